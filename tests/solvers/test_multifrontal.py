"""The sparse factorisation against SciPy's, and the elimination order against what is known of grids."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from dln_jax.solvers.elements.assembly import Pattern, pattern
from dln_jax.solvers.elements.dissection import bisect, dissect
from dln_jax.solvers.elements.energies import ElementEnergy
from dln_jax.solvers.elements.linear_solvers import sparse


def grid(*counts):
    """Pairs of neighbours in a grid of vertices."""
    numbers = np.arange(np.prod(counts)).reshape(counts)
    pairs = []
    for axis, count in enumerate(counts):
        pairs.append(np.stack([numbers.take(range(count - 1), axis), numbers.take(range(1, count), axis)], -1))
    return np.concatenate([pair.reshape(-1, 2) for pair in pairs])


def graph_of(pairs):
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return csr_array(coo_array((np.ones(len(both)), both.T), shape=(pairs.max() + 1,) * 2))


BODIES = {
    "one vertex": (np.zeros((1, 1), int), 3),
    "chain": (grid(300), 1),
    "plane": (grid(25, 12), 2),
    "tetrahedra": (Delaunay(np.random.default_rng(0).uniform(size=(150, 3))).simplices, 3),
    "two bodies": (np.concatenate([grid(7, 6, 5), 210 + grid(5, 5, 5)]), 3),
    "star": (np.stack([np.zeros(199, int), np.arange(1, 200)], axis=1), 2),
}


def system(name, lanes=1, held=0.1):
    """The body's pattern with some unknowns held, and entries of diagonally dominant matrices."""
    indices, width = BODIES[name]
    random = np.random.default_rng(1)
    n = int(indices.max()) + 1
    free = random.uniform(size=(n, width)) >= held
    free[0] = True
    at = pattern((ElementEnergy(lambda *_: jnp.zeros(()), indices),), n, width, free)
    values = random.normal(size=(lanes, len(at.rows)))
    on_diagonal = at.rows == at.columns
    for lane in values:
        sums = np.zeros(at.unknowns)
        np.add.at(sums, at.rows[~on_diagonal], np.abs(lane[~on_diagonal]))
        np.add.at(sums, at.columns[~on_diagonal], np.abs(lane[~on_diagonal]))
        lane[on_diagonal] = 0.1 + sums[at.rows[on_diagonal]]
    return at, values, random.normal(size=(lanes, n, width))


def solution(at: Pattern, values, b):
    solver = sparse((), at)
    return solver.solve(solver.factorise((), values), b)


@pytest.mark.parametrize("name", BODIES)
def test_solutions_are_those_of_scipy_and_zero_where_unknowns_are_held(name):
    at, (values,), (b,) = system(name)
    x = jax.jit(lambda values, b: solution(at, values, b))(values, b)
    lower = csr_array(coo_array((values, (at.rows, at.columns)), shape=(at.unknowns,) * 2))
    whole = lower + lower.T - csr_array(coo_array((lower.diagonal(), (np.arange(at.unknowns),) * 2)))
    free = np.flatnonzero(at.free)
    expected = np.zeros(at.unknowns)
    expected[free] = spsolve(whole[free][:, free].tocsc(), b.ravel()[free])
    np.testing.assert_allclose(np.ravel(x), expected, atol=1e-12 * np.abs(expected).max())


def test_single_precision_and_batches_of_matrices_right_hand_sides_or_both():
    at, values, b = system("plane", lanes=3)
    one = lambda values, b: solution(at, values, b)  # noqa: E731
    expected = np.stack([jax.jit(one)(*lane) for lane in zip(values, b, strict=True)])
    np.testing.assert_allclose(jax.jit(jax.vmap(one))(values, b), expected, atol=1e-13)
    shared = jax.jit(jax.vmap(one, (None, 0)))(values[1], np.stack([b[1], 2 * b[1]]))
    np.testing.assert_allclose(shared, [expected[1], 2 * expected[1]], atol=1e-13)
    single = jax.jit(one)(values[0].astype(np.float32), b[0].astype(np.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected[0], atol=1e-5 * np.abs(expected[0]).max())


@pytest.mark.parametrize("place", [0.0, 0.5, 1.0])
def test_a_matrix_that_is_not_definite_has_no_finite_solution(place):
    at, values, b = system("tetrahedra", lanes=2)
    on_diagonal = np.flatnonzero(at.rows == at.columns)
    values[1, on_diagonal[int(place * (len(on_diagonal) - 1))]] *= -1
    x = jax.jit(jax.vmap(lambda values, b: solution(at, values, b)))(values, b)
    assert np.isfinite(x[0]).all() and not np.isfinite(x[1]).all()


def test_the_separator_of_a_box_is_its_cross_section():
    left, right, separator = bisect(graph_of(grid(20, 6, 5)))
    assert len(separator) == 30 and min(len(left), len(right)) >= 0.3 * 600
    assert sorted(np.concatenate([left, right, separator])) == list(range(600))


@pytest.mark.parametrize("name", ["plane", "tetrahedra", "two bodies", "star"])
def test_boundaries_are_what_elimination_fills(name):
    """Elimination vertex by vertex on the graph itself, which knows of no fronts."""
    elements = BODIES[name][0]
    ends = itertools.combinations(range(elements.shape[1]), 2)
    pairs = np.concatenate([elements[:, list(pair)] for pair in ends])
    graph = graph_of(pairs)
    graph.data[:] = 1
    nodes = dissect(graph, leaf=8)
    near = [set(graph[[vertex]].indices.tolist()) for vertex in range(len(graph.indptr) - 1)]
    for node in nodes:
        for vertex in node.own:
            for other in near[vertex]:
                near[other] |= near[vertex] - {other}
                near[other].discard(vertex)
        left = set().union(*(near[vertex] for vertex in node.own)) - set(node.own)
        assert left == set(node.boundary)
    assert sorted(np.concatenate([node.own for node in nodes])) == list(range(len(graph.indptr) - 1))
