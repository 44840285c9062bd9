"""The ground of creatures: bumps, friction along both horizontal axes, and flat ground that computes no bumps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_soft_energies import make_context, total

from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import body_length, box_quadruped
from dln_jax.softbody.terms.creature import Bumps, creature_terms, ground_height

TETRAHEDRON = make_mesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])
BUMPS = Bumps(jnp.asarray([0.1, 0.05]), jnp.asarray([[3.0, 1.0], [-2.0, 4.0]]), jnp.asarray([0.3, 1.2]))


def ground(bumps=None):
    return creature_terms(TETRAHEDRON, [[0, 1]], bumps=bumps)[-1]


@pytest.mark.parametrize("bumps", [None, BUMPS])
def test_ground_pushes_up_and_brakes_in_both_directions(bumps):
    random = np.random.default_rng(0)
    start = 0.1 * random.normal(size=(4, 3))
    x = start + 0.02 * random.normal(size=(4, 3))
    term, h = ground(bumps), 0.033
    context = make_context(TETRAHEDRON.vertices, start, None, h)
    expected = 0.0
    for (x0, y0, z0), (x1, y1, z1) in zip(start, x, strict=True):
        waves = [] if bumps is None else zip(*map(np.asarray, bumps), strict=True)
        surface = [0.0, 0.0]
        for amplitude, (kx, ky), phase in waves:
            surface[0] += amplitude * np.sin(kx * x0 + ky * y0 + phase)
            surface[1] += amplitude * np.sin(kx * x1 + ky * y1 + phase)
        expected += 14000 * min(z1 - surface[1], 0) ** 2
        expected += 300 * max(0.01 - z0 + surface[0], 0) * ((x1 - x0) ** 2 + (y1 - y0) ** 2) / h**2
    assert float(total(term, term.parameters, context, jnp.asarray(x))) == pytest.approx(expected, rel=1e-12)


def test_bumps_without_height_are_flat_ground_and_flat_ground_has_no_sine():
    x = jnp.asarray(np.random.default_rng(1).normal(size=(4, 3)))
    context = make_context(TETRAHEDRON.vertices, x, None, 0.033)

    def energy(term):
        return total(term, term.parameters, context, x)

    level = ground(BUMPS._replace(amplitude=jnp.zeros(2)))
    assert float(energy(level)) == pytest.approx(float(energy(ground())), rel=1e-14)
    assert "sin" in str(jax.make_jaxpr(lambda: energy(level))())
    assert " sin" not in str(jax.make_jaxpr(lambda: energy(ground()))())


def test_height_is_the_sum_of_the_waves():
    assert float(ground_height(BUMPS, [jnp.asarray(0.2), jnp.asarray(-0.4)])) == pytest.approx(
        0.1 * np.sin(0.6 - 0.4 + 0.3) + 0.05 * np.sin(-0.4 - 1.6 + 1.2)
    )


def test_box_quadruped_stands_on_four_legs():
    creature = box_quadruped()
    mesh, muscles = creature.mesh, creature.muscles
    assert mesh.vertices.shape == (56, 3) and muscles.shape == (48, 2)
    assert (mesh.vertices[:, 2] == 0).sum() == 16 and body_length(creature) == pytest.approx(1.6)
    np.testing.assert_allclose(np.linalg.norm(np.diff(mesh.vertices[muscles], axis=1), axis=2), 0.4)
