"""The folder of a run belongs to it alone, and every run ends with an exit status and a line that says how to go on."""

import contextlib
import errno
import fcntl
import json
import os
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
from refusals import refuses
from small_runs import SMALL, stop_at_save

from torchrl_quad import BPTTLoss
from torchrl_quad.training.checkpoints import read_checkpoint
from torchrl_quad.training.launch import own_folder

ROOT = Path(__file__).parent.parent


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


def test_of_many_that_want_a_folder_at_once_one_gets_it(tmp_path):
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


def test_a_file_system_without_locks_is_no_reason_to_stop(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOLCK, "No locks available")))
    with own_folder(tmp_path, named=True) as folder:
        assert folder == tmp_path


# -- how a run ends ----------------------------------------------------------------------------------------------------


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


def test_ctrl_c_before_the_first_checkpoint_says_so(refused, no_pictures, tmp_path, monkeypatch):
    stop_at_save(monkeypatch, 1)
    said = refused("bptt", *SMALL, f"hydra.run.dir={tmp_path}", status=130)
    assert said == "Stopped. Nothing was saved yet: the first evaluation writes a checkpoint."


def test_what_environment_and_loss_refuse_ends_in_one_line_and_leaves_no_folder(refused, launch, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert refused("bptt", *SMALL, "env.drone=hawk").startswith("Error: Unknown drone 'hawk'. Choose from: crazyflie")
    assert not list(tmp_path.glob("outputs/hovering/bptt/seed0/*"))
    assert "env.curve=oval: it must be one of slow_circle" in refused("bptt", *SMALL, "task=tracking", "env.curve=oval")
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(BaseException, match="Unknown drone 'hawk'") as error:
        launch("bptt", *SMALL, "env.drone=hawk")
    assert isinstance(error.value.__cause__, ValueError)  # the traceback starts where it was raised


def test_a_bug_keeps_its_traceback(launch, no_pictures, tmp_path, monkeypatch):
    monkeypatch.setattr(BPTTLoss, "loss_actor", lambda self, rollout: {}["missing"])
    refuses("missing", launch, "bptt", *SMALL, f"hydra.run.dir={tmp_path}", error=KeyError)
