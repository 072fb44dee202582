"""Classical controllers: signs worked by hand, limits, and solutions that other programs find."""

import numpy as np
import pytest
import torch
from helpers import refuses
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torch import nn

from benchmarks.laps import basis, plan_lap, racing
from torchrl_quad import MPC, ActionSequence, GeometricController, HoveringEnv, LandingEnv, RacingEnv, TrackingEnv
from torchrl_quad.controllers import follow
from torchrl_quad.controllers.mpc import WEIGHTS, feedback
from torchrl_quad.dynamics import quaternion

DOUBLE = {"dtype": torch.float64}


def at(env, **changes):
    """The start of an episode at the target, level and at rest, but for some entries of the state."""
    td = env.reset()
    td["state", "position"] = td["state", "target"].clone()
    for name, value in changes.items():
        td["state", name] = td["state", name] + torch.tensor(value, dtype=env.dtype)
    return td


@pytest.mark.parametrize("controller", [GeometricController, MPC])
@pytest.mark.parametrize("delay", [0, 3])
def test_a_drone_that_hovers_where_it_shall_gets_exactly_the_action_that_hovers(controller, delay):
    env = HoveringEnv(num_envs=2, action_delay=delay, **DOUBLE)
    action = controller(env)(at(env))["action"]
    torch.testing.assert_close(action, env.hover_action.expand(2, 4), rtol=0, atol=1e-9)


SIGNS = {  # what is wrong along x, y or z, and what mends it: action, sign (0 thrust, 1 roll, 2 pitch, 3 yaw rate)
    "position": [(2, -1), (1, 1), (0, -1)],  # ahead: nose up; on the left: roll right; too high: less thrust
    "velocity": [(2, -1), (1, 1), (0, -1)],
    "quaternion": [(1, -1), (2, -1), (3, -1)],  # rolled right: roll left; nose down: nose up; heads left: turn right
}


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("entry", SIGNS)
def test_errors_of_each_axis_are_mended_in_the_right_direction(entry, axis):
    env = HoveringEnv(num_envs=1, action_delay=0, **DOUBLE)
    wrong, (action, sign) = 0.1 * torch.eye(3, dtype=env.dtype)[axis], SIGNS[entry][axis]
    if entry == "quaternion":  # turned by a small angle
        wrong = quaternion.from_axis_angle(wrong) - quaternion.identity(wrong)
    td = at(env, **{entry: wrong.tolist()})
    more = sign * (GeometricController(env, heading=0.0)(td.copy())["action"][0] - env.hover_action)
    assert more[action] > 0.01 and all(more[i].abs() < 1e-9 for i in {1, 2, 3} - {action})
    if entry != "quaternion":  # the planner agrees; what a tilt costs it trades off
        more = sign * (MPC(env, horizon=12)(td)["action"][0] - env.hover_action)
        assert more[action] > 0.01


def test_the_geometric_law_is_that_of_the_formulas():
    """Worked in numpy with matrices: f = F . R e3, and rates R' R_d W_d - k_R e_R."""
    env = HoveringEnv(num_envs=1, action_delay=0, **DOUBLE)
    td = at(env, position=[0.1, -0.2, 0.05], velocity=[0.3, 0.1, -0.2])
    attitude = quaternion.from_axis_angle(torch.tensor([[0.2, -0.1, 0.4]], dtype=env.dtype))
    td["state", "quaternion"] = attitude
    rotation = Rotation.from_quat(attitude[0].numpy(), scalar_first=True).as_matrix()
    force = -10 * np.array([0.1, -0.2, 0.05]) - 5 * np.array([0.3, 0.1, -0.2]) + np.array([0, 0, 9.81])
    third = force / np.linalg.norm(force)
    second = np.cross(third, [1, 0, 0])
    second /= np.linalg.norm(second)
    wanted = np.stack([np.cross(second, third), second, third], 1)
    skew = 0.5 * (wanted.T @ rotation - rotation.T @ wanted)
    rates = -12.0 * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    expected = [0.46 * force @ rotation[:, 2], *rates]
    action = GeometricController(env, attitude_gain=12.0, heading=0.0)(td)["action"]
    expected = env.dynamics.controller.encode(torch.tensor([expected], dtype=env.dtype)).clamp(-1, 1)
    torch.testing.assert_close(action, expected)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_the_geometric_controller_flies_home_from_a_tilted_start_whatever_the_delay(delay):
    start = {"tilt": 1.0, "velocity": 1.0, "angular_velocity": 1.0}
    env = HoveringEnv(num_envs=2, action_delay=delay, random_start=start, seed=3)
    flight = env.rollout(130, GeometricController(env), break_when_any_done=False)
    assert flight["next", "metrics", "position_error"][:, -1].max() < 0.05


