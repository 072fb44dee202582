"""The documentation: the site builds, links lead somewhere, and code blocks and all commands that are written run."""

import argparse
import importlib
import inspect
import re
import runpy
import shlex
import sys
from importlib.metadata import metadata, version
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote

import pytest
import yaml
from helpers import ROOT, run
from markdown_it import MarkdownIt
from packaging.requirements import Requirement
from sphinx.util.inventory import InventoryFile
from test_examples import EXAMPLES, reduced
from test_recipes import RECIPES, SMALL

from torchrl_quad.envs import TASKS
from torchrl_quad.training.configuration import compose
from torchrl_quad.training.schema import check

PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "recipes/README.md", "examples/README.md")]
PAGES += [ROOT / "examples/tasks/README.md"]
PAGES += sorted(path for path in ROOT.glob("docs/**/*.md") if "_build" not in path.parts)
PARTS = {path.parent.name for path in ROOT.glob("torchrl_quad/*/__init__.py")} - {"training"}  # which recipes use
PUBLIC = ["torchrl_quad", *(f"torchrl_quad.{part}" for part in sorted(PARTS))]
FIRST = (ROOT / "examples/03_train.py").read_text().split('"""\n\n', 1)[1]  # the program, which test_examples.py runs
# Blocks that are not run: text, data, and Sphinx's directives, except those that hold code.
NOT_RUN = re.compile(r"(|text|yaml|\{(?!code|sourcecode)[\w-]+\}.*)")


def name_of(path):
    return str(path.relative_to(ROOT))


def public_names():
    for module in map(importlib.import_module, PUBLIC):
        yield from (f"{module.__name__}.{name}" for name in module.__all__)
    for name, value in vars(importlib.import_module("torchrl_quad.diagnostics")).items():
        if getattr(value, "__module__", None) == "torchrl_quad.diagnostics" and not name.startswith("_"):
            yield f"torchrl_quad.diagnostics.{name}"


SCREEN = {"width": 1280, "height": 800}
MEASURE = """() => {
    const {scrollWidth, scrollHeight} = document.documentElement;
    const boxes = [...document.querySelectorAll("pre, .table-wrapper, math")];
    const cut = boxes.filter((box) => box.scrollWidth > box.clientWidth);
    return [scrollWidth, scrollHeight, cut.map((box) => box.textContent.trim().slice(0, 60))];
}"""


def test_the_site_builds_without_a_warning_describes_every_public_name_and_fits_a_browser(tmp_path, request):
    (command,) = (line for line in run("make", "--dry-run", "docs").splitlines() if "-m sphinx" in line)
    _, *options, folder = shlex.split(command)
    assert folder == "docs/_build/html"
    assert {"-W", "--keep-going", "-n"} <= set(options)
    # In one process, and without listings of all modules, which are a part of the time.
    options += ["-D", "extensions=myst_parser,sphinx.ext.autodoc,sphinx.ext.autosummary,sphinx.ext.napoleon,extension"]
    run(sys.executable, *options, "-j1", str(tmp_path), timeout=600)
    with open(tmp_path / "objects.inv", "rb") as file:
        inventory = InventoryFile.load(file, "", lambda *parts: "".join(parts))
    described = set().union(*inventory.values())
    assert [name for name in public_names() if name not in described] == []
    read(tmp_path)
    look_at(tmp_path, request.getfixturevalue("browser"))


def read(site):
    """Links lead to files, nothing comes from elsewhere, formulas are MathML, and classes show all their arguments."""
    pages = {path: path.read_text() for path in site.rglob("*.html")}
    local = re.compile(r'(?:href|src)="([^":#?]+)["#?]')
    links = {path.parent / unquote(link) for path, text in pages.items() for link in local.findall(text)}
    assert [link for link in links if not link.exists()] == []
    assert not any(re.search(r'<(script|img|link)\b[^>]*(src|href)="(https?:)?//', text) for text in pages.values())
    assert all("<math" in pages[site / f"docs/{name}.html"] for name in ("losses", "dynamics"))
    assert not any("\\frac" in pages[path] for path in site.glob("docs/*.html"))
    tasks = {name: task for name, task in TASKS.items() if task.__module__.startswith("torchrl_quad.")}
    shown = {name: inspect.signature(task).parameters for name, task in tasks.items()}
    shown["_api/torchrl_quad.objectives.ABPTLoss"] = ["zero_step_return", "clip_action_gradient"]  # the last, of a base
    for name, arguments in shown.items():
        text = pages[site / f"docs/{name}.html"]
        for form in ("<strong>{}</strong>", '<span class="pre">{}</span>'):  # described, and in the signature
            assert [argument for argument in arguments if form.format(argument) not in text] == [], name


def look_at(site, browser):
    """Open the pages without a network, as a reader with a small screen does. One listing stands for all of them."""
    wrong = []
    page = browser.new_context(offline=True, viewport=SCREEN).new_page()
    page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", lambda r: None if r.url.startswith("file://") else wrong.append(r.url))
    listings = sorted((site / "source").rglob("*.html"))  # which show files of the repository
    assert listings
    classes = sorted(site.glob("docs/_api/*.html"), key=lambda path: path.stat().st_size)  # the longest stand for all
    assert len(classes) > 6
    for path in {*site.rglob("*.html")} - {*listings[1:], *classes[:-6], site / "index.html"}:
        name = str(path.relative_to(site))
        page.goto(path.as_uri())
        width, height, cut = page.evaluate(MEASURE)
        if width > SCREEN["width"]:
            wrong.append(f"{name}: scrolls to the side")
        if height > 6 * SCREEN["height"] and path not in listings:
            wrong.append(f"{name}: {height} pixels long, which is more than six screens")
        wrong += [f"{name}: wider than its column: {text}" for text in cut if path not in listings]
    page.goto((site / "index.html").as_uri())
    page.wait_for_url("**/docs/index.html")
    page.context.close()
    assert not wrong, "\n".join(sorted(wrong))


