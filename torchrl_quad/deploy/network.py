"""The network of a policy with everything folded into its layers, written as ONNX and as C."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from importlib import resources
from string import Template
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy.contract import Contract

if TYPE_CHECKING:
    from onnx import ModelProto

Array = NDArray[np.float32]
OPSET, IR_VERSION = 20, 10  # onnxruntime reads both since 1.18

# By the name of a torch.nn activation with its default arguments: the ONNX operator (with those of its attributes that
# are not ONNX's defaults), and the C expression of x.
ACTIVATIONS: dict[str, tuple[str, str]] = {
    "CELU": ("Celu", "x > 0.0f ? x : expm1f(x)"),
    "ELU": ("Elu", "x > 0.0f ? x : expm1f(x)"),
    "GELU": ("Gelu", "0.5f * x * (1.0f + erff(x * 0.707106781f))"),
    "Hardswish": ("HardSwish", "x * fminf(fmaxf(x + 3.0f, 0.0f), 6.0f) / 6.0f"),
    "LeakyReLU": ("LeakyRelu", "x > 0.0f ? x : 0.01f * x"),
    "Mish": ("Mish", "x * tanhf(x > 20.0f ? x : log1pf(expf(x)))"),
    "ReLU": ("Relu", "x > 0.0f ? x : 0.0f"),
    "SELU": ("Selu", "1.05070099f * (x > 0.0f ? x : 1.67326324f * expm1f(x))"),
    "SiLU": ("SiLU", "x / (1.0f + expf(-x))"),  # no operator of its own in this opset
    "Sigmoid": ("Sigmoid", "1.0f / (1.0f + expf(-x))"),
    "Softplus": ("Softplus", "x > 20.0f ? x : log1pf(expf(x))"),
    "Softsign": ("Softsign", "x / (1.0f + fabsf(x))"),
    "Tanh": ("Tanh", "tanhf(x)"),
}


class Layer(NamedTuple):
    """A layer: activation(weight x + bias). A convolution halves height and width."""

    weight: Array  #: (out, in), of a convolution (out, in, 3, 3)
    bias: Array  #: (out)
    activation: str  #: one of ``ACTIVATIONS``; the last layer's is Tanh, and the action is clamped


class Memory(NamedTuple):
    """A gated recurrent unit as torch writes it: rows for the reset gate, the update gate, and the new value."""

    weight: Array  #: (3 m, in), of what it reads
    bias: Array  #: (3 m)
    own_weight: Array  #: (3 m, m), of the memory itself
    own_bias: Array  #: (3 m)


class Network(NamedTuple):
    """A policy: layers; of a visual one also convolutions before them; and a memory between the first two."""

    layers: list[Layer]  #: the first reads the features of the image, then the observation; the last gives the action
    convolutions: Sequence[Layer] = ()
    image: tuple[int, int] = (0, 0)  #: height and width
    nearest: float = 0.0  #: the convolutions read 1 / max(depth, nearest) [m]
    memory: Memory | None = None  #: reads what the first layer gives; the second one reads both
    max_loc: float = math.inf  #: the largest sum of the last layer

    @property
    def limit(self) -> float:
        """The largest action; TorchRL's TanhNormal keeps as far from -1 and 1."""
        return min(1.0 - 1e-6, math.tanh(self.max_loc))

    @property
    def images(self) -> list[tuple[int, int, int]]:
        """Channels, height and width of the image, and of what each convolution makes of it."""
        found = [(1, *self.image)]
        for layer in self.convolutions:
            _, height, width = found[-1]
            found.append((len(layer.bias), (height + 1) // 2, (width + 1) // 2))
        return found

    @property
    def features(self) -> int:
        """How many features the convolutions give."""
        return math.prod(self.images[-1]) if self.convolutions else 0

    @property
    def reads(self) -> dict[str, tuple[int, ...]]:
        """The shapes of what it reads, by name, without the batch."""
        shapes: dict[str, tuple[int, ...]] = {"observation": (self.layers[0].weight.shape[1] - self.features,)}
        shapes |= {"depth": self.images[0]} if self.convolutions else {}
        return shapes | ({"memory": (self.memory.own_weight.shape[1],)} if self.memory else {})

    def weights(self) -> Iterator[Array]:
        """All weights and biases, in the order in which they are used."""
        for layer in (*self.convolutions, self.layers[0]):
            yield from layer[:2]
        yield from self.memory or ()
        for layer in self.layers[1:]:
            yield from layer[:2]


# -- ONNX --------------------------------------------------------------------------------------------------------------


def write_onnx(network: Network) -> ModelProto:
    """The network as ONNX, all float32, with a free batch axis. The same weights give the same bytes.

    It reads ``observation`` (batch, k), ``depth`` (batch, 1, height, width) and ``memory`` (batch, m), of those that
    there are, and returns ``action`` (batch, actions) and ``next_memory``.
    """
    from onnx import TensorProto, helper, numpy_helper  # only who exports needs it

    nodes: list[Any] = []
    constants: list[Any] = []

    def add(operator: str, reads: Sequence[str], name: str, **options: Any) -> str:
        nodes.append(helper.make_node(operator, [*reads], [name] if operator != "GRU" else ["", name], **options))
        return name

    def constant(name: str, value: Any, dtype: Any = np.float32) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def run(layer: Layer, x: str, suffix: str) -> str:
        own = [constant(f"{name}_{suffix}", value) for name, value in zip(("weight", "bias"), layer, strict=False)]
        if layer.weight.ndim == 4:
            total = add("Conv", [x, *own], f"sum_{suffix}", strides=[2, 2], pads=[1, 1, 1, 1])
        else:
            total = add("Gemm", [x, *own], f"sum_{suffix}", transB=1)
        if layer.activation == "SiLU":
            return add("Mul", [total, add("Sigmoid", [total], f"gate_{suffix}")], f"layer_{suffix}")
        return add(ACTIVATIONS[layer.activation][0], [total], f"layer_{suffix}")

    x = "observation"
    if network.convolutions:
        image = add("Max", ["depth", constant("nearest", network.nearest)], "clamped")
        image = add("Reciprocal", [image], "inverse")
        for i, layer in enumerate(network.convolutions):
            image = run(layer, image, f"convolution_{i}")
        x = add("Concat", [add("Flatten", [image], "features"), x], "features_and_observation", axis=1)
    x = run(network.layers[0], x, "0")
    if network.memory:
        at = constant("axis", [0], np.int64)
        weight, bias, own_weight, own_bias = (  # of the update gate, the reset gate, and the new value
            np.concatenate([np.split(x, 3)[i] for i in (1, 0, 2)]) for x in network.memory
        )
        parts = {"memory_weight": weight, "memory_own_weight": own_weight, "memory_bias": np.append(bias, own_bias)}
        sequence, before = add("Unsqueeze", [x, at], "sequence"), add("Unsqueeze", ["memory", at], "before")
        reads = [sequence, *(constant(name, value[None]) for name, value in parts.items()), "", before]
        size = network.memory.own_weight.shape[1]
        after = add("GRU", reads, "after", hidden_size=size, linear_before_reset=1)
        x = add("Concat", [x, add("Squeeze", [after, at], "next_memory")], "recalled", axis=1)
    for i, layer in enumerate(network.layers[1:], 1):
        x = run(layer, x, f"{i}")
    add("Clip", [x, constant("low", -network.limit), constant("high", network.limit)], "action")
    shapes = network.reads
    written = {"action": (len(network.layers[-1].bias),)}
    written |= {"next_memory": shapes["memory"]} if network.memory else {}
    begin, end = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape]) for name, shape in side.items()]
        for side in (shapes, written)
    )
    return onnx_model("policy", nodes, begin, end, constants)


