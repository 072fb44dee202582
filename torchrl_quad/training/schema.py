"""The schema of the configuration: the type and the range of every setting, checked before a run makes its folder.

The signatures of task and loss declare the settings in ``env`` and ``loss``, ``SETTINGS`` all others. The YAML files of
a recipe say which of them it has.
"""

from __future__ import annotations

import copy
import difflib
import functools
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from torchrl_quad import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, PODSLoss, SAPOLoss, SHACLoss
from torchrl_quad.envs import task_class
from torchrl_quad.envs.config import as_disturbances
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.objectives import PathwiseLoss
from torchrl_quad.options import (
    Below1,
    Count,
    Device,
    Fraction,
    Horizon,
    NonNegative,
    Positive,
    Real,
    Share,
    Size,
    Width,
    accepted,
    argument_names,
    check_known,
    declared,
    imported,
    must,
)
from torchrl_quad.training.configuration import CONFIG, OWN, SET_BY_RECIPES, plain, tuned


class Section(BaseModel):
    """A section of the configuration: nothing is converted, and no setting is unknown."""

    model_config = ConfigDict(strict=True, extra="forbid")


ACTIVATIONS = "CELU ELU GELU Hardswish LeakyReLU Mish PReLU ReLU SELU SiLU Sigmoid Softplus Softsign Tanh"  # torch.nn
_Channels = Annotated[list[Annotated[int, Field(ge=1, le=4096)]], Field(min_length=1, max_length=8)]
_Frames = Literal["px4", "ardupilot", "betaflight", "crazyflie", "mavros", "mujoco", "rotorpy", "crazyflow"]


