"""Differentiable rollouts, visited states and restarts."""

import pytest
import torch
from helpers import assert_equal, cases, refuses
from tensordict.nn import TensorDictModule
from torchrl.envs import BatchSizeTransform, ExplorationType, PendulumEnv, StepCounter, TransformedEnv

from torchrl_quad import HoveringEnv, TrackingEnv, VisitedStateBuffer, differentiable_rollout, make_actor, restart
from torchrl_quad.errors import UserValueError

TORQUE = TensorDictModule(lambda speed: -speed.unsqueeze(-1), in_keys=["thdot"], out_keys=["action"])


@pytest.fixture
def flight(env):
    actor = make_actor(env)
    return env, actor, *differentiable_rollout(env, actor, None, 5)


def test_the_rollout_keeps_the_graph_and_the_carry_drops_it_and_goes_on_where_the_rollout_ended(flight):
    env, actor, rollout, carry = flight
    assert rollout.batch_size == (4, 5)
    assert not any(value.requires_grad for value in carry.values(include_nested=True, leaves_only=True))
    rollout["next", "reward"].sum().backward(retain_graph=True)
    assert all(p.grad is not None for p in actor.parameters())
    assert torch.equal(carry["state", "position"], rollout["next", "state", "position"][:, -1])
    before = carry.clone()
    following, _ = differentiable_rollout(env, actor, carry, 3)
    assert torch.equal(following["state", "position"][:, 0], carry["state", "position"])
    assert (carry == before).all()  # it is not modified


def test_it_samples_by_default_is_deterministic_on_request_and_resets_the_carry_of_a_finished_environment(env):
    actor, carry = make_actor(env), env.reset()
    for options, is_same in (({}, False), ({"exploration_type": ExplorationType.DETERMINISTIC}, True)):
        actions = [differentiable_rollout(env, actor, carry, 2, **options)[0]["action"] for _ in range(2)]
        assert torch.equal(*actions) == is_same
    env = HoveringEnv(num_envs=2, max_episode_steps=3)
    rollout, carry = differentiable_rollout(env, make_actor(env), None, 3)
    assert rollout["next", "done"][:, -1].all()
    assert not carry["done"].any() and (carry["state", "step"] == 0).all()


def visited(rollout, *args, **options):
    """A buffer with the states of a rollout."""
    buffer = VisitedStateBuffer(*args, **options)
    buffer.extend(rollout)
    return buffer


def test_the_buffer_keeps_complete_detached_states_and_the_oldest_go_first(flight):
    env, _, rollout, _ = flight
    buffer = visited(rollout)
    assert len(buffer) == 20
    stored = buffer[:]
    assert set(stored["state"].keys()) == set(env.observation_spec["state"].keys())
    assert not any(value.requires_grad for value in stored.values(include_nested=True, leaves_only=True))
    assert torch.equal(stored["state", "position"], rollout["state", "position"].reshape(20, 3).detach())
    buffer = visited(rollout[:2], capacity=8)
    buffer.extend(rollout[2:, :3])
    assert len(buffer) == 8
    kept = {tuple(p.tolist()) for p in buffer[:]["state", "position"]}
    assert {tuple(p.tolist()) for p in rollout[2:, :3]["state", "position"].reshape(6, 3)} <= kept


def test_the_buffer_leaves_out_terminated_and_broken_states(flight):
    rollout = flight[2].detach().clone()
    rollout["terminated"][0, 1] = True
    rollout["state", "velocity"][2, 3, 0] = float("nan")
    rollout["state", "rotor_speed"][3, 0, 1] = float("inf")
    buffer = visited(rollout)
    assert len(buffer) == 17
    assert all(value.isfinite().all() for value in buffer[:].values(include_nested=True, leaves_only=True))
    rollout["state", "velocity"][:] = float("nan")
    assert buffer.extend(rollout).numel() == buffer.extend(rollout[:, :0]).numel() == 0 and len(buffer) == 17


