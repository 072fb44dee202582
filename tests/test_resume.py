"""A run that was stopped goes on as if it had not been."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from refusals import cases
from small_runs import EVERYTHING, SMALL, assert_equal, rows, stop_at_save

from torchrl_quad.training import loop
from torchrl_quad.training.checkpoints import read_checkpoint

ROOT = Path(__file__).parent.parent
ENTROPY = ["loss.alpha=auto", "loss.clip_action_gradient=3"]
SEEING = [  # and remembering: a memory, images on their way, and noise that goes on
    *("task=forest", "env.density=0.02", "env.camera.width=6", "env.camera.height=4", "+env.camera.rate=2"),
    *("+env.camera.delay=1", "+env.camera.noise=0.02", "actor.noise_correlation=0.9"),
]


@cases(
    *((recipe, [*EVERYTHING, *ENTROPY]) for recipe in ("abpt", "ahac", "shac", "sapo")),
    *((recipe, EVERYTHING) for recipe in ("hybrid", "ppo")),
    ("bptt", [*SEEING, *ENTROPY]),
)
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not(recipe, options, train, refused, tmp_path, monkeypatch):
    short = "total_steps=96"
    straight = train(recipe, tmp_path / "straight", short, *options)
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        stop_at_save(patch, 2)
        said = refused(recipe, *SMALL, short, f"hydra.run.dir={folder}", *options, status=130)
    assert said.startswith("Stopped. Continue with: python ")
    assert said.endswith(f"recipes/{recipe}.py resume={folder}/checkpoint.pt")
    assert [row["iteration"] for row in rows(folder)] == ["2", "4"]  # and a checkpoint at 2
    torch.manual_seed(77)
    resumed = train(recipe, folder, short, f"resume={folder}/checkpoint.pt")

    assert_equal(straight, resumed)
    assert rows(tmp_path / "straight") == rows(folder)
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("straight", "stopped")]
    for summary in summaries:
        assert summary.pop("seconds") > 0 and summary.pop("revision")
    assert summaries[0] == summaries[1]
    if recipe == "abpt":  # no memory that was never written
        assert {len(x) for x in straight["processes"][0]["buffer"]["states"].values()} == {96}


KILLED = """
import os, runpy, signal, sys
from torchrl_quad.training.loop import Run

def save(self, path, save=Run._save, saves=[]):
    saves.append(path)
    if len(saves) == 2:  # metrics.csv has the row already
        os.kill(os.getpid(), signal.SIGKILL)
    save(self, path)

Run._save = save
runpy.run_path("recipes/abpt.py", run_name="__main__")
"""


def test_a_run_that_was_killed_goes_on_from_its_last_checkpoint_although_it_left_its_lock(train, tmp_path):
    options = ["buffer.capacity=24", "total_steps=72", "eval.interval=1"]
    straight = train("abpt", tmp_path / "straight", *options)
    folder = tmp_path / "killed"
    command = [sys.executable, "-c", KILLED, *SMALL, *options, f"hydra.run.dir={folder}"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            said = process.communicate(timeout=120)[1]
        finally:
            process.kill()
    assert process.returncode == -signal.SIGKILL, said
    assert read_checkpoint(folder / "checkpoint.pt")["iteration"] == 1
    assert [row["iteration"] for row in rows(folder)] == ["1", "2"]
    assert f"process {process.pid} on" in (folder / "run.lock").read_text()
    assert_equal(straight, train("abpt", folder, *options, "resume=auto"))
    assert rows(folder) == rows(tmp_path / "straight") and not (folder / "run.lock").exists()


def test_resume_auto_starts_goes_on_and_leaves_alone_what_is_finished(train, launch, tmp_path, monkeypatch):
    first = train("bptt", tmp_path, "resume=auto")
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    printed = launch("bptt", *SMALL, f"hydra.run.dir={tmp_path}", "resume=auto")
    assert printed == f"Finished before: {tmp_path}\n"
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    (tmp_path / "summary.json").unlink()  # stopped within the final evaluation
    train("bptt", tmp_path, "resume=auto")
    assert (tmp_path / "summary.json").exists()

    monkeypatch.setattr(loop, "revision", lambda: "another")
    with monkeypatch.context() as patch:  # made longer, and killed after the last checkpoint
        patch.setattr(loop.Run, "_finish", lambda self: None)
        longer = train("bptt", tmp_path, "resume=auto", "total_steps=240")
    assert not (tmp_path / "summary.json").exists()
    assert longer["iteration"] == 10 and len(rows(tmp_path)) == 5
    assert longer["stateful"][1]["param_groups"][0]["lr"] == pytest.approx(2e-4)  # the schedule has stretched
    assert longer["revision"] == f"{first['revision']}, then another"
    train("bptt", tmp_path, "resume=auto", "total_steps=240")
    assert json.loads((tmp_path / "summary.json").read_text())["steps"] == 240


def test_what_the_command_line_says_must_agree_with_the_checkpoint(train, refused, tmp_path):
    train("bptt", tmp_path)
    small = [*SMALL, f"hydra.run.dir={tmp_path}"]
    said = refused("bptt", *small)
    assert f"{tmp_path} holds another run. Continue with it, resume={tmp_path}/checkpoint.pt, or choose another" in said
    for words, message in {
        "bptt env.drone=small_racer": "env.drone=small_racer contradicts the checkpoint .*trained with env.drone=visf",
        "bptt tuned=bptt_racing": "num_envs=.* contradicts the checkpoint",
        "bptt algorithm=shac": "algorithm=shac: this recipe is bptt",
        "shac": "algorithm=shac contradicts the checkpoint .*trained with algorithm=bptt",
    }.items():
        recipe, *changes = words.split()
        assert re.search(message, refused(recipe, *small, "resume=auto", *changes))


def test_a_run_that_is_resumed_by_path_goes_on_in_the_folder_of_its_checkpoint(train, launch, refused, tmp_path):
    saved, path = train("bptt", tmp_path / "first"), tmp_path / "first/checkpoint.pt"
    said = refused("bptt", f"resume={path}", "total_steps=240", f"hydra.run.dir={tmp_path}/elsewhere")
    assert f"hydra.run.dir={tmp_path}/elsewhere has no effect: resume={path} continues in the folder of that" in said
    launch("bptt", f"resume={path}", "total_steps=240")
    assert (saved["iteration"], read_checkpoint(path)["iteration"]) == (8, 10)
    assert not (tmp_path / "elsewhere").exists()
