"""Heads on frozen latents: what BC, IQL and IRIS learn beside a joint checkpoint (App. D.1, D.3, D.6, D.7).

A head sees latents of that checkpoint's encoder only and is of no use without it: its file names the weights it belongs to.
`*` is any batch prefix, D the latent, A the action, m the noise dimension, n critics.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from velap._version import __version__
from velap.config import Config, ModelConfig
from velap.errors import CheckpointError, UnknownTaskError
from velap.models.action_model import ConditionalVAE
from velap.models.networks import MLP, EnsembleMLP, Policy
from velap.models.velap import WEIGHTS_SHA256, restore, shared_weights
from velap.runs import content_sha256, load_tensors, save_tensors

N_CRITICS = 2
"""Q-networks of IQL, of which the minimum counts (Kostrikov et al. 2022, as in TD3)."""


class Head(nn.Module):
    """Base of all heads. `method` and `settings` say what it is: they are kept in its file and enter record hashes."""

    method: str = ""
    """Name in records and tables."""
    settings: str = "{}"
    """Canonical JSON of the learner's config, all fields."""
    weights_sha256: str = ""
    """Hash of weights and settings, the same for the same training; set by `save_head` and `load_head`."""


class PolicyHead(Head):
    """BC and BC(D*), D.1: a policy of Table 5 and nothing else."""

    def __init__(self, config: ModelConfig, action_dim: int) -> None:
        super().__init__()
        self.policy = Policy(config.width(action_dim), config.policy_dense, action_dim, config.norm)

    def act(self, latent: Tensor) -> Tensor:
        """π: `[*, D] → [*, A]` in [-1, 1]."""
        return self.policy(latent)


class IQLHead(PolicyHead):
    """IQL, D.3: the policy of Table 5 beside the critics Q and V of Table 6."""

    def __init__(self, config: ModelConfig, action_dim: int) -> None:
        super().__init__(config, action_dim)
        self.critics = EnsembleMLP(N_CRITICS, config.width(action_dim) + action_dim, config.critic_dense, config.norm)
        self.value_net = MLP(config.width(action_dim), config.critic_dense, 1, config.norm)

    def qs(self, latent: Tensor, action: Tensor) -> Tensor:
        """Q of every critic: `[*, D], [*, A] → [n, *]` [Q-value, in units of the learner's reward]."""
        return self.critics(torch.cat([latent, action], -1))

    def value(self, latent: Tensor) -> Tensor:
        """V: `[*, D] → [*]` [Q-value, in units of the learner's reward]."""
        return self.value_net(latent).squeeze(-1)


class SubgoalHead(Head):
    """IRIS, D.6 and D.7: a cVAE (Table 4) over latents `horizon` steps ahead, and a worker (Table 5) that reaches them.

    The value that ranks subgoals is the joint checkpoint's `LatentModel.value`, as in D.4 and D.5.
    """

    def __init__(self, config: ModelConfig, action_dim: int) -> None:
        super().__init__()
        latent, norm = config.width(action_dim), config.norm
        self.manager = ConditionalVAE(latent, latent, config.noise_dim, config.generative_dense, norm, bounded=False)
        self.worker = Policy(2 * latent, config.policy_dense, action_dim, norm)
        self.register_buffer("steps_ahead", torch.tensor(0))
        self.register_buffer("change_scale", torch.ones(()))
        self.steps_ahead: Tensor
        self.change_scale: Tensor

    @property
    def horizon(self) -> int:
        """How far ahead a subgoal lies [steps]."""
        return int(self.steps_ahead)

    @property
    def noise_dim(self) -> int:
        """m."""
        return self.manager.noise_dim

    def propose(self, latent: Tensor, noise: Tensor) -> Tensor:
        """Subgoals from standard noise: `[*, D], [*, m] → [*, D]`."""
        return latent + self.change_scale * self.manager.decode(latent, noise)

    def act(self, latent: Tensor, subgoal: Tensor) -> Tensor:
        """Worker: `[*, D], [*, D] → [*, A]` in [-1, 1]."""
        return self.worker(torch.cat([latent, subgoal], -1))


HEADS: dict[str, type[PolicyHead] | type[IQLHead] | type[SubgoalHead]] = {
    "bc": PolicyHead,
    "bc-success": PolicyHead,
    "iql": IQLHead,
    "iql-sparse": IQLHead,
    "iris": SubgoalHead,
    "iris-multistep": SubgoalHead,
}
"""The methods that need a head, and its class. Nothing else is ever loaded."""

AnyHead = PolicyHead | IQLHead | SubgoalHead

HEAD_FORMAT = "velap-head/1"


def head_path(checkpoint: Path | str, method: str) -> Path:
    """Where the head of a method lies: beside the joint checkpoint."""
    return Path(checkpoint).with_name(f"{method}.safetensors")


def make_head(method: str, config: ModelConfig, action_dim: int) -> AnyHead:
    """A fresh head of that method; raises UnknownTaskError for a method without one."""
    if method not in HEADS:
        raise UnknownTaskError(f"the method {method!r} has no learner of its own; expected one of {', '.join(HEADS)}.")
    head = HEADS[method](config, action_dim)
    head.method = method
    return head


def save_head(path: Path, head: AnyHead, joint_metadata: Mapping[str, str], provenance: Mapping[str, str]) -> str:
    """One safetensors file with weights, method, settings, the joint weights it belongs to and provenance; returns its
    SHA-256."""
    weights = head.state_dict()
    head.weights_sha256 = content_sha256(weights, {"method": head.method, "settings": head.settings})
    metadata = {
        **provenance,
        WEIGHTS_SHA256: head.weights_sha256,
        "format": HEAD_FORMAT,
        "method": head.method,
        "head_config": head.settings,
        "joint": shared_weights(joint_metadata),
        "code_version": __version__,
    }
    return save_tensors(path, weights, metadata)


def load_head(path: Path | str, joint_metadata: Mapping[str, str], device: torch.device | str = "cpu") -> AnyHead:
    """Head in eval mode for the joint checkpoint with this metadata (of `load_checkpoint`).

    Raises CheckpointError when the file is missing, damaged, no head, or belongs to other joint weights.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"no head at {path}; expected the file that `velap train TASK --method {path.stem}` writes "
                              "beside the joint checkpoint. Train it, or name another file.")
    tensors, metadata = load_tensors(path)
    method = metadata.get("method", "")
    if metadata.get("format") != HEAD_FORMAT or method not in HEADS:
        raise CheckpointError(f"{path} has format {metadata.get('format')!r} and method {method!r}; expected "
                              f"{HEAD_FORMAT!r} and one of {', '.join(HEADS)}. Give the file that `velap train --method` "
                              "wrote.")
    own, given = metadata.get("joint", "none"), shared_weights(joint_metadata)
    if own != given:
        raise CheckpointError(f"{path} is foreign to this joint checkpoint: it was learnt on the latents of weights "
                              f"{own[:12]}, the checkpoint has {given[:12]}. Train it again with `velap train --method "
                              f"{method}`, or give the checkpoint that lies beside it.")
    config = Config.from_json(joint_metadata["config"])
    head = make_head(method, config.model, len(json.loads(joint_metadata["spaces"])["action_low"]))
    restore(head, tensors, path)
    head.settings, head.weights_sha256 = metadata["head_config"], metadata[WEIGHTS_SHA256]
    return head.to(device).eval().requires_grad_(False)
