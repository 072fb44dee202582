"""Flights cut into short windows, all flown open-loop at once from their motor commands, by a drone's own dynamics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from torchrl_quad.airframe import quarters
from torchrl_quad.dynamics import MotorCommand, QuadrotorParams, load_drone, quaternion
from torchrl_quad.dynamics.rigid_body import RigidBodyState, Rotors, accelerations, rk4
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.identification.errors import NoFlight, TooShort
from torchrl_quad.identification.log import FlightLog
from torchrl_quad.identification.signals import Array, convolved
from torchrl_quad.options import checked

#: What is predicted, and the unit of its error.
ERRORS = {"position": "m", "velocity": "m/s", "attitude": "rad", "body_rate": "rad/s"}
CONSTANT_VELOCITY = "constant_velocity"
PAST = 0.5  # [s] before a prediction, from which its constant disturbance follows
SAMPLE = 0.01  # [s], aimed at: logs that are quicker are read with a whole number of their samples to one of ours
WARM_UP = 0.5  # [s] of commands, from which the rotors' speeds follow
MAX_DELAY = 0.2  # [s], of the on-board clock and of commands, each way


@checked
def prediction_error(
    log: FlightLog | Sequence[FlightLog],
    drone: str | Path | Mapping | QuadrotorParams | Any,
    horizons: Annotated[Sequence[Annotated[float, Field(ge=0.01, le=60)]], Field(min_length=1)] = (0.1, 0.25, 0.5),
    *,
    past: Annotated[float, Field(ge=0, le=60)] = PAST,
    every: Annotated[float, Field(gt=0, le=3600)] = 0.1,
) -> dict[str, dict[float, float]]:
    """The error of open-loop predictions: ``errors["position"][0.5]`` [m], after half a second.

    A prediction starts in a measured state and reads only the motor commands from there on. Errors are root mean
    squares over all windows of the flight: of the distance in ``position`` [m] and ``velocity`` [m/s], of the angle in
    ``attitude`` [rad], of the length of the difference in ``body_rate`` [rad/s].

    The speeds of the rotors follow from the commands before a window, and the delay of the on-board clock from the gyro
    and the attitude. What the drone moved beyond the model over the last ``past`` seconds continues, as a constant
    force and torque in the body frame: it stands for the drone's trim, a worn rotor and slow air.

    A drone with a ``motor_command`` (:class:`~torchrl_quad.dynamics.MotorCommand`) turns commands into rotor speeds by
    that. For one without, speed is proportional to command times battery voltage, by the factor that makes its mean
    thrust over this flight carry it; its delay is zero.

    Args:
        log: a flight, or several, which count together.
        drone: a preset's name, the path of a YAML file, a mapping, parameters, or the result of a fit;
            ``"constant_velocity"`` keeps velocity and body rates as they are, as a reference.
        horizons: times after which errors are taken [s].
        past: time from which the constant force and torque follow [s]; 0 leaves them out.
        every: time between the starts of predictions [s].

    Raises:
        TooShort: no piece of the flight is long enough.
        ValueError: the drone is wrong.
    """
    horizons = [float(h) for h in horizons]
    windows, flown, seen = predict(as_logs(log, "prediction_error"), drone, max(horizons), past, every)
    return rms_errors(windows, flown, seen, horizons)


@torch.no_grad()
def predict(
    logs: Sequence[FlightLog], drone: Any, horizon: float, past: float = PAST, every: float = 0.1
) -> tuple[Windows, RigidBodyState, RigidBodyState]:
    """The windows of flights, what the drone's model predicts in them, and what was measured, each (W, n, k)."""
    params = None if isinstance(drone, str) and drone == CONSTANT_VELOCITY else as_params(drone)
    motors = None if params is None else params.motor_command
    windows = cut(logs, horizon, past, every, nominal_voltage=1.0 if motors is None else motors.nominal_voltage)
    late = torch.tensor([stream_delay(log) for log in logs], dtype=torch.float64)[windows.log]
    seen = windows.measured(late, torch.arange(windows.future + 1))
    if params is None:
        return windows, _coast(states_at(seen, 0), windows), seen
    if motors is None:
        per_volt = late.new_tensor([carrying_speed(params, log) for log in logs])[windows.log]
        plant = Plant(params, late.new_zeros(()), per_volt, late.new_zeros(()), late)
    else:
        plant = plant_of(params, motors, late)
    speed = windows.rotor_speed(plant)
    return windows, windows.fly(plant, states_at(seen, 0), speed, windows.push(plant, speed)), seen


