"""The building blocks of a recipe, and horizons with their graph in TorchRL's Trainer and collectors."""

import math
from types import SimpleNamespace

import pytest
import torch
from helpers import assert_equal, cases, refuses
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import nn
from torchrl.checkpoint import Checkpoint
from torchrl.envs import CatFrames, TransformedEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers import DefaultOptimizationStepper, Trainer, UpdateWeights

from torchrl_quad import DifferentiableCollector, HoveringEnv, differentiable_rollout
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.modules import make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, SHACLoss
from torchrl_quad.training import building, evaluation
from torchrl_quad.training.building import AdaptiveOptimizer, Optimizer, minibatches, shuffled
from torchrl_quad.training.configuration import compose
from torchrl_quad.training.evaluation import has_levelled_off, last_rise, looks_ahead, merit, next_pace, stalls
from torchrl_quad.training.loop import Run, backward


def optimizer(iterations, kind=Optimizer, **options):
    """Of a network with one parameter, in a run of so many iterations."""
    section = {"lr": 1e-2, "final_lr": 1e-4, "betas": [0.9, 0.99], "schedule": "linear", "max_grad_norm": 1.0}
    run = {"num_envs": 2, "horizon": 3, "total_steps": 6 * iterations, "actor": section | options}
    return kind(OmegaConf.create(run), "actor", torch.nn.Linear(1, 1, bias=False))


def numbered(*shape):
    """A rollout that numbers its steps."""
    return TensorDict({"step": torch.arange(torch.Size(shape).numel()).view(shape)}, shape)


@pytest.mark.parametrize(("kind", "critic"), [(SHACLoss, make_value), (ABPTLoss, make_qvalue)])
def test_a_target_critic_follows_as_with_torchrl_s_soft_update(kind, critic):
    env = HoveringEnv(num_envs=1)
    targets = []
    for update in (building.TargetUpdate, SoftUpdate):
        torch.manual_seed(0)
        loss = kind(make_actor(env), critic(env))
        updater = update(loss, tau=0.1)
        getattr(loss, f"{loss.critic_name}_params").data.apply_(lambda parameter: parameter.add_(1.0))
        updater.step()
        targets.append(getattr(loss, f"target_{loss.critic_name}_params").data.clone())
    own, torchrl = (dict(target.items(True, True)) for target in targets)
    assert len(own) > 3
    torch.testing.assert_close(own, torchrl)


@cases((SHACLoss, make_value, [0.5, 0.001]), (ABPTLoss, make_qvalue, 0.1))
def test_a_critic_of_a_recipe_reads_what_its_policy_does_not_see(kind, make, scale):
    section = {"num_cells": [8], "activation": "ELU", "input_scale": scale, "lmbda": 0.95}
    section |= {"in_keys": ["observation", ["state", "rotor_speed"]]}
    cfg = OmegaConf.create({"critic": section, "normalize": False, "loss": {}, "gamma": 0.99})
    env = HoveringEnv(num_envs=3)
    actor = make_actor(env)
    loss = building.make_loss(kind, cfg, env, actor, make)
    rollout, _ = differentiable_rollout(env, actor, None, 4)
    before = loss(rollout)
    rollout["next", "state"] = rollout["next", "state"].apply(lambda x: x)
    rollout["next", "state", "rotor_speed"] = 0.5 * rollout["next", "state", "rotor_speed"]
    assert loss(rollout)["loss_actor"] != before["loss_actor"]
    assert ("state", "rotor_speed") in loss.in_keys and ("state", "rotor_speed") not in actor.in_keys


class Known(Disturbance):
    """Lets critics know the rotor speeds."""

    privileged = {"rotor_speed": 1e-3}


class Blind(HoveringEnv):
    """Lets only critics know where the drone is."""

    privileged = {"position": 0.5}

    def observe(self, state):
        return state["velocity"]


