"""The runs that put the paper on trial."""

import math
import multiprocessing
import os
import re
import shlex
import signal
import sys
import time

import numpy as np
import pytest
import torch
from helpers import cases, refuses
from scipy.stats import mannwhitneyu

from benchmarks.paper import elsewhere, flights, gradients, matrix, reproduce, results, running, tables
from benchmarks.paper.evidence import Starts, best_learning_rate, probability
from benchmarks.paper.matrix import Job
from torchrl_quad import BPTTLoss, differentiable_rollout, make_actor, make_env
from torchrl_quad.files import read_rows, write_rows


def curve(variant, seed, *returns, **more):
    for i, value in enumerate(returns, 1):
        yield {"variant": variant, "lr": "", "seed": seed, "steps": 100 * i, "seconds": 2 * i, "return": value, **more}


def run_main(monkeypatch, module, words, *arguments):
    """Run a program with a command line, and more arguments that may hold spaces."""
    monkeypatch.setattr(sys, "argv", [module.__name__, *shlex.split(words), *map(str, arguments)])
    module.main()


@pytest.mark.slow
def test_a_shrunken_matrix_runs_and_goes_on_where_it_was_stopped(run_here, monkeypatch, tmp_path):
    in_own_process = reproduce.run  # of one of the runs; the others save the time to start

    def run(recipe, overrides, folder):
        (in_own_process if folder.parent.name == "abpt-now" else run_here)(recipe, overrides, folder)

    monkeypatch.setattr(reproduce, "run", run)
    arguments = ["trial --quick --tasks hovering --experiments dynamics --seeds 42 --cores 2"]
    arguments += ["--data", tmp_path / "data", "--output", tmp_path / "runs"]
    run_main(monkeypatch, reproduce, *arguments)
    finals = read_rows(tmp_path / "data/final.csv")
    found = sorted((row["variant"], row["seed"], row["lr"]) for row in finals)
    assert found == [("abpt", "100", "0.003"), ("abpt-no-visited", "42", ""), ("abpt-now", "42", "")]
    assert all(row["steps"] == "64" and float(row["seconds"]) > 0 and row["machine"] for row in finals)
    curves = read_rows(tmp_path / "data/curves/hovering.csv")
    assert [row["steps"] for row in curves if row["variant"] == "abpt-no-visited"] == ["16", "32", "48", "64"]
    audit = read_rows(tmp_path / "data/audit.csv")
    assert {row["task"] for row in audit} == set(matrix.TASKS)

    # Cut off after the curve was written and before the run was entered: no row is there twice.
    write_rows(tmp_path / "data/final.csv", [row for row in finals if row["variant"] != "abpt-now"])
    started = []
    monkeypatch.setattr(reproduce, "run", lambda *of: started.append(of[-1]))  # it had finished
    monkeypatch.setattr(reproduce.gradients, "audit_tasks", lambda _: audit)
    run_main(monkeypatch, reproduce, *arguments)
    assert started == [tmp_path / "runs/hovering/abpt-now/seed42"]
    assert len(read_rows(tmp_path / "data/final.csv")) == 3
    assert sorted(map(str, read_rows(tmp_path / "data/curves/hovering.csv"))) == sorted(map(str, curves))


def finish(folder):
    """Leave what a finished run leaves."""
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text("steps,time/processor_seconds,eval/return,eval/solved\n10,1.5,2.5,0.1\n")
    (folder / "summary.json").write_text('{"return": 2.5, "solved": 0.1, "steps": 10, "revision": "abc"}')


@cases(("trial --quick",), ("ablations --quick",), ("forest --forests 2",), ("shipped --tasks six_gates",))
def test_results_that_do_not_ship_never_get_among_those_that_do(what, monkeypatch, capsys):
    with pytest.raises(SystemExit):
        run_main(monkeypatch, reproduce, what)
    assert "name another folder with --data" in capsys.readouterr().err


