"""Losses as LossModules: their keys, what they refuse, their checkpoints, and environments that are no quadrotors."""

import inspect
import re
import textwrap

import pytest
import torch
from helpers import cases, refuses
from tensordict.nn import TensorDictModule, TensorDictSequential
from test_objectives import GAMMA, make_networks, make_rollout
from torch import nn
from torchrl.envs import PendulumEnv
from torchrl.modules import MLP, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss, SoftUpdate, ValueEstimators
from torchrl.objectives.value import GAE

from torchrl_quad import HoveringEnv, RacingEnv, VisitedStateBuffer, differentiable_rollout
from torchrl_quad.errors import UserError
from torchrl_quad.modules import make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, PODSLoss, SAPOLoss, SHACLoss
from torchrl_quad.objectives.ppo import PlainClipPPOLoss


@pytest.fixture
def flight(env):
    return differentiable_rollout(env, make_actor(env), None, 3)


def losses(env):
    actor = make_actor(env)
    return [BPTTLoss(actor), SHACLoss(actor, make_value(env)), ABPTLoss(actor, make_qvalue(env))]


@pytest.mark.parametrize("entropy", [0.0, 0.1, "auto"])
def test_in_keys_suffice_and_out_keys_come_out(entropy):
    env = HoveringEnv(num_envs=2)
    actor = make_actor(env, return_log_prob=True)
    for loss in (
        BPTTLoss(actor, alpha=entropy),
        SHACLoss(actor, make_value(env), alpha=entropy),
        ABPTLoss(actor, make_qvalue(env), alpha=entropy),
        ABPTLoss(actor, make_qvalue(env), alpha=entropy, zero_step_return=False),
        AHACLoss(actor, make_value(env), alpha=entropy, clip_action_gradient=2.0),
        *([SAPOLoss(actor, make_value(env), alpha=entropy)] if entropy else []),
    ):
        rollout, _ = differentiable_rollout(env, actor, None, 3)
        out = loss(rollout.select(*loss.in_keys))
        assert set(out.keys()) == set(loss.out_keys)
        assert all(value.shape == () and value.isfinite() for value in out.values())
        assert ("loss_alpha" in loss.out_keys) == (entropy == "auto")
        sum(value for key, value in out.items() if key.startswith("loss_")).backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in loss.parameters() if p.requires_grad)
        loss.zero_grad()


def masked(rollout, counts):
    """A rollout in which a collector hides some steps, whose rewards mean nothing."""
    hidden = rollout.copy()
    hidden["next"] = rollout["next"].copy()
    hidden["collector", "mask"] = counts
    hidden["next", "reward"] = torch.where(counts.unsqueeze(-1), rollout["next", "reward"], torch.nan)
    return hidden


def seeded(loss, rollout):
    torch.manual_seed(1)
    return loss(rollout)


def test_steps_that_a_collector_masks_do_not_count(env64):
    # TorchRL asks the same of its losses in test_loss_module.py.
    actor = make_actor(env64, return_log_prob=True)
    value, qvalue = make_value(env64), make_qvalue(env64)
    rollout, _ = differentiable_rollout(env64, actor, None, 6)
    counts = torch.ones(4, 6, dtype=torch.bool)
    every = masked(rollout, counts)
    abpt = ABPTLoss(actor, qvalue), ABPTLoss(actor, qvalue, simulated_steps=2)
    for loss in (BPTTLoss(actor, alpha=0.1), SHACLoss(actor, value), *abpt, SAPOLoss(actor, value, alpha=0.1)):
        hidden = masked(rollout, counts & (torch.arange(4) > 0).unsqueeze(1))
        out, without = (seeded(loss, flight) for flight in (hidden, rollout[1:]))
        torch.testing.assert_close(4 * out["loss_actor"], 3 * without["loss_actor"])
        torch.testing.assert_close(seeded(loss, every)["loss_actor"], seeded(loss, rollout)["loss_actor"])
        if "loss_value" in out:
            torch.testing.assert_close(out["loss_value"], without["loss_value"])
    for loss in (AHACLoss(actor, value), HybridLoss(actor, value)):
        out = loss(masked(rollout, counts & (torch.arange(4) > 0).unsqueeze(1)))
        assert all(x.isfinite() for x in out.values())
        assert not torch.equal(out["loss_actor"], loss(rollout)["loss_actor"])
    cut = masked(rollout, counts & (torch.arange(6) < 3))
    torch.testing.assert_close(BPTTLoss(actor)(cut)["loss_actor"], BPTTLoss(actor)(rollout[:, :3])["loss_actor"])
    pods = PODSLoss(actor)
    flight = pods.write_action_target(cut).detach()
    changed = flight["action_target"] != flight["action"]
    assert changed[:, 0].any() and not changed[:, 3:].any()
    for x in actor.parameters():  # from which the policy moves away
        x.data += 0.1
    for name, x in pods(flight).items():
        torch.testing.assert_close(x, pods(flight[:, :3])[name])


