"""Loading drones: presets, files, mappings, and what is wrong with a bad one."""

import functools
import itertools
import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from refusals import cases, refuses

from torchrl_quad import GeometricController, HoveringEnv, QuadrotorParams, available_drones, load_drone, suggest_gains
from torchrl_quad.dynamics import FlightController, import_drone, presets
from torchrl_quad.dynamics.gains import rate_loop
from torchrl_quad.errors import DroneWarning, UserValueError, shown

VISFLY = {name: value.squeeze().tolist() for name, value in load_drone("visfly").fields().items()}


@pytest.mark.parametrize("name", available_drones())
def test_every_preset_can_hover_and_reach_its_commanded_thrust_with_a_rate_loop_as_damped_as_it_says(name):
    params, text = load_drone(name), (Path(presets.__file__).parent / f"drones/{name}.yaml").read_text()
    controller = FlightController(params)  # which refuses a drone that cannot hover
    thrust = len(params.rotor_spin) * controller.thrust_max
    assert (thrust >= params.max_thrust_to_weight * params.mass * params.gravity).all() and "# Source: " in text
    loop = rate_loop(params, 0.005)
    assert loop.is_stable.all() and (loop.damping_ratio >= (0.8 if "suggest_gains" in text else 0.54)).all()


def test_a_geometric_controller_hovers_every_preset():
    drones = {name: load_drone(name) for name in available_drones()}
    for rotors in {len(drone.rotor_spin) for drone in drones.values()}:
        some = [drone.replace(motor_time_constant=drone.motor_time_constant.expand(2)) for drone in drones.values()]
        some = [drone.fields() for drone in some if len(drone.rotor_spin) == rotors]
        params = QuadrotorParams(**{name: torch.stack([fields[name] for fields in some]) for name in some[0]})
        env = HoveringEnv(num_envs=len(some), drone=params, seed=0)
        policy = GeometricController(env, position_gain=4.0, velocity_gain=3.0)
        with torch.no_grad():
            flight = env.rollout(200, policy, break_when_any_done=False)
        assert flight["next", "success"][:, -50:].all()


def test_a_drone_comes_from_a_file_or_a_mapping_as_well(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({**VISFLY, "mass": 0.5}).replace("mass: 0.5", "mass: 5e-1"))
    for source in (path, str(path), {**VISFLY, "mass": 0.5}):
        assert load_drone(source).mass.item() == 0.5


@cases(
    ({"mass": None}, r"mine.yaml: missing field 'mass'. Required: mass, inertia"),
    ({"colour": 3.0}, r"mine.yaml: unknown field 'colour'. Allowed: mass, inertia"),
    ({"mass": -1.0}, r"mine.yaml: field 'mass' must be between 0.001 and 1000, in SI units; got \[-1.0\]"),
    ({"inertia": [1e-3, float("inf"), 1e-3]}, r"mine.yaml: field 'inertia' must be between 1e-08 and 1000"),
    ({"inertia": [1e-3, 1e-3]}, r"mine.yaml: field 'inertia' has shape \(2,\); it must be \(3,\)"),
    ({"linear_drag": [0.0, -0.1, 0.0]}, r"mine.yaml: field 'linear_drag' must be between 0 and 100"),
    ({"rotor_spin": [1, 1, 0, -1]}, r"mine.yaml: field 'rotor_spin' must be \+1 or -1"),
    ({"inertia": [1e-3, 1e-3, 2.1e-3]}, r"inertia \[0.001, 0.001, 0.0021\] kg m2: in a body none .* exceeds the sum"),
    (
        {"inertia": [0.02, 0.02, 0.03]},
        r"it is that of a ring of 0.255 m radius, and the farthest rotor is 0.075 m from",
    ),
    (
        {"thrust_map": [-1e-6, 5e-3, 0.0]},
        r"must rise .* is \[0.0046\] at rotor_speed_min and \[-0.002\] at rotor_speed_max",
    ),
    ({"thrust_map": [0.0, 1e-3, 0.0]}, r"thrust_map must bend, .* k2 is \[0.0\]. Write 3.1e-10, which"),
    ({"mass": "1:59:59"}, r"mine.yaml: field 'mass' is not a number or a list of numbers: '1:59:59'"),
    ({"thrust_map": [4e-7, -5e-3, 0.0]}, r"thrust_map must rise with rotor speed"),
    ({"rotor_speed_min": 4000.0}, r"rotor_speed_min must be below rotor_speed_max, got \[4000.0\] and \[3500.0\]"),
)
def test_a_bad_file_is_refused_with_its_field_and_what_is_allowed(change, message, tmp_path):
    path = tmp_path / "mine.yaml"
    values = {name: value for name, value in {**VISFLY, **change}.items() if value is not None}
    path.write_text(yaml.safe_dump(values))
    refuses(message, load_drone, path)


