"""An exported policy in flight, without torch: numpy and onnxruntime run it."""

from __future__ import annotations

import io
import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.contract import (
    MEASURED,
    Arrays,
    BrokenPolicy,
    Contract,
    Fault,
    Fields,
    MissingQuantity,
    NegativeDepth,
    NotFinite,
    NotUnitQuaternion,
    StaleState,
    TamperedBundle,
    UnknownContract,
    WrongActions,
)
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.errors import UserTypeError, UserValueError, needing, one_line, shown

START = np.array([1.0, 0.0, 0.0, 0.0])  # the quaternion that the first one of a flight takes its sign from
AGAIN = "Export the policy again."
MOST = 1e6  # of a number that says where a flight starts in the task


class Graph:
    """A graph of a bundle, ready to run.

    Args:
        path: where it came from.
        content: ONNX.
        about: what the contract says of it: ``reads`` and ``writes``.

    Raises:
        TamperedBundle: onnxruntime cannot read it.
        ImportError: onnxruntime is missing.
    """

    def __init__(self, path: Path, content: bytes, about: Contract) -> None:
        with needing("A bundle flies with onnxruntime: pip install onnxruntime"):
            import onnxruntime
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            own = {"providers": ["CPUExecutionProvider"], "enable_fallback": 0}  # the fallback prints
            self.session = onnxruntime.InferenceSession(content, options, **own)
        except Exception as error:  # onnxruntime has a dozen kinds, with nothing else in common
            raise TamperedBundle(f"{path}: onnxruntime cannot read it: {one_line(error)}. {AGAIN}") from error
        self.name, self.reads = path.stem, [*about["reads"]]
        self.writes = {name: tuple(x["shape"]) for name, x in about["writes"].items()}

    def __call__(self, given: Arrays) -> Arrays:
        """What the graph makes of arrays (n, ...), by name; what it does not read is ignored.

        Raises:
            BrokenPolicy: it fails, or answers in other shapes than the contract says.
        """
        try:
            found: Any = self.session.run([*self.writes], {name: given[name] for name in self.reads})
        except Exception as error:  # see above
            raise BrokenPolicy(f"onnxruntime cannot run {self.name}.onnx: {one_line(error)}.") from error
        count = len(given[self.reads[0]])
        if [x.shape for x in found] != [(count, *shape) for shape in self.writes.values()]:
            shapes = ", ".join(str(x.shape) for x in found)
            raise BrokenPolicy(f"{self.name}.onnx answered arrays of the shapes {shapes}.")
        return dict(zip(self.writes, found, strict=True))


