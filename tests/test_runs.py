"""What a training run saves and logs, and how it goes on: after a stop, beside others, after numbers not finite."""

import csv
import io
import json
import multiprocessing
import os
import runpy
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path

import checkpoints
import common
import pytest
import run
import torch
import yaml
from omegaconf import OmegaConf

from torchrl_quad import BPTTLoss

ROOT = Path(__file__).parent.parent
SMALL = ["num_envs=4", "horizon=6", "total_steps=192", "eval.interval=2", "env.max_episode_steps=30", "compile=false"]
EVERYTHING = [  # that draws random numbers or keeps a memory
    "normalize=true",
    "env.wind={mean: [1, 0, 0], gust: 0.5}",
    "env.observation_noise={position: 0.01}",
    "env.observation_delay=1",
    "env.randomize={mass: {scale: [0.8, 1.2]}}",
]


@pytest.fixture
def train(launch, no_pictures):
    def train(recipe, folder, *overrides):
        launch(recipe, *SMALL, f"hydra.run.dir={folder}", *overrides)
        return checkpoints.read_checkpoint(folder / "checkpoint.pt")

    return train


def rows(folder):
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]


def assert_equal(a, b, path=""):
    """Bit for bit, in all that a checkpoint holds; only the clock may differ."""
    assert type(a) is type(b), path
    if isinstance(a, dict):
        assert a.keys() == b.keys(), path
        for key in a:
            if not str(key).startswith(("time/", "seconds", "config")):
                assert_equal(a[key], b[key], f"{path}/{key}")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), path
        for i, pair in enumerate(zip(a, b, strict=True)):
            assert_equal(*pair, f"{path}/{i}")
    elif isinstance(a, torch.Tensor):
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True, msg=path)
    else:
        assert a == b or a != a, path


# -- stop and go on ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recipe", ["abpt", "bptt", "shac", "ppo"])
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not(recipe, train, tmp_path, monkeypatch):
    options = [*EVERYTHING, *([] if recipe == "ppo" else ["loss.alpha=auto"])]
    options += ["buffer.capacity=24"] if recipe == "abpt" else []  # full from the start: what is unused is arbitrary
    straight = train(recipe, tmp_path / "straight", *options)

    saves = []

    def stop_at_the_third(self, path, save=run.Run._save):
        saves.append(path)
        if len(saves) == 3:
            raise KeyboardInterrupt
        save(self, path)

    with monkeypatch.context() as patch:
        patch.setattr(run.Run, "_save", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            train(recipe, tmp_path / "stopped", *options)
    assert [row["iteration"] for row in rows(tmp_path / "stopped")] == ["2", "4", "6"]  # and a checkpoint at 4
    torch.manual_seed(77)
    resumed = train(recipe, tmp_path / "stopped", f"resume={tmp_path}/stopped/checkpoint.pt")

    assert_equal(straight, resumed)
    assert rows(tmp_path / "straight") == rows(tmp_path / "stopped")
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("straight", "stopped")]
    for summary in summaries:
        assert summary.pop("seconds") > 0
    assert summaries[0] == summaries[1]


