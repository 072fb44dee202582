"""What a run logs, what it does with numbers that are not finite, and how recipes read what wandb's agent writes."""

import json
import struct
import sys
import time
from collections import Counter

import pytest
import torch
import yaml
from conftest import RECIPES
from helpers import EVERYTHING, SMALL, assert_equal, cases, poison, rows, stop_at_save
from omegaconf import OmegaConf
from torchrl import torchrl_logger

from torchrl_quad.envs import HoveringEnv
from torchrl_quad.files import read_rows
from torchrl_quad.training import evaluation, loop
from torchrl_quad.training.checkpoints import read_checkpoint, revision
from torchrl_quad.training.configuration import hydra_argument


def test_what_torchrl_says_while_a_run_trains_goes_above_its_bar(train, tmp_path, monkeypatch):
    record, said = loop.Run.record, []
    monkeypatch.setattr(torchrl_logger.handlers[0], "stream", sys.stderr)  # pytest has replaced it since
    monkeypatch.setattr(loop.tqdm, "write", lambda text, **_: said.append(text))
    monkeypatch.setattr(loop.Run, "record", lambda *run, **rest: [torchrl_logger.info("told"), record(*run, **rest)])
    train("bptt", tmp_path, "total_steps=24")
    assert said and all("told" in text for text in said)


def test_wandb_gets_configuration_metrics_pictures_films_replay_and_artifact(launch, tmp_path):
    small = [*SMALL, f"hydra.run.dir={tmp_path}"]
    (tmp_path / "policy").mkdir()  # what has been exported lies beside the checkpoint
    (tmp_path / "policy/policy.txt").write_text("exported")
    launch("bptt", "seed=3", "actor.lr=0.01", *small, "logger.backend=wandb", "logger.flight_every=3")
    launch("bptt", "seed=3", "actor.lr=0.01", *small, "resume=auto", "total_steps=240")
    resumed = read_checkpoint(tmp_path / "checkpoint.pt")
    logs = sorted(tmp_path.glob("wandb/offline-run-*/*.wandb"))
    assert len(logs) == 2 and len({log.stem for log in logs}) == 1  # one run, of two parts
    first, second = (wandb_records(log) for log in logs)

    run = first["run"][0].run
    assert run.display_name == second["run"][0].run.display_name
    assert run.display_name.startswith("hovering_bptt_seed3 actor.lr=0.01 num_envs=4 horizon=6 ")
    assert run.display_name.endswith(" compile=false eval.interval=2 e…") and len(run.display_name) == 128
    assert list(run.tags) == ["hovering", "bptt", "visfly"] and run.job_type == "train"
    changes = [*run.config.update, *(item for record in first.get("config", []) for item in record.config.update)]
    config = {item.key: json.loads(item.value_json) for item in changes if item.key}  # the last of each counts
    assert config["task"] == "hovering" and config["env"]["dt"] == 0.005
    assert config["revision"] == revision() != "unknown"
    axes = {(x.metric.glob_name or x.metric.name): x.metric.step_metric for x in first["metric"]}
    assert axes.pop("*") == "steps" and set(axes.values()) <= {"", "steps"}
    best = {x.metric.name: (x.metric.summary.max, x.metric.summary.min) for x in first["metric"]}
    assert best["eval/return"] == best["eval/solved"] == (True, False)
    assert best["eval/crash"] == best["eval/position_error"] == (False, True)

    history = [logged(record) for record in first["history"]]
    assert all("steps" in row for row in history) and not any(name.endswith("/step") for row in history for name in row)
    curves = [row for row in history if "eval/return" in row]
    assert [row["steps"] for row in curves] == [48, 96, 144, 192]
    clock = {f"time/{name}" for name in ("seconds", "processor_seconds", "steps_per_second")}
    names = {name for name in rows(tmp_path)[0] if "/" in name} | clock
    assert names <= set(curves[0])
    assert {name.split("/")[0] for name in names} == {"train", "eval", "reward", "grad", "time"}
    assert [row["eval/return"] for row in curves] == [row["eval/return"] for row in resumed["rows"][:4]]
    final, best = json.loads((tmp_path / "summary.json").read_text()), logged(second["history"][-1])
    assert min(x for x in names | set(best) if "/" in x).startswith("best/")  # wandb sorts by name
    assert [best[f"best/{x}"] for x in ("solved", "return")] == [final[x] for x in ("solved", "return")]
    assert best["best/steps"] == final["best_steps"] and best["steps"] == 240
    # The third evaluation and the final one draw the flight; the page comes with the final one alone.
    items = [item for record in first["history"] for item in record.history.item]
    media = [(item.nested_key[0], json.loads(item.value_json)) for item in items if item.nested_key[1:] == ["path"]]
    kinds = {"eval/flight": (2, b"\x89PNG"), "eval/film": (2, b"\0\0\0 ftyp")}
    kinds |= {"eval/learning_curve": (1, b"\x89PNG"), "eval/replay": (1, b"<!doctype html>")}
    assert Counter(name for name, path in media) == {name: count for name, (count, _) in kinds.items()}
    for name, path in media:
        assert (logs[0].parent / "files" / path).read_bytes().startswith(kinds[name][1]), name
    artifact = first["artifact"][0].artifact
    assert artifact.type == "model" and set(artifact.aliases) == {"best", "latest"}
    contents = {entry.path for entry in artifact.manifest.contents}
    assert contents == {"checkpoint.pt", "config.yaml", "summary.json", "policy/policy.txt"}
    assert json.loads(second["artifact"][0].artifact.metadata)["return"] == final["return"]
    assert [logged(r)["steps"] for r in second["history"] if "eval/return" in logged(r)] == [240]


