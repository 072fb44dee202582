"""A bundle flies elsewhere as it does in our own simulator, is judged as our evaluation does, and its mutants fail."""

import copy
import re
import sys

import numpy as np
import pytest
import torch
from deploying import pilot
from helpers import cases, refuses, run

from torchrl_quad import HoveringEnv, load_drone, make_env
from torchrl_quad.deploy import describe, load_bundle
from torchrl_quad.deploy.judging import Judge, judge
from torchrl_quad.deploy.simulators import make_simulator
from torchrl_quad.deploy.simulators.mujoco import MuJoCo
from torchrl_quad.deploy.simulators.vehicle import ContractLoop, Drone
from torchrl_quad.deploy.transfer import MUTANTS, fly, measure, mistakes
from torchrl_quad.dynamics import FlightController
from torchrl_quad.errors import UserError, UserValueError
from torchrl_quad.files import read_rows

NAMES = ("position", "quaternion", "velocity", "angular_velocity")
STEPS = 110


def turned(name):
    """Drones that begin turned and moving, two steps of delay, and another drone than the nominal one."""
    start = {"yaw": 0.7, "tilt": 0.2, "velocity": 0.1}
    env = make_env("hovering", num_envs=8, max_episode_steps=STEPS, seed=0, random_start=start, action_delay=2)
    env.start_range = (0.2, 0.2, 0.1)
    env.set_params(env.params.replace(mass=0.47, motor_time_constant=0.03))
    return env, pilot(env)


@pytest.fixture
def hovering(export_once):
    return export_once("turned", turned)[2]


@pytest.mark.parametrize("drone", ["visfly", "crazyflie"])
def test_the_rate_loop_in_numpy_is_that_of_the_simulator_within_and_beyond_the_limits(drone):
    params = load_drone(drone, torch.float64).replace(drag_height=0.0)
    theirs = FlightController(params)
    ours = Drone({name: x.squeeze().tolist() for name, x in params.fields().items()})
    draw = torch.Generator().manual_seed(0)
    spread = torch.logspace(-2, 1, 200, dtype=torch.float64)[:, None]
    rates, turning = (spread * torch.randn(200, 3, dtype=torch.float64, generator=draw) for _ in range(2))
    thrust = theirs.half_range * 2 * torch.rand(200, 1, dtype=torch.float64, generator=draw)
    speed = theirs.hover_speed * (1 + 0.2 * torch.randn(200, 4, dtype=torch.float64, generator=draw))
    expected = theirs.rotor_speed(type(theirs).setpoint_type(thrust, rates), turning, theirs.rotors.wrench(speed))
    asked = ContractLoop(ours, 0.001)(thrust[:, 0].numpy(), rates.numpy(), turning.numpy(), speed.numpy())
    low, high = (x.item() for x in (theirs.rotors.speed(theirs.thrust_min), theirs.rotors.speed(theirs.thrust_max)))
    saturated = ((expected < 1.001 * low) | (expected > 0.999 * high)).any(1)
    assert 20 < saturated.sum() < 180
    np.testing.assert_allclose(asked, expected, rtol=1e-9)


COMMANDS = {  # by commands that change all the time
    "rates": lambda x: np.stack((4.5 * (1 + 0.3 * x), x, -0.5 * x, 0.4 + 0.2 * x), 1),
    "attitude": lambda x: np.stack((4.5 * (1 + 0.3 * x), 0.4 * x, -0.3 * x, 0.4 + 0.2 * x), 1),
    "velocity": lambda x: np.stack((2 * x, -x, 0.5 + x, 0.4 + 0.2 * x), 1),
    "rotor_thrusts": lambda x: 1.12 * (1 + 0.3 * x[:, None] * (1, 0.98, 0.97, 0.99)),
}


