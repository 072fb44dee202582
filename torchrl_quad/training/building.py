"""Building blocks of a recipe: environment, networks, loss, optimisers, minibatches."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

import torch
import torch.distributed as dist
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SoftUpdate

from torchrl_quad import ObservationNormalizer, QuadrotorEnv, TrustRegion, make_actor, make_env, make_visual_actor
from torchrl_quad.data.unwrap import base_env, leaf, observed
from torchrl_quad.errors import UserValueError
from torchrl_quad.objectives import PathwiseLoss, SHACLoss
from torchrl_quad.options import argument_names, imported
from torchrl_quad.training.configuration import plain

SEEDS_PER_PROCESS = 10_000
SMOOTHING = 0.05  # how much of the scale of returns is new in each iteration
_Loss = TypeVar("_Loss", bound=PathwiseLoss)


def rank() -> int:
    """Which of the processes that torchrun has started this is, and 0 without it; 0 logs, evaluates and saves."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """How many processes train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def cat_all(x: Tensor) -> Tensor:
    """The tensors of all processes, of one shape, concatenated along the first axis."""
    if world_size() == 1:
        return x
    parts = [torch.empty_like(x) for _ in range(world_size())]
    dist.all_gather(parts, x.contiguous())
    return torch.cat(parts)


def mean_of_all(x: Tensor) -> Tensor:
    """The mean of a scalar over the processes."""
    return cat_all(x.detach().view(1)).mean()


def of_first(x: Any) -> Any:
    """What the first of the processes has."""
    values = [x]
    if world_size() > 1:
        dist.broadcast_object_list(values)
    return values[0]


def own_seed(cfg: DictConfig) -> int:
    """The seed of this process."""
    return cfg.seed + SEEDS_PER_PROCESS * rank()


def set_up(cfg: DictConfig) -> tuple[EnvBase, TensorDictModule]:
    """Seed everything, and build the environment and the policy; in all processes networks start equal."""
    torch.manual_seed(cfg.seed)
    env = build_env(cfg, cfg.num_envs, own_seed(cfg), compile=cfg.compile)
    return env, make_policy(cfg, env)


def build_env(
    cfg: DictConfig, num_envs: int, seed: int, *, compile: bool = False, normalizer: dict[str, Tensor] | None = None
) -> EnvBase:
    """Build the environment of a configuration, with a normaliser, and its state, if it asks for one."""
    options = plain(cfg.env, resolve=True)
    if options.get("disturbances") is None:  # a task may have some of its own
        options.pop("disturbances", None)
    env = make_env(cfg.task, num_envs=num_envs, device=cfg.device, seed=seed, compile=compile, **options)
    if not cfg.normalize:
        return env
    transform = ObservationNormalizer(env)
    if normalizer is not None:
        transform.load_state_dict(normalizer)
    return TransformedEnv(env, transform)


def task_of(env: EnvBase) -> QuadrotorEnv:
    """The task under a normaliser, or the environment itself."""
    return cast("QuadrotorEnv", base_env(env))


def make_policy(cfg: DictConfig, env: EnvBase) -> TensorDictModule:
    """Build the policy of a configuration, which reads the depth images of a camera if there is one."""
    log_prob = "entropy_bonus" in cfg.loss or cfg.loss.get("alpha", 0) != 0  # of PPO, or of an entropy bonus
    options = network(cfg, "actor") | {x: cfg.actor[x] for x in ("scale_init", "noise_correlation", "learn_scale")}
    sees = cfg.actor.vision and "depth" in observed(env)
    remembers = sees or bool(privileged(env))
    options |= {"recurrent": remembers if cfg.actor.recurrent is None else cfg.actor.recurrent}
    options |= {"hidden_size": cfg.actor.hidden_size, "return_log_prob": log_prob}
    if not sees:
        return make_actor(env, **options)
    return make_visual_actor(env, **options, channels=list(cfg.actor.channels))


def network(cfg: DictConfig, name: str, env: EnvBase | None = None) -> dict[str, Any]:
    """The options of a network as keywords of ``make_actor``, ``make_value`` and ``make_qvalue``."""
    section = cfg[name]
    scale = 1.0 if cfg.normalize else section.input_scale
    activation = getattr(nn, section.activation)
    options: dict[str, Any] = {"num_cells": list(section.num_cells), "activation": activation, "input_scale": scale}
    if section.get("in_keys") is not None:  # a critic may know more than the policy, of the state
        keys = [key if isinstance(key, str) else tuple(key) for key in section.in_keys]
        scale = section.input_scale  # one, or one for each entry
        return options | {"in_keys": keys, "input_scale": plain(scale) if OmegaConf.is_list(scale) else scale}
    if env is not None:
        more = privileged(env) | ({"obstacle": 1.0} if "obstacle" in observed(env) else {})  # of which there are images
        options |= {"in_keys": ["observation", *more], "input_scale": [scale, *more.values()]}
    return options


