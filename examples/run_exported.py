"""π^g from `velap export`, with PyTorch and NumPy alone: copy this file to the robot.

    velap export checkpoints/SpiralMaze.safetensors --out exported
    python examples/run_exported.py exported
"""

from __future__ import annotations

import json
import sys
from collections import deque
from pathlib import Path

import numpy as np
import torch


class ExportedPolicy:
    """Acts by the goal policy π^g, one robot at a time."""

    def __init__(self, folder: Path) -> None:
        self.about = json.loads((folder / "export.json").read_text())
        self._encode = torch.export.load(folder / "encode.pt2").module()
        self._policy = torch.export.load(folder / "act_global.pt2").module()
        self._low, self._high = (np.float32(self.about[name]) for name in ("action_low", "action_high"))
        self._frames: deque[np.ndarray] = deque(maxlen=self.about["frame_stack"])
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._frames.clear()
        self._commands = torch.zeros(1, len(self._low))

    @torch.no_grad()
    def act(self, frame: np.ndarray, state: np.ndarray | None = None) -> np.ndarray:
        """The camera's newest frame uint8 [H, W, 3], and the state [S] of a model that has one -> action float32 [A] in the
        robot's own range."""
        if frame.dtype != np.uint8 or list(frame.shape) != self.about["image_shape"]:
            raise ValueError(f"got {frame.dtype}{list(frame.shape)}; expected uint8{self.about['image_shape']}")
        self._frames.append(frame)
        while len(self._frames) < self.about["frame_stack"]:
            self._frames.appendleft(frame)  # the first frame stands for those before it
        seen = [torch.from_numpy(np.stack(self._frames))[None], self._commands]
        if self.about["state_size"]:
            seen.append(torch.tensor(np.asarray(state, np.float32)).reshape(1, self.about["state_size"]))
        action = self._policy(self._encode(*seen))
        memory = self.about["command_memory"]
        self._commands = memory * self._commands + (1 - memory) * action
        return self._low + (action[0].numpy() + 1) / 2 * (self._high - self._low)


if __name__ == "__main__":
    policy = ExportedPolicy(Path(sys.argv[1]))
    print(policy.act(np.zeros(policy.about["image_shape"], np.uint8)))
