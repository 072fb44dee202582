"""Train the losses on two environments that are independent of this package: are they what they say?

The pendulum is TorchRL's, for 200 steps; random actions reach about -1200, and a policy that swings it up about -150.
Balance is a task of VMAS (Bettini et al. 2022, arXiv:2207.03530; ``pip install vmas``): three agents carry a bar with a
ball on it to a goal, by contact; the reward is a hundred times the way that the ball comes closer, and -10 if it falls.

All losses have the same networks, rates and number of steps; the hybrid, PPO and train.py have those of their recipes.
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable, Iterable
from itertools import product
from typing import cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import Compose, PendulumEnv, RewardScaling, Transform, TransformedEnv, VmasEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss, SoftUpdate
from torchrl.objectives.value import GAE

from benchmarks.paper.flights import about
from benchmarks.paper.running import composed, kept
from torchrl_quad import differentiable_rollout, make_actor, make_qvalue, make_value, objectives
from torchrl_quad.files import add_rows
from torchrl_quad.training.building import (
    AdaptiveOptimizer,
    Optimizer,
    ReturnScale,
    average_policy,
    make_loss,
    make_policy,
    minibatches,
    network,
    shuffled,
)
from torchrl_quad.training.loop import backward

ENVS, HORIZON, EPISODE, EPISODES = 256, 16, 200, 256
STEPS = 1_024_000  # of all environments together
LEARNING_RATE = 1e-2  # of actor and critics; it falls to a fiftieth
LOSSES = {
    "bptt": lambda env, actor: objectives.BPTTLoss(actor),
    "shac": lambda env, actor: objectives.SHACLoss(actor, make_value(env)),
    "sapo": lambda env, actor: objectives.SAPOLoss(actor, make_value(env), alpha_init=1e-2),
    "ahac": lambda env, actor: objectives.AHACLoss(actor, make_value(env), horizon=HORIZON),
    "abpt": lambda env, actor: objectives.ABPTLoss(actor, make_qvalue(env)),
    "abpt-simulated": lambda env, actor: objectives.ABPTLoss(actor, make_qvalue(env), simulated_steps=1),
}
NAMES = (*LOSSES, "hybrid", "ppo", "train")


class CosSin(Transform):
    """The angle as cosine and sine, which do not jump at half a turn, and the speed: ``observation`` (*, 3)."""

    def _call(self, td: TensorDictBase) -> TensorDictBase:
        th, thdot = td["th"], td["thdot"]
        return td.set("observation", torch.stack((th.cos(), th.sin(), thdot / 8), -1))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, spec: Composite) -> Composite:
        return spec.set("observation", Unbounded((*spec.shape, 3)))


class Pendulum:
    """TorchRL's pendulum, with an observation."""

    reward = 0.1  # times the cost: returns near ten are quicker to learn than those near 100

    def __init__(self, seed: int, count: int):
        self.count = count
        self.env = TransformedEnv(PendulumEnv(seed=seed), Compose(CosSin(), RewardScaling(0.0, self.reward)))

    def starts(self, count: int | None = None) -> TensorDictBase:
        return self.env.reset(PendulumEnv.gen_params(batch_size=[count or self.count]), set_state=False)

    def go_on(self, carry: TensorDictBase) -> TensorDictBase:
        """Reset half of the pendulums: an episode never ends."""
        fresh = self.starts(len(carry) // 2)
        going_on = carry.select(*fresh.keys())[torch.randperm(len(carry))[: len(carry) - len(fresh)]]
        return torch.cat((fresh, going_on))


class OneBody(Transform):
    """The agents of a team as one body: ``observation`` and ``action`` of all, and the ``reward`` that they share."""

    def __init__(self, agents: int):
        super().__init__(in_keys_inv=[("agents", "action")], out_keys_inv=["action"])
        self.agents = agents

    def _step(self, td: TensorDictBase, next_td: TensorDictBase) -> TensorDictBase:
        return self._reset(td, next_td).set("reward", next_td["agents", "reward"].mean(-2))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set("observation", tensordict_reset["agents", "observation"].flatten(-2))

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        return action.unflatten(-1, (self.agents, -1))

    def transform_observation_spec(self, spec: Composite) -> Composite:
        each = spec["agents", "observation"]
        return spec.set("observation", Unbounded((*each.shape[:-2], each.shape[-2:].numel())))

    def transform_input_spec(self, spec: Composite) -> Composite:
        actions = spec["full_action_spec"]
        each = actions["agents", "action"].shape
        del actions["agents"]
        actions["action"] = Bounded(-1.0, 1.0, (*each[:-2], each[-2:].numel()))
        return spec

    def transform_reward_spec(self, spec: Composite) -> Composite:
        each = spec["agents", "reward"].shape
        del spec["agents"]
        spec["reward"] = Unbounded((*each[:-2], 1))
        return spec


class Balance:
    """VMAS's balance, whose three agents one policy moves. It keeps its state, with the graph, to itself."""

    reward = 0.1

    def __init__(self, seed: int, count: int):
        env = VmasEnv("balance", num_envs=count, continuous_actions=True, grad_enabled=True, seed=seed)
        self.env = TransformedEnv(env, Compose(OneBody(env.n_agents), RewardScaling(0.0, self.reward)))

    def starts(self) -> TensorDictBase:
        return self.env.reset()

    def go_on(self, carry: TensorDictBase) -> TensorDictBase:
        """Cut the graph, and reset half of the environments."""
        env = self.env.base_env
        env.world.zero_grad()
        for name, value in vars(env.scenario).items():
            if isinstance(value, Tensor):
                setattr(env.scenario, name, value.detach())
        return self.env.reset(carry.set("_reset", torch.rand(len(carry), 1) < 0.5))


ENVIRONMENTS = {"pendulum": Pendulum, "balance": Balance}


def mean_return(environment: str, actor: torch.nn.Module) -> float:
    place = ENVIRONMENTS[environment](10_000, EPISODES)
    mode = ExplorationType.DETERMINISTIC
    with torch.no_grad():
        flight, _ = differentiable_rollout(place.env, actor, place.starts(), EPISODE, exploration_type=mode)
    done = flight["next", "done"].int()
    first = done.cumsum(1) - done == 0  # an episode that ends early is followed by another
    return (flight["next", "reward"] * first).sum(1).mean().item() / place.reward


def learn(
    environment: str,
    place: Pendulum | Balance,
    actor: torch.nn.Module,
    iterate: Callable[[float, TensorDictBase], tuple[TensorDictBase, TensorDictBase]],
    optimizers: Iterable[Optimizer] = (),
) -> tuple[float, float, float]:
    """Train by iterations: the mean returns before and after, and the seconds.

    ``iterate`` takes the share of all steps that have been flown, and where the next horizon starts; flies and learns,
    and gives the rollout and where it ended. The optimizers take their rates by that share.
    """
    before, start = mean_return(environment, actor), time.process_time()
    carry, steps = place.starts(), 0
    while steps < STEPS:
        for optimizer in optimizers:
            optimizer.anneal(steps / STEPS * optimizer.iterations)
        rollout, carry = iterate(steps / STEPS, carry)
        steps += rollout.numel()
        carry = place.go_on(carry)
    return before, mean_return(environment, actor), time.process_time() - start


def train(name: str, environment: str, seed: int) -> tuple[float, float, float]:
    torch.manual_seed(seed)
    place = ENVIRONMENTS[environment](seed, ENVS)
    actor = make_actor(place.env, scale_init=0.3, return_log_prob=name == "sapo")
    loss = LOSSES[name](place.env, actor)
    loss.make_value_estimator(gamma=0.98)
    target = SoftUpdate(loss, tau=0.05) if name in ("shac", "abpt", "abpt-simulated") else None
    extra = [loss.log_alpha] if loss.automatic_alpha else []
    actor_optimizer = torch.optim.Adam([*loss.actor_network_params.parameters(), *extra], betas=(0.7, 0.95))
    critic = [] if name == "bptt" else list(getattr(loss, f"{loss.critic_name}_params").parameters())
    critic_optimizer = torch.optim.Adam(critic, betas=(0.7, 0.95)) if critic else None

    def iterate(share: float, carry: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        for optimizer in filter(None, (actor_optimizer, critic_optimizer)):
            optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - 0.98 * share)
        rollout, carry = differentiable_rollout(place.env, actor, carry, getattr(loss, "horizon", HORIZON))
        loss_actor, metadata = loss.loss_actor(rollout)
        actor_optimizer.zero_grad()
        (loss_actor + metadata.get("loss_alpha", 0.0)).backward()
        norm = torch.nn.utils.clip_grad_norm_(loss.actor_network_params.parameters(), 0.5)
        if norm.isfinite():  # the derivative of a contact is NaN now and then
            actor_optimizer.step()
        if critic_optimizer:
            data = loss.write_value_target(rollout.detach()).reshape(-1)
            for _ in range(8):
                batch = data[torch.randint(len(data), (512,))]
                optimise(critic_optimizer, getattr(loss, loss.critic_loss_key)(batch)[0], 1.0)
                if target:
                    target.step()
        if name == "ahac":
            loss.adapt_horizon(metadata["stiffness"])
        return rollout, carry

    return learn(environment, place, actor, iterate)


def optimise(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
    backward(loss, optimizer, max_grad_norm)
    optimizer.step()


def set_up(
    algorithm: str, environment: str, seed: int, *overrides: str
) -> tuple[DictConfig, Pendulum | Balance, ProbabilisticActor, ValueOperator]:
    """Compose the configuration of a recipe, and build its environment and networks."""
    torch.manual_seed(seed)
    cfg = composed(algorithm, [f"total_steps={STEPS}", *overrides])
    place = ENVIRONMENTS[environment](seed, cfg.num_envs)
    return cfg, place, make_policy(cfg, place.env), make_value(place.env, **network(cfg, "critic"))


def train_hybrid(environment: str, seed: int) -> tuple[float, float, float]:
    """Train with the settings and the loop of recipes/hybrid.py."""
    cfg, place, actor, value = set_up("hybrid", environment, seed, f"num_envs={min(128, ENVS)}")
    loss = objectives.HybridLoss(actor, value, **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    actor_optimizer, critic_optimizer = AdaptiveOptimizer(cfg, "actor", loss), Optimizer(cfg, "critic", loss)

    def iterate(_: float, carry: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        rollout, carry = differentiable_rollout(place.env, actor, carry, cfg.horizon)
        moved = 0.0
        for batch in shuffled(loss.write_targets(rollout).exclude("next"), cfg.batch_size, cfg.epochs):
            losses = loss(batch)
            if moved < actor_optimizer.limit:
                moved = max(moved, losses["kl"].item())
                optimise(actor_optimizer, losses["loss_actor"], cfg.actor.max_grad_norm)
            optimise(critic_optimizer, losses["loss_value"], cfg.critic.max_grad_norm)
        actor_optimizer.adapt(moved)
        return rollout, carry

    return learn(environment, place, actor, iterate, (actor_optimizer, critic_optimizer))


def train_ppo(environment: str, seed: int) -> tuple[float, float, float]:
    """Train with the loop of recipes/ppo.py, its settings for racing, and the horizons of the hybrid."""
    more = (f"num_envs={min(128, ENVS)}", "tuned=ppo_racing", "horizon=32", "batch_size=1024")
    cfg, place, actor, value = set_up("ppo", environment, seed, *more)
    advantage = GAE(gamma=cfg.gamma, lmbda=cfg.critic.lmbda, value_network=value, vectorized=False)
    loss = ClipPPOLoss(actor, value, **cfg.loss)
    actor_optimizer, critic_optimizer = Optimizer(cfg, "actor", actor), Optimizer(cfg, "critic", value)

    def iterate(_: float, carry: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        with torch.no_grad():
            rollout, carry = differentiable_rollout(place.env, actor, carry, cfg.horizon)
            advantage(rollout)
        moved = 0.0
        for batch in shuffled(rollout.exclude("next"), cfg.batch_size, cfg.epochs):
            losses = loss(batch)
            if moved < cfg.actor.max_kl:
                moved = abs(losses["kl_approx"].item())
                loss_actor = losses["loss_objective"] + losses["loss_entropy"]
                optimise(actor_optimizer, loss_actor, cfg.actor.max_grad_norm)
            optimise(critic_optimizer, losses["loss_critic"], cfg.critic.max_grad_norm)
        return rollout, carry

    return learn(environment, place, actor, iterate, (actor_optimizer, critic_optimizer))


def train_one_setting(environment: str, seed: int) -> tuple[float, float, float]:
    """Train with the settings and the loop of recipes/train.py, but the near discount throughout, as nothing counts as
    solved here, and with the fresh starts of the others."""
    cfg, place, actor, _ = set_up("train", environment, seed)
    loss = make_loss(objectives.AHACLoss, cfg, place.env, actor, make_value, horizon=cfg.horizon)
    loss.value_estimator.gamma.fill_(2.0 * cfg.gamma - 1.0)
    actor_optimizer, critic_optimizer = Optimizer(cfg, "actor", loss), Optimizer(cfg, "critic", loss)
    scale, average = ReturnScale(loss), cast("AveragedModel", average_policy(cfg, actor))

    def iterate(_: float, carry: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        actor_optimizer.param_groups[0]["lr"] *= loss.lr_factor
        actor.scale_noise(loss.lr_factor)
        rollout, carry = differentiable_rollout(place.env, actor, carry, loss.horizon)
        scale.divide(rollout)
        target, metrics = loss.better_actions(rollout, cfg.step)
        data = rollout.detach().set("action_target", target)
        for _ in range(cfg.epochs):
            if backward(loss.loss_fit(data), actor_optimizer, cfg.actor.max_grad_norm)[1].isfinite():
                actor_optimizer.step()
        average.update_parameters(actor)
        data = loss.write_value_target(data)
        scale.update(data)
        share = max(actor_optimizer.param_groups[0]["lr"] / (loss.lr_factor * actor_optimizer.first_lr), 1 / 3)
        for batch in minibatches(data, cfg.critic, 1 / share):
            optimise(critic_optimizer, loss.loss_value(batch)[0], cfg.critic.max_grad_norm)
        loss.adapt_horizon(metrics["stiffness"])
        return rollout, carry

    return learn(environment, place, average.module, iterate, (actor_optimizer, critic_optimizer))


OWN_LOOPS = {"hybrid": train_hybrid, "ppo": train_ppo, "train": train_one_setting}


def elsewhere(args: Namespace) -> None:
    """The losses on TorchRL's pendulum and VMAS's balance."""
    torch.set_num_threads(1)
    path = args.data / "elsewhere.csv"
    done = kept(path, "environment", "loss", "seed")
    for seed, environment, name in product(args.seeds, args.environments, args.losses):
        if (environment, name, str(seed)) not in done:
            flown = OWN_LOOPS[name](environment, seed) if name in OWN_LOOPS else train(name, environment, seed)
            numbers = {x: f"{y:.6g}" for x, y in zip(("before", "after", "seconds"), flown, strict=True)}
            own = {"environment": environment, "loss": name, "seed": seed}
            add_rows(path, [own | numbers | {"steps": STEPS} | about()])