def test_keys_can_be_renamed():
    actor, value, _ = make_networks()
    loss = SHACLoss(actor, value).make_value_estimator(gamma=GAMMA)
    loss.set_keys(reward="gain", terminated="crashed", done="over", value_target="goal")
    assert ("next", "gain") in loss.in_keys and ("next", "reward") not in loss.in_keys
    rollout = make_rollout(actor)
    expected = SHACLoss(actor, value).make_value_estimator(gamma=GAMMA)(rollout)
    for old, new in (("reward", "gain"), ("terminated", "crashed"), ("done", "over")):
        rollout.rename_key_(("next", old), ("next", new))
    result = loss(rollout)
    assert result["loss_actor"] == expected["loss_actor"] and result["loss_value"] == expected["loss_value"]
    assert "goal" in loss.write_value_target(rollout)


def test_a_loss_goes_on_from_a_checkpoint_with_its_discounts():
    def make(critic):
        actor, value, qvalue = make_networks(critic=critic)
        return nn.ModuleDict({"bptt": BPTTLoss(actor), "shac": SHACLoss(actor, value), "abpt": ABPTLoss(actor, qvalue)})

    saved, loaded = make(10.0), make(3.0)
    for loss, kind in zip(saved.values(), (None, "TD0", None), strict=True):
        loss.make_value_estimator(kind, gamma=0.5)
    loaded.load_state_dict(saved.state_dict())
    before, after = ({key: x.tolist() for key, x in each.state_dict().items()} for each in (saved, loaded))
    assert before == after
    assert [loss.value_estimator.gamma.item() for loss in loaded.values()] == [0.5] * 3
    kinds = ValueEstimators.TD1, ValueEstimators.TD0, ValueEstimators.TDLambda
    assert tuple(loss.value_type for loss in loaded.values()) == kinds


def test_the_running_median_of_the_clip_has_the_precision_of_the_actor(env64):
    loss, other = (BPTTLoss(make_actor(env64), clip_action_gradient=2.0) for _ in range(2))
    loss(differentiable_rollout(env64, loss.actor_network, None, 3)[0])
    other.load_state_dict(loss.state_dict())
    assert other.clip.median == loss.clip.median and other.clip.median.dtype == torch.float64


@pytest.mark.parametrize("loss", [ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, SAPOLoss, SHACLoss])
def test_the_example_of_a_loss_is_short_and_runs(loss):
    (block,) = re.findall(r"code-block:: python\n\n((?: {4}.*\n|\n)+)", inspect.getdoc(loss) + "\n")
    program = textwrap.dedent(block).strip()
    assert len(program.splitlines()) < 12
    names = {}
    exec(program, names)
    assert all(p.grad.isfinite().all() and p.grad.any() for p in names["loss"].actor_network_params.parameters())


