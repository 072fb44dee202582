"""The environment in TorchRL's own hands: under its transforms, losses and collectors, and in several processes."""

import multiprocessing
import signal
from functools import partial

import pytest
import torch
from refusals import refuses
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torchrl.collectors import MultiCollector
from torchrl.envs import Compose, ParallelEnv, RewardSum, SerialEnv, StepCounter, TransformedEnv, check_env_specs
from torchrl.envs import transforms as of_torchrl
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate

from torchrl_quad import HoveringEnv, ObservationNormalizer, VisitedStateBuffer, differentiable_rollout
from torchrl_quad.envs import TASKS, make_env
from torchrl_quad.modules import make_actor, make_qvalue, make_value
from torchrl_quad.objectives import ABPTLoss, BPTTLoss, SHACLoss

FEATURES = ["observation", ("state", "velocity")]


def norm():
    return of_torchrl.ObservationNorm(loc=0.1, scale=2.0, in_keys=["observation"], standard_normal=True)


def frames(**kwargs):
    return of_torchrl.CatFrames(N=3, dim=-1, in_keys=["observation"], **kwargs)


def tensors():
    return of_torchrl.CatTensors(FEATURES, "observation", del_keys=False)


BEFORE_THE_POLICY = {
    "normalised": lambda: [norm()],
    "frames": lambda: [frames()],
    "frames after zeros": lambda: [frames(padding="constant")],
    "tensors": lambda: [tensors()],
    "all": lambda: [StepCounter(), norm(), tensors(), frames(), of_torchrl.RewardScaling(0.5, 2.0), RewardSum()],
}
PRECISION = {"double to float": lambda: [of_torchrl.DoubleToFloat()]}


def make(transforms, **kwargs):
    """Three drones in float64, one of which begins anew after 4 steps, and each time at the same place."""
    env = HoveringEnv(**{"num_envs": 3, "dtype": torch.float64, "random_start": {"velocity": 1.0}} | kwargs)
    start = env.reset()["state"]
    start["step"] = torch.tensor([[0], [10], [env.max_episode_steps - 4]])
    env.set_initial_state_source(lambda n: start)
    return TransformedEnv(env, Compose(*transforms)) if transforms else env


def make_loss(name, env, actor):
    if name == "bptt":
        return BPTTLoss(actor).make_value_estimator(gamma=0.99)
    loss = SHACLoss(actor, make_value(env)) if name == "shac" else ABPTLoss(actor, make_qvalue(env))
    SoftUpdate(loss.make_value_estimator(gamma=0.99), tau=0.01)
    return loss


def lively(actor):
    """The actor with weights large enough for its input to matter."""
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return actor


def total(out):
    return sum(value for key, value in out.items() if key.startswith("loss_"))


def total_reward(env, actor):
    flight, _ = differentiable_rollout(env, actor, None, 9, exploration_type=ExplorationType.DETERMINISTIC)
    assert flight["next", "done"].sum() == 2
    return flight["next", "reward"].sum()


def gradient(env, actor):
    return torch.cat([g.flatten() for g in torch.autograd.grad(total_reward(env, actor), list(actor.parameters()))])


@pytest.fixture
def processes():
    """Other processes begin as copies of one that has imported everything; those that do not answer fail the test."""

    def give_up(*_):
        raise TimeoutError("no answer from the other processes in 100 s")

    multiprocessing.set_forkserver_preload(["torchrl.collectors", "torchrl_quad.envs"])
    multiprocessing.set_start_method("forkserver", force=True)
    signal.signal(signal.SIGALRM, give_up)
    signal.alarm(100)
    yield
    signal.alarm(0)
    multiprocessing.set_start_method(None, force=True)


@pytest.mark.parametrize(
    ("task", "name"), [("hovering", x) for x in (*BEFORE_THE_POLICY, *PRECISION)] + [(x, "all") for x in TASKS]
)
def test_specs_hold_under_transforms(task, name):
    transforms = {**BEFORE_THE_POLICY, **PRECISION}[name]()
    env = TransformedEnv(make_env(task, num_envs=2, dtype=torch.float64), Compose(*transforms))
    check_env_specs(env, break_when_any_done="both")


