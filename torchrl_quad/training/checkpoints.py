"""Checkpoints: files with a checksum, which say what is wrong with them, and from which a run continues."""

from __future__ import annotations

import contextlib
import hashlib
import io
import shutil
import subprocess
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from torchrl_quad.dynamics import presets
from torchrl_quad.errors import UserError, UserValueError
from torchrl_quad.files import replacing
from torchrl_quad.training.configuration import named_code, plain, tuned
from torchrl_quad.training.schema import check, settings

FORMAT = 5  # of the content; raise it when older files can no longer be read
MARK = b"\ntorchrl_quad checkpoint, sha256 "  # then 64 digits: the checksum of all bytes before the mark
# Settings that a resumed run may change.
MAY_CHANGE = ("resume", "trust", "total_steps", "threads", "compile", "max_skipped", "diagnostics", "eval", "logger")


def previous(path: Path) -> Path:
    """Where the checkpoint before this one is kept."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def write_checkpoint(path: Path, content: dict[str, Any], keep: Path | None = None) -> None:
    """Write a checkpoint, completely or not at all, and keep an intact one as the previous."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, **content}, buffer)
    payload = buffer.getvalue()
    with replacing(path) as temporary:
        temporary.write_bytes(payload + MARK + hashlib.sha256(payload).hexdigest().encode())
        if keep is not None and keep != previous(path) and keep.exists():
            with replacing(previous(path)) as copy:
                shutil.copyfile(keep, copy)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read the content of a checkpoint, on the CPU. Nothing in the file is executed."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No checkpoint at {path}. Train one first: python recipes/abpt.py")
    payload, mark, checksum = path.read_bytes().rpartition(MARK)
    if not mark:
        raise UserValueError(f"{path} is cut off, or no checkpoint of these recipes. {_way_out(path)}")
    if hashlib.sha256(payload).hexdigest().encode() != checksum:
        raise UserValueError(f"{path} is damaged: its checksum does not fit its content. {_way_out(path)}")
    try:
        content = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    except Exception as error:
        said = (str(error) or repr(error)).splitlines()[0]
        raise UserValueError(
            f"{path} cannot be read. Checkpoints hold only tensors and plain values; anything else could run code, and "
            f"is not loaded. {_way_out(path)} torch says: {said}"
        ) from error
    content = content if isinstance(content, dict) else {}
    if content.get("format") != FORMAT:
        raise UserValueError(
            f"{path} has checkpoint format {content.get('format')}, this version reads format {FORMAT}. It was written "
            f"by torchrl_quad {content.get('version')} at revision {content.get('revision')}: use that version, or "
            "train again."
        )
    return content


def _way_out(path: Path) -> str:
    if previous(path).exists():
        return f"Continue from the checkpoint before it: resume={previous(path)}"
    return "There is none before it to continue from: train again."


def take_over(cfg: DictConfig, folder: Path) -> None:
    """Replace the configuration by that of the checkpoint that ``cfg.resume`` names.

    ``resume=auto`` means the checkpoint in the run's own folder, if there is one. The command line must agree with the
    checkpoint, except for ``MAY_CHANGE``.
    """
    own = folder / "checkpoint.pt"
    if cfg.resume == "auto":
        cfg.resume = str(own) if own.exists() else None
    elif cfg.resume is None and own.exists():
        raise FileExistsError(
            f"{folder} holds another run. Continue with it, resume={own}, or choose another hydra.run.dir."
        )
    if cfg.resume is None:
        return
    overrides = [override.lstrip("+~").partition("=") for override in HydraConfig.get().overrides.task]
    names = ["algorithm", *(name for name, _, _ in overrides)]
    for name, _, value in overrides:
        names += _leaves(plain(tuned()[value])) if name == "tuned" and value != "null" else []
    asked = {name: OmegaConf.select(cfg, name) for name in names}
    path = Path(cfg.resume)
    content = read_checkpoint(path)
    saved = saved_config(path, content, [*cfg.trust, *named_code(plain(cfg))])
    for key, value in asked.items():
        was = OmegaConf.select(saved, key)
        if value != was and key.split(".")[0] not in MAY_CHANGE:
            raise UserValueError(
                f"{key}={value} contradicts the checkpoint {cfg.resume}, which was trained with {key}={was}. Leave it "
                f"out to continue, or start a new run without resume. These may change: {', '.join(MAY_CHANGE)}."
            )
        if value != was:
            OmegaConf.update(saved, key, value)
    before = presets.parse(content["config"].encode(), str(path))
    known = settings(str(saved.algorithm))
    lacking = [f"no {name}" for name, default in known.items() if default is not None and name not in before]
    if differs := lacking + [name for name, value in _as_now(before, known)[1].items() if value]:
        raise UserValueError(
            f"{path} was written by an older {saved.algorithm}.py, which had {', '.join(differs)}. Continue it with "
            "that version, or start a new run without resume; evaluate.py and export.py read it."
        )
    saved.resume = cfg.resume
    with open_dict(cfg):
        cfg.clear()
        cfg.update(saved)


