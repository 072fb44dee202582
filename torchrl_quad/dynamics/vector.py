"""Vectors (*, k) in two forms: one tensor, or k components.

The physics is written for both. One tensor takes the fewest calls, which is what an eager step costs. Components leave
no indices, so that a compiler makes one loop over drones of everything and keeps its numbers in registers.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

Component = Tensor | float


class Components:
    """The k components of a vector (*, k), each a tensor (*) or, where all drones share it, a number.

    Behaves like the tensor (*, k): arithmetic goes entry by entry, and k = 1 goes with any k.
    """

    def __init__(self, components: Iterable[Component]) -> None:
        self.components = tuple(components)

    def __getitem__(self, index: tuple[type(Ellipsis), slice]) -> Components:
        return Components(self.components[index[1]])

    def __add__(self, other: Components | float) -> Components:
        return _each(operator.add, self, other)

    def __sub__(self, other: Components | float) -> Components:
        return _each(operator.sub, self, other)

    def __mul__(self, other: Components | float) -> Components:
        return _each(operator.mul, self, other)

    def __truediv__(self, other: Components | float) -> Components:
        return _each(operator.truediv, self, other)

    def __rtruediv__(self, other: float) -> Components:
        return Components([other / x for x in self.components])

    def __neg__(self) -> Components:
        return Components([-x for x in self.components])

    def abs(self) -> Components:
        return Components([abs(x) for x in self.components])

    def square(self) -> Components:
        return self * self

    def sqrt(self) -> Components:
        return Components([x.sqrt() for x in self.components])

    def rsqrt(self) -> Components:
        return Components([torch.rsqrt(x) for x in self.components])

    def exp(self) -> Components:
        return Components([x.exp() if isinstance(x, Tensor) else math.exp(x) for x in self.components])

    def clamp_min(self, low: float) -> Components:
        return Components([x.clamp_min(low) for x in self.components])

    def clamp_max(self, high: float) -> Components:
        return Components([x.clamp_max(high) for x in self.components])


Vector = Tensor | Components


def unbind(vector: Tensor, constant: bool = False) -> Components:
    """The components of a vector (*, k); of a constant that all drones share, as numbers."""
    shared = constant and vector.numel() == vector.shape[-1]
    return Components(vector.flatten().tolist() if shared else vector.unbind(-1))


def unbind_rows(matrix: Tensor) -> list[Components]:
    """The rows of a constant matrix (*, k, k), each as components."""
    return [unbind(row, constant=True) for row in matrix.unbind(-2)]


def split(vector: Components, sizes: Iterable[int]) -> list[Components]:
    """Its parts of these sizes, in their order."""
    entries = iter(vector.components)
    return [Components(itertools.islice(entries, size)) for size in sizes]


def stack(vector: Components) -> Tensor:
    """The components, each a tensor (n), as rows (k, n)."""
    return torch.stack(vector.components)


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product of vectors (*, 3)."""
    if isinstance(a, Tensor):
        return torch.linalg.cross(a, b)
    (ax, ay, az), (bx, by, bz) = a.components, b.components
    return Components((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def dot(a: Vector, b: Vector) -> Vector:
    """Scalar product (*, 1)."""
    if isinstance(a, Tensor):
        return (a * b).sum(-1, keepdim=True)
    return Components([_sum((a * b).components)])


def multiply_add(a: Vector, b: Vector, c: Vector) -> Vector:
    """a + b c, entry by entry."""
    return torch.addcmul(a, b, c) if isinstance(c, Tensor) else a + b * c


def matvec(matrix: Tensor | Sequence[Components], vector: Vector) -> Vector:
    """The product (*, k) of a matrix (*, k, k), or its rows, and a vector (*, k)."""
    if isinstance(vector, Tensor):
        return (matrix * vector.unsqueeze(-2)).sum(-1)
    return Components([_sum((row * vector).components) for row in matrix])


def cat(*vectors: Vector) -> Vector:
    """The entries of several vectors as one."""
    if isinstance(vectors[0], Tensor):
        return torch.cat(vectors, -1)
    return Components([x for vector in vectors for x in vector.components])


def along_z(z: Vector) -> Vector:
    """The vector (0, 0, z), (*, 3), for z (*, 1)."""
    return pad(z, (2, 0)) if isinstance(z, Tensor) else Components((0.0, 0.0, *z.components))


def clamp(x: Vector, low: Vector, high: Vector) -> Vector:
    """x, but not below low nor above high, entry by entry."""
    return minimum(maximum(x, low), high)


def soft_limit(x: Vector, limit: Vector) -> Vector:
    """x where it is small, and always less than the limit, entry by entry; its derivative is never zero."""
    return x * ((x / limit).square() + 1.0).rsqrt()


def maximum(a: Vector, b: Vector) -> Vector:
    """The greater, entry by entry."""
    if isinstance(a, Tensor):
        return torch.maximum(a, b)
    return _each(lambda x, y: torch.maximum(x, y) if isinstance(y, Tensor) else x.clamp_min(y), a, b)


def minimum(a: Vector, b: Vector) -> Vector:
    """The smaller, entry by entry."""
    if isinstance(a, Tensor):
        return torch.minimum(a, b)
    return _each(lambda x, y: torch.minimum(x, y) if isinstance(y, Tensor) else x.clamp_max(y), a, b)


def greatest(x: Vector) -> Vector:
    """The greatest entry, (*, 1)."""
    return x.amax(-1, keepdim=True) if isinstance(x, Tensor) else _reduce(larger, x)


def least(x: Vector) -> Vector:
    """The least entry, (*, 1)."""
    return x.amin(-1, keepdim=True) if isinstance(x, Tensor) else _reduce(smaller, x)


def larger(a: Vector, b: Vector) -> Vector:
    """The greater, entry by entry, as :func:`maximum`; its derivative costs a compiled step less."""
    return torch.maximum(a, b) if isinstance(a, Tensor) else _each(lambda x, y: torch.where(x > y, x, y), a, b)


def smaller(a: Vector, b: Vector) -> Vector:
    """The smaller, entry by entry, as :func:`minimum`; its derivative costs a compiled step less."""
    return torch.minimum(a, b) if isinstance(a, Tensor) else _each(lambda x, y: torch.where(x < y, x, y), a, b)


def where_positive(condition: Vector, a: Vector, b: Vector) -> Vector:
    """a where the condition is above zero, b elsewhere, entry by entry."""
    if isinstance(condition, Tensor):
        return torch.where(condition > 0, a, b)
    k = len(condition.components)
    a, b = (x.components * k if len(x.components) == 1 else x.components for x in (a, b))
    entries = zip(condition.components, a, b, strict=True)
    return Components([torch.where(x > 0, y, z) for x, y, z in entries])


def width(x: Vector) -> int:
    """The number k of entries of a vector (*, k)."""
    return x.shape[-1] if isinstance(x, Tensor) else len(x.components)


def is_same(a: Vector, b: Vector) -> bool:
    """Whether a tensor on the processor equals another, where a look at its values is free; False where it is not."""
    if not isinstance(a, Tensor) or a.device.type != "cpu":
        return False
    return not is_traced() and torch.equal(a, b)


def is_traced() -> bool:
    """Whether no value of a tensor can be looked at here."""
    return torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()


def where_same(a: Vector, b: Vector, other: Vector) -> Vector:
    """b (*, k) for those drones whose entries all equal those of a, the other for the rest."""
    if isinstance(a, Tensor):
        return torch.where((a == b).all(-1, keepdim=True), b, other)
    same = functools.reduce(operator.and_, (x == y for x, y in zip(a.components, b.components, strict=True)))
    return Components([torch.where(same, x, y) for x, y in zip(b.components, other.components, strict=True)])


def _reduce(function: Callable, x: Components) -> Components:
    return functools.reduce(function, (Components([entry]) for entry in x.components))


def _each(function: Callable, a: Components, b: Components | float) -> Components:
    left = a.components
    right = b.components if isinstance(b, Components) else (b,)
    k = max(len(left), len(right))
    left, right = (x * k if len(x) == 1 else x for x in (left, right))
    return Components([function(x, y) for x, y in zip(left, right, strict=True)])


def _sum(values: Sequence[Component]) -> Component:
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total
