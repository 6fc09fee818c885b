"""Frame store: stacking, exact round trips, datasets of strangers, and one paragraph for each thing that can be wrong."""

import json
import shutil
import warnings
from pathlib import Path

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
import torch
from minari.data_collector.episode_buffer import EpisodeBuffer

from velap.data import minari_io
from velap.data.frames import FrameStore, content_hash, stack_indices
from velap.data.loading import load_store
from velap.data.minari_io import load_positions
from velap.data.writing import Extras, write_dataset
from velap.errors import DatasetError, StorageError

ACTIONS = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
RGB = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
LENGTHS = (5, 3, 7)


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


def smooth_frames(count: int, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Images that JPEG keeps well: a grey level a frame, plus a ramp along the last image axis but one."""
    levels = np.random.default_rng(seed).integers(40, 200, count)
    ramp = np.linspace(0, 40, shape[-2]).reshape(-1, 1)
    return (levels.reshape(-1, *[1] * len(shape)) + ramp).clip(0, 255).astype(np.uint8) * np.ones(shape, np.uint8)


def a_store(dataset_id: str = "velap/Toy-v0", seed: int = 0) -> FrameStore:
    """Three episodes of 5, 3 and 7 transitions; the second one succeeds."""
    rng = np.random.default_rng(seed)
    rows = sum(LENGTHS) + len(LENGTHS)
    last = np.cumsum(np.array(LENGTHS) + 1) - 1
    actions = rng.uniform(-1, 1, (rows, 2)).astype(np.float32)
    actions[last] = 0
    rewards, terminated, truncated = np.zeros(rows, np.float32), np.zeros(rows, bool), np.zeros(rows, bool)
    truncated[last - 1] = True
    rewards[last[1] - 1], terminated[last[1] - 1], truncated[last[1] - 1] = 1, True, False
    frames = rng.integers(0, 256, (rows, 64, 64, 3), dtype=np.uint8)
    return FrameStore.from_arrays(frames=frames, actions=actions, rewards=rewards, terminated=terminated,
    truncated=truncated,
                                  episode_length=LENGTHS, action_low=[-1, -1], action_high=[1, 1], dataset_id=dataset_id)


def stranger(observations, space: gym.Space = RGB, *, rewards=None, actions=None, terminations=None, truncations=None,
             action_space: gym.Space = ACTIONS, dataset_id: str = "lab/pile-v0", jpeg: bool = False,
             data_format: str = "hdf5") -> str:
    """A Minari dataset of one or more episodes, written by Minari itself. `observations` is a list, one item an episode."""
    buffers = []
    for number, episode in enumerate(observations):
        frames = episode
        while isinstance(frames, dict):
            frames = next(iter(frames.values()))
        steps = len(frames) - 1
        ends = np.arange(steps) == steps - 1
        won = number == 0
        buffers.append(EpisodeBuffer(
            observations=episode,
            actions=np.full((steps, 2), 0.5, np.float32) if actions is None else actions[number],
            rewards=(ends & won).astype(np.float64) if rewards is None else rewards[number],
            terminations=ends & won if terminations is None else terminations[number],
            truncations=ends & (not won) if truncations is None else truncations[number],
        ))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(dataset_id, buffers, observation_space=space, action_space=action_space,
                                           jpeg_encoding=jpeg, data_format=data_format)
    return dataset_id


def two_episodes(shape: tuple[int, ...] = (64, 64, 3)) -> list[np.ndarray]:
    return [smooth_frames(5, shape, 1), smooth_frames(4, shape, 2)]


def noise(shape: tuple[int, ...]) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (count, *shape), dtype=np.uint8) for count in (5, 4)]


def assert_paragraph(error: pytest.ExceptionInfo[BaseException]) -> None:
    """Got, expected and a way out in one paragraph."""
    text = str(error.value)
    assert "\n" not in text
    assert "xpected" in text
    assert text.endswith(".")


# stacking


def test_stack_indices_repeats_the_first_frame_of_the_episode():
    index, first = np.array([4, 5, 6, 9]), np.array([4, 4, 4, 4])
    expected = [[4, 4, 4], [4, 4, 5], [4, 5, 6], [7, 8, 9]]
    assert stack_indices(index, first, 3).tolist() == expected
    assert stack_indices(torch.tensor(index), torch.tensor(first), 3).tolist() == expected
    assert stack_indices(torch.tensor(index), torch.tensor(first), 3).dtype == torch.int64


def test_stack_indices_keeps_any_prefix():
    index = np.arange(12).reshape(3, 4)
    assert stack_indices(index, np.zeros_like(index), 2).shape == (3, 4, 2)
    assert stack_indices(np.array(3), np.array(2), 3).tolist() == [2, 2, 3]
    assert stack_indices(torch.arange(12).reshape(3, 4), torch.zeros(3, 4, dtype=torch.int64), 1).shape == (3, 4, 1)


# our own datasets


def test_rows_know_their_episode():
    store = a_store()
    assert store.episode_start.tolist() == [0, 6, 10]
    assert store.first.tolist() == [0] * 6 + [6] * 4 + [10] * 8
    assert store.last.tolist() == [5] * 6 + [9] * 4 + [17] * 8
    assert store.episode_of.tolist() == [0] * 6 + [1] * 4 + [2] * 8
    assert (store.n_transitions, store.n_episodes) == (15, 3)


def test_round_trip_is_exact(root: Path):
    store = a_store()
    positions = np.random.default_rng(1).normal(size=(18, 2)).astype(np.float32)
    path = write_dataset(store, Extras(positions=positions, seeds=[7, 8, 9], options=[{"split": "train"}] * 3))
    loaded = load_store(store.dataset_id)
    for name, array in store.arrays().items():
        assert loaded.arrays()[name].dtype == array.dtype, name
        np.testing.assert_array_equal(loaded.arrays()[name], array, err_msg=name)
    assert loaded.content_hash == store.content_hash == content_hash(store)
    np.testing.assert_array_equal(load_positions(store.dataset_id), positions)
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["Toy-v0", "namespace_metadata.json"]


def test_minari_lists_and_iterates_our_dataset():
    store = a_store()
    write_dataset(store, Extras(seeds=[7, 8, 9], metadata={"description": "toy", "author": {"velap"}}))
    assert minari.list_local_datasets()[store.dataset_id]["total_steps"] == 15
    dataset = minari.load_dataset(store.dataset_id)
    episodes = list(dataset)
    assert [len(episode) for episode in episodes] == list(LENGTHS)
    np.testing.assert_array_equal(episodes[1].observations, store.frames[6:10])
    np.testing.assert_array_equal(episodes[2].actions, store.actions[10:17])
    assert episodes[1].terminations.tolist() == [False, False, True]
    assert [meta["seed"] for meta in dataset.storage.get_episode_metadata([0, 1, 2])] == [7, 8, 9]
    assert dataset[0].rewards.sum() + dataset[1].rewards.sum() == 1


def test_the_hash_depends_on_every_array():
    store = a_store()
    hashes = {store.content_hash}
    for name, array in store.arrays().items():
        changed = array.copy()
        changed.reshape(-1).view(np.uint8)[0] ^= 1
        hashes.add(content_hash(FrameStore(**{**store.__dict__, name: changed})))
    assert len(hashes) == 1 + len(store.arrays())


def test_an_existing_dataset_is_replaced_only_on_request():
    write_dataset(a_store())
    with pytest.raises(DatasetError, match="--overwrite") as error:
        write_dataset(a_store(seed=1))
    assert_paragraph(error)
    assert load_store("velap/Toy-v0").content_hash == a_store().content_hash
    write_dataset(a_store(seed=1), overwrite=True)
    assert load_store("velap/Toy-v0").content_hash == a_store(seed=1).content_hash


def test_a_replacement_cut_between_its_renames_gives_the_old_dataset_back():
    path = write_dataset(a_store())
    path.rename(path.parent / f".{path.name}.old")
    assert load_store("velap/Toy-v0").content_hash == a_store().content_hash


def test_a_full_disk_leaves_nothing(root: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(StorageError, match="Free some space") as error:
        write_dataset(a_store())
    assert_paragraph(error)
    assert not minari_io.exists("velap/Toy-v0")
    assert not list(root.rglob("*.hdf5"))


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.7, 0.99])
def test_a_truncated_file_is_damaged(fraction: float):
    path = write_dataset(a_store()) / "data" / "main_data.hdf5"
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(DatasetError, match="damaged") as error:
        load_store("velap/Toy-v0")
    assert_paragraph(error)


@pytest.mark.parametrize("place", [0.0001, 0.02, 0.5, 0.9, 0.9999])
def test_a_flipped_bit_is_damage(place: float):
    path = write_dataset(a_store()) / "data" / "main_data.hdf5"
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 4
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="damaged"):
        load_store("velap/Toy-v0")


def test_arrays_are_checked_against_their_own_hash():
    path = write_dataset(a_store()) / "data"
    with h5py.File(path / "main_data.hdf5", "r+") as file:
        file["episode_2/actions"][3, 0] = 0.25
    metadata = json.loads((path / "metadata.json").read_text())
    metadata["velap"]["file_sha256"] = minari_io.file_sha256(path / "main_data.hdf5")
    (path / "metadata.json").write_text(json.dumps(metadata))
    with pytest.raises(DatasetError, match="its arrays have SHA-256"):
        load_store("velap/Toy-v0")


def test_what_is_kept_beside_the_arrays_is_checked_too():
    path = write_dataset(a_store(), Extras(positions=np.zeros((18, 2), np.float32))) / "data" / "main_data.hdf5"
    with h5py.File(path, "r+") as file:
        file["episode_2/infos/agent_position"][3, 0] = 0.25
    for read in (load_positions, load_store):
        with pytest.raises(DatasetError, match="damaged"):
            read("velap/Toy-v0")


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"velap": 3}', '{"total_episodes": 1}'])
def test_damaged_metadata(text: str):
    path = write_dataset(a_store()) / "data" / "metadata.json"
    path.write_text(text)
    with pytest.raises(DatasetError, match="damaged") as error:
        load_store("velap/Toy-v0")
    assert_paragraph(error)


@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.95])
def test_a_strangers_truncated_file_is_an_error_too(root: Path, fraction: float):
    path = root / stranger(two_episodes()) / "data" / "main_data.hdf5"
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(DatasetError, match="damaged"):
        load_store("lab/pile-v0")


# datasets of strangers


def test_plain_rgb_frames():
    observations = two_episodes()
    store = load_store(stranger(observations))
    np.testing.assert_array_equal(store.frames, np.concatenate(observations))
    assert store.rewards.tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert store.terminated.tolist() == [False, False, False, True, False, False, False, False, False]
    assert np.flatnonzero(store.truncated).tolist() == [7]
    assert store.actions[[4, 8]].tolist() == [[0, 0], [0, 0]]
    assert len(store.content_hash) == 64


def test_arrow_datasets_are_read():
    pytest.importorskip("pyarrow")
    observations = two_episodes()
    store = load_store(stranger(observations, data_format="arrow"))
    np.testing.assert_array_equal(store.frames, np.concatenate(observations))


def test_jpeg_frames_are_decoded():
    observations = two_episodes()
    store = load_store(stranger(observations, jpeg=True))
    assert np.abs(store.frames.astype(int) - np.concatenate(observations)).max() <= 8


def test_dict_with_one_image():
    observations = two_episodes()
    space = gym.spaces.Dict({"state": gym.spaces.Box(-1, 1, (4,), np.float32), "camera": RGB})
    episodes = [{"state": np.zeros((len(frames), 4), np.float32), "camera": frames} for frames in observations]
    store = load_store(stranger(episodes, space))
    np.testing.assert_array_equal(store.frames, np.concatenate(observations))


def test_nested_and_several_images_are_named_by_key():
    inner = gym.spaces.Dict({"wrist": RGB, "front": RGB})
    space = gym.spaces.Dict({"pixels": inner, "state": gym.spaces.Box(-1, 1, (4,), np.float32)})
    front = two_episodes()
    episodes = [{"pixels": {"wrist": frames // 2, "front": frames}, "state": np.zeros((len(frames), 4), np.float32)}
                for frames in front]
    dataset_id = stranger(episodes, space)
    with pytest.raises(DatasetError, match=r"pixels/front.*pixels/wrist|pixels/wrist.*pixels/front") as error:
        load_store(dataset_id)
    assert_paragraph(error)
    np.testing.assert_array_equal(load_store(dataset_id, image_key="pixels/front").frames, np.concatenate(front))
    with pytest.raises(DatasetError, match=r"no observation key 'rgb'.*state") as error:
        load_store(dataset_id, image_key="rgb")
    assert_paragraph(error)


@pytest.mark.parametrize("shape", [(64, 64), (64, 64, 1), (1, 64, 64)])
def test_grey_images_are_repeated(shape: tuple[int, ...]):
    observations = noise(shape)
    store = load_store(stranger(observations, gym.spaces.Box(0, 255, shape, np.uint8)))
    grey = np.concatenate(observations).reshape(-1, 64, 64)
    assert store.frames.shape == (9, 64, 64, 3)
    for channel in range(3):
        np.testing.assert_array_equal(store.frames[..., channel], grey)


def test_grey_jpeg_images():
    observations = two_episodes((64, 64))
    store = load_store(stranger(observations, gym.spaces.Box(0, 255, (64, 64), np.uint8), jpeg=True))
    assert np.abs(store.frames[..., 1].astype(int) - np.concatenate(observations)).max() <= 8


def test_channel_first_images_are_transposed():
    observations = noise((3, 64, 64))
    store = load_store(stranger(observations, gym.spaces.Box(0, 255, (3, 64, 64), np.uint8), jpeg=True))
    np.testing.assert_array_equal(store.frames[3, :, :, 2], observations[0][3, 2])


def test_other_squares_are_resized_and_said_so():
    observations = [np.full((count, 128, 128, 3), 100, np.uint8) for count in (5, 4)]
    observations[0][2, :64, :64] = 20
    dataset_id = stranger(observations, gym.spaces.Box(0, 255, (128, 128, 3), np.uint8))
    with pytest.warns(UserWarning, match="128×128 are resized to 64×64"):
        store = load_store(dataset_id)
    assert store.frames.shape == (9, 64, 64, 3)
    assert (store.frames[2, :32, :32] == 20).all()
    assert (store.frames[2, 32:] == 100).all()
    assert load_store(dataset_id, image_size=None).frames.shape == (9, 128, 128, 3)


def test_two_reward_levels_are_binarised():
    rewards = [np.array([-0.1, -0.1, -0.1, 10.0]), np.full(3, -0.1)]
    dataset_id = stranger(two_episodes(), rewards=rewards)
    with pytest.warns(UserWarning, match=r"reward 10 is read as success \(1\), -0.1 as 0"):
        store = load_store(dataset_id)
    assert store.rewards.tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(("values", "rule"), [((-1, -1, -1, 0), "reward>=0"), ((0.1, 0.1, 0.1, 1), "reward>=1"),
                                              ((-1, -1, -1, -0.5), "reward>=-0.5")])
def test_the_higher_of_two_rewards_is_success_whatever_its_sign(values: tuple[float, ...], rule: str):
    dataset_id = stranger(two_episodes(), rewards=[np.array(values, float), np.full(3, values[0])])
    with pytest.warns(UserWarning, match="is read as success"):
        store = load_store(dataset_id)
    assert store.rewards.tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert store.reading.success == rule


def test_an_episode_ends_at_its_first_success():
    never = [np.zeros(4, bool), np.zeros(3, bool)]
    ends = [np.array([False, False, False, True]), np.array([False, False, True])]
    observations = two_episodes()
    rewards = [np.array([0.0, 1.0, 1.0, 0.0]), np.zeros(3)]
    dataset_id = stranger(observations, rewards=rewards, terminations=never, truncations=ends)
    with pytest.warns(UserWarning, match="1 episodes go on after their first success"):
        store = load_store(dataset_id)
    assert store.episode_length.tolist() == [2, 3]
    np.testing.assert_array_equal(store.frames, np.concatenate([observations[0][:3], observations[1]]))
    assert store.rewards.tolist() == [0, 1, 0, 0, 0, 0, 0]
    assert np.flatnonzero(store.terminated).tolist() == [1]
    assert np.flatnonzero(store.truncated).tolist() == [5]
    assert store.actions[2].tolist() == [0, 0]


def test_an_episode_without_a_flag_counts_as_truncated():
    dataset_id = stranger(two_episodes(), truncations=[np.zeros(4, bool), np.zeros(3, bool)])
    with pytest.warns(UserWarning, match="1 episodes end without a flag"):
        store = load_store(dataset_id)
    assert np.flatnonzero(store.truncated).tolist() == [7]


def test_actions_outside_the_space_are_clipped_and_unbounded_spaces_bounded():
    actions = [np.array([[2.0, -3.0], [0, 0], [0.5, 0], [0, 0]], np.float32), np.zeros((3, 2), np.float32)]
    dataset_id = stranger(two_episodes(), actions=actions)
    with pytest.warns(UserWarning, match="1 of 7 actions lie outside"):
        assert load_store(dataset_id).actions[0].tolist() == [1, -1]
    free = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    dataset_id = stranger(two_episodes(), actions=actions, action_space=free, dataset_id="lab/free-v0")
    with pytest.warns(UserWarning, match="unbounded"):
        store = load_store(dataset_id)
    assert (store.action_low.tolist(), store.action_high.tolist()) == ([0, -3], [2, 0])


# what is refused


def refused(dataset_id: str, match: str, **options: object) -> None:
    with pytest.raises(DatasetError, match=match) as error:
        load_store(dataset_id, **options)
    assert_paragraph(error)


def test_missing_dataset_and_bad_id():
    write_dataset(a_store())
    refused("velap/Toi-v0", "velap/Toy-v0.*velap collect")
    refused("../etc/passwd", "not a Minari dataset id")
    refused("velap/Toy", "a version at the end")


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 1.0), (0.0, 255.0)])
def test_float_images_are_rounded_by_the_bounds_of_their_space(low: float, high: float):
    observations = noise((64, 64, 3))
    stored = [(low + frames / 255 * (high - low)).astype(np.float32) for frames in observations]
    store = load_store(stranger(stored, gym.spaces.Box(low, high, (64, 64, 3), np.float32)))
    np.testing.assert_array_equal(store.frames, np.concatenate(observations))


@pytest.mark.parametrize(("high", "factor", "match"), [(1.0, 2.0, "to 2; expected 0 to 1"), (255.0, 1.0, "up to 1; "
                          "expected values"),
                                                       (1.0, np.nan, "from nan to nan")])
def test_float_images_must_fit_the_bounds_of_their_space(high: float, factor: float, match: str):
    frames = [(images / images.max() * factor).astype(np.float32) for images in noise((64, 64, 3))]
    refused(stranger(frames, gym.spaces.Box(0.0, high, (64, 64, 3), np.float32)), match)


@pytest.mark.parametrize("space", [gym.spaces.Box(-np.inf, np.inf, (64, 64, 3), np.float32),
                                   gym.spaces.Box(0, 1023, (64, 64, 3), np.uint16)])
def test_images_of_other_numbers_are_refused(space: gym.spaces.Box):
    refused(stranger([frames.astype(space.dtype) for frames in two_episodes()], space), r"int16|inf.*np.round\(255")


@pytest.mark.parametrize(("shape", "hint"), [((64, 64, 9), "stacks frames itself"), ((9, 64, 64), "stacks frames itself"),
                                             ((4, 84, 84), "newest frame"), ((4, 64, 64, 3), "newest frame"),
                                             ((64, 64, 4), "red, green and blue"), ((48, 64, 3), "--fit pad")])
def test_wrong_image_shapes_are_refused(shape: tuple[int, ...], hint: str):
    observations = [np.zeros((count, *shape), np.uint8) for count in (5, 4)]
    refused(stranger(observations, gym.spaces.Box(0, 255, shape, np.uint8)), hint)


def test_no_image_at_all():
    space = gym.spaces.Dict({"state": gym.spaces.Box(-1, 1, (4,), np.float32)})
    refused(stranger([{"state": np.zeros((5, 4), np.float32)}], space), r"no image.*state: float32\[4\]")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_actions_and_rewards_must_be_finite(bad: float):
    actions = [np.zeros((4, 2), np.float32), np.zeros((3, 2), np.float32)]
    actions[1][2, 0] = bad
    refused(stranger(two_episodes(), actions=actions), "episode 1: the action of step 2")
    rewards = [np.array([0, bad, 0, 1.0]), np.zeros(3)]
    refused(stranger(two_episodes(), rewards=rewards, dataset_id="lab/rewards-v0"), "episode 0: the reward of step 1")


@pytest.mark.parametrize(("values", "match"), [
    ((0, 0, 0, 0), r"is 0.*--success labels:"), ((1, 1, 1, 1), "every reward.*is 1"),
    ((0, 0.5, 0.7, 1), r"4 different rewards.*'reward>=1'"),
])
def test_rewards_that_are_not_sparse(values: tuple[float, ...], match: str):
    other = np.full(3, values[0], float)
    refused(stranger(two_episodes(), rewards=[np.array(values, float), other]), match)


def test_episodes_that_are_too_short():
    dataset_id = stranger(two_episodes())
    assert load_store(dataset_id, min_length=4).n_episodes == 2
    refused(dataset_id, "has 4 transitions; expected one of 5", min_length=5)


def test_flags_before_the_end():
    early = [np.array([False, False, False, True]), np.array([True, False, False])]
    refused(stranger(two_episodes(), terminations=early), "episode 1: a termination stands at step 0")


def test_counts_that_disagree():
    flags = [np.zeros(3, bool)] * 2
    dataset_id = stranger(two_episodes(), rewards=[np.eye(3)[2], np.zeros(3)], terminations=flags, truncations=flags)
    refused(dataset_id, "one more than the 3 rewards")
    dataset_id = stranger(two_episodes(), actions=[np.zeros((2, 2), np.float32)] * 2, dataset_id="lab/few-v0")
    refused(dataset_id, "actions have shape")
    dataset_id = stranger(two_episodes(), terminations=[np.zeros(2, bool)] * 2, dataset_id="lab/flags-v0")
    refused(dataset_id, "terminations are bool")


def test_discrete_actions_are_refused():
    actions = [np.zeros(4, int), np.zeros(3, int)]
    refused(stranger(two_episodes(), action_space=gym.spaces.Discrete(3), actions=actions), "continuous")


def test_an_empty_dataset_is_refused(root: Path):
    path = root / stranger(two_episodes())
    shutil.copytree(path, root / "lab" / "none-v0")
    metadata = root / "lab" / "none-v0" / "data" / "metadata.json"
    metadata.write_text(json.dumps({**json.loads(metadata.read_text()), "total_episodes": 0, "total_steps": 0}))
    refused("lab/none-v0", "no episode")
