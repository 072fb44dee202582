"""Find the parameters of a drone from its flights, in stages."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from torchrl_quad.dynamics import MotorCommand, QuadrotorParams
from torchrl_quad.dynamics.rigid_body import RigidBodyState
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.files import replacing
from torchrl_quad.identification import prediction
from torchrl_quad.identification.errors import TooShort
from torchrl_quad.identification.fitting import MAX_ITERATIONS, Problem, State, bootstrap, covariance, minimise
from torchrl_quad.identification.log import FlightLog
from torchrl_quad.identification.motor_checks import turning_fits
from torchrl_quad.identification.parameters import FIELDS, NEED_MASS, UNKNOWNS, Estimate, Model, report, unknowns_of
from torchrl_quad.identification.prediction import CONSTANT_VELOCITY, PAST, Windows
from torchrl_quad.identification.result import IdentificationResult
from torchrl_quad.options import Seed, checked

_BODY_STEP = 0.02  # [s]
_MOST_WINDOWS = 360  # more would cost more and tell little more, since neighbours overlap
_HORIZONS = (0.1, 0.25, 0.5)  # [s], of the errors that are reported
_BLOCK = 2.0  # [s] of flight that are held out together
_EVERY_BLOCK = 5  # of which the last is held out
_TENSORS = ("x", "streams")  # of a state
_CONTRARY = 0.15  # correlation
_MOST_TRIM = 0.2  # of the weight
_UNJUDGED = "it cannot be judged, as the drone has no motor_command whose thrust could contradict it: weigh it"
_MASS = "without a known mass, motion only tells its ratio to the mass, which `ratios` gives"


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
    """Fit a drone to open-loop predictions of short windows as in :func:`prediction_error`, by gradient through its
    dynamics: Gauss-Newton steps bring the states at five times of each window nearer to the measured ones, robustly. A
    fifth of the flight is held out.

    Motion only tells ratios: thrust, drag and inertia by the mass. ``known={"mass": 0.03}`` makes numbers of them.
    Rotor speeds have no scale of their own either: k2 belongs to the speeds that the drone's ``motor_command`` gives.

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
        checkpoint: a file that gets each step, and from which a fit of the same flights and settings continues.

    Raises:
        TooShort: no piece of a flight is long enough for a window, or there are too few windows for the unknowns.
        ValueError: a field cannot be fitted; the rotors would turn the drone another way than in the flights; or the
            fit leaves a force of a fifth of the weight or more, so that the mass or the thrust is wrong.
    """
    logs = prediction.as_logs(log, "identify")
    if draws == 1:
        raise UserValueError("draws must be 0, for no bootstrap, or at least 2: one draw has no spread.")
    given = dict(known or {})
    delay = given.pop("command_delay", None)
    prior = prediction.as_params(prediction.as_params(drone).replace(**given))
    _check_turning(prior, logs)
    unjudged = {"mass": _UNJUDGED} if prior.motor_command is None and "mass" in given else {}
    prior, motors = _with_motors(prior, logs, delay)
    unknowns = unknowns_of(fields)
    not_fitted = {x for name in known or () for x in FIELDS.get(name, ())} | {"stream"}  # which each log has
    wanted = [x for x in unknowns if x not in not_fitted]
    moves_streams = "stream" in unknowns and any("angular_velocity" in x.onboard for x in logs)
    if not wanted and not moves_streams:
        raise UserValueError("identify: nothing is left to fit, since all of the fields are known. Name more fields.")
    seconds = sum((b - a) * x.dt for x in logs for a, b in x.segments)
    every = max(0.5 * horizon, seconds / _MOST_WINDOWS)
    windows = prediction.cut(logs, horizon, past, every, _BODY_STEP, motors.nominal_voltage)
    held = held_out(windows)
    kept = windows.select(torch.nonzero(~held).flatten())
    if len(kept) < 2 * len(wanted) + 4:
        raise TooShort(
            f"identify: {len(kept)} windows of {horizon:g} s are too few for {len(wanted)} unknowns. Give more "
            "flights, or fewer fields."
        )
    mark = fingerprint(logs, prior, motors, wanted, past, horizon)
    fit = Fit(Model(prior, motors, ()), kept, logs, moves_streams, progress, iterations, Checkpoint(checkpoint, mark))
    state, dropped, two = fit.run(wanted)
    model = fit.model.only(state.free)
    cover, hessians, scores = fit.uncertainty(state)
    n = len(state.x)
    # Student's distribution, nearly, and the bias of a sum over so many of the lags that there are.
    quantile = 1.96 * (1.0 + 2.5 / max(len(kept) - n, 1) + 1.5 * fit.lags / len(kept))
    has_mass = "mass" in given
    parameters, ratios = report(model, state.x, cover[:n, :n], quantile, has_mass)
    resampled = {}
    if draws:
        changes = bootstrap(hessians, scores, fit.lags, draws, seed)
        tables = report(model, state.x, torch.cov(changes[:, :n].T).reshape(n, n), 1.96, has_mass)
        resampled = {name: (entry["low"], entry["high"]) for table in tables for name, entry in table.items()}
    found = parameters["command_delay"]["value"] if "command_delay" in parameters else motors.delay
    motors = dataclasses.replace(motors, delay=float(np.clip(found, -0.1, 0.5)))  # what a drone's file may say
    fitted = QuadrotorParams(**model.params(state.x)._asdict(), motor_command=motors)
    left = _checked_trim(logs, fitted, past, "thrust" in wanted)
    errors, by_flight = _errors(logs, {"fitted": fitted, "prior": prior}, past, horizon)
    half = quantile * cover.diag()[n:].clamp_min(0.0).sqrt() * UNKNOWNS["stream"].scale
    ends = zip(state.streams.tolist(), (state.streams - half).tolist(), (state.streams + half).tolist(), strict=True)
    clocks = [Estimate(value=value, low=low, high=high, unit="s") for value, low, high in ends]
    settings = {"past": past, "horizon": horizon, "seed": seed, "windows": len(kept), "held_out": int(held.sum())}
    settings |= {"iterations": state.iteration, "cost": state.cost}
    return IdentificationResult(
        drone=fitted,
        prior=prior,
        has_mass=has_mass,
        parameters=parameters,
        ratios=ratios,
        stream_delay={log.name: clock for log, clock in zip(logs, clocks, strict=True)},
        bootstrap=resampled,
        names=list(state.free),
        correlation=_correlation(cover[:n, :n]).tolist(),
        not_identifiable=_not_identifiable(dropped, has_mass, fields) | unjudged,
        time_constants=two,
        errors=errors,
        errors_by_flight=by_flight,
        trim=left,
        settings=settings,
        logs=[log.name for log in logs],
        flights=logs,
    )


def _with_motors(
    prior: QuadrotorParams, logs: Sequence[FlightLog], delay: float | None
) -> tuple[QuadrotorParams, MotorCommand]:
    """The drone with a map from motor commands to rotor speeds: its own, or one whose thrust carries it."""
    motors = prior.motor_command
    volts = [float(x.battery_voltage.mean()) for x in logs if x.battery_voltage is not None]
    for volt in volts:
        if motors is not None and not 0.5 < volt / motors.nominal_voltage < 2.0:
            raise UserValueError(
                f"identify: a battery has {volt:.3g} V in the mean, and the drone's motor_command is for "
                f"{motors.nominal_voltage:.3g} V. Say by Columns(names, scale=...) in which unit the log has it, leave "
                "battery_voltage out, or give the drone the motor_command of its own battery."
            )
    if motors is None:
        nominal = float(np.mean(volts)) if volts else 1.0
        motors = MotorCommand(float(np.mean([prediction.carrying_speed(prior, x, nominal) for x in logs])), nominal)
    if delay is not None:
        motors = dataclasses.replace(motors, delay=delay)
    return dataclasses.replace(prior, motor_command=motors), motors


def _check_turning(prior: QuadrotorParams, logs: Sequence[FlightLog]) -> None:
    """Refuse rotors whose places or spins turn the drone against what its flights show."""
    places, spin, mine = prior.rotor_positions.numpy(), prior.rotor_spin.numpy(), prediction.log_columns(prior)
    signs = np.stack((places[:, 1], -places[:, 0], spin))  # of roll, pitch and yaw
    each = []
    for log in logs:
        rows = np.concatenate([np.arange(start, stop) for start, stop in log.segments])
        each.append(turning_fits(log.angular_velocity, log.motor_command[:, mine], log.dt, [rows], signs)[0, 0])
    fits = np.mean(each, 0)
    if fits[2] < -_CONTRARY:
        raise UserValueError(
            f"identify: the rotors of these flights turn the other way than the drone's (correlation {fits[2]:.2f} "
            f"of torque and acceleration about z). Write rotor_spin: {(-spin).astype(int).tolist()} in the drone."
        )
    if fits[:2].min() < -_CONTRARY:
        raise UserValueError(
            f"identify: motors turn these flights against where the drone's rotor_positions are (correlations "
            f"{fits[0]:.2f} in roll, {fits[1]:.2f} in pitch). When you read the log, name its motors front left, back "
            "left, back right, front right, and give the attitude of a body whose x points forward."
        )


def _checked_trim(
    logs: Sequence[FlightLog], fitted: QuadrotorParams, past: float, fits_thrust: bool
) -> dict[str, list[float]]:
    """The mean force and torque that the fitted drone leaves over, refused beyond a fifth of the weight."""
    left = prediction.trim(logs, fitted, past)
    if left is None:
        return {}
    force, torque = left.force.tolist(), left.torque.tolist()
    share = math.hypot(*force)
    if share > _MOST_TRIM:
        more = "" if fits_thrust else ' Or fit its thrust, too: name "thrust_map" in fields.'
        along = ", ".join(f"{x:+.2f}" for x in force)
        raise UserValueError(
            f"identify: {share:.0%} of the drone's weight is left over ({along} along x, y, z): its mass of "
            f"{float(fitted.mass):.3g} kg or its thrust is not that of these flights. Weigh it with its battery.{more}"
        )
    return {"force_per_weight": force, "torque": torque}


@dataclasses.dataclass
class Fit:
    """One fit: its windows, and the stages in which unknowns come and go."""

    model: Model
    windows: Windows
    logs: list[FlightLog]
    moves_streams: bool
    progress: bool
    iterations: int
    file: Checkpoint

    @property
    def lags(self) -> int:
        """How many windows in a row err alike."""
        overlap = 2 * (self.windows.past + self.windows.future) // self.windows.future
        return max(overlap, round(4.0 * (len(self.windows) / 100.0) ** (2.0 / 9.0)))

    def run(self, wanted: list[str]) -> tuple[State, dict[str, str], str]:
        """Fit what is wanted; leave out what the flights do not tell; then ask for two time constants."""
        streams = torch.tensor([prediction.stream_delay(log) for log in self.logs], dtype=torch.float64)
        free, dropped = [x for x in wanted if x != "asymmetry"], {}
        x, near = self.model.only(free).start, min(4, self.iterations - 1)  # a later stage starts near its end
        while True:
            start = State(tuple(free), x, streams, iteration=near if dropped else 0)
            state = self._minimise(start, f"without {sorted(dropped)}")
            worst = self._least_certain(state)
            if not worst:
                break
            dropped |= worst
            if self.progress:
                print("\n".join(f"{name}: {reason}" for name, reason in worst.items()))
            x = state.x[[i for i, name in enumerate(free) if name not in worst]]
            free, streams = [name for name in free if name not in worst], state.streams
        if "asymmetry" not in wanted or "lag" not in free:
            return state, dropped, "not asked for"
        start = State((*free, "asymmetry"), torch.cat((state.x, state.x.new_zeros(1))), state.streams, iteration=near)
        more = self._minimise(start, "two time constants")
        cover, *_ = self.uncertainty(more)
        ratio, error = float(more.x[-1]), float(cover[len(free), len(free)].sqrt())
        value, low, high = (math.exp(ratio + end * error) for end in (0.0, -1.96, 1.96))
        said = f"rising / falling = {value:.2f}, 95 % between {low:.2f} and {high:.2f}"
        if abs(ratio) > 2.58 * error and abs(ratio) > math.log(1.2):
            return more, dropped, f"two time constants: {said}"
        return state, dropped, f"one time constant: {said}"

    def uncertainty(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """The covariance (n + L, n + L) of the unknowns at the optimum, and the equations behind it."""
        hessians, scores = self._problem(state).equations(state, update_scale=True)
        cover, bread = covariance(hessians, scores, self.windows.log, self.lags)
        if len(self.logs) > 2 and "thrust" in state.free:
            # The level of thrust differs from flight to flight, with rotors and battery, more than within one.
            sums = scores.new_zeros(len(self.logs), scores.shape[1]).index_add(0, self.windows.log, scores)
            between = (bread @ (sums.T @ sums) @ bread).diag() * len(self.logs) / (len(self.logs) - 1)
            wider = torch.ones_like(between)
            i = state.free.index("thrust")
            wider[i] = (between[i] / cover[i, i].clamp_min(1e-300)).clamp_min(1.0).sqrt()
            cover = cover * wider[:, None] * wider
        return cover, hessians, scores

    def _problem(self, state: State) -> Problem:
        return Problem(self.model.only(state.free), self.windows, self.moves_streams, "thrust" in state.free)

    def _minimise(self, start: State, stage: str) -> State:
        def after(now: State) -> None:
            self.file.write(stage, now)
            if self.progress:
                print(f"step {now.iteration}, cost {now.cost:.4g}, {len(now.free)} unknowns, {stage}")

        return minimise(self._problem(start), self.file.resume(stage, start), after, self.iterations)

    def _least_certain(self, state: State) -> dict[str, str]:
        """The unknown that is least certain, if it is too uncertain, and why; or all that nothing depends on."""
        if not state.free:
            return {}
        cover, *_ = self.uncertainty(state)
        variance = cover.diag()[: len(state.x)]
        untold = [name for name, x in zip(state.free, variance, strict=True) if x <= 0]
        if untold:
            return {x: f"nothing in the flights depends on it; it needs {UNKNOWNS[x].why}" for x in untold}
        halves = 1.96 * variance.sqrt()
        excess = halves / halves.new_tensor([UNKNOWNS[name].wide for name in state.free])
        i = int(excess.argmax())
        name, half = state.free[i], float(halves[i])
        unknown = UNKNOWNS[name]
        if excess[i] <= 1.0 and abs(float(state.x[i])) < unknown.limit:
            return self._impossible(state)
        factor = f"spans a factor of {math.exp(2 * min(half, 20.0)):.3g}"
        spread = f"its 95 % interval {factor if unknown.is_log else f'is {2 * half * unknown.scale:.3g} wide'}"
        correlation = _correlation(cover)[i, : len(state.x)].clone()
        correlation[i] = 0.0
        j = int(correlation.abs().argmax())
        if abs(float(correlation[j])) > 0.9:
            spread += f", and it is hardly told from {state.free[j]} (correlation {float(correlation[j]):.2f})"
        return {name: f"{spread}; it needs {unknown.why}"}

    def _impossible(self, state: State) -> dict[str, str]:
        """The inertia about z, where the flights want one that no body has."""
        if "z_ratio" not in state.free:
            return {}
        step = torch.tensor([1e-3 * (name == "z_ratio") for name in state.free], dtype=torch.float64)
        up, down = (self.model.only(state.free).bounded(state.x + x).dist(state.x) for x in (step, -step))
        if min(up, down) > 5e-4:
            return {}
        limit = "Jx + Jy, the most" if up < down else "|Jx - Jy|, the least"
        return {"z_ratio": f"its best value is {limit} that a body can have; it needs {UNKNOWNS['z_ratio'].why}"}


class Checkpoint:
    """A file with the last step of each stage of a fit."""

    def __init__(self, path: str | Path | None, fingerprint: str) -> None:
        self.path, self.fingerprint, self.stages = path, fingerprint, dict[str, Any]()
        if path is not None and Path(path).is_file():
            with self._named():
                content = json.loads(Path(path).read_text())
                self.stages = dict(content["stages"]) if content["fingerprint"] == fingerprint else {}

    def resume(self, stage: str, start: State) -> State:
        """The last step of a stage, or its start."""
        found = self.stages.get(stage)
        with self._named():
            if found is None or tuple(found["free"]) != start.free:
                return start
            old = {name: start.x.new_tensor(found[name]).reshape(getattr(start, name).shape) for name in _TENSORS}
            if not all(x.isfinite().all() for x in old.values()):
                raise ValueError("an unknown is not finite")
            return State(**found | {"free": start.free} | old)

    def write(self, stage: str, state: State) -> None:
        """Keep a step."""
        if self.path is not None:
            self.stages[stage] = dataclasses.asdict(state) | {x: getattr(state, x).tolist() for x in _TENSORS}
            with replacing(self.path) as temporary:
                temporary.write_text(json.dumps({"fingerprint": self.fingerprint, "stages": self.stages}))

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError) as error:
            said = f"{self.path} is not a checkpoint of a fit: {shown(error)}. Delete it to start again."
            raise UserValueError(said) from error


def held_out(windows: Windows) -> Tensor:
    """Which windows (W) are held out: of each log every fifth block of two seconds, or of less in a short log."""
    held = torch.zeros(len(windows), dtype=torch.bool)
    for k in windows.log.unique():
        own = windows.log == k
        start = (windows.start[own] - windows.start[own].min()) * windows.dt
        block = min(_BLOCK, float(start.max()) / _EVERY_BLOCK + 1e-9)
        held[own] = start // block % _EVERY_BLOCK == _EVERY_BLOCK - 1
    return held


def _errors(
    logs: Sequence[FlightLog], drones: Mapping[str, QuadrotorParams], past: float, horizon: float
) -> tuple[dict[str, dict[str, dict[float, float]]], dict[str, dict[str, dict[str, float]]]]:
    """RMS errors of the predictions in the held-out windows, of drones by name, and of constant velocity; and those
    after the horizon in each flight."""
    horizons = sorted({h for h in _HORIZONS if h <= horizon} | {horizon})
    table: dict[str, dict[str, dict[float, float]]] = {}
    flights: dict[str, dict[str, dict[str, float]]] = {log.name: {} for log in logs}
    for name, drone in {**drones, CONSTANT_VELOCITY: CONSTANT_VELOCITY}.items():
        windows, *states = prediction.predict(logs, drone, horizon, past, 0.1)
        held = held_out(windows)
        for k, log in enumerate([None, *logs], -1):
            own = held if log is None else held & (windows.log == k)
            if own.any():
                flown, seen = (RigidBodyState(*(x[own] for x in state)) for state in states)
                errors = prediction.rms_errors(windows, flown, seen, horizons)
                if log is None:
                    table[name] = errors
                else:
                    flights[log.name][name] = {quantity: x[horizon] for quantity, x in errors.items()}
    return table, flights


def _not_identifiable(dropped: Mapping[str, str], has_mass: bool, fields: str | Sequence[str] | None) -> dict[str, str]:
    """Fields without a number, with the reason."""
    found = {UNKNOWNS[name].number: reason for name, reason in dropped.items()}
    if not has_mass:
        found["mass"] = "motion does not tell it: weigh the drone, and give known={'mass': ...}"
        asked = [name for name in NEED_MASS if fields is None or name in fields]
        found |= {name: _MASS for name in asked if name not in found}
    return found


def _correlation(cover: Tensor) -> Tensor:
    deviation = cover.diag().clamp_min(1e-300).sqrt()
    return (cover / deviation[:, None] / deviation).clamp(-1.0, 1.0)


def fingerprint(logs: Sequence[FlightLog], prior: QuadrotorParams, motors: MotorCommand, *settings: Any) -> str:
    """What the flights, the start and the settings of a fit amount to: a checkpoint is of one of them."""
    digest = hashlib.sha256(repr((settings, motors)).encode())
    for value in prior.fields().values():
        digest.update(value.numpy().tobytes())
    for log in logs:
        motion = (log.position, log.velocity, log.quaternion, log.angular_velocity)
        for column in (*motion, log.motor_command, log.battery_voltage):
            digest.update(b"none" if column is None else np.ascontiguousarray(column).tobytes())
        digest.update(repr((log.dt, log.segments, log.onboard)).encode())
    return digest.hexdigest()
