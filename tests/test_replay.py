"""Replays: what they hold, how they are written, and how they play in a browser without a network."""

import base64
import json
import re
import sys

import numpy as np
import pytest
import torch
from browsing import TIMEOUT
from helpers import refuses
from torchrl.envs import RewardSum, TransformedEnv

from torchrl_quad import HoveringEnv, RacingEnv, differentiable_rollout, make_actor, make_env
from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs.metrics import first_episode
from torchrl_quad.render import write_replay

NUM_ENVS, STEPS = 3, 600


@pytest.fixture(scope="module")
def flight():
    """Three races of a random policy, which crash."""
    torch.manual_seed(0)
    env = RacingEnv(num_envs=NUM_ENVS, seed=0, reward="position")
    return env, env.rollout(STEPS, break_when_any_done=False)


@pytest.fixture(scope="module")
def race(flight, open_page, tmp_path_factory):
    env, rollout = flight
    replay = opened(open_page, tmp_path_factory.mktemp("replay"), env, rollout, "next gate")
    yield replay
    replay.close()


@pytest.fixture
def replay(race):
    """The race, at its start, with all environments."""
    if race.page.locator("#play").inner_text() == "Pause":
        race.page.click("#play")
    race.page.select_option("#environment", "all")
    race.page.select_option("#speed", "1")
    race.scrub(0)
    yield race
    assert not race.wrong


def opened(open_page, folder, env, rollout, goal="target"):
    """The replay of a flight whose environment is known, with what such a page shows at first."""
    write_replay(rollout, folder / "replay.html", env=env)
    replay = open_page(folder / "replay.html")
    assert type(env).__name__ in replay.page.title()
    np.testing.assert_allclose(replay.bodies()[:, 0], rollout["state", "position"][:, 0], atol=1e-6)
    success = "  dashed: success below it" if isinstance(env, HoveringEnv) else ""
    panels = ["reward, sum", "action [-1, 1], thrust", "speed [m/s]", f"distance to the {goal} [m]{success}"]
    assert replay.series()[1] == panels and replay.layout("yaxis4.type") == ("linear" if goal == "next gate" else "log")
    if success:
        low, high = replay.layout("yaxis4.range")
        assert low < -1 < high and replay.layout("shapes.0.y0") == pytest.approx(0.1)
    return replay


def test_positions_and_attitudes_are_all_a_replay_needs(open_page, tmp_path):
    rollout = HoveringEnv(num_envs=2).rollout(12, break_when_any_done=False)
    rollout = rollout.select(("next", "state", "position"), ("next", "state", "quaternion"))
    write_replay(rollout, tmp_path / "replay.html", control_dt=0.1)
    replay = open_page(tmp_path / "replay.html")
    replay.scrub(4)
    np.testing.assert_allclose(replay.bodies()[:, 0], rollout["next", "state", "position"][:, 4], atol=1e-6)
    assert replay.page.inner_text("#clock") == "0.50 s of 1.20 s"
    assert replay.series()[1] == ["height [m]"] and "guess" in replay.page.inner_text("#note")
    replay.close()


