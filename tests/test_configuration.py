"""The schema of the configuration: what is refused, and what is said instead."""

import pytest
from helpers import cases, refuses
from omegaconf import OmegaConf

from torchrl_quad import load_drone
from torchrl_quad.envs import TASKS
from torchrl_quad.training.configuration import compose, plain, tuned
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
    ("gamma=2", "gamma=2: it must be at most 1. .* 0.99 is usual"),
    ("gamma=nan", "gamma=nan: it must be a finite number"),
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
    one = [OmegaConf.masked_copy(found["train", task], settings("train").keys() - {"task", "env"}) for task in TASKS]
    assert all(cfg == one[0] for cfg in one)


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
