"""Hover by what a camera sees of seven landmarks: from scratch, and with a memory that has learned to tell the state.

Heeg et al. 2025, arXiv:2410.15979, let a policy learn the state from features first, which speeds up what follows.
"""

import sys
from pathlib import Path

import torch
from torchrl.envs.utils import ExplorationType
from torchrl.modules import set_recurrent_mode

from torchrl_quad import AHACLoss, differentiable_rollout, make_actor, make_value, restart
from torchrl_quad.dynamics.quaternion import up_in_body

sys.path.insert(0, str(Path(__file__).parents[1]))
from examples.tasks.features import Features

LESSONS, ITERATIONS = 150, 150
STATE = [("state", name) for name in ("position", "velocity", "quaternion", "angular_velocity")]


env = Features(num_envs=64, seed=0)
env.compile()


def pretrain(actor):
    """Let the memory tell position, velocity and the direction of up, in flights of the untrained policy."""
    features, memory, _ = actor[0].module
    tell = torch.nn.LazyLinear(9)
    optimizer = torch.optim.Adam([*features.parameters(), *memory.parameters(), *tell.parameters()], 3e-3)
    for _ in range(LESSONS):
        with torch.no_grad():
            flown, _ = differentiable_rollout(env, actor, None, 32)
        with set_recurrent_mode("recurrent"):
            seen = memory(features(flown.select("observation", "is_init", "recurrent_state")))
        state = flown["state"]
        truth = torch.cat((state["position"], state["velocity"], up_in_body(state["quaternion"])), -1)
        error = (tell(torch.cat((seen["features"], seen["recalled"]), -1)) - truth).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    print(f"after {LESSONS} lessons the memory tells the state to {error.sqrt():.2f} (m, m/s) on average")


def train(pretrained):
    """The median distance to the target [cm] of a policy that has learned by AHAC."""
    torch.manual_seed(0)
    env.set_seed(0)
    actor = make_actor(env, recurrent=True, scale_init=0.2, learn_scale=False, noise_correlation=0.9)
    if pretrained:
        pretrain(actor)
    loss = AHACLoss(actor, make_value(env, in_keys=STATE), clip_action_gradient=2.0)
    actor_optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), 1e-2, betas=(0.7, 0.95))
    critic_optimizer = torch.optim.Adam(loss.value_network_params.parameters(), 5e-3)
    carry = env.reset()
    for _ in range(ITERATIONS):
        rollout, end = differentiable_rollout(env, actor, carry, loss.horizon)
        loss_actor, metrics = loss.loss_actor(rollout)
        actor_optimizer.zero_grad()
        loss_actor.backward()
        torch.nn.utils.clip_grad_norm_(loss.actor_network_params.parameters(), 0.5)
        actor_optimizer.step()
        data = loss.write_value_target(rollout.detach())
        for _ in range(4):
            critic_optimizer.zero_grad()
            loss.loss_value(data)[0].backward()
            critic_optimizer.step()
        loss.adapt_horizon(metrics["stiffness"])
        carry = restart(env, end, 0.2)
    with torch.no_grad():
        flight, _ = differentiable_rollout(env, actor, None, 256, exploration_type=ExplorationType.DETERMINISTIC)
    return 100 * env.episode_metrics(flight)["position_error"].median()


for pretrained in (False, True):
    print(f"{'pretrained' if pretrained else 'from scratch'}: {train(pretrained):.0f} cm from the target")
