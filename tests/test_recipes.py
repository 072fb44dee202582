"""Every recipe on a reduced budget, and training that is long enough to succeed."""

import gc
import json
import math
import re
import sys
from itertools import groupby

import pytest
import torch
from helpers import ROOT, cases, run
from helpers import SMALL as SMALL_RUN
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate

from torchrl_quad import HoveringEnv, LandingEnv, SHACLoss, differentiable_rollout, make_actor, make_value, restart
from torchrl_quad.envs import TASKS
from torchrl_quad.envs.metrics import EPISODE_METRICS
from torchrl_quad.files import read_rows
from torchrl_quad.modules.actors import TanhGaussianActor
from torchrl_quad.objectives.calls import MedianClip
from torchrl_quad.training import loop
from torchrl_quad.training.building import Optimizer, build_env
from torchrl_quad.training.checkpoints import read_checkpoint, write_checkpoint
from torchrl_quad.training.evaluation import drawing_from, evaluate
from torchrl_quad.training.schema import LOSSES, settings

SMALL = [*SMALL_RUN, "total_steps=96"]
RECIPES = sorted(LOSSES)


@pytest.fixture
def train(launch):
    """As conftest's, but with a smaller budget, and with pictures."""
    return lambda recipe, folder, *overrides: launch(recipe, *SMALL, f"hydra.run.dir={folder}", *overrides)


