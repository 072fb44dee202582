"""What a run logs: a row in metrics.csv for each evaluation, and the same names in wandb or tensorboard."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from torchrl.record.loggers import get_logger

from torchrl_quad.errors import UserValueError
from torchrl_quad.files import write_rows
from torchrl_quad.training.configuration import plain
from torchrl_quad.training.evaluation import as_json

ARTIFACT = ("checkpoint.pt", "config.yaml", "policy")  # of a run's folder, where they are there; and summary.json
NOT_IN_A_NAME = ("task=", "seed=", "resume=", "device=", "threads=", "logger.")


class Logs:
    """The log of a run. ``saved`` is its state in the checkpoint from which the run goes on, in the same wandb run.

    Tensorboard forgets what it was given later than the checkpoint.
    """

    def __init__(self, run: Any, saved: dict[str, Any] | None) -> None:
        cfg, folder, rows = self.cfg, self.folder, self.rows = run.cfg, run.folder, run.rows
        self.backend: Any = None
        if rows:  # without those that came after the checkpoint
            write_rows(folder / "metrics.csv", rows, missing=math.nan)
        if not cfg.logger.backend:
            return
        config = plain(cfg, resolve=True) | {"revision": run.revision}
        name = f"{cfg.task}_{cfg.algorithm}_seed{cfg.seed}"
        self.name = (saved or {}).get("name") or run_name(name, HydraConfig.get().overrides.task)
        drone = Path(cfg.env.drone).stem if isinstance(cfg.env.get("drone"), str) else "own drone"
        wandb = {
            **{key: cfg.logger[key] for key in ("mode", "project", "group")},
            "name": self.name,
            "tags": [str(tag)[:64] for tag in (cfg.task, cfg.algorithm, drone)],
            "job_type": "train",
            "config": config,
            "log_env_packages": False,  # would take the place of the configuration's own section env
            "reinit": "finish_previous",  # one that a failed run has left in this process
        }
        if saved:
            wandb["id"] = saved["local"]["id"]
        self.backend = _logger(cfg.logger.backend, str(folder), name, wandb_kwargs=wandb)
        if cfg.logger.backend == "wandb":
            self.backend.experiment.define_metric("steps", hidden=True)
            self.backend.experiment.define_metric("*", step_metric="steps")
            for metric, described in run.task.metric_info.items():
                if described.goal:  # the table of runs then shows the best value, not the last
                    self.backend.experiment.define_metric(f"eval/{metric}", step_metric="steps", summary=described.goal)
        if rows and cfg.logger.backend == "tensorboard":
            self.backend.experiment.close()
            writer = type(self.backend.experiment)
            self.backend.experiment = writer(self.backend.experiment.log_dir, purge_step=int(rows[-1]["steps"]) + 1)

    def add(self, row: dict[str, float]) -> None:
        """Log a row, and rewrite metrics.csv: after a resume it ends where the checkpoint does."""
        self.rows.append(row)
        write_rows(self.folder / "metrics.csv", self.rows, missing=math.nan)
        metrics = {key: x for key, x in row.items() if "/" in key}
        if self.cfg.logger.backend == "wandb":
            self.backend.experiment.log({"steps": row["steps"], **metrics})
        elif self.backend is not None:
            self.backend.log_metrics(metrics, step=row["steps"])

    def show_flight(self, steps: int) -> None:
        """Log flight.png and the film, as far as they have been drawn."""
        if self.cfg.logger.backend == "wandb":
            import wandb

            films = "flight.mp4", "flight.gif"
            drawn = self._drawn("eval/flight", "flight.png", make=wandb.Image)
            drawn |= self._drawn("eval/film", *films, make=lambda x: wandb.Video(x, format=cast("Any", x[-3:])))
            self.backend.experiment.log({"steps": steps, **drawn})

    def finish(self, summary: dict[str, Any]) -> None:
        """Log the summary, the learning curve, the replay, and what to keep of the run, and close the logger."""
        if self.cfg.logger.backend == "wandb":
            import wandb

            experiment = self.backend.experiment
            drawn = self._drawn("eval/learning_curve", "learning_curve.png", make=wandb.Image)
            as_it_is = functools.partial(wandb.Html, inject=False)
            drawn |= self._drawn("eval/replay", "flight.html", make=as_it_is)
            numbers = {x: y for x, y in summary.items() if isinstance(y, float) and x != "seconds"}
            best = {f"best/{x}": y for x, y in {**numbers, "steps": summary["best_steps"]}.items()}
            experiment.log({"steps": summary["steps"], **drawn, **best})
            name = f"{self.cfg.task}_{self.cfg.algorithm}_{experiment.id}"
            artifact = wandb.Artifact(name, type="model", metadata=json.loads(as_json(summary)))
            for path in map(self.folder.joinpath, ARTIFACT):
                if path.is_dir():
                    artifact.add_dir(str(path), name=path.name)
                elif path.exists():
                    artifact.add_file(str(path))
            with artifact.new_file("summary.json") as file:
                file.write(as_json(summary))
            experiment.log_artifact(artifact, aliases=["best", "latest"])
        if self.backend is not None:
            self.backend.shutdown()

    def state_dict(self) -> dict[str, Any] | None:
        """What a resumed run needs to log into the same wandb run."""
        return {**self.backend.state_dict(), "name": self.name} if self.cfg.logger.backend == "wandb" else None

    def _drawn(self, name: str, *files: str, make: Callable[[str], Any]) -> dict[str, Any]:
        """What wandb shows under a name, made of the first of these files that is there."""
        paths = [str(self.folder / file) for file in files if (self.folder / file).exists()]
        return {name: make(paths[0])} if paths else {}


def _logger(backend: str, *arguments: Any, **options: Any) -> Any:
    """TorchRL's logger; what wandb refuses, such as a run without a login, is a UserValueError."""
    try:
        return get_logger(cast("Any", backend), *arguments, **options)
    except Exception as error:
        if not type(error).__module__.startswith("wandb"):
            raise
        said = str(error).splitlines()[0].rstrip(".")
        raise UserValueError(f"logger.backend=wandb: {said}. Or write logger.mode=offline.") from error


def run_name(name: str, overrides: Iterable[str]) -> str:
    """The name of a run in wandb, at most 128 characters: with what was asked for, but for task and seed."""
    given = [x.lstrip("+") for x in overrides if not x.lstrip("+~").startswith(NOT_IN_A_NAME)]
    name = " ".join([name, *given])
    return name if len(name) <= 128 else f"{name[:127]}…"
