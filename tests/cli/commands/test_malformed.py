"""Errors in files and on command lines: one line, exit status 2, and nothing is written."""

import dataclasses
import hashlib
import io
import json
import pickle
import re
import struct
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest
import safetensors.numpy
from calls import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import (
    export_c,
    make_data,
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
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import load, save
from dln_jax.zoo.run_folder import CONFIG, LOCK
from scripts.reports.commands import (
    arm_table,
    compare_locomotion,
    delan_report,
    diffnet_report,
    diffnet_table,
    hnn_table,
    softbody_report,
    stability,
)

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


def saved(**changes):
    return lambda path, arrays: np.savez(path, **{**arrays, **{first(arrays): value for value in changes.values()}})


SHAPE = "{'descr': '<f8', 'fortran_order': False, 'shape': %s, }"
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
    "header that is not a dictionary": with_header("[1, 2]"),
    "header without a shape": with_header("{'descr': '<f8', 'fortran_order': False}"),
    "header that is no Python": with_header("{'descr': '<f8', ((("),
    "deeply nested header": with_header("(" * 5000),
    "long header": with_header(SHAPE % "(20,)" + " " * 200_000, version=2),
    "huge shape": with_header(SHAPE % "(10**15,)".replace("10**15", "1000000000000000")),
    "huge shape of nothing": with_header(SHAPE % "(1000000000000, 0)", data=b""),
    "negative shape": with_header(SHAPE % "(-20, -1)"),
    "shape of a string": with_header(SHAPE % "'20'"),
    "shape of numbers that are not whole": with_header(SHAPE % "(20.0,)"),
    "unknown type": with_header("{'descr': 'x9', 'fortran_order': False, 'shape': (20,), }"),
    "structured type": with_header("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (20,), }"),
    "object type": with_header("{'descr': '|O', 'fortran_order': False, 'shape': (20,), }"),
    "pickled objects": saved(objects=np.array([{"a": 1}], dtype=object)),
    "words": saved(words=np.array(["a", "b"])),
    "complex numbers": saved(complex=np.ones((20, 2)) * 1j),
    "dates": saved(dates=np.array(["2024-01-31"] * 20, dtype="M8[D]")),
    "nothing": saved(nothing=np.zeros((0, 2))),
    "NaN": saved(nan=np.full((20, 2), np.nan)),
}
READERS = {
    "train_delan": (train_delan, TRAJECTORIES, "--data"),
    "train_hnn": (train_hnn, TRAJECTORIES, "--data"),
    "train_hnn_task": (train_hnn_task, TRAJECTORIES, "--task=measured", "--data"),
    "train_diffnet": (train_diffnet, SAMPLES, "--function"),
    "simulate": (simulate, MESH, "--mesh"),
}


@pytest.mark.parametrize("damage", ARCHIVES)
def test_a_damaged_archive_is_refused(here, damage):
    for reader, good in ((schema, TRAJECTORIES), (functions, SAMPLES), (meshes, MESH)):
        path = here / f"{reader.__name__}.npz"
        ARCHIVES[damage](path, good)
        with pytest.raises(InputError, match=re.escape(str(path))) as caught:
            reader.load(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("reader", READERS)
def test_a_command_refuses_a_damaged_archive(here, capsys, reader):
    script, arrays, *options = READERS[reader]
    ARCHIVES["half"](here / "data.npz", arrays)
    assert "data.npz" in refuse(capsys, script, *options, "data.npz", "--out", "run")


@pytest.mark.parametrize("script", [arm_table, delan_report, hnn_table])
def test_reports_refuse_damaged_archives(here, capsys, script):
    option = "--real-pendulum" if script is hnn_table else "--data"
    for path in ("half.npz", f"{LONG}.npz"):
        refuse(capsys, script, option, path, "--out", "run")
    edited(garbled)(here / "half.npz", TRAJECTORIES)
    refuse(capsys, script, option, "half.npz", "--out", "run")


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
    try:
        meshes.load(path)
    except InputError as error:
        assert "\n" not in str(error)


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
    with pytest.raises(InputError, match="label names 1 trajectories"):
        schema.from_arrays({**arrays, "trajectory": numbers, "label": ["a"]})


def test_a_copy_of_a_trajectory_in_the_test_is_refused(here, capsys):
    copied = {key: value.copy() for key, value in TRAJECTORIES.items()}
    for key in ("q", "qd", "qdd", "tau"):
        copied[key][16:] = copied[key][4:8]
    np.savez("copied.npz", **copied)
    for script in (train_delan, train_hnn):
        assert "'4' is a copy of '1'" in refuse(capsys, script, "--data", "copied.npz", "--out", "run")
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


@pytest.mark.parametrize("needs", NEEDS, ids=lambda text: text[:60] or "empty")
def test_needs_that_are_none_are_refused(needs):
    with pytest.raises(InputError, match="needs") as caught:
        needs_from_text(needs)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("needs", ["{", '{"joints": ["revolute"]}'])
def test_needs_of_an_option_and_of_a_file_are_refused(here, capsys, needs):
    np.savez("data.npz", **{key: value for key, value in TRAJECTORIES.items() if key != "tau"})
    for script, *options in ((train_delan,), (train_hnn_task, "--task", "measured")):
        assert "needs" in refuse(capsys, script, *options, "--data", "data.npz", "--out", "run", "--needs", needs)
    np.savez("stated.npz", **TRAJECTORIES, needs=np.array(needs))
    assert "needs" in refuse(capsys, train_delan, "--data", "stated.npz", "--out", "run")


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["revolute", "prismatic", "", "joints"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*Needs._fields, "x"]), inner),
    max_leaves=8,
)


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.sampled_from(Needs._fields), ANY_JSON) | ANY_JSON)
def test_any_json_states_needs_or_is_refused(stated):
    try:
        assert hash(needs_from_json(stated)) is not None
    except InputError as error:
        assert "\n" not in str(error)


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


