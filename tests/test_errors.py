"""Wrong input and common mistakes are refused where they come in: what is wrong, why, and what to write instead."""

import pytest
import torch
from helpers import cases, refuses
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import MultiAction, StepCounter, TransformedEnv
from torchrl.envs.transforms import Compose, ExcludeTransform, ObservationNorm, SelectTransform

from torchrl_quad import HoveringEnv, HybridLoss, LandingEnv, SHACLoss, load_drone, make_actor, make_env, make_value
from torchrl_quad.data import differentiable_rollout, restart
from torchrl_quad.envs import Event
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.objectives.calls import holding
from torchrl_quad.training.launch import Refused, _explained

nan = float("nan")
visfly = load_drone("visfly")


def linear(inputs, outputs, in_key="observation", out_key="action", **kwargs):
    return TensorDictModule(nn.Linear(inputs, outputs, **kwargs), in_keys=[in_key], out_keys=[out_key])


def near(state, **other):
    """An event, with some of it wrong."""
    return Event(**{"happened": state["step"] > 0, "time": state["position"][:, :1], "amount": 1.0, **other})


def adding(**entries):
    return lambda self, n: {**HoveringEnv.initial_state(self, n), **entries}


def test_an_unknown_option_is_refused_with_the_closest_one_and_all_of_them():
    for task, kwargs, message in (
        ("hovering", {"num_env": 3}, r"HoveringEnv got .* 'num_env'. Did you mean 'num_envs'\? Choose from: "),
        ("racing", {"gate_bonsu": "log"}, r"RacingEnv got an unexpected .* 'gate_bonsu'. Did you mean 'gate_bonus'\?"),
        ("tracking", {"xyz": 1}, r"argument 'xyz'. Choose from: action_delay, camera, .*curve.* weights, wind.$"),
    ):
        refuses(message, make_env, task, error=TypeError, **kwargs)


@cases(
    ({"num_envs": 2.5}, "num_envs must be a whole number, got 2.5"),
    ({"max_episode_steps": -3}, "max_episode_steps must be at least 1, got -3"),
    ({"dt": "fast"}, "dt must be a number, got 'fast'. The physics step, 1e-6 to 0.1 s"),
    ({"control_dt": 0.002}, "control_dt must be a whole multiple of dt, .* 0.002 and 0.005. Try control_dt=0.005."),
    ({"weights": ["velocity"]}, "weights must be a mapping from terms of the reward to numbers, got .'velocity'"),
    ({"weights": {"velocity": nan}}, "weights: velocity must be a finite number, got nan"),
    ({"event_discount": 0}, "event_discount must be greater than 0, got 0. The discount per control step"),
    ({"event_discount": "gamma"}, "got 'gamma'. The discount .*; None for no gradient in it."),
    ({"drone": visfly.replace(mass=4.6)}, r"to hover, its rotors would have to turn at .* Check mass \[kg\]"),
    ({"drone": visfly.replace(max_thrust_to_weight=0.8)}, "max_thrust_to_weight .* must be above 1 to hover; got"),
    ({"drone": visfly.replace(rotor_positions=[[0.1 * i, 0.03 * i] for i in (-3, -1, 1, 3)])},
        "its 4 rotors cannot control roll and pitch independently. It takes four or more with a torque about each"),
    ({"drone": None}, "drone must be the name of a preset, .* or QuadrotorParams, got None"),
    ({"auto_reset": True}, "auto_reset=True is for environments that reset themselves"),
    ({"dtype": torch.int32}, "dtype must be torch.float32 or torch.float64"),
    ({"dynamics": "plane"}, r"dynamics must be one of quadrotor, point_mass(, \w+)*, got 'plane'"),
    ({"action_delay": 0, "observe_last_action": True}, "without a delay there are none"),
    ({"wind": {"speed": 3}}, "wind: unknown key 'speed'. Allowed: mean, spread, gust, gust_time"),
    ({"wind": {"mean": [1.0]}}, "wind: mean must have at least 3 items, not 1, got .* Along x, y and z"),
    ({"wind": {"spread": [-1.0, 0.0, 0.0]}}, r"wind: spread\[0\] must be at least 0, got -1"),
    ({"wind": {"mean": [-60, 0, 0], "spread": [25, 0, 0], "gust": 4.0}}, "add up to 105 m/s; .* to 100 m/s"),
    ({"wind": 3.0}, r"^wind: it must be a mapping with any of mean, .*, such as \{'mean': \(0.0, 0.0, 0.0\)}"),
    ({"observation_noise": {"delay": 1}}, "observation_noise: unknown key 'delay'"),
    ({"observation_delay": -1}, "observation_delay must be at least 0, got -1. Control steps by which"),
    ({"random_start": {"tilt": float("nan")}}, "random_start: tilt must be a finite number, got nan"),
    *(({"randomize": drawn}, message) for drawn, message in (
        ({"weight": {"scale": [0.9, 1.1]}}, "randomize: unknown field 'weight'. Choose from: mass, inertia"),
        ({"rate_gain": {"scale": [0.9, 1.1]}}, "'rate_gain' belongs to the flight controller, which keeps the nominal"),
        ({"mass": {"gamma": [1, 2]}}, "mass needs one distribution of: uniform: low and high; scale: .*; normal: "),
        ({"mass": {"uniform": [-0.1, 1.0]}}, "drones that may be drawn are not all possible: .*'mass' must be between"),
        ({"mass": {"normal": [0.5, -0.1]}}, "mass needs two numbers, mean and standard deviation"),
        ({"rotor_spin": {"scale": [-1, 1]}}, "unknown field 'rotor_spin'"),
        ({"rotor_speed_min": {"uniform": [100, 3000]}, "rotor_speed_max": {"uniform": [2500, 4000]}},
            "min must be below"),
        ("none", "Unknown randomize 'none'. Give the path of a .yaml file"))),
)  # fmt: skip
def test_a_bad_value_is_refused_by_name(kwargs, message):
    refuses(message, HoveringEnv, **kwargs)


