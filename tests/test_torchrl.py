"""The environment in TorchRL's own hands; the last section follows TorchRL's tests (pytorch/rl, test/envs) by name.

These do not apply: TestAutoReset, as our environments do not reset themselves; RewardSum of ("reward_terms", name),
which are observations here; nested done flags, several agents, strings, tensorclasses, dynamic specs, discrete actions.
"""

import multiprocessing
import pickle
import signal
from functools import partial

import pytest
import torch
from helpers import cases, refuses
from tensordict import assert_close
from test_bounded_steps import LOSSES
from torch.nn.utils import parameters_to_vector
from torchrl.collectors import Collector, MultiCollector
from torchrl.data import Unbounded
from torchrl.envs import AsyncEnvPool, EnvCreator, ParallelEnv, SerialEnv, check_env_specs
from torchrl.envs import transforms as of_torchrl
from torchrl.envs.transforms import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import step_mdp
from torchrl.objectives import SoftUpdate

from torchrl_quad import HoveringEnv, ObservationNormalizer, VisitedStateBuffer, differentiable_rollout, make_actor
from torchrl_quad.envs import TASKS, make_env
from torchrl_quad.objectives import BPTTLoss

FEATURES = ["observation", ("state", "velocity")]


norm = partial(of_torchrl.ObservationNorm, loc=0.1, scale=2.0, in_keys=["observation"], standard_normal=True)
frames = partial(of_torchrl.CatFrames, N=3, dim=-1, in_keys=["observation"])
tensors = partial(of_torchrl.CatTensors, FEATURES, "observation", del_keys=False)
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
    loss = LOSSES[name](env, actor).make_value_estimator(gamma=0.99)
    if name != "bptt":
        SoftUpdate(loss, tau=0.01)
    return loss


def total(out):
    return sum(value for key, value in out.items() if key.startswith("loss_"))


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


@cases(*(("hovering", x) for x in (*BEFORE_THE_POLICY, *PRECISION)), *((x, "all") for x in TASKS))
def test_specs_hold_under_transforms(task, name):
    transforms = {**BEFORE_THE_POLICY, **PRECISION}[name]()
    env = TransformedEnv(make_env(task, num_envs=2, dtype=torch.float64), Compose(*transforms))
    check_env_specs(env, break_when_any_done="both")


def test_frames_are_remembered_in_the_next_horizon_without_their_graph_and_restarted_in_visited_states():
    env = make([frames()])
    actor = make_actor(env)
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


# -- what TorchRL's own tests ask of an environment --------------------------------------------------------------------

each_task = pytest.mark.parametrize("task", TASKS)


def short(task, num_envs=3, **options):
    return make_env(task, num_envs=num_envs, max_episode_steps=4, **options)


@each_task
def test_specs_are_locked_have_an_unbatched_form_and_are_what_a_step_writes(task):
    env = short(task)
    check_env_specs(env, break_when_any_done="both")
    for _ in range(2):  # TestEnvBase::test_env_lock, also of a copy from another process
        assert env.is_spec_locked and env.input_spec.is_locked and env.output_spec.is_locked
        with pytest.raises(RuntimeError, match="lock"):
            env.input_spec["full_action_spec", "action"] = Unbounded(())
        env, original = pickle.loads(pickle.dumps(env)), env
    assert not short(task, spec_locked=False).is_spec_locked
    # TestEnvBase::test_single_env_spec
    assert env.full_action_spec_unbatched["action"].shape == (4,) and env.full_reward_spec_unbatched.shape == ()
    for batched, single in ((env.output_spec, env.output_spec_unbatched), (env.input_spec, env.input_spec_unbatched)):
        assert not single.shape and batched.is_in(single.zeros(env.shape))
    assert type(env) is TASKS[task]
    fake, step = env.fake_tensordict(), env.rand_step(env.reset())
    assert (original.step(step.exclude("next"))["next"] == step["next"]).all()
    assert set(fake.keys(True, True)) == set(step.keys(True, True)) and env.output_spec["full_done_spec"].is_in(step)
    # TestEnvBase::test_batch_locked
    refuses("Expected a tensordict with shape==env.batch_size", env.step, step.expand(2, 3).clone(), error=RuntimeError)


