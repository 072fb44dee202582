"""A bundle that was changed, and its checksums with it, is refused in one line or flies within limits."""

import copy
import io
import json
import os
import pickle
import random
import shutil
import zipfile

import numpy as np
import onnx
import pytest
from deploying import FLOWN, measured, resting
from onnx import TensorProto, helper

from torchrl_quad.deploy import (
    BrokenPolicy,
    TamperedBundle,
    UnknownContract,
    contract,
    load_bundle,
)
from torchrl_quad.dynamics.parameters import LIMITS
from torchrl_quad.errors import UserError


@pytest.fixture
def copied(export_once, tmp_path):
    """A copy of a bundle, with its contract."""

    def copied(task="hovering"):
        folder = shutil.copytree(export_once(task)[2], tmp_path / "policy", dirs_exist_ok=True)
        return folder, json.loads((folder / "contract.json").read_text())

    return copied


def fit(folder, about):
    """Write a contract with checksums that fit, as somebody who changes a bundle does."""
    about["sha256"] = {name: contract.sha256((folder / name).read_bytes()) for name in contract.files(about)}
    rest = json.dumps({k: v for k, v in about.items() if k != "digest"}, sort_keys=True, separators=(",", ":"))
    (folder / "contract.json").write_text(json.dumps({**about, "digest": contract.sha256(rest.encode())}))


def put(about, path, value):
    *way, last = [int(x) if x.isdigit() else x for x in path.split(".")]
    for key in way:
        about = about[key]
    about[last] = value


def require_sane_flight(bundle):
    for k in range(5):
        thrust, rates = bundle(measured(bundle, position=[0.3 * k, 0.0, 10.0**k], velocity=[0.0, 10.0**k, 0.0]))
        assert 0.0 <= thrust <= 20 * bundle.contract["output"]["thrust"]["weight"] <= 600_000
        assert np.abs(rates).max() <= 100


# -- contracts ---------------------------------------------------------------------------------------------------------

NUMBERS = [0, -1, 2, 3.0, 1e308, -1e308, 1e-300, float("nan"), float("inf"), 10**400, 2**63]
OTHERS = [None, True, "", "0.02", "\n\x1b[31m\ud800", [], {}, [[0, 0, 0]] * 2000, {"a": 1}]


def deep(levels):
    return {"a": deep(levels - 1)} if levels else [[]]


