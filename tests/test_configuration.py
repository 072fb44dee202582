"""The schema of the configuration, what is refused and what is said instead; tasks and recipes of somebody's own."""

import importlib
import json
import math
import re
import sys

import gymnasium
import pytest
from helpers import SMALL, cases, refuses, rows
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf
from own_task import CornerEnv
from test_docs import ROOT, files, importable  # noqa: F401, a fixture

from torchrl_quad import HoveringEnv, QuadrotorEnv, TrackingEnv, available_tasks, load_drone, make_env, register_task
from torchrl_quad.envs import TASKS, registry
from torchrl_quad.training.checkpoints import read_checkpoint
from torchrl_quad.training.configuration import compose, defaults, plain, tuned
from torchrl_quad.training.launch import _joined
from torchrl_quad.training.schema import IDLE, LOSSES, check, schema_of, settings

TUNED = tuned()
RECIPES = sorted(LOSSES)

REFUSED = [  # of ABPT, unless a recipe is named
    ("actor.max_grad_norm=-1", "actor.max_grad_norm=-1: it must be greater than 0. Longer gradients are shortened"),
    ("actor.betas=[0.9]", r"actor.betas=\[0.9\]: it must have at least 2 items, not 1. .* such as \[0.9, 0.999\]"),
    ("actor.betas=[0.9,1.0]", r"actor.betas\[1\]=1.0: it must be less than 1"),
    ("actor.num_cells=64", r"actor.num_cells=64: it must be a list. .* or \[64\] for one layer"),
    ("actor.activation=functional", "actor.activation=functional: it must be 'CELU', 'ELU', .* or 'Tanh'"),
    ("actor.final_lr=0 actor.schedule=exponential", "actor.final_lr=0: it must be above 0 with schedule=exponential"),
    ("actor.schedule=step", "actor.schedule=step: it must be 'constant', 'linear', .* or 'inverse_sqrt'"),
    ("critic.updates=null", "critic.updates=null: it must be a whole number"),
    ("actor.scale_init=abc", "actor.scale_init=abc: it must be a number"),
    ("gamma=2", "gamma=2: it must be at most 1. .* 0.99 is usual"),
    ("gamma=nan", "gamma=nan: it must be a finite number"),
    ("buffer.fraction=2", "buffer.fraction=2: it must be at most 1. .* null for none"),
    ("eval.interval=0", "eval.interval=0: it must be at least 1. Iterations between evaluations"),
    ("normalize=5", "normalize=5: it must be true or false"),
    ("horizon=2.5", "horizon=2.5: it must be a whole number"),
    ("total_steps=1e6", "total_steps=1000000.0: it must be a whole number, written 1000000"),
    ("seed=true", "seed=True: it must be a whole number"),
    ("device=gpu", "device=gpu: it must be a device of this machine that torch knows"),
    ("num_envs=100000000", "num_envs=100000000: it must be at most 10000000. .* no memory holds more"),
    ("env.dt=0", "env.dt=0: it must be at least 0.000001. The physics step"),
    ("env.event_discount=0", "env.event_discount=0.*: it must be greater than 0. .* null for no gradient in it"),
    ("env.dynamics=point", "env.dynamics=point: it must be one of quadrotor, point_mass"),
    ("env=3", "env=3: it must be a section with settings of its own"),
    ("loss.alpha=never", "loss.alpha=never: it must be a number. .* or auto to hold the entropy"),
    ("sapo loss.target_entropy=1", "loss.target_entropy=1: it must be at most -0.001. .* auto for minus half"),
    ("logger.backend=csvv", "logger.backend=csvv: it must be 'wandb', 'tensorboard' or 'csv'"),
    ("resume=none.pt", "resume=none.pt: it must be the path of a checkpoint.pt that exists, or auto"),
    ("+gama=0.9", "gama is unknown: this recipe has no such setting. Did you mean gamma?"),
    ("+loss.delay_value=abc", "loss.delay_value is unknown, or set by the recipe. Choose from: alpha"),
    ("ppo loss.loss_critic_type=l3", "loss.loss_critic_type=l3: it must be 'l1', 'l2' or 'smooth_l1'"),
    ("ppo +loss.gamma=0.9", "loss.gamma is unknown, or set by the recipe"),
    ("critic=null", "critic=null: it must be a section with settings of its own"),
    ("ppo loss.clip_epsilon=-1", "loss.clip_epsilon=-1: it must be greater than 0"),
    ("~critic.tau", "critic.tau is missing: do not delete it"),
    ("env.control_dt=${nothing}", "env.control_dt: Interpolation key 'nothing' not found"),
    ("evaluate", "checkpoint is missing: write checkpoint=... on the command line"),
]


