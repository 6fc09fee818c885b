"""What can be measured of a dataset before any training: actions, scenes, coverage, and from where a success can be reached.

Frames are compared as pictures, shrunk and projected on their main components: no network is known yet. Small things that
matter may be missed, and different lighting may look like another place.

Letters: F frames, E episodes, S sampled episodes, N nodes (sampled frames), A action entries, C components, H×W image [px].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import squareform

from velap.data.frames import FrameStore

LAGS = 10
"""Autocorrelation of actions is measured up to this lag [steps]. ours."""
AT_BOUND = 0.01
"""An action entry is at its bound within this share of its range. ours."""
SAMPLED_EPISODES = 200
"""Episodes whose scenes are compared. ours: some seconds."""
SCENE_FRAMES = 9
"""Frames of an episode that its scene is taken from. ours."""
STILL = 16
"""A pixel is still in an episode where no channel varies by more over its frames [grey levels]. ours: above JPEG's noise."""
CHANGED = 24
"""A still pixel differs between two episodes where a channel's median differs by more [grey levels]. ours."""
SAME_SCENE = 0.005
"""Two episodes show one scene where at most this share of the pixels that are still in both differs. ours: 20 pixels of
64 × 64. By it SpiralMaze has one scene; the other tasks have 40 (FaucetClose) to 118 in 105 contexts."""
FEWEST_STILL = 0.2
"""Scenes are compared where at least this share of the pixels is still. ours: a moving camera leaves none."""
NODES = 12_000
"""Frames that coverage is measured on, at most. ours: some seconds."""
SIDE = 16
"""Side of the frames that are compared [px]. ours: on the shipped tasks 16 × 16 tells places to 1 or 2 cm."""
COMPONENTS = 32
"""C. ours."""
FITTED = 3000
"""Frames that the components are fitted to, and steps that are looked at one by one. ours."""
JUMP = 0.99
"""A step that changes the frame by more than this share of all steps does is a jump. ours."""
NEIGHBOURS = 8
"""Nearest frames of other episodes that a node may go on from. ours."""


@dataclass(frozen=True)
class Actions:
    """How actions are distributed."""

    lowest: np.ndarray
    """float [A] in the data."""
    highest: np.ndarray
    """float [A] in the data."""
    at_bound: np.ndarray
    """float [A] share of the actions at a bound of the entry."""
    constant: np.ndarray
    """bool [A] the entry never varies."""
    autocorrelation: np.ndarray
    """float [LAGS + 1] of lag 0, 1, ..., mean over the entries that vary; NaN beyond the length of the episodes."""


@dataclass(frozen=True)
class Scenes:
    """Which episodes look alike where nothing moves."""

    still: float
    """Share of the pixels that are still in an episode, mean over the sampled ones."""
    episodes: np.ndarray
    """int64 [S] the sampled episodes, in pairs of subsequent ones."""
    labels: np.ndarray
    """int64 [S] number of each one's scene; empty where too few pixels are still."""
    together: float
    """Share of the pairs of subsequent episodes that share a scene; NaN where unknown."""
    backgrounds: np.ndarray
    """uint8 [S, H, W, 3] median frame of each sampled episode."""

    @property
    def count(self) -> int:
        """Scenes among the sampled episodes; 0 where unknown."""
        return len(np.unique(self.labels))


