"""Losses against numbers worked by hand."""

import pytest
import torch
from helpers import refuses
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives.utils import ValueEstimators

from torchrl_quad import ABPTLoss, AHACLoss, BPTTLoss, SHACLoss

GAMMA, LAMBDA = 0.5, 0.5


class Scale(nn.Module):
    """Multiplies its input by one weight."""

    def __init__(self, weight):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(float(weight)))

    def forward(self, x, *others):
        return self.weight * x + sum(others)


def make_networks(policy=2.0, critic=10.0):
    """a = policy * s; V(s) = critic * s; Q(s, a) = critic * s + a."""
    actor = TensorDictModule(Scale(policy), in_keys=["observation"], out_keys=["action"])
    value = TensorDictModule(Scale(critic), in_keys=["observation"], out_keys=["state_value"])
    qvalue = TensorDictModule(Scale(critic), in_keys=["observation", "action"], out_keys=["state_action_value"])
    return actor, value, qvalue


def make_abpt(actor, *critics, **kwargs):
    """ABPT with one critic Q(s, a) = critic * s + a for each of the weights."""
    loss = ABPTLoss(actor, make_networks()[2], num_qvalue_nets=len(critics), **kwargs)
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        params["module", "weight"].data.copy_(torch.tensor(critics))
    return loss.make_value_estimator(gamma=GAMMA, lmbda=LAMBDA)


def doubling():
    """A rollout of x' = x + a, a = x, with a reward of -x'^2 / 2: from 1 to 2 to 4."""
    positions, actions = [torch.ones(1, 1).double()], []
    for _ in range(2):
        actions.append(positions[-1] * torch.ones(1, requires_grad=True).double())
        positions.append(positions[-1] + actions[-1])
    rollout = TensorDict({"observation": torch.stack(positions[:2], 1), "action": torch.stack(actions, 1)}, [1, 2])
    ends = dict.fromkeys(("done", "terminated"), torch.zeros(1, 2, 1, dtype=torch.bool))
    later = torch.stack(positions[1:], 1)
    return rollout.set("next", TensorDict({"observation": later, "reward": -0.5 * later**2, **ends}, [1, 2]))


def make_rollout(actor, dtype=torch.float32):
    """Two environments, four steps. Environment 0 is truncated at step 1; environment 1 terminates at step 2.

    Observations are 1, 2, 3, 4 (next: 2, 9, 4, 5 with 9 the true last state before the reset), and the reward of each
    step is its action: r = 2 s at policy weight 2.
    """
    observation = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=dtype).view(1, 4, 1).repeat(2, 1, 1)
    following = torch.tensor([[2.0, 9.0, 4.0, 5.0], [2.0, 3.0, 9.0, 5.0]], dtype=dtype).unsqueeze(-1)
    terminated = torch.zeros(2, 4, 1, dtype=torch.bool)
    truncated = terminated.clone()
    truncated[0, 1] = True
    terminated[1, 2] = True
    rollout = actor(TensorDict({"observation": observation}, [2, 4]))
    ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    rollout["next"] = TensorDict({"observation": following, "reward": rollout["action"] * 1.0, **ends}, [2, 4])
    return rollout


# Rewards are 2, 4, 6, 8. Environment 0: [2 + 4/2] + [6 + 8/2] = 14; environment 1: [2 + 4/2 + 6/4] + [8] = 13.5.
REWARDS = [14.0, 13.5]


def test_bptt_sums_the_discounted_rewards_of_each_segment():
    actor, *_ = make_networks()
    loss = BPTTLoss(actor, reduction="none").make_value_estimator(gamma=GAMMA)
    assert loss(make_rollout(actor))["loss_actor"].tolist() == [-x for x in REWARDS]
    mean = BPTTLoss(actor).make_value_estimator(gamma=GAMMA)(make_rollout(actor))["loss_actor"]
    assert mean.item() == -sum(REWARDS) / 2
    mean.backward()
    # every reward is proportional to the policy's weight of 2
    assert actor.module.weight.grad.item() == -sum(REWARDS) / 2 / 2
    total = BPTTLoss(actor, reduction="sum").make_value_estimator(gamma=GAMMA)(make_rollout(actor))["loss_actor"]
    assert total.item() == -sum(REWARDS)


def test_abpt_averages_the_n_step_and_the_0_step_return():
    actor, *_ = make_networks()

    def objective(**switches):
        loss = make_abpt(actor, 10.0, 20.0, reduction="none", **switches)
        return [-x for x in loss.loss_actor(make_rollout(actor))[0].tolist()]

    # The smaller critic wins: Q(s, pi(s)) = 10 s + 2 s. Segments start at s = 1 and 3 in environment 0, 1 and 4 in 1.
    n_step = [14 + 12 * 9 / 4 + 12 * 5 / 4, 13.5 + 12 * 5 / 2]
    zero_step = [12 * 1 + 12 * 3, 12 * 1 + 12 * 4]
    assert objective(zero_step_return=False) == n_step and objective(n_step_return=False) == zero_step
    assert objective() == [(a + b) / 2 for a, b in zip(n_step, zero_step, strict=True)]