def test_a_notebook_shows_a_replay_below_its_cell(browser, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rollout = HoveringEnv(num_envs=2).rollout(12, break_when_any_done=False)
    for position in (rollout["state", "position"], rollout["next", "state", "position"]):
        position[:] = torch.nan  # the page opens nevertheless
    replay = write_replay(rollout)
    assert not list(tmp_path.iterdir()) and repr(replay) == f"Replay({len(replay.html) / 1e6:.1f} MB)"
    (tmp_path / "notebook.html").write_text(f"<!doctype html><div>{replay._repr_html_()}</div>")
    page = browser.new_context(offline=True).new_page()
    page.goto((tmp_path / "notebook.html").as_uri())
    frame = page.frame_locator("iframe")
    frame.locator("body[data-ready]").wait_for(timeout=TIMEOUT)
    assert frame.locator("#clock").inner_text() == "0.00 s of 0.24 s"
    page.context.close()


def test_play_moves_the_drones_and_pause_stops_them(replay):
    before, picture = replay.bodies(), replay.picture()
    assert replay.picture() == picture
    replay.page.click("#play")
    replay.wait(lambda step: step >= 10)
    replay.page.click("#play")
    paused, step = replay.bodies(), replay.step()
    assert (np.abs(paused[:, 0] - before[:, 0]).max(-1) > 1e-3).all()
    frames = "new Promise((done) => { let n = 0; (function f() { n++ < 4 ? requestAnimationFrame(f) : done(); })(); })"
    replay.page.evaluate(frames)
    assert replay.step() == step
    np.testing.assert_array_equal(replay.bodies(), paused)
    assert replay.picture() != picture


def test_the_slider_scrubs_to_the_state_of_the_rollout(replay, flight):
    env, rollout = flight
    replay.page.select_option("#size", "3")
    for frame in (1, 30):
        replay.scrub(frame)
        state = rollout["next", "state"][:, frame - 1]
        bodies = replay.bodies()
        np.testing.assert_allclose(bodies[:, 0], state["position"], atol=1e-5)
        hubs = torch.nn.functional.pad(env.params.rotor_positions, (0, 1)).expand(NUM_ENVS, 4, 3)
        hubs = 3 * quaternion.rotate(state["quaternion"].unsqueeze(1), hubs)
        np.testing.assert_allclose(bodies[:, 1:8:2] - bodies[:, :1], hubs, atol=1e-5)
        lines = replay.trace("thrust").reshape(NUM_ENVS, 4, 3, 3)
        lengths = np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=-1)
        thrust = env.dynamics.controller.rotors.thrust(state["rotor_speed"])
        hover = (env.params.mass * env.params.gravity / 4).item()
        np.testing.assert_allclose(lengths, 3 * 0.075 * thrust / hover, rtol=1e-3)


@pytest.mark.parametrize("speed", ["0.25", "4"])
def test_it_plays_in_real_time_times_the_speed(replay, flight, speed):
    env, _ = flight
    replay.page.select_option("#speed", speed)
    replay.page.click("#play")
    # Asked once for each frame, over half a second and twelve steps at least.
    steps, milliseconds = replay.page.evaluate(
        """() => new Promise((done) => {
            let first = null;
            const step = () => Number(document.getElementById("time").value);
            requestAnimationFrame(function look(time) {
                if (first === null && step() > 0) first = [step(), time];
                const [steps, passed] = first === null ? [0, 0] : [step() - first[0], time - first[1]];
                if (steps >= 12 && passed > 500) done([steps, passed]);
                else requestAnimationFrame(look);
            });
        })"""
    )
    assert steps < STEPS - 20  # it has not come to the end
    assert 1000 * env.control_dt * steps / milliseconds == pytest.approx(float(speed), rel=0.15)


def test_the_time_series_are_those_of_the_chosen_environment(replay, flight):
    _, rollout = flight
    terms = rollout["next", "reward_terms"]
    assert replay.series()[0][:NUM_ENVS] == ["0", "1", "2"]
    for i in (2, 0):
        replay.page.select_option("#environment", str(i))
        names, panels = replay.series()
        assert names == ["sum", *terms.keys(), "thrust", "roll rate", "pitch rate", "yaw rate", "speed", "distance"]
        assert panels[0].startswith("reward: sum")
        end = first_episode(rollout)[i].sum()
        times, reward = replay.trace("position", "series").T
        np.testing.assert_allclose(times, 0.02 * np.arange(STEPS + 1), atol=1e-9)
        np.testing.assert_allclose(reward[1 : end + 1], terms["position"][i, :end, 0], atol=1e-6)
        assert np.isnan(reward[0]) and np.isnan(reward[end + 1 :]).all()
        action = replay.trace("roll rate", "series")[:end, 1]
        np.testing.assert_allclose(action, rollout["action"][i, :end, 1], atol=1e-6)
        bodies = replay.bodies()
        assert np.isfinite(bodies[i, 0]).all() and np.isfinite(bodies[:, 0]).all(-1).sum() == 1


