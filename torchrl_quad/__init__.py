"""Differentiable quadrotor tasks and first-order policy losses for TorchRL."""

from torchrl_quad.data import ObservationNormalizer, VisitedStateBuffer, differentiable_rollout
from torchrl_quad.dynamics import QuadrotorParams, available_drones, load_drone
from torchrl_quad.envs import HoveringEnv, LandingEnv, QuadrotorEnv, RacingEnv, TrackingEnv, load_track, make_env
from torchrl_quad.modules import make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, BPTTLoss, SHACLoss

__version__ = "0.1.0"

__all__ = [
    "ABPTLoss",
    "BPTTLoss",
    "HoveringEnv",
    "LandingEnv",
    "ObservationNormalizer",
    "QuadrotorEnv",
    "QuadrotorParams",
    "RacingEnv",
    "SHACLoss",
    "TrackingEnv",
    "VisitedStateBuffer",
    "available_drones",
    "differentiable_rollout",
    "load_drone",
    "load_track",
    "make_actor",
    "make_env",
    "make_qvalue",
    "make_value",
]
