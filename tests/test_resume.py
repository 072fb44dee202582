"""A run has its folder alone, says how to go on, and goes on as if it had not stopped; damage is found."""

import contextlib
import errno
import fcntl
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
import yaml
from helpers import EVERYTHING, ROOT, SMALL, assert_equal, cases, refuses, rows, stop_at_save
from omegaconf import OmegaConf

from torchrl_quad import BPTTLoss
from torchrl_quad.training import loop
from torchrl_quad.training.building import average_policy
from torchrl_quad.training.checkpoints import previous, read_checkpoint, write_checkpoint
from torchrl_quad.training.launch import own_folder

ENTROPY = ["loss.alpha=auto", "loss.clip_action_gradient=3"]
SEEING = [  # and remembering: a memory, images on their way, and noise that goes on
    *("task=forest", "env.density=0.02", "env.camera.width=6", "env.camera.height=4", "+env.camera.rate=2"),
    *("+env.camera.delay=1", "+env.camera.noise=0.02", "actor.noise_correlation=0.9"),
]


@cases(
    *((recipe, [*EVERYTHING, *ENTROPY]) for recipe in ("abpt", "ahac", "shac")),  # SAPO keeps what SHAC does
    ("hybrid", EVERYTHING),
    ("train", [*(x for x in EVERYTHING if "max_kl" not in x), ENTROPY[1]]),
    ("ppo", ["normalize=true", "env.dynamics=point_mass", *EVERYTHING[-3:], "compile=true"]),  # whose step is short
    ("bptt", [*SEEING, *ENTROPY]),
)
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not(recipe, options, train, refused, tmp_path, monkeypatch):
    short = "total_steps=96"
    # What a compiler was given, without the code that it makes of that, which takes half a minute.
    monkeypatch.setattr("torch._inductor.compile_fx.compile_fx", lambda graph, *_, **__: graph.forward)
    straight = train(recipe, tmp_path / "straight", short, *options)
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        stop_at_save(patch, 2)
        said = refused(recipe, *SMALL, short, f"hydra.run.dir={folder}", *options, status=130)
    assert said.startswith("Stopped. Continue with: python ")
    assert said.endswith(f"recipes/{recipe}.py resume={folder}/checkpoint.pt")
    assert [row["iteration"] for row in rows(folder)] == ["2", "4"]  # and a checkpoint at 2
    torch.manual_seed(77)
    resumed = train(recipe, folder, short, f"resume={folder}/checkpoint.pt", *options[-1:])

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


def test_a_run_ends_when_its_evaluation_has_levelled_off_says_so_and_goes_on_with_more_patience(
    launch, no_pictures, tmp_path, monkeypatch
):
    monkeypatch.setattr(loop, "evaluate", lambda *_: ({"eval/return": 1.0, "eval/solved": 1.0}, None))
    options = [*SMALL, "horizon=2", "eval.interval=1", "total_steps=480", f"hydra.run.dir={tmp_path}", "resume=auto"]
    said = launch("bptt", *options, "eval.patience=0.5")
    assert "Stopped before total_steps, since the last evaluation that improved by 1 % was at step 8.\n" in said
    assert read_checkpoint(tmp_path / "checkpoint.pt")["iteration"] == len(rows(tmp_path)) == 22
    assert launch("bptt", *options) == f"Finished before: {tmp_path}\n"
    assert "Stopped" not in launch("bptt", *options, "eval.patience=null")
    assert len(rows(tmp_path)) == 60


