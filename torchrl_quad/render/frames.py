"""Drones at an instant as arrays of pixels: what films and ``env.render()`` are made of."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs import QuadrotorEnv, RacingEnv, TrackingEnv

INK, BLUE, RED = "#222222", "#2f6db5", "#c8452f"
SIZE = 336  # [pixels], of the edges of a frame
_DOTS_PER_INCH = 80
_ARMS = torch.tensor([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [0.0, 0.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])


class Scene:
    """A view into which drones are drawn again and again; axes, and what stands still, are drawn once.

    Args:
        points: (*, 3) [m]; all of them, and the ground below, are in view.
        num_drones: how many are drawn into a frame.
        places: (*, 3) [m], where targets stand still.
        curve: (*, 3) [m], along which targets move.
        size: of the edges of a frame [pixels].
    """

    def __init__(
        self,
        points: Tensor,
        num_drones: int,
        *,
        places: Tensor | None = None,
        curve: Tensor | None = None,
        size: int = SIZE,
    ) -> None:
        points = torch.cat([x.detach().cpu().double().reshape(-1, 3) for x in (points, places, curve) if x is not None])
        self.low, self.high = points.amin(0), points.amax(0)
        self.low[2].clamp_(max=0.0)
        self.low, self.high = box(self.low, self.high)
        extent = self.high - self.low
        self.arms = (0.04 * extent.amax()).float() * _ARMS

        self.figure = make_figure(figsize=(size / _DOTS_PER_INCH, size / _DOTS_PER_INCH), dpi=_DOTS_PER_INCH)
        space = self.figure.add_axes((0.0, 0.02, 0.96, 0.98), projection="3d")
        set_box(space, self.low, self.high, zoom=0.82)
        if curve is not None:
            space.plot(*_numpy(curve).T, color=RED, linestyle="--", linewidth=1)
        if places is not None:
            space.plot(*_numpy(places).T, color=RED, marker="o", markersize=11, fillstyle="none", linestyle="none")
        moving = {"animated": True}  # drawn onto the axes in each frame
        colors = shades(num_drones)
        self.drones = [space.plot([], [], [], color=color, linewidth=2.5, **moving)[0] for color in colors]
        self.trails = [space.plot([], [], [], color=color, linewidth=1, alpha=0.5, **moving)[0] for color in colors]
        (self.targets,) = space.plot([], [], [], color=RED, marker="*", markersize=8, linestyle="none", **moving)
        self.text = space.text2D(0.04, 0.94, "", transform=space.transAxes, color=INK, **moving)
        self.figure.canvas.draw()
        self.background = self.figure.canvas.copy_from_bbox(self.figure.bbox)

    def draw(
        self,
        position: Tensor,
        attitude: Tensor,
        target: Tensor | None = None,
        trails: Iterable[Tensor] = (),
        text: str = "",
    ) -> np.ndarray:
        """A frame (size, size, 3), uint8.

        Args:
            position: of the drones (num_drones, 3) [m].
            attitude: their quaternions (num_drones, 4).
            target: where they are to be (num_drones, 3) [m].
            trails: the line (*, 3) [m] that each has flown.
            text: for the corner.
        """
        bodies = position.unsqueeze(1) + quaternion.rotate(
            attitude.unsqueeze(1), self.arms.to(position.dtype).expand(len(position), -1, -1)
        )
        for drone, body in zip(self.drones, bodies, strict=True):
            drone.set_data_3d(*_numpy(body).T)
        for line, trail in zip(self.trails, trails, strict=False):
            line.set_data_3d(*_numpy(trail).T)
        if target is not None:
            self.targets.set_data_3d(*_numpy(target).T)
        self.text.set_text(text)
        self.figure.canvas.restore_region(self.background)
        for artist in (*self.trails, self.targets, *self.drones, self.text):
            self.figure.draw_artist(artist)
        return np.array(self.figure.canvas.buffer_rgba())[..., :3].copy()


# The views of an environment, by how many drones they show and their size. They are not kept in the environment, which
# can be copied and sent to other processes.
_scenes: weakref.WeakKeyDictionary[QuadrotorEnv, dict[tuple[int, int], Scene]] = weakref.WeakKeyDictionary()


def draw_frame(
    env: QuadrotorEnv, state: Mapping[str, Tensor], drones: Sequence[int] | None, size: int = SIZE
) -> np.ndarray:
    """A state of an environment as a frame; see :meth:`~torchrl_quad.envs.QuadrotorEnv.render`."""
    chosen = list(range(min(env.num_envs, 6)) if drones is None else drones)
    if not chosen or not all(isinstance(i, int) and 0 <= i < env.num_envs for i in chosen):
        raise ValueError(
            f"render: drones are indices from 0 to {env.num_envs - 1}, at least one, such as drones=[0]; got {chosen}."
        )
    if size < 100:
        raise ValueError(f"render: size must be at least 100 pixels, got {size}.")
    shown = [state[key][chosen].cpu() for key in ("position", "quaternion", "target") if key in state]
    points = torch.cat(shown[::2]).double()
    scenes = _scenes.setdefault(env, {})
    scene = scenes.get((len(chosen), size))
    if scene is None:  # what the task shows, and half a metre around it
        more = [*(env.fallback[key] for key in ("position", "target") if key in env.fallback), *scenery(env).values()]
        points = torch.cat((points, *(x.detach().cpu().reshape(-1, 3) for x in more)))
        low, high = points.amin(0) - torch.tensor([0.5, 0.5, 0.0]), points.amax(0) + 0.5
    else:  # to the sides that have become too near it grows by half, so that it need not at every step
        low, high, room = points.amin(0), points.amax(0), 0.5 * (scene.high - scene.low)
        low = torch.where(low < scene.low, low - room, scene.low)
        high = torch.where(high > scene.high, high + room, scene.high)
    if scene is None or (low < scene.low).any() or (high > scene.high).any():
        corners = torch.stack((low, high))
        scenes[len(chosen), size] = scene = Scene(corners, len(chosen), **scenery(env), size=size)
    return scene.draw(*shown)


def scenery(env: QuadrotorEnv) -> dict[str, Tensor]:
    """What of a task stands still, as keywords of :class:`Scene`."""
    if isinstance(env, RacingEnv):
        return {"places": env.gates}
    if isinstance(env, TrackingEnv):
        phase = torch.linspace(0, 2 * math.pi, 129, device=env.device, dtype=env.dtype)
        return {"curve": env.curve(phase)}
    return {}


# -- what figures share with it ----------------------------------------------------------------------------------------


def make_figure(**options: Any) -> Any:
    """A matplotlib figure that neither asks for a screen nor changes the user's backend."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("Pictures need matplotlib: pip install 'torchrl_quad[render]'.") from error
    figure = Figure(**options)
    FigureCanvasAgg(figure)
    return figure


