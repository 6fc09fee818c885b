"""The toy world as pixels: an environment whose frames hold its position, and an exact model that reads them.

Makes agents, rollouts and videos testable without training.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from toy_world import GOAL, HALF_WIDTH, START, TIP, algorithm_1, crosses_wall, move, straight_to_goal, toy_fns
from velap.config import Config, ModelConfig, override
from velap.evaluation.evaluate import Player
from velap.evaluation.records import RunKey
from velap.methods.base import make_agent
from velap.models.functions import SearchFns
from velap.models.velap import Spaces

SIDE = 8
ACTION_SCALE = 2.0
"""The environment's actions are this times the model's."""


def draw(position: np.ndarray, size: int = SIDE) -> np.ndarray:
    """Frame uint8 [size, size, 3] with x and y in red and green of every pixel."""
    frame = np.zeros((size, size, 3), np.uint8)
    frame[..., :2] = np.round((position + HALF_WIDTH) / (2 * HALF_WIDTH) * 255)
    frame[..., 2] = 77
    return frame


def read(frames: Tensor) -> Tensor:
    """Positions [*, 2] of the newest of stacked frames [*, N, H, W, 3]."""
    return frames[..., -1, 0, 0, :2].double() / 255 * 2 * HALF_WIDTH - HALF_WIDTH


class ToyEnv(gym.Env[np.ndarray, np.ndarray]):
    """From START, moved a little by the seed, to within 1 of GOAL."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}
    render_mode = "rgb_array"
    extent = (-HALF_WIDTH, HALF_WIDTH, -HALF_WIDTH, HALF_WIDTH)

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)
        self.action_space = gym.spaces.Box(-ACTION_SCALE, ACTION_SCALE, (2,), np.float32)
        self.position = np.array(START)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position = np.array(START) + self.np_random.uniform(-0.5, 0.5, 2)
        return draw(self.position), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        moved = move(torch.from_numpy(self.position), torch.from_numpy(np.asarray(action, np.float64)) / ACTION_SCALE)
        self.position = moved.numpy()
        success = bool(np.linalg.norm(self.position - np.array(GOAL)) < 1)
        return draw(self.position), float(success), success, False, {"success": success}

    def render(self, size: int = SIDE) -> np.ndarray:  # type: ignore[override]
        return draw(self.position, size)

    def agent_position(self) -> np.ndarray:
        return self.position.copy()

    def set_agent_position(self, position: np.ndarray) -> None:
        self.position = np.asarray(position, np.float64)

    def free_positions(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return rng.uniform(-HALF_WIDTH, HALF_WIDTH, (count, 2))


class ToyModel(nn.Module):
    """The exact model of the toy world, with the parts of `LatentModel` that agents use."""

    def __init__(self, **changes: object) -> None:
        super().__init__()
        self.anchor = nn.Parameter(torch.zeros(1, dtype=torch.float64))
        self._fns = toy_fns(**changes)
        self.success_share = self._fns.success_share
        axis = torch.arange(-9.0, 10.0, 3.0)
        self.bank_latents = torch.cartesian_prod(axis, axis)
        self.bank_rows = torch.arange(len(self.bank_latents))
        self.encoded_batches: list[int] = []

    action_dim, config, memory = 2, ModelConfig(frame_stack=2), 0.0
    spaces = Spaces(SIDE, SIDE, (-ACTION_SCALE,) * 2, (ACTION_SCALE,) * 2)

    def encode(self, frames: Tensor, commands: Tensor | None = None, state: Tensor | None = None) -> Tensor:
        self.encoded_batches.append(len(frames))
        return read(frames)

    def to_unit(self, action: Tensor) -> Tensor:
        return action

    def act_local(self, latent: Tensor, goal: Tensor) -> Tensor:
        """The shortest way: straight, or over the tip of the wall."""
        over_the_tip = latent.new_tensor([0.0, TIP + 0.5])
        towards = torch.where(crosses_wall(latent, goal)[..., None], over_the_tip, goal) - latent
        return towards / towards.norm(dim=-1, keepdim=True).clamp(min=1)

    def act_global(self, latent: Tensor) -> Tensor:
        return straight_to_goal(latent)

    def value(self, latent: Tensor) -> Tensor:
        return self._fns.value(latent)

    def to_env(self, action: Tensor) -> np.ndarray:
        return (ACTION_SCALE * action).numpy().astype(np.float32)

    def search_fns(self, hidden: str | None = None) -> SearchFns:
        return self._fns


def toy_config(**planner: object) -> Config:
    """Config for the toy world: Algorithms 1 and 2, replanning every 10 steps; `planner` replaces fields of the search."""
    base = Config(task="toy", preset="default")
    settings = vars(algorithm_1(n_iter=60, n_sim=3, candidates=20)) | planner
    return override(base, planner=settings, controller={"n_replan": 10},
                    model={"frame_stack": 2})


def toy_env() -> gym.Env[Any, Any]:
    """The environment with a time limit of 60 steps."""
    return gym.wrappers.TimeLimit(ToyEnv(), 60)


def toy_player(max_steps: int = 60, n_iter: int = 300, **planner: object) -> Player:
    """VELAP in the toy world; `planner` replaces fields of the search."""
    model, config = ToyModel(), toy_config(n_iter=n_iter, **planner)
    key = RunKey(task="toy", method="velap", preset="default", train_seed=0, env="toy-v0", config_hash="0" * 12,
                 checkpoint="", code_version="test", max_steps=max_steps)
    agent = make_agent("velap", model, config, ToyEnv().action_space)  # type: ignore[arg-type]
    return Player(agent=agent, model=model, config=config, key=key, make_env=toy_env,  # type: ignore[arg-type]
                  image_size=SIDE)


gym.register("Toy-v0", ToyEnv, max_episode_steps=60)
