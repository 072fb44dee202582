"""Training that is long enough to succeed."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType

from torchrl_quad import HoveringEnv, differentiable_rollout

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["abpt", "bptt", "shac", "sapo", "ahac"])
def test_every_recipe_learns_to_hover(recipe, tmp_path):
    subprocess.run([sys.executable, f"recipes/{recipe}.py", f"hydra.run.dir={tmp_path}"], cwd=ROOT, check=True)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["solved"] >= 0.99
    assert summary["position_error"] < 0.05


@pytest.mark.slow
def test_the_program_of_the_readme_learns_to_hover():
    program = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    names = {}
    exec(program, names)
    env = HoveringEnv(num_envs=256, seed=99)
    with torch.no_grad():
        flight, _ = differentiable_rollout(
            env, names["actor"], None, 256, exploration_type=ExplorationType.DETERMINISTIC
        )
    metrics = env.episode_metrics(flight)
    assert metrics["solved"].all() and metrics["position_error"].median() < 0.05


@pytest.mark.slow
def test_abpt_flies_two_laps(tmp_path):
    command = [sys.executable, "recipes/abpt.py", "task=racing", f"hydra.run.dir={tmp_path}"]
    subprocess.run(command, cwd=ROOT, check=True)
    assert json.loads((tmp_path / "summary.json").read_text())["gates_passed"] >= 8


@pytest.mark.slow
@pytest.mark.parametrize("task", ["landing", "tracking"])
def test_abpt_tracks_and_lands(task, tmp_path):
    subprocess.run(
        [sys.executable, "recipes/abpt.py", f"task={task}", f"hydra.run.dir={tmp_path}"], cwd=ROOT, check=True
    )
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["solved"] >= 0.95
    assert task == "landing" or summary["tracking_rmse"] < 0.05
