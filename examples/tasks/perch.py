"""Touch a vertical wall, pitched up by 60 degrees, as a drone that perches there."""

import torch

from torchrl_quad import QuadrotorEnv
from torchrl_quad.dynamics.quaternion import rotate
from torchrl_quad.envs.markers import Markers, Shape
from torchrl_quad.envs.terms import body_observation, norm, outside, penalties, shortened


class Perch(QuadrotorEnv):
    """Solved by touching it slower than 1 m/s, within 10 degrees of the attitude; the target is a point in the wall."""

    defaults, ends_on_success = {"drone": "small_racer"}, True
    weights = {"survival": 0.02, "lean": 0.02, "slip": 0.008, "spin": 0.001, "touch": 20.0}  # to wait pays less

    def initial_state(self, n):
        start = self.tensor([-1.5, 0.0, 1.5]) + 0.5 * self.uniform(n, 3)
        return {**self.hover_state(start), "target": self.tensor([0.3, 0.0, 1.5]).repeat(n, 1)}

    def lean(self, state):  # how far the body's z axis is from where it should point, up and away from the wall
        return norm(rotate(state["quaternion"], self.tensor([[0.0, 0.0, 1.0]])) - self.tensor([-(0.75**0.5), 0.0, 0.5]))

    def observe(self, state):
        return torch.cat((state["target"] - state["position"], *body_observation(state)), -1)

    def reward_terms(self, state):
        way, lean = state["target"] - state["position"], self.lean(state)
        near, slip = (5.0 * state["position"][..., :1]).clamp_max(0.0).exp(), state["velocity"] - shortened(way, 1.5)
        touch = self.weights["touch"] * (state["position"][..., :1] > 0) * (-2.0 * lean - norm(state["velocity"])).exp()
        return {**penalties(self.weights, lean=near * lean, slip=slip, spin=state["angular_velocity"]), "touch": touch}

    def is_success(self, state):
        return (state["position"][..., :1] > 0) & (self.lean(state) < 0.17) & (norm(state["velocity"]) < 1.0)

    def is_crash(self, state):
        return outside(state["position"], self.tensor([-3.0, 0.0, 0.0]), 3.0, 4.0) & ~self.is_success(state)

    def markers(self):
        return Markers(shapes=[Shape.box((0.1, -1.5, 0.0), (0.2, 1.5, 3.0), name="wall")])
