"""Train the losses on TorchRL's own pendulum: are they what they say on an environment that is not ours?

python recipes/trial/pendulum.py --losses shac sapo ahac abpt abpt-simulated hybrid --seeds 0 1 2

The task is that of gymnasium's Pendulum-v1: 200 steps from a random angle, under a torque too weak to lift the pendulum
at once. The return is the mean over 256 episodes without exploration noise. Random actions reach about -1200, and a
policy that swings it up about -150. All losses have the same networks, rates and number of steps. The hybrid has the
settings of its recipe instead, and as many steps.
"""

from __future__ import annotations

import argparse
import sys
import time

import torch
from tables import table  # whose import makes the recipes' code known
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, EnvBase, PendulumEnv, RewardScaling, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate
from training.building import AdaptiveRate, shuffled

from torchrl_quad import (
    ABPTLoss,
    AHACLoss,
    BPTTLoss,
    HybridLoss,
    SAPOLoss,
    SHACLoss,
    differentiable_rollout,
    make_actor,
    make_qvalue,
    make_value,
)

ENVS, HORIZON, EPISODE, EPISODES = 256, 16, 200, 256
LEARNING_RATE = 1e-2  # of actor and critics; it falls to a fiftieth
REWARD = 0.1  # of the cost: returns near ten are quicker to learn than those near 100
LOSSES = {
    "bptt": lambda env, actor: BPTTLoss(actor),
    "shac": lambda env, actor: SHACLoss(actor, make_value(env)),
    "sapo": lambda env, actor: SAPOLoss(actor, make_value(env), alpha_init=1e-2),
    "ahac": lambda env, actor: AHACLoss(actor, make_value(env), horizon=HORIZON),
    "abpt": lambda env, actor: ABPTLoss(actor, make_qvalue(env)),
    "abpt-simulated": lambda env, actor: ABPTLoss(actor, make_qvalue(env), simulated_steps=1),
    "hybrid": lambda env, actor: HybridLoss(actor, make_value(env, num_cells=(128, 128))),
}


class CosSin(Transform):
    """The angle as cosine and sine, which do not jump at half a turn, and the speed: ``observation`` (*, 3)."""

    def _call(self, td: TensorDictBase) -> TensorDictBase:
        th, thdot = td["th"], td["thdot"]
        return td.set("observation", torch.stack((th.cos(), th.sin(), thdot / 8), -1))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, spec: Composite) -> Composite:
        """Add the observation."""
        return spec.set("observation", Unbounded((*spec.shape, 3)))


def make_pendulum(seed: int) -> EnvBase:
    """Make TorchRL's pendulum with an observation and a scaled reward."""
    return TransformedEnv(PendulumEnv(seed=seed), Compose(CosSin(), RewardScaling(0.0, REWARD)))


def starts(env: EnvBase, count: int) -> TensorDictBase:
    """Random angles and speeds, as the environment draws them."""
    return env.reset(PendulumEnv.gen_params(batch_size=[count]), set_state=False)


def mean_return(actor: torch.nn.Module) -> float:
    """Fly fresh episodes of 200 steps without exploration noise."""
    env = make_pendulum(seed=10_000)
    with torch.no_grad():
        mode = ExplorationType.DETERMINISTIC
        flight, _ = differentiable_rollout(env, actor, starts(env, EPISODES), EPISODE, exploration_type=mode)
    return flight["next", "reward"].sum(1).mean().item() / REWARD


