"""Programs of steps: how often they trace an energy, and Hessians by combinations of the corners."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.scene import element_energies, make_scene, prepare
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.springs import springs
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.energies import element_hessians, of_corners, project, square


def test_a_step_traces_its_energy_seven_times_at_most():
    traces = 0

    def counted(F, mu, lam):
        nonlocal traces
        traces += 1
        return stable_neo_hookean(F, mu, lam)

    mesh = beam(2.0, 0.5, 4, 1)
    scene = make_scene(mesh, [elastic(mesh, counted, youngs_modulus=1e6, poisson_ratio=0.3)], density=1e3, held=[0])
    init, step = make_step(scene, 0.01)
    traces = 0
    jax.jit(step).trace(scene.params, init())
    # Both first guesses, the start, the search, the Hessian, the verdict, and the forces on held vertices.
    assert 0 < traces <= 7


@pytest.fixture(scope="module")
def body():
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    terms = [
        elastic(mesh, stable_neo_hookean, youngs_modulus=1e3, poisson_ratio=0.4),
        springs([[0, 7], [1, 6]], stiffness=300.0, rest_length=2.5),
    ]
    scene = make_scene(mesh, terms, density=1.0)
    x = jnp.asarray(mesh.vertices + 0.4 * np.random.default_rng(0).normal(size=mesh.vertices.shape))
    return element_energies(scene), x, prepare(scene, scene.params, x)


def test_hessians_by_combinations_are_those_by_the_corners(body):
    energies, x, data = body

    @jax.jit
    def both(x):
        direct = []
        for element, of in zip(energies, data, strict=True):
            corners = x[element.indices]
            whole = jax.vmap(jax.hessian(of_corners(element)))(corners, of)
            direct.append(whole.reshape(len(corners), corners[0].size, -1))
        return list(map(square, element_hessians(energies, x, data))), direct

    for ours, direct in zip(*both(x), strict=True):
        np.testing.assert_allclose(ours, direct, rtol=1e-12, atol=1e-12 * abs(direct).max())


def test_elements_of_several_sizes_are_projected_like_each_alone(body):
    energies, x, data = body
    shift = jnp.asarray(1e-6)

    @jax.jit
    def projected(x):
        hessians = element_hessians(energies, x, data)
        return list(map(square, hessians)), list(map(square, project(hessians, shift)))

    before, after = projected(x)
    largest = max(np.diagonal(h, axis1=1, axis2=2).max() for h in before)
    assert all((np.linalg.eigvalsh(h)[:, 0] < -1.0).any() for h in before)
    for h, result in zip(before, after, strict=True):
        values, vectors = np.linalg.eigh(h)
        expected = np.einsum("mik,mk,mjk->mij", vectors, np.maximum(values, 0), vectors)
        expected += float(shift) * largest * np.eye(h.shape[1])
        np.testing.assert_allclose(result, expected, atol=1e-9 * largest)