def composed(recipe, *overrides):
    return compose(recipe, overrides)


@pytest.mark.parametrize(("words", "message"), REFUSED, ids=[words for words, _ in REFUSED])
def test_a_setting_out_of_its_range_is_refused_with_what_to_write_instead(words, message):
    first, *rest = words.split()
    recipe, overrides = (first, rest) if first in (*RECIPES, "evaluate") else ("abpt", [first, *rest])
    cfg = composed(recipe, *overrides)
    refuses(message, check, cfg)


IGNORED = {  # what a person wrote, which nothing would read
    "abpt tuned=abpt": "tuned=abpt: nothing has this name in .*by_task. Choose from: abpt_",
    "bptt +epochs=3": "epochs is unknown: this recipe has no such setting",
    "bptt +critic.updates=3": "critic is unknown: this recipe has no such setting. Leave it out.",
    "sapo +critic.tau=0.1": "critic.tau is unknown",
    "shac task=racing tuned=shac_racing_positon": "tuned=shac_racing_positon: .* Choose from: shac_racing_position",
    "shac actor.schedule=constant actor.final_lr=0.1": "actor.final_lr=0.1 has no effect: actor.schedule=constant",
    "hybrid actor.schedule=cosine": "actor.schedule=cosine has no effect: actor.max_kl sets the rate",
    "abpt normalize=true critic.input_scale=2.0": "critic.input_scale=2.0 has no effect: normalize=true",
    "bptt actor.channels=[4]": r"actor.channels=\[4\] has no effect: env.camera=null",
    "bptt task=forest actor.recurrent=false actor.hidden_size=8": "actor.hidden_size=8 has no effect",
    "bptt task=forest env.difficulty=hard env.gap=1.0 env.density=0.1": "env.difficulty=hard has no effect: env.dens",
    "bptt task=forest env.scene={ground:true} env.gap=1.0": "env.gap=1.0 has no effect: env.scene is set",
    "shac +loss.target_entropy=-1.0": "loss.target_entropy=-1.0 has no effect: loss.alpha is not auto",
    "sapo loss.alpha=0.1 loss.alpha_init=1.0": "loss.alpha_init=1.0 has no effect: loss.alpha is not auto",
    "pods loss.iterations=3": "loss.iterations=3 has no effect: loss.order=1",
    "abpt buffer.fraction=null buffer.capacity=100": "buffer.capacity=100 has no effect: buffer.fraction=null",
    "bptt task=forest actor.recurrent=false actor={hidden_size:8}": "actor.hidden_size=8 has no effect: actor.rec",
    "ppo env.event_discount=0.9": "env.event_discount=0.9 has no effect: PPO follows no gradient",
    "ppo +loss.entropy_coeff=0.1": "loss.entropy_coeff=0.1 has no effect: loss.entropy_bonus=false",
    "bptt logger.project=mine": "logger.project=mine has no effect: it is wandb's",
    "abpt restart_fraction=0.1": "restart_fraction=0.1 has no effect: buffer.fraction",
}


@pytest.mark.parametrize("words", IGNORED)
def test_what_a_person_writes_takes_effect_or_is_refused(words):
    recipe, *overrides = words.split()
    refuses(IGNORED[words], check, composed(recipe, *overrides), overrides)
    check(composed(recipe, *overrides[:-1]), overrides[:-1])


def test_every_setting_that_another_may_switch_off_is_one():
    known = [OmegaConf.create(settings(recipe)) for recipe in RECIPES]
    for names, *_ in IDLE:
        for name in names.split():
            shipped = any(OmegaConf.select(node, name, default="") != "" for node in known)
            assert shipped or name in ("env.difficulty", "env.density", "env.gap", "loss.entropy_coeff"), name