def test_neither_keeps_a_graph_and_the_planner_goes_on_from_its_last_plan():
    env = HoveringEnv(num_envs=1, random_start={"tilt": 0.5})
    env.set_params(env.params.replace(mass=torch.tensor([0.46], requires_grad=True)))
    mpc = MPC(env, horizon=10)
    flight = env.rollout(14, mpc, break_when_any_done=False)
    assert flight["next", "reward"].requires_grad  # as of any flight of this drone
    assert not flight["action"].requires_grad and not flight["plan"].requires_grad
    error = flight["next", "metrics", "position_error"][0, :, 0]
    assert error[-1] < error.max()
    state = dict(flight["state"][:, 5].items())
    begun = mpc.begin(flight["plan"][:, 4], state, mpc.goal(state)[1])
    assert torch.equal(begun[:-1], flight["plan"][0, 4, 1:].unsqueeze(1))
    fresh = {**state, "step": 0 * state["step"]}
    assert torch.equal(mpc.begin(flight["plan"][:, 4], fresh, mpc.goal(state)[1]), mpc.goal(state)[1])
    assert not GeometricController(env)(flight[:, 3])["action"].requires_grad


def test_each_weight_of_the_planner_changes_its_plan():
    env = HoveringEnv(num_envs=1, random_start={"tilt": 0.5, "velocity": 1.0}, **DOUBLE)
    td, settings = env.reset(), [{}, *({name: value + 5.0} for name, value in WEIGHTS.items())]
    plain, *plans = (MPC(env, horizon=4, weights=changes)(td.copy())["plan"] for changes in settings)
    assert all((plan - plain).abs().max() > 1e-4 for plan in plans)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_what_the_planner_predicts_is_what_the_environment_flies(delay):
    env = TrackingEnv(num_envs=2, action_delay=delay, **DOUBLE)
    td, mpc = env.reset(), MPC(env, horizon=6)
    plan = mpc(td.copy())["plan"].transpose(0, 1)
    now = ActionSequence(torch.cat((plan, plan[-1:].expand(delay, -1, -1)))) if delay else ActionSequence(plan)
    flight = env.rollout(6 + delay, now, tensordict=td.copy(), auto_reset=False, break_when_any_done=False)
    flown = flight["next", "state"]
    start = td["state"] if delay == 0 else flown[:, delay - 1]
    predicted = mpc.predict(mpc.pack(dict(start.items())), plan)
    for t in range(1, 7):
        torch.testing.assert_close(predicted[t], mpc.pack(dict(flown[:, delay + t - 1].items())))


