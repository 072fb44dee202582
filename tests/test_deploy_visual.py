"""Visual policies that remember, exported: images and their faults, the memory, and what is refused."""

import ctypes
import math
import re

import numpy as np
import pytest
import torch
from deploying import compiled, resting
from torch import nn

from torchrl_quad import ForestEnv, HoveringEnv, make_visual_actor
from torchrl_quad.deploy import (
    MissingQuantity,
    NegativeDepth,
    NotFinite,
    StaleState,
    WrongActions,
    export,
    export_policy,
    load_bundle,
    transfer,
)
from torchrl_quad.deploy.bundle import Bundle
from torchrl_quad.deploy.judging import Judge


def a_visual_policy():
    """A small one that remembers, with its environment."""
    env = HoveringEnv(num_envs=64, max_episode_steps=16, camera={"width": 3, "height": 2, "rate": 3, "delay": 2})
    actor = make_visual_actor(env, num_cells=(4,), channels=(2,), hidden_size=2)
    with torch.no_grad():
        actor[0][-1].module.mlp[-1].weight.mul_(30.0)
    return env, actor


@pytest.fixture(scope="module")
def visual(tmp_path_factory):
    torch.manual_seed(0)
    env, actor = a_visual_policy()
    return export_policy(actor, env, tmp_path_factory.mktemp("visual") / "policy")


IMAGE = [[0.0, 2.0, 12.0], [1.0, 3.0, 10.0]]


def pixel(value):
    return [[0.0, value, 12.0], [1.0, 3.0, 10.0]]


@pytest.mark.parametrize(
    ("kind", "message", "changes"),
    [
        (MissingQuantity, "lacks 'depth': give position, .*, depth, depth_age and age", {"depth": None}),
        (MissingQuantity, "lacks 'depth_age', the time since the image was taken", {"depth_age": None}),
        (MissingQuantity, r"depth must have shape \(2, 3\) or \(1, 2, 3\), got \(3, 2\)", {"depth": [[1, 1]] * 3}),
        (MissingQuantity, "depth must be 6 numbers, got 'far'", {"depth": "far"}),
        (MissingQuantity, "whole numbers, uint16: give metres. Are they milli", {"depth": np.ones((2, 3), np.uint16)}),
        (NotFinite, "Not finite: depth. Give 0 for a pixel that measures nothing", {"depth": pixel(math.nan)}),
        (NotFinite, "Not finite: depth. .* and the range for far", {"depth": pixel(math.inf)}),
        (NotFinite, "Not finite: depth_age", {"depth_age": math.nan}),
        (NegativeDepth, "depth must not be negative, got -0.1 m", {"depth": pixel(-0.1)}),
        (StaleState, "The image is 0.11 s old; the contract allows 0 to 0.1 s", {"depth_age": 0.11}),
        (StaleState, "The image is -1 s old", {"depth_age": -1}),
        (StaleState, "The state is 1 s old", {"age": 1}),
    ],
)
def test_each_fault_of_an_image_has_a_name_and_leaves_the_memory_as_it_was(visual, kind, message, changes):
    bundle, untouched = load_bundle(visual, on_fault="hover"), load_bundle(visual)
    state = resting(depth=IMAGE, depth_age=0.1)
    first = bundle(state)
    assert not np.array_equal(bundle.memory, [0, 0]) and bundle.memory.dtype == np.float32
    memory = bundle.memory.copy()
    bundle({key: x for key, x in (state | changes).items() if x is not None})
    assert bundle.faults == {kind.__name__: 1} and re.search(message, str(bundle.last_fault))
    np.testing.assert_array_equal(bundle.memory, memory)
    np.testing.assert_allclose(bundle.action, bundle.contract["output"]["hover_action"])
    assert untouched(state)[0] == first[0] != bundle(state)[0] == untouched(state)[0]
    bundle.reset()
    np.testing.assert_array_equal(bundle.memory, [0, 0])
    clipped = np.minimum(IMAGE, 10.0)[None]  # what is beyond the range counts as the range
    assert bundle(state | {"depth": clipped})[0] == first[0]


