"""A bundle in flight and its limits: faults have names and are counted, and what cannot be exported is refused."""

import copy
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from deploying import FLOWN, build, resting, seen_by
from own_task import CornerEnv
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import PendulumEnv, RewardSum, TransformedEnv

import torchrl_quad
from torchrl_quad import HoveringEnv, ObservationNormalizer, RacingEnv, TrackingEnv, load_drone, make_actor, make_env
from torchrl_quad.deploy import (
    BrokenPolicy,
    MissingQuantity,
    NotFinite,
    NotUnitQuaternion,
    StaleState,
    contract,
    export_policy,
    load_bundle,
)
from torchrl_quad.deploy.describe import _harmonics
from torchrl_quad.deploy.tasks import Course, Curve, Gates
from torchrl_quad.envs import TASKS
from torchrl_quad.errors import UserValueError

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=64, max_episode_steps=16, action_delay=2, observe_last_action=True)
    return export_policy(make_actor(env, (8,)), env, tmp_path_factory.mktemp("bundle") / "policy")


FAULTS = [
    (MissingQuantity, "The state lacks 'velocity': give position, quaternion", {"velocity": None}),
    (MissingQuantity, "The state lacks 'age'", {"age": None}),
    (MissingQuantity, r"position must have shape \(3,\), got \(2,\)", {"position": [1, 2]}),
    (MissingQuantity, "quaternion must be 4 numbers, got 'level'", {"quaternion": "level"}),
    (MissingQuantity, "age must be a number", {"age": "new"}),
    (
        NotFinite,
        "Not finite, or beyond 1e.06: position, velocity",
        {"position": [0, 0, 1e9], "velocity": [0, math.nan, 0]},
    ),
    (NotFinite, "age", {"age": math.inf}),
    (NotFinite, "beyond 1e.06: position", {"position": [10**400, 0, 0]}),
    (NotFinite, "beyond 1e.06: age", {"age": 10**400}),
    (NotUnitQuaternion, "The quaternion has norm 1.01; it must be 1 to 0.001", {"quaternion": [1.01, 0, 0, 0]}),
    (NotUnitQuaternion, "norm 0;", {"quaternion": [0, 0, 0, 0]}),
    (StaleState, "The state is 0.03 s old; the contract allows 0 to 0.02 s", {"age": 0.03}),
    (StaleState, "-1 s old", {"age": -1}),
    (MissingQuantity, "The state must be a mapping of position, quaternion, .* and age, got None", None),
    (MissingQuantity, r"and age, got \[\]", []),
]


@pytest.mark.parametrize(("kind", "message", "changes"), FAULTS)
def test_each_fault_has_a_name_and_changes_nothing_or_hovers_and_is_counted(folder, kind, message, changes):
    state = changes
    if isinstance(changes, dict):
        state = {key: x for key, x in resting(**changes).items() if x is not None}
    raising, hovering, untouched = load_bundle(folder), load_bundle(folder, on_fault="hover"), load_bundle(folder)
    for bundle in (raising, hovering, untouched):
        bundle(resting())
    with pytest.raises(kind, match=message):
        raising(state)
    assert raising.faults == {kind.__name__: 1}
    thrust, rates = hovering(state)
    assert (thrust, *rates) == pytest.approx((0.46 * 9.81, 0, 0, 0))
    assert hovering.faults == {kind.__name__: 1} and isinstance(hovering.last_fault, kind)
    np.testing.assert_allclose(hovering.queue[-1], hovering.contract["output"]["hover_action"])
    np.testing.assert_array_equal(raising.queue, untouched.queue)
    assert raising(resting())[0] == untouched(resting())[0]
    assert not untouched.faults and untouched.last_fault is None
    hovering.reset()
    assert hovering.faults  # readable after the flight


def test_a_bundle_keeps_the_queue_and_starts_anew(folder):
    bundle = load_bundle(folder)
    hover = np.float32(bundle.contract["output"]["hover_action"])
    bundle(resting())
    np.testing.assert_array_equal(bundle.observation[13:], [*hover, *hover])
    first = bundle.action
    bundle(resting())
    np.testing.assert_array_equal(bundle.observation[13:], [*hover, *first])
    second = bundle.action
    bundle.reset(target=[1, 0, 1.9])
    np.testing.assert_array_equal(bundle.queue, [hover, hover])
    bundle(resting())
    np.testing.assert_allclose(bundle.observation[:3], [0, 0, 0.5], atol=1e-6)
    assert not np.array_equal(bundle.action, second)
    with pytest.raises(TypeError, match="reset: hovering has no 'gate'. Choose from: target"):
        bundle.reset(gate=1)
    with pytest.raises(ValueError, match="target must be three finite numbers"):
        bundle.reset(target=[1, 2])
    with pytest.raises(ValueError, match='on_fault must be "raise" or "hover", got \'land\''):
        load_bundle(folder, on_fault="land")