def test_what_is_no_drone_is_refused_by_name(tmp_path):
    assert available_drones() == sorted(path.stem for path in Path(presets.__file__).parent.glob("drones/*.yaml"))
    (tmp_path / "list.yaml").write_text("- 1\n- 2\n")
    (tmp_path / "bad.yaml").write_text("mass: [1")
    drone = load_drone()
    for make, message in (
        (lambda: load_drone("visflu"), f"Unknown drone 'visflu'. Choose from: {', '.join(available_drones())}"),
        (lambda: load_drone(tmp_path / "list.yaml"), "expected a mapping of names to values, got list"),
        (lambda: load_drone(tmp_path / "bad.yaml"), "bad.yaml: not a YAML file"),
        (
            lambda: FlightController(drone.replace(rotor_spin=[1.0] * 4)),
            "its 4 rotors cannot control yaw independently",
        ),
        (lambda: drone.replace(weight=1.0), "QuadrotorParams has no field 'weight'. Choose from: mass,"),
        (lambda: drone.replace(mass=torch.ones(5)), r"field 'mass' has shape \(5,\); it must be \(1,\) for one drone"),
        (lambda: load_drone("visfly", torch.int64), "dtype must be torch.float32 or torch.float64"),
    ):
        refuses(message, make)
    with pytest.raises(FileNotFoundError, match="No drone file at .*none.yaml. Choose from: cf2p"):
        load_drone(tmp_path / "none.yaml")


def test_gradients_flow_through_replace_to_and_construction_and_a_drone_in_float64_may_lie_at_a_limit():
    mass = torch.full((5, 1), 0.5, requires_grad=True)
    params = load_drone().replace(mass=mass).to(dtype=torch.float64)
    QuadrotorParams(**params.fields()).mass.sum().backward()
    assert (mass.grad == 1.0).all() and params.mass.shape == (5, 1)
    assert not params.detach().mass.requires_grad
    drone = {
        **VISFLY,
        "mass": 0.027,
        "inertia": [1e-8] * 3,
        "yaw_torque_coefficient": 1e-5,
        "rate_gain": [20.0] * 3,
        "rate_damping": [0.0] * 3,
    }
    env = HoveringEnv(num_envs=1, drone=drone, dtype=torch.float64)
    assert (env.params.mass.item(), env.params.inertia[..., 0].item()) == (0.027, 1e-8)
    rounded = load_drone(drone, torch.float32)  # whose 1e-8 is a little less
    assert rounded.to(dtype=torch.float64).inertia[0] < 1e-8


# Gazebo's iris with gains of PX4, and motors so quick that the loop is unstable in these steps.
IRIS = {**VISFLY, "mass": 1.535, "inertia": [0.029125, 0.029125, 0.055225], "thrust_map": [5.84e-6, 0.0, 0.0]}
IRIS |= {"rotor_positions": [[0.13, 0.22], [-0.13, 0.20], [-0.13, -0.20], [0.13, -0.22]], "rotor_speed_max": 1100.0}
IRIS |= {"motor_time_constant": [0.0125, 0.025], "yaw_torque_coefficient": 0.06, "max_thrust_to_weight": 1.8}
IRIS |= {"rate_gain": [146.08, 146.08, 8.18], "rate_damping": [0.029125] * 3, "max_body_rate": [3.84, 3.84, 3.49]}
QUICK = {**VISFLY, "motor_time_constant": 0.005, "rate_damping": VISFLY["inertia"], "max_body_rate": [0.2] * 3}


