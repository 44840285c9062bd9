"""Minima of element energies against closed forms, finite differences and an independent optimiser."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import Delaunay

from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.mesh.simplices import regularity
from dln_jax.softbody.scene import make_scene
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements import selection
from dln_jax.solvers.elements.assembly import assemble, entries, gradient, pattern
from dln_jax.solvers.elements.energies import ElementEnergy, element_hessians, lower_triangles, project, square, value
from dln_jax.solvers.elements.linear_solvers import block_tridiagonal, dense, matrix_free, sparse
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.selection import by_size, least_work, search_takes_at_most
from dln_jax.solvers.elements.symmetric_systems import conjugate_gradients
from dln_jax.types import InputError

SOLVERS = {"dense": dense, "block-tridiagonal": block_tridiagonal, "sparse": sparse, "matrix-free": matrix_free}
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


@functools.cache
def solved(name):
    return jax.jit(functools.partial(hanging_chain, linear_solver=SOLVERS[name], definite=True))


ARGUMENTS = (50.0, 0.11, jnp.array([1.0, 0.1]))


@pytest.fixture(scope="module")
def sag():
    """Mean height, compiled: the scalar that the derivatives below are of."""
    return jax.jit(lambda *arguments: hanging_chain(*arguments)[0][:, 1].mean())


# As measured: long bands are factorised, wide ones are not. Corners of the elements, dimension, the least work.
CLOUD = np.random.default_rng(0).uniform(size=(1000, 3))
CHOICES = {
    "a few": (beam(4.0, 1.0, 8, 2).elements, 2, dense),
    "plane": (beam(4.0, 1.0, 80, 20).elements, 2, block_tridiagonal),
    "bar": (box((8.0, 1.0, 1.0), (48, 6, 6)).elements, 3, block_tridiagonal),
    "block": (box((2.0, 1.0, 1.0), (12, 6, 6)).elements, 3, block_tridiagonal),
    "unordered tetrahedra": (Delaunay(CLOUD).simplices, 3, sparse),
    "chain": (np.stack([np.arange(4000), np.arange(1, 4001)], axis=1), 1, block_tridiagonal),
}


@pytest.mark.parametrize("case", CHOICES)
def test_the_linear_solver_of_least_work_is_chosen(case):
    indices, dimension, expected = CHOICES[case]
    energies = (ElementEnergy(spring, indices),)
    chosen = least_work(energies, pattern(energies, int(indices.max()) + 1, dimension))
    assert getattr(chosen, "func", chosen) is expected


def unordered_body(modulus, ratio):
    """About a thousand tetrahedra in no particular order."""
    random = np.random.default_rng(0)
    points = random.uniform(size=(230, 3)) * [2.0, 1.0, 1.0]
    elements = Delaunay(points).simplices
    mesh = make_mesh(points, elements[np.abs(regularity(points, elements)) > 0.02])
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=ratio)
    return make_scene(mesh, (solid,), held=np.argsort(points[:, 0])[:20])


def chosen(scene, dt):
    """Name of the solver that a time step takes, of its linear systems."""
    seen = []

    def observed(way):
        return lambda *arguments, **options: seen.append(way.__name__) or way(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        for way in (dense, block_tridiagonal, sparse, matrix_free):
            patch.setattr(selection, way.__name__, observed(way))
        make_step(scene, dt)
    return seen[0]


@pytest.mark.slow
def test_the_choice_of_the_solver_follows_the_stiffness():
    soft, stiff = unordered_body(1e4, 0.3), unordered_body(1e9, 0.49)
    assert chosen(soft, 1e-3) == "matrix_free"
    assert chosen(stiff, 1 / 60) == "sparse"
    # What is traced is not known: the choice is that of the size alone, and the step is made.
    assert len({chosen_when_traced(scene) for scene in (soft, stiff)}) == 1


def chosen_when_traced(scene):
    names = []

    def make(dt):
        names.append(chosen(scene, dt))
        return dt

    jax.eval_shape(make, 1e-3)
    return names[0]


def test_products_of_a_search_are_those_that_conjugate_gradients_take():
    """A chain of springs between held ends; its Hessian is known."""
    data = ({"k": jnp.full(CHAIN - 1, 50.0), "length": jnp.full(CHAIN - 1, 0.05)}, jnp.zeros(CHAIN))
    at = pattern(ENERGIES, CHAIN, 2, FREE)
    x = jnp.asarray(START)
    asked = functools.partial(search_takes_at_most, energies=ENERGIES, at=at, x=x, data=data, residual=1e-2)
    assert asked(40) and not asked(2)


def test_factors_that_would_fill_the_memory_are_not_stored(monkeypatch):
    energies = (ElementEnergy(spring, CHOICES["unordered tetrahedra"][0]),)
    at = pattern(energies, len(CLOUD), 3)
    monkeypatch.setattr(selection, "_UPPER_ENTRIES", 1e6)
    assert least_work(energies, at).func is sparse
    monkeypatch.setattr(selection, "_UPPER_TILE_ENTRIES", 1e6)
    assert least_work(energies, at) is matrix_free


@pytest.mark.parametrize("name", SOLVERS)
def test_every_linear_solver_finds_the_minimum_of_an_independent_optimiser(name):
    x, info = solved(name)(*ARGUMENTS)
    assert info.converged and info.definite and info.residual <= 1e-8

    def energy(unknowns):
        x = START.copy()
        x[-1] = ARGUMENTS[2]
        x[1:-1] = unknowns.reshape(-1, 2)
        lengths = np.linalg.norm(np.diff(x, axis=0), axis=1)
        return 25.0 * np.sum((lengths - 0.11) ** 2) + 0.3 * x[:, 1].sum()

    reference = minimize(energy, np.asarray(x)[1:-1].ravel() + 1e-3, method="BFGS", options={"gtol": 1e-9})
    assert energy(np.asarray(x)[1:-1].ravel()) <= reference.fun + 1e-12
    np.testing.assert_allclose(np.asarray(x)[1:-1].ravel(), reference.x, atol=2e-5)
    np.testing.assert_array_equal(x[0], START[0])


@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd], ids=["reverse", "forward"])
def test_derivatives_are_those_of_the_minimum(sag, mode):
    derivatives = jax.jit(mode(lambda *arguments: hanging_chain(*arguments)[0][:, 1].mean(), argnums=(0, 1, 2)))
    slopes = derivatives(*ARGUMENTS)
    step = 1e-6
    for number, scale in ((0, 1e2), (1, 1.0)):
        moved = [[*ARGUMENTS], [*ARGUMENTS]]
        moved[0][number] += scale * step
        moved[1][number] -= scale * step
        difference = (sag(*moved[0]) - sag(*moved[1])) / (2 * scale * step)
        np.testing.assert_allclose(slopes[number], difference, rtol=1e-6)
    for axis in range(2):
        e = step * jnp.eye(2)[axis]
        difference = (sag(*ARGUMENTS[:2], ARGUMENTS[2] + e) - sag(*ARGUMENTS[:2], ARGUMENTS[2] - e)) / (2 * step)
        np.testing.assert_allclose(slopes[2][axis], difference, rtol=1e-6)


@pytest.mark.slow
def test_second_derivatives_nest(sag):
    curvature = jax.jit(jax.hessian(lambda length: hanging_chain(50.0, length, ARGUMENTS[2])[0][:, 1].mean()))(0.11)
    slope = jax.jit(jax.grad(lambda length: hanging_chain(50.0, length, ARGUMENTS[2])[0][:, 1].mean()))
    np.testing.assert_allclose(curvature, (slope(0.11 + 1e-5) - slope(0.11 - 1e-5)) / 2e-5, rtol=1e-6)


def test_an_unfinished_search_says_so_and_has_no_derivative():
    unfinished = functools.partial(hanging_chain, iterations=1)
    x, info = jax.jit(unfinished)(*ARGUMENTS)
    assert not info.converged and info.iterations == 1 and np.isfinite(x).all()
    slope = jax.jit(jax.grad(lambda length: unfinished(50.0, length, ARGUMENTS[2])[0].sum()))(0.11)
    assert np.isnan(slope)


def test_values_that_are_not_finite_do_not_converge():
    x, info = solved("dense")(jnp.nan, 0.11, ARGUMENTS[2])
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


def test_single_precision_stays_single():
    x, info = jax.jit(lambda x, one: minimise(rosenbrock, x, one, tolerance=1e-3))(
        jnp.zeros((4, 1), jnp.float32), jnp.float32(1.0)
    )
    assert x.dtype == jnp.float32 and info.converged
    np.testing.assert_allclose(x, 1.0, atol=1e-3)


def test_assembly_agrees_with_differentiating_the_sum():
    data = ({"k": jnp.linspace(1, 2, CHAIN - 1), "length": jnp.full(CHAIN - 1, 0.2)}, jnp.arange(float(CHAIN)))
    at = pattern(ENERGIES, CHAIN, 2)
    x = jnp.asarray(START) + 0.1 * jax.random.normal(jax.random.key(0), START.shape)

    @jax.jit
    def both(x):
        total = lambda x: value(ENERGIES, x, data)  # noqa: E731
        assembled = gradient(ENERGIES, at, x, data), entries(at, element_hessians(ENERGIES, x, data))
        return assembled, (jax.grad(total)(x), jax.hessian(total)(x).reshape(at.unknowns, at.unknowns))

    (slope, values), (expected_slope, expected) = both(x)
    np.testing.assert_allclose(slope, expected_slope, atol=1e-13)
    whole = np.zeros((at.unknowns, at.unknowns))
    whole[at.rows, at.columns] = values
    np.testing.assert_allclose(whole, np.tril(expected), atol=1e-12)


def test_the_transpose_of_assembly_reads_where_it_adds():
    at = pattern(ENERGIES, CHAIN, 2)
    corners = at.corners[0]
    components = jax.random.normal(jax.random.key(1), (4, CHAIN - 1))
    blocks = jax.random.normal(jax.random.key(2), (CHAIN, 2))
    added, transposed = jax.vjp(lambda c: assemble(corners, c), components)
    np.testing.assert_allclose(jnp.vdot(added, blocks), jnp.vdot(components, transposed(blocks)[0]), rtol=1e-13)


def test_projection_keeps_what_is_positive_and_removes_what_is_not():
    whole = np.array([[[2.0, 0.0], [0.0, -1.0]], [[1.0, 0.5], [0.5, 3.0]]])
    (projected,) = project((lower_triangles(jnp.asarray(whole)),), jnp.asarray(0.0))
    np.testing.assert_allclose(square(projected), [[[2.0, 0.0], [0.0, 0.0]], whole[1]], atol=1e-14)


def test_conjugate_gradients_refuse_a_matrix_that_is_not_definite():
    diagonal = jnp.array([1.0, 2.0, -3.0])
    solve = functools.partial(conjugate_gradients, precondition=lambda r: r, tolerance=1e-12, iterations=10)
    b = jnp.array([1.0, 1.0, 1.0])
    np.testing.assert_allclose(solve(lambda x: jnp.abs(diagonal) * x, b), b / jnp.abs(diagonal), rtol=1e-11)
    assert np.isnan(solve(lambda x: diagonal * x, b)).all()
    assert np.isnan(solve(lambda x: jnp.abs(diagonal) * x, b, iterations=1)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"indices": np.array([[0, 3]])}, "element 0 of energy 0"),
        ({"indices": np.array([[0, 1], [2, 2]])}, "element 1 of energy 0"),
        ({"free": np.ones((2, 2), bool)}, "free has shape"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"iterations": 0}, "iterations"),
        ({"x0": jnp.zeros(3)}, "x0 has shape"),
    ],
)
def test_mistakes_name_what_is_wrong(change, message):
    indices = change.pop("indices", np.array([[0, 1]]))
    x0 = change.pop("x0", jnp.zeros((3, 2)))
    energies = (ElementEnergy(lambda x, _: jnp.sum(x**2), indices),)
    with pytest.raises(InputError, match=message):
        minimise(energies, x0, (jnp.zeros(len(indices)),), **change)
