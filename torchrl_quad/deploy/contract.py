"""The contract of an exported policy: what it reads and writes, its checksums, and what may be wrong with it."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.errors import MissingPackage, UserError, UserValueError, shown

VERSION = 4  # of the contract; raise it when a reader of the older one would misunderstand the new one
GRAPHS = ("policy", "observe", "advance", "judge", "episode")  # the ONNX files that a bundle may have
OTHERS = ("README.md", "policy.c", "policy.h", "starts.npz", "vectors.npz")  # files beside these and contract.json
MEASURED = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3}  # what each state must have
ENDS = ("crash", "success", "terminated", "truncated")  # how a state ends an episode
MOST_PIXELS = 2**18  # of an image; 256 of them are in vectors.npz
Contract = Mapping[str, Any]  # the content of contract.json, or a part of it
Fields = dict[str, Any]  # the same while it is written
Arrays = dict[str, NDArray[Any]]  # by name
Signature = dict[str, tuple[tuple[int, ...], str]]  # shapes, without batch and time, and dtypes by name


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
    """The network failed, or answered something else than four numbers from -1 to 1."""


def schema() -> Fields:
    """The JSON schema of ``contract.json``."""
    return json.loads((resources.files("torchrl_quad.deploy") / "contract.schema.json").read_text())


def schema_table() -> str:
    """The fields of the contract with their meaning, and what numbers they may hold, as a table in Markdown."""
    rows = [f"| `{name}` | {entry['description']} | {_range(entry)} |" for name, entry in _fields(schema())]
    return "\n".join(("| field | meaning | numbers |", "|---|---|---|", *rows))


def _fields(part: Contract, prefix: str = "") -> Iterator[tuple[str, Contract]]:
    for name, entry in part["properties"].items():
        yield prefix + name, entry
        for key, between in (("properties", "."), ("items", "[]."), ("additionalProperties", ".*.")):
            inside = entry if key == "properties" else entry.get(key)
            if isinstance(inside, dict) and "properties" in inside:
                yield from _fields(inside, f"{prefix}{name}{between}")


def _range(entry: Contract) -> str:
    """The range of a field's numbers as an interval: [0, 1] with its ends, (0, 1) without."""
    while "prefixItems" in entry or "items" in entry:
        entry = entry["prefixItems"][-1] if "prefixItems" in entry else entry["items"]
    low = next(
        (f"{end}{entry[rule]:g}" for rule, end in (("minimum", "["), ("exclusiveMinimum", "(")) if rule in entry), ""
    )
    high = next(
        (f"{entry[rule]:g}{end}" for rule, end in (("maximum", "]"), ("exclusiveMaximum", ")")) if rule in entry), ""
    )
    return f"{low or '(-inf'}, {high or 'inf)'}" if low or high else ""


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


def writer(contract: Contract) -> str:
    """The package that wrote a contract, of which nothing is known yet."""
    origin = contract.get("origin")
    package = origin.get("package") if isinstance(origin, dict) else None
    return shown(package).strip("'") if isinstance(package, str) else "an unknown version"


# -- what the contract says --------------------------------------------------------------------------------------------

_BOUNDS = {"exclusiveMinimum": "above", "minimum": "at least", "maximum": "at most", "exclusiveMaximum": "below"}
_MUST = {
    **_BOUNDS,
    "type": "of type",
    "enum": "one of",
    "minItems": "of a length of at least",
    "maxItems": "of a length of at most",
    "maxLength": "of a length of at most",
    "maxProperties": "of a size of at most",
    "pattern": "like",
}


def problem(contract: Contract) -> str | None:
    """Where a contract does not fit its schema, or contradicts itself, if anywhere."""
    return next(itertools.chain(_misfits(contract), _contradictions(contract)), None)


def check(contract: Contract, path: Path) -> None:
    """Hold a contract against its schema, and what it says against itself, before anything uses it.

    Raises:
        UnknownContract: it does not fit.
        ImportError: jsonschema is missing.
    """
    if said := problem(contract):
        raise UnknownContract(
            f"{path}: {said}. This torchrl_quad cannot fly it. It was written by {writer(contract)}: use that "
            "one, or export again."
        )


def drone_problem(contract: Contract) -> str | None:
    """What is wrong with the drone of a contract that flies, the nominal one with the fields of ``plant``, or None."""
    return next(_plant_problems(contract), None)


def _plant_problems(contract: Contract) -> Iterator[str]:
    flies = {**contract["drone"], **contract["plant"]}
    yield from _misfits(flies, "drone", "plant")
    yield from _contradictions_of_a_drone(flies, "plant")