@cases(
    ("observe", lambda _, s: s["position"][:, 0], r"observe\(state\) must be a tensor \(4, k\), torch.float32"),
    ("reward_terms", lambda _, s: {"near": -s["position"]}, r"reward_terms\(state\)\['near'\] must .* keepdim"),
    ("reward_terms", lambda _, s: {"near": -s["position"][:, 0]}, r"\['near'\] must .*; got \(4,\)"),
    ("reward_terms", lambda _, s: {"near": s["step"]}, r"got \(4, 1\), torch.int64. Convert it: .to\(self.dtype\)"),
    ("reward_terms", lambda _, s: {"near": s["velocity"].mul_(0.0)[:, :1]}, "writes into 'velocity' in place"),
    ("is_crash", lambda _, s: s["vel"] > 0.0, "is_crash asks for 'vel', which is no entry .* has: position"),
    ("reward_terms", lambda env, _: {"near": env.weights["near"]}, "asks for 'near', .*; the weights: survival, "),
    ("reward_terms", lambda env, s: {"near": env.scene.nearest(s)[0]}, "asks None for 'nearest'. .* scene={'ground'"),
    ("reward_terms", lambda _, s: {"on": 0.1}, r"got float. Write torch.full_like\(state\['position'\]\[:, :1\], 0.1"),
    ("metrics", lambda _, s: {"far": s["step"]}, r"\['far'\] must be a tensor \(4, 1\), torch.float32; got"),
    ("reward_terms", lambda _, s: -s["position"], r"reward_terms\(state\) must be a mapping .*; got Tensor"),
    ("advance", lambda _, p, s: None, r"advance\(previous, state\) must be a mapping .*; got NoneType"),
    ("metrics", lambda _, s: {"far": s["position"]}, r"metrics\(state\)\['far'\] must be a tensor \(4, 1\)"),
    ("is_crash", lambda _, s: s["position"][:, :1], r"is_crash\(state\) must be a tensor \(4, 1\), torch.bool"),
    ("advance", lambda _, p, s: {"position": s["position"]}, "advance must return the whole state, and 'target'"),
    ("advance", lambda _, p, s: {**s, "target": s["target"].double()}, "float32.; got .* torch.float64"),
    ("advance", lambda _, p, s: {**s, "legs": s["step"]}, "advance gives 'legs', which the state lacks"),
    ("events", lambda _, p, s: {"near": 0.5}, r"\['near'\] must be an Event; got float"),
    ("events", lambda _, p, s: {"near": near(s, happened=s["step"])}, r"\.happened must be .* torch.bool; got"),
    ("events", lambda _, p, s: {"near": near(s, time=s["position"])}, r"\.time must be a tensor \(4, 1\), .* got"),
    ("events", lambda _, p, s: {"near": near(s, amount=None)}, r"\.amount must be a tensor \(4, 1\), .* NoneType"),
    ("events", lambda _, p, s: {"near": near(s, term="gate")}, "term must be one of survival, .*; got 'gate'"),
    ("initial_state", adding(legs=torch.zeros(4)), r"'legs' must be a tensor \(4, ...\) of at least two .*\(4,\)"),
    ("initial_state", adding(step=torch.zeros(4, 1)), "entry 'step' is the environment's own; give yours another"),
    ("initial_state", lambda env, n: {**HoveringEnv.initial_state(env, n), "legs": torch.rand(n, 1)},
        "initial_state: 'legs' differs between calls with one seed. Draw from self.uniform"),
    ("initial_state", lambda env, n: env.hover_state(torch.zeros(n, 3))["step"],
        "initial_state asks for 'step', which hover_state does not give: it has position, "),
    ("initial_state", lambda env, n: TensorDict(env.hover_state(torch.zeros(n, 3)), [n]),
        "initial_state must return the state that hover_state .*; got TensorDict"),
    ("initial_state", lambda _, n: {"goal": torch.zeros(n, 3)}, "must return the state that hover_state .*; got goal"),
    ("initial_state", adding(legs=torch.full((4, 1), torch.nan)), "'legs' is not finite. Look .*; for infinity write"),
    ("initial_state", adding(position=torch.full((4, 3), 1e7)), "no drone can fly .*'position' must be finite and bet"),
    ("state_bounds", lambda _: {"target": (2.0, 3.0)}, r"no drone can fly .*: 'target' must lie between 2.0 and 3.0"),
    ("state_bounds", lambda _: {"goal": (2.0, 3.0)}, r"state_bounds must give entries .*; got 'goal': \(2.0, 3.0\)"),
    ("observation_bounds", lambda _: torch.zeros(13), r"observation_bounds must be a tensor \(k,\) above zero"),
    ("state_bounds", lambda _: {"target": 2.0}, r"state_bounds must give entries .*; got 'target': 2.0"),
    ("reward_terms", lambda _, s: {"near": torch.log(0.0 * s["position"][:, :1])}, r"\['near'\] is not finite at"),
    ("is_success", lambda _, s: s["position"][:, 2] > 1.0, r"must be a tensor \(4, 1\), .* Keep .*: x\[:, 2:3\]"),
    ("is_success", lambda *_: torch.zeros(1, 1, dtype=torch.bool), r"; got \(1, 1\), torch.bool.$"),
    ("metrics", lambda _, s: {"crash": s["position"][:, :1]}, r"metrics\(state\): every task has crash already"),
    ("initial_state", adding(legs=torch.zeros(4, 1).int()), r"'legs' must be .* int64 or bool; got .* torch.int32\)"),
)  # fmt: skip
def test_a_task_of_another_form_is_refused_by_the_name_of_its_method(method, wrong, message):
    with pytest.raises(ValueError, match="OwnEnv." + (message if message.startswith(method) else ".*" + message)):
        type("OwnEnv", (HoveringEnv,), {method: wrong})(num_envs=4)