@pytest.fixture
def no_garbage_of_others():
    """What other tests leave takes most of a second to look through, which the clock of a run would count."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("no_garbage_of_others", "no_pictures")
def test_a_compiled_run_learns_what_an_eager_one_does(train, monkeypatch, tmp_path):
    # The graph runs as it was captured: test_horizon.py compares the code that the compiler makes of one.
    monkeypatch.setattr("torch._inductor.compile_fx.compile_fx", lambda graph, *_, **__: graph.forward)
    small = ["env.dynamics=point_mass", "actor.noise_correlation=0.9", "hydra.job_logging.root.level=WARNING"]
    for mode in ("false", "true"):
        train("bptt", tmp_path / mode, *small, f"compile={mode}")
    eager, compiled = (read_rows(tmp_path / mode / "metrics.csv") for mode in ("false", "true"))
    for name in ("train/loss_actor", "grad/actor", "eval/return", "eval/position_error"):
        assert float(compiled[-1][name]) == pytest.approx(float(eager[-1][name]), rel=1e-3), name
    first, last = (float(row["time/processor_seconds"]) for row in compiled)
    assert first < 5 * (last - first) + 0.5  # compilation, of several seconds, is outside the clock


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_trains_on_its_tasks_and_leaves_what_it_promises(launch, no_pictures, recipe, tmp_path):
    tasks = TASKS if recipe == "abpt" else ["forest"]  # the others differ in their losses alone
    tasks = ["landing"] if recipe in ("sapo", "ahac", "hybrid", "pods", "train") else tasks
    sweep = [f"task={','.join(tasks)}", f"hydra.sweep.dir={tmp_path}", "hydra.sweep.subdir=${task}"]
    memory = [] if recipe in ("abpt", "bptt") else ["actor.recurrent=true", "actor.hidden_size=8"]
    camera = ["env.density=0.02", "env.camera.width=8", "env.camera.height=6"] if tasks == ["forest"] else []
    printed = launch(recipe, "--multirun", *SMALL, *memory, *camera, *sweep, "hydra/launcher=basic")
    for task in tasks:
        folder = tmp_path / task
        rows = read_rows(folder / "metrics.csv")
        assert [int(row["iteration"]) for row in rows] == [2, 4]
        steps = [int(row["steps"]) for row in rows]
        has_changing_horizon = recipe in ("ahac", "train")
        assert steps[-1] >= 96 > steps[0] if has_changing_horizon else steps == [48, 96]
        metrics = {f"eval/{name}" for name in TASKS[task].metric_info}
        assert {"grad/actor", *metrics, *(["grad/critic"] if "critic" in settings(recipe) else [])} <= set(rows[0])
        assert any(name.startswith("train/loss_") for name in rows[0])
        may_be_missing = {"eval/lap_time", "eval/landing_speed"}
        assert all(math.isfinite(float(row[name])) for row in rows for name in set(row) - may_be_missing)
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["episodes"] == 256 and summary["steps"] == steps[-1]
        report = printed.split(f"{recipe} on {task}, seed 0, 256 fresh episodes:\n")[1].split("results in")[0]
        assert f"  episodes solved       {EPISODE_METRICS['solved'].format(summary['solved'])}\n" in report
        assert set(TASKS[task].metric_info) <= set(summary)
        best = read_checkpoint(folder / "checkpoint.pt")["best"]
        assert (best["solved"], best["return"]) == max((float(x["eval/solved"]), float(x["eval/return"])) for x in rows)
        assert summary["best_steps"] == best["steps"] in steps


@cases(("false", "null", 4), ("true", "null", 8), ("true", "3", 3))
def test_horizons_of_train_py_get_twice_as_long_and_with_a_memory_four_times(
    memory, most, longest, train, no_pictures, tmp_path
):
    words = [f"actor.recurrent={memory}", f"loss.max_horizon={most}", "loss.max_stiffness=1e9", "horizon=2"]
    train("train", tmp_path, *words, "total_steps=400", "eval.interval=10")
    assert float(read_rows(tmp_path / "metrics.csv")[-1]["train/horizon"]) == longest


@cases(("ahac", 1), ("train", 8), ("train", 2))
def test_where_the_shortest_horizon_is_too_stiff_the_actor_learns_slower_with_less_noise(
    recipe, least, train, no_pictures, monkeypatch, tmp_path
):
    steps, noise, critic, clips = [], [], [], []
    fit, step, clip = loop.Run.fit_critic, Optimizer.step, MedianClip.forward
    monkeypatch.setattr(loop.Run, "fit_critic", lambda *args, **times: (fit(*args, **times), critic.append(times))[0])
    monkeypatch.setattr(
        Optimizer, "step", lambda self: (step(self), steps.append((self.name, self.param_groups[0]["lr"])))
    )
    monkeypatch.setattr(TanhGaussianActor, "scale_noise", lambda _, share: noise.append(share))
    monkeypatch.setattr(MedianClip, "forward", lambda self, grad: (clips.append(self.factor), clip(self, grad))[1])
    words = ["loss.max_stiffness=1.000001", "loss.min_lr_factor=0.25", "loss.horizon_lr=0.5", "actor.schedule=constant"]
    words += [f"min_epochs={least}"] * (recipe == "train")
    train(recipe, tmp_path, *words, "horizon=2", "loss.min_horizon=2", "total_steps=240", "eval.interval=6")
    rates = [rate / settings(recipe)["actor"]["lr"] for name, rate in steps if name == "actor"]
    epochs = [len(list(some)) for name, some in groupby(name for name, _ in steps) if name == "actor"]
    # What the rate and the optimiser's steps make together.
    factors = list(dict.fromkeys(rates)) if least != 2 else [x / 8 for x in dict.fromkeys(epochs)]
    assert factors[0] == 1.0 and 0.3 > factors[-1] == pytest.approx(0.25) and factors == sorted(factors, reverse=True)
    if recipe == "train":
        assert epochs[-1] == least and (min(rates) > 0.8 or least == 8)  # epochs are whole
        assert clips == pytest.approx([16 / x for x in epochs])
        assert noise[0] == 1.0 and noise[-1] == pytest.approx(0.25) and noise == sorted(noise, reverse=True)
        rows = read_rows(tmp_path / "metrics.csv")
        assert {x["train/pace"] for x in rows} == {"1.0"} and float(rows[-1]["train/lr_factor"]) == pytest.approx(0.25)
        assert all(x["times"] == pytest.approx(1) for x in critic)


@pytest.mark.parametrize("recipe", ["abpt", "ppo"])
def test_evaluation_repeats_the_summary_of_the_run_also_with_a_normalizer(train, launch, recipe, tmp_path, request):
    if recipe != "abpt":  # the others draw by the same functions
        request.getfixturevalue("no_pictures")
    train(recipe, tmp_path, "normalize=true", "env.wind={gust: 0.5}", "actor.schedule=exponential")
    checkpoint = read_checkpoint(tmp_path / "checkpoint.pt")
    assert checkpoint["stateful"][-1]["count"] == 96
    if recipe == "ppo":  # the next horizon starts from what the normalizer of now makes of its states
        cfg = OmegaConf.create(checkpoint["config"])
        env, carry = build_env(cfg, cfg.num_envs, 0), TensorDict(checkpoint["processes"][0]["carry"], [cfg.num_envs])
        env.transform.load_state_dict(checkpoint["stateful"][-1])
        torch.testing.assert_close(carry["observation"], restart(env, carry, 0.0)["observation"])
    launch("evaluate", f"checkpoint={tmp_path}/checkpoint.pt")
    summary = json.loads((tmp_path / "summary.json").read_text())
    evaluation = json.loads((tmp_path / "evaluation.json").read_text())
    assert all(summary[name] == value for name, value in evaluation.items())
    if recipe != "abpt":
        return
    for flown, again in (("flight.png", "evaluation.png"), ("flight.html", "evaluation.html")):  # the same flight
        assert (tmp_path / flown).read_bytes() == (tmp_path / again).read_bytes()
    assert (tmp_path / "evaluation.mp4").read_bytes()[4:8] == b"ftyp"
    assert (tmp_path / "evaluation.pdf").read_bytes().startswith(b"%PDF")


def test_seeds_differ_and_the_coefficient_of_an_entropy_bonus_is_fixed_or_learned(train, no_pictures, tmp_path):
    train("bptt", tmp_path, "loss.alpha=auto")
    first, last = (float(row["train/alpha"]) for row in read_rows(tmp_path / "metrics.csv"))
    assert first != last
    losses = set()
    for seed in "01":
        train("bptt", tmp_path / seed, "loss.alpha=0.01", f"seed={seed}")
        rows = read_rows(tmp_path / seed / "metrics.csv")
        assert [float(row["train/alpha"]) for row in rows] == pytest.approx([0.01, 0.01])
        losses.add(rows[0]["train/loss_actor"])
    assert len(losses) == 2


def test_an_evaluation_of_more_episodes_than_drones_flies_rounds_from_starts_of_their_own():
    env = LandingEnv(num_envs=4, max_episode_steps=10, seed=0)
    actor = make_actor(env)
    with drawing_from(env, 7):
        rounds = [evaluate(env, actor) for _ in range(3)]
    with drawing_from(env, 7):
        metrics, flight = evaluate(env, actor, episodes=9)  # 9 take 3 rounds of 4
    means = [single["eval/return"] for single, _ in rounds]
    assert len(set(means)) == 3 and metrics["eval/return"] == pytest.approx(sum(means) / 3, rel=1e-6)
    terms = [value for name, value in metrics.items() if name.startswith("reward/")]
    assert sum(terms) == pytest.approx(sum(means) / 3, rel=1e-5)
    torch.testing.assert_close(flight["state"].to_dict(), rounds[-1][1]["state"].to_dict(), rtol=0, atol=0)
    own = {"episode_metrics": lambda _, flight: {"height": flight["next", "state", "position"][:, -1, 2:]}}
    with pytest.raises(ValueError, match=r"Own.episode_metrics: 'height' must have .* shape \(4,\); got \(4, 1\)"):
        evaluate(type("Own", (LandingEnv,), own)(num_envs=4, max_episode_steps=10), actor)


def judged(actor, seed=99, **options):
    """The metrics of fresh episodes of hovering, flown by the mean action."""
    env = HoveringEnv(seed=seed, **options)
    with torch.no_grad():
        mode = {"exploration_type": ExplorationType.DETERMINISTIC}
        flight, _ = differentiable_rollout(env, actor, None, env.max_episode_steps, **mode)
    return env.episode_metrics(flight)


def test_shac_learns_to_hover_in_seconds():
    coarse = {"dynamics": "point_mass", "num_envs": 64, "control_dt": 0.05, "dt": 0.05, "max_episode_steps": 100}
    iterations = 70
    env = HoveringEnv(seed=0, **coarse)
    actor = make_actor(env, input_scale=0.5)
    loss = SHACLoss(actor, make_value(env, input_scale=0.5))
    target = SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(actor.parameters(), 2e-2, betas=(0.7, 0.95))
    critic_optimizer = torch.optim.Adam(loss.value_network_params.parameters(), 5e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, iterations)
    assert judged(actor, **coarse)["solved"].mean() < 0.1
    carry = env.reset()
    for _ in range(iterations):
        rollout, carry = differentiable_rollout(env, actor, carry, 24)
        optimizer.zero_grad()
        loss.loss_actor(rollout)[0].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        schedule.step()
        data = loss.write_value_target(rollout.detach()).reshape(-1)
        for batch in data[torch.randperm(len(data))].split(512):
            critic_optimizer.zero_grad()
            loss.loss_value(batch)[0].backward()
            critic_optimizer.step()
            target.step()
        carry = restart(env, carry, 0.1)
    assert judged(actor, **coarse)["solved"].mean() >= 0.9


def summary(folder, recipe, *overrides):
    command = [sys.executable, f"recipes/{recipe}.py", *overrides, f"hydra.run.dir={folder}"]
    run(*command, timeout=None)
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["abpt", "bptt", "shac", "sapo", "ahac", "train"])
def test_every_recipe_learns_to_hover(recipe, tmp_path):
    found = summary(tmp_path, recipe)
    assert found["solved"] >= 0.99 and found["position_error"] < 0.05


@pytest.mark.slow
def test_the_program_of_the_readme_learns_to_hover():
    program = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    names = {}
    exec(program, names)
    metrics = judged(names["actor"], num_envs=256)
    assert metrics["solved"].all() and metrics["position_error"].median() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("task", ["landing", "tracking", "racing"])
def test_abpt_lands_tracks_and_flies_two_laps(task, tmp_path):
    found = summary(tmp_path, "abpt", f"task={task}")
    assert found["gates_passed"] >= 8 if task == "racing" else found["solved"] >= 0.95
    assert task != "tracking" or found["tracking_rmse"] < 0.05


@cases(
    (r"(?m)^(step|epochs):.*\n", "", "no step, no epochs"),
    ("(?m)^actor:\n", "older: 1\nactor:\n  gone: 0.5\n  off: 0.0\n", "older, actor.gone"),
)
def test_what_an_older_recipe_wrote_can_be_flown_but_not_continued(
    pattern, lines, had, train, launch, refused, no_pictures, tmp_path
):
    train("train", tmp_path)
    path = tmp_path / "checkpoint.pt"
    saved = read_checkpoint(path)
    saved["config"] = re.sub(pattern, lines, saved["config"])
    write_checkpoint(path, saved, None)
    assert "4 fresh episodes" in launch("evaluate", f"checkpoint={path}", "episodes=4")
    said = refused("train", f"resume={path}", "total_steps=960")
    assert f"{path} was written by an older train.py, which had {had}. Continue it with that version" in said
