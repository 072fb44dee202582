"""The rigid body: Newton and Euler with drag, in the frames of the paper's section III-B, and its integrators.

The integrators' order of convergence is 1, 1 and 4 under a prescribed wrench. With the rate controller and the rotors
in the loop the wrench is held over each physics step, and all three are of first order.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.vector import Components, Vector, along_z, cat, cross


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
    return params.linear_drag.addcmul(params.quadratic_drag, velocity_body.abs()) * -velocity_body


def drag_moment(air: Vector, params: QuadrotorParams) -> Vector:
    """The torque (*, 3) [N m], body frame, of a drag (*, 3) [N] that acts ``drag_height`` above the centre of mass."""
    x, y = air[..., :1] * params.drag_height, air[..., 1:2] * params.drag_height
    return cat(-y, x, x * 0.0)


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
    air, torque = drag(quaternion.rotate_inverse(state.quaternion, airspeed), params), wrench[..., 1:]
    height = params.drag_height
    constant = height.components[0] if isinstance(height, Components) else None
    if not (isinstance(constant, float) and constant == 0.0):  # compiled code of such a drone has no moment
        torque = torque + drag_moment(air, params)
    linear = quaternion.rotate(state.quaternion, (air + along_z(wrench[..., :1])) / params.mass)
    angular = (torque - gyroscopic_torque(state.angular_velocity, params.inertia)) / params.inertia
    return linear - along_z(params.gravity), angular


Accelerations = Callable[[RigidBodyState], tuple[Vector, Vector]]
Integrator = Literal["euler", "semi_implicit_euler", "rk4"]


def euler(state: RigidBodyState, accelerations: Accelerations, dt: float) -> RigidBodyState:
    """Explicit Euler: everything moves along its derivative at the start of the step."""
    return _normalized(_moved(state, _derivative(state, accelerations), dt))


def semi_implicit_euler(state: RigidBodyState, accelerations: Accelerations, dt: float) -> RigidBodyState:
    """Symplectic Euler: velocities first, then position and attitude with the new velocities."""
    linear, angular = accelerations(state)
    velocity = state.velocity + linear * dt
    angular_velocity = state.angular_velocity + angular * dt
    position = state.position + velocity * dt
    attitude = state.quaternion + quaternion.derivative(state.quaternion, angular_velocity) * dt
    return _normalized(RigidBodyState(position, attitude, velocity, angular_velocity))


def rk4(state: RigidBodyState, accelerations: Accelerations, dt: float) -> RigidBodyState:
    """The classical Runge-Kutta method."""
    k1 = _derivative(state, accelerations)
    k2 = _derivative(_moved(state, k1, 0.5 * dt), accelerations)
    k3 = _derivative(_moved(state, k2, 0.5 * dt), accelerations)
    k4 = _derivative(_moved(state, k3, dt), accelerations)
    mean = RigidBodyState(*((a + (b + c) * 2.0 + d) / 6.0 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)))
    return _normalized(_moved(state, mean, dt))


INTEGRATORS = {"euler": euler, "semi_implicit_euler": semi_implicit_euler, "rk4": rk4}


def _derivative(state: RigidBodyState, accelerations: Accelerations) -> RigidBodyState:
    linear, angular = accelerations(state)
    turning = quaternion.derivative(state.quaternion, state.angular_velocity)
    return RigidBodyState(state.velocity, turning, linear, angular)


def _moved(state: RigidBodyState, derivative: RigidBodyState, dt: float) -> RigidBodyState:
    return RigidBodyState(*(x + dx * dt for x, dx in zip(state, derivative, strict=True)))


def _normalized(state: RigidBodyState) -> RigidBodyState:
    return state._replace(quaternion=quaternion.normalize(state.quaternion))
