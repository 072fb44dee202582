"""The drone of a contract in numpy, for many drones at once: its rotors, its drag, and two rate loops that fly it.

Arrays are (n, ...), one row for each drone. Nothing here imports torch.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.airframe import INTEGRAL_SHARE, Array, RateLoop, matrix
from torchrl_quad.deploy.contract import Contract
from torchrl_quad.rotations import cross, rotate, rotate_inverse


class Drone:
    """A drone from the fields of a contract's ``drone``: what :class:`~torchrl_quad.QuadrotorParams` documents.

    Attributes:
        allocation: (6, n), from rotor thrusts [N] to force and torque, see :func:`torchrl_quad.airframe.matrix`.
        mixer: (n, 4), the pseudo-inverse of its first four rows.
        thrust_limits: the least and the greatest thrust [N] that may be commanded of one rotor.
        motor_time_constant: of rotors that speed up, and of those that slow down (2) [s].
        hover_speed: of each rotor (n) [rad/s].
    """

    mass: float
    gravity: float
    yaw_torque_coefficient: float
    rotor_speed_min: float
    rotor_speed_max: float
    motor_time_constant: Array
    inertia: Array
    rotor_positions: Array
    rotor_spin: Array
    thrust_map: Array
    linear_drag: Array
    quadratic_drag: Array
    rate_gain: Array
    rate_damping: Array
    max_thrust_to_weight: float

    def __init__(self, fields: Contract) -> None:
        arrays = {name: np.array(value, float) for name, value in fields.items()}
        for name, value in arrays.items():
            setattr(self, name, value if value.ndim else float(value))
        self.drag_height = float(arrays.get("drag_height", 0.0))
        self.rotor_effectiveness = arrays.get("rotor_effectiveness", np.ones(len(self.rotor_spin)))
        self.motor_time_constant = np.broadcast_to(self.motor_time_constant, 2)
        k2, k1, k0 = self.thrust_map
        self.vertex_speed, self.vertex_thrust = -k1 / (2.0 * k2), k0 - k1 * k1 / (4.0 * k2)
        ends = np.array([self.rotor_speed_min, self.rotor_speed_max])
        self.least_root = 1e-6 * ((ends - self.vertex_speed) ** 2).max()
        self.allocation, four = matrix(fields), len(self.rotor_spin) == 4
        self.mixer = np.asarray((np.linalg.inv if four else np.linalg.pinv)(self.allocation[:4]), np.float64)
        least, greatest = self.thrust(ends)
        self.thrust_limits = max(least, 0.0), greatest
        self.weight = self.mass * self.gravity
        self.hover_speed = self.speed(self.mixer[:, 0] * self.weight)

    def __eq__(self, other: object) -> bool:
        """Whether all numbers are the same."""
        if not isinstance(other, Drone) or vars(self).keys() != vars(other).keys():
            return False
        return all(np.array_equal(x, vars(other)[name]) for name, x in vars(self).items())

    def thrust(self, speed: Array) -> Array:
        """Thrust [N] of rotors that turn at a speed [rad/s]."""
        return self.thrust_map[0] * (speed - self.vertex_speed) ** 2 + self.vertex_thrust

    def speed(self, thrust: Array) -> Array:
        """Speed [rad/s] at which rotors have a thrust [N]."""
        squared = (thrust - self.vertex_thrust) / self.thrust_map[0]
        return np.sign(self.thrust_map[0]) * np.sqrt(np.maximum(squared, self.least_root)) + self.vertex_speed

    def time_constant(self, change: Array) -> Array:
        """The time constant [s] of rotors whose speed is to change by so much [rad/s]."""
        rises, falls = self.motor_time_constant
        return np.where(change > 0.0, rises, falls)

    def rate_loop(self, dt: float) -> RateLoop:
        """The loop of :class:`ContractLoop` about hover, in steps of dt [s]."""
        return RateLoop(self.rate_gain, self.inertia, self.rate_damping, self.motor_time_constant, dt)

    def drag(self, quaternion: Array, velocity: Array) -> tuple[Array, Array]:
        """Force [N] and torque [N m] of the air, world frame, each (n, 3), at an attitude (n, 4) and a velocity (n, 3)
        [m/s]: the force acts ``drag_height`` above the centre of mass."""
        body = rotate_inverse(quaternion, velocity)
        force = -(self.linear_drag + self.quadratic_drag * np.abs(body)) * body
        torque = cross(np.array([0.0, 0.0, self.drag_height]), force)
        return rotate(quaternion, force), rotate(quaternion, torque)


class ContractLoop:
    """The rate loop of the contract, as the drone was trained with; it reads rotor speeds.

    torque = J K (desired - rate) - D (angular acceleration) + w x J w, where the angular acceleration follows from the
    rotor speeds. Where rotors saturate it gives up yaw first, then thrust, then roll and pitch. ``drone`` is nominal,
    ``dt`` the time between two calls [s].
    """

    def __init__(self, drone: Drone, dt: float) -> None:
        self.drone, self.dt = drone, dt
        self.gain = drone.inertia * drone.rate_gain
        self.share, self.per_share = drone.mixer[:, 0], 1.0 / drone.mixer[:, 0]
        least, greatest = drone.thrust_limits
        lowest, highest = (least * self.per_share).max(), (greatest * self.per_share).min()
        self.middle, self.half_span = 0.5 * (highest + lowest), 0.5 * (highest - lowest)
        self.yaw_share, self.tiny = drone.mixer[:, 3] * self.per_share, 1e-6 * drone.weight

    def __call__(self, thrust: Array, rates: Array, angular_velocity: Array, rotor_speed: Array) -> Array:
        """Rotor speeds (n, m) [rad/s] to command, for a collective thrust (n) [N] and body rates (n, 3) [rad/s], from
        the body rates (n, 3) [rad/s] and rotor speeds (n, m) [rad/s] of this moment."""
        drone = self.drone
        gyroscopic = cross(angular_velocity, drone.inertia * angular_velocity)
        believed = drone.thrust(rotor_speed) @ drone.allocation[1:4].T
        acceleration = (believed - gyroscopic) / drone.inertia
        torque = gyroscopic + self.gain * (rates - angular_velocity) - drone.rate_damping * acceleration
        return self.mix(thrust, torque)

    def mix(self, collective: Array, torque: Array) -> Array:
        """Rotor speeds (n, m) [rad/s] for a collective thrust (n) [N] and a torque (n, 3) [N m], within the limits."""
        drone, collective = self.drone, collective[:, None]
        thrust = np.concatenate((collective, torque), 1) @ drone.mixer.T
        limited = np.clip(thrust, *drone.thrust_limits)
        beyond = (limited != thrust).any(1)
        if beyond.any():
            limited[beyond] = self._within_limits(thrust[beyond], collective[beyond], torque[beyond, 2:])
        return drone.speed(limited)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Continue with only these drones (n); this loop has no memory."""

    def _within_limits(self, thrust: Array, collective: Array, yaw_torque: Array) -> Array:
        # In units of collective thrust, of which every rotor has its share.
        yaw = self.yaw_share * yaw_torque
        tilt = thrust * self.per_share - yaw - collective
        least, greatest = tilt.min(1, keepdims=True), tilt.max(1, keepdims=True)
        shrink = np.minimum(2.0 * self.half_span / np.maximum(greatest - least, self.tiny), 1.0)
        highest = self.middle + self.half_span - greatest * shrink
        lowest = self.middle - self.half_span - least * shrink
        level = np.maximum(np.minimum(collective, highest), lowest) + tilt * shrink
        used = (level - self.middle) * np.sign(self.yaw_share)
        used = np.where(yaw_torque > 0.0, used.max(1, keepdims=True), -used.min(1, keepdims=True))
        reach = np.maximum(np.abs(yaw_torque) * np.abs(self.yaw_share).max(), self.tiny)
        level = level + yaw * np.clip((self.half_span - used) / reach, 0.0, 1.0)
        return np.clip(level * self.share, *self.drone.thrust_limits)


