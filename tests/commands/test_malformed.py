"""Errors in files and on command lines: one line, exit status 2, and nothing is written."""

import io
import json
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from calls import json_of, one_line, refused
from numpy.testing import assert_array_equal, assert_equal
from small_logs import STATES, small_log

from dln_jax.commands import (
    simulate,
    train_delan,
    train_diffnet,
    train_hnn,
    train_hnn_pixels,
    train_hnn_task,
    train_locomotion,
)
from dln_jax.data import arrays, functions, meshes, schema
from dln_jax.data.joints import needs_from_text
from dln_jax.data.splits import split
from dln_jax.files import write_json
from dln_jax.learning.engine.checkpoint import Checkpoint, restore, store
from dln_jax.learning.engine.problem import Progress
from dln_jax.runs.arguments import arguments_of
from dln_jax.runs.folder import CONFIG, LOCK, stored_arguments

TRAJECTORIES = small_log(2)
MESH = {"vertices": np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), "elements": np.array([[0, 1, 2]])}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with data, beside the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    np.savez("data.npz", **TRAJECTORIES)
    return here


def listing():
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(Path().rglob("*"))}


def refuse(capsys, script, *arguments):
    """Asserts one line and exit status 2, and that every file is as it was."""
    before = listing()
    line = refused(capsys, script, *arguments)
    assert listing() == before and len(line) < 1000
    return line


# npz archives


def zipped(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)


def npy(array):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array)
    return buffer.getvalue()


def header(text, version=1, data=bytes(160)):
    length = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + length + text.encode() + data


