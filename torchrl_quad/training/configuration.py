"""Where a configuration comes from: YAML files, the signatures of tasks, recipes and classes of your own."""

from __future__ import annotations

import ast
import contextlib
import functools
import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import NoneType
from typing import Any, cast

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from torchrl_quad import QuadrotorEnv, available_tasks
from torchrl_quad.envs import TASKS, task_class
from torchrl_quad.errors import UserValueError

CONFIG = Path(__file__).parent / "config"  # in the repository a link to recipes/config
SET_BY_RECIPES = ("num_envs", "device", "seed", "compile")  # settings outside ``env``
OWN: dict[str, tuple[str, Mapping[str, Any]]] = {}  # recipes of your own: the configuration each is made from, and more
_OFFERED: dict[tuple[str, str], type | None] = {}  # what is in hydra's store, by group and name, with a task's class
# hydra's own options that take a value are these, and some with a hyphen in their name.
_SETTING = re.compile(r"--(?!cfg=|package=|info=)([\w.@/]+=.*)", re.DOTALL)
# What Python and hydra write differently: a string, which may be a key with its colon, and None.
_PYTHON = re.compile(r"""('(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*")(\s*:)?|(?<![^\s,\[{:])None(?![^\s,\]}])""")


def _steps_in(seconds: float, cfg: DictConfig) -> float:
    """Control steps in a time of train.yaml; the schema refuses a period that no environment takes."""
    period = OmegaConf.select(cfg, "env.control_dt", throw_on_resolution_failure=False)
    return seconds / period if isinstance(period, float | int) and 1e-6 <= period <= 1.0 else 1.0


def _resolve(name: str, of_steps: Callable[[float], float]) -> None:
    """Register ``${NAME:SECONDS}``, a function of the time in control steps."""
    OmegaConf.register_new_resolver(name, lambda seconds, *, _root_: of_steps(_steps_in(seconds, _root_)), replace=True)


_resolve("steps_in", lambda steps: min(max(round(steps), 1), 100_000))  # the longest horizon of the schema
_resolve("decay_over", lambda steps: max(1.0 - 1.0 / steps, 0.0))  # per control step, with this time constant
OmegaConf.register_new_resolver(  # ${any_drone:X,Y} is X where each episode draws another drone, else Y
    "any_drone", lambda x, y, *, _root_: x if OmegaConf.select(_root_, "env.randomize") == "any" else y, replace=True
)


def compose(recipe: str, overrides: Iterable[str] = ()) -> DictConfig:
    """The configuration of a recipe with a command line. Not for several threads: hydra holds one folder at a time."""
    with hydra.initialize_config_dir(str(CONFIG), version_base=None):
        return hydra.compose(recipe, command_line(overrides))


def command_line(arguments: Iterable[str]) -> list[str]:
    """A command line in hydra's grammar, with all tasks that ship or are named on it, and what is tuned, on offer."""
    arguments = [re.sub(r"^task\._target_=", "task=", hydra_argument(argument)) for argument in arguments]
    if any(argument.startswith("loss._target_=") for argument in arguments):
        arguments = [re.sub(r"^loss\.", "++loss.", argument) for argument in arguments]  # the files lack its options
    asked = ",".join(argument.removeprefix("task=") for argument in arguments if argument.startswith("task="))
    for name in {*TASKS, *re.findall(r"[\w.]+", asked)}:
        # Other names are words of a sweep, such as choice(hovering, racing).
        if name in asked.split(",") or name in available_tasks() or "." in name:
            _offer("task", name, task_class(name))
    for name in tuned():
        _offer("tuned", name)
    return arguments


def _offer(group: str, name: str, cls: type[QuadrotorEnv] | None = None) -> None:
    """Put a task, or what is tuned for one, into hydra's store, unless it is there."""
    store = ConfigStore.instance()
    if f"{name}.yaml" in store.repo.get(group, {}) and _OFFERED.get((group, name)) is cls:
        return
    _OFFERED[group, name] = cls
    node = tuned()[name] if cls is None else {"task": name, "env": defaults(cls)}
    store.store(group=group, name=name, node=node, package="_global_")


@functools.cache
def tuned() -> dict[str, DictConfig]:
    """What is tuned for a recipe and a task, by the name RECIPE_TASK: the sections of the recipe's file in by_task/."""
    found = {}
    for path in sorted((CONFIG / "by_task").glob("*.yaml")):
        for name, section in OmegaConf.load(path).items():
            if not OmegaConf.is_dict(section):
                raise UserValueError(f"{path}: {name} is no section. Indent settings below the name of their task.")
            found[f"{path.stem}_{name}"] = section
    return found


