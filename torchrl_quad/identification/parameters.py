"""What a fit can find: its unknowns, what they make of a drone, and in which words they are reported."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import MotorCommand, QuadrotorParams
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.errors import shown
from torchrl_quad.identification.errors import UnknownField
from torchrl_quad.identification.windows import MAX_DELAY, Plant

#: What ``fields`` of :func:`~torchrl_quad.identification.identify` may name, and the unknowns that each stands for.
FIELDS: dict[str, tuple[str, ...]] = {
    "thrust_map": ("thrust",),
    "motor_time_constant": ("lag", "asymmetry"),
    "linear_drag": ("drag_xy", "drag_z"),
    "drag_height": ("height",),
    "inertia": ("roll", "pitch", "z_ratio"),
    "yaw_torque_coefficient": ("yaw",),
    "command_delay": ("delay",),
    "stream_delay": ("stream",),
}


@dataclasses.dataclass(frozen=True)
class Unknown:
    """One number that a fit looks for, in coordinates of its own: a logarithm, or a multiple of ``scale``."""

    name: str
    low: float  #: of the coordinate
    high: float
    wide: float  #: half of a 95 % interval that is wider than this says that the flights do not tell
    scale: float | None  #: None: the coordinate is the logarithm
    why: str  #: what a flight needs to tell it


_LOG = {"low": -7.0, "high": 7.0, "wide": math.log(3.0), "scale": None}
UNKNOWNS = {
    x.name: x
    for x in (
        Unknown("thrust", **_LOG, why="changes of thrust, or hovering"),
        Unknown("lag", **_LOG, why="quick changes of the motor commands"),
        Unknown("asymmetry", **{**_LOG, "wide": 10.0}, why="quick changes of the motor commands, up and down"),
        Unknown("drag_xy", **_LOG, why="fast flight sideways"),
        Unknown("drag_z", **_LOG, why="fast climbs and descents"),
        Unknown("height", -20.0, 20.0, 2.0, 0.01, "fast flight sideways, and quick turns of the body"),
        Unknown("roll", **_LOG, why="quick rolls"),
        Unknown("pitch", **_LOG, why="quick pitching"),
        Unknown("z_ratio", **{**_LOG, "wide": math.log(2.0)}, why="quick turns about two axes at once"),
        Unknown("yaw", **_LOG, why="yaw manoeuvres"),
        Unknown("delay", -10.0, 10.0, 2.0, 0.01, "quick changes of the motor commands"),
        Unknown("stream", -100 * MAX_DELAY + 5, 100 * MAX_DELAY - 5, 2.0, 0.01, "quick turns of the body"),
    )
}


@dataclasses.dataclass(frozen=True)
class Model:
    """A drone as a function of the unknowns: coordinates as a tensor (n), in the order of ``free``.

    Motion fixes ratios: thrust, drag and inertia by the mass. The coordinates are those ratios, so that the mass is
    only a scale. The arm is the prior's. So is the ratio of the inertia about z to the others, unless it is free, too.
    """

    prior: QuadrotorParams  #: float64; its mass is the known one
    motors: MotorCommand
    free: tuple[str, ...]  #: names of unknowns

    @property
    def start(self) -> Tensor:
        """The coordinates of the prior, (n)."""
        prior = self.prior
        tau = prior.motor_time_constant.log()
        arm = prior.rotor_positions.abs().mean(0)  # y of the rotors rolls, x pitches
        k2 = prior.thrust_map[0]
        drag = prior.linear_drag.clamp_min(1e-4 * float(prior.mass)).log() - prior.mass.log()
        values = {
            "thrust": (k2 / prior.mass[0]).log(),
            "lag": tau.mean(),
            "asymmetry": tau[0] - tau[-1],
            "drag_xy": drag[:2].mean(),
            "drag_z": drag[2],
            "height": prior.drag_height[0] / UNKNOWNS["height"].scale,
            "roll": (arm[1] * k2 / prior.inertia[0]).log(),
            "pitch": (arm[0] * k2 / prior.inertia[1]).log(),
            "z_ratio": prior.inertia[2].log() - 0.5 * (prior.inertia[0] * prior.inertia[1]).log(),
            "yaw": (prior.yaw_torque_coefficient[0] * k2 / prior.inertia[2]).log(),
            "delay": prior.mass.new_tensor(self.motors.delay / UNKNOWNS["delay"].scale),
            "stream": prior.mass.new_zeros(()),
        }
        return torch.stack([values[name] for name in self.free]) if self.free else prior.mass.new_zeros(0)

    def only(self, free: Sequence[str]) -> Model:
        """The same with other unknowns; what is left out keeps its prior."""
        return dataclasses.replace(self, free=tuple(free))

    def params(self, x: Tensor) -> RawParams:
        """The drone at coordinates (n), differentiable in them; what is not free is the prior's."""
        prior, c = self.prior, dict(zip(self.free, x, strict=True))
        arm, mass = prior.rotor_positions.abs().mean(0), prior.mass[0]
        fields: dict[str, Tensor] = dict(prior.fields())
        k2 = c["thrust"].exp() * mass if "thrust" in c else prior.thrust_map[0]
        fields["thrust_map"] = prior.thrust_map * (k2 / prior.thrust_map[0])
        if "lag" in c:
            half = 0.5 * c["asymmetry"] if "asymmetry" in c else torch.zeros_like(c["lag"])
            both = [c["lag"] + half, c["lag"] - half] if "asymmetry" in c else [c["lag"]]
            fields["motor_time_constant"] = torch.stack(both).exp()
        drag = prior.linear_drag
        xy = c["drag_xy"].exp() * mass if "drag_xy" in c else None
        z = c["drag_z"].exp() * mass if "drag_z" in c else drag[2]
        fields["linear_drag"] = torch.stack([drag[0] if xy is None else xy, drag[1] if xy is None else xy, z])
        if "height" in c:
            fields["drag_height"] = (c["height"] * UNKNOWNS["height"].scale).reshape(1)
        # Without its own unknown an inertia keeps its ratio to the thrust, which is what motion would fix.
        grown = k2 / prior.thrust_map[0]
        jx = arm[1] * k2 / c["roll"].exp() if "roll" in c else prior.inertia[0] * grown
        jy = arm[0] * k2 / c["pitch"].exp() if "pitch" in c else prior.inertia[1] * grown
        ratio = c["z_ratio"].exp() if "z_ratio" in c else prior.inertia[2] / prior.inertia[:2].prod().sqrt()
        jz = ratio * (jx * jy).sqrt()
        if {"roll", "pitch", "z_ratio"} & set(c):
            fields["inertia"] = torch.stack([jx, jy, jz])
        if "yaw" in c:
            inertia = fields["inertia"]
            fields["yaw_torque_coefficient"] = (c["yaw"].exp() * inertia[2] / k2).reshape(1)
        return RawParams(**fields)

    def plant(self, x: Tensor, stream_delay: Tensor) -> Plant:
        """What windows read, at coordinates (n); the stream delay (W) [s] moves with its coordinate."""
        c = dict(zip(self.free, x, strict=True))
        motors, like = self.motors, self.prior.mass
        delay = c["delay"] * UNKNOWNS["delay"].scale if "delay" in c else like.new_tensor(motors.delay)
        if "stream" in c:
            stream_delay = stream_delay + c["stream"] * UNKNOWNS["stream"].scale
        zero, slope = like.new_tensor(motors.speed_at_zero), like.new_tensor(motors.speed_per_volt)
        return Plant(self.params(x), zero, slope, delay, stream_delay)


