"""Networks that read their sizes from the environment."""

import pytest
import torch
from torchrl.envs import CatTensors, PendulumEnv, StepCounter, TransformedEnv, UnsqueezeTransform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad import HoveringEnv, make_actor, make_qvalue, make_value


@pytest.mark.parametrize("wrap", [False, True])
def test_a_policy_starts_close_to_hovering_with_a_little_noise(wrap):
    env = HoveringEnv(num_envs=500)
    actor = make_actor(TransformedEnv(env, StepCounter()) if wrap else env, scale_init=0.1)
    td = env.reset()
    torch.testing.assert_close(actor(td.copy())["action"], env.hover_action.expand(500, 4), atol=0.02, rtol=0)
    with set_exploration_type(ExplorationType.RANDOM):
        noise = actor(td)["action"] - env.hover_action
    assert noise.std(0).tolist() == pytest.approx([0.09, 0.1, 0.1, 0.1], abs=0.02)


def test_the_first_action_can_be_chosen_and_is_the_middle_of_the_range_elsewhere():
    env = HoveringEnv(num_envs=2, dtype=torch.float64)
    wanted = torch.tensor([0.5, -0.5, 0.0, 0.9], dtype=torch.float64)
    actor = make_actor(env, action_init=wanted)
    torch.testing.assert_close(actor(env.reset())["action"], wanted.expand(2, 4), atol=0.02, rtol=0)
    pendulum = TransformedEnv(
        PendulumEnv(), UnsqueezeTransform(dim=-1, in_keys=["th", "thdot"], in_keys_inv=["th", "thdot"])
    )
    pendulum = pendulum.append_transform(CatTensors(["th", "thdot"], "observation", del_keys=False))
    action = make_actor(pendulum)(pendulum.reset())["action"]
    assert action.shape == (1,)
    assert action.abs() < 0.1


def test_every_network_has_the_precision_of_the_environment():
    env = HoveringEnv(num_envs=2, dtype=torch.float64)
    td = make_actor(env)(env.reset())
    for network, key in ((make_value(env), "state_value"), (make_qvalue(env), "state_action_value")):
        assert network(td)[key].dtype is torch.float64
        assert network(td)[key].shape == (2, 1)
