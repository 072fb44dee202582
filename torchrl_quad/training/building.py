"""Building blocks of a recipe: environment, networks, optimisers, minibatches."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import lr_scheduler
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.objectives import SoftUpdate

from torchrl_quad import ObservationNormalizer, TrustRegion, make_actor, make_env, make_visual_actor
from torchrl_quad.errors import UserValueError
from torchrl_quad.objectives import PathwiseLoss
from torchrl_quad.training.processes import cat_all, mean_of_all, rank, world_size

SEEDS_PER_RUN = 10_000  # the process of rank r draws from seed + r * this


def set_up(cfg: DictConfig) -> tuple[EnvBase, TensorDictModuleBase]:
    """Seed everything, and build the environment and the policy.

    Under ``torchrun`` each process has environments and random numbers of its own, and networks that start equal.
    """
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    env = build_env(cfg, cfg.num_envs, own_seed(cfg), compile=cfg.compile)
    return env, make_policy(cfg, env)


def own_seed(cfg: DictConfig) -> int:
    """The seed of this process."""
    return cfg.seed + SEEDS_PER_RUN * rank()


def build_env(cfg: DictConfig, num_envs: int, seed: int, *, compile: bool = False) -> EnvBase:
    """Build the environment of a configuration, with a normaliser if it asks for one."""
    options = OmegaConf.to_container(cfg.env, resolve=True)
    env = make_env(cfg.task, num_envs=num_envs, device=cfg.device, seed=seed, compile=compile, **options)
    return TransformedEnv(env, ObservationNormalizer(env)) if cfg.normalize else env


def make_policy(cfg: DictConfig, env: EnvBase) -> TensorDictModuleBase:
    """Build the policy of a configuration; it writes log-probabilities if the loss needs them.

    It sees where the environment has a camera, unless the configuration blinds it.
    """
    log_prob = "entropy_bonus" in cfg.loss or cfg.loss.get("alpha", 0) != 0  # of PPO, or of an entropy bonus
    noise = {name: cfg.actor[name] for name in ("scale_init", "noise_correlation", "learn_scale")}
    if not sees(cfg, env):
        return make_actor(env, **network(cfg, "actor"), **noise, return_log_prob=log_prob)
    sight = {name: cfg.actor[name] for name in ("recurrent", "hidden_size")} | {"channels": list(cfg.actor.channels)}
    return make_visual_actor(env, **network(cfg, "actor"), **noise, **sight, return_log_prob=log_prob)


def sees(cfg: DictConfig, env: EnvBase) -> bool:
    """Whether the policy of a configuration reads the images of a camera."""
    return cfg.actor.vision and "depth" in env.observation_spec


def network(cfg: DictConfig, name: str, env: EnvBase | None = None) -> dict[str, Any]:
    """The options of a network as keywords of ``make_actor``, ``make_value`` and ``make_qvalue``.

    A critic, which is given the environment, also reads where the nearest obstacle is, of which a policy has images.
    """
    section = cfg[name]
    scale = 1.0 if cfg.normalize else section.input_scale
    activation = getattr(nn, section.activation)
    options = {"num_cells": list(section.num_cells), "activation": activation, "input_scale": scale}
    if env is not None and "obstacle" in env.observation_spec:
        options |= {"in_keys": ["observation", "obstacle"], "input_scale": [scale, 1.0]}
    return options


def actor_parameters(loss: PathwiseLoss) -> list[dict[str, Any]]:
    """The policy's parameters and, if it is learned, the entropy coefficient: groups that are clipped apart."""
    learned = [loss.log_alpha] if loss.automatic_alpha else []
    return [{"params": own} for own in (list(loss.actor_network_params.parameters()), learned) if own]


