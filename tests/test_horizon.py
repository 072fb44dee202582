"""The quick rollout against TorchRL's own, and the compiled step against the eager one."""

import copy

import pytest
import torch
from helpers import Looks, anew, cases, look_at_nothing, on_plain_tensors, refuses
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch._dynamo.utils import counters
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_quad import ActionSequence, BPTTLoss, HoveringEnv, RacingEnv, audit_reward, differentiable_rollout
from torchrl_quad.dynamics import DYNAMICS, PointMass
from torchrl_quad.envs import TASKS, make_env
from torchrl_quad.errors import Unsupported
from torchrl_quad.modules import make_actor

NOISE, START = {"position": 0.01, "attitude": 0.01}, {"tilt": 0.3, "velocity": 0.5}
EVERYTHING = {"action_delay": 2, "observe_last_action": True, "observation_delay": 1, "event_discount": 0.99}
EVERYTHING |= {"observation_noise": NOISE, "random_start": START, "wind": {"mean": [1.0, 0.0, 0.0], "gust": 0.5}}
EVERYTHING["randomize"] = {"mass": {"scale": [0.8, 1.2]}, "rotor_positions": {"scale": [0.9, 1.1]}}


def fly(rollout, env, actor, start, steps):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        flight = rollout(steps, actor, tensordict=start.clone(), auto_reset=False, break_when_any_done=False)
    loss = flight["next", "reward"].sum() + flight["observation"].square().sum() + flight["state", "velocity"].sum()
    return flight, torch.autograd.grad(loss, list(actor.parameters()))


def torchrls_loop(env):
    return lambda *args, **kwargs: EnvBase.rollout(env, *args, **kwargs)


def entries(flight):
    return dict(flight.items(include_nested=True, leaves_only=True))


@pytest.mark.parametrize("options", [{}, EVERYTHING], ids=["plain", "everything"])
@pytest.mark.parametrize("task", TASKS)
def test_the_quick_rollout_is_that_of_torchrl_in_every_entry_and_gradient(task, options):
    env = make_env(task, num_envs=3, max_episode_steps=7, dtype=torch.float64, **options)
    actor = make_actor(env)
    quick, quick_grad = fly(env.rollout, env, actor, env.reset(), 20)
    env.set_seed(0)
    slow, slow_grad = fly(torchrls_loop(env), env, actor, env.reset(), 20)
    assert quick.names == slow.names and quick.shape == slow.shape
    assert quick["next", "done"].sum() >= 6
    torch.testing.assert_close(entries(quick), entries(slow))
    torch.testing.assert_close(quick_grad, slow_grad)
    assert not quick["next", "metrics"].requires_grad


def test_a_policy_may_read_the_state_and_any_other_flies_in_torchrls_loop(env):
    actor, start = make_actor(env, in_keys=["observation", ("state", "rotor_speed")], input_scale=1e-4), env.reset()
    quick, _ = fly(env.rollout, env, actor, start, 5)
    slow, _ = fly(torchrls_loop(env), env, actor, start, 5)
    torch.testing.assert_close(entries(quick), entries(slow))
    hover = env.hover_action.expand(4, 4)
    reads_more = TensorDictModule(lambda x, y: hover, in_keys=["observation", "mine"], out_keys=["action"])
    start = env.reset().set("mine", torch.ones(4, 1))
    flight = env.rollout(5, reads_more, tensordict=start, auto_reset=False, break_when_any_done=False)
    assert flight["mine"].sum() == 20
    for policy in (lambda td: td.set("action", hover), None):
        assert env.rollout(5, policy, break_when_any_done=False).shape == (4, 5)


class Paid(HoveringEnv):
    """Gives another reward in a step of its own."""

    def _step(self, tensordict):
        return super()._step(tensordict).set("reward", torch.full((2, 1), 7.0))


def test_a_step_of_one_s_own_is_flown_and_an_output_that_nobody_wants_does_no_harm():
    env = Paid(num_envs=2)
    actor = make_actor(env)
    assert (env.rollout(3, actor, break_when_any_done=False)["next", "reward"] == 7.0).all()
    policy = TensorDictModule(lambda x: (x[:, :4].tanh(), x), in_keys=["observation"], out_keys=["action", "_"])
    assert HoveringEnv(num_envs=2).rollout(3, policy, break_when_any_done=False).shape == (2, 3)


