"""QR and symmetric eigenvalues in C on hard matrices: large and small numbers, equal eigenvalues, graded rows."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from comparison import in_c
from jax import lax

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)
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
SYMMETRIC = {name: np.tril(matrix) + np.tril(matrix, -1).T for name, matrix in MATRICES.items()}
EPS = np.finfo(float).eps


def eigh(a):
    vectors, values = lax.linalg.eigh(a, symmetrize_input=False)
    return values, vectors


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    functions = {"eigh": (eigh, (np.eye(N),)), "qr": (jnp.linalg.qr, (np.eye(N),))}
    holes = [np.where(np.arange(N * N).reshape(N, N) == 30, value, np.eye(N)) for value in (np.nan, np.inf)]
    states = {
        "eigh": [(matrix,) for matrix in (*SYMMETRIC.values(), *(np.maximum(matrix, matrix.T) for matrix in holes))],
        "qr": [(matrix,) for matrix in (*MATRICES.values(), *holes)],
    }
    return in_c(functions, states, tmp_path_factory.mktemp("c"))


@pytest.mark.parametrize("place, name", list(enumerate(MATRICES)))
def test_eigenvectors_are_orthonormal_and_have_their_values(place, name, results):
    values, vectors = (result[place] for result in results["eigh"])
    size = max(np.abs(SYMMETRIC[name]).max(), np.finfo(float).tiny)
    a = SYMMETRIC[name] / size
    assert (np.diff(values) >= 0).all()
    assert np.abs(vectors.T @ vectors - np.eye(N)).max() < 20 * N * EPS
    assert np.abs(a @ vectors - vectors * (values / size)).max() < 20 * N * EPS
    np.testing.assert_allclose(values / size, np.linalg.eigvalsh(a), rtol=0, atol=20 * N * EPS)


@pytest.mark.parametrize("place, name", list(enumerate(MATRICES)))
def test_qr_is_orthonormal_times_upper_triangular(place, name, results):
    q, r = (result[place] for result in results["qr"])
    size = max(np.abs(MATRICES[name]).max(), np.finfo(float).tiny)
    assert (np.tril(r, -1) == 0).all()
    assert np.abs(q.T @ q - np.eye(N)).max() < 20 * N * EPS
    assert np.abs(q @ (r / size) - MATRICES[name] / size).max() < 20 * N * EPS


def test_numbers_that_are_not_finite_are_not_hidden(results):
    values, vectors = (result[len(MATRICES) :] for result in results["eigh"])
    assert np.isnan(values).all() and np.isnan(vectors).all()
    q, r = (result[len(MATRICES) :] for result in results["qr"])
    assert all(np.isnan(result).any() for result in (*q, *r))
