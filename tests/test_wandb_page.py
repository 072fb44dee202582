"""What wandb's agent makes of our sweep, and how recipes read the arguments it writes."""

import pytest
import yaml
from conftest import RECIPES
from omegaconf import OmegaConf
from refusals import cases

from torchrl_quad.training.configuration import hydra_argument


@pytest.mark.parametrize("style", ["args", "args_no_hyphens"])
def test_a_sweep_hands_over_mappings_and_null_as_people_write_them(train, tmp_path, style):
    from wandb.sdk.launch.sweeps.utils import create_sweep_command_args

    text = (RECIPES / "sweep.yaml").read_text().split("\n", 1)[1]
    assert text in (RECIPES.parent / "docs/wandb.md").read_text()  # the page shows the file
    sweep = yaml.safe_load(text)
    assert sweep["program"] == "recipes/abpt.py" and sweep["metric"] == {"name": "best/return", "goal": "maximize"}
    last = -1 if style == "args" else 0
    values = {name: x.get("values", [x.get("value", 0.01)])[last] for name, x in sweep["parameters"].items()}
    arguments = create_sweep_command_args({"args": {name: {"value": value} for name, value in values.items()}})[style]
    arguments = [x for x in arguments if "logger." not in x]
    checkpoint = train("abpt", tmp_path, *arguments, "total_steps=24", "horizon=6", "--logger.backend=None")
    cfg = OmegaConf.create(checkpoint["config"])
    assert cfg.env.wind == {"mean": [1.0, 0.0, 0.0], "gust": 0.5} and cfg.actor.lr == 0.01
    assert cfg.env.randomize == values["env.randomize"] == (None if last == 0 else {"mass": {"scale": [0.8, 1.2]}})


@cases(
    ('env.wind={"mean": [1, 0.5, -1e-05], "gust": null}', "env.wind={mean: [1, 0.5, -1e-05], gust: null}"),
    ("+a={'b c': \"it's\", 'd': True}", r"""+a={b\ c: "it's", d: True}"""),
    ("a=None,{'b': [1, 2]}", "a=null,{b: [1, 2]}"),  # a sweep of hydra's
    ("--actor.num_cells=[32, 32]", "actor.num_cells=[32, 32]"),
    ("env.wind={mean: [1, 0, 0]}", "env.wind={mean: [1, 0, 0]}"),
    *((x, x) for x in ("env.drone=None_of_them", "--config-name=abpt", "--cfg=job", "--multirun", "~env.wind")),
)
def test_arguments_come_in_the_grammar_of_hydra(written, read):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    assert hydra_argument(written) == read == hydra_argument(read)
    if not read.startswith("--"):
        OverridesParser.create().parse_override(read)