@cases(
    (ABPTLoss, {"alpha": -1.0}, "alpha must be at least 0 or be 'auto', got -1.0. The coefficient of the entropy"),
    (ABPTLoss, {"alpha": float("inf")}, "alpha must be a finite number or be 'auto', got inf"),
    (ABPTLoss, {"alpha_init": 0.0}, "alpha_init must be greater than 0, got 0.0. What alpha=auto starts"),
    (ABPTLoss, {"reduction": "median"}, "reduction must be 'mean', 'sum' or 'none', got 'median'"),
    (ABPTLoss, {"n_step_return": False, "zero_step_return": False}, "with both off there is no objective"),
    (ABPTLoss, {"zero_step_return": False, "simulated_steps": 3}, "simulated_steps belong to the 0-step return"),
    (ABPTLoss, {"n_step_return": "abc"}, "n_step_return must be true or false, got 'abc'. Whether J includes J_N"),
    (ABPTLoss, {"num_qvalue_nets": 0}, "num_qvalue_nets must be at least 1, got 0. The critics made from it"),
    (ABPTLoss, {"simulated_steps": -1}, "simulated_steps must be at least 0, got -1. Simulated control steps"),
    (SAPOLoss, {"alpha": 0.0}, "alpha must be greater than 0 or be 'auto', got 0.0. .* without .* take SHACLoss"),
    (SAPOLoss, {"target_entropy": 1.0}, "must be at most -0.001 or be 'auto', got 1.0. .* a negative number"),
    (SAPOLoss, {"num_value_nets": 0}, "num_value_nets must be at least 1, got 0"),
    (SAPOLoss, {"delay_value": True}, "SAPOLoss sets delay_value itself: leave it out, or take SHACLoss"),
    (AHACLoss, {"horizon": 4, "min_horizon": 8}, "horizon=4 must lie between min_horizon=8 and max_horizon=8"),
    (AHACLoss, {"horizon": 0}, "horizon must be at least 1, got 0. Control steps of the first rollout"),
    (AHACLoss, {"max_stiffness": 1.0}, "max_stiffness must be greater than 1, got 1.0. .*1.5 to 5 are usual"),
    (AHACLoss, {"gradient_lmbda": 0.9, "terminal_gradient": False}, "terminal_gradient=False cuts: leave one of them"),
    (AHACLoss, {"horizon_lr": 1.0}, "horizon_lr must be less than 1, got 1.0"),
    (SHACLoss, {"target_bootstrap": True, "terminal_gradient": False}, "would change nothing. Leave one of them out"),
    (HybridLoss, {"gradient_lmbda": 0.0}, "gradient_lmbda must be greater than 0"),
    (HybridLoss, {"clip_epsilon": 1.0}, "clip_epsilon must be less than 1"),
    (HybridLoss, {"entropy_coeff": -0.1}, "entropy_coeff must be at least 0"),
    (HybridLoss, {"decay": 1.0}, "decay must be less than 1"),
)
def test_bad_arguments_say_what_is_allowed(cls, options, message):
    actor, value, qvalue = make_networks()
    refuses(message, cls, actor, qvalue if cls is ABPTLoss else value, error=UserError, **options)


@cases(
    (lambda _, shac: shac.make_value_estimator(gamma=2.0), "gamma must be at most 1, got 2.0"),
    (lambda _, shac: shac.make_value_estimator(lmbda=-0.1), "lmbda must be at least 0, got -0.1"),
    (lambda bptt, _: bptt.make_value_estimator(lmbda=0.9), "BPTTLoss estimates .* TD1: .*argument 'lmbda'"),
    (lambda _, shac: shac.make_value_estimator(lambda_=0.9), "by TDLambda: .*argument 'lambda_'"),
    (lambda _, shac: shac.make_value_estimator("abc"), "not implemented for loss SHACLoss. Choose from: td0"),
    (lambda _, shac: shac.set_keys(value_target=5), "value_target must be the name of an entry, .*, got 5"),
    (lambda _, shac: shac.set_keys(rewards="gain"), "SHACLoss reads no 'rewards'. Choose from: "),
    (lambda bptt, _: setattr(PODSLoss(bptt.actor_network), "alpha", 0.1), "PODSLoss has no entropy bonus: leave alpha"),
    (lambda *_: setattr(HybridLoss(*make_networks()[:2]), "alpha", 0.1), "HybridLoss .*: set entropy_coeff"),
    (lambda *_: BPTTLoss(nn.Linear(13, 4)), "actor_network must be a TensorDictModule, got Linear. Wrap a plain"),
    (lambda bptt, _: SHACLoss(bptt.actor_network, nn.Linear(1, 1)), "value_network must be .*, got Linear"),
    (lambda bptt, _: bptt((1, 2)), "BPTTLoss needs a rollout, the tensordict that .* returns; got tuple"),
)
def test_losses_and_estimators_take_what_fits_alone(call, message):
    actor, value, _ = make_networks()
    refuses(message, call, BPTTLoss(actor), SHACLoss(actor, value), error=UserError)


