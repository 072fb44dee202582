"""A compiled environment follows every change that an eager one follows, and its audits are the same."""

import copy

import pytest
import torch
from torch._dynamo.utils import counters

from torchrl_quad import HoveringEnv, audit_reward, differentiable_rollout, make_actor
from torchrl_quad.dynamics import DYNAMICS, PointMass

BONUS = 1.0
LIFT = 1.0


def moved(state, dt):
    return [state[0] + state[2] * (LIFT * dt), *state[1:]]


class Gliding(PointMass):
    """Keeps its velocity; a global and a function of this module move it."""

    def physics_step(self, state, setpoint, plant, controller, wind):
        return moved(state, self.dt)


class Paid(HoveringEnv):
    """Pays a global of this module and an attribute of its class."""

    extra = 10.0

    def reward_terms(self, state):
        return {"paid": torch.full_like(state["position"][:, :1], BONUS + self.extra)}


def test_a_compiled_step_sees_changed_attributes_classes_and_globals(monkeypatch):
    # What is watched does not depend on the backend, and this one generates no code.
    eager, compiled = Paid(num_envs=2), Paid(num_envs=2).compile(backend="eager")

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
    monkeypatch.setattr(Paid, "extra", 20.0)
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


def test_the_gradients_in_actions_are_those_of_a_compiled_horizon():
    env = HoveringEnv(num_envs=4, max_episode_steps=12, dtype=torch.float64)
    actor, audits = make_actor(env), []
    for _ in range(2):
        env.set_seed(0)
        torch.manual_seed(0)
        rollout, _ = differentiable_rollout(env, actor, None, 20)
        audits.append(audit_reward(rollout, rollout["action"]))
        env.compile(backend="eager")
    assert rollout["action"].grad_fn.name() != "StackBackward0"
    for name, term in audits[0].items():
        assert audits[1][name].gradient_norm == pytest.approx(term.gradient_norm, rel=1e-9)
