"""Trace the rules of a task into ONNX, so that a bundle runs them as the environment does, without the task's code.

One call of torch.onnx converts all methods together, which takes seconds. The graph of each file is cut out of the
result: what leads to its outputs, and nothing else. So what a method reads is found, and not declared.
"""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.export import ExportedProgram

from torchrl_quad.deploy.contract import ENDS, MEASURED
from torchrl_quad.deploy.network import OPSET, onnx_model
from torchrl_quad.engine.packing import Key
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.envs.guard import is_unit
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.errors import UserValueError, one_line

if TYPE_CHECKING:
    from onnx import ModelProto, ValueInfoProto

Tensors = dict[str, Tensor]
Method = Callable[[Tensors], Tensors]
STEPS = 7  # of the flight that ``episode_metrics`` is traced with
METHODS = {"observe": "observe", "judge": "is_crash and is_success", "measure": "metrics", "sum_up": "episode_metrics"}


class Rules(NamedTuple):
    """What a task computes outside the network."""

    #: ONNX models by name, "observe" and those that there are of "advance", "judge", "episode"
    graphs: dict[str, ModelProto]
    entries: dict[str, Key]  #: the keys in the state of the task's own entries that these read, by name
    obstacles: dict[str, Key]  #: the keys in the state of the obstacles that are judged by, by name
    unjudged: str | None  #: why there are no graphs "judge" and "episode", or None


def trace(env: QuadrotorEnv, state: State) -> Rules:
    """The rules of an environment's task as ONNX.

    Args:
        env: the environment.
        state: any complete states of it, (n, ...), where n is above 1 and not the number of its environments.

    Raises:
        ValueError: a rule depends on the number of environments, on random numbers, on what no drone measures, or on
            values in a way that cannot be traced.
    """
    rules = _Methods(env, state)
    with _quietly_without_randomness(env), torch.no_grad():
        program, outputs = _exported(rules)
        try:
            found: Any = torch.onnx.export(program, (), dynamo=True, opset_version=OPSET, verbose=False)
            model = found.model_proto
        except Exception as error:  # torch.onnx has many kinds
            raise _refusal(env, "torch.onnx cannot convert its rules", error) from error
    return _Cut(model, [*rules.inputs], outputs, map(name_of, env.task_entries)).rules(rules)


def name_of(key: Key) -> str:
    """The name of an entry of the state in ONNX and in a contract."""
    return key if isinstance(key, str) else ".".join(key)


# -- rules as functions of tensors by name -----------------------------------------------------------------------------