def put(key, value):
    return lambda config, number: {**config, key or number: value}


CONFIGS = {
    "no JSON": lambda config, number: "{",
    "empty": lambda config, number: "",
    "binary": lambda config, number: "\x00\x01",
    "a list": lambda config, number: [config],
    "null": lambda config, number: None,
    "nested": lambda config, number: "[" * 100_000,
    "nothing in it": lambda config, number: {},
    "a missing key": lambda config, number: {key: value for key, value in config.items() if key != number},
    "an unknown key": put("colour", "red"),
    "a word": put(None, "many"),
    "a number as a word": put(None, "3"),
    "a fraction": put(None, 2.5),
    "a truth": put(None, True),
    "a list of numbers": put(None, [3]),
    "an object": put(None, {"a": 3}),
    "NaN": put(None, float("nan")),
    "Infinity": put(None, float("inf")),
    "too large": put(None, 10**30),
    "negative": put(None, -3),
}


@pytest.mark.parametrize(
    ("script", "damage"), [*(("train_hnn", damage) for damage in CONFIGS), *((script, "a word") for script in RESUMED)]
)
def test_a_damaged_config_is_refused(here, capsys, script, damage):
    module, changes, number = RESUMED[script]
    np.savez("data.npz", **TRAJECTORIES)
    folder = here / "run"
    folder.mkdir()
    (folder / LOCK).touch()
    damaged = CONFIGS[damage]({**stored_arguments(arguments_of(module.Arguments)), **changes}, number)
    (folder / CONFIG).write_text(damaged if isinstance(damaged, str) else json.dumps(damaged))
    line = refuse(capsys, module, "--out", "run", "--resume")
    assert CONFIG in line or (damage == "negative" and number in line)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_stored_arguments_are_of_the_types_that_the_command_line_has(tmp_path_factory, data):
    expected = stored_arguments(arguments_of(train_hnn.Arguments))
    key = data.draw(st.sampled_from(sorted(expected)))
    path = tmp_path_factory.mktemp("stored") / CONFIG
    write_json(path, {**expected, key: data.draw(ANY_JSON)})
    try:
        stored = dataclasses.asdict(checked_arguments(path, json.loads(path.read_text()), train_hnn.Arguments))
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
        *("{", "[]", {"teapot": {}}, {case: 3}, {case: {"value_mse": "small"}}, {case: {"value_mse": 1.0}}),
        {case: {"value_mse": [1.0]}},
    ):
        write_json(folder / CONFIG, {**stored_arguments(diffnet_table.Arguments()), "samples": 50})
        (folder / "jobs.json").write_text(stored if isinstance(stored, str) else json.dumps(stored))
        assert "jobs.json" in refuse(capsys, diffnet_table, "--out", "run", "--resume")
        write_json(folder / CONFIG, {**stored_arguments(hnn_table.Arguments()), "tasks": "spring"})
        assert "jobs.json" in refuse(capsys, hnn_table, "--out", "run", "--resume")