@cases(
    (["env.disturbances=[test_building.Known]"], {("state", "rotor_speed"): 1e-3}),
    (["task=test_building.Blind"], {("state", "position"): 0.5}),
    (["env.randomize=any", "env.control=rotor_thrusts", "env.drone=cf2x"],
        {("state", "traits"): 1.0, ("state", "rotor_speed"): 1e-3}),
    (["env.drone=cf2x"], {}),
)  # fmt: skip
def test_critics_read_what_a_task_or_a_disturbance_keeps_from_policies_which_then_have_a_memory(words, read):
    cfg = compose("train", ["task=hovering", "compile=false", "num_envs=2", *words])
    env, actor = building.set_up(cfg)
    critic = make_value(env, **building.network(cfg, "critic", env))
    assert critic.in_keys == ["observation", *read] and critic.module.scales == (1.0, *read.values())
    assert ("recurrent_state" in actor.in_keys) == bool(read)
    forgets = building.make_policy(compose("train", [*words, "actor.recurrent=false"]), env)
    assert "recurrent_state" not in forgets.in_keys


@cases(("mass", 1.0), ("position", "large"), ("position", None), ("position", float("nan")))
def test_what_critics_are_to_read_must_be_in_the_state(key, factor):
    class Wrong(HoveringEnv):
        privileged = {key: factor}

    refuses(rf"Wrong.privileged must be entries of the state, .* got '{key}': {factor!r}. The state has: ", Wrong)
    Wrong.privileged = [key]
    refuses(rf"Wrong.privileged must be entries of the state, .* got \['{key}'\]", Wrong)


@cases(("constant", 1e-2, 1e-2), ("linear", 5.05e-3, 1e-4), ("exponential", 1e-3, 1e-4), ("cosine", 5.05e-3, 1e-4))
def test_a_schedule_goes_from_the_first_to_the_last_learning_rate(schedule, halfway, last):
    adam = optimizer(100, schedule=schedule)
    for iteration, rate in ((0, 1e-2), (49.5, halfway), (99, last), (200, last)):
        adam.anneal(iteration)
        assert adam.param_groups[0]["lr"] == pytest.approx(rate)


def test_the_inverse_square_root_of_the_iteration_is_the_same_rate_in_runs_of_every_length():
    for length in (901, 5000):
        adam = optimizer(length, schedule="inverse_sqrt")
        for iteration, rate in ((0, 1e-2), (150, 1e-2), (600, 5e-3), (700, 1e-2 * (15 / 70) ** 0.5)):
            adam.anneal(iteration)
            assert adam.param_groups[0]["lr"] == pytest.approx(rate)
    for iteration, share in ((3999, 1.0), (4499, 0.5), (4999, 0.0)):  # and of a run that comes to its last fifth
        adam.anneal(iteration, pace=0.25)
        assert adam.param_groups[0]["lr"] == pytest.approx(share * 0.25e-2 * (150 / iteration) ** 0.5, rel=2e-3)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_rewards_in_any_unit_are_divided_by_the_size_of_returns_and_critics_keep_what_they_say(unit):
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=2, seed=0)
    loss = AHACLoss(actor := make_actor(env), make_value(env))
    scale, rollout = building.ReturnScale(loss), differentiable_rollout(env, actor, None, 3)[0]
    for size in (4.0, 2.0):  # of all targets, in the reward's unit
        before = scale.value
        reward = unit * torch.ones(2, 3, 1, requires_grad=True)
        data = rollout.detach().set(("next", "reward"), reward)
        scale.divide(data)
        torch.testing.assert_close(data["next", "reward"].double() * before, reward.double())
        assert data["next", "reward"].requires_grad
        data = data.detach().set("value_target", torch.full((2, 3, 1), size * unit) / before.float())
        said = loss._critics(data) * before
        scale.update(data)
        torch.testing.assert_close(loss._critics(data) * scale.value, said, rtol=1e-5, atol=1e-6 * unit)
        targets = torch.full((2, 3, 1), size * unit).double()
        torch.testing.assert_close(data["value_target"].double() * scale.value, targets)
    assert scale.value.item() == pytest.approx(unit * ((16 + 4) / 2) ** 0.5, rel=1e-6)


