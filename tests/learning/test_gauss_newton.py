"""Levenberg-Marquardt against optimistix and closed forms; resume, seeds, stops and reasons."""

import functools
import operator
import threading

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from jax.flatten_util import ravel_pytree

from dln_jax.learning.engine.gauss_newton import Status, jacobian_bytes, make_levenberg_marquardt, minimise
from dln_jax.solvers import normal_equations as equations
from dln_jax.types import InputError


@functools.cache
def make(residual, **settings):
    """Shared between tests, so that equal programs are compiled once."""
    return make_levenberg_marquardt(residual, **settings)


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


@functools.cache
def by_optimistix(name):
    residual, start, data, _, _ = PROBLEMS[name]
    return optimistix.least_squares(
        lambda x, arrays: jax.vmap(lambda *sample: residual(x, *sample))(*arrays),
        optimistix.LevenbergMarquardt(rtol=1e-13, atol=1e-13),
        start,
        tuple(map(jnp.asarray, data)),
        max_steps=1000,
        throw=False,
    ).value


PLAIN = {"acceleration": 0.0, "scaling": "diagonal"}


@pytest.mark.parametrize(("name", "settings"), [*((name, {}) for name in PROBLEMS), ("exponential", PLAIN)])
def test_classic_problems_agree_with_optimistix(name, settings):
    residual, start, data, minimum, tolerance = PROBLEMS[name]
    optimiser = make(residual, **settings)
    result = minimise(optimiser, optimiser.init(start), data, iterations=150, dispatch=150)
    reference = by_optimistix(name)
    squares = jax.vmap(lambda *sample: residual(reference, *sample))(*map(jnp.asarray, data)) ** 2
    total = float(result.value) * len(data[0])
    np.testing.assert_allclose(total, squares.sum(), rtol=1e-9, atol=1e-11)
    if minimum is not None:
        np.testing.assert_allclose(total, minimum, rtol=1e-5, atol=1e-11)
    for ours, theirs in zip(jax.tree.leaves(result.parameters), jax.tree.leaves(reference), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=tolerance)


def test_diagonal_scaling_is_the_running_maximum():
    residual, start, data, *_ = PROBLEMS["exponential"]
    arrays = tuple(map(jnp.asarray, data))
    optimiser = make(residual, **PLAIN)
    state, largest, fell = optimiser.init(start), np.zeros(3), False
    for _ in range(6):
        rows = jax.vmap(lambda *sample: ravel_pytree(jax.grad(residual)(*sample))[0], (None, 0, 0))(
            state.parameters, *arrays
        )
        diagonal = np.mean(np.asarray(rows) ** 2, axis=0)
        fell |= bool(np.any(diagonal < 0.9 * largest))
        largest = np.maximum(largest, diagonal)
        state = optimiser.step(state, arrays)
        np.testing.assert_allclose(state.scale, largest, rtol=1e-10)
    assert fell


def linear(x, row, y):
    return row @ x - y


def linear_problem(samples, parameters, seed=0):
    return np.asarray(uniform(seed, samples, parameters)), np.asarray(uniform(seed + 1, samples))


