"""Compare first-order gradients, and their parts, with the gradient of the return that the simulator gives.

python -m benchmarks.paper.ascent outputs/reproduce/*/{abpt,shac,bptt}/seed*/checkpoint.pt \\
    --output benchmarks/paper/data/ascent.csv

In states that the policy of a checkpoint visits, the true gradient of the return in the next action is measured: each
component of the action is changed a little up and down, and the policy flies on with the same noise, gates and crashes
included. The objective of abpt.py, shac.py or bptt.py, and each of its parts, has a gradient in the same action. The
result is the cosine between the two, from -1 to 1, as the mean over states. Two halves of the measurement are compared
in the same way: their cosine shows its noise, for which exact gradients do not reach 1 either.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import cosine_similarity
from torchrl.envs import EnvBase
from tqdm import tqdm

from benchmarks.paper.matrix import VARIANTS
from torchrl_quad import ABPTLoss, BPTTLoss, SHACLoss, differentiable_rollout, make_qvalue, make_value
from torchrl_quad.envs.metrics import first_episode
from torchrl_quad.files import add_rows, read_rows
from torchrl_quad.objectives import PathwiseLoss
from torchrl_quad.objectives.action_gradients import action_gradient
from torchrl_quad.objectives.segments import discounts
from torchrl_quad.training.building import build_env, make_policy, network
from torchrl_quad.training.checkpoints import read_checkpoint

CRITICS = {"abpt": (ABPTLoss, make_qvalue), "shac": (SHACLoss, make_value)}
SEED = 3_000_000


def name(path: Path, cfg: DictConfig) -> dict[str, str]:
    """Name a run by task, variant and seed; a folder <task>/<variant>/seed<seed> tells a variant of matrix.py."""
    variant = next((x for x in path.resolve().parts[-3:-2] if x in VARIANTS), cfg.algorithm)
    return {"task": cfg.task, "variant": variant, "seed": str(cfg.seed)}


def load_loss(saved: dict, cfg: DictConfig, env: EnvBase) -> PathwiseLoss:
    """Build the loss of a checkpoint, with its last policy and critics."""
    actor = make_policy(cfg, env)
    if cfg.algorithm == "bptt":
        loss = BPTTLoss(actor, **cfg.loss).make_value_estimator(gamma=cfg.gamma)
    else:
        kind, make_critic = CRITICS[cfg.algorithm]
        loss = kind(actor, make_critic(env, **network(cfg, "critic", env)), **cfg.loss)
        loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    loss.load_state_dict(saved["stateful"][0])
    return loss


def estimates(loss: PathwiseLoss, rollout: TensorDictBase) -> dict[str, Tensor]:
    """Compute the gradients of the objective and of its parts in the first action: each (envs, 4)."""
    parts = loss.objective_parts(rollout)
    parts |= {"objective": sum(parts.values())}
    return {name: action_gradient(part.sum(), rollout["action"])[:, 0] for name, part in parts.items()}


@torch.no_grad()
def slopes(env: EnvBase, loss: PathwiseLoss, start: TensorDictBase, action: Tensor, steps: int, size: float) -> Tensor:
    """Measure the gradient of the discounted return in an action by central differences: (envs, 4).

    Args:
        start: the tensordict of a reset (envs).
        action: the first action (envs, 4); the policy flies on with the same noise each time.
        steps: control steps whose rewards count, up to the end of the episode.
        size: the change of each component up and down.
    """

    def flown(action: Tensor) -> Tensor:
        return return_of(env, loss, start.clone().set("action", action), steps)

    changes = size * torch.eye(action.shape[-1])
    return torch.stack([flown(action + x) - flown(action - x) for x in changes], -1) / (2.0 * size)


def return_of(env: EnvBase, loss: PathwiseLoss, start: TensorDictBase, steps: int) -> Tensor:
    """Fly the action in ``start`` (envs), and then the policy, with the same noise in each call: the discounted return.

    Noise that is correlated in time goes on from ``start["noise"]``, if it is there.

    Returns:
        (envs), up to the end of the episode, or of the steps.
    """
    torch.manual_seed(SEED)
    first = env.step(start)
    rest, _ = differentiable_rollout(env, loss.actor_network, env.step_mdp(first), steps - 1)
    flight = torch.cat([x.select(("next", "reward"), ("next", "done")) for x in (first.unsqueeze(1), rest)], 1)
    discount = discounts(flight["next", "done"], loss.value_estimator.gamma) * first_episode(flight)
    return (discount * flight["next", "reward"]).sum((1, 2))


def visited(cfg: DictConfig, loss: PathwiseLoss, env: EnvBase, states: int) -> TensorDictBase:
    """States that a policy visits, each in as many environments as there are for it: the tensordict of a reset."""
    scout = build_env(cfg, states, SEED)
    with torch.no_grad():
        flight, _ = differentiable_rollout(scout, loss.actor_network, None, env.max_episode_steps // 2)
    drawn = flight[torch.arange(states), torch.randint(flight.shape[1], (states,))].select("state")
    return env.reset(drawn.repeat_interleave(env.num_envs // states), set_state=True)


def examine(saved: dict, cfg: DictConfig, states: int, repeats: int, steps: int, size: float) -> dict[str, str]:
    """Compare the gradients of a checkpoint with the measured one."""
    torch.manual_seed(SEED)
    env = build_env(cfg, states * repeats, SEED)
    loss = load_loss(saved, cfg, env)
    start = visited(cfg, loss, env, states)
    rollout, _ = differentiable_rollout(env, loss.actor_network, start, cfg.horizon)
    estimated = estimates(loss, rollout)
    action = rollout["action"][:, 0].detach()
    true = slopes(env, loss, start, action, steps, size)

    def each(x: Tensor) -> Tensor:  # per state: the mean over repeats, whose noise differs
        return x.unflatten(0, (states, -1)).mean(1)

    def agreement(one: Tensor, other: Tensor) -> float:
        return cosine_similarity(one, other, dim=-1).mean().item()

    halves = true.unflatten(0, (states, 2, -1)).mean(2).unbind(1)
    row = {"explained_variance": saved["rows"][-1].get("train/explained_variance", math.nan)}
    row["halves"] = agreement(*halves)
    row |= {name: agreement(each(x), each(true)) for name, x in estimated.items()}
    return {name: f"{x:.4g}" for name, x in row.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", type=Path)
    parser.add_argument("--states", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=4, help="flights from each of them, each with its own noise")
    parser.add_argument("--steps", type=int, default=256, help="control steps whose rewards count")
    parser.add_argument("--size", type=float, default=0.1, help="change of an action, in its range of -1 to 1")
    parser.add_argument("--output", type=Path, required=True, help="a CSV file; runs that are in it are skipped")
    args = parser.parse_args()
    if args.repeats % 2:
        parser.error("--repeats must be even: two halves of them are compared.")
    torch.set_num_threads(1)
    rows, seen = read_rows(args.output), []
    for path in tqdm(args.checkpoints):
        saved = read_checkpoint(path)
        cfg = OmegaConf.create(saved["config"])
        if cfg.algorithm not in ("bptt", *CRITICS):
            parser.error(f"{path} was trained with {cfg.algorithm}; choose runs of bptt, {', '.join(CRITICS)}.")
        if cfg.normalize:
            parser.error(f"{path} was trained under a normaliser; choose runs with normalize=false.")
        own = name(path, cfg)
        if own in seen:
            parser.error(
                f"{path} is a second {' '.join(own.values())}: give runs that differ in more an --output each."
            )
        seen.append(own)
        if not any(own.items() <= row.items() for row in rows):
            add_rows(args.output, [own | examine(saved, cfg, args.states, args.repeats, args.steps, args.size)])


if __name__ == "__main__":
    main()