def test_c_leaves_the_memory_as_it_was_where_it_reads_what_is_not_finite(export_once, tmp_path):
    library = compiled(export_once("forest")[2], tmp_path / "policy.so")
    floats, inf = (lambda *x: (ctypes.c_float * len(x))(*x)), float("inf")
    for observation, depth, kept in ((inf, 1.0, 0.5), (0.0, inf, 0.5), (0.0, float("nan"), 0.5), (0.0, 1.0, inf)):
        memory, action = floats(0.1, 0.2, 0.3, kept), floats(0, 0, 0, 0)
        images = floats(*29 * [1.0], depth)
        assert library.policy_action(floats(*8 * [0.0], observation), images, memory, action) == 1
        assert list(memory) == pytest.approx([0.1, 0.2, 0.3, kept]) and action[0] == pytest.approx(-1 / 3)
    memory = floats(0.1, 0.2, 0.3, 0.5)
    assert library.policy_action(floats(*9 * [0.0]), floats(*30 * [1.0]), memory, action) == 0
    assert memory[3] != 0.5


def test_a_bundle_that_acts_or_remembers_differently_from_its_policy_is_not_written(tmp_path, monkeypatch, trace_once):
    env, actor = a_visual_policy()

    def forgets(self, *given, read=Bundle._read):
        return read(self, *given) | {"memory": np.zeros_like(self.memory)}

    def off(*arguments, fold=export.fold):
        network = fold(*arguments)
        *layers, last = network.layers
        return network._replace(layers=[*layers, last._replace(bias=last.bias + np.float32(1e-3))])

    wrongs = (
        (Bundle, "_read", forgets, ValueError, "acts differently"),
        (export, "fold", off, WrongActions, "by 0.001"),
    )
    for owner, name, wrong, error, said in wrongs:
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, wrong)
            with pytest.raises(error, match=said):
                export_policy(actor, env, tmp_path / "policy")
        assert not list(tmp_path.iterdir())
    assert export_policy(actor, env, tmp_path / "policy").is_dir()


def test_no_simulator_flies_a_visual_policy_or_a_task_with_obstacles(export_once):
    ways = (("forest", "images"), ("forest, blind", "obstacles"), ("hovering, without memory", "no camera"))
    for task, why in ways:
        with pytest.raises(ValueError, match=f"cannot fly this bundle of the task .*: .*{why}"):
            transfer.fly(export_once(task)[2], "torchrl_quad")
    bundle = load_bundle(export_once("forest, blind")[2])
    with pytest.raises(ValueError, match="'forest' cannot be judged here: its drones crash into obstacles"):
        Judge(bundle, bundle.starts())


def test_a_visual_policy_that_was_built_for_another_camera_or_changed_is_refused(tmp_path):
    forest = ForestEnv(num_envs=2, camera={"width": 6, "height": 5})
    seen, hooked, deeper = (make_visual_actor(forest) for _ in range(3))

    def refuses(match, policy=seen, env=forest):
        with pytest.raises(ValueError, match=match):
            export_policy(policy, env, tmp_path / "policy")

    refuses("for images of another size; the environment has no camera", env=HoveringEnv(num_envs=2))
    narrow = HoveringEnv(num_envs=2, camera={"width": 9, "height": 5})
    refuses("for images of another size; the environment shows it 9 x 5 pixels", env=narrow)
    hooked[0][1].gru.register_forward_hook(lambda *_: None)
    deeper[0][1].gru = nn.GRU(64, 64, 2, batch_first=True)
    for changed in (hooked, deeper):
        refuses("exports what make_actor and make_visual_actor build, .* This VisualActor is something", changed)
    velocity = make_visual_actor(forest, in_keys=[("state", "velocity")])
    refuses(r"reads \['depth', \('state', 'velocity'\)\]. A drone only has", velocity)
    flatter = make_visual_actor(forest)
    flatter[0][0].module.convolutions[1] = nn.ELU(0.5)
    refuses("cannot write ELU.alpha=0.5", flatter)
