"""The quadrotor with rate loops as autopilots have them: with an integral, and with Betaflight's rest and mixer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from torchrl_quad.airframe import INTEGRAL_SHARE
from torchrl_quad.dynamics.control import FlightController, Setpoint
from torchrl_quad.dynamics.gains import rate_loop
from torchrl_quad.dynamics.model import Quadrotor
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.rigid_body import gyroscopic_torque
from torchrl_quad.dynamics.vector import Vector, cat, clamp, larger, matvec, smaller, where_positive
from torchrl_quad.errors import UserValueError

RELAX_CUTOFF = 15.0  # [Hz], iterm_relax_cutoff
RELAX_THRESHOLD = math.radians(40.0)  # [rad/s], by which a setpoint that leaves its mean stops the integral


class PIDController(FlightController):
    """The rate loop of training, with what an integral needs."""

    def __init__(self, nominal: QuadrotorParams) -> None:
        super().__init__(nominal)
        self.integral_rate = torch.as_tensor(INTEGRAL_SHARE * rate_loop(nominal, 0.0).bandwidth).to(self.gain)  # [1/s]


class FirmwareController(PIDController):
    """A mixer that adds torques to the speeds of rotors and not to their thrusts: the loop is quicker with throttle."""

    def __init__(self, nominal: QuadrotorParams) -> None:
        super().__init__(nominal)
        k2, k1, _ = nominal.thrust_map.split(1, -1)
        self.per_slope = 1.0 / (2.0 * k2 * self.hover_speed.mean(-1, keepdim=True) + k1)  # [rad/s per N]
        self.span = nominal.rotor_speed_max - nominal.rotor_speed_min

    def rotor_speed(self, setpoint: Setpoint, angular_velocity: Vector, wrench: Vector) -> Vector:
        """As for the loop of training, of which it only sees the gyro. Where the torques need more than the whole range
        they shrink, all alike; the throttle moves to make room for them (airmode)."""
        held = gyroscopic_torque(angular_velocity, self.nominal.inertia)
        acceleration = (wrench[..., 1:4] - held) / self.nominal.inertia
        torque = self.gain * (setpoint.body_rate - angular_velocity) - self.nominal.rate_damping * acceleration
        mix = matvec(self.mixer, cat(setpoint.thrust * 0.0, torque)) * self.per_slope
        least, greatest = mix.amin(-1, keepdim=True), mix.amax(-1, keepdim=True)
        shrink = (self.span / larger(greatest - least, self.span * 1e-6)).clamp_max(1.0)
        low, high = self.nominal.rotor_speed_min, self.nominal.rotor_speed_max
        throttle = self.rotors.speed(clamp(self.share * setpoint.thrust, self.thrust_min, self.thrust_max))
        throttle = larger(smaller(throttle, high - greatest * shrink), low - least * shrink)
        return clamp(throttle + mix * shrink, low, high)


class PID(Quadrotor):
    """The quadrotor with a PID rate loop, whose integral rests only while a rotor saturates: ``firmware="pid"``.

    The state has ``rate_integral`` (3) [rad/s], what the integral adds to the wanted body rate. In a step of dt, if
    each rotor can do what it is asked for, with I = 0.1 bandwidth [1/s],

    .. math:: integral \\leftarrow integral + dt I (wanted - w).

    Raises:
        ValueError: actions command something else than body rates.
    """

    sizes = {**Quadrotor.sizes, "rate_integral": 3}
    _loop = PIDController

    def finish(self) -> None:
        """Refuse other controllers than that of body rates, whose place this one takes."""
        super().finish()
        if type(self.controller) is not FlightController:
            raise UserValueError("firmware=... flies body rates. Leave out control=..., or firmware.")
        self.controller = self._loop(self.nominal)

    def physics_step(
        self, state: Sequence[Vector], setpoint: Any, plant: Any, controller: Any, wind: Vector | None
    ) -> Any:
        """The quadrotor's step, for a wanted body rate to which the integral adds."""
        *drone, integral = state
        wanted = Setpoint(setpoint.thrust, setpoint.body_rate + integral)
        asked, _ = controller.asked(wanted, drone[3], controller.rotors.wrench(drone[4]))
        beyond = (clamp(asked, controller.thrust_min, controller.thrust_max) - asked).abs().amax(-1, keepdim=True)
        fits = where_positive(beyond, beyond * 0.0, beyond * 0.0 + 1.0)
        integral = integral + controller.integral_rate * (setpoint.body_rate - drone[3]) * fits * self.dt
        return [*super().physics_step(drone, wanted, plant, controller, wind), integral]


class Betaflight(PID):
    """The quadrotor with Betaflight's mixer, and with an integral that rests while commands move:
    ``firmware="betaflight"``.

    Entries of the state, each (3) [rad/s]: ``rate_integral``, what the integral adds to the wanted body rate, and
    ``slow_rate``, the wanted body rate behind a low-pass filter. In a step of dt, with I = 0.1 bandwidth [1/s],

    .. math:: slow \\leftarrow slow + (1 - e^{-2 \\pi 15 dt}) (wanted - slow), \\qquad
        integral \\leftarrow integral + dt I (wanted - w) \\max(0, 1 - |wanted - slow| / 40°/s).

    Source: ``pid.c`` and ``mixer.c`` of Betaflight 4.6, with ``betaflight.txt`` of an exported policy.

    Raises:
        ValueError: actions command something else than body rates.
    """

    sizes = {**PID.sizes, "slow_rate": 3}
    _loop = FirmwareController

    def finish(self) -> None:
        """Work out the filter."""
        super().finish()
        self.slowing = 1.0 - math.exp(-2.0 * math.pi * RELAX_CUTOFF * self.dt)

    def physics_step(
        self, state: Sequence[Vector], setpoint: Any, plant: Any, controller: Any, wind: Vector | None
    ) -> Any:
        """As with any integral, but for when it rests."""
        *drone, integral, slow = state
        wanted = setpoint.body_rate
        told = Setpoint(setpoint.thrust, wanted + integral)
        after = Quadrotor.physics_step(self, drone, told, plant, controller, wind)
        slow = slow + (wanted - slow) * self.slowing
        relaxed = ((wanted - slow).abs() * (-1.0 / RELAX_THRESHOLD) + 1.0).clamp_min(0.0)
        integral = integral + controller.integral_rate * (wanted - drone[3]) * relaxed * self.dt
        return [*after, integral, slow]
