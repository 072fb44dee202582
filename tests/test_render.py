"""Pictures, films, and frames for TorchRL."""

import copy
import gc
import re
import sys
import weakref

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv, check_env_specs
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor, make_env
from torchrl_quad.render import animate_flight, figures, plot_episode, plot_flight, plot_learning_curve, write_replay
from torchrl_quad.render.frames import Scene

TASKS = ["hovering", "landing", "racing", "tracking"]


class Climbing(HoveringEnv):
    """A task of one's own, without target and metrics."""

    weights = {"climb": 1.0}

    def initial_state(self, n):
        return self.hover_state(self.uniform(n, 3) + self.tensor([0.0, 0.0, 2.0]))

    def observe(self, state):
        return state["position"]

    def reward_terms(self, state):
        return {"climb": state["velocity"][:, 2:]}

    def is_crash(self, state):
        return state["position"][:, 2:] <= 0

    def is_success(self, state):
        return state["position"][:, 2:] > 4

    def metrics(self, state):
        return {}


class Measured(Climbing):
    """The same with a metric."""

    def metrics(self, state):
        return {"vertical_speed": state["velocity"][:, 2:]}


def image(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved, by the order in which they are."""
    figures = []

    def savefig(self, path, save=Figure.savefig, **options):
        figures.append(self)
        save(self, path, **options)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return figures


def lines(axis):
    """What an axis shows, by name."""
    return {line.get_label(): line.get_xydata() for line in axis.lines if line.get_label()[0] != "_"}


# -- pictures and films ------------------------------------------------------------------------------------------------


def flown(flight):
    """The positions (time + 1, 3) of each first episode, from its start to its end."""
    start, ends = flight["state", "position"], flight["next", "state", "position"]
    steps = flight["next", "done"][..., 0].int().argmax(1) + 1
    return [torch.cat((s[:1], e[:n])) for s, e, n in zip(start, ends, steps, strict=True)]


def test_a_flight_with_crashes_and_fewer_environments_than_asked_for_is_drawn(drawn, crashing, tmp_path):
    flight = crashing(HoveringEnv(num_envs=3, max_episode_steps=40), 60)
    assert flight["next", "terminated"][1].any()
    plot_flight(flight, tmp_path / "flight.png")
    space, over_time = drawn[0].axes
    for path, line, expected in zip(space.lines, over_time.lines, flown(flight), strict=True):
        np.testing.assert_array_equal(np.stack(path.get_data_3d(), -1), expected)
        distance = (expected - flight["state", "target"][0, 0]).norm(dim=-1)
        time = 0.02 * torch.arange(len(expected))
        np.testing.assert_allclose(line.get_xydata(), torch.stack((time, distance), -1), rtol=1e-5)


class Wandering(HoveringEnv):
    """To another place in each episode."""

    def initial_state(self, n):
        return super().initial_state(n) | {"target": self.uniform(n, 3) + self.tensor([0.0, 0.0, 3.0])}


@pytest.mark.parametrize("task", ["landing", "racing", "tracking", "wandering"])
def test_the_targets_of_a_flight_are_those_of_its_first_episodes(task, drawn, monkeypatch, tmp_path):
    scenes = []
    monkeypatch.setattr(figures, "Scene", lambda *args, **still: scenes.append(still) or Scene(*args, **still))
    options = {"num_envs": 2, "max_episode_steps": 30}
    env = Wandering(**options) if task == "wandering" else make_env(task, **options)
    flight = env.rollout(70, break_when_any_done=False)
    plot_flight(flight, tmp_path / "flight.png")
    animate_flight(flight, tmp_path / "flight.gif")
    space, over_time = drawn[0].axes
    assert over_time.get_ylabel() == ("gates passed" if task == "racing" else "distance to the target [m]")
    name = "gate" if task == "racing" else "target"
    if task == "tracking":
        (line,) = [line for line in space.lines if line.get_label() == name]
        shown, expected = np.stack(line.get_data_3d(), -1), flight["state", "target"][0, :30]
        np.testing.assert_array_equal(shown[:30], expected)
        assert np.linalg.norm(np.diff(shown, axis=0), axis=-1).max() < 0.1  # without a chord to the next start
    else:
        (marks,) = [marks for marks in space.collections if marks.get_label() == name]
        shown = np.stack(marks._offsets3d, -1)
        expected = [episode[:n] for episode, n in zip(flight["next", "state", "target"], (30, 30), strict=True)]
        expected = torch.cat((flight["state", "target"][:, 0], *expected)).unique(dim=0)
        np.testing.assert_allclose(shown, expected, atol=6e-4)
    (still,) = scenes[0].values()
    np.testing.assert_array_equal(still, shown)


def test_a_flight_is_filmed_in_real_time_until_its_episodes_end(tmp_path):
    env = make_env("racing", num_envs=3, max_episode_steps=60)
    animate_flight(env.rollout(100, break_when_any_done=False), tmp_path / "flight.gif", fps=10)
    with Image.open(tmp_path / "flight.gif") as film:
        assert film.n_frames == 21
        assert film.info["duration"] == 100  # [ms], five control steps
        first, last = (np.asarray(film.convert("RGB")) for _ in map(film.seek, (0, 20)))
    assert (first != last).any()


def test_a_film_keeps_step_with_the_clock_and_shows_the_end(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(
        Scene, "draw", lambda self, *args, draw=Scene.draw, **kw: shown.append(args) or draw(self, *args, **kw)
    )
    flight = HoveringEnv(num_envs=1, control_dt=0.005).rollout(100)
    animate_flight(flight, tmp_path / "flight.gif", control_dt=0.005)
    with Image.open(tmp_path / "flight.gif") as film:
        starts = np.cumsum([0] + [film.info["duration"] for _ in map(film.seek, range(film.n_frames))])
    np.testing.assert_allclose(starts[:-1], [*range(0, 500, 65), 500], atol=5)  # [ms], of 13 control steps
    torch.testing.assert_close(shown[-1][0], flight["next", "state", "position"][:, -1])


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("drones", [[0], [0, 1]])
def test_positions_that_are_not_finite_are_left_out_of_every_picture(value, drones, drawn, tmp_path):
    env = HoveringEnv(num_envs=2)
    flight = env.rollout(8, break_when_any_done=False)
    state = env.reset()
    for position in (flight["state", "position"], flight["next", "state", "position"], state["state", "position"]):
        position[drones] = value
    plot_flight(flight, tmp_path / "flight.png")
    plot_episode(flight, tmp_path / "episode.png")
    animate_flight(flight, tmp_path / "flight.gif")
    for figure in drawn:
        space = figure.axes[0]
        limits = np.array([space.get_xlim(), space.get_ylim(), space.get_zlim()])
        assert np.ptp(limits, axis=1).max() < 8
    env._see(state["state"])
    assert (env.render() != 255).any(-1).sum() > 1000
    state["state", "position"][1] = torch.tensor([30.0, 0.0, 5.0])
    env._see(state["state"])
    assert (np.abs(env.render().astype(int) - [140, 212, 70]).sum(-1) < 90).any()  # the view follows the second drone


@pytest.mark.parametrize("shape", [(1,), (2, 3)])
def test_a_target_that_is_no_position_is_not_drawn(shape, drawn, tmp_path):
    class Own(Climbing):
        def initial_state(self, n):
            return super().initial_state(n) | {"target": torch.ones(n, *shape)}

    env = Own(num_envs=2, max_episode_steps=3)
    flight = env.rollout(8, break_when_any_done=False)
    plot_flight(flight, tmp_path / "flight.png")
    plot_episode(flight, tmp_path / "episode.png")
    animate_flight(flight, tmp_path / "flight.gif")
    write_replay(flight, tmp_path / "replay.html", env=env)
    assert drawn[0].axes[1].get_ylabel() == "reward" and set(lines(drawn[1].axes[2])) == {"reward"}
    td = env.rollout(2)[:, -1]
    before = env.render()
    env.reset(td.set("_reset", torch.tensor([[True], [False]])), set_state=False)
    assert (env.render() != before).any()


@pytest.mark.parametrize("cls", [Climbing, Measured])
def test_a_task_of_one_s_own_without_targets_is_drawn_filmed_and_rendered(cls, drawn, tmp_path):
    env = cls(num_envs=2, max_episode_steps=20)
    flight = env.rollout(20, break_when_any_done=False)
    plot_flight(flight, tmp_path / "flight.png")
    plot_episode(flight, tmp_path / "episode.svg")
    animate_flight(flight, tmp_path / "flight.gif")
    name = "vertical speed" if cls is Measured else "reward"
    assert drawn[0].axes[1].get_ylabel() == name
    (line,) = lines(drawn[1].axes[2]).values()
    np.testing.assert_allclose(line[1:, 1], flight["next", "reward"][0, :, 0], rtol=1e-6)
    assert image(tmp_path / "flight.gif").shape == env.render().shape == (336, 336, 3)


# -- figures for papers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_of_every_task_is_drawn_with_what_flew(task, drawn, tmp_path):
    env = make_env(task, num_envs=3, max_episode_steps=40)
    flight, _ = differentiable_rollout(env, make_actor(env), None, 100)  # with its graph, and three episodes
    plot_episode(flight, tmp_path / "episode.pdf", env_index=1, control_dt=env.control_dt)
    space, _, error, action, rotors = drawn[0].axes
    first = flight[1, :40]
    first = first[: first["next", "done"][:, 0].tolist().index(True) + 1]
    time = 0.02 * torch.arange(len(first) + 1)
    path = torch.as_tensor(np.asarray(space.collections[0]._segments3d))
    torch.testing.assert_close(path[:, 1].float(), first["next", "state", "position"].detach())
    target, position = (first["next", "state", name].detach() for name in ("target", "position"))
    low, high = torch.tensor([space.get_xlim(), space.get_ylim(), space.get_zlim()]).T
    assert all(((low - 0.1 <= x) & (x <= high + 0.1)).all() for x in (first["state", "target"], position))
    assert (high - low).max() < 8  # and they fill the view
    distance = lines(error)["to the next gate" if task == "racing" else "to the target"]
    torch.testing.assert_close(torch.as_tensor(distance[:, 0]), time.double(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(torch.as_tensor(distance[1:, 1]).float(), (position - target).norm(dim=-1))
    more = {"landing": {"over ground"}, "tracking": {"RMSE"}}.get(task, set())
    assert set(lines(error)) - more == {"to the next gate" if task == "racing" else "to the target"}
    assert more <= set(lines(error))
    shown = lines(action)
    assert list(shown) == ["thrust", "roll rate", "pitch rate", "yaw rate"]
    for line, values in zip(shown.values(), first["action"].detach().T, strict=True):
        np.testing.assert_allclose(line[:, 0], time)
        np.testing.assert_array_equal(line[:, 1], [*values, values[-1]])  # the last one, too, lasts a step
    for line, values in zip(lines(rotors).values(), first["next", "state", "rotor_speed"].detach().T, strict=True):
        np.testing.assert_array_equal(line[1:, 1], values)


def test_the_gates_of_an_episode_are_numbered_and_passing_them_is_marked(drawn, tmp_path):
    env = make_env("racing", num_envs=2, max_episode_steps=100)
    td = env.reset()
    gate = env.gates[td["state", "gate"][0, 0]]
    td["state", "position"][0] = gate - torch.tensor([1.0, 0.0, 0.0])
    td["state", "velocity"][0] = torch.tensor([5.0, 0.0, 0.0])
    flight = env.rollout(
        60, lambda td: td.set("action", env.hover_action.expand(2, 4)), tensordict=env.reset(td, set_state=True),
        auto_reset=False, break_when_any_done=False,
    )  # fmt: skip
    step = flight["next", "state", "gate_passed"][0, :, 0].tolist().index(True)
    plot_episode(flight, tmp_path / "episode.png")
    space, _, *panels = drawn[0].axes
    start = td["state", "gate"][0].item()
    assert [int(text.get_text()) for text in space.texts] == [start + 1, (start + 1) % 4 + 1]
    for panel in panels:
        (mark,) = [line for line in panel.lines if line.get_linestyle() == ":"]
        assert mark.get_xdata()[0] == pytest.approx(0.02 * (step + 1))


def test_the_fonts_of_a_figure_are_embedded_as_truetype_and_it_is_as_wide_as_two_columns(tmp_path):
    flight = HoveringEnv(num_envs=1).rollout(10)
    for suffix in ("pdf", "png"):
        plot_episode(flight, tmp_path / f"episode.{suffix}")
    pdf = (tmp_path / "episode.pdf").read_bytes()
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf
    width, _ = (float(x) / 72 for x in re.search(rb"/MediaBox \[\s*0 0 ([\d.]+) ([\d.]+)", pdf).groups())
    assert width == pytest.approx(7.16, abs=0.01)
    assert image(tmp_path / "episode.png").shape[1] == 2148  # 300 dots per inch


def test_what_cannot_be_drawn_is_named(tmp_path):
    flight = HoveringEnv(num_envs=2).rollout(5)
    path = tmp_path / "flight.png"
    for draw in (plot_flight, plot_episode, animate_flight):
        with pytest.raises(ValueError, match=rf"{draw.__name__} .*\(num_envs, time\).* got \(5,\).*unsqueeze\(0\)"):
            draw(flight[0], path)
        with pytest.raises(ValueError, match=rf"{draw.__name__} .* got \(2, 0\)"):
            draw(flight[:, :0], path)
        with pytest.raises(ValueError, match=rf"{draw.__name__}: the rollout lacks .*'position'.*Hand it over whole"):
            draw(flight.exclude(("next", "state", "position")), path)
    for draw in (plot_flight, animate_flight):
        with pytest.raises(ValueError, match=f"{draw.__name__}: num_envs must be at least 1, got 0"):
            draw(flight, path, num_envs=0)
    with pytest.raises(ValueError, match=r"the rollout lacks \('state', 'rotor_speed'\), "):
        plot_episode(flight.exclude(("state", "rotor_speed"), ("next", "state", "rotor_speed")), path)
    with pytest.raises(IndexError, match="env_index=2, and the rollout has 2 environments"):
        plot_episode(flight, path, env_index=2)
    with pytest.raises(ValueError, match=r"Format 'docx' is not supported \(supported formats: .*pdf, .*png"):
        plot_episode(flight, tmp_path / "flight.docx")


def test_drawing_leaves_the_user_s_matplotlib_alone(tmp_path):
    import matplotlib
    from matplotlib import pyplot

    matplotlib.use("svg")
    settings = dict(matplotlib.rcParams)
    env = HoveringEnv(num_envs=1)
    flight = env.rollout(5)
    for draw in (plot_flight, plot_episode, animate_flight):
        draw(flight, tmp_path / ("flight.gif" if draw is animate_flight else "flight.png"))
    env.render()
    assert not pyplot.get_fignums()
    assert matplotlib.get_backend() == "svg"
    assert dict(matplotlib.rcParams) == settings


# -- frames ------------------------------------------------------------------------------------------------------------


def recorded(env, **options):
    """The environment filmed, and the film in the memory of the recorder."""
    return TransformedEnv(env, Compose(PixelRenderTransform(**options), VideoRecorder(None, None)))


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
    assert video.dtype == torch.uint8
    assert (video[0, 0] != video[0, -1]).any()
    frame = torch.as_tensor(rollout["next"][..., -1].get("pixels").tolist()[0])
    assert torch.equal(video[0, -1], frame.permute(2, 0, 1))  # upright


def test_wandb_shows_the_video(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    logger = WandbLogger("run", offline=True, log_dir=str(tmp_path))
    env = HoveringEnv(num_envs=2)
    filmed = TransformedEnv(env, Compose(PixelRenderTransform(), VideoRecorder(logger, "flight", fps=50)))
    filmed.rollout(5)
    filmed.transform.dump()
    logger.experiment.finish()
    (video,) = tmp_path.glob("wandb/offline-run-*/files/media/videos/flight_*.mp4")
    assert b"ftyp" in video.read_bytes()[:16]


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


def falls_first(env):
    """The tensordict after a reset in which drone 0 is about to hit the ground."""
    td = env.reset()
    td["state", "position"][0, 2] = 0.05
    td["state", "velocity"][0, 2] = -2.0
    return env.reset(td, set_state=True)


def test_after_a_partial_reset_one_drone_has_begun_anew_and_the_others_fly_on():
    env = HoveringEnv(num_envs=2)
    filmed = recorded(env)
    rollout = filmed.rollout(3, tensordict=falls_first(filmed), auto_reset=False, break_when_any_done=False)
    (step,) = rollout["next", "terminated"][0, :, 0].nonzero().flatten().tolist()
    assert len(filmed.transform[1].obs) >= 5  # a start more
    frame = 3 + step  # two resets and the start stand before the first step; this comes after the crash
    begun = rollout[:, step + 1]
    assert begun["state", "step"].flatten().tolist() == [0, step + 1]
    env.reset(begun.clone(), set_state=True)
    shown = filmed.transform[1].obs[frame].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(shown, env.render())


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_is_rendered_is_where_the_last_step_or_rollout_has_led_to(compile):
    env = HoveringEnv(num_envs=2, compile=compile)
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


class Witness(torch.autograd.Function):
    """Does nothing, and lives as long as the graph it stands in."""

    @staticmethod
    def forward(ctx, x, witness):
        ctx.witness = witness
        return x.clone()

    @staticmethod
    def backward(ctx, grad):
        return grad, None


def test_no_graph_is_kept_for_pictures():
    env = HoveringEnv(num_envs=2, action_delay=0)
    witness = torch.nn.Identity()
    lives = weakref.ref(witness)
    flight = env.step(env.reset().set("action", Witness.apply(torch.zeros(2, 4, requires_grad=True), witness)))
    assert flight["next", "state", "position"].requires_grad
    del witness
    gc.collect()
    assert lives() is not None
    del flight
    gc.collect()
    assert lives() is None
    env.render()
    env.rollout(50, make_actor(env), break_when_any_done=False)
    assert sum(x.untyped_storage().nbytes() for x in env._seen.values()) == 2 * 10 * 4  # and not the whole rollout


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


def test_without_a_state_or_with_drones_that_are_not_there_rendering_is_refused():
    env = HoveringEnv(num_envs=2)
    with pytest.raises(ValueError, match=r"there is none yet. Call env.reset\(\) first."):
        env.render()
    env.reset()
    for drones in ([2], [-1], []):
        with pytest.raises(ValueError, match=r"indices from 0 to 1, at least one, such as drones=\[0\]"):
            env.render(drones)
    with pytest.raises(ValueError, match="size must be at least 100 pixels, got 20"):
        env.render(size=20)


def test_an_environment_that_has_been_rendered_is_copied_and_forgotten():
    env = HoveringEnv(num_envs=2)
    env.reset()
    np.testing.assert_array_equal(copy.deepcopy(env).render(), env.render())
    gone = weakref.ref(env)
    del env
    gc.collect()
    assert gone() is None


# -- learning ----------------------------------------------------------------------------------------------------------


def test_a_learning_curve_is_drawn_from_its_csv(drawn, tmp_path):
    (tmp_path / "metrics.csv").write_text(
        "steps,time/seconds,eval/return,eval/success,eval/position_error\n100,1.0,5.0,0.0,1.0\n200,2.0,20.0,1.0,0.02\n"
    )
    plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    shown = {axis.get_ylabel(): axis.lines[0].get_xydata().tolist() for axis in drawn[0].axes}
    assert shown == {
        "return": [[1, 5], [2, 20]],
        "success [%]": [[1, 0], [2, 100]],
        "median error [cm]": [[1, 100], [2, 2]],
    }


@pytest.mark.parametrize("rows", ["0,0.0,5.0,,\n", "0,0.0,5.0,,none\n100,1.0,6.0,0.5,none\n"])
def test_a_learning_curve_has_gaps_where_cells_are_empty(drawn, tmp_path, rows):
    (tmp_path / "metrics.csv").write_text("steps,time/seconds,eval/return,eval/success,note\n" + rows)
    plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    shown = drawn[0].axes[1].lines[0].get_ydata()
    assert len(shown) == rows.count("\n") and np.isnan(shown[0])


def test_a_learning_curve_of_nothing_is_refused(tmp_path):
    path = tmp_path / "metrics.csv"
    for text, message in (("steps,eval/return\n", "has no row yet"), ("steps\n1\n", "needs the columns .* has steps")):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            plot_learning_curve(path, tmp_path / "curve.png")


def test_a_run_draws_no_flight_twice(launch, monkeypatch, tmp_path):
    import run

    drawn = []
    monkeypatch.setattr(run.Run, "_log_flight", lambda self, flight, steps: drawn.append(steps))
    monkeypatch.setattr(run, "publish_flight", lambda *_: None)
    small = ["num_envs=4", "horizon=6", "total_steps=48", "eval.interval=1", "env.max_episode_steps=6", "compile=false"]
    launch("bptt", *small, "logger.flight_every=1", f"hydra.run.dir={tmp_path}")
    assert drawn == [24, 48]


@pytest.mark.parametrize("draw", [plot_flight, plot_episode, animate_flight, "render"])
def test_without_matplotlib_it_says_what_to_install(draw, monkeypatch, tmp_path):
    env = HoveringEnv(num_envs=2)
    flight = env.rollout(5)
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl_quad\[render\]'"):
        env.render() if draw == "render" else draw(flight, tmp_path / "flight.png")
