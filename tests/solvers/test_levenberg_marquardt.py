"""Levenberg-Marquardt on published problems and closed forms; its normal equations, seeds, and why it ends."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.solvers import levenberg_marquardt
from dln_jax.solvers import normal_equations as equations
from dln_jax.solvers.levenberg_marquardt import Status, init
from dln_jax.solvers.normal_equations import jacobian_bytes


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


# Classic problems (Moré, Garbow and Hillstrom 1981).
NO_DATA = (np.zeros(1),)
BARD = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])


def rosenbrock(x, _):
    return jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(x, _):
    a, b, c, d = x
    return jnp.array([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


def bard(x, u, y):
    return y - (x[0] + u / (x[1] * (16 - u) + x[2] * jnp.minimum(u, 16 - u)))


# Residual of a sample, start, data, sum of squares and parameters at the minimum, and the parameters' tolerance.
PROBLEMS = {
    "rosenbrock": (rosenbrock, [-1.2, 1.0], NO_DATA, 0.0, [1.0, 1.0], 1e-9),
    # Its Jacobian is singular at the minimum, where parameters matter by their fourth power.
    "powell singular": (powell_singular, [3.0, -1.0, 0.0, 1.0], NO_DATA, 0.0, np.zeros(4), 1e-3),
    "bard": (bard, np.ones(3), (np.arange(1.0, 16.0), BARD), 8.21487e-3, [0.08241056, 1.133036, 2.343695], 1e-6),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_classic_problems_have_their_published_minima(name):
    residual, start, data, minimum, expected, tolerance = PROBLEMS[name]
    final = solve(residual, jnp.array(start), data, 150)
    np.testing.assert_allclose(final.loss * len(data[0]), minimum, rtol=1e-5, atol=1e-11)
    np.testing.assert_allclose(final.parameters, expected, rtol=tolerance, atol=tolerance)


def linear(x, row, y):
    return row @ x - y


def linear_problem(samples, parameters, seed=0):
    return np.asarray(uniform(seed, samples, parameters)), np.asarray(uniform(seed + 1, samples))


@pytest.mark.parametrize(
    ("rank", "damping", "falls_back"),
    [(4, 1e-3, False), (4, 1e-18, True), (7, 1e-18, False)],
    ids=["singular, damped", "singular, undamped", "regular, undamped"],
)
def test_rank_deficient_problems_converge_and_fallbacks_are_counted(rank, damping, falls_back):
    basis, y = linear_problem(60, rank)
    rows = basis @ np.asarray(uniform(5, rank, 7)) if rank < 7 else basis
    final = run(linear, init(jnp.ones(7))._replace(damping=jnp.array(damping)), (rows, y), 5)
    expected = np.linalg.lstsq(rows, y)[0]
    np.testing.assert_allclose(final.loss, np.mean((rows @ expected - y) ** 2), rtol=1e-9)
    if rank == 7:
        np.testing.assert_allclose(final.parameters, expected, rtol=1e-9, atol=1e-10)
    assert (final.fallbacks > 0) == falls_back
    # The step has no part in the null space to speak of, though nothing but rounding defines it there.
    assert np.abs(final.parameters).max() < 1e3


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
        together = lambda parameters: jax.vmap(lambda x: residual(parameters, x))(x[:11]).ravel()  # noqa: E731
        sums = equations.normal_equations(residual, parameters, chunks, keep=True)
        return sums, together(parameters), jax.jacobian(together)(parameters)

    (matrix, vector, squares, jacobian), values, rows = jax.tree.map(np.asarray, evaluate(parameters))
    np.testing.assert_allclose(np.tril(matrix), np.tril(rows.T @ rows), atol=1e-11)
    np.testing.assert_allclose(vector, values @ rows, atol=1e-12)
    np.testing.assert_allclose(squares, values @ values, rtol=1e-13)
    sizes = {"samples": 12, "residuals": outputs, "chunk_size": 4}
    kept, not_kept = (jacobian_bytes(parameters, keep=keep, **sizes) for keep in (True, False))
    assert kept - not_kept == jacobian.nbytes


@pytest.mark.parametrize(("gap", "falls_back"), [(0.5, True), (4.0, False)])
def test_a_factor_of_rounding_errors_is_not_used(gap, falls_back):
    """[[1, 1 - gap eps], [1 - gap eps, 1]]: Cholesky succeeds with L_22² = 2 gap eps, and the bound is 2 eps."""
    correlation = 1 - gap * np.finfo(float).eps
    factor, fell_back = equations.factorise(jnp.array([[1.0, 0.0], [correlation, 1.0]]))
    assert fell_back == falls_back
    assert np.isfinite(np.asarray(factor[0])).all()


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


def test_seeds_equal_each_alone_and_one_that_has_stopped_holds_still_while_others_go_on():
    parameters = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(network_parameters, range(4)))
    state = run(network, jax.vmap(init)(parameters), NETWORK_DATA, 12, improvement=STOPPING)
    assert len(set(state.iteration.tolist())) > 1
    for seed in range(4):
        alone = solve(network, network_parameters(seed), NETWORK_DATA, 12, improvement=STOPPING)
        assert (state.iteration[seed], state.status[seed]) == (alone.iteration, alone.status)
        for left, right in zip(jax.tree.leaves(state), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(left[seed], right, rtol=1e-6)


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
    residual, start, data, minimum, *_ = PROBLEMS["bard"]
    final = solve(residual, jnp.array(start), data, 50, improvement=1e-3)
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


def test_single_precision_and_ragged_data_are_refused():
    def single(x, row):
        return (row @ x).astype(jnp.float32)

    for refused, words in (
        (lambda: init(jnp.zeros(2, jnp.float32)), "parameters are float32.*enable_x64"),
        (lambda: solve(single, jnp.zeros(2), (jnp.ones((3, 2)),), 1), "residuals are float32"),
        (lambda: solve(linear, jnp.zeros(2), (jnp.ones((3, 2)), jnp.ones(4)), 1), r"\[3, 4\] samples"),
    ):
        with one_line(words):
            refused()
