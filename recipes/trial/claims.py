"""The paper's claims as statistics over the results, each with its threshold and its rule, fixed before the first run.

A claim is one part or several, and every part is a number with a bootstrap over seeds. A part is supported when its
95 % interval lies on the right side of the threshold. It is refuted when an interval that is wider, by the number m of
parts (quantiles 0.025 / m and 1 - 0.025 / m), lies on the wrong side: of many parts one will look refuted by chance.
A claim is supported when all its parts are, refuted when one of them is, and undecided otherwise. With fewer than five
seeds of any run that it needs it is preliminary, with fewer than three it has no verdict.

Three statistics carry most of it:

- P(a > b): how often a seed of a beats a seed of b, ties counted half; against 0.5.
- gap(a, b): (mean a - mean b) / max(|mean a|, |mean b|); against a share. In hovering and tracking most of the return
  is paid for being in the air, and 2 % of it are about 20 cm: two methods are equal there when they are within 2 %.
- the end of a curve: the mean of its last tenth of evaluations. Two methods are compared in speed by when they first
  reach a level: 98 % of the lower one of their two ends in hovering and tracking, 90 % in landing and racing. Seconds
  are steps at the pace of the quickest seed, since the machine was not always idle. A run that diverged ends where it
  began.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from matrix import EXPERIMENTS, SEEDS, TASKS
from matrix import METHODS as METHOD_VARIANTS
from reproduce import read

RESAMPLES = 4_000
METHODS = tuple(METHOD_VARIANTS)
FIRST_ORDER = ("abpt", "shac", "bptt")
PUBLISHED = {  # the same methods as published with the paper, by task and method
    **{(task, "bptt"): "bptt-episode" for task in TASKS},
    **{(task, "shac"): "shac-cut" for task in TASKS},
    **{(task, "abpt"): "abpt-entropy" for task in ("landing", "racing")},  # added when the runs were there
}
LEVEL = {"hovering": 0.98, "tracking": 0.98, "landing": 0.9, "racing": 0.9}
LEAST_SEEDS = 3  # for a verdict
EQUAL = 0.02  # share of the return within which two methods are equal in hovering and tracking


class NotRunError(Exception):
    """A claim needs a run that is not there."""


@dataclass(frozen=True)
class Part:
    """A number that has to lie above ``low`` and below ``high``, and what a bootstrap gives for it, in order."""

    what: str
    value: float
    draws: np.ndarray = field(repr=False)
    low: float = -math.inf
    high: float = math.inf

    def interval(self, parts: int = 1) -> tuple[float, float]:
        """The middle 95 % of the bootstrap, or more for one of several parts."""
        cut = int(0.025 / parts * len(self.draws))
        return float(self.draws[cut]), float(self.draws[len(self.draws) - 1 - cut])

    def verdict(self, parts: int = 1) -> str:
        """Supported, refuted or undecided, as one of several parts."""
        least, most = self.interval()
        if self.low < least and most < self.high:
            return "supported"
        least, most = self.interval(parts)
        return "refuted" if most < self.low or least > self.high else "undecided"


@dataclass(frozen=True)
class Claim:
    """What the paper says, and the parts that put it on trial."""

    id: str
    text: str
    parts: Callable[[Results], Iterable[Part]]


@dataclass(frozen=True)
class Verdict:
    """What became of a claim."""

    claim: Claim
    verdict: str
    parts: list[Part]
    seeds: int


class Results:
    """What stands in the CSV files, by task and variant, in arrays over seeds.

    Args:
        data: the folder of the CSV files.
        alias: variants that are looked up in the place of others, such as ``PUBLISHED``.
    """

    def __init__(self, data: Path, alias: dict[tuple[str, str], str] | None = None) -> None:
        self.data, self.alias = data, alias or {}
        self.curves: dict[tuple[str, str], dict[int, list[dict[str, str]]]] = {}
        for task in TASKS:
            for row in read(data / f"curves/{task}.csv"):
                self.curves.setdefault((task, row["variant"]), {}).setdefault(int(row["seed"]), []).append(row)
        self.finals = [row for row in read(data / "final.csv") if not row["lr"]]
        self.used: set[tuple[str, str]] = set()  # by the claim that is being tried

    def column(self, task: str, variant: str, name: str) -> list[np.ndarray]:
        """A column of the curves, an array for each seed."""
        key = task, self.alias.get((task, variant), variant)
        if key not in self.curves:
            raise NotRunError(f"{key[1]} on {task}")
        self.used.add(key)
        seeds = self.curves[key]
        return [np.array([float(x.get(name) or "nan") for x in seeds[seed]]) for seed in SEEDS if seed in seeds]

    def end(self, task: str, variant: str, name: str = "return") -> np.ndarray:
        """The ends of the curves."""
        curves = self.column(task, variant, name)
        began = min((x[0] for x in curves if np.isfinite(x[0])), default=math.nan)
        return np.array([x[-max(len(x) // 10, 1) :].mean() if np.isfinite(x[-1]) else began for x in curves])

    def final(self, task: str, variant: str, name: str) -> np.ndarray:
        """What the best policies reached in the final evaluation, of the seeds that have one."""
        key = task, self.alias.get((task, variant), variant)
        rows = {int(x["seed"]): x for x in self.finals if (x["task"], x["variant"]) == key}
        values = np.array([float(rows[seed].get(name) or "nan") for seed in SEEDS if seed in rows])
        if not np.isfinite(values).any():
            raise NotRunError(f"{key[1]} on {task}")
        self.used.add(key)
        return values[np.isfinite(values)]

    def until(self, task: str, variant: str, axis: str, level: float) -> np.ndarray:
        """Steps, or seconds at the pace of the quickest seed, until the curve reaches a level; infinity if never."""
        returns, steps, seconds = (self.column(task, variant, name) for name in ("return", "steps", "seconds"))
        pace = min((s[-1] / n[-1] for s, n in zip(seconds, steps, strict=True) if n[-1]), default=math.nan)
        first = [
            next((t for t, x in zip(*c, strict=True) if x >= level), np.inf) for c in zip(steps, returns, strict=True)
        ]
        return np.array(first) * (pace if axis == "seconds" else 1.0)

    def level(self, task: str, *ends: np.ndarray) -> float:
        """What a method has to reach to have converged: nearly the lowest of the mean ends."""
        lowest = min(x.mean() for x in ends)
        return lowest - (1.0 - LEVEL[task]) * abs(lowest)

    def seeds(self, runs: Iterable[tuple[str, str]]) -> int:
        """The least number of seeds of these runs; 0 where there are none."""
        return min((len(self.curves.get(run, {})) for run in runs), default=0)


# -- statistics --------------------------------------------------------------------------------------------------------


def bootstrap(
    what: str, statistic: Callable[..., np.ndarray], *samples: np.ndarray, low=-math.inf, high=math.inf
) -> Part:
    """A statistic of samples over seeds and its bootstrap; each sample is drawn anew by itself.

    The statistic takes samples (*, seeds), and gives numbers (*).
    """
    rng = np.random.default_rng(0)
    with np.errstate(all="ignore"):
        draws = statistic(*(rng.choice(x, (RESAMPLES, len(x))) for x in samples))
        return Part(what, float(statistic(*samples)), np.sort(draws), low, high)


def mean(x: np.ndarray) -> np.ndarray:
    """Over seeds."""
    return x.mean(-1)


def probability(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """P(a > b), ties counted half."""
    a, b = a[..., :, None], b[..., None, :]
    return ((a > b).mean((-2, -1)) + (a >= b).mean((-2, -1))) / 2


def gap(a: np.ndarray, *b: np.ndarray) -> np.ndarray:
    """The difference of the means of a and the best b, in units of the greater one."""
    one, other = mean(a), np.max([mean(x) for x in b], 0)
    return (one - other) / np.maximum(np.maximum(np.abs(one), np.abs(other)), 1e-12)


def beats(what: str, a: np.ndarray, b: np.ndarray) -> Part:
    """The part that a is higher than b."""
    return bootstrap(f"P({what})", probability, a, b, low=0.5)


def deviation(x: np.ndarray) -> np.ndarray:
    """How far each seed is from the mean of all."""
    return np.abs(x - x.mean())


def roughness(curve: np.ndarray) -> float:
    """All that a curve has lost between evaluations, in units of its range; infinite where it diverged."""
    if not np.isfinite(curve).all():
        return math.inf
    return float(np.maximum(-np.diff(curve), 0).sum() / max(np.ptp(curve), 1e-12))


# -- claims ------------------------------------------------------------------------------------------------------------


def higher_end(
    r: Results, tasks: Iterable[str], best: str, others: Iterable[str], name: str = "return"
) -> Iterable[Part]:
    """``best`` ends higher than each of the others on every task."""
    for task in tasks:
        for other in others:
            yield beats(f"{name} of {best} > {other}, {task}", r.end(task, best, name), r.end(task, other, name))


def sooner(
    r: Results, tasks: Iterable[str], pairs: Iterable[tuple[str, str]], axes=("steps", "seconds")
) -> Iterable[Part]:
    """The first of each pair reaches what both reach before the second on every task."""
    for task in tasks:
        for pair in pairs:
            level = r.level(task, *(r.end(task, x) for x in pair))
            for axis in axes:
                one, other = (r.until(task, x, axis, level) for x in pair)
                yield beats(f"{axis} of {pair[0]} < {pair[1]}, {task}", -one, -other)


def others(of: str) -> list[str]:
    """The other methods."""
    return [method for method in METHODS if method != of]


def c1(r: Results) -> Iterable[Part]:
    """Highest, but for ties where the paper itself has them (C8)."""
    for task in ("hovering", "tracking"):
        for other in others("abpt"):
            yield bootstrap(f"gap(abpt, {other}), {task}", gap, r.end(task, "abpt"), r.end(task, other), low=-EQUAL)
    yield from higher_end(r, ["landing", "racing"], "abpt", others("abpt"))


def c3(r: Results) -> Iterable[Part]:
    """About as fast is at most twice the steps to what both reach."""
    level = r.level("racing", *(r.end("racing", x) for x in ("abpt", "ppo")))
    abpt, ppo = (r.until("racing", x, "steps", level) for x in ("abpt", "ppo"))
    yield beats("steps of abpt < twice those of ppo, racing", -abpt, -2.0 * ppo)
    yield from higher_end(r, ["racing"], "abpt", ["ppo"])


def c4(r: Results) -> Iterable[Part]:
    """The gain is the gap to the better one of SHAC and BPTT, and there has to be one."""

    def contrast(*ends: np.ndarray) -> np.ndarray:
        gains = [gap(*ends[i : i + 3]) for i in (0, 3, 6, 9)]
        return (gains[2] + gains[3] - gains[0] - gains[1]) / 2

    ends = [r.end(task, method) for task in ("hovering", "tracking", "landing", "racing") for method in FIRST_ORDER]
    yield bootstrap("mean gain in landing and racing, less that in hovering and tracking", contrast, *ends, low=0.0)
    yield from higher_end(r, ["landing", "racing"], "abpt", ["shac", "bptt"])


def c7(r: Results) -> Iterable[Part]:
    """Each lost stretch of a curve counts."""
    for task in ("landing", "racing"):
        rough = {m: np.array([roughness(x) for x in r.column(task, m, "return")]) for m in METHODS}
        pooled = np.concatenate([rough[m] for m in FIRST_ORDER])
        yield beats(f"roughness of ppo < first-order methods, {task}", -rough["ppo"], -pooled)


def c8(r: Results) -> Iterable[Part]:
    """Equal is a gap that is small on both sides."""
    for task in ("hovering", "tracking"):
        for a, b in (("abpt", "shac"), ("abpt", "bptt"), ("shac", "bptt")):
            what = f"gap({a}, {b}), {task}"
            yield bootstrap(what, gap, r.end(task, a), r.end(task, b), low=-EQUAL, high=EQUAL)


def c9(r: Results) -> Iterable[Part]:
    """It works when more than half of the episodes succeed."""
    yield bootstrap("success of bptt, landing", mean, r.end("landing", "bptt", "success"), low=0.5)


def c11(r: Results) -> Iterable[Part]:
    """Strongly: by more than a tenth of the mean, and more than every other method."""
    shac, *rest = (r.end("landing", method) for method in ("shac", *others("shac")))
    share = deviation(shac) / abs(shac.mean())
    yield bootstrap("mean deviation of a seed of shac / mean, landing", mean, share, low=0.1)
    for other, ends in zip(others("shac"), rest, strict=True):
        yield beats(f"deviation of a seed of shac > {other}, landing", deviation(shac), deviation(ends))


def c13(r: Results) -> Iterable[Part]:
    """Far below is by a quarter."""
    yield from higher_end(r, ["racing"], "shac", ["bptt"])
    for other in ("ppo", "abpt"):
        yield bootstrap(f"gap(shac, {other}), racing", gap, r.end("racing", "shac"), r.end("racing", other), high=-0.25)


def c16(r: Results) -> Iterable[Part]:
    """A lot is a quarter of all episodes, hardly a tenth of the return."""
    lost = [r.end("landing", variant, "success") for variant in ("abpt-no-n-step", "abpt")]
    what = "success without N-step return, less that of abpt, landing"
    yield bootstrap(what, lambda a, b: mean(a) - mean(b), *lost, high=-0.25)
    ends = [r.end("racing", variant) for variant in ("abpt-no-n-step", "abpt")]
    yield bootstrap("gap(without N-step return, abpt), racing", gap, *ends, low=-0.1, high=0.1)


def c17(r: Results) -> Iterable[Part]:
    """In each stretch between two evaluations, from the same number of starts."""
    for task in TASKS:
        runs = [r.column(task, variant, "start_cells") for variant in ("abpt", "abpt-no-visited")]
        cells = [np.array([x[np.isfinite(x)].mean() for x in run]) for run in runs]
        yield beats(f"cells in which horizons start, with > without buffer, {task}", *cells)


def c18(r: Results) -> Iterable[Part]:
    """Exact: a gradient is zero or is not."""
    rows = [x for x in read(r.data / "audit.csv") if x["reward"] in ("position", "velocity") and x["term"] == "gate"]
    norms = np.sort([float(x["gradient_norm"]) for x in rows if float(x["mean_return"])])
    if not len(norms):
        raise NotRunError("the audit of racing")
    yield Part("greatest gradient norm of the gate bonus where it was paid", norms[-1], norms, high=1e-12)


def c19(r: Results) -> Iterable[Part]:
    """Does not beat: is not better by more than a tenth. Close: is not worse by more than a quarter."""
    abpt = r.end("racing", "abpt", "gates_passed")
    relaxed = {x: r.end("racing", x, "gates_passed") for x in EXPERIMENTS["relaxation"][0]}
    for name, gates in relaxed.items():
        yield bootstrap(f"gap({name}, abpt) in gates", gap, gates, abpt, high=0.1)
    best = max((relaxed["bptt-reciprocal"], relaxed["shac-reciprocal"]), key=np.mean)
    yield bootstrap("gap(better reciprocal, abpt) in gates", gap, best, abpt, low=-0.25)
    yield beats("deviation of gates, better reciprocal > abpt", deviation(best), deviation(abpt))


def c20(r: Results) -> Iterable[Part]:
    """Lingering: more seconds within 1 m of the next gate for each gate passed, than the carrier and than ABPT."""

    def per_gate(variant: str) -> np.ndarray:
        near, gates = (r.final("racing", variant, name) for name in ("time_near_gate", "gates_passed"))
        return near / np.maximum(gates, 1.0)

    for variant in EXPERIMENTS["relaxation"][0]:
        for other in (variant.split("-")[0], "abpt"):
            yield beats(f"seconds near a gate for each passed, {variant} > {other}", per_gate(variant), per_gate(other))


def c21(r: Results) -> Iterable[Part]:
    """By gates, which both rewards share."""
    yield from higher_end(r, ["racing"], "abpt", others("abpt"), "gates_passed")
    yield from higher_end(r, ["racing"], "abpt-velocity", [f"{m}-velocity" for m in others("abpt")], "gates_passed")


def c22(r: Results) -> Iterable[Part]:
    """By gates."""
    for method in ("abpt", "shac"):
        yield from higher_end(r, ["racing"], f"{method}-velocity", [method], "gates_passed")


def c23(r: Results) -> Iterable[Part]:
    """It fails when fewer than a tenth of the episodes succeed: 8 gates in 512 steps and no crash."""
    yield bootstrap("success of bptt, racing, velocity", mean, r.end("racing", "bptt-velocity", "success"), high=0.1)


NOT_RACING = ("hovering", "tracking", "landing")
CLAIMS = (
    Claim("C1", "ABPT converges to the highest reward in all four tasks", c1),
    Claim("C2", "ABPT converges fastest in hovering, tracking and landing, in time-steps and in wall-time",
          partial(sooner, tasks=NOT_RACING, pairs=[("abpt", other) for other in others("abpt")])),
    Claim("C3", "In racing ABPT converges about as fast as PPO, and to a higher reward than PPO", c3),
    Claim("C4", "ABPT's gain is clearest where the reward is partially differentiable (landing, racing)", c4),
    Claim("C5", "PPO needs more time-steps than the first-order methods",
          partial(sooner, tasks=TASKS, pairs=[(m, "ppo") for m in FIRST_ORDER], axes=("steps",))),
    Claim("C6", "PPO ends lowest in hovering and tracking",
          lambda r: [p for m in FIRST_ORDER for p in higher_end(r, ["hovering", "tracking"], m, ["ppo"])]),
    Claim("C7", "PPO's curves are smooth: non-differentiable reward terms do not hurt it", c7),
    Claim("C8", "BPTT, SHAC and ABPT are about equal in hovering and tracking", c8),
    Claim("C9", "BPTT still works in landing", c9),
    Claim("C10", "BPTT is the worst of the four in racing",
          lambda r: [p for m in others("bptt") for p in higher_end(r, ["racing"], m, ["bptt"])]),
    Claim("C11", "SHAC fluctuates strongly between seeds in landing", c11),
    Claim("C12", "SHAC is worse than BPTT in landing",
          partial(higher_end, tasks=["landing"], best="bptt", others=["shac"])),
    Claim("C13", "In racing SHAC beats BPTT and stays far below PPO and ABPT", c13),
    Claim("C14", "Without the 0-step return, ABPT ends lower in landing and racing",
          partial(higher_end, tasks=["landing", "racing"], best="abpt", others=["abpt-no-0-step"])),
    Claim("C15", "Without visited-state initialisation, ABPT converges more slowly",
          partial(sooner, tasks=TASKS, pairs=[("abpt", "abpt-no-visited")], axes=("steps",))),
    Claim("C16", "Without the N-step return, landing suffers a lot and racing hardly", c16),
    Claim("C17", "Starting each horizon where the last one ended covers fewer states than the buffer does", c17),
    Claim("C18", "The gate bonus contributes no analytic gradient", c18),
    Claim("C19", "Relaxing the bonus does not beat ABPT; the reciprocal one is close on gates but varies more", c19),
    Claim("C20", "Relaxed bonuses make the drone linger near a gate", c20),
    Claim("C21", "ABPT is best under the position-based and under the velocity-based racing reward", c21),
    Claim("C22", "With the velocity-based reward ABPT and SHAC pass more gates than with the position-based one", c22),
    Claim("C23", "Under the velocity-based reward BPTT fails", c23),
)  # fmt: skip
AS_PUBLISHED = ("C1", "C2", "C3", "C4", "C5", "C8", "C9", "C10", "C11", "C12", "C13")  # those about methods that differ


def try_claim(claim: Claim, results: Results) -> Verdict:
    """The verdict over one claim, as far as its runs are there."""
    results.used.clear()
    try:
        parts = list(claim.parts(results))
    except NotRunError:
        return Verdict(claim, "not run", [], 0)
    each = {part.verdict(len(parts)) for part in parts}
    verdict = "refuted" if "refuted" in each else "undecided" if "undecided" in each else "supported"
    seeds = results.seeds(results.used)
    if 0 < seeds < LEAST_SEEDS:
        return Verdict(claim, "too few seeds", [], seeds)
    return Verdict(claim, f"{verdict} (preliminary)" if 0 < seeds < len(SEEDS) else verdict, parts, seeds)


def try_all(data: Path) -> tuple[list[Verdict], list[Verdict]]:
    """All claims; and those about BPTT, SHAC and ABPT once more, with the three as published with the paper."""
    own, published = Results(data), Results(data, PUBLISHED)
    again = [claim for claim in CLAIMS if claim.id in AS_PUBLISHED]
    return [try_claim(claim, own) for claim in CLAIMS], [try_claim(claim, published) for claim in again]
