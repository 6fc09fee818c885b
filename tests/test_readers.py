"""Readers: one dataset in every format gives one store, and each thing that formats do differently. Files are written
with the formats' own libraries where they are small; LeRobot's and robomimic's layouts are written with pyarrow, PyAV and
h5py."""

from __future__ import annotations

import io
import json
import warnings
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector.episode_buffer import EpisodeBuffer
from PIL import Image

from velap.data.frames import Episode, FrameStore
from velap.data.loading import load_store
from velap.data.writing import write_dataset
from velap.errors import DatasetError
from velap.registry import READERS, register_reader

LENGTHS = (6, 4, 9, 5)
WON = (1, 3)
FPS = 10


pytestmark = pytest.mark.filterwarnings("ignore:.*(its bounds are taken from|go on after their first success|are resized)")


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path / "lerobot"))
    return tmp_path


def smooth(count: int, shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Frames that a video codec keeps well: broad waves that move."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), indexing="ij")
    phase = rng.uniform(0, 6, 3) + np.arange(count)[:, None] / 4
    waves = np.sin(3 * y[None, ..., None] + 2 * x[None, ..., None] + phase[:, None, None])
    return (128 + 80 * waves).round().astype(np.uint8)


def recorded(shape: tuple[int, ...] = (64, 64, 3)) -> list[Episode]:
    """Episodes of LENGTHS transitions; WON ones end in success with reward 1."""
    rng, episodes = np.random.default_rng(0), []
    for number, steps in enumerate(LENGTHS):
        rewards = np.zeros(steps)
        rewards[-1] = number in WON
        actions = rng.uniform(-1, 1, (steps, 2)).astype(np.float32)
        episodes.append(Episode(smooth(steps + 1, shape, number), actions, rewards, rewards > 0))
    return episodes


def stored(episodes: list[Episode], **options: Any) -> FrameStore:
    return FrameStore.from_episodes(iter(episodes), action_low=-1, action_high=1, **options)


def same(store: FrameStore, expected: FrameStore) -> None:
    for name, array in expected.arrays().items():
        np.testing.assert_array_equal(store.arrays()[name], array, err_msg=name)
    assert store.content_hash == expected.content_hash


def padded(values: np.ndarray) -> np.ndarray:
    """[T, *] → [T + 1, *]: formats with as many actions as observations record one more, which leads nowhere."""
    return np.concatenate([values, np.zeros_like(values[:1])])


# writers of the formats


def write_minari(episodes: list[Episode], data_format: str, dataset_id: str = "lab/four-v0", **infos: Any) -> str:
    shape = np.asarray(episodes[0].images).shape[1:]
    buffers = []
    for episode in episodes:
        ends = np.arange(len(episode.actions)) == len(episode.actions) - 1
        told = {name: make(episode) for name, make in infos.items()}
        buffers.append(EpisodeBuffer(observations=episode.images, actions=episode.actions,
        rewards=np.asarray(episode.rewards),
                                     terminations=episode.terminated, truncations=ends & ~episode.terminated,
                                     infos=told or None))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(dataset_id, buffers, observation_space=gym.spaces.Box(0, 255, shape, np.uint8),
                                           action_space=gym.spaces.Box(-1, 1, (2,), np.float32), jpeg_encoding=False,
                                           data_format=data_format)
    return dataset_id


def write_robomimic(episodes: list[Episode], path: Path, next_obs: bool = True) -> str:
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {}})
        for number, episode in enumerate(episodes):
            demo = data.create_group(f"demo_{number}")
            last = slice(None, -1) if next_obs else slice(None)
            demo.attrs["num_samples"] = len(episode.images[last])
            demo["obs/agentview_image"] = episode.images[last]
            demo["obs/robot0_eef_pos"] = np.zeros((len(episode.images[last]), 3))
            if next_obs:
                demo["next_obs/agentview_image"] = episode.images[1:]
            demo["actions"] = episode.actions if next_obs else padded(episode.actions)
            rewards = np.asarray(episode.rewards) if next_obs else padded(np.asarray(episode.rewards))
            demo["rewards"], demo["dones"] = rewards, (rewards > 0).astype(int)
    return str(path)