def test_an_accelerator_is_not_waited_for_inside_a_horizon(monkeypatch):
    env = HoveringEnv(num_envs=4, max_episode_steps=7, wind={"gust": 0.5})
    policy, start = TensorDictModule(lambda x: x[:, :4].sin(), ["observation"], ["action"]), env.reset()

    def looks(steps):
        with Looks() as seen:
            flight = env.rollout(steps, policy, tensordict=start, auto_reset=False, break_when_any_done=False)
        assert flight["next", "done"].any()
        return seen.count

    assert looks(20) > looks(10)
    look_at_nothing(monkeypatch)
    assert looks(20) == looks(10) == 1  # whether the actions were finite, at the end


def losses_of(flight):
    """A number that depends on all that a loss may read: rewards, both ends of each step, and what the policy wrote."""
    read = [("next", "reward"), "observation", ("next", "observation"), ("state", "velocity"), "action", "loc", "scale"]
    read += [("next", "state", "rotor_speed"), ("next", "reward_terms", "velocity"), "action_log_prob"]
    parts = [flight[key] for key in read if key in flight]
    return sum((x * torch.linspace(0.5, 1.5, x.numel(), dtype=x.dtype).view_as(x)).sum() for x in parts)


def break_drones(env, parameter):
    """One step, and its gradients: the state of drone 0 is not finite, and drone 2 turns too fast."""
    env.set_seed(0)
    td = env.reset()
    td["state", "velocity"][0] = torch.nan
    td["state", "angular_velocity"][2] = 99.0  # within the bounds, until it flies
    action = (env.hover_action + 0.1).repeat(env.num_envs, 1).requires_grad_()
    end = env.step(td.set("action", action))["next"]
    total = end["observation"].sum() + end["reward"].sum() + end["state", "rotor_speed"].sum()
    return end, torch.autograd.grad(total, (action, parameter))


