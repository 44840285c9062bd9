"""Factorisations of many matrices at once: against NumPy, one by one, and without LAPACK's batched calls."""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import hilbert
from test_minimise import ARGUMENTS, hanging_chain

from dln_jax.solvers.elements.energies import lower_triangles, project
from dln_jax.solvers.elements.linear_solvers import block_tridiagonal, dense, matrix_free, sparse
from dln_jax.solvers.elements.symmetric_systems import places, solve_bands
from dln_jax.solvers.elimination import cholesky, solve, solve_lower, solve_lower_transposed, substitute

EPS = np.finfo(float).eps


def definite(size, condition, band, count=5):
    """Symmetric matrices of about a condition number, rescaled products of banded triangles."""
    random = np.random.default_rng(size)
    row, column = np.indices((size, size))
    lower = np.where((row - column <= band) & (row > column), random.normal(size=(count, size, size)) / (band + 1), 0)
    lower += np.eye(size)
    scale = condition ** -np.linspace(0, 0.5, size)
    return scale[:, None] * (lower @ lower.swapaxes(1, 2)) * scale


def of_bands(matrices, b, band):
    """x [count, n, k] by `solve_bands`."""
    size = matrices.shape[1]
    row, column = places(size, band)
    whole = np.broadcast_to(np.eye(row.max() + 1), (len(matrices), row.max() + 1, row.max() + 1)).copy()
    whole[:, :size, :size] = np.tril(matrices)
    whole = jnp.asarray(whole.transpose(1, 2, 0)[row, column], b.dtype)
    return np.asarray(jax.jit(solve_bands)(whole, jnp.asarray(b.transpose(1, 2, 0)))).transpose(2, 0, 1)


@pytest.mark.parametrize(
    ("matrices", "band", "precision"),
    [
        (definite(1, 1.0, 0), 0, np.float64),
        (definite(2, 1e3, 1), 1, np.float64),
        (definite(7, 1e14, 3), 3, np.float64),
        (definite(25, 10.0, 6), 6, np.float64),
        (hilbert(9)[None], 8, np.float64),
        (definite(9, 1e4, 3), 3, np.float32),
    ],
    ids=lambda of: str(getattr(of, "shape", of)),
)
def test_systems_with_bands_are_solved_backward_stably(matrices, band, precision):
    exact, size = matrices.astype(precision).astype(float), matrices.shape[1]
    b = np.random.default_rng(1).normal(size=(len(matrices), size, 2)).astype(precision)
    x = of_bands(exact, b, band)
    assert x.dtype == precision
    # |b - A x| <= c n eps |A| |x| says nothing of the condition: Higham 2002, theorem 10.4.
    sizes = np.linalg.norm(exact, 2, axis=(1, 2))[:, None, None] * np.linalg.norm(x, axis=1, keepdims=True)
    assert np.all(np.abs(exact @ x.astype(float) - b) <= 8 * size * np.finfo(precision).eps * sizes)


def test_only_the_system_that_is_not_definite_is_not_finite():
    matrices = np.concatenate([definite(12, 10.0, 3)] * 2)[:7]
    matrices[1, 4, 4] = -1.0
    matrices[3, 4, 4] = np.nan
    matrices[5] = np.kron(np.eye(6), np.ones((2, 2)))
    expected = [True, False] * 3 + [True]
    assert np.isfinite(of_bands(matrices, np.ones((7, 12, 1)), 3)).all(axis=(1, 2)).tolist() == expected
    nowhere = np.where(np.triu(np.ones((12, 12)), 1), np.nan, matrices)
    lower = np.asarray(jax.jit(jax.vmap(cholesky))(nowhere))
    assert np.isfinite(lower).all(axis=(1, 2)).tolist() == expected
    np.testing.assert_allclose(lower[0] @ lower[0].T, matrices[0], atol=12 * EPS * np.abs(matrices[0]).max())


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("right", [False, True])
def test_substitution_in_nested_batches(transposed, right):
    """Every way that the factor, the right-hand sides or both may be a batch, within a batch or not."""
    random = np.random.default_rng(0)
    factor, b = random.normal(size=(2, 3, 5, 5)) + 6 * np.eye(5), random.normal(size=(2, 3, 5, 2))
    b = b.swapaxes(2, 3) if right else b
    inverse = np.linalg.inv(np.tril(factor).swapaxes(2, 3) if transposed else np.tril(factor))

    @jax.jit
    def solutions(factor, inverse, b):
        pairs = []
        for outer, inner in itertools.product([(0, 0), (None, 0), (0, None)], repeat=2):

            def mapped(function, matrix, outer=outer, inner=inner):
                of = [
                    array[tuple(slice(None) if axis == 0 else 0 for axis in axes)]
                    for array, *axes in zip((matrix, b), outer, inner, strict=True)
                ]
                return jax.vmap(jax.vmap(function, inner), outer)(*of)

            ours = mapped(lambda factor, b: substitute(factor, b, transposed=transposed, right=right), factor)
            pairs.append((ours, mapped(lambda inverse, b: b @ inverse if right else inverse @ b, inverse)))
        return pairs

    for x, expected in solutions(factor, inverse, b):
        np.testing.assert_allclose(x, expected, rtol=1e-10, atol=1e-13)


