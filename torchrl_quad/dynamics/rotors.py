"""The rotors: thrust from speed and back, speed lag, and how four thrusts make one wrench.

A wrench is (*, 4): collective thrust [N] along body z, then torque [N m] about body x, y, z.
"""

import torch
from torch import Tensor

from torchrl_quad.dynamics.parameters import QuadrotorParams


class Rotors:
    """The four rotors of a drone, with what follows from its parameters worked out once.

    The thrust map k2 w^2 + k1 w + k0 (paper, section III-B) is kept as k2 (w - w0)^2 + f0, which is quick both ways.
    """

    def __init__(self, params: QuadrotorParams) -> None:
        k2, k1, k0 = params.thrust_map.split(1, -1)
        self.curvature = k2
        self.vertex_speed = -k1 / (2.0 * k2)
        self.vertex_thrust = k0 - k1 * k1 / (4.0 * k2)
        self.least_root = 1e-6 * (params.rotor_speed_max - self.vertex_speed).square()
        self.rate = -1.0 / params.motor_time_constant
        self.allocation = allocation_matrix(params)

    def thrust(self, speed: Tensor) -> Tensor:
        """Rotor thrust (*, 4) [N] at the rotor speed (*, 4) [rad/s]."""
        return torch.addcmul(self.vertex_thrust, self.curvature, (speed - self.vertex_speed).square())

    def speed(self, thrust: Tensor) -> Tensor:
        """Rotor speed (*, 4) [rad/s] that gives the thrust (*, 4) [N]: the inverse of :meth:`thrust`.

        Next to the lowest point of the thrust map, where the slope of the inverse is infinite, the speed is held one
        thousandth of its range above that point, so that derivatives stay finite.
        """
        squared = (thrust - self.vertex_thrust) / self.curvature
        return self.vertex_speed + torch.maximum(squared, self.least_root).sqrt()

    def wrench(self, speed: Tensor) -> Tensor:
        """The wrench (*, 4) on the body at the rotor speeds (*, 4) [rad/s]."""
        return apply(self.allocation, self.thrust(speed))

    def follow(self, speed: Tensor, commanded: Tensor, dt: float) -> Tensor:
        """Rotor speed (*, 4) after dt [s] of first-order lag towards a constant command: exact for any dt."""
        return torch.lerp(commanded, speed, torch.exp(self.rate * dt))


def thrust_limits(params: QuadrotorParams) -> tuple[Tensor, Tensor]:
    """The least and the greatest thrust [N] that may be commanded of one rotor; the least is never negative."""
    rotors = Rotors(params)
    return rotors.thrust(params.rotor_speed_min).clamp_min(0.0), rotors.thrust(params.rotor_speed_max)


def allocation_matrix(params: QuadrotorParams) -> Tensor:
    """The matrix (*, 4, 4) that turns four rotor thrusts into a wrench, for any rotor layout.

    Torque is r x F of each rotor, (y f, -x f), plus the drag torque kappa s f about z. The paper prints the matrix of a
    "+" frame; published drones are X frames.
    """
    x, y = params.rotor_positions.unbind(-1)
    yaw = params.torque_to_thrust * params.rotor_spin
    return torch.stack(torch.broadcast_tensors(torch.ones_like(x), y, -x, yaw), -2)


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """The product (*, 4) of a matrix (*, 4, 4) and a vector (*, 4), written so that a compiler can fuse it."""
    return (matrix * vector.unsqueeze(-2)).sum(-1)