def test_a_branch_on_data_is_named_by_its_line_and_a_stopped_program_gives_parameters_back():
    branching = torch.compile(lambda x: x if (x > 0.0).all() else -x, fullgraph=True, backend="eager")
    said = r"test_errors.py:\d+: the compiler cannot follow this line: .*torch.where"
    with pytest.raises(Refused, match=said), _explained():
        branching(torch.ones(2))
    module = torch.nn.Linear(1, 1)
    mine, others = module.weight, TensorDictParams(TensorDict.from_module(module).data.clone())
    for stop in (KeyboardInterrupt(), ValueError()):
        with pytest.raises(type(stop)), holding(others, module):
            raise stop
        assert module.weight is mine


def test_an_event_whose_term_has_a_name_that_is_taken_is_refused():
    methods = {"events": lambda _, previous, state: {"near": near(state)}}
    methods["reward_terms"] = lambda _, state: {"near_time": state["position"][:, :1]}
    with pytest.raises(ValueError, match="gives the term 'near_time', which the reward has already: rename one"):
        type("OwnEnv", (HoveringEnv,), methods)(num_envs=4)


@cases(
    *((torch.zeros(shape), r"must have shape \(4, 4\), .* got \(") for shape in ((4,), (4, 1), (4, 5), (4, 4, 1))),
    *(
        (torch.zeros(4, 4, dtype=kind), f"is {kind}, and the environment flies in torch.float32. Convert the policy")
        for kind in (torch.float16, torch.float64, torch.bool, torch.int64, torch.complex64)
    ),
    ids=lambda x: f"{x.dtype} {tuple(x.shape)}" if isinstance(x, torch.Tensor) else "",
)
def test_an_action_of_another_shape_or_kind_is_refused_and_not_broadcast(action, message, env):
    refuses(f"The action {message}", env.step, env.reset().set("action", action))
    policy = TensorDictModule(lambda _: action, in_keys=["observation"], out_keys=["action"])
    for break_when_any_done in (False, True):
        refuses(f"The action {message}", env.rollout, 2, policy, break_when_any_done=break_when_any_done)


