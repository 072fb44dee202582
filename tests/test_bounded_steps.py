"""Bounds on what a policy learns from: the gradient of each action, and the length of an update."""

import copy

import pytest
import torch
from helpers import anew, cases, pushed, refuses
from tensordict import nn as of_td
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Normal
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, SHACLoss, TrustRegion
from torchrl_quad.objectives.calls import MedianClip, action_gradient, sources_of_steps

LOSSES = {
    "bptt": lambda env, actor, **options: BPTTLoss(actor, **options),
    "shac": lambda env, actor, **options: SHACLoss(actor, make_value(env), **options),
    "abpt": lambda env, actor, **options: ABPTLoss(actor, make_qvalue(env), **options),
    "simulated": lambda env, actor, **options: ABPTLoss(actor, make_qvalue(env), simulated_steps=2, **options),
}
FAR = 1e9  # medians: so long is no gradient


@pytest.fixture
def env():
    """Its episodes end inside a horizon."""
    return HoveringEnv(num_envs=4, dtype=torch.float64, max_episode_steps=6)


def flight(env, actor, steps=9):
    return differentiable_rollout(anew(env), actor, None, steps)[0]


def gradient(loss, rollout):
    torch.manual_seed(1)
    value = loss.loss_actor(rollout)[0]
    return value, torch.autograd.grad(value, [x for x in loss.actor_network_params.parameters() if x.requires_grad])


@pytest.mark.parametrize("name", LOSSES)
def test_a_clip_that_never_clips_changes_no_gradient(env, name):
    samples_anew = name in ("abpt", "simulated")  # the actions after its last states: the same where there is no noise
    actor = make_actor(env, scale_init=1e-4 if samples_anew else 0.1)
    clipped, plain, shorter = (LOSSES[name](env, actor, clip_action_gradient=clip) for clip in (FAR, None, 1.0))
    clipped.load_state_dict({**clipped.state_dict(), **plain.state_dict()})
    shorter.load_state_dict(clipped.state_dict())
    rollout = flight(env, actor)
    _, shortened = gradient(shorter, rollout)
    assert shorter.loss_actor(rollout)[1]["clipped"] > 0 == clipped.loss_actor(rollout)[1]["clipped"]
    (value, found), (expected_value, expected) = gradient(clipped, rollout), gradient(plain, rollout)
    torch.testing.assert_close(value, expected_value)
    assert not all(map(torch.allclose, shortened, found))
    if samples_anew:
        a, b = (torch.cat([g.flatten() for g in x]) for x in (found, expected))
        assert (a - b).norm() < 2e-3 * b.norm()
    else:
        torch.testing.assert_close(found, expected)


def test_the_gradient_of_an_action_is_that_of_all_that_follows_in_torchrls_loop_too(env):
    actor = make_actor(env)
    weight = torch.linspace(0.5, 1.5, 9, dtype=env.dtype).view(1, 9, 1)

    def objective(rollout):
        return (weight * rollout["next", "reward"]).sum() + rollout["loc"].square().sum()

    rollout = flight(env, actor)
    found = action_gradient(objective(rollout), rollout["action"])
    again = torch.autograd.grad(objective(rollout), list(actor.parameters()))  # the graph is still whole
    assert all(g.isfinite().all() for g in again)

    with set_exploration_type(ExplorationType.RANDOM):
        slow = EnvBase.rollout(anew(env), 9, actor, break_when_any_done=False)
    torch.testing.assert_close(action_gradient(objective(slow), slow["action"]), found)

    def with_push(size):
        """The objective where one action is pushed."""
        with torch.no_grad():
            return objective(pushed(env, actor, 2, lambda td: td["action"][1, 2].add_(size)))

    numeric = (with_push(1e-5) - with_push(-1e-5)) / 2e-5
    torch.testing.assert_close(found[1, 2, 2], numeric, rtol=1e-6, atol=1e-9)


def test_the_sources_of_an_entry_are_its_steps_whatever_their_shape_but_for_those_without_a_graph():
    images = [torch.full((4, 2, 3), 1.0 + t, requires_grad=t > 0) for t in range(3)]
    (first, second) = sources_of_steps(torch.stack(images, 1))
    total = sum((1.0 + t) * image.sum() for t, image in enumerate(images))
    grads = torch.autograd.grad(total, [first, second])
    assert [g.unique().tolist() for g in grads] == [[2.0], [3.0]] and grads[0].shape == (4, 2, 3)
    assert sources_of_steps(images[1]) is None and sources_of_steps(torch.stack(images, 1).clone()) is None
    # A step without a graph; another order.
    for of_steps in (torch.stack([x[:, 0] for x in images], 1), torch.stack([x[:, 0] for x in images[1:]])):
        refuses("this one was copied, reshaped or cut", action_gradient, total, of_steps)


