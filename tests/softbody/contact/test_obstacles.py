"""Rigid obstacles: their distances, and bodies that rest on them or hit them fast."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody import make_scene, make_step
from dln_jax.softbody.contact import box, capsule, half_space, heightfield, obstacle_contact, sphere
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.types import InputError

OBSTACLES = {
    "half-space": half_space([1.0, 2.0, 2.0], 0.3),
    "sphere": sphere([0.1, 0.2, -0.1], 0.4),
    "capsule": capsule([0.0, 0.0, 0.0], [1.0, 0.5, 0.0], 0.2),
    "box": box([0.1, 0.0, 0.2], [0.5, 0.3, 0.2]),
    "heightfield": heightfield(0.3 * np.random.default_rng(0).uniform(size=(6, 7)), [-1.0, -1.0], 0.4),
}


@pytest.mark.parametrize("name", OBSTACLES)
def test_a_distance_never_grows_faster_than_the_way(name):
    # The bound of the steps rests on it: no vertex may be nearer than the distance says.
    distance, shape = OBSTACLES[name]
    x = jnp.asarray(np.random.default_rng(1).uniform(-1.2, 1.2, (500, 3)))
    slopes = jax.vmap(jax.grad(distance), (0, None))(x, shape)
    assert jnp.linalg.norm(slopes, axis=1).max() <= 1 + 1e-12


@pytest.mark.parametrize("name", ["half-space", "sphere", "capsule", "box"])
def test_a_point_moved_by_the_distance_along_the_slope_is_on_the_surface(name):
    distance, shape = OBSTACLES[name]
    x = jnp.asarray(np.random.default_rng(2).uniform(-2.0, 2.0, (500, 3)))
    d, slope = jax.vmap(jax.value_and_grad(distance), (0, None))(x, shape)
    outside = d > 0
    assert outside.sum() > 100
    np.testing.assert_allclose(jax.vmap(distance, (0, None))(x - d[:, None] * slope, shape)[outside], 0, atol=1e-12)


@pytest.fixture(scope="module")
def falling():
    """A block above a ground with a coefficient of friction, and its step."""
    mesh = beam(0.4, 0.2, 2, 1)
    mesh = mesh._replace(vertices=mesh.vertices + np.array([0.0, 0.05]))
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=1e6, poisson_ratio=0.3), gravity(mesh)]
    ground = obstacle_contact(mesh, half_space([0.0, 1.0]), distance=0.01, stiffness=1e5, friction=0.5, name="ground")
    scene = make_scene(mesh, terms, contacts=[ground])
    init, step = make_step(scene, 0.01)
    return scene, init, jax.jit(step)


def test_a_block_at_1000_m_per_s_stays_above_the_ground(falling):
    scene, init, step = falling
    state = init(v=[0.0, -1000.0])
    state, info = step(scene.params, state)
    assert state.x[:, 1].min() > 0
    assert info.least_distance > 0


def test_a_block_comes_to_rest_and_the_ground_carries_its_weight(falling):
    scene, init, step = falling
    state = init()
    for _ in range(150):
        state, info = step(scene.params, state)
        assert info.converged
    assert jnp.abs(state.v).max() < 1e-4
    energy, data = scene.contacts[0].energies[0], (scene.params.terms["ground"], scene.params.rest)
    elements = energy.elements(state.x, state.x, data)
    _, slopes = jax.vmap(energy.gradient)(state.x[elements.indices], energy.describe(state.x, elements, data))
    weight = float(scene.params.masses.sum()) * 9.81
    assert -float(slopes[..., 1].sum()) == pytest.approx(weight, rel=1e-4)


def test_a_body_inside_an_obstacle_is_refused():
    mesh = beam(0.4, 0.2, 2, 1)
    with pytest.raises(InputError, match="inside the obstacle 'ball'"):
        obstacle_contact(mesh, sphere([0.0, 0.0], 0.1), distance=0.01, stiffness=1e5, name="ball")