def test_a_rollout_without_its_graph_is_refused_with_advice():
    actor, value, qvalue = make_networks()
    detached = make_rollout(actor).detach()
    abpt = ABPTLoss(actor, qvalue), ABPTLoss(actor, qvalue, n_step_return=False)
    for loss in (BPTTLoss(actor), SHACLoss(actor, value), *abpt):
        refuses("carries no gradient.*Use differentiable_rollout", loss.loss_actor, detached, error=RuntimeError)
        with torch.no_grad():
            loss.loss_actor(detached)
    with pytest.raises(RuntimeError, match="Build the actor with return_log_prob=True"):
        BPTTLoss(actor, alpha=0.1).loss_actor(make_rollout(actor))


def test_a_rollout_without_a_time_dimension_is_refused(env, flight):
    rollout, carry = flight
    message = r"{} needs a rollout of batch size \(\*, horizon\), whose last .* is time; got \({}.*Give it what diff"
    wrong = [(rollout[:, 0], "4,"), (rollout.reshape(-1), "12,"), (rollout[:, :0], "4, 0"), (carry, "4,")]
    for loss in losses(env):
        for data, shape in (*wrong, (rollout.transpose(0, 1), "3, 4")):
            refuses(message.format(type(loss).__name__, shape), loss, data)
        loss(rollout[0])  # a single flight, whose dimension has the name of time


@pytest.mark.parametrize(
    "key", ["action", "next", *(("next", key) for key in ("reward", "done", "terminated", "observation"))]
)
def test_a_rollout_that_lacks_an_entry_is_refused(env, flight, key):
    for loss in losses(env):
        if key in loss.in_keys or key == "next":
            named = "reads .*'next'" if key == "next" else f"reads {key!r}".replace("(", r"\(").replace(")", r"\)")
            refuses(f"{type(loss).__name__} {named}.*not in the rollout.*set_keys", loss, flight[0].exclude(key))


def test_an_entry_of_another_shape_a_wrong_tensor_key_and_a_rollout_on_another_device_are_refused(env, flight):
    for loss in losses(env):
        for key in ("reward", "done", "terminated"):
            wrong = flight[0].copy()
            wrong["next"] = wrong["next"].copy().set(key, wrong["next", key].squeeze(-1))
            refuses(rf"'{key}'\) of shape \(4, 3, 1\) in this rollout; got \(4, 3\)", loss, wrong)
    with pytest.raises(ValueError, match=r"'value_target' has shape \(4, 3\), and the critic's pred.* \(4, 3, 1\)"):
        losses(env)[1](flight[0].copy().set("value_target", torch.zeros(4, 3)))
    for loss in losses(env):
        refuses("is on cpu, and the rollout on meta: loss.to.'meta'. moves it", loss, flight[0].to("meta"))
        loss.set_keys(reward="gain")
        refuses(r"reads \('next', 'gain'\), which is not in the rollout. If it has", loss, flight[0])


def test_swapped_networks_are_refused(env, flight):
    actor, value, qvalue = make_actor(env), make_value(env), make_qvalue(env)
    for loss, reads, writes in (
        (SHACLoss(actor, qvalue), "'state_value' of its value_network", "state_action_value"),
        (ABPTLoss(actor, value), "'state_action_value' of its qvalue_network", "state_value"),
        (SHACLoss(value, actor), "'state_value' of its value_network", "loc, scale, action"),
    ):
        refuses(f"reads {reads}, which writes {writes}. Give another network, or set", loss, flight[0])


