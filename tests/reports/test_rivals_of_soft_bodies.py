"""The reference that all simulators of soft bodies are compared with, and the part of the report that always runs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dln_jax.precision import in_float64
from dln_jax.softbody.mesh.mesh import vertices_where
from dln_jax.softbody.mesh.shapes import box
from scripts.reports.soft_bodies.body import (
    KIRCHHOFF,
    NEO_HOOKEAN,
    SMITH,
    Body,
    elastic_forces,
    motion,
    reference_motion,
    relative_error,
)
from scripts.reports.soft_bodies.rivals import cantilever, depth, hitting

MESH = box((0.4, 0.2, 0.2), (2, 1, 1))


@pytest.mark.parametrize("law", [NEO_HOOKEAN, KIRCHHOFF])
def test_explicit_reference_agrees_with_implicit_midpoint_steps(law):
    body = Body(MESH, vertices_where(MESH, lambda x: x[:, 0] == 0), 1e5, np.array([0.1, 0.2]), law=law)
    reference = reference_motion(body, 4e-4)
    coarse, fine = (
        relative_error(body, in_float64(lambda dt=dt: motion(body, "midpoint", dt))().x, reference)
        for dt in (0.01, 0.005)
    )
    assert fine < 5e-3
    assert coarse / fine == pytest.approx(4, rel=0.3)


def test_reference_of_a_fall_is_free_until_it_meets_the_floor():
    mesh = MESH._replace(vertices=MESH.vertices + np.array([0.0, 0.0, 0.1]))
    body = Body(mesh, np.zeros(0, int), 1e5, np.array([0.1, 0.2]), floor=True)
    x = reference_motion(body, 2e-4, 1e6)
    assert_allclose(x[0] - mesh.vertices, np.tile([0.0, 0.0, -0.5 * 9.81 * 0.1**2], (len(mesh.vertices), 1)), atol=1e-9)
    assert x[1][:, 2].min() > -1e-3


def test_laws_agree_at_small_strains():
    body = cantilever(1)
    x = body.mesh.vertices + 1e-6 * np.sin(7 * body.mesh.vertices[:, ::-1])
    forces = [elastic_forces(body._replace(law=law))(x) for law in (NEO_HOOKEAN, KIRCHHOFF, SMITH)]
    scale = np.abs(forces[0]).max()
    for other in forces[1:]:
        assert_allclose(other, forces[0], atol=1e-4 * scale)


def test_depth_of_blocks_that_overlap():
    body = hitting()
    assert depth(body.mesh, body.mesh.vertices) == 0
    upper = np.asarray(body.v)[:, 2] < 0
    lowered = body.mesh.vertices - np.where(upper[:, None], [0.0, 0.0, 0.016], 0.0)
    assert depth(body.mesh, lowered) == pytest.approx(0.01)
