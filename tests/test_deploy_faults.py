"""A bundle in flight and its limits: faults have names and are counted, and what cannot be exported is refused."""

import contextlib
import copy
import json
import math
import re
import sys

import numpy as np
import pytest
import torch
from deploying import FLOWN, build, measured, resting
from helpers import cases, refuses, run
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import PendulumEnv, RewardSum, TransformedEnv

import torchrl_quad
from torchrl_quad import HoveringEnv, ObservationNormalizer, load_drone, make_actor, make_env
from torchrl_quad.deploy import BrokenPolicy, StaleState, contract, export_policy, load_bundle
from torchrl_quad.deploy.contract import MissingQuantity, NegativeDepth, NotFinite, NotUnitQuaternion
from torchrl_quad.envs import TASKS
from torchrl_quad.errors import DroneWarning, UserValueError
from torchrl_quad.training.drawing import environment_beside


def far(value):
    return [[0.0, value, 12.0, 1.0, 3.0, 10.0], *4 * [6 * [3.0]]]


FAULTS = [
    (MissingQuantity, "The state lacks 'velocity': give position, quaternion", {"velocity": None}),
    (MissingQuantity, "The state lacks 'age'", {"age": None}),
    (MissingQuantity, r"position must have shape \(3,\), got \(2,\)", {"position": [1, 2]}),
    (MissingQuantity, "quaternion must be 4 numbers, got 'level'", {"quaternion": "level"}),
    (MissingQuantity, "age must be a number", {"age": True}),
    (NotFinite, "beyond 1e.06: position, velocity", {"position": [0, 0, 1e9], "velocity": [0, math.nan, 0]}),
    (NotFinite, "age", {"age": math.inf}),
    (NotUnitQuaternion, "The quaternion has norm 1.01; it must be 1 to 0.001", {"quaternion": [1.01, 0, 0, 0]}),
    (NotUnitQuaternion, "norm 0;", {"quaternion": [0, 0, 0, 0]}),
    (StaleState, "The state is 0.03 s old; the contract allows 0 to 0.02 s", {"age": 0.03}),
    (StaleState, "-1 s old", {"age": -1}),
    (MissingQuantity, "The state must be a mapping of position, quaternion, .* and age, got None", None),
    (MissingQuantity, r"and age, got \[\]", []),
]
FAULTS_OF_IMAGES = [
    (MissingQuantity, "lacks 'depth': give position, .*, depth, depth_age and age", {"depth": None}),
    (MissingQuantity, "lacks 'depth_age', the time since that was measured", {"depth_age": None}),
    (MissingQuantity, r"depth must have shape \(5, 6\) or \(1, 5, 6\), got \(3, 2\)", {"depth": [[1, 1]] * 3}),
    (MissingQuantity, "depth must be 30 numbers, got 'far'", {"depth": "far"}),
    (MissingQuantity, "whole numbers, uint16: give metres. Are they milli", {"depth": np.ones((5, 6), np.uint16)}),
    (NotFinite, "Not finite: depth. Give 0 for a pixel that measures nothing", {"depth": far(math.nan)}),
    (NotFinite, "Not finite: depth. .* and the range for far", {"depth": far(math.inf)}),
    (NotFinite, "Not finite: depth_age", {"depth_age": math.nan}),
    (NegativeDepth, "depth must not be negative, got -0.1 m", {"depth": far(-0.1)}),
    (StaleState, "The image is 0.07 s old; the contract allows 0 to 0.06 s", {"depth_age": 0.07}),
    (StaleState, "The image is -1 s old", {"depth_age": -1}),
    (StaleState, "The state is 1 s old", {"age": 1}),
]


@cases(*(("tracking", *x) for x in FAULTS), *(("forest", *x) for x in FAULTS_OF_IMAGES))
def test_each_fault_has_a_name_and_changes_nothing_or_hovers_and_is_counted(task, kind, message, changes, export_once):
    folder = export_once(task)[2]
    raising, hovering, untouched = load_bundle(folder), load_bundle(folder, on_fault="hover"), load_bundle(folder)
    good, state = measured(raising), changes
    if isinstance(changes, dict):
        state = {key: x for key, x in (good | changes).items() if x is not None}
    for bundle in (raising, hovering, untouched):
        bundle(good)
    refuses(message, raising, state, error=kind)
    assert raising.faults == {kind.__name__: 1}
    thrust, rates = hovering(state)
    weight = hovering.contract["output"]["thrust"]["weight"]
    assert (thrust, *rates) == pytest.approx((weight, 0, 0, 0))
    assert hovering.faults == {kind.__name__: 1} and isinstance(hovering.last_fault, kind)
    np.testing.assert_allclose(hovering.queue[-1], hovering.contract["output"]["hover_action"])
    np.testing.assert_array_equal(raising.queue, untouched.queue)
    assert task != "forest" or untouched.memory.any()
    for bundle in (raising, hovering):
        np.testing.assert_array_equal(bundle.memory, untouched.memory)
    assert raising(good)[0] == untouched(good)[0]
    assert not untouched.faults and untouched.last_fault is None
    hovering.reset()
    assert hovering.faults  # readable after the flight
    assert not hovering.memory.any()


