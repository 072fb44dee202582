"""Transforms that fly inside, against TorchRL's own loop."""

import pytest
import torch
from torchrl.envs import (
    ActionScaling,
    CatTensors,
    ClipTransform,
    Compose,
    DoubleToFloat,
    DTypeCastTransform,
    EnvBase,
    ExcludeTransform,
    InitTracker,
    ObservationNorm,
    RenameTransform,
    RewardClipping,
    RewardScaling,
    RewardSum,
    SelectTransform,
    StepCounter,
    TargetReturn,
    TrajCounter,
    TransformedEnv,
)

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor
from torchrl_quad.data.transforms import under_transforms

OBSERVATION = ["observation"]


def normalizer(key="observation", size=13, **keys):
    loc, scale = torch.linspace(-1, 1, size).double(), torch.linspace(0.5, 2, size).double()
    return ObservationNorm(loc, scale, in_keys=[key], standard_normal=True, **keys)


TRANSFORMS = {
    "scaled reward": lambda: RewardScaling(0.3, 2.0),
    "clipped reward": lambda: RewardClipping(-0.2, 0.1),
    "sum": RewardSum,
    "sum of clipped": lambda: Compose(RewardScaling(0.1, 3.0), RewardSum(), RewardClipping(-0.2, 0.1)),
    "target": lambda: TargetReturn(7.0),
    "constant target": lambda: TargetReturn(7.0, mode="constant"),
    "steps": StepCounter,
    "starts": InitTracker,
    "trajectories": TrajCounter,
    "normalised": normalizer,
    "copied": lambda: normalizer(out_keys=["seen"]),
    "concatenated": lambda: CatTensors(["observation", ("state", "velocity")], "features", del_keys=False),
    "concatenated alone": lambda: CatTensors(["observation"], "features"),
    "clipped": lambda: ClipTransform(in_keys=OBSERVATION, low=-0.5, high=1.0),
    "cast": lambda: DTypeCastTransform(torch.float64, torch.float32, in_keys=OBSERVATION, in_keys_inv=["action"]),
    "all of float": DoubleToFloat,
    "scaled action": lambda: ActionScaling(loc=torch.tensor(0.1).double(), scale=torch.tensor(0.7).double()),
    "clipped action": lambda: ClipTransform(in_keys_inv=["action"], in_keys=[], low=-0.1, high=0.3),
    "renamed": lambda: RenameTransform(["observation"], ["seen"]),
    "left out": lambda: ExcludeTransform(("metrics", "position_error"), "success"),
    "selected": lambda: SelectTransform("observation", *HoveringEnv().state_keys, ("reward_terms", "velocity")),
}


def fly(env, actor, steps, *, inside, monkeypatch):
    with monkeypatch.context() as patch:
        if not inside:
            patch.setattr("torchrl_quad.data.rollout.under_transforms", lambda env, actor: "not wanted")
            patch.setattr(HoveringEnv, "rollout", EnvBase.rollout)
        else:
            patch.setattr(TransformedEnv, "rollout", None)
        env.set_seed(1)
        for transform in env.transform if isinstance(env.transform, Compose) else [env.transform]:
            if isinstance(transform, TrajCounter):
                transform._traj_count.value = 0
        torch.manual_seed(1)
        first, carry = differentiable_rollout(env, actor, env.reset(), 7)
        rollout, carry = differentiable_rollout(env, actor, carry, steps)
    loss = 0.0
    for flight in (first, rollout):
        for x in (x for _, x in sorted(flight.items(True, True), key=str)):
            if x.requires_grad and x.is_floating_point():
                loss = loss + (x.double() * torch.linspace(0.5, 1.5, x.numel()).double().view_as(x)).sum()
    flown = {i: dict(x.items(True, True)) for i, x in enumerate((first, rollout, carry))}
    return flown, torch.autograd.grad(loss, list(actor.parameters()))


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize("compile", [False, True])
def test_each_transform_flies_inside_with_torchrl_s_numbers_and_gradients(name, compile, monkeypatch):
    base = HoveringEnv(num_envs=3, max_episode_steps=9, dtype=torch.float64, compile=compile)
    env = TransformedEnv(base, TRANSFORMS[name]())
    keys = {"copied": ["seen"], "renamed": ["seen"], "concatenated": ["features"], "concatenated alone": ["features"]}
    actor = make_actor(env, (8,), in_keys=keys.get(name, OBSERVATION), return_log_prob=True)
    assert not isinstance(under_transforms(env, actor), str)
    expected = fly(env, actor, 20, inside=False, monkeypatch=monkeypatch)
    found = fly(env, actor, 20, inside=True, monkeypatch=monkeypatch)
    precision = {"rtol": 2e-4, "atol": 2e-5} if "float" in name or name == "cast" else {"rtol": 1e-7, "atol": 1e-9}
    torch.testing.assert_close(found, expected, **precision)
    assert found[0][1]["next", "done"].any()
