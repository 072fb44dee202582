"""Figures, tables and verdicts of the results of reproduce.py; no run is needed for it.

python recipes/results.py

Reads docs/results/data, draws into docs/results, and fills in what stands between the markers of docs/results.md and
README.md. Of other data (--data) it makes a page beside them.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterable
from pathlib import Path

import matplotlib
import numpy as np
from checkpoints import replacing
from claims import METHODS, NotRunError, Part, Results, Verdict, try_all
from matrix import EXPERIMENTS, LEARNING_RATES, SEEDS, TASKS, VARIANTS
from reproduce import DATA, best_learning_rate, read

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = {"abpt": "#c8452f", "shac": "#2f6db5", "bptt": "#3b9c5a", "ppo": "#7d7d7d"}
FIGURES = {  # file: experiment, and what is drawn
    "main": (METHODS, TASKS, "return"),
    "published": (("bptt", "shac", *EXPERIMENTS["published"][0]), TASKS, "return"),
    "ablation": (("abpt", *EXPERIMENTS["ablation"][0]), TASKS, "return"),
    "relaxation": (("abpt", "bptt", "shac", *EXPERIMENTS["relaxation"][0]), ("racing",), "gates_passed"),
    "reward": ((*METHODS, *EXPERIMENTS["reward"][0]), ("racing",), "gates_passed"),
    "differences": (("abpt", "shac", *EXPERIMENTS["differences"][0]), ("landing", "racing"), "return"),
    "critic": (("abpt", "abpt-no-0-step", "abpt-critic"), TASKS, "return"),
    "rate": (("abpt", "shac", "bptt", *EXPERIMENTS["rate"][0]), TASKS, "return"),
}
COLUMNS = {  # of the table of ends: heading, column of the curves, factor, digits
    "return": ("return", 1, 2),
    "success [%]": ("success", 100, 0),
    "gates": ("gates_passed", 1, 1),
    "error [cm]": ("position_error", 100, 1),
}
SUMMARY = {  # of the README: what stands beside the success; column of the final evaluations, factor, digits, unit
    "hovering": ("position_error", 100, 1, "cm"),
    "tracking": ("tracking_rmse", 100, 1, "cm"),
    "landing": ("landing_speed", 1, 2, "m/s"),
    "racing": ("gates_passed", 1, 1, "gates"),
}


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    lines = [list(head), ["---" for _ in head], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def spread(values: np.ndarray, factor: float = 1.0, digits: int = 2) -> str:
    """The mean over seeds, and from the least to the greatest."""
    values = factor * values[np.isfinite(values)]
    if len(values) == 0:
        return ""
    return f"{values.mean():.{digits}f} ({values.min():.{digits}f} to {values.max():.{digits}f})"


def draw(results: Results, path: Path, variants: Iterable[str], tasks: Iterable[str], column: str) -> bool:
    """Curves over steps and over seconds: the mean over seeds, and the band from the least to the greatest."""
    tasks = [task for task in tasks if any((task, variant) in results.curves for variant in variants)]
    if not tasks:
        return False
    figure, axes = plt.subplots(2, len(tasks), figsize=(4.2 * len(tasks), 6.4), layout="constrained", squeeze=False)
    shades = plt.get_cmap("tab20")
    for (row, axis), k in ((x, k) for x in enumerate(("steps", "seconds")) for k in range(len(tasks))):
        for i, variant in enumerate(variants):
            try:
                times, values = (results.column(tasks[k], variant, name) for name in (axis, column))
            except NotRunError:
                continue
            # Seeds share their steps, and not their seconds: those are drawn at the same times.
            grid = max(times, key=len) if axis == "steps" else np.linspace(0.0, np.mean([t[-1] for t in times]), 200)
            band = np.array([np.interp(grid, t, y, left=np.nan) for t, y in zip(times, values, strict=True)])
            color = COLORS.get(variant, shades(i))
            axes[row, k].plot(grid, band.mean(0), color=color, linewidth=1.5, label=VARIANTS[variant].label)
            axes[row, k].fill_between(grid, band.min(0), band.max(0), color=color, alpha=0.15, linewidth=0)
        axes[row, k].set(xlabel={"steps": "control steps", "seconds": "seconds"}[axis], xscale="log")
        axes[row, k].grid(alpha=0.3)
        if row == 0:
            axes[row, k].set_title(tasks[k])
        if k == 0:
            axes[row, k].set_ylabel(column.replace("_", " "))
    axes[0, 0].legend(fontsize=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return True


def search_table(data: Path) -> str:
    """What the search for learning rates found, and what it took."""
    finals = [row for row in read(data / "final.csv") if row["lr"]]
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


def best_level(results: Results, task: str) -> float:
    """Nearly the highest of the methods' mean ends, which a method has to reach to have converged in the tables."""
    return results.level(task, max((results.end(task, method) for method in METHODS), key=np.mean))


def ends_table(results: Results, experiment: str) -> str:
    """Where the curves of an experiment end, and when they have converged."""
    variants, tasks = EXPERIMENTS[experiment]
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


def ranking(results: Results) -> str:
    """Who converges first, by steps and by seconds: medians over seeds."""
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


