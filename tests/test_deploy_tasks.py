"""Any task exports, its rules traced; bundles that were changed and policies that cannot fly are refused."""

import ast
import ctypes
import json
import math
import shutil

import numpy as np
import onnx
import pytest
import torch
from deploying import build, compiled, pilot, resting
from helpers import ROOT, refuses
from onnx import TensorProto, helper
from own_task import CornerEnv, RelayEnv
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_quad import ForestEnv, HoveringEnv, RacingEnv, TrackingEnv, differentiable_rollout, make_env
from torchrl_quad.deploy import WrongActions, contract, export, export_policy, load_bundle, transfer
from torchrl_quad.deploy.bundle import Bundle
from torchrl_quad.deploy.contract import MEASURED, BrokenPolicy, TamperedBundle, UnknownContract
from torchrl_quad.deploy.judging import Judge, judge
from torchrl_quad.deploy.tracing import name_of, trace
from torchrl_quad.deploy.transfer import fly
from torchrl_quad.dynamics.parameters import LIMITS
from torchrl_quad.envs.step import sample_state
from torchrl_quad.errors import UserValueError
from torchrl_quad.modules import make_actor, make_visual_actor


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
    "racing": {"success_gates": 2},
    **{"relay": {}, "ring": {}},
}
RANDOM_TRACK = {"file": "random", "random": {"gates": 3, "spacing": [2, 4]}, "frame": 0.3}
OPTIONS = {"racing": {"track": RANDOM_TRACK, "observe_directions": True}}
PILOTS = {"relay": {"after": 6}, "ring": {"beyond": 0.5}, "racing": {"directed": True}}


def harder(name):
    task = name.removesuffix(", harder")
    options = {"num_envs": 16, "max_episode_steps": 130, "seed": 1, "random_start": {"velocity": 2.0, "tilt": 0.3}}
    options |= OPTIONS.get(task, {})
    env = OWN[task](**options) if task in OWN else make_env(task, **options)
    vars(env).update(HARDER[task])
    return env, pilot(env, **PILOTS.get(task, {}))


SLOW = ["ring", "hovering"]  # whose rules are like those of the relay, and of tracking


@pytest.mark.parametrize("task", [pytest.param(x, marks=[pytest.mark.slow] * (x in SLOW)) for x in HARDER])
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


def test_a_race_with_noise_and_delay_is_exported_though_gates_are_counted_from_true_positions(trace_once, tmp_path):
    trace_once("racing")  # whose rules are the same
    sensors = {"observation_noise": {"position": 0.3}, "observation_delay": 2}
    env = RacingEnv(num_envs=64, max_episode_steps=16, action_delay=0, **sensors)
    bundle = load_bundle(export_policy(make_actor(env, (8,)), env, tmp_path / "policy"))
    assert bundle.contract["observation_delay"] == 2
    (gate, after), before = env.gates[1:3].numpy(), np.array([-1.0, 0.0, 0.0])
    bundle.reset(gate=1)
    bundle(resting(position=gate + before))
    np.testing.assert_allclose(bundle.observation[:6], [*-before, *after - gate - before], atol=1e-5)
    assert (bundle.progress["gate"], bundle.progress["gates_passed"]) == (1, 0)
    bundle(resting(position=gate - before))  # past the gate: neither end is near
    assert (bundle.progress["gate"], bundle.progress["gates_passed"]) == (2, 1)


def corner(phase):
    return torch.stack((phase.sin(), (phase - math.pi).abs(), 2 + 0 * phase), -1)


def test_a_curve_with_corners_and_double_precision_export(tmp_path):
    env = TrackingEnv(num_envs=64, curve=corner, period=4.0, dtype=torch.float64, max_episode_steps=16)
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

    env = method("episode_metrics", by_return)(64, max_episode_steps=8)
    bundle = load_bundle(export_policy(make_actor(env, (4,)), env, tmp_path / "policy"))
    bundle(resting())
    why = "solved: it follows from 'next.reward', which no drone measures"
    assert bundle.contract["task"]["unjudged"] == why and bundle.graphs.keys() == {"policy", "observe"}
    with pytest.raises(UserValueError, match=f"cannot fly this bundle of the task .*: {why}. Fly it in the package's"):
        fly(bundle, "torchrl_quad")
    refuses(f"cannot be judged here: {why}", Judge, bundle, bundle.starts(), error=UserValueError)


@pytest.fixture
def copied(export_once, tmp_path):
    """A copy of a bundle, and its contract."""
    folder = shutil.copytree(export_once("hovering")[2], tmp_path / "policy")
    return folder, json.loads((folder / "contract.json").read_text())


def fit(folder, about):
    """Write a contract with checksums that fit, as somebody who changes a bundle does."""
    about["sha256"] = {name: contract.sha256((folder / name).read_bytes()) for name in contract.files(about)}
    (folder / "contract.json").write_text(json.dumps(about | {"digest": contract.digest(about)}))