class _Convention(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: _Frames
    xyzw: bool = False


_Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
_Resume = accepted(lambda x: x == "auto" or Path(x).is_file(), "the path of a checkpoint.pt that exists, or auto")

#: The type and the description of each setting outside env and loss; "network" stands for actor and critic.
SETTINGS: dict[str, tuple[Any, str]] = {
    "algorithm": (str, ""),
    "task": (str, ""),
    "seed": (_Seed, "All random numbers follow from it."),
    "resume": (Annotated[str, _Resume] | None, ""),
    "trust": (list[str], "The paths of your own classes that a checkpoint names, and that may be imported."),
    "device": (Device, ""),
    "threads": (Annotated[int, Field(ge=1, le=1024)], "Torch threads; 1 is the fastest for tensors as small as these."),
    "num_envs": (Size, "Drones of each process; no memory holds more than these."),
    "horizon": (Horizon, "Control steps in a rollout."),
    "total_steps": (Annotated[int, Field(ge=1, le=10**15)], "Control steps of all drones together, in the whole run."),
    "compile": (bool, ""),
    "normalize": (bool, ""),
    "gamma": (Fraction, "The discount of future rewards per control step; 0.99 is usual."),
    "diagnostics": (Count, "Evaluations between audits of reward and gradient; 0 for none."),
    "max_skipped": (Count, "Updates that may be left out for not being finite; 0 stops at the first."),
    "restart_fraction": (Fraction, "The share of flights that each iteration gives up."),
    "step": (Positive, "The median change of an action that an iteration asks for, in units of the action."),
    "epochs": (Annotated[int, Field(ge=1, le=10_000)], "Passes over each rollout."),
    "min_epochs": (Annotated[int, Field(ge=1, le=10_000)], "Of these, the least where gradients are stiff."),
    "batch_size": (Size, "Control steps in a minibatch."),
    "network.num_cells": (list[Width], "The width of every hidden layer, in a list: [64, 64], or [64] for one layer."),
    "network.activation": (cast("Any", Literal)[tuple(ACTIVATIONS.split())], ""),
    "network.input_scale": (Positive, "The observation is multiplied by this."),
    "network.lr": (Positive, "The learning rate at the start; to keep a network as it is, write 1e-12."),
    "network.schedule": (Literal["constant", "linear", "exponential", "cosine", "inverse_sqrt"], ""),
    "network.final_lr": (NonNegative, "The learning rate at the end of the run."),
    "network.betas": (
        Annotated[list[Below1], Field(min_length=2, max_length=2)],
        "The two decay rates of Adam's averages, such as [0.9, 0.999].",
    ),
    "network.max_grad_norm": (Positive, "Longer gradients are shortened to this norm; to clip nothing, write 1e9."),
    "actor.scale_init": (Annotated[Real, Field(ge=1e-4)], "The standard deviation of the policy's noise at the start."),
    "actor.learn_scale": (bool, "Whether this noise changes with the state and in training."),
    "actor.noise_correlation": (Below1, "Of the policy's noise in two steps that follow each other; 0 is white noise."),
    "actor.vision": (bool, "Whether the policy reads the images of a camera, where there is one."),
    "actor.recurrent": (bool | None, "Whether the policy has a memory; null: where it sees."),
    "actor.hidden_size": (Width, "Numbers in that memory."),
    "actor.channels": (_Channels, "Of the convolutions of a visual policy: [8, 16]."),
    "actor.max_kl": (Positive | None, "How far an update, or PPO's iteration, may move the policy; null for none."),
    "actor.average": (Share | None, "The share of the iterations whose weights are averaged, as 0.1; null for none."),
    "critic.in_keys": (
        Annotated[list[str | list[str]], Field(min_length=1)] | None,
        "The entries that the critic reads, such as [observation, [state, rotor_speed]].",
    ),
    "critic.input_scale": (Positive | list[Positive], "What it reads is multiplied by this, or by one for each entry."),
    "critic.lmbda": (Fraction, "The lambda of the TD(lambda) targets; 0.95 is usual."),
    "critic.updates": (Annotated[int, Field(ge=1, le=100_000)], "Gradient steps of the critic per iteration."),
    "critic.batch_size": (Size, "Control steps in a minibatch of the critic."),
    "critic.tau": (Share, "The share of the critic that its target network takes over in each update."),
    "buffer.capacity": (Size, "Visited states kept; the oldest go first."),
    "buffer.fraction": (Fraction | None, "The share of horizons that start in visited states; null for none."),
    "eval.interval": (Size, "Iterations between evaluations; for only the last one, write 10000000."),
    "eval.episodes": (Size | None, "Episodes of each evaluation, at least; null for one of each drone."),
    "eval.patience": (
        Below1 | None,
        "Of a run: without a rise for so long it slows down, and ends the second time in a row; null: never.",
    ),
    "eval.seed": (_Seed, ""),
    "logger.backend": (Literal["wandb", "tensorboard", "csv"] | None, ""),
    "logger.project": (str, ""),
    "logger.group": (str | None, ""),
    "logger.mode": (Literal["offline", "online", "disabled"], ""),
    "logger.flight_every": (Count, "Evaluations between pictures of the flight; 0 draws only the last one."),
    "checkpoint": (str, ""),
    "episodes": (Size, "Fresh episodes to fly, side by side."),
    "folder": (str | None, "The folder to write."),
    "target": (Literal["crazyflie", "px4", "betaflight"] | None, "The firmware to write code for."),
    "logs": (Annotated[list[str], Field(min_length=1)], "The paths of flights of one drone, in a list."),
    "columns": (str | dict[str, Any] | None, "Which columns of the logs are which quantity, as for read_log."),
    "convention": (_Frames | _Convention | None, "The frames of the logs."),
    "drone": (str | dict[str, Any], "Where the fit starts: a preset, a YAML file, or a mapping."),
    "mass": (Positive | None, "The mass in kg, from a scale; null if unknown."),
    "reading": (dict[str, Any] | None, "Other arguments of read_log."),
    "known": (dict[str, Any] | None, "Fields of the drone that are known by measurement."),
    "fields": (list[str] | None, "What to fit; null for everything."),
    "past": (NonNegative, ""),
    "motor_command": (dict[str, float] | None, "From motor commands to rotor speeds, as in a drone's file."),
    "max_kl": (Positive, "How far the policy may move, as a KL divergence from the one that flew."),
    "steps": (Size, "Gradient steps of the policy."),
    "iterations": (Size, ""),
    "draws": (Count, "Of the bootstrap over windows; 0 for none."),
}
# By a setting that only they have, and those above them.
PROGRAMS = {"motor_command": "adapt", "logs": "identify", "folder": "export", "checkpoint": "evaluate"}
IDENTIFYING = {"horizon": (Positive, ""), "folder": (str, "The folder to write.")}  # of identify.py, under these names
#: The options of TorchRL's ClipPPOLoss that the recipe takes.
PPO: dict[str, tuple[Any, str]] = {
    "clip_epsilon": (Annotated[Real, Field(gt=0, lt=1)], "How far the ratio of probabilities may move from 1."),
    "entropy_bonus": (bool, ""),
    "entropy_coeff": (NonNegative, "The weight of the entropy bonus."),
    "critic_coeff": (Positive, "The weight of the critic's loss."),
    "loss_critic_type": (Literal["l1", "l2", "smooth_l1"], "The distance of values from their targets."),
    "normalize_advantage": (bool, "Whether advantages have zero mean and unit variance in each minibatch."),
    "max_importance_ratio": (Positive | None, "The largest ratio of probabilities; null for any."),
}
LOSSES: dict[str, type | None] = {
    **{"abpt": ABPTLoss, "ahac": AHACLoss, "bptt": BPTTLoss, "hybrid": HybridLoss},
    **{"pods": PODSLoss, "sapo": SAPOLoss, "shac": SHACLoss},
    "train": AHACLoss,
    "ppo": None,  # TorchRL's
}
# What a recipe builds its loss with itself.
SET_BY_LOOPS = {"horizon", "average", "reduction", "delay_value", "delay_qvalue"}
# Settings that others switch off: where, and why.
IDLE: list[tuple[str, Callable[[Any], bool], str]] = [
    *(
        (f"{network}.final_lr", lambda c, n=network, x=kind: c[n]["schedule"] == x, f"{network}.schedule={kind}")
        for network in ("actor", "critic")
        for kind in ("constant", "inverse_sqrt")
    ),
    ("actor.schedule actor.final_lr", lambda c: _kind(c) == "hybrid", "actor.max_kl sets the rate"),
    ("actor.input_scale", lambda c: c["normalize"], "normalize=true"),
    ("critic.input_scale", lambda c: c["normalize"] and not c["critic"].get("in_keys"), "normalize=true"),
    ("actor.channels", lambda c: c["env"].get("camera") is None, "env.camera=null"),
    ("actor.vision", lambda c: c["env"].get("camera") is None and c["actor"]["vision"], "env.camera=null"),
    ("actor.channels", lambda c: not c["actor"]["vision"], "actor.vision=false"),
    ("actor.hidden_size", lambda c: c["actor"]["recurrent"] is False, "actor.recurrent=false"),
    (
        "actor.hidden_size",
        lambda c: c["actor"]["recurrent"] is None and not _may_remember(c),
        "a policy that sees nothing has a memory only with actor.recurrent=true",
    ),
    ("loss.alpha_init", lambda c: c["loss"].get("alpha") != "auto", "loss.alpha is not auto"),
    (
        "loss.target_entropy",  # in whose size SAPO measures the entropy
        lambda c: c["loss"].get("alpha") != "auto" and _kind(c) != "sapo",
        "loss.alpha is not auto",
    ),
    (
        "loss.alpha loss.average_over_horizon actor.max_kl",
        lambda c: _kind(c) == "train",
        "the policy is fitted to actions",
    ),
    ("loss.iterations", lambda c: c["loss"].get("order") == 1, "loss.order=1"),
    (
        "env.event_discount",
        lambda c: _kind(c) == "ppo" and c["env"].get("event_discount"),
        "PPO follows no gradient through events",
    ),
    ("loss.entropy_coeff", lambda c: c["loss"].get("entropy_bonus") is False, "loss.entropy_bonus=false"),
    ("env.difficulty", lambda c: None not in map(c["env"].get, ("density", "gap")), "env.density and env.gap are set"),
    ("env.difficulty env.density env.gap", lambda c: c["env"].get("scene") is not None, "env.scene is set"),
    ("logger.project logger.group logger.mode", lambda c: c["logger"]["backend"] != "wandb", "it is wandb's"),
    ("restart_fraction", lambda c: c.get("buffer", {}).get("fraction") is not None, "buffer.fraction is set"),
    ("buffer.capacity", lambda c: c["buffer"]["fraction"] is None, "buffer.fraction=null"),
]


def _kind(c: Any) -> str:
    """The recipe that ships, on whose configuration another may rest."""
    return OWN.get(c["algorithm"], (c["algorithm"],))[0]


def _may_remember(c: Any) -> bool:
    """Whether a policy may get a memory without being asked to."""
    env = c["env"]
    sees = env.get("camera") and c["actor"]["vision"]
    told = [task_class(c["task"]), *(env.get("disturbances") or ())]
    return bool(sees or "any" in (env.get("randomize") or "") or any(getattr(x, "privileged", x) for x in told))


def settings(name: str) -> dict[str, Any]:
    """What the YAML files of a recipe set, without what is tuned for a task; of an unknown recipe, of all."""
    config, own = OWN.get(name, (name, {}))
    if config not in {*LOSSES, *PROGRAMS.values()}:
        return plain(OmegaConf.merge(*map(settings, LOSSES)))
    return _merged(config, own) if own else copy.deepcopy(_shipped(config))


@functools.cache
def _shipped(config: str) -> dict[str, Any]:
    """The settings of a recipe that ships, whose files are read once."""
    return _merged(config, {})


def _merged(config: str, own: Mapping[str, Any]) -> dict[str, Any]:
    recipe = OmegaConf.load(CONFIG / f"{config}.yaml")
    shared = [OmegaConf.load(CONFIG / f"{x}.yaml") for x in recipe.defaults if x in ("common", "critic")]
    merged = plain(OmegaConf.merge(*shared, recipe, own)) | ({"task": None} if shared else {})
    return {name: value for name, value in merged.items() if name not in ("defaults", "hydra")}


def check(cfg: DictConfig, overrides: Sequence[str] = ()) -> None:
    """Raise a UserError for the first setting that is unknown, of a wrong value, or written without effect."""
    try:
        chosen = OmegaConf.masked_copy(cfg, [str(name) for name in cfg if name != "hydra"])
        values = plain(chosen, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        name = error.full_key or "a setting"
        raise UserValueError(f"{name} is missing: write {name}=... on the command line.") from None
    except OmegaConfBaseException as error:
        raise UserValueError(f"{error.full_key or 'the configuration'}: {str(error).splitlines()[0]}") from None
    asked = dict(pair for override in overrides for pair in _asked(override))
    schema = schema_of(values, asked)
    try:
        schema.model_validate(values)
    except ValidationError as error:
        raise UserValueError(_sentence(schema, error.errors()[0])) from None
    if "algorithm" in values:
        as_disturbances(values.get("env", {}).get("disturbances") or (), "env.disturbances")
        _check_together(values, asked)


def _asked(override: str) -> Iterator[tuple[str, Any]]:
    """The name and the value of an override, and of each entry of a mapping."""
    name, _, value = override.partition("=")
    todo = [(name.lstrip("+~"), OverridesParser.create().parse_override(override).value())] if "{" in value else []
    yield name.lstrip("+~"), value
    for name, mapping in todo:
        for key, x in mapping.items() if isinstance(mapping, dict) else ():
            yield f"{name}.{key}", x
            todo.append((f"{name}.{key}", x))


def schema_of(values: dict[str, Any], asked: Mapping[str, str] = MappingProxyType({})) -> type[BaseModel]:
    """The schema of a recipe, with its task and its loss, or of another program in recipes."""
    for name, program in PROGRAMS.items():
        if name in values:
            return _section(settings(program), SETTINGS | (IDENTIFYING if program == "identify" else {}))
    for name in ("algorithm", "task"):
        if not isinstance(values.get(name), str):
            raise UserValueError(f"{name}={shown(values.get(name))}: it must be a name.")
    config, own = OWN.get(values["algorithm"], (values["algorithm"], {}))
    kinds: dict[str, tuple[Any, str]] = {"env": (_environment(values), ""), "loss": (dict[str, Any], "")}
    if config in LOSSES:
        kinds["loss"] = _loss(LOSSES[config], own.get("loss") or {}, values.get("loss"), asked), ""
    # What is tuned for another recipe, which this one starts from, is left alone. A recipe that is somebody's own, in
    # another program, may lack anything.
    spare = {name for name in SETTINGS if name.startswith("critic.") and name not in asked}
    return _section(settings(values["algorithm"]), SETTINGS | kinds, spare, config in LOSSES)


def _section(
    known: Mapping[str, Any],
    kinds: Mapping[str, tuple[Any, str]],
    spare: Collection[str] = (),
    is_complete: bool = True,
    section: str = "",
) -> type[BaseModel]:
    """The schema of a section with these settings, all of which it must have if it is complete, and spare ones."""
    fields: dict[str, Any] = {}
    more = [name.removeprefix(section) for name in spare if section and name.startswith(section)]
    for key, value in {**dict.fromkeys(more), **known}.items():
        name = section + key
        kind, text = kinds.get(name) or kinds.get(re.sub(r"^(actor|critic)\.", "network.", name)) or (None, "")
        if kind is None and isinstance(value, Mapping):
            kind = _section(value, kinds, spare, is_complete, f"{name}.")
        fields[key] = _field(key, kind or Any, text, ... if is_complete and key in known else None)
    return create_model(section or "Configuration", __base__=Section, **fields)


def _field(name: str, kind: Any, described: str, default: Any = None) -> tuple[Any, Any]:
    """A field of a schema; the alias is for _target_, since no field may start with an underscore."""
    return kind, Field(default, alias=name, description=re.sub(r"\bNone\b", "null", described) or None)


def _environment(values: dict[str, Any]) -> type[BaseModel]:
    """The schema of the section env, from the signature of the task, which checks what has no declared type."""
    cls, env = task_class(values["task"]), values.get("env")
    for name in env if isinstance(env, dict) else ():
        if name in SET_BY_RECIPES:
            raise UserValueError(f"env.{name}: recipes set it for all environments. Write {name}=..., without env.")
    if isinstance(env, dict):
        check_known(cls, sorted(map(str, env)))
    kinds = declared(cls) | {"disturbances": (list[str | dict[str, Any]] | None, "")}
    fields: dict[str, Any] = {x: _field(x, *kinds.get(x, (Any, ""))) for x in inspect.signature(cls).parameters}
    return create_model("Env", __base__=Section, **fields)


def _loss(kind: type | None, added: Mapping[str, Any], values: Any, asked: Mapping[str, str]) -> type[BaseModel]:
    """The schema of the section loss, from the signature of the loss, and from what a recipe of your own adds."""
    values = values if isinstance(values, dict) else {}
    options = PPO if kind is None else declared(kind)
    names = {*options, *added} - SET_BY_LOOPS
    if path := values.get("_target_"):
        if kind is None:
            raise UserValueError(f"loss._target_={path}: this recipe takes only TorchRL's loss. Write your own recipe.")
        own, base = imported(path, "loss._target_"), PathwiseLoss if kind is BPTTLoss else kind
        if not (isinstance(own, type) and issubclass(own, base)):
            raise UserTypeError(f"loss._target_={path}: it must be a subclass of {base.__name__}.")
        options |= declared(own)
        # A setting of the recipe's own loss that this one lacks is left out, but the command line must not name it.
        unasked = {name for name in values if f"loss.{name}" not in asked}
        names = {*argument_names(own), "_target_", *unasked} - SET_BY_LOOPS
    for name in values:
        if name not in names:
            raise UserValueError(
                f"loss.{name} is unknown, or set by the recipe. Choose from: {', '.join(sorted(names))}."
            )
    plain = {name: (type(x), "") for name, x in added.items() if isinstance(x, bool | str)}
    fields: dict[str, Any] = {x: _field(x, *(plain | options).get(x, (Any, ""))) for x in names}
    return create_model("Loss", __base__=Section, **{x.strip("_"): field for x, field in fields.items()})


def _check_together(values: dict[str, Any], asked: Mapping[str, str]) -> None:
    """Refuse settings that do not fit each other, or that the command line sets in vain."""
    for name in ("actor", "critic"):
        section = values.get(name) or {}
        if section.get("schedule") == "exponential" and section["final_lr"] == 0:
            raise UserValueError(
                f"{name}.final_lr=0: it must be above 0 with schedule=exponential, which never reaches 0. Try 1e-6."
            )
    if (name := asked.get("tuned", "null")) not in ("null", *tuned()):
        own = [x for x in tuned() if x.startswith(f"{values['algorithm']}_")] or list(tuned())
        close = difflib.get_close_matches(name, own, 1) or own
        raise UserValueError(
            f"tuned={name}: nothing has this name in {CONFIG / 'by_task'}. Choose from: {', '.join(close)}."
        )
    for names, is_idle, why in IDLE:
        for name in set(names.split()) & asked.keys():
            if is_idle(values):
                raise UserValueError(f"{name}={asked[name]} has no effect: {why}. Leave it out, or change that.")


def _sentence(schema: type[BaseModel], error: Any) -> str:
    """One refusal: the setting, its value, what it must be, and its description."""
    name, value, described = "", error["input"], ""
    section: type[BaseModel] | None = schema
    known: list[str] = []
    for key in error["loc"]:
        if isinstance(key, int):  # an entry of a list
            name += f"[{key}]"
        elif section is not None and (key in section.model_fields or error["type"] == "extra_forbidden"):
            name, known = f"{name}.{key}" if name else key, list(section.model_fields)
            field = section.model_fields.get(key)
            described = (field and field.description) or ""
            inner = None if field is None else field.annotation
            section = inner if isinstance(inner, type) and issubclass(inner, BaseModel) else None
    if error["type"] == "extra_forbidden":
        close = difflib.get_close_matches(name.rpartition(".")[2], known, 1)
        hint = f"Did you mean {''.join([*name.rpartition('.')[:2], *close])}?" if close else "Leave it out."
        return f"{name} is unknown: this recipe has no such setting. {hint}"
    if error["type"] == "missing":
        return f"{name} is missing: do not delete it. Set it to another value instead."
    said = value[:100] if isinstance(value, str) else "null" if value is None else shown(value)
    text = "" if isinstance(value, dict) else f"={said}"
    return f"{name}{text}: it must {must(error)}. {described}".strip()
