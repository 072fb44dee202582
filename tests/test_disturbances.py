"""Random drones, wind, sensors, starts, and disturbances of one's own, on every task."""

import pytest
import torch
from helpers import cases, fly, hold, refuses
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from torchrl_quad import HoveringEnv, load_drone, make_env
from torchrl_quad.dynamics import DYNAMICS, Quadrotor, quaternion
from torchrl_quad.envs import TASKS
from torchrl_quad.envs.disturbances import Disturbance, Sensors
from torchrl_quad.errors import DroneWarning

RANDOMIZE = {"mass": {"scale": [0.8, 1.2]}, "inertia": {"scale": [0.9, 1.1]}}
RANDOMIZE |= {"motor_time_constant": {"uniform": [0.02, 0.05]}, "linear_drag": {"normal": [0.005, 0.001]}}
NOISE = {"position": 0.01, "attitude": 0.01, "velocity": 0.05, "angular_velocity": 0.02}
EVERYTHING = {"observation_noise": NOISE, "observation_delay": 2, "randomize": RANDOMIZE}
EVERYTHING["wind"] = {"mean": [1.0, 0.0, 0.0], "spread": [0.5, 0.5, 0.0], "gust": 0.5}
EVERYTHING["random_start"] = {"tilt": 0.5, "yaw": 3.1, "velocity": 1.0, "angular_velocity": 0.5}


@pytest.mark.parametrize("task", TASKS)
def test_every_task_takes_every_disturbance_and_a_restored_state_flies_the_same(task):
    env = make_env(task, num_envs=3, dtype=torch.float64, disturbances=own(), **EVERYTHING)
    check_env_specs(env, break_when_any_done="both")
    env.set_seed(1)
    whole = fly(env, env.reset(), hold(env, 4))
    generator = env.random_state()
    rest = fly(env, env.step_mdp(whole[:, -1]), hold(env, 4))
    env.reset()
    env.set_random_state(generator)
    restored = env.reset(TensorDict({"state": whole["next", "state"][:, -1].clone()}, [3]), set_state=True)
    torch.testing.assert_close(restored["observation"], whole["next", "observation"][:, -1], rtol=0, atol=0)
    again = fly(env, restored, hold(env, 4))
    for key, value in rest["next"].items(include_nested=True, leaves_only=True):
        assert torch.equal(value, again["next", key]), key


@pytest.mark.parametrize("task", [*TASKS, "any drone"])
def test_gradients_with_every_disturbance_agree_with_finite_differences(task):
    env = any_drone(2, **EVERYTHING | {"randomize": "any", "observe_last_action": True})
    if task in TASKS:
        env = make_env(task, num_envs=2, dtype=torch.float64, **EVERYTHING)
    start = env.rollout(3)["next", "state"][:, -1].clone()
    actions = (env.hover_action + 0.1 * torch.randn(2, 8, 4, dtype=torch.float64)).requires_grad_()
    position = start["position"].clone().requires_grad_()
    mass = start["drone", "mass"].clone().requires_grad_()
    wind = start["wind"].clone().requires_grad_()

    def rewards_and_observations(actions, position, mass, wind):
        env.set_seed(5)
        state = start.clone(recurse=True)
        state["position"], state["drone", "mass"], state["wind"] = position, mass, wind
        ends = fly(env, env.reset(TensorDict({"state": state}, [2]), set_state=True), actions.unbind(1))["next"]
        return torch.cat((ends["reward"].flatten(), ends["observation"].flatten()))

    inputs = (actions, position, mass, wind)
    assert torch.autograd.gradcheck(rewards_and_observations, inputs, fast_mode=True, atol=1e-6, rtol=1e-5)


def test_drones_are_drawn_at_reset_within_their_bounds_and_stay_for_an_episode():
    env = HoveringEnv(num_envs=2000, randomize=EVERYTHING["randomize"], max_episode_steps=3)
    drone, nominal = env.reset()["state", "drone"], env.nominal
    assert set(drone.keys()) == set(EVERYTHING["randomize"])
    ratio = drone["mass"] / nominal.mass
    assert 0.8 <= ratio.min() < 0.82 and 1.18 < ratio.max() <= 1.2
    assert 0.02 <= drone["motor_time_constant"].min() < 0.021
    assert (drone["inertia"] / nominal.inertia).std(0).min() > 0.05
    assert abs(drone["linear_drag"].std().item() - 0.001) < 1e-4
    flight = env.rollout(5, break_when_any_done=False)["state", "drone", "mass"]
    assert (flight[:, 0] == flight[:, 2]).all() and (flight[:, 2] != flight[:, 3]).all()


