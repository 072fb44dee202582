"""What holds of every state and every action, searched for counterexamples."""

import tempfile
from functools import cache
from pathlib import Path

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from hypothesis.configuration import set_hypothesis_home_dir
from hypothesis.extra.numpy import arrays
from tensordict import TensorDict

from torchrl_quad import make_env
from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs import TASKS
from torchrl_quad.envs.terms import axes_observation

N = 3
DRONE = "position", "quaternion", "velocity", "angular_velocity", "rotor_speed"
set_hypothesis_home_dir(Path(tempfile.gettempdir(), "hypothesis"))  # what it keeps does not belong among the sources
search = settings(max_examples=25, deadline=None, derandomize=True, database=None)
each_task = pytest.mark.parametrize("task", TASKS)


def on_each_task(**drawn):
    return lambda test: each_task(search(given(**drawn)(test)))


@cache
def env_of(task, dtype=torch.float64):
    open_ground = {"density": 0.0} if task == "forest" else {}  # states are drawn where trees would stand, too
    return make_env(task, num_envs=N, dtype=dtype, max_episode_steps=50, **open_ground)


def numbers(bound, *shape):
    """Arrays of numbers up to a bound, the round and the tiny among them."""
    return arrays("float64", (N, *shape), elements=st.floats(-bound, bound), fill=st.nothing())


def wild(bound):
    """As numbers up to the bound, and now and then of any size that is finite."""
    return st.one_of(numbers(bound, 3), arrays("float64", (N, 3), elements=st.floats(-1e300, 1e300)))


@st.composite
def flights(draw, calm=True):
    """Drones anywhere, turned, moving and in any step of their episode, and actions; calm ones within the model."""
    motion = numbers if calm else lambda bound, _: wild(bound)
    turned = torch.from_numpy(draw(numbers(1.0, 4))) + 1e-3
    sizes = {"position": 8.0, "velocity": 20.0, "angular_velocity": 10.0}
    flight = {"seed": draw(st.integers(0, 9)), **{name: draw(motion(most, 3)) for name, most in sizes.items()}}
    flight["quaternion"] = turned / turned.norm(dim=-1, keepdim=True)
    flight |= {name: draw(numbers(1.0, 4)) for name in ("rotors", "queued")}
    flight["step"] = draw(arrays("int64", (N, 1), elements=st.integers(0, 10**6 if not calm else 60)))
    return flight | {"action": draw(numbers(1.0 if calm else 3.0, 4))}


def start(task, flight, dtype=torch.float64):
    """The environment, and the flight's state, in a task's own starts, with its action."""
    env = env_of(task, dtype)
    env.set_seed(flight["seed"])
    state = env.sample_start(N)["state"]
    low, high = env.nominal.rotor_speed_min, env.nominal.rotor_speed_max
    values = {name: torch.as_tensor(value).to(env.dtype).clamp(-3e38, 3e38) for name, value in flight.items()}
    for name in DRONE[:-1]:
        state[name] = values[name]
    state["rotor_speed"] = low + (high - low) * (0.5 + 0.5 * values["rotors"])
    state["action_queue"] = values["queued"].unsqueeze(1)
    state["step"] = torch.as_tensor(flight["step"])
    return env, TensorDict({"state": state, "action": values["action"]}, [N])


def step(env, td):
    return env.step(td.copy())["next"]


def after(env, td, steps=1):
    """Some steps later, with the same action."""
    for _ in range(steps):
        td = td.copy().update({"state": step(env, td)["state"]})
    return td


def leaves(td):
    return dict(td.items(include_nested=True, leaves_only=True))


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(x, other[key]) for key, x in one.items())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@on_each_task(flight=flights(calm=False))
def test_a_step_from_anywhere_is_finite_and_so_are_its_derivatives(task, dtype, flight):
    env, td = start(task, flight, dtype)
    inputs = [td["action"], *(x for x in leaves(td["state"]).values() if x.is_floating_point())]
    for x in inputs:
        x.requires_grad_()
    ends = step(env, td)
    assert all(x.isfinite().all() for x in leaves(ends).values())
    grads = torch.autograd.grad(ends["reward"].sum() + ends["observation"].sum(), inputs, allow_unused=True)
    assert all(x is None or x.isfinite().all() for x in grads)
    unit = ends["state", "quaternion"].norm(dim=-1)
    torch.testing.assert_close(unit, torch.ones_like(unit), atol=1e-5, rtol=0)


@on_each_task(flight=flights(calm=False))
def test_rewards_are_the_sum_of_their_terms_and_flags_agree_and_the_specs_contain_what_is_made(task, flight):
    env, td = start(task, flight)
    ends = step(env, td)
    torch.testing.assert_close(sum(ends["reward_terms"].values()), ends["reward"])
    assert torch.equal(ends["done"], ends["terminated"] | ends["truncated"])
    assert torch.equal(ends["terminated"], ends["crash"] | (ends["success"] & env.ends_on_success))
    assert torch.equal(ends["truncated"], ends["state", "step"] >= env.max_episode_steps)
    assert not (ends["crash"] & ends["success"] & env.ends_on_success).any()
    for made in (ends, env.reset(ends.select("state"), set_state=True)):
        for spec in (env.observation_spec, env.state_spec, env.done_spec):
            assert spec.is_in(made.select(*spec.keys()))


