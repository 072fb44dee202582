"""The environment: specs, resets, ends, seeds and delay; broken environments crash alone, and reach no others."""

import inspect
import io

import pytest
import torch
from helpers import FLOWN, anew, cases, fly, hold, look_at_nothing, refuses, start
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv, check_env_specs

from torchrl_quad import ActionSequence, HoveringEnv, differentiable_rollout, load_drone, make_actor, make_env
from torchrl_quad.dynamics import INTEGRATORS
from torchrl_quad.envs import TASKS

OTHER = {"integrator": "rk4", "drone": "small_racer", "control_dt": 0.01, "observe_last_action": True}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("options", [{"action_delay": 0}, {"action_delay": 3}, OTHER])
def test_specs_hold_with_any_precision_delay_and_observation(dtype, options):
    env = HoveringEnv(num_envs=3, dtype=dtype, max_episode_steps=7, **options)
    check_env_specs(env, break_when_any_done="both")
    seen = env.rollout(2)["observation"]
    assert seen.dtype is dtype and seen.shape == (3, 2, 13 + 4 * env.observe_last_action)
    assert ("action_queue" in env.reset()["state"]) == (env.action_delay > 0)


def test_the_reward_is_the_paper_s_formula_and_the_observation_ten_times_the_paper_s(env64):
    flight = env64.rollout(5)
    state = flight["next", "state"]
    level = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)

    def norm(x):
        return x.norm(dim=-1, keepdim=True)

    expected = (
        0.1
        - 0.1 / 9 * norm(state["position"] - torch.tensor([1.0, 0.0, 1.5], dtype=torch.float64))
        - 1e-5 * norm(state["quaternion"] - level)
        - 0.002 * norm(state["velocity"])
        - 0.002 * norm(state["angular_velocity"])
    )
    torch.testing.assert_close(flight["next", "reward"], expected)
    seen = state["target"] - state["position"], 10 * state["quaternion"], state["velocity"], state["angular_velocity"]
    torch.testing.assert_close(flight["next", "observation"], torch.cat(seen, -1))
    assert all((term == 0).all() for term in env64.reset()["reward_terms"].values())


def test_starts_lie_in_their_box_level_and_at_rest():
    td = HoveringEnv(num_envs=2000, seed=3).reset()
    offset = (td["state", "position"] - torch.tensor([1.0, 0.0, 1.5])).abs().amax(0)
    assert (offset <= torch.tensor([1.0, 1.0, 0.5])).all() and (offset > torch.tensor([0.98, 0.98, 0.49])).all()
    assert (td["state", "velocity"] == 0).all()
    assert (td["state", "quaternion"] == torch.tensor([1.0, 0.0, 0.0, 0.0])).all()


def test_leaving_the_box_terminates():
    outside = [(1, 0, -0.1), (1, 0, 6.1), (6.1, 0, 1.5), (-4.1, 0, 1.5), (1, 5.1, 1.5), (1, -5.1, 1.5)]
    env = HoveringEnv(num_envs=7)
    ends = fly(env, start(env, position=[*outside, (1, 0, 1.5)]), hold(env, 1))["next"][:, 0]
    assert ends["terminated"].flatten().tolist() == [True] * 6 + [False]
    assert not ends["truncated"].any() and torch.equal(ends["done"], ends["terminated"])


def test_the_controller_keeps_its_drone_and_the_one_that_flies_is_fitted_in_place_or_set_through_transforms(env64):
    mass = torch.nn.Parameter(torch.tensor([0.46]))
    env = HoveringEnv(num_envs=1, drone=load_drone().replace(mass=mass))
    assert env.params.mass is mass
    mass.data.mul_(2.0)
    assert env.nominal.mass.item() == pytest.approx(0.46)
    others = [HoveringEnv(num_envs=1, drone=load_drone()) for _ in range(2)]
    assert others[0].params.mass is not others[1].params.mass
    wrapped = TransformedEnv(env64, StepCounter())
    mass = torch.tensor([0.9], requires_grad=True)
    wrapped.set_params(load_drone("visfly").replace(mass=mass))
    assert env64.params.mass.dtype is torch.float64
    height = wrapped.rollout(3, make_actor(env64))["next", "state", "position"][..., 2]
    assert torch.autograd.grad(height.sum(), mass)[0] < 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_everything_moves_to_the_gpu():
    env = HoveringEnv(num_envs=4).to("cuda")
    check_env_specs(env)
    assert env.rollout(3)["next", "reward"].device.type == "cuda"
    assert HoveringEnv(num_envs=4, device="cuda").rollout(3).device.type == "cuda"


