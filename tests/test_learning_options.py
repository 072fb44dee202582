"""Options of losses, networks, buffers and diagnostics: each works, or is refused in one line, whatever it is given."""

import copy
import inspect
import pickle

import numpy as np
import pytest
import torch
from helpers import refuses
from tensordict import TensorDict
from torch import nn

from torchrl_quad import DifferentiableCollector, HoveringEnv, ObservationNormalizer, TrustRegion, VisitedStateBuffer
from torchrl_quad.data import differentiable_rollout, restart
from torchrl_quad.diagnostics import audit_reward, compare_gradients, gradient_by_horizon, gradient_statistics
from torchrl_quad.engine import ActionSequence
from torchrl_quad.envs import ForestEnv
from torchrl_quad.errors import UserError, UserTypeError, UserValueError
from torchrl_quad.modules import make_actor, make_qvalue, make_value, make_visual_actor
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, PODSLoss, SAPOLoss, SHACLoss
from torchrl_quad.options import declared

HOSTILE = [
    *(None, True, "a", "", float("nan"), float("inf"), -1, 0, 1, 0.5, 1e30, -1e30, 1e300, 10**9, 10**400, 10**5000),
    *([], {}, (), object(), b"", 1j, [None], ["a"], [1.5], [float("nan")], [10**6] * 3, [10**400], ("a",), {1}),
    *(np.float32(1), np.float64(np.nan), np.int64(3), np.bool_(True), np.array(3.0), np.array([1, 2]), np.array("a")),
    *(torch.tensor(1.0), torch.tensor(float("nan")), torch.ones(3), torch.ones(3, device="meta"), torch.tensor(1j)),
    *(TensorDict({}, []), TensorDict({}, [4]), TensorDict({}, [4, 3]), nn.ELU, nn.ELU(), nn.Linear, nn.Linear(3, 4)),
    *(nn.GLU, int, "auto", "cuda", torch.float64, slice(None), ...),
]
LOSS = [*declared(BPTTLoss), "unknown"]
CRITIC = [*declared(SHACLoss), "unknown"]


@pytest.fixture(scope="module")
def calls():
    """What is called, with arguments that work, and the names of further ones."""
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=4, seed=1)
    seen = ForestEnv(num_envs=2, density=0.02, camera={"width": 6, "height": 4})
    actor = make_actor(env, return_log_prob=True)
    rollout, carry = differentiable_rollout(env, actor, None, 3)
    buffer = VisitedStateBuffer(env=env)
    buffer.extend(rollout)
    bptt, with_value = BPTTLoss(actor), {"actor_network": actor, "value_network": make_value(env)}
    shac = SHACLoss(**with_value)
    return {
        "bptt": (BPTTLoss, {"actor_network": actor}, LOSS),
        "shac": (SHACLoss, with_value, CRITIC),
        "sapo": (SAPOLoss, with_value, CRITIC),
        "ahac": (AHACLoss, with_value, CRITIC),
        "hybrid": (HybridLoss, with_value, CRITIC),
        "pods": (PODSLoss, {"actor_network": actor}, LOSS),
        "abpt": (ABPTLoss, {"actor_network": actor, "qvalue_network": make_qvalue(env)}, LOSS),
        "estimator": (shac.make_value_estimator, {}, []),
        "returns": (bptt.make_value_estimator, {}, []),
        "keys": (SHACLoss(**with_value).set_keys, {}, ["action", "reward", "value_target", "value", "unknown"]),
        "loss": (bptt.loss_actor, {"tensordict": rollout}, []),
        "critic's loss": (shac.loss_value, {"tensordict": rollout}, []),
        "targets": (HybridLoss(**with_value).write_targets, {"tensordict": rollout}, []),
        "trust region": (TrustRegion, {"actor": actor, "max_kl": 0.1}, []),
        "actor": (make_actor, {"env": env}, []),
        "value": (make_value, {"env": env}, []),
        "qvalue": (make_qvalue, {"env": env}, []),
        "visual actor": (make_visual_actor, {"env": seen}, []),
        "buffer": (VisitedStateBuffer, {}, []),
        "start": (buffer.initial_state, {"env": env}, []),
        "source": (buffer.source, {"env": env}, []),
        "extend": (VisitedStateBuffer(env=env).extend, {"tensordicts": rollout}, []),
        "load": (VisitedStateBuffer().load_state_dict, {"state_dict": buffer.state_dict()}, []),
        "rollout": (differentiable_rollout, {"env": env, "actor": actor, "carry": None, "horizon": 1}, []),
        "restart": (restart, {"env": env, "carry": carry, "fraction": 0.5}, []),
        "normalizer": (ObservationNormalizer, {"env": env}, []),
        "statistics": (ObservationNormalizer(env).update, {"rollout": rollout}, []),
        "collector": (DifferentiableCollector, {"env": env, "policy": actor, "frames_per_batch": 8}, []),
        "audit": (audit_reward, {"rollout": rollout, "inputs": actor}, []),
        "comparison": (compare_gradients, {"loss": shac, "rollout": rollout}, []),
        "variance": (gradient_statistics, {"loss": bptt, "rollout": rollout}, []),
        "by horizon": (gradient_by_horizon, {"env": env, "actor": actor, "loss": bptt, "horizons": [2]}, []),
        "actions": (ActionSequence, {"actions": torch.zeros(3, 4, 4)}, []),
    }