def test_a_drone_that_is_heavier_or_weaker_than_its_controller_believes_flies_so(tmp_path):
    env = HoveringEnv(num_envs=1, randomize={"mass": {"uniform": [0.552, 0.552]}}, dtype=torch.float64)
    fixed = HoveringEnv(num_envs=1, dtype=torch.float64)
    fixed.params = fixed.params.replace(mass=0.552)
    td = env.reset()
    known = fixed.reset(TensorDict({"state": td["state"].exclude("drone")}, [1]), set_state=True)
    flight, expected = fly(env, td, hold(env, 20)), fly(fixed, known, hold(fixed, 20))
    torch.testing.assert_close(flight["next", "state", "position"], expected["next", "state", "position"])
    # 20 % too heavy: it falls with (1 - 1 / 1.2) g.
    assert flight["next", "state", "velocity"][0, -1, 2].item() == pytest.approx(-9.81 / 6 * 0.4, rel=0.02)
    assert env.nominal.mass.item() == pytest.approx(0.46)
    (tmp_path / "drones.yaml").write_text("rotor_speed_max: {uniform: [1800, 1800]}\n")
    weak = HoveringEnv(num_envs=1, randomize=str(tmp_path / "drones.yaml"))
    flight = fly(weak, weak.reset(), [torch.tensor([[1.0, 0.0, 0.0, 0.0]])] * 30)
    assert flight["next", "state", "rotor_speed"].max().item() == pytest.approx(1800.0, rel=1e-3)


def test_wind_has_the_strength_the_memory_and_the_spread_asked_for_and_a_drone_drifts_until_it_moves_with_the_air():
    drone = load_drone("visfly").replace(linear_drag=[2.0, 2.0, 2.0])
    env = HoveringEnv(num_envs=1, drone=drone, wind={"mean": [1.0, -0.5, 0.0]})
    flight = fly(env, env.reset(), hold(env, 100))["next", "state", "velocity"][0]
    torch.testing.assert_close(flight[-1], torch.tensor([1.0, -0.5, 0.0]), atol=2e-2, rtol=0)
    calm = HoveringEnv(num_envs=1, drone=drone)
    assert fly(calm, calm.reset(), hold(calm, 10))["next", "state", "velocity"].abs().max() < 1e-5
    env = HoveringEnv(num_envs=4000, wind={"mean": [2.0, 0.0, 0.0], "gust": 1.5, "gust_time": 0.1})
    wind = fly(env, env.reset(), hold(env, 6))["next", "state", "wind"] - torch.tensor([2.0, 0.0, 0.0])
    for t in (0, 5):
        assert wind[:, t].std(0).tolist() == pytest.approx([1.5] * 3, rel=0.05)
    assert ((wind[:, 0] * wind[:, 5]).mean(0) / 1.5**2).tolist() == pytest.approx([0.368] * 3, abs=0.06)
    mean = HoveringEnv(num_envs=1000, wind={"spread": [3.0, 0.0, 1.0]}).reset()["state", "wind"]
    assert mean.abs().amax(0).tolist() == pytest.approx([3.0, 0.0, 1.0], abs=0.05)


def test_the_observation_lags_behind_by_the_delay():
    late, now = (HoveringEnv(num_envs=2, seed=4, observation_delay=delay, dtype=torch.float64) for delay in (3, 0))
    actions = [now.hover_action + 0.3 * torch.rand(2, 4, dtype=torch.float64) for _ in range(8)]
    seen, true = fly(late, late.reset(), actions), fly(now, now.reset(), actions)
    torch.testing.assert_close(seen["observation"][:, 3:], true["observation"][:, :-3])
    torch.testing.assert_close(seen["next", "reward"], true["next", "reward"])
    assert (seen["observation"][:, :3] == true["observation"][:, :1]).all()
    for kwargs, delay in (({}, 3), ({"observation_delay": 1}, 1)):  # sensors that are given whole keep their delay
        env = HoveringEnv(num_envs=2, observation_noise=Sensors(position=0.1, delay=3), **kwargs)
        assert env.reset()["state", "measurements"].shape == (2, delay + 1, 13)


