"""What the phases of a training share, and what a phase is.

F frames of the dataset, D latent dimension.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn

from velap.config import Phase, TrainConfig
from velap.data.sampling import Batch, WindowSampler
from velap.losses import Info
from velap.models.velap import LatentModel
from velap.runs import make_generator
from velap.threads import TRANSITIONS_A_THREAD, one_thread
from velap.training.actor_critic import ActorCritic
from velap.training.capture import Captured, adam, set_rate
from velap.training.encoding import encode_all

FROZEN_RATE = 1e-3
"""Peak learning rate of the phases on frozen latents, cosine to a hundredth. ours."""


class Run:
    """A training run as its phases see it."""

    def __init__(self, model: LatentModel, config: TrainConfig, sampler: WindowSampler, features: Tensor, seed: int) -> None:
        self.model, self.config, self.sampler, self.features, self.seed = model, config, sampler, features, seed
        self.generator = make_generator(seed, stream=1, device=sampler.device)
        self.weight_seed = self.generator.initial_seed()
        """Seed of networks that learn beside the model."""
        self.actor_critic = ActorCritic(model, config)
        self.graphs = sampler.device.type == "cuda"
        """Updates are captured as CUDA graphs."""
        self.updates = 0
        """Updates so far of phases whose policies learn in every few of them."""

    def fresh_stream(self, stream: int) -> None:
        """Random numbers of their own from here on, whatever was drawn before."""
        self.generator.set_state(make_generator(self.seed, stream=stream, device=self.sampler.device).get_state())


class Frozen:
    """What a frozen encoder gives: all latents at hand, and fresh optimisers for what learns on them."""

    def __init__(self, run: Run) -> None:
        model = run.model
        model.encoder.requires_grad_(False).eval()
        self.latents = encode_all(model, run.sampler, run.features)
        """float32 [F, D] of every frame of the dataset."""
        rows = run.sampler.transitions
        self.step_square = (self.latents[rows + 1] - self.latents[rows]).square().sum(-1).mean()
        """float32 [], mean square one-step change [latent distance²]."""
        parts = (model.dynamics, model.local_critics, model.global_critic)
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "model": adam([p for part in parts for p in part.parameters()], FROZEN_RATE),
            "policy": adam(run.actor_critic.policy_parameters, FROZEN_RATE)}
        """Of h and the critics, and of the policies and g; they go on from phase to phase."""


def start_heads_afresh(run: Run) -> None:
    """New weights for all but φ, targets included: without a joint phase the heads begin here."""
    drawn = torch.randint(2**31, (1,), generator=run.generator, device=run.generator.device)
    run.model.start_heads_afresh(int(drawn))
    run.actor_critic.copy_targets()


PhaseT = TypeVar("PhaseT", bound=Phase)


class PhaseLearner(ABC, Generic[PhaseT]):
    """The updates of one phase. Made when the phase begins; a resume makes it anew and loads `modules` and `optimizers`."""

    def __init__(self, phase: PhaseT, run: Run) -> None:
        self.phase, self.run = phase, run
        self.modules: dict[str, nn.Module] = {}
        """Networks beside the model by name."""
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        """By name."""
        self._captured: dict[str, Captured] = {}

    @classmethod
    def check(cls, phase: PhaseT, sampler: WindowSampler) -> None:
        """Raises DatasetError where the data lack what the phase needs; before the first update of the whole run."""

    def begin(self) -> None:
        """Right before the first update of the phase, not on a resume within it."""

    @abstractmethod
    def update(self, done: int) -> Info:
        """Update number `done` of the phase."""

    def set_rate(self, rate: float) -> None:
        """The learning rate of all optimisers."""
        for optimizer in self.optimizers.values():
            set_rate(optimizer, rate)

    def captured(self, name: str, update: Callable[[], Info]) -> Info:
        """`update()`; on a GPU it is captured as a graph, once for each name."""
        if not self.run.graphs:
            return update()
        if name not in self._captured:
            self._captured[name] = Captured(update, self.run.generator)
        return self._captured[name]()

    def in_turn(self, update: Callable[[bool], Info]) -> Info:
        """`update(policies)`, where the policies learn in every `policy_every`-th update."""
        self.run.updates += 1
        policies = self.run.updates % self.run.config.policy_every == 0
        return self.captured(f"policies {policies}", partial(update, policies))


def few_threads(batch: Batch) -> AbstractContextManager[None]:
    """One thread for the heads while a batch is small."""
    return one_thread(batch.now_at.device, len(batch.now_at) <= TRANSITIONS_A_THREAD)
