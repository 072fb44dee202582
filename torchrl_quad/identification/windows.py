"""Flights cut into short windows, all flown open-loop at once by the drone's own dynamics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.rigid_body import RigidBodyState, accelerations, rk4
from torchrl_quad.dynamics.rotors import Rotors
from torchrl_quad.identification.errors import TooShort
from torchrl_quad.identification.log import FlightLog

SAMPLE = 0.01  # [s], aimed at: logs that are quicker are read with a whole number of their samples to one of ours
WARM_UP = 0.5  # [s] of commands, from which the rotors' speeds follow
MAX_DELAY = 0.2  # [s], of the on-board clock and of commands, each way


class Plant(NamedTuple):
    """What the prediction of windows needs to know of the drone, and of each window's log."""

    params: Any  #: QuadrotorParams or RawParams, float64
    speed_at_zero: Tensor  #: () or (W) [rad/s]
    speed_per_volt: Tensor  #: () or (W) [rad/s per V of command times voltage]
    delay: Tensor  #: () [s], from the logged command to the motor
    stream_delay: Tensor  #: (W) [s], by which the on-board clock is late


class Trajectory(NamedTuple):
    """States of windows: (W, n, k), or (W, k) at one time."""

    position: Tensor
    velocity: Tensor
    quaternion: Tensor
    angular_velocity: Tensor

    def at(self, step: int) -> Trajectory:
        """The states at one step, (W, k)."""
        return Trajectory(*(x[:, step] for x in self))


class Push(NamedTuple):
    """A constant disturbance beside the model, (W, 3), body frame."""

    force: Tensor  #: [m/s2], specific force
    torque: Tensor  #: [rad/s2], angular acceleration


