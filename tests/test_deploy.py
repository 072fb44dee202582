"""From policy to drone: what is exported flies as the policy did, says what it needs, and refuses what it cannot."""

import ctypes
import json
import os
import shutil

import jsonschema
import numpy as np
import onnxruntime
import pytest
import torch
from deploying import TASKS, build, by_hand, compiled, resting, run_c
from helpers import refuses
from torch import nn
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type

from torchrl_quad import HoveringEnv, files, load_drone, make_actor, make_visual_actor
from torchrl_quad.deploy import StaleState, contract, export_policy, load_bundle
from torchrl_quad.deploy.network import ACTIVATIONS, Layer, Network, write_c, write_onnx
from torchrl_quad.deploy.tracing import name_of
from torchrl_quad.dynamics.gains import rate_loop


@pytest.fixture(params=TASKS)
def exported(request, export_once):
    return export_once(request.param)


@pytest.fixture
def hovering(export_once):
    return export_once("hovering")[2]


def test_torch_onnx_and_c_agree_and_the_contract_fits_its_schema(exported, tmp_path):
    env, actor, folder = exported
    vectors = dict(np.load(folder / "vectors.npz"))
    expected, after = vectors.pop("action"), vectors.pop("next_memory", None)
    sees = "depth" in vectors
    assert len(expected) == (256 if sees else 1024) and (np.abs(expected - expected.mean(0)).max(0) > 0.1).any()
    seen = {name: torch.from_numpy(x) for name, x in vectors.items()}
    if isinstance(env, TransformedEnv):
        seen["observation"] = env.transform.normalize(seen["observation"])
    with torch.no_grad():
        action, memory = by_hand(actor, **seen)
    np.testing.assert_allclose(action, expected, rtol=0, atol=1e-5)
    if after is not None:
        np.testing.assert_allclose(memory, after, rtol=0, atol=1e-5)
        assert vectors["memory"][0].any() < vectors["memory"][1].any() and np.abs(after - vectors["memory"]).max() > 0.1
    assert not sees or vectors["depth"].std() > 0.1
    bundle = load_bundle(folder)
    assert bundle.check() <= 1e-5
    library = compiled(folder, tmp_path / "policy.so")
    library.policy_self_test.restype = ctypes.c_float
    assert 0.0 < library.policy_self_test() <= 1e-5
    k = expected.shape[1]
    np.testing.assert_allclose(run_c(library, vectors, k), expected, rtol=0, atol=1e-5)
    given, command, signal = ((ctypes.c_float * k)(*x) for x in (expected[0], [], []))
    library.policy_command(given, command)
    np.testing.assert_allclose(command, bundle.commanded(expected[0]), rtol=1e-5, atol=1e-6)
    if bundle.contract["output"]["control"] == "rotor_thrusts":
        library.policy_signal(command, signal)
        np.testing.assert_allclose(signal, bundle.command(expected[0])[1], rtol=1e-5)
    if after is None:
        return
    np.testing.assert_allclose(vectors.pop("memory"), after, rtol=0, atol=1e-5)
    session = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    hand, onnx, c = torch.zeros(1, 4), np.zeros((1, 4), np.float32), np.zeros((1, 4), np.float32)
    for i in range(30):  # each keeps a memory of its own
        given = {name: x[i : i + 1] for name, x in vectors.items()}
        with torch.no_grad():
            action, hand = by_hand(actor, **{name: x[i : i + 1] for name, x in seen.items()} | {"memory": hand})
        by_onnx, onnx = session.run(None, given | {"memory": onnx})
        for found in (by_onnx, run_c(library, given | {"memory": c})):
            np.testing.assert_allclose(found, action, rtol=0, atol=1e-5)
    assert np.abs(onnx - c).max() < 1e-5 and hand.abs().max() > 0.1
    jsonschema.validate(json.loads((folder / "contract.json").read_text()), contract.schema())