def test_gates_are_passed_in_their_order_on_the_line_between_two_positions():
    gates = Gates({"gates": [[0, 0, 1], [5, 0, 1]], "gate_radius": 0.3})
    gates.advance(np.array([-1.0, 0.29, 1]), np.array([1.0, 0.29, 1]))  # neither end is near
    assert (gates.gate, gates.passed) == (1, 1)
    gates.advance(None, np.array([5.0, 0, 1]))  # where it was is unknown
    gates.advance(np.array([4.0, 0.31, 1]), np.array([6.0, 0.31, 1]))
    assert gates.gate == 1
    found = gates.inputs(np.array([4.0, 0, 1]))
    np.testing.assert_array_equal(np.stack([found["to_gate"], found["to_gate_after"]]), [[1, 0, 0], [-4, 0, 0]])
    gates.advance(np.array([4.0, 0, 1]), np.array([4.8, 0, 1]))
    assert (gates.gate, gates.passed) == (0, 2)
    for gate in (2, -1, True, 0.5):
        with pytest.raises(ValueError, match="gate must be a whole number from 0 to 1"):
            gates.reset(gate)


def test_a_course_commands_its_speed_towards_the_target_and_less_within_a_metre_of_it():
    course = Course({"target": [32, 0, 1.5], "speed": 5.0})
    np.testing.assert_allclose(course.inputs(np.array([29.0, 4.0, 1.5]))["command"], [3, -4, 0])
    np.testing.assert_allclose(course.inputs(np.array([31.5, 0.0, 1.5]))["command"], [2.5, 0, 0])
    course.reset(target=[0, 0, 0], speed=2)
    np.testing.assert_allclose(course.inputs(np.array([0.0, 0.0, 9.0]))["command"], [0, 0, -2])
    for speed in (0, -1, math.nan, math.inf, "fast"):
        with pytest.raises(ValueError, match="speed must be a positive number"):
            course.reset(speed=speed)


def test_a_race_with_noise_and_delay_is_exported_though_gates_are_counted_from_true_positions(tmp_path):
    gates = [[0, 0, 2], [1, 0, 2]]
    sensors = {"observation_noise": {"position": 0.3}, "observation_delay": 2}
    env = RacingEnv(num_envs=16, max_episode_steps=16, track={"gates": gates, "starts": gates}, **sensors)
    assert (
        load_bundle(export_policy(make_actor(env, (8,)), env, tmp_path / "policy")).contract["observation_delay"] == 2
    )


