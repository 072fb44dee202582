"""What the recipes build, and what they do beside the algorithm: networks, optimisers, minibatches, evaluation."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from checkpoints import read_checkpoint, take_over
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import lr_scheduler
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_quad import ObservationNormalizer, differentiable_rollout, make_actor, make_env
from torchrl_quad.objectives import PathwiseLoss

SEEDS_PER_RUN = 10_000  # a process of rank r draws from seed + r * this

# -- building ----------------------------------------------------------------------------------------------------------


def set_up(cfg: DictConfig) -> tuple[EnvBase, TensorDictModuleBase]:
    """Resume where asked to, join the other processes, seed everything, and build the environment and the policy.

    Under ``torchrun`` each process has environments and random numbers of its own, and networks that start equal.
    """
    take_over(cfg)
    torch.set_num_threads(cfg.threads)
    if "RANK" in os.environ and not dist.is_initialized():
        if ":" in str(cfg.device):
            raise ValueError(f"Under torchrun each process has a GPU of its own: write device=cuda, not {cfg.device}.")
        gpu = cfg.device == "cuda"
        if gpu:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("nccl" if gpu else "gloo")
    torch.manual_seed(cfg.seed)
    env = build_env(cfg, cfg.num_envs, own_seed(cfg), compile=cfg.compile)
    return env, make_policy(cfg, env)


def rank() -> int:
    """Which of the processes this is; 0 logs, evaluates and saves."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """How many processes train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def own_seed(cfg: DictConfig) -> int:
    """The seed of this process."""
    return cfg.seed + SEEDS_PER_RUN * rank()


def build_env(cfg: DictConfig, num_envs: int, seed: int, *, compile: bool = False) -> EnvBase:
    """The environment of a configuration, under a normaliser where it asks for one."""
    options = OmegaConf.to_container(cfg.env, resolve=True)
    env = make_env(cfg.task, num_envs=num_envs, device=cfg.device, seed=seed, compile=compile, **options)
    return TransformedEnv(env, ObservationNormalizer(env)) if cfg.normalize else env


def make_policy(cfg: DictConfig, env: EnvBase) -> TensorDictModuleBase:
    """The policy of a configuration; it writes log-probabilities where the loss needs them."""
    log_prob = cfg.algorithm == "ppo" or cfg.loss.alpha != 0
    return make_actor(env, **network(cfg, "actor"), scale_init=cfg.actor.scale_init, return_log_prob=log_prob)


def network(cfg: DictConfig, name: str) -> dict[str, Any]:
    """The sizes of a network as keywords of ``make_actor``, ``make_value`` and ``make_qvalue``."""
    net = cfg[name]
    scale = 1.0 if cfg.normalize else net.input_scale
    return {"num_cells": list(net.num_cells), "activation": getattr(nn, net.activation), "input_scale": scale}


def actor_parameters(loss: PathwiseLoss) -> list[nn.Parameter]:
    """The policy's parameters, and the entropy coefficient where it is learned."""
    return [*loss.actor_network_params.parameters(), *([loss.log_alpha] if loss.automatic_alpha else [])]