def box(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The corners (3) of a box around that from low to high (3) in which no side is much shorter than the others.

    It grows to both sides but, of what is above the ground, upwards alone.
    """
    extent = high - low
    more = 0.5 * ((0.6 * extent.amax().clamp_min(0.5)) - extent).clamp_min(0.0)
    ground = torch.minimum(low, torch.zeros_like(low))
    bottom = low - more
    lift = (ground - bottom).clamp_min(0.0) * torch.tensor([0.0, 0.0, 1.0])
    return bottom + lift, high + more + lift


def set_box(space: Any, low: Tensor, high: Tensor, zoom: float) -> None:
    """Let the axes of a space, in one scale and with few ticks, go from low to high (3)."""
    from matplotlib.ticker import MaxNLocator

    space.set_box_aspect((high - low).tolist(), zoom=zoom)
    for name, *limits in zip("xyz", low.tolist(), high.tolist(), strict=True):
        axis = getattr(space, f"{name}axis")
        axis.set_major_locator(MaxNLocator(3))
        axis.set_tick_params(pad=-1, labelsize=8)
        axis.labelpad = -2
        space.set(**{f"{name}lim": limits, f"{name}label": f"{name} [m]"})


def shades(count: int) -> np.ndarray:
    """Colours of a number of drones, (count, 4)."""
    from matplotlib import colormaps

    return colormaps["viridis"](np.linspace(0.05, 0.85, count))


def _numpy(x: Tensor) -> np.ndarray:
    return x.numpy(force=True)