def wobble(simulator, contract, steps=400, **options):
    """Where drones get in open loop, from tilted and fast starts."""
    command = COMMANDS[contract["output"]["control"]]
    draw = np.random.default_rng(0)
    n, world = 6, make_simulator(simulator, contract, **options)
    attitude = np.array([1.0, 0, 0, 0]) + 0.4 * draw.standard_normal((n, 4))
    starts = dict(zip(NAMES, (draw.standard_normal((n, k)) for k in (3, 4, 3, 3)), strict=True))
    starts["velocity"] *= 3.0
    starts["position"][:, 2] += 5.0  # Crazyflow has a floor
    starts["quaternion"] = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    world.reset(starts)
    for t in range(steps):
        world.step(command(np.sin(0.02 * t + np.arange(n))))
    return world.state()


def in_small_steps(folder):
    contract = load_bundle(folder).contract
    return {**contract, "control_dt": 0.001, "simulator": {**contract["simulator"], "dt": 0.001}}


@cases(("rates", 0.03), *((mode, [0.02, 0.05]) for mode in COMMANDS))
def test_mujoco_moves_a_drone_as_our_simulator_does_by_any_commands(mode, lag, hovering):
    """At the same small step. The drone that flies is not the one that the controller believes in, and its drag acts
    above the centre of mass."""
    contract = in_small_steps(hovering)
    assert contract["plant"] == {"mass": 0.47, "motor_time_constant": 0.03}
    contract["plant"] = {"mass": 0.47, "motor_time_constant": lag, "drag_height": 0.02}
    commands = HoveringEnv(num_envs=1, control=mode)
    contract["output"] = {**contract["output"], **describe._commands(commands)}
    expected, found = wobble("torchrl_quad", contract), wobble("mujoco", contract)
    assert np.linalg.norm(expected["velocity"], axis=1).min() > 0.5
    assert np.abs(expected["quaternion"][:, 0]).min() < 0.95
    for name in expected:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-5, atol=1e-4, err_msg=name)
    shifted = wobble("mujoco", {**contract, "plant": {**contract["plant"], "mass": 0.46}})  # the tolerance is not wide
    assert np.abs(shifted["position"] - expected["position"]).max() > 1e-3


AS_ROTORPY = {"quadratic_drag": [0.0] * 3, "linear_drag": [0.0] * 3, "thrust_map": [4.1e-7, 0.0, 0.0]}


@pytest.mark.slow  # both are optional, and slow to start
@pytest.mark.filterwarnings("ignore:Attaching a spec with an empty prefix:UserWarning")  # of Crazyflow's own model
@cases(
    ("crazyflow", {"quadratic_drag": [0.0, 0.0, 0.0]}),
    ("crazyflow", {"quadratic_drag": [0.0, 0.0, 0.0], "motor_time_constant": [0.02, 0.05]}),
    ("rotorpy", AS_ROTORPY),
    ("rotorpy", {**AS_ROTORPY, "motor_time_constant": [0.02, 0.05]}),
)
def test_other_simulators_move_a_drone_as_ours_does_where_their_models_agree(simulator, changes, hovering):
    pytest.importorskip(simulator)
    contract = in_small_steps(hovering)
    plant = {"mass": 0.47, "motor_time_constant": changes.get("motor_time_constant", 0.03)}
    contract |= {"drone": {**contract["drone"], **changes}, "plant": plant}
    expected, found = wobble("torchrl_quad", contract), wobble(simulator, contract)
    for name, tolerance in {"position": 5e-3, "quaternion": 1e-3, "velocity": 5e-3, "angular_velocity": 1e-2}.items():
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=tolerance, err_msg=name)
    np.testing.assert_allclose(found["rotor_speed"], expected["rotor_speed"], rtol=3e-3)  # of another order in time


