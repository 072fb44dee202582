"""What is not the algorithm: building, descending, evaluating, logging, and what a run leaves behind."""

from __future__ import annotations

import contextlib
import copy
import csv
import json
import math
import os
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import lr_scheduler
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from torchrl_quad import ObservationNormalizer, differentiable_rollout, make_actor, make_env
from torchrl_quad.objectives import PathwiseLoss
from torchrl_quad.render import plot_flight, plot_learning_curve

UNITS = {  # how the metrics of an evaluation are printed: factor and unit
    "position_error": (100, "cm (median)"),
    "tracking_rmse": (100, "cm (median)"),
    "landing_speed": (1, "m/s"),
    "gates_passed": (1, "gates"),
    "lap_time": (1, "s"),
    "return": (1, ""),
}


def set_up(cfg: DictConfig) -> tuple[EnvBase, TensorDictModuleBase]:
    """Seed everything, and build the environment and the policy of a configuration."""
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    if cfg.normalize:
        cfg.actor.input_scale = 1.0
        if "critic" in cfg:
            cfg.critic.input_scale = 1.0
    env = build_env(cfg, cfg.num_envs, cfg.seed, compile=cfg.compile)
    return env, make_policy(cfg, env)


def build_env(cfg: DictConfig, num_envs: int, seed: int, *, compile: bool = False) -> EnvBase:
    """The environment of a configuration, under a normaliser where it asks for one."""
    options = OmegaConf.to_container(cfg.env, resolve=True)
    env = make_env(cfg.task, num_envs=num_envs, device=cfg.device, seed=seed, compile=compile, **options)
    return TransformedEnv(env, ObservationNormalizer(env)) if cfg.normalize else env


def update_normalizer(env: EnvBase, rollout: TensorDictBase) -> None:
    """Show the observations of a horizon to the normaliser, where there is one."""
    if isinstance(env, TransformedEnv):
        env.transform.update(rollout)


def make_policy(cfg: DictConfig, env: EnvBase) -> TensorDictModuleBase:
    """The policy of a configuration; it writes log-probabilities where the loss needs them."""
    log_prob = cfg.algorithm == "ppo" or cfg.loss.alpha != 0
    return make_actor(env, **network(cfg.actor), scale_init=cfg.actor.scale_init, return_log_prob=log_prob)


def network(cfg: DictConfig) -> dict[str, Any]:
    """The sizes of a network as keywords of ``make_actor``, ``make_value`` and ``make_qvalue``."""
    activation = getattr(nn, cfg.activation)
    return {"num_cells": list(cfg.num_cells), "activation": activation, "input_scale": cfg.input_scale}


def actor_parameters(loss: PathwiseLoss) -> list[nn.Parameter]:
    """The policy's parameters, and the entropy coefficient where it is learned."""
    return [*loss.actor_network_params.parameters(), *([loss.log_alpha] if loss.automatic_alpha else [])]


def make_optimizer(
    cfg: DictConfig, parameters: Iterable[nn.Parameter], iterations: int
) -> tuple[torch.optim.Adam, lr_scheduler.LRScheduler]:
    """Adam, and the schedule that takes its learning rate from ``lr`` to ``final_lr`` over the run.

    Raises:
        ValueError: the schedule is unknown.
    """
    optimizer = torch.optim.Adam(parameters, cfg.lr, betas=tuple(cfg.betas))
    steps, decay = max(iterations - 1, 1), cfg.final_lr / cfg.lr
    schedules = {
        "constant": lambda: lr_scheduler.ConstantLR(optimizer, 1.0),
        "linear": lambda: lr_scheduler.LinearLR(optimizer, 1.0, decay, steps),
        "exponential": lambda: lr_scheduler.ExponentialLR(optimizer, decay ** (1 / steps)),
        "cosine": lambda: lr_scheduler.CosineAnnealingLR(optimizer, steps, cfg.final_lr),
    }
    if cfg.schedule not in schedules:
        raise ValueError(f"Unknown schedule {cfg.schedule!r}. Choose from: {', '.join(schedules)}.")
    return optimizer, schedules[cfg.schedule]()


