"""From the arguments of an environment to what disturbs its flights, and what its drones see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator

from torchrl_quad.dynamics import DYNAMICS, QuadrotorParams
from torchrl_quad.envs.disturbances import Disturbance, DroneRandomization, RandomStart, Sensors, Wind
from torchrl_quad.envs.eyes import Eye
from torchrl_quad.envs.scenes import Scene
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import Explained, accepted, build, buildable
from torchrl_quad.vision import DepthCamera

# Numbers of all states of an environment and of the noise of 32 steps: 2 GB in single precision, 64 on an accelerator.
MAX_NUMBERS, MAX_NUMBERS_ELSEWHERE = 2**29, 2**34


def _disturbances(value: Any) -> Any:
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise UserTypeError(f"disturbances must be a list of Disturbance, got {type(value).__name__}.")
    for disturbance in value:
        if not isinstance(disturbance, Disturbance):
            raise UserTypeError(f"disturbances: each must be a Disturbance, got {type(disturbance).__name__}.")
    return value


def _dynamics(value: Any) -> Any:
    if not (isinstance(value, str) and value in DYNAMICS):  # which users extend
        raise UserValueError(f"be one of {', '.join(DYNAMICS)}")
    return value


def _scene(value: Any) -> Any:
    try:
        return value if value is None else Scene.of(value)
    except UserValueError as error:
        raise Explained(str(error).removeprefix("scene: ")) from None


def _is_file_or(*kinds: type) -> Any:
    return lambda value: isinstance(value, (str, Path, Mapping, *kinds)) and value != ""


#: The types of an environment's options that are no plain numbers.
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
RandomizeOption = Annotated[
    Any, accepted(lambda x: x is None or _is_file_or()(x), "a mapping, or the path of a YAML file")
]
DisturbancesOption = Annotated[Any, AfterValidator(_disturbances)]
SceneOption = Annotated[Any, AfterValidator(_scene)]
CameraOption = Annotated[Any, buildable(DepthCamera, "camera")]


def choose_disturbances(
    nominal: QuadrotorParams,
    plant_fields: Sequence[str],
    random_start: Any,
    randomize: Any,
    wind: Any,
    observation_noise: Any,
    observation_delay: int,
    more: Sequence[Disturbance],
    scene: Any,
    camera: Any,
) -> dict[str, Disturbance]:
    """The disturbances that an environment's arguments ask for, by name, in the order in which they act."""
    chosen: dict[str, Disturbance] = {}
    if random_start:
        chosen["random_start"] = build(RandomStart, "random_start", random_start)
    if randomize:
        chosen["randomize"] = DroneRandomization(randomize, nominal, plant_fields)
    if wind is not None:
        chosen["wind"] = build(Wind, "wind", wind)
    sensors = build(Sensors, "observation_noise", observation_noise or {}, delay=observation_delay)
    if sensors.noise_size or sensors.delay:
        chosen["sensors"] = sensors
    for disturbance in more:
        chosen[f"{type(disturbance).__name__}_{len(chosen)}"] = disturbance
    if scene is not None or camera is not None:
        chosen["scene"] = Scene.of({"ground": True} if scene is None else scene).bound(nominal)
    if camera is not None:
        chosen["camera"] = Eye(DepthCamera.of(camera), chosen["scene"])
    return chosen


def require_room(env: Any) -> None:
    """Refuse what would not fit into memory: many environments, each with long delays or large images.

    Raises:
        ValueError: it would not.
    """
    most = MAX_NUMBERS if env.device.type == "cpu" else MAX_NUMBERS_ELSEWHERE
    each = {"flight": 100, "action_delay": 4 * env.action_delay}
    each |= {name: 32 * x.noise_size for name, x in env.disturbances.items()}
    if "sensors" in each:
        each["sensors"] += 13 * (env.disturbances["sensors"].delay + 1)
    if "camera" in each:
        each["camera"] += env.camera.pixels * (env.disturbances["camera"].kept + 1)
    count = env.num_envs * sum(each.values())
    if count > most:
        raise UserValueError(
            f"num_envs={env.num_envs:,} environments need {count:,} numbers in memory, and {most:,} are the most; "
            f"{max(each, key=each.get)} needs most of them. Give fewer environments, shorter delays, or smaller images."
        )