@dataclass(frozen=True)
class Coverage:
    """Where the data are, and how episodes meet."""

    rows: np.ndarray
    """int64 [N] rows of the store: every `stride`-th frame of an episode, and its last one."""
    stride: int
    """[steps]"""
    radius: float
    """Two frames are near where they differ by less: median difference of frames `stride` apart in an episode."""
    plane: np.ndarray
    """float [N, 2] first two components."""
    company: np.ndarray
    """int64 [N] other episodes that come near."""
    joins: np.ndarray
    """float [N] least number of changes from one episode to another on a way to a success; inf where there is no way."""
    failed_joins: np.ndarray
    """float [episodes without success] `joins` of their first frames."""
    start_like: float
    """Share of the successful last frames that are nearer to the first frame of some episode than one step leads; NaN
    without success."""
    start_like_others: float
    """The same of the last frames of the other episodes; NaN where every episode succeeds."""
    jumps: float
    """Share of the successful last steps that change the frame by more than the share `JUMP` of all steps does; NaN without
    success."""

    @property
    def lonely(self) -> float:
        """Share of the nodes that no other episode comes near."""
        return float((self.company == 0).mean())

    @property
    def in_reach(self) -> float:
        """Share of the episodes without success whose start has a way to a success; NaN where all succeed."""
        return float(np.isfinite(self.failed_joins).mean()) if len(self.failed_joins) else float("nan")


@dataclass(frozen=True)
class Survey:
    """All measurements."""

    actions: Actions
    scenes: Scenes
    coverage: Coverage | None
    """None where no frame differs from another."""
    frozen_frames: float
    """Share of subsequent frames that are equal in every pixel."""
    contrast: float
    """Standard deviation of the pixels about their mean over the frame, mean over frames [grey levels]."""


