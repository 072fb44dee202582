"""The results of the runs as arrays over seeds, and the statistics that claims are tested with.

All runs are judged from the same starts, so seeds alone cannot tell what other starts would give. A draw of the
bootstrap takes one set of starts for all methods, and shifts each by as much as its policy returned more from that set
than from all of them (``reproduce starts``). A shift that two methods share does not change their difference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.paper.matrix import SEEDS, TASKS
from torchrl_quad.files import read_rows

Row = Mapping[str, str]
RESAMPLES = 4_000
STARTS = {"hovering": 64, "tracking": 64, "landing": 64, "racing": 128}  # of an evaluation along a curve
PPO_STARTS = 256  # of PPO's, which trains more drones
Shift = Callable[[np.random.Generator, np.ndarray], np.ndarray]  # from drawn sets (n) to what they add to a mean (n)
LEVEL = {"hovering": 0.98, "tracking": 0.98, "landing": 0.9, "racing": 0.9}


def column(rows: Sequence[Row], name: str) -> list[float]:
    """Read a column, as numbers; what was not measured is left out."""
    return [float(row[name]) for row in rows if row.get(name)]


def grouped(rows: Sequence[Row], *names: str) -> dict[tuple[str, ...], list[Row]]:
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def until(curve: Iterable[tuple[float, float]], level: float) -> float:
    """Find the steps, or seconds, at which a curve of them and returns first reaches a level, or infinity."""
    return next((t for t, x in curve if x >= level), math.inf)


class Judged(np.ndarray):
    """What the seeds of a method reach from one set of starts, and how far another set would shift their mean."""

    shift: Shift | None = None


def judged(values: np.ndarray, shift: Shift | None) -> np.ndarray:
    values = np.asarray(values, dtype=float).view(Judged)
    values.shift = shift
    return values


class Starts:
    """How far the mean of a method depends on the set of starts from which it is judged: the rows of starts.csv."""

    def __init__(self, data: Path) -> None:
        self.rows = read_rows(data / "starts.csv")

    def shift(self, task: str, algorithm: str, name: str, starts: int = 256) -> Shift | None:
        """How far each set of so many starts shifts a column, drawn from the policies flown; None if unknown."""
        rows = [row for row in self.rows if row["task"] == task and row.get(name)]
        rows = [row for row in rows if row["algorithm"] == algorithm] or rows  # if none is of the method, of any other
        runs = [column(x, name) for x in grouped(rows, "algorithm", "seed").values()]
        if not runs:
            return None
        off = np.array([np.array(x) - np.mean(x) for x in runs])  # (policies, sets)
        policies, count = off.shape
        off *= math.sqrt(count / (count - 1) * int(rows[0]["starts"]) / starts)
        return lambda rng, sets: off[rng.integers(policies, size=len(sets)), sets % count]


def shares(values: np.ndarray, starts: int) -> Shift:
    """How far another set of starts shifts a share of solved episodes: as much as independent episodes would."""
    share = np.clip(np.mean(values), 0.0, 1.0)
    return lambda rng, sets: math.sqrt(share * (1.0 - share) / starts) * rng.standard_normal(len(sets))


class NotRunError(Exception):
    """A claim needs a run that is missing."""


@dataclass(frozen=True)
class Part:
    """A number that must lie above ``low`` and below ``high``, with its bootstrap in ascending order."""

    what: str
    value: float
    draws: np.ndarray = field(repr=False)
    low: float = -math.inf
    high: float = math.inf

    def interval(self, parts: int = 1) -> tuple[float, float]:
        """Give the middle 95 % of the bootstrap, or more when this is one of several parts."""
        cut = int(0.025 / parts * len(self.draws))
        return float(self.draws[cut]), float(self.draws[len(self.draws) - 1 - cut])

    def verdict(self, parts: int = 1) -> str:
        """Decide: supported, refuted or undecided, as one of several parts."""
        least, most = self.interval()
        if self.low < least and most < self.high:
            return "supported"
        least, most = self.interval(parts)  # wider: of many parts one looks refuted by chance
        return "refuted" if most < self.low or least > self.high else "undecided"


def best_learning_rate(task: str, variant: str, data: Path, rates: tuple[float, ...]) -> float | None:
    """Find the rate whose run in the search ended highest; None while the search is not complete."""
    ends = {}
    for lr in rates:
        rows = [x for x in read_rows(data / f"search/{task}.csv") if x["variant"] == variant and x["lr"] == f"{lr:g}"]
        if not rows:
            return None
        ends[lr] = np.mean([float(row["return"]) for row in rows[-max(len(rows) // 10, 1) :]])
    return max(ends, key=lambda lr: -math.inf if math.isnan(ends[lr]) else ends[lr])


class Results:
    """The CSV files by task and variant, as arrays over seeds; ``alias`` names variants to read instead of others."""

    def __init__(self, data: Path, alias: dict[tuple[str, str], str] | None = None) -> None:
        self.data, self.alias = data, alias or {}
        self.curves = {
            (task, variant): {int(seed): points for (seed,), points in grouped(own, "seed").items()}
            for task in TASKS
            for (variant,), own in grouped(read_rows(data / f"curves/{task}.csv"), "variant").items()
        }
        self.all_finals = read_rows(data / "final.csv")
        self.finals = [row for row in self.all_finals if not row["lr"]]
        self.starts = Starts(data)
        self.used: set[tuple[str, str]] = set()  # by the claim on trial

    def column(self, task: str, variant: str, name: str) -> list[np.ndarray]:
        """Read a column of the curves: an array for each seed."""
        key = task, self.alias.get((task, variant), variant)
        if key not in self.curves:
            raise NotRunError(f"{key[1]} on {task}")
        self.used.add(key)
        seeds = self.curves[key]
        return [np.array([float(x.get(name) or "nan") for x in seeds[seed]]) for seed in SEEDS if seed in seeds]

    def end(self, task: str, variant: str, name: str = "return") -> np.ndarray:
        """Read the ends of the curves (seeds)."""
        curves = self.column(task, variant, name)
        began = min((x[0] for x in curves if np.isfinite(x[0])), default=math.nan)
        ends = np.array([x[-max(len(x) // 10, 1) :].mean() if np.isfinite(x[-1]) else began for x in curves])
        method, starts = variant.split("-")[0], PPO_STARTS if variant.startswith("ppo") else STARTS[task]
        if name == "solved":
            return judged(ends, shares(ends, starts))
        reward = "_position" if task == "racing" and not variant.endswith("-velocity") else ""
        shift = self.starts.shift(task + reward, method, name, starts)
        if shift is not None and method == "ppo":  # more drones, and so a set of its own
            return judged(ends, lambda rng, sets: shift(rng, rng.permutation(sets)))
        return judged(ends, shift)

    def final(self, task: str, variant: str, name: str) -> np.ndarray:
        """Read what the best policies reached in the final evaluation, for the seeds that have one."""
        key = task, self.alias.get((task, variant), variant)
        rows = {int(x["seed"]): x for x in self.finals if (x["task"], x["variant"]) == key}
        values = np.array([float(rows[seed].get(name) or "nan") for seed in SEEDS if seed in rows])
        if not np.isfinite(values).any():
            raise NotRunError(f"{key[1]} on {task}")
        self.used.add(key)
        return values[np.isfinite(values)]

    def until(self, task: str, variant: str, axis: str, level: float) -> np.ndarray:
        """Count steps, or seconds at the pace of the quickest seed, until the curve reaches a level; or infinity."""
        returns, steps, seconds = (self.column(task, variant, name) for name in ("return", "steps", "seconds"))
        pace = min((s[-1] / n[-1] for s, n in zip(seconds, steps, strict=True) if n[-1]), default=math.nan)
        first = [until(zip(*curve, strict=True), level) for curve in zip(steps, returns, strict=True)]
        return np.array(first) * (pace if axis == "seconds" else 1.0)

    def level(self, task: str, *ends: np.ndarray) -> float:
        """Give the return at which a method counts as converged: nearly the lowest of the mean ends."""
        lowest = min(x.mean() for x in ends)
        return lowest - (1.0 - LEVEL[task]) * abs(lowest)

    def seeds(self, runs: Iterable[tuple[str, str]]) -> int:
        return min((len(self.curves.get(run, {})) for run in runs), default=0)

    def dynamics(self, runs: Iterable[tuple[str, str]]) -> str:
        runs = set(runs)
        found = {row.get("dynamics") or "" for row in self.finals if (row["task"], row["variant"]) in runs}
        return "both" if len(found) > 1 else "".join(found)


def bootstrap(
    what: str, statistic: Callable[..., np.ndarray], *samples: np.ndarray, low=-math.inf, high=math.inf
) -> Part:
    """Compute a statistic, from samples (*, seeds) to numbers (*), and its bootstrap, which draws each sample apart."""
    rng = np.random.default_rng(0)
    drawn = [rng.choice(np.asarray(x), (RESAMPLES, len(x))) for x in samples]
    sets = rng.integers(0, 2**32, RESAMPLES)
    for x, values in zip(samples, drawn, strict=True):
        if getattr(x, "shift", None) is not None:
            values += x.shift(rng, sets)[:, None]
    with np.errstate(all="ignore"):
        draws = statistic(*drawn)
        return Part(what, float(statistic(*map(np.asarray, samples))), np.sort(draws), low, high)


def mean(x: np.ndarray) -> np.ndarray:
    return x.mean(-1)


def probability(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """P(a > b), ties counted half."""
    a, b = a[..., :, None], b[..., None, :]
    return ((a > b).mean((-2, -1)) + (a >= b).mean((-2, -1))) / 2


def gap(a: np.ndarray, *b: np.ndarray) -> np.ndarray:
    """Compare the mean of a with that of the best b: their difference, in units of the greater one."""
    one, other = mean(a), np.max([mean(x) for x in b], 0)
    return (one - other) / np.maximum(np.maximum(np.abs(one), np.abs(other)), 1e-12)


def beats(what: str, a: np.ndarray, b: np.ndarray) -> Part:
    return bootstrap(f"P({what})", probability, a, b, low=0.5)


def deviation(x: np.ndarray) -> np.ndarray:
    return np.abs(x - x.mean())


def roughness(curve: np.ndarray) -> float:
    """Sum all that a curve loses between evaluations, in units of its range; infinite where it diverged."""
    if not np.isfinite(curve).all():
        return math.inf
    return float(np.maximum(-np.diff(curve), 0).sum() / max(np.ptp(curve), 1e-12))
