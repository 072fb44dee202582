"""The documentation site: ``make docs`` builds it from the Markdown files of the repository and the docstrings.

The source directory is the repository, not this folder. So each page is read from its own place, and links between
files work on GitHub and on the site. The site needs no network, neither to be built nor to be read.
"""

import shutil
import sys
from pathlib import Path

import ziamath
from matplotlib.figure import Figure

import torchrl_quad
from torchrl_quad.render import figures

sys.path.insert(0, str(Path(__file__).parent))  # extension.py

vars(figures)["Figure"] = Figure  # which annotations name, and only type checkers import
shutil.rmtree(Path(__file__).parent / "_api", ignore_errors=True)  # pages of classes, which may be there no more

project = "torchrl_quad"
version = release = torchrl_quad.__version__
root_doc = "docs/index"
include_patterns = ["docs/**.md", "docs/_api/*.rst", "recipes/README.md", "CONTRIBUTING.md"]
include_patterns += ["examples/*", "examples/data/README.md", "examples/tasks/README.md"]
exclude_patterns = ["docs/_build", ".venv", ".git"]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "extension",
]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4  # links to headings, by the names that GitHub gives them

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autosummary_ignore_module_all = False
templates_path = [str(Path(__file__).parent / "templates")]  # of the pages in docs/_api
python_maximum_signature_line_length = 90  # a longer one has each argument on a line of its own
toc_object_entries_show_parents = "hide"
napoleon_use_rtype = False  # "Returns:" is a sentence here; its types are in the signature

# Foreign names are not looked up, since a build needs no network.
nitpick_ignore_regex = [
    (r"py:.*", r"(torch|torchrl|tensordict|gymnasium|numpy|np|matplotlib)\..*"),
    (r"py:.*", r"(collections\.abc|pathlib|dataclasses|enum)\..*"),
    # In annotations that only keep the name, and those of modules without a page.
    (r"py:class", r"Arrays|Contract|Fields|Key|Length|ModelProto|Path|State|Tensor|TensorDict|TensorDictBase|Vector"),
    (r"py:class", r"torchrl_quad\.(engine\.\w+|deploy\.(bundle|contract)|identification\.parameters|options)\.\w+"),
    (r"py:(exc|class|obj)", r"[A-Z][A-Za-z]*Error|ResetNeeded|NoFfmpeg|None|bool|dict|float|int|list|str|tuple|type"),
]

html_theme = "furo"
pygments_dark_style = "github-dark"
html_title = f"torchrl_quad {version}"
html_static_path = ["site.css", str(Path(ziamath.__file__).parent / "fonts")]  # with the font of the formulas
html_css_files = ["site.css"]
html_extra_path = ["index.html"]  # leads from the root of the site to the pages in docs/
html_copy_source = False
html_show_copyright = False
html_use_index = html_domain_indices = False  # the reference lists every name
html_math_renderer = "mathml"