@on_each_task(flight=flights(calm=False))
def test_a_step_is_a_pure_function_of_its_input(task, flight):
    env, td = start(task, flight)
    before = td.clone()
    first = step(env, td)
    env.randomness.seed(99)
    assert equal(leaves(first), leaves(step(env, td))) and equal(leaves(td), leaves(before))


def has_sense(td):
    """Which of the states (N) a drone can fly from: those within the bounds of the model."""
    bounds = {"position": 1e6, "velocity": 300.0, "angular_velocity": 100.0}  # the other entries always are
    return torch.stack([(td["state", name].abs() <= bound).all(-1) for name, bound in bounds.items()]).all(0)


@on_each_task(flight=st.one_of(flights(), flights(calm=False)))
def test_a_reset_to_a_state_restores_it_to_the_last_bit_or_refuses_it(task, flight):
    env, td = start(task, flight)
    good = has_sense(td)
    assert step(env, td)["crash"][~good].all()
    if not good.all():
        with pytest.raises(ValueError, match="no drone can fly from the state of environments"):
            env.reset(td.select("state").clone(), set_state=True)
    if good.any():  # the others are not asked for
        chosen = td.select("state").clone().set("_reset", good.unsqueeze(1))
        assert equal(leaves(env.reset(chosen, set_state=True)["state"]), leaves(td["state"]))


@on_each_task(flight=flights())
def test_two_quaternions_of_one_attitude_fly_alike(task, flight):
    env, td = start(task, flight)
    other = td.clone()
    other["state", "quaternion"] = -td["state", "quaternion"]
    one, two = step(env, td), step(env, other)
    for key in ("reward", "crash", "success", ("state", "position"), ("state", "velocity"), ("state", "rotor_speed")):
        torch.testing.assert_close(one[key], two[key], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(one["state", "quaternion"], -two["state", "quaternion"], rtol=1e-12, atol=1e-12)
    seen, again = (axes_observation(dict(x["state"].items()))[0] for x in (one, two))
    torch.testing.assert_close(seen, again, rtol=1e-11, atol=1e-11)
    up = quaternion.rotate(one["state", "quaternion"], torch.tensor([0.0, 0.0, 10.0]).to(seen).expand(N, 3))
    torch.testing.assert_close(seen[:, 3:], up)


@on_each_task(flight=flights(), order=st.permutations(range(N)))
def test_the_order_of_the_environments_is_that_of_the_results(task, flight, order):
    env, td = start(task, flight)
    one, two = step(env, td)[list(order)], step(env, td[list(order)])
    torch.testing.assert_close(leaves(one), leaves(two), rtol=1e-12, atol=1e-12)


@search
@given(flight=flights(), angle=st.floats(-7.0, 7.0))
def test_a_world_turned_about_its_vertical_turns_the_flight(flight, angle):
    turn = quaternion.from_axis_angle(torch.tensor([[0.0, 0.0, angle]], dtype=torch.float64))

    def turned(state):
        rotated = {key: quaternion.rotate(turn, state[key]) for key in ("position", "velocity")}
        return {**rotated, "quaternion": quaternion.multiply(turn.expand(N, 4), state["quaternion"])}

    env, td = start("hovering", flight)
    other = td.clone()
    other["state"].update(turned(td["state"]))
    td, other = (after(env, x, 3) for x in (td, other))
    expected = td["state"].copy().update(turned(td["state"]))
    for key in DRONE:
        torch.testing.assert_close(other["state", key], expected[key], rtol=1e-9, atol=1e-9)


@search
@given(flight=flights())
def test_body_rates_follow_their_command_and_hardly_exceed_the_limit(flight):
    env = env_of("hovering")
    td = env.reset().set("action", torch.as_tensor(flight["action"]))
    td["action"][:, 0] = env.hover_action[0]
    command = td["action"][:, 1:] * env.nominal.max_body_rate
    for _ in range(50):
        td = after(env, td)
        assert (td["state", "angular_velocity"].abs() < 1.25 * env.nominal.max_body_rate).all()
    torch.testing.assert_close(td["state", "angular_velocity"], command, atol=1e-6, rtol=0)


@search
@given(flight=flights(calm=False))
def test_actions_beyond_their_bounds_are_clamped_and_rotors_keep_their_limits(flight):
    env, td = start("hovering", {**flight, "action": flight["action"] * 10.0})
    clamped = td.clone()
    clamped["action"] = td["action"].clamp(-1.0, 1.0)
    td, clamped = (after(env, x, 10) for x in (td, clamped))
    assert all(torch.equal(td["state", key], clamped["state", key]) for key in DRONE)
    speed = td["state", "rotor_speed"]
    assert (speed >= env.nominal.rotor_speed_min * (1 - 1e-12)).all()
    assert (speed <= env.nominal.rotor_speed_max * (1 + 1e-12)).all()
