"""Steps against another library and the laws of symplectic maps; rollouts; roots of equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from scipy.integrate import solve_ivp

from dln_jax.mechanics.integrators import (
    adaptive_rollout,
    explicit_euler,
    gauss_legendre4,
    implicit_midpoint,
    rk4,
    rollout,
    second_order,
    stormer_verlet,
    symplectic_euler,
)
from dln_jax.solvers.newton import find_root

START = (jnp.array([1.2]), jnp.array([0.3]))


def drive(t, q):
    """A pendulum that is pushed: times of the stages matter."""
    return -jnp.sin(q) + 0.6 * jnp.cos(3 * t)


def swing(t, q):
    return -jnp.sin(q)


def damped(t, q, qd):
    return drive(t, q) - 0.3 * qd


def rate(t, qd):
    return qd


def euler_of(force):
    return symplectic_euler(lambda t, q, p: p, lambda t, q, p: force(t, q))


ORDERS = {
    "explicit euler": (explicit_euler(second_order(damped)), 1),
    "symplectic euler": (symplectic_euler(lambda t, q, qd: qd, damped), 1),
    "stormer verlet": (stormer_verlet(rate, drive), 2),
    "rk4": (rk4(second_order(damped)), 4),
    "implicit midpoint": (implicit_midpoint(second_order(damped)), 2),
    "gauss": (gauss_legendre4(second_order(damped)), 4),
}


@pytest.mark.parametrize("name", ORDERS)
def test_halving_the_step_shows_the_order(name):
    """Against the state one second after t = 0.5 by the adaptive method of another library."""
    step, order = ORDERS[name]
    friction = 0.0 if name == "stormer verlet" else 0.3

    def field(t, y):
        return y[1], -np.sin(y[0]) + 0.6 * np.cos(3 * t) - friction * y[1]

    reference = solve_ivp(field, (0.5, 1.5), np.concatenate(START), method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]

    @jax.jit
    def end(steps):
        dt = 1.0 / steps
        return jax.lax.fori_loop(0, steps, lambda k, state: step(0.5 + k * dt, state, dt), START)

    def error(steps):
        return float(np.linalg.norm(np.concatenate(end(steps)) - reference))

    coarse, fine = (40, 80) if order == 4 else (160, 320)
    assert np.log2(error(coarse) / error(fine)) == pytest.approx(order, abs=0.2)
    assert error(fine) < 0.05


def coupled(t, state):
    """Hamilton's equations of a Hamiltonian that is not separable, H = (1 + q²) p² / 2 + q⁴ / 4."""
    q, p = state
    return (1 + q**2) * p, -q * p**2 - q**3


LAWS = {
    "symplectic euler": (euler_of(swing), True, False),
    "stormer verlet": (stormer_verlet(rate, swing), True, True),
    "implicit midpoint": (implicit_midpoint(coupled), True, True),
    "gauss": (gauss_legendre4(coupled), True, True),
    "rk4": (rk4(coupled), False, False),
}


@pytest.mark.parametrize("name", LAWS)
def test_which_steps_preserve_area_and_can_be_reversed(name):
    step, symplectic, reversible = LAWS[name]

    @jax.jit
    def map_and_area(z, t, dt):
        def flat(z):
            q, p = step(t, (z[:1], z[1:]), dt)
            return jnp.concatenate([q, p])

        return flat(z), jnp.linalg.det(jax.jacfwd(flat)(z))

    start = jnp.concatenate(START)
    end, area = map_and_area(start, 0.0, 0.3)
    difference = map_and_area(end, 0.3, -0.3)[0] - start
    # For one degree of freedom, symplectic is area-preserving.
    assert (abs(area - 1) < 1e-13) == symplectic, area
    assert (np.abs(difference).max() < 1e-13) == reversible, difference


def test_symplectic_steps_conserve_energy_near_the_separatrix():
    """1e5 steps of H = p²/2 - cos q from 1e-3 rad below upright; the amplitudes are those of the modified energies.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration" (2006), sections IX.3 and IX.8.
    """
    dt, start = 0.2, (jnp.array([np.pi - 1e-3]), jnp.zeros(1))

    def swinging(t, state):
        return state[1], swing(t, state[0])

    def error(step):
        def turn(_, carried):
            (q, p), largest = carried
            change = jnp.sum(p**2 / 2 - jnp.cos(q)) + jnp.cos(start[0][0])
            return step(0.0, (q, p), dt), jnp.maximum(largest, jnp.abs(change))

        return float(jax.jit(lambda: jax.lax.fori_loop(0, 100_000, turn, (start, 0.0)))()[1])

    for step, amplitude in (
        (euler_of(swing), 4 / 3**1.5 * dt),
        (stormer_verlet(rate, swing), dt**2 / 3),
        (implicit_midpoint(swinging), dt**2 / 6),
    ):
        assert error(step) < 1.05 * amplitude
    assert error(rk4(swinging)) > dt**2, "of order four, but it drifts"


