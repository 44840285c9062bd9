"""Factorisations of many matrices at once: against NumPy, one by one, and without LAPACK's batched calls."""

import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import slow_among
from scipy.linalg import hilbert

from dln_jax.locomotion.task import creature_named, make_task, run_episode
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.solvers import lapack
from dln_jax.solvers.elements.energies import ElementEnergy, lower_triangles, project
from dln_jax.solvers.elements.linear_solvers import block_tridiagonal, dense, matrix_free, sparse
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.symmetric_systems import places, solve_bands
from dln_jax.solvers.elimination import solve, solve_lower, solve_lower_transposed

ROOT = Path(__file__).parents[2]
SIDES = list(itertools.product((False, True), (False, True)))


def definite(size, condition, count=1, band=None):
    """Symmetric matrices of a condition number, those with a band rescaled products of banded triangles."""
    random = np.random.default_rng(size)
    if band is None:
        turn = np.linalg.qr(random.normal(size=(count, size, size)))[0]
        return (turn * np.geomspace(1, 1 / condition, size)) @ turn.swapaxes(1, 2)
    row, column = np.indices((size, size))
    lower = np.where((row - column <= band) & (row > column), random.normal(size=(count, size, size)) / (band + 1), 0)
    lower += np.eye(size)
    scale = condition ** -np.linspace(0, 0.5, size)
    return scale[:, None] * (lower @ lower.swapaxes(1, 2)) * scale


def of_bands(matrices, b, band):
    """x [count, n, k] by `solve_bands`."""
    size = matrices.shape[1]
    row, column = places(size, band)
    whole = np.broadcast_to(np.eye(row.max() + 1), (len(matrices), row.max() + 1, row.max() + 1)).copy()
    whole[:, :size, :size] = np.tril(matrices)
    whole = jnp.asarray(whole.transpose(1, 2, 0)[row, column], b.dtype)
    return np.asarray(jax.jit(solve_bands)(whole, jnp.asarray(b.transpose(1, 2, 0)))).transpose(2, 0, 1)


@pytest.mark.parametrize(
    ("size", "band", "condition", "precision"),
    [
        (1, 0, 1.0, np.float64),
        (2, 1, 1e3, np.float64),
        (7, 3, 1e14, np.float64),
        (25, 6, 10.0, np.float64),
        (9, 8, 1e8, np.float64),
        (12, 0, 1e14, np.float64),
        (1, 0, 1.0, np.float32),
        (9, 3, 1e4, np.float32),
    ],
)
def test_systems_with_bands_are_solved_backward_stably(size, band, condition, precision):
    matrices = definite(size, condition, 5, band).astype(precision)
    b = np.random.default_rng(1).normal(size=(5, size, 2)).astype(precision)
    x = of_bands(matrices, b, band)
    assert x.dtype == precision
    # |b - A x| <= c n eps |A| |x| says nothing of the condition: Higham 2002, theorem 10.4.
    exact, x = matrices.astype(float), x.astype(float)
    sizes = np.linalg.norm(exact, 2, axis=(1, 2))[:, None, None] * np.linalg.norm(x, axis=1, keepdims=True)
    assert np.all(np.abs(exact @ x - b) <= 8 * size * np.finfo(precision).eps * sizes)


def test_hilbert_matrices_have_bands_too():
    x = of_bands(hilbert(9)[None], np.ones((1, 9, 1)), 8)[0]
    assert np.abs(hilbert(9) @ x - 1).max() <= 8 * 9 * np.finfo(float).eps * np.linalg.norm(x)


@pytest.mark.parametrize("fault", ["indefinite", "singular", "nan"])
def test_only_the_system_that_is_not_definite_is_not_finite(fault):
    matrices = definite(12, 10.0, 3, 3)
    matrices[1, 4, 4] = {"indefinite": -1.0, "singular": matrices[1, 4, :4] @ matrices[1, 4, :4], "nan": np.nan}[fault]
    if fault == "singular":
        matrices[1] = np.kron(np.eye(6), np.ones((2, 2)))
    finite = np.isfinite(of_bands(matrices, np.ones((3, 12, 1)), 3)).all(axis=1)[:, 0]
    assert finite.tolist() == [True, False, True]
    lower = np.asarray(jax.jit(jax.vmap(lapack.cholesky))(matrices))
    assert np.isfinite(lower).all(axis=(1, 2)).tolist() == [True, False, True]


