"""Scenes and cameras in tasks, and the forest: steps, gradients, restored states, rewards, metrics, refusals."""

import base64
import json
import math
import re

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from helpers import cases, refuses, start
from PIL import Image
from stable_baselines3 import PPO
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import DoubleToFloat, TransformedEnv, check_env_specs

from torchrl_quad import ActionSequence, DepthCamera, ForestEnv, HoveringEnv, LandingEnv, differentiable_rollout
from torchrl_quad.adapters import DronesVecEnv
from torchrl_quad.render import animate_flight, plot_flight, write_replay
from torchrl_quad.vision import Primitives, nearest
from torchrl_quad.vision.primitives import distances

PILLARS = {"ground": True, "cylinders": [{"base": [3.0, 0.0, 0.0], "radius": 0.2, "height": 3.0}]}
PILLARS["cylinders"] += [{"count": 4, "low": [-3, -3, 0], "high": [4, 3, 0], "radius": [0.1, 0.3], "height": [2, 4]}]
OPTIONS = {"wind": {"gust": 0.5}, "randomize": {"mass": {"scale": [0.9, 1.1]}}, "observation_noise": {"velocity": 0.1}}


def fly(env, actions):
    return differentiable_rollout(env, ActionSequence(actions), env.reset(), len(actions))[0]


def commands(env, steps, spread=0.2):
    n = env.num_envs
    random = torch.randn(steps, n, 4, generator=torch.Generator().manual_seed(0), dtype=env.dtype)
    return (env.hover_action.expand(steps, n, 4) + spread * random).requires_grad_()


@pytest.mark.slow  # a minute and more of compiling
def test_a_compiled_step_sees_what_an_eager_one_sees_with_the_same_gradients():
    camera = {"width": 6, "height": 4, "rate": 2, "delay": 3, "noise": 0.02, "dropout": 0.1, "differentiable": True}
    made = {"num_envs": 4, "camera": camera, "dtype": torch.float64, "density": 0.02, "max_episode_steps": 6, **OPTIONS}
    flown = []
    for compiled in (False, True):
        env = ForestEnv(**made, compile=compiled)
        actions = commands(env, 9)
        rollout = fly(env, actions)
        (rollout["next", "reward"].sum() + (rollout["next", "depth"] * torch.arange(6)).sum()).backward()
        flown.append((rollout.detach(), actions.grad))
    (eager, slope), (fused, fused_slope) = flown
    assert eager["next", "done"].any()
    for key, x in eager.items(True, True):
        torch.testing.assert_close(fused[key], x, atol=1e-9, rtol=1e-9, msg=lambda m, key=key: f"{key}: {m}")
    torch.testing.assert_close(fused_slope, slope, atol=1e-10, rtol=1e-7)
    assert slope.abs().max() > 1e-3


def test_fused_rays_are_the_same():
    env = HoveringEnv(num_envs=3, scene=PILLARS, camera={"width": 16, "height": 5, "pitch": -0.5})
    state = env.sample_start(3)["state"]
    solids = env.scene.solids({("scene", "cylinders"): state["scene", "cylinders"]})
    seen = [env.camera.depth(solids, state["position"], state["quaternion"], fused=x) for x in (False, True)]
    torch.testing.assert_close(*seen, atol=1e-4, rtol=1e-5)
    assert seen[0].unique().numel() > 20


