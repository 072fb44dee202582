"""The whole drone: rate controller, rotors and rigid body over one control step."""

from typing import NamedTuple

from torch import Tensor

from torchrl_quad.dynamics.control import FlightController, Setpoint
from torchrl_quad.dynamics.integrators import INTEGRATORS
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.rigid_body import RigidBodyState, accelerations
from torchrl_quad.dynamics.rotors import Rotors
from torchrl_quad.dynamics.vector import Vector, clamp


class QuadrotorState(NamedTuple):
    """A rigid body with four turning rotors."""

    position: Vector  #: (*, 3) [m], world frame
    quaternion: Vector  #: (*, 4), body to world, unit norm
    velocity: Vector  #: (*, 3) [m/s], world frame
    angular_velocity: Vector  #: (*, 3) [rad/s], body frame
    rotor_speed: Vector  #: (*, 4) [rad/s]


def physics_step(
    state: QuadrotorState,
    setpoint: Setpoint,
    params: QuadrotorParams,
    rotors: Rotors,
    controller: FlightController,
    dt: float,
    integrator: str = "semi_implicit_euler",
    wind: Vector | None = None,
) -> QuadrotorState:
    """One physics step of dt [s]: the present rotor speeds make the wrench, and the controller sets their next target.

    ``rotors`` are those of ``params``; the controller knows its own, and flies by them. ``wind`` is (*, 3) [m/s], world
    frame.
    """
    speed = state.rotor_speed
    wrench = rotors.wrench(speed)
    believed = wrench if rotors is controller.rotors else controller.rotors.wrench(speed)
    commanded = controller.rotor_speed(setpoint, state.angular_velocity, believed)
    if rotors is not controller.rotors:  # the nominal rotors can do what the controller asks of them; these may not
        commanded = clamp(commanded, params.rotor_speed_min, params.rotor_speed_max)
    body = INTEGRATORS[integrator](RigidBodyState(*state[:4]), lambda s: accelerations(s, wrench, params, wind), dt)
    return QuadrotorState(*body, rotors.follow(speed, commanded, dt))


def control_step(
    state: QuadrotorState,
    action: Tensor,
    params: QuadrotorParams,
    controller: FlightController,
    dt: float,
    substeps: int,
    integrator: str = "semi_implicit_euler",
    wind: Tensor | None = None,
) -> QuadrotorState:
    """Hold an action (*, 4) in [-1, 1] over ``substeps`` physics steps of dt [s], with the drone ``params`` in the
    wind (*, 3) [m/s], world frame."""
    setpoint = controller.setpoint(action)
    rotors = controller.rotors if params is controller.nominal else Rotors(params)
    for _ in range(substeps):
        state = physics_step(state, setpoint, params, rotors, controller, dt, integrator, wind)
    return state