def test_the_pid_loop_follows_body_rates_without_reading_rotor_speeds(hovering):
    world = make_simulator("mujoco", load_bundle(hovering).contract, "pid")
    level = {"position": np.zeros((2, 3)), "quaternion": np.eye(4)[[0, 0]]}
    world.reset({**level, "velocity": np.zeros((2, 3)), "angular_velocity": np.zeros((2, 3))})
    rates = np.array([[0.5, 0.0, 0.2], [0.0, -0.5, -0.2]])
    for _ in range(15):
        world.step(np.c_[np.full(2, 4.6), rates])
    np.testing.assert_allclose(world.state()["angular_velocity"], rates, atol=0.06)
    turning, memory = world.state()["angular_velocity"], copy.deepcopy(world.control.loop)
    loops = (world.control.loop, 0.0), (memory, 2000.0)
    slow, quick = (loop(np.full(2, 4.6), rates, turning, x) for loop, x in loops)
    np.testing.assert_array_equal(slow, quick)


def test_a_bundle_flies_in_mujoco_as_in_ours_and_as_the_environment_flew(hovering):
    bundle = load_bundle(hovering, on_fault="hover")
    ours, theirs = fly(bundle, "torchrl_quad"), fly(bundle, "mujoco")
    results = bundle.contract["results"]
    assert ours["metrics"]["solved"].mean() == theirs["metrics"]["solved"].mean() == results["solved"] == 1.0
    assert np.median(ours["metrics"]["position_error"]) == pytest.approx(results["position_error"], rel=0.05)
    assert np.abs(theirs["position"] - ours["position"]).max() < 0.01
    assert theirs["faults"] == {} and theirs["simulator"].startswith("MuJoCo")
    heavy = fly(bundle, "mujoco", "pid", scale={"mass": 1.3}, late=1)
    assert heavy["position"][:, -1, 2].mean() < theirs["position"][:, -1, 2].mean() - 0.05


def test_a_policy_with_eyes_sees_in_mujoco_what_it_sees_in_ours(export_once, monkeypatch):
    folder = export_once("hovering, without memory")[2]  # among no trees; each image for two steps, three steps late
    bundle = load_bundle(folder)
    ours = fly(bundle, "torchrl_quad")
    error, results = np.quantile(ours["metrics"]["position_error"], 0.5, method="lower"), bundle.contract["results"]
    assert error == pytest.approx(results["position_error"], rel=1e-4)
    assert ours["metrics"]["crash"].mean() == results["crash"]
    bundle = load_bundle(export_once("forest")[2])
    ours, theirs = (fly(bundle, name, episodes=8) for name in ("torchrl_quad", "mujoco"))
    assert theirs["faults"] == {} and ours["metrics"]["crash"].sum() > 0
    gap = np.abs(theirs["action"] - ours["action"]).max()
    assert gap < 0.01
    for name in ("crash", "distance", "clearance"):
        np.testing.assert_allclose(theirs["metrics"][name], ours["metrics"][name], atol=0.05)
    bundle._starts["scene.cylinders"][..., 0] += 500.0
    blind = fly(bundle, "mujoco", episodes=8)
    assert np.abs(blind["action"] - theirs["action"]).max() > 2.0 * gap
    monkeypatch.setattr(MuJoCo, "sees", False)
    refuses("mujoco has no camera, and this policy reads images. Fly it", fly, bundle, "mujoco", error=UserValueError)


def test_gates_and_laps_are_counted_from_the_lines_between_positions(export_once):
    env, _, folder = export_once("racing")
    bundle, gates = load_bundle(folder), env.base_env.gates.numpy()
    order = [3, 3, 0, 1, 1, 2, 3, 0]  # gate 0 is the next one; after steps 2, 3, 5, 6 and 7 another one is passed
    position = gates[order][None]
    flight = {"position": position, "velocity": 0 * position, "angular_velocity": 0 * position}
    flight |= {"quaternion": np.tile(np.eye(4)[0], (1, 8, 1)), "action": np.zeros((1, 7, 4))}
    starts = {name: x[:1] for name, x in bundle.starts().items() if name not in flight}
    found = judge(bundle, flight | starts | {"gate": np.zeros((1, 1), int)})
    assert (len(gates), found["gates_passed"], found["solved"]) == (4, 5, 0)
    assert found["lap_time"] == pytest.approx((7 - 2) * 0.02)


