"""The contract of an exported policy: what it reads and writes, its checksums, and what may be wrong with it."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.airframe import contradictions, matrix, uncontrolled
from torchrl_quad.errors import UserError, UserValueError, needing, one_line, shown

VERSION = 5  # of the contract; raise it when a reader of the older one would misunderstand the new one
GRAPHS = ("policy", "observe", "advance", "judge", "episode")  # the ONNX files that a bundle may have
OTHERS = ("README.md", "policy.c", "policy.h", "starts.npz", "vectors.npz")  # files beside these and contract.json
AUTOPILOTS = ("betaflight.txt", "px4.params", "crazyflie.txt")  # and these, where they exist
MEASURED = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3}  # what each state must have
ENDS = ("crash", "success", "terminated", "truncated")  # how a state ends an episode
Contract = Mapping[str, Any]  # the content of contract.json, or a part of it
Fields = dict[str, Any]  # the same while it is written
Arrays = dict[str, NDArray[Any]]  # by name


class TamperedBundle(UserValueError):
    """A file of a bundle is missing, damaged, or not the one that was exported."""


class UnknownContract(UserValueError):
    """A contract has a version, a field or a number that this package does not fly."""


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


class BrokenPolicy(Fault):
    """The network failed, or answered something else than its numbers from -1 to 1."""


def schema() -> Fields:
    """The JSON schema of ``contract.json``."""
    return json.loads((resources.files("torchrl_quad.deploy") / "contract.schema.json").read_text())


def schema_table() -> str:
    """The fields of the contract with their meaning, as a table in Markdown."""
    rows = [f"| `{name}` | {entry['description']} |" for name, entry in _fields(schema())]
    return "\n".join(("| field | meaning |", "|---|---|", *rows))


def _fields(part: Contract, prefix: str = "") -> Iterator[tuple[str, Contract]]:
    for name, entry in part["properties"].items():
        yield prefix + name, entry
        for key, between in (("properties", "."), ("items", "[]."), ("additionalProperties", ".*.")):
            inside = entry if key == "properties" else entry.get(key)
            if isinstance(inside, dict) and "properties" in inside:
                yield from _fields(inside, f"{prefix}{name}{between}")


@contextlib.contextmanager
def naming(folder: str | Path) -> Iterator[None]:
    """Put the folder of a bundle before the message of what is refused in this block."""
    try:
        yield
    except UserError as error:
        if str(error).startswith(str(folder)):
            raise
        raise type(error)(f"{folder}: {error}") from error


def sha256(content: bytes) -> str:
    """The checksum of a file's content."""
    return hashlib.sha256(content).hexdigest()


def digest(contract: Contract) -> str:
    """The checksum of a contract, of all its fields but ``digest``."""
    rest = {key: value for key, value in contract.items() if key != "digest"}
    return sha256(json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False).encode())


# -- what the contract says --------------------------------------------------------------------------------------------


def problem(contract: Contract) -> str | None:
    """Where a contract does not fit its schema, or its drones cannot fly, if anywhere."""
    if misfit := next(_misfits(contract), None):
        return misfit
    drone = _contradictions(contract["drone"], "drone", hovers=True)
    return next(itertools.chain(_unequal(contract), drone), None) or drone_problem(contract)


def _unequal(contract: Contract) -> Iterator[str]:
    """Which parts of the output do not have an entry for each number of an action."""
    output, n = contract["output"], contract["graphs"]["policy"]["writes"].get("action", {}).get("shape")
    wrong = [name for name in ("order", "units", "range", "hover_action") if [len(output[name])] != n]
    if wrong:
        yield f"output.{wrong[0]} does not have as many entries as an action of the policy"
    elif output["control"] == "rotor_thrusts" and n != [len(contract["drone"]["rotor_spin"])]:
        yield "output: rotor_thrusts needs an entry for each rotor of the drone"


def drone_problem(contract: Contract) -> str | None:
    """What is wrong with the drone of a contract that flies, the nominal one with the fields of ``plant``, or None."""
    flies = {**contract["drone"], **contract["plant"]}
    return next(itertools.chain(_misfits(flies, "drone", "plant"), _contradictions(flies, "plant")), None)


def _misfits(value: Any, part: str | None = None, at: str = "") -> Iterator[str]:
    """Where a contract, or a part of it, which stands at another place, does not fit the schema."""
    with needing("A bundle is checked with jsonschema: pip install jsonschema"):
        from jsonschema import Draft202012Validator
    rules = schema() if part is None else schema()["properties"][part]
    for error in Draft202012Validator(rules).iter_errors(value):
        place = f"{at}{error.json_path.removeprefix('$')}".removeprefix(".") or "it"
        yield f"{place}: {one_line(error.message)}"


def files(contract: Contract) -> tuple[str, ...]:
    """The names of all files of a bundle but contract.json."""
    optional = (name for name in AUTOPILOTS if name in contract["sha256"])
    return (*OTHERS, *optional, *(f"{name}.onnx" for name in GRAPHS if name in contract["graphs"]))


def _contradictions(drone: Contract, name: str, hovers: bool = False) -> Iterator[str]:
    """Why these parts do not make a drone, or one that hovers."""
    (k2, k1, k0), low, high = drone["thrust_map"], drone["rotor_speed_min"], drone["rotor_speed_max"]
    each = [drone[k] for k in ("rotor_positions", "rotor_spin", "rotor_direction", "rotor_effectiveness") if k in drone]
    if len({len(x) for x in each}) > 1 or len({len(x) for x in each[0]}) > 1:
        yield f"{name}: rotor_positions and the other fields of rotors must be equally long"
        return
    allocation = matrix(drone)[:4]
    if not np.isfinite(allocation).all():
        yield f"{name}.rotor_direction has a rotor without a direction"
    elif axes := uncontrolled(allocation):  # as the package's own controller asks
        yield f"{name}.rotor_positions and rotor_spin cannot control {axes} independently"
    elif hovers:
        share = np.linalg.pinv(allocation)[:, 0] * drone["mass"] * drone["gravity"]
        least, most = (k2 * w * w + k1 * w + k0 for w in (low, high))
        if not ((max(least, 0.0) < share) & (share < most)).all():
            yield f"{name}: to hover each rotor must give {shown(share.round(4).tolist())} N, of {least:g} to {most:g}"
    yield from (f"{name}.{why}" for why in contradictions(drone))