#: What motion fixes whatever the mass is, as logarithms in the coordinates.
RATIOS: dict[str, tuple[str, str]] = {
    "k2/m": ("thrust", "N s2/kg"),
    "drag xy/m": ("drag_xy", "1/s"),
    "drag z/m": ("drag_z", "1/s"),
    "arm k2/Jx": ("roll", "s"),
    "arm k2/Jy": ("pitch", "s"),
    "kappa k2/Jz": ("yaw", "s"),
    "Jz/Jxy": ("z_ratio", ""),
}
# Fields by name: the unknowns whose logarithms add up to it, with their factors; unit; whether it needs the mass.
_SUMS: dict[str, tuple[Mapping[str, float], str, bool]] = {
    "thrust_map": ({"thrust": 1.0}, "N s2 (k2)", True),
    "motor_time_constant": ({"lag": 1.0}, "s", False),
    "motor_time_constant.rising": ({"lag": 1.0, "asymmetry": 0.5}, "s", False),
    "motor_time_constant.falling": ({"lag": 1.0, "asymmetry": -0.5}, "s", False),
    "linear_drag.xy": ({"drag_xy": 1.0}, "N s/m", True),
    "linear_drag.z": ({"drag_z": 1.0}, "N s/m", True),
    "drag_height": ({"height": 1.0}, "m", False),
    "inertia.x": ({"thrust": 1.0, "roll": -1.0}, "kg m2", True),
    "inertia.y": ({"thrust": 1.0, "pitch": -1.0}, "kg m2", True),
    "inertia.z": ({"z_ratio": 1.0, "thrust": 1.0, "roll": -0.5, "pitch": -0.5}, "kg m2", True),
    "yaw_torque_coefficient": ({"yaw": 1.0, "z_ratio": 1.0, "roll": -0.5, "pitch": -0.5}, "m", False),
    "command_delay": ({"delay": 1.0}, "s", False),
}


