"""Commands that are written anywhere run: those of blocks here, and every other one in a test that it is known by."""

import argparse
import re
import runpy
import shlex
import sys
from importlib.metadata import metadata, version
from pathlib import Path

import pytest
from helpers import ROOT, run
from markdown_it import MarkdownIt
from packaging.requirements import Requirement
from test_docs import PAGES, code, files, importable, name_of  # noqa: F401, a fixture
from test_examples import EXAMPLES
from test_recipes import RECIPES, SMALL

from torchrl_quad.training.configuration import compose
from torchrl_quad.training.schema import check

AFTER_TRAINING = ("evaluate", "export")  # recipes that read a checkpoint
SMOKE = {  # the tests that run a program on a reduced budget
    **{f"recipes/{name}.py": "test_recipes" for name in (*RECIPES, "evaluate")},
    "recipes/adapt.py": "test_adaptation",
    "recipes/export.py": "test_deploy_faults",
    "recipes/identify.py": "test_identification",
    "recipes/import_drone.py": "test_importing",
    "recipes/transfer.py": "test_transfer",
    "benchmarks/paper/reproduce.py": "test_reproduce",
    "benchmarks/paper/results.py": "test_claims",
    **{f"benchmarks/{path.name}": "test_benchmarks" for path in ROOT.glob("benchmarks/*.py")},
    "benchmarks/adaptation.py": "test_adaptation",
    "python -m build": "test_package",
    "wandb": "test_logs",
    "tensorboard": "test_logs",
}


def commands():
    for page in PAGES:
        for _, content in code(page, "bash"):
            for command in content.replace("\\\n", " ").splitlines():
                if words := shlex.split(command, comments=True):
                    yield pytest.param(words, id=f"{name_of(page)}: {shlex.join(words)}")


@pytest.mark.usefixtures("quick_fits", "importable")
@pytest.mark.parametrize("command", list(commands()))
def test_every_command_of_a_block_runs(command, launch, request, monkeypatch, tmp_path):
    program, *words = as_a_script(command)
    if "logger.backend=wandb" not in words:
        request.getfixturevalue("no_pictures")
    if "recipes/export.py" in words:
        request.getfixturevalue("trace_once")("hovering")
    script = next((word for word in words if word.endswith(".py")), "")
    if program == "make":
        run("make", "--dry-run", *words)  # what it does has tests of its own, and `make test` runs this one
    elif program == "pip":
        installs(words)
    elif program in ("python", "torchrun") and Path(script).stem in (*RECIPES, *AFTER_TRAINING):
        recipe(program, words, launch, tmp_path)
    elif program == "python" and script == "recipes/identify.py":
        monkeypatch.chdir(ROOT)  # where the flight is
        arguments = [word for word in words if "=" in word and not word.startswith("iterations=")]
        launch("identify", *arguments, f"folder={tmp_path}", "iterations=1", "draws=0")
    elif program == "python" and script.startswith("examples/"):
        assert ROOT / script in EXAMPLES and words == [script]  # which have a test of their own
    elif program == "python" and script.startswith(("recipes/", "benchmarks/")):
        understands(words, monkeypatch)
    else:
        pytest.fail(f"No test knows how to try {program!r}: add it here, or fence as text what cannot be tried.")


def as_a_script(words):
    """``python -m benchmarks.paper.results`` as the file that it runs."""
    is_ours = words[1:2] == ["-m"] and words[2].startswith("benchmarks.")
    return [words[0], f"{words[2].replace('.', '/')}.py", *words[3:]] if is_ours else words


class Understood(Exception):
    """A program has read its arguments."""


def understands(words, monkeypatch):
    """A program takes these arguments, and a test of its own runs it on a reduced budget."""
    script, *arguments = words
    is_run(script)
    arguments = [re.sub(r"\b(mypackage|shuttle)\.\w+", "own_task.CornerEnv", x) for x in arguments]
    if script in ("recipes/transfer.py", "recipes/import_drone.py"):
        runpy.run_path(str(ROOT / script))["settings"](arguments)
    elif Path(script).parent.name == "recipes":
        settings = [re.sub(r"^([\w.]+=[^,{\[]*),.*", r"\1", x) for x in arguments if not x.startswith(("--", "hydra"))]
        check(compose(Path(script).stem, settings), settings)
    else:

        def parse(parser, *args, read=argparse.ArgumentParser.parse_args):
            read(parser, *args)
            raise Understood

        with monkeypatch.context() as patch:
            patch.setattr(argparse.ArgumentParser, "parse_args", parse)
            patch.setattr(sys, "argv", [script, *(x.strip("[]") for x in arguments)])
            with pytest.raises(Understood):
                runpy.run_path(str(ROOT / script), run_name="__main__")


def is_run(program):
    """A test runs a program: one that nobody runs may end in an error that nobody has seen."""
    assert program in SMOKE, f"{program}: no test is known that runs it. Write one, and name its file in SMOKE."
    stem, text = Path(program.split()[-1]).stem, (ROOT / f"tests/{SMOKE[program]}.py").read_text()
    assert stem in (*RECIPES, *re.findall(r"\w+", text)), f"{SMOKE[program]} knows nothing of {program}"


