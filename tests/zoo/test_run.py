"""Every model comes back from its folder as it was, and anything wrong with a folder is refused in one line."""

import hashlib
import json
import struct
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from calls import json_of, one_line
from numpy.testing import assert_array_equal

from dln_jax import Needs, build, describe
from dln_jax.zoo.parameter_files import load_manifest, load_tree, save_tree
from dln_jax.zoo.run import load, save

NEEDS = Needs(joints=("revolute", "prismatic"), friction=True)
DELAN = describe("structured-delan", needs=NEEDS, precision="f32", width=5)
DIFFNET = describe("differential-network", sizes=[1, 3, 1], activation="cos", members=1, precision="f64")


@pytest.fixture
def run_folder(tmp_path):
    save(tmp_path, DELAN, build(DELAN).init(jax.random.key(0)))
    return tmp_path


ALTERED = "truncated or altered"
DAMAGES = [
    ("model.safetensors", lambda path, data: path.write_bytes(data[:-7]), ALTERED),
    ("model.safetensors", lambda path, data: path.write_bytes(data[:-1] + bytes([data[-1] ^ 1])), ALTERED),
    ("model.safetensors", lambda path, data: path.unlink(), "missing, though model.json names it"),
    ("model.json", lambda path, data: path.unlink(), "no such file"),
    ("model.json", lambda path, data: path.write_bytes(b"{"), "not readable as JSON"),
]


def test_damaged_files_are_refused_in_one_line(run_folder):
    for name, damage, words in DAMAGES:
        path = run_folder / name
        data = path.read_bytes()
        damage(path, data)
        with one_line(words):
            load(run_folder)
        path.write_bytes(data)


MANIFEST = {
    '{"schema_version": 99}': "schema version 99",
    '{"schema_version": true}': "schema version",
    '{"tensor_file": "../model.safetensors"}': "tensor_file is",
    '{"tensor_file": ".."}': "missing",
    '{"tensor_file": 3}': "tensor_file",
    '{"sha256": [1]}': "sha256",
    '{"model": null}': "describes no model",
    '{"model": []}': "describes no model",
    '{"model": {}}': "",
}
OF_DELAN = {
    '{"name": "oracle"}': "knows structured-delan",
    '{"name": ["structured-delan"]}': "",
    '{"name": "os:system"}': "",
    '{"name": "own"}': "",
    '{"width": 6}': "expected float32",
    '{"depth": 3}': "is missing|expected float32",
    '{"precision": "f16"}': "precision",
    '{"precision": ["f64"]}': "",
    '{"activation": ["tanh"]}': "",
    '{"needs": []}': "needs",
    '{"needs": {"joints": {"revolute": 1}}}': "needs",
    '{"width": "3"}': "width",
    '{"width": [3]}': "width",
    '{"width": 3.5}': "width",
    '{"width": true}': "width",
    '{"width": -3}': "width",
    '{"depth": 1000000000}': "depth",
    '{"diagonal_shift": NaN}': "not readable as JSON",
    '{"shared_trunk": ["yes"]}': "shared_trunk",
    '{"colour": [1.0]}': "colour",
}
OF_DIFFNET = {
    '{"sizes": "1-3-1"}': "sizes",
    '{"sizes": [1]}': "sizes",
    '{"sizes": ["1", "3", "1"]}': "sizes",
    '{"sizes": [1, -3, 1]}': "sizes",
    '{"members": "1"}': "members",
    '{"members": 0}': "members",
}
"""Wrong values and words of their refusals."""


def test_values_that_no_model_has_are_refused_in_one_line(run_folder):
    stored = json_of(run_folder / "model.json")
    (run_folder / "diffnet").mkdir()
    save(run_folder / "diffnet", DIFFNET, build(DIFFNET).init(jax.random.key(0)))
    other = json_of(run_folder / "diffnet/model.json")
    for folder, manifest, rows in (
        (run_folder, lambda change: stored | change, MANIFEST),
        (run_folder, lambda change: {**stored, "model": stored["model"] | change}, OF_DELAN),
        (run_folder / "diffnet", lambda change: {**other, "model": other["model"] | change}, OF_DIFFNET),
    ):
        for text, words in rows.items():
            (folder / "model.json").write_text(json.dumps(manifest(json.loads(text))))
            with one_line(words or None) as caught:
                load(folder)
            assert len(str(caught.value)) < 1000, text


def test_damaged_tensors_are_refused_even_if_the_digest_is_right(run_folder):
    stored = json_of(run_folder / "model.json")
    for tensors in (
        b"no tensors",
        struct.pack("<Q", 2**60) + b"{}",
        struct.pack("<Q", 2) + b"[]",
        # A type that NumPy lacks.
        struct.pack("<Q", 60) + b'{"a":{"dtype":"F8_E4M3","shape":[1],"data_offsets":[0,1]}}'.ljust(60) + b"\0",
        safetensors.numpy.save({"a": np.zeros(3)}),
    ):
        digest = hashlib.sha256(tensors).hexdigest()
        (run_folder / "model.json").write_text(json.dumps({**stored, "sha256": digest}))
        (run_folder / "model.safetensors").write_bytes(tensors)
        with one_line("model.safetensors"):
            load(run_folder)


# stored trees


class State(NamedTuple):
    layers: dict
    count: jax.Array
    done: jax.Array


TREE = State(
    {"a/b": {"w": jnp.arange(6.0).reshape(2, 3), "e": jnp.ones((), jnp.float32) / 3}},
    jnp.int32(7),
    jnp.array(True),
)


def test_arrays_come_back_however_they_lie_in_memory(tmp_path):
    numbers = np.arange(24.0).reshape(4, 6)
    tree = {"transposed": numbers.T, "columns": numbers.T[:, [True, False, True, False]], "strided": numbers[::2, ::3]}
    save_tree(tmp_path, "state", tree, {})
    jax.tree.map(assert_array_equal, load_tree(tmp_path, "state", tree), tree)


def test_a_tree_comes_back_bit_for_bit_and_old_states_are_removed(tmp_path):
    for number in (1, 2):
        save_tree(tmp_path, "checkpoint", TREE, {"note": number}, number=number)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint-000000002.safetensors", "checkpoint.json"]
    manifest = load_manifest(tmp_path, "checkpoint")
    assert manifest["note"] == 2 and set(manifest["versions"]) >= {"jax", "dln-jax"}
    assert manifest["tensors"]["count"] == {"shape": [], "dtype": "int32"}
    jax.tree.map(partial(assert_array_equal, strict=True), load_tree(tmp_path, "checkpoint", TREE), TREE)
