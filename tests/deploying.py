"""Small policies to export, and a state to fly them from."""

import torch
from torchrl.envs import TransformedEnv

from torchrl_quad import ObservationNormalizer, make_actor, make_env, make_visual_actor

CAMERA = {"width": 6, "height": 5, "pitch": 0.2, "rate": 2, "delay": 1, "noise": 0.02, "dropout": 0.05}
SIZES = {"num_cells": (7,), "channels": (2, 3)}
TASKS = {  # with all that policies may read, spread over the tasks
    "hovering": {},
    "tracking": {"curve": "lemniscate", "observe_last_action": True, "action_delay": 2},
    "landing": {
        "observation_noise": {"position": 0.01, "attitude": 0.05},
        "observation_delay": 1,
        "randomize": {"mass": {"scale": [0.8, 1.2]}, "motor_time_constant": {"uniform": [0.02, 0.05]}},
        "wind": {"mean": [1, 0, 0], "gust": 0.5},
        "random_start": {"tilt": 0.5, "yaw": 3.0},
    },
    "racing": {"action_delay": 0},
    "forest": {"camera": CAMERA, "density": 0.05, "random_start": {"tilt": 0.5, "yaw": 3.0, "velocity": 3.0}},
    "forest, blind": {"camera": None, "density": 0.01, "observe_velocity": False, "observe_last_action": True},
    "hovering, without memory": {"camera": {"width": 5, "height": 4, "position": [0.1, 0, 0], "along_ray": True}},
}
NORMALIZED = ("tracking", "racing", "forest")


def build(name, num_envs=16):
    """An environment whose policy is untrained but moves, with its normaliser if it has one."""
    torch.manual_seed(0)
    env = make_env(name.split(",")[0], num_envs=num_envs, **{"max_episode_steps": 48, **TASKS[name]})
    if name in NORMALIZED:
        env = TransformedEnv(env, ObservationNormalizer(env))
        env.transform.update(env.rollout(20, break_when_any_done=False))
    if "depth" in env.observation_spec:
        actor = make_visual_actor(env, **SIZES, hidden_size=4, recurrent="without" not in name, input_scale=0.3)
        last = actor[0][-1].module.mlp[-1]
    else:
        actor = make_actor(env, (16, 16))
        last = actor[0].module.mlp[-1]
    with torch.no_grad():
        last.weight.add_(0.3 * torch.randn_like(last.weight))
    return env, actor


def resting(**changes):
    """A level drone at rest near the target of hovering, as a bundle takes it."""
    still = {"position": [1, 0, 1.4], "quaternion": [1, 0, 0, 0], "velocity": [0, 0, 0], "angular_velocity": [0, 0, 0]}
    return {**still, "age": 0.0, **changes}
