"""Draw drones as arrays of pixels: films, and the frames of ``env.render()``."""

from __future__ import annotations

import itertools
import numbers
import os
import subprocess
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import IO

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.data.unwrap import base_env
from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs.markers import Markers
from torchrl_quad.errors import MissingPackage, UserValueError
from torchrl_quad.files import replacing
from torchrl_quad.render.canvas import INK, RED, bounds, box, draw_markers, drone_colors, make_figure, set_box
from torchrl_quad.render.flights import Flight, state_keys
from torchrl_quad.render.obstacles import depth_image, with_obstacles

_INCHES = 4.2
_REINSTALL = "pip install --force-reinstall --no-deps imageio-ffmpeg"
_ARMS = torch.tensor([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [0.0, 0.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])


class NoFfmpeg(MissingPackage):
    """Films cannot be written as MP4 here."""


class Scene:
    """A view for many frames of the same drones; it draws axes and markers only once.

    Args:
        points: (*, 3) [m]; the finite ones, and the ground below, are in view.
        num_drones: how many drones a frame shows.
        size: width and height of a frame [pixels].
        markers: what to draw beside the drones.
        image: the height and width of a camera's images [pixels], if a frame shows one.
    """

    def __init__(
        self, points: Tensor, num_drones: int, size: int, markers: Markers, image: tuple[int, int] | None = None
    ) -> None:
        low, high = bounds(points, *markers.points())
        low[2].clamp_(max=0.0)
        self.low, self.high = box(low, high)
        extent = self.high - self.low
        self.arms = (0.04 * extent.amax()).float() * _ARMS

        self.figure = make_figure(figsize=(_INCHES, _INCHES), dpi=(size + 0.01) / _INCHES)
        space = self.figure.add_axes((0.0, 0.02, 0.96, 0.98), projection="3d")
        set_box(space, self.low, self.high, zoom=0.82)
        draw_markers(space, markers, size=8)
        animated = {"animated": True}  # drawn onto the axes in each frame
        colors = drone_colors(num_drones)
        self.drones = [space.plot([], [], [], color=color, linewidth=2.5, **animated)[0] for color in colors]
        self.trails = [space.plot([], [], [], color=color, linewidth=1, alpha=0.5, **animated)[0] for color in colors]
        (self.targets,) = space.plot([], [], [], color=RED, marker="*", markersize=8, linestyle="none", **animated)
        self.image = None
        if image is not None:
            inset = self.figure.add_axes((0.66, 0.76, 0.32, 0.22))
            inset.set(xticks=[], yticks=[])
            style = {"cmap": "magma", "vmin": 0.0, "vmax": 1.0, "animated": True}
            self.image = inset.imshow(np.zeros(image), **style)
        self.text = space.text2D(0.04, 0.94, "", transform=space.transAxes, color=INK, **animated)
        self.figure.canvas.draw()
        self.background = self.figure.canvas.copy_from_bbox(self.figure.bbox)

    def draw(
        self,
        position: Tensor,
        attitude: Tensor,
        target: Tensor | None = None,
        trails: Iterable[Tensor] = (),
        text: str = "",
        image: Tensor | None = None,
    ) -> np.ndarray:
        """Draw a frame (size, size, 3), uint8.

        Args:
            position: of the drones (num_drones, 3) [m].
            attitude: their quaternions (num_drones, 4).
            target: of each drone (num_drones, 3) [m].
            trails: the line (*, 3) [m] that each drone has flown.
            text: for the corner.
            image: of a camera (height, width), from 0 to 1.
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
        images = () if self.image is None or image is None else (self.image,)
        for artist in images:
            artist.set_data(_numpy(image))
        for artist in (*self.trails, self.targets, *self.drones, self.text, *images):
            self.figure.draw_artist(artist)
        return np.array(self.figure.canvas.buffer_rgba())[..., :3].copy()


def animate_flight(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    env: EnvBase | None = None,
    num_envs: int = 6,
    control_dt: float = 0.02,
    fps: int = 15,
    max_seconds: float = 12.0,
    size: int = 336,
    beside: TensorDictBase | None = None,
    labels: tuple[str, str] = ("", ""),
) -> None:
    """Film the first episodes of a flight in real time: drones with trails, their targets, and the task's markers.

    A task with a camera shows what the first drone saw, the nearer the brighter. Where each episode has obstacles of
    its own, the film shows the first environment alone.

    Args:
        rollout: (num_envs, time), of any task.
        path: the film to write: GIF, or MP4 (H.264) with ``imageio-ffmpeg`` of the extra ``render``, by its suffix.
        env: the environment that flew, also under transforms. It provides the control step and the markers; without
            it, the film shows the targets in the rollout.
        num_envs: how many environments to show, at most.
        control_dt: control step [s]; used only without ``env``.
        fps: frames per second, at least; up to 50, and rounded up so that a frame lasts whole control steps.
        max_seconds: the length of the film, at most.
        size: width and height [pixels], rounded up to an even number.
        beside: another flight of the same task, (num_envs, time), to film to the right of the first, in the same view.
        labels: a word for each of the two, in their corners.

    Raises:
        ImportError: ``path`` is an MP4, and there is no ffmpeg that works: :class:`NoFfmpeg`.
        TypeError: ``env`` is not a quadrotor environment.
        ValueError: the rollout has another shape or lacks the position or the quaternion, a number is not positive, or
            the suffix is another.
    """
    write = {".gif": _write_gif, ".mp4": _write_mp4}.get(Path(path).suffix.lower())
    if write is None:
        raise UserValueError(f"animate_flight writes .gif and .mp4, got {Path(path).name}.")
    for name, value in (("control_dt", control_dt), ("fps", fps), ("max_seconds", max_seconds), ("size", size)):
        if not value > 0:
            raise UserValueError(f"animate_flight: {name} must be positive, got {value!r}.")
    scene = getattr(None if env is None else base_env(env), "scene", None)
    num_envs = 1 if scene is not None and scene.is_random else num_envs
    needed = state_keys("position", "quaternion")
    both = [rollout] if beside is None else [rollout, beside]
    flights = [Flight("animate_flight", x, env, control_dt, needed, num_envs) for x in both]
    control_dt = flights[0].control_dt
    last = min(max(round(max_seconds / control_dt), 1), *(x.shape[1] for x in both))  # step
    paths = [flight.state("position")[:, : last + 1] for flight in flights]
    view = torch.cat([path.flatten(0, 1) for path in paths])
    seen = [flight.depth for flight in flights]
    far = getattr(getattr(flights[0].env, "camera", None), "range", 10.0)
    scenes = [
        Scene(
            view,
            len(flight),
            size + size % 2,
            with_obstacles(flight.markers, flight.solids(0)),
            image=None if depth is None else depth.shape[-2:],
        )
        for flight, depth in zip(flights, seen, strict=True)
    ]
    attitudes = [flight.state("quaternion") for flight in flights]
    trail = max(round(1.0 / control_dt), 1)
    stride = max(int(1.0 / (min(fps, 50) * control_dt) + 1e-6), 1)
    instants = np.append(np.arange(0, last, stride), last)

    def frame(i: int, t: int) -> np.ndarray:
        target = flights[i].target
        return scenes[i].draw(
            paths[i][:, t],
            attitudes[i][:, t],
            None if target is None else target[:, t],
            trails=paths[i][:, max(t - trail, 0) : t + 1],
            text=f"{control_dt * t:.1f} s  {labels[i]}".rstrip(),
            image=None if seen[i] is None else depth_image(seen[i][0, t], far),
        )

    frames = (np.concatenate([frame(i, t) for i in range(len(flights))], 1) for t in instants)
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
    exe, first = find_ffmpeg(), next(frames)
    rate = Fraction(1.0 / (times[-1] - times[-2])).limit_denominator()
    target = ["-movflags", "+faststart", "-f", "mp4", f"file:{path.absolute()}"]
    with tempfile.TemporaryFile() as said:
        whole = True
        try:
            command = _encoding(exe, *first.shape[1::-1], rate, *target)
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said) as process:
                for frame in itertools.chain([first], frames):
                    process.stdin.write(frame.tobytes())
        except BrokenPipeError:  # it has ended before the film
            whole = False
        if not whole or process.returncode or not (path.exists() and path.stat().st_size):
            raise NoFfmpeg(_broken(exe, process.returncode, said))


def find_ffmpeg() -> str:
    """The ffmpeg that films in MP4 are written with, tried on a film of one frame.

    Raises:
        NoFfmpeg: there is none, or it does not work.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise NoFfmpeg("Films in MP4 need imageio-ffmpeg: pip install '.[render]' in a clone.") from error
    exe = "ffmpeg"
    try:
        exe = get_ffmpeg_exe()
        with tempfile.TemporaryFile() as film, tempfile.TemporaryFile() as said:
            command = _encoding(exe, 16, 16, Fraction(1), "-f", "h264", "-")
            done = subprocess.run(command, input=bytes(3 * 16 * 16), stdout=film, stderr=said, timeout=20, check=False)
            film.seek(0)
            if done.returncode or not film.read(4).startswith(b"\0\0"):  # the mark at which H.264 begins
                raise NoFfmpeg(_broken(exe, done.returncode, said))
    except subprocess.TimeoutExpired as error:
        raise NoFfmpeg(_broken(exe, "no answer in 20 s")) from error
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: imageio-ffmpeg finds none
        raise NoFfmpeg(_broken(exe, " ".join(str(error).split()))) from error
    return exe


def _encoding(exe: str, width: int, height: int, rate: Fraction, *target: str) -> list[str]:
    """The command that makes H.264 of raw frames."""
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(rate), "-i", "-"]
    return [exe, "-y", "-v", "error", *source, "-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", *target]


