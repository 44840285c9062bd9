"""Bodies in contact: nothing crosses, forces balance, momentum is kept, and derivatives are those of the motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from impact_derivatives import compare_derivatives_with_differences
from scipy.optimize import linprog

from dln_jax.softbody import MIDPOINT, make_scene, make_step
from dln_jax.softbody.contact import body_contact, crossings
from dln_jax.softbody.contact.crossings import _segments_meet_triangles
from dln_jax.softbody.mesh.mesh import Mesh, make_mesh, vertices_where
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.types import InputError


def joined(*bodies: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    elements = [body.elements + start for body, start in zip(bodies, starts, strict=False)]
    return make_mesh(np.concatenate([body.vertices for body in bodies]), np.concatenate(elements))


def shifted(body: Mesh, *offset: float) -> Mesh:
    return body._replace(vertices=body.vertices + np.array(offset))


def scene_of(mesh, *, held=(), weight=True, **contact):
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=1e5, poisson_ratio=0.3)]
    terms += [gravity(mesh)] if weight else []
    contact = {"distance": 0.02, "stiffness": 1e5, **contact}
    return make_scene(mesh, terms, held=held, contacts=[body_contact(mesh, **contact)])


@pytest.fixture(scope="module")
def colliding():
    """Two free blocks in the plane, and their step."""
    mesh = joined(beam(0.4, 0.2, 2, 1), shifted(beam(0.4, 0.2, 2, 1), 0.1, 0.25))
    scene = scene_of(mesh, weight=False)
    init, step = make_step(scene, 0.01)
    return scene, init, jax.jit(step)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_bodies_that_collide_never_cross_and_keep_their_momentum(colliding, speed):
    scene, init, step = colliding
    above = scene.mesh.vertices[:, 1] > 0.22
    state = init(v=np.where(above[:, None], [0.0, -speed], 0.0))
    masses = np.asarray(scene.params.masses)[:, None]
    before = (masses * np.asarray(state.v)).sum(axis=0)
    for _ in range(40):
        state, info = step(scene.params, state)
        assert info.converged
        assert not crossings(scene.mesh, np.asarray(state.x))
    after = (masses * np.asarray(state.v)).sum(axis=0)
    np.testing.assert_allclose(after, before, atol=1e-6 * speed * masses.sum())
    # The upper body has pushed the lower one and has not passed through.
    assert np.asarray(state.v)[~above, 1].mean() < -0.1 * speed
    assert np.asarray(state.x)[above, 1].mean() > np.asarray(state.x)[~above, 1].mean()


def test_the_same_bodies_without_contact_cross(colliding):
    scene, init, _ = colliding
    free = scene._replace(contacts=())
    init, step = make_step(free, 0.01)
    above = scene.mesh.vertices[:, 1] > 0.22
    state, _ = jax.jit(step)(free.params, init(v=np.where(above[:, None], [0.0, -20.0], 0.0)))
    assert crossings(scene.mesh, np.asarray(state.x))


def test_a_list_that_is_too_short_is_reported_and_the_step_has_not_converged():
    mesh = joined(beam(4.0, 0.2, 80, 1), shifted(beam(4.0, 0.2, 80, 1), 0.01, 0.21))
    scene = scene_of(mesh, weight=False, capacity=1)
    init, step = make_step(scene, 0.01)
    _, info = jax.jit(step)(scene.params, init())
    assert info.overflow
    assert not info.converged


@pytest.mark.slow
def test_held_vertices_push_a_body_ahead_and_reach_their_goal():
    mesh = joined(beam(0.4, 0.2, 2, 1), shifted(beam(0.4, 0.2, 2, 1), 0.45, 0.0))
    held = vertices_where(mesh, lambda x: x[:, 0] < 0.41)
    scene = scene_of(mesh, held=held, weight=False)
    init, step = make_step(scene, 0.01)
    # In one step the held body moves across the whole gap, and half of the other body.
    v = np.where(mesh.vertices[:, :1] < 0.41, [25.0, 0.0], 0.0)
    state, info = jax.jit(step)(scene.params, init(v=v))
    assert info.converged
    np.testing.assert_allclose(state.x[held], mesh.vertices[held] + [0.25, 0.0], atol=1e-12)
    assert not crossings(mesh, np.asarray(state.x))


@pytest.mark.slow
def test_derivatives_through_an_impact_with_friction_agree_with_differences():
    mesh = joined(beam(0.4, 0.2, 2, 1), shifted(beam(0.4, 0.2, 2, 1), 0.1, 0.215))
    held = vertices_where(mesh, lambda x: x[:, 1] < 0.21)
    scene = scene_of(mesh, held=held, friction=0.3)
    v = np.where(mesh.vertices[:, 1:] > 0.21, [0.5, -0.5], 0.0)
    compare_derivatives_with_differences(scene, v, steps=6, tolerance=1e-10)


def test_surfaces_that_cross_at_the_start_are_refused_by_their_vertices():
    mesh = joined(beam(0.4, 0.2, 2, 1), shifted(beam(0.4, 0.2, 2, 1), 0.1, 0.1))
    with pytest.raises(InputError, match="cross, the first with the vertices"):
        scene_of(mesh)


def test_an_integrator_that_extrapolates_is_refused(colliding):
    scene, *_ = colliding
    with pytest.raises(InputError, match="use BACKWARD_EULER"):
        make_step(scene, 0.01, MIDPOINT)


def test_crossings_are_decided_exactly():
    one = box((1.0, 1.0, 1.0), (1, 1, 1))
    # First in contact by a face, then apart by one unit of rounding.
    assert crossings(joined(one, shifted(one, 1.0, 0.0, 0.0)), joined(one, shifted(one, 1.0, 0.0, 0.0)).vertices)
    gap = np.nextafter(1.0, 2.0)
    apart = joined(one, shifted(one, gap, 0.0, 0.0))
    assert not crossings(apart, apart.vertices)


@pytest.mark.slow
def test_two_boxes_in_space_come_to_rest_on_each_other():
    mesh = joined(box((1.0, 1.0, 0.5), (2, 2, 1)), shifted(box((1.0, 1.0, 0.5), (2, 2, 1)), 0.1, 0.1, 0.515))
    held = vertices_where(mesh, lambda x: x[:, 2] < 0.51)
    scene = scene_of(mesh, held=held, friction=0.3)
    init, step = make_step(scene, 0.02)
    step = jax.jit(step)
    state = init()
    for _ in range(60):
        state, info = step(scene.params, state)
        assert info.converged
        assert not crossings(mesh, np.asarray(state.x))
    assert jnp.abs(state.v).max() < 1e-2


def test_crossings_agree_with_linear_programming_in_degenerate_positions():
    # On a coarse lattice most pairs touch, are in one plane or in one line.
    random = np.random.default_rng(0)
    edges, triangles = (random.integers(0, 4, (300, count, 3)).astype(float) for count in (2, 3))
    proper = (edges[:, 0] != edges[:, 1]).any(axis=1)
    proper &= np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).any(axis=1)
    met = 0
    for (p, q), (a, b, c) in zip(edges[proper], triangles[proper], strict=True):
        # p + t (q - p) = a + u (b - a) + v (c - a) with 0 <= t <= 1, u, v >= 0, u + v <= 1.
        columns = np.stack([q - p, a - b, a - c], axis=1)
        program = linprog(np.zeros(3), [[0, 1, 1]], [1], columns, a - p, bounds=[(0, 1), (0, None), (0, None)])
        result = _segments_meet_triangles(np.stack([p, q])[None], np.stack([a, b, c])[None])
        assert bool(result[0]) == (program.status == 0)
        met += program.status == 0
    assert 30 < met < proper.sum() - 30


def test_a_step_beyond_its_list_moves_nothing():
    """With pairs left out, no motion is known to be free: the body stays where it is, and the step says so."""
    mesh = joined(beam(4.0, 0.2, 80, 1), shifted(beam(4.0, 0.2, 80, 1), 0.01, 0.215))
    scene = scene_of(mesh, weight=False, capacity=1)
    init, step = make_step(scene, 0.01)
    above = mesh.vertices[:, 1] > 0.21
    state, info = jax.jit(step)(scene.params, init(v=np.where(above[:, None], [0.0, -50.0], 0.0)))
    assert info.overflow and not info.converged
    assert not crossings(mesh, np.asarray(state.x))


@pytest.mark.slow
def test_held_vertices_that_cannot_reach_their_goal_stop_before_the_obstacle():
    mesh = joined(beam(0.4, 0.2, 2, 1), shifted(beam(0.4, 0.2, 2, 1), 0.45, 0.0))
    scene = scene_of(mesh, held=vertices_where(mesh, lambda x: abs(x[:, 0] - 0.425) > 0.2), weight=False)
    init, step = make_step(scene, 0.01)
    # The held ends of both bodies would have to pass through each other.
    v = np.where(mesh.vertices[:, :1] < 0.425, [100.0, 0.0], 0.0)
    state, info = jax.jit(step)(scene.params, init(v=v))
    assert not info.converged
    assert not crossings(mesh, np.asarray(state.x))
