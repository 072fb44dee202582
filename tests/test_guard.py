"""Broken environments crash alone: nothing of them reaches the others, nor the parameters that all share."""

import pytest
import torch
from flying import fly

from torchrl_quad import HoveringEnv, available_drones, load_drone, make_actor
from torchrl_quad.dynamics import INTEGRATORS


def gradients_of_the_first(env, key=None, value=None):
    """Of the rewards of environment 0, in the mass and a policy's weights, beside a neighbour with this entry."""
    mass = env.nominal.mass.clone().requires_grad_()
    env.params = env.nominal.replace(mass=mass)
    env.set_seed(0)
    torch.manual_seed(0)
    actor, td, rewards, crashes = make_actor(env), env.reset(), [], []
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


@pytest.mark.parametrize("drone", available_drones())
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


@pytest.mark.parametrize(
    ("key", "value", "options"),
    [
        ("wind", [1e5, 0.0, 0.0], {"wind": {"gust": 0.5}}),
        ("mean_wind", float("nan"), {"wind": {"gust": 0.5}}),
        (("drone", "inertia"), 1e-30, {"randomize": {"inertia": {"scale": [0.9, 1.1]}}}),
        (("drone", "motor_time_constant"), 0.0, {"randomize": {"motor_time_constant": {"scale": [0.9, 1.1]}}}),
        (("drone", "thrust_map"), 0.0, {"randomize": {"thrust_map": {"scale": [0.9, 1.1]}}}),
    ],
)
def test_wind_and_drones_beyond_their_bounds_crash_alone(key, value, options):
    env = HoveringEnv(num_envs=2, action_delay=0, **options)
    expected, _ = gradients_of_the_first(env)
    found, crashes = gradients_of_the_first(env, key, value)
    assert crashes[0] == [False, True]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(
    ("field", "value"),
    [("mass", 0.0), ("mass", 1e9), ("inertia", [1e-30] * 3), ("motor_time_constant", 1e-9), ("gravity", -9.81)],
)
def test_a_drone_whose_numbers_would_overflow_is_refused(field, value):
    with pytest.raises(ValueError, match=f"field '{field}' must be between .*, in SI units; got"):
        load_drone().replace(**{field: value})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("velocity", float("nan")),
        ("velocity", 1e30),
        ("position", float("inf")),
        ("position", 1e30),
        ("target", 1e30),
        ("angular_velocity", -1e12),
        ("quaternion", 1e30),
        ("quaternion", 0.0),
        ("rotor_speed", float("nan")),
        ("rotor_speed", 1e12),
        ("rotor_speed", -1e9),
    ],
)
def test_a_broken_state_terminates_and_leaks_nothing_into_the_others(dtype, key, value):
    env = HoveringEnv(num_envs=4, seed=1, dtype=dtype)
    action = (env.hover_action.expand(4, 4) + 0.1).clone().requires_grad_()
    mass = torch.tensor(0.46, dtype=dtype, requires_grad=True)
    env.params = env.params.replace(mass=mass)

    def gradients(td):
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
    assert first["terminated"].flatten().tolist() == [False, False, True, False]
    assert not first["success"][2]
    assert first["reward"][2] == 0
    assert torch.equal(flight["next", "reward"][[0, 1, 3]], clean["next", "reward"][[0, 1, 3]])
    assert torch.equal(broken_action[[0, 1, 3]], clean_action[[0, 1, 3]])
    assert broken_action.isfinite().all()
    torch.testing.assert_close(broken_mass, clean_mass)


def test_an_action_beyond_all_bounds_terminates_its_own_environment_only(env):
    action = env.hover_action.expand(4, 4).clone()
    action[1, 2] = 1e30
    action.requires_grad_()
    flight = fly(env, env.reset(), [action] * 2)
    assert flight["next", "terminated"][:, 0].flatten().tolist() == [False, True, False, False]
    assert flight["next", "observation"].isfinite().all()
    (grad,) = torch.autograd.grad(flight["next", "reward"].sum(), action)
    assert grad.isfinite().all()
    assert (grad[1] == 0).all()
    assert (grad[[0, 2, 3]] != 0).any(-1).all()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_action_that_is_not_finite_is_refused_with_the_name_of_its_environment(env, value):
    action = env.hover_action.repeat(4, 1)
    action[[1, 3], 2] = value
    with pytest.raises(ValueError, match="The action is not finite in environments 1, 3: the weights of the policy"):
        env.step(env.reset().set("action", action))


def test_gradients_stay_finite_after_a_crash(env64):
    td = env64.reset()
    td["state", "position"][0] = torch.tensor([9.0, 9.0, -3.0], dtype=torch.float64)
    action = torch.ones(4, 4, dtype=torch.float64, requires_grad=True)
    flight = fly(env64, env64.reset(td, set_state=True), [action] * 30)
    flight["next", "reward"].sum().backward()
    assert action.grad.isfinite().all()
