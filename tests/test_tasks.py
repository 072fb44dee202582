"""What tracking, landing and racing observe, reward and end, by numbers worked out here."""

import math

import pytest
import torch
from helpers import cases, fly, hold, refuses, start
from torchrl.envs import check_env_specs

from torchrl_quad import LandingEnv, RacingEnv, TrackingEnv, load_track


def test_the_point_moves_along_the_circle_and_the_next_ten_are_observed():
    env = TrackingEnv(num_envs=4, dtype=torch.float64)
    td = env.reset()
    phase = td["state", "phase"]
    flight = fly(env, td, hold(env, 50))["next", "state"]
    angle = phase.unsqueeze(1) + 0.2 * math.pi * 0.02 * torch.arange(1, 51, dtype=torch.float64).view(1, 50, 1)
    expected = torch.cat((2 + 2 * angle.cos(), 2 * angle.sin(), torch.ones_like(angle)), -1)
    torch.testing.assert_close(flight["target"], expected)
    # In 0.1 s steps: what is the point after 5 control steps is the first point observed now.
    first = td["observation"][:, :3] + td["state", "position"]
    torch.testing.assert_close(first, flight["target"][:, 4])
    tenth = td["observation"][:, 27:30] + td["state", "position"]
    torch.testing.assert_close(tenth, flight["target"][:, 49])
    assert td["observation"].shape == (4, 40)


def test_the_tracking_error_is_the_root_mean_square_since_two_seconds():
    env = TrackingEnv(num_envs=2, dtype=torch.float64)
    flight = fly(env, env.reset(), hold(env, 130))["next"]
    error = flight["metrics", "position_error"]
    rmse = flight["metrics", "tracking_rmse"]
    torch.testing.assert_close(rmse[:, 129], error[:, 100:].square().mean(1).sqrt())
    torch.testing.assert_close(rmse[:, 100], error[:, 100])
    torch.testing.assert_close(rmse[:, 99], error[:, :100].square().mean(1).sqrt())
    assert not rmse.requires_grad


def test_an_episode_of_tracking_succeeds_below_ten_centimetres_without_a_crash():
    def still(phase):
        return torch.stack((torch.zeros_like(phase), torch.zeros_like(phase), 1 + 0.001 * phase.cos()), -1)

    env = TrackingEnv(num_envs=3, curve=still, period=10.0, max_episode_steps=120)
    velocity = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0]]
    td = start(env, position=[[0.0, 0.0, 1.0], [0.2, 0.0, 1.0], [0.0, 0.0, 5.99]], velocity=velocity)
    metrics = env.episode_metrics(fly(env, td, hold(env, 120)))
    assert metrics["solved"].tolist() == [1.0, 0.0, 0.0] and metrics["crash"].tolist() == [0.0, 0.0, 1.0]
    assert metrics["tracking_rmse"][:2].tolist() == pytest.approx([0.0, 0.2], abs=2e-3)


@pytest.mark.parametrize("name", ["slow_circle", "fast_circle", "lemniscate"])
def test_the_named_curves_start_near_their_point_and_inside_their_box(name):
    env = TrackingEnv(num_envs=500, curve=name, seed=2)
    state = env.reset()["state"]
    assert ((state["position"] - state["target"]).abs().amax(0) <= 0.2).all() and state["phase"].min() < 0.1
    assert state["phase"].max() > 2 * math.pi - 0.1 and not env.is_crash(state).any()


def test_a_large_curve_gets_a_box_that_holds_it():
    def large(phase):
        return torch.stack((20 * phase.cos(), 3 * phase.sin(), 8 + 0 * phase), -1)

    env = TrackingEnv(num_envs=3, curve=large, period=60.0)
    positions = torch.tensor([[22.9, 0.0, 8.0], [23.1, 0.0, 8.0], [0.0, 5.9, 8.0]])
    assert env.is_crash({"position": positions}).flatten().tolist() == [False, True, False]


@cases(
    ({"curve": "square"}, "curve must be one of slow_circle, fast_circle, lemniscate, or a .* got 'square'"),
    ({"curve": lambda p: p}, "needs a period in seconds"),
    ({"curve": lambda p: p, "period": 5.0}, r"from shape \(2, 257\) it made \(2, 257\), torch.float32"),
    ({"curve": lambda p: torch.stack((p, p, p), -1).double(), "period": 5.0}, "both torch.float32.* torch.float64"),
    ({"curve": lambda p: [math.cos(p), 0, 1], "period": 5.0}, "it failed: "),
    ({"curve": lambda p: [p, p, p], "period": 5.0}, "it made a list"),
    ({"curve": lambda p: torch.stack((p, p, p + 1), -1), "period": 5.0}, "not periodic: .* moves by 10.9 m"),
    ({"curve": lambda p: torch.stack((p.cos(), p.sin(), p.sin()), -1), "period": 5.0}, "goes down to z = -1 m"),
    ({"curve": lambda p: torch.stack((p / 0, p, p), -1), "period": 5.0}, "not finite"),
)
def test_a_curve_that_cannot_be_flown_is_refused(kwargs, message):
    refuses(message, TrackingEnv, num_envs=1, **kwargs)


