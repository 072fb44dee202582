"""Checkpoints: files with a checksum, which say what is wrong with them, and from which a run goes on."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from torchrl_quad.errors import UserValueError
from torchrl_quad.files import replacing

FORMAT = 3  # of the content; raise it when older files can no longer be read
MARK = b"\ntorchrl_quad checkpoint, sha256 "  # then 64 digits: the checksum of all bytes before the mark
FREE_ON_RESUME = ("resume", "total_steps", "threads", "compile", "max_skipped", "diagnostics", "eval", "logger")


def previous(path: Path) -> Path:
    """Where the checkpoint before this one is kept."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def write_checkpoint(path: Path, content: dict[str, Any], keep: Path | None = None) -> None:
    """Write a checkpoint, completely or not at all, and keep an intact one as the previous.

    Raises:
        OSError: the disk is full; all files are then as they were.
    """
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, **content}, buffer)
    payload = buffer.getvalue()
    with replacing(path) as temporary:
        temporary.write_bytes(payload + MARK + hashlib.sha256(payload).hexdigest().encode())
        if keep is not None and keep != previous(path) and keep.exists():
            with replacing(previous(path)) as copy:
                try:
                    os.link(keep, copy)
                except OSError:  # a file system without hard links
                    shutil.copyfile(keep, copy)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read the content of a checkpoint, on the CPU. Nothing in the file is executed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, cut off, foreign, or of another version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No checkpoint at {path}. Train one first: python recipes/abpt.py")
    payload, mark, checksum = path.read_bytes().rpartition(MARK)
    if mark and hashlib.sha256(payload).hexdigest().encode() != checksum:
        raise UserValueError(f"{path} is damaged: its checksum does not fit its content. {_way_out(path)}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        said = (str(error) or repr(error)).splitlines()[0]
        raise UserValueError(
            f"{path} cannot be read: it is cut off or damaged, or no checkpoint of these recipes, which hold tensors "
            f"and plain values only (anything else could run code, and is not loaded). {_way_out(path)} torch says: "
            f"{said}"
        ) from error
    if not isinstance(content, dict) or "config" not in content:
        raise UserValueError(f"{path} is not a checkpoint of these recipes. Give the path of a checkpoint.pt.")
    if content.get("format") != FORMAT:
        raise UserValueError(
            f"{path} has checkpoint format {content.get('format', 0)}, this version reads format {FORMAT}. It was "
            f"written by torchrl_quad {content.get('version', '0.1.0 or before')} at revision "
            f"{content.get('revision', 'unknown')}: use that version, or train again."
        )
    if not mark:
        raise UserValueError(f"{path} is damaged: its checksum is missing. {_way_out(path)}")
    return content


def _way_out(path: Path) -> str:
    if previous(path).exists():
        return f"Go on from the checkpoint before it: resume={previous(path)}"
    return "There is none before it to go on from: train again."


def take_over(cfg: DictConfig, folder: Path) -> None:
    """Replace the configuration by that of the checkpoint that ``cfg.resume`` names.

    ``resume=auto`` means the checkpoint in the run's own folder, if there is one; name the folder with hydra.run.dir or
    hydra.sweep.dir. The command line must agree with the checkpoint, except for ``FREE_ON_RESUME``.

    Raises:
        FileExistsError: the folder holds another run, and ``resume`` does not name it.
        ValueError: the command line contradicts the checkpoint.
    """
    own = folder / "checkpoint.pt"
    if cfg.resume == "auto":
        cfg.resume = str(own) if own.exists() else None
    elif cfg.resume is None and own.exists():
        raise FileExistsError(
            f"{folder} holds another run. Go on with it, resume={own}, or choose another hydra.run.dir."
        )
    if cfg.resume is None:
        return
    saved = OmegaConf.create(read_checkpoint(Path(cfg.resume))["config"])
    for key in ("algorithm", *(override.split("=")[0].lstrip("+~") for override in HydraConfig.get().overrides.task)):
        asked, was = OmegaConf.select(cfg, key), OmegaConf.select(saved, key)
        if asked != was and key.split(".")[0] not in FREE_ON_RESUME:
            raise UserValueError(
                f"{key}={asked} contradicts the checkpoint {cfg.resume}, which was trained with {key}={was}. Leave it "
                f"out to go on, or start a new run without resume. These may change: {', '.join(FREE_ON_RESUME)}."
            )
        if asked != was:
            OmegaConf.update(saved, key, asked)
    saved.resume = cfg.resume
    with open_dict(cfg):
        cfg.clear()
        cfg.update(saved)


def revision() -> str:
    """The git commit of the code, with "-dirty" when the code differs from it; "unknown" outside a repository."""

    def git(*words: str) -> str:
        command = ("git", "--no-optional-locks", *words)
        return subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True).stdout

    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        changed = git("status", "--porcelain", "--", "..", "../../torchrl_quad")
        return git("rev-parse", "HEAD").strip() + ("-dirty" if changed else "")
    return "unknown"
