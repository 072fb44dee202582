"""A policy that learns to hover by short-horizon actor-critic: actor, critic, target network and visited states."""

import torch
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate

from torchrl_quad import HoveringEnv, SHACLoss, VisitedStateBuffer, differentiable_rollout, make_actor, make_value

ITERATIONS = 60

torch.manual_seed(0)
env = HoveringEnv(num_envs=64)
actor = make_actor(env, input_scale=0.5)
loss = SHACLoss(actor, make_value(env))
loss.make_value_estimator(gamma=0.99, lmbda=0.95)
target = SoftUpdate(loss, tau=0.05)
actor_optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), 2e-2, betas=(0.7, 0.95))
critic_optimizer = torch.optim.Adam(loss.value_network_params.parameters(), 5e-3, betas=(0.7, 0.95))
schedule = torch.optim.lr_scheduler.LinearLR(actor_optimizer, 1.0, 0.01, ITERATIONS)
buffer = VisitedStateBuffer(capacity=8192)

carry = env.reset()
for iteration in range(ITERATIONS):
    # The actor climbs the rewards of the horizon, and the value of its end, through the dynamics.
    rollout, _ = differentiable_rollout(env, actor, carry, 64)
    loss_actor, _ = loss.loss_actor(rollout)
    actor_optimizer.zero_grad()
    loss_actor.backward()
    torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
    actor_optimizer.step()
    schedule.step()

    # The critic moves to the TD(lambda) targets of its slow copy.
    data = loss.write_value_target(rollout.detach())
    for _ in range(4):
        critic_optimizer.zero_grad()
        loss.loss_value(data)[0].backward()
        critic_optimizer.step()
        target.step()

    # Half of the next horizons start where the policy has been, so that they see what comes after the first 64 steps.
    buffer.extend(data)
    carry = buffer.initial_state(env, fraction=0.5)

    if (iteration + 1) % 10 == 0:
        print(f"iteration {iteration + 1}: reward {rollout['next', 'reward'].mean():.4f} per step")

with torch.no_grad():
    flight, _ = differentiable_rollout(env, actor, None, 256, exploration_type=ExplorationType.DETERMINISTIC)
result = env.episode_metrics(flight)
print(f"solved {100 * result['solved'].mean():.0f} %, error {100 * result['position_error'].median():.1f} cm")
