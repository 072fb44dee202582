"""What tasks say about themselves, for reports and pictures."""

import pytest
import torch
from refusals import cases, refuses

from torchrl_quad import HoveringEnv, make_env
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
    assert Metric("speed").summarise(values) == 4.0
    assert Metric("error", median=True).summarise(values) == 2.0
    assert Metric("lap time", "s").format(Metric("lap time").summarise(values[1:2])) == "none"
    assert describe_metric("top_speed", {}) == Metric("top speed")
    assert describe_metric("solved", {}) is EPISODE_METRICS["solved"]
    assert describe_metric("solved", {"solved": Metric("landed")}).label == "landed"


@pytest.mark.parametrize("task", TASKS)
def test_a_task_describes_every_metric_that_it_gives(task):
    env = make_env(task, num_envs=2)
    rollout = env.rollout(3, break_when_any_done=False)
    names = {*env.episode_metrics(rollout), *rollout["next", "metrics"].keys()}
    assert names == set(env.metric_info)
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
