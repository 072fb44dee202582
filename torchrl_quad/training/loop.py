"""The training loop: it counts, evaluates, saves, and continues after a stop."""

from __future__ import annotations

import copy
import math
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
import torch.distributed as dist
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl import torchrl_logger
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.objectives import LossModule
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

import torchrl_quad
from torchrl_quad import VisitedStateBuffer, differentiable_rollout
from torchrl_quad.diagnostics import audit_reward, compare_gradients, gradient_statistics
from torchrl_quad.errors import Diverged, UserError, UserValueError
from torchrl_quad.files import replacing
from torchrl_quad.objectives import PathwiseCriticLoss, PathwiseLoss
from torchrl_quad.training import drawing
from torchrl_quad.training.building import (
    Optimizer,
    TargetUpdate,
    average_policy,
    iterations,
    minibatches,
    of_first,
    own_seed,
    rank,
    task_of,
    world_size,
)
from torchrl_quad.training.checkpoints import fits, read_checkpoint, revision, write_checkpoint
from torchrl_quad.training.evaluation import (
    STALLED,
    best_policy,
    drawing_from,
    evaluate,
    final_evaluation,
    has_levelled_off,
    last_rise,
    looks_ahead,
    merit,
    next_pace,
    report,
    rounds,
    title,
    why_unsolved,
)
from torchrl_quad.training.logs import Logs

# Of a checkpoint.
PROGRESS = ("iteration", "steps", "skipped", "seconds", "processor_seconds", "rows", "best", "pace", "slower_since")
CELL = 0.5  # [m]: train/start_cells counts the cubes of this size in which horizons have started


