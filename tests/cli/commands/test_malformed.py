"""Errors in files and on command lines: one line, exit status 2, and nothing is written."""

import dataclasses
import io
import json
import pickle
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from calls import json_of, one_line, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import (
    simulate,
    train_delan,
    train_diffnet,
    train_hnn,
    train_hnn_pixels,
    train_hnn_task,
    train_locomotion,
)
from dln_jax.cli.stored_arguments import checked_arguments, stored_arguments
from dln_jax.data import arrays, functions, meshes, schema
from dln_jax.data.splits import split
from dln_jax.data.stated_needs import needs_from_json, needs_from_text
from dln_jax.files import write_json
from dln_jax.learning.engine.checkpoint import Checkpoint, restore, store
from dln_jax.learning.engine.problem import Progress
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import describe
from dln_jax.zoo.run_folder import CONFIG, LOCK
from scripts.reports.commands import arm_table, delan_report, diffnet_table, hnn_table

TRAJECTORIES = {
    "t": np.tile(np.arange(4.0), 5),
    **{key: np.random.default_rng(0).normal(size=(20, 2)) for key in ("q", "qd", "qdd", "tau")},
    "trajectory": np.repeat(np.arange(5), 4),
}
SAMPLES = {"x": np.linspace(0.0, 1.0, 20)[:, None], "y": np.ones((20, 1))}
MESH = {"vertices": np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), "elements": np.array([[0, 1, 2]])}
LONG = "x" * 5000
NEEDS = Needs(joints=("revolute", "prismatic"), friction=True)
DELAN = describe("structured-delan", needs=NEEDS, precision="f64", width=3, depth=1)
DIFFNET = describe("differential-network", sizes=[1, 3, 1], activation="cos", members=1, precision="f64")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def listing():
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(Path().rglob("*"))}


def refuse(capsys, script, *arguments):
    """Asserts one line and exit status 2, and that every file is as it was."""
    before = listing()
    line = refused(capsys, script, *arguments)
    assert listing() == before
    assert len(line) < 1000 + (len(LONG) if LONG in line else 0)
    return line


def assert_one_line_at_most(function, *given):
    """Asserts that the function takes what it is given, or refuses it in one line."""
    try:
        return function(*given)
    except InputError as error:
        assert "\n" not in str(error)


# npz archives


def zipped(path, members, **options):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name, data, **options)


def npy(array):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array)
    return buffer.getvalue()


def header(text, version=1):
    data = text.encode()
    length = struct.pack("<H" if version == 1 else "<I", len(data))
    return b"\x93NUMPY" + bytes([version, 0]) + length + data


def with_header(text, version=1, data=bytes(160)):
    """The first array has this header."""

    def write(path, arrays):
        members = {f"{key}.npy": npy(array) for key, array in arrays.items()}
        zipped(path, {**members, f"{first(arrays)}.npy": header(text, version) + data})

    return write


def first(arrays):
    return next(iter(arrays))


def edited(change):
    """A good archive whose bytes are changed."""

    def write(path, arrays):
        np.savez_compressed(path, **arrays)
        data = bytearray(path.read_bytes())
        change(data)
        path.write_bytes(bytes(data))

    return write


def each_entry(data, local, central, value):
    """Puts a number of two bytes into the headers of all members."""
    for mark, place in ((b"PK\x03\x04", local), (b"PK\x01\x02", central)):
        at = data.find(mark)
        while at >= 0:
            data[at + place : at + place + 2] = struct.pack("<H", value)
            at = data.find(mark, at + 4)


def garbled(data):
    start = 30 + struct.unpack("<H", data[26:28])[0] + struct.unpack("<H", data[28:30])[0]
    data[start : start + 20] = b"\xff" * 20


def saved(value):
    return lambda path, arrays: np.savez(path, **{**arrays, first(arrays): value})


