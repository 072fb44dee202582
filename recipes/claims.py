"""The paper's claims as statistics over the results, each with its threshold and its rule, fixed before the first run.

A claim is one part or several, and every part is a number with a 95 % bootstrap interval over seeds. A part is
supported when its whole interval lies on the right side of the threshold, refuted when it lies on the wrong side, and
undecided when the threshold is inside. A claim is supported when all its parts are, refuted when one of them is, and
undecided otherwise. With fewer than five seeds of any run that it needs it is preliminary.

Three statistics carry most of it:

- P(a > b): how often a seed of a beats a seed of b, ties counted half; against 0.5.
- gap(a, b): (mean a - mean b) / max(|mean a|, |mean b|); against a share.
- the end of a curve: the mean of its last tenth of evaluations. A method has converged, in steps or in seconds, at its
  first evaluation that reaches 90 % of the highest mean end among ABPT, SHAC, BPTT and PPO on the task; infinity counts
  as later than any number. A run that diverged ends where it began.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matrix import EXPERIMENTS, SEEDS, TASKS
from reproduce import read

RESAMPLES = 4_000
METHODS = EXPERIMENTS["main"][0]
FIRST_ORDER = ("abpt", "shac", "bptt")
LEVEL = 0.9  # of the highest end, at which a method has converged


class NotRunError(Exception):
    """A claim needs a run that is not there."""


@dataclass(frozen=True)
class Part:
    """A number that has to lie above ``low`` and below ``high``, with its bootstrap interval."""

    what: str
    value: float
    interval: tuple[float, float]
    low: float = -math.inf
    high: float = math.inf

    @property
    def verdict(self) -> str:
        """Supported, refuted or undecided."""
        least, most = self.interval
        if self.low < least and most < self.high:
            return "supported"
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
    """What stands in the CSV files, by task and variant, in arrays over seeds."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self.curves: dict[tuple[str, str], dict[int, list[dict[str, str]]]] = {}
        for task in TASKS:
            for row in read(data / f"curves/{task}.csv"):
                self.curves.setdefault((task, row["variant"]), {}).setdefault(int(row["seed"]), []).append(row)
        self.finals = [row for row in read(data / "final.csv") if not row["lr"]]
        self.used: set[tuple[str, str]] = set()  # by the claim that is being tried

    def column(self, task: str, variant: str, name: str) -> list[np.ndarray]:
        """A column of the curves, an array for each seed."""
        if (task, variant) not in self.curves:
            raise NotRunError(f"{variant} on {task}")
        self.used.add((task, variant))
        seeds = self.curves[task, variant]
        return [np.array([float(x.get(name) or "nan") for x in seeds[seed]]) for seed in SEEDS if seed in seeds]

    def end(self, task: str, variant: str, name: str = "return") -> np.ndarray:
        """The ends of the curves."""
        ends = [
            x[-max(len(x) // 10, 1) :].mean() if np.isfinite(x[-1]) else x[0] for x in self.column(task, variant, name)
        ]
        return np.array(ends)

    def final(self, task: str, variant: str, name: str) -> np.ndarray:
        """What the best policies reached in the final evaluation."""
        rows = {int(x["seed"]): x for x in self.finals if (x["task"], x["variant"]) == (task, variant)}
        if not rows:
            raise NotRunError(f"{variant} on {task}")
        self.used.add((task, variant))
        return np.array([float(rows[seed].get(name) or "nan") for seed in SEEDS if seed in rows])

    def until(self, task: str, variant: str, axis: str, level: float | None = None) -> np.ndarray:
        """Steps or seconds until the curve reaches a level."""
        level = self.level(task) if level is None else level
        returns, times = self.column(task, variant, "return"), self.column(task, variant, axis)
        return np.array(
            [next((t for t, r in zip(*x, strict=True) if r >= level), np.inf) for x in zip(times, returns, strict=True)]
        )

    def level(self, task: str) -> float:
        """What a method has to reach to have converged."""
        return LEVEL * max(self.end(task, method).mean() for method in METHODS)

    def seeds(self, runs: Iterable[tuple[str, str]]) -> int:
        """The least number of seeds of these runs."""
        return min((len(self.curves.get(run, {})) for run in runs), default=len(SEEDS))


# -- statistics --------------------------------------------------------------------------------------------------------


def bootstrap(
    what: str, statistic: Callable[..., np.ndarray], *samples: np.ndarray, low=-math.inf, high=math.inf
) -> Part:
    """A statistic of samples over seeds with its 95 % percentile interval; each sample is drawn anew by itself.

    The statistic takes samples (*, seeds), and gives numbers (*).
    """
    rng = np.random.default_rng(0)
    with np.errstate(all="ignore"):
        values = np.sort(statistic(*(rng.choice(x, (RESAMPLES, len(x))) for x in samples)))
        interval = float(values[int(0.025 * RESAMPLES)]), float(values[int(0.975 * RESAMPLES) - 1])
        return Part(what, float(statistic(*samples)), interval, low, high)


def mean(x: np.ndarray) -> np.ndarray:
    """Over seeds."""
    return x.mean(-1)


def sd(x: np.ndarray) -> np.ndarray:
    """The standard deviation over seeds."""
    return x.std(-1)


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


def roughness(curve: np.ndarray) -> float:
    """All that a curve has lost between evaluations, in units of its range."""
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
    """The first of each pair converges before the second on every task."""
    for task in tasks:
        for one, other in pairs:
            for axis in axes:
                yield beats(
                    f"{axis} of {one} < {other}, {task}", -r.until(task, one, axis), -r.until(task, other, axis)
                )


def others(of: str) -> list[str]:
    """The other methods."""
    return [method for method in METHODS if method != of]


def c3(r: Results) -> Iterable[Part]:
    """About as fast is at most twice the steps to 90 % of what PPO reaches."""
    level = LEVEL * r.end("racing", "ppo").mean()
    times = [r.until("racing", method, "steps", level) for method in ("abpt", "ppo")]
    yield bootstrap(
        "log2 of steps, abpt / ppo, racing", lambda a, b: np.log2(np.median(a, -1) / np.median(b, -1)), *times, high=1.0
    )
    yield from higher_end(r, ["racing"], "abpt", ["ppo"])


def c4(r: Results) -> Iterable[Part]:
    """The gain is the gap to the better one of SHAC and BPTT."""

    def contrast(*ends: np.ndarray) -> np.ndarray:
        gains = [gap(*ends[i : i + 3]) for i in (0, 3, 6, 9)]
        return (gains[2] + gains[3] - gains[0] - gains[1]) / 2

    ends = [r.end(task, method) for task in ("hovering", "tracking", "landing", "racing") for method in FIRST_ORDER]
    yield bootstrap("mean gain in landing and racing, less that in hovering and tracking", contrast, *ends, low=0.0)


def c7(r: Results) -> Iterable[Part]:
    for task in ("landing", "racing"):
        rough = {m: np.array([roughness(x) for x in r.column(task, m, "return")]) for m in METHODS}
        pooled = np.concatenate([rough[m] for m in FIRST_ORDER])
        yield beats(f"roughness of ppo < first-order methods, {task}", -rough["ppo"], -pooled)


def c8(r: Results) -> Iterable[Part]:
    for task in ("hovering", "tracking"):
        for a, b in (("abpt", "shac"), ("abpt", "bptt"), ("shac", "bptt")):
            what = f"gap({a}, {b}), {task}"
            yield bootstrap(what, gap, r.end(task, a), r.end(task, b), low=-0.05, high=0.05)


def c9(r: Results) -> Iterable[Part]:
    yield bootstrap("success of bptt, landing", mean, r.end("landing", "bptt", "success"), low=0.5)


def c11(r: Results) -> Iterable[Part]:
    ends = [r.end("landing", method) for method in ("shac", *others("shac"))]
    yield bootstrap("sd / mean of shac over seeds, landing", lambda x: sd(x) / abs(mean(x)), ends[0], low=0.1)
    what = "sd of shac less the greatest other sd, landing"
    yield bootstrap(what, lambda x, *y: sd(x) - np.max([sd(z) for z in y], 0), *ends, low=0.0)


def c13(r: Results) -> Iterable[Part]:
    yield from higher_end(r, ["racing"], "shac", ["bptt"])
    for other in ("ppo", "abpt"):
        yield bootstrap(f"gap(shac, {other}), racing", gap, r.end("racing", "shac"), r.end("racing", other), high=-0.25)


def c16(r: Results) -> Iterable[Part]:
    for task, low, high in (("landing", -math.inf, -0.25), ("racing", -0.1, 0.1)):
        ends = r.end(task, "abpt-no-n-step"), r.end(task, "abpt")
        yield bootstrap(f"gap(without N-step return, abpt), {task}", gap, *ends, low=low, high=high)


def c17(r: Results) -> Iterable[Part]:
    """In each stretch between two evaluations, from the same number of starts."""
    for task in TASKS:
        runs = [r.column(task, variant, "start_cells") for variant in ("abpt", "abpt-no-visited")]
        cells = [np.array([x.mean() for x in run]) for run in runs]
        yield beats(f"cells in which horizons start, with > without buffer, {task}", *cells)


def c18(r: Results) -> Iterable[Part]:
    """Exact: a gradient is zero or is not."""
    rows = [x for x in read(r.data / "audit.csv") if x["reward"] in ("position", "velocity") and x["term"] == "gate"]
    rows = [x for x in rows if float(x["mean_return"])]
    if not rows:
        raise NotRunError("the audit of racing")
    norms = [float(row["gradient_norm"]) for row in rows]
    yield Part(
        "greatest gradient norm of the gate bonus where it was paid", max(norms), (min(norms), max(norms)), high=1e-12
    )


def c19(r: Results) -> Iterable[Part]:
    relaxed = EXPERIMENTS["relaxation"][0]
    yield from higher_end(r, ["racing"], "abpt", relaxed, "gates_passed")
    abpt = r.end("racing", "abpt", "gates_passed")
    best = max((r.end("racing", f"{m}-reciprocal", "gates_passed") for m in ("bptt", "shac")), key=np.mean)
    yield bootstrap("gap(better reciprocal, abpt) in gates", gap, best, abpt, low=-0.25)
    yield bootstrap("sd of gates, better reciprocal less abpt", lambda a, b: sd(a) - sd(b), best, abpt, low=0.0)


def c20(r: Results) -> Iterable[Part]:
    def per_gate(variant: str) -> np.ndarray:
        near, gates = (r.final("racing", variant, name) for name in ("time_near_gate", "gates_passed"))
        return near / np.maximum(gates, 1.0)

    for variant in EXPERIMENTS["relaxation"][0]:
        carrier = variant.split("-")[0]
        yield beats(
            f"seconds within 1 m of the next gate per gate, {variant} > {carrier}", per_gate(variant), per_gate(carrier)
        )


def c21(r: Results) -> Iterable[Part]:
    yield from higher_end(r, ["racing"], "abpt", others("abpt"), "gates_passed")
    yield from higher_end(r, ["racing"], "abpt-position", [f"{m}-position" for m in others("abpt")], "gates_passed")


def c22(r: Results) -> Iterable[Part]:
    for method in ("abpt", "shac"):
        yield from higher_end(r, ["racing"], method, [f"{method}-position"], "gates_passed")


def c23(r: Results) -> Iterable[Part]:
    yield bootstrap("success of bptt, racing", mean, r.end("racing", "bptt", "success"), high=0.1)


NOT_RACING = ("hovering", "tracking", "landing")
VS_ABPT = [("abpt", other) for other in others("abpt")]
CLAIMS = (
    Claim("C1", "ABPT converges to the highest reward in all four tasks",
          partial(higher_end, tasks=TASKS, best="abpt", others=others("abpt"))),
    Claim("C2", "ABPT converges fastest in hovering, tracking and landing, in time-steps and in wall-time",
          partial(sooner, tasks=NOT_RACING, pairs=VS_ABPT)),
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


def try_claim(claim: Claim, results: Results) -> Verdict:
    """The verdict over one claim, as far as its runs are there."""
    results.used.clear()
    try:
        parts = list(claim.parts(results))
    except NotRunError:
        return Verdict(claim, "not run", [], 0)
    each = {part.verdict for part in parts}
    verdict = "refuted" if "refuted" in each else "undecided" if "undecided" in each else "supported"
    seeds = results.seeds(results.used)
    return Verdict(claim, verdict if seeds >= len(SEEDS) else f"{verdict} (preliminary)", parts, seeds)