def test_a_long_gradient_is_shortened_to_so_many_medians():
    clip = MedianClip(2.0, decay=0.5)
    grad = torch.tensor([1.0, -1.0, 1.0, 1.0, 30.0, 0.0]).view(2, 3, 1)
    shorter, fraction = clip(grad)
    assert shorter.flatten().tolist() == [1.0, -1.0, 1.0, 1.0, 2.0, 0.0]
    assert fraction == pytest.approx(1 / 5)  # of those that are not zero
    broken, fraction = clip(torch.tensor([[torch.inf, 1.0], [torch.nan, 1.0], [0.0, 1.0]]))
    assert broken.tolist() == [[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]]
    assert fraction == pytest.approx(2 / 3)
    clip.median.fill_(1.0)
    clip(3.0 * grad)
    assert clip.median == 2.0  # half way from 1 to 3
    assert "median" in clip.state_dict()
    clip(torch.zeros(2, 3, 1))
    assert clip.median == 2.0


def test_with_a_clip_the_entropy_bonus_counts_at_the_states_visited(env):
    actor = make_actor(env, return_log_prob=True)
    loss = BPTTLoss(actor, alpha=0.3, clip_action_gradient=FAR)
    rollout = flight(env, actor)
    loss_actor, metadata = loss.loss_actor(rollout)
    torch.testing.assert_close(metadata["entropy"], -rollout["action_log_prob"].mean().detach())
    reward = BPTTLoss(actor, clip_action_gradient=FAR).loss_actor(rollout)[0]
    (scale_grad,) = torch.autograd.grad(reward - loss_actor, actor[0].module.mlp[-1].bias)
    assert (scale_grad[4:] > 0).all()  # more noise, more entropy


def test_what_cannot_be_clipped_is_refused(env):
    actor = make_actor(env)
    for bad in (0.0, float("inf")):
        with pytest.raises(ValueError, match="clip_action_gradient must be .*, got .*in running medians of their"):
            BPTTLoss(actor, clip_action_gradient=bad)
    rollout = flight(env, actor)
    loss = BPTTLoss(actor, clip_action_gradient=5.0)
    for changed in (rollout[:2], torch.stack([flight(env, actor, steps=4) for _ in range(4)])):
        refuses("needs one rollout as differentiable_rollout returned it, whole", loss.loss_actor, changed)
    refuses("BPTTLoss needs .* the rollout has no 'loc'. Build it by", loss.loss_actor, rollout.exclude("loc"))
    with torch.no_grad():
        loss.loss_actor(rollout)


SCALE = of_td.NormalParamExtractor(scale_mapping="biased_softplus_0.1_0.01")  # that of make_actor
WRAPPINGS = {
    "actor": lambda body, head, **how: ProbabilisticActor(TensorDictSequential(body, head), ["loc", "scale"], **how),
    "sequence": lambda body, head, **how: TensorDictSequential(body, ProbabilisticActor(head, ["loc", "scale"], **how)),
    "modules": lambda body, head, **how: of_td.ProbabilisticTensorDictSequential(
        body, head, of_td.ProbabilisticTensorDictModule(["loc", "scale"], ["action"], **how)
    ),
}


def by_hand(actor, wrapping="actor", *more, distribution=TanhNormal, **options):
    """The network of a policy of make_actor, as a user of TorchRL writes a policy; ``more`` stands before the head."""
    *layers, last = copy.deepcopy(actor.last.mlp)
    body = TensorDictModule(nn.Sequential(*layers, *more), ["observation"], ["hidden"])
    head = TensorDictModule(nn.Sequential(last, SCALE), ["hidden"], ["loc", "scale"])
    return WRAPPINGS[wrapping](body, head, distribution_class=distribution, return_log_prob=True, **options)


LEARN = {
    "clip": lambda actor, value: BPTTLoss(actor, alpha=0.1, clip_action_gradient=1.5),
    "ahac": lambda actor, value: AHACLoss(actor, value, alpha=0.1, num_value_nets=1),
    "hybrid": lambda actor, value: HybridLoss(actor, value, entropy_coeff=0.1),
}


