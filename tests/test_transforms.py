"""Transforms that fly inside, against TorchRL's own loop, and observations normalised by running statistics."""

import pytest
import torch
from helpers import on_plain_tensors, refuses
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase, ExplorationType, TransformedEnv, VecNormV2, check_env_specs, set_exploration_type
from torchrl.envs import transforms as T

from torchrl_quad import HoveringEnv, ObservationNormalizer, differentiable_rollout, make_actor, make_visual_actor
from torchrl_quad.data import flight_mode
from torchrl_quad.data.transforms import normalized, transforms_of, under_transforms
from torchrl_quad.objectives.calls import action_gradient

OBSERVATION = ["observation"]
COUNTED = ["observation", "step_count", "is_init"]


def normalizer(key="observation", size=13, **keys):
    loc, scale = torch.linspace(-1, 1, size).double(), torch.linspace(0.5, 2, size).double()
    return T.ObservationNorm(loc, scale, in_keys=[key], standard_normal=True, **keys)


def frames(count, key="observation", out_keys=None, **padding):
    return T.CatFrames(count, -1, [key], out_keys, **padding)


TRANSFORMS = {
    "scaled reward": lambda: T.RewardScaling(0.3, 2.0),
    "clipped reward": lambda: T.RewardClipping(-0.2, 0.1),
    "sum": T.RewardSum,
    "sum of clipped": lambda: T.Compose(T.RewardScaling(0.1, 3.0), T.RewardSum(), T.RewardClipping(-0.2, 0.1)),
    "target": lambda: T.TargetReturn(7.0),
    "constant target": lambda: T.TargetReturn(7.0, mode="constant"),
    "steps": T.StepCounter,
    "starts": T.InitTracker,
    "trajectories": T.TrajCounter,
    "normalised": normalizer,
    "copied": lambda: normalizer(out_keys=["seen"]),
    "concatenated": lambda: T.CatTensors(["observation", ("state", "velocity")], "features", del_keys=False),
    "concatenated alone": lambda: T.CatTensors(["observation"], "features"),
    "clipped": lambda: T.ClipTransform(in_keys=OBSERVATION, low=-0.5, high=1.0),
    "cast": lambda: T.DTypeCastTransform(torch.float64, torch.float32, in_keys=OBSERVATION, in_keys_inv=["action"]),
    "all of float": T.DoubleToFloat,
    "scaled action": lambda: T.ActionScaling(loc=torch.tensor(0.1).double(), scale=torch.tensor(0.7).double()),
    "clipped action": lambda: T.ClipTransform(in_keys_inv=["action"], in_keys=[], low=-0.1, high=0.3),
    "renamed": lambda: T.RenameTransform(["observation"], ["seen"]),
    "frames": lambda: frames(3),
    "frames after a number": lambda: frames(2, padding="constant", padding_value=0.5),
    "frames of frames": lambda: T.Compose(frames(2), normalizer(size=26), frames(3)),
    "clipped frames": lambda: T.Compose(frames(3), T.ClipTransform(in_keys=OBSERVATION, low=-0.5, high=1.0)),
    "frames of an entry": lambda: frames(3, ("state", "velocity"), ["seen"]),
    "limited": lambda: T.StepCounter(max_steps=3),
    "limited twice": lambda: T.Compose(T.StepCounter(max_steps=4), T.StepCounter(3, step_count_key="more")),
    "read": lambda: T.Compose(T.RewardScaling(0.3, 2.0), T.TargetReturn(7.0), T.RewardSum()),
    "counted": lambda: T.Compose(T.StepCounter(7), T.InitTracker(), T.CatTensors(COUNTED, "seen", del_keys=False)),
    "left out": lambda: T.ExcludeTransform(("metrics", "position_error"), "success"),
    "selected": lambda: T.SelectTransform("observation", *HoveringEnv().state_keys, ("reward_terms", "velocity")),
}


KEYS = {"copied": ["seen"], "renamed": ["seen"], "concatenated": ["features"], "concatenated alone": ["features"]}
KEYS |= {"frames of an entry": ["observation", "seen"], "counted": ["seen"]}
KEYS |= {"read": ["observation", "target_return", "episode_reward"]}
WITHIN = {"scaled reward", "clipped reward", "sum", "target", "steps", "starts", "normalised", "clipped", "frames"}
WITHIN |= {"limited"}  # which others hold


