"""The problems from outside the package: their environments can be solved, and what they record can be read and holds
successes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import velap
from studies.foreign import maze
from velap.registry import TASKS

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari",
                                        "ignore:.*(its bounds are|go on after their|are resized)")


@pytest.fixture(autouse=True)
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))


def test_maze_is_a_long_way_and_its_walks_are_read() -> None:
    env = maze.LongWay()
    env.reset(seed=0)
    steps, reached = 0, False
    for corridor, x in enumerate((0.1, 0.3, 0.5, 0.7, 0.9)):
        for target in ((x, 0.9 if corridor % 2 else 0.1), (x, 0.1 if corridor % 2 else 0.9)):
            while np.abs(target - env.place).max() > 0.01 and not reached:
                observation, _, reached, *_ = env.step(((target - env.place) / maze.STEP).astype(np.float32))
                steps += 1
    assert reached and 80 < steps < 130
    assert env.observation_space.contains(observation)
    env.reset(seed=0)
    assert not any(env.step(np.array([1.0, -1.0]))[2] for _ in range(300))  # the walls hold

    successes = maze.collect(maze.Collection(walks=60, steps=40, dataset="foreign/few-v0"))
    store = velap.load_store("foreign/few-v0", image_key=maze.IMAGE_KEY)
    assert store.n_episodes == 60 and 0 < store.rewards.sum() == successes < 20
    assert store.frames.shape[1:] == (64, 64, 3)


def test_pusht_is_recorded_with_coverage_by_which_successes_are_told(tmp_path: Path) -> None:
    pusht = pytest.importorskip("studies.foreign.pusht", reason="gym-pusht is not installed")
    path = tmp_path / "few.npz"
    highest = pusht.collect(pusht.Collection(path, seed=1, episodes=6, steps=60, share=1.0))
    least = sorted(highest)[-2] - 1e-4
    store = velap.load_store(str(path), success=f"info:coverage>={least:.6f}")
    assert store.n_episodes == 6 and store.rewards.sum() == 2
    assert store.actions.min() >= 0 and store.actions.max() <= 512


def test_button_is_a_registered_task_that_its_expert_solves_and_that_velap_collects(monkeypatch: pytest.MonkeyPatch) -> None:
    button = pytest.importorskip("studies.foreign.button")
    env = button.ButtonTopdown()
    env.start({"split": "test"}, seed=1000)
    assert env.in_test_region() and env.render().shape == (64, 64, 3)
    assert any(env.advance(env.expert_action()) for _ in range(button.TASK.max_steps))

    recipe = replace(button.TASK.recipe, contexts=2, trajectories=4, max_steps=50)
    with monkeypatch.context() as patch:
        patch.setitem(TASKS, "ButtonTopdown", replace(button.TASK, recipe=recipe, behaviours={"noisy-expert": 1.0}))
        store = velap.load_store(velap.make_dataset("ButtonTopdown", workers=1))
    TASKS.pop("ButtonTopdown")  # other tests know velap's own tasks
    assert store.dataset_id == "velap/ButtonTopdown-v0" and store.n_episodes == 8 and 0 < store.rewards.sum() < 8
