"""The folder of a bundle, read: every file is held against the contract, and none is larger than it may be."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy.contract import (
    GRAPHS,
    MEASURED,
    OTHERS,
    VERSION,
    Arrays,
    Contract,
    Fields,
    Signature,
    TamperedBundle,
    UnknownContract,
    check,
    digest,
    files,
    sha256,
    signature,
    writer,
)
from torchrl_quad.deploy.graphs import AGAIN, Graph, foreign_parts
from torchrl_quad.errors import UserError, one_line, shown

MOST_BYTES = {"contract.json": 2**20, **dict.fromkeys((*OTHERS, *(f"{name}.onnx" for name in GRAPHS)), 2**28)}


class Content(NamedTuple):
    """What a bundle flies with."""

    contract: Contract
    graphs: dict[str, Graph]
    vectors: Arrays
    starts: Arrays


def read(folder: Path) -> Content:
    """Read a bundle, when every checksum fits and every file holds what the contract says.

    Raises:
        FileNotFoundError: there is no contract in the folder.
        UnknownContract: it has another version, does not fit the schema, or contradicts itself.
        TamperedBundle: a file is not as it was exported, or no contract and no policy at all.
        ImportError: jsonschema is missing.
    """
    path = folder / "contract.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"No bundle at {folder}: it has no contract.json. Export one: "
            "python recipes/export.py checkpoint=.../checkpoint.pt"
        )
    contract = _parsed(path)
    if type(contract["version"]) is not int or contract["version"] != VERSION:
        raise UnknownContract(
            f"{path} has version {shown(contract['version'])}, and this torchrl_quad reads version {VERSION}. It was "
            f"written by {writer(contract)}: use that one, or export again."
        )
    try:
        fits = digest(contract) == contract["digest"]
    except (ValueError, TypeError, RecursionError):
        fits = False
    if not fits:
        raise TamperedBundle(f"{path} was changed after the export: its checksum does not fit. {AGAIN}")
    check(contract, path)
    content, graphs = {}, {}
    for name in files(contract):
        content[name] = _content(folder / name)
        if sha256(content[name]) != contract["sha256"][name]:
            raise TamperedBundle(f"{folder / name} was changed after the export: its checksum does not fit. {AGAIN}")
    for name, about in contract["graphs"].items():
        own = folder / f"{name}.onnx"
        if problem := foreign_parts(own.name, content[own.name]):
            raise TamperedBundle(f"{own} {problem}. {AGAIN}")
        graphs[name] = Graph(own, content[own.name], about)
    policy = contract["graphs"]["policy"]
    expected = signature(policy["reads"]) | signature(policy["writes"])
    vectors = _arrays(folder / "vectors.npz", content["vectors.npz"], expected)
    return Content(contract, graphs, vectors, _starts(folder / "starts.npz", content["starts.npz"], contract))


def _content(path: Path) -> bytes:
    most = MOST_BYTES[path.name]
    try:
        if path.exists() and not path.is_file():  # who opens a pipe waits for ever
            raise TamperedBundle(f"{path} is no plain file. {AGAIN}")
        with open(path, "rb") as file:
            size = path.stat().st_size
            content = file.read(most + 1) if size <= most else b""
    except OSError as error:
        raise TamperedBundle(f"{path} cannot be read: {error.strerror}. {AGAIN}") from error
    if max(size, len(content)) > most:
        raise TamperedBundle(f"{path} is larger than {most >> 20} MiB, the most that is read. {AGAIN}")
    return content


def _parsed(path: Path) -> Fields:
    """The JSON of a contract, stricter than Python reads it."""
    try:
        contract = json.loads(
            _content(path).decode(),
            object_pairs_hook=_unique,
            parse_int=_whole,
            parse_float=_finite,
            parse_constant=_finite,
        )
    except (ValueError, RecursionError) as error:  # of a parser: all of it is about the file
        if isinstance(error, UserError):
            raise
        why = "it nests too deep" if isinstance(error, RecursionError) else str(error)
        raise TamperedBundle(f"{path} is no contract of a policy, or is damaged: {one_line(why)}. {AGAIN}") from error
    if not isinstance(contract, dict) or not {"version", "sha256", "digest"} <= contract.keys():
        raise TamperedBundle(f"{path} is no contract of a policy, or is damaged: it lacks its version. {AGAIN}")
    return contract


def _unique(pairs: list[tuple[str, Any]]) -> Fields:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice in one object")
    return found


def _whole(text: str) -> int:
    if len(text) > 20:
        raise ValueError("a whole number has more than 20 digits")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is no finite number")
    return value


# -- its arrays --------------------------------------------------------------------------------------------------------


def _arrays(path: Path, content: bytes, expected: Signature) -> Arrays:
    """The arrays (n, ...) of a file, of these shapes without n, all finite."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
            names = sorted(entry.filename for entry in archive.infolist())
        if not stored or names != sorted(f"{name}.npy" for name in expected):
            raise ValueError(f"it must hold only {', '.join(sorted(expected))}, not compressed")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in expected}
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for damaged files
        raise TamperedBundle(f"{path} is damaged: {one_line(error)}. {AGAIN}") from error
    count = len(arrays[next(iter(arrays))]) if arrays[next(iter(arrays))].ndim else 0
    for name, (shape, dtype) in expected.items():
        x = arrays[name]
        if not count or x.shape != (count, *shape):
            wanted = ", ".join(map(str, ("n", *shape)))
            raise TamperedBundle(f"{path}: {name} has shape {x.shape}, and must have ({wanted}), n above 0. {AGAIN}")
        if x.dtype != dtype or not np.isfinite(x).all():
            raise TamperedBundle(f"{path}: {name} must hold finite numbers in {dtype}. {AGAIN}")
    return arrays


def _starts(path: Path, content: bytes, contract: Contract) -> Arrays:
    task, limits = contract["task"], contract["limits"]
    expected = {name: ((size,), task["dtype"]) for name, size in MEASURED.items()} | signature(task["entries"])
    starts = _arrays(path, content, expected)
    norm = np.linalg.norm(starts["quaternion"].astype(float), axis=1)
    fits = {name: np.abs(starts[name]) <= limits["max_value"] for name in MEASURED}
    fits["quaternion"] = np.abs(norm - 1.0) <= limits["quaternion_norm_error"]
    fits |= {name: within(starts[name], about) for name, about in task["entries"].items()}
    for name, fit in fits.items():
        if not fit.all():
            value = shown(starts[name][np.flatnonzero(~fit.reshape(len(norm), -1).all(1))[0]].tolist())
            raise TamperedBundle(f"{path}: no flight starts with the {name} {value}. {AGAIN}")
    return starts


def within(values: NDArray[Any], about: Contract) -> NDArray[np.bool_]:
    """Which values of an entry of the task are between the bounds that the contract gives for it."""
    low, high = (np.inf * sign if about[end] is None else about[end] for end, sign in (("low", -1), ("high", 1)))
    values = values.astype(float)  # bounds of a damaged contract may be beyond float32
    return (values >= low) & (values <= high)