def test_a_run_that_was_killed_goes_on_from_its_last_checkpoint(train, tmp_path):
    options = ["total_steps=480", "buffer.capacity=24"]
    straight = train("abpt", tmp_path / "straight", *options)
    folder = tmp_path / "killed"
    command = [sys.executable, "recipes/abpt.py", *SMALL, *options, f"hydra.run.dir={folder}"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        for _ in range(6000):
            if (folder / "checkpoint.pt").exists():
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert checkpoints.read_checkpoint(folder / "checkpoint.pt")["iteration"] < 20
    assert_equal(straight, train("abpt", folder, *options, "resume=auto"))
    assert rows(folder) == rows(tmp_path / "straight")


def test_resume_auto_starts_goes_on_and_leaves_alone_what_is_finished(train, launch, tmp_path):
    train("bptt", tmp_path, "resume=auto")
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    printed = launch("bptt", *SMALL, f"hydra.run.dir={tmp_path}", "resume=auto")
    assert printed == f"Finished before: {tmp_path}\n"
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    (tmp_path / "summary.json").unlink()  # stopped within the final evaluation
    train("bptt", tmp_path, "resume=auto")
    assert (tmp_path / "summary.json").exists()
    longer = train("bptt", tmp_path, "resume=auto", "total_steps=240")
    assert longer["iteration"] == 10 and len(rows(tmp_path)) == 5
    assert longer["parts"][1]["param_groups"][0]["lr"] == pytest.approx(2e-4)  # the schedule has stretched
    assert json.loads((tmp_path / "summary.json").read_text())["steps"] == 240


def test_a_run_without_resume_does_not_write_into_another(train, tmp_path):
    train("bptt", tmp_path)
    with pytest.raises(FileExistsError, match=rf"Go on with it, resume={tmp_path}/checkpoint.pt, or choose another"):
        train("bptt", tmp_path)


def test_what_the_command_line_says_must_agree_with_the_checkpoint(train, tmp_path):
    train("bptt", tmp_path)
    with pytest.raises(ValueError, match=r"env.drone=small_racer contradicts .* trained with env.drone=visfly"):
        train("bptt", tmp_path, "resume=auto", "env.drone=small_racer")
    with pytest.raises(ValueError, match=r"algorithm=shac contradicts .* trained with algorithm=bptt"):
        train("shac", tmp_path, "resume=auto")


def test_a_checkpoint_that_cannot_be_read_is_named_with_the_reason(train, tmp_path):
    good = train("bptt", tmp_path)
    whole = (tmp_path / "checkpoint.pt").read_bytes()
    path = tmp_path / "bad.pt"

    def fails(error, match):
        with pytest.raises(error, match=match):
            checkpoints.read_checkpoint(path)

    fails(FileNotFoundError, "No checkpoint at .*bad.pt. Train one first")
    path.write_bytes(whole[: len(whole) // 2])
    fails(ValueError, "bad.pt cannot be read: it is cut off, or no checkpoint of these recipes")
    path.write_text("hello")
    fails(ValueError, "bad.pt cannot be read: it is cut off, or no checkpoint of these recipes")
    torch.save({"config": Path("anything that is pickled")}, path)
    fails(ValueError, "anything else could run code, and is not loaded")
    torch.save({"weights": torch.zeros(1)}, path)
    fails(ValueError, "bad.pt is not a checkpoint of these recipes. Give the path of a checkpoint.pt.")
    torch.save({"config": "", "steps": 1}, path)
    fails(ValueError, "bad.pt has checkpoint format 0, this version reads format 2. It was written by .* or before")
    torch.save({**good, "format": 3, "version": "9.1"}, path)
    fails(ValueError, "has checkpoint format 3, .* written by torchrl_quad 9.1 at revision .*: use that version")
    good["processes"] *= 2
    torch.save(good, tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="was written by 2 processes, and 1 want to go on"):
        train("bptt", tmp_path, "resume=auto")


def test_a_run_that_is_made_longer_is_not_over_before_it_is(train, tmp_path, monkeypatch):
    train("bptt", tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(run.Run, "_finish", lambda self: None)  # killed after the last checkpoint
        train("bptt", tmp_path, "resume=auto", "total_steps=240")
    assert not (tmp_path / "summary.json").exists()
    train("bptt", tmp_path, "resume=auto", "total_steps=240")
    assert json.loads((tmp_path / "summary.json").read_text())["steps"] == 240


def test_a_run_that_other_code_goes_on_with_says_so(train, tmp_path, monkeypatch):
    first = train("bptt", tmp_path)["revision"]
    monkeypatch.setattr(run, "revision", lambda: "another")
    assert train("bptt", tmp_path, "resume=auto", "total_steps=240")["revision"] == f"{first}, then another"


def test_a_checkpoint_without_an_evaluated_policy_is_no_policy(train, tmp_path, monkeypatch):
    poison(monkeypatch, None)
    with pytest.raises(FloatingPointError):
        train("bptt", tmp_path, "max_skipped=0")
    with pytest.raises(ValueError, match="failure.pt holds no policy that was evaluated"):
        common.load_policy(tmp_path / "failure.pt")


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), checkpoints.replacing(path) as temporary:
        temporary.write_text(f"half of the n{1 / 0}")
    assert path.read_text() == "old"
    with checkpoints.replacing(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


# -- watch -------------------------------------------------------------------------------------------------------------


def test_wandb_gets_configuration_metrics_pictures_films_replay_and_checkpoint(launch, tmp_path):
    small = [*SMALL, f"hydra.run.dir={tmp_path}"]
    launch("bptt", *small, "logger.backend=wandb", "logger.flight_every=3")
    launch("bptt", *small, "resume=auto", "total_steps=240")
    resumed = checkpoints.read_checkpoint(tmp_path / "checkpoint.pt")
    logs = sorted(tmp_path.glob("wandb/offline-run-*/*.wandb"))
    assert len(logs) == 2 and len({log.stem for log in logs}) == 1  # one run, of two parts
    first, second = (wandb_records(log) for log in logs)

    config = {item.key: json.loads(item.value_json) for item in first["run"][0].run.config.update}
    assert config["task"] == "hovering" and config["env"]["dt"] == 0.005
    assert config["revision"] == checkpoints.revision() != "unknown"
    history = [logged(record) for record in first["history"]]
    curves = [row for row in history if "eval/return" in row]
    assert [row["eval/step"] for row in curves] == [48, 96, 144, 192]
    names = {name for name in rows(tmp_path)[0] if "/" in name} | {
        f"time/{name}" for name in ("seconds", "processor_seconds", "steps_per_second")
    }
    assert names <= set(curves[0])
    assert {name.split("/")[0] for name in names} == {"train", "eval", "reward", "grad", "time"}
    assert [row["eval/return"] for row in curves] == [row["eval/return"] for row in resumed["rows"][:4]]
    # The third evaluation and the final one draw the flight; the page comes with the final one alone.
    items = [item for record in first["history"] for item in record.history.item]
    media = [(item.nested_key[0], json.loads(item.value_json)) for item in items if item.nested_key[1:] == ["path"]]
    kinds = {
        "eval/flight": (2, b"\x89PNG"),
        "eval/film": (2, b"GIF89a"),
        "eval/learning_curve": (1, b"\x89PNG"),
        "eval/replay": (1, b"<!doctype html>"),
    }
    assert Counter(name for name, path in media) == {name: count for name, (count, _) in kinds.items()}
    for name, path in media:
        assert (logs[0].parent / "files" / path).read_bytes().startswith(kinds[name][1]), name
    assert first["artifact"][0].artifact.type == "model"
    assert [entry.path for entry in first["artifact"][0].artifact.manifest.contents] == ["checkpoint.pt"]
    assert [logged(r)["eval/step"] for r in second["history"] if "eval/return" in logged(r)] == [240]


def wandb_records(path):
    """What an offline run has kept: chunks in blocks of 32 KiB, each after 4 bytes of checksum, its size, its kind."""
    from wandb.proto import wandb_internal_pb2

    content, at, data, records = path.read_bytes(), 7, b"", {}
    while at < len(content):
        if 32768 - at % 32768 < 7:  # too little for a chunk is left empty
            at += 32768 - at % 32768
        size, kind = struct.unpack_from("<HB", content, at + 4)
        data += content[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # whole, or the last part
            record = wandb_internal_pb2.Record.FromString(data)
            records.setdefault(record.WhichOneof("record_type"), []).append(record)
            data = b""
    return records


def logged(record):
    return {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}


def test_tensorboard_gets_the_names_of_the_csv_and_forgets_what_is_flown_again(train, tmp_path, monkeypatch):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    saves = []

    def stop_at_the_third(self, path, save=run.Run._save):
        saves.append(path)
        if len(saves) == 3:
            self.logger.flush()
            raise KeyboardInterrupt
        save(self, path)

    with monkeypatch.context() as patch:
        patch.setattr(run.Run, "_save", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            train("bptt", tmp_path, "logger.backend=tensorboard")
    train("bptt", tmp_path, "resume=auto")
    (folder,) = {path.parent for path in tmp_path.glob("**/events.out.tfevents*")}
    events = EventAccumulator(str(folder)).Reload()
    with open(tmp_path / "metrics.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert set(events.Tags()["scalars"]) == {name for name in table[0] if "/" in name}
    for name in events.Tags()["scalars"]:
        scalars = events.Scalars(name)
        assert [scalar.step for scalar in scalars] == [48, 96, 144, 192], name
        assert [scalar.value for scalar in scalars] == pytest.approx([float(row[name]) for row in table]), name


@pytest.mark.parametrize("recipe", ["abpt", "bptt", "shac", "ppo"])
def test_a_run_with_diagnostics_learns_the_same_bit_for_bit_and_logs_them(recipe, train, tmp_path):
    options = [*EVERYTHING, "task=landing", *(["buffer.capacity=24"] if recipe == "abpt" else [])]
    plain = train(recipe, tmp_path / "plain", *options)
    audited = train(recipe, tmp_path / "audited", *options, "diagnostics=2")
    for checkpoint in (plain, audited):
        checkpoint["names"] = [set(row) for row in checkpoint["rows"]]
    for row, without in zip(audited["rows"], plain["names"], strict=True):
        for name in set(row) - without:
            del row[name]
    news = [a - b for a, b in zip(audited.pop("names"), plain.pop("names"), strict=True)]
    terms = ("descent", "approach", "success", "crash")
    shares = {f"reward/{term}_{share}" for term in terms for share in ("return_share", "gradient_share")}
    norms = {"grad/cosine", "grad/first_order_norm", "grad/value_norm", "grad/variance", "grad/signal_to_noise"}
    assert news == [set(), shares | (set() if recipe == "ppo" else norms)] * 2
    assert_equal(plain, audited)
    first, second, *_ = rows(tmp_path / "audited")
    assert first["reward/descent_gradient_share"] == "nan" and 0 < float(second["reward/descent_gradient_share"]) <= 1
    if recipe != "ppo":
        assert float(second["grad/variance"]) > 0 and (float(second["grad/cosine"]) <= 1 or recipe == "bptt")


def test_the_configuration_goes_along_with_the_results(train, tmp_path):
    checkpoint = train("bptt", tmp_path, "env.drone=small_racer")
    saved = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert saved["env"]["drone"] == "small_racer"
    assert OmegaConf.create(checkpoint["config"]) == OmegaConf.create(saved)
    assert checkpoint["revision"] == json.loads((tmp_path / "summary.json").read_text())["revision"]


# -- numbers that are not finite ---------------------------------------------------------------------------------------


def poison(monkeypatch, *calls):
    """Let the loss, or only its gradient, be NaN in these calls; None means in all."""
    count = iter(range(1_000))

    def loss_actor(self, rollout, original=BPTTLoss.loss_actor):
        loss, metrics = original(self, rollout)
        call = next(count)
        if call in calls or None in calls:
            parameter = next(self.actor_network_params.parameters())
            loss = loss + (0.0 * parameter).sqrt().sum() if call % 2 else loss * torch.nan
        return loss, metrics

    monkeypatch.setattr(BPTTLoss, "loss_actor", loss_actor)


def test_an_update_that_is_not_finite_is_left_out_and_counted(train, tmp_path, monkeypatch):
    poison(monkeypatch, 0, 3, 4)
    checkpoint = train("bptt", tmp_path)
    assert [row["grad/skipped"] for row in checkpoint["rows"]] == [1, 2, 3, 3]
    assert all(parameter.isfinite().all() for parameter in checkpoint["best"]["actor"].values())
    assert checkpoint["parts"][1]["state"][0]["step"] == 8 - 3
    assert all(row["grad/actor"] != row["grad/actor"] or row["grad/actor"] > 0 for row in checkpoint["rows"])


def test_too_many_of_them_stop_the_run_and_leave_the_state(train, tmp_path, monkeypatch):
    poison(monkeypatch, None)
    with pytest.raises(FloatingPointError) as error:
        train("bptt", tmp_path, "max_skipped=3", "eval.interval=100")
    message = str(error.value)
    assert (
        "4 updates had a loss or gradient that is not finite and were left out; the limit is max_skipped=3" in message
    )
    assert (
        "actor, iteration 3, loss -" in message and "gradient norm nan, not finite in actor_network_params" in message
    )
    failure = checkpoints.read_checkpoint(tmp_path / "failure.pt")
    assert failure["skipped"] == 4
    carry = failure["processes"][0]["carry"]
    assert carry["state"]["position"].shape == (4, 3) and carry["state"]["step"].max() > 0
    assert not (tmp_path / "summary.json").exists()


# -- several processes -------------------------------------------------------------------------------------------------


def join(rank, port):
    """Be one of two processes, as torchrun tells them."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": port}
    sys.path.insert(0, str(ROOT / "recipes"))
    torch.set_num_threads(1)


def in_two_processes(function, *arguments):
    """What a function of the rank returns in each of them."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(function, (0, 1), *([argument] * 2 for argument in arguments), timeout=300))


def free_port():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return str(free.getsockname()[1])


def train_together(rank, ports, launches):
    os.environ["HYDRA_FULL_ERROR"] = "1"
    printed = io.StringIO()
    for port, arguments in zip(ports, launches, strict=True):
        join(rank, port)
        sys.argv = ["abpt.py", *arguments]
        with redirect_stdout(printed):
            runpy.run_path(str(ROOT / "recipes/abpt.py"), run_name="__main__")
    return printed.getvalue()


def test_two_processes_train_one_policy_and_resume(tmp_path):
    options = [*SMALL, *EVERYTHING, "buffer.capacity=24", "actor.schedule=constant", "critic.schedule=constant"]
    launches = [
        [*options, "total_steps=384", f"hydra.run.dir={tmp_path}/straight"],
        [*options, "total_steps=192", f"hydra.run.dir={tmp_path}/resumed"],
        [f"resume={tmp_path}/resumed/checkpoint.pt", "total_steps=384"],
    ]
    printed = in_two_processes(train_together, [free_port() for _ in launches], launches)
    assert [text.count("fresh episodes") for text in printed] == [3, 0]  # one of them reports
    straight = checkpoints.read_checkpoint(tmp_path / "straight/checkpoint.pt")
    assert [row["steps"] for row in straight["rows"]] == [96, 192, 288, 384]
    first, second = straight["processes"]
    assert first["parameters"] == second["parameters"]
    for name in ("torch", "env"):
        assert not torch.equal(first[name], second[name])
    assert not torch.equal(first["carry"]["state"]["position"], second["carry"]["state"]["position"])
    assert straight["parts"][-1]["count"] == 384  # the normaliser has seen what both have flown
    assert_equal(straight, checkpoints.read_checkpoint(tmp_path / "resumed/checkpoint.pt"))


def test_the_gradients_are_those_of_all_processes_averaged():
    results = in_two_processes(descend_on_own_data, free_port())
    alone = [gradient_alone(rank) for rank in (0, 1)]
    loss = sum(value for value, _ in alone) / 2
    gradient = sum(grad for _, grad in alone) / 2
    assert not torch.allclose(alone[0][1], alone[1][1])
    for value, norm, clipped, _ in results:
        torch.testing.assert_close(value, loss)
        torch.testing.assert_close(norm, gradient.norm())
        torch.testing.assert_close(clipped, gradient * (0.5 / gradient.norm()).clamp(max=1.0))
    assert torch.equal(results[0][3], results[1][3])  # the parameters after ten steps


def model_and_loss(rank):
    torch.manual_seed(0)
    model = torch.nn.Linear(3, 2)
    data = torch.randn(8, 3, generator=torch.Generator().manual_seed(rank)) + rank
    return model, lambda: (model(data) ** 2).mean()


def gradient_alone(rank):
    model, loss = model_and_loss(rank)
    value = loss()
    value.backward()
    return value.detach(), torch.cat([p.grad.flatten() for p in model.parameters()])


def descend_on_own_data(rank, port):
    import torch.distributed as dist

    join(rank, port)
    dist.init_process_group("gloo")
    model, loss = model_and_loss(rank)
    optimizer = torch.optim.Adam(model.parameters(), 0.1)
    value, norm = common.backward(loss(), optimizer, max_grad_norm=0.5)
    clipped = torch.cat([p.grad.flatten() for p in model.parameters()])
    for _ in range(10):
        common.backward(loss(), optimizer, max_grad_norm=0.5)
        optimizer.step()
    dist.destroy_process_group()
    return value, norm, clipped, torch.nn.utils.parameters_to_vector(model.parameters()).detach()


# -- sweeps ------------------------------------------------------------------------------------------------------------


def test_the_runs_of_a_sweep_go_side_by_side_and_a_second_time_are_skipped(launch, tmp_path):
    sweep = ["--multirun", *SMALL, "task=hovering,tracking", "resume=auto", f"hydra.sweep.dir={tmp_path}"]
    sweep += ["hydra.sweep.subdir=${task}"]
    command = [sys.executable, "recipes/bptt.py", *sweep]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True).stdout
    assert printed.count("fresh episodes") == 2
    folders = [tmp_path / task for task in ("hovering", "tracking")]
    started = [(folder / "config.yaml").stat().st_mtime for folder in folders]
    ended = [(folder / "summary.json").stat().st_mtime for folder in folders]
    assert max(started) < min(ended)  # the second had started before the first was over
    assert launch("bptt", *sweep, "hydra/launcher=basic").count("Finished before") == 2
