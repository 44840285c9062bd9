"""Bodies that are joined, moved and turned keep their volumes, sets and shape."""

import numpy as np
import pytest
from calls import one_line

from dln_jax.softbody.mesh.mesh import NamedSet, components, make_mesh, volumes
from dln_jax.softbody.mesh.placement import join, rotate, translate
from dln_jax.softbody.mesh.quadratic import quadratic
from dln_jax.softbody.mesh.sets import values_by_set, vertices_in
from dln_jax.softbody.mesh.shapes import beam, box

BODIES = {2: beam(0.4, 0.2, 2, 1), 3: box((0.4, 0.3, 0.2), (2, 1, 1))}
TURNS = {2: 0.7, 3: [0.3, -0.5, 0.4]}


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("order", [1, 2])
def test_bodies_are_joined_with_their_sets(dimension, order):
    body = BODIES[dimension] if order == 1 else quadratic(BODIES[dimension])
    body = body._replace(sets={"tip": NamedSet(np.array([1, 2]), np.array([0]))})
    offset = [1.0, 0.2, 0.3][:dimension]
    placed = translate(rotate(body, TURNS[dimension]), offset)
    mesh = join(body, pad=placed)
    n, m = len(body.vertices), len(body.elements)
    assert components(mesh).max() == 1 and mesh.elements.dtype == body.elements.dtype
    np.testing.assert_allclose(volumes(mesh), np.tile(volumes(body), 2), rtol=1e-12)
    np.testing.assert_allclose(placed.vertices.mean(axis=0), body.vertices.mean(axis=0) + offset, rtol=1e-12)
    assert vertices_in(mesh, ["tip"]).tolist() == [1, 2, n + 1, n + 2]
    assert vertices_in(mesh, ["pad"]).tolist() == list(range(n, 2 * n))
    assert values_by_set(mesh, 1.0, {"pad": 2.0}).tolist() == [1.0] * m + [2.0] * m
    if order == 1:  # the same as a mesh that was never two
        whole = make_mesh(
            np.concatenate([body.vertices, placed.vertices]), np.concatenate([body.elements, body.elements + n])
        )
        np.testing.assert_array_equal(mesh.vertices, whole.vertices)


def test_a_turn_is_counterclockwise_about_its_point():
    square = rotate(BODIES[2], np.pi / 2, about=[0.0, 0.0])
    np.testing.assert_allclose(square.vertices, BODIES[2].vertices @ [[0.0, 1.0], [-1.0, 0.0]], atol=1e-15)
    cube = rotate(BODIES[3], [0.0, 0.0, np.pi / 2], about=np.zeros(3))
    np.testing.assert_allclose(cube.vertices[:, :2], BODIES[3].vertices[:, :2] @ [[0.0, 1.0], [-1.0, 0.0]], atol=1e-15)


def test_bodies_that_cannot_be_joined_and_vectors_of_another_size_are_refused():
    for call, words in (
        (lambda: join(), "there is none"),
        (lambda: join(BODIES[2], BODIES[3]), "differ in dimension"),
        (lambda: join(BODIES[2], quadratic(BODIES[2])), "order of their elements"),
        (lambda: translate(BODIES[2], [1.0, 2.0, 3.0]), "expected 2 finite numbers"),
        (lambda: rotate(BODIES[3], 0.3), "expected 3 finite numbers"),
        (lambda: rotate(BODIES[2], np.nan), "expected 1 finite number in"),
    ):
        with one_line(words):
            call()
