"""What `velap diagnose` measures on recorded episodes: dynamics, distances by Q^l and values by Q^g; no environment.

F frames of the dataset, S pairs of states, T transitions of an episode, D latent dimensions, N stacked frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr
from torch import Tensor

from velap.config import Config
from velap.data.frames import FrameStore, Reading
from velap.data.loading import load_store
from velap.data.minari_io import load_positions
from velap.data.sampling import WindowSampler
from velap.errors import ConfigError
from velap.models.horizon import q_from_steps, steps_from_q
from velap.models.velap import LatentModel
from velap.report.figures import RealStates
from velap.training.diagnostics import Horizon
from velap.training.encoding import encode_rows
from velap.training.loop import HOLDOUT_EPISODES, holdout_episodes

PAIRS = 1000
"""Pairs of states of different trajectories, of each kind. ours."""
REAL_STATES = 4000
"""Frames of the dataset that a latent is compared with. ours: a few seconds of encoding."""
FEW = 16
"""Episodes that are examined if none was held out. ours, as `holdout_episodes`."""
REWARDED = 3
"""Rewarded episodes that Q^g is drawn along. ours."""
LAST = 20
"""Q^g has to rise over this number of steps before the reward; farther away the tree searches [steps]. ours."""
LED = 5
"""The value of an action is compared with that of the state this number of steps later [steps]. ours: recorded actions last
some steps, and one step is hardly more than the noise of a value."""
FEWEST = 50
"""Fewest transitions of a correlation. ours."""
APART = 2.0
"""Two states are apart where the agent needs more than this times the steps that count as arrived. ours."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A dataset, and the episodes of it that are examined."""

    store: FrameStore
    sampler: WindowSampler
    episodes: NDArray[np.int64]
    """[E] episodes that are examined."""
    held_out: bool
    """None of them was trained on."""
    positions: NDArray[np.float32] | None
    """[F, 2 or 3] agent's position at each frame [m], where the dataset keeps it."""

    @property
    def spans(self) -> list[tuple[int, int]]:
        """First and last row of each episode."""
        starts, lengths = self.store.episode_start[self.episodes], self.store.episode_length[self.episodes]
        return [(int(start), int(start + length)) for start, length in zip(starts, lengths, strict=True)]

    @property
    def rows(self) -> NDArray[np.int64]:
        """Rows of the episodes, concatenated."""
        return np.concatenate([np.arange(first, last + 1) for first, last in self.spans])

    @property
    def fastest(self) -> float | None:
        """The agent's way in its fastest recorded steps [m/step]; None where positions are unknown."""
        if self.positions is None:
            return None
        moving = self.sampler.transitions.cpu().numpy()
        ways = np.linalg.norm(self.positions[moving + 1].astype(np.float64) - self.positions[moving], axis=-1)
        return float(np.quantile(ways, 0.999))


def load_as_trained(dataset_id: str, image_key: str | None, model: LatentModel, metadata: Mapping[str, str],
                    success: str | None = None) -> FrameStore:
    """A dataset, read as the training data of the checkpoint with `metadata`, except for a camera or rule that is given."""
    reading = Reading.from_json(metadata["reading"]) if "reading" in metadata else Reading()
    return load_store(dataset_id, image_key or reading.image_key or None, image_size=model.spaces.height, fit=reading.fit,
                      state_key=reading.state_key or None,
                      success=success or reading.success or None)


def open_recorded(dataset_id: str, image_key: str | None, model: LatentModel, config: Config,
                  metadata: Mapping[str, str], success: str | None = None) -> Recorded:
    """Read a dataset by `load_as_trained`; raises ConfigError where its actions do not fit the model."""
    store = load_as_trained(dataset_id, image_key, model, metadata, success)
    if len(store.action_low) != model.action_dim:
        raise ConfigError(f"{dataset_id} has actions of {len(store.action_low)} entries, the checkpoint acts by "
                          f"{model.action_dim}; expected the same. Name the dataset that it was trained on with --dataset.")
    kept = holdout_episodes(store, HOLDOUT_EPISODES, int(metadata.get("seed", 0)))
    held_out = len(kept) > 0 or metadata.get("dataset_hash") != store.content_hash
    device = next(model.parameters()).device
    sampler = WindowSampler(store, config.train, config.model.frame_stack, device, kept)
    positions = load_positions(dataset_id)
    known = positions is not None and len(positions) == len(store.frames)
    return Recorded(
        store=store,
        sampler=sampler,
        episodes=kept if len(kept) else np.arange(min(FEW, store.n_episodes)),
        held_out=held_out,
        positions=positions if known else None)


