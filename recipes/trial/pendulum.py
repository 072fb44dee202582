"""Train the losses on TorchRL's own pendulum: are they what they say on an environment that is not ours?

python recipes/trial/pendulum.py --losses shac sapo ahac abpt abpt-simulated --seeds 0 1 2

The task is that of gymnasium's Pendulum-v1: 200 steps from a random angle, under a torque too weak to lift the pendulum
at once. The return is the mean over 256 episodes without exploration noise. Random actions reach about -1200, and a
policy that swings it up about -150. All losses have the same networks, rates and number of steps.
"""

from __future__ import annotations

import argparse
import sys
import time

import torch
from tables import table
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, EnvBase, PendulumEnv, RewardScaling, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate

from torchrl_quad import (
    ABPTLoss,
    AHACLoss,
    BPTTLoss,
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
                critic_optimizer.zero_grad()
                learn(data[torch.randint(len(data), (512,))])[0].backward()
                torch.nn.utils.clip_grad_norm_(critic, 1.0)
                critic_optimizer.step()
                if target:
                    target.step()
        if name == "ahac":
            loss.adapt_horizon(metadata["stiffness"])
        steps += rollout.numel()
        fresh = starts(env, ENVS // 2)  # an episode of the pendulum has no end of its own: half of them start afresh
        going_on = carry.select(*fresh.keys())[torch.randperm(ENVS)[: ENVS - len(fresh)]]
        carry = torch.cat((fresh, going_on))
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
            runs.append(train(name, seed, args.steps))
            print(f"{name}, seed {seed}: {runs[-1][1]:.0f}", file=sys.stderr)
        before, after, seconds = zip(*runs, strict=True)
        returns = ", ".join(f"{x:.0f}" for x in after)
        lines.append([name, f"{sum(before) / len(runs):.0f}", returns, f"{sum(seconds) / len(runs):.0f} s"])
    print(table(["loss", "before", "after, by seed", "seconds"], lines))


if __name__ == "__main__":
    main()
