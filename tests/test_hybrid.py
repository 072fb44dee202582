"""The hybrid loss: its two gradients, and the weights that a rollout gives them."""

import pickle

import pytest
import torch
from refusals import refuses
from torch.distributions import Normal
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal
from torchrl.objectives import ValueEstimators

from torchrl_quad import HoveringEnv, HybridLoss, differentiable_rollout, make_actor, make_value
from torchrl_quad.objectives.calls import distribution_again

GAMMA, LAMBDA = 0.9, 0.8


@pytest.fixture
def env():
    """Its episodes end inside a horizon."""
    return HoveringEnv(num_envs=8, dtype=torch.float64, max_episode_steps=6)


def make_loss(env, correlation=0.0, learn_scale=True, **options):
    torch.manual_seed(0)
    actor, value = make_actor(env, noise_correlation=correlation, learn_scale=learn_scale), make_value(env)
    return HybridLoss(actor, value, **options).make_value_estimator(gamma=GAMMA, lmbda=LAMBDA)


def flight(env, loss, steps=9):
    env.set_seed(0)
    torch.manual_seed(0)
    return differentiable_rollout(env, loss.actor_network, None, steps)[0]


def gradient(loss, value):
    parameters = [x for x in loss.actor_network_params.parameters() if x.requires_grad]
    return torch.cat([g.flatten() for g in torch.autograd.grad(value, parameters)])


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_the_gradient_of_a_mean_is_that_of_its_own_return(env, correlation):
    """Finite differences: one innovation of one flight is pushed, and the lambda-return that starts there changes."""
    loss = make_loss(env, correlation, gradient_lmbda=LAMBDA, clip_action_gradient=None)
    rollout = flight(env, loss)
    data = loss.write_targets(rollout)
    weight, deviation = loss.pathwise_weight.clamp(0, 1), (data["value_target"] - value_of(loss, data)).std()
    push, drone, step = 1e-5, 1, 1

    def with_push(size):
        """The flight with an action that is moved before the tanh; noise that is correlated goes on from there."""
        env.set_seed(0)
        torch.manual_seed(0)
        count = iter(range(100))

        def pushed(td):
            td = loss.actor_network(td)
            if next(count) == step:
                td["action"][drone, 2] = (torch.atanh(td["action"][drone, 2]) + size).tanh()
                if correlation:
                    noise_scale = td["scale"][drone, 2] / (1 - correlation**2) ** 0.5
                    td["noise"][drone, 2] += size / noise_scale
            return td

        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            flown = EnvBase.rollout(env, 9, pushed, auto_cast_to_device=False, break_when_any_done=False)
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
    parameters = distribution_again(loss.actor_network, loss.actor_network_params, data)
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


def test_a_single_flight_is_regressed_over_its_steps():
    env = HoveringEnv(num_envs=1, dtype=torch.float64)
    loss = make_loss(env)
    data = loss.write_targets(flight(env, loss, 16))
    assert loss.pathwise_weight != 0 and data["location_gradient"].isfinite().all()


def test_weights_are_running_means_that_a_checkpoint_keeps(env):
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
    short = make_loss(env, gradient_lmbda=1e-61).make_value_estimator(gamma=GAMMA, lmbda=LAMBDA)
    refuses("too small for a horizon of 6 steps.* Fly fewer, or raise", short.write_targets, flight(env, short, 6))
    short.write_targets(flight(env, short, 5))
    refuses("TD0", short.make_value_estimator, ValueEstimators.TD0, error=NotImplementedError, gamma=GAMMA)
    read = loss.write_targets(rollout.select(*loss.in_keys))
    assert loss(read)["loss_actor"].isfinite()
    refuses("reads 'latent', which write_targets writes and these samples have lost", loss, read.exclude("latent"))
    pickle.dumps(loss)
