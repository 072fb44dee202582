"""What an action may command: body rates, an attitude, single rotors, or a velocity.

The outer loops need no tuning: a loop is half as quick as what it acts through, down to the rate loop of the drone.
Loops in such a row are well damped, whatever their number (the damping optimum, Naslin 1968).
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.control import FlightController, Nominal, Setpoint, join
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.vector import Vector, cat, clamp, dot, soft_limit
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import between, checked

Tilt = Annotated[float, between(0.01, 1.5)]


class AttitudeSetpoint(NamedTuple):
    """What an action of ``control="attitude"`` asks for."""

    thrust: Vector  #: (*, 1) [N], collective
    up: Vector  #: (*, 3), the world's up in the wanted body frame, a unit vector
    yaw_rate: Vector  #: (*, 1) [rad/s], about the world's up


class RotorSetpoint(NamedTuple):
    """What an action of ``control="rotor_thrusts"`` asks for."""

    thrust: Vector  #: (*, 4) [N], of each rotor


class VelocitySetpoint(NamedTuple):
    """What an action of ``control="velocity"`` asks for."""

    velocity: Vector  #: (*, 3) [m/s], world frame
    yaw_rate: Vector  #: (*, 1) [rad/s], about the world's up


class TiltController(FlightController):
    """What the controllers of attitude and velocity share: a loop that tilts the drone."""

    def __init__(self, nominal: QuadrotorParams, max_tilt: float) -> None:
        super().__init__(nominal)
        self.max_tilt = float(max_tilt)
        nominal = self.nominal
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
    """``control="rotor_thrusts"``: the thrust of each rotor, without a flight controller.

    Each entry maps -1..1 to 0..1 times the rotor's part of the full collective thrust of ``control="rates"``. Rotors
    are in the order of ``rotor_positions``; what they cannot give is cut off.
    """

    action_units = {f"rotor {i}": "N" for i in (1, 2, 3, 4)}
    setpoint_type, setpoint_sizes = RotorSetpoint, (4,)

    def __init__(self, nominal: Nominal) -> None:
        super().__init__(nominal)
        self.offset, self.scale = self.offset.new_ones(4), self.half_range * self.share
        self.hover_action = self.hover_action[..., :1].expand(*self.hover_action.shape).contiguous()

    def command(self, setpoint: RotorSetpoint, state: Any, wrench: Vector) -> Vector:
        """Commanded rotor speed (*, 4) [rad/s]."""
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
        nominal = self.nominal
        # Sideways it acts through the tilt: its lag, and the time to tilt fully at the greatest rate. Upwards it acts
        # only through the rotors, as the tilt does.
        tilt_gain = self.tilt_gain.amin(-1, keepdim=True)
        sideways = 0.5 / (1.0 / tilt_gain + self.max_tilt / self.tilt_rate.amin(-1, keepdim=True))
        self.velocity_gain = join(sideways, sideways, tilt_gain)
        # The drone keeps half its weight, so that a direction of thrust is always defined, and half its spare thrust.
        self.max_climb = 0.5 * nominal.gravity * (nominal.max_thrust_to_weight - 1.0).clamp_max(1.0)
        self.slope, self.full_thrust = math.tan(self.max_tilt), 2.0 * self.half_range
        speed = sideways.new_full((3,), float(max_speed))
        self.offset, self.scale = self.offset.new_zeros(4), join(speed, nominal.max_body_rate[..., 2:])
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
    """Build a flight controller for a drone.

    Args:
        control: a name of ``CONTROLS``, or a mapping with ``mode``, the name, and limits: ``{"mode": "velocity",
            "max_speed": 5.0}``.
        nominal: what it takes to be the drone's parameters.

    Raises:
        ValueError: the name is unknown, or the mode has no such limit, or the limit is out of its range.
    """
    limits = dict(control) if isinstance(control, Mapping) else {"mode": control}
    mode = limits.pop("mode", None)
    if not isinstance(mode, str) or mode not in CONTROLS:
        what = f"Unknown control {shown(mode)}" if mode is not None else f"control={shown(control)} has no 'mode' key"
        raise UserValueError(
            f'{what}. Choose from: {", ".join(CONTROLS)}; or {{"mode": "velocity", "max_speed": 5.0}}.'
        )
    known = [x.name for x in inspect.signature(CONTROLS[mode]).parameters.values() if x.kind is x.KEYWORD_ONLY]
    for name in limits:
        if name not in known:
            has = f"Choose from: {', '.join(known)}" if known else "It has none; those of the drone hold"
            raise UserValueError(f"control: {mode!r} has no limit {shown(name)}. {has}.")
    try:
        return CONTROLS[mode](nominal, **limits)
    except UserValueError as error:
        where = "control: " if limits and not str(error).startswith(("drone", "nominal")) else ""
        raise UserValueError(f"{where}{error}") from None


def _entries(vector: Vector) -> tuple[Vector, Vector, Vector]:
    return vector[..., :1], vector[..., 1:2], vector[..., 2:]
