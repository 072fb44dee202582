"""Files that are written whole or not at all, checkpoints that say what is wrong with them, and how a run resumes."""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

FORMAT = 2  # of checkpoint.pt; to be raised when an older file can no longer be read
FREE_ON_RESUME = (
    "resume",
    "total_steps",
    "threads",
    "compile",
    "max_skipped",
    "diagnostics",
    "eval",
    "logger",
)

# A run that resumes goes on in the folder of its checkpoint; hydra.run.dir asks for it by this name.
OmegaConf.register_new_resolver(
    "folder_of", lambda resume, new: new if resume in (None, "auto") else str(Path(resume).parent), replace=True
)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path to write to; the file takes the place of ``path`` when it is complete, and not before."""
    temporary = path.with_name(f".{path.stem}{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file; what is not a number becomes null."""
    content = {key: None if isinstance(x, float) and math.isnan(x) else x for key, x in content.items()}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")


def revision() -> str:
    """The git commit of the code, with "-dirty" when the code differs from it; "unknown" outside a repository."""

    def git(*words: str) -> str:
        command = ("git", "--no-optional-locks", *words)
        return subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True).stdout

    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        changed = git("status", "--porcelain", "--", ".", "../torchrl_quad")
        return git("rev-parse", "HEAD").strip() + ("-dirty" if changed else "")
    return "unknown"


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint, on the CPU. Nothing in the file is executed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is cut off, foreign, or of another version.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No checkpoint at {path}. Train one first: python recipes/abpt.py")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        said = (str(error) or repr(error)).splitlines()[0]
        raise ValueError(
            f"{path} cannot be read: it is cut off, or no checkpoint of these recipes, which hold tensors and plain "
            f"values only (anything else could run code, and is not loaded). torch says: {said}"
        ) from error
    if not isinstance(content, dict) or "config" not in content:
        raise ValueError(f"{path} is not a checkpoint of these recipes. Give the path of a checkpoint.pt.")
    if content.get("format") != FORMAT:
        raise ValueError(
            f"{path} has checkpoint format {content.get('format', 0)}, this version reads format {FORMAT}. It was "
            f"written by torchrl_quad {content.get('version', '0.1.0 or before')} at revision "
            f"{content.get('revision', 'unknown')}: use that version, or train again."
        )
    return content


def take_over(cfg: DictConfig) -> None:
    """Put the configuration of the checkpoint that ``cfg.resume`` names in the place of this one.

    ``resume=auto`` means the checkpoint in the run's own folder, where there is one; the folder has to be named for
    that, by hydra.run.dir or hydra.sweep.dir. What the command line says must agree with the checkpoint, but for what
    may change on the way, ``FREE_ON_RESUME``.

    Raises:
        FileExistsError: the folder holds another run, and ``resume`` does not name it.
        ValueError: the command line contradicts the checkpoint.
    """
    own = Path(HydraConfig.get().runtime.output_dir) / "checkpoint.pt"
    if cfg.resume == "auto":
        cfg.resume = str(own) if own.exists() else None
    elif cfg.resume is None and own.exists():
        raise FileExistsError(
            f"{own.parent} holds another run. Go on with it, resume={own}, or choose another hydra.run.dir."
        )
    if cfg.resume is None:
        return
    saved = OmegaConf.create(read_checkpoint(Path(cfg.resume))["config"])
    for key in ("algorithm", *(override.split("=")[0].lstrip("+~") for override in HydraConfig.get().overrides.task)):
        asked, was = OmegaConf.select(cfg, key), OmegaConf.select(saved, key)
        if asked != was and key.split(".")[0] not in FREE_ON_RESUME:
            raise ValueError(
                f"{key}={asked} contradicts the checkpoint {cfg.resume}, which was trained with {key}={was}. Leave it "
                f"out to go on, or start a run of its own without resume. What may change: {', '.join(FREE_ON_RESUME)}."
            )
        if asked != was:
            OmegaConf.update(saved, key, asked)
    saved.resume = cfg.resume
    with open_dict(cfg):
        cfg.clear()
        cfg.update(saved)