@pytest.mark.parametrize("ridge", [0.0, 0.05])
def test_linear_least_squares_in_few_iterations(ridge):
    rows, y = linear_problem(60, 7)
    optimiser = make(linear, ridge=ridge)
    result = minimise(optimiser, optimiser.init(jnp.zeros(7)), (rows, y), iterations=6)
    stacked = np.concatenate([rows, np.sqrt(60 * ridge) * np.eye(7)])
    expected = np.linalg.lstsq(stacked, np.concatenate([y, np.zeros(7)]))[0]
    np.testing.assert_allclose(result.parameters, expected, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(result.value, np.mean((rows @ expected - y) ** 2), rtol=1e-9)  # without the ridge
    assert result.statistics.fallbacks == 0


def test_a_linear_problem_has_no_acceleration():
    data = tuple(map(jnp.asarray, linear_problem(60, 7)))
    accelerated, plain = (
        optimiser.run(optimiser.init(jnp.zeros(7)), data, 1).parameters
        for optimiser in (make(linear, ridge=0.05), make(linear, ridge=0.05, acceleration=0.0))
    )
    np.testing.assert_allclose(accelerated, plain, rtol=1e-12)


@pytest.mark.parametrize(
    ("rank", "damping", "falls_back"),
    [(4, 1e-3, False), (4, 1e-18, True), (7, 1e-18, False)],
    ids=["singular, damped", "singular, undamped", "regular, undamped"],
)
def test_rank_deficient_problems_converge_and_fallbacks_are_counted(rank, damping, falls_back):
    basis, y = linear_problem(60, rank)
    rows = basis @ np.asarray(uniform(5, rank, 7)) if rank < 7 else basis
    optimiser = make(linear, ridge=0.0)
    state = optimiser.init(jnp.ones(7))._replace(damping=jnp.array(damping))
    result = minimise(optimiser, state, (rows, y), iterations=5)
    floor = np.mean((rows @ np.linalg.lstsq(rows, y)[0] - y) ** 2)
    np.testing.assert_allclose(result.value, floor, rtol=1e-9)
    assert (result.statistics.fallbacks > 0) == falls_back
    # The step has no part in the null space to speak of, though nothing but rounding defines it there.
    assert np.abs(result.parameters).max() < 1e3


def test_ill_conditioned_problem():
    """Monomials to degree 9 on [0, 1]: their condition number is 1e7, that of the normal equations 1e14."""
    t = np.linspace(0, 1, 50)
    rows, y = np.vander(t, 10), np.sin(5 * t)
    optimiser = make(linear, least_damping=1e-18)
    result = minimise(optimiser, optimiser.init(jnp.zeros(10)), (rows, y), iterations=60)
    floor = np.mean((rows @ np.linalg.lstsq(rows, y)[0] - y) ** 2)
    assert 1e-15 < floor < 1e-11
    assert result.value < 1.01 * floor


def network(parameters, x, y):
    """Two outputs of a layer of 6, so that reverse mode has two rows per sample."""
    return jnp.tanh(x @ parameters["in"] + parameters["bias"]) @ parameters["out"] - y


def network_parameters(seed):
    return {"in": 2 * uniform(seed, 3, 6), "bias": uniform(seed + 10, 6), "out": uniform(seed + 20, 6, 2)}


NETWORK_DATA = (uniform(1, 37, 3), jnp.sin(2 * uniform(1, 37, 3)[:, :2]))


@pytest.fixture(scope="module")
def whole():
    optimiser = make(network)
    return optimiser.run(optimiser.init(network_parameters(0)), NETWORK_DATA, 6)


@pytest.mark.parametrize(
    "settings",
    [{"chunk_size": 5, "rows": 37}, {"chunk_size": 36, "kept_bytes": 0}],
    ids=lambda settings: " ".join(settings),
)
def test_chunks_and_what_is_kept_do_not_matter(whole, settings):
    optimiser = make(network, **settings)
    state = optimiser.run(optimiser.init(network_parameters(0)), NETWORK_DATA, 6)
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

    chunks = equations.split((x,), jnp.arange(11), 5)
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


def test_acceleration_follows_a_curved_valley():
    """A network on an exactly representable target: a decrease of 1e8 in less than half the iterations."""
    teacher = network_parameters(3)
    data = (NETWORK_DATA[0], jax.vmap(lambda x: network(teacher, x, 0.0))(NETWORK_DATA[0]))
    taken = []
    for acceleration in (0.75, 0.0):
        optimiser = make(network, acceleration=acceleration)
        state = optimiser.init(network_parameters(0))
        while state.loss > 1e-8 and state.iteration < 400:
            state = optimiser.run(state, data, 2)
        taken.append(int(state.iteration))
    assert taken[0] < 0.5 * taken[1]


def test_rows_are_drawn_anew_and_reproducibly():
    optimiser = make(network, rows=30, chunk_size=7)
    first, again, other = (
        optimiser.run(optimiser.init(network_parameters(0), jax.random.key(seed)), NETWORK_DATA, 3)
        for seed in (1, 1, 2)
    )
    assert trees_equal(first, again)
    assert not trees_equal(first.parameters, other.parameters)
    # With one draw for all iterations, the loss at the start of an iteration would be the one at the end of the last.
    one = optimiser.run(optimiser.init(network_parameters(0), jax.random.key(1)), NETWORK_DATA, 1)
    assert trees_equal(optimiser.run(one, NETWORK_DATA, 2), first)
    everything = jax.vmap(lambda *sample: network(first.parameters, *sample))(*NETWORK_DATA)
    assert abs(first.loss - jnp.mean(jnp.sum(everything**2, axis=1))) > 1e-6


def test_seeds_vmapped_equal_seeds_looped():
    """Repeatedly and against the clock: batched LAPACK would wedge here."""
    optimiser = make(network, rows=30, chunk_size=7)
    parameters = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(network_parameters, range(4)))
    keys = jax.random.split(jax.random.key(0), 4)
    together = {}

    def train():
        for _ in range(15):
            state = jax.vmap(optimiser.init)(parameters, keys)
            together["state"] = jax.vmap(lambda state: optimiser.run(state, NETWORK_DATA, 8))(state)
        jax.block_until_ready(together)

    thread = threading.Thread(target=train, daemon=True)
    thread.start()
    thread.join(timeout=60)
    assert not thread.is_alive(), "the program of several seeds has not come to an end"
    for seed in range(4):
        state = optimiser.run(optimiser.init(network_parameters(seed), keys[seed]), NETWORK_DATA, 8)
        for left, right in zip(jax.tree.leaves(together["state"]), jax.tree.leaves(state), strict=True):
            np.testing.assert_allclose(left[seed], right, rtol=1e-6)


