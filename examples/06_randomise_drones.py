"""Train one policy on a single perfect drone, and another on varied drones, wind, sensors and starts; compare them."""

import torch
from torchrl.envs.utils import ExplorationType

from torchrl_quad import BPTTLoss, HoveringEnv, VisitedStateBuffer, differentiable_rollout, make_actor

ITERATIONS = 35

variations = {
    # The controller believes in the nominal drone: a heavier one sinks at the action that should hover.
    "randomize": {"mass": {"scale": [0.8, 1.2]}, "motor_time_constant": {"uniform": [0.02, 0.06]}},
    "wind": {"spread": [1.0, 1.0, 0.0], "gust": 0.5},  # [m/s]
    "observation_noise": {"position": 0.01, "attitude": 0.01, "velocity": 0.05, "angular_velocity": 0.02},
    "random_start": {"tilt": 0.5, "velocity": 1.0},  # [rad], [m/s]
}


def train(env):
    """Train a policy to hover in an environment, by backpropagation through time."""
    torch.manual_seed(0)
    actor = make_actor(env, input_scale=0.5)
    loss = BPTTLoss(actor)
    optimizer = torch.optim.Adam(actor.parameters(), 2e-2, betas=(0.7, 0.95))
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, ITERATIONS)
    buffer, carry = VisitedStateBuffer(capacity=8192), env.reset()
    for _ in range(ITERATIONS):
        rollout, _ = differentiable_rollout(env, actor, carry, 64)
        optimizer.zero_grad()
        loss(rollout)["loss_actor"].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        schedule.step()
        buffer.extend(rollout)
        carry = buffer.initial_state(env, fraction=0.5)  # half of the horizons go on with a flight
    return actor


def evaluate(actor, **options):
    """The mean distance to the target over the last second [cm], of the median drone, and of the worst in ten."""
    env = HoveringEnv(num_envs=128, seed=1, **options)  # other drones than those of the training
    with torch.no_grad():
        flight, _ = differentiable_rollout(env, actor, None, 256, exploration_type=ExplorationType.DETERMINISTIC)
    error = 100 * env.episode_metrics(flight)["position_error"]
    return f"{error.median():5.1f} {error.quantile(0.9):5.1f}"


print("distance to the target [cm]: median, nine in ten are closer than")
for name, options in (("one drone", {}), ("varied drones", variations)):
    actor = train(HoveringEnv(num_envs=64, **options))
    print(f"learnt on {name:14} perfect drone {evaluate(actor)}    varied drones {evaluate(actor, **variations)}")