@torch.no_grad()
def trim(logs: Sequence[FlightLog], drone: QuadrotorParams, past: float = PAST) -> Push | None:
    """What moves the flights beyond a drone with a ``motor_command``, on average over windows of ``past`` [s], (3)
    each: as a share of its weight, and [rad/s2]; None where the flights are too short for a window."""
    motors = drone.motor_command or MotorCommand(1.0, 1.0)
    try:
        windows = cut(logs, 0.1, past or PAST, 0.1, nominal_voltage=motors.nominal_voltage)
    except TooShort:
        return None
    plant = plant_of(drone, motors, torch.tensor([stream_delay(log) for log in logs], dtype=torch.float64)[windows.log])
    force, torque = windows.push(plant, windows.rotor_speed(plant))
    return Push(force.mean(0) / drone.gravity, torque.mean(0))


def as_logs(log: FlightLog | Sequence[FlightLog], whose: str) -> list[FlightLog]:
    """One flight or several, as a list."""
    logs = [log] if isinstance(log, FlightLog) else list(log) if isinstance(log, Sequence) else [log]
    for one in logs:
        if not isinstance(one, FlightLog):
            raise UserTypeError(
                f"{whose}: log must be a flight as read_log(path) gives it, or a list of them; got {shown(one)}."
            )
        if not one.segments:
            raise TooShort(f"{whose}: {one.name} has no piece in flight.")
    if not logs:
        raise UserValueError(f"{whose} needs at least one flight: read_log(path) gives it.")
    return logs


def rms_errors(
    windows: Windows, flown: RigidBodyState, seen: RigidBodyState, horizons: Sequence[float]
) -> dict[str, dict[float, float]]:
    """Root mean squares over windows, by quantity and horizon [s]."""
    steps = torch.tensor([max(1, round(h / windows.dt)) for h in horizons])
    rms = differences(states_at(flown, steps), states_at(seen, steps)).square().sum(-1).mean(0).sqrt()
    return {name: dict(zip(horizons, rms[:, i].tolist(), strict=True)) for i, name in enumerate(ERRORS)}


def differences(flown: RigidBodyState, seen: RigidBodyState) -> Tensor:
    """Predictions minus measurements (W, n, 4, 3), in the order of ``ERRORS``."""
    position, _, velocity, rate = (x - y for x, y in zip(flown, seen, strict=True))
    return torch.stack((position, velocity, rotation_vector(flown.quaternion, seen.quaternion), rate), -2)


def as_params(drone: Any) -> QuadrotorParams:
    """A drone in float64: from a name, a path, a mapping, parameters, or the result of a fit."""
    drone = getattr(drone, "drone", drone)
    if not isinstance(drone, QuadrotorParams):
        drone = load_drone(drone, torch.float64)
    for name, value in drone.fields().items():
        if value.dim() != drone.dim(name):
            raise UserValueError(f"A flight is of one drone, and {name} has shape {tuple(value.shape)}, of several.")
    log_columns(drone)
    return drone.detach().to(dtype=torch.float64, device="cpu")


def log_columns(drone: QuadrotorParams) -> list[int]:
    """For each rotor, in whatever order the drone lists them, the column of its motor in a log: by its place."""
    if found := quarters(drone.rotor_positions.tolist()):  # plain numbers, also under jacfwd
        return found
    raise UserValueError(
        "Flight logs hold the commands of four motors of an X: front left, back left, back right, front right. This "
        f"drone has rotors at {drone.rotor_positions.tolist()} m. Give one with a rotor in each of the four quarters."
    )


