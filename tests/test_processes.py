"""Several processes: those that train one policy, and the runs of a sweep."""

import io
import math
import multiprocessing
import os
import runpy
import socket
import sys
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout

import pytest
import torch
import torch.distributed as dist
from helpers import EVERYTHING, ROOT, SMALL, assert_equal

from torchrl_quad.training import drawing
from torchrl_quad.training.checkpoints import read_checkpoint
from torchrl_quad.training.loop import backward


def join(rank, port):
    """Be one of two processes, as torchrun tells them."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": port}
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def in_two_processes():
    """What a function of the rank returns in each of two processes."""
    multiprocessing.set_forkserver_preload(["torchrl_quad.training.loop", "hydra.main"])  # imported once for both
    with ProcessPoolExecutor(2, multiprocessing.get_context("forkserver")) as pool:
        yield lambda function, *arguments: list(pool.map(function, (0, 1), *([x] * 2 for x in arguments), timeout=300))


def free_port():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return str(free.getsockname()[1])


def train_together(rank, port, arguments):
    join(rank, port)
    sys.argv = ["abpt.py", *arguments]
    drawing.draw_flight = drawing.publish_flight = lambda *args: None
    drawing.draw_learning_curve = lambda metrics, path, env: path.touch()
    with redirect_stdout(io.StringIO()) as printed:
        runpy.run_path(str(ROOT / "recipes/abpt.py"), run_name="__main__")
    return printed.getvalue()


def test_two_processes_train_one_policy_and_resume(in_two_processes, tmp_path):
    options = [*SMALL, *EVERYTHING, "loss.clip_action_gradient=2", "buffer.capacity=24"]
    options += [f"{network}.schedule=constant" for network in ("actor", "critic")]
    launches = [
        [*options, "total_steps=192", f"hydra.run.dir={tmp_path}/straight"],
        [*options, "total_steps=96", f"hydra.run.dir={tmp_path}/resumed"],
        [f"resume={tmp_path}/resumed/checkpoint.pt", "total_steps=192"],
    ]
    for arguments in launches:
        printed = in_two_processes(train_together, free_port(), arguments)
        assert [text.count("fresh episodes") for text in printed] == [1, 0]  # one of them reports
    straight = read_checkpoint(tmp_path / "straight/checkpoint.pt")
    assert [row["steps"] for row in straight["rows"]] == [96, 192]
    first, second = straight["processes"]
    assert first["parameters"] == second["parameters"]
    for name in ("torch", "env", "clip"):
        with pytest.raises(AssertionError):
            assert_equal(first[name], second[name])
    assert not torch.equal(first["carry"]["state"]["position"], second["carry"]["state"]["position"])
    assert straight["stateful"][-1]["count"] == 192  # the normaliser has seen what both have flown
    assert_equal(straight, read_checkpoint(tmp_path / "resumed/checkpoint.pt"))


def test_the_gradients_are_those_of_all_processes_averaged(in_two_processes):
    results = in_two_processes(descend_together, free_port())
    (one, one_gradient, *_), (other, other_gradient, *_) = map(descend, (0, 1))
    gradient = (one_gradient + other_gradient) / 2
    assert not torch.allclose(one_gradient, other_gradient)
    for value, clipped, norm, _ in results:
        torch.testing.assert_close(value, (one + other) / 2)
        torch.testing.assert_close(norm, gradient.norm())
        torch.testing.assert_close(clipped, gradient * (0.5 / gradient.norm()).clamp(max=1.0))
    assert torch.equal(results[0][3], results[1][3])  # the parameters after ten steps


def descend(rank, max_grad_norm=math.inf):
    """From data of one's own: the loss and its gradient, its norm, and the parameters after ten steps."""
    torch.manual_seed(0)
    model = torch.nn.Linear(3, 2)
    data = torch.randn(8, 3, generator=torch.Generator().manual_seed(rank)) + rank
    optimizer, found = torch.optim.Adam(model.parameters(), 0.1), []
    for _ in range(10):
        value, norm = backward((model(data) ** 2).mean(), optimizer, max_grad_norm)
        found.append((value, torch.cat([p.grad.flatten() for p in model.parameters()]), norm))
        optimizer.step()
    return *found[0], torch.nn.utils.parameters_to_vector(model.parameters()).detach()


def descend_together(rank, port):
    join(rank, port)
    dist.init_process_group("gloo")
    found = descend(rank, max_grad_norm=0.5)
    dist.destroy_process_group()
    return found


def test_the_runs_of_a_sweep_go_side_by_side_and_a_second_time_are_skipped(launch, tmp_path):
    from joblib.externals.loky import get_reusable_executor

    sweep = ["--multirun", *SMALL, "total_steps=24", "env.max_episode_steps=4", "task=hovering,tracking", "resume=auto"]
    sweep += [f"hydra.sweep.dir={tmp_path}", "hydra.sweep.subdir=${task}"]
    launch("bptt", *sweep, "hydra.launcher.n_jobs=2")  # the runs have processes of their own, the sweep has this one
    get_reusable_executor().shutdown()
    folders = [tmp_path / task for task in ("hovering", "tracking")]
    started = [(folder / "config.yaml").stat().st_mtime for folder in folders]
    ended = [(folder / "learning_curve.png").stat().st_mtime for folder in folders]  # which is drawn last
    assert max(started) < min(ended)  # the second had started before the first was over
    assert launch("bptt", *sweep, "hydra/launcher=basic").count("Finished before") == 2