def places(value, way=()):
    """The ways to everything in a contract."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [*([way] if way else []), *(x for key, part in inside for x in places(part, (*way, key)))]


def damage(about, draw):
    """Change something in a contract; what."""
    *way, last = draw.choice(places(about))
    part = about
    for key in way:
        part = part[key]
    how = draw.choice(["delete", "number", "other", "deep", "times", "more"])
    if how == "delete":
        del part[last]
    elif how == "times" and type(part[last]) in (int, float):
        part[last] *= draw.choice([-1, 0, 0.5, 1.1, 1e3, 1e10])
    elif how == "more":
        part["new" if isinstance(part, dict) else last] = copy.deepcopy(part)
    else:
        part[last] = draw.choice({"number": NUMBERS, "deep": [deep(20), deep(400)]}.get(how, OTHERS))
    return how, *way, last


def load_or_refusal(folder):
    try:
        return load_bundle(folder)
    except UserError as error:
        return error


@pytest.mark.parametrize("task", FLOWN)
def test_a_damaged_contract_is_refused_in_one_line_or_flies_within_the_documented_limits(copied, task):
    draw, flown, (folder, whole) = random.Random(task), 0, copied(task)
    for _ in range(100):
        about = copy.deepcopy(whole)
        changed = damage(about, draw)
        fit(folder, about)
        found = load_or_refusal(folder)
        if isinstance(found, UserError):
            said = str(found)
            assert said.startswith(str(folder)) and said.isprintable() and len(said) < 1500, changed
        else:
            require_sane_flight(found)
            flown += 1
    assert 0 < flown < 50


CONTRADICTIONS = [
    ("hovering", "output.thrust.range", [0, 1e308], r"output.thrust.range\[1\] is 1e\+308, and must be at most 600000"),
    (
        "hovering",
        "output.thrust.range.1",
        30,
        r"output.thrust.range\[1\] is 30, and must be 13.5378 by its other fields",
    ),
    ("hovering", "output.thrust.range.0", 1, r"output.thrust.range\[0\] is 1, and must be 0"),
    ("hovering", "output.thrust.weight", 9, "output.thrust.weight is 9, and must be 4.5126"),
    ("hovering", "drone.max_thrust_to_weight", 21, "max_thrust_to_weight is 21, and must be at most 20"),
    ("hovering", "output.body_rate.range.1", [-3, 2], r"body_rate.range\[1\]\[0\] is -3, and must be -2"),
    ("hovering", "output.body_rate.range.2", [-2, 99], r"body_rate.range\[2\]\[1\] is 99, and must be 2"),
    ("hovering", "output.hover_action.0", 0.5, "hover_action.* is 1.5, and must be 0.666667"),
    ("hovering", "output.hover_action.3", 0.5, "hover_action .* must not turn"),
    ("hovering", "output.order", ["thrust"] * 4, "output.order .* must be thrust, roll_rate, pitch_rate, yaw_rate"),
    ("tracking", "action_delay", 7, r"reads.action_queue is \(\(2, 4\), 'float32'\), and must be \(\(7, 4\),"),
    ("hovering", "action_delay", 101, "action_delay is 101, and must be at most 100"),
    ("hovering", "limits.max_state_age", 5, "limits.max_state_age is 5, and must be 0.02"),
    ("forest", "limits.max_depth_age", None, "limits.max_depth_age is 0, and must be 0.06"),
    ("forest", "camera.quaternion", [0.5, 0, 0, 0], "the norm of camera.quaternion is 0.5"),
    ("forest", "memory", 4.0, "memory is 4.0, and must be of type integer"),
    ("forest", "memory", 5, r"policy.reads.memory is \(\(4,\), 'float32'\), and must be \(\(5,\), 'float32'\)"),
    ("tracking", "task.dtype", "float64", r"reads.position is .*'float32'\), and must be .*'float64'\)"),
    ("racing", "task.entries.gate.dtype", "bool", r"reads.gate is .*'int64'\), and must be .*'bool'\)"),
    ("racing", "task.entries.gate.high", 0, r"starts.npz: no flight starts with the gate \[[1-3]\]"),
    ("racing", "task.entries.step", {"shape": [1], "dtype": "int64", "low": 0, "high": 1}, "has 'step', which is not"),
    ("racing", "graphs.advance.writes.wind", {"shape": [3], "dtype": "bool"}, "writes.wind .* nothing of that name"),
    ("hovering", "graphs.observe.reads", {}, "graphs.observe.reads is empty"),
    ("hovering", "graphs.observe.reads.target.shape", [2], "observe.reads.target is .*, and must be"),
    ("hovering", "graphs.judge.writes", {}, "graphs.judge.writes lacks 'crash'"),
    ("hovering", "graphs.episode.reads.weather", {"shape": [], "dtype": "bool"}, "reads.weather .* nothing of"),
    ("hovering", "task.metrics", {}, "graphs.episode.writes.crash is .*, and must be nothing of that name"),
    ("hovering", "task.unjudged", "no", "graphs must have judge and episode, or task.unjudged say why not"),
    ("forest", "task.unjudged", None, "graphs must have judge and episode, or task.unjudged say why not"),
    ("hovering", "graphs.fly", {"reads": {}, "writes": {}}, "graphs has 'fly', which is unknown"),
    ("hovering", "observation.size", 12, "observation.seen must hold lists of 12 numbers"),
    ("hovering", "control_dt", 0.0201, "limits.max_state_age|whole multiple of simulator.dt"),
    ("hovering", "simulator.dt", 0.003, "control_dt is 0.02, and must be a whole multiple of simulator.dt"),
    ("hovering", "simulator.integrator", "rk9", "simulator.integrator is 'rk9', and must be one of euler"),
    ("hovering", "observation.seen.p99", [1], r"observation.seen must hold lists of 13 numbers"),
    ("hovering", "observation.seen.least", [9] * 13, r"observation.seen must rise from least to greatest"),
    ("hovering", "drone.thrust_map", [1e-9, 0, 0], "drone: to hover each rotor must give"),
    ("hovering", "drone.rotor_positions", [[0.1, 0.1]] * 4, "drone.rotor_positions and rotor_spin cannot make thrust"),
    ("hovering", "plant", {"mass": 0}, "plant.mass is 0, and must be at least 0.001"),
    ("hovering", "plant", {"wings": 2}, "plant has 'wings', which is unknown"),
    ("hovering", "plant", {"rotor_speed_min": 9000}, "plant.rotor_speed_min is 9000, and must be below"),
]


@pytest.mark.parametrize(("task", "path", "value", "message"), CONTRADICTIONS)
def test_a_contract_that_contradicts_its_schema_itself_or_the_other_files_is_refused(
    copied, task, path, value, message
):
    folder, about = copied(task)
    put(about, path, value)
    fit(folder, about)
    with pytest.raises((UnknownContract, TamperedBundle), match=message) as refused:
        load_bundle(folder)
    assert str(refused.value).startswith(str(folder))


def test_the_ranges_of_the_schema_lie_within_those_of_the_simulated_drones():
    fields = contract.schema()["properties"]["drone"]["properties"]
    for name in LIMITS.keys() - {"rotor_spin"}:
        entry = fields[name]
        while "items" in entry and "minimum" not in entry:
            entry = entry["items"]
        least, most = LIMITS[name]
        assert least <= entry.get("minimum", entry.get("exclusiveMinimum")) < entry["maximum"] <= most, name


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (b'{"version": NaN}', "NaN is no finite number"),
        (b'{"version": 1e400}', "1e400 is no finite number"),
        (b'{"version": ' + b"9" * 5000 + b"}", "more than 20 digits"),
        (b'{"version": 4, "version": 4}', "a key stands twice"),
        (b"[" * 100_000, "it nests too deep"),
        (json.dumps({"version": 4}).encode("utf-16"), "'utf-8' codec can't decode"),
        (b"\xef\xbb\xbf{}", "BOM"),
        (b" " * 2**21, "is larger than 1 MiB, the most that is read"),
        (b"", "Expecting value"),
    ],
)
def test_a_contract_that_is_no_plain_json_is_refused(copied, text, why):
    folder, _ = copied()
    (folder / "contract.json").write_bytes(text)
    with pytest.raises(TamperedBundle, match=f"policy/contract.json .*{why}"):
        load_bundle(folder)


@pytest.mark.parametrize("name", [*contract.OTHERS, "policy.onnx", "judge.onnx"])
def test_no_file_is_read_that_is_huge_or_never_ends(copied, name):
    folder, _ = copied()
    os.truncate(folder / name, 2**40)  # of holes
    with pytest.raises(TamperedBundle, match=f"{name} is larger than 256 MiB"):
        load_bundle(folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(TamperedBundle, match=f"{name} is no plain file"):
        load_bundle(folder)


# -- arrays ------------------------------------------------------------------------------------------------------------


def npz(arrays, name, raw=None, how=zipfile.ZIP_STORED):
    """A file of arrays in which one is replaced by bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", how) as archive:
        for key, x in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(x))
            archive.writestr(f"{key}.npy", raw if raw and key == name else content.getvalue())
    return buffer.getvalue()


