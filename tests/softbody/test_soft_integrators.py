"""The average-vector-field method: energy, order and derivatives; divergence; steps that shorten themselves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import slow_among

from dln_jax.rollout import rollout
from dln_jax.softbody.driven import drive, driven_step
from dln_jax.softbody.examples import drop
from dln_jax.softbody.integrators import AVERAGE_VECTOR_FIELD, BACKWARD_EULER, BDF2, MIDPOINT
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.shapes import disc
from dln_jax.softbody.scene import make_scene, potential
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.types import InputError

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


@pytest.mark.parametrize(("rate", "noise", "turned"), [(2.0, 0.0, 1e-3), (5.0, 2.0, 1e-2), (10.0, 0.0, 3e-3)])
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


@pytest.mark.parametrize(
    "integrator",
    slow_among([AVERAGE_VECTOR_FIELD, MIDPOINT, BDF2, BACKWARD_EULER], lambda one: one is not AVERAGE_VECTOR_FIELD),
)
def test_order(integrator):
    """Against steps of an eighth of the length, from a rotation that also stretches."""
    scene = free_disc()
    start = spinning(5.0, 0.0) + np.array([2.0, 0.0]) * scene.mesh.vertices

    @jax.jit
    def end(count):
        init, step = make_step(scene, 0.05 / count, integrator, tolerance=1e-9)
        state = init(v=start)
        return jax.lax.fori_loop(0, count, lambda _, state: step(scene.params, state, None)[0], state).x

    exact = end(3200)
    coarse, fine = (np.abs(end(count) - exact).max() for count in (200, 400))
    assert np.log2(coarse / fine) == pytest.approx(1 if integrator is BACKWARD_EULER else 2, abs=0.2)


def impact(integrator, halvings, **options):
    """speed -> height and velocity at the end, added, and the outcomes, of a mass that hits a stiff ground."""
    mesh = Mesh(np.array([[0.0, 0.01]]), np.zeros((0, 3), int))
    ground = plane_contact([0], normal=(0, 1), stiffness=1e5, width=1e-3)
    scene = make_scene(mesh, [ground], masses=1.0)
    init, step = make_step(scene, 0.02, integrator, halvings=halvings, **options)

    def run(speed):
        start = init(v=speed * jnp.array([0.0, -1.0]))
        advance, observe = functools.partial(step, scene.params), lambda _, info: info
        last, info = rollout(advance, start, steps=4, observe=observe)
        return last.x[0, 1] + last.v[0, 1], info

    return run


@pytest.mark.slow
def test_a_step_that_fails_is_taken_in_parts_and_has_its_derivatives():
    """The midpoint rule creates energy in the first step of 20 ms, and little in steps of 2.5 ms."""
    _, whole = jax.jit(impact(MIDPOINT, 0))(4.0)
    assert not whole.converged.all() and whole.substeps is None
    run = impact(MIDPOINT, 4, tolerance=1e-10)
    gradient = jax.jit(jax.value_and_grad(run, has_aux=True))
    (_, info), slope = gradient(4.0)
    assert info.converged.all() and info.substeps[0] > 1 and (info.substeps[1:] == 1).all()
    ahead, behind = (gradient(4.0 + change)[0][0] for change in (1e-5, -1e-5))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=1e-6)
    _, tangent = jax.jit(lambda speed: jax.jvp(lambda speed: run(speed)[0], (speed,), (1.0,)))(4.0)
    np.testing.assert_allclose(tangent, slope, rtol=1e-12)


def test_steps_that_converge_are_not_changed_by_halvings():
    (plain, info), (halved, info_halved) = (jax.jit(impact(BACKWARD_EULER, halvings))(0.5) for halvings in (0, 3))
    assert info.converged.all() and (info_halved.substeps == 1).all()
    np.testing.assert_array_equal(info.iterations, info_halved.iterations)
    np.testing.assert_allclose(halved, plain, rtol=1e-13)


def test_a_step_that_fails_in_every_part_is_not_converged():
    _, info = jax.jit(impact(BACKWARD_EULER, 1, iterations=1, tolerance=1e-12))(4.0)
    assert not info.converged[0]


def test_halvings_of_a_method_of_two_steps_are_refused():
    with pytest.raises(InputError, match="halvings"):
        make_step(free_disc(), DT, BDF2, halvings=2)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [BDF2, AVERAGE_VECTOR_FIELD])
def test_a_bouncing_body_raises_no_false_alarm(integrator):
    example = drop()
    init, step = driven_step(example, example.dt, integrator)
    observe = lambda _, info: info  # noqa: E731
    driven = drive(example, example.dt, 500)
    run = jax.jit(lambda params: rollout(functools.partial(step, params), init(), driven, observe=observe)[1])
    assert run(example.scene.params).converged.all()
