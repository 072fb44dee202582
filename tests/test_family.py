"""SAPO, AHAC, and ABPT with a simulated start, against numbers worked by hand and finite differences."""

import math

import pytest
import torch
from test_objectives import GAMMA, LAMBDA, REWARDS, make_abpt, make_networks, make_rollout, td_lambda

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, AHACLoss, SAPOLoss, SHACLoss

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
    expected = [
        td_lambda(soft, [20, 90, 40, 50], [False, True, False, True], [False] * 4),
        td_lambda(soft, [20, 30, 90, 50], [False, False, True, True], [False, False, True, False]),
    ]
    torch.testing.assert_close(target[..., 0], torch.tensor(expected))
    assert rollout["next", "reward"][0, :, 0].tolist() == [2, 4, 6, 8]  # left as they were
    # They have no target networks: what they learn of is what they say now.
    loss.value_network_params["module", "weight"].data.add_(1.0)
    assert not torch.equal(loss.write_value_target(rollout.detach())["value_target"], target)


def test_the_target_entropy_of_sapo_is_minus_half_the_size_of_the_action():
    loss, rollout = make_sapo(10.0, alpha="auto", target_entropy="auto")
    assert loss._target_entropy(rollout) == -0.5
    assert loss._normalized_entropy(rollout)[0, :, 0].tolist() == [x + 0.5 for x in ENTROPY]  # (h + 1/2) / (2 / 2)
    loss_alpha = loss.loss_actor(rollout)[1]["loss_alpha"]
    loss_alpha.backward()
    assert loss.alpha == 1.0 and loss.log_alpha.grad == 0.5  # the mean entropy of 0 is too high: alpha falls


@pytest.mark.parametrize("clip", [None, 1e9])
def test_the_gradient_of_sapo_is_that_of_finite_differences(env64, clip):
    env, actor = env64, make_actor(env64, (8,), return_log_prob=True)
    loss = SAPOLoss(actor, make_value(env, (8,)), alpha=0.1, clip_action_gradient=clip)
    weight = actor[0].module.mlp[-1].bias  # of means and scales

    def value():
        env.set_seed(0)
        torch.manual_seed(0)
        return loss.loss_actor(differentiable_rollout(env, actor, None, 5)[0])[0]

    (grad,) = torch.autograd.grad(value(), weight)
    for entry in (1, 5):  # clipped, the entropy counts at fixed states: only a later one could have another gradient
        ends = []
        for step in (1e-6, -2e-6):
            weight.data[entry] += step
            ends.append(value().item())
        weight.data[entry] += 1e-6
        numeric = (ends[0] - ends[1]) / 2e-6
        assert grad[entry].item() == pytest.approx(numeric, rel=1e-6 if clip is None else 2e-2, abs=1e-8)


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


def test_a_clip_that_never_clips_leaves_the_gradient_of_the_simulated_start():
    env = HoveringEnv(num_envs=4, dtype=torch.float64)
    actor = make_actor(env, scale_init=1e-4)  # actions that are sampled anew are the same
    rollout, _ = differentiable_rollout(env, actor, None, 6)
    found = []
    for clip in (None, 1e9):
        torch.manual_seed(0)  # the critics, and the actions that are sampled anew
        loss = ABPTLoss(actor, make_qvalue(env), simulated_steps=2, clip_action_gradient=clip)
        value = loss.loss_actor(rollout)[0]
        grads = torch.autograd.grad(value, list(actor.parameters()), retain_graph=True)
        found.append(torch.cat([g.flatten() for g in grads]))
    assert (found[0] - found[1]).norm() < 2e-3 * found[0].norm()