SHAPE = "{'descr': '<f8', 'fortran_order': False, 'shape': %s, }"
TYPE = "{'descr': %s, 'fortran_order': False, 'shape': (20,), }"
HEADERS = [
    *("[1, 2]", "{'descr': '<f8', 'fortran_order': False}", "{'descr': '<f8', (((", "(" * 5000),
    *(SHAPE % shape for shape in ("(1000000000000000,)", "(-20, -1)", "'20'", "(20.0,)")),
    *(TYPE % kind for kind in ("'x9'", "[('a', '<f8')]", "'|O'")),
]
VALUES = [
    np.array([{"a": 1}], dtype=object),
    np.array(["a", "b"]),
    np.ones((20, 2)) * 1j,
    np.array(["2024-01-31"] * 20, dtype="M8[D]"),
    np.zeros((0, 2)),
    np.full((20, 2), np.nan),
]
ARCHIVES = {
    "missing": lambda path, arrays: None,
    "a folder": lambda path, arrays: path.mkdir(),
    "empty": lambda path, arrays: path.write_bytes(b""),
    "text": lambda path, arrays: path.write_text("no archive"),
    "a pickle": lambda path, arrays: path.write_bytes(pickle.dumps({"q": 1})),
    "an npy": lambda path, arrays: path.write_bytes(npy(arrays[first(arrays)])),
    "no members": lambda path, arrays: zipped(path, {}),
    "other members": lambda path, arrays: zipped(path, {"readme.txt": b"hello"}),
    "half": edited(lambda data: data.__delitem__(slice(len(data) // 2, None))),
    "no directory": edited(lambda data: data.__delitem__(slice(len(data) - 30, None))),
    "garbled stream": edited(garbled),
    "wrong checksum": edited(lambda data: each_entry(data, 14, 16, 1)),
    "unknown compression": edited(lambda data: each_entry(data, 8, 10, 97)),
    "encrypted": edited(lambda data: each_entry(data, 6, 8, 1)),
    "no npy": lambda path, arrays: zipped(path, {f"{key}.npy": b"12345678" for key in arrays}),
    "empty npy": lambda path, arrays: zipped(path, {f"{key}.npy": b"" for key in arrays}),
    "cut header": lambda path, arrays: zipped(path, {f"{key}.npy": npy(arrays[key])[:40] for key in arrays}),
    "short data": lambda path, arrays: zipped(path, {f"{key}.npy": npy(arrays[key])[:-3] for key in arrays}),
    "more data": lambda path, arrays: zipped(path, {f"{key}.npy": npy(arrays[key]) + b"1" for key in arrays}),
    "header of another version": with_header(SHAPE % "(20,)", version=9),
    "long header": with_header(SHAPE % "(20,)" + " " * 200_000, version=2),
    "huge shape of nothing": with_header(SHAPE % "(1000000000000, 0)", data=b""),
    **{f"header {number}": with_header(text) for number, text in enumerate(HEADERS)},
    **{f"value {number}": saved(value) for number, value in enumerate(VALUES)},
}


def test_damaged_archives_are_refused_by_name(here):
    for damage, write in ARCHIVES.items():
        for reader, good in ((schema, TRAJECTORIES), (functions, SAMPLES), (meshes, MESH)):
            path = here / f"{damage} of {reader.__name__}.npz"
            write(path, good)
            with one_line(re.escape(str(path))):
                reader.load(path)


def test_commands_refuse_damaged_archives(here, capsys):
    for script, good, option in (
        (train_delan, TRAJECTORIES, "--data"),
        (train_hnn, TRAJECTORIES, "--data"),
        (train_hnn_task, TRAJECTORIES, "--task=measured --data"),
        (train_diffnet, SAMPLES, "--function"),
        (simulate, MESH, "--mesh"),
        (arm_table, TRAJECTORIES, "--data"),
        (delan_report, TRAJECTORIES, "--data"),
        (hnn_table, TRAJECTORIES, "--real-pendulum"),
    ):
        edited(garbled)(here / "garbled.npz", good)
        assert "garbled.npz" in refuse(capsys, script, option, "garbled.npz", "--out run")
        refuse(capsys, script, option, f"{LONG}.npz", "--out run")


def test_only_what_is_needed_is_read_and_no_more_than_the_bound(here, monkeypatch):
    """A key that nobody reads may be anything; those that are read are counted before they are."""
    members = {f"{key}.npy": npy(array) for key, array in TRAJECTORIES.items()}
    zipped("data.npz", {**members, "notes.npy": header(SHAPE % "(1000000000000,)"), "readme.txt": b""})
    data = schema.load("data.npz")
    np.testing.assert_array_equal(data.tau, TRAJECTORIES["tau"])
    with pytest.raises(InputError, match=r"'x' is missing.*not read: t, q, .*readme.txt"):
        functions.load("data.npz")
    monkeypatch.setattr(arrays, "MOST_BYTES", 1000)
    with pytest.raises(InputError, match="holds more than"):
        schema.load("data.npz")


def test_columns_in_either_order_and_bytes_in_either_order_are_read(here):
    q = np.arange(24.0).reshape(12, 2)
    np.savez(
        "data.npz", t=np.arange(12.0), q=np.asfortranarray(q), qd=q.astype(">f4"), trajectory=np.zeros(12, np.uint8)
    )
    data = schema.load("data.npz")
    np.testing.assert_array_equal(data.q, q)
    np.testing.assert_array_equal(data.qd, q)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=4), st.booleans())
def test_an_archive_with_any_bytes_changed_is_read_or_refused(tmp_path_factory, changes, compressed):
    path = tmp_path_factory.mktemp("changed") / "mesh.npz"
    (np.savez_compressed if compressed else np.savez)(path, **MESH)
    data = bytearray(path.read_bytes())
    for place, value in changes:
        data[place % len(data)] = value
    path.write_bytes(bytes(data))
    assert_one_line_at_most(meshes.load, path)


# trajectories


def test_a_trajectory_may_have_any_number_and_is_named_by_it():
    numbers = np.repeat([20240131, 7, 20240202], 4)
    arrays = {key: value[:12] for key, value in TRAJECTORIES.items()}
    data = schema.from_arrays({**arrays, "trajectory": numbers})
    assert data.label.tolist() == ["7", "20240131", "20240202"]
    np.testing.assert_array_equal(data.label[data.trajectory].astype(int), numbers)
    for wrong in (1e300, -1, 0.5):
        with pytest.raises(InputError, match="not whole numbers >= 0"):
            schema.from_arrays({**arrays, "trajectory": np.where(numbers == 7, wrong, numbers)})


def test_a_copy_of_a_trajectory_in_the_test_is_refused(here, capsys):
    copied = {key: value.copy() for key, value in TRAJECTORIES.items()}
    for key in ("q", "qd", "qdd", "tau"):
        copied[key][16:] = copied[key][4:8]
    np.savez("copied.npz", **copied)
    for script in (train_delan, train_hnn):
        assert "'4' is a copy of '1'" in refuse(capsys, script, "--data copied.npz --out run")
    for key in ("q", "qd", "qdd", "tau"):
        copied[key][:] = 1.0
    assert len(split(schema.from_arrays(copied)).test.t) == 4, "a body at rest is at rest in every recording"


# needs

NEEDS = [
    "",
    "{",
    "null",
    "3",
    '"revolute"',
    "[]",
    "{}",
    '{"joints": {}}',
    '{"joints": {"revolute": 1}}',
    '{"joints": []}',
    '{"joints": "revolute"}',
    '{"joints": 2}',
    '{"joints": [["revolute"], "revolute"]}',
    '{"joints": [{}, "revolute"]}',
    '{"joints": [null, 1]}',
    '{"joints": ["ball", "revolute"]}',
    '{"joints": ["revolute", "revolute"], "wind": true}',
    '{"joints": ["revolute", "revolute"], "gravity": 1}',
    '{"joints": ["revolute", "revolute"], "friction": "yes"}',
    '{"joints": ["revolute", "revolute"], "actuation": 3}',
    '{"joints": ["revolute", "revolute"], "actuation": "ab"}',
    '{"joints": ["revolute", "revolute"], "actuation": {"a": 1}}',
    '{"joints": ["revolute", "revolute"], "actuation": [1, 2]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], [1, 2]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[], []]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], ["x"]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], [null]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], [NaN]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[1], [Infinity]]}',
    '{"joints": ["revolute", "revolute"], "actuation": [[[1]], [[2]]]}',
    "[" * 100_000,
    '{"joints": ' + "[" * 500 + "]" * 500 + "}",
]


def test_needs_that_are_none_are_refused(here, capsys):
    for needs in NEEDS:
        with one_line("needs"):
            needs_from_text(needs)
    np.savez("data.npz", **{key: value for key, value in TRAJECTORIES.items() if key != "tau"})
    for needs in ("{", '{"joints": ["revolute"]}'):
        for script, *task in ((train_delan,), (train_hnn_task, "--task measured")):
            assert "needs" in refuse(capsys, script, *task, "--data data.npz --out run --needs", needs)
    np.savez("stated.npz", **TRAJECTORIES, needs=np.array("{"))
    assert "needs" in refuse(capsys, train_delan, "--data stated.npz --out run")


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["revolute", "prismatic", "", "joints"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*Needs._fields, "x"]), inner),
    max_leaves=8,
)


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.sampled_from(Needs._fields), ANY_JSON) | ANY_JSON)
def test_any_json_states_needs_or_is_refused(stated):
    hash(assert_one_line_at_most(needs_from_json, stated))


