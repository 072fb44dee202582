"""SAPO, AHAC, the hybrid loss, and ABPT with a simulated start: numbers worked by hand, finite differences."""

import math
import pickle

import pytest
import torch
from helpers import anew, pushed, refuses
from test_objectives import GAMMA, LAMBDA, REWARDS, doubling, make_abpt, make_networks, make_rollout, targets
from torch.distributions import Normal
from torchrl.modules import TanhNormal
from torchrl.objectives import ValueEstimators

from torchrl_quad import ActionSequence, HoveringEnv, differentiable_rollout, make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, PODSLoss, SAPOLoss, SHACLoss
from torchrl_quad.objectives.calls import plain_of

ENTROPY = [-3.0, -1.0, 1.0, 3.0]  # of the four steps, in both environments


def make_sapo(*critics, **options):
    """V(s) = critic * s for each of the critics; alpha 2, target -1: the entropies above count -1, 0, 1 and 2."""
    actor, value, _ = make_networks()
    loss = SAPOLoss(actor, value, num_value_nets=len(critics), **{"alpha": 2.0, "target_entropy": -1.0, **options})
    if len(critics) > 1:
        loss.value_network_params["module", "weight"].data.copy_(torch.tensor(critics))
    rollout = make_rollout(actor)
    rollout["action_log_prob"] = -torch.tensor([ENTROPY, ENTROPY])
    return loss.make_value_estimator(gamma=GAMMA, lmbda=LAMBDA), rollout


# -- SAPO --------------------------------------------------------------------------------------------------------------


def test_sapo_adds_the_entropy_of_each_step_to_its_reward_and_climbs_the_mean_of_the_critics():
    loss, rollout = make_sapo(10.0, 30.0, reduction="none")
    # Bonuses of 2 (-1, 0, 1, 2). Environment 0: [-2 + 0/2] + [2 + 4/2]; environment 1: [-2 + 0/2 + 2/4] + [4].
    entropy = [-2 + 4, -1.5 + 4]
    terminal = [20 * 9 / 4 + 20 * 5 / 4, 20 * 5 / 2]
    loss_actor, metadata = loss.loss_actor(rollout)
    assert loss_actor.tolist() == [-sum(x) for x in zip(REWARDS, entropy, terminal, strict=True)]
    assert metadata["entropy"] == 0.0 and metadata["alpha"] == 2.0
    divided, rollout = make_sapo(10.0, 30.0, reduction="none", average_over_horizon=True)
    assert divided.loss_actor(rollout)[0].tolist() == (loss_actor / 4).tolist()


def test_the_critics_of_sapo_learn_the_soft_return_of_the_least_of_them():
    loss, rollout = make_sapo(30.0, 10.0)
    target = loss.write_value_target(rollout.detach())["value_target"]
    soft = [2.0 - 2, 4.0 + 0, 6.0 + 2, 8.0 + 4]
    torch.testing.assert_close(target[..., 0], torch.tensor(targets(soft)))
    assert rollout["next", "reward"][0, :, 0].tolist() == [2, 4, 6, 8]  # left as they were
    # They have no target networks: what they learn of is what they say now.
    loss.value_network_params["module", "weight"].data.add_(1.0)
    assert not torch.equal(loss.write_value_target(rollout.detach())["value_target"], target)


def test_the_target_entropy_of_sapo_is_minus_half_the_size_of_the_action():
    loss, rollout = make_sapo(10.0, alpha="auto", target_entropy="auto")
    assert loss._target_entropy(rollout) == -0.5
    assert loss._normalized_entropy(rollout)[0, :, 0].tolist() == [x + 0.5 for x in ENTROPY]  # (h + 1/2) / (2 / 2)
    loss.loss_actor(rollout)[1]["loss_alpha"].backward()
    assert loss.alpha == 1.0 and loss.log_alpha.grad == 0.5  # the mean entropy of 0 is too high: alpha falls


