"""Differentiable quadrotor tasks and first-order policy losses for TorchRL."""

# ruff: noqa: F403, F405 - type checkers know by __all__ which of these names the package has
import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_quad.controllers import *
    from torchrl_quad.data import *
    from torchrl_quad.diagnostics import *
    from torchrl_quad.dynamics import *
    from torchrl_quad.engine import *
    from torchrl_quad.envs import *
    from torchrl_quad.modules import *
    from torchrl_quad.objectives import *
    from torchrl_quad.vision import *

__version__ = "0.1.0"

__all__ = [
    "MPC",
    "ABPTLoss",
    "AHACLoss",
    "ActionSequence",
    "BPTTLoss",
    "DepthCamera",
    "DifferentiableCollector",
    "Forest",
    "ForestEnv",
    "GeometricController",
    "HoveringEnv",
    "HybridLoss",
    "LandingEnv",
    "ObservationNormalizer",
    "PODSLoss",
    "QuadrotorEnv",
    "QuadrotorParams",
    "RacingEnv",
    "SAPOLoss",
    "SHACLoss",
    "Scene",
    "TrackingEnv",
    "TrustRegion",
    "VisitedStateBuffer",
    "audit_reward",
    "available_drones",
    "available_tasks",
    "compare_gradients",
    "differentiable_rollout",
    "gradient_by_horizon",
    "gradient_statistics",
    "load_drone",
    "load_track",
    "make_actor",
    "make_env",
    "make_qvalue",
    "make_value",
    "make_visual_actor",
    "random_track",
    "register_envs",
    "register_task",
    "restart",
    "suggest_gains",
]


_PARTS = ("dynamics", "engine", "data", "modules", "objectives", "envs", "vision", "controllers", "diagnostics")
# What gymnasium registers needs no torch; envs/registry.py adds the episode lengths, which only the signatures have.
_TASKS = ("forest", "hovering", "landing", "racing", "tracking")


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: :mod:`torchrl_quad.deploy` flies where there is no torch."""
    if name in _PARTS:
        return importlib.import_module(f"{__name__}.{name}")
    for part in _PARTS if name in __all__ else ():
        module = importlib.import_module(f"{__name__}.{part}")
        if hasattr(module, name):
            return globals().setdefault(name, getattr(module, name))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PARTS})


def register_envs(*tasks: str) -> None:
    """Register tasks with gymnasium, as ``torchrl_quad/Hovering-v0`` and so on; importing the package does it.

    Your own task, ``register_task("fly_through", ...)``, is ``torchrl_quad/FlyThrough-v0``.

    Args:
        *tasks: their names; by default those of this package.
    """
    import gymnasium

    module = "torchrl_quad.adapters.gym"
    for task in tasks or _TASKS:
        name = f"torchrl_quad/{task.title().replace('_', '')}-v0"
        if name not in gymnasium.registry:
            classes = {"entry_point": f"{module}:GymEnv", "vector_entry_point": f"{module}:GymVectorEnv"}
            own = {} if task in _TASKS else {"max_episode_steps": None}  # a task of yours ends its episodes itself
            gymnasium.register(name, **classes, kwargs={"task": task, **own})


try:
    register_envs()
except ModuleNotFoundError as error:
    if error.name != "gymnasium":  # which a machine that only flies exported policies does not need
        raise
