"""Gradients in the times of events, against finite differences of a return that counts these times, in float64."""

import math

import pytest
import torch
from helpers import cases, fly
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from torchrl_quad import LandingEnv, RacingEnv, audit_reward, make_env
from torchrl_quad.envs import Event, ball_entry, level_crossing
from torchrl_quad.envs.terms import time_terms
from torchrl_quad.envs.track import forward

GAMMA = 0.97
STEPS = 8
PAID = {"racing": "gate", "gates": "gate", "landing": "success"}  # by the terms that an event pays
TIMED = {"racing": "gate_time", "gates": "gate_time", "landing": "touchdown_time"}
EVENT_PAYS = {"racing": 5.0, "gates": 5.0, "landing": 20.0}
GATES = {"gates": [{"position": [4 * i, 4 * i % 8, 2], "yaw": 1.4 * i, "pitch": 0.3 * i} for i in range(4)]}
GATES |= {"width": 1.0, "height": 0.8}
each_task = pytest.mark.parametrize("task", PAID)


def racers(**options):
    """Before their gates, at 3 to 8 m/s, off the middle of them by up to 0.2 m."""
    env = RacingEnv(num_envs=6, dtype=torch.float64, **options)
    state = env.reset()["state"]
    off = 0.14 * torch.randn(6, 3, dtype=torch.float64).clamp(-1.0, 1.0)
    way = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.3]), dim=-1)
    speed = torch.linspace(3.0, 8.0, 6, dtype=torch.float64).unsqueeze(1)
    state["position"] = state["target"] + off - way * (0.3 + 0.09 * speed)
    state["velocity"] = speed * way
    state["angular_velocity"] = 0.5 + 0.1 * torch.randn(6, 3, dtype=torch.float64)  # at rest its norm has a kink
    return env, state


def racers_through_gates(**options):
    """The same before gates with a direction, along it within half a radian."""
    env, state = racers(track=GATES, **options)
    along = forward(env.rotations)[state["gate"][:, 0]]
    way = torch.nn.functional.normalize(along + 0.3 * torch.randn(6, 3, dtype=torch.float64).clamp(-1.0, 1.0), dim=-1)
    speed = state["velocity"].norm(dim=-1, keepdim=True)
    off = 0.2 * torch.nn.functional.normalize(torch.linalg.cross(way, torch.randn(6, 3, dtype=torch.float64)), dim=-1)
    state["position"], state["velocity"] = state["target"] + off - way * (0.1 + 0.07 * speed), speed * way
    return env, state


def landers(**options):
    """Two each lack in the height, on the side (along x, along y), and in the speed; the last two have to brake."""
    env = LandingEnv(num_envs=6, dtype=torch.float64, **options)
    state = env.reset()["state"]
    position = [[0, 0.1, 0.215], [0.1, 0, 0.21], [0.31, 0, 0.12], [0, -0.309, 0.15], [0, 0, 0.17], [0.1, 0.1, 0.18]]
    velocity = [[0.1, 0, -0.2], [0, 0, -0.15], [-0.2, 0, 0], [0, 0.16, 0], [0, 0.1, -0.42], [0.1, 0, -0.4]]
    state["position"] = state["target"] + torch.tensor(position, dtype=torch.float64)
    state["velocity"] = torch.tensor(velocity, dtype=torch.float64)
    return env, state


STARTS = {"racing": racers, "gates": racers_through_gates, "landing": landers}


def flight(env, state, actions):
    """What each step pays and leads to, with the state at its start, (n, STEPS)."""
    return fly(env, env.reset(TensorDict({"state": state}, env.batch_size), set_state=True), actions.unbind(1))