def test_the_signature_of_a_task_names_every_argument():
    arguments = inspect.signature(TASKS["racing"]).parameters
    own = {"track", "reward", "gate_bonus"}
    assert own | {"num_envs", "seed", "drone", "dynamics", "wind", "disturbances", "compile"} <= set(arguments)
    kinds = {argument.kind for argument in arguments.values()}
    assert not kinds & {inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL}


def test_episode_metrics_judge_the_first_episode_by_its_last_second():
    env = HoveringEnv(num_envs=3, max_episode_steps=60)
    places = [(1.0, 0.0, 1.5), (1.2, 0.0, 1.5), (1.0, 0.0, 5.99)]  # the second hovers beside the target
    td = start(env, position=places, velocity=[(0, 0, 0), (0, 0, 0), (0, 0, 5)])  # the third leaves, and starts again
    flight, _ = differentiable_rollout(env, ActionSequence(env.hover_action.expand(60, 3, 4)), td, 60)
    metrics = env.episode_metrics(flight)
    assert metrics["solved"].tolist() == [1.0, 0.0, 0.0] and metrics["crash"].tolist() == [0.0, 0.0, 1.0]
    assert metrics["position_error"].tolist() == pytest.approx([0.0, 0.2, 4.6], abs=0.1)
    assert metrics["return"].tolist() == pytest.approx([6.0, 60 * (0.1 - 0.2 * 0.1 / 9), 0.04], abs=0.01)


# -- moving: the device cpu:0 stands for any other one, whose generator restarts ---------------------------------------

OPTIONS = {"num_envs": 4, "seed": 5, "dtype": torch.float64, "randomize": {"mass": {"scale": [0.8, 1.2]}}}
OPTIONS |= {"wind": {"mean": [1.0, 0.0, 0.0], "gust": 0.5}, "observation_noise": {"position": 0.01}}
OPTIONS |= {"scene": {"spheres": [{"count": 2, "low": [-1, -1, 0], "high": [1, 1, 3], "radius": 0.1}]}}
OPTIONS |= {"camera": {"width": 3, "height": 2, "noise": 0.01}}


def assert_equal(one, other):
    one, other = (dict(td.items(include_nested=True, leaves_only=True)) for td in (one, other))
    assert one.keys() == other.keys()
    assert [key for key, x in one.items() if not torch.equal(x.cpu(), other[key].cpu())] == []


def fly_on(env, steps):
    return env.rollout(steps, lambda td: td.set("action", env.hover_action.expand(env.num_envs, 4)))


def test_an_environment_that_moves_keeps_its_drone_and_restarts_from_its_seed():
    moved, fresh = HoveringEnv(**OPTIONS), HoveringEnv(**OPTIONS)
    for env in (moved, fresh):
        env.params = env.params.replace(motor_time_constant=0.05)
    fly_on(moved, 3)
    assert moved.to("cpu:0") is moved and moved.device == moved.randomness.device == torch.device("cpu:0")
    (lag,), (nominal,) = (x.motor_time_constant.unique().tolist() for x in (moved.params, moved.nominal))
    assert lag == 0.05 != nominal == fresh.nominal.motor_time_constant.unique().item()
    for _ in range(2):  # the second episode draws on
        assert_equal(fly_on(moved, 5), fly_on(fresh, 5))
    check_env_specs(moved)
    nominal = HoveringEnv(num_envs=2, max_episode_steps=7).to("cpu:0")
    assert nominal.params is nominal.nominal and nominal.rollout(9)["next", "state", "step"].flatten().max() == 7