def carrying_speed(params: QuadrotorParams, log: FlightLog, nominal_voltage: float = 1.0) -> float:
    """The rotor speed per volt of command [rad/s] with which the drone's mean thrust carries it through a flight."""
    voltage = np.full(len(log.time), nominal_voltage) if log.battery_voltage is None else log.battery_voltage
    volts = np.concatenate([(log.motor_command * voltage[:, None])[a:b] for a, b in log.segments])
    force = np.gradient(log.velocity, log.dt, axis=0) + np.array([0.0, 0.0, float(params.gravity)])
    seen = quaternion.rotate_inverse(torch.from_numpy(log.quaternion), torch.from_numpy(force))
    needed = float(params.mass) * float(torch.cat([seen[a:b, 2] for a, b in log.segments]).mean())
    k2, k1, k0 = params.thrust_map.tolist()
    if not volts.any():
        raise NoFlight(f"{log.name}: its motor commands are zero in flight. Name the right columns when it is read.")
    square, line, rest = k2 * np.square(volts).sum(1).mean(), k1 * volts.sum(1).mean(), 4.0 * k0 - needed
    return float((-line + math.sqrt(max(line * line - 4.0 * square * rest, 0.0))) / (2.0 * square))


def _coast(start: RigidBodyState, windows: Windows) -> RigidBodyState:
    time = windows.dt * torch.arange(windows.future + 1, dtype=torch.float64).reshape(1, -1, 1)
    attitude, velocity, rate = (x[:, None].expand(-1, windows.future + 1, -1) for x in start[1:])
    turn = quaternion.from_axis_angle(rate * time)
    position = start.position[:, None] + velocity * time
    return RigidBodyState(position, quaternion.multiply(attitude, turn), velocity, rate)


class Plant(NamedTuple):
    """What the prediction of windows needs to know of the drone, and of each window's log."""

    params: QuadrotorParams  #: or RawParams, float64
    speed_at_zero: Tensor  #: () or (W) [rad/s]
    speed_per_volt: Tensor  #: () or (W) [rad/s per V of command times voltage]
    delay: Tensor  #: () [s], from the logged command to the motor
    stream_delay: Tensor  #: (W) [s], by which the on-board clock is late


def plant_of(params: QuadrotorParams, motors: MotorCommand, stream_delay: Tensor) -> Plant:
    """A drone whose motors are known."""
    zero, per_volt, delay = params.mass.new_tensor([motors.speed_at_zero, motors.speed_per_volt, motors.delay])
    return Plant(params, zero, per_volt, delay, stream_delay)


