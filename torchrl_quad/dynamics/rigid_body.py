"""The body: rotors that make a wrench, Newton and Euler with drag (the paper's section III-B), and integrators.

A wrench is (*, 4): collective thrust [N] along body z, then torque [N m] about body x, y, z. That of tilted rotors is
(*, 6), with the force [N] along body x and y behind. The integrators are of order 1, 1 and 4 under a prescribed wrench,
and of order 1 with controller and rotors in the loop, since the wrench is held over each physics step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.vector import Components, Vector, along_z, cat, cross, larger, matvec, where_positive


class Rotors:
    """The n rotors of a drone, with what follows from its parameters worked out once.

    The thrust map k2 w^2 + k1 w + k0 (paper, section III-B) is kept as k2 (w - w0)^2 + f0, which is quick both ways.
    """

    def __init__(self, params: QuadrotorParams) -> None:
        k2, k1, k0 = (params.thrust_map[..., i : i + 1] for i in range(3))
        self.curvature = k2
        self.vertex_speed = -k1 / (k2 * 2.0)
        self.vertex_thrust = k0 - k1 * k1 / (k2 * 4.0)
        self.side = k2.sign()  # of the vertex on which speeds lie: above the lowest point, or below the highest
        far = (params.rotor_speed_max - self.vertex_speed).square()
        self.least_root = larger(far, (params.rotor_speed_min - self.vertex_speed).square()) * 1e-6
        self.time_constant = params.motor_time_constant
        self.allocation = allocation_matrix(params)

    def thrust(self, speed: Vector) -> Vector:
        """Thrust (*, n) [N] of whole rotors at the rotor speed (*, n) [rad/s]."""
        return self.vertex_thrust.addcmul(self.curvature, (speed - self.vertex_speed).square())

    def speed(self, thrust: Vector) -> Vector:
        """Rotor speed (*, n) [rad/s] that gives the thrust (*, n) [N]: the inverse of :meth:`thrust`.

        Next to the vertex of the thrust map, where the slope of the inverse is infinite, the speed is held one
        thousandth of its range away from that point, so that derivatives stay finite.
        """
        squared = (thrust - self.vertex_thrust) / self.curvature
        return self.vertex_speed.addcmul(self.side, squared.maximum(self.least_root).sqrt())

    def wrench(self, speed: Vector) -> Vector:
        """The wrench (*, 4 or 6) on the body at the rotor speeds (*, n) [rad/s]."""
        return matvec(self.allocation, self.thrust(speed))

    def follow(self, speed: Vector, commanded: Vector, dt: float) -> Vector:
        """Rotor speed (*, n) after dt [s] of first-order lag towards a constant command: exact for any dt."""
        remains = (-dt / self.time_constant).exp()
        if remains.shape[-1] > 1:  # one rotor speeds up at the pace of the first, and slows down at that of the second
            remains = where_positive(commanded - speed, remains[..., :1], remains[..., 1:])
        return commanded.addcmul(remains, speed - commanded)


def thrust_limits(params: QuadrotorParams) -> tuple[Tensor, Tensor]:
    """The least and the greatest thrust [N] that may be commanded of one rotor; the least is never negative."""
    rotors = Rotors(params)
    return rotors.thrust(params.rotor_speed_min).clamp_min(0.0), rotors.thrust(params.rotor_speed_max)


def allocation_matrix(params: QuadrotorParams) -> Vector:
    """The matrix (*, 4, n), or (*, 6, n) for tilted rotors, from the thrusts f of n whole rotors to a wrench.

    The force of a rotor is F = f d, with d its direction, and its torque r x F + kappa s F: upright (y f, -x f,
    kappa s f). ``rotor_effectiveness`` multiplies both.
    """
    yaw = params.yaw_torque_coefficient * params.rotor_spin
    x, y, *height = _columns(params.rotor_positions, params.rotor_spin)
    one: Any = Components([1.0]) if isinstance(yaw, Components) else torch.ones_like(x)
    rows = [one, y, -x, yaw]
    if params.rotor_direction is not None:
        u, v, w = _columns(params.rotor_direction, params.rotor_spin)
        shorten = (u * u + v * v + w * w).clamp_min(1e-12).rsqrt()
        u, v, w = u * shorten, v * shorten, w * shorten
        z = height[0] if height else x * 0.0
        rows = [w, y * w - z * v + yaw * u, z * u - x * w + yaw * v, x * v - y * u + yaw * w, u, v]
    if params.rotor_effectiveness is not None:
        rows = [row * params.rotor_effectiveness for row in rows]
    return Components(rows) if isinstance(yaw, Components) else torch.stack(torch.broadcast_tensors(*rows), -2)


def _columns(matrix: Vector, spin: Vector) -> Sequence[Vector]:
    """The columns, each (*, n), of a matrix (*, n, k); its components are the entries of one row after another."""
    if isinstance(matrix, Components):
        k = matrix.shape[-1] // spin.shape[-1]
        return [matrix[..., i::k] for i in range(k)]
    return matrix.unbind(-1)


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


def gyroscopic_torque(angular_velocity: Vector, inertia: Vector) -> Vector:
    """w x J w, (*, 3) [N m], body frame."""
    return cross(angular_velocity, inertia * angular_velocity)


def accelerations(
    state: RigidBodyState, wrench: Vector, params: QuadrotorParams, wind: Vector | None = None
) -> tuple[Vector, Vector]:
    """Linear acceleration (world frame) and angular acceleration (body frame), each (*, 3), under a wrench.

    Drag acts on the velocity relative to the wind (*, 3) [m/s], world frame; None is still air. It acts ``drag_height``
    above the centre of mass, so that a drone that flies forward is pitched up.
    """
    airspeed = state.velocity if wind is None else state.velocity - wind
    air, torque = drag(quaternion.rotate_inverse(state.quaternion, airspeed), params), wrench[..., 1:4]
    push = along_z(wrench[..., :1]) if wrench.shape[-1] == 4 else cat(wrench[..., 4:], wrench[..., :1])
    height = params.drag_height.components[0] if isinstance(params.drag_height, Components) else None
    if not (isinstance(height, float) and height == 0.0):  # compiled code of such a drone has no moment
        x, y = air[..., :1] * params.drag_height, air[..., 1:2] * params.drag_height
        torque = torque + cat(-y, x, x * 0.0)
    linear = quaternion.rotate(state.quaternion, (air + push) / params.mass)
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