@pytest.mark.parametrize("condition", [10.0, 1e14])
def test_cholesky_of_a_batch(condition):
    matrices = definite(17, condition, 6)
    nowhere = np.where(np.triu(np.ones((17, 17)), 1), np.nan, matrices)
    lower = np.asarray(jax.jit(jax.vmap(jax.vmap(lapack.cholesky)))(nowhere.reshape(2, 3, 17, 17))).reshape(6, 17, 17)
    product = lower @ lower.swapaxes(1, 2)
    assert np.abs(product - matrices).max() <= 17 * np.finfo(float).eps * np.abs(matrices).max()
    assert (np.triu(lower, 1) == 0).all()


@pytest.mark.parametrize(("transposed", "right"), SIDES)
def test_substitution_in_nested_batches(transposed, right):
    """Every way that the factor, the right-hand sides or both may be a batch, within a batch or not."""
    random = np.random.default_rng(0)
    factor, b = random.normal(size=(2, 3, 5, 5)) + 6 * np.eye(5), random.normal(size=(2, 3, 5, 2))
    b = b.swapaxes(2, 3) if right else b
    inverse = np.linalg.inv(np.tril(factor).swapaxes(2, 3) if transposed else np.tril(factor))
    one = lambda factor, b: lapack.substitute(factor, b, transposed=transposed, right=right)  # noqa: E731
    ways = list(itertools.product([(0, 0), (None, 0), (0, None)], repeat=2))

    def chosen(array, k, outer, inner):
        return array[tuple(slice(None) if axis[k] == 0 else 0 for axis in (outer, inner))]

    @jax.jit
    def solutions(factor, b):
        return [
            jax.vmap(jax.vmap(one, inner), outer)(chosen(factor, 0, outer, inner), chosen(b, 1, outer, inner))
            for outer, inner in ways
        ]

    for (outer, inner), x in zip(ways, solutions(factor, b), strict=True):
        for i, j in itertools.product(range(2), range(3)):
            place = [(i if outer[k] == 0 else 0, j if inner[k] == 0 else 0) for k in range(2)]
            known, wanted = inverse[place[0]], b[place[1]]
            np.testing.assert_allclose(x[i, j], wanted @ known if right else known @ wanted, rtol=1e-10, atol=1e-13)


def test_eigenvalues_in_clusters_and_zeros():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 12, 12)))[0]
    known = np.sort([-3.0, 0, 0, 0, 1e-9, 1, 1, 1, 1 + 1e-12, 2, 2, 1e3])
    matrices = (turn * known) @ turn.swapaxes(1, 2)
    values, vectors = jax.jit(jax.vmap(lapack.symmetric_eigen))(jnp.asarray(matrices))
    np.testing.assert_allclose(values, np.broadcast_to(known, (4, 12)), atol=12 * np.finfo(float).eps * 1e3)
    np.testing.assert_allclose(vectors.swapaxes(1, 2) @ vectors, np.broadcast_to(np.eye(12), (4, 12, 12)), atol=1e-13)


def test_projection_of_elements_of_several_sizes():
    """Against NumPy; the shift is relative to the largest diagonal entry of all, and NaN ends nowhere."""
    random = np.random.default_rng(2)
    wholes = [random.normal(size=(count, size, size)) for count, size in ((3, 2), (5, 6), (2, 12))]
    wholes = [matrices + matrices.swapaxes(1, 2) for matrices in wholes]
    projected = jax.jit(project)(tuple(lower_triangles(jnp.asarray(matrices)) for matrices in wholes), 1e-3)
    spectra = [np.linalg.eigh(matrices) for matrices in wholes]
    largest = max(np.diagonal(matrices, axis1=1, axis2=2).max() for matrices in wholes)
    for (values, vectors), lower in zip(spectra, projected, strict=True):
        raised = vectors * (np.maximum(values, 0) + 1e-3 * largest)[:, None] @ vectors.swapaxes(1, 2)
        np.testing.assert_allclose(lower, lower_triangles(jnp.asarray(raised)), atol=1e-12)
    assert np.isfinite(jax.jit(project)((jnp.full((3, 4), jnp.nan),), 1e-3)[0]).all()


