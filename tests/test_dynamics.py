"""Physics against physics, and gradients through the simulator against finite differences, in float64."""

import math

import numpy as np
import pytest
import torch
from helpers import FLOWN
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from torchrl_quad import HoveringEnv
from torchrl_quad.deploy.simulators import vehicle
from torchrl_quad.dynamics import PID, Betaflight, FlightController, Quadrotor, load_drone, quaternion, rigid_body
from torchrl_quad.dynamics.control import Setpoint
from torchrl_quad.dynamics.gains import rate_loop
from torchrl_quad.dynamics.model import QuadrotorState
from torchrl_quad.dynamics.rigid_body import INTEGRATORS, RigidBodyState, Rotors, accelerations
from torchrl_quad.dynamics.vector import matvec

F64 = torch.float64
LEVEL = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=F64)
ZERO = torch.zeros(1, 3, dtype=F64)
TILTED = [[0.1, -0.2, 1.0], [0.2, 0.1, 1.0], [-0.1, 0.2, 0.9], [-0.1, -0.1, 1.0]]
NO_WRENCH = torch.zeros(1, 4, dtype=F64)


def drone(name="visfly", **changes):
    return load_drone(name, dtype=F64).replace(**changes)


def without_drag():
    return drone(linear_drag=[0.0] * 3, quadratic_drag=[0.0] * 3)


def vector(*values):
    return torch.tensor([values], dtype=F64)


def body(position=ZERO, attitude=LEVEL, velocity=ZERO, angular_velocity=ZERO):
    return RigidBodyState(position, attitude, velocity, angular_velocity)


def fly_body(state, params, wrench, seconds, dt, integrator="rk4"):
    for _ in range(round(seconds / dt)):
        state = INTEGRATORS[integrator](state, lambda s: accelerations(s, wrench, params), dt)
    return state


def hovering(controller, n=1):
    still = ZERO.repeat(n, 1)
    return QuadrotorState(still, LEVEL.repeat(n, 1), still, still, controller.hover_speed.expand(n, 4))


def fly(state, action, params, controller, seconds, dt=0.005, integrator="semi_implicit_euler"):
    model, history = Quadrotor(controller.nominal, dt, 1, integrator), []
    for _ in range(round(seconds / dt)):
        state = QuadrotorState(**model.control_step(state._asdict(), action, params, None))
        history.append(state)
    return history


def test_free_fall_follows_the_parabola_and_with_drag_ends_where_that_balances_the_weight():
    end = fly_body(body(velocity=vector(1.0, 2.0, 3.0)), without_drag(), NO_WRENCH, 1.0, 0.01)
    torch.testing.assert_close(end.velocity, vector(1.0, 2.0, 3.0 - 9.81))
    torch.testing.assert_close(end.position, vector(1.0, 2.0, 3.0 - 9.81 / 2))
    params = drone()
    speed = -fly_body(body(), params, NO_WRENCH, 60.0, 0.05).velocity[0, 2]
    force = params.linear_drag[2] * speed + params.quadratic_drag[2] * speed**2
    torch.testing.assert_close(force, (params.mass * params.gravity)[0], rtol=1e-6, atol=0)


def test_drag_opposes_motion_along_every_axis_and_above_the_centre_of_mass_pitches_a_drone_up():
    params = drone(gravity=0.01)
    velocity = 5.0 * torch.cat((torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)))
    linear, _ = accelerations(body(velocity=velocity), NO_WRENCH, params)
    assert ((linear * velocity).sum(-1) < -0.05).all()
    params = drone(drag_height=0.03, linear_drag=[0.2] * 3, quadratic_drag=[0.0] * 3)
    velocity = torch.tensor([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]], dtype=F64)
    _, angular = accelerations(body(velocity=velocity), NO_WRENCH, params)
    moment = 0.03 * 0.2 * 2.0  # about y where it flies along x (nose up), about x where it flies along y
    about = torch.tensor([[0.0, -moment, 0.0], [moment, 0.0, 0.0]], dtype=F64)
    torch.testing.assert_close(angular, about / params.inertia)


