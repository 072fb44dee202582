"""Checkpoints: damage is found before anything is used, and the checkpoint before it is there."""

import errno
import random
import re
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf
from refusals import refuses
from small_runs import SMALL, rows, stop_at_save

from torchrl_quad.training.building import average_policy
from torchrl_quad.training.checkpoints import previous, read_checkpoint, write_checkpoint

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


def test_a_run_goes_on_from_the_checkpoint_before_a_damaged_one(train, refused, launch, tmp_path):
    straight = train("bptt", tmp_path)
    path = tmp_path / "checkpoint.pt"
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)
    said = refused("bptt", *SMALL, f"hydra.run.dir={tmp_path}", "resume=auto")
    assert f"{path} is damaged: its checksum does not fit its content." in said
    assert said.endswith(f"Continue from the checkpoint before it: resume={tmp_path}/checkpoint.previous.pt")
    assert read_checkpoint(previous(path))["iteration"] == 6
    launch("bptt", f"resume={previous(path)}")
    assert read_checkpoint(path)["iteration"] == 8
    torch.testing.assert_close(read_checkpoint(path)["best"]["actor"], straight["best"]["actor"], rtol=0, atol=0)
    assert read_checkpoint(previous(path))["iteration"] == 6  # and not the damaged one


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


def test_a_configuration_from_somebody_else_runs_no_code_and_passes_the_schema_or_is_refused(
    train, refused, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evilmod.py").write_text("open('ran', 'w')")
    saved, path = train("bptt", tmp_path / "run"), tmp_path / "run/checkpoint.pt"
    for text, message in EVIL.items():
        values = yaml.safe_load(saved["config"])
        try:
            values |= yaml.safe_load(text) or {}
        except (yaml.YAMLError, TypeError):
            values = None
        is_whole = values is None or "${" in text or "&" in text or not text
        write_own(path, saved, config=text if is_whole else yaml.safe_dump(values))
        recipes = [["evaluate", f"checkpoint={path}"], ["bptt", f"resume={path}", "total_steps=240"]]
        for recipe, *words in recipes if "evilmod" in text else recipes[:1]:
            said = refused(recipe, *words)
            assert f"{path}: the configuration in it" in said and message in said, (text, said)
    assert not (tmp_path / "ran").exists()


def test_content_that_does_not_fit_its_configuration_is_refused_in_one_line(train, refused, tmp_path):
    saved, path = train("abpt", tmp_path), tmp_path / "checkpoint.pt"
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
