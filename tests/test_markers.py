"""What tasks say about themselves, for reports and pictures, and the frames of ``env.render()``."""

import copy
import gc
import weakref

import numpy as np
import pytest
import torch
from helpers import cases, refuses, start
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv, check_env_specs
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor, make_env
from torchrl_quad.envs import TASKS
from torchrl_quad.envs.markers import Markers, Shape
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, describe_metric
from torchrl_quad.render import animate_flight, canvas, plot_episode, plot_flight


@cases(
    (Metric("position error", "cm", 100.0, median=True), 0.03214, "3.21 cm (median)"),
    (Metric("episodes solved", "%", 100.0), 1.0, "100 %"),
    (Metric("return"), -23.456, "-23.5"),
    (Metric("return"), 12345.6, "12346"),
    (Metric("lap time", "s"), torch.inf, "inf s"),
)
def test_a_metric_is_printed_in_its_unit(metric, value, text):
    assert metric.format(value) == text


def test_episodes_without_a_value_do_not_count_and_a_metric_that_nobody_describes_goes_by_its_name():
    values = torch.tensor([1.0, torch.nan, 2.0, 9.0])
    assert Metric("speed").summarise(values) == 4.0 and Metric("error", median=True).summarise(values) == 2.0
    assert Metric("lap time", "s").format(Metric("lap time").summarise(values[1:2])) == "none"
    assert describe_metric("top_speed", {}) == Metric("top speed")
    assert describe_metric("solved", {}) is EPISODE_METRICS["solved"]
    assert describe_metric("solved", {"solved": Metric("landed")}).label == "landed"


@pytest.mark.parametrize("task", TASKS)
def test_a_task_describes_every_metric_that_it_gives(task):
    env = make_env(task, num_envs=2)
    rollout = env.rollout(3, break_when_any_done=False)
    assert {*env.episode_metrics(rollout), *rollout["next", "metrics"].keys()} == set(env.metric_info)
    assert all(values.shape == (2,) for values in env.episode_metrics(rollout).values())


def test_the_markers_of_racing_and_tracking_are_where_their_targets_are():
    racing, tracking = make_env("racing", num_envs=8), make_env("tracking", num_envs=8)
    markers = racing.markers()
    target = racing.reset()["state", "target"]
    assert (target.unsqueeze(1) == markers.gates).all(-1).any(-1).all()
    assert markers.gate_radius == racing.track["gate_radius"] and markers.progress in racing.metric_info
    target = tracking.reset()["state", "target"]
    assert (torch.cdist(target, tracking.markers().curve).amin(-1) < 0.06).all()  # half of the step between points
    hovering = HoveringEnv(num_envs=2).markers()  # shown where the flight had them
    assert hovering.places is hovering.curve is hovering.gates is None


def test_bodies_are_closed_and_have_the_volume_and_the_corners_that_they_should_have():
    """By the theorem of Gauss; a face with its corners in the wrong order would count against the others."""
    ball, pillar = Shape.sphere((1, 2, 3), 0.5), Shape.cylinder((1, 2, 0), 0.5, 2.0)
    polygon = 0.5 * 24 * torch.tensor(2 * torch.pi / 24).sin()  # the area of 24 corners on a circle of radius 1
    for shape, volume in ((Shape.box((0, 0, 0), (1, 2, 3)), 6.0), (pillar, 0.5 * polygon), (ball, 4.19 * 0.5**3)):
        a, b, c = (shape.points[shape.faces[:, i]] for i in range(3))
        enclosed = (a * torch.linalg.cross(b, c)).sum() / 6
        torch.testing.assert_close(enclosed, torch.as_tensor(volume), rtol=0.03 if shape is ball else 1e-4, atol=0)
    assert ((ball.points - torch.tensor([1.0, 2, 3])).norm(dim=-1) - 0.5).abs().max() < 1e-6
    assert pillar.points[:, 2].unique().tolist() == [0, 2]


