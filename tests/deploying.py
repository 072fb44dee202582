"""Small policies to export, and a state to fly them from."""

import ctypes
import functools
import json
import subprocess
from unittest.mock import patch

import numpy as np
import onnx
import pytest
import torch
from filelock import FileLock
from torch import nn
from torch.onnx._internal.exporter._registration import ONNXRegistry
from torchrl.envs import TransformedEnv

from torchrl_quad import ObservationNormalizer, make_actor, make_env, make_visual_actor
from torchrl_quad.deploy import export, export_policy
from torchrl_quad.deploy.tracing import Rules, name_of, trace

# torch.onnx builds its table of operators again in each call, which takes longer than most of a small export.
ONNXRegistry.from_torchlib = staticmethod(functools.cache(ONNXRegistry.from_torchlib))  # called of an instance, too

GCC = ["gcc", "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
CAMERA = {"width": 6, "height": 5, "pitch": 0.2, "rate": 2, "delay": 1, "noise": 0.02, "dropout": 0.05}
SIZES = {"num_cells": (7, 6), "channels": (2, 3)}
TASKS = {  # with all that policies may read, spread over the tasks
    "hovering": {},
    "tracking": {"drone": "crazyflie", "curve": "lemniscate", "observe_last_action": True, "action_delay": 2},
    "landing": {
        "control": "attitude",
        "observation_noise": {"position": 0.01, "attitude": 0.05},
        "observation_delay": 1,
        "randomize": {"mass": {"scale": [0.8, 1.2]}, "motor_time_constant": {"uniform": [0.02, 0.05]}},
        "wind": {"mean": [1, 0, 0], "gust": 0.5},
        "random_start": {"tilt": 0.5, "yaw": 3.0},
    },
    "racing": {"action_delay": 0, "control": {"mode": "velocity", "max_speed": 4.0, "max_tilt": 0.7}},
    "forest": {"camera": CAMERA, "density": 0.05, "random_start": {"tilt": 0.5, "yaw": 3.0, "velocity": 3.0}},
    "forest, blind": {"camera": {"width": 4, "height": 3}, "density": 0.01}
    | {"observe_velocity": False, "observe_last_action": True},
    "hovering, with memory": {"control": "rotor_thrusts"},
    "hovering, without memory": {
        "camera": {"width": 5, "height": 4, "position": [0.1, 0, 0], "along_ray": True, "rate": 2, "delay": 3}
    }
    | {"control": "rotor_thrusts", "drone": "typhoon_h480"},
}
NORMALIZED = ("tracking", "racing", "forest")
SAME_RULES = {"hovering, with memory": "hovering", "hovering, without memory": "hovering"}  # which are traced once
FLOWN = ("hovering", "tracking", "racing", "landing", "forest")  # of each task one


def build(name, num_envs=16):
    """An environment whose policy is untrained but moves, with its normaliser if it has one."""
    torch.manual_seed(0)
    env = make_env(name.split(",")[0], num_envs=num_envs, **{"max_episode_steps": 48, **TASKS[name]})
    if name in NORMALIZED:
        env = TransformedEnv(env, ObservationNormalizer(env))
        env.transform.update(env.rollout(20, break_when_any_done=False))
    if "depth" in env.observation_spec and "blind" not in name:
        actor = make_visual_actor(env, **SIZES, hidden_size=4, recurrent="without" not in name, input_scale=0.3)
        last = actor[0][-1].module.mlp[-1]
    else:
        memory = {"recurrent": True, "hidden_size": 4} if "with memory" in name else {}
        actor = make_actor(env, (16, 16), **memory)
        last = actor.last.mlp[-1]
    with torch.no_grad():
        last.weight.add_(0.3 * torch.randn_like(last.weight))
    return env, actor


def pilot(env, sink=2.0, after=0, beyond=0.0, directed=False):
    """A policy by hand, a single layer: fly to the first point that is observed, level and without turning.

    ``sink`` is the stiffness of the height; ``after`` numbers come behind the body's in the observation;
    it flies ``beyond`` the point [m], along x, or 1 m along the direction that is observed after two points.
    """
    actor = make_actor(env, ())
    (layer,) = (x for x in actor[0].module.mlp if isinstance(x, nn.Linear))
    with torch.no_grad():
        weight = torch.zeros_like(layer.weight)
        x, q, v, w = 0, *(weight.shape[1] - after - k for k in (10, 6, 3))  # where the quantities begin
        weight[0, x + 2], weight[0, v + 2] = 0.2 * sink, -0.4
        for axis, along, sign in ((1, 1, -1.0), (2, 0, 1.0)):  # roll moves along -y, pitch along x
            weight[axis, x + along], weight[axis, v + along] = sign * 0.8, sign * -1.0
            weight[axis, q + axis] = -0.6
        weight[3, q + 3] = -0.3
        weight[:, 6:9] += 0.1 * directed * weight[:, :3]
        weight[1:4, w : w + 3] += -0.02 * torch.eye(3)
        layer.weight.copy_(weight)
        layer.bias[1:4] = torch.tensor([0.0, 0.8 * beyond, 0.0])
    return actor


def resting(**changes):
    """A level drone at rest near the target of hovering, as a bundle takes it."""
    still = {"position": [1, 0, 1.4], "quaternion": [1, 0, 0, 0], "velocity": [0, 0, 0], "angular_velocity": [0, 0, 0]}
    return {**still, "age": 0.0, **changes}


def measured(bundle, **changes):
    """A state that the policy of a bundle can fly from."""
    camera = bundle.contract["camera"]
    images = {"depth": np.full((camera["height"], camera["width"]), 3.0), "depth_age": 0.0} if camera else {}
    return resting(**images | changes)


def contract_of(drone, dynamics="quadrotor", dt=0.001):
    """What simulators read of a contract: of a drone by its fields, whose policy commands rates."""
    body_rate, thrust = [[-x, x] for x in drone["max_body_rate"]], [0.0, 9.81]
    output = {"control": "rates", "gains": {}, "range": [thrust, *body_rate]}
    output |= {"body_rate": {"range": body_rate}, "thrust": {"range": thrust}}
    simulator = {"dynamics": dynamics, "dt": dt, "integrator": "semi_implicit_euler"}
    about = {"drone": drone, "plant": {}, "control_dt": 0.02, "rate_loop": {}, "simulator": simulator}
    about |= {"camera": None, "obstacles": None, "output": output}
    return {**about, "task": {"name": "racing", "unjudged": ""}, "origin": {"package": "torchrl_quad"}}


def rules_of(env, _, folder):
    """The rules in a bundle, of an environment and its policy."""
    about = json.loads((folder / "contract.json").read_text())
    graphs = {name: onnx.load(folder / f"{name}.onnx") for name in about["graphs"] if name != "policy"}
    keys = {name_of(key): key for key in getattr(env, "base_env", env).task_entries}
    obstacles = [x for x in about["graphs"].get("judge", {"reads": {}})["reads"] if x.startswith("scene.")]
    obstacles = {name: tuple(name.split(".")) for name in obstacles}
    entries = {name: keys[name] for name in about["task"]["entries"]}
    return Rules(graphs, entries, obstacles, about["task"]["unjudged"])


@pytest.fixture(scope="session")
def export_once(tmp_path_factory, worker_id):
    """Environment, policy and bundle of a task, exported once for all processes, since tracing takes seconds."""
    base = tmp_path_factory.getbasetemp()
    shared = (base if worker_id == "master" else base.parent) / "bundles"
    shared.mkdir(exist_ok=True)

    @functools.cache
    def export_once(task, make=build):
        """``make`` builds environment and policy by the name of the task; by default it is one of TASKS."""
        torch.set_num_threads(1)
        env, actor = make(task)
        with FileLock(shared / f"{task}.lock"):
            if not (shared / task).exists():
                rules = rules_of(*export_once(SAME_RULES[task])) if task in SAME_RULES else None
                with patch.object(export, "trace", trace if rules is None else lambda *_: rules):
                    export_policy(actor, env, shared / task)
        return env, actor, shared / task

    return export_once


@pytest.fixture
def trace_once(export_once, monkeypatch):
    """Makes further exports of a class of tasks in a test take their rules from the bundle that all share."""

    def trace_once(task):
        exported = export_once(task)
        rules, own = rules_of(*exported), type(getattr(exported[0], "base_env", exported[0]))
        monkeypatch.setattr(export, "trace", lambda env, *given: rules if type(env) is own else trace(env, *given))

    return trace_once


def compiled(folder, out):
    subprocess.run([*GCC, str(folder / "policy.c"), "-o", str(out), "-lm"], check=True)
    return ctypes.CDLL(str(out))


def run_c(library, given, actions=4):
    """Actions in C for what a policy reads, by name, each (n, ...); the memory (n, m) becomes that of the next step."""
    pointer, action = ctypes.POINTER(ctypes.c_float), np.zeros(actions, np.float32)
    rows = []
    for i in range(len(given["observation"])):
        reads = [given[name][i].ctypes.data_as(pointer) for name in ("observation", "depth", "memory") if name in given]
        assert library.policy_action(*reads, action.ctypes.data_as(pointer)) == 0
        rows.append(action.copy())
    return np.stack(rows)


def by_hand(actor, observation, depth=None, memory=None):
    """The mean action and the memory after it, from the weights; torch's own recurrent cell is not TorchRL's."""
    if depth is None and memory is None:
        return torch.tanh(actor[0].module.mlp(observation).chunk(2, 1)[0]), None
    sight, head = actor[0][0].module, actor[0][-1].module.mlp
    if depth is None:
        x = nn.functional.elu(sight.trunk.mlp(observation))
    else:
        x = 1 / depth.clamp(min=0.3)
        for eye in list(sight.convolutions)[:-1:2]:
            x = nn.functional.elu(nn.functional.conv2d(x, eye.weight, eye.bias, 2, 1))
        x = nn.functional.elu(sight.trunk.mlp(torch.cat((x.flatten(1), 0.3 * observation), 1)))
    if memory is not None:
        gru = actor[0][1].gru
        memory = torch.gru_cell(x, memory, gru.weight_ih_l0, gru.weight_hh_l0, gru.bias_ih_l0, gru.bias_hh_l0)
        x = torch.cat((x, memory), 1)
    return torch.tanh(head(x).chunk(2, 1)[0]), memory
