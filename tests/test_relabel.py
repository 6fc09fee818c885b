"""Hindsight goals of App. B.4 and the windows they are drawn from."""

import numpy as np
import pytest
import torch

from velap.config.training import TrainConfig
from velap.data.frames import FrameStore
from velap.data.sampling import FirstTransitions, WholeWindows, WindowSampler


def make_store(lengths=(4, 6, 5), rewarded=(1,)) -> FrameStore:
    """Episodes of the given lengths; frame f holds the value f, the rewarded ones end in success."""
    starts = np.concatenate([[0], np.cumsum(np.array(lengths) + 1)[:-1]])
    n = int(sum(lengths) + len(lengths))
    rewards, terminated, truncated = np.zeros(n, np.float32), np.zeros(n, bool), np.zeros(n, bool)
    for i, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        ended = i in rewarded
        rewards[start + length - 1] = float(ended)
        (terminated if ended else truncated)[start + length - 1] = True
    frames = np.broadcast_to(np.arange(n, dtype=np.uint8)[:, None, None, None], (n, 8, 8, 3)).copy()
    actions = np.arange(n, dtype=np.float32)[:, None] / n
    return FrameStore(
        frames=frames,
        actions=actions,
        rewards=rewards,
        terminated=terminated,
        truncated=truncated,
        episode_start=starts.astype(np.int64),
        episode_length=np.array(lengths, np.int64),
        action_low=-np.ones(1, np.float32),
        action_high=np.ones(1, np.float32),
        dataset_id="test/rows-v0",
        content_hash="0",
    )


def sampler(store=None, **train) -> WindowSampler:
    return WindowSampler(store or make_store(), TrainConfig(**train), 1, torch.device("cpu"), np.array([], dtype=np.int64))


def drawn(whole: bool, windows: int, length: int) -> WholeWindows | FirstTransitions:
    """Windows of which at most 96 transitions count."""
    return WholeWindows(windows, length, 96, 96, min(3, length)) if whole else FirstTransitions(windows, length)


@pytest.fixture
def shares(monkeypatch):
    """Sets the shares of the strategies a and b of B.4; the rest is c."""

    def put(next_=0.0, future=0.0):
        monkeypatch.setattr("velap.data.relabelling.NEXT", next_)
        monkeypatch.setattr("velap.data.relabelling.FUTURE", future)

    return put


def episode_of(rows: torch.Tensor) -> torch.Tensor:
    return torch.bucketize(rows.contiguous(), torch.tensor([5, 12, 18]), right=True)


@pytest.mark.parametrize("whole", [True, False])
def test_next_goals_are_the_next_frame_and_end_with_reward(whole, shares):
    shares(next_=1.0)
    batch = sampler().sample(drawn(whole, 64, 4), torch.Generator().manual_seed(0), 0.05)
    goal_rows, next_rows = batch.rows[batch.goal_at], batch.rows[batch.now_at + 1]
    assert torch.equal(goal_rows, next_rows)
    assert batch.goal_reward.eq(1).all() and batch.goal_proceeds.eq(0).all()


@pytest.mark.parametrize("whole", [True, False])
def test_future_goals_lie_later_in_the_same_episode(whole, shares):
    shares(future=1.0)
    batch = sampler().sample(drawn(whole, 256, 4), torch.Generator().manual_seed(0), 0.05)
    real = batch.weight > 0
    now, goal = batch.rows[batch.now_at][real], batch.rows[batch.goal_at][real]
    assert torch.equal(episode_of(now), episode_of(goal))
    reached = batch.goal_reward[real] > 0
    assert (goal[~reached] >= now[~reached] + 2).all()
    assert torch.equal(goal[reached], now[reached] + 1)
    assert (~reached).sum() > 50