def test_a_run_that_fails_is_reported_and_the_others_go_on(monkeypatch, capsys, tmp_path):
    def run(recipe, overrides, folder):
        if "shac" in str(folder):
            raise RuntimeError(f"{folder} ended with 1")
        finish(folder)

    monkeypatch.setattr(reproduce, "run", run)
    monkeypatch.setattr(reproduce.gradients, "audit_tasks", list)
    arguments = "trial --quick --tasks hovering --experiments main --seeds 0 --data"
    with pytest.raises(SystemExit, match="2 of 8 runs failed"):
        run_main(monkeypatch, reproduce, arguments, tmp_path / "data", "--output", tmp_path / "runs")
    said = capsys.readouterr().err
    assert "hovering/shac/lr0.003/seed100 ended with 1" in said
    assert "hovering/shac/seed0: the search for its learning rate is not complete" in said
    rows = read_rows(tmp_path / "data/final.csv")
    assert len(rows) == 6 and {(row["revision"], row["dynamics"]) for row in rows} == {("abc", matrix.DYNAMICS)}
    assert (rows[0]["solved"], rows[0]["seconds"], rows[0]["flown"].count("-")) == ("0.1", "1.5", 2)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # has threads, which its copy does not need
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_runs_and_starts_no_others(number, tmp_path):
    sleeper = "import os, time; print(os.getpid(), flush=True); time.sleep(99)"
    jobs = [(running.command, [sys.executable, "-c", sleeper], tmp_path / str(i)) for i in range(3)]
    process = multiprocessing.get_context("fork").Process(target=running.side_by_side, args=(1, jobs), daemon=True)
    log, deadline = tmp_path / "0/log.txt", time.monotonic() + 120
    process.start()
    while not log.exists() or not log.read_text():
        assert process.is_alive() and time.monotonic() < deadline
        time.sleep(0.1)
    os.kill(process.pid, number)
    process.join(30)
    assert process.exitcode == 128 + number
    with pytest.raises(ProcessLookupError):
        os.kill(int(log.read_text()), 0)
    assert not (tmp_path / "1").exists()


def test_a_run_that_fails_is_told_and_stops_no_other(tmp_path, capsys):
    codes = ("raise OSError(1) #0", "#1")
    jobs = [(running.command, [sys.executable, "-c", code], tmp_path / code[-1]) for code in codes]
    refuses("1 of 2 runs failed", running.side_by_side, 1, jobs, error=SystemExit)
    assert "ended with 1: OSError: 1 See log.txt there" in capsys.readouterr().err
    assert (tmp_path / "1/log.txt").exists()


def test_a_run_that_diverged_is_kept_as_one_and_the_best_learning_rate_ends_highest(tmp_path):
    finish(tmp_path / "run")
    (tmp_path / "run/failure.pt").write_text("")
    job = Job("hovering", "abpt", 100, 0.03)
    reproduce.keep(job, tmp_path / "run", tmp_path)
    assert running.kept(tmp_path / "final.csv", *reproduce.KEY) == {job.key} != {Job("hovering", "abpt", 100, 0.01).key}
    assert [row["return"] for row in read_rows(tmp_path / "search/hovering.csv")] == ["2.5", "nan"]
    ends = {"0.001": 3.0, "0.01": 5.0, "0.1": math.nan}
    rows = [row | {"lr": lr} for lr, end in ends.items() for row in curve("abpt", 100, 9.0, end)]
    write_rows(tmp_path / "search/hovering.csv", rows)
    assert best_learning_rate("hovering", "abpt", tmp_path, (1e-3, 1e-2, 1e-1)) == 1e-2
    assert best_learning_rate("hovering", "abpt", tmp_path, (1e-3, 1e-2, 1.0)) is None
    assert best_learning_rate("hovering", "shac", tmp_path, (1e-3,)) is None


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


