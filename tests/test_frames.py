"""``env.render()``: frames for TorchRL, wandb and people."""

import copy
import gc
import weakref

import numpy as np
import pytest
import torch
from refusals import refuses
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv, check_env_specs
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor, make_env
from torchrl_quad.envs import TASKS


def recorded(env, **options):
    """The environment under a recorder that keeps its film in memory."""
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


def falls_first(env):
    """The tensordict after a reset in which drone 0 is about to hit the ground."""
    td = env.reset()
    td["state", "position"][0, 2] = 0.05
    td["state", "velocity"][0, 2] = -2.0
    return env.reset(td, set_state=True)


def test_after_a_partial_reset_one_drone_starts_again_and_the_others_fly_on():
    env = HoveringEnv(num_envs=2)
    filmed = recorded(env)
    rollout = filmed.rollout(3, tensordict=falls_first(filmed), auto_reset=False, break_when_any_done=False)
    (step,) = rollout["next", "terminated"][0, :, 0].nonzero().flatten().tolist()
    assert len(filmed.transform[1].obs) >= 5  # a start more
    frame = 3 + step  # two resets and the start come before the first step; this frame follows the crash
    begun = rollout[:, step + 1]
    assert begun["state", "step"].flatten().tolist() == [0, step + 1]
    env.reset(begun.clone(), set_state=True)
    shown = filmed.transform[1].obs[frame].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(shown, env.render())


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


class Witness(torch.autograd.Function):
    """Does nothing, and lives as long as the graph that holds it."""

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


def test_drones_that_are_nowhere_are_left_out_and_the_view_follows_the_others():
    env = HoveringEnv(num_envs=2)
    env.reset()
    env.render_state["position"][:] = torch.nan
    assert (env.render() != 255).any(-1).sum() > 1000
    env.render_state["position"][1] = torch.tensor([30.0, 0.0, 5.0])
    assert (np.abs(env.render().astype(int) - [140, 212, 70]).sum(-1) < 90).any()  # the colour of the second drone


@pytest.mark.parametrize("task", ["racing", "tracking"])
def test_the_view_holds_the_markers_whatever_the_drones_do(task, monkeypatch):
    from torchrl_quad.render import video

    scenes = []
    monkeypatch.setattr(video, "View", lambda *a, scene=video.View, **k: scenes.append(scene(*a, **k)) or scenes[-1])
    env = make_env(task, num_envs=1)
    env.reset()
    env.render()
    points = torch.cat([x for x in (env.markers().gates, env.markers().curve) if x is not None])
    assert ((scenes[0].low <= points) & (points <= scenes[0].high)).all()