def wandb_records(path):
    """What an offline run has kept: chunks in blocks of 32 KiB, each after 4 bytes of checksum, its size, its kind. The
    last record is "exit", for which wandb's own process may take a moment."""
    from wandb.proto import wandb_internal_pb2

    for _ in range(200):
        content, at, data, records = path.read_bytes(), 7, b"", {}
        while at + 7 <= len(content):
            if 32768 - at % 32768 < 7:  # too little for a chunk is left empty
                at += 32768 - at % 32768
                continue
            size, kind = struct.unpack_from("<HB", content, at + 4)
            data += content[at + 7 : at + 7 + size]
            at += 7 + size
            if kind in (1, 4) and at <= len(content):  # whole, or the last part
                record = wandb_internal_pb2.Record.FromString(data)
                records.setdefault(record.WhichOneof("record_type"), []).append(record)
                data = b""
        if "exit" in records:
            break
        time.sleep(0.1)
    return records


def logged(record):
    return {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}


def test_tensorboard_gets_the_names_of_the_csv_and_forgets_what_is_flown_again(train, refused, tmp_path, monkeypatch):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with monkeypatch.context() as patch:
        stop_at_save(patch, 3)
        refused("bptt", *SMALL, f"hydra.run.dir={tmp_path}", "logger.backend=tensorboard", status=130)
    train("bptt", tmp_path, "resume=auto")
    (folder,) = {path.parent for path in tmp_path.glob("**/events.out.tfevents*")}
    events = EventAccumulator(str(folder)).Reload()
    table = read_rows(tmp_path / "metrics.csv")
    assert set(events.Tags()["scalars"]) == {name for name in table[0] if "/" in name}
    for name in events.Tags()["scalars"]:
        scalars = events.Scalars(name)
        assert [scalar.step for scalar in scalars] == [48, 96, 144, 192], name
        assert [scalar.value for scalar in scalars] == pytest.approx([float(row[name]) for row in table]), name


@pytest.mark.parametrize("recipe", ["abpt", "ppo"])
def test_a_run_with_diagnostics_learns_the_same_bit_for_bit_and_logs_them(recipe, train, tmp_path):
    options = [*EVERYTHING, "task=landing", "env.event_discount=null", "eval.interval=1", "total_steps=96"]
    options += ["buffer.capacity=24"] if recipe == "abpt" else []
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
        assert float(second["grad/variance"]) > 0 and float(second["grad/cosine"]) <= 1


