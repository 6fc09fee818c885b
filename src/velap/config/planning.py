"""Config of the search and of the controller (Tables 8 and 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from velap.config.fields import require

Anchor = Literal["auto", "none", "snap"]
Precision = Literal["float32", "bfloat16"]
NEIGHBOUR_DISTANCE = 3.0
"""d_neigh in upper 5-percentiles of one-step latent distances, Table 8."""
SNAP_GAP = 0.5
"""Where `auto` anchors, most held-out latents lie nearer to the bank than this [one-step distances]. ours: an anchor then
moves a candidate by less than half a step and undoes errors of h that lead nowhere real. Where the bank has wider gaps,
anchors move candidates by as much as a step does."""
RARE_SUCCESS = 0.04
"""Where fewer of the data's episodes succeed than this, edges have no proposer unless the config says so. ours: a policy
that learnt from so few successes proposes nothing better than g does (docs/experiments/2026-11-one-search.md)."""


@dataclass(frozen=True)
class PlannerConfig:
    """Tree search (Algorithm 1, Eq. 6-8, Table 8, App. B.6). Thresholds on Q are given as exponents of γ, as in Table 8."""

    provenance: bool | None = None
    """Edges remember what proposed them and are walked by it; those of g carry a risk. ours; off in `paper`. null: where at
    least 4 % of the data's episodes succeed."""
    n_iter: int = 500
    """Expansions a plan, Table 8 (250 in the other tasks than ButtonWall). Counts candidates, not rounds."""
    n_sim: int = 10
    """Simulated steps an expansion [steps], Table 8 (5 in ObstacleMaze, WindowClose, FaucetClose)."""
    candidates: int = 10
    """K, candidates a round (batch processing, App. B.6, which gives no number). ours; 50 in `paper`."""
    discard_high_exponent: float = 2.0
    """τ_high = γ^this, Table 8: too close to a node of the tree."""
    discard_low_exponent: float | None = 20.0
    """τ_low = γ^this; null reads it as n_sim, Table 8. ours is wider: straight rollouts are exactly n_sim long."""
    neighbour_exponent: float = 3.0
    """τ_neigh = γ^this, Table 8."""
    goal_exponent: float = 5.0
    """τ_goal = γ^this, Table 8."""
    p_sparse: float = 0.4
    """p^sparse, the share of Eq. 6 in P_node. ours: the paper gives no number."""
    p_value: float = 0.4
    """p^value, the share of Eq. 7 in P_node; the rest is uniform. ours: the paper gives no number."""
    p_policy: float = 0.2
    """p^policy: probability that an expansion acts by π^g instead of g. ours: Table 8 leaves it out. No effect with
    `provenance`, where the policies have half of a round."""
    coherent_noise: bool = True
    """Draw the action noise once a simulation instead of once a step (the data are correlated walks). ours; off in
    `paper`."""
    anchor: Anchor = "auto"
    """`snap` moves a candidate to its nearest dataset latent and rejects one that is too far from it. Expansions then crowd
    the node they were made from as neighbours do, since they come to the same few latents, and π^l looks ahead by h. `auto`
    snaps where held-out latents lie within half a one-step distance of the bank. ours; `none` in `paper`."""

    def __post_init__(self) -> None:
        for name in ("n_iter", "n_sim", "candidates"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("p_sparse", "p_value", "p_policy"):
            require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "a probability")
        require(self.p_sparse + self.p_value <= 1 + 1e-9, "p_sparse + p_value", self.p_sparse + self.p_value, "at most 1")
        require(self.anchor in get_args(Anchor), "anchor", self.anchor, f"one of {get_args(Anchor)}")


def has_provenance(config: PlannerConfig, success_share: float) -> bool:
    """Whether edges remember their proposer, for a model of data of which this share of the episodes succeeds."""
    return success_share >= RARE_SUCCESS if config.provenance is None else config.provenance


@dataclass(frozen=True)
class ControllerConfig:
    """MPC loop (Algorithm 2, Table 9)."""

    n_replan: int = 15
    """Environment steps between plans, Table 9 (25 in SpiralMaze, ButtonWall)."""
    stop_exponent: float = 5.0
    """τ_stop = γ^this: π^g takes over, Table 9."""
    waypoint_exponent: float = 3.0
    """τ_wp = γ^this: on to the next waypoint, Table 9."""

    def __post_init__(self) -> None:
        require(self.n_replan >= 1, "n_replan", self.n_replan, "at least 1 step")