@cases(
    (IRIS, r"about roll and pitch overshoots by 25% \(in continuous time by 7%\) and asks at full rate .* torque"),
    (
        {**IRIS, "rate_gain": [75.0] * 3, "max_body_rate": [8.0, 8.0, 0.1]},
        r"about roll and pitch asks .* 10.2 times the torque",
    ),
    ({**QUICK, "rate_gain": [365.0, 365.0, 50.0]}, r"about roll and pitch overshoots by 100%"),
    ({**QUICK, "rate_gain": [20.0, 20.0, 730.0]}, r"about yaw is unstable, .* Write rate_gain: \[20.0, 20.0, "),
    ({**QUICK, "rate_damping": [0.03] * 3}, r"about roll and pitch and yaw is unstable"),
)
def test_gains_that_the_physics_steps_do_not_bear_are_refused_and_each_advice_flies(drone, message):
    advice = refuses(message, HoveringEnv, num_envs=1, drone=drone).split("Write ")[1]
    gain, damping = (json.loads(numbers) for numbers in re.findall(r"\[.*?\]", advice))
    choices = [{"drone": {**drone, "rate_gain": gain, "rate_damping": damping}}]
    if "torque" not in message:  # of which rotors have no more in shorter steps
        choices.append({"drone": drone, "dt": float(re.search(r"dt=(.*)\.", advice)[1])})
    for options in choices:
        env = HoveringEnv(num_envs=1, **options)
        stick = functools.partial(fly_stick, env.hover_action + torch.tensor([0.0, 0.02, 0.02, 0.02]))
        rates = env.rollout(15, stick, break_when_any_done=False)["next", "state", "angular_velocity"][0]
        rates = rates / (0.02 * env.nominal.max_body_rate)
        assert rates.max() < 1.35 and rates[-1].min() > 0.3


def fly_stick(action, td):
    return td.set("action", action.expand(1, 4))


@pytest.mark.parametrize("dt", [1e-3, 5e-3, 2e-2])
def test_suggested_gains_are_well_damped_and_ask_no_more_of_the_rotors_than_they_have(dt):
    several = load_drone().replace(mass=torch.tensor([[0.4], [0.5]]))
    for drone in (*map(load_drone, available_drones()), several, load_drone(IRIS)):
        params = drone.replace(**suggest_gains(drone, dt))
        assert (rate_loop(params, dt).damping_ratio >= 0.799).all() and (params.rate_gain > 2).all()
        asked = params.inertia * params.rate_gain * params.max_body_rate
        assert (asked <= 1.001 * FlightController(params).spare_torque()).all()
    bare = {name: value for name, value in IRIS.items() if not name.startswith("rate_")}
    assert torch.allclose(suggest_gains(bare, dt)["rate_gain"].float(), params.rate_gain)


def test_a_command_beyond_the_reach_of_the_rotors_is_warned_of_and_the_advice_flies_without():
    with pytest.warns(
        DroneWarning, match="commands max_thrust_to_weight=6, and the rotors reach 4.446 times"
    ) as warned:
        HoveringEnv(num_envs=1, drone={**VISFLY, "max_thrust_to_weight": 6.0})
    most = float(str(warned[0].message).rpartition(" ")[2].removesuffix("."))
    HoveringEnv(num_envs=1, drone={**VISFLY, "max_thrust_to_weight": most})


def test_drones_drawn_have_bodies_and_none_has_an_unstable_rate_loop():
    env = HoveringEnv(num_envs=200, randomize={"inertia": {"scale": [0.7, 1.3]}})
    inertia = env.reset()["state", "drone", "inertia"]
    assert (2 * inertia.amax(-1) <= inertia.sum(-1) * (1 + 1e-6)).all() and inertia[:, 2].std() > 1e-4
    unstable = {"inertia": {"scale": [0.1, 1.0]}}
    refuses("randomize: a drone: in steps of dt=0.005 s .* unstable", HoveringEnv, num_envs=1, randomize=unstable)
    HoveringEnv(num_envs=1, randomize=unstable, dt=0.001)
    refuses("unstable with an inertia of", env.set_params, env.params.replace(inertia=env.params.inertia * 0.1))