@pytest.mark.parametrize("axis", [(1.0, 2.0, 0.5), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
def test_a_ring_is_a_circle_around_its_axis(axis):
    centres, radii = torch.tensor([[1.0, 2, 3], [4, 0, 2]]), torch.tensor([0.5, 1.0])
    rims = Markers(gates=centres, gate_axes=[axis, (1, 0, 0)], gate_radius=radii).rings()
    torch.testing.assert_close(rims[0], Shape.ring((1, 2, 3), 0.5, axis).points)
    spokes = rims - centres[:, None]
    torch.testing.assert_close(spokes.norm(dim=-1), radii[:, None].expand(2, 33))
    axes = torch.tensor([axis if any(axis) else (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)])  # a single gate has no course
    torch.testing.assert_close((spokes @ axes[..., None])[..., 0], torch.zeros(2, 33), atol=1e-5, rtol=0)
    assert torch.linalg.matrix_rank(spokes, tol=1e-3).tolist() == [2, 2]


@cases(
    (lambda: Shape([(0, 0)]), r"Shape: points must be points \(n, 3\) \[m\], got shape \(1, 2\)"),
    (lambda: Shape([(0, 0, 0)], [(0, 0, 1)]), "faces must be indices .* of its 1 points"),
    (lambda: Shape([(0, 0, 0)], color="red"), "color must be written as #rrggbb, such as #c8452f, got 'red'"),
    (lambda: Shape([(0, 0, 0)], opacity=0), "opacity must be greater than 0, got 0"),
    (lambda: Markers(gates=[1, 2, 3]), "Markers: gates must be points"),
    (lambda: Markers(gates=[(0, 0, 1)], gate_radius=torch.ones(2)), "one for all 1 gates or one each"),
    (lambda: Markers(gates=[(0, 0, 1)], gate_axes=torch.ones(2, 3)), "2 directions for 1 gates"),
    (lambda: Markers(shapes=["wall"]), "shapes must be a list of Shape"),
)
def test_markers_that_are_none_are_refused(make, message):
    refuses(message, make)


def test_figures_films_and_frames_show_everything_that_a_task_of_one_s_own_names(own_markers, monkeypatch, tmp_path):
    views = []

    def look(space, markers, *args, draw=canvas.draw_markers, **options):
        draw(space, markers, *args, **options)
        views.append(space)

    monkeypatch.setattr(canvas, "draw_markers", look)
    env = own_markers(num_envs=2)
    flight = env.rollout(5, break_when_any_done=False)
    plot_flight(flight, tmp_path / "flight.png", env=env, title="Through a window")
    plot_episode(flight, tmp_path / "episode.png", env=env)
    animate_flight(flight, tmp_path / "flight.gif", env=env)
    env.render()
    assert len(views) == 4 and views[0].figure.get_suptitle() == "Through a window"
    for view in views:
        shown = {artist.get_label() for artist in (*view.lines, *view.collections)}
        assert {"wall", "ball", "tree", "rope", "target", "gate"} <= shown
        limits = torch.tensor([view.get_xlim(), view.get_ylim(), view.get_zlim()]).T
        points = torch.cat([x.reshape(-1, 3) for x in env.markers().points()])
        assert (points >= limits[0] - 1e-5).all() and (points <= limits[1] + 1e-5).all()


@pytest.mark.parametrize("task", TASKS)
def test_torchrl_records_videos_of_every_task(task, tmp_path):
    env = make_env(task, num_envs=3)
    logger = CSVLogger("run", str(tmp_path))
    filmed = TransformedEnv(env, Compose(PixelRenderTransform(size=128), VideoRecorder(logger, "flight")))
    check_env_specs(filmed)
    filmed.transform.dump()  # what the check has filmed
    rollout = filmed.rollout(8, make_actor(env))
    filmed.transform.dump()
    video = torch.load(tmp_path / "run/videos/flight_1.pt")
    assert video.shape == (1, 9, 3, 128, 128)  # the reset, and eight steps
    assert video.dtype == torch.uint8 and (video[0, 0] != video[0, -1]).any()
    frame = torch.as_tensor(rollout["next"][..., -1].get("pixels").tolist()[0])
    assert torch.equal(video[0, -1], frame.permute(2, 0, 1))  # upright


def test_the_flight_is_the_same_whether_it_is_rendered_or_not():
    def fly(render):
        env = HoveringEnv(num_envs=2, seed=3, max_episode_steps=3, wind={"gust": 1.0})
        td = env.reset()
        for _ in range(8):
            if render:
                env.render()
            _, td = env.step_and_maybe_reset(td.set("action", torch.zeros(2, 4)))
        return td["observation"]

    assert torch.equal(fly(render=False), fly(render=True))


def test_after_a_partial_reset_one_drone_starts_again_and_the_others_fly_on():
    env = HoveringEnv(num_envs=2)
    filmed = TransformedEnv(env, Compose(PixelRenderTransform(), VideoRecorder(None, None)))
    falls_first = start(filmed, position=[(1.0, 0.0, 0.05), (1.0, 0.0, 1.5)], velocity=[(0, 0, -2), (0, 0, 0)])
    rollout = filmed.rollout(3, tensordict=falls_first, auto_reset=False, break_when_any_done=False)
    (step,) = rollout["next", "terminated"][0, :, 0].nonzero().flatten().tolist()
    assert len(filmed.transform[1].obs) >= 5  # a start more
    frame = 3 + step  # two resets and the start come before the first step; this frame follows the crash
    begun = rollout[:, step + 1]
    assert begun["state", "step"].flatten().tolist() == [0, step + 1]
    env.reset(begun.clone(), set_state=True)
    np.testing.assert_array_equal(filmed.transform[1].obs[frame].permute(1, 2, 0).numpy(), env.render())


def test_a_frame_shows_the_state_after_the_last_step_or_rollout():
    env = HoveringEnv(num_envs=2)
    actor = make_actor(env)

    def expect(state):
        picture = env.render()
        env.reset(TensorDict({"state": state.detach()}, [2]), set_state=True)
        np.testing.assert_array_equal(picture, env.render())

    td = env.reset()
    expect(td["state"])
    expect(env.step(actor(td))["next", "state"])
    expect(env.rollout(9, actor)["next", "state"][:, -1])
    flight, carry = differentiable_rollout(env, actor, None, 9)
    expect(carry["state"])
    flight["next", "reward"].sum().backward()


def test_no_graph_is_kept_for_pictures():
    env = HoveringEnv(num_envs=2, action_delay=0)
    action = torch.zeros(2, 4, requires_grad=True)
    lives = weakref.ref(action)
    flight = env.step(env.reset().set("action", action))["next"]
    assert flight["state", "position"].requires_grad
    del action
    gc.collect()
    assert lives() is not None
    del flight
    gc.collect()
    assert lives() is None
    env.render()
    env.rollout(50, make_actor(env), break_when_any_done=False)
    kept = sum(x.untyped_storage().nbytes() for x in env.render_state.values())
    assert kept == 2 * 10 * 4  # and not the whole rollout


def test_the_chosen_drones_are_drawn_in_the_chosen_size_and_a_view_follows_who_leaves_it():
    env = HoveringEnv(num_envs=3)
    td = env.reset()
    pictures = [env.render(drones) for drones in ([0], [1], [0, 1])]
    assert all((a != b).any() for a, b in zip(pictures, pictures[1:] + pictures[:1], strict=True))
    assert env.render(np.arange(3), size=200).shape == (200, 200, 3)
    before = env.render([2])
    td["state", "position"][2] = torch.tensor([30.0, 0.0, 5.0])
    env.reset(td, set_state=True)
    after = env.render([2])
    ink = [(picture != 255).any(-1).sum() for picture in (before, after)]
    assert (before != after).any() and min(ink) > 1000
    green = (np.abs(after.astype(int) - [70, 20, 90]).sum(-1) < 60).sum()  # the colour of the first drone
    assert green > 10


def test_rendering_before_a_reset_or_of_unknown_drones_is_refused():
    env = HoveringEnv(num_envs=2)
    refuses(r"after the last reset or step. Call env.reset\(\) first.", env.render)
    env.reset()
    for drones in ([2], [-1], []):
        refuses(r"indices from 0 to 1, at least one, such as drones=\[0\]", env.render, drones)
    refuses("size must be at least 100 pixels, got 20", env.render, size=20)


def test_an_environment_that_has_been_rendered_is_copied_and_forgotten():
    env = HoveringEnv(num_envs=2)
    env.reset()
    np.testing.assert_array_equal(copy.deepcopy(env).render(), env.render())
    gone = weakref.ref(env)
    del env
    gc.collect()
    assert gone() is None