class Push(NamedTuple):
    """A constant disturbance on top of the model, (W, 3), body frame."""

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

    def measured(self, stream_delay: Tensor, samples: Tensor) -> RigidBodyState:
        """The measured states (W, n, k) at samples (n) from the starts."""
        index = self.start[:, None] + samples
        position, velocity, attitude = self.motion[self.log[:, None], index].split((3, 3, 4), -1)
        late = stream_delay * self.lagging[self.log] / self.dt
        return RigidBodyState(position, attitude, velocity, self._between(self.rate, index + late[:, None]))

    def rotor_speed(self, plant: Plant) -> Tensor:
        """Rotor speeds (W, past + future + 1, 4) [rad/s], from the commands."""
        warm = round(WARM_UP / self.dt)
        steps = torch.arange(-warm - self.past, self.future)
        late = (plant.stream_delay - plant.delay) / self.dt
        command = self._between(self.command, self.start[:, None] + steps + 0.5 + late[:, None])
        slope, zero = (x.reshape(-1, 1, 1) for x in (plant.speed_per_volt, plant.speed_at_zero))
        wanted = (zero + slope * command[..., log_columns(plant.params)]).clamp_min(0.0).unbind(1)
        rotors, speed, speeds = Rotors(plant.params), wanted[0], []
        for k, target in enumerate(wanted):
            if k >= warm:
                speeds.append(speed)
            speed = rotors.follow(speed, target, self.dt)
        return torch.stack([*speeds, speed], 1)

    def push(self, plant: Plant, speed: Tensor, wind: Callable[[RigidBodyState], Tensor] | None = None) -> Push:
        """What the drone moved beyond the model, on average, in the samples before the windows, in still air or in the
        ``wind`` [m/s], world frame, that is a function of the state."""
        if not self.past:
            zero = self.motion.new_zeros(len(self), 3)
            return Push(zero, zero)
        seen = self.measured(plant.stream_delay, torch.arange(-self.past, 1))
        middle = RigidBodyState(*(0.5 * (x[:, 1:] + x[:, :-1]) for x in seen))
        middle = middle._replace(quaternion=quaternion.normalize(middle.quaternion))
        turning = 0.5 * (speed[:, 1 : self.past + 1] + speed[:, : self.past])
        air = None if wind is None else wind(middle)
        linear, angular = accelerations(middle, Rotors(plant.params).wrench(turning), plant.params, air)
        sped = seen.velocity.diff(dim=1) / self.dt - linear
        spun = seen.angular_velocity.diff(dim=1) / self.dt - angular
        return Push(quaternion.rotate_inverse(middle.quaternion, sped).mean(1), spun.mean(1))

    def turning(self, stream_delay: Tensor, span: int) -> Tensor:
        """How much further the attitude turned in pieces of ``span`` samples than the gyro says, (W, pieces, 3) [rad]:
        it depends on the delay between them, and not on the drone."""
        count = self.future // span
        seen = self.measured(stream_delay, torch.arange(0, count * span + 1))
        attitude = seen.quaternion[:, ::span]
        rate = 0.5 * (seen.angular_velocity[:, 1:] + seen.angular_velocity[:, :-1])
        gyro = rate.unflatten(1, (count, span)).sum(2) * self.dt
        return rotation_vector(attitude[:, 1:], attitude[:, :-1]) - gyro

    def fly(
        self,
        plant: Plant,
        start: RigidBodyState,
        speed: Tensor,
        push: Push,
        more: Callable[[RigidBodyState, Tensor], Push] | None = None,
    ) -> RigidBodyState:
        """Open-loop predictions, from states at the starts, at every step of the body: (W, future / stride + 1, k).

        ``more(state, wrench)`` adds to the push in every state (``benchmarks/real_flights.py`` lets a network do so).
        """
        rotors, steps = Rotors(plant.params), self.future // self.stride
        wrench = rotors.wrench(0.5 * (speed[:, self.past + 1 :] + speed[:, self.past : -1]))
        wrench = wrench[:, : steps * self.stride].unflatten(1, (steps, self.stride)).mean(2).unbind(1)
        state = start
        states = [state]
        for k in range(steps):

            def moving(s: RigidBodyState, wrench: Tensor = wrench[k]) -> tuple[Tensor, Tensor]:
                linear, angular = accelerations(s, wrench, plant.params)
                force, torque = push
                if more is not None:
                    force, torque = (x + y for x, y in zip(push, more(s, wrench), strict=True))
                return linear + quaternion.rotate(s.quaternion, force), angular + torque

            state = rk4(state, moving, self.dt * self.stride)
            states.append(state)
        return RigidBodyState(*(torch.stack(x, 1) for x in zip(*states, strict=True)))

    def _between(self, series: Tensor, index: Tensor) -> Tensor:
        """A series (L, T, k) at fractional samples (W, n): cubic (Catmull and Rom), and so differentiable in time.
        A straight line between samples would lose two per cent of what moves five times a second."""
        below = index.detach().floor().clamp(1, series.shape[1] - 3)
        s = (index - below).unsqueeze(-1)
        below, log = below.long(), self.log[:, None]
        a, b, c, d = (series[log, below + shift] for shift in (-1, 0, 1, 2))
        return b + 0.5 * s * (c - a + s * (2.0 * a - 5.0 * b + 4.0 * c - d + s * (3.0 * (b - c) + d - a)))


def states_at(states: RigidBodyState, steps: int | Tensor) -> RigidBodyState:
    """States (W, n, k) at one step, (W, k), or at several."""
    return RigidBodyState(*(x[:, steps] for x in states))


