"""Recover from upside down, and hover."""

import torch

from torchrl_quad import HoveringEnv
from torchrl_quad.dynamics.quaternion import from_axis_angle, up_in_body
from torchrl_quad.envs.terms import norm, penalties


class Flip(HoveringEnv):
    """From 3 m up, within 0.3 rad of upside down, tumbling; solved as hovering is, 0.1 m from the target."""

    defaults = {"drone": "small_racer", "random_start": {"yaw": 3.14, "velocity": 1.0, "angular_velocity": 1.0}}
    target, start_range, box_height = (0.0, 0.0, 3.0), (0.5, 0.5, 0.5), 8.0
    weights = {"survival": 0.1, "position": 0.01, "tilt": 0.01, "velocity": 0.003, "spin": 0.002}

    def initial_state(self, n):
        axis = torch.nn.functional.normalize(self.normal(n, 2), dim=-1)
        turn = torch.cat(((torch.pi + 0.3 * self.uniform(n, 1)) * axis, torch.zeros_like(axis[:, :1])), -1)
        return {**super().initial_state(n), "quaternion": from_axis_angle(turn)}

    def reward_terms(self, state):
        up = up_in_body(state["quaternion"])
        tilt = torch.atan2(norm(up[..., :2]), up[..., 2:])  # its slope is the same upside down
        errors = {"position": state["target"] - state["position"], "tilt": tilt, "velocity": state["velocity"]}
        return penalties(self.weights, **errors, spin=state["angular_velocity"])
