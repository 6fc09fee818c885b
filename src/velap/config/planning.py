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


@dataclass(frozen=True)
class PlannerConfig:
    """Tree search (Algorithm 1, Eq. 6-8, Table 8, App. B.6). Thresholds on Q are given as exponents of γ, as in Table 8."""

    provenance: bool = True
    """Edges remember what proposed them and are walked by it; those of g carry a risk. ours; off in `paper`."""
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
    p_sparse: float = 0.9
    """p^sparse of the node sampling mixture. ours: the paper gives no number; 0.4 in `paper`."""
    p_value: float = 0.1
    """p^value of the node sampling mixture; the rest is uniform. ours; 0.4 in `paper`."""
    p_policy: float = 0.2
    """p^policy: probability that an expansion acts by π^g instead of g. ours: Table 8 leaves it out. No effect with
    `provenance`, where the policies have half of a round."""
    expansion_weight: float = 1.0
    """Each expansion made from a node counts as this many neighbours in Eq. 6, so that explored surroundings are left alone.
    ours; 0 in `paper`."""
    coherent_noise: bool = True
    """Draw the action noise once a simulation instead of once a step (the data are correlated walks). ours; off in
    `paper`."""
    anchor: Anchor = "auto"
    """`snap` moves a candidate to its nearest dataset latent and rejects one that is too far from it; `auto` snaps where
    held-out latents lie within half a one-step distance of the bank. ours; `none` in `paper`."""

    def __post_init__(self) -> None:
        for name in ("n_iter", "n_sim", "candidates"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        require(self.expansion_weight >= 0, "expansion_weight", self.expansion_weight, "a weight of 0 or more")
        for name in ("p_sparse", "p_value", "p_policy"):
            require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "a probability")
        require(self.p_sparse + self.p_value <= 1 + 1e-9, "p_sparse + p_value", self.p_sparse + self.p_value, "at most 1")
        require(self.anchor in get_args(Anchor), "anchor", self.anchor, f"one of {get_args(Anchor)}")


@dataclass(frozen=True)
class ControllerConfig:
    """MPC loop (Algorithm 2, Table 9)."""

    n_replan: int = 15
    """Environment steps between plans, Table 9 (25 in SpiralMaze, ButtonWall)."""
    stop_exponent: float = 5.0
    """τ_stop = γ^this: π^g takes over, Table 9."""
    waypoint_exponent: float = 3.0
    """τ_wp = γ^this: on to the next waypoint, Table 9."""
    lookahead: int = 3
    """π^l competes with actions sampled from g, each held for this many simulated steps and judged by Q_min to the waypoint;
    0 acts by π^l alone [steps]. ours: π^l pushes into walls at corners that h knows of; 0 in `paper`."""
    lookahead_gain: float = 2.0
    """Above 1, the actions of the lookahead also compete multiplied by this and clipped to the limits. ours: g and π^l are
    as slow as the data; 1 in `paper`."""

    def __post_init__(self) -> None:
        require(self.n_replan >= 1, "n_replan", self.n_replan, "at least 1 step")
        require(self.lookahead >= 0, "lookahead", self.lookahead, "0 or more steps")
        require(self.lookahead_gain >= 1, "lookahead_gain", self.lookahead_gain, "a factor of 1 or more")
