"""Config of the search and of the controller (Tables 8 and 9), parts of `velap.config.Config`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from velap.config.training import require

Anchor = Literal["none", "snap"]


@dataclass(frozen=True)
class PlannerConfig:
    """Tree search (Algorithm 1, Eq. 6-8, Table 8, App. B.6). Thresholds on Q are given as exponents of γ, as in Table 8."""

    n_iter: int = 250
    """Expansions a plan, Table 8 (500 in ButtonWall). Counts candidates, not rounds."""
    n_sim: int = 5
    """Simulated steps an expansion [steps], Table 8 (10 in SpiralMaze, ButtonWall, DrawerButton)."""
    candidates: int = 50
    """K, candidates a round (batch processing, App. B.6). ours: the paper gives no number; 50 plan as well as 25 and in
    three quarters of the time."""
    discard_high_exponent: float = 2.0
    """τ_high = γ^this, Table 8: too close to a node of the tree."""
    discard_low_exponent: float | None = None
    """τ_low = γ^this; None reads it as n_sim, Table 8. ours may widen it: straight rollouts are exactly n_sim long."""
    discard_std: float | None = None
    """τ_std [Q-value]; None reads it as 1 - γ, Table 8."""
    neighbour_exponent: float = 3.0
    """τ_neigh = γ^this, Table 8."""
    goal_exponent: float = 5.0
    """τ_goal = γ^this, Table 8."""
    neighbour_distance_factor: float = 3.0
    """d_neigh is this times the upper 5-percentile of one-step latent distances, Table 8."""
    p_sparse: float = 0.4
    """p^sparse of the node sampling mixture. ours: the paper gives no number."""
    p_value: float = 0.4
    """p^value of the node sampling mixture; the rest is uniform. ours."""
    temperature_sparse: float = 1.0
    """T_sparse of Eq. 6 [neighbours]. ours."""
    expansion_weight: float = 0.0
    """An expansion made from a node crowds it like this many neighbours in Eq. 6, so that a node whose surroundings are
    explored is left alone. ours; 0 in `paper`."""
    temperature_value: float = 0.1
    """T_value of Eq. 7 [Q-value]. ours."""
    p_policy: float = 0.2
    """p^policy: an expansion acts by π^g instead of g. ours: the paper gives no number."""
    coherent_noise: bool = True
    """Draw the action noise once a simulation instead of once a step (the data are correlated walks). ours; off in
    `paper`."""
    anchor: Anchor = "none"
    """`snap` moves a candidate to its nearest dataset latent and rejects one farther from it than `ANCHOR_FACTOR`. ours."""

    def __post_init__(self) -> None:
        for name in ("n_iter", "n_sim", "candidates"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("temperature_sparse", "temperature_value", "neighbour_distance_factor"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
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
    """π^l competes with sampled actions, each held for this many simulated steps and judged by Q_min to the waypoint; 0 acts
    by π^l alone [steps]. ours: π^l pushes into walls at corners that h knows of; 0 in `paper`."""
    shortcut_exponent: float = 0.0
    """On to the farthest waypoint with Q_min above γ^this, whatever lies between; 0 takes each in turn. ours: trees in open
    space zigzag, but a shortcut may cut corners."""
    residuals: int = 0
    """Last steps of the episode whose prediction errors correct h in lookahead and plans; 0 trusts h [steps]. ours."""
    lookahead_gain: float = 1.0
    """All actions of the lookahead compete with themselves times this, cut to the limits, as well; 1 has none. ours: g and
    π^l are as slow as the data."""
    goal_lookahead: int = 0
    """π^g competes with stronger versions of its action, each held for this many simulated steps and judged by Q^g; 0 acts
    by π^g alone [steps]. ours."""
    success_rollout: int = 0
    """At every step the policy cloned from successes (`success_policy`) is simulated this far; where it gets to a node with
    Q^g above τ_goal, it acts and nothing is planned; 0 has none [steps]. ours: errors of h that a search exploits, a policy
    that knows nothing of h hardly meets."""
    held_turn: int = 0
    """The policy of `held_policy` and π^g lead in turns of so many steps, that one first; 0 never lets π^g lead beside it
    [steps]. ours: where one of them stands still the other seldom does."""
    success_exponent: float = 0.0
    """The policy cloned from successes acts where Q^g is above γ^this, as long as revisits do not say otherwise (τ_stop); 0
    has none [steps]. ours: the last steps to a success ask for more than Q^g tells, and what worked is in the data."""
    revisit_penalty: float = 0.0
    """Every state that the episode has been in moves the goal away from its surroundings by this [steps]; 0 trusts Q^g.
    ours: plans and π^g then leave places that promise the goal and do not keep it."""

    def __post_init__(self) -> None:
        require(self.n_replan >= 1, "n_replan", self.n_replan, "at least 1 step")
        require(self.residuals >= 0, "residuals", self.residuals, "0 or more steps")
        require(self.shortcut_exponent >= 0, "shortcut_exponent", self.shortcut_exponent, "0 or more")
        require(self.lookahead >= 0, "lookahead", self.lookahead, "0 or more steps")
        require(self.success_rollout >= 0, "success_rollout", self.success_rollout, "0 or more steps")
        require(self.held_turn >= 0, "held_turn", self.held_turn, "0 or more steps")
        require(0 <= self.success_exponent <= self.stop_exponent, "success_exponent", self.success_exponent,
                "0 to `stop_exponent` steps")
        require(self.goal_lookahead >= 0, "goal_lookahead", self.goal_lookahead, "0 or more steps")
        require(self.lookahead_gain >= 1, "lookahead_gain", self.lookahead_gain, "a factor of 1 or more")
        require(self.revisit_penalty >= 0, "revisit_penalty", self.revisit_penalty, "0 or more steps")

