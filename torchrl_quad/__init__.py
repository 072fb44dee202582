"""Differentiable quadrotor tasks and first-order policy losses for TorchRL."""

import gymnasium

from torchrl_quad.data import (
    DifferentiableCollector,
    ObservationNormalizer,
    VisitedStateBuffer,
    differentiable_rollout,
    restart,
)
from torchrl_quad.diagnostics import audit_reward, compare_gradients, gradient_by_horizon, gradient_statistics
from torchrl_quad.dynamics import QuadrotorParams, available_drones, load_drone
from torchrl_quad.engine import ActionSequence
from torchrl_quad.envs import (
    HoveringEnv,
    LandingEnv,
    QuadrotorEnv,
    RacingEnv,
    TrackingEnv,
    available_tasks,
    load_track,
    make_env,
    register_task,
)
from torchrl_quad.modules import make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, BPTTLoss, HybridLoss, SHACLoss, TrustRegion

__version__ = "0.1.0"

__all__ = [
    "ABPTLoss",
    "ActionSequence",
    "BPTTLoss",
    "DifferentiableCollector",
    "HoveringEnv",
    "HybridLoss",
    "LandingEnv",
    "ObservationNormalizer",
    "QuadrotorEnv",
    "QuadrotorParams",
    "RacingEnv",
    "SHACLoss",
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
    "register_envs",
    "register_task",
    "restart",
]


def register_envs() -> None:
    """Register the tasks with gymnasium, as ``torchrl_quad/Hovering-v0`` and so on; importing the package does it.

    A task of your own, ``register_task("fly_through", ...)``, is ``torchrl_quad/FlyThrough-v0``.
    """
    for task in available_tasks():
        name = f"torchrl_quad/{task.title().replace('_', '')}-v0"
        if name not in gymnasium.registry:
            classes = {"entry_point": "torchrl_quad.gym:GymEnv", "vector_entry_point": "torchrl_quad.gym:GymVectorEnv"}
            gymnasium.register(name, **classes, kwargs={"task": task})


register_envs()
