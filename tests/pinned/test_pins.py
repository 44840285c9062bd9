"""Commands on small data give the stored numbers, files and words."""

import json
import math
from pathlib import Path

import lines
import pytest

PINS = Path(__file__).with_name("pins.json")
STORED = json.loads(PINS.read_text()) if PINS.exists() else {}
CLOSE = 1e-9
"""Relative difference of numbers that count as equal, relative to the larger one or to 1e-9."""


@pytest.fixture(scope="module")
def workplace(folder):
    lines.make_files(folder)
    return folder


@pytest.fixture(scope="module")
def renewed(pytestconfig):
    """Collects what is measured; with --renew it is stored."""
    found = {}
    yield found
    if pytestconfig.getoption("--renew"):
        PINS.write_text(json.dumps({**STORED, **found}, indent=1, sort_keys=True) + "\n")


def differences(stored, found, where=""):
    """Lines on what moved."""
    if isinstance(stored, dict) and isinstance(found, dict):
        keys = sorted({*stored, *found})
        return [line for key in keys for line in differences(stored.get(key), found.get(key), f"{where}/{key}")]
    if isinstance(stored, float | int) and isinstance(found, float | int):
        if math.isclose(stored, found, rel_tol=CLOSE, abs_tol=1e-12) or (stored != stored and found != found):
            return []
    elif stored == found:
        return []
    return [f"{where}: {stored!r} is now {found!r}"]


def compare(name, found, renewed, pytestconfig):
    renewed[name] = found
    if not pytestconfig.getoption("--renew"):
        moved = differences(STORED.get(name), json.loads(json.dumps(found)), name)
        assert not moved, "\n".join(moved)


@pytest.mark.parametrize("name", lines.LINES)
def test_a_command_gives_what_it_gave(name, workplace, capsys, renewed, pytestconfig):
    if not (pytestconfig.getoption("--pinned") or pytestconfig.getoption("--renew")):
        pytest.skip("numbers of commands are compared with --pinned, on the processor and JAX that stored them")
    compare(name, lines.measured(name, capsys), renewed, pytestconfig)


@pytest.mark.parametrize("name", [*lines.LOGS, *lines.SPOILED])
def test_a_log_is_split_and_checked_as_it_was(name, workplace, renewed, pytestconfig):
    compare(f"log {name}", lines.splits_and_findings(name), renewed, pytestconfig)


@pytest.mark.parametrize("name", lines.DAMAGED)
def test_a_damaged_log_is_refused_as_it_was(name, workplace, capsys, renewed, pytestconfig):
    words = "--data", f"{name}.npz", "--out", f"refused {name}"
    compare(f"damaged {name}", lines.ended(capsys, "train_delan", *words), renewed, pytestconfig)


def test_public_names_have_their_signatures(renewed, pytestconfig):
    compare("public names", lines.public_names(), renewed, pytestconfig)


def test_commands_have_their_options(capsys, renewed, pytestconfig):
    compare("help", lines.help_texts(capsys), renewed, pytestconfig)