def test_a_run_that_solves_nothing_says_what_may_be_the_reason(train, tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(torchrl_logger, "warning", said.append)
    train("bptt", tmp_path, "task=racing", "env.weights={gate: 0}", "total_steps=480", "eval.interval=1")
    for steps in (120, 480):  # and at the end
        of_step = [x for x in said if x.startswith(f"Nothing is solved after {steps} steps.")]
        starts = [x.partition(" Perhaps ")[2][:18] for x in of_step]
        assert starts == ["as this policy fli", "all episodes end a"] and len(said) == 4


def test_a_return_unsolved_may_disagree_with_success_or_pay_for_loitering():
    def why(*returns, crash=0.0, ends_on_success=False):
        rows = [{"steps": i, "eval/return": x, "eval/solved": 0.1} for i, x in enumerate(returns, start=1)]
        rows[-1]["eval/crash"] = crash
        return [x[:18] for x in evaluation.why_unsolved(rows, 5.0, ends_on_success)]

    assert why(1.0, *20 * [2.0]) == ["reward and success", "all episodes end a"]
    assert why(1.0, *9 * [2.0]) == why(*20 * [2.0]) == why(*range(20)) == ["all episodes end a"]
    assert why(1.0, *20 * [2.0], crash=0.1) == []
    assert why(*range(20), ends_on_success=True) == ["loitering pays mor", "all episodes end a"]
    assert why(*range(-20, 0), ends_on_success=True) == ["all episodes end a"]


def test_a_run_that_solves_few_episodes_says_so_at_its_end(train, tmp_path, monkeypatch):
    said, of_episodes = [], HoveringEnv.episode_metrics
    monkeypatch.setattr(torchrl_logger, "warning", said.append)

    def fourth(env, flight):
        return of_episodes(env, flight) | {"solved": torch.arange(len(flight)) % 4 == 0}

    monkeypatch.setattr(HoveringEnv, "episode_metrics", fourth)
    train("bptt", tmp_path, "task=hovering", "total_steps=480", "eval.interval=1")
    assert said and all(x.startswith("At most 25 % of the episodes are solved after 480 steps. Perhaps ") for x in said)


def test_a_task_of_your_own_is_audited_before_it_trains_which_changes_nothing(train, tmp_path, monkeypatch):
    said, own = [], [*EVERYTHING, "task._target_=own_task.CornerEnv", "env.max_episode_steps=6"]
    monkeypatch.setattr(torchrl_logger, "warning", said.append)
    audited = train("abpt", tmp_path / "audited", *own)
    assert said[0].startswith("Before training, own_task.CornerEnv may have a trap: as this policy flies a step pays -")
    before = [x for x in said if x.startswith("Before")]
    monkeypatch.setattr(loop.Run, "_traps", lambda _: ["'spin' is less than a thousandth: it teaches nothing"])
    assert_equal(train("abpt", tmp_path / "plain", *own), audited)
    assert before == [x for x in said if x.startswith("Before")]  # what teaches nothing at first may later


def test_an_update_that_is_not_finite_is_left_out_and_counted(train, tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(torchrl_logger, "warning", said.append)
    poison(monkeypatch, 0, 3, 4)
    checkpoint = train("bptt", tmp_path, "env.drone=small_racer")
    saved = yaml.safe_load((tmp_path / "config.yaml").read_text())  # the configuration goes along with the results
    assert saved["env"]["drone"] == "small_racer" and OmegaConf.create(checkpoint["config"]) == OmegaConf.create(saved)
    assert checkpoint["revision"] == json.loads((tmp_path / "summary.json").read_text())["revision"]
    assert [row["grad/skipped"] for row in checkpoint["rows"]] == [1, 2, 3, 3]
    assert [x.partition(":")[0] for x in said] == ["An update was skipped in iteration 0"]
    assert all(parameter.isfinite().all() for parameter in checkpoint["best"]["actor"].values())
    assert checkpoint["stateful"][1]["state"][0]["step"] == 8 - 3
    assert all(row["grad/actor"] != row["grad/actor"] or row["grad/actor"] > 0 for row in checkpoint["rows"])


def test_too_many_of_them_stop_the_run_and_leave_the_state(refused, no_pictures, tmp_path, monkeypatch):
    poison(monkeypatch, None)
    said = refused("bptt", *SMALL, f"hydra.run.dir={tmp_path}", "max_skipped=3", "eval.interval=100")
    assert "4 updates were skipped because their loss or gradient was not finite; the limit is max_skipped=3" in said
    assert "actor, iteration 3, loss -" in said and "gradient norm nan, not finite in actor_network_params" in said
    failure = read_checkpoint(tmp_path / "failure.pt")
    assert failure["skipped"] == 4
    carry = failure["processes"][0]["carry"]
    assert carry["state"]["position"].shape == (4, 3) and carry["state"]["step"].max() > 0
    assert not (tmp_path / "summary.json").exists()


def test_a_run_draws_no_flight_twice(launch, no_pictures, monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(loop.drawing, "draw_flight", lambda flight, path, env, title: drawn.append(len(flight)))
    small = [*SMALL, "total_steps=48", "eval.interval=1", f"hydra.run.dir={tmp_path}"]
    launch("bptt", *small, "logger.flight_every=1")
    assert drawn == [4, 256]  # after the first iteration, and the best policy at the end


@pytest.mark.parametrize("style", ["args", "args_no_hyphens"])
def test_a_sweep_hands_over_mappings_and_null_as_people_write_them(train, tmp_path, style):
    from wandb.sdk.launch.sweeps.utils import create_sweep_command_args

    text = (RECIPES / "sweep.yaml").read_text().split("\n", 1)[1]
    assert text in (RECIPES.parent / "docs/wandb.md").read_text()  # the page shows the file
    sweep = yaml.safe_load(text)
    assert sweep["program"] == "recipes/abpt.py" and sweep["metric"] == {"name": "best/return", "goal": "maximize"}
    last = -1 if style == "args" else 0
    values = {name: x.get("values", [x.get("value", 0.01)])[last] for name, x in sweep["parameters"].items()}
    arguments = create_sweep_command_args({"args": {name: {"value": value} for name, value in values.items()}})[style]
    arguments = [x for x in arguments if "logger." not in x]
    checkpoint = train("abpt", tmp_path, *arguments, "total_steps=24", "horizon=6", "--logger.backend=None")
    cfg = OmegaConf.create(checkpoint["config"])
    assert cfg.env.wind == {"mean": [1.0, 0.0, 0.0], "gust": 0.5} and cfg.actor.lr == 0.01
    assert cfg.env.randomize == values["env.randomize"] == (None if last == 0 else {"mass": {"scale": [0.8, 1.2]}})


@cases(
    ('env.wind={"mean": [1, 0.5, -1e-05], "gust": null}', "env.wind={mean: [1, 0.5, -1e-05], gust: null}"),
    ("+a={'b c': \"it's\", 'd': True}", r"""+a={b\ c: "it's", d: True}"""),
    ("a=None,{'b': [1, 2]}", "a=null,{b: [1, 2]}"),  # a sweep of hydra's
    (
        """columns={"time": Columns(('t(s)',), scale=0.001), 'x': None}""",
        "columns={time: {names: ['t(s)'], scale: 0.001}, x: null}",
    ),
    ("columns={'x': Columns('a', 2)}", "columns={x: {names: 'a', scale: 2}}"),
    ("max_gap=0.1", "++reading.max_gap=0.1"),
    ("convention=dataclasses.replace(frames.px4(), xyzw=True)", "convention={name: 'px4', xyzw: True}"),
    ("--actor.num_cells=[32, 32]", "actor.num_cells=[32, 32]"),
    ("env.wind={mean: [1, 0, 0]}", "env.wind={mean: [1, 0, 0]}"),
    *((x, x) for x in ("env.drone=None_of_them", "--config-name=abpt", "--cfg=job", "--multirun", "~env.wind")),
)
def test_arguments_come_in_the_grammar_of_hydra(written, read):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    assert hydra_argument(written) == read == hydra_argument(read)
    if not read.startswith("--"):
        OverridesParser.create().parse_override(read)