@torch.inference_mode()
def encode_states(model: LatentModel, sampler: WindowSampler, rows: NDArray[np.int64]) -> Tensor:
    """Latents [R, D] of the states at rows [R]."""
    return encode_rows(model, sampler, torch.from_numpy(rows).to(sampler.device)).float()


def rank_correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Spearman's rho, NaN where one of them does not vary."""
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(spearmanr(first, second).statistic)


@dataclass(frozen=True, kw_only=True)
class RolloutError:
    """Error of rollouts by h against the true displacement: quartiles over S pairs."""

    lengths: NDArray[np.int64]
    """[K] simulated steps [steps]."""
    error: NDArray[np.float64]
    """[3, K] lower quartile, median, upper quartile [one-step lengths]."""
    moved: NDArray[np.float64]
    """[3, K] of the true displacement [one-step lengths]."""
    local_steps: NDArray[np.float64]
    """[3, K] of log_γ Q_min from the start to the true state [steps]."""
    one_step: float
    """Mean distance of subsequent encodings [latent distance]."""

    def at(self, steps: int) -> int:
        """Index of the length nearest to `steps`."""
        return int(np.abs(self.lengths - steps).argmin())


def rollout_error(horizons: Sequence[Horizon]) -> RolloutError:
    """Quartiles over the pairs of each length; the first length is 1."""
    one_step = horizons[0].moved.mean().item()

    def quartiles(values: Sequence[Tensor], unit: float) -> NDArray[np.float64]:
        return np.stack([np.quantile(each.double().cpu().numpy() / unit, (0.25, 0.5, 0.75)) for each in values], 1)

    return RolloutError(
        lengths=np.array([each.length for each in horizons]),
        error=quartiles([each.error for each in horizons], one_step),
        moved=quartiles([each.moved for each in horizons], one_step),
        local_steps=quartiles([each.local_steps for each in horizons], 1.0),
        one_step=one_step)


@dataclass(frozen=True, kw_only=True)
class StatePairs:
    """Distances by Q^l from states of the examined episodes to states of other trajectories."""

    name: str
    local_steps: NDArray[np.float64]
    """[S] log_γ Q_min [steps]."""
    least_steps: NDArray[np.float64] | None
    """[S] lower bound: distance of the positions at top speed [steps]; None where positions are unknown."""

    def arrived(self, limit: float) -> float:
        """Share of the pairs that are at most `limit` [steps] apart by Q^l."""
        return float((self.local_steps <= limit).mean())

    def aliased(self, limit: float) -> float | None:
        """Share of the pairs truly apart that are at most `limit` [steps] apart by Q^l; None without such pairs."""
        if self.least_steps is None:
            return None
        apart = self.least_steps > APART * limit
        return float((self.local_steps[apart] <= limit).mean()) if apart.any() else None


def other_pairs(model: LatentModel, recorded: Recorded, reach: int, rng: np.random.Generator,
                count: int = PAIRS) -> list[StatePairs]:
    """Pairs with neighbouring episodes, at most `reach` [episodes] before or after, which tend to share a scene, and with
    far ones."""
    store = recorded.store
    start = rng.choice(recorded.rows, count)
    episode = store.episode_of[start]
    everything = np.arange(store.n_episodes)
    latents, found = encode_states(model, recorded.sampler, start), []
    for name, near in (("neighbouring episodes", True), ("far episodes", False)):
        choices = []
        for number in range(count):
            distance = np.abs(everything - episode[number])
            pool = everything[((distance <= reach) & (distance > 0)) if near else distance > reach]
            choices.append(rng.choice(pool) if len(pool) else -1)
        chosen = np.array(choices)
        if (chosen < 0).any():
            continue
        goal = store.episode_start[chosen] + rng.integers(0, store.episode_length[chosen] + 1)
        goals = encode_states(model, recorded.sampler, goal)
        found.append(StatePairs(name=name, local_steps=local_steps(model, latents, goals),
                                least_steps=_least_steps(recorded, start, goal)))
    return found


def local_steps(model: LatentModel, start: Tensor, goal: Tensor) -> NDArray[np.float64]:
    """log_γ Q_min between latents [S, D] [steps]."""
    with torch.inference_mode():
        return steps_from_q(model.reach(start, goal)[0].double(), model.discount).cpu().numpy()