def privileged(env: EnvBase) -> dict[NestedKey, float]:
    """What the critics read and the policy does not, with factors, as the task and its disturbances say."""
    task: Any = base_env(env)
    sources = (task, *getattr(task, "disturbances", {}).values())
    said = [x for source in sources for x in getattr(source, "privileged", {}).items()]
    return {("state", *([key] if isinstance(key, str) else key)): factor for key, factor in said}


def make_loss(
    kind: type[_Loss],
    cfg: DictConfig,
    env: EnvBase,
    actor: TensorDictModule,
    make_critic: Callable[..., Any] | None = None,
    **more: Any,
) -> _Loss:
    """Build the loss of a recipe, or the one that ``loss._target_`` names, with critic and discounts as configured.

    ``make_critic`` is ``make_value`` or ``make_qvalue``; ``more`` are arguments of the loss that override its settings.
    """
    options = plain(cfg.loss, resolve=True) | more
    if path := options.pop("_target_", None):
        kind = imported(path)  # which gets those settings of the recipe's loss that it knows
        options = {name: value for name, value in options.items() if name in argument_names(kind)}
    networks = [actor] if make_critic is None else [actor, make_critic(env, **network(cfg, "critic", env))]
    loss = kind(*networks, **options)
    loss.make_value_estimator(gamma=cfg.gamma, **({"lmbda": cfg.critic.lmbda} if "critic" in cfg else {}))
    return loss


