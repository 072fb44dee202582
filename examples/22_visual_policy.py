"""Train a policy of depth images with a memory to fly through forests, and measure how far it gets in new ones."""

import torch
from torchrl.envs.utils import ExplorationType

from torchrl_quad import BPTTLoss, ForestEnv, differentiable_rollout, make_visual_actor, restart

ITERATIONS = 60
STEPS = 500  # of a flight through the forest, at most
TASK = {"difficulty": "easy", "speed": 3.0}


def train(iterations):
    """Train on short horizons; return the policy."""
    torch.manual_seed(0)
    env = ForestEnv(num_envs=32, **TASK)  # compile=True is three times as fast, after a minute
    actor = make_visual_actor(env, hidden_size=32, input_scale=0.2)
    # A drone that is about to crash has gradients many times as large as all others.
    loss = BPTTLoss(actor, clip_action_gradient=2.0).make_value_estimator(gamma=0.99)
    optimizer = torch.optim.Adam(actor.parameters(), lr=3e-3)
    carry = None
    for i in range(iterations):
        # The memory keeps its graph within a horizon, and enters the next one without it.
        rollout, end = differentiable_rollout(env, actor, carry, 32)
        optimizer.zero_grad()
        loss(rollout)["loss_actor"].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        carry = restart(env, end, 0.1)
        if i % 10 == 0:
            print(f"horizon {i:3d}: mean reward {rollout['next', 'reward'].mean():+.3f}")
    return actor


def distance_flown(actor, steps):
    """The mean distance [m] that drones fly in new forests; 30 m is the other side."""
    env = ForestEnv(num_envs=16, seed=1, **TASK)
    with torch.no_grad():
        flight, _ = differentiable_rollout(env, actor, None, steps, exploration_type=ExplorationType.DETERMINISTIC)
    return env.episode_metrics(flight)["distance"].mean().item()


if __name__ == "__main__":
    print(f"trained drones fly {distance_flown(train(ITERATIONS), STEPS):.1f} m")
