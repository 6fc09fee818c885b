"""`velap diagnose`: known numbers from exact models, every class of failure, the command from end to end, its errors."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

from test_cli import untrained
from toy_env import toy_config, toy_player
from toy_world import GOAL, START, toy_fns
from velap import cli
from velap.config import Config, ModelConfig, describe
from velap.config.training import TrainConfig
from velap.data.frames import FrameStore, Reading
from velap.data.sampling import WindowSampler
from velap.data.writing import Extras, write_dataset
from velap.envs.mazes.env import STEP_LENGTH, SpiralMaze
from velap.envs.sawyer.tasks import DrawerButton
from velap.evaluation.rollout import FrameReader
from velap.models import checkpoint as checkpoints
from velap.models.checkpoint import load_checkpoint
from velap.report.diagnose import failures, text
from velap.report.diagnose.failures import CLASSES, REMEDIES, Trace, classify, judge, watch
from velap.report.diagnose.model import (
    LED,
    Recorded,
    StatePairs,
    ValueCurve,
    action_values,
    encode_states,
    open_recorded,
    other_pairs,
    rank_correlation,
    real_states_of,
    rollout_error,
)
from velap.report.diagnose.plans import Starts, plan_strip, tree_numbers
from velap.report.diagnose.world import distances_to, look_at_scene, stack_all
from velap.report.figures import RealStates
from velap.search.est import plan
from velap.training.diagnostics import horizons

DISCOUNT = 0.96
DRIFT = 0.1
"""The line model's dynamics go this much too far at every step."""


