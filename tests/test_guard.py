"""Broken environments crash alone, and reach no others; states from outside are accepted or refused by name."""

import pytest
import torch
from helpers import FLOWN, anew, cases, fly, refuses
from tensordict import TensorDict

from torchrl_quad import HoveringEnv, differentiable_rollout, load_drone, make_actor, make_env
from torchrl_quad.dynamics import INTEGRATORS

nan = float("nan")
LARGEST = torch.iinfo(torch.int64).max
RANDOM = {"randomize": {"mass": {"scale": [0.9, 1.1]}, "thrust_map": {"scale": [0.9, 1.1]}}, "wind": {"gust": 0.5}}


def gradients_of_the_first(env, key=None, value=None):
    """Of the rewards of environment 0, in the mass and a policy's weights, beside a neighbour with this entry."""
    mass = env.nominal.mass.clone().requires_grad_()
    env.params = env.nominal.replace(mass=mass)
    actor, td, rewards, crashes = make_actor(anew(env)), env.reset(), [], []
    if key is not None:
        td["state", key][1] = torch.as_tensor(value)
    for _ in range(3):
        td = actor(td.copy())
        stepped = env.step(td.set("action", td["loc"].tanh()))
        rewards.append(stepped["next", "reward"][0])
        crashes.append(stepped["next", "crash"].flatten().tolist())
        td = env.step_mdp(stepped)
    weights = [p for p in actor.parameters() if p.requires_grad]
    grads = torch.autograd.grad(sum(rewards).sum(), [mass, *weights], allow_unused=True)
    return torch.cat([g.flatten() for g in grads if g is not None]), crashes


@pytest.mark.parametrize("drone", FLOWN)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_neighbour_that_breaks_does_not_reach_what_all_share(drone, integrator):
    env = HoveringEnv(num_envs=2, drone=drone, integrator=integrator, action_delay=0)
    expected, crashes = gradients_of_the_first(env)
    assert not any(map(any, crashes))
    # Within the bounds, and far beyond them.
    for key, value in (("angular_velocity", 99.0), ("angular_velocity", 999.0), ("velocity", [299.0, -299.0, 299.0])):
        found, crashes = gradients_of_the_first(env, key, value)
        assert crashes[0] == [False, True], (key, value)
        torch.testing.assert_close(found, expected, msg=f"{key} {value}")


def test_a_drone_whose_numbers_would_overflow_is_refused():
    tiny = {"mass": 0.0, "inertia": [1e-30] * 3, "motor_time_constant": 1e-9, "gravity": -9.81}
    for field, value in [("mass", 1e9), *tiny.items()]:
        refuses(f"field '{field}' must be between .*, in SI units; got", load_drone().replace, **{field: value})


BROKEN = {"velocity": [nan, 1e30], "position": [float("inf"), 1e30], "target": [1e30], "angular_velocity": [-1e12]}
BROKEN |= {"quaternion": [1e30, 0.0], "rotor_speed": [nan, 1e12, -1e9], "wind": [1e5], "mean_wind": [nan]}
BROKEN |= {("drone", "inertia"): [1e-30], ("drone", "motor_time_constant"): [0.0], ("drone", "thrust_map"): [0.0]}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in BROKEN.items() for value in values])
def test_a_broken_state_terminates_and_leaks_nothing_into_the_others(dtype, key, value):
    drawn = {name: {"scale": [0.9, 1.1]} for name in ("inertia", "motor_time_constant", "thrust_map")}
    env = HoveringEnv(num_envs=4, seed=1, dtype=dtype, randomize=drawn, wind={"gust": 0.5})
    action = (env.hover_action.expand(4, 4) + 0.1).clone().requires_grad_()
    mass = torch.tensor(0.46, dtype=dtype, requires_grad=True)
    env.params = env.params.replace(mass=mass)

    def gradients(td):
        env.set_seed(0)
        flight = fly(env, td, [action] * 3)
        for entry, x in flight["next"].items(include_nested=True, leaves_only=True):
            assert x.isfinite().all(), entry
        loss = flight["next", "reward"][[0, 1, 3]].sum() + 0.0 * flight["next", "reward"][2].sum()
        return flight, torch.autograd.grad(loss, (action, mass))

    td = env.reset()
    clean, (clean_action, clean_mass) = gradients(td)
    broken = td.clone()
    broken["state", key][2] = value
    flight, (broken_action, broken_mass) = gradients(broken)
    first = flight["next"][:, 0]
    assert first["terminated"].flatten().tolist() == [False, False, True, False] and not first["success"][2]
    assert first["reward"][2] == 0
    assert torch.equal(flight["next", "reward"][[0, 1, 3]], clean["next", "reward"][[0, 1, 3]])
    assert torch.equal(broken_action[[0, 1, 3]], clean_action[[0, 1, 3]]) and broken_action.isfinite().all()
    torch.testing.assert_close(broken_mass, clean_mass)


