"""Your own task: fly through a ring that swings from side to side. It needs no spec, no mask and no detach."""

import torch

from torchrl_quad import BPTTLoss, QuadrotorEnv, differentiable_rollout, make_actor
from torchrl_quad.envs.terms import body_observation, norm

ITERATIONS = 70


class RingEnv(QuadrotorEnv):
    """Fly along x at 1.5 m/s, through a ring of 0.5 m radius at x = 0, which swings along y by 0.5 m, once in 4 s."""

    ends_on_success = True

    def initial_state(self, n):
        start = self.tensor([-2.0, 0.0, 1.5]) + 0.3 * self.uniform(n, 3)
        return {**self.hover_state(start), "phase": torch.pi * self.uniform(n, 1)}

    def advance(self, previous, state):
        return {**state, "phase": previous["phase"] + 2 * torch.pi * self.control_dt / 4}

    def observe(self, state):
        return torch.cat((self.to_ring(state), state["phase"].cos() / 2, *body_observation(state)), -1)

    def reward_terms(self, state):
        slip = norm(state["velocity"] - self.tensor([1.5, 0, 0]) - self.tensor([0, 0.785, 0]) * state["phase"].cos())
        return {"aim": -0.1 * self.miss(state), "slip": -0.03 * slip, "spin": -0.02 * norm(state["angular_velocity"])}

    def is_success(self, state):
        return (state["position"][..., :1] >= 0) & (self.miss(state) < 0.5)

    def is_crash(self, state):
        return (state["position"][..., :1] >= 0) & (self.miss(state) >= 0.5)

    def to_ring(self, state):
        return self.tensor([0.0, 0.5, 0.0]) * state["phase"].sin() + self.tensor([0.0, 0.0, 1.5]) - state["position"]

    def miss(self, state):
        return norm(self.to_ring(state)[..., 1:])


torch.manual_seed(0)
env = RingEnv(num_envs=64, dt=0.01)
actor = make_actor(env, input_scale=0.5)
loss = BPTTLoss(actor)
optimizer = torch.optim.Adam(actor.parameters(), 1e-2, betas=(0.7, 0.95))
schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, ITERATIONS)
carry = env.reset()
for iteration in range(ITERATIONS):
    rollout, carry = differentiable_rollout(env, actor, carry, 64)
    optimizer.zero_grad()
    loss(rollout)["loss_actor"].backward()
    optimizer.step()
    schedule.step()
    if iteration % 10 == 9:
        through, ended = rollout["next", "success"].sum(), rollout["next", "done"].sum()
        print(f"iteration {iteration + 1}: {through} of {ended} flights that ended led through the ring")
