"""Compiled functions of tensors: a control step on rows and a policy, each with its adjoint.

What was assumed of everything else is checked once per horizon, not at every step.
"""

from __future__ import annotations

import copy
import gc
import os
import shutil
import types
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.func import vjp

from torchrl_quad.engine.packing import Layout, Record, Rows, like, record
from torchrl_quad.engine.policy import GivenActions, PlainPolicy
from torchrl_quad.engine.simulation import Simulation, State

Function = Callable[..., tuple[Tensor, ...]]


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
    """A compiled method from tensors to a tuple of tensors; ``options`` are keywords of ``torch.compile``.

    A call checks every assumption of the compiler: on the tensors, and on whatever else the method reads, such as
    attributes of a task. Where one no longer holds, it compiles again. :meth:`again` calls what the last call has
    compiled with other tensors of the same kind, and checks nothing else.
    """

    def __init__(self, method: types.MethodType, options: dict[str, Any]) -> None:
        mode = torch._inductor.list_mode_options(options["mode"]) if options.get("mode") else {}
        self.patches = {"cpp.vec_isa_ok": True, **mode, **(options.get("options") or {})}
        backend = options.get("backend", "inductor")
        self.backend = None if backend == "inductor" else torch._dynamo.lookup_backend(backend)
        given = {name: x for name, x in options.items() if name not in ("mode", "options", "backend")}
        keywords: dict[str, Any] = {"fullgraph": True, "dynamic": False, **given, "backend": self._compile}
        # With a code object of its own: what is compiled for it is not shared with other environments.
        f = method.__func__
        own = types.FunctionType(f.__code__.replace(), f.__globals__, f.__name__, f.__defaults__, f.__closure__)
        method = types.MethodType(own, method.__self__)
        self.checked = torch.compile(method, **keywords, options={"guard_filter_fn": _watched})
        self.last: tuple[Function, Sequence[Any], Sequence[Any]] | None = None  # what was compiled, inputs and outputs
        self.direct: Function | None = None

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Check everything, and call."""
        self.direct = None
        collects = gc.isenabled()
        gc.disable()  # an eighth of a compilation went by finding that its graphs are in use
        try:
            outputs = self.checked(*inputs)
            self.direct = self.last and _direct(*self.last, inputs, outputs)
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


def _direct(
    function: Function, taken: Sequence[Any], given: Sequence[Any], inputs: Sequence[Tensor], outputs: Sequence[Tensor]
) -> Function | None:
    """A compiled function that takes and gives the method's own inputs and outputs, wherever its graph has them.

    None where their places are not unique, as when one tensor is given twice.
    """
    place = {id(x): i for i, x in enumerate(taken)}
    source = {id(x): i for i, x in enumerate(given)}
    if not all(id(x) in source for x in outputs) or len({id(x) for x in inputs}) < len(inputs):
        return None
    places, results = [place.get(id(x)) for x in inputs], [source[id(x)] for x in outputs]
    template = [None if i in places else x for i, x in enumerate(taken)]

    def call(*inputs: Tensor) -> tuple[Tensor, ...]:
        values = template.copy()
        for i, x in zip(places, inputs, strict=True):
            if i is not None:
                values[i] = x
        outputs = function(*values)
        return tuple([outputs[i] for i in results])

    return call


# Of some 700 assumptions the compiled step keeps those that a user can break: on its input, on torch's state, on the
# attributes of the simulation, its class and its physics, on globals of the modules that they live in. The others are
# about torch and the engine.
_FIXED_TYPES = {"TYPE_MATCH", "BUILTIN_MATCH", "MODULE_MATCH", "CLASS_MATCH", "DUPLICATE_INPUT"}
_FIXED_PLACES = ("self.layout", "self.output_layout", "__import__", "list(dict.keys(__imp")
_FIXED_MODULES = ("torch_dot", "torch'", "torchrl_quad_dot_engine", "builtins")


def _watched(guards: Sequence[Any]) -> list[bool]:
    return [_is_watched(guard.name, guard.guard_type) for guard in guards]


def _is_watched(name: str, kind: str) -> bool:
    if kind in _FIXED_TYPES or name.startswith(_FIXED_PLACES) or "___unnamed" in name:
        return False
    if kind == "NOT_PRESENT_IN_GENERIC_DICT":
        return name.startswith("self.simulation")
    if name.startswith("G["):
        imported = "G['__import_"
        return name.startswith(imported) and not name.removeprefix(imported).startswith(_FIXED_MODULES)
    return True


class StepProgram:
    """A compiled control step and its adjoint, on flat lists of tensors.

    ``forward(*start, *others)`` takes the rows of the state (floats, integers, flags), valid (n) and the action (n, k);
    then the parameters that gradients may reach, and the noise of each disturbance. It returns the state after each
    substep, each (rows, n), and the end: the rows of the state and of the outputs, and the observation (n, k).
    ``adjoint(*start, *others, *states, *grads)`` takes the gradients in the floats of the end (state, outputs,
    observation), and returns those in the floats of the start (state, action), and in the parameters.
    """

    def __init__(self, simulation: Simulation, layout: Layout, output_layout: Layout, options: dict[str, Any]) -> None:
        self.simulation, self.layout, self.output_layout = simulation, layout, output_layout
        self.substeps, self.parameter_count = simulation.substeps, len(simulation.parameters)
        self.noise_names: tuple[str, ...] = ()
        substep = simulation.rows_step()

        def pull(x: Tensor, inputs: tuple[Any, ...], grad: Tensor) -> tuple[Tensor, ...]:
            grad_x, grad_inputs = vjp(lambda x, inputs: substep(x, *inputs), x, inputs)[1](grad)
            return (grad_x, *_flat(grad_inputs))  # a flat tuple: only such a region is traced once for all

        region: Any = torch.compiler.nested_compile_region  # compiled once for all its calls in a step
        self.substep, self.pull = region(substep), region(pull)
        self.forward = Compiled(self._forward, options)
        self.adjoint = Compiled(self._adjoint, options)

    def _forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        rows, valid, action, parameters, noise, _ = self._parts(inputs)
        before, valid, x, more = self.simulation.begin(self.layout.unpack(rows), valid, action, parameters)
        states = []
        for _ in range(self.substeps):
            x = self.substep(x, *more)
            states.append(x)
        end = record(self.simulation.finish(before, x, valid, noise), self.layout, self.output_layout)
        return *states, *end.state, *end.outputs, end.observation

    def _adjoint(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        rows, valid, action, parameters, noise, more = self._parts(inputs)
        states, grads = more[: self.substeps], more[self.substeps :]

        def begin(floats: Tensor, action: Tensor, parameters: tuple[Tensor, ...]) -> tuple[Any, Any]:
            state = self.layout.unpack(rows._replace(floats=floats))
            before, is_valid, x, inputs = self.simulation.begin(state, valid, action, parameters)
            own = {key: x for key, x in before.items() if x.is_floating_point()}
            return (x, inputs, own), (is_valid, {key: x for key, x in before.items() if key not in own})

        def finish(floats: State, x: Tensor) -> tuple[Any, Any]:
            end = self.simulation.finish({**others, **floats}, x, is_valid, noise)
            end_record = record(end, self.layout, self.output_layout)
            return (end_record.state.floats, end_record.outputs.floats, end_record.observation), end.valid

        derive: Any = vjp  # its annotations leave out has_aux
        (first, inputs, before), pull_begin, (is_valid, others) = derive(
            begin, rows.floats, action, parameters, has_aux=True
        )
        _, pull_finish, keep = derive(finish, before, states[-1], has_aux=True)
        grad_before, grad_x = pull_finish(grads)
        total: list[Tensor] = []
        for x in reversed((first, *states[:-1])):
            grad_x, *more = self.pull(x, inputs, grad_x.contiguous())
            total = [a + b for a, b in zip(total, more, strict=True)] if total else more
        # What has become meaningless may have infinite derivatives. They must not reach what all share.
        grad_x, *total = (torch.where(keep, g, 0.0) for g in (grad_x, *total))
        grad_before = {key: torch.where(like(keep, g), g, 0.0) for key, g in grad_before.items()}
        grad_floats, grad_action, grad_parameters = pull_begin((grad_x, _like(inputs, total), grad_before))
        return grad_floats, grad_action.contiguous(), *grad_parameters

    def _parts(self, inputs: Sequence[Tensor]) -> tuple[Any, ...]:
        """Rows, valid, action, parameters, noise by name, and the rest of a flat list."""
        noise_at = 5 + self.parameter_count
        rest_at = noise_at + len(self.noise_names)
        noise = dict(zip(self.noise_names, inputs[noise_at:rest_at], strict=True))
        return Rows(*inputs[:3]), inputs[3], inputs[4], inputs[5:noise_at], noise, inputs[rest_at:]


class PolicyProgram:
    """A compiled policy and its adjoint, on flat lists of tensors; all policies of one signature share a program.

    ``forward(*weights, *inputs, drawn)`` returns what the policy keeps, and what it writes, in the order of its
    ``out_keys``. ``adjoint(*weights, *inputs, drawn, *kept, *grads)`` takes the gradients of what it wrote, and returns
    the traces, and the gradients of its inputs and of what was drawn.
    """

    def __init__(self, policy: PlainPolicy, options: dict[str, Any]) -> None:
        self.counts = len(policy.weights), len(policy.in_keys)
        self.policy = copy.copy(policy)
        self.policy.weights = ()  # those of the first one would live as long as the program
        self.forward = Compiled(self._forward, options)
        self.adjoint = Compiled(self._adjoint, options)

    def _forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        weights, read, (drawn,) = self._parts(inputs)
        kept, written = self.policy.forward(weights, read, drawn)
        return *kept, *(written[key] for key in self.policy.out_keys)

    def _adjoint(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        weights, read, (drawn, *more) = self._parts(inputs)
        count = len(more) - len(self.policy.out_keys)
        grads = dict(zip(self.policy.out_keys, more[count:], strict=True))
        traces, grad_inputs, grad_drawn = self.policy.adjoint(weights, read, more[:count], drawn, grads)
        return *traces, *grad_inputs, grad_drawn

    def _parts(self, inputs: Sequence[Tensor]) -> tuple[Sequence[Tensor], Sequence[Tensor], Sequence[Tensor]]:
        """Weights, what the policy reads, and the rest of a flat list."""
        first, count = self.counts
        return inputs[:first], inputs[first : first + count], inputs[first + count :]


def policy_inputs(
    policy: PlainPolicy | GivenActions, layout: Layout, output_layout: Layout, at: Record, memory: Mapping[Any, Tensor]
) -> list[Tensor]:
    """The entries that a policy reads, of what is known of a state and what it remembers."""
    inputs = []
    for key in policy.in_keys:
        if key == "observation":
            inputs.append(at.observation)
        elif key in memory:
            inputs.append(memory[key])
        elif key in output_layout.place:
            inputs.append(output_layout.read(at.outputs, key))
        else:
            inputs.append(layout.read(at.state, name_in_state(key)))
    return inputs


def name_in_state(key: tuple[str, ...]) -> Any:
    """The name within the state of a key ("state", ...)."""
    return key[1] if len(key) == 2 else key[1:]


def _flat(inputs: Sequence[Any]) -> list[Tensor]:
    return [x for part in inputs for x in (part if isinstance(part, tuple) else (part,))]


def _like(inputs: Sequence[Any], flat: Sequence[Tensor]) -> tuple[Any, ...]:
    """The reverse of :func:`_flat`."""
    rest = iter(flat)
    return tuple(tuple(next(rest) for _ in part) if isinstance(part, tuple) else next(rest) for part in inputs)
