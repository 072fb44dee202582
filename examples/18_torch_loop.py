"""Train PPO in a loop of plain torch tensors, as CleanRL does."""

import torch
from torch import nn
from torch.distributions import Normal

from torchrl_quad import HoveringEnv
from torchrl_quad.adapters import TorchVectorEnv

ITERATIONS = 60
DRONES, ROLLOUT, DISCOUNT, LAMBDA = 512, 24, 0.98, 0.95


def network(outputs):
    """From the 13 entries of the observation, through two layers of 64."""
    return nn.Sequential(nn.Linear(13, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


def train(seed=0):
    """Train PPO for the budget; return its actor, and the mean reward of each iteration."""
    torch.manual_seed(seed)
    env = TorchVectorEnv(HoveringEnv(num_envs=DRONES, seed=seed))
    actor, critic, log_std = network(4), network(1), nn.Parameter(torch.full((4,), -0.7))
    parameters, rewards = [*actor.parameters(), *critic.parameters(), log_std], []
    optimizer = torch.optim.Adam(parameters, 3e-3)
    observation, _ = env.reset()
    for iteration in range(ITERATIONS):
        optimizer.param_groups[0]["lr"] = 3e-3 * (1 - iteration / ITERATIONS)
        steps, advantages = [], [torch.zeros(DRONES)]
        with torch.no_grad():
            for _ in range(ROLLOUT):
                action = Normal(actor(observation), log_std.exp()).sample()
                flown = observation, action
                observation, reward, terminated, truncated, info = env.step(action)
                after = critic(info["final_obs"]).squeeze(-1) * ~terminated  # the time limit is no end of the rewards
                error = reward + DISCOUNT * after - critic(flown[0]).squeeze(-1)
                steps.append((*flown, error, ~(terminated | truncated), reward))
            for _, _, error, goes_on, _ in reversed(steps):
                advantages.insert(0, error + DISCOUNT * LAMBDA * goes_on * advantages[0])
            observations, actions, _, _, reward = (torch.cat(x) for x in zip(*steps, strict=True))
            advantage, old = torch.cat(advantages[:-1]), Normal(actor(observations), log_std.exp()).log_prob(actions)
            target = advantage + critic(observations).squeeze(-1)
            advantage = (advantage - advantage.mean()) / advantage.std()
        for batch in [batch for _ in range(3) for batch in torch.randperm(len(target)).chunk(4)]:
            new = Normal(actor(observations[batch]), log_std.exp()).log_prob(actions[batch])
            ratio = (new - old[batch]).sum(-1).exp()
            gain = torch.minimum(ratio * advantage[batch], ratio.clamp(0.8, 1.2) * advantage[batch]).mean()
            error = (critic(observations[batch]).squeeze(-1) - target[batch]).square().mean()
            optimizer.zero_grad()
            (error - gain).backward()
            optimizer.step()
        rewards.append(reward.mean().item())
    return actor, rewards


if __name__ == "__main__":
    print("mean reward, 0.1 at most:", train()[1][-1])