@pytest.mark.parametrize("clip", [None, 1e9])
def test_the_gradient_of_sapo_is_that_of_finite_differences(env64, clip):
    env, actor = env64, make_actor(env64, (8,), return_log_prob=True)
    loss = SAPOLoss(actor, make_value(env, (8,)), alpha=0.1, clip_action_gradient=clip)
    weight = actor[0].module.mlp[-1].bias  # of means and scales

    def value():
        return loss.loss_actor(differentiable_rollout(anew(env), actor, None, 5)[0])[0]

    (grad,) = torch.autograd.grad(value(), weight)
    for entry in (1, 5):  # clipped, the entropy counts at fixed states: only a later one could have another gradient
        ends = []
        for step in (1e-6, -2e-6):
            weight.data[entry] += step
            ends.append(value().item())
        weight.data[entry] += 1e-6
        numeric = (ends[0] - ends[1]) / 2e-6
        assert grad[entry].item() == pytest.approx(numeric, rel=1e-6 if clip is None else 2e-2, abs=1e-8)


# -- PODS --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2])
def test_pods_asks_for_the_actions_that_raise_the_return(order):
    """The best is x = 0 after one step, and to stay."""
    actor, _, _ = make_networks(policy=1.0)
    rollout = doubling()
    loss = PODSLoss(actor, order=order, step=1e9 if order == 2 else 0.1, clip_action_gradient=None).double()
    loss.make_value_estimator(gamma=1.0)
    change = (loss.write_action_target(rollout)["action_target"] - rollout["action"])[0, :, 0]
    # The gradients are -(2 + 2 * 4) and -4: their median, the lower one, is a change of 0.1. The policy doubles x.
    assert change.tolist() == pytest.approx([-2.0, 0.0] if order == 2 else [-0.25, -0.1], abs=1e-6)


def test_the_second_order_of_pods_is_that_of_the_dynamics():
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=2, seed=0, dtype=torch.float64)
    actor = make_actor(env)
    for x in actor.parameters():  # the same action everywhere, so that it reacts to nothing
        x.data.zero_()
    start, steps = env.reset(), 4
    loss = PODSLoss(actor, order=2, step=0.02, iterations=100, clip_action_gradient=None)
    rollout, _ = differentiable_rollout(env, actor, start.clone(), steps)
    change = (loss.write_action_target(rollout)["action_target"] - rollout["action"]).detach()

    def returned(actions):
        flight = env.rollout(steps, ActionSequence(actions.movedim(-2, 0)), tensordict=start.clone(), auto_reset=False)
        return (loss._discounts(flight) * flight["next", "reward"]).sum()

    flown = rollout["action"].detach()
    gradient, hessian = torch.func.grad(returned)(flown), torch.autograd.functional.hessian(returned, flown)
    damping = gradient.norm(dim=-1)[gradient.norm(dim=-1) > 0].median() / 0.02
    matrix = damping * torch.eye(flown.numel()).double() - hessian.reshape(flown.numel(), -1)
    expected = torch.linalg.solve(matrix, gradient.flatten()).view_as(change)
    torch.testing.assert_close(change, expected)
    assert (expected - gradient / damping).abs().max() > 0.01 * expected.abs().max()  # the second order tells


