"""Policies that see and remember: gradients through their memory, where it begins anew, and which losses take them."""

import functools
import math

import pytest
import torch
from helpers import anew, refuses
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from torchrl.envs import Compose, EnvBase, ExplorationType, InitTracker, TransformedEnv, set_exploration_type
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss

from torchrl_quad import ForestEnv, HoveringEnv, TrustRegion, VisitedStateBuffer
from torchrl_quad.data import differentiable_rollout, flight_mode, restart
from torchrl_quad.modules import make_actor, make_qvalue, make_value, make_visual_actor
from torchrl_quad.objectives import ABPTLoss, AHACLoss, BPTTLoss, HybridLoss, SAPOLoss, SHACLoss

CAMERA = {"width": 6, "height": 4}
SMALL = {"channels": (2,), "num_cells": (5, 4), "hidden_size": 3}
MEMORY = "recurrent_state"
MODE = ExplorationType.DETERMINISTIC


def forest(**options):
    return ForestEnv(**{"num_envs": 3, "dtype": torch.float64, "camera": CAMERA, "density": 0.02, **options})


def actor_for(env, seed=0, **options):
    torch.manual_seed(seed)
    actor = make_visual_actor(env, **{**SMALL, **options})
    with torch.no_grad():
        for x in actor[0][-1].parameters():
            x.mul_(30.0)  # the head, which begins near zero: what is seen and remembered shall move the drone
    return actor


@pytest.mark.parametrize("noise_correlation", [0.0, 0.9])
def test_a_flight_is_that_of_torchrls_loop_with_its_transforms_and_forgets_where_episodes_begin(
    noise_correlation, monkeypatch
):
    monkeypatch.setattr("torchrl_quad.data.rollout.under_transforms", lambda *_: "")  # which would fly it inside, too
    env = forest(max_episode_steps=7)
    actor = actor_for(env, noise_correlation=noise_correlation)
    wrapped = TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))
    flights = []
    for flown in (env, wrapped):
        anew(env, 1)
        flight, carry = differentiable_rollout(flown, actor, None, 16)
        loss = flight["next", "reward"].sum() + flight["next", "observation"].square().sum() + flight["loc"].sum()
        flights.append((flight, carry, torch.autograd.grad(loss, list(actor.parameters()))))
    (quick, quick_carry, quick_grad), (slow, slow_carry, slow_grad) = flights
    assert quick["is_init"][:, [7, 14]].all() and quick["is_init"].sum() == 6
    if noise_correlation:  # it goes on where an episode begins
        torch.testing.assert_close(quick["noise"][:, :-1], quick["noise_before"][:, 1:])
        torch.testing.assert_close(quick["noise"], slow["noise"])
    for key in (MEMORY, "depth", "action", "loc", ("next", MEMORY), ("next", "reward"), ("next", "is_init")):
        own = torch.where(slow["is_init"].unsqueeze(-1), 0.0, slow[key]) if key == MEMORY else slow[key]
        torch.testing.assert_close(quick[key], own)
    torch.testing.assert_close(quick_grad, slow_grad)
    torch.testing.assert_close(quick_carry[MEMORY], slow_carry[MEMORY])
    # What was before an episode has no effect on what is remembered in it.
    memory = torch.zeros(3, 1, 3, dtype=torch.float64, requires_grad=True)
    flight, _ = differentiable_rollout(env, actor, env.reset().set(MEMORY, memory), 12)
    before, after = (torch.autograd.grad(x.sum(), memory, retain_graph=True)[0] for x in flight["loc"].split(7, 1))
    assert (before != 0).all() and (after == 0).all()


