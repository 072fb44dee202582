"""Measure the energy and the tilt of a flight, and print and draw them like the metrics of the package."""

import math

import torch

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor
from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs.metrics import Metric, first_episode
from torchrl_quad.render import plot_flight

STEPS = 256


class MeteredHovering(HoveringEnv):
    """Hovering that also measures the tilt and the work of the rotors."""

    metric_info = {  # how reports and pictures show each metric; values are in SI units
        **HoveringEnv.metric_info,
        "tilt": Metric("greatest tilt", "deg", 180 / math.pi),
        "energy": Metric("rotor energy", "J", median=True),
    }

    def initial_state(self, n):
        """The start of hovering; ``energy`` (1) [J] is kept in the state, because a later step needs it."""
        start = super().initial_state(n)
        return {**start, "energy": torch.zeros_like(start["position"][:, :1])}

    def advance(self, previous, state):
        """Add the work of one control step: torque times speed, summed over the rotors."""
        speed, drone = state["rotor_speed"], self.nominal
        k2, k1, k0 = drone.thrust_map.split(1, -1)
        power = (drone.yaw_torque_coefficient * (k2 * speed.square() + k1 * speed + k0) * speed).sum(-1, keepdim=True)
        return {**state, "energy": previous["energy"] + power * self.control_dt}

    def metrics(self, state):
        """Of a state, each (n, 1); an episode takes those at its end."""
        up = quaternion.rotate(state["quaternion"], self.tensor([0.0, 0.0, 1.0]).expand_as(state["position"]))
        tilt = up[:, 2:].clamp(-1.0, 1.0).acos()
        return {**super().metrics(state), "tilt": tilt, "energy": state["energy"]}

    def episode_metrics(self, rollout):
        """The tilt of an episode is its greatest."""
        first = first_episode(rollout)
        greatest = (rollout["next", "metrics", "tilt"] * first).amax((1, 2))
        return {**super().episode_metrics(rollout), "tilt": greatest}


torch.manual_seed(0)
env = MeteredHovering(num_envs=16)
with torch.no_grad():
    flight, _ = differentiable_rollout(env, make_actor(env), None, STEPS)
for name, values in env.episode_metrics(flight).items():
    metric = env.metric_info[name]
    print(f"{metric.label:18} {metric.format(metric.summarise(values))}")
plot_flight(flight, "flight.png", env=env)