def test_one_step_towards_better_actions_goes_where_the_loss_itself_goes(env64):
    actor = make_actor(env64)
    rollout, _ = differentiable_rollout(env64, actor, None, 5)
    pods, bptt = PODSLoss(actor, step=0.3, clip_action_gradient=2.0), BPTTLoss(actor, clip_action_gradient=2.0)
    ahac = AHACLoss(actor, make_value(env64), horizon=5, clip_action_gradient=2.0)
    target, measured = ahac.better_actions(rollout, 0.3)
    assert {"stiffness", "clipped", "n_step_return"} <= measured.keys()
    length = (target - rollout["action"]).norm(dim=-1)
    assert length[length > 0].median().item() == pytest.approx(0.3)  # those that do not act within the horizon apart
    by_pods = pods.write_action_target(rollout.copy()).detach()
    assert not torch.allclose(target, by_pods["action_target"])  # which has no value of the end
    refuses("step must be greater than 0, got -1", ahac.better_actions, rollout, -1)
    bonus = BPTTLoss(make_actor(env64, return_log_prob=True), alpha=0.1)
    refuses("leaves out its entropy bonus: set alpha to 0", bonus.better_actions, rollout, error=NotImplementedError)
    refuses("loss_fit reads 'action_target', which is not", ahac.loss_fit, rollout)
    towards = ahac.loss_fit(rollout.detach().set("action_target", target))
    masked = rollout.detach().set("action_target", target.clone()).set(("collector", "mask"), torch.ones(4, 5).bool())
    masked["collector", "mask"][:, 3], masked["action_target"][:, 3] = False, torch.nan
    grads = torch.autograd.grad(ahac.loss_fit(masked), list(actor.parameters()), allow_unused=True)
    assert all(x.isfinite().all() for x in grads if x is not None)
    for pair in ((pods.loss_actor(by_pods)[0], bptt.loss_actor(rollout)[0]), (towards, ahac.loss_actor(rollout)[0])):
        grads = (torch.autograd.grad(loss, list(actor.parameters()), allow_unused=True) for loss in pair)
        flat = [torch.cat([x.flatten() for x in grad if x is not None]) for grad in grads]
        torch.testing.assert_close(flat[0] / flat[0].norm(), flat[1] / flat[1].norm())
    compiled = HoveringEnv(num_envs=2, compile={"backend": "eager"})
    other = make_actor(compiled)
    flown, _ = differentiable_rollout(compiled, other, None, 3)
    why = "differentiates twice, and a compiled flight only once: call env.eager"
    refuses(why, PODSLoss(other, order=2), flown, error=NotImplementedError)


# -- AHAC --------------------------------------------------------------------------------------------------------------


def make_ahac(**options):
    env = HoveringEnv(num_envs=1)
    return AHACLoss(make_actor(env), make_value(env), **options)


def test_the_horizon_gets_shorter_where_the_dynamics_are_stiff_and_longer_where_they_are_not():
    loss = make_ahac(horizon=32, max_stiffness=2.0, horizon_lr=0.1)
    loss.adapt_horizon(torch.tensor(3.0))  # half too much; a fifth of the multiplier is new
    assert loss.multiplier.item() == pytest.approx(0.2 * 0.5)
    assert loss.length.item() == pytest.approx(32 * math.exp(-0.1 * 0.1))
    loss.adapt_horizon(torch.tensor(torch.inf))  # counts as twice the bound
    assert loss.multiplier.item() == pytest.approx(0.8 * 0.1 + 0.2 * 1.0)
    before = loss.length.clone(), loss.multiplier.clone()
    loss.adapt_horizon(torch.tensor(torch.nan))
    assert (loss.length, loss.multiplier) == before
    for stiffness, horizon in ((9.0, 8), (1.0, 64)):
        for _ in range(60):
            loss.adapt_horizon(torch.tensor(stiffness))
        assert loss.horizon == horizon
    again = make_ahac(horizon=32)
    again.load_state_dict(loss.state_dict())
    assert again.horizon == 64 and again.multiplier == loss.multiplier
    for _ in range(200):
        again.adapt_horizon((0.04 * again.length).float())  # a stiffness of 2 at 50 steps
    assert again.length.item() == pytest.approx(50, rel=1e-3)


def test_where_the_shortest_horizon_is_too_stiff_the_actor_learns_slower_instead():
    loss = make_ahac(horizon=32, min_horizon=16, horizon_lr=0.1, min_lr_factor=0.25)
    found = []
    for stiffness in (*[9.0] * 40, *[1.0] * 80):
        loss.adapt_horizon(torch.tensor(stiffness))
        found.append((loss.horizon, loss.lr_factor))
    falls, rises = found[:40], found[40:]
    assert falls[-1] == (16, 0.25) and falls == sorted(falls, reverse=True) and rises[-1] == (64, 1.0)
    between = [factor for horizon, factor in found if 0.25 < factor < 1.0]
    assert len(between) > 10 and all(horizon == 16 for horizon, factor in found if factor < 1.0)
    assert all(factor == 1.0 for horizon, factor in found if horizon > 16)
    again = make_ahac(horizon=32, min_horizon=16, min_lr_factor=0.25)
    loss.length.fill_(8.0)
    again.load_state_dict(loss.state_dict())
    assert (again.horizon, again.lr_factor) == (16, 0.5)