def report(model: Model, x: Tensor, covariance: Tensor, quantile: float, has_mass: bool) -> tuple[dict, dict]:
    """The parameters and the ratios by name: value, 95 % interval (low, high), unit, and the prior's value.

    Args:
        model: the drone.
        x: its coordinates (n).
        covariance: of them (n, n).
        quantile: standard deviations in half of an interval.
        has_mass: whether the mass is known; without it, fields that scale with the mass are left out.
    """
    place = {name: i for i, name in enumerate(model.free)}
    values, prior = _numbers(model, model.params(x), x), _numbers(model, RawParams(**model.prior.fields()), None)

    def interval(factors: Mapping[str, float], value: float, scale: float | None) -> tuple[float, float]:
        gradient = torch.zeros_like(x)
        for name, factor in factors.items():
            if name in place:
                gradient[place[name]] = factor
        half = quantile * float((gradient @ covariance @ gradient).clamp_min(0.0).sqrt())
        if scale is None:
            return value * math.exp(-half), value * math.exp(half)
        return value - half * scale, value + half * scale

    parameters: dict[str, dict[str, Any]] = {}
    two = "asymmetry" in place
    for name, (factors, unit, needs_mass) in _SUMS.items():
        main = next(reversed(factors)) if name in ("inertia.x", "inertia.y") else next(iter(factors))
        if main not in place or (needs_mass and not has_mass):
            continue
        if name.startswith("motor_time_constant") and (name == "motor_time_constant") is two:
            continue
        low, high = interval(factors, values[name], UNKNOWNS[main].scale)
        parameters[name] = {"value": values[name], "low": low, "high": high, "unit": unit, "prior": prior[name]}
    ratios = {}
    for name, (unknown, unit) in RATIOS.items():
        if unknown in place:
            value = math.exp(float(x[place[unknown]]))
            low, high = interval({unknown: 1.0}, value, None)
            ratios[name] = {"value": value, "low": low, "high": high, "unit": unit}
    return parameters, ratios


def _numbers(model: Model, params: RawParams, x: Tensor | None) -> dict[str, float]:
    tau = params.motor_time_constant
    place = {} if x is None else dict(zip(model.free, x.tolist(), strict=True))
    delay = place["delay"] * UNKNOWNS["delay"].scale if "delay" in place else model.motors.delay
    return {
        "thrust_map": float(params.thrust_map[0]),
        "motor_time_constant": float(tau.log().mean().exp()),
        "motor_time_constant.rising": float(tau[0]),
        "motor_time_constant.falling": float(tau[-1]),
        "linear_drag.xy": float(params.linear_drag[:2].mean()),
        "linear_drag.z": float(params.linear_drag[2]),
        "drag_height": float(params.drag_height[0]),
        "inertia.x": float(params.inertia[0]),
        "inertia.y": float(params.inertia[1]),
        "inertia.z": float(params.inertia[2]),
        "yaw_torque_coefficient": float(params.yaw_torque_coefficient[0]),
        "command_delay": delay,
    }


def unknowns_of(fields: Sequence[str] | None) -> list[str]:
    """The unknowns behind fields; None are all.

    Raises:
        UnknownField: one is not known.
    """
    if isinstance(fields, str):
        fields = [fields]
    fields = list(FIELDS) if fields is None else list(dict.fromkeys(fields))
    if not fields:
        raise UnknownField(f"identify: fields names none. Choose from: {', '.join(FIELDS)}; None is everything.")
    for name in fields:
        if name not in FIELDS:
            raise UnknownField(
                f"identify cannot fit {shown(name)}. Choose from: {', '.join(FIELDS)}. Geometry, gravity and the mass "
                'are taken as known: known={"mass": 0.03}, or in the drone.'
            )
    return [unknown for name in fields for unknown in FIELDS[name]]