# config.json

RESUMED = {
    "train_delan": (train_delan, {"data": "data.npz"}, "width"),
    "train_hnn": (train_hnn, {"data": "data.npz"}, "width"),
    "train_hnn_task": (train_hnn_task, {"task": "spring"}, "trajectories"),
    "train_hnn_pixels": (train_hnn_pixels, {}, "steps"),
    "train_diffnet": (train_diffnet, {}, "depth"),
    "diffnet_table": (diffnet_table, {}, "steps"),
    "train_locomotion": (train_locomotion, {}, "episode"),
    "arm_table": (arm_table, {}, "seeds"),
    "hnn_table": (hnn_table, {}, "seeds"),
}


WRONG_NUMBERS = ["many", "3", 2.5, True, [3], {"a": 3}, float("nan"), float("inf"), 10**30, -3]


def test_damaged_configs_are_refused(here, capsys):
    np.savez("data.npz", **TRAJECTORIES)
    Path("run").mkdir()
    Path("run", LOCK).touch()
    for name, (module, changes, number) in RESUMED.items():
        config = {**stored_arguments(arguments_of(module.Arguments)), **changes}
        damaged = [json.dumps({**config, number: "many"})]
        if name == "train_hnn":
            damaged += ["{", "{}", *(json.dumps({**config, number: wrong}) for wrong in WRONG_NUMBERS)]
            missing = {key: value for key, value in config.items() if key != number}
            damaged += map(json.dumps, (missing, {**config, "colour": "red"}))
        for text in damaged:
            Path("run", CONFIG).write_text(text)
            line = refuse(capsys, module, "--out run --resume")
            assert CONFIG in line or (f'"{number}": -3' in text and number in line), text


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_stored_arguments_are_of_the_types_that_the_command_line_has(tmp_path_factory, data):
    expected = stored_arguments(arguments_of(train_hnn.Arguments))
    key = data.draw(st.sampled_from(sorted(expected)))
    path = tmp_path_factory.mktemp("stored") / CONFIG
    write_json(path, {**expected, key: data.draw(ANY_JSON)})
    try:
        stored = dataclasses.asdict(checked_arguments(path, json_of(path), train_hnn.Arguments))
    except InputError as error:
        assert key in str(error) and "\n" not in str(error)
    else:
        assert not isinstance(stored[key], list | dict)


