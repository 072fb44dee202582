"""An exported policy in flight, without torch: numpy and onnxruntime run it."""

from __future__ import annotations

import inspect
import io
import math
import reprlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.contract import (
    Fault,
    MissingQuantity,
    NegativeDepth,
    NotFinite,
    NotUnitQuaternion,
    StaleState,
    UnknownContract,
    WrongActions,
)
from torchrl_quad.deploy.simulators.vehicle import rotate
from torchrl_quad.deploy.tasks import RULES
from torchrl_quad.errors import MissingPackage, UserTypeError, UserValueError

QUANTITIES = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3}  # that each state must have
START = np.array([1.0, 0.0, 0.0, 0.0])  # the quaternion that the first one of a flight takes its sign from
UP = np.array([0.0, 0.0, 1.0])
IN_BODY = "_in_body"  # ends the names of inputs that are vectors of the world frame, turned to the body frame


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
        contract: the content of ``contract.json``.
        observation: what the network read last, float32 (k).
        action: what it answered, or the hover action after a fault; float32 (4).
        memory: what the network remembers, float32 (m); zeros at the start of a flight, and as it was after a fault.
        queue: the last commands, oldest first, float32 (action_delay, 4).
        faults: how many faults of each kind there were since the bundle was loaded, by the name of the error.
        last_fault: the last of them, or None.
    """

    def __init__(
        self, contract: dict[str, Any], files: Mapping[str, bytes], on_fault: Literal["raise", "hover"]
    ) -> None:
        if on_fault not in ("raise", "hover"):
            raise UserValueError(f'on_fault must be "raise" or "hover", got {on_fault!r}.')
        try:
            import onnxruntime
        except ImportError as error:
            raise MissingPackage("A bundle flies with onnxruntime: pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        provider = ["CPUExecutionProvider"]
        self._session = onnxruntime.InferenceSession(files["policy.onnx"], options, providers=provider)
        self._vectors, self._starts = files["vectors.npz"], files["starts.npz"]
        self.contract, self.on_fault = contract, on_fault
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
        if contract["task"]["rule"] not in RULES:
            raise UnknownContract(
                f"The contract's task follows the rule {contract['task']['rule']!r}; this torchrl_quad knows "
                f"{', '.join(RULES)}. Use the one that exported it: {contract['origin']['package']}."
            )
        self.rule = RULES[contract["task"]["rule"]](contract["task"] | {"control_dt": contract["control_dt"]})
        self._names = [x["name"] for x in contract["inputs"]]
        self._turned = [name for name in self._names if name.endswith(IN_BODY)]
        self.reset()
        self._require_known_inputs()

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
                raise UserTypeError(f"reset: {task} has no {name!r}. Choose from: {', '.join(known)}.")
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
            Fault: the policy cannot fly from this state; the bundle is as before the call. With ``on_fault="hover"``
                the command is to hover instead, the time goes on, and :attr:`faults` counts it. A gate that is passed
                meanwhile counts with the next good state.
        """
        try:
            position = self._read(state)
        except Fault as fault:
            self.faults[type(fault).__name__] += 1
            self.last_fault = fault
            if self.on_fault == "raise":
                raise
            action = self._hover
            if self._begun:
                self.rule.advance(None, None)
        else:
            action, self._position = self._action, position
        self.action, self._begun = action, True
        if len(self.queue):
            self.queue = np.concatenate((self.queue[1:], action[None]))
        return self._half_thrust * (float(action[0]) + 1.0), self._max_rates * action[1:]

    def starts(self) -> dict[str, NDArray[Any]]:
        """The fresh starts that came with it: ``position``, ``quaternion``, ``velocity`` and ``angular_velocity``, as a
        call takes them, and what :meth:`reset` takes, each (n, ...). The contract's ``results`` began in them."""
        with np.load(io.BytesIO(self._starts)) as starts:
            return dict(starts)

    def check(self, tolerance: float = 1e-5) -> float:
        """Run the policy on all observations that came with it.

        Returns:
            the greatest difference from the actions, and memories, that came with them.

        Raises:
            WrongActions: the difference is above the tolerance.
        """
        with np.load(io.BytesIO(self._vectors)) as vectors:
            given = {x.name: vectors[x.name] for x in self._session.get_inputs()}
            expected = [vectors[x.name] for x in self._session.get_outputs()]
        found = self._session.run(None, given)
        error = max(float(np.abs(x - y).max()) for x, y in zip(found, expected, strict=True))
        if not error <= tolerance:
            raise WrongActions(
                f"The policy differs by {error:.3g} from what it did when it was exported, allowed are {tolerance:g}. "
                "This onnxruntime computes otherwise: do not fly with it."
            )
        return error

    def _read(self, state: Mapping[str, Any]) -> NDArray[np.float64]:
        """Compute the action from a state; the position in it. Nothing of the bundle changes before a fault."""
        if not isinstance(state, Mapping):
            raise MissingQuantity(f"The state must be a mapping of {', '.join(QUANTITIES)} and age, got {state!r}.")
        parts = [self._quantity(state, name, (size,)) for name, size in QUANTITIES.items()]
        age = self._age(state, "age", "it was measured")
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
        saved = vars(self.rule).copy()
        if self._begun:
            self.rule.advance(self._position, position)
        known = self.rule.inputs(position)
        known |= {"quaternion": quaternion, "velocity": velocity, "angular_velocity": angular_velocity}
        observation = (self._scale * self._assembled(known)).astype(np.float32)
        action, *memory = self._session.run(None, {"observation": observation[None], **seen, **remembered})
        if not all(math.isfinite(float(x.sum())) for x in (action, *memory)):
            vars(self.rule).update(saved)
            raise NotFinite("The action is not finite: the policy, or what runs it, is broken.")
        self.observation, self._action, self._quaternion = observation, action[0], quaternion
        if memory:
            self.memory = memory[0][0]
        return position

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
        age = self._age(state, "depth_age", "the image was taken")
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
            value = np.asarray(state[name], float)
        except KeyError:
            needed = ", ".join((*QUANTITIES, *(["depth", "depth_age"] if self._camera else [])))
            raise MissingQuantity(f"The state lacks {name!r}: give {needed} and age.") from None
        except (TypeError, ValueError):
            raise MissingQuantity(
                f"{name} must be {math.prod(shapes[0])} numbers, got {reprlib.repr(state[name])}."
            ) from None
        except OverflowError:
            raise NotFinite(f"Not finite, or beyond {self._max_value:g}: {name}.") from None
        if value.shape not in shapes:
            raise MissingQuantity(f"{name} must have shape {' or '.join(map(str, shapes))}, got {value.shape}.")
        return value

    def _age(self, state: Mapping[str, Any], name: str, since: str) -> float:
        try:
            return float(state[name])
        except KeyError:
            raise MissingQuantity(f"The state lacks {name!r}, the time since {since} [s].") from None
        except (TypeError, ValueError):
            raise MissingQuantity(f"{name} must be a number [s], got {state[name]!r}.") from None
        except OverflowError:
            raise NotFinite(f"Not finite, or beyond {self._max_value:g}: {name}.") from None

    def _is_sane(self, x: NDArray[np.float64]) -> bool:
        return bool((np.abs(x) <= self._max_value).all())

    def _require_known_inputs(self) -> None:
        names = {*self.rule.inputs(np.zeros(3)), "quaternion", "velocity", "angular_velocity", "up", "action_queue"}
        for name in self._names:
            if name.removesuffix(IN_BODY) not in names:
                raise UnknownContract(
                    f"The contract's policy reads {name!r}; this torchrl_quad knows {', '.join(sorted(names))}. Use "
                    f"the one that exported it: {self.contract['origin']['package']}."
                )


def load_bundle(folder: str | Path, on_fault: Literal["raise", "hover"] = "raise") -> Bundle:
    """Load what :func:`~torchrl_quad.deploy.export_policy` wrote, and check that nobody changed it since.

    Args:
        folder: with ``contract.json`` in it.
        on_fault: what a state does that the policy cannot fly from: "raise" an error, or "hover": command to hover, and
            count it.

    Raises:
        FileNotFoundError: there is no bundle.
        TamperedBundle: a file is missing or was changed.
        UnknownContract: the contract is of another version.
        ImportError: onnxruntime is missing.
    """
    return Bundle(*contracts.read(Path(folder)), on_fault)
