"""States from outside: what a step, a rollout and a reset accept, and what they refuse by name."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_quad import differentiable_rollout, make_actor, make_env

nan = float("nan")
LARGEST = torch.iinfo(torch.int64).max
RANDOM = {"randomize": {"mass": {"scale": [0.9, 1.1]}, "thrust_map": {"scale": [0.9, 1.1]}}, "wind": {"gust": 0.5}}


@pytest.mark.parametrize(
    ("task", "key", "value", "message"),
    [
        ("hovering", ("drone", "mass"), 0.0, r"\('drone', 'mass'\) must be finite and between 0.001 and 1000"),
        ("hovering", ("drone", "mass"), -1.0, r"\('drone', 'mass'\) must be finite and between"),
        ("hovering", "wind", 1e5, "'wind' must be finite and between -300 and 300"),
        ("hovering", "position", nan, "'position' must be finite and between"),
        ("hovering", "quaternion", 0.9, "'quaternion' must have unit norm"),
        ("hovering", "rotor_speed", -1e5, "'rotor_speed' must be finite and between"),
        ("hovering", "action_queue", nan, "'action_queue' must be finite and between"),
        ("hovering", "step", LARGEST, "'step' must lie between 0 and 2147483648"),
        ("hovering", "step", -1, "'step' must lie between 0"),
        ("racing", "gate", 99, "'gate' must lie between 0 and 3"),
        ("racing", "gate", -1, "'gate' must lie between 0 and 3"),
        ("racing", "gates_passed", -1, "'gates_passed' must lie between 0"),
        ("racing", "pass_step", -2, "'pass_step' must lie between -1"),
        ("racing", "lap_time", -1.0, "'lap_time' must lie between 0"),
        ("tracking", "squared_error", -1.0, "'squared_error' must lie between 0"),
        ("tracking", "phase", 100.0, "'phase' must lie between 0 and 6.283"),
    ],
)
def test_an_entry_out_of_its_range_is_refused_by_name_and_environment(task, key, value, message):
    env = make_env(task, num_envs=4, **RANDOM)
    td = env.reset()
    td["state", key][2] = value
    with pytest.raises(ValueError, match=f"no drone can fly from the state of environments 2: {message}"):
        env.reset(td.copy(), set_state=True)
    env.set_initial_state_source(lambda n: td["state"])
    with pytest.raises(ValueError, match=f"initial_state_source: no drone can fly .* environments 2: {message}"):
        env.reset()
    others = torch.tensor([[True], [True], [False], [True]])
    env.reset(td.copy().set("_reset", others), set_state=True)  # nobody asks for environment 2


@pytest.mark.parametrize(
    ("key", "dtype", "message"),
    [
        ("step", torch.float32, "state 'step' must be whole numbers, got torch.float32"),
        ("gate", torch.float64, "state 'gate' must be whole numbers, got torch.float64"),
        ("velocity", torch.int64, "state 'velocity' must be floating point, got torch.int64"),
        ("gate_passed", torch.int64, "state 'gate_passed' must be bool, got torch.int64"),
        ("velocity", torch.complex64, "state 'velocity' must be floating point, got torch.complex64"),
    ],
)
def test_an_entry_of_another_kind_is_refused(key, dtype, message):
    env = make_env("racing", num_envs=4)
    td = env.reset()
    td["state", key] = td["state", key].to(dtype)
    with pytest.raises(ValueError, match=message):
        env.reset(td, set_state=True)


def test_a_state_that_was_set_is_a_copy(env):
    td = env.reset()
    start = env.reset(td.clone(), set_state=True)
    source = td["state"].clone()
    env.set_initial_state_source(lambda n: source)
    env.reset()["state", "position"][0] = 99.0
    assert (source["position"] == start["state", "position"]).all()


def broken_states(env):
    td = env.reset()
    yield td.exclude("state"), r"a state is a tensordict, such as env.reset\(\)\[.state.\]; got NoneType"
    yield td.exclude(("state", "velocity")), "the state lacks velocity. A state is restored whole"
    yield TensorDict({**td, "state": torch.zeros(4, 3)}, [4]), "a state is a tensordict, such as .* got Tensor"
    short = td.clone()
    short["state", "velocity"] = torch.zeros(4, 2)
    yield short, r"state 'velocity' has shape \(4, 2\), expected \(4, 3\)"


def test_a_state_that_is_not_whole_is_refused_by_a_step_a_rollout_and_a_reset(env):
    actor = make_actor(env)
    for td, message in broken_states(env):
        with pytest.raises(ValueError, match=message):
            env.step(td.copy().set("action", torch.zeros(4, 4)))
        with pytest.raises(ValueError, match=message):
            differentiable_rollout(env, actor, td, 2)
        if "state" in td:
            with pytest.raises(ValueError, match=message):
                env.reset(td.copy(), set_state=True)
    with pytest.raises(ValueError, match='needs a tensordict with the state to set in "state"; got none'):
        env.reset(set_state=True)


def test_a_state_of_another_device_or_precision_is_refused_by_a_step_and_converted_by_a_reset(env):
    td = env.reset()
    state = td["state"].apply(lambda x: x.double() if x.is_floating_point() else x)
    double = TensorDict({"state": state, "action": torch.zeros(4, 4)}, [4])
    elsewhere = TensorDict({"state": td["state"].to("meta"), "action": torch.zeros(4, 4)}, [4])
    for wrong, message in ((double, "torch.float64 on cpu"), (elsewhere, "torch.float32 on meta")):
        with pytest.raises(ValueError, match=f"state 'position' is {message}, and this environment torch.float32 on"):
            env.step(wrong)
    with pytest.raises(ValueError, match="on meta, and that of the environment torch.float32 on cpu"):
        differentiable_rollout(env, make_actor(env), td.to("meta"), 2)
    assert env.reset(double, set_state=True)["state", "position"].dtype is torch.float32


def test_starts_come_from_a_function_that_gives_whole_states(env):
    with pytest.raises(ValueError, match="initial_state_source must be a function from a number n to n states.*got Te"):
        env.set_initial_state_source(env.reset())
    state = env.reset()["state"]
    for wrong, message in ((state[:2], r"has shape \(2, 3\), expected \(4, 3\)"), (torch.zeros(4), "got Tensor")):
        env.set_initial_state_source(lambda n, wrong=wrong: wrong)
        with pytest.raises(ValueError, match=f"initial_state_source: .*{message}"):
            env.reset()
