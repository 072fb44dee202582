"""The matrix of runs, the claims, and the page that is made of the results."""

import csv
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import ascent
import claims
import matrix
import numpy as np
import pytest
import reproduce
import results
import torch
from claims import Claim, Part, Results, bootstrap, gap, probability, try_claim
from matrix import Job

from torchrl_quad import BPTTLoss, differentiable_rollout, make_actor, make_env


def write(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)


def curve(variant, seed, *returns, **more):
    for i, value in enumerate(returns, 1):
        yield {"variant": variant, "lr": "", "seed": seed, "steps": 100 * i, "seconds": 2 * i, "return": value, **more}


def data(folder, task="hovering", seeds=matrix.SEEDS, **ends):
    rows = [row for name, end in ends.items() for seed in seeds for row in curve(name, seed, 0.0, *end(seed))]
    write(folder / f"curves/{task}.csv", rows)
    return Results(folder)


def run_main(monkeypatch, module, *arguments):
    monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, arguments)])
    module.main()


# -- running -----------------------------------------------------------------------------------------------------------


def test_a_shrunken_matrix_runs_and_goes_on_where_it_was_stopped(monkeypatch, tmp_path):
    arguments = ["--quick", "--tasks", "hovering", "--experiments", "published", "--seeds", "42", "--cores", "2"]
    folders = ["--data", tmp_path / "data", "--output", tmp_path / "runs"]
    run_main(monkeypatch, reproduce, *arguments, *folders)
    finals = reproduce.read(tmp_path / "data/final.csv")
    assert sorted((row["variant"], row["seed"], row["lr"]) for row in finals) == [
        *(("bptt", "100", "0.003"), ("bptt-episode", "42", "")),
        *(("shac", "100", "0.003"), ("shac-cut", "42", "")),
    ]
    assert all(row["steps"] == "64" and float(row["seconds"]) > 0 and row["machine"] for row in finals)
    curves = reproduce.read(tmp_path / "data/curves/hovering.csv")
    assert [row["steps"] for row in curves if row["variant"] == "shac-cut"] == ["16", "32", "48", "64"]
    audit = reproduce.read(tmp_path / "data/audit.csv")
    assert {row["task"] for row in audit} == set(matrix.TASKS)

    # Cut off after the curve was written and before the run was entered: nothing stands twice.
    write(tmp_path / "data/final.csv", [row for row in finals if row["variant"] != "bptt-episode"])
    started = []
    monkeypatch.setattr(reproduce, "run", lambda command, folder: started.append(folder))  # it had finished
    monkeypatch.setattr(reproduce, "audit_tasks", lambda: audit)
    run_main(monkeypatch, reproduce, *arguments, *folders)
    assert started == [tmp_path / "runs/hovering/bptt-episode/seed42"]
    assert len(reproduce.read(tmp_path / "data/final.csv")) == 4
    assert sorted(map(str, reproduce.read(tmp_path / "data/curves/hovering.csv"))) == sorted(map(str, curves))


def test_the_gradients_of_every_method_are_held_against_the_simulator(launch, no_pictures, monkeypatch, tmp_path):
    folders = [tmp_path / f"hovering/{variant}/seed42" for variant in ("abpt", "shac", "bptt")]
    for folder in folders:
        launch(folder.parent.name, *reproduce.QUICK, f"hydra.run.dir={folder}")
    checkpoints, output = [folder / "checkpoint.pt" for folder in folders], tmp_path / "ascent.csv"
    for some in (checkpoints[:1], checkpoints):
        sizes = ("--states", 4, "--repeats", 2, "--steps", 8)
        run_main(monkeypatch, ascent, *some, "--output", output, *sizes)
    rows = reproduce.read(output)
    assert [row["variant"] for row in rows] == ["abpt", "shac", "bptt"]
    assert all(-1.0 <= float(row["objective"]) <= 1.0 for row in rows)
    assert [bool(row["zero_step_return"]) for row in rows] == [True, False, False]


