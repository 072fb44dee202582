"""The make-up of rewards and policy gradients, against numbers worked by hand and the paper's table I."""

import functools
import math
import re

import pytest
import torch
from helpers import cases, refuses
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from test_bounded_steps import LOSSES
from test_loss_modules import pendulum_networks
from torch import nn
from torchrl.envs import PendulumEnv

from torchrl_quad import ABPTLoss, BPTTLoss, HoveringEnv, SHACLoss, differentiable_rollout, make_actor, make_env
from torchrl_quad.diagnostics import audit_reward, compare_gradients, gradient_by_horizon, gradient_statistics
from torchrl_quad.envs.terms import distance


class Weigh(nn.Module):
    """The weighted sum of all entries of its inputs."""

    def __init__(self, *weights):
        super().__init__()
        self.weights = nn.Parameter(torch.tensor(weights))

    def forward(self, *x):
        return (self.weights * torch.cat(x, -1)).sum(-1, keepdim=True)


def module(net, in_keys, out_key):
    return TensorDictModule(net, in_keys=in_keys, out_keys=[out_key])


def make_rollout(states=((1.0, 2.0, 3.0), (1.0, 2.0, 3.0)), weight=2.0):
    """Two environments, three steps, action = 2 s, next state = s + action; returns of 36, -56, 5, 3 and 0 by term."""
    actor = module(Weigh(weight), ["observation"], "action")
    state = torch.tensor(states).unsqueeze(-1)
    steps = [actor(TensorDict({"observation": s}, s.shape[:1])) for s in state.unbind(1)]
    for td in steps:
        s, a = td["observation"], td["action"]
        paid = {"linear": 3.0 * a, "quadratic": -a.square(), "bonus": 5.0 * (s > 2.5), "alive": torch.ones_like(a)}
        paid["crash"], no = torch.zeros_like(a), torch.zeros_like(a, dtype=torch.bool)
        ends = {"reward": sum(paid.values()), "reward_terms": paid, "observation": s + a}
        td["next"] = TensorDict({**ends, "done": no, "terminated": no}, td.batch_size)
    return torch.stack(steps, 1), actor


def test_returns_gradients_and_shares_are_those_worked_by_hand():
    rollout, actor = make_rollout()
    audit = audit_reward(rollout, actor)
    returns = {name: term.mean_return for name, term in audit.items()}
    assert returns == {"linear": 36.0, "quadratic": -56.0, "bonus": 5.0, "alive": 3.0, "crash": 0.0}
    shares = {name: round(term.return_share, 6) for name, term in audit.items()}
    assert shares == {"linear": 0.36, "quadratic": 0.56, "bonus": 0.05, "alive": 0.03, "crash": 0.0}
    # d/dw of 3 w s and of -(w s)^2 at w = 2, summed over s = 1, 2, 3: 18 and -56
    norms = {name: term.gradient_norm for name, term in audit.items()}
    assert norms == {"linear": 18.0, "quadratic": 56.0, "bonus": 0.0, "alive": 0.0, "crash": 0.0}
    assert audit["linear"].gradient_share == pytest.approx(18 / 74)
    verdicts = {name: term.verdict for name, term in audit.items()}
    differentiable = dict.fromkeys(("linear", "quadratic"), "differentiable")
    assert verdicts == {**differentiable, "bonus": "no gradient", "alive": "constant", "crash": "not seen"}
    assert actor.module.weights.grad is None
    _, row, *_, last = repr(audit).splitlines()
    assert row.split() == ["linear", "36", "36.0%", "18", "24.3%", "differentiable"]
    assert last == "partially differentiable: all but bonus, 5.0% of the return; not seen: crash"
    metrics = audit.metrics()
    assert metrics["quadratic_return_share"] == audit["quadratic"].return_share and len(metrics) == 10


def test_returns_are_discounted_anew_in_each_episode():
    rollout, actor = make_rollout()
    rollout["next", "done"][0, 1] = True
    audit = audit_reward(rollout, actor, gamma=0.5)
    # s = 1, 2, 3 with discounts 1, 1/2, 1 and 1, 1/2, 1/4: sums of 5 and 2.75
    assert audit["linear"].mean_return == 6 * (5 + 2.75) / 2 and audit["linear"].gradient_norm == 3 * (5 + 2.75) / 2
    assert audit["bonus"].mean_return == 5 * (1 + 0.25) / 2