def test_a_run_that_lost_a_third_of_what_it_solved_goes_back_to_its_best_policy_and_where_it_stalls_slower(
    train, launch, no_pictures, tmp_path, monkeypatch
):
    script, saved, save = [0.4, 0.1, 0.84, 0.6, 0.55, 0.8, 0.9, 0.7], {}, loop.Run._save

    def keep(self, path):
        saved[self.iteration] = save(self, path) or read_checkpoint(path)

    monkeypatch.setattr(loop.Run, "_save", keep)
    scripted = lambda *_: (dict.fromkeys(("eval/return", "eval/solved"), script[len(seen)]), seen.append(0))  # noqa: E731
    monkeypatch.setattr(loop, "evaluate", scripted)
    paces = [1, 1, 1, 2, 0.5, 0.25, 2, 0.25]
    monkeypatch.setattr(loop, "next_pace", lambda rows, since, _: paces[len(rows) - 1 if since or len(rows) < 7 else 0])
    options, seen = ["eval.interval=1", "eval.patience=0.9", "actor.average=0.5", "actor.schedule=constant"], []
    straight = train("train", tmp_path / "straight", *options)
    assert [row["train/rate"] for row in saved[8]["rows"]] == [*[1e-2] * 5, 5e-3, 1.25e-3, 2.5e-3]
    assert saved[8]["pace"] == 0.0625
    best, policy = saved[3]["stateful"], saved[3]["best"]["actor"]
    assert not torch.equal(policy[key := "module.0.module.mlp.0.weight"], best[0][f"actor_network_params.{key}"])
    best[0] |= {f"actor_network_params.{name}": x for name, x in policy.items()}  # the mean, which solved so many
    for lost in (5, 6):  # and critics, optimisers, scale, average
        assert_equal(saved[lost]["stateful"], best)
    seen = []
    with monkeypatch.context() as patch:
        stop_at_save(patch, 6)
        with pytest.raises(SystemExit):
            train("train", tmp_path / "stopped", *options)
    seen.pop()  # the evaluation before that checkpoint
    train("train", tmp_path / "stopped", *options, "resume=auto")
    assert_equal(straight, saved[8])


def test_a_run_goes_on_if_the_command_line_agrees_in_the_folder_of_its_checkpoint_or_of_the_one_before_a_damaged_one(
    train, launch, refused, tmp_path
):
    folder, path = tmp_path / "run", tmp_path / "run/checkpoint.pt"
    straight, small = train("bptt", folder), [*SMALL, f"hydra.run.dir={folder}"]
    said = refused("bptt", *small)
    assert f"{folder} holds another run. Continue with it, resume={path}, or choose another" in said
    for words, message in {
        "bptt env.drone=small_racer": "env.drone=small_racer contradicts the checkpoint .*trained with env.drone=visf",
        "bptt tuned=bptt_racing": "gamma=.* contradicts the checkpoint",
        "bptt algorithm=shac": "algorithm=shac: this recipe is bptt",
        "shac": "algorithm=shac contradicts the checkpoint .*trained with algorithm=bptt",
    }.items():
        recipe, *changes = words.split()
        assert re.search(message, refused(recipe, *small, "resume=auto", *changes))
    said = refused("bptt", f"resume={path}", "total_steps=240", f"hydra.run.dir={tmp_path}/elsewhere")
    assert f"hydra.run.dir={tmp_path}/elsewhere has no effect: resume={path} continues in the folder of that" in said
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)
    said = refused("bptt", *small, "resume=auto")
    assert f"{path} is damaged: its checksum does not fit its content." in said
    assert said.endswith(f"Continue from the checkpoint before it: resume={folder}/checkpoint.previous.pt")
    assert read_checkpoint(previous(path))["iteration"] == 6
    launch("bptt", f"resume={previous(path)}")
    assert read_checkpoint(path)["iteration"] == straight["iteration"] == 8
    torch.testing.assert_close(read_checkpoint(path)["best"]["actor"], straight["best"]["actor"], rtol=0, atol=0)
    assert read_checkpoint(previous(path))["iteration"] == 6  # and not the damaged one
    launch("bptt", f"resume={path}", "total_steps=240")
    assert read_checkpoint(path)["iteration"] == 10 and not (tmp_path / "elsewhere").exists()