def test_a_drone_shows_itself_as_a_table_with_units():
    drone = load_drone("crazyflie")
    first, *lines = str(drone.replace(mass=torch.tensor([[0.02], [0.03]], requires_grad=True))).splitlines()
    assert first == "QuadrotorParams" and len(lines) == len(drone.fields()) + 1
    shown = dict(re.split(" {2,}", line.strip(), maxsplit=1) for line in lines)
    assert shown["mass [kg]"] == "0.02 to 0.03 over 2 drones"
    assert shown["inertia [kg m2]"] == "3.7e-05, 3.2e-05, 5.3e-05"
    assert shown["rotor_positions [m]"].startswith("(0.028072, 0.028072), (-0.028072, ")
    assert "speed_per_volt=519.0" in shown["motor_command"]


NO_NUMBERS = [True, np.True_, [True, 1.0, 1.0], "1", b"1", "", [], [[1.0], [1.0, 2.0]], 10**400, 10**6000, float("nan")]
NO_NUMBERS += [functools.reduce(lambda inner, _: [inner], range(5000), 1.0), {}, object(), 1j, np.array(["1"])]
NO_NUMBERS += [torch.tensor(True), torch.tensor(1j), torch.zeros(0)]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: shown(value)[:20])
def test_what_is_no_number_is_refused_in_every_field_however_a_drone_is_made(value):
    params = load_drone("visfly")
    ways = (
        lambda change: load_drone({**VISFLY, **change}),
        lambda change: params.replace(**change),
        lambda change: QuadrotorParams(**{**params.fields(), **change}),
    )
    for name, make in itertools.product(VISFLY, ways):
        with pytest.raises(UserValueError, match=f"field '{name}' (is not a number|must be|has shape)") as refused:
            make({name: value})
        assert "\n" not in str(refused.value)
    motors = {"speed_per_volt": 500.0, "nominal_voltage": 3.7, "speed_at_zero": 0.0, "delay": 0.0}
    for name in motors:
        refuses(name, load_drone, {**VISFLY, "motor_command": {**motors, name: value}}, error=UserValueError)


# -- files of other projects -------------------------------------------------------------------------------------------

MOTOR = {"timeConstantUp": 0.0125, "timeConstantDown": 0.025, "maxRotVelocity": 1000, "momentConstant": 0.02}
MOTOR |= {"motorConstant": 1e-5, "rotorDragCoefficient": 1e-4}
CORNERS = ((0.2, -0.1), (-0.2, 0.1), (0.2, 0.1), (-0.2, -0.1))
J = "<inertia><ixx>0.01</ixx><iyy>0.02</iyy><izz>0.025</izz></inertia>"


def sdf(content):
    return f"<sdf version='1.9'><model name='x'>{content}</model></sdf>"


def motors(**changes):
    """Of an SDF: of four rotors, the first of which may differ."""
    turns = ({"turningDirection": x} for x in ("ccw", "ccw", "cw", "cw"))
    said = [MOTOR | {"linkName": f"rotor_{i}", "motorNumber": i} | x for i, x in enumerate(turns)]
    said[0] |= changes
    return "".join(f"<plugin>{''.join(f'<{k}>{v}</{k}>' for k, v in x.items())}</plugin>" for x in said)


