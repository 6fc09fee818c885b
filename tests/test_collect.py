"""Collection: the same arrays whatever the workers, kills that cost little, errors with a way out, and the card."""

import dataclasses
import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
import pytest
from PIL import Image

from velap import threads
from velap.data import behaviours, minari_io
from velap.data import card as cards
from velap.data import collection as collect
from velap.data.frames import FrameStore
from velap.data.loading import load_store
from velap.data.minari_io import load_positions
from velap.data.worker import Shard, Workers
from velap.errors import DatasetError, RenderError, StorageError, UnknownTaskError
from velap.tasks import Recipe, Task

ENVIRONMENT = '''
import os, time
import gymnasium as gym, numpy as np
from velap.errors import RenderError

class Line(gym.Env):
    """A dot in the unit square; it succeeds on the right. Frames show it as a bright cell of an 8 by 8 grid."""
    observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self):
        self.place = np.zeros(2)
        self.context = 0

    def agent_position(self):
        return self.place.copy()

    def _frame(self):
        frame = np.full((64, 64, 3), 30 + self.context, np.uint8)
        if os.environ.get("LINE_FAULT") == "other pixels":
            frame[0, 0, 0] = os.getpid() % 251
        column, row = (self.place * 7.99).astype(int)
        frame[8 * row : 8 * row + 8, 8 * column : 8 * column + 8] = 250
        return frame

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.context = options.get("context", 0)
        self.place = self.np_random.uniform(0, 1, 2) if options["split"] == "train" else np.array([0.05, 0.5])
        return self._frame(), {"success": False}

    def step(self, action):
        time.sleep(float(os.environ.get("LINE_DELAY", 0)))
        if os.environ.get("LINE_FAULT") == "render":
            raise RenderError("the driver is missing; expected EGL. Install libegl1.")
        if os.environ.get("LINE_FAULT") == "die":
            os._exit(9)
        if os.environ.get("LINE_FAULT") == "crash":
            raise ZeroDivisionError("a bug of the environment")
        self.place = np.clip(self.place + 0.05 * np.asarray(action), 0, 1)
        success = bool(self.place[0] > 0.95)
        return self._frame(), float(success), success, False, {"success": success}

gym.register("velap_test/Line-v0", entry_point="velap_line_env:Line", max_episode_steps=50)
'''
TASK = Task("Line", "velap_line_env:velap_test/Line-v0", 50, Recipe(1, 24, 6, 1.0))
SCRIPT = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # what tests in the background start ignores it
from velap.data import collection as collect
from velap.tasks import Recipe, Task
collect.SHARD_TRAJECTORIES = 4
task = Task("Line", "velap_line_env:velap_test/Line-v0", 50, Recipe(1, 24, 6, 1.0))
collect.collect(task, seed=3, workers=2)
"""


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "velap_line_env.py").write_text(ENVIRONMENT)
    monkeypatch.syspath_prepend(str(modules))
    monkeypatch.setattr(collect, "SHARD_TRAJECTORIES", 4)
    return tmp_path / "datasets"


def a_store(result: collect.CollectResult) -> FrameStore:
    return load_store(result.dataset_id)


def test_the_number_of_workers_and_the_size_of_shards_do_not_matter(monkeypatch: pytest.MonkeyPatch):
    one = collect.collect(TASK, seed=3, workers=1, dataset_id="velap/One-v0")
    monkeypatch.setattr(collect, "SHARD_TRAJECTORIES", 5)
    three = collect.collect(TASK, seed=3, workers=3, dataset_id="velap/Three-v0")
    other = collect.collect(TASK, seed=4, workers=2, dataset_id="velap/Other-v0")
    assert one.content_hash == three.content_hash != other.content_hash
    assert a_store(three).content_hash == one.content_hash
    assert (one.episodes, one.resumed) == (24, 0)


def test_what_is_collected(root: Path):
    seen: list[tuple[int, int]] = []
    result = collect.collect(TASK, seed=3, workers=2, progress=lambda done, total: seen.append((done, total)))
    assert [done for done, _ in seen] == [0, 4, 8, 12, 16, 20, 24]
    store, positions = a_store(result), load_positions(result.dataset_id)
    assert store.n_episodes == 24
    assert store.episode_length.max() == 6
    assert result.transitions == store.n_transitions
    won = positions[store.episode_start + store.episode_length, 0] > 0.95
    assert result.successes == won.sum() > 0
    steps = np.ones(len(store.frames), bool)
    steps[store.episode_start + store.episode_length] = False
    moved = np.clip(positions[:-1] + 0.05 * store.actions[:-1], 0, 1)
    np.testing.assert_allclose(moved[steps[:-1]], positions[1:][steps[:-1]], atol=1e-6)
    ends = store.episode_start + store.episode_length - 1
    np.testing.assert_array_equal(store.terminated[ends], won)
    np.testing.assert_array_equal(store.truncated[ends], ~won)
    assert sorted(entry.name for entry in (root / "velap").iterdir()) == ["Line-v0", "namespace_metadata.json"]
    dataset = minari.load_dataset(result.dataset_id)
    assert dataset.env_spec.id == "velap_test/Line-v0"
    metadata = next(iter(dataset.storage.get_episode_metadata([0])))
    assert (metadata["options"], metadata["behaviour"]) == ({"split": "train", "context": 0}, "random-walk")


def test_contexts_are_passed_on_and_counted():
    task = dataclasses.replace(TASK, recipe=Recipe(3, 5, 2, 1.0))
    store = a_store(collect.collect(task, workers=2))
    assert store.n_episodes == 15
    corner = store.frames[store.episode_start].reshape(15, -1).min(axis=1)
    assert corner.tolist() == [30] * 5 + [31] * 5 + [32] * 5


def test_random_walk_is_the_papers():
    env = gym.Env()
    env.action_space = gym.spaces.Box(np.array([-1, 0], np.float32), np.array([1, 4], np.float32))
    rng = np.random.default_rng(0)
    walks = []
    for _ in range(2000):
        act = behaviours.random_walk(env, Recipe(1, 1, 1, 0.1, action_noise=0.2), rng)
        walks.append([act(np.zeros(0)) for _ in range(3)])
    actions = np.asarray(walks) * [1, 0.5] - [0, 1]
    assert actions.min() >= -1
    assert actions.max() <= 1
    np.testing.assert_allclose(actions[:, 0].mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(actions[:, 0].var(axis=0), 1 / 3, atol=0.03)
    inner = np.abs(actions[:, 0]) < 0.3
    np.testing.assert_allclose((actions[:, 1] - actions[:, 0])[inner].std(), 0.2, atol=0.01)


def test_behaviours_are_mixed_in_their_shares(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(behaviours.BEHAVIOURS, "still", lambda env, recipe, rng: lambda frame: np.zeros(2, np.float32))
    import velap_line_env

    env = velap_line_env.Line()
    shares = dataclasses.replace(TASK, behaviours={"random-walk": 3.0, "still": 1.0}).shares
    assert shares == {"random-walk": 0.75, "still": 0.25}
    runs = [behaviours.run_trajectory(env, TASK.recipe, shares, 0, 0, number) for number in range(400)]
    still = np.array([run["behaviour"][0] == 1 for run in runs])
    assert 0.18 < still.mean() < 0.32
    assert all((run["actions"] == 0).all() == flag for run, flag in zip(runs, still, strict=True))


# interruptions


def start(root: Path, delay: float) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "LINE_DELAY": str(delay), "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen([sys.executable, "-c", SCRIPT], env=environment, stderr=subprocess.PIPE, start_new_session=True)


def wait_for(found, seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not found():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.01)


def test_kill_and_resume_gives_the_same_bits(root: Path):
    expected = collect.collect(TASK, seed=3, workers=2, dataset_id="velap/Whole-v0").content_hash
    partial = root / "velap" / ".Line-v0.partial"
    for shards in (1, 3):
        process = start(root, delay=0.02)
        wait_for(lambda: len(list((partial / "shards").glob("0*.npz"))) >= shards)  # noqa: B023
        process.kill()
        process.communicate()
        assert not (root / "velap" / "Line-v0").exists()
        assert set(minari.list_local_datasets()) == {"velap/Whole-v0"}
    damaged = sorted((partial / "shards").glob("0*.npz"))[0]
    damaged.write_bytes(damaged.read_bytes()[:500])
    result = collect.collect(TASK, seed=3, workers=1)
    assert result.content_hash == expected
    assert 8 <= result.resumed < 24
    assert result.notes == ()
    assert not partial.exists()


def test_workers_end_with_a_killed_parent(root: Path):
    process = start(root, delay=0.02)
    wait_for(lambda: list((root / "velap" / ".Line-v0.partial" / "shards").glob("0*.npz")))
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(children) >= 2  # two workers, and what keeps count of their resources
    process.kill()
    process.communicate()
    wait_for(lambda: not any(Path(f"/proc/{child}/cmdline").exists() and Path(f"/proc/{child}/cmdline").read_bytes()
                             for child in children))


def test_ctrl_c_is_clean(root: Path):
    process = start(root, delay=0.05)
    wait_for(lambda: list((root / "velap" / ".Line-v0.partial" / "shards").glob("0*.npz")))
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: parent and workers alike
    _, errors = process.communicate(timeout=90)
    assert process.returncode != 0
    assert errors.decode().strip().endswith("KeyboardInterrupt")
    assert not (root / "velap" / "Line-v0").exists()
    assert collect.collect(TASK, seed=3, workers=1).resumed >= 4


def test_shards_of_another_seed_are_not_mixed_in(root: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupt(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(collect, "_build", interrupt)
    with pytest.raises(KeyboardInterrupt):
        collect.collect(TASK, seed=3, workers=1)
    monkeypatch.undo()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    monkeypatch.syspath_prepend(str(root.parent / "modules"))
    result = collect.collect(TASK, seed=4, workers=1)
    assert result.resumed == 0
    assert "another seed" in result.notes[0]


# errors


def test_an_existing_dataset_is_replaced_only_on_request():
    first = collect.collect(TASK, seed=3, workers=1)
    with pytest.raises(DatasetError, match="--overwrite"):
        collect.collect(TASK, seed=4, workers=1)
    assert a_store(first).content_hash == first.content_hash
    second = collect.collect(TASK, seed=4, workers=1, overwrite=True)
    assert a_store(second).content_hash == second.content_hash != first.content_hash


def test_shards_left_beside_a_finished_dataset_are_deleted(root: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        patch.setattr(collect.shutil, "rmtree", lambda *args, **kwargs: None)
        result = collect.collect(TASK, seed=3, workers=1)
    partial = root / "velap" / ".Line-v0.partial"
    assert list((partial / "shards").iterdir())
    with pytest.raises(DatasetError, match="exists already"):
        collect.collect(TASK, seed=3, workers=1)
    assert not partial.exists()
    assert a_store(result).content_hash == result.content_hash


def test_unknown_task():
    with pytest.raises(UnknownTaskError, match="expected one of"):
        collect.collect("SpiralMase")


def test_two_collections_at_once_are_refused(root: Path):
    with minari_io.exclusive(root / "velap" / ".Line-v0.partial", "velap/Line-v0"), \
            pytest.raises(StorageError, match="another process is writing"):
        collect.collect(TASK, workers=1)


@pytest.mark.parametrize(("fault", "kind", "match"), [
    ("render", RenderError, "Install libegl1"), ("crash", DatasetError, "ZeroDivisionError: a bug of the environment"),
    ("die", DatasetError, "ended by itself.*--workers 1 if memory was short"),
])
def test_faults_of_the_environment_arrive(root: Path, monkeypatch: pytest.MonkeyPatch, fault: str, kind: type, match: str):
    monkeypatch.setenv("LINE_FAULT", fault)
    with pytest.raises(kind, match=match) as error:
        collect.collect(TASK, workers=2)
    assert "\n" not in str(error.value)
    assert not (root / "velap" / "Line-v0").exists()


def test_a_full_disk_keeps_what_is_finished(root: Path):
    for limit in (2_000, 30_000):  # [bytes] a file: too few for a shard; enough for the shards, not for the dataset
        code = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n" + SCRIPT
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False,
                             env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
        assert run.returncode == 1
        assert run.stderr.strip().splitlines()[-1].startswith("velap.errors.StorageError: could not write")
        assert not (root / "velap" / "Line-v0").exists()
    assert collect.collect(TASK, seed=3, workers=1).resumed == 24


def test_what_killed_workers_were_writing_is_deleted(root: Path, monkeypatch: pytest.MonkeyPatch):
    shards, all_of_them = root / "velap" / ".Line-v0.partial" / "shards", Workers.collect

    def one_fails(self: Workers, pending: list[Shard], fingerprint: str) -> Iterator[int]:
        yield from all_of_them(self, pending[:1], fingerprint)
        (shards / ".00000-000004.npz.tmp").write_bytes(b"half a shard")
        raise OSError(errno.EFBIG, "File too large")

    monkeypatch.setattr(Workers, "collect", one_fails)
    with pytest.raises(StorageError, match="File too large"):
        collect.collect(TASK, seed=3, workers=2)
    assert [path.name for path in shards.iterdir()] == ["00000-000000.npz"]


def test_a_machine_that_does_not_tell_its_cores_collects(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    assert threads.usable_cores() == os.cpu_count()
    assert collect.collect(dataclasses.replace(TASK, recipe=Recipe(1, 4, 2, 1.0))).episodes == 4


def test_processes_that_see_other_pixels_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("LINE_FAULT", "other pixels")
    with pytest.raises(DatasetError, match=r"different frames.*--workers 1"):
        collect.collect(TASK, workers=2)


# the card


def test_the_card_and_its_pictures_show_what_is_in_the_dataset():
    result = collect.collect(TASK, seed=3, workers=2)
    store = a_store(result)
    share = 100 * result.successes / result.transitions
    assert result.success_percent == pytest.approx(share)
    assert f"- successful transitions: {result.successes} ({share:.2f} %), the paper's is 1.00 % (Table 10)" in result.card
    assert f"- SHA-256 of the arrays: {store.content_hash}" in result.card
    assert "- made by: `velap collect Line --seed 3`" in result.card
    for line in ("contexts | 1 | 1", "trajectories a context | 24 | 24", "longest trajectory [steps] | 6 | 6",
                 f"successful transitions [%] | {share:.2f} | 1.00"):
        assert f"| {line} |" in result.card
    assert "- episodes: 24 of " in result.card
    assert f"- random-walk: 24 trajectories, {result.successes} of them successful" in result.card
    assert "where test episodes start" not in result.card
    told = cards.dataset_card(store, provenance={"from_test": 2})
    assert "- trajectories from where test episodes start to success: 2" in told
    assert (result.path / "card.md").read_text().startswith(result.card)
    bars = [line for line in result.card.splitlines() if "│" in line]
    assert [int(line.split()[-1]) for line in bars] == [*np.bincount(store.episode_length, minlength=7)[1:],
                                                       24 - result.successes, result.successes]
    sheet = np.asarray(Image.open(result.path / "frames.png").convert("RGB"))
    assert sheet.shape == (cards.SHEET_ROWS * 132 + 4, cards.SHEET_COLUMNS * 132 + 4, 3)
    np.testing.assert_array_equal(sheet[4:132:2, 4:132:2], _first_frame_of_a_success(store))
    assert (sheet == [255, 0, 0]).all(axis=-1).any()
    coverage = np.asarray(Image.open(result.path / "coverage.png").convert("RGB"))
    assert min(coverage.shape[:2]) >= 500
    assert len(np.unique(coverage.reshape(-1, 3), axis=0)) > 50


def test_coverage_in_space_is_shown_from_above_and_from_the_front(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    from matplotlib.axes import Axes

    drawn, scatter = [], Axes.scatter
    monkeypatch.setattr(Axes, "scatter", lambda self, x, y, **style: drawn.append((style["label"], np.stack([x, y], -1)))
                        or scatter(self, x, y, **style))
    store = a_store(collect.collect(TASK, seed=3, workers=1))
    drawn.clear()
    positions = np.random.default_rng(0).normal(size=(len(store.frames), 3))
    cards.draw_coverage(store, positions, tmp_path / "coverage.png", {"test_starts": [[1.0, 2.0, 3.0]]})
    ends = positions[store.episode_start + store.episode_length]
    won = ends[cards.episode_returns(store) > 0]
    expected = [("visited", positions), ("starts", positions[store.episode_start]),
                ("test starts", np.array([[1.0, 2.0, 3.0]])), ("successes", won)]
    assert len(drawn) == 8 and len(won) > 0
    for (label, points), (name, places), plane in zip(drawn, expected * 2, [[0, 1]] * 4 + [[0, 2]] * 4, strict=True):
        assert label == f"{name} ({len(places):,})"
        np.testing.assert_array_equal(points, places[:, plane])


def _first_frame_of_a_success(store: FrameStore) -> np.ndarray:
    return store.frames[store.episode_start[np.flatnonzero(cards.episode_returns(store))[0]]]


def test_the_card_of_a_strangers_dataset_needs_nothing_but_the_store(tmp_path: Path):
    store = a_store(collect.collect(TASK, seed=3, workers=1))
    paths = cards.save_card(store, tmp_path / "card")
    assert [path.name for path in paths] == ["card.md", "frames.png"]
    assert "Table 10" not in paths[0].read_text()