def test_torque_free_rotation_conserves_angular_momentum_in_the_world():
    params = without_drag()
    start = body(attitude=quaternion.from_axis_angle(vector(0.3, -0.8, 0.5)), angular_velocity=vector(4.0, 7.0, -2.0))

    def momentum(state):
        return quaternion.rotate(state.quaternion, params.inertia * state.angular_velocity)

    end = fly_body(start, params, NO_WRENCH, 1.0, 1e-3)
    torch.testing.assert_close(momentum(end), momentum(start), rtol=1e-8, atol=1e-12)
    assert not torch.allclose(end.angular_velocity, start.angular_velocity, atol=0.1)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("semi_implicit_euler", 1), ("rk4", 4)])
def test_each_integrator_converges_with_its_order_under_a_prescribed_wrench(integrator, order):
    params = drone()
    wrench = vector(6.0, 2e-3, -3e-3, 1e-3)
    attitude = quaternion.from_axis_angle(vector(0.2, 0.4, -0.3))
    start = body(ZERO, attitude, vector(2.0, -1.0, 0.5), vector(1.0, -2.0, 1.5))

    def end(dt, method):
        return torch.cat(list(fly_body(start, params, wrench, 0.4, dt, method)), -1)

    exact, steps = (end(1e-3, "rk4"), (5e-3, 2.5e-3)) if order < 4 else (end(2.5e-4, "rk4"), (4e-2, 2e-2))
    errors = [(end(dt, integrator) - exact).norm() for dt in steps]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_every_integrator_is_of_first_order_with_all_in_the_loop_and_keeps_the_norm_of_quaternions(integrator):
    params = drone()
    controller = FlightController(params)

    def flown(seconds, dt, *action):
        return fly(hovering(controller), vector(*action), params, controller, seconds, dt, integrator)

    def end(dt):
        return torch.cat(list(flown(0.05, dt, 0.0, 0.5, -0.4, 0.3)[-1][:4]), -1)

    for state in flown(3.0, 5e-3, 0.3, 1.0, -1.0, 1.0):
        torch.testing.assert_close(state.quaternion.norm(dim=-1), torch.ones(1, dtype=F64))
    exact = end(3.125e-5)
    errors = [(end(dt) - exact).norm() for dt in (2e-3, 1e-3)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("tilted", [False, True])
def test_allocation_is_r_cross_f_for_any_layout(tilted):
    positions = [[0.2, 0.1, 0.03], [-0.15, 0.12, 0.0], [-0.1, -0.3, -0.04], [0.05, -0.2, 0.1], [0.3, 0.0, 0.02]]
    params = drone(rotor_positions=positions, rotor_spin=[1.0, 1.0, -1.0, -1.0, 1.0])
    thrust, up = torch.tensor([1.0, 2.0, 0.5, 1.5, 0.7], dtype=F64), vector(0.0, 0.0, 1.0).repeat(5, 1)
    if tilted:
        up = torch.nn.functional.normalize(torch.randn(5, 3, dtype=F64) + 2.0 * up, dim=-1)
        params = params.replace(rotor_direction=3.0 * up)
    force = up * thrust.unsqueeze(-1)
    torque = torch.linalg.cross(params.rotor_positions, force)
    torque += params.yaw_torque_coefficient * params.rotor_spin.unsqueeze(-1) * force
    collective, whole = force.sum(0), torch.cat((force.sum(0)[2:], torque.sum(0)))
    whole = torch.cat((whole, collective[:2])) if tilted else whole
    torch.testing.assert_close(rigid_body.allocation_matrix(params) @ thrust, whole)
    share = torch.tensor([1.0, 0.5, 0.0, 0.8, 1.2], dtype=F64)
    worn = rigid_body.allocation_matrix(params.replace(rotor_effectiveness=share))
    torch.testing.assert_close(worn @ thrust, rigid_body.allocation_matrix(params) @ (share * thrust))


@pytest.mark.parametrize("dt", [5e-4, 5e-3, 1e-2])
@pytest.mark.parametrize("name", FLOWN)
def test_the_rate_loop_is_damped_as_its_poles_say_in_the_steps_that_are_flown(name, dt):
    params = drone(name, drag_height=0.0)
    controller = FlightController(params)
    step = torch.nn.functional.pad(0.02 * torch.eye(3, dtype=F64), (1, 0))  # about one axis each
    history = fly(hovering(controller, 3), controller.hover_action + step, params, controller, 1.0, dt)
    rates = torch.stack([state.angular_velocity.diagonal() for state in history]) / (0.02 * params.max_body_rate)
    loop, fields = rate_loop(params, dt), (params.rate_gain, params.rate_damping / params.inertia)
    torch.testing.assert_close((rates.amax(0) - 1).clamp_min(0), torch.tensor(loop.overshoot), atol=2e-3, rtol=0)
    for axis, (gain, ratio) in enumerate(zip(*(x.tolist() for x in fields), strict=True)):
        share = -math.expm1(-dt / params.motor_time_constant.item())
        a = np.array([[1.0, dt], [-share * gain, 1.0 - share - share * ratio]])
        np.testing.assert_allclose(np.sort(np.linalg.eigvals(a)), np.sort(loop.poles[axis]), rtol=1e-9)
        state, flown = np.zeros(2), []
        for _ in history:
            state = a @ state + [0.0, share * gain]
            flown.append(state[0])
        np.testing.assert_allclose(rates[:, axis], flown, atol=5e-3)
        answer = np.linalg.solve(np.exp(1j * loop.bandwidth[axis] * dt) * np.eye(2) - a, [0.0, share * gain])[0]
        assert abs(answer) == pytest.approx(0.5**0.5, rel=1e-9)
        of_continuous_time = (1 + ratio) / (2 * math.sqrt(gain * params.motor_time_constant))
        assert rate_loop(params, 0.0).damping_ratio[axis] == pytest.approx(of_continuous_time, rel=1e-5)


FALLING_SLOPE = {"thrust_map": [-2.0, 8.0, 0.1], "rotor_speed_min": 0.0, "rotor_speed_max": 1.0}  # of a motor command


@pytest.mark.parametrize("changes", [{}, FALLING_SLOPE, {**FALLING_SLOPE, "thrust_map": [0.01, 6.0, -0.1]}])
@pytest.mark.parametrize("name", FLOWN)
def test_the_thrust_map_and_its_inverse_agree_over_the_speed_range(name, changes):
    params = drone(name, **changes)
    rotors = Rotors(params)
    apart = vehicle.Drone({k: x.squeeze().numpy() for k, x in params.fields().items() if k != "drag_height"})
    low, high = rigid_body.thrust_limits(params)
    thrust = low + torch.linspace(0.01, 1, 50, dtype=F64) * (high - low)
    speed = rotors.speed(thrust)
    torch.testing.assert_close(rotors.thrust(speed), thrust)
    assert ((params.rotor_speed_min <= speed) & (speed <= params.rotor_speed_max * (1 + 1e-9))).all()
    np.testing.assert_allclose(apart.speed(thrust.numpy()), speed.numpy(), rtol=1e-12)


@pytest.mark.parametrize("dt", [1e-3, 5e-3, 0.05])
@pytest.mark.parametrize(("speeds_up", "slows_down"), [(0.033, 0.033), (0.05, 0.2)])
def test_the_motor_step_response_is_the_exact_exponential_for_any_dt(dt, speeds_up, slows_down):
    rotors = Rotors(drone(motor_time_constant=[speeds_up, slows_down] if speeds_up < slows_down else speeds_up))
    speed, target = torch.full((1, 4), 1000.0, dtype=F64), vector(2000.0, 2000.0, 500.0, 500.0)
    for _ in range(round(0.1 / dt)):
        speed = rotors.follow(speed, target, dt)
    up, down = 2000.0 - 1000.0 * math.exp(-0.1 / speeds_up), 500.0 + 500.0 * math.exp(-0.1 / slows_down)
    torch.testing.assert_close(speed, vector(up, up, down, down))


def test_rotations_agree_with_the_rotation_matrix_and_invert_each_other():
    q = quaternion.normalize(torch.randn(5, 4, dtype=F64))
    v = torch.randn(5, 3, dtype=F64)
    matrix = torch.tensor(Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix())
    torch.testing.assert_close(quaternion.rotate(q, v), (matrix @ v.unsqueeze(-1)).squeeze(-1))
    torch.testing.assert_close(quaternion.rotate_inverse(q, quaternion.rotate(q, v)), v)
    p = quaternion.normalize(torch.randn(5, 4, dtype=F64))
    one_by_one = quaternion.rotate(p, quaternion.rotate(q, v))
    torch.testing.assert_close(quaternion.rotate(quaternion.multiply(p, q), v), one_by_one)
    assert torch.equal(quaternion.rotate(q, v[0]), quaternion.rotate(q, v[:1].expand(5, 3)))
    assert torch.equal(quaternion.multiply(p, q[0]), quaternion.multiply(p, q[:1].expand(5, 4)))
    assert torch.equal(quaternion.rotate(q.unsqueeze(1), v)[:, 2], quaternion.rotate(q, v[2:3]))


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("kind", [Quadrotor, PID, Betaflight])
def test_components_fly_as_tensors_do_with_two_time_constants_and_drag_above_the_centre_of_mass(kind, own):
    params = drone(motor_time_constant=[0.03, 0.06], drag_height=0.02)
    model = kind(params, 0.005, 1, "semi_implicit_euler")
    state = model.rest(torch.zeros(3, 3, dtype=F64))
    state["velocity"] = vector(1.0, -2.0, 0.5).repeat(3, 1)
    state |= {name: 0.1 + x for name, x in state.items() if name in ("rate_integral", "slow_rate")}
    action = model.hover_action + torch.tensor([[0.3, 0.2, -0.1, 0.4], [-0.3, 0.0, 0.3, 0.0], [0.0] * 4], dtype=F64)
    flies = params.replace(mass=0.5, drag_height=0.04) if own else model.nominal
    flies = flies.replace(rotor_effectiveness=[0.9, 1.0, 0.8, 1.0], rotor_direction=TILTED) if own else flies
    plant = tuple(getattr(flies, name).reshape(-1, 1).expand(-1, 3) for name in model.plant_fields) if own else ()
    rows = model.rows_step()(torch.cat([x.t() for x in state.values()]), model.setpoint_rows(action), plant, ())
    after = model.control_step(state, action, flies, None)
    torch.testing.assert_close(rows, torch.cat([after[name].t() for name in model.sizes]))


# -- where rotors saturate: yaw gives way first, and nothing changes where they do not ---------------------------------

each_drone = pytest.mark.parametrize("controller", FLOWN, indirect=True)


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
    thrust = controller.nominal.mass * controller.nominal.gravity * (0.7 + 0.6 * torch.rand(n, 1, dtype=F64))
    return Setpoint(thrust, size * (2 * torch.rand(n, 3, dtype=F64) - 1) * controller.nominal.max_body_rate)


@each_drone
def test_the_mixer_is_exact_to_the_last_bit_or_gives_up_yaw_first_and_asks_no_more_of_a_rotor_than_it_can(controller):
    setpoint = setpoints(controller, 500, 0.02)
    plain = matvec(controller.mixer, asked_wrench(controller, setpoint))
    assert ((plain >= controller.thrust_min) & (plain <= controller.thrust_max)).all()
    assert torch.equal(speeds(controller, setpoint), controller.rotors.speed(plain))
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
    assert (flown[:, 3] > -1e-9).all() and (flown[feasible, 3] < asked[feasible, 3]).all()
    assert flown[feasible, 3].mean() > 0
    thrust = controller.rotors.thrust(speeds(controller, setpoints(controller, 500, 30.0)))
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


STEPS = 20


def flight(env, actions, state, steps=STEPS):
    """Rewards and final state of a flight that resets where it is done, as one vector."""
    env.set_seed(0)
    td = env.reset(TensorDict({"state": state}, env.batch_size), set_state=True)
    rewards = []
    for t in range(steps):
        step, td = env.step_and_maybe_reset(td.set("action", actions[:, t]))
        rewards.append(step["next", "reward"].flatten())
    last = step["next", "state"]
    ends = (last[k].flatten() for k in ("position", "quaternion", "velocity", "angular_velocity"))
    return torch.cat((*rewards, *ends))


def setup(**kwargs):
    env = HoveringEnv(num_envs=3, dtype=torch.float64, seed=2, **kwargs)
    actions = env.hover_action + 0.2 * torch.randn(3, STEPS, 4, dtype=torch.float64)
    state = env.rollout(3)["next", "state"][:, -1].clone()
    return env, actions.requires_grad_(), state


def gradients_agree(function, *inputs):
    return torch.autograd.gradcheck(function, inputs, fast_mode=True, atol=1e-6, rtol=1e-5)


def test_with_respect_to_actions_with_each_integrator_and_delay():
    for options in ({}, {"integrator": "euler", "action_delay": 0}, {"integrator": "rk4", "action_delay": 2}):
        env, actions, state = setup(**options)
        assert gradients_agree(lambda a, env=env, state=state: flight(env, a, state), actions)


def test_with_respect_to_every_entry_of_the_initial_state_also_through_resets():
    env, actions, state = setup(max_episode_steps=24)
    state["step"] = torch.tensor([[15], [0], [19]])  # the second drone flies through
    actions = actions.detach()
    values = {key: x.clone().requires_grad_() for key, x in state.items() if x.is_floating_point()}

    def flown(*given):
        return flight(env, actions, state.copy().update(dict(zip(values, given, strict=True))))

    assert gradients_agree(flown, *values.values())


@pytest.mark.parametrize(("limit", "lag"), [(256, [0.03, 0.05]), (12, 0.033)])  # at rest two constants have a kink
def test_with_respect_to_every_parameter_of_the_drone_also_through_resets(limit, lag):
    smooth = dict.fromkeys(("velocity", "angular_velocity", "attitude"), 0.0)  # at rest these terms have one, too
    env, actions, state = setup(max_episode_steps=limit, weights=smooth)
    actions = actions.detach()
    if limit == 12:
        state["step"] = torch.tensor([[3], [0], [7]])
    drag = {"drag_height": 0.02, "linear_drag": [0.3] * 3, "quadratic_drag": [0.05] * 3}  # it turns the drone
    own = env.params.replace(motor_time_constant=lag, rotor_speed_min=1300.0, rotor_speed_max=1850.0, **drag)
    if limit == 256:
        places = torch.nn.functional.pad(own.rotor_positions, (0, 1), value=0.01)
        own = own.replace(rotor_positions=places, rotor_direction=TILTED, rotor_effectiveness=[0.9, 1.0, 1.1, 0.8])

    def fly(**parameters):
        env.params = own.replace(**parameters)
        return (weights * flight(env, actions, state, steps=14)).sum()

    names = sorted(own.fields().keys() & set(env.dynamics.plant_fields) - {"rotor_spin"})  # which is +1 or -1
    values = {name: getattr(own, name).clone().requires_grad_() for name in names}
    weights = torch.rand(3 * 14 + 3 * 13, dtype=F64)
    grads = torch.autograd.grad(fly(**values), values.values())
    for (name, value), grad in zip(values.items(), grads, strict=True):
        value = value.detach()
        step = 1e-5 * value * torch.randn_like(value)
        with torch.no_grad():
            slope = (fly(**{name: value + step}) - fly(**{name: value - step})) / 2.0
        assert slope != 0.0, name
        torch.testing.assert_close(
            (grad * step).sum(), slope, rtol=1e-5, atol=0.0, msg=lambda said, name=name: f"{name}: {said}"
        )


def test_through_a_partial_reset_the_gradient_is_cut_exactly_there():
    env, actions, state = setup(max_episode_steps=12)
    state["step"] = torch.tensor([[3], [0], [7]])
    assert gradients_agree(lambda a: flight(env, a, state), actions)
    # environment 0 is reset after 9 steps, environment 1 after 12, environment 2 after 5 and 17
    rewards = flight(env, actions, state)[: 3 * STEPS].view(STEPS, 3)
    for i, resets in enumerate(([9], [12], [5, 17])):
        for reset in resets:
            (grad,) = torch.autograd.grad(rewards[reset:, i].sum(), actions, retain_graph=True)
            assert (grad[i, :reset] == 0).all() and (grad[i, reset : reset + 1] != 0).any()
            assert (grad[[j for j in range(3) if j != i]] == 0).all()