def summary_table(results: Results) -> str:
    """What the best policies of the methods reach, and in how many seconds: mean success, medians of the rest."""
    shown = ("abpt", "abpt-no-0-step", *(method for method in METHODS if method != "abpt"))
    rows = []
    for task, ending in (*((task, "") for task in TASKS), ("racing", "-velocity")):
        column, factor, digits, unit = SUMMARY[task]
        cells = []
        for variant in shown:
            try:
                success, *others = (results.final(task, variant + ending, x) for x in ("success", column, "seconds"))
                metric, seconds = map(np.median, others)
                cells.append(f"{success.mean():.0%}, {factor * metric:.{digits}f} {unit}, {seconds:.0f} s")
            except NotRunError:
                cells.append("")
        reward = {"racing": ", position reward", "racing-velocity": ", velocity reward"}.get(task + ending, "")
        rows.append([task + reward, *cells])
    return table(["", *(VARIANTS[variant].label for variant in shown)], rows)


def claims_table(verdicts: list[Verdict]) -> str:
    """The verdicts, and under each claim what they rest on."""
    rows = [[v.claim.id, v.claim.text, f"**{v.verdict}**", str(v.seeds or "")] for v in verdicts]
    blocks = [table(["", "the paper's claim", "verdict", "seeds"], rows), "### What the verdicts rest on"]
    for v in verdicts:
        if v.parts:
            head = ["part", "value", "95 % interval", "must be", "verdict"]
            rows = [part_row(part, len(v.parts)) for part in v.parts]
            blocks.append(f"**{v.claim.id}** {v.claim.text}\n\n" + table(head, rows))
    return "\n\n".join(blocks)


def audit_table(data: Path) -> str:
    """What each term of each reward gives to return and gradient."""
    rows = [
        [
            x["task"],
            x["reward"],
            x["term"],
            f"{float(x['return_share']):.1%}",
            f"{float(x['gradient_share']):.1%}",
            x["verdict"],
        ]
        for x in read(data / "audit.csv")
    ]
    return table(["task", "reward", "term", "share of the return", "share of the gradient", "verdict"], rows)


def ascent_table(data: Path) -> str:
    """How near the gradients of the last policies come to the measured ones, by ascent.py."""
    columns = {
        "objective": "objective",
        "N-step return": "n_step_return",
        "0-step return": "zero_step_return",
        "two measurements": "halves",
        "explained variance of the critic": "explained_variance",
    }
    runs: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in read(data / "ascent.csv"):
        runs.setdefault((row["task"], row["variant"]), []).append(row)
    order = sorted(runs, key=lambda run: (TASKS.index(run[0]), list(VARIANTS).index(run[1])))
    rows = [
        [task, VARIANTS[variant].label, str(len(runs[task, variant]))]
        + [spread(np.array([float(x.get(name) or "nan") for x in runs[task, variant]])) for name in columns.values()]
        for task, variant in order
    ]
    return table(["task", "", "seeds", *columns], rows)


def part_row(part: Part, parts: int) -> list[str]:
    """A part of a claim as a row."""
    bounds = [
        f"> {part.low:g}" if math.isfinite(part.low) else "",
        f"< {part.high:g}" if math.isfinite(part.high) else "",
    ]
    interval = "{:.3g} to {:.3g}".format(*part.interval())
    must = " and ".join(filter(None, bounds))
    return [part.what.replace(">", "&gt;"), f"{part.value:.3g}", interval, must, part.verdict(parts)]


def page(data: Path, pictures: Path) -> str:
    """The generated part of docs/results.md."""
    results = Results(data)
    verdicts, published = try_all(data)
    finals = read(data / "final.csv")
    hours = sum(float(row["seconds"] or 0) for row in finals) / 3600
    machines = sorted({row["machine"] for row in finals})
    seeds = {seed for runs in results.curves.values() for seed in runs}
    blocks = [
        f"{len(finals)} runs, {hours:.1f} hours of training, each run on one core of {', '.join(machines) or 'none'}; "
        f"seeds {', '.join(str(seed) for seed in SEEDS if seed in seeds) or 'none yet'}.",
        "## Verdicts",
        claims_table(verdicts),
        "## Verdicts on BPTT, SHAC and ABPT as published",
        "BPTT through whole episodes, SHAC without the gradient of its terminal value, ABPT with an entropy bonus in "
        "landing and racing.",
        claims_table(published),
        "## Reward audit",
        audit_table(data),
        "## Rankings",
        ranking(results),
        "## Learning rates",
        search_table(data),
    ]
    for name, (variants, tasks, column) in FIGURES.items():
        blocks.append(f"## {name.capitalize()}")
        if draw(results, pictures / f"{name}.png", variants, tasks, column):
            blocks.append(f"![Curves of the experiment: {name}](results/{name}.png)")
        blocks.append(ends_table(results, name))
    blocks += ["## Ascent", ascent_table(data)]
    return "\n\n".join(blocks)


def fill(path: Path, marker: str, new: str) -> None:
    """Put a text between the marker and the end in a file."""
    begin, end = f"<!-- {marker} -->", "<!-- end -->"
    old = path.read_text() if path.exists() else f"# Results\n\n{begin}\n{end}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(re.sub(f"{begin}.*?{end}", lambda _: f"{begin}\n\n{new}\n\n{end}", old, flags=re.DOTALL))
    print(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="of another folder the page is made in it")
    data = parser.parse_args().data
    shipped = data.resolve() == DATA.resolve()
    docs, readme = (DATA.parents[1], DATA.parents[2] / "README.md") if shipped else (data, data / "summary.md")
    marker = "generated by recipes/results.py"
    fill(docs / "results.md", marker, page(data, docs / "results"))
    fill(readme, marker, summary_table(Results(data)))


if __name__ == "__main__":
    main()
