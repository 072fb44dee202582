"""Every example, on a budget of two."""

import re
import runpy
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from torchrl.envs.utils import check_env_specs

from torchrl_quad import audit_reward, differentiable_rollout, make_actor, make_env

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.py"))
BUDGET = re.compile(r"^(STEPS|ITERATIONS) = [\d_]+$", flags=re.MULTILINE)
LONG = {r"(?<=rollout\()256\b|(?<=actor, None, )256\b": "20", r"\(8, 16, 32, 64\)": "(2, 4)"}
LONG |= {"max_envs=8": "max_envs=2", r"(?<=actor, carry, )\d\d\b": "8", r"(?<=ForestEnv\(num_envs=)\d+": "2"}
LONG |= {r"(?<=HoveringEnv\(num_envs=)8(?=, drone=)": "2, max_episode_steps=40", r"\bsteps=3\)": "steps=3, horizon=4)"}


def reduced(program):
    """A program on a budget of two, whose horizons and final flights are short."""
    for long, short in LONG.items():
        program = re.sub(long, short, program)
    return BUDGET.sub(r"\1 = 2", program)


@pytest.mark.usefixtures("quick_fits")
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_short_and_runs(example, tmp_path, monkeypatch):
    assert len(example.read_text().splitlines()) < 60
    small = tmp_path / example.name
    small.write_text(reduced(example.read_text()))
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(small), run_name="__main__")


TASKS = sorted((EXAMPLES[0].parent / "tasks").glob("*.py"))
ATTITUDE = "'attitude' is less than a thousandth of return and gradient: it teaches nothing"


@pytest.mark.parametrize("task", TASKS, ids=lambda path: path.stem)
def test_every_task_of_the_gallery_is_short_and_listed_keeps_the_rules_and_its_reward_has_no_trap(task):
    readme = task.parent / "README.md"
    assert len(task.read_text().splitlines()) <= 40 and f"[{task.stem}]({task.name})" in readme.read_text()
    assert sum(path.stat().st_size for path in task.parent.glob("*.png")) < 400_000
    env = make_env(f"examples.tasks.{task.stem}.{task.stem.title()}", num_envs=2, seed=0)
    check_env_specs(env)
    actor = make_actor(env)
    rollout, _ = differentiable_rollout(env, actor, env.reset(), 8)
    audit = audit_reward(rollout, actor, gamma=0.99)
    assert [x for x in audit.traps if x != ATTITUDE] == []  # the paper's weight, where a task has the paper's reward
    assert {x.verdict for x in audit.values()} <= {"differentiable", "constant", "not seen"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_ppo_of_stable_baselines3_beats_random_actions(seed):
    (path,) = (path for path in EXAMPLES if path.stem.startswith("10_"))
    example, random = runpy.run_path(str(path)), np.random.default_rng(seed)
    drones = gymnasium.make_vec(example["TASK"], num_envs=128)
    drones.reset(seed=seed)
    by_chance, first = 0.0, np.ones(128, dtype=bool)
    while first.any():
        _, reward, terminated, truncated, _ = drones.step(random.uniform(-1, 1, (128, 4)))
        by_chance, first = by_chance + (reward * first).mean(), first & ~(terminated | truncated)
    learnt = example["train"](seed)
    print(f"seed {seed}: random {by_chance:.2f}, PPO {learnt:.2f}")
    assert learnt > by_chance + 12  # of 25.6 at most