def test_compiled_flights_equal_eager_ones_and_never_recompile(monkeypatch):
    options = {**EVERYTHING, "reward": "position", "control": "velocity"}
    env = RacingEnv(num_envs=4, max_episode_steps=11, dt=0.01, dtype=torch.float64, **options)
    drag = env.nominal.linear_drag.clone().requires_grad_()
    env.params = env.nominal.replace(linear_drag=drag)
    actor = make_actor(env, in_keys=["observation", ("state", "velocity")], return_log_prob=True)
    called = TensorDictSequential(actor)

    def train(policy):
        """Two horizons, through the ends of episodes, from a start that wants a gradient."""
        start = anew(env).reset()
        start["state", "position"][:2] = start["state", "target"][:2] - torch.tensor([0.5, 0.0, 0.0])
        start["state", "velocity"][:2, 0] = 3.0  # through the gate, which is an event
        start["state", "velocity"].requires_grad_()
        flight, carry = differentiable_rollout(env, policy, start, 14)
        assert flight["next", "state", "gate_passed"].any()
        more, _ = differentiable_rollout(env, policy, carry, 3)
        wanted = [drag, start["state", "velocity"], *policy.parameters()]
        return flight, torch.autograd.grad(losses_of(flight) + losses_of(more), wanted)

    def optimise_actions():
        anew(env)
        actions = (env.hover_action + 0.05 * torch.ones(14, 4, 4, dtype=env.dtype)).requires_grad_()
        flight, _ = differentiable_rollout(env, ActionSequence(actions), None, 14)
        torch.testing.assert_close(flight["action"], actions.transpose(0, 1))
        return flight, torch.autograd.grad(losses_of(flight), actions)

    def train_with_clipped_gradients():
        flight, _ = differentiable_rollout(anew(env), actor, None, 14)
        loss = BPTTLoss(actor, clip_action_gradient=2.0).loss_actor(flight)[0]
        return flight, torch.autograd.grad(loss, list(actor.parameters()))

    def audit():
        """The gradients in actions."""
        flight, _ = differentiable_rollout(anew(env), actor, None, 14)
        return {name: term.gradient_norm for name, term in audit_reward(flight, flight["action"]).items()}

    def all_ways():
        in_torchrls_loop = fly(torchrls_loop(env), env, actor, anew(env).reset(), 12)
        with monkeypatch.context() as patch:
            look_at_nothing(patch)
            as_on_an_accelerator = train(actor)
        flights = train(actor), train(called), optimise_actions(), train_with_clipped_gradients()
        return *flights, in_torchrls_loop, as_on_an_accelerator

    eager, eager_audit, (broken, broken_grads) = all_ways(), audit(), break_drones(env, drag)
    env.compile()
    assert env.flies_inside(actor) and not env.flies_inside(called)
    all_ways()
    assert audit() == pytest.approx(eager_audit, rel=1e-9)
    compiled_so_far = counters["stats"]["unique_graphs"]
    compiled, (end, end_grads) = all_ways(), break_drones(env, drag)
    with torch.no_grad():
        train_free = env.rollout(4, actor, break_when_any_done=False)
        env.rollout(3, actor)
    env.rollout(3)
    env.set_initial_state_source(lambda n: train_free["next", "state"][:, 2])
    env.rollout(12, actor, break_when_any_done=False)["next", "reward"].sum().backward()
    assert counters["stats"]["unique_graphs"] == compiled_so_far
    for (flight, grads), (expected, expected_grads) in zip(compiled, eager, strict=True):
        torch.testing.assert_close(entries(flight), entries(expected))
        torch.testing.assert_close(grads, expected_grads)
        assert not flight["next", "metrics"].requires_grad and not expected["next", "metrics"].requires_grad
        assert flight["next", "done"].any()
    torch.testing.assert_close(compiled[0], compiled[1])
    torch.testing.assert_close(entries(end), entries(broken))
    torch.testing.assert_close(end_grads, broken_grads)
    assert end["crash"].flatten().tolist() == [True, False, True, False]
    assert (end_grads[0][[0, 2]] == 0).all() and (end_grads[0][[1, 3]] != 0).any() and (end_grads[1] != 0).all()
    assert end["state"].isfinite().all() and end["observation"].isfinite().all()
    too_much = torch.full((4, 4), 1e30, dtype=env.dtype)
    assert env.step(env.reset().set("action", too_much))["next", "crash"].all()
    with pytest.raises(ValueError, match="The action is not finite in environments 0, 1, 2, 3: "):
        env.step(env.reset().set("action", torch.nan * too_much))
    loss = differentiable_rollout(env, actor, None, 5)[0]["next", "reward"].sum()
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(loss, list(actor.parameters()), create_graph=True)


def test_an_action_of_a_horizon_that_is_not_finite_is_refused_with_its_first_step(env):
    actions = env.hover_action.repeat(8, 4, 1)
    actions[5:, 2, 0] = torch.nan
    sequence = iter(actions)
    policy = TensorDictModule(lambda _: next(sequence), in_keys=["observation"], out_keys=["action"])
    with pytest.raises(ValueError, match="not finite in environments 2, first at step 5 of the rollout: the weights"):
        env.rollout(8, policy, break_when_any_done=False)


class Patrol(HoveringEnv):
    """Waypoints (3, 3) of each drone, the next one first."""

    def initial_state(self, n):
        state = super().initial_state(n)
        return {**state, "waypoints": state["position"].unsqueeze(1) + self.uniform(n, 3, 3)}

    def advance(self, previous, state):
        return {**state, "waypoints": previous["waypoints"].roll(-1, 1)}


def test_an_entry_of_a_task_may_have_more_than_one_dimension():
    env = Patrol(num_envs=3, max_episode_steps=7, dtype=torch.float64)
    start = env.reset()
    flight = env.rollout(5, make_actor(env), tensordict=start.clone(), auto_reset=False, break_when_any_done=False)
    torch.testing.assert_close(flight["next", "state", "waypoints"][:, 0], start["state", "waypoints"].roll(-1, 1))
    start["state", "velocity"][1] = torch.nan  # its state cannot go on, and its waypoints stay
    after = env.step(start.set("action", env.hover_action.repeat(3, 1)))["next", "state", "waypoints"]
    torch.testing.assert_close(after[1], start["state", "waypoints"][1])
    torch.testing.assert_close(after[0], start["state", "waypoints"][0].roll(-1, 0))


