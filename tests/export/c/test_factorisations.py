"""QR and symmetric eigenvalues in C on hard matrices: large and small numbers, equal eigenvalues, graded rows."""

import jax.numpy as jnp
import numpy as np
from comparison import in_c
from compilers import needs_compiler
from jax import lax

N = 6
RANDOM = np.random.default_rng(8)
BASIS = np.linalg.qr(RANDOM.normal(size=(N, N)))[0]
GRADES = 10.0 ** -np.arange(0, 18, 3)
MATRICES = {
    "zero": np.zeros((N, N)),
    "identity": np.eye(N),
    "ones": np.ones((N, N)),
    "Hilbert": 1 / (1 + np.add.outer(np.arange(N), np.arange(N))),
    "two clusters": BASIS @ np.diag([1, 1, 1, 2, 2, 2 + 1e-14]) @ BASIS.T,
    "graded": RANDOM.normal(size=(N, N)) * np.sqrt(np.outer(GRADES, GRADES)),
    "large": 1e200 * RANDOM.normal(size=(N, N)),
    "small": 1e-200 * RANDOM.normal(size=(N, N)),
    "far apart": np.diag([1e150, 1e-150, 1, -1, 1e-300, 0]) + 1e-160,
    "nearly diagonal": np.diag(np.arange(N)) + 1e-13 * RANDOM.normal(size=(N, N)),
    "exchange": np.eye(N)[::-1],
}


def eigh(a):
    vectors, values = lax.linalg.eigh(a, symmetrize_input=False)
    return values, vectors


HOLES = [np.where(np.arange(N * N).reshape(N, N) == 30, value, np.eye(N)) for value in (np.nan, np.inf)]
BOUND = 20 * N * np.finfo(float).eps


@needs_compiler
def test_factors_are_orthonormal_and_give_the_matrix_and_nothing_hides_what_is_not_finite(tmp_path):
    symmetric = [np.tril(matrix) + np.tril(matrix, -1).T for matrix in MATRICES.values()]
    functions = {"eigh": (eigh, (np.eye(N),)), "qr": (jnp.linalg.qr, (np.eye(N),))}
    states = {
        "eigh": [(matrix,) for matrix in (*symmetric, *(np.maximum(matrix, matrix.T) for matrix in HOLES))],
        "qr": [(matrix,) for matrix in (*MATRICES.values(), *HOLES)],
    }
    results = in_c(functions, states, tmp_path)
    for name, matrix, values, vectors in zip(MATRICES, symmetric, *results["eigh"], strict=False):
        size = max(np.abs(matrix).max(), np.finfo(float).tiny)
        assert (np.diff(values) >= 0).all(), name
        assert np.abs(vectors.T @ vectors - np.eye(N)).max() < BOUND, name
        assert np.abs(matrix / size @ vectors - vectors * (values / size)).max() < BOUND, name
        np.testing.assert_allclose(values / size, np.linalg.eigvalsh(matrix / size), rtol=0, atol=BOUND, err_msg=name)
    for name, q, r in zip(MATRICES, *results["qr"], strict=False):
        size = max(np.abs(MATRICES[name]).max(), np.finfo(float).tiny)
        assert (np.tril(r, -1) == 0).all(), name
        assert np.abs(q.T @ q - np.eye(N)).max() < BOUND, name
        assert np.abs(q @ (r / size) - MATRICES[name] / size).max() < BOUND, name
    assert all(np.isnan(result[-2:]).all() for result in results["eigh"])
    assert all(np.isnan(result).any() for of_all in results["qr"] for result in of_all[-2:])
