"""The flight controllers, from an action to rotor speeds: actions command rates, an attitude, rotors, or velocity.

The outer loops need no tuning: a loop is half as quick as what it acts through, down to the rate loop of the drone.
Loops in such a row are well damped, whatever their number (the damping optimum, Naslin 1968).
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_quad.airframe import listed, uncontrolled
from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.parameters import QuadrotorParams, RawParams
from torchrl_quad.dynamics.rigid_body import Rotors, gyroscopic_torque, thrust_limits
from torchrl_quad.dynamics.vector import (
    Vector,
    cat,
    clamp,
    dot,
    is_same,
    larger,
    matvec,
    smaller,
    soft_limit,
    unbind,
    unbind_all,
    where_positive,
    where_same,
)
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import accepted, between, checked

Nominal = Annotated[
    Any, accepted(lambda x: isinstance(x, QuadrotorParams), "QuadrotorParams, such as load_drone('visfly')")
]
Tilt = Annotated[float, between(0.01, 1.5)]


class Setpoint(NamedTuple):
    """What an action of ``control="rates"`` asks for: collective thrust and body rates (CTBR)."""

    thrust: Vector  #: (*, 1) [N]
    body_rate: Vector  #: (*, 3) [rad/s], body frame


@checked
class FlightController:
    """Rate controller and mixer, with a copy of the parameters of the nominal drone: ``control="rates"``.

    The mixer is the inverse of the allocation of four rotors, and the pseudo-inverse of that of more: of all thrusts
    that make a wrench those with the least sum of squares. It uses the force along body z and the torques: the lateral
    force of tilted rotors pushes the drone, but is not commanded. All rotors count as whole.

    Raises:
        ValueError: the rotor layout cannot make thrust and torque about each axis, or the drone cannot hover.
    """

    #: What the entries of an action command, and in which unit.
    action_units = {"thrust": "N", "roll rate": "rad/s", "pitch rate": "rad/s", "yaw rate": "rad/s"}
    setpoint_type: type[Any] = Setpoint
    setpoint_sizes: tuple[int, ...] = (1, 3)

    def __init__(self, nominal: Nominal) -> None:
        self.nominal = nominal = nominal.detach().replace(rotor_effectiveness=None)
        self.rotors = Rotors(nominal)
        self.mixer = _inverse(self.rotors.allocation[..., :4, :])
        self.thrust_min, self.thrust_max = thrust_limits(nominal)
        self.gain = nominal.inertia * nominal.rate_gain
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
        _check_hover(nominal, self.hover_speed, self.share)

    def reach(self) -> Tensor:
        """The greatest collective thrust without torque, (*, 1), in weights."""
        return (self.middle + self.half_span) / (self.nominal.mass * self.nominal.gravity)

    def spare_torque(self) -> Tensor:
        """Torque (*, 3) [N m] about each axis that the rotors have at hover, to either side, at the same thrust."""
        hover = self.rotors.thrust(self.hover_speed)
        room = torch.minimum(self.thrust_max - hover, hover - self.thrust_min)
        return (room.unsqueeze(-1) / self.mixer[..., 1:].abs().clamp_min(1e-30)).amin(-2)

    def unbind(self) -> FlightController:
        """The same on components: its numbers become constants of the code that is compiled with it."""
        apart = unbind_all(self, matrices=["mixer"])
        used = "rotor_positions", "rotor_direction"  # in the allocation of the rotors
        fields = {k: unbind(x, constant=True) for k, x in self.nominal.fields().items() if k not in used}
        apart.nominal, apart.rotors = RawParams(**fields), unbind_all(self.rotors, matrices=["allocation"])
        return apart

    def decode(self, action: Tensor) -> Tensor:
        """What an action (*, k) in [-1, 1] commands, in ``action_units``; values outside are clamped."""
        return (action.clamp(-1.0, 1.0) + self.offset) * self.scale

    def encode(self, command: Tensor) -> Tensor:
        """The action (*, k) for a command in ``action_units``; beyond the limits it lies outside [-1, 1]."""
        return command / self.scale - self.offset

    def setpoint(self, action: Tensor) -> Any:
        """Decode an action (*, k), for :meth:`command`."""
        return self.setpoint_type(*self.decode(action).split(self.setpoint_sizes, -1))

    def command(self, setpoint: Any, state: Any, wrench: Vector) -> Vector:
        """Commanded rotor speed (*, n) [rad/s] for a setpoint, the drone's state, and the present wrench."""
        rates = self.rate_setpoint(setpoint, state.quaternion, state.velocity)
        return self.rotor_speed(rates, state.angular_velocity, wrench)

    def rate_setpoint(self, setpoint: Any, attitude: Vector, velocity: Vector) -> Setpoint:
        """Thrust and body rates for a setpoint, at an attitude (*, 4) and a velocity (*, 3) [m/s], world frame."""
        return setpoint

    def rotor_speed(self, setpoint: Setpoint, angular_velocity: Vector, wrench: Vector) -> Vector:
        """Commanded rotor speed (*, n) [rad/s] for a setpoint, the body rates (*, 3), and the present wrench.

        Torque = J K (desired rate - rate) - D (angular acceleration) + w x J w, where the angular acceleration follows
        from the wrench that nominal rotors exert; the setpoint is held, so that the paper's derivative of the desired
        rate is zero. The moment of a drag above the centre of mass disturbs this loop, as it does any without integral.
        """
        thrust, torque = self.asked(setpoint, angular_velocity, wrench)
        return self.rotors.speed(self._within_limits(thrust, setpoint.thrust, torque[..., 2:]))

    def asked(self, setpoint: Setpoint, angular_velocity: Vector, wrench: Vector) -> tuple[Vector, Vector]:
        """The thrusts (*, n) [N] that the mixer asks of the rotors, and the torque (*, 3) [N m] for which it does."""
        held = gyroscopic_torque(angular_velocity, self.nominal.inertia)
        acceleration = (wrench[..., 1:4] - held) / self.nominal.inertia
        torque = held.addcmul(self.gain, setpoint.body_rate - angular_velocity)
        torque = torque - self.nominal.rate_damping * acceleration
        return matvec(self.mixer, cat(setpoint.thrust, torque)), torque

    def _within_limits(self, thrust: Vector, collective: Vector, yaw_torque: Vector) -> Vector:
        """The rotor thrusts (*, n) [N] that can be flown, for what the mixer asks of them."""
        # Thrusts within the limits pass unchanged. Where a rotor saturates, the yaw torque shrinks; if that is not
        # enough the collective thrust moves to make room for roll and pitch, up as well as down (airmode); roll and
        # pitch shrink only where they need more than the whole range.
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