def huge(x):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**15, 3)})
    return header.getvalue()


@pytest.mark.parametrize("file", ["vectors.npz", "starts.npz"])
def test_arrays_that_do_not_fit_the_contract_are_refused(copied, file):
    folder, about = copied()
    with np.load(folder / file) as content:
        arrays = dict(content)
    name = next(iter(arrays))
    x, count = arrays[name], len(arrays[name])
    objects = io.BytesIO()
    np.save(objects, np.array([pickle.Pickler, None], object), allow_pickle=True)
    wrongs = {
        "is damaged: File is not a zip file": b"no zip",
        "is damaged: Object arrays cannot be loaded": npz(arrays, name, objects.getvalue()),
        "is damaged: ": npz(arrays, name, huge(x)),
        "it must hold only .*, not compressed": npz(arrays, name, how=zipfile.ZIP_DEFLATED),
        "must hold only .*": npz({**arrays, "more": x}, name),
        f"{name} must hold finite numbers in float32": npz({**arrays, name: np.full_like(x, np.nan)}, name),
        f"{name} has shape": npz({**arrays, name: x[:, :2]}, name),
        rf"{name} has shape \(0, ": npz({key: y[:0] for key, y in arrays.items()}, name),
        rf"has shape \({count}, ": npz({**arrays, name: x[:1]}, name),
        rf"{name} has shape \(\)": npz({**arrays, name: x[0, 0]}, name),
        f"{name} must hold finite": npz({**arrays, name: x.astype("U9")}, name),
    }
    if file == "starts.npz":
        wrongs["no flight starts with the quaternion"] = npz({**arrays, "quaternion": 2 * arrays["quaternion"]}, name)
        wrongs["no flight starts with the velocity"] = npz(
            {**arrays, "velocity": np.full((count, 3), 1e7, np.float32)}, name
        )
    for message, content in wrongs.items():
        (folder / file).write_bytes(content)
        fit(folder, about)
        with pytest.raises(TamperedBundle, match=f"policy/{file}.*{message}"):
            load_bundle(folder)


# -- networks ----------------------------------------------------------------------------------------------------------