def test_a_fraction_of_the_environments_starts_in_visited_states():
    env = HoveringEnv(num_envs=1000)
    rollout, _ = differentiable_rollout(env, make_actor(env), None, 3)
    buffer = visited(rollout[:, 1:])  # step counts 1 and 2; fresh starts have 0
    for fraction in (0.0, 0.7, 1.0):
        carry = buffer.initial_state(env, fraction)
        assert (carry["state", "step"] > 0).float().mean().item() == pytest.approx(fraction, abs=0.06)
        assert not carry["done"].any()
    carry = buffer.initial_state(env, 1.0)
    torch.testing.assert_close(carry["observation"][:, :3], carry["state", "target"] - carry["state", "position"])
    env.set_initial_state_source(buffer.source(env, fraction=1.0))
    assert (buffer.initial_state(env, 0.0)["state", "step"] == 0).all()  # fresh starts stay fresh
    assert (env.reset()["state", "step"] > 0).all()


@pytest.mark.parametrize("wrap", [False, True])
def test_resets_inside_a_horizon_start_in_visited_states_too_and_so_do_horizons_under_transforms(wrap):
    env = HoveringEnv(num_envs=50, max_episode_steps=4)
    env = TransformedEnv(env, StepCounter()) if wrap else env
    actor = make_actor(env)
    buffer = visited(differentiable_rollout(env, actor, None, 3)[0][:, 2:])
    start = buffer.initial_state(env, 1.0)
    assert not wrap or (start["step_count"] == 0).all()
    env.set_initial_state_source(buffer.source(env, fraction=1.0))
    for carry in (None, start):
        rollout, _ = differentiable_rollout(env, actor, carry, 4)
        assert (rollout["state", "step"][:, [0, 2]] == 2).all()  # after two steps the episode ends, and begins again
    env.set_initial_state_source(None)
    assert not env.reset()["state", "step"].any()


def test_a_rollout_cut_in_two_by_way_of_the_buffer_equals_the_uncut_one_to_the_last_bit():
    env = HoveringEnv(num_envs=1, action_delay=3)
    actor = make_actor(env)
    deterministic = {"exploration_type": ExplorationType.DETERMINISTIC}
    start = env.reset()
    whole, _ = differentiable_rollout(env, actor, start, 30, **deterministic)
    first, carry = differentiable_rollout(env, actor, start, 15, **deterministic)
    second, _ = differentiable_rollout(env, actor, visited(carry).initial_state(env, 1.0), 15, **deterministic)
    joined = torch.cat((first, second), 1)
    for key, value in whole.items(include_nested=True, leaves_only=True):
        if "reward_terms" not in key or key[0] == "next":  # a reset writes zeros there
            assert torch.equal(value, joined[key]), key


def test_the_buffer_is_saved_and_loaded_with_its_generator(flight, tmp_path):
    env, _, rollout, _ = flight
    buffer, *others = visited(rollout, seed=4), VisitedStateBuffer(seed=9), VisitedStateBuffer(seed=9)
    buffer.initial_state(env)
    others[0].load_state_dict(buffer.state_dict())
    buffer.dumps(tmp_path / "buffer")
    others[1].loads(tmp_path / "buffer")
    starts = []
    for each in (buffer, *others):
        env.set_seed(0)
        starts.append(each.initial_state(env, 0.5))
        assert len(each) == len(buffer)
    assert (starts[0] == starts[1]).all() and (starts[0] == starts[2]).all()


def test_what_was_never_written_stays_out_of_files(flight, tmp_path):
    files = []
    for secret in (1.0, 2.0):  # what memory held before
        buffer = visited(flight[2][:, :2], capacity=5000)
        buffer._storage._storage[8:]["state"].apply_(lambda x, secret=secret: x.fill_(secret))
        buffer.dumps(tmp_path)
        files.append((tmp_path / "buffer.pt").read_bytes())
    assert files[0] == files[1] and len(files[0]) < 20_000
    assert all(len(x) == 8 for x in buffer.state_dict()["states"].values())