class Heavier(Disturbance):
    def start(self, random, state):
        return {("drone", "mass"): torch.full_like(state["position"][:, :1], 2.0)}


def test_parameters_and_policies_that_do_not_fit_are_refused(env):
    with pytest.raises(TypeError, match="params must be QuadrotorParams, such as env.params.replace.*; got str"):
        env.params = "visfly"
    with pytest.raises(ValueError, match="rate_gain would change nothing here: .* the controller keeps the nominal"):
        env.params = env.params.replace(rate_gain=[10.0] * 3)
    drawn = HoveringEnv(num_envs=4, randomize={"mass": {"scale": [0.8, 1.2]}})
    with pytest.raises(ValueError, match="randomize draws mass in each episode, .* change what randomize draws"):
        drawn.params = drawn.params.replace(mass=0.5)
    with pytest.raises(ValueError, match="Heavier draws mass .* have no gradient. .* without Heavier, or change what"):
        HoveringEnv(num_envs=4, disturbances=Heavier).set_params(drawn.params.replace(mass=0.5))
    for field, message in (
        ("mass", "randomize draws mass .* no gradient"),
        ("rate_gain", "No gradient reaches it: detach"),
    ):
        learned = drawn.params.replace(**{field: drawn.params.value(field).clone().requires_grad_()})
        refuses(message, drawn.set_params, learned)
        refuses(message, HoveringEnv, num_envs=4, drone=learned, randomize={"mass": {"scale": [0.8, 1.2]}})
    any_drone = HoveringEnv(num_envs=4, control="rotor_thrusts", randomize="any")
    with pytest.raises(ValueError, match="randomize draws motor_time_constant in each episode"):
        any_drone.params = any_drone.params.replace(motor_time_constant=0.04)
    worn = env.nominal.replace(rotor_effectiveness=[0.9, 1.0, 1.0, 1.0])
    worn = HoveringEnv(num_envs=4, drone=worn, randomize={"rotor_effectiveness": {"scale": [0.9, 1.0]}}).rebuilt(seed=1)
    with_z = torch.nn.functional.pad(worn.nominal.rotor_positions, (0, 1))
    worn.params = worn.params.replace(rotor_positions=with_z)  # what is drawn is as it was
    with pytest.raises(ValueError, match='there is none. A policy writes it under "action", as make_actor.env. does'):
        differentiable_rollout(env, linear(13, 4, out_key="acton"), None, 2)

    with pytest.raises(ValueError, match="The action is on meta, and the environment on cpu"):
        env.step(TensorDict({**env.reset().to_dict(), "action": torch.zeros(4, 4, device="meta")}, [4]))


