"""The rotors: thrust from speed and back, speed lag, and how four thrusts make one wrench.

A wrench is (*, 4): collective thrust [N] along body z, then torque [N m] about body x, y, z.
"""

import torch
from torch import Tensor

from torchrl_quad.dynamics.parameters import QuadrotorParams


def thrust_from_speed(speed: Tensor, params: QuadrotorParams) -> Tensor:
    """Rotor thrust (*, 4) [N] at the rotor speed (*, 4) [rad/s]: k2 w^2 + k1 w + k0 (paper, section II-B)."""
    k2, k1, k0 = params.thrust_map.split(1, -1)
    return (k2 * speed + k1) * speed + k0


def speed_from_thrust(thrust: Tensor, params: QuadrotorParams) -> Tensor:
    """Rotor speed (*, 4) [rad/s] that gives the thrust (*, 4) [N]: the inverse of :func:`thrust_from_speed`.

    The root is held at or above one thousandth of its value at full speed, where the slope of the inverse would be
    infinite: an error of at most 0.1 % of the top speed, and only next to the lowest point of the thrust map.
    """
    k2, k1, k0 = params.thrust_map.split(1, -1)
    floor = 1e-3 * (2.0 * k2 * params.rotor_speed_max + k1)
    discriminant = k1 * k1 + 4.0 * k2 * (thrust - k0)
    root = torch.maximum(discriminant, floor * floor).sqrt()
    return (root - k1) / (2.0 * k2)


def thrust_limits(params: QuadrotorParams) -> tuple[Tensor, Tensor]:
    """The least and the greatest thrust [N] that may be commanded of one rotor; the least is never negative."""
    low = thrust_from_speed(params.rotor_speed_min, params).clamp_min(0.0)
    return low, thrust_from_speed(params.rotor_speed_max, params)


def lagged_speed(speed: Tensor, commanded: Tensor, params: QuadrotorParams, dt: float) -> Tensor:
    """Rotor speed (*, 4) after dt [s] of first-order lag towards a constant command: exact for any dt."""
    return commanded + (speed - commanded) * torch.exp(-dt / params.motor_time_constant)


def allocation_matrix(params: QuadrotorParams) -> Tensor:
    """The matrix (*, 4, 4) that turns four rotor thrusts into a wrench, for any rotor layout.

    Torque is r x F of each rotor, (y f, -x f), plus the drag torque kappa s f about z.
    """
    x, y = params.rotor_positions.unbind(-1)
    yaw = params.torque_to_thrust * params.rotor_spin
    rows = torch.broadcast_tensors(torch.ones_like(x), y, -x, yaw)
    return torch.stack(rows, -2)


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """The product (*, 4) of a matrix (*, 4, 4) and a vector (*, 4), written so that a compiler can fuse it."""
    return (matrix * vector.unsqueeze(-2)).sum(-1)
