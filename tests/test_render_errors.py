"""What pictures refuse, need, and leave alone."""

import sys

import pytest

from torchrl_quad import HoveringEnv
from torchrl_quad.render import animate_flight, plot_episode, plot_flight, write_replay

FILES = {animate_flight: "flight.gif"}


def test_what_cannot_be_drawn_is_named(tmp_path):
    flight = HoveringEnv(num_envs=2).rollout(5)
    for draw in (plot_flight, plot_episode, animate_flight, write_replay):
        path = tmp_path / FILES.get(draw, "flight.png")
        with pytest.raises(ValueError, match=rf"{draw.__name__} .*\(num_envs, time\).* got \(5,\).*unsqueeze\(0\)"):
            draw(flight[0], path)
        with pytest.raises(ValueError, match=rf"{draw.__name__} .* got \(2, 0\)"):
            draw(flight[:, :0], path)
        with pytest.raises(ValueError, match=rf"{draw.__name__}: the rollout lacks .*'position'.*Pass it whole"):
            draw(flight.exclude(("next", "state", "position")), path)
        with pytest.raises(TypeError, match=f"{draw.__name__}: env must be the quadrotor environment .* got str"):
            draw(flight, path, env="hovering")
    for draw in (plot_flight, animate_flight, write_replay):
        path = tmp_path / FILES.get(draw, "flight.png")
        with pytest.raises(ValueError, match=f"{draw.__name__}: num_envs must be at least 1, got 0"):
            draw(flight, path, num_envs=0)
    with pytest.raises(IndexError, match="env_index=2, and the rollout has 2 environments"):
        plot_episode(flight, path, env_index=2)
    with pytest.raises(ValueError, match=r"animate_flight writes \.gif and \.mp4, got flight\.avi"):
        animate_flight(flight, tmp_path / "flight.avi")
    with pytest.raises(ValueError, match=r"Format 'docx' is not supported \(supported formats: .*pdf, .*png"):
        plot_episode(flight, tmp_path / "flight.docx")
    assert not list(tmp_path.iterdir())


def test_drawing_leaves_the_user_s_matplotlib_alone(tmp_path):
    import matplotlib
    from matplotlib import pyplot

    matplotlib.use("svg")
    settings = dict(matplotlib.rcParams)
    env = HoveringEnv(num_envs=1)
    flight = env.rollout(5)
    for draw in (plot_flight, plot_episode, animate_flight):
        draw(flight, tmp_path / FILES.get(draw, "flight.png"))
    env.render()
    assert not pyplot.get_fignums()
    assert matplotlib.get_backend() == "svg"
    assert dict(matplotlib.rcParams) == settings


@pytest.mark.parametrize("draw", [plot_flight, plot_episode, animate_flight, "render"])
def test_without_matplotlib_it_says_what_to_install(draw, monkeypatch, tmp_path):
    env = HoveringEnv(num_envs=2)
    flight = env.rollout(5)
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"pip install '.\[render\]'"):
        env.render() if draw == "render" else draw(flight, tmp_path / FILES.get(draw, "flight.png"))


def test_a_film_in_mp4_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"MP4 need imageio-ffmpeg: pip install '.\[render\]'"):
        animate_flight(HoveringEnv(num_envs=1).rollout(3), tmp_path / "flight.mp4")
