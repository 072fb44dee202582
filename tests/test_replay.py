"""What replays hold, and how they are written."""

import base64
import json
import re
import sys

import numpy as np
import pytest
import torch
from torchrl.envs import RewardSum, TransformedEnv

from torchrl_quad import HoveringEnv, RacingEnv, differentiable_rollout, make_actor, make_env
from torchrl_quad.render import write_replay


def written(rollout, **options):
    """What the page of a flight shows, as it is stored."""
    text = write_replay(rollout, **options).html
    content = json.loads(re.search(r'<script type="application/json" id="flight">(.*?)</script>', text, re.DOTALL)[1])

    def numbers(name, *shape):
        return torch.from_numpy(np.frombuffer(base64.b64decode(content[name]), "<f4").copy()).reshape(shape)

    return content, numbers


def test_what_is_not_known_of_the_start_is_left_out_there():
    rollout = HoveringEnv(num_envs=2).rollout(3)
    _, numbers = written(rollout.exclude(("state", "target"), ("state", "velocity")))
    target = numbers("target", 2, 4, 3)
    assert target[:, 0].isnan().all() and torch.equal(target[:, 1:], rollout["next", "state", "target"])
    torch.testing.assert_close(numbers("position", 2, 4, 3)[:, 0], rollout["state", "position"][:, 0])


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
    randomize = {"rotor_positions": {"scale": [0.5, 2.0]}, "mass": {"scale": [0.5, 2.0]}}
    env = HoveringEnv(num_envs=3, randomize=randomize)
    rollout = env.rollout(5, break_when_any_done=False)
    _, numbers = written(rollout, env=env)
    drone = rollout["state", "drone"][:, 0]
    torch.testing.assert_close(numbers("rotors", 3, 4, 2), drone["rotor_positions"])
    thrust = env.dynamics.controller.rotors.thrust(rollout["state", "rotor_speed"][:, 0])
    torch.testing.assert_close(numbers("lift", 3, 6, 4)[:, 0], 4 * thrust / (drone["mass"] * 9.81), rtol=1e-4, atol=0)


def test_the_gate_of_a_frame_is_the_one_that_the_drone_flies_to():
    env = RacingEnv(num_envs=3)
    rollout = env.rollout(4, break_when_any_done=False)
    gates = written(rollout, env=env)[1]("gate", 3, 5)
    assert torch.equal(gates[:, 1:], rollout["next", "state", "gate"][..., 0].float())
    assert torch.equal(gates[:, 0], rollout["state", "gate"][:, 0, 0].float())
    content, _ = written(rollout)
    assert content["gates"] is content["gate"] is None


def test_rings_face_along_the_course():
    env = RacingEnv(num_envs=1, track={"gates": [[0, 0, 2], [4, 0, 2], [4, 0, 6], [0, 0, 6]], "gate_radius": 0.5})
    rings = written(env.rollout(2), env=env)[1]("gates", 4, 33, 3) - env.gates[:, None]
    torch.testing.assert_close(rings.norm(dim=-1), torch.full((4, 33), 0.5))
    along = env.gates.roll(-1, 0) - env.gates.roll(1, 0)  # of a square, between the edges before and after
    torch.testing.assert_close((rings * along[:, None]).sum(-1), torch.zeros(4, 33), atol=1e-5, rtol=0)


def test_a_page_of_twelve_long_flights_is_small():
    env = make_env("tracking", num_envs=14)
    content, _ = written(env.rollout(512, break_when_any_done=False), env=env)
    assert content["environments"] == 12 and len(json.dumps(content)) < 1_500_000


def test_a_page_that_cannot_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    rollout = HoveringEnv(num_envs=1).rollout(2)
    path = tmp_path / "replay.html"
    path.write_text("old")

    def full(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr("torchrl_quad.files.os.replace", full)
    with pytest.raises(OSError, match="No space"):
        write_replay(rollout, path)
    assert [file.name for file in tmp_path.iterdir()] == ["replay.html"] and path.read_text() == "old"


def test_a_rollout_without_attitudes_and_a_machine_without_plotly_are_refused(monkeypatch):
    rollout = HoveringEnv(num_envs=2).rollout(3)
    with pytest.raises(ValueError, match=r"write_replay: the rollout lacks .*'quaternion'"):
        write_replay(rollout.exclude(("next", "state", "quaternion")))
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(ImportError, match=r"pip install '.\[render\]'"):
        write_replay(rollout)
