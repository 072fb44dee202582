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


@pytest.mark.parametrize("max_episode_steps", [256, 12])
def test_with_respect_to_every_entry_of_the_initial_state_also_through_resets(max_episode_steps):
    env, actions, state = setup(max_episode_steps=max_episode_steps)
    state["step"] = torch.tensor([[3], [0], [7]])
    actions = actions.detach()
    for key, value in state.items():
        if not value.is_floating_point():
            continue
        value = value.clone().requires_grad_()
        assert gradients_agree(lambda x, key=key: flight(env, actions, state.copy().set(key, x)), value), key


@pytest.mark.parametrize("max_episode_steps", [256, 12])
def test_with_respect_to_the_parameters_of_the_drone_also_through_resets(max_episode_steps):
    env, actions, state = setup(drone="visfly", max_episode_steps=max_episode_steps)
    # Rotors that slow down later than they speed up, and drag that turns the drone.
    actions, params = actions.detach(), env.params.replace(motor_time_constant=[0.03, 0.05], drag_height=0.02)

    def with_params(mass, linear_drag, motor_time_constant, inertia, thrust_map, drag_height):
        env.params = params.replace(
            mass=mass,
            linear_drag=linear_drag,
            motor_time_constant=motor_time_constant,
            inertia=inertia,
            thrust_map=thrust_map * torch.tensor([1e-6, 1e-5, 1e-2], dtype=torch.float64),
            drag_height=drag_height,
        )
        return flight(env, actions, state)

    scaled_map = params.thrust_map / torch.tensor([1e-6, 1e-5, 1e-2], dtype=torch.float64)
    values = (
        params.mass,
        params.linear_drag,
        params.motor_time_constant,
        params.inertia,
        scaled_map,
        params.drag_height,
    )
    values = [value.clone().requires_grad_() for value in values]
    # Inertia is of the order of 1e-3, and so needs a small step; all take the same.
    for i, value in enumerate(values):
        fixed = [v.detach() for v in values]

        def one(x, i=i, fixed=fixed):
            return with_params(*fixed[:i], x, *fixed[i + 1 :])

        assert torch.autograd.gradcheck(one, (value,), fast_mode=True, eps=1e-7, atol=1e-4, rtol=1e-4), i


def test_through_a_partial_reset_the_gradient_is_cut_exactly_there():
    env, actions, state = setup(max_episode_steps=12)
    state["step"] = torch.tensor([[3], [0], [7]])
    assert gradients_agree(lambda a: flight(env, a, state), actions)
    # environment 0 is reset after 9 steps, environment 1 after 12, environment 2 after 5 and 17
    rewards = flight(env, actions, state)[: 3 * STEPS].view(STEPS, 3)
    for i, resets in enumerate(([9], [12], [5, 17])):
        for reset in resets:
            (grad,) = torch.autograd.grad(rewards[reset:, i].sum(), actions, retain_graph=True)
            assert (grad[i, :reset] == 0).all()
            assert (grad[i, reset : reset + 1] != 0).any()
            assert (grad[[j for j in range(3) if j != i]] == 0).all()
