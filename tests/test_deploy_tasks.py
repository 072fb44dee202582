"""Any task exports: its rules, traced, observe, advance and judge as its environment does."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from deploying import pilot, resting
from own_task import CornerEnv, RelayEnv
from refusals import refuses
from torchrl.envs.utils import ExplorationType

from torchrl_quad import RacingEnv, TrackingEnv, differentiable_rollout, make_actor, make_env
from torchrl_quad.deploy import export_policy, load_bundle
from torchrl_quad.deploy.contract import MEASURED
from torchrl_quad.deploy.judging import Judge, judge
from torchrl_quad.deploy.tracing import name_of, trace
from torchrl_quad.deploy.transfer import fly
from torchrl_quad.envs.step import sample_state
from torchrl_quad.errors import UserValueError

ROOT = Path(__file__).parent.parent


def ring_env():
    """The class of examples/04_own_task.py, without the training in it."""
    tree = ast.parse((ROOT / "examples/04_own_task.py").read_text())
    tree.body = [x for x in tree.body if isinstance(x, ast.Import | ast.ImportFrom | ast.ClassDef)]
    names = {"__name__": "ring"}
    exec(compile(tree, "04_own_task.py", "exec"), names)
    return names["RingEnv"]


OWN = {"relay": RelayEnv, "ring": ring_env()}
HARDER = {  # so that some episodes succeed, some do not, and some crash
    "hovering": {"box_height": 1.7},
    "tracking": {"success_radius": 1.24, "ceiling": 1.15},
    "landing": {"success_speed": 0.28, "box_half_width": 0.9},
    "racing": {"success_gates": 1, "ceiling": 1.5},
    "relay": {},
    "ring": {},
}
PILOTS = {"relay": {"after": 6}, "ring": {"beyond": 0.5}}


def harder(name):
    task = name.removesuffix(", harder")
    options = {"num_envs": 16, "max_episode_steps": 130, "seed": 1, "random_start": {"velocity": 2.0, "tilt": 0.3}}
    env = OWN[task](**options) if task in OWN else make_env(task, **options)
    vars(env).update(HARDER[task])
    return env, pilot(env, **PILOTS.get(task, {}))


@pytest.mark.parametrize("task", HARDER)
def test_flights_are_judged_as_the_environment_judges_them(export_once, task):
    """In flights of its own, and in those of a bundle in our simulator, of tasks of one's own, too."""
    env, actor, folder = export_once(f"{task}, harder", harder)
    bundle = load_bundle(folder)
    with torch.no_grad():
        mode = {"exploration_type": ExplorationType.DETERMINISTIC}
        flight, _ = differentiable_rollout(env, actor, None, 130, **mode)
    expected = {name: x.numpy() for name, x in env.episode_metrics(flight).items()}
    assert 0 < expected["solved"].sum() < 16 and 0 < expected["crash"].sum() < 16
    states = {name: torch.cat((flight["state", name][:, :1], flight["next", "state", name]), 1) for name in MEASURED}
    flown = {name: x.numpy() for name, x in states.items()} | {"action": flight["action"].numpy()}
    keys = {name_of(key): key for key in env.task_entries}
    first = {name: flight["state", keys[name]][:, 0].numpy() for name in bundle.contract["task"]["entries"]}
    found = judge(bundle, flown | first)
    assert set(found) == set(expected) - {"return", "spin"}
    follows = Judge(bundle, first | {name: x[:, 0] for name, x in flown.items()})
    for t in range(10):
        follows.step(flown["action"][:, t], {name: flown[name][:, t + 1] for name in MEASURED})
    for name, values in found.items():
        np.testing.assert_allclose(values, expected[name], rtol=1e-4, atol=1e-5, err_msg=name)
    for name, x in follows.flight().items():
        key = keys.get(name, name)
        own = flight["next", "state", key][:, :10] if name in keys else flight["next", name][:, :10, 0]
        ended = flight["next", "done"][:, :10].cumsum(1).bool().numpy()[..., 0]
        x = x[:, 1:] if name in keys else x
        np.testing.assert_allclose(x[~ended], own.numpy()[~ended], rtol=1e-5, atol=1e-6, err_msg=name)
    ours = fly(bundle, "torchrl_quad")
    for name in ("solved", "crash"):
        assert ours["metrics"][name].mean() == pytest.approx(bundle.contract["results"][name], abs=1 / 15)