def test_an_environment_stays_compiled_where_it_moves_until_it_is_made_eager():
    env, fresh = (HoveringEnv(num_envs=2, camera={"width": 3, "height": 2}, scene={"ground": True}) for _ in range(2))
    assert env.compile(backend="eager") is env and env.is_compiled
    assert env.to("cpu:0").is_compiled and env.disturbances["camera"].is_compiled
    assert env.eager() is env and not (env.is_compiled or env.disturbances["camera"].is_compiled)
    assert_equal(fly_on(env, 3), fly_on(fresh, 3))


# Flights that crash after some ten steps, each in its own time.
RESTLESS = {"num_envs": 8, "dtype": torch.float64, "seed": 3, "random_start": {"tilt": 3.0, "velocity": 20.0}}
RESTLESS |= {"wind": {"gust": 2.0}, "observation_noise": {"position": 0.1, "velocity": 0.1}}
ONCE = {"auto_reset": False, "break_when_any_done": False}
POLICY = TensorDictModule(lambda x: x[:, :4].sin(), in_keys=["observation"], out_keys=["action"])
STEPS = 80


def by_hand(env, start, steps):
    flight, td = [], start
    for _ in range(steps):
        stepped, td = env.step_and_maybe_reset(POLICY(td))
        flight.append(stepped)
    return torch.stack(flight, 1)


@pytest.mark.parametrize("device", ["a processor", "an accelerator"])
def test_one_seed_gives_one_flight_however_it_is_flown(device, monkeypatch):
    if device == "an accelerator":
        look_at_nothing(monkeypatch)
    env = HoveringEnv(**RESTLESS)
    expected = env.rollout(STEPS, POLICY, tensordict=env.reset(), **ONCE)
    assert expected["next", "done"].sum() > 20

    other = HoveringEnv(**RESTLESS)
    flights = {"TorchRL's loop": EnvBase.rollout(other, STEPS, POLICY, tensordict=other.reset(), **ONCE)}
    other = HoveringEnv(**RESTLESS)
    flights["by hand"] = by_hand(other, other.reset(), STEPS)
    other = TransformedEnv(HoveringEnv(**RESTLESS), Compose(StepCounter(), RewardSum()))
    flights["transformed"] = other.rollout(STEPS, POLICY, tensordict=other.reset(), **ONCE)
    other = HoveringEnv(**RESTLESS)
    td, halves = other.reset(), []
    for steps in (13, STEPS - 13):
        halves.append(other.rollout(steps, POLICY, tensordict=td, **ONCE))
        td = other.maybe_reset(other.step_mdp(halves[-1][:, -1]))
    flights["in two parts"] = torch.cat(halves, 1)
    for name, flight in flights.items():
        for key, x in expected.items(include_nested=True, leaves_only=True):
            torch.testing.assert_close(flight[key], x, msg=f"{name}: {key}")


def test_episodes_that_end_soon_start_at_another_state_each_time():
    env = HoveringEnv(num_envs=6, max_episode_steps=3)
    td = env.reset()
    td["state", "step"] = torch.tensor([[0], [1], [2], [0], [1], [2]])  # they end in different steps
    start = env.reset(td, set_state=True)
    flight = env.rollout(31, POLICY, tensordict=start, **ONCE)
    begins = flight["state", "step"][:, 1:, 0] == 0
    for positions, begin in zip(flight["state", "position"][:, 1:], begins, strict=True):
        assert begin.sum() >= 10 and len(positions[begin].unique(dim=0)) == begin.sum()


