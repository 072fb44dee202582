"""Find the parameters of a drone from its flights."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from torchrl_quad.dynamics import MotorCommand, QuadrotorParams
from torchrl_quad.dynamics.presets import is_number
from torchrl_quad.errors import UserValueError
from torchrl_quad.identification.errors import TooLittleFlight, UnknownField
from torchrl_quad.identification.fitting import MAX_ITERATIONS
from torchrl_quad.identification.log import FlightLog, as_logs
from torchrl_quad.identification.parameters import FIELDS, Model, unknowns_of
from torchrl_quad.identification.prediction import PAST, as_params, carrying_speed
from torchrl_quad.identification.result import IdentificationResult
from torchrl_quad.identification.stages import Checkpoint, Fit, fingerprint, held_out
from torchrl_quad.identification.windows import cut
from torchrl_quad.options import Seed, checked

_BODY_STEP = 0.02  # [s]
_MOST_WINDOWS = 360  # more would cost more and tell little more, since neighbours overlap


@checked
def identify(
    log: FlightLog | Sequence[FlightLog],
    drone: str | Path | Mapping | QuadrotorParams = "crazyflie",
    known: Mapping[str, Any] | None = None,
    fields: str | Sequence[str] | None = None,
    *,
    past: Annotated[float, Field(ge=0, le=60)] = PAST,
    horizon: Annotated[float, Field(ge=0.1, le=60)] = 0.5,
    iterations: Annotated[int, Field(ge=1, le=100_000)] = MAX_ITERATIONS,
    draws: Annotated[int, Field(ge=0, le=100_000)] = 200,
    seed: Seed = 0,
    progress: bool = False,
    checkpoint: str | Path | None = None,
) -> IdentificationResult:
    """Fit a drone to the open-loop predictions of short windows, by gradient through its dynamics.

    Every window starts in a measured state and reads only motor commands, as in :func:`prediction_error`; what is
    minimised is how far its states at five times lie from the measured ones, robustly. All windows fly at once, and the
    derivative of each prediction in each unknown makes Gauss-Newton steps. A fifth of the flight is held out.

    Motion only tells ratios: thrust, drag and inertia by the mass. ``known={"mass": 0.03}`` makes numbers of them.
    Rotor speeds have no scale of their own either: k2 belongs to the speeds that the drone's ``motor_command`` gives.
    For a drone without one, speed is proportional to command times voltage, so that the prior's thrust carries it.

    Args:
        log: a flight, or several of the same drone.
        drone: where to start, and what is kept of it: its geometry, and what the flights do not tell.
        known: fields that are known by measurement, as ``mass`` [kg] from a scale. They are not fitted.
        fields: what to fit, of ``FIELDS``; None is everything.
        past: time before a window from which its constant disturbance follows [s].
        horizon: length of a window [s].
        iterations: at most, of each stage: one follows for every unknown that is dropped, and one for rotors with two
            time constants.
        draws: of the bootstrap over windows; 0 for none, else two or more.
        seed: of these draws; the rest is deterministic.
        progress: print a line for each step.
        checkpoint: a file that each step is written to, and from which a fit of the same flights and settings goes on.

    Raises:
        UnknownField: a field cannot be fitted.
        TooShort: no piece of a flight is long enough for a window.
        TooLittleFlight: there are too few windows for the unknowns.
        ValueError: the drone is wrong, or a known value.
    """
    logs = as_logs(log, "identify")
    if draws == 1:
        raise UserValueError("draws must be 0, for no bootstrap, or at least 2: one draw has no spread.")
    known = dict(known or {})
    delay = known.pop("command_delay", None)
    prior = as_params(drone)
    prior = as_params(prior.replace(**known)) if known else prior
    prior, motors = _with_motors(prior, logs, delay)
    wanted = [x for x in unknowns_of(fields) if x != "stream"]
    for name in (*known, *(["command_delay"] if delay is not None else [])):
        wanted = [x for x in wanted if x not in FIELDS.get(name, ())]
    lagging = any("angular_velocity" in x.onboard for x in logs)
    moves_streams = lagging and "stream" in unknowns_of(fields)
    if not wanted and not moves_streams:
        raise UnknownField("identify: nothing is left to fit, since all of the fields are known. Name more fields.")
    step = min(x.dt * max(1, round(0.01 / x.dt)) for x in logs)
    seconds = sum((b - a) * x.dt for x in logs for a, b in x.segments)
    every = max(0.5 * horizon, seconds / _MOST_WINDOWS)
    windows = cut(logs, horizon, past, every, max(1, round(_BODY_STEP / step)), motors.nominal_voltage)
    held = held_out(windows)
    kept = windows.select(torch.nonzero(~held).flatten())
    if len(kept) < 2 * len(wanted) + 4:
        raise TooLittleFlight(
            f"identify: {len(kept)} windows of {horizon:g} s are too few for {len(wanted)} unknowns. Give more "
            "flights, or fewer fields."
        )
    fit = Fit(Model(prior, motors, ()), kept, logs, moves_streams, progress, iterations)
    fit.file = Checkpoint(checkpoint, fingerprint(logs, prior, motors, wanted, past, horizon))
    state, dropped, two = fit.run(wanted)
    return fit.result(
        state,
        dropped,
        two,
        windows.select(torch.nonzero(held).flatten()),
        has_mass="mass" in known,
        fields=fields,
        past=past,
        horizon=horizon,
        draws=draws,
        seed=seed,
    )


def _with_motors(
    prior: QuadrotorParams, logs: Sequence[FlightLog], delay: float | None
) -> tuple[QuadrotorParams, MotorCommand]:
    """The drone with a map from motor commands to rotor speeds: its own, or one whose thrust carries it."""
    motors = prior.motor_command
    if motors is None:
        volts = [float(x.battery_voltage.mean()) for x in logs if x.battery_voltage is not None]
        nominal = float(np.mean(volts)) if volts else 1.0
        motors = MotorCommand(float(np.mean([carrying_speed(prior, x, nominal) for x in logs])), nominal)
    if delay is not None:
        motors = dataclasses.replace(motors, delay=float(delay) if is_number(delay) else delay)
    return dataclasses.replace(prior, motor_command=motors), motors
