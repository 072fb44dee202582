"""The environment in TorchRL's own hands."""

import torch
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv, check_env_specs
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_quad import HoveringEnv, make_actor, make_value


def test_a_collector_and_the_ppo_loss_of_torchrl_train_on_it():
    env = TransformedEnv(HoveringEnv(num_envs=4, max_episode_steps=8), Compose(StepCounter(), RewardSum()))
    actor, value = make_actor(env, return_log_prob=True), make_value(env)
    before = [p.clone() for p in actor.parameters()]
    loss = ClipPPOLoss(actor, value, entropy_bonus=False)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    collector = Collector(env, actor, frames_per_batch=40, total_frames=80, auto_register_policy_transforms=True)
    for data in collector:
        assert data.batch_size == (4, 10)
        assert not data["next", "reward"].requires_grad
        GAE(gamma=0.99, lmbda=0.95, value_network=value, vectorized=False)(data)
        out = loss(data)
        optimizer.zero_grad()
        (out["loss_objective"] + out["loss_critic"]).backward()
        optimizer.step()
    collector.shutdown()
    assert any(not torch.equal(p, q) for p, q in zip(actor.parameters(), before, strict=True))


def test_specs_hold_under_transforms():
    check_env_specs(TransformedEnv(HoveringEnv(num_envs=3), Compose(StepCounter(), RewardSum())))
