"""Bodies in contact: nothing crosses, forces balance, momentum is kept, and derivatives are those of the motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from impact_derivatives import compare_derivatives_with_differences
from scipy.optimize import linprog

from dln_jax.softbody.contact.barrier import normal_force
from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.candidates import areas, surface_of
from dln_jax.softbody.contact.crossings import _segments_meet_triangles, count_overlaps, crossings
from dln_jax.softbody.contact.obstacles import half_space, obstacle_contact
from dln_jax.softbody.integrators import AVERAGE_VECTOR_FIELD, MIDPOINT
from dln_jax.softbody.mesh.mesh import Mesh, vertices_where
from dln_jax.softbody.mesh.shapes import beam, box, join, quadratic, translate
from dln_jax.softbody.scene import make_scene, prepare_contacts
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.moving import lists_between, moving_gradient


def joined(one: Mesh, other: Mesh, *offset: float) -> Mesh:
    """Two bodies, the other one moved."""
    return join(one, translate(other, offset))


def blocks(*offset):
    return joined(beam(0.4, 0.2, 2, 1), beam(0.4, 0.2, 2, 1), *offset)


def scene_of(mesh, *, held=(), modulus=1e5, weight=True, contacts=(), **contact):
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=0.3)]
    terms += [gravity(mesh)] if weight else []
    contact = {"distance": 0.02, "stiffness": 1e5, **contact}
    return make_scene(mesh, terms, held=held, contacts=[body_contact(mesh, **contact), *contacts])


def above(mesh, height, velocity):
    """Velocities of the vertices above a height."""
    return np.where(mesh.vertices[:, 1:] > height, velocity, 0.0)


@pytest.fixture(scope="module")
def colliding():
    """Two free blocks in the plane, and their step."""
    scene = scene_of(blocks(0.1, 0.25), weight=False)
    init, step = make_step(scene, 0.01)
    return scene, init, jax.jit(step)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_bodies_that_collide_never_cross_and_keep_their_momentum(colliding, speed):
    scene, init, step = colliding
    upper = scene.mesh.vertices[:, 1] > 0.22
    state = init(v=above(scene.mesh, 0.22, [0.0, -speed]))
    masses = np.asarray(scene.params.masses)
    before = masses @ state.v
    for _ in range(40):
        state, info = step(scene.params, state)
        assert info.converged
        assert not crossings(scene.mesh, np.asarray(state.x))
    np.testing.assert_allclose(masses @ state.v, before, atol=1e-6 * speed * masses.sum())
    # The upper body has pushed the lower one and has not passed through.
    assert np.asarray(state.v)[~upper, 1].mean() < -0.1 * speed
    assert np.asarray(state.x)[upper, 1].mean() > np.asarray(state.x)[~upper, 1].mean()


def test_a_step_beyond_its_list_of_pairs_says_so_and_moves_nothing():
    """With pairs left out, no motion is known to be free: the body stays where it is."""
    mesh = joined(beam(4.0, 0.2, 80, 1), beam(4.0, 0.2, 80, 1), 0.01, 0.215)
    scene = scene_of(mesh, weight=False, capacity=1)
    init, step = make_step(scene, 0.01)
    state, info = jax.jit(step)(scene.params, init(v=above(mesh, 0.21, [0.0, -50.0])))
    assert info.overflow and not info.converged
    assert not crossings(mesh, np.asarray(state.x))


def test_held_vertices_push_a_body_ahead_and_stop_before_what_they_cannot_pass():
    mesh = blocks(0.45, 0.0)
    for held, speed in ((mesh.vertices[:, 0] < 0.41, 25.0), (abs(mesh.vertices[:, 0] - 0.425) > 0.2, 100.0)):
        scene = scene_of(mesh, held=held, weight=False)
        init, step = make_step(scene, 0.01)
        # In one step the held body moves across the whole gap, and half of the other body, whose end may be held.
        v = np.where(mesh.vertices[:, :1] < 0.425, [speed, 0.0], 0.0)
        state, info = jax.jit(step)(scene.params, init(v=v))
        assert not crossings(mesh, np.asarray(state.x))
        assert info.converged == (speed == 25.0)
        if info.converged:
            np.testing.assert_allclose(state.x[held], mesh.vertices[held] + [0.25, 0.0], atol=1e-12)


def test_derivatives_through_an_impact_with_friction_agree_with_differences():
    mesh = blocks(0.1, 0.215)
    scene = scene_of(mesh, held=vertices_where(mesh, lambda x: x[:, 1] < 0.21), friction=0.3)
    compare_derivatives_with_differences(scene, above(mesh, 0.21, [0.5, -0.5]), steps=4, tolerance=1e-10)


def test_a_block_pressed_onto_another_rubs_with_the_normal_forces_at_the_end_of_the_step():
    mu, dt = 0.5, 0.002
    mesh = joined(beam(0.8, 0.2, 4, 1), beam(0.4, 0.2, 2, 1), 0.1, 0.212)
    upper = mesh.vertices[:, 1] > 0.206
    scene = scene_of(mesh, held=~upper, modulus=1e6, weight=False, distance=0.01, friction=mu)
    barrier, errors = scene.contacts[0].energies[:1], []
    init, step = make_step(scene, dt, tolerance=1e-9, friction_iterations=12)
    step, state = jax.jit(step), init(v=above(mesh, 0.206, [2.0, -2.0]))

    @jax.jit
    def forces(x):
        """Returns the barrier's force on every vertex, and the force and normal of each pair."""
        data = prepare_contacts(scene, scene.params, x)[:1]
        lists = lists_between(barrier, x, jnp.zeros_like(x), data)
        pairs = jax.vmap(normal_force)(x[lists[0].indices], barrier[0].describe(x, lists[0], data[0]))
        return moving_gradient(barrier, x, lists, data)[1], *pairs[:2]

    masses = np.asarray(scene.params.masses)[upper]
    for _ in range(8):
        before, (state, info) = state, step(scene.params, state)
        assert info.converged
        gradient, size, normal = map(np.asarray, forces(state.x))
        pushed = -gradient[upper].sum(axis=0)
        # The normal of a pair points from its edge to its vertex; the upper body slides to the right.
        turned = np.sign(normal[:, 1:]) * np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        expected = mu * size @ turned
        if (largest := np.linalg.norm(expected)) > 1.0:
            change = masses @ np.asarray(state.v - before.v)[upper] / dt
            errors.append(np.linalg.norm(change - pushed - expected) / largest)
    assert len(errors) > 4 and max(errors) < 1e-6


