"""Training that is long enough to succeed."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["abpt", "bptt", "shac"])
def test_every_recipe_learns_to_hover(recipe, tmp_path):
    subprocess.run([sys.executable, f"recipes/{recipe}.py", f"hydra.run.dir={tmp_path}"], cwd=ROOT, check=True)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["success"] >= 0.99
    assert summary["error"] < 0.05