def test_a_run_stalls_when_no_evaluation_has_risen_for_a_share_of_it_and_levels_off_when_it_does_so_again():
    returns = [-10.0, 90.0, 90.9, 91.1, 91.9, *[92.0] * 5]  # a rise is 1 % of the range, 1: at the fourth step
    curve = [{"steps": 10 * i, "eval/return": x, "eval/solved": 0.98} for i, x in enumerate(returns, 1)]
    assert [last_rise(curve[:n]) for n in range(1, 11)] == [10, 20, 20, 40, 40, 40, 40, 40, 40, 40]
    assert [stalls(curve, 0, x, least=6) for x in (None, 0.61, 0.59, 0.5)] == [False, False, True, True]
    assert [stalls(curve, x, 0.3, least=3) for x in (60, 70, 80)] == [True, True, False]
    assert not stalls(curve, 0, 0.5) and not stalls([], 0, 0.5)  # too few evaluations to say
    low = [row | {"eval/solved": 0.4} for row in curve]
    assert not stalls(low, 0, 0.5, least=6)  # the task is not solved, and 30 evaluations are too few to say
    long = low + [low[-1] | {"steps": 100.0 + i, "eval/solved": 0.3 + 0.004 * i} for i in range(1, 31)]
    assert [stalls(long[:n], 0, 0.2) for n in (34, 39)] == [True, True] and not stalls(long[:33], 0, 0.2)
    assert stalls(long[:15] + long[-1:], 0, 0.2, least=5) is False and not stalls(long, 66, 0.2)
    later = [row | {"steps": 100.0 + 10 * i} for i, row in enumerate(curve[-1:] * 20)]
    level = [has_levelled_off(curve + later, since, 0.5) for since in (0, 40, 50, 140, 150)]
    assert level == [False, False, True, True, False]
    assert not has_levelled_off([row | {"eval/solved": 0.97} for row in curve + later], 50, 0.5)
    later = [row | {"eval/solved": 0.4} for row in later]
    assert [looks_ahead(rows, 0.6) for rows in ([], low[:1], low, low + later)] == [False, False, False, True]
    assert looks_ahead([curve[0] | {"eval/solved": 0.9}, *low], 0.6)
    assert looks_ahead([*low, *later, {"steps": 300.0, "eval/return": 200.0, "eval/solved": 0.0}], 0.6)  # it stays so
    assert not looks_ahead(low + later, None)
    curve[7]["eval/solved"] = 1.0
    assert last_rise(curve) == 80 and last_rise([*curve, curve[-1] | {"eval/return": float("nan")}]) == 80
    again = [curve[0] | {"eval/return": -math.inf}, curve[-1] | {"steps": 120, "eval/return": 99}]
    assert last_rise([*curve, *again]) == 120
    offset = [row | {"eval/return": row["eval/return"] + 1000.0} for row in curve]  # 1 % of the return itself
    assert last_rise(offset[:7]) == 20


@cases(
    (True, [0.2, 0.9, 0.5], [0, 100, 89]),
    (False, [0.2, 0.9, 0.5], [0, 100, 91]),  # it just misses the last gate
    (False, [0.2, 0.9, 0.7], [0, 100, 50]),
    (False, [0.2, 0.4, 0.0], [0, 100, 50]),  # it never had a way
    (True, [0.2, 0.9, 0.0], [0, 100, math.nan]),
    (True, [0.2, 0.9, 0.0], [0, 100, -math.inf]),
    (False, [0.2, 0.9], [math.nan, 100]),
)
def test_a_run_has_lost_its_way_where_it_solves_a_third_less_and_its_return_fell(lost, solved, returns):
    rows = [{"eval/solved": x, "eval/return": y} for x, y in zip(solved, returns, strict=True)]
    assert [evaluation.has_lost_its_way(rows, patience) for patience in (0.5, None)] == [lost, False]