def pendulum_networks(env):
    assert env.action_spec_unbatched.shape == (1,)
    angles, state = ["th", "thdot"], ["observation"]
    features = TensorDictModule(lambda th, thdot: torch.stack((th.cos(), th.sin(), thdot / 8), -1), angles, state)
    torque = TensorDictModule(lambda x: 2 * x.tanh(), ["raw"], ["action"])

    def network(in_keys, inputs, out_key, *more):
        mlp = MLP(inputs, 1, num_cells=[32], activation_class=nn.Tanh)
        return TensorDictSequential(features, TensorDictModule(mlp, in_keys, [out_key]), *more)

    qvalue = network([*state, "action"], 4, "state_action_value")
    return network(state, 3, "raw", torque), network(state, 3, "state_value"), qvalue


@pytest.mark.parametrize("name", ["bptt", "shac", "abpt"])
def test_losses_train_the_pendulum_of_torchrl(name):
    env = PendulumEnv(seed=0)
    torch.manual_seed(0)
    actor, value, qvalue = pendulum_networks(env)
    cls, critics = {"bptt": (BPTTLoss, ()), "shac": (SHACLoss, (value,)), "abpt": (ABPTLoss, (qvalue,))}[name]
    loss = cls(actor, *critics)
    loss.make_value_estimator(gamma=0.95)
    updater = SoftUpdate(loss, tau=0.05) if name != "bptt" else None
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    buffer = VisitedStateBuffer(env=env)

    def fresh(n=32):
        return env.reset(env.gen_params(batch_size=[n]), set_state=False)

    def mean_reward():
        env.set_seed(1)
        with torch.no_grad():
            return differentiable_rollout(env, actor, fresh(), 60)[0]["next", "reward"].mean().item()

    before = mean_reward()
    for _ in range(40):
        rollout, _ = differentiable_rollout(env, actor, fresh(), 30)
        buffer.extend(rollout)
        out = loss(rollout)
        optimizer.zero_grad()
        sum(value for key, value in out.items() if key.startswith("loss_")).backward()
        optimizer.step()
        if updater:
            updater.step()
    assert len(buffer) == 40 * 32 * 30
    assert mean_reward() > before + 0.7  # from about -5.9 per step; the torque is too weak to swing up in one go


IN_KEYS = ["observation", ("state", "rotor_speed")]


def results(loss, rollout):
    """All that a loss computes of a rollout, its gradients, and the next random number; the graph is kept."""
    torch.manual_seed(1)
    out = loss(rollout)
    inputs = {"action": rollout["action"], "next": rollout["next", "observation"]}
    inputs |= dict(loss.named_parameters())
    losses = [value for key, value in out.items() if key.startswith("loss_")]
    pairs = [(f"{i}, {key}", value, x) for i, value in enumerate(losses) for key, x in inputs.items()]
    grads = {name: torch.autograd.grad(y, x, retain_graph=True, allow_unused=True)[0] for name, y, x in pairs}
    target = loss.write_value_target(rollout.copy())["value_target"]
    return {**dict(out.items()), **grads, "target": target}, torch.rand(1)


@pytest.mark.parametrize("name", ["shac", "abpt"])
def test_pure_functions_give_the_numbers_and_draw_the_random_numbers_of_the_networks(name):
    env = HoveringEnv(num_envs=3, max_episode_steps=4, random_start={"tilt": 0.5, "velocity": 1.0}, seed=0)
    make_critic, make = (make_value, SHACLoss) if name == "shac" else (make_qvalue, ABPTLoss)
    actor, critic = make_actor(env, return_log_prob=True), make_critic(env, in_keys=IN_KEYS, input_scale=(1.0, 1e-3))
    loss = make(actor, critic).make_value_estimator(gamma=0.9, lmbda=0.8)
    critic, calls = getattr(loss, loss.critic_name), []
    rollout, _ = differentiable_rollout(env, make_actor(env, return_log_prob=True), None, 6)
    loss.actor_network_params.data.apply_(lambda x: x.add_(0.1 * torch.randn_like(x)))
    assert critic.plain() is not None

    pure, after_pure = results(loss, rollout)
    for network in (critic, loss.actor_network):
        network.register_forward_hook(lambda network, *_: calls.append(network))
    called, after_called = results(loss, rollout)

    assert critic in calls and (loss.actor_network in calls) == (name == "abpt")
    assert after_pure == after_called
    assert {key for key, x in pure.items() if x is None} == {key for key, x in called.items() if x is None}
    assert sum(x is not None for x in pure.values()) >= 18
    for key, x in called.items():
        if x is not None:
            torch.testing.assert_close(pure[key], x, msg=lambda message, key=key: f"{key}: {message}")


