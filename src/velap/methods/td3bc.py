"""TD3-BC, App. D.2: π^g of the joint checkpoint at every step, without a plan."""

from __future__ import annotations

from velap.methods.base import Agent, Method, Parts
from velap.methods.reactive import ReactiveAgent
from velap.registry import register_method


@register_method("td3bc")
class TD3BC(Method):
    """π^g alone, learnt by the joint training."""

    label = "TD3-BC"

    def agent(self, parts: Parts) -> Agent:
        """π^g at every step."""
        return ReactiveAgent(self.name, parts.model, parts.model.act_global)
