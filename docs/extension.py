"""What the site adds to Sphinx: formulas as MathML, examples and linked files as pages, whole signatures."""

import ast
import re
import sys
from collections.abc import Iterator
from html import escape
from inspect import unwrap
from pathlib import Path
from typing import Any, get_type_hints
from unicodedata import lookup

from docutils import nodes
from latex2mathml.converter import convert
from myst_parser.parsers.sphinx_ import MystParser
from plotly.offline import get_plotlyjs
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext.autosummary import autosummary_toc
from sphinx.util import inspect
from sphinx.util.docstrings import prepare_docstring
from sphinx.writers.html5 import HTML5Translator

import torchrl_quad
from torchrl_quad.render.replay import page_of

LANGUAGES = {".py": "python", ".yaml": "yaml", ".toml": "toml"}  # of linked files, by suffix
ACRONYMS = {"abpt", "ppo", "sac", "shac", "bptt", "skrl"}


# -- formulas ----------------------------------------------------------------------------------------------------------


def write_formula(self: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML, which browsers show without a script."""
    latex = re.sub(r"\\mathcal\s*([LN])", lambda match: script_letter(match[1]), node.astext())
    self.body.append(convert(latex, display="block" if isinstance(node, nodes.math_block) else "inline"))
    raise nodes.SkipNode


def script_letter(letter: str) -> str:
    """Give the character: MathML Core has no script alphabet but Unicode's."""
    try:
        return lookup(f"MATHEMATICAL SCRIPT CAPITAL {letter}")
    except KeyError:
        return lookup(f"SCRIPT CAPITAL {letter}")


# -- examples and linked files -----------------------------------------------------------------------------------------


class ExampleParser(MystParser):
    """Reads an example: its name is the title, its docstring the text, and the rest its code."""

    supported = ("python",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        """Parse it as the Markdown page that it is made to."""
        path = Path(document["source"])
        first = ast.parse(inputstring).body[0]
        text = ast.get_docstring(ast.parse(inputstring))
        code = "\n".join(inputstring.splitlines()[first.end_lineno :]).strip()
        words = [word.upper() if word in ACRONYMS else word for word in path.stem[3:].split("_")]
        title = " ".join([words[0][0].upper() + words[0][1:], *words[1:]])
        run = f"```bash\npython examples/{path.name}\n```"
        super().parse(f"# {title}\n\n{text}\n\n{run}\n\n````python\n{code}\n````\n", document)


def add_examples(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put the pages of the examples under the page that lists them."""
    if docname == "examples/README":
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\ntasks/README\n[0-9]*\n```\n"


def link_to_sources(app: Sphinx, doctree: nodes.document) -> None:
    """Let links to files of the repository open a page with the file, instead of a download."""
    env = app.env
    files = vars(env).setdefault("linked_files", set())
    for node in [*doctree.findall(addnodes.download_reference), *doctree.findall(addnodes.pending_xref)]:
        if node.get("reftype") != "myst":
            continue
        if isinstance(node, addnodes.download_reference):
            name, _ = env.relfn2path(node["reftarget"], env.docname)
        elif node["refdomain"] == "doc" and node["reftarget"] not in env.found_docs:
            name = node["reftarget"] + ".py"  # all other files with a suffix of a source are pages anyway
        else:
            continue
        if Path(name).suffix in LANGUAGES:
            files.add(name)
            uri = app.builder.get_relative_uri(env.docname, f"source/{name}")
            node.replace_self(nodes.reference("", "", *node.children, internal=True, refuri=uri))


def merge_sources(app: Sphinx, env: BuildEnvironment, docnames: object, other: BuildEnvironment) -> None:
    """Keep the files to which the pages link that another process has read."""
    vars(env).setdefault("linked_files", set()).update(getattr(other, "linked_files", ()))


def source_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Show the files to which pages link."""
    for name in sorted(getattr(app.env, "linked_files", ())):
        path = Path(app.srcdir, name)
        code = app.builder.highlighter.highlight_block(path.read_text(), LANGUAGES[path.suffix], linenos="inline")
        yield f"source/{name}", {"title": name, "body": f"<h1>{escape(name)}</h1>{code}"}, "page.html"


# -- navigation --------------------------------------------------------------------------------------------------------


def leave_out_of_navigation(app: Sphinx, doctree: nodes.document) -> None:
    """Classes have pages, which the tables of the reference list; in the sidebar they would hide everything else."""
    for node in list(doctree.findall(autosummary_toc)):
        node.parent.remove(node)


def share_navigation(app: Sphinx, name: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Make the sidebar once for all pages of a folder that are not in it; it is most of what a page costs."""
    if name not in {page for pages in app.env.toctree_includes.values() for page in pages}:
        make = context["toctree"]
        tree = app.env.temp_data.setdefault("trees", {}).setdefault(name.rpartition("/")[0], [])
        context["toctree"] = lambda **options: (tree or tree.append(make(**options)) or tree)[0]


# -- the reference -----------------------------------------------------------------------------------------------------


def add_short_names(app: Sphinx, env: BuildEnvironment) -> None:
    """Let references to torchrl_quad.HoveringEnv find torchrl_quad.envs.HoveringEnv."""
    objects = env.domains.python_domain.objects
    for name in torchrl_quad.__all__:
        for place in [place for place in objects if place.count(".") == 2 and place.endswith(f".{name}")]:
            objects.setdefault(f"torchrl_quad.{name}", objects[place]._replace(aliased=True))


def keep_shapes(app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Docstrings write shapes, (*, 3) or (3), and norms, |x|, plainly; unless escaped they would be markup."""
    for i, line in enumerate(lines):
        parts = line.split("``")  # every second one is a literal
        parts[::2] = [re.sub(r"(?<=\()\*|\((?=\d+\))|\|", r"\\\g<0>", part) for part in parts[::2]]
        lines[i] = "``".join(parts)


def owners(cls: type) -> list[type]:
    """List a class and the bases of the package to which its constructor hands arguments on."""
    found = []
    for owner in cls.__mro__:
        if not owner.__module__.startswith("torchrl_quad"):
            break
        found.append(owner)
        constructor = vars(owner).get("__init__")
        if constructor and not any(x.kind is x.VAR_KEYWORD for x in inspect.signature(constructor).parameters.values()):
            break
    return found


def show_plain_types(app: Sphinx, function: Any, bound: bool) -> None:
    """Show an option of a range by its plain type: docstrings say the range, and signatures stay short."""
    function = unwrap(function)
    for owner in (function, vars(function).get("__init__", function)) if isinstance(function, type) else (function,):
        owner = unwrap(owner)
        for name, kind in getattr(owner, "__annotations__", {}).items():
            known = getattr(owner, "__globals__", None) or vars(sys.modules[owner.__module__])
            try:
                whole = eval(kind, known) if isinstance(kind, str) else kind
            except (NameError, TypeError):  # of a type that only type checkers import
                continue
            if "Annotated" in repr(whole):
                plain = get_type_hints(type("", (), {"__annotations__": {name: whole}}))
                owner.__annotations__[name] = plain[name]


def show_constructor(
    app: Sphinx, what: str, name: str, value: Any, options: object, signature: str, returned: str
) -> tuple[str, str] | None:
    """Show all arguments of a class: those that metaclasses of TorchRL hide, and those that it hands to its base."""
    if what != "class" or not ("**" in (signature or "") or "__signature__" in vars(value)):
        return None
    arguments: dict[str, Any] = {}
    for owner in owners(value):
        show_plain_types(app, owner, True)
        if "__init__" in vars(owner):
            for x in inspect.signature(owner.__init__, bound_method=True).parameters.values():
                if x.kind not in (x.VAR_KEYWORD, x.VAR_POSITIONAL):
                    arguments.setdefault(x.name, x)
    if "compile" in getattr(value, "__signature__", inspect.Signature()).parameters:  # TorchRL's metaclass takes it
        arguments["compile"] = value.__signature__.parameters["compile"]
    whole = inspect.Signature(sorted(arguments.values(), key=lambda x: x.kind))
    return inspect.stringify_signature(whole, show_return_annotation=False, unqualified_typehints=True), returned


def arguments_of(lines: list[str]) -> tuple[int, int, dict[str, list[str]]]:
    """Find the section Args of a docstring: where it begins and ends, and its entries by name."""
    if "Args:" not in lines:
        end = lines.index("Raises:") if "Raises:" in lines else len(lines)
        return end, end, {}
    begin = end = lines.index("Args:") + 1
    entries: dict[str, list[str]] = {}
    while end < len(lines) and lines[end].startswith("    "):
        if match := re.match(r"    ([\w*]+):", lines[end]):
            name = match[1]
        entries.setdefault(name, []).append(lines[end])
        end += 1
    return begin - 1, end, entries


def describe_all_arguments(app: Sphinx, what: str, name: str, value: Any, options: object, lines: list[str]) -> None:
    """Describe the arguments that a class hands to its base, too, in the place of ``**kwargs``."""
    if what != "class" or len(bases := owners(value)) < 2:
        return
    begin, end, entries = arguments_of(lines)
    own = dict(entries)
    for base in bases[1:]:
        for argument, text in arguments_of(prepare_docstring(base.__doc__))[2].items():
            own.setdefault(argument, text)
    if set(own) != set(entries):
        own.pop("**kwargs", None)
        lines[begin:end] = ["Args:", *(line for text in own.values() for line in text), ""]


def write_race(app: Sphinx, error: Exception | None) -> None:
    """Write the page of docs/replay.md, from a flight without the 5 MB of plotly.js."""
    if error is None:
        content = Path(app.srcdir, "docs/images/race.json").read_text()
        page = page_of(content, "four drones race through four gates", get_plotlyjs())
        Path(app.outdir, "race.html").write_text(page.html, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Sphinx calls this before it reads the sources."""
    app.add_html_math_renderer("mathml", (write_formula, None), (write_formula, None))
    app.add_source_suffix(".py", "python")
    app.add_source_parser(ExampleParser)
    app.connect("source-read", add_examples)
    app.connect("doctree-read", link_to_sources, priority=400)  # before downloads are collected
    app.connect("doctree-read", leave_out_of_navigation, priority=400)
    app.connect("env-merge-info", merge_sources)
    app.connect("html-collect-pages", source_pages)
    app.connect("build-finished", write_race)
    app.connect("html-page-context", share_navigation, priority=400)  # before the theme asks for it
    app.connect("autodoc-process-docstring", describe_all_arguments, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", keep_shapes)
    app.connect("autodoc-before-process-signature", show_plain_types)
    app.connect("autodoc-process-signature", show_constructor)
    app.connect("env-updated", add_short_names)
    return {"parallel_read_safe": True}
