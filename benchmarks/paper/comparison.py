"""Compare the recipes as they ship: which method to take on which task, with intervals over the seeds.

shipped.py calls this after its flights. It flies nothing by itself. The conventions are those of Agarwal et al. 2021,
"Deep reinforcement learning at the edge of the statistical precipice": interquartile means, percentile intervals of the
bootstrap, and the probability that one method improves on another. The bootstrap draws seeds and a set of starts
(evidence.py), but for the curves and for tasks that starts.py has not flown, where it draws seeds alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import trim_mean

from benchmarks.paper.evidence import Starts, bootstrap, judged, probability
from benchmarks.paper.results import COLORS
from benchmarks.paper.tables import table
from torchrl_quad.files import replacing

Row = Mapping[str, str]
Shown = tuple[str, float, int, str]  # of a task: column, factor, digits, unit
RELIABLE = 0.99  # of the episodes, solved by the worst seed
ENOUGH, WANTED = 3, 10  # seeds: for an interval, and of each method
LABELS = {  # of variants of a task
    "racing_position": "racing, position",
    "six_gates": "six gates",
    "six_gates_back": "six gates, backwards",
}


def interquartile_mean(values: ArrayLike) -> NDArray[np.float64]:
    """The mean (*) of the middle half of values (*, seeds), without the quarter below and the quarter above it."""
    return trim_mean(values, 0.25, axis=-1)


def interval(values: Sequence[float]) -> tuple[float, float]:
    """The 95 % interval of the interquartile mean, by the bootstrap over seeds and, of what is ``judged``, starts."""
    return bootstrap("", interquartile_mean, np.asanyarray(values)).interval()


def is_level(one: np.ndarray, best: np.ndarray) -> bool:
    """Whether the 95 % interval of the difference of two interquartile means, from the same starts, reaches zero."""
    gap = bootstrap("", lambda a, b: interquartile_mean(a) - interquartile_mean(b), one, best)
    return not gap.interval()[1] < 0.0


def column(rows: Sequence[Row], name: str) -> list[float]:
    """Read a column, as numbers; what was not measured is left out."""
    return [float(row[name]) for row in rows if row.get(name)]


def returns_of(rows: Sequence[Row], starts: Starts) -> np.ndarray:
    """The returns of a method's seeds on a task, with what another set of starts would change."""
    return judged(np.array(column(rows, "return")), starts.shift(rows[0]["task"], rows[0]["algorithm"], "return"))


