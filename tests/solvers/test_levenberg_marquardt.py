"""Levenberg-Marquardt against SciPy and closed forms; its normal equations, seeds, and why it ends."""

import functools
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jax.flatten_util import ravel_pytree

from dln_jax.solvers import levenberg_marquardt
from dln_jax.solvers import normal_equations as equations
from dln_jax.solvers.levenberg_marquardt import Status, init
from dln_jax.solvers.normal_equations import jacobian_bytes
from dln_jax.types import InputError


@functools.cache
def compiled(residual, improvement=0.0):
    """Shared between tests, so that equal programs are compiled once."""
    return jax.jit(functools.partial(levenberg_marquardt.run, residual, improvement=improvement))


def run(residual, state, data, iterations, **settings):
    return compiled(residual, **settings)(state, tuple(map(jnp.asarray, data)), iterations)


def solve(residual, start, data, iterations, **settings):
    return run(residual, init(start), data, iterations, **settings)


@pytest.fixture
def constants(monkeypatch):
    """Sets constants of the module, for programs that are compiled from then on."""

    def set_(**values):
        compiled.cache_clear()
        for name, value in values.items():
            monkeypatch.setattr(levenberg_marquardt, name, value)

    yield set_
    compiled.cache_clear()


def uniform(seed, *shape):
    return jax.random.uniform(jax.random.key(seed), shape, minval=-1.0, maxval=1.0)


def trees_equal(left, right):
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True))


# Classic problems (Moré, Garbow and Hillstrom 1981): residual of a sample, start, data, sum of squares at the minimum.
NO_DATA = (np.zeros(1),)
BARD = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])
KOWALIK_Y = np.array([0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])
KOWALIK_U = np.array([4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])
TIMES = np.linspace(0, 4, 23)


