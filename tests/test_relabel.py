"""Hindsight goals of App. B.4 and the windows they are drawn from."""

import numpy as np
import pytest
import torch

from velap.config.training import TrainConfig
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler


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


def shares(next_=0.0, future=0.0, other=0.0) -> dict:
    return {"relabel_next": next_, "relabel_future": future, "relabel_other": other}


def episode_of(rows: torch.Tensor) -> torch.Tensor:
    return torch.bucketize(rows.contiguous(), torch.tensor([5, 12, 18]), right=True)


@pytest.mark.parametrize("whole", [True, False])
def test_next_goals_are_the_next_frame_and_end_with_reward(whole):
    batch = sampler(**shares(next_=1.0)).sample(64, 4, whole, torch.Generator().manual_seed(0))
    goal_rows, next_rows = batch.rows[batch.goals.position], batch.rows[batch.start + 1]
    assert torch.equal(goal_rows, next_rows)
    assert batch.goals.reward.eq(1).all() and batch.goals.proceeds.eq(0).all()


@pytest.mark.parametrize("whole", [True, False])
def test_future_goals_lie_later_in_the_same_episode(whole):
    batch = sampler(**shares(future=1.0)).sample(256, 4, whole, torch.Generator().manual_seed(0))
    real = batch.weight > 0
    now, goal = batch.rows[batch.start][real], batch.rows[batch.goals.position][real]
    assert torch.equal(episode_of(now), episode_of(goal))
    reached = batch.goals.reward[real] > 0
    assert (goal[~reached] >= now[~reached] + 2).all()
    assert torch.equal(goal[reached], now[reached] + 1)
    assert (~reached).sum() > 50


@pytest.mark.parametrize("whole", [True, False])
def test_other_goals_come_from_other_windows_without_reward(whole):
    store = make_store(lengths=(5,) * 40, rewarded=())
    batch = sampler(store, **shares(other=1.0)).sample(20, 4, whole, torch.Generator().manual_seed(0))
    now, goal = batch.rows[batch.start] // 6, batch.rows[batch.goals.position] // 6
    real = batch.weight > 0
    assert (now[real] != goal[real]).float().mean() > 0.9
    same_frame = batch.rows[batch.goals.position] == batch.rows[batch.start + 1]
    assert torch.equal(batch.goals.reward > 0, same_frame)


def test_no_bootstrap_after_a_terminal():
    batch = sampler(**shares(other=1.0)).sample(256, 4, True, torch.Generator().manual_seed(1))
    terminal = (batch.rows[batch.start] == 10) & (batch.weight > 0)  # last transition of episode 1, frames 5 to 11
    assert terminal.any()
    assert batch.proceeds[terminal].eq(0).all() and batch.reward[terminal].eq(1).all()
    assert batch.goals.proceeds[terminal].eq(0).all()
    truncated = (batch.rows[batch.start] == 3) & (batch.weight > 0)
    assert truncated.any() and batch.proceeds[truncated].eq(1).all()


def test_windows_never_cross_an_episode_and_align_actions_with_frames():
    draw = sampler(**shares(next_=1.0))
    batch = draw.sample(128, 5, True, torch.Generator().manual_seed(2))
    rows = batch.rows[: 128 * 6].view(128, 6)
    assert torch.equal(episode_of(rows[:, :1]).expand(-1, 6), episode_of(rows))
    assert torch.equal((rows[:, 1:] - rows[:, :-1]) == 1, batch.valid)
    assert torch.equal(batch.actions[batch.valid], draw.actions[rows[:, :-1][batch.valid]])
    assert draw.stacks(rows)[..., 0, 0, 0, 0].long().equal(rows)


def test_rewarded_share_draws_rare_rewards():
    plain = sampler(make_store((9,) * 50, (3,)), rewarded_share=0.0, **shares(next_=1.0))
    rich = sampler(make_store((9,) * 50, (3,)), rewarded_share=0.5, **shares(next_=1.0))
    counts = [s.sample(200, 3, False, torch.Generator().manual_seed(0)).reward.sum().item() for s in (plain, rich)]
    assert counts[0] < 5 and 70 < counts[1] < 130
    replaced = rich.sample(200, 3, False, torch.Generator().manual_seed(0), rewarded_share=0.0)
    assert replaced.reward.sum() < 5


def test_held_out_episodes_are_never_drawn():
    draw = WindowSampler(make_store(), TrainConfig(), 1, torch.device("cpu"), np.array([0]))
    batch = draw.sample(200, 4, True, torch.Generator().manual_seed(0))
    assert (batch.rows >= 5).all()


@pytest.mark.parametrize("whole", [True, False])
def test_groups_of_windows_come_from_episodes_near_each_other_and_share_goals(whole, monkeypatch):
    monkeypatch.setattr("velap.data.relabelling.GROUP_GOALS", 1.0)
    store = make_store(lengths=(5,) * 40, rewarded=())
    held = np.array([7, 20])
    config = TrainConfig(group_windows=6, group_reach=2, rewarded_share=0.0, **shares(other=1.0))
    draw = WindowSampler(store, config, 1, torch.device("cpu"), held)
    batch = draw.sample(23, 4, whole, torch.Generator().manual_seed(0))  # three groups of six and one of five
    episodes = batch.rows[batch.start] // 6
    group = batch.start // 5 // 6
    leaders = batch.rows[torch.arange(0, 23, 6) * 5] // 6
    assert (episodes - leaders[group]).abs().max() <= 3  # two of the training episodes, a held-out one between them
    assert len(leaders.unique()) > 1 and not torch.isin(episodes, torch.from_numpy(held)).any()
    goal_group = batch.goals.position // 5 // 6
    assert torch.equal(goal_group, group)
    assert not torch.equal(batch.goals.position // 5, batch.start // 5)


def test_windows_of_one_group_are_the_windows_of_no_groups():
    plain, one = (
        sampler(group_windows=1, group_reach=reach).sample(16, 4, True, torch.Generator().manual_seed(3)) for reach in (1, 8)
    )
    assert torch.equal(plain.rows, one.rows) and torch.equal(plain.goals.position, one.goals.position)
