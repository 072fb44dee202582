"""Gradients of policies, compared with the gradient of the return that the simulator gives, and terms without any.

In states that a policy visits, the true gradient of the return in the next action is measured: each component of the
action is changed a little up and down, and the policy flies on with the same noise, gates and crashes included. The
result is the cosine between it and a loss's gradient, from -1 to 1. Two halves of the measurement are compared in the
same way: their cosine shows its noise, for which exact gradients do not reach 1 either.
"""

from __future__ import annotations

import math
import shutil
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import cosine_similarity
from torchrl.envs import EnvBase
from tqdm import tqdm

from benchmarks.paper.flights import overrides
from benchmarks.paper.matrix import VARIANTS
from benchmarks.paper.running import QUICK, kept, run, side_by_side
from torchrl_quad import audit_reward, differentiable_rollout, make_actor, make_env, make_qvalue, make_value, objectives
from torchrl_quad.envs.metrics import first_episode
from torchrl_quad.files import add_rows, replacing
from torchrl_quad.objectives.calls import action_gradient, discounts, distribution_again
from torchrl_quad.training.building import build_env, make_policy, network
from torchrl_quad.training.checkpoints import read_checkpoint

LOSSES = {"bptt": objectives.BPTTLoss, "shac": objectives.SHACLoss, "abpt": objectives.ABPTLoss}
LOSSES |= {"hybrid": objectives.HybridLoss}
SEED = 3_000_000