def test_the_bootstrap_of_abpt_has_its_gradient_through_state_and_action_and_none_in_the_critic():
    actor, *_ = make_networks()
    loss = make_abpt(actor, 10.0)
    rollout = make_rollout(actor)
    shift = torch.zeros(2, 4, 1, requires_grad=True)
    rollout["next", "observation"] = rollout["next", "observation"] + shift
    loss.loss_actor(rollout)[0].backward()
    # d/d(next observation) = mean over envs, half weight, discount gamma^n, of d(10 s + 2 s)/ds; none at a termination
    assert (-shift.grad[..., 0] * 2 * 2).tolist() == [[0, 12 / 4, 0, 12 / 4], [0, 0, 0, 12 / 2]]
    # policy weight: rewards give s * discount, the bootstraps' actions their state, the 0-step returns' actions too
    rewards = sum(REWARDS) / 2
    bootstraps = 9 / 4 + 5 / 4 + 5 / 2
    starts = (1 + 3) + (1 + 4)
    assert actor.module.weight.grad.item() == pytest.approx(-(rewards + bootstraps + starts) / 2 / 2)
    assert all(p.grad is None for p in loss.qvalue_network_params.values(True, True))


def test_without_its_terminal_gradient_shac_has_the_value_of_shac_and_the_gradient_of_bptt():
    actor, value, _ = make_networks()

    def value_and_gradient(loss, rollout):
        loss.make_value_estimator(gamma=GAMMA)
        actor.module.weight.grad = None
        objective = loss.loss_actor(rollout)[0]
        objective.backward()
        return objective.item(), actor.module.weight.grad.item()

    def rollout():
        """The next observations depend on the policy, too: they grow by its weight less 2."""
        rollout = make_rollout(actor)
        rollout["next", "observation"] = rollout["next", "observation"] + actor.module.weight - 2.0
        return rollout

    kept = value_and_gradient(SHACLoss(actor, value), rollout())
    cut = value_and_gradient(SHACLoss(actor, value, terminal_gradient=False), rollout())
    terminal = [90 / 4 + 50 / 4, 50 / 2]  # gamma^n V(s_n) of each environment, and its derivative: 10 gamma^n
    assert cut[0] == kept[0] == -(sum(REWARDS) + sum(terminal)) / 2
    assert cut[1] == value_and_gradient(BPTTLoss(actor), rollout())[1] == -sum(REWARDS) / 2 / 2
    assert kept[1] == cut[1] - (10 / 4 + 10 / 4 + 10 / 2) / 2


def test_shac_as_published_by_xu_et_al_bootstraps_with_the_target_critic_and_divides_by_the_steps():
    def fly(**options):
        """The objectives, and their gradients in the next observations, when critic and target say 10 s and 30 s."""
        actor, value, _ = make_networks()
        loss = SHACLoss(actor, value, reduction="none", **options).make_value_estimator(gamma=GAMMA)
        if options.get("delay_value", True):
            loss.target_value_network_params["module", "weight"].data.fill_(30.0)
        rollout = make_rollout(actor)
        shift = torch.zeros(2, 4, 1, requires_grad=True)
        rollout["next", "observation"] = rollout["next", "observation"] + shift
        objective = -loss.loss_actor(rollout)[0]
        objective.sum().backward()
        assert all(p.grad is None for p in loss.value_network_params.values(True, True))
        assert torch.equal(sum(loss.objective_parts(rollout).values()), objective)
        return objective.tolist(), shift.grad[..., 0].tolist()

    # gamma^n V(s_n): with the critic 90 / 4 + 50 / 4 and 50 / 2, with the target three times as much
    critic = ([14 + 35, 13.5 + 25], [[0, 10 / 4, 0, 10 / 4], [0, 0, 0, 10 / 2]])
    target = ([14 + 105, 13.5 + 75], [[0, 30 / 4, 0, 30 / 4], [0, 0, 0, 30 / 2]])
    divided = tuple((torch.tensor(x) / 4).tolist() for x in target)
    assert fly() == critic and fly(target_bootstrap=True) == target
    assert fly(target_bootstrap=True, average_over_horizon=True) == divided
    assert fly(target_bootstrap=True, delay_value=False) == critic  # there is no other network