def test_two_boxes_in_space_come_to_rest_on_each_other():
    mesh = joined(box((1.0, 1.0, 0.5), (1, 1, 1)), box((1.0, 1.0, 0.5), (1, 1, 1)), 0.1, 0.1, 0.515)
    scene = scene_of(mesh, held=vertices_where(mesh, lambda x: x[:, 2] < 0.51), friction=0.3)
    init, step = make_step(scene, 0.04)
    step, state = jax.jit(step), init()
    for _ in range(30):
        state, info = step(scene.params, state)
        assert info.converged
        assert not crossings(mesh, np.asarray(state.x))
    assert jnp.abs(state.v).max() < 1e-2


def test_surfaces_that_cross_and_integrators_that_extrapolate_or_average_are_refused(colliding):
    scene, *_ = colliding
    for refused, words in (
        (lambda: scene_of(blocks(0.1, 0.1)), "cross, the first with the vertices"),
        (lambda: make_step(scene, 0.01, MIDPOINT), "use BACKWARD_EULER"),
        (lambda: make_step(scene, 0.01, AVERAGE_VECTOR_FIELD), "the contact pairs change"),
    ):
        with one_line(words):
            refused()


def have_a_common_point(a, b):
    """Whether some barycentric coordinates in both simplices, none negative, give the same point."""
    corners, dimension = np.concatenate([a, -b]), a.shape[1]
    first = np.arange(len(corners)) < len(a)
    equations = np.vstack([corners.T, first, ~first])
    return linprog(np.zeros(len(corners)), A_eq=equations, b_eq=[0.0] * dimension + [1.0, 1.0]).status == 0