class LineModel(nn.Module):
    """States on a line, one apart; the brightness of a frame is the place. All exact but for dynamics that drift."""

    discount, action_dim, config, memory = DISCOUNT, 1, ModelConfig(), 0.0

    def __init__(self, period: float = 1e9) -> None:
        super().__init__()
        self.anchor = nn.Parameter(torch.zeros(1))
        self.period = period
        """States so far apart look the same to Q^l."""

    def encode(self, frames: Tensor, commands: Tensor | None = None, state: Tensor | None = None) -> Tensor:
        return frames[..., -1, 0, 0, :1].float()

    def step(self, latent: Tensor, action: Tensor) -> Tensor:
        return latent + action + DRIFT

    def reach(self, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        apart = (goal - start).abs()[..., 0] % self.period
        return DISCOUNT**apart, torch.zeros_like(apart)


def line_store(episodes: int = 8, length: int = 20, side: int = 4) -> FrameStore:
    """Episode e walks from place 20 e to the right, one place a step; the last one is rewarded."""
    place = np.concatenate([length * e + np.arange(length + 1) for e in range(episodes)])
    rows = len(place)
    frames = np.broadcast_to(place.astype(np.uint8)[:, None, None, None], (rows, side, side, 3)).copy()
    rewards, terminated, truncated = np.zeros(rows), np.zeros(rows, bool), np.zeros(rows, bool)
    ends = np.arange(length - 1, rows, length + 1)
    rewards[ends[-1]], terminated[ends[-1]], truncated[ends[:-1]] = 1, True, True
    actions = np.ones((rows, 1))
    actions[length :: length + 1] = 0
    return FrameStore.from_arrays(frames=frames, actions=actions, rewards=rewards, terminated=terminated,
    truncated=truncated,
                                  episode_length=np.full(episodes, length), action_low=[-1.0], action_high=[1.0],
                                  dataset_id="test/line-v0")


def line_recorded(looked_at: list[int]) -> Recorded:
    store = line_store()
    held_out = np.array(looked_at)
    sampler = WindowSampler(store, TrainConfig(), 1, torch.device("cpu"), held_out)
    positions = store.frames[:, 0, 0, :2].astype(np.float32) * (1, 0)
    return Recorded(store=store, sampler=sampler, episodes=held_out, held_out=True, positions=positions.astype(np.float32))


def test_rollout_error_displacement_and_local_steps_are_exact() -> None:
    recorded = line_recorded([2, 5])
    assert recorded.spans == [(42, 62), (105, 125)]
    found = rollout_error(horizons(LineModel(), recorded.sampler, recorded.spans, (1, 3, 10, 30), None))  # type: ignore[arg-type]
    assert found.lengths.tolist() == [1, 3, 10], "no episode has 30 steps"
    assert found.one_step == 1
    np.testing.assert_allclose(found.error, np.tile([0.1, 0.3, 1.0], (3, 1)), rtol=1e-4)
    np.testing.assert_allclose(found.moved, np.tile([1, 3, 10], (3, 1)))
    np.testing.assert_allclose(found.local_steps, np.tile([1, 3, 10], (3, 1)), rtol=1e-4)
    assert found.at(4) == 1


def test_pairs_of_other_trajectories_come_from_near_and_from_far() -> None:
    recorded, rng = line_recorded([3]), np.random.default_rng(0)
    near, far = other_pairs(LineModel(), recorded, 1, rng, 300)  # type: ignore[arg-type]
    assert (near.name, far.name) == ("neighbouring episodes", "far episodes")
    assert near.local_steps.max() <= 40.01 < far.local_steps.max()
    assert far.local_steps.min() >= 19.99
    for each in (near, far):
        assert each.least_steps is not None
        np.testing.assert_allclose(each.local_steps, each.least_steps, rtol=1e-3, atol=1e-3)
        assert each.aliased(3.0) == 0
    assert recorded.fastest == pytest.approx(1)
    near, far = other_pairs(LineModel(period=25), recorded, 1, rng, 300)  # type: ignore[arg-type]
    assert 0.05 < far.aliased(3.0) < 0.3, "of 25 places 4 look at most three steps away"
    assert len(other_pairs(LineModel(), recorded, 8, rng, 10)) == 1, "no episode is farther than 8"  # type: ignore[arg-type]


def test_aliasing_counts_states_that_are_truly_apart() -> None:
    pairs = StatePairs(
        name="x",
        local_steps=np.array([1.0, 1.0, 9.0, 9.0, 2.0]),
        least_steps=np.array([20.0, 1.0, 20.0, 1.0, 6.1]))
    assert pairs.arrived(3.0) == 0.6
    assert pairs.aliased(3.0) == pytest.approx(2 / 3)
    assert pairs.aliased(30.0) is None
    assert dataclasses.replace(pairs, least_steps=None).aliased(3.0) is None


class ClimbingModel(LineModel):
    """The goal is 255 places up the line and π^g goes there at once; farther than `sight` Q^g is blind to actions."""

    sight = 1e9

    def value(self, latent: Tensor) -> Tensor:
        return DISCOUNT ** (255 - latent[..., 0])

    def global_q(self, latent: Tensor, action: Tensor) -> Tensor:
        seen = 255 - latent[..., 0] <= self.sight
        return self.value(latent) * DISCOUNT ** torch.where(seen, 1 - action[..., 0], latent[..., 0] % 7)


def test_promises_of_actions_are_compared_with_what_comes_of_them() -> None:
    rng = np.random.default_rng(0)
    walks = [np.repeat(rng.choice([-1, 1], 40), LED) for _ in range(4)]
    places = [100 + np.concatenate([[0], walk.cumsum()]) for walk in walks]
    rows = sum(map(len, places))
    frames = np.broadcast_to(np.concatenate(places).astype(np.uint8)[:, None, None, None], (rows, 4, 4, 3)).copy()
    ends = np.cumsum([len(place) for place in places]) - 1
    truncated = np.isin(np.arange(rows), ends - 1)
    rewards, never = np.zeros(rows), np.zeros(rows, bool)
    actions = np.concatenate([[*walk, 0] for walk in walks])[:, None].astype(float)
    store = FrameStore.from_arrays(frames=frames, actions=actions, rewards=rewards, terminated=never, truncated=truncated,
                                   episode_length=[len(walk) for walk in walks], action_low=[-1.0], action_high=[1.0])
    sampler = WindowSampler(store, TrainConfig(), 1, torch.device("cpu"), np.arange(3))
    recorded = Recorded(store=store, sampler=sampler, episodes=np.arange(3), held_out=True, positions=None)
    model: Any = ClimbingModel()
    latents = encode_states(model, recorded.sampler, recorded.rows)
    found = action_values(model, recorded, latents)
    assert len(found.away) == sum(len(place) - LED for place in places[:3])
    taken = np.concatenate([walk[: len(walk) + 1 - LED] for walk in walks[:3]])
    np.testing.assert_allclose(found.promised, taken - 1, atol=1e-3)
    np.testing.assert_allclose(found.gained, np.concatenate([place[LED:] - place[:-LED] for place in places[:3]]), atol=1e-2)
    assert min(found.rho(far=False), found.rho(far=True)) > 0.7
    model.sight = np.median(found.away)
    blind = action_values(model, recorded, latents)
    assert blind.rho(far=False) > 0.7
    assert abs(blind.rho(far=True)) < 0.25
    assert np.isnan(dataclasses.replace(blind, away=blind.away[:60], promised=blind.promised[:60], gained=blind.gained[:60])
                    .rho(far=True)), "30 transitions are too few"


def test_rank_correlation_and_values_along_an_episode() -> None:
    assert rank_correlation(np.array([1.0, 2, 3, 4]), np.array([1.0, 3, 2, 4])) == pytest.approx(0.8)
    assert np.isnan(rank_correlation(np.ones(4), np.arange(4.0)))
    ideal = DISCOUNT ** np.arange(9.0, -1, -1)
    curve = ValueCurve("x", np.append(ideal, 1.0), DISCOUNT)
    np.testing.assert_allclose(curve.ideal, ideal)
    assert curve.rho == pytest.approx(1)
    assert curve.steps_error == pytest.approx(0, abs=1e-6)
    early = ValueCurve("x", np.append(ideal * DISCOUNT**3, 1.0), DISCOUNT)
    assert early.steps_error == pytest.approx(3)


def test_an_album_finds_the_nearest_real_state_and_holds_none_that_is_looked_at() -> None:
    recorded, model = line_recorded([0]), LineModel()
    real_states = real_states_of(model, recorded, np.random.default_rng(0), 1000)  # type: ignore[arg-type]
    numbers, distances = real_states.nearest(np.array([[60.4], [3.0]]))
    assert real_states.frames[numbers, 0, 0, 0].tolist() == [60, 20]
    np.testing.assert_allclose(distances, [0.4, 17], atol=1e-4)
    assert encode_states(model, recorded.sampler, np.array([0, 25])).tolist() == [[0.0], [24.0]]  # type: ignore[arg-type]
    assert RealStates(
        source="x",
        latents=np.array([[0.0], [1.0], [5.0]], np.float32),
        frames=real_states.frames).spacing() == pytest.approx((1 + 1 + 4) / 3)


def test_shortest_ways_between_points_of_a_maze() -> None:
    layout = SpiralMaze().layout
    start = layout.sample_free(np.random.default_rng(0), 50)
    goal = start[0]
    steps, straight = distances_to(layout, start, goal), np.linalg.norm(start - goal, axis=-1) / STEP_LENGTH
    sees = layout.sees(start, goal)
    np.testing.assert_allclose(steps[sees], straight[sees], atol=0.01)
    assert (steps[~sees] > straight[~sees]).all()
    assert steps.max() > 60, "the corridor is long"


class SeeingModel(nn.Module):
    """Reads the block's place off the frame; straight distances, true ways to the goal."""

    discount, action_dim, config, memory = DISCOUNT, 2, ModelConfig(), 0.0

    def __init__(self, world: Any) -> None:
        super().__init__()
        self.anchor, self.world = nn.Parameter(torch.zeros(1)), world

    def encode(self, frames: Tensor, commands: Tensor | None = None, state: Tensor | None = None) -> Tensor:
        picture = frames[:, -1].float()
        blue = ((picture[..., 2] - picture[..., 0]) > 60).float()
        axis = torch.arange(64.0) + 0.5
        count = blue.sum((1, 2))
        column, row = (blue.sum(1) * axis).sum(1) / count, (blue.sum(2) * axis).sum(1) / count
        return torch.stack([column / 32 - 1, 1 - row / 32], -1)

    def to_unit(self, action: Tensor) -> Tensor:
        return action

    def reach(self, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        q = DISCOUNT ** ((goal - start).norm(dim=-1) / STEP_LENGTH)
        return q, torch.zeros_like(q)

    def value(self, latent: Tensor) -> Tensor:
        places = np.stack([self.world.layout.nearest_free(place) for place in latent.double().numpy()])
        return torch.from_numpy(DISCOUNT ** self.world.geodesic_steps(places))


def test_a_scene_tells_learnt_from_true_distances() -> None:
    env = gym.make("velap/SpiralMaze-v0")
    scene = look_at_scene(SeeingModel(env.unwrapped), env, FrameReader(env, 64), 1, 1000, 60)  # type: ignore[arg-type]
    assert scene.value_rho > 0.99
    assert scene.near_rho > 0.9, "a straight line is the way, but for a few walls"
    assert scene.local_rho < 0.5, "and far off it is not"
    assert scene.aliased(3.0, 6.0) < 0.05
    assert scene.aliased(12.0, 30.0) > 0.02, "through a wall of the spiral"
    assert scene.aliased(3.0, 1e6) is None


def test_trees_in_numbers_and_as_a_strip() -> None:
    roots = torch.tensor([START, GOAL], dtype=torch.float64)
    config = toy_config().planner
    result = plan(toy_fns(), roots, config, [torch.Generator().manual_seed(seed) for seed in (0, 1)])
    grid = np.stack(np.meshgrid(np.arange(-10.0, 11), np.arange(-10.0, 11), indexing="ij"), -1).reshape(-1, 2)
    real_states = RealStates(
        source="a grid",
        latents=grid.astype(np.float32),
        frames=(grid[:, None, None, :1] + 10).repeat(3, -1).astype(np.uint8))
    starts = Starts(("one", "two"), np.full((2, 1, 1, 1, 3), 77, np.uint8))
    first, second = tree_numbers(starts, result, real_states, 0.5)
    assert first.nodes - 1 + sum(first.rejected.values()) == config.n_iter
    nodes = result.tree.latents[0, : first.nodes]
    assert first.distance == pytest.approx(float(torch.cdist(nodes, torch.tensor(grid)).amin(1).mean()) / 0.5)
    assert second.reached_goal and second.waypoints == 0 and second.start_value == pytest.approx(1)
    strip = plan_strip(starts, result, real_states, 0.5)
    assert len(strip.frames) == len(strip.captions) == first.waypoints + 1
    assert strip.frames[0, 0, 0, 0] == 77
    np.testing.assert_allclose(strip.frames[1:, 0, 0, 0] - 10.0, result.waypoints[0, 1 : len(strip.frames), 0], atol=0.51)


def a_trace(**changes: Any) -> Trace:
    """An episode that goes ten steps to the right and back, and fails."""
    way = [np.array([0.1 * min(step, 20 - step), 0.0]) for step in range(21)]
    return Trace(7, **{"positions": way, "values": [0.1] * 20, "near_goal": [False] * 20, "steps": 20, **changes})


@pytest.mark.parametrize(("kind", "changes"), [
    ("solved", {"success": True}),
    ("never left the start", {"positions": [np.array([0.1 * (step % 5), 0.0]) for step in range(21)]}),
    ("wrong order", {"subtasks": [(False, False), (False, True), (True, True)], "near_goal": [True]}),
    ("object not finished", {"objects": [np.zeros((2, 3)), np.array([[0, 0, 0], [0, 0.02, 0]])], "near_goal": [True],
                             "subtasks": [(False, False), (True, False), (True, True), (True, False)]}),
    ("failed near the goal", {"near_goal": [False, True, False], "objects": [np.zeros((1, 3)), np.full((1, 3), 0.001)]}),
    ("stopped halfway", {}),
    ("stopped halfway", {"positions": []}),
])
def test_every_failure_has_its_class(kind: str, changes: dict[str, Any]) -> None:
    assert classify(a_trace(**changes), fastest=0.1) == kind
    assert set(REMEDIES) == set(CLASSES) - {"solved"}


def test_outcomes_carry_what_they_were_judged_by() -> None:
    stuck, moved = judge([dataclasses.replace(a_trace(goal_steps=[30.0, 12.0]), seed=9),
                            dataclasses.replace(a_trace(positions=[np.zeros(2), np.array([0.05, 0])]), seed=8)], None)
    assert (stuck.seed, stuck.kind, stuck.farthest) == (8, "never left the start", pytest.approx(0.05))
    assert (moved.seed, moved.kind, moved.goal_steps, moved.best_value) == (9, "stopped halfway", 12.0, 0.1)
    assert moved.farthest == pytest.approx(1.0)
    assert judge([a_trace()], fastest=0.3)[0].kind == "never left the start", "the data hold longer steps"


def test_episodes_are_watched_and_shown() -> None:
    failures = watch(toy_player(), range(1000, 1002), None)
    assert failures.counts["solved"] == 2
    assert [outcome.seed for outcome in failures.outcomes] == [1000, 1001]
    assert failures.strip.captions[0].startswith("step 0\n")
    assert failures.strip.captions[-1].endswith("\nend")
    cut = watch(toy_player(max_steps=2, n_iter=20), [1000], None)
    assert cut.counts["never left the start"] == 1
    assert cut.strip.title == "Episode 1000: never left the start"


def test_the_drawer_and_the_button_tell_what_is_done() -> None:
    world = DrawerButton()
    world.start({"split": "test"}, 1000)
    before = world.objects()
    assert world.subtasks() == (False, False)
    world.set_joint("btnbox_joint", -0.055)
    world.advance(np.zeros(4))
    assert world.subtasks() == (False, True)
    assert np.linalg.norm(world.objects() - before, axis=-1).max() > 0.03
    world.set_joint("goal_slidey", 0.0)
    assert world.subtasks()[0]


def test_states_of_an_episode_repeat_its_first_frame() -> None:
    frames = [np.full((1, 1, 3), step, np.uint8) for step in range(4)]
    assert stack_all(frames, 3)[..., 0, 0, 0].tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3]]


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A small dataset whose actions fit the mazes and whose agent is fast, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    store, bounds = line_store(episodes=12, side=64), np.ones(2, np.float32)
    positions = store.frames[:, 0, 0, :2].astype(np.float32)
    small = FrameStore.from_arrays(frames=store.frames, actions=store.actions.repeat(2, 1), rewards=store.rewards,
                                   terminated=store.terminated, truncated=store.truncated,
                                   episode_length=store.episode_length, action_low=-bounds, action_high=bounds,
                                   dataset_id="test/small-v0")
    write_dataset(small, Extras(positions=positions))
    return "test/small-v0"


