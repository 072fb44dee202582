"""What may mend a log that is refused: each is tried on the log before a message tells it.

A remedy is a mapping: arguments of ``read_log`` by name, ``span`` (times to read between), or a ``quantity`` and what
to do with its columns: ``factor`` and ``offset`` (a number, or one for each component), ``order`` (of components, in
ours), ``name`` (as which quantity), ``drop``; ``when`` says on what it depends.
"""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchrl_quad.deploy.frames import Convention
from torchrl_quad.identification.errors import LogError, Remedy
from torchrl_quad.identification.layouts import RIVALS, Columns, Layout

_DEEPEST, _MOST, _SECONDS = 4, 30, 60.0  # faults of one log that are mended together; how often it is read, how long


@dataclass(frozen=True)
class Mended:
    """How a log is read: with which layout, and how that and the options differ from what the caller gave."""

    layout: Layout
    there: set[str]  #: the columns of the file
    columns: Mapping[str, Columns | None] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)  #: of other arguments
    when: tuple[str, ...] = ()
    done: tuple[object, ...] = ()

    def by(self, remedy: Remedy) -> Mended | None:
        """With one more remedy; None where it was done, or the file does not have its quantity."""
        axes = np.ndim(remedy.get("factor", 0.0))
        kind = (remedy.get("quantity"), remedy.keys() - {"when"}, axes)
        if kind in self.done or ("convention" in self.changes and ("convention" in remedy or axes)):
            return None
        todo, layout = dict(remedy), self.layout
        when = (*self.when, *filter(None, [todo.pop("when", "")]))
        quantity = todo.pop("quantity", None)
        if quantity is None:
            if "convention" in todo:  # the order of quaternions is that of the columns, whatever the frame
                todo["convention"] = replace(todo["convention"], xyzw=layout.convention.xyzw)
            layout = replace(layout, convention=todo.get("convention", layout.convention))
            return replace(self, layout=layout, changes={**self.changes, **todo}, when=when)
        name = todo.get("name", quantity)
        choices = (c for c in layout.columns.get(quantity, ()) if self.there >= set(c.names))
        used = layout.time if quantity == "time" else next(choices, None)
        if used is None:
            return None
        places = _places(layout.convention, quantity, len(used.names))
        columns = None if "drop" in todo else _changed(used, places, todo)
        kept = {q: x for q, x in layout.columns.items() if q not in (quantity, name)}
        kept |= {} if columns is None else {name: (columns,)}
        (time,) = kept.pop("time", (layout.time,))
        layout = replace(layout, columns=kept, time=time)
        others = {q: x for q, x in self.columns.items() if q != quantity}
        return replace(self, layout=layout, columns={**others, name: columns}, when=when, done=(*self.done, kind))

    def told(self, asked: object) -> str:
        """What to write, for a caller who asked for some columns."""
        parts, span = [], self.changes.get("span")
        if self.columns:
            ousted = {rival for pair in RIVALS for rival in pair if set(pair) & set(self.columns)}
            given = {k: v for k, v in asked.items() if k not in ousted} if isinstance(asked, Mapping) else {}
            entries = (f'"{name}": {_said(value)}' for name, value in {**given, **self.columns}.items())
            parts.append(f"columns={{{', '.join(entries)}}}")
        for name, value in self.changes.items():
            if name != "span":
                said = f"{value:g}" if name != "convention" else f"frames.{value.name.lower()}()"
                if name == "convention" and value.xyzw:
                    said = f"dataclasses.replace({said}, xyzw=True)"
                parts.append(f"{name}={said}")
        condition = f"If {' and '.join(dict.fromkeys(self.when))}, write " if self.when else "Write "
        told = [f"Its part from {span[0]:.10g} to {span[1]:.10g} s reads: cut the file there."] if span else []
        return " ".join(told + ([f"{condition}{', '.join(parts)}."] if parts else []))


def remedy_for(error: LogError, start: Mended, read: Callable[[Mended], object]) -> Mended | None:
    """The fewest remedies with which the log reads: one alone, else with those of the errors that come next."""
    queue, reads, begun = collections.deque([(error, start, 1)]), 0, time.monotonic()
    while queue:
        error, before, depth = queue.popleft()
        for mended in filter(None, map(before.by, error.remedies)):
            if reads == _MOST or time.monotonic() - begun > _SECONDS:
                return None
            reads += 1
            try:
                read(mended)
            except LogError as further:
                queue.extend([(further, mended, depth + 1)] if depth < _DEEPEST else [])
            else:
                return mended
    return None


def _places(convention: Convention, quantity: str, count: int) -> list[int]:
    """Where the file has each of our components."""
    if quantity == "quaternion" and convention.xyzw:
        return [3, 0, 1, 2]
    if quantity in ("motor_command", "rotor_speed") and convention.motors:
        return np.argsort(convention.motors).tolist()
    return list(range(count))


def _changed(used: Columns, places: list[int], todo: Mapping[str, Any]) -> Columns:
    n = len(used.names)
    given = used.scale, used.offset, todo.get("factor", 1.0), todo.get("offset", 0.0)
    scale, offset, factor, less = (np.broadcast_to(np.asarray(x, float), n) for x in given)
    source = np.arange(n)
    source[places] = np.array(places)[list(todo.get("order", range(n)))]
    factor, less = factor[np.argsort(places)], less[np.argsort(places)]
    scale, offset = scale[source], offset[source] + less / scale[source]
    names = tuple(used.names[k] for k in source)
    return Columns(names, *(x[0] if (x == x[0]).all() else tuple(x.tolist()) for x in (scale * factor, offset)))


def _said(value: object) -> str:
    if not isinstance(value, Columns):
        return repr(value)
    said = repr(value.names)
    for name, usual in (("scale", 1.0), ("offset", 0.0)):
        x = getattr(value, name)
        if x != usual:
            said += f", {name}={f'{x:.10g}' if isinstance(x, float) else tuple(float(f'{y:.10g}') for y in x)}"
    return f"Columns({said})"