def test_without_a_cpp_compiler_the_step_stays_eager_and_says_so(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.warns(UserWarning, match="neither g.. nor clang.. is on the PATH"):
        env = HoveringEnv(num_envs=2, compile=True)
    assert not env.is_compiled
    with torch._dynamo.config.patch(disable=True):  # as TORCH_COMPILE_DISABLE=1 does
        assert not HoveringEnv(num_envs=2, compile=True).is_compiled
    assert env.rollout(2)["next", "reward"].isfinite().all()


@pytest.mark.parametrize("options", [{"mode": "reduce-overhead"}, {"options": {"triton.cudagraphs": True}}])
def test_cuda_graphs_are_refused_since_a_horizon_keeps_all_of_its_steps(options):
    env = HoveringEnv(num_envs=2)
    refuses("max-autotune-no-cudagraphs", env.compile, error=Unsupported, **options)
    assert env.compile(mode="max-autotune-no-cudagraphs", options=None).is_compiled


@pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
@cases(
    ({},),
    ({"activation": nn.Tanh, "in_keys": ["observation", ("state", "velocity")], "input_scale": (1.0, 0.3)},),
    ({"activation": nn.SiLU, "num_cells": (16,), "action_init": torch.full((4,), 0.2)},),
)
def test_a_policy_on_plain_tensors_is_the_policy(options, kind, env64):
    actor = make_actor(env64, return_log_prob=True, **options)
    for parameter in actor.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    td = env64.reset()
    inputs = [td[key].requires_grad_() for key in actor.in_keys]
    written, plain, drawn = on_plain_tensors(actor, td, kind)
    kept, mine = plain.forward(plain.weights, inputs, drawn)
    torch.testing.assert_close(mine, {key: written[key] for key in plain.out_keys})
    grads = {key: torch.randn_like(x) for key, x in mine.items()}
    total = sum((written[key] * grads[key]).sum() for key in grads)
    expected = torch.autograd.grad(total, [*inputs, *plain.weights])
    traces, grad_inputs, _ = plain.adjoint(plain.weights, inputs, kept, drawn, grads)
    torch.testing.assert_close(tuple(grad_inputs), expected[: len(inputs)])
    torch.testing.assert_close(tuple(plain.weight_gradient(plain.weights, traces)), expected[len(inputs) :])


def test_a_saturated_policy_keeps_the_gradient_that_torchrl_gives(env):
    actor = make_actor(env, return_log_prob=True)
    actor[0].module.mlp[-1].bias.data += 12.0
    td = env.reset()
    written, plain, drawn = on_plain_tensors(actor, td, ExplorationType.DETERMINISTIC)
    weights, mine = list(plain.weights), plain.forward(plain.weights, [td["observation"]], drawn)[1]
    assert (written["action"] > 0.999).all()
    for key in ("action", "action_log_prob"):
        torch.testing.assert_close(mine[key], written[key])
        expected, found = (torch.autograd.grad(x[key].sum(), weights, retain_graph=True) for x in (written, mine))
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_policies_that_somebody_has_changed_are_called():
    env = HoveringEnv(num_envs=2)
    compiled, actor = HoveringEnv(num_envs=2).compile(), make_actor(env)
    assert compiled.flies_inside(actor) and not env.flies_inside(actor)
    assert compiled.flies_inside(ActionSequence(torch.zeros(3, 2, 4)))
    hook = actor[0].module.mlp[1].register_forward_hook(lambda *_: None)
    assert not compiled.flies_inside(actor)
    hook.remove()
    with set_exploration_type(ExplorationType.MODE):
        assert not compiled.flies_inside(actor)
    assert compiled.flies_inside(actor)
    actor[0].module.mlp[1] = nn.PReLU()
    other_head = make_actor(env)
    other_head[0].module.head = nn.Identity()
    windy = HoveringEnv(num_envs=2, wind={"gust": 0.5})
    others = [actor, other_head, make_actor(env, activation=nn.RReLU)]
    others += [make_actor(HoveringEnv(num_envs=2, dtype=torch.float64))]
    others += [make_actor(HoveringEnv(num_envs=2, observe_last_action=True))]
    others += [make_actor(windy, in_keys=["observation", ("state", "wind")])]
    others += [TensorDictModule(nn.Linear(13, 4), ["observation"], ["action"])]
    others += [make_actor(env, in_keys=["observation", "observation"])]
    for change in ({0: nn.Linear(13, 64, bias=False)}, {1: nn.ELU(inplace=True)}, {5: nn.Tanh()}):
        others.append(make_actor(env))
        others[-1][0].module.mlp._modules.update({str(i): layer for i, layer in change.items()})
    assert not any(map(compiled.flies_inside, others))


def test_a_sequence_of_actions_is_played_once(env):
    sequence = ActionSequence(torch.zeros(5, 4, 4))
    env.rollout(3, sequence, break_when_any_done=False)
    with pytest.raises(ValueError, match="5 actions, 0 of them unplayed, and the flight needs 1 more"):
        env.rollout(3, sequence, break_when_any_done=False)


# -- a compiled environment follows every change that an eager one follows ---------------------------------------------

BONUS = 1.0
LIFT = 1.0


def moved(state, dt):
    return [state[0] + state[2] * (LIFT * dt), *state[1:]]


class Gliding(PointMass):
    """Keeps its velocity; a global and a function of this module move it."""

    def physics_step(self, state, setpoint, plant, controller, wind):
        return moved(state, self.dt)


class Bonus(HoveringEnv):
    """Pays a global of this module and an attribute of its class."""

    extra = 10.0

    def reward_terms(self, state):
        return {"paid": torch.full_like(state["position"][:, :1], BONUS + self.extra)}


def test_a_compiled_step_sees_changed_attributes_classes_and_globals(monkeypatch):
    # What is watched does not depend on the drone and on the backend, and this one generates no code.
    eager, compiled = (Bonus(num_envs=2, dynamics="point_mass") for _ in range(2))
    compiled.compile(backend="eager")

    def step(env):
        td = env.reset().set("action", env.hover_action.repeat(2, 1))
        after = env.step(td)["next"]
        return after["reward"].flatten().tolist(), after["success"].flatten().tolist()

    def both():
        assert step(compiled) == step(eager)
        return step(eager)

    assert both() == ([11.0, 11.0], [False, False])
    for env in (eager, compiled):
        env.success_radius = 50.0  # an attribute of the class becomes one of the environment
    monkeypatch.setattr(Bonus, "extra", 20.0)
    assert both() == ([21.0, 21.0], [True, True])
    monkeypatch.setitem(globals(), "BONUS", 2.0)
    assert both()[0] == [22.0, 22.0]
    before = counters["stats"]["unique_graphs"]
    both()
    assert counters["stats"]["unique_graphs"] == before
    copied = copy.deepcopy(compiled)
    copied.extra = 30.0  # a copy shares nothing with what it was made of
    assert step(copied)[0] == [32.0, 32.0] and step(compiled)[0] == [22.0, 22.0]


def test_a_compiled_step_sees_changes_of_dynamics_in_a_module_of_ones_own(monkeypatch):
    monkeypatch.setitem(DYNAMICS, "gliding", Gliding)
    eager, compiled = (HoveringEnv(num_envs=2, dynamics="gliding") for _ in range(2))
    compiled.compile(backend="eager")
    start = eager.reset()
    start["state", "velocity"] = torch.ones(2, 3)

    def height():
        ends = [env.step(start.copy().set("action", torch.zeros(2, 4)))["next", "state"] for env in (eager, compiled)]
        torch.testing.assert_close(ends[0]["position"], ends[1]["position"])
        return (ends[1]["position"] - start["state", "position"])[0, 2].item()

    step = eager.control_dt
    assert height() == pytest.approx(step, rel=1e-3)
    monkeypatch.setitem(globals(), "LIFT", 2.0)
    assert height() == pytest.approx(2 * step, rel=1e-3)
    for env in (eager, compiled):
        env.dynamics.dt *= 2
    assert height() == pytest.approx(4 * step, rel=1e-3)
    monkeypatch.setitem(globals(), "moved", lambda state, dt: state)
    assert height() == 0.0
