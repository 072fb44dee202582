"""What a fit found, and its files: the drone, ranges for randomisation, a report, pictures."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from torchrl_quad.dynamics import QuadrotorParams
from torchrl_quad.dynamics.parameters import LIMITS
from torchrl_quad.files import make_folder, replacing
from torchrl_quad.identification.log import FlightLog
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


@dataclasses.dataclass(frozen=True)
class IdentificationResult:
    """What :func:`~torchrl_quad.identification.identify` found.

    Entries of ``parameters``, ``ratios`` and ``stream_delay`` are mappings with ``value``, the 95 % interval ``low`` to
    ``high``, and ``unit``. What the flights do not tell is in none of them, but in ``not_identifiable``.
    """

    drone: QuadrotorParams  #: the fitted drone, float64; what was not fitted is the prior's
    prior: QuadrotorParams  #: where the fit started
    has_mass: bool  #: whether the mass was known; without it, ``drone`` has the prior's, and only ratios count
    parameters: Mapping[str, Mapping[str, Any]]  #: by name
    ratios: Mapping[str, Mapping[str, Any]]  #: what motion tells whatever the mass is, by name
    stream_delay: Mapping[str, Mapping[str, Any]]  #: by log, how late its on-board clock is
    bootstrap: Mapping[str, tuple[float, float]]  #: the same intervals, from windows drawn anew
    names: Sequence[str]  #: of the unknowns, in the order of ``correlation``
    correlation: Sequence[Sequence[float]]  #: between the unknowns
    not_identifiable: Mapping[str, str]  #: by field, the reason
    time_constants: str  #: what the flights say about rotors that speed up and slow down at a different pace
    errors: Mapping[
        str, Mapping[str, Mapping[float, float]]
    ]  #: by model, quantity and horizon [s], in held-out windows
    settings: Mapping[str, Any]  #: of the fit
    logs: Sequence[str]  #: names of the flights
    flights: Sequence[FlightLog] = dataclasses.field(repr=False, default=())  #: for pictures

    def __str__(self) -> str:
        lines = [
            f"{len(self.logs)} flight(s), {self.settings['windows']} windows, {self.settings['held_out']} held out"
        ]
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
        return "\n".join(lines)

    def randomization(self) -> dict[str, dict[str, list[float]]]:
        """What ``randomize`` of an environment takes: the drone's fields within the 95 % intervals.

        Each is relative to the fitted drone. Fields with several entries take the widest of their intervals.
        """
        found: dict[str, dict[str, list[float]]] = {}
        everything = {**self.ratios, **self.parameters}
        for field, names in _RANDOMISED.items():
            own = [everything[name] for name in names if name in everything]
            if not own:
                continue
            if field == "drag_height":
                low, high = LIMITS[field]
                found[field] = {"uniform": [max(low, float(own[0]["low"])), min(high, float(own[0]["high"]))]}
            else:
                low = min(x["low"] / x["value"] for x in own)
                found[field] = {"scale": [float(low), float(max(x["high"] / x["value"] for x in own))]}
        return found

    def as_yaml(self) -> str:
        """The drone as a file that :func:`~torchrl_quad.load_drone` takes."""
        content: dict[str, Any] = {}
        for name, value in self.drone.fields().items():
            plain = [_rounded(x) for x in value.reshape(-1).tolist()]
            plain = [plain[i : i + 2] for i in range(0, 8, 2)] if name == "rotor_positions" else plain
            content[name] = plain[0] if len(plain) == 1 else plain
        motors = self.drone.motor_command
        if motors is not None:
            content["motor_command"] = {k: _rounded(v) for k, v in dataclasses.asdict(motors).items()}
        head = [f"# Fitted to {', '.join(self.logs)}."]
        if not self.has_mass:
            head.append("# The mass is the prior's: only ratios to it were fitted.")
        head += [f"# Not fitted: {name}: {reason}." for name, reason in self.not_identifiable.items()]
        return "\n".join(head) + "\n" + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)

    def report(self) -> dict[str, Any]:
        """Everything but the flights, as plain numbers and strings."""
        names = [f.name for f in dataclasses.fields(self) if f.name not in ("drone", "prior", "flights")]
        return {name: _plain(getattr(self, name)) for name in names}

    @checked
    def save(self, folder: str | Path, pictures: bool = True) -> Path:
        """Write ``drone.yaml``, ``randomization.yaml``, ``report.json`` and pictures; each is complete or not there.

        Pictures come last, and need matplotlib: ``prediction.png`` shows predictions against the first flight,
        ``residuals.png`` the errors of all.

        Raises:
            ImportError: matplotlib is not installed.
            OSError: the folder cannot be made or written.
        """
        folder = make_folder(folder)
        with replacing(folder / "drone.yaml") as path:
            path.write_text(self.as_yaml(), encoding="utf-8")
        with replacing(folder / "randomization.yaml") as path:
            path.write_text(yaml.safe_dump(self.randomization(), default_flow_style=None), encoding="utf-8")
        with replacing(folder / "report.json") as path:
            path.write_text(json.dumps(self.report(), indent=1), encoding="utf-8")
        if pictures and self.flights:
            from torchrl_quad.identification.pictures import draw_prediction, draw_residuals

            span = {"horizon": self.settings["horizon"], "past": self.settings["past"]}
            draw_prediction(self.flights[0], self.drone, folder / "prediction.png", prior=self.prior, **span)
            draw_residuals(self.flights, self.drone, folder / "residuals.png", **span)
        return folder


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