@pytest.mark.parametrize("name", TUNED)
def test_every_configuration_that_ships_passes_the_schema_with_its_tuned_values(name):
    recipe, task, *variant = name.split("_", 2)
    assert recipe in RECIPES and task in TASKS  # or nobody would ever read the section
    cfg = composed(recipe, f"task={task}", *([f"tuned={name}"] if variant else []))
    check(cfg)
    assert OmegaConf.merge(cfg, {key: x for key, x in plain(TUNED[name]).items() if key != "defaults"}) == cfg


def test_recipes_pass_the_schema_on_tasks_that_they_are_not_tuned_for_and_one_has_the_same_numbers_for_all():
    missing = {(recipe, task) for recipe in RECIPES for task in TASKS} - {tuple(name.split("_")) for name in TUNED}
    found = {run: composed(run[0], f"task={run[1]}") for run in sorted(missing)}
    for cfg in found.values():
        check(cfg)
    one = [plain(found["train", task]) | {"task": "", "env": {}} for task in TASKS]  # times of its env not resolved
    assert all(cfg == one[0] for cfg in one)


@pytest.mark.parametrize("period", [0.005, 0.02, 0.04])
def test_one_setting_spans_the_same_times_at_every_control_period(period):
    cfg = composed("train", f"env.control_dt={period}")
    check(cfg)
    lasting = cfg.gamma, cfg.env.event_discount, cfg.critic.lmbda, cfg.loss.gradient_lmbda, cfg.actor.noise_correlation
    times = [cfg.horizon * period, *(period / (1.0 - share) for share in lasting)]
    assert times == pytest.approx([1.28, 2.0, 2.0, 0.4, 1.0, 0.2])
    cfg = composed("train", "env.control_dt=1", "env.dt=0.02", "horizon=64")  # what is shorter than a step
    assert (cfg.horizon, cfg.actor.noise_correlation, cfg.gamma) == (64, 0.0, 0.5)


@cases(
    (["env.randomize=any"], (256, 24_000_000, 2)),
    (["env.randomize=any", "num_envs=8"], (8, 24_000_000, 2)),
    (["env.randomize={mass: {scale: [0.8, 1.2]}}"], (64, 6_000_000, 8)),
)
def test_one_setting_flies_more_drones_where_each_is_another(words, expected):
    cfg = composed("train", *words)
    check(cfg)
    assert (cfg.num_envs, cfg.total_steps, cfg.min_epochs) == expected


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_command_line_has_the_last_word_and_may_set_what_is_optional(recipe):
    assert composed(recipe, "task=racing", "horizon=7").horizon == 7
    check(composed(recipe, "env.weights={velocity: 0}", "env.wind={gust: 0.5}", "env.event_discount=0.99"))


def numbers(values, schema, path=""):
    """The numbers of a configuration, each with its name and its field of the schema."""
    for name, value in values.items():
        field = schema.model_fields.get(name)
        if isinstance(value, dict) and hasattr(field.annotation, "model_fields"):
            yield from numbers(value, field.annotation, f"{path}{name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield path + name, field


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_number_that_ships_has_a_type_and_a_range(recipe):
    values = OmegaConf.to_container(composed(recipe), resolve=True)
    found = dict(numbers(values, schema_of(values)))
    assert len(found) > 20
    for name, field in found.items():
        assert any(word in repr(field) for word in ("Ge(", "Gt(", "Literal[")), name


def test_a_refused_run_leaves_no_folder_and_one_line_and_torchrun_takes_no_gpu_by_name(refused, tmp_path, monkeypatch):
    assert "total_step is unknown: this recipe has no such setting. Did you" in refused("bptt", "total_step=1")
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path)
        assert "weights: unknown term ring. Choose from: " in refused("bptt", "env.weights.ring=1")
    line = refused("bptt", "gamma=2", f"hydra.run.dir={tmp_path}/outputs/run")
    assert line.startswith("Error: gamma=2: it must be at most 1.")
    assert not list(tmp_path.iterdir())
    monkeypatch.setenv("RANK", "0")
    said = "device=cuda:0: under torchrun each process takes its own GPU. Write device=cuda."
    with pytest.raises(ValueError, match=said), _joined(OmegaConf.create({"device": "cuda:0"})):
        raise AssertionError("It is refused before anything is joined.")


ALIASES = "a0: &a0 [1, 1]\n" + "".join(f"a{i + 1}: &a{i + 1} [*a{i}, *a{i}]\n" for i in range(40))