@pytest.mark.parametrize("way", ["inside", "called"])
@pytest.mark.parametrize("sees", [True, False])
def test_a_policy_in_a_compiled_horizon_sees_and_remembers_as_in_an_eager_flight(sees, way, monkeypatch):
    class Direct:  # what is compiled, without a compiler, which takes a minute
        def __init__(self, function, options):
            self.again = function

        def __call__(self, *inputs):
            return self.again(*inputs)

    monkeypatch.setattr("torchrl_quad.engine.program.Compiled", Direct)
    monkeypatch.setattr("torch.compiler.nested_compile_region", lambda function: function)
    env = forest(max_episode_steps=3, dt=0.01, control_dt=0.01)
    actor, results = actor_for(env) if sees else make_actor(env, (4, 6, 5), recurrent=True, hidden_size=5), []
    if way == "called":
        actor[0][0].register_forward_hook(lambda *_: None)
    for _ in range(2):
        _, carry = differentiable_rollout(anew(env, 1), actor, None, 2)
        flight, _ = differentiable_rollout(env, actor, carry, 4)
        loss = flight["next", "reward"].sum() + flight["next", "observation"].square().sum() + flight["loc"].sum()
        loss = loss + flight["next", MEMORY].square().sum() + flight[MEMORY].sum()
        results.append((dict(flight.items(True, True)), torch.autograd.grad(loss, list(actor.parameters()))))
        env._run({})
        env.disturbances["camera"].is_compiled = False
    assert flight_mode(env, actor).mode == way and results[0][0]["is_init"].any()
    torch.testing.assert_close(*results)


def test_memory_goes_on_where_a_horizon_does_and_is_kept_with_visited_states():
    env = forest(num_envs=32, density=0.0)
    actor = actor_for(env)
    flight, carry = differentiable_rollout(env, actor, None, 3)
    torch.testing.assert_close(carry[MEMORY], flight["next", MEMORY][:, -1].detach())
    begun = restart(env, carry, 0.5)
    again = begun["is_init"].squeeze(-1)
    assert 0 < again.sum() < 32 and (begun["state", "step"][again] == 0).all()
    more, _ = differentiable_rollout(env, actor, begun, 1)
    assert (more[MEMORY][again] == 0).all()
    torch.testing.assert_close(more[MEMORY][~again, 0], carry[MEMORY][~again])

    buffer = VisitedStateBuffer(env=env, actor=actor)
    buffer.extend(flight)
    start = buffer.initial_state(env, fraction=0.5)
    fresh = start["is_init"].squeeze(-1)
    assert (start[MEMORY][fresh] == 0).all() and (start["state", "step"][fresh] == 0).all() and 0 < fresh.sum() < 32
    visited = start[~fresh]
    step, place = visited["state", "step"].squeeze(-1), visited["state", "position"]
    drone = (flight["state", "position"][:, step].transpose(0, 1) == place.unsqueeze(1)).all(-1).int().argmax(1)
    assert step.unique().numel() == 3
    torch.testing.assert_close(visited[MEMORY], flight[MEMORY][drone, step].detach())
    forgets = VisitedStateBuffer(env=env)
    forgets.extend(flight)
    assert MEMORY not in forgets.initial_state(env)


@pytest.mark.parametrize(("recurrent", "noise_correlation"), [(True, 0.0), (True, 0.9), (False, 0.9)])
def test_losses_take_a_policy_that_sees(recurrent, noise_correlation):
    env = forest(max_episode_steps=4)
    actor = actor_for(env, recurrent=recurrent, noise_correlation=noise_correlation, return_log_prob=True)
    value, qvalue = (make(env, in_keys=["observation", ("state", "position")]) for make in (make_value, make_qvalue))
    _, carry = differentiable_rollout(env, actor, None, 2)  # which begins with memories
    rollout, _ = differentiable_rollout(env, actor, carry, 6)
    losses = [BPTTLoss(actor, alpha=0.1), SHACLoss(actor, value), ABPTLoss(actor, qvalue), SAPOLoss(actor, value)]
    for loss in losses:
        total = sum(x for key, x in loss(rollout).items() if key.startswith("loss_"))
        grads = torch.autograd.grad(total, list(actor.parameters()), retain_graph=True)
        assert all(g.isfinite().all() and g.any() for g in grads)
    for loss in (HybridLoss(actor, value), AHACLoss(actor, value, horizon=6)):
        loss(rollout)["loss_actor"].backward(retain_graph=True)
    # A bound that clips nothing leaves the gradient as it is: that of each action, and of the policy in whole memories.
    pair = BPTTLoss(actor), BPTTLoss(actor, clip_action_gradient=1e12)
    grads = [torch.autograd.grad(x.loss_actor(rollout)[0], list(actor.parameters()), retain_graph=True) for x in pair]
    torch.testing.assert_close(*grads)
    if recurrent:
        clipped = BPTTLoss(actor, clip_action_gradient=1.0).loss_actor(rollout)[0]
        with pytest.raises(RuntimeError, match="has first derivatives only. .* without a memory"):
            torch.autograd.grad(clipped, list(actor.parameters()), create_graph=True)
    over = rollout[:, :2].clone(recurse=False)  # all have crashed: there is no value after the end
    over["next"].update({name: torch.ones_like(over["next", name]) for name in ("done", "terminated")})
    assert ABPTLoss(actor, qvalue)(over)["loss_actor"].isfinite()
    bound = TrustRegion(actor, max_kl=1e-3)
    assert bound.divergence(rollout) < 1e-12
    with bound.around(rollout), torch.no_grad():
        for x in actor.parameters():
            x.add_(0.1)
    assert bound.divergence(rollout) <= 1e-3