def test_a_drone_that_no_simulator_can_fly_is_refused_with_the_name_of_its_bundle(hovering, monkeypatch):
    bundle = load_bundle(hovering)
    monkeypatch.setitem(bundle.contract["simulator"], "dynamics", "balloon")
    with pytest.raises(UserValueError, match=f"^{hovering}: The simulator lacks the dynamics 'balloon'. Known are qu"):
        fly(bundle, "torchrl_quad")
    for options, why in (
        ({"late": True}, "late must be a whole number, at least 0, got True"),
        ({"episodes": 0}, "episodes must be a whole number, at least 1, got 0"),
        ({"scale": {"mass": "2"}}, "scale: mass must be a number from 0 to 1000, got '2'"),
        ({"mutant": "yaw"}, "mutant must be one of MUTANTS.values.., got 'yaw'"),
        ({"loop": ["pid"]}, "mujoco has no rate loop"),
    ):
        refuses(f"^{hovering}: {why}", fly, bundle, "mujoco", error=UserError, **options)
    refuses("mutant must be none or one of xyzw, ", measure, bundle, "t.csv", "mujoco", "contract", "yav")


def test_a_state_that_is_not_a_number_is_a_crash(hovering):
    bundle = load_bundle(hovering)
    starts = {name: x[:2] for name, x in bundle.starts().items()}
    follow = Judge(bundle, starts)
    for value in (1.0, np.nan):
        follow.step(np.zeros((2, 4)), starts | {"position": np.array([[1.0, 0.0, 1.5], [value, 0.0, 1.5]])})
    assert follow.flight()["crash"].tolist() == [[False, False], [False, True]]
    assert follow.flight()["done"].tolist() == [[False, False], [False, True]]


WITHOUT_TORCH = """
import runpy, sys
for name in ("torch", "torchrl", "tensordict", "hydra", "onnx"):
    sys.modules[name] = None
sys.argv = ["recipes/transfer.py", *sys.argv[1:]]
runpy.run_path("recipes/transfer.py", run_name="__main__")
"""


def test_the_recipe_flies_without_torch_keeps_a_table_and_finds_mistakes_of_a_port(hovering, tmp_path, launch):
    settings = [f"bundle={hovering}", f"folder={tmp_path}", "loop=contract"]
    run(sys.executable, "-c", WITHOUT_TORCH, *settings)
    (first,) = read_rows(tmp_path / "transfer.csv")
    assert (first["mutant"], first["solved"], first["episodes"]) == ("none", "1.0000", "8")
    printed = launch("transfer", *settings, "mutants=true")
    assert "MuJoCo" in printed and str(tmp_path / "transfer.csv") in printed
    table = read_rows(tmp_path / "transfer.csv")
    assert table[0] == first and [row["mutant"] for row in table] == ["none", *MUTANTS][:-1]
    failed = {row["mutant"] for row in table if float(row["solved"]) <= 0.5}
    assert failed >= {"xyzw", "yaw", "heading", "motors", "frd"}
    launch("transfer", *settings, "mutants=true")  # finds all of it there
    assert read_rows(tmp_path / "transfer.csv") == table
    bundle = load_bundle(hovering)
    bundle.contract["output"]["control"], bundle.contract["action_delay"] = "rotor_thrusts", 0
    assert mistakes(bundle) == ["xyzw", "heading", "motors", "frd_gyro"]


