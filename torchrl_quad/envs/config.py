"""The options of an environment: their types, what they are built into, and whether they fit each other."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import AfterValidator
from torch import Tensor

from torchrl_quad.dynamics import DYNAMICS, Dynamics, QuadrotorParams
from torchrl_quad.envs.disturbances import Disturbance, DroneRandomization, RandomStart, Sensors, Wind
from torchrl_quad.envs.scenes import MountedCamera, Scene
from torchrl_quad.envs.task import Task
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.options import Explained, accepted, between, build, buildable, check_value, imported
from torchrl_quad.vision import DepthCamera

MAX_SUBSTEPS = 200  # physics steps of a control step, which take half a second without compilation
# Numbers of all states of an environment and of the noise of 32 steps: 2 GB in single precision, 64 on an accelerator.
MAX_NUMBERS = 2**29
MAX_NUMBERS_ELSEWHERE = 2**34
# A larger weight would leave none of the seven digits of single precision to the others.
Weight = Annotated[float, between(-1e6, 1e6)]


# -- types of options --------------------------------------------------------------------------------------------------


def _names(keys: Iterable[object]) -> str:
    return ", ".join(map(str, keys))


def _dynamics(value: object) -> object:
    if not (isinstance(value, str) and value in DYNAMICS):  # users add to DYNAMICS
        raise UserValueError(f"be one of {_names(DYNAMICS)}")
    return value


def _scene(value: Any) -> object:
    try:
        return value if value is None else Scene.of(value)
    except UserValueError as error:
        raise Explained(str(error).removeprefix("scene: ")) from None


def _weights(weights: object) -> object:
    if weights is None:
        return None
    if not isinstance(weights, Mapping):
        raise UserValueError("be a mapping from terms of the reward to numbers")
    for name, value in weights.items():
        x = value.detach() if isinstance(value, Tensor) else value
        if isinstance(x, Tensor) and x.numel() == 1 and not (x.is_complex() or x.dtype == torch.bool):
            x = x.item()
        try:
            check_value(str(name), x, Weight)
        except UserValueError as error:
            raise Explained(str(error)) from None
    return weights


def _is_file_or(*kinds: type) -> Callable[[object], bool]:
    return lambda value: isinstance(value, (str, Path, Mapping, *kinds)) and value != ""


DroneOption = Annotated[
    Any,
    accepted(
        _is_file_or(QuadrotorParams), "the name of a preset, the path of a YAML file, a mapping, or QuadrotorParams"
    ),
]
DynamicsOption = Annotated[Any, AfterValidator(_dynamics)]
ControlOption = Annotated[
    Any, accepted(lambda x: isinstance(x, str | Mapping), "a name, such as rates, or a mapping with limits")
]
NoiseOption = Annotated[Any, buildable(Sensors, "observation_noise")]
WindOption = Annotated[Any, buildable(Wind, "wind")]
StartOption = Annotated[Any, buildable(RandomStart, "random_start")]
RandomizeOption = Annotated[Any, accepted(_is_file_or(type(None)), "a mapping, or the path of a YAML file")]
DisturbancesOption = Annotated[Any, AfterValidator(lambda value: as_disturbances(value) and value)]
SceneOption = Annotated[Any, AfterValidator(_scene)]
CameraOption = Annotated[Any, buildable(DepthCamera, "camera")]
WeightsOption = Annotated[Any, AfterValidator(_weights)]


def as_disturbances(value: Any) -> list[Disturbance]:
    """A user's own disturbances, from one or a list of instances, classes, paths of classes, and mappings of the path
    and arguments of one: ``{"_target_": "mypackage.GyroBias", "spread": 0.1}``."""
    is_one = isinstance(value, (str, Mapping, Disturbance, type))
    if not (is_one or isinstance(value, Sequence)):
        raise UserTypeError(f"disturbances must be a list of Disturbance, got {type(value).__name__}.")
    built = []
    for x in [value] if is_one else value:
        arguments = dict(x) if isinstance(x, Mapping) else {}
        found = arguments.pop("_target_", x)
        found = imported(found, "disturbance") if isinstance(found, str) else found
        if isinstance(found, type) and issubclass(found, Disturbance):
            found = build(found, "disturbances", arguments)
        if not isinstance(found, Disturbance):
            got = getattr(found, "__name__", type(found).__name__)
            raise UserTypeError(f"disturbances: each must be a Disturbance, its class, or its path; got {got}.")
        built.append(found)
    return built


# -- what is built of them ---------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What the dynamics and the disturbances of an environment are built of, and built of again on another device.

    Raises:
        ValueError: the options do not fit each other.
    """

    dynamics: str
    control: str | Mapping[str, object]
    dt: float
    control_dt: float
    action_delay: int
    integrator: str
    observe_last_action: bool
    random_start: RandomStart | Mapping[str, object] | None
    randomize: str | Path | Mapping[str, object] | None
    wind: Wind | Mapping[str, object] | None
    observation_noise: Sensors | Mapping[str, object] | None
    observation_delay: int
    disturbances: Sequence[Disturbance]
    scene: Scene | str | Path | Mapping[str, object] | None
    camera: DepthCamera | Mapping[str, object] | None

    def __post_init__(self) -> None:
        if not self.takes_control and self.control != "rates":
            raise UserValueError(
                f"dynamics={self.dynamics!r} takes no control: its actions have a meaning of their own. Leave out "
                f"control={shown(self.control)}."
            )
        substeps = self.substeps
        fits = math.isclose(substeps * self.dt, self.control_dt, rel_tol=1e-6)
        if not (1 <= substeps <= MAX_SUBSTEPS and fits):
            raise UserValueError(
                f"control_dt must be a whole multiple of dt, at most {MAX_SUBSTEPS} times as long; got "
                f"{self.control_dt} and {self.dt}. Try control_dt={min(max(substeps, 1), MAX_SUBSTEPS) * self.dt:g}."
            )
        if self.action_delay == 0 and self.observe_last_action:
            raise UserValueError(
                "observe_last_action shows the commands that are on their way; with action_delay=0 there are none."
            )

    @property
    def substeps(self) -> int:
        """Physics steps of a control step."""
        return round(self.control_dt / self.dt)

    @property
    def takes_control(self) -> bool:
        """Whether the model of the dynamics has a choice of what actions command."""
        return "control" in inspect.signature(DYNAMICS[self.dynamics]).parameters

    def build_dynamics(self, nominal: QuadrotorParams) -> Dynamics:
        """The model of the drone."""
        model: Callable[..., Dynamics] = DYNAMICS[self.dynamics]
        control = {"control": self.control} if self.takes_control else {}
        return model(nominal, dt=self.dt, substeps=self.substeps, integrator=self.integrator, **control)

    def build_disturbances(self, dynamics: Dynamics) -> dict[str, Disturbance]:
        """The disturbances by name, in the order in which they act."""
        chosen: dict[str, Disturbance] = {}
        if self.random_start:
            chosen["random_start"] = build(RandomStart, "random_start", self.random_start)
        if self.randomize:
            chosen["randomize"] = DroneRandomization(self.randomize, dynamics.nominal, dynamics.plant_fields)
        if self.wind is not None:
            chosen["wind"] = build(Wind, "wind", self.wind)
        sensors = build(Sensors, "observation_noise", self.observation_noise or {}, delay=self.observation_delay)
        if sensors.noise_size or sensors.delay:
            chosen["sensors"] = sensors
        for disturbance in self.disturbances:
            chosen[f"{type(disturbance).__name__}_{len(chosen)}"] = disturbance
        if self.scene is not None or self.camera is not None:
            scene = Scene.of({"ground": True} if self.scene is None else self.scene).bound(dynamics.nominal)
            chosen["scene"] = scene
            if self.camera is not None:
                chosen["camera"] = MountedCamera(DepthCamera.of(self.camera), scene)
        return chosen