def _broken(exe: str, why: int | str, said: IO[bytes] | None = None) -> str:
    """What is wrong with an ffmpeg: its exit status and the first line that it has said, or an error."""
    if said is not None:
        said.seek(0)
        line = said.readline(200).decode(errors="replace").strip()
        why = f"exit status {why}{': ' * bool(line)}{line}"
    mend = "unset IMAGEIO_FFMPEG_EXE" if os.environ.get("IMAGEIO_FFMPEG_EXE") else _REINSTALL
    return f"Films in MP4 need an ffmpeg that writes H.264, and {exe} does not ({why}). Write a GIF, or {mend}."


# The views of each environment, by number of drones and size. They are kept outside the environment, which can be
# copied and sent to other processes.
_scenes: weakref.WeakKeyDictionary[EnvBase, dict[tuple[int, int, bytes], Scene]] = weakref.WeakKeyDictionary()


def draw_frame(env: EnvBase, drones: Sequence[int] | None, size: int) -> np.ndarray:
    """Draw an environment as it is; see :meth:`~torchrl_quad.envs.QuadrotorEnv.render`."""
    if not env.render_state:
        raise UserValueError("render() draws the state after the last reset or step. Call env.reset() first.")
    alone = env.scene is not None and env.scene.is_random
    chosen = list(range(min(env.num_envs, 1 if alone else 6)) if drones is None else drones)
    if not chosen or not all(isinstance(i, numbers.Integral) and 0 <= i < env.num_envs for i in chosen):
        raise UserValueError(
            f"render: drones are indices from 0 to {env.num_envs - 1}, at least one, such as drones=[0]; got {chosen}."
        )
    if size < 100:
        raise UserValueError(f"render: size must be at least 100 pixels, got {size}.")
    shown = {key: x[chosen].cpu() for key, x in env.render_state.items() if isinstance(key, str)}
    drawn = {key: x[chosen[:1]] for key, x in env.render_state.items() if not isinstance(key, str)}
    points = [x for key, x in shown.items() if key != "quaternion"]
    scenes = _scenes.setdefault(env, {})
    solids = None if env.scene is None else env.scene.solids(drawn)
    known = b"".join(_numpy(x).tobytes() for x in drawn.values())  # another episode may have other obstacles
    scene = scenes.get((len(chosen), size, known))
    image = None
    if env.camera is not None:
        pose = (env.render_state[key][chosen[:1]] for key in ("position", "quaternion"))
        image = depth_image(env.camera.depth(solids, *pose)[0, 0], env.camera.range)
    if scene is None:  # half a metre of room around all drones, their targets and the markers
        everything = [x for key, x in env.render_state.items() if isinstance(key, str) and key != "quaternion"]
        low, high = bounds(*everything, *env.markers().points())
        low, high = low - torch.tensor([0.5, 0.5, 0.0]), high + 0.5
    else:  # a side that has become too near moves out by half of the view, so that it need not at every step
        low, high = bounds(*points, scene.low, scene.high)
        room = 0.5 * (scene.high - scene.low)
        low, high = low - room * (low < scene.low), high + room * (high > scene.high)
    if scene is None or (low < scene.low).any() or (high > scene.high).any():
        corners = torch.stack((low, high))
        markers, pixels = with_obstacles(env.markers(), solids), None if image is None else image.shape
        if drawn:
            scenes.clear()  # of episodes that are over
        scenes[len(chosen), size, known] = scene = Scene(corners, len(chosen), size, markers, image=pixels)
    return scene.draw(*shown.values(), image=image)


def _numpy(x: Tensor) -> np.ndarray:
    return x.numpy(force=True)
