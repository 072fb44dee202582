"""A folder that is not as it was exported is refused in one line; a network that leaves its limits is a fault."""

import json
import shutil

import numpy as np
import onnx
import pytest
from deploying import resting
from onnx import TensorProto, helper
from refusals import refuses

from torchrl_quad.deploy import BrokenPolicy, TamperedBundle, UnknownContract, WrongActions, contract, load_bundle
from torchrl_quad.dynamics.parameters import LIMITS


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
    ("version", 3, "has version 3, and this torchrl_quad reads version 4. It was written by torchrl_quad"),
    ("smell", {}, r"/contract.json: it: .*'smell' was unexpected.* This torchrl_quad cannot fly it. It was written"),
    ("output.thrust.range.1", 1e308, r"output.thrust.range\[1\]: 1e\+308 is greater than the maximum of 600000"),
    ("drone.max_thrust_to_weight", 21, "drone.max_thrust_to_weight: 21 is greater than the maximum of 20"),
    ("action_delay", 101, "action_delay: 101 is greater than the maximum of 100"),
    ("output.order", ["thrust"] * 4, "output.order: .* was expected"),
    ("simulator.integrator", "rk9", "simulator.integrator: 'rk9' is not one of"),
    ("drone.thrust_map", [1e-9, 0, 0], "drone: to hover each rotor must give"),
    ("drone.rotor_positions", [[0.1, 0.1]] * 4, "drone.rotor_positions and rotor_spin cannot make thrust"),
    ("plant", {"mass": 0}, "plant.mass: 0 is less than the minimum of 0.001"),
    ("plant", {"wings": 2}, "plant: .*'wings' was unexpected"),
    ("plant", {"rotor_speed_min": 9000}, "plant.rotor_speed_min is 9000, and must be below"),
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


def test_another_runtime_that_gives_different_results_is_found(copied):
    bundle = load_bundle(copied[0])
    bundle._vectors["action"] += np.float32(1e-3)
    refuses("policy/policy.onnx: the policy differs by 0.001", bundle.check, error=WrongActions)


def test_a_graph_that_onnxruntime_cannot_read_or_that_leaves_its_limits_or_its_shape_is_refused(copied):
    folder, about = copied

    def load(*nodes, scale=1.0):
        reads, writes = (
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", n])]
            for name, n in (("observation", 13), ("action", 4))
        )
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
