"""The documentation: Markdown pages, examples that run as it is built, and the API from the docstrings."""

import importlib
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
exclude_patterns = ["_build", "examples", "gallery/*.ipynb", "gallery/*.py"]
myst_heading_anchors = 3
default_role = "code"  # docstrings write `name` as Markdown does
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
copybutton_exclude = ".linenos, .gp, .go"  # an example is copied without its prompts and output
python_use_unqualified_type_names = True

html_theme = "furo"
html_math_renderer = "mathml"
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
    "first_notebook_cell": "# pip install dln-jax",
}
suppress_warnings = ["config.cache"]
warnings.filterwarnings("ignore", message="FigureCanvasAgg is non-interactive")

PACKAGES = {
    "types": "Symbols, units and shapes",
    "mechanics": "Mechanics: equations of motion from energies",
    "scenes": "Textbook systems and data generated from them",
    "models": "Models: energies made of networks and bases",
    "data": "Data: a user's file",
    "zoo": "Models by name, run folders",
    "learning": "Learning",
    "metrics": "Numbers about a model",
    "figures": "Figures",
    "control": "Control",
    "export": "Real time and C",
    "softbody": "Soft bodies",
    "locomotion": "Locomotion",
    "nn": "Networks",
    "solvers": "Solvers",
    "scale": "Scale: several devices and processes",
    "precision": "Precision",
}
"""Folders and modules of dln_jax that the API pages show, in the order of the contents."""


PUBLIC = {
    "Basic": {
        "From a log to a model": ["read_log", "train", "identify", "evaluate", "load", "save"],
        "Energies and equations of motion": [
            "LagrangianSystem", "NaturalSystem", "HamiltonianSystem", "NaturalHamiltonian", "dynamics", "flow", "Needs",
        ],
        "Models and training": [
            "model_names", "make", "make_delan", "Model", "fit", "GaussNewton", "Adam", "Problem",
        ],
        "Deployment": ["export_c", "load_c", "low_latency", "enable_low_latency"],
        "Errors": ["InputError"],
    },
    "Advanced": {
        "Files": ["load_trajectories", "save_trajectories", "build", "describe"],
        "Robots": ["read_robot", "tree_system", "joint_dissipation"],
        "Further records of a system": ["InverseForward", "PhaseRates"],
    },
}  # fmt: skip
"""The names of `dln_jax` itself, in the order in which a reader needs them."""


def write_public_page():
    """One page of the public names by their public path."""
    listed = [name for groups in PUBLIC.values() for names in groups.values() for name in names]
    missing = set(dln_jax.__all__) - {*listed, "__version__"}
    assert not missing and len(set(listed)) == len(listed), f"names without a place on the page: {missing}"
    parts = ["Public names", "=" * len("Public names"), "", "Names of `dln_jax` itself. The packages have more.", ""]
    for level, groups in PUBLIC.items():
        parts += [level, "-" * len(level), ""]
        for title, names in groups.items():
            parts += [title, "~" * len(title), ""]
            for name in names:
                is_class = isinstance(getattr(dln_jax, name), type)
                kind, options = ("autoclass", ["   :members:"]) if is_class else ("autofunction", [])
                parts += [f".. {kind}:: dln_jax.{name}", *options, ""]
    write_if_changed(HERE / "api" / "public.rst", parts)


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
    for package, title in PACKAGES.items():
        parts = [title, "=" * len(title), ""]
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


def to_rst(app, what, name, obj, options, lines):
    """Turns a docstring into reStructuredText: Markdown's tables and `code`, Google's sections, no other markup."""
    if lines and lines[0].startswith("Alias for field number"):  # of a record's field that has no line of its own
        lines.clear()
    converted, in_table = [], False
    for line, following in itertools.zip_longest(lines, lines[1:], fillvalue=""):
        if line.startswith("|") and RULE.fullmatch(following):
            in_table = True
            converted += [".. list-table::", "   :header-rows: 1", ""]
        in_table &= line.startswith("|")
        if not in_table:
            converted.append(escaped(line))
        elif not RULE.fullmatch(line):
            cells = [cell.strip() for cell in line.strip()[1:-1].split("|")]
            converted += [f"   {'  -' if column else '* -'} {escaped(cell)}" for column, cell in enumerate(cells)]
    if what != "attribute":  # Napoleon takes what is before a colon there for a type
        converted = str(GoogleDocstring(converted, Config(), app, "function", name, obj, options)).splitlines()
    lines[:] = converted


def escaped(line):
    """A line with what reStructuredText would read as markup escaped, outside of `code` and of an example's code."""
    if line.lstrip().startswith((">>> ", "... ")):
        return line
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(part if index % 2 else re.sub(r"([|*]|_(?!\w))", r"\\\1", part) for index, part in enumerate(parts))


NUMBER = re.compile(r"(\d[\d.]*e-\d+)")


def tidy(app, doctree, page):
    """Keeps small numbers of tables on one line, and names JAX's arrays as their users do."""
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


def ancestors(node):
    """The nodes above a node."""
    while (node := node.parent) is not None:
        yield node


def write_mathml(display):
    """A visitor that writes a formula as MathML, which browsers draw without a script and so without a network."""

    def visit(writer, node):
        writer.body.append(convert(node.astext(), display=display))
        raise nodes.SkipNode

    return visit


def setup(app):
    """Sphinx calls it."""
    app.add_html_math_renderer("mathml", (write_mathml("inline"), None), (write_mathml("block"), None))
    write_public_page()
    write_api_pages()
    app.connect("autodoc-process-docstring", to_rst, priority=100)
    app.connect("doctree-resolved", tidy)