FRAME = f"<link name='base_link'><inertial><mass>1</mass>{J}</inertial></link>" + "".join(
    f"<joint name='j{i}'><pose relative_to='base_link'>{x} {y} 0.1 0 0 0</pose></joint><link name='rotor_{i}'>"
    f"<pose relative_to='j{i}'/><inertial><mass>0.25</mass></inertial></link>"
    for i, (x, y) in enumerate(CORNERS)
)
URDF = (
    "<robot name='{}'><properties kf='1e-9' km='2e-11' thrust2weight='2' drag_coeff_xy='1e-6'/><link name='base_link'>"
    "<inertial><mass value='0.4'/><inertia ixx='1e-3' ixy='{}' iyy='1e-3' izz='1.5e-3'/></inertial></link>"
    + "".join(
        f"<link name='prop{i}_link'><inertial><origin xyz='{CORNERS[k][0]} {CORNERS[k][1]} 0'/></inertial></link>"
        for i, k in enumerate((0, 3, 1, 2))
    )
    + "</robot>"
)
L2F = {"mass": 1.0, "gravity": [0, 0, 9.8], "J": np.diag([0.01, 0.01, 0.015]).tolist(), "action_limit": [0, 1]}
L2F |= {"rotor_positions": [[x, -y, 0] for x, y in CORNERS], "rotor_thrust_directions": [[0, 0, -1]] * 4}  # z is down
L2F |= {"rotor_torque_directions": [[0, 0, x] for x in (1, 1, -1, -1)], "rotor_torque_constants": [0.02] * 4}
L2F |= {"rotor_thrust_coefficients": [[0.1, 0.5, 5.0]] * 4, "rotor_time_constants_rising": [0.03] * 4}
L2F |= {"rotor_time_constants_falling": [0.06] * 4}
HEXAGON = [[0.2 * np.cos(x), 0.2 * np.sin(x), 0.0] for x in np.arange(6) * np.pi / 3]
ROTORPY = {
    "mass": 1.0,
    "Ixx": 0.01,
    "Iyy": 0.01,
    "Izz": 0.015,
    "rotor_pos": {f"r{i}": x for i, x in enumerate(HEXAGON)},
}
ROTORPY |= {"rotor_directions": [1, -1] * 3, "k_eta": 1e-5, "k_m": 2e-7, "k_d": 1e-4, "k_z": 2e-4, "tau_m": 0.02}
ROTORPY |= {"rotor_speed_min": 0, "rotor_speed_max": 900, "c_Dx": 0.01, "c_Dy": 0.01, "c_Dz": 0.02}
MODELS = {"mass": 0.03, "L": 0.03, "J": np.diag([1e-5, 1e-5, 1.9e-5]).tolist(), "thrust_tau": 0.05, "thrust_max": 0.12}
MODELS |= {"rpm2thrust": [0, 0, 4e-10], "rpm2torque": [0, 0, 8e-12]}
MODELS |= {"mixing_matrix": [[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]}
TOML = "\n".join(f"[{x}]\n" + "\n".join(f"{k} = {v}" for k, v in MODELS.items()) for x in "ab")
AGILICIOUS = {"mass": 0.75, "tbm_fr": [0.2, -0.1, 0], "tbm_bl": [-0.2, 0.1, 0], "tbm_br": [-0.2, -0.1, 0]}
AGILICIOUS |= {"tbm_fl": [0.2, 0.1, 0], "inertia": [0.0025, 0.0021, 0.0043], "motor_omega_min": 150, "motor_tau": 0.033}
AGILICIOUS |= {"motor_omega_max": 2000, "kappa": 0.022, "thrust_max": 8, "aero_coeff_1": [0.1, 0.1, 0.2]}
AGILICIOUS |= {"omega_max": [10, 10, 4]}
FLIGHTMARE = "quadrotor_dynamics: {mass: 0.73, arm_l: 0.17, thrust_map: [1.3e-6, 0, 0], kappa: 0.016, motor_tau: 0.03}"
HOVER, FAST = np.sqrt(9.81 * 2 / 4 / 1e-5), 2 * np.pi / 60  # of a rotor of the SDF [rad/s]; of one rpm


@cases(
    ("x.sdf", sdf(FRAME + motors()), {}, {"mass": 2.0, "inertia": [0.025, 0.065, 0.075],
     "rotor_positions": CORNERS, "rotor_spin": [-1, -1, 1, 1], "motor_time_constant": [0.0125, 0.025],
     "thrust_map": [1e-5, 0, 0], "linear_drag": [4e-4 * HOVER, 4e-4 * HOVER, 0]}),
    ("x.urdf", URDF.format("racer", 0), {"motor_time_constant": 0.05}, {
     "rotor_positions": [CORNERS[i] for i in (0, 3, 1, 2)],
     "rotor_spin": [1, -1, 1, -1], "thrust_map": [1e-9 / FAST**2, 0, 0], "yaw_torque_coefficient": 0.02,
     "rotor_speed_max": np.sqrt(2 * 0.4 * 9.81 / 4e-9) * FAST, "motor_time_constant": 0.05}),
    ("x.json", json.dumps({"dynamics": L2F}), {"linear_drag": [0.1] * 3}, {"rotor_positions": CORNERS, "gravity": 9.8,
     "rotor_spin": [-1, -1, 1, 1], "thrust_map": [5e-6, 5e-4, 0.1], "motor_time_constant": [0.03, 0.06]}),
    ("x.json", json.dumps(ROTORPY), {}, {"rotor_positions": np.array(HEXAGON)[:, :2], "rotor_spin": [1, -1] * 3,
     "yaw_torque_coefficient": 0.02, "quadratic_drag": [0.01, 0.01, 0.02],
     "linear_drag": 6 * np.sqrt(9.81 / 6e-5) * np.array([1e-4, 1e-4, 2e-4])}),
    ("x.toml", TOML, {"entry": "b", "linear_drag": [0.01] * 3}, {"rotor_spin": [-1, 1, -1, 1], "mass": 0.03,
     "rotor_positions": 0.03 * np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]),
      "yaw_torque_coefficient": 0.02, "rotor_speed_max": np.sqrt(0.12 / 4e-10) * FAST}),
    ("x.yaml", json.dumps(AGILICIOUS), {}, {"rotor_positions": [CORNERS[i] for i in (0, 1, 3, 2)],
     "rotor_spin": [-1, -1, 1, 1], "thrust_map": [2e-6, 0, 0], "max_body_rate": [10, 10, 4],
     "linear_drag": [0.1, 0.1, 0.2]}),
    ("x.yaml", FLIGHTMARE, {"linear_drag": [0.1] * 3, "rotor_speed_max": 3000}, {"rotor_spin": [1, -1, 1, -1],
     "inertia": [0.00791138, 0.00791138, 0.01230658]}),
)  # fmt: skip
def test_drones_of_other_projects_become_ours_and_their_yaml_says_what_is_not_theirs(
    file, text, given, wanted, tmp_path
):
    path = tmp_path / file
    path.write_text(text)
    drone = load_drone(path, torch.float64, **given)
    for name, value in wanted.items():
        np.testing.assert_allclose(getattr(drone, name).squeeze(), np.asarray(value, float), rtol=1e-5, err_msg=name)
    written = tmp_path / "ours.yaml"
    written.write_text(import_drone(path, **given))
    for name, value in load_drone(written, torch.float64).fields().items():
        torch.testing.assert_close(value, getattr(drone, name), rtol=1e-6, atol=1e-12)
    assert written.read_text().startswith(f"# Source: {file}") and "chosen here: suggest_gains" in written.read_text()
    assert all(
        f"{x}: " in written.read_text() and "given, not in the file" in written.read_text()
        for x in given
        if x != "entry"
    )
    assert HoveringEnv(num_envs=1, drone=str(written)).nominal.mass.item() == pytest.approx(drone.mass.item())


