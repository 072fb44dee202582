"""Figures, films and learning curves."""

import pickle
import re

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from helpers import cases, refuses
from matplotlib.figure import Figure
from own_task import CornerEnv
from PIL import Image
from torchrl.envs import RewardSum, TransformedEnv

from torchrl_quad import ActionSequence, HoveringEnv, differentiable_rollout, envs, make_actor, make_env
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric
from torchrl_quad.render import animate_flight, plot_episode, plot_flight, plot_learning_curve, video, write_replay
from torchrl_quad.render.video import View

TASKS = ["hovering", "landing", "racing", "tracking"]


class Plain(CornerEnv):
    """A user's task, without target and metrics."""

    metric_info = EPISODE_METRICS

    def metrics(self, state):
        return {}


class Measured(CornerEnv):
    """The same with a metric, which is its reward, too."""

    weights = {"distance": -1.0}
    metric_info = {**EPISODE_METRICS, "corner_error": Metric("distance to the corner", "cm", 100.0)}


class Wandering(HoveringEnv):
    """To another place in each episode."""

    def initial_state(self, n):
        return super().initial_state(n) | {"target": self.uniform(n, 3) + self.tensor([0.0, 0.0, 3.0])}


def image(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


@pytest.fixture
def views(monkeypatch):
    """The views of films, and what each frame of them was drawn from."""
    drawn = []

    class Recorded(View):
        def __init__(self, points, num_drones, size, markers, image=None):
            super().__init__(points, num_drones, size, markers, image)
            self.markers = markers

        def draw(self, *args, **options):
            drawn.append((self, args, options))
            return super().draw(*args, **options)

    monkeypatch.setattr(video, "View", Recorded)
    return drawn


def lines(axis):
    """The lines of an axis, by name."""
    return {line.get_label(): line.get_xydata() for line in axis.lines if line.get_label()[0] != "_"}


def flown(flight):
    """The positions (time + 1, 3) of each first episode, from its start to its end."""
    start, ends = flight["state", "position"], flight["next", "state", "position"]
    steps = flight["next", "done"][..., 0].int().argmax(1) + 1
    return [torch.cat((s[:1], e[:n])) for s, e, n in zip(start, ends, steps, strict=True)]


def test_a_flight_with_crashes_and_fewer_environments_than_asked_for_is_drawn(crashing):
    flight = crashing(HoveringEnv(num_envs=3, max_episode_steps=40), 60)
    assert flight["next", "terminated"][1].any()
    space, over_time = plot_flight(flight).axes
    for path, line, expected in zip(space.lines, over_time.lines, flown(flight), strict=True):
        np.testing.assert_array_equal(np.stack(path.get_data_3d(), -1), expected)
        distance = (expected - flight["state", "target"][0, 0]).norm(dim=-1)
        time = 0.02 * torch.arange(len(expected))
        np.testing.assert_allclose(line.get_xydata(), torch.stack((time, distance), -1), rtol=1e-5)


@pytest.mark.parametrize("task", ["landing", "racing", "tracking", "wandering"])
def test_without_the_environment_targets_are_those_of_the_first_episodes(task, views, tmp_path):
    options = {"num_envs": 2, "max_episode_steps": 30}
    env = Wandering(**options) if task == "wandering" else make_env(task, **options)
    flight = env.rollout(70, break_when_any_done=False)
    space, over_time = plot_flight(flight).axes
    animate_flight(flight, tmp_path / "flight.gif")
    assert over_time.get_ylabel() == "distance to the target [m]"
    if task == "tracking":
        (line,) = [line for line in space.lines if line.get_label() == "target"]
        shown, expected = np.stack(line.get_data_3d(), -1), flight["state", "target"][0, :30]
        np.testing.assert_array_equal(shown[:30], expected)
        assert np.linalg.norm(np.diff(shown, axis=0), axis=-1).max() < 0.1  # without a chord to the next start
    else:
        (marks,) = [marks for marks in space.collections if marks.get_label() == "target"]
        shown = np.stack(marks._offsets3d, -1)
        expected = [episode[:n] for episode, n in zip(flight["next", "state", "target"], (30, 30), strict=True)]
        expected = torch.cat((flight["state", "target"][:, 0], *expected)).unique(dim=0)
        np.testing.assert_allclose(shown, expected, atol=6e-4)
    markers = views[0][0].markers
    (still,) = (x for x in (markers.places, markers.curve) if x is not None)
    np.testing.assert_array_equal(still, shown)


@pytest.mark.parametrize("transformed", [False, True])
def test_the_environment_provides_the_control_step_the_markers_and_the_units(transformed, views, tmp_path):
    env = make_env("racing", num_envs=2, max_episode_steps=20, control_dt=0.04)
    flight = env.rollout(20, break_when_any_done=False)
    named = TransformedEnv(env, RewardSum()) if transformed else env
    space, over_time = plot_flight(flight, env=named).axes
    animate_flight(flight, tmp_path / "flight.gif", env=named)
    assert over_time.get_ylabel() == "gates passed" and over_time.lines[0].get_xdata()[-1] == pytest.approx(0.8)
    (marks,) = [marks for marks in space.collections if marks.get_label() == "gate"]
    rims = np.asarray(marks._segments3d)
    np.testing.assert_allclose(rims[:, :-1].mean(1), env.gates, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(rims - env.gates[:, None].numpy(), axis=-1), 0.3, atol=1e-5)
    assert [line.get_ydata()[0] for line in over_time.lines if line.get_label() == "success: 8"] == [8]
    assert torch.equal(views[0][0].markers.gates, env.gates)
    with Image.open(tmp_path / "flight.gif") as film:
        assert sum(film.info["duration"] for _ in map(film.seek, range(film.n_frames))) == pytest.approx(840, abs=50)


def test_a_film_keeps_step_with_the_clock_and_shows_the_end(tmp_path, views):
    flight = HoveringEnv(num_envs=1, control_dt=0.005).rollout(100)
    for suffix in ("mp4", "gif"):
        animate_flight(flight, tmp_path / f"flight.{suffix}", control_dt=0.005)
    with Image.open(tmp_path / "flight.gif") as film:
        starts = np.cumsum([0] + [film.info["duration"] for _ in map(film.seek, range(film.n_frames))])
    np.testing.assert_allclose(starts[:-1], [*range(0, 500, 65), 500], atol=5)  # [ms], of 13 control steps
    torch.testing.assert_close(views[-1][1][0], flight["next", "state", "position"][:, -1])
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "flight.mp4"))
    assert frames == len(starts) - 1 and seconds == pytest.approx(0.065 * frames, abs=0.01)
    animate_flight(flight, tmp_path / "flight.gif", control_dt=0.005, max_seconds=0.25)
    torch.testing.assert_close(views[-1][1][0], flight["next", "state", "position"][:, 49])


