"""The schema of the configuration: the type and the range of every setting, checked before a run makes its folder.

A setting is refused with its name, its value, what it must be, and the sentence that describes it. The signatures of
task and loss declare the settings in ``env`` and ``loss``, this file all others. The YAML files of a recipe say which
of them it has.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar, cast

import torch
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from torchrl_quad import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, SAPOLoss, SHACLoss
from torchrl_quad.envs import task_class
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import (
    Below1,
    Count,
    Fraction,
    NonNegative,
    Positive,
    Real,
    Share,
    Size,
    argument_names,
    check_known,
    declared,
    must,
)
from torchrl_quad.training.configuration import CONFIG, OWN, SET_BY_RECIPES, own_disturbances, own_loss

TRUST = "The paths of your own classes that a checkpoint names, and that may be imported."
MAX_ROLLOUT = 100_000_000  # control steps of a rollout: with a graph they take more than 50 GB


def available_device(name: str) -> str:
    """The name of a device that this machine has."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise UserValueError("be cpu, cuda, or one of several GPUs, such as cuda:1")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise UserValueError("be cpu: torch finds no CUDA device on this machine")
    return name


def existing_checkpoint(path: str) -> str:
    """The path of a checkpoint to go on from, or auto."""
    if path != "auto" and not Path(path).is_file():
        raise UserValueError("be the path of a checkpoint.pt that exists, or auto")
    return path


# -- types -------------------------------------------------------------------------------------------------------------

Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Device = Annotated[str, AfterValidator(available_device)]
Threads = Annotated[int, Field(ge=1, le=1024)]
ACTIVATIONS = (
    "CELU ELU GELU Hardswish LeakyReLU Mish PReLU ReLU SELU SiLU Sigmoid Softplus Softsign Tanh"  # of torch.nn
)
Activation = Literal[tuple(ACTIVATIONS.split())]  # type: ignore[valid-type]


class Section(BaseModel):
    """A section of the configuration: nothing is converted, and no setting is unknown."""

    model_config = ConfigDict(strict=True, extra="forbid")


_Section = TypeVar("_Section", bound=Section)


class Optimised(Section):
    """A network and its optimiser."""

    num_cells: list[Annotated[int, Field(ge=1, le=65_536)]] = Field(
        description="The width of every hidden layer, in a list: [64, 64], or [64] for a single layer."
    )
    activation: Activation
    input_scale: Positive = Field(description="The observation is multiplied by this.")
    lr: Positive = Field(description="The learning rate at the start; to keep a network as it is, write 1e-12.")
    schedule: Literal["constant", "linear", "exponential", "cosine"]
    final_lr: NonNegative = Field(description="The learning rate at the end of the run.")
    betas: list[Below1] = Field(
        min_length=2, max_length=2, description="The two decay rates of Adam's averages, such as [0.9, 0.999]."
    )
    max_grad_norm: Positive = Field(
        description="Longer gradients are shortened to this norm; to clip nothing, write a large number such as 1e9."
    )

    @model_validator(mode="after")
    def _exponential_never_reaches_zero(self) -> Optimised:
        if self.schedule == "exponential" and self.final_lr == 0:
            raise UserValueError("have a final_lr above 0 with schedule=exponential, which never reaches 0; try 1e-6")
        return self


class Actor(Optimised):
    """The policy."""

    scale_init: Annotated[Real, Field(ge=1e-4)] = Field(
        description="The standard deviation of the policy's noise at the start."
    )
    learn_scale: bool = Field(description="Whether this noise changes with the state and in training.")
    vision: bool = Field(description="Whether the policy reads the images of a camera, where there is one.")
    recurrent: bool = Field(description="Whether a policy that sees has a memory.")
    hidden_size: int = Field(ge=1, le=65_536, description="Numbers in that memory.")
    channels: list[Annotated[int, Field(ge=1, le=4096)]] = Field(
        min_length=1, max_length=8, description="Of the convolutions of a policy that sees: [8, 16]."
    )
    noise_correlation: Below1 = Field(
        description="Of the policy's noise in two steps that follow each other; 0 is white noise."
    )
    max_kl: Positive | None = Field(
        description="How far an update, or PPO's iteration, may move the policy; null for none."
    )
    average: Share | None = Field(
        description="The share of the iterations so far over which the weights that are evaluated are averaged, such "
        "as 0.1; null for none."
    )


