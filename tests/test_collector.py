"""Horizons with their graph, in TorchRL's Trainer and in loops written around collectors."""

import pytest
import torch
from small_runs import assert_equal
from torch import nn
from torchrl.checkpoint import Checkpoint
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.trainers import DefaultOptimizationStepper, Trainer, UpdateWeights

from torchrl_quad import BPTTLoss, DifferentiableCollector, HoveringEnv, differentiable_rollout, make_actor

NUM_ENVS, HORIZON = 4, 5
FRAMES = NUM_ENVS * HORIZON


def make(transformed=False, **options):
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=NUM_ENVS, seed=1, wind={"gust": 0.5}, max_episode_steps=7)
    env = TransformedEnv(env, StepCounter()) if transformed else env
    return DifferentiableCollector(env, make_actor(env), frames_per_batch=FRAMES, **options)


@pytest.mark.parametrize("transformed", [False, True])
def test_batches_have_their_graph_and_begin_where_the_one_before_has_ended(transformed):
    collector, same = make(transformed, total_frames=50), make(transformed)
    torch.manual_seed(3)
    batches = list(collector)
    torch.manual_seed(3)
    carry = None
    for batch in batches:
        expected, carry = differentiable_rollout(same.env, same.policy, carry, HORIZON)
        torch.testing.assert_close(batch["next", "reward"], expected["next", "reward"], rtol=0, atol=0)
        assert batch["next", "reward"].requires_grad
    assert not any(x.requires_grad for x in collector.carry.values(True, True))
    assert len(batches) == len(collector) == 3  # the batch that reaches total_frames is the last
    assert batches[1]["next", "done"].any()  # through the ends of episodes


def test_a_share_of_the_environments_begins_each_batch_afresh():
    collector = make(total_frames=2 * FRAMES, restart_fraction=1.0)
    assert [batch["state", "step"][:, 0].sum().item() for batch in collector] == [0, 0]


def test_a_state_dict_goes_on_bit_for_bit_also_through_a_file(tmp_path):
    straight, first, second = make(), make(), make()
    torch.manual_seed(5)
    batches = [straight.next() for _ in range(3)]
    torch.manual_seed(5)
    first.next()
    torch.save(first.state_dict(), tmp_path / "collector.pt")
    with torch.no_grad():
        next(second.policy.parameters()).add_(1.0)
    second.load_state_dict(torch.load(tmp_path / "collector.pt", weights_only=True))
    for batch in batches[1:]:
        assert_equal(batch.detach().to_dict(), second.next().detach().to_dict())


def trainer(collector, folder):
    loss = BPTTLoss(collector.policy).make_value_estimator(gamma=0.99)
    trainer = Trainer(
        collector=collector,
        total_frames=4 * FRAMES,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(collector.policy.parameters(), 1e-2),
        optimization_stepper=DefaultOptimizationStepper(),
        checkpoint=Checkpoint(),
        save_trainer_file=folder,
        progress_bar=False,
        seed=3,
    )
    UpdateWeights(collector).register(trainer)
    return trainer


def test_the_trainer_follows_the_gradient_through_the_dynamics_and_goes_on_from_its_checkpoint(tmp_path):
    straight, stopped = make(total_frames=4 * FRAMES), make(total_frames=2 * FRAMES)
    before = torch.nn.utils.parameters_to_vector(straight.policy.parameters()).clone()
    trainer(straight, tmp_path / "straight").train()
    after = torch.nn.utils.parameters_to_vector(straight.policy.parameters())
    assert (after - before).abs().max() > 1e-2 and straight.env.is_closed

    half = trainer(stopped, tmp_path / "stopped")
    half.train()
    half.save_trainer(force_save=True)
    random = torch.get_rng_state()
    resumed = make(total_frames=4 * FRAMES)
    again = trainer(resumed, tmp_path / "stopped").load_from_file(tmp_path / "stopped")
    torch.set_rng_state(random)
    again.train()
    torch.testing.assert_close(torch.nn.utils.parameters_to_vector(resumed.policy.parameters()), after, rtol=0, atol=0)


def test_weights_are_copied_from_whatever_form_torchrl_hands_over():
    other = make().policy
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.uniform_()
    forms = [{"policy_or_weights": other}, {"policy": other}, {"weights_dict": {"policy": other}}]
    for form in (*forms, {"policy_or_weights": other.state_dict()}):
        collector = make()
        before = [parameter.detach().clone() for parameter in collector.policy.parameters()]
        collector.update_policy_weights_()  # without any there is nothing to do
        assert all(torch.equal(*pair) for pair in zip(collector.policy.parameters(), before, strict=True))
        collector.update_policy_weights_(**form)
        for ours, theirs in zip(collector.policy.parameters(), other.parameters(), strict=True):
            assert torch.equal(ours, theirs) and ours is not theirs


def test_wrong_numbers_are_refused_with_what_to_write_instead():
    env = HoveringEnv(num_envs=NUM_ENVS)
    with pytest.raises(ValueError, match="frames_per_batch=10 must be a multiple of .* 4. Try 8, a horizon of 2"):
        DifferentiableCollector(env, make_actor(env), frames_per_batch=10)
    with pytest.raises(ValueError, match="restart_fraction must be at most 1, got 2"):
        DifferentiableCollector(env, make_actor(env), frames_per_batch=8, restart_fraction=2)
    for no_env in (nn.Linear(3, 4), lambda: None, 3):
        with pytest.raises(TypeError, match="env must be a TorchRL environment, such as make_env.*; got "):
            DifferentiableCollector(no_env, make_actor(env), frames_per_batch=8)