def test_the_stiffness_is_the_root_mean_square_of_the_action_gradients_in_medians():
    loss = make_ahac()
    grad = torch.tensor([[3.0, 4.0], [0.0, 5.0], [0.0, 0.0], [0.0, 25.0]]).view(2, 2, 2)
    _, measured = loss._measure(grad)  # lengths 5, 5, 25, and one that counts nothing
    assert measured["stiffness"].item() == pytest.approx(math.sqrt((25 + 25 + 625) / 3) / 5)
    assert loss._measure(0.0 * grad)[1]["stiffness"].isnan()
    grad[0, 0, 0] = torch.nan  # nothing is stiffer than this
    assert make_ahac(clip_action_gradient=2.0)._measure(grad)[1]["stiffness"] == torch.inf


def test_ahac_learns_what_shac_does_from_the_least_of_its_critics(env64):
    env, actor = env64, make_actor(env64)
    ahac, shac = AHACLoss(actor, make_value(env)), SHACLoss(actor, make_value(env), num_value_nets=2, delay_value=False)
    shac.value_network_params.data.copy_(ahac.value_network_params.data)
    rollout, _ = differentiable_rollout(env, actor, None, 5)
    out, expected = ahac(rollout), shac(rollout)
    assert out["stiffness"] > 1 and set(out.keys()) == set(ahac.out_keys) == {*shac.out_keys, "stiffness"}
    assert all(torch.equal(out[key], expected[key]) for key in shac.out_keys)
    grads = [torch.autograd.grad(x["loss_actor"], list(actor.parameters())) for x in (out, expected)]
    torch.testing.assert_close(*grads)
    with torch.no_grad():
        assert ahac.loss_actor(rollout)[1]["stiffness"].isnan()


# -- ABPT --------------------------------------------------------------------------------------------------------------


def test_the_simulated_start_of_abpt_is_the_return_of_its_first_steps_and_the_value_after_them():
    actor, *_ = make_networks()

    def start(steps):
        loss = make_abpt(actor, 10.0, 20.0, reduction="none", n_step_return=False, simulated_steps=steps)
        return loss.objective_parts(make_rollout(actor))["zero_step_return"].tolist()

    # V(s) = 12 s, rewards 2, 4, 6, 8. Environment 0 has segments of steps 0, 1 and 2, 3; next states are 2, 9, 4, 5.
    assert start(1)[0] == (2 + 24 / 2) + (6 + 48 / 2)
    # Environment 1 has steps 0 to 2, the last of which terminates, and 3, which the end of the horizon cuts.
    assert start(1)[1] == (2 + 24 / 2) + (8 + 60 / 2)
    assert start(2) == [(2 + 4 / 2 + 108 / 4) + (6 + 8 / 2 + 60 / 4), (2 + 4 / 2 + 36 / 4) + (8 + 60 / 2)]
    assert start(3)[1] == (2 + 4 / 2 + 6 / 4) + (8 + 60 / 2)
    whole = make_abpt(actor, 10.0, 20.0, reduction="none", zero_step_return=False)
    assert start(4) == start(9) == whole.objective_parts(make_rollout(actor))["n_step_return"].tolist()


def test_the_simulated_start_has_the_gradient_of_the_simulator_once_an_action_has_had_its_effect():
    env = HoveringEnv(num_envs=4, dtype=torch.float64, action_delay=1)
    actor = make_actor(env)
    rollout, _ = differentiable_rollout(env, actor, None, 4)
    for steps, moves in ((1, False), (2, True), (4, True)):
        loss = ABPTLoss(actor, make_qvalue(env), n_step_return=False, simulated_steps=steps)
        loss.qvalue_network_params.data.zero_()  # critics that know nothing
        (objective,) = loss.objective_parts(rollout).values()
        expected = sum(0.99**t * rollout["next", "reward"][:, t, 0] for t in range(steps))
        torch.testing.assert_close(objective, expected)
        grads = torch.autograd.grad(objective.sum(), list(actor.parameters()), retain_graph=True)
        assert any(g.abs().max() > 1e-12 for g in grads) == moves


HYBRID = {"gamma": 0.9, "lmbda": 0.8}


