"""Pressure, gas, tendons, fibres and loads against closed forms, laws of mechanics and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from impact_derivatives import require_gradient_of_differences
from jax.flatten_util import ravel_pytree
from scipy.optimize import fsolve

from dln_jax.softbody.mesh.mesh import NamedSet, boundary, make_mesh, volumes
from dln_jax.softbody.mesh.shapes import beam, box, lattice, quadratic
from dln_jax.softbody.mesh.surfaces import (
    closed_surface,
    enclosed_volume,
    facets_in,
    inner_surface,
    surface_parts,
)
from dln_jax.softbody.scene import make_scene, potential, with_parameters
from dln_jax.softbody.step import make_step, static_solve
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.fibres import fibres
from dln_jax.softbody.terms.loads import body_force, gas, gravity, point_force, pressure, traction
from dln_jax.softbody.terms.springs import muscles, path_length, tendon_of_length, tendon_of_tension
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

E, NU = 1e5, 0.3


def ring(inner, outer, around, across):
    """A ring in the plane."""
    angles = 2 * np.pi * np.arange(around) / around
    radii = np.linspace(inner, outer, across + 1)
    vertices = np.concatenate([r * np.stack([np.cos(angles), np.sin(angles)], axis=1) for r in radii])
    i, k = np.meshgrid(np.arange(around), np.arange(across))
    a, b = (k * around + i).ravel(), (k * around + (i + 1) % around).ravel()
    return make_mesh(
        vertices, np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])
    )


def hollow_box(*, bottom=True):
    """A cube of 1 m whose middle third is a cavity, which without its bottom is open at z = 0."""
    cells = [c for c in np.ndindex(3, 3, 3) if c[:2] != (1, 1) or c[2] == 2 or (bottom and c[2] == 0)]
    positions, elements = lattice(cells)
    return make_mesh(positions / 3, elements)


def forces(term, mesh, x, control=None):
    scene = make_scene(mesh, [term])
    return -np.asarray(jax.jit(jax.grad(lambda x: potential(scene, x, scene.params, control)))(x))


def shaken(mesh, amount=0.03):
    return mesh.vertices + amount * np.random.default_rng(0).normal(size=mesh.vertices.shape)


def test_surfaces_enclose_the_volume_of_the_body_and_of_its_cavity():
    for mesh, expected in ((ring(0.5, 1.0, 12, 2), 0.75), (hollow_box(), 1 / 27)):
        outer, wall = surface_parts(mesh)
        cavity = enclosed_volume(mesh.vertices, closed_surface(mesh, inner_surface(mesh)))
        assert cavity == pytest.approx(expected, rel=1e-12)
        whole = enclosed_volume(mesh.vertices, surface_parts(mesh)[0])
        assert whole - cavity == pytest.approx(volumes(mesh).sum(), rel=1e-12)
        assert enclosed_volume(mesh.vertices, wall) == pytest.approx(-cavity)
        assert len(outer) + len(wall) == len(boundary(mesh))


def test_pressure_on_a_closed_surface_has_no_resultant_force_or_moment():
    for mesh in (ring(0.5, 1.0, 12, 1), hollow_box(), quadratic(ring(0.5, 1.0, 12, 1)), quadratic(hollow_box())):
        x = shaken(mesh)
        f = forces(pressure(mesh, inner_surface(mesh), pressure=3e3), mesh, x)
        size = np.abs(f).sum()
        assert size > 1e2
        np.testing.assert_allclose(f.sum(axis=0), 0, atol=1e-12 * size)
        np.testing.assert_allclose(x.T @ f - f.T @ x, 0, atol=1e-12 * size)


def test_pressure_under_a_cap_lifts_with_its_area_and_pulls_at_the_rim_of_the_opening():
    mesh = hollow_box(bottom=False)
    open_cavity = boundary(mesh)
    middle = mesh.vertices[open_cavity].mean(axis=1)
    inside = (np.abs(middle[:, :2] - 0.5) < 0.17).all(axis=1) & (middle[:, 2] < 0.67) & (middle[:, 2] > 1e-9)
    with one_line(r"open at 4 edges.*cap=True"):
        closed_surface(mesh, open_cavity[inside])
    chamber = closed_surface(mesh, open_cavity[inside], cap=True)
    assert enclosed_volume(mesh.vertices, chamber) == pytest.approx(2 / 27)
    f = forces(pressure(mesh, open_cavity[inside], pressure=900.0, cap=True), mesh, mesh.vertices)
    up = mesh.vertices[:, 2] > 0.5
    assert f[up, 2].sum() == pytest.approx(100.0)
    assert f[mesh.vertices[:, 2] < 1e-9, 2].sum() == pytest.approx(-100.0)


def test_a_thick_walled_cylinder_widens_as_lame_says():
    p, around, across = 1e-4 * E, 24, 2
    mesh = quadratic(ring(0.5, 1.0, around, across))
    radius = np.linalg.norm(mesh.vertices, axis=1)
    # Mid-side nodes of the inner and outer circle are on them.
    on = {r: np.abs(radius - r) < 0.01 for r in (0.5, 1.0)}
    curved = sum(np.where(at, r / radius, 0.0) for r, at in on.items())
    mesh = mesh._replace(vertices=mesh.vertices * np.where(curved, curved, 1.0)[:, None])
    terms = [
        elastic(mesh, stable_neo_hookean, youngs_modulus=E, poisson_ratio=NU),
        pressure(mesh, inner_surface(mesh)),
    ]
    scene = make_scene(mesh, terms, masses=1e-3, held=[int(np.argmax(mesh.vertices[:, 0]))])
    x, info = static_solve(scene, scene.params, jnp.asarray(p), tolerance=1e-5)
    assert info.converged
    x = x - x.mean(axis=0) + mesh.vertices.mean(axis=0)
    for r, at in on.items():
        moved = np.linalg.norm(x[at], axis=1).mean() - r
        # Plane strain, a = 0.5 m and b = 1 m.
        expected = p * 0.25 / 0.75 * (1 + NU) / E * ((1 - 2 * NU) * r + 1 / r)
        assert moved == pytest.approx(expected, rel=3e-3)


def test_a_sealed_gas_keeps_pressure_times_volume_and_resists_a_load():
    mesh = ring(0.5, 1.0, 12, 1)
    term = gas(mesh, inner_surface(mesh), pressure=2e3, ambient=1e4)
    surface = closed_surface(mesh, inner_surface(mesh))
    x = 1.1 * mesh.vertices
    volume = enclosed_volume(x, surface)
    absolute = 1.2e4 * enclosed_volume(mesh.vertices, surface) / volume
    of_gauge = forces(pressure(mesh, inner_surface(mesh), pressure=absolute - 1e4), mesh, x)
    np.testing.assert_allclose(forces(term, mesh, x), of_gauge, atol=1e-9)
    pumped = gas(mesh, inner_surface(mesh), pressure=None, ambient=1e4)
    np.testing.assert_allclose(forces(pumped, mesh, x, jnp.asarray(absolute * volume)), of_gauge, atol=1e-9)


def test_a_tendon_pulls_with_one_tension_and_never_pushes():
    mesh = box((1.0, 0.2, 0.2), (3, 1, 1))
    path = np.array([[0.05, 0.1, 0.03], [0.5, 0.12, 0.1], [0.95, 0.1, 0.17]])
    rest = float(path_length(mesh, path))
    assert rest == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    tense = tendon_of_length(mesh, path, stiffness=200.0, length=0.9 * rest)
    slack = tendon_of_length(mesh, path, stiffness=200.0, length=1.1 * rest)
    assert not forces(slack, mesh, mesh.vertices).any()
    pulled = forces(tendon_of_tension(mesh, path, tension=20.0 * rest), mesh, mesh.vertices)
    np.testing.assert_allclose(forces(tense, mesh, mesh.vertices), pulled, atol=1e-12)
    np.testing.assert_allclose(pulled.sum(axis=0), 0, atol=1e-12)
    # In a strain G the work is that of the tension on the segments s, which grow by s G s / |s|.
    segments = np.diff(path, axis=0)
    growth = np.einsum("ki,kj,k->ij", segments, segments, 1 / np.linalg.norm(segments, axis=1))
    for body in (mesh, quadratic(mesh)):
        force = forces(tendon_of_tension(body, path, tension=20.0), body, body.vertices)
        np.testing.assert_allclose(body.vertices.T @ force, -20.0 * growth, atol=1e-12)


def test_fibres_shorten_a_bar_to_where_their_stress_balances_that_of_the_material():
    mu, strength, passive, activation = E / 2, 2e4, 5e4, 0.5

    def stresses(stretches):
        """First Piola stresses of the stable neo-Hookean bar with nu = 0 and fibres along the first axis."""
        one, other = stretches
        J = one * other
        along = mu * (one - other) + mu * (J - 1) * other + activation * strength + passive * (one - 1)
        return along, mu * (other - one) + mu * (J - 1) * one

    one, other = fsolve(stresses, [0.95, 1.0], xtol=1e-14)
    assert one < 0.95
    for mesh in (beam(1.0, 0.5, 2, 1), quadratic(beam(1.0, 0.5, 2, 1))):
        solid = elastic(mesh, stable_neo_hookean, youngs_modulus=E, poisson_ratio=0.0)
        muscle = fibres(mesh, (3.0, 0.0), strength=strength, stiffness=passive)
        shortened = mesh.vertices * np.array([one, other])
        contracting = forces(muscle, mesh, shortened, jnp.asarray([activation]))
        assert np.abs(contracting).max() > 100
        np.testing.assert_allclose(contracting, -forces(solid, mesh, shortened), atol=1e-8)


def test_loads_add_up_to_force_times_area_or_volume():
    for mesh in (quadratic(box((0.3, 0.4, 0.5), (2, 2, 2))), beam(0.3, 0.5, 3, 2)):
        top = boundary(mesh)[(mesh.vertices[boundary(mesh)][..., -1] == 0.5).all(axis=1)]
        t = np.arange(1.0, mesh.dimension + 1)
        area = 0.12 if mesh.dimension == 3 else 0.3
        np.testing.assert_allclose(forces(traction(mesh, top, t), mesh, mesh.vertices).sum(axis=0), t * area)
        f = forces(body_force(mesh, t), mesh, mesh.vertices)
        np.testing.assert_allclose(f.sum(axis=0), t * volumes(mesh).sum())
        one = forces(point_force(mesh, [2], t), mesh, mesh.vertices)
        np.testing.assert_allclose(one[2], t)
        assert not np.delete(one, 2, axis=0).any()


def actuated():
    """A ring with a chamber, a tendon and fibres, all of them driven, and a driven muscle and load."""
    mesh = ring(0.5, 1.0, 8, 1)
    terms = [
        elastic(mesh, stable_neo_hookean, youngs_modulus=E, poisson_ratio=NU),
        pressure(mesh, inner_surface(mesh), name="air"),
        tendon_of_length(mesh, [8, 10, 12], stiffness=3e4),
        fibres(mesh, (1.0, 0.5), strength=2e4, groups=np.arange(16) % 2),
        muscles([[8, 12], [9, 13]], stiffness=900.0),
        traction(mesh, surface_parts(mesh)[0], name="wind"),
        gravity(mesh),
    ]
    return mesh, make_scene(mesh, terms, held=[8, 9])


CONTROL = {
    "air": jnp.asarray(3e3),
    "tendon": jnp.asarray([2.1]),
    "fibres": jnp.asarray([0.3, 0.8]),
    "muscles": jnp.asarray([0.8, 0.9]),
    "wind": jnp.asarray([40.0, -30.0]),
}


def test_derivatives_by_all_controls_and_parameters_are_those_of_finite_differences():
    _, scene = actuated()
    init, step = make_step(scene, 0.02, tolerance=1e-10)
    weights = np.random.default_rng(2).normal(size=scene.mesh.vertices.shape)
    at, unravel = ravel_pytree((CONTROL, jnp.asarray(2e4), jnp.asarray(3e4)))

    def outcome(shares):
        control, strength, stiffness = unravel(at * shares)
        params = with_parameters(scene.params, fibres={"strength": strength}, tendon={"stiffness": stiffness})
        state, info = jax.lax.scan(lambda state, _: step(params, state, control), init(), None, length=2)
        return jnp.sum(weights * state.x), info.converged

    require_gradient_of_differences(outcome, np.ones(len(at)), np.full(len(at), 1e-4))


@pytest.mark.slow
def test_controls_are_shared_by_name():
    mesh, scene = actuated()
    init, step = make_step(scene, 0.02)
    bare = make_scene(mesh, [gravity(mesh)])
    missing = {name: of for name, of in CONTROL.items() if name != "air"}
    for control, words in (
        (jnp.ones(2), "one array, but the scene has the actuators air, tendon"),
        (CONTROL | {"water": jnp.ones(1)}, r"names 'water', which is not an actuator.*air"),
        (missing, r"air got no control; expected shape .*: the gauge pressure in Pa"),
        (CONTROL | {"fibres": jnp.ones(3)}, "expected shape"),
    ):
        with one_line(words):
            step(scene.params, init(), control)
    jax.eval_shape(make_step(scene, 0.02, halvings=1).step, scene.params, init(), CONTROL)
    with one_line("the control is one array, but the scene has no actuator"):
        static_solve(bare, bare.params, jnp.ones(3))


def test_mistakes_of_actuators_say_what_is_wrong():
    mesh, cube = ring(0.5, 1.0, 8, 1), box((1.0, 1.0, 1.0), (1, 1, 1))
    wall, named = inner_surface(mesh), mesh._replace(sets={"few": NamedSet(np.array([0, 12]), np.zeros(0, int))})
    for mistake, words in (
        (lambda: pressure(mesh, wall[1:]), "open at 2 vertices, the first is vertex 1"),
        (lambda: pressure(quadratic(mesh), wall[1:]), r"or use linear elements \(order 1\)"),
        (lambda: pressure(mesh, [[0, 99]]), "facet 0 is .0, 99.; expected 2 different vertices of 0..15"),
        (lambda: pressure(mesh, [[0, 1], [1, 0]]), "is repeated"),
        (lambda: inner_surface(cube), "no closed cavity"),
        (lambda: facets_in(named, "few"), "'few' contains no edge of the surface"),
        (lambda: tendon_of_tension(mesh, [[0.7, 0.0], [3.0, 0.0]], tension=1.0), "point 1 at .3.0, 0.0. m is outside"),
        (lambda: tendon_of_tension(mesh, [0, 0], tension=1.0), "points 0 and 1 of the path coincide"),
        (lambda: fibres(mesh, (0.0, 0.0), strength=1.0), "direction of fibres 0 is zero"),
        (lambda: traction(mesh, surface_parts(mesh)[0], [1.0, 2.0, 3.0]), "has shape .3.; expected .2."),
        (lambda: gas(mesh, wall, pressure=-2e5), "absolute pressure"),
    ):
        with one_line(words):
            mistake()