@pytest.mark.parametrize("wrap", [False, True])
def test_a_broken_policy_is_refused_and_does_not_crash_its_drones_in_silence(wrap):
    env = HoveringEnv(num_envs=20)
    env = TransformedEnv(env, StepCounter()) if wrap else env
    actor = make_actor(env)
    with torch.no_grad():
        next(actor.parameters())[0, 0] = nan
    message = r"not finite in environments 0, 1, .* 9, \.\.\..*: the weights of the policy are broken, or what it reads"
    refuses(message, differentiable_rollout, env, actor, None, 3)


@pytest.mark.parametrize("transform", ["grad", "jacrev", "vmap", "compile"])
def test_an_action_is_not_looked_at_where_nobody_can(env64, transform):
    td = env64.rollout(2)["next"][:, -1].select("state")

    def reward(action):
        return env64.step(td.copy().set("action", action))["next", "reward"].sum()

    action = env64.hover_action.repeat(4, 1)
    if transform == "compile":
        torch.testing.assert_close(torch.compile(reward, backend="eager")(action), reward(action))
    elif transform == "vmap":
        torch.testing.assert_close(torch.vmap(reward)(action.expand(2, 4, 4)), reward(action).expand(2))
    else:
        assert getattr(torch.func, transform)(reward)(action).isfinite().all()


@pytest.mark.parametrize("transform", ["grad", "jacrev", "jacfwd"])
def test_a_drone_is_not_looked_at_where_nobody_can(env64, transform):
    td, drone, random = env64.rollout(2)["next"][:, -1].select("state"), env64.params, env64.random_state()

    def reward(mass):
        env64.set_random_state(random)
        env64.params = drone.replace(mass=mass)
        return env64.step(td.copy().set("action", env64.hover_action.repeat(4, 1)))["next", "reward"].sum()

    slope = getattr(torch.func, transform)(reward)(drone.mass)
    mass = drone.mass.clone().requires_grad_()
    torch.testing.assert_close(slope, *torch.autograd.grad(reward(mass), mass))


@pytest.mark.parametrize("horizon", [0, 2.5, "long"])
def test_a_horizon_is_a_number_of_steps(env, horizon):
    with pytest.raises(ValueError, match="horizon must be (at least 1|a whole number), got"):
        differentiable_rollout(env, make_actor(env), None, horizon)
    refuses("max_steps must be", env.rollout, horizon)


@pytest.mark.parametrize("key", ["obs", ("state", "speed")])
def test_an_actor_that_reads_what_nobody_writes_is_refused_with_what_there_is(env, key):
    message = "The actor reads .*, which is not in the tensordict .* env.reset.. writes: .*'state', 'position'"
    for some in (env, TransformedEnv(env, StepCounter())):
        refuses(message, differentiable_rollout, some, linear(13, 4, in_key=key), None, 2)
    with pytest.raises(ValueError, match="The actor reads 'observation', which is not in the tensordict"):
        differentiable_rollout(env, make_actor(env), env.reset().select("state"), 2)


def test_a_carry_is_a_tensordict_of_the_environment(env):
    actor = make_actor(env)
    rollout, carry = differentiable_rollout(env, actor, None, 3)
    no_actor = "actor must be a TensorDictModule that writes the action, got Linear"
    refuses(no_actor, differentiable_rollout, env, nn.Linear(13, 4), None, 1, error=TypeError)
    with pytest.raises(TypeError, match="carry must be the tensordict to start from, or None .* got Tensor"):
        differentiable_rollout(env, actor, torch.zeros(4), 2)
    for wrong, size in ((carry[:2], r"\(2,\)"), (rollout, r"\(4, 3\)")):
        with pytest.raises(ValueError, match=rf"carry has batch size {size}, and the environment \(4,\)"):
            differentiable_rollout(env, actor, wrong, 2)