def bisected(env, steps):
    """The fraction of each step (n, STEPS, 1) at which its event happens, by bisection; 0 where none does."""
    if isinstance(env, RacingEnv) and env.is_directed:
        gate = steps["state", "gate"][..., 0]
        start, end = (x - env.gates[gate] for x in (steps["state", "position"], steps["next", "state", "position"]))
        along, high = forward(env.rotations)[gate], torch.ones_like(steps["next", "reward"])

        def inside(fraction):
            ahead = (torch.lerp(start, end, fraction) * along).sum(-1, keepdim=True) >= 0.0
            return ahead & steps["next", "state", "gate_passed"]
    elif isinstance(env, RacingEnv):
        centre = steps["state", "target"]
        start, end = (x - centre for x in (steps["state", "position"], steps["next", "state", "position"]))
        way = end - start
        high = (-(start * way).sum(-1, keepdim=True) / way.square().sum(-1, keepdim=True)).clamp(0.0, 1.0)

        def inside(fraction):
            return (start + fraction * way).norm(dim=-1, keepdim=True) < 0.3
    else:
        high = torch.ones_like(steps["next", "reward"])

        def inside(fraction):
            keys = ("position", "velocity", "target")
            ends = ((key, steps["state", key], steps["next", "state", key]) for key in keys)
            return env.is_success({key: torch.lerp(start, end, fraction) for key, start, end in ends})

    low, happened = torch.zeros_like(high), inside(high)
    for _ in range(60):
        middle = 0.5 * (low + high)
        hit = inside(middle)
        low, high = torch.where(hit, low, middle), torch.where(hit, middle, high)
    return torch.where(happened, high, 0.0), happened


def counted(steps):
    """The discount of each step of the first episode, (n, STEPS, 1)."""
    over = steps["next", "done"].cumsum(1) - steps["next", "done"].long()
    return GAMMA ** torch.arange(STEPS).view(1, STEPS, 1) * (over == 0)


def rates(env, task, steps):
    """The dense terms at the ends of steps, as they were paid until the event and after it."""
    end = {key: x.flatten(0, 1) for key, x in steps["next", "state"].items()}
    old = {**end, **{key: steps["state", key].flatten(0, 1) for key in env.task_entries}}
    terms = ([x for name, x in env.reward_terms(state).items() if name != PAID[task]] for state in (old, end))
    before, after = (sum(x).view(-1, STEPS, 1) for x in terms)
    return before, after * ~steps["next", "terminated"]


def actions_of(env, task):
    actions = env.hover_action + 0.05 * torch.randn(6, STEPS, 4, dtype=torch.float64)
    if task == "landing":
        actions[4:, :, 0] += 0.3  # the last two brake
    return actions


@each_task
def test_gradients_in_actions_and_start_are_those_of_the_return_in_continuous_time(task):
    env, state = STARTS[task](event_discount=GAMMA)
    names = ("position", "velocity", "angular_velocity")
    inputs = [actions_of(env, task).requires_grad_(), *(state[name].requires_grad_() for name in names)]
    steps = flight(env, state, inputs[0])
    flown = steps.detach()
    before, after = rates(env, task, flown)
    assert (bisected(env, flown)[1] * counted(flown) > 0).any(1).all(), "each drone has an event"
    returns = {"events": (counted(steps) * steps["next", "reward_terms", TIMED[task]]).sum((1, 2))}
    if task != "landing":  # the descent of landing has a scale without gradient
        returns["all"] = (counted(steps) * steps["next", "reward"]).sum((1, 2))

    def reference(values):
        """The returns of another flight; all that the task pays is what its events pay, and its dense terms."""
        with torch.no_grad():
            moved = flight(env, state.clone().update(dict(zip(names, values[1:], strict=True))), values[0])
            fraction, happened = bisected(env, moved)
            # What events pay, and the dense terms at these rates in their steps.
            paid = EVENT_PAYS[task] * GAMMA**fraction + fraction * before + (1.0 - fraction) * after
            events = (counted(moved) * happened * paid).sum((1, 2))
            terms = moved["next", "reward_terms"].items()
            dense = sum(x for name, x in terms if name not in (PAID[task], TIMED[task]))
            return {"events": events, "all": events + (counted(moved) * dense).sum((1, 2))}

    for i, size in enumerate((1e-3, 1e-4, 1e-4, 1e-3)):
        for part, ours in returns.items():
            (grad,) = torch.autograd.grad(ours.sum(), inputs[i], retain_graph=True)
            # A direction with a part along the gradient: the difference is not a small one between large numbers.
            direction = sum(torch.nn.functional.normalize(x.flatten(1)) for x in (grad, 0.5 * torch.randn_like(grad)))
            along = {}
            for step in (1, -1, 2, -2):
                values = [x.detach() for x in inputs]
                values[i] = values[i] + step * size * direction.view_as(grad)
                along[step] = reference(values)[part]
            expected = (8.0 * (along[1] - along[-1]) - (along[2] - along[-2])) / (12.0 * size)
            torch.testing.assert_close((grad.flatten(1) * direction).sum(1), expected, rtol=1e-6, atol=1e-12)