def test_the_objective_is_the_sum_of_its_parts_and_truncation_bootstraps_and_termination_does_not():
    actor, value, _ = make_networks()
    shac = SHACLoss(actor, value, reduction="none").make_value_estimator(gamma=GAMMA)
    abpt = make_abpt(actor, 10.0, reduction="none")
    # SHAC: environment 0 has V(9) = 90 after two steps, V(5) = 50 after two; environment 1 has V(5) after one.
    parts = {
        BPTTLoss(actor, reduction="none").make_value_estimator(gamma=GAMMA): {"rewards": REWARDS},
        shac: {"rewards": REWARDS, "terminal_value": [90 / 4 + 50 / 4, 50 / 2]},
        abpt: {"n_step_return": [(14 + 27 + 15) / 2, (13.5 + 30) / 2], "zero_step_return": [48 / 2, 60 / 2]},
    }
    for loss, expected in parts.items():
        rollout = make_rollout(actor)
        found = loss.objective_parts(rollout)
        assert {name: part.tolist() for name, part in found.items()} == expected
        assert torch.equal(sum(found.values()), -loss.loss_actor(rollout)[0])
        assert all(part.requires_grad for part in found.values())
    refuses("needs a rollout", shac.objective_parts, make_rollout(actor)[:, 0])


def test_a_loss_has_the_precision_of_its_rollout():
    actor, value, _ = make_networks()
    loss = SHACLoss(actor.double(), value.double(), alpha=0.1).make_value_estimator(gamma=0.99, lmbda=0.95)
    rollout = make_rollout(actor, torch.float64)
    rollout["action_log_prob"] = -torch.ones(2, 4, dtype=torch.float64)
    rewards = loss.objective_parts(rollout)["rewards"]
    expected = [(2 + 4 * 0.99) + (6 + 8 * 0.99), 2 + 0.99 * (4 + 0.99 * 6) + 8]
    assert rewards.tolist() == pytest.approx(expected, abs=1e-14)
    target = loss.write_value_target(rollout)["value_target"]
    assert target[0, 0].item() == pytest.approx(2 + 0.99 * (0.05 * 20 + 0.95 * (4 + 0.99 * 90)), rel=1e-15)
    default = BPTTLoss(actor, alpha="auto", alpha_init=0.3)
    assert (default.value_estimator.gamma.item(), loss.alpha.item()) == (0.99, 0.1)
    assert default.alpha.item() == pytest.approx(0.3, abs=1e-15)


def td_lambda(rewards, next_values, ends, terminations):
    """Backwards: G = r + gamma ((1 - lambda) V' + lambda G'), with V' = 0 when terminated and G' = V' at an end."""
    found, following = [], None
    for r, v, end, terminated in reversed(list(zip(rewards, next_values, ends, terminations, strict=True))):
        v = 0.0 if terminated else v
        following = v if end or following is None else following
        following = r + GAMMA * ((1 - LAMBDA) * v + LAMBDA * following)
        found.append(following)
    return found[::-1]


def targets(rewards):
    """Of make_rollout's two environments, where V(s) = 10 s."""
    first = td_lambda(rewards, [20, 90, 40, 50], [False, True, False, True], [False] * 4)
    return [first, td_lambda(rewards, [20, 30, 90, 50], [False, False, True, True], [False, False, True, False])]


def test_td_lambda_targets_respect_the_ends_and_come_from_the_target_network_and_for_abpt_from_the_least_critic():
    actor, value, _ = make_networks()
    loss = SHACLoss(actor, value).make_value_estimator(gamma=GAMMA, lmbda=LAMBDA)
    value.module.weight.data.fill_(-3.0)  # the target network still says 10 s
    target = loss.write_value_target(make_rollout(actor).detach())["value_target"]
    expected = targets([2.0, 4.0, 6.0, 8.0])
    # by hand: environment 0, step 1: 4 + 0.5 * 90 = 49; step 0: 2 + 0.5 (0.5 * 20 + 0.5 * 49) = 19.25
    assert expected[0][:2] == [19.25, 49.0]
    # environment 1, step 2: 6; step 1: 4 + 0.5 (0.5 * 30 + 0.5 * 6) = 13
    assert expected[1][1:3] == [13.0, 6.0]
    torch.testing.assert_close(target[..., 0], torch.tensor(expected))
    target = make_abpt(actor, 10.0, 20.0).write_value_target(make_rollout(actor).detach())["value_target"]
    expected = td_lambda([2.0, 4.0, 6.0, 8.0], [24, 108, 48, 60], [False, True, False, True], [False] * 4)
    torch.testing.assert_close(target[0, :, 0], torch.tensor(expected))