@pytest.mark.parametrize("whole", [True, False])
def test_other_goals_come_from_other_windows_without_reward(whole, shares):
    shares()
    store = make_store(lengths=(5,) * 40, rewarded=())
    batch = sampler(store).sample(drawn(whole, 20, 4), torch.Generator().manual_seed(0), 0.05)
    now, goal = batch.rows[batch.now_at] // 6, batch.rows[batch.goal_at] // 6
    real = batch.weight > 0
    assert (now[real] != goal[real]).float().mean() > 0.9
    same_frame = batch.rows[batch.goal_at] == batch.rows[batch.now_at + 1]
    assert torch.equal(batch.goal_reward > 0, same_frame)


def test_no_bootstrap_after_a_terminal(shares):
    shares()
    batch = sampler().sample(drawn(True, 256, 4), torch.Generator().manual_seed(1), 0.05)
    terminal = (batch.rows[batch.now_at] == 10) & (batch.weight > 0)  # last transition of episode 1, frames 5 to 11
    assert terminal.any()
    assert batch.proceeds[terminal].eq(0).all() and batch.reward[terminal].eq(1).all()
    assert batch.goal_proceeds[terminal].eq(0).all()
    truncated = (batch.rows[batch.now_at] == 3) & (batch.weight > 0)
    assert truncated.any() and batch.proceeds[truncated].eq(1).all()


def test_windows_never_cross_an_episode_and_align_actions_with_frames(shares):
    shares(next_=1.0)
    draw = sampler()
    batch = draw.sample(drawn(True, 128, 5), torch.Generator().manual_seed(2), 0.05)
    rows = batch.rows[: 128 * 6].view(128, 6)
    assert torch.equal(episode_of(rows[:, :1]).expand(-1, 6), episode_of(rows))
    assert torch.equal((rows[:, 1:] - rows[:, :-1]) == 1, batch.valid)
    assert torch.equal(batch.actions[batch.valid], draw.actions[rows[:, :-1][batch.valid]])
    assert draw.stacks(rows)[..., 0, 0, 0, 0].long().equal(rows)


def test_rewarded_share_draws_rare_rewards(shares):
    shares(next_=1.0)
    draw = sampler(make_store((9,) * 50, (3,)))
    counts = [draw.sample(drawn(False, 200, 3), torch.Generator().manual_seed(0), share).reward.sum().item()
              for share in (0.0, 0.5)]
    assert counts[0] < 5 and 70 < counts[1] < 130


def test_held_out_episodes_are_never_drawn():
    draw = WindowSampler(make_store(), TrainConfig(), 1, torch.device("cpu"), np.array([0]))
    batch = draw.sample(drawn(True, 200, 4), torch.Generator().manual_seed(0), 0.05)
    assert (batch.rows >= 5).all()


@pytest.mark.parametrize("whole", [True, False])
def test_groups_of_windows_come_from_episodes_near_each_other_and_share_goals(whole, monkeypatch, shares):
    shares()
    monkeypatch.setattr("velap.data.relabelling.GROUP_GOALS", 1.0)
    store = make_store(lengths=(5,) * 40, rewarded=())
    held = np.array([7, 20])
    config = TrainConfig(group_windows=6, group_reach=2)
    draw = WindowSampler(store, config, 1, torch.device("cpu"), held)
    batch = draw.sample(drawn(whole, 23, 4), torch.Generator().manual_seed(0), 0.05)  # three groups of six and one of five
    episodes = batch.rows[batch.now_at] // 6
    group = batch.now_at // 5 // 6
    leaders = batch.rows[torch.arange(0, 23, 6) * 5] // 6
    assert (episodes - leaders[group]).abs().max() <= 3  # two of the training episodes, a held-out one between them
    assert len(leaders.unique()) > 1 and not torch.isin(episodes, torch.from_numpy(held)).any()
    goal_group = batch.goal_at // 5 // 6
    assert torch.equal(goal_group, group)
    assert not torch.equal(batch.goal_at // 5, batch.now_at // 5)


def test_windows_of_one_group_are_the_windows_of_no_groups():
    draw = drawn(True, 16, 4)
    plain, one = (
        sampler(group_windows=1, group_reach=reach).sample(draw, torch.Generator().manual_seed(3), 0.05) for reach in (1, 8)
    )
    assert torch.equal(plain.rows, one.rows) and torch.equal(plain.goal_at, one.goal_at)
