"""The tasks in other frameworks, each tried with the real package."""

import importlib
import itertools
import sys
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from helpers import refuses
from rsl_rl.runners import OnPolicyRunner
from skrl.agents.torch.ppo import PPO
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model
from stable_baselines3 import PPO as StablePPO
from stable_baselines3.common.vec_env import VecMonitor
from tensordict import TensorDict
from torchrl.envs import PendulumEnv, RewardScaling, TransformedEnv

from torchrl_quad import HoveringEnv, adapters, make_env
from torchrl_quad.adapters import DronesVecEnv, GymVectorEnv, RslRlVecEnv, SkrlEnv, TorchVectorEnv
from torchrl_quad.errors import UserError

NETWORK = {"class_name": "MLPModel", "hidden_dims": [8]}
ACTOR = {**NETWORK, "distribution_cfg": {"class_name": "GaussianDistribution"}}
RSL_RL = {"num_steps_per_env": 8, "save_interval": 1, "algorithm": {"class_name": "PPO"}}
RSL_RL |= {"actor": ACTOR, "critic": NETWORK, "obs_groups": {"actor": ["policy"], "critic": ["policy"]}}


def scattered(make=make_env, **options):
    """Drones that crash at different times, and a time limit."""
    start = {"tilt": 3.0, "velocity": 20.0}
    return make("racing", num_envs=8, seed=3, max_episode_steps=12, random_start=start, **options)


@pytest.mark.parametrize("options", [{}, {"wind": {"gust": 0.5}, "observation_noise": {"position": 0.1}}])
@pytest.mark.parametrize("is_gym", [False, True])
def test_a_loop_flies_as_the_torchrl_environment_does(is_gym, options):
    gym = partial(scattered, GymVectorEnv, autoreset_mode="SameStep")
    env, reference = gym(**options) if is_gym else TorchVectorEnv(scattered(**options)), scattered(**options)
    (observation, _), td, ended = env.reset(), reference.reset(), set()
    for action in torch.randn(40, 8, 4):  # beyond the bounds, too
        np.testing.assert_array_equal(observation, td["observation"])
        observation, reward, terminated, truncated, info = env.step(action.numpy() if is_gym else action)
        flown, td = reference.step_and_maybe_reset(td.set("action", action.clamp(-1, 1)))
        end, over = flown["next"], np.asarray(terminated | truncated)
        for mine, its in ((reward, "reward"), (terminated, "terminated"), (truncated, "truncated")):
            np.testing.assert_array_equal(mine, end[its].squeeze(-1))
        for i in np.flatnonzero(over):
            np.testing.assert_array_equal(info["final_obs"][i], end["observation"][i])
        np.testing.assert_array_equal(info["crash"], (td if is_gym else end)["crash"].squeeze(-1))
        ended.add(over.sum())
    assert len(ended) > 3
    np.testing.assert_array_equal(env.reset(seed=5)[0], env.reset(seed=5)[0])


def test_a_torch_loop_sees_what_transforms_make_of_a_task():
    rewards = []
    for env in (scattered(), TransformedEnv(scattered(), RewardScaling(0.0, 2.0))):
        env = TorchVectorEnv(env)
        env.reset()
        rewards.append(env.step(torch.zeros(8, 4))[1])
    torch.testing.assert_close(rewards[1], 2 * rewards[0])


def test_the_runner_of_rsl_rl_trains_logs_saves_and_loads(tmp_path, capsys):
    task = HoveringEnv(num_envs=8, seed=0, max_episode_steps=10, action_delay=0)
    env = RslRlVecEnv(task)
    runner = OnPolicyRunner(env, RSL_RL, str(tmp_path))
    before = [x.clone() for x in runner.alg.actor.parameters()]
    runner.learn(3, init_at_random_ep_len=True)
    assert any((x != y).any() for x, y in zip(before, runner.alg.actor.parameters(), strict=True))
    assert "Episode/position_error" in capsys.readouterr().out
    runner.load(str(tmp_path / "model_2.pt"))
    assert runner.get_inference_policy()(env.get_observations()).shape == (8, 4)
    # It flew in inference mode, and the same task still gives gradients.
    action = torch.zeros(8, 4, requires_grad=True)
    reward = task.step(env.drones.now.set("action", action))["next", "reward"]
    assert torch.autograd.grad(reward.sum(), action)[0].abs().sum() > 0


