"""Vectors (*, k) in two forms, one tensor or k components; the physics is written once, in the methods of a tensor.

One tensor takes the fewest calls, which is what an eager step costs. Components leave no indices, so that a compiler
fuses everything into one loop over drones and keeps its numbers in registers.
"""

from __future__ import annotations

import copy
import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn.functional import pad

if TYPE_CHECKING:  # to a type checker both forms are tensors

    class Components(Tensor):
        """See below."""

        components: tuple[Tensor, ...]

        def __init__(self, components: Iterable[Tensor | float]) -> None: ...

    Vector = Tensor
else:

    def _of_each(function):
        def method(self, *limit):
            return Components([function(x, *limit) for x in self.components])

        return method

    def _of_both(function):
        def method(self, other):
            return _each(function, self, other)

        return method

    class Components:
        """The k components of a vector (*, k), each a tensor (*) or, where all drones share it, a number.

        Behaves like the tensor (*, k): arithmetic goes entry by entry, and k = 1 goes with any k. Its methods are those
        of a tensor that the physics uses, along the last dimension, which stays.
        """

        def __init__(self, components):
            self.components = tuple(components)

        @property
        def shape(self):
            return (len(self.components),)

        def __getitem__(self, index):
            return Components(self.components[index[1]])  # of [..., a:b]

        __add__, __sub__ = _of_both(operator.add), _of_both(operator.sub)
        __mul__, __truediv__ = _of_both(operator.mul), _of_both(operator.truediv)
        __neg__, abs, sign = map(_of_each, (operator.neg, operator.abs, torch.sign))
        sqrt, rsqrt = map(_of_each, (torch.sqrt, torch.rsqrt))
        clamp_min, clamp_max = map(_of_each, (torch.clamp_min, torch.clamp_max))

        def __rtruediv__(self, other):
            return Components([other / x for x in self.components])

        def square(self):
            return self * self

        def exp(self):
            return Components([x.exp() if isinstance(x, Tensor) else math.exp(x) for x in self.components])

        def maximum(self, other):
            return _each(lambda x, y: torch.maximum(x, y) if isinstance(y, Tensor) else x.clamp_min(y), self, other)

        def minimum(self, other):
            return _each(lambda x, y: torch.minimum(x, y) if isinstance(y, Tensor) else x.clamp_max(y), self, other)

        def addcmul(self, factor, other):
            return self + factor * other

        def sum(self, dim, keepdim):
            return Components([functools.reduce(operator.add, self.components)])

        def amax(self, dim, keepdim):
            return functools.reduce(larger, [Components([x]) for x in self.components])

        def amin(self, dim, keepdim):
            return functools.reduce(smaller, [Components([x]) for x in self.components])

        def split(self, sizes, dim):
            entries = iter(self.components)
            return [Components(itertools.islice(entries, size)) for size in sizes]

    Vector = Tensor | Components


def unbind(vector: Tensor, constant: bool = False) -> Components:
    """The components of a vector (*, k); of a constant that all drones share, as numbers."""
    shared = constant and vector.numel() == vector.shape[-1]
    return Components(vector.flatten().tolist() if shared else vector.unbind(-1))


def unbind_all(owner: Any, matrices: Sequence[str]) -> Any:
    """A copy whose tensors, all of them constants, are components; those of matrices (*, k, k) are their rows."""
    apart = copy.copy(owner)
    for name, value in vars(owner).items():
        if name in matrices:
            setattr(apart, name, Components([unbind(row, constant=True) for row in value.unbind(-2)]))
        elif isinstance(value, Tensor):
            setattr(apart, name, unbind(value, constant=True))
    return apart


def parts(vector: Vector) -> tuple[Tensor, ...]:
    """The k entries one by one, each (*)."""
    return vector.components if isinstance(vector, Components) else vector.unbind(-1)


