"""A point mass with an attitude: the simplification that much of the literature trains on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.control import Nominal
from torchrl_quad.dynamics.integrators import Integrator
from torchrl_quad.dynamics.interface import PhysicsStep, Substeps
from torchrl_quad.dynamics.modes import RotorThrustController, make_controller
from torchrl_quad.dynamics.parameters import QuadrotorParams, RawParams
from torchrl_quad.dynamics.rigid_body import drag
from torchrl_quad.dynamics.vector import Components, Vector, along_z, cat, split, stack
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import checked


@checked
class PointMass:
    """Thrust and body rates follow the command at once: no rotors, no rate controller, no moments.

    An implementation of :class:`~torchrl_quad.dynamics.Dynamics`. Drag, mass and gravity are those of the drone. Each
    physics step turns the attitude with the commanded rate, then moves velocity and position (semi-implicit Euler, the
    only integrator here). It flies commands that the rotors of the drone may not reach.

    Args:
        nominal: the drone whose weight and limits scale the action.
        dt: physics step, 1e-6 to 0.1 s.
        substeps: physics steps in a control step, 1 to 200.
        integrator: must be "semi_implicit_euler".
        control: what an action commands, as :func:`~torchrl_quad.dynamics.make_controller` takes it; not rotors.

    Raises:
        ValueError: another integrator is asked for, or an action shall command rotors.
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
                f'dynamics="point_mass" knows the integrator "semi_implicit_euler" alone, got {integrator!r}.'
            )
        self.controller = make_controller(control, nominal)
        if isinstance(self.controller, RotorThrustController):
            raise UserValueError(
                'dynamics="point_mass" has no rotors, so control="rotor_thrusts" commands nothing. Take '
                'dynamics="quadrotor", or another control.'
            )
        self.nominal, self.hover_action = self.controller.nominal, self.controller.hover_action
        self.action_units, self.dt, self.substeps, self.limits = self.controller.action_units, dt, substeps, {}

    def rest(self, position: Tensor) -> dict[str, Tensor]:
        """Level and still, at the positions (n, 3) [m]."""
        still = torch.zeros_like(position)
        level = quaternion.identity(position)
        return {"position": position, "quaternion": level, "velocity": still, "angular_velocity": still.clone()}

    def control_step(
        self, state: dict[str, Tensor], action: Tensor, params: QuadrotorParams, wind: Tensor | None
    ) -> dict[str, Tensor]:
        """The entries of the drone after one control step."""
        setpoint = self.controller.setpoint(action)
        position, attitude, velocity = state["position"], state["quaternion"], state["velocity"]
        for _ in range(self.substeps):
            thrust, rates = self.controller.rate_setpoint(setpoint, attitude, velocity)
            position, attitude, velocity = _step(position, attitude, velocity, thrust, rates, params, self.dt, wind)
        return {"position": position, "quaternion": attitude, "velocity": velocity, "angular_velocity": rates}

    def setpoint_rows(self, action: Tensor) -> Tensor:
        """What an action (n, 4) asks of the controller, as rows (k, n)."""
        return torch.cat([x.t() for x in self.controller.setpoint(action)])

    def rows_step(self) -> Callable[..., Tensor]:
        """A physics step on rows (13, n), for a compiler."""
        controller, dt = self.controller.unbind(), self.dt

        def step(x: Tensor, setpoint: Tensor, plant: tuple[Tensor, ...], wind: tuple[Tensor, ...]) -> Tensor:
            rows, params = Components(x.unbind()), controller.nominal
            position, attitude, velocity = rows[..., :3], rows[..., 3:7], rows[..., 7:10]
            wanted = controller.setpoint_type(*split(Components(setpoint.unbind()), controller.setpoint_sizes))
            thrust, rates = controller.rate_setpoint(wanted, attitude, velocity)
            if plant:
                params = RawParams(**{k: Components(v.unbind()) for k, v in zip(self.plant_fields, plant, strict=True)})
            air = Components(wind[0].unbind()) if wind else None
            after = _step(position, attitude, velocity, thrust, rates, params, dt, air)
            return stack(cat(*after, rates))

        return step


def _step(
    position: Vector,
    attitude: Vector,
    velocity: Vector,
    thrust: Vector,
    rates: Vector,
    params: QuadrotorParams,
    dt: float,
    wind: Vector | None,
) -> tuple[Vector, Vector, Vector]:
    attitude = quaternion.normalize(attitude + quaternion.derivative(attitude, rates) * dt)
    air = velocity if wind is None else velocity - wind
    force = drag(quaternion.rotate_inverse(attitude, air), params) + along_z(thrust)
    velocity = velocity + (quaternion.rotate(attitude, force / params.mass) - along_z(params.gravity)) * dt
    return position + velocity * dt, attitude, velocity
