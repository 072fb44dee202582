"""Describe a task to pictures and reports: the scenery beside its drones, and the names and units of its metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Metric:
    """How a metric is summed up over episodes, printed, and drawn.

    Values themselves are in SI units everywhere; only print and pictures use ``scale`` and ``unit``.
    """

    label: str  #: its name in prose, such as "position error"
    unit: str = ""  #: the unit in print, such as "cm"
    scale: float = 1.0  #: how many of these units make one SI unit, 100 for cm
    median: bool = False  #: sum up with the median instead of the mean, which a few crashes would dominate
    log: bool = False  #: draw on a logarithmic axis

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


@dataclass(frozen=True)
class Scenery:
    """The things that pictures show beside the drones; positions are in m, in the world frame.

    Places, a curve or gates show where targets are. Without them, pictures show where the entry ``target``
    (num_envs, 3) of the state has been in the flight.
    """

    target: str = "target"  #: the name of the target, as in "distance to the target"
    places: Tensor | None = None  #: targets that do not move (k, 3)
    curve: Tensor | None = None  #: a line (m, 3) along which the target moves
    gates: Tensor | None = None  #: centres of gates (k, 3), in the order of flight; the target is one of them
    gate_radius: float = 0.3  #: [m]
    progress: str | None = None  #: the metric that best shows how a flight goes; by default the distance to the target


def visible_state(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The entries of a state that pictures show: ``position``, ``quaternion``, and ``target`` if it is a position."""
    shown = {key: state[key] for key in ("position", "quaternion")}
    if "target" in state and state["target"].shape == state["position"].shape:
        shown["target"] = state["target"]
    return shown


def merge_reset(before: Mapping[str, Tensor], begun: Mapping[str, Tensor], mask: Tensor | None) -> dict[str, Tensor]:
    """The visible state after a reset of the environments in a mask (num_envs, 1), of all of them for None."""
    if mask is None or not before:
        return dict(begun)
    return {key: torch.where(mask.reshape(-1, 1), x, before[key]) for key, x in begun.items()}
