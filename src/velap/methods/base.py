"""What acts (`Agent`), and what a method consists of (`Method`): its name in tables, what it learns, how it acts.

B environments, N stacked frames, A action dimension.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from velap.errors import ConfigError, ObservationError, UnknownTaskError
from velap.registry import METHODS

if TYPE_CHECKING:
    from gymnasium.spaces import Box

    from velap.config import Config
    from velap.methods.heads import Head
    from velap.models.velap import LatentModel
    from velap.training.frozen import FrozenLearner, LearnerConfig


State = NDArray[np.floating[Any]] | None
"""[B, S] numbers beside the frames; None for models without."""


class Agent(Protocol):
    """Acts in B environments at once; rows never influence each other."""

    method: str
    """Name in records and tables."""
    frame_stack: int
    """N, frames a state [frames]."""
    last_plan_ms: NDArray[np.float64]
    """[B] planning time of the last `act` [ms], NaN in rows that did not plan."""

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Start new episodes where `mask` bool [B] is set, with randomness from `seeds` int [B] alone; None takes the row
        numbers."""
        ...

    def act(self, frames: NDArray[np.uint8], state: State = None) -> NDArray[np.float32]:
        """Stacked frames [B, N, H, W, 3], oldest first, and the newest state [B, S] of a model that has one -> actions
        [B, A] in the environment's own range.

        A batch of another size than the last one starts new episodes in all rows.
        """
        ...


@runtime_checkable
class FollowsTree(Protocol):
    """An agent that grows a tree and says which actions follow it."""

    by_plan: NDArray[np.bool_]
    """[B] rows whose last action followed an edge of the current tree."""


@dataclass(frozen=True)
class Parts:
    """What an agent can be made of."""

    model: LatentModel
    """In evaluation mode."""
    config: Config
    """The model's."""
    action_space: Box
    """The environment's."""
    settings: Any
    """The method's settings; None if it has no settings."""
    head: Any
    """What the method learnt beside the model, of the type `Method.head`; None where it learns nothing."""


class Learnt(Protocol):
    """Identity of a head; the metadata of its file repeat it."""

    settings: str
    """Canonical JSON of the learner's config."""
    weights_sha256: str


class Method(ABC):
    """A method, by the name that records and tables use. Subclass it, and add it by `velap.register_method`:

        @register_method("mine")
        class Mine(Method):
            label = "My baseline"

            def agent(self, parts: Parts) -> Agent:
                return ReactiveAgent(self.name, parts.model, parts.model.act_global)
    """

    label: ClassVar[str]
    """How tables print it."""
    settings: ClassVar[Any] = None
    """How it acts: a frozen dataclass, whose fields `velap evaluate --set NAME.FIELD=VALUE` replaces; None if there is
    nothing to set."""
    paper_settings: ClassVar[Any] = None
    """The same in the preset `paper`; None takes `settings`."""
    head: ClassVar[type[Head] | None] = None
    """Network that it learns on frozen latents; None where it acts by the joint checkpoint alone."""
    learner: ClassVar[type[FrozenLearner[Any, Any]] | None] = None
    """What learns the head."""
    learning: ClassVar[LearnerConfig | None] = None
    """The learner's config."""
    paper_learning: ClassVar[LearnerConfig | None] = None
    """The same in the preset `paper`; None takes `learning`."""
    needs_model: ClassVar[bool] = True
    """Whether it needs a trained model."""
    whole_checkpoint: ClassVar[bool] = False
    """Whether it acts by the whole checkpoint, or only by the weights and config that all methods share."""

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def agent(self, parts: Parts) -> Agent:
        """An agent that acts by this method."""

    @property
    def learns(self) -> bool:
        """Whether something is learnt for it beside the joint checkpoint."""
        return self.head is not None

    def settings_of(self, preset: str, changes: Mapping[str, Any] | None = None) -> Any:
        """How it plans in a preset with the fields of `changes` replaced; None if it has no settings."""
        settings = self.paper_settings if preset == "paper" and self.paper_settings is not None else self.settings
        return _changed(f"the method {self.name!r}", settings, changes)

    def learner_config(self, preset: str, changes: Mapping[str, Any] | None = None) -> LearnerConfig:
        """How it learns in a preset with the fields of `changes` replaced; raises UnknownTaskError if nothing is learnt."""
        if not self.learns:
            raise self.nothing_to_learn()
        config = self.paper_learning if preset == "paper" and self.paper_learning is not None else self.learning
        changed: LearnerConfig = _changed(f"the learner of {self.name!r}", config, changes)
        return changed

    def nothing_to_learn(self) -> UnknownTaskError:
        """The error for asking for the learner or the head of a method that learns nothing."""
        return UnknownTaskError(f"the method {self.name!r} has no learner of its own; expected one of "
                                f"{', '.join(learning_methods())}. The others act by the joint checkpoint alone: `velap "
                                "train TASK`.")

    def config_hash(self, config: Config, head: Learnt | None = None, settings: Any = None) -> str:
        """The `config_hash` of its records, of everything that decides how it acts. `settings` None takes the preset's."""
        return self._hash_of(config.hash() if self.whole_checkpoint else config.shared_json(), config, head, settings)

    def _hash_of(self, text: str, config: Config, head: Learnt | None, settings: Any) -> str:
        """Hash of the config's part in `text`, and of settings and head."""
        settings = settings or self.settings_of(config.preset)
        parts: dict[str, Any] = {"method": self.name, "settings": asdict(settings) if settings is not None else {},
                                 "config": text}
        if self.learns:
            if head is None:
                raise ConfigError(f"the method {self.name!r} acts by a head and got none; train it with `velap train TASK "
                                  f"--method {self.name}`.")
            parts |= {"head": head.settings, "head_weights": head.weights_sha256}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def _changed(owner: str, defaults: Any, changes: Mapping[str, Any] | None) -> Any:
    """A dataclass, or None, with the fields of `changes` replaced; raises ConfigError for unknown fields."""
    names = [field.name for field in fields(defaults)] if defaults is not None else []
    unknown = sorted(set(changes or {}) - set(names))
    if unknown:
        raise ConfigError(f"{owner} has no field {unknown}; expected some of {names}.")
    return replace(defaults, **changes) if changes else defaults


