"""Evaluation: one episode of the deterministic policy from a fresh start in every environment."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_quad import differentiable_rollout
from torchrl_quad.data.unwrap import group, observed
from torchrl_quad.envs.metrics import EPISODE_METRICS, describe_metric, first_episode
from torchrl_quad.errors import UserValueError
from torchrl_quad.files import replacing
from torchrl_quad.training.building import build_env, make_policy, task_of
from torchrl_quad.training.checkpoints import fits, read_checkpoint, saved_config

SOLVED = 0.98  # of an evaluation's episodes: a run that has never solved so many does not end early


def evaluate(
    env: EnvBase, actor: TensorDictModuleBase, episodes: int | None = None
) -> tuple[dict[str, float], TensorDictBase]:
    """Fly one episode in every environment, again and again until there are as many episodes as asked for.

    Returns the metrics by name, each the mean over the episodes that have one (the median if the task asks for it), and
    the last flight of all environments.
    """
    task, of_episodes = task_of(env), []
    with torch.no_grad():
        for _ in range(rounds(episodes, task.num_envs)):
            flight, _ = differentiable_rollout(
                env, actor, None, task.max_episode_steps, exploration_type=ExplorationType.DETERMINISTIC
            )
            first = first_episode(flight)
            found = task.episode_metrics(flight)
            for name, x in found.items():
                if not isinstance(x, Tensor) or x.shape != flight.shape[:1]:
                    got = tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__
                    raise UserValueError(
                        f"{type(task).__name__}.episode_metrics: {name!r} must have one value for each episode, "
                        f"shape {tuple(flight.shape[:1])}; got {got}. Take the last step of the episode by "
                        "torchrl_quad.envs.metrics.at_episode_end(rollout, x), or write x.flatten()."
                    )
            measured = {f"eval/{name}": x for name, x in found.items()}
            for name, term in group(flight, ("next", "reward_terms")).items():
                measured[f"reward/{name}"] = cast("Tensor", (term * first).sum(1))
            of_episodes.append(measured)
    metrics = {}
    for name in of_episodes[0]:
        section, _, key = name.partition("/")
        values = torch.cat([each[name] for each in of_episodes])
        is_term = section == "reward"
        metrics[name] = values.mean().item() if is_term else describe_metric(key, task.metric_info).summarise(values)
    return metrics, flight


def rounds(episodes: int | None, drones: int) -> int:
    """How often so many drones fly an episode each until there are ``episodes``; once for None."""
    return -(-(episodes or 1) // drones)


def merit(score: Mapping[str, float], patience: float | None) -> tuple[float, float]:
    """What makes a policy the best of a run: first the episodes solved, then the return.

    With a ``patience`` the run goes back to that policy, so the episodes count to the nearest 2 %: otherwise one
    evaluation that happened to solve all would hold it for good. Below a half of them the return alone counts: an
    early policy may solve a fifth, and crash in all others.
    """
    solved = score["solved"]
    if patience is not None and not math.isinf(solved):
        solved = round(50 * solved) / 50 if solved >= 0.5 else 0.0
    return solved, score["return"]


def last_rise(rows: Sequence[Mapping[str, float]]) -> int:
    """The step of a run's last evaluation that rose: by 1 % of the episodes, or of the highest return or the range of
    returns, whichever is larger. A policy that solves more may return less; from there on its return counts."""
    rose, lowest, highest, solved = 0, math.inf, -math.inf, 0.0
    for row in rows:
        if not math.isfinite(found := row["eval/return"]):
            continue
        lowest = min(lowest, found)
        if highest == -math.inf or found > highest + 0.01 * max(highest - lowest, abs(highest)):
            rose, highest = int(row["steps"]), found
        if row["eval/solved"] > solved + 0.01:
            rose, solved, highest = int(row["steps"]), row["eval/solved"], found
    return rose


def stalls(
    rows: Sequence[Mapping[str, float]], since: int, patience: float | None, least: int = 10, solved: float = 0.5
) -> bool:
    """Whether no evaluation has risen since the step ``since``, for ``least`` of them and a share ``patience`` of the
    steps so far; never where ``patience`` is None.

    Returns may stay level for long before a task is solved. So a run that has never solved the share ``solved`` of an
    evaluation's episodes stalls where its return has not risen for half of the steps, and 30 evaluations.
    """
    if patience is None or not rows:
        return False
    if max(row["eval/solved"] for row in rows) < solved:
        patience, least, rows = max(patience, 0.5), max(least, 30), [{**row, "eval/solved": 0.0} for row in rows]
    since = max(since, last_rise(rows))
    return sum(row["steps"] > since for row in rows) >= least and since <= (1.0 - patience) * rows[-1]["steps"]


def has_lost_its_way(rows: Sequence[Mapping[str, float]], patience: float | None) -> bool:
    """Whether a run that once solved half of an evaluation's episodes solves less than two thirds of its best; never
    where ``patience`` is None.

    Its return has also fallen by a tenth of the range: a race that just misses the last gate is not lost.
    """
    known = [row for row in rows if math.isfinite(row["eval/return"])]
    best = max((row["eval/solved"] for row in known), default=0.0)
    if patience is None or not 0.5 <= best > 1.5 * rows[-1]["eval/solved"]:
        return False
    returns = [row["eval/return"] for row in known]
    return not rows[-1]["eval/return"] >= max(returns) - 0.1 * (max(returns) - min(returns))


def has_levelled_off(rows: Sequence[Mapping[str, float]], since: int, patience: float | None) -> bool:
    """Whether a run that has solved a task stalls again after the stall in the step ``since``, with no rise between."""
    has_solved = any(row["eval/solved"] >= SOLVED for row in rows)
    return has_solved and since > last_rise(rows) and stalls(rows, since, patience)


STALLED = 0.25  # by which a stall changes the pace


def next_pace(rows: Sequence[Mapping[str, float]], since: int, patience: float | None) -> float:
    """By what the actor's rate changes after a run's last evaluation: a quarter where it stalls, a half where it has
    lost its way, 2 where it rises.

    A policy from which a run has lost its way a dozen times was good by luck. The run then goes on without it, and the
    rate doubles again.
    """
    if stalls(rows, since, patience):
        return STALLED
    if has_lost_its_way(rows, patience):
        scores = [merit({"solved": row["eval/solved"], "return": row["eval/return"]}, patience) for row in rows]
        best = max((i for i, row in enumerate(rows) if math.isfinite(row["eval/return"])), key=scores.__getitem__)
        lost = sum(has_lost_its_way(rows[:n], patience) for n in range(best + 2, len(rows) + 1))
        return 0.5 if lost < 12 else 2.0
    return 2.0 if patience is not None and last_rise(rows) == rows[-1]["steps"] else 1.0


def looks_ahead(rows: Sequence[Mapping[str, float]], patience: float | None) -> bool:
    """Whether a run has solved nine tenths of an evaluation's episodes, or has once stalled after 30 evaluations or
    more, however few it solved."""
    if any(row["eval/solved"] >= 0.9 for row in rows):
        return True
    return patience is not None and any(stalls(rows[:n], 0, patience, solved=0) for n in range(30, len(rows) + 1))


def why_unsolved(rows: Sequence[Mapping[str, float]], seconds: float, ends_on_success: bool) -> list[str]:
    """What may keep a run of episodes of so many seconds from solving more, besides traps of the reward."""
    if rows[-1]["eval/crash"] >= 0.05:
        return []
    found, usual = [], rows[-1]["eval/return"]  # of episodes few of which are solved
    if last_rise(rows) > rows[0]["steps"] and stalls(rows, 0, 0.33, solved=0.0):
        found.append("reward and success disagree: returns have levelled off, and most episodes are not solved")
    if ends_on_success and usual > 0.0:
        found.append(
            f"loitering pays more: success ends the episode, and one without success returns {usual:.3g}. Let success "
            "pay more than that, or the episode go on"
        )
    limit = f"all episodes end after {seconds:.3g} s: if drones still come nearer then, set max_episode_steps"
    return [*found, limit]


@contextlib.contextmanager
def drawing_from(env: EnvBase, seed: int) -> Iterator[None]:
    """Let the environment draw from a seed for a while; its own random numbers then continue where they were."""
    state = task_of(env).random_state()
    env.set_seed(seed)
    try:
        yield
    finally:
        task_of(env).set_random_state(state)


def final_evaluation(
    cfg: DictConfig,
    actor: TensorDictModuleBase,
    normalizer: dict[str, Tensor] | None,
    episodes: int = 256,
    seed: int = 2_000_000,
) -> tuple[dict[str, Any], TensorDictBase]:
    """Fly a policy over fresh episodes, side by side, from starts drawn with the seed: a summary, and the flight."""
    env = build_env(cfg, episodes, seed, normalizer=normalizer)
    if cfg.compile and "depth" in observed(env):  # rays are five times slower without, which costs more than to compile
        task_of(env).compile()
    metrics, flight = evaluate(env, actor)
    summary = {"task": cfg.task, "algorithm": cfg.algorithm, "seed": cfg.seed, "episodes": episodes}
    return summary | {name.removeprefix("eval/"): v for name, v in metrics.items() if name.startswith("eval/")}, flight


def best_policy(
    cfg: DictConfig, best: Mapping[str, Any], source: Path
) -> tuple[TensorDictModule, dict[str, Tensor] | None]:
    """Build the best policy of a run from its weights, with the state of its normaliser if it has one."""
    if not isinstance(best.get("actor"), Mapping):
        raise UserValueError(
            f"{source} holds no policy: the run stopped before its first evaluation, or no return was finite. Train "
            "longer, or with a lower learning rate."
        )
    with fits(source, "the policy"):
        normalizer = best["normalizer"] if cfg.normalize else None
        actor = make_policy(cfg, build_env(cfg, 1, 0, normalizer=normalizer))
        actor.load_state_dict(best["actor"])
    return actor, normalizer


def load_policy(
    checkpoint: Path, device: str = "cpu", trust: Collection[str] = ()
) -> tuple[DictConfig, TensorDictModule, dict[str, Tensor] | None]:
    """Read the configuration, the best policy, and the state of its normaliser if it has one, from a checkpoint.

    ``trust`` lists the paths of your own classes that the configuration may name, such as "mypackage.WindowEnv".
    """
    saved = read_checkpoint(checkpoint)
    cfg = saved_config(checkpoint, saved, trust)
    cfg.device = device
    return cfg, *best_policy(cfg, saved["best"], checkpoint)


def as_json(summary: Mapping[str, Any]) -> str:
    """A summary as JSON; NaN becomes null."""
    content = {key: None if isinstance(x, float) and math.isnan(x) else x for key, x in summary.items()}
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def title(summary: Mapping[str, Any]) -> str:
    """A summary in one line: "abpt on hovering, seed 0: 100 % of 256 episodes solved"."""
    solved = EPISODE_METRICS["solved"].format(summary["solved"])
    return f"{_name(summary)}: {solved} of {summary['episodes']} episodes solved"


def report(summary: Mapping[str, Any], metric_info: Mapping[str, Any], path: Path) -> None:
    """Write a summary as JSON, and print how well the policy flies, and where the results are."""
    with replacing(path) as temporary:
        temporary.write_text(as_json(summary))
    print(f"\n{_name(summary)}, {summary['episodes']} fresh episodes:")
    for name, metric in metric_info.items():
        if not math.isnan(summary.get(name, math.nan)):
            print(f"  {metric.label:21s} {metric.format(summary[name])}")
    if "seconds" in summary:
        print(f"  {'training':22s}{summary['steps']:,} steps in {summary['seconds']:.1f} s")
    print(f"  {'results in':22s}{path.parent}")


def _name(summary: Mapping[str, Any]) -> str:
    return f"{summary['algorithm']} on {summary['task']}, seed {summary['seed']}"