def test_projection_of_elements_of_several_sizes():
    """Against NumPy; the shift is relative to the largest diagonal entry of all, and NaN ends nowhere."""
    random = np.random.default_rng(2)
    wholes = [random.normal(size=(count, size, size)) for count, size in ((3, 2), (5, 6), (2, 12))]
    wholes = [matrices + matrices.swapaxes(1, 2) for matrices in wholes]
    projected = jax.jit(project)(tuple(lower_triangles(jnp.asarray(matrices)) for matrices in wholes), 1e-3)
    largest = max(np.diagonal(matrices, axis1=1, axis2=2).max() for matrices in wholes)
    for matrices, lower in zip(wholes, projected, strict=True):
        values, vectors = np.linalg.eigh(matrices)
        raised = vectors * (np.maximum(values, 0) + 1e-3 * largest)[:, None] @ vectors.swapaxes(1, 2)
        np.testing.assert_allclose(lower, lower_triangles(jnp.asarray(raised)), atol=1e-12)
    assert np.isfinite(jax.jit(project)((jnp.full((3, 4), jnp.nan),), 1e-3)[0]).all()


@pytest.mark.parametrize("size", [5, 17])
def test_general_and_triangular_systems_in_batches_and_their_derivatives(size):
    """On both sides of the size where the written-out form ends; only the lower triangle is read."""
    random = np.random.default_rng(size)
    matrices, b = random.normal(size=(3, size, size)) + 4 * np.eye(size), random.normal(size=(3, size))
    triangles = np.linalg.inv(np.tril(matrices))
    for function, inverse in (
        (solve, np.linalg.inv(matrices)),
        (solve_lower, triangles),
        (solve_lower_transposed, triangles.swapaxes(1, 2)),
    ):

        @jax.jit
        @jax.vmap
        def both(matrix, b, function=function):
            return function(matrix, b), jax.grad(lambda *arguments: function(*arguments).sum())(matrix, b)

        (solution, slopes), x = both(matrices, b), (inverse @ b[..., None])[..., 0]
        np.testing.assert_allclose(solution, x, rtol=1e-8, atol=1e-11)
        # d(uᵀ x) = -(A⁻ᵀ u) xᵀ dA, of the lower triangle where only that is read.
        outer = inverse.sum(axis=1)[:, :, None] * x[:, None]
        outer = outer.swapaxes(1, 2) if function is solve_lower_transposed else outer
        np.testing.assert_allclose(slopes, -(outer if function is solve else np.tril(outer)), rtol=1e-6, atol=1e-9)
    assert not jnp.isfinite(solve_lower(jnp.zeros((size, size)), jnp.ones(size))).all()


def sag(stiffness, length, way):
    return hanging_chain(stiffness, length, ARGUMENTS[2:], way, tolerance=1e-10)[0][:, 1].mean()


# The second chain is compressed as it starts, so that its Hessian is indefinite there.
CHAINS = (jnp.array([30.0, 50.0, 3.0, 40.0]), jnp.array([0.08, 0.12, 0.09, 0.085]))


@pytest.mark.parametrize("way", [dense, block_tridiagonal, sparse])
def test_minima_and_their_derivatives_in_batches(way):
    every = jax.value_and_grad(lambda *chain: sag(*chain, way), (0, 1))
    together, alone = jax.jit(jax.vmap(every))(*CHAINS), jax.jit(every)
    for lane in range(4):
        expected = alone(*(numbers[lane] for numbers in CHAINS))
        for left, right in zip(jax.tree.leaves(together), jax.tree.leaves(expected), strict=True):
            assert jnp.isfinite(right)
            np.testing.assert_allclose(left[lane], right, rtol=1e-7, atol=1e-12)


# The first result of a call to LAPACK, and whether its factors are a batch.
CALL = re.compile(r"custom_call @lapack_\w+\(.*-> \(?tensor<((?:\d+x)+)f")


def lapack_calls(function, *arguments):
    text = jax.jit(function).lower(*arguments).as_text()
    return [call.group(1) for call in map(CALL.search, text.splitlines()) if call]


@pytest.mark.parametrize("way", [dense, block_tridiagonal, sparse, matrix_free])
def test_no_batch_is_given_to_lapack(way):
    """Threads of several devices would wait for each other in it."""
    calls = lapack_calls(jax.vmap(lambda length: sag(50.0, length, way)), np.linspace(0.1, 0.2, 4))
    assert calls and all(shape.count("x") <= 2 for shape in calls), calls
    # A batch that is given to it would be seen.
    assert lapack_calls(jnp.linalg.cholesky, np.ones((3, 4, 4))) == ["3x4x4x"]


def test_elsewhere_a_batch_is_one_call():
    mapped = jax.jit(jax.vmap(cholesky)).trace(jnp.ones((3, 40, 40)))
    text = mapped.lower(lowering_platforms=("cuda",)).as_text()
    assert "cusolver" in text and "stablehlo.while" not in text
