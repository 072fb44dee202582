"""The check of the losses on environments that are not ours, on a reduced budget."""

import runpy
import sys
from pathlib import Path

import pytest
import torch

from torchrl_quad import differentiable_rollout, make_actor
from torchrl_quad.files import read_rows

SCRIPT = Path(__file__).parent.parent / "benchmarks/paper/elsewhere.py"
RANGE = {"pendulum": (-4 * 16.3, 0.0), "balance": (-20.0, 20.0)}  # returns that four steps can have


@pytest.fixture
def program(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    program = runpy.run_path(str(SCRIPT))
    program["main"].__globals__.update(ENVS=2, HORIZON=4, EPISODE=4, EPISODES=2, STEPS=1)
    return program


@pytest.mark.parametrize(("environment", "losses"), [("pendulum", None), ("balance", ["shac", "hybrid", "ppo"])])
def test_a_loss_trains_on_an_environment_that_is_not_ours_once_and_has_a_row_in_the_table(
    environment, losses, program, monkeypatch, tmp_path
):
    losses = losses or list(program["NAMES"])
    arguments = ["--environments", environment, "--losses", *losses, "--seeds", "0", "--data", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
    program["main"]()
    rows = read_rows(tmp_path / "elsewhere.csv")
    assert [(row["environment"], row["loss"], row["seed"]) for row in rows] == [(environment, x, "0") for x in losses]
    low, high = RANGE[environment]
    assert low < float(rows[0]["before"]) < high
    head, _, *lines = program["blocks"](tmp_path)[environment].splitlines()
    assert head == "| loss | before | after | each seed | seconds |"
    assert {line.split(" | ")[0] for line in lines} == {f"| {name}" for name in losses}
    assert all(line in (tmp_path / "elsewhere.md").read_text() for line in lines)
    for name in ("train", "train_hybrid", "train_ppo"):
        program["main"].__globals__[name] = lambda *_: pytest.fail("It has been trained.")
    program["main"]()


def test_balance_cuts_the_graph_between_horizons_and_lets_some_go_on(program):
    torch.manual_seed(0)
    place = program["Balance"](0, 16)
    actions = torch.zeros(16, 6, requires_grad=True)
    end = place.env.step(place.starts().set("action", actions))["next"]
    gradient = torch.autograd.grad(end["observation"].sum(), actions, retain_graph=True)[0]
    assert (gradient != 0).any(0).all(), "each agent is moved by its own action"
    start = place.go_on(end.detach())
    assert not any(entry.requires_grad for entry in start.values(True, True))
    kept = (start["observation"] == end["observation"]).all(-1)
    assert 0 < kept.sum() < 16


def test_a_reset_at_the_end_of_a_horizon_leaves_no_graph_in_the_carry(program):
    place = program["Balance"](0, 4)
    carry, scenario = place.starts(), place.env.base_env.scenario
    scenario.package.set_pos(torch.tensor([0.0, -2.0]), batch_index=0)  # one ball lies on the floor
    rollout, carry = differentiable_rollout(place.env, make_actor(place.env), carry, 1)
    assert rollout["next", "done"].flatten().tolist() == [True, False, False, False]
    assert rollout["next", "observation"].requires_grad
    assert not any(entry.requires_grad for entry in carry.values(True, True))
