"""The rotors: thrust from speed and back, speed lag, and how four thrusts make one wrench.

A wrench is (*, 4): collective thrust [N] along body z, then torque [N m] about body x, y, z.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.vector import Components, Vector, matvec, unbind, unbind_rows, where_positive


class Rotors:
    """The four rotors of a drone, with what follows from its parameters worked out once.

    The thrust map k2 w^2 + k1 w + k0 (paper, section III-B) is kept as k2 (w - w0)^2 + f0, which is quick both ways.
    """

    def __init__(self, params: QuadrotorParams) -> None:
        k2, k1, k0 = (params.thrust_map[..., i : i + 1] for i in range(3))
        self.curvature = k2
        self.vertex_speed = -k1 / (k2 * 2.0)
        self.vertex_thrust = k0 - k1 * k1 / (k2 * 4.0)
        self.least_root = (params.rotor_speed_max - self.vertex_speed).square() * 1e-6
        self.time_constant = params.motor_time_constant
        self.allocation = allocation_matrix(params)

    def unbind(self) -> Rotors:
        """The same on components."""
        apart = copy.copy(self)
        for name, value in vars(self).items():
            setattr(apart, name, unbind_rows(value) if name == "allocation" else unbind(value, constant=True))
        return apart

    def thrust(self, speed: Vector) -> Vector:
        """Rotor thrust (*, 4) [N] at the rotor speed (*, 4) [rad/s]."""
        return self.vertex_thrust.addcmul(self.curvature, (speed - self.vertex_speed).square())

    def speed(self, thrust: Vector) -> Vector:
        """Rotor speed (*, 4) [rad/s] that gives the thrust (*, 4) [N]: the inverse of :meth:`thrust`.

        Next to the lowest point of the thrust map, where the slope of the inverse is infinite, the speed is held one
        thousandth of its range above that point, so that derivatives stay finite.
        """
        squared = (thrust - self.vertex_thrust) / self.curvature
        return squared.maximum(self.least_root).sqrt() + self.vertex_speed

    def wrench(self, speed: Vector) -> Vector:
        """The wrench (*, 4) on the body at the rotor speeds (*, 4) [rad/s]."""
        return matvec(self.allocation, self.thrust(speed))

    def follow(self, speed: Vector, commanded: Vector, dt: float) -> Vector:
        """Rotor speed (*, 4) after dt [s] of first-order lag towards a constant command: exact for any dt."""
        remains = (-dt / self.time_constant).exp()
        if remains.shape[-1] > 1:  # one rotor speeds up at the pace of the first, and slows down at that of the second
            remains = where_positive(commanded - speed, remains[..., :1], remains[..., 1:])
        return commanded.addcmul(remains, speed - commanded)


def thrust_limits(params: QuadrotorParams) -> tuple[Tensor, Tensor]:
    """The least and the greatest thrust [N] that may be commanded of one rotor; the least is never negative."""
    rotors = Rotors(params)
    return rotors.thrust(params.rotor_speed_min).clamp_min(0.0), rotors.thrust(params.rotor_speed_max)


def allocation_matrix(params: QuadrotorParams) -> Vector:
    """The matrix (*, 4, 4) that turns four rotor thrusts into a wrench, for any rotor layout.

    Torque is r x F of each rotor, (y f, -x f), plus the drag torque kappa s f about z. The paper prints the matrix of a
    "+" frame; published drones are X frames.
    """
    yaw = params.yaw_torque_coefficient * params.rotor_spin
    if isinstance(yaw, Components):  # then the positions are (x, y, x, y, ...)
        x, y = params.rotor_positions[..., 0::2], params.rotor_positions[..., 1::2]
        return Components([Components([1.0]), y, -x, yaw])
    x, y = params.rotor_positions.unbind(-1)
    return torch.stack(torch.broadcast_tensors(torch.ones_like(x), y, -x, yaw), -2)
