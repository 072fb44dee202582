"""Time limits and bounds of the gymnasium environments, and the warning that one drone is slow."""

import gymnasium
import numpy as np

from torchrl_quad.adapters.gym import GymEnv, GymVectorEnv
from torchrl_quad.envs import TASKS

HOVERING = "torchrl_quad/Hovering-v0"


def test_the_time_limit_is_the_task_s_own():
    limits = {task: gymnasium.spec(f"torchrl_quad/{task.capitalize()}-v0").max_episode_steps for task in TASKS}
    assert limits == {"hovering": 256, "landing": 256, "racing": 512, "tracking": 512, "forest": 900}
    envs = gymnasium.make_vec(HOVERING, num_envs=2, max_episode_steps=3)
    for env, actions in ((GymEnv("hovering", max_episode_steps=3), np.zeros(4)), (envs, np.zeros((2, 4)))):
        env.reset()
        assert [np.all(env.step(actions)[3]) for _ in range(3)] == [False, False, True]
    for options, limit in (({"max_episode_steps": 2}, 2), ({"max_episode_steps": 260}, 260)):
        env = gymnasium.make(HOVERING, **options)
        assert env.spec.max_episode_steps == limit
        env.reset(seed=0)
        hover, steps = env.unwrapped.torchrl_env.hover_action.numpy(), 1
        while not env.step(hover)[3]:
            steps += 1
        assert steps == limit


def test_the_space_of_the_observation_has_the_bounds_of_the_task():
    for task, box in (
        ("hovering", [5, 5, 6]),
        ("landing", [5, 5, 6]),
        ("tracking", [10, 10, 6]),
        ("racing", [15, 16, 6]),
    ):
        space = GymVectorEnv(task, 2).single_observation_space
        body = [*4 * [10], *3 * [50], *3 * [50]]
        assert space.high[:3].tolist() == box
        assert (space.high[-10:].tolist(), (-space.low).tolist()) == (body, space.high.tolist())
    env = GymVectorEnv("hovering", 1, observe_last_action=True, observation_noise={"position": 100.0})
    assert env.single_observation_space.high[-4:].tolist() == [1, 1, 1, 1]
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    assert (abs(observation[0, :3]) == [5, 5, 6]).any()
