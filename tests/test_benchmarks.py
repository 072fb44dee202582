"""Every benchmark runs, on a reduced budget, and says what it has measured."""

import functools
import importlib
import math
import platform
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers import cases, refuses

from torchrl_quad.files import machine, read_rows

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
ONE = "--seeds 0 --iterations 1"
THEIRS = pytest.mark.skipif(find_spec("l2f") is None, reason="pip install l2f foundation-policy")
SMALL = "num_envs=4 horizon=4 env.max_episode_steps=20 compile=false"


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs a benchmark in this process, where it starts quicker; gives its rows. ``change`` sees the module before."""

    def run(name, arguments, change=lambda module: None):
        output = tmp_path / "results.csv"
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("OMP_NUM_THREADS", "1")
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments.split(), "--output", str(output)])
        module = importlib.import_module(f"benchmarks.{name}")
        change(module)
        module.main()
        rows = read_rows(output)
        assert all(row["machine"] and row["torch"] for row in rows)
        return rows

    return run


@cases(
    ("throughput", "--num-envs 4 --modes eager --horizon 2 --rounds 1", 9),
    ("memory", "--num-envs 4 --modes eager --horizon 2 --rounds 1", 1),
    pytest.param("camera", "--primitives 2 --scenes trees --images 2x4x3 --rounds 1", 1, marks=pytest.mark.slow),
    ("racing", f"--tracks visfly --steps 16 --episodes 2 --cores 1 --runs runs --overrides {SMALL}", 1),
    ("any_drone", f"--policies windy informed --drones any mujoco --episodes 2 --overrides total_steps=16 {SMALL}", 16),
    pytest.param("any_drone", "--policies raptor --drones l2f --episodes 2", 1, marks=THEIRS),
    ("time_to_solve", f"--algorithms bptt --modes eager --overrides {SMALL} total_steps=16", 1),
    ("profile_recipes", f"--algorithms bptt --iterations 2 --skip 1 --overrides {SMALL}", 1),
    pytest.param("identification", "--seeds 1 --seconds 10", 10, marks=pytest.mark.slow),  # it simulates a flight
    ("real_flights", "--flights flights --network-steps 2 --folder fits", 24),
    ("identified_training", f"{ONE} --drones before=visfly --judge crazyflie --tasks hovering --no-compile", 2),
)
@pytest.mark.usefixtures("quick_fits")
def test_a_benchmark_writes_a_table(name, arguments, rows, run, run_here, tmp_path, monkeypatch):
    (tmp_path / "flights").mkdir()
    for flight in ("circle", "figure8"):  # one to fit, and one that judges
        (tmp_path / f"flights/{flight}.csv.gz").symlink_to(BENCHMARKS.parent / "examples/data/figure8.csv.gz")

    def quicker(module):
        if hasattr(module, "identify") and name != "identification":  # whose guess is 30 % off: it has to converge
            quick = functools.partial(module.identify, fields=["linear_drag"], iterations=1, draws=2)
            monkeypatch.setattr(module, "identify", quick)
        monkeypatch.setattr(module, "STEPS", 4, raising=False)
        if name in ("racing", "any_drone"):
            monkeypatch.setattr(module, "run", run_here)

    assert len(run(name, arguments, quicker)) == rows


def test_the_benchmark_of_exported_policies_writes_a_table(run, monkeypatch, trace_once):
    def shorter(module):
        trace_once("racing")
        monkeypatch.setattr(module, "make_env", functools.partial(module.make_env, max_episode_steps=40))

    rows = run("deployment", "--checkpoints racing --observations 20 --calls 2", shorter)
    assert [row["normalizer"] for row in rows] == ["False", "True"]
    assert all(float(row[pair]) <= 1e-5 for row in rows for pair in ("torch - ONNX", "torch - C", "ONNX - C"))


def test_the_benchmark_of_a_gpu_runs_on_the_cpu_writes_each_row_and_names_what_failed(run, monkeypatch):
    commands, saved = [], []

    def without_processes(module):
        save, ended = module.save, SimpleNamespace(returncode=1, stderr="Error: it failed.")
        monkeypatch.setattr(
            module, "save", lambda path, rows, **about: [saved.append(len(rows)), save(path, rows, **about)]
        )
        monkeypatch.setattr(module, "in_own_process", lambda check: check())
        monkeypatch.setattr(module, "solve", lambda *arguments: None)
        own = SimpleNamespace(run=lambda command, **options: [commands.append(command), ended][1])
        monkeypatch.setattr(module, "subprocess", own)  # not that of everybody: h5py's import asks it, too

    small = "--device cpu --num-envs 2 4 --modes eager --check-envs 2 --horizon 2 --seconds"
    with pytest.raises(SystemExit, match=r"Not ok: checkpoint to CPU, hovering solved\."):
        run("gpu", f"{small} 480", without_processes)
    rows = read_rows(Path("results.csv"))
    assert [row["result"] for row in rows] == ["ok", "Error: it failed.", "not solved"] + ["ok"] * 4
    assert saved == list(range(1, 8)) and float(rows[0]["gradients"]) == 0 and "device=cpu" in commands[0]
    assert all(0 < float(row["forward, of bound"]) < 1 for row in rows if row["check"].startswith("speed"))
    with pytest.raises(SystemExit):
        run("gpu", f"{small} 0", without_processes)
    late = [row["result"] for row in read_rows(Path("results.csv")) if row["check"].startswith("speed")]
    assert late == ["no time left"] * 4


@cases(("exit('Error: no.')", "1: Error: no."), ("import os; os._exit(3)", "3: "))
def test_a_recipe_that_fails_is_not_one_that_never_solves(program, said, monkeypatch, tmp_path):
    module = importlib.import_module("benchmarks.time_to_solve")
    monkeypatch.setattr(module, "RECIPES", tmp_path)
    (tmp_path / "bptt.py").write_text(program)
    refuses(f"^bptt ended with {said}$", module.solve, "bptt", 0, [], tmp_path, error=RuntimeError)
    (tmp_path / "bptt.py").write_text("")
    assert module.solve("bptt", 0, [], tmp_path) is None


def test_the_benchmark_of_controllers_writes_a_table(run, monkeypatch):
    eager = functools.partial(monkeypatch.setattr, name="has_compiler", value=lambda: False)
    rows = run("controllers", "--tasks hovering --starts 2 --steps 2 --calls 1", eager)
    assert [row["policy"] for row in rows] == ["geometric", "mpc"]
    assert importlib.import_module("benchmarks.controllers").table(rows).count("\n") == 3


def test_the_least_time_of_a_point_mass_is_the_one_worked_by_hand_and_below_every_lap_that_was_flown():
    least_time = importlib.import_module("benchmarks.lap_bound").least_time
    ends, ball = torch.tensor([[0.0, 0, 0], [3, 0, 0]]).double(), 0.5 * torch.eye(3).double().repeat(2, 1, 1)
    straight = least_time(ends, 0.0 * ball, is_closed=False, thrust=20.0, gravity=10.0)
    assert straight == pytest.approx(math.sqrt(2 * 3 / math.sqrt(20**2 - 10**2)), rel=1e-5)
    lap = least_time(ends, ball, is_round=True, thrust=20.0, gravity=0.0)  # 2 m there and back: full thrust both ways
    assert lap == pytest.approx(4 * math.sqrt(2 / 20), rel=1e-5)
    t = least_time(ends, 0.0 * ball, is_closed=False, thrust=20.0, gravity=0.0, drag=(2.0, 2.0, 0.0))
    assert 20 / 2 * t - 20 / 2**2 * (1 - math.exp(-2 * t)) == pytest.approx(3.0, rel=1e-4)
    assert all(float(row["least_ratio"]) > 1.0 for row in read_rows(BENCHMARKS / "results/racing.csv"))


def test_the_results_that_are_published_name_their_machine():
    published = list((BENCHMARKS / "results").glob("*.csv"))
    programs = {path.stem.removesuffix("_recipes") for path in BENCHMARKS.glob("*.py")}
    programs -= {"laps", "lap_bound", "pilots", "report"}
    assert {path.stem for path in published} == programs | {"transfer"}
    for path in published:
        assert all(row["machine"] for row in read_rows(path))


def test_a_processor_is_named_with_its_generation_and_without_linux_by_what_python_knows(monkeypatch):
    said = "processor\t: 0\ncpu family\t: 25\nmodel\t\t: 17\nmodel name\t: AMD EPYC\npower management:\n"
    monkeypatch.setattr(Path, "read_text", lambda path: said)
    assert machine() == "AMD EPYC (25-17)"
    monkeypatch.setattr(Path, "read_text", lambda path: "processor\t: 0\nmodel name\t: ARMv7 rev 4\n")
    assert machine() == "ARMv7 rev 4"
    monkeypatch.setattr(Path, "read_text", lambda path: "Processor\t: ARMv7\n")
    assert machine() == (platform.processor() or platform.machine())
