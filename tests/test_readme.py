"""README.md and the pages of the documentation as their reader meets them.

Every block runs as printed in a fresh interpreter, in a folder where the README's own first command has run.
"""

import importlib
import os
import re
import shlex
from pathlib import Path
from typing import NamedTuple, get_type_hints

import numpy as np
import pytest
from calls import command
from conftest import PROGRAMS, SHORTEST_COMPILATION, slow_among
from interpreters import Program, interpreters
from planar_arm import URDF, motions

from dln_jax import read_robot
from dln_jax.commands import COMMANDS
from dln_jax.data import schema
from dln_jax.options import CompilationCache
from dln_jax.runs.arguments import names_listed, parse
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import cart_pole, pendulum
from scripts.reports.run import arguments_of, chosen_cases

ROOT = Path(__file__).parent.parent
PAGES = {path.name: path.read_text() for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]}
PROSE = {name: re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE) for name, text in PAGES.items()}
MOST_WORDS = 900
"""Largest number of words of the README."""
BARE = "--no-figures"
SMALL = {
    "train_delan": f"--optimizer adam --precision f64 --steps 40 --width 4 --depth 1 --batch 64 {BARE}",
    "train_hnn_task": f"--optimizer adam --steps 2 {BARE}",
    "export_c": "",
    "identify": f"--no-uncertainty {BARE}",
}
"""Put behind what a page gives, so that a command runs for a second: what is printed there stays as it is."""
QUICKLY = "__import__('dln_jax.precision').precision._OPTIONS = {}; "
"""Leaves XLA's options to the tests, whose programs compile sooner; in this process a fixture does so."""
NOT_RUN = (("pip", "install"), ("python", "-m", "pytest"))
"""Commands that install, or test this very repository."""


class Block(NamedTuple):
    page: str
    text: str


def blocks(language):
    pattern = re.compile(rf"^```{language}\n(.*?)^```", re.DOTALL | re.MULTILINE)
    return [Block(name, text) for name, page in PAGES.items() for text in pattern.findall(page)]


def commands(text):
    """The commands of a shell block, each as a list of words; `dln-jax NAME` is `python -m scripts.NAME`."""
    lines = re.sub(
        r"^dln-jax (\w)", r"python -m scripts.\1", text.replace("\\\n", " "), flags=re.MULTILINE
    ).splitlines()
    return [shlex.split(part, comments=True) for line in lines for part in line.split("&&") if part.strip()]


def script_and_arguments(words):
    assert words[:2] == ["python", "-m"] and words[2].startswith("scripts."), words
    return importlib.import_module(f"dln_jax.commands.{words[2].removeprefix('scripts.')}"), words[3:]


def cases_and_line(words):
    """The cases of a report, and the words after its name, of which a first one without dashes is a subject."""
    name, line = words[3], words[4:]
    subject = ["--only"] if line and not line[0].startswith("-") else []
    return importlib.import_module(f"scripts.reports.cases.{name}").CASES, [*subject, *line]


EVERY = [words for block in blocks("bash") for words in commands(block.text)]
FIRST = ["python", "-m", "scripts.train_delan"]
SCRIPTS = [list(words) for words in dict.fromkeys(map(tuple, EVERY)) if words[2:3] and words[2].startswith("scripts.")]
INLINE = {
    re.sub(r"^dln-jax ", "python -m scripts.", text.replace("\n", " "))
    for page in PROSE.values()
    for text in re.findall(r"`((?:python -m scripts\.(?!report --|NAME)|dln-jax [a-z_]+ --)[^`]*)`", page)
}


@pytest.fixture(scope="module")
def workplace(folder):
    """A folder with the reader's own data, where the README's first command has run."""
    data = generators.uniform(cart_pole(friction=0.1), samples=60)
    schema.save(folder / "mine.npz", data._replace(label=np.array([f"run{index}" for index in range(60)])))
    swings = generators.free_swing(pendulum(), trajectories=4, steps=60)
    np.savez(folder / "swings.npz", t=swings.t, q=swings.q, trajectory=swings.trajectory)
    (folder / "arm.urdf").write_text(URDF)
    log = motions(0, noise=0.05, samples=400, tree=read_robot(folder / "arm.urdf").tree)
    titles = "t [s],q1 [rad],q2 [rad],tau1 [N m],tau2 [N m]"
    np.savetxt(folder / "log.csv", np.column_stack([log.t, log.q, log.tau]), "%.9f", ",", header=titles, comments="")
    run(FIRST)
    return folder