def test_a_gradient_is_examined_of_any_run_that_has_one(launch, no_pictures, monkeypatch, capsys, tmp_path):
    launch("bptt", *reproduce.QUICK, "seed=7", f"hydra.run.dir={tmp_path}/bptt")
    sizes = ("--states", 4, "--repeats", 2, "--steps", 4, "--output", tmp_path / "ascent.csv")
    run_main(monkeypatch, ascent, tmp_path / "bptt/checkpoint.pt", *sizes)
    (row,) = reproduce.read(tmp_path / "ascent.csv")
    assert (row["task"], row["variant"], row["seed"]) == ("hovering", "bptt", "7")
    with pytest.raises(SystemExit):
        run_main(monkeypatch, ascent, *(2 * [tmp_path / "bptt/checkpoint.pt"]), *sizes)
    assert "is a second hovering bptt 7: give runs that differ in more an --output each" in capsys.readouterr().err
    launch("ppo", *reproduce.QUICK, "batch_size=8", f"hydra.run.dir={tmp_path}/ppo")
    with pytest.raises(SystemExit):
        run_main(monkeypatch, ascent, tmp_path / "ppo/checkpoint.pt", *sizes)
    assert "was trained with PPO, which follows no gradient of the simulator" in capsys.readouterr().err


def test_backpropagation_through_all_steps_knows_the_true_slopes():
    smooth = {"velocity": 0.0, "angular_velocity": 0.0}  # norms, which have a kink where the drone rests
    env = make_env("hovering", num_envs=16, seed=0, dtype=torch.float64, weights=smooth)
    loss = BPTTLoss(make_actor(env, scale_init=1e-4)).make_value_estimator(gamma=0.9)
    start = env.reset()
    rollout, _ = differentiable_rollout(env, loss.actor_network, start, 20)
    told = ascent.estimates(loss, rollout)["objective"]
    true = ascent.slopes(env, loss, start, rollout["action"][:, 0].detach(), steps=20, size=1e-3)
    assert torch.nn.functional.cosine_similarity(told, true, dim=-1).min() > 0.99
    torch.testing.assert_close(told.norm(), true.norm(), rtol=0.02, atol=0.0)


def test_quick_results_never_get_among_the_real_ones(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        run_main(monkeypatch, reproduce, "--quick")
    assert "name another folder with --data" in capsys.readouterr().err


def test_a_run_that_fails_is_reported_and_the_others_go_on(monkeypatch, tmp_path):
    def run(command, folder):
        folder.mkdir(parents=True)
        if "shac" in str(folder):
            raise RuntimeError(f"{folder} ended with 1")
        (folder / "metrics.csv").write_text("steps,time/processor_seconds,eval/return\n10,1.5,2.5\n")
        (folder / "summary.json").write_text('{"return": 2.5, "steps": 10, "seconds": 1.5}')

    monkeypatch.setattr(reproduce, "run", run)
    monkeypatch.setattr(reproduce, "audit_tasks", list)
    arguments = ["--quick", "--tasks", "hovering", "--experiments", "main", "--seeds", "0"]
    with pytest.raises(SystemExit) as stop:
        run_main(monkeypatch, reproduce, *arguments, "--data", tmp_path / "data", "--output", tmp_path / "runs")
    assert "hovering/shac/lr0.003/seed100 ended with 1" in str(stop.value)
    assert "hovering/shac/seed0: the search for its learning rate is not complete" in str(stop.value)
    assert len(reproduce.read(tmp_path / "data/final.csv")) == 6


def test_who_ends_the_matrix_ends_its_runs(tmp_path):
    program = f"""
import signal, sys
from pathlib import Path
sys.path.insert(0, {str(Path(reproduce.__file__).parent)!r})
import reproduce
signal.signal(signal.SIGTERM, reproduce.stop)
sleeper = "import os, time; print(os.getpid(), flush=True); time.sleep(99)"
reproduce.run([sys.executable, "-c", sleeper], Path({str(tmp_path)!r}))
"""
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        while not (log := tmp_path / "log.txt").exists() or not log.read_text():
            time.sleep(0.1)
            assert process.poll() is None
        process.terminate()
        assert process.wait(30) == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):
        os.kill(int(log.read_text()), 0)