def fly(env, actor, *, inside):
    """Two horizons with a gradient of all that has one; by TorchRL's loop, or only if it does not help."""
    with pytest.MonkeyPatch.context() as patch:
        if inside:
            patch.setattr(TransformedEnv, "rollout", None)
        else:
            patch.setattr("torchrl_quad.data.rollout.under_transforms", lambda env, actor: "not wanted")
            patch.setattr(HoveringEnv, "rollout", EnvBase.rollout)
        env.set_seed(1)
        for transform in transforms_of(env):
            if isinstance(transform, T.TrajCounter):
                transform._traj_count.value = 0
        torch.manual_seed(1)
        first, carry = differentiable_rollout(env, actor, env.reset(), 4)
        rollout, carry = differentiable_rollout(env, actor, carry, 9)
    loss = 0.0
    for flight in (first, rollout):
        for _, x in sorted(flight.items(True, True), key=lambda item: str(item[0])):
            if x.requires_grad and x.is_floating_point():
                loss = loss + (x.double() * torch.linspace(0.5, 1.5, x.numel()).double().view_as(x)).sum()
    flown = {i: dict(x.items(True, True)) for i, x in enumerate((first, rollout, carry))}
    assert rollout["next", "done"].any() and rollout.names == [None, "time"]
    of_actions = action_gradient(loss, rollout["action"])
    return flown, of_actions, torch.autograd.grad(loss, list(actor.parameters()))


def check(transform, in_keys=("observation",), *, coarse=False, recurrent=False, backend=None, **options):
    base = HoveringEnv(num_envs=3, max_episode_steps=5, dtype=torch.float64, **options)
    env = TransformedEnv(base, transform)
    options = {"recurrent": True, "hidden_size": 5, "noise_correlation": 0.4} if recurrent else {}
    actor = make_actor(env, (8, 7), in_keys=list(in_keys), return_log_prob=True, **options)
    if recurrent:
        env = TransformedEnv(base, T.Compose(transform.clone(), T.InitTracker(), actor.make_tensordict_primer()))
    expected = fly(env, actor, inside=False)
    if backend:
        base.compile(backend=backend)
    assert flight_mode(env, actor).mode == ("inside" if backend else "called")
    found = fly(env, actor, inside=True)
    torch.testing.assert_close(found, expected, **({"rtol": 2e-4, "atol": 2e-5} if coarse else {}))


@pytest.mark.parametrize("name", [name for name in TRANSFORMS if name not in WITHIN])
def test_each_transform_flies_inside_with_torchrl_s_numbers_and_gradients(name):
    check(TRANSFORMS[name](), KEYS.get(name, OBSERVATION), coarse=name in ("cast", "all of float"))


def test_a_memory_flies_under_transforms():
    check(T.Compose(normalizer(), T.RewardSum()), recurrent=True)


@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_transforms_and_memory_fly_inside_the_compiled_step(backend):
    both = T.CatTensors(["observation", ("state", "rotor_speed")], "both", del_keys=False)
    read = [both, normalizer("both", 17), T.ClipTransform(in_keys=["both"], low=-3.0, high=3.0), frames(3, "both")]
    paid = [T.RewardScaling(0.1, 3.0), T.RewardSum(), T.TargetReturn(7.0), T.StepCounter(max_steps=3)]
    transforms = T.Compose(*read, *paid, TRANSFORMS["scaled action"]())
    keys = ["both", ("state", "velocity"), "target_return", "step_count"]
    one = {"control_dt": 0.005, "integrator": "euler", "action_delay": 0}  # a physics step
    check(transforms, keys, recurrent=True, backend=backend, wind={"gust": 0.5}, **one)


@settings(max_examples=6, deadline=None)
@given(
    st.lists(st.sampled_from([name for name in TRANSFORMS if name not in {*KEYS, "cast", "all of float"}]), max_size=5),
    st.sets(st.sampled_from(["step_count", "target_return", "episode_reward", "is_init"])),
)
def test_any_order_of_transforms_flies_inside_with_torchrl_s_numbers(names, counters):
    env = HoveringEnv(num_envs=2, dtype=torch.float64)
    env = TransformedEnv(env, T.Compose(*(TRANSFORMS[name]() for name in names)))
    try:
        env.rollout(2)
    except (IndexError, KeyError, NotImplementedError, RuntimeError):
        assume(False)  # TorchRL itself cannot fly it
    reason = flight_mode(env, make_actor(env)).reason
    assume(not any(x in reason for x in ("drops it before the next", "is written before, by another", "clips frames")))
    counters &= set(env.observation_spec.keys())
    check(T.Compose(*(TRANSFORMS[name]() for name in names)), ["observation", *sorted(counters)])


