"""Networks that read their sizes from the environment, and exploration noise that is correlated in time."""

import pytest
import torch
from helpers import cases, on_plain_tensors, refuses
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import CatTensors, PendulumEnv, StepCounter, TransformedEnv, UnsqueezeTransform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad import ABPTLoss, HoveringEnv, differentiable_rollout, load_drone, make_actor, make_qvalue, make_value
from torchrl_quad.objectives.calls import sample_action

nan = float("nan")


def make_pendulum():
    """An environment whose action, a torque, lies between -2 and 2."""
    angles = ["th", "thdot"]
    pendulum = TransformedEnv(PendulumEnv(), UnsqueezeTransform(dim=-1, in_keys=angles, in_keys_inv=angles))
    return pendulum.append_transform(CatTensors(angles, "observation", del_keys=False))


@pytest.mark.parametrize("wrap", [False, True])
def test_a_policy_starts_close_to_hovering_with_a_little_noise(wrap):
    env = HoveringEnv(num_envs=500)
    actor = make_actor(TransformedEnv(env, StepCounter()) if wrap else env, scale_init=0.1)
    td = env.reset()
    torch.testing.assert_close(actor(td.copy())["action"], env.hover_action.expand(500, 4), atol=0.02, rtol=0)
    with set_exploration_type(ExplorationType.RANDOM):
        noise = actor(td)["action"] - env.hover_action
    assert noise.std(0).tolist() == pytest.approx([0.09, 0.1, 0.1, 0.1], abs=0.02)


