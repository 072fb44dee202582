"""The protocol of dynamics models, and what the two that ship share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Protocol

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.control import FlightController
from torchrl_quad.dynamics.modes import make_controller
from torchrl_quad.dynamics.parameters import QuadrotorParams, RawParams
from torchrl_quad.dynamics.vector import Components, Vector, cat, stack
from torchrl_quad.options import between

# [s]. In a shorter step a drone at 1 m/s does not move in single precision; with a longer one the rate loop of no drone
# that ships is stable.
PhysicsStep = Annotated[float, between(1e-6, 0.1)]
Substeps = Annotated[int, between(1, 200)]


class Dynamics(Protocol):
    """A model of a drone with its flight controller: state, limits, and one control step in two array forms.

    Environments and the engine read nothing else. It is built as ``Model(nominal, dt, substeps, integrator)``, and
    again when an environment moves to another device. A model with a choice of what actions command takes ``control``
    as well. :class:`~torchrl_quad.dynamics.Quadrotor` and :class:`~torchrl_quad.dynamics.PointMass` are the examples.
    """

    sizes: dict[str, int]
    """The entries of its state and their widths. All start with ``position``, ``quaternion``, ``velocity`` and
    ``angular_velocity``, which tasks observe."""

    plant_fields: tuple[str, ...]
    """The fields of :class:`~torchrl_quad.QuadrotorParams` that the flying drone reads. They may differ from those of
    the nominal drone, be drawn for each episode, and carry gradients."""

    limits: dict[str, Tensor]
    """Greatest absolute values of its own entries, beyond which the numbers mean nothing and the episode ends."""

    nominal: QuadrotorParams
    """The drone that the controller is built for."""

    hover_action: Tensor
    """The action (4) that holds the nominal drone where it is; (num_envs, 4) where drones differ in it."""

    action_units: dict[str, str]
    """What the four entries of an action command, by name, and the unit of each. A model may leave this out."""

    substeps: int
    """Physics steps in a control step."""

    def rest(self, position: Tensor) -> dict[str, Tensor]:
        """The state of a drone that hovers at the positions (n, 3) [m]."""
        ...

    def control_step(
        self, state: dict[str, Tensor], action: Tensor, params: QuadrotorParams, wind: Tensor | None
    ) -> dict[str, Tensor]:
        """Its entries (n, k) after a control step under an action (n, 4): the drone ``params`` in the wind (n, 3)."""
        ...

    def setpoint_rows(self, action: Tensor) -> Tensor:
        """What an action (n, 4) asks for, as rows (k, n) that ``rows_step`` reads."""
        ...

    def rows_step(self) -> Callable[..., Tensor]:
        """One physics step for a compiler: ``step(x, setpoint, plant, wind)``.

        ``x`` are the state's entries below each other (rows, n). ``plant`` are the ``plant_fields`` as rows (k, n), or
        empty for the nominal drone. ``wind`` holds one tensor (3, n) or none. It returns the next ``x``.
        """
        ...


class ControlledModel:
    """What both models share: the flight controller, and how a physics step becomes a control step in both forms."""

    sizes: dict[str, int]
    plant_fields: tuple[str, ...]

    def __init__(
        self, nominal: QuadrotorParams, dt: float, substeps: int, integrator: str, control: str | Mapping[str, Any]
    ) -> None:
        self.controller = make_controller(control, nominal)
        self.nominal, self.hover_action = self.controller.nominal, self.controller.hover_action
        self.action_units = self.controller.action_units
        self.dt, self.substeps, self.integrator = dt, substeps, integrator
        self.limits: dict[str, Tensor] = {}

    def rest(self, position: Tensor) -> dict[str, Tensor]:
        """Level and still, at the positions (n, 3) [m]."""
        still = {name: position.new_zeros(len(position), width) for name, width in self.sizes.items()}
        return {**still, "position": position, "quaternion": quaternion.identity(position)}

    def plant(self, params: QuadrotorParams, controller: FlightController) -> Any:
        """What physics steps read of the drone that flies, worked out once in a control step."""
        return params

    def physics_step(
        self, state: Sequence[Vector], setpoint: Any, plant: Any, controller: FlightController, wind: Vector | None
    ) -> Sequence[Vector]:
        """The entries of the state, in the order of ``sizes``, after a physics step."""
        raise NotImplementedError

    def control_step(
        self, state: dict[str, Tensor], action: Tensor, params: QuadrotorParams, wind: Tensor | None
    ) -> dict[str, Tensor]:
        """The entries of the drone after a control step, which holds the action (n, 4) in [-1, 1]."""
        setpoint, plant = self.controller.setpoint(action), self.plant(params, self.controller)
        entries: Sequence[Tensor] = [state[name] for name in self.sizes]
        for _ in range(self.substeps):
            entries = self.physics_step(entries, setpoint, plant, self.controller, wind)
        return dict(zip(self.sizes, entries, strict=True))

    def setpoint_rows(self, action: Tensor) -> Tensor:
        """What an action (n, 4) asks of the controller, as rows (k, n)."""
        return torch.cat([x.t() for x in self.controller.setpoint(action)])

    def rows_step(self) -> Callable[..., Tensor]:
        """A physics step on rows (k, n), for a compiler, with the nominal parameters as constants of its code."""
        controller = self.controller.unbind()

        def step(x: Tensor, setpoint: Tensor, plant: tuple[Tensor, ...], wind: tuple[Tensor, ...]) -> Tensor:
            state = Components(x.unbind()).split(list(self.sizes.values()), -1)
            wanted = controller.setpoint_type(*Components(setpoint.unbind()).split(controller.setpoint_sizes, -1))
            params = controller.nominal
            if plant:
                params = RawParams(**{k: Components(v.unbind()) for k, v in zip(self.plant_fields, plant, strict=True)})
            air = Components(wind[0].unbind()) if wind else None
            return stack(cat(*self.physics_step(state, wanted, self.plant(params, controller), controller, air)))

        return step