# models and checkpoints


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A model of dynamics and a differential network, as they are stored."""
    folder = tmp_path_factory.mktemp("models")
    for name in ("delan", "diffnet"):
        (folder / name).mkdir()
    save(folder / "delan", DELAN, build(DELAN).init(jax.random.key(0)))
    save(folder / "diffnet", DIFFNET, build(DIFFNET).init(jax.random.key(0)))
    return {name: {path.name: path.read_bytes() for path in (folder / name).iterdir()} for name in ("delan", "diffnet")}


def manifest(**changes):
    return "manifest", changes


def described(**changes):
    return "model", changes


DAMAGED_MODELS = {
    "no JSON": ("text", "{"),
    "a list": ("text", "[]"),
    "nested": ("text", "[" * 100_000),
    "no schema": manifest(schema_version=None),
    "schema in words": manifest(schema_version="1"),
    "schema that is true": manifest(schema_version=True),
    "no file": manifest(tensor_file=None),
    "file that is a number": manifest(tensor_file=3),
    "file that is a list": manifest(tensor_file=["model.safetensors"]),
    "file elsewhere": manifest(tensor_file="../model.safetensors"),
    "file that is a folder": manifest(tensor_file=".."),
    "file of a long name": manifest(tensor_file=LONG),
    "no digest": manifest(sha256=None),
    "digest that is a list": manifest(sha256=[1]),
    "no description": manifest(model=None),
    "description in words": manifest(model="delan"),
    "description that is a list": manifest(model=[]),
    "empty description": manifest(model={}),
    "name that is a list": described(name=["structured-delan"]),
    "name that is a number": described(name=3),
    "precision that is a list": described(precision=["f64"]),
    "precision that is a number": described(precision=64),
    "unknown precision": described(precision="f16"),
    "activation that is a list": described(activation=["tanh"]),
    "activation that is a number": described(activation=1),
    "a factory that is elsewhere": described(name="os:system"),
    "a factory that nobody knows": described(name="own"),
    "an older schema": manifest(schema_version=1),
}
OF_DELAN = {
    "needs that are a list": described(needs=[]),
    "needs that are null": described(needs=None),
    "needs with wrong joints": described(needs={"joints": {"revolute": 1}}),
    "width in words": described(width="3"),
    "width that is a list": described(width=[3]),
    "width that is null": described(width=None),
    "width that is a fraction": described(width=3.5),
    "width that is true": described(width=True),
    "no width": described(width=0),
    "negative width": described(width=-3),
    "depth in words": described(depth="1"),
    "no depth": described(depth=0),
    "endless depth": described(depth=10**9),
    "shift in words": described(diagonal_shift="2"),
    "shift that is not finite": described(diagonal_shift=float("nan")),
    "trunk in words": described(shared_trunk="yes"),
    "unknown setting": described(colour=1.0),
}
OF_DIFFNET = {
    "sizes in words": described(sizes="1-3-1"),
    "sizes that are null": described(sizes=None),
    "one size": described(sizes=[1]),
    "sizes of words": described(sizes=["1", "3", "1"]),
    "negative sizes": described(sizes=[1, -3, 1]),
    "endless sizes": described(sizes=[1] * 5000),
    "members in words": described(members="1"),
    "no members": described(members=0),
}


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        *(("delan", damage) for damage in {**DAMAGED_MODELS, **OF_DELAN}),
        *(("diffnet", damage) for damage in OF_DIFFNET),
    ],
)
def test_a_damaged_model_is_refused(here, capsys, models, name, damage):
    (here / "run").mkdir()
    for file, data in models[name].items():
        (here / "run" / file).write_bytes(data)
    kind, change = {**DAMAGED_MODELS, **OF_DELAN, **OF_DIFFNET}[damage]
    stored = json.loads(models[name]["model.json"])
    if kind == "manifest":
        stored |= change
    elif kind == "model":
        stored["model"] |= change
    (here / "run" / "model.json").write_text(change if kind == "text" else json.dumps(stored))
    with pytest.raises(InputError) as caught:
        load("run")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000 + len(LONG)
    if damage == "a list":
        refuse(capsys, export_c, "--run", "run", "--out", "c")


TENSORS = {
    "empty": b"",
    "text": b"no tensors",
    "a huge header": struct.pack("<Q", 2**60) + b"{}",
    "no header": struct.pack("<Q", 2) + b"[]",
    "a type that NumPy lacks": struct.pack("<Q", 60)
    + b'{"a":{"dtype":"F8_E4M3","shape":[1],"data_offsets":[0,1]}}'.ljust(60)
    + b"\0",
    "other tensors": safetensors.numpy.save({"a": np.zeros(3)}),
}


@pytest.mark.parametrize("damage", TENSORS)
def test_damaged_tensors_are_refused_even_if_the_digest_is_right(here, capsys, models, damage):
    (here / "run").mkdir()
    stored = json.loads(models["delan"]["model.json"]) | {"sha256": hashlib.sha256(TENSORS[damage]).hexdigest()}
    write_json(here / "run" / "model.json", stored)
    (here / "run" / "model.safetensors").write_bytes(TENSORS[damage])
    assert "model.safetensors" in refuse(capsys, export_c, "--run", "run", "--out", "c")


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


@pytest.mark.parametrize("history", HISTORIES, ids=str)
def test_a_damaged_history_is_refused(here, history):
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
    path.write_text(json.dumps({**json.loads(path.read_text()), "history": history}))
    with pytest.raises(InputError, match="history") as caught:
        restore(checkpoint, state)
    assert "\n" not in str(caught.value)


# options

SCRIPTS = {
    "train_delan": (train_delan, "--data", "data.npz"),
    "train_diffnet": (train_diffnet, "--samples", "20"),
    "train_locomotion": (train_locomotion,),
    "simulate": (simulate,),
    "hnn_table": (hnn_table, "--tasks", "spring"),
    "delan_report": (delan_report, "--only", "published", "--data", "data.npz", "--test", "4"),
}


PLACES = ("file", "file/below", "full", "link", LONG)


@pytest.mark.parametrize(
    ("script", "out"),
    [*(pytest.param("simulate", out, id=out[:20]) for out in PLACES), *((name, "file") for name in SCRIPTS)],
)
def test_a_place_that_cannot_be_written_to_is_refused(here, capsys, script, out):
    np.savez("data.npz", **TRAJECTORIES)
    Path("file").touch()
    Path("full").mkdir()
    Path("full/notes.txt").touch()
    Path("link").symlink_to("nowhere")
    module, *options = SCRIPTS[script]
    assert "--out" in refuse(capsys, module, *options, "--out", out)


OPTIONS = {
    "infinite box": (make_data, "--scene", "pendulum", "--kind", "uniform", "--position-bound", "inf"),
    "box that is none": (make_data, "--scene", "pendulum", "--kind", "uniform", "--rate-bound", "nan"),
    "negative seed of states": (make_data, "--scene", "pendulum", "--kind", "uniform", "--seed", "-1"),
    "negative seed of swings": (make_data, "--scene", "pendulum", "--kind", "free-swing", "--seed", "-1"),
    "infinite time step": (make_data, "--scene", "pendulum", "--kind", "free-swing", "--dt", "inf"),
    "infinite letters": (make_data, "--dt", "inf"),
    "one sample": (train_diffnet, "--samples", "1"),
    "one sample for the table": (diffnet_table, "--samples", "1"),
    "endless networks": (train_diffnet, "--depth", "5000"),
    "endless Lagrangian": (train_delan, "--data", "data.npz", "--depth", "5000"),
    "endless Hamiltonian": (train_hnn, "--data", "data.npz", "--depth", "5000"),
    "endless phase model": (train_hnn_task, "--task", "measured", "--data", "free.npz", "--depth", "5000"),
    "endless report": (diffnet_report, "--depth", "5000"),
    "infinite rate": (train_delan, "--data", "data.npz", "--optimizer", "adam", "--learning-rate", "inf"),
    "infinite noise": (train_diffnet, "--noise", "inf"),
    "infinite posture": (train_locomotion, "--upright", "inf"),
    "infinite posture of all": (compare_locomotion, "--upright", "inf"),
    "unknown rival": (compare_locomotion, "--rivals", "ppo,dreams"),
    "infinite stiffness": (simulate, "--youngs-modulus", "inf"),
    "unknown report": (softbody_report, "--only", "teapot"),
    "unknown case": (stability, "--only", ","),
    "unknown scene": (simulate, "--scene", "teapot"),
    "unknown table": (hnn_table, "--tasks", "spring,teapot"),
    "no run to export": (export_c, "--run", "nothing"),
    "long name to export": (export_c, "--run", LONG),
}


@pytest.mark.parametrize("mistake", OPTIONS)
def test_a_number_or_a_name_that_cannot_be_is_refused(here, capsys, mistake):
    np.savez("data.npz", **TRAJECTORIES)
    np.savez("free.npz", **{key: value for key, value in TRAJECTORIES.items() if key != "tau"})
    script, *options = OPTIONS[mistake]
    refuse(capsys, script, *options, "--out", "new.npz" if script is make_data else "new")


def test_a_mesh_that_is_held_everywhere_or_by_no_number_is_refused(here, capsys):
    for held in (np.arange(3), np.array([7]), np.array([-1]), np.zeros(0, int), np.array([0.5]), np.array([[0]])):
        np.savez("mesh.npz", **MESH, held=held)
        assert "held" in refuse(capsys, simulate, "--mesh", "mesh.npz", "--out", "run")


def test_a_cache_that_is_no_folder_is_refused(here, capsys, monkeypatch):
    Path("file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", "file")
    assert "XDG_CACHE_HOME" in refuse(capsys, train_delan, "--out", "run")
