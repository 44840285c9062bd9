"""Barrier energies against those of the authors' toolkit, ipctk."""

import ipctk
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.candidates import surface_of
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.terms.term import Context
from dln_jax.solvers.elements.moving import lists_between, moving_gradient, moving_hessians

DISTANCE = 0.35


def ours(mesh):
    """Positions -> value, gradient and Hessian."""
    contact = body_contact(mesh, distance=DISTANCE, stiffness=1.0, capacity=2000)
    rest = jnp.asarray(mesh.vertices)

    @jax.jit
    def evaluate(x):
        data = contact.prepare(contact.parameters, Context(rest, jnp.ones(len(rest)), rest, jnp.asarray(0.01)))
        lists = lists_between(contact.energies, x, jnp.zeros_like(rest), data)
        (blocks,) = moving_hessians(contact.energies, x, lists, data)
        unknowns = (lists[0].indices[:, :, None] * x.shape[1] + jnp.arange(x.shape[1])).reshape(len(blocks), -1)
        whole = jnp.zeros((x.size, x.size)).at[unknowns[:, :, None], unknowns[:, None, :]].add(blocks)
        return (*moving_gradient(contact.energies, x, lists, data), whole), lists[0].overflow

    return evaluate


def reference(mesh, x):
    surface = surface_of(mesh)
    faces = surface.facets if mesh.dimension == 3 else np.zeros((0, 3), int)
    collision_mesh = ipctk.CollisionMesh(np.asfortranarray(mesh.vertices), surface.edges, faces)
    assert collision_mesh.num_vertices == len(x)
    collisions = ipctk.NormalCollisions()
    collisions.use_area_weighting = True
    collisions.build(collision_mesh, np.asfortranarray(x), DISTANCE)
    potential = ipctk.BarrierPotential(DISTANCE)
    parts = (collisions, collision_mesh, np.asfortranarray(x))
    # Without its "physical" scaling the toolkit returns b alone.
    results = (potential(*parts), potential.gradient(*parts), potential.hessian(*parts).toarray())
    return [of / DISTANCE**3 for of in results]


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_value_gradient_and_hessian_agree(dimension):
    one = beam(1.0, 1.0, 2, 2) if dimension == 2 else box((1.0, 1.0, 1.0), (2, 2, 2))
    vertices = np.concatenate([one.vertices, one.vertices + 1.2 * np.eye(dimension)[-1] + 0.13])
    mesh = make_mesh(vertices, np.concatenate([one.elements, one.elements + len(one.vertices)]))
    evaluate = ours(mesh)
    for seed in range(3):
        x = mesh.vertices + 0.03 * np.random.default_rng(seed).normal(size=mesh.vertices.shape)
        results, overflow = evaluate(x)
        assert not overflow
        for result, expected in zip(results, reference(mesh, x), strict=True):
            np.testing.assert_allclose(np.ravel(result), np.ravel(expected), atol=1e-12 * np.abs(expected).max())
