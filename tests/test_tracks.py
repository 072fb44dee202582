"""Gates with a shape and a direction, tracks of other projects, and tracks that each episode draws."""

import math

import numpy as np
import pytest
import torch
from helpers import cases, fly, hold, refuses, start
from torchrl.envs import check_env_specs

from torchrl_quad import RacingEnv, load_track, random_track
from torchrl_quad.envs.gates import around, bar_distance, beyond_edges
from torchrl_quad.envs.track import forward

OPEN = {"width": 2.0, "height": 1.0}
BOTH_WAYS = [{"position": [0, 0, 3], "yaw": 0.0}, {"position": [0, 0, 3], "yaw": math.pi}]


def one_step(track, position, velocity, **entries):
    env = RacingEnv(num_envs=len(position), track=track, dtype=torch.float64, action_delay=0)
    td = start(env, position=position, velocity=velocity, gate=0, target=[0.0, 0.0, 3.0], **entries)
    return env, fly(env, td, hold(env, 1))["next"]


def test_a_gate_is_passed_in_its_direction_and_within_its_opening_only():
    ways = {  # relative to the centre, in m: where a step of 0.2 m begins along x, y, z, and its direction along x
        (-0.1, 0.9, 0.0): (1, "all"), (-0.1, 1.1, 0.0): (1, ""), (-0.1, 0.0, 0.45): (1, "all"),
        (-0.1, 0.0, 0.55): (1, "round"), (-0.1, 0.9, 0.45): (1, "square"), (0.1, 0.0, 0.0): (-1, ""),
        (-0.3, 0.0, 0.0): (1, ""), (0.05, 0.0, 0.0): (1, ""),
    }  # fmt: skip
    position = [[x, y, 3.0 + z] for x, y, z in ways]
    velocity = [[10.0 * sign, 0.0, 0.0] for sign, _ in ways.values()]
    for kind, shape in (("square", OPEN), ("round", {"radius": 1.0})):
        _, ends = one_step({"gates": BOTH_WAYS, **shape}, position, velocity)
        expected = [who in ("all", kind) for _, who in ways.values()]
        assert ends["state", "gate_passed"].flatten().tolist() == expected
        assert ends["state", "gate"].flatten().tolist() == [int(x) for x in expected]
        crosses = [x == -0.1 for x, _, _ in ways]
        pays = [1 if passed else -1 if crossed else 0 for passed, crossed in zip(expected, crosses, strict=True)]
        assert ends["reward_terms", "gate"].flatten().sign().tolist() == pays
    _, ends = one_step({"gates": BOTH_WAYS[::-1], **OPEN}, position, velocity)  # the same place from the other side
    assert ends["state", "gate_passed"].flatten().tolist() == [sign < 0 for sign, _ in ways.values()]
    windows = [{"position": [0, y, 3], "yaw": 0.0} for y in (0, 4)]  # in one wall, where one is passed the other is not
    _, ends = one_step({"gates": windows, **OPEN}, position[:1], velocity[:1])
    assert ends["reward_terms", "gate"].flatten().tolist() == [5.0]


def test_the_reward_of_a_gate_with_a_direction_is_how_fast_the_way_around_into_it_gets_shorter():
    env = RacingEnv(num_envs=40, track={"gates": BOTH_WAYS, **OPEN}, dtype=torch.float64, seed=1)
    generator = torch.Generator().manual_seed(0)
    state = dict(env.reset()["state"].items())
    off, velocity = 4.0 * torch.randn(2, 40, 3, generator=generator, dtype=torch.float64)
    state |= {"position": state["target"] + off, "velocity": velocity}

    def way(position):
        led, _, _ = env.lead({**state, "position": position})
        return (led["position"] - led["target"]).norm(dim=-1) - led["target"][:, 0]

    step = 1e-6 * velocity
    shorter = (way(state["position"] - step) - way(state["position"] + step)) / 2e-6
    found = env.reward_terms(state)["towards"][:, 0] / 0.02
    torch.testing.assert_close(found, shorter.clamp_max(15.0), rtol=1e-5, atol=1e-5)
    assert 5 < (env.lead(state)[0]["position"][:, 0] > 0).sum() < 35  # beyond the gate
    ahead = forward(env.rotations)[state["gate"][:, 0]]
    still = {**state, "position": state["target"] + 0.3 * ahead, "velocity": -ahead}
    assert (env.reward_terms(still)["towards"] > 0.0).all()  # beyond a missed gate the reward leads back
    near = {**state, "position": state["target"] - 0.1 * ahead}
    for speed, lead in ((0.0, -0.4), (2.0, 0.0)):  # before its plane, and not onto it, half of the opening from there
        led = env.lead({**near, "velocity": speed * ahead})[0]["target"]
        torch.testing.assert_close(led[:, 0], torch.full_like(led[:, 0], lead))