def test_a_film_of_two_flights_shows_them_side_by_side_in_one_view(tmp_path, views):
    one, other = (HoveringEnv(num_envs=2, seed=seed).rollout(12) for seed in (0, 1))
    animate_flight(one, tmp_path / "flight.gif", beside=other, labels=("left", "right"), size=120)
    with Image.open(tmp_path / "flight.gif") as film:
        assert film.size == (240, 120)
        picture = np.asarray(film.convert("RGB"))
    assert np.abs(picture[:, :120].astype(int) - picture[:, 120:]).max() > 50
    (left, drones, words), (right, others, _) = views[-2:]
    torch.testing.assert_close(drones[0], one["next", "state", "position"][:, -1])
    torch.testing.assert_close(others[0], other["next", "state", "position"][:, -1])
    assert torch.equal(left.low, right.low) and words["text"] == "0.2 s  left"


@pytest.mark.parametrize(("value", "drones"), [(torch.nan, [0]), (torch.inf, [0, 1])])
def test_positions_that_are_not_finite_are_left_out_of_every_picture(value, drones, tmp_path):
    flight = HoveringEnv(num_envs=2).rollout(8, break_when_any_done=False)
    for position in (flight["state", "position"], flight["next", "state", "position"]):
        position[drones] = value
    animate_flight(flight, tmp_path / "flight.gif")
    for figure in (plot_flight(flight), plot_episode(flight)):
        space = figure.axes[0]
        limits = np.array([space.get_xlim(), space.get_ylim(), space.get_zlim()])
        assert np.ptp(limits, axis=1).max() < 8


