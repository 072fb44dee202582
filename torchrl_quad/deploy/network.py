"""The network of a policy with everything folded into its layers, written as ONNX and as C."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import resources
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

OPSET, IR_VERSION = 20, 10  # onnxruntime reads both since 1.18
LIMIT = np.float32(1.0 - 1e-6)  # of the action; TorchRL's TanhNormal keeps as far from -1 and 1

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
    """A layer: activation(weight x + bias)."""

    weight: NDArray[np.float32]  #: (out, in)
    bias: NDArray[np.float32]  #: (out)
    activation: str  #: one of ``ACTIVATIONS``; the last layer's is Tanh, and the action is clamped to ``LIMIT``


def write_onnx(layers: list[Layer]) -> bytes:
    """The network as ONNX: ``observation`` (batch, k) to ``action`` (batch, 4), both float32, with a free batch axis.

    The same layers give the same bytes.
    """
    import onnx  # only who exports needs it
    from onnx import TensorProto, helper, numpy_helper

    nodes, constants, x = [], [], "observation"
    for i, layer in enumerate(layers):
        for name, value in (("weight", layer.weight), ("bias", layer.bias)):
            constants.append(numpy_helper.from_array(value, f"{name}_{i}"))
        nodes.append(helper.make_node("Gemm", [x, f"weight_{i}", f"bias_{i}"], [f"sum_{i}"], transB=1))
        x = f"layer_{i}"
        if layer.activation == "SiLU":
            nodes.append(helper.make_node("Sigmoid", [f"sum_{i}"], [f"gate_{i}"]))
            nodes.append(helper.make_node("Mul", [f"sum_{i}", f"gate_{i}"], [x]))
        else:
            nodes.append(helper.make_node(ACTIVATIONS[layer.activation][0], [f"sum_{i}"], [x]))
    for name, limit in (("low", -LIMIT), ("high", LIMIT)):
        constants.append(numpy_helper.from_array(np.array(limit, np.float32), name))
    nodes.append(helper.make_node("Clip", [x, "low", "high"], ["action"]))
    sizes = {"observation": layers[0].weight.shape[1], "action": len(layers[-1].bias)}
    ends = [[helper.make_tensor_value_info(k, TensorProto.FLOAT, ["batch", n])] for k, n in sizes.items()]
    graph = helper.make_graph(nodes, "policy", *ends, constants)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, producer_name="torchrl_quad", ir_version=IR_VERSION, opset_imports=opset)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def write_c(
    layers: list[Layer], contract: Mapping[str, Any], observation: NDArray[np.float32], action: NDArray[np.float32]
) -> dict[str, bytes]:
    """The network as C99: the files ``policy.h`` and ``policy.c``, with vectors (n, k) and (n, 4) for its self-test."""
    output, steps, x = contract["output"], [], "observation"
    for i, layer in enumerate(layers):
        y = "action" if i == len(layers) - 1 else ("one", "two")[i % 2]
        rows, columns = layer.weight.shape
        steps.append(f"    sum(weight_{i}, bias_{i}, {columns}, {x}, {rows}, {y});")
        steps.append(f"    for (int i = 0; i < {rows}; ++i) {y}[i] = {_function(layer.activation)}({y}[i]);")
        x = y
    names = sorted({layer.activation for layer in layers})
    rates = [high for _, high in output["body_rate"]["range"]]
    values = {
        "task": contract["task"]["name"],
        "version": contract["version"],
        "observation": observation.shape[1],
        "control_dt": _float(contract["control_dt"]),
        "action_delay": contract["action_delay"],
        "hover_action": _floats(output["hover_action"]),
        "max_thrust": _float(output["thrust"]["range"][1]),
        "max_rates": _floats(rates),
        "limit": _float(LIMIT),
        "width": max(len(layer.bias) for layer in layers),
        "activations": "\n".join(
            f"static float {_function(name)}(float x) {{ return {ACTIVATIONS[name][1]}; }}" for name in names
        ),
        "weights": "\n".join(_constants(layers)),
        "layers": "\n".join(steps),
        "vectors": len(observation),
        "test_observation": _rows(observation),
        "test_action": _rows(action),
    }
    templates = resources.files(__package__) / "templates"
    return {
        name: Template((templates / name).read_text()).substitute(values).encode() for name in ("policy.h", "policy.c")
    }


def _constants(layers: list[Layer]) -> Iterator[str]:
    for i, layer in enumerate(layers):
        rows, columns = layer.weight.shape
        # One row for each input: the inner loop then runs along memory.
        yield f"static const float weight_{i}[{columns * rows}] = {{\n{_rows(layer.weight.T)}\n}};"
        yield f"static const float bias_{i}[{rows}] = {{{_floats(layer.bias)}}};"


def _function(activation: str) -> str:
    return f"{activation.lower()}_of"


def _rows(values: NDArray[np.float32]) -> str:
    return ",\n".join(f"    {_floats(row)}" for row in values)


def _floats(values: Any) -> str:
    return ", ".join(map(_float, values))


def _float(value: Any) -> str:
    """A float32 as C writes it, without loss."""
    text = repr(float(str(np.float32(value))))
    return f"{text}f"