def test_the_best_policy_solves_most_and_with_a_patience_to_the_nearest_2_percent_and_half_at_least():
    early, late = {"solved": 1.0, "return": 112.7}, {"solved": 127 / 128, "return": 141.5}
    none, first = {"solved": 125 / 128, "return": 150.0}, {"solved": -math.inf, "return": -math.inf}
    assert max([first, early, late, none], key=lambda score: merit(score, None)) == early
    assert max([first, early, late, none], key=lambda score: merit(score, 0.5)) == late
    crashes, comes_near = {"solved": 27 / 128, "return": 17.4}, {"solved": 17 / 128, "return": 28.5}
    assert max([first, crashes, comes_near], key=lambda score: merit(score, None)) == crashes
    assert max([first, crashes, comes_near], key=lambda score: merit(score, 0.5)) == comes_near
    half = {"solved": 0.5, "return": 10.0}
    assert max([first, crashes, half, comes_near], key=lambda score: merit(score, 0.5)) == half


def test_the_rate_quarters_where_a_run_stalls_halves_where_it_has_lost_its_way_and_doubles_with_each_rise():
    curve = [{"steps": 10 * i, "eval/return": min(i, 20.0), "eval/solved": 0.5} for i in range(1, 62)]
    assert [next_pace(curve[:n], 0, 0.5) for n in range(1, 41)] == [*[2.0] * 20, *[1.0] * 19, 0.25]
    assert next(n for n in range(21, 62) if next_pace(curve[:n], 250, 0.5) == 0.25) == 50
    assert next_pace(curve[:5], 0, None) == next_pace(curve, 0, None) == 1.0
    assert next_pace([*curve[:21], {"steps": 220, "eval/return": 10.0, "eval/solved": 0.3}], 0, 0.5) == 0.5
    fell = [{"steps": 210 + i, "eval/return": -i, "eval/solved": 0.3} for i in range(14)]
    fell[3] = fell[3] | {"eval/return": math.nan}
    lucky = [*curve[:21], *fell, {"steps": 225, "eval/return": 30.0, "eval/solved": 0.6}, *fell[:3]]
    paces = [next_pace(lucky[:n], 0, 0.9) for n in range(22, 40)]
    assert paces == [*[0.5] * 11, *[2.0] * 4, *[0.5] * 3]  # to one policy a run goes back at half the rate eleven times
    rare = [row | {"steps": 100 * row["steps"], "eval/return": 1.0} for row in curve[1:]]
    assert [next_pace(curve[:1] + rare[:n], 0, 0.5) for n in range(1, 11)] == [*[1.0] * 9, 0.25]  # ten at least


def test_when_a_run_evaluates_follows_from_what_every_process_knows():
    cfg = OmegaConf.create({"eval": {"patience": 0.5, "interval": 2}})
    run = {"cfg": cfg, "evaluated": 102}  # and no rows, which the first process alone has
    assert [Run.is_due.fget(SimpleNamespace(**run, iteration=i)) for i in (103, 104, 105, 106)] == [*[False] * 3, True]


def test_the_gradient_of_alpha_takes_nothing_of_the_actor_s_norm():
    loss = BPTTLoss(make_actor(HoveringEnv(num_envs=1), return_log_prob=True), alpha="auto")
    actor = list(loss.actor_network_params.parameters())
    objective = sum(x.sum() for x in actor) + 1e6 * loss.log_alpha
    _, norm = backward(objective, torch.optim.Adam(building.parameter_groups("actor", loss)), 0.5)
    gradient = torch.cat([x.grad.flatten() for x in actor])
    assert norm.item() == pytest.approx(gradient.numel() ** 0.5, rel=1e-4)
    assert gradient.norm().item() == pytest.approx(0.5, rel=1e-4)
    assert loss.log_alpha.grad.item() == pytest.approx(0.5, rel=1e-4)


@pytest.mark.parametrize(("iteration", "limit"), [(0, 0.3), (5, 0.15), (9, 0.03), (10, 0.006)])
def test_how_far_a_horizon_may_move_the_policy_falls_to_a_fiftieth(iteration, limit):
    adam = optimizer(10, AdaptiveOptimizer, max_kl=0.2)
    adam.anneal(iteration)
    assert adam.limit == pytest.approx(limit)