def test_a_smaller_buffer_is_loaded_with_its_oldest_state_first_to_go(flight):
    small, same, large = (VisitedStateBuffer(capacity=n) for n in (8, 8, 10))
    positions = flight[2]["state", "position"].detach().reshape(-1, 3)
    states = flight[2].reshape(-1)
    small.extend(states[:8])
    small.extend(states[8:11])
    for other in (same, large):
        other.load_state_dict(small.state_dict())
        assert len(other) == 8
    assert (same[:]["state", "position"] == small[:]["state", "position"]).all()
    assert (large[:]["state", "position"] == positions[3:11]).all()
    for buffer in (small, same, large):
        buffer.extend(states[11:14])
    assert (same[:]["state", "position"] == small[:]["state", "position"]).all()
    kept = {tuple(x) for x in large[:]["state", "position"].tolist()}
    assert kept == {tuple(x) for x in positions[4:14].tolist()}


POSITION = "state.position"


def put(name, value):
    return lambda content: content["states"].update({name: value})


@cases(
    (lambda content: content.pop("cursor"), "does not fit this visited-state buffer of 30 states: 'cursor'"),
    (lambda content: content["states"].pop(POSITION), "other states .*position.* differ in name"),
    (put("state.extra", torch.ones(20, 1)), "other states .* 'extra'.* differ in name"),
    (put(POSITION, torch.ones(20, 2)), "other states .*position"),
    (put(POSITION, torch.ones(20, 3, dtype=torch.int64)), "other states .*position"),
    (put(POSITION, torch.ones(19, 3)), "does not fit .* it has 19 states, and its cursor is 20"),
    (lambda content: content.update(states={POSITION: torch.ones(31, 3)}), "of 30 states: it has 31 states"),
    (lambda content: content.update(states=[1, 2]), "does not fit"),
    (lambda content: content.update(cursor=21), "it has 20 states, and its cursor is 21"),
    (lambda content: content.update(cursor=-1), "it has 20 states, and its cursor is -1"),
    (lambda content: content.update(random=torch.ones(3)), "does not fit .*RNG state must be a torch.ByteTensor"),
)
def test_content_that_does_not_fit_is_refused_and_changes_nothing(change, message, flight):
    env, _, rollout, _ = flight
    buffer = visited(rollout[:2], 30, env)
    content, before = visited(rollout, 30, env).state_dict(), buffer.state_dict()
    change(content)
    for target in (buffer, VisitedStateBuffer(30, env)):
        assert "\n" not in refuses(message, target.load_state_dict, content, error=UserValueError)
    assert_equal(buffer.state_dict(), before)


def test_a_buffer_keeps_the_markov_state_of_any_environment():
    assert VisitedStateBuffer().state_keys == VisitedStateBuffer(env=HoveringEnv(num_envs=2)).state_keys == ("state",)
    pendulum = TransformedEnv(PendulumEnv(seed=0), StepCounter())
    buffer = VisitedStateBuffer(env=pendulum)
    assert buffer.state_keys == ("th", "thdot", "params")
    rollout, _ = differentiable_rollout(pendulum, TORQUE, None, 4)
    buffer.extend(rollout)
    assert buffer.initial_state(pendulum, 1.0)["th"] in rollout["th"]
    assert buffer.initial_state(pendulum, 0.0)["th"] not in rollout["th"]
    with pytest.raises(TypeError, match=r"PendulumEnv has no sample_start\(n\).*start horizons with buffer.init"):
        buffer.source(pendulum)


class OwnPendulum(PendulumEnv):
    """A pendulum that knows where its episodes start."""

    def sample_start(self, n):
        return self.gen_params(batch_size=[n]).update({"th": torch.full((n,), 0.5), "thdot": torch.zeros(n)})


def test_fresh_starts_come_from_an_environment_that_samples_them():
    env = OwnPendulum(seed=0)
    start = env.reset()
    buffer = visited(start, env=env)
    for fraction, angle in ((0.0, 0.5), (1.0, start["th"])):
        assert buffer.initial_state(env, fraction)["th"] == angle
        assert (buffer.source(env, fraction)(3)["th"] == angle).all()
        assert restart(env, start, 1.0 - fraction)["th"] == angle