class Run:
    """A training run: ``for _ in run: ...``, with ``run.carry``, ``run.optimise(...)`` and ``run.record(...)`` in it.

    Every ``eval.interval`` iterations the run writes a row of metrics and a checkpoint, which holds all that it needs
    to continue bit for bit, and the best policy so far, by :func:`merit`, which flies from other starts at the end.
    With ``eval.patience`` a run that has stalled goes back to it, with its critics and optimisers, at a quarter of the
    actor's rate; so does a run that has lost its way, at half of it. Each evaluation that rises doubles the rate again.

    The seconds are those of the loop, without set-up, compilation, evaluations and checkpoints.

    Args:
        cfg, env: the configuration and its environment.
        actor, loss: the policy, and what holds everything that is trained, its parameters too.
        stateful: optimisers, and whatever else has a ``state_dict`` that changes in training.
        buffer: of visited states, if the algorithm has one.

    Attributes:
        carry: where the next horizon starts; the algorithm sets it in each iteration.
        horizon: control steps of this iteration's rollout, ``cfg.horizon`` unless the algorithm sets it.
        levelled_off: whether it has stalled again at the lower rate; then it ends.
        looks_ahead: whether it has once solved nine tenths of an evaluation, or has long not risen.
        pace: the factor by which stalls and collapses lower the actor's rate.
    """

    def __init__(
        self,
        cfg: DictConfig,
        env: EnvBase,
        actor: TensorDictModule,
        loss: LossModule,
        stateful: Sequence[Any],
        buffer: VisitedStateBuffer | None = None,
    ) -> None:
        self.cfg, self.env, self.actor, self.loss, self.task = cfg, env, actor, loss, task_of(env)
        self.average = average_policy(cfg, actor)
        # What evaluations fly.
        self.flown = actor if self.average is None else cast("TensorDictModule", self.average.module)
        self.normalizer = env.transform if isinstance(env, TransformedEnv) else None
        self.stateful = [x for x in (loss, *stateful, self.average, self.normalizer) if x is not None]
        own = {"buffer": buffer, "clip": getattr(loss, "clip", None)}  # each clips by the median of its own drones
        self.of_process = {name: x for name, x in own.items() if x is not None}
        self.horizon, self.steps, self.drones = cfg.horizon, 0, cfg.num_envs * world_size()
        self.total_steps = iterations(cfg) * cfg.horizon * self.drones
        self.recorded: dict[str, list[float]] = defaultdict(list)
        self.starts: list[Tensor] = []  # positions in which the horizons since the last row have started
        self.rows: list[dict[str, float]] = []  # of metrics.csv
        self.iteration, self.seconds, self.processor_seconds, self.skipped, self.slower_since = 0, 0.0, 0.0, 0, 0
        self.pace = 1.0
        self.best: dict[str, Any] = {"solved": -math.inf, "return": -math.inf}
        self.folder = Path(HydraConfig.get().runtime.output_dir)
        self.saved: Path | None = None  # the last checkpoint known to be intact
        self.revision = revision()
        if world_size() > 1:
            torch.manual_seed(own_seed(cfg))  # the networks are built, and equal
        logger_state = self._load(Path(cfg.resume)) if cfg.resume else None
        if not cfg.resume:
            self.carry = env.reset()
        self.evaluated = self.rows[-1]["iteration"] if self.rows else 0  # known to all processes, as rows are not
        self.looks_ahead = looks_ahead(self.rows, cfg.eval.patience)
        self.levelled_off = has_levelled_off(self.rows, self.slower_since, cfg.eval.patience)
        self.is_over = not self.goes_on and (self.folder / "summary.json").exists()
        if rank() == 0 and not self.is_over:
            for name in ("summary.json", "failure.pt"):  # of the run before it was made longer, or went on
                (self.folder / name).unlink(missing_ok=True)
            self.logs = Logs(self, logger_state)
            with replacing(self.folder / "config.yaml") as path:
                OmegaConf.save(cfg, path, resolve=True)

    @property
    def is_due(self) -> bool:
        """Whether it is time for an evaluation; with ``eval.patience`` they also wait for 2 % more iterations."""
        waits = self.cfg.eval.patience is not None and self.iteration < 1.02 * self.evaluated
        return not waits and self.iteration % self.cfg.eval.interval == 0

    @property
    def goes_on(self) -> bool:
        """Whether there are steps left, and a reason to fly them."""
        return self.steps < self.total_steps and not self.levelled_off

    def __iter__(self) -> Iterator[int]:
        if self.is_over:
            if rank() == 0:
                print(f"Finished before: {self.folder}")
            return
        began = time.perf_counter()
        if self.cfg.compile and self.goes_on:
            if rank() == 0:
                print("Compiling the control step: about a minute, or 6 s where it is in the cache.", flush=True)
            self._warm_up()
            if rank() == 0:
                print(f"Compiled in {time.perf_counter() - began:.0f} s.", flush=True)
        if rank() == self.steps == 0 and not type(self.task).__module__.startswith("torchrl_quad."):
            for trap in (x for x in self._traps() if not x.endswith("teaches nothing")):  # it may, later
                torchrl_logger.warning(f"Before training, {self.cfg.task} may have a trap: {trap}.")
        way = "inside" if self.task.flies_inside(self.actor) else "before"
        name = f"{self.cfg.algorithm} {self.cfg.task} {self.cfg.seed}, policy {way} the step"
        often = 0.1 if sys.stderr.isatty() else 30.0  # [s]: a file or a cluster's log keeps every line
        bounds = {"total": self.total_steps, "initial": self.steps, "mininterval": often}
        bar = tqdm(**bounds, unit="step", unit_scale=True, desc=name, disable=rank() > 0)
        with logging_redirect_tqdm([torchrl_logger]), bar:  # TorchRL's lines go above the bar
            while self.goes_on:
                self.starts.append(self.carry["state", "position"].clone())
                for optimizer in (x for x in self.stateful if isinstance(x, Optimizer)):
                    pace = self.pace if optimizer.name == "actor" else 1.0
                    optimizer.anneal(self.steps / self.drones / self.cfg.horizon, pace)
                start, processor_start = time.perf_counter(), time.process_time()
                yield self.iteration
                if self.average is not None:
                    self.average.update_parameters(self.actor)
                self.seconds += time.perf_counter() - start
                self.processor_seconds += time.process_time() - processor_start
                self.iteration += 1
                self.steps += self.horizon * self.drones
                bar.update(self.horizon * self.drones)
                if self.is_due or self.steps >= self.total_steps:
                    best, pace, self.evaluated = None, 1.0, self.iteration
                    if rank() == 0:
                        metrics = self._evaluate()
                        solved = metrics["eval/solved"]
                        bar.set_postfix_str(f"return {metrics['eval/return']:.2f}, solved {solved:.0%}")
                        since, patience = self.slower_since, self.cfg.eval.patience
                        self.looks_ahead = looks_ahead(self.rows, patience)
                        self.levelled_off = has_levelled_off(self.rows, since, patience)
                        pace = 1.0 if self.levelled_off else next_pace(self.rows, since, patience)
                        if pace < 1.0:
                            best = self.best.get("stateful")
                    known = self.looks_ahead, self.levelled_off, best, pace
                    self.looks_ahead, self.levelled_off, best, pace = of_first(known)
                    self.pace = min(max(pace * self.pace, 1 / 16), 1.0)
                    if pace == STALLED:
                        self.slower_since = self.steps
                    if best is not None:
                        self._roll_back(best)
                    self.recorded.clear()
                    self.starts.clear()
                    self._save(self.folder / "checkpoint.pt")
        if rank() == 0:
            if self.cfg.eval.patience is not None:
                how = "Stopped before total_steps, since" if self.levelled_off else "Flew all of total_steps:"
                print(f"{how} the last evaluation that improved by 1 % was at step {last_rise(self.rows):,}.")
            self._finish()
            if len(self.rows) >= 10 and max(x["eval/solved"] for x in self.rows) < 0.5:
                self._warn()
            print(f"{time.perf_counter() - began:.0f} s in all, {self.seconds:.0f} s of them training.")

    def optimise(self, optimizer: Optimizer, loss: Tensor) -> bool:
        """Take one step down a loss with its clipped gradient, averaged over all processes; record the norm.

        The step is skipped if the loss or its gradient is not finite; more than ``max_skipped`` of them end the run.
        Returns whether it was taken.
        """
        both = torch.stack(backward(loss, optimizer, optimizer.max_grad_norm))
        value, norm = both.tolist()  # in one call, so that it waits for a GPU once
        if math.isfinite(value) and math.isfinite(norm):
            self.record(**{f"grad_{optimizer.name}": norm})
            optimizer.step()
            return True
        self.skipped += 1
        if self.skipped == 1 and rank() == 0:
            why = f"loss {value:g} and gradient norm {norm:g} are not both finite"
            torchrl_logger.warning(
                f"An update was skipped in iteration {self.iteration}: {why}. grad/skipped counts them."
            )
        parameters = self.loss.named_parameters()
        broken = [key for key, p in parameters if p.grad is not None and not p.grad.isfinite().all()]
        optimizer.zero_grad()
        if self.skipped <= self.cfg.max_skipped:
            return False
        path = self.folder / "failure.pt"
        self._save(path)
        raise Diverged(
            f"{self.skipped} updates were skipped because their loss or gradient was not finite; the limit is "
            f"max_skipped={self.cfg.max_skipped}. The last: {optimizer.name}, iteration {self.iteration}, loss "
            f"{value:g}, gradient norm {norm:g}, not finite in {', '.join(broken[:3]) or 'no parameter'}. Networks and "
            f'the state in which the horizon started are saved: {path}, ["processes"][{rank()}]["carry"]. Look for an '
            "infinite derivative there, or lower the learning rate; raise max_skipped if the run recovers without help."
        )

    def fit_critic(
        self, optimizer: Optimizer, data: TensorDictBase, target: TargetUpdate | None = None, times: float = 1.0
    ) -> dict[str, Any]:
        """Take ``critic.updates`` steps of the critic towards the value targets in ``data``, on random minibatches.

        ``target`` moves the target critic after each, and there are so many ``times`` as many. Returns the loss and the
        metrics of the last minibatch.
        """
        loss, metrics = cast("PathwiseCriticLoss", self.loss), {}
        read = data.select(*getattr(loss, loss.critic_name).in_keys, loss.tensor_keys.value_target)
        for batch in minibatches(read, self.cfg.critic, times):
            loss_critic, measured = getattr(loss, loss.critic_loss_key)(batch)
            self.optimise(optimizer, loss_critic)
            metrics = {loss.critic_loss_key: loss_critic, **measured}
            if target is not None:
                target.step()
        return metrics

    def record(self, **metrics: Tensor | float) -> None:
        """Keep what this iteration measured; a row holds the mean since the row before."""
        for name, value in metrics.items():
            name = f"grad/{name.removeprefix('grad_')}" if name.startswith("grad_") else f"train/{name}"
            self.recorded[name].append(float(value.detach()) if isinstance(value, Tensor) else value)

    def _warm_up(self) -> None:
        """Compile all that the loop will call, before the clock starts; change nothing."""
        loss, before = cast("Any", self.loss), copy.deepcopy(self.loss.state_dict())
        has_gradient = torch.set_grad_enabled(isinstance(loss, PathwiseLoss))
        with torch.random.fork_rng(), drawing_from(self.env, self.cfg.eval.seed), has_gradient:
            rollout, _ = differentiable_rollout(self.env, self.actor, self.carry, min(self.cfg.horizon, 2))
            if isinstance(loss, PathwiseLoss):
                loss.loss_actor(rollout)[0].backward()
                loss.zero_grad()
            elif hasattr(loss, "warm_up"):
                loss.warm_up(rollout, min(self.cfg.batch_size, self.cfg.num_envs * self.cfg.horizon))
        self.loss.load_state_dict(before)  # such as running means

    def _evaluate(self) -> dict[str, float]:
        """Fly the policy or its average, and log the result with everything recorded since the last time."""
        with drawing_from(self.env, self.cfg.eval.seed):
            metrics, flight = evaluate(self.env, self.flown, self.cfg.eval.episodes)
        row = {
            "iteration": self.iteration,
            "steps": self.steps,
            "time/seconds": self.seconds,
            "time/processor_seconds": self.processor_seconds,
            "time/steps_per_second": self.steps / self.seconds,
            **{name: sum(values) / len(values) for name, values in self.recorded.items()},
            "train/start_cells": len(torch.cat(self.starts).div(CELL).floor().unique(dim=0)),
            "grad/skipped": self.skipped,
            **metrics,
        }
        if self.cfg.diagnostics and (len(self.rows) + 1) % self.cfg.diagnostics == 0:
            row |= self._diagnose()
        self.logs.add(row)
        every = self.cfg.logger.flight_every
        if every and len(self.rows) % every == 0 and self.steps < self.total_steps:  # at the end the best one is drawn
            episodes = rounds(self.cfg.eval.episodes, len(flight)) * len(flight)
            now = {**self.cfg, "episodes": episodes, "solved": metrics["eval/solved"]}
            drawing.draw_flight(flight, self.folder / "flight", self.env, title(now))
            self.logs.show_flight(self.steps)
        late = [i >= 4 and x["steps"] >= 0.1 * self.total_steps for i, x in enumerate(self.rows)]
        if sum(late) == 1 and late[-1] and not any(x["eval/solved"] for x in self.rows):
            self._warn()
        score = {name: metrics[f"eval/{name}"] for name in ("solved", "return")}
        patience = self.cfg.eval.patience
        if math.isfinite(score["return"]) and merit(score, patience) >= merit(self.best, patience):
            policy = {"actor": self.flown, "normalizer": self.normalizer}
            weights = {name: copy.deepcopy(x.state_dict()) for name, x in policy.items() if x is not None}
            self.best = {**score, "steps": self.steps, **weights}
            if patience is not None:
                self.best["stateful"] = copy.deepcopy([x.state_dict() for x in self.stateful])
        return metrics

    def _roll_back(self, stateful: list[dict[str, Any]]) -> None:
        """Go back to the best policy with its critics and optimisers, from fresh starts."""
        for x, state in zip(self.stateful, stateful, strict=True):
            x.load_state_dict(copy.deepcopy(state))
        # The weights of which the best policy was the mean may be poor.
        self.actor.load_state_dict(self.flown.state_dict())
        self.carry = self.env.reset()

    def _warn(self) -> None:
        """Say why a run that solves nothing, or little, may not learn."""
        solved = max(x["eval/solved"] for x in self.rows)
        result = f"At most {100 * solved:.2g} % of the episodes are solved" if solved else "Nothing is solved"
        seconds = self.task.max_episode_steps * self.task.control_dt
        for trap in [*self._traps(), *why_unsolved(self.rows, seconds, self.task.ends_on_success)]:
            torchrl_logger.warning(f"{result} after {self.steps:,} steps. Perhaps {trap}.")

    def _traps(self) -> Sequence[str]:
        """What the audit of the next horizon's reward says; change nothing."""
        with torch.random.fork_rng(), drawing_from(self.env, self.cfg.eval.seed):
            rollout, _ = differentiable_rollout(self.env, self.actor, self.carry, self.horizon)
            try:
                return audit_reward(rollout, self.actor, gamma=self.cfg.gamma).traps
            except UserError as error:
                return [str(error)]

    def _diagnose(self) -> dict[str, float]:
        """Measure what reward and gradient of the next horizon are made of; change nothing."""
        with torch.random.fork_rng(), drawing_from(self.env, self.cfg.eval.seed):
            rollout, _ = differentiable_rollout(self.env, self.actor, self.carry, self.horizon)
            audit = audit_reward(rollout, self.actor, gamma=self.cfg.gamma)
            metrics = {f"reward/{name}": share for name, share in audit.metrics().items()}
            if isinstance(self.loss, PathwiseLoss):
                comparison, statistics = compare_gradients(self.loss, rollout), gradient_statistics(self.loss, rollout)
                metrics |= {f"grad/{name}": value for name, value in asdict(comparison).items()}
                metrics |= {"grad/variance": statistics.variance, "grad/signal_to_noise": statistics.signal_to_noise}
        return metrics

    def _finish(self) -> None:
        """Fly the best policy from fresh starts, write the summary, which marks the run as finished, and draw it."""
        summary, flight = final_evaluation(self.cfg, *best_policy(self.cfg, self.best, self.folder))
        summary |= {"steps": self.steps, "best_steps": self.best["steps"], "seconds": round(self.seconds, 2)}
        summary |= {"revision": self.revision}
        report(summary, self.task.metric_info, self.folder / "summary.json")
        figure, page = self.folder / "episode.pdf", self.folder / "flight.html"
        drawing.draw_flight(flight, self.folder / "flight.png", self.env, title(summary))
        drawing.publish_flight(flight, figure, page, self.env, title(summary))
        drawing.draw_learning_curve(self.folder / "metrics.csv", self.folder / "learning_curve.png", self.env)
        self.logs.show_flight(self.steps)
        self.logs.finish(summary)

    def _save(self, path: Path) -> None:
        """Write all that the run needs to continue, of all processes."""
        own = {
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state(self.env.device) if self.env.device.type == "cuda" else None,
            "env": self.task.random_state(),
            "carry": self.carry.cpu().to_dict(),
            **{name: x.state_dict() for name, x in self.of_process.items()},
            "parameters": sum(p.detach().double().sum().item() for p in self.loss.parameters()),
        }
        processes = [own] * world_size()
        if world_size() > 1:
            dist.gather_object(own, processes if rank() == 0 else None)  # the others keep their own
        if len({process["parameters"] for process in processes}) > 1:
            raise RuntimeError("The parameters of the processes differ: take every step with run.optimise.")
        if rank() == 0:
            content = {
                "version": torchrl_quad.__version__,
                "revision": self.revision,
                "config": OmegaConf.to_yaml(self.cfg, resolve=True),
                **{name: getattr(self, name) for name in PROGRESS},
                "logger": self.logs.state_dict(),
                "stateful": [x.state_dict() for x in self.stateful],
                "processes": processes,
            }
            is_failure = path.name == "failure.pt"
            write_checkpoint(path, content, None if is_failure else self.saved)
            self.saved = self.saved if is_failure else path
        if world_size() > 1:
            dist.barrier()  # none continues, or gives up, before the file is there

    def _load(self, path: Path) -> dict[str, Any] | None:
        """Take everything from a checkpoint, and return the state of the logger."""
        saved = read_checkpoint(path)
        if not saved["processes"]:
            raise UserValueError(f"{path} holds an adapted policy, and no run to continue. Adapt it again, or train.")
        if len(saved["processes"]) != world_size():
            raise UserValueError(
                f"{path} was written by {len(saved['processes'])} processes, and {world_size()} want to continue. "
                "Start as many as before: torchrun --nproc-per-node=N."
            )
        with fits(path, "the state of the run"):
            own = saved["processes"][rank()]
            for x, state in zip(self.stateful, saved["stateful"], strict=True):
                x.load_state_dict(state)
            for name, x in self.of_process.items():
                x.load_state_dict(own[name])
            carry = TensorDict(own["carry"], [self.cfg.num_envs]).to(self.env.device)
            self.carry = self.env.reset(carry.exclude("_reset"), set_state=True).update(carry)
            self.task.set_random_state(own["env"])
            torch.set_rng_state(own["torch"])
            if own["cuda"] is not None:
                torch.cuda.set_rng_state(own["cuda"], self.env.device)
            for name in PROGRESS:
                setattr(self, name, saved.get(name, getattr(self, name)))  # older ones lack the last two
            self.best |= {name: float(self.best[name]) for name in ("solved", "return")}
            self.rows = [{str(name): value + 0 for name, value in row.items()} for row in self.rows]
        self.saved, before = path, saved["revision"]
        self.revision = before if self.revision in before else f"{before}, then {self.revision}"
        return saved["logger"]


def backward(loss: Tensor, optimizer: torch.optim.Optimizer, max_grad_norm: float) -> tuple[Tensor, Tensor]:
    """Compute the gradient of a loss, average it over the processes, and clip that of each group of parameters.

    Returns the loss and the norm of the first group's gradient before clipping, both averaged over the processes.
    """
    optimizer.zero_grad()
    loss.backward()
    groups = [[p for p in group["params"] if p.grad is not None] for group in optimizer.param_groups]
    loss = loss.detach()
    if world_size() > 1:
        tensors = [loss, *(p.grad for group in groups for p in group)]
        flat = nn.utils.parameters_to_vector(tensors)
        dist.all_reduce(flat)
        nn.utils.vector_to_parameters(flat / world_size(), tensors)
    norms = [nn.utils.clip_grad_norm_(group, max_grad_norm, foreach=True) for group in groups]
    return loss, norms[0]
