"""Success rules: their text, what they say of episodes and of environments, and that both agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from velap.data.frames import Episode, FrameStore
from velap.data.success import Success, success_of
from velap.errors import ConfigError, DatasetError

pytestmark = pytest.mark.filterwarnings("ignore:.*go on after their first success")


def at_the_door(reward: float, info: Any, terminated: bool) -> bool:
    """A rule of a user."""
    return bool(info["door"] > 0.5 and reward < 0)


def episodes(**changes: Any) -> list[Episode]:
    """Two episodes of four steps; dense rewards, the first one ends well."""
    made = []
    for won in (True, False):
        images = np.random.default_rng(won).integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
        told = np.array([False, False, False, False, won])
        values = {"rewards": np.array([-0.3, -0.2, -0.25, -0.1]),
                  "infos": {"success": told, "door": np.array([0, 0.2, 0.6, 1.0])},
                  "terminated": np.array([False, False, False, won])}
        made.append(Episode(images=images, actions=np.zeros((4, 2)), **{**values, **changes}))
    return made


def store(success: Any = None, made: list[Episode] | None = None) -> FrameStore:
    return FrameStore.from_episodes(made or episodes(), action_low=-1, action_high=1, success=success)


@pytest.mark.parametrize("text", ["reward>=1", "reward>=-0.5", "info:success", "info:coverage>=0.95", "info:next.reward>=1",
                                  "terminated", "labels:a/b.csv", "python:my.module:solved",
                                  "reward>=0.7", "reward>=1234567", "info:x>=0.000001"])
def test_a_rule_reads_as_it_writes(text: str) -> None:
    assert str(Success.parse(text)) == text


@pytest.mark.parametrize("text", ["", "reward", "reward>1", "info", "terminated>=1", "success", "labels", "reward>=x"])
def test_other_texts_are_refused_with_the_forms(text: str) -> None:
    with pytest.raises(ConfigError, match=r"expected one of the forms reward>=1, info:success"):
        Success.parse(text)


def test_infos_come_first_then_two_rewards() -> None:
    """As evaluation judges: the environment's own word, else its reward."""
    told = store()
    assert told.reading.success == "info:success"
    assert told.rewards.tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
    sparse = episodes(rewards=np.array([-1.0, -1, -1, 0]), infos={})
    sparse[1] = Episode(sparse[1].images, sparse[1].actions, np.full(4, -1.0))
    with pytest.warns(UserWarning, match=r"reward 0 is read as success \(1\), -1 as 0"):
        assert store(made=sparse).reading.success == "reward>=0"
    with pytest.raises(DatasetError, match=r"4 different rewards.*infos hold door.*info:door.*terminated.*labels"):
        store(made=episodes(infos={"door": np.array([0, 0.2, 0.6, 1.0])}))


@pytest.mark.parametrize(("rule", "won"), [("terminated", [3]), ("info:door>=0.5", [2, 6]), ("reward>=-0.1", [3, 8]),
                                           ("info:success", [3]), (at_the_door, [2, 6])])
def test_what_rules_say_of_episodes(rule: Any, won: list[int]) -> None:
    found = store(rule)
    assert np.flatnonzero(found.rewards).tolist() == won
    assert np.flatnonzero(found.terminated).tolist() == won


def test_labels_are_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "answers.csv"
    path.write_text("episode,success,step\n0,0,\n1,yes,2\n")
    found = store(f"labels:{path}", episodes(infos={}))
    assert np.flatnonzero(found.rewards).tolist() == [7]
    assert found.episode_length.tolist() == [4, 3]
    path.write_text("episode,success\n1,1\n")
    assert np.flatnonzero(store(f"labels:{path}").rewards).tolist() == [8]
    for text, match in (("episode,won\n1,1\n", "line 2"), ("episode,success\n1,maybe\n", "'maybe'"),
                        ("episode,success,step\n1,1,9\n", "step 9; expected one of its 4 steps")):
        path.write_text(text)
        with pytest.raises(DatasetError, match=match):
            store(f"labels:{path}")
    with pytest.raises(DatasetError, match="cannot be read"):
        store(f"labels:{tmp_path / 'none.csv'}")