@cases(
    (
        "x.sdf",
        sdf(FRAME),
        r"does not say rotor_spin \[1\], yaw_torque_coefficient \[m\], thrust_map .*, motor_time_constant",
    ),
    (
        "x.urdf",
        URDF.format("cf", 0),
        r"\(URDF.*\) does not say motor_time_constant \[s\]. Give .*motor_time_constant=0.03\)",
    ),
    ("x.urdf", URDF.format("cf", 4e-4), r"inertia \[kg m2\]: its products of inertia are not small, 0.0004 kg m2"),
    ("x.sdf", sdf(FRAME + motors(motorConstant=2e-5)), "rotors differ in motorConstant"),
    ("x.sdf", sdf(FRAME.replace(J, "") + motors()), "inertia .*: the link 'base_link' has a mass and no <inertia>"),
    ("x.sdf", sdf(FRAME + motors() + "<plugin filename='gz-sim-lift-drag'/>"), r"it has wings \(LiftDrag\)"),
    ("x.sdf", sdf("<include><placement_frame>a</placement_frame></include>"), "a placement_frame is not read"),
    (
        "x.sdf",
        sdf(FRAME.replace("'j0'/>", "'j9'/>")),
        "a pose is relative to 'j9', which is no link",
    ),
    (
        "x.sdf",
        sdf(FRAME.replace("0.1 0 0 0<", "0.1 3.141592654 0 0<") + motors()),
        r"x.sdf: to hover, .*let rotor_direction point up",
    ),
    ("x.urdf", URDF.format("cf", 0).replace("'prop", "'w"), "rotor_positions .* no link with an <inertial> is named"),
    (
        "x.json",
        json.dumps({**ROTORPY, "mass": None}),
        "mass .*, linear_drag .*: it follows from the drag of the rotors",
    ),
    ("x.sdf", sdf("<include><uri>model://other</uri></include>"), "includes the model 'model://other': put it at "),
    ("x.urdf", "<!DOCTYPE x [<!ENTITY a 'b'>]><robot>&a;</robot>", "declares entities or a type"),
    ("x.sdf", sdf(FRAME.replace("0.02<", "much<")), "expected 1 number, got 'much'"),
    ("x.xml", "<mujoco/>", "XML with the root <mujoco> is no URDF or SDF .* These can be read: URDF"),
    ("x.json", "[1]", "this file is of no kind that is known. These can be read"),
    (
        "x.json",
        json.dumps({"dynamics": {**L2F, "rotor_positions": [1, 2]}}),
        r"'rotor_positions' has shape \(2,\); it must be",
    ),
    ("x.toml", TOML, r"choose one drone of the file, by entry='a' or another of"),
    ("x.xacro", "", "a .xacro file has to be run before its numbers can be read. Expand it first"),
    ("x.toml", "[cf2x]\nacc_coef = 1", "this file is of no kind that is known. These can be read"),
    ("x.stl", "", "no drone can be read from a .stl file. These can be read"),
    ("x.yaml", "mass: 1", "is no file of another project"),
)
def test_what_cannot_become_a_drone_is_refused_with_all_that_is_missing(file, text, message, tmp_path):
    (tmp_path / file).write_text(text)
    refuses(message, import_drone, tmp_path / file)


