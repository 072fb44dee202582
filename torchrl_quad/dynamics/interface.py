"""The protocol of dynamics models: environments and the engine ask them for nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Protocol

from torch import Tensor

from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.options import between

# [s]. In a shorter step a drone at 1 m/s does not move in single precision; with a longer one the rate loop of no drone
# that ships is stable.
PhysicsStep = Annotated[float, between(1e-6, 0.1)]
Substeps = Annotated[int, between(1, 200)]


class Dynamics(Protocol):
    """A model of a drone with its flight controller: state, limits, and one control step in two array forms.

    It is built as ``Model(nominal, dt, substeps, integrator)``, and again when an environment moves to another device.
    A model with a choice of what actions command takes ``control`` as well.
    :class:`~torchrl_quad.dynamics.Quadrotor` and :class:`~torchrl_quad.dynamics.PointMass` are the examples.
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
    """The drone that the controller believes in."""

    hover_action: Tensor
    """The action (4) that holds the nominal drone where it is; (num_envs, 4) where drones differ in it."""

    action_units: dict[str, str]
    """What the four entries of an action command, by name, and the unit of each. A model may leave this out."""

    substeps: int
    """Physics steps in a control step."""

    def rest(self, position: Tensor) -> dict[str, Tensor]:
        """The state of a drone that hovers at the positions (n, 3) [m]."""

    def control_step(
        self, state: dict[str, Tensor], action: Tensor, params: Any, wind: Tensor | None
    ) -> dict[str, Tensor]:
        """Its entries (n, k) after a control step under an action (n, 4): the drone ``params`` in the wind (n, 3)."""

    def setpoint_rows(self, action: Tensor) -> Tensor:
        """What an action (n, 4) asks for, as rows (k, n) that ``rows_step`` reads."""

    def rows_step(self) -> Callable[..., Tensor]:
        """One physics step for a compiler: ``step(x, setpoint, plant, wind)``.

        ``x`` are the state's entries below each other (rows, n). ``plant`` are the ``plant_fields`` as rows (k, n), or
        empty for the nominal drone. ``wind`` holds one tensor (3, n) or none. It returns the next ``x``.
        """
