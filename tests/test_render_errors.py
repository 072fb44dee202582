"""What pictures refuse, need, and leave alone, and that results do not depend on them."""

import errno
import sys
from types import SimpleNamespace
from unittest.mock import Mock

import imageio_ffmpeg
import pytest
from helpers import SMALL, refuses

from torchrl_quad import HoveringEnv
from torchrl_quad.render import animate_flight, plot_episode, plot_flight, video, write_replay
from torchrl_quad.render.video import NoFfmpeg
from torchrl_quad.training import drawing


def film(*args, **options):
    animate_flight(*args, "flight.gif", **options)


DRAW = {"plot_flight": plot_flight, "plot_episode": plot_episode, "write_replay": write_replay, "animate_flight": film}


@pytest.fixture(autouse=True)
def in_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_what_cannot_be_drawn_is_named(tmp_path):
    flight = HoveringEnv(num_envs=2).rollout(5)
    calls = [
        (plot_flight, flight, {"num_envs": 0}, "num_envs must be at least 1, got 0"),
        (plot_episode, flight, {"env_index": 2}, "env_index=2, and the rollout has 2 environments"),
        (animate_flight, flight, {"path": "flight.avi"}, r"animate_flight writes \.gif and \.mp4, got flight\.avi"),
        (plot_episode, flight, {"path": "flight.docx"}, "Format 'docx' is not supported .*: .*pdf, .*png"),
    ]
    for name, draw in DRAW.items():
        calls += [
            (draw, flight[0], {}, rf"{name} .*\(num_envs, time\).* got \(5,\).*unsqueeze\(0\)"),
            (draw, flight[:, :0], {}, rf"{name} .* got \(2, 0\)"),
            (draw, flight.exclude(("next", "state", "position")), {}, f"{name}: .* lacks .*'position'.*Pass it whole"),
            (draw, flight, {"env": "hovering"}, f"{name}: env must be the quadrotor environment .* got str"),
        ]
    for draw, rollout, options, message in calls:
        refuses(message, draw, rollout, error=(ValueError, TypeError, IndexError), **options)
    assert not list(tmp_path.iterdir())


def test_drawing_leaves_the_user_s_matplotlib_alone():
    import matplotlib
    from matplotlib import pyplot

    matplotlib.use("svg")
    settings = dict(matplotlib.rcParams)
    env = HoveringEnv(num_envs=1)
    flight = env.rollout(5)
    for draw in DRAW.values():
        draw(flight)
    env.render()
    assert not pyplot.get_fignums()
    assert matplotlib.get_backend() == "svg" and dict(matplotlib.rcParams) == settings


def test_without_matplotlib_or_ffmpeg_it_says_what_to_install(monkeypatch):
    env = HoveringEnv(num_envs=2)
    flight = env.rollout(5)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"MP4 need imageio-ffmpeg: pip install '.\[render\]'"):
        animate_flight(flight, "flight.mp4")
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    for draw in (plot_flight, plot_episode, film, lambda _: env.render()):
        refuses(r"pip install '.\[render\]'", draw, flight, error=ImportError)


WORKS = imageio_ffmpeg.get_ffmpeg_exe()
BROKEN = {
    "missing": None,
    "not executable": f'exec {WORKS} "$@"',
    "fails": "echo no encoder >&2; exit 3",
    "does nothing": "cat >/dev/null",
    "killed later": "head -c 100 >/dev/null; kill -9 $$",
    "killed at the end": f'{WORKS} "$@"; kill -9 $$',
    "hangs": "exec sleep 60",
    "hangs at the end": "cat >/dev/null; exec sleep 60",
}


@pytest.fixture
def broken_ffmpeg(tmp_path, monkeypatch):
    def broken(kind):
        path = tmp_path / "ffmpeg"
        if (script := BROKEN[kind]) is not None:
            path.write_text(f"#!/bin/sh\n{script}\n")
            path.chmod(0o644 if kind == "not executable" else 0o755)
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(path))

    return broken


@pytest.mark.parametrize("kind", BROKEN)
def test_an_ffmpeg_that_does_not_work_is_named_with_the_reason(kind, broken_ffmpeg, monkeypatch, tmp_path):
    env = HoveringEnv(num_envs=1)
    broken_ffmpeg(kind)
    why = r"\(.+\)"
    if kind.startswith("hangs"):
        monkeypatch.setattr(video, "_PATIENCE", 0.5)
        why = r"\(no progress for 0.5 s\)"
    with pytest.raises(NoFfmpeg, match=rf"writes H.264, and \S+ does not {why}. .*unset IMAGEIO_FFMPEG_EXE"):
        animate_flight(env.rollout(3), tmp_path / "film.mp4", env=env)


def test_where_no_ffmpeg_works_the_film_is_a_gif_and_a_line_says_why(broken_ffmpeg, monkeypatch, capsys, tmp_path):
    env = HoveringEnv(num_envs=1)
    flight, path = env.rollout(3), tmp_path / "flight"
    drawing.draw_flight(flight, path, env, "one")
    assert path.with_suffix(".mp4").exists() and not capsys.readouterr().err
    broken_ffmpeg("fails")
    drawing.draw_flight(flight, path, env, "one")
    assert path.with_suffix(".gif").read_bytes().startswith(b"GIF") and not path.with_suffix(".mp4").exists()
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"Warning: {path}.gif takes the place of an MP4. Films in MP4 need ")
    monkeypatch.undo()
    drawing.draw_flight(flight, path, env, "one")
    assert path.with_suffix(".mp4").exists() and not path.with_suffix(".gif").exists()


