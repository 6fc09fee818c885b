"""A task of another package: a dot that is moved to the right edge of its picture."""

import gymnasium as gym
import numpy as np

from velap.tasks import Recipe, Task


class Reach(gym.Env):
    observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        left = options is not None and options.get("split") == "test"
        self.place = self.np_random.uniform(0, 0.1 if left else 0.9, 2)
        return self.render(), {}

    def step(self, action):
        self.place = np.clip(self.place + 0.05 * np.asarray(action), 0, 1)
        success = bool(self.place[0] > 0.95)
        return self.render(), float(success), success, False, {"success": success}

    def render(self):
        frame = np.zeros((64, 64, 3), np.uint8)
        row, column = (self.place[::-1] * 55).astype(int)
        frame[row : row + 8, column : column + 8] = 255
        return frame


gym.register("Reach-v0", "reach_task:Reach", max_episode_steps=40)
TASK = Task("Reach", "reach_task:Reach-v0", max_steps=40, recipe=Recipe(1, 40, 12, success_percent=1.0))
