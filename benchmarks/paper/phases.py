"""Train the hybrid on racing, and measure in phases of its training which of its two gradients points uphill.

python -m benchmarks.paper.phases --tasks racing racing_position --seeds 100

In states that the policy of a phase visits, the gradient of the return in the mean of the next action is measured: the
action is changed a little up and down, together with what it carries into later noise, and the policy flies on, gates
and crashes included. That gradient, the pathwise one, that of the score function, and what the loss makes of both
become gradients in the policy's weights over all these states. The result is the cosine of each with the measured one.
Two halves of the measurement are compared in the same way: their cosine shows its noise.

It may be stopped at any moment. Started again, it skips what is in benchmarks/paper/data/phases.csv, and resumes what was
cut off. It fills in the table of docs/more_losses.md.
"""

from __future__ import annotations

import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import cosine_similarity
from torchrl.envs import EnvBase

from benchmarks.paper.ascent import SEED, return_of, visited
from benchmarks.paper.comparison import LABELS, column
from benchmarks.paper.results import fill
from benchmarks.paper.running import QUICK, RECIPES, arguments, command_line, page, run, side_by_side
from benchmarks.paper.shipped import overrides
from benchmarks.paper.tables import table
from torchrl_quad import HybridLoss, differentiable_rollout, make_value
from torchrl_quad.files import add_rows, read_rows, replacing
from torchrl_quad.objectives.action_gradients import distribution_again
from torchrl_quad.training.building import build_env, make_policy, network
from torchrl_quad.training.checkpoints import read_checkpoint

SHARES = (0.05, 0.125, 0.25, 0.5, 0.75, 1.0)  # of the steps of a run
GRADIENTS = {"pathwise": "pathwise", "score": "score function", "hybrid": "hybrid", "halves": "two halves"}


def train(task: str, seed: int, folder: Path, quick: bool) -> None:
    """Train once, or resume it, and keep a copy of the checkpoint in each phase."""
    own = [f"seed={seed}", *(QUICK if quick else ()), "resume=auto", f"hydra.run.dir={folder}"]
    command = [sys.executable, str(RECIPES / "hybrid.py"), *overrides(task, "hybrid"), *own]
    with ThreadPoolExecutor(1) as pool:
        training = pool.submit(run, command, folder)
        while not training.done():
            keep(folder)
            time.sleep(1.0)
        training.result()
    keep(folder)


def keep(folder: Path) -> None:
    """Copy the checkpoint of a run if a phase has begun of which there is no copy yet."""
    path = folder / "checkpoint.pt"
    if not path.exists():
        return
    saved = read_checkpoint(path)
    share = saved["rows"][-1]["steps"] / OmegaConf.create(saved["config"]).total_steps if saved["rows"] else 0.0
    for phase in SHARES:
        copy = folder / f"phase_{phase}.pt"
        if share >= 0.99 * phase and not copy.exists():
            with replacing(copy) as temporary:
                shutil.copyfile(path, temporary)


