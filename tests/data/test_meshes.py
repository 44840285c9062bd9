"""Meshes against geometry and topology, nonsense against its messages, and creatures against their drawings."""

import itertools

import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull, Delaunay

from dln_jax.softbody.mesh.mesh import (
    boundary,
    components,
    lumped_masses,
    make_mesh,
    overlaps,
    vertices_where,
    volumes,
)
from dln_jax.softbody.mesh.shapes import beam, biped, body_length, box, crawler, disc, lattice, quadruped
from dln_jax.softbody.mesh.simplices import facets, regularity, simplex_volumes

BEAM = beam(4.0, 1.0, 8, 3)
# A ring of cells: a hole, which has a boundary of its own.
RING = make_mesh(*lattice([(x, y) for x in range(3) for y in range(3) if (x, y) != (1, 1)]))
# Mesh, volume, size of the boundary, centre.
SHAPES = {
    "beam": (BEAM, 4.0, 10.0, (2.0, 0.5)),
    "box": (box((4.0, 1.0, 2.0), (5, 2, 3)), 8.0, 28.0, (2.0, 0.5, 1.0)),
    "disc": (disc(3.0, 5), 15 * 9.0 * np.sin(np.pi / 15), 180.0 * np.sin(np.pi / 30), (0.0, 0.0)),
    "ring": (RING, 8.0, 16.0, (1.5, 1.5)),
}


def outward_normals(vertices, facet):
    """Normal of each facet times its length or area."""
    first, *others = vertices[facet].swapaxes(0, 1)
    one, *other = (corner - first for corner in others)
    return np.cross(one, *other) / 2 if other else one[:, ::-1] * [1, -1]


def flux(vertices, facet):
    """Returns the flux of the field x through facets: dim times the enclosed volume if all point outwards."""
    return np.sum(outward_normals(vertices, facet) * vertices[facet].mean(axis=1))


def edges(mesh):
    pairs = list(itertools.combinations(range(mesh.dimension + 1), 2))
    return np.unique(np.sort(mesh.elements[:, pairs].reshape(-1, 2), axis=1), axis=0)


def euler_characteristic(mesh):
    faces = len(np.unique(np.sort(facets(mesh.elements).reshape(-1, mesh.dimension), axis=1), axis=0))
    inside = faces - len(mesh.elements) if mesh.dimension == 3 else len(mesh.elements)
    return len(mesh.vertices) - len(edges(mesh)) + inside


def mirrored(mesh, axis):
    """For each vertex, its mirror image about the middle; fails where there is none."""
    image = mesh.vertices.copy()
    image[:, axis] = image[:, axis].min() + image[:, axis].max() - image[:, axis]
    distance = np.linalg.norm(image[:, None] - mesh.vertices[None], axis=2)
    assert distance.min(axis=1).max() < 1e-12
    return distance.argmin(axis=1)


def same_simplices(one, other):
    return {frozenset(row) for row in one.tolist()} == {frozenset(row) for row in other.tolist()}


def test_volume_boundary_and_centre():
    for shape, (mesh, volume, surface, centre) in SHAPES.items():
        assert volumes(mesh).min() > 0
        assert_allclose(volumes(mesh).sum(), volume, rtol=1e-13)
        normals = outward_normals(mesh.vertices, boundary(mesh))
        # Conforming: a facet that is not shared would lie inside and add to the surface.
        assert_allclose(np.linalg.norm(normals, axis=1).sum(), surface, rtol=1e-13)
        assert_allclose(normals.sum(axis=0), 0.0, atol=1e-13 * surface)
        assert_allclose(flux(mesh.vertices, boundary(mesh)), mesh.dimension * volume, rtol=1e-13)
        # Equal shares reproduce the first moment of each simplex.
        masses = lumped_masses(mesh, 700.0)
        assert_allclose(masses @ mesh.vertices, 700.0 * volume * np.array(centre), atol=1e-10 * volume)
        assert masses.min() > 0
        assert shape != "disc" or regularity(mesh.vertices, mesh.elements).min() > 0.6
        assert euler_characteristic(mesh) == (0 if shape == "ring" else 1)


def test_vertices_of_a_beam_are_numbered_along_its_short_side():
    mesh = beam(4.0, 1.0, 40, 10)
    inside = ((mesh.vertices > 0) & (mesh.vertices < [4.0, 1.0])).all(axis=1)
    assert_array_equal(np.unique(boundary(mesh)), np.flatnonzero(~inside))
    assert (len(mesh.vertices), len(mesh.elements)) == (451, 800)
    assert np.ptp(mesh.elements, axis=1).max() == 12  # a narrow band
    assert_array_equal(vertices_where(mesh, lambda x: x[:, 0] < 1e-9), np.arange(11))
    assert mesh.elements.dtype == np.int32 and mesh.vertices.dtype == np.float64


