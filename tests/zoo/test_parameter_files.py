"""Stored trees come back bit for bit."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.zoo.parameter_files import load_manifest, load_tree, save_tree


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
    jax.tree.map(np.testing.assert_array_equal, load_tree(tmp_path, "state", tree), tree)


def test_a_tree_comes_back_bit_for_bit_and_old_states_are_removed(tmp_path):
    for number in (1, 2):
        save_tree(tmp_path, "checkpoint", TREE, {"note": number}, number=number)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint-000000002.safetensors", "checkpoint.json"]
    manifest = load_manifest(tmp_path, "checkpoint")
    assert manifest["note"] == 2 and set(manifest["versions"]) >= {"jax", "dln-jax"}
    assert manifest["tensors"]["count"] == {"shape": [], "dtype": "int32"}
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), load_tree(tmp_path, "checkpoint", TREE), TREE)
