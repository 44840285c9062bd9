"""Bounces off obstacles with forces that are averages along the step: the energy is kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody import AVERAGE_VECTOR_FIELD, BACKWARD_EULER, make_scene, make_step, potential, with_parameters
from dln_jax.softbody.contact import body_contact, half_space, obstacle_contact, sphere
from dln_jax.softbody.integrators import averaged_moving
from dln_jax.softbody.mesh.shapes import disc
from dln_jax.softbody.scene import contact_energies, prepare_contacts
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.moving import lists_between, moving_gradient, moving_hessians
from dln_jax.types import InputError

SPEED = 2.0


def ball_above(obstacle, height):
    ball = disc(0.5, 2)
    ball = ball._replace(vertices=ball.vertices + np.array([0.0, 0.5 + height]))
    contact = obstacle_contact(ball, obstacle, distance=0.02, stiffness=1e5, name="ground")
    return make_scene(
        ball, [elastic(ball, stable_neo_hookean, youngs_modulus=3e5, poisson_ratio=0.3)], contacts=[contact]
    )


def after_the_bounce(scene, integrator, dt, seconds=0.25, **settings):
    init, step = make_step(scene, dt, integrator, **settings)

    def motion(params):
        start = init(v=[0.0, -SPEED])
        return jax.lax.scan(lambda state, _: step(params, state), start, None, length=round(seconds / dt))

    return motion


def test_an_elastic_ball_keeps_its_energy_in_a_bounce_of_long_steps_and_backward_euler_loses_it():
    scene, energies = ball_above(half_space([0.0, 1.0]), 0.03), {}
    masses = np.asarray(scene.params.masses)
    for integrator in (AVERAGE_VECTOR_FIELD, BACKWARD_EULER):
        motion = jax.jit(after_the_bounce(scene, integrator, 5e-3, tolerance=1e-8))
        state, info = motion(scene.params)
        assert info.converged.all() and float(state.x[:, 1].min()) > 0.1
        assert 0.5 * SPEED < masses @ np.asarray(state.v)[:, 1] / masses.sum() < SPEED
        kinetic = 0.5 * float(masses @ np.sum(np.asarray(state.v) ** 2, axis=1))
        energies[integrator] = kinetic + float(potential(scene, state.x, scene.params))
    before = 0.5 * masses.sum() * SPEED**2
    assert energies[AVERAGE_VECTOR_FIELD] == pytest.approx(before, rel=1e-4)
    assert energies[BACKWARD_EULER] < 0.9 * before


def test_the_average_force_of_an_obstacle_does_the_work_of_its_energy():
    scene = ball_above(sphere([0.0, -1.0], 1.0), 0.015)
    start, (energy,) = scene.params.rest, contact_energies(scene)
    data = prepare_contacts(scene, scene.params, start)
    moving, averages = (averaged_moving(energy),), ((start, data[0]),)
    x = start + jnp.asarray(np.random.default_rng(0).normal(scale=2e-3, size=start.shape)) - jnp.array([0.0, 2e-3])
    lists = lists_between(moving, start, x - start, averages)

    def average(x):
        return moving_gradient(moving, x, lists, averages)

    _, slope = average(x)
    before, after = (moving_gradient((energy,), at, lists, data)[0] for at in (start, x))
    assert float(before) > 0
    assert float(jnp.vdot(slope, x - start)) == pytest.approx(float(after - before), rel=1e-5)
    np.testing.assert_allclose(slope, jax.grad(lambda x: average(x)[0])(x), rtol=1e-9, atol=1e-9 * jnp.abs(slope).max())
    (hessians,) = moving_hessians(moving, x, lists, averages)
    across = jnp.asarray(np.random.default_rng(1).normal(size=x.shape))
    product = jnp.einsum("mij,mj->mi", hessians, across[lists[0].indices[:, 0]])
    expected = jax.jvp(lambda x: average(x)[1], (x,), (across,))[1][lists[0].indices[:, 0]]
    np.testing.assert_allclose(product, expected, rtol=1e-9, atol=1e-9 * jnp.abs(expected).max())


@pytest.mark.slow
def test_the_derivative_of_a_bounce_that_keeps_the_energy_agrees_with_differences():
    scene = ball_above(half_space([0.0, 1.0]), 0.03)
    motion = after_the_bounce(scene, AVERAGE_VECTOR_FIELD, 0.01, seconds=0.2, tolerance=1e-10)
    near = scene.params.terms["ground"]

    def rebound(values):
        ground = {"contact": near.contact._replace(stiffness=values[1])}
        state, info = motion(with_parameters(scene.params, elastic={"youngs_modulus": values[0]}, ground=ground))
        return jnp.sum(scene.params.masses * state.v[:, 1]) / jnp.sum(scene.params.masses), info.converged

    at = jnp.array([3e5, 1e5])
    (_, converged), gradient = jax.jit(jax.value_and_grad(rebound, has_aux=True))(at)
    assert converged.all()
    value = jax.jit(lambda values: rebound(values)[0])
    for place in range(2):
        change = 10.0 * np.eye(2)[place]
        difference = (value(at + change) - value(at - change)) / 20.0
        assert float(gradient[place]) == pytest.approx(float(difference), rel=1e-6)


def test_averages_of_forces_between_bodies_are_refused():
    ball = disc(0.5, 2)
    material = elastic(ball, stable_neo_hookean, youngs_modulus=3e5, poisson_ratio=0.3)
    scene = make_scene(ball, [material], contacts=[body_contact(ball, distance=0.02, stiffness=1e5)])
    with pytest.raises(InputError, match="the pairs that touch change"):
        make_step(scene, 0.01, AVERAGE_VECTOR_FIELD)