@pytest.mark.parametrize("kind", ["blind", "seeing", "remembering"])
def test_loc_scale_and_log_probability_are_those_given_the_noise_of_the_step_before(kind):
    env, options = forest(max_episode_steps=4), {"scale_init": 0.3, "return_log_prob": True}
    make = make_actor if kind == "blind" else functools.partial(actor_for, recurrent=kind == "remembering")
    actor, white = make(env, noise_correlation=0.9, **options), make(env, **options)
    white.load_state_dict(actor.state_dict())
    rollout, _ = differentiable_rollout(env, actor, None, 6)
    rollout, rest = rollout.detach(), math.sqrt(1 - 0.9**2)
    with torch.no_grad(), set_recurrent_mode(True):
        free, given = (x.get_dist_params(rollout.select(*x.in_keys)) for x in (white, actor))
    torch.testing.assert_close(rollout["scale"], free["scale"] * rest)
    torch.testing.assert_close(rollout["loc"], free["loc"] + 0.9 * free["scale"] * rollout["noise_before"])
    torch.testing.assert_close(rollout["action"], torch.tanh(free["loc"] + free["scale"] * rollout["noise"]))
    density = TransformedDistribution(Normal(rollout["loc"], rollout["scale"]), TanhTransform())
    torch.testing.assert_close(rollout["action_log_prob"], density.log_prob(rollout["action"]).sum(-1))
    loss = ClipPPOLoss(actor, make_value(env), entropy_bonus=False)
    assert "noise_before" in loss.in_keys
    rollout["advantage"] = rollout["value_target"] = torch.ones(3, 6, 1)
    with set_recurrent_mode(True):  # nothing has changed yet: the ratio is one
        assert loss(rollout)["kl_approx"].abs().max() < 1e-9
    torch.testing.assert_close(given["loc"], rollout["loc"])
    start = rollout[:, 0].select(*white.in_keys)
    with set_exploration_type(MODE):  # also after a random flight
        modes = [policy(start.copy().set("noise", torch.ones(3, 4))) for policy in (actor, white)]
    torch.testing.assert_close(modes[0]["action"], modes[1]["action"])
    assert actor.plain().size == 4


def test_what_cannot_be_seen_is_refused():
    refuses("Give it a camera", make_visual_actor, HoveringEnv(num_envs=1))
    env = forest(num_envs=1)
    for name, wrong, example in (("channels", ((), 8, (2.5,)), "8, 16"), ("num_cells", ((), 64, (2.5,), (0,)), "64")):
        for value in wrong:
            refuses(f"{name}.* must .*in a list: .{example}.", make_visual_actor, env, **{name: value})
    refuses("recurrent=False", make_visual_actor(env, recurrent=False).make_tensordict_primer)
    refuses("InitTracker", EnvBase.rollout, env, 2, make_visual_actor(env))
