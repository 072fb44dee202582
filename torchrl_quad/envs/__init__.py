"""Quadrotor tasks as TorchRL environments whose tensordicts carry gradients."""

from typing import Any

from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.hovering import HoveringEnv

__all__ = ["TASKS", "HoveringEnv", "QuadrotorEnv", "make_env"]

TASKS: dict[str, type[QuadrotorEnv]] = {"hovering": HoveringEnv}


def make_env(task: str, **kwargs: Any) -> QuadrotorEnv:
    """Build a task by its name: ``make_env("hovering", num_envs=64)``; the keywords go to the environment.

    Raises:
        ValueError: the task is unknown.
    """
    if task not in TASKS:
        raise ValueError(f"Unknown task {task!r}. Choose from: {', '.join(sorted(TASKS))}.")
    return TASKS[task](**kwargs)
