"""Contact of quadratic bodies: their mid-side nodes are part of the surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody import make_scene, make_step
from dln_jax.softbody.contact import body_contact, crossings, half_space, obstacle_contact
from dln_jax.softbody.contact.surface import areas, surface_of
from dln_jax.softbody.mesh.mesh import boundary_vertices, make_mesh, vertices_where
from dln_jax.softbody.mesh.quadratic import quadratic
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.scene import contact_energies, prepare_contacts
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.moving import lists_between, moving_gradient

GRAVITY = 9.81


def two_blocks(dimension, *, gap=0.015):
    """Two quadratic blocks, the upper one half as wide and in the middle of the lower one."""
    if dimension == 2:
        lower, upper, offset = beam(0.4, 0.2, 1, 1), beam(0.2, 0.2, 1, 1), [0.1, 0.2 + gap]
    else:
        lower, upper, offset = box((0.4, 0.4, 0.2), (1, 1, 1)), box((0.2, 0.2, 0.2), (1, 1, 1)), [0.1, 0.1, 0.2 + gap]
    vertices = np.concatenate([lower.vertices, upper.vertices + np.array(offset)])
    return quadratic(make_mesh(vertices, np.concatenate([lower.elements, upper.elements + len(lower.vertices)])))


def scene_of(mesh, *, modulus=1e5, held=(), weight=True, **contact):
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=0.3)]
    terms += [gravity(mesh)] if weight else []
    contact = {"distance": 0.01, "stiffness": 1e5, **contact}
    return make_scene(mesh, terms, held=held, contacts=[body_contact(mesh, **contact)])


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_surface_holds_every_node_of_the_boundary_and_its_whole_area(dimension):
    mesh = two_blocks(dimension)
    surface = surface_of(mesh)
    assert surface.vertices.tolist() == boundary_vertices(mesh).tolist()
    of_vertices, of_edges = areas(surface, jnp.asarray(mesh.vertices))
    area = 1.2 + 0.8 if dimension == 2 else (2 * 0.16 + 4 * 0.08) + 6 * 0.04
    assert float(of_vertices.sum()) == pytest.approx(area, rel=1e-14)
    assert float(of_edges.sum()) == pytest.approx(area, rel=1e-14)


def test_a_mid_side_node_that_bulges_into_another_body_is_a_crossing():
    mesh = two_blocks(2)
    x = mesh.vertices.copy()
    middle = vertices_where(mesh, lambda x: (abs(x[:, 1] - 0.2) < 1e-9) & (abs(x[:, 0] - 0.2) < 1e-9))
    assert not crossings(mesh, x)
    x[middle, 1] += 0.04
    assert {vertex for pair in crossings(mesh, x) for edge in pair for vertex in edge} >= set(middle.tolist())


def test_a_quadratic_block_rests_on_another_which_carries_its_weight():
    mesh = two_blocks(2, gap=0.0085)
    held = vertices_where(mesh, lambda x: x[:, -1] < 0.201)
    # Friction of a large threshold is a viscous drag, which brings the block to rest soon.
    scene = scene_of(mesh, held=held, friction=0.3, threshold_speed=0.1)
    init, step = make_step(scene, 0.1, tolerance=1e-9)
    step, state = jax.jit(step), init()
    for _ in range(50):
        state, info = step(scene.params, state)
        assert info.converged
        assert not crossings(mesh, np.asarray(state.x))
    barrier, data = contact_energies(scene)[:1], prepare_contacts(scene, scene.params, state.x)[:1]
    lists = lists_between(barrier, state.x, jnp.zeros_like(state.x), data)
    force = float(moving_gradient(barrier, state.x, lists, data)[1][held, -1].sum())
    weight = float(np.asarray(scene.params.masses)[scene.free[:, 0]].sum()) * GRAVITY
    assert force == pytest.approx(weight, rel=1e-6)
    # Mid-side nodes of the lower edge keep their distance, too.
    above = np.setdiff1d(boundary_vertices(mesh), held)
    assert float(state.x[above, -1].min()) > 0.2


def test_mid_side_nodes_stay_above_an_obstacle():
    mesh = quadratic(beam(0.4, 0.2, 1, 1))
    mesh = mesh._replace(vertices=mesh.vertices + np.array([0.0, 0.02]))
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=1e5, poisson_ratio=0.3)]
    ground = obstacle_contact(mesh, half_space([0.0, 1.0]), distance=0.01, stiffness=1e5)
    scene = make_scene(mesh, terms, contacts=[ground])
    init, step = make_step(scene, 0.005)
    state, step = init(v=[0.0, -5.0]), jax.jit(step)
    for _ in range(8):
        state, info = step(scene.params, state)
        assert info.converged and float(state.x[:, 1].min()) > 0