def test_the_landing_reward_is_the_published_formula():
    height = torch.tensor([2.0, 2.0, 2.0, 0.5, 0.5, 0.01], dtype=torch.float64)
    descent = torch.tensor([0.5, 1.0, 1.4, 0.4, -3.0, 2.0], dtype=torch.float64)
    distance = torch.tensor([0.0, 0.3, 1.0, 2.0, 0.5, 0.4], dtype=torch.float64)
    env, zero = LandingEnv(num_envs=6, dtype=torch.float64), torch.zeros(6)
    state = env.reset()["state"]
    state["position"] = torch.stack((2.0 + distance, zero, height), -1)
    state["velocity"] = torch.stack((zero, zero, -descent), -1)
    best, e = height.clamp(0.05, 1.0), 1.2
    x = torch.where(descent <= best, descent / best, 5 - 4 * descent / best)
    terms = env.reward_terms(state)
    torch.testing.assert_close(terms["descent"][:, 0], 0.1 * (e**x - 1) / (e - 1))
    torch.testing.assert_close(terms["approach"][:, 0], 0.1 * (e ** (1 - distance / (2 * best)) - 1) / (e - 1))


def test_the_height_that_scales_the_landing_reward_carries_no_gradient():
    """Central differences of the position at a fixed height, and of the velocity."""
    env = LandingEnv(num_envs=1, dtype=torch.float64)
    state = dict(env.reset()["state"].items())
    place = torch.tensor([[2.3, 0.0, 0.5]], dtype=torch.float64, requires_grad=True)
    velocity = torch.tensor([[0.0, 0.0, -0.4]], dtype=torch.float64, requires_grad=True)

    def shaped(place, velocity):
        terms = env.reward_terms({**state, "position": place, "velocity": velocity})
        return (terms["descent"] + terms["approach"]).sum()

    by_place, by_velocity = torch.autograd.grad(shaped(place, velocity), (place, velocity))
    steps = 1e-6 * torch.eye(3, dtype=torch.float64)
    sideways = [(shaped(place + h, velocity) - shaped(place - h, velocity)).item() / 2e-6 for h in steps[:2]]
    falling = [(shaped(place, velocity + h) - shaped(place, velocity - h)).item() / 2e-6 for h in steps]
    assert by_place.flatten().tolist() == pytest.approx([*sideways, 0.0], abs=1e-8)
    assert by_velocity.flatten().tolist() == pytest.approx(falling, abs=1e-8)
    assert (by_place[0, 0].item(), by_velocity[0, 2].item()) == pytest.approx((-0.1036, -0.2110), abs=1e-4)


def test_a_landing_succeeds_crashes_or_does_neither():
    env = LandingEnv(num_envs=9)
    positions = [(2.0, 0.0, 0.15), (2.29, -0.29, 0.19), (2.4, 0.0, 0.1), (2.0, 0.0, 0.1), (2.4, 0.0, -0.01), (2, 0, 3)]
    positions += [(8.0, 0.0, 2.0), (2.0, -5.1, 2.0), (2.0, 0.0, 6.1)]  # beyond its bounds
    velocities = [(0.0, 0.0, -0.2), (0.1, 0.0, 0.0), (0, 0, 0), (0.0, 0.0, -0.5), *5 * [(0, 0, 0)]]
    td = start(env, position=torch.tensor(positions), velocity=torch.tensor(velocities))
    flight = fly(env, td, hold(env, 1))
    ends, success = flight["next"], torch.tensor([True, True] + 7 * [False])
    crash = torch.tensor([False, False, False, False, True, False, True, True, True])
    assert torch.equal(ends["success"].flatten(), success) and torch.equal(ends["crash"].flatten(), crash)
    assert torch.equal(ends["terminated"].flatten(), success | crash)
    torch.testing.assert_close(ends["reward_terms", "success"].flatten(), 20.0 * success)
    torch.testing.assert_close(ends["reward_terms", "crash"].flatten(), -0.1 * crash)
    metrics = env.episode_metrics(flight)
    assert torch.equal(metrics["solved"], success.float()) and torch.equal(metrics["crash"], crash.float())
    assert metrics["landing_speed"].isnan().tolist() == [False] * 5 + [True] * 4
    assert metrics["landing_speed"][3].item() == pytest.approx(0.5, abs=0.05)
    env.success_height = 0.01  # solved, though higher, as on a deck
    speeds = env.episode_metrics(flight)["landing_speed"]
    assert speeds.isnan().tolist() == [False] * 2 + [True] * 2 + [False] + [True] * 4
    assert metrics["position_error"][2].item() == pytest.approx(0.4, abs=0.01)