def model(nodes, constants=(), size=13, output="action", batch="batch", **more):
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, n])]
        for name, n in (("observation", size), (output, 4))
    ]
    graph = helper.make_graph(nodes, "policy", *ends, constants)
    opset = [helper.make_opsetid("", 20), helper.make_opsetid("com.microsoft", 1)]
    return helper.make_model(graph, ir_version=10, opset_imports=opset, **more)


def weight(columns=13, scale=0.1):
    return onnx.numpy_helper.from_array(np.full((4, columns), scale, np.float32), "w")


def gemm(output="action"):
    return helper.make_node("Gemm", ["observation", "w"], [output], transB=1)


def elsewhere():
    tensor = TensorProto(name="w", data_type=1, dims=[4, 13], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="secret.bin")
    return tensor


def loop():
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"])],
        "body",
        [helper.make_tensor_value_info("i", 7, []), helper.make_tensor_value_info("go", 9, [])],
        [helper.make_tensor_value_info("on", 9, [])],
    )
    return helper.make_node("Loop", ["", "yes"], [], body=body)


FUNCTION = helper.make_function("", "Tanh", ["x"], ["y"], [helper.make_node("Relu", ["x"], ["y"])], [])
NETWORKS = {
    "keeps weights in another file": lambda: model([gemm()], [elsewhere()]),
    "computes 'Loop', and no policy": lambda: model([gemm(), loop()], [weight()]),
    "computes 'com.microsoft.Gelu'": lambda: model(
        [gemm("sum"), helper.make_node("Gelu", ["sum"], ["action"], domain="com.microsoft")], [weight()]
    ),
    "computes 'Nonsense'": lambda: model([helper.make_node("Nonsense", ["observation"], ["action"])]),
    r"has the fields \[25\] beside its graph": lambda: model([gemm()], [weight()], functions=[FUNCTION]),
    "reads {'observation': .*12.*, and the contract says .*13": lambda: model([gemm()], [weight(12)], 12),
    "writes {'thrust': .*, and the contract says": lambda: model([gemm("thrust")], [weight()], output="thrust"),
    r"reads {'observation': \('tensor\(float\)', 1, 13": lambda: model([gemm()], [weight()], batch=1),
    "onnxruntime cannot read it": lambda: model([gemm()]),
    "is damaged: it is no ONNX": lambda: b"\x3a\x99\x99",
    "onnxruntime cannot read it: .*No graph was found": lambda: b"",
}


RULES = {
    "keeps weights in another file": NETWORKS["keeps weights in another file"],
    "computes 'Loop', and no task": NETWORKS["computes 'Loop', and no policy"],
    "computes 'RandomNormal', and no task": lambda: model([helper.make_node("RandomNormal", [], ["x"], shape=[1])]),
    "computes 'com.microsoft.Gelu'": NETWORKS["computes 'com.microsoft.Gelu'"],
    "reads {'observation': .*, and the contract says .*'position'": NETWORKS[
        "writes {'thrust': .*, and the contract says"
    ],
}


@pytest.mark.parametrize(
    ("file", "message", "made"),
    [*(("policy.onnx", *x) for x in NETWORKS.items()), *(("observe.onnx", *x) for x in RULES.items())],
)
def test_a_graph_that_no_export_writes_is_refused_and_reads_no_other_file(
    copied, file, message, made, monkeypatch, capfd
):
    folder, about = copied()
    monkeypatch.chdir(folder.parent)
    (folder.parent / "secret.bin").write_bytes(np.ones((4, 13), np.float32).tobytes())
    content = made()
    (folder / file).write_bytes(content if isinstance(content, bytes) else content.SerializeToString())
    fit(folder, about)
    with pytest.raises(TamperedBundle, match=f"{file} {message}|{file}: {message}") as refused:
        load_bundle(folder)
    assert str(refused.value).isprintable() and capfd.readouterr() == ("", "")


def test_a_network_that_leaves_its_limits_or_its_shape_in_flight_is_a_fault(copied):
    folder, about = copied()
    twice = helper.make_node("Concat", ["sum", "sum"], ["action"], axis=0)  # onnxruntime believes what is declared
    for made, message in (
        (model([gemm()], [weight(scale=9.0)]), r"policy: The action leaves -1 to 1, which no exported policy does"),
        (
            model([gemm("sum"), twice], [weight()]),
            r"policy: policy.onnx answered arrays of the shapes \(2, 4\)",
        ),
    ):
        (folder / "policy.onnx").write_bytes(made.SerializeToString())
        fit(folder, about)
        with pytest.raises(BrokenPolicy, match=message):
            load_bundle(folder)(resting())