def test_rsl_rl_sets_episode_lengths_within_the_limit_and_is_told_which_episodes_it_has_ended():
    env = RslRlVecEnv(HoveringEnv(num_envs=3, seed=0, max_episode_steps=10))
    env.episode_length_buf = torch.tensor([0, 9, 0])
    env.drones.now["state", "position"][2, 2] = -1.0  # underground
    _, _, done, extras = env.step(torch.zeros(3, 4))
    assert done.tolist() == [False, True, True]
    assert extras["time_outs"].tolist() == [False, True, False] and extras["log"]["Episode/crash"] == 0.5
    assert env.episode_length_buf.tolist() == [1, 0, 0]
    env = RslRlVecEnv(HoveringEnv(3, seed=0, max_episode_steps=10))
    steps = torch.tensor([0, 5, 9])
    env.episode_length_buf = steps
    steps += 1
    for wrong in (None, 3, [0, 0, 0], steps, -steps, steps.float(), steps[:2], steps[:, None], steps.to("meta")):
        refused(setattr, env, "episode_length_buf", wrong)
    assert env.episode_length_buf.tolist() == [0, 5, 9]


def test_ppo_of_skrl_trains(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = SkrlEnv(HoveringEnv(num_envs=8, seed=0, max_episode_steps=10))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    network = [{"name": "layer", "input": "OBSERVATIONS", "layers": [8], "activations": "tanh"}]
    policy = gaussian_model(**spaces, network=network, output="ACTIONS")
    value = deterministic_model(**spaces, network=network, output="ONE")
    for model in (policy, value):
        model.init_state_dict()
    before = [x.clone() for x in policy.parameters()]
    memory = RandomMemory(memory_size=8, num_envs=8, device=env.device)
    config = {"rollouts": 8, "time_limit_bootstrap": True}
    agent = PPO(models={"policy": policy, "value": value}, memory=memory, cfg=config, **spaces)
    SequentialTrainer(env=env, agents=agent, cfg={"timesteps": 24, "close_environment_at_exit": False}).train()
    assert all((x != y).any() for x, y in zip(before, policy.parameters(), strict=True))
    assert [x.shape for x in env.step(torch.zeros(8, 4))[:-1]] == [(8, 13), (8, 1), (8, 1), (8, 1)]


def test_stable_baselines3_counts_successes_and_ends():
    options = {"num_envs": 2, "max_episode_steps": 3, "autoreset_mode": "SameStep", "render_mode": "rgb_array"}
    drones = gymnasium.make_vec("torchrl_quad/Hovering-v0", **options)
    state = drones.torchrl_env.reset()["state"].clone()
    state["position"][0], state["position"][1] = state["target"][0], torch.tensor([1.0, 0.0, 0.5])
    drones.torchrl_env.set_initial_state_source(lambda n: state.clone())
    env = DronesVecEnv(drones)
    env.reset()
    hover = np.tile(drones.torchrl_env.hover_action.numpy(), (2, 1))
    infos = [env.step(hover)[3] for _ in range(3)]
    assert infos[0] == [{}, {}] and [info["is_success"] for info in infos[2]] == [True, False]
    assert all(info["TimeLimit.truncated"] for info in infos[2])
    np.testing.assert_allclose(infos[2][0]["terminal_observation"][:4], [0, 0, 0, 10], atol=0.1)
    assert [picture.shape for picture in env.get_images()] == 2 * [(336, 336, 3)]
    ppo = StablePPO("MlpPolicy", VecMonitor(env), n_steps=8, batch_size=16, n_epochs=1, device="cpu").learn(16)
    assert ppo.ep_success_buffer
    refuses("share 'x'", env.set_attr, "x", 1, error=NotImplementedError)


def drones(**options):
    return gymnasium.make_vec("torchrl_quad/Hovering-v0", num_envs=3, seed=0, autoreset_mode="SameStep", **options)


FLOWN = torch.linspace(-1, 1, 12).reshape(3, 4)
WRONG = [None, "up", 0.5, [0.0] * 4, [[0.0] * 4, [0.0] * 3], {}, np.full((3, 4), "up"), np.zeros((3, 4), object)]
WRONG += [x.numpy() for x in (FLOWN.long(), FLOWN.bool(), FLOWN.to(torch.complex64), FLOWN[:2], FLOWN / 0)]
WRONG += [FLOWN.long(), FLOWN.bool(), FLOWN.to("meta"), FLOWN.to_sparse(), FLOWN[:2], FLOWN[0], FLOWN.log(), FLOWN / 0]
OPTIONS = ["reset_mask", ["x"], {"seed": 0}, {"x": 1}]
SEEDS = [-1, 2**63, 10**5000, 1.5, "0", True, torch.tensor(0)]
ADAPTERS = {
    "gymnasium": (drones, FLOWN.numpy()),
    "sb3": (lambda: DronesVecEnv(drones()), FLOWN.numpy()),
    "torch": (lambda: TorchVectorEnv(HoveringEnv(3, seed=0)), FLOWN),
    "skrl": (lambda: SkrlEnv(HoveringEnv(3, seed=0)), FLOWN),
    "rsl_rl": (lambda: RslRlVecEnv(HoveringEnv(3, seed=0)), FLOWN),
}


def refused(call, *arguments, **options):
    with pytest.raises(UserError) as error:
        call(*arguments, **options)
    assert "\n" not in str(error.value)


def resets(env, name):
    """The calls that take a seed, and those that take options."""
    if name == "rsl_rl":  # which has no reset
        return [], []
    if name == "sb3":
        return [env.seed], [env.set_options]
    return [lambda seed: env.reset(seed=seed)], [lambda x: env.reset(options=x), lambda x: env.reset(seed=1, options=x)]


@pytest.mark.parametrize("name", ADAPTERS)
def test_a_refused_call_is_explained_and_leaves_the_flight_as_it_was(name):
    make, action = ADAPTERS[name]
    env, undisturbed = make(), make()
    if name != "rsl_rl":  # which begins by itself
        refused(env.step, action)
        env.reset(), undisturbed.reset()
    for _ in range(3):
        for wrong in WRONG:
            refused(env.step, wrong)
        seeded, with_options = resets(env, name)
        for call, wrong in [*itertools.product(seeded, SEEDS), *itertools.product(with_options, OPTIONS)]:
            refused(call, wrong)
        one, other = env.step(action), undisturbed.step(action)
        for mine, its in zip(one[:-1], other[:-1], strict=True):
            mine, its = (x["policy"] if isinstance(x, TensorDict) else x for x in (mine, its))
            np.testing.assert_array_equal(mine, its)
    if name == "rsl_rl":
        return
    env.close(), env.close()
    for call in (env.reset, lambda: env.step(action)):
        refused(call)


def test_actions_of_stable_baselines3_wait_for_one_step():
    env, action = DronesVecEnv(drones(render_mode="rgb_array")), FLOWN.numpy().copy()
    refused(env.get_images)
    refused(env.step_wait)
    env.reset()
    env.step_async(action)
    action[:] = np.nan  # they were kept as they had been
    env.step_wait()
    refused(env.step_wait)
    env.step_async(FLOWN.numpy())
    env.reset()  # what waited is forgotten
    refused(env.step_wait)


@pytest.mark.parametrize("adapter", [TorchVectorEnv, SkrlEnv, RslRlVecEnv, DronesVecEnv])
def test_what_is_no_environment_of_its_kind_is_refused(adapter):
    for wrong in (None, "hovering", HoveringEnv, 3, gymnasium.make_vec("CartPole-v1", num_envs=2), PendulumEnv()):
        refused(adapter, wrong)
    if adapter is not DronesVecEnv:
        seeing = HoveringEnv(2, camera={"width": 6, "height": 4})
        refuses("shows depth images, which plain observations leave out. Build it with cam", adapter, seeing)
    else:
        with pytest.raises(ValueError, match=r"'NextStep', and stable-baselines3 .* autoreset_mode=\"SameStep\""):
            adapter(gymnasium.make_vec("torchrl_quad/Hovering-v0", num_envs=2))
    with pytest.raises(AttributeError, match="no 'Rllib'. Choose from: .*DronesVecEnv, "):
        adapters.Rllib  # noqa: B018


@pytest.mark.parametrize("package", ["rsl_rl", "skrl", "stable_baselines3"])
def test_a_missing_package_is_named_with_what_installs_it(package, monkeypatch):
    monkeypatch.delitem(sys.modules, f"torchrl_quad.adapters.{package}")
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r'needs .*: pip install ".\[adapters\]"'):
        importlib.import_module(f"torchrl_quad.adapters.{package}")