class Critic(Optimised):
    """The critic; some recipes add the settings of ``CRITIC``."""

    lmbda: Fraction = Field(description="The lambda of the TD(lambda) targets; 0.95 is usual.")


CRITIC: dict[str, Any] = {
    "updates": Annotated[int, Field(ge=1, le=100_000, description="Gradient steps of the critic per iteration.")],
    "batch_size": Annotated[Size, Field(description="Control steps in a minibatch of the critic.")],
    "tau": Annotated[
        Share, Field(description="The share of the critic that its target network takes over in each update.")
    ],
}


class Buffer(Section):
    """The buffer of visited states."""

    capacity: Size = Field(description="Visited states kept; the oldest go first.")
    fraction: Fraction | None = Field(description="The share of horizons that start in visited states; null for none.")


class Evaluation(Section):
    """The evaluations during training."""

    interval: Size = Field(description="Iterations between evaluations; for the last one alone, write 10000000.")
    episodes: Size | None = Field(description="Episodes of each evaluation, at least; null for one of each drone.")
    seed: Seed


class Logger(Section):
    """Loggers beside metrics.csv."""

    backend: Literal["wandb", "tensorboard", "csv"] | None
    project: str
    group: str | None
    mode: Literal["offline", "online", "disabled"]
    flight_every: Count = Field(description="Evaluations between pictures of the flight; 0 draws the last one alone.")


class Training(Section):
    """The configuration of a training run; some recipes add the settings of ``TRAINING``."""

    algorithm: str
    task: str
    seed: Seed = Field(description="Torch, the environment and the buffer draw from it.")
    resume: Annotated[str, AfterValidator(existing_checkpoint)] | None
    trust: list[str] = Field(description=TRUST)
    device: Device
    threads: Threads = Field(description="Torch threads; 1 is the fastest for tensors as small as these.")
    num_envs: Size = Field(description="Drones of each process; no memory holds more than these.")
    horizon: int = Field(ge=1, le=100_000, description="Control steps in a rollout.")
    total_steps: int = Field(ge=1, le=10**15, description="Control steps of all drones together, in the whole run.")
    compile: bool
    normalize: bool
    actor: Actor
    gamma: Fraction = Field(description="The discount of future rewards per control step; 0.99 is usual.")
    diagnostics: Count = Field(description="Evaluations between audits of reward and gradient; 0 for none.")
    max_skipped: Count = Field(description="Updates that may be left out for not being finite; 0 stops at the first.")
    eval: Evaluation
    logger: Logger

    @model_validator(mode="after")
    def _fits_into_memory(self) -> Training:
        if self.num_envs * self.horizon > MAX_ROLLOUT:
            raise ValueError(f"have num_envs times horizon at most {MAX_ROLLOUT:,}, or no memory holds a rollout")
        return self


TRAINING: dict[str, Any] = {
    "buffer": Buffer,
    "restart_fraction": Annotated[Fraction, Field(description="The share of flights that each iteration gives up.")],
    "epochs": Annotated[int, Field(ge=1, le=10_000, description="Passes over each rollout.")],
    "batch_size": Annotated[Size, Field(description="Control steps in a minibatch.")],
}


class Exporting(Section):
    """The configuration of export.py."""

    checkpoint: str
    trust: list[str] = Field(description=TRUST)
    folder: str | None = Field(description="The folder to write; null: policy, beside the checkpoint.")
    episodes: Size = Field(description="Fresh episodes to fly, side by side.")
    threads: Threads


class Flying(Section):
    """The configuration of evaluate.py."""

    checkpoint: str
    trust: list[str] = Field(description=TRUST)
    episodes: Size = Field(description="Fresh episodes to fly, side by side.")
    seed: Seed
    threads: Threads
    device: Device