@functools.cache
def _validator() -> Any:
    try:
        from jsonschema import Draft202012Validator
        from jsonschema.validators import extend
    except ImportError as error:
        raise MissingPackage("A bundle is checked with jsonschema: pip install jsonschema") from error
    kinds = Draft202012Validator.TYPE_CHECKER.redefine("integer", lambda _, x: type(x) is int)  # 3.0 is none
    return extend(Draft202012Validator, type_checker=kinds)(schema())


def _misfits(value: Any, part: str | None = None, *at: str) -> Iterator[str]:
    """Where a contract, or a part of it, which stands at another place, does not fit the schema."""
    validator = _validator()
    if part is not None:
        validator = validator.evolve(schema=validator.schema["properties"][part])
    for error in validator.iter_errors(value):
        rule, wanted = error.validator, error.validator_value
        place = "".join(f"[{x}]" if isinstance(x, int) else f".{shown(x)[1:-1]}" for x in (*at, *error.absolute_path))
        place = place[1:] or "it"
        if rule == "required":
            yield f"{place} lacks {next(name for name in wanted if name not in error.instance)}"
        elif rule == "additionalProperties":
            known = error.schema.get("properties", {})
            yield f"{place} has {shown(next(name for name in error.instance if name not in known))}, which is unknown"
        else:
            wanted = ", ".join(map(str, wanted)) if isinstance(wanted, list) else wanted
            must = f"{_MUST[rule]} {wanted}" if rule in _MUST else wanted  # the others are constants
            yield f"{place} is {shown(error.instance)}, and must be {must}"


def _contradictions(contract: Contract) -> Iterator[str]:
    """Where a contract that fits the schema contradicts itself."""
    drone, output, limits = contract["drone"], contract["output"], contract["limits"]
    thrust, rates, ratio = output["thrust"], output["body_rate"]["range"], drone["max_thrust_to_weight"]
    dt, camera = contract["control_dt"], contract["camera"]
    yield from _contradictions_of_a_drone(drone, "drone", hovers=True)
    yield from _plant_problems(contract)
    equal = {
        "output.thrust.weight": (thrust["weight"], drone["mass"] * drone["gravity"]),
        "output.thrust.range[1]": (thrust["range"][1], ratio * thrust["weight"]),
        "output.thrust.range_in_weights[1]": (thrust["range_in_weights"][1], ratio),
        **{f"output.body_rate.range[{i}][1]": (x[1], drone["max_body_rate"][i]) for i, x in enumerate(rates)},
        **{f"output.body_rate.range[{i}][0]": (x[0], -drone["max_body_rate"][i]) for i, x in enumerate(rates)},
        "output.hover_action[0] + 1": (output["hover_action"][0] + 1.0, 2.0 / ratio),
        "limits.max_state_age": (limits["max_state_age"], (1 + contract["observation_delay"]) * dt),
    }
    if camera:
        equal["limits.max_depth_age"] = (limits["max_depth_age"] or 0.0, (camera["rate"] + camera["delay"]) * dt)
        if camera["width"] * camera["height"] > MOST_PIXELS:
            yield f"camera has {camera['width']} x {camera['height']} pixels, and may have {MOST_PIXELS}"
        equal["the norm of camera.quaternion"] = (math.hypot(*camera["quaternion"]), 1.0)
    for name, (value, wanted) in equal.items():
        if not math.isclose(value, wanted, rel_tol=1e-3):
            yield f"{name} is {value:g}, and must be {wanted:g} by its other fields"
    if any(output["hover_action"][1:]):
        yield f"output.hover_action is {output['hover_action']}, and must not turn"
    steps = dt / contract["simulator"]["dt"]
    if not math.isclose(steps, max(round(steps), 1), rel_tol=1e-6):
        yield f"control_dt is {dt:g}, and must be a whole multiple of simulator.dt"
    if set(contract["sha256"]) != {*files(contract)}:
        yield f"sha256 must be of {', '.join(files(contract))}"
    seen = contract["observation"]["seen"]
    marks = [seen[x] for x in ("least", "p1", "p99", "greatest")]
    if any(len(x) != contract["observation"]["size"] for x in marks):
        yield f"observation.seen must hold lists of {contract['observation']['size']} numbers"
    elif not all(a <= b for pair in itertools.pairwise(marks) for a, b in zip(*pair, strict=True)):
        yield "observation.seen must rise from least to greatest"
    yield from _contradictions_of_the_graphs(contract)