def train(name: str, seed: int, total_steps: int) -> tuple[float, float, float]:
    """Train with a loss; return the mean returns before and after, and the seconds."""
    torch.manual_seed(seed)
    env = make_pendulum(seed)
    actor = make_actor(env, scale_init=0.3, return_log_prob=name == "sapo")
    loss = LOSSES[name](env, actor)
    loss.make_value_estimator(gamma=0.98)
    target = SoftUpdate(loss, tau=0.05) if name in ("shac", "abpt", "abpt-simulated") else None
    extra = [loss.log_alpha] if loss.automatic_alpha else []
    actor_optimizer = torch.optim.Adam([*loss.actor_network_params.parameters(), *extra], betas=(0.7, 0.95))
    critic = [] if name == "bptt" else list(getattr(loss, f"{loss.critic_name}_params").parameters())
    critic_optimizer = torch.optim.Adam(critic, betas=(0.7, 0.95)) if critic else None
    learn = getattr(loss, loss.critic_loss_key) if critic else None

    before, start, steps = mean_return(actor), time.process_time(), 0
    carry = starts(env, ENVS)
    while steps < total_steps:
        for optimizer in (actor_optimizer, critic_optimizer):
            if optimizer:
                optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - 0.98 * steps / total_steps)
        rollout, carry = differentiable_rollout(env, actor, carry, getattr(loss, "horizon", HORIZON))
        loss_actor, metadata = loss.loss_actor(rollout)
        actor_optimizer.zero_grad()
        (loss_actor + metadata.get("loss_alpha", 0.0)).backward()
        torch.nn.utils.clip_grad_norm_(loss.actor_network_params.parameters(), 0.5)
        actor_optimizer.step()
        if critic:
            data = loss.write_value_target(rollout.detach()).reshape(-1)
            for _ in range(8):
                optimise(critic_optimizer, learn(data[torch.randint(len(data), (512,))])[0], 1.0)
                if target:
                    target.step()
        if name == "ahac":
            loss.adapt_horizon(metadata["stiffness"])
        steps += rollout.numel()
        carry = start_some(env, carry)
    return before, mean_return(actor), time.process_time() - start


def optimise(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
    """Take a step down the gradient of a loss, of bounded norm."""
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_([x for group in optimizer.param_groups for x in group["params"]], max_grad_norm)
    optimizer.step()


def start_some(env: EnvBase, carry: TensorDictBase) -> TensorDictBase:
    """Let half of the pendulums start afresh: an episode has no end of its own."""
    fresh = starts(env, len(carry) // 2)
    going_on = carry.select(*fresh.keys())[torch.randperm(len(carry))[: len(carry) - len(fresh)]]
    return torch.cat((fresh, going_on))


def train_hybrid(seed: int, total_steps: int) -> tuple[float, float, float]:
    """As :func:`train`, with the loop and the settings of recipes/hybrid.py."""
    torch.manual_seed(seed)
    env, envs, horizon, batch_size = make_pendulum(seed), min(128, ENVS), 2 * HORIZON, 1024
    actor = make_actor(env, scale_init=0.2, learn_scale=False, noise_correlation=0.9)
    loss = LOSSES["hybrid"](env, actor)
    loss.make_value_estimator(gamma=0.99, lmbda=0.95)
    actor_optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), 1e-3, betas=(0.9, 0.99))
    critic_optimizer = torch.optim.Adam(loss.value_network_params.parameters(), 3e-3, betas=(0.9, 0.99))
    iterations = -(-total_steps // (envs * horizon))
    rate = AdaptiveRate(actor_optimizer, 0.25, iterations)

    before, start = mean_return(actor), time.process_time()
    carry = starts(env, envs)
    for iteration in range(iterations):
        critic_optimizer.param_groups[0]["lr"] = 3e-3 * (1.0 - 0.99 * iteration / iterations)
        rollout, carry = differentiable_rollout(env, actor, carry, horizon)
        moved = 0.0
        for batch in shuffled(loss.write_targets(rollout).exclude("next"), batch_size, 5):
            losses = loss(batch)
            if moved < rate.limit(iteration):
                moved = max(moved, losses["kl"].item())
                optimise(actor_optimizer, losses["loss_actor"], 0.5)
            optimise(critic_optimizer, losses["loss_value"], 1.0)
        rate.step(iteration, moved)
        carry = start_some(env, carry)
    return before, mean_return(actor), time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--losses", nargs="+", default=list(LOSSES), choices=list(LOSSES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1_024_000, help="of all 256 pendulums together")
    args = parser.parse_args()
    torch.set_num_threads(1)
    lines = []
    for name in args.losses:
        runs = []
        for seed in args.seeds:
            runs.append(train_hybrid(seed, args.steps) if name == "hybrid" else train(name, seed, args.steps))
            print(f"{name}, seed {seed}: {runs[-1][1]:.0f}", file=sys.stderr)
        before, after, seconds = zip(*runs, strict=True)
        returns = ", ".join(f"{x:.0f}" for x in after)
        lines.append([name, f"{sum(before) / len(runs):.0f}", returns, f"{sum(seconds) / len(runs):.0f} s"])
    print(table(["loss", "before", "after, by seed", "seconds"], lines))


if __name__ == "__main__":
    main()
