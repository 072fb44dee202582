"""A disturbance and a loss of somebody's own, as they would stand in a package of theirs."""

from dataclasses import dataclass

from torchrl_quad import ABPTLoss
from torchrl_quad.envs.disturbances import Disturbance


@dataclass
class Push(Disturbance):
    """Push each drone at the start."""

    strength: float = 1.0

    def start(self, random, state):
        return {"velocity": state["velocity"] + self.strength * random.uniform(len(state["position"]), 3)}


class ThriftyLoss(ABPTLoss):
    """ABPT that charges for the size of actions."""

    def __init__(self, actor_network, qvalue_network, *, effort: float = 0.1, **kwargs):
        super().__init__(actor_network, qvalue_network, **kwargs)
        self.effort = effort

    def objective_parts(self, tensordict):
        action = tensordict.get(self.tensor_keys.action)
        return {**super().objective_parts(tensordict), "effort": -self.effort * action.square().sum((-2, -1))}
