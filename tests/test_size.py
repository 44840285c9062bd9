"""The code stays within the bounds of docs/architecture.md, which are only ever lowered."""

import ast
import functools
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest

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


@pytest.mark.slow
def test_a_training_loads_few_modules(tmp_path):
    line = ["train_delan", "--steps", "5", "--no-figures", "--no-low-latency", "--out", str(tmp_path / "run")]
    count = (
        f"open({str(tmp_path / 'count')!r}, 'w').write(str(sum(name.startswith('dln_jax') for name in sys.modules)))"
    )
    program = f"import sys, atexit; sys.argv = {line!r}; atexit.register(exec, {count!r}, globals()); "
    program += "from dln_jax.__main__ import command; command('train_delan', 'train_delan')"
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)
    assert int((tmp_path / "count").read_text()) <= int(COUNTS["modules that a training loads"])
