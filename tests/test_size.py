"""The code stays within the bounds of docs/architecture.md, which are only ever lowered."""

import ast
import functools
import io
import os
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest
from calls import json_of
from planar_arm import URDF, motions

from dln_jax.data.robots import read_robot
from dln_jax.data.schema import save

ROOT = Path(__file__).resolve().parent.parent
LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING,
    tokenize.ENDMARKER,
}  # fmt: skip
WHOLE = ("dln_jax", "scripts", "tests")
PAGE = (ROOT / "docs" / "architecture.md").read_text()
ROOMS = re.findall(r"^\| ([^|]+) \| ((?:`[\w.]+` ?)+) \| (\d+) \| \d+ \|$", PAGE, re.MULTILINE)
COUNTS = dict(re.findall(r"^\| ([a-z ]+) \| (\d+) \| \d+ \|$", PAGE, re.MULTILINE))


@functools.cache
def code_tokens(path):
    """Tokens without comments, docstrings and layout."""
    text = path.read_text()
    bodies = [
        node.body for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module)
    ]
    docstrings = {
        (line.lineno, line.col_offset)
        for body in bodies
        for line in body
        if isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)
    }
    count = depth = 0
    for one in tokenize.generate_tokens(io.StringIO(text).readline):
        # An f-string is one token, as it was before Python 3.12.
        count += not depth and one.type not in LAYOUT and one.start not in docstrings
        depth += {"FSTRING_START": 1, "FSTRING_END": -1}.get(tokenize.tok_name[one.type], 0)
    return count


def files(name):
    if name == ".":
        return (ROOT / "dln_jax").glob("*.py")
    return (ROOT / name if name in WHOLE else ROOT / "dln_jax" / name).rglob("*.py")


@pytest.mark.parametrize(("room", "packages", "bound"), ROOMS, ids=[room for room, *_ in ROOMS])
def test_a_room_stays_within_its_bound(room, packages, bound):
    size = sum(code_tokens(path) for name in re.findall(r"`(.+?)`", packages) for path in files(name))
    assert size <= int(bound), f"{room} has {size - int(bound)} code tokens more than its bound of {bound}"


def test_every_package_is_in_one_room():
    named = [name for _, packages, _ in ROOMS for name in re.findall(r"`(.+?)`", packages)]
    packages = {path.parent.name for path in (ROOT / "dln_jax").glob("*/__init__.py")}
    assert sorted(named) == sorted({*packages, ".", *WHOLE})


def test_classes_and_modules_stay_within_their_bounds():
    trees = [ast.parse(path.read_text()) for path in files("dln_jax")]
    classes = sum(isinstance(node, ast.ClassDef) for tree in trees for node in ast.walk(tree))
    assert classes <= int(COUNTS["classes"]) and len(trees) <= int(COUNTS["modules"])


WALK = """
import atexit, json, pathlib, sys
modules, moves, previous = set(), 0, None
root, answer, *sys.argv = sys.argv[1:]

def enter(code, _):
    global moves, previous
    # Bodies of modules and classes run when they are imported.
    if not code.co_filename.startswith(root) or not code.co_flags & 1 or code.co_name == "<module>":
        return sys.monitoring.DISABLE
    modules.add(code.co_filename)
    moves += code.co_filename != previous
    previous = code.co_filename

def store():
    sys.monitoring.set_events(sys.monitoring.PROFILER_ID, 0)
    loaded = sum(name.startswith("dln_jax") for name in sys.modules)
    pathlib.Path(answer).write_text(json.dumps([len(modules), moves, loaded]))

sys.monitoring.use_tool_id(sys.monitoring.PROFILER_ID, "walk")
sys.monitoring.register_callback(sys.monitoring.PROFILER_ID, sys.monitoring.events.PY_START, enter)
sys.monitoring.set_events(sys.monitoring.PROFILER_ID, sys.monitoring.events.PY_START)
atexit.register(store)
from dln_jax.__main__ import command
command(sys.argv[0], sys.argv[0])
"""
"""Counts the modules that a command enters, its moves between them, and the modules that it loads."""
BRIEF = ["--no-figures", "--no-uncertainty"]


@pytest.mark.skipif(sys.version_info < (3, 12), reason="sys.monitoring is of Python 3.12")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a training", ["train_delan", "--steps", "5", *BRIEF]),
        ("identify", ["identify", "--robot", "arm.urdf", "--data", "log.npz", "--test", "last:30%", *BRIEF]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_command_enters_few_modules_and_seldom_moves_between_them(name, words, tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    save(tmp_path / "log.npz", motions(0, noise=0.05, tree=read_robot(tmp_path / "arm.urdf").tree))
    line = [sys.executable, "-c", WALK, str(ROOT / "dln_jax"), "counts.json", *words, "--out", "run"]
    subprocess.run(line, check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)})
    counts = json_of(tmp_path / "counts.json")
    kinds = f"modules that {name} enters", f"moves of {name} between modules", f"modules that {name} loads"
    for kind, count in zip(kinds, counts, strict=True):
        assert count <= int(COUNTS[kind]), (kind, count)