@pytest.mark.parametrize(("moved", "factor", "end"), [(0.31, 1 / 1.5, 1e-6), (0.2, 1.0, 1e-3), (0.13, 1.5, 0.02)])
def test_the_rate_adapts_to_how_far_the_policy_was_moved_within_its_bounds(moved, factor, end):
    adam = optimizer(10, AdaptiveOptimizer, max_kl=0.2, lr=1e-3)
    adam.anneal(0)
    adam.adapt(moved)
    assert adam.param_groups[0]["lr"] == pytest.approx(1e-3 * factor)
    for _ in range(60):
        adam.adapt(moved)
    assert adam.param_groups[0]["lr"] == pytest.approx(end)
    with pytest.raises(ValueError, match="actor.max_kl=null: this recipe sets its rate by it. Write a number"):
        optimizer(10, AdaptiveOptimizer, max_kl=None)


def test_minibatches_are_random_steps_or_each_once_in_an_epoch_and_horizons_of_a_policy_with_a_memory_stay_whole():
    cfg = OmegaConf.create({"updates": 3, "batch_size": 50})
    batches = [batch["step"] for batch in minibatches(numbered(3, 4), cfg)]
    assert [batch.shape for batch in batches] == [(50,)] * 3
    assert len(list(minibatches(numbered(3, 4), cfg, 2.5))) == 8  # times as many
    assert set(torch.cat(batches).tolist()) == set(range(12)) and not torch.equal(batches[0], batches[1])
    batches = [batch["step"] for batch in shuffled(numbered(3, 4), 5, 2)]
    assert [len(batch) for batch in batches] == [5, 5, 2, 5, 5, 2]
    epochs = [torch.cat(batches[:3]).tolist(), torch.cat(batches[3:]).tolist()]
    assert epochs[0] != epochs[1] and [sorted(epoch) for epoch in epochs] == [list(range(12))] * 2
    rollout = numbered(3, 4)
    rollout["is_init"] = torch.zeros(3, 4, 1, dtype=torch.bool)
    batches = [batch["step"] for batch in shuffled(rollout, 8, 2)]
    assert [batch.shape for batch in batches] == [(2, 4), (1, 4)] * 2
    for epoch in (batches[:2], batches[2:]):
        assert sorted(torch.cat(epoch).tolist()) == rollout["step"].tolist()
    assert [batch.shape for batch in shuffled(rollout, 3, 1)] == [(1, 4)] * 3


NUM_ENVS, HORIZON = 4, 5
FRAMES = NUM_ENVS * HORIZON


def make(transformed=False, **options):
    torch.manual_seed(0)
    env = HoveringEnv(num_envs=NUM_ENVS, seed=1, wind={"gust": 0.5}, max_episode_steps=7)
    env = TransformedEnv(env, CatFrames(3, -1, ["observation"])) if transformed else env
    return DifferentiableCollector(env, make_actor(env), frames_per_batch=FRAMES, **options)


@pytest.mark.parametrize("transformed", [False, True])
def test_batches_have_their_graph_and_begin_where_the_one_before_has_ended(transformed):
    collector, same = make(transformed, total_frames=50), make(transformed)
    torch.manual_seed(3)
    batches = list(collector)
    torch.manual_seed(3)
    carry = None
    for batch in batches:
        expected, carry = differentiable_rollout(same.env, same.policy, carry, HORIZON)
        torch.testing.assert_close(batch["next", "reward"], expected["next", "reward"], rtol=0, atol=0)
        assert batch["next", "reward"].requires_grad
    assert not any(x.requires_grad for x in collector.carry.values(True, True))
    assert len(batches) == len(collector) == 3  # the batch that reaches total_frames is the last
    assert batches[1]["next", "done"].any()  # through the ends of episodes


def test_a_share_of_the_environments_begins_each_batch_afresh():
    collector = make(total_frames=2 * FRAMES, restart_fraction=1.0)
    assert [batch["state", "step"][:, 0].sum().item() for batch in collector] == [0, 0]