def ticks(replay):
    """Times on the axis of the time series [s], and their places on the page [pixels]."""
    script = """() => Array.from(document.querySelectorAll("#series .xtick text"), (tick) => {
        const box = tick.getBoundingClientRect();
        return [Number(tick.textContent), box.x + box.width / 2];
    })"""
    return np.array(replay.page.evaluate(script)).T


def test_the_cursor_is_in_step_and_a_click_goes_to_a_time(replay):
    times, pixels = ticks(replay)
    for frame in (120, 500):
        replay.scrub(frame)
        box = replay.page.locator("#cursor").bounding_box()
        centre = box["x"] + box["width"] / 2
        assert centre == pytest.approx(np.interp(0.02 * frame, times, pixels), abs=1.5)
    axes = ("yaxis", "yaxis2", "yaxis3", "yaxis4")
    for axis, part in zip(axes, replay.page.locator("#cursor div").all(), strict=True):
        top, height = (replay.layout(f"{axis}.{name}") for name in ("_offset", "_length"))
        part, around = part.bounding_box(), replay.page.locator("#series").bounding_box()
        assert (part["y"] - around["y"], part["height"]) == pytest.approx((top, height), abs=1.5)  # not on the labels
    box = replay.page.locator("#series").bounding_box()
    x, y = np.interp(6.0, times, pixels), box["y"] + 0.6 * box["height"]
    replay.page.mouse.move(x - 5, y)
    replay.page.wait_for_selector("#series .hoverlayer > *", state="attached")
    replay.page.mouse.move(x, y)
    replay.page.mouse.click(x, y)
    replay.wait(lambda step: step != 500)
    assert replay.step() == pytest.approx(300, abs=3)


def test_the_keyboard_plays_steps_and_chooses_and_keys_of_the_browser_are_left_to_it(replay):
    keyboard = replay.page.keyboard
    for key, step in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1)):
        keyboard.press(key)
        assert replay.step() == step
    keyboard.press("ArrowDown")
    assert replay.page.input_value("#environment") == "0"
    keyboard.press("ArrowUp")
    assert replay.page.input_value("#environment") == "all"
    keyboard.press(" ")
    replay.wait(lambda step: step > 3)
    keyboard.press(" ")
    assert replay.page.inner_text("#play") == "Play"
    replay.scrub(0)
    replay.page.evaluate("document.activeElement.blur()")  # the slider has keys of its own
    for key in ("Alt+ArrowRight", "Control+ArrowRight", "Meta+ArrowRight"):
        keyboard.press(key)
    assert replay.step() == 0
    replay.page.focus("#environment")
    replay.page.select_option("#environment", "1")
    keyboard.press("ArrowRight")
    assert replay.step() == 1
    keyboard.down(" ")
    keyboard.down(" ")  # held, it repeats
    keyboard.up(" ")
    assert replay.page.inner_text("#play") == "Pause"