@each_task
def test_a_seed_repeats_a_flight_and_gives_the_seed_of_the_next_environment(task):
    env, actions = short(task), 0.1 * torch.randn(4, 3, 4)
    # TestEnvBase::test_env_seed
    following = env.set_seed(5)
    first = env.rollout(9, actions=actions)
    assert env.set_seed(5) == following != 5 and env.set_seed(5, static_seed=True) == 5
    assert_close(env.rollout(9, actions=list(actions)), first)
    assert torch.equal(first["action"], actions.transpose(0, 1)) and first.names == [None, "time"]
    env.set_seed(following)
    assert not torch.equal(env.rollout(9, actions=actions)["observation"], first["observation"])
    # TestRollout::test_rollout_set_truncated, TestEnvBase::test_storing_device
    flight = env.rollout(2, set_truncated=True, storing_device="cpu", break_when_any_done=False)
    assert flight["next", "truncated"][:, -1].all() and flight["next", "done"][:, -1].all()


@each_task
def test_resets_of_some_and_steps_that_reset_leave_the_others_alone(task):
    env = short(task).append_transform(StepCounter())
    before = step_mdp(env.rollout(2, actions=env.base_env.hover_action.expand(2, 3, 4))[:, -1])
    mask = torch.tensor([[True], [False], [True]])
    resets = (env.reset(before.clone().set("_reset", x), set_state=False) for x in (mask, mask & ~mask))
    after, nobody = (x.exclude("_reset", "action") for x in resets)  # TestEnvBase::test_env_base_reset_flag
    assert after["state", "step"].flatten().tolist() == after["step_count"].flatten().tolist() == [0, 2, 0]
    for kept, expected in ((after[1], before[1]), (nobody, before)):
        assert_close(kept, expected.exclude("action"), rtol=0, atol=0)
    steps, root = [], env.reset()
    for _ in range(6):  # TestStepMdp::test_step_and_maybe_reset
        step, root = env.step_and_maybe_reset(root.set("action", env.base_env.hover_action.expand(3, 4)))
        steps.append(step["state", "step"][0].item())
    assert steps == [0, 1, 2, 3, 0, 1] and env.maybe_reset(root.clone())["state", "step"].tolist() == [[2]] * 3
    # TestCollector, of one process, goes on where a batch ends
    batches = list(Collector(env, env.rand_action, frames_per_batch=9, total_frames=18))
    assert torch.cat([x["step_count"] for x in batches], 1)[0].flatten().tolist() == [0, 1, 2, 3, 0, 1]


@each_task
def test_environments_are_copied_by_creators_and_moved_to_a_device_as_they_are(task):
    env = SerialEnv(2, EnvCreator(partial(short, task)))  # TestEnvCreator::test_env_creator
    assert env.rollout(5, break_when_any_done=False)["next", "done"].sum(2).tolist() == [[[1]] * 3] * 2
    copy, device = short(task), torch.device("cpu")
    assert copy.to(device) is copy and copy.device == device and copy.rollout(2).device == device
    assert copy.load_state_dict(copy.state_dict()).missing_keys == []


def alone(task):
    """One drone, without a batch."""
    return TransformedEnv(short(task, 1), of_torchrl.BatchSizeTransform(reshape_fn=lambda td: td.reshape(())))


in_processes = pytest.param("hovering", "multiprocessing", marks=pytest.mark.slow)


@pytest.mark.parametrize(("task", "backend"), [*((x, "threading") for x in TASKS), in_processes])
def test_drones_one_by_one_fly_asynchronously(task, backend, processes):
    exchange = {"exchange": "queue"} if backend == "multiprocessing" else {}
    env = AsyncEnvPool([partial(alone, task)] * 2, backend=backend, **exchange)
    try:  # TestAsyncEnvPool::test_specs, test_async_reset_and_step
        assert env.rand_step(env.reset()).shape == env.shape == (2,)
        if task == "hovering":
            env.check_env_specs(break_when_any_done="both")
        assert env.rollout(6, break_when_any_done=False)["state", "step"][..., 0].tolist() == [[0, 1, 2, 3, 0, 1]] * 2
        env.async_step_send(env.rand_action(env.reset()))
        assert env.async_step_recv(min_get=2)["next", "state", "step"].tolist() == [[1], [1]]
    finally:
        env.close(raise_if_closed=False)
