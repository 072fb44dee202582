"""The schema of the configuration: the type and the range of every setting, checked before a run makes its folder.

A setting is refused with its name, its value, what it must be, and the sentence that describes it. The settings in
``env`` and ``loss`` are declared by the signatures of the task and of the loss, all others here. Which of them a recipe
has, its YAML files say.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

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
    check_known,
    declared,
    must,
)
from torchrl_quad.training.own import CONFIG, OWN, SET_BY_RECIPES

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
    """The critic; that of PPO has no target network."""

    lmbda: Fraction = Field(description="The lambda of the TD(lambda) targets; 0.95 is usual.")
    updates: int = Field(None, ge=1, le=100_000, description="Gradient steps of the critic per iteration.")
    batch_size: Size = Field(None, description="Control steps in a minibatch of the critic.")
    tau: Share = Field(None, description="The share of the critic that its target network takes over in each update.")


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
    """The configuration of a training run."""

    algorithm: str
    task: str
    seed: Seed = Field(description="Torch, the environment and the buffer draw from it.")
    resume: Annotated[str, AfterValidator(existing_checkpoint)] | None
    device: Device
    threads: Threads = Field(description="Torch threads; 1 is the fastest for tensors as small as these.")
    num_envs: Size = Field(description="Drones of each process; more than these fit into no memory.")
    horizon: int = Field(ge=1, le=100_000, description="Control steps in a rollout.")
    total_steps: int = Field(ge=1, le=10**15, description="Control steps of all drones together, in the whole run.")
    compile: bool
    normalize: bool
    actor: Actor
    critic: Critic = Field(None)
    buffer: Buffer = Field(None)
    restart_fraction: Fraction = Field(None, description="The share of flights that each iteration gives up.")
    epochs: int = Field(None, ge=1, le=10_000, description="Passes over each rollout.")
    batch_size: Size = Field(None, description="Control steps in a minibatch.")
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


OWN_TASK = Field(description="The class of the checkpoint's task, where that has no registered name.")


class Flying(Section):
    """The configuration of evaluate.py."""

    checkpoint: str
    own_task: str | None = OWN_TASK
    episodes: Size = Field(description="Fresh episodes to fly, side by side.")
    seed: Seed
    threads: Threads
    device: Device


class Exporting(Section):
    """The configuration of export.py."""

    checkpoint: str
    own_task: str | None = OWN_TASK
    folder: str | None = Field(description="The folder to write; null: policy, beside the checkpoint.")
    episodes: Size = Field(description="Fresh episodes to fly, side by side.")
    threads: Threads


class Identifying(Section):
    """The configuration of identify.py."""

    logs: list[str] = Field(min_length=1, description="The paths of flights of one drone, in a list.")
    drone: str | dict[str, Any] = Field(description="Where the fit starts: a preset, a YAML file, or a mapping.")
    mass: Positive | None = Field(description="The mass in kg, from a scale; null where it is not known.")
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
    """What the YAML files of a recipe set, without those for a task; None for a recipe that is not known here."""
    config, own = OWN.get(algorithm, (algorithm, {}))
    if not (CONFIG / f"{config}.yaml").is_file() or config not in LOSSES:
        return None
    recipe = OmegaConf.load(CONFIG / f"{config}.yaml")
    shared = [OmegaConf.load(CONFIG / f"{x}.yaml") for x in recipe.pop("defaults") if x in ("common", "critic")]
    merged = OmegaConf.merge(*shared, recipe, own)
    known = OmegaConf.to_container(OmegaConf.masked_copy(merged, [name for name in merged if name != "hydra"]))
    return {"task": None} | known


# -- the check ---------------------------------------------------------------------------------------------------------


def check(cfg: DictConfig, overrides: Sequence[str] = ()) -> None:
    """Check a configuration against the schema, and what the command line has changed in it.

    Raises:
        UserValueError: the first setting that is unknown, has the wrong type, is out of its range, or has no effect.
        UserTypeError: the task has no such option.
    """
    try:
        chosen = OmegaConf.masked_copy(cfg, [name for name in cfg if name != "hydra"])
        values = OmegaConf.to_container(chosen, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        name = error.full_key or "a setting"
        raise UserValueError(f"{name} is missing: write {name}=... on the command line.") from None
    except OmegaConfBaseException as error:
        raise UserValueError(f"{error.full_key or 'the configuration'}: {str(error).splitlines()[0]}") from None
    _refuse_none(values)
    kinds = {"logs": Identifying, "folder": Exporting, "checkpoint": Flying}
    asked = {name.lstrip("+~"): value for name, _, value in (override.partition("=") for override in overrides)}
    schema = next((kind for name, kind in kinds.items() if name in values), None) or schema_of(values, asked)
    try:
        schema.model_validate(values)
    except ValidationError as error:
        raise UserValueError(_sentence(schema, error.errors()[0])) from None
    if "algorithm" in values:
        _refuse_idle(values, asked)


def schema_of(values: dict[str, Any], asked: Mapping[str, str]) -> type[Training]:
    """The schema of a training run, of its recipe, its task and its loss, if these have what was asked for."""
    for name in ("algorithm", "task"):
        if not isinstance(values.get(name), str):
            raise UserValueError(f"{name}={shown(values.get(name))}: it must be a name.")
    known = settings(values["algorithm"])
    _refuse_unread(known or values, asked)
    if known is None:  # of a recipe that is somebody's own, in another program
        return create_model("Training", __base__=Training, env=(_environment(values), ...), loss=(dict[str, Any], ...))
    _require_all(values, known)
    sections = {"env": _environment(values), "loss": _loss(values["algorithm"], values["loss"])}
    return create_model("Training", __base__=Training, **{name: (kind, ...) for name, kind in sections.items()})


def _require_all(values: Mapping[str, Any], known: Mapping[str, Any], section: str = "") -> None:
    """Refuse to go without settings that the files of the recipe have, and the command line has deleted."""
    for name in known:
        if name not in values:
            raise UserValueError(f"{section}{name} is missing: do not delete it. Set it to another value instead.")
        if name not in ("env", "loss") and isinstance(known[name], Mapping) and isinstance(values[name], Mapping):
            _require_all(values[name], known[name], f"{section}{name}.")


def _environment(values: dict[str, Any]) -> Any:
    """The schema of the section env, from the signature of the task."""
    cls, env = task_class(values["task"]), values.get("env")
    for name in env if isinstance(env, dict) else ():
        if name in SET_BY_RECIPES:
            raise UserValueError(f"env.{name}: recipes set it for all environments. Write {name}=..., without env.")
    if isinstance(env, dict):
        check_known(cls, sorted(map(str, env)))
    return _section("Env", declared(cls), inspect.signature(cls).parameters)


def _loss(algorithm: str, values: Any) -> Any:
    """The schema of the section loss, from the signature of the loss, and from what a recipe of one's own adds."""
    config, own = OWN.get(algorithm, (algorithm, {}))
    options = {name: kind for name, kind in declared(LOSSES[config]).items() if name not in SET_BY_LOOPS}
    added = {name: (type(x) if isinstance(x, bool | str) else Any, "") for name, x in (own.get("loss") or {}).items()}
    options = {**added, **options}
    for name in values if isinstance(values, dict) else ():
        if name not in options:
            raise UserValueError(
                f"loss.{name} is unknown, or set by the recipe. Choose from: {', '.join(sorted(options))}."
            )
    return _section("Loss", options, options)


