"""Source distribution and wheel: what is in them, and that they work without the repository."""

import importlib.metadata
import os
import shutil
import sys
import tarfile
import tomllib
import zipfile

import yaml
from helpers import ROOT, run
from packaging.specifiers import SpecifierSet

PROGRAM = """
import importlib.util, pathlib, torchrl_quad
from torchrl_quad.training import configuration, launch, loop

here = pathlib.Path.cwd()
assert all(pathlib.Path(x).is_relative_to(here) for x in (torchrl_quad.__file__, configuration.CONFIG))
assert not any(importlib.util.find_spec(name) for name in ("results", "tables", "training"))
for drone in torchrl_quad.available_drones():
    torchrl_quad.make_env("racing", num_envs=2, drone=drone).rollout(2)

@launch.recipe("bptt", algorithm="smooth", loss={"smoothness": 0.1})
def main(cfg):
    pass

main()
"""


def test_the_distributions_hold_every_file_and_the_wheel_works_away_from_the_repository(tmp_path):
    """The source distribution, and the wheel that is built from it, with the package, presets and types alone."""
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("torchrl_quad", "recipes/config"):  # to which a link in the package leads
        shutil.copytree(ROOT / name, source / name, symlinks=True)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(source))
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    ours = {str(p.relative_to(ROOT)) for p in (ROOT / "torchrl_quad").rglob("*") if p.suffix and p.is_file()}
    assert {path for path in ours if "__pycache__" not in path} | {"README.md", "LICENSE", "pyproject.toml"} <= names
    wheel = next(tmp_path.glob("*.whl"))
    names = zipfile.ZipFile(wheel).namelist()
    own = {str(path.relative_to(ROOT)) for path in (ROOT / "torchrl_quad").rglob("*.yaml")}
    configuration = {path.relative_to(ROOT / "recipes") for path in (ROOT / "recipes/config").rglob("*.yaml")}
    assert own | {f"torchrl_quad/training/{path}" for path in configuration} | {"torchrl_quad/py.typed"} <= set(names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"torchrl_quad"}
    site = str(tmp_path / "site")
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", site, str(wheel))
    (tmp_path / "smooth.py").write_text(PROGRAM)  # a recipe of one's own
    command = [sys.executable, "smooth.py", "--cfg", "job", "task=racing"]  # which shows the configuration
    shown = yaml.safe_load(run(*command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": site}))
    assert (shown["algorithm"], shown["loss"]["smoothness"]) == ("smooth", 0.1)
    assert shown["env"]["max_episode_steps"] == 512
    assert shown["eval"]["interval"] == 20  # of racing in by_task/bptt.yaml


def test_every_python_that_the_package_names_can_have_the_tested_versions():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    prefix = "Programming Language :: Python :: 3."
    named = [f"3.{x.removeprefix(prefix)}.0" for x in project["classifiers"] if x.startswith(prefix)]
    assert all(python in SpecifierSet(project["requires-python"]) for python in named)
    assert f"{sys.version_info.major}.{sys.version_info.minor}.0" in named
    pins = [line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line]
    for name, version in pins:
        if name.startswith("backports."):  # what newer Pythons have themselves
            continue
        try:
            package = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:  # of an extra that is not installed
            continue
        allowed = SpecifierSet(package.metadata.get("Requires-Python", ""))
        assert package.version.split("+")[0] != version or all(python in allowed for python in named), name
