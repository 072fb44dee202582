"""Exploration noise that is correlated in time."""

import math

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from torchrl_quad import ABPTLoss, BPTTLoss, HoveringEnv, differentiable_rollout, make_actor, make_qvalue, make_value
from torchrl_quad.objectives.calls import sample_action

RHO = 0.9
ONCE = {"auto_reset": False, "break_when_any_done": False}


@pytest.fixture
def env64():
    return HoveringEnv(num_envs=4, seed=1, dtype=torch.float64, max_episode_steps=7)


def test_the_noise_is_standard_normal_in_every_step_and_correlated_over_time():
    env = HoveringEnv(num_envs=512, max_episode_steps=90)
    actor = make_actor(env, noise_correlation=RHO, scale_init=0.2)
    start = env.reset()
    start["state", "step"][::2] = 30  # these end with the horizon
    rollout, carry = differentiable_rollout(env, actor, env.reset(start, set_state=True), 60)
    noise = rollout["noise"].double()
    assert noise.mean().abs() < 0.05  # four standard errors, as below
    for part in (noise[:, 0], noise[:, 30], noise[:, -1]):
        assert part.std() == pytest.approx(1.0, abs=0.06)
    for lag in (1, 5, 20):
        correlation = (noise[:, lag:] * noise[:, :-lag]).mean().item()
        assert correlation == pytest.approx(RHO**lag, abs=0.06)
    mean = torch.atanh(rollout["action"]) - 0.2 * rollout["noise"]  # mu + sigma e, with mu nearly constant at the start
    assert mean.std(1).max() < 0.1
    more, _ = differentiable_rollout(env, actor, carry, 3)
    assert torch.equal(more["noise_before"][:, 0], rollout["noise"][:, -1])  # also over resets
    assert 0 < rollout["next", "done"][:, -1].sum() < 512


def test_loc_scale_and_log_probability_are_those_given_the_noise_of_the_step_before(env64):
    actor = make_actor(env64, noise_correlation=RHO, scale_init=0.3, return_log_prob=True)
    plain = make_actor(env64, scale_init=0.3)
    plain.load_state_dict(actor.state_dict())
    rollout, _ = differentiable_rollout(env64, actor, None, 20)
    with torch.no_grad():
        free = plain.get_dist_params(rollout.select("observation"))
    rest = math.sqrt(1 - RHO**2)
    torch.testing.assert_close(rollout["scale"], free["scale"] * rest)
    torch.testing.assert_close(rollout["loc"], free["loc"] + RHO * free["scale"] * rollout["noise_before"])
    given = TransformedDistribution(Normal(rollout["loc"], rollout["scale"]), TanhTransform())
    torch.testing.assert_close(rollout["action_log_prob"], given.log_prob(rollout["action"]).sum(-1))
    marginal = torch.tanh(free["loc"] + free["scale"] * rollout["noise"])
    torch.testing.assert_close(rollout["action"], marginal)


def test_every_way_to_fly_gives_the_same_noise_values_and_gradients(env64):
    actor = make_actor(env64, noise_correlation=RHO, scale_init=0.3, return_log_prob=True)
    called = TensorDictSequential(actor)

    def flight(roll, policy=actor, kind=ExplorationType.RANDOM):
        env64.set_seed(0)
        torch.manual_seed(0)
        with set_exploration_type(kind):
            rollout = roll(12, policy, tensordict=env64.reset(), **ONCE)
            rest = roll(5, policy, tensordict=env64.maybe_reset(env64.step_mdp(rollout[:, -1].detach())), **ONCE)
        total = sum(x["next", "reward"].sum() + x["action_log_prob"].sum() + x["noise"].sum() for x in (rollout, rest))
        return dict(rest.items(True, True)), torch.autograd.grad(total, list(actor.parameters()))

    expected = flight(lambda *a, **k: EnvBase.rollout(env64, *a, **k))
    torch.testing.assert_close(flight(env64.rollout), expected)
    torch.testing.assert_close(flight(env64.rollout, called), expected)
    mode, _ = flight(env64.rollout, kind=ExplorationType.DETERMINISTIC)
    assert not mode["noise"].any()
    loss = BPTTLoss(actor, clip_action_gradient=1e9), BPTTLoss(actor)
    rollout, _ = differentiable_rollout(env64, actor, None, 6)
    grads = [torch.autograd.grad(x.loss_actor(rollout)[0], list(x.actor_network_params.parameters())) for x in loss]
    torch.testing.assert_close(*grads)


