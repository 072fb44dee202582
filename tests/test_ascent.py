"""Gradients are compared with what the simulator measures: of every method, and of the hybrid in phases of training."""

import pytest
import torch
from test_reproduce import run_main

from benchmarks.paper import ascent, phases, running
from torchrl_quad import BPTTLoss, HybridLoss, differentiable_rollout, make_actor, make_env, make_value
from torchrl_quad.files import read_rows


def test_the_gradients_of_every_method_are_compared_with_the_simulator(
    launch, no_pictures, monkeypatch, capsys, tmp_path
):
    folders = [tmp_path / f"hovering/{variant}/seed42" for variant in ("abpt", "shac", "bptt")]
    other = tmp_path / "elsewhere"  # whose name tells no variant
    for folder, algorithm in zip([*folders, other], ("abpt", "shac", "bptt", "bptt"), strict=True):
        launch(algorithm, *running.QUICK, f"seed={7 if folder == other else 42}", f"hydra.run.dir={folder}")
    checkpoints, output = [folder / "checkpoint.pt" for folder in (*folders, other)], tmp_path / "ascent.csv"
    sizes = ("--output", output, "--states", 4, "--repeats", 2, "--steps", 8)
    for some in (checkpoints[:1], checkpoints):
        run_main(monkeypatch, ascent, *some, *sizes)
    rows = read_rows(output)
    assert [(row["variant"], row["seed"]) for row in rows] == [
        *((algorithm, "42") for algorithm in ("abpt", "shac", "bptt")),
        ("bptt", "7"),
    ]
    assert all(-1.0 <= float(row["objective"]) <= 1.0 for row in rows)
    assert [bool(row["zero_step_return"]) for row in rows] == [True, False, False, False]

    with pytest.raises(SystemExit):
        run_main(monkeypatch, ascent, *(2 * [other / "checkpoint.pt"]), *sizes)
    assert "is a second hovering bptt 7: give runs that differ in more an --output each" in capsys.readouterr().err
    launch("ppo", *running.QUICK, "batch_size=8", f"hydra.run.dir={tmp_path}/ppo")
    with pytest.raises(SystemExit):
        run_main(monkeypatch, ascent, tmp_path / "ppo/checkpoint.pt", *sizes)
    assert "was trained with ppo; choose runs of bptt, abpt, shac." in capsys.readouterr().err


def test_backpropagation_through_all_steps_knows_the_true_slopes():
    smooth = {"velocity": 0.0, "angular_velocity": 0.0}  # norms, which have a kink where the drone rests
    env = make_env("hovering", num_envs=16, seed=0, dtype=torch.float64, weights=smooth)
    loss = BPTTLoss(make_actor(env, scale_init=1e-4)).make_value_estimator(gamma=0.9)
    start = env.reset()
    rollout, _ = differentiable_rollout(env, loss.actor_network, start, 20)
    estimated = ascent.estimates(loss, rollout)["objective"]
    true = ascent.slopes(env, loss, start, rollout["action"][:, 0].detach(), steps=20, size=1e-3)
    assert torch.nn.functional.cosine_similarity(estimated, true, dim=-1).min() > 0.99
    torch.testing.assert_close(estimated.norm(), true.norm(), rtol=0.02, atol=0.0)


def test_the_phases_of_the_hybrid_are_flown_and_measured_once(run_here, monkeypatch, tmp_path):
    sizes = ("--states", 4, "--repeats", 2, "--steps", 8, "--tasks", "racing", "--quick")
    monkeypatch.setattr(phases, "run", run_here)
    for _ in range(2):
        run_main(monkeypatch, phases, *sizes, "--data", tmp_path, "--output", tmp_path / "runs")
        for name in ("run", "examine"):
            monkeypatch.setattr(phases, name, lambda *_: pytest.fail("It has been measured."))
    rows = read_rows(tmp_path / "phases.csv")
    assert [float(row["share"]) for row in rows] == list(phases.SHARES)
    assert all(-1.0 <= float(row[name]) <= 1.0 for row in rows for name in phases.GRADIENTS)
    assert phases.block(tmp_path) in (tmp_path / "more_losses.md").read_text()


def test_the_pathwise_gradient_of_the_hybrid_is_what_the_phases_measure():
    smooth = {"velocity": 0.0, "angular_velocity": 0.0}  # norms, which have a kink where the drone rests
    env = make_env("hovering", num_envs=16, seed=0, dtype=torch.float64, weights=smooth)
    value = make_value(env)
    loss = HybridLoss(
        make_actor(env, scale_init=0.01, learn_scale=False, noise_correlation=0.9), value, gradient_lmbda=1.0
    ).make_value_estimator(gamma=0.9, lmbda=1.0)
    loss.clip, loss.decay = None, 1.0
    loss.pathwise_weight.fill_(1.0)
    loss.value_network_params.apply_(torch.zero_)  # nothing is known of the time after the horizon
    start = env.reset()
    rollout, _ = differentiable_rollout(env, loss.actor_network, start, 20)
    first = loss.write_targets(rollout)[:, 0]
    true = phases.slopes(env, loss, 0.9, start, first, steps=20, size=1e-4)
    estimated = first["location_gradient"]  # times a number, the same for all
    assert torch.nn.functional.cosine_similarity(estimated, true, dim=-1).min() > 0.99
    assert torch.nn.functional.cosine_similarity(estimated.flatten(), true.flatten(), dim=0) > 0.99