def test_what_is_beyond_the_range_of_the_camera_counts_as_its_range(export_once):
    bundle = load_bundle(export_once("forest")[2])
    thrusts = []
    for depth in (far(12.0), np.minimum(far(12.0), 10.0)[None]):
        bundle.reset()
        thrusts.append(bundle(measured(bundle, depth=depth))[0])
    assert thrusts[0] == thrusts[1]


def test_a_bundle_keeps_the_queue_and_starts_again(export_once):
    bundle = load_bundle(export_once("tracking")[2])
    hover = np.float32(bundle.contract["output"]["hover_action"])
    queues, actions = [[*hover, *hover]], []
    for _ in range(2):
        bundle(resting())
        np.testing.assert_array_equal(bundle.observation[-8:], queues[-1])
        actions.append(bundle.action)
        queues.append([*hover, *bundle.action])
    bundle.reset(phase=1.0)
    np.testing.assert_array_equal(bundle.queue, [hover, hover])
    assert bundle.progress["phase"] == 1.0
    bundle(resting())
    assert not np.array_equal(bundle.action, actions[0])
    refuses("reset: tracking has no 'gate'. Choose from: phase", bundle.reset, error=TypeError, gate=1)
    bundle.reset()
    np.testing.assert_array_equal(bundle.progress["phase"], bundle.starts()["phase"][0])
    refuses('on_fault must be "raise" or "hover", got \'land\'', load_bundle, bundle.folder, on_fault="land")


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch, trace_once):
    env, actor = build("hovering")

    class Counting(HoveringEnv):
        calls = 0

        def observe(self, state):
            self.calls += 1
            return super().observe(state) + 1e-3 * self.calls

    def fails(match, policy=actor, env=env, error=ValueError, **options):
        refuses(match, export_policy, policy, env, tmp_path / "policy", error=error, **options)

    module = TensorDictModule(nn.Linear(13, 4), in_keys=["observation"], out_keys=["action"])
    fails("exports what make_actor and make_visual_actor build, .* This TensorDictModule is something else", module)
    knows = make_actor(env, in_keys=["observation", ("state", "rotor_speed")])
    fails(r"reads \['observation', \('state', 'rotor_speed'\)\]. A drone only has", knows)
    leaky = make_actor(env)
    leaky[0].module.mlp[1] = nn.LeakyReLU(0.2)
    fails(r"cannot write LeakyReLU\(negative_slope=0.2\)", leaky)
    hooked = make_actor(env)
    hooked[0].module.mlp.register_forward_hook(lambda *_: None)
    fails("exports what make_actor and make_visual_actor build", hooked)
    fails("the bundle observes something else than Counting does, by", env=Counting(num_envs=64, max_episode_steps=8))
    fails("the policy reads 13 numbers, the environment observes 40", env=make_env("tracking", num_envs=2))
    fails("supports only one transform, an ObservationNormalizer", env=TransformedEnv(env, RewardSum()))
    broken = make_actor(env)
    with torch.no_grad():
        broken[0].module.mlp[0].bias[0] = math.nan
    fails("the weights of the policy, or its normaliser, are not finite", broken)
    trace_once("hovering")
    strong = load_drone("visfly").replace(max_thrust_to_weight=30.0)
    with pytest.warns(DroneWarning, match="the rotors reach 4.446 times the weight"):
        strongest = HoveringEnv(num_envs=64, max_episode_steps=4, drone=strong)
    said = r"export_policy: output.thrust.range_in_weights.1.: 30.0 is greater than the maximum of 20. A bundle flies"
    fails(said, env=strongest)
    other = HoveringEnv(num_envs=64, max_episode_steps=8)
    other.dynamics.controller.action_units = {"thrust": "N", "throttle": "1"}
    fails("exports the controls rates, attitude, velocity, rotor_thrusts; got 'rates'", env=other)
    of_an_error = ObservationNormalizer(env, ("metrics", "position_error"))
    fails('the normalizer must be that of "observation", got ', normalizer=of_an_error)
    fails("needs an environment of this package, got PendulumEnv", env=PendulumEnv())
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "onnx", None)
        fails("needs onnx onnxruntime onnxscript: pip install onnx onnxruntime onnxscript", error=ImportError)
    assert not (tmp_path / "policy").exists()
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "thesis.txt").write_text("")
    fails("exists and is no bundle", error=FileExistsError)