def test_without_visited_states_horizons_go_on_and_a_task_of_your_own_is_flown_with_all_that_the_paper_flies():
    def starts(task, variant):
        cfg = reproduce.configuration(Job(task, variant, 42), 1e-3)
        return cfg.buffer.fraction, cfg.restart_fraction

    assert {starts(task, "abpt-no-visited") for task in matrix.TASKS} == {(None, 0)}
    assert starts("landing", "abpt-restarts") == (None, 0.2)
    assert starts("racing", "abpt-now") == starts("racing", "abpt") == (0.8, 0.2)
    jobs = matrix.jobs(tuple(matrix.EXPERIMENTS), ("own_task.CornerEnv",), (42,))
    assert {"abpt", "ppo", "bptt-episode", "abpt-no-0-step"} <= {job.variant for job in jobs}
    cfg = reproduce.configuration(jobs[0], 1e-2)
    assert (cfg.task, cfg.total_steps, cfg.env.reach) == ("own_task.CornerEnv", 491_520, 0.5)


@pytest.fixture
def flown(run_here, monkeypatch, tmp_path):
    """Fly quick runs, and again what is missing of them, which is nothing; the rows of their file."""

    def fly(what):
        for run in (run_here, lambda *_: pytest.fail("It has been flown.")):
            monkeypatch.setattr(flights, "run", run)
            run_main(monkeypatch, reproduce, f"{what} --quick --data", tmp_path, "--output", tmp_path / "runs")
        return read_rows(tmp_path / f"{what.split()[0]}.csv")

    return fly


def test_recipes_are_flown_as_they_ship_and_what_is_there_is_not_flown_again(flown, monkeypatch, tmp_path):
    rows = flown("shipped --tasks six_gates_back own_task.CornerEnv --methods ppo --seeds 0 --cores 2")
    assert len(rows) == 2 and {row["task"] for row in rows} == {"own_task.CornerEnv", "six_gates_back"}
    assert all(row["steps"] == "64" and row["machine"] and float(row["seconds"]) > 0 for row in rows)
    run_main(monkeypatch, results, "--data", tmp_path)
    page = (tmp_path / "results.md").read_text()
    for cell in ("0.00 gates passed", r"\d\.\d\d m"):  # a row for each method, a column for each task
        assert re.search(rf"^\| PPO \|.* 0.0% \(0.0%\), {cell}, ", page, re.M)
    assert "| six gates, backwards | PPO | 1 | " in page
    curves = read_rows(tmp_path / "shipped_curves.csv")
    assert {row["task"] for row in curves} == {"own_task.CornerEnv", "six_gates_back"} and curves[-1]["steps"] == "64"
    assert (tmp_path / "figures/shipped.png").stat().st_size > 10_000
    values = [("0.5", "0.02", "9"), ("1.0", "0.01", "5"), ("1.0", "", "7")]
    about = {"task": "hovering", "algorithm": "ppo"}
    group = [about | dict(zip(("solved", "position_error", "seconds"), x, strict=True)) for x in values]
    assert tables.summary_table(group) == [{"": "PPO", "hovering": "83.3% (50.0%), 1.5 cm, 7 s, 3 seeds"}]
    with pytest.raises(SystemExit):
        run_main(monkeypatch, reproduce, "shipped --tasks window --data", tmp_path)


def test_abpt_hovers_every_drone_that_is_asked_for(flown):
    (row,) = flown("drones --drones cf2x --seeds 0")
    assert (row["drone"], row["algorithm"], row["task"], row["steps"]) == ("cf2x", "abpt", "hovering", "64")


