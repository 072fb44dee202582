"""A point mass with an attitude: the simplification that much of the literature trains on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.control import FlightController, Nominal
from torchrl_quad.dynamics.model import ControlledModel, PhysicsStep, Substeps
from torchrl_quad.dynamics.modes import RotorThrustController
from torchrl_quad.dynamics.rigid_body import Integrator, drag
from torchrl_quad.dynamics.vector import Vector, along_z
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import checked


@checked
class PointMass(ControlledModel):
    """Thrust and body rates follow the command at once: no rotors, no rate controller, no moments.

    An implementation of :class:`~torchrl_quad.dynamics.Dynamics`. Drag, mass and gravity are those of the drone. Each
    physics step turns the attitude with the commanded rate, then moves velocity and position (semi-implicit Euler). It
    flies commands that the rotors of the drone may not reach.

    The arguments are those of :class:`~torchrl_quad.dynamics.Quadrotor`.

    Raises:
        ValueError: another integrator is asked for, or actions command rotors.
    """

    sizes = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3}
    plant_fields = ("mass", "linear_drag", "quadratic_drag", "gravity")

    def __init__(
        self,
        nominal: Nominal,
        dt: PhysicsStep,
        substeps: Substeps,
        integrator: Integrator,
        control: str | Mapping[str, Any] = "rates",
    ) -> None:
        if integrator != "semi_implicit_euler":
            raise UserValueError(
                f'dynamics="point_mass" supports only the integrator "semi_implicit_euler", got {integrator!r}.'
            )
        super().__init__(nominal, dt, substeps, integrator, control)
        if isinstance(self.controller, RotorThrustController):
            raise UserValueError(
                'dynamics="point_mass" has no rotors, so control="rotor_thrusts" commands nothing. Use '
                'dynamics="quadrotor", or another control.'
            )

    def physics_step(
        self, state: Sequence[Vector], setpoint: Any, plant: Any, controller: FlightController, wind: Vector | None
    ) -> Sequence[Vector]:
        """Turn, then move."""
        position, attitude, velocity, _ = state
        thrust, rates = controller.rate_setpoint(setpoint, attitude, velocity)
        attitude = quaternion.normalize(attitude + quaternion.derivative(attitude, rates) * self.dt)
        air = velocity if wind is None else velocity - wind
        force = drag(quaternion.rotate_inverse(attitude, air), plant) + along_z(thrust)
        velocity = velocity + (quaternion.rotate(attitude, force / plant.mass) - along_z(plant.gravity)) * self.dt
        return position + velocity * self.dt, attitude, velocity, rates