@pytest.mark.parametrize("steps", [5, 45])
def test_a_flight_goes_on_bit_for_bit_from_a_saved_random_state(steps):
    env = TransformedEnv(HoveringEnv(**RESTLESS), StepCounter())
    first = env.rollout(steps, POLICY, tensordict=env.reset(), **ONCE)
    carry = env.maybe_reset(env.step_mdp(first[:, -1]))
    saved = io.BytesIO()
    torch.save({"random": env.random_state(), "state": carry["state"].to_dict()}, saved)
    saved.seek(0)
    expected = env.rollout(50, POLICY, tensordict=carry.clone(), **ONCE)

    loaded = torch.load(saved, weights_only=True)
    again = TransformedEnv(HoveringEnv(**{**RESTLESS, "seed": 99}), StepCounter())
    again.rollout(7, POLICY, break_when_any_done=False)
    start = again.reset(TensorDict({"state": loaded["state"]}, [8]), set_state=True)
    again.set_random_state(loaded["random"])
    for _ in range(2):  # what was loaded can be loaded again
        flight = again.rollout(50, POLICY, tensordict=start.clone(), **ONCE)
        for key in (("state", "position"), ("state", "wind"), "observation", ("next", "reward")):
            assert torch.equal(flight[key], expected[key]), key
        again.set_random_state(loaded["random"])


def test_flights_repeat_with_the_seed_whatever_the_global_generator_does():
    def starts(seed, disturb):
        env = HoveringEnv(num_envs=4, seed=seed)
        torch.manual_seed(disturb)
        first = env.reset()["state", "position"]
        torch.rand(disturb)
        assert env.to("cpu") is env  # a move to where it is leaves the generator alone
        second = env.reset()["state", "position"]
        env.set_seed(seed)
        assert torch.equal(env.reset()["state", "position"], first)
        return torch.stack((first, second))

    assert torch.equal(starts(5, 1), starts(5, 2))
    assert not torch.equal(starts(5, 1), starts(6, 1)) and not torch.equal(*starts(5, 1))
    before = torch.get_rng_state()
    HoveringEnv(num_envs=4).reset()
    assert torch.equal(torch.get_rng_state(), before)


nan = float("nan")
LARGEST = torch.iinfo(torch.int64).max
RANDOM = {"randomize": {"mass": {"scale": [0.9, 1.1]}, "thrust_map": {"scale": [0.9, 1.1]}}, "wind": {"gust": 0.5}}


def gradients_of_the_first(env, key=None, value=None):
    """Of the rewards of environment 0, in the mass and a policy's weights, beside a neighbour with this entry."""
    mass = env.nominal.mass.clone().requires_grad_()
    env.params = env.nominal.replace(mass=mass)
    actor, td, rewards, crashes = make_actor(anew(env)), env.reset(), [], []
    if key is not None:
        td["state", key][1] = torch.as_tensor(value)
    for _ in range(3):
        td = actor(td.copy())
        stepped = env.step(td.set("action", td["loc"].tanh()))
        rewards.append(stepped["next", "reward"][0])
        crashes.append(stepped["next", "crash"].flatten().tolist())
        td = env.step_mdp(stepped)
    weights = [p for p in actor.parameters() if p.requires_grad]
    grads = torch.autograd.grad(sum(rewards).sum(), [mass, *weights], allow_unused=True)
    return torch.cat([g.flatten() for g in grads if g is not None]), crashes


@pytest.mark.parametrize("drone", FLOWN)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_neighbour_that_breaks_does_not_reach_what_all_share(drone, integrator):
    env = HoveringEnv(num_envs=2, drone=drone, integrator=integrator, action_delay=0)
    expected, crashes = gradients_of_the_first(env)
    assert not any(map(any, crashes))
    # Within the bounds, and far beyond them.
    for key, value in (("angular_velocity", 99.0), ("angular_velocity", 999.0), ("velocity", [299.0, -299.0, 299.0])):
        found, crashes = gradients_of_the_first(env, key, value)
        assert crashes[0] == [False, True], (key, value)
        torch.testing.assert_close(found, expected, msg=f"{key} {value}")


def test_a_drone_whose_numbers_would_overflow_is_refused():
    tiny = {"mass": 0.0, "inertia": [1e-30] * 3, "motor_time_constant": 1e-9, "gravity": -9.81}
    for field, value in [("mass", 1e9), *tiny.items()]:
        refuses(f"field '{field}' must be between .*, in SI units; got", load_drone().replace, **{field: value})


