"""Evaluation: one episode of the deterministic policy from a fresh start in every environment."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_quad import differentiable_rollout
from torchrl_quad.envs.metrics import EPISODE_METRICS, describe_metric, first_episode
from torchrl_quad.errors import UserValueError
from torchrl_quad.files import replacing
from torchrl_quad.training.building import build_env, make_policy
from torchrl_quad.training.checkpoints import fits, read_checkpoint, saved_config


def evaluate(
    env: EnvBase, actor: TensorDictModuleBase, episodes: int | None = None
) -> tuple[dict[str, float], TensorDictBase]:
    """Fly one episode in every environment, again and again until there are as many episodes as asked for.

    Returns:
        the metrics by name, each the mean over the episodes that have one (the median if the task asks for it), and the
        last flight of all environments.
    """
    of_episodes = []
    with torch.no_grad():
        for _ in range(rounds(episodes, env.batch_size[0])):
            flight, _ = differentiable_rollout(
                env, actor, None, env.max_episode_steps, exploration_type=ExplorationType.DETERMINISTIC
            )
            first = first_episode(flight)
            rewards = {name: (term * first).sum(1) for name, term in flight["next", "reward_terms"].items()}
            measured = {"eval": env.episode_metrics(flight), "reward": rewards}
            of_episodes.append(TensorDict(measured, env.batch_size))
    measured = torch.cat(of_episodes)
    metrics = {
        f"eval/{name}": describe_metric(name, env.metric_info).summarise(values)
        for name, values in measured["eval"].items()
    }
    return metrics | {f"reward/{name}": term.mean().item() for name, term in measured["reward"].items()}, flight


def rounds(episodes: int | None, drones: int) -> int:
    """How often so many drones fly an episode each until there are as many as asked for; once where nothing is."""
    return -(-(episodes or 1) // drones)


@contextlib.contextmanager
def drawing_from(env: EnvBase, seed: int) -> Iterator[None]:
    """Let the environment draw from a seed for a while; afterwards it goes on as if it had drawn nothing."""
    state = env.random_state()
    env.set_seed(seed)
    try:
        yield
    finally:
        env.set_random_state(state)


def final_evaluation(
    cfg: DictConfig,
    actor: TensorDictModuleBase,
    normalizer: dict[str, Tensor] | None,
    episodes: int = 256,
    seed: int = 2_000_000,
) -> tuple[dict[str, Any], TensorDictBase]:
    """Fly a policy over fresh episodes, side by side, from starts drawn with the seed: a summary, and the flight."""
    env = build_env(cfg, episodes, seed)
    if normalizer is not None:
        env.transform.load_state_dict(normalizer)
    metrics, flight = evaluate(env, actor)
    summary = {"task": cfg.task, "algorithm": cfg.algorithm, "seed": cfg.seed, "episodes": episodes}
    return summary | {name.removeprefix("eval/"): v for name, v in metrics.items() if name.startswith("eval/")}, flight


def best_policy(
    cfg: DictConfig, best: Mapping[str, Any], source: Path
) -> tuple[TensorDictModuleBase, dict[str, Tensor] | None]:
    """Build the best policy of a run from its weights, with the state of its normaliser if it has one.

    Raises:
        ValueError: there is none.
    """
    if not isinstance(best.get("actor"), Mapping):
        raise UserValueError(
            f"{source} holds no policy: the run stopped before its first evaluation, or no return was finite. Train "
            "longer, or with a lower learning rate."
        )
    env = build_env(cfg, 1, 0)
    actor, normalizer = make_policy(cfg, env), best.get("normalizer")
    with fits(source, "the policy"):
        actor.load_state_dict(best["actor"])
        if cfg.normalize:
            env.transform.load_state_dict(normalizer)
    return actor, normalizer if cfg.normalize else None


def load_policy(
    checkpoint: Path, device: str = "cpu", task: str | None = None
) -> tuple[DictConfig, TensorDictModuleBase, dict[str, Tensor] | None]:
    """Read the configuration, the best policy, and the state of its normaliser if it has one, from a checkpoint.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a checkpoint that these recipes can read, or holds no policy.
    """
    saved = read_checkpoint(checkpoint)
    cfg = saved_config(checkpoint, saved, task, "own_task")
    cfg.device = device
    return cfg, *best_policy(cfg, saved["best"], checkpoint)


def as_json(summary: Mapping[str, Any]) -> str:
    """A summary as JSON; what is not a number becomes null."""
    content = {key: None if isinstance(x, float) and math.isnan(x) else x for key, x in summary.items()}
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def write_summary(path: Path, summary: Mapping[str, Any]) -> None:
    """Write a summary as JSON."""
    with replacing(path) as temporary:
        temporary.write_text(as_json(summary))


def title(summary: Mapping[str, Any]) -> str:
    """A summary in one line: "abpt on hovering, seed 0: 100 % of 256 episodes solved"."""
    solved = EPISODE_METRICS["solved"].format(summary["solved"])
    return (
        f"{summary['algorithm']} on {summary['task']}, seed {summary['seed']}: {solved} of {summary['episodes']} "
        "episodes solved"
    )


def print_summary(summary: Mapping[str, Any], metric_info: Mapping[str, Any], folder: Path) -> None:
    """Print how well the policy flies, and where the results are."""
    run = f"{summary['algorithm']} on {summary['task']}, seed {summary['seed']}"
    print(f"\n{run}, {summary['episodes']} fresh episodes:")
    for name, metric in metric_info.items():
        if not math.isnan(summary.get(name, math.nan)):
            print(f"  {metric.label:22s}{metric.format(summary[name])}")
    if "seconds" in summary:
        print(f"  {'training':22s}{summary['steps']:,} steps in {summary['seconds']:.1f} s")
    print(f"  {'results in':22s}{folder}")