def test_gradients_of_rewards_and_images_are_those_of_finite_differences():
    camera = {"width": 6, "height": 4, "differentiable": True}
    env = ForestEnv(num_envs=3, camera=camera, dtype=torch.float64, density=0.05, random_start={"velocity": 3.0})
    start = env.reset()
    # In the middle of the forest, where clearance and closing speed count.
    state = start["state"].clone()
    state["position"][:, 0] += 8.0
    flat = {("scene", "cylinders"): state["scene", "cylinders"], "position": state["position"]}
    while (env.scene.nearest(flat)[0] <= 0.1).any():
        state["position"][:, 1] += 0.1
    start = env.reset(start.set("state", state), set_state=True)
    weights = torch.rand(3, 8, 1, 4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def objective(actions):
        rollout, _ = differentiable_rollout(env, ActionSequence(actions), start, 8)
        return rollout["next", "reward"].sum() + 1e-2 * (weights * rollout["next", "depth"]).sum()

    actions = commands(env, 8, 0.05)
    (slope,) = torch.autograd.grad(objective(actions), actions)
    direction = torch.randn(8, 3, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    change = (objective(actions + 1e-6 * direction) - objective(actions - 1e-6 * direction)) / 2e-6
    assert change.item() == pytest.approx((slope * direction).sum().item(), rel=1e-4)


def test_images_are_taken_at_the_rate_and_seen_after_the_delay():
    late = HoveringEnv(num_envs=2, scene=PILLARS, camera={"width": 5, "height": 4, "rate": 3, "delay": 4})
    prompt = HoveringEnv(num_envs=2, scene=PILLARS, camera={"width": 5, "height": 4})
    actions = commands(late, 20).detach()
    start = late.reset()
    rollout, _ = differentiable_rollout(late, ActionSequence(actions), start, 20)
    truth, ends = [start["state", "images"][:, -1:]], rollout["next", "state"]
    for t in range(20):
        solids = prompt.scene.solids({("scene", "cylinders"): ends["scene", "cylinders"][:, t]})
        truth.append(prompt.camera.depth(solids, ends["position"][:, t], ends["quaternion"][:, t]))
    truth = torch.cat(truth, 1)
    for t in range(1, 21):
        taken = max(0, (t - 4) // 3 * 3)
        torch.testing.assert_close(rollout["next", "depth"][:, t - 1, 0], truth[:, taken])
    assert (truth[:, 0] - truth[:, -1]).abs().max() > 0.01
    # A restored state has its images, and goes on alike.
    again = late.reset(rollout[:, 7].select("state").clone(), set_state=True)
    torch.testing.assert_close(again["depth"], rollout["depth"][:, 7], atol=0, rtol=0)
    rest, _ = differentiable_rollout(late, ActionSequence(actions[7:]), again, 13)
    torch.testing.assert_close(rest["next", "depth"], rollout["next", "depth"][:, 7:], atol=0, rtol=0)


def test_each_episode_has_another_forest_that_keeps_its_gaps_and_is_restored_with_the_state():
    env = ForestEnv(num_envs=6, difficulty="hard", max_episode_steps=3, camera={"noise": 0.01, "rate": 2})
    check_env_specs(env)
    first, again = env.reset(), ForestEnv(num_envs=6, difficulty="hard", camera={"noise": 0.01, "rate": 2}).reset()
    env.set_seed(0)
    torch.testing.assert_close(env.reset()["state"], again["state"])
    trees = first["state", "scene", "cylinders"]
    assert trees.shape == (6, 58, 5)
    apart = torch.cdist(trees[..., :2], trees[..., :2]) - trees[..., 3:4] - trees[..., 3].unsqueeze(1)
    present = trees[..., 2] == 0.0
    assert (apart[present[:, :, None] & present[:, None] & ~torch.eye(58, dtype=torch.bool)] >= 0.9 - 1e-4).all()
    assert present.float().mean() > 0.98
    assert (trees[present][:, :2] - torch.tensor([15.0, 0.0])).abs().amax(0).tolist() < [15.0, 8.0]
    rollout = env.rollout(5, break_when_any_done=False)
    forests = rollout["state", "scene", "cylinders"]
    assert (forests[:, 0] == forests[:, 2]).all() and (forests[:, 3] != forests[:, 2]).any(-1).any(-1).all()
    back = env.reset(rollout[:, 1].select("state").clone(), set_state=True)
    torch.testing.assert_close(back["depth"], rollout["depth"][:, 1], atol=0, rtol=0)


def test_a_drone_crashes_into_what_stands_in_its_way_and_through_the_finish_it_succeeds():
    pole = {"cylinders": [{"base": [5.0, 0.0, 0.0], "radius": 0.02, "height": 3.0}]}
    env = ForestEnv(num_envs=2, scene=pole, camera=None, action_delay=0)
    velocity = [[60.0, 0.0, 0.0], [10.0, 0.0, 0.0]]  # 1.2 m in one step: right through it
    td = start(env, position=[[4.6, 0.0, 1.5], [29.9, 0.0, 1.5]], velocity=velocity)
    step = env.step(td.set("action", env.hover_action.expand(2, 4)))["next"]
    assert (step["state", "position"][0, 0] > 5.5).item(), "it is far behind the pole at the end of the step"
    assert step["crash"].flatten().tolist() == [True, False]
    assert step["state", "collided"].flatten().tolist() == [True, False]
    assert step["success"].flatten().tolist() == [False, True] and step["terminated"].all()
    assert step["reward_terms", "collision"].flatten().tolist() == [-10.0, 0.0]
    assert step["reward_terms", "finish"].flatten().tolist() == [0.0, 10.0]


def test_a_camera_is_an_option_of_every_task_and_works_under_transforms():
    env = LandingEnv(num_envs=2, camera=DepthCamera(width=4, height=3, pitch=-1.2), dtype=torch.float64)
    state = env.reset()["state"]
    state["position"] = state["position"] * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 0.05])
    td = env.reset(env.reset().set("state", state), set_state=True)
    assert not env.step(td.set("action", env.hover_action.expand(2, 4)))["next", "crash"].any(), "ground is to land on"
    env = TransformedEnv(HoveringEnv(num_envs=2, scene=PILLARS, camera={}, dtype=torch.float64), DoubleToFloat())
    check_env_specs(env)
    policy = TensorDictModule(lambda x: x.mean((-1, -2)).expand(-1, 4) * 0.0, in_keys=["depth"], out_keys=["action"])
    rollout, _ = differentiable_rollout(env, policy, env.reset(), 3)
    assert rollout["next", "depth"].dtype == torch.float32 and rollout["next", "depth"].shape == (2, 3, 1, 12, 16)


def test_a_fixed_scene_comes_from_a_file_and_stands_in_no_state(tmp_path):
    room = "walls: [{point: [8, 0, 0], normal: [-2, 0, 0]}]\nspheres: [{centre: [3, 1, 2], radius: 0.3}]\n"
    (tmp_path / "room.yaml").write_text(room + "boxes: [{centre: [3, -2, 0.5], size: [1, 1, 1], yaw: 0.7}]\n")
    env = HoveringEnv(num_envs=2, scene=str(tmp_path / "room.yaml"), camera={})
    assert "scene" not in env.reset()["state"].keys()  # noqa: SIM118, a tensordict
    solids = env.scene.solids({})
    assert isinstance(solids, Primitives)
    assert nearest(solids, torch.tensor([[7.0, 5.0, 4.0]]))[0].item() == pytest.approx(1.0)


@cases(
    (lambda: HoveringEnv(scene={"spheres": [{"centre": [1, 0, 1.5], "radius": 1.0}]}), "drones would start there"),
    (lambda: HoveringEnv(camera={"position": (0.5, 0, 0)}), "the camera could be inside an obstacle"),
    (lambda: ForestEnv(gap=0.2), "does not fit through gaps of 0.2 m"),
    (lambda: ForestEnv(density=10.0), "density must be at most 2, got 10.0"),
    (lambda: ForestEnv(speed=(5.0, 2.0)), "speed must be one speed"),
    (lambda: ForestEnv(difficulty="wild"), "difficulty must be 'easy', 'middle' or 'hard', got 'wild'. How dense"),
    (lambda: HoveringEnv(scene={}), "a scene needs an obstacle or the ground: give it one"),
    (lambda: HoveringEnv(scene={"ground": True, "clearance": 1.0}), "clearance is of obstacles with a count"),
    (lambda: HoveringEnv(scene={"trees": []}), "scene: unknown key 'trees'. Allowed: ground"),
    (lambda: HoveringEnv(scene={"spheres": [{"centre": [1, 0], "radius": 1}]}), "centre must be 3 numbers"),
    (lambda: HoveringEnv(scene={"spheres": [{"centre": [1, 0, 1]}]}), "missing: radius"),
    (lambda: HoveringEnv(camera={"fov": 1.0}), "camera: unknown key 'fov'. Allowed: width"),
)
def test_scenes_that_cannot_be_flown_are_refused(make, message):
    refuses(message, make)


def test_a_state_within_an_obstacle_is_not_restored():
    env = HoveringEnv(num_envs=2, scene=PILLARS)
    td = env.reset()
    td["state", "position"][1] = torch.tensor([3.0, 0.0, 1.0])
    refuses(r"environments 1: an obstacle stands within 0.128 m of 'position'", env.reset, td, set_state=True)
    assert math.isclose(env.scene.radius, 0.128, abs_tol=1e-3)


def test_stable_baselines3_learns_from_images_and_vectors_of_a_gymnasium_environment():
    options = {"autoreset_mode": "SameStep", "max_episode_steps": 3, "camera": {"rate": 2}}
    drones = gymnasium.make_vec("torchrl_quad/Forest-v0", num_envs=4, **options)
    observation, _ = drones.reset(seed=0)
    assert drones.observation_space.contains(observation)
    assert {name: x.shape for name, x in observation.items()} == {"observation": (4, 9), "depth": (4, 1, 12, 16)}
    ppo = PPO("MultiInputPolicy", DronesVecEnv(drones), n_steps=4, batch_size=8, n_epochs=1, device="cpu", seed=0)
    before = [x.clone() for x in ppo.policy.parameters()]
    ppo.learn(32)
    assert any((x != y).any() for x, y in zip(ppo.policy.parameters(), before, strict=True))
    check_env(gymnasium.make("torchrl_quad/Forest-v0").unwrapped, skip_render_check=True)


def test_pictures_show_the_obstacles_and_beside_the_flight_what_the_camera_saw(tmp_path):
    env = ForestEnv(num_envs=2, density=0.02, camera={"rate": 2})
    rollout = env.rollout(4, break_when_any_done=False)
    replay = write_replay(rollout, env=env)
    page = json.loads(re.search(r'id="flight">(.*?)</script>', replay.html, re.DOTALL)[1])
    seen = np.frombuffer(base64.b64decode(page["images"]["data"]), np.uint8).reshape(2, 5, 12, 16)
    depth = torch.cat((rollout["depth"][:, :1], rollout["next", "depth"]), 1).squeeze(2).numpy()
    order = np.argsort(depth.flatten(), kind="stable")
    assert (np.diff(seen.flatten()[order].astype(int)) <= 0).all(), "the nearer the brighter"
    assert np.unique(seen).size > 10
    trees = [(x[:, 2] == 0.0).sum().item() for x in rollout["state", "scene", "cylinders"][:, 0]]
    meshes = [np.frombuffer(base64.b64decode(x["points"]), "<f4").reshape(-1, 3) for x in page["obstacles"]]
    assert [len(mesh) for mesh in meshes] == [96 * count for count in trees]
    panels = plot_flight(rollout, tmp_path / "above.png", env=env, view="above").axes[:2]
    assert [len(panel.patches) for panel in panels] == trees
    assert panels[0].patches[0].get_radius() == rollout["state", "scene", "cylinders"][0, 0, 0, 3].item()
    animate_flight(rollout, tmp_path / "film.gif", env=env, size=200)
    with Image.open(tmp_path / "film.gif") as film:
        corner = np.asarray(film.convert("RGB"))[:50, 132:].astype(int)
    assert (corner.max(-1) - corner.min(-1) > 30).mean() > 0.2, "an image in the corner, in its colours"
    before = env.render(size=150)
    env.reset()
    assert (env.render(size=150) != before).mean() > 0.01, "another episode, another forest"


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

    expected = {"speed": 0.1 * (1.0 - gentle(1.0) / gentle(4.0)), "heading": -0.05 * (1.0 - math.cos(turn))}
    expected["clearance"] = -0.1 * math.log(1.0 + math.exp((0.3 - distance) / 0.1))
    expected["closing"] = -0.15 * 3.0 * math.exp(-distance / 0.5)
    expected |= {"smoothness": -0.005 * 0.25, "collision": 0.0, "finish": 0.0}
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
    success = torch.tensor([[True] * 4, [False, False, False, True]]).unsqueeze(-1)
    ends = {"reward": torch.ones(2, 4, 1, dtype=torch.float64), "done": crash, "crash": crash, "success": success}
    measured = {"distance": [[1, 2, 3, 0], [4, 5, 6, 30]], "flown_speed": [[1, 2, 6, 50], [2, 4, 6, 8]]}
    measured["clearance"] = [[0.9, 0.4, 0.7, 0.1], [0.8, 0.6, 0.5, 0.3]]
    ends["metrics"] = {name: env.tensor(x).unsqueeze(-1) for name, x in measured.items()}
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
    gaps = distances(env.scene.solids(state), torch.stack((state["position"], state["target"]), 1)).min()
    assert env.scene.radius + 0.5 <= gaps < env.scene.radius + 0.55  # some stand as near as they may


def test_critics_read_how_far_the_nearest_obstacle_is_and_will_be_and_where_it_is_not():
    half = math.sqrt(0.5)
    env = HoveringEnv(num_envs=1, scene=POLE, dtype=torch.float64)
    to_the_left = [half, 0.0, 0.0, half]  # along y
    state = start(env, position=[4.0, 0.0, 2.0], quaternion=to_the_left, velocity=[0.6, 0.0, 0.0])
    gap, direction = [0.8 - env.scene.radius], [0.0, 1.0, 0.0]
    later = [distance - env.scene.radius for distance in (0.65, 0.5, 0.2)]  # in 0.25, 0.5 and 1 s
    assert state["obstacle"].flatten().tolist() == pytest.approx([*gap, *direction, *later], abs=1e-9)
