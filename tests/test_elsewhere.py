"""The losses on environments that are independent of this package, on a reduced budget."""

import pytest
import torch
from test_reproduce import run_main

from benchmarks.paper import elsewhere, reproduce, tables
from torchrl_quad import differentiable_rollout, make_actor
from torchrl_quad.files import read_rows

RANGE = {"pendulum": (-4 * 16.3, 0.0), "balance": (-20.0, 20.0)}  # returns that four steps can have


@pytest.mark.parametrize(
    ("environment", "losses"), [("pendulum", elsewhere.NAMES), ("balance", ("shac", "hybrid", "ppo"))]
)
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
    assert [row["loss"] for row in table] == list(losses)
    assert all(environment in row for row in table)
    monkeypatch.setattr(elsewhere, "learn", lambda *_: pytest.fail("It has been trained."))
    run_main(monkeypatch, reproduce, *arguments)


def test_balance_cuts_the_graph_between_horizons_and_lets_some_go_on():
    torch.manual_seed(0)
    place = elsewhere.Balance(0, 16)
    actions = torch.zeros(16, 6, requires_grad=True)
    end = place.env.step(place.starts().set("action", actions))["next"]
    gradient = torch.autograd.grad(end["observation"].sum(), actions, retain_graph=True)[0]
    assert (gradient != 0).any(0).all(), "each agent is moved by its own action"
    start = place.go_on(end.detach())
    assert not any(entry.requires_grad for entry in start.values(True, True))
    kept = (start["observation"] == end["observation"]).all(-1)
    assert 0 < kept.sum() < 16


def test_a_reset_at_the_end_of_a_horizon_leaves_no_graph_in_the_carry():
    place = elsewhere.Balance(0, 4)
    carry, scenario = place.starts(), place.env.base_env.scenario
    scenario.package.set_pos(torch.tensor([0.0, -2.0]), batch_index=0)  # one ball lies on the floor
    rollout, carry = differentiable_rollout(place.env, make_actor(place.env), carry, 1)
    assert rollout["next", "done"].flatten().tolist() == [True, False, False, False]
    assert rollout["next", "observation"].requires_grad
    assert not any(entry.requires_grad for entry in carry.values(True, True))
