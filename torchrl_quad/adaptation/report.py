"""One page about an adaptation, with its pictures inside: what changed, and what the flights do not cover."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.adaptation.adapting import Adaptation
from torchrl_quad.adaptation.fit import UNKNOWNS, FlightFit
from torchrl_quad.files import replacing
from torchrl_quad.identification import FlightLog
from torchrl_quad.render.canvas import BLUE, INK, RED, make_figure, png

_NAMES = [f"{name} {x}" for name, what in zip(UNKNOWNS, ("0123", "xyz", "xy", "xy"), strict=True) for x in what]
_STYLE = "body{font:16px/1.5 sans-serif;max-width:56em;margin:2em auto;color:#222}td,th{padding:.1em 1em .1em 0}"


def write_report(found: Adaptation, path: str | Path, logs: Sequence[FlightLog]) -> None:
    """Write an HTML page that needs no other file; it is complete or not there. It needs matplotlib.

    Args:
        found: what an :class:`Adapter` returned.
        path: of the page.
        logs: the flights that it was given.
    """
    flown = "".join(f"<li>{html.escape('. '.join([f'{x.name}: {_ranges(x)}', *x.notes]))}</li>" for x in logs)
    verdict = "The policy changed" if found.changed else "The policy stays as it was"
    parts = [f"<h1>{verdict}</h1><p>{html.escape(found.reason)}.</p>"]
    left = ["Speeds, heights and turns beyond those of the flights below", "Gusts: the wind is taken as steady"]
    if (fit := found.fit) is not None:
        rows = [(f"error of {k.replace('_', ' ')}, held out", v, fit.after[k]) for k, v in fit.before.items()]
        parts += ["<h2>What the flights say</h2>", _table("of the simulator", "of the fit", rows)]
        wide = (1.96 * fit.spread()).tolist()
        parts += [_table("fitted", "&plusmn; 95 %", [*zip(_NAMES, fit.mean.tolist(), wide, strict=True)])]
        parts += [
            "<p>Rotors and turning are relative to the simulator's: 0 is no change. Wind is in m/s, shear in 1/s."
        ]
        parts += [_image(_fitted(fit), "The table as a picture")]
        left += ["A change that all rotors share: mass, battery and motor_command have the same effect"]
        left += ["The simulator's own drone, which evaluate.py flies: the new policy is for the fitted one"]
        left += [f"{name}, which is the simulator's: it needs {why}" for name, why in fit.not_told.items()]
    if found.flights:
        rows = [(name.replace("_", " "), x, found.after[name]) for name, x in found.before.items()]
        parts += ["<h2>The policies in the fitted simulator</h2>", _table("before", "after", rows)]
        parts.append(_image(_compared(found), "Both policies over time: the median, and nine in ten flights"))
    parts.append(f"<h2>What is not covered</h2><ul>{''.join(f'<li>{x}.</li>' for x in left)}</ul>")
    spent = ", ".join(f"{name} {x:.1f} s" for name, x in found.seconds.items())
    parts.append(f"<h2>Flights</h2><ul>{flown}</ul><p>KL divergence from the old policy: {found.kl:.3g}. {spent}.</p>")
    page = f"<!doctype html><meta charset=utf-8><title>{verdict}</title><style>{_STYLE}</style>{''.join(parts)}"
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _ranges(log: FlightLog) -> str:
    rows = np.concatenate([np.arange(*piece) for piece in log.segments])
    speed, turn = (np.linalg.norm(x[rows], axis=1).max() for x in (log.velocity, log.angular_velocity))
    low, high = log.position[rows, 2].min(), log.position[rows, 2].max()
    return f"{len(rows) * log.dt:.1f} s, up to {speed:.2g} m/s and {turn:.2g} rad/s, {low:.2f} to {high:.2f} m high"


def _table(before: str, after: str, rows: Sequence[tuple[str, float, float]]) -> str:
    lines = "".join(f"<tr><td>{html.escape(name)}</td><td>{a:.4g}</td><td>{b:.4g}</td></tr>" for name, a, b in rows)
    return f"<table><tr><th></th><th>{before}</th><th>{after}</th></tr>{lines}</table>"


def _image(figure: Any, caption: str) -> str:
    picture = base64.b64encode(png(figure, dpi=110)).decode()
    return f'<p><img alt="{caption}" src="data:image/png;base64,{picture}"><br>{caption}.'


def _fitted(fit: FlightFit) -> Any:
    """The unknowns with their 95 % intervals."""
    figure = make_figure(figsize=(7.2, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(7, 4))
    mean, wide = fit.mean.numpy(), 1.96 * fit.spread().numpy()
    for ax, part, label in ((left, slice(0, 7), "relative to the simulator"), (right, slice(7, 11), "m/s, 1/s")):
        places = np.arange(11)[part]
        ax.errorbar(places, mean[part], wide[part], fmt="o", color=BLUE, capsize=3)
        ax.axhline(0.0, color=INK, linewidth=0.6)
        ax.set_xticks(places, _NAMES[part], fontsize=7, rotation=30)
        ax.set_ylabel(label, fontsize=8)
        ax.tick_params(axis="y", labelsize=7)
    return figure


def _compared(found: Adaptation) -> Any:
    """What the task measures over time, of both policies: the median, and nine in ten."""
    figure = make_figure(figsize=(7.2, 2.6), layout="constrained")
    ax = figure.subplots()
    for flight, color, label in zip(found.flights, (RED, BLUE), ("before", "after"), strict=True):
        measured: Any = flight.get(("next", "metrics"), {"reward": flight.get(("next", "reward"))})
        name = next(iter(measured.keys()))
        values: Any = measured[name].squeeze(-1).float().numpy()
        low, middle, high = np.nanquantile(values, (0.05, 0.5, 0.95), axis=0)
        time = np.arange(1, len(middle) + 1) * found.control_dt
        ax.fill_between(time, low, high, color=color, alpha=0.2, linewidth=0)
        ax.plot(time, middle, color=color, label=label)
    ax.set_xlabel("time [s]")
    ax.set_ylabel(name.replace("_", " "))
    ax.legend(frameon=False)
    return figure
