"""Steps and rollouts against closed forms, another library and the laws of symplectic maps; roots of equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

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
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.scenes.scene import closed_form_forward_dynamics
from dln_jax.solvers.newton import find_root
from dln_jax.types import InputError

ARM = two_link_arm()
START = (jnp.array([1.2]), jnp.array([0.3]))
ARM_START = (jnp.array([0.4, 0.9]), jnp.array([-0.5, 1.0]))


def drive(t, q):
    """A pendulum that is pushed: times of the stages matter."""
    return -jnp.sin(q) + 0.6 * jnp.cos(3 * t)


def swing(t, q):
    return -jnp.sin(q)


def arm(t, q, qd):
    return closed_form_forward_dynamics(ARM, q, qd, jnp.array([0.3, -0.2]) * jnp.sin(t))


def rate(t, qd):
    return qd


def with_velocity(force):
    return second_order(lambda t, q, qd: force(t, q))


def euler_of(force):
    return symplectic_euler(lambda t, q, p: p, lambda t, q, p: force(t, q))


ORDERS = {
    "explicit euler": (explicit_euler(with_velocity(drive)), drive, 1),
    "symplectic euler": (euler_of(drive), drive, 1),
    "stormer verlet": (stormer_verlet(rate, drive), drive, 2),
    "rk4": (rk4(with_velocity(drive)), drive, 4),
    "implicit midpoint": (implicit_midpoint(with_velocity(drive)), drive, 2),
    "gauss": (gauss_legendre4(with_velocity(drive)), drive, 4),
    "symplectic euler, arm": (symplectic_euler(lambda t, q, qd: qd, arm), arm, 1),
    "rk4, arm": (rk4(second_order(arm)), arm, 4),
}


@pytest.fixture(scope="module")
def references():
    """States one second after t = 0.5, by the adaptive method of another library."""

    def end(force, start):
        field = jax.jit(lambda t, y: jnp.concatenate([y[len(y) // 2 :], force(t, y)]))
        solution = solve_ivp(field, (0.5, 1.5), np.concatenate(start), method="DOP853", rtol=1e-13, atol=1e-13)
        return solution.y[:, -1]

    return {drive: end(lambda t, y: drive(t, y[:1]), START), arm: end(lambda t, y: arm(t, y[:2], y[2:]), ARM_START)}


@pytest.mark.parametrize("name", ORDERS)
def test_halving_the_step_shows_the_order(name, references):
    step, force, order = ORDERS[name]

    @jax.jit
    def end(steps):
        start = ARM_START if force is arm else START
        dt = 1.0 / steps
        return jax.lax.fori_loop(0, steps, lambda k, state: step(0.5 + k * dt, state, dt), start)

    def error(steps):
        return float(np.linalg.norm(np.concatenate(end(steps)) - references[force]))

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


@pytest.mark.parametrize("name", ["symplectic euler", "stormer verlet", "implicit midpoint", "gauss", "rk4"])
def test_energy_over_a_hundred_thousand_steps(name):
    """Bounded for symplectic steps; drifting without end for a method of higher order that is not."""
    step = {
        "symplectic euler": euler_of(swing),
        "stormer verlet": stormer_verlet(rate, swing),
        "implicit midpoint": implicit_midpoint(with_velocity(swing)),
        "gauss": gauss_legendre4(with_velocity(swing)),
        "rk4": rk4(with_velocity(swing)),
    }[name]
    # 1000 seconds at a hundredth, or 20,000 at a fifth: whatever makes the error of each order visible.
    dt = 0.01 if "euler" in name else 0.2
    t = dt * 250 * jnp.arange(401)
    q, p = jax.jit(lambda: rollout(step, START, t, substeps=250))()
    energy = 0.5 * p[:, 0] ** 2 - jnp.cos(q[:, 0])
    error = np.abs(energy - energy[0])
    early, late = error[:100].max(), error[-100:].max()
    if name == "rk4":
        assert late > 3 * early
    else:
        assert late < 1.05 * early and late < 0.02


@pytest.mark.parametrize("method", [gauss_legendre4, rk4], ids=["gauss", "rk4"])
def test_gauss_methods_keep_quadratic_invariants_exactly(method):
    """Euler's equations of a free rigid body: energy and squared angular momentum."""
    inertia = jnp.array([1.0, 2.0, 3.5])
    step = method(lambda t, y: jnp.cross(y, y / inertia))
    y = jax.jit(lambda: rollout(step, jnp.array([0.5, 1.0, -0.7]), 0.2 * jnp.arange(1001)))()
    energy, momentum = jnp.sum(y**2 / inertia, axis=1), jnp.sum(y**2, axis=1)
    drift = max(float(jnp.ptp(energy)), float(jnp.ptp(momentum)))
    assert float(jnp.ptp(y[:, 0])) > 0.5
    assert drift > 1e-6 if method is rk4 else drift < 1e-13