class Identifying(Section):
    """The configuration of identify.py."""

    logs: list[str] = Field(min_length=1, description="The paths of flights of one drone, in a list.")
    drone: str | dict[str, Any] = Field(description="Where the fit starts: a preset, a YAML file, or a mapping.")
    mass: Positive | None = Field(description="The mass in kg, from a scale; null if unknown.")
    known: dict[str, Any] | None = Field(description="Fields of the drone that are known by measurement.")
    fields: list[str] | None = Field(description="What to fit; null for everything.")
    folder: str = Field(description="The folder to write.")
    past: NonNegative
    horizon: Positive
    iterations: Size
    draws: Count = Field(description="Of the bootstrap over windows; 0 for none.")
    seed: Seed
    threads: Threads


# -- what is declared elsewhere ----------------------------------------------------------------------------------------


def ppo(
    *,
    clip_epsilon: Annotated[Real, Field(gt=0, lt=1)] = 0.2,
    entropy_bonus: bool = True,
    entropy_coeff: NonNegative = 0.01,
    critic_coeff: Positive = 1.0,
    loss_critic_type: Literal["l1", "l2", "smooth_l1"] = "smooth_l1",
    normalize_advantage: bool = False,
    max_importance_ratio: Positive | None = None,
) -> None:
    """The options of TorchRL's ClipPPOLoss that the recipe takes.

    Args:
        clip_epsilon: how far the ratio of probabilities may move from 1; 0.2 is usual.
        entropy_bonus: whether there is one.
        entropy_coeff: its weight.
        critic_coeff: the weight of the critic's loss.
        loss_critic_type: the distance of values from their targets.
        normalize_advantage: to zero mean and unit variance in each minibatch.
        max_importance_ratio: the largest ratio of probabilities; null for any.
    """


LOSSES: dict[str, Callable[..., Any]] = {
    "abpt": ABPTLoss,
    "ahac": AHACLoss,
    "bptt": BPTTLoss,
    "hybrid": HybridLoss,
    "ppo": ppo,
    "sapo": SAPOLoss,
    "shac": SHACLoss,
}
# What a recipe builds its loss with itself.
SET_BY_LOOPS = {"horizon", "average", "reduction", "delay_value", "delay_qvalue"}
# Settings that others switch off: where, and why.
IDLE: list[tuple[str, Callable[[Any], bool], str]] = [
    ("actor.final_lr", lambda c: c["actor"]["schedule"] == "constant", "actor.schedule=constant"),
    ("critic.final_lr", lambda c: c["critic"]["schedule"] == "constant", "critic.schedule=constant"),
    ("actor.schedule actor.final_lr", lambda c: c["algorithm"] == "hybrid", "actor.max_kl sets the rate"),
    ("actor.input_scale critic.input_scale", lambda c: c["normalize"], "normalize=true"),
    ("actor.recurrent actor.hidden_size actor.channels", lambda c: c["env"].get("camera") is None, "env.camera=null"),
    ("actor.vision", lambda c: c["env"].get("camera") is None and c["actor"]["vision"], "env.camera=null"),
    ("actor.recurrent actor.hidden_size actor.channels", lambda c: not c["actor"]["vision"], "actor.vision=false"),
    ("actor.hidden_size", lambda c: not c["actor"]["recurrent"], "actor.recurrent=false"),
    ("loss.alpha_init loss.target_entropy", lambda c: c["loss"].get("alpha") != "auto", "loss.alpha is not auto"),
    ("loss.entropy_coeff", lambda c: c["loss"].get("entropy_bonus") is False, "loss.entropy_bonus=false"),
    ("env.difficulty", lambda c: c["env"].get("density") is not None, "env.density is set"),
    ("logger.project logger.group logger.mode", lambda c: c["logger"]["backend"] != "wandb", "it is wandb's"),
    ("restart_fraction", lambda c: c.get("buffer", {}).get("fraction") is not None, "buffer.fraction is set"),
]


def settings(algorithm: str) -> dict[str, Any] | None:
    """What the YAML files of a recipe set, without those for a task; None for a recipe that is unknown here."""
    config, own = OWN.get(algorithm, (algorithm, {}))
    if config not in LOSSES:
        return None
    recipe = OmegaConf.create(OmegaConf.load(CONFIG / f"{config}.yaml"))
    shared = [OmegaConf.load(CONFIG / f"{x}.yaml") for x in recipe["defaults"] if x in ("common", "critic")]
    merged = _plain(OmegaConf.merge(*shared, recipe, own))
    return {"task": None} | {name: value for name, value in merged.items() if name not in ("defaults", "hydra")}


