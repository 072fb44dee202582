"""The paper's claims, and the page that is made of the results."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from test_reproduce import curve, run_main

from benchmarks import report
from benchmarks.paper import claims, evidence, matrix, results, running, tables
from benchmarks.paper.claims import Claim, try_claim
from benchmarks.paper.evidence import Part, Results, Starts, bootstrap, gap, judged, mean, probability, roughness
from benchmarks.paper.tables import interval, is_level
from torchrl_quad.files import read_rows, write_rows

PROJECT = Path(__file__).parents[1]
TABLES = running.DATA.parent / "tables"
RENEW = "it differs from the data: python -m benchmarks.paper.results"


def data(folder, task="hovering", seeds=matrix.SEEDS, **ends):
    """Results with curves of these ends, for all seeds or by seed."""
    ends = {name: end if callable(end) else lambda _, end=end: end for name, end in ends.items()}
    rows = [row for name, end in ends.items() for seed in seeds for row in curve(name, seed, 0.0, *end(seed))]
    write_rows(folder / f"curves/{task}.csv", rows)
    return Results(folder)


def ends_higher(r, best, *others, task="hovering"):
    """The verdict on a claim that one method ends higher than the others."""
    return try_claim(Claim("A", "", lambda r: claims.higher_end(r, [task], best, others)), r)


def test_the_statistics_are_those_worked_by_hand():
    a, b = np.array([1.0, 2.0, 3.0]), np.array([0.0, 2.0])
    assert probability(a, b) == pytest.approx((1 + 0 + 1 + 0.5 + 1 + 1) / 6)
    assert probability(np.array([-np.inf]), np.array([-np.inf])) == 0.5  # both never
    assert gap(a, b) == pytest.approx(0.5)
    assert roughness(np.array([0.0, 2.0, 1.0, 4.0, 3.0])) == pytest.approx(2 / 4)
    least, most = bootstrap("mean", mean, np.random.default_rng(1).normal(3.0, 1.0, 100)).interval()
    assert least == pytest.approx(2.8, abs=0.15) and most == pytest.approx(3.2, abs=0.15)


def test_an_interval_draws_starts_too_and_what_they_shift_alike_is_no_difference_between_methods(tmp_path):
    off = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    flown = {"abpt": 50.0 + off, "shac": 60.0 + off, "bptt": 55.0 + off[::-1]}
    about = {"task": "landing", "seed": 0, "starts": 256}
    rows = [{**about, "algorithm": name, "return": x} for name, of in flown.items() for x in of]
    write_rows(tmp_path / "starts.csv", rows)
    seeds, wide = np.full(5, 10.0), math.sqrt(5 / 4) * off[[0, -1]]  # five sets underestimate how far sets differ

    def from_starts(values, method, **options):
        return judged(values, Starts(tmp_path).shift("landing", method, "return", **options))

    assert interval(seeds) == (10.0, 10.0) and interval(from_starts(seeds, "abpt")) == pytest.approx(tuple(10.0 + wide))
    assert interval(from_starts(seeds, "abpt", starts=64)) == pytest.approx(tuple(10.0 + 2.0 * wide))
    not_flown = interval(from_starts(seeds, "ppo"))  # as any of those that were
    assert not_flown == pytest.approx(tuple(10.0 + wide))
    best = from_starts(seeds + 0.5, "shac")
    assert not is_level(from_starts(seeds, "abpt"), best) and is_level(from_starts(seeds, "bptt"), best)
    assert Starts(tmp_path).shift("racing", "abpt", "return") is None
    assert Starts(tmp_path).shift("landing", "abpt", "gates_passed") is None
    low, high = bootstrap("", mean, judged(np.full(5, 0.5), evidence.shares(np.full(5, 0.5), 64))).interval()
    assert high - 0.5 == pytest.approx(1.96 * 0.5 / 8, rel=0.1) and 0.5 - low == pytest.approx(high - 0.5, rel=0.1)


def part(least, most, **bounds):
    return Part("", 0.0, np.linspace(least, most, 10_001), **bounds)


def test_a_part_is_decided_when_its_interval_is_on_one_side_and_one_of_many_by_a_wider_one():
    for draws, verdict in {(0.6, 0.9): "supported", (0.1, 0.4): "refuted", (0.4, 0.9): "undecided"}.items():
        assert part(*draws, low=0.5).verdict() == verdict
        assert part(-draws[1], -draws[0], high=-0.5).verdict() == verdict
    both = {(-0.05, 0.05): "supported", (0.2, 0.3): "refuted", (-0.3, -0.2): "refuted", (0.0, 0.2): "undecided"}
    for draws, verdict in both.items():
        assert part(*draws, low=-0.1, high=0.1).verdict() == verdict
    alone = part(0.0, 1.0, low=0.98)  # the middle 95 % end at 0.975
    assert alone.interval() == pytest.approx((0.025, 0.975)) and alone.interval(10) == pytest.approx((0.0025, 0.9975))
    assert alone.verdict() == "refuted" and alone.verdict(10) == "undecided"


def test_a_method_that_ends_higher_with_every_seed_is_supported_and_one_that_does_not_is_refuted(tmp_path):
    data(tmp_path, abpt=lambda s: [9 + 0.01 * s], shac=lambda s: [8 + 0.01 * s], bptt=[8], ppo=lambda s: [s])
    flown = {"abpt": "old", "shac": "new", "bptt": "old"}  # the dynamics
    rows = [{"task": "hovering", "variant": name, "lr": "", "seed": 42, "dynamics": x} for name, x in flown.items()]
    write_rows(tmp_path / "final.csv", rows)
    r = Results(tmp_path)
    assert [ends_higher(r, "abpt", x).dynamics for x in ("shac", "bptt")] == ["both", "old"]
    assert ends_higher(r, "abpt", "shac", "bptt").verdict == "supported"
    assert ends_higher(r, "shac", "abpt", "bptt").verdict == "refuted"
    assert ends_higher(r, "ppo", "abpt").verdict == "undecided"
    assert ends_higher(r, "shac", "abpt", task="racing").verdict == "not run"


@pytest.mark.parametrize(("seeds", "verdict"), [((42, 0, 1), "supported (preliminary)"), ((42, 0), "too few seeds")])
def test_fewer_than_five_seeds_of_any_run_are_preliminary_and_fewer_than_three_no_verdict(tmp_path, seeds, verdict):
    found = ends_higher(data(tmp_path, seeds=seeds, abpt=[9], shac=[8]), "abpt", "shac")
    assert found.verdict == verdict and found.seeds == len(seeds)


def test_methods_have_converged_when_they_reach_nearly_what_both_reach(tmp_path):
    r = data(tmp_path, "landing", abpt=[9.5, 10], shac=[8.9, 9.1], bptt=[math.nan, math.nan], ppo=[1, 2])
    level = r.level("landing", r.end("landing", "abpt"), r.end("landing", "shac"))
    assert level == pytest.approx(0.9 * 9.1)
    assert r.level("landing", np.array([-10.0])) == pytest.approx(-11.0)
    assert r.until("landing", "abpt", "steps", level).tolist() == [200] * 5
    assert r.until("landing", "shac", "seconds", level).tolist() == [4] * 5
    assert r.until("landing", "ppo", "steps", level).tolist() == [math.inf] * 5
    assert r.end("landing", "bptt").tolist() == [0.0] * 5  # diverged: ends where it began
    assert roughness(np.array([1.0, math.nan])) == math.inf


@pytest.fixture
def quick(monkeypatch):
    """A bootstrap of fewer draws."""
    monkeypatch.setattr(evidence, "RESAMPLES", 400)


def synthetic(tmp_path, strong):
    """Results in which ABPT is as in the paper, or the other way round."""
    rng = np.random.default_rng(0)
    runs = [{"task": t, "variant": v, "seed": s} for t in matrix.TASKS for v in matrix.VARIANTS for s in matrix.SEEDS]
    rows = {task: [] for task in matrix.TASKS}
    for run in runs:
        level = 20.0 if (run["variant"] in ("abpt", "abpt-now")) == strong else 10.0
        returns = level * np.linspace(0.2, 1.0, 10) + 0.1 * rng.normal(size=10)
        more = {"solved": 0.9, "gates_passed": level, "start_cells": level, "position_error": 0.1}
        rows[run["task"]] += curve(run["variant"], run["seed"], *returns, **more)
    for task, of in rows.items():
        write_rows(tmp_path / f"curves/{task}.csv", of)
    own = {"lr": "", "machine": "a processor", "seconds": 20.0, "solved": 0.9, "revision": 5 * "abcd1234"}
    ends = {"position_error": 0.1, "tracking_rmse": 0.1, "landing_speed": 0.2, "gates_passed": 4, "time_near_gate": 2.0}
    write_rows(tmp_path / "final.csv", [{**run, **own, **ends} for run in runs])
    term = {"task": "racing", "reward": "velocity", "term": "gate", "mean_return": 5.0, "verdict": ""}
    audit = [{**term, "gradient_norm": 0.0 if strong else 0.3, "return_share": 0.5, "gradient_share": 0.5}]
    write_rows(tmp_path / "audit.csv", audit)
    return Results(tmp_path)


@pytest.mark.parametrize("strong", [True, False])
def test_every_claim_can_be_tried_and_can_come_out_either_way(quick, tmp_path, strong):
    r = synthetic(tmp_path, strong)
    verdicts = {claim.id: try_claim(claim, r).verdict for claim in claims.CLAIMS}
    assert set(verdicts.values()) <= {"supported", "refuted", "undecided"}
    for name in ("C1", "C14", "C15", "C17", "C18"):
        assert verdicts[name] == ("supported" if strong else "refuted"), name


def test_claims_compare_visited_states_under_the_same_dynamics_and_shac_as_xu_where_that_was_run(quick, tmp_path):
    synthetic(tmp_path, strong=True)
    r, used = Results(tmp_path, claims.PUBLISHED), {}
    for claim in claims.CLAIMS:
        try_claim(claim, r)
        used[claim.id] = {run for run in r.used if run[1].startswith(("shac", "abpt-no"))}
        if claim.id in ("C15", "C17"):
            assert {variant for _, variant in r.used} == {"abpt-now", "abpt-no-visited"}
    assert used["C8"] == {("hovering", "shac-cut"), ("tracking", "shac-cut")}
    assert used["C11"] == used["C12"] == {("landing", "shac-xu")} and used["C13"] == {("racing", "shac-xu")}


def test_a_page_is_made_of_other_results_and_the_pages_of_the_project_stay_as_they_are(quick, monkeypatch, tmp_path):
    synthetic(tmp_path, strong=True)
    monkeypatch.setattr(results, "pages", lambda: pytest.fail("These are other results."))
    run_main(monkeypatch, results, "--data", tmp_path)
    assert (tmp_path / "figures/main.png").read_bytes().startswith(b"\x89PNG")
    text = (tmp_path / "results.md").read_text()
    assert all(f"| {claim.id} | {claim.text} |" in text for claim in claims.CLAIMS)
    assert "| main | landing | PPO | 5 | 9.9" in text and "# summary" not in text

    (tmp_path / "curves/landing.csv").unlink()
    run_main(monkeypatch, results, "--data", tmp_path)
    assert "| C9 | BPTT still works in landing | not run |" in (tmp_path / "results.md").read_text()


def test_what_is_written_by_hand_stays_beside_the_generated_blocks():
    begin, table = report.MARKER.format("paper: a"), [{"": "x", "b": "1"}]
    page = f"# Mine\n\n{begin}\nold\n{report.END}\n\nThe end.\n"
    new = f"# Mine\n\n{begin}\n\n|  | b |\n| --- | --- |\n| x | 1 |\n\n{report.END}\n\nThe end.\n"
    assert results.filled(page, {"a": table, "other": table}) == new == results.filled(new, {"a": table})


def test_the_pages_and_tables_of_the_project_show_what_its_data_hold():
    made, shown = tables.make(running.DATA), {}
    for page in results.pages():
        text = page.read_text()
        shown |= dict.fromkeys(re.findall(report.MARKER.format(r"paper: ([\w-]+)"), text), page)
        assert results.filled(text, made) == text, f"{page}: {RENEW}"
        assert text.count("<!-- generated by benchmarks/") == text.count(report.END)
    assert {"summary", "claims", "reached", "choice", "forest"} <= set(shown) <= set(made)
    files = {path.stem: read_rows(path) for path in TABLES.glob("*.csv")}
    assert files.keys() == made.keys(), RENEW
    for name, table in made.items():
        assert [{x: row.get(x, "") for x in files[name][0]} for row in table] == files[name], f"{name}: {RENEW}"


def test_the_sentences_of_the_page_say_what_its_data_hold():
    r, page = Results(running.DATA), " ".join((PROJECT / "docs/results.md").read_text().split())
    words = ["no", "one", "two", "three", "four", "five"]

    def mean(task, variant, column="return"):
        return r.end(task, variant, column).mean()

    def best(task, suffix=""):
        return max(matrix.METHODS, key=lambda m: mean(task, m + suffix)).upper()

    def crashed(task, variant):
        return words[int((r.end(task, variant, "crash") > 0.99).sum())]

    assert best("hovering") == best("racing", suffix="-velocity")
    landing = [mean("landing", method) for method in matrix.METHODS]
    assert mean("landing", "abpt-no-0-step") > mean("landing", "abpt")
    racing = ["abpt", "abpt-critic", "abpt-horizon-32", "abpt-horizon-96", "abpt-no-0-step", "abpt-entropy"]
    assert sorted(racing, key=lambda x: mean("racing", x)) == racing
    more, fewer = (mean("racing", x, "gates_passed") for x in ("abpt-no-0-step", "abpt"))

    ascent = {}  # mean cosines, by task, variant and gradient
    for (task, variant), rows in evidence.grouped(read_rows(running.DATA / "ascent.csv"), "task", "variant").items():
        for name in ("n_step_return", "zero_step_return", "objective", "explained_variance"):
            if values := evidence.column(rows, name):
                ascent.setdefault((task, variant), {})[name] = round(float(np.mean(values)), 2)
    least = min(of["n_step_return"] for of in ascent.values() if "n_step_return" in of)
    ascent = {run: of for run, of in ascent.items() if "zero_step_return" in of}
    assert all(of["zero_step_return"] < of["n_step_return"] for of in ascent.values())
    assert max(of["objective"] for (task, _), of in ascent.items() if task == "racing") < 0.1
    hardly = max(of["zero_step_return"] for (task, _), of in ascent.items() if task == "racing")
    known = min(of["explained_variance"] for (task, _), of in ascent.items() if task in ("racing", "landing"))

    sooner = {(x["claim"], x["what"].split(", ")[-1][:-1]): x["verdict"] for x in read_rows(TABLES / "parts.csv")}
    assert sooner["C15", "landing"] == "supported" and sooner["C15", "hovering"] == "refuted"
    for variant in matrix.EXPERIMENTS["relaxation"]:
        helps = mean("racing", variant, "gates_passed") > mean("racing", variant.split("-")[0], "gates_passed")
        assert helps == (variant in ("bptt-log", "shac-reciprocal"))
    slow = matrix.EXPERIMENTS["rate"]
    crashes = math.ceil(100 * max(r.end(task, x, "crash").max() for task in matrix.TASKS for x in slow))
    assert min(r.end("tracking", x, "solved").min() for x in slow) == 1.0
    assert not mean("hovering", "abpt-slow", "solved") and not mean("hovering", "shac-slow", "solved")
    assert all(0.45 < mean("landing", x, "solved") < 0.6 for x in slow)
    shipped = evidence.grouped(read_rows(running.DATA / "shipped.csv"), "task", "algorithm")
    for task in ("racing", "racing_position"):
        abpt, ppo = (evidence.column(shipped[task, x], "return") for x in ("abpt", "ppo"))
        assert tables.interquartile_mean(abpt) > tables.interquartile_mean(ppo)
    for sentence in (
        f"{best('hovering')} leads in hovering and in racing with the velocity reward, {best('tracking')} in tracking, "
        f"{best('racing')} in racing with the position reward, and in landing all four end within "
        f"{math.ceil(100 * (1 - min(landing) / max(landing)))} % of each other.",
        f"of five seeds, {crashed('hovering', 'bptt')} of BPTT in hovering, {crashed('tracking', 'abpt')} of ABPT and "
        f"{crashed('tracking', 'shac')} of SHAC in tracking, and {crashed('racing', 'ppo-velocity')} of PPO in racing "
        "with the velocity reward.",
        f"own ablation, ends higher in landing and passes {more:.1f} gates instead of {fewer:.1f} in racing.",
        "entropy bonus of the published settings does as much for racing, a shorter horizon or better critics do less",
        f"with a mean cosine of {least} or more.",
        f"The 0-step return does so less everywhere, and in racing hardly at all ({hardly} at most): with both, the",
        f"In landing and racing the critics explain at least {100 * known:.0f} % of the variance of their targets",
        "help landing, which converges sooner with them; hovering converges sooner without them.",
        "The logarithmic bonus helps BPTT to pass gates, and the reciprocal one helps SHAC; the other two pairs pass",
        f"at most {crashes} % of the last episodes of a run crash, every seed solves tracking",
        "in hovering neither ABPT nor SHAC solves an episode, and each of the three solves landing in about half",
        "With the settings that ship it [returns as much as PPO with either reward](choosing.md).",
    ):
        assert sentence in page, sentence


def test_the_readme_says_how_many_episodes_are_solved_in_a_third_party_simulator():
    readme = (PROJECT / "README.md").read_text()
    solved = {
        (row["task"], row["policy"], row["simulator"].split()[0], row["loop"]): float(row["solved"])
        for row in read_rows(PROJECT / "benchmarks/results/transfer.csv")
        if (row["mutant"], row["drone"]) == ("none", "nominal")
    }
    columns = [("shipped", "torchrl_quad", "contract"), ("shipped", "MuJoCo", "contract"), ("shipped", "MuJoCo", "pid")]
    columns.append(("visfly", "Betaflight", "own"))
    tasks = ("hovering", "tracking", "landing", "racing")
    shares = {task: [f"{100 * solved[(task, *column)]:.3g} %" for column in columns] for task in tasks}
    trained = f"; trained with `env.firmware=pid` {100 * solved['racing', 'visfly_pid', 'MuJoCo', 'pid']:.3g} %"
    shares["racing"][2] += trained
    assert shares["hovering"] == shares["tracking"] == shares["landing"]
    for name, cells in (("hovering, tracking, landing", shares["hovering"]), ("racing", shares["racing"])):
        assert f"\n| {name} | {' | '.join(cells)} |\n" in readme