BROKEN = {"velocity": [nan, 1e30], "position": [float("inf"), 1e30], "target": [1e30], "angular_velocity": [-1e12]}
BROKEN |= {"quaternion": [1e30, 0.0], "rotor_speed": [nan, 1e12, -1e9], "wind": [1e5], "mean_wind": [nan]}
BROKEN |= {("drone", "inertia"): [1e-30], ("drone", "motor_time_constant"): [0.0], ("drone", "thrust_map"): [0.0]}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in BROKEN.items() for value in values])
def test_a_broken_state_terminates_and_leaks_nothing_into_the_others(dtype, key, value):
    drawn = {name: {"scale": [0.9, 1.1]} for name in ("inertia", "motor_time_constant", "thrust_map")}
    env = HoveringEnv(num_envs=4, seed=1, dtype=dtype, randomize=drawn, wind={"gust": 0.5})
    action = (env.hover_action.expand(4, 4) + 0.1).clone().requires_grad_()
    mass = torch.tensor(0.46, dtype=dtype, requires_grad=True)
    env.params = env.params.replace(mass=mass)

    def gradients(td):
        env.set_seed(0)
        flight = fly(env, td, [action] * 3)
        for entry, x in flight["next"].items(include_nested=True, leaves_only=True):
            assert x.isfinite().all(), entry
        loss = flight["next", "reward"][[0, 1, 3]].sum() + 0.0 * flight["next", "reward"][2].sum()
        return flight, torch.autograd.grad(loss, (action, mass))

    td = env.reset()
    clean, (clean_action, clean_mass) = gradients(td)
    broken = td.clone()
    broken["state", key][2] = value
    flight, (broken_action, broken_mass) = gradients(broken)
    first = flight["next"][:, 0]
    assert first["terminated"].flatten().tolist() == [False, False, True, False] and not first["success"][2]
    assert first["reward"][2] == 0
    assert torch.equal(flight["next", "reward"][[0, 1, 3]], clean["next", "reward"][[0, 1, 3]])
    assert torch.equal(broken_action[[0, 1, 3]], clean_action[[0, 1, 3]]) and broken_action.isfinite().all()
    torch.testing.assert_close(broken_mass, clean_mass)


@pytest.mark.parametrize(("delay", "value"), [(1, 1e30), (0, 1e7)])  # the second within what rates are clamped to
def test_an_action_beyond_all_bounds_terminates_its_own_environment_only(delay, value):
    env = HoveringEnv(num_envs=4, action_delay=delay)
    action = env.hover_action.expand(4, 4).clone()
    action[1, 2] = value
    action.requires_grad_()
    flight = fly(env, env.reset(), [action] * 2)
    assert flight["next", "terminated"][:, 0].flatten().tolist() == [False, True, False, False]
    assert flight["next", "observation"].isfinite().all()
    (grad,) = torch.autograd.grad(flight["next", "reward"].sum(), action)
    assert grad.isfinite().all() and grad.any(1).tolist() == [True, False, True, True]


@cases(
    ("hovering", ("drone", "mass"), 0.0, r"\('drone', 'mass'\) must be finite and between 0.001 and 1000"),
    ("hovering", "wind", 1e5, "'wind' must be finite and between -300 and 300"),
    ("hovering", "position", nan, "'position' must be finite and between"),
    ("hovering", "quaternion", 0.9, "'quaternion' must have unit norm"),
    ("hovering", "rotor_speed", -1e5, "'rotor_speed' must be finite and between"),
    ("hovering", "action_queue", nan, "'action_queue' must be finite and between"),
    ("hovering", "step", LARGEST, "'step' must lie between 0 and 2147483648"),
    ("racing", "gate", -1, "'gate' must lie between 0 and 3"),
    ("racing", "pass_step", -2, "'pass_step' must lie between -1"),
    ("tracking", "phase", 100.0, "'phase' must lie between 0 and 6.283"),
)
def test_an_entry_out_of_its_range_is_refused_by_name_and_environment(task, key, value, message):
    env = make_env(task, num_envs=4, **RANDOM)
    td = env.reset()
    td["state", key][2] = value
    refuses(f"no drone can fly from the state of environments 2: {message}", env.reset, td.copy(), set_state=True)
    env.set_initial_state_source(lambda n: td["state"])
    refuses(f"initial_state_source: no drone can fly .* environments 2: {message}", env.reset)
    others = torch.tensor([[True], [True], [False], [True]])
    env.reset(td.copy().set("_reset", others), set_state=True)  # nobody asks for environment 2