def descend(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> Tensor:
    """One clipped step down the loss; returns the norm of the gradient before clipping.

    Raises:
        RuntimeError: the gradient is not finite; the parameters are left as they were.
    """
    optimizer.zero_grad()
    loss.backward()
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(parameters, max_grad_norm, error_if_nonfinite=True)
    optimizer.step()
    return norm


def restart(env: EnvBase, carry: TensorDictBase, fraction: float) -> TensorDictBase:
    """Give up a random fraction of the flights, and start them afresh; the others go on."""
    fresh = TensorDict({"state": env.sample_initial_state(env.num_envs)}, env.batch_size)
    chosen = torch.rand(carry.shape, device=carry.device) < fraction
    return env.reset(fresh.where(chosen, carry.select("state")), set_state=True)


def minibatches(rollout: TensorDictBase, cfg: DictConfig) -> Iterator[TensorDictBase]:
    """``cfg.updates`` random batches of ``cfg.batch_size`` steps from a rollout."""
    steps = rollout.reshape(-1)
    for _ in range(cfg.updates):
        yield steps[torch.randint(len(steps), (cfg.batch_size,), device=steps.device)]


def shuffled(rollout: TensorDictBase, batch_size: int) -> Iterable[TensorDictBase]:
    """All steps of a rollout once, in random batches."""
    steps = rollout.reshape(-1)
    return steps[torch.randperm(len(steps), device=steps.device)].split(batch_size)


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
    rng = getattr(env, "base_env", env).rng
    state = rng.get_state()
    rng.manual_seed(seed)
    try:
        yield
    finally:
        rng.set_state(state)


class Run:
    """The bookkeeping of a training run: ``for _ in run: ...; run.record(...)``.

    Counts steps and seconds of training, evaluates every ``eval.interval`` iterations, and each time writes a row of
    metrics and a checkpoint. The checkpoint holds the networks as they are, and the best policy so far: the one with
    the greatest return in these evaluations. That one is flown at the end, on other starts. Leaves in the run's folder:
    ``metrics.csv``, ``checkpoint.pt``, ``summary.json``, ``learning_curve.png`` and ``flight.png``. Set-up, compilation
    and the final evaluation are outside the seconds.

    Raises:
        FileExistsError: the folder holds the metrics of another run.
    """

    def __init__(self, cfg: DictConfig, env: EnvBase, actor: TensorDictModuleBase, **modules: nn.Module) -> None:
        self.cfg, self.actor, self.modules = cfg, actor, {"actor": actor, **modules}
        if cfg.normalize:
            self.modules["normalizer"] = env.transform
        self.folder = Path(HydraConfig.get().runtime.output_dir)
        if (self.folder / "metrics.csv").exists():
            raise FileExistsError(f"{self.folder} holds the results of another run. Choose another hydra.run.dir.")
        self.iterations = iterations(cfg)
        self.steps_per_iteration = cfg.num_envs * cfg.horizon
        self.env = env
        self.logger = None
        if cfg.logger.backend:
            wandb = {"mode": cfg.logger.mode, "project": cfg.logger.project, "config": OmegaConf.to_container(cfg)}
            name = f"{cfg.task}_{cfg.algorithm}_seed{cfg.seed}"
            self.logger = get_logger(cfg.logger.backend, str(self.folder), name, wandb_kwargs=wandb)
        self.recorded: dict[str, list[float]] = defaultdict(list)
        self.seconds = 0.0
        self.best: dict[str, Any] = {"return": -math.inf}

    def __iter__(self) -> Iterator[int]:
        if self.cfg.compile:
            self._warm_up()
        bar = tqdm(
            total=self.iterations * self.steps_per_iteration, unit="step", unit_scale=True, desc=self.cfg.algorithm
        )
        with bar:
            start = time.perf_counter()
            for iteration in range(self.iterations):
                yield iteration
                bar.update(self.steps_per_iteration)
                if (iteration + 1) % self.cfg.eval.interval == 0 or iteration + 1 == self.iterations:
                    with drawing_from(self.env, self.cfg.eval.seed):
                        metrics, _ = evaluate(self.env, self.actor)
                    self.seconds = time.perf_counter() - start
                    self._write_row(iteration + 1, metrics)
                    self._keep_best(metrics["eval/return"], (iteration + 1) * self.steps_per_iteration)
                    self._save((iteration + 1) * self.steps_per_iteration)
                    bar.set_postfix(
                        {"return": f"{metrics['eval/return']:.2f}", "success": f"{metrics['eval/success']:.0%}"}
                    )
        self._finish()

    def record(self, **metrics: Tensor | float) -> None:
        """Keep what this iteration measured; a row holds the mean since the row before."""
        for name, value in metrics.items():
            group = "grad" if name.startswith("grad_") else "train"
            self.recorded[f"{group}/{name.removeprefix('grad_')}"].append(
                float(value.detach()) if isinstance(value, Tensor) else value
            )

    def _keep_best(self, value: float, steps: int) -> None:
        """Copy the policy if no evaluation has been better."""
        if value >= self.best["return"]:
            policy = {name: self.modules[name] for name in ("actor", "normalizer") if name in self.modules}
            weights = {name: copy.deepcopy(module.state_dict()) for name, module in policy.items()}
            self.best = {"return": value, "steps": steps, **weights}

    def _save(self, steps: int) -> None:
        """Write networks, the best policy and the configuration, all or nothing."""
        weights = {name: module.state_dict() for name, module in self.modules.items()}
        config = OmegaConf.to_yaml(self.cfg, resolve=True)
        temporary = self.folder / "checkpoint.tmp"
        torch.save({"config": config, "steps": steps, "best": self.best, **weights}, temporary)
        os.replace(temporary, self.folder / "checkpoint.pt")

    def _warm_up(self) -> None:
        """Compile the step and its derivative before the clock starts; change nothing."""
        with torch.random.fork_rng(), drawing_from(self.env, self.cfg.eval.seed):
            rollout, _ = differentiable_rollout(self.env, self.actor, None, 2)
            if self.cfg.algorithm != "ppo":  # which takes no derivative of the step
                rollout["next", "reward"].sum().backward()
                self.actor.zero_grad()

    def _write_row(self, iteration: int, evaluation: dict[str, float]) -> None:
        steps = iteration * self.steps_per_iteration
        row = {
            "iteration": iteration,
            "steps": steps,
            "time/seconds": self.seconds,
            "time/steps_per_second": steps / self.seconds,
            **{name: sum(values) / len(values) for name, values in self.recorded.items()},
            **evaluation,
        }
        self.recorded.clear()
        with open(self.folder / "metrics.csv", "a", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(row))
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
        if self.logger is not None:
            for name, value in row.items():
                self.logger.log_scalar(name, value, step=steps)

    def _finish(self) -> None:
        """Final evaluation on fresh starts, pictures, summary."""
        summary, flight = final_evaluation(*load_policy(self.folder / "checkpoint.pt", self.cfg.device))
        steps = {"steps": self.iterations * self.steps_per_iteration, "best_steps": self.best["steps"]}
        summary |= {**steps, "seconds": round(self.seconds, 2)}
        write_json(self.folder / "summary.json", summary)
        plot_learning_curve(self.folder / "metrics.csv", self.folder / "learning_curve.png")
        plot_flight(flight, self.folder / "flight.png", control_dt=self.cfg.env.control_dt)
        if self.cfg.logger.backend == "wandb":
            self.logger.experiment.finish()
        print_summary(summary, self.folder)


def iterations(cfg: DictConfig) -> int:
    """Rollouts in a run: as many as fit into ``total_steps``, and at least one."""
    return max(cfg.total_steps // (cfg.num_envs * cfg.horizon), 1)


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


def load_policy(
    checkpoint: Path, device: str = "cpu"
) -> tuple[DictConfig, TensorDictModuleBase, dict[str, Tensor] | None]:
    """The configuration, the best policy, and the state of its normaliser, where there is one, of a checkpoint.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a checkpoint of these recipes.
    """
    if not checkpoint.is_file():
        raise FileNotFoundError(f"No checkpoint at {checkpoint}. Train one first: python recipes/abpt.py")
    try:
        state = torch.load(checkpoint, map_location=device, weights_only=True)
        cfg = OmegaConf.create(state["config"])
        cfg.device = device
        actor = make_policy(cfg, build_env(cfg, 1, 0))
        actor.load_state_dict(state["best"]["actor"])
    except Exception as error:
        raise ValueError(f"{checkpoint} is not a checkpoint that these recipes can read: {error}") from error
    return cfg, actor, state["best"].get("normalizer")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file, all or nothing; what is not a number becomes null."""
    temporary = path.with_suffix(".tmp")
    content = {key: None if isinstance(x, float) and math.isnan(x) else x for key, x in content.items()}
    temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    os.replace(temporary, path)


def print_summary(summary: dict[str, Any], folder: Path | None = None) -> None:
    """Say how well the policy flies, and where the results are."""
    print(
        f"\n{summary['algorithm']} on {summary['task']}, seed {summary['seed']}, {summary['episodes']} fresh episodes:"
    )
    print(f"  success       {summary['success']:.1%}")
    print(f"  crashes       {summary['crash']:.1%}")
    for name, (scale, unit) in UNITS.items():
        if not math.isnan(summary.get(name, math.nan)):
            print(f"  {name.replace('_', ' '):13s} {scale * summary[name]:.2f} {unit}")
    if "seconds" in summary:
        print(f"  training      {summary['steps']:,} steps in {summary['seconds']:.1f} s")
    if folder is not None:
        print(f"  results in    {folder}")
