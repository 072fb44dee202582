"""Quadrotor tasks as TorchRL environments whose tensordicts carry gradients."""

from typing import Any

from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.events import Event, ball_entry, level_crossing
from torchrl_quad.envs.hovering import HoveringEnv
from torchrl_quad.envs.landing import LandingEnv
from torchrl_quad.envs.racing import RacingEnv, load_track
from torchrl_quad.envs.task import Task
from torchrl_quad.envs.tracking import TrackingEnv

__all__ = [
    "TASKS",
    "Disturbance",
    "Event",
    "HoveringEnv",
    "LandingEnv",
    "QuadrotorEnv",
    "RacingEnv",
    "Task",
    "TrackingEnv",
    "ball_entry",
    "level_crossing",
    "load_track",
    "make_env",
]

#: The tasks by name.
TASKS: dict[str, type[QuadrotorEnv]] = {
    "hovering": HoveringEnv,
    "landing": LandingEnv,
    "racing": RacingEnv,
    "tracking": TrackingEnv,
}


def make_env(task: str, **kwargs: Any) -> QuadrotorEnv:
    """Build a task by its name: ``make_env("hovering", num_envs=64)``; the keywords go to the environment.

    Raises:
        ValueError: the task is unknown, or an argument is out of its range.
        TypeError: a keyword is unknown.
    """
    if task not in list(TASKS):  # a list compares what cannot be hashed, too
        raise ValueError(f"Unknown task {task!r}. Choose from: {', '.join(sorted(TASKS))}.")
    return TASKS[task](**kwargs)