@pytest.mark.parametrize("wrapping", WRAPPINGS)
@pytest.mark.parametrize("name", LEARN)
def test_a_policy_of_torchrl_learns_what_the_same_network_of_make_actor_learns(env, name, wrapping):
    actor, value = make_actor(env, return_log_prob=True), make_value(env)
    other = by_hand(actor, wrapping)
    found, expected = (gradient(LEARN[name](policy, value), flight(env, policy)) for policy in (other, actor))
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found[1], expected[1], rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("distribution", [TanhNormal, IndependentNormal])
def test_a_clip_that_never_clips_has_the_gradient_of_finite_differences_for_any_policy(env, distribution):
    bounds = {"low": torch.full((4,), -0.9), "high": torch.full((4,), 0.8)} if distribution is TanhNormal else {}
    policy = by_hand(make_actor(env), distribution=distribution, distribution_kwargs=bounds).to(env.dtype)
    loss = BPTTLoss(policy, clip_action_gradient=FAR)
    _, grads = gradient(loss, flight(env, policy))
    direction = [torch.randn_like(x) for x in loss.actor_network_params.parameters()]

    def moved(size):
        params = list(loss.actor_network_params.parameters())
        with torch.no_grad():
            torch._foreach_add_(params, direction, alpha=size)
            value = loss.loss_actor(flight(env, policy))[0]
            torch._foreach_add_(params, direction, alpha=-size)
        return value

    numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6
    along = sum((a * b).sum() for a, b in zip(grads, direction, strict=True))
    torch.testing.assert_close(along, numeric, rtol=1e-6, atol=1e-8)


class Blurred(nn.Module):
    """Draws in its forward pass, by a function."""

    def forward(self, x):
        return nn.functional.dropout(x, 0.5)


@cases(
    ([nn.Dropout(0.5)], {}, "its layer Dropout .*module.4. draws random numbers.*Call actor.eval"),
    ([Blurred()], {}, "its layer Blurred .*draws random numbers"),
    ([nn.BatchNorm1d(64, dtype=torch.float64)], {}, "its layer BatchNorm1d .*uses the statistics of its batch"),
    ([], {"distribution": Normal}, "TanhNormal or an IndependentNormal; this one has Normal. Build it by make_actor"),
)
def test_a_policy_that_would_not_act_the_same_again_is_refused_by_the_name_of_the_layer(more, options, message, env):
    policy = by_hand(make_actor(env), "actor", *more, **options)
    loss = BPTTLoss(policy, clip_action_gradient=5.0)
    refuses(message, loss.loss_actor, flight(env, policy, steps=3), error=NotImplementedError)
    if more and not isinstance(more[0], Blurred):
        loss.loss_actor(flight(env, policy.eval(), steps=3))


def test_an_update_is_shortened_to_the_bound():
    env = HoveringEnv(num_envs=64)
    actor = make_actor(env)
    rollout = env.rollout(8, actor, break_when_any_done=False)
    trust_region = TrustRegion(actor, max_kl=0.02)

    def update(length):
        before = [x.detach().clone() for x in actor.parameters()]
        torch.manual_seed(0)
        with trust_region.around(rollout), torch.no_grad():
            for x in actor.parameters():
                x += length * torch.randn_like(x)
        moved = torch.cat([(x.detach() - y).flatten() for x, y in zip(actor.parameters(), before, strict=True)])
        kl = trust_region.divergence(rollout)
        with torch.no_grad():
            for x, y in zip(actor.parameters(), before, strict=True):
                x.copy_(y)
        return moved.norm().item(), kl.item(), trust_region.metrics["kl"].item()

    short = update(1e-4)
    assert short[1] == pytest.approx(short[2]) and short[1] < 0.02
    for length in (1e-2, 1.0):
        long = update(length)
        assert long[2] > 0.1 and 0 < long[1] <= 0.02
        assert long[1] > 0.01 or length == 1.0  # no shorter than it must be, where the divergence is still quadratic
    before = [x.detach().clone() for x in actor.parameters()]
    with trust_region.around(rollout), torch.no_grad():
        actor[0].module.mlp[0].weight.fill_(torch.nan)
    assert all(torch.equal(x, y) for x, y in zip(actor.parameters(), before, strict=True))


def test_a_policy_without_noise_may_still_move_and_a_trust_region_knows_what_it_needs():
    env = HoveringEnv(num_envs=64)
    actor = make_actor(env, scale_init=1e-3)
    rollout = env.rollout(8, actor, break_when_any_done=False)
    with torch.no_grad():
        actor[0].module.mlp[-1].bias[0] += 0.01
    found = [TrustRegion(actor, 1.0, min_scale=x).divergence(rollout).item() for x in (0.0, 0.1)]
    assert found == pytest.approx([0.01**2 / (2 * scale**2) for scale in (1e-3, 0.1)], rel=1e-3)
    actor = make_actor(env)
    refuses("min_scale must be at least 0, got -1", TrustRegion, actor, 0.1, min_scale=-1)
    refuses("max_kl must be greater than 0, got 0.0. .* 0.01 to 0.1 are usual", TrustRegion, actor, 0.0)
    free = TrustRegion(actor, None)
    with free.around(env.reset()):
        pass
    assert free.metrics == {}
    around = TrustRegion(actor, 0.1).around(env.reset())
    refuses("reads loc and scale, which are not in the rollout", around.__enter__)  # before the block runs
