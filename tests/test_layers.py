"""The two towers meet in the recipes alone."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_quad

PACKAGE = Path(torchrl_quad.__file__).parent
ALLOWED = {  # what each part of the package may import of the others
    "dynamics": set(),
    "engine": set(),
    "envs": {"dynamics", "engine", "render"},  # render only within env.render(), see below
    "render": {"data", "dynamics", "envs", "files"},  # of data, base_env alone
    "modules": {"data"},  # base_env alone
    "objectives": set(),
    "data": set(),
    "files": set(),
    "diagnostics": {"data", "objectives"},
    "gym": {"envs"},
}

TORCHRL = {"torch", "torchrl", "tensordict"}
LIBRARIES = {
    "dynamics": {"torch", "numpy", "yaml"},
    "engine": {"torch", "tensordict"},
    "envs": TORCHRL | {"numpy"},
    "render": TORCHRL | {"matplotlib", "mpl_toolkits", "plotly", "PIL", "numpy"},
    "modules": TORCHRL,
    "objectives": TORCHRL,
    "data": TORCHRL,
    "files": set(),
    "diagnostics": TORCHRL,
    "gym": {"gymnasium", "numpy", "torch"},
}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("part", ALLOWED)
def test_each_part_imports_only_what_it_may(part):
    files = [*PACKAGE.glob(f"{part}/**/*.py"), *PACKAGE.glob(f"{part}.py")]
    assert files
    for path in files:
        names = list(imports(path))
        parts = {name.split(".")[1] for name in names if name.startswith("torchrl_quad.")} - {part}
        assert parts <= ALLOWED[part], path
        outside = {name.split(".")[0] for name in names} - sys.stdlib_module_names - {"torchrl_quad"}
        assert outside <= LIBRARIES[part], path


def test_environments_load_what_draws_only_when_they_are_asked_to_draw():
    program = "import sys, torchrl_quad; assert not {'torchrl_quad.render', 'matplotlib'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_public_part_is_covered():
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert folders | {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"} == set(ALLOWED)
