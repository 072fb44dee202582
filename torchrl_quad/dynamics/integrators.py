"""Fixed-step integrators of the rigid body under given accelerations.

Their order of convergence is 1, 1 and 4 under a prescribed wrench. With the rate controller and the rotors in the
loop the wrench is held over each physics step, and all three are of first order.
"""

from collections.abc import Callable
from typing import Literal

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.rigid_body import RigidBodyState
from torchrl_quad.dynamics.vector import Vector

Accelerations = Callable[[RigidBodyState], tuple[Vector, Vector]]


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


Integrator = Literal["euler", "semi_implicit_euler", "rk4"]
INTEGRATORS = {"euler": euler, "semi_implicit_euler": semi_implicit_euler, "rk4": rk4}


def _derivative(state: RigidBodyState, accelerations: Accelerations) -> RigidBodyState:
    linear, angular = accelerations(state)
    return RigidBodyState(
        state.velocity, quaternion.derivative(state.quaternion, state.angular_velocity), linear, angular
    )


def _moved(state: RigidBodyState, derivative: RigidBodyState, dt: float) -> RigidBodyState:
    return RigidBodyState(*(x + dx * dt for x, dx in zip(state, derivative, strict=True)))


def _normalized(state: RigidBodyState) -> RigidBodyState:
    return state._replace(quaternion=quaternion.normalize(state.quaternion))