def test_two_runs_of_one_second_get_folders_of_their_own(launch, no_pictures, tmp_path, monkeypatch):
    moment = datetime(2030, 1, 1)
    monkeypatch.setattr("hydra.core.utils.datetime", SimpleNamespace(now=lambda: moment))
    monkeypatch.chdir(tmp_path)
    hydras = tmp_path / "outputs/hovering/bptt/seed0/2030-01-01_00-00-00"
    with own_folder(hydras, named=False):  # a run that has just started
        launch("bptt", *SMALL, "actor.lr=0.01")
        launch("bptt", *SMALL, "actor.lr=0.02")
    for name, rate in (("_2", 0.01), ("_3", 0.02)):
        folder = hydras.with_name(hydras.name + name)
        checkpoint = read_checkpoint(folder / "checkpoint.pt")
        assert f"  lr: {rate}\n" in checkpoint["config"]
        assert json.loads((folder / "summary.json").read_text())["best_steps"] == checkpoint["best"]["steps"]


def test_a_proposed_folder_that_another_run_has_or_had_gets_a_number(tmp_path):
    proposed = tmp_path / "run"
    with own_folder(proposed, named=False) as first, own_folder(proposed, named=False) as second:
        assert (first.name, second.name) == ("run", "run_2")
        (first / "summary.json").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]  # the empty one is gone
    with own_folder(proposed, named=False) as third:
        assert third.name == "run_2"
    assert [path.name for path in first.iterdir()] == ["summary.json"]


def test_a_named_folder_is_refused_while_its_holder_lives_and_taken_over_when_it_is_dead(tmp_path):
    with (
        own_folder(tmp_path, named=True),
        pytest.raises(FileExistsError, match=rf"{tmp_path} is in use by process {os.getpid()} on .* since \d{{4}}-"),
        own_folder(tmp_path, named=True),
    ):
        pass
    (tmp_path / "run.lock").write_text("process 123 on another machine since 2020-01-01 00:00:00\n")
    with own_folder(tmp_path, named=True):
        assert f"process {os.getpid()}" in (tmp_path / "run.lock").read_text()
    assert not list(tmp_path.iterdir())


def test_of_many_that_want_a_folder_at_once_one_gets_it_and_without_locks_they_go_on(tmp_path, monkeypatch):
    def want(_):
        with contextlib.suppress(FileExistsError), own_folder(tmp_path, named=True):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.002)
            inside.pop()

    inside, most = [], []
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(want, range(200)))
    assert max(most) == 1
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOLCK, "No locks available")))
    with own_folder(tmp_path, named=True) as folder:
        assert folder == tmp_path


def test_ctrl_c_ends_in_one_line_that_says_how_to_go_on(tmp_path):
    script, folder = ROOT / "recipes/bptt.py", tmp_path / "run"
    command = [sys.executable, script, *SMALL, "total_steps=1_000_000", f"hydra.run.dir={folder}"]
    said, deadline = tmp_path / "said.txt", time.monotonic() + 120
    options = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}  # ignored where tests run behind "&"
    with said.open("w") as file, subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=file, **options) as run:
        try:
            while not (folder / "checkpoint.pt").exists():
                assert run.poll() is None and time.monotonic() < deadline, said.read_text()
                time.sleep(0.02)
            run.send_signal(signal.SIGINT)
            run.wait(timeout=60)
        finally:
            run.kill()
    printed = said.read_text()
    assert run.returncode == 130
    assert "Traceback" not in printed
    assert printed.splitlines()[-1] == f"Stopped. Continue with: python {script} resume={folder}/checkpoint.pt"


def test_ctrl_c_before_a_checkpoint_says_so_and_a_bug_keeps_its_traceback(
    refused, no_pictures, tmp_path, monkeypatch, launch
):
    stop_at_save(monkeypatch, 1)
    said = refused("bptt", *SMALL, f"hydra.run.dir={tmp_path}", status=130)
    assert said == "Stopped. Nothing was saved yet: the first evaluation writes a checkpoint."
    monkeypatch.setattr(BPTTLoss, "loss_actor", lambda self, rollout: {}["missing"])
    refuses("missing", launch, "bptt", *SMALL, f"hydra.run.dir={tmp_path}", error=KeyError)


