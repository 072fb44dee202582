"""Figures and axes: colours, limits and scales that all pictures share."""

from __future__ import annotations

import io
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.envs.markers import Markers
from torchrl_quad.errors import needing
from torchrl_quad.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

INK, BLUE, RED, GREEN = "#222222", "#2f6db5", "#c8452f", "#3a7d4f"


def make_figure(**options: Any) -> Figure:
    """A matplotlib figure that needs no screen, leaves the user's backend alone, and shows itself in a notebook."""
    with needing("Pictures need matplotlib: pip install '.[render]' in a clone."):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(**options)
    FigureCanvasAgg(figure)
    vars(figure)["_repr_png_"] = partial(png, figure)  # notebooks show only figures of pyplot without it
    return figure


def png(figure: Figure, dpi: int = 100) -> bytes:
    """A figure as the content of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def save(figure: Figure, path: str | Path | None, **options: Any) -> Figure:
    """Return a figure, and write it if there is a path, complete or not at all; without a suffix it gets .png."""
    if path is not None:
        path = Path(path)
        with replacing(path if path.suffix else path.with_suffix(".png")) as temporary:
            figure.savefig(temporary, **options)
    return figure


def bounds(*points: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the greatest coordinates (3) of the finite points, each (*, 3); those of a cube if none is."""
    rows = torch.cat([x.detach().cpu().double().reshape(-1, 3) for x in points])
    rows = rows[rows.isfinite().all(-1)]
    if not len(rows):
        rows = torch.tensor([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]])
    return rows.amin(0), rows.amax(0)


def box(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Widen a box, from low to high (3), until no side is much shorter than the others, but not to below the ground."""
    extent = high - low
    more = 0.5 * ((0.6 * extent.amax().clamp_min(0.5)) - extent).clamp_min(0.0)
    ground = torch.minimum(low, torch.zeros_like(low))
    bottom = low - more
    lift = (ground - bottom).clamp_min(0.0) * torch.tensor([0.0, 0.0, 1.0])
    return bottom + lift, high + more + lift


def add_space(figure: Figure, place: tuple[float, float, float, float], **options: Any) -> Axes3D:
    """Add three-dimensional axes at a place: left, bottom, width and height as shares of the figure."""
    return cast("Axes3D", figure.add_axes(place, projection="3d", **options))


def set_box(space: Axes3D, low: Tensor, high: Tensor, zoom: float) -> None:
    """Limit three-dimensional axes to the box from low to high (3), in one scale and with few ticks."""
    from matplotlib.ticker import MaxNLocator

    space.set_box_aspect((high - low).tolist(), zoom=zoom)
    for name, *limits in zip("xyz", low.tolist(), high.tolist(), strict=True):
        axis = getattr(space, f"{name}axis")
        axis.set_major_locator(MaxNLocator(3))
        axis.set_tick_params(pad=-1, labelsize=8)
        axis.labelpad = -2
        space.set(**{f"{name}lim": limits, f"{name}label": f"{name} [m]"})


def set_scale(axis: Axes, log: bool) -> None:
    """Make the vertical axis linear or logarithmic, with plain numbers at its ticks."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_yscale("log" if log else "linear")
    if log:
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.yaxis.set_minor_formatter(NullFormatter())
    axis.yaxis.set_major_formatter("{x:g}")


def draw_markers(space: Axes3D, markers: Markers, size: float = 12.0) -> None:
    """Draw markers into three-dimensional axes, with names for a legend; ``size`` is of the stars [points]."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    for shape in markers.shapes:
        if shape.faces is None:
            space.plot(*shape.points.T.numpy(), color=shape.color, linewidth=1.5, zorder=2, label=shape.name or None)
        else:
            triangles = shape.points[shape.faces].numpy()
            style = {"facecolors": shape.color, "alpha": shape.opacity, "linewidths": 0, "shade": True}
            space.add_collection(Poly3DCollection(triangles, **style, zorder=2, label=shape.name or None))
    if markers.curve is not None:
        space.plot(*markers.curve.T.numpy(), color=RED, linestyle="--", linewidth=1.0, label=markers.target, zorder=3)
    if markers.places is not None:
        star = {"marker": "*", "color": RED, "s": size**2}
        space.scatter(*markers.places.T.numpy(), label=markers.target, zorder=10, **star)
    if (rings := markers.rings()) is not None:
        space.add_collection(Line3DCollection(list(rings.numpy()), color=RED, linewidth=1.8, zorder=10, label="gate"))


def drone_colors(count: int) -> np.ndarray:
    """A colour for each of a number of drones, (count, 4)."""
    from matplotlib import colormaps

    return colormaps["viridis"](np.linspace(0.05, 0.85, count))