@pytest.mark.parametrize("bias", [0.3, 10.0])  # and far beyond where the tanh tells numbers apart
def test_called_or_not_the_noise_is_the_same_also_where_the_action_is_saturated(env64, bias):
    actor = make_actor(env64, noise_correlation=RHO, scale_init=0.3, return_log_prob=True)
    actor[0].module.mlp[-1].bias.data[:4] = bias
    td = env64.reset()
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        torch.manual_seed(3)
        with set_exploration_type(kind):
            written, plain = actor(td.copy()), actor.plain()
        torch.manual_seed(3)
        drawn = plain.drawn(1, 4, {})[0]
        mine = plain.forward(plain.weights, [td["observation"]], drawn)[1]
        torch.testing.assert_close({key: written[key] for key in mine}, mine)
        torch.testing.assert_close(plain.drawn_again(written), drawn)
        assert written["noise"].abs().max() < 5 and written["noise"].any() == (kind is ExplorationType.RANDOM)
    with set_exploration_type(ExplorationType.DETERMINISTIC):  # also after a random flight
        again = actor(td.copy().set("noise", torch.ones(4, 4, dtype=env64.dtype)))
    torch.testing.assert_close(again["action"], written["action"])


def test_an_actor_can_be_called_with_its_entries(env):
    td = env.reset()
    for rho, before in ((0.0, {}), (RHO, {"noise_before": torch.zeros(4, 4)})):
        actor = make_actor(env, noise_correlation=rho)
        assert ("noise" in actor.out_keys) == bool(rho)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = actor(observation=td["observation"], **before)
            torch.testing.assert_close(written[2], actor(td.copy())["action"])


def test_ppo_s_ratio_is_that_of_the_new_part_of_the_noise():
    env = HoveringEnv(num_envs=8)
    actor = make_actor(env, noise_correlation=RHO, scale_init=0.3, return_log_prob=True)
    loss = ClipPPOLoss(actor, make_value(env), entropy_bonus=False)
    assert "noise_before" in loss.in_keys
    rollout, _ = differentiable_rollout(env, actor, None, 5)
    data = rollout.detach().select(*loss.in_keys, strict=False).reshape(-1)  # it names entries of "next" it never reads
    data["advantage"] = data["value_target"] = torch.ones(40, 1)
    assert loss(data)["kl_approx"].abs() < 1e-5  # nothing has changed yet: the ratio is one
    with torch.no_grad():
        actor[0].module.mlp[-1].bias[:4] += 0.05
        new = actor.get_dist_params(data)
    old, moved = (Normal(x["loc"], x["scale"]) for x in (rollout.detach().reshape(-1), new))
    u = torch.atanh(data["action"])
    expected = (old.log_prob(u) - moved.log_prob(u)).sum(-1).mean()
    torch.testing.assert_close(loss(data)["kl_approx"], expected, rtol=1e-3, atol=1e-4)


def test_a_new_action_at_the_end_of_a_horizon_has_the_noise_of_the_policy_itself():
    env = HoveringEnv(num_envs=2000)
    actor = make_actor(env, noise_correlation=RHO, scale_init=0.3)
    loss = ABPTLoss(actor, make_qvalue(env))
    rollout, _ = differentiable_rollout(env, actor, None, 2)
    assert loss(rollout)["loss_actor"].isfinite()
    states = rollout[:, 0].select("observation")
    action = sample_action(actor, loss.actor_network_params, states)["action"].detach()
    assert torch.atanh(action).std(0).mean() == pytest.approx(0.3, rel=0.05)