def test_minimise_several_seeds():
    parameters = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(network_parameters, range(3)))
    optimiser = make(network, gradient_tolerance=0.02)
    seen = []

    def size(parameters):
        return sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(parameters))

    state = jax.vmap(lambda parameters: optimiser.init(parameters))(parameters)
    result = minimise(
        optimiser,
        state,
        NETWORK_DATA,
        iterations=12,
        dispatch=2,
        validation=size,
        on_dispatch=lambda _, at: seen.append(at),
    )
    assert result.reason.count("\n") == 2
    for seed in range(3):
        validations = [progress.validation[seed] for progress in seen]
        assert result.value[seed] == min(validations)
        ours = jax.tree.map(operator.itemgetter(seed), result.parameters)
        np.testing.assert_allclose(size(ours), min(validations))
    # A seed that has reached its tolerance holds still while the others go on.
    assert len(set(result.statistics.iterations.tolist())) > 1
    assert set(result.status.tolist()) <= {Status.GRADIENT, Status.ITERATIONS}


def test_a_run_resumes_bit_for_bit(capsys):
    optimiser = make(network, rows=30, chunk_size=7)
    stored, seen = [], []
    settings = {
        "dispatch": 4,
        "validation": lambda parameters: jnp.abs(jnp.sum(parameters["out"])),
        "on_dispatch": lambda state, at: (stored.append(jax.tree.map(np.asarray, state)), seen.append(at)),
    }
    start = optimiser.init(network_parameters(0), jax.random.key(7))
    unbroken = minimise(optimiser, start, NETWORK_DATA, iterations=14, **settings)
    assert [int(progress.iteration) for progress in seen] == [4, 8, 12, 14]
    expected = [abs(float(np.sum(state.parameters["out"]))) for state in stored]
    np.testing.assert_allclose([float(progress.validation) for progress in seen], expected, rtol=1e-12)
    assert unbroken.value == min(progress.validation for progress in seen)
    assert unbroken.value < seen[-1].validation  # the best is not simply the last
    resumed = minimise(
        optimiser,
        jax.tree.map(jnp.asarray, stored[1]),
        NETWORK_DATA,
        iterations=14,
        **settings,
    )
    assert trees_equal(unbroken.state, resumed.state)
    assert trees_equal(unbroken.parameters, resumed.parameters)
    assert resumed.status == Status.ITERATIONS
    assert capsys.readouterr() == ("", "")


def test_the_residual_is_traced_for_one_program_only():
    calls = []

    def counted(*arguments):
        calls.append(1)
        return network(*arguments)

    optimiser = make(counted, rows=30)
    state = optimiser.run(optimiser.init(network_parameters(0)), NETWORK_DATA, 0)
    first = len(calls)
    assert 0 < first <= 4
    minimise(optimiser, state, tuple(map(np.asarray, NETWORK_DATA)), iterations=3, dispatch=2)
    assert len(calls) == first


@jax.custom_jvp
def misleading(x):
    return 2 + x


misleading.defjvp(lambda primals, tangents: (misleading(*primals), -tangents[0]))
STOPS = {
    "gradient": ({"gradient_tolerance": 1e-6}, {}, Status.GRADIENT),
    "step": ({"step_tolerance": 1e-4}, {}, Status.STEP),
    "improvement": ({"improvement_tolerance": 1e-3}, {}, Status.IMPROVEMENT),
    "iterations": ({}, {"iterations": 3}, Status.ITERATIONS),
    "no iterations": ({}, {"iterations": 0}, Status.ITERATIONS),
    # The clock ticks once a look: at the start, after compiling, before each dispatch.
    "time": ({}, {"seconds": 4.5, "clock": None}, Status.TIME),
}


