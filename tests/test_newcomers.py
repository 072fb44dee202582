"""Common mistakes: whoever makes one is told what to write instead."""

import pytest
import torch
from refusals import refuses
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import Compose, ExcludeTransform, MultiAction, ObservationNorm, SelectTransform, TransformedEnv

from torchrl_quad import HoveringEnv, HybridLoss, LandingEnv, SHACLoss
from torchrl_quad.data import differentiable_rollout, restart
from torchrl_quad.modules import make_actor, make_value


def test_what_newcomers_stumble_over_is_said_where_they_stumble():
    env = HoveringEnv(num_envs=3, seed=0, drone="small_racer", control_dt=0.04, wind={"gust": 0.5})
    line = repr(env)
    parts = "HoveringEnv(num_envs=3", "drone='small_racer'", "control_dt=0.04 s", "device=cpu", "compiled=False", "wind"
    assert all(part in line for part in parts) and "\n" not in line
    env.params = env.params.replace(mass=0.2)
    assert "drone='small_racer' with other parameters" in repr(env)

    actor = make_actor(env)
    flown, carry = differentiable_rollout(env, actor, None, 5)
    masked = flown[:, -1]["next"].detach().set("_reset", torch.tensor([[True], [False], [False]]))
    refuses(r"set_state=False\); to set them to this state, set_state=True", env.reset, masked.clone())
    assert env.reset(masked.clone(), set_state=False)["state", "step"].flatten().tolist() == [0, 5, 5]
    assert env.reset(masked.clone(), set_state=True)["state", "step"].flatten().tolist() == [5, 5, 5]

    with pytest.raises(ValueError, match=r"one action \(k\) .* MultiAction.* control_dt=0.04"):
        make_actor(TransformedEnv(HoveringEnv(num_envs=3), Compose(MultiAction())))
    velocity = ("state", "velocity")
    for transform, message in (
        (ExcludeTransform("reward_terms"), r"no groups: name each, such as \(\"reward_terms\", \"velocity\"\)"),
        (
            ExcludeTransform(velocity),
            r"leaves out \('state', 'velocity'\), .* No transform may drop a part of the state",
        ),
        (Compose(SelectTransform("observation")), "leaves out .* every step would start where the first one did"),
        (Compose(ObservationNorm(0.0, 1.0, in_keys=[velocity])), "ObservationNorm overwrites .* the flight"),
    ):
        refuses(message, differentiable_rollout, TransformedEnv(env, transform), actor, None, 2)
    with pytest.raises(TypeError, match=r"Write actor.compile\(\) instead"):
        differentiable_rollout(env, torch.compile(actor), None, 2)
    single = TransformedEnv(HoveringEnv(num_envs=3), ExcludeTransform(("reward_terms", "velocity")))
    assert ("next", "reward_terms", "velocity") not in differentiable_rollout(single, actor, None, 2)[0]
    with pytest.raises(ValueError, match=r"restart needs the whole state, .* lacks \('state', 'velocity'\)"):
        restart(env, carry.exclude(("state", "velocity")), 0.5)
    with pytest.raises(ValueError, match=r"episode_metrics reads .*'success'.* Judge a rollout before you leave out"):
        env.episode_metrics(flown.exclude(("next", "success")))


def test_a_policy_may_overwrite_what_the_environment_writes():
    env = HoveringEnv(num_envs=3, max_episode_steps=8)
    scale = TensorDictModule(lambda x: 0.5 * x, ["observation"], ["observation"])
    actor = TensorDictSequential(scale, make_actor(env))
    flights = []
    for horizon in (24, 8):  # at the end of the shorter ones the environments are reset
        env.set_seed(0)
        torch.manual_seed(0)
        parts, carry = [], None
        for _ in range(24 // horizon):
            rollout, carry = differentiable_rollout(env, actor, carry, horizon)
            parts.append(rollout["state", "position"])
        flights.append(torch.cat(parts, 1))
    torch.testing.assert_close(*flights, rtol=0, atol=0)


def test_losses_say_what_a_critic_must_write():
    env = HoveringEnv(num_envs=4)
    actor = make_actor(env)
    rollout, _ = differentiable_rollout(env, actor, None, 3)
    flat = TensorDictModule(lambda x: x.sum(-1), ["observation"], ["state_value"])
    refuses(r"value_network must write .* 'state_value' of shape \(4, 1\); got \(4,\)", SHACLoss(actor, flat), rollout)
    with pytest.raises(ValueError, match=r"SHACLoss needs a V\(s\), which reads no action"):
        SHACLoss(actor, TensorDictModule(torch.nn.Linear(4, 1), ["action"], ["state_value"]))
    loss = HybridLoss(actor, make_value(env))  # somebody else's advantage is not what its own targets are
    assert loss(rollout.copy().set("advantage", torch.zeros(4, 3, 1)))["loss_actor"].isfinite()
    assert loss.make_value_estimator("tdlambda").value_estimator.vectorized is False


def test_a_default_precision_of_float64_changes_no_environment():
    torch.set_default_dtype(torch.float64)
    try:
        for task in (HoveringEnv, LandingEnv):
            assert task(num_envs=2).rollout(2)["next", "reward"].dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)
