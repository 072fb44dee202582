"""YAML presets: by the name of one that ships with the package, by path, or as a mapping."""

import math
import numbers
from collections.abc import Mapping, Sequence
from importlib.abc import Traversable
from pathlib import Path
from typing import Any

import yaml

from torchrl_quad.errors import UserValueError

MAX_BYTES = 1_000_000  # of a file; the largest that ships with the package has 1 kB
MAX_DEPTH = 20  # of lists and mappings within each other


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
        ValueError: the name is unknown, or the file is not a YAML mapping in UTF-8, is larger than 1 MB, is nested more
            than 20 deep, or uses aliases.
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
        raise UserValueError(f"Unknown {kind} {preset!r}. {choices} the path of a .yaml file, or a mapping.")
    if not path.is_file():
        raise FileNotFoundError(f"No {kind} file at {path}. {choices} the path of a .yaml file that exists.")
    with path.open("rb") as file:
        values = parse(file.read(MAX_BYTES + 1), source)
    if not isinstance(values, Mapping):
        raise UserValueError(f"{source}: expected a mapping of names to values, got {type(values).__name__}.")
    return source, values


def parse(content: bytes, source: str) -> Any:
    """The content of a YAML file, read in time and memory proportional to its size.

    Aliases are refused, since a file of a few lines can mean billions of values through them.

    Raises:
        ValueError: the content is too large, too deep, not in UTF-8, no YAML, or uses an alias.
    """
    if len(content) > MAX_BYTES:
        raise UserValueError(
            f"{source}: has more than {MAX_BYTES:,} bytes, which no file of settings needs. Leave out the rest."
        )
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        raise UserValueError(
            f"{source}: not in UTF-8 (byte {error.start} is {content[error.start]:#04x}). Save it as UTF-8."
        ) from None
    depth = 0
    try:
        for event in yaml.parse(text, yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                line = event.start_mark.line + 1
                raise UserValueError(
                    f"{source}: line {line} uses the alias *{event.anchor}. Write the values out instead."
                )
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise UserValueError(f"{source}: nests more than {MAX_DEPTH} lists or mappings. Write it flatter.")
    except yaml.YAMLError as error:
        raise UserValueError(f"{source}: not a YAML file: {error}") from error
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:  # such as the 99th of May
        raise UserValueError(f"{source}: not a YAML file: {error}") from error


def is_number(value: Any) -> bool:
    """Whether a setting is one finite number, of Python or of numpy."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def is_numbers(value: Any, count: int) -> bool:
    """Whether a setting is a list of so many finite numbers."""
    return isinstance(value, Sequence) and len(value) == count and all(is_number(x) for x in value)
