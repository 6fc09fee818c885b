"""Policies cloned from the successes; of several the one that gets to the goal most often by the model is kept (ours).

Successes cover a part of the states only; where a clone goes from anywhere else is an accident of its first weights. h and
Q^g tell the accidents apart without an environment.

F frames, D latent.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from velap.config import ClonePhase
from velap.data.sampling import WindowSampler
from velap.losses import Info, cloning_error
from velap.models.arrivals import arrivals
from velap.models.horizon import q_from_steps
from velap.models.velap import LatentModel
from velap.threads import TRANSITIONS_A_THREAD, one_thread
from velap.training.capture import adam
from velap.training.encoding import encode_rows, evaluated
from velap.training.phase import FROZEN_RATE, Frozen, PhaseLearner, Run
from velap.training.steps import cosine

BATCH = 256
"""Transitions a batch. ours."""
STREAM = 6
"""Random numbers of the phase, so that clones can be learnt again beside the same model."""
STATES = 3_000
"""States of the data that are looked at; simulations start from the half of them that is farther from the goal by Q^g."""
HORIZON = 150
"""Simulated steps [steps]."""
GOAL_EXPONENT = 5.0
"""The goal is there where Q^g is above γ^this, as in Table 8."""


def fresh(policy: nn.Module, generator: torch.Generator) -> None:
    """New weights for all layers."""
    seed = int(torch.randint(2**31, (1,), generator=generator, device=generator.device))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for module in policy.modules():
            if isinstance(module, nn.Linear | nn.LayerNorm | nn.BatchNorm1d):
                module.reset_parameters()


@torch.no_grad()
def arrival_rate(model: LatentModel, policy: nn.Module, states: Tensor) -> float:
    """Share of the states [*, D] in the half farther from the goal from where a cloned policy gets there by h, averaged over
    gains on its actions: that tells good clones apart better than its own gain alone."""
    values = model.value(states)
    far = states[values <= values.median()]
    goal_value = q_from_steps(GOAL_EXPONENT, model.discount)
    found = arrivals(policy, model.step, model.value, far, goal_value, HORIZON)
    return float((~found.steps.isinf()).float().mean())


@torch.no_grad()
def measure_arrivals(model: LatentModel, sampler: WindowSampler, generator: torch.Generator) -> None:
    """Sets `arrival_rates` of a model with a clone, on a CPU generator's choice of states of the data."""
    policy, pool = model.success_policy, sampler.transitions
    assert policy is not None, "there is a clone to measure"
    rows = pool[torch.randint(len(pool), (STATES,), generator=generator).to(pool.device)]
    with evaluated(model):
        states = encode_rows(model, sampler, rows)
        rates = [arrival_rate(model, each, states) for each in (model.global_policy, policy)]
    model.arrival_rates.copy_(torch.tensor(rates))


class Best(nn.Module):
    """The best clone so far."""

    def __init__(self, policy: nn.Module) -> None:
        super().__init__()
        self.policy = copy.deepcopy(policy).requires_grad_(False)
        self.register_buffer("rate", torch.tensor(-1.0))
        self.rate: Tensor
        """float32 [], its arrival rate; -1 before the first."""

    def keep(self, policy: nn.Module, rate: float) -> None:
        """Take a clone that arrives more often."""
        if rate > float(self.rate):
            self.policy.load_state_dict(policy.state_dict())
            self.rate.fill_(rate)


class CloneLearner(PhaseLearner[ClonePhase]):
    """Clones successes by mean-squared error as in D.1; `candidates` policies share the updates, one after the other."""

    def __init__(self, phase: ClonePhase, run: Run, frozen: Frozen) -> None:
        super().__init__(phase, run)
        policy = run.model.success_policy
        assert policy is not None, "a clone phase gives the model a policy of successes"
        self.policy, self.latents = policy, frozen.latents
        self.rows = run.sampler.successes()
        """int64 [*], transitions that are cloned."""
        self.best = Best(policy)
        self.modules = {"best": self.best}
        self.optimizers = {"clone": adam(policy.parameters(), FROZEN_RATE)}
        self.part = -(-phase.steps // phase.candidates)
        """Updates of a candidate [steps]; the last one takes what is left."""

    @classmethod
    def check(cls, phase: ClonePhase, sampler: WindowSampler) -> None:
        """Raises DatasetError where no episode succeeds."""
        sampler.successes()

    def begin(self) -> None:
        """Random numbers of its own."""
        self.run.fresh_stream(STREAM)

    def update(self, done: int) -> Info:
        """One update of the present candidate, from weights of its own; after its last one it is judged, and the best of all
        is left in the model."""
        several, within = self.phase.candidates > 1, done % self.part
        if several and within == 0:
            fresh(self.policy, self.run.generator)
            self.optimizers["clone"] = adam(self.policy.parameters(), FROZEN_RATE)
            self._captured.clear()
        updates = min(self.part, self.phase.steps - (done - within))
        self.set_rate(FROZEN_RATE * cosine(within / updates))
        info = self.captured("clone", self._update)
        if several and within == updates - 1:
            info = {**info, "clone/arrival_rate": torch.tensor(self._judge())}
        if several and done == self.phase.steps - 1:
            self.policy.load_state_dict(self.best.policy.state_dict())
        return info

    def _update(self) -> Info:
        drawn = torch.randint(len(self.rows), (BATCH,), generator=self.run.generator, device=self.rows.device)
        rows, optimizer = self.rows[drawn], self.optimizers["clone"]
        optimizer.zero_grad(set_to_none=True)
        with one_thread(rows.device, len(rows) <= TRANSITIONS_A_THREAD):
            loss = cloning_error(self.policy(self.latents[rows]), self.run.sampler.actions[rows]).mean()
            loss.backward()
            optimizer.step()
        return {"clone/loss": loss.detach()}

    def _judge(self) -> float:
        """Arrival rate of the present candidate, which is kept where it is the best so far."""
        pool, generator = self.run.sampler.transitions, self.run.generator
        drawn = pool[torch.randint(len(pool), (STATES,), generator=generator, device=pool.device)]
        with evaluated(self.run.model):
            rate = arrival_rate(self.run.model, self.policy, self.latents[drawn])
        self.best.keep(self.policy, rate)
        return rate