def test_the_first_action_can_be_chosen_and_is_the_middle_of_the_range_or_the_mean_of_hovering_elsewhere():
    env = HoveringEnv(num_envs=2, dtype=torch.float64)
    wanted = torch.tensor([0.5, -0.5, 0.0, 0.9], dtype=torch.float64)
    actor = make_actor(env, action_init=wanted)
    torch.testing.assert_close(actor(env.reset())["action"], wanted.expand(2, 4), atol=0.02, rtol=0)
    pendulum = make_pendulum()
    action = make_actor(pendulum)(pendulum.reset())["action"]
    assert action.shape == (1,) and action.abs() < 0.1
    pendulum.base_env.neutral_action = torch.tensor([1.5])
    assert make_actor(pendulum)(pendulum.reset())["action"].item() == pytest.approx(1.5, abs=0.1)
    env = HoveringEnv(num_envs=2, drone=load_drone("visfly").replace(max_thrust_to_weight=[[2.0], [4.0]]))
    assert env.hover_action[:, 0].tolist() == pytest.approx([0.0, -0.5])
    assert make_actor(env)(env.reset())["action"][:, 0].tolist() == pytest.approx([-0.25, -0.25], abs=0.03)


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_an_action_with_bounds_of_its_own_is_a_tanh_gaussian_between_them(rho):
    actor = make_actor(make_pendulum(), return_log_prob=True, scale_init=0.3, noise_correlation=rho)
    td = TensorDict({"observation": torch.randn(5, 2)}, [5])
    written, plain, drawn = on_plain_tensors(actor, td)
    pure = plain.forward(plain.weights, [td["observation"]], drawn)[1]
    assert {"loc", "scale", "action", "action_log_prob"} <= set(pure)
    torch.testing.assert_close({key: written[key] for key in pure}, pure)
    torch.testing.assert_close(plain.drawn_again(written), drawn, rtol=0, atol=1e-5)

    loc, scale, action = (written[key].double() for key in ("loc", "scale", "action"))
    x = (action / 2).atanh()  # the normal variable
    torch.testing.assert_close(x, loc + scale * drawn[:, :1].double(), rtol=0, atol=1e-5)
    density = torch.distributions.Normal(loc, scale).log_prob(x) - (2 * (1 - (action / 2) ** 2)).log()
    torch.testing.assert_close(written["action_log_prob"].double(), density.sum(-1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_a_saturated_policy_has_a_likely_action_and_a_gradient_of_usual_size(rho):
    actor = make_actor(make_pendulum(), return_log_prob=True, scale_init=0.1, noise_correlation=rho)
    last = actor[0].module.mlp[-1]
    with torch.no_grad():
        last.bias[0] = 1600.0  # as in a run of PPO that went on to push where nothing changes any more
    td = TensorDict({"observation": torch.randn(500, 2)}, [500])
    with set_exploration_type(ExplorationType.RANDOM):
        td = actor(td)
    assert td["action"].min() > 1.9996
    log_prob = actor.get_dist(td).log_prob(td["action"])
    torch.testing.assert_close(log_prob, td["action_log_prob"], rtol=0, atol=1e-2)
    assert log_prob.min() > 0.0  # the density in a range of 2e-4
    (grad,) = torch.autograd.grad(log_prob.mean(), last.bias)
    assert grad.abs().max() < 10.0


def test_each_entry_may_have_a_scale_of_its_own():
    env = HoveringEnv(num_envs=3)
    keys = ["observation", ("state", "rotor_speed")]
    td = make_actor(env)(env.reset())
    for make, extra in ((make_actor, 0), (make_value, 0), (make_qvalue, 1)):
        net = make(env, in_keys=keys, input_scale=(1.0, 1e-3))
        seen = []
        mlp = next(m for m in net.modules() if hasattr(m, "mlp")).mlp
        mlp.register_forward_pre_hook(lambda _, x, seen=seen: seen.append(x[0]))
        net(td.clone())
        entries = torch.cat((td["observation"], 1e-3 * td["state", "rotor_speed"]), -1)
        torch.testing.assert_close(seen[0][:, : entries.shape[1]], entries)
        assert seen[0].shape[1] == entries.shape[1] + 4 * extra
        with pytest.raises(ValueError, match="input_scale must be a number, or one for each of the 2 in_keys"):
            make(env, in_keys=keys, input_scale=(1.0, 1.0, 1.0))


def test_every_network_has_the_precision_of_the_environment_and_may_read_whole_numbers(env64):
    td = make_actor(env64)(env64.reset())
    whole = make_value(env64, in_keys=[("state", "step"), "success", "observation"])
    values = [(network, "state_value") for network in (make_value(env64), whole)]
    for network, key in (*values, (make_qvalue(env64), "state_action_value")):
        assert network(td)[key].dtype is torch.float64 and network(td)[key].shape == (4, 1)


@pytest.mark.parametrize("make", [make_actor, make_value, make_qvalue])
@cases(
    ({"num_cells": (0,)}, r"num_cells\[0\] must be at least 1, got 0. .*in a list: \[64, 64\]"),
    ({"num_cells": 64}, r"num_cells must be a list, got 64. .*in a list: \[64, 64\]"),
    ({"num_cells": [65_536] * 3}, "has 8,59.,...,... weights, more than 100,000,000: write smaller widths"),
    ({"input_scale": nan}, "input_scale must be a finite number or be a list, got nan"),
    ({"activation": "relu"}, "activation must be a class of activations of torch.nn without arguments, .*'relu'"),
    ({"activation": torch.nn.GLU}, "activation must be a class of activations"),
    ({"in_keys": "observation"}, "in_keys must be a list, got 'observation'"),
    ({"in_keys": []}, "in_keys must have at least 1 item"),
    ({"in_keys": [("state", "speed")]}, r"Unknown entry \('state', 'speed'\) in in_keys. Choose from: obs"),
    ({"in_keys": [("state", "action_queue")]}, r"has shape \(4, 1, 4\) and a network reads vectors: flatten it"),
)
def test_a_network_of_wrong_sizes_or_entries_is_refused(kwargs, message, env, make):
    refuses(message, make, env, **kwargs)


@cases(
    ({"in_keys": "obs"}, r"in_keys must be a list, got 'obs'. .*in a list: .\"observation\"."),
    ({"in_keys": [3]}, r"in_keys\[0\] must be the name of an entry, such as .*, got 3"),
    ({"action_init": [0.0, 0.0, 0.0]}, "action_init must be 4 numbers strictly between"),
    ({"action_init": [1.0, 0.0, 0.0, 0.0]}, r"strictly between .* got \[1.0, 0.0, 0.0, 0.0\]"),
    ({"action_init": ["a", 0.0, 0.0, 0.0]}, r"strictly between .* got \['a', 0.0, 0.0, 0.0\]"),
    ({"scale_init": 1e300}, "scale_init must be at most 100, got 1e.300"),
    ({"scale_init": 0.0}, "scale_init must be at least 0.0001, got 0.0. The standard deviation of the policy"),
    ({"noise_correlation": -0.1}, "noise_correlation must be at least 0, got -0.1"),
    ({"noise_correlation": 1.0}, "noise_correlation must be less than 1, got 1.0"),
)
def test_a_first_action_out_of_bounds_and_a_wrong_list_of_entries_are_refused(kwargs, message, env):
    refuses(message, make_actor, env, **kwargs)
    pendulum = PendulumEnv()
    pendulum.action_spec = Unbounded(pendulum.action_spec.shape)
    refuses("make_actor needs an action with bounds, a Bounded spec; got Unbounded", make_actor, pendulum)


RHO = 0.9


def test_the_noise_is_standard_normal_in_every_step_and_correlated_over_time():
    env = HoveringEnv(num_envs=512, max_episode_steps=90)
    actor = make_actor(env, noise_correlation=RHO, scale_init=0.2)
    start = env.reset()
    start["state", "step"][::2] = 30  # these end with the horizon
    rollout, carry = differentiable_rollout(env, actor, env.reset(start, set_state=True), 60)
    noise = rollout["noise"].double()
    assert noise.mean().abs() < 0.05  # four standard errors, as below
    for part in (noise[:, 0], noise[:, 30], noise[:, -1]):
        assert part.std() == pytest.approx(1.0, abs=0.06)
    for lag in (1, 5, 20):
        assert (noise[:, lag:] * noise[:, :-lag]).mean().item() == pytest.approx(RHO**lag, abs=0.06)
    mean = torch.atanh(rollout["action"]) - 0.2 * rollout["noise"]  # mu + sigma e, with mu nearly constant at the start
    assert mean.std(1).max() < 0.1
    more, _ = differentiable_rollout(env, actor, carry, 3)
    assert torch.equal(more["noise_before"][:, 0], rollout["noise"][:, -1])  # also over resets
    assert 0 < rollout["next", "done"][:, -1].sum() < 512


@pytest.mark.parametrize("bias", [0.3, 10.0])  # and far beyond where the tanh tells numbers apart
def test_called_or_not_the_noise_is_the_same_also_where_the_action_is_saturated(env64, bias):
    actor = make_actor(env64, noise_correlation=RHO, scale_init=0.3, return_log_prob=True)
    actor[0].module.mlp[-1].bias.data[:4] = bias
    td = env64.reset()
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        written, plain, drawn = on_plain_tensors(actor, td, kind)
        mine = plain.forward(plain.weights, [td["observation"]], drawn)[1]
        torch.testing.assert_close({key: written[key] for key in mine}, mine)
        torch.testing.assert_close(plain.drawn_again(written), drawn)
        assert written["noise"].abs().max() < 5 and written["noise"].any() == (kind is ExplorationType.RANDOM)
    with set_exploration_type(ExplorationType.DETERMINISTIC):  # also after a random flight
        again = actor(td.copy().set("noise", torch.ones(4, 4, dtype=env64.dtype)))
    torch.testing.assert_close(again["action"], written["action"])


def test_an_actor_can_be_called_with_its_entries(env):
    td = env.reset()
    for rho, before in ((0.0, {}), (RHO, {"noise_before": torch.zeros(4, 4)})):
        actor = make_actor(env, noise_correlation=rho)
        assert ("noise" in actor.out_keys) == bool(rho)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = actor(observation=td["observation"], **before)
            torch.testing.assert_close(written[2], actor(td.copy())["action"])


def test_a_new_action_at_the_end_of_a_horizon_has_the_noise_of_the_policy_itself():
    env = HoveringEnv(num_envs=2000)
    actor = make_actor(env, noise_correlation=RHO, scale_init=0.3)
    loss = ABPTLoss(actor, make_qvalue(env))
    rollout, _ = differentiable_rollout(env, actor, None, 2)
    assert loss(rollout)["loss_actor"].isfinite()
    states = rollout[:, 0].select("observation")
    action = sample_action(actor, loss.actor_network_params, states)["action"].detach()
    assert torch.atanh(action).std(0).mean() == pytest.approx(0.3, rel=0.05)


@cases((0.1, 0.01), (0.03, 0.003))
def test_training_cannot_bring_the_noise_below_a_bound(scale_init, least):
    env = HoveringEnv(num_envs=2)
    actor = make_actor(env, scale_init=scale_init)
    assert actor(env.reset())["scale"][0].tolist() == pytest.approx(4 * [scale_init], rel=0.05)
    with torch.no_grad():
        list(actor.parameters())[-1][4:] = -100.0
    assert actor(env.reset())["scale"][0].tolist() == pytest.approx(4 * [least], rel=1e-4)


@pytest.mark.parametrize("options", [{}, {"noise_correlation": 0.9}, {"recurrent": True}])
def test_a_policy_draws_a_share_of_its_noise_in_flights_and_calls(options):
    env = HoveringEnv(num_envs=4000)
    actor = make_actor(env, scale_init=0.1, learn_scale=False, **options)
    start, wide = differentiable_rollout(env, actor, None, 1)[0][:, 0], []
    for share in (1.0, 0.25):
        actor.scale_noise(share)
        with torch.random.fork_rng(), set_exploration_type(ExplorationType.RANDOM):
            called = actor(start.exclude("noise"))
        flown = differentiable_rollout(env, actor, start.exclude("noise"), 1)[0][:, 0]
        torch.testing.assert_close(called["action"], flown["action"])
        wide.append((flown["action"].atanh() - flown["loc"]).std().item())
    assert wide[1] == pytest.approx(0.25 * wide[0], rel=0.05)
