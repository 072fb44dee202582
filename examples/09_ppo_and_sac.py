"""The tasks are ordinary TorchRL environments: TorchRL's own PPO and SAC learn on them, with a Collector."""

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import ClipPPOLoss, SACLoss, SoftUpdate
from torchrl.objectives.value import GAE

from torchrl_quad import HoveringEnv, make_actor, make_qvalue, make_value

ITERATIONS = 40
OPTIONS = {"auto_register_policy_transforms": True}  # TorchRL's default from 0.15 on


def ppo(env, actor):
    """On-policy: train a few epochs on each batch, then throw it away."""
    value = make_value(env)
    loss = ClipPPOLoss(actor, value, entropy_bonus=False)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=value, vectorized=False)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    for data in Collector(env, actor, frames_per_batch=4096, total_frames=4096 * ITERATIONS, **OPTIONS):
        for batch in 5 * advantage(data).reshape(-1)[torch.randperm(4096)].split(1024):
            minimise(optimizer, loss(batch))


def sac(env, actor):
    """Off-policy: keep every step, and learn from it many times."""
    loss = SACLoss(actor, make_qvalue(env), action_spec=env.action_spec_unbatched, alpha_init=1e-3, fixed_alpha=True)
    target = SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=256)
    for data in Collector(env, actor, frames_per_batch=2048, total_frames=2048 * ITERATIONS, **OPTIONS):
        buffer.extend(data.reshape(-1))
        for _ in range(48):
            minimise(optimizer, loss(buffer.sample()))
            target.step()


def minimise(optimizer, losses):
    """Take one step of the optimiser on the sum of all entries called loss."""
    optimizer.zero_grad()
    sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
    optimizer.step()


def mean_return(env, actor):
    """The return of an episode of the actor's mode, averaged over drones; 25.6 at most."""
    with torch.no_grad():
        flight = env.rollout(256, actor, break_when_any_done=False)
    return env.episode_metrics(flight)["return"].mean()


for learn in (ppo, sac):
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=128)
    actor = make_actor(env, action_init=torch.zeros(4), scale_init=0.3, return_log_prob=True)  # knows no hovering
    print(f"{learn.__name__}: mean return {mean_return(env, actor):.2f} before")
    learn(env, actor)
    print(f"{learn.__name__}: mean return {mean_return(env, actor):.2f} after")
