"""The documentation: Markdown pages, examples, and the API from the docstrings.

`python -m sphinx docs docs/_build` shows the code of the examples. With `-D plot_gallery=1` it also runs them in about
20 minutes, and shows what they print and draw.
"""

import ast
import importlib
import inspect
import itertools
import os
import pkgutil
import re
import warnings
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
from docutils import nodes
from latex2mathml.converter import convert
from matplotlib.figure import Figure
from sphinx.ext.napoleon import Config, GoogleDocstring
from sphinx_gallery.scrapers import figure_rst

import dln_jax

HERE = Path(__file__).parent
project = "dln_jax"
author = "The dln_jax developers"
copyright = f"2026, {author}"
version = release = dln_jax.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
if "DOCUMENTATION_ONLINE" in os.environ:  # the inventories are fetched, and a warning where there is no network
    extensions.append("sphinx.ext.intersphinx")
intersphinx_mapping = {
    "python": ("https://docs.python.org/3", None),
    "numpy": ("https://numpy.org/doc/stable", None),
    "jax": ("https://docs.jax.dev/en/latest", None),
    "optax": ("https://optax.readthedocs.io/en/latest", None),
}
myst_enable_extensions = ["dollarmath"]
exclude_patterns = ["_build", "examples", "api/contents.md", "gallery/*.ipynb", "gallery/*.py"]
myst_heading_anchors = 3
default_role = "code"  # docstrings write `name` as Markdown does
add_module_names = False
toc_object_entries = False  # the contents of every page would hold every function: half of the time of a build
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True

html_theme = "furo"
html_math_renderer = "mathml"
pygments_dark_style = "a11y-high-contrast-dark"  # a contrast of 7 or more for every token
html_title = f"dln_jax {version}"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_search_scorer = str(HERE / "_static" / "scorer.js")  # the search for a public name finds it first
html_show_sphinx = False


def library_figures(block, block_vars, gallery_conf):
    """Saves the figures that a block of an example has made without pyplot, as those of `dln_jax.figures`."""
    shown = block_vars.setdefault("library_figures", [])
    paths = []
    for value in block_vars["example_globals"].values():
        if isinstance(value, Figure) and not hasattr(value, "number") and not any(value is known for known in shown):
            shown.append(value)
            paths.append(next(block_vars["image_path_iterator"]))
            value.savefig(paths[-1])
    return figure_rst(paths, gallery_conf["src_dir"])


plot_gallery = "False"  # the option -D turns it on
sphinx_gallery_conf = {
    "image_scrapers": ("matplotlib", library_figures),
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "ignore_pattern": r"slab_films\.py$",  # drawing that three examples share
    "within_subsection_order": "FileNameSortKey",
    "remove_config_comments": True,
    "download_all_examples": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,  # pages that load scripts from the network
    "first_notebook_cell": "# pip install dln-jax",
}
suppress_warnings = ["config.cache"]
warnings.filterwarnings("ignore", message="FigureCanvasAgg is non-interactive")

PACKAGES = {
    "Write energies": ["mechanics", "scenes"],
    "Learn from data": ["data", "identification", "models", "learning", "metrics", "figures", "zoo"],
    "Control": ["control"],
    "Simulate soft bodies": ["softbody", "locomotion"],
    "Deploy": ["export", "scale"],
    "Tools underneath": ["types", "rollout", "nn", "solvers", "precision"],
}
"""Folders and modules of dln_jax by what one does with them. Their docstrings describe them on the API page."""

PUBLIC = {
    "Learn from data": [
        "read_log", "train", "identify", "evaluate", "save", "load", "load_trajectories", "save_trajectories",
    ],
    "Write energies": [
        "LagrangianSystem", "NaturalSystem", "HamiltonianSystem", "NaturalHamiltonian", "dynamics", "flow", "Needs",
        "InverseForward", "PhaseRates",
    ],
    "Start from a robot file": ["read_robot", "tree_system", "joint_dissipation"],
    "Build and fit a model": [
        "model_names", "describe", "make", "build", "make_delan", "Model", "Problem", "fit", "GaussNewton", "Adam",
    ],
    "Deploy": ["export_c", "load_c", "low_latency", "enable_low_latency"],
    "Catch errors": ["InputError"],
}  # fmt: skip
"""The names of `dln_jax` itself, by what one does with them."""