@pytest.mark.parametrize("curve", ["slow_circle", "fast_circle", "lemniscate"])
def test_a_curve_is_a_few_harmonics(curve):
    env = TrackingEnv(num_envs=1, curve=curve, dtype=torch.float64)
    about = _harmonics(env)
    assert len(about["cosine"]) <= 2
    rule = Curve({"period": env.period, "lookahead": 10, "lookahead_interval": 0.1, "control_dt": 0.02, **about})
    phase = torch.linspace(0, 2 * math.pi, 50, dtype=torch.float64)
    np.testing.assert_allclose(rule.points(phase.numpy()), env.curve(phase), atol=1e-7)


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch):
    env, actor = build("hovering")

    class Backwards(HoveringEnv):
        def observe(self, state):
            return super().observe(state).flip(-1)

    class Own(HoveringEnv):
        pass

    def corner(phase):
        return torch.stack((phase.sin(), (phase - math.pi).abs(), 2 + 0 * phase), -1)

    def refuses(match, policy=actor, env=env, error=ValueError, **options):
        with pytest.raises(error, match=match):
            export_policy(policy, env, tmp_path / "policy", **options)

    module = TensorDictModule(nn.Linear(13, 4), in_keys=["observation"], out_keys=["action"])
    refuses("exports what make_actor and make_visual_actor build, .* This TensorDictModule is something else", module)
    refuses(
        r"reads \['observation', \('state', 'rotor_speed'\)\]. A drone can give it",
        make_actor(env, in_keys=["observation", ("state", "rotor_speed")]),
    )
    leaky = make_actor(env)
    leaky[0].module.mlp[1] = nn.LeakyReLU(0.2)
    refuses(r"cannot write LeakyReLU\(negative_slope=0.2\)", leaky)
    hooked = make_actor(env)
    hooked[0].module.mlp.register_forward_hook(lambda *_: None)
    refuses("exports what make_actor and make_visual_actor build", hooked)
    refuses("observes something else than the contract says, by", env=Backwards(num_envs=16, max_episode_steps=8))
    refuses("the policy reads 13 numbers, the environment observes 40", env=make_env("tracking", num_envs=2))
    refuses("the curve has corners", env=TrackingEnv(num_envs=2, curve=corner, period=4.0))
    refuses("knows one transform, a single ObservationNormalizer", env=TransformedEnv(env, RewardSum()))
    broken = make_actor(env)
    with torch.no_grad():
        broken[0].module.mlp[0].bias[0] = math.nan
    refuses("the weights of the policy, or its normaliser, are not finite", broken)
    strong = load_drone("visfly").replace(max_thrust_to_weight=30.0)
    refuses(
        r"export_policy: output.thrust.range_in_weights\[1\] is 30.0, and must be at most 20. A bundle flies within",
        env=HoveringEnv(num_envs=2, max_episode_steps=4, drone=strong),
    )
    other = HoveringEnv(num_envs=2, control="attitude")
    refuses("exports thrust and body rates alone, control=\"rates\"; got 'attitude'", env=other)
    of_an_error = ObservationNormalizer(env, ("metrics", "position_error"))
    refuses('the normalizer must be that of "observation", got ', normalizer=of_an_error)
    refuses("cannot say what CornerEnv observes. It knows forest, .*, tracking, and tasks that", env=CornerEnv(2))
    refuses("needs an environment of this package, got PendulumEnv", env=PendulumEnv())
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "onnx", None)
        refuses("needs onnx and onnxruntime: pip install onnx onnxruntime", error=ImportError)
    assert not (tmp_path / "policy").exists()
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "thesis.txt").write_text("")
    refuses("exists and is no bundle", error=FileExistsError)
    assert Own(num_envs=1)  # a task that inherits is known by its parent


def test_a_normalizer_is_that_of_the_transforms_or_is_given_beside_a_bare_environment(tmp_path):
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=64, max_episode_steps=16)
    actor, normalizer = make_actor(env, (8,)), ObservationNormalizer(env)
    normalizer.update(env.rollout(16, break_when_any_done=False))
    ways = {"none": {}, "given": {"normalizer": normalizer}, "wrapped": {"env": TransformedEnv(env, normalizer)}}
    bundles = [load_bundle(export_policy(actor, **{"env": env, "folder": tmp_path / x, **ways[x]})) for x in ways]
    marks = [bundle.contract["origin"]["weights_sha256"] for bundle in bundles]
    assert marks[0] != marks[1] == marks[2]


# -- steps that fail ---------------------------------------------------------------------------------------------------


class Failing:
    """A session that fails or answers otherwise, once."""

    def __init__(self, session, answer):
        self.session, self.answer, self.get_inputs = session, answer, session.get_inputs

    def run(self, names, given):
        found = self.session.run(names, given)
        answer, self.answer = self.answer, None
        return found if answer is None else answer(found)


def crash(found):
    raise RuntimeError("[ONNXRuntimeError] : 6 :\n out of everything")


class Hostile:
    def __array__(self, *_, **__):
        raise ZeroDivisionError