def test_options_are_changed_one_at_a_time_and_shown_beside_what_ships(flown, tmp_path):
    (row,) = flown("ablations --tasks landing --methods bptt --changes 'event times' clip --seeds 0")
    assert (row["change"], row["algorithm"], row["steps"]) == ("clip", "bptt", "64")
    assert tables.ablations_table(tmp_path) == []
    clip = row | {"return": "8.0", "solved": "0.5"}
    write_rows(tmp_path / "ablations.csv", [clip, clip | {"change": "no average", "solved": "0.25"}])
    ships = [row | {"seed": seed, "return": "9.0", "solved": "1.0"} for seed in "012"]
    write_rows(tmp_path / "shipped.csv", ships)  # of which one seed has flown with a change
    assert tables.ablations_table(tmp_path) == [
        {"task": "landing", "option": "clip", "BPTT": "-1.0, 50% (100%), 1"},
        {"task": "landing", "option": "average", "BPTT": "+1.0, 100% (25%), 1"},
    ]


def test_half_and_twice_a_rate_fly_once_and_are_judged_by_their_worst_seed(flown, tmp_path):
    (row,) = flown("rates --tasks hovering --methods bptt --factors 0.5 --seeds 101")
    assert (row["factor"], row["algorithm"], row["steps"]) == ("0.5", "bptt", "64")
    ends = {("0.5", "101"): "0.75", ("0.5", "102"): "0.5", ("2", "101"): "1", ("2", "103"): "0.9"}
    rows = [row | {"factor": factor, "seed": seed, "solved": x} for (factor, seed), x in ends.items()]
    write_rows(tmp_path / "rates.csv", rows)
    assert tables.rates_table(tmp_path) == [{"": "BPTT", "hovering": "50/?/90"}]
    assert flights.scaled("racing", "ppo", "2") == ["actor.lr=0.012", "actor.final_lr=2e-05"]
    assert flights.scaled("hovering", "hybrid", "0.5") == ["actor.max_kl=0.125"]
    assert flights.scaled("hovering", "train", "2") == ["actor.lr=0.02"]


def test_policies_of_the_forest_are_flown_at_the_speeds_and_densities_and_not_twice(flown, monkeypatch, tmp_path):
    (row,) = flown("forest --policies blind --seeds 0 --speeds 6 --difficulties middle --forests 2")
    assert (row["difficulty"], row["speed"], row["steps"]) == ("middle", "6.0", "64")
    assert float(row["solved"]) + float(row["crash"]) <= 1.0
    two = [{**row, "policy": "bptt", "seed": str(seed), "solved": x} for seed, x in enumerate(("0.5", "0.75"))]
    write_rows(tmp_path / "forest.csv", [row, *two])
    run_main(monkeypatch, results, "--data", tmp_path)
    assert (tmp_path / "figures/forest.png").exists()
    assert re.search(r"^\| bptt \| 0.0 \| \d+ \| 62% \(50%, 2 seeds\) \|$", (tmp_path / "results.md").read_text(), re.M)


def test_a_policy_is_flown_from_every_set_of_starts_once(flown, monkeypatch):
    monkeypatch.setattr(flights, "STARTS", 2)
    monkeypatch.setattr(flights, "SETS", 3)
    rows = flown("starts --tasks racing --methods bptt --seeds 0")
    assert [row["starts_seed"] for row in rows] == ["2000000", "2000001", "2000002"]
    assert len({row["return"] for row in rows}) == 3 and all(row["gates_passed"] == "0" for row in rows)


