"""What a fit can find: its unknowns, what they make of a drone, and how they are reported."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NotRequired, TypedDict

import torch
from torch import Tensor

from torchrl_quad.dynamics import MotorCommand, QuadrotorParams
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.identification.prediction import MAX_DELAY, Plant, plant_of


@dataclasses.dataclass(frozen=True)
class Unknown:
    """One number that a fit looks for, in coordinates of its own: a logarithm, or a multiple of ``scale``."""

    number: str  #: of a drone that it makes, as it is reported
    why: str  #: what a flight needs to tell it
    wide: float = math.log(3.0)  #: half of a 95 % interval that is wider says that the flights do not tell it
    limit: float = math.inf  #: of the coordinate, either way
    scale: float = 1.0

    @property
    def is_log(self) -> bool:
        """Whether the coordinate is a logarithm, which has no limit."""
        return math.isinf(self.limit)


UNKNOWNS = {
    "thrust": Unknown("thrust_map", "changes of thrust, or hovering"),
    "lag": Unknown("motor_time_constant", "quick changes of the motor commands"),
    "asymmetry": Unknown("motor_time_constant", "quick changes of the motor commands, up and down", 10.0),
    "drag_xy": Unknown("linear_drag.xy", "fast flight sideways"),
    "drag_z": Unknown("linear_drag.z", "fast climbs and descents"),
    "height": Unknown("drag_height", "fast flight sideways, and quick turns of the body", 2.0, 20.0, 0.01),
    "roll": Unknown("inertia.x", "quick rolls"),
    "pitch": Unknown("inertia.y", "quick pitching"),
    "z_ratio": Unknown("inertia.z", "quick turns about two axes at once", math.log(2.0)),
    "yaw": Unknown("yaw_torque_coefficient", "yaw manoeuvres"),
    "delay": Unknown("command_delay", "quick changes of the motor commands", 2.0, 10.0, 0.01),
    "stream": Unknown("stream_delay", "quick turns of the body", 2.0, 100 * MAX_DELAY - 5, 0.01),
}
#: What ``fields`` of :func:`~torchrl_quad.identification.identify` may name, and the unknowns that each stands for.
FIELDS: dict[str, tuple[str, ...]] = {}
for _name, _unknown in UNKNOWNS.items():
    _field = _unknown.number.partition(".")[0]
    FIELDS[_field] = (*FIELDS.get(_field, ()), _name)


_DRAG = ("drag_xy", "drag_xy", "drag_z")  # of each axis


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
        grown = k2 / prior.thrust_map[0]
        fields["thrust_map"] = prior.thrust_map * grown
        if "lag" in c:
            halves = (0.5 * c["asymmetry"], -0.5 * c["asymmetry"]) if "asymmetry" in c else (0.0,)
            fields["motor_time_constant"] = torch.stack([c["lag"] + half for half in halves]).exp()
        drag = [c[x].exp() * mass if x in c else old for x, old in zip(_DRAG, prior.linear_drag, strict=True)]
        fields["linear_drag"] = torch.stack(drag)
        if "height" in c:
            fields["drag_height"] = (c["height"] * UNKNOWNS["height"].scale).reshape(1)
        # Without its own unknown an inertia keeps its ratio to the thrust, which is what motion would fix.
        jx = arm[1] * k2 / c["roll"].exp() if "roll" in c else prior.inertia[0] * grown
        jy = arm[0] * k2 / c["pitch"].exp() if "pitch" in c else prior.inertia[1] * grown
        if "z_ratio" in c:
            ratio = c["z_ratio"].exp()
        else:
            low, high = _possible(jx, jy)
            ratio = (prior.inertia[2] / prior.inertia[:2].prod().sqrt()).maximum(low).minimum(high)
        if {"roll", "pitch", "z_ratio"} & set(c):
            fields["inertia"] = torch.stack([jx, jy, ratio * (jx * jy).sqrt()])
        if "yaw" in c:
            fields["yaw_torque_coefficient"] = (c["yaw"].exp() * fields["inertia"][2] / k2).reshape(1)
        return RawParams(**fields)

    def bounded(self, x: Tensor) -> Tensor:
        """The nearest coordinates (n) with an inertia that a body can have."""
        if "z_ratio" not in self.free:
            return x
        i, (low, high) = self.free.index("z_ratio"), _possible(*self.params(x).inertia[:2])
        return torch.cat((x[:i], x[i : i + 1].clamp(low.log(), high.log()), x[i + 1 :]))

    def plant(self, x: Tensor, stream_delay: Tensor) -> Plant:
        """What windows read, at coordinates (n), with the stream delay of each (W) [s]."""
        plant = plant_of(self.params(x), self.motors, stream_delay)
        if "delay" in self.free:
            plant = plant._replace(delay=x[self.free.index("delay")] * UNKNOWNS["delay"].scale)
        return plant


def _possible(jx: Tensor, jy: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest ratio of the inertia about z to the others, sqrt(Jx Jy): each principal moment of a
    body is at most the sum of the other two."""
    root = (jx * jy).sqrt()
    return (jx - jy).abs() / root + 1e-9, (jx + jy) / root


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