def test_the_command_writes_its_page_and_pictures(small: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = untrained(tmp_path / "model.safetensors")
    command = ["diagnose", "SpiralMaze", "--dataset", small, "--checkpoint", str(checkpoint), "--out", "report"]
    assert cli.main([*command, "--episodes", "2", "--max-steps", "6", "--set", "planner.n_iter=6"]) == 0
    assert "LOOK  Dynamics h: after" in capsys.readouterr().out
    pictures = ("model.png", "values.png", "scenes.png", "plan.png", "failure.png")
    assert sorted(path.name for path in Path("report").iterdir()) == sorted([*pictures, "report.md"])
    for name in pictures:
        with Image.open(Path("report") / name) as image:
            assert min(image.size) > 200
    text = (Path("report") / "report.md").read_text()
    assert all(f"]({name})" in text for name in pictures)
    assert "| 1000 | never left the start | 6 | " in text
    assert "were not trained on" in text
    assert "Q^g against the shortest way to the goal" in text
    assert all(f"- **{kind}**: " in text for kind in CLASSES)


def test_a_foreign_dataset_needs_no_environment(small: str, tmp_path: Path) -> None:
    checkpoint = untrained(tmp_path / "model.safetensors", task="robot")
    assert cli.main(["diagnose", "--dataset", small, "--checkpoint", str(checkpoint)]) == 0
    folder = Path("runs/diagnosis/test_small-v0")
    assert sorted(path.name for path in folder.iterdir()) == ["model.png", "plan.png", "report.md", "values.png"]
    text = (folder / "report.md").read_text()
    assert "Left out: true distances, the expert's path and episodes: there is no environment" in text
    assert "along 1 episodes" in text
    assert "of the data |" in text, "plans start from recorded states"
    assert "## Episodes" not in text


@pytest.mark.parametrize(("kept", "named", "episodes"), [("reward>=0", None, 12), ("reward>=0", "reward>=1", 1)])
def test_the_data_are_read_as_the_checkpoint_says(small: str, tmp_path: Path, kept: str, named: str | None,
                                                  episodes: int) -> None:
    model, config, _ = load_checkpoint(untrained(tmp_path / "model.safetensors", task="robot"))
    store = open_recorded(small, None, model, config, {"reading": Reading(success=kept).to_json()}, named).store
    assert store.rewards.sum() == episodes, "an episode ends with its first success"


def test_a_foreign_environment_is_run(small: str, tmp_path: Path) -> None:
    checkpoint = untrained(tmp_path / "model.safetensors", task="robot")
    assert cli.main(["diagnose", "toys", "--dataset", small, "--env", "toy_env:Toy-v0", "--checkpoint", str(checkpoint),
                     "--episodes", "1", "--max-steps", "3", "--first-seed", "0"]) == 0
    text = (Path("runs/diagnosis/toys") / "report.md").read_text()
    assert "Left out: true distances in test scenes" in text
    assert "| 0 | never left the start | 3 | " in text


@pytest.mark.parametrize(("arguments", "text"), [
    ([], "neither a task nor a dataset"),
    (["Nowhere"], "unknown task 'Nowhere'"),
    (["SpiralMaze"], "no released checkpoint of SpiralMaze"),
    (["SpiralMaze", "--first-seed", "5"], "seeds 0 to 99 are the test episodes"),
    (["SpiralMaze", "--episodes", "0"], "got 0 episodes"),
    (["SpiralMaze", "--checkpoint", "gone.safetensors"], "Make it with `velap collect SpiralMaze`"),
    (["--dataset", "robot/pile-v0"], "expected --checkpoint"),
    (["--dataset", "test/small-v0", "--checkpoint", "gone.safetensors"], "no checkpoint at gone.safetensors"),
    (["--dataset", "robot/pile-v0", "--checkpoint", "model.safetensors"], "no Minari dataset 'robot/pile-v0'"),
    (["SpiralMaze", "--dataset", "test/small-v0", "--checkpoint", "model.safetensors"], "was trained on 'robot'"),
    (["--dataset", "test/line-v0", "--checkpoint", "model.safetensors"], "actions of 1 entries, the checkpoint acts by 2"),
    (["--dataset", "test/small-v0", "--checkpoint", "model.safetensors", "--set", "planner.nothing=1"], "no field"),
])
@pytest.mark.usefixtures("small")
def test_errors_are_one_paragraph_and_leave_nothing(arguments: list[str], text: str, monkeypatch: pytest.MonkeyPatch,
                                                    capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(checkpoints, "__file__", str(Path("models/checkpoint.py").absolute()))
    untrained(Path("model.safetensors"), task="robot")
    if "test/line-v0" in arguments:
        write_dataset(line_store(side=64))
    assert cli.main(["diagnose", *arguments]) == 2
    (message,) = (line for line in capsys.readouterr().err.splitlines() if not line.startswith("note: "))
    assert text in message
    assert message.startswith("velap: ")
    assert not Path("runs").exists()


def test_every_config_field_that_advice_names_exists() -> None:
    known = {name for name, *_ in describe(Config(task="x", preset="default"))}
    for module in (text, failures):
        named = re.findall(r"\b(?:model|train|planner|controller)(?:\.[a-z_0-9]+)+", Path(module.__file__).read_text())
        assert named and set(named) <= known, module.__name__
