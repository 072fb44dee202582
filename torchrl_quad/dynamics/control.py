"""The flight controller: from an action to four rotor speeds, with the parameters of the nominal drone."""

from __future__ import annotations

import copy
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.parameters import QuadrotorParams, RawParams
from torchrl_quad.dynamics.rigid_body import drag, drag_moment, gyroscopic_torque
from torchrl_quad.dynamics.rotors import Rotors, thrust_limits
from torchrl_quad.dynamics.vector import (
    Vector,
    cat,
    clamp,
    is_same,
    larger,
    matvec,
    smaller,
    unbind,
    unbind_rows,
    where_positive,
    where_same,
)
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import accepted, checked

Nominal = Annotated[
    Any, accepted(lambda x: isinstance(x, QuadrotorParams), "QuadrotorParams, such as load_drone('visfly')")
]


class Setpoint(NamedTuple):
    """What an action of ``control="rates"`` asks for: collective thrust and body rates (CTBR)."""

    thrust: Vector  #: (*, 1) [N]
    body_rate: Vector  #: (*, 3) [rad/s], body frame


@checked
class FlightController:
    """Rate controller and mixer with the nominal parameters of the drone: ``control="rates"``.

    The drone that flies may differ (randomised, fitted): the controller keeps a copy of what it was built with, and no
    gradient flows into that. Those of :mod:`~torchrl_quad.dynamics.modes` give actions another meaning.

    Raises:
        ValueError: the rotor layout cannot make thrust and torque about each axis, or the drone cannot hover.
    """

    action_units = {"thrust": "N", "roll rate": "rad/s", "pitch rate": "rad/s", "yaw rate": "rad/s"}
    """What the four entries of an action command, and in which unit."""

    setpoint_type: type[Any] = Setpoint
    setpoint_sizes: tuple[int, ...] = (1, 3)

    def __init__(self, nominal: Nominal) -> None:
        nominal = nominal.detach()
        self.nominal = nominal
        self.rotors = Rotors(nominal)
        self.mixer = _inverse(self.rotors.allocation)
        self.thrust_min, self.thrust_max = thrust_limits(nominal)
        self.gain = nominal.inertia * nominal.rate_gain
        self.knows_moment = bool((nominal.drag_height != 0).any())
        weight = nominal.mass * nominal.gravity
        self.tiny = 1e-6 * weight
        # What a rotor contributes to collective thrust; its limits, and the thrust it has for yaw, in these units.
        self.share, self.per_share = self.mixer[..., 0], 1.0 / self.mixer[..., 0]
        lowest = (self.thrust_min * self.per_share).amax(-1, keepdim=True)
        highest = (self.thrust_max * self.per_share).amin(-1, keepdim=True)
        self.middle, self.half_span = 0.5 * (highest + lowest), 0.5 * (highest - lowest)
        self.yaw_share = self.mixer[..., 3] * self.per_share
        self.yaw_sign, self.yaw_reach = self.yaw_share.sign(), self.yaw_share.abs().amax(-1, keepdim=True)
        self.half_range = 0.5 * nominal.max_thrust_to_weight * weight
        self.hover_speed = self.rotors.speed(matvec(self.mixer, pad(weight, (0, 3))))
        # An action a commands (a + offset) scale.
        self.offset = pad(weight.new_ones(1), (0, 3))
        self.scale = join(self.half_range, nominal.max_body_rate)
        self.hover_action = pad(2.0 / nominal.max_thrust_to_weight - 1.0, (0, 3))
        _check_hover(nominal, self.hover_speed)

    def unbind(self) -> FlightController:
        """The same on components: its numbers become constants of the code that is compiled with it."""
        apart = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(apart, name, unbind(value, constant=True))
        fields = {k: unbind(x, constant=True) for k, x in self.nominal.fields().items() if k != "rotor_positions"}
        apart.nominal = RawParams(**fields)
        apart.rotors, apart.mixer = self.rotors.unbind(), unbind_rows(self.mixer)
        return apart

    def decode(self, action: Tensor) -> Tensor:
        """What an action (*, 4) in [-1, 1] commands, in ``action_units``; values outside are clamped."""
        return (action.clamp(-1.0, 1.0) + self.offset) * self.scale

    def encode(self, command: Tensor) -> Tensor:
        """The action (*, 4) for a command in ``action_units``; beyond the limits it lies outside [-1, 1]."""
        return command / self.scale - self.offset

    def setpoint(self, action: Tensor) -> Any:
        """Decode an action (*, 4), for :meth:`command`."""
        return self.setpoint_type(*self.decode(action).split(self.setpoint_sizes, -1))

    def command(self, setpoint: Any, state: Any, wrench: Vector) -> Vector:
        """Commanded rotor speed (*, 4) [rad/s] for a setpoint, the drone's state, and the present wrench (*, 4)."""
        rates, moment = self.rate_setpoint(setpoint, state.quaternion, state.velocity), None
        if self.knows_moment:
            velocity_body = quaternion.rotate_inverse(state.quaternion, state.velocity)
            moment = drag_moment(drag(velocity_body, self.nominal), self.nominal)
        return self.rotor_speed(rates, state.angular_velocity, wrench, moment)

    def rate_setpoint(self, setpoint: Any, attitude: Vector, velocity: Vector) -> Setpoint:
        """Thrust and body rates for a setpoint, at an attitude (*, 4) and a velocity (*, 3) [m/s], world frame."""
        return setpoint

    def rotor_speed(
        self, setpoint: Setpoint, angular_velocity: Vector, wrench: Vector, moment: Vector | None = None
    ) -> Vector:
        """Commanded rotor speed (*, 4) [rad/s] for a setpoint, the body rates (*, 3), and the present wrench (*, 4).

        Torque = J K (desired rate - rate) - D (angular acceleration) + w x J w, where the angular acceleration follows
        from the wrench that nominal rotors exert. The paper prints a derivative of the desired rate as well; a setpoint
        that is held for a control step has none. The rotors also hold against the moment (*, 3) of a drag above the
        centre of mass, which firmware leaves to an integral.
        """
        inertia = self.nominal.inertia
        held = gyroscopic_torque(angular_velocity, inertia)
        if moment is not None:
            held = held - moment
        acceleration = (wrench[..., 1:] - held) / inertia
        torque = held.addcmul(self.gain, setpoint.body_rate - angular_velocity)
        torque = torque - self.nominal.rate_damping * acceleration
        thrust = matvec(self.mixer, cat(setpoint.thrust, torque))
        return self.rotors.speed(self._within_limits(thrust, setpoint.thrust, torque[..., 2:]))

    def _within_limits(self, thrust: Vector, collective: Vector, yaw_torque: Vector) -> Vector:
        """The rotor thrusts (*, 4) [N] that can be flown, and give up yaw first.

        Where a rotor saturates: the yaw torque shrinks; if that is not enough the collective thrust moves to make room
        for roll and pitch, up as well as down (airmode); roll and pitch shrink only where they need more than the whole
        range. Thrusts within the limits pass unchanged.

        The mixer asks for ``thrust`` (*, 4) [N]; of this, ``collective`` (*, 1) [N] is collective thrust, and
        ``yaw_torque`` (*, 1) [N m] the torque about body z.
        """
        limited = clamp(thrust, self.thrust_min, self.thrust_max)
        if is_same(limited, thrust):
            return limited
        # In units of collective thrust, of which every rotor has its share; half its range above and below the middle.
        yaw = self.yaw_share * yaw_torque
        tilt = thrust * self.per_share - yaw - collective
        least_tilt, greatest_tilt = tilt.amin(-1, keepdim=True), tilt.amax(-1, keepdim=True)
        shrink = (self.half_span * 2.0 / larger(greatest_tilt - least_tilt, self.tiny)).clamp_max(1.0)
        highest = self.middle + self.half_span - greatest_tilt * shrink
        lowest = self.middle - self.half_span - least_tilt * shrink
        level = larger(smaller(collective, highest), lowest) + tilt * shrink
        # The rotors that yaw speeds up have room above, the others below.
        used = (level - self.middle) * self.yaw_sign
        used = where_positive(yaw_torque, used.amax(-1, keepdim=True), -used.amin(-1, keepdim=True))
        yaw_fits = (self.half_span - used) / larger(yaw_torque.abs() * self.yaw_reach, self.tiny)
        level = level + yaw * yaw_fits.clamp_min(0.0).clamp_max(1.0)
        return where_same(limited, thrust, clamp(level * self.share, self.thrust_min, self.thrust_max))