@cases(
    (ALIASES.encode(), "line 2 uses the alias \\*a0. Write the values out instead"),
    (b"mass: " + b"[" * 5000 + b"]" * 5000, "nests more than 20 lists or mappings"),
    ("mass: 1  # Größe".encode("latin-1"), "not in UTF-8 .byte 13 is 0xf6.. Save it as UTF-8"),
    (b"#" * 1_000_001, "has more than 1,000,000 bytes"),
    (b"mass: 1\nmass: 2", "line 2 names 'mass' for the second time"),
    (b"mass: !!int 1:30", "line 1 uses the tag"),
    (b"[1]: 2", "line 1 names a value by a list or a mapping, and a name must be a word"),
    (b"mass: [1", "not a YAML file"),
    (b"mass: " + b"9" * 5000, "line 1 has a number of 5000 digits"),
    ids=["aliases", "deep", "latin-1", "large", "twice", "tag", "no name", "cut off", "long number"],
)
def test_a_yaml_file_that_no_setting_needs_is_refused_by_name(content, message, tmp_path):
    (tmp_path / "mine.yaml").write_bytes(content)
    refuses(f"mine.yaml: {message}", load_drone, tmp_path / "mine.yaml")


@pytest.fixture(autouse=True)
def forget(monkeypatch):
    """What a test registers is known to it alone."""
    monkeypatch.setattr(registry, "TASKS", dict(TASKS))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    monkeypatch.setattr(ConfigStore.instance(), "repo", dict(ConfigStore.instance().repo))


def test_one_line_makes_a_task_known_to_make_env_and_to_gymnasium():
    register_task("fly_to_corner", CornerEnv)
    register_task("fly_to_corner", CornerEnv)  # a cell of a notebook that runs again
    assert "fly_to_corner" in available_tasks() and type(make_env("fly_to_corner", num_envs=2, reach=0.1)) is CornerEnv
    drones = gymnasium.make_vec("torchrl_quad/FlyToCorner-v0", num_envs=2, reach=0.1)
    assert drones.reset(seed=0)[0].shape == (2, 13)
    assert type(make_env("own_task.CornerEnv", num_envs=2)) is CornerEnv  # without any name


class LateEnv(CornerEnv):
    def __init__(self, num_envs=8, **kwargs):
        self.corner = self.tensor([1.0, 1.0, 1.0])
        super().__init__(num_envs, **kwargs)


class LaterEnv(LateEnv):
    def __init__(self, num_envs=8, *, speed=1.0, **kwargs):
        QuadrotorEnv.__init__(self, num_envs, **kwargs)
        self.reach = speed


@pytest.mark.parametrize("task", [LateEnv, LaterEnv])
def test_what_is_set_too_early_or_too_late_comes_with_a_note_of_the_order(task):
    with pytest.raises(AttributeError, match="no attribute '(randomness|reach)'") as refused:
        task()
    assert "set what they read before it, and make tensors in set_up" in refused.value.__notes__[0]
    with pytest.raises(AttributeError, match="no attribute 'unifrom'") as refused:  # a slip, and no matter of order
        type("OwnEnv", (HoveringEnv,), {"observe": lambda env, _: env.unifrom(4)})()
    assert not hasattr(refused.value, "__notes__")


class UnfinishedEnv(QuadrotorEnv):
    def observe(self, state):
        return state["position"]


@cases(
    ("Window", CornerEnv, ValueError, "small letters, digits and underscores, such as 'window'; got 'Window'"),
    ("hovering", CornerEnv, ValueError, "is torchrl_quad.envs.hovering.HoveringEnv already. Choose another name"),
    ("x", CornerEnv(num_envs=1), TypeError, "subclass of QuadrotorEnv, itself and not an instance; got CornerEnv"),
    ("x", dict, TypeError, "a subclass of QuadrotorEnv, itself and not an instance; got the class dict"),
    ("x", UnfinishedEnv, TypeError, "UnfinishedEnv lacks initial_state, is_crash, is_success, reward_terms. docs/"),
)
def test_what_is_no_task_is_refused_when_it_is_registered(name, cls, error, message):
    refuses(message, register_task, name, cls, error=error)


