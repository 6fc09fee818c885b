"""Config of a training: what all phases share (Eq. 2-5, Table 7), and the phases in their order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

from velap.config.fields import require

CriticLoss = Literal["mse", "cross_entropy"]
DynamicsLoss = Literal["infonce", "mse"]
DYNAMICS_HORIZON = 3
"""k of Eq. 9 [steps], App. B.5."""
DISTIL_STEPS = 3_000
"""Updates after an ensemble's own that teach its median to one policy [steps]. ours."""


@dataclass(frozen=True)
class Phase:
    """One phase of a training: so many updates by one objective."""

    name: ClassVar[str]
    """Kind of the phase in saved configs."""
    frozen: ClassVar[bool] = True
    """The phase works on latents of a frozen encoder."""

    steps: int
    """Updates [steps]. ours: the paper gives no number."""

    def __post_init__(self) -> None:
        require(self.steps >= 1, f"{self.name}.steps", self.steps, "at least 1; leave the phase out instead of 0")

    @property
    def label(self) -> str:
        """How settings and progress call this phase."""
        return self.name

    @property
    def updates(self) -> int:
        """Updates of the phase with all that belongs to it [steps]."""
        return self.steps

    def stage(self, done: int) -> str:
        """How progress calls update number `done`."""
        return self.label

    def _at_least(self, least: float, *names: str) -> None:
        for name in names:
            require(getattr(self, name) >= least, f"{self.name}.{name}", getattr(self, name), f"{least} or more")


@dataclass(frozen=True)
class _Sampled(Phase):
    """A phase whose batches are windows of the data."""

    rewarded_share: float = 0.05
    """Share of windows drawn to hold a rewarded transition, beyond chance. ours: an encoder has to see rewards to tell them
    apart; afterwards a share makes states that look rewarded too valuable. 0 in `paper`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 <= self.rewarded_share <= 1, f"{self.name}.rewarded_share", self.rewarded_share, "a share from 0 to 1")


@dataclass(frozen=True)
class EncoderPhase(Phase):
    """φ alone, on pairs of states: what the actions between them were, and what either looks like (ours: the losses of Eq. 2
    leave out where exactly a hand or a handle is)."""

    name: ClassVar[str] = "encoder"
    frozen: ClassVar[bool] = False

    pairs: int = 64
    """Pairs of states a batch. ours."""
    inverse: float = 0.3
    """Weight of the inverse model's error beside the reconstruction of both states. ours."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least(1, "pairs")
        self._at_least(0, "inverse")


@dataclass(frozen=True)
class JointPhase(_Sampled):
    """Sec. 4: φ, h and the critics by Eq. 2, the policies by Eq. 5 in turn."""

    name: ClassVar[str] = "joint"
    frozen: ClassVar[bool] = False

    c1: float = 0.01
    """Weight of the dynamics loss, Eq. 2, Table 7 (0.001 in SpiralMaze)."""
    dynamics_loss: DynamicsLoss = "infonce"
    """L_h of Eq. 2: Eq. 9, or the mean-squared error that App. E.3 compares with."""
    windows: int = 24
    """Windows of consecutive frames a batch. Table 7: 64 transitions, hence 64 windows in `paper`."""
    window: int = 20
    """Transitions of a window that train the values [steps]. ours: overlapping transitions share encoded frames. 1 in
    `paper`: a window then holds the k steps of Eq. 9 and its first transition trains the values."""
    reconstruction_side: int = 0
    """Side of the shrunk frames that φ is to reconstruct besides Eq. 2; 0 disables it [px]. ours: Eq. 2 asks the latent only
    for what a step or a value depends on here and now."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least(1, "windows", "window")
        self._at_least(0, "c1")
        require(self.dynamics_loss in get_args(DynamicsLoss), "joint.dynamics_loss", self.dynamics_loss,
                f"one of {get_args(DynamicsLoss)}")
        require(self.window == 1 or self.window >= DYNAMICS_HORIZON, "joint.window", self.window,
                f"1, or at least the {DYNAMICS_HORIZON} steps of Eq. 9")
        require(0 <= self.reconstruction_side <= 64, "joint.reconstruction_side", self.reconstruction_side, "0 to 64 px")


@dataclass(frozen=True)
class LatentPhase(_Sampled):
    """h by its mean-squared rollout error, critics, policies and g as before, on frozen latents (ours)."""

    name: ClassVar[str] = "latent"

    horizon: int = 5
    """Rollout length of h [steps]. ours."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least(1, "horizon")


@dataclass(frozen=True)
class ValuePhase(_Sampled):
    """Critics, policies and g alone, on frozen latents (ours: values a hundred steps from the goal take thousands of
    updates, and h's rollouts would cost most of them)."""

    name: ClassVar[str] = "values"