def run(words):
    script, arguments = script_and_arguments(words)
    # A page reads the uncertainty of the first run.
    brief = ["--no-uncertainty"] if words != FIRST and words[2] == FIRST[2] else []
    command(script, *arguments, *shlex.split(SMALL[words[2].removeprefix("scripts.")]), *brief)


def test_the_readme_is_short():
    assert len(PAGES["README.md"].split()) <= MOST_WORDS


def test_every_command_of_a_block_is_known():
    """Each is one of a script, which runs below, or is named as one that does not run here."""
    assert len(SCRIPTS) >= 3 and SCRIPTS[0] == FIRST
    others = [words for words in EVERY if words not in SCRIPTS]
    assert all(any(tuple(words[: len(known)]) == known for known in NOT_RUN) for words in others)


@pytest.mark.parametrize("words", SCRIPTS[1:], ids=shlex.join)
def test_a_command_of_a_block_runs(words, workplace):
    before = len(list(workplace.glob("*"))) + len(list((workplace / "runs").iterdir()))
    run(words)
    assert len(list(workplace.glob("*"))) + len(list((workplace / "runs").iterdir())) == before + 1


def test_commands_in_the_text_parse():
    for text in INLINE:
        words = shlex.split(text)
        if words[2].removeprefix("scripts.") not in COMMANDS:
            cases, line = cases_and_line(words)
            options, _ = parse(arguments_of(cases), prog=text, description=None, line=line, common=CompilationCache)
            chosen_cases(cases, names_listed(options.only))
            continue
        script, words = script_and_arguments(words)
        own, _ = parse(script.Arguments, prog=script.__name__, description=None, line=words, common=CompilationCache)
        for name, hint in get_type_hints(type(own), include_extras=True).items():
            for shown in (getattr(mark, "metavar", None) for mark in getattr(hint, "__metadata__", ())):
                if shown and shown.startswith("{"):
                    known = re.match(r"{(.*?)}", shown)[1].split(",")
                    files = (".npz", ".xml", ".urdf") if "FILE" in known else (".npz",)
                    named = [word for word in str(getattr(own, name)).split(",") if not word.endswith(files)]
                    assert set(named) <= {*known, "None"}, (text, name)


@pytest.fixture(scope="module")
def run_fresh():
    told = {
        "JAX_COMPILATION_CACHE_DIR": os.environ[PROGRAMS],
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": SHORTEST_COMPILATION,
        "JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "0",
    }
    with interpreters({**os.environ, **told}) as run_programs:
        yield run_programs


@pytest.mark.parametrize(
    "block",
    slow_among(blocks("python"), lambda block: block.page != "README.md"),
    ids=lambda block: f"{block.page}:{block.text.split()[-1][:30]}",
)
def test_a_python_block_runs_in_a_fresh_interpreter_and_says_something(
    block, workplace, run_fresh, tmp_path, pytestconfig
):
    # On the first line, so that tracebacks have the page's numbers of lines.
    (tmp_path / "block.py").write_text(("" if pytestconfig.getoption("--optimised") else QUICKLY) + block.text)
    (result,) = run_fresh(tmp_path, Program(tmp_path / "block.py", folder=workplace, environment=dict(os.environ)))
    assert result.returncode == 0, result.stderr
    assert re.search(r"\d\.\d", result.stdout) and not re.search("nan|inf", result.stdout), result.stdout


def test_there_are_blocks_to_run():
    """Pages that no pattern matches would pass everything above."""
    assert len(blocks("python")) >= 8 and len(INLINE) >= 10
    fences = sum(len(re.findall(r"^```(?!\{)\w+$", page, re.MULTILINE)) for page in PAGES.values())
    assert sum(len(blocks(language)) for language in ("python", "bash")) == fences


def test_links_to_files_and_headings_of_pages_lead_somewhere():
    """The documentation's builder checks those of its pages again; nobody else checks the README's."""
    for page, text in PROSE.items():
        folder = ROOT if page == "README.md" else ROOT / "docs"
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if target.startswith(("https://", "gallery/", "api/")):
                continue
            path, _, heading = target.partition("#")
            assert (folder / path).exists(), (page, target)
            if heading:
                headings = re.findall(r"^#+ (.*)$", (folder / path).read_text(), re.MULTILINE)
                slugs = [re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in headings]
                assert heading in slugs, (page, target)
