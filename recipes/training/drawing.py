"""The pictures of a flight, each file complete or not there."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_quad.deploy import Bundle
from torchrl_quad.deploy.replaying import as_rollout, environment
from torchrl_quad.deploy.transfer import fly
from torchrl_quad.files import replacing
from torchrl_quad.render import animate_flight, plot_episode, plot_flight, plot_learning_curve, write_replay


def draw_flight(flight: TensorDictBase, path: Path, env: EnvBase, title: str) -> None:
    """Draw a flight as a picture and as a film: ``path`` with .png and, see :func:`film_of`, .mp4 or .gif."""
    with replacing(path.with_suffix(".png")) as temporary:
        plot_flight(flight, temporary, env=env, title=title)
    film = film_of(path)
    sharp = {"fps": 25, "size": 560} if film.suffix == ".mp4" else {}
    with replacing(film) as temporary:
        animate_flight(flight, temporary, env=env, **sharp)


def film_of(path: Path) -> Path:
    """The film beside a picture: .mp4, or .gif where imageio-ffmpeg is not installed."""
    return path.with_suffix(".mp4" if find_spec("imageio_ffmpeg") else ".gif")


def publish_flight(flight: TensorDictBase, figure: Path, page: Path, env: EnvBase, title: str) -> None:
    """Draw the first episode of a flight as a figure for a paper, and write a page that plays the flight."""
    with replacing(figure) as temporary:
        plot_episode(flight, temporary, env=env)
    write_replay(flight, page, env=env, title=title)


def draw_transfer(bundle: Bundle, simulator: str, loop: str, path: Path, drones: int = 4) -> None:
    """Film a bundle in our simulator and in another one, side by side, and write a page that plays both together."""
    flights = [
        fly(bundle, name, how, episodes=drones) for name, how in (("torchrl_quad", "contract"), (simulator, loop))
    ]
    ours, theirs = (as_rollout(bundle.contract, flight) for flight in flights)
    env, labels = environment(bundle.contract), tuple(flight["simulator"] for flight in flights)
    film = film_of(path)
    with replacing(film) as temporary:
        animate_flight(ours, temporary, env=env, beside=theirs, labels=labels)
    title = f"drones 1 to {drones}: {labels[0]}; {drones + 1} to {2 * drones}, from the same starts: {labels[1]}"
    write_replay(torch.cat((ours, theirs)), path.with_suffix(".html"), env=env, title=title)


def draw_learning_curve(metrics: Path, path: Path, env: EnvBase) -> None:
    """Draw the evaluations in a metrics.csv over training time and steps."""
    with replacing(path) as temporary:
        plot_learning_curve(metrics, temporary, metrics=env.metric_info)
