"""The two towers meet in the recipes alone."""

import ast
from pathlib import Path

import pytest

import torchrl_quad

PACKAGE = Path(torchrl_quad.__file__).parent
ALLOWED = {  # what each part of the package may import of the others
    "dynamics": set(),
    "envs": {"dynamics"},
    "render": {"dynamics", "envs"},
    "modules": set(),
    "objectives": set(),
    "data": set(),
}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("part", ALLOWED)
def test_each_part_imports_only_what_it_may(part):
    files = list((PACKAGE / part).glob("**/*.py"))
    assert files
    for path in files:
        names = list(imports(path))
        parts = {name.split(".")[1] for name in names if name.startswith("torchrl_quad.")} - {part}
        assert parts <= ALLOWED[part], path
        if part == "dynamics":
            assert not any(name.split(".")[0] in ("torchrl", "tensordict") for name in names), path


def test_every_public_part_is_covered():
    assert {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()} == set(ALLOWED)
