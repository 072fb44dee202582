"""The pictures of a flight, each file complete or not there."""

from __future__ import annotations

from pathlib import Path

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_quad.files import replacing
from torchrl_quad.render import animate_flight, plot_episode, plot_flight, plot_learning_curve, write_replay


def draw_flight(flight: TensorDictBase, path: Path, env: EnvBase) -> None:
    """Draw a flight as a picture and as a film: ``path`` with .png and .gif."""
    for draw, suffix in ((plot_flight, ".png"), (animate_flight, ".gif")):
        with replacing(path.with_suffix(suffix)) as temporary:
            draw(flight, temporary, env=env)


def publish_flight(flight: TensorDictBase, figure: Path, page: Path, env: EnvBase) -> None:
    """Draw the first episode of a flight as a figure for a paper, and write a page that plays the flight."""
    with replacing(figure) as temporary:
        plot_episode(flight, temporary, env=env)
    write_replay(flight, page, env=env)


def draw_learning_curve(metrics: Path, path: Path, env: EnvBase) -> None:
    """Draw the evaluations in a metrics.csv over training time and steps."""
    with replacing(path) as temporary:
        plot_learning_curve(metrics, temporary, metrics=env.metric_info)