def test_functions_are_kept_by_name_and_found_again() -> None:
    kept = store(at_the_door).reading.success
    assert kept == "python:test_success:at_the_door"
    assert success_of(-1.0, {"door": 0.7}, kept) and not success_of(1.0, {"door": 0.7}, kept)
    with pytest.raises(ConfigError, match="function of a module"):
        store(lambda reward, info, terminated: True)
    with pytest.raises(ConfigError, match="names no function"):
        success_of(0, {}, "python:no_such_module:solved")


@pytest.mark.parametrize(("rule", "reward", "info", "terminated", "won"), [
    ("reward>=0", -1, {}, False, False), ("reward>=0", 0, {}, True, True),
    ("reward>=1", 0.1, {"success": True}, False, False),
    ("info:success", 5, {"success": False}, True, False), ("info:next.success", -3, {"is_success": True}, False, True),
    ("info:coverage>=0.95", 0, {"coverage": 0.96}, False, True), ("info:coverage>=0.95", 0, {"coverage": 0.9}, True, False),
    ("reward>=0.7", np.float32(0.7), {}, False, True), ("info:door/open", 0, {"door": {"open": 1}}, False, True),
    ("info:open", 0, {"open": np.array([True])}, False, True), (None, 0, {"success": None}, False, False),
    ("terminated", 0, {}, True, True), ("terminated", 1, {}, False, False), ("labels:a.csv", 1, {}, False, True),
    (None, 1, {}, False, True), (None, 0, {}, True, False), (None, -1, {"success": True}, False, True),
])
def test_what_rules_say_of_an_environments_step(
        rule: str | None, reward: float, info: Any, terminated: bool, won: bool) -> None:
    assert success_of(reward, info, rule, terminated) is won


@pytest.mark.parametrize("told", [{"task": False}, "False", np.array([True, False]), [], object()])
def test_an_info_that_is_no_truth_value_is_no_success(told: Any) -> None:
    """robosuite's is {"task": False}, which Python calls true."""
    for rule in (None, "info:success", "info:success>=1"):
        with pytest.raises(ConfigError, match=r"info 'success' is .*expected true, false or one number.*--success info:"):
            success_of(0, {"success": told}, rule)


@pytest.mark.parametrize("rule", ["info:solved", "labels:answers.csv", None])
def test_a_shaped_reward_is_no_success(rule: str | None) -> None:
    """The rule's own word is missing, and 0.3 a step does not say that the task is solved."""
    with pytest.raises(ConfigError, match=r"the reward 0.3 and no .*in its info.*--success"):
        success_of(0.3, {}, rule)


def test_levels_are_those_of_single_precision() -> None:
    """0.7 is stored as 0.69999999; the rule holds in the data as it does in the environment."""
    made = [Episode(each.images, each.actions, np.array([0.1, 0.2, 0.3, last], np.float32))
            for each, last in zip(episodes(), (0.7, 0.4), strict=True)]
    assert np.flatnonzero(store("reward>=0.7", made).rewards).tolist() == [3]
    sparse = [Episode(each.images, each.actions, np.array([0, 0, 0, last], np.float32))
              for each, last in zip(episodes(), (123456.7, 0), strict=True)]
    with pytest.warns(UserWarning, match="read as success"):
        found = store(made=sparse)
    assert success_of(np.float32(123456.7), {}, found.reading.success), "the kept rule has the level itself"


@pytest.mark.parametrize("text", ["\ufeffepisode,success\n1,1\n", "episode;success\n1;1\n", "episode\tsuccess\n1\t1\n",
                                  "Episode, Success, step\n0, False,\n1, True, 3.0\n"])
def test_labels_of_spreadsheets_are_read(text: str, tmp_path: Path) -> None:
    path = tmp_path / "answers.csv"
    path.write_bytes(text.encode())
    assert np.flatnonzero(store(f"labels:{path}", episodes(infos={})).rewards).tolist() == [8]


def test_labels_of_another_dataset_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "answers.csv"
    path.write_text("episode,success\n0,1\n7,1\n")
    with pytest.raises(DatasetError, match="episode 7 a success; expected numbers from 0 to 1"):
        store(f"labels:{path}")
    path.write_text("episode,success,step\n0,1,2.5\n")
    with pytest.raises(DatasetError, match=r"line 2.*no whole number"):
        store(f"labels:{path}")


def test_rewards_below_zero_say_nothing_without_a_rule() -> None:
    with pytest.raises(ConfigError, match="--success 'reward>=0'"):
        success_of(-1, {})