def test_no_direction_is_preferred():
    """Even numbers of cells: a mirror image of itself, so that straight loads do not bend or twist it."""
    for mesh in (beam(4.0, 1.0, 6, 2), box((3.0, 1.0, 1.0), (4, 2, 2))):
        for axis in range(mesh.dimension):
            assert same_simplices(mirrored(mesh, axis)[mesh.elements], mesh.elements)


def test_regularity_is_one_for_regular_simplices_of_any_size():
    for vertices in ([[0.0, 0.0], [2.0, 0.0], [1.0, 3**0.5]], [[0.0, 0, 0], [1, 1, 0], [0, 1, 1], [1, 0, 1]]):
        corners = list(range(len(vertices)))
        elements = np.array([corners, [1, 0, *corners[2:]], [0, *corners[1:-1], 0]])
        for scale in (1e-150, 1e150):
            found = regularity(scale * np.array(vertices), elements)
            assert_allclose(found, [1.0, -1.0, 0.0], atol=1e-12)


SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
HALVES = [[0, 1, 2], [0, 2, 3]]
# A face in the plane z = 0, with 3 and 5 above it and 4 below.
BIPYRAMID = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 1], [0.2, 0.2, -1], [0.3, 0.3, 2]]
UP, DOWN = [0, 1, 2, 3], [0, 2, 1, 4]
LOOSE = box((1.0, 1.0, 1.0), (3, 3, 3))
NONSENSE = (
    ([*SQUARE[:3], [0.0, np.nan]], HALVES, r"vertex 3 is at \[0.0, nan\]; expected finite"),
    (np.array(SQUARE) + 0j, HALVES, "vertices has type complex128; expected real"),
    (np.zeros((3, 4)), HALVES, r"vertices has shape \[3, 4\]; expected \[n, 2\]"),
    ([[0.0, 0.0], [1.0]], HALVES, "vertices is not an array: its rows differ in length"),
    (SQUARE, np.array(HALVES, float), "elements has type float64; expected integers"),
    (BIPYRAMID, HALVES, r"elements has shape \[2, 3\]; expected \[m, 4\] .* each tetrahedron"),
    (SQUARE, np.zeros((0, 3), int), r"elements has shape \[0, 3\]; expected \[m, 3\] with m >= 1"),
    (SQUARE, [[0, 1, 2], [0, 2, 4]], "element 1 has corner 4, but there are 4 vertices"),
    (SQUARE, [[0, 1, 2], [0, 2, 2**32 + 3]], "element 1 has corner 4294967299"),  # which wraps to 3 in 32 bits
    (SQUARE, [[0, 1, -2], [0, 2, 3]], "element 0 has corner -2, .*expected 0 to 3"),
    (SQUARE, [[0, 1, 2], [0, 3, 3]], r"element 1 has corner 3 twice: \[0, 3, 3\]"),
    (SQUARE, [*HALVES, [0, 2, 1]], "element 2 is a duplicate of element 0"),
    ([*SQUARE, [1.5, -0.4e-12]], [*HALVES, [0, 4, 1]], "element 2 is degenerate: the area of triangle"),
    ([*BIPYRAMID[:4], [1.0, 1.0, 0.0]], [UP, [0, 1, 2, 4]], "element 1 is degenerate: the volume"),
    ([*SQUARE, [2.0, 2.0], [3.0, 3.0]], HALVES, r"vertex 4 is dangling: .* no element.*\(1 more like it\)"),
    (
        LOOSE.vertices[LOOSE.elements].reshape(-1, 3),  # vertices that were never merged
        np.arange(LOOSE.elements.size).reshape(-1, 4),
        "no two of the 135 elements share a vertex.*540 vertices have 64 distinct",
    ),
)


def test_nonsense_is_named():
    for vertices, elements, message in NONSENSE:
        with one_line(message):
            make_mesh(vertices, elements)


def test_what_is_left_when_the_nonsense_is_removed():
    assert make_mesh(1e-9 * np.array(SQUARE), np.array(HALVES, np.uint8)).vertices.dtype == np.float64
    make_mesh([*SQUARE, [1.5, -4e-12]], [*HALVES, [0, 4, 1]])  # flat, but just above rounding
    # Shared vertices connect elements; bodies that are apart are bodies.
    corners = np.array([[0, 0], [1, 0], [0, 1]])
    apart = make_mesh(np.vstack([corners, corners + 5]), [[0, 1, 2], [3, 4, 5]])
    hinged = make_mesh(np.vstack([corners, -corners[1:]]), [[0, 1, 2], [0, 3, 4]])
    assert components(apart).tolist() == [0, 1] and components(hinged).tolist() == [0, 0]