def full_signature(cls: type, base: type) -> inspect.Signature:
    """All arguments of a task: its own, then those it hands on to its base, then ``compile``, which TorchRL takes."""
    arguments: dict[str, inspect.Parameter] = {}
    for owner in cls.__mro__[: cls.__mro__.index(base)]:
        parameters = inspect.signature(vars(owner)["__init__"]).parameters if "__init__" in vars(owner) else {}
        for name, argument in parameters.items():
            if name != "self" and argument.kind not in (argument.VAR_KEYWORD, argument.VAR_POSITIONAL):
                arguments.setdefault(name, argument)
    option = inspect.Parameter("compile", inspect.Parameter.KEYWORD_ONLY, default=False, annotation="bool | dict")
    return inspect.Signature(sorted([*arguments.values(), option], key=lambda x: x.kind))


# -- checks that no type can express -----------------------------------------------------------------------------------


def check_compilation(options: Mapping[str, Any]) -> None:
    """Check that torch.compile takes these keywords, which it would find out at the first step."""
    known = [*list(inspect.signature(torch.compile).parameters)[1:], "warmup"]
    modes, backends = [None, *torch._inductor.list_mode_options()], torch.compiler.list_backends(())
    settings = torch._inductor.list_options()

    def are_settings(value: object) -> bool:
        return value is None or (isinstance(value, Mapping) and all(x.replace("-", "_") in settings for x in value))

    kinds = {
        "fullgraph": bool,
        "dynamic": bool | None,
        "disable": bool,
        "mode": Annotated[Any, accepted(lambda x: x in modes, f"one of {_names(modes)}")],
        "backend": Annotated[Any, accepted(lambda x: callable(x) or x in backends, f"one of {_names(backends)}")],
        "options": Annotated[Any, accepted(are_settings, "a mapping of what torch._inductor.list_options() lists")],
    }
    for name, value in options.items():
        if name not in known:
            raise UserTypeError(f"compile: torch.compile takes no {shown(name)}. Choose from: {_names(known)}.")
        check_value(f"compile: {name}", value, kinds.get(name, Any))


