"""The documentation: the site builds without a warning, links lead somewhere, and code blocks run."""

import importlib
import inspect
import re
import runpy
import shlex
import sys
from itertools import pairwise
from urllib.parse import unquote

import pytest
import yaml
from helpers import ROOT, run
from markdown_it import MarkdownIt
from sphinx.util.inventory import InventoryFile
from test_examples import EXAMPLES, reduced

from torchrl_quad.envs import TASKS

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
    elsewhere = files().values()  # the others import it, or test_own_tasks.py does
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
