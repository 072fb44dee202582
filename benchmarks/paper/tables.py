"""The tables of the trial's pages and of README.md, in Markdown, made of the results and the recipes' configuration."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
from omegaconf import DictConfig, OmegaConf

from benchmarks.paper.claims import METHODS, PUBLISHED, Verdict
from benchmarks.paper.evidence import NotRunError, Part, Results
from benchmarks.paper.matrix import EXPERIMENTS, LEARNING_RATES, TASKS, VARIANTS
from benchmarks.paper.reproduce import best_learning_rate
from benchmarks.paper.running import composed
from torchrl_quad.files import read_rows

COLUMNS = {  # of the tables of ends: heading, column of the curves, factor, digits
    "return": ("return", 1, 2),
    "solved [%]": ("solved", 100, 0),
    "gates": ("gates_passed", 1, 1),
    "error [cm]": ("position_error", 100, 1),
}


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Write a table in Markdown."""
    lines = [list(head), ["---" for _ in head], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def spread(values: np.ndarray, factor: float = 1.0, digits: int = 2) -> str:
    """Write the mean over seeds, and the least and the greatest."""
    values = factor * values[np.isfinite(values)]
    if len(values) == 0:
        return ""
    return f"{values.mean():.{digits}f} ({values.min():.{digits}f} to {values.max():.{digits}f})"


# -- protocol ----------------------------------------------------------------------------------------------------------


@cache
def recipe(algorithm: str, task: str) -> DictConfig:
    """Compose the configuration of a recipe on a task."""
    return composed(algorithm, [f"task={task}"])


def starts(task: str, variant: str) -> str:
    """Say where the horizons of a variant start, from its configuration."""
    overrides = OmegaConf.from_dotlist(list(VARIANTS[variant].overrides))
    cfg = OmegaConf.merge(recipe(VARIANTS[variant].algorithm, task), overrides)
    visited = cfg.buffer.fraction if "buffer" in cfg else None
    if visited is not None:
        return f"{visited:.0%} visited, {1 - visited:.0%} fresh"
    fresh = cfg.get("restart_fraction", 0)
    return f"{fresh:.0%} fresh, {1 - fresh:.0%} go on" if fresh else "all go on"


def starts_table() -> str:
    """List the methods, those as published, and every other variant whose horizons start in another way."""
    rows = []
    for name, of in ((name, of) for variants in EXPERIMENTS.values() for name, of in variants.items()):
        own, usual = (
            [starts(task, x) if task in of else "" for task in TASKS] for x in (name, VARIANTS[name].algorithm)
        )
        if name in METHODS or name in PUBLISHED.values() or own != usual:
            rows.append([VARIANTS[name].label, *own])
    return table(["", *TASKS], rows)


def revisions_table(data: Path) -> str:
    """List the revisions of the code that the runs were flown at."""
    experiments = {variant: name for name, variants in EXPERIMENTS.items() for variant in variants}
    groups: dict[tuple[str, str, str], list[str]] = {}
    for row in read_rows(data / "final.csv"):
        revision = re.sub("[0-9a-f]{40}", lambda match: match[0][:7], row.get("revision") or "unknown")
        key = row.get("flown") or "", revision, row.get("dynamics") or ""
        groups.setdefault(key, []).append("search" if row["lr"] else experiments[row["variant"]])
    rows = [
        [revision, flown, dynamics, str(len(of)), ", ".join(x for x in ("search", *EXPERIMENTS) if x in of)]
        for (flown, revision, dynamics), of in sorted(groups.items(), key=lambda group: (group[0][0], -len(group[1])))
    ]
    return table(["revision", "date", "dynamics", "runs", "experiments"], rows)


def search_table(data: Path) -> str:
    """Show what the search for learning rates found, and its cost."""
    finals = [row for row in read_rows(data / "final.csv") if row["lr"]]
    rows = []
    for name, variant in VARIANTS.items():
        if not variant.searched:
            continue
        own = [row for row in finals if row["variant"] == name]
        found = {task: best_learning_rate(task, name, data, LEARNING_RATES) for task in TASKS}
        steps, seconds = (sum(float(row[key] or 0) for row in own) for key in ("steps", "seconds"))
        if name not in METHODS:  # another reward of racing
            found |= {task: "" for task in TASKS if task != "racing"}
        rates = ["not complete" if lr is None else lr and f"{lr:g}" for lr in found.values()]
        rows.append([variant.label, *rates, f"{len(own)}", f"{steps / 1e6:.1f} M", f"{seconds:.0f}"])
    return table(["", *TASKS, "runs", "control steps", "seconds"], rows)


# -- ends of curves ----------------------------------------------------------------------------------------------------


def best_level(results: Results, task: str) -> float:
    """Give the return at which a method counts as converged in the tables: nearly the highest of the mean ends."""
    return results.level(task, max((results.end(task, method) for method in METHODS), key=np.mean))


def ends_table(results: Results, experiment: str) -> str:
    """Show where the curves of an experiment end, and when they converge."""
    tasks = [task for task in TASKS if any(task in of for of in EXPERIMENTS[experiment].values())]
    variants = tuple(EXPERIMENTS[experiment])
    if experiment != "main":
        variants = (*dict.fromkeys(VARIANTS[variant].algorithm for variant in variants), *variants)
    rows = []
    for task, variant in ((task, variant) for task in tasks for variant in variants):
        try:
            columns = [results.end(task, variant, name) for name, _, _ in COLUMNS.values()]
            level = best_level(results, task)
            until = [results.until(task, variant, axis, level) for axis in ("steps", "seconds")]
        except NotRunError:
            continue
        cells = [spread(x, factor, digits) for x, (_, factor, digits) in zip(columns, COLUMNS.values(), strict=True)]
        median = [f"{np.median(x) / scale:.{d}f}" for x, scale, d in zip(until, (1e6, 1), (2, 0), strict=True)]
        median = ["never" if cell == "inf" else cell for cell in median]
        if experiment in ("reward", "relaxation"):  # whose returns are of another kind
            median = ["", ""]
        rows.append([task, VARIANTS[variant].label, str(len(columns[0])), *cells, *median])
    return table(["task", "", "seeds", *COLUMNS, "converged at [M steps]", "[s]"], rows)


def overview_cell(results: Results, task: str, variant: str) -> str:
    """Write the means of the ends: return and solved episodes, and in racing the gates passed."""
    try:
        reached, solved = (results.end(task, variant, name).mean() for name in ("return", "solved"))
        gates = f", {results.end(task, variant, 'gates_passed').mean():.1f} gates" if task == "racing" else ""
    except NotRunError:
        return "not run"
    return f"{reached:.1f}, {100 * solved:.0f} %{gates}"


def overview(results: Results, variants: Iterable[str], tasks: Iterable[str] = TASKS) -> str:
    """Show the means of the ends, a row for each variant."""
    rows = [[VARIANTS[x].label, *(overview_cell(results, task, x) for task in tasks)] for x in variants]
    return table(["", *tasks], rows)


def methods_table(results: Results) -> str:
    """Show the means of the ends, a row for each task and a column for each method."""
    rows = [[task, *(overview_cell(results, task, x) for x in METHODS)] for task in TASKS]
    rows.append(["racing, velocity reward", *(overview_cell(results, "racing", f"{x}-velocity") for x in METHODS)])
    return table(["", *(VARIANTS[method].label for method in METHODS)], rows)


def ranking(results: Results) -> str:
    """Show who converges first, by steps and by seconds: medians over seeds."""
    rows = []
    for task in TASKS:
        cells = []
        for axis in ("steps", "seconds"):
            try:
                level = best_level(results, task)
                times = {method: np.median(results.until(task, method, axis, level)) for method in METHODS}
            except NotRunError:
                break
            order = sorted(times, key=times.get)
            cells.append(", ".join(VARIANTS[m].label + (" (never)" if math.isinf(times[m]) else "") for m in order))
        rows.append([task, *(cells or ["", ""])])
    return table(["task", "by steps", "by seconds"], rows)


def verdicts_table(verdicts: list[Verdict], published: list[Verdict]) -> str:
    """List the claims under their verdicts, for the recipes' methods and for those as published."""
    kinds = dict.fromkeys(v.verdict for v in sorted((*verdicts, *published), key=lambda v: v.verdict))
    rows = [[x, *(", ".join(v.claim.id for v in of if v.verdict == x) for of in (verdicts, published))] for x in kinds]
    return table(["verdict", "methods of the recipes", "methods as published"], rows)


def published_table() -> str:
    """Show which variant represents each method as published."""
    rows = [
        [VARIANTS[method].label, *(VARIANTS[PUBLISHED.get((task, method), method)].label for task in TASKS)]
        for method in METHODS
    ]
    return table(["", *TASKS], rows)


def claims_table(verdicts: list[Verdict]) -> str:
    """Show the verdicts, and then the parts of each claim."""
    rows = [[v.claim.id, v.claim.text, f"**{v.verdict}**", str(v.seeds or ""), v.dynamics] for v in verdicts]
    blocks = [table(["", "the paper's claim", "verdict", "seeds", "dynamics"], rows), "### The parts of each claim"]
    for v in verdicts:
        if v.parts:
            head = ["part", "value", "95 % interval", "must be", "verdict"]
            rows = [part_row(part, len(v.parts)) for part in v.parts]
            blocks.append(f"**{v.claim.id}** {v.claim.text}\n\n" + table(head, rows))
    return "\n\n".join(blocks)


def part_row(part: Part, parts: int) -> list[str]:
    """Write a part of a claim as a row."""
    bounds = [
        f"> {part.low:g}" if math.isfinite(part.low) else "",
        f"< {part.high:g}" if math.isfinite(part.high) else "",
    ]
    interval = "{:.3g} to {:.3g}".format(*part.interval())
    must = " and ".join(filter(None, bounds))
    return [part.what.replace(">", "&gt;"), f"{part.value:.3g}", interval, must, part.verdict(parts)]


# -- rewards and gradients ---------------------------------------------------------------------------------------------


def audit_table(data: Path) -> str:
    """Show the share of each reward term in return and gradient."""
    rows = [
        [x["task"], x["reward"], x["term"]]
        + [f"{float(x[name]):.1%}" for name in ("return_share", "gradient_share")]
        + [x["verdict"]]
        for x in read_rows(data / "audit.csv")
    ]
    return table(["task", "reward", "term", "share of the return", "share of the gradient", "verdict"], rows)


def ascent_table(data: Path) -> str:
    """Compare the gradients at the last policies with the measured ones: the results of ascent.py."""
    columns = {
        "N-step return": "n_step_return",
        "0-step return": "zero_step_return",
        "whole objective": "objective",
        "measurement": "halves",
        "explained variance of the critic": "explained_variance",
    }
    runs: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in read_rows(data / "ascent.csv"):
        runs.setdefault((row["task"], row["variant"]), []).append(row)
    order = sorted(runs, key=lambda run: (TASKS.index(run[0]), list(VARIANTS).index(run[1])))
    rows = [
        [task, VARIANTS[variant].label, str(len(runs[task, variant]))]
        + [spread(np.array([float(x.get(name) or "nan") for x in runs[task, variant]])) for name in columns.values()]
        for task, variant in order
    ]
    return table(["task", "", "seeds", *columns], rows)