def _check_hover(nominal: QuadrotorParams, speed: Tensor, share: Tensor) -> None:
    if not (share > 0).all():
        raise UserValueError(
            f"drone: to hover, its rotors would have to carry {listed(share.tolist())} of the weight each, and each "
            "must carry a part. Put the centre of mass, x = y = 0, between the rotors of rotor_positions, and let "
            "rotor_direction point up; of four rotors neighbours spin opposite ways, rotor_spin."
        )
    low, high, most = nominal.rotor_speed_min, nominal.rotor_speed_max, nominal.max_thrust_to_weight
    if not ((low < speed) & (speed < high)).all():
        raise UserValueError(
            f"drone: to hover, its rotors would have to turn at {speed.tolist()} rad/s, and they can at "
            f"{low.tolist()} to {high.tolist()}. Check mass [kg], gravity, thrust_map and rotor_positions."
        )
    if not (most > 1).all():
        raise UserValueError(
            f"drone: max_thrust_to_weight is that of full thrust, and must be above 1 to hover; got {most.tolist()}."
        )


def _inverse(allocation: Tensor) -> Tensor:
    if axes := uncontrolled(allocation.double().cpu().numpy()):
        raise UserValueError(
            f"drone: its {allocation.shape[-1]} rotors cannot control {axes} independently. It takes four "
            "or more with a torque about each axis on its own: put them off one line, let some spin each way "
            "(rotor_spin), or tilt them (rotor_direction)."
        )
    four = allocation.shape[-1] == 4
    return torch.linalg.inv_ex(allocation)[0] if four else torch.linalg.pinv(allocation.double()).to(allocation)


class AttitudeSetpoint(NamedTuple):
    """What an action of ``control="attitude"`` asks for."""

    thrust: Vector  #: (*, 1) [N], collective
    up: Vector  #: (*, 3), the world's up in the wanted body frame, a unit vector
    yaw_rate: Vector  #: (*, 1) [rad/s], about the world's up


class RotorSetpoint(NamedTuple):
    """What an action of ``control="rotor_thrusts"`` asks for."""

    thrust: Vector  #: (*, n) [N], of each of n rotors


class VelocitySetpoint(NamedTuple):
    """What an action of ``control="velocity"`` asks for."""

    velocity: Vector  #: (*, 3) [m/s], world frame
    yaw_rate: Vector  #: (*, 1) [rad/s], about the world's up


