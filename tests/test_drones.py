"""Loading drones: presets, files, mappings, and what is wrong with a bad one."""

import functools
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers import cases, refuses

from torchrl_quad import GeometricController, HoveringEnv, QuadrotorParams, available_drones, load_drone, suggest_gains
from torchrl_quad.dynamics import FlightController, presets
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
    ({"inertia": [0.02, 0.02, 0.03]}, r"it is that of a ring of 0.255 m radius, and the farthest rotor is 0.075 m"),
    ({"rotor_positions": [[5.3, 5.3], [-5.3, 5.3], [-5.3, -5.3], [5.3, -5.3]]},
        r"a ring of 0.0664 m radius, and the farthest rotor is 7.5 m from .*; mass is in kg, rotor_positions in m"),
    ({"thrust_map": [-1e-6, 5e-3, 0.0]}, r"must rise .* is \[0.0046\] at rotor_speed_min and \[-0.002\] at"),
    ({"thrust_map": [0.0, 1e-3, 0.0]}, r"thrust_map must bend, .* k2 is \[0.0\]. Write 3.1e-10, which"),
    ({"mass": "1:59:59"}, r"mine.yaml: field 'mass' is not a number or a list of numbers: '1:59:59'"),
    ({"thrust_map": [4e-7, -5e-3, 0.0]}, r"thrust_map must rise with rotor speed"),
    ({"rotor_speed_min": 4000.0}, r"rotor_speed_min must be below rotor_speed_max, got \[4000.0\] and \[3500.0\]"),
)  # fmt: skip
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
    drone = {**VISFLY, "mass": 0.027, "inertia": [1e-8] * 3, "rate_gain": [20.0] * 3, "rate_damping": [0.0] * 3}
    drone["rotor_positions"] = [[1e-3, 1e-3], [-1e-3, 1e-3], [-1e-3, -1e-3], [1e-3, -1e-3]]
    drone["yaw_torque_coefficient"] = 1e-5
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
    ({**IRIS, "rate_gain": [75.0] * 3, "max_body_rate": [8, 8, 0.1]}, r"roll and pitch asks .* 10.2 times the torque"),
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
    with pytest.warns(DroneWarning, match="commands max_thrust_to_weight=6, and the rotors reach 4.446") as warned:
        HoveringEnv(num_envs=1, drone={**VISFLY, "max_thrust_to_weight": 6.0})
    most = float(str(warned[0].message).rpartition(" ")[2].removesuffix("."))
    HoveringEnv(num_envs=1, drone={**VISFLY, "max_thrust_to_weight": most})


def test_drones_drawn_have_bodies_and_none_has_an_unstable_rate_loop():
    env = HoveringEnv(num_envs=200, randomize={"inertia": {"scale": [0.7, 1.3]}})
    inertia = env.reset()["state", "drone", "inertia"]
    assert (2 * inertia.amax(-1) <= inertia.sum(-1) * (1 + 1e-6)).all() and inertia[:, 2].std() > 1e-4
    unstable = {"inertia": {"scale": [0.1, 1.0]}}
    refuses("randomize: a drawn drone: in steps of dt=0.005 s .* unstable", HoveringEnv, num_envs=1, randomize=unstable)
    HoveringEnv(num_envs=1, randomize=unstable, dt=0.001)
    lighter = env.params.replace(inertia=env.params.inertia * 0.1)
    refuses(r"unstable with an inertia of [^m]* kg m2, since its gains are for [^a-z]*\.", env.set_params, lighter)
    stronger = {"thrust_map": {"scale": [1.0, 10.0]}, "rotor_positions": {"scale": [0.5, 2.0]}}
    refuses(r"rotors that give \[20.0, 20.0, 10.0\] times the torque", HoveringEnv, num_envs=1, randomize=stronger)


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
    ways = [lambda change: load_drone({**VISFLY, **change}), lambda change: params.replace(**change)]
    ways.append(lambda change: QuadrotorParams(**{**params.fields(), **change}))
    for name, make in itertools.product(VISFLY, ways):
        with pytest.raises(UserValueError, match=f"field '{name}' (is not a number|must be|has shape)") as refused:
            make({name: value})
        assert "\n" not in str(refused.value)
    motors = {"speed_per_volt": 500.0, "nominal_voltage": 3.7, "speed_at_zero": 0.0, "delay": 0.0}
    for name in motors:
        refuses(name, load_drone, {**VISFLY, "motor_command": {**motors, name: value}}, error=UserValueError)