def test_inverted_elements_are_turned_and_counted():
    """Delaunay meshes of scipy, whose orientations are drawn."""
    for dimension in (2, 3):
        random = np.random.default_rng(dimension)
        points = random.uniform(-1.0, 1.0, (60, dimension))
        elements = random.permuted(Delaunay(points).simplices, axis=1)
        mesh = make_mesh(points, elements)
        assert mesh.turned == (simplex_volumes(points, elements) < 0).sum()
        assert 0.25 < mesh.turned / len(elements) < 0.75
        assert volumes(mesh).min() > 0 and make_mesh(points, mesh.elements).turned == 0
        assert_array_equal(np.sort(mesh.elements, axis=1), np.sort(elements, axis=1))
        hull = ConvexHull(points)
        assert same_simplices(boundary(mesh), hull.simplices) and len(overlaps(mesh)) == 0
        assert_allclose(flux(points, boundary(mesh)), dimension * hull.volume, rtol=1e-12)


def test_overlapping_elements_are_accepted_and_named():
    # Vertices, elements, the facet they have in common, and whether all lie on one side of it.
    for vertices, elements, facet, one_sided in (
        ([*SQUARE, [0.2, 0.5]], [*HALVES, [0, 2, 4]], {0, 2}, False),
        (BIPYRAMID, [UP, DOWN, [0, 1, 2, 5]], {0, 1, 2}, False),
        ([*BIPYRAMID[:4], BIPYRAMID[5]], [UP, [1, 2, 0, 4]], {0, 1, 2}, True),
    ):
        mesh = make_mesh(vertices, elements)
        assert [set(row) for row in overlaps(mesh).tolist()] == [facet]
        # Facets covered on both sides are inside; facets covered on one side, however often, are outside.
        skin = [frozenset(row) for row in boundary(mesh).tolist()]
        assert len(set(skin)) == len(skin) == len(elements) * mesh.dimension + one_sided
        assert (facet in skin) == one_sided


def test_arguments_that_make_no_sense_are_named():
    for call, message in (
        (lambda: beam(0.0, 1.0, 2, 2), "length along x is 0.0; expected a positive"),
        (lambda: beam(1.0, 1.0, 2, 0), "number of cells along y is 0"),
        (lambda: box((1.0, 1.0, np.inf), (1, 1, 1)), "length along z is inf; expected a finite"),
        (lambda: disc(1.0, 0), "rings is 0"),
        (lambda: lumped_masses(BEAM, -1.0), "density is -1.0; expected a positive"),
        (lambda: lumped_masses(BEAM, [1.0] * 7 + [np.nan] + [1.0] * 40), "density of element 7 is nan"),
        (lambda: vertices_where(BEAM, lambda x: x[:, 0] > 5), r"no vertex .* \[4.0, 1.0\] m"),
        (lambda: vertices_where(BEAM, lambda x: x > 0), r"bool of shape \[36, 2\]"),
    ):
        with one_line(message):
            call()


def test_creatures_are_symmetric_bodies_with_muscles_on_either_side_of_each_leg():
    for creature, legs, length in ((crawler(), 4, 2.88), (biped(), 2, 1.6), (quadruped(), 4, 3.2)):
        mesh, pairs = creature.mesh, creature.muscles
        assert mesh.vertices[:, 1].min() == 0.0 and body_length(creature) == pytest.approx(length)
        assert regularity(mesh.vertices, mesh.elements).min() > 0.5
        assert euler_characteristic(mesh) == 1  # in one piece, without holes
        # Distinct pairs that are edges of the mesh, none on the ground, ordered along the body.
        distinct = {tuple(sorted(pair)) for pair in pairs.tolist()}
        assert len(distinct) == len(pairs) and distinct <= {*map(tuple, edges(mesh).tolist())}
        middles = mesh.vertices[pairs].mean(axis=1)
        assert (middles[:, 1] > 0).all() and (np.diff(middles[:, 0]) > -1e-12).all()
        # Symmetric about the vertical axis: neither direction is easier.
        image = mirrored(mesh, 0)
        assert same_simplices(image[mesh.elements], mesh.elements) and same_simplices(image[pairs], pairs)
        # Each sole is the end of a leg with a muscle on either side.
        skin = boundary(mesh)
        soles = skin[(mesh.vertices[skin, 1] == 0).all(axis=1)]
        corners, used = np.unique([*soles.flat, *pairs.flat], return_counts=True)
        assert len(soles) == legs and (used[np.isin(corners, soles)] == 2).all()
