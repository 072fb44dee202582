"""What may mend a log that is refused: each is tried on the log before a message tells it.

A remedy is a mapping: arguments of ``read_log`` by name, ``span`` (times to read between), or a ``quantity`` and what
to do with its columns: ``factor`` and ``offset`` (a number, or one for each component), ``order`` (of components, in
ours), ``name`` (as which quantity), ``drop``; ``when`` says on what it depends.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchrl_quad.deploy.frames import Convention
from torchrl_quad.identification.errors import LogError, Remedy
from torchrl_quad.identification.layouts import RIVALS, Columns, Layout

_DEEPEST, _MOST = 4, 12  # faults of one log that are mended together, and how often it is read for that


@dataclass(frozen=True)
class Mended:
    """How a log is read: with which layout and options, and how they differ from what the caller gave."""

    layout: Layout
    options: Mapping[str, Any]
    there: Collection[str]  #: the columns of the file
    columns: Mapping[str, Columns | None] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)
    when: tuple[str, ...] = ()
    done: tuple[object, ...] = ()

    def by(self, remedy: Remedy) -> Mended:
        """With one more remedy."""
        todo = dict(remedy)
        when = (*self.when, *filter(None, [todo.pop("when", "")]))
        quantity = todo.pop("quantity", None)
        if quantity is None:
            layout = replace(self.layout, convention=todo["convention"]) if "convention" in todo else self.layout
            options = {name: value for name, value in todo.items() if name != "convention"}
            return replace(
                self, layout=layout, options={**self.options, **options}, changes={**self.changes, **todo}, when=when
            )
        if quantity == "time":
            columns, name = _changed(self.layout.time, [0], todo), "time"
            layout = self.layout if columns is None else replace(self.layout, time=columns)
        else:
            choices = self.layout.columns[quantity]
            used = next(c for c in choices if all(column in self.there for column in c.names))
            columns = _changed(used, _places(self.layout.convention, quantity, len(used.names)), todo)
            name = todo.get("name", quantity)
            kept = {q: x for q, x in self.layout.columns.items() if q not in (quantity, name)}
            layout = replace(self.layout, columns=kept if columns is None else {**kept, name: (columns,)})
        own = {q: x for q, x in self.columns.items() if q != quantity}
        done = (*self.done, _kind(remedy))
        return replace(self, layout=layout, columns={**own, name: columns}, when=when, done=done)

    def told(self, asked: object) -> str:
        """What to write, for a caller who asked for some columns."""
        parts = []
        if self.columns:
            given = asked if isinstance(asked, Mapping) else {}
            given = {k: v for k, v in given.items() if k not in _ousted(self.columns)}
            entries = (f'"{name}": {_said(value)}' for name, value in {**given, **self.columns}.items())
            parts.append(f"columns={{{', '.join(entries)}}}")
        span = self.changes.get("span")
        for name, value in self.changes.items():
            if name == "convention":
                parts.append(f"convention=frames.{value.name.lower()}()")
            elif name != "span":
                parts.append(f"{name}={value:g}")
        condition = f"If {' and '.join(dict.fromkeys(self.when))}, write " if self.when else "Write "
        write = f"{condition}{', '.join(parts)}." if parts else ""
        part = "" if span is None else f"Its part from {span[0]:.6g} to {span[1]:.6g} s reads: cut the file there."
        return " ".join(filter(None, (part, write)))


def remedy_for(error: LogError, start: Mended, read: Callable[[Mended], object]) -> Mended | None:
    """The first of the remedies with which the log reads, alone or with those of the errors that come next."""
    left = itertools.count(_MOST, -1)

    def found(error: LogError, before: Mended, depth: int) -> Mended | None:
        for remedy in error.remedies if depth else ():
            turns = "convention" in remedy or ("factor" in remedy and np.ndim(remedy["factor"]))
            if (turns and "convention" in before.changes) or _kind(remedy) in before.done:  # which is done
                continue
            if next(left) <= 0:
                return None
            mended = before.by(remedy)
            try:
                read(mended)
            except LogError as further:
                deeper = found(further, mended, depth - 1)
                if deeper is not None:
                    return deeper
            else:
                return mended
        return None

    return found(error, start, _DEEPEST)


def _kind(remedy: Remedy) -> object:
    return remedy.get("quantity"), sorted(set(remedy) - {"when"}), np.ndim(remedy.get("factor", 0.0))


def _ousted(columns: Collection[str]) -> set[str]:
    return {rival for pair in RIVALS for rival in pair if set(pair) & set(columns)}


def _places(convention: Convention, quantity: str, count: int) -> list[int]:
    """Where the file has each of our components."""
    if quantity == "quaternion" and convention.xyzw:
        return [3, 0, 1, 2]
    if quantity in ("motor_command", "rotor_speed") and convention.motors:
        return np.argsort(convention.motors).tolist()
    return list(range(count))


def _changed(used: Columns, places: list[int], todo: Mapping[str, Any]) -> Columns | None:
    if "drop" in todo:
        return None
    n = len(used.names)
    scale, offset, factor, less = (np.broadcast_to(np.asarray(x, float), n).copy() for x in (
        used.scale, used.offset, todo.get("factor", 1.0), todo.get("offset", 0.0)))  # fmt: skip
    names = list(used.names)
    order = todo.get("order", range(n))
    old = names.copy(), scale.copy(), offset.copy()
    for i, k in enumerate(order):
        names[places[i]], scale[places[i]], offset[places[i]] = (x[places[k]] for x in old)
        offset[places[i]] += less[i] / scale[places[i]]
        scale[places[i]] *= factor[i]
    return Columns(tuple(names), *(x[0] if (x == x[0]).all() else tuple(x.tolist()) for x in (scale, offset)))


def _said(value: object) -> str:
    """As it is written in Python."""
    if not isinstance(value, Columns):
        return repr(value)
    parts = [repr(value.names)]
    for name, usual in (("scale", 1.0), ("offset", 0.0)):
        x = getattr(value, name)
        if x != usual:
            parts.append(f"{name}={f'{x:.10g}' if isinstance(x, float) else tuple(float(f'{y:.10g}') for y in x)}")
    return f"Columns({', '.join(parts)})"
