"""Any number and place of rotors, and rotors that fail."""

import math

import pytest
import torch
from refusals import cases, refuses

from torchrl_quad import HoveringEnv, load_drone
from torchrl_quad.controllers import GeometricController
from torchrl_quad.dynamics import FlightController, Quadrotor

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
LAYOUTS = {
    "plus": ring(4),
    "h": {
        "rotor_positions": [[0.12, 0.06], [-0.12, 0.06], [-0.12, -0.06], [0.12, -0.06]],
        "rotor_spin": [1, -1, 1, -1],
    },
    "asymmetric": {
        "rotor_positions": [[0.15, 0.08], [-0.06, 0.1], [-0.1, -0.07], [0.09, -0.12]],
        "rotor_spin": X["rotor_spin"],
    },
    "hexarotor": ring(6, math.pi / 6),
    "octorotor": ring(8),
    "coaxial": joined(X, ring(4, math.pi / 4, lift=-0.03)),
    "tilted hexarotor": ring(6, lean=0.4, lift=0.02),
}


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
        torch.testing.assert_close(
            turned["angular_velocity"], 0.4 * torch.eye(3, dtype=F64)[axis : axis + 1], atol=0.01, rtol=0.0
        )
    assert model.rest(torch.zeros(2, 3, dtype=F64))["rotor_speed"].shape == (2, n)


@pytest.mark.parametrize("name", ["hexarotor", "tilted hexarotor"])
def test_a_controller_of_position_holds_it_with_any_rotors_and_actions_and_states_follow_their_number(name):
    env = HoveringEnv(num_envs=2, drone=drone(name).to(dtype=torch.float32))
    flight = env.rollout(120, GeometricController(env))
    assert flight["next", "metrics", "position_error"][:, -1].max() < 0.01
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
    (
        {"rotor_positions": [[0.2 + x, y] for x, y in LAYOUTS["h"]["rotor_positions"]]},
        "have to carry .*x = y = 0, between",
    ),
    (
        {"rotor_spin": [1, -1, 1]},
        r"field 'rotor_spin' has shape \(3,\); it must be \(4,\) .* the 4 rotors of rotor_positions",
    ),
    ({"rotor_direction": [[0, 0, 0]] * 4}, "'rotor_direction' must be a direction for each rotor"),
    ({"rotor_effectiveness": [-1, 1, 1, 1]}, "'rotor_effectiveness' must be between 0 and 10"),
)
def test_a_layout_that_cannot_fly_is_refused_by_the_axis_that_it_cannot_control(change, message):
    refuses(message, lambda: FlightController(load_drone("visfly").replace(**change)))