def test_parts_of_a_model_stand_where_its_simulator_puts_them(tmp_path):
    """A payload 0.2 m below the body, which is written in several ways; frames of masses turn no rotor."""
    given = {"yaw_torque_coefficient": 0.02}
    load = "<link name='load'><pose relative_to='{}'>0 0 {} 0 0 0</pose><inertial><mass>1</mass>" + J
    load += "</inertial></link>"
    turned = FRAME.replace("<inertial><mass>0.25<", "<inertial><pose>0 0 0 0 0.2 0</pose><mass>0.25<")
    (tmp_path / "frame").mkdir()
    (tmp_path / "frame/model.sdf").write_text(sdf("<pose>0 0 0.24 0 0 0</pose>" + FRAME))
    include = "<include{}><uri>{}</uri>{}</include>"
    ways = (
        FRAME + load.format("base_link", -0.2),
        turned + load.format("__model__", -0.2),
        include.format(" merge='true'", "model://frame/", "") + load.format("base_link", -0.2),
        include.format("", "https://host/1.0/owner/models/frame/3", "<name>v</name>") + load.format("v", 0.04 - 0.24),
        include.format("", "file://frame/model.sdf", "<pose>0 0 1 0 0 0</pose>") + load.format("x::base_link", -0.2),
        f"<model name='m'><pose>0 0 3 0 0 0</pose>{FRAME}</model>" + load.format("m::base_link", -0.2),
        FRAME + "<plugin filename='gz-sim-lift-drag'><link_name>x::rotor_0</link_name></plugin>"
        "<frame name='f' attached_to='base_link'><pose degrees='true'>0.2 0.5 0 0 0 90</pose></frame>"
        + load.format("f", -0.2).replace("0 0 -0.2 0 0 0", "-0.5 0.2 -0.2 0 0 -1.5707963"),
        f"<model name='m'><pose>1 0 3 0 0 3.14159265</pose>{FRAME}</model><frame name='g' attached_to='m::base_link'/>"
        + load.format("g", -0.2),
    )
    for i, way in enumerate(ways):
        (tmp_path / f"{i}").mkdir()
        (tmp_path / f"{i}/MODEL.SDF").write_text(sdf(way + motors()))
        drone = load_drone(tmp_path / f"{i}/MODEL.SDF", torch.float64, **given)
        height = 2 * 1 / 3 * (0.2 + 0.05) ** 2  # of the other 2 kg, whose centre is 5 cm above the body
        np.testing.assert_allclose(drone.inertia, [0.035 + height, 0.085 + height, 0.1], atol=1e-6, err_msg=way)
        assert drone.rotor_direction is None


