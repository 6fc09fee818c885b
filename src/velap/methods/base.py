"""The `Agent` protocol: what acts in a batch of environments, and the registry of the methods that do.

B environments, N stacked frames, A action dimensions.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from velap.errors import ConfigError, UnknownTaskError
from velap.models.heads import HEADS
from velap.search.manager import MULTISTEP, IRISConfig
from velap.search.shooting import MBOPConfig, MPPIConfig

if TYPE_CHECKING:
    from gymnasium.spaces import Box

    from velap.config import Config
    from velap.models.heads import AnyHead
    from velap.models.velap import LatentModel

METHODS = ("velap", "bc", "bc-success", "td3bc", "iql", "iql-sparse", "mppi", "mbop", "iris", "iris-multistep", "random")
"""Methods of this package, in the names that records and tables use: those of Table 1, IQL with the sparse-reward setting
of its authors, and uniform actions."""
Settings = MPPIConfig | MBOPConfig | IRISConfig
SETTINGS: dict[str, Settings] = {
    "mppi": MPPIConfig(goal_ends=True), "mbop": MBOPConfig(goal_ends=True),
    "iris": IRISConfig(), "iris-multistep": MULTISTEP,
}
"""How the planning baselines plan in the default preset. VELAP's planner is the checkpoint's `planner` and `controller`."""
PAPER_SETTINGS: dict[str, Settings] = {**SETTINGS, "mppi": MPPIConfig(), "mbop": MBOPConfig()}
"""The same in the `paper` preset."""


class Learnt(Protocol):
    """What a head says of itself; a file's metadata says it as well."""

    settings: str
    """Canonical JSON of the learner's config."""
    weights_sha256: str


class Agent(Protocol):
    """Acts in B environments at once; rows never influence each other."""

    method: str
    """Name in records and tables, one of `METHODS`."""
    frame_stack: int
    """N, frames a state [frames]."""
    last_plan_ms: NDArray[np.float64]
    """[B] planning time of the last `act` [ms], NaN in rows that did not plan."""

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Start new episodes where `mask` [B] is set, with randomness from `seeds` [B] alone; None takes the row numbers."""
        ...

    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Stacked frames [B, N, H, W, 3], oldest first -> actions [B, A] in the environment's own range.

        A batch of another size than the last one starts new episodes in all rows.
        """
        ...


def method_settings(method: str, changes: Mapping[str, Any] | None = None, preset: str = "default") -> Settings | None:
    """How a method plans, with the fields of `changes` replaced; None for a method that is not in `SETTINGS`."""
    check_method(method)
    settings = (PAPER_SETTINGS if preset == "paper" else SETTINGS).get(method)
    if not changes:
        return settings
    names = [field.name for field in fields(settings)] if settings is not None else []
    unknown = sorted(set(changes) - set(names))
    if unknown or settings is None:
        raise ConfigError(f"the method {method!r} has no field {unknown}; expected some of {names}.")
    return replace(settings, **changes)


def method_hash(config: Config, method: str, head: Learnt | None = None, settings: Settings | None = None) -> str:
    """The `config_hash` of a method's records: its joint config, and what else decides how it acts.

    VELAP's is that config's own hash. The others leave out planner, controller and the policy of successes, which they have
    no use for. `settings` None takes those of the config's preset.
    """
    if method == "velap":
        return config.hash()
    settings = settings or method_settings(method, preset=config.preset)
    plain = asdict(settings) if settings is not None else {}
    parts = {"config": config.shared_json(), "method": method, "settings": plain}
    if method in HEADS:
        if head is None:
            raise ConfigError(f"the method {method!r} acts by a head and got none; train it with `velap train TASK --method "
                              f"{method}`.")
        parts |= {"head": head.settings, "head_weights": head.weights_sha256}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def check_method(method: str) -> None:
    """Raises UnknownTaskError unless `method` is registered."""
    if method not in METHODS:
        raise UnknownTaskError(f"unknown method {method!r}; expected one of {', '.join(METHODS)}.")


def make_agent(method: str, model: LatentModel | None, config: Config, action_space: Box, head: AnyHead | None = None,
               settings: Settings | None = None) -> Agent:
    """The agent of that name.

    Args:
        method: one of `METHODS`.
        model: what all but `random` act by; put into evaluation mode.
        config: of the model.
        action_space: the environment's.
        head: what a method in `velap.models.heads.HEADS` learnt beside the model.
        settings: how a planning baseline plans; None takes those of the config's preset.
    """
    from velap.methods.reactive import RandomAgent, ReactiveAgent
    from velap.methods.velap import VelapAgent

    check_method(method)
    stack = config.model.frame_stack
    if method == "random":
        return RandomAgent(action_space, stack)
    if model is None:
        raise UnknownTaskError(f"method {method!r} acts by a trained model, got none; name one with --checkpoint.")
    model.eval()
    settings = settings or method_settings(method, preset=config.preset)
    if method in HEADS:
        return _headed_agent(method, model, stack, head, settings)
    if method == "td3bc":
        return ReactiveAgent(method, model, model.act_global, stack)
    if method == "velap":
        return VelapAgent(model, config)
    from velap.methods.mpc import MPCAgent

    planner: Any = settings
    return MPCAgent(model, stack, planner)


def _headed_agent(method: str, model: LatentModel, stack: int, head: AnyHead | None, settings: Settings | None) -> Agent:
    """An agent of a learner; raises ConfigError without the head of that very method."""
    from velap.methods.iris import IRISAgent
    from velap.methods.reactive import ReactiveAgent

    if head is None or head.method != method:
        got = "none" if head is None else f"one of {head.method!r}"
        raise ConfigError(f"the method {method!r} acts by its own head and got {got}; train it with `velap train TASK "
                          f"--method {method}`, or name its file with --head.")
    head.eval()
    learnt: Any = head
    if method.startswith("iris"):
        planner: Any = settings
        return IRISAgent(method, model, stack, learnt, planner)
    return ReactiveAgent(method, model, learnt.act, stack)


def masked_seeds(mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None) -> list[tuple[int, int]]:
    """(row, seed) of every row set in `mask` [B]."""
    rows = np.flatnonzero(mask)
    return [(int(row), int(row if seeds is None else seeds[row])) for row in rows]