def _contradictions_of_the_graphs(contract: Contract) -> Iterator[str]:
    """Where graphs read what no bundle has, or write something else than it reads."""
    task, graphs, floats = contract["task"], contract["graphs"], contract["task"]["dtype"]
    judged = {"judge", "episode"} & graphs.keys()
    if judged != (set() if task["unjudged"] else {"judge", "episode"}):
        yield "graphs must have judge and episode, or task.unjudged say why not"
        return
    entries: Signature = {name: ((*x["shape"],), x["dtype"]) for name, x in task["entries"].items()}
    delay = contract["action_delay"]
    changing: Signature = {name: ((size,), floats) for name, size in MEASURED.items()}
    changing |= {"action_queue": ((delay, 4), floats)} if delay else {}
    if taken := entries.keys() & {*changing, "step"}:
        yield f"task.entries has {shown(min(taken))}, which is not the task's"
    step: Signature = {"step": ((1,), "int64")}
    now = changing | entries | step
    before = {f"previous.{name}": x for name, x in (changing | entries).items()}
    ends: Signature = dict.fromkeys(ENDS, ((1,), "bool"))
    found = {name: tuple(signature(graph[side]) for side in ("reads", "writes")) for name, graph in graphs.items()}
    metrics = {name: x for name, x in found.get("judge", ({}, {}))[1].items() if name.startswith("metrics.")}
    flight = {f"{prefix}{name}": x for name, x in now.items() for prefix in ("state.", "next.state.")}
    flight |= {f"next.{name}": x for name, x in (ends | metrics | {"done": ends["crash"]}).items()}
    camera, memory = contract["camera"], contract["memory"]
    policy: Signature = {"observation": ((contract["observation"]["size"],), "float32")}
    policy |= {"depth": ((1, camera["height"], camera["width"]), "float32")} if camera else {}
    policy |= {"memory": ((memory,), "float32")} if memory else {}
    answer: Signature = {"action": ((4,), "float32")}
    answer |= {"next_memory": ((memory,), "float32")} if memory else {}
    known = {
        "policy": (policy, answer),
        "observe": (now, {"observation": (policy["observation"][0], floats)}),
        "advance": (before | changing | step, entries),
        "judge": (now, ends | metrics),
        "episode": (flight | {"action": ((4,), floats)}, {name: ((), floats) for name in task["metrics"]}),
    }
    for graph, sides in found.items():
        for side, own, others in zip(("reads", "writes"), sides, known[graph], strict=True):
            for name in own:
                if own[name] != others.get(name):
                    wanted = "nothing of that name" if name not in others else shown(others[name])
                    yield f"graphs.{graph}.{side}.{shown(name)[1:-1]} is {shown(own[name])}, and must be {wanted}"
            if missing := others.keys() - own.keys() if graph != "advance" and side == "writes" else set():
                yield f"graphs.{graph}.{side} lacks {shown(min(missing))}"
        if not sides[0]:
            yield f"graphs.{graph}.reads is empty"
    if judged and not {"solved", "crash"} <= task["metrics"].keys():
        yield "task.metrics lacks solved or crash"
    if found["policy"][0] != policy:
        yield f"graphs.policy.reads must have {', '.join(policy)}"


def signature(tensors: Contract) -> Signature:
    """The shapes and types of what a graph reads or writes, by name."""
    return {name: ((*x["shape"],), x["dtype"]) for name, x in tensors.items()}


def files(contract: Contract) -> tuple[str, ...]:
    """The names of all files of a bundle but contract.json."""
    return (*OTHERS, *(f"{name}.onnx" for name in GRAPHS if name in contract["graphs"]))


def _contradictions_of_a_drone(drone: Contract, name: str, hovers: bool = False) -> Iterator[str]:
    """Why these parts do not make a drone, or one that hovers."""
    (k2, k1, k0), low, high = drone["thrust_map"], drone["rotor_speed_min"], drone["rotor_speed_max"]
    if not (k2 > 0 and k1 + 2 * k2 * low >= 0):
        yield f"{name}.thrust_map is {drone['thrust_map']}, and must rise from rotor_speed_min on"
    if not low < high:
        yield f"{name}.rotor_speed_min is {low:g}, and must be below rotor_speed_max, {high:g}"
    x, y = np.array(drone["rotor_positions"], float).T
    allocation = np.array([np.ones(4), y, -x, drone["yaw_torque_coefficient"] * np.array(drone["rotor_spin"], float)])
    rows = allocation / np.maximum(np.linalg.norm(allocation, axis=1, keepdims=True), 1e-30)
    if not np.linalg.cond(rows) < 1e4:  # as the package's own controller asks
        yield f"{name}.rotor_positions and rotor_spin cannot make thrust and torque about each axis on their own"
    elif hovers:
        share = np.linalg.inv(allocation)[:, 0] * drone["mass"] * drone["gravity"]
        least, most = (k2 * w * w + k1 * w + k0 for w in (low, high))
        if not ((least < share) & (share < most)).all():
            yield f"{name}: to hover each rotor must give {shown(share.round(4).tolist())} N, of {least:g} to {most:g}"
