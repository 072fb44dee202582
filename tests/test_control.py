"""The flight controller where rotors saturate: yaw gives way first, and nothing changes where they do not."""

import pytest
import torch

from torchrl_quad import available_drones, load_drone
from torchrl_quad.dynamics import FlightController
from torchrl_quad.dynamics.control import Setpoint
from torchrl_quad.dynamics.vector import matvec, stack, unbind

F64 = torch.float64
each_drone = pytest.mark.parametrize("controller", available_drones(), indirect=True)


@pytest.fixture
def controller(request):
    return FlightController(load_drone(request.param, dtype=F64))


def asked_wrench(controller, setpoint):
    """What the controller asks of a drone that is level, still and without torque, (n, 4)."""
    torque = controller.nominal.inertia * controller.nominal.rate_gain * setpoint.body_rate
    return torch.cat((setpoint.thrust, torque), -1)


def speeds(controller, setpoint):
    still = torch.zeros_like(setpoint.body_rate)
    return controller.rotor_speed(setpoint, still, torch.cat((setpoint.thrust, still), -1))


def setpoints(controller, n, size):
    """Random setpoints (n) of thrusts about hovering, and body rates up to a size times the greatest."""
    weight = controller.nominal.mass * controller.nominal.gravity
    thrust = weight * (0.7 + 0.6 * torch.rand(n, 1, dtype=F64))
    return Setpoint(thrust, size * (2 * torch.rand(n, 3, dtype=F64) - 1) * controller.nominal.max_body_rate)


@each_drone
def test_thrust_roll_and_pitch_are_exact_where_yaw_alone_saturates(controller):
    setpoint = setpoints(controller, 500, 0.1)
    setpoint.body_rate[:, 2] = 1e3 * controller.nominal.max_body_rate[2]
    asked, flown = asked_wrench(controller, setpoint), controller.rotors.wrench(speeds(controller, setpoint))
    level = matvec(controller.mixer, asked * torch.tensor([1.0, 1.0, 1.0, 0.0], dtype=F64))
    feasible = ((level >= controller.thrust_min) & (level <= controller.thrust_max)).all(-1)
    assert feasible.sum() > 50
    # Rotors that hardly turn are off by a millionth of their greatest thrust.
    arm = controller.nominal.rotor_positions.norm(dim=-1).max()
    error = (flown - asked)[feasible, :3] / torch.stack((torch.ones_like(arm), arm, arm))
    assert (error.abs() < 2e-6 * controller.thrust_max.max()).all()
    assert (flown[:, 3] > -1e-9).all()
    assert (flown[feasible, 3] < asked[feasible, 3]).all()
    assert flown[feasible, 3].mean() > 0


@each_drone
def test_where_nothing_saturates_the_mixer_is_untouched_to_the_last_bit(controller):
    setpoint = setpoints(controller, 500, 0.02)
    plain = matvec(controller.mixer, asked_wrench(controller, setpoint))
    assert ((plain >= controller.thrust_min) & (plain <= controller.thrust_max)).all()
    assert torch.equal(speeds(controller, setpoint), controller.rotors.speed(plain))


@each_drone
def test_no_command_asks_more_of_a_rotor_than_it_can_give(controller):
    setpoint = setpoints(controller, 500, 30.0)
    thrust = controller.rotors.thrust(speeds(controller, setpoint))
    slack = 1e-6 * controller.thrust_max
    assert ((thrust >= controller.thrust_min - slack) & (thrust <= controller.thrust_max + slack)).all()


@each_drone
def test_the_saturated_mixer_has_exact_derivatives(controller):
    setpoint, rate = setpoints(controller, 20, 3.0), controller.nominal.max_body_rate
    weight = controller.nominal.mass * controller.nominal.gravity

    def commanded(thrust, rates):
        return speeds(controller, Setpoint(thrust * weight, rates * rate)) / controller.hover_speed

    inputs = [(setpoint.thrust / weight).requires_grad_(), (setpoint.body_rate / rate).requires_grad_()]
    plain = matvec(controller.mixer, asked_wrench(controller, setpoint))
    assert ((plain < controller.thrust_min) | (plain > controller.thrust_max)).any(-1).sum() > 5
    assert torch.autograd.gradcheck(commanded, inputs, eps=1e-7, atol=1e-5, rtol=1e-5)


@each_drone
@pytest.mark.parametrize("size", [0.02, 3.0])
def test_arrays_and_components_give_the_same_commands(controller, size):
    setpoint = setpoints(controller, 200, size)
    rates = torch.randn(200, 3, dtype=F64)
    wrench = matvec(controller.rotors.allocation, controller.thrust_max * torch.rand(200, 4, dtype=F64))
    whole = controller.rotor_speed(setpoint, rates, wrench)
    apart = controller.unbind().rotor_speed(Setpoint(*map(unbind, setpoint)), unbind(rates), unbind(wrench))
    torch.testing.assert_close(stack(apart).t(), whole, rtol=1e-12, atol=1e-9)
