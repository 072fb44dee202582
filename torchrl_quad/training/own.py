"""Tasks and recipes of your own: what hydra and the schema have to know of them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from torchrl_quad import QuadrotorEnv, available_tasks
from torchrl_quad.envs import task_class
from torchrl_quad.errors import UserValueError

CONFIG = Path(__file__).parents[2] / "recipes/config"
SET_BY_RECIPES = ("num_envs", "device", "seed", "compile")  # settings outside ``env``
OWN: dict[str, tuple[str, Mapping[str, Any]]] = {}  # recipes of your own: the configuration each is made from, and more
PLAIN = (bool, int, float, str, NoneType)


def offer_tasks(arguments: Sequence[str]) -> list[str]:
    """Offer hydra a configuration for each task on a command line that has no file in ``config/task/``.

    Returns:
        the command line, with ``task=mypackage.WindowEnv`` for ``task._target_=mypackage.WindowEnv``.

    Raises:
        ValueError: a path leads to no class.
        TypeError: it leads to a class that is no task.
    """
    arguments = [re.sub(r"^task\._target_=", "task=", argument) for argument in arguments]
    values = " ".join(x.removeprefix("task=") for x in arguments if x.startswith("task="))
    for name in set(re.findall(r"[\w.]+", values)):
        known = name in available_tasks() or "." in name
        if known and not (CONFIG / f"task/{name}.yaml").exists():
            node = {"task": name, "env": defaults(task_class(name))}
            ConfigStore.instance().store(group="task", name=name, node=node, package="_global_")
    return arguments


def defaults(cls: type[QuadrotorEnv]) -> dict[str, Any]:
    """The options of a task that ``common.yaml`` lacks, or has with another value; ??? where one must be given."""
    base, settings = inspect.signature(QuadrotorEnv).parameters, {}
    for name, argument in _options(cls).items():
        default = "???" if argument.default is argument.empty else argument.default
        is_plain = isinstance(default, (*PLAIN, list, tuple, Mapping))
        if is_plain and (name not in base or name == "max_episode_steps" or default != base[name].default):
            settings[name] = default
    return settings


def own_recipe(config: str, settings: Mapping[str, Any]) -> str:
    """Store the configuration of a recipe of your own: ``config``, and then these settings. Returns its name.

    Raises:
        ValueError: the settings lack a name, or it is that of a recipe that ships.
    """
    name = settings.get("algorithm")
    if not isinstance(name, str) or (CONFIG / f"{name}.yaml").exists():
        raise UserValueError(
            f"A recipe of your own needs a name of its own: @recipe({config!r}, algorithm='my_{config}', ...); got "
            f"{name!r}."
        )
    OWN[name] = config, settings
    node = OmegaConf.load(CONFIG / f"{config}.yaml")
    overrides = [str(entry).startswith("{'override ") for entry in node.defaults]
    node.defaults.insert(overrides.index(True), f"{name}_settings")  # after the task and what is tuned
    ConfigStore.instance().store(name=name, node=node)
    ConfigStore.instance().store(name=f"{name}_settings", node=dict(settings))
    return name


def _options(cls: type[QuadrotorEnv]) -> dict[str, inspect.Parameter]:
    parameters = inspect.signature(cls).parameters.items()
    return {name: x for name, x in parameters if name not in (*SET_BY_RECIPES, "dtype", "disturbances")}
