"""What actions may command: every mode goes where it is told, on every drone, with exact derivatives."""

import itertools
import math

import pytest
import torch
from helpers import FLOWN, cases, fly, refuses
from scipy.spatial.transform import Rotation
from torchrl.envs import check_env_specs

from torchrl_quad import HoveringEnv, load_drone, make_actor, make_env
from torchrl_quad.adapters.gym import GymVectorEnv
from torchrl_quad.dynamics import CONTROLS, DYNAMICS, quaternion
from torchrl_quad.envs import TASKS

F64 = torch.float64
DT, STEPS = 0.005, 4  # physics step [s], and how many make a control step
each_mode = pytest.mark.parametrize("control", CONTROLS)
each_drone = pytest.mark.parametrize("drone", FLOWN)
MODELS = set(itertools.product(CONTROLS, DYNAMICS)) - {("rotor_thrusts", "point_mass")}
MODELS -= set(itertools.product(set(CONTROLS) - {"rates"}, ("pid", "betaflight")))
each_model = pytest.mark.parametrize(("control", "dynamics"), sorted(MODELS))
each_flight = cases(*((name, "quadrotor") for name in FLOWN), ("visfly", "point_mass"))


def commanded(steps, *commands, control, drone="visfly", **options):
    """Fly the dynamics from rest, one drone for each command in physical units; returns the states after each step."""
    if isinstance(drone, str):  # without an integral, a drag moment turns drones off
        drone = load_drone(drone, F64).replace(drag_height=0.0)
    env = HoveringEnv(num_envs=len(commands), control=control, drone=drone, dt=0.01, dtype=F64, **options)
    action = env.dynamics.controller.encode(torch.tensor(commands, dtype=F64))
    state, states = env.dynamics.rest(torch.zeros(len(commands), 3, dtype=F64)), []
    for _ in range(steps):
        state = env.dynamics.control_step(state, action, env.nominal, None)
        states.append(state)
    return states


@each_flight
def test_roll_leans_right_pitch_leans_forward_and_yaw_turns_left(drone, dynamics):
    weight, rate = 9.81 * load_drone(drone).mass.item(), 0.3
    commands = [[weight, 0.4, 0, 0], [weight, 0, 0.4, 0], [weight, 0.3, -0.2, 0], [weight, 0, 0, rate]]
    states = commanded(100, *commands, control="attitude", drone=drone, dynamics=dynamics)
    turned = Rotation.from_quat(states[-1]["quaternion"].numpy(), scalar_first=True)
    velocity, angles = states[20]["velocity"], torch.tensor(turned.as_euler("ZYX")[:, ::-1].copy())
    assert velocity[0, 1] < -0.1 and velocity[0, 0].abs() < 1e-6  # y is to the left
    assert velocity[1, 0] > 0.1 and velocity[1, 1].abs() < 1e-6
    torch.testing.assert_close(angles[:3, :2], torch.tensor(commands, dtype=F64)[:3, 1:3], atol=2e-3, rtol=0)
    assert 0.5 * 2 * rate < angles[3, 2] <= 1.05 * 2 * rate and angles[3, :2].abs().max() < 1e-3


@each_flight
def test_every_drone_flies_within_5_percent_of_a_commanded_velocity_but_for_what_linear_drag_takes(drone, dynamics):
    commands = [[2.0, 0, 0, 0], [-1.0, 0, 0, 0], [0, 2.5, 0, 0.3], [0, 0, 1.0, 0], [0, 0, -1.0, 0], [1.5, -1.5, 0.5, 0]]
    states = commanded(150, *commands, control="velocity", drone=drone, dynamics=dynamics)
    wanted = torch.tensor(commands, dtype=F64)
    # Where k (wanted - v) = c v / m, with no integral part, v is wanted k / (k + c / m).
    params, gain = load_drone(drone, F64), 2.42
    drag = (params.linear_drag[0] / params.mass).item()
    taken = drag / (gain + drag) if drag > 0.1 else 0.0
    for state in states[-25:]:
        error = (state["velocity"] - wanted[:, :3]).norm(dim=-1) / wanted[:, :3].norm(dim=-1)
        assert (error < 0.05 + taken).all(), error
    assert states[-1]["angular_velocity"][2] @ quaternion.up_in_body(states[-1]["quaternion"])[2] > 0.29
    up = torch.stack([quaternion.up_in_body(state["quaternion"])[:, 2] for state in states])
    assert up.min() > math.cos(math.pi / 6)


