"""Barrier energies against those of the authors' toolkit, ipctk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody.contact import body_contact
from dln_jax.softbody.contact.surface import surface_of
from dln_jax.softbody.mesh.mesh import Mesh, make_mesh
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.terms.term import Context
from dln_jax.solvers.elements.moving import lists_between, moving_gradient, moving_hessians

ipctk = pytest.importorskip("ipctk", reason="the reference needs ipctk, of the extra [test]")

DISTANCE = 0.35


def two_bodies(dimension: int) -> Mesh:
    one = beam(1.0, 1.0, 2, 2) if dimension == 2 else box((1.0, 1.0, 1.0), (2, 2, 2))
    lift = np.eye(dimension)[-1]
    return make_mesh(
        np.concatenate([one.vertices, one.vertices + 1.2 * lift + 0.13]),
        np.concatenate([one.elements, one.elements + len(one.vertices)]),
    )


def ours(mesh: Mesh, x: np.ndarray):
    contact = body_contact(mesh, distance=DISTANCE, stiffness=1.0, capacity=2000)
    rest = jnp.asarray(mesh.vertices)
    data = contact.prepare(contact.parameters, Context(rest, jnp.ones(len(rest)), rest, jnp.asarray(0.01), None))
    lists = lists_between(contact.energies, jnp.asarray(x), jnp.zeros_like(rest), data)
    assert not any(elements.overflow for elements in lists)
    value, gradient = moving_gradient(contact.energies, jnp.asarray(x), lists, data)
    hessian = jax.jacfwd(lambda x: moving_gradient(contact.energies, x, lists, data)[1])(jnp.asarray(x))
    (blocks, *_), (elements, *_) = (
        moving_hessians(contact.energies, jnp.asarray(x), lists, data),
        lists,
    )
    d = x.shape[1]
    unknowns = (np.asarray(elements.indices)[:, :, None] * d + np.arange(d)).reshape(len(blocks), -1)
    assembled = np.zeros((x.size, x.size))
    np.add.at(assembled, (unknowns[:, :, None], unknowns[:, None, :]), blocks)
    np.testing.assert_allclose(assembled, hessian.reshape(x.size, x.size), atol=1e-11 * np.abs(assembled).max())
    return value, gradient.reshape(-1), hessian.reshape(x.size, x.size)


def reference(mesh: Mesh, x: np.ndarray):
    surface = surface_of(mesh)
    at = np.asfortranarray(mesh.vertices)
    faces = surface.triangles if mesh.dimension == 3 else np.zeros((0, 3), int)
    collision_mesh = ipctk.CollisionMesh(at, surface.edges, faces)
    assert collision_mesh.num_vertices == len(x)
    collisions = ipctk.NormalCollisions()
    collisions.use_area_weighting = True
    collisions.build(collision_mesh, np.asfortranarray(x), DISTANCE)
    potential = ipctk.BarrierPotential(DISTANCE)
    parts = (collisions, collision_mesh, np.asfortranarray(x))
    # Without its "physical" scaling the toolkit returns b alone.
    scale = DISTANCE**3
    hessian = potential.hessian(*parts).toarray()
    return potential(*parts) / scale, potential.gradient(*parts) / scale, hessian / scale


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_value_gradient_and_hessian_agree(dimension):
    mesh = two_bodies(dimension)
    for seed in range(3):
        x = mesh.vertices + 0.03 * np.random.default_rng(seed).normal(size=mesh.vertices.shape)
        for result, expected in zip(ours(mesh, x), reference(mesh, x), strict=True):
            np.testing.assert_allclose(result, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
