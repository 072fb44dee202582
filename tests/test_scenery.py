"""What tasks say about themselves, for reports and pictures."""

import pytest
import torch

from torchrl_quad import HoveringEnv, make_env
from torchrl_quad.envs.scenery import EPISODE_METRICS, Metric, describe_metric

TASKS = ["hovering", "landing", "racing", "tracking"]


@pytest.mark.parametrize(
    ("metric", "value", "text"),
    [
        (Metric("position error", "cm", 100.0, median=True), 0.03214, "3.21 cm (median)"),
        (Metric("episodes solved", "%", 100.0), 1.0, "100 %"),
        (Metric("return"), -23.456, "-23.5"),
        (Metric("return"), 12345.6, "12346"),
        (Metric("lap time", "s"), torch.nan, "none"),
        (Metric("lap time", "s"), torch.inf, "inf s"),
    ],
)
def test_a_metric_is_printed_in_its_unit(metric, value, text):
    assert metric.format(value) == text


def test_episodes_without_a_value_do_not_count():
    values = torch.tensor([1.0, torch.nan, 2.0, 9.0])
    assert Metric("speed").summarise(values) == 4.0
    assert Metric("error", median=True).summarise(values) == 2.0
    assert Metric("lap time", "s").format(Metric("lap time").summarise(values[1:2])) == "none"


def test_a_metric_that_nobody_describes_goes_by_its_name():
    assert describe_metric("top_speed", {}) == Metric("top speed")
    assert describe_metric("solved", {}) is EPISODE_METRICS["solved"]
    assert describe_metric("solved", {"solved": Metric("landed")}).label == "landed"


@pytest.mark.parametrize("task", TASKS)
def test_a_task_describes_every_metric_that_it_gives(task):
    env = make_env(task, num_envs=2)
    rollout = env.rollout(3, break_when_any_done=False)
    names = {*env.episode_metrics(rollout), *rollout["next", "metrics"].keys()}
    assert names == set(env.metric_info)
    assert all(values.shape == (2,) for values in env.episode_metrics(rollout).values())


def test_the_scenery_of_racing_and_tracking_is_where_their_targets_are():
    racing, tracking = make_env("racing", num_envs=8), make_env("tracking", num_envs=8)
    scenery = racing.scenery()
    target = racing.reset()["state", "target"]
    assert (target.unsqueeze(1) == scenery.gates).all(-1).any(-1).all()
    assert scenery.gate_radius == racing.track["gate_radius"] and scenery.progress in racing.metric_info
    target = tracking.reset()["state", "target"]
    assert (torch.cdist(target, tracking.scenery().curve).amin(-1) < 0.06).all()  # half of the step between points
    hovering = HoveringEnv(num_envs=2).scenery()  # shown where the flight had them
    assert hovering.places is hovering.curve is hovering.gates is None
