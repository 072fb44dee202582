"""Several processes: those that train one policy, and the runs of a sweep."""

import io
import multiprocessing
import os
import runpy
import socket
import sys
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path

import pytest
import torch
from small_runs import EVERYTHING, SMALL, assert_equal

from torchrl_quad.training.checkpoints import read_checkpoint
from torchrl_quad.training.loop import backward

ROOT = Path(__file__).parent.parent


def join(rank, port):
    """Be one of two processes, as torchrun tells them."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": port}
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def in_two_processes():
    """What a function of the rank returns in each of two processes."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        yield lambda function, *arguments: list(pool.map(function, (0, 1), *([x] * 2 for x in arguments), timeout=300))


def free_port():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return str(free.getsockname()[1])


def draw_nothing():
    """As conftest's ``no_pictures``, in a process that has no fixtures."""
    from torchrl_quad.training import drawing

    drawing.draw_flight = drawing.publish_flight = lambda *args: None
    drawing.draw_learning_curve = lambda metrics, path, env: path.touch()


def train_together(rank, port, arguments):
    join(rank, port)
    sys.argv = ["abpt.py", *arguments]
    draw_nothing()
    with redirect_stdout(io.StringIO()) as printed:
        runpy.run_path(str(ROOT / "recipes/abpt.py"), run_name="__main__")
    return printed.getvalue()


def test_two_processes_train_one_policy_and_resume(in_two_processes, tmp_path):
    options = [*SMALL, *EVERYTHING, "loss.clip_action_gradient=2", "buffer.capacity=24"]
    options += [f"{network}.schedule=constant" for network in ("actor", "critic")]
    launches = [
        [*options, "total_steps=384", f"hydra.run.dir={tmp_path}/straight"],
        [*options, "total_steps=192", f"hydra.run.dir={tmp_path}/resumed"],
        [f"resume={tmp_path}/resumed/checkpoint.pt", "total_steps=384"],
    ]
    for arguments in launches:
        printed = in_two_processes(train_together, free_port(), arguments)
        assert [text.count("fresh episodes") for text in printed] == [1, 0]  # one of them reports
    straight = read_checkpoint(tmp_path / "straight/checkpoint.pt")
    assert [row["steps"] for row in straight["rows"]] == [96, 192, 288, 384]
    first, second = straight["processes"]
    assert first["parameters"] == second["parameters"]
    for name in ("torch", "env", "clip"):
        with pytest.raises(AssertionError):
            assert_equal(first[name], second[name])
    assert not torch.equal(first["carry"]["state"]["position"], second["carry"]["state"]["position"])
    assert straight["stateful"][-1]["count"] == 384  # the normaliser has seen what both have flown
    assert_equal(straight, read_checkpoint(tmp_path / "resumed/checkpoint.pt"))


def test_the_gradients_are_those_of_all_processes_averaged(in_two_processes):
    results = in_two_processes(descend_on_own_data, free_port())
    alone = [gradient_alone(rank) for rank in (0, 1)]
    loss = sum(value for value, _ in alone) / 2
    gradient = sum(grad for _, grad in alone) / 2
    assert not torch.allclose(alone[0][1], alone[1][1])
    for value, norm, clipped, _ in results:
        torch.testing.assert_close(value, loss)
        torch.testing.assert_close(norm, gradient.norm())
        torch.testing.assert_close(clipped, gradient * (0.5 / gradient.norm()).clamp(max=1.0))
    assert torch.equal(results[0][3], results[1][3])  # the parameters after ten steps


def model_and_loss(rank):
    torch.manual_seed(0)
    model = torch.nn.Linear(3, 2)
    data = torch.randn(8, 3, generator=torch.Generator().manual_seed(rank)) + rank
    return model, lambda: (model(data) ** 2).mean()


def gradient_alone(rank):
    model, loss = model_and_loss(rank)
    value = loss()
    value.backward()
    return value.detach(), torch.cat([p.grad.flatten() for p in model.parameters()])


def descend_on_own_data(rank, port):
    import torch.distributed as dist

    join(rank, port)
    dist.init_process_group("gloo")
    model, loss = model_and_loss(rank)
    optimizer = torch.optim.Adam(model.parameters(), 0.1)
    value, norm = backward(loss(), optimizer, max_grad_norm=0.5)
    clipped = torch.cat([p.grad.flatten() for p in model.parameters()])
    for _ in range(10):
        backward(loss(), optimizer, max_grad_norm=0.5)
        optimizer.step()
    dist.destroy_process_group()
    return value, norm, clipped, torch.nn.utils.parameters_to_vector(model.parameters()).detach()


def test_the_runs_of_a_sweep_go_side_by_side_and_a_second_time_are_skipped(launch, tmp_path):
    from joblib.externals.loky import get_reusable_executor

    sweep = ["--multirun", *SMALL, "total_steps=48", "task=hovering,tracking", "resume=auto"]
    sweep += [f"hydra.sweep.dir={tmp_path}", "hydra.sweep.subdir=${task}"]
    launch("bptt", *sweep, "hydra.launcher.n_jobs=2")  # the runs have processes of their own, the sweep has this one
    get_reusable_executor().shutdown()
    folders = [tmp_path / task for task in ("hovering", "tracking")]
    started = [(folder / "config.yaml").stat().st_mtime for folder in folders]
    ended = [(folder / "learning_curve.png").stat().st_mtime for folder in folders]  # which is drawn last
    assert max(started) < min(ended)  # the second had started before the first was over
    assert launch("bptt", *sweep, "hydra/launcher=basic").count("Finished before") == 2