class _Methods:
    """The rules of a task as functions of tensors by name, with an example of what they read.

    What a bundle has, keeps its name in the state: the drone's quantities, the task's entries, ``step`` and
    ``action_queue``. ``previous.`` begins the names of the step before, ``flight.`` those of whole flights (n, time,
    ...), ``scene.`` those of obstacles, which only a judge has, and ``hidden.`` those of what a bundle does not have.
    """

    def __init__(self, env: QuadrotorEnv, state: State) -> None:
        self.env = env
        self.unjudged: str | None = None
        self._collided: tuple[Tensors, Tensor] | None = None
        self.changing = [*MEASURED, *(["action_queue"] if "action_queue" in state else [])]
        self.known = {name_of(key): key for key in (*self.changing, *env.task_entries, "step")}
        self.hidden = {f"hidden.{name_of(key)}": key for key in state if key not in self.known.values()}
        self.inputs = {name: state[key] for name, key in (self.known | self.hidden).items()}
        self.inputs |= {f"previous.{name}": state[name].clone() for name in self.changing}
        self.obstacles: dict[str, Key] = {
            name_of(key): key for key in state if isinstance(key, tuple) and key[0] == "scene"
        }
        self.inputs |= {name: state[key].clone() for name, key in self.obstacles.items()}
        self.methods: list[Method] = [self.observe, self.advance, self.judge, self.measure, self.sum_up]
        self.flight: dict[str, tuple[str, ...]] = {}
        self._add_flight(len(state["step"]))

    def _add_flight(self, n: int) -> None:
        """Add what ``episode_metrics`` may read."""
        env, x = self.env, self.inputs
        parts = {("next", name): torch.zeros(n, 1, dtype=torch.bool, device=env.device) for name in (*ENDS, "done")}
        parts |= {("next", "metrics", name): value for name, value in env.metrics(self.judged(x)).items()}
        parts |= {
            ("next", "reward"): env.tensor(n * [[0.0]]),
            ("action",): torch.zeros_like(env.hover_action).expand(n, -1),
        }
        for name, key in self.known.items():
            path = (key,) if isinstance(key, str) else key
            parts |= {("state", *path): x[name], ("next", "state", *path): x[name]}
        for path, value in parts.items():
            name = f"{'hidden' if 'reward' in path else 'flight'}.{name_of(path)}"
            self.flight[name] = path
            self.inputs[name] = torch.stack(STEPS * [value], 1)

    def state(self, x: Tensors) -> State:
        return {key: x[name] for name, key in (self.known | self.hidden).items()}

    def judged(self, x: Tensors) -> State:
        """The state with the obstacles, and whether the drone touched one on its way from the step before."""
        state, scene = self.state(x) | {key: x[name] for name, key in self.obstacles.items()}, self.env.scene
        if scene is not None:
            state["collided"] = torch.zeros_like(x["step"], dtype=torch.bool)
            if self._collided is None or self._collided[0] is not x:  # traced once for all that judge
                self._collided = x, scene.collided({"position": x["previous.position"]}, state)
            state["collided"] = self._collided[1]
        return state

    def observe(self, x: Tensors) -> Tensors:
        """``observation`` (n, k), as ControlStep.observe makes it from what the sensors show."""
        state = self.state(x)
        queue = [state["action_queue"].flatten(1)] if self.env.observe_last_action else []
        return {"observation": torch.cat((self.env.observe(state), *queue), -1)}

    def advance(self, x: Tensors) -> Tensors:
        """The task's entries now; given are those of the step before, and the drone then and now."""
        after = self.state(x)
        before = after | {name: x[f"previous.{name}"] for name in self.changing} | {"step": after["step"] - 1}
        advanced = self.env.advance(before, after)
        return {f"advance.{name_of(key)}": advanced[key] for key in self.env.task_entries}

    def judge(self, x: Tensors) -> Tensors:
        """How a state ends the episode, if it does; where the guard would replace it, it is a crash."""
        state, step = self.judged(x), self.env.control_step
        keep = is_unit(state["quaternion"]).unsqueeze(1)
        for key in MEASURED:
            low, high = (bound[:1] for bound in step.guard.bounds[key])
            keep = keep & ((state[key] >= low) & (state[key] <= high)).all(1, keepdim=True)
        ends = step.ends(state, keep)
        return {f"judge.{name}": ends[name] for name in ENDS}

    def measure(self, x: Tensors) -> Tensors:
        return {f"judge.metrics.{name}": value for name, value in self.env.metrics(self.judged(x)).items()}

    def sum_up(self, x: Tensors) -> Tensors:
        """The metrics of the first episode of each flight; none where they need what a flight lacks."""
        flight = TensorDict({}, x["flight.next.done"].shape[:2])
        for name, path in self.flight.items():
            flight[path] = x[name]
        try:
            found = self.env.episode_metrics(flight)
        except KeyError as missing:
            self.unjudged = f"episode_metrics reads what no flight has: {one_line(missing)}"
            return {}
        return {f"episode.{name}": value.to(self.env.dtype) for name, value in found.items()}


# -- from functions to one ONNX model ----------------------------------------------------------------------------------


class _Whole(nn.Module):
    """Some methods together, as torch.export takes them."""

    def __init__(self, methods: Iterable[Method]) -> None:
        super().__init__()
        self.methods = [*methods]

    def forward(self, x: Tensors) -> Tensors:
        return {name: found for method in self.methods for name, found in method(x).items()}


def _exported(rules: _Methods) -> tuple[ExportedProgram, list[str]]:
    """All methods as one exported program, and the names of its outputs."""
    try:
        return _export(rules, rules.methods)
    except Exception as error:  # of the task, or of torch.export; find the method whose mistake it is
        for method in rules.methods:
            try:
                _export(rules, [method])
            except Exception as its:
                name = METHODS.get(method.__name__, method.__name__)
                raise _refusal(rules.env, f"its {name} cannot be exported", its) from its
        raise _refusal(rules.env, "its rules cannot be exported together", error) from error