def test_what_environment_and_loss_refuse_ends_in_one_line_and_leaves_no_folder(refused, launch, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert refused("bptt", *SMALL, "env.drone=hawk").startswith("Error: Unknown drone 'hawk'. Choose from: cf2p")
    assert not list(tmp_path.glob("outputs/hovering/bptt/seed0/*"))
    assert "env.curve=oval: it must be one of slow_circle" in refused("bptt", *SMALL, "task=tracking", "env.curve=oval")
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(BaseException, match="Unknown drone 'hawk'") as error:
        launch("bptt", *SMALL, "env.drone=hawk")
    assert isinstance(error.value.__cause__, ValueError)  # the traceback starts where it was raised


CONTENT = {"config": "task: hovering", "best": {"actor": {"weight": torch.ones(40, 40)}}, "version": "0.1"}


def test_no_flipped_bit_of_a_checkpoint_goes_unnoticed(tmp_path):
    path = tmp_path / "checkpoint.pt"
    write_checkpoint(path, CONTENT)
    torch.testing.assert_close(read_checkpoint(path)["best"], CONTENT["best"])
    whole, draw = path.read_bytes(), random.Random(0)
    positions = [draw.randrange(len(whole)) for _ in range(200)] + list(range(len(whole) - 110, len(whole)))
    for at in positions:
        damaged = bytearray(whole)
        damaged[at] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        refuses(r"checkpoint\.pt (is damaged|is cut off)", read_checkpoint, path)


def test_a_file_that_is_no_checkpoint_of_this_version_is_named_with_the_reason(refused, tmp_path):
    path = tmp_path / "bad.pt"

    def fails(match):
        refuses(match, read_checkpoint, path, error=(ValueError, FileNotFoundError))

    fails("No checkpoint at .*bad.pt. Train one first")
    torch.save({"weights": torch.zeros(1)}, path)
    fails("bad.pt is cut off, or no checkpoint of these recipes. There is none before it")
    write_checkpoint(path, {**CONTENT, "config": Path("anything that is pickled")})
    fails("anything else could run code, and is not loaded")
    write_checkpoint(path, {**CONTENT, "format": 2})
    fails("has checkpoint format 2, this version reads format 5. It was written by torchrl_quad 0.1 at .*:")
    assert "bad.pt has checkpoint format 2" in refused("evaluate", f"checkpoint={path}")


def test_a_full_disk_is_named_and_leaves_the_last_checkpoint_intact(refused, no_pictures, tmp_path, monkeypatch):
    small = [*SMALL, f"hydra.run.dir={tmp_path}"]
    full = OSError(errno.ENOSPC, "No space left on device", "checkpoint.pt")
    with monkeypatch.context() as patch:
        stop_at_save(patch, 1, full)
        assert "the disk is full: checkpoint.pt. Nothing was saved yet" in refused("bptt", *small)

    def write_half(path, data, write=Path.write_bytes):
        write(path, data[: len(data) // 2])
        raise full

    with monkeypatch.context() as patch:
        stop_at_save(patch, 3, full)
        said = refused("bptt", *small)
    assert "The last checkpoint is intact. Make room. Continue with: python " in said
    assert said.endswith(f"recipes/bptt.py resume={tmp_path}/checkpoint.pt")
    before = (tmp_path / "checkpoint.pt").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_half)
        assert "the disk is full" in refused("bptt", *small, "resume=auto")
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


EVIL = {  # what somebody else may have written into the configuration of a checkpoint
    "task: evilmod.Evil": "names evilmod.Evil. Code that a file names is not run",
    "env: {disturbances: [{_target_: evilmod.Evil}]}": "names evilmod.Evil. Code",
    "env: {disturbances: evilmod.Evil}": "it must be a list",
    "loss: {_target_: evilmod.Evil}": "names evilmod.Evil. Code",
    "task: 5": "is no mapping with a task",
    "task: &a hovering\ntags: [*a, *a]": "uses the alias",
    "task: ${oc.env:HOME}": "refers to other values by",
    "env: {control_dt: 1e400}": "env.control_dt",
    "env: {evil: 1}": "unexpected keyword argument 'evil'",
    "env: 5": "env=5: it must be a section",
    "num_envs: abc": "num_envs=abc: it must be a whole number",
    "algorithm: [1]": "algorithm=[1]: it must be a name",
    "[": "not a YAML file",
    "": "is no mapping with a task",
}


def write_own(path, content, **changes):
    write_checkpoint(path, {**{k: v for k, v in content.items() if k != "format"}, **changes})


def test_a_checkpoint_from_somebody_else_runs_no_code_and_is_refused_in_one_line_if_its_parts_do_not_fit(
    train, refused, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evilmod.py").write_text("open('ran', 'w')")
    saved, path = train("abpt", tmp_path / "run"), tmp_path / "run/checkpoint.pt"
    for text, message in EVIL.items():
        values = yaml.safe_load(saved["config"])
        try:
            values |= yaml.safe_load(text) or {}
        except (yaml.YAMLError, TypeError):
            values = None
        is_whole = values is None or "${" in text or "&" in text or not text
        write_own(path, saved, config=text if is_whole else yaml.safe_dump(values))
        recipes = [["evaluate", f"checkpoint={path}"], ["abpt", f"resume={path}", "total_steps=240"]]
        for recipe, *words in recipes if "evilmod" in text else recipes[:1]:
            said = refused(recipe, *words)
            assert f"{path}: the configuration in it" in said and message in said, (text, said)
    assert not (tmp_path / "ran").exists()
    weights = {name: x[:1] for name, x in saved["best"]["actor"].items()}
    for change in (
        {"best": {}},
        {"best": {**saved["best"], "actor": weights}},
        {"config": saved["config"].replace("normalize: false", "normalize: true")},
    ):
        write_own(path, saved, **change)
        said = refused("evaluate", f"checkpoint={path}")
        assert re.search(f"{path}(: the policy in it does not fit| holds no policy)", said)
    unfit = "the state of the run in it does not fit its configuration"
    for change, message in (
        ({"processes": saved["processes"] * 2}, "was written by 2 processes, and 1 want to continue"),
        ({"processes": [{}]}, unfit),
        ({"stateful": saved["stateful"][::-1]}, unfit),
        ({"rows": [{"a": "b"}]}, unfit),
    ):
        write_own(path, saved, **change)
        said = refused("abpt", f"resume={path}", "total_steps=240")
        assert str(path) in said and message in said, change


def test_the_average_of_the_policy_spans_a_share_of_the_iterations_and_is_what_a_run_keeps(train, tmp_path):
    policy = torch.nn.Linear(1, 1, bias=False)
    average = average_policy(OmegaConf.create({"actor": {"average": 0.5}}), policy)
    seen = []
    for weight in (1.0, 2.0, 3.0):
        torch.nn.init.constant_(policy.weight, weight)
        average.update_parameters(policy)
        seen.append(average.module.weight.item())
    assert seen == pytest.approx([1.0, 7 / 4, 22 / 9])  # what was before counts (1 - 1/t)^2: 0, 1/4, 4/9

    saved = train("bptt", tmp_path / "averaged", "actor.average=1", "eval.interval=8")  # a plain mean of the weights
    plain = train("bptt", tmp_path / "plain", "eval.interval=8")
    assert saved["stateful"][0].keys() == plain["stateful"][0].keys()
    for name, weight in saved["stateful"][0].items():  # which the training does not see
        torch.testing.assert_close(weight, plain["stateful"][0][name], rtol=0, atol=0)
    best, last = (x["best"]["actor"] for x in (saved, plain))
    mean = {k.removeprefix("module."): v for k, v in saved["stateful"][-1].items()}
    assert mean.pop("n_averaged") == 8
    torch.testing.assert_close(best, mean, rtol=0, atol=0)
    assert any((best[name] - last[name]).abs().max() > 1e-3 for name in best)
    assert rows(tmp_path / "averaged")[-1]["eval/return"] != rows(tmp_path / "plain")[-1]["eval/return"]
