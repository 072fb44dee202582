"""The runs that put the paper on trial."""

import math
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from scipy.stats import mannwhitneyu

from benchmarks.paper import (
    ablations,
    claims,
    comparison,
    forest,
    matrix,
    rates,
    reproduce,
    running,
    shipped,
    starts,
    tables,
)
from benchmarks.paper.evidence import Starts
from benchmarks.paper.matrix import Job
from torchrl_quad.files import read_rows, write_rows


def curve(variant, seed, *returns, **more):
    for i, value in enumerate(returns, 1):
        yield {"variant": variant, "lr": "", "seed": seed, "steps": 100 * i, "seconds": 2 * i, "return": value, **more}


def run_main(monkeypatch, module, *arguments):
    monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, arguments)])
    module.main()


@pytest.mark.slow
def test_a_shrunken_matrix_runs_and_goes_on_where_it_was_stopped(run_here, monkeypatch, tmp_path):
    in_own_process = reproduce.run  # of one of the runs; the others save the time to start

    def run(command, folder):
        (in_own_process if folder.parent.name == "abpt-now" else run_here)(command, folder)

    monkeypatch.setattr(reproduce, "run", run)
    arguments = ["--quick", "--tasks", "hovering", "--experiments", "dynamics", "--seeds", "42", "--cores", "2"]
    folders = ["--data", tmp_path / "data", "--output", tmp_path / "runs"]
    run_main(monkeypatch, reproduce, *arguments, *folders)
    finals = read_rows(tmp_path / "data/final.csv")
    assert sorted((row["variant"], row["seed"], row["lr"]) for row in finals) == [
        *(("abpt", "100", "0.003"), ("abpt-no-visited", "42", ""), ("abpt-now", "42", ""))
    ]
    assert all(row["steps"] == "64" and float(row["seconds"]) > 0 and row["machine"] for row in finals)
    curves = read_rows(tmp_path / "data/curves/hovering.csv")
    assert [row["steps"] for row in curves if row["variant"] == "abpt-no-visited"] == ["16", "32", "48", "64"]
    audit = read_rows(tmp_path / "data/audit.csv")
    assert {row["task"] for row in audit} == set(matrix.TASKS)

    # Cut off after the curve was written and before the run was entered: no row is there twice.
    write_rows(tmp_path / "data/final.csv", [row for row in finals if row["variant"] != "abpt-now"])
    started = []
    monkeypatch.setattr(reproduce, "run", lambda command, folder: started.append(folder))  # it had finished
    monkeypatch.setattr(reproduce, "audit_tasks", lambda _: audit)
    run_main(monkeypatch, reproduce, *arguments, *folders)
    assert started == [tmp_path / "runs/hovering/abpt-now/seed42"]
    assert len(read_rows(tmp_path / "data/final.csv")) == 3
    assert sorted(map(str, read_rows(tmp_path / "data/curves/hovering.csv"))) == sorted(map(str, curves))


def finish(folder):
    """Leave what a finished run leaves."""
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text("steps,time/processor_seconds,eval/return,eval/solved\n10,1.5,2.5,0.1\n")
    (folder / "summary.json").write_text('{"return": 2.5, "solved": 0.1, "steps": 10, "revision": "abc"}')


def test_runs_that_were_flown_elsewhere_are_collected_when_they_are_finished(monkeypatch, tmp_path):
    finish(tmp_path / "runs/racing/shac-xu/seed3")
    (tmp_path / "runs/racing/shac-xu/seed2").mkdir()  # has only begun
    folders = ("--data", tmp_path / "data", "--output", tmp_path / "runs")
    for _ in range(2):
        run_main(monkeypatch, reproduce, "--collect", "--experiments", "published", *folders)
    (row,) = read_rows(tmp_path / "data/final.csv")
    assert (row["variant"], row["seed"], row["solved"], row["seconds"]) == ("shac-xu", "3", "0.1", "1.5")
    assert (row["revision"], row["dynamics"]) == ("abc", matrix.DYNAMICS) and row["flown"].count("-") == 2
    assert [row["solved"] for row in read_rows(tmp_path / "data/curves/racing.csv")] == ["0.1"]