class Doubled(nn.Module):
    """A critic of the user's own."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, *inputs):
        return 2.0 * self.network(*inputs)


@cases(
    (lambda critic: critic.register_forward_hook(lambda *arguments: None),),
    (lambda critic: critic.module.mlp[3].register_full_backward_hook(lambda *arguments: None),),
    (lambda critic: critic.module.mlp.__setitem__(2, nn.Dropout(0.5)),),
    (lambda critic: critic.module.mlp.__setitem__(2, nn.PReLU()),),
    (lambda critic: nn.utils.parametrizations.weight_norm(critic.module.mlp[0]),),
    (lambda critic: critic.module.mlp.__setitem__(5, critic.module.mlp[2]),),
    (lambda critic: setattr(critic.module, "head", nn.Softplus()),),
    (lambda critic: setattr(critic, "module", Doubled(critic.module)),),
    (lambda critic: setattr(critic, "__class__", type("Mine", (ValueOperator,), {})),),
    ids=["hook", "backward", "dropout", "parameters", "parametrization", "shared", "head", "module", "class"],
)
def test_a_critic_that_somebody_has_changed_is_called_as_it_is(change, env):
    critic = make_value(env)
    change(critic)
    assert not hasattr(critic, "plain") or critic.plain() is None
    loss = SHACLoss(make_actor(env), critic)
    rollout, _ = differentiable_rollout(env, make_actor(env), None, 3)
    torch.manual_seed(0)
    prediction = loss.loss_value(rollout)[1]["pred_value"]
    torch.manual_seed(0)
    loss.write_value_target(rollout)  # draws first
    torch.testing.assert_close(prediction, critic(rollout.detach())["state_value"].mean())
    loss(rollout)["loss_value"].backward()
    assert all(x.grad is not None for x in loss.value_network_params.parameters())


@cases(
    ({"entropy_coeff": 0.1, "max_importance_ratio": 1.2, "loss_critic_type": "l1"}, {"noise_correlation": 0.7}),
    ({"entropy_bonus": False, "normalize_advantage": True, "critic_coeff": 0.5}, {"scale_init": 0.5}),
    ({"loss_critic_type": "l2"}, {"recurrent": True}),
)
def test_ppo_by_functions_of_tensors_has_the_values_and_gradients_of_torchrls(options, policy):
    env = RacingEnv(num_envs=6, max_episode_steps=5, seed=0, dtype=torch.float64)
    actor, value = make_actor(env, (8,), return_log_prob=True, **policy), make_value(env, (8,))
    rollout = differentiable_rollout(env, actor, None, 12)[0].detach()
    with torch.no_grad():
        actor.last.mlp[-1].bias.add_(0.1)  # away from the policy that flew
    found = []
    for loss in (ClipPPOLoss(actor, value, **options), PlainClipPPOLoss(actor, value, **options)):
        is_plain = isinstance(loss, PlainClipPPOLoss)
        data = loss.write_values(rollout.copy()) if is_plain else rollout.copy()
        GAE(gamma=0.9, lmbda=0.8, value_network=None if is_plain else value, vectorized=False)(data)
        torch.manual_seed(0)
        with set_recurrent_mode(True):
            losses = loss(data if "recurrent" in policy else data.reshape(-1))
        objective = losses["loss_objective"] + losses.get("loss_entropy", 0.0)
        loss.zero_grad()
        (losses.get("loss_actor", objective) + losses["loss_critic"]).backward()
        measured = {name: x.detach().mean() for name, x in losses.items() if name != "loss_actor"}
        found.append([measured, [p.grad for p in loss.parameters()]])
    torch.testing.assert_close(*found)
    assert 0 < found[0][0]["clip_fraction"] < 1 and rollout["next", "done"].any()
