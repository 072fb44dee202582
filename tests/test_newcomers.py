"""What newcomers stumble over: each gets told what to write instead."""

import pytest
import torch
from torchrl.envs import Compose, ExcludeTransform, MultiAction, TransformedEnv

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor, restart


def test_what_newcomers_stumble_over_is_said_where_they_stumble():
    env = HoveringEnv(num_envs=3, seed=0, drone="small_racer", control_dt=0.04, wind={"gust": 0.5})
    line = repr(env)
    for part in ("HoveringEnv(num_envs=3", "drone='small_racer'", "control_dt=0.04 s", "device=cpu", "compiled=False"):
        assert part in line
    assert "wind" in line and "\n" not in line
    env.params = env.params.replace(mass=0.2)
    assert "drone='small_racer' with other parameters" in repr(env)

    actor = make_actor(env)
    flown, carry = differentiable_rollout(env, actor, None, 5)
    masked = flown[:, -1]["next"].detach().set("_reset", torch.tensor([[True], [False], [False]]))
    with pytest.raises(ValueError, match=r"set_state=False\); to set them to this state, set_state=True"):
        env.reset(masked.clone())
    assert env.reset(masked.clone(), set_state=False)["state", "step"].flatten().tolist() == [0, 5, 5]
    assert env.reset(masked.clone(), set_state=True)["state", "step"].flatten().tolist() == [5, 5, 5]

    with pytest.raises(ValueError, match=r"one action \(k\) .* MultiAction .* control_dt=0.04"):
        make_actor(TransformedEnv(HoveringEnv(num_envs=3), Compose(MultiAction())))
    for dropped, message in (
        ("reward_terms", r"no groups: name each, such as \(\"reward_terms\", \"velocity\"\)"),
        (("state", "velocity"), "lacks velocity. .* No transform may drop a part of it, as ExcludeTransform would"),
    ):
        with pytest.raises(ValueError, match=message):
            differentiable_rollout(TransformedEnv(env, ExcludeTransform(dropped)), actor, None, 2)
    single = TransformedEnv(HoveringEnv(num_envs=3), ExcludeTransform(("reward_terms", "velocity")))
    assert ("next", "reward_terms", "velocity") not in differentiable_rollout(single, actor, None, 2)[0]
    with pytest.raises(ValueError, match=r"restart needs the whole state, .* lacks \('state', 'velocity'\)"):
        restart(env, carry.exclude(("state", "velocity")), 0.5)
    with pytest.raises(ValueError, match=r"episode_metrics reads .*'success'.* Judge a rollout before you leave out"):
        env.episode_metrics(flown.exclude(("next", "success")))