def test_an_ffmpeg_that_cannot_be_found_is_installed_anew(monkeypatch, tmp_path):
    missing = Mock(side_effect=RuntimeError("No ffmpeg exe could be found."))
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    with pytest.raises(NoFfmpeg, match=r"No ffmpeg exe could be found.*pip install --force-reinstall"):
        animate_flight(HoveringEnv(num_envs=1).rollout(3), tmp_path / "flight.mp4")


FAILURES = {
    "disk full": (OSError(errno.ENOSPC, "No space left on device"), False),
    "broken font": (RuntimeError("Can not load face\n(unknown file format)"), True),
}


@pytest.mark.parametrize("kind", FAILURES)
def test_a_run_whose_pictures_all_fail_has_its_results_and_says_what_is_missing(kind, launch, monkeypatch, tmp_path):
    (error, traced), said = FAILURES[kind], []
    for name in ("plot_flight", "plot_episode", "animate_flight", "write_replay", "plot_learning_curve"):
        monkeypatch.setattr(drawing, name, Mock(side_effect=error))
    monkeypatch.setattr(drawing, "_warn", said.append)
    for old in ("flight.mp4", "flight.gif", "flight.html"):
        (tmp_path / old).touch()
    launch("bptt", *SMALL, "total_steps=48", f"hydra.run.dir={tmp_path}", "logger.backend=wandb")
    launch("evaluate", f"checkpoint={tmp_path}/checkpoint.pt")
    missing = ["flight.png", "flight.mp4", "episode.pdf", "flight.html", "learning_curve.png"]
    missing += [f"evaluation.{x}" for x in ("png", "mp4", "pdf", "html")]
    assert [line.split(" is missing. ")[0] for line in said] == [f"{tmp_path}/{name}" for name in missing]
    names = {path.name for path in tmp_path.iterdir()}
    assert {"summary.json", "metrics.csv", "checkpoint.pt", "evaluation.json"} <= names
    assert not {name for name in names if name.endswith((".png", ".mp4", ".gif", ".pdf", ".html"))}
    assert ("drawing.log" in names) == traced
    assert not any("\n" in line for line in said)
    if traced:
        assert all(f"{type(error).__name__}: " in x and f"traceback is in {tmp_path}/drawing.log" in x for x in said)
        assert "in draw_flight\n    plot_flight(" in (tmp_path / "drawing.log").read_text()


def test_a_run_that_is_stopped_while_it_draws_has_its_results(refused, monkeypatch, tmp_path):
    monkeypatch.setattr(drawing, "draw_flight", Mock(side_effect=KeyboardInterrupt))
    refused("bptt", *SMALL, "total_steps=48", f"hydra.run.dir={tmp_path}", status=130)
    assert {"summary.json", "metrics.csv", "checkpoint.pt"} <= {path.name for path in tmp_path.iterdir()}


def test_a_picture_takes_the_place_of_nothing_but_a_picture(capsys, tmp_path):
    env = HoveringEnv(num_envs=1)
    kept = tmp_path / "kept.html"
    kept.write_text("kept")
    (tmp_path / "flight.html").symlink_to(kept)
    (tmp_path / "episode.png").mkdir()
    drawing.publish_flight(env.rollout(3), tmp_path / "episode.png", tmp_path / "flight.html", env, "one")
    said = capsys.readouterr().err.splitlines()
    wanted = [f"Warning: {tmp_path}/{name}" for name in ("episode.png", "flight.html")]
    assert [line.split(" is missing. ")[0] for line in said] == wanted
    assert kept.read_text() == "kept" and (tmp_path / "flight.html").is_symlink()


def test_a_transfer_without_a_film_still_gets_its_page(broken_ffmpeg, monkeypatch, capsys, tmp_path):
    env = HoveringEnv(num_envs=1)
    monkeypatch.setattr(drawing, "fly", lambda bundle, name, how, episodes: {"simulator": name})
    monkeypatch.setattr(drawing, "as_rollout", lambda flight: env.rollout(3))
    broken_ffmpeg("killed later")
    (tmp_path / "transfer.mp4").touch()
    bundle = SimpleNamespace(contract={"control_dt": 0.02}, folder=tmp_path)
    drawing.draw_transfer(bundle, "mujoco", "contract", tmp_path / "transfer")
    assert {"transfer.gif", "transfer.html"} == {path.name for path in tmp_path.glob("transfer.*")}
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    drawing.draw_transfer(bundle, "mujoco", "contract", tmp_path / "transfer")
    assert [path.name for path in tmp_path.glob("transfer.*")] == ["transfer.html"]
    fallback, missing = capsys.readouterr().err.splitlines()
    assert "transfer.gif takes the place" in fallback
    assert "transfer.mp4 is missing. Pictures need matplotlib: pip install" in missing