def rosenbrock(x, _):
    return jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(x, _):
    a, b, c, d = x
    return jnp.array([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


def bard(x, u, y):
    return y - (x[0] + u / (x[1] * (16 - u) + x[2] * jnp.minimum(u, 16 - u)))


def kowalik_osborne(x, u, y):
    return y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


def exponential(x, t, y):
    return x["height"] * jnp.exp(-x["rate"] * t) + x["floor"] - y


PROBLEMS = {
    "rosenbrock": (rosenbrock, jnp.array([-1.2, 1.0]), NO_DATA, 0.0, 1e-9),
    # Its Jacobian is singular at the minimum, where parameters matter by their fourth power.
    "powell singular": (powell_singular, jnp.array([3.0, -1.0, 0.0, 1.0]), NO_DATA, 0.0, 1e-3),
    "bard": (bard, jnp.ones(3), (np.arange(1.0, 16.0), BARD), 8.21487e-3, 1e-6),
    "kowalik-osborne": (
        kowalik_osborne,
        jnp.array([0.25, 0.39, 0.415, 0.39]),
        (KOWALIK_U, KOWALIK_Y),
        3.07505e-4,
        1e-5,
    ),
    "exponential": (
        exponential,
        {"height": jnp.array(1.0), "rate": jnp.array(0.3), "floor": jnp.array(0.0)},
        (TIMES, 5 * np.exp(-1.5 * TIMES) + 2 + 0.01 * np.cos(40 * TIMES)),
        None,
        1e-6,
    ),
}


def by_scipy(name):
    residual, start, data, _, _ = PROBLEMS[name]
    x0, unravel = ravel_pytree(start)

    def residuals(x):
        values = jax.vmap(lambda *sample: residual(unravel(x), *sample))(*map(jnp.asarray, data)).ravel()
        return values, values

    both = jax.jit(jax.jacfwd(residuals, has_aux=True))
    solution = scipy.optimize.least_squares(
        lambda x: both(x)[1], x0, lambda x: both(x)[0], method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    return unravel(jnp.asarray(solution.x))


@pytest.mark.parametrize("name", PROBLEMS)
def test_classic_problems_agree_with_scipy(name):
    residual, start, data, minimum, tolerance = PROBLEMS[name]
    final = solve(residual, start, data, 150)
    reference = by_scipy(name)
    squares = jax.vmap(lambda *sample: residual(reference, *sample))(*map(jnp.asarray, data)) ** 2
    total = float(final.loss) * len(data[0])
    np.testing.assert_allclose(total, squares.sum(), rtol=1e-9, atol=1e-11)
    if minimum is not None:
        np.testing.assert_allclose(total, minimum, rtol=1e-5, atol=1e-11)
    for ours, theirs in zip(jax.tree.leaves(final.parameters), jax.tree.leaves(reference), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=tolerance)


def linear(x, row, y):
    return row @ x - y


def linear_problem(samples, parameters, seed=0):
    return np.asarray(uniform(seed, samples, parameters)), np.asarray(uniform(seed + 1, samples))


def test_linear_least_squares_in_few_iterations():
    rows, y = linear_problem(60, 7)
    final = solve(linear, jnp.zeros(7), (rows, y), 6)
    expected = np.linalg.lstsq(rows, y)[0]
    np.testing.assert_allclose(final.parameters, expected, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(final.loss, np.mean((rows @ expected - y) ** 2), rtol=1e-9)
    assert final.fallbacks == 0


def test_a_linear_problem_has_no_acceleration(constants):
    data = linear_problem(60, 7)
    accelerated = solve(linear, jnp.zeros(7), data, 1).parameters
    constants(UPPER_ACCELERATION=0.0)
    np.testing.assert_allclose(accelerated, solve(linear, jnp.zeros(7), data, 1).parameters, rtol=1e-12)


@pytest.mark.parametrize(
    ("rank", "damping", "falls_back"),
    [(4, 1e-3, False), (4, 1e-18, True), (7, 1e-18, False)],
    ids=["singular, damped", "singular, undamped", "regular, undamped"],
)
def test_rank_deficient_problems_converge_and_fallbacks_are_counted(rank, damping, falls_back):
    basis, y = linear_problem(60, rank)
    rows = basis @ np.asarray(uniform(5, rank, 7)) if rank < 7 else basis
    final = run(linear, init(jnp.ones(7))._replace(damping=jnp.array(damping)), (rows, y), 5)
    floor = np.mean((rows @ np.linalg.lstsq(rows, y)[0] - y) ** 2)
    np.testing.assert_allclose(final.loss, floor, rtol=1e-9)
    assert (final.fallbacks > 0) == falls_back
    # The step has no part in the null space to speak of, though nothing but rounding defines it there.
    assert np.abs(final.parameters).max() < 1e3


def test_ill_conditioned_problem(constants):
    """Monomials to degree 9 on [0, 1]: their condition number is 1e7, that of the normal equations 1e14."""
    t = np.linspace(0, 1, 50)
    rows, y = np.vander(t, 10), np.sin(5 * t)
    constants(LOWER_DAMPING=1e-18)
    final = solve(linear, jnp.zeros(10), (rows, y), 60)
    floor = np.mean((rows @ np.linalg.lstsq(rows, y)[0] - y) ** 2)
    assert 1e-15 < floor < 1e-11
    assert final.loss < 1.01 * floor


def network(parameters, x, y):
    """Two outputs of a layer of 6, so that reverse mode has two rows per sample."""
    return jnp.tanh(x @ parameters["in"] + parameters["bias"]) @ parameters["out"] - y


def network_parameters(seed):
    return {"in": 2 * uniform(seed, 3, 6), "bias": uniform(seed + 10, 6), "out": uniform(seed + 20, 6, 2)}


NETWORK_DATA = (uniform(1, 37, 3), jnp.sin(2 * uniform(1, 37, 3)[:, :2]))


@pytest.mark.parametrize("values", [{"CHUNK": 5}, {"CHUNK": 36, "KEPT_BYTES": 0}], ids=" ".join)
def test_chunks_and_what_is_kept_do_not_matter(values, constants):
    whole = solve(network, network_parameters(0), NETWORK_DATA, 6)
    constants(**values)
    state = solve(network, network_parameters(0), NETWORK_DATA, 6)
    np.testing.assert_allclose(state.loss, whole.loss, rtol=1e-8)
    assert whole.loss < 0.05 * np.mean(np.sum(np.asarray(NETWORK_DATA[1]) ** 2, axis=1))
    np.testing.assert_array_equal(state.trials, whole.trials)


@pytest.mark.parametrize(("inputs", "outputs"), [(450, 2), (3, 5)], ids=["reverse, in blocks", "forward"])
def test_normal_equations(inputs, outputs):
    """Against the whole Jacobian: 450 parameters make three rows of blocks; 5 residuals of 3 parameters go forward."""
    mixing = uniform(3, outputs, inputs)
    parameters, x = uniform(4, inputs), uniform(5, 12, inputs)

    def residual(parameters, x):
        return jnp.sin(mixing @ (parameters * x)) + parameters[:outputs].sum()

    chunks = equations.split((x[:11],), 5)
    assert chunks.weights.tolist() == [[1] * 4, [1] * 4, [1] * 3 + [0]]

    @jax.jit
    def evaluate(parameters):
        values = equations.residuals(residual, parameters, chunks)
        sums = equations.normal_equations(residual, parameters, chunks, keep=True)
        products = [
            equations.pull_back(residual, parameters, chunks, jacobian, values) for jacobian in (sums.jacobian, None)
        ]
        together = lambda parameters: jax.vmap(lambda x: residual(parameters, x))(x[:11]).ravel()  # noqa: E731
        return sums, products, together(parameters), jax.jacobian(together)(parameters)

    sums, products, values, rows = jax.tree.map(np.asarray, evaluate(parameters))
    expected = values @ rows
    np.testing.assert_allclose(np.tril(sums.matrix), np.tril(rows.T @ rows), atol=1e-11)
    np.testing.assert_allclose(sums.squares, values @ values, rtol=1e-13)
    for vector in (sums.vector, *products):
        np.testing.assert_allclose(vector, expected, atol=1e-12)
    sizes = {"samples": 12, "residuals": outputs, "chunk_size": 4}
    kept, not_kept = (jacobian_bytes(parameters, keep=keep, **sizes) for keep in (True, False))
    assert kept - not_kept == sums.jacobian.nbytes
    piece = 4 * inputs * (outputs if inputs <= outputs else 1)
    assert not_kept == 8 * (4 * inputs**2 + piece)


def test_factor_of_a_singular_matrix_is_that_of_the_nearest_regular_one():
    basis = np.asarray(uniform(0, 5, 3))
    factor, fell_back = equations.factorise(jnp.tril(basis @ basis.T))
    assert fell_back
    matrix = (factor.lower @ factor.lower.T) / factor.scaling / factor.scaling[:, None]
    np.testing.assert_allclose(matrix, basis @ basis.T, atol=1e-14)
    b = jnp.asarray(basis @ np.ones(3))
    np.testing.assert_allclose(basis @ basis.T @ equations.solve(factor, b), b, rtol=1e-9)


@pytest.mark.parametrize(("gap", "falls_back"), [(0.5, True), (4.0, False)])
def test_a_factor_of_rounding_errors_is_not_used(gap, falls_back):
    """[[1, 1 - gap eps], [1 - gap eps, 1]]: Cholesky succeeds with L_22² = 2 gap eps, and the bound is 2 eps."""
    correlation = 1 - gap * np.finfo(float).eps
    factor, fell_back = equations.factorise(jnp.array([[1.0, 0.0], [correlation, 1.0]]))
    assert fell_back == falls_back
    assert np.isfinite(np.asarray(factor.lower)).all()


def test_acceleration_follows_a_curved_valley(constants):
    """A network on an exactly representable target: a decrease of 1e8 in less than half the iterations."""
    teacher = network_parameters(3)
    data = (NETWORK_DATA[0], jax.vmap(lambda x: network(teacher, x, 0.0))(NETWORK_DATA[0]))
    taken = []
    for acceleration in (0.75, 0.0):
        constants(UPPER_ACCELERATION=acceleration)
        state = init(network_parameters(0))
        while state.loss > 1e-8 and state.iteration < 400:
            state = run(network, state, data, 2)
        taken.append(int(state.iteration))
    assert taken[0] < 0.5 * taken[1]


def test_a_run_in_parts_equals_a_whole_one_bit_for_bit():
    whole = solve(network, network_parameters(0), NETWORK_DATA, 9)
    parts = solve(network, network_parameters(0), NETWORK_DATA, 4)
    assert trees_equal(run(network, parts, NETWORK_DATA, 5), whole)


STOPPING = 0.05
"""An improvement that stops seeds at different iterations."""


@pytest.mark.slow
def test_seeds_vmapped_equal_seeds_looped():
    """Repeatedly and against the clock: batched LAPACK would wedge here."""
    parameters = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(network_parameters, range(4)))
    several = compiled(network, STOPPING)
    together = {}

    def train():
        for _ in range(8):
            together["state"] = several(jax.vmap(init)(parameters), NETWORK_DATA, 8)
            together["mapped"] = jax.vmap(lambda state: several(state, NETWORK_DATA, 8))(jax.vmap(init)(parameters))
        jax.block_until_ready(together)

    thread = threading.Thread(target=train, daemon=True)
    thread.start()
    thread.join(timeout=60)
    assert not thread.is_alive(), "the program of several seeds has not come to an end"
    for seed in range(4):
        state = solve(network, network_parameters(seed), NETWORK_DATA, 8, improvement=STOPPING)
        for of_seeds in together.values():
            for left, right in zip(jax.tree.leaves(of_seeds), jax.tree.leaves(state), strict=True):
                np.testing.assert_allclose(left[seed], right, rtol=1e-6)


def test_a_seed_that_has_stopped_holds_still_while_others_go_on():
    parameters = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(network_parameters, range(4)))
    state = run(network, jax.vmap(init)(parameters), NETWORK_DATA, 12, improvement=STOPPING)
    assert len(set(state.iteration.tolist())) > 1
    for seed in range(4):
        alone = solve(network, network_parameters(seed), NETWORK_DATA, 12, improvement=STOPPING)
        assert (state.iteration[seed], state.status[seed]) == (alone.iteration, alone.status)


def test_the_residual_is_traced_for_one_program_only():
    calls = []

    def counted(*arguments):
        calls.append(1)
        return network(*arguments)

    state = solve(counted, network_parameters(0), NETWORK_DATA, 0)
    first = len(calls)
    assert 0 < first <= 4
    run(counted, run(counted, state, NETWORK_DATA, 2), NETWORK_DATA, 1)
    assert len(calls) == first


def test_no_improvement_to_speak_of_ends_a_run_that_then_holds_still():
    residual, start, data, minimum, _ = PROBLEMS["bard"]
    final = solve(residual, start, data, 50, improvement=1e-3)
    assert final.status == Status.IMPROVEMENT and 3 < final.iteration < 50
    np.testing.assert_allclose(final.loss * 15, minimum, rtol=1e-3)
    assert trees_equal(run(residual, final, data, 1, improvement=1e-3), final)


def test_a_zero_gradient_ends_a_run():
    final = solve(lambda x, _: x**2, jnp.array(0.0), NO_DATA, 5)
    assert final.status == Status.FLAT and final.iteration == 0


@jax.custom_jvp
def misleading(x):
    return 2 + x


misleading.defjvp(lambda primals, tangents: (misleading(*primals), -tangents[0]))


def test_wrong_derivatives_stall():
    final = solve(lambda x, _: misleading(x), jnp.array(0.0), NO_DATA, 9)
    assert final.status == Status.STALLED
    assert (int(final.trials), float(final.parameters), float(final.loss)) == (levenberg_marquardt.TRIALS, 0.0, 4.0)


def test_a_non_finite_trial_is_a_failed_trial():
    """From 20 the undamped step for log(x) = 1 is to -20, where there is no logarithm."""
    start = init(jnp.array(20.0))._replace(damping=jnp.array(1e-12))
    final = run(lambda x, _: jnp.log(x) - 1, start, NO_DATA, 50)
    np.testing.assert_allclose(final.parameters, np.e, rtol=1e-8)
    assert final.trials > final.iteration


@jax.custom_jvp
def treacherous(x):
    """x, whose derivative is not finite below 0.1."""
    return x


treacherous.defjvp(lambda primals, tangents: (primals[0], jnp.where(primals[0] < 0.1, jnp.nan, tangents[0])))


def test_what_is_not_finite_stops_with_the_last_good_state():
    start = init(jnp.array(1.0))._replace(damping=jnp.array(1.0))
    final = run(lambda x, _: treacherous(x), start, NO_DATA, 50)
    assert final.status == Status.NON_FINITE
    assert 0 < final.parameters < 0.1 and final.iteration > 0
    assert trees_equal(run(lambda x, _: treacherous(x), start, NO_DATA, final.iteration).parameters, final.parameters)
    bad = jnp.asarray(NETWORK_DATA[1]).at[3].set(jnp.nan)
    final = solve(network, network_parameters(0), (NETWORK_DATA[0], bad), 5)
    assert (final.status, final.iteration) == (Status.NON_FINITE, 0)
    assert trees_equal(final.parameters, network_parameters(0))


REFUSED = {
    "float32 parameters": (lambda: init(jnp.zeros(2, jnp.float32)), "parameters are float32.*enable_x64"),
    "float32 residuals": (
        lambda: solve(lambda x, row: (row @ x).astype(jnp.float32), jnp.zeros(2), (jnp.ones((3, 2)),), 1),
        "residuals are float32",
    ),
    "ragged": (lambda: solve(linear, jnp.zeros(2), (jnp.ones((3, 2)), jnp.ones(4)), 1), r"\[3, 4\] samples"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    call, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        call()