NAMES = "python|torchrun|make|pip|pytest|pre-commit|wandb|tensorboard"
PROGRAM = re.compile(rf"(?:[A-Z_]+=\S+ )*(?:\.venv/bin/)?({NAMES}) \S")
IN_CODE = re.compile(r"(?<![\w/])(?:python|torchrun)(?: -\S+)* [\w./]*\.py[^\n`]*")


def written():
    """Commands in the sentences and plain blocks of pages, and in docstrings, comments and messages of the code."""
    for page in sorted({*PAGES, *ROOT.glob("*.md")}):
        for token in MarkdownIt().parse(page.read_text()):
            found = [x.content for x in token.children or () if x.type == "code_inline"]
            if token.type == "fence" and token.info.strip() != "bash":
                found += token.content.replace("\\\n", " ").splitlines()
            yield from ((page, x.strip()) for x in found if PROGRAM.match(x.strip()))
    for folder in ("benchmarks", "docs", "examples", "recipes", "torchrl_quad"):
        for path in sorted((*ROOT.glob(f"{folder}/**/*.py"), *ROOT.glob(f"{folder}/**/*.yaml"))):
            joined = re.sub(r"\\+\n\s*", " ", path.read_text())
            yield from ((path, match[0]) for match in IN_CODE.finditer(joined))


def words_of(command):
    """The words of a command; in code it may stand in a string, whose end is not part of it."""
    command = re.sub(r"\{(\w+)\}/", r"\1/", re.sub(r"^(\w+=\S+ )*(\.venv/bin/)?", "", command))
    try:
        return shlex.split(command, comments=True)
    except ValueError:
        return shlex.split(command.rpartition('"')[0], comments=True)


def test_every_command_in_a_sentence_or_a_docstring_is_one_that_a_test_runs(monkeypatch):
    seen, wrong = {tuple(param.values[0]) for param in commands()}, []
    for path, command in written():
        program, *words = as_a_script(words_of(command))
        if (key := (program, *words)) in seen:
            continue
        seen.add(key)
        try:
            script = next((x.removeprefix("../torchrl_quad/") for x in words if x.endswith(".py")), "")
            if program == "make":
                run("make", "--dry-run", *words)
            elif program == "pip":
                assert words[0] == "install"
                if words[-1].startswith(".["):
                    installs(words)
            elif program in ("wandb", "tensorboard"):
                is_run(program)
            elif program == "pytest":
                assert words == ["-m", "slow"]
            elif program == "pre-commit":
                assert (ROOT / ".pre-commit-config.yaml").exists()
            elif words[0] == "-m":
                is_run(f"python -m {words[1]}")
            elif script.startswith("examples/"):
                assert ROOT / script in EXAMPLES
            elif script in files():  # a program of the pages on writing, which test_own_tasks.py runs
                continue
            else:
                before = next(i for i, word in enumerate(words) if word.endswith(script))  # torchrun's own options
                understands([script, *words[before + 1 :]], monkeypatch)
        except (Exception, SystemExit) as error:
            wrong.append(f"{path.relative_to(ROOT)}: {command}: {error!r}")
    assert wrong == [], "\n".join(wrong)


def installs(words):
    """Try as much of pip as works without a network: every name must belong to the project."""
    assert words.pop(0) == "install"
    extras, needs = (metadata("torchrl_quad").get_all(name) for name in ("Provides-Extra", "Requires-Dist"))
    known = {Requirement(need).name for need in needs} | {"torchrl_quad"}
    while words:
        word = words.pop(0)
        if word in ("--constraint", "-c"):
            assert (ROOT / words.pop(0)).is_file()
        elif word.endswith(".whl"):
            assert word == f"dist/torchrl_quad-{version('torchrl_quad')}-py3-none-any.whl"
        elif word not in ("--editable", "-e"):
            wanted = Requirement(re.sub(r"^\.(?=\[|$)", "torchrl_quad", word))
            assert wanted.name in known and wanted.extras <= set(extras)


def recipe(program, words, launch, folder):
    """Run a recipe on a reduced budget; one that resumes, from the checkpoint of another small run."""
    name = next(Path(word).stem for word in words if word.endswith(".py"))
    small = [*SMALL, "total_steps=24"]  # one horizon, and one evaluation
    arguments = [word for word in words if "=" in word and not word.startswith(("-", "hydra.run.", "hydra.sweep."))]
    assert program == "python" or words[0].startswith("--nproc-per-node=")  # a test of its own starts several
    if "--multirun" in words:  # one run of it, in this process; a test of their own has several side by side
        arguments = [re.sub(r"^([\w.]+=[^,{]*),.*", r"\1", word) for word in arguments]
        launch(name, "--multirun", *arguments, *small, f"hydra.sweep.dir={folder}", "hydra/launcher=basic")
    elif "checkpoint.pt" in " ".join(words):
        launch("abpt" if name in AFTER_TRAINING else name, *small, f"hydra.run.dir={folder}")
        arguments = [re.sub("=outputs/.*checkpoint.pt", f"={folder}/checkpoint.pt", word) for word in arguments]
        launch(name, *arguments, *([] if name in AFTER_TRAINING else ["total_steps=48"]))
    else:
        launch(name, *arguments, *small, f"hydra.run.dir={folder}")