@pytest.mark.parametrize("size", [5, 20])
def test_general_systems_in_batches_and_their_derivatives(size):
    random = np.random.default_rng(size)
    matrices, b = random.normal(size=(3, size, size)), random.normal(size=(3, size))
    np.testing.assert_allclose(jax.jit(jax.vmap(solve))(matrices, b), np.linalg.solve(matrices, b[..., None])[..., 0])
    shared = jax.jit(jax.vmap(solve, (None, 0)))(matrices[0], b)
    np.testing.assert_allclose(shared, np.linalg.solve(matrices[0], b.T).T)

    for function, inverse in (
        (solve, np.linalg.inv(matrices)),
        (solve_lower, np.linalg.inv(np.tril(matrices))),
        (solve_lower_transposed, np.linalg.inv(np.tril(matrices)).swapaxes(1, 2)),
    ):
        # d(uᵀ x) = -(A⁻ᵀ u) xᵀ dA, of the lower triangle where only that is read.
        slopes = jax.jit(jax.vmap(jax.grad(lambda *arguments, f=function: f(*arguments).sum())))(matrices, b)
        adjoint, x = inverse.sum(axis=1), (inverse @ b[..., None])[..., 0]
        outer = adjoint[:, :, None] * x[:, None]
        if function is solve_lower_transposed:
            outer = outer.swapaxes(1, 2)
        np.testing.assert_allclose(slopes, -(outer if function is solve else np.tril(outer)), rtol=1e-6, atol=1e-9)


COUNT = 6
CHAIN = (
    ElementEnergy(
        lambda x, data: 0.5 * data[0] * (jnp.sqrt(sum((b - a) ** 2 for a, b in zip(*x, strict=True))) - data[1]) ** 2,
        np.stack([np.arange(COUNT - 1), np.arange(1, COUNT)], axis=1),
        unrolled=True,
    ),
    ElementEnergy(lambda x, weight: weight * x[0][1], np.arange(COUNT)[:, None], unrolled=True),
)
FREE = np.ones((COUNT, 2), bool)
FREE[0] = FREE[-1] = False
START = np.stack([np.linspace(0, 1, COUNT), 0.02 * np.sin(np.arange(COUNT))], axis=1)


def sag(stiffness, length, way):
    """Mean height of a chain of springs between two held ends."""
    data = ((jnp.full(COUNT - 1, stiffness), jnp.full(COUNT - 1, length)), jnp.full(COUNT, 0.3))
    x, _ = minimise(CHAIN, jnp.asarray(START), data, free=FREE, tolerance=1e-10, linear_solver=way)
    return x[:, 1].mean()


# The second chain is compressed as it starts, so that its Hessian is indefinite there.
CHAINS = (jnp.array([30.0, 50.0, 3.0, 40.0]), jnp.array([0.18, 0.25, 0.2, 0.19]))


@pytest.mark.parametrize(
    ("way", "derived"),
    [
        (dense, lambda one: jax.jacfwd(jax.value_and_grad(one))),
        pytest.param(block_tridiagonal, lambda one: jax.value_and_grad(one, (0, 1)), marks=pytest.mark.slow),
        pytest.param(sparse, lambda one: jax.value_and_grad(one, (0, 1)), marks=pytest.mark.slow),
        pytest.param(matrix_free, lambda one: one, marks=pytest.mark.slow),
    ],
    ids=["dense, second", "blocks, first", "sparse, first", "no matrix, none"],
)
def test_minima_and_their_derivatives_in_batches(way, derived):
    every = derived(lambda stiffness, length: sag(stiffness, length, way))
    together, alone = jax.jit(jax.vmap(every))(*CHAINS), jax.jit(every)
    for lane in range(4):
        expected = alone(*(numbers[lane] for numbers in CHAINS))
        for left, right in zip(jax.tree.leaves(together), jax.tree.leaves(expected), strict=True):
            assert jnp.isfinite(right)
            np.testing.assert_allclose(left[lane], right, rtol=1e-7, atol=1e-12)