def onnx_model(name: str, nodes: list[Any], reads: list[Any], writes: list[Any], constants: list[Any]) -> ModelProto:
    """An ONNX model of one graph, checked."""
    import onnx
    from onnx import helper

    graph = helper.make_graph(nodes, name, reads, writes, constants)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, producer_name="torchrl_quad", ir_version=IR_VERSION, opset_imports=opset)
    onnx.checker.check_model(model, full_check=True)
    return model


# -- C -----------------------------------------------------------------------------------------------------------------


def write_c(network: Network, contract: Contract, vectors: Mapping[str, Array]) -> dict[str, bytes]:
    """The network as C99: the files ``policy.h`` and ``policy.c``; vectors (n, ...) by name are for the self-test."""
    output, reads = contract["output"], network.reads
    turns_rotors = output["control"] == "rotor_thrusts"
    names = sorted({layer.activation for layer in (*network.convolutions, *network.layers)})
    tests = {f"test_{name}": _rows(x.reshape(len(x), -1)) for name, x in vectors.items()}
    others = [name for name in reads if name != "observation"]
    parameters = {"depth": " const float depth[POLICY_DEPTH],", "memory": f"\n{18 * ' '}float memory[POLICY_MEMORY],"}
    between = [len(layer.weight) for layer in network.layers]
    between += [math.prod(image) for image in network.images] if network.convolutions else []
    arguments = {"depth": "test_depth + n * POLICY_DEPTH", "memory": "memory"}
    values = {
        "task": contract["task"]["name"],
        "version": contract["version"],
        "control_dt": as_float(contract["control_dt"]),
        "action_delay": contract["action_delay"],
        "hover_action": as_floats(output["hover_action"]),
        "actions": len(output["order"]),
        "names": ", ".join(f"{name} [{unit}]" for name, unit in zip(output["order"], output["units"], strict=True)),
        "middle": as_floats(0.5 * (high + low) for low, high in output["range"]),
        "half": as_floats(0.5 * (high - low) for low, high in output["range"]),
        **(_rotors(contract["drone"]) if turns_rotors else {}),
        "limit": as_float(network.limit),
        "activations": "\n".join(
            f"static float {name.lower()}_of(float x) {{ return {ACTIVATIONS[name][1]}; }}" for name in names
        ),
        "weights": "\n".join(_constants(network)),
        "vectors": len(vectors["action"]),
        "parameters": "".join(parameters[name] for name in others),
        "arguments": "".join(f", {arguments[name]}" for name in others),
        **{name: math.prod(shape) for name, shape in reads.items()},
        **tests,
        **dict(zip(("rows", "columns"), network.image, strict=True)),
        "width": max(between),  # floats between the steps
        "features": network.features,
        "recalled": network.layers[:2][-1].weight.shape[1],
        "layers": "\n".join(f"    {line}" for line in _steps(network)),
    }
    features = [*others, "rotors"] if turns_rotors else others
    return {name: fill_in(name, values, features).encode() for name in ("policy.h", "policy.c")}