def test_a_drone_that_could_hardly_stop_before_a_crash_pays_and_the_cost_pushes_it_away():
    gates = [[-2, 0, 3], [2, 0, 3]]  # the box ends at x = -6 and 6, y = -4 and 4, z = 0 and 7
    scene = {"spheres": [{"centre": [0, -3, 3], "radius": 0.9}], "drone_radius": 0.1}
    env = RacingEnv(num_envs=6, track={"gates": gates, "scene": scene}, weights={"closing": 0.5}, dtype=torch.float64)
    state = dict(env.reset()["state"].items())
    position = [[4, 0, 3], [4, 0, 3], [4, 0, 3], [5, 3, 3], [0, 0, 0], [0, 0, 3]]  # the last is 2 m before the sphere
    velocity = [[10, 0, 0], [-10, 0, 0], [7, 0, 0], [10, 10, 0], [0, 0, -1], [0, -10, 0]]
    braking = [25, 1, 1, 50 * 50 / 15, 1, 25]  # [m/s2], v^2 / (2 d); of two sides; 1 where it costs nothing
    state |= {"position": torch.tensor(position).double().requires_grad_(), "velocity": torch.tensor(velocity).double()}
    cost = env.reward_terms(state)["closing"].flatten()
    torch.testing.assert_close(cost, -0.5 * (torch.tensor(braking).double() / 15).clamp_min(1.0).log())
    (push,) = torch.autograd.grad(cost.sum(), state["position"])
    torch.testing.assert_close(push[3], torch.tensor([-0.5, -0.5, 0.0]).double())
    assert push[0, 0] < 0.0 and push[5, 1] > 0.0 and not push[[1, 2, 4]].any()
    assert "closing" in RacingEnv(track={"gates": BOTH_WAYS, **OPEN}).reset()["reward_terms"]
    assert "closing" not in RacingEnv(track={"gates": gates}).reset()["reward_terms"]


POLE = {"cylinders": [{"base": [-2, 0, 0], "radius": 0.1, "height": 6.0}], "drone_radius": 0.1}
FOUR_SIDES, ROUND = {"width": 1.0, "height": 0.8}, {"radius": 0.5}


def test_the_reward_leads_around_a_pole_that_is_in_the_way_from_wherever_a_drone_comes():
    track = {"gates": BOTH_WAYS, **OPEN, "scene": POLE}
    refuses("this track has obstacles, and scene has others. Write yours into", RacingEnv, track=track, scene=POLE)
    scene = RacingEnv(track=track).scene

    def obstacle(points):
        return scene.nearest({"position": points})

    aside = torch.cat((torch.zeros(2, 400, 1), torch.rand(2, 400, 2) * 1.2 - 0.6), -1)
    starts, ends = aside + torch.tensor([[[-8.0, 0.0, 3.0]], [[-1.0, 0.0, 3.0]]])
    gap = (ends - starts).norm(dim=-1, keepdim=True)
    ahead, least, place = (ends - starts) / gap, torch.full((400, 1), 9.0), starts
    turned = around(starts, ahead, gap, 0.2, obstacle)
    torch.testing.assert_close(turned.norm(dim=-1), torch.ones(400))
    points = starts.unsqueeze(1) + torch.linspace(0.0, 1.0, 401).reshape(-1, 1) * (gap * ahead).unsqueeze(1)
    straight = obstacle(points)[0].amin((1, 2))
    assert torch.equal(turned[straight > 0.2], ahead[straight > 0.2])
    for _ in range(200):  # fly where it leads
        left = (ends - place).norm(dim=-1, keepdim=True).clamp_min(1e-3)
        place = place + around(place, (ends - place) / left, left, 0.2, obstacle) * left.clamp_max(0.05)
        least = least.minimum(obstacle(place)[0])
    assert (place - ends).norm(dim=-1).max() < 0.1 and (straight < 0.0).sum() > 40 and least.min() > 0.0

    start, along = torch.tensor([[-2.5, 0.03, 3.0], [-2.25, 0.0, 3.0]]), torch.tensor([[1.0, 0.0, 0.0]]).repeat(2, 1)
    turned = around(start, along, torch.tensor([[6.0], [0.05]]), 0.2, obstacle)
    assert turned[0, 1] > 0.5 and turned[0, 2] == 0.0  # to the left, and not up the pole
    torch.testing.assert_close(turned[1], along[1])  # it stands behind where the way ends


