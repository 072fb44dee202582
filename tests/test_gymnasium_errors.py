"""What the gymnasium environments refuse, and how they say it."""

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded

from torchrl_quad.adapters.gym import GymEnv, GymVectorEnv
from torchrl_quad.errors import UserError

HOVERING = "torchrl_quad/Hovering-v0"


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros((3, 3)), r"The action has shape \(3, 3\), expected \(3, 4\), one row per drone."),
        (np.zeros(4), r"shape \(4,\), expected \(3, 4\)"),
        (None, r"must be an array of floats .*; got NoneType of object"),
        (np.zeros((3, 4), int), r"must be an array of floats of shape \(3, 4\) .*; got ndarray of int64"),
        ([[0.0] * 4, [0.0]], "must be an array of floats .* env.action_space.sample.*; got list"),
        ([[0, 0, 0, 0], [0, np.nan, 0, 0], [0, 0, 0, np.inf]], r"NaN or infinite at \[\[1, 1\], \[2, 3\]\]"),
    ],
)
def test_an_action_that_cannot_be_flown_is_refused(action, message):
    env = GymVectorEnv("hovering", 3)
    env.reset()
    with pytest.raises(UserError, match=message):
        env.step(action)


def test_one_drone_s_action_is_refused_in_its_own_words():
    env = GymEnv("hovering")
    env.reset()
    with pytest.raises(ValueError, match=r"shape \(3,\), expected \(4,\)\.$"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"NaN or infinite at \[\[2\]\]\. .* nan_to_num"):
        env.step([0, 0, np.nan, 0])


def test_unknown_options_are_refused_with_those_that_exist():
    with pytest.raises(ValueError, match="autoreset_mode must be 'NextStep', 'SameStep' or 'Disabled', got 'same'"):
        GymVectorEnv("hovering", autoreset_mode="same")
    with pytest.raises(ValueError, match="num_envs is for many drones: write gymnasium.make_vec."):
        gymnasium.make(HOVERING, num_envs=2)
    for build in (GymEnv, GymVectorEnv):
        with pytest.raises(ValueError, match="render_mode must be 'rgb_array', got 'human'"):
            build("hovering", render_mode="human")
    with pytest.raises(TypeError, match="control_dt"):
        GymEnv("hovering", frameskip=2)


@pytest.mark.parametrize("mask", [[True, False], np.ones(3), np.zeros(3, dtype=bool), np.ones((3, 1), dtype=bool)])
def test_a_reset_mask_has_to_mark_some_of_the_drones(mask):
    with pytest.raises(ValueError, match=r"reset_mask must be a bool array of shape \(3,\) .* leave it out"):
        GymVectorEnv("hovering", 3).reset(options={"reset_mask": mask})


@pytest.mark.parametrize("build", [GymEnv, GymVectorEnv])
def test_what_cannot_begin_an_episode_is_refused_before_anything_changes(build):
    env, undisturbed = build("hovering", seed=0), build("hovering", seed=0)
    for seed in (-1, 2**63, 10**5000, 0.5, "0", True, [0]):
        with pytest.raises(UserError, match="seed must be "):
            env.reset(seed=seed)
    for options in ("reset_mask", [1], {"seed": 0}, {"reset_mask": None}, {"reset_mask": [[True], [True, False]]}):
        with pytest.raises(UserError, match=r"options|reset_mask must be"):
            env.reset(seed=1, options=options)
    np.testing.assert_array_equal(env.reset(options={})[0], undisturbed.reset()[0])
    env.close()
    for call in (env.reset, lambda: env.step(env.action_space.sample()), env.render):
        with pytest.raises(ClosedEnvironmentError, match="has been closed: make another one"):
            call()


def test_a_step_outside_an_episode_is_refused():
    env = GymVectorEnv("hovering", 2, autoreset_mode="Disabled", max_episode_steps=1)
    with pytest.raises(ResetNeeded, match=r"begin together: call reset\(\) without reset_mask first"):
        env.reset(options={"reset_mask": [True, False]})
    with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
        env.step(np.zeros((2, 4)))
    env.reset()
    env.step(np.zeros((2, 4)))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ResetNeeded, match=r"episodes of drones \[1\] have ended. Call reset\(\) before"):
        env.step(np.zeros((2, 4)))
