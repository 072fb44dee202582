"""Tables of the results, each a list of rows: CSV files in full, and those of the pages in Markdown.

Interquartile means, percentile intervals and probabilities of improvement are those of Agarwal et al. 2021. The
bootstrap draws seeds and a set of starts (evidence.py); of tasks not flown from many sets, only seeds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import trim_mean

from benchmarks.paper import elsewhere, flights
from benchmarks.paper.claims import METHODS, Verdict, try_all
from benchmarks.paper.evidence import (
    NotRunError,
    Results,
    Row,
    Starts,
    bootstrap,
    column,
    grouped,
    judged,
    probability,
    until,
)
from benchmarks.paper.matrix import EXPERIMENTS, TASKS, VARIANTS
from torchrl_quad.envs import task_class
from torchrl_quad.envs.metrics import EPISODE_METRICS
from torchrl_quad.files import read_rows

Table = list[dict[str, str]]
RELIABLE = 0.99  # of the episodes, solved by the worst seed
ENOUGH, WANTED = 3, 10  # seeds: for an interval, and of each method
LABELS = {"racing_position": "racing, position", "six_gates": "six gates", "six_gates_back": "six gates, backwards"}
LABELS |= {"point_mass": "hovering, a point mass", "memory": "tracking with a memory"}
LABELS |= {x: f"hovering by {x.replace('_', ' ')}" for x in ("attitude", "rotor_thrusts", "velocity")}


def make(data: Path) -> dict[str, Table]:
    results, starts, runs = Results(data), Starts(data), read_rows(data / "shipped.csv")
    made = reached_tables(runs, starts) | {
        "summary": summary_table(runs),
        "choice": choice_table(runs, starts, read_rows(data / "shipped_curves.csv")),
        "improvement": improvement_table(runs),
        "speed": speed_table([*runs, *read_rows(data / "rates.csv")]),
        "ablations": ablations_table(data),
        "rates": rates_table(data),
        "forest": forest_table(data),
        "elsewhere": elsewhere_table(data),
        "tracks": reached_tables(read_rows(data / "tracks.csv"), starts)["reached"],
        "one_setting": one_setting_table(data, starts),
    }
    if results.all_finals or results.curves:
        own, published = try_all(data)
        made |= {
            "claims": claims_table(own, published),
            "parts": [*parts_table("the recipes'", own), *parts_table("as published", published)],
            "methods": methods_table(results),
            "ends": [row for name in EXPERIMENTS for row in ends_table(results, name)],
            "ascent": ascent_table(data),
        }
    return {name: table for name, table in made.items() if table}


def markdown(table: Table) -> str:
    head = list(dict.fromkeys(name for row in table for name in row))
    lines = [head, ["---" for _ in head], *([row.get(name, "") for name in head] for row in table)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def spread(values: Iterable[float]) -> str:
    values = [x for x in values if np.isfinite(x)]
    return f"{np.mean(values):.4g} ({min(values):.4g} to {max(values):.4g})" if values else ""


def seeds(count: int) -> str:
    return f"{count} seed{'s' * (count > 1)}"


def claims_table(own: list[Verdict], published: list[Verdict]) -> Table:
    """Show the verdict on each claim, for the methods of the recipes and as published, and the part that decides it."""
    again, rows = {v.claim.id: v.verdict for v in published}, []
    for v in own:
        row = {"": v.claim.id, "the paper's claim": v.claim.text, "verdict": v.verdict}
        deciding = [part for part in parts_table("", [v]) if v.verdict.startswith(part["verdict"])]
        decided = "{what}: {value} ({must be})".format(**deciding[0]) if deciding else ""
        rows.append(row | {"as published": again.get(v.claim.id, ""), "decided by (bound)": decided})
    return rows


def parts_table(methods: str, verdicts: list[Verdict]) -> Table:
    """Show the parts of each claim, with the 95 % interval of each."""
    rows = []
    for v in verdicts:
        for part in v.parts:
            low, high = part.interval()
            bounds = [f"{sign} {x:g}" for sign, x in ((">", part.low), ("<", part.high)) if math.isfinite(x)]
            row = {"claim": v.claim.id, "methods": methods, "what": part.what, "value": f"{part.value:.3g}"}
            row |= {"low": f"{low:.3g}", "high": f"{high:.3g}", "must be": " and ".join(bounds)}
            rows.append(row | {"verdict": part.verdict(len(v.parts)), "seeds": str(v.seeds), "dynamics": v.dynamics})
    return rows


def end_cell(results: Results, task: str, variant: str) -> str:
    """Write the means of the ends: return and solved episodes, and in racing the gates passed."""
    try:
        reached, solved = (results.end(task, variant, name).mean() for name in ("return", "solved"))
        gates = f", {results.end(task, variant, 'gates_passed').mean():.1f} gates" if task == "racing" else ""
    except NotRunError:
        return "not run"
    return f"{reached:.1f}, {100 * solved:.0f} %{gates}"


def methods_table(results: Results) -> Table:
    """Show the means of the ends, a row for each task and a column for each method."""
    of = {task: (task, "") for task in TASKS} | {"racing, velocity reward": ("racing", "-velocity")}
    return [
        {"": name} | {VARIANTS[x].label: end_cell(results, task, x + suffix) for x in METHODS}
        for name, (task, suffix) in of.items()
    ]


def ends_table(results: Results, experiment: str) -> Table:
    """Show where the curves of an experiment end, means over seeds, and when they converge, medians."""
    rows = []
    for task, variant in product(TASKS, EXPERIMENTS[experiment]):
        row = {"experiment": experiment, "task": task, "method": VARIANTS[variant].label}
        try:
            row["seeds"] = str(len(results.end(task, variant)))
            for name in ("return", "solved", "gates_passed", "position_error"):
                row[name] = spread(results.end(task, variant, name))
            if experiment not in ("reward", "relaxation"):  # whose returns are of another kind
                level = results.level(task, max((results.end(task, x) for x in METHODS), key=np.mean))
                for axis in ("steps", "seconds"):
                    reached = np.median(results.until(task, variant, axis, level))
                    row[f"{axis} to converge"] = f"{reached:.4g}" if np.isfinite(reached) else "never"
        except NotRunError:
            continue
        rows.append(row)
    return rows


def ascent_table(data: Path) -> Table:
    """Compare the gradients at the last policies with the measured ones: mean cosines over seeds."""
    names = ("n_step_return", "zero_step_return", "objective", "halves", "explained_variance")
    runs = grouped(read_rows(data / "ascent.csv"), "task", "variant")
    return [
        {"task": task, "method": VARIANTS[variant].label, "seeds": str(len(runs[task, variant]))}
        | {name: spread(column(runs[task, variant], name)) for name in names}
        for task, variant in sorted(runs, key=lambda run: (TASKS.index(run[0]), list(VARIANTS).index(run[1])))
    ]


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


def returns_of(rows: Sequence[Row], starts: Starts) -> np.ndarray:
    return judged(np.array(column(rows, "return")), starts.shift(rows[0]["task"], rows[0]["algorithm"], "return"))


def in_order(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    groups, tasks = grouped(rows, "task", "algorithm"), dict.fromkeys(row["task"] for row in rows)
    return {
        task: {x: groups[task, x] for x in flights.METHODS if (task, x) in groups}
        for task in sorted(tasks, key=[*flights.TASKS, *tasks].index)
    }


def metric_of(task: str) -> tuple[str, float, int, str]:
    """What is shown of a task with its solved episodes: of a task of your own the first metric that its class names."""
    if task in flights.TASKS:
        return flights.TASKS[task]
    name = flights.VARIANTS.get(task, [f"task={task}"])[0].removeprefix("task=")
    own = [x for x in task_class(name).metric_info.items() if x[0] not in EPISODE_METRICS]
    name, metric = own[0] if own else ("return", EPISODE_METRICS["return"])
    return name, metric.scale, 2, metric.unit or metric.label


def summary_table(rows: Sequence[Row]) -> Table:
    """Show what each method reaches on each task: solved episodes, their least, and the medians of the rest."""
    flown = in_order(rows)

    def cell(task: str, runs: list[Row]) -> str:
        metric, factor, digits, unit = metric_of(task)
        solved = column(runs, "solved")
        shown, seconds = (np.nanmedian([float(run.get(x) or "nan") for run in runs]) for x in (metric, "seconds"))
        few = "" if len(runs) == WANTED else f", {seeds(len(runs))}"
        return f"{np.mean(solved):.1%} ({min(solved):.1%}), {factor * shown:.{digits}f} {unit}, {seconds:.0f} s{few}"

    return [
        {"": label} | {LABELS.get(t, t): cell(t, of[method]) if method in of else "" for t, of in flown.items()}
        for method, label in flights.METHODS.items()
        if any(method in of for of in flown.values())
    ]


def reached_tables(rows: Sequence[Row], starts: Starts) -> dict[str, Table]:
    """Show what every method reaches on every task, and what it takes: in short, and in full."""
    full, short = [], {method: {"": label} for method, label in flights.METHODS.items()}
    for task, of in in_order(rows).items():
        name, factor, digits, unit = metric_of(task)
        for method, own in of.items():
            returns, solved, metric = returns_of(own, starts), *(column(own, x) for x in ("solved", name))
            mean = f"{interquartile_mean(returns):.4g}"
            if len(returns) >= ENOUGH:
                mean += " [{:.4g}, {:.4g}]".format(*interval(returns))
            row = {"task": LABELS.get(task, task), "method": flights.METHODS[method], "seeds": str(len(own))}
            row |= {"return": mean, "solved (worst seed)": f"{np.mean(solved):.1%} ({min(solved):.1%})"}
            row["metric"] = f"{factor * np.median(metric):.{digits}f} {unit}" if metric else ""
            row |= {name: f"{np.median(column(own, name)):.4g}" for name in ("steps", "seconds")}
            full.append(row)
            short[method][row["task"]] = f"{mean}, {min(solved):.1%}"
    return {"reached": [row for row in short.values() if len(row) > 1], "reached_in_full": full}


def one_setting_table(data: Path, starts: Starts) -> Table:
    """Show what train.py reaches on tasks and variants of tasks for which nothing was set."""
    rows = reached_tables(read_rows(data / "one_setting.csv"), starts)["reached_in_full"]
    return [{name: x for name, x in row.items() if name != "method"} for row in rows]


def choice_table(rows: Sequence[Row], starts: Starts, curves: Sequence[Row] = ()) -> Table:
    """Show for each task the quickest method that works with every seed, and the one of the highest return; and when
    evaluations of one setting first reach 98 % of the highest return of a tuned method, the median over seeds."""
    lines, untuned = [], grouped([x for x in curves if x["algorithm"] == "train"], "task", "seed")
    for task, flown in in_order(rows).items():
        worst = {x: min(column(own, "solved")) for x, own in flown.items()}
        returns = {x: interquartile_mean(column(own, "return")) for x, own in flown.items()}
        seconds_of = {x: np.median(column(own, "seconds")) for x, own in flown.items()}
        most_seeds = max(map(len, flown.values()))
        tried = [x for x, own in flown.items() if len(own) == most_seeds]
        quick = min((x for x in tried if worst[x] >= RELIABLE), key=seconds_of.get, default=None)
        most = max(tried, key=returns.get)
        reached = {x: returns_of(flown[x], starts) for x in tried if most_seeds >= ENOUGH}
        level = [flights.METHODS[x] for x in reached if x != most and is_level(reached[x], reached[most])]

        few = f", {seeds(most_seeds)}" if most_seeds < WANTED else ""
        said = {x: f"{flights.METHODS[x]}: {returns[x]:.4g}, {worst[x]:.1%}, {seconds_of[x]:.0f} s{few}" for x in tried}
        row = {"task": LABELS.get(task, task), "quickest that works with every seed": said.get(quick, "none")}
        row |= {"highest return": said[most], "level with it": ", ".join(level)}
        goal = max((returns[x] for x in tried if x != "train"), default=math.inf)
        came = [
            until(((float(x["seconds"]), float(x["return"] or "nan")) for x in own), goal - 0.02 * abs(goal))
            for (of, _), own in untuned.items()
            if of == task
        ]
        if came and goal < math.inf:
            when = f"{np.median(came):.0f} s, " if np.median(came) < math.inf else ""
            row["One setting at 98 % of the best tuned"] = f"{when}{np.isfinite(came).sum()} of {seeds(len(came))}"
        lines.append(row)
    return lines


def speed_table(rows: Sequence[Row]) -> Table:
    """Show how many thousand steps a second each method took on each machine: medians over the seeds."""
    lines, flown = [], {row["algorithm"] for row in rows}
    for task, of in in_order(rows).items():
        for (name,), own in sorted(grouped([row for runs in of.values() for row in runs], "machine").items()):
            row = {"task": LABELS.get(task, task), "machine": name}
            for method, label in ((x, label) for x, label in flights.METHODS.items() if x in flown):
                speeds = [float(x["steps"]) / float(x["seconds"]) / 1e3 for x in own if x["algorithm"] == method]
                row[label] = f"{np.median(speeds):.0f}" if speeds else ""
            lines.append(row)
    return lines


def improvement_table(rows: Sequence[Row]) -> Table:
    """Show how probable it is that the method of a row has a higher return than that of a column, over the tasks."""
    tasks = in_order(rows).values()
    flown = [{x: column(own, "return") for x, own in of.items() if len(own) >= ENOUGH} for of in tasks]
    enough = [x for x in flights.METHODS if any(x in of for of in flown)]

    def cell(ours: str, theirs: str) -> str:
        values = [probability(np.array(of[ours]), np.array(of[theirs])) for of in flown if {ours, theirs} <= set(of)]
        return f"{np.mean(values):.2f}, {len(values)}" if values and ours != theirs else ""

    return [{"": flights.METHODS[x]} | {flights.METHODS[y]: cell(x, y) for y in enough} for x in enough]


def ablations_table(data: Path) -> Table:
    """Show what each option adds to the return, and what the worst seed solves with it, and without it."""
    shipped = grouped(read_rows(data / "shipped.csv"), "task", "algorithm")
    changed = grouped(read_rows(data / "ablations.csv"), "task", "algorithm", "change")
    rows = []
    for task, option in product(flights.CHANGED_TASKS, flights.OPTIONS):
        row = {"task": LABELS.get(task, task), "option": option}
        for method, no in product(flights.CHANGED_METHODS, ("", "no ")):
            own = changed.get((task, method, no + option), [])
            ships = [x for x in shipped.get((task, method), []) if x["seed"] in {y["seed"] for y in own}]
            if ships:
                have, lack = (ships, own) if no else (own, ships)  # the option
                gain = np.mean(column(have, "return")) - np.mean(column(lack, "return"))
                solved, without = (min(column(x, "solved")) for x in (have, lack))
                row[flights.METHODS[method]] = f"{gain:+.1f}, {solved:.0%} ({without:.0%}), {len(own)}"
        rows += [row] if len(row) > 2 else []
    return rows


def rates_table(data: Path) -> Table:
    """Show the episodes that the worst of three seeds solves at half the rate, at the one that ships, and at twice."""
    lines = []
    for method, label in flights.METHODS.items():
        of = grouped([x for x in read_rows(data / "rates.csv") if x["algorithm"] == method], "task", "factor")
        row = {"": label}
        for task in (task for task in flights.TASKS if any(task == key[0] for key in of)):
            worst = [min(column(of[task, x], "solved")) if (task, x) in of else math.nan for x in flights.FACTORS]
            row[LABELS.get(task, task)] = "/".join("?" if math.isnan(x) else f"{100 * x:.0f}" for x in worst)
        lines += [row] if len(row) > 1 else []
    return lines


def forest_table(data: Path) -> Table:
    """Show the successes of each policy in the middle forest, mean and least, and what its training has cost."""
    rows, lines = read_rows(data / "forest.csv"), []
    speeds = sorted({float(row["speed"]) for row in rows})

    def cell(runs: list[Row]) -> str:
        solved = column(runs, "solved")
        return f"{np.mean(solved):.0%} ({min(solved):.0%}, {seeds(len(solved))})" if solved else ""

    for policy in (name for name in flights.POLICIES if any(row["policy"] == name for row in rows)):
        own = [row for row in rows if (row["policy"], row["difficulty"]) == (policy, "middle")]
        million, cost = (np.median(column(own, name)) if own else math.nan for name in ("steps", "seconds"))
        row = {"": policy, "million steps": f"{million / 1e6:.1f}", "processor seconds": f"{cost:.0f}"}
        lines.append(row | {f"{x:g} m/s": cell([r for r in own if float(r["speed"]) == x]) for x in speeds})
    return lines


def elsewhere_table(data: Path) -> Table:
    """Show the returns of the losses on other environments: the mean over seeds, and the worst."""
    of = grouped(read_rows(data / "elsewhere.csv"), "environment", "loss")
    lines = []
    for name in elsewhere.NAMES:
        row = {"loss": name}
        for environment in elsewhere.ENVIRONMENTS:
            if own := of.get((environment, name)):
                after = column(own, "after")
                row[environment] = f"{np.mean(after):.4g} ({min(after):.4g})"
        lines += [row] if len(row) > 1 else []
    return lines