def test_a_bundle_flies_the_environment_as_the_actor_does(exported):
    """From named quantities, with quaternions of any sign; it commands what the environment decodes. Faults between
    two steps change neither task nor memory."""
    env, actor, folder = exported
    base, bundle, draw = getattr(env, "base_env", env), load_bundle(folder), np.random.default_rng(0)
    td, keys = env.reset(), {name_of(key): key for key in base.task_entries}
    bundle.reset(**{name: td["state", keys[name]][0].numpy() for name in bundle.progress})
    memory, actions = torch.zeros(16, 1, bundle.contract["memory"]), []
    for t in range(40):
        seen = {key: td["state", key] for key in base.control_step.safe_state}
        for disturbance in base.disturbances.values():
            seen = disturbance.observe(seen)
        state = {k: seen[k][0].numpy() for k in ("position", "quaternion", "velocity", "angular_velocity")}
        state["quaternion"] = state["quaternion"] * draw.choice([-1.0, 1.0]) * (1 + 1e-4)
        state |= {"depth": td["depth"][0].numpy() * 1.0, "depth_age": 0.001} if "depth" in td else {}
        if t % 7 == 3:
            with pytest.raises(StaleState):
                bundle(state | {"age": 1.0})
        pair = bundle(state | {"age": 0.001})
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            td = actor(td.set("recurrent_state", memory).set("is_init", torch.zeros(16, 1, dtype=torch.bool)))
        actions.append(td["action"])
        if memory.numel():
            memory = td["next", "recurrent_state"]
            np.testing.assert_allclose(bundle.memory, memory[0, 0], rtol=0, atol=1e-4)
        np.testing.assert_allclose(bundle.action, td["action"][0], rtol=0, atol=2e-3)
        controller = base.dynamics.controller
        command = controller.decode(torch.from_numpy(bundle.action))
        if base.control == "rotor_thrusts":
            speed, drone = controller.command(controller.setpoint_type(command), None, None), controller.nominal
            low, high = drone.rotor_speed_min, drone.rotor_speed_max
            np.testing.assert_allclose(pair[1], (speed - low) / (high - low), rtol=1e-4)
            pair = pair[0]
        np.testing.assert_allclose(np.hstack(pair), command, rtol=1e-5, atol=1e-6)
        td = env.step_mdp(env.step(td))
    assert (torch.stack(actions).std(0) > 1e-3).any()


def test_a_gate_that_is_passed_during_a_fault_counts_afterwards_and_the_time_of_a_task_goes_on(export_once):
    bundle = load_bundle(export_once("racing")[2], on_fault="hover")
    gates = export_once("racing")[0].base_env.gates.numpy()
    for faults in (1, 3):
        bundle.reset(gate=1)
        bundle(resting(position=gates[1] - (1, 0, 0)))
        for _ in range(faults):
            bundle(resting(position=[np.nan] * 3))
        assert (bundle.progress["gate"], bundle.progress["gates_passed"]) == (1, 0)
        bundle(resting(position=gates[1] + (1, 0, 0)))
        assert (bundle.progress["gate"], bundle.progress["gates_passed"]) == (2, 1)
    env, _, folder = export_once("tracking")
    bundle, step = load_bundle(folder, on_fault="hover"), env.base_env.phase_rate * env.base_env.control_dt
    for begun in (False, True):
        bundle.reset(phase=1.0)
        if begun:
            bundle(resting())
        for _ in range(3):
            bundle(resting(age=9.0))
        bundle(resting())
        assert bundle.progress["phase"] == pytest.approx(1.0 + (4 * step if begun else 0.0), abs=1e-5)


def test_a_drone_that_turns_round_keeps_the_sign_of_its_quaternion(hovering):
    bundle = load_bundle(hovering)
    for angle in np.linspace(0.0, 4 * np.pi, 200):
        half = 0.5 * angle
        q = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        bundle(resting(quaternion=q if q[0] >= 0 else -q))  # as an estimator writes it
        np.testing.assert_allclose(bundle.observation[3:7], 10 * q, atol=1e-5)
    bundle.reset()
    bundle(resting(quaternion=[-1, 0, 0, 0]))
    assert bundle.observation[3] == 10.0


