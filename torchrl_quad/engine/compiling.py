"""Compile a function of tensors; check what was assumed of everything else once per horizon, not at every step."""

from __future__ import annotations

import gc
import os
import shutil
import types
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, ...]]
Call = tuple[Function, Sequence[Any], Sequence[Any]]  # with its inputs and outputs


def has_compiler() -> bool:
    """Whether torch can compile here, and may (TORCH_COMPILE_DISABLE); a warning says what is missing."""
    if torch._dynamo.config.disable:
        return False
    if shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++"):
        return True
    warnings.warn(
        "compile: torch.compile needs a C++ compiler, and neither g++ nor clang++ is on the PATH. The environment "
        "stays eager: correct, but several times slower. Install one (Debian: apt install g++), or name yours in the "
        "environment variable CXX.",
        stacklevel=3,
    )
    return False


class Compiled:
    """A compiled function from tensors to a tuple of tensors.

    A call checks every assumption of the compiler: on the tensors, and on whatever else the function reads, such as
    attributes of a task. Where one no longer holds, it compiles again. :meth:`again` calls what the last call has
    compiled with other tensors of the same kind, and checks nothing else.

    Args:
        method: a method whose arguments are tensors, and which returns a tuple of tensors.
        options: keywords of ``torch.compile``.
    """

    def __init__(self, method: types.MethodType, options: dict[str, Any]) -> None:
        mode = torch._inductor.list_mode_options(options["mode"]) if options.get("mode") else {}
        self.patches = {"cpp.vec_isa_ok": True, **mode, **options.get("options", {})}
        backend = options.get("backend", "inductor")
        self.backend = None if backend == "inductor" else torch._dynamo.lookup_backend(backend)
        given = {name: x for name, x in options.items() if name not in ("mode", "options", "backend")}
        keywords: dict[str, Any] = {"fullgraph": True, "dynamic": False, **given, "backend": self._compile}
        self.checked = torch.compile(_own(method), **keywords, options={"guard_filter_fn": _watched})
        self.last: Call | None = None  # of what was compiled
        self.direct: Function | None = None

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Check everything, and call."""
        self.direct = None
        collects = gc.isenabled()
        gc.disable()  # an eighth of a compilation went by finding that its graphs are in use
        try:
            outputs = self.checked(*inputs)
            self.direct = None if self.last is None else _direct(self.last, inputs, outputs)
        finally:
            self.last = None  # it holds tensors
            if collects:
                gc.enable()
        return outputs

    def again(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Call on the assumptions of the last call, with tensors of the same shapes, strides and types."""
        return self(*inputs) if self.direct is None else self.direct(*inputs)

    def _compile(self, graph: torch.fx.GraphModule, examples: list[Tensor], **_: Any) -> Function:
        if self.backend is None:
            function = torch._inductor.compile(graph, list(examples), options=self.patches)
        else:
            function = self.backend(graph, examples)

        def call(*inputs: Tensor) -> tuple[Tensor, ...]:
            outputs = function(*inputs)
            self.last = function, inputs, outputs
            return outputs

        return call


def _direct(last: Call, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> Function | None:
    """What a call has compiled, on the function's own inputs and outputs, wherever they are among those of the graph.

    None where their places are not unique, as when one tensor is given twice.
    """
    function, taken, given = last
    place = {id(x): i for i, x in enumerate(taken)}
    source = {id(x): i for i, x in enumerate(given)}
    if not all(id(x) in source for x in outputs) or len({id(x) for x in inputs}) < len(inputs):
        return None
    places, results = [place.get(id(x)) for x in inputs], [source[id(x)] for x in outputs]
    own = set(places)
    template = [None if i in own else x for i, x in enumerate(taken)]

    def call(*inputs: Tensor) -> tuple[Tensor, ...]:
        values = template.copy()
        for i, x in zip(places, inputs, strict=True):
            if i is not None:
                values[i] = x
        outputs = function(*values)
        return tuple([outputs[i] for i in results])

    return call


def _own(method: types.MethodType) -> types.MethodType:
    """The same method with a code object of its own: what is compiled for it is not shared with other environments."""
    f = method.__func__
    copy = types.FunctionType(f.__code__.replace(), f.__globals__, f.__name__, f.__defaults__, f.__closure__)
    return types.MethodType(copy, method.__self__)


# Of some 700 assumptions the compiled step keeps those that a user can break: on its input, on torch's state, on the
# attributes of the simulation, its class and its physics, on globals of the modules that they live in. The others are
# about torch and the engine.
_FIXED_TYPES = {"TYPE_MATCH", "BUILTIN_MATCH", "MODULE_MATCH", "CLASS_MATCH", "DUPLICATE_INPUT"}
_FIXED_PLACES = ("self.layout", "self.output_layout", "__import__", "list(dict.keys(__imp")
_FIXED_MODULES = ("torch_dot", "torch'", "torchrl_quad_dot_engine", "builtins")


def _watched(guards: Sequence[Any]) -> list[bool]:
    def watched(guard: Any) -> bool:
        name = guard.name
        if guard.guard_type in _FIXED_TYPES or name.startswith(_FIXED_PLACES) or "___unnamed" in name:
            return False
        if guard.guard_type == "NOT_PRESENT_IN_GENERIC_DICT":
            return name.startswith("self.simulation")
        if name.startswith("G["):
            module = name.removeprefix("G['").removeprefix("__import_")
            return name.startswith("G['__import_") and not module.startswith(_FIXED_MODULES)
        return True

    return [watched(guard) for guard in guards]
