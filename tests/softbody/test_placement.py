"""Bodies that are joined, moved and turned keep their volumes and sets."""

import numpy as np
import pytest
from calls import one_line

from dln_jax.softbody.mesh.mesh import NamedSet, components, values_by_set, vertices_in, volumes
from dln_jax.softbody.mesh.shapes import beam, box, join, quadratic, rotate, translate

BODIES = beam(0.4, 0.2, 2, 1), quadratic(box((0.4, 0.3, 0.2), (2, 1, 1)))


@pytest.mark.parametrize("body", BODIES)
def test_bodies_are_joined_with_their_sets(body):
    body = body._replace(sets={"tip": NamedSet(np.array([1, 2]), np.array([0]))})
    turn, offset = (np.pi / 2 * np.eye(3)[2], [1.0, 0.2, 0.3]) if body.dimension == 3 else (np.pi / 2, [1.0, 0.2])
    placed = translate(rotate(body, turn), offset)
    mesh, n = join(body, pad=placed), len(body.vertices)
    assert components(mesh).max() == 1
    np.testing.assert_allclose(volumes(mesh), np.tile(volumes(body), 2), rtol=1e-12)
    ours, theirs = (of.vertices[:, :2] - of.vertices[:, :2].mean(axis=0) for of in (placed, body))
    np.testing.assert_allclose(ours, theirs @ [[0.0, 1.0], [-1.0, 0.0]], atol=1e-15)
    assert vertices_in(mesh, ["tip"]).tolist() == [1, 2, n + 1, n + 2]
    assert values_by_set(mesh, 1.0, {"pad": 2.0}).mean() == 1.5


def test_what_cannot_be_joined_or_moved_is_refused():
    with one_line("differ in dimension"):
        join(*BODIES)
    with one_line(r"expected .2,"):
        translate(BODIES[0], 1.0)
