"""Pictures."""

import numpy as np
import pytest
import torch

from torchrl_quad import HoveringEnv, make_env
from torchrl_quad.render import animate_flight, plot_flight, plot_learning_curve


def test_a_flight_with_crashes_and_fewer_environments_than_asked_for_is_drawn(tmp_path):
    env = HoveringEnv(num_envs=3, max_episode_steps=40)
    td = env.reset()
    td["state", "position"][1] = torch.tensor([1.0, 0.0, 5.99])
    td["state", "velocity"][1, 2] = 5.0
    flight = env.rollout(60, tensordict=env.reset(td, set_state=True), auto_reset=False, break_when_any_done=False)
    assert flight["next", "terminated"][1].any()
    plot_flight(flight, tmp_path / "flight.png")
    assert (tmp_path / "flight.png").stat().st_size > 10_000


@pytest.mark.parametrize("task", ["landing", "racing", "tracking"])
def test_a_flight_of_every_task_is_drawn(task, tmp_path):
    env = make_env(task, num_envs=2, max_episode_steps=30)
    plot_flight(env.rollout(70, break_when_any_done=False), tmp_path / "flight.png")
    assert (tmp_path / "flight.png").stat().st_size > 10_000


def test_a_flight_is_filmed_in_real_time_until_its_episodes_end(tmp_path):
    from PIL import Image

    env = make_env("racing", num_envs=3, max_episode_steps=60)
    animate_flight(env.rollout(100, break_when_any_done=False), tmp_path / "flight.gif", fps=10)
    with Image.open(tmp_path / "flight.gif") as film:
        assert film.n_frames == 20
        assert film.info["duration"] == 100  # [ms], five control steps
        first, last = (np.asarray(film.convert("RGB")) for _ in map(film.seek, (0, 19)))
    assert (first != last).any()


def test_a_learning_curve_is_drawn_from_its_csv(tmp_path):
    (tmp_path / "metrics.csv").write_text(
        "steps,time/seconds,eval/return,eval/success,eval/position_error\n100,1.0,5.0,0.0,1.0\n200,2.0,20.0,1.0,0.02\n"
    )
    plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 10_000


def test_without_matplotlib_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl_quad\[render\]'"):
        plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