def test_the_critic_s_loss_is_the_squared_error_and_reaches_the_critic_alone():
    actor, value, _ = make_networks()
    rollout = make_rollout(actor)
    rollout["value_target"] = torch.zeros(2, 4, 1)
    loss_value, metadata = SHACLoss(actor, value).loss_value(rollout)
    # V = 10, 20, 30, 40 in both environments
    assert loss_value.item() == pytest.approx((100 + 400 + 900 + 1600) / 4)
    assert metadata["pred_value"].item() == 25.0
    loss_value.backward()
    assert value.module.weight.grad is not None and actor.module.weight.grad is None
    # two critics, each (12 s)^2
    loss_qvalue, _ = make_abpt(actor, 10.0, 10.0).loss_qvalue(rollout)
    assert loss_qvalue.item() == pytest.approx(2 * 144 * (1 + 4 + 9 + 16) / 4)


def test_missing_targets_are_computed_also_where_a_terminated_last_state_is_not_finite():
    actor, value, _ = make_networks()
    loss = SHACLoss(actor, value).make_value_estimator(gamma=GAMMA, lmbda=LAMBDA)
    rollout = make_rollout(actor).detach()
    without = loss.loss_value(rollout)[0]
    assert "value_target" not in rollout
    clean = loss.write_value_target(rollout.copy())
    assert without == loss.loss_value(clean)[0]
    rollout["next", "observation"][1, 2] = float("nan")
    assert torch.equal(loss.write_value_target(rollout)["value_target"], clean["value_target"])


def test_td0_is_offered_and_gae_is_not():
    actor, value, _ = make_networks()
    loss = SHACLoss(actor, value).make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    target = loss.write_value_target(make_rollout(actor).detach())["value_target"]
    assert target[1, :, 0].tolist() == [2 + 10, 4 + 15, 6, 8 + 25]
    with pytest.raises(NotImplementedError, match="not implemented for loss SHACLoss"):
        loss.make_value_estimator(ValueEstimators.GAE)


def test_without_delay_the_target_is_the_critic_itself():
    actor, value, qvalue = make_networks()
    for loss in (SHACLoss(actor, value, delay_value=False), ABPTLoss(actor, qvalue, delay_qvalue=False)):
        loss.make_value_estimator(gamma=GAMMA)
        before = loss.write_value_target(make_rollout(actor).detach())["value_target"].clone()
        getattr(loss, f"{loss.critic_name}_params").data.apply_(lambda parameter: parameter.add_(1.0))
        assert not torch.equal(loss.write_value_target(make_rollout(actor).detach())["value_target"], before)


def test_the_entropy_bonus_is_alpha_times_the_mean_of_minus_log_prob_and_alpha_rises_where_that_is_too_low():
    actor, *_ = make_networks()
    rollout = make_rollout(actor)
    rollout["action_log_prob"] = -torch.arange(8.0).view(2, 4)
    plain = BPTTLoss(actor, reduction="none").make_value_estimator(gamma=GAMMA)(rollout)["loss_actor"]
    out = BPTTLoss(actor, reduction="none", alpha=0.5).make_value_estimator(gamma=GAMMA)(rollout)
    torch.testing.assert_close(out["loss_actor"], plain - 0.5 * torch.tensor([1.5, 5.5]))
    assert out["entropy"].item() == 3.5
    for log_prob, direction in ((3.0, -1.0), (-3.0, 1.0)):
        loss = BPTTLoss(actor, alpha="auto", alpha_init=0.2, target_entropy=0.0).make_value_estimator(gamma=GAMMA)
        rollout = make_rollout(actor)
        rollout["action_log_prob"] = torch.full((2, 4), log_prob)
        loss(rollout)["loss_alpha"].backward()
        assert loss.alpha.item() == pytest.approx(0.2)
        assert loss.log_alpha.grad.sign().item() == direction  # gradient descent moves alpha the other way
    assert BPTTLoss(actor, alpha="auto")._target_entropy(make_rollout(actor)) == -1.0


@pytest.mark.parametrize(("lmbda", "expected"), [(1.0, (-8.0, -3.0)), (0.5, (-4.5, -3.0))])
def test_each_action_climbs_its_own_lambda_return(lmbda, expected):
    """V = x, and x' = 2 x: the first action has -2 + (1 - lambda) 1 + lambda (-8 + 2), the second one -4 + 1."""
    actor, value, _ = make_networks(policy=1.0, critic=1.0)
    loss = AHACLoss(actor, value, horizon=2, num_value_nets=1, gradient_lmbda=lmbda).double()
    rollout = doubling().set("loc", torch.zeros(1, 2, 1)).set("scale", torch.zeros(1, 2, 1))
    loss.make_value_estimator(gamma=1.0, lmbda=1.0)
    change = (loss.better_actions(rollout, 0.3)[0] - rollout["action"])[0, :, 0]
    assert change.tolist() == pytest.approx([0.1 * x for x in expected])  # the median of two is the lower one
