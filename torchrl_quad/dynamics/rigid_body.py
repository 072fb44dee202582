"""The rigid body: Newton and Euler with drag, in the frames of the paper's section III-B."""

from typing import NamedTuple

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.vector import Components, Vector, along_z, cat, cross, multiply_add


class RigidBodyState(NamedTuple):
    """Six degrees of freedom."""

    position: Vector  #: (*, 3) [m], world frame
    quaternion: Vector  #: (*, 4), body to world, unit norm
    velocity: Vector  #: (*, 3) [m/s], world frame
    angular_velocity: Vector  #: (*, 3) [rad/s], body frame


def drag(velocity_body: Vector, params: QuadrotorParams) -> Vector:
    """Aerodynamic force (*, 3) [N], body frame, that opposes the body-frame velocity (*, 3) [m/s].

    The paper prints the quadratic part as v * v without the sign, which would push a drone that flies forward.
    """
    return multiply_add(params.linear_drag, params.quadratic_drag, velocity_body.abs()) * -velocity_body


def angular_acceleration(angular_velocity: Vector, torque: Vector, inertia: Vector) -> Vector:
    """Euler's equation, (*, 3) [rad/s2], body frame: J^-1 (torque - w x J w)."""
    return (torque - gyroscopic_torque(angular_velocity, inertia)) / inertia


def gyroscopic_torque(angular_velocity: Vector, inertia: Vector) -> Vector:
    """w x J w, (*, 3) [N m], body frame."""
    return cross(angular_velocity, inertia * angular_velocity)


def accelerations(
    state: RigidBodyState, wrench: Vector, params: QuadrotorParams, wind: Vector | None = None
) -> tuple[Vector, Vector]:
    """Linear acceleration (world frame) and angular acceleration (body frame), each (*, 3), under a wrench (*, 4).

    Drag acts on the velocity relative to the wind (*, 3) [m/s], world frame; None is still air. It acts ``drag_height``
    above the centre of mass, so that a drone that flies forward is pitched up.
    """
    airspeed = state.velocity if wind is None else state.velocity - wind
    velocity_body = quaternion.rotate_inverse(state.quaternion, airspeed)
    air, torque = drag(velocity_body, params), wrench[..., 1:]
    if _is_set(params.drag_height):
        torque = torque + drag_moment(air, params)
    linear = quaternion.rotate(state.quaternion, (air + along_z(wrench[..., :1])) / params.mass)
    return linear - along_z(params.gravity), angular_acceleration(state.angular_velocity, torque, params.inertia)


def drag_moment(air: Vector, params: QuadrotorParams) -> Vector:
    """The torque (*, 3) [N m], body frame, of a drag (*, 3) [N] that acts above the centre of mass."""
    x, y = air[..., :1] * params.drag_height, air[..., 1:2] * params.drag_height
    return cat(-y, x, x * 0.0)


def _is_set(value: Vector) -> bool:
    """Whether it may differ from zero: False only of a constant of compiled code, to which it is then no cost."""
    if isinstance(value, Components):
        (value,) = value.components
    return not (isinstance(value, float) and value == 0.0)