@dataclasses.dataclass(frozen=True)
class Windows:
    """Windows of several logs: the logs as padded tensors (L, T, k), and W pairs of log and first sample."""

    motion: Tensor  #: (L, T, 10): position, velocity, quaternion
    rate: Tensor  #: (L, T, 3) [rad/s]
    command: Tensor  #: (L, T, 4) [V], motor command times battery voltage
    lagging: Tensor  #: (L), 1 where the body rates are on the on-board clock, as commands are; else 0
    log: Tensor  #: (W)
    start: Tensor  #: (W)
    dt: float  #: [s], of a sample
    past: int  #: samples before a window, from which its disturbance follows
    future: int  #: samples in a window
    stride: int  #: samples in a step of the body

    def __len__(self) -> int:
        return len(self.start)

    def select(self, index: Tensor) -> Windows:
        """Some of the windows."""
        return dataclasses.replace(self, log=self.log[index], start=self.start[index])

    def measured(self, stream_delay: Tensor, samples: Tensor) -> Trajectory:
        """The measured states at samples (n) from the starts."""
        index = self.start[:, None] + samples
        motion = self.motion[self.log[:, None], index]
        late = stream_delay * self.lagging[self.log] / self.dt
        return Trajectory(*motion.split((3, 3, 4), -1), self._between(self.rate, index + late[:, None]))

    def rotor_speed(self, plant: Plant) -> Tensor:
        """Rotor speeds (W, past + future + 1, 4) [rad/s], from the commands alone."""
        warm = round(WARM_UP / self.dt)
        steps = torch.arange(-warm - self.past, self.future)
        late = (plant.stream_delay - plant.delay) / self.dt
        command = self._between(self.command, self.start[:, None] + steps + 0.5 + late[:, None])
        slope, zero = (x.reshape(-1, 1, 1) for x in (plant.speed_per_volt, plant.speed_at_zero))
        wanted = (zero + slope * command).clamp_min(0.0).unbind(1)
        rotors, speed, speeds = Rotors(plant.params), wanted[0], []
        for k, target in enumerate(wanted):
            if k >= warm:
                speeds.append(speed)
            speed = rotors.follow(speed, target, self.dt)
        return torch.stack([*speeds, speed], 1)

    def push(self, plant: Plant, speed: Tensor) -> Push:
        """The disturbance that the samples before the windows show: what they moved beyond the model, on average.

        Nothing that happens within a window enters.
        """
        if not self.past:
            zero = self.motion.new_zeros(len(self), 3)
            return Push(zero, zero)
        seen = self.measured(plant.stream_delay, torch.arange(-self.past, 1))
        middle = RigidBodyState(*(0.5 * (x[:, 1:] + x[:, :-1]) for x in _body(seen)))
        middle = middle._replace(quaternion=quaternion.normalize(middle.quaternion))
        turning = 0.5 * (speed[:, 1 : self.past + 1] + speed[:, : self.past])
        linear, angular = accelerations(middle, Rotors(plant.params).wrench(turning), plant.params)
        sped = seen.velocity.diff(dim=1) / self.dt - linear
        spun = seen.angular_velocity.diff(dim=1) / self.dt - angular
        return Push(quaternion.rotate_inverse(middle.quaternion, sped).mean(1), spun.mean(1))

    def turning(self, stream_delay: Tensor, span: int) -> Tensor:
        """How much further the attitude turned in pieces of ``span`` samples than the gyro says, (W, pieces, 3) [rad].

        Only the delay between them matters to it, not the drone.
        """
        count = self.future // span
        seen = self.measured(stream_delay, torch.arange(0, count * span + 1))
        attitude = seen.quaternion[:, ::span]
        rate = 0.5 * (seen.angular_velocity[:, 1:] + seen.angular_velocity[:, :-1])
        gyro = rate.unflatten(1, (count, span)).sum(2) * self.dt
        return rotation_vector(attitude[:, 1:], attitude[:, :-1]) - gyro

    def fly(
        self,
        plant: Plant,
        start: Trajectory,
        speed: Tensor,
        push: Push,
        beside: Callable[[RigidBodyState, Tensor], Push] | None = None,
    ) -> Trajectory:
        """Open-loop predictions, from states at the starts, at every step of the body: (W, future / stride + 1, k).

        ``beside(state, wrench)`` adds to the push in every state (``benchmarks/real_flights.py`` lets a network do so).
        """
        rotors, steps = Rotors(plant.params), self.future // self.stride
        wrench = rotors.wrench(0.5 * (speed[:, self.past + 1 :] + speed[:, self.past : -1]))
        wrench = wrench[:, : steps * self.stride].unflatten(1, (steps, self.stride)).mean(2).unbind(1)
        state = _body(start)
        states = [state]
        for k in range(steps):

            def moving(s: RigidBodyState, wrench: Tensor = wrench[k]) -> tuple[Tensor, Tensor]:
                linear, angular = accelerations(s, wrench, plant.params)
                force, torque = push
                if beside is not None:
                    force, torque = (x + more for x, more in zip(push, beside(s, wrench), strict=True))
                return linear + quaternion.rotate(s.quaternion, force), angular + torque

            state = rk4(state, moving, self.dt * self.stride)
            states.append(state)
        flown = RigidBodyState(*(torch.stack(x, 1) for x in zip(*states, strict=True)))
        return Trajectory(flown.position, flown.velocity, flown.quaternion, flown.angular_velocity)

    def _between(self, series: Tensor, index: Tensor) -> Tensor:
        """A series (L, T, k) at fractional samples (W, n): cubic (Catmull and Rom), and so differentiable in time.

        A straight line between samples would lose two per cent of what moves five times a second.
        """
        below = index.detach().floor().clamp(1, series.shape[1] - 3)
        s = (index - below).unsqueeze(-1)
        below, log = below.long(), self.log[:, None]
        a, b, c, d = (series[log, below + shift] for shift in (-1, 0, 1, 2))
        return b + 0.5 * s * (c - a + s * (2.0 * a - 5.0 * b + 4.0 * c - d + s * (3.0 * (b - c) + d - a)))


def cut(
    logs: Sequence[FlightLog], future: float, past: float, every: float, stride: int = 1, nominal_voltage: float = 1.0
) -> Windows:
    """Windows of all logs, ``every`` so many seconds; each lies in one piece of flight, with its past and its delays.

    Args:
        logs: the flights.
        future: length of a window [s].
        past: time before a window from which its disturbance follows [s].
        every: time between the starts of windows [s].
        stride: samples in a step of the body.
        nominal_voltage: of a battery whose voltage is not in the log [V].

    Raises:
        TooShort: no piece of a flight is long enough for one window.
    """
    dt = min(log.dt * max(1, round(SAMPLE / log.dt)) for log in logs)
    columns, starts, owners = [], [], []
    n_past, n_future = round(past / dt), round(future / dt)
    # A delay may be found to be longer than it is thought to be, by this much.
    margin = math.ceil((WARM_UP + MAX_DELAY) / dt), math.ceil(MAX_DELAY / dt)
    for k, log in enumerate(logs):
        columns.append(_columns(log, dt, nominal_voltage))
        found = 0
        for first, last in log.segments:
            first, last = math.ceil(first * log.dt / dt), math.floor((last - 1) * log.dt / dt)
            own = np.arange(first + n_past + margin[0], last - n_future - margin[1] + 1, max(1, round(every / dt)))
            starts.append(own)
            owners.append(np.full(len(own), k))
            found += len(own)
        if not found:
            needed = past + future + WARM_UP + 2 * MAX_DELAY
            raise TooShort(
                f"{log.name}: no piece of the flight is {needed:.2f} s long, which a prediction of {future:g} s needs: "
                f"with {past + WARM_UP:g} s before it, and room for delays. Give a longer flight, or shorter horizons."
            )
    length = max(len(c) for c in columns)
    stacked = torch.from_numpy(np.stack([np.pad(c, ((0, length - len(c)), (0, 0)), "edge") for c in columns]))
    motion, rate, command = stacked.split((10, 3, 4), -1)
    lagging = torch.tensor([float("angular_velocity" in log.onboard) for log in logs], dtype=torch.float64)
    log, start = torch.from_numpy(np.concatenate(owners)), torch.from_numpy(np.concatenate(starts))
    return Windows(motion, rate, command, lagging, log, start, dt, n_past, n_future, stride)