@pytest.mark.parametrize("shape", [(1,), (2, 3)])
def test_a_target_that_is_no_position_is_not_drawn(shape, tmp_path):
    class Own(Plain):
        def initial_state(self, n):
            return super().initial_state(n) | {"target": torch.ones(n, *shape)}

    env = Own(num_envs=2, max_episode_steps=3)
    flight = env.rollout(8, break_when_any_done=False)
    animate_flight(flight, tmp_path / "flight.gif", env=env)
    write_replay(flight, env=env)
    assert plot_flight(flight, env=env).axes[1].get_ylabel() == "reward"
    assert set(lines(plot_episode(flight, env=env).axes[2])) == {"reward"}
    before = env.render()
    env.reset()
    assert (env.render() != before).any()


@cases((Plain, True, "reward"), (Measured, False, "corner error"), (Measured, True, "distance to the corner [cm]"))
def test_a_task_without_targets_shows_its_metrics_or_its_reward(cls, given, name, tmp_path):
    env = cls(num_envs=2, max_episode_steps=20)
    flight = env.rollout(20, break_when_any_done=False)
    options = {"env": env} if given else {}
    animate_flight(flight, tmp_path / "flight.gif", **options)
    assert plot_flight(flight, **options).axes[1].get_ylabel() == name
    ((shown, line),) = lines(plot_episode(flight, tmp_path / "episode.svg", **options).axes[2]).items()
    assert shown == name
    scale = 100.0 if "cm" in name else 1.0
    np.testing.assert_allclose(line[1:, 1], scale * flight["next", "reward"][0, :, 0], rtol=1e-6)
    assert image(tmp_path / "flight.gif").shape == env.render().shape == (336, 336, 3)


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_of_every_task_is_drawn_with_what_flew(task, tmp_path):
    env = make_env(task, num_envs=3, max_episode_steps=40)
    flight, _ = differentiable_rollout(env, make_actor(env), None, 100)  # with its graph, and three episodes
    space, _, error, action, rotors = plot_episode(flight, tmp_path / "episode.pdf", env=env, env_index=1).axes
    first = flight[1, :40]
    first = first[: first["next", "done"][:, 0].tolist().index(True) + 1]
    time = 0.02 * torch.arange(len(first) + 1)
    target, position = (first["next", "state", name].detach() for name in ("target", "position"))
    path = torch.as_tensor(np.asarray(space.collections[0]._segments3d))
    torch.testing.assert_close(path[:, 1].float(), position)
    low, high = torch.tensor([space.get_xlim(), space.get_ylim(), space.get_zlim()]).T
    assert all(((low - 0.1 <= x) & (x <= high + 0.1)).all() for x in (first["state", "target"], position))
    assert (high - low).max() < (9 if task == "racing" else 8)  # and they fill the view, with all gates in it
    names = {"landing": {"distance over ground"}, "tracking": {"tracking RMSE"}}.get(task, set())
    names |= {"success: below 0.1"} if task in ("hovering", "tracking") else set()
    name = "to the next gate" if task == "racing" else "to the target"
    assert set(lines(error)) == names | {name}
    distance = torch.as_tensor(lines(error)[name])
    torch.testing.assert_close(distance[:, 0], time.double(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(distance[1:, 1].float(), (position - target).norm(dim=-1))
    shown = lines(action)
    assert list(shown) == ["thrust", "roll rate", "pitch rate", "yaw rate"]
    for line, values in zip(shown.values(), first["action"].detach().T, strict=True):
        np.testing.assert_allclose(line[:, 0], time)
        np.testing.assert_array_equal(line[:, 1], [*values, values[-1]])  # the last one, too, lasts a step
    for line, values in zip(lines(rotors).values(), first["next", "state", "rotor_speed"].detach().T, strict=True):
        np.testing.assert_array_equal(line[1:, 1], values)


@pytest.mark.parametrize("task", envs.TASKS)
def test_an_episode_of_one_step_is_drawn(task):
    env = make_env(task, num_envs=1, max_episode_steps=1)
    assert plot_episode(env.rollout(1, break_when_any_done=False), env=env).axes[-1].get_xlim() == (0.0, 0.02)


def test_without_rotors_in_the_state_there_is_no_panel_of_them():
    last = plot_episode(make_env("hovering", num_envs=1, dynamics="point_mass").rollout(3)).axes[-1]
    assert last.get_ylabel() == "action" and last.get_xlabel() == "time [s]"


def test_the_gates_of_an_episode_are_numbered_and_passing_them_is_marked():
    env = make_env("racing", num_envs=2, max_episode_steps=100)
    td = env.reset()
    gate = env.gates[td["state", "gate"][0, 0]]
    td["state", "position"][0] = gate - torch.tensor([1.0, 0.0, 0.0])
    td["state", "velocity"][0] = torch.tensor([5.0, 0.0, 0.0])
    hover = ActionSequence(env.hover_action.expand(60, 2, 4))
    flight, _ = differentiable_rollout(env, hover, env.reset(td, set_state=True), 60)
    step = flight["next", "state", "gate_passed"][0, :, 0].tolist().index(True)
    space, _, *panels = plot_episode(flight, env=env).axes
    assert [int(text.get_text()) for text in space.texts] == [1, 2, 3, 4]  # also those that it does not reach
    for panel in panels:
        (mark,) = [line for line in panel.lines if line.get_linestyle() == ":"]
        assert mark.get_xdata()[0] == pytest.approx(0.02 * (step + 1))


def test_the_fonts_of_a_figure_are_embedded_as_truetype_and_it_is_as_wide_as_two_columns(tmp_path):
    flight = HoveringEnv(num_envs=1).rollout(10)
    for name in ("episode.pdf", "episode"):  # without a suffix it is a PNG
        plot_episode(flight, tmp_path / name)
    pdf = (tmp_path / "episode.pdf").read_bytes()
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf
    width, _ = (float(x) / 72 for x in re.search(rb"/MediaBox \[\s*0 0 ([\d.]+) ([\d.]+)", pdf).groups())
    assert width == pytest.approx(7.16, abs=0.01)
    assert image(tmp_path / "episode.png").shape[1] == 2148  # 300 dots per inch


def test_without_a_path_a_figure_is_returned_and_shows_itself_in_a_notebook(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = make_env("forest", num_envs=2)
    flight = env.rollout(5, break_when_any_done=False)
    for figure in (plot_flight(flight, env=env), plot_episode(flight, env=env)):
        assert isinstance(figure, Figure) and figure._repr_png_().startswith(b"\x89PNG")
    assert not list(tmp_path.iterdir())
    assert pickle.loads(pickle.dumps(figure))._repr_png_() == figure._repr_png_()


@pytest.fixture
def draw(tmp_path):
    """Draws a CSV file with these lines; returns the axes."""

    def draw(*rows, **options):
        (tmp_path / "metrics.csv").write_text("\n".join((*rows, "")))
        return plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png", **options).axes

    return draw


def test_metrics_are_drawn_in_their_units_in_the_order_of_the_task(draw):
    head = "steps,time/seconds,eval/position_error,eval/return,eval/top_speed,eval/solved,train/loss"
    rows = head, "100,1.0,1.0,5.0,3.0,0.0,9.0", "200,2.0,0.02,20.0,4.0,1.0,8.0"
    axes = draw(*rows, metrics=HoveringEnv.metric_info)
    shown = {axis.get_ylabel(): axis.lines[0].get_xydata().tolist() for axis in axes}
    assert list(shown) == ["return", "episodes solved [%]", "position error [cm], median", "top speed"]
    assert shown["episodes solved [%]"] == [[1, 0], [2, 100]]
    assert shown["position error [cm], median"] == [[1, 100], [2, 2]]
    labels = [axis.get_ylabel() for axis in draw(*rows)]
    assert labels == ["return", "episodes solved [%]", "position error", "top speed"]


def test_a_learning_curve_has_gaps_where_cells_are_empty_and_one_of_nothing_is_refused(draw):
    axes = draw("steps,time/seconds,eval/return,eval/solved,note", "0,0.0,5.0,,none", "100,1.0,6.0,0.5,none")
    assert np.isnan(axes[1].lines[0].get_ydata()).tolist() == [True, False]
    refuses("has no row yet", draw, "steps,eval/return")
    refuses("needs the columns .* has steps", draw, "steps", "1")