def write_public_page():
    """One page of the public names by their public path."""
    listed = [name for names in PUBLIC.values() for name in names]
    missing = set(dln_jax.__all__) - {*listed, "__version__"}
    assert not missing and len(set(listed)) == len(listed), f"names without a place on the page: {missing}"
    parts = ["Public names", "=" * len("Public names"), "", "Names of `dln_jax` itself. The packages have more.", ""]
    for title, names in PUBLIC.items():
        parts += [title, "-" * len(title), ""]
        for name in names:
            is_class = isinstance(getattr(dln_jax, name), type)
            kind, options = ("autoclass", ["   :members:"]) if is_class else ("autofunction", [])
            parts += [f".. {kind}:: dln_jax.{name}", *options, ""]
    write_if_changed(HERE / "api" / "public.rst", parts)


def write_contents():
    """Tables of the public names and the packages, each with the first sentence of its docstring."""
    parts = ["## Public names", ""]
    for title, names in PUBLIC.items():
        rows = [(f"{{py:obj}}`~dln_jax.{name}`", getattr(dln_jax, name)) for name in names]
        parts += [f"### {title}", "", *table("name", rows)]
    parts += ["## Packages", ""]
    for title, packages in PACKAGES.items():
        rows = [(f"[{name}](api/{name})", importlib.import_module(f"dln_jax.{name}")) for name in packages]
        parts += [f"### {title}", "", *table("package", rows)]
    pages = ["public", *(name for packages in PACKAGES.values() for name in packages)]
    parts += ["```{toctree}", ":hidden:", "", *(f"api/{name}" for name in pages), "```", ""]
    write_if_changed(HERE / "api" / "contents.md", parts)


def table(what, rows):
    """A Markdown table of (link, object), with what the docstrings say first."""
    lines = [f"| {link} | {first_sentence(value)} |" for link, value in rows]
    return [f"| {what} | summary |", "|---|---|", *lines, ""]


def first_sentence(value):
    """The first sentence of a docstring, on one line."""
    paragraph = " ".join(inspect.getdoc(value).split("\n\n")[0].split())
    return re.split(r"(?<=[.:]) (?=[A-Z])", paragraph)[0]


def write_if_changed(path, parts):
    """Writes the lines of a page, unless the file holds them already: an unchanged page is not built again."""
    text = "\n".join(parts)
    if not path.exists() or path.read_text() != text:
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)


def defined_name(public):
    """(module, name there, public name) of a name of `dln_jax`."""
    value = getattr(dln_jax, public)
    return getattr(value, "__module__", ""), getattr(value, "__name__", ""), public


def modules(package):
    """A package's modules, itself first, without those that need an extra which is not installed."""
    package = importlib.import_module(f"dln_jax.{package}")
    yield package
    for module in pkgutil.walk_packages(getattr(package, "__path__", []), package.__name__ + "."):
        try:
            yield importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("dln_jax"):
                raise


def write_api_pages():
    """One page a package, so that a new module is in the documentation without a list to extend."""
    folder = HERE / "api"
    for package in itertools.chain.from_iterable(PACKAGES.values()):
        parts = [f"dln_jax.{package}", "=" * len(f"dln_jax.{package}"), ""]
        for module in modules(package):
            defined = map(defined_name, dln_jax.__all__)
            elsewhere = sorted(names for names in defined if names[0] == module.__name__)
            members = [] if hasattr(module, "__path__") else ["   :members:"]
            if elsewhere:  # each object has one place, so that a reference to it leads there
                members.append(f"   :exclude-members: {', '.join(name for _, name, _ in elsewhere)}")
            see = [f"See :doc:`public`: {', '.join(f'`dln_jax.{public}`' for *_, public in elsewhere)}.", ""]
            short = module.__name__.removeprefix("dln_jax.")
            heading = [] if short == package else [short, "-" * len(short), ""]
            parts += [*heading, f".. automodule:: {module.__name__}", *members, ""]
            parts += see if elsewhere else []
        write_if_changed(folder / f"{package}.rst", parts)


RULE = re.compile(r"\|[-| ]+\|")
SECTION = re.compile(r"(Args|Raises|Returns|Yields):")