def test_gradients_through_implicit_steps():
    """By a parameter closed over and by the start, in reverse mode and batched, against central differences."""

    def final(gravity, q):
        step = gauss_legendre4(second_order(lambda t, q, qd: -gravity * jnp.sin(q)))
        q, qd = rollout(step, (q[None], jnp.zeros(1)), jnp.linspace(0.0, 1.0, 6))
        return q[-1, 0] ** 2 + qd[3, 0]

    shift = 1e-4
    points = jnp.array([1.5, 1.1]) + shift * jnp.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(final, argnums=(0, 1))))(*points.T)
    differences = (values[1::2] - values[2::2]) / (2 * shift)
    assert np.abs(differences).min() > 0.1
    np.testing.assert_allclose([gradient[0] for gradient in gradients], differences, rtol=1e-7)


def test_rollout_is_its_steps_in_turn_batched_or_not():
    step = stormer_verlet(rate, drive)
    t = jnp.array([0.3, 0.4, 0.9, 0.7])
    starts = jax.tree.map(lambda leaf: leaf + jnp.arange(3.0)[:, None], START)
    q, p = jax.jit(jax.vmap(lambda *state: rollout(step, state, t, substeps=2)))(*starts)
    step = jax.jit(step)
    for lane in range(3):
        state = jax.tree.map(lambda leaf, lane=lane: leaf[lane], starts)
        for k in range(3):
            np.testing.assert_allclose((q[lane, k], p[lane, k]), state, rtol=1e-14)
            half = (t[k + 1] - t[k]) / 2
            for time in (t[k], t[k] + half):
                state = step(time, state, half)
        np.testing.assert_allclose((q[lane, 3], p[lane, 3]), state, rtol=1e-14)
    with pytest.raises(InputError, match="substeps is 0"):
        rollout(step, START, t, substeps=0)


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
    def integrate(t):
        return adaptive_rollout(lambda t, y: -2 * t * y, jnp.ones(()), t, tolerance=1e-11, max_steps=50)

    program = jax.jit(integrate)
    t = jnp.array([0.0, 0.5, 1.0])
    y, finished = program(t)
    assert finished and not program(500 * t)[1]
    np.testing.assert_allclose(y, np.exp(-(t**2)), rtol=1e-9)


def test_separatrix_energy_stays_within_backward_error():
    """H = p²/2 + g (1 - cos q), released 1e-3 rad below upright; the amplitudes are those of the modified energies.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration" (2006), sections IX.3 and IX.8.
    """
    g, dt = 9.81, 0.01
    methods = {
        "symplectic euler": (euler_of(lambda t, q: -g * jnp.sin(q)), 4 / 3**1.5 * g**1.5 * dt),
        "stormer verlet": (stormer_verlet(rate, lambda t, q: -g * jnp.sin(q)), g**2 * dt**2 / 3),
        "implicit midpoint": (implicit_midpoint(lambda t, y: (y[1], -g * jnp.sin(y[0]))), g**2 * dt**2 / 6),
    }
    for name, (step, amplitude) in methods.items():
        start = (jnp.array([np.pi - 1e-3]), jnp.zeros(1))
        q, p = jax.jit(lambda step=step, start=start: rollout(step, start, dt * jnp.arange(5001)))()
        energy = p**2 / 2 + g * (1 - jnp.cos(q))
        assert jnp.abs(energy - energy[0]).max() < 1.1 * amplitude and jnp.abs(q).max() < np.pi, name


