"""The tasks as gymnasium environments: its checkers, its vector environments, its wrappers."""

import copy
import importlib
import importlib.metadata
import sys
from functools import partial
from itertools import combinations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence, data_shares_objects
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from helpers import refuses, run
from torchrl import envs as torchrl_envs

import torchrl_quad
from torchrl_quad import load_drone
from torchrl_quad.adapters.gym import GymEnv, GymVectorEnv
from torchrl_quad.errors import UserError

TASKS = ["forest", "hovering", "landing", "racing", "tracking"]
MODES = list(AutoresetMode)
HOVERING = "torchrl_quad/Hovering-v0"


def name(task):
    return f"torchrl_quad/{task.capitalize()}-v0"


def sinking(env, heights):
    """Start every episode at the same heights [m], on the way down: the lower a drone begins, the sooner it crashes."""
    state = env.torchrl_env.reset()["state"].clone()
    state["position"][:, 2] = torch.as_tensor(heights)
    state["velocity"][:, 2] = -1.0
    state["position"][:, :2] = state["target"][:, :2]
    env.torchrl_env.set_initial_state_source(lambda n: state.clone())
    return env


def some_actions(steps, num_envs, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, num_envs, 4)).astype(np.float32)


def test_gymnasium_imports_the_package_by_its_prefix_environments_when_they_are_made_and_what_draws_not_before():
    program = (
        "import contextlib, sys, gymnasium\n"
        "with contextlib.suppress(gymnasium.error.Error):\n"
        "    gymnasium.make('torchrl_quad:torchrl_quad/Walking-v0')\n"
        f"assert gymnasium.spec('{HOVERING}').vector_entry_point == 'torchrl_quad.adapters.gym:GymVectorEnv'\n"
        "assert 'torchrl_quad.adapters.gym' not in sys.modules\n"
        f"gymnasium.make('torchrl_quad:{HOVERING}').reset()\n"
        f"gymnasium.make_vec('torchrl_quad:{HOVERING}', num_envs=2).reset()\n"
        "assert not {'torchrl_quad.render', 'matplotlib'} & set(sys.modules)\n"
    )
    run(sys.executable, "-c", program)


