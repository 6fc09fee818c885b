"""A baseline of another package: a linear policy of the frozen latents, cloned from all transitions."""

from torch import nn

import velap
from velap.methods.base import Method
from velap.methods.heads import Head
from velap.methods.reactive import ReactiveAgent
from velap.training.frozen import FrozenLearner, LearnerConfig


class LinearHead(Head):
    def __init__(self, config, action_dim):
        super().__init__(config, action_dim)
        self.linear = nn.Linear(self.latent_dim, action_dim)

    def act(self, latent):
        return self.linear(latent).tanh()


class LinearLearner(FrozenLearner):
    def loss(self, rows):
        loss = (self.model.act(self.data.latents[rows]) - self.data.actions[rows]).square().mean()
        return loss, {"loss": loss.detach()}


@velap.register_method("linear")
class Linear(Method):
    label, head, learner, learning = "Linear", LinearHead, LinearLearner, LearnerConfig(steps=200, batch=64)

    def agent(self, parts):
        return ReactiveAgent(self.name, parts.model, parts.head.act)
