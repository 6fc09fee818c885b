"""Configs as JSON, whole and with a schema number; the hash of what decides a result; fields replaced by name."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from velap.config.fields import docs, hints, replace, require, type_name, typed
from velap.config.model import ModelConfig
from velap.config.planning import ControllerConfig, PlannerConfig
from velap.config.training import PHASES, Phase, TrainConfig
from velap.errors import ConfigError

SCHEMA = 4
"""Number of the JSON layout. `velap.config.migrate` reads older files."""
CADENCES = ("log_every", "checkpoint_every")
"""Fields of `TrainConfig` that decide no result and stay out of the hash."""
PARTS: dict[str, type] = {
    "model": ModelConfig, "train": TrainConfig, "planner": PlannerConfig, "controller": ControllerConfig,
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that decides a result, saved whole with every run."""

    task: str
    preset: str
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    planner: PlannerConfig = dataclasses.field(default_factory=PlannerConfig)
    controller: ControllerConfig = dataclasses.field(default_factory=ControllerConfig)

    def __post_init__(self) -> None:
        train = self.train
        require(self.model.critic_bounded or train.critic_loss == "mse", "critic_loss", train.critic_loss,
                "'mse' where `critic_bounded` is off: cross entropy asks for Q-values in [0, 1]")

    def to_dict(self) -> dict[str, Any]:
        """Every field by part, phases by kind."""
        plain = dataclasses.asdict(self)
        plain["train"]["phases"] = [phase_to_dict(phase) for phase in self.train.phases]
        return {"schema": SCHEMA, **plain}

    def to_json(self) -> str:
        """Canonical JSON of every field: equal configs are equal text."""
        return json.dumps(self.to_dict(), sort_keys=True)

    def hash(self) -> str:
        """First 12 hexadecimal digits of the SHA-256 of what decides a result: every field but `CADENCES`."""
        decides = self.to_dict()
        for name in CADENCES:
            decides["train"].pop(name)
        return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]

    def shared_json(self) -> str:
        """Canonical JSON of what all methods act by besides weights: the model, γ, and the names that their records have."""
        model = dataclasses.asdict(self.model)
        known = {"task": self.task, "preset": self.preset, "model": model, "discount": self.train.discount}
        return json.dumps(known, sort_keys=True)

    @staticmethod
    def from_json(text: str) -> Config:
        """Inverse of `to_json`, which reads older schemas too; raises ConfigError on unknown, missing or mistyped fields."""
        try:
            raw = json.loads(text)
        except json.JSONDecodeError as error:
            raise ConfigError(f"the config is not JSON ({error}); expected the text that velap saved. Restore the "
                              "file.") from error
        schema = raw.get("schema", 1) if isinstance(raw, dict) else None
        if schema in (1, 2, 3):
            from velap.config.migrate import from_older

            return from_older(raw)
        if schema != SCHEMA:
            raise ConfigError(f"the config has schema {schema!r}; expected {SCHEMA}. The file comes from another version of "
                              "velap: read it with that one.")
        return build(Config, {name: value for name, value in raw.items() if name != "schema"}, "config")


def phase_to_dict(phase: Phase) -> dict[str, Any]:
    """Every field of a phase, and its kind."""
    return {"phase": phase.name, **dataclasses.asdict(phase)}


def build(cls: type, raw: Any, where: str) -> Any:
    """A dataclass from parsed JSON that names all of its fields and no other."""
    if not isinstance(raw, dict):
        raise ConfigError(f"`{where}` is {type(raw).__name__}; expected an object with the fields of {cls.__name__}.")
    known = hints(cls)
    if set(raw) != set(known):
        raise ConfigError(f"`{where}` has unknown fields {sorted(set(raw) - set(known))} and lacks "
                          f"{sorted(set(known) - set(raw))}; "
                          f"expected {sorted(known)}. The file may come from another version of velap.")
    values = {}
    for name, hint in known.items():
        place = f"{where}.{name}"
        if dataclasses.is_dataclass(hint):
            values[name] = build(hint, raw[name], place)  # type: ignore[arg-type]
        elif name == "phases":
            values[name] = tuple(_build_phase(each, f"{place}[{i}]") for i, each in enumerate(raw[name]))
        else:
            values[name] = typed(raw[name], hint, place)
    return cls(**values)


def _build_phase(raw: Any, where: str) -> Phase:
    kind = raw.get("phase") if isinstance(raw, dict) else None
    if kind not in PHASES:
        raise ConfigError(f"`{where}` is a phase of kind {kind!r}; expected one of {', '.join(PHASES)}. The file may come "
                          "from another version of velap.")
    phase: Phase = build(PHASES[kind], {name: value for name, value in raw.items() if name != "phase"}, where)
    return phase


def override(config: Config, **changes: Mapping[str, Any]) -> Config:
    """A copy with fields of its parts replaced: `override(config, planner={"n_iter": 10}, train={"joint": {"steps": 10}})`.

    A phase is named by its label. One that the config lacks is put in its place
    when `steps` are given; `steps=0` leaves a phase out.
    """
    parts: dict[str, Any] = {}
    for part, fields in changes.items():
        if part not in PARTS:
            raise ConfigError(f"a config has no part {part!r}; expected some of {', '.join(PARTS)}, each with its fields, "
                              "such as {'planner': {'n_iter': 500}}.")
        if not isinstance(fields, Mapping):
            raise ConfigError(f"`{part}` is {fields!r}; expected its fields, such as {{'planner': {{'n_iter': 500}}}}.")
        current, given = getattr(config, part), dict(fields)
        if part == "train":
            phases = current.phases
            for label in [name for name in given if name in PHASES]:
                phases = _with_phase(phases, label, given.pop(label))
            if phases != current.phases:
                current = dataclasses.replace(current, phases=phases)
        parts[part] = replace(current, given, part)
    return dataclasses.replace(config, **parts)


def _with_phase(phases: tuple[Phase, ...], label: str, fields: Mapping[str, Any]) -> tuple[Phase, ...]:
    """The phases with fields of the one called `label` replaced, the phase put in or left out."""
    found = next((phase for phase in phases if phase.label == label), None)
    others = tuple(phase for phase in phases if phase.label != label)
    if fields.get("steps") == 0:
        return others
    if found is not None:
        changed = replace(found, fields, f"train.{label}")
        return tuple(changed if phase is found else phase for phase in phases)
    if "steps" not in fields:
        raise ConfigError(f"the config has no phase {label!r}; expected one of "
                          f"{', '.join(phase.label for phase in phases)}. Add "
                          f"it with train.{label}.steps.")
    made = PHASES[label](1)
    order = list(PHASES)
    before = tuple(phase for phase in others if order.index(phase.label) < order.index(label))
    return (*before, replace(made, fields, f"train.{label}"), *(phase for phase in others if phase not in before))


def describe(config: Config) -> Iterator[tuple[str, str, str, str]]:
    """(dotted name, type, value, meaning) of every field that a setting can change, phases that the config lacks
    included."""
    for part in PARTS:
        current = getattr(config, part)
        meanings = docs(type(current))
        for name, hint in hints(type(current)).items():
            if name != "phases":
                yield f"{part}.{name}", type_name(hint), json.dumps(getattr(current, name)), meanings[name]
        if part == "train":
            made = {phase.label: phase for phase in current.phases}
            for label, kind in PHASES.items():
                meanings = docs(kind)
                for name, hint in hints(kind).items():
                    value = json.dumps(getattr(made[label], name)) if label in made else "-"
                    yield f"train.{label}.{name}", type_name(hint), value, meanings[name]