def test_the_actions_of_a_rollout_may_be_the_inputs():
    rollout, actor = make_rollout()
    audit = audit_reward(rollout, rollout["action"])
    assert audit["linear"].gradient_norm == pytest.approx(3 / 2 * math.sqrt(6))  # six actions, mean of two returns
    assert audit["bonus"].verdict == "no gradient"
    by_weights = audit_reward(rollout, [actor.module.weights])
    assert by_weights == audit_reward(rollout, actor) == audit_reward(rollout, BPTTLoss(actor))


def test_an_audit_needs_no_gradient_mode_and_counts_no_gradient_that_is_not_finite():
    rollout, actor = make_rollout()
    rollout["next", "reward_terms", "root"] = (rollout["action"] - rollout["action"].detach()).sqrt()
    assert audit_reward(rollout, actor)["root"].verdict == "not finite"
    assert audit_reward(rollout, actor).without_gradient == ["bonus", "root"]
    with torch.no_grad():
        assert audit_reward(rollout, actor)["linear"].gradient_norm == 18.0


def fly(task, horizon=24, **options):
    """A horizon in which every term is paid: drones above and beside the pad, before a gate, and in free flight."""
    options = {"num_envs": 6, "seed": 0, **options}
    env = (functools.partial(make_env, task) if isinstance(task, str) else task)(**options)
    td = env.reset()
    state = td["state"]
    if task == "landing":
        state["position"][:2] = torch.tensor([2.0, 0.0, 0.25])
        state["velocity"][:2, 2] = -0.2
        state["position"][2:4] = torch.tensor([3.0, 0.0, 0.1])
        state["velocity"][2:4, 2] = -1.0
    if task == "racing":
        state["position"][:3] = state["target"][:3] - torch.tensor([0.5, 0.0, 0.0])
        state["velocity"][:3, 0] = 2.0
    actor = make_actor(env)
    rollout, _ = differentiable_rollout(env, actor, env.reset(td, set_state=True), horizon)
    return rollout, actor


@cases(
    ("hovering", {}, [], ["'attitude'"]),  # whose weight the paper chose
    ("tracking", {}, [], ["'attitude'"]),
    ("landing", {}, ["success", "crash"], []),
    ("racing", {"reward": "position"}, ["gate"], ["'attitude'"]),
    ("racing", {"reward": "velocity"}, ["gate"], []),
    ("racing", {"gate_bonus": "log"}, [], ["gate,"]),
    ("racing", {"reward": "velocity", "gate_bonus": "reciprocal"}, [], ["gate,"]),
)
def test_the_audit_finds_which_rewards_are_fully_and_which_are_partially_differentiable(task, options, without, traps):
    rollout, actor = fly(task, **options)
    audit = audit_reward(rollout, actor, gamma=0.99)
    assert audit.without_gradient == without
    for name, term in audit.items():
        expected = "no gradient" if name in without else "constant" if name == "survival" else "differentiable"
        assert term.verdict == expected, f"{name}\n{audit}"
    assert sum(term.return_share for term in audit.values()) == pytest.approx(1.0)
    assert sum(term.gradient_share for term in audit.values()) == pytest.approx(1.0)
    assert [trap.split()[0] for trap in audit.traps] == traps, audit
    if task != "hovering":
        return
    for key in ("action", ("state", "quaternion")):  # the first state has no graph
        by_entry = audit_reward(rollout, rollout[key])
        assert [term.verdict for term in by_entry.values()] == [term.verdict for term in audit.values()]


class DoubtfulEnv(HoveringEnv):
    """Hovering that ends with a bonus, and pays for being near: both well or badly, as the weights say."""

    ends_on_success = True
    weights = {**HoveringEnv.weights, "attitude": 0.0, "arrival": 20.0, "near": 0.0, "width": 1.0}
    start_range, success_radius = (1.0, 0.5, 0.5), 0.3

    def initial_state(self, n):
        start = super().initial_state(n)
        start["velocity"] = start["target"] - start["position"]
        return start

    def reward_terms(self, state):
        arrival = self.weights["arrival"] * self.is_success(state)
        near = self.weights["near"] * (-((distance(state) / self.weights["width"]) ** 2)).exp()
        return {**super().reward_terms(state), "arrival": arrival, "near": near}


class CountingEnv(DoubtfulEnv):
    """Pays in each step for how often a drone was near so far: of six, some are from the start, and some get there."""

    ends_on_success = False
    weights = {**DoubtfulEnv.weights, "arrival": 0.0, "visited": 9.0}

    def initial_state(self, n):
        return {**super().initial_state(n), "visits": torch.zeros(n, 1, device=self.device)}

    def advance(self, previous, state):
        return {**state, "visits": previous["visits"] + (distance(previous) > 0.6) * (distance(state) <= 0.6)}

    def reward_terms(self, state):
        return {**super().reward_terms(state), "visited": self.weights["visited"] * state["visits"]}


