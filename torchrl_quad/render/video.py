"""Draw drones as arrays of pixels: films, and the frames of ``env.render()``."""

from __future__ import annotations

import contextlib
import itertools
import numbers
import os
import select
import subprocess
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs.markers import Markers
from torchrl_quad.errors import MissingPackage, UserValueError, needing, one_line
from torchrl_quad.files import replacing
from torchrl_quad.options import Positive, Size, checked
from torchrl_quad.render import canvas
from torchrl_quad.render.canvas import INK, RED
from torchrl_quad.render.flights import Flight, depth_image, state_keys, with_obstacles

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from mpl_toolkits.mplot3d.art3d import Line3D

    from torchrl_quad.envs import QuadrotorEnv

_INCHES = 4.2
_PATIENCE = 20.0  # [s], with an ffmpeg that makes no progress
_REINSTALL = "pip install --force-reinstall --no-deps imageio-ffmpeg"
_ARMS = torch.tensor([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [0.0, 0.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])


class NoFfmpeg(MissingPackage):
    """Films cannot be written as MP4 here."""


class View:
    """A view of ``size`` pixels for many frames of the same drones; it draws axes and markers only once.

    The finite ones of the points (*, 3) [m] are in view, with the ground below. ``image`` is the height and width of a
    camera's images [pixels], if a frame shows one.
    """

    def __init__(
        self, points: Tensor, num_drones: int, size: int, markers: Markers, image: Sequence[int] | None = None
    ) -> None:
        low, high = canvas.bounds(points, *markers.points())
        low[2].clamp_(max=0.0)
        self.low, self.high = canvas.box(low, high)
        self.arms = (0.04 * (self.high - self.low).amax()).float() * _ARMS

        dpi = (size + 0.01) / _INCHES  # it rounds down to pixels
        self.figure = canvas.make_figure(figsize=(_INCHES, _INCHES), dpi=dpi)
        self.canvas: FigureCanvasAgg = self.figure.canvas  # pyrefly: ignore[bad-assignment]  as make_figure sets it
        space = canvas.add_space(self.figure, (0.0, 0.02, 0.96, 0.98))
        canvas.set_box(space, self.low, self.high, zoom=0.82)
        canvas.draw_markers(space, markers, size=8)

        def line(**style: Any) -> Line3D:  # drawn onto the axes in each frame
            return cast("Line3D", space.plot([], [], [], animated=True, **style)[0])

        colors = canvas.drone_colors(num_drones)
        self.drones = [line(color=color, linewidth=2.5) for color in colors]
        self.trails = [line(color=color, linewidth=1, alpha=0.5) for color in colors]
        self.targets = line(color=RED, marker="*", markersize=8, linestyle="none")
        self.image = None
        if image is not None:
            inset = self.figure.add_axes((0.66, 0.76, 0.32, 0.22), xticks=[], yticks=[])
            self.image = inset.imshow(np.zeros(tuple(image)), cmap="magma", vmin=0.0, vmax=1.0, animated=True)
        self.text = space.text2D(0.04, 0.94, "", transform=space.transAxes, color=INK, animated=True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def draw(
        self,
        position: Tensor,
        attitude: Tensor,
        target: Tensor | None = None,
        trails: Iterable[Tensor] = (),
        text: str = "",
        image: Tensor | None = None,
    ) -> np.ndarray:
        """A frame (size, size, 3), uint8: positions and targets (num_drones, 3), quaternions (num_drones, 4), a trail
        (*, 3) of each drone, a text in the corner, and the image (height, width) of a camera, from 0 to 1.
        """
        arms = self.arms.to(position.dtype).expand(len(position), -1, -1)
        bodies = position.unsqueeze(1) + quaternion.rotate(attitude.unsqueeze(1), arms)
        for drone, body in zip(self.drones, bodies, strict=True):
            drone.set_data_3d(*_numpy(body).T)
        for line, trail in zip(self.trails, trails, strict=False):
            line.set_data_3d(*_numpy(trail).T)
        if target is not None:
            self.targets.set_data_3d(*_numpy(target).T)
        self.text.set_text(text)
        self.canvas.restore_region(self.background)
        for artist in (*self.trails, self.targets, *self.drones, self.text):
            self.figure.draw_artist(artist)
        if self.image is not None and image is not None:
            self.image.set_data(_numpy(image))
            self.figure.draw_artist(self.image)
        return np.array(self.canvas.buffer_rgba())[..., :3].copy()


@checked
def animate_flight(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    env: EnvBase | None = None,
    num_envs: Size = 6,
    control_dt: Positive = 0.02,
    fps: Positive = 15,
    max_seconds: Positive = 12.0,
    size: Size = 336,
    beside: TensorDictBase | None = None,
    labels: tuple[str, str] = ("", ""),
) -> None:
    """Film the first episodes of a flight in real time: drones with trails, their targets, and the task's markers.

    A task with a camera shows the first drone's depth image, the nearer the brighter. Where each episode has obstacles
    of its own, the film shows only the first environment. The other arguments, and errors, are those of
    :func:`plot_flight`; the rollout needs the quaternion.

    Args:
        path: the film to write: GIF, or MP4 (H.264) with ``imageio-ffmpeg`` of the extra ``render``, by its suffix.
        fps: frames per second, at least; up to 50, and rounded up so that a frame lasts whole control steps.
        max_seconds: the maximum length of the film.
        size: width and height [pixels], rounded up to an even number.
        beside: another flight of the same task, (num_envs, time), to film to the right of the first, in the same view.
        labels: a word for each of the two, in their corners.

    Raises:
        NoFfmpeg: no ffmpeg works, for an MP4; an ImportError.
    """
    write = {".gif": _write_gif, ".mp4": _write_mp4}.get(Path(path).suffix.lower())
    if write is None:
        raise UserValueError(f"animate_flight writes .gif and .mp4, got {Path(path).name}.")
    needed = state_keys("position", "quaternion")
    both = [rollout] if beside is None else [rollout, beside]
    flights = [Flight("animate_flight", x, env, control_dt, needed, num_envs) for x in both]
    if flights[0].has_own_obstacles:
        flights = [Flight("animate_flight", x, env, control_dt, needed, 1) for x in both]
    control_dt, camera = flights[0].control_dt, None if flights[0].env is None else flights[0].env.camera
    last = min(max(round(max_seconds / control_dt), 1), *(x.shape[1] for x in both))  # step
    everywhere = torch.cat([flight.position[:, : last + 1].flatten(0, 1) for flight in flights])
    trail = max(round(1.0 / control_dt), 1)
    stride = max(int(1.0 / (min(fps, 50) * control_dt) + 1e-6), 1)
    instants = np.append(np.arange(0, last, stride), last)

    def pictures(flight: Flight, label: str) -> Iterator[np.ndarray]:
        images = None if flight.depth is None else depth_image(flight.depth[0], camera.range if camera else 10.0)
        pixels, markers = None if images is None else images.shape[1:], with_obstacles(flight.markers, flight.solids(0))
        view = View(everywhere, len(flight), size + size % 2, markers, pixels)
        position, attitude, target = flight.position, cast("Tensor", flight.state("quaternion")), flight.target
        for t in instants:
            aim, image = None if target is None else target[:, t], None if images is None else images[t]
            trails, text = position[:, max(t - trail, 0) : t + 1], f"{control_dt * t:.1f} s  {label}".rstrip()
            yield view.draw(position[:, t], attitude[:, t], aim, trails, text=text, image=image)

    films = map(pictures, flights, labels)
    frames = (np.concatenate(parts, 1) for parts in zip(*films, strict=True))
    with replacing(path) as temporary:
        write(temporary, frames, control_dt * np.append(instants, instants[-1] + stride))


def _write_gif(path: Path, frames: Iterator[np.ndarray], times: np.ndarray) -> None:
    """Write frames, each shown from its time [s] to the next; the last of the times is the end."""
    from PIL import Image

    # A GIF counts in 10 ms: rounded instants keep step with the clock where rounded intervals would not.
    durations = 10 * np.diff(np.round(100 * times))
    first, *rest = map(Image.fromarray, frames)
    first.save(path, save_all=True, append_images=rest, duration=durations.tolist(), loop=0)


def _write_mp4(path: Path, frames: Iterator[np.ndarray], times: np.ndarray) -> None:
    """The same in equal intervals: the last frame, of the end, may come later than its time by less than one."""
    with needing("Films in MP4 need imageio-ffmpeg: pip install '.[render]' in a clone.", NoFfmpeg):
        from imageio_ffmpeg import get_ffmpeg_exe
    first, rate = next(frames), Fraction(1.0 / (times[-1] - times[-2])).limit_denominator()
    source = f"-f rawvideo -pix_fmt rgb24 -s {first.shape[1]}x{first.shape[0]} -r {rate} -i -".split()
    target = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart", "-f", "mp4"]
    exe, whole, why = "ffmpeg", False, f"no progress for {_PATIENCE:g} s"
    with tempfile.TemporaryFile() as log:
        try:
            exe = get_ffmpeg_exe()
            command = [exe, "-y", "-v", "error", *source, *target, f"file:{path.absolute()}"]
            process = subprocess.Popen(command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log)
        except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: imageio-ffmpeg finds none
            raise _no_ffmpeg(exe, one_line(error)) from error
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):  # it hangs
                with contextlib.suppress(BrokenPipeError), cast("IO[bytes]", process.stdin) as pipe:  # it has ended
                    os.set_blocking(pipe.fileno(), False)
                    for frame in itertools.chain([first], frames):
                        rest = memoryview(frame.tobytes())
                        while rest:
                            if not select.select([], [pipe], [], _PATIENCE)[1]:
                                raise subprocess.TimeoutExpired(exe, _PATIENCE)
                            rest = rest[os.write(pipe.fileno(), rest) :]
                    whole = True
                why = f"exit status {process.wait(_PATIENCE)}"
        finally:
            process.kill()
            process.wait()
        if not whole or process.returncode or not (path.exists() and path.stat().st_size):
            log.seek(0)
            said = one_line(log.readline(200).decode(errors="replace"))
            raise _no_ffmpeg(exe, f"{why}: {said}" if said else why)


def _no_ffmpeg(exe: str, why: str) -> NoFfmpeg:
    mend = "unset IMAGEIO_FFMPEG_EXE" if os.environ.get("IMAGEIO_FFMPEG_EXE") else _REINSTALL
    return NoFfmpeg(
        f"Films in MP4 need an ffmpeg that writes H.264, and {exe} does not ({why}). Write a GIF, or {mend}."
    )


# The views of each environment, by number of drones, size and obstacles. They are kept outside the environment, which
# can be copied and sent to other processes.
_views: weakref.WeakKeyDictionary[EnvBase, dict[tuple[int, int, bytes], View]] = weakref.WeakKeyDictionary()


def draw_frame(env: QuadrotorEnv, drones: Sequence[int] | None, size: int) -> np.ndarray:
    """Draw an environment as it is; see :meth:`~torchrl_quad.envs.QuadrotorEnv.render`."""
    if not env.render_state:
        raise UserValueError("render() draws the state after the last reset or step. Call env.reset() first.")
    state = {key: x for key, x in env.render_state.items() if isinstance(key, str)}
    obstacles = {key: x for key, x in env.render_state.items() if key not in state}  # each environment has its own
    chosen = list(range(min(env.num_envs, 1 if obstacles else 6)) if drones is None else drones)
    if not chosen or not all(isinstance(i, numbers.Integral) and 0 <= i < env.num_envs for i in chosen):
        raise UserValueError(
            f"render: drones are indices from 0 to {env.num_envs - 1}, at least one, such as drones=[0]; got {chosen}."
        )
    if size < 100:
        raise UserValueError(f"render: size must be at least 100 pixels, got {size}.")
    shown = {key: x[chosen].cpu() for key, x in state.items()}
    obstacles = {key: x[chosen[:1]] for key, x in obstacles.items()}
    solids = None if env.scene is None else env.scene.solids(obstacles)
    named = env.markers_of(obstacles)
    image = None
    if env.camera is not None and solids is not None:
        depth = env.camera.depth(solids, state["position"][chosen[:1]], state["quaternion"][chosen[:1]])
        image = depth_image(depth[0, 0], env.camera.range)
    views = _views.setdefault(env, {})
    # Another episode may have other obstacles.
    kind = len(chosen), size, b"".join(_numpy(x).tobytes() for x in obstacles.values())
    view = views.get(kind)
    if view is None:  # half a metre of room around all drones, their targets and the markers
        low, high = canvas.bounds(*(x for key, x in state.items() if key != "quaternion"), *named.points())
        low, high = low - torch.tensor([0.5, 0.5, 0.0]), high + 0.5
    else:  # a side that has become too near moves out by half of the view, so that it need not at every step
        low, high = canvas.bounds(*(x for key, x in shown.items() if key != "quaternion"), view.low, view.high)
        room = 0.5 * (view.high - view.low)
        low, high = low - room * (low < view.low), high + room * (high > view.high)
    if view is None or (low < view.low).any() or (high > view.high).any():
        if obstacles:
            views.clear()  # of episodes that are over
        markers, pixels = with_obstacles(named, solids), None if image is None else image.shape
        views[kind] = view = View(torch.stack((low, high)), len(chosen), size, markers, pixels)
    return view.draw(shown["position"], shown["quaternion"], shown.get("target"), image=image)


def _numpy(x: Tensor) -> np.ndarray:
    return x.numpy(force=True)
