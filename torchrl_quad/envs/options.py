"""From the arguments of an environment to what disturbs its flights, and what its drones see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl_quad.dynamics import QuadrotorParams
from torchrl_quad.envs.disturbances import Disturbance, DroneRandomization, RandomStart, Sensors, Wind, build
from torchrl_quad.envs.eyes import Eye
from torchrl_quad.envs.scenes import Scene
from torchrl_quad.errors import UserTypeError
from torchrl_quad.vision import DepthCamera


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
    if not isinstance(more, Sequence):
        raise UserTypeError(f"disturbances must be a list of Disturbance, got {type(more).__name__}.")
    for disturbance in more:
        if not isinstance(disturbance, Disturbance):
            raise UserTypeError(f"disturbances: each must be a Disturbance, got {type(disturbance).__name__}.")
        chosen[f"{type(disturbance).__name__}_{len(chosen)}"] = disturbance
    if scene is not None or camera is not None:
        chosen["scene"] = Scene.of({"ground": True} if scene is None else scene).bound(nominal)
    if camera is not None:
        chosen["camera"] = Eye(DepthCamera.of(camera), chosen["scene"])
    return chosen
