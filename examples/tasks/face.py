"""Hover at a point, and turn to face a target that circles around it."""

import torch

from torchrl_quad import QuadrotorEnv
from torchrl_quad.dynamics.quaternion import rotate_inverse, up_in_body
from torchrl_quad.envs.terms import outside, penalties


class Face(QuadrotorEnv):
    """It circles at up to 1 rad/s; solved by facing it within 0.1 rad, 0.1 m from home along each axis, at the end."""

    weights = {"survival": 0.1, "home": 0.02, "heading": 0.02, "velocity": 0.005, "spin": 0.002}

    def initial_state(self, n):
        home = self.tensor([0.0, 0.0, 1.5]).repeat(n, 1)
        own = {"home": home, "phase": torch.pi * self.uniform(n, 1), "rate": self.uniform(n, 1)}
        return self.advance(own, {**self.hover_state(home + 0.5 * self.uniform(n, 3)), **own})

    def advance(self, previous, state):
        phase = state["phase"] + self.control_dt * state["rate"]  # [rad]
        circle = torch.cat((phase.cos(), phase.sin(), 0.0 * phase), -1)
        return {**state, "phase": phase, "target": state["home"] + 3.0 * circle}

    def errors(self, state):  # in the body frame: which way north is does not matter
        home, way = (rotate_inverse(state["quaternion"], state[x] - state["position"]) for x in ("home", "target"))
        return {"home": home, "heading": torch.atan2(way[:, 1:2], way[:, :1])}

    def observe(self, state):
        level, velocity = 10.0 * up_in_body(state["quaternion"]), rotate_inverse(state["quaternion"], state["velocity"])
        return torch.cat((*self.errors(state).values(), level, velocity, state["angular_velocity"], state["rate"]), -1)

    def reward_terms(self, state):
        return penalties(self.weights, **self.errors(state), velocity=state["velocity"], spin=state["angular_velocity"])

    def is_crash(self, state):
        return outside(state["position"], state["home"], 3.0, 4.0)

    def is_success(self, state):
        return torch.cat([*self.errors(state).values()], -1).abs().amax(-1, keepdim=True) < 0.1
