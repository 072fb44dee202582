"""The building blocks of a recipe: targets that follow, learning rates, and minibatches."""

import pytest
import torch
from omegaconf import OmegaConf
from refusals import cases
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_quad import ABPTLoss, BPTTLoss, HoveringEnv, SHACLoss, make_actor, make_qvalue, make_value
from torchrl_quad.training.building import (
    AdaptiveOptimizer,
    Optimizer,
    TargetUpdate,
    minibatches,
    parameter_groups,
    shuffled,
)
from torchrl_quad.training.loop import backward


def optimizer(iterations, kind=Optimizer, **options):
    """Of a network with one parameter, in a run of so many iterations."""
    section = {"lr": 1e-2, "final_lr": 1e-4, "betas": [0.9, 0.99], "schedule": "linear", "max_grad_norm": 1.0}
    run = {"num_envs": 2, "horizon": 3, "total_steps": 6 * iterations, "actor": section | options}
    return kind(OmegaConf.create(run), "actor", torch.nn.Linear(1, 1, bias=False))


def numbered(*shape):
    """A rollout that numbers its steps."""
    return TensorDict({"step": torch.arange(torch.Size(shape).numel()).view(shape)}, shape)


@pytest.mark.parametrize(("kind", "critic"), [(SHACLoss, make_value), (ABPTLoss, make_qvalue)])
def test_a_target_critic_follows_as_with_torchrl_s_soft_update(kind, critic):
    env = HoveringEnv(num_envs=1)
    targets = []
    for update in (TargetUpdate, SoftUpdate):
        torch.manual_seed(0)
        loss = kind(make_actor(env), critic(env))
        updater = update(loss, tau=0.1)
        getattr(loss, f"{loss.critic_name}_params").data.apply_(lambda parameter: parameter.add_(1.0))
        updater.step()
        targets.append(getattr(loss, f"target_{loss.critic_name}_params").data.clone())
    own, torchrl = (dict(target.items(True, True)) for target in targets)
    assert len(own) > 3
    torch.testing.assert_close(own, torchrl)


@cases(("constant", 1e-2, 1e-2), ("linear", 5.05e-3, 1e-4), ("exponential", 1e-3, 1e-4), ("cosine", 5.05e-3, 1e-4))
def test_a_schedule_goes_from_the_first_to_the_last_learning_rate(schedule, halfway, last):
    adam = optimizer(100, schedule=schedule)
    for iteration, rate in ((0, 1e-2), (49.5, halfway), (99, last), (200, last)):
        adam.anneal(iteration)
        assert adam.param_groups[0]["lr"] == pytest.approx(rate)


def test_the_gradient_of_alpha_takes_nothing_of_the_actor_s_norm():
    loss = BPTTLoss(make_actor(HoveringEnv(num_envs=1), return_log_prob=True), alpha="auto")
    actor = list(loss.actor_network_params.parameters())
    objective = sum(x.sum() for x in actor) + 1e6 * loss.log_alpha
    _, norm = backward(objective, torch.optim.Adam(parameter_groups("actor", loss)), 0.5)
    gradient = torch.cat([x.grad.flatten() for x in actor])
    assert norm.item() == pytest.approx(gradient.numel() ** 0.5, rel=1e-4)
    assert gradient.norm().item() == pytest.approx(0.5, rel=1e-4)
    assert loss.log_alpha.grad.item() == pytest.approx(0.5, rel=1e-4)


@pytest.mark.parametrize(("iteration", "limit"), [(0, 0.3), (5, 0.15), (9, 0.03), (10, 0.006)])
def test_how_far_a_horizon_may_move_the_policy_falls_to_a_fiftieth(iteration, limit):
    adam = optimizer(10, AdaptiveOptimizer, max_kl=0.2)
    adam.anneal(iteration)
    assert adam.limit == pytest.approx(limit)


@pytest.mark.parametrize(("moved", "factor", "end"), [(0.31, 1 / 1.5, 1e-6), (0.2, 1.0, 1e-3), (0.13, 1.5, 0.02)])
def test_the_rate_adapts_to_how_far_the_policy_was_moved_within_its_bounds(moved, factor, end):
    adam = optimizer(10, AdaptiveOptimizer, max_kl=0.2, lr=1e-3)
    adam.anneal(0)
    adam.adapt(moved)
    assert adam.param_groups[0]["lr"] == pytest.approx(1e-3 * factor)
    for _ in range(60):
        adam.adapt(moved)
    assert adam.param_groups[0]["lr"] == pytest.approx(end)
    with pytest.raises(ValueError, match="actor.max_kl=null: this recipe sets its rate by it. Write a number"):
        optimizer(10, AdaptiveOptimizer, max_kl=None)


def test_minibatches_are_random_steps_of_the_rollout():
    cfg = OmegaConf.create({"updates": 3, "batch_size": 50})
    batches = [batch["step"] for batch in minibatches(numbered(3, 4), cfg)]
    assert [batch.shape for batch in batches] == [(50,)] * 3
    assert set(torch.cat(batches).tolist()) == set(range(12)) and not torch.equal(batches[0], batches[1])


def test_shuffled_batches_hold_every_step_once_in_each_epoch():
    batches = [batch["step"] for batch in shuffled(numbered(3, 4), 5, 2)]
    assert [len(batch) for batch in batches] == [5, 5, 2, 5, 5, 2]
    epochs = [torch.cat(batches[:3]).tolist(), torch.cat(batches[3:]).tolist()]
    assert epochs[0] != epochs[1] and [sorted(epoch) for epoch in epochs] == [list(range(12))] * 2


def test_the_horizons_of_a_policy_with_a_memory_stay_whole():
    rollout = numbered(3, 4)
    rollout["is_init"] = torch.zeros(3, 4, 1, dtype=torch.bool)
    batches = [batch["step"] for batch in shuffled(rollout, 8, 2)]
    assert [batch.shape for batch in batches] == [(2, 4), (1, 4)] * 2
    for epoch in (batches[:2], batches[2:]):
        assert sorted(torch.cat(epoch).tolist()) == rollout["step"].tolist()
    assert [batch.shape for batch in shuffled(rollout, 3, 1)] == [(1, 4)] * 3