def test_everything_that_the_markers_name_is_drawn_and_a_drone_until_its_position_is_not_finite(
    open_page, own_markers, tmp_path
):
    env = own_markers(num_envs=2)
    rollout, markers = env.rollout(6, break_when_any_done=False), env.markers()
    position = rollout["next", "state", "position"]
    position[0, 3:] = torch.nan
    write_replay(rollout, tmp_path / "replay.html", env=env)
    replay = open_page(tmp_path / "replay.html")
    shown = {"places": markers.places, "path": markers.curve, "target": np.tile(env.target, (2, 1))}
    for name, points in (shown | {shape.name: shape.points for shape in markers.shapes}).items():
        np.testing.assert_allclose(replay.trace(name), points, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(replay.trace("gates")[:33], markers.rings()[0], atol=1e-6)
    replay.scrub(3)
    np.testing.assert_allclose(replay.bodies()[0, 0], position[0, 2], atol=1e-6)
    replay.scrub(4)
    assert np.isfinite(replay.bodies()[:, 0]).all(1).tolist() == [False, True]
    replay.close()


def test_the_next_gate_stands_out(replay, flight):
    env, rollout = flight
    for i in range(NUM_ENVS):
        replay.page.select_option("#environment", str(i))
        ring = replay.trace("next")
        ring = ring[np.isfinite(ring).all(-1)]
        gate = env.gates[rollout["state", "gate"][i, 0, 0]]
        np.testing.assert_allclose(np.linalg.norm(ring - gate.numpy(), axis=-1), 0.3, atol=1e-5)


def test_a_drone_stays_where_its_episode_has_ended_and_the_page_says_how(open_page, crashing, tmp_path):
    env = HoveringEnv(num_envs=2, max_episode_steps=30)
    rollout = crashing(env, 50)
    end = rollout["next", "terminated"][1, :, 0].int().argmax()
    assert end < 10
    replay = opened(open_page, tmp_path, env, rollout)
    assert replay.page.inner_text("#status") == "2 flying"
    replay.scrub(50)
    position = rollout["next", "state", "position"]
    np.testing.assert_allclose(replay.bodies()[:, 0], torch.stack((position[0, 29], position[1, end])), atol=1e-6)
    assert replay.page.inner_text("#status") == "1 truncated, 1 crashed"
    options = replay.page.locator("#environment option").all_inner_texts()
    assert options == ["all", "0: truncated at 0.60 s", f"1: crashed at {0.02 * (end + 1):.2f} s"]
    np.testing.assert_allclose(replay.trace("crash")[1], position[1, end], atol=1e-6)
    replay.close()


def written(rollout, **options):
    """What the page of a flight shows, as it is stored."""
    text = write_replay(rollout, **options).html
    content = json.loads(re.search(r'<script type="application/json" id="flight">(.*?)</script>', text, re.DOTALL)[1])

    def numbers(name, *shape):
        return torch.from_numpy(np.frombuffer(base64.b64decode(content[name]), "<f4").copy()).reshape(shape)

    return content, numbers


def test_what_is_not_known_is_left_out():
    rollout = HoveringEnv(num_envs=2, action_delay=0).rollout(3)
    _, numbers = written(rollout.exclude(("state", "target"), ("state", "velocity")))
    target = numbers("target", 2, 4, 3)
    assert target[:, 0].isnan().all() and torch.equal(target[:, 1:], rollout["next", "state", "target"])
    torch.testing.assert_close(numbers("position", 2, 4, 3)[:, 0], rollout["state", "position"][:, 0])
    content, _ = written(rollout.exclude(("state", "target"), ("next", "state", "target"), ("next", "reward_terms")))
    assert content["target"] is None and not content["knows_drone"]
    assert [panel["label"] for panel in content["panels"]] == ["reward", "action [-1, 1]", "speed [m/s]", "height [m]"]


def test_drones_of_other_environments_than_those_shown_are_refused():
    env = HoveringEnv(num_envs=2)
    env = HoveringEnv(num_envs=2, drone=env.params.replace(mass=torch.tensor([[0.3], [0.4]])))
    write_replay(env.rollout(2), env=env)
    with pytest.raises(ValueError, match="env has a mass for each of its 2 environments, and the page would show 3"):
        write_replay(HoveringEnv(num_envs=3).rollout(2), env=env)


def test_a_rollout_with_its_graph_in_double_precision_is_written_under_transforms_too():
    env = TransformedEnv(HoveringEnv(num_envs=3, dtype=torch.float64, dt=0.01, control_dt=0.04), RewardSum())
    rollout, _ = differentiable_rollout(env, make_actor(env), None, 5)
    assert rollout["next", "reward"].requires_grad
    content, numbers = written(rollout, env=env, num_envs=2, control_dt=0.5)
    assert content["control_dt"] == 0.04
    torch.testing.assert_close(numbers("position", 2, 6, 3)[:, 1:], rollout["next", "state", "position"][:2].float())


def test_randomised_drones_are_drawn_with_their_own_rotors():
    randomize = {"rotor_positions": {"scale": [0.8, 2.0]}, "mass": {"scale": [0.5, 2.0]}}
    env = HoveringEnv(num_envs=3, randomize=randomize)
    rollout = env.rollout(5, break_when_any_done=False)
    _, numbers = written(rollout, env=env)
    drone = rollout["state", "drone"][:, 0]
    torch.testing.assert_close(numbers("rotors", 3, 4, 2), drone["rotor_positions"])
    thrust = env.dynamics.controller.rotors.thrust(rollout["state", "rotor_speed"][:, 0])
    torch.testing.assert_close(numbers("lift", 3, 6, 4)[:, 0], 4 * thrust / (drone["mass"] * 9.81), rtol=1e-4, atol=0)


def test_the_gate_of_a_frame_is_the_one_that_the_drone_flies_to_and_rings_face_along_the_course():
    env = RacingEnv(num_envs=3)
    rollout = env.rollout(4, break_when_any_done=False)
    gates = written(rollout, env=env)[1]("gate", 3, 5)
    assert torch.equal(gates[:, 1:], rollout["next", "state", "gate"][..., 0].float())
    assert torch.equal(gates[:, 0], rollout["state", "gate"][:, 0, 0].float())
    content, _ = written(rollout)
    assert content["gates"] is content["gate"] is None
    env = RacingEnv(num_envs=1, track={"gates": [[0, 0, 2], [4, 0, 2], [4, 0, 6], [0, 0, 6]], "gate_radius": 0.5})
    rings = written(env.rollout(2), env=env)[1]("gates", 4, 33, 3) - env.gates[:, None]
    torch.testing.assert_close(rings.norm(dim=-1), torch.full((4, 33), 0.5))
    along = env.gates.roll(-1, 0) - env.gates.roll(1, 0)  # of a square, between the edges before and after
    torch.testing.assert_close((rings * along[:, None]).sum(-1), torch.zeros(4, 33), atol=1e-5, rtol=0)


def test_each_drone_has_the_gates_of_its_own_episode_with_their_openings_and_frames(tmp_path, open_page):
    env = RacingEnv(num_envs=2, track={"file": "random", "frame": 0.25})
    rollout = env.rollout(4, break_when_any_done=False)
    rims = written(rollout, env=env)[1]("gates", 2, 6, 33, 3)
    drawn = rollout["state", "track"][:, 0]
    away = (rims - drawn["gates"].unsqueeze(2)).norm(dim=-1)
    torch.testing.assert_close(away.amax((1, 2)), torch.full((2,), 0.75 * 2**0.5))  # the corners of 1.5 m by 1.5 m
    write_replay(rollout, tmp_path / "replay.html", env=env)
    replay = open_page(tmp_path / "replay.html")
    for i in (0, 1):
        replay.page.select_option("#environment", str(i))
        points = torch.from_numpy(replay.trace("gates")).float()
        torch.testing.assert_close(points[~points[:, 0].isnan()], rims[i].flatten(0, 1))
        bars = torch.from_numpy(replay.trace("shape 0")).float()
        from_centre = (bars[~bars[:, 0].isnan()].reshape(6, 33, 3) - drawn["gates"][i, :, None]).norm(dim=-1)
        torch.testing.assert_close(from_centre.amax(1), torch.full((6,), 2**0.5))
    replay.close()


def test_a_page_of_twelve_long_flights_is_small_and_a_machine_without_plotly_is_told_what_to_install(monkeypatch):
    env = make_env("tracking", num_envs=14)
    content, _ = written(env.rollout(512, break_when_any_done=False), env=env)
    assert content["environments"] == 12 and len(json.dumps(content)) < 1_500_000
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    refuses(r"pip install '.\[render\]'", write_replay, HoveringEnv(num_envs=2).rollout(3), error=ImportError)
