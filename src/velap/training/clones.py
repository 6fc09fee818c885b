"""Policies cloned from the successes; of several the one that gets to the goal most often by the model is kept (ours).

Successes cover a part of the states only; where a clone goes from anywhere else is an accident of its first weights. h and
Q^g tell the accidents apart without an environment.

F frames, D latent.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from velap.config.training import TrainConfig
from velap.data.sampling import WindowSampler
from velap.losses import Info, cloning_error
from velap.models.arrivals import arrivals
from velap.models.horizon import q_from_steps
from velap.models.velap import LatentModel
from velap.threads import TRANSITIONS_A_THREAD, one_thread
from velap.training.capture import adam
from velap.training.latents import evaluated

BATCH = 256
"""Transitions a batch. ours."""
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
def arrival_rate(model: LatentModel, states: Tensor) -> float:
    """Share of the states [*, D] in the half farther from the goal from where the cloned policy gets there by h, averaged
    over the gains that the controller tries: one that arrives at any gain tells good clones apart better than the best."""
    assert model.success_policy is not None, "the model has no policy cloned from successes"
    values = model.value(states)
    far = states[values <= values.median()]
    goal_value = q_from_steps(GOAL_EXPONENT, model.discount)
    found = arrivals(model.success_policy, model.step, model.value, far, goal_value, HORIZON)
    return float((~found.steps.isinf()).float().mean())


class Clones(nn.Module):
    """The best clone so far."""

    def __init__(self, policy: nn.Module) -> None:
        super().__init__()
        self.best = copy.deepcopy(policy).requires_grad_(False)
        self.register_buffer("rate", torch.tensor(-1.0))
        self.rate: Tensor
        """float32 [], its arrival rate; -1 before the first."""

    def judge(self, model: LatentModel, cache: Tensor, rows: Tensor, generator: torch.Generator) -> float:
        """Keep the model's clone if it arrives more often than the best one; returns its arrival rate.

        cache [F, D] are latents, `rows` int64 [*] those to draw states from.
        """
        assert model.success_policy is not None, "the model has no policy cloned from successes"
        drawn = rows[torch.randint(len(rows), (STATES,), generator=generator, device=rows.device)]
        rate = arrival_rate(model, cache[drawn])
        if rate > float(self.rate):
            self.best.load_state_dict(model.success_policy.state_dict())
            self.rate.fill_(rate)
        return rate


class Cloning:
    """Learns the policy of successes on cached latents, mean-squared error as in D.1; `clone_candidates` policies share the
    updates, one after the other."""

    def __init__(self, policy: nn.Module, config: TrainConfig, sampler: WindowSampler) -> None:
        self.policy, self.config, self.sampler = policy, config, sampler
        self.rows = sampler.successes(config.clone_reach)
        """int64 [*], transitions that are cloned."""
        self.candidates = Clones(policy) if config.clone_candidates > 1 else None
        self.optimizer = self._optimise()

    def _optimise(self) -> torch.optim.Optimizer:
        return adam(self.policy.parameters(), self.config.latent_learning_rate)

    def _part(self, steps: int) -> int:
        """Updates of a candidate [steps]."""
        return -(-steps // self.config.clone_candidates)

    def progress(self, done: int, steps: int) -> float:
        """Share of the present candidate's updates that `done` of all `steps` leave behind."""
        part = self._part(steps)
        return done % part / min(part, steps - done // part * part)

    def begin(self, done: int, steps: int, generator: torch.Generator) -> bool:
        """Give a candidate whose first update comes weights and an optimiser of its own; says whether it did."""
        if self.candidates is None or done % self._part(steps):
            return False
        fresh(self.policy, generator)
        self.optimizer = self._optimise()
        return True

    def update(self, cache: Tensor, generator: torch.Generator) -> Info:
        """One update. cache [F, D]."""
        drawn = torch.randint(len(self.rows), (BATCH,), generator=generator, device=self.rows.device)
        rows = self.rows[drawn]
        self.optimizer.zero_grad(set_to_none=True)
        with one_thread(rows.device, len(rows) <= TRANSITIONS_A_THREAD):
            loss = cloning_error(self.policy(cache[rows]), self.sampler.actions[rows]).mean()
            loss.backward()
            self.optimizer.step()
        return {"clone/loss": loss.detach()}

    def finish(self, model: LatentModel, cache: Tensor, done: int, steps: int, generator: torch.Generator) -> Info:
        """Judge a candidate after its last update; after the last of all the best one is left in the model. cache [F, D]."""
        part, last = self._part(steps), done == steps - 1
        if self.candidates is None or not (done % part == part - 1 or last):
            return {}
        with evaluated(model):
            rate = self.candidates.judge(model, cache, self.sampler.transitions, generator)
        if last:
            self.policy.load_state_dict(self.candidates.best.state_dict())
        return {"clone/arrival_rate": torch.tensor(rate)}
