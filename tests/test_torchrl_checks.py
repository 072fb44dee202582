"""TorchRL's own checks of losses, for each of ours: those of pytorch/rl, test/objectives, which each test names, in
``_objectives_common.py`` (common), ``test_loss_module.py`` (module) and ``test_sac.py`` (sac).

What belongs to replayed samples does not apply, such as prioritised weights and multi-step targets, nor do composite
and discrete distributions, which have no derivative of single actions. GAE and V-trace are refused.
"""

import copy

import pytest
import torch
from helpers import refuses
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules import ActorValueOperator, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, SAPOLoss, SHACLoss

CRITICS = {"shac": SHACLoss, "sapo": SAPOLoss, "ahac": AHACLoss, "hybrid": HybridLoss, "abpt": ABPTLoss}
LOSSES = {"bptt": BPTTLoss, **CRITICS}
each_loss = pytest.mark.parametrize("name", LOSSES)
each_critic = pytest.mark.parametrize("name", CRITICS)


@pytest.fixture(scope="module")
def env():
    return HoveringEnv(num_envs=3, max_episode_steps=4, seed=0)


def build(env, name, critics=None, **options):
    """A loss of new networks."""
    critic = () if name == "bptt" else (critics or (make_qvalue if name == "abpt" else make_value)(env),)
    return LOSSES[name](make_actor(env, return_log_prob=True), *critic, **options)


def fly(env, loss):
    """A rollout of its policy; the hybrid reads its samples, with their targets."""
    rollout, _ = differentiable_rollout(env, loss.actor_network, None, 6)
    return loss.write_targets(rollout) if isinstance(loss, HybridLoss) else rollout


def seeded(loss, *data, **entries):
    torch.manual_seed(3)
    return loss(*data, **entries)


@each_loss
def test_keys_have_their_defaults_can_be_set_and_reach_the_estimator(env, name):
    """common: tensordict_keys_test, set_advantage_keys_through_loss_test."""
    loss = build(env, name)
    for key, default in vars(loss.default_keys()).items():
        assert getattr(loss.tensor_keys, key) == default
        loss.set_keys(**{key: ("other", key)})
        assert getattr(loss.tensor_keys, key) == ("other", key)
    estimator = loss.make_value_estimator().value_estimator
    assert estimator.tensor_keys.reward == ("other", "reward")
    loss.set_keys(done=None)
    assert estimator.tensor_keys.done == loss.tensor_keys.done == "done"
    refuses("reads no 'unknown'", loss.set_keys, unknown="x")


@each_loss
def test_entries_may_be_arguments_and_some_outputs_chosen(env, name):
    """sac: test_sac_notensordict; TorchRL flattens the names of nested entries."""
    loss = build(env, name)
    rollout, _ = differentiable_rollout(env, loss.actor_network, None, 6)
    entries = {"_".join([key] if isinstance(key, str) else key): rollout[key] for key in loss.in_keys}
    whole, given = seeded(copy.deepcopy(loss), rollout), seeded(copy.deepcopy(loss), **entries)
    assert set(whole.keys()) == set(loss.out_keys)
    torch.testing.assert_close(dict(zip(loss.out_keys, given, strict=True)), dict(whole.items()))
    loss.select_out_keys("loss_actor")
    torch.testing.assert_close(seeded(loss, **entries), whole["loss_actor"])


@each_loss
def test_losses_are_independent_leave_their_input_as_it_is_and_reach_no_target(env, name):
    """sac: test_sac, with _check_td_steady."""
    loss = build(env, name)
    rollout = fly(env, loss)
    before = rollout.clone()
    with set_exploration_type(ExplorationType.RANDOM):
        out = loss(rollout)
        assert exploration_type() == ExplorationType.RANDOM  # module: test_loss_exploration
    assert set(rollout.keys(True, True)) == set(before.keys(True, True)) and (rollout == before).all()
    reached = {"loss_actor": "actor_network", "loss_alpha": "log_alpha"}
    for key, value in out.items():
        if not key.startswith("loss_"):
            continue
        loss.zero_grad()
        value.backward(retain_graph=True)
        moved = {part.split("_params")[0] for part, x in loss.named_parameters() if x.grad is not None and x.grad.any()}
        assert moved == {reached.get(key, getattr(loss, "critic_name", ""))}