def _export(rules: _Methods, methods: list[Method]) -> tuple[ExportedProgram, list[str]]:
    whole, batch, time = _Whole(methods), torch.export.Dim("batch"), torch.export.Dim("time")
    shapes = {name: {0: batch, 1: time} if name in rules.flight else {0: batch} for name in rules.inputs}
    program = torch.export.export(whole, (rules.inputs,), dynamic_shapes=(shapes,), strict=False)
    for node in program.graph.nodes:
        if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
            raise UserValueError(RANDOM.format(node.target))
    return program, [*whole(rules.inputs)]


HOW = (
    " What is exported consists of torch operations on the state, for any number of drones: no .item(), no Python `if` "
    "on values (write torch.where), and no tensor with one row per environment (keep it in an entry of the state)."
)
RANDOM = "it draws random numbers ({}). Draw them in initial_state, and keep them in an entry of the state."


def _refusal(env: QuadrotorEnv, what: str, why: Exception) -> UserValueError:
    end = "" if isinstance(why, UserValueError) else HOW
    return UserValueError(f"export_policy: {type(env).__name__}: {what}: {one_line(why).rstrip('.')}.{end}")


@contextlib.contextmanager
def _quietly_without_randomness(env: QuadrotorEnv) -> Iterator[None]:
    """Refuse random numbers while rules are traced, which would be the same ones for ever; and silence torch.onnx,
    which tells of missing packages and of its own future."""

    class Refusing:
        tensor = env.randomness.tensor

        def __getattr__(self, name: str) -> Any:
            raise UserValueError(RANDOM.format(name))

    logger, randomness = logging.getLogger("torch.onnx"), env.randomness
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    env.randomness = cast(Randomness, Refusing())
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        env.randomness = randomness
        logger.setLevel(level)


# -- from one model to a graph for each file ---------------------------------------------------------------------------