def test_a_step_of_gauss_newton_never_raises_the_cost_and_its_derivatives_are_finite_differences():
    env = HoveringEnv(num_envs=3, random_start={"tilt": 1.5, "velocity": 3.0}, seed=1, **DOUBLE)
    mpc, td = MPC(env, horizon=8), env.reset()
    state = dict(td["state"].items())
    goal, neutral = mpc.goal(state)
    actions = neutral
    states, costs = mpc.predict(mpc.pack(state), actions), []
    for _ in range(4):
        costs.append(mpc.cost(states[1:], actions, goal, neutral))
        states, actions = mpc.improve(states, actions, goal, neutral)
    costs = torch.stack(costs)
    assert (costs.diff(dim=0) <= 0).all() and (costs[-1] < 0.98 * costs[0]).all()
    assert actions.abs().max() <= 1.0
    inner = 0.5 * actions
    derivatives, h = mpc.linearise(states[:-1], inner), 1e-6
    for i in (4, 8, 11, 14, 17, 19):
        change = torch.zeros(21, dtype=env.dtype)
        change[i] = h
        up, down = (mpc.step(states[:-1] + s * change[:17], inner + s * change[17:]) for s in (1, -1))
        torch.testing.assert_close(derivatives[..., i], (up - down) / (2 * h), rtol=1e-4, atol=1e-5)
    mpc.compile(backend="eager")
    torch.testing.assert_close(mpc.linearise(states[:-1], inner), derivatives)
    torch.testing.assert_close(mpc.predict(states[0], actions), states)


def test_the_backward_pass_solves_the_linear_quadratic_problem():
    """Without bounds: the gain of scipy's algebraic Riccati equation, far from the end. Within: by brute force."""
    torch.manual_seed(0)
    a, b = torch.eye(3).double() + 0.1 * torch.randn(3, 3).double(), torch.randn(3, 2).double()
    q, r = torch.tensor([1.0, 2.0, 0.5]).double(), torch.tensor([0.3, 0.7]).double()
    steps, wide = 200, torch.full((200, 1, 2), torch.inf).double()
    linear = torch.cat((a, b), 1).expand(steps, 1, 3, 5)
    no = torch.zeros(steps, 1, 3).double(), torch.zeros(steps, 1, 2).double()
    _, gains = feedback(linear, (q.repeat(steps, 1), no[0]), (r, no[1]), (-wide, wide))
    p = solve_discrete_are(a.numpy(), b.numpy(), np.diag(q), np.diag(r))
    wanted = -np.linalg.solve(np.diag(r) + b.numpy().T @ p @ b.numpy(), b.numpy().T @ p @ a.numpy())
    np.testing.assert_allclose(gains[0, 0].numpy(), wanted, atol=1e-9)
    slope, act_slope = torch.randn(1, 1, 3).double(), torch.zeros(1, 1, 2).double()
    bound = torch.full((1, 1, 2), 0.1).double()
    step, gain = feedback(linear[:1], (q[None], slope), (r, act_slope), (-bound, bound))
    grid = torch.cartesian_prod(*2 * [torch.linspace(-0.1, 0.1, 401).double()])
    x = grid @ b.T
    cost = 0.5 * (q * x * x).sum(1) + x @ slope[0, 0] + 0.5 * (r * grid * grid).sum(1)
    torch.testing.assert_close(step[0, 0], grid[cost.argmin()], atol=6e-4, rtol=0)
    assert (gain[0, 0][step[0, 0].abs() == 0.1] == 0).all()


def test_derivatives_of_a_reference_are_those_of_its_curve():
    env = TrackingEnv(num_envs=2, curve="lemniscate", **DOUBLE)
    td, rate = env.reset(), env.phase_rate
    motion = follow(GeometricController(env).reference, dict(td["state"].items()), torch.tensor([0.0, 0.3]).double())
    phase = td["state", "phase"] + rate * torch.tensor([0.0, 0.3]).double()
    derivatives = [2 * phase.cos(), -2 * rate * phase.sin(), -2 * rate**2 * phase.cos(), 2 * rate**3 * phase.sin()]
    for got, x in zip(motion, derivatives, strict=True):  # x of the figure of eight is 2 + 2 cos
        torch.testing.assert_close(got[..., 0] - 2.0 * (got is motion.position), x, atol=1e-3, rtol=0)


