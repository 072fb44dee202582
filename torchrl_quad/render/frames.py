"""Drones at an instant as arrays of pixels: what films and ``env.render()`` are made of."""

from __future__ import annotations

import math
import numbers
import weakref
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs import QuadrotorEnv, RacingEnv, TrackingEnv
from torchrl_quad.envs.base import drawn

INK, BLUE, RED = "#222222", "#2f6db5", "#c8452f"
_DOTS_PER_INCH = 80
_ARMS = torch.tensor([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [0.0, 0.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])


class Scene:
    """A view into which drones are drawn again and again; axes, and what stands still, are drawn once.

    Args:
        points: (*, 3) [m]; those that are finite, and the ground below, are in view.
        num_drones: how many are drawn into a frame.
        size: of the edges of a frame [pixels].
        places: (*, 3) [m], where targets stand still.
        curve: (*, 3) [m], along which targets move.
    """

    def __init__(
        self,
        points: Tensor,
        num_drones: int,
        size: int,
        *,
        places: Tensor | None = None,
        curve: Tensor | None = None,
    ) -> None:
        low, high = bounds(*(x for x in (points, places, curve) if x is not None))
        low[2].clamp_(max=0.0)
        self.low, self.high = box(low, high)
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


def draw_frame(env: QuadrotorEnv, state: Mapping[str, Tensor], drones: Sequence[int] | None, size: int) -> np.ndarray:
    """A state of an environment as a frame; see :meth:`~torchrl_quad.envs.QuadrotorEnv.render`."""
    chosen = list(range(min(env.num_envs, 6)) if drones is None else drones)
    if not chosen or not all(isinstance(i, numbers.Integral) and 0 <= i < env.num_envs for i in chosen):
        raise ValueError(
            f"render: drones are indices from 0 to {env.num_envs - 1}, at least one, such as drones=[0]; got {chosen}."
        )
    if size < 100:
        raise ValueError(f"render: size must be at least 100 pixels, got {size}.")
    shown = {key: x[chosen].cpu() for key, x in state.items()}
    points = [x for key, x in shown.items() if key != "quaternion"]
    scenes = _scenes.setdefault(env, {})
    scene = scenes.get((len(chosen), size))
    if scene is None:  # what the task shows, and half a metre around it
        starts = (env.fallback[key] for key in shown if key != "quaternion")
        low, high = bounds(*points, *starts, *scenery(env).values())
        low, high = low - torch.tensor([0.5, 0.5, 0.0]), high + 0.5
    else:  # to the sides that have become too near it grows by half, so that it need not at every step
        low, high = bounds(*points, scene.low, scene.high)
        room = 0.5 * (scene.high - scene.low)
        low, high = low - room * (low < scene.low), high + room * (high > scene.high)
    if scene is None or (low < scene.low).any() or (high > scene.high).any():
        corners = torch.stack((low, high))
        scenes[len(chosen), size] = scene = Scene(corners, len(chosen), size, **scenery(env))
    return scene.draw(*shown.values())


def scenery(env: QuadrotorEnv) -> dict[str, Tensor]:
    """What of a task stands still, as keywords of :class:`Scene`."""
    if isinstance(env, RacingEnv):
        return {"places": env.gates}
    if isinstance(env, TrackingEnv):
        phase = torch.linspace(0, 2 * math.pi, 129, device=env.device, dtype=env.dtype)
        return {"curve": env.curve(phase)}
    return {}


# -- what all pictures share -------------------------------------------------------------------------------------------


def checked(rollout: TensorDictBase, who: str, num_envs: int | None, *keys: tuple[str, ...]) -> TensorDictBase:
    """The first environments of a rollout, all for None, without graph and on the CPU, if it has these entries."""
    if rollout.dim() != 2 or 0 in rollout.shape:
        raise ValueError(
            f"{who} needs a rollout of batch size (num_envs, time), such as env.rollout(...) returns; got "
            f"{tuple(rollout.shape)}. Of one drone, write rollout.unsqueeze(0)."
        )
    if num_envs is not None and num_envs < 1:
        raise ValueError(f"{who}: num_envs must be at least 1, got {num_envs}.")
    entries = rollout.keys(include_nested=True)
    missing = [key for key in keys if key not in entries]
    if missing:
        raise ValueError(
            f"{who}: the rollout lacks {', '.join(map(str, missing))}. Hand it over whole, as env.rollout(...) and "
            "differentiable_rollout(...) return it."
        )
    return rollout[:num_envs].detach().cpu()


def episode_steps(flight: TensorDictBase) -> Tensor:
    """The control steps of the first episodes of a flight (num_envs, time), (num_envs)."""
    if ("next", "done") not in flight.keys(include_nested=True):
        return torch.full(flight.shape[:1], flight.shape[1])
    return QuadrotorEnv.first_episode(flight).sum((1, 2))


def first_episodes(flight: TensorDictBase, name: str) -> Tensor | None:
    """An entry of the state (num_envs, time + 1, k): where first episodes start, and what each step has led to.

    It stays as it was at the end of the episode, and is NaN where it is infinite, and at a start of which nothing is
    known. None where there is no such entry, or the target is no position.
    """
    ends = flight["next", "state"]
    if name not in ends or (name == "target" and name not in drawn(ends)):
        return None
    value = ends[name].float()
    start = flight.get(("state", name), torch.full_like(value, math.nan))[:, :1]
    instants = torch.arange(flight.shape[1] + 1).minimum(episode_steps(flight)[:, None])
    value = torch.cat((start.float(), value), 1).take_along_dim(instants.unsqueeze(-1), 1)
    return value.nan_to_num(math.nan, math.nan, math.nan)


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


def bounds(*points: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the greatest coordinates (3) of those points, each (*, 3), that are finite; a cube if none is."""
    rows = torch.cat([x.detach().cpu().double().reshape(-1, 3) for x in points])
    rows = rows[rows.isfinite().all(-1)]
    if not len(rows):
        rows = torch.tensor([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]])
    return rows.amin(0), rows.amax(0)


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