def flown_on(
    saved: dict, cfg: DictConfig, states: int, repeats: int
) -> tuple[EnvBase, objectives.PathwiseLoss, TensorDictBase, TensorDictBase]:
    """Let the policy of a checkpoint fly a horizon from states that it visits, each ``repeats`` times.

    Returns:
        the environment, the loss, the tensordict of the reset (states * repeats), and the rollout.
    """
    torch.manual_seed(SEED)
    env = build_env(cfg, states * repeats, SEED)
    actor = make_policy(cfg, env)
    make_critic = make_qvalue if cfg.algorithm == "abpt" else make_value
    critics = [] if cfg.algorithm == "bptt" else [make_critic(env, **network(cfg, "critic", env))]
    loss = LOSSES[cfg.algorithm](actor, *critics, **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, **({"lmbda": cfg.critic.lmbda} if critics else {}))
    loss.load_state_dict(saved["stateful"][0])
    scout = build_env(cfg, states, SEED)
    with torch.no_grad():
        flight, _ = differentiable_rollout(scout, loss.actor_network, None, env.max_episode_steps // 2)
    drawn = flight[torch.arange(states), torch.randint(flight.shape[1], (states,))].select("state")
    start = env.reset(drawn.repeat_interleave(repeats), set_state=True)
    return env, loss, start, differentiable_rollout(env, loss.actor_network, start, cfg.horizon)[0]


def return_of(env: EnvBase, loss: objectives.PathwiseLoss, start: TensorDictBase, steps: int) -> Tensor:
    """Fly the action in ``start`` (envs), and then the policy, with the same noise in each call: the discounted return.

    Noise that is correlated in time continues from ``start["noise"]``, if there is one.

    Returns:
        (envs), up to the end of the episode, or of the steps.
    """
    torch.manual_seed(SEED)
    first = env.step(start)
    rest, _ = differentiable_rollout(env, loss.actor_network, env.step_mdp(first), steps - 1)
    flight = torch.cat([x.select(("next", "reward"), ("next", "done")) for x in (first.unsqueeze(1), rest)], 1)
    discount = discounts(flight["next", "done"], loss.value_estimator.gamma) * first_episode(flight)
    return (discount * flight["next", "reward"]).sum((1, 2))


@torch.no_grad()
def slopes(
    env: EnvBase,
    loss: objectives.PathwiseLoss,
    start: TensorDictBase,
    changed: Callable[[Tensor], dict[str, Tensor]],
    steps: int,
    size: float,
) -> Tensor:
    """Measure the gradient of the discounted return in the first action by central differences: (envs, 4).

    Args:
        env: as many environments as there are starts.
        start: the tensordict of a reset (envs).
        changed: what a change (4) of the first action puts into ``start``, such as ``{"action": action + change}``.
        steps: control steps whose rewards count, up to the end of the episode.
        size: the change of each component up and down.
    """

    def flown(change: Tensor) -> Tensor:
        return return_of(env, loss, start.clone().update(changed(change)), steps)

    changes = size * torch.eye(env.action_spec.shape[-1], dtype=env.action_spec.dtype)
    return torch.stack([flown(x) - flown(-x) for x in changes], -1) / (2.0 * size)


# -- ascent: the losses of the trial -----------------------------------------------------------------------------------


def ascent(args: Namespace) -> None:
    """Gradients of ABPT, SHAC and BPTT, and of their parts, at the last policies of runs: which of them climb?

    A folder <task>/<variant>/seed<seed> names the variant of a run of the trial.
    """
    torch.set_num_threads(1)
    path = args.data / "ascent.csv"
    done, seen = kept(path, "task", "variant", "seed"), []
    for checkpoint in tqdm(args.checkpoints):
        saved = read_checkpoint(checkpoint)
        cfg = OmegaConf.create(saved["config"])
        if cfg.algorithm not in ("bptt", "abpt", "shac"):
            sys.exit(f"{checkpoint} was trained with {cfg.algorithm}; choose runs of bptt, abpt, shac.")
        if cfg.normalize:
            sys.exit(f"{checkpoint} was trained under a normaliser; choose runs with normalize=false.")
        variant = next((x for x in checkpoint.resolve().parts[-3:-2] if x in VARIANTS), cfg.algorithm)
        own = {"task": cfg.task, "variant": variant, "seed": str(cfg.seed)}
        if own in seen:
            sys.exit(f"{checkpoint} is a second {' '.join(own.values())}: give each a --data folder of its own.")
        seen.append(own)
        if tuple(own.values()) not in done:
            add_rows(path, [own | examine(saved, cfg, args.states, args.repeats, args.steps, args.size)])


def examine(saved: dict, cfg: DictConfig, states: int, repeats: int, steps: int, size: float) -> dict[str, str]:
    """Compare the gradients of a checkpoint with the measured one: mean cosines over states."""
    env, loss, start, rollout = flown_on(saved, cfg, states, repeats)
    estimated = estimates(loss, rollout)
    action = rollout["action"][:, 0].detach()
    true = slopes(env, loss, start, lambda change: {"action": action + change}, steps, size)

    def each(x: Tensor) -> Tensor:  # per state: the mean over repeats, whose noise differs
        return x.unflatten(0, (states, -1)).mean(1)

    def agreement(one: Tensor, other: Tensor) -> float:
        return cosine_similarity(one, other, dim=-1).mean().item()

    halves = true.unflatten(0, (states, 2, -1)).mean(2).unbind(1)
    row = {"explained_variance": saved["rows"][-1].get("train/explained_variance", math.nan)}
    row["halves"] = agreement(*halves)
    row |= {name: agreement(each(x), each(true)) for name, x in estimated.items()}
    return {name: f"{x:.4g}" for name, x in row.items()}


def estimates(loss: objectives.PathwiseLoss, rollout: TensorDictBase) -> dict[str, Tensor]:
    """Compute the gradients of the objective and of its parts in the first action: each (envs, 4)."""
    parts = loss.objective_parts(rollout)
    parts |= {"objective": sum(parts.values())}
    return {name: action_gradient(part.sum(), rollout["action"])[:, 0] for name, part in parts.items()}


# -- phases: the hybrid ------------------------------------------------------------------------------------------------

SHARES = (0.05, 0.125, 0.25, 0.5, 0.75, 1.0)  # of the steps of a run
GRADIENTS = {"pathwise": "pathwise", "score": "score function", "hybrid": "hybrid", "halves": "two halves"}


def phases(args: Namespace) -> None:
    """Gradients of the hybrid in phases of its training on racing: the pathwise one, the score function's, and both.

    All become gradients in the policy's weights over the visited states. The change of an action is one of the mean
    before the tanh, and is carried into later noise.
    """
    torch.set_num_threads(1)
    path = args.data / "phases.csv"
    done = kept(path, "task", "seed", "share")
    todo = [
        (task, seed, args.output / task / f"seed{seed}", shares)
        for seed in args.seeds
        for task in args.tasks
        if (shares := [share for share in SHARES if (task, str(seed), str(share)) not in done])
    ]
    side_by_side(args.cores, [(train_in_phases, *job[:3], args.quick) for job in todo])
    for task, seed, folder, shares in todo:
        for share in shares:
            saved = read_checkpoint(folder / f"phase_{share}.pt")
            row = {"task": task, "seed": seed, "share": share, "steps": saved["rows"][-1]["steps"]}
            add_rows(path, [row | examine_phase(saved, args.states, args.repeats, args.steps, args.size)])


def train_in_phases(task: str, seed: int, folder: Path, quick: bool) -> None:
    """Train once, or resume it, and keep a copy of the checkpoint in each phase."""
    with ThreadPoolExecutor(1) as pool:
        own = [*overrides(task, "hybrid"), f"seed={seed}", *(QUICK if quick else ())]
        training = pool.submit(run, "hybrid", own, folder)
        while not training.done():
            keep_phase(folder)
            time.sleep(1.0)
        training.result()
    keep_phase(folder)


def keep_phase(folder: Path) -> None:
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


def examine_phase(saved: dict, states: int, repeats: int, steps: int, size: float) -> dict[str, str]:
    """Compare the gradients of a checkpoint of the hybrid with the measured one, in the policy's weights."""
    cfg = OmegaConf.create(saved["config"])
    env, loss, start, rollout = flown_on(saved, cfg, states, repeats)
    weight = loss.pathwise_weight.clamp(0.0, 1.0).item()
    loss.pathwise_weight.fill_(1.0)  # so that the whole pathwise gradient is written
    loss.decay = 1.0
    data = loss.write_targets(rollout)
    predicted = (data["location_gradient"] * (data["latent"] - data["loc"])).sum(-1, keepdim=True)
    predicted = predicted - predicted.mean()
    first, advantage, predicted = data[:, 0], (data["advantage"] + predicted)[:, 0], predicted[:, 0]
    pathwise, noise = first["location_gradient"], first["latent"] - first["loc"]
    score = noise / first["scale"] ** 2  # the gradient of the logarithm of the density
    true = slopes(env, loss, start, in_the_mean(first, cfg.actor.noise_correlation), steps, size)
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


def in_the_mean(first: TensorDictBase, rho: float) -> Callable[[Tensor], dict[str, Tensor]]:
    """A change of the mean of an action before the tanh, for :func:`slopes`; noise of correlation rho carries it on."""
    deviation = first["scale"] / (1.0 - rho**2) ** 0.5
    return lambda change: {"action": (first["latent"] + change).tanh(), "noise": first["noise"] + change / deviation}


def weight_gradient(loss: objectives.HybridLoss, data: TensorDictBase, direction: Tensor) -> Tensor:
    """The gradient in the policy's weights (parameters) from that in the means of its actions, (envs, 4)."""
    loc, _ = distribution_again(loss.actor_network, loss.actor_network_params, data)
    weights = list(loss.actor_network_params.parameters())
    grads = torch.autograd.grad((loc * direction).sum(), weights)
    return torch.cat([x.flatten() for x in grads])


# -- terms of the rewards ----------------------------------------------------------------------------------------------

REWARDS = {  # task and name of a reward: options of the environment
    ("hovering", ""): {},
    ("tracking", ""): {},
    ("landing", ""): {},
    ("racing", "position"): {"reward": "position"},
    ("racing", "velocity"): {"reward": "velocity"},
    ("racing", "velocity, log bonus"): {"reward": "velocity", "gate_bonus": "log"},
    ("racing", "velocity, reciprocal bonus"): {"reward": "velocity", "gate_bonus": "reciprocal"},
}


def audit_tasks(
    own: Iterable[str] = (), num_envs: int = 64, horizon: int = 32, seed: int = 0
) -> list[dict[str, object]]:
    """Audit each reward, and those of tasks of your own, where every term is paid: a row for each term."""
    rows = []
    for (task, name), options in {**REWARDS, **{(task, ""): {} for task in own}}.items():
        torch.manual_seed(seed)
        env = make_env(task, num_envs=num_envs, seed=seed, **options)
        td = env.reset()
        state, some = td["state"], slice(0, num_envs // 2)
        if task == "landing":  # near the pad: some will land, and some crash
            near = state["target"][some] + 0.4 * torch.rand(num_envs // 2, 3)
            state["position"][some] = near + env.tensor([0, 0, 0.1])
            state["velocity"][some] = torch.linspace(-1.0, 0.0, num_envs // 2)[:, None] * env.tensor([0.0, 0.0, 1.0])
        if task == "racing":  # on the way through the next gate
            way = torch.nn.functional.normalize(state["target"] - state["position"], dim=-1)
            state["position"][some] = (state["target"] - torch.rand(num_envs, 1) * way)[some]
            state["velocity"][some] = 2.0 * way[some]
        actor = make_actor(env)
        rollout, _ = differentiable_rollout(env, actor, env.reset(td, set_state=True), horizon)
        audit = audit_reward(rollout, actor, gamma=0.99)
        rows += [{"task": task, "reward": name, "term": term, **asdict(found)} for term, found in audit.items()]
    return rows