FAILURES = {
    "stale": (StaleState, {"age": 1.0}, None),
    "missing": (MissingQuantity, {"velocity": None}, None),
    "NaN": (NotFinite, {"position": [np.nan, 0, 0]}, None),
    "text": (MissingQuantity, {"position": ["1", "2", "3"]}, None),
    "truth": (MissingQuantity, {"age": True}, None),
    "own type": (MissingQuantity, {"position": Hostile()}, None),
    "onnxruntime": (BrokenPolicy, {}, crash),
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
    session, gates = failing._session, failing.contract["task"].get("gates", [[1, 0, 1.4]])
    for step in range(6):
        position = np.array(gates[0]) + (step - 2.5, 0, 0)  # through the gate between two of the steps
        state = seen_by(failing, position=position, angular_velocity=[0, 0.1 * step, 0])
        before = copy.deepcopy(
            {**vars(failing), "_session": 0, "faults": 0, "last_fault": 0, "rule": vars(failing.rule)}
        )
        failing._session = Failing(session, answer)
        with pytest.raises(kind):
            failing({key: x for key, x in (state | changes).items() if x is not None})
        after = {**vars(failing), "_session": 0, "faults": 0, "last_fault": 0, "rule": vars(failing.rule)}
        np.testing.assert_equal(after, before)
        failing._session = session
        (thrust, rates), (expected, turning) = failing(state), untouched(state)
        assert thrust == expected and np.array_equal(rates, turning)
        assert vars(failing.rule).keys() == vars(untouched.rule).keys()
    np.testing.assert_equal(vars(failing.rule), vars(untouched.rule))
    np.testing.assert_equal(failing.memory, untouched.memory)
    if kind is not KeyboardInterrupt:
        assert failing.faults == {kind.__name__: 6} and str(failing.last_fault).startswith(f"{failing.folder}: ")


@pytest.mark.parametrize(
    ("task", "progress"),
    [
        ("hovering", {"target": "here"}),
        ("hovering", {"target": [10**400, 0, 0]}),
        ("hovering", {"target": [True, False, True]}),
        ("tracking", {"phase": "late"}),
        ("tracking", {"phase": 1e308}),
        ("tracking", {"phase": 10**5000}),
        ("racing", {"gate": [0, 1]}),
        ("racing", {"gate": np.arange(2)}),
        ("forest", {"target": [1, 2, 3], "speed": np.nan}),
        ("forest", {"speed": True}),
    ],
)
def test_a_start_that_makes_no_sense_is_refused_and_changes_nothing(export_once, task, progress):
    bundle = load_bundle(export_once(task)[2])
    before = copy.deepcopy(vars(bundle.rule))
    with pytest.raises(UserValueError, match=f"^{bundle.folder}: {list(progress)[-1]} must be"):
        bundle.reset(**progress)
    np.testing.assert_equal(vars(bundle.rule), before)


# -- without torch -----------------------------------------------------------------------------------------------------

BLOCKED = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"torch", "torchrl", "tensordict", "gymnasium", "yaml", "onnx"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
"""


def python(program):
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_flying_needs_numpy_onnxruntime_and_jsonschema_alone(folder):
    fly = f"""
import numpy
from torchrl_quad.deploy import frames, load_bundle
bundle = load_bundle({str(folder)!r})
print(bundle.check(), bundle({resting()}), frames.px4().to({{"position": [1, 2, 3]}}))
assert "torch" not in sys.modules
"""
    assert "array" in python(BLOCKED + fly)
    missing = """
sys.modules[{!r}] = None
from torchrl_quad.deploy import load_bundle
from torchrl_quad.errors import MissingPackage
try:
    load_bundle({!r})
except MissingPackage as error:
    print(error)
"""
    for name, why in {"onnxruntime": "flies", "jsonschema": "is checked"}.items():
        assert (
            python(BLOCKED + missing.format(name, str(folder))) == f"A bundle {why} with {name}: pip install {name}\n"
        )


def test_the_package_imports_its_parts_when_they_are_asked_for():
    assert {name: task(num_envs=1).max_episode_steps for name, task in TASKS.items()} == torchrl_quad._TASKS
    assert {*torchrl_quad.__all__, *torchrl_quad._PARTS} <= set(dir(torchrl_quad))
    for name in torchrl_quad.__all__:
        assert getattr(torchrl_quad, name).__module__.startswith("torchrl_quad"), name
    assert not hasattr(torchrl_quad, "Nothing") and not hasattr(torchrl_quad.deploy, "Nothing")
    python("import sys, torchrl_quad; assert 'torch' not in sys.modules")


# -- recipe and page ---------------------------------------------------------------------------------------------------


def test_the_recipe_exports_the_best_policy_of_a_run_with_its_results(train, launch, refused, tmp_path):
    train("bptt", tmp_path, "normalize=true", "task=forest", "env.camera={width: 6, height: 5}", "env.density=0.02")
    printed = launch("export", f"checkpoint={tmp_path}/checkpoint.pt")
    assert re.search(r"policy: flies forest; its actions differ by at most \d\.\de-0[6-9]", printed)
    about = load_bundle(tmp_path / "policy").contract
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert about["results"] == {key: summary[key] for key in about["results"]}
    assert about["origin"]["checkpoint_sha256"] == contract.sha256((tmp_path / "checkpoint.pt").read_bytes())
    assert about["memory"] > 0 and about["camera"]["range"] == 10.0
    assert "cannot fly this bundle of the task 'forest': its policy reads images, and they have no camera" in refused(
        "transfer", f"bundle={tmp_path}/policy", "simulator=torchrl_quad"
    )
    assert "folder is unknown" not in refused("export", f"checkpoint={tmp_path}/none.pt")
    assert "episodes=0" in refused("export", f"checkpoint={tmp_path}/checkpoint.pt", "episodes=0")


def test_the_page_shows_every_field_of_the_contract():
    assert contract.schema_table() in (ROOT / "docs/deploy_contract.md").read_text(), "put it into this page"
