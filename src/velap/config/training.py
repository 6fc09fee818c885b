"""Frozen configuration of the training (Table 7 and ours); `velap.config` holds the other parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from velap.errors import ConfigError

DynamicsLoss = Literal["infonce", "mse"]
CriticLoss = Literal["mse", "cross_entropy"]
Precision = Literal["float32", "bfloat16"]


def require(condition: bool, field_name: str, got: object, expected: str) -> None:
    """Raise ConfigError for a field that got something else than expected."""
    if not condition:
        raise ConfigError(f"config field `{field_name}` is {got!r}; expected {expected}. Change that field and start again.")


@dataclass(frozen=True)
class TrainConfig:
    """Joint training (Eq. 2-5, 9; Table 7; App. B.4, B.5) and the latent phase (ours)."""

    encoder_steps: int = 0
    """Updates of the encoder alone before the joint phase, on pairs of states; 0 has none [steps]. ours: the losses of Eq. 2
    leave out where exactly a hand or a handle is."""
    encoder_pairs: int = 64
    """Pairs a batch of the encoder phase, drawn from all over the data. ours."""
    encoder_learning_rate: float = 1e-3
    """Peak learning rate of the encoder phase, cosine to a hundredth. ours."""
    inverse: float = 0.3
    """Weight of the summed actions between two states beside the reconstruction of both, in the encoder phase. ours."""
    joint_steps: int = 4_000
    """Model updates of the joint phase [steps]. ours: the paper gives no number."""
    batch_windows: int = 24
    """Windows of consecutive frames a batch. Table 7: 64 transitions, so 64 windows with `whole_windows` off."""
    window: int = 20
    """Transitions a window [steps]. ours; `dynamics_horizon` in `paper`, where only the first transition trains the
    values."""
    whole_windows: bool = True
    """Every transition of a window trains the values, and goals come from the encoded frames. ours; off in `paper`."""
    value_transitions: int = 96
    """Transitions of a batch of whole windows that train values and policies, drawn at random; 0 takes all. ours: beyond a
    hundred or so, more frames teach more than more transitions of the same frames."""
    dynamics_rollouts: int = 96
    """Rollouts of h a batch of whole windows, their starts drawn at random; 0 starts one wherever k steps are left. ours."""
    learning_rate: float = 3e-4
    """Table 7, Adam."""
    c0: float = 0.2
    """Weight of the global critic's loss, Eq. 2, Table 7."""
    c1: float = 0.01
    """Weight of the dynamics loss, Eq. 2, Table 7 (0.001 in SpiralMaze)."""
    reconstruction: float = 0.0
    """Weight of the reconstruction loss of the joint phase; 0 has none. ours: Eq. 2 asks the latent only for what a step or
    a value depends on here and now, and far parts of a scene may go missing; the paper does without."""
    reconstruction_side: int = 16
    """Side of the shrunk frames that are reconstructed [px]. ours: what the far end of a scene looks like, or where exactly
    a handle is."""
    c2: float = 0.001
    """Weight of imitation in the local policy, Eq. 5, Table 7."""
    c3: float = 0.001
    """Weight of imitation in the global policy, Eq. 5, Table 7 (0.5 where experts are in the data)."""
    discount: float = 0.96
    """γ, Table 7."""
    temperature: float = 1.0
    """T of the InfoNCE similarity, App. B.5, Table 7."""
    kl_weight: float = 0.01
    """β of the action cVAE, Table 4."""
    dynamics_horizon: int = 3
    """k of Eq. 9 [steps], App. B.5."""
    dynamics_loss: DynamicsLoss = "infonce"
    """Loss of h in the joint phase: Eq. 9, or mean-squared error (App. E.3's comparison)."""
    critic_loss: CriticLoss = "mse"
    """Loss of the critics: Eq. 3 and 4, or the cross entropy of bounded ones. ours: squared errors of far states' values,
    hundredths, teach nothing."""
    critic_floor: float = 0.0
    """With more than 0, a transition counts in the cross entropy of the global critics by 1 / (its target + this); 0 counts
    all alike [Q-value]. ours: Q far from the goal is small and its errors are too, but an action there is chosen by them."""
    policy_relative: bool = False
    """The policies gain by Q in its own size instead of Q (Eq. 5). ours: far from the goal Q is small, and imitation would
    be all that counts."""
    relabel_next: float = 0.2
    """Share of goals that are the next state (strategy a of B.4). ours: the paper gives no shares."""
    relabel_future: float = 0.4
    """Share of goals from the future of the same trajectory (strategy b). ours."""
    relabel_other: float = 0.4
    """Share of goals from other trajectories (strategy c). ours."""
    group_windows: int = 1
    """Windows of a batch that come from episodes recorded near each other, which tend to share a scene; 1 draws all apart.
    ours: goals of other trajectories (strategy c) then teach what is near within a scene, not only to tell scenes apart."""
    group_reach: int = 8
    """Largest distance of the episodes of a group in the recording from its first [episodes]. ours."""
    rewarded_share: float = 0.05
    """Share of windows drawn to hold a rewarded transition, beyond chance. ours; 0 in `paper`."""
    target_rate: float = 0.05
    """Polyak rate of the target networks. ours: values of unreachable goals fall by γ a target update, so a slow one costs
    thousands of updates; TD3's 0.005 in `paper`, which is silent."""
    policy_every: int = 2
    """Model updates a policy update. ours (TD3's delay); 1 in `paper`, the alternation of Eq. 2 and 5."""
    heads_afresh: bool = False
    """The joint phase teaches the encoder alone: it sees no commands (`command_memory`), and h, critics, policies and g
    start from new weights on the frozen latents. ours: what learnt to do without commands does not take them up later,
    and an encoder that learns beside them sees less."""
    latent_steps: int = 4_000
    """Updates of the latent phase: encoder frozen, all latents cached. ours; 0 in `paper`."""
    latent_horizon: int = 5
    """Rollout length of the dynamics in the latent phase [steps]. ours."""
    latent_rewarded_share: float | None = None
    """`rewarded_share` of the latent phase; None takes that one. ours: an encoder has to see rewards to tell them apart, but
    a share beyond chance makes states that look like rewarded ones too valuable."""
    latent_value_steps: int = 0
    """Updates of critics, policies and g alone after the latent phase, on cached latents; 0 has none [steps]. ours: values a
    hundred steps from the goal take thousands of updates, and h's rollouts would cost most of them."""
    member_steps: int = 0
    """Updates of `members` π^g with critics of their own after the values, on cached latents; 0 has none [steps]. ours:
    where the data are thin, what one policy does is luck; the median of several is less so."""
    members: int = 4
    """Those policies. ours."""
    member_noise: float = 0.0
    """Gaussian noise on the latents that the members learn from, in deviations of each dimension. ours: φ mistakes places
    in scenes that it has not seen."""
    distil_steps: int = 0
    """Updates that teach the members' median action and mean value to the model's π^g and Q^g [steps]. ours."""
    held_steps: int = 0
    """Updates of members whose transitions are of `HELD_ACTIONS` steps, for the policy of `held_policy`, which then learns
    their median for `distil_steps`; 0 has none [steps]. ours: which way to go a hundred steps from the goal is easier to
    tell by several steps than by one."""
    clone_steps: int = 0
    """Updates of the last phase, on cached latents too: the policy of `success_policy` is cloned from the transitions of
    successful episodes; 0 has none [steps]. ours."""
    clone_candidates: int = 1
    """Policies that share those updates, one after the other from weights of their own; the one is kept that gets to the
    goal most often by h and Q^g from far states of the data. ours: where a clone goes from states unlike the successes is
    luck."""
    clone_reach: int = 0
    """Only the last so many steps before a success are cloned; 0 clones all of a successful episode [steps]. ours: the way
    there is a random walk's as often as an expert's, its end is what worked."""
    holdout_episodes: int = 16
    """Unrewarded episodes kept out of training for the diagnostics. ours."""
    latent_learning_rate: float = 1e-3
    """Peak learning rate of the latent phase, cosine to a hundredth. ours."""
    precision: Precision = "bfloat16"
    """Arithmetic of the encoder's convolutions. ours: 2.4 times the frames/s of float32 on a CPU with bf16 units."""
    log_every: int = 50
    """Model updates between logged losses [steps]. ours."""
    diagnose_every: int = 1_000
    """Model updates between rollout-error and calibration diagnostics [steps]. ours."""
    checkpoint_every: int = 500
    """Model updates between checkpoints [steps]. ours."""

    def __post_init__(self) -> None:
        later = ("latent_steps", "latent_value_steps", "member_steps", "distil_steps", "held_steps", "clone_steps",
                 "clone_reach")
        for name in ("encoder_steps", "joint_steps", *later, "value_transitions", "dynamics_rollouts"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        for name in (
            "encoder_pairs",
            "batch_windows",
            "window",
            "dynamics_horizon",
            "policy_every",
            "group_windows",
            "group_reach",
            "latent_horizon",
            "members",
            "clone_candidates",
            "log_every",
            "diagnose_every",
            "checkpoint_every",
        ):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("encoder_learning_rate", "learning_rate", "latent_learning_rate", "temperature"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        for name in ("inverse", "c0", "c1", "reconstruction", "c2", "c3", "kl_weight"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a weight of 0 or more")
        require(1 <= self.reconstruction_side <= 64, "reconstruction_side", self.reconstruction_side, "1 to 64 px")
        require(self.member_noise >= 0, "member_noise", self.member_noise, "0 or a positive number of deviations")
        taught = self.member_steps > 0 or self.held_steps > 0
        require((self.distil_steps > 0) == taught, "distil_steps", self.distil_steps,
                "at least 1 where `member_steps` or `held_steps` is set, and 0 where neither is")
        require(0 < self.discount < 1, "discount", self.discount, "a number between 0 and 1")
        for name in ("rewarded_share", "latent_rewarded_share"):
            share = getattr(self, name)
            require(share is None or 0 <= share <= 1, name, share, "a share from 0 to 1")
        require(0 < self.target_rate <= 1, "target_rate", self.target_rate, "a rate in (0, 1]")
        shares = self.relabel_next + self.relabel_future + self.relabel_other
        require(
            min(self.relabel_next, self.relabel_future, self.relabel_other) >= 0 and abs(shares - 1) < 1e-6,
            "relabel_next, relabel_future, relabel_other",
            (self.relabel_next, self.relabel_future, self.relabel_other),
            "three shares of 0 or more that add up to 1",
        )
        require(
            self.dynamics_loss in get_args(DynamicsLoss),
            "dynamics_loss",
            self.dynamics_loss,
            f"one of {get_args(DynamicsLoss)}",
        )
        require(
            self.window >= self.dynamics_horizon,
            "window",
            self.window,
            f"at least dynamics_horizon = {self.dynamics_horizon} steps",
        )
        require(self.precision in get_args(Precision), "precision", self.precision, f"one of {get_args(Precision)}")
        require(
            self.critic_loss in get_args(CriticLoss), "critic_loss", self.critic_loss, f"one of {get_args(CriticLoss)}"
        )
        require(
            0 <= self.critic_floor <= 1 and (self.critic_floor == 0 or self.critic_loss == "cross_entropy"),
            "critic_floor",
            self.critic_floor,
            "0 to 1, and 0 where `critic_loss` is not 'cross_entropy'",
        )

    @property
    def steps(self) -> int:
        """Updates of all phases [steps]."""
        return sum(steps for _, steps in self.phases)

    @property
    def phases(self) -> tuple[tuple[str, int], ...]:
        """Name and updates of every phase, in their order; all after `joint` work on a frozen encoder [steps]."""
        return (
            ("encoder", self.encoder_steps),
            ("joint", self.joint_steps),
            ("latent", self.latent_steps),
            ("values", self.latent_value_steps),
            ("members", self.member_steps),
            ("distil", self.distil_steps if self.member_steps else 0),
            ("held", self.held_steps),
            ("held_distil", self.distil_steps if self.held_steps else 0),
            ("clone", self.clone_steps),
        )