def grouped(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Group the rows by task and method."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["task"], row["algorithm"]), []).append(row)
    return groups


def reached_table(rows: Sequence[Row], methods: Mapping[str, str], shown: Mapping[str, Shown], starts: Starts) -> str:
    """Show what every method reaches on every task, and what it takes."""
    groups, lines = grouped(rows), []
    for task, (name, factor, digits, unit) in shown.items():
        for method, label in methods.items():
            own = groups.get((task, method))
            if not own:
                continue
            returns, solved, metric = returns_of(own, starts), *(column(own, x) for x in ("solved", name))
            mean = f"{interquartile_mean(returns):.4g}"
            if len(returns) >= ENOUGH:
                mean += " ({:.4g} to {:.4g})".format(*interval(returns))
            precise = f"{factor * np.median(metric):.{digits}f} {unit}" if metric else ""
            cost = f"{np.median(column(own, 'steps')) / 1e6:.1f}", f"{np.median(column(own, 'seconds')):.0f}"
            share = f"{np.mean(solved):.1%} ({min(solved):.1%})"
            lines.append([LABELS.get(task, task), label, str(len(own)), mean, share, precise, *cost])
    head = ["task", "", "seeds", "return (95 % interval)", "solved (worst seed)", "", "million steps", "seconds"]
    return table(head, lines)


def choice_table(rows: Sequence[Row], methods: Mapping[str, str], shown: Mapping[str, Shown], starts: Starts) -> str:
    """Show for each task the quickest method that works with every seed, and the one of the highest return.

    They are chosen among the methods that have flown with the most seeds. Those that :func:`is_level` finds are level
    with the highest return.
    """
    groups, lines = grouped(rows), []
    for task in shown:
        flown = {method: groups[task, method] for method in methods if (task, method) in groups}
        if not flown:
            continue
        worst = {method: min(column(own, "solved")) for method, own in flown.items()}
        returns = {method: interquartile_mean(column(own, "return")) for method, own in flown.items()}
        seconds_of = {method: np.median(column(own, "seconds")) for method, own in flown.items()}
        seeds = max(map(len, flown.values()))
        tried = [method for method, own in flown.items() if len(own) == seeds]
        quick = min((x for x in tried if worst[x] >= RELIABLE), key=seconds_of.get, default=None)
        most = max(tried, key=returns.get)
        few = {x: f", {len(own)} seed{'s' * (len(own) > 1)}" if len(own) < WANTED else "" for x, own in flown.items()}
        said = {x: f"{methods[x]}: {returns[x]:.4g}, {worst[x]:.1%}, {seconds_of[x]:.0f} s{few[x]}" for x in flown}
        reached = {x: returns_of(flown[x], starts) for x in tried if seeds >= ENOUGH}
        level = [methods[x] for x in reached if x != most and is_level(reached[x], reached[most])]
        cells = [said.get(x, "none") for x in (quick, most)]
        lines.append([LABELS.get(task, task), *cells, ", ".join(level)])
    return table(["task", "quickest that works with every seed", "highest return", "level with it"], lines)


def speed_table(rows: Sequence[Row], methods: Mapping[str, str], shown: Mapping[str, Shown]) -> str:
    """Show how many thousand steps a second each method took on each machine: medians over the seeds."""
    speeds: dict[tuple[str, str], dict[str, list[float]]] = {}
    for task in shown:
        for row in sorted((x for x in rows if x["task"] == task), key=lambda x: x["machine"]):
            own = speeds.setdefault((task, row["machine"]), {}).setdefault(row["algorithm"], [])
            own.append(float(row["steps"]) / float(row["seconds"]) / 1e3)
    lines = [
        [LABELS.get(task, task), f'"{name}"', *(f"{np.median(own[x]):.0f}" if x in own else "" for x in methods)]
        for (task, name), own in speeds.items()
    ]
    return table(["task", "machine", *methods.values()], lines)


def improvement_table(rows: Sequence[Row], methods: Mapping[str, str], shown: Mapping[str, Shown]) -> str:
    """Show how probable it is that the method of a row has a higher return than that of a column, over the tasks."""
    groups, lines = grouped(rows), []
    enough = [x for x in methods if any(len(groups.get((task, x), ())) >= ENOUGH for task in shown)]
    for ours in enough:
        cells = []
        for theirs in enough:
            both = [
                [column(groups[task, method], "return") for method in (ours, theirs)]
                for task in shown
                if all(len(groups.get((task, method), ())) >= ENOUGH for method in (ours, theirs))
            ]
            values = [probability(*map(np.array, pair)) for pair in both]
            cells.append(f"{np.mean(values):.2f}, {len(values)}" if values and ours != theirs else "")
        lines.append([methods[ours], *cells])
    return table(["", *(methods[x] for x in enough)], lines)


def draw(curves: Sequence[Row], methods: Mapping[str, str], tasks: Sequence[str], path: Path) -> None:
    """Draw the return over steps and over seconds: interquartile means over the seeds, and their intervals."""
    from matplotlib.figure import Figure

    runs: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for point in curves:
        runs.setdefault((point["task"], point["algorithm"]), {}).setdefault(point["seed"], []).append(point)
    tasks = [task for task in tasks if any((task, method) in runs for method in methods)]
    if not tasks:
        return
    figure = Figure((3.2 * len(tasks) + 0.6, 5.2), layout="constrained")
    panels = figure.subplots(2, len(tasks), squeeze=False)
    lines = {}
    for row, (time, unit) in enumerate((("steps", 1e6), ("seconds", 1.0))):
        for panel, task in zip(panels[row], tasks, strict=True):
            for method in methods:
                if (task, method) not in runs:
                    continue
                seeds = [[column(points, x) for x in (time, "return")] for points in runs[task, method].values()]
                grid = np.linspace(0.0, np.median([t[-1] for t, _ in seeds]), 100)
                values = np.array([np.interp(grid, t, y, left=np.nan) for t, y in seeds])
                grid, values = (x[..., np.isfinite(values).all(0)] for x in (grid, values))
                (lines[method],) = panel.plot(grid / unit, interquartile_mean(values.T), color=COLORS[method])
                if len(seeds) >= ENOUGH:
                    low, high = np.transpose([interval(x) for x in values.T])
                    panel.fill_between(grid / unit, low, high, color=COLORS[method], alpha=0.2, linewidth=0)
            panel.grid(alpha=0.3)
            panel.set(xlabel={"steps": "million control steps", "seconds": "processor seconds"}[time])
            panel.set_title("" if row else LABELS.get(task, task))
        panels[row, 0].set_ylabel("return")
    names = [methods[method] for method in lines]
    figure.legend(lines.values(), names, loc="outside lower center", ncols=len(names), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
