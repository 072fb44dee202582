"""Compare classical controllers, which know the drone's parameters, with a policy that learns."""

import time

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad import MPC, BPTTLoss, GeometricController, HoveringEnv, differentiable_rollout, make_actor

ITERATIONS = 80
STEPS = 256

torch.set_num_threads(1)
torch.manual_seed(0)


def train(env):
    """A policy by backpropagation through time."""
    actor = make_actor(env)
    loss = BPTTLoss(actor)
    optimizer = torch.optim.Adam(actor.parameters(), 1e-2)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, ITERATIONS)
    carry = env.reset()
    for _ in range(ITERATIONS):
        rollout, carry = differentiable_rollout(env, actor, carry, 96)
        optimizer.zero_grad()
        loss(rollout)["loss_actor"].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        schedule.step()
    return actor


def fly(name, policy, env):
    """Fly from the same starts as the others, and judge the flight as every evaluation does."""
    env.set_seed(7)
    begin = time.process_time()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        flight = env.rollout(STEPS, policy, break_when_any_done=False)
    milliseconds = 1e3 * (time.process_time() - begin) / STEPS
    result = env.episode_metrics(flight)
    solved, error = 100 * result["solved"].mean(), 100 * result["position_error"].median()
    print(f"{name:14s}{solved:10.0f} %{error:12.1f} cm{milliseconds:12.1f} ms")


learned = train(HoveringEnv(num_envs=64))
env = HoveringEnv(num_envs=4)
print(f"{'':14s}{'solved':>12s}{'error':>15s}{'a step':>15s}")
fly("BPTT", learned, env)
fly("geometric", GeometricController(env), env)
fly("MPC", MPC(env), env)
