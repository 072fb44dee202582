"""The whole quadrotor: flight controller, rotors and rigid body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from torchrl_quad.dynamics.control import FlightController, Nominal
from torchrl_quad.dynamics.model import ControlledModel, PhysicsStep, Substeps
from torchrl_quad.dynamics.parameters import PLANT_FIELDS, QuadrotorParams
from torchrl_quad.dynamics.rigid_body import INTEGRATORS, Integrator, RigidBodyState, accelerations
from torchrl_quad.dynamics.rotors import Rotors
from torchrl_quad.dynamics.vector import Vector, clamp
from torchrl_quad.options import checked


class QuadrotorState(NamedTuple):
    """A rigid body with four turning rotors."""

    position: Vector  #: (*, 3) [m], world frame
    quaternion: Vector  #: (*, 4), body to world, unit norm
    velocity: Vector  #: (*, 3) [m/s], world frame
    angular_velocity: Vector  #: (*, 3) [rad/s], body frame
    rotor_speed: Vector  #: (*, 4) [rad/s]


@checked
class Quadrotor(ControlledModel):
    """The quadrotor as environments fly it: an implementation of :class:`~torchrl_quad.dynamics.Dynamics`.

    Args:
        dt: physics step, 1e-6 to 0.1 s.
        substeps: physics steps in a control step, 1 to 200.
        control: what an action commands, as :func:`~torchrl_quad.dynamics.make_controller` takes it.
    """

    sizes = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3, "rotor_speed": 4}
    plant_fields = PLANT_FIELDS

    def __init__(
        self,
        nominal: Nominal,
        dt: PhysicsStep,
        substeps: Substeps,
        integrator: Integrator,
        control: str | Mapping[str, Any] = "rates",
    ) -> None:
        super().__init__(nominal, dt, substeps, integrator, control)
        self.limits = {"rotor_speed": 2.0 * self.nominal.rotor_speed_max}

    def rest(self, position: Tensor) -> dict[str, Tensor]:
        """Level, still, rotors at hover speed, at the positions (n, 3) [m]."""
        return {**super().rest(position), "rotor_speed": self.controller.hover_speed.expand(len(position), 4).clone()}

    def plant(self, params: QuadrotorParams, controller: FlightController) -> tuple[QuadrotorParams, Rotors]:
        """The parameters and the rotors."""
        return params, controller.rotors if params is controller.nominal else Rotors(params)

    def physics_step(
        self,
        state: Sequence[Vector],
        setpoint: Any,
        plant: tuple[QuadrotorParams, Rotors],
        controller: FlightController,
        wind: Vector | None,
    ) -> QuadrotorState:
        """The present rotor speeds make the wrench, and the controller, by its own rotors, sets their next target."""
        (params, rotors), before = plant, QuadrotorState(*state)
        speed = before.rotor_speed
        wrench = rotors.wrench(speed)
        believed = wrench if rotors is controller.rotors else controller.rotors.wrench(speed)
        commanded = controller.command(setpoint, before, believed)
        if rotors is not controller.rotors:  # the nominal rotors can do what the controller asks of them; these may not
            commanded = clamp(commanded, params.rotor_speed_min, params.rotor_speed_max)
        integrate = INTEGRATORS[self.integrator]
        body = integrate(RigidBodyState(*before[:4]), lambda s: accelerations(s, wrench, params, wind), self.dt)
        return QuadrotorState(*body, rotors.follow(speed, commanded, self.dt))
