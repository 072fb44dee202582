"""The check of the losses on TorchRL's pendulum, on a reduced budget."""

import runpy
import sys
from pathlib import Path

SCRIPT = Path(__file__).parent.parent / "recipes/trial/pendulum.py"


def test_every_loss_trains_on_the_pendulum_and_has_a_row_in_the_table(monkeypatch, capsys):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), "--seeds", "0", "--steps", "1"])
    program = runpy.run_path(str(SCRIPT))
    program["main"].__globals__.update(ENVS=2, HORIZON=4, EPISODE=4, EPISODES=2)
    program["main"]()
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert head == "| loss | before | after, by seed | seconds |"
    assert [row.split(" | ")[0] for row in rows] == [f"| {name}" for name in program["LOSSES"]]
    assert -4 * 16.3 < float(rows[0].split(" | ")[1]) < 0  # of four steps, each of which costs at most 16.3
