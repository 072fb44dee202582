"""The whole drone: rate controller, rotors and rigid body over one control step."""

from typing import NamedTuple

from torch import Tensor

from torchrl_quad.dynamics import rotors
from torchrl_quad.dynamics.control import FlightController, Setpoint
from torchrl_quad.dynamics.integrators import INTEGRATORS
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.rigid_body import RigidBodyState, accelerations


class QuadrotorState(NamedTuple):
    """A rigid body with four turning rotors."""

    position: Tensor  # (*, 3) [m], world frame
    quaternion: Tensor  # (*, 4), body to world, unit norm
    velocity: Tensor  # (*, 3) [m/s], world frame
    angular_velocity: Tensor  # (*, 3) [rad/s], body frame
    rotor_speed: Tensor  # (*, 4) [rad/s]


def physics_step(
    state: QuadrotorState,
    setpoint: Setpoint,
    params: QuadrotorParams,
    controller: FlightController,
    dt: float,
    integrator: str = "semi_implicit_euler",
) -> QuadrotorState:
    """One physics step of dt [s]: the present rotor speeds make the wrench, and the controller sets their next target."""
    wrench = rotors.apply(rotors.allocation_matrix(params), rotors.thrust_from_speed(state.rotor_speed, params))
    commanded = controller.rotor_speed(setpoint, state.angular_velocity, state.rotor_speed)
    body = INTEGRATORS[integrator](RigidBodyState(*state[:4]), lambda s: accelerations(s, wrench, params), dt)
    return QuadrotorState(*body, rotors.lagged_speed(state.rotor_speed, commanded, params, dt))


def control_step(
    state: QuadrotorState,
    action: Tensor,
    params: QuadrotorParams,
    controller: FlightController,
    dt: float,
    substeps: int,
    integrator: str = "semi_implicit_euler",
) -> QuadrotorState:
    """Hold an action (*, 4) in [-1, 1] over ``substeps`` physics steps of dt [s]."""
    setpoint = controller.setpoint(action)
    for _ in range(substeps):
        state = physics_step(state, setpoint, params, controller, dt, integrator)
    return state