def join(*parts: Tensor) -> Tensor:
    """Tensors (k) or (num_envs, k) behind each other, in the last dimension."""
    batch = torch.broadcast_shapes(*(x.shape[:-1] for x in parts))
    return torch.cat([x.expand(*batch, x.shape[-1]) for x in parts], -1)


def _check_hover(nominal: QuadrotorParams, speed: Tensor) -> None:
    low, high = nominal.rotor_speed_min, nominal.rotor_speed_max
    if not ((low < speed) & (speed < high)).all():
        raise UserValueError(
            f"drone: to hover, its rotors would have to turn at {speed.tolist()} rad/s, and they can at "
            f"{low.tolist()} to {high.tolist()}. Check mass [kg], gravity, thrust_map and rotor_positions."
        )
    if not (nominal.max_thrust_to_weight > 1).all():
        raise UserValueError(
            "drone: max_thrust_to_weight is what full thrust commands, in units of the weight, and must be above 1 to "
            f"hover; got {nominal.max_thrust_to_weight.tolist()}."
        )


def _inverse(allocation: Tensor) -> Tensor:
    # Rounding makes rotors on one line look invertible: with rows of one length drones have conditions below 100.
    rows = allocation.double()
    rows = rows / rows.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    inverse, _ = torch.linalg.inv_ex(allocation)
    if not (torch.linalg.cond(rows) < 1e4).all():
        raise UserValueError(
            "drone: with these rotor_positions and rotor_spin the four rotors cannot make thrust and torque about each "
            "axis on their own. Put them off one line, and let two of them spin each way."
        )
    return inverse