@pytest.mark.filterwarnings("ignore")
def test_every_argument_is_taken_or_refused_in_one_line(calls):
    for name, (function, given, more) in calls.items():
        signature = inspect.signature(function.__init__ if isinstance(function, type) else function)
        own = [x for x, p in signature.parameters.items() if x != "self" and p.kind is not p.VAR_KEYWORD]
        accepted, refused = 0, []
        for argument in dict.fromkeys([*own, *more]):
            for value in HOSTILE:
                try:
                    function(**{**given, argument: value})
                    accepted += 1
                except UserError as error:
                    refused.append(str(error))
        assert len(refused) > accepted and "\n" not in "".join(refused), name


def test_what_is_taken_has_finite_losses(calls):
    env, actor = calls["actor"][1]["env"], calls["bptt"][1]["actor_network"]
    rollout, _ = differentiable_rollout(env, actor, None, 3)
    for name in ("bptt", "shac", "sapo", "ahac", "abpt"):
        cls, given, _ = calls[name]
        for option in declared(cls):
            for value in (1e6, 1e-6, 1, 0, 64, True, None, "auto"):
                try:
                    loss = cls(**{**given, option: value})
                except UserError:
                    continue
                out = loss(rollout)
                assert all(x.isfinite().all() for x in out.values()), (name, option, value)


class Weighted(BPTTLoss):
    """A loss of a user.

    Args:
        weight: of everything. It may be anything.
    """

    def __init__(self, actor_network, *, weight: int = 1, **kwargs):
        super().__init__(actor_network, **kwargs)
        self.weight = weight


def test_a_loss_of_ones_own_is_checked_too(env):
    actor = make_actor(env)
    assert Weighted(actor, weight=np.int64(3)).weight == 3
    with pytest.raises(UserValueError, match="weight must be a whole number, got 'much'. Of everything.$"):
        Weighted(actor, weight="much")
    refuses("alpha must be at least 0 or be 'auto', got -1", Weighted, actor, error=UserValueError, alpha=-1)
    with pytest.raises(UserTypeError, match="Weighted got an unexpected .* 'weigth'. Did you mean 'weight'"):
        Weighted(actor, weigth=2)


@pytest.mark.parametrize("way", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))], ids=["copy", "pickle"])
def test_a_copy_of_a_loss_computes_the_same(env, way):
    loss = Weighted(make_actor(env), weight=2)
    rollout, _ = differentiable_rollout(env, loss.actor_network, None, 3)
    assert way(loss)(rollout)["loss_actor"] == loss(rollout)["loss_actor"]
    assert list(inspect.signature(Weighted).parameters) == ["actor_network", "weight", "kwargs"]


def test_an_actor_or_a_carry_of_another_environment_is_refused(env, env64):
    actor = make_actor(env)
    forest = ForestEnv(num_envs=2, density=0.02)
    for other, carry, message in (
        (forest, None, "was built for entries of 13 numbers, and reads some of 9: those"),
        (env, env64.reset(), "'observation' of the carry is torch.float64 on cpu, and that of the env"),
    ):
        refuses(message, differentiable_rollout, other, actor, carry, 1, error=UserValueError)
    rollout, _ = differentiable_rollout(env64, make_actor(env64), None, 2)
    with pytest.raises(UserValueError, match="Critic computes in torch.float32 on cpu, and 'observation' is .*64"):
        SHACLoss(actor, make_value(env)).loss_value(rollout.detach())