@cases((FOUR_SIDES,), (ROUND,))
def test_the_distance_from_bars_is_that_from_their_points_and_the_direction_is_its_gradient(opening):
    sizes = torch.tensor([[opening["radius"]] if "radius" in opening else [0.5, 0.4]])
    special = [[0, 0, 0], [0, 1e-9, 0], [0, 0.3, 0.3], [0, 0.55, 0.55], [0, 0.55, 0.45], [1, 0, 0]]
    place = torch.cat((torch.tensor(special), 0.5 * torch.randn(1000, 3))).requires_grad_()
    found, away = bar_distance(place, sizes, 0.2)
    (slope,) = torch.autograd.grad(found[6:].sum(), place)
    torch.testing.assert_close(slope[6:], away[6:], rtol=1e-4, atol=1e-4)
    grid = torch.cartesian_prod(torch.linspace(-0.1, 0.1, 21), *2 * [torch.linspace(-0.7, 0.7, 141)])
    beyond = beyond_edges(grid[:, 1:], sizes)
    bars = grid[((beyond > -1e-4).any(-1)) & (beyond < 0.2001).all(-1)]
    least = torch.cdist(place.detach(), bars).amin(1, keepdim=True)
    torch.testing.assert_close(found.clamp_min(0.0), least.where(found > 0.0, 0.0), rtol=0.0, atol=0.012)
    assert (least[found < 0.0] < 0.012).all() and (found < 0.0).sum() > 5


def test_touching_a_frame_is_a_crash_from_wherever_it_comes():
    position = torch.tensor([[-0.1, 0, 3], [-0.1, 1.05, 3], [0, 0, 3.9], [-0.1, 2, 3], [-0.1, 0, 3.4], [0.5, 1.1, 3]])
    velocity = torch.tensor([[10.0, 0, 0], [10, 0, 0], [0, 0, -10], [10, 0, 0], [10, 0, 0], [0, 10, 0]])
    touching = [False, True, True, False, True, False]  # in the middle; a bar; from above; outside; by its side; before
    for gates, frame in ((BOTH_WAYS, 0.1), (BOTH_WAYS, 0.0)):
        track = {"gates": gates, **OPEN, **({"frame": frame} if frame else {})}
        env, ends = one_step(track, position.double(), velocity.double())
        assert 0.1 < env.drone_radius < 0.35  # so that 0.1 m from an edge is too near, and 0.5 m is not
        assert ends["crash"].flatten().tolist() == [bool(frame) and x for x in touching]
        assert ends["crash"].equal(ends["terminated"])
        assert (ends["reward_terms", "gate"].flatten()[2] < 0.0) == bool(frame)  # before the plane, a miss all the same


def test_an_open_track_ends_at_its_last_gate_and_times_the_way_from_the_first():
    gates = [{"position": [x, 0.0, 2.0], "yaw": 0.0} for x in (1.0, 1.3)]
    env = RacingEnv(num_envs=2, track={"gates": gates, "closed": False, **OPEN}, first_gate=0, action_delay=0)
    td = start(env, position=[0.95, 0.0, 2.0], velocity=[8.0, 0.0, 0.0])
    td["state", "gate"][1] = 1  # it does not fly the whole way
    flight = fly(env, td, hold(env, 3))
    assert flight["next", "success"][..., 0].tolist() == [[False, False, True], [False, False, True]]
    metrics = env.episode_metrics(flight)
    assert metrics["solved"].tolist() == [1.0, 1.0] and metrics["lap_time"].isnan().tolist() == [False, True]
    assert metrics["lap_time"][0].item() == pytest.approx(0.06) and flight["next", "terminated"][:, 2].all()