def test_what_newcomers_stumble_over_is_said_where_they_stumble():
    env = HoveringEnv(num_envs=3, seed=0, drone="small_racer", control_dt=0.04, wind={"gust": 0.5})
    line = repr(env)
    parts = "HoveringEnv(num_envs=3", "drone='small_racer'", "control_dt=0.04 s", "device=cpu", "compiled=False", "wind"
    assert all(part in line for part in parts) and "\n" not in line
    env.params = env.params.replace(mass=0.2)
    assert "drone='small_racer' with other parameters" in repr(env)

    actor = make_actor(env)
    flown, carry = differentiable_rollout(env, actor, None, 5)
    masked = flown[:, -1]["next"].detach().set("_reset", torch.tensor([[True], [False], [False]]))
    refuses(r"set_state=False\); to set them to this state, set_state=True", env.reset, masked.clone())
    assert env.reset(masked.clone(), set_state=False)["state", "step"].flatten().tolist() == [0, 5, 5]
    assert env.reset(masked.clone(), set_state=True)["state", "step"].flatten().tolist() == [5, 5, 5]

    with pytest.raises(ValueError, match=r"one action \(k\) .* MultiAction.* control_dt=0.04"):
        make_actor(TransformedEnv(HoveringEnv(num_envs=3), Compose(MultiAction())))
    velocity = ("state", "velocity")
    for transform, message in (
        (ExcludeTransform("reward_terms"), r"no groups: name each, such as \(\"reward_terms\", \"velocity\"\)"),
        (ExcludeTransform(velocity), r"leaves out \('state', 'velocity'\), .* No transform may drop a part"),
        (Compose(SelectTransform("observation")), "leaves out .* every step would start where the first one did"),
        (Compose(ObservationNorm(0.0, 1.0, in_keys=[velocity])), "ObservationNorm overwrites .* the flight"),
    ):
        refuses(message, differentiable_rollout, TransformedEnv(env, transform), actor, None, 2)
    with pytest.raises(TypeError, match=r"Write actor.compile\(\) instead"):
        differentiable_rollout(env, torch.compile(actor), None, 2)
    single = TransformedEnv(HoveringEnv(num_envs=3), ExcludeTransform(("reward_terms", "velocity")))
    assert ("next", "reward_terms", "velocity") not in differentiable_rollout(single, actor, None, 2)[0]
    with pytest.raises(ValueError, match=r"restart needs the whole state, .* lacks \('state', 'velocity'\)"):
        restart(env, carry.exclude(("state", "velocity")), 0.5)
    with pytest.raises(ValueError, match=r"episode_metrics reads .*'success'.* Judge a rollout before you leave out"):
        env.episode_metrics(flown.exclude(("next", "success")))


def test_a_policy_may_overwrite_what_the_environment_writes():
    env = HoveringEnv(num_envs=3, max_episode_steps=8)
    scale = TensorDictModule(lambda x: 0.5 * x, ["observation"], ["observation"])
    actor = TensorDictSequential(scale, make_actor(env))
    flights = []
    for horizon in (24, 8):  # at the end of the shorter ones the environments are reset
        env.set_seed(0)
        torch.manual_seed(0)
        parts, carry = [], None
        for _ in range(24 // horizon):
            rollout, carry = differentiable_rollout(env, actor, carry, horizon)
            parts.append(rollout["state", "position"])
        flights.append(torch.cat(parts, 1))
    torch.testing.assert_close(*flights, rtol=0, atol=0)


def test_losses_say_what_a_critic_must_write():
    env = HoveringEnv(num_envs=4)
    actor = make_actor(env)
    rollout, _ = differentiable_rollout(env, actor, None, 3)
    flat = TensorDictModule(lambda x: x.sum(-1), ["observation"], ["state_value"])
    refuses(r"value_network must write .* 'state_value' of shape \(4, 1\); got \(4,\)", SHACLoss(actor, flat), rollout)
    with pytest.raises(ValueError, match=r"SHACLoss needs a V\(s\), which reads no action"):
        SHACLoss(actor, TensorDictModule(torch.nn.Linear(4, 1), ["action"], ["state_value"]))
    loss = HybridLoss(actor, make_value(env))  # somebody else's advantage is not what its own targets are
    assert loss(rollout.copy().set("advantage", torch.zeros(4, 3, 1)))["loss_actor"].isfinite()
    assert loss.make_value_estimator("tdlambda").value_estimator.vectorized is False


def test_a_default_precision_of_float64_changes_no_environment():
    torch.set_default_dtype(torch.float64)
    try:
        for task in (HoveringEnv, LandingEnv):
            assert task(num_envs=2).rollout(2)["next", "reward"].dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)