def _least_steps(recorded: Recorded, start: NDArray[np.int64], goal: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Distance of the positions at the fastest recorded speed [steps]."""
    places, fastest = recorded.positions, recorded.fastest
    if places is None or not fastest:
        return None
    return np.linalg.norm(places[goal].astype(np.float64) - places[start], axis=-1) / fastest


@dataclass(frozen=True)
class ValueCurve:
    """Q^g along an episode that ends in the reward."""

    label: str
    values: NDArray[np.float64]
    """[T + 1] [Q-value]; the reward is that of the last transition."""
    discount: float

    @property
    def ideal(self) -> NDArray[np.float64]:
        """[T] γ^(steps before the rewarded action): the value of following this episode."""
        return np.asarray(q_from_steps(1.0, self.discount)) ** np.arange(len(self.values) - 2, -1, -1)

    @property
    def rho(self) -> float:
        """Spearman's rho of value and time over the last `LAST` steps up to the reward."""
        last = self.values[:-1][-LAST:]
        return rank_correlation(last, np.arange(float(len(last))))

    @property
    def steps_error(self) -> float:
        """Median error of log_γ Q^g as the number of steps left [steps]."""
        read = steps_from_q(torch.from_numpy(self.values[:-1]), self.discount).numpy()
        return float(np.median(np.abs(read - np.arange(len(read) - 1, -1, -1))))


def value_curve(model: LatentModel, label: str, latents: Tensor) -> ValueCurve:
    """Q^g along the latents [T + 1, D] of an episode."""
    with torch.inference_mode():
        return ValueCurve(label, model.value(latents).double().cpu().numpy(), model.discount)


def rewarded_curves(model: LatentModel, recorded: Recorded, count: int = REWARDED) -> list[ValueCurve]:
    """Q^g along the longest rewarded episodes of the dataset, most of which were trained on."""
    store = recorded.store
    rewarded = np.flatnonzero(np.bincount(store.episode_of, weights=store.rewards) > 0)
    longest = rewarded[np.argsort(-store.episode_length[rewarded], kind="stable")][:count]
    curves = []
    for episode in longest:
        first = int(store.episode_start[episode])
        rows = np.arange(first, first + int(store.episode_length[episode]) + 1)
        curves.append(value_curve(model, f"episode {episode} of the data", encode_states(model, recorded.sampler, rows)))
    return curves


@dataclass(frozen=True, kw_only=True)
class ActionValues:
    """Q^g of recorded actions against Q^g of the states that followed; S transitions.

    π^g climbs Q^g over actions, so this shows whether Q^g distinguishes actions. Values along episodes do not show that.
    """

    away: NDArray[np.float64]
    """[S] log_γ Q^g(z, π^g(z)) before the action [steps]."""
    promised: NDArray[np.float64]
    """[S] steps by which Q^g prefers the recorded action to π^g's [steps]."""
    gained: NDArray[np.float64]
    """[S] steps nearer to the goal by Q^g after the next `LED` steps [steps]."""

    def rho(self, far: bool) -> float:
        """Spearman's rho of promise and gain over the farther or the nearer half; NaN below `FEWEST` transitions."""
        half = (self.away > np.median(self.away)) == far if len(self.away) else np.zeros(0, bool)
        if half.sum() < FEWEST:
            return float("nan")
        return rank_correlation(self.promised[half], self.gained[half])


@torch.inference_mode()
def action_values(model: LatentModel, recorded: Recorded, latents: Tensor) -> ActionValues:
    """Values of the recorded actions of the examined episodes; latents [R, D] of `recorded.rows`."""
    actions = recorded.sampler.actions[torch.from_numpy(recorded.rows).to(recorded.sampler.device)]
    values, taken = (steps_from_q(q, model.discount).double().cpu().numpy()
                     for q in (model.value(latents), model.global_q(latents, actions)))
    lengths = [last - first + 1 for first, last in recorded.spans]
    begins = np.cumsum([0, *lengths[:-1]])
    now = np.concatenate([begin + np.arange(max(length - LED, 0)) for begin, length in zip(begins, lengths, strict=True)])
    return ActionValues(away=values[now], promised=values[now] - taken[now], gained=values[now] - values[now + LED])


def real_states_of(model: LatentModel, recorded: Recorded, rng: np.random.Generator, size: int = REAL_STATES) -> RealStates:
    """States of the dataset, drawn uniformly from the episodes that are not examined, or from all if there are no others."""
    rows = np.setdiff1d(np.arange(len(recorded.store.frames)), recorded.rows if recorded.held_out else [])
    if len(rows) == 0:
        rows = recorded.rows
    rows = np.sort(rng.choice(rows, min(size, len(rows)), replace=False))
    return RealStates(source=f"the dataset {recorded.store.dataset_id}", frames=recorded.store.frames[rows],
                      latents=encode_states(model, recorded.sampler, rows).cpu().numpy())
