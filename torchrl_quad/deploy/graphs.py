"""The ONNX graphs of a bundle: what they may hold, what they read and write, and how they run, without torch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchrl_quad.deploy.contract import Arrays, BrokenPolicy, Contract, TamperedBundle
from torchrl_quad.errors import MissingPackage, one_line

OPSET, IR_VERSION = 20, 10  # onnxruntime reads both since 1.18
AGAIN = "Export the policy again."
# What the network of a policy computes; see network.py. SiLU and Mish are two operators.
POLICY_OPERATORS = {
    *("Celu", "Clip", "Concat", "Conv", "Elu", "Flatten", "GRU", "Gelu", "Gemm", "HardSwish", "LeakyRelu", "Max"),
    *("Mish", "Mul", "Reciprocal", "Relu", "Selu", "Sigmoid", "Softplus", "Softsign", "Squeeze", "Tanh", "Unsqueeze"),
}
# The rules of a task may compute everything but these: loops might never end, and random numbers differ each time.
NOT_IN_TASKS = {
    *("Bernoulli", "Dropout", "If", "Loop", "Multinomial", "RandomNormal", "RandomNormalLike", "RandomUniform"),
    *("RandomUniformLike", "Scan", "SequenceMap"),
}


class Graph:
    """A graph of a bundle, ready to run.

    Args:
        path: where it came from.
        content: ONNX.
        about: what the contract says of it: ``reads`` and ``writes``.

    Raises:
        TamperedBundle: onnxruntime cannot read it, or it reads or writes something else than the contract says.
        ImportError: onnxruntime is missing.
    """

    def __init__(self, path: Path, content: bytes, about: Contract) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise MissingPackage("A bundle flies with onnxruntime: pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            own = {"providers": ["CPUExecutionProvider"], "enable_fallback": 0}  # the fallback prints
            self.session = onnxruntime.InferenceSession(content, options, **own)
        except Exception as error:  # onnxruntime has a dozen kinds, with nothing else in common
            raise TamperedBundle(f"{path}: onnxruntime cannot read it: {one_line(error)}. {AGAIN}") from error
        axes = ("batch", "time") if path.stem == "episode" else ("batch",)
        for verb, side in (("reads", self.session.get_inputs()), ("writes", self.session.get_outputs())):
            found = {x.name: (x.type, *x.shape) for x in side}
            wanted = {
                name: (f"tensor({ONNX_TYPES[x['dtype']]})", *(axes if verb == "reads" else axes[:1]), *x["shape"])
                for name, x in about[verb].items()
            }
            if found != wanted:
                found = one_line(found)
                raise TamperedBundle(f"{path} {verb} {found}, and the contract says {one_line(wanted)}. {AGAIN}")
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


ONNX_TYPES = {"float32": "float", "float64": "double", "int64": "int64", "bool": "bool"}


def foreign_parts(name: str, content: bytes) -> str | None:
    """What the ONNX file of this name holds that no export writes, if anything.

    Loops would run for ever, and weights in other files would read any file of this computer. This reads the wire
    format of protobuf, without onnx: a model has its graph as field 7, a graph its nodes as field 1, and a node its
    operator as field 4, its attributes as field 5 and its domain as field 7; an attribute a graph as 6 or 11.
    """
    if b"location" in content:
        return "keeps weights in another file"
    try:
        model = list(_fields(memoryview(content)))
        if others := sorted({number for number, _ in model} - {*range(1, 9), 14}):
            return f"has the fields {others[:9]} beside its graph"
        parts = [part for number, graph in model if number == 7 for part in _fields(graph)]
        nodes = [list(_fields(node)) for number, node in parts if number == 1]
        attributes = [field for node in nodes for number, part in node if number == 5 for field, _ in _fields(part)]
        used = {b".".join(bytes(dict(node)[i]) for i in (7, 4) if i in dict(node)).decode() for node in nodes}
    except (ValueError, KeyError, TypeError, IndexError):
        return "is damaged: it is no ONNX"
    is_policy = name == "policy.onnx"
    foreign = used - POLICY_OPERATORS if is_policy else {x for x in used if x in NOT_IN_TASKS or "." in x}
    if {6, 11} & {*attributes}:
        foreign |= {"a graph within a graph"}
    if foreign:
        what = "policy" if is_policy else "task"
        return f"computes {min(foreign)[:40]!r}, and no {what} that was exported does"
    return None


def _fields(message: memoryview) -> Iterator[tuple[int, Any]]:
    """The fields of a message of protobuf by number: whole numbers, and bytes."""
    at = 0

    def whole() -> int:
        nonlocal at
        value = 0
        for i in range(10):
            at += 1
            value |= (message[at - 1] & 127) << 7 * i
            if message[at - 1] < 128:
                return value
        raise ValueError("a number does not end")

    for _ in range(20_000):
        if at == len(message):
            return
        number, kind = divmod(whole(), 8)
        if kind == 0:
            yield number, whole()
            continue
        size = whole() if kind == 2 else {1: 8, 5: 4}[kind]
        yield number, message[at : at + size]
        at += size
    raise ValueError("it has more than 20000 fields, or ends within one")
