"""Describe a task to pictures and reports: the scenery beside its drones, and the names and units of its metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_quad.engine.packing import like
from torchrl_quad.envs.shapes import Shape, along_the_course, as_numbers, as_points, rings
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import Real, Scale, checked
from torchrl_quad.vision.primitives import SIZES


@checked
@dataclass(frozen=True)
class Metric:
    """How a metric is summed up over episodes, printed, and drawn.

    Values themselves are in SI units everywhere; only print and pictures use ``scale`` and ``unit``.

    Args:
        label: its name in prose, such as "position error".
        unit: in print, such as "cm".
        scale: how many of these units make one SI unit, 100 for cm.
        median: whether it is summed up with the median instead of the mean, which a few crashes would dominate.
        log: whether it is drawn on a logarithmic axis.
    """

    label: str
    unit: str = ""
    scale: Scale = 1.0
    median: bool = False
    log: bool = False

    @property
    def is_length(self) -> bool:
        """Whether the values are metres, so that they can share an axis with a distance."""
        return self.unit in ("mm", "cm", "m", "km")

    @property
    def axis_label(self) -> str:
        """The label of an axis of values times ``scale``: "position error [cm]"."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    def summarise(self, values: Tensor) -> float:
        """Sum up the values of episodes (n); leave out those without one, which are NaN."""
        return (values.nanmedian() if self.median else values.nanmean()).item()

    def format(self, value: float) -> str:
        """A summed-up value in print, with three significant digits: "3.21 cm (median)", "93 %"; "none" for NaN."""
        if math.isnan(value):
            return "none"
        value = self.scale * value
        number = f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
        return " ".join(filter(None, (number, self.unit, "(median)" if self.median else "")))


#: The metrics of every task. A task adds its own by ``metric_info = {**EPISODE_METRICS, "lap_time": Metric(...)}``.
EPISODE_METRICS: dict[str, Metric] = {
    "return": Metric("return"),
    "solved": Metric("episodes solved", "%", 100.0),
    "crash": Metric("crashes", "%", 100.0),
}


def describe_metric(name: str, metric_info: Mapping[str, Metric]) -> Metric:
    """The description of a metric; one without a description gets its name, without a unit."""
    return metric_info.get(name) or EPISODE_METRICS.get(name) or Metric(name.replace("_", " "))


@checked
@dataclass(frozen=True)
class Scenery:
    """The things that pictures show beside the drones; positions are in m, in the world frame.

    Pictures show all of them. Without places, a curve, or gates that are the targets, they also show where the entry
    ``target`` (num_envs, 3) of the state has been in the flight.

    Args:
        target: the name of the target, as in "distance to the target".
        places: targets that do not move (k, 3).
        curve: a line (m, 3) along which the target moves.
        gates: centres of gates (k, 3), in the order of flight.
        gate_radius: of all gates, or of each (k) [m].
        gate_axes: the direction (k, 3) in which each gate is flown; by default along the course.
        shapes: objects of your own.
        progress: the metric that best shows how a flight goes; by default the distance to the target.
        success: the value of the progress, in SI units, from which a state fulfils the task.

    Raises:
        ValueError: something has another type or shape.
    """

    target: str = "target"
    places: Tensor | None = None
    curve: Tensor | None = None
    gates: Tensor | None = None
    gate_radius: float | Tensor = 0.3
    gate_axes: Tensor | None = None
    shapes: Sequence[Shape] = ()
    progress: str | None = None
    success: Real | None = None

    def __post_init__(self) -> None:
        for name in ("places", "curve", "gates", "gate_axes"):
            if (points := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_points(f"Scenery: {name}", points))
        count = 0 if self.gates is None else len(self.gates)
        radius = as_numbers(self.gate_radius)
        is_radius = radius is not None and radius.numel() in (1, count)
        if not is_radius or not ((radius > 0) & radius.isfinite()).all():
            raise UserValueError(f"Scenery: gate_radius must be positive [m], one for all {count} gates or one each.")
        if self.gate_axes is not None and len(self.gate_axes) != count:
            raise UserValueError(f"Scenery: gate_axes has {len(self.gate_axes)} directions for {count} gates.")
        is_list = isinstance(self.shapes, Sequence) and not isinstance(self.shapes, str | bytes)
        if not is_list or not all(isinstance(shape, Shape) for shape in self.shapes):
            raise UserValueError("Scenery: shapes must be a list of Shape, such as [Shape.sphere((0, 0, 2), 0.5)].")

    def rings(self) -> Tensor | None:
        """The rims of the gates (k, 33, 3), if there are any."""
        if self.gates is None:
            return None
        axes = along_the_course(self.gates) if self.gate_axes is None else self.gate_axes
        return rings(self.gates, axes, self.gate_radius)

    def points(self) -> list[Tensor]:
        """All points that pictures show, each (*, 3)."""
        everything = (self.places, self.curve, self.rings(), *(shape.points for shape in self.shapes))
        return [x for x in everything if x is not None]


def visible_state(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The entries of a state that pictures show: ``position``, ``quaternion``, ``target`` if it is a position, and the
    random obstacles of a scene."""
    shown = {key: state[key] for key in ("position", "quaternion")}
    if "target" in state and state["target"].shape == state["position"].shape:
        shown["target"] = state["target"]
    nested = state.get("scene", {})
    for kind in SIZES:
        obstacles = nested.get(kind, None) if ("scene", kind) not in state else state["scene", kind]
        if obstacles is not None:
            shown["scene", kind] = obstacles
    return {key: x.detach() for key, x in shown.items()}


def merge_reset(before: Mapping[str, Tensor], begun: Mapping[str, Tensor], mask: Tensor | None) -> dict[str, Tensor]:
    """The visible state after a reset of the environments in a mask (num_envs, 1), of all of them for None."""
    if mask is None or not before:
        return dict(begun)
    return {key: torch.where(like(mask.flatten(), x), x, before[key]) for key, x in begun.items()}
