"""Gradients of policies, compared with the gradient of the return that the simulator gives, and terms without any.

The true gradient is measured in visited states: each component of the action is changed a little up and down, and the
policy flies on with the same noise, gates and crashes included. The cosine between two halves of the measurement shows
its noise, for which exact gradients do not reach 1 either.
"""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from collections.abc import Iterable
from dataclasses import asdict

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import cosine_similarity
from torchrl.envs import EnvBase
from tqdm import tqdm

from benchmarks.paper.matrix import VARIANTS
from benchmarks.paper.running import kept
from torchrl_quad import audit_reward, differentiable_rollout, make_actor, make_env, make_qvalue, make_value
from torchrl_quad.envs.metrics import first_episode
from torchrl_quad.files import add_rows
from torchrl_quad.objectives import PathwiseLoss
from torchrl_quad.objectives.calls import action_gradient, discounts
from torchrl_quad.training.building import build_env, make_loss, make_policy
from torchrl_quad.training.checkpoints import read_checkpoint
from torchrl_quad.training.schema import LOSSES

SEED = 3_000_000


def ascent(args: Namespace) -> None:
    """Gradients of ABPT, SHAC and BPTT, and of their parts, at the last policies of runs: which of them climb?

    A folder <task>/<variant>/seed<seed> names the variant of a run of the trial.
    """
    torch.set_num_threads(1)
    path = args.data / "ascent.csv"
    for checkpoint in tqdm(args.checkpoints):
        saved = read_checkpoint(checkpoint)
        cfg = OmegaConf.create(saved["config"])
        if cfg.algorithm not in ("bptt", "abpt", "shac"):
            sys.exit(f"{checkpoint} was trained with {cfg.algorithm}; choose runs of bptt, abpt, shac.")
        if cfg.normalize:
            sys.exit(f"{checkpoint} was trained under a normaliser; choose runs with normalize=false.")
        variant = next((x for x in checkpoint.resolve().parts[-3:-2] if x in VARIANTS), cfg.algorithm)
        own = {"task": cfg.task, "variant": variant, "seed": str(cfg.seed)}
        if tuple(own.values()) not in kept(path, *own):
            add_rows(path, [own | examine(saved, cfg, args.states, args.repeats, args.steps, args.size)])


def examine(saved: dict, cfg: DictConfig, states: int, repeats: int, steps: int, size: float) -> dict[str, str]:
    """Compare the gradients of a checkpoint with the measured one: mean cosines over states that its policy visits.

    From each state the policy flies ``repeats`` times, each time with its own noise.
    """
    torch.manual_seed(SEED)
    env = build_env(cfg, states * repeats, SEED)
    critic = {"bptt": None, "abpt": make_qvalue, "shac": make_value}[cfg.algorithm]
    loss = make_loss(LOSSES[cfg.algorithm], cfg, env, make_policy(cfg, env), critic)
    loss.load_state_dict(saved["stateful"][0])
    scout = build_env(cfg, states, SEED)
    with torch.no_grad():
        flight, _ = differentiable_rollout(scout, loss.actor_network, None, env.max_episode_steps // 2)
    drawn = flight[torch.arange(states), torch.randint(flight.shape[1], (states,))].select("state")
    start = env.reset(drawn.repeat_interleave(repeats), set_state=True)
    rollout, _ = differentiable_rollout(env, loss.actor_network, start, cfg.horizon)
    estimated = estimates(loss, rollout)
    true = slopes(env, loss, start, rollout["action"][:, 0].detach(), steps, size)

    def each(x: Tensor) -> Tensor:  # per state: the mean over repeats, whose noise differs
        return x.unflatten(0, (states, -1)).mean(1)

    def agreement(one: Tensor, other: Tensor) -> float:
        return cosine_similarity(one, other, dim=-1).mean().item()

    row = {"explained_variance": saved["rows"][-1].get("train/explained_variance", math.nan)}
    row["halves"] = agreement(*true.unflatten(0, (states, 2, -1)).mean(2).unbind(1))
    row |= {name: agreement(each(x), each(true)) for name, x in estimated.items()}
    return {name: f"{x:.4g}" for name, x in row.items()}


def estimates(loss: PathwiseLoss, rollout: TensorDictBase) -> dict[str, Tensor]:
    """Compute the gradients of the objective and of its parts in the first action: each (envs, 4)."""
    parts = loss.objective_parts(rollout)
    parts |= {"objective": sum(parts.values())}
    return {name: action_gradient(part.sum(), rollout["action"])[:, 0] for name, part in parts.items()}


@torch.no_grad()
def slopes(env: EnvBase, loss: PathwiseLoss, start: TensorDictBase, action: Tensor, steps: int, size: float) -> Tensor:
    """Measure the gradient of the discounted return in the first action by central differences: (envs, 4).

    Args:
        start: the tensordict of a reset (envs).
        steps: control steps whose rewards count, up to the end of the episode.
        size: the change of each component up and down.
    """

    def return_of(change: Tensor) -> Tensor:
        torch.manual_seed(SEED)  # the policy, which flies on, has the same noise in each call
        first = env.step(start.clone().set("action", action + change))
        rest, _ = differentiable_rollout(env, loss.actor_network, env.step_mdp(first), steps - 1)
        flight = torch.cat([x.select(("next", "reward"), ("next", "done")) for x in (first.unsqueeze(1), rest)], 1)
        discount = discounts(flight["next", "done"], loss.value_estimator.gamma) * first_episode(flight)
        return (discount * flight["next", "reward"]).sum((1, 2))

    changes = size * torch.eye(env.action_spec.shape[-1], dtype=env.action_spec.dtype)
    return torch.stack([return_of(x) - return_of(-x) for x in changes], -1) / (2.0 * size)


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