def test_a_normalizer_is_that_of_the_transforms_or_is_given_beside_a_bare_environment(tmp_path, trace_once):
    trace_once("hovering")
    env = HoveringEnv(num_envs=64, max_episode_steps=16)
    actor, normalizer = make_actor(env, (8,)), ObservationNormalizer(env)
    normalizer.update(env.rollout(16, break_when_any_done=False))
    ways = {"none": {}, "given": {"normalizer": normalizer}, "wrapped": {"env": TransformedEnv(env, normalizer)}}
    bundles = [load_bundle(export_policy(actor, **{"env": env, "folder": tmp_path / x, **ways[x]})) for x in ways]
    marks = [bundle.contract["origin"]["weights_sha256"] for bundle in bundles]
    assert marks[0] != marks[1] == marks[2]


class Failing:
    """A session that fails or answers something else, once."""

    def __init__(self, session, answer):
        self.session, self.answer = session, answer

    def run(self, names, given):
        found = self.session.run(names, given)
        answer, self.answer = self.answer, None
        return found if answer is None else answer(found)


def crash(found):
    raise RuntimeError("[ONNXRuntimeError] : 6 :\n out of everything")


FAILURES = {  # of the state, or of a graph
    "stale": (StaleState, {"age": 1.0}, None),
    "missing": (MissingQuantity, {"velocity": None}, None),
    "text": (MissingQuantity, {"position": ["1", "2", "3"]}, None),
    "onnxruntime": (BrokenPolicy, {}, crash),
    "observe": (NotFinite, {}, lambda found: [np.full_like(x, np.nan) for x in found]),
    "advance": (BrokenPolicy, {}, lambda found: [x[:, :0] for x in found]),
    "interrupt": (KeyboardInterrupt, {}, lambda _: exec("raise KeyboardInterrupt")),
    "action": (NotFinite, {}, lambda found: [np.full_like(x, np.nan) for x in found]),
    "last output": (NotFinite, {}, lambda found: [*found[:-1], np.full_like(found[-1], np.inf)]),
    "beyond": (BrokenPolicy, {}, lambda found: [np.full_like(found[0], 2.0), *found[1:]]),
    "shape": (BrokenPolicy, {}, lambda found: [found[0][:, :3], *found[1:]]),
}


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("task", FLOWN)
def test_a_step_that_failed_and_is_repeated_equals_one_that_never_failed(export_once, task, failure):
    kind, changes, answer = FAILURES[failure]
    failing, untouched = (load_bundle(export_once(task)[2]) for _ in range(2))
    name = failure if failure in failing.graphs else "policy"
    if failure == "advance" != name:
        pytest.skip("no entry of this task changes")
    graph = failing.graphs[name]
    session = graph.session
    gate = export_once(task)[0].base_env.gates[0].numpy() if task == "racing" else np.array([1, 0, 1.4])

    def content(bundle):
        return copy.deepcopy({k: x for k, x in vars(bundle).items() if k not in ("graphs", "faults", "last_fault")})

    for bundle in (failing, untouched):
        bundle.reset(**({"gate": 0} if task == "racing" else {}))
    for step in range(6):
        position = gate + (step - 2.5, 0, 0)  # through the gate between two of the steps
        state = measured(failing, position=position, angular_velocity=[0, 0.1 * step, 0])
        before = content(failing)
        graph.session = Failing(session, answer)
        fails = step > 0 or failure != "advance"  # it is not called in the first step
        with pytest.raises(kind) if fails else contextlib.nullcontext():
            failing({key: x for key, x in (state | changes).items() if x is not None})
        graph.session = session
        if fails:
            np.testing.assert_equal(content(failing), before)
        np.testing.assert_equal(failing(state) if fails else failing.command(failing.action), untouched(state))
    np.testing.assert_equal(content(failing), content(untouched))
    assert task != "racing" or failing.progress["gate"] == 1
    if kind is not KeyboardInterrupt:
        count = 5 if failure == "advance" else 6
        assert failing.faults == {kind.__name__: count} and str(failing.last_fault).startswith(f"{failing.folder}: ")


