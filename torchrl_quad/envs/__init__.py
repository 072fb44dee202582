"""Quadrotor tasks as TorchRL environments whose tensordicts carry gradients."""

from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.forest import Forest, ForestEnv
from torchrl_quad.envs.hovering import HoveringEnv
from torchrl_quad.envs.landing import LandingEnv
from torchrl_quad.envs.racing import RacingEnv
from torchrl_quad.envs.registry import TASKS, available_tasks, make_env, register_task, task_class
from torchrl_quad.envs.scenes import Scene
from torchrl_quad.envs.task import Task
from torchrl_quad.envs.terms import Event, ball_entry, level_crossing
from torchrl_quad.envs.track import load_track, random_track
from torchrl_quad.envs.tracking import TrackingEnv

__all__ = [
    "TASKS",
    "Disturbance",
    "Event",
    "Forest",
    "ForestEnv",
    "HoveringEnv",
    "LandingEnv",
    "QuadrotorEnv",
    "RacingEnv",
    "Scene",
    "Task",
    "TrackingEnv",
    "available_tasks",
    "ball_entry",
    "level_crossing",
    "load_track",
    "make_env",
    "random_track",
    "register_task",
    "task_class",
]
