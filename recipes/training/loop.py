"""The bookkeeping of a training run: what it logs, what it saves, how it goes on after a stop."""

from __future__ import annotations

import copy
import csv
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from checkpoints import FORMAT, read_checkpoint, replacing, revision, write_json
from common import (
    backward,
    drawing_from,
    evaluate,
    final_evaluation,
    generator,
    iterations,
    load_policy,
    own_seed,
    rank,
    world_size,
)
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.record.loggers import Logger, get_logger
from tqdm import tqdm

import torchrl_quad
from torchrl_quad import (
    VisitedStateBuffer,
    audit_reward,
    compare_gradients,
    differentiable_rollout,
    gradient_statistics,
)
from torchrl_quad.objectives import PathwiseLoss
from torchrl_quad.render import animate_flight, plot_episode, plot_flight, plot_learning_curve, write_replay

CELL = 0.5  # [m]: train/start_cells counts the cubes of this size in which horizons have started
UNITS = {  # how the metrics of an evaluation are printed: factor and unit
    "position_error": (100, "cm (median)"),
    "tracking_rmse": (100, "cm (median)"),
    "landing_speed": (1, "m/s"),
    "gates_passed": (1, "gates"),
    "lap_time": (1, "s"),
    "return": (1, ""),
}


class Run:
    """A training run: ``for _ in run: ...``, with ``run.carry``, ``run.descend(...)`` and ``run.record(...)`` in it.

    Counts steps and seconds of training, evaluates every ``eval.interval`` iterations, and each time writes a row of
    metrics and a checkpoint. The checkpoint holds all that the run needs to go on exactly as if it had not stopped
    (``resume=PATH``), and the best policy so far: the one with the greatest return in these evaluations. That one is
    flown at the end, on other starts. Leaves in the run's folder: ``config.yaml``, ``metrics.csv``, ``checkpoint.pt``,
    ``summary.json``, ``learning_curve.png``, and the flight as ``flight.png``, ``flight.gif``, ``flight.html`` and
    ``episode.pdf``. The seconds are those of the loop alone: set-up, compilation, evaluations and checkpoints are
    outside. Processor seconds are those in which its threads ran: with one, what it takes on a core of its own. Of
    several processes the first evaluates, logs and saves.

    Args:
        cfg: the configuration, as ``set_up`` left it.
        env: the environment.
        actor: the policy, whose parameters are those of the loss.
        loss: all that is trained.
        parts: optimisers and schedules: what else has a ``state_dict`` and changes in training.
        buffer: of visited states, where the algorithm has one.

    Raises:
        ValueError: the checkpoint to resume does not fit.

    Attributes:
        carry: where the next horizon starts, to be set by the algorithm in each iteration.
    """

    def __init__(
        self,
        cfg: DictConfig,
        env: EnvBase,
        actor: TensorDictModuleBase,
        loss: nn.Module,
        parts: Sequence[Any],
        buffer: VisitedStateBuffer | None = None,
    ) -> None:
        self.cfg, self.env, self.actor, self.loss, self.buffer = cfg, env, actor, loss, buffer
        self.parts = [loss, *parts, *([env.transform] if cfg.normalize else [])]
        self.iterations = iterations(cfg)
        self.audits = cfg.get("diagnostics", 0)  # a run begun before there were any has no such setting
        self.steps_per_iteration = cfg.num_envs * cfg.horizon * world_size()
        self.recorded: dict[str, list[float]] = defaultdict(list)
        self.starts: list[Tensor] = []  # positions in which the horizons since the last row have started
        self.rows: list[dict[str, float]] = []  # of metrics.csv
        self.done, self.seconds, self.processor_seconds, self.skipped = 0, 0.0, 0.0, 0
        self.best: dict[str, Any] = {"return": -math.inf}
        if world_size() > 1:
            torch.manual_seed(own_seed(cfg))  # the networks are made, and equal
        saved = read_checkpoint(Path(cfg.resume)) if cfg.resume else None
        self.revision = revision()
        if saved is None:
            self.folder = Path(HydraConfig.get().runtime.output_dir)
            self.carry = env.reset()
        else:
            self.folder, before = Path(cfg.resume).parent, saved["revision"]
            self.revision = before if self.revision in before else f"{before}, then {self.revision}"
            self._load(saved)
        self.is_over = self.done >= self.iterations and (self.folder / "summary.json").exists()
        self.logger = None
        if rank() == 0 and not self.is_over:
            for name in ("summary.json", "failure.pt"):  # of the run before it was made longer, or went on
                (self.folder / name).unlink(missing_ok=True)
            if self.rows:
                self._write_rows()  # without those that came after the checkpoint
            self.logger = self._make_logger(saved and saved["wandb"])
            with replacing(self.folder / "config.yaml") as path:
                OmegaConf.save(cfg, path, resolve=True)

    # -- what the algorithm calls --------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[int]:
        if self.is_over:
            if rank() == 0:
                print(f"Finished before: {self.folder}")
            self._leave()
            return
        if self.cfg.compile and self.done < self.iterations:
            self._warm_up()
        step = self.steps_per_iteration
        with tqdm(
            total=self.iterations * step,
            initial=self.done * step,
            unit="step",
            unit_scale=True,
            desc=f"{self.cfg.algorithm} {self.cfg.task} {self.cfg.seed}",
            disable=rank() > 0,
        ) as bar:
            for iteration in range(self.done, self.iterations):
                self.starts.append(self.carry["state", "position"].clone())
                start, processor_start = time.perf_counter(), time.process_time()
                yield iteration
                self.seconds += time.perf_counter() - start
                self.processor_seconds += time.process_time() - processor_start
                self.done += 1
                bar.update(step)
                if self.done % self.cfg.eval.interval == 0 or self.done == self.iterations:
                    if rank() == 0:
                        metrics = self._evaluate()
                        bar.set_postfix_str(f"return {metrics['eval/return']:.2f}, {metrics['eval/success']:.0%}")
                    self.recorded.clear()
                    self.starts.clear()
                    self._save(self.folder / "checkpoint.pt")
        if rank() == 0:
            self._finish()
        self._leave()

    def descend(self, name: str, optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
        """One clipped step down a loss, averaged over all processes; records the norm of its gradient.

        The step is left out when the loss or its gradient is not finite.

        Raises:
            FloatingPointError: this has happened more than ``max_skipped`` times; the run is saved as it is.
        """
        value, norm = backward(loss, optimizer, max_grad_norm)
        finite = value.isfinite() and norm.isfinite()
        if finite:
            self.record(**{f"grad_{name}": norm})
        else:
            self.skipped += 1
            parameters = self.loss.named_parameters()
            broken = [key for key, p in parameters if p.grad is not None and not p.grad.isfinite().all()]
            optimizer.zero_grad()  # without gradients a step changes nothing
        optimizer.step()
        if finite or self.skipped <= self.cfg.max_skipped:
            return
        path = self.folder / "failure.pt"
        self._save(path)
        raise FloatingPointError(
            f"{self.skipped} updates had a loss or gradient that is not finite and were left out; the limit is "
            f"max_skipped={self.cfg.max_skipped}. The last: {name}, iteration {self.done}, loss {value:g}, gradient "
            f"norm {norm:g}, not finite in {', '.join(broken[:3]) or 'no parameter'}. Networks and the state in which "
            f'the horizon started are saved: {path}, ["processes"][{rank()}]["carry"]. Look for an infinite derivative '
            "there, or lower the learning rate; raise max_skipped if the run recovers by itself."
        )

    def record(self, **metrics: Tensor | float) -> None:
        """Keep what this iteration measured; a row holds the mean since the row before."""
        for name, value in metrics.items():
            group = "grad" if name.startswith("grad_") else "train"
            self.recorded[f"{group}/{name.removeprefix('grad_')}"].append(
                float(value.detach()) if isinstance(value, Tensor) else value
            )

    # -- evaluating and logging ----------------------------------------------------------------------------------------

    def _warm_up(self) -> None:
        """Compile the step and its derivative before the clock starts; change nothing."""
        with torch.random.fork_rng(), drawing_from(self.env, self.cfg.eval.seed):
            rollout = self.env.rollout(2, self.actor, break_when_any_done=False)
            if self.cfg.algorithm != "ppo" or self.audits:  # PPO itself takes no derivative of the step
                rollout["next", "reward"].sum().backward()
                self.actor.zero_grad()

    def _evaluate(self) -> dict[str, float]:
        """Fly the policy as it is, and tell what came out, with what was recorded since the last time."""
        with drawing_from(self.env, self.cfg.eval.seed):
            metrics, flight = evaluate(self.env, self.actor)
        steps = self.done * self.steps_per_iteration
        row = {
            "iteration": self.done,
            "steps": steps,
            "time/seconds": self.seconds,
            "time/processor_seconds": self.processor_seconds,
            "time/steps_per_second": steps / self.seconds,
            **{name: sum(values) / len(values) for name, values in self.recorded.items()},
            "train/start_cells": len(torch.cat(self.starts).div(CELL).floor().unique(dim=0)),
            "grad/skipped": self.skipped,
            **metrics,
        }
        if self.audits and (len(self.rows) + 1) % self.audits == 0:
            row |= self._diagnose()
        self.rows.append(row)
        self._write_rows()
        if self.logger is not None:
            self.logger.log_metrics({key: x for key, x in row.items() if "/" in key}, step=steps)
        every = self.cfg.logger.flight_every
        if every and len(self.rows) % every == 0 and self.done < self.iterations:  # at the end the best one is drawn
            self._log_flight(flight, steps)
        if metrics["eval/return"] >= self.best["return"]:
            policy = {"actor": self.actor, **({"normalizer": self.env.transform} if self.cfg.normalize else {})}
            weights = {name: copy.deepcopy(module.state_dict()) for name, module in policy.items()}
            self.best = {"return": metrics["eval/return"], "steps": steps, **weights}
        return metrics

    def _diagnose(self) -> dict[str, float]:
        """What reward and gradient of the next horizon are made of; changes nothing."""
        with torch.random.fork_rng(), drawing_from(self.env, self.cfg.eval.seed):
            rollout, _ = differentiable_rollout(self.env, self.actor, self.carry, self.cfg.horizon)
            audit = audit_reward(rollout, self.actor, gamma=self.cfg.gamma)
            metrics = {f"reward/{name}": share for name, share in audit.metrics().items()}
            if isinstance(self.loss, PathwiseLoss):
                comparison, statistics = compare_gradients(self.loss, rollout), gradient_statistics(self.loss, rollout)
                metrics |= {f"grad/{name}": value for name, value in asdict(comparison).items()}
                metrics |= {"grad/variance": statistics.variance, "grad/signal_to_noise": statistics.signal_to_noise}
        return metrics

    def _write_rows(self) -> None:
        """Write metrics.csv anew: after a resume it ends where the checkpoint does."""
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        with replacing(self.folder / "metrics.csv") as path, open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, names, restval=math.nan)
            writer.writeheader()
            writer.writerows(self.rows)

    def _make_logger(self, saved: dict[str, Any] | None) -> Logger | None:
        """The logger of the configuration; after a resume it goes on in the same run."""
        cfg = self.cfg.logger
        if not cfg.backend:
            return None
        config = {**OmegaConf.to_container(self.cfg, resolve=True), "revision": self.revision}
        wandb = {"mode": cfg.mode, "project": cfg.project, "group": cfg.group, "config": config}
        wandb |= {"reinit": "finish_previous"}  # one that a failed run has left in this process
        name = f"{self.cfg.task}_{self.cfg.algorithm}_seed{self.cfg.seed}"
        if saved:
            wandb["id"] = saved["local"]["id"]
        logger = get_logger(cfg.backend, str(self.folder), name, wandb_kwargs=wandb)
        if saved and cfg.backend == "wandb":
            logger.load_state_dict(saved)
        if self.done and cfg.backend == "tensorboard":  # what was logged after the checkpoint is to be forgotten
            logger.experiment.close()
            logger.experiment = type(logger.experiment)(
                logger.experiment.log_dir, purge_step=self.done * self.steps_per_iteration + 1
            )
        return logger

    def _log_flight(self, flight: TensorDictBase, steps: int) -> None:
        """Draw a flight, as picture and as film, and hand both to the logger."""
        draw_flight(flight, self.folder / "flight", self.cfg.env.control_dt)
        if self.cfg.logger.backend == "wandb":
            import wandb

            picture, film = wandb.Image(str(self.folder / "flight.png")), wandb.Video(str(self.folder / "flight.gif"))
            self.logger.experiment.log({"eval/flight": picture, "eval/film": film, "eval/step": steps})

    def _finish(self) -> None:
        """Final evaluation on fresh starts, pictures, summary; the summary last, since it says that the run is over."""
        summary, flight = final_evaluation(*load_policy(self.folder / "checkpoint.pt", self.cfg.device))
        steps = self.iterations * self.steps_per_iteration
        summary |= {"steps": steps, "best_steps": self.best["steps"], "seconds": round(self.seconds, 2)}
        summary |= {"revision": self.revision}
        self._log_flight(flight, steps)
        publish_flight(flight, self.folder / "episode.pdf", self.folder / "flight.html", self.env)
        with replacing(self.folder / "learning_curve.png") as path:
            plot_learning_curve(self.folder / "metrics.csv", path)
        if self.cfg.logger.backend == "wandb":
            import wandb

            experiment = self.logger.experiment
            curve = wandb.Image(str(self.folder / "learning_curve.png"))
            page = wandb.Html(str(self.folder / "flight.html"), inject=False)  # as it is
            experiment.log({"eval/learning_curve": curve, "eval/replay": page})
            experiment.summary.update({f"final/{name}": value for name, value in summary.items()})
            checkpoint = wandb.Artifact(f"{self.cfg.task}_{self.cfg.algorithm}_{experiment.id}", type="model")
            checkpoint.add_file(str(self.folder / "checkpoint.pt"))
            experiment.log_artifact(checkpoint)
        if self.logger is not None:
            self.logger.shutdown()
        write_json(self.folder / "summary.json", summary)
        print_summary(summary, self.folder)

    def _leave(self) -> None:
        """Part from the other processes."""
        if dist.is_initialized():
            dist.destroy_process_group()

    # -- stopping and going on -----------------------------------------------------------------------------------------

    def _save(self, path: Path) -> None:
        """Write all that the run needs to go on, that of all processes, all or nothing."""
        own = {
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state(self.env.device) if self.env.device.type == "cuda" else None,
            "env": generator(self.env).get_state(),
            "carry": self.carry.cpu().to_dict(),
            "buffer": None if self.buffer is None else self.buffer.state_dict(),
            "parameters": sum(p.detach().double().sum().item() for p in self.loss.parameters()),
        }
        processes = [own]
        if world_size() > 1:
            processes = [None] * world_size() if rank() == 0 else None
            dist.gather_object(own, processes)
        if rank() == 0:
            self._write(path, processes)
        if world_size() > 1:  # whoever goes on, or gives up, does so when the file is there
            dist.barrier()

    def _write(self, path: Path, processes: list[dict[str, Any]]) -> None:
        if len({process["parameters"] for process in processes}) > 1:
            raise RuntimeError(
                "The processes have drifted apart: their parameters differ. Take every step with run.descend."
            )
        content = {
            "format": FORMAT,
            "version": torchrl_quad.__version__,
            "revision": self.revision,
            "config": OmegaConf.to_yaml(self.cfg, resolve=True),
            "iteration": self.done,
            "seconds": (self.seconds, self.processor_seconds),
            "skipped": self.skipped,
            "rows": self.rows,
            "best": self.best,
            "wandb": self.logger.state_dict() if self.cfg.logger.backend == "wandb" else None,
            "parts": [part.state_dict() for part in self.parts],
            "processes": processes,
        }
        with replacing(path) as temporary:
            torch.save(content, temporary)

    def _load(self, saved: dict[str, Any]) -> None:
        """Take everything from a checkpoint.

        Raises:
            ValueError: it was written by another number of processes, or lacks something.
        """
        if len(saved["processes"]) != world_size():
            raise ValueError(
                f"{self.cfg.resume} was written by {len(saved['processes'])} processes, and {world_size()} want to go "
                "on. Start as many as before: torchrun --nproc-per-node=N."
            )
        own = saved["processes"][rank()]
        for part, state in zip(self.parts, saved["parts"], strict=True):
            part.load_state_dict(state)
        if self.buffer is not None:
            self.buffer.load_state_dict(own["buffer"])
        self.carry = TensorDict(own["carry"], self.env.batch_size).to(self.env.device)
        generator(self.env).set_state(own["env"])
        torch.set_rng_state(own["torch"])
        if own["cuda"] is not None:
            torch.cuda.set_rng_state(own["cuda"], self.env.device)
        self.done, self.skipped = saved["iteration"], saved["skipped"]
        self.seconds, self.processor_seconds = saved["seconds"]
        self.rows, self.best = saved["rows"], saved["best"]


def draw_flight(flight: TensorDictBase, path: Path, control_dt: float) -> None:
    """Write a flight as a picture and as a film: the path with .png and .gif."""
    for draw, suffix in ((plot_flight, ".png"), (animate_flight, ".gif")):
        with replacing(path.with_suffix(suffix)) as temporary:
            draw(flight, temporary, control_dt=control_dt)


def publish_flight(flight: TensorDictBase, figure: Path, page: Path, env: EnvBase) -> None:
    """Write the first episode of a flight as a figure for a paper, and the flight as a page to play it in a browser."""
    with replacing(figure) as temporary:
        plot_episode(flight, temporary, control_dt=env.control_dt)
    write_replay(flight, page, env=env)  # whole or not at all, by itself


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
