"""Gradients through the simulator against finite differences, in float64."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_quad import HoveringEnv

STEPS = 20


def flight(env, actions, state, steps=STEPS):
    """Rewards and final state of a flight that resets where it is done, as one vector."""
    env.set_seed(0)
    td = env.reset(TensorDict({"state": state}, env.batch_size), set_state=True)
    rewards = []
    for t in range(steps):
        step, td = env.step_and_maybe_reset(td.set("action", actions[:, t]))
        rewards.append(step["next", "reward"].flatten())
    last = step["next", "state"]
    return torch.cat(
        (*rewards, *(last[k].flatten() for k in ("position", "quaternion", "velocity", "angular_velocity")))
    )


def setup(**kwargs):
    env = HoveringEnv(num_envs=3, dtype=torch.float64, seed=2, **kwargs)
    actions = env.hover_action + 0.2 * torch.randn(3, STEPS, 4, dtype=torch.float64)
    state = env.rollout(3)["next", "state"][:, -1].clone()
    return env, actions.requires_grad_(), state


def gradients_agree(function, *inputs):
    return torch.autograd.gradcheck(function, inputs, fast_mode=True, atol=1e-6, rtol=1e-5)


def test_with_respect_to_actions():
    env, actions, state = setup()
    assert gradients_agree(lambda a: flight(env, a, state), actions)


def test_with_respect_to_actions_with_each_other_integrator_and_delay():
    for options in ({"integrator": "euler", "action_delay": 0}, {"integrator": "rk4", "action_delay": 2}):
        env, actions, state = setup(**options)
        assert gradients_agree(lambda a, env=env, state=state: flight(env, a, state), actions)


def test_with_respect_to_every_entry_of_the_initial_state_also_through_resets():
    env, actions, state = setup(max_episode_steps=24)
    state["step"] = torch.tensor([[15], [0], [19]])  # the second drone flies through
    actions = actions.detach()
    for key, value in state.items():
        if not value.is_floating_point():
            continue
        value = value.clone().requires_grad_()
        assert gradients_agree(lambda x, key=key: flight(env, actions, state.copy().set(key, x)), value), key


@pytest.mark.parametrize(("limit", "lag"), [(256, [0.03, 0.05]), (12, 0.033)])  # at rest two constants have a kink
def test_with_respect_to_every_parameter_of_the_drone_also_through_resets(limit, lag):
    smooth = dict.fromkeys(("velocity", "angular_velocity", "attitude"), 0.0)  # at rest these terms have one, too
    env, actions, state = setup(max_episode_steps=limit, weights=smooth)
    actions = actions.detach()
    if limit == 12:
        state["step"] = torch.tensor([[3], [0], [7]])
    drag = {"drag_height": 0.02, "linear_drag": [0.3] * 3, "quadratic_drag": [0.05] * 3}  # it turns the drone
    own = env.params.replace(motor_time_constant=lag, rotor_speed_min=1300.0, rotor_speed_max=1850.0, **drag)
    for name in sorted(set(env.dynamics.plant_fields) - {"rotor_spin"}):  # which is +1 or -1

        def fly(x, name=name):
            env.params = own.replace(**{name: x})
            return flight(env, actions, state, steps=14)

        value = getattr(own, name)
        x = value.clone().requires_grad_()
        out = fly(x)
        weights, step = torch.rand_like(out), 1e-5 * value * torch.randn_like(value)
        (grad,) = torch.autograd.grad((weights * out).sum(), x)
        slope = (weights * (fly(value + step) - fly(value - step))).sum() / 2.0
        assert slope != 0.0, name
        torch.testing.assert_close(
            (grad * step).sum(), slope, rtol=1e-5, atol=0.0, msg=lambda said, name=name: f"{name}: {said}"
        )


def test_through_a_partial_reset_the_gradient_is_cut_exactly_there():
    env, actions, state = setup(max_episode_steps=12)
    state["step"] = torch.tensor([[3], [0], [7]])
    assert gradients_agree(lambda a: flight(env, a, state), actions)
    # environment 0 is reset after 9 steps, environment 1 after 12, environment 2 after 5 and 17
    rewards = flight(env, actions, state)[: 3 * STEPS].view(STEPS, 3)
    for i, resets in enumerate(([9], [12], [5, 17])):
        for reset in resets:
            (grad,) = torch.autograd.grad(rewards[reset:, i].sum(), actions, retain_graph=True)
            assert (grad[i, :reset] == 0).all() and (grad[i, reset : reset + 1] != 0).any()
            assert (grad[[j for j in range(3) if j != i]] == 0).all()
