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

from velap.config.planning import ControllerConfig, PlannerConfig
from velap.config.training import TrainConfig, require
from velap.errors import ConfigError

Norm = Literal["batch", "layer", "none"]


@dataclass(frozen=True)
class ModelConfig:
    """Networks of App. B.1."""

    frame_stack: int = 3
    """Frames a state N [frames]. ours: the paper leaves N open for the simulated tasks and uses 3 on hardware (E.1)."""
    latent_dim: int = 32
    """d_Z, Table 7: units of φ's output."""
    norm: Norm = "layer"
    """Normalisation of hidden layers. Tables 2-6: batch. ours: layer, no train/eval gap and no batch statistics in
    targets."""
    moment_colours: int = 0
    """Colours of the palette whose moments the encoder takes instead of convolutions; 0 takes convolutions. ours: centres of
    colours tell places to a tenth of a pixel after a minute of training (`docs/decisions.md`)."""
    slow_features: int = 0
    """The last so many of φ's units are the slowest linear features of the moments, as they are. ours: dense layers lose a
    third of what moments tell of where a window is (`docs/decisions.md`)."""
    keep_moments: bool = False
    """Behind those stand all moments of the newest frame, which `latent_dim` counts too. ours: a task of many objects asks
    for all that they tell (`docs/decisions.md`)."""
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
    held_policy: bool = False
    """A policy learnt from actions held for several steps (`held_steps`), which leads VELAP in place of π^g. ours; off in
    `paper`."""
    command_memory: float = 0.0
    """Share that a leaky mean of the past actions keeps at a step; with more than 0 it stands behind the output of φ, as the
    speed of what follows commands slowly is hard to see in pixels. ours; 0 (off) in `paper`."""
    command_dims: int = 0
    """So many actions are remembered, the first ones; 0 remembers all. ours: a gripper that no task needs is noise."""
    half_weights: bool = False
    """Weight matrices are in half precision in the checkpoint, which they halve; computing is in single. ours."""
    bank_size: int = 4096
    """Dataset latents kept with the model for support tests and film strips; 0 keeps none. ours; 0 in `paper`."""

    def __post_init__(self) -> None:
        require(1 <= self.frame_stack <= 16, "frame_stack", self.frame_stack, "1 to 16 frames")
        require(0 <= self.moment_colours <= 256, "moment_colours", self.moment_colours, "0 to 256 colours")
        require(self.latent_dim >= 1, "latent_dim", self.latent_dim, "a positive number of units")
        require(not self.keep_moments or self.moment_colours > 0, "keep_moments", True,
                "False where `moment_colours` is 0: there are no moments")
        moments = 6 * self.moment_colours
        most = max(min(self.latent_dim - 1 - self.keep_moments * moments, moments), 0)
        require(0 <= self.slow_features <= most, "slow_features", self.slow_features,
                f"0 to {most}: less than latent_dim, and no more than there are moments (6 × moment_colours)")
        require(self.learnt_dim >= 1, "latent_dim", self.latent_dim,
                f"more than {moments}: `keep_moments` puts 6 × moment_colours of them behind what is learnt")
        require(self.norm in get_args(Norm), "norm", self.norm, f"one of {get_args(Norm)}")
        sizes = {len(self.encoder_filters), len(self.encoder_kernels), len(self.encoder_strides)}
        require(len(sizes) == 1, "encoder_filters", self.encoder_filters, "as many filters as kernels and strides")
        require(self.noise_dim >= 1, "noise_dim", self.noise_dim, "a positive number of units")
        require(self.n_ens >= 1, "n_ens", self.n_ens, "at least one critic")
        require(self.n_global >= 1, "n_global", self.n_global, "at least one critic")
        require(0 <= self.command_memory < 1, "command_memory", self.command_memory, "at least 0 and less than 1")
        require(self.command_dims >= 0, "command_dims", self.command_dims, "0 or a number of actions")
        require(self.bank_size >= 0, "bank_size", self.bank_size, "0 or a number of latents")

    @property
    def learnt_dim(self) -> int:
        """Units of φ that come out of its dense layers."""
        return self.latent_dim - self.slow_features - self.keep_moments * 6 * self.moment_colours

    def width(self, action_dim: int) -> int:
        """D, dimensions of a latent with all that is in it."""
        if self.command_memory == 0:
            return self.latent_dim
        return self.latent_dim + min(self.command_dims or action_dim, action_dim)


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
        require(
            self.model.critic_bounded or self.train.critic_loss == "mse",
            "critic_loss",
            self.train.critic_loss,
            "'mse' where `critic_bounded` is off: cross entropy asks for Q-values in [0, 1]",
        )
        require(
            self.model.slow_features == 0 or self.train.encoder_steps > 0,
            "encoder_steps",
            self.train.encoder_steps,
            "at least 1 where `slow_features` is set: the encoder phase finds them",
        )
        asked = {"clone_steps": self.train.clone_steps, "success_rollout": self.controller.success_rollout,
                 "success_exponent": self.controller.success_exponent}
        for name, steps in asked.items():
            require(self.model.success_policy or steps == 0, name, steps, "0 where `success_policy` is off")
        for name, steps in (("held_steps", self.train.held_steps), ("held_turn", self.controller.held_turn)):
            require(self.model.held_policy or steps == 0, name, steps, "0 where `held_policy` is off")

    def to_json(self) -> str:
        """Canonical JSON: sorted keys, so that equal configs are equal text.

        Fields younger than the first records are left out at the value that changes nothing: what was recorded before they
        existed keeps its hash.
        """
        raw = dataclasses.asdict(self)
        for part in YOUNGER_FIELDS:
            raw[part] = older_fields(part, raw[part]) | CONSTANTS.get(part, {})
        return json.dumps(raw, sort_keys=True)

    def shared_json(self) -> str:
        """Canonical JSON of what all methods share: without planner, controller, the policy of successes and the bank."""
        raw = json.loads(self.to_json())
        for part, name in OWN_FIELDS:
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
    constants = CONSTANTS.get(where.removeprefix("config."), {})
    raw = {name: value for name, value in raw.items() if name not in constants or value != constants[name]}
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