def test_an_empty_buffer_a_bad_fraction_or_capacity_and_states_of_other_tasks_are_refused(env, flight):
    buffer = VisitedStateBuffer()
    for use in (lambda: buffer.initial_state(env), lambda: buffer.source(env)(4)):
        refuses("The visited-state buffer is empty. Fly a first horizon", use, error=RuntimeError)
    buffer.extend(flight[2])
    for use in (buffer.initial_state, buffer.source, lambda env, fraction: restart(env, flight[3], fraction)):
        for fraction, must in ((1.5, "at most 1"), (-0.1, "at least 0"), (float("nan"), "a finite number")):
            refuses(f"fraction must be {must}, got {fraction}. The share of", use, env, fraction)
    for capacity, must in ((0, "at least 1"), (2.5, "a whole number"), (10**400, "at most 10000000")):
        message = f"capacity must be {must}, got .*. Visited states kept; the oldest go fir"
        refuses(message, VisitedStateBuffer, capacity)
    buffer, message = visited(flight[2]), "These are other states than those in the visited-state buffer: .*{}.* diff"
    for other, key in ((TrackingEnv(num_envs=4), "phase"), (HoveringEnv(num_envs=4, action_delay=2), "action_queue")):
        refuses(message.format(key), buffer.initial_state, other)
        refuses(message.format(key), buffer.extend, other.rollout(2))
    assert len(buffer) == 20
    with pytest.raises(ValueError, match="keeps .'th',., and the rollout lacks 'th'. Give the buffer the environment"):
        visited(flight[2], state_keys=["th"])


def test_an_environment_that_does_not_declare_its_state_is_not_set_to_one():
    pendulum = PendulumEnv(seed=0)
    pendulum.state_spec = None
    message = "PendulumEnv cannot be set to a state: its state_spec is empty. Declare the entries of its Mark"
    _, carry = differentiable_rollout(pendulum, TORQUE, None, 4)
    refuses(message, restart, pendulum, carry, 0.5)
    refuses(message, VisitedStateBuffer, 8, pendulum)


@pytest.mark.parametrize("wrap", [False, True])
def test_a_restart_begins_a_fraction_of_the_flights_afresh_and_lets_the_others_go_on(wrap):
    env = HoveringEnv(num_envs=1000)
    env = TransformedEnv(env, StepCounter()) if wrap else env
    _, carry = differentiable_rollout(env, make_actor(env), None, 3)
    env.set_initial_state_source(lambda n: carry["state"])  # fresh starts are the task's own all the same
    for fraction in (0.0, 0.3, 1.0):
        after = restart(env, carry, fraction)
        fresh = (after["state", "step"] == 0).flatten()
        assert fresh.float().mean().item() == pytest.approx(fraction, abs=0.06)
        assert (after["state"][~fresh] == carry["state"][~fresh]).all()
        torch.testing.assert_close(after["observation"][~fresh], carry["observation"][~fresh])
    with pytest.raises(ValueError, match="restart needs the whole state, .*, and the carry lacks .*'action_queue'."):
        restart(env, carry.exclude("state"), 0.5)
    refuses(r"The carry has batch size \(10,\), and the environment \(1000,\)", restart, env, carry[:10], 0.5)


def test_flights_without_a_batch_of_their_own_restart_as_the_error_advises():
    alone, batch = PendulumEnv(seed=0), TransformedEnv(PendulumEnv(seed=0), BatchSizeTransform(batch_size=[8]))
    _, carry = differentiable_rollout(batch, TORQUE, None, 3)
    refuses(r"\(8,\), and the environment \(\)\. .* TorchRL's BatchSizeTransform", restart, alone, carry, 0.5)
    torch.testing.assert_close(restart(batch, carry, 0.0)["th"], carry["th"])
    assert (restart(batch, carry, 1.0)["th"] != carry["th"]).all()
