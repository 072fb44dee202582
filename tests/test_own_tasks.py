"""Tasks and recipes of somebody's own, which are not in the repository."""

import importlib
import json
import math
import re
import sys

import gymnasium
import pytest
from helpers import SMALL, cases, refuses, rows
from hydra.core.config_store import ConfigStore
from own_task import CornerEnv
from test_configuration import composed
from test_docs import ROOT, files, importable  # noqa: F401, a fixture

from torchrl_quad import HoveringEnv, QuadrotorEnv, TrackingEnv, available_tasks, make_env, register_task
from torchrl_quad.envs import TASKS, registry
from torchrl_quad.training.checkpoints import read_checkpoint
from torchrl_quad.training.configuration import defaults
from torchrl_quad.training.schema import check


@pytest.fixture(autouse=True)
def forget(monkeypatch):
    """What a test registers is known to it alone."""
    monkeypatch.setattr(registry, "TASKS", dict(TASKS))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    monkeypatch.setattr(ConfigStore.instance(), "repo", dict(ConfigStore.instance().repo))


def test_one_line_makes_a_task_known_to_make_env_and_to_gymnasium():
    register_task("fly_to_corner", CornerEnv)
    register_task("fly_to_corner", CornerEnv)  # a cell of a notebook that runs again
    assert "fly_to_corner" in available_tasks() and type(make_env("fly_to_corner", num_envs=2, reach=0.1)) is CornerEnv
    drones = gymnasium.make_vec("torchrl_quad/FlyToCorner-v0", num_envs=2, reach=0.1)
    assert drones.reset(seed=0)[0].shape == (2, 13)
    assert type(make_env("own_task.CornerEnv", num_envs=2)) is CornerEnv  # without any name


class LateEnv(CornerEnv):
    def __init__(self, num_envs=8, **kwargs):
        self.corner = self.tensor([1.0, 1.0, 1.0])
        super().__init__(num_envs, **kwargs)


class LaterEnv(LateEnv):
    def __init__(self, num_envs=8, *, speed=1.0, **kwargs):
        QuadrotorEnv.__init__(self, num_envs, **kwargs)
        self.reach = speed


@pytest.mark.parametrize("task", [LateEnv, LaterEnv])
def test_what_is_set_too_early_or_too_late_comes_with_a_note_of_the_order(task):
    with pytest.raises(AttributeError, match="no attribute '(randomness|reach)'") as refused:
        task()
    assert "set what they read before it, and make tensors in set_up" in refused.value.__notes__[0]
    with pytest.raises(AttributeError, match="no attribute 'unifrom'") as refused:  # a slip, and no matter of order
        type("OwnEnv", (HoveringEnv,), {"observe": lambda env, _: env.unifrom(4)})()
    assert not hasattr(refused.value, "__notes__")


class UnfinishedEnv(QuadrotorEnv):
    def observe(self, state):
        return state["position"]


@cases(
    ("Window", CornerEnv, ValueError, "small letters, digits and underscores, such as 'window'; got 'Window'"),
    ("hovering", CornerEnv, ValueError, "is torchrl_quad.envs.hovering.HoveringEnv already. Choose another name"),
    ("x", CornerEnv(num_envs=1), TypeError, "subclass of QuadrotorEnv, itself and not an instance; got CornerEnv"),
    ("x", dict, TypeError, "a subclass of QuadrotorEnv, itself and not an instance; got the class dict"),
    ("x", UnfinishedEnv, TypeError, "UnfinishedEnv lacks initial_state, is_crash, is_success, reward_terms. docs/"),
)
def test_what_is_no_task_is_refused_when_it_is_registered(name, cls, error, message):
    refuses(message, register_task, name, cls, error=error)


@cases(
    ("window", "Unknown task 'window'. Choose from: .*racing.* give the path .*, or call register_task"),
    ("no_package.WindowEnv", "Python finds no module 'no_package'. Put its folder on PYTHONPATH, or install"),
    ("own_task.Corner", "the module 'own_task' .* has no 'Corner'. Write one of: own_task.CornerEnv"),
    ("own_task.norm", "a task is a subclass of QuadrotorEnv"),
)
def test_recipes_say_in_one_line_how_a_task_that_they_do_not_know_becomes_known(task, message, refused, tmp_path):
    assert re.search(message, refused("bptt", f"task={task}", f"hydra.run.dir={tmp_path}/run"))
    assert not list(tmp_path.iterdir())


@cases(
    ("env.reach=far", "env.reach=far: it must be a number"),
    ("env.patience=0.5", "env.patience=0.5: it must be a whole number"),
    ("+env.rech=1", "argument 'rech'. Did you mean 'reach'?"),
    ("+env.seed=1", "env.seed: recipes set it for all environments. Write seed=..., without env"),
)
def test_the_settings_of_a_task_come_from_its_signature_and_are_checked_by_it(words, message):
    assert defaults(CornerEnv) == {"reach": 0.5, "patience": None, "dt": 0.01, "max_episode_steps": 256}
    assert defaults(HoveringEnv) == {"max_episode_steps": 256}
    task = "task._target_=own_task.CornerEnv"
    check(composed("bptt", task, "env.reach=1", "env.patience=3"))
    refuses(re.escape(message), check, composed("bptt", task, words), error=(ValueError, TypeError))