@each_mode
@each_drone
def test_the_hover_action_hovers_and_is_the_command_that_it_stands_for(control, drone):
    env = HoveringEnv(num_envs=1, control=control, drone=drone, dtype=F64)
    controller = env.dynamics.controller
    rest = state = env.dynamics.rest(torch.zeros(1, 3, dtype=F64))
    for _ in range(20):
        state = env.dynamics.control_step(state, env.hover_action.expand(1, 4), env.nominal, None)
    torch.testing.assert_close(state, rest, atol=1e-9, rtol=1e-9)
    command = zip(env.action_units.values(), controller.decode(env.hover_action).tolist(), strict=True)
    weight = 0 if control == "velocity" else 9.81 * env.nominal.mass.item()
    assert sum(x for unit, x in command if unit == "N") == pytest.approx(weight)
    torch.testing.assert_close(controller.encode(controller.decode(env.hover_action)), env.hover_action)
    assert (env.reset()["state", "action_queue"] == env.hover_action).all()


@each_model
def test_flights_have_exact_derivatives_with_delay_and_random_drones(control, dynamics):
    options = {"action_delay": 2, "randomize": {"mass": {"scale": [0.8, 1.2]}}, "wind": {"gust": 0.5}}
    start = {"tilt": 0.5, "velocity": 1.0, "angular_velocity": 1.0}
    options |= {"control": control, "dynamics": dynamics, "random_start": start}
    env = HoveringEnv(num_envs=2, dtype=F64, dt=0.01, **options)
    actions = (env.hover_action + 0.2 * torch.randn(2, 8, 4, dtype=F64)).requires_grad_()
    drag = env.nominal.linear_drag.clone().requires_grad_()

    def outputs(actions, drag):
        env.set_seed(0)
        env.params = env.nominal.replace(linear_drag=drag)
        td, ends = env.reset(), []
        for action in actions.unbind(1):
            step = env.step(td.set("action", action))
            ends += [step["next", "reward"].flatten(), step["next", "observation"].flatten()]
            td = env.step_mdp(step)
        return torch.cat(ends)

    grads = torch.autograd.grad(outputs(actions, drag).sum(), actions)[0]
    assert (grads[:, :6] != 0).any(-1).all() and (grads[:, 6:] == 0).all()  # the last two are still on their way
    assert torch.autograd.gradcheck(outputs, (actions, drag), fast_mode=True, atol=1e-6, rtol=1e-5)


@each_model
def test_the_step_that_is_compiled_is_the_eager_step(control, dynamics):
    env = HoveringEnv(num_envs=50, control=control, dynamics=dynamics, dtype=F64, dt=0.01, control_dt=0.01)
    model, action = env.dynamics, 1.2 * (2 * torch.rand(50, 4, dtype=F64) - 1)
    state = {name: x + 0.5 * torch.randn_like(x) for name, x in model.rest(torch.zeros(50, 3, dtype=F64)).items()}
    state["quaternion"] = quaternion.normalize(state["quaternion"])
    after = model.control_step(state, action, env.nominal, None)
    rows = model.rows_step()(torch.cat([x.t() for x in state.values()]), model.setpoint_rows(action), (), ())
    torch.testing.assert_close(rows.t(), torch.cat([after[name] for name in state], 1), rtol=1e-9, atol=1e-9)


@each_mode
def test_drones_of_one_batch_each_have_their_own_controller(control):
    command = [[0.3, 0.1, -0.1, 0.2]] * 2
    drones = [load_drone(name, F64) for name in ("visfly", "crazyflie")]
    both = {name: torch.stack([drone.fields()[name] for drone in drones]) for name in drones[0].fields()}
    together = commanded(10, *command, control=control, drone=type(drones[0])(**both))[-1]
    for i, drone in enumerate(drones):
        alone = commanded(10, command[0], control=control, drone=drone)[-1]
        torch.testing.assert_close({key: x[i : i + 1] for key, x in together.items()}, alone)
    refuses("is for 2 environments, and num_envs=5", HoveringEnv, num_envs=5, drone=type(drones[0])(**both))


def test_limits_can_be_chosen_and_gymnasium_takes_them():
    env = GymVectorEnv("hovering", 2, control={"mode": "velocity", "max_speed": 5.0, "max_tilt": 0.7}).torchrl_env
    assert env.dynamics.controller.decode(torch.ones(4)).tolist() == [5.0, 5.0, 5.0, 2.0]
    assert list(env.action_units.values()) == ["m/s", "m/s", "m/s", "rad/s"]


