"""The options of an environment: their types, what they are built into, and whether they fit each other."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator
from torch import Tensor

from torchrl_quad.dynamics import DYNAMICS, Dynamics, QuadrotorParams
from torchrl_quad.dynamics.gains import MAX_SUBSTEPS
from torchrl_quad.dynamics.parameters import FIELDS
from torchrl_quad.envs.any_drone import any_drone
from torchrl_quad.envs.disturbances import Disturbance, DroneRandomization, RandomStart, Sensors, Wind
from torchrl_quad.envs.scenes import MountedCamera, Scene
from torchrl_quad.errors import DroneWarning, UserTypeError, UserValueError, shown
from torchrl_quad.options import accepted, between, build, buildable, check_value, explained, imported
from torchrl_quad.vision import DepthCamera

# A larger weight would leave none of the seven digits of single precision to the others.
Weight = Annotated[float, between(-1e6, 1e6)]


def _dynamics(value: object) -> object:
    if not (isinstance(value, str) and value in DYNAMICS):  # users add to DYNAMICS
        raise UserValueError(f"be one of {', '.join(DYNAMICS)}")
    return value


FloatType = Annotated[
    Any, accepted(lambda x: x is torch.float32 or x is torch.float64, "torch.float32 or torch.float64")
]
ControlPeriod = Annotated[float, between(1e-6, 1.0)]
_DRONE = "the name of a preset, the path of a YAML file, a mapping, or QuadrotorParams"
DroneOption = Annotated[
    Any, accepted(lambda x: isinstance(x, str | Path | Mapping | QuadrotorParams) and x != "", _DRONE)
]
DynamicsOption = Annotated[Any, AfterValidator(_dynamics)]
FirmwareOption = Literal["pid", "betaflight"] | None
ControlOption = Annotated[
    Any, accepted(lambda x: isinstance(x, str | Mapping), "a name, such as rates, or a mapping with limits")
]
NoiseOption = Annotated[Any, buildable(Sensors, "observation_noise")]
WindOption = Annotated[Any, buildable(Wind, "wind")]
StartOption = Annotated[Any, buildable(RandomStart, "random_start")]
RandomizeOption = Annotated[
    Any,
    accepted(lambda x: isinstance(x, str | Path | Mapping | None) and x != "", "any, a mapping, or the path of a file"),
]
DisturbancesOption = Annotated[Any, AfterValidator(lambda value: as_disturbances(value) and value)]
SceneOption = Annotated[Any, explained(Scene.of, "scene")]
CameraOption = Annotated[Any, buildable(DepthCamera, "camera")]
WeightsOption = Annotated[
    Any,
    accepted(lambda x: isinstance(x, Mapping | None), "a mapping from terms of the reward to numbers"),
    explained(lambda weights: [check_value(str(name), x, Weight) for name, x in weights.items()], "weights"),
]


def as_disturbances(value: Any, setting: str = "disturbances") -> list[Disturbance]:
    """A user's own disturbances, from one or a list of instances, classes, paths of classes, and mappings of the path
    and arguments of one: ``{"_target_": "mypackage.GyroBias", "spread": 0.1}``."""
    is_one = isinstance(value, (str, Mapping, Disturbance, type))
    if not (is_one or isinstance(value, Sequence)):
        raise UserTypeError(f"{setting} must be a list of Disturbance, got {type(value).__name__}.")
    built = []
    for x in [value] if is_one else value:
        arguments = dict(x) if isinstance(x, Mapping) else {}
        found = arguments.pop("_target_", x)
        if isinstance(found, str):
            found = imported(found, setting)
        if isinstance(found, type) and issubclass(found, Disturbance):
            found = build(found, setting, arguments)
        if not isinstance(found, Disturbance):
            given = x if isinstance(x, str) else getattr(found, "__name__", shown(x))
            raise UserTypeError(f"{setting}={given}: it must be a subclass of Disturbance, its path, or an instance.")
        built.append(found)
    return built


def build_dynamics(nominal: QuadrotorParams, options: Mapping[str, Any]) -> Dynamics:
    """The model of the drone; a UserValueError says which options do not fit each other."""
    dt, control_dt, control = options["dt"], options["control_dt"], options["control"]
    model: Callable[..., Dynamics] = DYNAMICS[options["firmware"] or options["dynamics"]]
    if options["firmware"] and options["dynamics"] not in ("quadrotor", options["firmware"]):
        raise UserValueError(f"firmware={options['firmware']!r} flies a quadrotor. Leave out dynamics=...")
    takes_control = "control" in inspect.signature(model).parameters
    if not takes_control and control != "rates":
        raise UserValueError(
            f"dynamics={options['dynamics']!r} takes no control: its actions have a meaning of their own. Leave out "
            f"control={shown(control)}."
        )
    substeps = round(control_dt / dt)
    if not 1 <= substeps <= MAX_SUBSTEPS or not math.isclose(substeps * dt, control_dt, rel_tol=1e-6):
        raise UserValueError(
            f"control_dt must be a whole multiple of dt, at most {MAX_SUBSTEPS} times as long; got {control_dt} and "
            f"{dt}. Try control_dt={min(max(substeps, 1), MAX_SUBSTEPS) * dt:g}."
        )
    more = {"control": control} if takes_control else {}
    if drawn := any_drone(options["randomize"], nominal):
        if control != "rotor_thrusts":
            raise UserValueError(
                f"randomize='any' draws the whole drone, of which no flight controller knows; got "
                f"control={shown(control)}. Write control='rotor_thrusts'."
            )
        nominal = drawn.middle
    return model(nominal, dt=dt, substeps=substeps, integrator=options["integrator"], **more)


def build_disturbances(
    dynamics: Dynamics, drone: QuadrotorParams, options: Mapping[str, Any]
) -> dict[str, Disturbance]:
    """The disturbances by name, in the order in which they act; those of a drone with worn rotors start from these."""
    chosen: dict[str, Disturbance] = {}
    if options["random_start"]:
        chosen["random_start"] = build(RandomStart, "random_start", options["random_start"])
    if options["randomize"]:
        worn = dynamics.nominal.replace(rotor_effectiveness=drone.rotor_effectiveness)
        drawn = any_drone(options["randomize"], drone)
        drawn = drawn or DroneRandomization(options["randomize"], worn, dynamics.plant_fields)
        chosen["randomize"] = drawn
        for params in drawn.liveliest(dynamics.nominal):
            check_flown(dynamics, params, "randomize: a drawn ")
    if options["wind"] is not None:
        chosen["wind"] = build(Wind, "wind", options["wind"])
        drags = ("linear_drag", "quadratic_drag")
        if not options["randomize"] and not any(drone.value(name).any() for name in drags):
            warnings.warn("wind: this drone has no drag, so wind does not move it.", DroneWarning, stacklevel=2)
    noise, delay = options["observation_noise"] or {}, options["observation_delay"]
    sensors = build(Sensors, "observation_noise", noise, delay=delay)
    if sensors.noise_size or sensors.delay:
        chosen["sensors"] = sensors
    for disturbance in options["disturbances"]:
        chosen[f"{type(disturbance).__name__}_{len(chosen)}"] = disturbance
    scene, camera = options["scene"], options["camera"]
    if scene is not None or camera is not None:
        chosen["scene"] = scene = Scene.of({"ground": True} if scene is None else scene).bound(dynamics.nominal)
        if camera is not None:
            chosen["camera"] = MountedCamera(DepthCamera.of(camera), scene)
    return chosen


def check_flown(dynamics: Dynamics, params: QuadrotorParams, which: str = "") -> None:
    """Let the model refuse a drone that is to fly; models may leave this out."""
    try:
        getattr(dynamics, "check_flown", lambda _: None)(params)
    except UserValueError as error:
        raise UserValueError(f"{which}{error}") from None


def check_changes(
    dynamics: Dynamics, flying: QuadrotorParams, params: QuadrotorParams, starts: Mapping[Any, Disturbance]
) -> None:
    """Refuse a drone of which a change, or a gradient, would be lost: it does not count in flight, or a disturbance,
    named by entry in ``starts``, draws another value in each episode."""
    learned, plant = {k for k, x in params.fields().items() if x.requires_grad}, set(dynamics.plant_fields)
    changed = learned | {k for k in FIELDS if not _same(params.value(k), flying.value(k))}
    drawn = {key[1]: x for key, x in starts.items() if key[0] == "drone" and not x.follows_params}
    if lost := sorted(changed & drawn.keys()):
        by = drawn[lost[0]]
        who = "randomize" if isinstance(by, DroneRandomization) else type(by).__name__
        raise UserValueError(
            f"params: {who} draws {', '.join(lost)} in each episode, so this would change nothing, and would have no "
            f"gradient. Build the environment with this drone and without {who}, or change what {who} draws."
        )
    if idle := learned - plant or (set() if changed & plant else changed):
        mend = "Build the environment with this drone for another controller: HoveringEnv(drone=params)."
        raise UserValueError(
            f"params: {', '.join(sorted(idle))} would change nothing here: in flight only "
            f"{', '.join(dynamics.plant_fields)} count, and the controller keeps the nominal drone. "
            + ("No gradient reaches it: detach it." if learned & idle else mend)
        )


def _same(x: Tensor, y: Tensor) -> bool:
    """Whether values of a field are equal; rotor positions with z never equal those without."""
    return len({1, x.shape[-1], y.shape[-1]}) < 3 and bool(torch.isclose(x, y, rtol=1e-6, atol=0.0).all())


def check_forms(model: type) -> None:
    """Refuse to compile a model whose ``control_step`` alone is its own: compiled steps do not call it."""
    levels = {name: k for k, part in reversed([*enumerate(model.__mro__)]) for name in vars(part)}
    if levels["control_step"] < min(levels.get(x, 1000) for x in ("setpoint_rows", "rows_step", "physics_step")):
        raise UserValueError(
            f"{model.__name__} has a control_step of its own, which compiled steps do not call. Write setpoint_rows or "
            "rows_step for them, too, or physics_step, which both forms call."
        )


def full_signature(cls: Any, base: type) -> inspect.Signature:
    """All arguments of a task: its own, then those it hands on to its base, then ``compile``, which TorchRL takes."""
    arguments: dict[str, inspect.Parameter] = {}
    for owner in cls.__mro__[: cls.__mro__.index(base)]:
        parameters = inspect.signature(vars(owner)["__init__"]).parameters if "__init__" in vars(owner) else {}
        for name, argument in parameters.items():
            if name != "self" and argument.kind not in (argument.VAR_KEYWORD, argument.VAR_POSITIONAL):
                usual = cls.defaults.get(name, argument.default)
                arguments.setdefault(name, argument.replace(default=usual))
    option = inspect.Parameter("compile", inspect.Parameter.KEYWORD_ONLY, default=False, annotation="bool | dict")
    return inspect.Signature(sorted([*arguments.values(), option], key=lambda x: x.kind))


def known_weights(usual: Mapping[str, Any], weights: Mapping[str, Any]) -> Mapping[str, Any]:
    """The weights of a task's reward terms, with those that are given; a UserValueError names a term it lacks."""
    if unknown := [str(name) for name in weights if name not in usual]:
        raise UserValueError(f"weights: unknown term {', '.join(unknown)}. Choose from: {', '.join(usual)}.")
    return {**usual, **{name: float(x) for name, x in weights.items()}}


def check_params(params: object, num_envs: int, nominal: QuadrotorParams | None = None) -> None:
    """Check that these are parameters of one drone, or one for each environment, with the nominal one's rotors."""
    if not isinstance(params, QuadrotorParams):
        raise UserTypeError(
            f"params must be QuadrotorParams, such as env.params.replace(mass=0.5) or load_drone('visfly'); got "
            f"{type(params).__name__}."
        )
    for name, value in params.fields().items():
        batch = value.shape[0] if value.dim() > params.dim(name) else 1
        if batch not in (1, num_envs):
            raise UserValueError(f"drone: field {name!r} is for {batch} environments, and num_envs={num_envs}.")
    has, needs = (None if x is None else x.rotor_spin.shape[-1] for x in (params, nominal))
    if needs not in (None, has):
        raise UserValueError(
            f"params: this drone has {has} rotors, and the one that the controller believes in has {needs}. Build the "
            "environment with it: HoveringEnv(drone=params)."
        )
