import pytest
import torch

from torchrl_quad import HoveringEnv


@pytest.fixture(autouse=True)
def one_thread_and_a_fixed_seed():
    torch.set_num_threads(1)
    torch.manual_seed(0)


@pytest.fixture
def env():
    return HoveringEnv(num_envs=4, seed=1)


@pytest.fixture
def env64():
    return HoveringEnv(num_envs=4, seed=1, dtype=torch.float64)
