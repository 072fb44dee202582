"""Carry on hovering when one of the rotors weakens to 70 % of its thrust."""

import torch
from torch.nn.functional import one_hot

from torchrl_quad import HoveringEnv

LEFT = 0.7  # of the thrust


class Damaged(HoveringEnv):
    """Any rotor, at any time in the first 2 s, which no policy is told; solved as hovering is."""

    def initial_state(self, n):
        start = super().initial_state(n)
        own = {"rotor": one_hot(self.integers(4, n), 4).to(self.dtype), "time": 1.0 + self.uniform(n, 1)}  # [s]
        return {**start, **own, ("drone", "rotor_effectiveness"): torch.ones_like(own["rotor"])}

    def advance(self, previous, state):
        is_weak = state["step"] * self.control_dt > state["time"]
        return {**state, ("drone", "rotor_effectiveness"): 1.0 - (1.0 - LEFT) * is_weak * state["rotor"]}