@pytest.mark.parametrize("name", STOPS)
def test_stop_rules(name):
    settings, limits, expected = STOPS[name]
    if "clock" in limits:
        ticks = iter(range(100))
        limits = {**limits, "clock": lambda: float(next(ticks))}
    optimiser = make(bard, **settings)
    result = minimise(
        optimiser, optimiser.init(jnp.ones(3)), PROBLEMS["bard"][2], dispatch=1, **{"iterations": 50, **limits}
    )
    assert result.status == expected
    iterations = int(result.statistics.iterations)
    assert result.reason.startswith(f"iteration {iterations}: ")
    assert iterations == limits.get("iterations", iterations)
    if expected == Status.GRADIENT:
        assert result.state.gradient_norm <= 1e-6
        assert 3 < iterations < 50
    if expected == Status.STEP:
        assert result.state.step_norm <= 1e-4 * (np.linalg.norm(result.parameters) + 1e-4)
        assert 3 < iterations < 50
    if expected == Status.IMPROVEMENT:
        np.testing.assert_allclose(result.value * 15, 8.21487e-3, rtol=1e-3)
        assert 3 < iterations < 50
    if expected == Status.TIME:
        assert iterations == 3
    # Who has stopped by a rule holds still.
    if expected < Status.ITERATIONS:
        assert trees_equal(optimiser.step(result.state, tuple(map(jnp.asarray, PROBLEMS["bard"][2]))), result.state)


def test_wrong_derivatives_stall():
    optimiser = make(lambda x, _: misleading(x), trials=5)
    result = minimise(optimiser, optimiser.init(jnp.array(0.0)), NO_DATA, iterations=9)
    assert result.status == Status.STALLED
    assert (int(result.statistics.trials), float(result.parameters), float(result.value)) == (5, 0.0, 4.0)


def test_a_non_finite_trial_is_a_failed_trial():
    """From 20 the undamped step for log(x) = 1 is to -20, where there is no logarithm."""
    optimiser = make(lambda x, _: jnp.log(x) - 1, damping=1e-12)
    result = minimise(optimiser, optimiser.init(jnp.array(20.0)), NO_DATA, iterations=50)
    np.testing.assert_allclose(result.parameters, np.e, rtol=1e-8)
    assert result.statistics.trials > result.statistics.iterations


def test_non_finite_loss_stops_with_the_last_good_state():
    inputs, targets = map(np.array, NETWORK_DATA)
    key = jax.random.key(4)
    draws = [jax.random.permutation(jax.random.fold_in(key, iteration), 37)[:6].tolist() for iteration in range(8)]
    # A sample that the first draws leave out.
    bad = next(row for row in draws[5] if not any(row in draw for draw in draws[:5]))
    targets[bad] = np.nan
    optimiser = make(network, rows=6)
    states = []
    result = minimise(
        optimiser,
        optimiser.init(network_parameters(0), key),
        (inputs, targets),
        iterations=8,
        dispatch=1,
        on_dispatch=lambda state, _: states.append(state),
    )
    assert result.status == Status.NON_FINITE
    assert result.reason.startswith("iteration 5: the loss is not finite")
    assert result.statistics.iterations == 5
    assert trees_equal(result.parameters, states[4].parameters)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.parameters))


REFUSED = {
    "float32 parameters": (lambda: make(linear).init(jnp.zeros(2, jnp.float32)), "parameters are float32.*enable_x64"),
    "float32 residuals": (
        lambda: make(lambda x, row: (row @ x).astype(jnp.float32)).run(
            make(linear).init(jnp.zeros(2)), (jnp.ones((3, 2)),), 1
        ),
        "residuals are float32",
    ),
    "ragged": (
        lambda: make(linear).run(make(linear).init(jnp.zeros(2)), (jnp.ones((3, 2)), jnp.ones(4)), 1),
        r"\[3, 4\] samples",
    ),
    "rows": (
        lambda: make(linear, rows=4).run(make(linear).init(jnp.zeros(2)), (jnp.ones((3, 2)), jnp.ones(3)), 1),
        "rows is 4; expected 1 to 3",
    ),
    "scaling": (lambda: make(linear, scaling="diagonal?"), "scaling 'diagonal\\?'"),
    "probe": (lambda: make(linear, probe=0.0), "probe 0.0"),
    "dispatch": (
        lambda: minimise(make(linear), make(linear).init(jnp.zeros(2)), NO_DATA, iterations=1, dispatch=0),
        "dispatch is 0",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    call, message = REFUSED[name]
    # The jaxtyping import hook of the tests refuses a wrong literal before the library does.
    with pytest.raises(Exception if name == "scaling" else InputError, match=None if name == "scaling" else message):
        call()