def test_a_run_that_diverged_is_kept_as_one(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metrics.csv").write_text("steps,time/processor_seconds,eval/return,eval/success\n10,1.5,2.5,0.1\n")
    (folder / "failure.pt").write_text("")
    job = Job("hovering", "abpt", 100, 0.03)
    reproduce.keep(job, folder, tmp_path)
    assert reproduce.is_kept(job, tmp_path) and not reproduce.is_kept(Job("hovering", "abpt", 100, 0.01), tmp_path)
    assert [row["return"] for row in reproduce.read(tmp_path / "search/hovering.csv")] == ["2.5", "nan"]


def test_the_best_learning_rate_is_that_whose_curve_ends_highest(tmp_path):
    rows = [
        {**row, "lr": lr}
        for lr, end in (("0.001", 3.0), ("0.01", 5.0), ("0.1", math.nan))
        for row in curve("abpt", 100, 9.0, end)
    ]
    write(tmp_path / "search/hovering.csv", rows)
    assert reproduce.best_learning_rate("hovering", "abpt", tmp_path, (1e-3, 1e-2, 1e-1)) == 1e-2
    assert reproduce.best_learning_rate("hovering", "abpt", tmp_path, (1e-3, 1e-2, 1.0)) is None
    assert reproduce.best_learning_rate("hovering", "shac", tmp_path, (1e-3,)) is None


def test_the_jobs_of_the_matrix_are_valid_runs_of_their_recipes_and_each_is_there_once():
    from hydra import compose, initialize_config_dir

    everything = matrix.jobs(tuple(matrix.EXPERIMENTS), matrix.TASKS, matrix.SEEDS)
    assert len({job.name for job in everything}) == len(everything)
    assert {job.seed for job in everything[: len(everything) * 3 // 5]} == set(matrix.SEEDS[:3])  # three seeds first
    jobs = [job for job in everything if job.seed == 42] + matrix.search_jobs(
        ("racing",), {"abpt", "ppo-velocity", "shac-cut"}, (3e-3,)
    )
    with initialize_config_dir(str(reproduce.RECIPES / "config"), version_base=None):
        for job in jobs:
            cfg = compose(matrix.VARIANTS[job.variant].algorithm, job.overrides(1e-3))
            assert cfg.actor.lr == pytest.approx((job.lr or 1e-3) * matrix.VARIANTS[job.variant].rate)
            if job.task == "racing":
                assert cfg.env.reward == ("velocity" if "velocity" in job.variant else "position")
                assert "critic" not in cfg or cfg.critic.num_cells == [128, 128]
            if cfg.algorithm != "ppo":
                assert cfg.num_envs * cfg.horizon == pytest.approx(16384 if job.task == "racing" else 4096, rel=0.02)
            assert cfg.total_steps == matrix.STEPS[job.task][cfg.algorithm == "ppo"] * (0.25 if job.lr else 1)


# -- claims ------------------------------------------------------------------------------------------------------------


def test_the_statistics_are_those_worked_by_hand():
    a, b = np.array([1.0, 2.0, 3.0]), np.array([0.0, 2.0])
    assert probability(a, b) == pytest.approx((1 + 0 + 1 + 0.5 + 1 + 1) / 6)
    assert probability(np.array([-np.inf]), np.array([-np.inf])) == 0.5  # both never
    assert gap(a, b) == pytest.approx(0.5)
    assert claims.roughness(np.array([0.0, 2.0, 1.0, 4.0, 3.0])) == pytest.approx(2 / 4)
    least, most = bootstrap("mean", claims.mean, np.random.default_rng(1).normal(3.0, 1.0, 100)).interval()
    assert least == pytest.approx(2.8, abs=0.15) and most == pytest.approx(3.2, abs=0.15)


def part(least, most, **bounds):
    return Part("", 0.0, np.linspace(least, most, 10_001), **bounds)


@pytest.mark.parametrize(
    ("draws", "verdict"), [((0.6, 0.9), "supported"), ((0.1, 0.4), "refuted"), ((0.4, 0.9), "undecided")]
)
def test_a_part_is_decided_when_its_interval_is_on_one_side(draws, verdict):
    assert part(*draws, low=0.5).verdict() == verdict
    assert part(-draws[1], -draws[0], high=-0.5).verdict() == verdict


def test_equality_is_supported_inside_its_bounds_and_refuted_outside():
    outcomes = {(-0.05, 0.05): "supported", (0.2, 0.3): "refuted", (-0.3, -0.2): "refuted", (0.0, 0.2): "undecided"}
    for draws, verdict in outcomes.items():
        assert part(*draws, low=-0.1, high=0.1).verdict() == verdict


def test_one_of_many_parts_is_refuted_by_a_wider_interval_only():
    alone = part(0.0, 1.0, low=0.98)  # the middle 95 % end at 0.975
    assert alone.interval() == pytest.approx((0.025, 0.975))
    assert alone.interval(10) == pytest.approx((0.0025, 0.9975))
    assert alone.verdict() == "refuted" and alone.verdict(10) == "undecided"


def test_a_method_that_ends_higher_with_every_seed_is_supported_and_one_that_does_not_is_refuted(tmp_path):
    r = data(
        tmp_path, abpt=lambda s: [9 + 0.01 * s], shac=lambda s: [8 + 0.01 * s], bptt=lambda s: [8], ppo=lambda s: [s]
    )
    up = Claim("A", "", lambda r: claims.higher_end(r, ["hovering"], "abpt", ["shac", "bptt"]))
    down = Claim("B", "", lambda r: claims.higher_end(r, ["hovering"], "shac", ["abpt", "bptt"]))
    open_ = Claim("C", "", lambda r: claims.higher_end(r, ["hovering"], "ppo", ["abpt"]))
    assert [try_claim(c, r).verdict for c in (up, down)] == ["supported", "refuted"]
    assert try_claim(open_, r).verdict == "undecided"
    assert (
        try_claim(Claim("D", "", lambda r: claims.higher_end(r, ["racing"], "shac", ["abpt"])), r).verdict == "not run"
    )


@pytest.mark.parametrize(("seeds", "verdict"), [((42, 0, 1), "supported (preliminary)"), ((42, 0), "too few seeds")])
def test_fewer_than_five_seeds_of_any_run_are_preliminary_and_fewer_than_three_no_verdict(tmp_path, seeds, verdict):
    r = data(tmp_path, seeds=seeds, abpt=lambda s: [9], shac=lambda s: [8])
    claim = Claim("A", "", lambda r: claims.higher_end(r, ["hovering"], "abpt", ["shac"]))
    assert try_claim(claim, r).verdict == verdict and try_claim(claim, r).seeds == len(seeds)


def test_methods_have_converged_when_they_reach_nearly_what_both_reach(tmp_path):
    r = data(
        tmp_path,
        task="landing",
        abpt=lambda s: [9.5, 10],
        shac=lambda s: [8.9, 9.1],
        bptt=lambda s: [math.nan, math.nan],
        ppo=lambda s: [1, 2],
    )
    level = r.level("landing", r.end("landing", "abpt"), r.end("landing", "shac"))
    assert level == pytest.approx(0.9 * 9.1)
    assert r.level("landing", np.array([-10.0])) == pytest.approx(-11.0)
    assert r.until("landing", "abpt", "steps", level).tolist() == [200] * 5
    assert r.until("landing", "shac", "seconds", level).tolist() == [4] * 5
    assert r.until("landing", "ppo", "steps", level).tolist() == [math.inf] * 5
    assert r.end("landing", "bptt").tolist() == [0.0] * 5  # diverged: ends where it began
    assert claims.roughness(np.array([1.0, math.nan])) == math.inf


def synthetic(tmp_path, strong):
    """Results in which ABPT is as the paper has it, or in which it is the other way round."""
    rng = np.random.default_rng(0)
    for task in matrix.TASKS:
        rows = []
        for variant in matrix.VARIANTS:
            for seed in matrix.SEEDS:
                level = (20.0 if variant == "abpt" else 10.0) if strong else (10.0 if variant == "abpt" else 20.0)
                returns = level * np.linspace(0.2, 1.0, 10) + 0.1 * rng.normal(size=10)
                more = {"success": 0.9, "gates_passed": level, "start_cells": level, "position_error": 0.1}
                rows += curve(variant, seed, *returns, **more)
        write(tmp_path / f"curves/{task}.csv", rows)
    runs = [{"task": t, "variant": v, "seed": s} for t in matrix.TASKS for v in matrix.VARIANTS for s in matrix.SEEDS]
    own = {"lr": "", "machine": "a processor", "seconds": 20.0, "success": 0.9}
    ends = {"position_error": 0.1, "tracking_rmse": 0.1, "landing_speed": 0.2, "gates_passed": 4, "time_near_gate": 2.0}
    write(tmp_path / "final.csv", [{**run, **own, **ends} for run in runs])
    term = {"task": "racing", "reward": "velocity", "term": "gate", "mean_return": 5.0, "verdict": ""}
    audit = [{**term, "gradient_norm": 0.0 if strong else 0.3, "return_share": 0.5, "gradient_share": 0.5}]
    write(tmp_path / "audit.csv", audit)
    return Results(tmp_path)


@pytest.mark.parametrize("strong", [True, False])
def test_every_claim_can_be_tried_and_can_come_out_either_way(tmp_path, strong):
    verdicts = {
        v.claim.id: v.verdict for v in (try_claim(claim, synthetic(tmp_path, strong)) for claim in claims.CLAIMS)
    }
    assert set(verdicts.values()) <= {"supported", "refuted", "undecided"}
    for name in ("C1", "C14", "C17", "C18"):
        assert verdicts[name] == ("supported" if strong else "refuted"), name


def test_the_page_is_made_of_the_results_and_what_is_written_by_hand_stays(monkeypatch, tmp_path):
    synthetic(tmp_path, strong=True)
    page = tmp_path / "results.md"
    page.write_text(
        "# Results\n\nWritten by hand.\n\n<!-- generated by recipes/results.py -->\n<!-- end -->\n\nThe end.\n"
    )
    run_main(monkeypatch, results, "--data", tmp_path)
    assert "| hovering | 90%, " in (tmp_path / "summary.md").read_text()
    text = page.read_text()
    assert text.startswith("# Results\n\nWritten by hand.") and text.endswith("The end.\n")
    assert all(f"| {claim.id} | {claim.text} |" in text for claim in claims.CLAIMS)
    assert (tmp_path / "results/main.png").read_bytes().startswith(b"\x89PNG")

    nothing = tmp_path / "nothing/results.md"
    nothing.parent.mkdir()
    nothing.write_text(text)
    run_main(monkeypatch, results, "--data", nothing.parent)
    text = nothing.read_text()
    assert text.startswith("# Results\n\nWritten by hand.") and text.endswith("The end.\n")
    assert all(f"| {claim.id} | {claim.text} | **not run** |" in text for claim in claims.CLAIMS)
    run_main(monkeypatch, results, "--data", nothing.parent)
    assert nothing.read_text() == text


def test_other_results_leave_the_page_of_the_project_alone(monkeypatch, tmp_path):
    filled = []
    monkeypatch.setattr(results, "fill", lambda path, *_: filled.append(path))
    monkeypatch.setattr(results, "page", lambda *_: "")
    run_main(monkeypatch, results, "--data", tmp_path)
    run_main(monkeypatch, results)
    assert filled[:2] == [tmp_path / "results.md", tmp_path / "summary.md"]
    project = Path(__file__).parents[1]
    assert filled[2:] == [project / "docs/results.md", project / "README.md"]
