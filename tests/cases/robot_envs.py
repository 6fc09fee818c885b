"""Environments of someone else, each with one peculiarity."""

import gymnasium as gym
import numpy as np


class Robot(gym.Env):
    """A clock: frames turn brighter; never a success."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - as Gymnasium's are
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def frame(self):
        return np.full((64, 64, 3), 10 * self.t % 256, np.uint8)

    def observe(self):
        return self.frame()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        self.t += 1
        return (self.observe(), *self.outcome())

    def outcome(self):
        return 0.0, False, False, {}

    def render(self):
        return self.frame() if self.render_mode == "rgb_array" else None


class MinusOne(Robot):
    """AntMaze, Fetch, OGBench: -1 a step, 0 at the goal, where it ends."""

    def outcome(self):
        won = self.t >= 5
        return (0.0 if won else -1.0), won, False, {}


class Offset(Robot):
    """0.1 a step, 1 at the goal."""

    def outcome(self):
        won = self.t >= 5
        return (1.0 if won else 0.1), won, False, {}


class Unbounded(Robot):
    """Actions without bounds."""

    action_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


class TwoCameras(Robot):
    """Two images beside each other."""

    observation_space = gym.spaces.Dict(camera=Robot.observation_space, wrist=Robot.observation_space)

    def observe(self):
        return {"camera": self.frame(), "wrist": 255 - self.frame()}


class Pixels(Robot):
    """As gym_pusht: pixels only where asked for."""

    def __init__(self, render_mode=None, obs_type="state"):
        super().__init__(render_mode)
        self.pixels = obs_type == "pixels"
        if not self.pixels:
            self.observation_space = gym.spaces.Box(-9, 9, (2,), np.float32)

    def observe(self):
        return self.frame() if self.pixels else np.zeros(2, np.float32)


for name in ("Robot", "MinusOne", "Offset", "Unbounded", "TwoCameras", "Pixels"):
    gym.register(f"{name}-v0", f"robot_envs:{name}", max_episode_steps=20)
gym.register("NoLimit-v0", "robot_envs:Robot")
