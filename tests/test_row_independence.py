"""An episode is the same whatever episodes share its batch, also where their rows do other things at the same step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from toy_env import SIDE, ToyEnv, ToyModel, draw, toy_config
from toy_world import straight_to_goal
from velap.config import override
from velap.evaluation.rollout import FrameReader, Moment, Rollout
from velap.methods.provenance import ProvenanceAgent
from velap.methods.tree_agent import Actor, TreeAgent
from velap.methods.velap import VelapAgent

STARTS = ((-6.0, 0.0), (-3.0, -7.0), (1.5, 0.5), (-1.0, 7.0), (4.0, -8.0), (-8.0, 5.0), (9.0, 3.0), (-6.0, -1.0))
"""Where the episode of each seed begins: far behind the wall, near the goal, above and below it."""
STEPS = 25


class RecordingEnv(ToyEnv):
    """The toy world from the seed's start; keeps the actions of every episode."""

    def __init__(self, actions: dict[int, list[np.ndarray]]) -> None:
        super().__init__()
        self.actions, self.seed = actions, -1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        assert seed is not None
        super().reset(seed=seed)
        self.seed, self.position = seed, np.array(STARTS[seed])
        self.actions[seed] = []
        return draw(self.position), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.actions[self.seed].append(action)
        return super().step(action)


def actions_of(agent: TreeAgent, seeds: tuple[int, ...],
               batch: int) -> tuple[dict[int, np.ndarray], set[tuple[bool, Actor]]]:
    """The actions [steps, A] of every episode, and what rows did at one step: whether they planned, and who acted."""
    taken: dict[int, list[np.ndarray]] = {}
    modes: set[tuple[bool, Actor]] = set()

    def watch(moment: Moment) -> None:
        row = moment.row
        modes.add((bool(row in agent.planned_rows), agent.last_actors[row]))

    envs: list[gym.Env[Any, Any]] = [RecordingEnv(taken) for _ in range(batch)]
    rollout = Rollout(envs, agent, FrameReader(envs[0], SIDE, None), max_steps=STEPS, observer=watch)
    assert {episode.seed for episode in rollout.run(seeds)} == set(seeds)
    return {seed: np.stack(actions) for seed, actions in taken.items()}, modes


@pytest.mark.parametrize("provenance", [False, True], ids=["algorithm-2", "provenance"])
def test_every_episode_takes_the_same_actions_in_any_batch(provenance: bool) -> None:
    """π^g walks on the left of the wall, the clone on the right, and g is trusted little."""
    config = override(toy_config(n_iter=40, provenance=provenance), controller={"n_replan": 5})
    kind = ProvenanceAgent if provenance else VelapAgent

    def agent() -> TreeAgent:
        model = ToyModel(act_global=lambda z: (z[..., :1] < 0) * straight_to_goal(z),
                         act_success=lambda z: (z[..., :1] >= 0) * straight_to_goal(z))
        return kind(model, config)  # type: ignore[arg-type]

    acted: set[Actor] = set()
    every = tuple(range(len(STARTS)))
    alone: dict[int, np.ndarray] = {}
    for seed in every:
        alone |= actions_of(agent(), (seed,), 1)[0]
    assert max(len(actions) for actions in alone.values()) > 5, "some episode plans more than once"
    for seeds, batch in ((every, 8), (every[::-1], 3), ((2, 0, 6, 1, 2), 2)):
        together, modes = actions_of(agent(), seeds, batch)
        assert len(modes) >= 3, f"rows did the same all the time: {modes}"
        acted |= {actor for _, actor in modes}
        for seed, actions in together.items():
            np.testing.assert_allclose(actions, alone[seed], atol=1e-5, err_msg=f"seed {seed} in {seeds}, {batch} at once")
    assert acted >= {Actor.LOCAL, Actor.GOAL} | ({Actor.POLICY, Actor.CLONE} if provenance else set())