@pytest.fixture
def env():
    """Its episodes end inside a horizon."""
    return HoveringEnv(num_envs=8, dtype=torch.float64, max_episode_steps=6)


def make_loss(env, correlation=0.0, learn_scale=True, **options):
    torch.manual_seed(0)
    actor, value = make_actor(env, noise_correlation=correlation, learn_scale=learn_scale), make_value(env)
    return HybridLoss(actor, value, **options).make_value_estimator(**HYBRID)


def flight(env, loss, steps=9):
    return differentiable_rollout(anew(env), loss.actor_network, None, steps)[0]


def gradient(loss, value):
    parameters = [x for x in loss.actor_network_params.parameters() if x.requires_grad]
    return torch.cat([g.flatten() for g in torch.autograd.grad(value, parameters)])


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_the_gradient_of_a_mean_is_that_of_its_own_return(env, correlation):
    """Finite differences: one innovation of one flight is pushed, and the lambda-return that starts there changes."""
    loss = make_loss(env, correlation, gradient_lmbda=HYBRID["lmbda"], clip_action_gradient=None)
    data = loss.write_targets(flight(env, loss))
    weight, deviation = loss.pathwise_weight.clamp(0, 1), (data["value_target"] - value_of(loss, data)).std()
    push, drone, step = 1e-5, 1, 1

    def with_push(size):
        """The flight with an action that is moved before the tanh; noise that is correlated goes on from there."""

        def move(td):
            td["action"][drone, 2] = (torch.atanh(td["action"][drone, 2]) + size).tanh()
            if correlation:
                noise_scale = td["scale"][drone, 2] / (1 - correlation**2) ** 0.5
                td["noise"][drone, 2] += size / noise_scale

        with torch.no_grad():
            flown = pushed(env, loss.actor_network, step, move)
            return loss.write_value_target(flown)["value_target"][drone, step, 0]

    numeric = (with_push(push) - with_push(-push)) / (2 * push)
    found = data["location_gradient"][drone, step, 2] * deviation / weight
    torch.testing.assert_close(found, numeric, rtol=1e-5, atol=1e-9)


def value_of(loss, data):
    with torch.no_grad():
        return loss.value_network(data.copy())["state_value"]


def test_the_loss_is_the_surrogate_of_the_rest_and_the_pathwise_term(env):
    loss = make_loss(env)
    data = loss.write_targets(flight(env, loss))
    pathwise = loss.pathwise_weight.clamp(0, 1)
    assert not data["advantage"].requires_grad
    losses = loss(data)
    assert set(losses.keys()) == set(loss.out_keys)
    # At the policy that flew, the gradient of the ratio is that of the log-probability.
    actor = loss.actor_network
    with loss.actor_network_params.to_module(actor):
        parameters = actor.get_dist_params(data.select("observation"))
    loc, scale = parameters["loc"], parameters["scale"]
    log_prob = Normal(loc, scale).log_prob(data["latent"]).sum(-1, keepdim=True)
    by_hand = -(log_prob * data["advantage"]).mean() - (data["location_gradient"] * loc).sum(-1).mean()
    torch.testing.assert_close(gradient(loss, losses["loss_actor"]), gradient(loss, by_hand))
    torch.testing.assert_close(losses["loss_actor"], -data["advantage"].mean())
    assert losses["kl"] == 0
    # The rest of the advantage and what the derivative predicts add up to the advantage itself.
    predicted = (data["location_gradient"] * (data["latent"] - data["loc"])).sum(-1, keepdim=True)
    whole = data["advantage"] + predicted - predicted.mean()
    advantage = data["value_target"] - value_of(loss, data)
    torch.testing.assert_close(whole, (advantage - advantage.mean()) / advantage.std())
    x, y = (z - z.mean(0) for z in (predicted / pathwise, whole))  # in each step of the horizon
    slope = (x * y).mean() / x.square().mean()
    torch.testing.assert_close(slope, loss.pathwise_weight)
    loss(data.flatten()[:5])["loss_value"].backward()