@pytest.mark.parametrize("name", [*contract.OTHERS, "policy.onnx", "observe.onnx", "episode.onnx", "contract.json"])
def test_a_file_that_was_changed_or_is_missing_is_named(copied, name):
    folder, _ = copied
    assert load_bundle(folder).check() <= 1e-5
    content = (folder / name).read_bytes()
    damaged = content.replace(b"0.46", b"0.45") if name == "contract.json" else content[:-3] + b"abc"
    (folder / name).write_bytes(damaged)
    with pytest.raises(TamperedBundle, match=f"{name} was changed after the export: its checksum does not fit"):
        load_bundle(folder)
    (folder / name).unlink()
    why = f"{name} cannot be read|No bundle at .* has no contract"
    refuses(why, load_bundle, folder, error=(TamperedBundle, FileNotFoundError))


@pytest.mark.parametrize("text", ["[]", "{", "{}", "", "[" * 100_000, '{"version": NaN, "digest": ""}'])
def test_a_file_that_is_no_contract_is_refused(tmp_path, text):
    (tmp_path / "contract.json").write_text(text)
    refuses("contract.json is no contract of a policy, or is damaged", load_bundle, tmp_path, error=TamperedBundle)


CHANGES = [  # of a contract whose checksums fit
    ("version", 3, "has version 3, and this torchrl_quad reads 5. It was written by torchrl_quad"),
    ("smell", {}, r"/contract.json: it: .*'smell' was unexpected.* This torchrl_quad cannot fly it. It was written"),
    ("output.thrust.range.1", 1e308, r"output.thrust.range\[1\]: 1e\+308 is greater than the maximum of 600000"),
    ("drone.max_thrust_to_weight", 21, "drone.max_thrust_to_weight: 21 is greater than the maximum of 20"),
    ("action_delay", 101, "action_delay: 101 is greater than the maximum of 100"),
    ("output.order", ["thrust"] * 3, "output.order: .* is too short"),
    ("output.hover_action", [0] * 5, "output.hover_action does not have as many entries as an action of the policy"),
    ("output.control", "velocity", "output.gains: 'tilt_gain' is a required property"),
    ("simulator.integrator", "rk9", "simulator.integrator: 'rk9' is not one of"),
    ("drone.thrust_map", [1e-9, 0, 0], "drone: to hover each rotor must give"),
    ("drone.rotor_positions", [[0.1, 0.1]] * 4, "drone.rotor_positions and rotor_spin cannot control roll and pitch"),
    ("plant", {"mass": 0}, "plant.mass: 0 is less than the minimum of 0.001"),
    ("plant", {"inertia": [1e-3, 1e-3, 3e-3]}, "plant.inertia .* kg m2: in a body none of the three exceeds"),
    ("plant", {"wings": 2}, "plant: .*'wings' was unexpected"),
    ("plant", {"rotor_speed_min": 9000}, "plant.rotor_speed_min must be below rotor_speed_max"),
]


@pytest.mark.parametrize(("path", "value", "message"), CHANGES)
def test_a_contract_that_this_package_does_not_fly_is_refused(copied, path, value, message):
    folder, about = copied
    *way, last = [int(x) if x.isdigit() else x for x in path.split(".")]
    part = about
    for key in way:
        part = part[key]
    part[last] = value
    fit(folder, about)
    refuses(f"^{folder}.*{message}", load_bundle, folder, error=UnknownContract)


def test_the_ranges_of_the_schema_lie_within_those_of_the_simulated_drones():
    fields = contract.schema()["properties"]["drone"]["properties"]
    for name in LIMITS.keys() - {"rotor_spin"}:
        entry = fields[name]
        while "items" in entry and "minimum" not in entry:
            entry = entry["items"]
        least, most = LIMITS[name]
        assert least <= entry.get("minimum", entry.get("exclusiveMinimum")) < entry["maximum"] <= most, name


def test_another_runtime_is_found_and_a_graph_that_it_cannot_read_or_that_leaves_limits_or_shape_is_refused(copied):
    bundle = load_bundle(copied[0])
    bundle._vectors["action"] += np.float32(1e-3)
    refuses("policy/policy.onnx: the policy differs by 0.001", bundle.check, error=WrongActions)
    folder, about = copied

    def load(*nodes, scale=1.0):
        shapes = (("observation", ["batch", 13]), ("action", ["batch", 4]))
        reads, writes = ([helper.make_tensor_value_info(name, TensorProto.FLOAT, x)] for name, x in shapes)
        weight = onnx.numpy_helper.from_array(np.full((4, 13), scale, np.float32), "w")
        graph = helper.make_graph(nodes, "policy", reads, writes, [weight])
        model = helper.make_model(graph, ir_version=10, opset_imports=[helper.make_opsetid("", 20)])
        (folder / "policy.onnx").write_bytes(model.SerializeToString())
        fit(folder, about)
        return load_bundle(folder)

    def gemm(output):
        return helper.make_node("Gemm", ["observation", "w"], [output], transB=1)

    with pytest.raises(TamperedBundle, match=r"policy.onnx: onnxruntime cannot read it: .* Export the policy again"):
        load(helper.make_node("Nonsense", ["observation"], ["action"]))
    with pytest.raises(BrokenPolicy, match="policy: The action leaves -1 to 1, which no exported policy does"):
        load(gemm("action"), scale=9.0)(resting())
    twice = helper.make_node("Concat", ["sum", "sum"], ["action"], axis=0)  # onnxruntime believes what is declared
    with pytest.raises(BrokenPolicy, match=r"policy: policy.onnx answered arrays of the shapes \(2, 4\)"):
        load(gemm("sum"), twice)(resting())


