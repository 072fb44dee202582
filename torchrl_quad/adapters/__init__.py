"""The tasks for other frameworks; each adapter imports its framework when you ask for it.

==================  ==============================  ==================================
adapter             wraps                           for
==================  ==============================  ==================================
``GymVectorEnv``    a task, by its name             gymnasium: many drones
``GymEnv``          a task, by its name             gymnasium: one drone
``TorchVectorEnv``  a TorchRL environment           loops in plain torch, as CleanRL's
``RslRlVecEnv``     a TorchRL environment           rsl-rl's ``OnPolicyRunner``
``SkrlEnv``         a TorchRL environment           skrl's agents and trainers
``DronesVecEnv``    gymnasium's vector environment  stable-baselines3
==================  ==============================  ==================================
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_quad.adapters.gym import Closed, GymEnv, GymVectorEnv, ResetNeeded
    from torchrl_quad.adapters.rsl_rl import RslRlVecEnv
    from torchrl_quad.adapters.skrl import SkrlEnv
    from torchrl_quad.adapters.stable_baselines3 import DronesVecEnv
    from torchrl_quad.adapters.torch_vector import TorchVectorEnv

__all__ = [
    "Closed",
    "DronesVecEnv",
    "GymEnv",
    "GymVectorEnv",
    "ResetNeeded",
    "RslRlVecEnv",
    "SkrlEnv",
    "TorchVectorEnv",
]
_MODULES = {
    **dict.fromkeys(("Closed", "GymEnv", "GymVectorEnv", "ResetNeeded"), "gym"),
    "DronesVecEnv": "stable_baselines3",
    "RslRlVecEnv": "rsl_rl",
    "SkrlEnv": "skrl",
    "TorchVectorEnv": "torch_vector",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"{__name__} has no {name!r}. Choose from: {', '.join(__all__)}.")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
