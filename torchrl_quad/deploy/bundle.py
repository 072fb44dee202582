"""An exported policy in flight, without torch: numpy and onnxruntime run it."""

from __future__ import annotations

import copy
import inspect
import math
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.contract import (
    IN_BODY,
    BrokenPolicy,
    Fault,
    MissingQuantity,
    NegativeDepth,
    NotFinite,
    NotUnitQuaternion,
    StaleState,
    TamperedBundle,
    WrongActions,
)
from torchrl_quad.deploy.reading import AGAIN, QUANTITIES, Content, read, shapes_of
from torchrl_quad.deploy.simulators.vehicle import rotate
from torchrl_quad.deploy.tasks import RULES
from torchrl_quad.errors import MissingPackage, UserTypeError, UserValueError, one_line, shown

START = np.array([1.0, 0.0, 0.0, 0.0])  # the quaternion that the first one of a flight takes its sign from
UP = np.array([0.0, 0.0, 1.0])
SINCE = {"age": ", the time since it was measured [s]", "depth_age": ", the time since the image was taken [s]"}


class Bundle:
    """A policy in flight: call it once in each control step. :func:`load_bundle` builds it.

    .. code-block:: python

        bundle = load_bundle("outputs/policy")
        bundle.check()
        bundle.reset()
        thrust, rates = bundle({"position": p, "quaternion": q, "velocity": v, "angular_velocity": w, "age": 0.004})

    It keeps what the network does not: the commands on their way, the sign of the quaternion, the task's progress, and
    the memory of the network, if it has one. ``rule`` is the progress (:mod:`~torchrl_quad.deploy.tasks`):
    ``bundle.rule.gate``, for example. A policy that sees also needs ``depth`` and ``depth_age`` in each call.

    Attributes:
        folder: where it came from; every message begins with it.
        contract: the content of ``contract.json``.
        observation: what the network read last, float32 (k).
        action: what it answered, or the hover action after a fault; float32 (4).
        memory: what the network remembers, float32 (m); zeros at the start of a flight, and as it was after a fault.
        queue: the last commands, oldest first, float32 (action_delay, 4).
        faults: how many faults of each kind there were since the bundle was loaded, by the name of the error.
        last_fault: the last of them, or None.
    """

    def __init__(self, folder: Path, content: Content, on_fault: Literal["raise", "hover"]) -> None:
        if not isinstance(on_fault, str) or on_fault not in ("raise", "hover"):
            raise UserValueError(f'on_fault must be "raise" or "hover", got {shown(on_fault)}.')
        contract, policy, self._vectors, self._starts = content
        self.folder, self.contract, self.on_fault = folder, contract, on_fault
        self.faults: Counter[str] = Counter()
        self.last_fault: Fault | None = None
        output, limits = contract["output"], contract["limits"]
        self._half_thrust = 0.5 * output["thrust"]["range"][1]
        self._max_rates = np.array(output["body_rate"]["range"])[:, 1]
        self._hover = np.array(output["hover_action"], np.float32)
        self._max_age, self._norm_error = limits["max_state_age"], limits["quaternion_norm_error"]
        self._max_value = limits["max_value"]
        self._max_depth_age, self._camera = limits["max_depth_age"], contract["camera"]
        scales = [np.full(x["stop"] - x["start"], x["scale"]) for x in contract["inputs"]]
        self._scale = np.concatenate(scales)
        self.rule = RULES[contract["task"]["rule"]](contract["task"] | {"control_dt": contract["control_dt"]})
        self._names = [x["name"] for x in contract["inputs"]]
        self._turned = [name for name in self._names if name.endswith(IN_BODY)]
        self._reads, self._writes = shapes_of(contract)
        self.reset()
        self._session = self._opened(policy)

    def reset(self, **progress: Any) -> None:
        """Start a new flight; the counts of faults go on.

        Args:
            progress: where the flight starts in the task: ``target`` (3) [m] in hovering, landing and the forest, and
                there ``speed`` [m/s], by default the contract's; ``phase`` [rad] in tracking, by default 0; ``gate``,
                the index of the first, in racing, by default 0.
        """
        known = inspect.signature(self.rule.reset).parameters
        for name in progress:
            if name not in known:
                task = self.contract["task"]["name"]
                raise UserTypeError(f"{self.folder}: reset: {task} has no {name!r}. Choose from: {', '.join(known)}.")
        with contracts.naming(self.folder):
            self.rule.reset(**progress)
        self.queue = np.tile(self._hover, (self.contract["action_delay"], 1))
        self.action = self._hover.copy()
        self.memory = np.zeros(self.contract["memory"], np.float32)
        self.observation: NDArray[np.float32] | None = None
        self._quaternion, self._position = START, None
        self._begun = False

    def __call__(self, state: Mapping[str, Any]) -> tuple[float, NDArray[np.float64]]:
        """The command for this control step.

        Args:
            state: by name ``position`` (3) [m] and ``velocity`` (3) [m/s] in the world frame, ``quaternion`` (4)
                (w, x, y, z), body to world, of either sign, ``angular_velocity`` (3) [rad/s] in the body frame, and
                ``age`` [s], the time since they were measured. Of a policy that sees also ``depth`` (height, width) or
                (1, height, width) [m], rows from the top and each from the left, 0 where the camera measures nothing
                and its range, or more, where there is nothing; and ``depth_age`` [s], the time since the image. Other
                entries are ignored.

        Returns:
            the collective thrust [N] and the body rates (3) [rad/s].

        Raises:
            Fault: the policy cannot fly from this state; the bundle is as before the call, as after any other error.
                With ``on_fault="hover"`` the command is to hover instead, the time goes on, and :attr:`faults` counts
                it. A gate that is passed meanwhile counts with the next good state.
        """
        rule = copy.copy(self.rule)
        try:
            after = self._read(state, rule)
        except Fault as fault:
            fault.args = (f"{self.folder}: {fault}",)
            self.faults[type(fault).__name__] += 1
            self.last_fault = fault
            if self.on_fault == "raise":
                raise
            after = {"action": self._hover.copy()}
            if self._begun:
                rule.advance(None, None)
        action = after["action"]
        if len(self.queue):
            after["queue"] = np.concatenate((self.queue[1:], action[None]))
        command = self._half_thrust * (float(action[0]) + 1.0), self._max_rates * action[1:]
        vars(self.rule).update(vars(rule))  # from here on nothing fails
        vars(self).update(after, _begun=True)
        return command

    def starts(self) -> dict[str, NDArray[Any]]:
        """The fresh starts that came with it: ``position``, ``quaternion``, ``velocity`` and ``angular_velocity``, as a
        call takes them, and what :meth:`reset` takes, each (n, ...). The contract's ``results`` began in them."""
        return {name: x.copy() for name, x in self._starts.items()}

    def check(self, tolerance: float = 1e-5) -> float:
        """Run the policy on all observations that came with it.

        Returns:
            the greatest difference from the actions, and memories, that came with them.

        Raises:
            WrongActions: the difference is above the tolerance.
            ValueError: the tolerance is no number of at least 0.
        """
        if not isinstance(tolerance, (int, float)) or isinstance(tolerance, bool) or not tolerance >= 0:
            raise UserValueError(f"{self.folder}: tolerance must be a number, at least 0, got {shown(tolerance)}.")
        with contracts.naming(self.folder):
            found = self._run({name: self._vectors[name] for name in self._reads})
        error = max(float(np.abs(x - self._vectors[name]).max()) for name, x in zip(self._writes, found, strict=True))
        if not error <= tolerance:
            raise WrongActions(
                f"{self.folder / 'policy.onnx'}: the policy differs by {error:.3g} from what it did when it was "
                f"exported, allowed are {tolerance:g}. This onnxruntime computes otherwise: do not fly with it."
            )
        return error

    def _opened(self, policy: bytes) -> Any:
        """The network, when it reads and writes what the contract says."""
        try:
            import onnxruntime
        except ImportError as error:
            raise MissingPackage("A bundle flies with onnxruntime: pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        path = self.folder / "policy.onnx"
        try:
            own = {"providers": ["CPUExecutionProvider"], "enable_fallback": 0}  # which prints
            session = onnxruntime.InferenceSession(policy, options, **own)
        except Exception as error:  # onnxruntime has a dozen kinds, with nothing else in common
            why = one_line(error)
            raise TamperedBundle(f"{path}: onnxruntime cannot read it: {why}. {AGAIN}") from error
        for verb, side, shapes in (
            ("reads", session.get_inputs(), self._reads),
            ("writes", session.get_outputs(), self._writes),
        ):
            found = {x.name: (x.type, *x.shape) for x in side}
            wanted = {name: ("tensor(float)", "batch", *shape) for name, shape in shapes.items()}
            if found != wanted:
                found = one_line(found)
                raise TamperedBundle(f"{path} {verb} {found}, and the contract says {wanted}. {AGAIN}")
        return session

    def _run(self, given: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        """What the network makes of arrays (n, ...)."""
        try:
            found = self._session.run([*self._writes], given)
        except Exception as error:  # see above
            raise BrokenPolicy(f"onnxruntime cannot run the policy: {one_line(error)}.") from error
        count = len(given["observation"])
        if [x.shape for x in found] != [(count, *shape) for shape in self._writes.values()]:
            raise BrokenPolicy(f"The policy answered arrays of the shapes {', '.join(str(x.shape) for x in found)}.")
        return found

    def _read(self, state: Mapping[str, Any], rule: Any) -> dict[str, Any]:
        """What follows from a state: the attributes that this step changes. The rule, a copy, advances."""
        if not isinstance(state, Mapping):
            raise MissingQuantity(
                f"The state must be a mapping of {', '.join(QUANTITIES)} and age, got {shown(state)}."
            )
        parts = [self._quantity(state, name, (size,)) for name, size in QUANTITIES.items()]
        age = float(self._quantity(state, "age", ()))
        if not (math.isfinite(age) and np.abs(np.concatenate(parts)).max() <= self._max_value):
            names = [name for name, part in zip(QUANTITIES, parts, strict=True) if not self._is_sane(part)]
            raise NotFinite(f"Not finite, or beyond {self._max_value:g}: {', '.join(names) or 'age'}.")
        if not 0.0 <= age <= self._max_age:
            raise StaleState(f"The state is {age:g} s old; the contract allows 0 to {self._max_age:g} s.")
        position, quaternion, velocity, angular_velocity = parts
        norm = math.sqrt(float(quaternion @ quaternion))
        if not abs(norm - 1.0) <= self._norm_error:
            raise NotUnitQuaternion(f"The quaternion has norm {norm:.6g}; it must be 1 to {self._norm_error:g}.")
        quaternion = quaternion / (norm if float(quaternion @ self._quaternion) >= 0.0 else -norm)
        seen = {} if self._camera is None else {"depth": self._image(state)}
        remembered = {"memory": self.memory[None]} if len(self.memory) else {}
        if self._begun:
            rule.advance(self._position, position)
        known = rule.inputs(position)
        known |= {"quaternion": quaternion, "velocity": velocity, "angular_velocity": angular_velocity}
        observation = (self._scale * self._assembled(known)).astype(np.float32)
        (action,), *memory = self._run({"observation": observation[None], **seen, **remembered})
        if not all(math.isfinite(float(x.sum())) for x in (action, *memory)):
            raise NotFinite("The action is not finite: the policy, or what runs it, is broken.")
        if np.abs(action).max() > 1.0:
            raise BrokenPolicy(f"The action leaves -1 to 1, which no exported policy does: {action.tolist()}.")
        after = {"action": action, "observation": observation, "_quaternion": quaternion, "_position": position}
        return after | ({"memory": memory[0][0]} if memory else {})

    def _assembled(self, known: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """The entries of the observation before scaling, in their order, from vectors by name."""
        known |= {"action_queue": self.queue.ravel(), "up": UP}
        if self._turned:
            vectors = np.stack([known[name.removesuffix(IN_BODY)] for name in self._turned])
            known |= zip(self._turned, rotate(known["quaternion"][None], vectors, back=True), strict=True)
        return np.concatenate([known[name] for name in self._names])

    def _image(self, state: Mapping[str, Any]) -> NDArray[np.float32]:
        """The image of a state, (1, 1, height, width), as the network reads it."""
        height, width = self._camera["height"], self._camera["width"]
        given = state.get("depth")
        if isinstance(given, np.ndarray) and given.dtype.kind in "iu":
            raise MissingQuantity(f"depth holds whole numbers, {given.dtype}: give metres. Are they millimetres?")
        depth = self._quantity(state, "depth", (height, width), (1, height, width))
        age = float(self._quantity(state, "depth_age", ()))
        if not (math.isfinite(age) and np.isfinite(depth).all()):
            name = "depth" if math.isfinite(age) else "depth_age"
            raise NotFinite(f"Not finite: {name}. Give 0 for a pixel that measures nothing, and the range for far.")
        if depth.min() < 0.0:
            raise NegativeDepth(f"depth must not be negative, got {depth.min():g} m. Write 0 for nothing measured.")
        if not 0.0 <= age <= self._max_depth_age:
            raise StaleState(f"The image is {age:g} s old; the contract allows 0 to {self._max_depth_age:g} s.")
        return np.minimum(depth, self._camera["range"]).astype(np.float32).reshape(1, 1, height, width)

    def _quantity(self, state: Mapping[str, Any], name: str, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
        """A quantity of a state, in one of these shapes."""
        try:
            given = state[name]
        except KeyError:
            needed = ", ".join((*QUANTITIES, *(["depth", "depth_age"] if self._camera else [])))
            raise MissingQuantity(f"The state lacks {name!r}{SINCE.get(name, '')}: give {needed} and age.") from None
        try:
            value = np.asarray(given)
            numbers = value if value.dtype.kind in "fiuO" and not isinstance(given, (str, bytes)) else None
            numbers = None if numbers is None else numbers.astype(float, copy=False)
        except OverflowError:
            raise NotFinite(f"Not finite, or beyond {self._max_value:g}: {name}.") from None
        except Exception:  # whatever the conversion of somebody else's type raises
            numbers = None
        if numbers is None:
            wanted = f"{math.prod(shapes[0])} numbers" if shapes[0] else "a number [s]"
            raise MissingQuantity(f"{name} must be {wanted}, got {shown(given)}.")
        if numbers.shape not in shapes:
            raise MissingQuantity(f"{name} must have shape {' or '.join(map(str, shapes))}, got {numbers.shape}.")
        return numbers

    def _is_sane(self, x: NDArray[np.float64]) -> bool:
        return bool((np.abs(x) <= self._max_value).all())


def load_bundle(folder: str | Path, on_fault: Literal["raise", "hover"] = "raise") -> Bundle:
    """Load what :func:`~torchrl_quad.deploy.export_policy` wrote, and check that nobody changed it since.

    Checksums tell of accidents alone: who changes a file on purpose writes new ones. So the contract is also held
    against its schema and against itself, and the other files against the contract, before anything is used.

    Args:
        folder: with ``contract.json`` in it.
        on_fault: what a state does that the policy cannot fly from: "raise" an error, or "hover": command to hover, and
            count it.

    Raises:
        FileNotFoundError: there is no bundle.
        TamperedBundle: a file is missing, damaged or too large, was changed, or does not fit the contract.
        UnknownContract: the contract has another version, field or range, or contradicts itself.
        ImportError: onnxruntime or jsonschema is missing.
    """
    if not isinstance(folder, (str, os.PathLike)):
        raise UserTypeError(f"load_bundle: folder must be the path of a folder, got {shown(folder)}.")
    return Bundle(Path(folder), read(Path(folder)), on_fault)