def test_methods_are_compared_by_interquartile_means_and_by_who_beats_whom(tmp_path):
    assert tables.interquartile_mean([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 100.0]) == 3.5
    ours, theirs = [3.0, 1.0, 2.0], [2.0, 0.0, 2.0, 1.0]
    expected = mannwhitneyu(ours, theirs).statistic / 12
    assert probability(np.array(ours), np.array(theirs)) == pytest.approx(expected)
    assert tables.interval([2.0, 2.0, 2.0]) == (2.0, 2.0)
    assert tables.interval([-math.inf, 1.0, 2.0]) == (-math.inf, 2.0)  # one seed diverged
    low, high = tables.interval([1.0, 2.0, 3.0, 4.0])
    assert 1.0 <= low < 2.5 < high <= 4.0
    flown = {  # by method: return, solved and seconds of each seed
        "bptt": [(9.0, 1.0, 3), (9.2, 0.98, 3), (9.1, 1.0, 3)],  # quick, but not with every seed
        "shac": [(9.0, 1.0, 5), (9.1, 1.0, 5), (9.2, 0.99, 5)],
        "ppo": [(9.5, 1.0, 40), (9.6, 1.0, 40), (9.7, 1.0, 40)],
        "abpt": [(99.0, 0.5, 1), (99.0, 1.0, 1)],  # few
    }
    names = ("return", "solved", "seconds", "steps", "machine")
    flown = [({"task": "hovering", "algorithm": method}, (*x, 1e6, "a box")) for method in flown for x in flown[method]]
    rows = [about | dict(zip(names, map(str, values), strict=True)) for about, values in flown]
    none = Starts(tmp_path)
    (choice,) = tables.choice_table(rows, none)
    assert list(choice.values())[1:] == ["SHAC: 9.1, 99.0%, 5 s, 3 seeds", "PPO: 9.6, 100.0%, 40 s, 3 seeds", ""]
    ends = {0: (9.3, 9.5), 1: (9.0, 9.41), 2: (9.5, 9.0), 3: (math.nan, 9.4)}  # returns after ten and twenty seconds
    run = {"task": "hovering", "algorithm": "train"}
    curves = [run | {"seed": s, "seconds": 10 * i, "return": x} for s, of in ends.items() for i, x in enumerate(of, 1)]
    (choice,) = tables.choice_table(rows, none, curves)
    assert choice.popitem() == ("One setting at 98 % of the best tuned", "20 s, 3 of 4 seeds")
    alone = [row | {"algorithm": "train"} for row in rows if row["algorithm"] == "ppo"]
    assert tables.choice_table(alone, none, curves)[0].popitem()[0] == "level with it"
    (level,) = tables.choice_table([x for x in rows if x["algorithm"] != "ppo"], none)
    assert list(level.values())[2:] == ["BPTT: 9.1, 98.0%, 3 s, 3 seeds", "SHAC"]
    speeds = {"BPTT": "333", "SHAC": "200", "ABPT": "1000", "PPO": "25"}
    assert tables.speed_table(rows) == [{"task": "hovering", "machine": "a box", **speeds}]
    reached = tables.reached_tables(rows, none)
    assert "| hovering | ABPT | 2 | 99 | 75.0% (50.0%) |  | 1e+06 | 1 |" in tables.markdown(reached["reached_in_full"])
    assert reached["reached"][0] == {"": "BPTT", "hovering": "9.1 [9, 9.2], 98.0%"}
    beaten = tables.markdown(tables.improvement_table(rows))
    assert "| PPO | 1.00, 1 | 1.00, 1 |  |" in beaten and "| BPTT |  | 0.50, 1 | 0.00, 1 |" in beaten


RANGE = {"pendulum": (-4 * 16.3, 0.0), "balance": (-20.0, 20.0)}  # returns that four steps can have


@cases(("pendulum", elsewhere.NAMES), ("balance", ("shac", "hybrid", "ppo")))
def test_a_loss_trains_on_another_environment_once_and_has_a_row_in_the_table(
    environment, losses, monkeypatch, tmp_path
):
    for name, value in {"ENVS": 2, "HORIZON": 4, "EPISODE": 4, "EPISODES": 2, "STEPS": 1}.items():
        monkeypatch.setattr(elsewhere, name, value)
    arguments = [f"elsewhere --environments {environment} --losses {' '.join(losses)} --seeds 0 --data", tmp_path]
    run_main(monkeypatch, reproduce, *arguments)
    rows = read_rows(tmp_path / "elsewhere.csv")
    assert [(row["environment"], row["loss"], row["seed"]) for row in rows] == [(environment, x, "0") for x in losses]
    low, high = RANGE[environment]
    assert low < float(rows[0]["before"]) < high
    table = tables.elsewhere_table(tmp_path)
    assert [row["loss"] for row in table] == list(losses) and all(environment in row for row in table)
    monkeypatch.setattr(elsewhere, "learn", lambda *_: pytest.fail("It has been trained."))
    run_main(monkeypatch, reproduce, *arguments)