@each_task
def test_values_and_all_other_terms_and_their_gradients_are_the_same_with_the_option_and_without(task):
    flights, grads = [], []
    for discount in (GAMMA, None):
        torch.manual_seed(0)
        env, state = STARTS[task](event_discount=discount)
        actions = actions_of(env, task).requires_grad_()
        assert (TIMED[task] in env.reset()["reward_terms"]) == (discount is not None)
        flights.append(flight(env, state, actions))
        terms = flights[-1]["next", "reward_terms"]
        wanted = [flights[-1]["next", "reward"], *(x for name, x in terms.items() if x.requires_grad)]
        grads.append([torch.autograd.grad(x.sum(), actions, retain_graph=True)[0] for x in wanted])
    (reward, *others, timed), (reward_without, *others_without) = grads
    torch.testing.assert_close(reward, reward_without + timed)
    assert timed.any() and all(map(torch.equal, others, others_without))
    terms = flights[0]["next", "reward_terms"]
    assert not terms.pop(TIMED[task]).any()
    for key, x in flights[1].items(True, True):
        assert torch.equal(flights[0][key], x), key


@each_task
def test_the_audit_says_that_a_term_has_a_gradient_in_time_only(task):
    env, state = STARTS[task](event_discount=GAMMA)
    actions = actions_of(env, task).requires_grad_()
    audit = audit_reward(flight(env, state, actions), actions, gamma=GAMMA)
    timed = audit[TIMED[task]]
    assert timed.verdict == "gradient in time only" and audit[PAID[task]].verdict == "no gradient"
    assert timed.return_share == 0.0 and timed.gradient_share > 0.0
    (row,) = (line for line in str(audit).splitlines() if line.startswith(TIMED[task]))
    assert row.split()[1] == "0" and row.endswith("%  gradient in time only")


@cases(({},), ({"dynamics": "point_mass"},), ({"wind": {"gust": 3.0}, "randomize": {"mass": {"scale": [0.8, 1.2]}}},))
@each_task
def test_tumbling_and_standing_drones_have_finite_gradients_and_specs_hold(options, task):
    task_options = {"track": GATES} if task == "gates" else {}
    name = "landing" if task == "landing" else "racing"
    env = make_env(name, num_envs=2, event_discount=0.99, **task_options, **options)
    check_env_specs(env, break_when_any_done="both")
    env, state = STARTS[task](event_discount=0.99, **options)
    state["velocity"][0] = 0.0
    inputs = [state["position"].requires_grad_(), state["velocity"].requires_grad_()]
    inputs.append((4.0 * torch.rand(6, 60, 4, dtype=torch.float64) - 2.0).requires_grad_())
    timed = flight(env, state, inputs[-1])["next", "reward_terms", TIMED[task]]
    grads = torch.autograd.grad(timed.sum(), inputs)
    assert all(x.any() and x.isfinite().all() for x in grads)


