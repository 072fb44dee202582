"""Conventions of autopilots and simulators: our quantities in their frames, orders, signs and units, and back.

.. code-block:: python

    px4 = frames.px4(world="enu")
    state = px4.back({"position": ned, "velocity": v_ned, "quaternion": q, "angular_velocity": w_frd})
    thrust, rates = bundle({**state, "age": age})
    rates_frd = px4.to({"body_rate": rates})["body_rate"]
    thrust_z = px4.thrust(thrust, full_thrust=weight / hover_thrust)

Ours: a world with z up, in which x and y may point anywhere; body x forward, y left, z up (FLU); quaternions
(w, x, y, z) from body to world; rotors front left, back left, back right, front right: a drone that lists them
otherwise needs ``px4.of(drone.rotor_positions)``, see :meth:`Convention.of`. Where a target has a north, say
where our x and y point: ``world="enu"``, x east and y north, or ``world="nwu"``, x north and y west.

Everything broadcasts over leading dimensions. ``docs/deploy_autopilots.md`` says which facts were read in the source of
a target, and which in its documentation; check them against your version.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_quad.airframe import quarters
from torchrl_quad.errors import UserValueError
from torchrl_quad.rotations import conjugate, multiply, rotate

Array = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]

_HALF = 0.5**0.5
SAME: Quaternion = (1.0, 0.0, 0.0, 0.0)
# Turn the components of a vector in one frame into those in another; the right-handed frames differ by a rotation.
ENU_TO_NED: Quaternion = (0.0, _HALF, _HALF, 0.0)  # (x, y, z) -> (y, x, -z)
NWU_TO_NED: Quaternion = (0.0, 1.0, 0.0, 0.0)  # (x, y, z) -> (x, -y, -z)
NWU_TO_ENU: Quaternion = (_HALF, 0.0, 0.0, _HALF)  # (x, y, z) -> (-y, x, z)
FLU_TO_FRD: Quaternion = (0.0, 1.0, 0.0, 0.0)  # (x, y, z) -> (x, -y, -z)
DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class Convention:
    """The conventions of one target. :meth:`to` and :meth:`back` translate quantities by name:

    ====================  =====  ===================================================================================
    quantity              size   meaning
    ====================  =====  ===================================================================================
    ``position``          3      [m], world frame
    ``velocity``          3      [m/s], world frame
    ``quaternion``        4      attitude; ours w x y z
    ``angular_velocity``  3      [rad/s], as measured, body frame
    ``body_rate``         3      as commanded: ours [rad/s], body frame; theirs in ``rates``, see below
    ``motors``            4      anything that belongs to a motor each; ours front left, back left, back right, front
                                 right, or as the drone lists its own: see :meth:`of`
    ====================  =====  ===================================================================================
    """

    name: str
    world: Quaternion = SAME  #: from our world frame to theirs
    body: Quaternion = SAME  #: from our body frame to theirs
    xyzw: bool = False  #: whether their quaternions are (x, y, z, w)
    motors: tuple[int, ...] = ()  #: for each of their motors the index of ours; none where they have no fixed order
    rates: tuple[float, float, float] = (1.0, 1.0, 1.0)  #: their commanded rates for ours of 1 rad/s
    thrust_range: tuple[float, float] | None = None  #: their commands for no and full thrust; None where in newtons
    thrust_limit: float = 1.0  #: the share of this range that may be commanded
    whole_thrust: bool = False  #: whether their command is a whole number
    idle: float = 0.0  #: the share of the motors' signal that their command for no thrust leaves

    def of(self, rotor_positions: ArrayLike) -> Convention:
        """The same for a drone with its rotors at (4, 2 or 3) [m], as its contract lists them, in any order.

        Raises:
            ValueError: they are not those of an X, one in each quarter.
        """
        if not (places := quarters(rotor_positions)):
            raise UserValueError(
                f"{self.name} numbers the motors of an X, one in each quarter, and this drone has rotors at "
                f"{np.asarray(rotor_positions).tolist()}. Map its motors by hand."
            )
        return replace(self, motors=tuple(places.index(place) for place in self.motors))

    def to(self, quantities: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Our quantities as theirs.

        Raises:
            ValueError: a quantity is unknown, has another size, or the target has no fixed order of motors.
        """
        return {name: self._translate(name, x, False) for name, x in quantities.items()}

    def back(self, quantities: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Their quantities as ours; see :meth:`to`."""
        return {name: self._translate(name, x, True) for name, x in quantities.items()}

    def thrust(self, newtons: ArrayLike, full_thrust: float | None = None, model_factor: float = 0.0) -> Array:
        """Their command for a collective thrust [N].

        A command beyond their range is moved to its end. Where they take newtons, that is what they get.

        Args:
            newtons: our collective thrust.
            full_thrust: the thrust [N] of their full command, unless the target takes newtons: weight / hover command,
                and for a Crazyflie 4 THRUST_MAX. For Betaflight betaflight.txt in a bundle has both.
            model_factor: f of the thrust curve f s^2 + (1 - f) s of the motors' signal s, where the target does not
                undo it itself. PX4 does, by THR_MDL_FAC, and ArduPilot, by MOT_THST_EXPO: leave it 0 there.

        Raises:
            ValueError: a thrust is not finite, full_thrust is missing or not above 0, or model_factor is not in 0 to 1.
        """
        x = np.asarray(newtons, float)
        if not np.isfinite(x).all():
            raise UserValueError(f"newtons must be finite: there is no command for {newtons!r}. Give the thrust [N].")
        if self.thrust_range is None:
            return x
        low, high = self.thrust_range
        signal = motor_signal(x / self._full_thrust(full_thrust), model_factor)
        share = (signal - self.idle) / (1.0 - self.idle)
        command = low + (high - low) * np.clip(share, 0.0, self.thrust_limit)
        return np.rint(command).astype(int) if self.whole_thrust else command

    def newtons(self, command: ArrayLike, full_thrust: float | None = None, model_factor: float = 0.0) -> Array:
        """The collective thrust [N] of their command; see :meth:`thrust`."""
        if self.thrust_range is None:
            return np.asarray(command, float)
        low, high = self.thrust_range
        share = (np.asarray(command, float) - low) / (high - low)
        return self._full_thrust(full_thrust) * motor_thrust(self.idle + (1.0 - self.idle) * share, model_factor)

    def _full_thrust(self, value: float | None) -> float:
        if value is None or not 0.0 < value < np.inf:
            raise UserValueError(
                f"full_thrust must be the thrust [N] of the full command of {self.name}, above 0, got {value!r}: it "
                "turns newtons into a share. Write weight / hover command."
            )
        return value

    def _translate(self, name: str, value: ArrayLike, back: bool) -> Array:
        if name not in _SIZES:
            raise UserValueError(f"Unknown quantity {name!r}. Choose from: {', '.join(_SIZES)}.")
        if name == "motors" and not self.motors:
            raise UserValueError(f"{self.name} has no order of motors of its own: name them by their places.")
        x = np.asarray(value, float)
        if x.shape[-1:] != (_SIZES[name],):
            raise UserValueError(f"{name} must have shape (..., {_SIZES[name]}), got {x.shape}.")
        if name in ("position", "velocity", "angular_velocity"):
            turn = np.round(rotate(self.body if name == "angular_velocity" else self.world, np.eye(3)))  # 0, 1 and -1
            return x @ (turn.T if back else turn)
        if name == "body_rate":
            return x / self.rates if back else x * self.rates
        if name == "motors":
            return x[..., np.argsort(self.motors) if back else list(self.motors)]
        if not back:
            q = multiply(multiply(self.world, x), conjugate(self.body))
            return np.roll(q, -1, -1) if self.xyzw else q
        q = np.roll(x, 1, -1) if self.xyzw else x
        return multiply(multiply(conjugate(self.world), q), self.body)


_SIZES = {"position": 3, "velocity": 3, "quaternion": 4, "angular_velocity": 3, "body_rate": 3, "motors": 4}


def named(convention: str | Mapping[str, Any]) -> Convention:
    """A convention by its name, or by {"name": "px4", "xyzw": True}."""
    name, xyzw = (convention, None) if isinstance(convention, str) else (convention["name"], convention.get("xyzw"))
    made = globals()[name]()
    return made if xyzw is None else replace(made, xyzw=xyzw)


def px4(world: str = "enu") -> Convention:
    """PX4: NED and FRD, w x y z. Thrust is ``thrust_body[2]``, from 0 down to -1, of VehicleRatesSetpoint or
    VehicleAttitudeSetpoint; ``MPC_THR_HOVER`` is the hover command without its sign. Motors of the quad X."""
    return _aerospace("PX4", world, (0.0, -1.0))


def ardupilot(world: str = "enu") -> Convention:
    """ArduPilot Copter: NED and FRD, w x y z. SET_ATTITUDE_TARGET's thrust is one, from 0 to 1, only with 8 in
    ``GUID_OPTIONS``, and a climb rate otherwise; ``MOT_THST_HOVER`` is the hover command. Motors of the quad X."""
    return _aerospace("ArduPilot", world, (0.0, 1.0))


def betaflight(sitl: bool = False, min_check: float = 1000.0, motor_idle: float = 0.0) -> Convention:
    """Betaflight: rates [deg/s] as its sticks count them, roll right, pitch forward, yaw right; throttle up to 2000 us.
    It estimates no position, and does not undo the thrust curve: give ``model_factor``, and set thrust_linear to 0.

    Args:
        sitl: the order of the motor packets of its simulator target, not of its outputs.
        min_check: the throttle [us] up to which it hears none; the firmware's default is 1050.
        motor_idle: what its motors get then, a share of their signal. Its setting of this name counts in 0.01 %, and
            has the default 550. A throttle t makes idle + (1 - idle) (t - min_check) / (2000 - min_check).
    """
    if not (750.0 <= min_check < 2000.0 and 0.0 <= motor_idle < 1.0):
        raise UserValueError(
            f"min_check must lie from 750 to below 2000 us, and motor_idle from 0 to below 1, got {min_check!r} and "
            f"{motor_idle!r}. Write 1050 and 0.055 for the firmware's defaults."
        )
    motors, rates = (3, 1, 0, 2) if sitl else (2, 3, 1, 0), (DEGREES, DEGREES, -DEGREES)
    return Convention("Betaflight", motors=motors, rates=rates, thrust_range=(min_check, 2000.0), idle=motor_idle)


def crazyflie(manual: bool = False) -> Convention:
    """Crazyflie through cflib: z up and FLU, x y z w. Rates [deg/s] and thrust (0 to 65535, at most 60000) of
    ``send_setpoint``, in rate mode; or, with ``manual``, of ``send_setpoint_manual(rate=True)``, whose yaw has the
    other sign and whose thrust :func:`crazyflie_percentage` converts. Thrust is a whole number, as cflib packs it.

    Send one ``send_setpoint`` of zero thrust first: until then the firmware holds the motors. Measured body rates are
    ``stateEstimateZ.rateRoll``, ``ratePitch`` and ``rateYaw`` in mrad/s; ratePitch has the other sign than ours."""
    rates = (DEGREES, DEGREES, DEGREES if manual else -DEGREES)
    return Convention("Crazyflie", SAME, SAME, True, (3, 2, 1, 0), rates, (0.0, 65535.0), 60000 / 65535, True)


def mavros(world: str = "enu", thrust_scaling: float = 1.0) -> Convention:
    """mavros (ROS): ENU and FLU, x y z w; it translates to the autopilot's frames itself. The thrust of
    ``setpoint_raw/attitude``: mavros multiplies it by its parameter ``setpoint_raw/thrust_scaling``, and clips the
    product to 0 to 1. Give that parameter here; with 1 / full_thrust the command is in newtons."""
    if not 0.0 < thrust_scaling < np.inf:
        raise UserValueError(
            f"thrust_scaling must be above 0, got {thrust_scaling!r}: mavros multiplies the thrust by it. Write its "
            "parameter setpoint_raw/thrust_scaling."
        )
    to_enu = _world(world, SAME, NWU_TO_ENU)
    return Convention("mavros", to_enu, xyzw=True, thrust_range=(0.0, 1.0 / thrust_scaling))


def mujoco() -> Convention:
    """MuJoCo: z up, w x y z; the angular velocity in ``qvel`` of a free joint is in the body frame, the velocity in the
    world frame. Thrust in N at a site for each rotor, in the order of the model."""
    return Convention("MuJoCo")


def rotorpy() -> Convention:
    """RotorPy: z up and FLU, x y z w, body rates; ``cmd_ctbr`` in N and rad/s. Rotors in the order of its X frames."""
    return Convention("RotorPy", xyzw=True, motors=(0, 3, 2, 1))


def crazyflow() -> Convention:
    """Crazyflow: z up and FLU, x y z w, body rates, thrust in N. Rotors in the order of a Crazyflie."""
    return Convention("Crazyflow", xyzw=True, motors=(3, 2, 1, 0))


def motor_signal(thrust: ArrayLike, model_factor: float) -> Array:
    """The signal s, from 0 to 1, whose thrust f s^2 + (1 - f) s, a share of all thrust, is the one given."""
    u, f = np.asarray(thrust, float), _model_factor(model_factor)
    root = np.sqrt((1.0 - f) ** 2 + 4.0 * f * np.maximum(u, 0.0))
    return 2.0 * u / (1.0 - f + root) if f < 1.0 else np.sqrt(np.maximum(u, 0.0))


def motor_thrust(signal: ArrayLike, model_factor: float) -> Array:
    """The share of all thrust, f s^2 + (1 - f) s, of a signal s; PX4 calls f THR_MDL_FAC."""
    s, f = np.asarray(signal, float), _model_factor(model_factor)
    return f * s * s + (1.0 - f) * s


def crazyflie_percentage(command: ArrayLike) -> Array:
    """The ``thrust_percentage`` of ``send_setpoint_manual`` that sends this thrust command; from 10001 to 60000."""
    return np.clip((np.asarray(command, float) - 10001.0) / (60000.0 - 10001.0), 0.0, 1.0) * 100.0


def _model_factor(value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise UserValueError(
            f"model_factor must lie from 0 to 1, got {value!r}: it is f of the thrust curve f s^2 + (1 - f) s. Write 0 "
            "where the target undoes the curve itself."
        )
    return value


def _aerospace(name: str, world: str, thrust_range: tuple[float, float]) -> Convention:
    to_ned = _world(world, ENU_TO_NED, NWU_TO_NED)
    return Convention(name, to_ned, FLU_TO_FRD, False, (3, 1, 0, 2), (1.0, -1.0, -1.0), thrust_range)


def _world(name: str, enu: Quaternion, nwu: Quaternion) -> Quaternion:
    if name not in ("enu", "nwu"):
        raise UserValueError(
            f'Unknown world {name!r}. Choose from: "enu", x east and y north; "nwu", x north and y west.'
        )
    return enu if name == "enu" else nwu