class _Cut:
    """The one model, from which graphs are cut, with names of its inputs and outputs, and of the task's entries."""

    def __init__(self, model: ModelProto, inputs: list[str], outputs: list[str], entries: Iterable[str]) -> None:
        graph = model.graph
        self.nodes, self.constants = list(graph.node), {x.name: x for x in graph.initializer}
        self.maker = {name: node for node in self.nodes for name in node.output}
        self.inputs = {x.name: name for x, name in zip(graph.input, inputs, strict=True)}
        self.outputs = {name: x.name for x, name in zip(graph.output, outputs, strict=True)}
        ends = zip([*graph.input, *graph.output], [*inputs, *outputs], strict=True)
        self.types = {name: x.type.tensor_type for x, name in ends}
        self.reads = {name: {self.inputs[x] for x in self._behind(name) if x in self.inputs} for name in outputs}
        self.entries = [*entries]
        # What an input follows from: an entry from the step before, and a flight from its states.
        self.source = {name: f"advance.{name}" for name in self.entries} | {"flight.next.done": "judge.terminated"}
        self.source |= {f"flight.next.{x.removeprefix('judge.')}": x for x in outputs if x.startswith("judge.")}

    def _behind(self, *outputs: str) -> set[str]:
        """All values of the model that lead to outputs, with their own."""
        found = {self.outputs[x] for x in outputs}
        for node in reversed(self.nodes):  # which ONNX lists in the order in which they are computed
            if not found.isdisjoint(node.output):
                found.update(filter(None, node.input))  # "" is an input that is left out
        return found

    def _follows_from(self, *outputs: str) -> set[str]:
        """The inputs that outputs follow from, in this step and in those before."""
        found, todo = set(), [*outputs]
        while todo:
            for name in self.reads.get(todo.pop(), ()):
                name = name.removeprefix("flight.next.state.").removeprefix("flight.state.")
                if name not in found:
                    found.add(name)
                    todo += [self.source[name]] if name in self.source else []
        return found

    def _why_not(self, output: str) -> str | None:
        """Why a bundle cannot compute an output, if it cannot."""
        hidden = sorted(x.removeprefix("hidden.") for x in self._follows_from(output) if x.startswith("hidden."))
        return f"it follows from {hidden[0]!r}, which no drone measures" if hidden else None

    def rules(self, rules: _Methods) -> Rules:
        """The graphs, with the entries that they need, and none of what they do not."""
        task = type(rules.env).__name__
        if why := self._why_not("observation"):
            raise UserValueError(
                f"export_policy: {task}: its observation cannot be exported: {why}. A drone has "
                f"{', '.join(rules.known)}."
            )
        asked = [*(f"judge.{x}" for x in ENDS), "episode.solved", "episode.crash"]
        reasons = (f"{name.partition('.')[2]}: {why}" for name in asked if (why := self._why_not(name)))
        unjudged = rules.unjudged or next(reasons, None)
        judged = [] if unjudged else [x for x in self.outputs if x.startswith(("judge.", "episode."))]
        judged = [x for x in judged if not self._why_not(x)]
        needed = self._follows_from("observation", *judged)
        outputs = {
            "observe": ["observation"],
            "advance": [f"advance.{x}" for x in self.entries if x in needed and not self._stays(x)],
            "judge": [x for x in judged if x.startswith("judge.")],
            "episode": [x for x in judged if x.startswith("episode.")],
        }
        graphs = {name: self._graph(task, name, wanted) for name, wanted in outputs.items() if wanted}
        obstacles = {name: key for name, key in rules.obstacles.items() if name in needed}
        return Rules(graphs, {x: rules.known[x] for x in self.entries if x in needed}, obstacles, unjudged)

    def _stays(self, entry: str) -> bool:
        """Whether an entry keeps its value."""
        value = self.outputs[f"advance.{entry}"]
        while value in self.maker and self.maker[value].op_type == "Identity":
            value = self.maker[value].input[0]
        return self.inputs.get(value) == entry

    def _graph(self, task: str, name: str, wanted: list[str]) -> ModelProto:
        """The ONNX with only these outputs. Values are numbered, so that the same rules give the same bytes."""
        from onnx import helper, numpy_helper

        used = self._behind(*wanted)
        inputs = {value: x for value, x in self.inputs.items() if value in used}
        before = [f"previous.{x}" for x in self.entries] if name == "advance" else self.entries
        called = dict(zip(self.entries, before, strict=True))  # in "advance" their outputs have the plain names
        names = {value: called.get(x, x.removeprefix("flight.")) for value, x in inputs.items()}
        reads = [self._end(names[value], x) for value, x in inputs.items()]
        writes = [self._end(x.removeprefix(f"{name}."), x) for x in wanted]
        constants, nodes = [], []
        for value in (x for node in self.nodes for x in (*node.input, *node.output) if x in used):
            if value in self.constants and value not in names:
                names[value] = f"constant {len(constants)}"
                constants.append(numpy_helper.from_array(numpy_helper.to_array(self.constants[value]), names[value]))
            names.setdefault(value, f"value {len(names)}")
        for node in self.nodes:
            if used.isdisjoint(node.output):
                continue
            if node.op_type in ("If", "Loop", "Scan") or node.domain:  # loops might never end
                raise UserValueError(
                    f"export_policy: {task}: {name}.onnx would compute {node.domain}{node.op_type}, which bundles do "
                    "not. Write it with other operations of torch."
                )
            read, written = ([names.get(x, "") for x in side] for side in (node.input, node.output))
            nodes.append(helper.make_node(node.op_type, read, written))
            nodes[-1].attribute.extend(node.attribute)
        for output, end in zip(wanted, writes, strict=True):
            nodes.append(helper.make_node("Identity", [names[self.outputs[output]]], [end.name]))
        return onnx_model(name, nodes, reads, writes, constants)

    def _end(self, name: str, source: str) -> ValueInfoProto:
        """An input or output of a graph: its axes of batch and time are free."""
        from onnx import helper

        kind, free = self.types[source], ["batch", "time"] if "flight." in source else ["batch"]
        sizes = [x.dim_value for x in kind.shape.dim][len(free) :]
        return helper.make_tensor_value_info(name, kind.elem_type, [*free, *sizes])