def test_each_episode_draws_a_track_by_the_rules_and_flies_on_bit_for_bit():
    rules = {"gates": 5, "spacing": [2.0, 5.0], "turn": 1.9, "heights": [1.0, 2.0], "yaw": 0.2}
    env = RacingEnv(num_envs=300, track={"random": rules, "radius": 0.5}, seed=4, observe_directions=True)
    td = env.reset()
    gates, course = td["state", "track", "gates"], torch.cat((td["state", "track", "gates"],) * 2, 1)[:, :7, :2]
    way = course[:, 1:] - course[:, :-1]
    cosine = torch.nn.functional.cosine_similarity(way[:, 1:], way[:, :-1], dim=-1)
    assert (cosine >= math.cos(1.9) - 1e-5).all() and (way.norm(dim=-1) <= 5.0 + 1e-4).all()
    flat = torch.cdist(gates[..., :2], gates[..., :2]) + 9.0 * torch.eye(5)
    assert (flat >= 2.0 - 1e-4).all() and (gates[..., 2] >= 1.0).all() and (gates[..., 2] <= 2.0).all()
    assert len(gates[:, 0].unique(dim=0)) == 300 and not env.is_crash(td["state"]).any()
    ahead = forward(td["state", "track", "rotations"])
    first = td["state", "gate"][:, 0]
    torch.testing.assert_close(td["observation"][:, 6:9], 10.0 * ahead[torch.arange(300), first])
    torch.testing.assert_close(td["state", "target"], gates[torch.arange(300), first])
    saved, actions = env.randomness.state(), hold(env, 3)
    again = env.reset()["state"]
    assert not (again["track", "gates"] == gates).all(-1).any()
    env.randomness.set_state(saved)
    assert (env.reset()["state"] == again).all()
    assert (fly(env, td, actions)["next", "state", "track"] == td["state", "track"].unsqueeze(1)).all()
    check_env_specs(RacingEnv(num_envs=2, track={"file": "random", "gate_radius": 0.4}, event_discount=0.99))


def test_a_random_track_is_that_of_its_seed_and_gates_move_by_their_jitter():
    track = random_track(3, gates=4, radius=0.5, frame=0.1)
    assert track == random_track(3, gates=4, radius=0.5, frame=0.1) and track != random_track(4, gates=4, radius=0.5)
    assert len(track["gates"]) == 4 and track["gates"][0]["radius"] == 0.5 and "random" not in track
    moving = {**track, "position_jitter": [0.1, 0.2, 0.0], "rotation_jitter": [0.0, 0.0, 0.3]}
    env = RacingEnv(num_envs=400, track=moving)
    drawn = env.reset()["state", "track"]
    off = (drawn["gates"] - env.gates).abs().amax((0, 1))
    assert (off <= torch.tensor([0.1, 0.2, 0.0]) + 1e-5).all() and (off[:2] > torch.tensor([0.09, 0.18])).all()
    turned = (forward(drawn["rotations"]) * forward(env.rotations)).sum(-1).clamp(-1.0, 1.0).acos()
    assert 0.28 < turned.max() < 0.3 + 1e-3


SPLIT_S = """
start_pos: [-5, -4, 3]
goal_pos: [0, 0, 3]
gates:
  Gate1: {position: [0, 0, 3], rotation: [0.7071068, 0, 0, 0.7071068], scale: [0.6, 0.6, 0.6]}
  Gate10: {position: [6, -6, 1], rotation: [-0.7071068, 0, 0, 0.7071068], scale: [0.6, 0.6, 0.6]}
  Gate2: {position: [9, 6, 3], rotation: [0.7071068, 0, 0, 0.7071068], scale: [0.6, 0.6, 0.6]}
  N: 3
"""
LSY = """
[env.track]
randomize = false
safety_limits = {pos_limit_low = [-2.5, -1.5, -0.001], pos_limit_high = [2.5, 1.5, 2.0]}
gates = [{pos = [0.5, 0.25, 0.7], rpy = [0.0, 0.0, -0.78]}, {pos = [-1.0, -0.25, 1.2], rpy = [0.0, 0.0, 3.14]}]
obstacles = [{pos = [1.0, 0.75, 1.5]}]
drones = [{pos = [-1.5, 0.75, 0.01], rpy = [0.0, 0.0, 0.0]}]
[env.randomizations]
gate_pos = {fn = "uniform", kwargs = {minval = [-0.1, -0.2, 0.0], maxval = [0.1, 0.2, 0.0]}}
obstacle_pos = {fn = "uniform", kwargs = {minval = [-0.1, -0.1, 0.0], maxval = [0.1, 0.1, 0.0]}}
"""
POINTS = {"initial": {"position": [-5, 4, 1]}, "end": {"position": [4, 0, 1]}, "gate_radius": 0.4}