@each_loss
def test_parameters_are_those_of_the_networks_can_be_drawn_anew_and_saved(env, name):
    """common: reset_parameters_recursive_test; sac: test_state_dict; module: test_init_params."""
    loss, other = build(env, name), build(env, name)
    rollout = fly(env, loss)
    assert set(loss.actor_network_params.parameters()) == set(loss.actor_network.parameters())
    other.load_state_dict(loss.state_dict())
    torch.testing.assert_close(seeded(other, rollout)["loss_actor"], seeded(loss, rollout)["loss_actor"])
    state = {key: x.clone() for key, x in loss.state_dict().items() if key.endswith((".weight", ".bias"))}
    net = loss.get_stateful_net("actor_network").apply(lambda part: part)
    loss.from_stateful_net("actor_network", net)
    assert all(torch.equal(x, loss.state_dict()[key]) for key, x in state.items())
    for x in loss.state_dict().values():
        x += 1000
    loss.reset_parameters_recursive()
    assert not any(((x - state[key]) > 900).all() for key, x in loss.state_dict().items() if key in state)


@each_loss
def test_a_reduction_gives_numbers_or_one_for_each(env, name):
    """sac: test_sac_reduction. None is TorchRL's other word for the mean; a loss is shown in a line."""
    rollout, found = fly(env, build(env, name)), {}
    for reduction in ("none", "mean", "sum", None):
        torch.manual_seed(0)
        loss = build(env, name, reduction=reduction)
        out = found[reduction] = {key: x for key, x in seeded(loss, rollout).items() if key.startswith("loss_")}
        shapes = {tuple(x.shape) for x in out.values()}
        assert shapes and shapes <= ({(3,), (3, 6)} if reduction == "none" else {()})
        shown = repr(loss)
        assert shown.startswith(f"{type(loss).__name__}(actor_network=TanhGaussianActor") and "\n" not in shown
        assert shown.endswith(f", reduction={reduction or 'mean'!r})")
    torch.testing.assert_close(found[None], found["mean"], rtol=0, atol=0)


@each_critic
def test_a_list_of_critics_learns_by_any_distance_and_targets_follow_an_updater(env, name):
    """sac: test_sac_list_qvalue_networks; module: test_from_module_list, test_updater, test_loss_vmap_random."""
    is_q, distances = name == "abpt", {"l2": "mse_loss", "l1": "l1_loss", "smooth_l1": "smooth_l1_loss"}
    critics = [(make_qvalue if is_q else make_value)(env) for _ in range(3)]
    count = {} if name == "hybrid" else {"num_qvalue_nets" if is_q else "num_value_nets": 3}
    rollout = fly(env, build(env, name))
    for kind, function in distances.items():
        loss = build(env, name, critics, loss_function=kind, **count)
        data = seeded(loss.write_value_target, rollout.detach())
        predicted = [critic(data.copy())["state_action_value" if is_q else "state_value"] for critic in critics]
        errors = [getattr(nn.functional, function)(x, data["value_target"]) for x in predicted]
        torch.testing.assert_close(loss._critic_loss(data)[0], sum(errors))
    loss.set_vmap_randomness("different")  # which critics that are called one by one have anyway
    if name in ("shac", "abpt"):
        targets = getattr(loss, f"target_{loss.critic_name}_params")
        before = targets.clone()
        getattr(loss, f"{loss.critic_name}_params").data.add_(1.0)
        assert (targets == before).all()
        HardUpdate(loss, value_network_update_interval=1).step()
        SoftUpdate(loss, tau=0.5).step()
        assert not (targets == before).any()
    else:
        refuses("Did not find any target parameters", SoftUpdate, loss, error=RuntimeError, tau=0.5)