def test_the_entropy_is_that_of_the_tanh_normal(env):
    without, loss = make_loss(env), make_loss(env, entropy_coeff=0.1)
    data = loss.write_targets(flight(env, loss))
    torch.manual_seed(1)
    losses = loss(data)
    torch.manual_seed(1)
    parameters = plain_of(loss.actor_network, data).distribution(data)
    slope = 1.0 - TanhNormal(*parameters).rsample().square()  # of the tanh
    entropy = (Normal(*parameters).entropy() + slope.log()).sum(-1)
    assert set(losses.keys()) == set(loss.out_keys)
    torch.testing.assert_close(losses["entropy"], entropy.mean().detach())
    without.pathwise_weight.copy_(loss.pathwise_weight)
    by_hand = without(data)["loss_actor"] - 0.1 * entropy.mean()
    torch.testing.assert_close(losses["loss_actor"], by_hand.detach())
    both = gradient(without, without(data)["loss_actor"]) - 0.1 * gradient(loss, entropy.mean())
    torch.testing.assert_close(gradient(loss, losses["loss_actor"]), both)


def test_the_weight_tells_a_true_derivative_from_none(env):
    """A reward that is a smooth function of actions, and one that jumps against what its derivative says."""
    losses = [make_loss(env, learn_scale=False) for _ in range(2)]
    many, carry = HoveringEnv(num_envs=128, dtype=torch.float64), None
    for _ in range(10):
        rollout, carry = differentiable_rollout(many, losses[0].actor_network, carry, 2)
        push = rollout["action"].atanh()[..., :1] - rollout["loc"][..., :1].detach()
        for loss, reward in zip(losses, (push, -1.0 * (push > 0) + 0.1 * push), strict=True):
            data = loss.write_targets(rollout.copy().set(("next", "reward"), reward))
    smooth, jumps = losses
    assert 0.9 < smooth.pathwise_weight < 1.1
    assert jumps.pathwise_weight < 0 and not data["location_gradient"].any()


def test_a_single_flight_is_regressed_over_its_steps_and_weights_are_running_means_that_a_checkpoint_keeps(env):
    single = HoveringEnv(num_envs=1, dtype=torch.float64)
    loss = make_loss(single)
    data = loss.write_targets(flight(single, loss, 16))
    assert loss.pathwise_weight != 0 and data["location_gradient"].isfinite().all()
    loss = make_loss(env, decay=0.5)
    rollout = flight(env, loss)
    loss.write_targets(rollout)
    first = loss.pathwise_weight.clone()
    loss.clip.median.zero_()
    loss.write_targets(rollout)
    torch.testing.assert_close(loss.pathwise_weight, first)
    other = make_loss(env)
    other.load_state_dict(loss.state_dict())
    torch.testing.assert_close(other.pathwise_weight, first)


def test_errors(env):
    loss = make_loss(env)
    rollout = flight(env, loss)
    refuses("carries no gradient", loss.write_targets, rollout.detach(), error=RuntimeError)
    with torch.no_grad(), pytest.raises(RuntimeError, match="with gradients enabled"):
        loss.write_targets(rollout)
    # A crash that leaves numbers that are not finite has no value, and no gradient.
    broken = rollout.clone(recurse=True)
    broken["next", "terminated"][2, 4] = broken["next", "done"][2, 4] = True
    broken["next", "observation"] = torch.where(broken["next", "terminated"], torch.nan, broken["next", "observation"])
    data = loss.write_targets(rollout.copy().update({"next": broken["next"]}))
    assert data["location_gradient"].isfinite().all() and loss.pathwise_weight.isfinite()
    short = make_loss(env, gradient_lmbda=1e-61).make_value_estimator(**HYBRID)
    refuses("too small for a horizon of 6 steps.* Fly fewer, or raise", short.write_targets, flight(env, short, 6))
    short.write_targets(flight(env, short, 5))
    refuses("TD0", short.make_value_estimator, ValueEstimators.TD0, error=NotImplementedError, gamma=0.9)
    read = loss.write_targets(rollout.select(*loss.in_keys))
    assert loss(read)["loss_actor"].isfinite()
    refuses("reads 'latent', which write_targets writes and these samples have lost", loss, read.exclude("latent"))
    pickle.dumps(loss)
