"""Observations normalised by running statistics, with gradients."""

import pytest
import torch
from helpers import refuses
from tensordict.nn import TensorDictModule
from test_transforms import check
from torchrl.envs import TransformedEnv, VecNormV2, check_env_specs

from torchrl_quad import HoveringEnv, ObservationNormalizer, differentiable_rollout, make_actor


def test_the_normalizer_s_statistics_are_those_of_all_observations_seen():
    base = HoveringEnv(num_envs=8, dtype=torch.float64)
    normalizer = ObservationNormalizer(base, min_scale=1e-4)
    env = TransformedEnv(base, normalizer)
    check_env_specs(env)
    actor, seen, carry = make_actor(env), [], None
    for _ in range(3):
        rollout, carry = differentiable_rollout(env, actor, carry, 7)
        seen.append(base.observe(rollout["next", "state"].reshape(-1)).detach())
        normalizer.update(rollout)
        carry = env.reset(carry.select("state"), set_state=True)
        expected = normalizer._apply_transform(base.observe(carry["state"]))
        torch.testing.assert_close(carry["observation"], expected)
    seen = torch.cat(seen)
    torch.testing.assert_close(normalizer.loc, seen.mean(0))
    torch.testing.assert_close(normalizer.scale, seen.std(0, correction=0).clamp_min(1e-4))
    assert normalizer.count == 8 * 7 * 3


def test_gradients_pass_the_normalizer_and_an_update_before_backward_changes_nothing():
    def gradient(update):
        torch.manual_seed(0)
        base = HoveringEnv(num_envs=4, seed=1)
        normalizer = ObservationNormalizer(base)
        env = TransformedEnv(base, normalizer)
        actor = make_actor(env)
        normalizer.update(differentiable_rollout(env, actor, None, 3)[0])
        rollout, _ = differentiable_rollout(env, actor, None, 5)
        if update:
            normalizer.update(rollout)
        rollout["next", "reward"].sum().backward()
        return torch.cat([p.grad.flatten() for p in actor.parameters()])

    before, after = gradient(update=False), gradient(update=True)
    assert torch.equal(before, after)
    assert before.abs().sum() > 0


@pytest.mark.parametrize("in_keys", [["observation"], [("state", "velocity"), "observation", ("state", "position")]])
def test_under_the_normalizer_the_environment_inside_flies_with_the_numbers_and_gradients_of_torchrl_s_loop(in_keys):
    env = HoveringEnv(num_envs=4, dtype=torch.float64)
    normalizer = ObservationNormalizer(env)
    normalizer.update(env.rollout(20, break_when_any_done=False))
    check(normalizer, in_keys)


def test_under_the_normalizer_errors_and_unwanted_outputs_stay_as_they_are():
    base = HoveringEnv(num_envs=4)
    env = TransformedEnv(base, ObservationNormalizer(base))
    with pytest.raises(ValueError, match="The actor reads 'observation', which is not in the tensordict"):
        differentiable_rollout(env, make_actor(env), env.reset().exclude("observation"), 2)
    policy = TensorDictModule(lambda x: (x, x[:, :4].tanh()), in_keys=["observation"], out_keys=["_", "action"])
    assert differentiable_rollout(env, policy, None, 3)[0].shape == (4, 3)


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size:UserWarning")
def test_a_live_vecnorm_is_refused_and_the_normalizer_named():
    env = TransformedEnv(HoveringEnv(num_envs=4), VecNormV2(in_keys=["observation"]))
    with pytest.raises(ValueError, match=r"VecNormV2 changes its statistics in place.*ObservationNormalizer\(env\)"):
        differentiable_rollout(env, make_actor(env), None, 5)
    env = TransformedEnv(env.base_env, ObservationNormalizer(env.base_env))
    differentiable_rollout(env, make_actor(env), None, 5)[0]["next", "reward"].sum().backward()


def test_the_normalizer_is_saved_and_leaves_out_what_is_not_finite():
    env = HoveringEnv(num_envs=4)
    one, other = ObservationNormalizer(env), ObservationNormalizer(env)
    rollout = env.rollout(5)
    one.update(rollout)
    broken = rollout.clone()
    broken["next", "observation"][0, 0, 0] = float("nan")
    one.update(broken)
    assert one.count == 39
    one.update(rollout[:0])
    assert all(buffer.isfinite().all() for buffer in one.state_dict().values())
    other.load_state_dict(one.state_dict())
    observation = rollout["observation"]
    assert torch.equal(one._apply_transform(observation), other._apply_transform(observation))


def test_the_normalizer_names_what_it_can_normalise(env):
    for options, message in (
        ({"key": "obs"}, "The environment does not observe 'obs'. Choose from: observation, "),
        ({"key": ("state", "position")}, 'is part of the state .* normalise "features"'),
        ({"min_scale": 0.0}, "min_scale must be greater than 0, got 0.0. The least standard deviation to divide by"),
    ):
        refuses(message, ObservationNormalizer, env, **options)