def test_every_activation_is_written_alike_as_onnx_and_c(tmp_path):
    x = np.linspace(-30, 30, 601, dtype=np.float32)
    one, small, zero = np.ones((1, 1), np.float32), np.full((1, 1), 0.02, np.float32), np.zeros(1, np.float32)
    functions = "\n".join(f"float {name}_of(float x) {{ return {c}; }}" for name, (_, c) in ACTIVATIONS.items())
    (tmp_path / "policy.c").write_text("#include <math.h>\n" + functions)
    library = compiled(tmp_path, tmp_path / "policy.so")
    for name in ACTIVATIONS:
        expected = getattr(nn, name)()(torch.from_numpy(x))
        content = write_onnx(Network([Layer(one, zero, name), Layer(small, zero, "Tanh")])).SerializeToString()
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        found = session.run(None, {"observation": x[:, None]})[0][:, 0]
        np.testing.assert_allclose(found, torch.tanh(0.02 * expected), rtol=0, atol=1e-6, err_msg=name)
        function = getattr(library, f"{name}_of")
        function.argtypes, function.restype = [ctypes.c_float], ctypes.c_float
        np.testing.assert_allclose([function(v) for v in x], expected, rtol=2e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("task", ["hovering", "forest"])
def test_the_bound_of_a_mean_is_written_too(task, tmp_path, trace_once):
    trace_once(task)
    env = build(task)[0]
    make = make_visual_actor if task == "forest" else make_actor
    actor = make(env, num_cells=(4,), return_log_prob=True)
    parts = actor[0][-1] if task == "forest" else actor[0]
    with torch.no_grad():
        parts.module.mlp[-1].bias[:2] = torch.tensor([1600.0, -1600.0])
    folder = export_policy(actor, env, tmp_path / "policy")
    vectors = dict(np.load(folder / "vectors.npz"))
    for found in (vectors["action"], run_c(compiled(folder, tmp_path / "policy.so"), vectors)):
        np.testing.assert_allclose(found[:, :2], np.tile([np.tanh(5), -np.tanh(5)], (len(found), 1)), rtol=0, atol=1e-6)


def test_c_answers_what_is_not_finite_with_the_hover_action_and_decodes_commands(hovering, tmp_path):
    one, four = np.ones((8, 13), np.float32), np.ones((4, 8), np.float32)
    layers = [Layer(one, one[:, 0], "ReLU"), Layer(four, four[:, 0], "Tanh")]  # both hide NaN or infinity
    about = json.loads((hovering / "contract.json").read_text())
    for name, content in write_c(Network(layers), about, {"observation": one[:1], "action": four[:1, :4]}).items():
        (tmp_path / name).write_bytes(content)
    library = compiled(tmp_path, tmp_path / "policy.so")
    action = (ctypes.c_float * 4)()
    for value in ("nan", "inf", "-inf"):
        assert library.policy_action((ctypes.c_float * 13)(0.0, 0.0, float(value)), action) == 1
        assert list(action) == pytest.approx([-1 / 3, 0, 0, 0])
    assert library.policy_action((ctypes.c_float * 13)(), action) == 0
    command = (ctypes.c_float * 4)()
    library.policy_command((ctypes.c_float * 4)(-1 / 3, 0.5, -1.0, 0.25), command)
    assert [*command] == pytest.approx([0.46 * 9.81, 1.0, -2.0, 0.5])


@pytest.mark.parametrize("task", ["landing", "forest"])
def test_the_same_policy_gives_the_same_bytes_and_leaves_the_environment_as_it_was(
    export_once, task, tmp_path, monkeypatch, trace_once
):
    env, actor, folder = export_once(task)
    if task == "forest":  # now flown in parts; its rules are traced twice in landing
        trace_once(task)
        monkeypatch.setattr("torchrl_quad.deploy.export.MOST_NUMBERS", 30_000)
    base = getattr(env, "base_env", env)
    if base.disturbances:  # noise drawn ahead, and starts of a visited state, are handed on too
        base.rollout(3)
    before = base.randomness.generator.get_state()
    again = export_policy(actor, env, tmp_path / "again")
    assert torch.equal(before, base.randomness.generator.get_state())
    names = sorted(path.name for path in folder.iterdir())
    about = json.loads((folder / "contract.json").read_text())
    assert names == sorted([*contract.files(about), "contract.json"])
    for name in names:
        assert (folder / name).read_bytes() == (again / name).read_bytes(), name


def test_a_contract_says_what_the_environment_is(hovering):
    about = json.loads((hovering / "contract.json").read_text())
    assert (about["task"]["name"], about["task"]["unjudged"]) == ("hovering", None)
    assert about["task"]["about"] == HoveringEnv.__doc__.splitlines()[0]
    assert about["task"]["entries"] == {"target": {"shape": [3], "dtype": "float32", "low": None, "high": None}}
    assert list(about["graphs"]["observe"]["reads"]) == [*contract.MEASURED, "target"]
    assert about["graphs"]["observe"]["writes"] == {"observation": {"shape": [13], "dtype": "float32"}}
    assert "advance" not in about["graphs"] and not (hovering / "advance.onnx").exists()
    assert (about["observation"]["size"], about["observation"]["seen"]["greatest"][3]) == (13, 10.0)
    assert about["output"]["thrust"]["range"] == pytest.approx([0, 3 * 0.46 * 9.81])
    assert about["output"]["body_rate"]["range"] == [[-2, 2]] * 3
    assert about["output"]["hover_action"] == pytest.approx([-1 / 3, 0, 0, 0])
    assert (about["control_dt"], about["action_delay"], about["drone"]["mass"]) == (0.02, 1, 0.46)
    low, high = about["envelope"]["low"], about["envelope"]["high"]
    assert 0 < low[2] < high[2] < 6 and about["envelope"]["max_speed"] > 0.1
    page = (hovering / "README.md").read_text()
    assert "| 0 | thrust | 0 | 13.5378 | N |" in page and "target - position           3     m, world frame" in page
    assert "| 1 | 0.05303 | 0.05303 | clockwise |\n| 2 | -0.05303 | 0.05303 | counter-clockwise |" in page
    loop, nominal = about["rate_loop"], rate_loop(load_drone("visfly", torch.float64), about["simulator"]["dt"])
    assert loop["gain"] == about["drone"]["rate_gain"]
    for name in ("natural_frequency", "damping_ratio", "bandwidth"):
        np.testing.assert_allclose(loop[name], getattr(nominal, name), rtol=1e-5)


def test_a_failed_export_leaves_the_old_bundle_and_no_leftovers(hovering, tmp_path, monkeypatch, trace_once):
    trace_once("hovering")
    env, actor = build("hovering")
    folder = shutil.copytree(hovering, tmp_path / "policy")
    old = (folder / "contract.json").read_bytes()
    with torch.no_grad():
        actor[0].module.mlp[-1].bias.add_(0.1)
    dead = f"{files._prefix(folder)}{2**22 + 1}"  # of a process that cannot be
    aside = tmp_path / f"{dead}.0.old"
    for stopped_by_a_kill in (False, True):  # between the two renames
        if stopped_by_a_kill:
            folder.rename(aside)
            folder.mkdir()  # by somebody who missed it
            (tmp_path / f"{dead}.1").mkdir()
        with monkeypatch.context() as patch:
            patch.setattr("torchrl_quad.deploy.export._check_the_flight", lambda *_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                export_policy(actor, env, folder)
        assert (folder / "contract.json").read_bytes() == old
        assert [path.name for path in tmp_path.iterdir()] == ["policy"]
    with monkeypatch.context() as patch:  # neither the new bundle nor the old one can take the place

        def replace(source, target, rename=os.replace):
            if target == folder:
                raise OSError("no")
            rename(source, target)

        patch.setattr("os.replace", replace)
        refuses("no", export_policy, actor, env, folder, error=OSError)
    (aside,) = tmp_path.glob("*.old")
    assert (aside / "contract.json").read_bytes() == old
    export_policy(actor, env, folder)
    assert (folder / "contract.json").read_bytes() != old
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=r"policy also holds notes.txt: .* Move it away, or choose another"):
        export_policy(actor, env, folder)
    assert (folder / "notes.txt").read_text() == "mine"