def test_the_noise_has_the_size_asked_for_and_rewards_do_not_see_it():
    noise = {"position": 0.2, "attitude": 0.05, "velocity": 0.3, "angular_velocity": 0.4}
    env = HoveringEnv(num_envs=4000, observation_noise=noise)
    flight = fly(env, env.reset(), hold(env, 3))
    seen, state = flight["next", "observation"][:, -1], flight["next", "state"][:, -1]
    sizes = {"position": seen[:, :3] - (state["target"] - state["position"]), "velocity": seen[:, 7:10]}
    for name, error in {**sizes, "angular_velocity": seen[:, 10:]}.items():
        assert error.std(0).tolist() == pytest.approx([noise[name]] * 3, rel=0.05)
    angle = quaternion.rotate(seen[:, 3:7] / 10, torch.tensor([0.0, 0.0, 1.0]).expand(4000, 3))[:, :2]
    assert angle.std(0).tolist() == pytest.approx([0.05] * 2, rel=0.05)
    assert seen[:, 3:7].norm(dim=-1).tolist() == pytest.approx([10.0] * 4000, abs=1e-4)
    silent = HoveringEnv(num_envs=4000)
    assert torch.equal(flight["next", "reward"], fly(silent, silent.reset(), hold(env, 3))["next", "reward"])


def any_drone(n, **options):
    options = {"drone": "cf2x", "control": "rotor_thrusts", "randomize": "any", "dtype": torch.float64, **options}
    return HoveringEnv(num_envs=n, **options)


def test_any_drone_is_a_body_within_its_ranges_and_full_signal_is_all_that_its_own_rotors_give():
    env = any_drone(2000, randomize={"any": {"thrust_to_weight": [2.0, 4.0]}})
    td = env.reset()
    state = td["state"]
    mass, inertia, lag = (state["drone", x] for x in ("mass", "inertia", "motor_time_constant"))
    assert 0.02 <= mass.min() < 0.03 and 4.8 < mass.max() <= 5.0 and lag[:, 1].max() > 2.8 * lag[:, 0].max()
    assert (inertia <= inertia.sum(-1, keepdim=True) - inertia + 1e-12).all()
    assert [(state["delay"] == k).sum().item() for k in range(4)] == pytest.approx([500] * 4, abs=70)
    end = fly(env, td, [torch.ones(2000, 4, dtype=torch.float64)] * 4)
    signal = end["next", "state", "rotor_speed"][:, -1] / env.nominal.rotor_speed_max
    assert (signal <= 1.0).all() and (signal[:, 0] > state["rotor_speed"][:, 0] / env.nominal.rotor_speed_max).all()
    full = 4 * state["drone", "thrust_map"][:, :1] * env.nominal.rotor_speed_max**2
    weights = full / mass / 9.81
    assert 2.0 <= weights.min() < 2.01 and 3.99 < weights.max() <= 4.0
    torch.testing.assert_close(state["traits"][:, :1], weights.log() - 1.0)
    assert state["traits"].abs().max() < 3.0 and state["traits"].std(0).min() > 0.1
    described = env.disturbances["randomize"].spec  # as the contract of a policy says it
    assert described["thrust_to_weight"] == {"any": [2.0, 4.0]} and len(described) == 12


def test_a_command_takes_effect_after_the_delay_of_the_drawn_drone():
    env = any_drone(64)
    td = env.reset()
    hover = env.hover_action.expand(64, 4).clone()
    still, push = fly(env, td, [hover] * 5), fly(env, td, [hover + 0.5, *[hover] * 4])
    moved = (push["next", "state", "rotor_speed"] != still["next", "state", "rotor_speed"]).any(-1)
    first = moved.double().argmax(1, keepdim=True)
    assert moved.any(1).all() and torch.equal(first, td["state", "delay"])
    assert set(first.flatten().tolist()) == {*range(env.action_delay + 1)} == {0, 1, 2, 3}


@cases(
    ({"control": "rates"}, "draws the whole drone, of which no flight controller knows; got control='rates'"),
    ({"action_delay": 2}, r"action_delay=2 would change nothing. Write randomize={'any': {'delay': \[0, 2\]}}"),
    ({"drone": "typhoon_h480"}, "any draws quadrotors with upright rotors"),
    ({"randomize": {"any": {"weight": [1, 2]}}}, "any draws no 'weight'. Choose from: mass, thrust_to_weight, arm"),
    ({"randomize": {"any": {"mass": 1.0}}}, "mass must .* Give two numbers, low and high"),
    ({"randomize": {"any": {"thrust_to_weight": [0.9, 2]}}}, "two numbers, low and high, between 1.01 and 50; got"),
    ({"randomize": {"any": {"arm": [0.01, 0.1], "inertia": [0.01, 1]}}}, "not all possible: .* 'inertia' must be"),
    ({"randomize": {"any": {"delay": [0, 2.5]}}}, "delay needs two whole numbers"),
    ({"randomize": {"any": {}, "mass": {"scale": [1, 2]}}}, "any draws the whole drone, and takes ranges, such as"),
    ({"randomize": {"any": {"delay": [0, 0]}}, "observe_last_action": True}, "without a delay there are none"),
    ({"drone": load_drone("cf2x").replace(mass=torch.tensor([0.03], requires_grad=True))}, "no gradient reaches yours"),
    ({"drone": "kingfisher", "randomize": {"linear_drag": {"scale": [0.5, 2.0]}}}, "linear_drag is 0, and no scale"),
)
def test_a_distribution_of_any_drone_that_cannot_be_is_refused(options, message):
    refuses(message, any_drone, 1, **options)