def test_balance_cuts_the_graph_between_horizons_and_at_a_reset_and_lets_some_go_on():
    torch.manual_seed(0)
    place = elsewhere.Balance(0, 16)
    actions = torch.zeros(16, 6, requires_grad=True)
    end = place.env.step(place.starts().set("action", actions))["next"]
    gradient = torch.autograd.grad(end["observation"].sum(), actions, retain_graph=True)[0]
    assert (gradient != 0).any(0).all(), "each agent is moved by its own action"
    start = place.go_on(end.detach())
    assert not any(entry.requires_grad for entry in start.values(True, True))
    assert 0 < (start["observation"] == end["observation"]).all(-1).sum() < 16
    place = elsewhere.Balance(0, 4)
    carry, scenario = place.starts(), place.env.base_env.scenario
    scenario.package.set_pos(torch.tensor([0.0, -2.0]), batch_index=0)  # one ball lies on the floor
    rollout, carry = differentiable_rollout(place.env, make_actor(place.env), carry, 1)
    assert rollout["next", "done"].flatten().tolist() == [True, False, False, False]
    assert rollout["next", "observation"].requires_grad
    assert not any(entry.requires_grad for entry in carry.values(True, True))


def test_the_gradients_of_every_method_are_compared_with_the_simulator(launch, no_pictures, monkeypatch, tmp_path):
    quick = [*running.QUICK, "total_steps=16", "env.max_episode_steps=8"]
    folders = {"abpt": "hovering/abpt-critic/seed0", "shac": "hovering/shac/seed0", "bptt": "elsewhere"}
    for algorithm, folder in folders.items():
        launch(algorithm, *quick, f"hydra.run.dir={tmp_path / folder}")
    checkpoints = [tmp_path / folder / "checkpoint.pt" for folder in folders.values()]
    ascent = "ascent --states 2 --repeats 2 --steps 4 --data", tmp_path
    for some in (checkpoints[:1], checkpoints):
        run_main(monkeypatch, reproduce, *ascent, *some)
    rows = read_rows(tmp_path / "ascent.csv")
    assert [row["variant"] for row in rows] == ["abpt-critic", "shac", "bptt"]  # by the folder, or by the method
    assert all(-1.0 <= float(row["objective"]) <= 1.0 for row in rows)
    assert [bool(row["zero_step_return"]) for row in rows] == [True, False, False]
    launch("ppo", *quick, "batch_size=8", f"hydra.run.dir={tmp_path}/ppo")
    with pytest.raises(SystemExit, match="was trained with ppo; choose runs of bptt, abpt, shac"):
        run_main(monkeypatch, reproduce, *ascent, tmp_path / "ppo/checkpoint.pt")


def test_backpropagation_through_all_steps_knows_the_true_slopes():
    weights = {"velocity": 0.0, "angular_velocity": 0.0}  # norms that have a kink where the drone rests
    smooth = make_env("hovering", num_envs=16, seed=0, dtype=torch.float64, weights=weights)
    loss = BPTTLoss(make_actor(smooth, scale_init=1e-4)).make_value_estimator(gamma=0.9)
    start = smooth.reset()
    rollout, _ = differentiable_rollout(smooth, loss.actor_network, start, 20)
    estimated = gradients.estimates(loss, rollout)["objective"]
    true = gradients.slopes(smooth, loss, start, rollout["action"][:, 0].detach(), steps=20, size=1e-3)
    assert torch.nn.functional.cosine_similarity(estimated, true, dim=-1).min() > 0.99
    torch.testing.assert_close(estimated.norm(), true.norm(), rtol=0.02, atol=0.0)