def cut(
    logs: Sequence[FlightLog], future: float, past: float, every: float, step: float = 0.0, nominal_voltage: float = 1.0
) -> Windows:
    """Windows of length ``future``, one ``every`` so often [s]; each lies in one piece of flight, with its ``past`` [s]
    and room for delays. The body moves in steps of about ``step`` [s], of a sample at least. ``nominal_voltage`` [V] is
    of a battery that is not in the log."""
    dt = min(log.dt * max(1, round(SAMPLE / log.dt)) for log in logs)
    columns, starts, owners = [], [], []
    n_past, n_future = round(past / dt), round(future / dt)
    # The fit may find a delay that is longer than the first guess, by this much.
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
                f"with {past + WARM_UP:g} s before it, and room for delays. Give a longer flight, or leave it out."
            )
    length = max(len(c) for c in columns)
    stacked = torch.from_numpy(np.stack([np.pad(c, ((0, length - len(c)), (0, 0)), "edge") for c in columns]))
    motion, rate, command = stacked.split((10, 3, 4), -1)
    lagging = torch.tensor([float("angular_velocity" in log.onboard) for log in logs], dtype=torch.float64)
    log, start = torch.from_numpy(np.concatenate(owners)), torch.from_numpy(np.concatenate(starts))
    return Windows(motion, rate, command, lagging, log, start, dt, n_past, n_future, max(1, round(step / dt)))


def stream_delay(log: FlightLog) -> float:
    """The time [s] by which the on-board clock is late: where the integral of the gyro over a tenth of a second fits
    best how far the attitude turned; 0 for a single clock."""
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
    misfits = (turned[index] - gyro[index + late] for late in range(-reach, reach + 1))
    costs = np.array([np.square(np.clip(misfit, -0.3, 0.3)).sum() for misfit in misfits])
    best = int(np.clip(costs.argmin(), 1, len(costs) - 2))
    left, low, right = costs[best - 1 : best + 2]
    curvature = left - 2.0 * low + right
    shift = 0.5 * (left - right) / curvature if curvature > 0 else 0.0  # the bottom of the parabola through three costs
    return float((best - reach + np.clip(shift, -0.5, 0.5)) * log.dt)


def rotation_vector(to: Tensor, of: Tensor) -> Tensor:
    """The rotation (*, 3) [rad] that turns the attitude ``of`` into ``to``, in the body frame of ``of``."""
    conjugate = torch.cat((of[..., :1], -of[..., 1:]), -1)
    turn = quaternion.multiply(conjugate, to)
    turn = turn * torch.where(turn[..., :1] < 0, -1.0, 1.0)
    sine = (turn[..., 1:].square().sum(-1, keepdim=True) + 1e-24).sqrt()  # above zero, for its derivative
    return turn[..., 1:] * (2.0 * torch.atan2(sine, turn[..., :1]) / sine)


def _columns(log: FlightLog, dt: float, nominal_voltage: float) -> Array:
    """Position, velocity, attitude, rates and volts (T, 17), a sample every dt [s]: means of quicker samples."""
    voltage = np.full(len(log.time), nominal_voltage)
    if log.battery_voltage is not None:  # held between samples of a slower stream: straight lines are not late
        fresh = np.flatnonzero(np.diff(log.battery_voltage, prepend=np.nan) != 0)
        voltage = np.interp(np.arange(len(log.time)), fresh, log.battery_voltage[fresh])
    volts = log.motor_command * voltage[:, None]
    columns = np.concatenate((log.position, log.velocity, log.quaternion, log.angular_velocity, volts), 1)
    n = round(dt / log.dt)
    if n > 1:  # the mean over the samples about each of ours keeps what a command did between them
        kernel = np.ones(n) if n % 2 else np.concatenate(([0.5], np.ones(n - 1), [0.5]))
        padded = np.pad(columns, ((len(kernel) // 2, len(kernel) // 2), (0, 0)), "edge")
        columns[:, 10:] = convolved(padded, kernel / kernel.sum())[:, 10:]
        columns = columns[::n]
    if not math.isclose(n * log.dt, dt):
        time = np.arange(0.0, log.time[-1], dt)
        columns = np.stack([np.interp(time, log.time, x) for x in columns.T], 1)
    columns[:, 6:10] /= np.linalg.norm(columns[:, 6:10], axis=1, keepdims=True)
    return columns