def test_random_starts_tilt_turn_and_push_within_their_bounds():
    state = HoveringEnv(num_envs=4000, random_start=EVERYTHING["random_start"]).reset()["state"]
    up = quaternion.rotate(state["quaternion"], torch.tensor([0.0, 0.0, 1.0]).expand(4000, 3))
    tilt = torch.acos(up[:, 2].clamp(max=1.0))
    assert 0.48 < tilt.max() <= 0.5 + 1e-3 and tilt.mean().item() == pytest.approx(0.25, abs=0.02)
    ahead = quaternion.rotate(state["quaternion"], torch.tensor([1.0, 0.0, 0.0]).expand(4000, 3))
    assert torch.atan2(ahead[:, 1], ahead[:, 0]).abs().max() > 3.0
    assert 0.95 < state["velocity"].abs().max() <= 1.0 and 0.47 < state["angular_velocity"].abs().max() <= 0.5
    assert state["quaternion"].norm(dim=-1).tolist() == pytest.approx([1.0] * 4000, abs=1e-5)


class GyroBias(Disturbance):
    """The policy sees body rates with an offset that wanders."""

    noise_size = 3

    def start(self, random, state):
        return {"gyro_bias": 0.1 * random.normal(len(state["position"]), 3)}

    def advance(self, state, noise, dt):
        return {"gyro_bias": state["gyro_bias"] + 0.05 * dt**0.5 * noise}

    def observe(self, state):
        return {**state, "angular_velocity": state["angular_velocity"] + state["gyro_bias"]}


class BatterySag(Disturbance):
    """Thrust falls by a fifth in ten seconds, from a charge that differs between episodes."""

    def __init__(self, thrust_map):
        self.thrust_map = thrust_map

    def start(self, random, state):
        charge = 1.0 - 0.05 * (random.uniform(len(state["position"]), 1) + 1.0)
        return {"charge": charge, ("drone", "thrust_map"): charge * self.thrust_map.to(charge)}

    def advance(self, state, noise, dt):
        charge = state["charge"] - 0.02 * dt
        return {"charge": charge, ("drone", "thrust_map"): charge * self.thrust_map.to(charge)}


def own():
    return [GyroBias(), BatterySag(load_drone("visfly").thrust_map)]


def test_disturbances_of_one_s_own_change_what_is_seen_and_what_flies():
    env = HoveringEnv(num_envs=3, dtype=torch.float64, disturbances=own())
    td = env.reset()
    state = fly(env, td, hold(env, 20))["next", "state"]
    torch.testing.assert_close(td["observation"][:, -3:], td["state", "gyro_bias"])  # at rest there is nothing else
    assert (state["gyro_bias"].diff(dim=1) != 0).all()
    torch.testing.assert_close(state["charge"][:, -1], td["state", "charge"] - 0.02 * 0.4)
    torch.testing.assert_close(state["drone", "thrust_map"][:, -1], state["charge"][:, -1] * env.nominal.thrust_map)
    assert (state["velocity"][:, -1, 2] < -0.02).all()  # the controller believes in a full battery


@pytest.mark.parametrize("drift", [GyroBias, f"{__name__}.GyroBias", {"_target_": f"{__name__}.GyroBias"}])
def test_a_disturbance_may_be_given_by_its_class_or_its_path_alone_or_in_a_list(drift):
    for given in (drift, [drift]):
        env = HoveringEnv(num_envs=2, disturbances=given)
        assert "gyro_bias" in env.reset()["state"].keys()  # noqa: SIM118, a tensordict
    with pytest.raises(ValueError, match="disturbances: unknown key .size."):
        HoveringEnv(num_envs=1, disturbances={"_target_": f"{__name__}.GyroBias", "size": 3})


@cases(
    (3.0, TypeError, "disturbances must be a list of Disturbance, got float"),
    ([3.0], TypeError, "disturbances=3.0: it must be a subclass of Disturbance, its path, or an instance"),
    (HoveringEnv, TypeError, "disturbances=HoveringEnv: it must be a subclass of Disturbance"),
    ("disturbed.Gyro", ValueError, "disturbances 'disturbed.Gyro': Python finds no module 'disturbed'"),
    (own()[1], ValueError, r"Entry \('drone', 'thrust_map'\) changes no parameter of the drone"),
)
def test_what_is_not_a_disturbance_is_refused(wrong, error, message):
    refuses(message, HoveringEnv, error=error, num_envs=1, disturbances=wrong, dynamics="point_mass")


