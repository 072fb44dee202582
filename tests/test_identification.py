"""From flights to parameters: simulated flights whose truth is known, and a real one."""

import dataclasses
import gzip
import json
import re

import numpy as np
import pytest
import torch
from helpers import ROOT, refuses
from log_writers import END, OURS, TABLE, G, flight, matrix, own_table, write_csv
from scipy.spatial.transform import Rotation

from benchmarks import identification as benchmark
from torchrl_quad import HoveringEnv, load_drone
from torchrl_quad.deploy import frames
from torchrl_quad.dynamics import MotorCommand
from torchrl_quad.errors import UserError, UserValueError
from torchrl_quad.identification import LAYOUTS, Columns, estimation, fitting, identify, prediction, read_log
from torchrl_quad.identification.errors import NoFlight, TooShort, WrongFrame, WrongQuaternion, WrongUnit
from torchrl_quad.identification.parameters import UNKNOWNS, Model
from torchrl_quad.identification.prediction import prediction_error

REAL = ROOT / "examples/data/figure8.csv.gz"
BRIEF = {"horizon": 0.2, "past": 0.1}
QUICK = {"fields": ["linear_drag"], "draws": 0} | BRIEF
pytestmark = pytest.mark.usefixtures("quick_fits")


@pytest.fixture(scope="module")
def simulated():
    """A noisy flight of eight seconds, simulated in steps of half a sample of the log."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"STEP": 0.005, "CONTROL": 1, "SAMPLE": 2}.items():
            patch.setattr(benchmark, name, value)
        truth = benchmark.true_drone()
        return benchmark.simulate_flight(0, truth, seconds=8.0, stream_delay=0.015), truth


@pytest.fixture(scope="module")
def real():
    return read_log(REAL)


@pytest.fixture(scope="module")
def short(real):
    return dataclasses.replace(real, segments=((300, 700),))


@pytest.fixture
def rough(monkeypatch):
    """Fits read every other sample, and less of what was before a window."""
    monkeypatch.setattr(prediction, "SAMPLE", 0.02)
    monkeypatch.setattr(prediction, "WARM_UP", 0.2)


def test_a_fit_finds_the_drone_of_a_simulated_flight_and_writes_files_that_fly(simulated, tmp_path, capsys):
    log, truth = simulated
    start = benchmark.start(0, truth)
    wanted = ["thrust_map", "inertia", "yaw_torque_coefficient", "command_delay", "stream_delay"]
    known = {name: getattr(truth, name) for name in ("mass", "linear_drag", "drag_height", "motor_time_constant")}
    file = tmp_path / "checkpoint.json"
    result = identify(log, start, known, wanted, draws=50, iterations=9, checkpoint=file)
    found = {**result.parameters, **result.ratios}
    tolerance = {"k2/m": 0.01, "arm k2/Jx": 0.04, "arm k2/Jy": 0.04, "kappa k2/Jz": 0.06}
    for name, most in tolerance.items():
        assert found[name]["value"] == pytest.approx(benchmark.truths(truth)[name], rel=most), name
        assert found[name]["low"] < found[name]["value"] < found[name]["high"]
    assert result.stream_delay[log.name]["value"] == pytest.approx(0.015, abs=0.005)
    assert found["command_delay"]["value"] == pytest.approx(0.010, abs=0.005)
    before, after = (result.errors[k]["attitude"][0.5] for k in ("prior", "fitted"))
    assert after < 0.5 * before
    # The intervals of the bootstrap are about as wide as those of the Jacobian.
    low, high = result.bootstrap["k2/m"]
    assert 0.3 < (high - low) / (found["k2/m"]["high"] - found["k2/m"]["low"]) < 2.0

    # Going on from a finished fit takes no step, and a fit is the same again.
    again = identify(log, start, known, wanted, draws=50, iterations=9, checkpoint=file, progress=True)
    assert "step" not in capsys.readouterr().out
    assert again.report() == result.report()

    # The pictures show predictions as long as those of the fit: a short flight has room for no longer ones.
    short = dataclasses.replace(log, segments=((log.segments[0][0], log.segments[0][0] + 160),))
    brief = dataclasses.replace(result, flights=[short], settings={**result.settings, **BRIEF})
    assert (brief.save(tmp_path / "brief") / "residuals.png").exists()

    folder = result.save(tmp_path / "fit", pictures=False)
    drone = load_drone(folder / "drone.yaml", torch.float64)
    assert drone.motor_command.delay == pytest.approx(result.drone.motor_command.delay, rel=1e-5)
    errors = prediction_error(log, folder / "drone.yaml")
    assert errors["position"] == pytest.approx(prediction_error(log, result)["position"], rel=1e-3)
    env = HoveringEnv(num_envs=3, drone=str(folder / "drone.yaml"), randomize=str(folder / "randomization.yaml"))
    assert (env.reset()["state", "drone", "inertia"][:, 0].std() > 0).all()
    report = json.loads((folder / "report.json").read_text())
    assert report["parameters"]["inertia.x"]["value"] == found["inertia.x"]["value"]


@pytest.mark.usefixtures("rough")
def test_a_fit_that_was_stopped_goes_on_as_if_it_had_not(short, tmp_path, monkeypatch, capsys):
    file, write, options = tmp_path / "checkpoint.json", estimation.Checkpoint.write, QUICK | {"iterations": 9}
    straight = identify(short, **options)

    def stop(self, stage, state):
        write(self, stage, state)
        if state.iteration in (2, 8):  # while the scale of the residuals follows the steps, and when it stands
            assert not state.converged
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(estimation.Checkpoint, "write", stop)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                identify(short, **options, checkpoint=file)
    resumed = identify(short, **options, checkpoint=file, progress=True)
    assert re.findall(r"step (\d+)", capsys.readouterr().out)[:1] == ["9"]
    assert resumed.report() == straight.report()


def test_a_checkpoint_is_of_one_flight_only(real):
    prior = load_drone("visfly", torch.float64)

    def seen(**changes):
        return estimation.fingerprint([dataclasses.replace(real, **changes)], prior, MotorCommand(500.0, 3.7), "lag")

    assert seen(name="renamed", notes=("one more",)) == seen()  # which no fit reads
    columns = ["time", "position", "velocity", "quaternion", "angular_velocity", "motor_command", "battery_voltage"]
    changed = {name: seen(**{name: 1.01 * getattr(real, name)}) for name in columns}
    changed |= {"no voltage": seen(battery_voltage=None), "one clock": seen(onboard=()), "none": seen(segments=())}
    assert [name for name, mark in changed.items() if mark == seen()] == []
    assert len(set(changed.values())) == len(changed)


@pytest.mark.usefixtures("rough")
def test_what_a_flight_does_not_tell_gets_no_number_but_a_reason(simulated):
    log, truth = simulated
    level = {"quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (len(log.time), 1)), "onboard": ()}
    level |= {"velocity": 0.0 * log.velocity, "angular_velocity": 0.0 * log.angular_velocity}
    # What holds this drone: its hover speed over volts.
    held = np.repeat(1731.3 / (700.0 * log.battery_voltage[:, None]), 4, 1)
    hover = dataclasses.replace(log, position=0.0 * log.position + [0.0, 0.0, 1.0], motor_command=held, **level)
    result = identify(hover, truth, fields=["thrust_map", "linear_drag", "inertia"], iterations=3, draws=0)
    assert set(result.ratios) == {"k2/m"}
    assert result.parameters == {}  # no mass, no numbers that scale with it
    assert {"mass", "thrust_map", "linear_drag.xy", "linear_drag.z", "inertia.x"} <= set(result.not_identifiable)
    assert "nothing in the flights depends on it" in result.not_identifiable["inertia.x"]
    assert "weigh the drone" in result.not_identifiable["mass"]
    torch.testing.assert_close(result.drone.linear_drag, truth.linear_drag)


def test_the_jacobian_of_a_fit_is_that_of_central_differences(real):
    prior = load_drone("crazyflie", torch.float64)
    free = tuple(name for name in UNKNOWNS if name != "stream")
    model = Model(prior, prior.motor_command, free)
    short = prediction.cut([real], 0.3, 0.1, 4.0, 0.02, prior.motor_command.nominal_voltage)
    problem = fitting.Problem(model, short, moves_streams=True, counts_push=True)
    x = model.start + 0.1 * torch.randn(len(free), dtype=torch.float64)  # where two time constants are two
    streams = torch.tensor([prediction.stream_delay(real)], dtype=torch.float64)
    _, jacobian = problem.linearise(fitting.State(free, x, streams), update_scale=True)
    assert jacobian.shape == (len(short), problem.scale.numel(), len(UNKNOWNS))
    for i, name in enumerate(UNKNOWNS):
        step = 1e-5 * torch.eye(len(UNKNOWNS), dtype=torch.float64)[i]
        moved, shift = step[:-1], UNKNOWNS["stream"].scale * step[-1]
        ends = problem.raw(x + moved, shift, streams), problem.raw(x - moved, -shift, streams)
        slope = (ends[0] - ends[1]) / 2e-5 / problem.scale
        size = slope.abs().max()
        assert size > 0.0, name
        torch.testing.assert_close(jacobian[..., i], slope, rtol=1e-4, atol=1e-5 * size.item())


def test_predictions_of_a_drone_that_is_right_are_right_and_of_one_that_drifts_are_worked_by_hand(simulated, real):
    log, truth = simulated
    errors = prediction_error(log, truth, (0.1, 0.5))
    wrong = prediction_error(log, truth.replace(inertia=2.0 * truth.inertia), (0.1, 0.5))
    coasting = prediction_error(log, "constant_velocity", (0.1, 0.5))
    for name in ("velocity", "attitude", "body_rate"):
        assert errors[name][0.5] < 0.35 * coasting[name][0.5], name
        assert name == "velocity" or errors[name][0.5] < 0.5 * wrong[name][0.5], name
    # A flight along a parabola: constant velocity misses it by g t^2 / 2.
    time = real.time
    fall = np.stack((0.0 * time, 0.0 * time, -0.5 * 9.81 * time**2), 1)
    level = {"quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1)), "angular_velocity": np.zeros_like(fall)}
    falling = dataclasses.replace(real, position=fall, velocity=np.gradient(fall, real.dt, axis=0), **level)
    missed = prediction_error(falling, "constant_velocity", (0.4,))
    assert missed["position"][0.4] == pytest.approx(0.5 * 9.81 * 0.16, rel=1e-6)
    assert missed["velocity"][0.4] == pytest.approx(9.81 * 0.4, rel=1e-6)
    # A drone that knows no motors carries its weight: along this flight it is not far off after a tenth of a second.
    plain = dataclasses.replace(load_drone("visfly", torch.float64), motor_command=None)
    assert prediction_error(real, plain, (0.1,))["position"][0.1] < 0.01


REFUSED = {  # what a fit, or a prediction, says of an argument
    "identify": [
        ("past", -1, "past must"), ("horizon", 1e-9, "horizon must"), ("iterations", 1.5, "iterations must"),
        ("draws", 1, "draws must be 0, for no bootstrap, or at least 2"), ("seed", 10**400, "seed must"),
        ("fields", [], "fields is empty"), ("fields", ["mass"], "cannot fit 'mass'. Choose from: thrust_map"),
        ("fields", {"inertia": 1}, "fields"), ("known", 5, "known"), ("known", {1: 2}, "1"),
        ("known", {"weight": 1.0}, "weight"), ("known", {"command_delay": True}, "delay"),
        *(("known", {"mass": x}, "mass") for x in (True, "1", [[1], [2]], 10**400)),
        ("known", {"linear_drag": [0.1, 0.1, 0.1]}, "nothing is left to fit"),
        *(("drone", x, "drone") for x in (5, None, {})), *(("log", x, "log must be") for x in (5, "a.csv", [None])),
        ("log", [], "at least one flight"), ("progress", 1, "progress must"), ("checkpoint", 5, "checkpoint must"),
    ],
    "prediction_error": [
        ("past", float("nan"), "past must"), ("every", 0, "every must"), ("drone", 5, "drone"), ("log", None, "log"),
        *(("horizons", x, "horizons") for x in (0.1, [], [0.0], [-0.1], ["a"], [True], [10**400], None)),
    ],
}  # fmt: skip


def test_arguments_of_fits_and_predictions_are_refused_in_one_line_and_a_flight_of_ones_own_must_be_whole(real):
    def flown(*segments):
        return dataclasses.replace(real, segments=segments)

    usual = {"identify": QUICK | {"log": flown((300, 700)), "iterations": 1}}
    usual["prediction_error"] = {"log": flown((300, 700)), "drone": "crazyflie", "horizons": (0.1,)}
    functions = {"identify": identify, "prediction_error": prediction_error}
    for function, table in REFUSED.items():
        for name, value, message in table:
            with pytest.raises(UserError, match=message) as refused:
                functions[function](**usual[function] | {name: value})
            assert "\n" not in str(refused.value) and len(str(refused.value)) < 800, (function, name, value)
    still = dataclasses.replace(real, motor_command=0.0 * real.motor_command)
    no_motors = dataclasses.replace(load_drone("visfly"), motor_command=None)
    plain = {key: value.squeeze().tolist() for key, value in no_motors.fields().items()}
    for error, message, call, *arguments in (
        (TooShort, "too few", identify, flown((300, 600))),
        (TooShort, "no piece of the flight is 1.90 s long", prediction_error, flown((300, 420)), "crazyflie"),
        (TooShort, "figure8 has no piece in flight", prediction_error, flown(), "visfly"),
        (NoFlight, "its motor commands are zero", prediction_error, still, no_motors),
        (UserError, "missing key 'nominal_voltage'", load_drone, plain | {"motor_command": {"speed_per_volt": 500.0}}),
        (UserError, "unknown key 'gain'. Allowed: speed", load_drone, plain | {"motor_command": {"gain": 1.0}}),
        (UserError, "command: it must be a mapping .*; got 500.0", load_drone, plain | {"motor_command": 500.0}),
    ):
        refuses(message, call, *arguments, error=error)
    bad = [("position", x) for x in (None, 5, "a", np.zeros(3), np.nan * real.position)]
    bad += [("time", x) for x in (None, 5, "a", np.nan * real.time, real.time[::-1], 100.0 * real.time)]
    bad += [("segments", x) for x in (None, 5, ((5, 3),), ((0, 10**9),), ((-1, 5),), (("a", 5),))]
    bad += [("setpoint", 5), ("name", 5), ("quaternion", real.position), ("onboard", "gyro")]
    for name, value in bad:
        refuses(name, dataclasses.replace, real, error=UserError, **{name: value})


@pytest.mark.usefixtures("rough")
def test_what_contradicts_the_drone_is_found_and_no_inertia_is_one_that_no_body_has(real, short):
    turned = "the other way than the drone's.*Write rotor_spin: .1, -1, 1, -1. in the drone"
    refuses(turned, identify, short, "crazyflie", {"rotor_spin": [-1, 1, -1, 1]}, **QUICK)
    heavy = r"left over .*mass of 0.06 kg or its thrust.*name \"thrust_map\" in fields"
    refuses(heavy, identify, short, "crazyflie", {"mass": 0.06}, iterations=1, **QUICK)
    plain = dataclasses.replace(load_drone("crazyflie"), motor_command=None)
    assert "mass: it cannot be judged" in identify(short, plain, {"mass": 0.06}, iterations=1, **QUICK).verdict
    large = dataclasses.replace(short, battery_voltage=10.0 * real.battery_voltage)
    refuses("a battery has 3.* V in the mean, and the drone's motor_command is for", identify, large, **QUICK)
    result = identify(short, iterations=1, **QUICK)
    assert max(map(abs, result.trim["force_per_weight"])) < 0.1 and set(result.errors_by_flight) == {"figure8"}
    strong = dataclasses.replace(result, drone=result.drone.replace(thrust_map=1.8 * result.drone.thrust_map))
    assert "per mass the rotors give 1.80 times the thrust of the given drone" in strong.verdict
    assert "thrust" not in result.verdict
    worse = {**result.errors, "fitted": {name: {0.2: 9.0} for name in result.errors["fitted"]}}
    assert "the fit predicts worse than constant velocity: position (9 against" in dataclasses.replace(
        result, errors=worse).verdict  # fmt: skip
    prior = load_drone("crazyflie", torch.float64)
    whole = ("roll", "pitch", "z_ratio"), ([0.3, -0.4, 20.0], [0.3, -0.4, -20.0])
    for free, steps in (whole, (("roll",), ([3.0], [-3.0]))):
        model = Model(prior, prior.motor_command, free)
        for step in steps:
            inertia = model.params(model.bounded(model.start + torch.tensor(step, dtype=torch.float64))).inertia
            assert 2.0 * inertia.max() <= inertia.sum() * (1.0 + 1e-9)


BROKEN = ("{", "[]", "5", '{"stages": 5}', "[" * 100_000, "\xff", '{"fingerprint": "F", "stages": 5}')
DRAG = {"free": ["drag_xy", "drag_z"]}
BROKEN_STAGES = (5, {}, {"free": 5}, DRAG, DRAG | {"x": [0], "streams": [0]})


@pytest.mark.usefixtures("rough")
def test_a_checkpoint_that_is_damaged_is_refused_and_named(short, tmp_path):
    file = tmp_path / "checkpoint.json"
    options = QUICK | {"iterations": 1, "checkpoint": file}
    identify(short, **options)
    whole = json.loads(file.read_text())
    first = next(iter(whole["stages"]))
    texts = [text.replace("F", whole["fingerprint"]) for text in BROKEN]
    for stage in (*BROKEN_STAGES, whole["stages"][first] | {"x": [1e999, 0]}, whole["stages"][first] | {"more": 1}):
        texts.append(json.dumps({**whole, "stages": {first: stage}}))
    for text in texts:
        file.write_text(text, encoding="latin-1")
        with pytest.raises(UserError, match="checkpoint.json is not a checkpoint of a fit: .*Delete it to start again"):
            identify(short, **options)


@pytest.mark.usefixtures("rough")
def test_the_recipe_fits_a_real_flight_and_draws_it(launch, refused, tmp_path):
    (tmp_path / "own.csv").write_text(gzip.decompress(REAL.read_bytes()).decode().replace("pwr_pm_vbat", "volts"))
    own = ["columns={battery_voltage: {names: [volts], scale: 1.0}}", "convention=crazyflie", "reading={max_gap: 0.2}"]
    arguments = [f"logs=[{tmp_path}/own.csv]", *own, "mass=0.027", "fields=[linear_drag]", "iterations=1", "draws=5"]
    assert "linear_drag.xy" in launch("identify", *arguments, f"folder={tmp_path}/fit")
    names = "checkpoint.json drone.yaml prediction.png randomization.yaml report.json residuals.png"
    assert sorted(path.name for path in (tmp_path / "fit").iterdir()) == names.split()
    assert refused("identify", "logs=[none.csv]").startswith("Error: none.csv")
    assert frames.named({"name": "px4", "xyzw": True}).xyzw and frames.named("mujoco") == frames.mujoco()
    assert "convention" in refused("identify", f"logs=[{REAL}]", "convention={xyzw: true}")
    assert "mass=-1: it must be greater than 0" in refused("identify", f"logs=[{REAL}]", "mass=-1")


def by_thrust(t, position, push=0.0, turned=0.0):
    """The table of a flight by a thrust that leaves ``push`` (T, 3) [m/s^2] to drag and wind, ``turned`` about y beside
    [rad]."""
    velocity = np.gradient(position, t, axis=0)
    up = np.gradient(velocity, t, axis=0) + (0.0, 0.0, G) - push
    x, y, z = (up / np.linalg.norm(up, axis=-1, keepdims=True)).T
    lean = Rotation.from_quat(np.stack((-y, x, 0.0 * x, 1.0 + z), -1))
    lean *= Rotation.from_rotvec(np.outer(turned + 0.0 * t, (0.0, 1.0, 0.0)))
    quaternion = lean.as_quat(scalar_first=True)
    rates = np.zeros_like(position)
    rates[1:-1] = (lean[:-2].inv() * lean[2:]).as_rotvec() / (t[2:] - t[:-2])[:, None]
    command = np.random.default_rng(1).uniform(0.45, 0.55, (len(t), 4))
    true = {"position": position, "velocity": velocity, "quaternion": quaternion, "angular_velocity": rates}
    columns = {"t": t}
    for quantity, values in (true | {"motor_command": command}).items():
        columns |= dict(zip(OURS[quantity], values.T, strict=True))
    return columns


def test_drag_wind_flips_and_noise_are_no_reason_to_refuse_a_flight(tmp_path):
    t, mapping = np.arange(0.0, 30.0, 0.01), {k: x for k, x in TABLE.items() if k != "acceleration"}
    height = 20.0 + 0.3 * np.sin(0.9 * t)
    circle = np.stack((50.0 * np.cos(0.2 * t), 50.0 * np.sin(0.2 * t), height), -1)
    along = np.stack((3.0 * np.sin(1.2 * t), 0.0 * t, height), -1)
    gusts = np.stack((0.0 * t, 0.7 * np.sin(2.1 * t) + 0.5 * np.sin(0.7 * t + 1.0), 0.0 * t), -1)
    flips = 2.0 * np.pi * np.clip((t % 4.0 - 1.0) / 0.5, 0.0, 1.0)
    hover = np.stack((0.0 * t, 0.0 * t, height), -1)
    noisy = hover + 0.002 * np.random.default_rng(0).standard_normal(hover.shape)
    for name, table in {
        "circle": by_thrust(t, circle, -0.3 * np.gradient(circle, t, axis=0)),
        "crosswind": by_thrust(t, along, gusts),
        "flips": by_thrust(t, hover, turned=flips),
        "noise": by_thrust(t, hover, turned=0.02 * np.sin(3.0 * t)) | dict(zip("xyz", noisy.T, strict=True)),
    }.items():
        columns = mapping if name != "noise" else {k: x for k, x in mapping.items() if k != "velocity"}
        assert len(read_log(write_csv(tmp_path / f"{name}.csv", table), columns).time) > 2900, name


def test_euler_angles_and_velocities_of_the_body_become_ours(tmp_path):
    t = np.arange(0.0, END, 0.01)
    true = flight(t)
    r = matrix(true["quaternion"])
    columns = own_table(t, velocity=np.einsum("nji,nj->ni", r, true["velocity"]))
    columns["roll"], columns["pitch"] = np.arctan2(r[:, 2, 1], r[:, 2, 2]), -np.arcsin(r[:, 2, 0])
    columns["yaw"] = np.degrees(np.arctan2(r[:, 1, 0], r[:, 0, 0]))
    path = write_csv(tmp_path / "own.csv", columns)
    euler = Columns(("roll", "pitch", "yaw"), scale=(1.0, 1.0, np.pi / 180))
    turned = {k: v for k, v in TABLE.items() if k not in ("velocity", "quaternion")}
    log = read_log(path, {**turned, "velocity_body": OURS["velocity"], "euler": euler})
    np.testing.assert_allclose(log.velocity, true["velocity"], atol=1e-6)
    np.testing.assert_allclose(np.abs((log.quaternion * true["quaternion"]).sum(-1)), 1.0, atol=1e-7)
    refuses('"velocity_body"', read_log, path, TABLE, error=WrongFrame)
    rates = np.einsum("nij,nj->ni", r, true["angular_velocity"])
    with pytest.raises(WrongFrame, match="in the world frame"):
        read_log(write_csv(path, own_table(t, angular_velocity=rates)), TABLE)
    # Angles and quaternions of NED and FRD follow from the convention, and what is odd of them is told in its frame.
    ned = {k: true[k] for k in ("position", "velocity", "angular_velocity")}
    theirs = frames.px4().to(ned | {"quaternion": true["quaternion"]})
    angles = Rotation.from_quat(theirs["quaternion"], scalar_first=True).as_euler("xyz")
    given = dict(zip(("roll", "pitch", "yaw"), angles.T, strict=True))
    last = np.roll(theirs["quaternion"], -1, 1)
    write_csv(path, own_table(t, **{k: theirs[k] for k in ned}, quaternion=last) | given)
    read = {k: v for k, v in TABLE.items() if k not in ("acceleration", "quaternion")}
    px4 = dataclasses.replace(frames.px4(), motors=(0, 1, 2, 3))
    turned = read_log(path, read | {"euler": ("roll", "pitch", "yaw")}, convention=px4)
    np.testing.assert_allclose(np.abs((turned.quaternion * true["quaternion"]).sum(-1)), 1.0, atol=1e-7)
    read["quaternion"] = OURS["quaternion"]
    refuses("if the quaternion is scalar last", read_log, path, read, convention=px4, error=WrongQuaternion)
    write_csv(path, own_table(t, motor_command=1000.0 + 1000.0 * true["motor_command"]))
    refuses("pulses.*scale=0.001, offset=1000", read_log, path, TABLE, error=WrongUnit)
    few = {k: v for k, v in TABLE.items() if k in ("time", "position", "quaternion")}
    log = read_log(path, few | {"motor_command": Columns(OURS["motor_command"], scale=1 / 2000)})
    inside = slice(*log.segments[0])
    np.testing.assert_allclose(log.velocity[inside], true["velocity"][inside], atol=0.02)
    assert log.acceleration is None and log.setpoint is None
    twisted = {k: v for k, v in TABLE.items() if k != "quaternion"} | {"euler": OURS["angular_velocity"]}
    write_csv(path, own_table(t))
    refuses("does not follow euler .*belong together.$", read_log, path, twisted, error=WrongFrame)  # no order mends it


def test_a_gyro_on_another_clock_is_no_other_order_of_motors(tmp_path):
    rows = np.genfromtxt(REAL, delimiter=",", names=True)
    late = {x: np.roll(rows[x], 10 * x.startswith("imu_gyro")) for x in rows.dtype.names}
    assert "fits how the drone turns if its rates are " in str(read_log(write_csv(tmp_path / "late.csv", late)))


def test_columns_and_layouts_say_which_of_their_fields_is_wrong():
    wrong = {"scale": (0, True, "2", None, np.inf, 10**400, (1, 2), 1j), "offset": (np.nan, [], [[1.0] * 3])}
    for field, values in wrong.items():
        for value in values:
            with pytest.raises(UserValueError, match=f"Columns: {field} of a, b, c must be a number, or one for each"):
                Columns(("a", "b", "c"), **{field: value})
    refuses("names must be the names of columns, got 5", Columns, 5, error=UserValueError)
    for changes, message in (
        ({"columns": {"position": ("x", "y", "z")}}, "position takes 3 column.* got 1: x"),
        ({"columns": {"position": (5,)}}, "columns: 'position' takes the name of a column"),
        ({"columns": {"speed": (("v",),)}}, "Unknown quantity 'speed'"),
        ({"convention": "px4"}, "convention must be one of torchrl_quad.deploy.frames, got 'px4'"),
        ({"time": Columns(("s", "ns"))}, "time takes 1 column.* got 2: s, ns"),
    ):
        refuses(message, dataclasses.replace, LAYOUTS["nanobench"], error=UserError, **changes)