@pytest.mark.parametrize("name", ["bptt", "shac", "sapo", "ahac", "abpt"])
def test_the_coefficient_of_the_entropy_can_be_scheduled_and_saved(env, name):
    """module: TestSchedulableBuffers."""
    loss, other = build(env, name, alpha=1e-3), build(env, name, alpha=0.3)
    rollout = fly(env, loss)
    for value in (0.25, 2, torch.tensor(0.5)):
        loss.fixed_alpha = value
        assert loss.alpha == value and seeded(loss, rollout)["alpha"] == value
    loss.alpha = 0.125
    other.load_state_dict(loss.state_dict())
    assert other.alpha == 0.125 and other.fixed_alpha.dtype == torch.float32
    torch.testing.assert_close(seeded(other, rollout)["loss_actor"], seeded(loss, rollout)["loss_actor"])
    refuses("alpha must be at least 0, got -1", setattr, loss, "alpha", -1)
    learned = build(env, name, alpha="auto")
    learned.alpha = 0.5
    assert learned.log_alpha.exp().item() == pytest.approx(0.5) and learned.log_alpha.requires_grad
    refuses("write loss.alpha = ... instead", setattr, learned, "fixed_alpha", 0.1)
    if name != "sapo":
        without = build(env, name)
        without.alpha = 0.1
        assert set(seeded(without, rollout).keys()) == set(without.out_keys) >= {"entropy", "alpha"}


def test_layers_that_actor_and_critic_share_stay_shared_in_another_precision(env):
    """module: test_shared_params, TestCast."""
    common = TensorDictModule(nn.Linear(13, 8), ["observation"], ["hidden"])
    last = TensorDictModule(nn.Sequential(nn.Linear(8, 8), NormalParamExtractor()), ["hidden"], ["loc", "scale"])
    head = ProbabilisticActor(last, ["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True)
    both = ActorValueOperator(common, head, ValueOperator(nn.Linear(8, 1), in_keys=["hidden"]))
    loss = SHACLoss(both.get_policy_operator(), both.get_value_operator(), clip_action_gradient=2.0)
    rollout, _ = differentiable_rollout(env, loss.actor_network, None, 4)
    assert sum(x for key, x in loss(rollout).items() if key.startswith("loss_")).isfinite()
    first = "module", "0", "module", "weight"
    assert loss.actor_network_params[first] is loss.value_network_params[first]
    assert all(x.dtype == torch.float64 for x in loss.double().parameters())


def test_a_mask_has_the_name_that_loss_mask_key_says(env):
    """module: the tests of loss_mask_key, of later versions."""
    loss = build(env, "bptt", reduction="none")
    rollout = fly(env, loss)
    rollout["mine"] = torch.arange(6).expand(3, 6) < 3
    rollout["collector", "mask"] = torch.zeros(3, 6, dtype=torch.bool)
    assert (loss(rollout)["loss_actor"] == 0).all()
    loss.loss_mask_key = "mine"
    torch.testing.assert_close(loss(rollout)["loss_actor"], loss(rollout[:, :3].exclude("collector"))["loss_actor"])
    loss.loss_mask_key = None
    assert (loss(rollout)["loss_actor"] != 0).all()


COMPILED = [pytest.param(name, marks=[] if name in ("bptt", "hybrid") else pytest.mark.slow) for name in LOSSES]


@pytest.mark.filterwarnings("ignore")  # of torch, about its own insides
@pytest.mark.parametrize("name", COMPILED)
def test_a_loss_compiles_into_one_graph_with_the_same_numbers(env, name):
    """sac and others: their tests with torch.compile. AHAC reads the graph of the flight, outside of all others."""
    loss = build(env, name)
    flight = fly(env, loss)
    rollout = flight if name == "ahac" else flight[:, 2:5]  # an episode ends in the middle
    compiled = torch.compile(loss, fullgraph=name != "ahac", backend="eager")
    torch.testing.assert_close(seeded(compiled, rollout), seeded(loss, rollout))
