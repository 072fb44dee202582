"""Read a rollout as pictures show it: first episodes, targets, and how well they go."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.data.unwrap import base_env
from torchrl_quad.dynamics import FlightController
from torchrl_quad.envs.markers import Markers, visible_state
from torchrl_quad.envs.metrics import describe_metric, first_episode
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.vision import Primitives


class Flight:
    """The first episodes of a rollout, without their graph, on the CPU.

    Args:
        who: the function that draws, for its errors.
        rollout: (num_envs, time).
        env: the environment that flew, also under transforms, or None.
        control_dt: control step [s], used without ``env``.
        needed: keys of the rollout without which nothing can be drawn.
        num_envs: how many environments to keep; None for all.

    Raises:
        TypeError: ``env`` is not a quadrotor environment.
        ValueError: the rollout has another shape or lacks a key, or ``num_envs`` is less than 1.
    """

    def __init__(
        self,
        who: str,
        rollout: TensorDictBase,
        env: EnvBase | None,
        control_dt: float,
        needed: list[tuple[str, ...]],
        num_envs: int | None = None,
    ) -> None:
        check_rollout(who, rollout, env, needed, num_envs)
        self.rollout: TensorDictBase = rollout[:num_envs].detach().cpu()
        self.env = None if env is None else base_env(env)
        self.control_dt = control_dt if env is None else self.env.control_dt
        self.metric_info = {} if env is None else self.env.metric_info
        self.steps = self._count_steps()  # of each first episode (num_envs)
        self.target = self.state("target")
        self.named = Markers() if env is None else self.env.markers()  # by the task
        self.markers = self.named
        self._add_targets()

    def __len__(self) -> int:
        return len(self.rollout)

    @property
    def title(self) -> str:
        """What is shown: "HoveringEnv, 12 flights"."""
        name = "Flight" if self.env is None else type(self.env).__name__
        return f"{name}, {len(self)} flight{'s' * (len(self) > 1)}"

    @property
    def times(self) -> np.ndarray:
        """The instants [s] of states (time + 1), the first at the start."""
        return self.control_dt * np.arange(self.rollout.shape[1] + 1)

    def state(self, name: str) -> Tensor | None:
        """An entry of the state (num_envs, time + 1, k): at the start of the first episode, and after each step.

        After the end of the episode it keeps its last value. It is NaN where it is infinite, and at the start if the
        rollout does not hold the start. None if there is no such entry, or if the target is not a position.
        """
        ends = self.rollout["next", "state"]
        if name not in ends or (name == "target" and name not in visible_state(ends)):
            return None
        value = ends[name].float()
        start = self.rollout.get(("state", name), torch.full_like(value, math.nan))[:, :1]
        instants = torch.arange(self.rollout.shape[1] + 1).minimum(self.steps[:, None])
        value = torch.cat((start.float(), value), 1).take_along_dim(instants.unsqueeze(-1), 1)
        return value.nan_to_num(math.nan, math.nan, math.nan)

    def solids(self, i: int) -> Primitives | None:
        """The obstacles in the first episode of an environment, if there are any."""
        scene = getattr(self.env, "scene", None)
        if scene is None:
            return None
        drawn = self.rollout["next", "state"].get("scene", {})
        return scene.solids({("scene", kind): x[i : i + 1, 0].to(self.env.device) for kind, x in drawn.items()})

    @property
    def depth(self) -> Tensor | None:
        """What the cameras showed (num_envs, time + 1, height, width) [m], as :meth:`state`, if they did."""
        seen = self.rollout.get(("next", "depth"), None)
        if seen is None:
            return None
        seen = torch.cat((self.rollout.get("depth", seen)[:, :1], seen), 1).squeeze(2)
        instants = torch.arange(seen.shape[1]).minimum(self.steps[:, None])
        return seen[torch.arange(len(seen))[:, None], instants].float()

    @property
    def distance(self) -> np.ndarray | None:
        """The distance to the target (num_envs, time + 1) [m], if there is one."""
        return None if self.target is None else (self.state("position") - self.target).norm(dim=-1).numpy()

    def outputs(self) -> dict[str, np.ndarray]:
        """The metrics of every step, or without any the reward, by name (num_envs, time + 1), NaN at the start."""
        ends = self.rollout["next"]
        values = dict(ends.get("metrics", {}).items()) or {"reward": ends["reward"]}
        return {
            name: torch.nn.functional.pad(x.squeeze(-1).float(), (1, 0), value=math.nan).numpy()
            for name, x in values.items()
        }

    def progress(self) -> tuple[str, bool, np.ndarray, float | None]:
        """What best shows how the flight goes: the label of its axis, whether that is logarithmic, values, and success.

        That is the metric that the task names, else the distance to the target, else the first metric or the reward.
        Success is the value from which a state fulfils the task, if the task says so.
        """
        outputs, name = self.outputs(), self.markers.progress
        if name not in outputs and self.target is not None:
            return f"distance to the {self.markers.target} [m]", self.log_distance, self.distance, self.near_enough
        known = name in outputs
        name = name if known else next(iter(outputs))
        metric = describe_metric(name, self.metric_info)
        success = metric.scale * self.markers.success if known and self.markers.success is not None else None
        return metric.axis_label, metric.log, metric.scale * outputs[name], success

    def progress_lines(self) -> tuple[str, bool, dict[str, np.ndarray]]:
        """All that shows how the flight goes: the label of the axis, whether it is logarithmic, and lines by name.

        These are the distance to the target and the metrics that are lengths; without a target, all metrics or the
        reward.
        """
        outputs = {describe_metric(name, self.metric_info): x for name, x in self.outputs().items()}
        if self.target is None:
            return "", False, {metric.axis_label: metric.scale * x for metric, x in outputs.items()}
        distance = self.distance
        lines = {f"to the {self.markers.target}": distance}
        for metric, x in outputs.items():
            if metric.is_length and not np.allclose(x[:, 1:], distance[:, 1:], atol=1e-5, equal_nan=True):
                lines[metric.label] = x
        return "distance [m]", self.log_distance, lines

    @property
    def log_distance(self) -> bool:
        """Whether the axis of a distance is logarithmic; not on a course, where it jumps from gate to gate."""
        return self.gate_index() is None

    @property
    def near_enough(self) -> float | None:
        """The distance to the target from which a state fulfils the task [m], if the task says so."""
        return self.markers.success if self.markers.progress is None else None

    @property
    def action_names(self) -> list[str]:
        """The names of the entries of an action: those of the environment, else of ``control="rates"``."""
        size = self.rollout["action"].shape[-1]
        names = list(FlightController.action_units if self.env is None else self.env.action_units)
        return names if size == len(names) else [str(i) for i in range(size)]

    def gate_index(self) -> Tensor | None:
        """The index of the gate that each drone flies to (num_envs, time + 1), if the targets are gates."""
        if self.markers.gates is None or self.target is None:
            return None
        gap, index = (self.target.unsqueeze(-2) - self.markers.gates).norm(dim=-1).min(-1)
        return index if gap.nan_to_num(0.0).max() < 1e-3 else None

    def _count_steps(self) -> Tensor:
        if ("next", "done") not in self.rollout.keys(include_nested=True):
            return torch.full(self.rollout.shape[:1], self.rollout.shape[1])
        return first_episode(self.rollout).sum((1, 2))

    def _add_targets(self) -> None:
        """Show where the targets of these episodes have been, if the task shows nothing of them."""
        markers = self.markers
        if self.target is None or markers.places is not None or markers.curve is not None:
            return
        if self.gate_index() is not None:
            return
        moving = (self.target.diff(dim=1).abs() > 0).any(-1).sum()
        if 2 * moving > self.steps.sum():
            known = {"curve": self.target[self.steps.argmax()]}
        else:
            known = {"places": self.target.flatten(0, 1).mul(1e3).round().div(1e3).unique(dim=0)}
        self.markers = dataclasses.replace(markers, **known)


def state_keys(*names: str) -> list[tuple[str, ...]]:
    """The keys of a rollout that hold these entries of the state before and after each step, and the ends."""
    return [*((*prefix, "state", name) for prefix in ((), ("next",)) for name in names), ("next", "done")]


def check_rollout(
    who: str,
    rollout: TensorDictBase,
    env: EnvBase | None,
    needed: list[tuple[str, ...]],
    num_envs: int | None = None,
) -> None:
    """Refuse what cannot be drawn; arguments and errors are those of :class:`Flight`."""
    if env is not None and not (isinstance(env, EnvBase) and hasattr(env, "markers")):
        raise UserTypeError(
            f"{who}: env must be the quadrotor environment that flew, with or without transforms, or None; got "
            f"{type(env).__name__}."
        )
    if rollout.dim() != 2 or 0 in rollout.shape:
        raise UserValueError(
            f"{who} needs a rollout of batch size (num_envs, time), such as env.rollout(...) returns; got "
            f"{tuple(rollout.shape)}. For one drone, write rollout.unsqueeze(0)."
        )
    if num_envs is not None and num_envs < 1:
        raise UserValueError(f"{who}: num_envs must be at least 1, got {num_envs}.")
    keys = rollout.keys(include_nested=True)
    missing = [key for key in needed if key not in keys]
    if missing:
        raise UserValueError(
            f"{who}: the rollout lacks {', '.join(map(str, missing))}. Pass it whole, as env.rollout(...) and "
            "differentiable_rollout(...) return it."
        )
