"""The documentation site: ``make docs`` builds it from the Markdown files of the repository and the docstrings.

The source directory is the repository, not this folder. So each page is read from its own place, and links between
files work on GitHub and on the site.
"""

import ast
import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import inspect

import torchrl_quad

project = "torchrl_quad"
version = release = torchrl_quad.__version__
root_doc = "docs/index"
include_patterns = ["docs/*.md", "recipes/README.md", "examples/README.md", "CONTRIBUTING.md"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]

myst_enable_extensions = ["dollarmath", "substitution"]
myst_substitutions = {  # {{ fly_by_hand }} is the docstring of examples/01_fly_by_hand.py
    path.stem[3:]: ast.get_docstring(ast.parse(path.read_text()))
    for path in (Path(__file__).parents[1] / "examples").glob("*.py")
}
myst_heading_anchors = 4  # links to headings, by the names that GitHub gives them

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 90  # a longer one has each argument on a line of its own
toc_object_entries_show_parents = "hide"
napoleon_use_rtype = False  # "Returns:" is a sentence here; its types are in the signature

# Foreign names are not looked up, since a build needs no network.
nitpick_ignore_regex = [
    (r"py:.*", r"(torch|torchrl|tensordict|gymnasium|numpy|np)\..*"),
    (r"py:.*", r"(collections\.abc|pathlib|dataclasses|enum)\..*"),
    (r"py:class", r"Path|State|Tensor|TensorDictBase|Vector"),  # in annotations that keep the name alone
    (r"py:class", r"torchrl_quad\.engine\.\w+\.\w+"),  # the engine's own
    (r"py:(exc|class|obj)", r"[A-Z][A-Za-z]*Error|ResetNeeded|None|bool|dict|float|int|list|str|tuple|type"),
]

html_theme = "furo"
html_title = "torchrl_quad"
html_extra_path = ["index.html"]  # leads from the root of the site to the pages in docs/
html_copy_source = False
html_show_copyright = False
mathjax_path = "https://cdn.jsdelivr.net/npm/mathjax@3/es5/tex-mml-chtml.js"  # fetched by the reader, not by the build


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


def show_constructor(
    app: Sphinx, what: str, name: str, value: type, options: object, signature: str, returned: str
) -> tuple[str, str] | None:
    """Show the arguments of a class, which the metaclasses of TorchRL's environments and losses hide."""
    if what != "class" or signature != "(*args, **kwargs)":
        return None
    if "__init__" not in vars(value):  # the class then says where its arguments are described
        return "(...)", returned
    constructor = inspect.signature(value.__init__, bound_method=True)
    return inspect.stringify_signature(constructor, show_return_annotation=False, unqualified_typehints=True), returned


def setup(app: Sphinx) -> None:
    """Sphinx calls this before it reads the sources."""
    app.connect("autodoc-process-docstring", keep_shapes)
    app.connect("autodoc-process-signature", show_constructor)
    app.connect("env-updated", add_short_names)
