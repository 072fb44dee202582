"""One seed gives one flight, however it is flown, and goes on bit for bit from what was saved."""

import io

import pytest
import torch
from flying import look_at_nothing
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv

from torchrl_quad import HoveringEnv

RESTLESS = {  # flights that crash after some ten steps, each in its own time
    "num_envs": 8,
    "dtype": torch.float64,
    "seed": 3,
    "random_start": {"tilt": 3.0, "velocity": 20.0},
    "wind": {"gust": 2.0},
    "observation_noise": {"position": 0.1, "velocity": 0.1},
}
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
    options = {"auto_reset": False, "break_when_any_done": False}
    env = HoveringEnv(**RESTLESS)
    expected = env.rollout(STEPS, POLICY, tensordict=env.reset(), **options)
    assert expected["next", "done"].sum() > 20

    other = HoveringEnv(**RESTLESS)
    flights = {"TorchRL's loop": EnvBase.rollout(other, STEPS, POLICY, tensordict=other.reset(), **options)}
    other = HoveringEnv(**RESTLESS)
    flights["by hand"] = by_hand(other, other.reset(), STEPS)
    other = TransformedEnv(HoveringEnv(**RESTLESS), Compose(StepCounter(), RewardSum()))
    flights["transformed"] = other.rollout(STEPS, POLICY, tensordict=other.reset(), **options)
    other = HoveringEnv(**RESTLESS)
    td, halves = other.reset(), []
    for steps in (13, STEPS - 13):
        halves.append(other.rollout(steps, POLICY, tensordict=td, **options))
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
    flight = env.rollout(31, POLICY, tensordict=start, auto_reset=False, break_when_any_done=False)
    begins = flight["state", "step"][:, 1:, 0] == 0
    for positions, begin in zip(flight["state", "position"][:, 1:], begins, strict=True):
        assert begin.sum() >= 10
        assert len(positions[begin].unique(dim=0)) == begin.sum()


@pytest.mark.parametrize("steps", [5, 45])
def test_a_flight_goes_on_bit_for_bit_from_a_saved_random_state(steps):
    env = TransformedEnv(HoveringEnv(**RESTLESS), StepCounter())
    options = {"auto_reset": False, "break_when_any_done": False}
    first = env.rollout(steps, POLICY, tensordict=env.reset(), **options)
    carry = env.maybe_reset(env.step_mdp(first[:, -1]))
    saved = io.BytesIO()
    torch.save({"random": env.random_state(), "state": carry["state"].to_dict()}, saved)
    saved.seek(0)
    expected = env.rollout(50, POLICY, tensordict=carry.clone(), **options)

    loaded = torch.load(saved, weights_only=True)
    again = TransformedEnv(HoveringEnv(**{**RESTLESS, "seed": 99}), StepCounter())
    again.rollout(7, POLICY, break_when_any_done=False)
    start = again.reset(TensorDict({"state": loaded["state"]}, [8]), set_state=True)
    again.set_random_state(loaded["random"])
    for _ in range(2):  # what was loaded can be loaded again
        flight = again.rollout(50, POLICY, tensordict=start.clone(), **options)
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