def test_what_flies_in_torchrl_s_loop_says_why():
    def reason(*transforms, policy=None, compile=True):
        env = TransformedEnv(HoveringEnv(num_envs=2, compile=compile), T.Compose(*transforms))
        return flight_mode(env, policy or make_actor(env, (8,)))

    assert reason(T.RewardSum()) == ("inside", "")
    assert reason(compile=False).reason.startswith("the environment is not compiled")
    assert reason(T.StepCounter(max_steps=5)) == ("inside", "")
    assert reason(T.RewardSum(), T.FrameSkipTransform(2)).reason.startswith("FrameSkipTransform is none of")
    assert "'step_count' is written before" in reason(T.StepCounter(max_steps=3), T.StepCounter(max_steps=4)).reason
    clip = T.ClipTransform(in_keys=OBSERVATION, low=-0.5, high=1.0)
    for of_frames in ((TRANSFORMS["frames of frames"](), clip), (frames(2), normalizer(size=26), clip.clone())):
        assert "it clips frames of frames, or frames that" in reason(T.RewardSum(), *of_frames).reason
    for drops in (T.ExcludeTransform("step_count"), T.RenameTransform(["step_count"], ["n"])):
        assert reason(T.StepCounter(), drops).reason.startswith("'step_count' is counted in a step, and a later")
    env, flights = HoveringEnv(num_envs=2), []
    for flown in (env, TransformedEnv(env, T.FrameSkipTransform(3))):  # it flies no further, as docs/engine.md says
        env.set_seed(0)
        flights.append(flown.rollout(2, actions=env.hover_action.expand(2, 2, 4))["next"])
    torch.testing.assert_close(flights[1]["state"].to_dict(), flights[0]["state"].to_dict(), rtol=0, atol=0)
    torch.testing.assert_close(flights[1]["reward"], 3 * flights[0]["reward"])
    reads = TensorDictModule(lambda x, y: x[:, :4].tanh(), ["observation", "step_count"], ["action"])
    assert reason(T.StepCounter(), policy=reads).mode == "called"
    reads.in_keys[1] = "traj_count"
    assert reason(T.TrajCounter(), policy=reads) == ("loop", "the policy reads 'traj_count', which is counted outside")
    called = TensorDictModule(lambda x: x[:, :4].tanh(), ["observation"], ["action"])
    assert reason(T.RewardSum(), policy=called).reason.startswith("TensorDictModule has no form on plain tensors")


def test_of_what_a_policy_reads_the_image_alone_has_no_gradient_whatever_it_is_called():
    base = HoveringEnv(num_envs=2, camera={"width": 6, "height": 4})

    def without_gradient(*transforms, make=make_actor, **options):
        env = TransformedEnv(base, T.Compose(*transforms))
        plain = under_transforms(env, make(env, (5,), **options)).policy.plain()
        plain.without_gradient = base.control_step.constants
        return plain.without_gradient

    stacked = T.CatFrames(3, -3, ["depth"], ["images"])
    assert without_gradient(stacked, make=make_visual_actor, image_key="images") == {"images"}
    renamed = T.ExcludeTransform("depth"), T.RenameTransform(["observation"], ["depth"])
    assert without_gradient(*renamed, in_keys=["depth"]) == set()


def test_the_first_step_reads_what_the_start_says():
    base = HoveringEnv(num_envs=2, dtype=torch.float64)
    env = TransformedEnv(base, T.Compose(normalizer(), T.ExcludeTransform("success")))
    start, actor = env.reset(), make_actor(env, (8,))
    start["observation"] = start["observation"] + 1.0
    rollout, _ = differentiable_rollout(env, actor, start, 2, exploration_type=ExplorationType.DETERMINISTIC)
    assert torch.equal(rollout["observation"][:, 0], start["observation"])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(rollout["action"][:, 0], actor(start.copy())["action"])


def test_the_normalizer_s_statistics_are_those_of_all_observations_seen():
    base = HoveringEnv(num_envs=8, dtype=torch.float64)
    normalizer = ObservationNormalizer(base, min_scale=1e-4)
    env = TransformedEnv(base, normalizer)
    check_env_specs(env)
    actor, seen, carry = make_actor(env), [], None
    for _ in range(3):
        rollout, carry = differentiable_rollout(env, actor, carry, 7)
        seen.append(base.observe(rollout["next", "state"].reshape(-1)).detach())
        normalizer.update(rollout)
        carry = env.reset(carry.select("state"), set_state=True)
        expected = normalizer._apply_transform(base.observe(carry["state"]))
        torch.testing.assert_close(carry["observation"], expected)
    seen = torch.cat(seen)
    torch.testing.assert_close(normalizer.loc, seen.mean(0))
    torch.testing.assert_close(normalizer.scale, seen.std(0, correction=0).clamp_min(1e-4))
    assert normalizer.count == 8 * 7 * 3


