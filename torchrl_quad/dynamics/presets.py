"""YAML presets: by the name of one that ships with the package, by path, or as a mapping."""

from collections.abc import Mapping
from importlib.abc import Traversable
from pathlib import Path
from typing import Any

import yaml


def names(folder: Traversable) -> list[str]:
    """The presets in a folder of the package."""
    return sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def read(kind: str, preset: str | Path | Mapping, folder: Traversable | None = None) -> tuple[str, Mapping[str, Any]]:
    """What a preset says, and what to call it in an error.

    Args:
        kind: what it describes, for errors: "drone".
        preset: the name of a file in the folder, the path of a file that ends in .yaml, or a mapping.
        folder: where the package keeps its own; None where it has none.

    Raises:
        ValueError: the name is unknown, or the file is not a YAML mapping.
        FileNotFoundError: the path does not exist.
    """
    if isinstance(preset, Mapping):
        return kind, preset
    known = [] if folder is None else names(folder)
    choices = f"Choose from: {', '.join(known)}; or give" if known else "Give"
    if preset in known:
        source, path = f"{preset}.yaml", folder / f"{preset}.yaml"
    elif isinstance(preset, Path) or (isinstance(preset, str) and preset.endswith((".yaml", ".yml"))):
        source, path = str(preset), Path(preset)
    else:
        raise ValueError(f"Unknown {kind} {preset!r}. {choices} the path of a .yaml file, or a mapping.")
    if not path.is_file():
        raise FileNotFoundError(f"No {kind} file at {path}. {choices} the path of a .yaml file that exists.")
    try:
        values = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{source}: not a YAML file: {error}") from error
    if not isinstance(values, Mapping):
        raise ValueError(f"{source}: expected a mapping of names to values, got {type(values).__name__}.")
    return source, values