@cases(
    ({"control": "thrust"}, "Unknown control 'thrust'. Choose from: rates, attitude, rotor_thrusts, velocity; or"),
    ({"control": {"max_tilt": 0.5}}, r"control=\{'max_tilt': 0.5\} has no .mode. key. Choose from: rates, "),
    ({"control": None}, "control must be a name, such as rates, or a mapping with limits, got None"),
    ({"mode": "attitude", "max_speed": 1.0}, "'attitude' has no limit 'max_speed'. Choose from: max_tilt"),
    ({"mode": "rates", "max_tilt": 1.0}, "'rates' has no limit 'max_tilt'. It has none; those of the drone hold"),
    ({"mode": "attitude", "max_tilt": 30}, "control: max_tilt must be at most 1.5, got 30"),
    ({"mode": "velocity", "max_speed": "5"}, "control: max_speed must be a number, got '5'"),
    ({"control": "velocity", "dynamics": "own"}, "'own' takes no control: .* Leave out control='velocity'"),
    ({"control": "rotor_thrusts", "dynamics": "point_mass"}, 'control="rotor_thrusts" commands nothing'),
    ({"integrator": "rk4", "dynamics": "point_mass"}, 'supports only the integrator "semi_implicit_euler"'),
    ({"randomize": {"inertia": {"scale": [0.9, 1.1]}}, "dynamics": "point_mass"}, "unknown field 'inertia'. "),
)
def test_a_mode_or_a_limit_that_makes_no_sense_or_that_a_model_does_not_have_is_refused(options, message, monkeypatch):
    monkeypatch.setitem(DYNAMICS, "own", lambda nominal, dt, substeps, integrator: None)
    refuses(message, HoveringEnv, num_envs=1, **({"control": options} if "mode" in options else options))


# -- the point mass ----------------------------------------------------------------------------------------------------


@pytest.fixture
def point_mass():
    drone = load_drone("visfly", dtype=F64).replace(linear_drag=[0.0] * 3, quadratic_drag=[0.0] * 3)
    return HoveringEnv(num_envs=2, drone=drone, dynamics="point_mass", action_delay=0, dtype=F64)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_flies_a_point_mass_with_all_disturbances(task):
    disturbed = {"randomize": {"mass": {"scale": [0.9, 1.1]}}, "observation_noise": {"position": 0.01}}
    env = make_env(task, num_envs=3, dynamics="point_mass", dtype=F64, wind={"gust": 0.5}, **disturbed)
    check_env_specs(env)
    assert ("state", "rotor_speed") not in env.reset().keys(include_nested=True)
    actor = make_actor(env)
    flight = env.rollout(20, actor, break_when_any_done=False)
    assert flight["next", "reward"].isfinite().all()
    grads = torch.autograd.grad(flight["next", "reward"].sum(), list(actor.parameters()), allow_unused=True)
    assert all(g is None or g.isfinite().all() for g in grads)


@pytest.mark.parametrize("level", [-1.0, 0.2])
def test_thrust_straight_up_gives_a_constant_acceleration(point_mass, level):
    env, action = point_mass, torch.zeros(2, 20, 4, dtype=F64)
    action[..., 0] = level
    flight = fly(env, env.reset(), action.unbind(1))
    # -1 is no thrust, free fall; full thrust is max_thrust_to_weight times the weight.
    acceleration = 9.81 * ((level + 1) / 2 * env.nominal.max_thrust_to_weight.item() - 1)
    k = STEPS * torch.arange(1, 21, dtype=F64)
    height = flight["next", "state", "position"][..., 2] - flight["state", "position"][:, :1, 2]
    torch.testing.assert_close(flight["next", "state", "velocity"][0, :, 2], acceleration * k * DT)
    torch.testing.assert_close(height[0], acceleration * DT**2 * k * (k + 1) / 2)
    assert (flight["next", "state", "velocity"][..., :2] == 0).all()


def test_body_rates_follow_at_once_and_turn_by_rate_times_time(point_mass):
    env, action = point_mass, point_mass.hover_action.repeat(2, 10, 1)
    action[..., 3] = 0.5
    state = fly(env, env.reset(), action.unbind(1))["next", "state"]
    rate = 0.5 * env.nominal.max_body_rate * torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(state["angular_velocity"][0, 0], rate)
    # Each step adds the derivative and normalizes: it turns by 2 atan(rate dt / 2).
    angle = 2 * torch.atan(rate * DT / 2) * STEPS * 10
    torch.testing.assert_close(state["quaternion"][0, -1], quaternion.from_axis_angle(angle))
