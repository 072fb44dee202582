"""Losses call the networks of the package as pure functions, and all others as they are: the numbers are the same."""

import pytest
import torch
from torch import nn
from torchrl.modules import ValueOperator

from torchrl_quad import ABPTLoss, HoveringEnv, SHACLoss, differentiable_rollout, make_actor, make_qvalue, make_value

IN_KEYS = ["observation", ("state", "rotor_speed")]


def results(loss, rollout):
    """All that a loss computes of a rollout, its gradients, and the next random number; the graph is kept."""
    torch.manual_seed(1)
    out = loss(rollout)
    inputs = {"action": rollout["action"], "next": rollout["next", "observation"]}
    inputs |= dict(loss.named_parameters())
    losses = [value for key, value in out.items() if key.startswith("loss_")]
    grads = {
        f"{i}, {key}": torch.autograd.grad(value, x, retain_graph=True, allow_unused=True)[0]
        for i, value in enumerate(losses)
        for key, x in inputs.items()
    }
    target = loss.write_value_target(rollout.copy())["value_target"]
    return {**dict(out.items()), **grads, "target": target}, torch.rand(1)


@pytest.mark.parametrize("name", ["shac", "abpt"])
def test_pure_functions_give_the_numbers_and_draw_the_random_numbers_of_the_networks(name):
    env = HoveringEnv(num_envs=3, max_episode_steps=4, random_start={"tilt": 0.5, "velocity": 1.0}, seed=0)
    make_critic, make = (make_value, SHACLoss) if name == "shac" else (make_qvalue, ABPTLoss)
    actor, critic = make_actor(env, return_log_prob=True), make_critic(env, in_keys=IN_KEYS, input_scale=(1.0, 1e-3))
    loss = make(actor, critic).make_value_estimator(gamma=0.9, lmbda=0.8)
    critic, calls = getattr(loss, loss.critic_name), []
    rollout, _ = differentiable_rollout(env, make_actor(env, return_log_prob=True), None, 6)
    loss.actor_network_params.data.apply_(lambda x: x.add_(0.1 * torch.randn_like(x)))
    assert critic.plain() is not None

    pure, after_pure = results(loss, rollout)
    for network in (critic, loss.actor_network):
        network.register_forward_hook(lambda network, *_: calls.append(network))
    called, after_called = results(loss, rollout)

    assert critic in calls and (loss.actor_network in calls) == (name == "abpt")
    assert after_pure == after_called
    assert {key for key, x in pure.items() if x is None} == {key for key, x in called.items() if x is None}
    assert sum(x is not None for x in pure.values()) >= 18
    for key, x in called.items():
        if x is not None:
            torch.testing.assert_close(pure[key], x, msg=lambda message, key=key: f"{key}: {message}")


class Doubled(nn.Module):
    """A critic of the user's own."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, *inputs):
        return 2.0 * self.network(*inputs)


@pytest.mark.parametrize(
    "change",
    [
        lambda critic: critic.register_forward_hook(lambda *arguments: None),
        lambda critic: critic.module.mlp[3].register_full_backward_hook(lambda *arguments: None),
        lambda critic: critic.module.mlp.__setitem__(2, nn.Dropout(0.5)),
        lambda critic: critic.module.mlp.__setitem__(2, nn.PReLU()),
        lambda critic: nn.utils.parametrizations.weight_norm(critic.module.mlp[0]),
        lambda critic: critic.module.mlp.__setitem__(5, critic.module.mlp[2]),
        lambda critic: setattr(critic.module, "head", nn.Softplus()),
        lambda critic: setattr(critic, "module", Doubled(critic.module)),
        lambda critic: setattr(critic, "__class__", type("Mine", (ValueOperator,), {})),
    ],
    ids=["hook", "backward", "dropout", "parameters", "parametrization", "shared", "head", "module", "class"],
)
def test_a_critic_that_somebody_has_changed_is_called_as_it_is(env, change):
    critic = make_value(env)
    change(critic)
    assert not hasattr(critic, "plain") or critic.plain() is None
    loss = SHACLoss(make_actor(env), critic)
    rollout, _ = differentiable_rollout(env, make_actor(env), None, 3)
    torch.manual_seed(0)
    prediction = loss.loss_value(rollout)[1]["pred_value"]
    torch.manual_seed(0)
    loss.write_value_target(rollout)  # draws first
    torch.testing.assert_close(prediction, critic(rollout.detach())["state_value"].mean())
    loss(rollout)["loss_value"].backward()
    assert all(x.grad is not None for x in loss.value_network_params.parameters())