@pytest.mark.slow
def test_batches_of_batches_of_minima():
    one = lambda stiffness, length: sag(stiffness, length, dense)  # noqa: E731
    nested = jax.jit(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))(*CHAINS)
    np.testing.assert_allclose(np.diag(nested), jax.jit(jax.vmap(one))(*CHAINS), rtol=1e-9)


def gradient_of_a_creature():
    task = make_task(creature_named("crawler"), episode=1)
    one = lambda actuation: run_episode(task, lambda _: actuation).distance  # noqa: E731
    return jax.grad(one), np.full(task.muscle_count, 0.9)


def long_chain():
    """20 coordinates: beyond what is written out row by row."""
    spread = np.linspace(1, 2, 400).reshape(20, 20)
    system = NaturalSystem(lambda q: jnp.eye(20) + 0.1 * jnp.tril(jnp.sin(spread * q)), lambda q: jnp.cos(q).sum())
    functions = dynamics(system)
    return lambda q: (functions.forward_dynamics(q, q, q), functions.mass_matrix(q, q)), np.linspace(0, 1, 20)


PROGRAMS = {
    "a creature's gradient": gradient_of_a_creature,
    "mechanics of 20 coordinates": long_chain,
    "blocks": lambda: (lambda length: sag(50.0, length, block_tridiagonal), np.full((), 0.2)),
    "sparse": lambda: (lambda length: sag(50.0, length, sparse), np.full((), 0.2)),
    "no matrix": lambda: (lambda length: sag(50.0, length, matrix_free), np.full((), 0.2)),
}
# The first result of a call to LAPACK, and whether its factors are a batch.
CALL = re.compile(r"custom_call @lapack_\w+\(.*-> \(?tensor<((?:\d+x)+)f")


@pytest.mark.parametrize("program", slow_among(PROGRAMS, lambda name: name.startswith("a creature")))
def test_no_batch_is_given_to_lapack(program):
    one, at = PROGRAMS[program]()
    text = jax.jit(jax.vmap(one)).lower(np.broadcast_to(at, (4, *at.shape))).as_text()
    calls = [call.group(1) for call in map(CALL.search, text.splitlines()) if call]
    assert calls and all(shape.count("x") <= 2 for shape in calls), calls


def test_a_batch_that_is_given_to_lapack_would_be_seen():
    text = jax.jit(jnp.linalg.cholesky).lower(np.ones((3, 4, 4))).as_text()
    assert [call.group(1) for call in map(CALL.search, text.splitlines()) if call] == ["3x4x4x"]


def test_elsewhere_a_batch_is_one_call():
    mapped = jax.jit(jax.vmap(lapack.cholesky)).trace(jnp.ones((3, 40, 40)))
    text = mapped.lower(lowering_platforms=("cuda",)).as_text()
    assert "cusolver" in text and "stablehlo.while" not in text


ON_FOUR_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from dln_jax.locomotion.task import creature_named, make_task, run_episode
from dln_jax.scale.mesh import batch_mesh, spread
from dln_jax.solvers import lapack

task = make_task(creature_named("crawler"), episode=1)

def one(a):
    matrix = jnp.eye(40) + 0.01 * jnp.outer(jnp.arange(40.0), jnp.arange(40.0)) * a[0] ** 2
    factor = lapack.cholesky(matrix)
    values, _ = lapack.symmetric_eigen(matrix[:6, :6])
    x = lapack.solve(matrix, lapack.substitute(factor, jnp.ones((40, 1)))[:, 0])
    return run_episode(task, lambda _: a).distance, x.sum() + values.sum()

lanes = 0.6 + 0.02 * np.arange(8)[:, None] * np.ones(task.muscle_count)
mesh = batch_mesh()
assert mesh is not None and mesh.size == 4
program = jax.jit(spread(lambda _, lanes: jax.vmap(one)(lanes), mesh)).lower(None, lanes).compile()
first = jax.block_until_ready(program(None, lanes))
for shift in range(100):
    rolled = jax.block_until_ready(program(None, np.roll(lanes, shift, axis=0)))
for left, right in zip(rolled, first):
    np.testing.assert_allclose(left, np.roll(right, shift), rtol=1e-9)
"""


@pytest.mark.slow
def test_four_devices_do_not_wait_for_each_other():
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", ON_FOUR_DEVICES], env=environment, timeout=300, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
