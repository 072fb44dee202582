"""What is measured of episodes: names and units of metrics, and the ends of episodes in a rollout."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.options import Scale, checked


@checked
@dataclass(frozen=True)
class Metric:
    """How a metric is averaged over episodes, printed, and drawn.

    Values themselves are in SI units everywhere; only print and pictures use ``unit``, and ``scale``, how many
    of these units make one SI unit.
    """

    label: str  #: its name in prose, such as "position error"
    unit: str = ""  #: in print, such as "cm"
    scale: Scale = 1.0  # how many of these units make one SI unit, 100 for cm
    median: bool = False  #: whether its average is the median instead of the mean, which a few crashes would dominate
    log: bool = False  #: whether it is drawn on a logarithmic axis
    goal: Literal["max", "min"] | None = None  #: whether more or less is better; wandb keeps the best value

    @property
    def is_length(self) -> bool:
        """Whether the values are metres, so that they can share an axis with a distance."""
        return self.unit in ("mm", "cm", "m", "km")

    @property
    def axis_label(self) -> str:
        """The label of an axis of values times ``scale``: "position error [cm]"."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    def summarise(self, values: Tensor) -> float:
        """The average over episodes (n), without those that have no value, which are NaN."""
        values = values if values.is_floating_point() else values.float()  # such as a bool, whether it was solved
        return (values.nanmedian() if self.median else values.nanmean()).item()

    def format(self, value: float) -> str:
        """An average in print, with three significant digits: "3.21 cm (median)", "93 %"; "none" for NaN."""
        if math.isnan(value):
            return "none"
        value = self.scale * value
        number = f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
        return " ".join(filter(None, (number, self.unit, "(median)" if self.median else "")))


#: The metrics of every task. A task adds its own by ``metric_info = {**EPISODE_METRICS, "lap_time": Metric(...)}``.
EPISODE_METRICS: dict[str, Metric] = {
    "return": Metric("return", goal="max"),
    "solved": Metric("episodes solved", "%", 100.0, goal="max"),
    "crash": Metric("crashes", "%", 100.0, goal="min"),
}


def describe_metric(name: str, metric_info: Mapping[str, Metric]) -> Metric:
    """The description of a metric; one without a description gets its name, without a unit."""
    return metric_info.get(name) or EPISODE_METRICS.get(name) or Metric(name.replace("_", " "))


def read(rollout: TensorDictBase, *names: str) -> Tensor:
    """An entry ``("next", *names)`` of a rollout."""
    return cast(Tensor, rollout["next", *names])


def first_episode(rollout: TensorDictBase) -> Tensor:
    """Mark the steps of each environment's first episode, its last one included, bool (num_envs, time, 1)."""
    done = read(rollout, "done")
    return (done.cumsum(1) - done.int()) == 0


def at_episode_end(rollout: TensorDictBase, value: Tensor, steps: int = 1) -> Tensor:
    """The mean of a value (num_envs, time, 1) over the last steps of each environment's first episode, (num_envs)."""
    first = first_episode(rollout)
    if steps == 1:
        return value.gather(1, first.sum(1, keepdim=True) - 1).flatten()
    last = first & (first.sum(1, keepdim=True) - first.cumsum(1) < steps)
    return (value.where(last, 0).sum(1) / last.sum(1)).squeeze(-1)
