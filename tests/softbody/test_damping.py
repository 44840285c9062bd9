"""Damping terms: decay rates of vibrations, rigid motions, and the rebound of a point mass, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

from dln_jax.rollout import rollout
from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.integrators import AVERAGE_VECTOR_FIELD, BACKWARD_EULER, MIDPOINT
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import element_energies, make_scene, potential, prepare
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.damping import mass_damping, stiffness_damping
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.penalty import damping_of_restitution
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.energies import value
from dln_jax.types import InputError

E, NU, ALPHA, BETA = 1e5, 0.3, 1.5, 2e-3
MESH = beam(1.0, 0.5, 2, 1)


@functools.cache
def scene(damped=True):
    solid = elastic(MESH, stable_neo_hookean, youngs_modulus=E, poisson_ratio=NU)
    if not damped:
        return make_scene(MESH, [solid])
    strain_rate = stiffness_damping(MESH, time=BETA, youngs_modulus=E, poisson_ratio=NU)
    return make_scene(MESH, [solid, strain_rate, mass_damping(MESH, rate=ALPHA)])


@functools.cache
def vibration():
    """Frequency in rad/s and shape of the lowest elastic vibration, whose modal mass is 1."""
    masses = np.repeat(np.asarray(scene().params.masses), 2)
    bare = scene(damped=False)
    stiffness = jax.hessian(lambda x: potential(bare, x.reshape(-1, 2), bare.params))(bare.params.rest.ravel())
    squared, shapes = eigh(np.asarray(stiffness), np.diag(masses))
    # Three rigid motions come first.
    return np.sqrt(squared[3]), shapes[:, 3].reshape(-1, 2)


def decaying(integrator, duration, amplitude=1e-6):
    """steps -> the modal coordinate over the amplitude at the end, from the rest shape in motion."""
    _, shape = vibration()

    @jax.jit  # one program for every step length
    def end(count):
        init, step = make_step(scene(), duration / count, integrator, tolerance=1e-12)
        return jax.lax.fori_loop(
            0, count, lambda _, state: step(scene().params, state, None)[0], init(v=amplitude * shape)
        ).x

    weights = np.asarray(scene().params.masses)[:, None] * shape / amplitude
    return lambda count: np.sum(weights * (np.asarray(end(count)) - MESH.vertices))


@pytest.mark.parametrize("integrator", [AVERAGE_VECTOR_FIELD, MIDPOINT])
def test_a_vibration_decays_at_its_rayleigh_rate(integrator):
    frequency, _ = vibration()
    rate = (ALPHA + BETA * frequency**2) / 2
    damped = np.sqrt(frequency**2 - rate**2)
    # After five and a half half-periods, at a maximum of the displacement.
    duration = 5.5 * np.pi / damped
    exact = np.exp(-rate * duration) * np.sin(damped * duration) / damped
    assert 0.2 < np.exp(-rate * duration) < 0.5
    end = decaying(integrator, duration)
    coarse, fine = ((end(count) - exact) / abs(exact) for count in (200, 400))
    assert np.log2(coarse / fine) == pytest.approx(2, abs=0.1)
    # Extrapolated to short steps; 0.1 % of beta would change it by as much.
    assert abs(4 * fine - coarse) / 3 < 1e-3


def test_strain_rate_damping_leaves_a_turning_body_alone_and_mass_damping_does_not():
    turning = np.stack([-MESH.vertices[:, 1], MESH.vertices[:, 0]], axis=1)

    def kept(term):
        body = make_scene(MESH, [term])
        init, step = make_step(body, 0.01, AVERAGE_VECTOR_FIELD, tolerance=1e-10)
        run = jax.jit(lambda state: rollout(functools.partial(step, body.params), state, steps=20)[0].v)
        v = run(init(v=turning - turning.mean(axis=0)))
        masses, first = np.asarray(body.params.masses), turning - turning.mean(axis=0)
        return float(masses @ np.sum(np.asarray(v) ** 2, axis=1)) / float(masses @ np.sum(first**2, axis=1))

    assert kept(mass_damping(MESH, rate=ALPHA)) == pytest.approx(np.exp(-2 * ALPHA * 0.2), rel=1e-4)
    x = jnp.asarray(MESH.vertices)
    turn = jnp.array([[jnp.cos(0.3), -jnp.sin(0.3)], [jnp.sin(0.3), jnp.cos(0.3)]])
    term = stiffness_damping(MESH, time=BETA, youngs_modulus=E, poisson_ratio=NU)
    body = make_scene(MESH, [term])
    data = prepare(body, body.params, x, dt=0.01)
    assert abs(value(element_energies(body), x @ turn.T, data)) < 1e-20
    assert value(element_energies(body), 1.01 * x, data) > 1.0


def test_a_static_solve_has_no_damping():
    x, info = static_solve(scene(), scene().params, x=scene().params.rest)
    assert info.converged
    np.testing.assert_allclose(x, MESH.vertices, atol=1e-12)
    assert potential(scene(), 1.1 * scene().params.rest, scene().params) == pytest.approx(
        float(potential(scene(False), 1.1 * scene().params.rest, scene(False).params))
    )


def rebound(damping, dt, integrator, speed=2.0):
    """Speed after the rebound over that before, of point masses 1 cm above the ground."""
    mesh = Mesh(np.array([[0.0, 0.01], [1.0, 0.01]]), np.zeros((0, 3), int))
    ground = plane_contact([0, 1], normal=(0, 1), stiffness=1e4, width=1e-3, damping=damping)
    body = make_scene(mesh, [ground], masses=[1.0, 3.0])
    init, step = make_step(body, dt, integrator, tolerance=1e-9)
    run = jax.jit(lambda state: rollout(functools.partial(step, body.params), state, steps=round(0.15 / dt))[0].v)
    return np.asarray(run(init(v=(0.0, -speed))))[:, 1] / speed


@pytest.mark.parametrize("restitution", [0.9, 0.5])
def test_a_point_mass_rebounds_with_the_restitution_it_was_given(restitution):
    damping = damping_of_restitution(restitution, 2.0)
    coarse, fine = (rebound(damping, dt, AVERAGE_VECTOR_FIELD) for dt in (1e-3, 1e-4))
    np.testing.assert_allclose(fine, restitution, atol=5e-4)
    np.testing.assert_allclose(coarse, restitution, atol=2e-2)
    np.testing.assert_allclose(rebound(damping, 1e-4, BACKWARD_EULER), restitution, atol=2e-2)
    # Slower, it rebounds better.
    assert (rebound(damping, 1e-3, AVERAGE_VECTOR_FIELD, speed=1.0) > coarse).all()


def test_impossible_restitutions_are_refused():
    assert damping_of_restitution(1.0, 3.0) == 0.0
    for restitution in (-0.1, 0.0, 1.1, np.nan):
        with pytest.raises(InputError, match="restitution is"):
            damping_of_restitution(restitution, 1.0)


def test_absent_damping_is_not_traced():
    def size(terms):
        body = make_scene(MESH, terms)
        init, step = make_step(body, 0.01)
        return len(str(jax.make_jaxpr(step)(body.params, init())))

    ground = lambda **options: plane_contact(range(6), normal=(0, 1), stiffness=1e4, width=1e-3, **options)  # noqa: E731
    assert size([ground()]) < 0.9 * size([ground(damping=0.1)])