def stack(vector: Vector) -> Tensor:
    """The entries, each (n), as rows (k, n)."""
    return torch.stack(parts(vector))


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product of vectors (*, 3)."""
    if isinstance(a, Components):
        (ax, ay, az), (bx, by, bz) = parts(a), parts(b)
        return Components((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))
    return torch.linalg.cross(a, b) if a.dim() == b.dim() else torch.linalg.cross(*torch.broadcast_tensors(a, b))


def dot(a: Vector, b: Vector) -> Vector:
    """Scalar product (*, 1)."""
    return (a * b).sum(-1, keepdim=True)


def matvec(matrix: Vector, vector: Vector) -> Vector:
    """The product (*, k) of a matrix (*, k, k), a tensor or Components of its rows, and a vector (*, k)."""
    if isinstance(vector, Components):
        return cat(*(dot(row, vector) for row in parts(matrix)))
    return (matrix * vector.unsqueeze(-2)).sum(-1)


def cat(*vectors: Vector) -> Vector:
    """The entries of several vectors as one."""
    if isinstance(vectors[0], Tensor):
        return torch.cat(vectors, -1)
    return Components([x for vector in vectors for x in parts(vector)])


def along_z(z: Vector) -> Vector:
    """The vector (0, 0, z), (*, 3), for z (*, 1)."""
    return Components((0.0, 0.0, *parts(z))) if isinstance(z, Components) else pad(z, (2, 0))


def clamp(x: Vector, low: Vector, high: Vector) -> Vector:
    """x within limits, entry by entry."""
    return x.maximum(low).minimum(high)


def soft_limit(x: Vector, limit: Vector) -> Vector:
    """x where it is small, and always less than the limit, entry by entry; its derivative is never zero."""
    return x * ((x / limit).square() + 1.0).rsqrt()


def larger(a: Vector, b: Vector) -> Vector:
    """The greater, entry by entry, as ``maximum``; its derivative costs a compiled step less."""
    return _each(lambda x, y: torch.where(x > y, x, y), a, b) if isinstance(a, Components) else torch.maximum(a, b)


def smaller(a: Vector, b: Vector) -> Vector:
    """The smaller, entry by entry, as ``minimum``; its derivative costs a compiled step less."""
    return _each(lambda x, y: torch.where(x < y, x, y), a, b) if isinstance(a, Components) else torch.minimum(a, b)


def where_positive(condition: Vector, a: Vector, b: Vector) -> Vector:
    """a where the condition is above zero, b elsewhere, entry by entry."""
    if isinstance(condition, Tensor):
        return torch.where(condition > 0, a, b)
    chosen = _each(lambda x, y: (x, y), a, b)  # pairs, of which the condition takes one
    return _each(lambda x, pair: torch.where(x > 0, *pair), condition, chosen)


def is_same(a: Vector, b: Vector) -> bool:
    """Whether a tensor on the CPU equals another; False where reading values would cost a device synchronisation."""
    return isinstance(a, Tensor) and a.device.type == "cpu" and not is_traced() and torch.equal(a, b)


def is_traced() -> bool:
    """Whether no value of a tensor can be read here."""
    return torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()


def where_same(a: Vector, b: Vector, other: Vector) -> Vector:
    """b (*, k) for those drones whose entries all equal those of a, the other for the rest."""
    if isinstance(a, Tensor):
        return torch.where((a == b).all(-1, keepdim=True), b, other)
    same = functools.reduce(operator.and_, [x == y for x, y in zip(parts(a), parts(b), strict=True)])
    return _each(lambda x, y: torch.where(same, x, y), b, other)


def _each(function: Callable, a: Vector, b: Vector | float) -> Components:
    left, right = parts(a), parts(b) if isinstance(b, Components) else (b,)
    k = max(len(left), len(right))
    left, right = (x * k if len(x) == 1 else x for x in (left, right))
    return Components([function(x, y) for x, y in zip(left, right, strict=True)])
