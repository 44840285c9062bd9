"""Exported C as Python functions: what they take, that they share nothing between calls, and hold nothing on to."""

import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from comparison import STRICT, TYPES
from compilers import needs_compiler

from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.types import InputError

pytestmark = needs_compiler
MATRIX = np.arange(6.0).reshape(2, 3)


class Several(NamedTuple):
    y: jnp.ndarray
    total: jnp.ndarray


def matrix(a, k):
    return k * a.T


def several(a, k):
    return Several(a + k, jnp.sum(a))


def count(flag, n, wide):
    return jnp.where(flag, n, -n) + wide.astype(jnp.int32)


@pytest.fixture(scope="module", params=TYPES)
def loaded(request, tmp_path_factory):
    """The functions of an export, and the type of its real numbers."""
    folder, real = tmp_path_factory.mktemp("binding"), TYPES[request.param]
    functions: dict[str, Any] = {
        function.__name__: (function, (np.zeros((2, 3), real), real(0))) for function in (matrix, several)
    }
    functions["number"] = (lambda k: 2 * k, (real(0),))
    functions["count"] = (count, (np.bool_(True), np.int32(0), np.uint32(0)))
    export_c(functions, folder, precision=request.param)
    return load_c(folder, flags=("-O0", *STRICT)), real


def test_any_real_numbers_of_the_shape_are_taken(loaded):
    functions, real = loaded
    arrays = [np.array(MATRIX, dtype) for dtype in (np.float64, np.float32, np.int64, ">f8")]
    for a in (*arrays, np.asfortranarray(MATRIX), MATRIX.tolist(), np.repeat(MATRIX, 2, axis=1)[:, ::2]):
        for k in (2, np.float32(2), np.array(2.0), jnp.array(2.0)):
            result = functions.matrix(a, k)
            assert result.dtype == real and result.shape == (3, 2)
            np.testing.assert_array_equal(result, 2 * MATRIX.T)


def test_results_are_new_arrays_and_numbers(loaded):
    functions, real = loaded
    array = MATRIX.astype(real)
    first, second = functions.several(array, 1.0), functions.several(array, 2.0)
    np.testing.assert_array_equal(first.y, MATRIX + 1)
    np.testing.assert_array_equal(second.y, MATRIX + 2)
    assert first.total == second.total == 15 and first.y.flags.writeable
    assert functions.number(3.0) == 6 and isinstance(functions.number(3.0), float)
    assert functions.count(True, 3, 4) == 7 and functions.count(np.bool_(False), np.int32(3), 4) == 1
    assert isinstance(functions.count(True, 3, 4), int)
    assert "several(a [2, 3], k) -> y [2, 3], total" in functions.several.__doc__


def test_nothing_is_held_on_to(loaded):
    functions, real = loaded
    a, k = MATRIX.astype(real), np.array(1.0, real)
    before, result = (sys.getrefcount(a), sys.getrefcount(k)), functions.several(a, k)
    for _ in range(100):
        result = functions.several(a, k)
        with pytest.raises(InputError):
            functions.several(a, a)
    assert (sys.getrefcount(a), sys.getrefcount(k)) == before
    references = sys.getrefcount(result.y)
    assert references == 2
    a.resize((6, 1))  # refused while a buffer of it is held


def test_threads_may_call_at_once(loaded):
    functions, real = loaded
    inputs = [np.full((2, 3), number, real) for number in range(200)]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda a: functions.matrix(a, 1.0), inputs))
    for a, result in zip(inputs, results, strict=True):
        np.testing.assert_array_equal(result, a.T)


REFUSED = [
    ((MATRIX,), "matrix takes a, k; got 1 arguments$"),
    ((MATRIX, 1.0, 2.0), "matrix takes a, k; got 3 arguments$"),
    ((MATRIX.T, 1.0), r"a has shape \(3, 2\); expected \(2, 3\)"),
    ((0.1, 1.0), r"a has shape \(\)"),
    ((MATRIX, [1.0]), r"k has shape \(1,\)"),
    ((MATRIX, "1"), "k has type <U1; expected real numbers"),
    ((MATRIX + 1j, 1.0), "a has type complex128"),
    ((None, 1.0), "a has type object"),
    (([1, [2]], 1.0), "a has type object"),
]


def test_others_are_refused_by_name(loaded):
    for args, message in REFUSED:
        with one_line(message):
            loaded[0].matrix(*args)