def get_method(name: str) -> Method:
    """The method of that name; raises UnknownTaskError with the names that exist."""
    found: Method = METHODS[name](name)
    return found


def learning_methods() -> list[str]:
    """Names of the methods that learn something beside the joint checkpoint, as far as they are imported."""
    return sorted(name for name, method in METHODS.imported.items() if method.head is not None)


def make_agent(method: str, model: LatentModel | None, config: Config, action_space: Box, head: Head | None = None,
               settings: Any = None) -> Agent:
    """The agent of a registered method.

    Args:
        method: a name in `velap.registry.METHODS`.
        model: what it acts by; put into evaluation mode. None for a method that needs none.
        config: of the model.
        action_space: the environment's.
        head: what the method learnt beside the model.
        settings: how it plans; None takes the settings of the config's preset.
    """
    kind = get_method(method)
    if kind.needs_model:
        if model is None:
            raise UnknownTaskError(f"method {method!r} acts by a trained model, got none; name one with --checkpoint.")
        model.eval()
    if kind.learns:
        if head is None or head.method != method:
            got = "none" if head is None else f"one of {head.method!r}"
            raise ConfigError(f"the method {method!r} acts by its own head and got {got}; train it with `velap train TASK "
                              f"--method {method}`, or name its file with --head.")
        head.eval()
    settings = settings or kind.settings_of(config.preset)
    return kind.agent(Parts(model, config, action_space, settings, head))  # type: ignore[arg-type]  # None where not needed


def checked_starts(mask: Any, seeds: Any) -> tuple[NDArray[np.bool_], list[tuple[int, int]]]:
    """What `Agent.reset` was given: the mask bool [B], and (row, seed) of every row that is set in it.

    Raises ObservationError for other masks, such as numbers of rows, and for seeds that are not one integer a row.
    """
    started = np.array(mask)
    if started.dtype != np.bool_ or started.ndim != 1 or len(started) == 0:
        raise ObservationError(f"reset got a mask of type {started.dtype} and shape {list(started.shape)}; expected bool "
                               "[B], true in the rows where an episode begins. For all of B rows give np.ones(B, bool).")
    given = np.arange(len(started)) if seeds is None else np.asarray(seeds)
    if given.shape != started.shape or given.dtype.kind not in "iu" or (given < 0).any():
        raise ObservationError(f"reset got seeds of type {given.dtype} and shape {list(given.shape)}; expected an integer "
                               f"of 0 or more for each of the {len(started)} rows. Rows that go on ignore theirs.")
    return started, [(int(row), int(given[row])) for row in np.flatnonzero(started)]