def test_registering_again_changes_nothing_and_warns_of_nothing():
    (plugin,) = importlib.metadata.entry_points(group="gymnasium.envs", name="torchrl_quad")
    specs = {task: gymnasium.spec(name(task)) for task in TASKS}
    plugin.load()()
    importlib.reload(torchrl_quad)
    assert all(gymnasium.spec(name(task)) is specs[task] for task in TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_s_checker_finds_nothing(task):
    check_env(gymnasium.make(name(task), max_episode_steps=-1, render_mode="rgb_array").unwrapped)


def test_torchrl_can_wrap_the_gymnasium_environment():
    wrapped = torchrl_envs.GymWrapper(gymnasium.make(HOVERING))
    for env in (wrapped, torchrl_envs.GymEnv("torchrl_quad/Racing-v0", track="visfly")):
        torchrl_envs.check_env_specs(env)
        env.set_seed(0)
        assert env.rollout(5)["next", "reward"].shape == (5, 1)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_and_types_are_those_that_gymnasium_expects(task):
    env = gymnasium.make_vec(name(task), num_envs=3)
    assert isinstance(env, GymVectorEnv) and env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.single_action_space == gymnasium.spaces.Box(-1, 1, (4,)) and env.action_space.shape == (3, 4)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    observation, reward, *flags, info = env.step(env.action_space.sample())
    assert observation in env.observation_space
    parts = observation if task == "forest" else {"observation": observation}  # with an image beside the vector
    assert {*(x.dtype for x in parts.values())} == {np.dtype(np.float32)} and reward.dtype == np.float64
    flags += [info["success"], info["_success"], info["crash"]]
    assert reward.shape == (3,) and {(x.shape, x.dtype) for x in flags} == {((3,), np.dtype(bool))}
    np.testing.assert_allclose(sum(x for key, x in info["reward_terms"].items() if key[0] != "_"), reward, atol=1e-6)
    assert {key for key in info if key[0] != "_"} == {"success", "crash", "reward_terms", "metrics"}


@pytest.mark.parametrize("mode", MODES)
def test_episodes_end_and_begin_as_in_gymnasium_s_own_vector_environment(mode):
    options = {"dtype": torch.float64, "max_episode_steps": 7}
    heights = [0.05, 0.08, 0.11, 1.5, 1.5]
    mine = sinking(GymVectorEnv("hovering", 5, autoreset_mode=mode, **options), heights)
    singles = [partial(lambda z: sinking(GymEnv("hovering", **options), z), z) for z in heights]
    its = SyncVectorEnv(singles, autoreset_mode=mode)
    assert mine.metadata["autoreset_mode"] == its.metadata["autoreset_mode"]
    assert mine.observation_space == its.observation_space and mine.action_space == its.action_space
    assert data_equivalence(mine.reset(), its.reset())
    ends = np.zeros((2, 5))
    for actions in some_actions(30, 5):
        flown = mine.step(actions)
        assert data_equivalence(flown, its.step(actions))
        over, ends = flown[2] | flown[3], ends + flown[2:4]
        if mode is AutoresetMode.DISABLED and over.any():
            again = [env.reset(options={"reset_mask": over}) for env in (mine, its)]
            assert data_equivalence(*again)
    crashes, timeouts = ends
    assert crashes[0] > crashes[1] > crashes[2] > crashes[3] == crashes[4] == 0
    assert (timeouts[3:] > 2).all()


@pytest.mark.parametrize("mode", MODES)
def test_many_drones_give_a_picture_each_of_where_they_are(mode):
    options = {"dtype": torch.float64, "max_episode_steps": 7, "render_mode": "rgb_array"}
    env = sinking(GymVectorEnv("hovering", 2, autoreset_mode=mode, **options), [0.05, 1.5])
    env.reset()
    for actions in some_actions(20, 2):
        _, _, terminated, truncated, _ = env.step(actions)
        over = terminated | truncated
        if terminated[0] and not truncated[1]:
            break
    if mode is AutoresetMode.DISABLED:
        env.reset(options={"reset_mask": over})
    elif mode is AutoresetMode.NEXT_STEP:
        env.step(actions)
    assert env.now["state", "step"][0] == 0 < env.now["state", "step"][1]  # one has begun anew, the other flies on
    first, second = env.render()
    assert (first != second).any()
    env.torchrl_env.reset(env.now.clone(), set_state=True)
    for i, picture in enumerate((first, second)):
        np.testing.assert_array_equal(picture, env.torchrl_env.render([i]))


def test_without_a_render_mode_or_an_episode_there_is_no_picture():
    env = GymEnv("hovering")
    env.reset()
    with pytest.warns(UserWarning, match='draws nothing without render_mode="rgb_array"'):
        assert env.render() is None
    for build in (GymEnv, GymVectorEnv):
        refuses(r"call reset\(\) first", build("hovering", render_mode="rgb_array").render, error=ResetNeeded)


def test_a_seed_repeats_the_flight_no_seed_goes_on_drawing_and_environments_that_nobody_seeds_start_differently():
    env = GymVectorEnv("hovering", 4, wind={"gust": 1.0})

    def fly(seed):
        first = env.reset(seed=seed)[0]
        return np.stack([first, *(env.step(actions)[0] for actions in some_actions(5, 4)), env.reset()[0]])

    np.testing.assert_array_equal(fly(5), fly(5))
    assert (fly(5) != fly(6))[:, :, :3].any((1, 2)).all() and (fly(5)[0] != fly(None)[0]).any()
    for options in ({}, {"seed": 3}):
        one, other = (GymEnv("hovering", **options).reset()[0] for _ in range(2))
        assert (one == other).all() == bool(options)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_what_is_handed_out_belongs_to_the_caller(mode):
    def fly(disturb):
        env = GymVectorEnv("racing", 3, seed=0, max_episode_steps=3, autoreset_mode=mode)
        env.reset()
        calls = []
        for actions in some_actions(8, 3):
            observation, *ends, info = env.step(actions)
            calls.append((np.array(observation), copy.deepcopy(ends), copy.deepcopy(info)))
            if disturb:
                actions[:] = np.nan
                for x in (observation, *ends, *info["metrics"].values(), *info["reward_terms"].values()):
                    x[:] = 1
        return calls

    assert data_equivalence(fly(disturb=True), fly(disturb=False), exact=True)
    env = GymVectorEnv("racing", 3, max_episode_steps=2, autoreset_mode=mode)
    env.reset()
    flown = [env.step(actions) for actions in some_actions(4, 3)]
    assert not any(data_shares_objects(a, b) for a, b in combinations(flown, 2))
    assert all(not data_shares_objects(a, b) for step in flown for a, b in combinations(arrays(step), 2))


def arrays(result):
    """All arrays in what a step returns, but those of objects."""
    if isinstance(result, np.ndarray) and result.dtype != object:
        return [result]
    entries = result.values() if isinstance(result, dict) else () if result is None else result
    return [x for entry in entries for x in arrays(entry)]


def test_options_reach_the_torchrl_environment_and_no_gradient_is_kept():
    drone = load_drone("visfly")
    env = GymVectorEnv("hovering", 2, drone=drone.replace(mass=drone.mass.clone().requires_grad_()), control_dt=0.01)
    assert env.torchrl_env.params.mass.requires_grad
    assert env.torchrl_env.control_dt == 0.01 and env.metadata["render_fps"] == 100
    env.reset()
    env.step(some_actions(1, 2)[0])
    assert not any(x.requires_grad for x in env.now.values(True, True))


def test_the_time_limit_is_the_task_s_own():
    limits = {task: gymnasium.spec(f"torchrl_quad/{task.capitalize()}-v0").max_episode_steps for task in TASKS}
    assert limits == {"hovering": 256, "landing": 256, "racing": 512, "tracking": 512, "forest": 900}
    envs = gymnasium.make_vec(HOVERING, num_envs=2, max_episode_steps=3)
    for env, actions in ((GymEnv("hovering", max_episode_steps=3), np.zeros(4)), (envs, np.zeros((2, 4)))):
        env.reset()
        assert [np.all(env.step(actions)[3]) for _ in range(3)] == [False, False, True]
    for limit in (2, 260):
        env = gymnasium.make(HOVERING, max_episode_steps=limit)
        assert env.spec.max_episode_steps == limit
        env.reset(seed=0)
        hover, steps = env.unwrapped.torchrl_env.hover_action.numpy(), 1
        while not env.step(hover)[3]:
            steps += 1
        assert steps == limit


def test_the_space_of_the_observation_has_the_bounds_of_the_task():
    for task, box in {"hovering": [5, 5, 6], "tracking": [10, 10, 6], "racing": [15, 16, 6]}.items():
        space = GymVectorEnv(task, 2).single_observation_space
        body = [*4 * [10], *3 * [50], *3 * [50]]
        assert space.high[:3].tolist() == box
        assert (space.high[-10:].tolist(), (-space.low).tolist()) == (body, space.high.tolist())
    env = GymVectorEnv("hovering", 1, observe_last_action=True, observation_noise={"position": 100.0})
    assert env.single_observation_space.high[-4:].tolist() == [1, 1, 1, 1]
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space and (abs(observation[0, :3]) == [5, 5, 6]).any()


def made(*options, **more):
    return lambda: GymVectorEnv("hovering", *options, **more)


def flown(action, build=GymVectorEnv, **options):
    def fly():
        env = build("hovering", **options)
        env.reset()
        env.step(action)

    return fly


def masked(mask):
    return lambda: GymVectorEnv("hovering", 3).reset(options={"reset_mask": mask})


MASK = r"reset_mask must be a bool array of shape \(3,\) .* leave it out"
REFUSED = [
    (flown(np.zeros((3, 3)), num_envs=3), r"action has shape \(3, 3\), expected \(3, 4\), one row per drone."),
    (flown(None, num_envs=3), "must be an array of floats .*; got NoneType of object"),
    (flown(np.zeros((3, 4), int), num_envs=3), r"must be .* floats of shape \(3, 4\) .*; got ndarray of int64"),
    (flown([[0.0] * 4, [0.0]], num_envs=3), "must be an array of floats .* env.action_space.sample.*; got list"),
    (flown([[0, 0, 0, 0], [0, np.nan, 0, np.inf]], num_envs=2), r"NaN or infinite at \[\[1, 1\], \[1, 3\]\]"),
    (flown(np.zeros(3), GymEnv), r"shape \(3,\), expected \(4,\)\.$"),
    (flown([0, 0, np.nan, 0], GymEnv), r"NaN or infinite at \[\[2\]\]\. .* nan_to_num"),
    (made(autoreset_mode="same"), "autoreset_mode must be 'NextStep', 'SameStep' or 'Disabled', got 'same'"),
    (made(render_mode="human"), "render_mode must be 'rgb_array', got 'human'"),
    (lambda: GymEnv("hovering", render_mode="human"), "render_mode must be 'rgb_array', got 'human'"),
    (lambda: GymEnv("hovering", frameskip=2), "control_dt"),
    (lambda: gymnasium.make(HOVERING, num_envs=2), "num_envs is for many drones: write gymnasium.make_vec."),
    *((masked(mask), MASK) for mask in ([True, False], np.ones(3), np.zeros(3, dtype=bool), np.ones((3, 1), bool))),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_what_cannot_be_built_reset_or_flown_is_refused(call, message):
    refuses(message, call, error=UserError)


@pytest.mark.parametrize("build", [GymEnv, GymVectorEnv])
def test_what_cannot_begin_an_episode_is_refused_and_nothing_begins_after_the_end(build):
    env = build("hovering")
    for options, message in (({"seed": -1}, "seed must be "), ({"options": {"seed": 0}}, "options: .* may hold")):
        refuses(message, env.reset, error=UserError, **options)
    env.close()
    for call in (env.reset, lambda: env.step(env.action_space.sample()), env.render):
        refuses("has been closed: make another one", call, error=ClosedEnvironmentError)


def test_a_step_outside_an_episode_is_refused():
    env = GymVectorEnv("hovering", 2, autoreset_mode="Disabled", max_episode_steps=1)
    with pytest.raises(ResetNeeded, match=r"begin together: call reset\(\) without reset_mask first"):
        env.reset(options={"reset_mask": [True, False]})
    refuses(r"call reset\(\) first", env.step, np.zeros((2, 4)), error=ResetNeeded)
    env.reset()
    env.step(np.zeros((2, 4)))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ResetNeeded, match=r"episodes of drones \[1\] have ended. Call reset\(\) before"):
        env.step(np.zeros((2, 4)))