def test_rotors_are_found_by_their_names_and_axes_and_what_follows_from_a_given_mass_follows(tmp_path):
    flat = URDF.format("cf", 0).replace("'prop", "'motor")
    guards = "".join(f"<link name='prop_guard_{i}'><inertial/></link>" for i in range(4))
    turned = "".join(
        f"<joint name='j{i}' type='continuous'><parent link='base_link'/><child link='motor{i}_link'/>"
        f"<origin rpy='1.5707963 0 0'/><axis xyz='0 {-2 if i else 1} 0'/></joint>"
        for i in range(4)
    )
    guards += "<link name='rotor_0_guard'><inertial/></link>"
    guarded = flat.replace("base_link", "quad_rotor1_base").replace("</robot>", guards + "</robot>")
    (tmp_path / "x.urdf").write_text(guarded)
    wanted = load_drone(tmp_path / "x.urdf", torch.float64, motor_time_constant=0.05)
    assert "of motor0_link, motor1_link" in import_drone(tmp_path / "x.urdf", motor_time_constant=0.05)
    lying = flat.replace("<origin xyz='0.2 -0.1 0'", "<origin xyz='0.2 0 0.1'").replace("</robot>", turned + "</robot>")
    (tmp_path / "y.URDF").write_text(lying)
    upright = load_drone(tmp_path / "y.URDF", torch.float64, motor_time_constant=0.05)
    assert upright.rotor_direction is None
    heavy = load_drone(tmp_path / "x.urdf", torch.float64, motor_time_constant=0.05, mass=1.6)
    torch.testing.assert_close(heavy.linear_drag, 2.0 * wanted.linear_drag)  # rotors turn twice as fast to carry it
    torch.testing.assert_close(heavy.rotor_speed_max, 2.0 * wanted.rotor_speed_max)
    more = {"thrust_map": (4.0 * wanted.thrust_map).tolist(), "motor_time_constant": 0.05}
    strong = load_drone(tmp_path / "x.urdf", torch.float64, **more)
    torch.testing.assert_close(2.0 * strong.rotor_speed_max, wanted.rotor_speed_max)  # by the file's thrust2weight


def test_the_recipe_writes_a_drone_from_a_model_and_what_it_includes(tmp_path, monkeypatch, capsys):
    script = Path(__file__).parents[1] / "recipes/import_drone.py"
    (tmp_path / "frame.sdf").write_text(sdf(FRAME))
    (tmp_path / "x.sdf").write_text(sdf(f"<include><uri>model://frame</uri></include>{motors()}"))
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path / "x.sdf"), "mass=3", f"output={tmp_path}/o/x.yaml"])
    runpy.run_path(str(script), run_name="__main__")
    assert load_drone(tmp_path / "o/x.yaml").mass == 3.0 and f"env.drone={tmp_path}/o/x.yaml" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path / "frame.sdf")])
    with pytest.raises(SystemExit):
        runpy.run_path(str(script), run_name="__main__")
    advice = re.search(r"load_drone\(.*\)(?=, or)", capsys.readouterr().err)[0]
    assert HoveringEnv(num_envs=1, drone=eval(advice)).nominal.mass.item() == 2.0
