"""The contract of an exported policy: what it reads and writes, its checksums, and what may be wrong with it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from torchrl_quad.errors import UserValueError

VERSION = 3  # of the contract; raise it when a reader of the older one would misunderstand the new one
FILES = ("README.md", "policy.c", "policy.h", "policy.onnx", "starts.npz", "vectors.npz")  # beside contract.json


class TamperedBundle(UserValueError):
    """A file of a bundle is missing, damaged, or not the one that was exported."""


class UnknownContract(UserValueError):
    """A contract has a version that this package cannot read."""


class WrongActions(UserValueError):
    """The policy, run here, does not give the actions that it gave when it was exported."""


class Fault(UserValueError):
    """A policy cannot fly from the state that it was given. Its subclasses say why."""


class MissingQuantity(Fault):
    """The state lacks a quantity, or gives it in another size."""


class NotFinite(Fault):
    """A quantity, or the action that follows from it, is NaN or infinite."""


class NotUnitQuaternion(Fault):
    """The norm of the quaternion is not one."""


class StaleState(Fault):
    """The state, or its image, was measured longer ago than the contract allows, or has an age below zero."""


class NegativeDepth(Fault):
    """A pixel of the image is below zero."""


def schema() -> dict[str, Any]:
    """The JSON schema of ``contract.json``."""
    return json.loads((resources.files(__package__) / "contract.schema.json").read_text())


def schema_table() -> str:
    """The fields of the contract with their meaning, as a table in Markdown."""
    rows = [f"| `{name}` | {meaning} |" for name, meaning in _fields(schema())]
    return "\n".join(("| field | meaning |", "|---|---|", *rows))


def _fields(part: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, entry in part["properties"].items():
        yield prefix + name, entry["description"]
        inside = entry.get("items", entry)
        if "properties" in inside:
            yield from _fields(inside, f"{prefix}{name}{'[]' if 'items' in entry else ''}.")


def sha256(content: bytes) -> str:
    """The checksum of a file's content."""
    return hashlib.sha256(content).hexdigest()


def digest(contract: Mapping[str, Any]) -> str:
    """The checksum of a contract, of all its fields but ``digest``."""
    rest = {key: value for key, value in contract.items() if key != "digest"}
    return sha256(json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False).encode())


def read(folder: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The contract of a bundle and the content of its files, when every checksum fits.

    Raises:
        FileNotFoundError: there is no contract in the folder.
        UnknownContract: it has another version.
        TamperedBundle: a file is not as it was exported.
    """
    path = folder / "contract.json"
    if not path.is_file():
        raise FileNotFoundError(f"No bundle at {folder}: it has no contract.json. Export one: python recipes/export.py")
    again = "Export the policy again."
    try:
        contract = json.loads(path.read_bytes())
        version, listed = contract["version"], contract["sha256"]
    except (ValueError, TypeError, KeyError) as error:
        raise TamperedBundle(f"{path} is no contract of a policy, or is damaged. {again}") from error
    if version != VERSION:
        raise UnknownContract(
            f"{path} has version {version!r}, and this torchrl_quad reads version {VERSION}. It was written by "
            f"{contract.get('origin', {}).get('package', 'an unknown version')}: use that one, or export again."
        )
    try:
        fits = digest(contract) == contract["digest"] and set(listed) == set(FILES)
    except (ValueError, TypeError, KeyError):
        fits = False
    if not fits:
        raise TamperedBundle(f"{path} was changed after the export: its checksum does not fit. {again}")
    files = {}
    for name in FILES:
        try:
            files[name] = (folder / name).read_bytes()
        except OSError as error:
            raise TamperedBundle(f"{folder / name} cannot be read: {error.strerror}. {again}") from error
        if sha256(files[name]) != listed[name]:
            raise TamperedBundle(f"{folder / name} was changed after the export: its checksum does not fit. {again}")
    return contract, files