EFFECT = "drone", "rotor_effectiveness"


class Faulty(Disturbance):
    """Returns what it is told to."""

    def __init__(self, start, changed, seen):
        self.given, self.changed, self.seen = start, changed, seen

    def start(self, random, state):
        return self.given

    def advance(self, state, noise, dt):
        return self.changed

    def observe(self, state):
        return {**state, **self.seen} if isinstance(self.seen, dict) else self.seen


@cases(
    ({}, None, {}, "Faulty.advance must return a mapping of the entries that it changes, or {}; got NoneType"),
    ({}, {}, None, "Faulty.observe must return the whole state. Start from {..state, ...}"),
    ({("drone", "mass"): -torch.ones(1, 1)}, {}, {}, "'mass'.*, from Faulty.start, must be above zero, as in"),
    ({"position": torch.zeros(1, 4)}, {}, {}, r"'position', from Faulty.start, must have shape \(1, 3\), got \(1, 4\)"),
    ({EFFECT: torch.ones(1, 1)}, {}, {}, r"'rotor_effectiveness'\), from .*must have shape \(1, 4\), got \(1, 1\)"),
    ({}, {EFFECT: torch.ones(1, 4)}, {}, "which the state lacks, so that it would be lost. Give it in start"),
    ({}, {"velocity": torch.zeros(1, 1)}, {}, r"must give 'velocity' as the state has it, \(\(1, 3\), torch.float32"),
    ({}, {"rotor_speed": torch.zeros(1, 4)}, {}, "writes 'rotor_speed', which follows the .*rotor_effectiveness"),
    ({}, {"angular_velocity": torch.zeros(1, 3)}, {}, "'angular_velocity', which follows the .* would be undone.$"),
)
def test_what_a_disturbance_does_wrong_or_in_vain_is_named(start, changed, seen, message):
    dynamics = "point_mass" if "angular_velocity" in (changed or {}) else "quadrotor"
    refuses(message, HoveringEnv, num_envs=1, disturbances=[Faulty(start, changed, seen)], dynamics=dynamics)


def test_a_weight_may_be_changed_and_an_unknown_one_is_named():
    usual, other = HoveringEnv(num_envs=2), HoveringEnv(num_envs=2, weights={"velocity": 0.0, "position": 1.0})
    state = usual.rollout(5)["next", "state"][:, -1]
    before, after = usual.reward_terms(state), other.reward_terms(state)
    torch.testing.assert_close(after["position"], 9 / 0.1 * before["position"])
    assert (after["velocity"] == 0).all() and torch.equal(after["survival"], before["survival"])
    assert make_env("racing", num_envs=1, gate_bonus="log", weights={"gate": 3.0}).weights["gate"] == 3.0
    with pytest.raises(ValueError, match="weights: unknown term speed. Choose from: survival, position"):
        HoveringEnv(num_envs=1, weights={"speed": 1.0})


def test_what_a_drone_says_and_another_setting_overrides_is_told():
    worn = load_drone("cf2x", torch.float64).replace(rotor_effectiveness=torch.ones(4, dtype=torch.float64))
    anyone, effective = any_drone(2), any_drone(2, drone=worn)
    assert torch.equal(anyone.params.quadratic_drag, effective.params.quadratic_drag)
    assert effective.params.rotor_effectiveness is not None
    assert HoveringEnv(num_envs=1, drone=worn).rebuilt(drone="crazyflie_brushless").params.mass.item() > 0.04
    worn = HoveringEnv(num_envs=1, drone=worn, dtype=torch.float64)
    worn.params = worn.nominal
    again = worn.rebuilt(seed=1)
    assert again.params is again.nominal
    with pytest.warns(DroneWarning, match="this drone has no drag, so wind does not move it"):
        HoveringEnv(num_envs=1, drone="kingfisher", wind={"gust": 1.0})


def test_a_model_whose_control_step_alone_is_its_own_is_not_compiled(monkeypatch):
    class Weak(Quadrotor):
        def control_step(self, state, action, params, wind):
            return super().control_step(state, 0.5 * action, params, wind)

    monkeypatch.setitem(DYNAMICS, "weak", Weak)
    eager = HoveringEnv(num_envs=1, dynamics="weak")
    refuses("Weak has a control_step of its own, which compiled steps do not call", eager.compile, backend="eager")
