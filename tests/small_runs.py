"""Small training runs, and how to compare them."""

import subprocess
from pathlib import Path

import torch

from torchrl_quad import BPTTLoss
from torchrl_quad.files import read_rows

ROOT = Path(__file__).parent.parent
SMALL = ["num_envs=4", "horizon=6", "total_steps=192", "env.max_episode_steps=15", "compile=false", "eval.interval=2"]
SMALL += ["eval.episodes=null"]
# All that draws random numbers or keeps a memory.
EVERYTHING = ["normalize=true", "env.wind={mean: [1, 0, 0], gust: 0.5}", "env.observation_noise={position: 0.01}"]
EVERYTHING += ["env.observation_delay=1", "env.randomize={mass: {scale: [0.8, 1.2]}}", "actor.noise_correlation=0.9"]
EVERYTHING += ["actor.max_kl=0.05", "actor.average=0.5"]


def run(*command, cwd=ROOT, timeout=300, **options):
    """What a command prints, which must succeed."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def rows(folder):
    """metrics.csv, without the clock."""
    return [{k: v for k, v in row.items() if "time/" not in k} for row in read_rows(folder / "metrics.csv")]


def assert_equal(a, b, path=""):
    """Bit for bit, in all that a checkpoint holds but the clock and the revision of the code."""
    assert type(a) is type(b), path
    if isinstance(a, dict):
        assert a.keys() == b.keys(), path
        for key in a:
            if not str(key).startswith(("time/", "seconds", "processor_seconds", "config", "revision")):
                assert_equal(a[key], b[key], f"{path}/{key}")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), path
        for i, pair in enumerate(zip(a, b, strict=True)):
            assert_equal(*pair, f"{path}/{i}")
    elif isinstance(a, torch.Tensor):
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True, msg=path)
    else:
        assert a == b or (a != a and b != b), f"{path}: {a} != {b}"


def stop_at_save(monkeypatch, number, error=KeyboardInterrupt):
    """Let a run end with an error when it is about to write its n-th checkpoint."""
    from torchrl_quad.training.loop import Run

    save, saves = Run._save, []

    def stop(self, path):
        saves.append(path)
        if len(saves) == number:
            if self.logs.backend is not None:
                self.logs.backend.flush()
            raise error
        save(self, path)

    monkeypatch.setattr(Run, "_save", stop)


def poison(monkeypatch, *calls):
    """Let the loss of BPTT, or only its gradient, be NaN in these calls; None means in all."""
    count = iter(range(1_000))

    def loss_actor(self, rollout, original=BPTTLoss.loss_actor):
        loss, metrics = original(self, rollout)
        call = next(count)
        if call in calls or None in calls:
            parameter = next(self.actor_network_params.parameters())
            loss = loss + (0.0 * parameter).sqrt().sum() if call % 2 else loss * torch.nan
        return loss, metrics

    monkeypatch.setattr(BPTTLoss, "loss_actor", loss_actor)