def to_rst(app, what, name, obj, options, lines):
    """Turns a docstring into reStructuredText: Markdown's tables and code, Google's sections, no other markup."""
    if lines and lines[0].startswith("Alias for field number"):  # of a record's field that has no line of its own
        lines.clear()
    converted, block, section = [], None, False
    for before, line, following in zip(["", *lines], lines, [*lines[1:], ""], strict=False):
        indented = line.startswith("    ")
        if line.startswith("|") and RULE.fullmatch(following):
            block = "table"
            converted += [".. list-table::", "   :header-rows: 1", ""]
        elif indented and not before and not section and block != "code":
            block = "code"
            converted += ["::", ""]
        elif (block == "table" and not line.startswith("|")) or (block == "code" and line and not indented):
            block = None
        if line and not indented:
            section = bool(SECTION.fullmatch(line))
        if block == "code":
            converted.append(line)
        elif block != "table":
            converted.append(escaped(line))
        elif not RULE.fullmatch(line):
            cells = [cell.strip() for cell in line.strip()[1:-1].split("|")]
            converted += [f"   {'  -' if column else '* -'} {escaped(cell)}" for column, cell in enumerate(cells)]
    if what != "attribute":  # Napoleon takes what is before a colon there for a type
        converted = str(GoogleDocstring(converted, Config(), app, "function", name, obj, options)).splitlines()
    lines[:] = converted


def escaped(line):
    """A line with what reStructuredText would read as markup escaped, outside of `code`."""
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(part if index % 2 else re.sub(r"([|*]|_(?!\w))", r"\\\1", part) for index, part in enumerate(parts))


NUMBER = re.compile(r"(\d[\d.]*(?:e-\d+)? / \d[\d.]*(?:e-\d+)?|\d[\d.]*e-\d+)")


def tidy(app, doctree, page):
    """Keeps numbers of tables on one line, names JAX's arrays as their users do, and ends code at its last line."""
    for block in doctree.findall(nodes.literal_block):
        if block.rawsource == block.astext():
            block.rawsource = block.rawsource.rstrip()
            block[:] = [nodes.Text(block.rawsource)]
    for text in list(doctree.findall(nodes.Text)):
        if "jaxlib._jax." in text:
            text.parent.replace(text, nodes.Text(text.replace("jaxlib._jax.", "")))
        elif NUMBER.search(text) and any(isinstance(above, nodes.entry) for above in ancestors(text)):
            parts = NUMBER.split(text)
            text.parent.replace(
                text,
                [
                    nodes.inline("", part, classes=["number"]) if index % 2 else nodes.Text(part)
                    for index, part in enumerate(parts)
                ],
            )


class Text(str):
    """A text whose `repr` has no quotes."""

    __repr__ = str.__str__


def name_defaults(app, function, bound):
    """Names defaults such as functions, whose `repr` is no Python and would keep a signature from being read."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return
    parameters = []
    for parameter in signature.parameters.values():
        try:
            ast.parse(repr(parameter.default))
        except SyntaxError:
            if parameter.default is not parameter.empty:
                name = getattr(parameter.default, "__name__", "...")
                parameter = parameter.replace(default=Text(name if name.isidentifier() else "..."))
        parameters.append(parameter)
    if parameters != list(signature.parameters.values()):
        function.__signature__ = signature.replace(parameters=parameters)


def show_texts(app):
    """Gives the gallery cards of text where the examples have not run, and so have no pictures."""
    if not app.config.sphinx_gallery_conf["plot_gallery"]:
        app.add_css_file("text-cards.css")


def ancestors(node):
    """The nodes above a node."""
    while (node := node.parent) is not None:
        yield node


def write_mathml(display):
    """A visitor that writes a formula as MathML, which browsers draw without a script and so without a network."""

    def visit(writer, node):
        formula = convert(node.astext().replace(r"\mathrm", r"\text"), display=display)  # \mathrm comes out in italics
        writer.body.append(formula.replace("<mover>", '<mover accent="true">'))  # dots close to their letters
        raise nodes.SkipNode

    return visit


def setup(app):
    """Sphinx calls it."""
    app.add_html_math_renderer("mathml", (write_mathml("inline"), None), (write_mathml("block"), None))
    write_public_page()
    write_api_pages()
    write_contents()
    app.connect("builder-inited", show_texts)
    app.connect("autodoc-before-process-signature", name_defaults)
    app.connect("autodoc-process-docstring", to_rst, priority=100)
    app.connect("doctree-resolved", tidy)
