"""Run a control step on rows: eager, or compiled with its derivative as one node of the graph."""

from __future__ import annotations

import os
import shutil
import types
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.func import vjp

from torchrl_quad.engine.packing import Layout, Rows, flat, nested
from torchrl_quad.engine.simulation import Simulation, State, Transition


def has_compiler() -> bool:
    """Whether torch can compile here; a warning says what is missing."""
    if shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++"):
        return True
    warnings.warn(
        "compile: torch.compile needs a C++ compiler, and neither g++ nor clang++ is on the PATH. The environment "
        "stays eager: correct, but several times slower. Install one (Debian: apt install g++), or name yours in the "
        "environment variable CXX.",
        stacklevel=3,
    )
    return False


class Record(NamedTuple):
    """A transition on rows."""

    state: Rows  # at the end of the step
    outputs: Rows  # reward, flags and so on, without the observation
    observation: Tensor  # (n, k)


class Stepper:
    """Steps a simulation, on entries or on rows.

    Args:
        simulation: what happens in a step.
        options: keywords of ``torch.compile``; None for an eager step.
    """

    def __init__(self, simulation: Simulation, options: dict[str, Any] | None = None) -> None:
        self.simulation, self.options = simulation, options
        state, outputs = simulation.example()
        self.layout = Layout(state)
        observation = outputs["observation"]
        outputs = flat(outputs)
        self.output_layout = Layout({key: x for key, x in outputs.items() if key != "observation"})
        self.compiled: _Compiled | None = None
        if options is not None:
            # Gradients of outputs that nothing depends on. They are three tensors: the compiler would guard
            # on one that comes twice, and compile again when it comes once.
            examples = self.layout.pack(state).floats, self.output_layout.pack(outputs).floats, observation
            self.zeros = tuple(torch.zeros_like(x) for x in examples)

    @property
    def is_compiled(self) -> bool:
        """Whether steps run compiled."""
        return self.options is not None

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions stay bound to the environment that they were made of: a copy makes its own.
        return {**self.__dict__, "compiled": None}

    def step(
        self, state: State, valid: Tensor, action: Tensor, noise: dict[str, Tensor]
    ) -> tuple[State, dict[str, Any]]:
        """One step on entries: the state at its end, and its outputs."""
        if not self.is_compiled:
            end = self.simulation(state, valid, action, noise)
            return end.state, end.outputs
        state, outputs, observation = self.step_rows(self.layout.pack(state), valid, action, noise)
        return self.layout.unpack(state), {**nested(self.unpack_outputs(outputs)), "observation": observation}

    def unpack_outputs(self, rows: Rows) -> dict[Any, Tensor]:
        """The outputs of a step, or of a horizon, by name; metrics have no gradient."""
        return {key: x.detach() if "metrics" in key else x for key, x in self.output_layout.unpack(rows).items()}

    def step_rows(self, rows: Rows, valid: Tensor, action: Tensor, noise: dict[str, Tensor]) -> Record:
        """One step on rows.

        Args:
            rows: the state at its start.
            valid: where that state was meaningful, bool (n); elsewhere the episode ends.
            action: (n, k).
            noise: what each disturbance has drawn for this step, by name.
        """
        if not self.is_compiled:
            end = self.simulation(self.layout.unpack(rows), valid, action, noise)
            return _record(end, self.layout, self.output_layout)
        if self.compiled is None:
            self.compiled = _Compiled(self.simulation, self.layout, self.output_layout, self.options)
        leaves = _Step.apply(self, rows[1:], valid, noise, rows.floats, action, *self.simulation.parameters)
        return Record(Rows(*leaves[:3]), Rows(*leaves[3:6]), leaves[6])


