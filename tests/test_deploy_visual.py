"""Visual policies that remember, exported: the memory in C, and what is refused."""

import ctypes

import numpy as np
import pytest
from deploying import build, compiled
from torch import nn

from torchrl_quad import ForestEnv, HoveringEnv, make_visual_actor
from torchrl_quad.deploy import WrongActions, export, export_policy, load_bundle, transfer
from torchrl_quad.deploy.bundle import Bundle
from torchrl_quad.deploy.judging import Judge


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
    trace_once("forest")
    env, actor = build("forest")

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


def test_a_blind_policy_with_memory_is_exported_and_flies_as_it_flew(export_once):
    folder = export_once("hovering, with memory")[2]
    assert load_bundle(folder).memory.shape == (4,)
    assert len(transfer.fly(folder, "torchrl_quad", episodes=4)["action"]) == 4


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
        refuses("exports what make_actor and make_visual_actor build, .* This ComposedActor is something", changed)
    velocity = make_visual_actor(forest, in_keys=[("state", "velocity")])
    refuses(r"reads \['depth', \('state', 'velocity'\)\]. A drone only has", velocity)
    flatter = make_visual_actor(forest)
    flatter[0][0].module.convolutions[1] = nn.ELU(0.5)
    refuses("cannot write ELU.alpha=0.5", flatter)
