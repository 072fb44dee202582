"""Make tables, figures and verdicts of the results of reproduce.py; fill the generated blocks of README.md and docs.

python -m benchmarks.paper.results
python -m benchmarks.paper.results --data FOLDER   # of other results: makes one page in that folder, and its figures
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import report
from benchmarks.paper import flights, tables
from benchmarks.paper.claims import METHODS
from benchmarks.paper.evidence import Results, Row, column, grouped
from benchmarks.paper.matrix import TASKS, VARIANTS
from benchmarks.paper.running import DATA, ships
from benchmarks.paper.tables import ENOUGH, LABELS, Table, interquartile_mean, interval
from torchrl_quad.files import make_folder, read_rows, replacing, write_rows

ROOT = DATA.parents[2]
COLORS = {"ABPT": "#c8452f", "SHAC": "#2f6db5", "BPTT": "#3b9c5a", "PPO": "#7d7d7d", "Hybrid": "#8a4fb0"}
COLORS |= {"SAPO": "#c99a2e", "AHAC": "#35a7a7"}
AXES = {"steps": ("million control steps", 1e6), "seconds": ("processor seconds", 1.0)}


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def filled(page: str, made: dict[str, Table]) -> str:
    """Replace the generated blocks of a page, each between its marker and the end, by the tables of these names."""
    for name, table in made.items():
        page = report.filled(page, f"paper: {name}", tables.markdown(table))
    return page


def write(path: Path, text: str) -> None:
    if not path.exists() or path.read_text() != text:
        with replacing(path) as temporary:
            temporary.write_text(text)
        print(path)


Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # x, y, and the least and the greatest of a band
Panel = dict[str, Curve]  # by the label of each curve


def draw(
    path: Path, rows: Sequence[Sequence[Panel]], titles: Sequence[str], xlabels: Iterable[str], ylabel: str, **axes: Any
) -> None:
    """Draw curves and their bands in rows of panels: titles of the columns, labels of the rows, properties of all."""
    labels = list(dict.fromkeys(label for row in rows for panel in row for label in panel))
    if not labels:
        return
    figure = Figure((3.2 * len(titles) + 0.6, 2.4 * len(rows) + 0.6), layout="constrained")
    handles = {}
    for row, plots, xlabel in zip(rows, figure.subplots(len(rows), len(titles), squeeze=False), xlabels, strict=True):
        for panel, plot, title in zip(row, plots, titles, strict=True):
            for label, (x, y, low, high) in panel.items():
                color = COLORS.get(label, f"C{labels.index(label)}")
                (handles[label],) = plot.plot(x, y, color=color)
                plot.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)
            plot.set(xlabel=xlabel, title=title if row is rows[0] else "", **axes)
            plot.grid(alpha=0.3)
        plots[0].set_ylabel(ylabel)
    figure.legend([handles[x] for x in labels], labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    make_folder(path.parent)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def draw_training(
    path: Path, runs: dict[str, dict[str, list[list[Row]]]], name: str, band: Callable[[np.ndarray], Any], **axes: Any
) -> None:
    """Draw a column of the points of each seed, by task and label, over steps and over seconds, at common times.

    ``band`` makes of values (seeds, times) their middle, and the least and the greatest of their band.
    """

    def curve(seeds: list[list[Row]], axis: str, unit: float) -> Curve:
        times, values = ([np.array(column(points, x)) for points in seeds] for x in (axis, name))
        grid = np.linspace(0.0, np.median([x[-1] for x in times]), 100)
        each = np.array([np.interp(grid, x, y, left=np.nan) for x, y in zip(times, values, strict=True)])
        grid, each = (x[..., np.isfinite(each).all(0)] for x in (grid, each))
        return grid / unit, *band(each)

    rows = [
        [{label: curve(seeds, axis, unit) for label, seeds in of.items()} for of in runs.values()]
        for axis, (_, unit) in AXES.items()
    ]
    titles = [LABELS.get(task, task) for task in runs]
    draw(path, rows, titles, [x for x, _ in AXES.values()], name.replace("_", " "), **axes)


def draw_trial(path: Path, results: Results) -> None:
    """Draw the methods of the trial: means over seeds, and bands from the least to the greatest."""
    flown = [(task, x) for task, x in product(TASKS, METHODS) if (task, x) in results.curves]
    runs: dict[str, dict[str, list[list[Row]]]] = {task: {} for task, _ in flown}
    for task, x in flown:
        runs[task][VARIANTS[x].label] = list(results.curves[task, x].values())
    draw_training(path, runs, "return", lambda x: (x.mean(0), x.min(0), x.max(0)), xscale="log")


def draw_shipped(path: Path, points: Sequence[Row]) -> None:
    """Draw the return of each method: interquartile means over the seeds, and their intervals."""
    runs = {
        task: {flights.METHODS[x]: list(grouped(own, "seed").values()) for x, own in of.items()}
        for task, of in tables.in_order(points).items()
    }

    def band(values: np.ndarray) -> Any:
        means = interquartile_mean(values.T)
        few = len(values) < ENOUGH
        return means, *((means, means) if few else np.transpose([interval(x) for x in values.T]))

    draw_training(path, runs, "return", band)


def draw_forest(path: Path, rows: Sequence[Row]) -> None:
    """Draw the success of each policy over the commanded speed: the mean over seeds, a panel for each density."""

    def curve(own: Sequence[Row]) -> Curve:
        of_speed = sorted(grouped(own, "speed").items(), key=lambda x: float(x[0][0]))
        x = np.array([float(speed) for (speed,), _ in of_speed])
        solved = [100 * np.array(column(runs, "solved")) for _, runs in of_speed]
        return x, *(np.array([f(y) for y in solved]) for f in (np.mean, np.min, np.max))

    flown = grouped(rows, "difficulty", "policy")
    names = [name for name in flights.DIFFICULTIES if any(name == key[0] for key in flown)]
    panels = [{x: curve(flown[name, x]) for x in flights.POLICIES if (name, x) in flown} for name in names]
    draw(path, [panels], names, ["commanded speed [m/s]"], "success [%]", ylim=(0, 100))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the results")
    data = parser.parse_args().data
    made = tables.make(data)
    if ships(data):
        for name, table in made.items():
            write_rows(DATA.parent / f"tables/{name}.csv", table)
        for page in pages():
            write(page, filled(page.read_text(), made))
    else:
        write(data / "results.md", "".join(f"# {x}\n\n{tables.markdown(table)}\n\n" for x, table in made.items()))
    figures = (DATA.parent if ships(data) else data) / "figures"
    draw_trial(figures / "main.png", Results(data))
    draw_shipped(figures / "shipped.png", read_rows(data / "shipped_curves.csv"))
    draw_forest(figures / "forest.png", read_rows(data / "forest.csv"))


if __name__ == "__main__":
    main()
