"""Frozen configuration. Each default cites the table of the paper it comes from, or says `ours`.

`paper` presets hold Tables 2-10 and nothing else; `default` presets hold whatever was measured to be best
(`docs/decisions.md` says what was measured). `tasks.py` applies the per-task overrides.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any, Literal, get_args, get_origin, get_type_hints

from velap.errors import ConfigError

Norm = Literal["batch", "layer", "none"]
DynamicsLoss = Literal["infonce", "mse"]
CriticLoss = Literal["mse", "cross_entropy"]
Anchor = Literal["none", "reject", "snap"]
Precision = Literal["float32", "bfloat16"]


def _require(condition: bool, field_name: str, got: object, expected: str) -> None:
    if not condition:
        raise ConfigError(f"config field `{field_name}` is {got!r}; expected {expected}. Change that field and start again.")


@dataclass(frozen=True)
class ModelConfig:
    """Networks of App. B.1."""

    frame_stack: int = 3
    """Frames a state N [frames]. ours: the paper leaves N open for the simulated tasks and uses 3 on hardware (E.1)."""
    latent_dim: int = 32
    """d_Z, Table 7."""
    norm: Norm = "layer"
    """Normalisation of hidden layers. Tables 2-6: batch. ours: layer, no train/eval gap and no batch statistics in
    targets."""
    encoder_filters: tuple[int, ...] = (32, 32, 64, 64)
    """Table 2."""
    encoder_kernels: tuple[int, ...] = (4, 4, 4, 4)
    """Table 2 [px]."""
    encoder_strides: tuple[int, ...] = (2, 2, 2, 2)
    """Table 2 [px]."""
    encoder_dense: tuple[int, ...] = (256, 128)
    """Table 2, hidden dense layers; the last one has `latent_dim` units."""
    dynamics_dense: tuple[int, ...] = (128, 128, 128, 128)
    """Table 3, hidden layers."""
    dynamics_residual: bool = True
    """h predicts z + f(z, a) instead of f(z, a). ours: Table 3 is silent; off in `paper`."""
    generative_dense: tuple[int, ...] = (128, 128, 128)
    """Table 4, hidden layers of both halves of the action cVAE."""
    noise_dim: int = 16
    """m, latent dimension of the action cVAE, Table 4."""
    policy_dense: tuple[int, ...] = (128, 128, 128)
    """Table 5, hidden layers."""
    critic_dense: tuple[int, ...] = (128, 128, 128)
    """Table 6, hidden layers."""
    critic_bounded: bool = True
    """Critics end in a sigmoid: returns of a terminal 0/1 reward lie in [0, 1]. ours; off in `paper`."""
    n_ens: int = 3
    """Members of the local ensemble, Table 7."""
    n_global: int = 2
    """Members of the global critic, of which the minimum counts (TD3's two). ours; 1 in `paper`: Eq. 4 has no minimum."""
    success_policy: bool = False
    """A policy cloned from successful episodes beside π^g, as BC(D*) of D.1 but in the model. ours; off in `paper`."""
    latent_norm: bool = False
    """Latents are normalised to zero mean and unit variance over their dimensions. ours; off in `paper`."""
    bank_size: int = 4096
    """Dataset latents kept with the model for support tests and film strips; 0 keeps none. ours; 0 in `paper`."""

    def __post_init__(self) -> None:
        _require(1 <= self.frame_stack <= 16, "frame_stack", self.frame_stack, "1 to 16 frames")
        _require(self.latent_dim >= 1, "latent_dim", self.latent_dim, "a positive number of units")
        _require(self.norm in get_args(Norm), "norm", self.norm, f"one of {get_args(Norm)}")
        sizes = {len(self.encoder_filters), len(self.encoder_kernels), len(self.encoder_strides)}
        _require(len(sizes) == 1, "encoder_filters", self.encoder_filters, "as many filters as kernels and strides")
        _require(self.noise_dim >= 1, "noise_dim", self.noise_dim, "a positive number of units")
        _require(self.n_ens >= 1, "n_ens", self.n_ens, "at least one critic")
        _require(self.n_global >= 1, "n_global", self.n_global, "at least one critic")
        _require(self.bank_size >= 0, "bank_size", self.bank_size, "0 or a number of latents")


@dataclass(frozen=True)
class TrainConfig:
    """Joint training (Eq. 2-5, 9; Table 7; App. B.4, B.5) and the latent phase (ours)."""

    encoder_steps: int = 0
    """Updates of the encoder alone before the joint phase, on pairs of states; 0 has none [steps]. ours: the losses of Eq. 2
    leave out where exactly a hand or a handle is."""
    encoder_pairs: int = 64
    """Pairs a batch of the encoder phase, drawn from all over the data. ours."""
    encoder_reach: int = 20
    """Most steps between the two states of a pair [steps]. ours."""
    encoder_rewarded_share: float = 0.0
    """Share of pairs that begin at most `encoder_reach` steps before a reward, beyond chance. ours, for objects that hardly
    ever move otherwise; it did not help on FaucetClose (`docs/decisions.md`)."""
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
    anneal: bool = False
    """The joint phase's learning rate falls along a cosine to a hundredth of `learning_rate`. ours; off in `paper`."""
    c0: float = 0.2
    """Weight of the global critic's loss, Eq. 2, Table 7."""
    c1: float = 0.01
    """Weight of the dynamics loss, Eq. 2, Table 7 (0.001 in SpiralMaze)."""
    shift: int = 0
    """Largest random shift of the joint phase's frames, the same for all frames of a group of windows [px]; 0 has none.
    ours: a hundred scenes are few for an encoder."""
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
    group_goals: float = 0.5
    """Share of the goals of strategy (c) that come from the same group. ours."""
    rewarded_share: float = 0.05
    """Share of windows drawn to hold a rewarded transition, beyond chance. ours; 0 in `paper`."""
    target_rate: float = 0.05
    """Polyak rate of the target networks. ours: values of unreachable goals fall by γ a target update, so a slow one costs
    thousands of updates; TD3's 0.005 in `paper`, which is silent."""
    policy_every: int = 2
    """Model updates a policy update. ours (TD3's delay); 1 in `paper`, the alternation of Eq. 2 and 5."""
    latent_steps: int = 4_000
    """Updates of the latent phase: encoder frozen, all latents cached. ours; 0 in `paper`."""
    latent_batch: int = 256
    """Windows a batch of the latent phase. ours."""
    latent_horizon: int = 5
    """Rollout length of the dynamics in the latent phase [steps]. ours."""
    latent_rewarded_share: float | None = None
    """`rewarded_share` of the latent phase; None takes that one. ours: an encoder has to see rewards to tell them apart, but
    a share beyond chance makes states that look like rewarded ones too valuable."""
    latent_dynamics_steps: int = 0
    """Updates of h alone after the latent phase, on short rollouts from all over the data; 0 has none [steps]. ours: long
    rollouts are few transitions an update, and h needs many."""
    latent_dynamics_batch: int = 512
    """Rollouts a batch of those. ours."""
    latent_dynamics_horizon: int = 3
    """Their length [steps]. ours."""
    latent_priority: float = 0.5
    """Half of them are drawn by the last error there to this power; 0 draws all uniformly. ours: contacts are rare."""
    latent_ridge: float = 0.1
    """Share of the mean variance that is added to every direction's before one-step changes are made white. ours."""
    latent_value_steps: int = 0
    """Updates of critics, policies and g alone after those of h, on cached latents; 0 has none [steps]. ours: values a
    hundred steps from the goal take thousands of updates, and h's rollouts would cost most of them."""
    latent_value_batch: int = 512
    """Transitions a batch of those. ours."""
    latent_heads: bool = True
    """The latent phase goes on training critics, policies and g on the frozen latents; off, it trains h alone. ours."""
    clone_steps: int = 0
    """Updates of the last phase, on cached latents too: the policy of `success_policy` is cloned from the transitions of
    successful episodes; 0 has none [steps]. ours."""
    clone_candidates: int = 1
    """Policies that share those updates, one after the other from weights of their own; the one is kept that gets to the
    goal most often by h and Q^g from far states of the data. ours: where a clone goes from states unlike the successes is
    luck."""
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
        later = ("latent_steps", "latent_dynamics_steps", "latent_value_steps", "clone_steps")
        for name in ("encoder_steps", "joint_steps", *later, "value_transitions", "dynamics_rollouts"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        for name in (
            "encoder_pairs",
            "encoder_reach",
            "batch_windows",
            "window",
            "dynamics_horizon",
            "policy_every",
            "group_windows",
            "group_reach",
            "latent_batch",
            "latent_horizon",
            "latent_dynamics_batch",
            "latent_dynamics_horizon",
            "latent_value_batch",
            "clone_candidates",
            "log_every",
            "diagnose_every",
            "checkpoint_every",
        ):
            _require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("encoder_learning_rate", "learning_rate", "latent_learning_rate", "temperature"):
            _require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        for name in ("inverse", "c0", "c1", "reconstruction", "c2", "c3", "kl_weight", "latent_priority", "latent_ridge"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), "a weight of 0 or more")
        _require(1 <= self.reconstruction_side <= 64, "reconstruction_side", self.reconstruction_side, "1 to 64 px")
        _require(0 <= self.shift <= 16, "shift", self.shift, "0 to 16 px")
        _require(0 < self.discount < 1, "discount", self.discount, "a number between 0 and 1")
        _require(0 <= self.group_goals <= 1, "group_goals", self.group_goals, "a share from 0 to 1")
        for name in ("rewarded_share", "latent_rewarded_share", "encoder_rewarded_share"):
            share = getattr(self, name)
            _require(share is None or 0 <= share <= 1, name, share, "a share from 0 to 1")
        _require(0 < self.target_rate <= 1, "target_rate", self.target_rate, "a rate in (0, 1]")
        shares = self.relabel_next + self.relabel_future + self.relabel_other
        _require(
            min(self.relabel_next, self.relabel_future, self.relabel_other) >= 0 and abs(shares - 1) < 1e-6,
            "relabel_next, relabel_future, relabel_other",
            (self.relabel_next, self.relabel_future, self.relabel_other),
            "three shares of 0 or more that add up to 1",
        )
        _require(
            self.dynamics_loss in get_args(DynamicsLoss),
            "dynamics_loss",
            self.dynamics_loss,
            f"one of {get_args(DynamicsLoss)}",
        )
        _require(
            self.window >= self.dynamics_horizon,
            "window",
            self.window,
            f"at least dynamics_horizon = {self.dynamics_horizon} steps",
        )
        _require(self.precision in get_args(Precision), "precision", self.precision, f"one of {get_args(Precision)}")
        _require(
            self.critic_loss in get_args(CriticLoss), "critic_loss", self.critic_loss, f"one of {get_args(CriticLoss)}"
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
            ("dynamics", self.latent_dynamics_steps),
            ("values", self.latent_value_steps),
            ("clone", self.clone_steps),
        )


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
    max_neighbours: int = 16
    """M, nearest tree nodes that a candidate is compared with inside d_neigh. ours: the paper compares with all of them,
    which
    is the same as long as no more than M lie within d_neigh."""
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
    rehearsals: int = 0
    """Walks of each of the best paths by π^l under h, with noise in the actions, that decide which one is followed; 0 trusts
    Eq. 8. ours: a search finds leaks of h that the controller does not have."""
    rehearsal_paths: int = 24
    """Paths that are rehearsed with noise, the best of all by one walk without. ours."""
    rehearsal_noise: float = 0.4
    """Deviation of that noise [1, the largest action]. ours."""
    anchor: Anchor = "none"
    """What to do with candidates by their nearest dataset latent: nothing, reject beyond `anchor_factor`, or also snap.
    ours."""
    anchor_factor: float = 1.0
    """Largest distance to a dataset latent, in upper 5-percentiles of one-step distances. ours."""

    def __post_init__(self) -> None:
        _require(self.rehearsals >= 0, "rehearsals", self.rehearsals, "0 or more walks")
        _require(self.rehearsal_noise >= 0, "rehearsal_noise", self.rehearsal_noise, "a deviation of 0 or more")
        for name in ("n_iter", "n_sim", "candidates", "max_neighbours", "rehearsal_paths"):
            _require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("temperature_sparse", "temperature_value", "neighbour_distance_factor", "anchor_factor"):
            _require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        _require(self.expansion_weight >= 0, "expansion_weight", self.expansion_weight, "a weight of 0 or more")
        for name in ("p_sparse", "p_value", "p_policy"):
            _require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "a probability")
        _require(self.p_sparse + self.p_value <= 1 + 1e-9, "p_sparse + p_value", self.p_sparse + self.p_value, "at most 1")
        _require(self.anchor in get_args(Anchor), "anchor", self.anchor, f"one of {get_args(Anchor)}")


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
    lookahead_samples: int = 32
    """Actions drawn from g for the lookahead. ours."""
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
    revisit_penalty: float = 0.0
    """Every state that the episode has been in moves the goal away from its surroundings by this [steps]; 0 trusts Q^g.
    ours: plans and π^g then leave places that promise the goal and do not keep it."""

    def __post_init__(self) -> None:
        _require(self.n_replan >= 1, "n_replan", self.n_replan, "at least 1 step")
        _require(self.residuals >= 0, "residuals", self.residuals, "0 or more steps")
        _require(self.shortcut_exponent >= 0, "shortcut_exponent", self.shortcut_exponent, "0 or more")
        _require(self.lookahead >= 0, "lookahead", self.lookahead, "0 or more steps")
        _require(self.success_rollout >= 0, "success_rollout", self.success_rollout, "0 or more steps")
        _require(self.goal_lookahead >= 0, "goal_lookahead", self.goal_lookahead, "0 or more steps")
        _require(self.lookahead_gain >= 1, "lookahead_gain", self.lookahead_gain, "a factor of 1 or more")
        _require(self.revisit_penalty >= 0, "revisit_penalty", self.revisit_penalty, "0 or more steps")
        _require(self.lookahead_samples >= 1, "lookahead_samples", self.lookahead_samples, "at least 1 action")