class TiltController(FlightController):
    """What the controllers of attitude and velocity share: a loop that tilts the drone."""

    def __init__(self, nominal: QuadrotorParams, max_tilt: float) -> None:
        super().__init__(nominal)
        self.max_tilt, nominal = float(max_tilt), self.nominal
        # The rate loop J K / (tau_m J s^2 + (J + D) s + J K) lags by this many seconds.
        lag = (1.0 + nominal.rate_damping / nominal.inertia) / nominal.rate_gain
        self.tilt_gain, self.tilt_rate = 0.5 / lag[..., :2], nominal.max_body_rate[..., :2]

    def tilting_rates(self, error: Vector) -> Vector:
        """Roll and pitch rate (*, 2) [rad/s] for a tilt error: the sine of the angle left about x and y, (*, 2)."""
        return soft_limit(self.tilt_gain * error, self.tilt_rate)


@checked
class AttitudeController(TiltController):
    """``control="attitude"``: collective thrust, roll, pitch, and rate of yaw.

    Roll and pitch are Euler angles in the order z, y, x, of -max_tilt to max_tilt. The heading is free: yaw turns about
    the world's up. Thrust is that of ``control="rates"``.

    Args:
        max_tilt: greatest roll and greatest pitch that an action can ask for, each 0.01 to 1.5 rad, 86 degrees.
    """

    action_units = {"thrust": "N", "roll": "rad", "pitch": "rad", "yaw rate": "rad/s"}
    setpoint_type, setpoint_sizes = AttitudeSetpoint, (1, 3, 1)

    def __init__(self, nominal: Nominal, *, max_tilt: Tilt = math.pi / 6) -> None:
        super().__init__(nominal, max_tilt)
        tilt = self.tilt_rate.new_full((2,), self.max_tilt)
        self.scale = join(self.half_range, tilt, self.nominal.max_body_rate[..., 2:])

    def setpoint(self, action: Tensor) -> AttitudeSetpoint:
        """Decode an action (*, 4)."""
        thrust, roll, pitch, yaw_rate = self.decode(action).split(1, -1)
        level = pitch.cos()
        return AttitudeSetpoint(thrust, cat(-pitch.sin(), roll.sin() * level, roll.cos() * level), yaw_rate)

    def rate_setpoint(self, setpoint: AttitudeSetpoint, attitude: Vector, velocity: Vector) -> Setpoint:
        """Thrust and body rates that lead to the attitude."""
        up = quaternion.up_in_body(attitude)
        (x, y, z), (wanted_x, wanted_y, wanted_z) = _entries(up), _entries(setpoint.up)
        error = cat(wanted_y * z - wanted_z * y, wanted_z * x - wanted_x * z)  # wanted up x present up
        yaw = setpoint.yaw_rate  # about the world's up: roll and pitch turn with the heading
        return Setpoint(setpoint.thrust, cat(self.tilting_rates(error) + yaw * up[..., :2], yaw * up[..., 2:]))


@checked
class RotorThrustController(FlightController):
    """``control="rotor_thrusts"``: the thrust of each rotor, in their order, without a flight controller.

    Each entry maps -1..1 to 0..1 times the rotor's part of the full collective thrust of ``control="rates"``; what a
    rotor cannot give is cut off.
    """

    setpoint_type = RotorSetpoint

    def __init__(self, nominal: Nominal) -> None:
        super().__init__(nominal)
        n = self.share.shape[-1]
        self.action_units, self.setpoint_sizes = {f"rotor {i + 1}": "N" for i in range(n)}, (n,)
        self.offset, self.scale = self.offset.new_ones(n), self.half_range * self.share
        self.hover_action = self.hover_action[..., :1].repeat_interleave(n, -1)

    def command(self, setpoint: RotorSetpoint, state: Any, wrench: Vector) -> Vector:
        """Commanded rotor speed (*, n) [rad/s]."""
        return self.rotors.speed(clamp(setpoint.thrust, self.thrust_min, self.thrust_max))


