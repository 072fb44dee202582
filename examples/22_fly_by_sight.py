"""Train a policy that sees the trees of a forest and remembers them, through the simulator, and count who comes through."""

import torch
from torchrl.envs.utils import ExplorationType

from torchrl_quad import BPTTLoss, ForestEnv, differentiable_rollout, make_visual_actor, restart


def train(iterations=30, num_envs=32, horizon=48, compile=True):
    """Train on an easy forest; return the policy and the mean reward of each horizon."""
    torch.manual_seed(0)
    env = ForestEnv(num_envs, difficulty="easy", speed=3.0, compile=compile)
    actor = make_visual_actor(env, num_cells=(64,), hidden_size=32, input_scale=0.2)
    # A drone that is about to crash has gradients many times as long as those of all others.
    loss = BPTTLoss(actor, clip_action_gradient=2.0).make_value_estimator(gamma=0.99)
    optimizer = torch.optim.Adam(actor.parameters(), lr=3e-3)
    carry, rewards = None, []
    for _ in range(iterations):
        # What the policy remembers goes through the horizon with its graph, and on into the next one without.
        rollout, end = differentiable_rollout(env, actor, carry, horizon)
        optimizer.zero_grad()
        loss(rollout)["loss_actor"].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        carry = restart(env, end, 0.1)
        rewards.append(rollout["next", "reward"].mean().item())
    return actor, rewards


def distance_flown(actor, num_envs=16, steps=300):
    """How far fresh drones come in forests that nobody has seen, on average [m]; 30 m is the other side."""
    env = ForestEnv(num_envs, difficulty="easy", speed=3.0, seed=1)
    with torch.no_grad():
        options = {"exploration_type": ExplorationType.DETERMINISTIC}
        flight, _ = differentiable_rollout(env, actor, None, steps, **options)
    return env.episode_metrics(flight)["distance"].mean().item()


if __name__ == "__main__":
    actor, rewards = train()
    for i in range(0, len(rewards), 5):
        print(f"horizon {i:3d}: mean reward {rewards[i]:+.3f}")
    print(f"fresh drones come {distance_flown(actor):.1f} m far")