def examine(saved: dict, states: int, repeats: int, steps: int, size: float) -> dict[str, str]:
    """Compare the gradients of a checkpoint with the measured one."""
    torch.manual_seed(SEED)
    cfg = OmegaConf.create(saved["config"])
    env = build_env(cfg, states * repeats, SEED)
    loss = HybridLoss(make_policy(cfg, env), make_value(env, **network(cfg, "critic", env)), **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    loss.load_state_dict(saved["stateful"][0])
    start = visited(cfg, loss, env, states)
    rollout, _ = differentiable_rollout(env, loss.actor_network, start, cfg.horizon)
    weight = loss.pathwise_weight.clamp(0.0, 1.0).item()
    loss.pathwise_weight.fill_(1.0)  # so that the whole pathwise gradient is written
    loss.decay = 1.0
    data = loss.write_targets(rollout)
    predicted = (data["location_gradient"] * (data["latent"] - data["loc"])).sum(-1, keepdim=True)
    predicted = predicted - predicted.mean()
    first, advantage, predicted = data[:, 0], (data["advantage"] + predicted)[:, 0], predicted[:, 0]
    pathwise, noise = first["location_gradient"], first["latent"] - first["loc"]
    score = noise / first["scale"] ** 2  # the gradient of the logarithm of the density
    true = slopes(env, loss, cfg.actor.noise_correlation, start, first, steps, size)
    half = torch.arange(len(true)) % 2 == 0
    directions = {
        "true": true,
        "pathwise": pathwise,
        "score": advantage * score,
        "hybrid": weight * pathwise + (advantage - weight * predicted) * score,
        "one half": true * half.unsqueeze(-1),
        "other half": true * ~half.unsqueeze(-1),
    }
    in_weights = {name: weight_gradient(loss, first, x) for name, x in directions.items()}
    pairs = {name: (name, "true") for name in GRADIENTS} | {"halves": ("one half", "other half")}
    row = {name: cosine_similarity(*(in_weights[x] for x in pair), dim=0).item() for name, pair in pairs.items()}
    row |= {"weight": weight, "explained_variance": saved["rows"][-1]["train/explained_variance"]}
    return {name: f"{x:.4g}" for name, x in row.items()}


def weight_gradient(loss: HybridLoss, data: TensorDictBase, direction: Tensor) -> Tensor:
    """The gradient in the policy's weights (parameters) from that in the means of its actions, (envs, 4)."""
    loc, _ = distribution_again(loss.actor_network, loss.actor_network_params, data)
    weights = list(loss.actor_network_params.parameters())
    grads = torch.autograd.grad((loc * direction).sum(), weights)
    return torch.cat([x.flatten() for x in grads])


@torch.no_grad()
def slopes(
    env: EnvBase, loss: HybridLoss, rho: float, start: TensorDictBase, first: TensorDictBase, steps: int, size: float
) -> Tensor:
    """Measure the gradient of the discounted return in the mean of an action by central differences: (envs, 4).

    Args:
        env: as many environments as there are starts.
        loss: whose policy flies.
        rho: the correlation of its noise from step to step.
        start: the tensordict of a reset (envs).
        first: the first step of a flight from there, with ``latent``, ``noise`` and ``scale``.
        steps: control steps whose rewards count, up to the end of the episode.
        size: the change of each component up and down, before the tanh.
    """
    deviation = first["scale"] / (1.0 - rho**2) ** 0.5

    def flown(change: Tensor) -> Tensor:
        changed = {"action": (first["latent"] + change).tanh(), "noise": first["noise"] + change / deviation}
        return return_of(env, loss, start.clone().update(changed), steps)

    changes = size * torch.eye(first["latent"].shape[-1], dtype=deviation.dtype)
    return torch.stack([flown(x) - flown(-x) for x in changes], -1) / (2.0 * size)


def block(data: Path) -> str:
    """Make the table of docs/more_losses.md."""
    lines, rows = [], read_rows(data / "phases.csv")
    for task, share in dict.fromkeys((row["task"], row["share"]) for row in rows):
        own = [row for row in rows if (row["task"], row["share"]) == (task, share)]
        shown = (*GRADIENTS, "weight", "explained_variance")
        steps, *means = (np.mean(column(own, name)) for name in ("steps", *shown))
        lines.append([LABELS.get(task, task), f"{steps / 1e6:.1f}", *(f"{x:.2f}" for x in means)])
    return table(["task", "million steps", *GRADIENTS.values(), "weight b", "explained variance of V"], lines)


def main() -> None:
    parser = command_line(__doc__, [100], tasks=("racing", "racing_position"))
    parser.add_argument("--states", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=8, help="flights from each of them, each with its own noise")
    parser.add_argument("--steps", type=int, default=256, help="control steps whose rewards count")
    parser.add_argument("--size", type=float, default=0.1, help="change of an action before the tanh")
    args = arguments(parser)
    if args.repeats % 2:
        parser.error("--repeats must be even: two halves of them are compared.")
    torch.set_num_threads(1)
    kept = {(row["task"], row["seed"], row["share"]) for row in read_rows(args.data / "phases.csv")}
    jobs = [
        (task, seed, args.output / task / f"seed{seed}")
        for seed in args.seeds
        for task in args.tasks
        if any((task, str(seed), str(share)) not in kept for share in SHARES)
    ]
    side_by_side(args.cores, [(train, *job, args.quick) for job in jobs])
    for task, seed, folder in jobs:
        for share in SHARES:
            key = {"task": task, "seed": str(seed), "share": str(share)}
            if tuple(key.values()) not in kept:
                saved = read_checkpoint(folder / f"phase_{share}.pt")
                measured = examine(saved, args.states, args.repeats, args.steps, args.size)
                row = key | {"steps": str(saved["rows"][-1]["steps"])} | measured
                add_rows(args.data / "phases.csv", [row])
    fill(page(args.data, "more_losses.md"), {"phases": block(args.data)})


if __name__ == "__main__":
    main()
