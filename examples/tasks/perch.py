"""Touch a vertical wall, pitched up by 60 degrees, as a drone that perches there."""

from torchrl_quad import LandingEnv
from torchrl_quad.dynamics.quaternion import rotate
from torchrl_quad.envs.markers import Markers, Shape
from torchrl_quad.envs.terms import Event, level_crossing, norm, outside, penalties, shortened


class Perch(LandingEnv):
    """Solved by touching it slower than 1.5 m/s, within 10 degrees of the attitude; the target is 0.9 m in the wall."""

    defaults, success_height = {"drone": "small_racer"}, 10.0
    target, start_centre, start_range = (1.0, 0.0, 1.5), (-1.5, 0.0, 1.5), 0.5
    weights = {"survival": 0.02, "lean": 0.02, "slip": 0.012, "spin": 0.001, "touch": 20.0}  # to wait pays less

    def lean(self, state):  # how far the body's z axis is from where it should point, up and away from the wall
        return norm(rotate(state["quaternion"], self.tensor([[0.0, 0.0, 1.0]])) - self.tensor([-(0.75**0.5), 0.0, 0.5]))

    def touch(self, state):
        fast = (norm(state["velocity"]) - 1.0).clamp_min(0.0)
        return self.weights["touch"] * (-2.0 * self.lean(state) - fast).exp()

    def reward_terms(self, state):
        near, way = (5.0 * state["position"][..., :1]).clamp_max(0.0).exp(), state["target"] - state["position"]
        costs = penalties(self.weights, slip=state["velocity"] - shortened(way, 1.5), spin=state["angular_velocity"])
        touch = self.touch(state) * (state["position"][..., :1] > 0)
        return {**costs, "lean": self.weights["lean"] * near * (1.0 - self.lean(state)), "touch": touch}

    def events(self, previous, state):
        time = level_crossing(-previous["position"][..., :1], -state["position"][..., :1], 0.0)
        return {"touch": Event(state["position"][..., :1] > 0, time, self.touch(state))}

    def is_success(self, state):
        return (state["position"][..., :1] > 0) & (self.lean(state) < 0.17) & (norm(state["velocity"]) < 1.5)

    def is_crash(self, state):
        return outside(state["position"], self.tensor([-3.0, 0.0, 0.0]), 3.0, 4.0) & ~self.is_success(state)

    def markers(self):
        return Markers(shapes=[Shape.box((0.1, -1.5, 0.0), (0.2, 1.5, 3.0), name="wall")])