def garbled(arrays):
    """An archive whose first stream is broken."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    data = bytearray(buffer.getvalue())
    start = 30 + sum(struct.unpack("<HH", data[26:30]))
    data[start : start + 20] = b"\xff" * 20
    return bytes(data)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


SHAPE = "{'descr': '<f8', 'fortran_order': False, 'shape': %s, }"
TYPE = "{'descr': %s, 'fortran_order': False, 'shape': (20,), }"
VERTICES = [
    b"12345678",
    npy(MESH["vertices"])[:-3],
    npy(MESH["vertices"]) + b"1",
    header(SHAPE % "(20,)", version=9),
    header(SHAPE % "(20,)" + " " * 200_000, version=2),
    header(SHAPE % "(1000000000000, 0)", data=b""),
    *map(header, ("[1, 2]", "{'descr': '<f8', (((", "(" * 5000)),
    *(header(SHAPE % shape) for shape in ("(1000000000000000,)", "(-20, -1)", "'20'", "(20.0,)")),
    *(header(TYPE % kind) for kind in ("'x9'", "[('a', '<f8')]", "'|O'")),
    *map(npy, (np.array(["a", "b"]), np.ones((3, 2)) * 1j, np.array([Bomb()]), np.full((3, 2), np.nan))),
]
"""Contents of a member that no reader takes."""


def test_damaged_archives_are_refused_by_name(here):
    path, words = here / "mesh.npz", re.escape(str(here / "mesh.npz"))
    for content in (b"", b"no archive", garbled(MESH)[:100], garbled(MESH)):
        path.write_bytes(content)
        with one_line(words):
            meshes.load(path)
    for vertices in VERTICES:
        zipped(path, vertices=vertices, elements=npy(MESH["elements"]))
        with one_line(words):
            meshes.load(path)


def test_commands_refuse_damaged_archives(here, capsys):
    for script, members, option in (
        (train_delan, TRAJECTORIES, "--data"),
        (train_hnn, TRAJECTORIES, "--data"),
        (train_hnn_task, TRAJECTORIES, "--task=measured --data"),
        (train_diffnet, {"x": np.ones((20, 1))}, "--function"),
        (simulate, MESH, "--mesh"),
    ):
        Path("garbled.npz").write_bytes(garbled(members))
        assert "garbled.npz" in refuse(capsys, script, option, "garbled.npz", "--out run")


def test_only_what_is_needed_is_read_and_no_more_than_the_bound(here, monkeypatch):
    """A key that nobody reads may be anything; those that are read are counted before they are."""
    members = {key: npy(array) for key, array in TRAJECTORIES.items()}
    zipped("data.npz", **members, notes=header(SHAPE % "(1000000000000,)"))
    assert_array_equal(schema.load("data.npz").tau, TRAJECTORIES["tau"])
    with one_line(r"'x' is missing.*not read: t, .*notes"):
        functions.load("data.npz")
    monkeypatch.setattr(arrays, "MOST_BYTES", 1000)
    with one_line("larger than"):
        schema.load("data.npz")


# trajectories


def test_a_copy_of_a_trajectory_in_the_test_is_refused(here, capsys):
    copied = {key: TRAJECTORIES[key][[*range(16), *range(4, 8)]] for key in STATES}
    np.savez("copied.npz", **{**TRAJECTORIES, **copied})
    for script in (train_delan, train_hnn):
        assert "'4' is a copy of training trajectory '1'" in refuse(capsys, script, "--data copied.npz --out run")
    at_rest = schema.from_arrays({**TRAJECTORIES, **dict.fromkeys(STATES, np.ones((20, 2)))})
    assert len(split(at_rest).test.t) == 4, "a body at rest is at rest in every recording"


# needs

NEEDS = [
    "{",
    "3",
    "{}",
    '{"joints": {}}',
    '{"joints": []}',
    '{"joints": "revolute"}',
    '{"joints": [["revolute"], "revolute"]}',
    '{"joints": [null, 1]}',
    '{"joints": ["ball", "revolute"]}',
    '{"joints": ["revolute", "revolute"], "wind": true}',
    '{"joints": ["revolute", "revolute"], "joint_friction": ["rust"]}',
    '{"joints": ["revolute", "revolute"], "gravity": 1}',
    '{"joints": ["revolute", "revolute"], "friction": "yes"}',
    '{"joints": ["revolute", "revolute"], "actuation": {"a": 1}}',
    '{"joints": ["revolute", "revolute"], "actuation": [1, 2]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], [1, 2]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[], []]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], [null]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], [NaN]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[[1]], [[2]]]}',
    "[" * 100_000,
    '{"joints": ' + "[" * 500 + "]" * 500 + "}",
]


def test_needs_that_are_none_are_refused(here, capsys):
    for needs in NEEDS:
        with one_line("needs"):
            needs_from_text(needs)
    for script, *task in ((train_delan,), (train_hnn_task, "--task measured")):
        assert "needs" in refuse(capsys, script, *task, "--data data.npz --out run --needs", "{")
    np.savez("stated.npz", **TRAJECTORIES, needs=np.array("{"))
    assert "needs" in refuse(capsys, train_delan, "--data stated.npz --out run")


# config.json

RESUMED = [
    (train_hnn, {"data": "data.npz"}, "width"),
    (train_delan, {"data": "data.npz"}, "width"),
    (train_hnn_task, {"task": "spring"}, "trajectories"),
    (train_hnn_pixels, {}, "steps"),
    (train_diffnet, {}, "depth"),
    (train_locomotion, {}, "episode"),
]
WRONG_NUMBERS = ["3", 2.5, True, [3], {"a": 3}, float("nan"), float("inf"), 10**30, -3]


def test_damaged_configs_are_refused(here, capsys):
    Path("run").mkdir()
    Path("run", LOCK).touch()
    for module, changes, number in RESUMED:
        config = {**stored_arguments(arguments_of(module.Arguments)), **changes}
        damaged = [json.dumps({**config, number: "many"})]
        if module is train_hnn:
            damaged += ["{", "{}", *(json.dumps({**config, number: wrong}) for wrong in WRONG_NUMBERS)]
            damaged.append(json.dumps({**config, "colour": "red"}))
        for text in damaged:
            Path("run", CONFIG).write_text(text)
            line = refuse(capsys, module, "--out run --resume")
            assert CONFIG in line or (f'"{number}": -3' in text and number in line), text


# checkpoints

HISTORIES = [
    "null",
    "{}",
    "[3]",
    "[[1, 2.0]]",
    '[["1", 1.0, 1.0, 1.0, 1.0, ""]]',
    '[[1.5, 1.0, 1.0, 1.0, 1.0, ""]]',
    '[[1, {}, 1.0, 1.0, 1.0, ""]]',
    '[[1, 1.0, 1.0, 1.0, null, ""]]',
    '[[1, [1.0], 1.0, 1.0, 1.0, ""], [2, [1.0, 2.0], 1.0, 1.0, 1.0, ""]]',
    "[[1, 1.0, 1.0, 1.0, 1.0, 3]]",
]


def test_damaged_histories_are_refused(here):
    """And the state of an undamaged one comes back, numbers that are not finite included."""
    checkpoint = Checkpoint(here, {"settings": {"target": float("inf"), "widths": (1, 2)}, "data": "x"}, resume=True)
    state = {"w": np.arange(3.0)}
    rows = [Progress(1, 2.0, float("nan"), 3.0, 0.5)]
    store(checkpoint, state, rows)
    found, history = restore(checkpoint, state)
    assert_array_equal(found["w"], state["w"])
    assert_equal(history, rows)
    path = here / "checkpoint.json"
    stored = json_of(path)
    for damaged in HISTORIES:
        write_json(path, {**stored, "history": json.loads(damaged)})
        with one_line("history"):
            restore(checkpoint, state)


# places


def test_places_that_cannot_be_written_to_are_refused(here, capsys, monkeypatch):
    Path("file").touch()
    for script in (train_locomotion, simulate):
        assert "--out" in refuse(capsys, script, "--out file")
    monkeypatch.setenv("XDG_CACHE_HOME", "file")
    assert "XDG_CACHE_HOME" in refuse(capsys, train_delan, "--out run")