@cases(
    ("window", "Unknown task 'window'. Choose from: .*racing.* give the path .*, or call register_task"),
    ("no_package.WindowEnv", "Python finds no module 'no_package'. Put its folder on PYTHONPATH, or install"),
    ("own_task.Corner", "the module 'own_task' .* has no 'Corner'. Write one of: own_task.CornerEnv"),
    ("own_task.norm", "a task is a subclass of QuadrotorEnv"),
    ("examples.tasks.flip", "'examples.tasks.flip': this is a module. Write one of: examples.tasks.flip.Flip"),
    ("torchrl_quad.envs.forest", "this is a module. Write one of: torchrl_quad.envs.forest.ForestEnv"),
    ("examples.tasks.flop.Flip", "'examples.tasks' has no 'flop'. Write the path of a class in one of .*: .*flip, "),
    ("own_task.corner.CornerEnv", "the module 'own_task' .* has no 'corner'. Write one of: own_task.CornerEnv"),
)
def test_recipes_say_in_one_line_how_a_task_that_they_do_not_know_becomes_known(task, message, refused, tmp_path):
    assert re.search(message, refused("bptt", f"task={task}", f"hydra.run.dir={tmp_path}/run"))
    assert not list(tmp_path.iterdir())


@cases(
    ("env.reach=far", "env.reach=far: it must be a number"),
    ("env.patience=0.5", "env.patience=0.5: it must be a whole number"),
    ("+env.rech=1", "argument 'rech'. Did you mean 'reach'?"),
    ("+env.seed=1", "env.seed: recipes set it for all environments. Write seed=..., without env"),
)
def test_the_settings_of_a_task_come_from_its_signature_and_are_checked_by_it(words, message):
    assert defaults(CornerEnv) == {"reach": 0.5, "patience": None, "dt": 0.01, "max_episode_steps": 256}
    assert defaults(HoveringEnv) == {"max_episode_steps": 256}
    task = "task._target_=own_task.CornerEnv"
    check(composed("bptt", task, "env.reach=1", "env.patience=3"))
    refuses(re.escape(message), check, composed("bptt", task, words), error=(ValueError, TypeError))


@cases(
    ("env.disturbances=[own_task.ABPTLoss]", "=own_task.ABPTLoss: it must be a subclass of Disturbance"),
    ("env.disturbances=[own_task.Pull]", "'own_task.Pull': the module 'own_task' .* has no 'Pull'"),
    ("env.disturbances=[Push]", "env.disturbances='Push': it must be the path of a class"),
    ("env.disturbances=own_task.Push", "env.disturbances=own_task.Push: it must be a list"),
    ("env.disturbances=[{_target_: own_task.Push, force: 1}]", "unknown key 'force'. Allowed: streng"),
    ("loss._target_=own_task.Push", "loss._target_=own_task.Push: it must be a subclass of ABPTLoss"),
    ("loss._target_=own_task.ThriftyLoss loss.efort=1", "loss.efort is unknown.* effort, "),
    ("loss._target_=own_task.ThriftyLoss loss.effort=low", "loss.effort=low: it must be a number"),
    ("loss._target_=own_task.ThriftyLoss loss.alpha=-1", "loss.alpha=-1: it must be at least 0"),
)
def test_a_disturbance_or_a_loss_of_your_own_that_does_not_fit_is_refused(words, message):
    overrides = words.split(" loss")
    overrides = [overrides[0], *(f"loss{word}" for word in overrides[1:])]
    refuses(message, check, composed("abpt", *overrides), overrides, error=(ValueError, TypeError))