def stream_delay(log: FlightLog) -> float:
    """The time [s] by which the on-board clock is late: where the gyro fits the attitude best; 0 for a single clock.

    It compares how far the attitude turned in a tenth of a second with the integral of the gyro over it, and knows
    nothing of the drone.
    """
    if "angular_velocity" not in log.onboard:
        return 0.0
    span = max(2, round(0.1 / log.dt))
    integral = np.concatenate((np.zeros((1, 3)), np.cumsum(log.angular_velocity, 0)))[:-1] * log.dt
    integral += 0.5 * log.dt * (log.angular_velocity - log.angular_velocity[0])
    attitude = torch.from_numpy(log.quaternion)
    turned = rotation_vector(attitude[span:], attitude[:-span]).numpy()
    reach = math.ceil(MAX_DELAY / log.dt)
    index = np.concatenate([np.arange(a + reach, b - span - reach) for a, b in log.segments])
    if len(index) < 10:
        return 0.0
    gyro = integral[span:] - integral[:-span]

    def misfit(late: int) -> float:
        return float(np.square(np.clip(turned[index] - gyro[index + late], -0.3, 0.3)).sum())

    costs = np.array([misfit(late) for late in range(-reach, reach + 1)])
    best = int(np.clip(costs.argmin(), 1, len(costs) - 2))
    left, low, right = costs[best - 1 : best + 2]
    curvature = left - 2.0 * low + right
    shift = 0.5 * (left - right) / curvature if curvature > 0 else 0.0
    return float((best - reach + np.clip(shift, -0.5, 0.5)) * log.dt)


def rotation_vector(to: Tensor, of: Tensor) -> Tensor:
    """The rotation (*, 3) [rad] that turns the attitude ``of`` into ``to``, in the body frame of ``of``."""
    conjugate = torch.cat((of[..., :1], -of[..., 1:]), -1)
    turn = quaternion.multiply(conjugate, to)
    turn = turn * torch.where(turn[..., :1] < 0, -1.0, 1.0)
    sine = (turn[..., 1:].square().sum(-1, keepdim=True) + 1e-24).sqrt()
    return turn[..., 1:] * (2.0 * torch.atan2(sine, turn[..., :1]) / sine)


def unheld(series: np.ndarray) -> np.ndarray:
    """A series (T) that was held between samples of a slower one, drawn straight between them: no longer late."""
    fresh = np.flatnonzero(np.diff(series, prepend=np.nan) != 0)
    return np.interp(np.arange(len(series)), fresh, series[fresh])


def _columns(log: FlightLog, dt: float, nominal_voltage: float) -> np.ndarray:
    """Position, velocity, attitude, rates and volts (T, 17), a sample every dt [s]: means of quicker samples."""
    voltage = np.full(len(log.time), nominal_voltage) if log.battery_voltage is None else unheld(log.battery_voltage)
    volts = log.motor_command * voltage[:, None]
    columns = np.concatenate((log.position, log.velocity, log.quaternion, log.angular_velocity, volts), 1)
    n = round(dt / log.dt)
    if n > 1:  # the mean over the samples about each of ours keeps what a command did between them
        kernel = np.ones(n) if n % 2 else np.concatenate(([0.5], np.ones(n - 1), [0.5]))
        padded = np.pad(columns, ((len(kernel) // 2, len(kernel) // 2), (0, 0)), "edge")
        smooth = np.stack([np.convolve(x, kernel / kernel.sum(), "valid") for x in padded.T], 1)
        columns[:, 10:] = smooth[:, 10:]
        columns = columns[::n]
    if not math.isclose(n * log.dt, dt):
        time = np.arange(0.0, log.time[-1], dt)
        columns = np.stack([np.interp(time, log.time, x) for x in columns.T], 1)
    columns[:, 6:10] /= np.linalg.norm(columns[:, 6:10], axis=1, keepdims=True)
    return columns


def _body(state: Trajectory) -> RigidBodyState:
    return RigidBodyState(state.position, state.quaternion, state.velocity, state.angular_velocity)
