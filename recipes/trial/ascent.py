"""Does a first-order gradient know the way up? Its parts against the simulator.

python recipes/ascent.py outputs/reproduce/*/{abpt,shac,bptt}/seed*/checkpoint.pt --output docs/results/data/ascent.csv

In states that the policy of a checkpoint visits, the true gradient of the return in the next action is measured: the
action is changed a little up and down, and the policy flies on with the same noise, gates and crashes included. Beside
it stands what the objective of abpt.py, shac.py or bptt.py says of the same action, and what its parts say: the cosine
between the two, from -1 to 1, as the mean over states. How much noise the measurement has, the cosine between its two
halves shows: exact estimates do not reach 1 either.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from checkpoints import read_checkpoint
from common import build_env, make_policy, network
from matrix import VARIANTS
from omegaconf import DictConfig, OmegaConf
from reproduce import read, write
from tensordict import TensorDictBase
from torch import Tensor
from torch.autograd.graph import GradientEdge
from torch.nn.functional import cosine_similarity
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_quad import ABPTLoss, BPTTLoss, SHACLoss, differentiable_rollout, make_qvalue, make_value
from torchrl_quad.objectives import PathwiseLoss
from torchrl_quad.objectives.pathwise import discounts

CRITICS = {"abpt": (ABPTLoss, make_qvalue), "shac": (SHACLoss, make_value)}
SEED = 3_000_000


def name(path: Path, cfg: DictConfig) -> dict[str, str]:
    """Task, variant and seed of a run; a variant of matrix.py is known by its folder, <task>/<variant>/seed<seed>."""
    variant = next((x for x in path.resolve().parts[-3:-2] if x in VARIANTS), cfg.algorithm)
    return {"task": cfg.task, "variant": variant, "seed": str(cfg.seed)}


def load_loss(saved: dict, cfg: DictConfig, env: EnvBase) -> PathwiseLoss:
    """The loss of a checkpoint, with the policy and the critics as they were at last."""
    actor = make_policy(cfg, env)
    if cfg.algorithm == "bptt":
        loss = BPTTLoss(actor, **cfg.loss).make_value_estimator(gamma=cfg.gamma)
    else:
        kind, make_critic = CRITICS[cfg.algorithm]
        loss = kind(actor, make_critic(env, **network(cfg, "critic")), **cfg.loss)
        loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    loss.load_state_dict(saved["parts"][0])
    return loss


def estimates(loss: PathwiseLoss, rollout: TensorDictBase) -> dict[str, Tensor]:
    """The gradient of the objective, and of its parts where it has several, in the first action: each (envs, 4)."""
    node, index = rollout["action"].grad_fn.next_functions[0]  # the actions were stacked when it had been flown
    parts = loss.objective_parts(rollout)
    parts |= {"objective": sum(parts.values())}
    return {
        name: torch.autograd.grad(part.sum(), GradientEdge(node, index), retain_graph=True)[0].squeeze(1)
        for name, part in parts.items()
    }


@torch.no_grad()
def slopes(env: EnvBase, loss: PathwiseLoss, start: TensorDictBase, action: Tensor, steps: int, size: float) -> Tensor:
    """The true gradient of the discounted return in an action, by central differences: (envs, 4).

    Args:
        start: what reset has given (envs).
        action: (envs, 4), to be taken first; the policy flies on with the same noise each time.
        steps: control steps until which rewards count; they count to the end of the episode at most.
        size: how much each component is changed up and down.
    """
    gamma = loss.value_estimator.gamma

    def flown(action: Tensor) -> Tensor:
        torch.manual_seed(SEED)
        first = env.step(start.clone().set("action", action))
        rest, _ = differentiable_rollout(env, loss.actor_network, env.step_mdp(first), steps - 1)
        flight = torch.cat([x.select(("next", "reward"), ("next", "done")) for x in (first.unsqueeze(1), rest)], 1)
        discount = discounts(flight["next", "done"], gamma) * env.first_episode(flight)
        return (discount * flight["next", "reward"]).sum((1, 2))

    changes = size * torch.eye(action.shape[-1])
    return torch.stack([flown(action + x) - flown(action - x) for x in changes], -1) / (2.0 * size)


def examine(saved: dict, cfg: DictConfig, states: int, repeats: int, steps: int, size: float) -> dict[str, str]:
    """What the gradient of a checkpoint finds."""
    torch.manual_seed(SEED)
    scout, env = (build_env(cfg, number, SEED) for number in (states, states * repeats))
    loss = load_loss(saved, cfg, env)
    with torch.no_grad():
        flight, _ = differentiable_rollout(scout, loss.actor_network, None, env.max_episode_steps // 2)
    visited = flight[torch.arange(states), torch.randint(flight.shape[1], (states,))].select("state")
    start = env.reset(visited.repeat_interleave(repeats), set_state=True)
    rollout, _ = differentiable_rollout(env, loss.actor_network, start, cfg.horizon)
    told = estimates(loss, rollout)
    action = rollout["action"][:, 0].detach()
    true = slopes(env, loss, start, action, steps, size)

    def each(x: Tensor) -> Tensor:  # state: the mean over repeats, whose noise differs
        return x.unflatten(0, (states, -1)).mean(1)

    def agreement(one: Tensor, other: Tensor) -> float:
        return cosine_similarity(one, other, dim=-1).mean().item()

    halves = true.unflatten(0, (states, 2, -1)).mean(2).unbind(1)
    row = {"explained_variance": saved["rows"][-1].get("train/explained_variance", math.nan)}
    row["halves"] = agreement(*halves)
    row |= {name: agreement(each(x), each(true)) for name, x in told.items()}
    return {name: f"{x:.4g}" for name, x in row.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", type=Path)
    parser.add_argument("--states", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=4, help="flights from each of them, each with its own noise")
    parser.add_argument("--steps", type=int, default=256, help="control steps until which rewards count")
    parser.add_argument("--size", type=float, default=0.1, help="of the change of an action, from -1 to 1")
    parser.add_argument("--output", type=Path, required=True, help="a CSV file; what stands there is not done again")
    args = parser.parse_args()
    if args.repeats % 2:
        parser.error("--repeats has to be even: halves of them are compared.")
    torch.set_num_threads(1)
    rows, seen = read(args.output), []
    for path in tqdm(args.checkpoints):
        saved = read_checkpoint(path)
        cfg = OmegaConf.create(saved["config"])
        if cfg.algorithm == "ppo":
            parser.error(f"{path} was trained with PPO, which follows no gradient of the simulator.")
        if cfg.normalize:
            parser.error(f"{path} was trained under a normaliser; only policies without one can be examined.")
        own = name(path, cfg)
        if own in seen:
            parser.error(
                f"{path} is a second {' '.join(own.values())}: give runs that differ in more an --output each."
            )
        seen.append(own)
        if not any(own.items() <= row.items() for row in rows):
            rows.append(own | examine(saved, cfg, args.states, args.repeats, args.steps, args.size))
            write(args.output, rows)


if __name__ == "__main__":
    main()
