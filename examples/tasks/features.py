"""Hover by where a camera sees seven landmarks, without position, attitude or velocity; after Heeg et al. 2025."""

import torch

from torchrl_quad import HoveringEnv
from torchrl_quad.dynamics.quaternion import rotate_inverse


class Features(HoveringEnv):
    """Recover from a tilt and a push, 3 m before seven landmarks on a wall; solved as hovering is. It takes a memory.

    Observed: of each landmark ten times its place in the image of a camera that looks ahead, 90 degrees wide and high,
    -1 to 1, or zeros, and whether it is in the image; and the last command.
    """

    defaults = {
        "observe_last_action": True,
        "random_start": {"tilt": 0.5, "yaw": 0.3, "velocity": 1.0, "angular_velocity": 1.0},
    }
    privileged = dict.fromkeys(("position", "quaternion", "velocity", "angular_velocity"), 1.0)
    target, start_range = (0.0, 0.0, 1.5), (0.5, 0.5, 0.5)
    sides = ((-1, 0.7), (-1, 2.3), (0, 0.5), (0, 1.5), (0, 2.5), (1, 0.7), (1, 2.3))  # y and z [m], at x = 3 m

    def set_up(self):
        super().set_up()
        self.landmarks = self.tensor([(3.0, *side) for side in self.sides])

    def observe(self, state):
        way = self.landmarks - state["position"].unsqueeze(-2)
        ahead, aside = rotate_inverse(state["quaternion"].unsqueeze(-2), way).split((1, 2), -1)
        place = aside / ahead.clamp_min(0.1)
        seen = (ahead > 0.1) & (place.abs() < 1.0).all(-1, keepdim=True)
        return torch.cat((torch.where(seen, 10.0 * place, 0.0), seen.to(place)), -1).flatten(-2)

    def observation_bounds(self):
        return self.tensor([10.0] * 21)
