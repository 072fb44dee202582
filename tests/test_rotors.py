"""Any number and place of rotors, and rotors that fail."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from deploying import contract_of
from helpers import cases, fly, hold, refuses
from log_writers import END, TABLE, flight, ned, own_table, write_csv

import torchrl_quad
from torchrl_quad import GeometricController, HoveringEnv, load_drone
from torchrl_quad.deploy import contract, frames
from torchrl_quad.deploy.simulators import make_simulator, special
from torchrl_quad.dynamics import FlightController, Quadrotor
from torchrl_quad.envs import Disturbance
from torchrl_quad.identification import Columns, prediction_error, read_log
from torchrl_quad.identification.errors import WrongMotors
from torchrl_quad.identification.prediction import log_columns

F64 = torch.float64


def ring(n, turn=0.0, lean=0.0, lift=0.0):
    """Rotors on a circle, one after the other spinning the other way, and leaning forward and back along it."""
    angles = [2.0 * math.pi * i / n + turn for i in range(n)]
    signs = [(-1.0) ** i for i in range(n)]
    places = [[0.1 * math.cos(a), 0.1 * math.sin(a), lift] for a in angles]
    ups = [[-lean * s * math.sin(a), lean * s * math.cos(a), 1.0] for a, s in zip(angles, signs, strict=True)]
    return {"rotor_positions": places, "rotor_spin": signs, **({"rotor_direction": ups} if lean else {})}


def joined(a, b):
    return {name: [*a[name], *([-x for x in b[name]] if name == "rotor_spin" else b[name])] for name in a}


X = ring(4, math.pi / 4)
LAYOUTS = {"plus": ring(4), "hexarotor": ring(6, math.pi / 6), "octorotor": ring(8)}
LAYOUTS |= {"coaxial": joined(X, ring(4, math.pi / 4, lift=-0.03)), "tilted hexarotor": ring(6, lean=0.4, lift=0.02)}
LAYOUTS["h"] = X | {"rotor_positions": [[0.12, 0.06], [-0.12, 0.06], [-0.12, -0.06], [0.12, -0.06]]}
LAYOUTS["asymmetric"] = X | {"rotor_positions": [[0.15, 0.08], [-0.06, 0.1], [-0.1, -0.07], [0.09, -0.12]]}


def drone(name):
    return load_drone("visfly", F64).replace(**LAYOUTS[name])


@pytest.mark.parametrize("name", LAYOUTS)
def test_any_layout_hovers_turns_as_commanded_and_hovers_by_the_thrusts_of_its_rotors(name):
    params = drone(name)
    n, weight = len(params.rotor_spin), params.mass * params.gravity
    controller = FlightController(params)
    hover = controller.rotors.wrench(controller.hover_speed)
    wanted = torch.zeros_like(hover)
    wanted[0] = weight
    torch.testing.assert_close(hover, wanted)  # no torque, and of tilted rotors no force to a side
    for axis in range(3):  # free rotation, without a controller: more thrust of some rotors, and the body turns
        model = Quadrotor(params, 0.001, 10, "rk4", control="rotor_thrusts")
        state = model.rest(torch.zeros(1, 3, dtype=F64))
        push = 0.02 * controller.mixer[:, axis + 1] / controller.mixer[:, axis + 1].abs().max()
        turned = model.control_step(state, model.hover_action + push / controller.share / n, params, None)
        rates = turned["angular_velocity"][0]
        assert rates.argmax() == axis and rates[axis] > 0.0 and rates.abs().sum() < 1.05 * rates[axis]
        model = Quadrotor(params, 0.005, 100, "semi_implicit_euler")
        stick = torch.nn.functional.pad(0.2 * torch.eye(3, dtype=F64)[axis : axis + 1], (1, 0))
        turned = model.control_step(model.rest(torch.zeros(1, 3, dtype=F64)), model.hover_action + stick, params, None)
        torch.testing.assert_close(turned["angular_velocity"], 2.0 * stick[:, 1:], atol=0.01, rtol=0.0)
    assert model.rest(torch.zeros(2, 3, dtype=F64))["rotor_speed"].shape == (2, n)


@pytest.mark.parametrize("name", ["hexarotor", "tilted hexarotor"])
def test_a_controller_of_position_holds_it_with_any_rotors_and_actions_and_states_follow_their_number(name):
    env = HoveringEnv(num_envs=2, drone=drone(name).to(dtype=torch.float32))
    flight = env.rollout(100, GeometricController(env))
    assert flight["next", "metrics", "position_error"][:, -1].max() < 0.05
    assert env.reset()["state", "rotor_speed"].shape == (2, 6)
    env = HoveringEnv(num_envs=2, drone=drone(name), control="rotor_thrusts")
    assert env.action_spec.shape == (2, 6) == env.hover_action.expand(2, -1).shape
    assert list(env.action_units) == [f"rotor {i}" for i in range(1, 7)]


def test_four_of_more_than_four_thrusts_make_a_wrench_by_the_least_squares():
    controller = FlightController(drone("octorotor"))
    wrench = torch.tensor([4.0, 0.1, -0.2, 0.03], dtype=F64)
    thrust = controller.mixer @ wrench
    torch.testing.assert_close(controller.rotors.allocation @ thrust, wrench)
    nothing = torch.linalg.svd(controller.rotors.allocation)[2][4:]  # thrusts that make no wrench
    torch.testing.assert_close(nothing @ thrust, torch.zeros(4, dtype=F64))


@cases(
    (ring(3), "its 3 rotors cannot control roll, pitch and yaw independently"),
    ({"rotor_spin": [1, 1, 1, 1]}, "its 4 rotors cannot control yaw independently.* let some spin each way"),
    ({"rotor_spin": [1, 1, -1, -1]}, "its 4 rotors cannot control roll and yaw independently"),
    ({"rotor_positions": [[0.1 * i, 0.0] for i in (-3, -1, 1, 3)]}, "cannot control roll independently.* off one line"),
    ({"rotor_positions": [[0.2 + x, y] for x, y in LAYOUTS["h"]["rotor_positions"]]}, "have to carry .*x = y = 0"),
    ({"rotor_spin": [1, -1, 1]}, r"field 'rotor_spin' has shape \(3,\); it must be \(4,\) .* the 4 rotors"),
    ({"rotor_direction": [[0, 0, 0]] * 4}, "'rotor_direction' must be a direction for each rotor"),
    ({"rotor_effectiveness": [-1, 1, 1, 1]}, "'rotor_effectiveness' must be between 0 and 10"),
)
def test_a_layout_that_cannot_fly_is_refused_by_the_axis_that_it_cannot_control(change, message):
    refuses(message, lambda: FlightController(load_drone("visfly").replace(**change)))


class MotorFailure(Disturbance):
    """One rotor, drawn at the start, gives only a share of its thrust and torque after a time [s]."""

    def __init__(self, time=0.1, left=0.0):
        self.time, self.left = time, left

    def start(self, random, state):
        rotors = state["rotor_speed"].shape[-1]
        fails = torch.nn.functional.one_hot(random.integers(rotors, len(state["position"])), rotors)
        whole = {("drone", "rotor_effectiveness"): torch.ones_like(state["rotor_speed"])}
        return whole | {"fails": fails.to(state["position"])}

    def advance(self, state, noise, dt):
        late = state["step"] * dt > self.time - 1e-6
        whole = 1.0 - (1.0 - self.left) * state["fails"]
        return {("drone", "rotor_effectiveness"): torch.where(late, whole, state["drone", "rotor_effectiveness"])}


def test_a_rotor_that_fails_in_flight_takes_its_thrust_and_torque_with_it_and_the_controller_does_not_know():
    env = HoveringEnv(num_envs=8, dtype=F64, disturbances=MotorFailure(0.1), random_start={"yaw": 0.1})
    flight = fly(env, env.reset(), hold(env, 8))["next", "state"]
    works, fails = flight["drone", "rotor_effectiveness"], flight["fails"][:, 0]
    assert (works[:, :4] == 1.0).all() and torch.equal(works[:, 4:], 1.0 - flight["fails"][:, 4:])
    assert flight["angular_velocity"][:, :5].abs().max() < 1e-9 and (flight["rotor_speed"][:, 4] > 1600.0).all()
    # A step of 20 ms without it: the torque of the others turns the drone towards the dead rotor, r x F.
    arms = fails @ env.nominal.rotor_positions
    rates = flight["angular_velocity"][:, 5]
    assert (rates[:, 0] * arms[:, 1] < 0.0).all() and (rates[:, 1] * arms[:, 0] > 0.0).all()
    assert (rates[:, 2] * (fails @ env.nominal.rotor_spin) < 0.0).all()
    assert flight["velocity"][:, 5, 2].tolist() == pytest.approx([-9.81 * 0.25 * 0.02] * 8, rel=0.05)


def test_a_worn_drone_flies_worn_while_its_controller_believes_it_whole_and_other_drones_do_not_fit():
    worn = load_drone("visfly").replace(rotor_effectiveness=[0.5, 1.0, 1.0, 1.0])
    env = HoveringEnv(num_envs=1, drone=worn)
    assert env.nominal.rotor_effectiveness is None and env.params.rotor_effectiveness[0] == 0.5
    whole = HoveringEnv(num_envs=1)
    assert fly(env, env.reset(), hold(env, 3))["next", "state", "velocity"][0, -1, 2] < -0.05
    whole.params = worn
    one, other = (fly(x, x.set_seed(1) and x.reset(), hold(x, 3))["next", "state"] for x in (env, whole))
    torch.testing.assert_close(one, other)
    drawn = {"rotor_effectiveness": {"uniform": [0.7, 1.0]}}
    works = HoveringEnv(num_envs=500, randomize=drawn).reset()["state", "drone", "rotor_effectiveness"]
    assert works.shape == (500, 4) and 0.7 <= works.min() < 0.71 and works.std(0).min() > 0.07
    drawn = {"rotor_effectiveness": {"scale": [0.9, 1.0]}}
    works = HoveringEnv(num_envs=500, drone=worn, randomize=drawn).reset()["state", "drone", "rotor_effectiveness"]
    assert works[:, 0].max() <= 0.5 and works[:, 1].min() >= 0.9
    with pytest.raises(ValueError, match="this drone has 6 rotors, and the one that the controller believes in has 4"):
        whole.params = drone("hexarotor")


def test_a_drone_with_tilted_rotors_comes_from_a_yaml_file_as_it_was_written(tmp_path):
    written = fields(load_drone("visfly", F64)) | LAYOUTS["tilted hexarotor"]
    (tmp_path / "six.yaml").write_text(yaml.safe_dump(written))
    six = load_drone(tmp_path / "six.yaml", F64)
    assert torch.equal(six.rotor_direction, drone("tilted hexarotor").rotor_direction)
    assert six.rotor_positions.shape == (6, 3)
    assert six.replace(rotor_direction=None).rotor_direction is None


def fields(params):
    values = {name: value.tolist() for name, value in params.fields().items()}
    return {name: value[0] if len(value) == 1 else value for name, value in values.items()}


@pytest.mark.parametrize("name", ["hexarotor", "coaxial", "tilted hexarotor"])
def test_a_drone_of_a_contract_flies_in_mujoco_as_in_the_package_also_with_a_dead_rotor(name):
    pytest.importorskip("mujoco")
    plant = {"rotor_effectiveness": [0.0, *[1.0] * (len(LAYOUTS[name]["rotor_spin"]) - 1)]}
    flown = contract_of(fields(drone(name))) | {"plant": plant}
    start = {"position": np.zeros((1, 3)), "quaternion": np.eye(4)[:1], "velocity": np.zeros((1, 3))}
    start["angular_velocity"] = np.array([[0.5, -0.3, 0.2]])
    ends = []
    for kind in ("torchrl_quad", "mujoco"):
        world = make_simulator(kind, flown)
        world.reset(start)
        for _ in range(10):
            world.step(np.array([[5.0, 0.5, 1.0, -0.2]]))
        ends.append(world.state())
    assert abs(ends[0]["angular_velocity"]).max() > 0.3 and abs(ends[0]["velocity"][0, :2]).max() > 0.05
    for key, x in ends[0].items():
        np.testing.assert_allclose(x, ends[1][key], rtol=2e-3, atol=2e-4, err_msg=key)
    assert special(flown["drone"] | plant) >= {"more than four rotors", "rotors that are not whole"}
    assert ("tilted rotors" in special(flown["drone"])) == (name == "tilted hexarotor")


def test_a_contract_of_any_rotors_fits_its_schema_and_one_whose_rotors_do_not_agree_is_refused():
    tilted = fields(drone("tilted hexarotor"))
    assert contract.drone_problem({"drone": tilted, "plant": {"rotor_effectiveness": [0.0] * 6}}) is None
    assert contract.problem({"version": contract.VERSION}) == "it: 'task' is a required property"
    for plant, message in (
        ({"rotor_spin": [1, -1, 1, -1]}, "rotor_positions and the other fields of rotors must be equally long"),
        ({"rotor_direction": [[0, 0, 0]] * 6}, "rotor_direction has a rotor without a direction"),
        ({"rotor_spin": [1] * 6, "rotor_direction": [[0, 0, 1]] * 6}, "cannot control yaw independently"),
    ):
        assert message in contract.drone_problem({"drone": tilted, "plant": plant})


@pytest.mark.parametrize("order", [(2, 0, 3, 1), (1, 2, 3, 0)])
def test_the_motors_of_an_autopilot_and_of_a_log_belong_to_rotors_by_their_place_in_whatever_order(order):
    usual = load_drone("crazyflie", F64)
    other = usual.replace(rotor_positions=usual.rotor_positions[[*order]], rotor_spin=usual.rotor_spin[[*order]])
    thrust = np.array([1.0, 2.0, 3.0, 4.0])  # front left, back left, back right, front right
    theirs = frames.px4().to({"motors": thrust})["motors"]
    known = frames.px4().of(other.rotor_positions)
    assert known.to({"motors": thrust[[*order]]})["motors"].tolist() == theirs.tolist()
    assert known.back({"motors": theirs})["motors"].tolist() == thrust[[*order]].tolist()
    assert thrust[log_columns(other)].tolist() == thrust[[*order]].tolist() and log_columns(usual) == [0, 1, 2, 3]
    log = read_log(Path(torchrl_quad.__file__).parents[1] / "examples/data/figure8.csv.gz")
    errors = [prediction_error(log, x)["body_rate"][0.5] for x in (usual, other)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)
    for call in (lambda: frames.px4().of(LAYOUTS["plus"]["rotor_positions"]), lambda: log_columns(drone("hexarotor"))):
        refuses("of an X.* has rotors at ", call)


def test_a_plus_is_told_from_an_x_and_the_remedy_for_a_log_in_ned_keeps_the_order_of_its_quaternions(tmp_path):
    t = np.arange(0.0, END, 0.01)
    axes = np.array([[0.0, 1.5, 0.0, -1.5], [-1.5, 0.0, 1.5, 0.0], [1.0, -1.0, 1.0, -1.0]])
    true, on = flight(t), ((t > 0.7) & (t < 9.3))[:, None]
    spun = np.gradient(true["angular_velocity"], t, axis=0)
    thrust = np.square(true["motor_command"]).mean(1, keepdims=True) + 0.004 * np.clip(spun, -20.0, 20.0) @ axes
    path = write_csv(tmp_path / "plus.csv", own_table(t, motor_command=on * np.sqrt(np.clip(thrust, 0.01, 1.0))))
    refuses("as rotors in front, left, behind and right do", read_log, path, TABLE, error=WrongMotors)
    down = ned(flight(t))
    path = write_csv(tmp_path / "ned.csv", own_table(t, **down))
    mapping = TABLE | {"quaternion": [*TABLE["quaternion"][1:], TABLE["quaternion"][0]]}
    said = refuses("all of the log is in NED", read_log, path, mapping, convention=frames.crazyflie(), error=ValueError)
    told = re.search(r"rite (.*)\.$", said)[1]
    given = eval(f"dict({told})", {"Columns": Columns, "np": np, "frames": frames, "dataclasses": dataclasses})
    log = read_log(path, **{"columns": mapping, **given})
    k = slice(*log.segments[0])
    assert np.abs((log.quaternion * flight(log.time)["quaternion"]).sum(-1))[k].min() > 0.999