def write_lerobot(episodes: list[Episode], root: Path, codec: str | None = None, episodes_a_file: int = 3,
                  cameras: tuple[str, ...] = ("observation.images.front",), state: list[np.ndarray] | None = None) -> str:
    """Format v3, as lerobot.datasets writes it; images as PNG columns, or as videos of that codec."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    height, width = episodes[0].images.shape[1:3]
    dtype = "image" if codec is None else "video"
    features: dict[str, Any] = {key: {"dtype": dtype, "shape": [height, width, 3], "names": ["height", "width", "channels"]}
                                for key in cameras}
    features |= {"action": {"dtype": "float32", "shape": [2], "names": None},
                 "next.reward": {"dtype": "float32", "shape": [1], "names": None},
                 "next.success": {"dtype": "bool", "shape": [1], "names": None}}
    if state is not None:
        features["observation.state"] = {"dtype": "float32", "shape": [state[0].shape[1]], "names": None}
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in ("episode_index", "frame_index", "index")}
    (root / "meta/info.json").write_text(json.dumps({
        "codebase_version": "v3.0", "robot_type": "so101", "fps": FPS, "total_episodes": len(episodes),
        "total_frames": sum(len(e.images) for e in episodes), "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"}))
    entries: list[dict[str, Any]] = []
    for file in range(-(-len(episodes) // episodes_a_file)):
        chosen = list(enumerate(episodes))[file * episodes_a_file : (file + 1) * episodes_a_file]
        columns: dict[str, list[Any]] = {name: [] for name in features if features[name]["dtype"] != "video"}
        start = 0
        for number, episode in chosen:
            count = len(episode.images)
            rewards = padded(np.asarray(episode.rewards))
            columns["action"] += padded(episode.actions).tolist()
            columns["next.reward"] += rewards.tolist()
            columns["next.success"] += (rewards > 0).tolist()
            if state is not None:
                columns["observation.state"] += state[number].tolist()
            columns["episode_index"] += [number] * count
            columns["frame_index"] += range(count)
            columns["index"] += range(count)
            for key in cameras:
                if codec is None:
                    columns[key] += [{"bytes": png(frame), "path": None} for frame in episode.images]
            entry = {"episode_index": number, "length": count, "data/chunk_index": 0, "data/file_index": file}
            for key in cameras if codec else ():
                entry |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": file,
                          f"videos/{key}/from_timestamp": start / FPS, f"videos/{key}/to_timestamp": (start + count) / FPS}
            start += count
            entries.append(entry)
        pq.write_table(pa.table(columns), root / f"data/chunk-000/file-{file:03d}.parquet")
        for key in cameras if codec else ():
            path = root / f"videos/{key}/chunk-000/file-{file:03d}.mp4"
            write_video(path, np.concatenate([episode.images for _, episode in chosen]), str(codec))
    pq.write_table(pa.Table.from_pylist(entries), root / "meta/episodes/chunk-000/file-000.parquet")
    return str(root)


def png(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG")
    return buffer.getvalue()


def write_video(path: Path, frames: np.ndarray, codec: str) -> None:
    av = pytest.importorskip("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        options = {"libsvtav1": {"crf": "10", "g": "2"}, "libx264": {"crf": "8", "g": "2"}}[codec]
        stream = container.add_stream(codec, rate=FPS, options=options)
        stream.height, stream.width, stream.pix_fmt, stream.time_base = *frames.shape[1:3], "yuv420p", Fraction(1, FPS)
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


# one dataset in every format


def test_every_lossless_format_gives_the_same_store(root: Path) -> None:
    pytest.importorskip("pyarrow")
    episodes = recorded()
    expected = stored(episodes)
    assert expected.rewards.sum() == len(WON)
    same(load_store(write_minari(episodes, "hdf5")), expected)
    same(load_store(write_minari(episodes, "arrow", "lab/arrow-v0")), expected)
    same(load_store(write_minari(episodes, "parquet", "lab/parquet-v0")), expected)
    same(load_store(write_robomimic(episodes, root / "demo.hdf5"), image_key="agentview_image"), expected)
    same(load_store(write_robomimic(episodes, root / "rows.hdf5", next_obs=False)), expected)
    with pytest.warns(UserWarning, match="bounds are taken from the data"):
        images = load_store(write_lerobot(episodes, root / "images"))
    np.testing.assert_array_equal(images.frames, expected.frames)
    np.testing.assert_array_equal(images.actions, expected.actions)
    np.testing.assert_array_equal(images.rewards, expected.rewards)
    np.testing.assert_array_equal(images.terminated, expected.terminated)
    np.testing.assert_array_equal(images.truncated, expected.truncated)
    rows = {"observations": np.concatenate([e.images for e in episodes]),
            "actions": np.concatenate([padded(e.actions) for e in episodes]),
            "rewards": np.concatenate([padded(np.asarray(e.rewards)) for e in episodes]),
            "terminals": np.concatenate([np.arange(len(e.images)) == len(e.images) - 1 for e in episodes])}
    np.savez(root / "visual-cube-v0.npz", **rows)
    same(load_store(root / "visual-cube-v0.npz"), expected)


@pytest.mark.parametrize("codec", ["libx264", "libsvtav1"])
def test_lerobot_videos_are_decoded_within_the_codecs_error(root: Path, codec: str) -> None:
    av = pytest.importorskip("av")
    if codec not in av.codecs_available:
        pytest.skip(f"PyAV here has no {codec}")
    episodes = recorded()
    expected = stored(episodes)
    store = load_store(write_lerobot(episodes, root / "video", codec))
    assert store.episode_length.tolist() == list(LENGTHS)
    error = np.abs(store.frames.astype(int) - expected.frames)
    assert error.mean() < 2.5
    moved = np.abs(store.frames[1:].astype(int) - expected.frames[:-1])
    assert moved.mean() > 2 * error.mean(), "the bound would notice frames that are one step late"
    np.testing.assert_array_equal(store.rewards, expected.rewards)


def test_a_generator_is_taken_once_and_one_episode_at_a_time() -> None:
    episodes, alive = recorded(), []

    def stream() -> Any:
        for number, episode in enumerate(episodes):
            alive.append(number)
            yield episode

    same(FrameStore.from_episodes(stream(), action_low=[-1, -1], action_high=[1, 1]), stored(episodes))
    assert alive == [0, 1, 2, 3]
    with pytest.raises(DatasetError, match="has no episode"):
        FrameStore.from_episodes([])


# what formats do differently


def test_success_is_named_by_the_user_and_kept(root: Path) -> None:
    episodes = [Episode(e.images, e.actions, np.arange(len(e.actions), dtype=float)) for e in recorded()]
    source = write_lerobot(episodes, root / "rows")
    assert load_store(source).reading.success == "info:success"  # of next.success
    store = load_store(source, success="info:next.reward>=4")
    assert store.reading.success == "info:next.reward>=4"
    assert np.flatnonzero(store.rewards).tolist() == [4, 15, 21]
    assert store.episode_length.tolist() == [5, 4, 5, 5]
    with pytest.raises(DatasetError, match=r"no info 'won'; expected one of .*next\.success"):
        load_store(source, success="info:won")
    with pytest.raises(DatasetError, match=r"no success by the rule reward>=100"):
        load_store(source, success="reward>=100")


def test_several_cameras_are_listed_and_one_is_chosen(root: Path) -> None:
    source = write_lerobot(recorded(), root / "two", cameras=("observation.images.front", "observation.images.wrist"))
    with pytest.raises(DatasetError, match=r"images\.front, observation\.images\.wrist.*--image-key"):
        load_store(source)
    assert load_store(source, image_key="observation.images.wrist").reading.image_key == "observation.images.wrist"


def test_float_cameras_count_and_depth_maps_do_not(root: Path) -> None:
    source = write_robomimic(recorded(), root / "depth.hdf5")
    with h5py.File(source, "r+") as file:
        for name in file["data"]:
            depth = np.random.default_rng(0).uniform(0, 3, file[f"data/{name}/obs/agentview_image"].shape[:3])
            file[f"data/{name}/obs/agentview_depth"] = depth.astype(np.float32)[..., None]
    same(load_store(source), stored(recorded()))
    with h5py.File(source, "r+") as file:
        for name in file["data"]:
            for group in ("obs", "next_obs"):
                images = file[f"data/{name}/{group}/agentview_image"][:]
                file[f"data/{name}/{group}/wrist_image"] = (images / 255).astype(np.float32)
    with pytest.raises(DatasetError, match=r"several images.*: agentview_image, wrist_image"):
        load_store(source)
    same(load_store(source, image_key="wrist_image"), stored(recorded()))


def test_what_the_last_row_says_counts_for_the_last_frame(root: Path) -> None:
    """LeRobot and robomimic store no frame behind the last action; a success there is not lost."""
    episodes = recorded()
    with h5py.File(write_robomimic(episodes, root / "late.hdf5", next_obs=False), "r+") as file:
        rewards = file["data/demo_1/rewards"]
        rewards[:] = np.arange(len(rewards)) == len(rewards) - 1
    store = load_store(root / "late.hdf5")
    assert np.flatnonzero(store.rewards).tolist() == np.flatnonzero(stored(episodes).rewards).tolist()


def test_a_lerobot_id_is_found_in_lerobots_cache(root: Path) -> None:
    write_lerobot(recorded(), root / "lerobot" / "me" / "pusht")
    assert load_store("me/pusht").dataset_id == "me/pusht"


def test_damaged_and_foreign_files_are_named(root: Path) -> None:
    source = Path(write_lerobot(recorded(), root / "broken"))
    table = source / "data/chunk-000/file-001.parquet"
    table.write_bytes(table.read_bytes()[:200])
    with pytest.raises(DatasetError, match=r"episode 3 cannot be read from .*file-001\.parquet"):
        load_store(source)
    info = json.loads((source / "meta/info.json").read_text())
    (source / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    with pytest.raises(DatasetError, match=r"format v2\.1; expected v3.*convert"):
        load_store(source)
    np.savez(root / "bare.npz", observations=np.zeros((3, 64, 64, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"expected .*Add actions, terminals"):
        load_store(root / "bare.npz")
    (root / "notes.txt").write_text("not a dataset")
    with pytest.raises(DatasetError, match=r"no reader takes .*lerobot, minari, ogbench, robomimic"):
        load_store(root / "notes.txt")
    with pytest.raises(DatasetError, match="no Minari dataset"):
        load_store("lab/none-v0")


def test_transitions_with_next_observations(root: Path) -> None:
    episodes = recorded()
    np.savez(root / "pairs.npz", observations=np.concatenate([e.images[:-1] for e in episodes]),
             next_observations=np.concatenate([e.images[1:] for e in episodes]),
             actions=np.concatenate([e.actions for e in episodes]), rewards=np.concatenate([e.rewards for e in episodes]),
             terminals=np.concatenate([np.arange(len(e.actions)) == len(e.actions) - 1 for e in episodes]).astype(float))
    same(load_store(root / "pairs.npz"), stored(episodes))


@pytest.mark.parametrize(("shape", "fit", "mark", "black"), [
    ((48, 64, 3), "pad", (12 + 8, 16), 16 * 64), ((64, 40, 3), "pad", (16, 10 + 12), 24 * 64),
    ((48, 64, 3), "crop", (12, 16 - 8), 0), ((64, 40, 3), "crop", (16 - 12, 10), 0), ((32, 64, 3), "squash", (8, 8), 0),
])
def test_oblong_frames_become_square_as_asked(shape: tuple[int, ...], fit: Any, mark: tuple[int, int], black: int) -> None:
    episodes = [Episode(np.full((len(e.images), *shape), 200, np.uint8), e.actions, e.rewards) for e in recorded()]
    for episode in episodes:  # a mark in the upper left quarter
        episode.images[:, shape[0] // 4, shape[1] // 4] = 7
    with pytest.raises(DatasetError, match="--fit crop"):
        stored(episodes)
    store = stored(episodes, fit=fit, image_size=None)
    side = max(shape[:2]) if fit == "pad" else min(shape[:2])
    assert store.frames.shape[1:] == (side, side, 3)
    assert (store.frames == 0).all(-1).sum(axis=(1, 2)).tolist() == [black] * len(store.frames)
    darker = np.argwhere((store.frames[0, ..., 0] > 0) & (store.frames[0, ..., 0] < 200))
    assert darker.tolist() == [list(mark)]
    assert (store.reading.fit, store.reading.image_size) == (fit, side)


def test_other_sizes_are_kept() -> None:
    episodes = recorded((96, 96, 3))
    with pytest.warns(UserWarning, match="96×96 are resized to 64×64"):
        assert stored(episodes).frames.shape[1:] == (64, 64, 3)
    store = stored(episodes, image_size=96)
    np.testing.assert_array_equal(store.frames, np.concatenate([e.images for e in episodes]))
    assert store.reading.image_size == 96


def test_a_reader_of_another_package_is_used(root: Path) -> None:
    class Folder:
        """One `.npy` file an episode."""

        observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        content_sha256 = None

        def __init__(self, source: str) -> None:
            self.name, self.place, self.frames = source, Path(source) / ".frames", 0

        @classmethod
        def accepts(cls, source: str) -> bool:
            return (Path(source) / "mine.txt").exists()

        def state(self) -> str:
            return "1"

        def episodes(self, layout: Any) -> Any:
            return iter(recorded())

    register_reader("folder of mine")(Folder)
    try:
        (root / "mine").mkdir()
        (root / "mine" / "mine.txt").touch()
        same(load_store(root / "mine"), stored(recorded()))
    finally:
        del READERS._entries["folder of mine"]


# frames mapped from disk


def test_mapped_frames_are_the_frames_and_are_made_once(root: Path) -> None:
    source = write_robomimic(recorded(), root / "demo.hdf5")
    expected = load_store(source)
    store = load_store(source, mapped=True)
    same(store, expected)
    assert isinstance(store.frames, np.memmap) and store.reading == expected.reading
    made = (root / ".demo.hdf5.frames" / "frames.bin").stat()
    same(load_store(source, mapped=True), expected)
    assert (root / ".demo.hdf5.frames" / "frames.bin").stat().st_mtime_ns == made.st_mtime_ns
    load_store(source, mapped=True, success="reward>=0.5")
    assert (root / ".demo.hdf5.frames" / "frames.bin").stat().st_mtime_ns != made.st_mtime_ns
    with h5py.File(source, "r+") as file:
        file["data/demo_0/actions"][0] = 0.125
    assert load_store(source, mapped=True).actions[0].tolist() == [0.125, 0.125]


def test_mapped_frames_end_at_the_first_success(root: Path) -> None:
    episodes = [Episode(e.images, e.actions, (np.arange(len(e.actions)) >= 2).astype(float)) for e in recorded()]
    source = write_robomimic(episodes, root / "long.hdf5")
    same(load_store(source, mapped=True), load_store(source))
    assert (root / ".long.hdf5.frames" / "frames.bin").stat().st_size == 4 * len(LENGTHS) * 64 * 64 * 3


@pytest.mark.parametrize("name", ["frames.bin", "rows.npz"])
def test_damage_to_mapped_frames_is_noticed(root: Path, name: str) -> None:
    source = write_robomimic(recorded(), root / "demo.hdf5")
    load_store(source, mapped=True)
    path = root / ".demo.hdf5.frames" / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"mapped frames .* have SHA-256 .*Delete the folder"):
        load_store(source, mapped=True)


def test_a_full_disk_leaves_no_mapped_frames(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from velap.data import mapped
    from velap.errors import StorageError

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    source = write_robomimic(recorded(), root / "demo.hdf5")
    monkeypatch.setattr(mapped.np, "savez", full)
    with pytest.raises(StorageError, match="Free some space"):
        load_store(source, mapped=True)
    assert sorted(path.name for path in root.iterdir() if path.name.startswith(".demo")) == []


def test_our_own_datasets_can_be_mapped(root: Path) -> None:
    store = stored(recorded(), dataset_id="velap/Own-v0")
    write_dataset(store)
    same(load_store("velap/Own-v0", mapped=True), store)
    assert set(minari.list_local_datasets()) == {"velap/Own-v0"}
