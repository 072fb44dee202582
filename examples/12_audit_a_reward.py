"""Find the terms of a reward that have a gradient, compare simulator and critic, and see how the variance grows."""

import torch
from torchrl.objectives import SoftUpdate

from torchrl_quad import (
    ABPTLoss,
    RacingEnv,
    audit_reward,
    compare_gradients,
    differentiable_rollout,
    gradient_by_horizon,
    make_actor,
    make_qvalue,
)

ITERATIONS = 50

torch.manual_seed(0)
env = RacingEnv(num_envs=16, reward="velocity")
actor = make_actor(env)
loss = ABPTLoss(actor, make_qvalue(env))
loss.make_value_estimator(gamma=0.99, lmbda=0.95)


def before_the_gates():
    """Start up to 1 m before the gates at 2 m/s towards them: such drones earn every term of the reward."""
    td = env.reset()
    way = td["state", "target"] - td["state", "position"]
    way = way / way.norm(dim=-1, keepdim=True)
    td["state", "position"] = td["state", "target"] - torch.rand(env.num_envs, 1) * way
    td["state", "velocity"] = 2.0 * way
    return env.reset(td, set_state=True)


# 1. The reward: the bonus for a gate is most of the return, and has no gradient.
rollout, _ = differentiable_rollout(env, actor, before_the_gates(), 32)
print(audit_reward(rollout, actor, gamma=0.99))

# 2. The critic learns the bonus, too: its gradient points elsewhere than the simulator's.
optimizer = torch.optim.Adam(loss.qvalue_network_params.parameters(), 1e-3)
target = SoftUpdate(loss, tau=0.05)
for iteration in range(ITERATIONS + 1):
    rollout, _ = differentiable_rollout(env, actor, before_the_gates(), 32)
    if iteration in (0, ITERATIONS):
        print(f"\nafter {iteration} iterations of the critic: {compare_gradients(loss, rollout)}")
    data = loss.write_value_target(rollout.detach())
    for _ in range(4):
        optimizer.zero_grad()
        loss.loss_qvalue(data)[0].backward()
        optimizer.step()
        target.step()

# 3. A longer horizon sees more, and its gradient is noisier.
print("\nhorizon     norm   variance  signal to noise")
for horizon, x in gradient_by_horizon(env, actor, loss, (8, 16, 32, 64), start=before_the_gates(), max_envs=8).items():
    print(f"{horizon:7} {x.norm:8.3f} {x.variance:10.3f} {x.signal_to_noise:16.2f}")