def test_the_recipe_films_a_flight_beside_ours(hovering, tmp_path, launch, monkeypatch):
    from torchrl_quad.training import drawing

    films = []
    monkeypatch.setattr(drawing, "animate_flight", lambda *args, **options: films.append((args, options)))
    changed = ["scale={mass: 1.1}", "late=1"]
    settings = [f"bundle={hovering}", f"folder={tmp_path}", "episodes=1", "loop=contract", "pictures=true"]
    assert '{"late": 1, "mass": 1.1}' in launch("transfer", *settings, *changed)
    (((ours, _), options),) = films
    assert options["labels"][1].startswith("MuJoCo") and options["beside"].shape == ours.shape == (1, STEPS)
    apart = (options["beside"]["state", "position"] - ours["state", "position"]).abs().amax((0, -1))
    assert apart[0] < 0.01 < apart.max()  # the other drone, from the same start
    assert "from the same starts: MuJoCo" in (tmp_path / "transfer_mujoco.html").read_text()


def test_a_mistake_of_ours_keeps_its_traceback(hovering, tmp_path, monkeypatch, launch):
    def mistake(*_):
        raise ValueError("of ours")

    monkeypatch.setattr("torchrl_quad.deploy.transfer.machine", mistake)
    refuses("^of ours$", launch, "transfer", f"bundle={hovering}", f"folder={tmp_path}")


WRONG_SETTINGS = {
    "episodes=all": "episodes must be a whole number, at least 1, got 'all'",
    "episodes=0": "episodes must be a whole number, at least 1",
    "late=-1": "late must be a whole number, at least 0, got '-1'",
    "mutants=maybe": "mutants must be true or false, got 'maybe'",
    "scale=[": r"scale must look like {mass: 1.2, inertia: 1.5}, got '\['",
    "scale={mass: [1]}": "scale must look like",
    "scale={mass: 1e999}": "turned: scale: mass must be a number from 0 to 1000, got inf",
    "scale={mass: nan}": "scale: mass must be a number from 0 to 1000, got nan",
    "scale={mass: 0}": "turned: scale: plant.mass: 0.0 is less than the minimum of 0.001. Choose other factors",
    "scale={rate_gain: 2}": "turned: scale: the drone has no 'rate_gain' to scale. Choose from: mass, ",
    "late=1 ; late=2": "late is given twice",
    "scale={inertia: 1.0, rotor_positions: 0}": "turned: scale: plant.rotor_positions .* cannot control roll and pitch",
    "simulator=torchrl_quad ; loop=pid": "turned: torchrl_quad has no rate loop 'pid'. Choose from: contract",
    "simulator=torchrl_quad ; mutants=true ; scale={inertia: 3}": "turned: torchrl_quad flies motors as they are",
    "hello": "unknown setting 'hello'. Choose from: bundle=...",
    "bundel=x": "unknown setting 'bundel=x'. Choose from: bundle=...",
    "simulator=gazebo": "Unknown simulator 'gazebo'. Choose from: torchrl_quad, mujoco",
    "loop=own": "turned: mujoco has no rate loop 'own'. Choose from: contract, pid, pd.",
}


def test_the_recipe_says_in_one_line_what_is_wrong(hovering, refused, monkeypatch, tmp_path):
    bundle = f"bundle={hovering}"
    assert "bundle is missing: write bundle=FOLDER" in refused("transfer")
    assert "No bundle at nowhere" in refused("transfer", "bundle=nowhere")
    assert "/dev/null is a device, and no folder" in refused("transfer", bundle, "folder=/dev/null")
    for wrong, said in WRONG_SETTINGS.items():
        line = refused("transfer", bundle, f"folder={tmp_path}", *wrong.split(" ; "))
        assert re.fullmatch(f"Error: .*{said}.*", line), line
    table = tmp_path / "transfer.csv"
    for content in (b"a,b\n1,2\n", b"bundle\n\xff\n", b'a\n"' + b"x" * 200_000):
        table.write_bytes(content)
        assert "transfer.csv is no table of flights" in refused("transfer", bundle, f"folder={tmp_path}")
        assert table.read_bytes() == content
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "torchrl_quad.deploy.simulators.mujoco", raising=False)
    assert "Flying in mujoco needs mujoco: pip install mujoco" in refused("transfer", bundle)
