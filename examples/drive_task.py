"""Drive a simulated task through `velap serve`, as a robot would. Needs openpi-client and the task, nothing of the model.

    velap serve checkpoints/SpiralMaze.safetensors
    python examples/drive_task.py SpiralMaze --seed 1000

On a robot the three lines of the environment become the camera and the motors.
"""

from __future__ import annotations

import argparse
import os

import gymnasium as gym
from openpi_client.websocket_client_policy import WebsocketClientPolicy

import velap.envs  # noqa: F401 - registers the tasks


def drive(task: str, seed: int, host: str = "localhost", port: int = 8000, api_key: str | None = None) -> tuple[bool, int]:
    """One episode; returns whether it reached the goal, and its steps."""
    client = WebsocketClientPolicy(host, port, api_key)
    env = gym.make(f"velap/{task}-v0")
    picture, _ = env.reset(seed=seed, options={"split": "test"})
    steps, done, success = 0, False, False
    while not done:
        answer = client.infer({"image": picture, "reset": steps == 0, "seed": seed})
        picture, reward, terminated, truncated, _ = env.step(answer["actions"][0])
        steps, done, success = steps + 1, terminated or truncated, reward > 0
    env.close()
    return success, steps


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", default="SpiralMaze")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--port", type=int, default=8000)
    arguments = parser.parse_args()
    reached, steps = drive(**vars(arguments), api_key=os.environ.get("VELAP_API_KEY"))
    print(f"{'reached the goal' if reached else 'did not reach the goal'} after {steps} steps")
