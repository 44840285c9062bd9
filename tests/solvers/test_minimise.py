"""Minima of element energies against closed forms, finite differences and an independent optimiser."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from scipy.optimize import minimize
from scipy.spatial import Delaunay

from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.solvers.elements import linear_solvers
from dln_jax.solvers.elements.assembly import pattern
from dln_jax.solvers.elements.energies import ElementEnergy
from dln_jax.solvers.elements.linear_solvers import block_tridiagonal, by_size, dense, least_work, matrix_free, sparse
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.moving import Elements, MovingEnergy

SOLVERS = (dense, block_tridiagonal, sparse, matrix_free)
CHAIN = 12
LINKS = np.stack([np.arange(CHAIN - 1), np.arange(1, CHAIN)], axis=1)


def spring(x, data):
    squared = sum((b - a) ** 2 for a, b in zip(*x, strict=True))
    return 0.5 * data["k"] * (jnp.sqrt(squared) - data["length"]) ** 2


ENERGIES = (
    ElementEnergy(spring, LINKS, unrolled=True),
    ElementEnergy(lambda x, weight: weight * x[0][1], np.arange(CHAIN)[:, None], unrolled=True),
)
FREE = np.ones((CHAIN, 2), bool)
FREE[0] = FREE[-1] = False
START = np.stack([np.linspace(0, 1, CHAIN), 0.02 * np.sin(np.arange(CHAIN))], axis=1)


def hanging_chain(stiffness, length, ends, linear_solver=by_size, **options):
    """Positions of a chain of springs between two held ends."""
    start = jnp.asarray(START).at[-1].set(ends)
    data = (
        {"k": jnp.full(CHAIN - 1, stiffness), "length": jnp.full(CHAIN - 1, length)},
        jnp.full(CHAIN, 0.3),
    )
    return minimise(ENERGIES, start, data, free=FREE, linear_solver=linear_solver, **options)


ARGUMENTS = jnp.array([50.0, 0.11, 1.0, 0.1])


def sag(arguments):
    """Mean height of the chain, by stiffness, length of a link and place of the last vertex."""
    return hanging_chain(*arguments[:2], arguments[2:])[0][:, 1].mean()


# As measured: long bands are factorised, wide ones are not. Corners of the elements, dimension, the least work.
CLOUD = np.random.default_rng(0).uniform(size=(1000, 3))
CHOICES = {
    "a few": (beam(4.0, 1.0, 8, 2).elements, 2, dense),
    "plane": (beam(4.0, 1.0, 80, 20).elements, 2, block_tridiagonal),
    "block": (box((2.0, 1.0, 1.0), (12, 6, 6)).elements, 3, block_tridiagonal),
    "unordered tetrahedra": (Delaunay(CLOUD).simplices, 3, sparse),
    "chain": (np.stack([np.arange(4000), np.arange(1, 4001)], axis=1), 1, block_tridiagonal),
}


def test_the_linear_solver_of_least_work_is_chosen():
    for name, (indices, dimension, expected) in CHOICES.items():
        energies = (ElementEnergy(spring, indices),)
        chosen = least_work(energies, pattern(energies, int(indices.max()) + 1, dimension))
        assert getattr(chosen, "func", chosen) is expected, name


def test_factors_that_would_fill_the_memory_are_not_stored(monkeypatch):
    indices, dimension, _ = CHOICES["block"]
    energies = (ElementEnergy(spring, indices),)
    at = pattern(energies, int(indices.max()) + 1, dimension)
    monkeypatch.setattr(linear_solvers, "_UPPER_ENTRIES", 1e3)
    assert least_work(energies, at).func is sparse
    monkeypatch.setattr(linear_solvers, "_UPPER_TILE_ENTRIES", 1e3)
    assert least_work(energies, at) is matrix_free


def test_every_linear_solver_finds_the_minimum_of_an_independent_optimiser():
    def energy(unknowns):
        x = START.copy()
        x[-1] = ARGUMENTS[2:]
        x[1:-1] = unknowns.reshape(-1, 2)
        lengths = np.linalg.norm(np.diff(x, axis=0), axis=1)
        return 25.0 * np.sum((lengths - 0.11) ** 2) + 0.3 * x[:, 1].sum()

    sagging = START - np.outer(np.sin(np.pi * START[:, 0]), [0.0, 0.1])
    reference = minimize(energy, sagging[1:-1].ravel(), method="BFGS", options={"gtol": 1e-9})
    for way in SOLVERS:
        solve = functools.partial(hanging_chain, linear_solver=way, definite=True)
        x, info = jax.jit(solve)(50.0, 0.11, ARGUMENTS[2:])
        assert info.converged and info.definite and info.residual <= 1e-8, way
        found = np.asarray(x)[1:-1].ravel()
        assert energy(found) <= reference.fun + 1e-12
        np.testing.assert_allclose(found, reference.x, atol=2e-5)
        np.testing.assert_array_equal(x[0], START[0])


def test_derivatives_are_those_of_the_minimum():
    value_of = jax.jit(sag)
    step = np.diag([1e-4, 1e-6, 1e-6, 1e-6])
    differences = [(value_of(ARGUMENTS + e) - value_of(ARGUMENTS - e)) / (2 * e.sum()) for e in step]
    for mode in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(mode(sag))(ARGUMENTS), differences, rtol=1e-6)


def test_second_derivatives_nest():
    curvature, slope = jax.jit(jax.hessian(sag))(ARGUMENTS), jax.jit(jax.grad(sag))
    e = 1e-5 * np.eye(4)[1]
    difference = (slope(ARGUMENTS + e) - slope(ARGUMENTS - e)) / 2e-5
    np.testing.assert_allclose(curvature[1], difference, rtol=1e-6)


def test_an_unfinished_search_says_so_and_has_no_derivative():
    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def unfinished(length):
        x, info = hanging_chain(50.0, length, ARGUMENTS[2:], iterations=1)
        return x.sum(), info

    (total, info), slope = unfinished(0.11)
    assert not info.converged and info.iterations == 1 and np.isfinite(total) and np.isnan(slope)


def test_values_that_are_not_finite_do_not_converge():
    x, info = jax.jit(hanging_chain)(jnp.nan, 0.11, ARGUMENTS[2:])
    assert not info.converged
    np.testing.assert_array_equal(x[1:-1], START[1:-1])


def rosenbrock(x, one):
    return jnp.sum(100 * (x[1:, 0] - x[:-1, 0] ** 2) ** 2 + (one - x[:-1, 0]) ** 2)


def test_a_function_of_all_unknowns_is_minimised_from_where_its_hessian_is_indefinite():
    start = jnp.array([[0.0], [2.0], [0.5], [-1.0], [3.0]])
    assert np.linalg.eigvalsh(jax.hessian(lambda x: rosenbrock(x[:, None], 1.0))(start[:, 0]))[0] < 0
    x, info = jax.jit(lambda start, one: minimise(rosenbrock, start, one, definite=True))(start, 1.0)
    np.testing.assert_allclose(x, 1.0, atol=1e-9)
    assert info.converged and info.definite


def test_a_saddle_is_not_definite():
    # x² - y² has no minimum; its only stationary point is where the search starts.
    saddle = lambda x, _: jnp.sum(x[0] ** 2) - jnp.sum(x[1] ** 2)  # noqa: E731
    _, info = jax.jit(lambda x: minimise(saddle, x, 0.0, definite=True))(jnp.zeros((2, 1)))
    assert info.converged and not info.definite


def test_convergence_at_the_level_of_rounding_far_below_which_energies_are_blind():
    # Stiffness 1e12 about lengths of 1: the tolerance asks for 1e-24 m.
    x, info = jax.jit(lambda x: minimise(lambda x, k: k * jnp.sum((x - 1.0) ** 4 + (x - 1.0) ** 2), x, 1e12))(
        jnp.full((3, 1), 1.3)
    )
    assert info.converged
    np.testing.assert_allclose(x, 1.0, atol=1e-14)


def well(curvature):
    """An element of the first block with the energy -½ c x² + x⁴/40 - x/20 of the first unknown."""

    def energy(x):
        along = x[0, 0]
        return -0.5 * curvature * along**2 + 0.025 * along**4 - 0.05 * along

    return MovingEnergy(
        elements=lambda x, step, data: Elements(jnp.zeros((1, 1), int), (), jnp.asarray(False)),
        describe=lambda x, elements, data: jnp.zeros(1),
        gradient=lambda x, _: jax.value_and_grad(energy)(x),
        hessian=lambda x, _: jax.hessian(energy)(x)[0, :, 0],
        longest=lambda x, step, elements, data: jnp.ones((), x.dtype),
    )


def test_moving_elements_of_negative_curvature_take_few_iterations():
    """With Hessians that are always projected, the error would fall by the ratio of both curvatures in a step."""

    @jax.jit
    def solve(curvature):
        half_square, start = lambda x, _: 0.5 * jnp.sum(x**2), jnp.full((2, 2), 0.1)
        return minimise(half_square, start, moving=[well(curvature)], moving_data=[None])

    for curvature in (0.5, 0.9, 0.99):
        x, info = solve(curvature)
        assert info.converged and int(info.iterations) <= 9
        # 0.1 x³ + (1 - c) x = 0.05
        (root,) = (root.real for root in np.roots([0.1, 0, 1 - curvature, -0.05]) if abs(root.imag) < 1e-9)
        assert float(x[0, 0]) == pytest.approx(root, abs=1e-8)
        assert float(jnp.abs(x[1]).max()) < 1e-8


def test_mistakes_name_what_is_wrong():
    def minimised(indices=((0, 1),), x0=((0.0, 0.0),) * 3, **options):
        energies = (ElementEnergy(lambda x, _: jnp.sum(x**2), np.array(indices)),)
        minimise(energies, jnp.asarray(x0), (jnp.zeros(len(indices)),), **options)

    for mistake, words in (
        ({"indices": [[0, 3]]}, "element 0 of energy 0"),
        ({"indices": [[0, 1], [2, 2]]}, "element 1 of energy 0"),
        ({"free": np.ones((2, 2), bool)}, "free has shape"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"x0": np.zeros(3)}, "x0 has shape"),
    ):
        with one_line(words):
            minimised(**mistake)