def test_times_have_the_derivatives_of_finite_differences():
    start, end = torch.randn(2, 50, 3, dtype=torch.float64)
    centre = start + 0.7 * (end - start) + 0.02 * torch.randn(50, 3, dtype=torch.float64)
    high, low = torch.rand(2, 50, 1, dtype=torch.float64) * torch.tensor([1.0, -1.0]).view(2, 1, 1) + 0.2
    assert ((high > 0.2) & (low < 0.2)).all()
    for function, inputs, limit in ((ball_entry, (start, end, centre), 0.1), (level_crossing, (high, low), 0.2)):
        inputs = [x.requires_grad_() for x in inputs]
        assert torch.autograd.gradcheck(lambda *x, f=function, y=limit: f(*x, y), inputs, atol=1e-7, rtol=1e-6)


def test_the_derivative_of_a_grazing_pass_is_bounded_and_those_who_are_inside_or_stand_have_none_or_a_finite_one():
    angle = torch.linspace(0.0, math.pi / 2, 1000, dtype=torch.float64).unsqueeze(1)
    # The line passes the middle of a ball of 1 so far off.
    aside = torch.cat((0.0 * angle, angle.sin(), 0.0 * angle), 1)
    for length in (4.0, 2.5):
        start = (aside - torch.tensor([2.0, 0.0, 0.0])).requires_grad_()
        end = (start.detach() + torch.tensor([length, 0.0, 0.0])).requires_grad_()
        time = ball_entry(start, end, 0.0, 1.0)
        torch.testing.assert_close(time, (2.0 - angle.cos()) / length, rtol=0.0, atol=1e-7)
        grads = torch.autograd.grad(time.sum(), (start, end))
        exact = angle.cos() > 0.3
        steepness = grads[0].norm(dim=1, keepdim=True) + grads[1].norm(dim=1, keepdim=True)
        torch.testing.assert_close(steepness, torch.where(exact, 1.0 / angle.cos(), 1 / 0.3) / length)
    start = torch.tensor([[0.1, 0.0], [0.3, 0.0], [2.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0 + 1e-7, 0.0]])
    end = torch.tensor([[5.0, 0.0], [0.3, 0.0], [2.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    for function in (lambda s, e: ball_entry(s, e, 0.0, 1.0), lambda s, e: level_crossing(s[:, :1], e[:, :1], 1.0)):
        ends = [x.clone().requires_grad_() for x in (start, end)]
        time = function(*ends)
        grads = torch.autograd.grad(time.sum(), ends)
        inside = start[:, 0] <= 1.0
        assert not time[inside].any() and not any(x[inside].any() for x in grads)
        assert ((time >= 0.0) & (time <= 1.0)).all() and all((x.norm(dim=1) <= 1e4).all() for x in grads)


def test_a_later_event_costs_discount_and_changes_when_the_dense_terms_jump():
    x = torch.full((3, 1), 0.25, dtype=torch.float64, requires_grad=True)
    happened, terminated = torch.tensor([[True], [True], [False]]), torch.tensor([[False], [True], [False]])

    def paid(**terms):
        return {name: torch.full((3, 1), value, dtype=torch.float64) for name, value in terms.items()}

    events = {"a": Event(happened, x, 10.0), "b": Event(happened, 2.0 * x, torch.tensor(-4.0), term="fine")}
    ends = paid(a=10.0, dense=3.0, other=0.5, fine=-4.0), paid(a=7.0, dense=1.0, other=0.25, fine=9.0)
    terms = time_terms(events, 0.9, *ends, terminated)
    assert list(terms) == ["a_time", "b_time"] and not any(term.any() for term in terms.values())
    jump = torch.tensor([1.25 - 3.5, 1.25, 0.0], dtype=torch.float64).unsqueeze(1)
    for name, paying, factor in (("a_time", 10.0 * 0.9**0.25, 1.0), ("b_time", -4.0 * 0.9**0.5, 2.0)):
        (slope,) = torch.autograd.grad(terms[name].sum(), x, retain_graph=True)
        torch.testing.assert_close(slope, factor * (math.log(0.9) * paying + jump) * happened)
    # A bonus that falls with the distance is paid in each step, and has no time.
    assert "gate_time" not in RacingEnv(event_discount=GAMMA, gate_bonus="log").reset()["reward_terms"]
