"""The tasks for other frameworks; each adapter imports its framework when you ask for it."""

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