CONSTANTS: dict[str, dict[str, Any]] = {
    "model": {"latent_norm": False},
    "train": {"latent_batch": 256, "latent_heads": True},
    "planner": {"max_neighbours": 16, "anchor_factor": 1.0},
    "controller": {"lookahead_samples": 32},
}
"""Former fields by part, which are constants of the code now; saved configs still name them."""
OWN_FIELDS = (
    ("model", "success_policy"), ("model", "held_policy"), ("model", "bank_size"), ("train", "clone_steps"),
    ("train", "clone_candidates"), ("train", "clone_reach"), ("train", "held_steps"),
)
"""Fields by part that matter to VELAP alone, besides planner and controller."""
YOUNGER_FIELDS: dict[str, tuple[str, ...]] = {
    "model": ("success_policy", "held_policy", "command_memory", "command_dims", "moment_colours",
              "slow_features", "keep_moments", "half_weights"),
    "train": (
        "encoder_steps",
        "encoder_pairs",
        "encoder_learning_rate",
        "inverse",
        "heads_afresh",
        "latent_rewarded_share",
        "latent_value_steps",
        "member_steps",
        "members",
        "member_noise",
        "distil_steps",
        "clone_steps",
        "clone_candidates",
        "clone_reach",
        "held_steps",
        "critic_loss",
        "critic_floor",
        "policy_relative",
        "group_windows",
        "group_reach",
        "reconstruction",
        "reconstruction_side",
    ),
    "planner": (),
    "controller": ("residuals", "shortcut_exponent", "lookahead_gain", "goal_lookahead", "revisit_penalty",
                   "success_rollout", "success_exponent", "held_turn"),
}
"""Fields that `Config.to_json` leaves out at their defaults, which change nothing."""


def older_fields(part: str, values: dict[str, Any]) -> dict[str, Any]:
    """The fields of a part without those of `YOUNGER_FIELDS` that have their defaults."""
    defaults = {f.name: f.default for f in dataclasses.fields(get_type_hints(Config)[part])}
    return {
        name: value for name, value in values.items() if name not in YOUNGER_FIELDS[part] or value != defaults[name]
    }