def test_what_is_your_own_trains_resumes_is_evaluated_and_exported_as_what_ships(train, launch, refused, tmp_path):
    own = ["task._target_=own_task.CornerEnv", "env.disturbances=[{_target_: own_task.Push, strength: 0.1}]"]
    own += ["loss._target_=own_task.ThriftyLoss", "loss.effort=0.2"]
    first = train("abpt", tmp_path, *own, "env.reach=0.1")
    saved = train("abpt", tmp_path, *own, "resume=auto", "total_steps=240")
    assert saved["iteration"] == 10
    assert "task: own_task.CornerEnv" in saved["config"] and "effort: 0.2" in saved["config"]
    assert first["rows"][0]["train/effort"] < 0
    assert float(rows(tmp_path)[-1]["eval/corner_error"]) > 0
    trust = "trust=[own_task.CornerEnv, own_task.Push, own_task.ThriftyLoss]"
    for recipe, setting in ("evaluate", "checkpoint"), ("abpt", "resume"):
        said = refused(recipe, f"{setting}={tmp_path}/checkpoint.pt")
        assert said.endswith(f"file names is not run: if you trust it, write '{trust}'.")
    printed = launch("evaluate", f"checkpoint={tmp_path}/checkpoint.pt", trust)
    assert "abpt on own_task.CornerEnv" in printed and "distance to the corner" in printed
    summary = json.loads((tmp_path / "evaluation.json").read_text())
    assert summary["corner_error"] == json.loads((tmp_path / "summary.json").read_text())["corner_error"]
    printed = launch("export", f"checkpoint={tmp_path}/checkpoint.pt", trust, "episodes=4")
    assert "policy: flies own_task.CornerEnv; its actions differ by at most" in printed


@pytest.mark.usefixtures("importable", "no_pictures")
def test_a_recipe_outside_the_repository_is_short_and_takes_any_task(tmp_path, monkeypatch, capsys):
    """The programs of docs/writing.md, in files, as the page says."""
    assert all(len(content.splitlines()) < 60 for content in files().values())
    register_task("fly_to_corner", CornerEnv)
    sweep = ["hydra/launcher=basic", f"hydra.sweep.dir={tmp_path}/run", "hydra.sweep.subdir=${task}"]
    own = ["task=shuttle.ShuttleEnv,fly_to_corner", "loss.smoothness=0.3"]
    monkeypatch.setattr(sys, "argv", ["smooth.py", "--multirun", *SMALL, *sweep, *own])
    importlib.import_module("smooth").main()
    printed = capsys.readouterr().out
    assert "smooth on shuttle.ShuttleEnv, seed 0" in printed and "smooth on fly_to_corner, seed 0" in printed
    saved = read_checkpoint(tmp_path / "run/shuttle.ShuttleEnv/checkpoint.pt")
    assert "smoothness: 0.3" in saved["config"] and "algorithm: smooth" in saved["config"]
    assert math.isfinite(saved["best"]["return"])


def test_a_task_may_have_other_defaults_of_arguments_that_callers_and_recipes_see_and_may_change():
    class NearEnv(CornerEnv):
        defaults = {"reach": 0.1, "drone": "racer", "num_envs": 3}

    env = NearEnv()
    assert (env.num_envs, env.reach, NearEnv(2, reach=0.3).reach, NearEnv(2).num_envs) == (3, 0.1, 0.3, 2)
    assert "drone='racer'" in repr(env) and "drone='racer'" in repr(env.rebuilt(num_envs=2))
    assert defaults(NearEnv) == {**defaults(CornerEnv), "reach": 0.1, "drone": "racer"}
    assert type("NearerEnv", (NearEnv,), {"defaults": {"reach": 0.2}}).defaults == {**NearEnv.defaults, "reach": 0.2}
    NearEnv.defaults = {"drne": "racer"}
    refuses("argument 'drne'. Did you mean 'drone'", NearEnv, error=TypeError)
    for name, value in (("drone", "racer"), ("control_dt", 0.01), ("reach", 0.1)):
        both = dict(sorted({"num_envs": 3, name: value}.items()))
        message = f"FarEnv.{name} is an argument, .* Write defaults = {both}."
        refuses(message, type, "FarEnv", (CornerEnv,), {name: value, "defaults": {"num_envs": 3}}, error=TypeError)


def test_a_metric_that_is_described_and_not_given_is_named():
    silent = type("SilentEnv", (CornerEnv,), {"metrics": lambda self, state: {}})
    refuses(r"SilentEnv.metrics\(state\) lacks corner_error, which metric_info describes", silent)


@pytest.mark.parametrize("task", [HoveringEnv, TrackingEnv])
def test_an_episode_is_solved_by_a_success_of_your_own(task):
    class Own(task):
        def is_success(self, state):
            return state["step"] % 2 == 0

    for steps, solved in ((4, 1.0), (3, 0.0)):
        env = Own(num_envs=2, max_episode_steps=steps)
        metrics = env.episode_metrics(env.rollout(steps, auto_reset=True))
        assert metrics["solved"].tolist() == [solved] * 2
