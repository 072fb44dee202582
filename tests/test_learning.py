"""Training that is long enough to succeed."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate

from torchrl_quad import HoveringEnv, SHACLoss, differentiable_rollout, make_actor, make_value, restart

ROOT = Path(__file__).parent.parent


def evaluate(actor, seed=99, **options):
    """The metrics of fresh episodes of hovering, flown by the mean action."""
    env = HoveringEnv(seed=seed, **options)
    with torch.no_grad():
        flight, _ = differentiable_rollout(
            env, actor, None, env.max_episode_steps, exploration_type=ExplorationType.DETERMINISTIC
        )
    return env.episode_metrics(flight)


def test_shac_learns_to_hover_in_seconds():
    coarse = {"num_envs": 64, "control_dt": 0.05, "dt": 0.025, "max_episode_steps": 100}  # few steps a second of flight
    iterations = 64
    env = HoveringEnv(seed=0, **coarse)
    actor = make_actor(env, input_scale=0.5)
    loss = SHACLoss(actor, make_value(env, input_scale=0.5))
    target = SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(actor.parameters(), 2e-2, betas=(0.7, 0.95))
    critic_optimizer = torch.optim.Adam(loss.value_network_params.parameters(), 5e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, iterations)
    assert evaluate(actor, **coarse)["solved"].mean() < 0.1
    carry = env.reset()
    for _ in range(iterations):
        rollout, carry = differentiable_rollout(env, actor, carry, 24)
        optimizer.zero_grad()
        loss.loss_actor(rollout)[0].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        schedule.step()
        data = loss.write_value_target(rollout.detach()).reshape(-1)
        for batch in data[torch.randperm(len(data))].split(512):
            critic_optimizer.zero_grad()
            loss.loss_value(batch)[0].backward()
            critic_optimizer.step()
            target.step()
        carry = restart(env, carry, 0.1)
    assert evaluate(actor, **coarse)["solved"].mean() >= 0.9


def summary(folder, recipe, *overrides):
    command = [sys.executable, f"recipes/{recipe}.py", *overrides, f"hydra.run.dir={folder}"]
    subprocess.run(command, cwd=ROOT, check=True)
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["abpt", "bptt", "shac", "sapo", "ahac"])
def test_every_recipe_learns_to_hover(recipe, tmp_path):
    found = summary(tmp_path, recipe)
    assert found["solved"] >= 0.99 and found["position_error"] < 0.05


@pytest.mark.slow
def test_the_program_of_the_readme_learns_to_hover():
    program = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    names = {}
    exec(program, names)
    metrics = evaluate(names["actor"], num_envs=256)
    assert metrics["solved"].all() and metrics["position_error"].median() < 0.05


@pytest.mark.slow
def test_abpt_flies_two_laps(tmp_path):
    assert summary(tmp_path, "abpt", "task=racing")["gates_passed"] >= 8


@pytest.mark.slow
@pytest.mark.parametrize("task", ["landing", "tracking"])
def test_abpt_tracks_and_lands(task, tmp_path):
    found = summary(tmp_path, "abpt", f"task={task}")
    assert found["solved"] >= 0.95
    assert task == "landing" or found["tracking_rmse"] < 0.05