@cases(
    ("hovering", ("drone", "mass"), 0.0, r"\('drone', 'mass'\) must be finite and between 0.001 and 1000"),
    ("hovering", "wind", 1e5, "'wind' must be finite and between -300 and 300"),
    ("hovering", "position", nan, "'position' must be finite and between"),
    ("hovering", "quaternion", 0.9, "'quaternion' must have unit norm"),
    ("hovering", "rotor_speed", -1e5, "'rotor_speed' must be finite and between"),
    ("hovering", "action_queue", nan, "'action_queue' must be finite and between"),
    ("hovering", "step", LARGEST, "'step' must lie between 0 and 2147483648"),
    ("racing", "gate", -1, "'gate' must lie between 0 and 3"),
    ("racing", "pass_step", -2, "'pass_step' must lie between -1"),
    ("tracking", "phase", 100.0, "'phase' must lie between 0 and 6.283"),
)
def test_an_entry_out_of_its_range_is_refused_by_name_and_environment(task, key, value, message):
    env = make_env(task, num_envs=4, **RANDOM)
    td = env.reset()
    td["state", key][2] = value
    refuses(f"no drone can fly from the state of environments 2: {message}", env.reset, td.copy(), set_state=True)
    env.set_initial_state_source(lambda n: td["state"])
    refuses(f"initial_state_source: no drone can fly .* environments 2: {message}", env.reset)
    others = torch.tensor([[True], [True], [False], [True]])
    env.reset(td.copy().set("_reset", others), set_state=True)  # nobody asks for environment 2


def test_an_entry_of_another_kind_is_refused():
    env, whole, floating = make_env("racing", num_envs=4), "whole numbers", "floating point"
    wrong = [("step", torch.float32, whole), ("gate", torch.float64, whole), ("velocity", torch.int64, floating)]
    for key, dtype, kind in [*wrong, ("gate_passed", torch.int64, "bool"), ("velocity", torch.complex64, floating)]:
        td = env.reset()
        td["state", key] = td["state", key].to(dtype)
        refuses(f"state '{key}' must be {kind}, got {dtype}", env.reset, td, set_state=True)


def test_a_state_that_is_not_whole_is_refused_by_a_step_a_rollout_a_reset_and_as_a_start(env):
    actor, td = make_actor(env), env.reset()
    short = td.clone()
    short["state", "velocity"] = torch.zeros(4, 2)
    for wrong, message in (
        (td.exclude("state"), r"a state is a tensordict, such as env.reset\(\)\[.state.\]; got NoneType"),
        (td.exclude(("state", "velocity")), "the state lacks velocity. A state is restored whole"),
        (TensorDict({**td, "state": torch.zeros(4, 3)}, [4]), "a state is a tensordict, such as .* got Tensor"),
        (short, r"state 'velocity' has shape \(4, 2\), expected \(4, 3\)"),
    ):
        refuses(message, env.step, wrong.copy().set("action", torch.zeros(4, 4)))
        refuses(message, differentiable_rollout, env, actor, wrong, 2)
        if "state" in wrong:
            refuses(message, env.reset, wrong.copy(), set_state=True)
    refuses('needs a tensordict with the state to set in "state"; got none', env.reset, set_state=True)
    with pytest.raises(ValueError, match="initial_state_source must be a function from a number n to n states.*got Te"):
        env.set_initial_state_source(env.reset())
    state = env.reset()["state"]
    for wrong, message in ((state[:2], r"has shape \(2, 3\), expected \(4, 3\)"), (torch.zeros(4), "got Tensor")):
        env.set_initial_state_source(lambda n, wrong=wrong: wrong)
        refuses(f"initial_state_source: .*{message}", env.reset)


def test_a_reset_copies_and_converts_a_state_of_a_precision_or_device_that_a_step_refuses(env):
    td = env.reset()
    state = td["state"].apply(lambda x: x.double() if x.is_floating_point() else x)
    double = TensorDict({"state": state, "action": torch.zeros(4, 4)}, [4])
    elsewhere = TensorDict({"state": td["state"].to("meta"), "action": torch.zeros(4, 4)}, [4])
    for wrong, message in ((double, "torch.float64 on cpu"), (elsewhere, "torch.float32 on meta")):
        refuses(f"state 'position' is {message}, and this environment torch.float32 on", env.step, wrong)
    with pytest.raises(ValueError, match="on meta, and that of the environment torch.float32 on cpu"):
        differentiable_rollout(env, make_actor(env), td.to("meta"), 2)
    assert env.reset(double, set_state=True)["state", "position"].dtype is torch.float32
    kept = td["state"].clone()
    env.set_initial_state_source(lambda n: td["state"])
    env.reset()["state", "position"][0] = 99.0
    env.reset(td.clone(recurse=False), set_state=True)["state", "position"][0] = 99.0
    assert (td["state"] == kept).all()