@pytest.mark.parametrize("transformed", [False, True])
def test_a_state_dict_goes_on_bit_for_bit_also_through_a_file(tmp_path, transformed):
    straight, first, second = (make(transformed) for _ in range(3))
    torch.manual_seed(5)
    batches = [straight.next() for _ in range(3)]
    torch.manual_seed(5)
    first.next()
    torch.save(first.state_dict(), tmp_path / "collector.pt")
    with torch.no_grad():
        next(second.policy.parameters()).add_(1.0)
    second.load_state_dict(torch.load(tmp_path / "collector.pt", weights_only=True))
    for batch in batches[1:]:
        assert_equal(batch.detach().to_dict(), second.next().detach().to_dict())


def trainer(collector, folder):
    loss = BPTTLoss(collector.policy).make_value_estimator(gamma=0.99)
    adam = torch.optim.Adam(collector.policy.parameters(), 1e-2)
    options = {"frame_skip": 1, "optim_steps_per_batch": 1, "progress_bar": False, "seed": 3}
    options |= {"total_frames": 4 * FRAMES, "checkpoint": Checkpoint(), "save_trainer_file": folder}
    options["optimization_stepper"] = DefaultOptimizationStepper()
    trainer = Trainer(collector=collector, loss_module=loss, optimizer=adam, **options)
    UpdateWeights(collector).register(trainer)
    return trainer


def test_the_trainer_follows_the_gradient_through_the_dynamics_and_goes_on_from_its_checkpoint(tmp_path):
    straight, stopped = make(total_frames=4 * FRAMES), make(total_frames=2 * FRAMES)
    before = torch.nn.utils.parameters_to_vector(straight.policy.parameters()).clone()
    trainer(straight, tmp_path / "straight").train()
    after = torch.nn.utils.parameters_to_vector(straight.policy.parameters())
    assert (after - before).abs().max() > 1e-2 and straight.env.is_closed

    half = trainer(stopped, tmp_path / "stopped")
    half.train()
    half.save_trainer(force_save=True)
    random = torch.get_rng_state()
    resumed = make(total_frames=4 * FRAMES)
    again = trainer(resumed, tmp_path / "stopped").load_from_file(tmp_path / "stopped")
    torch.set_rng_state(random)
    again.train()
    torch.testing.assert_close(torch.nn.utils.parameters_to_vector(resumed.policy.parameters()), after, rtol=0, atol=0)


def test_weights_are_copied_from_whatever_form_torchrl_hands_over():
    other = make().policy
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.uniform_()
    forms = [{"policy_or_weights": other}, {"policy": other}, {"weights_dict": {"policy": other}}]
    for form in (*forms, {"policy_or_weights": other.state_dict()}):
        collector = make()
        before = [parameter.detach().clone() for parameter in collector.policy.parameters()]
        collector.update_policy_weights_()  # without any there is nothing to do
        assert all(torch.equal(*pair) for pair in zip(collector.policy.parameters(), before, strict=True))
        collector.update_policy_weights_(**form)
        for ours, theirs in zip(collector.policy.parameters(), other.parameters(), strict=True):
            assert torch.equal(ours, theirs) and ours is not theirs


def test_wrong_numbers_are_refused_with_what_to_write_instead():
    env = HoveringEnv(num_envs=NUM_ENVS)
    with pytest.raises(ValueError, match="frames_per_batch=10 must be a multiple of .* 4. Try 8, a horizon of 2"):
        DifferentiableCollector(env, make_actor(env), frames_per_batch=10)
    with pytest.raises(ValueError, match="restart_fraction must be at most 1, got 2"):
        DifferentiableCollector(env, make_actor(env), frames_per_batch=8, restart_fraction=2)
    for no_env in (nn.Linear(3, 4), lambda: None, 3):
        with pytest.raises(TypeError, match="env must be a TorchRL environment, such as make_env.*; got "):
            DifferentiableCollector(no_env, make_actor(env), frames_per_batch=8)