def check_weights(weights: Mapping[str, Any], known: Mapping[str, Any]) -> Mapping[str, Any]:
    """The weights of reward terms, if each is a number and the task has these terms."""
    unknown = [str(name) for name in weights if name not in known]
    if unknown:
        raise UserValueError(f"weights: unknown term {_names(unknown)}. Choose from: {_names(known)}.")
    return check_value("weights", dict(weights), WeightsOption)


def check_params(params: object, num_envs: int) -> None:
    """Check that these are the parameters of one drone, or of one for each environment."""
    if not isinstance(params, QuadrotorParams):
        raise UserTypeError(
            f"params must be QuadrotorParams, such as env.params.replace(mass=0.5) or load_drone('visfly'); got "
            f"{type(params).__name__}."
        )
    for name, value in params.fields().items():
        batch = value.shape[0] if value.dim() > params.dim(name) else 1
        if batch not in (1, num_envs):
            raise UserValueError(f"drone: field {name!r} is for {batch} environments, and num_envs={num_envs}.")


def check_memory(env: Task) -> None:
    """Check that states and noise fit into memory: many environments, each with long delays or large images, may not.

    Raises:
        ValueError: they do not.
    """
    most = MAX_NUMBERS if env.randomness.device.type == "cpu" else MAX_NUMBERS_ELSEWHERE
    each = {"flight": 100, "action_delay": 4 * env.action_delay}
    for name, disturbance in env.disturbances.items():
        each[name] = 32 * disturbance.noise_size
        if isinstance(disturbance, Sensors):
            each[name] += 13 * (disturbance.delay + 1)
        elif isinstance(disturbance, MountedCamera):
            each[name] += disturbance.camera.pixels * (disturbance.kept + 1)
    count = env.num_envs * sum(each.values())
    if count > most:
        raise UserValueError(
            f"num_envs={env.num_envs:,} environments need {count:,} numbers in memory; the maximum is {most:,}, and "
            f"{max(each, key=lambda name: each[name])} needs most of them. Give fewer environments, shorter delays, or "
            "smaller images."
        )
