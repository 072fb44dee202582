"""Read a rollout as pictures show it: first episodes, targets, obstacles, and how well they go."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.envs import EnvBase

from torchrl_quad.data.unwrap import base_env
from torchrl_quad.dynamics import FlightController, quaternion
from torchrl_quad.envs.markers import Markers, Shape
from torchrl_quad.envs.metrics import Metric, describe_metric, first_episode
from torchrl_quad.envs.scenes import ELSEWHERE
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.render.canvas import GREEN
from torchrl_quad.vision import Primitives

if TYPE_CHECKING:
    from torchrl_quad.envs import QuadrotorEnv

_WALL = 5.0  # [m], half of the sides of the square that stands for an endless wall


class Flight:
    """The first episodes of a rollout, without their graph, on the CPU; of one alone with an ``env_index``.

    ``who`` draws, and needs the keys ``needed``. The other arguments, and errors, are those of :func:`plot_flight`.
    """

    def __init__(
        self,
        who: str,
        rollout: TensorDictBase,
        env: EnvBase | None,
        control_dt: float,
        needed: Sequence[tuple[str, ...]],
        num_envs: int | None = None,
        env_index: int | None = None,
    ) -> None:
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
        keys = rollout.keys(include_nested=True)
        if missing := [str(key) for key in needed if key not in keys]:
            raise UserValueError(
                f"{who}: the rollout lacks {', '.join(missing)}. Pass it whole, as env.rollout(...) and "
                "differentiable_rollout(...) return it."
            )
        if env_index is not None:
            if not -len(rollout) <= env_index < len(rollout):
                raise IndexError(f"{who}: env_index={env_index}, and the rollout has {len(rollout)} environments.")
            rollout = cast("TensorDictBase", rollout[[env_index]])
            rollout = cast("TensorDictBase", rollout[:, : int(first_episode(rollout).sum())])
        self.rollout = cast("TensorDictBase", rollout[:num_envs].detach().cpu())
        self.env = None if env is None else cast("QuadrotorEnv", base_env(env))
        self.control_dt = control_dt if self.env is None else self.env.control_dt
        self.metric_info: Mapping[str, Metric] = {} if self.env is None else self.env.metric_info
        self.steps = torch.full(self.rollout.shape[:1], self.rollout.shape[1])  # of each first episode (num_envs)
        if ("next", "done") in keys:
            self.steps = first_episode(self.rollout).sum((1, 2))
        self.target = self.state("target")
        self.tracks = self.entries("next", "state", "track")  # gates of each environment's own, where it has some
        self.named = self.markers_of(0)  # by the task
        self.markers = self._with_targets()
        # The distance to the target [m] from which a state fulfils the task, if it says so; and whether its axis is
        # logarithmic: not on a course, where it jumps from gate to gate.
        self.near_enough = self.named.success if self.named.progress is None else None
        self.log_distance = self.gate_index() is None

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

    def entry(self, *key: str) -> Tensor | None:
        """An entry of the rollout, if it holds it."""
        return cast("Tensor | None", self.rollout.get(key, None))

    def entries(self, *key: str) -> dict[str, Tensor]:
        """The entries of the rollout below a key, by name; none if it holds none."""
        return dict(cast("Mapping[str, Tensor]", self.rollout.get(key, {})).items())

    def state(self, *name: str) -> Tensor | None:
        """An entry of the state (num_envs, time + 1, k), at the start of the first episode and after each step.

        It ends with the episode's last value, and is NaN where it is infinite or not known. None if there is no such
        entry, or if the target is not a position.
        """
        ends, starts = self.entry("next", "state", *name), self.entry("state", *name)
        if ends is None or (name == ("target",) and ends.shape != self.rollout["next", "state", "position"].shape):
            return None
        start = torch.full_like(ends[:, :1], math.nan) if starts is None else starts[:, :1]
        return self._at_instants(start, ends).nan_to_num(math.nan, math.nan, math.nan)

    def _at_instants(self, start: Tensor, ends: Tensor) -> Tensor:
        """What was at the start (num_envs, 1, ...) and after each step (num_envs, time, ...) of the first episodes."""
        instants = torch.arange(self.rollout.shape[1] + 1).minimum(self.steps[:, None])
        return torch.cat((start, ends), 1)[torch.arange(len(ends))[:, None], instants].float()

    @property
    def position(self) -> Tensor:
        """The positions (num_envs, time + 1, 3) [m], as :meth:`state`; every picture needs them."""
        return cast("Tensor", self.state("position"))

    @property
    def speed(self) -> Tensor:
        """The speed (num_envs, time + 1) [m/s], as :meth:`state`, where the rollout holds the velocity."""
        return cast("Tensor", self.state("velocity")).norm(dim=-1)

    def markers_of(self, i: int) -> Markers:
        """What the task shows for an environment."""
        drawn: Any = {("track", name): x[i : i + 1, 0] for name, x in self.tracks.items()}
        return Markers() if self.env is None else self.env.markers_of(drawn)

    @property
    def has_own_obstacles(self) -> bool:
        """Whether each environment has other obstacles, or gates."""
        return self.env is not None and bool({**self.tracks, **self.entries("next", "state", "scene")})

    def solids(self, i: int) -> Primitives | None:
        """The obstacles in the first episode of an environment, if there are any."""
        if self.env is None or self.env.scene is None:
            return None
        device = self.env.device
        drawn = self.entries("next", "state", "scene")
        return self.env.scene.solids({("scene", kind): x[i : i + 1, 0].to(device) for kind, x in drawn.items()})

    @property
    def depth(self) -> Tensor | None:
        """What the cameras showed (num_envs, time + 1, height, width) [m], as :meth:`state`, if they did."""
        images, first = self.entry("next", "depth"), self.entry("depth")
        if images is None:
            return None
        return self._at_instants((images if first is None else first)[:, :1], images).squeeze(2)

    @property
    def distance(self) -> np.ndarray | None:
        """The distance to the target (num_envs, time + 1) [m], if there is one."""
        return None if self.target is None else (self.position - self.target).norm(dim=-1).numpy()

    def outputs(self) -> dict[str, np.ndarray]:
        """The metrics of every step, or without any the reward, by name (num_envs, time + 1), NaN at the start."""
        values = self.entries("next", "metrics") or {"reward": cast("Tensor", self.entry("next", "reward"))}
        return {name: pad(x.squeeze(-1).float(), (1, 0), value=math.nan).numpy() for name, x in values.items()}

    def progress(self) -> tuple[str, bool, np.ndarray, float | None]:
        """The label of an axis, whether it is logarithmic, values, and the value from which a state fulfils the task.

        They are of the metric that the task names, else of the distance to the target, else of the first metric or the
        reward.
        """
        outputs, distance = self.outputs(), self.distance
        named = self.markers.progress if self.markers.progress in outputs else None
        if named is None and distance is not None:
            return f"distance to the {self.markers.target} [m]", self.log_distance, distance, self.near_enough
        name = named or next(iter(outputs))
        metric = describe_metric(name, self.metric_info)
        success = self.markers.success if named else None
        return metric.axis_label, metric.log, metric.scale * outputs[name], success and metric.scale * success

    def progress_lines(self) -> tuple[str, bool, dict[str, np.ndarray]]:
        """The label of an axis, whether it is logarithmic, and lines by name.

        These are the distance to the target and the metrics that are lengths; without a target, all metrics or the
        reward.
        """
        outputs = {describe_metric(name, self.metric_info): x for name, x in self.outputs().items()}
        if (distance := self.distance) is None:
            return "", False, {metric.axis_label: metric.scale * x for metric, x in outputs.items()}
        lines = {f"to the {self.markers.target}": distance}
        for metric, x in outputs.items():
            if metric.is_length and not np.allclose(x[:, 1:], distance[:, 1:], atol=1e-5, equal_nan=True):
                lines[metric.label] = x
        return "distance [m]", self.log_distance, lines

    @property
    def action_names(self) -> list[str]:
        """The names of the entries of an action: those of the environment, else of ``control="rates"``."""
        size = self.rollout["action"].shape[-1]
        names = list(FlightController.action_units if self.env is None else self.env.action_units)
        return names if size == len(names) else [str(i) for i in range(size)]

    def gate_index(self) -> Tensor | None:
        """The index of the gate that each drone flies to (num_envs, time + 1), if the targets are gates."""
        if self.named.gates is None or self.target is None:
            return None
        gates = self.tracks["gates"][:, :1].float() if "gates" in self.tracks else self.named.gates
        gap, index = (self.target.unsqueeze(-2) - gates).norm(dim=-1).min(-1)
        return index if gap.nan_to_num(0.0).max() < 1e-3 else None

    @property
    def shared_markers(self) -> Markers:
        """The markers without the gates of one environment, where each has its own."""
        return dataclasses.replace(self.markers, gates=None, gate_rims=None, shapes=()) if self.tracks else self.markers

    def _with_targets(self) -> Markers:
        """The markers of the task; if it shows no targets, with where those of these episodes have been."""
        named, target = self.named, self.target
        if target is None or named.places is not None or named.curve is not None or self.gate_index() is not None:
            return named
        moving = (target.diff(dim=1).abs() > 0).any(-1).sum()
        if 2 * moving > self.steps.sum():
            return dataclasses.replace(named, curve=target[self.steps.argmax()])
        return dataclasses.replace(named, places=target.flatten(0, 1).mul(1e3).round().div(1e3).unique(dim=0))


def state_keys(*names: str) -> list[tuple[str, ...]]:
    """The keys of a rollout that hold these entries of the state before and after each step, and the ends."""
    return [*((*prefix, "state", name) for prefix in ((), ("next",)) for name in names), ("next", "done")]


# -- obstacles ---------------------------------------------------------------------------------------------------------


def obstacle_shapes(solids: Primitives | None) -> list[Shape]:
    """The obstacles of one scene as one surface; nothing for the ground, and for what has been left out."""
    if solids is None:
        return []
    meshes = [Shape.sphere(x[:3], x[3]) for x in solids.spheres[0].tolist()]
    meshes += [Shape.cylinder(x[:3], x[3], x[4]) for x in solids.cylinders[0].tolist()]
    meshes += [box_shape(x) for x in solids.boxes[0].detach().cpu().float()]
    meshes += [_wall(x) for x in solids.planes[0].detach().cpu().float() if x[2].abs() < 0.99]
    meshes = [mesh for mesh in meshes if mesh.points[:, 2].min() > 0.5 * ELSEWHERE]
    first = itertools.accumulate((len(mesh.points) for mesh in meshes), initial=0)
    faces = [mesh.faces + i for mesh, i in zip(meshes, first, strict=False)]
    points = [mesh.points for mesh in meshes]
    return [Shape(torch.cat(points), torch.cat(faces), color=GREEN, opacity=0.6)] if points else []


def _wall(plane: Tensor) -> Shape:
    """A square of an upright plane: its normal (3), and its distance from the origin along that."""
    across = torch.tensor([-plane[1], plane[0], 0.0]) / plane[:2].norm()
    up = torch.linalg.cross(plane[:3], across)
    corners = [plane[3] * plane[:3] + _WALL * (a * across + b * up) for a, b in ((-1, 0), (1, 0), (1, 1), (-1, 1))]
    return Shape(torch.stack(corners), torch.tensor([(0, 1, 2), (0, 2, 3)]))


def box_shape(box: Tensor) -> Shape:
    """A box of a scene: centre (3), half of its sides (3) and attitude (4)."""
    shape = Shape.box(-box[3:6], box[3:6])
    points = box[:3] + quaternion.rotate(box[6:].expand(len(shape.points), 4), shape.points)
    return Shape(points, shape.faces)


def with_obstacles(markers: Markers, solids: Primitives | None) -> Markers:
    """Markers with the obstacles of a scene, if there are any."""
    return dataclasses.replace(markers, shapes=[*markers.shapes, *obstacle_shapes(solids)])


def depth_image(depth: Tensor, far: float) -> Tensor:
    """A depth image (height, width) [m] from 0 to 1, the nearer the brighter; 0 also where nothing was measured."""
    near = 1.0 - (depth.float().clamp_min(1e-3).log() - math.log(0.3)) / (math.log(far) - math.log(0.3))
    return torch.where(depth > 0.0, near.clamp(0.0, 1.0), 0.0)
