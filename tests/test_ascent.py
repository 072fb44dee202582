"""Gradients are compared with what the simulator measures: of every method, and of the hybrid in phases of training."""

import pytest
import torch
from test_reproduce import run_main

from benchmarks.paper import gradients, reproduce, running, tables
from torchrl_quad import BPTTLoss, HybridLoss, differentiable_rollout, make_actor, make_env, make_value
from torchrl_quad.files import read_rows


def test_the_gradients_of_every_method_are_compared_with_the_simulator(launch, no_pictures, monkeypatch, tmp_path):
    folders = [tmp_path / f"hovering/{variant}/seed42" for variant in ("abpt", "shac", "bptt")]
    other = tmp_path / "elsewhere"  # whose name tells no variant
    for folder, algorithm in zip([*folders, other], ("abpt", "shac", "bptt", "bptt"), strict=True):
        launch(algorithm, *running.QUICK, f"seed={7 if folder == other else 42}", f"hydra.run.dir={folder}")
    checkpoints = [folder / "checkpoint.pt" for folder in (*folders, other)]
    ascent = "ascent --states 2 --repeats 2 --steps 4 --data", tmp_path
    for some in (checkpoints[:1], checkpoints):
        run_main(monkeypatch, reproduce, *ascent, *some)
    rows = read_rows(tmp_path / "ascent.csv")
    trained = [*((algorithm, "42") for algorithm in ("abpt", "shac", "bptt")), ("bptt", "7")]
    assert [(row["variant"], row["seed"]) for row in rows] == trained
    assert all(-1.0 <= float(row["objective"]) <= 1.0 for row in rows)
    assert [bool(row["zero_step_return"]) for row in rows] == [True, False, False, False]

    with pytest.raises(SystemExit, match="is a second hovering bptt 7: give each a --data folder of its own"):
        run_main(monkeypatch, reproduce, *ascent, *(2 * [other / "checkpoint.pt"]))
    launch("ppo", *running.QUICK, "batch_size=8", f"hydra.run.dir={tmp_path}/ppo")
    with pytest.raises(SystemExit, match="was trained with ppo; choose runs of bptt, abpt, shac"):
        run_main(monkeypatch, reproduce, *ascent, tmp_path / "ppo/checkpoint.pt")


@pytest.fixture
def smooth():
    """An environment without the norms that have a kink where the drone rests."""
    weights = {"velocity": 0.0, "angular_velocity": 0.0}
    return make_env("hovering", num_envs=16, seed=0, dtype=torch.float64, weights=weights)


def test_backpropagation_through_all_steps_knows_the_true_slopes(smooth):
    loss = BPTTLoss(make_actor(smooth, scale_init=1e-4)).make_value_estimator(gamma=0.9)
    start = smooth.reset()
    rollout, _ = differentiable_rollout(smooth, loss.actor_network, start, 20)
    estimated = gradients.estimates(loss, rollout)["objective"]
    action = rollout["action"][:, 0].detach()
    true = gradients.slopes(smooth, loss, start, lambda change: {"action": action + change}, steps=20, size=1e-3)
    assert torch.nn.functional.cosine_similarity(estimated, true, dim=-1).min() > 0.99
    torch.testing.assert_close(estimated.norm(), true.norm(), rtol=0.02, atol=0.0)


def test_the_phases_of_the_hybrid_are_flown_and_measured_once(run_here, monkeypatch, tmp_path):
    phases = "phases --states 4 --repeats 2 --steps 8 --tasks racing --quick --data", tmp_path
    monkeypatch.setattr(gradients, "run", run_here)
    for _ in range(2):
        run_main(monkeypatch, reproduce, *phases, "--output", tmp_path / "runs")
        for name in ("run", "examine_phase"):
            monkeypatch.setattr(gradients, name, lambda *_: pytest.fail("It has been measured."))
    rows = read_rows(tmp_path / "phases.csv")
    assert [float(row["share"]) for row in rows] == list(gradients.SHARES)
    assert all(-1.0 <= float(row[name]) <= 1.0 for row in rows for name in gradients.GRADIENTS)
    assert len(tables.phases_table(tmp_path)) == len(rows)


def test_the_pathwise_gradient_of_the_hybrid_is_what_the_phases_measure(smooth):
    actor = make_actor(smooth, scale_init=0.01, learn_scale=False, noise_correlation=0.9)
    loss = HybridLoss(actor, make_value(smooth), gradient_lmbda=1.0).make_value_estimator(gamma=0.9, lmbda=1.0)
    loss.clip, loss.decay = None, 1.0
    loss.pathwise_weight.fill_(1.0)
    loss.value_network_params.apply_(torch.zero_)  # nothing is known of the time after the horizon
    start = smooth.reset()
    rollout, _ = differentiable_rollout(smooth, loss.actor_network, start, 20)
    first = loss.write_targets(rollout)[:, 0]
    true = gradients.slopes(smooth, loss, start, gradients.in_the_mean(first, 0.9), steps=20, size=1e-4)
    estimated = first["location_gradient"]  # times a number, the same for all
    assert torch.nn.functional.cosine_similarity(estimated, true, dim=-1).min() > 0.99
    assert torch.nn.functional.cosine_similarity(estimated.flatten(), true.flatten(), dim=0) > 0.99