def test_quick_results_never_get_among_the_real_ones(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        run_main(monkeypatch, reproduce, "--quick")
    assert "name another folder with --data" in capsys.readouterr().err


def test_a_run_that_fails_is_reported_and_the_others_go_on(monkeypatch, tmp_path):
    def run(command, folder):
        if "shac" in str(folder):
            raise RuntimeError(f"{folder} ended with 1")
        finish(folder)

    monkeypatch.setattr(reproduce, "run", run)
    monkeypatch.setattr(reproduce, "audit_tasks", list)
    arguments = ["--quick", "--tasks", "hovering", "--experiments", "main", "--seeds", "0"]
    with pytest.raises(SystemExit) as stop:
        run_main(monkeypatch, reproduce, *arguments, "--data", tmp_path / "data", "--output", tmp_path / "runs")
    assert "hovering/shac/lr0.003/seed100 ended with 1" in str(stop.value)
    assert "hovering/shac/seed0: the search for its learning rate is not complete" in str(stop.value)
    assert len(read_rows(tmp_path / "data/final.csv")) == 6


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_runs_and_starts_no_others(number, tmp_path):
    sleeper = "import os, time; print(os.getpid(), flush=True); time.sleep(99)"
    program = f"""
import sys
from pathlib import Path
from benchmarks.paper.running import run, side_by_side
folder = Path({str(tmp_path)!r})
side_by_side(1, [(run, [sys.executable, "-c", {sleeper!r}], folder / str(i)) for i in range(3)])
"""
    said, log, deadline = tmp_path / "said.txt", tmp_path / "0/log.txt", time.monotonic() + 120
    with said.open("w") as file, subprocess.Popen([sys.executable, "-c", program], stderr=file) as process:
        try:
            while not log.exists() or not log.read_text():
                assert process.poll() is None and time.monotonic() < deadline, said.read_text()
                time.sleep(0.1)
            process.send_signal(number)
            assert process.wait(30) == 128 + number
        finally:
            process.kill()
    with pytest.raises(ProcessLookupError):
        os.kill(int(log.read_text()), 0)
    assert not (tmp_path / "1").exists()


def test_a_run_that_fails_is_told_and_stops_no_other(tmp_path, capsys):
    jobs = [(running.run, [sys.executable, "-c", code], tmp_path / code[-1]) for code in ("raise OSError(1) #0", "#1")]
    with pytest.raises(SystemExit, match="1 of 2 runs failed"):
        running.side_by_side(1, jobs)
    assert "ended with 1: OSError: 1 See log.txt there" in capsys.readouterr().err
    assert (tmp_path / "1/log.txt").exists()


def test_a_run_that_diverged_is_kept_as_one(tmp_path):
    folder = tmp_path / "run"
    finish(folder)
    (folder / "failure.pt").write_text("")
    job = Job("hovering", "abpt", 100, 0.03)
    reproduce.keep(job, folder, tmp_path)
    assert reproduce.is_kept(job, tmp_path) and not reproduce.is_kept(Job("hovering", "abpt", 100, 0.01), tmp_path)
    assert [row["return"] for row in read_rows(tmp_path / "search/hovering.csv")] == ["2.5", "nan"]


def test_the_best_learning_rate_is_that_whose_curve_ends_highest(tmp_path):
    rows = [
        {**row, "lr": lr}
        for lr, end in (("0.001", 3.0), ("0.01", 5.0), ("0.1", math.nan))
        for row in curve("abpt", 100, 9.0, end)
    ]
    write_rows(tmp_path / "search/hovering.csv", rows)
    assert reproduce.best_learning_rate("hovering", "abpt", tmp_path, (1e-3, 1e-2, 1e-1)) == 1e-2
    assert reproduce.best_learning_rate("hovering", "abpt", tmp_path, (1e-3, 1e-2, 1.0)) is None
    assert reproduce.best_learning_rate("hovering", "shac", tmp_path, (1e-3,)) is None


def test_the_jobs_of_the_matrix_are_valid_runs_of_their_recipes_and_each_is_there_once():
    everything = matrix.jobs(tuple(matrix.EXPERIMENTS), matrix.TASKS, matrix.SEEDS)
    assert len({job.name for job in everything}) == len(everything)
    assert {job.seed for job in everything[: len(everything) * 3 // 5]} == set(matrix.SEEDS[:3])  # three seeds first
    assert {job.task for job in everything if job.variant == "shac-xu"} == {"landing", "racing"}
    jobs = [job for job in everything if job.seed == 42 and (job.task == "racing" or job.variant in matrix.METHODS)]
    for job in jobs + matrix.search_jobs(("racing",), {"abpt", "ppo-velocity", "shac-cut"}, (3e-3,)):
        cfg = reproduce.configuration(job, 1e-3)
        assert cfg.actor.lr == pytest.approx((job.lr or 1e-3) * matrix.VARIANTS[job.variant].rate)
        if job.task == "racing":
            assert cfg.env.reward == ("velocity" if "velocity" in job.variant else "position")
            assert "critic" not in cfg or cfg.critic.num_cells == [128, 128]
        assert cfg.actor.schedule == "linear" and cfg.loss.get("max_importance_ratio") is None
        if cfg.algorithm != "ppo":
            assert cfg.num_envs * cfg.horizon == pytest.approx(16384 if job.task == "racing" else 4096, rel=0.02)
        if cfg.algorithm == "shac":
            assert cfg.loss.target_bootstrap == cfg.loss.average_over_horizon == (job.variant == "shac-xu")
        assert cfg.total_steps == matrix.STEPS[job.task][cfg.algorithm == "ppo"] * (0.25 if job.lr else 1)


def test_without_visited_states_every_horizon_goes_on_where_the_last_one_ended():
    assert {tables.starts(task, "abpt-no-visited") for task in matrix.TASKS} == {"all go on"}
    assert tables.starts("landing", "abpt-restarts") == "20% fresh, 80% go on"
    assert tables.starts("racing", "abpt-now") == tables.starts("racing", "abpt") == "80% visited, 20% fresh"
    table = tables.starts_table()
    labels = [matrix.VARIANTS[x].label for x in (*matrix.METHODS, *claims.PUBLISHED.values(), "abpt-no-visited")]
    assert all(f"| {label} |" in table for label in labels)


def test_recipes_are_flown_as_they_ship_and_what_is_there_is_not_flown_again(run_here, monkeypatch, tmp_path):
    monkeypatch.setattr(shipped, "run", run_here)
    wanted = ["--tasks", "six_gates_back", "own_task.CornerEnv", "--methods", "ppo", "--seeds", "0", "--cores", "2"]
    arguments = [*wanted, "--data", tmp_path, "--output", tmp_path / "runs", "--quick"]
    run_main(monkeypatch, shipped, *arguments[:-1], "--quick")
    rows = read_rows(tmp_path / "shipped.csv")
    assert len(rows) == 2 and {row["task"] for row in rows} == {"own_task.CornerEnv", "six_gates_back"}
    assert all(row["steps"] == "64" and row["machine"] and float(row["seconds"]) > 0 for row in rows)
    page = (tmp_path / "summary.md").read_text()
    for cell in ("0.00 gates passed", r"\d\.\d\d m"):  # a row for each method, a column for each task
        assert re.search(rf"^\| PPO \|.* 0.0% \(0.0%\), {cell}, ", page, re.M)
    assert "| six gates, backwards | PPO | 1 | " in page
    curves = read_rows(tmp_path / "shipped_curves.csv")
    assert {row["task"] for row in curves} == {"own_task.CornerEnv", "six_gates_back"} and curves[-1]["steps"] == "64"
    assert (tmp_path / "results/shipped.png").stat().st_size > 10_000
    monkeypatch.setattr(shipped, "run", lambda *_: pytest.fail("It has been flown."))
    run_main(monkeypatch, shipped, *arguments)
    assert (tmp_path / "summary.md").read_text() == page
    values = [("0.5", "0.02", "9"), ("1.0", "0.01", "5"), ("1.0", "", "7")]
    group = [dict(zip(("solved", "position_error", "seconds"), x, strict=True)) for x in values]
    assert shipped.cell(group, "position_error", 100, 1, "cm") == "83.3% (50.0%), 1.5 cm, 7 s, 3 seeds"
    for refused in (["--quick"], ["--tasks", "own_task.CornerEnv"], ["--tasks", "window"]):
        with pytest.raises(SystemExit):
            run_main(monkeypatch, shipped, *refused)


def test_options_are_changed_one_at_a_time_and_shown_beside_what_ships(run_here, monkeypatch, tmp_path):
    monkeypatch.setattr(shipped, "run", run_here)
    wanted = ["--tasks", "landing", "--methods", "bptt", "--changes", "event times", "clip", "--seeds", "0"]
    arguments = [*wanted, "--data", tmp_path, "--output", tmp_path / "runs", "--quick"]
    run_main(monkeypatch, ablations, *arguments)
    (row,) = read_rows(tmp_path / "ablations.csv")
    assert (row["change"], row["algorithm"], row["steps"]) == ("clip", "bptt", "64")
    monkeypatch.setattr(ablations, "train", lambda *_: pytest.fail("It has been flown."))
    run_main(monkeypatch, ablations, *arguments)
    ships = [row | {"seed": seed, "return": "9.0", "solved": "0.5"} for seed in "012"]
    write_rows(tmp_path / "shipped.csv", ships)  # of which one seed has flown with a change
    assert "| landing | BPTT | as it ships | 1 | 9 (9) | 50.0% (50.0%) |" in ablations.summary(tmp_path)
    with pytest.raises(SystemExit):
        run_main(monkeypatch, ablations, "--quick")
    with initialize_config_dir(str(running.RECIPES / "config"), version_base=None):
        for task in ablations.TASKS:
            for method in ablations.OF_METHODS:
                cfg = compose(method, shipped.overrides(task, method))
                for change, override in ablations.CHANGES.items():
                    key, value = override.split("=")
                    value = cfg.gamma if value == "${gamma}" else yaml.safe_load(value)
                    assert ablations.is_change(task, method, change) is (OmegaConf.select(cfg, key) != value)


def test_half_and_twice_a_rate_fly_once_and_are_judged_by_their_worst_seed(run_here, monkeypatch, tmp_path):
    monkeypatch.setattr(shipped, "run", run_here)
    wanted = ["--tasks", "hovering", "--methods", "bptt", "--factors", "0.5", "--seeds", "101"]
    arguments = [*wanted, "--data", tmp_path, "--output", tmp_path / "runs", "--quick"]
    run_main(monkeypatch, rates, *arguments)
    (row,) = read_rows(tmp_path / "rates.csv")
    assert (row["factor"], row["algorithm"], row["steps"]) == ("0.5", "bptt", "64")
    monkeypatch.setattr(ablations, "train", lambda *_: pytest.fail("It has been flown."))
    run_main(monkeypatch, rates, *arguments)
    ends = {("0.5", "102"): "1.5", ("2", "101"): "9.0", ("2", "102"): "8.0", ("2", "103"): "7.0"}
    rows = [row | {"factor": factor, "seed": seed, "return": x, "solved": "0.5"} for (factor, seed), x in ends.items()]
    write_rows(tmp_path / "rates.csv", rows)
    assert "| hovering | BPTT | 1.5, 50.0%, 1 of 3 seeds |  | 7, 50.0% |" in rates.summary(tmp_path)
    assert rates.scaled("racing", "ppo", "2") == ["actor.lr=0.012", "actor.final_lr=2e-05"]
    assert rates.scaled("hovering", "hybrid", "0.5") == ["actor.max_kl=0.125"]
    with pytest.raises(SystemExit):
        run_main(monkeypatch, rates, "--quick")


def test_policies_of_the_forest_are_flown_at_the_speeds_and_densities_and_not_twice(run_here, monkeypatch, tmp_path):
    monkeypatch.setattr(forest, "run", run_here)
    wanted = ["--policies", "blind", "--seeds", "0", "--speeds", "6", "--difficulties", "middle"]
    arguments = [*wanted, "--forests", "2", "--data", tmp_path, "--output", tmp_path / "runs", "--quick"]
    run_main(monkeypatch, forest, *arguments)
    (row,) = rows = read_rows(tmp_path / "forest.csv")
    assert (row["difficulty"], row["speed"], row["steps"]) == ("middle", "6.0", "64")
    assert float(row["solved"]) + float(row["crash"]) <= 1.0
    assert (tmp_path / "images/forest_success.png").exists()
    monkeypatch.setattr(forest, "fly", lambda *_: pytest.fail("It has been flown."))
    run_main(monkeypatch, forest, *arguments)
    flown = [{**row, "policy": "bptt", "seed": str(seed), "solved": x} for seed, x in enumerate(("0.5", "0.75"))]
    assert "| bptt | 0.0 | " in forest.summary([*rows, *flown]) and "62% (50%, 2 seeds) |" in forest.summary(flown)


def test_a_policy_is_flown_from_every_set_of_starts_once(run_here, monkeypatch, tmp_path):
    monkeypatch.setattr(shipped, "run", run_here)
    monkeypatch.setattr(starts, "STARTS", 2)
    monkeypatch.setattr(starts, "SETS", 3)
    wanted = [
        "--tasks",
        "racing",
        "--methods",
        "bptt",
        "--seeds",
        "0",
        "--data",
        tmp_path,
        "--output",
        tmp_path / "runs",
    ]
    run_main(monkeypatch, starts, *wanted, "--quick")
    rows = read_rows(tmp_path / "starts.csv")
    assert [row["starts_seed"] for row in rows] == ["2000000", "2000001", "2000002"]
    assert len({row["return"] for row in rows}) == 3 and all(row["gates_passed"] == "0" for row in rows)
    monkeypatch.setattr(starts, "fly", lambda *_: pytest.fail("It has been flown."))
    run_main(monkeypatch, starts, *wanted, "--quick")


def test_methods_are_compared_by_interquartile_means_and_by_who_beats_whom(tmp_path):
    assert comparison.interquartile_mean([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 100.0]) == 3.5
    ours, theirs = [3.0, 1.0, 2.0], [2.0, 0.0, 2.0, 1.0]
    expected = mannwhitneyu(ours, theirs).statistic / 12
    assert comparison.probability(np.array(ours), np.array(theirs)) == pytest.approx(expected)
    assert comparison.interval([2.0, 2.0, 2.0]) == (2.0, 2.0)
    assert comparison.interval([-math.inf, 1.0, 2.0]) == (-math.inf, 2.0)  # one seed diverged
    low, high = comparison.interval([1.0, 2.0, 3.0, 4.0])
    assert 1.0 <= low < 2.5 < high <= 4.0
    flown = {  # by method: return, solved and seconds of each seed
        "bptt": [(9.0, 1.0, 3), (9.2, 0.98, 3), (9.1, 1.0, 3)],  # quick, but not with every seed
        "shac": [(9.0, 1.0, 5), (9.1, 1.0, 5), (9.2, 0.99, 5)],
        "ppo": [(9.5, 1.0, 40), (9.6, 1.0, 40), (9.7, 1.0, 40)],
        "abpt": [(99.0, 0.5, 1), (99.0, 1.0, 1)],  # few
    }
    names = ("return", "solved", "seconds", "steps", "machine")
    rows = [
        {"task": "hovering", "algorithm": method} | dict(zip(names, map(str, (*x, 1e6, "a box")), strict=True))
        for method, seeds in flown.items()
        for x in seeds
    ]
    of = shipped.METHODS, shipped.TASKS
    none = Starts(tmp_path)
    choice, table = (make(rows, *of, none) for make in (comparison.choice_table, comparison.reached_table))
    beaten, speed = (make(rows, *of) for make in (comparison.improvement_table, comparison.speed_table))
    assert "| hovering | SHAC: 9.1, 99.0%, 5 s, 3 seeds | PPO: 9.6, 100.0%, 40 s, 3 seeds |  |" in choice
    level = comparison.choice_table([x for x in rows if x["algorithm"] != "ppo"], *of, none)
    assert "| BPTT: 9.1, 98.0%, 3 s, 3 seeds | SHAC |" in level
    assert '| hovering | "a box" | 333 | 200 | 1000 |  |  |  | 25 |' in speed
    assert "| hovering | ABPT | 2 | 99 | 75.0% (50.0%) |  | 1.0 | 1 |" in table
    assert "| PPO | 1.00, 1 | 1.00, 1 |  |" in beaten and "| BPTT |  | 0.50, 1 | 0.00, 1 |" in beaten


def test_a_task_of_your_own_is_flown_with_all_that_the_paper_flies_on_each_of_its_tasks():
    jobs = matrix.jobs(tuple(matrix.EXPERIMENTS), ("own_task.CornerEnv",), (42,))
    assert {"abpt", "ppo", "bptt-episode", "abpt-no-0-step"} <= {job.variant for job in jobs}
    cfg = reproduce.configuration(jobs[0], 1e-2)
    assert (cfg.task, cfg.total_steps, cfg.env.reach) == ("own_task.CornerEnv", 491_520, 0.5)