def iterations(cfg: DictConfig) -> int:
    """Rollouts in a run: as many as fit into ``total_steps``, and at least one."""
    return max(cfg.total_steps // (cfg.num_envs * cfg.horizon * world_size()), 1)


def parameter_groups(name: str, module: nn.Module) -> list[dict[str, Any]]:
    """The parameters of a loss's "actor" or "critic", or of a network; groups are clipped apart."""
    network = module
    if isinstance(module, PathwiseLoss):
        network = getattr(module, f"{module.critic_name if name == 'critic' else 'actor_network'}_params")
    learned = name == "actor" and getattr(module, "automatic_alpha", False)  # an entropy coefficient
    return [{"params": list(network.parameters())}, *([{"params": [module.log_alpha]}] if learned else [])]


class Optimizer(torch.optim.Adam):
    """Adam, a schedule that takes its learning rate from ``lr`` to ``final_lr`` over the run, and a bound on gradients.

    The schedule ``inverse_sqrt`` is for runs of any length: constant, and from iteration 150 on one over its root. Only
    a run that comes to its last fifth lets it fall to zero.
    ``name`` is the section of the network, "actor" or "critic"; ``module`` is that network, or the loss that holds it.
    """

    def __init__(self, cfg: DictConfig, name: str, module: nn.Module) -> None:
        section = cfg[name]
        super().__init__(parameter_groups(name, module), section.lr, betas=tuple(section.betas), fused=True)
        self.name, self.max_grad_norm, self.iterations = name, section.max_grad_norm, iterations(cfg)
        self.first_lr, decay = section.lr, section.final_lr / section.lr
        factors: dict[str, Callable[[float], float]] = {
            "constant": lambda share: 1.0,
            "linear": lambda share: 1.0 + share * (decay - 1.0),
            "exponential": lambda share: decay**share,
            "cosine": lambda share: decay + (1.0 - decay) * 0.5 * (1.0 + math.cos(math.pi * share)),
            "inverse_sqrt": lambda share: (
                max(share * (self.iterations - 1) / 150, 1.0) ** -0.5 * min(5.0 * (1.0 - share), 1.0)
            ),
        }
        self.factor = factors[section.schedule]

    def anneal(self, iteration: float, pace: float = 1.0) -> None:
        """Set the learning rate of an iteration, counted from 0, which may lie between two; ``pace`` multiplies it."""
        # A function of the finished share of the run, so that a run can be resumed and made longer.
        share = min(iteration / max(self.iterations - 1, 1), 1.0)
        for group in self.param_groups:
            group["lr"] = self.first_lr * self.factor(share) * pace


class AdaptiveOptimizer(Optimizer):
    """Adam for a policy that a horizon moves by about ``max_kl`` (KL divergence), which falls to 2 % over the run.

    A horizon that moves it beyond 1.5 of the bound, the ``limit`` of this iteration, divides the rate by 1.5, and one
    that stays below 2/3 of it multiplies it. The rate keeps between 1e-6 and 20 times the first one.
    """

    def __init__(self, cfg: DictConfig, name: str, module: nn.Module) -> None:
        super().__init__(cfg, name, module)
        if cfg[name].max_kl is None:
            raise UserValueError(f"{name}.max_kl=null: this recipe sets its rate by it. Write a number; 0.25 is usual.")
        self.max_kl = cfg[name].max_kl

    def anneal(self, iteration: float, pace: float = 1.0) -> None:
        """Set the limit of an iteration, counted from 0; ``pace`` multiplies it."""
        self.limit = 1.5 * self.max_kl * max(1.0 - iteration / self.iterations, 0.02) * pace

    def adapt(self, moved: float) -> None:
        """Adapt the learning rate to how far the horizon has moved the policy."""
        for group in self.param_groups:
            if moved > self.limit:
                group["lr"] = max(group["lr"] / 1.5, 1e-6)
            elif moved < self.limit / 2.25:
                group["lr"] = min(group["lr"] * 1.5, 20.0 * self.first_lr)


class ReturnScale(nn.Module):
    """The root mean square of a run's returns, by which rewards are divided, so that values are about 1 on every task.

    As in PopArt (van Hasselt et al. 2016, arXiv:1602.07714) the last layer of the critics follows a change of the
    scale, so that what they predict in the reward's own unit stays as it was.
    """

    def __init__(self, loss: SHACLoss) -> None:
        super().__init__()
        self.last = list(loss.value_network_params.values(True, True))[-2:]  # weight and bias
        self.register_buffer("square", torch.zeros((), dtype=torch.float64, device=self.last[0].device))
        self.register_buffer("count", torch.zeros_like(self.square))
        self.square: Tensor
        self.count: Tensor

    @property
    def value(self) -> Tensor:
        """What rewards are divided by: 1 before the first update."""
        return torch.where(self.count > 0, self.square.sqrt().clamp_min(1e-8), 1.0)

    def divide(self, rollout: TensorDictBase) -> None:
        """Divide the rewards of a rollout, which keep their graph."""
        reward = leaf(rollout, ("next", "reward"))
        rollout.set(("next", "reward"), reward / self.value.to(reward.dtype))

    @torch.no_grad()
    def update(self, data: TensorDictBase) -> None:
        """Take the value targets of a divided rollout in, and write them in the new unit."""
        before, target = self.value, leaf(data, "value_target")
        self.count += 1
        mean = mean_of_all(target.double().square().nan_to_num(0.0, 0.0, 0.0).mean()) * before**2
        self.square.lerp_(mean, torch.maximum(1 / self.count, torch.full_like(self.count, SMOOTHING)))
        factor = before / self.value
        for x in self.last:
            x.data.mul_(factor)
        data.set("value_target", target * factor.to(target.dtype))


class TargetUpdate(SoftUpdate):
    """TorchRL's soft update of a loss's target critic, with all its parameters in one call."""

    def step(self) -> None:
        """Move the target by ``tau`` towards the critic."""
        name = f"{self.loss_module.critic_name}_params"
        target, critic = (getattr(self.loss_module, f"{prefix}{name}").values(True, True) for prefix in ("target_", ""))
        get_ema_multi_avg_fn(self.eps)(list(target), list(critic), None)


def average_policy(cfg: DictConfig, actor: TensorDictModuleBase) -> AveragedModel | None:
    """The average of a policy's weights over about the share ``actor.average`` of the iterations so far.

    It is the power function average of Karras et al. 2024, arXiv:2312.02696. None where no share is configured.
    """

    def update(average: Any, now: Any, updates: Tensor | int) -> None:
        get_ema_multi_avg_fn((1 - 1 / (int(updates) + 1)) ** (1 / cfg.actor.average))(average, now, updates)

    return None if cfg.actor.average is None else AveragedModel(actor, multi_avg_fn=update)


def trust_region(cfg: DictConfig, actor: TensorDictModule) -> TrustRegion:
    """The bound of a configuration on what an update does to the policy; all processes shorten alike."""
    return TrustRegion(cast("ProbabilisticActor", actor), cfg.actor.max_kl, average=mean_of_all)


def update_normalizer(env: EnvBase, rollout: TensorDictBase) -> None:
    """Update the normaliser, if there is one, with the observations of a horizon from all processes."""
    if isinstance(env, TransformedEnv):
        seen = cat_all(leaf(rollout, ("next", "observation")).detach())
        cast("ObservationNormalizer", env.transform).update(TensorDict({("next", "observation"): seen}))


def minibatches(rollout: TensorDictBase, cfg: DictConfig, times: float = 1.0) -> Iterator[TensorDictBase]:
    """``cfg.updates`` random batches of ``cfg.batch_size`` steps from a rollout, or so many ``times``."""
    steps = cast("TensorDict", rollout.reshape(-1))
    for _ in range(round(times * cfg.updates)):
        yield cast("TensorDict", steps[torch.randint(len(steps), (cfg.batch_size,), device=steps.device)])


def shuffled(rollout: TensorDictBase, batch_size: int, epochs: int) -> Iterator[TensorDictBase]:
    """All steps of a rollout ``epochs`` times, in random batches; of a policy with a memory, whole horizons."""
    steps, size = cast("TensorDict", rollout), max(batch_size // rollout.shape[-1], 1)
    if "is_init" not in rollout:
        steps, size = steps.reshape(-1), batch_size
    for _ in range(epochs):
        mixed = cast("TensorDict", steps[torch.randperm(len(steps), device=steps.device)])
        yield from mixed.split(size)