def test_the_reference_lists_what_the_package_exports_and_every_example_is_listed_and_the_readme_is_short():
    (table,) = re.findall(r"\.\. autosummary::\n.*\n\n((?:   \w+\n)+)", (ROOT / "docs/api.md").read_text())
    assert sorted(table.split()) == sorted(importlib.import_module("torchrl_quad").__all__)
    text = (ROOT / "examples/README.md").read_text()
    assert {example.name for example in EXAMPLES} == set(re.findall(r"\d\d_\w+\.py", text))
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_the_first_program_is_the_same_everywhere():
    """The program of example 3 (which test_examples.py runs) is the first of each of these pages."""
    for name in ("README.md", "docs/index.md", "docs/first_flight.md"):
        text = (ROOT / name).read_text()
        assert programs(ROOT / name)[0] == FIRST, name
        assert "about 40 s on one CPU" in text


def test_every_row_of_how_to_add_names_files_that_exist():
    rows = re.findall(r"^\| an? .*\|$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    for row in rows:
        names = re.findall(r"`([\w./]+(?:\.py|\.yaml|/))`", row)
        deeper = [ROOT / part for part in ("torchrl_quad", "recipes", "docs", "examples", "benchmarks", "tests")]
        found = {name: [*ROOT.glob(name), *(x for part in deeper for x in part.glob(f"**/{name}"))] for name in names}
        assert names and [name for name in names if not found[name]] == [], row
    assert len(rows) == 10


def headings(text):
    """The names that GitHub gives to the headings of a page."""
    titles = [after for before, after in pairwise(MarkdownIt().parse(text)) if before.type == "heading_open"]
    titles = ["".join(child.content for child in title.children) for title in titles]
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", sorted({*PAGES, *ROOT.glob("*.md")}), ids=name_of)
def test_links_and_pictures_lead_to_files_and_headings_that_exist(page):
    inline = (token for token in MarkdownIt().parse(page.read_text()) if token.type == "inline")
    attributes = (child.attrs for token in inline for child in token.children)
    for link in (values.get("href", values.get("src")) for values in attributes if values):
        if link.startswith("https://"):
            continue
        path, _, heading = unquote(link).partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists() and target.is_relative_to(ROOT), f"{link}: there is no such file in the repository"
        assert not heading or heading in headings(target.read_text()), f"{link}: there is no such heading"


def blocks(text, first_line=0):
    """Language, first line and content of the fenced blocks of a page, and of those in directives such as {note}."""
    for token in MarkdownIt().parse(text):
        if token.type == "fence":
            language, line = token.info.strip(), first_line + token.map[0] + 1
            yield language, line, token.content
            if language.startswith("{"):
                yield from blocks(token.content, line)


def code(page, language):
    return [(line, content) for kind, line, content in blocks(page.read_text()) if kind == language]


def programs(page):
    return [content for _, content in code(page, "python")]


def files():
    """The programs of the pages on writing that stand in files, by the name in their first line."""
    found = [content for page in ROOT.glob("docs/writing*.md") for content in programs(page)]
    return {content.split()[1]: content for content in found if re.match(r"# \w+\.py\n", content)}


@pytest.fixture
def importable(tmp_path, monkeypatch):
    """Python finds the files of the pages on writing, as in the folder in which they are saved."""
    for name, content in files().items():
        (tmp_path / name).write_text(content)
        monkeypatch.delitem(sys.modules, name.removesuffix(".py"), raising=False)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_nothing_escapes_these_tests_behind_another_name(page):
    for language, line, content in blocks(page.read_text()):
        known = language in ("python", "bash") or NOT_RUN.fullmatch(language)
        assert known, f"{page}:{line}: {language!r}. Write python or bash, which are run, or text, which is not code."
        if language == "yaml":
            yaml.safe_load(content)


@pytest.mark.usefixtures("quick_fits")
@pytest.mark.parametrize("page", [page for page in PAGES if programs(page) not in ([], [FIRST])], ids=name_of)
def test_the_programs_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch, importable):
    lines = []  # the code, on the same lines as in the page
    elsewhere = files().values()  # the others import it, or test_configuration.py does
    for line, content in code(page, "python"):
        if content in elsewhere:
            continue
        lines += [""] * (line - len(lines)) + content.splitlines()
    program = tmp_path / f"{page.stem}.py"
    program.write_text(reduced("\n".join(lines)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    # A graph runs as it was captured: test_horizon.py compares the code that the compiler makes of one.
    monkeypatch.setattr("torch._inductor.compile_fx.compile_fx", lambda graph, *_, **__: graph.forward)
    if "examples/data" in program.read_text():
        (tmp_path / "examples").symlink_to(ROOT / "examples")
    if "metrics.csv" in program.read_text():  # it reads what runs have left
        (tmp_path / "outputs/run").mkdir(parents=True)
        (tmp_path / "outputs/run/metrics.csv").write_text("steps,eval/return,eval/crash,grad/actor\n64,1.0,0.0,2.0\n")
    runpy.run_path(str(program), run_name="__main__")


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
            elif script in files():  # a program of the pages on writing, which test_configuration.py runs
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