class PIDLoop(ContractLoop):
    """A PID rate loop as in firmware: it only reads a gyro, and has no model of the drone.

    Its gains follow from the contract by a rule. P is the contract's gain times the inertia, and D the contract's
    damping, but of the measured body rate: with a perfect derivative the loop would be that of the contract in steps of
    dt. The derivative passes a low-pass filter of first order at 100 Hz. I is P times a tenth of the bandwidth of that
    loop in continuous time, held while a rotor saturates. Mixer and limits are those of the contract.
    """

    cutoff = 100.0  # [Hz], of the derivative
    integral_share = INTEGRAL_SHARE

    def __init__(self, drone: Drone, dt: float) -> None:
        super().__init__(drone, dt)
        self.integral_gain = self.gain * self.integral_share * drone.rate_loop(0.0).bandwidth
        self.smoothing = 1.0 - np.exp(-2.0 * np.pi * self.cutoff * dt)
        self.integral, self.derivative = np.zeros(3), np.zeros(3)
        self.before: Array | None = None

    def __call__(self, thrust: Array, rates: Array, angular_velocity: Array, rotor_speed: Array) -> Array:
        if self.before is None:
            self.before = angular_velocity
        error = rates - angular_velocity
        change = (angular_velocity - self.before) / self.dt
        self.derivative = self.derivative + self.smoothing * (change - self.derivative)
        self.before = angular_velocity
        torque = self.gain * error + self.integral - self.drone.rate_damping * self.derivative
        asked = np.concatenate((thrust[:, None], torque), 1) @ self.drone.mixer.T
        low, high = self.drone.thrust_limits
        fits = ((asked >= low) & (asked <= high)).all(1, keepdims=True)
        self.integral = self.integral + fits * self.integral_gain * error * self.dt
        return self.mix(thrust, torque)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        if self.before is not None:
            self.integral, self.derivative = self.integral[chosen], self.derivative[chosen]
            self.before = self.before[chosen]


