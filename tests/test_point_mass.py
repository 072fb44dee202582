"""The point mass: every task flies it, and it agrees with what can be worked out by hand."""

import pytest
import torch
from flying import fly
from torchrl.envs import check_env_specs

from torchrl_quad import HoveringEnv, load_drone, make_actor, make_env
from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs import TASKS

F64 = torch.float64
DT, STEPS = 0.005, 4  # physics step [s], and how many make a control step


@pytest.fixture
def env():
    drone = load_drone("visfly", dtype=F64).replace(linear_drag=[0.0] * 3, quadratic_drag=[0.0] * 3)
    return HoveringEnv(num_envs=2, drone=drone, dynamics="point_mass", action_delay=0, dtype=F64)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_flies_it_with_all_disturbances(task):
    disturbed = {"randomize": {"mass": {"scale": [0.9, 1.1]}}, "observation_noise": {"position": 0.01}}
    env = make_env(task, num_envs=3, dynamics="point_mass", dtype=F64, wind={"gust": 0.5}, **disturbed)
    check_env_specs(env)
    assert "rotor_speed" not in env.reset()["state"].keys()  # noqa: SIM118, a tensordict
    actor = make_actor(env)
    flight = env.rollout(20, actor, break_when_any_done=False)
    assert flight["next", "reward"].isfinite().all()
    grads = torch.autograd.grad(flight["next", "reward"].sum(), list(actor.parameters()), allow_unused=True)
    assert all(g is None or g.isfinite().all() for g in grads)


@pytest.mark.parametrize("level", [-1.0, 0.2])
def test_thrust_straight_up_gives_a_constant_acceleration(env, level):
    action = torch.zeros(2, 20, 4, dtype=F64)
    action[..., 0] = level
    flight = fly(env, env.reset(), action.unbind(1))
    # -1 is no thrust, free fall; full thrust is max_thrust_to_weight times the weight.
    acceleration = 9.81 * ((level + 1) / 2 * env.nominal.max_thrust_to_weight.item() - 1)
    k = STEPS * torch.arange(1, 21, dtype=F64)
    height = flight["next", "state", "position"][..., 2] - flight["state", "position"][:, :1, 2]
    torch.testing.assert_close(flight["next", "state", "velocity"][0, :, 2], acceleration * k * DT)
    torch.testing.assert_close(height[0], acceleration * DT**2 * k * (k + 1) / 2)
    assert (flight["next", "state", "velocity"][..., :2] == 0).all()


def test_body_rates_follow_at_once_and_turn_by_rate_times_time(env):
    action = env.hover_action.repeat(2, 10, 1)
    action[..., 3] = 0.5
    state = fly(env, env.reset(), action.unbind(1))["next", "state"]
    rate = 0.5 * env.nominal.max_body_rate[2]
    torch.testing.assert_close(state["angular_velocity"][0, 0], torch.stack((0 * rate, 0 * rate, rate)))
    # Each step adds the derivative and normalizes: it turns by 2 atan(rate dt / 2).
    angle = 2 * torch.atan(rate * DT / 2) * STEPS * 10
    axis_angle = torch.stack((0 * angle, 0 * angle, angle))[None]
    torch.testing.assert_close(state["quaternion"][:1, -1], quaternion.from_axis_angle(axis_angle))


def test_it_has_exact_derivatives():
    moving = {"velocity": 1.0, "angular_velocity": 1.0, "tilt": 0.3}
    env = HoveringEnv(num_envs=2, dynamics="point_mass", dtype=F64, random_start=moving)
    mass = env.nominal.mass.clone().requires_grad_()
    actions = (env.hover_action + 0.2 * torch.randn(2, 8, 4, dtype=F64)).requires_grad_()

    def outputs(actions, mass):
        env.set_seed(0)
        env.params = env.nominal.replace(mass=mass)
        ends = fly(env, env.reset(), actions.unbind(1))["next"]
        return torch.cat((ends["reward"].flatten(), ends["observation"].flatten()))

    assert torch.autograd.gradcheck(outputs, (actions, mass), fast_mode=True, atol=1e-6, rtol=1e-5)