def test_gates_are_passed_in_order_along_the_straight_line_of_a_step():
    env = RacingEnv(num_envs=4, dtype=torch.float64, reward="position")
    gate = torch.tensor([4.0, 4.0, 1.0], dtype=torch.float64)
    # Fast enough to jump over the gate within one step; beside it; not yet there; through another gate.
    offset = [[-1.0, 0.0, 0.0], [-1.0, 0.35, 0.0], [-2.0, 0.0, 0.0], [4.0 - 1.0, -4.0, 1.0]]
    velocity = torch.tensor([[100.0, 0.0, 0.0]] * 2 + [[1.0, 0.0, 0.0]] + [[100.0, 0.0, 0.0]], dtype=torch.float64)
    td = start(env, position=gate + torch.tensor(offset, dtype=torch.float64), velocity=velocity, gate=0, target=gate)
    state = fly(env, td, hold(env, 1))["next"]
    assert state["state", "gate_passed"].flatten().tolist() == [True, False, False, False]
    assert state["state", "gates_passed"].flatten().tolist() == [1, 0, 0, 0]
    assert state["state", "gate"].flatten().tolist() == [1, 0, 0, 0]
    assert state["state", "target"][0, 0].tolist() == [8.0, 0.0, 2.0]
    assert state["reward_terms", "gate"].flatten().tolist() == [20.0, 0.0, 0.0, 0.0]
    assert state["state", "pass_step"][0, 0].tolist() == [1, -1, -1, -1]


def test_a_lap_is_timed_from_a_gate_to_the_same_gate_and_eight_gates_succeed():
    gates = [[0.1 * i, 0.0, 1.0] for i in range(2)]
    env = RacingEnv(num_envs=1, track={"gates": gates, "gate_radius": 5.0}, max_episode_steps=9)
    flight = fly(env, env.reset(), hold(env, 9))
    ends = flight["next"]
    assert ends["state", "gates_passed"].flatten().tolist() == list(range(1, 10))
    assert ends["metrics", "lap_time"].flatten().tolist() == pytest.approx([0.0, 0.0] + [0.04] * 7)
    assert ends["success"].flatten().tolist() == [False] * 7 + [True] * 2
    metrics = env.episode_metrics(flight)
    assert metrics["solved"].item() == 1.0 and metrics["gates_passed"].item() == 9.0
    assert metrics["lap_time"].item() == pytest.approx(0.04)
    assert metrics["time_near_gate"].item() == pytest.approx(9 * 0.02)  # [s]; both gates are within 1 m all the time
    assert env.episode_metrics(flight[:, :2])["lap_time"].isnan().all()


def test_a_racer_that_breaks_or_crashes_keeps_what_it_has_passed():
    env = RacingEnv(num_envs=2)
    td = start(env, gates_passed=3, step=100, pass_step=[[5, 6, 7, -1]], lap_time=4.0)
    td["action"] = env.hover_action.expand(2, 4).clone()
    td["action"][0] = 1e30
    ends = env.step(td)["next"]
    assert ends["crash"].flatten().tolist() == [True, False]
    assert ends["metrics", "gates_passed"].flatten().tolist() == [3.0, 3.0]
    assert ends["metrics", "lap_time"].flatten().tolist() == [4.0, 4.0]
    assert ends["state", "step"].flatten().tolist() == [101, 101]
    assert ends["state", "pass_step"].tolist() == [[5, 6, 7, -1]] * 2
    low = start(env, gates_passed=9, position=[5.0, 0.0, 0.01], velocity=[0.0, 0.0, -5.0])
    metrics = env.episode_metrics(fly(env, low, hold(env, 1)))  # after eight gates, and without success
    found = {name: metrics[name].tolist() for name in ("solved", "crash", "gates_passed")}
    assert found == {"solved": [0, 0], "crash": [1, 1], "gates_passed": [9, 9]}