def test_c_leaves_the_memory_as_it_was_where_it_reads_what_is_not_finite(export_once, tmp_path):
    library = compiled(export_once("forest")[2], tmp_path / "policy.so")
    floats, inf = (lambda *x: (ctypes.c_float * len(x))(*x)), float("inf")
    for observation, depth, kept in ((inf, 1.0, 0.5), (0.0, inf, 0.5), (0.0, float("nan"), 0.5), (0.0, 1.0, inf)):
        memory, action = floats(0.1, 0.2, 0.3, kept), floats(0, 0, 0, 0)
        images = floats(*29 * [1.0], depth)
        assert library.policy_action(floats(*8 * [0.0], observation), images, memory, action) == 1
        assert list(memory) == pytest.approx([0.1, 0.2, 0.3, kept]) and action[0] == pytest.approx(-1 / 3)
    memory = floats(0.1, 0.2, 0.3, 0.5)
    assert library.policy_action(floats(*9 * [0.0]), floats(*30 * [1.0]), memory, action) == 0 and memory[3] != 0.5


def test_a_bundle_that_acts_or_remembers_differently_from_its_policy_is_not_written(tmp_path, monkeypatch, trace_once):
    trace_once("forest")
    env, actor = build("forest")

    def forgets(self, *given, read=Bundle._read):
        return read(self, *given) | {"memory": np.zeros_like(self.memory)}

    def off(*arguments, fold=export.fold):
        network = fold(*arguments)
        *layers, last = network.layers
        return network._replace(layers=[*layers, last._replace(bias=last.bias + np.float32(1e-3))])

    wrongs = [(Bundle, "_read", forgets, ValueError, "acts differently")]
    wrongs.append((export, "fold", off, WrongActions, "by 0.001"))
    for owner, name, wrong, error, said in wrongs:
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, wrong)
            refuses(said, export_policy, actor, env, tmp_path / "policy", error=error)
        assert not list(tmp_path.iterdir())
    assert export_policy(actor, env, tmp_path / "policy").is_dir()


def test_a_policy_whose_memory_amplifies_rounding_errors_is_exported(tmp_path, trace_once):
    trace_once("hovering")
    env, _ = build("hovering, with memory")
    actor = make_actor(env, (16, 16), recurrent=True, hidden_size=32)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        actor.last.mlp[-1].weight.add_(0.3 * torch.randn_like(actor.last.mlp[-1].weight))
        next(x for name, x in actor.named_parameters() if "weight_hh" in name).mul_(20.0)
        flight, _ = differentiable_rollout(env, actor, None, 48)
        flown, seen = (flight.select(*actor.in_keys).clone() for _ in range(2))
        seen["observation"][:, 0] += 1e-6
        with set_recurrent_mode(True):
            gap = (actor(seen)["action"] - actor(flown)["action"])[:2].abs().amax((0, 2))
    assert gap.max() > 1e-3 > 100 * gap[0], gap
    assert export_policy(actor, env, tmp_path / "policy").is_dir()


def test_a_blind_policy_among_trees_is_judged_as_in_the_environment(export_once):
    bundle = load_bundle(export_once("forest, blind")[2])
    metrics = transfer.fly(bundle, "torchrl_quad")["metrics"]
    for name in ("crash", "distance", "clearance"):
        assert metrics[name].mean() == pytest.approx(bundle.contract["results"][name], rel=0.01, abs=1e-3)


def test_a_visual_policy_that_was_built_for_another_camera_or_changed_is_refused(tmp_path):
    forest = ForestEnv(num_envs=2, camera={"width": 6, "height": 5})
    seen, hooked, deeper, flatter = (make_visual_actor(forest) for _ in range(4))
    narrow = HoveringEnv(num_envs=2, camera={"width": 9, "height": 5})
    for other, has in ((HoveringEnv(num_envs=2), "has no camera"), (narrow, "shows it 9 x 5 pixels")):
        refuses(f"images of another size; the environment {has}", export_policy, seen, other, tmp_path / "policy")
    hooked[0][1].gru.register_forward_hook(lambda *_: None)
    deeper[0][1].gru = nn.GRU(64, 64, 2, batch_first=True)
    velocity = make_visual_actor(forest, in_keys=[("state", "velocity")])
    flatter[0][0].module.convolutions[1] = nn.ELU(0.5)
    built = "exports what make_actor and make_visual_actor build, .* This ComposedActor is something"
    reads = r"reads \['depth', \('state', 'velocity'\)\]. A drone only has"
    wrong = ((hooked, built), (deeper, built), (velocity, reads), (flatter, "cannot write ELU.alpha=0.5"))
    for policy, message in wrong:
        refuses(message, export_policy, policy, forest, tmp_path / "policy")
