"""What many tests share: tables of cases and refusals, flights by hand, and small training runs."""

import inspect
import subprocess
from pathlib import Path

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_quad import BPTTLoss
from torchrl_quad.files import read_rows

ROOT = Path(__file__).parent.parent
SMALL = ["num_envs=4", "horizon=6", "total_steps=192", "env.max_episode_steps=15", "compile=false", "eval.interval=2"]
SMALL += ["eval.episodes=null"]
# All that draws random numbers or keeps a memory.
EVERYTHING = ["normalize=true", "env.wind={mean: [1, 0, 0], gust: 0.5}", "env.observation_noise={position: 0.01}"]
EVERYTHING += ["env.observation_delay=1", "env.randomize={mass: {scale: [0.8, 1.2]}}", "actor.noise_correlation=0.9"]
EVERYTHING += ["actor.max_kl=0.05", "actor.average=0.5"]
# Drones of every kind of controller settings, for flights that would take too long with all that ship.
FLOWN = ("crazyflie", "flightmare", "small_racer", "visfly")


def cases(*rows, ids=None):
    """Parametrises a test by rows: of the values of its first arguments, as many as a row has."""

    def parametrised(test):
        names = list(inspect.signature(test).parameters)[: len(getattr(rows[0], "values", rows[0]))]
        return pytest.mark.parametrize(names, rows, ids=ids)(test)

    return parametrised


def refuses(message, call, /, *arguments, error=ValueError, **options):
    """A call raises an error that says this; what it is given was made before. Returns all that it says."""
    with pytest.raises(error, match=message) as refused:
        call(*arguments, **options)
    return str(refused.value)


def fly(env, td, actions):
    """Step through a list of actions; returns the steps, stacked along time."""
    steps = []
    for action in actions:
        td = td.copy().set("action", action)
        steps.append(env.step(td))
        td = env.step_mdp(steps[-1])
    return torch.stack(steps, 1)


def hold(env, steps):
    """The actions that hover, for some steps."""
    return [env.hover_action.expand(env.num_envs, 4)] * steps


def start(env, **entries):
    """A reset with some entries of the state set."""
    td = env.reset()
    for key, value in entries.items():
        td["state", key] = torch.as_tensor(value, dtype=td["state", key].dtype).expand_as(td["state", key]).clone()
    return env.reset(td, set_state=True)


def anew(env, seed=0):
    """The environment, whose generator and torch's own begin from a seed."""
    env.set_seed(seed)
    torch.manual_seed(seed)
    return env


def pushed(env, actor, at, push):
    """Nine steps in TorchRL's loop, without a graph; ``push`` changes what the actor writes in step ``at``."""
    count = iter(range(100))

    def policy(td):
        td = actor(td)
        if next(count) == at:
            push(td)
        return td

    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return EnvBase.rollout(anew(env), 9, policy, auto_cast_to_device=False, break_when_any_done=False)


def on_plain_tensors(actor, td, kind=ExplorationType.RANDOM):
    """What an actor writes, its form on plain tensors, and the noise that was drawn."""
    with set_exploration_type(kind):
        torch.manual_seed(3)
        written, plain = actor(td.copy()), actor.plain()
        torch.manual_seed(3)
        return written, plain, plain.drawn(1, len(td), {})[0]


def look_at_nothing(patch):
    """Let the code believe that its tensors are on an accelerator, which it must not wait for."""
    for name in ("engine.horizon", "envs.randomness", "envs.guard"):
        patch.setattr(f"torchrl_quad.{name}.looks_are_free", lambda device: False)


class Looks(TorchDispatchMode):
    """Counts how often a value of a tensor is read."""

    count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count += function is torch.ops.aten._local_scalar_dense.default
        return function(*args, **(kwargs or {}))


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
