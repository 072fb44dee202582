"""The rigid body: Newton and Euler with drag, in the frames of the paper's section III-B."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.parameters import QuadrotorParams


class RigidBodyState(NamedTuple):
    """Six degrees of freedom."""

    position: Tensor  # (*, 3) [m], world frame
    quaternion: Tensor  # (*, 4), body to world, unit norm
    velocity: Tensor  # (*, 3) [m/s], world frame
    angular_velocity: Tensor  # (*, 3) [rad/s], body frame


def drag(velocity_body: Tensor, params: QuadrotorParams) -> Tensor:
    """Aerodynamic force (*, 3) [N], body frame, that opposes the body-frame velocity (*, 3) [m/s].

    The paper prints the quadratic part as v * v without the sign, which would push a drone that flies forward.
    """
    return torch.addcmul(params.linear_drag, params.quadratic_drag, velocity_body.abs()) * -velocity_body


def angular_acceleration(angular_velocity: Tensor, torque: Tensor, inertia: Tensor) -> Tensor:
    """Euler's equation, (*, 3) [rad/s2], body frame: J^-1 (torque - w x J w)."""
    return (torque - gyroscopic_torque(angular_velocity, inertia)) / inertia


def gyroscopic_torque(angular_velocity: Tensor, inertia: Tensor) -> Tensor:
    """w x J w, (*, 3) [N m], body frame."""
    return torch.linalg.cross(angular_velocity, inertia * angular_velocity)


def accelerations(
    state: RigidBodyState, wrench: Tensor, params: QuadrotorParams, wind: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Linear acceleration (world frame) and angular acceleration (body frame), each (*, 3), under a wrench (*, 4).

    Drag acts on the velocity relative to the wind (*, 3) [m/s], world frame; None is still air.
    """
    airspeed = state.velocity if wind is None else state.velocity - wind
    velocity_body = quaternion.rotate_inverse(state.quaternion, airspeed)
    thrust, torque = wrench.split((1, 3), -1)
    force_body = drag(velocity_body, params) + pad(thrust, (2, 0))
    linear = quaternion.rotate(state.quaternion, force_body / params.mass) - pad(params.gravity, (2, 0))
    return linear, angular_acceleration(state.angular_velocity, torque, params.inertia)