class CrashedEnv(HoveringEnv):
    def is_crash(self, state):
        return torch.ones_like(state["step"], dtype=torch.bool)


class DetachedEnv(HoveringEnv):
    def reward_terms(self, state):
        return super().reward_terms({**state, "velocity": state["velocity"].detach()}) | {
            "attitude": 0.0 * state["position"][:, :1]
        }


class SparseEnv(HoveringEnv):
    """Paid for arriving alone; two of six starts crash at once."""

    def is_crash(self, state):
        return (torch.arange(self.num_envs)[:, None] % 5 == 0) & (state["step"] < 2)

    def reward_terms(self, state):
        return {"arrival": self.is_success(state).to(self.dtype)}


class EasyEnv(HoveringEnv):
    """Every state is a success, and the observation has a large constant."""

    def is_success(self, state):
        return torch.ones_like(state["step"], dtype=torch.bool)

    def is_crash(self, state):
        return state["step"] > 5

    def observe(self, state):
        return torch.cat((super().observe(state), torch.full_like(state["velocity"], 1e4)), -1)


def test_a_success_that_is_always_true_and_a_large_observation_are_traps_and_a_crash_is_no_success():
    always, large = audit_reward(*fly(EasyEnv, 12, weights=NO_ATTITUDE), gamma=0.99).traps
    assert always.startswith("success is true in every step")
    assert large.startswith("the observation has entries of more than a hundred in the mean: 13 (1e+04), 14 (1e+04)")


class ClockedEnv(HoveringEnv):
    """A task whose target moves after six steps, whatever the drone does."""

    def advance(self, previous, state):
        moved = self.tensor([3.0, 0.0, 0.0]) * (state["step"] == 6)
        return {**state, "target": state["target"] + moved}


def test_what_jumps_by_the_clock_is_no_trap_as_no_drone_delays_it_by_waiting():
    rollout, actor = fly(ClockedEnv, 12, weights=NO_ATTITUDE)
    jumped = "target jumped 6 times, and a step then paid"
    assert audit_reward(rollout, actor, gamma=0.99).traps == []
    rollout["next", "state", "step"] += torch.arange(6).view(6, 1, 1)  # in six steps of their episodes: no clock
    assert audit_reward(rollout, actor, gamma=0.99).traps[0].startswith(jumped)
    env = ClockedEnv(num_envs=6, seed=0, weights=NO_ATTITUDE)
    carry = env.reset()
    carry["state", "step"] += torch.arange(6).view(6, 1)  # the same clock, and episodes that began before
    rollout, _ = differentiable_rollout(env, actor, carry, 12)
    assert len((rollout["next", "state", "target"][..., 0].diff(dim=1) > 1).nonzero()[:, 1].unique()) > 3
    assert audit_reward(rollout, actor, gamma=0.99).traps == []
    rollout, actor = fly(ClockedEnv, 12, weights=NO_ATTITUDE)
    for step in (torch.zeros(6, 12, 2), None):  # of another environment: the steps of the rollout count
        rollout["next", "state"].pop("step")
        if step is not None:
            rollout["next", "state", "step"] = step
        assert audit_reward(rollout, actor, gamma=0.99).traps == []
    few = audit_reward(*fly(ClockedEnv, 12, weights=NO_ATTITUDE, num_envs=3), gamma=0.99)  # which tell no clock
    assert few.traps[0].startswith(jumped.replace("6", "3"))


def test_a_reward_without_any_gradient_and_starts_that_crash_at_once_are_traps():
    audit = audit_reward(*fly(SparseEnv, 12))
    assert audit["arrival"].verdict in ("no gradient", "not seen") and audit["arrival"].gradient_norm == 0.0
    first, *_, last = audit.traps
    assert re.match("[0-9]+% of the episodes end in their first step", first) and "no term has a gradient" in last


NO_ATTITUDE = {"attitude": 0.0}