def test_a_damaged_table_of_what_was_measured_is_refused(here, capsys):
    np.savez("data.npz", **TRAJECTORIES)
    folder = here / "run"
    folder.mkdir()
    (folder / LOCK).touch()
    case = "sin/type1/cos/gauss-newton"
    for stored in (
        *("{", {"teapot": {}}, {case: 3}, {case: {"value_mse": "small"}}, {case: {"value_mse": 1.0}}),
        {case: {"value_mse": [1.0]}},
    ):
        write_json(folder / CONFIG, {**stored_arguments(diffnet_table.Arguments()), "samples": 50})
        (folder / "jobs.json").write_text(stored if isinstance(stored, str) else json.dumps(stored))
        assert "jobs.json" in refuse(capsys, diffnet_table, "--out run --resume")
        write_json(folder / CONFIG, {**stored_arguments(hnn_table.Arguments()), "tasks": "spring"})
        assert "jobs.json" in refuse(capsys, hnn_table, "--out run --resume")


# checkpoints

HISTORIES = [
    None,
    3,
    "none",
    {},
    [3],
    [[]],
    [[1, 2.0]],
    [["1", 1.0, 1.0, 1.0, 1.0, ""]],
    [[None, 1.0, 1.0, 1.0, 1.0, ""]],
    [[1.5, 1.0, 1.0, 1.0, 1.0, ""]],
    [[1, {}, 1.0, 1.0, 1.0, ""]],
    [[1, 1.0, 1.0, 1.0, None, ""]],
    [[1, [1.0], 1.0, 1.0, 1.0, ""], [2, [1.0, 2.0], 1.0, 1.0, 1.0, ""]],
    [[1, 1.0, 1.0, 1.0, 1.0, 3]],
]


def test_damaged_histories_are_refused(here):
    """And the state of an undamaged one comes back, numbers that are not finite included."""
    checkpoint = Checkpoint(here, {"settings": {"target": float("inf"), "widths": (1, 2)}, "data": "x"}, resume=True)
    state = {"w": np.arange(3.0)}
    rows = [Progress(1, 2.0, float("nan"), 3.0, 0.5)]
    store(checkpoint, state, rows)
    again = restore(checkpoint, state)
    assert again is not None
    np.testing.assert_array_equal(again[0]["w"], state["w"])
    np.testing.assert_equal(again[1], rows)
    path = here / "checkpoint.json"
    stored = json_of(path)
    for history in HISTORIES:
        path.write_text(json.dumps({**stored, "history": history}))
        with one_line("history"):
            restore(checkpoint, state)


# options


def test_places_that_cannot_be_written_to_are_refused(here, capsys):
    np.savez("data.npz", **TRAJECTORIES)
    Path("file").touch()
    for script, *options in (
        (train_delan, "--data data.npz"),
        (train_diffnet, "--samples 20"),
        (train_locomotion,),
        (simulate,),
        (hnn_table, "--tasks spring"),
        (delan_report, "--only published --data data.npz --test 4"),
    ):
        assert "--out" in refuse(capsys, script, *options, "--out file")


def test_a_cache_that_is_no_folder_is_refused(here, capsys, monkeypatch):
    Path("file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", "file")
    assert "XDG_CACHE_HOME" in refuse(capsys, train_delan, "--out run")