@cases(
    ("env.disturbances=[own_task.ABPTLoss]", "=own_task.ABPTLoss: it must be a subclass of Disturbance"),
    ("env.disturbances=[own_task.Pull]", "'own_task.Pull': the module 'own_task' .* has no 'Pull'"),
    ("env.disturbances=[Push]", "env.disturbances='Push': it must be the path of a class"),
    ("env.disturbances=own_task.Push", "env.disturbances=own_task.Push: it must be a list"),
    ("env.disturbances=[{_target_: own_task.Push, force: 1}]", "unknown key 'force'. Allowed: streng"),
    ("loss._target_=own_task.Push", "loss._target_=own_task.Push: it must be a subclass of ABPTLoss"),
    ("loss._target_=own_task.ThriftyLoss loss.efort=1", "loss.efort is unknown.* effort, "),
    ("loss._target_=own_task.ThriftyLoss loss.effort=low", "loss.effort=low: it must be a number"),
    ("loss._target_=own_task.ThriftyLoss loss.alpha=-1", "loss.alpha=-1: it must be at least 0"),
)
def test_a_disturbance_or_a_loss_of_your_own_that_does_not_fit_is_refused(words, message):
    overrides = words.split(" loss")
    overrides = [overrides[0], *(f"loss{word}" for word in overrides[1:])]
    refuses(message, check, composed("abpt", *overrides), overrides, error=(ValueError, TypeError))


def test_what_is_your_own_trains_resumes_is_evaluated_and_exported_as_what_ships(train, launch, refused, tmp_path):
    own = ["task._target_=own_task.CornerEnv", "env.disturbances=[{_target_: own_task.Push, strength: 0.1}]"]
    own += ["loss._target_=own_task.ThriftyLoss", "loss.effort=0.2"]
    first = train("abpt", tmp_path, *own, "env.reach=0.1")
    saved = train("abpt", tmp_path, *own, "resume=auto", "total_steps=240")
    assert saved["iteration"] == 10
    assert "task: own_task.CornerEnv" in saved["config"] and "effort: 0.2" in saved["config"]
    assert first["rows"][0]["train/effort"] < 0
    assert float(rows(tmp_path)[-1]["eval/corner_error"]) > 0
    trust = "trust=[own_task.CornerEnv, own_task.Push, own_task.ThriftyLoss]"
    for recipe, setting in ("evaluate", "checkpoint"), ("abpt", "resume"):
        said = refused(recipe, f"{setting}={tmp_path}/checkpoint.pt")
        assert said.endswith(f"file names is not run: if you trust it, write '{trust}'.")
    printed = launch("evaluate", f"checkpoint={tmp_path}/checkpoint.pt", trust)
    assert "abpt on own_task.CornerEnv" in printed and "distance to the corner" in printed
    summary = json.loads((tmp_path / "evaluation.json").read_text())
    assert summary["corner_error"] == json.loads((tmp_path / "summary.json").read_text())["corner_error"]
    printed = launch("export", f"checkpoint={tmp_path}/checkpoint.pt", trust, "episodes=4")
    assert "policy: flies own_task.CornerEnv; its actions differ by at most" in printed


@pytest.mark.usefixtures("importable", "no_pictures")
def test_a_recipe_outside_the_repository_is_short_and_takes_any_task(tmp_path, monkeypatch, capsys):
    """The programs of docs/writing.md, in files, as the page says."""
    assert all(len(content.splitlines()) < 60 for content in files().values())
    register_task("fly_to_corner", CornerEnv)
    sweep = ["hydra/launcher=basic", f"hydra.sweep.dir={tmp_path}/run", "hydra.sweep.subdir=${task}"]
    own = ["task=shuttle.ShuttleEnv,fly_to_corner", "loss.smoothness=0.3"]
    monkeypatch.setattr(sys, "argv", ["smooth.py", "--multirun", *SMALL, *sweep, *own])
    importlib.import_module("smooth").main()
    printed = capsys.readouterr().out
    assert "smooth on shuttle.ShuttleEnv, seed 0" in printed and "smooth on fly_to_corner, seed 0" in printed
    saved = read_checkpoint(tmp_path / "run/shuttle.ShuttleEnv/checkpoint.pt")
    assert "smoothness: 0.3" in saved["config"] and "algorithm: smooth" in saved["config"]
    assert math.isfinite(saved["best"]["return"])


def test_a_task_may_have_other_defaults_of_arguments_that_callers_and_recipes_see_and_may_change():
    class NearEnv(CornerEnv):
        defaults = {"reach": 0.1, "drone": "racer", "num_envs": 3}

    env = NearEnv()
    assert (env.num_envs, env.reach, NearEnv(2, reach=0.3).reach, NearEnv(2).num_envs) == (3, 0.1, 0.3, 2)
    assert "drone='racer'" in repr(env) and "drone='racer'" in repr(env.rebuilt(num_envs=2))
    assert defaults(NearEnv) == {**defaults(CornerEnv), "reach": 0.1, "drone": "racer"}
    NearEnv.defaults = {"drne": "racer"}
    refuses("argument 'drne'. Did you mean 'drone'", NearEnv, error=TypeError)


def test_a_metric_that_is_described_and_not_given_is_named():
    silent = type("SilentEnv", (CornerEnv,), {"metrics": lambda self, state: {}})
    refuses(r"SilentEnv.metrics\(state\) lacks corner_error, which metric_info describes", silent)


@pytest.mark.parametrize("task", [HoveringEnv, TrackingEnv])
def test_an_episode_is_solved_by_a_success_of_your_own(task):
    class Own(task):
        def is_success(self, state):
            return state["step"] % 2 == 0

    for steps, solved in ((4, 1.0), (3, 0.0)):
        env = Own(num_envs=2, max_episode_steps=steps)
        metrics = env.episode_metrics(env.rollout(steps, auto_reset=True))
        assert metrics["solved"].tolist() == [solved] * 2