class _Compiled:
    """A step and its adjoint as two compiled functions on rows."""

    def __init__(self, simulation: Simulation, layout: Layout, outputs: Layout, options: dict[str, Any]) -> None:
        self.simulation, self.layout, self.output_layout = simulation, layout, outputs
        substep = simulation.rows_step()

        def pull(x: Tensor, inputs: tuple[Any, ...], grad: Tensor) -> tuple[Tensor, ...]:
            grad_x, grad_inputs = vjp(lambda x, inputs: substep(x, *inputs), x, inputs)[1](grad)
            return (grad_x, *_flat(grad_inputs))  # a flat tuple: only such a region is traced once for all

        self.substep, self.pull = (torch.compiler.nested_compile_region(f) for f in (substep, pull))
        mode = torch._inductor.list_mode_options(options["mode"]) if options.get("mode") else {}
        more = {**mode, **options.get("options", {}), "guard_filter_fn": _watched, "cpp.vec_isa_ok": True}
        options = {"fullgraph": True, "dynamic": False, **options, "mode": None, "options": more}
        self.forward = torch.compile(_own(self._forward), **options)
        self.adjoint = torch.compile(_own(self._adjoint), **options)

    def _forward(
        self, rows: Rows, valid: Tensor, action: Tensor, parameters: tuple[Tensor, ...], noise: dict[str, Tensor]
    ) -> tuple[list[Tensor], Record]:
        before, valid, x, inputs = self.simulation.begin(self.layout.unpack(rows), valid, action, parameters)
        states = [x]
        for _ in range(self.simulation.substeps):
            states.append(self.substep(states[-1], *inputs))
        end = self.simulation.finish(before, states[-1], valid, noise)
        return states, _record(end, self.layout, self.output_layout)

    def _adjoint(
        self,
        states: list[Tensor],
        rows: Rows,
        valid: Tensor,
        action: Tensor,
        parameters: tuple[Tensor, ...],
        noise: dict[str, Tensor],
        grad: tuple[Tensor, Tensor, Tensor],
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        def begin(floats: Tensor, action: Tensor, parameters: tuple[Tensor, ...]) -> tuple[Any, Any]:
            state = self.layout.unpack(rows._replace(floats=floats))
            before, is_valid, x, inputs = self.simulation.begin(state, valid, action, parameters)
            floats = {key: x for key, x in before.items() if x.is_floating_point()}
            return (x, inputs, floats), (is_valid, {key: x for key, x in before.items() if key not in floats})

        def finish(floats: State, x: Tensor) -> tuple[Any, Any]:
            end = self.simulation.finish({**others, **floats}, x, is_valid, noise)
            record = _record(end, self.layout, self.output_layout)
            return (record.state.floats, record.outputs.floats, record.observation), end.valid

        primals, pull_begin, (is_valid, others) = vjp(begin, rows.floats, action, parameters, has_aux=True)
        _, inputs, before = primals
        _, pull_finish, keep = vjp(finish, before, states[-1], has_aux=True)
        grad_before, grad_x = pull_finish(grad)
        total = None
        for x in reversed(states[:-1]):
            grad_x, *more = self.pull(x, inputs, grad_x.contiguous())
            total = more if total is None else [a + b for a, b in zip(total, more, strict=True)]
        # What has become meaningless may have infinite derivatives. They must not reach what all share.
        grad_x, *total = (torch.where(keep, g, 0.0) for g in (grad_x, *total))
        grad_before = {
            key: torch.where(keep.reshape(-1, *(1 for _ in g.shape[1:])), g, 0.0) for key, g in grad_before.items()
        }
        return pull_begin((grad_x, _like(inputs, total), grad_before))


class _Step(torch.autograd.Function):
    """The compiled step as one node of the graph; it keeps the states between its substeps and nothing else."""

    @staticmethod
    def forward(ctx: Any, stepper: Stepper, others, valid, noise, floats, action, *parameters):
        floats, action, *parameters = (x.detach().contiguous() for x in (floats, action, *parameters))
        # The stride of a single row can be anything, and the compiler takes another stride for another kind of input.
        rows = Rows(floats, *(x.reshape(-1).view(x.shape) for x in others))
        states, record = stepper.compiled.forward(rows, valid, action, tuple(parameters), noise)
        ctx.stepper, ctx.noise = stepper, noise
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*rows, valid, action, *states, *parameters)
        ctx.mark_non_differentiable(*record.state[1:], *record.outputs[1:])
        return *record.state, *record.outputs, record.observation

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads):
        stepper, saved = ctx.stepper, ctx.saved_tensors
        rows, valid, action, more = Rows(*saved[:3]), saved[3], saved[4], saved[5:]
        count = stepper.simulation.substeps + 1
        grads = (
            zero if g is None else g.detach().contiguous()
            for g, zero in zip((grads[0], grads[3], grads[6]), stepper.zeros, strict=True)
        )
        floats, action, parameters = stepper.compiled.adjoint(
            list(more[:count]), rows, valid, action, tuple(more[count:]), ctx.noise, tuple(grads)
        )
        return None, None, None, None, floats, action, *parameters


def _record(end: Transition, layout: Layout, output_layout: Layout) -> Record:
    return Record(layout.pack(end.state), output_layout.pack(flat(end.outputs)), end.outputs["observation"])


def _flat(inputs: Sequence[Any]) -> list[Tensor]:
    return [x for part in inputs for x in (part if isinstance(part, tuple) else (part,))]


def _like(inputs: Sequence[Any], flat: Sequence[Tensor]) -> tuple[Any, ...]:
    """The reverse of :func:`_flat`."""
    flat = iter(flat)
    return tuple(tuple(next(flat) for _ in part) if isinstance(part, tuple) else next(flat) for part in inputs)


def _own(method: types.MethodType) -> types.MethodType:
    """The same method with a code object of its own: what is compiled for it is not shared with other environments."""
    f = method.__func__
    copy = types.FunctionType(f.__code__.replace(), f.__globals__, f.__name__, f.__defaults__, f.__closure__)
    return types.MethodType(copy, method.__self__)


# Of some 700 assumptions the compiled step keeps those that a user can break: on its input, on torch's state, on the
# attributes of the environment and its class, on globals of the modules that tasks live in. Checking the others at each
# call would cost more than the physics.
_FIXED_TYPES = {"TYPE_MATCH", "BUILTIN_MATCH", "MODULE_MATCH", "CLASS_MATCH", "DUPLICATE_INPUT"}
_FIXED_PLACES = ("self.layout", "self.output_layout", "self.substep", "self.pull", "__import__", "list(dict.keys(__imp")
_FIXED_MODULES = ("torch_dot", "torch'", "torchrl_quad_dot_dynamics", "torchrl_quad_dot_engine", "builtins")


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
