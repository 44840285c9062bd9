"""Integrators: energy, order, divergence, damping at closed-form rates, and steps that shorten themselves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from impact_derivatives import require_gradient_of_differences
from scipy.linalg import eigh

from dln_jax.rollout import rollout
from dln_jax.softbody.integrators import AVERAGE_VECTOR_FIELD, BACKWARD_EULER, BDF2, MIDPOINT
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.shapes import beam, disc
from dln_jax.softbody.scene import element_energies, make_scene, potential, prepare, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.contact import damping_of_restitution, plane_contact
from dln_jax.softbody.terms.elasticity import elastic, mass_damping, stiffness_damping
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.energies import value

DT = 1e-2


@functools.cache
def free_disc():
    mesh = disc(0.5, 3)
    return make_scene(mesh, [elastic(mesh, stable_neo_hookean, youngs_modulus=1e6, poisson_ratio=0.3)])


def spinning(rate, noise):
    """Velocities of the disc in m/s: a rotation in rad/s and random ones."""
    x = free_disc().mesh.vertices
    random = np.random.default_rng(0).normal(size=x.shape)
    return rate * np.stack([-x[:, 1], x[:, 0]], axis=1) + noise * random


@functools.cache
def thousand_steps(integrator):
    """v -> energies in J and angular momenta in kg m²/s, with the start, and the outcomes."""
    scene = free_disc()
    init, step = make_step(scene, DT, integrator)
    masses = scene.params.masses

    def measured(state):
        energy = 0.5 * jnp.sum(masses[:, None] * state.v**2) + potential(scene, state.x, scene.params)
        return energy, jnp.sum(masses * (state.x[:, 0] * state.v[:, 1] - state.x[:, 1] * state.v[:, 0]))

    @jax.jit
    def run(v):
        advance, observe = functools.partial(step, scene.params), lambda state, info: (measured(state), info)
        (energy, turning), info = rollout(advance, init(v=v), steps=1000, observe=observe)[1]
        first = measured(init(v=v))
        return jnp.append(first[0], energy), jnp.append(first[1], turning), info

    return run


@pytest.mark.parametrize(("rate", "noise", "turned"), [(5.0, 2.0, 1e-2), (10.0, 0.0, 3e-3)])
def test_a_spinning_disc_keeps_its_energy(rate, noise, turned):
    energy, turning, info = thousand_steps(AVERAGE_VECTOR_FIELD)(spinning(rate, noise))
    assert info.converged.all()
    # Exact but for the tolerance of the steps: the quadrature integrates the polynomial.
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)
    # Angular momentum is kept by no more than the order of the method.
    np.testing.assert_allclose(turning, turning[0], rtol=turned)
    assert np.ptp(turning) > 1e-6 * turning[0]


@pytest.mark.parametrize("rate", [2.0, 5.0])
def test_slow_growth_of_the_midpoint_rule_is_divergence(rate):
    """At 5 rad/s no step creates 10 % of the energy at hand, and 1,000 steps create 60 % of the energy."""
    energy, turning, info = thousand_steps(MIDPOINT)(spinning(rate, 2.0))
    # Without held vertices, actuation and friction of the step, the growth is the change of the energy.
    np.testing.assert_allclose(info.energy_growth[:20], np.diff(energy)[:20], atol=1e-6 * energy[0])
    # Quadratic invariants are kept: exact but for the tolerance of the steps.
    np.testing.assert_allclose(turning[1:][info.converged], turning[0], rtol=1e-6)
    # The energy was lowest near the start: growth by a tenth of the energy at hand is noticed.
    wrong = np.asarray(energy[1:] > 1.2 * energy[0])
    assert wrong.any() and not (wrong & np.asarray(info.converged)).any()
    assert np.asarray(info.converged)[np.asarray(energy[1:] < 1.05 * energy[0])][:300].all()
    if rate == 5.0:
        assert (info.energy_growth < 0.1 * info.energy_at_hand).all()


def test_backward_euler_dissipates_energy_and_rotation():
    energy, turning, info = thousand_steps(BACKWARD_EULER)(spinning(5.0, 2.0))
    assert info.converged.all()
    assert np.diff(energy).max() < 1e-9 * energy[0] and np.diff(turning).max() < 1e-9 * turning[0]


@pytest.mark.parametrize("integrator", [AVERAGE_VECTOR_FIELD, MIDPOINT, BDF2, BACKWARD_EULER])
def test_order(integrator):
    """Against steps of an eighth of the length, from a rotation that also stretches."""
    scene = free_disc()
    start = spinning(5.0, 0.0) + np.array([2.0, 0.0]) * scene.mesh.vertices

    @jax.jit
    def end(count):
        init, step = make_step(scene, 0.05 / count, integrator, tolerance=1e-9)
        state = init(v=start)
        return jax.lax.fori_loop(0, count, lambda _, state: step(scene.params, state, None)[0], state).x

    exact = end(1600)
    coarse, fine = (np.abs(end(count) - exact).max() for count in (100, 200))
    assert np.log2(coarse / fine) == pytest.approx(1 if integrator is BACKWARD_EULER else 2, abs=0.2)


def impact(integrator, halvings, **options):
    """speed -> height and velocity at the end, added, and the outcomes, of a mass that hits a stiff ground."""
    mesh = Mesh(np.array([[0.0, 0.01]]), np.zeros((0, 3), int))
    scene = make_scene(mesh, [plane_contact([0], normal=(0, 1), stiffness=1e5, width=1e-3)], masses=1.0)
    init, step = make_step(scene, 0.02, integrator, halvings=halvings, **options)

    def run(speed):
        start = init(v=speed * jnp.array([0.0, -1.0]))
        last, info = rollout(functools.partial(step, scene.params), start, steps=4, observe=lambda _, info: info)
        return last.x[0, 1] + last.v[0, 1], info

    return run


def test_a_step_that_fails_is_taken_in_parts_and_has_its_derivatives():
    """The midpoint rule creates energy in the first step of 20 ms, and little in steps of 2.5 ms."""
    _, whole = jax.jit(impact(MIDPOINT, 0))(4.0)
    assert not whole.converged.all() and whole.substeps is None
    run = impact(MIDPOINT, 4, tolerance=1e-10)

    def outcome(speeds):
        total, info = run(speeds[0])
        return total, info.converged

    _, info = jax.jit(run)(4.0)
    assert info.substeps[0] > 1 and (info.substeps[1:] == 1).all()
    require_gradient_of_differences(outcome, np.array([4.0]), np.array([1e-5]))
    _, tangent = jax.jit(lambda speed: jax.jvp(lambda speed: run(speed)[0], (speed,), (1.0,)))(4.0)
    ahead, behind = (jax.jit(run)(4.0 + change)[0] for change in (1e-5, -1e-5))
    np.testing.assert_allclose(tangent, (ahead - behind) / 2e-5, rtol=1e-6)


def test_halvings_change_no_step_that_converges_and_report_one_that_fails_in_every_part():
    (plain, info), (halved, info_halved) = (jax.jit(impact(BACKWARD_EULER, halvings))(0.5) for halvings in (0, 3))
    assert info.converged.all() and (info_halved.substeps == 1).all()
    np.testing.assert_array_equal(info.iterations, info_halved.iterations)
    np.testing.assert_allclose(halved, plain, rtol=1e-13)
    _, info = jax.jit(impact(BACKWARD_EULER, 1, iterations=1, tolerance=1e-12))(4.0)
    assert not info.converged[0]


# Rayleigh damping: alpha times the mass and beta times the stiffness.
ALPHA, BETA = 1.5, 2e-3
BAR = beam(1.0, 0.5, 2, 1)
SOLID = elastic(BAR, stable_neo_hookean, youngs_modulus=1e5, poisson_ratio=0.3)
STRAIN_RATE = stiffness_damping(BAR, time=BETA, youngs_modulus=1e5, poisson_ratio=0.3)
MASS = mass_damping(BAR, rate=ALPHA)


@functools.cache
def damped():
    """The scene, and the frequency in rad/s and the shape of its lowest elastic vibration, whose modal mass is 1."""
    bare, scene = make_scene(BAR, [SOLID]), make_scene(BAR, [SOLID, STRAIN_RATE, MASS])
    stiffness = jax.jit(jax.hessian(lambda x: potential(bare, x.reshape(-1, 2), bare.params)))(BAR.vertices.ravel())
    squared, shapes = eigh(np.asarray(stiffness), np.diag(np.repeat(np.asarray(scene.params.masses), 2)))
    # Three rigid motions come first.
    return scene, np.sqrt(squared[3]), shapes[:, 3].reshape(-1, 2)


@pytest.mark.parametrize("integrator", [AVERAGE_VECTOR_FIELD, MIDPOINT], ids=["average", "midpoint"])
def test_a_vibration_decays_at_its_rayleigh_rate(integrator):
    scene, frequency, shape = damped()
    rate = (ALPHA + BETA * frequency**2) / 2
    slower = np.sqrt(frequency**2 - rate**2)
    # After five and a half half-periods, at a maximum of the displacement.
    duration = 5.5 * np.pi / slower
    exact = np.exp(-rate * duration) * np.sin(slower * duration) / slower
    assert 0.2 < np.exp(-rate * duration) < 0.5

    @jax.jit  # one program for every step length
    def end(count):
        init, step = make_step(scene, duration / count, integrator, tolerance=1e-12)
        last = jax.lax.fori_loop(0, count, lambda _, state: step(scene.params, state, None)[0], init(v=1e-6 * shape))
        return jnp.sum(scene.params.masses[:, None] * shape * (last.x - BAR.vertices)) / 1e-6

    coarse, fine = ((end(count) - exact) / abs(exact) for count in (200, 400))
    assert np.log2(coarse / fine) == pytest.approx(2, abs=0.1)
    # Extrapolated to short steps; 0.1 % of beta would change it by as much.
    assert abs(4 * fine - coarse) / 3 < 1e-3


def test_strain_rate_damping_leaves_a_turning_body_alone():
    body = make_scene(BAR, [STRAIN_RATE])
    data = prepare(body, body.params, jnp.asarray(BAR.vertices), dt=0.01)
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    assert abs(value(element_energies(body), BAR.vertices @ turn.T, data)) < 1e-20
    assert value(element_energies(body), 1.01 * BAR.vertices, data) > 1.0


def test_damping_stores_no_energy():
    (scene, *_), bare = damped(), make_scene(BAR, [SOLID])
    stored, without = (jax.jit(lambda x, s=s: potential(s, x, s.params))(1.1 * BAR.vertices) for s in (scene, bare))
    assert float(stored) == pytest.approx(float(without))


def test_point_masses_rebound_with_the_restitution_they_were_given():
    mesh = Mesh(np.array([[0.0, 0.01], [1.0, 0.01]]), np.zeros((0, 3), int))
    ground = plane_contact([0, 1], normal=(0, 1), stiffness=1e4, width=1e-3, damping=1.0)
    body = make_scene(mesh, [ground], masses=[1.0, 3.0])

    def rebounds(integrator):
        """(damping, number of steps, speed) -> speed after the rebound over that before."""

        @jax.jit
        def run(damping, count, speed):
            init, step = make_step(body, 0.15 / count, integrator, tolerance=1e-9)
            params = with_parameters(body.params, ground={"damping": damping})
            start = init(v=speed * jnp.array([0.0, -1.0]))
            last = jax.lax.fori_loop(0, count, lambda _, state: step(params, state, None)[0], start)
            return last.v[:, 1] / speed

        return run

    averaging, euler = rebounds(AVERAGE_VECTOR_FIELD), rebounds(BACKWARD_EULER)
    for restitution in (0.9, 0.5):
        damping = damping_of_restitution(restitution, 2.0)
        np.testing.assert_allclose(averaging(damping, 1500, 2.0), restitution, atol=5e-4)
        np.testing.assert_allclose(euler(damping, 1500, 2.0), restitution, atol=2e-2)
        # Slower, it rebounds better.
        assert (averaging(damping, 150, 1.0) > restitution + 0.02).all()
    assert damping_of_restitution(1.0, 3.0) == 0.0
    for restitution in (0.0, 1.1, np.nan):
        with one_line("restitution is"):
            damping_of_restitution(restitution, 1.0)
