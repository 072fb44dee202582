"""Drag above the centre of mass, and rotors with two time constants, in float64."""

import math

import pytest
import torch

from torchrl_quad.dynamics import Quadrotor, RigidBodyState, accelerations, load_drone, quaternion
from torchrl_quad.dynamics.rotors import Rotors

F64 = torch.float64


def drone(**changes):
    return load_drone("visfly", dtype=F64).replace(**changes)


def test_rotors_with_two_time_constants_speed_up_at_one_pace_and_slow_down_at_the_other():
    rotors = Rotors(drone(motor_time_constant=[0.05, 0.2]))
    speed, target = torch.full((1, 4), 1000.0, dtype=F64), torch.tensor([[2000.0, 2000.0, 500.0, 500.0]], dtype=F64)
    up, down = 2000.0 - 1000.0 * math.exp(-0.1 / 0.05), 500.0 + 500.0 * math.exp(-0.1 / 0.2)
    torch.testing.assert_close(rotors.follow(speed, target, 0.1), torch.tensor([[up, up, down, down]], dtype=F64))


def test_drag_above_the_centre_of_mass_pitches_a_drone_that_flies_forward_up():
    params = drone(drag_height=0.03, linear_drag=[0.2, 0.2, 0.2], quadratic_drag=[0.0, 0.0, 0.0])
    still = torch.zeros(2, 3, dtype=F64)
    velocity = torch.tensor([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]], dtype=F64)
    state = RigidBodyState(still, quaternion.identity(still), velocity, still)
    _, angular = accelerations(state, torch.zeros(2, 4, dtype=F64), params)
    moment = 0.03 * 0.2 * 2.0  # about y where it flies along x (nose up), about x where it flies along y
    about = torch.tensor([[0.0, -moment, 0.0], [moment, 0.0, 0.0]], dtype=F64)
    torch.testing.assert_close(angular, about / params.inertia)


@pytest.mark.parametrize("own", [False, True])
def test_components_fly_as_tensors_do_with_two_time_constants_and_drag_above_the_centre_of_mass(own):
    params = drone(motor_time_constant=[0.03, 0.06], drag_height=0.02)
    model = Quadrotor(params, 0.005, 1, "semi_implicit_euler")
    state = model.rest(torch.zeros(3, 3, dtype=F64))
    state["velocity"] = torch.tensor([[1.0, -2.0, 0.5]], dtype=F64).expand(3, 3).clone()
    action = model.hover_action + torch.tensor([[0.3, 0.2, -0.1, 0.4], [-0.3, 0.0, 0.3, 0.0], [0.0] * 4], dtype=F64)
    flies = params.replace(mass=0.5, drag_height=0.04) if own else model.nominal
    plant = tuple(getattr(flies, name).reshape(-1, 1).expand(-1, 3) for name in model.plant_fields) if own else ()
    rows = model.rows_step()(torch.cat([x.t() for x in state.values()]), model.setpoint_rows(action), plant, ())
    after = model.control_step(state, action, flies, None)
    torch.testing.assert_close(rows, torch.cat([after[name].t() for name in model.sizes]))