@checked
class VelocityController(TiltController):
    """``control="velocity"``: velocity in the world frame, and rate of yaw.

    The velocity error asks for an acceleration, and with the weight for a thrust, along which the drone tilts. There is
    no integral part: drag, wind, and a weight that differs from the nominal one leave an error.

    Args:
        max_tilt: greatest angle by which it tilts, 0.01 to 1.5 rad, 86 degrees.
        max_speed: greatest velocity along each axis that an action can ask for, 0.01 to 100 m/s.
    """

    action_units = {"velocity x": "m/s", "velocity y": "m/s", "velocity z": "m/s", "yaw rate": "rad/s"}
    setpoint_type, setpoint_sizes = VelocitySetpoint, (3, 1)

    def __init__(
        self, nominal: Nominal, *, max_tilt: Tilt = math.pi / 6, max_speed: Annotated[float, between(0.01, 100.0)] = 3.0
    ) -> None:
        super().__init__(nominal, max_tilt)
        # Sideways it acts through the tilt: its lag, and the time to tilt fully at the greatest rate. Upwards it acts
        # only through the rotors, as the tilt does.
        tilt_gain = self.tilt_gain.amin(-1, keepdim=True)
        sideways = 0.5 / (1.0 / tilt_gain + self.max_tilt / self.tilt_rate.amin(-1, keepdim=True))
        self.velocity_gain = join(sideways, sideways, tilt_gain)
        # The drone keeps half its weight, so that a direction of thrust is always defined, and half its spare thrust.
        self.max_climb = 0.5 * self.nominal.gravity * (self.nominal.max_thrust_to_weight - 1.0).clamp_max(1.0)
        self.slope, self.full_thrust = math.tan(self.max_tilt), 2.0 * self.half_range
        speed = sideways.new_full((3,), float(max_speed))
        self.offset, self.scale = self.offset.new_zeros(4), join(speed, self.nominal.max_body_rate[..., 2:])
        self.hover_action = self.offset.clone()

    def rate_setpoint(self, setpoint: VelocitySetpoint, attitude: Vector, velocity: Vector) -> Setpoint:
        """Thrust and body rates that lead to the velocity."""
        wanted = self.velocity_gain * (setpoint.velocity - velocity)
        climb = soft_limit(wanted[..., 2:], self.max_climb) + self.nominal.gravity
        sideways, reach = wanted[..., :2], climb * self.slope
        sideways = sideways * (dot(sideways, sideways) / reach.square() + 1.0).rsqrt()
        wanted = cat(sideways, climb)
        in_body = quaternion.rotate_inverse(attitude, wanted)
        thrust = (in_body[..., 2:] * self.nominal.mass).clamp_min(0.0).minimum(self.full_thrust)
        x, y, _ = _entries(in_body * dot(wanted, wanted).rsqrt())
        error = cat(-y, x)  # body z x wanted direction of thrust
        # The thrust keeps its direction in the world while the drone turns under it.
        rates = cat(self.tilting_rates(error), setpoint.yaw_rate * quaternion.up_in_body(attitude)[..., 2:])
        return Setpoint(thrust, rates)


#: The flight controllers by the name of what their actions command.
CONTROLS: dict[str, type[FlightController]] = {
    "rates": FlightController,
    "attitude": AttitudeController,
    "rotor_thrusts": RotorThrustController,
    "velocity": VelocityController,
}


def make_controller(control: str | Mapping[str, Any], nominal: QuadrotorParams) -> FlightController:
    """Build a flight controller for what it takes to be the drone's parameters.

    ``control`` is a name of ``CONTROLS``, or a mapping with this as ``mode`` and limits: ``{"mode": "velocity",
    "max_speed": 5.0}``.

    Raises:
        ValueError: the name is unknown, or the mode has no such limit, or the limit is out of its range.
    """
    limits = dict(control) if isinstance(control, Mapping) else {"mode": control}
    mode = limits.pop("mode", None)
    if not isinstance(mode, str) or mode not in CONTROLS:
        what = f"Unknown control {shown(mode)}" if mode is not None else f"control={shown(control)} has no 'mode' key"
        choices = f'Choose from: {", ".join(CONTROLS)}; or {{"mode": "velocity", "max_speed": 5.0}}.'
        raise UserValueError(f"{what}. {choices}")
    known = [x.name for x in inspect.signature(CONTROLS[mode]).parameters.values() if x.kind is x.KEYWORD_ONLY]
    for name in (name for name in limits if name not in known):
        has = f"Choose from: {', '.join(known)}" if known else "It has none; those of the drone hold"
        raise UserValueError(f"control: {mode!r} has no limit {shown(name)}. {has}.")
    try:
        return CONTROLS[mode](nominal, **limits)
    except UserValueError as error:
        where = "control: " if limits and not str(error).startswith(("drone", "nominal")) else ""
        raise UserValueError(f"{where}{error}") from None


def _entries(vector: Vector) -> tuple[Vector, Vector, Vector]:
    return vector[..., :1], vector[..., 1:2], vector[..., 2:]