def test_crossings_agree_with_linear_programming_in_degenerate_positions():
    # On a coarse lattice most pairs touch, are in one plane or in one line.
    random = np.random.default_rng(0)
    edges, triangles = (random.integers(0, 4, (300, count, 3)).astype(float) for count in (2, 3))
    proper = (edges[:, 0] != edges[:, 1]).any(axis=1)
    proper &= np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).any(axis=1)
    expected = np.array(list(map(have_a_common_point, edges[proper], triangles[proper])))
    np.testing.assert_array_equal(_segments_meet_triangles(edges[proper], triangles[proper]), expected)
    assert 30 < expected.sum() < proper.sum() - 30


def test_the_surface_of_quadratic_bodies_holds_every_node_of_the_boundary_and_its_whole_area():
    for mesh, area in ((quadratic(beam(0.4, 0.2, 1, 1)), 1.2), (quadratic(box((0.4, 0.4, 0.2), (1, 1, 1))), 0.64)):
        surface = surface_of(mesh)
        size = mesh.vertices.max(axis=0)
        outside = vertices_where(mesh, lambda x, size=size: np.minimum(x, size - x).min(axis=1) < 1e-9)
        assert surface.vertices.tolist() == outside.tolist()
        for of in areas(surface, jnp.asarray(mesh.vertices)):
            assert float(of.sum()) == pytest.approx(area, rel=1e-14)


def test_mid_side_nodes_touch_neither_another_body_nor_an_obstacle():
    mesh = quadratic(joined(beam(0.4, 0.2, 1, 1), beam(0.2, 0.2, 1, 1), 0.1, 0.215))
    bulging = vertices_where(mesh, lambda x: np.linalg.norm(x - [0.2, 0.2], axis=1) < 1e-9)
    x = mesh.vertices.copy()
    assert not crossings(mesh, x)
    x[bulging, 1] += 0.04
    assert {vertex for pair in crossings(mesh, x) for edge in pair for vertex in edge} >= set(bulging.tolist())
    mesh = mesh._replace(vertices=mesh.vertices + np.array([0.0, 0.02]))
    ground = obstacle_contact(mesh, half_space([0.0, 1.0]), distance=0.01, stiffness=1e5)
    scene = scene_of(mesh, weight=False, distance=0.01, contacts=[ground])
    init, step = make_step(scene, 0.005)
    state, step = init(v=[0.0, -5.0]), jax.jit(step)
    for _ in range(8):
        state, info = step(scene.params, state)
        assert info.converged and float(state.x[:, 1].min()) > 0
        assert not crossings(mesh, np.asarray(state.x))


# Overlaps of bodies without contact.
CUBE = box((1.0, 1.0, 1.0), (2, 2, 2))


def test_cubes_overlap_as_far_as_they_reach_into_each_other():
    count = count_overlaps(joined(CUBE, CUBE, 2.0, 0.0, 0.0))
    for offset, expected in (
        ((0.0, 0.0, 1.0), 1),  # They touch, all vertices shared.
        ((0.3, 0.2, 1.0), 1),
        ((0.0, 0.0, 1.0 + 1e-9), 0),
        ((0.0, 0.0, 0.99), 1),  # Aligned: no vertex of one lies inside the other.
        ((0.0, 0.0, 0.5), 1),
        ((0.4, 0.3, 0.2), 1),
        ((0.0, 0.0, 1.01), 0),
        ((1.0, 1.0, 1.0), 1),
    ):
        x = np.concatenate([CUBE.vertices, CUBE.vertices + np.array(offset)])
        assert count(x) == expected, offset
        # Far from the origin rounding is larger, and the answer the same.
        assert count(x + 100.0) == expected, offset


def test_pairs_of_bodies_are_counted():
    square = beam(1.0, 1.0, 6, 6)
    mesh = joined(joined(joined(square, square, 0.5, 0.1), square, 0.9, 0.9), square, 5.0, 0.0)
    assert count_overlaps(mesh)(mesh.vertices) == 3
    inside = count_overlaps(joined(CUBE, CUBE, 9.0, 0.0, 0.0))
    assert inside(np.concatenate([CUBE.vertices, 0.2 + 0.5 * CUBE.vertices])) == 1  # one inside the other
    assert count_overlaps(CUBE) is None
