"""Differentiable quadrotor tasks and first-order policy losses for TorchRL."""

import gymnasium

from torchrl_quad.data import ObservationNormalizer, VisitedStateBuffer, differentiable_rollout, restart
from torchrl_quad.diagnostics import audit_reward, compare_gradients, gradient_by_horizon, gradient_statistics
from torchrl_quad.dynamics import QuadrotorParams, available_drones, load_drone
from torchrl_quad.engine import ActionSequence
from torchrl_quad.envs import TASKS, HoveringEnv, LandingEnv, QuadrotorEnv, RacingEnv, TrackingEnv, load_track, make_env
from torchrl_quad.modules import make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, SAPOLoss, SHACLoss, TrustRegion

__version__ = "0.1.0"

__all__ = [
    "ABPTLoss",
    "AHACLoss",
    "ActionSequence",
    "BPTTLoss",
    "HoveringEnv",
    "LandingEnv",
    "ObservationNormalizer",
    "QuadrotorEnv",
    "QuadrotorParams",
    "RacingEnv",
    "SAPOLoss",
    "SHACLoss",
    "TrackingEnv",
    "TrustRegion",
    "VisitedStateBuffer",
    "audit_reward",
    "available_drones",
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
    "restart",
]


def register_envs() -> None:
    """Register the tasks with gymnasium, as ``torchrl_quad/Hovering-v0`` and so on; importing the package does it."""
    for task in TASKS:
        name = f"torchrl_quad/{task.capitalize()}-v0"
        if name not in gymnasium.registry:
            classes = {"entry_point": "torchrl_quad.gym:GymEnv", "vector_entry_point": "torchrl_quad.gym:GymVectorEnv"}
            gymnasium.register(name, **classes, kwargs={"task": task})


register_envs()