@cases(
    ("hovering", {"target": "here"}, r"numbers of shape \(3,\), from -1e\+06 to 1e\+06; got 'here'"),
    ("hovering", {"target": [1, 2]}, r"numbers of shape \(3,\)"),
    ("hovering", {"target": [True, False, True]}, "numbers"),
    ("tracking", {"phase": "late"}, r"numbers of shape \(1,\), from 0 to 6.28319; got 'late'"),
    ("racing", {"gate": [0, 1]}, r"whole numbers of shape \(1,\), from 0 to 3; got \[0, 1\]"),
    ("racing", {"gate": np.arange(2)}, "whole numbers"),
    *(("racing", {"gate": gate}, "whole numbers") for gate in (4, -1, True, 0.5)),
    ("forest", {"target": [1, 2, 3], "speed": np.nan}, r"numbers of shape \(1,\), from 0.1 to 30; got nan"),
    *(("forest", {"speed": speed}, "numbers") for speed in (0, -1, math.inf, "fast", True)),
)
def test_a_start_that_makes_no_sense_is_refused_and_changes_nothing(task, progress, wanted, export_once):
    bundle = load_bundle(export_once(task)[2])
    before = bundle.progress
    refuses(f"^{bundle.folder}: {list(progress)[-1]} must be {wanted}", bundle.reset, error=UserValueError, **progress)
    np.testing.assert_equal(bundle.progress, before)


BLOCKED = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"torch", "torchrl", "tensordict", "gymnasium", "yaml", "onnx"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
"""


def test_flying_needs_numpy_onnxruntime_and_jsonschema_alone(export_once, monkeypatch):
    folder = export_once("hovering")[2]
    fly = f"""
import numpy
from torchrl_quad.deploy import frames, load_bundle
bundle = load_bundle({str(folder)!r})
print(bundle.check(), bundle({resting()}), frames.px4().to({{"position": [1, 2, 3]}}))
assert "torch" not in sys.modules
"""
    assert "array" in run(sys.executable, "-c", BLOCKED + fly)
    for name, why in {"onnxruntime": "flies", "jsonschema": "is checked"}.items():
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            said = f"^A bundle {why} with {name}: pip install {name} .import of {name} halted"
            refuses(said, load_bundle, folder, error=ImportError)


def test_the_package_imports_its_parts_when_they_are_asked_for():
    assert sorted(TASKS) == sorted(torchrl_quad._TASKS)
    assert {*torchrl_quad.__all__, *torchrl_quad._PARTS} <= set(dir(torchrl_quad))
    for name in torchrl_quad.__all__:
        assert getattr(torchrl_quad, name).__module__.startswith("torchrl_quad"), name
    assert not hasattr(torchrl_quad, "Nothing") and not hasattr(torchrl_quad.deploy, "Nothing")
    run(sys.executable, "-c", "import sys, torchrl_quad; assert 'torch' not in sys.modules")


def test_the_recipe_exports_the_best_policy_with_results_and_a_page(
    train, launch, refused, tmp_path, export_once, trace_once
):
    trace_once("forest")
    settings = ["env.camera={width: 6, height: 5}", "env.density=0.05", "env.max_episode_steps=48"]
    train("bptt", tmp_path, "normalize=true", "task=forest", *settings)
    printed = launch("export", f"checkpoint={tmp_path}/checkpoint.pt")
    assert re.search(r"policy: flies forest; its actions differ by at most \d\.\de-0[6-9]", printed)
    about = load_bundle(tmp_path / "policy").contract
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert about["results"] == {key: summary[key] for key in about["results"]}
    assert about["origin"]["checkpoint_sha256"] == contract.sha256((tmp_path / "checkpoint.pt").read_bytes())
    assert about["memory"] > 0 and about["camera"]["range"] == 10.0
    assert environment_beside(load_bundle(tmp_path / "policy")).camera.width == 6
    assert environment_beside(load_bundle(export_once("hovering")[2])) is None
    assert re.search(r"forest +MuJoCo", launch("transfer", f"bundle={tmp_path}/policy", "episodes=2", "loop=pid"))
    assert "folder is unknown" not in refused("export", f"checkpoint={tmp_path}/none.pt")
    assert "episodes=0" in refused("export", f"checkpoint={tmp_path}/checkpoint.pt", "episodes=0")
    assert contract.schema_table() in (export_once("forest")[2] / "README.md").read_text()
