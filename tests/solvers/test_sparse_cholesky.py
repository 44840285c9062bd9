"""The sparse factorisation against SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from dln_jax.solvers.elements.assembly import Pattern, pattern
from dln_jax.solvers.elements.energies import ElementEnergy
from dln_jax.solvers.elements.linear_solvers import sparse


def grid(*counts):
    """Pairs of neighbours in a grid of vertices."""
    numbers = np.arange(np.prod(counts)).reshape(counts)
    pairs = []
    for axis, count in enumerate(counts):
        pairs.append(np.stack([numbers.take(range(count - 1), axis), numbers.take(range(1, count), axis)], -1))
    return np.concatenate([pair.reshape(-1, 2) for pair in pairs])


BODIES = {
    "one vertex": (np.zeros((1, 1), int), 3),
    "chain": (grid(300), 1),
    "plane": (grid(25, 12), 2),
    "tetrahedra": (Delaunay(np.random.default_rng(0).uniform(size=(150, 3))).simplices, 3),
    "two bodies": (np.concatenate([grid(4, 4, 3), 48 + grid(3, 3, 3)]), 3),
    "star": (np.stack([np.zeros(199, int), np.arange(1, 200)], axis=1), 2),
}


def system(name, lanes=1):
    """The body's pattern with a tenth of the unknowns held, and entries of diagonally dominant matrices."""
    indices, width = BODIES[name]
    random = np.random.default_rng(1)
    n = int(indices.max()) + 1
    free = random.uniform(size=(n, width)) >= 0.1
    free[0] = True
    at = pattern((ElementEnergy(lambda *_: jnp.zeros(()), indices),), n, width, free)
    values = random.normal(size=(lanes, len(at.rows)))
    on_diagonal = at.rows == at.columns
    for lane in values:
        lane[on_diagonal] = 0.0
        whole = whole_matrix(at, np.abs(lane))
        lane[on_diagonal] = 0.1 + whole.sum(axis=1)[at.rows[on_diagonal]]
    return at, values, random.normal(size=(lanes, n, width))


def whole_matrix(at, values):
    lower = csr_array(coo_array((values, (at.rows, at.columns)), shape=(at.unknowns,) * 2))
    return lower + lower.T - diags_array(lower.diagonal())


def solution(at: Pattern, values, b):
    solver = sparse((), at)
    return solver.solve(solver.factorise((), values), b)


@pytest.mark.parametrize("name", BODIES)
def test_solutions_are_those_of_scipy_and_zero_where_unknowns_are_held(name):
    at, (values,), (b,) = system(name)
    x = jax.jit(lambda values, b: solution(at, values, b))(values, b)
    whole = csr_array(whole_matrix(at, values))
    free = np.flatnonzero(at.free)
    expected = np.zeros(at.unknowns)
    expected[free] = spsolve(whole[free][:, free].tocsc(), b.ravel()[free])
    np.testing.assert_allclose(np.ravel(x), expected, atol=1e-12 * np.abs(expected).max())


def test_single_precision_and_batches():
    at, values, b = system("plane", lanes=3)
    one = lambda values, b: solution(at, values, b)  # noqa: E731
    expected = np.stack([jax.jit(one)(*lane) for lane in zip(values, b, strict=True)])
    np.testing.assert_allclose(jax.jit(jax.vmap(one))(values, b), expected, atol=1e-13)
    single = jax.jit(one)(values[0].astype(np.float32), b[0].astype(np.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected[0], atol=1e-5 * np.abs(expected[0]).max())


def test_a_matrix_that_is_not_definite_has_no_finite_solution():
    at, values, b = system("tetrahedra", lanes=4)
    on_diagonal = np.flatnonzero(at.rows == at.columns)
    for lane, place in enumerate((0, len(on_diagonal) // 2, -1)):
        values[lane, on_diagonal[place]] *= -1
    x = jax.jit(jax.vmap(lambda values, b: solution(at, values, b)))(values, b)
    assert np.isfinite(x).all(axis=(1, 2)).tolist() == [False, False, False, True]