def test_starts_face_each_gate_in_turn_and_two_gates_are_observed():
    env = RacingEnv(num_envs=400, seed=1)
    state = env.reset()["state"]
    track = load_track()
    for i in range(4):
        here = state["gate"].flatten() == i
        assert here.sum() > 60 and (state["target"][here] == torch.tensor(track["gates"][i])).all()
        assert ((state["position"][here] - torch.tensor(track["starts"][i])).abs() <= 0.2 + 1e-6).all()
    lap = sum(math.dist(track["gates"][i - 1], track["gates"][i]) for i in range(4))
    assert lap == pytest.approx(21.67, abs=0.01)
    assert not env.is_crash(state).any()
    gates = env.gates[torch.cat((state["gate"], (state["gate"] + 1) % 4), -1)]
    torch.testing.assert_close(env.observe(state)[:, :6], (gates - state["position"].unsqueeze(1)).flatten(1))
    assert env.observe(state).shape == (400, 16)


@pytest.mark.parametrize("gate_bonus", ["binary", "log", "reciprocal"])
@pytest.mark.parametrize("reward", ["position", "velocity"])
def test_the_racing_reward_is_the_published_formula(reward, gate_bonus):
    env = RacingEnv(num_envs=1, reward=reward, gate_bonus=gate_bonus, dtype=torch.float64)
    state = env.reset()["state"]
    state["target"] = torch.tensor([[4.0, 4.0, 1.0]], dtype=torch.float64)
    state["position"] = torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64)  # 5 m away, along (0.6, 0.8, 0)
    state["velocity"] = torch.tensor([[3.0, 0.0, 0.0]], dtype=torch.float64)  # 1.8 m/s towards, 2.4 m/s across
    state["angular_velocity"] = torch.tensor([[0.0, 0.5, 0.0]], dtype=torch.float64)
    state["gate_passed"] = torch.tensor([[True]])
    terms = {name: value.item() for name, value in env.reward_terms(state).items()}
    gate = terms.pop("gate")
    if reward == "position":
        assert sum(terms.values()) == pytest.approx(0.1 - 0.1 / 9 * 5 - 0.002 * 3 - 0.002 * 0.5)
    else:
        assert sum(terms.values()) == pytest.approx(0.02 * 1.8 - 0.02 * 2.4 / 6 - 0.001 * 0.5)
    binary = {"position": 20.0, "velocity": 5.0}[reward]
    assert gate == pytest.approx({"binary": binary, "log": -5 * math.log(5.01), "reciprocal": 1 / 5.05}[gate_bonus])


def test_a_track_comes_from_a_file_and_starts_lie_half_way_by_default(tmp_path):
    (tmp_path / "mine.yaml").write_text("gates: [[0, 0, 1], [4, 0, 2], [4, 4, 7]]\n")
    env = RacingEnv(num_envs=3, track=str(tmp_path / "mine.yaml"))
    assert env.starts.tolist() == [[2.0, 2.0, 4.0], [2.0, 0.0, 1.5], [4.0, 2.0, 4.5]] and env.ceiling == 11.0
    check_env_specs(env)


@cases(
    ("monza", "Unknown track 'monza'. Choose from: airsim, .*, split_s, time_optimal, visfly; or give the path"),
    ({"gates": [[0, 0, 1]]}, "track: a track has 2 to 1000 gates, got 1"),
    ({"gate": []}, "unknown key 'gate'. Allowed: gates, starts, gate_radius"),
    ({}, "gates must be a list of points"),
    ({"gates": [[0, 0, 1], [1, 1, -1]]}, "in metres above ground"),
    ({"gates": [[0, 0, 1], [1, 1, float("nan")]]}, "gates must be a list of points"),
    ({"gates": [[0, 0, 1], [1, 1, 1]], "starts": [[0, 0, 1]]}, "one start before each gate, got 1 for 2"),
    ({"gates": [[0, 0, 1], [1, 1, 1]], "starts": [[0, 0, 1], [9, 9, 1]]}, r"within 0.2 m of \[9.0, 9.0, 1.0\]"),
    ({"gates": [[0, 0, 0.1], [1, 1, 0.1]]}, "not all inside the box"),
    ({"gates": [[0, 0, 1], [5, 0, 1]], "box": [[1, -1, 0], [4, 1, 2]]}, "gates stand from .*0.0, 0.0, 1.0.*"),
    ({"gates": [[0, 0, 1], [5, 0, 1]], "position_jitter": [0, 0, 2]}, r"gates stand from \[0.0, 0.0, -1.0\] to "),
    ({"file": "random", "position_jitter": [0, 0, 2]}, r"gates stand from \[-12.0, -12.0, -1.0\] to "),
    ({"gates": [[0, 0, 1], [1, 1, 1]], "gate_radius": 0}, "gate_radius must be at least 0.01, got 0. Of all gates"),
)
def test_a_track_that_nobody_can_fly_is_refused(track, message):
    refuses(message, RacingEnv, num_envs=1, track=track)