def test_gradients_pass_the_normalizer_and_an_update_before_backward_changes_nothing():
    def gradient(update):
        torch.manual_seed(0)
        base = HoveringEnv(num_envs=4, seed=1)
        normalizer = ObservationNormalizer(base)
        env = TransformedEnv(base, normalizer)
        actor = make_actor(env)
        normalizer.update(differentiable_rollout(env, actor, None, 3)[0])
        rollout, _ = differentiable_rollout(env, actor, None, 5)
        if update:
            normalizer.update(rollout)
        rollout["next", "reward"].sum().backward()
        return torch.cat([p.grad.flatten() for p in actor.parameters()])

    before, after = gradient(update=False), gradient(update=True)
    assert torch.equal(before, after)
    assert before.abs().sum() > 0


@pytest.mark.parametrize("in_keys", [["observation"], [("state", "velocity"), "observation", ("state", "position")]])
def test_under_the_normalizer_the_environment_inside_flies_with_the_numbers_and_gradients_of_torchrl_s_loop(in_keys):
    env = HoveringEnv(num_envs=4, dtype=torch.float64)
    normalizer = ObservationNormalizer(env)
    normalizer.update(env.rollout(20, break_when_any_done=False))
    check(normalizer, in_keys)


def test_under_the_normalizer_errors_and_unwanted_outputs_stay_as_they_are():
    base = HoveringEnv(num_envs=4)
    env = TransformedEnv(base, ObservationNormalizer(base))
    with pytest.raises(ValueError, match="The actor reads 'observation', which is not in the tensordict"):
        differentiable_rollout(env, make_actor(env), env.reset().exclude("observation"), 2)
    policy = TensorDictModule(lambda x: (x, x[:, :4].tanh()), in_keys=["observation"], out_keys=["_", "action"])
    assert differentiable_rollout(env, policy, None, 3)[0].shape == (4, 3)


def test_a_normalized_policy_on_plain_tensors_is_the_policy_and_one_with_hooks_has_no_plain_form():
    env = HoveringEnv(num_envs=4, dtype=torch.float64)
    normalizer = ObservationNormalizer(env)
    normalizer.update(env.rollout(20))
    actor = make_actor(env, in_keys=[("state", "velocity"), "observation"], input_scale=(0.3, 0.7))
    td = env.reset()
    written, plain, drawn = on_plain_tensors(normalized(actor, normalizer), td, ExplorationType.DETERMINISTIC)
    _, mine = plain.forward(plain.weights, [td[key] for key in plain.in_keys], drawn)
    torch.testing.assert_close(mine["action"], written["action"])
    expected, found = (torch.autograd.grad(x["action"].sum(), list(actor.parameters())) for x in (written, mine))
    torch.testing.assert_close(found, expected)
    assert torch.equal(written["observation"], td["observation"])
    next(x for x in actor.modules() if isinstance(x, torch.nn.Linear)).register_forward_hook(lambda *_: None)
    assert normalized(actor, normalizer).plain() is None


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size:UserWarning")
def test_a_live_vecnorm_is_refused_and_the_normalizer_named():
    env = TransformedEnv(HoveringEnv(num_envs=4), VecNormV2(in_keys=["observation"]))
    with pytest.raises(ValueError, match=r"VecNormV2 changes its statistics in place.*ObservationNormalizer\(env\)"):
        differentiable_rollout(env, make_actor(env), None, 5)
    env = TransformedEnv(env.base_env, ObservationNormalizer(env.base_env))
    differentiable_rollout(env, make_actor(env), None, 5)[0]["next", "reward"].sum().backward()


def test_the_normalizer_is_saved_and_leaves_out_what_is_not_finite():
    env = HoveringEnv(num_envs=4)
    one, other = ObservationNormalizer(env), ObservationNormalizer(env)
    rollout = env.rollout(5)
    one.update(rollout)
    broken = rollout.clone()
    broken["next", "observation"][0, 0, 0] = float("nan")
    one.update(broken)
    assert one.count == 39
    one.update(rollout[:0])
    assert all(buffer.isfinite().all() for buffer in one.state_dict().values())
    other.load_state_dict(one.state_dict())
    observation = rollout["observation"]
    assert torch.equal(one._apply_transform(observation), other._apply_transform(observation))


def test_the_normalizer_names_what_it_can_normalise(env):
    for options, message in (
        ({"key": "obs"}, "The environment does not observe 'obs'. Choose from: observation, "),
        ({"key": ("state", "position")}, 'is part of the state .* normalise "features"'),
        ({"min_scale": 0.0}, "min_scale must be greater than 0, got 0.0. The least standard deviation to divide by"),
    ):
        refuses(message, ObservationNormalizer, env, **options)
