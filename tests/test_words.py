"""Terms of the field are used throughout; words that they replaced do not come back."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
FILES = [
    path
    for folder, pattern in (("dln_jax", "*.py"), ("scripts", "*.py"), ("docs", "*.md"), ("docs/examples", "*.py"))
    for path in sorted((ROOT / folder).rglob(pattern))
    if not {"gallery", "_build", "moved.md"} & set(path.parts)  # moved.md lists the words that were replaced
] + [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
REPLACED = {
    r"laborator(y|ies)": "hardware (limits, encoders, noise and delay of a closed loop)",
    r"receding": "model predictive control",
    r"limited_horizon": "constrained LQ",
    r"adversar(y|ies)": "worst-case disturbance",
    r"sketch(es)?": "kinematic prior",
    r"ladder(?! of gaps)": "model selection",
    r"makers?(?! of result arrays)": "nominal model",
    r"doctor": "log validation",
    r"data\.stretches|cut_stretches": "segments",
    r"--hold\b": "--lock",
    r"(?:rooms|house|walls) (?:of|in) the (?:library|package|code)": "packages and layers",
    r"bodies that exist": "physically consistent",
    r"written_out|written out by hand": "unrolled; closed form",
    r"outside_share|run\.outside": "out of distribution",
}


def test_replaced_words_are_not_used():
    pattern = re.compile(rf"(?<!\w)(?:{'|'.join(REPLACED)})(?!\w)", re.IGNORECASE)
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}"
        for path in FILES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(line)
    ]
    assert not found, f"use these terms: {REPLACED}"


def test_variables_are_named_by_nouns():
    """A variable is named by a noun (joint, options, solution), not `each`, `given` or `found`."""
    named = []
    for path in FILES:
        if path.suffix != ".py" or "examples" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            for field in ("id", "arg", "attr"):
                if getattr(node, field, None) in {"each", "given", "found", "said", "told"}:
                    named.append(f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', '')}: {getattr(node, field)}")
    assert not named


def test_the_pattern_finds_a_word():
    """A search that looks in no file would pass everything above."""
    assert len(FILES) > 400 and any("Lagrangian" in path.read_text() for path in FILES)
