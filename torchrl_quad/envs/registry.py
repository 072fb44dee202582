"""The tasks by name: those of this package, and those that programs register."""

from __future__ import annotations

import inspect
import re
from typing import Any

from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.forest import ForestEnv
from torchrl_quad.envs.hovering import HoveringEnv
from torchrl_quad.envs.landing import LandingEnv
from torchrl_quad.envs.racing import RacingEnv
from torchrl_quad.envs.tracking import TrackingEnv
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.options import imported

# The tasks of this package, and those that register_task has added.
TASKS: dict[str, type[QuadrotorEnv]] = {
    "forest": ForestEnv,
    "hovering": HoveringEnv,
    "landing": LandingEnv,
    "racing": RacingEnv,
    "tracking": TrackingEnv,
}


def register_task(name: str, cls: type[QuadrotorEnv]) -> None:
    """Name your own task, for ``make_env``, gymnasium, and a recipe in the same program.

    After ``register_task("window", WindowEnv)`` you can write ``make_env("window")`` and
    ``gymnasium.make("torchrl_quad/Window-v0")``. A class that Python can import needs no name:
    ``make_env("mypackage.WindowEnv")``.

    The name is in small letters, digits and underscores; the class defines all that :class:`~torchrl_quad.envs.Task`
    asks for.

    Raises:
        ValueError: the name is not of this form, or another class has it.
        TypeError: this is no class of a task, or it lacks methods.
    """
    if not (isinstance(name, str) and re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name)):
        raise UserValueError(
            f"A task's name is in small letters, digits and underscores, such as 'window'; got {shown(name)}."
        )
    _checked_class(cls, f"register_task({name!r}, ...)")
    taken, own = (f"{x.__module__}.{x.__qualname__}" for x in (TASKS.get(name, cls), cls))
    if taken != own:  # a module that runs again, as in a notebook, may
        raise UserValueError(f"The task {name!r} is {taken} already. Choose another name for {own}.")
    TASKS[name] = cls
    from torchrl_quad import register_envs  # which needs the package whole

    register_envs(name)


def available_tasks() -> list[str]:
    """The names that :func:`make_env` knows."""
    return sorted(TASKS)


def task_class(task: str) -> type[QuadrotorEnv]:
    """Find the class of a task by its name, or by its path, such as "mypackage.WindowEnv", which is imported.

    Raises:
        ValueError: there is no such task.
        TypeError: what the path leads to is no class of a task, or lacks methods.
    """
    if isinstance(task, str) and task in TASKS:
        return TASKS[task]
    if isinstance(task, str) and re.fullmatch(r"\w+(\.\w+)+", task):
        return _checked_class(imported(task), f"task {task!r}")
    raise UserValueError(
        f"Unknown task {shown(task)}. Choose from: {', '.join(available_tasks())}. For your own task give the path "
        "of its class, such as 'mypackage.WindowEnv', or call register_task(name, WindowEnv) before."
    )


def make_env(task: str, **kwargs: Any) -> QuadrotorEnv:
    """Build a task by its name: ``make_env("hovering", num_envs=64)``; the keywords go to the environment.

    Raises:
        ValueError: the task is unknown, or an argument is out of its range.
        TypeError: a keyword is unknown.
    """
    return task_class(task)(**kwargs)


def _checked_class(cls: Any, source: str) -> type[QuadrotorEnv]:
    if not (isinstance(cls, type) and issubclass(cls, QuadrotorEnv)):
        got = f"the class {cls.__name__}" if isinstance(cls, type) else type(cls).__name__
        raise UserTypeError(
            f"{source}: a task is a subclass of QuadrotorEnv, itself and not an instance; got {got}. To train in "
            "another environment write the loop, as examples/08_abpt_on_another_environment.py does."
        )
    if inspect.isabstract(cls):
        missing = ", ".join(sorted(cls.__abstractmethods__))
        raise UserTypeError(f"{source}: {cls.__name__} lacks {missing}. docs/writing.md says what each of them gives.")
    return cls


try:  # gymnasium's ids of this package get the episode lengths, where there is gymnasium
    from gymnasium import registry as _ids
except ModuleNotFoundError:
    _ids = {}
for _name, _cls in TASKS.items():
    if _spec := _ids.get(f"torchrl_quad/{_name.capitalize()}-v0"):
        _spec.max_episode_steps = inspect.signature(_cls).parameters["max_episode_steps"].default