def test_the_lap_passes_the_gates_within_the_limits_of_the_drone_and_a_landing_is_soft():
    env = RacingEnv(num_envs=1, **DOUBLE)
    lap = plan_lap(env.gates, env.nominal, 0.3)
    assert (lap.position(lap.passes) - env.gates).norm(dim=1).max() < 0.12
    t = torch.linspace(0, lap.period, 400, dtype=env.dtype)
    acceleration, jerk = (basis(t, lap.rates, k) @ lap.coefficients for k in (2, 3))
    force = acceleration + torch.tensor([0.0, 0.0, 9.81], dtype=env.dtype)
    rate = torch.linalg.cross(force, jerk).norm(dim=1) / force.square().sum(1)
    assert rate.max() < 2.0 and force.norm(dim=1).max() < 3 * 9.81
    assert 2.5 < lap.period < 4.0
    flight = env.rollout(100, GeometricController(env, reference=racing(env)), break_when_any_done=False)
    assert flight["next", "state", "gates_passed"][0, -1] >= 1
    env = LandingEnv(num_envs=2)
    env.start_centre, env.start_range = (2.0, 0.0, 1.0), 0.3
    flight = env.rollout(150, GeometricController(env), break_when_any_done=False)
    assert env.episode_metrics(flight)["solved"].all()


def test_controllers_know_the_nominal_drone_alone_and_see_what_sensors_give():
    env = HoveringEnv(num_envs=2, randomize={"mass": {"scale": [0.5, 1.5]}}, observation_noise={"position": 0.1})
    td = env.reset()
    for controller in (GeometricController(env), MPC(env, horizon=2)):
        before = controller(td.copy())["action"]
        other = td.copy()
        other["state", "drone", "mass"] = 2 * td["state", "drone", "mass"]
        other["state", "position"] = td["state", "position"] + 1.0
        assert torch.equal(controller(other)["action"], before)
        measured = td.copy()
        measured["state", "measurements"] = td["state", "measurements"] + 0.1
        assert not torch.equal(controller(measured)["action"], before)


def test_what_they_cannot_fly_is_refused_and_a_reference_of_ones_own_is_flown():
    own = RacingEnv(num_envs=1)
    for env, message in (
        (HoveringEnv(num_envs=1, dynamics="point_mass"), "dynamics='quadrotor'"),
        (HoveringEnv(num_envs=1, control="velocity"), "control='rates'"),
        (own, "has no reference for RacingEnv"),
    ):
        for controller in (GeometricController, MPC):
            refuses(message, controller, env)
    refuses("flies a QuadrotorEnv", MPC, nn.Identity(), error=TypeError)
    still = {"reference": lambda state, t: state["target"].unsqueeze(1).expand(-1, len(t), 3)}
    for controller, wrong, message in (
        (MPC, {"horizon": 0}, "horizon must be at least 1, got 0. Control steps of a plan"),
        (MPC, {"iterations": 1.5}, "iterations must be a whole number, got 1.5"),
        (MPC, {"weights": {"speed": 1.0}}, "weights: unknown weight 'speed'. Choose from: position"),
        (MPC, {"weights": {"action": 0.0}}, "weights: action must be at least 1e-6"),
        (GeometricController, {"position_gain": 0.0}, "position_gain must be at least 0.001, got 0.0"),
        (MPC, {"reference": 3}, r"reference is a function from the state and times \(T\) .* is not callable"),
        (MPC, {"reference": lambda state, t: state["target"]}, r"here \(1, 2, 3\), torch.float32; it made \(1, 3\)"),
        (MPC, {"reference": lambda state, t: state["goal"]}, "given two times it failed: 'goal'"),
    ):
        refuses(message, controller, own, **{**still, **wrong})
    up = GeometricController(own, reference=lambda state, t: state["target"][:, None] + t[:, None] * torch.ones(3))
    assert up(at(own))["action"][0, 0] > own.hover_action[0] and isinstance(up(TensorDict(at(own))), TensorDict)