def test_a_contract_names_what_the_rules_of_a_task_read_and_nothing_else(export_once):
    about = load_bundle(export_once("relay, harder", harder)[2]).contract
    assert about["task"]["name"] == "own_task.RelayEnv"
    assert about["task"]["about"] == "Visit points in turn, over and over."
    entries = {name: (x["shape"], x["dtype"]) for name, x in about["task"]["entries"].items()}
    whole, flag, real = ([1], "int64"), ([1], "bool"), ([1], "float32")
    assert entries == {"stage": whole, "visited": whole, "is_near": flag, "record.gap": real}
    reads = {name: set(x["reads"]) - {*MEASURED} for name, x in about["graphs"].items()}
    assert reads["observe"] == {"stage", "is_near", "step", "action_queue"}
    assert reads["advance"] == {"previous.stage", "previous.visited", "previous.is_near", "previous.record.gap"}
    assert reads["judge"] == {"visited", "record.gap", "step"}
    velocity = {"shape": [3], "dtype": "float32", "unit": "m/s", "frame": "world"}
    assert about["graphs"]["observe"]["reads"]["velocity"] == velocity
    assert set(about["task"]["metrics"]) == {"solved", "crash", "visited", "nearest"}  # but no speed of rotors
    assert about["task"]["metrics"]["nearest"] == {"label": "nearest", "unit": "cm", "scale": 100.0, "median": False}


def test_a_race_with_noise_and_delay_is_exported_though_gates_are_counted_from_true_positions(tmp_path):
    gates = [[0, 0, 2], [1, 0, 2]]
    sensors = {"observation_noise": {"position": 0.3}, "observation_delay": 2}
    env = RacingEnv(num_envs=16, max_episode_steps=16, track={"gates": gates, "starts": gates}, **sensors)
    bundle = load_bundle(export_policy(make_actor(env, (8,)), env, tmp_path / "policy"))
    assert bundle.contract["observation_delay"] == 2
    bundle.reset(gate=1)
    bundle(resting(position=[0, 0, 2]))
    np.testing.assert_array_equal(bundle.observation[:6], [1, 0, 0, 0, 0, 0])
    assert (bundle.progress["gate"], bundle.progress["gates_passed"]) == (1, 0)
    bundle(resting(position=[2, 0, 2]))  # past the gate: neither end is near
    assert (bundle.progress["gate"], bundle.progress["gates_passed"]) == (0, 1)


def corner(phase):
    return torch.stack((phase.sin(), (phase - math.pi).abs(), 2 + 0 * phase), -1)


def test_a_curve_with_corners_and_double_precision_export(tmp_path):
    env = TrackingEnv(num_envs=2, curve=corner, period=4.0, dtype=torch.float64, max_episode_steps=16)
    bundle = load_bundle(export_policy(make_actor(env, (4,)), env, tmp_path / "policy"))
    bundle.reset(phase=1.0)
    bundle(resting(position=[0, 0, 2]))
    ahead = torch.tensor([1.0], dtype=torch.float64) + env.ahead
    np.testing.assert_allclose(bundle.observation[:30], (corner(ahead) - env.tensor([0, 0, 2])).flatten(), atol=1e-6)


def method(name, function):
    return type("Wrong", (CornerEnv,), {name: function})


GOALS = torch.zeros(4, 3)
WRONGS = {
    r"observe cannot be exported: it draws random numbers \(uniform\). Draw them in initial_state": method(
        "observe", lambda self, state: CornerEnv.observe(self, state) + self.uniform(len(state["position"]), 1)
    ),
    r"metrics cannot be exported: it draws random numbers \(.*rand": method(
        "metrics", lambda self, state: {"corner_error": torch.rand_like(state["position"][:, :1])}
    ),
    "observe cannot be exported: .* no tensor with one row per environment": method(
        "observe", lambda self, state: torch.cat((state["position"] - GOALS[: self.num_envs], state["velocity"]), -1)
    ),
    "is_crash and is_success cannot be exported: .* no Python `if` on values": method(
        "is_crash", lambda self, state: state["position"][:, 2:] < (1 if state["position"].mean() > 0 else 2)
    ),
    "observation cannot be exported: it follows from 'rotor_speed', which no drone measures. A drone": method(
        "observe", lambda self, state: torch.cat((state["position"], state["rotor_speed"]), -1)
    ),
}


@pytest.mark.parametrize("message", WRONGS)
def test_a_rule_that_cannot_be_exported_is_refused_by_its_name_with_what_to_write(message):
    env = WRONGS[message](4)
    refuses(f"^export_policy: Wrong: its {message}", trace, env, sample_state(env, 3), error=UserValueError)


def test_a_task_that_cannot_be_judged_without_its_reward_still_flies(tmp_path):
    def by_return(self, rollout):
        metrics = CornerEnv.episode_metrics(self, rollout)
        return {**metrics, "solved": metrics["solved"] * (metrics["return"] > 0)}

    env = method("episode_metrics", by_return)(4, max_episode_steps=8)
    bundle = load_bundle(export_policy(make_actor(env, (4,)), env, tmp_path / "policy"))
    bundle(resting())
    why = "solved: it follows from 'next.reward', which no drone measures"
    assert bundle.contract["task"]["unjudged"] == why and bundle.graphs.keys() == {"policy", "observe"}
    with pytest.raises(UserValueError, match=f"cannot fly this bundle of the task .*: {why}. Fly it in the package's"):
        fly(bundle, "torchrl_quad")
    refuses(f"cannot be judged here: {why}", Judge, bundle, bundle.starts(), error=UserValueError)
