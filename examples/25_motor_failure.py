"""A motor of a hexarotor dies at a random time, and a policy with a memory learns to come down all the same."""
# ruff: noqa: D102, the docstrings of the methods are in Disturbance

import math

import torch
from torchrl.envs.utils import ExplorationType

from torchrl_quad import BPTTLoss, LandingEnv, differentiable_rollout, load_drone, make_actor, restart
from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs import Disturbance
from torchrl_quad.envs.metrics import at_episode_end

ITERATIONS = 80
ANGLES = [math.pi * (2 * i + 1) / 6 for i in range(6)]
HEXAROTOR = load_drone("visfly").replace(
    rotor_positions=[[0.1 * math.cos(a), 0.1 * math.sin(a)] for a in ANGLES], rotor_spin=[1, -1, 1, -1, 1, -1]
)


class MotorFailure(Disturbance):
    """One rotor, drawn for each episode, stops at a time drawn up to ``latest`` [s]. The controller does not know."""

    def __init__(self, latest):
        self.latest = latest

    def start(self, random, state):
        speed = state["rotor_speed"]
        dies = torch.nn.functional.one_hot(random.integers(speed.shape[1], len(speed)), speed.shape[1])
        time = 0.5 * self.latest * (random.uniform(len(speed), 1) + 1.0)
        return {"dies": dies.to(speed), "time": time, ("drone", "rotor_effectiveness"): torch.ones_like(speed)}

    def advance(self, state, noise, dt):
        is_dead = (state["step"] * dt >= state["time"]) * state["dies"]
        return {("drone", "rotor_effectiveness"): 1.0 - is_dead}


def train(**options):
    """Train a policy to land, by backpropagation through time."""
    torch.manual_seed(0)
    env = LandingEnv(num_envs=64, drone=HEXAROTOR, **options)
    actor = make_actor(env, recurrent=True, hidden_size=32, input_scale=0.5)
    loss = BPTTLoss(actor).make_value_estimator(gamma=0.99)
    optimizer = torch.optim.Adam(actor.parameters(), 1e-2, betas=(0.7, 0.95))
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, ITERATIONS)
    carry = None
    for _ in range(ITERATIONS):
        rollout, end = differentiable_rollout(env, actor, carry, 48)
        optimizer.zero_grad()
        loss(rollout)["loss_actor"].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        schedule.step()
        carry = restart(env, end, 0.1)
    return actor


def evaluate(actor):
    """How flights end whose motor fails: the shares that landed and crashed [%], and the median tilt [degrees]."""
    env = LandingEnv(num_envs=256, seed=1, drone=HEXAROTOR, disturbances=[MotorFailure(2.0)])
    with torch.no_grad():
        flight, _ = differentiable_rollout(env, actor, None, 256, exploration_type=ExplorationType.DETERMINISTIC)
    result = env.episode_metrics(flight)
    upright = quaternion.up_in_body(flight["next", "state", "quaternion"])[..., 2:].clamp(-1.0, 1.0)
    tilt = at_episode_end(flight, upright.acos().rad2deg()).median()
    return f"{100 * result['solved'].mean():4.0f} {100 * result['crash'].mean():4.0f} {tilt:4.0f}"


print("trained with    landed [%]  crashed [%]  tilt at the end [degrees]", flush=True)
for name, options in (("failures", {"disturbances": [MotorFailure(2.0)]}), ("whole drones", {})):
    print(f"{name:14} {evaluate(train(**options))}", flush=True)
