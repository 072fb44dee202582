"""Fly through a window in a wall, and hover behind it."""

import torch

from torchrl_quad import HoveringEnv
from torchrl_quad.envs.terms import norm, penalties, shortened

SIDES = [((0, -2.75, 3), (0.1, 4.5, 6)), ((0, 2.75, 3), (0.1, 4.5, 6))]  # [m], centre and size
WALL = [*SIDES, ((0, 0, 0.5), (0.1, 1, 1)), ((0, 0, 4), (0.1, 1, 4))]  # to the ends of the box, but for 1 m by 1 m


class Window(HoveringEnv):
    """From 1 to 3 m before the wall; solved as hovering is, 2 m behind it."""

    defaults = {"scene": {"boxes": [{"centre": centre, "size": size} for centre, size in WALL]}}
    target = (2.0, 0.0, 1.5)
    weights = {"survival": 0.1, "way": 0.01, "slip": 0.02, "spin": 0.002}

    def initial_state(self, n):
        start = self.tensor([-2.0, 0.0, 1.5]) + self.tensor([1.0, 1.0, 0.5]) * self.uniform(n, 3)
        return {**super().initial_state(n), **self.hover_state(start)}

    def reward_terms(self, state):
        share = (1.0 + state["position"][..., :1]).clamp(0.0, 1.0)  # aims at the window, and ever farther behind it
        aim = torch.lerp(self.tensor([0.2, 0.0, 1.5]).expand_as(state["target"]), state["target"], share)
        way = aim - state["position"]
        left, slip = norm(way) + norm(state["target"] - aim), state["velocity"] - shortened(2.0 * way, 1.5)
        return penalties(self.weights, way=left, slip=slip, spin=state["angular_velocity"])
