"""Overlaps of simplices and of components against an independent linear program."""

import jax
import numpy as np
import pytest
from scipy.optimize import linprog

from dln_jax.softbody.mesh.intersections import count_overlaps, simplices_overlap
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import beam, box


def depth_of_common_point(a, b):
    """Largest t with a point whose barycentric coordinates in both simplices are at least t; positive: they overlap."""
    corners, dimension = a.shape
    objective = np.append(np.zeros(2 * corners), -1.0)
    same_point = np.hstack([a.T, -b.T, np.zeros((dimension, 1))])
    sums = np.zeros((2, 2 * corners + 1))
    sums[0, :corners] = sums[1, corners:-1] = 1.0
    at_least = np.hstack([-np.eye(2 * corners), np.ones((2 * corners, 1))])
    solution = linprog(
        objective,
        A_ub=at_least,
        b_ub=np.zeros(2 * corners),
        A_eq=np.vstack([same_point, sums]),
        b_eq=np.append(np.zeros(dimension), [1.0, 1.0]),
        bounds=[(None, None)] * (2 * corners + 1),
    )
    return -solution.fun if solution.status == 0 else -np.inf


@pytest.mark.parametrize("dimension", [2, 3])
def test_simplices_overlap_as_a_linear_program_says(dimension):
    random = np.random.default_rng(dimension)
    pairs = random.normal(size=(60, 2, dimension + 1, dimension))
    pairs[:, 1] += 0.8 * random.normal(size=(60, 1, dimension))
    solution = jax.jit(jax.vmap(lambda pair: simplices_overlap(pair[0], pair[1])))(pairs)
    expected = np.array([depth_of_common_point(*pair) > 0 for pair in pairs])
    assert 10 < expected.sum() < 50
    np.testing.assert_array_equal(solution, expected)


def beside(shape, *offsets):
    """Copies of a mesh, each moved."""
    n = len(shape.vertices)
    vertices = np.concatenate([shape.vertices + np.asarray(offset) for offset in offsets])
    return make_mesh(vertices, np.concatenate([shape.elements + n * k for k in range(len(offsets))]))


CUBE = box((1.0, 1.0, 1.0), (2, 2, 2))


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        ((0.0, 0.0, 1.0), 0),  # They touch, all vertices shared.
        ((0.3, 0.2, 1.0), 0),
        ((0.0, 0.0, 1.0 - 1e-12), 0),
        ((0.0, 0.0, 0.99), 1),  # Aligned: no vertex of one lies inside the other.
        ((0.0, 0.0, 0.5), 1),
        ((0.4, 0.3, 0.2), 1),
        ((0.0, 0.0, 1.01), 0),
        ((1.0, 1.0, 1.0), 0),
    ],
)
def test_cubes_overlap_as_far_as_they_reach_into_each_other(offset, expected):
    mesh = beside(CUBE, (0.0, 0.0, 0.0), offset)
    count = jax.jit(count_overlaps(mesh))
    assert count(mesh.vertices) == expected
    # Far from the origin rounding is larger, and the answer the same.
    assert count(mesh.vertices + 100.0) == expected


def test_pairs_are_counted_and_thin_bodies_and_contained_ones_are_found():
    square = beam(1.0, 1.0, 6, 6)
    mesh = beside(square, (0.0, 0.0), (0.5, 0.1), (0.9, 0.9), (5.0, 0.0))
    assert jax.jit(count_overlaps(mesh))(mesh.vertices) == 3
    needle = make_mesh([[0.4, -1.0, 0.45], [0.41, -1.0, 0.45], [0.4, -1.0, 0.46], [0.4, 2.0, 0.45]], [[0, 1, 2, 3]])
    for small in (needle.vertices, 0.01 * needle.vertices + 0.3):
        vertices = np.concatenate([CUBE.vertices, small])
        both = make_mesh(vertices, np.concatenate([CUBE.elements, needle.elements + len(CUBE.vertices)]))
        assert jax.jit(count_overlaps(both))(both.vertices) == 1
    assert count_overlaps(CUBE) is None
