"""What a run logs: a row in metrics.csv for each evaluation, and the same names in wandb or tensorboard."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torchrl.record.loggers import get_logger

from torchrl_quad.files import replacing


class Logs:
    """The log of a run: ``add`` a row, ``show`` pictures, ``finish`` with the summary.

    Args:
        cfg: the configuration.
        folder: where the files go.
        revision: of the code, for wandb.
        rows: of metrics.csv so far.
        steps: of training so far; tensorboard forgets what it was given later.
        saved: the logger's state in the checkpoint from which the run goes on; it then goes on in the same wandb run.
    """

    def __init__(
        self,
        cfg: DictConfig,
        folder: Path,
        revision: str,
        rows: list[dict[str, float]],
        steps: int,
        saved: dict[str, Any] | None,
    ) -> None:
        self.cfg, self.folder, self.rows = cfg, folder, rows
        self.backend = None
        if rows:
            self._write()  # without those that came after the checkpoint
        if not cfg.logger.backend:
            return
        config = {**OmegaConf.to_container(cfg, resolve=True), "revision": revision}
        wandb = {"mode": cfg.logger.mode, "project": cfg.logger.project, "group": cfg.logger.group, "config": config}
        wandb |= {"reinit": "finish_previous"}  # one that a failed run has left in this process
        if saved:
            wandb["id"] = saved["local"]["id"]
        name = f"{cfg.task}_{cfg.algorithm}_seed{cfg.seed}"
        self.backend = get_logger(cfg.logger.backend, str(folder), name, wandb_kwargs=wandb)
        if saved and cfg.logger.backend == "wandb":
            self.backend.load_state_dict(saved)
        if steps and cfg.logger.backend == "tensorboard":
            self.backend.experiment.close()
            writer = type(self.backend.experiment)
            self.backend.experiment = writer(self.backend.experiment.log_dir, purge_step=steps + 1)

    def add(self, row: dict[str, float]) -> None:
        """Log a row, and write metrics.csv anew: after a resume it ends where the checkpoint does."""
        self.rows.append(row)
        self._write()
        if self.backend is not None:
            self.backend.log_metrics({key: x for key, x in row.items() if "/" in key}, step=row["steps"])

    def show_flight(self, steps: int) -> None:
        """Log flight.png and flight.gif."""
        if self.cfg.logger.backend == "wandb":
            import wandb

            picture, film = wandb.Image(str(self.folder / "flight.png")), wandb.Video(str(self.folder / "flight.gif"))
            self.backend.experiment.log({"eval/flight": picture, "eval/film": film, "eval/step": steps})

    def finish(self, summary: dict[str, Any]) -> None:
        """Log the summary, the learning curve, the replay and the checkpoint, and close the logger."""
        if self.cfg.logger.backend == "wandb":
            import wandb

            experiment = self.backend.experiment
            curve = wandb.Image(str(self.folder / "learning_curve.png"))
            page = wandb.Html(str(self.folder / "flight.html"), inject=False)  # as it is
            experiment.log({"eval/learning_curve": curve, "eval/replay": page})
            experiment.summary.update({f"final/{name}": value for name, value in summary.items()})
            checkpoint = wandb.Artifact(f"{self.cfg.task}_{self.cfg.algorithm}_{experiment.id}", type="model")
            checkpoint.add_file(str(self.folder / "checkpoint.pt"))
            experiment.log_artifact(checkpoint)
        if self.backend is not None:
            self.backend.shutdown()

    def state_dict(self) -> dict[str, Any] | None:
        """What a run that goes on needs to log into the same wandb run."""
        return self.backend.state_dict() if self.cfg.logger.backend == "wandb" else None

    def _write(self) -> None:
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        with replacing(self.folder / "metrics.csv") as path, open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, names, restval=math.nan)
            writer.writeheader()
            writer.writerows(self.rows)