@pytest.mark.slow
def test_close_encounter_keeps_energy_and_collision_is_unfinished():
    """A Kepler orbit of eccentricity 0.999: a position error of the tolerance at r = 1 - e costs tolerance / r²."""
    nearest, tolerance, t = 1e-3, 1e-12, jnp.linspace(0.0, 2 * jnp.pi, 65)
    field = second_order(lambda t, q, qd: -q / jnp.sum(q**2) ** 1.5)

    orbit = jax.jit(lambda *start: adaptive_rollout(field, start, t, tolerance=tolerance))
    start = jnp.array([2.0 - nearest, 0.0]), jnp.array([0.0, (2 / (2.0 - nearest) - 1) ** 0.5])
    (q, qd), finished = orbit(*start)
    energy = 0.5 * jnp.sum(qd**2, axis=1) - 1 / jnp.linalg.norm(q, axis=1)
    assert finished and jnp.abs(energy - energy[0]).max() < 100 * tolerance / nearest**2
    assert not orbit(jnp.array([0.1, 0.0]), jnp.zeros(2))[1]

    def distance_at_end(factor):
        (q, _), _ = adaptive_rollout(field, (start[0], factor * start[1]), t[:49], tolerance=tolerance, max_steps=4096)
        return jnp.sum(q[-1] ** 2)

    far, speed, h = 2.0 - nearest, float(start[1][1]), 1e-6
    ends = [kepler_distance(speed * factor, far, float(t[48])) ** 2 for factor in (1 + h, 1 - h)]
    slope = jax.jit(jax.grad(distance_at_end))(1.0)
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=100 * tolerance / nearest**2)


def kepler_distance(speed, apocentre, t):
    """Distance at the time t on the orbit that starts at its apocentre, by Kepler's equation."""
    axis = 1 / (2 / apocentre - speed**2)
    eccentricity = apocentre / axis - 1
    anomaly = np.pi + t * axis**-1.5
    eccentric = brentq(lambda x: x - eccentricity * np.sin(x) - anomaly, anomaly - 1, anomaly + 1, xtol=1e-15)
    return axis * (1 - eccentricity * np.cos(eccentric))


@pytest.mark.slow
def test_implicit_steps_past_an_encounter_are_solutions_or_nan():
    """The implicit midpoint from the nearest point, with steps of up to a thousand times the time spent there."""
    field, dts = second_order(lambda t, q, qd: -q / jnp.sum(q**2) ** 1.5), jnp.geomspace(1e-4, 1.0, 33)
    start = jnp.array([1e-3, 0.0]), jnp.array([0.0, ((2 - 1e-3) / 1e-3) ** 0.5])
    ends = jax.jit(jax.vmap(lambda dt: implicit_midpoint(field)(0.0, start, dt)))(dts)
    finite = np.isfinite(np.concatenate(ends, axis=1)).all(axis=1)
    middle = [(first + last) / 2 for first, last in zip(start, ends, strict=True)]
    for first, last, rate in zip(start, ends, jax.vmap(lambda *state: field(0.0, state))(*middle), strict=True):
        change = dts[:, None] * rate
        off = jnp.abs(last - first - change).max(axis=1) > 1e-9 * (1 + jnp.abs(change).max(axis=1))
        assert not (np.asarray(off) & finite).any()
    assert finite.any()


def test_roots_have_derivatives_of_higher_order_in_both_modes():
    def cube_root(a):
        return find_root(lambda x, scale: x**3 - scale * a, jnp.array([1.5]), 2.0)[0][0]

    # d^k/da^k (2 a)^(1/3) at a = 1
    expected = 2.0 ** (1 / 3) * np.array([1.0, 1 / 3, -2 / 9])
    for slope in (jax.grad(cube_root), jax.jacfwd(cube_root)):
        got = jax.jit(lambda a, slope=slope: (cube_root(a), slope(a), jax.grad(slope)(a)))(1.0)
        np.testing.assert_allclose(got, expected, rtol=1e-14)


@pytest.mark.parametrize(
    "function, start, tolerance, converged",
    [
        (lambda x: jnp.array([x[0] * x[1] - 2, x[0] - x[1] + 1]), [3.0, 3.0], 0.0, True),
        (lambda x: x**2 - 4, [2.5], 1e-3, True),
        (lambda x: x**2 + 1, [1.5], 0.0, False),
        (lambda x: jnp.log(x), [-1.0], 0.0, False),
        (lambda x: x**2 - 4, [0.0], 0.0, False),
    ],
    ids=["two equations", "loose", "no root", "undefined", "singular"],
)
def test_convergence_is_reported(function, start, tolerance, converged):
    root, info = jax.jit(lambda: find_root(function, jnp.array(start), tolerance=tolerance, iterations=15))()
    assert bool(info.converged) == converged
    assert (np.abs(function(root)).max() < 1e-6) == converged
    if converged:
        assert info.residual <= max(tolerance, 1e-13) and 1 <= info.iterations < 15


def test_requests_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="tolerance is -1"):
        find_root(jnp.sin, jnp.ones(1), tolerance=-1.0)
    with pytest.raises(InputError, match="iterations is 0"):
        find_root(jnp.sin, jnp.ones(1), iterations=0)
    with pytest.raises(InputError, match="tolerance is 0"):
        adaptive_rollout(with_velocity(drive), START, jnp.arange(2.0), tolerance=0.0)