@dataclass(frozen=True)
class EnsemblePhase(Phase):
    """Several π^g with critics of their own, on frozen latents; the model's policy then learns their median (ours: where
    data are thin, what one policy does is luck)."""

    name: ClassVar[str] = "ensemble"

    members: int = 4
    """Policies. ours."""
    noise: float = 0.0
    """Gaussian noise on the latents that members learn from, in deviations of each dimension. ours: φ mistakes places in
    scenes that it has not seen."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least(1, "members")
        self._at_least(0, "noise")

    @property
    def updates(self) -> int:
        """Updates of the members, and of what they teach [steps]."""
        return self.steps + DISTIL_STEPS

    def stage(self, done: int) -> str:
        """The members learn, then they teach."""
        return self.label if done < self.steps else f"{self.label} distil"


@dataclass(frozen=True)
class ClonePhase(Phase):
    """A policy cloned from successful episodes, as BC(D*) of App. D.1 but beside π^g in the model (ours)."""

    name: ClassVar[str] = "clone"

    candidates: int = 1
    """Policies that share the updates one after the other; the one that reaches the goal most often by h and Q^g is kept.
    ours: where a clone goes from states unlike the successes is luck."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least(1, "candidates")


PHASES: dict[str, type[Phase]] = {
    phase.name: phase for phase in (EncoderPhase, JointPhase, LatentPhase, ValuePhase, EnsemblePhase, ClonePhase)
}
"""Kinds of phases by name."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    phases: tuple[Phase, ...] = (JointPhase(4_000), LatentPhase(4_000))
    """What is learnt, in this order."""
    discount: float = 0.96
    """γ, Table 7."""
    c0: float = 0.2
    """Weight of the global critic's loss, Eq. 2, Table 7."""
    c2: float = 0.001
    """Weight of imitation in the local policy, Eq. 5, Table 7."""
    c3: float = 0.001
    """Weight of imitation in the global policy, Eq. 5, Table 7 (0.5 where experts are in the data)."""
    critic_loss: CriticLoss = "mse"
    """Loss of the critics: Eq. 3 and 4, or the cross entropy of bounded ones; policies then gain by Q relative to its own
    size.
    ours: squared errors of far states' values, hundredths, teach nothing."""
    critic_floor: float = 0.0
    """Above 0, a transition counts in the global critics' cross entropy by 1 / (target + this) [Q-value]. ours: far from the
    goal Q and its errors are small, but actions there are chosen by them."""
    target_rate: float = 0.05
    """Polyak rate of the target networks. ours: TD3's 0.005, used in `paper`, costs thousands of updates."""
    policy_every: int = 2
    """Model updates per policy update. ours (TD3's delay); 1 in `paper`, the alternation of Eq. 2 and 5."""
    group_windows: int = 1
    """Windows of a batch from episodes recorded near each other, which tend to share a scene; 1 draws each alone. ours:
    goals of other trajectories (strategy c of B.4) then teach what is near within a scene."""
    group_reach: int = 8
    """Largest distance of a group's episodes in the recording from its first [episodes]. ours."""
    log_every: int = 50
    """Updates between logged losses [steps]. ours."""
    checkpoint_every: int = 500
    """Updates between saved states [steps]. ours."""

    def __post_init__(self) -> None:
        require(len(self.phases) > 0, "phases", self.phases, "at least one phase")
        order = [phase.frozen for phase in self.phases]
        require(order == sorted(order), "phases", [phase.name for phase in self.phases],
                "phases that train the encoder before those on frozen latents")
        labels = [phase.label for phase in self.phases]
        require(len(set(labels)) == len(labels), "phases", labels, "each kind of phase once")
        for name in ("policy_every", "group_windows", "group_reach", "log_every", "checkpoint_every"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("c0", "c2", "c3"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a weight of 0 or more")
        require(0 < self.discount < 1, "discount", self.discount, "a number between 0 and 1")
        require(0 < self.target_rate <= 1, "target_rate", self.target_rate, "a rate in (0, 1]")
        require(self.critic_loss in get_args(CriticLoss), "critic_loss", self.critic_loss, f"one of {get_args(CriticLoss)}")
        require(0 <= self.critic_floor <= 1 and (self.critic_floor == 0 or self.critic_loss == "cross_entropy"),
                "critic_floor", self.critic_floor, "0 to 1, and 0 where `critic_loss` is not 'cross_entropy'")

    @property
    def steps(self) -> int:
        """Updates of all phases [steps]."""
        return sum(phase.updates for phase in self.phases)

    @property
    def clones(self) -> bool:
        """The model has a policy cloned from successes."""
        return any(isinstance(phase, ClonePhase) for phase in self.phases)