class PDLoop(PIDLoop):
    """The same without the integral, which firmware holds back while the setpoint moves fast."""

    integral_share = 0.0


class Control:
    """Follows the commands of a contract by its ``output.law``: an outer loop, where there is one, and a rate loop."""

    def __init__(self, contract: Contract, loop: ContractLoop) -> None:
        self.output, self.loop = contract["output"], loop
        self.mode, gains = self.output["control"], self.output["gains"]
        self.gains = {name: np.array(value) for name, value in gains.items()}
        self.max_rate, self.most = np.array(self.output["body_rate"]["range"])[:, 1], self.output["thrust"]["range"][1]

    def __call__(self, command: Array, state: Mapping[str, Array]) -> Array:
        """Rotor speeds (n, m) [rad/s] to ask for, for commands (n, k) in a state of this moment (n, ...)."""
        if self.mode == "rotor_thrusts":
            return self.loop.drone.speed(np.clip(command, *self.loop.drone.thrust_limits))
        return self.loop(*self.rates(command, state), state["angular_velocity"], state["rotor_speed"])

    def rates(self, command: Array, state: Mapping[str, Array]) -> tuple[Array, Array]:
        """Collective thrusts (n) [N] and body rates (n, 3) [rad/s] for commands (n, k)."""
        if self.mode == "rates":
            return command[:, 0], command[:, 1:]
        up = rotate_inverse(state["quaternion"], np.array([0.0, 0.0, 1.0]))
        yaw, gravity = command[:, 3:], self.loop.drone.gravity
        if self.mode == "attitude":
            (roll, pitch), level = command[:, 1:3].T, np.cos(command[:, 2])
            wanted = np.stack((-np.sin(pitch), np.sin(roll) * level, np.cos(roll) * level), 1)
            return command[:, 0], np.c_[self._tilt(cross(wanted, up)[:, :2]) + yaw * up[:, :2], yaw * up[:, 2:]]
        error = self.gains["velocity_gain"] * (command[:, :3] - state["velocity"])
        climb = _limited(error[:, 2:], self.gains["max_climb"]) + gravity
        reach = climb * np.tan(self.gains["max_tilt"])
        sideways = error[:, :2] / np.sqrt(1.0 + (error[:, :2] ** 2).sum(1, keepdims=True) / reach**2)
        wanted = rotate_inverse(state["quaternion"], np.c_[sideways, climb])
        x, y = (wanted / np.linalg.norm(wanted, axis=1, keepdims=True))[:, :2].T
        thrust = np.clip(wanted[:, 2] * self.loop.drone.mass, 0.0, self.most)
        return thrust, np.c_[self._tilt(np.stack((-y, x), 1)), yaw * up[:, 2:]]

    def _tilt(self, error: Array) -> Array:
        return _limited(self.gains["tilt_gain"] * error, self.max_rate[:2])


def _limited(x: Array, limit: Array) -> Array:
    return x / np.sqrt(1.0 + (x / limit) ** 2)


LOOPS: dict[str, type[ContractLoop]] = {"contract": ContractLoop, "pid": PIDLoop, "pd": PDLoop}