def _rotors(drone: Contract) -> dict[str, str]:
    """The constants that turn the thrust of a rotor into its motor signal, with thrust k2 (w - w0)^2 + f0."""
    (k2, k1, k0), low, high = drone["thrust_map"], drone["rotor_speed_min"], drone["rotor_speed_max"]
    least, most = (k2 * w * w + k1 * w + k0 for w in (low, high))
    span = high - low
    numbers = {"least": max(least, 0.0), "most": most, "thrust_0": k0 - k1 * k1 / (4.0 * k2), "bend": 1.0 / k2}
    numbers |= {"signal_0": (-0.5 * k1 / k2 - low) / span, "per_speed": math.copysign(1.0, k2) / span}
    return {name: as_float(value) for name, value in numbers.items()}


def fill_in(template: str, values: Mapping[str, Any], features: Collection[str]) -> str:
    """A file from its template. Lines that begin with ``@name`` stay, without it, where there is such a feature."""
    lines = []
    for line in (resources.files("torchrl_quad.deploy") / "templates" / template).read_text().splitlines(keepends=True):
        marked = re.match(r"@(\w+) ?", line)
        if marked is None or marked[1] in features:
            lines.append(line[marked.end() if marked else 0 :])
    return Template("".join(lines)).substitute(values)


def _steps(network: Network) -> Iterator[str]:
    """The statements of the C code, one for each part of the network."""
    places = itertools.cycle(("one", "two"))
    x = "observation"
    if network.convolutions:
        x = next(places)
        yield f"for (int i = 0; i < POLICY_DEPTH; ++i) {x}[i] = 1.0f / fmaxf(depth[i], {as_float(network.nearest)});"
        images = network.images
        for i, (layer, (channels, height, width), after) in enumerate(
            zip(network.convolutions, images, images[1:], strict=False)
        ):
            y = "features" if i == len(network.convolutions) - 1 else next(places)
            own = f"kernel_{i}, kernel_bias_{i}"
            yield f"convolve({own}, {channels}, {height}, {width}, {x}, {after[0]}, {y});"
            yield _activate(layer, y, math.prod(after))
            x = y
        yield f"for (int i = 0; i < POLICY_OBSERVATION; ++i) features[{network.features} + i] = observation[i];"
    for i, layer in enumerate(network.layers):
        is_last = i == len(network.layers) - 1
        if i == 1 and network.memory:
            size, own = len(layer.weight[0]) - network.memory.own_weight.shape[1], "memory_weight, memory_bias"
            yield f"remember({own}, own_weight, own_bias, {size}, recalled, memory, recalled + {size});"
            x = "recalled"
        y = "action" if is_last else "recalled" if i == 0 and network.memory else next(places)
        rows, columns = layer.weight.shape
        yield f"sum(weight_{i}, bias_{i}, {columns}, {x}, {rows}, {y});"
        yield _activate(layer, y, rows)
        x = y


def _activate(layer: Layer, x: str, size: int) -> str:
    return f"for (int i = 0; i < {size}; ++i) {x}[i] = {layer.activation.lower()}_of({x}[i]);"


def _constants(network: Network) -> Iterator[str]:
    for i, layer in enumerate(network.convolutions):
        yield _constant(f"kernel_{i}", layer.weight.reshape(-1, 9))  # a row for each kernel
        yield _constant(f"kernel_bias_{i}", layer.bias)
    for i, layer in enumerate(network.layers):
        yield _constant(f"weight_{i}", layer.weight.T)  # one row for each input: the inner loop runs along memory
        yield _constant(f"bias_{i}", layer.bias)
    if network.memory:
        for name, value in zip(("memory_weight", "memory_bias", "own_weight", "own_bias"), network.memory, strict=True):
            yield _constant(name, value.T)


def _constant(name: str, value: Array) -> str:
    text = f"{{\n{_rows(value)}\n}}" if value.ndim == 2 else f"{{{as_floats(value)}}}"
    return f"static const float {name}[{value.size}] = {text};"


def _rows(values: Array) -> str:
    return ",\n".join(f"    {as_floats(row)}" for row in values)


def as_floats(values: Any) -> str:
    """Numbers as C writes them, with commas between."""
    return ", ".join(map(as_float, values))


def as_float(value: Any) -> str:
    """A float32 as C writes it, without loss."""
    return f"{float(str(np.float32(value)))!r}f"