@cases(
    ("racing", {"gate": 0.0, **NO_ATTITUDE}, "gate, target.* if a drone that waits .* waiting pays more than arriving"),
    (DoubtfulEnv, {"arrival": 1.0}, "success ends an episode and pays 1.1, .*: loitering pays more"),
    (DoubtfulEnv, {"near": 10.0, "width": 0.08}, "'near' is flat in .* of the flights, those in which it pays least"),
    (HoveringEnv, {"survival": 0.0, **NO_ATTITUDE}, "as this policy flies .* must cost more than [0-9.]*, else dying"),
    (CountingEnv, {}, "'visited' pays for each change of 'visits' in every later step"),
    (CrashedEnv, {}, "100% of the episodes end in their first step: look at the start, is_crash and is_success"),
    (DetachedEnv, {}, "'velocity' changes from step to step without a gradient: no numpy"),
    (HoveringEnv, {}, "'attitude' is less than a thousandth of return and gradient"),
)
def test_the_audit_says_in_words_what_keeps_a_policy_from_learning_a_task(task, weights, trap):
    options = {"reward": "position"} if task == "racing" else {}
    audit = audit_reward(*fly(task, 12, weights=weights, **options), gamma=0.99)
    assert len(audit.traps) == 1 and re.match(trap, audit.traps[0]), audit
    assert f"trap: {audit.traps[0]}" in repr(audit)


def shac(rollout_and_actor, critic, **options):
    rollout, actor = rollout_and_actor
    loss = SHACLoss(actor, module(Weigh(critic), ["observation"], "state_value"), **options)
    return loss.make_value_estimator(gamma=0.5), rollout


def reward_is_action(rollout_and_actor):
    rollout_and_actor[0]["next", "reward"] = 1.0 * rollout_and_actor[0]["action"]
    return rollout_and_actor


@pytest.mark.parametrize(("critic", "cosine"), [(4.0, 1.0), (-4.0, -1.0)])
def test_the_terminal_value_of_shac_pulls_with_the_rewards_or_against_them(critic, cosine):
    comparison = compare_gradients(*shac(reward_is_action(make_rollout()), critic))
    assert comparison.cosine == pytest.approx(cosine)
    assert comparison.first_order_norm == 1 + 2 / 2 + 3 / 4  # of w s
    assert comparison.value_norm == 4 * 3 / 8  # gamma^3 V(s + w s) at s = 3
    header, row = (line.split() for line in repr(comparison).splitlines())
    assert header == ["cosine", "first_order_norm", "value_norm"] and row == [f"{cosine:g}", "2.75", "1.5"]


@pytest.mark.parametrize(("critic", "cosine"), [(1.0, 1.0), (-1.0, -1.0)])
def test_abpt_sets_the_0_step_return_against_the_n_step_return(critic, cosine):
    rollout, actor = reward_is_action(make_rollout())
    qvalue = module(Weigh(0.0, 0.0), ["observation", "action"], "state_action_value")
    loss = ABPTLoss(actor, qvalue, num_qvalue_nets=1).make_value_estimator(gamma=0.5)
    loss.qvalue_network_params["module", "weights"].data.copy_(torch.tensor([[0.0, 4.0 * critic]]))
    comparison = compare_gradients(loss, rollout)
    # Q = 4 a at s_0 = 1, and gamma^3 4 w s' with s' = (1 + w) s at s = 3, where a change of w changes s' as well
    n_step = 2.75 + critic * 4 * (9 + 2 * 3) / 8
    assert comparison.first_order_norm == pytest.approx(abs(n_step) / 2) and comparison.value_norm == 4 / 2
    assert comparison.cosine == pytest.approx(cosine * math.copysign(1, n_step))


def test_the_cosine_is_nan_where_one_of_the_two_gradients_is_missing():
    rollout, actor = make_rollout()
    bptt = compare_gradients(BPTTLoss(actor), rollout)
    assert bptt.first_order_norm > 0 and math.isnan(bptt.value_norm) and math.isnan(bptt.cosine)
    cut = compare_gradients(*shac((rollout, actor), 4.0, terminal_gradient=False))
    assert cut.value_norm == 0.0 and math.isnan(cut.cosine)
    qvalue = module(Weigh(1.0, 1.0), ["observation", "action"], "state_action_value")
    alone = compare_gradients(ABPTLoss(actor, qvalue, n_step_return=False), rollout)
    assert alone.value_norm > 0 and math.isnan(alone.first_order_norm) and math.isnan(alone.cosine)


def test_the_spread_of_the_gradients_is_that_worked_by_hand():
    rollout, actor = reward_is_action(make_rollout(states=((1.0, 1.0), (2.0, 4.0), (0.0, 1.0), (9.0, 9.0))))
    loss = BPTTLoss(actor).make_value_estimator(gamma=1.0)
    statistics = gradient_statistics(loss, rollout, max_envs=3)  # 2, 6 and 1; the fourth is left out
    assert (statistics.norm, statistics.variance) == pytest.approx((3.0, 7.0))
    assert statistics.signal_to_noise == pytest.approx(3 / math.sqrt(7))