class Bundle:
    """A policy in flight: call it once in each control step. :func:`load_bundle` builds it.

    .. code-block:: python

        bundle = load_bundle("outputs/policy")
        bundle.check()
        bundle.reset()
        thrust, rates = bundle({"position": p, "quaternion": q, "velocity": v, "angular_velocity": w, "age": 0.004})

    It runs the task's own rules, as the export traced them, and keeps what the network does not: the commands on their
    way, the sign of the quaternion, where the flight is in the task (:attr:`progress`), and the memory of the network,
    if it has one. A visual policy also needs ``depth`` and ``depth_age`` in each call.

    Attributes:
        folder: where it came from; every message begins with it.
        contract: the content of ``contract.json``.
        graphs: its ONNX files, by name.
        observation: what the network read last, float32 (k).
        action: what it answered, or the hover action after a fault; float32 (k).
        memory: what the network remembers, float32 (m); zeros at the start of a flight, and as it was after a fault.
        queue: the last commands, oldest first, float32 (action_delay, k).
        faults: how many faults of each kind there were since the bundle was loaded, by the name of the error.
        last_fault: the last of them, or None.
    """

    def __init__(self, folder: Path, on_fault: Literal["raise", "hover"]) -> None:
        if on_fault not in ("raise", "hover"):
            raise UserValueError(f'on_fault must be "raise" or "hover", got {shown(on_fault)}.')
        contract, self.graphs, self._vectors, self._starts = _content(folder)
        self.folder, self.contract, self.on_fault = folder, contract, on_fault
        self.faults: Counter[str] = Counter()
        self.last_fault: Fault | None = None
        self._hover = np.array(contract["output"]["hover_action"], np.float32)
        self._limits, self._camera, self._dtype = contract["limits"], contract["camera"], contract["task"]["dtype"]
        low, high = np.array(contract["output"]["range"]).T
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._drone = Drone(contract["drone"])
        self.reset()

    def reset(self, **entries: Any) -> None:
        """Start a new flight; the counts of faults continue.

        Args:
            entries: where the flight starts in the task, by the names of ``contract["task"]["entries"]``: numbers, or
                arrays of the shape there. By default those of the first start in ``starts.npz``. Such as ``target`` (3)
                [m] in hovering and landing, ``phase`` [rad] in tracking, ``gate``, the index of the first one, in
                racing, ``target`` and ``speed`` [m/s] in the forest. ValueError for another shape, type or range.
        """
        task = self.contract["task"]
        if unknown := entries.keys() - task["entries"]:
            choices = ", ".join(task["entries"]) or "nothing; it has no entries"
            raise UserTypeError(
                f"{self.folder}: reset: {task['name']} has no {min(unknown)!r}. Choose from: {choices}."
            )
        given = {name: self._entry(name, value) for name, value in entries.items()}
        self._progress = {name: self._starts[name][:1] for name in task["entries"]} | given
        self.queue = np.tile(self._hover, (self.contract["action_delay"], 1))
        self.action = self._hover.copy()
        self.memory = np.zeros(self.contract["memory"], np.float32)
        self.observation: NDArray[np.float32] | None = None
        self._quaternion, self._before, self._step = START, None, 0

    @property
    def progress(self) -> Arrays:
        """The entries of the task by name, where the flight is in it, such as ``bundle.progress["gate"]``."""
        return {name: x[0].copy() for name, x in self._progress.items()}

    def __call__(self, state: Mapping[str, Any]) -> tuple[Any, Any]:
        """The command for this control step.

        Args:
            state: by name ``position`` (3) [m] and ``velocity`` (3) [m/s] in the world frame, ``quaternion`` (4)
                (w, x, y, z), body to world, of either sign, ``angular_velocity`` (3) [rad/s] in the body frame, and
                ``age`` [s], the time since they were measured. For a visual policy also ``depth`` (height, width) or
                (1, height, width) [m], rows from the top and each from the left, 0 where the camera measures nothing
                and its range, or more, where there is nothing; and ``depth_age`` [s], the time since the image. Other
                entries are ignored.

        Returns:
            by the contract's ``output.control``:

            - rates: the collective thrust [N] and the body rates (3) [rad/s];
            - attitude: the collective thrust [N], and roll and pitch [rad] with the rate of yaw [rad/s] (3);
            - velocity: the velocity (3) [m/s], world frame, and the rate of yaw [rad/s];
            - rotor_thrusts: the thrust of each rotor (n) [N], and the same as motor signals (n) from 0 to 1, by the
              thrust map of the drone: 0 is its ``rotor_speed_min``, 1 its ``rotor_speed_max``, and linear between.

        Raises:
            Fault: the policy cannot fly from this state; the bundle is as before the call, as after any other error.
                With ``on_fault="hover"`` the command is to hover instead, time continues with the drone where it was
                measured last, and :attr:`faults` counts it. A gate that is passed meanwhile counts with the next good
                state.
        """
        try:
            after = self._read(state)
        except Fault as fault:
            fault.args = (f"{self.folder}: {fault}",)
            self.faults[type(fault).__name__] += 1
            self.last_fault = fault
            if self.on_fault == "raise":
                raise
            after = {} if self._before is None else self._later(self._before | self._on_their_way())
            after["action"] = self._hover.copy()
        action = after["action"]
        after["queue"] = np.concatenate((self.queue[1:], action[None])) if len(self.queue) else self.queue
        command = self.command(action)
        vars(self).update(after)  # from here on nothing fails
        return command

    def command(self, action: NDArray[Any]) -> tuple[Any, Any]:
        """The pair that an action (k) commands, as a call returns it."""
        control, x = self.contract["output"]["control"], self.commanded(action)
        if control == "rotor_thrusts":
            low, high = self._drone.rotor_speed_min, self._drone.rotor_speed_max
            return x, (self._drone.speed(np.clip(x, *self._drone.thrust_limits)) - low) / (high - low)
        return (x[:3], float(x[3])) if control == "velocity" else (float(x[0]), x[1:])

    def commanded(self, action: NDArray[Any]) -> NDArray[np.float64]:
        """The same as numbers (k) in the contract's ``output.units``."""
        return self._middle + self._half * action

    def starts(self) -> Arrays:
        """The fresh starts that came with it: ``position``, ``quaternion``, ``velocity`` and ``angular_velocity``, as a
        call takes them, and what :meth:`reset` takes, each (n, ...). The contract's ``results`` began in them."""
        return {name: x.copy() for name, x in self._starts.items()}

    def check(self, tolerance: float = 1e-5) -> float:
        """Run the policy on all observations that came with it.

        Returns:
            the greatest difference from the actions and memories stored with them; WrongActions above the tolerance.
        """
        with contracts.naming(self.folder):
            found = self.graphs["policy"](self._vectors)
        error = max(float(np.abs(x - self._vectors[name]).max()) for name, x in found.items())
        if not error <= tolerance:
            raise WrongActions(
                f"{self.folder / 'policy.onnx'}: the policy differs by {error:.3g} from what it did when it was "
                f"exported, allowed are {tolerance:g}. This onnxruntime gives different results: do not fly with it."
            )
        return error

    def _later(self, now: Arrays) -> Fields:
        """The attributes that follow from a control step that leads to these measurements (1, ...)."""
        progress = self._progress
        if self._before is not None and "advance" in self.graphs:
            before = {f"previous.{name}": x for name, x in (self._before | progress).items()}
            progress = progress | self.graphs["advance"](before | now | {"step": np.array([[self._step + 1]])})
        step = self._step if self._before is None else self._step + 1
        return {"_progress": progress, "_step": step, "_before": now}

    def _read(self, state: Mapping[str, Any]) -> Fields:
        """What follows from a state: the attributes that this step changes."""
        if not isinstance(state, Mapping):
            raise MissingQuantity(f"The state must be a mapping of {', '.join(MEASURED)} and age, got {shown(state)}.")
        parts = [self._quantity(state, name, (size,)) for name, size in MEASURED.items()]
        age, most = float(self._quantity(state, "age", ())), self._limits["max_value"]
        if not (math.isfinite(age) and np.abs(np.concatenate(parts)).max() <= most):
            names = [name for name, part in zip(MEASURED, parts, strict=True) if not (np.abs(part) <= most).all()]
            raise NotFinite(f"Not finite, or beyond {most:g}: {', '.join(names) or 'age'}.")
        oldest = self._limits["max_state_age"]
        if not 0.0 <= age <= oldest:
            raise StaleState(f"The state is {age:g} s old; the contract allows 0 to {oldest:g} s.")
        quaternion, error = parts[1], self._limits["quaternion_norm_error"]
        norm = math.sqrt(float(quaternion @ quaternion))
        if not abs(norm - 1.0) <= error:
            raise NotUnitQuaternion(f"The quaternion has norm {norm:.6g}; it must be 1 to {error:g}.")
        parts[1] = quaternion / (norm if float(quaternion @ self._quaternion) >= 0.0 else -norm)
        seen = {} if self._camera is None else {"depth": self._image(state)}
        now = {name: x.astype(self._dtype)[None] for name, x in zip(MEASURED, parts, strict=True)}
        after = self._later(now | self._on_their_way())
        known = after["_before"] | after["_progress"] | {"step": np.array([[after["_step"]]])}
        observation = self.graphs["observe"](known)["observation"].astype(np.float32)
        found = self.graphs["policy"]({"observation": observation, "memory": self.memory[None], **seen})
        floats = [x for x in after["_progress"].values() if x.dtype.kind == "f"]
        if not all(np.isfinite(x).all() for x in (observation, *found.values(), *floats)):
            raise NotFinite("The action is not finite: the policy, its task, or what runs them, is broken.")
        (action,) = found["action"]
        if np.abs(action).max() > 1.0:
            raise BrokenPolicy(f"The action leaves -1 to 1, which no exported policy does: {action.tolist()}.")
        after |= {"action": action, "observation": observation[0], "_quaternion": parts[1]}
        return after | ({"memory": found["next_memory"][0]} if len(self.memory) else {})

    def _on_their_way(self) -> Arrays:
        """The commands on their way, as the rules of a task read them."""
        return {"action_queue": self.queue.astype(self._dtype)[None]} if len(self.queue) else {}

    def _entry(self, name: str, value: Any) -> NDArray[Any]:
        """An entry (1, ...) of the task to start with."""
        about = self.contract["task"]["entries"][name]
        shape, dtype = tuple(about["shape"]), np.dtype(about["dtype"])
        kinds, kind = {"b": ("b", "true or false"), "i": ("iu", "whole numbers")}.get(dtype.kind, ("iuf", "numbers"))
        low, high = (MOST * sign if about[x] is None else about[x] for x, sign in (("low", -1), ("high", 1)))
        given = np.asarray(value)
        fits = given.dtype.kind in kinds and (given.shape == shape or (given.ndim == 0 and shape == (1,)))
        if fits and ((low <= given) & (given <= high)).all():
            return given.astype(dtype).reshape(1, *shape)
        wanted = f"{kind} of shape {shape}" + ("" if dtype.kind == "b" else f", from {low:g} to {high:g}")
        raise UserValueError(f"{self.folder}: {name} must be {wanted}; got {shown(value)}.")

    def _image(self, state: Mapping[str, Any]) -> NDArray[np.float32]:
        """The image of a state, (1, 1, height, width), as the network reads it."""
        height, width = self._camera["height"], self._camera["width"]
        given = state.get("depth")
        if isinstance(given, np.ndarray) and given.dtype.kind in "iu":
            raise MissingQuantity(f"depth holds whole numbers, {given.dtype}: give metres. Are they millimetres?")
        depth = self._quantity(state, "depth", (height, width), (1, height, width))
        age, oldest = float(self._quantity(state, "depth_age", ())), self._limits["max_depth_age"]
        for name, value in (("depth_age", age), ("depth", depth)):
            if not np.isfinite(value).all():
                raise NotFinite(f"Not finite: {name}. Give 0 for a pixel that measures nothing, and the range for far.")
        if depth.min() < 0.0:
            raise NegativeDepth(f"depth must not be negative, got {depth.min():g} m. Write 0 for nothing measured.")
        if not 0.0 <= age <= oldest:
            raise StaleState(f"The image is {age:g} s old; the contract allows 0 to {oldest:g} s.")
        return np.minimum(depth, self._camera["range"]).astype(np.float32).reshape(1, 1, height, width)

    def _quantity(self, state: Mapping[str, Any], name: str, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
        """A quantity of a state, in one of these shapes."""
        try:
            given = state[name]
        except KeyError:
            needed = ", ".join((*MEASURED, *(["depth", "depth_age"] if self._camera else [])))
            since = ", the time since that was measured [s]" if "age" in name else ""
            raise MissingQuantity(f"The state lacks {name!r}{since}: give {needed} and age.") from None
        try:
            value = np.asarray(given)
            numbers = value.astype(float, copy=False) if value.dtype.kind in "fiuO" else None  # no text, no flags
        except Exception:  # whatever a foreign type raises when converted
            numbers = None
        if numbers is None:
            wanted = f"{math.prod(shapes[0])} numbers" if shapes[0] else "a number [s]"
            raise MissingQuantity(f"{name} must be {wanted}, got {shown(given)}.")
        if numbers.shape not in shapes:
            raise MissingQuantity(f"{name} must have shape {' or '.join(map(str, shapes))}, got {numbers.shape}.")
        return numbers


def load_bundle(folder: str | Path, on_fault: Literal["raise", "hover"] = "raise") -> Bundle:
    """Load what :func:`~torchrl_quad.deploy.export_policy` wrote, and check that it is unchanged.

    Checksums show accidents only: whoever changes a file on purpose writes new ones. So load bundles of people you
    trust. The contract is also held against its schema, and its drone must be one that can hover.

    Args:
        folder: with ``contract.json`` in it.
        on_fault: what a state does that the policy cannot fly from: "raise" an error, or "hover": command to hover, and
            count it.

    Raises:
        FileNotFoundError: there is no bundle.
        TamperedBundle: a file is missing, damaged or was changed.
        UnknownContract: the contract has another version, field or range.
        ImportError: onnxruntime or jsonschema is missing.
    """
    return Bundle(Path(folder), on_fault)


def _content(folder: Path) -> tuple[Contract, dict[str, Graph], Arrays, Arrays]:
    """The contract, the graphs, the vectors and the starts of a bundle, when every checksum fits."""
    path = folder / "contract.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"No bundle at {folder}: it has no contract.json. Export one: "
            "python recipes/export.py checkpoint=.../checkpoint.pt"
        )
    try:
        contract = json.loads(path.read_bytes())
        version, fits = contract["version"], contracts.digest(contract) == contract["digest"]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        why = f"it lacks {error}" if isinstance(error, KeyError) else one_line(error)
        raise TamperedBundle(f"{path} is no contract of a policy, or is damaged: {why}. {AGAIN}") from error
    package = contract.get("origin", {}).get("package", "another version")
    written = f"It was written by {package}: use that one, or export again."
    if version != contracts.VERSION:
        reads = f"this torchrl_quad reads {contracts.VERSION}"
        raise UnknownContract(f"{path} has version {shown(version)}, and {reads}. {written}")
    changed = f"was changed after the export: its checksum does not fit. {AGAIN}"
    if not fits:
        raise TamperedBundle(f"{path} {changed}")
    if said := contracts.problem(contract):
        raise UnknownContract(f"{path}: {said}. This torchrl_quad cannot fly it. {written}")
    content = {}
    for name in contracts.files(contract):
        try:
            content[name] = (folder / name).read_bytes()
        except OSError as error:
            raise TamperedBundle(f"{folder / name} cannot be read: {error.strerror}. {AGAIN}") from error
        if contracts.sha256(content[name]) != contract["sha256"][name]:
            raise TamperedBundle(f"{folder / name} {changed}")
    graphs = {
        name: Graph(folder / f"{name}.onnx", content[f"{name}.onnx"], x) for name, x in contract["graphs"].items()
    }
    vectors, starts = (dict(np.load(io.BytesIO(content[name]))) for name in ("vectors.npz", "starts.npz"))
    return contract, graphs, vectors, starts