class Estimate(TypedDict):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str
    prior: NotRequired[float]


# By the number of a drone that is reported: its unit, its place in its field (as a part of it, if that has several),
# and the factors with which coordinates add up to it; the first of them must have been fitted.
_NUMBERS: dict[str, tuple[str, slice, dict[str, float]]] = {
    "thrust_map": ("N s2 (k2)", slice(0, 1), {"thrust": 1.0}),
    "motor_time_constant": ("s", slice(None), {"lag": 1.0}),
    "motor_time_constant.rising": ("s", slice(0, 1), {"asymmetry": 0.5, "lag": 1.0}),
    "motor_time_constant.falling": ("s", slice(-1, None), {"asymmetry": -0.5, "lag": 1.0}),
    "linear_drag.xy": ("N s/m", slice(0, 2), {"drag_xy": 1.0}),
    "linear_drag.z": ("N s/m", slice(2, 3), {"drag_z": 1.0}),
    "drag_height": ("m", slice(0, 1), {"height": 1.0}),
    "inertia.x": ("kg m2", slice(0, 1), {"roll": -1.0, "thrust": 1.0}),
    "inertia.y": ("kg m2", slice(1, 2), {"pitch": -1.0, "thrust": 1.0}),
    "inertia.z": ("kg m2", slice(2, 3), {"z_ratio": 1.0, "thrust": 1.0, "roll": -0.5, "pitch": -0.5}),
    "yaw_torque_coefficient": ("m", slice(0, 1), {"yaw": 1.0, "z_ratio": 1.0, "roll": -0.5, "pitch": -0.5}),
    "command_delay": ("s", slice(None), {"delay": 1.0}),
}
NEED_MASS = ("thrust_map", "linear_drag", "inertia")  #: fields of which motion only tells the ratio to the mass


def _number(plant: Plant, name: str) -> float:
    """The number of a drone that goes by a name: the mean of its part of a field, of time constants the geometric."""
    field = name.partition(".")[0]
    if field == "command_delay":
        return float(plant.delay)
    part = getattr(plant.params, field)[_NUMBERS[name][1]]
    return float(part.log().mean().exp() if name == "motor_time_constant" else part.mean())


def report(
    model: Model, x: Tensor, covariance: Tensor, quantile: float, has_mass: bool
) -> tuple[dict[str, Estimate], dict[str, Estimate]]:
    """The parameters and the ratios by name, at coordinates (n) with a covariance (n, n); ``quantile`` is how many
    standard deviations half of an interval has. Without a known mass, fields that scale with it are left out."""
    place = {name: i for i, name in enumerate(model.free)}
    fitted, prior = model.plant(x, x.new_zeros(())), model.only(()).plant(x[:0], x.new_zeros(()))

    def estimate(value: float, unit: str, factors: Mapping[str, float]) -> Estimate:
        gradient = torch.zeros_like(x)
        for name, factor in factors.items():
            if name in place:
                gradient[place[name]] = factor
        half = quantile * float((gradient @ covariance @ gradient).clamp_min(0.0).sqrt())
        main = UNKNOWNS[next(iter(factors))]
        low = value * math.exp(-half) if main.is_log else value - half * main.scale
        high = value * math.exp(half) if main.is_log else value + half * main.scale
        if next(iter(factors)) == "z_ratio":  # as far as a body can have it
            least, most = (float(share) * value / ratio for share in _possible(*inertia[:2]))
            low, high = max(low, least), min(high, most)
        return {"value": value, "low": low, "high": high, "unit": unit}

    inertia = fitted.params.inertia
    ratio = float(inertia[2] / inertia[:2].prod().sqrt())
    parameters: dict[str, Estimate] = {}
    for name, (unit, _, factors) in _NUMBERS.items():
        replaced = name == "motor_time_constant" and "asymmetry" in place  # by two of them
        told = has_mass or name.partition(".")[0] not in NEED_MASS
        if next(iter(factors)) in place and told and not replaced:
            parameters[name] = {**estimate(_number(fitted, name), unit, factors), "prior": _number(prior, name)}
    ratios = {
        name: estimate(math.exp(float(x[place[unknown]])), unit, {unknown: 1.0})
        for name, (unknown, unit) in RATIOS.items()
        if unknown in place
    }
    return parameters, ratios


def unknowns_of(fields: str | Sequence[str] | None) -> list[str]:
    """The unknowns behind fields; None means all."""
    fields = [fields] if isinstance(fields, str) else list(FIELDS if fields is None else dict.fromkeys(fields))
    if not fields:
        raise UserValueError(f"identify: fields is empty. Choose from: {', '.join(FIELDS)}; None is everything.")
    for name in fields:
        if name not in FIELDS:
            raise UserValueError(
                f"identify cannot fit {shown(name)}. Choose from: {', '.join(FIELDS)}. Geometry, gravity and the mass "
                'are taken as known: known={"mass": 0.03}, or in the drone.'
            )
    return [unknown for name in fields for unknown in FIELDS[name]]