def test_transforms_that_the_policy_does_not_see_leave_its_gradient_as_it_is():
    plain = make([], seed=1)
    actor = lively(make_actor(plain))
    expected = 2.0 * gradient(plain, actor)
    assert expected.norm() > 1e-3
    beside = make([StepCounter(max_steps=50), of_torchrl.RewardScaling(0.5, 2.0), RewardSum()], seed=1)
    torch.testing.assert_close(gradient(beside, actor), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", BEFORE_THE_POLICY)
def test_gradients_through_transforms_that_the_policy_sees_are_finite_differences(name):
    env = make(BEFORE_THE_POLICY[name]())
    actor = lively(make_actor(env))
    start = parameters_to_vector(actor.parameters()).detach()
    direction = torch.randn_like(start)
    along = gradient(env, actor) @ direction

    def at(step):
        vector_to_parameters(start + step * direction, actor.parameters())
        with torch.no_grad():
            return total_reward(env, actor)

    assert along.abs() > 1e-3
    torch.testing.assert_close((at(1e-6) - at(-1e-6)) / 2e-6, along, rtol=1e-5, atol=1e-8)


def test_gradients_through_a_change_of_precision_are_those_of_either():
    exact = make([], seed=1)
    actor = lively(make_actor(exact))
    expected = gradient(exact, actor)
    start = exact.reset()["state"]
    up = of_torchrl.DTypeCastTransform(torch.float32, torch.float64)
    for env in (make([of_torchrl.DoubleToFloat()]), make([up], dtype=torch.float32)):
        env.set_initial_state_source(lambda n: start)
        same = make_actor(env)
        same.load_state_dict(actor.state_dict())
        result = gradient(env, same)
        assert result.dtype is env.observation_spec["observation"].dtype
        assert (result - expected).norm() < 1e-3 * expected.norm()


def test_frames_are_remembered_in_the_next_horizon_without_their_graph_and_restarted_in_visited_states():
    env = make([frames()])
    actor = lively(make_actor(env))
    _, carry = differentiable_rollout(env, actor, None, 3)
    for _ in range(3):
        flight, following = differentiable_rollout(env, actor, carry, 2)
        assert torch.equal(flight["next", "observation"][:2, 0, :26], carry["observation"][:2, 13:])
        flight["next", "reward"].sum().backward()  # of this horizon alone: the graph of the one before is gone
        carry = following
    env = make([StepCounter(), RewardSum(), frames()])
    rollout, _ = differentiable_rollout(env, make_actor(env), None, 3)
    buffer = VisitedStateBuffer()
    buffer.extend(rollout[:, 1:])
    carry = buffer.initial_state(env, 1.0)
    one, two, three = carry["observation"].split(13, -1)
    assert torch.equal(one, two) and torch.equal(two, three)
    torch.testing.assert_close(three[:, :3], carry["state", "target"] - carry["state", "position"])
    assert (carry["step_count"] == 0).all() and (carry["episode_reward"] == 0).all()


def test_a_transform_that_deletes_the_state_is_refused():
    env = TransformedEnv(HoveringEnv(num_envs=2), of_torchrl.CatTensors(FEATURES, "features"))
    refuses("step: the state lacks velocity. A state is restored whole", env.rollout, 2)


@pytest.mark.parametrize("name", ["all", "double to float"])
@pytest.mark.parametrize("loss_name", ["bptt", "shac", "abpt"])
def test_first_order_losses_train_under_transforms_and_from_visited_states(loss_name, name):
    env = make({**BEFORE_THE_POLICY, **PRECISION}[name](), seed=2)
    actor, buffer, carry = make_actor(env), VisitedStateBuffer(), None
    loss = make_loss(loss_name, env, actor)
    optimizer = torch.optim.SGD(loss.parameters(), 1e-3)
    before = parameters_to_vector(actor.parameters()).detach().clone()
    for _ in range(3):
        rollout, _ = differentiable_rollout(env, actor, carry, 6)
        buffer.extend(rollout)
        carry = buffer.initial_state(env, 0.5)
        loss_now = total(loss(rollout))
        optimizer.zero_grad()
        loss_now.backward()
        assert loss_now.isfinite()
        assert all(p.grad.isfinite().all() for p in loss.parameters() if p.requires_grad)
        assert parameters_to_vector([p.grad for p in actor.parameters()]).norm() > 0
        optimizer.step()
    assert not torch.equal(parameters_to_vector(actor.parameters()), before)


def test_a_collector_of_several_processes_flies_it(processes):
    makers = [partial(HoveringEnv, num_envs=3, max_episode_steps=6, seed=seed) for seed in (0, 1)]
    sizes = {"frames_per_batch": 24, "total_frames": 48}
    collector = MultiCollector(makers, make_actor(makers[0]()), sync=True, **sizes)
    try:
        batches = [data.clone() for data in collector]
    finally:
        collector.shutdown()
    assert [data.numel() for data in batches] == [24, 24]
    steps = torch.cat([data.reshape(2, 3, 4)["state", "step"] for data in batches], 2)
    assert steps[..., 0].tolist() == [[[0, 1, 2, 3, 4, 5, 0, 1]] * 3] * 2
    position = batches[0].reshape(2, 3, 4)["state", "position"]
    assert not torch.equal(position[0, :, 0], position[1, :, 0])


def check_a_batch_of_environments(env):
    env.set_seed(0)
    check_env_specs(env)
    assert env.batch_size == (2, 3)
    actor = make_actor(env)
    rollout, carry = differentiable_rollout(env, actor, None, 8)
    assert rollout.batch_size == (2, 3, 8)
    assert rollout["state", "step"][..., 0].tolist() == [[[0, 1, 2, 3, 4, 5, 0, 1]] * 3] * 2
    assert not torch.equal(*rollout["state", "position"][:, :, 0])
    hover = HoveringEnv(num_envs=1).hover_action
    torch.testing.assert_close(rollout["loc"][..., 0].tanh(), hover[0].expand(2, 3, 8), atol=0.02, rtol=0)
    buffer = VisitedStateBuffer()
    buffer.extend(rollout[..., 1:3])
    assert len(buffer) == 12
    visited = buffer.initial_state(env, 1.0)
    assert set(visited["state", "step"].flatten().tolist()) <= {1, 2}
    assert carry.batch_size == visited.batch_size == (2, 3)
    return actor, rollout


def test_environments_in_one_process_keep_their_gradients():
    env = TransformedEnv(SerialEnv(2, partial(HoveringEnv, num_envs=3, max_episode_steps=6)), StepCounter())
    actor, rollout = check_a_batch_of_environments(env)
    for name in ("bptt", "shac", "abpt"):
        loss = make_loss(name, env, actor)
        (grad, *_) = torch.autograd.grad(loss(rollout)["loss_actor"], list(actor.parameters()), retain_graph=True)
        assert grad.isfinite().all() and grad.norm() > 0
    carry = None
    for _ in range(2):  # each horizon has a graph of its own
        rollout, carry = differentiable_rollout(env, actor, carry, 3)
        BPTTLoss(actor)(rollout)["loss_actor"].backward()


def test_environments_in_several_processes_fly_and_the_loss_says_that_they_cut_the_gradient(processes):
    env = ParallelEnv(2, partial(HoveringEnv, num_envs=3, max_episode_steps=6))
    assert make_actor(env)(env.fake_tensordict())["action"].shape == (2, 3, 4)
    assert ObservationNormalizer(env).loc.shape == (13,) and env.is_closed  # networks need no process
    try:
        actor, rollout = check_a_batch_of_environments(env)
    finally:
        env.close(raise_if_closed=False)
    refuses("carries no gradient. Collectors, ParallelEnv, .* cut it", BPTTLoss(actor), rollout, error=RuntimeError)