def test_velocities_that_depend_on_time_are_taken_in_the_middle_of_a_verlet_step():
    step = stormer_verlet(lambda t, p: 3 * t**2 + 0 * p, lambda t, q: 0 * q)
    q, _ = rollout(step, (jnp.zeros(1), jnp.zeros(1)), jnp.linspace(0.0, 1.0, 11))
    np.testing.assert_allclose(q[-1], 1 - 0.1**2 / 4, rtol=1e-12)


def test_rollout_is_its_steps_in_turn():
    step, t, state = stormer_verlet(rate, drive), jnp.array([0.3, 0.4, 0.9, 0.7]), START
    q, p = jax.jit(lambda: rollout(step, START, t, substeps=2))()
    for k in range(4):
        np.testing.assert_allclose((q[k], p[k]), state, rtol=1e-14)
        half = (t[min(k + 1, 3)] - t[k]) / 2
        for time in (t[k], t[k] + half):
            state = step(time, state, half)


@pytest.mark.as_users_compile
def test_single_precision_states_stay_so_and_converge():
    state = {"angle": jnp.float32(1.0), "rate": jnp.zeros((), jnp.float32)}
    step = implicit_midpoint(lambda t, y: {"angle": y["rate"], "rate": -y["angle"]})
    states = jax.jit(lambda: rollout(step, state, jnp.linspace(0.0, 3.0, 31)))()
    energy = states["rate"] ** 2 + states["angle"] ** 2
    assert energy.dtype == jnp.float32
    assert np.abs(energy - 1.0).max() < 1e-5 and states["angle"][-1] < -0.9


def test_a_step_that_is_not_solved_is_not_a_number():
    blow_up = jax.jit(implicit_midpoint(lambda t, y: y**2))
    y, dt = jnp.ones(1), 0.3
    middle = (1 - jnp.sqrt(1 - 2 * dt)) / dt
    np.testing.assert_allclose(blow_up(0.0, y, dt), y + dt * middle**2, rtol=1e-14)
    assert np.isnan(blow_up(0.0, y, 10.0)).all()


def test_the_adaptive_rollout_is_accurate_or_says_that_it_did_not_finish():
    @jax.jit
    def program(t):
        return adaptive_rollout(lambda t, y: -2 * t * y, jnp.ones(()), t, tolerance=1e-11, max_steps=50)

    t = jnp.array([0.0, 0.5, 1.0])
    y, finished = program(t)
    assert finished and not program(500 * t)[1]
    np.testing.assert_allclose(y, np.exp(-(t**2)), rtol=1e-9)


def test_roots_have_derivatives_of_higher_order_in_both_modes():
    def cube_root(a):
        return find_root(lambda x, scale: x**3 - scale * a, jnp.array([1.5]), 2.0)[0][0]

    # d^k/da^k (2 a)^(1/3) at a = 1
    expected = 2.0 ** (1 / 3) * np.array([1.0, 1 / 3, -2 / 9])
    for slope in (jax.grad(cube_root), jax.jacfwd(cube_root)):
        got = jax.jit(lambda a, slope=slope: (cube_root(a), slope(a), jax.grad(slope)(a)))(1.0)
        np.testing.assert_allclose(got, expected, rtol=1e-14)


def test_convergence_is_reported():
    for function, start, tolerance, converged in [
        (lambda x: jnp.array([x[0] * x[1] - 2, x[0] - x[1] + 1]), [3.0, 3.0], 0.0, True),
        (lambda x: x**2 - 4, [2.5], 1e-3, True),
        (lambda x: x**2 + 1, [1.5], 0.0, False),
        (lambda x: jnp.log(x), [-1.0], 0.0, False),
        (lambda x: x**2 - 4, [0.0], 0.0, False),
    ]:
        root, info = find_root(function, jnp.array(start), tolerance=tolerance, iterations=15)
        assert bool(info.converged) == converged
        assert (np.abs(function(root)).max() < 1e-6) == converged
        if converged:
            assert info.residual <= max(tolerance, 1e-13) and 1 <= info.iterations < 15


def test_requests_that_make_no_sense_are_refused():
    t = jnp.arange(2.0)
    for call, message in [
        (lambda: find_root(jnp.sin, jnp.ones(1), tolerance=-1.0), "tolerance is -1"),
        (lambda: find_root(jnp.sin, jnp.ones(1), iterations=0), "iterations is 0"),
        (lambda: adaptive_rollout(second_order(damped), START, t, tolerance=0.0), "tolerance is 0"),
        (lambda: rollout(stormer_verlet(rate, drive), START, t, substeps=0), "substeps is 0"),
    ]:
        with one_line(message):
            call()
