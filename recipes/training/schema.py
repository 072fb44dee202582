"""The schema of the configuration: the type and the range of every setting, checked before a run makes its folder.

A setting is refused with its name, its value, what it must be, and the sentence that describes it here. Settings that
this schema leaves open (``Any``, and further entries of ``env`` and ``loss``) are checked by the environment and by the
loss themselves.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from torchrl_quad.envs import task_class
from torchrl_quad.envs.checks import refuse_unknown
from torchrl_quad.errors import UserValueError
from training.own import SET_BY_RECIPES, option_types


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

Real = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[Real, Field(gt=0)]
Fraction = Annotated[Real, Field(ge=0, le=1)]
Share = Annotated[Real, Field(gt=0, le=1)]
Count = Annotated[int, Field(ge=0, le=10**9)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Size = Annotated[int, Field(ge=1, le=10_000_000)]
Device = Annotated[str, AfterValidator(available_device)]
Threads = Annotated[int, Field(ge=1, le=1024)]
ACTIVATIONS = (
    "CELU ELU GELU Hardswish LeakyReLU Mish PReLU ReLU SELU SiLU Sigmoid Softplus Softsign Tanh"  # of torch.nn
)
Activation = Literal[tuple(ACTIVATIONS.split())]  # type: ignore[valid-type]


class Section(BaseModel):
    """A section of the configuration: nothing is converted, and no setting is unknown."""

    model_config = ConfigDict(strict=True, extra="forbid")


class Env(Section):
    """The arguments of the environment; it checks itself what is not listed here."""

    model_config = ConfigDict(strict=True, extra="allow")
    dynamics: Literal["quadrotor", "point_mass"]
    control: Literal["rates", "attitude", "rotor_thrusts", "velocity"] | dict[str, Any] = Field(
        "rates", description="A mapping sets limits, too: {mode: velocity, max_speed: 5.0}."
    )
    dt: Positive = Field(description="The physics step [s].")
    control_dt: Positive = Field(description="The control step [s], a whole multiple of env.dt.")
    action_delay: int = Field(ge=0, le=1000, description="Control steps from a command to its effect; 1 is usual.")
    observation_delay: int = Field(ge=0, le=1000, description="Control steps by which observations lag behind.")
    max_episode_steps: Size = Field(description="Control steps after which an episode is truncated.")
    observe_last_action: bool
    event_discount: Share | None = Field(
        None, description="The discount per control step by which the time of an event counts; null: no gradient in it."
    )


class Optimised(Section):
    """A network and its optimiser."""

    num_cells: list[Annotated[int, Field(ge=1, le=65_536)]] = Field(
        description="The width of every hidden layer, in a list: [64, 64], or [64] for a single layer."
    )
    activation: Activation
    input_scale: Positive = Field(description="The observation is multiplied by this.")
    lr: Positive = Field(description="The learning rate at the start; to keep a network as it is, write 1e-12.")
    schedule: Literal["constant", "linear", "exponential", "cosine"]
    final_lr: Annotated[Real, Field(ge=0)] = Field(description="The learning rate at the end of the run.")
    betas: list[Annotated[Real, Field(ge=0, lt=1)]] = Field(
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
    noise_correlation: Annotated[Real, Field(ge=0, lt=1)] = Field(
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


class Loss(Section):
    """The options of the loss; it checks itself what is not listed here."""

    model_config = ConfigDict(strict=True, extra="allow")
    alpha: Annotated[Real, Field(ge=0)] | Literal["auto"] = Field(
        None, description="The coefficient of the entropy bonus: a number, 0 for none, or auto to learn it."
    )
    clip_action_gradient: Positive | None = Field(
        None, description="The longest gradient in one action, in running medians; null for no bound."
    )
    terminal_gradient: bool = Field(None)
    target_bootstrap: bool = Field(None)
    average_over_horizon: bool = Field(None)
    alpha_init: Positive = Field(None, description="What alpha=auto starts from.")
    target_entropy: Annotated[Real, Field(lt=0)] | Literal["auto"] = Field(
        None, description="Where alpha=auto holds the entropy; auto for minus the size of the action (SAPO: half)."
    )
    simulated_steps: int = Field(
        None, ge=0, le=100_000, description="Control steps that ABPT's return of the start flies before its critic."
    )
    min_horizon: Size | None = Field(None, description="The shortest horizon; null for a quarter of horizon.")
    max_horizon: Size | None = Field(None, description="The longest horizon; null for twice horizon.")
    max_stiffness: Annotated[Real, Field(gt=1)] = Field(
        None, description="Where the action gradients grow beyond it along a horizon, the horizon gets shorter."
    )
    horizon_lr: Annotated[Real, Field(ge=0, lt=1)] = Field(
        None, description="The share by which the horizon may change in an iteration."
    )
    num_value_nets: int = Field(None, ge=1, le=64, description="Critics of states.")
    num_qvalue_nets: int = Field(None, ge=1, le=64, description="Critics whose smallest value counts.")
    gradient_lmbda: Share = Field(
        None, description="The lambda of the return that the pathwise gradient differentiates; 0.9 is usual."
    )
    clip_epsilon: Annotated[Real, Field(gt=0, lt=1)] = Field(
        None, description="How far the ratio of probabilities may move from 1; 0.2 is usual."
    )
    max_importance_ratio: Positive | None = Field(None, description="The largest ratio of probabilities; null for any.")
    critic_coeff: Positive = Field(None, description="The weight of the critic's loss.")
    entropy_coeff: Annotated[Real, Field(ge=0)] = Field(None, description="The weight of the entropy bonus.")


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
    env: Env
    normalize: bool
    actor: Actor
    critic: Critic | None = None
    loss: Loss
    buffer: Buffer | None = None
    restart_fraction: Fraction = Field(None, description="The share of flights that each iteration gives up.")
    epochs: int = Field(None, ge=1, le=10_000, description="Passes over each rollout.")
    batch_size: Size = Field(None, description="Control steps in a minibatch.")
    gamma: Fraction = Field(description="The discount of future rewards per control step; 0.99 is usual.")
    diagnostics: Count = Field(description="Evaluations between audits of reward and gradient; 0 for none.")
    max_skipped: Count = Field(description="Updates that may be left out for not being finite; 0 stops at the first.")
    eval: Evaluation
    logger: Logger


class Flying(Section):
    """The configuration of evaluate.py."""

    checkpoint: str
    episodes: Size = Field(description="Fresh episodes to fly, side by side.")
    seed: Seed
    threads: Threads
    device: Device


class Exporting(Section):
    """The configuration of export.py."""

    checkpoint: str
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
    past: Annotated[Real, Field(ge=0)]
    horizon: Positive
    iterations: Size
    draws: Count = Field(description="Of the bootstrap over windows; 0 for none.")
    seed: Seed
    threads: Threads


# -- the check ---------------------------------------------------------------------------------------------------------


def check(cfg: DictConfig) -> None:
    """Check a configuration against the schema, and the options of its task against the signature of its class.

    Raises:
        ValueError: the first setting that has the wrong type or is out of its range, and what to write instead.
        TypeError: the task has no such option.
    """
    try:
        settings = OmegaConf.masked_copy(cfg, [name for name in cfg if name != "hydra"])
        values = OmegaConf.to_container(settings, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        name = error.full_key or "a setting"
        raise UserValueError(f"{name} is missing: write {name}=... on the command line.") from None
    _refuse_none(values)
    kinds = {"logs": Identifying, "folder": Exporting, "checkpoint": Flying}
    schema = next((kind for name, kind in kinds.items() if name in values), Training)
    if isinstance(values.get("task"), str) and isinstance(values.get("env"), dict):
        schema = _with_options(values["task"], values["env"])
    try:
        schema.model_validate(values)
    except ValidationError as error:
        raise UserValueError(_sentence(schema, error.errors()[0])) from None


def _with_options(task: str, env: dict[str, Any]) -> type[Training]:
    """The schema of a training run on this task."""
    cls = task_class(task)
    for name in env:
        if name in SET_BY_RECIPES:
            raise UserValueError(f"env.{name}: recipes set it for all environments. Write {name}=..., without env.")
    refuse_unknown(cls, sorted(set(env) - set(inspect.signature(cls).parameters)))
    kinds = {name: (Real if kind is float else kind, None) for name, kind in option_types(cls).items()}
    kinds = {name: kind for name, kind in kinds.items() if name not in Env.model_fields}
    return create_model("Training", __base__=Training, env=(create_model("Env", __base__=Env, **kinds), ...))


def _refuse_none(values: Any, name: str = "") -> None:
    """Refuse the word None, which YAML reads as a string."""
    if isinstance(values, dict):
        for key, value in values.items():
            _refuse_none(value, f"{name}.{key}" if name else str(key))
    elif values in ("None", "none"):
        raise UserValueError(f"{name}={values}: it is the word {values!r} to YAML. For no value write {name}=null.")


_TYPES = {  # pydantic's kinds of error in plain words
    "int_type": "be a whole number",
    "float_type": "be a number",
    "bool_type": "be true or false",
    "string_type": "be a string",
    "list_type": "be a list",
    "model_type": "be a section with settings of its own",
}


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
        return f"{name} is unknown: recipes/training/schema.py has no such setting. Look for a misspelling."
    said = error["msg"].removeprefix("Value error, ").removeprefix("Input should ").replace(" after validation", "")
    for long, short in (("greater than or equal to", "at least"), ("less than or equal to", "at most")):
        said = said.replace(long, short)
    must = _TYPES.get(error["type"], said.replace("List should have", "have"))
    if error["type"] == "int_type" and isinstance(value, float) and value.is_integer():
        must += f", written {int(value)}"
    shown = "" if isinstance(value, dict) else f"={'null' if value is None else value}"
    return " ".join(filter(None, (f"{name}{shown}: it must {must}.", field and field.description)))
