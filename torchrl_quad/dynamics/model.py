"""The protocol of dynamics models, and the two that ship: the whole quadrotor, and a point mass with an attitude."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.control import FlightController, Nominal, RotorThrustController, make_controller
from torchrl_quad.dynamics.gains import PhysicsStep, check_flown, check_gains
from torchrl_quad.dynamics.parameters import PLANT_FIELDS, QuadrotorParams, RawParams
from torchrl_quad.dynamics.rigid_body import INTEGRATORS, Integrator, RigidBodyState, Rotors, accelerations, drag
from torchrl_quad.dynamics.vector import Components, Vector, along_z, cat, clamp, is_traced, stack
from torchrl_quad.errors import DroneWarning, UserValueError
from torchrl_quad.options import between, checked

Substeps = Annotated[int, between(1, 200)]


class Dynamics(Protocol):
    """A model of a drone with its flight controller: state, limits, and one control step in two array forms.

    Environments and the engine read nothing else. It is built as ``Model(nominal, dt, substeps, integrator)``, and
    again when an environment moves to another device. A model with a choice of what actions command takes ``control``
    as well. :class:`~torchrl_quad.dynamics.Quadrotor` and :class:`~torchrl_quad.dynamics.PointMass` are the examples.
    """

    #: The width of each entry of its state, first of those that tasks observe, which are ``position``, ``quaternion``,
    #: ``velocity`` and ``angular_velocity``.
    sizes: dict[str, int]
    #: The fields of :class:`~torchrl_quad.QuadrotorParams` that the flying drone reads. They may differ from those of
    #: the nominal drone, be drawn for each episode, and carry gradients.
    plant_fields: tuple[str, ...]
    #: Greatest absolute values of its own entries, beyond which the numbers mean nothing and the episode ends.
    limits: dict[str, Tensor]
    #: Entries that follow the command within a control step, so that nothing else can hold them; it may leave this out.
    commanded: tuple[str, ...]
    nominal: QuadrotorParams  #: the drone that the controller is built for
    hover_action: Tensor  #: (k), holds the nominal drone where it is; (num_envs, k) where drones differ in it
    action_units: dict[str, str]  #: the entries of an action by name, with their units; a model may leave this out
    substeps: int  #: physics steps in a control step

    def rest(self, position: Tensor) -> dict[str, Tensor]:
        """The state of a drone that hovers at the positions (n, 3) [m]."""

    def control_step(
        self, state: dict[str, Tensor], action: Tensor, params: QuadrotorParams, wind: Tensor | None
    ) -> dict[str, Tensor]:
        """Its entries (n, k) after a control step under an action (n, k): the drone ``params`` in the wind (n, 3)."""

    def setpoint_rows(self, action: Tensor) -> Tensor:
        """What an action (n, k) asks for, as rows (k, n) that ``rows_step`` reads."""

    def rows_step(self) -> Callable[..., Tensor]:
        """One physics step for a compiler: ``step(x, setpoint, plant, wind)``, which returns the next ``x``.

        ``x`` are the state's entries below each other (rows, n). ``plant`` are the ``plant_fields`` as rows (k, n),
        what is None as no rows, (0, n); or empty for the nominal drone. ``wind`` holds one tensor (3, n) or none.
        """


@checked
class ControlledModel:
    """What both models share: the flight controller, and how a physics step becomes a control step in both forms.

    Args:
        dt: physics step, 1e-6 to 0.1 s.
        substeps: physics steps in a control step, 1 to 200.
        control: what an action commands, as :func:`~torchrl_quad.dynamics.make_controller` takes it.
    """

    sizes: dict[str, int]
    plant_fields: tuple[str, ...]
    commanded: tuple[str, ...] = ()

    def __init__(
        self,
        nominal: Nominal,
        dt: PhysicsStep,
        substeps: Substeps,
        integrator: Integrator,
        control: str | Mapping[str, Any] = "rates",
    ) -> None:
        self.controller = make_controller(control, nominal)
        self.nominal, self.hover_action = self.controller.nominal, self.controller.hover_action
        self.action_units = self.controller.action_units
        self.dt, self.substeps, self.integrator = dt, substeps, integrator
        self.limits: dict[str, Tensor] = {}
        self.finish()

    def finish(self) -> None:
        """What a model adds to its construction: its limits, or a refusal of what it cannot fly.

        A method ``check_flown(params)`` can refuse another drone that is to fly.
        """

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
        """The entries of the drone after a control step, which holds the action (n, k) in [-1, 1]."""
        setpoint, plant = self.controller.setpoint(action), self.plant(params, self.controller)
        entries: Sequence[Tensor] = [state[name] for name in self.sizes]
        for _ in range(self.substeps):
            entries = self.physics_step(entries, setpoint, plant, self.controller, wind)
        return dict(zip(self.sizes, entries, strict=True))

    def setpoint_rows(self, action: Tensor) -> Tensor:
        """What an action (n, k) asks of the controller, as rows (k, n)."""
        return torch.cat([x.t() for x in self.controller.setpoint(action)])

    def rows_step(self) -> Callable[..., Tensor]:
        """A physics step on rows (k, n), for a compiler, with the nominal parameters as constants of its code."""
        controller = self.controller.unbind()

        def step(x: Tensor, setpoint: Tensor, plant: tuple[Tensor, ...], wind: tuple[Tensor, ...]) -> Tensor:
            state = Components(x.unbind()).split(list(self.sizes.values()), -1)
            wanted = controller.setpoint_type(*Components(setpoint.unbind()).split(controller.setpoint_sizes, -1))
            params = controller.nominal
            if plant:
                named = zip(self.plant_fields, plant, strict=True)
                params = RawParams(**{k: Components(v.unbind()) for k, v in named if len(v)})
            air = Components(wind[0].unbind()) if wind else None
            return stack(cat(*self.physics_step(state, wanted, self.plant(params, controller), controller, air)))

        return step


class QuadrotorState(NamedTuple):
    """A rigid body with n turning rotors."""

    position: Vector  #: (*, 3) [m], world frame
    quaternion: Vector  #: (*, 4), body to world, unit norm
    velocity: Vector  #: (*, 3) [m/s], world frame
    angular_velocity: Vector  #: (*, 3) [rad/s], body frame
    rotor_speed: Vector  #: (*, n) [rad/s]


class Quadrotor(ControlledModel):
    """The quadrotor as environments fly it, with flight controller, rotors and rigid body.

    An implementation of :class:`~torchrl_quad.dynamics.Dynamics`, with the arguments of
    :class:`~torchrl_quad.dynamics.model.ControlledModel`.
    """

    sizes = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3, "rotor_speed": 4}
    plant_fields, commanded = PLANT_FIELDS, ("rotor_speed",)

    def finish(self) -> None:
        """Count the rotors, limit their speeds, and refuse or question what such steps, or the rotors, do not fly."""
        self.sizes = {**self.sizes, "rotor_speed": self.nominal.rotor_spin.shape[-1]}
        self.limits = {"rotor_speed": 2.0 * self.nominal.rotor_speed_max}
        if not isinstance(self.controller, RotorThrustController):
            check_gains(self.controller, self.dt, self.substeps)
        asked, reach = self.nominal.max_thrust_to_weight, self.controller.reach()
        if (asked > reach * (1.0 + 1e-5)).any():
            warnings.warn(
                f"drone: full throttle commands max_thrust_to_weight={asked.max():.4g}, and the rotors reach "
                f"{reach.min():.4g} times the weight. Actions above that do nothing and have no gradient. Write "
                f"max_thrust_to_weight: {math.floor(1e3 * reach.min()) / 1e3:g}.",
                DroneWarning,
                stacklevel=2,
            )

    def check_flown(self, params: QuadrotorParams) -> None:
        """Refuse a drone with which the rate loop is unstable."""
        if not (is_traced() or isinstance(self.controller, RotorThrustController)):
            check_flown(self.controller, params, self.dt)

    def rest(self, position: Tensor) -> dict[str, Tensor]:
        """Level, still, rotors at hover speed, at the positions (n, 3) [m]."""
        return {**super().rest(position), "rotor_speed": self.controller.hover_speed.expand(len(position), -1).clone()}

    def plant(self, params: QuadrotorParams, controller: FlightController) -> tuple[QuadrotorParams, Rotors]:
        """The parameters and the rotors."""
        return params, controller.rotors if params is controller.nominal else Rotors(params)

    def physics_step(
        self, state: Sequence[Vector], setpoint: Any, plant: Any, controller: FlightController, wind: Vector | None
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


class PointMass(ControlledModel):
    """Thrust and body rates follow the command at once: no rotors, no rate controller, no moments.

    An implementation of :class:`~torchrl_quad.dynamics.Dynamics`, on which much of the literature trains. Drag, mass
    and gravity are those of the drone. Each physics step turns the attitude with the commanded rate, then moves
    velocity and position (semi-implicit Euler). It flies commands that the rotors of the drone may not reach. The
    arguments are those of :class:`~torchrl_quad.dynamics.Quadrotor`.

    Raises:
        ValueError: another integrator is asked for, or actions command rotors.
    """

    sizes = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3}
    plant_fields, commanded = ("mass", "linear_drag", "quadratic_drag", "gravity"), ("angular_velocity",)

    def finish(self) -> None:
        """Refuse what it cannot fly."""
        if self.integrator != "semi_implicit_euler":
            raise UserValueError(
                f'dynamics="point_mass" supports only the integrator "semi_implicit_euler", got {self.integrator!r}.'
            )
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
