"""Obstacles and what cameras saw, as pictures show them; and a figure of flights among obstacles, from above."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs.markers import Markers, Shape
from torchrl_quad.envs.scenes import ELSEWHERE
from torchrl_quad.errors import UserValueError
from torchrl_quad.render.canvas import INK, RED, make_figure, save
from torchrl_quad.render.flights import Flight, state_keys
from torchrl_quad.vision import Primitives

GREEN = "#3a7d4f"
_WALL = 5.0  # [m], half of the sides of the square that stands for an endless wall


def obstacle_shapes(solids: Primitives) -> list[Shape]:
    """The obstacles of one scene as one surface; nothing for the ground, and for what has been left out."""
    meshes = []
    for x in solids.spheres[0].tolist():
        meshes.append(Shape.sphere(x[:3], x[3]))
    for x in solids.cylinders[0].tolist():
        meshes.append(Shape.cylinder(x[:3], x[3], x[4]))
    for x in solids.boxes[0].detach().cpu().float():
        meshes.append(_turned(Shape.box(-x[3:6], x[3:6]), x[6:], x[:3]))
    for x in solids.planes[0].detach().cpu().float():
        if x[2].abs() < 0.99:
            across = torch.tensor([-x[1], x[0], 0.0]) / x[:2].norm()
            up = torch.linalg.cross(x[:3], across)
            corners = [a * across + b * up for a, b in ((-1, 0), (1, 0), (1, 1), (-1, 1))]
            meshes.append(Shape(torch.stack([x[3] * x[:3] + _WALL * c for c in corners]), [(0, 1, 2), (0, 2, 3)]))
    meshes = [mesh for mesh in meshes if mesh.points[:, 2].min() > 0.5 * ELSEWHERE]
    if not meshes:
        return []
    first, faces = 0, []
    for mesh in meshes:
        faces.append(mesh.faces + first)
        first += len(mesh.points)
    return [Shape(torch.cat([mesh.points for mesh in meshes]), torch.cat(faces), color=GREEN, opacity=0.6)]


def with_obstacles(markers: Markers, solids: Primitives | None) -> Markers:
    """Markers with the obstacles of a scene, if there are any."""
    shapes = [] if solids is None else obstacle_shapes(solids)
    return dataclasses.replace(markers, shapes=[*markers.shapes, *shapes]) if shapes else markers


def plot_from_above(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    env: EnvBase,
    num_envs: int = 4,
    title: str | None = None,
) -> None:
    """Draw the first episodes of a flight from above: obstacles, and the paths between them, coloured by speed.

    Environments with obstacles of their own get a panel each; those that share them, one for all. A cross marks a
    crash, a ring the start. Drawn is what stands between the least and the greatest height of the flight.

    Args:
        rollout: (num_envs, time), of a task with a scene.
        path: the picture to write, PNG, PDF or SVG by its suffix.
        env: the environment that flew, also under transforms.
        num_envs: how many environments to draw, at most.
        title: of the picture; by default the name of the environment and the number of flights.

    Raises:
        TypeError: ``env`` is not a quadrotor environment.
        ValueError: it has no scene; the rollout has another shape, lacks position or velocity; or ``num_envs`` is less
            than 1.
    """
    flight = Flight("plot_from_above", rollout, env, 0.02, state_keys("position", "velocity"), num_envs)
    if flight.env.scene is None:
        raise UserValueError(
            f"plot_from_above draws obstacles, and this {type(flight.env).__name__} has none: build it with a scene, "
            "or draw its flights with plot_flight."
        )
    from matplotlib.collections import LineCollection

    position, speed = flight.state("position"), flight.state("velocity").norm(dim=-1)
    groups = [[i] for i in range(len(flight))] if flight.env.scene.is_random else [list(range(len(flight)))]
    low, high = (f(position.nan_to_num().flatten(0, 1)) for f in (lambda x: x.amin(0), lambda x: x.amax(0)))
    sides = (high - low)[:2].clamp_min(2.0) + 4.0
    middle, width = 0.5 * (low + high)[:2], 10.0
    left, bottom, right, top = torch.cat((middle - 0.5 * sides, middle + 0.5 * sides)).tolist()
    height = min(0.6 + len(groups) * (0.88 * width * (sides[1] / sides[0]).item() + 0.2), 14.0)
    figure = make_figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    fastest, crash = speed.nan_to_num().amax().item(), flight.rollout.get(("next", "crash"), None)
    for axis, group in zip(axes, groups, strict=True):
        _draw_sections(axis, flight.solids(group[0]), low[2].item(), high[2].item())
        for i in group:
            flown = position[i, : int(flight.steps[i]) + 1, :2].numpy()
            line = LineCollection(list(itertools.pairwise(flown)), cmap="viridis", linewidth=1.8)
            line.set_array(speed[i, : len(flown) - 1].numpy())
            line.set_clim(0.0, fastest)
            axis.add_collection(line)
            axis.plot(*flown[0], marker="o", color=INK, markersize=5, fillstyle="none")
            if crash is not None and crash[i, : int(flight.steps[i])].any():
                axis.plot(*flown[-1], marker="x", color=RED, markersize=9, markeredgewidth=2)
        axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", ylabel="y [m]")
    axes[-1].set_xlabel("x [m]")
    figure.suptitle(flight.title if title is None else title, x=0.02, ha="left", fontsize=12)
    figure.colorbar(line, ax=list(axes), label="speed [m/s]", shrink=0.6, pad=0.01, aspect=30)
    save(figure, path, dpi=130)


def _draw_sections(axis: Any, solids: Primitives, low: float, high: float) -> None:
    """Draw what stands between two heights [m] from above."""
    from matplotlib.patches import Circle, Polygon

    style = {"facecolor": GREEN, "alpha": 0.6, "edgecolor": "none"}
    for x, y, z, radius in solids.spheres[0].tolist():
        if z - radius < high and z + radius > low:
            axis.add_patch(Circle((x, y), radius, **style))
    for x, y, z, radius, height in solids.cylinders[0].tolist():
        if z < high and z + height > low:
            axis.add_patch(Circle((x, y), radius, **style))
    for x in solids.boxes[0].detach().cpu().float():
        box = _turned(Shape.box(-x[3:6], x[3:6]), x[6:], x[:3]).points
        if box[:, 2].min() < high and box[:, 2].max() > low:
            centre = box[:, :2].mean(0)
            around = torch.atan2(*(box[:, :2] - centre).flip(-1).T).argsort()
            axis.add_patch(Polygon(box[around, :2].numpy(), **style))
    for x in solids.planes[0].tolist():
        if abs(x[2]) < 0.99:
            axis.axline((x[3] * x[0], x[3] * x[1]), (x[3] * x[0] - x[1], x[3] * x[1] + x[0]), color=GREEN, linewidth=3)


def depth_image(depth: Tensor, far: float) -> Tensor:
    """A depth image (height, width) [m] from 0 to 1, the nearer the brighter; 0 also where nothing was measured."""
    near = 1.0 - (depth.float().clamp_min(1e-3).log() - math.log(0.3)) / (math.log(far) - math.log(0.3))
    return torch.where(depth > 0.0, near.clamp(0.0, 1.0), 0.0)


def _turned(shape: Shape, attitude: Tensor, centre: Tensor) -> Shape:
    points = centre + quaternion.rotate(attitude.expand(len(shape.points), 4), shape.points)
    return Shape(points, shape.faces)
