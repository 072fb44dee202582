"""What a fit found, and its files: the drone, ranges for randomisation, a report, pictures."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic_core import to_jsonable_python

from torchrl_quad.dynamics import QuadrotorParams
from torchrl_quad.dynamics.parameters import LIMITS
from torchrl_quad.dynamics.rigid_body import RigidBodyState
from torchrl_quad.files import make_folder, replacing
from torchrl_quad.identification.log import FlightLog
from torchrl_quad.identification.parameters import Estimate
from torchrl_quad.identification.prediction import CONSTANT_VELOCITY, ERRORS, differences, predict
from torchrl_quad.identification.signals import Array
from torchrl_quad.options import checked

# Which intervals a field of the drone is randomised by.
_RANDOMISED = {
    "thrust_map": ("thrust_map", "k2/m"),
    "motor_time_constant": ("motor_time_constant", "motor_time_constant.rising", "motor_time_constant.falling"),
    "linear_drag": ("linear_drag.xy", "linear_drag.z", "drag xy/m", "drag z/m"),
    "inertia": ("inertia.x", "inertia.y", "arm k2/Jx", "arm k2/Jy"),
    "yaw_torque_coefficient": ("yaw_torque_coefficient",),
    "drag_height": ("drag_height",),
}
_SECONDS = 8.0  # of a flight that are drawn


@dataclasses.dataclass(frozen=True)
class IdentificationResult:
    """What :func:`~torchrl_quad.identification.identify` found.

    Entries of ``parameters``, ``ratios`` and ``stream_delay`` are mappings with ``value``, the 95 % interval ``low`` to
    ``high``, and ``unit``. What the flights do not tell is in none of them, but in ``not_identifiable``.
    """

    drone: QuadrotorParams  #: the fitted drone, float64; what was not fitted is the prior's
    prior: QuadrotorParams  #: where the fit started
    has_mass: bool  #: whether the mass was known; without it, ``drone`` has the prior's, and only ratios count
    parameters: Mapping[str, Estimate]  #: by name
    ratios: Mapping[str, Estimate]  #: what motion tells whatever the mass is, by name
    stream_delay: Mapping[str, Estimate]  #: by log, how late its on-board clock is
    bootstrap: Mapping[str, tuple[float, float]]  #: the same intervals, from resampled windows
    names: Sequence[str]  #: of the unknowns, in the order of ``correlation``
    correlation: Sequence[Sequence[float]]  #: between the unknowns
    not_identifiable: Mapping[str, str]  #: by field, the reason
    time_constants: str  #: what the flights say about rotors that speed up and slow down at a different pace
    #: by model, quantity and horizon [s], in held-out windows
    errors: Mapping[str, Mapping[str, Mapping[float, float]]]
    errors_by_flight: Mapping[str, Mapping[str, Mapping[str, float]]]  #: by flight, model and quantity, at the horizon
    #: ``force_per_weight`` (3) and ``torque`` (3) [rad/s2] that the fitted drone leaves over on average, body frame
    trim: Mapping[str, Sequence[float]]
    settings: Mapping[str, Any]  #: of the fit
    logs: Sequence[str]  #: names of the flights
    flights: Sequence[FlightLog] = dataclasses.field(repr=False, default=())  #: for pictures

    @property
    def verdict(self) -> str:
        """Whether the fit predicts the held-out windows better than constant velocity does, and where it does not; and
        a thrust that differs from the drone's by more than a fifth, which a wrong mass does."""
        fitted, coasting = (self.errors[name] for name in ("fitted", CONSTANT_VELOCITY))
        horizon = max(fitted["position"])
        pairs = {name: (fitted[name][horizon], coasting[name][horizon]) for name in ERRORS}
        worse = [f"{name} ({a:.2g} against {b:.2g} {ERRORS[name]})" for name, (a, b) in pairs.items() if not a < b]
        fit = f"worse than constant velocity: {', '.join(worse)}" if worse else "better than constant velocity in all"
        speed = float(self.prior.rotor_speed_max.max())
        found, before = (
            float(np.polyval(x.thrust_map.flatten().tolist(), speed) / x.mass.max()) for x in (self.drone, self.prior)
        )
        thrust = f"; per mass the rotors give {found / before:.2f} times the thrust of the given drone: weigh it"
        said = thrust if not 0.8 < found / before < 1.2 else ""
        left = self.trim.get("force_per_weight", (0.0, 0.0, 0.0))[2]
        said += f"; {left:+.0%} of the weight is left over along z: weigh it" if abs(left) > 0.1 else ""
        said += f"; mass: {self.not_identifiable['mass']}" if self.has_mass and "mass" in self.not_identifiable else ""
        return f"after {horizon:g} s the fit predicts {fit}{said}"

    def __str__(self) -> str:
        used, held = self.settings["windows"], self.settings["held_out"]
        lines = [f"{len(self.logs)} flight(s), {used} windows, {held} held out"]
        for title, table in (("parameters", self.parameters), ("ratios", self.ratios), ("clock", self.stream_delay)):
            lines += [f"{title}, with 95 % intervals:"] if table else []
            for name, x in table.items():
                lines.append(f"  {name:28} {x['value']:10.4g}  {x['low']:10.4g} to {x['high']:10.4g}  {x['unit']}")
        lines.append(f"rotors: {self.time_constants}")
        lines += [f"not identifiable: {name}: {reason}" for name, reason in self.not_identifiable.items()]
        for model, table in self.errors.items():
            last = {name: list(x.items())[-1] for name, x in table.items()}
            said = ", ".join(f"{name} {value:.3g}" for name, (_, value) in last.items())
            lines.append(f"held-out error after {next(iter(last.values()))[0]:g} s, {model}: {said}")
        for name, table in self.errors_by_flight.items():
            said = [f"{model} {x['attitude']:.3g} rad" for model, x in table.items() if model != "prior"]
            lines.append(f"attitude in {name}: {', '.join(said)}")
        if self.trim:
            x, y, z = self.trim["force_per_weight"]
            lines.append(f"trim left over: {x:+.3f}, {y:+.3f}, {z:+.3f} of the weight along x, y, z")
        return "\n".join([*lines, f"verdict: {self.verdict}"])

    def randomization(self) -> dict[str, dict[str, list[float]]]:
        """What ``randomize`` of an environment takes: the drone's fields within the 95 % intervals.

        Each is relative to the fitted drone. Fields with several entries take the widest of their intervals.
        """
        found: dict[str, dict[str, list[float]]] = {}
        everything = {**self.ratios, **self.parameters}
        for field, names in _RANDOMISED.items():
            own = [everything[name] for name in names if name in everything]
            if field == "drag_height" and own:
                least, most = LIMITS[field]
                found[field] = {"uniform": [max(least, own[0]["low"]), min(most, own[0]["high"])]}
            elif own:
                low, high = ([x[end] / x["value"] for x in own] for end in ("low", "high"))
                found[field] = {"scale": [min(low), max(high)]}
        return found

    def as_yaml(self) -> str:
        """The drone as a file that :func:`~torchrl_quad.load_drone` takes."""
        content: dict[str, Any] = {}
        for name, value in self.drone.fields().items():
            content[name] = _rounded(value.item() if value.numel() == 1 else value.tolist())
        if self.drone.motor_command is not None:
            content["motor_command"] = {k: _rounded(v) for k, v in vars(self.drone.motor_command).items()}
        head = [f"# Fitted to {', '.join(self.logs)}."]
        head += [] if self.has_mass else ["# The mass is the prior's: only ratios to it were fitted."]
        head += [f"# Not fitted: {name}: {reason}." for name, reason in self.not_identifiable.items()]
        return "\n".join(head) + "\n" + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)

    def report(self) -> dict[str, Any]:
        """Everything but the flights, as plain numbers and strings."""
        names = [f.name for f in dataclasses.fields(self) if f.name not in ("drone", "prior", "flights")]
        return {name: to_jsonable_python(getattr(self, name), inf_nan_mode="null") for name in [*names, "verdict"]}

    @checked
    def save(self, folder: str | Path, pictures: bool = True) -> Path:
        """Write ``drone.yaml``, ``randomization.yaml``, ``report.json`` and pictures; each is complete or not there.

        Pictures come last, and need matplotlib: ``prediction.png`` shows predictions against the first flight,
        ``residuals.png`` the errors of all.
        """
        folder = make_folder(folder)
        for name, text in {
            "drone.yaml": self.as_yaml(),
            "randomization.yaml": yaml.safe_dump(self.randomization(), default_flow_style=None),
            "report.json": json.dumps(self.report(), indent=1),
        }.items():
            with replacing(folder / name) as path:
                path.write_text(text, encoding="utf-8")
        if pictures and self.flights:
            self._draw_prediction(folder / "prediction.png")
            self._draw_residuals(folder / "residuals.png")
        return folder

    def _draw_prediction(self, path: Path) -> None:
        """Draw a piece of the first flight, and over it predictions from one state to the next."""
        from torchrl_quad.render.canvas import BLUE, INK, RED, make_figure, save  # which imports the environments

        horizon, past = self.settings["horizon"], self.settings["past"]
        figure = make_figure(figsize=(7.2, 6.4), layout="constrained")
        axes = figure.subplots(4, 2, sharex=True)
        for drone, color, label in ((self.prior, RED, "before the fit"), (self.drone, BLUE, "fitted")):
            windows, flown, seen = predict(self.flights[:1], drone, horizon, past, every=horizon)
            count = min(len(windows), round(_SECONDS / horizon))
            time = windows.dt * (windows.start[:count, None].numpy() + np.arange(windows.future + 1))
            for ax, (name, real), guess in zip(axes.flat, _curves(seen).items(), _curves(flown).values(), strict=True):
                real, guess = real[:count], guess[:count]
                if color == BLUE:  # the last
                    ax.set_ylabel(name, fontsize=8)
                    ax.tick_params(labelsize=7)
                    ax.grid(alpha=0.3, linewidth=0.5)
                    ax.plot(time.T, real.T, color=INK, linewidth=1.6, alpha=0.55)
                    margin = 0.25 * (real.max() - real.min()) + 1e-3
                    ax.set_ylim(real.min() - margin, real.max() + margin)
                ax.plot(time.T, guess.T, color=color, linewidth=0.9)
                ax.plot([], [], color=color, label=label)
        axes[0, 0].plot([], [], color=INK, linewidth=1.6, alpha=0.55, label="flight")
        axes[0, 0].legend(fontsize=7, frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
        for ax in axes[-1]:
            ax.set_xlabel("time [s]", fontsize=8)
        axes[0, 1].set_title(f"{self.flights[0].name}, predictions of {horizon:g} s", fontsize=8, loc="right")
        save(figure, path, dpi=110)

    def _draw_residuals(self, path: Path) -> None:
        """Draw how errors grow over a prediction: the median, and half and nine in ten of the windows around it."""
        from torchrl_quad.render.canvas import BLUE, make_figure, save

        windows, flown, seen = predict(self.flights, self.drone, self.settings["horizon"], self.settings["past"])
        errors = differences(flown, seen).norm(dim=-1).numpy()
        time = windows.dt * np.arange(errors.shape[1])
        figure = make_figure(figsize=(7.2, 2.2), layout="constrained")
        for i, (ax, (name, unit)) in enumerate(zip(figure.subplots(1, 4), ERRORS.items(), strict=True)):
            low, lower, median, upper, high = np.quantile(errors[:, :, i], (0.05, 0.25, 0.5, 0.75, 0.95), axis=0)
            ax.fill_between(time, low, high, color=BLUE, alpha=0.15, linewidth=0)
            ax.fill_between(time, lower, upper, color=BLUE, alpha=0.3, linewidth=0)
            ax.plot(time, median, color=BLUE)
            ax.set_title(f"{name.replace('_', ' ')} [{unit}]", fontsize=8)
            ax.tick_params(labelsize=7)
            ax.set_xlabel("time [s]", fontsize=8)
            ax.grid(alpha=0.3, linewidth=0.5)
            ax.set_ylim(bottom=0.0)
        save(figure, path, dpi=110)


def _curves(states: RigidBodyState) -> dict[str, Array]:
    """What a picture shows of states, (W, n) each, by its label."""
    w, x, y, z = states.quaternion.unbind(-1)
    sines = {"roll": 2.0 * (w * x + y * z), "pitch": 2.0 * (w * y - x * z)}  # of a small roll, and of pitch
    curves = {f"{'xy'[k]} position [m]": states.position[..., k].numpy() for k in range(2)}
    curves |= {f"{'xy'[k]} velocity [m/s]": states.velocity[..., k].numpy() for k in range(2)}
    curves |= {f"{name} [deg]": np.degrees(np.arcsin(np.clip(x.numpy(), -1.0, 1.0))) for name, x in sines.items()}
    return curves | {f"{name} rate [rad/s]": states.angular_velocity[..., k].numpy() for k, name in enumerate(sines)}


def _rounded(value: Any) -> Any:
    return [_rounded(x) for x in value] if isinstance(value, list) else float(f"{value:.6g}")