def _plain(cfg: Any, **options: bool) -> dict[str, Any]:
    return cast("dict[str, Any]", OmegaConf.to_container(cfg, **options))


# -- the check ---------------------------------------------------------------------------------------------------------


def check(cfg: DictConfig, overrides: Sequence[str] = ()) -> None:
    """Check a configuration against the schema, and what the command line has changed in it.

    Raises:
        UserValueError: the first setting that is unknown, has the wrong type, is out of its range, or has no effect.
        UserTypeError: the task has no such option, or a path leads to a class of another kind.
    """
    try:
        chosen = OmegaConf.masked_copy(cfg, [str(name) for name in cfg if name != "hydra"])
        values = _plain(chosen, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        name = error.full_key or "a setting"
        raise UserValueError(f"{name} is missing: write {name}=... on the command line.") from None
    except OmegaConfBaseException as error:
        raise UserValueError(f"{error.full_key or 'the configuration'}: {str(error).splitlines()[0]}") from None
    _check_none(values)
    kinds: dict[str, type[Section]] = {"logs": Identifying, "folder": Exporting, "checkpoint": Flying}
    asked = {name.lstrip("+~"): value for name, _, value in (override.partition("=") for override in overrides)}
    schema = next((kind for name, kind in kinds.items() if name in values), None) or schema_of(values, asked)
    try:
        schema.model_validate(values)
    except ValidationError as error:
        raise UserValueError(_sentence(schema, error.errors()[0])) from None
    if "algorithm" in values:
        own_disturbances(values["env"].get("disturbances"))
        _check_effects(values, asked)


def schema_of(values: dict[str, Any], asked: Mapping[str, str] = MappingProxyType({})) -> type[Training]:
    """The schema of a training run, of its recipe, its task and its loss."""
    for name in ("algorithm", "task"):
        if not isinstance(values.get(name), str):
            raise UserValueError(f"{name}={shown(values.get(name))}: it must be a name.")
    known = settings(values["algorithm"])
    if known is None:  # of a recipe that is somebody's own, in another program, which may have any of these
        loss, critic = dict[str, Any], _extended(Critic, {name: (kind, None) for name, kind in CRITIC.items()})
        more = {name: (kind, None) for name, kind in {**TRAINING, "critic": critic}.items()}
    else:
        loss, more = _loss(values["algorithm"], values["loss"], asked), {}
        if "critic" in known:
            fields = {name: kind for name, kind in CRITIC.items() if name in known["critic"]}
            # What the tuned file of another recipe sets, which this one starts from, is left alone.
            rest = {name: (kind, None) for name, kind in CRITIC.items() if f"critic.{name}" not in asked}
            more = {"critic": _extended(Critic, rest | fields)}
        more |= {name: kind for name, kind in TRAINING.items() if name in known}
    return _extended(Training, {"env": _environment(values), "loss": loss, **more})


def _extended(base: type[_Section], fields: Mapping[str, Any]) -> type[_Section]:
    """A section with more settings: each a type, which makes it a must, or a type and a default."""
    return cast("Any", create_model)(base.__name__, __base__=base, **fields)


def _environment(values: dict[str, Any]) -> type[Section]:
    """The schema of the section env, from the signature of the task."""
    cls, env = task_class(values["task"]), values.get("env")
    for name in env if isinstance(env, dict) else ():
        if name in SET_BY_RECIPES:
            raise UserValueError(f"env.{name}: recipes set it for all environments. Write {name}=..., without env.")
    if isinstance(env, dict):
        check_known(cls, sorted(map(str, env)))
    kinds = declared(cls) | {"disturbances": (list[str | dict[str, Any]] | None, "")}
    return _section("Env", kinds, inspect.signature(cls).parameters)


def _loss(algorithm: str, values: Any, asked: Mapping[str, str]) -> type[Section]:
    """The schema of the section loss, from the signature of the loss, and from what a recipe of your own adds."""
    config, own = OWN.get(algorithm, (algorithm, {}))
    kind, values = LOSSES[config], values if isinstance(values, dict) else {}
    options = declared(kind)
    names = {name: None for name in options if name not in SET_BY_LOOPS} | dict(own.get("loss") or {})
    if path := values.get("_target_"):
        if not isinstance(kind, type):
            raise UserValueError(f"loss._target_={path}: this recipe takes only TorchRL's loss. Write your own recipe.")
        kind = own_loss(path, kind)
        options |= declared(kind)
        known = {*argument_names(kind), "_target_"} - SET_BY_LOOPS
        # A setting of the recipe's own loss that this one lacks is left out, but the command line must not name it.
        names = {name: None for name in (*known, *values) if name in known or f"loss.{name}" not in asked}
    options = {name: (type(x) if isinstance(x, bool | str) else Any, "") for name, x in names.items()} | options
    for name in values:
        if name not in names:
            raise UserValueError(
                f"loss.{name} is unknown, or set by the recipe. Choose from: {', '.join(sorted(names))}."
            )
    return _section("Loss", options, names)


def _section(name: str, kinds: Mapping[str, tuple[Any, str]], names: Iterable[str]) -> type[Section]:
    """A section with these options, all of which may be left out; what has no declared type its owner checks."""
    fields = {}
    for option in names:
        kind, described = kinds.get(option, (Any, ""))
        # The alias allows _target_, since a field must not start with an underscore.
        fields[option.strip("_")] = (
            kind,
            Field(None, alias=option, description=re.sub(r"\bNone\b", "null", described) or None),
        )
    return cast("Any", create_model)(name, __base__=Section, **fields)


def _check_effects(values: dict[str, Any], asked: Mapping[str, str]) -> None:
    """Refuse what the command line sets and another setting switches off, and a file in tuned/ that is not there."""
    tuned, files = asked.get("tuned", "null"), sorted(path.stem for path in (CONFIG / "tuned").glob("*.yaml"))
    if tuned not in ("null", *files):
        close = difflib.get_close_matches(tuned, files, 1) or files
        raise UserValueError(f"tuned={tuned}: {CONFIG / 'tuned'} has no such file. Choose from: {', '.join(close)}.")
    for names, is_idle, why in IDLE:
        for name in set(names.split()) & asked.keys():
            if is_idle(values):
                raise UserValueError(f"{name}={asked[name]} has no effect: {why}. Leave it out, or change that.")


def _check_none(values: Any, name: str = "") -> None:
    """Refuse the word None, which YAML reads as a string."""
    if isinstance(values, dict):
        for key, value in values.items():
            _check_none(value, f"{name}.{key}" if name else str(key))
    elif values in ("None", "none"):
        raise UserValueError(f"{name}={values}: it is the word {values!r} to YAML. For no value write {name}=null.")


def _sentence(schema: type[BaseModel] | None, error: Any) -> str:
    """One refusal: the setting, its value, what it must be, and its description."""
    name, field, value, known = "", None, error["input"], []
    for key in error["loc"]:
        if isinstance(key, int):  # an entry of a list
            name += f"[{key}]"
        elif schema is not None and (key in schema.model_fields or error["type"] == "extra_forbidden"):
            name, known = f"{name}.{key}" if name else key, list(schema.model_fields)
            field = schema.model_fields.get(key)
            kinds = [] if field is None else [field.annotation, *getattr(field.annotation, "__args__", ())]
            schema = next((x for x in kinds if isinstance(x, type) and issubclass(x, BaseModel)), None)
    if error["type"] == "extra_forbidden":
        section, _, key = name.rpartition(".")
        close = [f"{section}.{x}".lstrip(".") for x in difflib.get_close_matches(key, known, 1)]
        hint = f"Did you mean {close[0]}?" if close else "Leave it out."
        return f"{name} is unknown: this recipe has no such setting. {hint}"
    if error["type"] == "missing":
        return f"{name} is missing: do not delete it. Set it to another value instead."
    said = value[:100] if isinstance(value, str) else "null" if value is None else shown(value)
    text = "" if isinstance(value, dict) else f"={said}"
    described = "" if field is None or not field.description else field.description
    return " ".join(filter(None, (f"{name}{text}: it must {must(error)}.", described)))
