"""YAML presets: by the name of one that ships with the package, by path, or as a mapping."""

import copy
import functools
import numbers
import os
import re
import tomllib
from collections.abc import Hashable, Mapping, Sequence
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from torchrl_quad.errors import UserValueError, shown

MAX_BYTES = 1_000_000  # of a file; the largest that ships with the package has 1 kB
MAX_DEPTH = 20  # of lists and mappings within each other
MAX_DIGITS = 400  # of a number
_ENDINGS = (".yaml", ".yml", ".toml", ".json")  # JSON is YAML, too


def names(folder: Traversable) -> list[str]:
    """The presets in a folder of the package."""
    return sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def read(kind: str, preset: str | Path | Mapping, folder: Traversable | None = None) -> tuple[str, Mapping[str, Any]]:
    """What a preset says, and its name in errors: a file by its name in a folder or its path, or a mapping.

    Raises:
        ValueError: the name is unknown, or :func:`parse` refuses the file, or it is no mapping.
        FileNotFoundError: the path does not exist.
    """
    if isinstance(preset, Mapping):
        return kind, preset
    known = {} if folder is None else {name: folder / f"{name}.yaml" for name in names(folder)}
    choices = f"Choose from: {', '.join(known)}; or give" if known else "Give"
    if isinstance(preset, str) and preset in known:
        source, path = f"{preset}.yaml", known[preset]
    elif isinstance(preset, Path) or (isinstance(preset, str) and preset.lower().endswith(_ENDINGS)):
        source, path = str(preset), Path(preset)
    elif isinstance(preset, str) and os.path.isfile(preset):
        raise UserValueError(
            f"{preset}: a {kind} is read from YAML or TOML, and this is neither. Write its numbers so."
        )
    else:
        raise UserValueError(f"Unknown {kind} {shown(preset)}. {choices} the path of a .yaml file, or a mapping.")
    if not path.is_file():  # which a pipe or a device is not, whose reading may never end
        raise FileNotFoundError(f"No {kind} file at {path}. {choices} the path of a .yaml file that exists.")
    with path.open("rb") as file:
        values = copy.deepcopy(_parsed(file.read(MAX_BYTES + 1), source))
    if not isinstance(values, Mapping):
        got = type(values).__name__
        raise UserValueError(f"{source}: expected a mapping of names to values, got {got}. Write each as name: value.")
    return source, values


@functools.lru_cache(maxsize=64)  # each environment reads its drone again, and a file takes milliseconds
def _parsed(content: bytes, source: str) -> Any:
    return (parse_toml if source.lower().endswith(".toml") else parse)(content, source)


def parse(content: bytes, source: str) -> Any:
    """The content of a YAML file, read in time and memory proportional to its size.

    Numbers are those of YAML 1.2: 1e-3 is one, and 1:30 is a string, as are dates. Aliases and tags are refused, since
    a file of a few lines can mean billions of values through them.

    Raises:
        ValueError: the content is too large, too deep, not in UTF-8, no YAML, or not plain values that come once.
    """
    if len(content) > MAX_BYTES:
        raise UserValueError(f"{source}: has more than {MAX_BYTES:,} bytes. Settings need less: leave out the rest.")
    try:
        return _Loader(content.decode()).get_single_data()
    except UnicodeDecodeError as error:
        byte = f"byte {error.start} is {content[error.start]:#04x}"
        raise UserValueError(f"{source}: not in UTF-8 ({byte}). Save it as UTF-8.") from None
    except yaml.YAMLError as error:
        raise UserValueError(f"{source}: not a YAML file: {' '.join(str(error).split())}") from error
    except UserValueError as error:
        raise UserValueError(f"{source}: {error}") from None


def parse_toml(content: bytes, source: str) -> Any:
    """The content of a TOML file; a ValueError if it is too large or none."""
    try:
        if len(content) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES:,} bytes")
        return tomllib.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise UserValueError(f"{source}: not a TOML file: {' '.join(str(error).split())}") from None


class _Loader(yaml.SafeLoader):
    """Plain values, each written once; what is YAML, but no setting needs, is a UserValueError."""

    yaml_implicit_resolvers = {}  # those of YAML 1.1 read 1:30 as 90 and 010 as 8, in time that grows with the square
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise UserValueError(f"line {line} uses the alias *{event.anchor}. Write the values out instead.")
        if event.tag is not None:
            raise UserValueError(f"line {line} uses the tag {shown(event.tag)}. Write the value without it.")
        self.depth += 1
        if self.depth > MAX_DEPTH + 1:  # the innermost is no list or mapping
            raise UserValueError(f"nests more than {MAX_DEPTH} lists or mappings. Write it flatter.")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        found: dict[Hashable, Any] = {}
        for key, value in node.value:
            where = f"line {key.start_mark.line + 1} names"
            if not isinstance(key, yaml.ScalarNode) or not key.value:
                kind = "nothing" if isinstance(key, yaml.ScalarNode) else "a list or a mapping"
                raise UserValueError(f"{where} a value by {kind}, and a name must be a word.")
            name = key.value  # as it stands there: on and 1, too
            if name in found:
                raise UserValueError(f"{where} {shown(name)} for the second time. Leave one of them out.")
            found[name] = self.construct_object(value, deep=True)
        return found

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        if len(node.value) > MAX_DIGITS:
            raise UserValueError(f"line {node.start_mark.line + 1} has a number of {len(node.value)} digits.")
        text = node.value.lower().replace(".inf", "inf").replace(".nan", "nan")
        if text.startswith(("0x", "0o")):
            return int(text, 0)
        return int(text) if re.fullmatch(f"[-+]?{_DIGITS}", text) else float(text)


_DIGITS = r"[0-9]+(_[0-9]+)*"
_NUMBER = rf"""(?xi: [-+]?(\.{_DIGITS} | {_DIGITS}(\.({_DIGITS})?)?) (e[-+]?[0-9]+)?
                | 0o[0-7]+ | 0x[0-9a-f]+ | [-+]?\.inf | \.nan)$"""
for _tag, _pattern, _first in (
    ("number", _NUMBER, "-+.0123456789"),
    ("bool", r"(?i:true|false|yes|no|on|off)$", "tTfFyYnNoO"),
    ("null", r"(?i:~|null|)$", ["~", "n", "N", ""]),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), list(_first))
_Loader.add_constructor("tag:yaml.org,2002:number", _Loader.construct_number)


def as_array(value: Any) -> NDArray[np.float64]:
    """A setting of numbers, or of lists of numbers that are equally long, as an array; a ValueError of all else."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "iuf":
        return value.astype(np.float64)
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes | bytearray):
        rows = [as_array(x) for x in value]
        if len({row.shape for row in rows}) > 1:
            raise ValueError("its lists have several lengths")
        return np.array(rows, np.float64)
    if not isinstance(value, numbers.Real) or isinstance(value, bool | np.bool_):
        raise ValueError(f"{shown(value)} is no number")
    try:
        return np.array(float(value))
    except OverflowError:
        raise ValueError(f"{shown(value)} is more than a float holds") from None