@pytest.mark.parametrize("name", ["bptt", "shac", "abpt"])
def test_the_variance_is_that_of_a_loop_with_backward_and_leaves_no_grad_behind(name):
    env = HoveringEnv(num_envs=5, dtype=torch.float64)
    actor = make_actor(env, num_cells=(8,))
    loss = LOSSES[name](env, actor, reduction="none")
    start = env.reset()

    def rollout(horizon):
        torch.manual_seed(horizon)
        env.set_seed(0)
        return differentiable_rollout(env, actor, start, horizon)[0]

    for horizon in (2, 6):
        data = rollout(horizon)
        torch.manual_seed(0)  # for the actions that ABPT samples
        statistics = gradient_statistics(loss, data)
        assert all(p.grad is None for p in [*loss.parameters(), *actor.parameters()])
        torch.manual_seed(0)
        objectives, naive = -loss.loss_actor(data)[0], []
        for objective in objectives:
            objective.backward(retain_graph=True)
            naive.append(torch.cat([p.grad.flatten() for p in actor.parameters()]))
            actor.zero_grad()
        naive = torch.stack(naive)
        assert statistics.norm == pytest.approx(naive.mean(0).norm().item(), rel=1e-6)
        assert statistics.variance == pytest.approx(naive.T.cov().trace().item(), rel=1e-6)
        torch.manual_seed(horizon)
        env.set_seed(0)
        if name != "abpt":
            assert gradient_by_horizon(env, actor, loss, [horizon], start=start) == {horizon: statistics}


def test_diagnostics_look_at_the_pendulum_of_torchrl():
    env = PendulumEnv(seed=0)
    actor, value, qvalue = pendulum_networks(env)
    start = env.reset(env.gen_params(batch_size=[6]), set_state=False)
    rollout, _ = differentiable_rollout(env, actor, start, 12)
    audit = audit_reward(rollout, actor, terms_key=("next", "reward"))
    assert audit["reward"].verdict == "differentiable" and audit.without_gradient == []
    assert audit["reward"].mean_return == pytest.approx(rollout["next", "reward"].sum(1).mean().item())
    assert audit_reward(rollout, rollout["action"], terms_key=("next", "reward"))["reward"].gradient_norm > 0
    for loss in (SHACLoss(actor, value), ABPTLoss(actor, qvalue)):
        comparison = compare_gradients(loss, rollout)
        assert -1.0 <= comparison.cosine <= 1.0 and comparison.first_order_norm > 0 and comparison.value_norm > 0
        grown = gradient_by_horizon(env, actor, loss, (2, 8), start=start, max_envs=4)
        assert grown[8].norm > grown[2].norm and all(x.variance > 0 for x in grown.values())


AUDITS = {
    r"'own' is not finite in 2 of 6 steps. Look for a logarithm": lambda r, a: audit_reward(r, a, terms_key="broken"),
    r"do not add up to the reward: they are off by up to 12": lambda r, a: audit_reward(r, a, reward_key="scaled"),
    r"'short' has shape \(2, 3\), and the reward \(2, 3, 1\)": lambda r, a: audit_reward(r, a, terms_key="own"),
    "reads .*'terms'.* which is not in the rollout. Name the terms": lambda r, a: audit_reward(r, a, terms_key="terms"),
    "carries no gradient. Collectors.*Use differentiable_rollout": lambda r, a: audit_reward(r.detach(), a),
    "carries no gradient": lambda r, a: compare_gradients(BPTTLoss(a), r.detach()),
    "does not depend on the inputs. Give the actor that flew": lambda r, a: audit_reward(r, make_rollout()[1]),
    "nothing to differentiate with respect to": lambda r, a: audit_reward(r, r["observation"]),
    "at least two .*, got 1. Fly more.* max_envs=1": lambda r, a: gradient_statistics(BPTTLoss(a), r, max_envs=1),
    "got 1. Fly more": lambda r, a: gradient_statistics(BPTTLoss(a), r[:1]),
}


@pytest.mark.parametrize("message", AUDITS)
def test_what_cannot_be_audited_is_refused_with_advice(message):
    rollout, actor = make_rollout()
    rollout["broken", "own"] = torch.tensor([0.0, float("nan"), 0.0]).expand(2, 3).unsqueeze(-1)
    rollout["scaled"] = 2.0 * rollout["next", "reward"]  # 6, -6 and -24
    rollout["own"] = TensorDict({"short": torch.ones(2, 3)}, [2, 3])
    refuses(message, AUDITS[message], rollout, actor, error=(ValueError, RuntimeError))