def iterations(cfg: DictConfig) -> int:
    """Rollouts in a run: as many as fit into ``total_steps``, and at least one."""
    return max(cfg.total_steps // (cfg.num_envs * cfg.horizon * world_size()), 1)


def make_optimizer(
    cfg: DictConfig, parameters: Iterable[nn.Parameter] | list[dict[str, Any]], iterations: int
) -> tuple[torch.optim.Adam, lr_scheduler.LRScheduler]:
    """Build Adam, and the schedule that takes its learning rate from ``lr`` to ``final_lr`` over the run."""
    optimizer = torch.optim.Adam(parameters, cfg.lr, betas=tuple(cfg.betas), fused=True)
    last, decay = max(iterations - 1, 1), cfg.final_lr / cfg.lr
    factor = {  # a function of the finished share of the run, so that a run can be resumed and made longer
        "constant": lambda share: 1.0,
        "linear": lambda share: 1.0 + share * (decay - 1.0),
        "exponential": lambda share: decay**share,
        "cosine": lambda share: decay + (1.0 - decay) * 0.5 * (1.0 + math.cos(math.pi * share)),
    }[cfg.schedule]
    return optimizer, lr_scheduler.LambdaLR(optimizer, lambda iteration: factor(min(iteration / last, 1.0)))


def advance(schedule: lr_scheduler.LRScheduler, iteration: float) -> None:
    """Set a schedule to an iteration, counted from 0, which may lie between two of them."""
    schedule.last_epoch = iteration - 1
    schedule.step()


class AdaptiveRate:
    """The learning rate of a policy that a horizon moves by about ``max_kl``, which falls to 2 % over the run.

    A horizon that moves it beyond 1.5 of the bound divides the rate by 1.5, and one that stays below 2/3 of it
    multiplies it. The rate keeps between 1e-6 and 20 times the first one.

    Args:
        optimizer: of the policy.
        max_kl: the KL divergence.
        iterations: of the run.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, max_kl: float, iterations: int) -> None:
        if max_kl is None:
            raise UserValueError("actor.max_kl=null: this recipe sets its rate by it. Write a number; 0.25 is usual.")
        self.optimizer, self.max_kl, self.iterations = optimizer, max_kl, iterations
        self.bounds = (1e-6, 20.0 * optimizer.param_groups[0]["lr"])

    def limit(self, iteration: int) -> float:
        """How far the horizon of an iteration, counted from 0, may move the policy."""
        return 1.5 * self.max_kl * max(1.0 - iteration / self.iterations, 0.02)

    def step(self, iteration: int, moved: float) -> None:
        """Adapt the rate, which the optimizer keeps, to how far the horizon has moved the policy."""
        low, high = self.bounds
        for group in self.optimizer.param_groups:
            if moved > self.limit(iteration):
                group["lr"] = max(group["lr"] / 1.5, low)
            elif moved < self.limit(iteration) / 2.25:
                group["lr"] = min(group["lr"] * 1.5, high)


class TargetUpdate(SoftUpdate):
    """TorchRL's soft update of a loss's target critic, with all its parameters in one call."""

    def step(self) -> None:
        """Move the target by ``tau`` towards the critic."""
        name = f"{self.loss_module.critic_name}_params"
        target, critic = (getattr(self.loss_module, f"{prefix}{name}").values(True, True) for prefix in ("target_", ""))
        get_ema_multi_avg_fn(self.eps)(list(target), list(critic), None)


def average_policy(cfg: DictConfig, actor: TensorDictModuleBase) -> AveragedModel | None:
    """The running average of a policy's weights, where the configuration wants one.

    It spans about the share ``actor.average`` of the iterations so far, so it lengthens with the run and forgets the
    start (the power function average of Karras et al. 2024, arXiv:2312.02696).
    """
    share = cfg.actor.average
    if share is None:
        return None

    def update(average: list[Tensor], now: list[Tensor], updates: Tensor) -> None:
        get_ema_multi_avg_fn((1 - 1 / (updates.item() + 1)) ** (1 / share))(average, now, updates)

    return AveragedModel(actor, multi_avg_fn=update)


def trust_region(cfg: DictConfig, actor: TensorDictModuleBase) -> TrustRegion:
    """The bound of a configuration on what an update does to the policy; all processes shorten alike."""
    return TrustRegion(actor, cfg.actor.max_kl, average=mean_of_all)


def update_normalizer(env: EnvBase, rollout: TensorDictBase) -> None:
    """Update the normaliser, if there is one, with the observations of a horizon from all processes."""
    if isinstance(env, TransformedEnv):
        seen = cat_all(rollout["next", "observation"].detach())
        env.transform.update(TensorDict({("next", "observation"): seen}))


def minibatches(rollout: TensorDictBase, cfg: DictConfig) -> Iterator[TensorDictBase]:
    """``cfg.updates`` random batches of ``cfg.batch_size`` steps from a rollout."""
    steps = rollout.reshape(-1)
    for _ in range(cfg.updates):
        yield steps[torch.randint(len(steps), (cfg.batch_size,), device=steps.device)]


def shuffled(rollout: TensorDictBase, batch_size: int, epochs: int) -> Iterator[TensorDictBase]:
    """All steps of a rollout ``epochs`` times, in random batches; of a policy that remembers, whole horizons."""
    remembers, horizon = "is_init" in rollout, rollout.shape[-1]
    steps = rollout if remembers else rollout.reshape(-1)
    size = max(batch_size // horizon, 1) if remembers else batch_size
    for _ in range(epochs):
        yield from steps[torch.randperm(len(steps), device=steps.device)].split(size)