def flight_of_tii(path, laps=2.4, tilt=0.2):
    """A figure eight through three gates, of which the middle one, tilted back, is passed both ways in each lap."""
    t = np.linspace(0.3, 0.3 + 2.0 * np.pi * laps, 2000)
    columns = {"drone_x": 6.0 * np.cos(t), "drone_y": 3.0 * np.sin(2.0 * t), "drone_z": 1.5 + 0.0 * t}
    back = np.array([-math.sin(tilt), 0.0, math.cos(tilt)])
    ahead_of = (((6, 0, 1.5), [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]), ((0, 0, 1.5), [0.0, 1.0, 0.0], back))
    for i, (centre, across, up) in enumerate((*ahead_of, ((-6, 0, 1.5), [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))):
        for j, (a, b) in enumerate(((-1, 1), (1, -1), (1, 1), (-1, -1))):
            corner = np.array(centre) + 0.8 * a * np.array(across) + 0.6 * b * np.array(up)
            for axis, x in zip("xyz", corner, strict=True):
                columns[f"gate{i + 1}_marker{j + 1}_{axis}"] = x + 0.01 * np.sin(9.0 * t)
    lines = [",".join(columns), *(",".join(f"{x:.5f}" for x in row) for row in zip(*columns.values(), strict=True))]
    lines[5] = "," * (len(columns) - 1)  # nothing is seen
    path.write_text("\n".join(lines))
    return path


def test_a_flight_of_the_tii_dataset_shows_its_track(tmp_path):
    track = load_track(flight_of_tii(tmp_path / "flight.csv"))
    assert track["closed"] and track["notes"][0] == "a lap of 4 gates, flown 2.2 times"
    gates = track["gates"]
    np.testing.assert_allclose([x["position"][:2] for x in gates], [[0, 0], [-6, 0], [0, 0], [6, 0]], atol=0.02)
    np.testing.assert_allclose([(x["width"], x["height"]) for x in gates], [[1.6, 1.2]] * 4, atol=0.02)
    ways = forward(torch.tensor([gate["rotation"] for gate in gates], dtype=torch.float64)).tolist()
    tilted = np.array([math.cos(0.2), 0.0, math.sin(0.2)])
    np.testing.assert_allclose(ways, [-tilted, [0, 1, 0], tilted, [0, 1, 0]], atol=0.02)
    RacingEnv(num_envs=2, track=str(tmp_path / "flight.csv")).reset()
    refuses("passed 2 gates, and no lap twice", load_track, flight_of_tii(tmp_path / "short.csv", laps=0.7))
    text = (tmp_path / "flight.csv").read_text().splitlines()
    (tmp_path / "text.csv").write_text("\n".join([*text[:3], "lost" + text[3], *text[4:]]))
    refuses("text.csv, line 4: could not convert string to float: 'lost", load_track, tmp_path / "text.csv")
    (tmp_path / "other.csv").write_text("time,x\n0,1\n")
    refuses("flight of TII's drone racing dataset, and has no column drone_x", load_track, tmp_path / "other.csv")
    refuses("No flight at .*none.csv", load_track, str(tmp_path / "none.csv"), error=FileNotFoundError)


def test_tracks_of_other_projects_are_read_and_what_was_assumed_is_said(tmp_path):
    (tmp_path / "split.yaml").write_text(SPLIT_S)
    split = load_track(tmp_path / "split.yaml", width=1.5, height=1.2)
    assert [gate["position"] for gate in split["gates"]] == [[0, 0, 3], [9, 6, 3], [6, -6, 1]]
    assert split["starts"][0] == [-5, -4, 3] and split["closed"]
    assert split["notes"][0] == "gates are flown along their -y axis"
    ways = forward(torch.tensor([gate["rotation"] for gate in split["gates"]], dtype=torch.float64)).tolist()
    np.testing.assert_allclose(ways, [[1, 0, 0], [1, 0, 0], [-1, 0, 0]], atol=1e-6)
    (tmp_path / "level.toml").write_text(LSY)
    level = load_track(str(tmp_path / "level.toml"))
    assert (level["gates"][0]["width"], level["frame"], level["closed"]) == (0.4, 0.16, False)
    assert level["position_jitter"] == [0.1, 0.2, 0.0] and level["box"][1] == [2.5, 1.5, 2.0]
    assert level["scene"]["cylinders"][0]["low"] == [0.9, 0.65, 0.0]
    changes = {"scene": {"ground": True}, "position_jitter": [0.0] * 3, "starts": [[0.0, 0.0, 1.0]] * 2}
    other = load_track(tmp_path / "level.toml", **changes)  # count instead of what the file says
    assert {key: other[key] for key in changes} == changes
    (tmp_path / "any.toml").write_text(LSY.replace("false", "true"))
    drawn = load_track(tmp_path / "any.toml", random={"gates": 4})
    for track in (drawn, tmp_path / "level.toml"):
        env = RacingEnv(num_envs=8, track=track, drone="crazyflie", first_gate=0, observe_directions=True)
        td = env.reset()
        flight = fly(env, td, hold(env, 20))["next"]
        assert not flight["crash"].any() and len(td["state", "track", "gates"].unique(dim=0)) == 8
        assert (flight["state", "track"] == td["state", "track"].unsqueeze(1)).all()
    assert len(td["state", "scene", "cylinders"].unique(dim=0)) == 8 and env.scene.touchable is not None
    assert forward(env.rotations)[0].tolist() == pytest.approx([math.cos(0.78), -math.sin(0.78), 0.0], abs=1e-6)
    lap = load_track({**POINTS, "gates": [[0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 0, 1]]})
    assert not lap["closed"] and len(lap["gates"]) == 5
    rounds = load_track({**POINTS, "gates": [[0, 0, 1], [4, 0, 1], [4, 4, 1]] * 2 + [[0, 0, 1]]})
    assert rounds["closed"] and len(rounds["gates"]) == 3 and rounds["starts"][0] == [-5, 4, 1]
    poses = {"2": {"pos": (4.0, 0.0, 1.0), "yaw": 1.0}, "1": {"pos": (0.0, 0.0, 0.0), "yaw": 0.0}}
    config = "track_config:\n  2: {pos: [4, 0, 1], yaw: 1}\n  1: {pos: [0, 0, 0], yaw: 0}\n"
    (tmp_path / "isaac.YAML").write_text(config)
    for track in (poses, str(tmp_path / "isaac.YAML")):
        isaac = load_track(track, lift=0.9, radius=0.7)
        assert [gate["position"] for gate in isaac["gates"]] == [[0, 0, 0.9], [4, 0, 1.9]]
    (tmp_path / "free.toml").write_text("\ufeff" + LSY.replace("obstacles = [{pos = [1.0, 0.75, 1.5]}]", ""))
    assert "scene" not in load_track(tmp_path / "free.toml")
    # In the first versions gates are flown along y, which their order shows; bars are narrower. Others say a size.
    first = LSY.replace("safety_limits = {", "other = {").replace("-0.78", "-2.35").replace("3.14]", "1.57]")
    (tmp_path / "first.toml").write_text(first.replace("[env.r", "gate_size = {width = 1.5, height = 1.4}\n[env.r"))
    first = load_track(tmp_path / "first.toml", box=[[-3, -3, 0], [3, 3, 2]])
    assert forward(torch.tensor(first["gates"][0]["rotation"])).tolist() == pytest.approx([0.707, -0.707, 0], abs=5e-3)
    along, opening = "gates are flown along their y axis", "they are open 1.5 x 1.4 m, with frames of 0.09 m"
    assert first["notes"][:2] == [along, opening]
    # The newest files have an order of passages, which may go backwards, and the oldest no limits and other words.
    gates = [{"pos": [x, 0, 1], "rpy": [0, 0, 0]} for x in (0, 2, 4)]
    own = {"gates": gates, "gate_order": [3, -1, 3], "drone": {"pos": [-1, 0, 0]}}
    spread = {"gate_pos": {"type": "uniform", "low": -0.1, "high": [0.1, 0.3, 0.1]}}
    ordered = load_track({"env": {"track": own}, "box": [[-5, -5, 0], [5, 5, 3]]})
    assert [gate["position"][0] for gate in ordered["gates"]] == [4, 0, 4] and ordered["box"][1] == [5, 5, 3]
    ways = forward(torch.tensor([gate["rotation"] for gate in ordered["gates"]]))[:, 0].tolist()
    assert ways == pytest.approx([1, -1, 1])
    old = {"env": {"track": {**own, "gate_order": [1, 2, 3]}, "randomization": spread}, "box": [[-5, -5, 0], [5, 5, 3]]}
    assert load_track(old)["position_jitter"] == pytest.approx([0.1, 0.2, 0.1])
    old["env"]["track"] = own
    refuses("passes a gate twice, and gates are moved at random", load_track, old)
    refuses(r"does not say safety_limits. Give box=", load_track, {"env": {"track": own}})
    refuses("names gates from 1 to 3; got .0, 1.", load_track, {**old, "env": {"track": {**own, "gate_order": [0, 1]}}})


AGILE = {"start_pos": [-5, 0, 2], "goal_pos": [8, 0, 2]}
UPRIGHT = {"rotation": [1, 0, 0, 0]}
ROW = {"Gate1": {"position": [0, 0, 2], **UPRIGHT}, "Gate2": {"position": [8, 0, 2], **UPRIGHT}}
LYING = [{"position": [x, 0, 2], "rotation": [0, 0, 0.6, 0.8], "radius": 1} for x in (0, 8)]  # x, y, z, w
SQUARE = {"position": [0, 0, 2], "yaw": 0.0, **OPEN}


@cases(
    ({**AGILE, "gates": ROW}, {}, "how far it is open is said by nothing. Give width and height, or radius"),
    ({"gates": [{**SQUARE, "radius": 1.0}] * 2}, {}, "is said by height and radius and width. Give width and"),
    ({"width": 1.0, "height": 1.0}, {}, "gates must be a list of points"),
    ({**AGILE, "gates": {**ROW, "Gate2": {"position": [8, 0, 2], "rotation": [0.7071, 0, 0, 0.7071]}}}, {"radius": 1.0},
     "their order does not show which. Give axis="),
    ({**AGILE, "gates": ROW}, {"radius": 1.0, "axis": "z"}, "axis must be one of x, y, -x, -y; got 'z'"),
    ({"gates": [[0, 0, 1], [1, 1, 1]], "initial": {}}, {}, "how near to a gate counts is not said. Give gate_radius"),
    ({"1": {"pos": [0, 0, 0], "yaw": 0}, "2": {"pos": [1, 0, 0], "yaw": 0}}, {"radius": 1.0}, "is not said. Give lift"),
    ({"gates": {"first": [0, 0, 1]}}, {}, "its gates have names, .* of no format that is known"),
    ({"gates": [[0, 0, 1], SQUARE]}, {}, "gates must be all points, or all mappings"),
    ({"gates": [SQUARE, {**SQUARE, "rotation": [1, 0, 0, 0]}]}, {}, "gate 2: give a yaw, .* or a rotation"),
    ({"gates": LYING}, {}, "lie or lean if rotations are w, x, y, z, and all .* x, y, z, w. Write w first"),
    ({**AGILE, "gates": dict(zip(ROW, LYING, strict=True))}, {"radius": 1, "axis": "x"}, "Write w first"),
    ({"quadrotor_config": {}}, {}, "unknown key .quadrotor_config.. Allowed: gates.* help of load_track lists"),
    ({"gates": [SQUARE, {**SQUARE, "wide": 1}]}, {}, "gate 2: unknown key 'wide'. Allowed: position, yaw"),
    ({"gates": [[0, 0, 1], [1, 1, 1]], "frame": 0.1}, {}, "frame is of gates with a direction; these are points"),
    ({"random": {"gates": 3, "turn": 2.0}}, {"radius": 1.0}, "3 gates need a turn of at least 2.09 rad, got 2"),
    ({"random": {"spacing": [4, 2]}}, {"radius": 1.0}, "spacing and heights are the least and then the greatest"),
    ({"env": {"track": {"gates": []}}}, {}, "track: cannot be read .*: it does not say 'drone'"),
    ({"goal_pos": [8, 0, 2], "gates": ROW}, {}, r"does not say start_pos. Give load_track\(..., start_pos=\[x, y, z\]"),
    ({**AGILE, "gates": {"Start": ROW["Gate1"], **ROW}}, {}, "The name of gate 'Start' has no number. Number them"),
    ({"gates": [{**SQUARE, "position": 5}, SQUARE]}, {}, "gates must be a list of points .* got .5, .0, 0, 2.."),
    ({"gates": [SQUARE, SQUARE], "gate_radius": 0.3}, {}, "gate_radius is of gates that are points; .* Give radius"),
    ({"random": {"heights": [-1, 4]}}, {"radius": 1.0}, "random: heights must be above the floor at 0 m; got .-1, 4."),
    ({"random": {}, "box": [[-5, -9, 0], [9, 9, 5]]}, {"radius": 1.0}, "6 gates .* need 6 m to all sides .* up to 5 m"),
    ({"random": {"yaw": 0.1}}, {"gate_radius": 1.0}, "random: yaw has no effect on gates that are spheres"),
    ({"gates": [SQUARE] * 2, "radius": 1.0}, {}, "each gate says how far it is open, so radius of"),
    ({"gates": [[0, 0, 1], [4, 0, 1], [0, 0, 1]]}, {}, "gates 3 and 1 are equal, and in a row"),
    ({"gates": [[0, 0, 1]] * 2, "floor": 0, "box": [[-5, -5, 0], [5, 5, 5]]}, {}, "floor has no effect beside box"),
    ({"random": {}, "starts": [[0, 0, 2]] * 6}, {"radius": 1.0}, "random draws gates and their starts. Leave out"),
)  # fmt: skip
def test_a_track_that_does_not_say_enough_is_refused_and_asks_by_name(track, settings, message):
    refuses(message, load_track, track, **settings)


def test_what_is_given_with_a_track_replaces_what_the_track_says_and_its_result_is_a_track(tmp_path):
    track = random_track(3, gates=4)
    assert {gate["radius"] for gate in load_track(track, radius=0.5)["gates"]} == {0.5}
    assert load_track(track, start=[0, 0, 3])["starts"] == [[0, 0, 3], *track["starts"][1:]]
    other = load_track({"file": "visfly", "gates": [[0, 0, 1], [4, 0, 1]]})
    assert other["starts"] == [[2, 0, 1]] * 2 and other["gate_radius"] == 0.3
    for name in ("random", "six_gates", load_track("random", random={}, gate_radius=0.4)):
        assert load_track(load_track(name)) == load_track(name)
    changed = load_track(load_track("random"), width=2.0, height=1.0, floor=0.9)
    assert changed["gates"][0]["width"] == 2.0 and changed["random"] == load_track("random")["random"]
    assert len(load_track(load_track("random"), random={"gates": 4})["gates"]) == 4
    gates = track["gates"]
    gates = [{"position": torch.tensor(x["position"]), "rotation": np.array(x["rotation"])} for x in gates]
    again = load_track({"gates": gates}, width=1.5, height=1.5)
    assert [gate["rotation"] for gate in again["gates"]] == [gate["rotation"] for gate in track["gates"]]
    load_track({"gates": [{**gate, "rotation": [0, 0, 1, 0]} for gate in LYING]})  # openings upside down
    boxed = load_track("airsim", box=[[-200, -200, -70], [200, 200, 70]])
    assert "floor" not in boxed and RacingEnv(num_envs=1, track=boxed).floor == -70
    row = {str(k): {"pos": [4 * k, 0, 1], "yaw": 0} for k in (1, 2)}
    assert load_track(row, lift=0, radius=1.0, scene={"ground": True})["scene"] == {"ground": True}
    (tmp_path / "self.yaml").write_text(f"file: {tmp_path}/self.yaml")
    refuses("self.yaml: 10 tracks name each other as file; does one name itself", load_track, tmp_path / "self.yaml")


@cases(({"start_range": 0.6},), ({"position_jitter": [9, 9, 0.2]},), ({"box": [[-3, -4, 0], [4, 4, 5]]},))
def test_episodes_on_random_tracks_start_inside_the_box(change):
    rules = {"gates": 4, "spacing": [1, 5], "heights": [0.3, 4], "yaw": 1.5}
    env = RacingEnv(num_envs=1000, track={"random": rules, "radius": 0.3, **change})
    state = env.reset()["state"]
    assert not env.is_crash(state).any() and not env.is_crash({"position": state["track", "gates"]}).any()