def _leaves(node: Mapping[str, Any], section: str = "") -> list[str]:
    """The whole names of the settings that a section sets, or the sections it begins with."""
    found = []
    for name, value in node.items():
        if name == "defaults":
            found += [x for other in value if other != "_self_" for x in _leaves(plain(tuned()[other]))]
        else:
            found += _leaves(value, f"{section}{name}.") if isinstance(value, dict) else [f"{section}{name}"]
    return found


def saved_config(path: Path, content: Mapping[str, Any], trust: Collection[str] = ()) -> DictConfig:
    """The configuration in a checkpoint, which has passed the schema like a command line.

    ``trust`` lists the paths of the classes that it may name; nothing else that a file names is imported.
    """
    source = f"{path}: the configuration in it"
    values = presets.parse(content["config"].encode(), source)
    if not isinstance(values, Mapping) or not isinstance(values.get("task"), str):
        raise UserValueError(f"{source} is no mapping with a task. Give the path of a checkpoint.pt.")
    if "${" in content["config"]:
        raise UserValueError(f"{source} refers to other values by ${{...}}, which no run writes. It is not read.")
    named = named_code(values)
    if not set(named) <= set(trust):
        raise UserValueError(
            f"{source} names {', '.join(named)}. Code that a file names is not run: if you trust it, write "
            f"'trust=[{', '.join(named)}]'."
        )
    try:
        known = settings(str(values.get("algorithm")))
        cfg = OmegaConf.create(_as_now(values, known)[0])
        check(cfg)
    except UserError as error:
        raise UserValueError(f"{source}: {error}") from error
    except OmegaConfBaseException as error:
        raise UserValueError(f"{source}: {str(error).splitlines()[0]}") from error
    return cfg


def _as_now(
    values: Mapping[str, Any], known: Mapping[str, Any], section: str = ""
) -> tuple[dict[str, Any], dict[str, Any]]:
    """A configuration with the settings that came after it, as they ship, and apart from it those that are gone.

    These are settings of the recipe, its networks and evaluations that this version has not, by their whole names.
    """
    now, gone = dict(known), {}
    for name, value in values.items():
        if name not in known and section in ("", "actor.", "critic.", "eval."):
            gone[f"{section}{name}"] = value
        elif isinstance(value, Mapping) and isinstance(known.get(name), Mapping):
            now[name], gone_from_it = _as_now(value, known[name], f"{section}{name}.")
            gone |= gone_from_it
        else:
            now[name] = value
    return now, gone


@contextlib.contextmanager
def fits(path: Path, what: str) -> Iterator[None]:
    """Raise a UserValueError that names the file whose content does not fit what its configuration builds."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        said = (str(error) or repr(error)).split("\n\t")[-1].splitlines()[0]
        told = f"{what} in it does not fit its configuration, or is of another version of this package"
        raise UserValueError(f"{path}: {told}: {said} {_way_out(path)}") from error


def revision() -> str:
    """The git commit of the code, with "-dirty" when the code differs from it; "unknown" outside its repository."""
    here = Path(__file__)

    def git(*words: str) -> str:
        command = ("git", "--no-optional-locks", *words)
        return subprocess.run(command, cwd=here.parent, capture_output=True, text=True, check=True).stdout

    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        git("ls-files", "--error-unmatch", here.name)  # an installed package may lie in a repository of something else
        changed = git("status", "--porcelain", "--", "..", "../../recipes")
        return git("rev-parse", "HEAD").strip() + ("-dirty" if changed else "")
    return "unknown"
