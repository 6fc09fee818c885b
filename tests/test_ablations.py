"""Figures 5 and 6: what reaches φ, what is measured in unseen scenes, resuming, and pictures from the committed results."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from rich.console import Console

import tiny_training
from studies import ablations, dynamics_loss, objectives, representation, unseen
from studies.ablations import Plan, Variant, budget, gather, show, updates_of, with_updates
from studies.exact_latents import collect_states, without_drawing
from studies.objectives import SHAPED_BY, DynamicsPhase, ObjectivePhase, known_phases
from velap import cli
from velap.config import Config, JointPhase, LatentPhase, TrainConfig, ValuePhase
from velap.config.training import PHASES
from velap.data.frames import FrameStore
from velap.envs.mazes.obstacle import TRAIN_CONTEXTS, obstacle_layout
from velap.errors import ConfigError
from velap.evaluation.evaluate import make_env
from velap.evaluation.records import read_records
from velap.registry import TASKS
from velap.tasks import get_task, make_config

ROOT = Path(__file__).parent.parent
STUDIES = {"5": representation.STUDY, "6": dynamics_loss.STUDY}


def phase(**fields: object) -> ObjectivePhase:
    """A phase on the frames of `tiny_training`."""
    return ObjectivePhase(**{"steps": 2, "windows": 3, "window": 5, **fields})  # type: ignore[arg-type]


def trained(path: Path, *phases: object, **model: object) -> tiny_training.Trainer:
    """All updates of these phases."""
    train = dataclasses.replace(tiny_training.QUICK, phases=phases)  # type: ignore[arg-type]
    config = Config("test", "default", model=dataclasses.replace(tiny_training.SMALL, **model), train=train)
    with known_phases():
        return tiny_training.to_end(tiny_training.make(path, config))


# what shapes φ


@pytest.mark.parametrize("objective", SHAPED_BY)
def test_heads_learn_whatever_shapes_the_encoder(tmp_path: Path, objective: str) -> None:
    side = 4 if objective == "reconstruction" else 0
    run = tiny_training.make(tmp_path, tiny_training.config())
    before = tiny_training.weights(run.model)
    after = trained(tmp_path, phase(objective=objective, reconstruction_side=side)).model
    changed = tiny_training.moved(before, after)
    heads = {"dynamics", "local_critics", "global_critic", "local_policy", "global_policy", "action_model"}
    assert changed == heads | ({"encoder"} if objective != "none" else set())


@pytest.mark.parametrize(("objective", "deaf"), [("contrastive", "c0"), ("values", "c1")])
def test_other_losses_do_not_reach_the_encoder(tmp_path: Path, objective: str, deaf: str) -> None:
    def encoder(weight: float) -> dict[str, torch.Tensor]:
        one = phase(objective=objective, steps=1, **({"c1": weight} if deaf == "c1" else {}))
        train = dataclasses.replace(tiny_training.QUICK, phases=(one,), **({"c0": weight} if deaf == "c0" else {}))
        with known_phases():
            settings = Config("test", "default", model=tiny_training.SMALL, train=train)
            return tiny_training.weights(tiny_training.to_end(tiny_training.make(tmp_path, settings)).model.encoder)

    one, other = encoder(0.1), encoder(7.0)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_joint_is_the_packages_own_joint_phase(tmp_path: Path) -> None:
    ours = trained(tmp_path, phase(objective="joint"))
    theirs = trained(tmp_path, JointPhase(2, windows=3, window=5))
    assert all(torch.allclose(value, theirs.model.state_dict()[name], atol=1e-5)
               for name, value in ours.model.state_dict().items())


@pytest.mark.parametrize(("loss", "horizon"), [("infonce", 3), ("mse", 3), ("mse", 1)])
def test_the_loss_of_h_is_the_one_asked_for(tmp_path: Path, loss: str, horizon: int) -> None:
    run = trained(tmp_path, phase(dynamics_loss=loss, horizon=horizon),
                  DynamicsPhase(2, dynamics_loss=loss, horizon=horizon))  # type: ignore[arg-type]
    assert run.step == 4
    latents = torch.tensor([[0.0], [1.0], [3.0], [7.0], [7.5], [9.0]])

    class Exact:
        seen_dim = 1

        @staticmethod
        def step(latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            return latent + action

    found = objectives.dynamics_loss(Exact(), latents, one_window(), loss, horizon,  # type: ignore[arg-type]
                                     torch.tensor(4.0))[0]
    misses = torch.tensor([0.0, 1.0, 2.0])[:horizon]  # actions are 1, 1, 3; the truth moves by 1, 2, 4
    truths = latents[1 : 1 + horizon]
    if loss == "mse":
        assert found == pytest.approx(float((misses**2 / 4).mean()))
    else:
        guesses = truths - misses[:, None]
        shares = (-torch.cdist(guesses, latents)).log_softmax(1)
        assert found == pytest.approx(-float(shares[range(horizon), range(1, 1 + horizon)].mean()), abs=2e-3)


def one_window() -> object:
    """Five steps, unrolled from the first state."""
    class Window:
        valid = torch.ones(1, 5, dtype=torch.bool)
        actions = torch.tensor([[[1.0], [1.0], [3.0], [0.5], [1.5]]])
        unroll_at = torch.tensor([0])

    return Window()


def test_random_features_are_standard_and_stay(tmp_path: Path) -> None:
    store = FrameStore.from_arrays(
        frames=np.random.default_rng(0).integers(0, 255, (42, 64, 64, 3), dtype=np.uint8), actions=np.zeros((42, 2)),
        rewards=np.zeros(42), terminated=np.zeros(42), truncated=np.zeros(42), episode_length=[20, 20], action_low=[-1, -1],
        action_high=[1, 1])
    config = dataclasses.replace(tiny_training.SMALL, encoder="random-conv", latent_dim=8, frame_stack=1)
    encoder = objectives.RandomConvEncoder(config, (64, 64))
    frames = torch.from_numpy(store.frames)
    encoder.fit(frames, torch.from_numpy(store.last), 0)
    latents = encoder(frames.unsqueeze(1))
    assert latents.mean(0).abs().max() < 1e-3 and (latents.std(0) - 1).abs().max() < 1e-3
    assert not any(parameter.requires_grad for parameter in encoder.parameters())


# configs


@pytest.mark.parametrize("number", STUDIES)
@pytest.mark.parametrize("task", ablations.TASKS)
def test_variants_have_the_presets_updates_search_and_controller(number: str, task: str) -> None:
    preset = with_updates(make_config(task), 30, 40)
    assert abs(updates_of(preset)[0] - 30) <= 2
    configs = {each.name: each.change(preset) for each in STUDIES[number].variants}
    assert len({config.hash() for config in configs.values()}) == len(configs) >= 6
    for config in configs.values():
        assert updates_of(config) == updates_of(preset)
        assert (config.planner, config.controller) == (preset.planner, preset.controller)
        with known_phases():
            assert Config.from_json(config.to_json()) == config


def test_the_packages_own_commands_do_not_know_the_phases() -> None:
    before = dict(PHASES)
    with known_phases():
        assert PHASES["objective"] is ObjectivePhase
    assert before == PHASES and "objective" not in PHASES
    with pytest.raises(ConfigError, match="a phase of kind 'objective'"):
        Config.from_json(representation.VARIANTS[0].change(make_config("SpiralMaze")).to_json())


# unseen scenes


def test_a_probe_reads_what_latents_tell_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    states = rng.normal(size=(60, 2))
    latents = np.concatenate([states[:, :1] * 3 + 1, rng.normal(size=(60, 3))], 1)
    errors = unseen.probe(latents, states)
    assert np.abs(errors[:, 0]).max() < 0.05, "a linear function of the latents"
    assert 0.8 < np.square(errors[:, 1]).mean() / states[:, 1].var() < 1.5, "no better than the mean"


def test_intervals_are_those_of_a_mean() -> None:
    assert unseen.interval(np.array([1.0, 3.0])) == [2.0, pytest.approx(2 - 1.96, abs=1e-4), pytest.approx(3.96, abs=1e-4)]
    assert unseen.root([4.0, -1.0, 9.0]) == [2.0, 0.0, 3.0]


@pytest.mark.parametrize("task", ["ObstacleMaze", "WindowClose"])
def test_scenes_are_unseen_and_the_agent_anywhere(task: str) -> None:
    found = unseen.walks(task, True, count=5, length=3)
    assert found.store.n_episodes == 5 and found.states.shape[0] == len(found.store.frames)
    scene = slice(found.position, None) if task == "ObstacleMaze" else slice(-5, -1)
    starts = found.states[found.store.episode_start]
    assert len(np.unique(starts[:, scene], axis=0)) == 5, "a scene each"
    assert starts[:, : found.position].std(0)[:2].min() > 0.02, "not at the test start"
    if task == "ObstacleMaze":
        bars = [np.float32([*a.centre, *b.centre]) for a, b in
                (obstacle_layout(context).walls[-2:] for context in range(TRAIN_CONTEXTS))]
        assert not any((np.stack(bars) == start[2:]).all(1).any() for start in starts), "in no training context"


# cells


def tiny_study(root: Path) -> Plan:
    """Two encoders of SpiralMaze, true states and frames, with trainings of seconds."""
    def small(config: Config) -> Config:
        config = dataclasses.replace(
            config, model=dataclasses.replace(config.model, bank_size=10),
            train=TrainConfig(phases=(phase(objective="none", steps=2), LatentPhase(2, horizon=3), ValuePhase(1))),
            planner=dataclasses.replace(config.planner, n_iter=2, candidates=1))
        return config

    def with_encoder(name: str) -> Variant:
        def change(config: Config) -> Config:
            config = small(config)
            return dataclasses.replace(config, model=dataclasses.replace(config.model, encoder=name))

        return Variant(name=name, label=name, change=change, states=name == "exact-states")

    study = dataclasses.replace(representation.STUDY, root=root,
                                variants=(with_encoder("exact-states"), with_encoder("random-conv")))
    return Plan(study=study, tasks=("SpiralMaze",), seeds=(0,), episodes=2)


@pytest.fixture
def small_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few walks, short episodes, and thirty trajectories."""
    task = get_task("SpiralMaze")
    small = dataclasses.replace(task, max_steps=6, recipe=dataclasses.replace(task.recipe, trajectories=30))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(TASKS, "SpiralMaze", small)
    monkeypatch.setattr(gym.spec(task.env_id), "max_episode_steps", 6)

    def data(name: str, states: bool) -> FrameStore:
        env = without_drawing(small) if states else make_env(task.env_id)
        monkeypatch.setattr("studies.exact_latents.without_drawing", lambda task: env)
        return collect_states(small)

    monkeypatch.setattr(ablations, "training_data", data)
    monkeypatch.setattr(ablations, "walks", lambda name, states: unseen.walks(name, states, 6, 32))


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("small_world")
def test_cells_train_measure_play_and_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, console = tiny_study(Path("results/tiny")), Console(quiet=True)
    show(console, plan, Path("fig.png"))
    with known_phases():
        assert [cell.state for cell in plan.cells] == ["done", "done"]
        longer = dataclasses.replace(plan, episodes=3)
        assert longer.cells[0].state == "4 of 6 episodes"
    records = plan.cells[0].record_file("velap")
    assert [each.episode_seed for each in read_records(records)] == [1000, 1001]
    exact, frames = (json.loads(cell.measured.read_text()) for cell in plan.cells)
    assert exact["probe"][0] < 0.01 < frames["probe"][0], "the ruler knows the state"
    assert len(frames["rollout"]) == unseen.HORIZON and frames["moved"][0][0] == pytest.approx(1, abs=0.3)
    assert Path("fig.png").exists() and Path("fig.pdf").read_bytes().startswith(b"%PDF")

    before = records.read_bytes()
    monkeypatch.setattr(ablations, "train", None)  # a finished cell is not trained again
    show(console, plan, Path("fig.png"))
    show(console, longer, Path("fig.png"))
    assert records.read_bytes().startswith(before) and len(read_records(records)) == 3
    found = gather(plan.study.root, plan.study.variants)
    assert budget(found).endswith("- SpiralMaze: 2 updates on frames, 3 on frozen latents, training seeds 0, 3 episodes a "
                                  "method.")