def plain(cfg: Any, **options: Any) -> dict[str, Any]:
    """A section of a configuration as a dict; the options are those of ``OmegaConf.to_container``."""
    return cast("dict[str, Any]", OmegaConf.to_container(cfg, **options))


def defaults(cls: type[QuadrotorEnv]) -> dict[str, Any]:
    """The options of a task that ``common.yaml`` lacks, or has with another value; ??? where one must be given."""
    base, settings = inspect.signature(QuadrotorEnv).parameters, {}
    for name, argument in inspect.signature(cls).parameters.items():
        default = "???" if argument.default is argument.empty else argument.default
        is_plain = isinstance(default, (bool, int, float, str, NoneType, list, tuple, Mapping))
        differs = name not in base or name == "max_episode_steps" or default != base[name].default
        if is_plain and differs and name not in (*SET_BY_RECIPES, "disturbances"):
            settings[name] = default
    return settings


def named_code(values: Any) -> list[str]:
    """The paths of the classes of your own that a configuration names, valid or not: task, disturbances and loss."""
    env, loss = ({**values[name]} if isinstance(values.get(name), dict) else {} for name in ("env", "loss"))
    disturbances = env.get("disturbances") if isinstance(env.get("disturbances"), list) else []
    targets = [{"_target_": x} if isinstance(x, str) else x for x in (*disturbances, loss)]
    paths = [str(x["_target_"]) for x in targets if isinstance(x, dict) and x.get("_target_") is not None]
    return [*(name for name in [values["task"]] if name not in available_tasks()), *paths]


def own_recipe(config: str, settings: Mapping[str, Any]) -> str:
    """Store the configuration of a recipe of your own: ``config``, and then these settings. Returns its name."""
    name = settings.get("algorithm")
    if not isinstance(name, str) or (CONFIG / f"{name}.yaml").exists():
        raise UserValueError(
            f"A recipe of your own needs a name that no recipe has which ships, and not {name!r}: "
            f"@recipe({config!r}, algorithm='my_{config}', ...)."
        )
    OWN[name] = config, settings
    node = OmegaConf.load(CONFIG / f"{config}.yaml")
    overrides = [str(entry).startswith("{'override ") for entry in node.defaults]
    node.defaults.insert(overrides.index(True), f"{name}_settings")  # after the task and what is tuned
    ConfigStore.instance().store(name=name, node=node)
    ConfigStore.instance().store(name=f"{name}_settings", node=dict(settings))
    return name


def hydra_argument(argument: str) -> str:
    """One argument in hydra's grammar: a sweep of wandb writes ``--env.wind={'mean': [1, 0, 0], 'gust': None}``, and
    an error of a log ``columns={"time": Columns(("t",), scale=1e-3)}, convention=frames.px4()``, each by itself."""
    if match := _SETTING.fullmatch(argument):
        argument = match[1]
    name, equals, value = argument.partition("=")
    if name in ("clearance", "max_gap", "min_duration", "onboard"):  # arguments of read_log
        name = f"++reading.{name}"
    if name in ("columns", "convention") and "(" in value:
        with contextlib.suppress(SyntaxError, TypeError, ValueError):
            value = str(_literal(ast.parse(value, mode="eval").body))
    return name + equals + _PYTHON.sub(_as_in_hydra, value) if equals and not name.startswith("-") else argument


def _literal(node: ast.expr) -> Any:
    """What Python writes of Columns and conventions, as mappings and words."""
    match node:
        case ast.Call(func=ast.Name(id="Columns"), args=given, keywords=rest):
            named = dict(zip(("names", "scale", "offset"), map(_literal, given), strict=False))
            return named | {str(x.arg): _literal(x.value) for x in rest}
        case ast.Call(func=ast.Attribute(attr="replace"), args=[convention], keywords=rest):
            return {"name": _literal(convention), **{str(x.arg): _literal(x.value) for x in rest}}
        case ast.Call(func=ast.Attribute(attr=convention), args=[]):
            return convention
        case ast.Dict(keys=keys, values=values):
            return {_literal(k): _literal(x) for k, x in zip(keys, values, strict=True) if k is not None}
        case ast.Tuple(elts=parts) | ast.List(elts=parts):
            return [_literal(x) for x in parts]
    return ast.literal_eval(node)


def _as_in_hydra(match: re.Match[str]) -> str:
    string, colon = match.groups()
    if string is None:
        return "null"
    return string if colon is None else re.sub(r"([^\w./+-])", r"\\\1", string[1:-1]) + ":"