@dataclass(frozen=True)
class Config:
    """Everything that decides a result, saved with every run."""

    task: str
    preset: str
    model: ModelConfig = field(default_factory=ModelConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)

    def __post_init__(self) -> None:
        _require(
            self.model.critic_bounded or self.train.critic_loss == "mse",
            "critic_loss",
            self.train.critic_loss,
            "'mse' where `critic_bounded` is off: cross entropy asks for Q-values in [0, 1]",
        )
        for name, steps in (("clone_steps", self.train.clone_steps), ("success_rollout", self.controller.success_rollout)):
            _require(self.model.success_policy or steps == 0, name, steps, "0 where `success_policy` is off")

    def to_json(self) -> str:
        """Canonical JSON: sorted keys, so that equal configs are equal text.

        Fields younger than the first records are left out at the value that changes nothing: what was recorded before they
        existed keeps its hash.
        """
        raw = dataclasses.asdict(self)
        for part in YOUNGER_FIELDS:
            raw[part] = older_fields(part, raw[part])
        return json.dumps(raw, sort_keys=True)

    def shared_json(self) -> str:
        """Canonical JSON of what all methods share: without planner, controller, the policy of successes and the bank."""
        raw = json.loads(self.to_json())
        for part, name in (("model", "success_policy"), ("model", "bank_size"), ("train", "clone_steps"),
                           ("train", "clone_candidates")):
            raw[part].pop(name, None)
        return json.dumps({name: raw[name] for name in ("task", "preset", "model", "train")}, sort_keys=True)

    def hash(self) -> str:
        """First 12 hexadecimal digits of the SHA-256 of `to_json()`."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()[:12]

    @staticmethod
    def from_json(text: str) -> Config:
        """Inverse of `to_json`; raises ConfigError on unknown or missing fields."""
        try:
            raw = json.loads(text)
        except json.JSONDecodeError as error:
            raise ConfigError(
                f"the config is not JSON ({error}); expected the text that velap saved. Restore the file."
            ) from error
        return _build(Config, raw, "config")


def _build(cls: type, raw: Any, where: str) -> Any:
    """A dataclass from parsed JSON, lists back to tuples, unknown keys refused."""
    if not isinstance(raw, dict):
        raise ConfigError(f"`{where}` is {type(raw).__name__}; expected an object with the fields of {cls.__name__}.")
    hints = get_type_hints(cls)
    unknown = sorted(set(raw) - set(hints))
    if unknown:
        raise ConfigError(
            f"`{where}` has unknown fields {unknown}; expected some of {sorted(hints)}. "
            "The file may come from another version of velap."
        )
    values = {}
    for name, value in raw.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            value = _build(hint, value, f"{where}.{name}")  # type: ignore[arg-type]
        elif get_origin(hint) is tuple and isinstance(value, list):
            value = tuple(value)
        values[name] = value
    try:
        return cls(**values)
    except TypeError as error:
        raise ConfigError(f"`{where}` does not fit {cls.__name__}: {error}.") from error


def override(config: Config, **changes: dict[str, Any]) -> Config:
    """A copy with fields of its parts replaced: `override(config, train={"joint_steps": 10})`."""
    parts = {}
    for part, fields in changes.items():
        current = getattr(config, part)
        unknown = sorted(set(fields) - {f.name for f in dataclasses.fields(current)})
        if unknown:
            names = sorted(f.name for f in dataclasses.fields(current))
            raise ConfigError(f"`{part}` has no field {unknown}; expected some of {names}.")
        parts[part] = dataclasses.replace(current, **fields)
    return dataclasses.replace(config, **parts)


YOUNGER_FIELDS: dict[str, tuple[str, ...]] = {
    "model": ("success_policy",),
    "train": (
        "encoder_steps",
        "encoder_pairs",
        "encoder_reach",
        "encoder_rewarded_share",
        "encoder_learning_rate",
        "inverse",
        "latent_rewarded_share",
        "latent_dynamics_steps",
        "latent_dynamics_batch",
        "latent_dynamics_horizon",
        "latent_priority",
        "latent_ridge",
        "latent_value_steps",
        "latent_value_batch",
        "clone_steps",
        "clone_candidates",
        "critic_loss",
        "policy_relative",
        "group_windows",
        "group_reach",
        "group_goals",
        "anneal",
        "reconstruction",
        "reconstruction_side",
        "shift",
    ),
    "planner": ("rehearsals", "rehearsal_paths", "rehearsal_noise"),
    "controller": ("residuals", "shortcut_exponent", "lookahead_gain", "goal_lookahead", "revisit_penalty",
                   "success_rollout"),
}
"""Fields that `Config.to_json` leaves out at their defaults, which change nothing."""

def older_fields(part: str, values: dict[str, Any]) -> dict[str, Any]:
    """The fields of a part without those of `YOUNGER_FIELDS` that have their defaults."""
    defaults = {f.name: f.default for f in dataclasses.fields(get_type_hints(Config)[part])}
    return {
        name: value for name, value in values.items() if name not in YOUNGER_FIELDS[part] or value != defaults[name]
    }
