"""`velap label`: what it shows, what it takes, and that the success rule reads what it writes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from velap.cli import main
from velap.data.labels import CAPTION, GAP, TILE, draw_sheets, parse_answers
from velap.data.loading import load_store
from velap.errors import ConfigError

pytestmark = pytest.mark.filterwarnings("ignore:.*(bounds are taken|end without a flag|go on after)")

LENGTHS = (5, 3, 8, 4)
COLOURS = ((200, 0, 0), (0, 200, 0), (0, 0, 200), (150, 150, 0))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Four episodes that end in a colour each; the reward succeeds at once everywhere, wrongly."""
    frames = []
    for length, colour in zip(LENGTHS, COLOURS, strict=True):
        frames += [np.full((64, 64, 3), 128, np.uint8)] * length
        frames.append(np.broadcast_to(np.array(colour, np.uint8), (64, 64, 3)))
    ends = np.cumsum(np.array(LENGTHS) + 1) - 1
    terminals, rewards = np.zeros(len(frames)), np.zeros(len(frames))
    terminals[ends], rewards[ends - np.array(LENGTHS)] = 1, 1
    actions = np.random.default_rng(0).uniform(-1, 1, (len(frames), 2)).astype(np.float32)
    path = tmp_path / "data.npz"
    np.savez(path, observations=np.stack(frames), actions=actions, terminals=terminals, rewards=rewards)
    return path


def test_labels_are_read_by_the_success_rule(data: Path, tmp_path: Path) -> None:
    labels = tmp_path / "labels.csv"
    assert main(["label", str(data), "--out", str(labels), "--successes", "1, 2:6"]) == 0
    assert labels.read_text() == "episode,success,step\n0,0,\n1,1,\n2,1,6\n3,0,\n"
    store = load_store(data, success=f"labels:{labels}")
    assert store.episode_length.tolist() == [5, 3, 7, 4]
    assert np.bincount(store.episode_of, weights=store.rewards).tolist() == [0, 1, 1, 0]


def test_the_sheet_shows_the_last_frame_of_whole_episodes(data: Path, tmp_path: Path) -> None:
    """Whole episodes: a wrong reward at their first step does not cut them."""
    assert main(["label", str(data), "--out", str(tmp_path / "answers.csv"), "--successes", "0"]) == 0
    sheet = np.asarray(Image.open(tmp_path / "answers-1.png"))
    assert sheet.shape == (TILE + CAPTION + 2 * GAP, 4 * (TILE + GAP) + GAP, 3)
    for number, colour in enumerate(COLOURS):
        left = GAP + number * (TILE + GAP)
        assert (sheet[GAP + CAPTION : GAP + CAPTION + TILE, left : left + TILE] == colour).all()
        assert (sheet[GAP : GAP + CAPTION, left : left + TILE] < 60).any(), "its number stands above"


def test_more_than_a_hundred_episodes_make_more_sheets(data: Path, tmp_path: Path) -> None:
    from velap.data.frames import Episode, FrameStore

    frames = np.zeros((2, 16, 16, 3), np.uint8)
    store = FrameStore.from_episodes([Episode(frames, np.zeros((1, 1)), [float(number == 0)]) for number in range(101)],
                                     action_low=-1, action_high=1, image_size=None)
    assert [path.name for path in draw_sheets(store, tmp_path / "sheets", "a")] == ["a-1.png", "a-2.png"]


def test_answers_come_from_standard_input(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("0 2-3\n\n1\n"))
    assert main(["label", str(data), "--out", str(tmp_path / "a.csv")]) == 0
    assert [line.split(",")[1] for line in (tmp_path / "a.csv").read_text().splitlines()[1:]] == ["1", "0", "1", "1"]


@pytest.mark.parametrize("answer", ["4", "2-9", "3-1", "x", "1:3", "-1", "1.5"])
def test_wrong_answers_are_named_and_nothing_is_written(data: Path, tmp_path: Path, answer: str) -> None:
    store = load_store(data)
    if answer == "1:3":
        store = load_store(data, success="labels:" + str(_all_false(tmp_path)), need_success=False)
    with pytest.raises(ConfigError, match=r"got the answer .*; expected .* Correct it"):
        parse_answers(answer, store)
    assert main(["label", str(data), "--out", str(tmp_path / "b.csv"), f"--successes={answer}"]) == 2
    assert not (tmp_path / "b.csv").exists()


def _all_false(folder: Path) -> Path:
    path = folder / "none.csv"
    path.write_text("episode,success\n0,0\n")
    return path


def test_no_answer_is_no_label(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["label", str(data), "--out", str(tmp_path / "c.csv"), "--successes", ""]) == 2
    assert "expected at least one number" in " ".join(capsys.readouterr().err.split())