def iterations(cfg: DictConfig) -> int:
    """Rollouts in a run: as many as fit into ``total_steps``, and at least one."""
    return max(cfg.total_steps // (cfg.num_envs * cfg.horizon * world_size()), 1)


def make_optimizer(
    cfg: DictConfig, parameters: Iterable[nn.Parameter], iterations: int
) -> tuple[torch.optim.Adam, lr_scheduler.LRScheduler]:
    """Adam, and the schedule that takes its learning rate from ``lr`` to ``final_lr`` over the run.

    Raises:
        ValueError: the schedule is unknown.
    """
    optimizer = torch.optim.Adam(parameters, cfg.lr, betas=tuple(cfg.betas))
    last, decay = max(iterations - 1, 1), cfg.final_lr / cfg.lr
    schedules = {  # functions of the share of the run that is over, so that a run can be resumed and made longer
        "constant": lambda share: 1.0,
        "linear": lambda share: 1.0 + share * (decay - 1.0),
        "exponential": lambda share: decay**share,
        "cosine": lambda share: decay + (1.0 - decay) * 0.5 * (1.0 + math.cos(math.pi * share)),
    }
    if cfg.schedule not in schedules:
        raise ValueError(f"Unknown schedule {cfg.schedule!r}. Choose from: {', '.join(schedules)}.")
    schedule = schedules[cfg.schedule]
    return optimizer, lr_scheduler.LambdaLR(optimizer, lambda iteration: schedule(min(iteration / last, 1.0)))


# -- experience --------------------------------------------------------------------------------------------------------


def update_normalizer(env: EnvBase, rollout: TensorDictBase) -> None:
    """Show the observations of a horizon, those of all processes, to the normaliser, where there is one."""
    if not isinstance(env, TransformedEnv):
        return
    seen = rollout.select(("next", "observation")).detach()
    if world_size() > 1:
        mine = seen["next", "observation"].contiguous()
        parts = [torch.empty_like(mine) for _ in range(world_size())]
        dist.all_gather(parts, mine)
        seen = TensorDict({("next", "observation"): torch.cat(parts)})
    env.transform.update(seen)


def minibatches(rollout: TensorDictBase, cfg: DictConfig) -> Iterator[TensorDictBase]:
    """``cfg.updates`` random batches of ``cfg.batch_size`` steps from a rollout."""
    steps = rollout.reshape(-1)
    for _ in range(cfg.updates):
        yield steps[torch.randint(len(steps), (cfg.batch_size,), device=steps.device)]


def shuffled(rollout: TensorDictBase, batch_size: int) -> Iterable[TensorDictBase]:
    """All steps of a rollout once, in random batches."""
    steps = rollout.reshape(-1)
    return steps[torch.randperm(len(steps), device=steps.device)].split(batch_size)


# -- descending --------------------------------------------------------------------------------------------------------


def backward(loss: Tensor, optimizer: torch.optim.Optimizer, max_grad_norm: float) -> tuple[Tensor, Tensor]:
    """The gradients of a loss, averaged over the processes and then clipped.

    Returns:
        the loss and the norm of its gradient before clipping, of all processes together.
    """
    optimizer.zero_grad()
    loss.backward()
    parameters = [p for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
    loss = loss.detach()
    if world_size() > 1:
        tensors = [loss, *(p.grad for p in parameters)]
        flat = nn.utils.parameters_to_vector(tensors)
        dist.all_reduce(flat)
        nn.utils.vector_to_parameters(flat / world_size(), tensors)
    return loss, nn.utils.clip_grad_norm_(parameters, max_grad_norm)


# -- evaluation --------------------------------------------------------------------------------------------------------


def evaluate(env: EnvBase, actor: TensorDictModuleBase) -> tuple[dict[str, float], TensorDictBase]:
    """One episode of the deterministic policy from a fresh start in every environment.

    Returns:
        metrics by name, each the mean over the episodes that have one (the median of errors), and the flight.
    """
    with torch.no_grad():
        flight, _ = differentiable_rollout(
            env, actor, None, env.max_episode_steps, exploration_type=ExplorationType.DETERMINISTIC
        )
    metrics = {
        f"eval/{name}": (value.nanmedian() if name in ("position_error", "tracking_rmse") else value.nanmean()).item()
        for name, value in env.episode_metrics(flight).items()
    }
    first = env.first_episode(flight)
    for name, term in flight["next", "reward_terms"].items():
        metrics[f"reward/{name}"] = (term * first).sum(1).mean().item()
    return metrics, flight


@contextlib.contextmanager
def drawing_from(env: EnvBase, seed: int) -> Iterator[None]:
    """Let the environment draw from a seed for a while, and go on afterwards as if nothing had been drawn."""
    rng = generator(env)
    state = rng.get_state()
    rng.manual_seed(seed)
    try:
        yield
    finally:
        rng.set_state(state)


def generator(env: EnvBase) -> torch.Generator:
    """The environment's own random generator, also under transforms."""
    return getattr(env, "base_env", env).rng


def final_evaluation(
    cfg: DictConfig,
    actor: TensorDictModuleBase,
    normalizer: dict[str, Tensor] | None,
    episodes: int = 256,
    seed: int = 2_000_000,
) -> tuple[dict[str, Any], TensorDictBase]:
    """The deterministic policy over fresh episodes: a summary, and the flight."""
    env = build_env(cfg, episodes, seed)
    if normalizer is not None:
        env.transform.load_state_dict(normalizer)
    metrics, flight = evaluate(env, actor)
    summary = {"task": cfg.task, "algorithm": cfg.algorithm, "seed": cfg.seed, "episodes": episodes}
    return summary | {name.removeprefix("eval/"): v for name, v in metrics.items() if name.startswith("eval/")}, flight


def load_policy(checkpoint: Path, device: str = "cpu") -> tuple[DictConfig, TensorDictModuleBase, dict | None]:
    """The configuration, the best policy, and the state of its normaliser, where there is one, of a checkpoint.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a checkpoint that these recipes can read, or holds no policy.
    """
    saved = read_checkpoint(checkpoint)
    cfg = OmegaConf.create(saved["config"])
    cfg.device = device
    if "actor" not in saved["best"]:
        raise ValueError(f"{checkpoint} holds no policy that was evaluated: the run was stopped before.")
    actor = make_policy(cfg, build_env(cfg, 1, 0))
    actor.load_state_dict(saved["best"]["actor"])
    return cfg, actor, saved["best"].get("normalizer")
