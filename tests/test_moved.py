"""An environment on another device, and one that is no longer compiled. The device cpu:0 stands for any other one."""

import torch
from torchrl.envs import check_env_specs

from torchrl_quad import HoveringEnv

OPTIONS = {"num_envs": 4, "seed": 5, "dtype": torch.float64, "randomize": {"mass": {"scale": [0.8, 1.2]}}}
OPTIONS |= {"wind": {"mean": [1.0, 0.0, 0.0], "gust": 0.5}, "observation_noise": {"position": 0.01}}
OPTIONS |= {"scene": {"spheres": [{"count": 2, "low": [-1, -1, 0], "high": [1, 1, 3], "radius": 0.1}]}}
OPTIONS |= {"camera": {"width": 3, "height": 2, "noise": 0.01}}


def assert_equal(one, other):
    one, other = (dict(td.items(include_nested=True, leaves_only=True)) for td in (one, other))
    assert one.keys() == other.keys()
    assert [key for key, x in one.items() if not torch.equal(x.cpu(), other[key].cpu())] == []


def hover(env, steps):
    return env.rollout(steps, lambda td: td.set("action", env.hover_action.expand(env.num_envs, 4)))


def test_an_environment_that_moves_keeps_its_drone_and_begins_anew_from_its_seed():
    moved, fresh = HoveringEnv(**OPTIONS), HoveringEnv(**OPTIONS)
    for env in (moved, fresh):
        env.params = env.params.replace(mass=0.5)
    hover(moved, 3)
    assert moved.to("cpu:0") is moved
    assert moved.device == moved.randomness.device == torch.device("cpu:0")
    assert moved.params.mass.item() == 0.5 != moved.nominal.mass.item() == fresh.nominal.mass.item()
    for _ in range(2):  # the second episode draws on
        assert_equal(hover(moved, 5), hover(fresh, 5))
    check_env_specs(moved)


def test_an_environment_that_flies_its_nominal_drone_does_so_where_it_moves():
    env = HoveringEnv(num_envs=2, max_episode_steps=7).to("cpu:0")
    assert env.params is env.nominal
    assert env.rollout(9)["next", "state", "step"].flatten().max() == 7


def test_an_environment_stays_compiled_where_it_moves_until_it_is_made_eager():
    env, fresh = (HoveringEnv(num_envs=2, camera={"width": 3, "height": 2}, scene={"ground": True}) for _ in range(2))
    assert env.compile(backend="eager") is env and env.is_compiled
    assert env.to("cpu:0").is_compiled and env.disturbances["camera"].is_compiled
    assert env.eager() is env and not (env.is_compiled or env.disturbances["camera"].is_compiled)
    assert_equal(hover(env, 3), hover(fresh, 3))
