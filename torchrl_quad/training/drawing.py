"""The pictures of a flight. One that cannot be drawn is missing, and a line on stderr says why."""

from __future__ import annotations

import contextlib
import functools
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_quad.deploy import Bundle
from torchrl_quad.deploy.contract import sha256
from torchrl_quad.deploy.transfer import as_rollout, fly
from torchrl_quad.errors import UserError
from torchrl_quad.files import check_place
from torchrl_quad.render import animate_flight, plot_episode, plot_flight, plot_learning_curve, write_replay
from torchrl_quad.render.video import NoFfmpeg
from torchrl_quad.training.building import build_env, task_of
from torchrl_quad.training.evaluation import load_policy

EXPLAINED = (UserError, OSError, ImportError, MemoryError)  # of any other error drawing.log has the traceback


def draw_flight(flight: TensorDictBase, path: Path, env: EnvBase, title: str) -> None:
    """Draw a flight as a picture and as a film: ``path`` with .png, and .mp4 or, where no ffmpeg works, .gif."""
    picture = path.with_suffix(".png")
    with _or_without(picture):
        plot_flight(flight, picture, env=env, title=title)
    _film(path, flight, env=env, sharp={"fps": 25, "size": 560})


def publish_flight(flight: TensorDictBase, figure: Path, page: Path, env: EnvBase, title: str) -> None:
    """Draw the first episode of a flight as a figure for a paper, and write a page that plays the flight."""
    with _or_without(figure):
        plot_episode(flight, figure, env=env)
    with _or_without(page):
        write_replay(flight, page, env=env, title=title)


def draw_transfer(bundle: Bundle, simulator: str, loop: str, path: Path, drones: int = 4, **changes: Any) -> None:
    """Film a bundle in our simulator and in another one, side by side, and write a page that plays both together.

    The other one flies with changes: ``scale`` and ``late``, as :func:`~torchrl_quad.deploy.transfer.fly` takes them.
    """
    ours_as_it_is = fly(bundle, "torchrl_quad", "contract", episodes=drones)
    flights = [ours_as_it_is, fly(bundle, simulator, loop, episodes=drones, **changes)]
    ours, theirs = map(as_rollout, flights)
    labels = tuple(flight["simulator"] for flight in flights)
    about = {"env": environment_beside(bundle), "control_dt": bundle.contract["control_dt"]}
    _film(path, ours, beside=theirs, labels=labels, **about)
    title = f"drones 1 to {drones}: {labels[0]}; {drones + 1} to {2 * drones}, from the same starts: {labels[1]}"
    page = path.with_suffix(".html")
    with _or_without(page):
        write_replay(cast("TensorDict", torch.cat(cast("Any", (ours, theirs)))), page, title=title, **about)


def environment_beside(bundle: Bundle) -> EnvBase | None:
    """The environment of the checkpoint beside a bundle, if it was exported from there and its task has a name."""
    checkpoint = bundle.folder.resolve().parent / "checkpoint.pt"
    with contextlib.suppress(UserError, OSError):
        if sha256(checkpoint.read_bytes()) == bundle.contract["origin"].get("checkpoint_sha256"):
            return build_env(load_policy(checkpoint)[0], 1, 0)
    return None


def draw_learning_curve(metrics: Path, path: Path, env: EnvBase) -> None:
    """Draw the evaluations in a metrics.csv over training time and steps."""
    with _or_without(path):
        plot_learning_curve(metrics, path, metrics=task_of(env).metric_info)


def _film(path: Path, flight: TensorDictBase, sharp: dict[str, Any] | None = None, **options: Any) -> None:
    """Film a flight, in an MP4 ``sharp``; no older film of the other suffix is left beside it."""
    mp4, gif = path.with_suffix(".mp4"), path.with_suffix(".gif")
    with _or_without(mp4, mp4, gif):
        try:
            animate_flight(flight, mp4, **options, **(sharp or {}))
            gif.unlink(missing_ok=True)
        except NoFfmpeg as error:  # a line on stderr says why
            _warn(f"{gif} takes the place of an MP4. {error}")
            animate_flight(flight, gif, **options)
            mp4.unlink(missing_ok=True)


@contextlib.contextmanager
def _or_without(path: Path, *older: Path) -> Iterator[None]:
    """Draw a picture, or go on without it: older ones, which would show another flight, are deleted."""
    try:
        yield
    except Exception as error:  # whatever it is, the results stand; a line and a traceback show it
        for old in older or (path,):
            with contextlib.suppress(OSError):
                if old.is_file() and not old.is_symlink():
                    old.unlink()
        why = " ".join(str(error).split())[:300] or type(error).__name__
        if not isinstance(error, EXPLAINED):
            why = f"{type(error).__name__}: {why.rstrip('.')}. {_log_traceback(path)}"
        _warn(f"{path} is missing. {why}")


def _log_traceback(path: Path) -> str:
    """Add the traceback of the present error to drawing.log, or print it where that cannot be written; say which."""
    log = path.with_name("drawing.log")
    try:
        check_place(log)
        with open(log, "a", encoding="utf-8") as file:
            file.write(f"{path.name} is missing.\n{traceback.format_exc()}\n")
    except OSError:
        traceback.print_exc()
        return "The traceback is above."
    return f"The traceback is in {log}."


@functools.cache  # each evaluation may draw
def _warn(line: str) -> None:
    print(f"Warning: {line}", file=sys.stderr)
