"""How well a drone's model predicts a flight, open-loop from its motor commands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams, load_drone, quaternion
from torchrl_quad.errors import UserValueError
from torchrl_quad.identification.errors import NoFlight
from torchrl_quad.identification.log import FlightLog, as_logs
from torchrl_quad.identification.windows import Plant, Trajectory, Windows, cut, rotation_vector, stream_delay
from torchrl_quad.options import checked

#: What is predicted, and the unit of its error.
ERRORS = {"position": "m", "velocity": "m/s", "attitude": "rad", "body_rate": "rad/s"}
CONSTANT_VELOCITY = "constant_velocity"
PAST = 0.5  # [s] before a prediction, from which its constant disturbance follows


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

    A prediction starts in a measured state, reads nothing but the motor commands from there on, and flies by our
    dynamics. Errors are root mean squares over all windows of the flight: of the distance in ``position`` [m] and
    ``velocity`` [m/s], of the angle in ``attitude`` [rad], of the length of the difference in ``body_rate`` [rad/s].

    Every model gets the same help from before the window, and none from within it. The speeds of its rotors follow from
    the commands before. What the drone moved beyond the model over the last ``past`` seconds, as a constant force and
    torque in the body frame, goes on: it stands for the drone's trim, a worn rotor and slow air. The delay of the
    on-board clock is found from the gyro and the attitude, without the drone.

    A drone with a ``motor_command`` (:class:`~torchrl_quad.dynamics.MotorCommand`) turns commands into rotor speeds by
    that. For one without, speed is proportional to command times battery voltage, by the factor that makes its mean
    thrust over this flight carry it; its delay is zero. So a drone that knows nothing of the motors starts with the
    right thrust.

    Args:
        log: a flight, or several, which count together.
        drone: a preset's name, the path of a YAML file, a mapping, parameters, or the result of a fit;
            ``"constant_velocity"`` keeps velocity and body rates as they are, as a reference.
        horizons: times after which errors are taken [s].
        past: time from which the constant force and torque follow [s]; 0 leaves them out.
        every: time between the starts of predictions [s].

    Raises:
        ValueError: a horizon is not positive, or the drone is wrong.
        TooShort: no piece of the flight is long enough.
    """
    logs, horizons = as_logs(log, "prediction_error"), [float(h) for h in horizons]
    windows, flown, seen = predict(logs, drone, max(horizons), past, every)
    steps = torch.tensor([max(1, round(h / windows.dt)) for h in horizons])
    errors = differences(Trajectory(*(x[:, steps] for x in flown)), Trajectory(*(x[:, steps] for x in seen)))
    rms = errors.square().sum(-1).mean(0).sqrt()
    return {name: dict(zip(horizons, rms[:, i].tolist(), strict=True)) for i, name in enumerate(ERRORS)}


@torch.no_grad()
def predict(
    logs: Sequence[FlightLog], drone: Any, horizon: float, past: float = PAST, every: float = 0.1
) -> tuple[Windows, Trajectory, Trajectory]:
    """The windows of flights, what the drone's model predicts in them, and what was measured, each (W, n, k)."""
    params = None if isinstance(drone, str) and drone == CONSTANT_VELOCITY else as_params(drone)
    voltage = params.motor_command.nominal_voltage if params is not None and params.motor_command is not None else 1.0
    windows = cut(logs, horizon, past, every, nominal_voltage=voltage)
    late = torch.tensor([stream_delay(log) for log in logs], dtype=torch.float64)[windows.log]
    seen = windows.measured(late, torch.arange(windows.future + 1))
    if params is None:
        return windows, _coast(seen.at(0), windows), seen
    plant = _plant(params, logs, windows, late)
    speed = windows.rotor_speed(plant)
    return windows, windows.fly(plant, seen.at(0), speed, windows.push(plant, speed)), seen


def differences(flown: Trajectory, seen: Trajectory) -> Tensor:
    """Predictions minus measurements (W, n, 4, 3), in the order of ``ERRORS``."""
    return torch.stack(
        (
            flown.position - seen.position,
            flown.velocity - seen.velocity,
            rotation_vector(flown.quaternion, seen.quaternion),
            flown.angular_velocity - seen.angular_velocity,
        ),
        -2,
    )


def as_params(drone: Any) -> QuadrotorParams:
    """A drone in float64: from a name, a path, a mapping, parameters, or the result of a fit."""
    drone = getattr(drone, "drone", drone)
    if not isinstance(drone, QuadrotorParams):
        drone = load_drone(drone, torch.float64)
    for name, value in drone.fields().items():
        if value.dim() != drone.dim(name):
            raise UserValueError(f"A flight is of one drone, and {name} has shape {tuple(value.shape)}, of several.")
    return drone.detach().to(dtype=torch.float64, device="cpu")


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


def _plant(params: QuadrotorParams, logs: Sequence[FlightLog], windows: Windows, late: Tensor) -> Plant:
    motors = params.motor_command
    if motors is None:
        slope = late.new_tensor([carrying_speed(params, log) for log in logs])[windows.log]
        return Plant(params, late.new_zeros(()), slope, late.new_zeros(()), late)
    zero, slope, delay = (late.new_tensor(x) for x in (motors.speed_at_zero, motors.speed_per_volt, motors.delay))
    return Plant(params, zero, slope, delay, late)


def _coast(start: Trajectory, windows: Windows) -> Trajectory:
    time = windows.dt * torch.arange(windows.future + 1, dtype=torch.float64).reshape(1, -1, 1)
    velocity, rate = (x[:, None].expand(-1, windows.future + 1, -1) for x in (start.velocity, start.angular_velocity))
    turn = quaternion.from_axis_angle(rate * time)
    attitude = quaternion.multiply(start.quaternion[:, None].expand(-1, windows.future + 1, -1), turn)
    return Trajectory(start.position[:, None] + velocity * time, velocity, attitude, rate)