def _section(name: str, kinds: Mapping[str, tuple[Any, str]], names: Iterable[str]) -> Any:
    """A section with these options, all of which may be left out; what has no declared type its owner checks."""
    fields = {}
    for option in names:
        kind, described = kinds.get(option, (Any, ""))
        fields[option] = (kind, Field(None, description=re.sub(r"\bNone\b", "null", described) or None))
    return create_model(name, __base__=Section, **fields)


def _refuse_unread(known: dict[str, Any], asked: Mapping[str, str]) -> None:
    """Refuse settings on the command line that the recipe has not, and a file in tuned/ that is not there."""
    node = OmegaConf.create(known)
    for name in asked:
        section, *inner = name.split(".")
        is_known = section in ("env", "loss", "tuned") or "/" in name or OmegaConf.select(node, name, default="") != ""
        if not is_known:
            among = known.get(section, {}) if inner else known
            close = difflib.get_close_matches(name.split(".")[-1], map(str, among), 1)
            hint = f"Did you mean {'.'.join([section, *close] if inner else close)}?" if close else "Leave it out."
            raise UserValueError(f"{name} is unknown: this recipe has no such setting. {hint}")
    tuned = asked.get("tuned", "null")
    files = sorted(path.stem for path in (CONFIG / "tuned").glob("*.yaml"))
    if tuned not in ("null", *files):
        close = difflib.get_close_matches(tuned, files, 1) or files
        raise UserValueError(
            f"tuned={tuned}: there is no such file in recipes/config/tuned. Choose from: {', '.join(close)}."
        )


def _refuse_idle(values: dict[str, Any], asked: Mapping[str, str]) -> None:
    """Refuse what the command line sets and another setting switches off."""
    for names, is_idle, why in IDLE:
        for name in set(names.split()) & asked.keys():
            if is_idle(values):
                raise UserValueError(f"{name}={asked[name]} has no effect: {why}. Leave it out, or change that.")


def _refuse_none(values: Any, name: str = "") -> None:
    """Refuse the word None, which YAML reads as a string."""
    if isinstance(values, dict):
        for key, value in values.items():
            _refuse_none(value, f"{name}.{key}" if name else str(key))
    elif values in ("None", "none"):
        raise UserValueError(f"{name}={values}: it is the word {values!r} to YAML. For no value write {name}=null.")


def _sentence(schema: type[BaseModel], error: Any) -> str:
    """One refusal: the setting, its value, what it must be, and its description."""
    name, field, value = "", None, error["input"]
    for key in error["loc"]:
        if isinstance(key, int):  # an entry of a list
            name += f"[{key}]"
        elif schema is not None and (key in schema.model_fields or error["type"] == "extra_forbidden"):
            name += f".{key}" if name else key
            field = schema.model_fields.get(key)
            kinds = [] if field is None else [field.annotation, *getattr(field.annotation, "__args__", ())]
            schema = next((x for x in kinds if isinstance(x, type) and issubclass(x, BaseModel)), None)
    if error["type"] == "extra_forbidden":
        return f"{name} is unknown: there is no such setting. Look for a misspelling."
    if error["type"] == "missing":
        return f"{name} is missing: write {name}=... on the command line."
    said = value[:100] if isinstance(value, str) else "null" if value is None else shown(value)
    text = "" if isinstance(value, dict) else f"={said}"
    described = "" if field is None or not field.description else field.description
    return " ".join(filter(None, (f"{name}{text}: it must {must(error)}.", described)))
