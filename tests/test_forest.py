"""What the forest rewards, ends and measures, by numbers worked out here; and where obstacles may stand."""

import math

import pytest
import torch
from refusals import cases
from tensordict import TensorDict

from torchrl_quad import ForestEnv, HoveringEnv
from torchrl_quad.vision.primitives import distances

POLE = {"ground": True, "cylinders": [{"base": [5.0, 0.0, 0.0], "radius": 0.2, "height": 6.0}]}


def forest(*positions, **entries):
    """Drones of 4 m/s in a scene of one pole, at these places, and their state with some entries set."""
    env = ForestEnv(num_envs=len(positions), scene=POLE, camera=None, speed=4.0, dtype=torch.float64)
    state = dict(env.reset()["state"].items())
    for key, value in {"position": positions, "target": [32.0, 0.0, 1.5], **entries}.items():
        state[key] = torch.as_tensor(value, dtype=state[key].dtype).expand_as(state[key])
    return env, state


def test_the_reward_of_the_forest_is_its_formula():
    turn = 0.3  # [rad], to the left
    env, state = forest(
        [4.0, 0.0, 1.5],  # 1 m before the middle of the pole
        velocity=[3.0, 0.0, 0.0],
        angular_velocity=[0.0, 0.5, 0.0],
        quaternion=[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)],
    )
    distance = 0.8 - env.scene.radius

    def gentle(x):
        return math.sqrt(x * x + 0.25) - 0.5

    expected = {
        "speed": 0.1 * (1.0 - gentle(1.0) / gentle(4.0)),
        "clearance": -0.1 * math.log(1.0 + math.exp((0.3 - distance) / 0.1)),
        "closing": -0.15 * 3.0 * math.exp(-distance / 0.5),
        "smoothness": -0.005 * 0.25,
        "heading": -0.05 * (1.0 - math.cos(turn)),
        "collision": 0.0,
        "finish": 0.0,
    }
    terms = {name: term.item() for name, term in env.reward_terms(state).items()}
    assert terms == pytest.approx(expected, rel=1e-9)
    away = env.reward_terms({**state, "velocity": -state["velocity"]})  # from the pole, which costs nothing
    assert away["closing"].item() == 0.0
    assert away["speed"].item() == pytest.approx(0.1 * (1.0 - gentle(7.0) / gentle(4.0)))


def test_a_flight_through_the_forest_ends_where_the_docstring_says():
    inside = [-4.9, 7.9, 3.9], [-4.9, -7.9, 0.2], [29.9, 0.0, 1.5]
    outside = [-5.1, 0.0, 1.5], [3.0, 8.1, 1.5], [3.0, -8.1, 1.5], [3.0, 0.0, 4.1], [3.0, 0.0, 0.1], [31.0, 8.1, 1.5]
    finished, touching = [30.0, -7.9, 1.5], [31.0, 0.0, 1.5]
    places = [*inside, *outside, finished, touching]
    env, state = forest(*places, collided=torch.tensor([place is touching for place in places]).unsqueeze(1))
    assert 0.1 < env.scene.radius < 0.2
    crash, success = env.is_crash(state).flatten(), env.is_success(state).flatten()
    assert crash.tolist() == 3 * [False] + 6 * [True] + [False, True]
    assert success.tolist() == 9 * [False] + [True, False]
    terms = env.reward_terms(state)
    assert terms["collision"].flatten().tolist() == pytest.approx((-10.0 * crash).tolist())
    assert terms["finish"].flatten().tolist() == pytest.approx((10.0 * success).tolist())


def test_the_metrics_of_the_forest_are_measured_by_the_way_to_the_target():
    env, state = forest([4.0, 0.0, 1.5], [-2.0, 0.0, 1.5], [31.0, 0.0, 1.5], velocity=[3.0, 2.0, 1.0])
    measured = {name: value.flatten().tolist() for name, value in env.metrics(state).items()}
    assert measured["distance"] == [4.0, 0.0, 30.0] and measured["flown_speed"] == pytest.approx(3 * [3.0])
    radius = env.scene.radius
    assert measured["clearance"] == pytest.approx([0.8 - radius, 1.5 - radius, 1.5 - radius])  # pole, ground, ground


def test_an_episode_of_the_forest_has_the_mean_speed_and_the_least_clearance_until_its_end():
    """Of two drones: one crashes in its third step, and what follows counts no more; one flies to the end."""
    env = ForestEnv(num_envs=2, camera=None, density=0.0, dtype=torch.float64)
    crash = torch.tensor([[False, False, True, False], [False, False, False, False]]).unsqueeze(-1)
    ends = {
        "reward": torch.ones(2, 4, 1, dtype=torch.float64),
        "done": crash,
        "crash": crash,
        "success": torch.tensor([[True] * 4, [False, False, False, True]]).unsqueeze(-1),
        "metrics": {
            "distance": [[1, 2, 3, 0], [4, 5, 6, 30]],
            "flown_speed": [[1, 2, 6, 50], [2, 4, 6, 8]],
            "clearance": [[0.9, 0.4, 0.7, 0.1], [0.8, 0.6, 0.5, 0.3]],
        },
    }
    ends["metrics"] = {name: env.tensor(x).unsqueeze(-1) for name, x in ends["metrics"].items()}
    metrics = env.episode_metrics(TensorDict({"next": ends}, [2, 4]))
    expected = {"return": [3, 4], "crash": [1, 0], "solved": [0, 1], "distance": [3, 30]}
    expected |= {"flown_speed": [3.0, 5.0], "clearance": [0.4, 0.3]}
    assert {name: value.tolist() for name, value in metrics.items()} == expected


@cases(
    ("cylinders", {"radius": [0.1, 0.3], "height": 5.0}),
    ("spheres", {"radius": [0.1, 0.3]}),
    ("boxes", {"size": [[0.2, 0.2, 0.2], [0.6, 0.6, 0.6]], "yaw": [-3.0, 3.0]}),
)
def test_random_obstacles_keep_clear_of_the_start_and_of_the_target(kind, size):
    scene = {kind: [{"count": 8, "low": [-2.0, -2.0, 0.0], "high": [2.0, 2.0, 3.0], **size}], "clearance": 0.5}
    env = HoveringEnv(num_envs=50, scene=scene, dtype=torch.float64)
    state = dict(env.sample_start(50)["state"].items(include_nested=True, leaves_only=True))
    kept = torch.stack((state["position"], state["target"]), 1)
    gaps = distances(env.scene.solids(state), kept).min()
    assert env.scene.radius + 0.5 <= gaps < env.scene.radius + 0.55  # some stand as near as they may


def test_critics_read_how_far_the_nearest_obstacle_is_and_where_it_is_not():
    half = math.sqrt(0.5)
    env = HoveringEnv(num_envs=1, scene=POLE, dtype=torch.float64)
    td = env.reset()
    td["state", "position"] = torch.tensor([[4.0, 0.0, 2.0]], dtype=torch.float64)
    td["state", "quaternion"] = torch.tensor([[half, 0.0, 0.0, half]], dtype=torch.float64)  # to the left, along y
    seen = env.reset(td, set_state=True)["obstacle"]
    assert seen.flatten().tolist() == pytest.approx([0.8 - env.scene.radius, 0.0, 1.0, 0.0], abs=1e-9)