@pytest.mark.usefixtures("small_world")
def test_results_of_another_config_are_not_mixed_in() -> None:
    plan = tiny_study(Path("results/tiny"))
    for cell in plan.cells:
        cell.measured.parent.mkdir(parents=True)
        cell.measured.write_text(json.dumps({"config_hash": "0123"}))
        assert cell.state == "outdated"
    with pytest.raises(ConfigError, match="2 cells below results/tiny were made with another config"):
        show(Console(quiet=True), plan, Path("fig.png"))


def test_bad_plans_say_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="got 0 episodes"):
        Plan(study=representation.STUDY, episodes=0)
    with pytest.raises(ConfigError, match=r"updates \(0, 3\)"):
        Plan(study=representation.STUDY, updates=(0, 3))
    empty = dataclasses.replace(representation.STUDY, root=tmp_path)
    with pytest.raises(ConfigError, match="found no measurements below"):
        show(Console(quiet=True), Plan(study=empty), tmp_path / "fig.png", no_run=True)


def test_a_dry_run_lists_the_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                   capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figure", "5", "SpiralMaze", "--seeds", "0", "--updates", "3", "4", "--dry-run"]) == 0
    lines = " ".join(capsys.readouterr().out.split())
    assert all(f"| {each.name} SpiralMaze seed 0 | missing |" in lines for each in representation.VARIANTS)
    assert list(tmp_path.iterdir()) == []


# the committed figures


SHIPPED = [number for number, study in STUDIES.items() if gather(ROOT / study.root, study.variants)]


@pytest.mark.parametrize("number", SHIPPED)
def test_the_pictures_are_made_of_the_committed_results(number: str, tmp_path: Path,
                                                        monkeypatch: pytest.MonkeyPatch) -> None:
    study = STUDIES[number]
    (tmp_path / "results").symlink_to(ROOT / "results")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figure", number, "--no-run", "--write", "small.png"]) == 0
    picture = imageio.imread(tmp_path / "small.png")[:, :, :3].astype(int)
    for colour in ((0, 114, 178), (230, 159, 0)):
        assert (np.abs(picture - colour).sum(-1) < 60).sum() > 100
    results = gather(ROOT / study.root, study.variants)
    page = (ROOT / f"docs/figures/fig{number}.md").read_text()
    assert f"{budget(results)}\n\n{study.table(results)}" in page, f"repeat `velap figure {number} --no-run`"
