"""The geometric controller on SE(3)."""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchrl_quad.controllers.policy import Controller, Reference, State, follow
from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.control import Tilt
from torchrl_quad.options import between, checked

LEAST_LIFT = 0.3  # vertical part of the thrust, in weights: the drone never turns over to dive
GREATEST_LIFT = 0.9  # of the greatest thrust: there is always some left to go sideways

Gain = Annotated[float, between(1e-3, 1e3)]


@checked
class GeometricController(Controller):
    r"""Geometric tracking control (Lee, Leok and McClamroch 2010) for thrust and body rates.

    With the errors of position and velocity :math:`e_x = x - x_d` and :math:`e_v = v - v_d`, and the attitude R (body
    to world), it takes from the paper

    - the force :math:`F = m (-k_x e_x - k_v e_v + g\,e_3 + a_d)`, and from it the thrust :math:`f = F \cdot R e_3`;
    - the wanted attitude :math:`R_d`, whose third axis is :math:`b_3 = F / |F|` and whose first is next to a heading;
    - the attitude error :math:`e_R = \frac12 (R_d^T R - R^T R_d)^\vee`, the sine of the angle left to turn.

    Lee's law ends in moments. Actions here are body rates, :math:`\Omega_c = R^T R_d \Omega_d - k_R e_R`, and the rate
    loop below turns them into his moments, but for his term of :math:`\dot\Omega_d` and its own damping.
    :math:`\Omega_d` is the rate at which :math:`a_d + g\,e_3` turns, from the jerk of the reference.

    F keeps within the greatest thrust and tilt, its vertical part first, and at least 0.3 of the weight; the action is
    clamped. ``env.rollout(256, GeometricController(env))`` flies it.

    Args:
        env: as for :class:`~torchrl_quad.controllers.policy.Controller`, which gives the errors, too.
        reference: likewise; its derivatives are taken by central differences.
        position_gain: :math:`k_x`, 0.001 to 1000 per s2.
        velocity_gain: :math:`k_v`, 0.001 to 1000 per s.
        attitude_gain: :math:`k_R`, 0.001 to 1000 per s; None makes this loop half as quick as the drone's rate loop.
        max_error: greatest error of the position that counts, 0.001 to 1000 m.
        max_tilt: greatest angle of F from the vertical, 0.01 to 1.5 rad, 86 degrees.
        heading: angle of :math:`b_1` from world x, -2 pi to 2 pi rad; None leaves it where it is.
    """

    def __init__(
        self,
        env: Any,
        *,
        reference: Reference | None = None,
        position_gain: Gain = 10.0,
        velocity_gain: Gain = 5.0,
        attitude_gain: Gain | None = None,
        max_error: Gain = 1.0,
        max_tilt: Tilt = 1.3,
        heading: Annotated[float, between(-2.0 * math.pi, 2.0 * math.pi)] | None = None,
    ) -> None:
        super().__init__(env, reference)
        self.position_gain, self.velocity_gain, self.max_error = position_gain, velocity_gain, max_error
        self.max_tilt, like = max_tilt, self.nominal.mass
        self.ahead = None if heading is None else like.new_tensor((math.cos(heading), math.sin(heading), 0.0))
        lag = (1.0 + self.nominal.rate_damping / self.nominal.inertia) / self.nominal.rate_gain  # of the rate loop [s]
        self.attitude_gain = 0.5 / lag if attitude_gain is None else torch.full_like(lag, attitude_gain)
        self.gravity = pad(self.nominal.gravity, (2, 0))

    def act(self, state: State, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for the drone as it will be when the action takes effect."""
        attitude, times = state["quaternion"], state["position"].new_full((1,), self.lead)
        position, velocity, acceleration, jerk = (x[:, 0] for x in follow(self.reference, state, times))
        position_error, velocity_error = position - state["position"], velocity - state["velocity"]
        far = torch.linalg.vector_norm(position_error, dim=-1, keepdim=True)
        position_error = position_error * (self.max_error / far.clamp_min(self.max_error))
        correction = self.position_gain * position_error + self.velocity_gain * velocity_error
        force = self.within_limits(correction + acceleration + self.gravity)  # per mass [m/s2]
        up = normalize(force, dim=-1)
        axes = torch.eye(3).to(attitude).expand(len(attitude), 3, 3)
        rotation = quaternion.rotate(attitude.unsqueeze(1), axes).mT
        ahead = rotation[..., 0] if self.ahead is None else self.ahead.expand_as(up)  # body x keeps close to this
        left = normalize(torch.linalg.cross(up, ahead), dim=-1)
        wanted = torch.stack((torch.linalg.cross(left, up), left, up), -1)
        difference = wanted.mT @ rotation
        skew = 0.5 * (difference - difference.mT)
        error = torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), -1)  # Lee's e_R, body frame
        steady = acceleration + self.gravity
        turn = torch.linalg.cross(steady, jerk) / steady.square().sum(-1, keepdim=True).clamp_min(1e-6)
        rates = quaternion.rotate_inverse(attitude, turn) - self.attitude_gain * error
        thrust = self.nominal.mass * (force * rotation[..., 2]).sum(-1, keepdim=True)
        action = self.dynamics.controller.encode(torch.cat((thrust, rates), -1))
        return tensordict.set("action", action.clamp(-1.0, 1.0))

    def within_limits(self, force: Tensor) -> Tensor:
        """The force per mass (n, 3) [m/s2] that the drone can fly: its vertical part comes first."""
        gravity = self.nominal.gravity
        greatest = self.nominal.max_thrust_to_weight * gravity
        lift = torch.minimum(torch.maximum(force[..., 2:], LEAST_LIFT * gravity), GREATEST_LIFT * greatest)
        room = torch.minimum((greatest.square() - lift.square()).sqrt(), math.tan(self.max_tilt) * lift)
        sideways = torch.linalg.vector_norm(force[..., :2], dim=-1, keepdim=True)
        return torch.cat((force[..., :2] * (room / torch.maximum(sideways, room)), lift), -1)