def test_an_entry_of_another_kind_is_refused():
    env, whole, floating = make_env("racing", num_envs=4), "whole numbers", "floating point"
    wrong = [("step", torch.float32, whole), ("gate", torch.float64, whole), ("velocity", torch.int64, floating)]
    for key, dtype, kind in [*wrong, ("gate_passed", torch.int64, "bool"), ("velocity", torch.complex64, floating)]:
        td = env.reset()
        td["state", key] = td["state", key].to(dtype)
        refuses(f"state '{key}' must be {kind}, got {dtype}", env.reset, td, set_state=True)


def test_a_state_that_is_not_whole_is_refused_by_a_step_a_rollout_a_reset_and_as_a_start(env):
    actor, td = make_actor(env), env.reset()
    short = td.clone()
    short["state", "velocity"] = torch.zeros(4, 2)
    for wrong, message in (
        (td.exclude("state"), r"a state is a tensordict, such as env.reset\(\)\[.state.\]; got NoneType"),
        (td.exclude(("state", "velocity")), "the state lacks velocity. A state is restored whole"),
        (TensorDict({**td, "state": torch.zeros(4, 3)}, [4]), "a state is a tensordict, such as .* got Tensor"),
        (short, r"state 'velocity' has shape \(4, 2\), expected \(4, 3\)"),
    ):
        refuses(message, env.step, wrong.copy().set("action", torch.zeros(4, 4)))
        refuses(message, differentiable_rollout, env, actor, wrong, 2)
        if "state" in wrong:
            refuses(message, env.reset, wrong.copy(), set_state=True)
    refuses('needs a tensordict with the state to set in "state"; got none', env.reset, set_state=True)
    with pytest.raises(ValueError, match="initial_state_source must be a function from a number n to n states.*got Te"):
        env.set_initial_state_source(env.reset())
    state = env.reset()["state"]
    for wrong, message in ((state[:2], r"has shape \(2, 3\), expected \(4, 3\)"), (torch.zeros(4), "got Tensor")):
        env.set_initial_state_source(lambda n, wrong=wrong: wrong)
        refuses(f"initial_state_source: .*{message}", env.reset)


def test_a_reset_copies_and_converts_a_state_of_a_precision_or_device_that_a_step_refuses(env):
    td = env.reset()
    state = td["state"].apply(lambda x: x.double() if x.is_floating_point() else x)
    double = TensorDict({"state": state, "action": torch.zeros(4, 4)}, [4])
    elsewhere = TensorDict({"state": td["state"].to("meta"), "action": torch.zeros(4, 4)}, [4])
    for wrong, message in ((double, "torch.float64 on cpu"), (elsewhere, "torch.float32 on meta")):
        refuses(f"state 'position' is {message}, and this environment torch.float32 on", env.step, wrong)
    with pytest.raises(ValueError, match="on meta, and that of the environment torch.float32 on cpu"):
        differentiable_rollout(env, make_actor(env), td.to("meta"), 2)
    assert env.reset(double, set_state=True)["state", "position"].dtype is torch.float32
    kept = td["state"].clone()
    env.set_initial_state_source(lambda n: td["state"])
    env.reset()["state", "position"][0] = 99.0
    env.reset(td.clone(recurse=False), set_state=True)["state", "position"][0] = 99.0
    assert (td["state"] == kept).all()
