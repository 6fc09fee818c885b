"""Config of the search and of the controller (Tables 8 and 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from velap.config.fields import require

Anchor = Literal["none", "snap"]
Precision = Literal["float32", "bfloat16"]
NEIGHBOUR_DISTANCE = 3.0
"""d_neigh in upper 5-percentiles of one-step latent distances, Table 8."""
HELD_TURN = 8
"""Steps that the held policy and π^g lead in turns, the held policy first [steps]. ours: where one of them stands still the
other seldom does."""


@dataclass(frozen=True)
class PlannerConfig:
    """Tree search (Algorithm 1, Eq. 6-8, Table 8, App. B.6). Thresholds on Q are given as exponents of γ, as in Table 8."""

    n_iter: int = 250
    """Expansions a plan, Table 8 (500 in ButtonWall). Counts candidates, not rounds."""
    n_sim: int = 5
    """Simulated steps an expansion [steps], Table 8 (10 in SpiralMaze, ButtonWall, DrawerButton)."""
    candidates: int = 50
    """K, candidates a round (batch processing, App. B.6, which gives no number)."""
    discard_high_exponent: float = 2.0
    """τ_high = γ^this, Table 8: too close to a node of the tree."""
    discard_low_exponent: float | None = None
    """τ_low = γ^this; null reads it as n_sim, Table 8. ours may widen it: straight rollouts are exactly n_sim long."""
    neighbour_exponent: float = 3.0
    """τ_neigh = γ^this, Table 8."""
    goal_exponent: float = 5.0
    """τ_goal = γ^this, Table 8."""
    p_sparse: float = 0.4
    """p^sparse of the node sampling mixture. ours: the paper gives no number."""
    p_value: float = 0.4
    """p^value of the node sampling mixture; the rest is uniform. ours."""
    p_policy: float = 0.2
    """p^policy: probability that an expansion acts by π^g instead of g. ours: the paper gives no number."""
    expansion_weight: float = 0.0
    """Each expansion made from a node counts as this many neighbours in Eq. 6, so that explored surroundings are left alone.
    ours; 0 in `paper`."""
    coherent_noise: bool = True
    """Draw the action noise once a simulation instead of once a step (the data are correlated walks). ours; off in
    `paper`."""
    anchor: Anchor = "none"
    """`snap` moves a candidate to its nearest dataset latent and rejects one that is too far from it. ours."""

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
    lookahead_gain: float = 1.0
    """Above 1, the actions of the lookahead also compete multiplied by this and clipped to the limits. ours: g and π^l are
    as slow as the data."""
    shortcut_exponent: float = 0.0
    """Above 0, go on to the farthest waypoint with Q_min above γ^this; 0 takes each in turn. ours: trees in open space
    zigzag."""
    residuals: int = 0
    """Last steps of the episode whose prediction errors correct h in lookahead and plans; 0 disables it [steps]. ours."""
    goal_lookahead: int = 0
    """π^g competes with stronger versions of its action, each held for this many simulated steps and judged by Q^g; 0
    disables it [steps]. ours."""
    success_rollout: int = 0
    """Simulate the cloned policy this far at every step; where it reaches a state with Q^g above τ_goal it acts and nothing
    is planned; 0 disables it [steps]. ours: a policy that knows nothing of h hardly meets the errors that a search
    exploits."""
    success_exponent: float = 0.0
    """The cloned policy acts where Q^g is above γ^this, as long as revisits leave the goal near (τ_stop); 0 disables it
    [steps].
    ours: the last steps to a success ask for more than Q^g tells, and what worked is in the data."""
    revisit_penalty: float = 0.0
    """Steps that each state of the episode adds to the goal distance of its surroundings; 0 trusts Q^g [steps]. ours: plans
    and π^g then leave places that promise the goal and do not keep it."""

    def __post_init__(self) -> None:
        require(self.n_replan >= 1, "n_replan", self.n_replan, "at least 1 step")
        for name in ("lookahead", "shortcut_exponent", "residuals", "goal_lookahead", "success_rollout", "revisit_penalty"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        require(self.lookahead_gain >= 1, "lookahead_gain", self.lookahead_gain, "a factor of 1 or more")
        require(0 <= self.success_exponent <= self.stop_exponent, "success_exponent", self.success_exponent,
                "0 to `stop_exponent` steps")
