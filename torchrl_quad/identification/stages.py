"""The stages of a fit: what the flights do not tell is left out, and a second time constant is tried at the end."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.dynamics import MotorCommand, QuadrotorParams
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.files import replacing
from torchrl_quad.identification.fitting import Linear, Problem, State, bootstrap, covariance, minimise
from torchrl_quad.identification.log import FlightLog
from torchrl_quad.identification.parameters import FIELDS, UNKNOWNS, Model, report
from torchrl_quad.identification.prediction import CONSTANT_VELOCITY, ERRORS, differences, predict
from torchrl_quad.identification.result import IdentificationResult
from torchrl_quad.identification.windows import Trajectory, Windows, stream_delay

MAX_BYTES = 10**7  # of a checkpoint, which has some numbers for each unknown
HORIZONS = (0.1, 0.25, 0.5)
_BLOCK = 2.0  # [s] of flight that are held out together
_EVERY_BLOCK = 5  # of which the last is held out
_MASS = "without a known mass, motion only tells its ratio to the mass, which `ratios` gives"


class Fit:
    """One fit: its windows, and the stages in which unknowns come and go."""

    def __init__(
        self,
        model: Model,
        windows: Windows,
        logs: list[FlightLog],
        moves_streams: bool,
        progress: bool,
        iterations: int,
    ) -> None:
        self.model, self.windows, self.logs = model, windows, logs
        self.moves_streams, self.progress, self.iterations = moves_streams, progress, iterations
        self.file = Checkpoint(None, "")
        overlap = 2 * (windows.past + windows.future) // windows.future
        self.lags = max(overlap, round(4.0 * (len(windows) / 100.0) ** (2.0 / 9.0)))

    def run(self, wanted: list[str]) -> tuple[State, dict[str, str], str]:
        """Fit what is wanted; leave out what the flights do not tell; then ask for two time constants."""
        streams = torch.tensor([stream_delay(log) for log in self.logs], dtype=torch.float64)
        free, dropped = [x for x in wanted if x != "asymmetry"], {}
        x = self.model.only(free).start
        while True:
            begun = min(4, self.iterations - 1) if dropped else 0  # near the end already
            state = self.file.resume(f"without {sorted(dropped)}", tuple(free), x, streams, begun)
            state = self._minimise(state, f"without {sorted(dropped)}")
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
        more = self.file.resume(
            "two time constants",
            (*free, "asymmetry"),
            torch.cat((state.x, state.x.new_zeros(1))),
            state.streams,
            min(4, self.iterations - 1),
        )
        more = self._minimise(more, "two time constants")
        _, _, cover, _ = self.uncertainty(more)
        ratio, error = float(more.x[-1]), float(cover[len(free), len(free)].sqrt())
        said = (
            f"rising / falling = {math.exp(ratio):.2f}, 95 % between {math.exp(ratio - 1.96 * error):.2f} and "
            f"{math.exp(ratio + 1.96 * error):.2f}"
        )
        if abs(ratio) > 2.58 * error and abs(ratio) > math.log(1.2):
            return more, dropped, f"two time constants: {said}"
        return state, dropped, f"one time constant: {said}"

    def problem(self, state: State) -> Problem:
        """Its cost, with the unknowns of a state."""
        return Problem(self.model.only(state.free), self.windows, self.moves_streams, "thrust" in state.free)

    def uncertainty(self, state: State) -> tuple[Problem, Linear, Tensor, Tensor]:
        """The covariance (n + L, n + L) of the unknowns at the optimum, and the inverse Hessian."""
        problem = self.problem(state)
        linear = problem.linearise(state, update_scale=True)
        cover, bread, scores = covariance(linear, self.windows.log, len(self.logs), self.lags)
        if len(self.logs) > 2 and "thrust" in state.free:
            # The level of thrust differs from flight to flight, with rotors and battery, more than within one.
            sums = scores.new_zeros(len(self.logs), scores.shape[1]).index_add(0, self.windows.log, scores)
            between = (bread @ (sums.T @ sums) @ bread).diag() * len(self.logs) / (len(self.logs) - 1)
            wider = torch.ones_like(between)
            i = state.free.index("thrust")
            wider[i] = (between[i] / cover[i, i].clamp_min(1e-300)).clamp_min(1.0).sqrt()
            cover = cover * wider[:, None] * wider
        return problem, linear, cover, bread

    def _minimise(self, state: State, stage: str) -> State:
        def after(now: State) -> None:
            self.file.write(stage, now)
            if self.progress:
                print(f"step {now.iteration}, cost {now.cost:.4g}, {len(now.free)} unknowns, {stage}")

        return minimise(self.problem(state), state, after, self.iterations)

    def _least_certain(self, state: State) -> dict[str, str]:
        """The unknown of which flights tell least, if too little, and why; or all of which they tell nothing."""
        if not state.free:
            return {}
        _, _, cover, _ = self.uncertainty(state)
        half = 1.96 * cover.diag()[: len(state.x)].clamp_min(0.0).sqrt()
        wide = torch.tensor([UNKNOWNS[name].wide for name in state.free], dtype=half.dtype)
        excess = half / wide
        untold = cover.diag()[: len(state.x)] <= 0
        if untold.any():
            why = {name: UNKNOWNS[name].why for name, none in zip(state.free, untold, strict=True) if none}
            return {name: f"nothing in the flights depends on it; it needs {need}" for name, need in why.items()}
        i = int(excess.argmax())
        unknown = UNKNOWNS[state.free[i]]
        if excess[i] <= 1.0 and not abs(float(state.x[i])) >= (unknown.high if unknown.scale else math.inf):
            return {}
        if unknown.scale is None:
            spread = f"its 95 % interval spans a factor of {math.exp(2 * min(float(half[i]), 20.0)):.3g}"
        else:
            spread = f"its 95 % interval is {2 * float(half[i]) * unknown.scale:.3g} wide"
        correlation = _correlation(cover)[i, : len(state.x)].clone()
        correlation[i] = 0.0
        j = int(correlation.abs().argmax())
        alike = f", and it is hardly told from {state.free[j]} (correlation {float(correlation[j]):.2f})"
        told = alike if abs(float(correlation[j])) > 0.9 else ""
        return {unknown.name: f"{spread}{told}; it needs {unknown.why}"}

    def result(
        self,
        state: State,
        dropped: dict[str, str],
        two: str,
        held: Windows,
        *,
        has_mass: bool,
        fields: Sequence[str] | None,
        past: float,
        horizon: float,
        draws: int,
        seed: int,
    ) -> IdentificationResult:
        """Everything that is reported of the optimum."""
        model = self.model.only(state.free)
        _, linear, cover, _ = self.uncertainty(state)
        n = len(state.x)
        # Student's distribution, nearly, and the bias of a sum over so many of the lags that there are.
        quantile = 1.96 * (1.0 + 2.5 / max(len(self.windows) - n, 1) + 1.5 * self.lags / len(self.windows))
        parameters, ratios = report(model, state.x, cover[:n, :n], quantile, has_mass)
        changes = bootstrap(linear, self.windows.log, len(self.logs), self.lags, draws, seed) if draws else None
        by_bootstrap = {}
        if changes is not None:
            alone, both = report(model, state.x, torch.cov(changes[:, :n].T).reshape(n, n), 1.96, has_mass)
            by_bootstrap = {name: (entry["low"], entry["high"]) for name, entry in (alone | both).items()}
        delay = parameters["command_delay"]["value"] if "command_delay" in parameters else self.model.motors.delay
        params = model.params(state.x)
        motors = dataclasses.replace(self.model.motors, delay=float(np.clip(delay, -0.1, 0.5)))
        drone = QuadrotorParams(**params._asdict(), motor_command=motors)
        half = quantile * cover.diag()[n:].clamp_min(0.0).sqrt() * UNKNOWNS["stream"].scale
        streams = {
            log.name: {"value": float(s), "low": float(s - h), "high": float(s + h), "unit": "s"}
            for log, s, h in zip(self.logs, state.streams, half, strict=True)
        }
        return IdentificationResult(
            drone=drone,
            prior=self.model.prior,
            has_mass=has_mass,
            parameters=parameters,
            ratios=ratios,
            stream_delay=streams,
            bootstrap=by_bootstrap,
            names=list(state.free),
            correlation=_correlation(cover[:n, :n]).tolist(),
            not_identifiable=_refused(dropped, has_mass, fields, parameters),
            time_constants=two,
            errors=_errors(self.logs, drone, self.model, past, horizon),
            settings={
                "past": past,
                "horizon": horizon,
                "seed": seed,
                "windows": len(self.windows),
                "held_out": len(held),
                "iterations": state.iteration,
                "cost": state.cost,
            },
            logs=[log.name for log in self.logs],
            flights=self.logs,
        )


@dataclasses.dataclass
class Checkpoint:
    """A file with the last step of each stage of a fit."""

    path: str | Path | None
    fingerprint: str

    def resume(self, stage: str, free: tuple[str, ...], x: Tensor, streams: Tensor, begun: int = 0) -> State:
        """The last step of a stage, or its start."""
        found = self._read().get(stage)
        try:
            if found is None or tuple(found["free"]) != free:
                return State(free, x, streams, iteration=begun)
            tensors = {name: torch.tensor(found[name], dtype=torch.float64) for name in ("x", "streams")}
            if any(tensors[name].shape != own.shape for name, own in (("x", x), ("streams", streams))):
                raise ValueError("another number of unknowns")
            if not all(tensor.isfinite().all() for tensor in tensors.values()):
                raise ValueError("an unknown is not finite")
            return State(**{**found, **tensors, "free": free})
        except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError) as error:
            raise self._broken(error) from error

    def write(self, stage: str, state: State) -> None:
        """Keep a step."""
        if self.path is None:
            return
        entry = dataclasses.asdict(state) | {"x": state.x.tolist(), "streams": state.streams.tolist()}
        content = {"fingerprint": self.fingerprint, "stages": {**self._read(), stage: entry}}
        with replacing(self.path) as temporary:
            temporary.write_text(json.dumps(content))

    def _read(self) -> dict[str, Any]:
        if self.path is None or not Path(self.path).is_file():
            return {}
        if Path(self.path).stat().st_size > MAX_BYTES:
            raise self._broken(f"it has more than {MAX_BYTES:,} bytes")
        try:
            content = json.loads(Path(self.path).read_text())
            return dict(content["stages"]) if content["fingerprint"] == self.fingerprint else {}
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise self._broken(error) from error

    def _broken(self, error: object) -> UserValueError:
        return UserValueError(f"{self.path} is no checkpoint of a fit: {shown(error)}. Delete it, to start anew.")


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
    logs: Sequence[FlightLog], drone: QuadrotorParams, model: Model, past: float, horizon: float
) -> dict[str, dict[str, dict[float, float]]]:
    """RMS errors of the predictions in the held-out windows: of the fit, of the prior, and of constant velocity."""
    horizons = sorted({h for h in HORIZONS if h <= horizon} | {horizon})
    table = {}
    for name, one in (("fitted", drone), ("prior", model.prior), (CONSTANT_VELOCITY, CONSTANT_VELOCITY)):
        windows, flown, seen = predict(logs, one, horizon, past, 0.1)
        steps = torch.tensor([max(1, round(h / windows.dt)) for h in horizons])
        inside = held_out(windows)
        parts = [Trajectory(*(x[inside][:, steps] for x in y)) for y in (flown, seen)]
        rms = differences(*parts).square().sum(-1).mean(0).sqrt()
        table[name] = {k: dict(zip(horizons, rms[:, i].tolist(), strict=True)) for i, k in enumerate(ERRORS)}
    return table


def _refused(
    dropped: Mapping[str, str], has_mass: bool, fields: Sequence[str] | None, parameters: Mapping[str, Any]
) -> dict[str, str]:
    """Fields that got no number, with the reason."""
    owner = {unknown: name for name, unknowns in FIELDS.items() for unknown in unknowns}
    part = {"drag_xy": ".xy", "drag_z": ".z", "roll": ".x", "pitch": ".y", "z_ratio": ".z"}
    found = {owner[name] + part.get(name, ""): reason for name, reason in dropped.items()}
    if not has_mass:
        found["mass"] = "motion does not tell it: weigh the drone, and give known={'mass': ...}"
        for name in ("thrust_map", "linear_drag", "inertia"):
            if fields is None or name in fields:
                found.setdefault(name, _MASS)
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
