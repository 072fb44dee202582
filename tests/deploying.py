"""Small policies to export, and a state to fly them from."""

import torch
from torchrl.envs import TransformedEnv

from torchrl_quad import ObservationNormalizer, make_actor, make_env

TASKS = {  # with all that observations may hold, spread over the tasks
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
}
NORMALIZED = ("tracking", "racing")


def build(task, num_envs=16):
    """An environment whose policy is untrained but moves, with its normaliser if it has one."""
    torch.manual_seed(0)
    env = make_env(task, num_envs=num_envs, max_episode_steps=48, **TASKS[task])
    if task in NORMALIZED:
        env = TransformedEnv(env, ObservationNormalizer(env))
        env.transform.update(env.rollout(20, break_when_any_done=False))
    actor = make_actor(env, (16, 16))
    with torch.no_grad():
        actor[0].module.mlp[-1].weight.add_(0.3 * torch.randn_like(actor[0].module.mlp[-1].weight))
    return env, actor


def resting(**changes):
    """A level drone at rest near the target of hovering, as a bundle takes it."""
    still = {"position": [1, 0, 1.4], "quaternion": [1, 0, 0, 0], "velocity": [0, 0, 0], "angular_velocity": [0, 0, 0]}
    return {**still, "age": 0.0, **changes}