def survey(store: FrameStore, seed: int = 0) -> Survey:
    """Measure a dataset; takes some seconds."""
    rng = np.random.default_rng(seed)
    rows = transitions(store)
    rows = np.sort(rng.choice(rows, min(FITTED, len(rows)), replace=False))
    frozen = (store.frames[rows] == store.frames[rows + 1]).all(axis=(1, 2, 3))
    contrast = store.frames[rows[:: max(1, len(rows) // 500)]].std(axis=(1, 2), dtype=np.float32)
    return Survey(_actions(store), _scenes(store), _coverage(store, _Places(store, rows)), float(frozen.mean()),
                  float(contrast.mean()))


def transitions(store: FrameStore) -> np.ndarray:
    """int64 [transitions of all episodes] rows that an action was taken at."""
    taken = np.ones(len(store.actions), bool)
    taken[store.episode_start + store.episode_length] = False
    return np.flatnonzero(taken)


def _actions(store: FrameStore) -> Actions:
    rows = transitions(store)
    actions = store.actions[rows].astype(np.float64)
    lowest, highest = actions.min(axis=0), actions.max(axis=0)
    margin = AT_BOUND * (store.action_high - store.action_low)
    at_bound = ((actions <= store.action_low + margin) | (actions >= store.action_high - margin)).mean(axis=0)
    constant = highest - lowest <= 1e-6 * np.maximum(1, np.abs(highest))
    return Actions(lowest, highest, at_bound, constant, _autocorrelation(store, rows, actions, ~constant))


def _autocorrelation(store: FrameStore, rows: np.ndarray, actions: np.ndarray, varying: np.ndarray) -> np.ndarray:
    """float [LAGS + 1] mean over the entries `varying` bool [A], about the mean of all episodes."""
    found = np.full(LAGS + 1, np.nan)
    if not varying.any():
        return found
    centred = (actions - actions.mean(axis=0))[:, varying]
    variance = (centred**2).mean(axis=0)
    episode = store.episode_of[rows]
    for lag in range(LAGS + 1):
        same = episode[lag:] == episode[: len(episode) - lag]
        if same.sum() >= 2:
            products = centred[lag:][same] * centred[: len(centred) - lag][same]
            found[lag] = float((products.mean(axis=0) / variance).mean())
    return found


def _sampled_pairs(store: FrameStore) -> np.ndarray:
    """int64 [S] episodes of at least half the median length, evenly spread pairs of subsequent ones: 0 1 20 21 40 41.

    Shorter ones would show as scenery what only had no time to move.
    """
    long_enough = np.flatnonzero(store.episode_length >= np.median(store.episode_length) / 2)
    if len(long_enough) <= SAMPLED_EPISODES:
        return long_enough
    firsts = np.linspace(0, len(long_enough) - 2, SAMPLED_EPISODES // 2).astype(np.int64)
    return long_enough[np.unique(np.concatenate([firsts, firsts + 1]))]


def _scenes(store: FrameStore) -> Scenes:
    """Compare the pixels that are still in two episodes, then cluster the episodes by average linkage."""
    episodes = _sampled_pairs(store)
    medians, still = [], []
    for episode in episodes:
        times = np.unique(np.linspace(0, store.episode_length[episode], SCENE_FRAMES).round().astype(np.int64))
        frames = store.frames[store.episode_start[episode] + times]
        medians.append(np.median(frames, axis=0))
        still.append((frames.max(axis=0).astype(np.int16) - frames.min(axis=0)).max(axis=-1) <= STILL)
    background, is_still = np.stack(medians).astype(np.uint8), np.stack(still)
    share = float(is_still.mean())
    if share < FEWEST_STILL:
        return Scenes(share, episodes, np.zeros(0, np.int64), float("nan"), background)
    levels = np.ascontiguousarray(np.moveaxis(background, -1, 0), np.int16)  # channels first: the largest is found faster
    apart = np.zeros((len(episodes), len(episodes)))
    for number in range(len(episodes) - 1):
        others = slice(number + 1, None)
        both = is_still[number] & is_still[others]
        changed = (np.abs(levels[:, number, None] - levels[:, others]).max(axis=0) > CHANGED) & both
        apart[number, others] = apart[others, number] = changed.sum(axis=(1, 2)) / np.maximum(both.sum(axis=(1, 2)), 1)
    following = np.flatnonzero(np.diff(episodes) == 1)
    together = float((apart[following, following + 1] <= SAME_SCENE).mean()) if len(following) else float("nan")
    labels = np.ones(1, np.int64)
    if len(episodes) > 1:
        labels = fcluster(linkage(squareform(apart, checks=False), "average"), SAME_SCENE, "distance")
    return Scenes(share, episodes, labels.astype(np.int64), together, background)


def _shrunk(frames: np.ndarray) -> np.ndarray:
    """uint8 [*, H, W, 3] → float32 [*, SIDE * SIDE * 3] means of blocks."""
    if min(frames.shape[1:3]) < SIDE:
        return frames.reshape(len(frames), -1).astype(np.float32)
    down, across = (np.linspace(0, side, SIDE + 1).round().astype(np.int64) for side in frames.shape[1:3])
    sums = np.add.reduceat(np.add.reduceat(frames, down[:-1], axis=1, dtype=np.float32), across[:-1], axis=2)
    heights, widths = np.diff(down).astype(np.float32), np.diff(across).astype(np.float32)
    return (sums / (heights[:, None] * widths)[..., None]).reshape(len(frames), -1)


class _Places:
    """Frames as points of C components."""

    def __init__(self, store: FrameStore, rows: np.ndarray) -> None:
        """Fitted to the frames at `rows`."""
        shrunk = _shrunk(store.frames[rows])
        self._mean = shrunk.mean(axis=0)
        centred = shrunk - self._mean
        _, axes = np.linalg.eigh(centred.T @ centred)
        self._axes = axes[:, ::-1][:, :COMPONENTS]

    def of(self, store: FrameStore, rows: np.ndarray) -> np.ndarray:
        """float32 [N, C] points of the frames at rows [N]."""
        chunks = np.array_split(rows, max(1, len(rows) // 2000))
        return np.concatenate([(_shrunk(store.frames[chunk]) - self._mean) @ self._axes for chunk in chunks])


def _nodes(store: FrameStore) -> tuple[np.ndarray, int]:
    """int64 [N] every stride-th frame of each episode and its last one; the stride [steps]."""
    stride = max(1, -(-len(store.frames) // NODES))
    since_start = np.arange(len(store.frames)) - store.first
    chosen = (since_start % stride == 0) | (np.arange(len(store.frames)) == store.last)
    return np.flatnonzero(chosen), stride


def _coverage(store: FrameStore, places: _Places) -> Coverage | None:
    """Neighbours of every node among other episodes, and ways to a success along episodes and across neighbours."""
    rows, stride = _nodes(store)
    points, episode = places.of(store, rows), store.episode_of[rows]
    inside = np.flatnonzero(episode[1:] == episode[:-1])
    ways = np.linalg.norm(points[inside + 1] - points[inside], axis=1)
    if not (ways > 0).any():
        return None
    radius = float(np.median(ways[ways > 0]))
    company, near_from, near_to = _neighbours(points, episode, radius)
    count = len(rows)
    won = np.bincount(store.episode_of, weights=store.rewards) > 0
    goals = np.flatnonzero((rows == store.last[rows]) & won[episode])
    joins = np.full(count, np.inf)
    if len(goals):
        # ways are followed backwards from the successes; csgraph drops edges of weight 0, so a step along costs a little
        little = 1e-4
        backwards = csr_matrix((np.concatenate([np.full(len(inside), little), np.ones(len(near_from))]),
                                (np.concatenate([inside + 1, near_to]), np.concatenate([inside, near_from]))),
                               shape=(count, count))
        joins = np.floor(dijkstra(backwards, indices=goals, min_only=True) + 0.5)
    failed = (rows == store.first[rows]) & ~won[episode]
    return Coverage(rows, stride, radius, points[:, :2], company, joins, joins[failed], *_ends(store, places, won))


def _ends(store: FrameStore, places: _Places, won: np.ndarray) -> tuple[float, float, float]:
    """`start_like`, `start_like_others` and `jumps` of the episodes `won` bool [E] and the others, FITTED at most."""
    steps = transitions(store)
    steps = steps[:: max(1, len(steps) // FITTED)]
    ways = np.linalg.norm(places.of(store, steps + 1) - places.of(store, steps), axis=1)
    one_step = float(np.median(ways[ways > 0])) if (ways > 0).any() else 0.0
    usual = float(np.quantile(ways, JUMP))
    starts = places.of(store, store.episode_start[:: max(1, store.n_episodes // FITTED)])
    ends = store.episode_start + store.episode_length

    def like_starts(rows: np.ndarray) -> float:
        rows = rows[:: max(1, len(rows) // FITTED)]
        return float((_least_distance(places.of(store, rows), starts) < one_step).mean()) if len(rows) else float("nan")

    last = ends[won]
    jumps = float("nan")
    if len(last):
        jumps = float((np.linalg.norm(places.of(store, last) - places.of(store, last - 1), axis=1) > usual).mean())
    return like_starts(last), like_starts(ends[~won]), jumps


def _squared_distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """float32 [n, m] between points [n, C] and others [m, C]."""
    return (points**2).sum(1)[:, None] + (others**2).sum(1) - 2 * points @ others.T


def _least_distance(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """float [n] distance of each point [n, C] to the nearest of others [m, C]."""
    chunks = np.array_split(points, max(1, len(points) // 500))
    return np.sqrt(np.concatenate([_squared_distances(chunk, others).min(axis=1) for chunk in chunks]).clip(0))


def _neighbours(points: np.ndarray, episode: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Other episodes that come within `radius` of each point, int64 [N]; pairs (from, to) of near points, nearest first."""
    company, firsts = np.zeros(len(points), np.int64), np.flatnonzero(np.diff(episode, prepend=-1))
    froms, tos = [], []
    for block in np.array_split(np.arange(len(points)), max(1, len(points) // 500)):
        squares = _squared_distances(points[block], points)
        squares[episode[block][:, None] == episode] = np.inf
        company[block] = np.logical_or.reduceat(squares < radius**2, firsts, axis=1).sum(axis=1)
        kept = min(NEIGHBOURS, squares.shape[1] - 1)
        nearest = np.argpartition(squares, kept, axis=1)[:, :kept]
        is_near = np.take_along_axis(squares, nearest, 1) < radius**2
        froms.append(np.repeat(block, kept)[is_near.reshape(-1)])
        tos.append(nearest.reshape(-1)[is_near.reshape(-1)])
    return company, np.concatenate(froms), np.concatenate(tos)
