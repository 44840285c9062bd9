"""Solves symmetric positive definite systems H p = b, with H a sum of element Hessians.

There are four methods. `least_work` chooses one before tracing, by its number of operations:

- `dense` Cholesky for small systems;
- `block_tridiagonal` Cholesky after reverse Cuthill-McKee ordering, a `lax.scan` over blocks, for narrow bands: bodies
  in the plane, and small or long ones in space;
- `sparse` Cholesky by tiles after nested dissection for other systems of any stiffness;
- `matrix_free` conjugate gradients with a block-Jacobi preconditioner on the element Hessians, for soft bodies in small
  time steps, and for systems with too large a factor for the memory.

The number of products in conjugate gradients depends on stiffness, Poisson's ratio, time step and mesh. It grows with
the square root of the condition number, and can be counted for known values only.

If the matrix is not positive definite, the solution is not finite: there are no shifts and no clamping.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dln_jax.precision import compiled
from dln_jax.solvers.elements import sparse_cholesky
from dln_jax.solvers.elements.assembly import Pattern, assemble, entries
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, element_hessians, square
from dln_jax.solvers.elements.sparse_cholesky import TILE
from dln_jax.solvers.elements.symmetric_systems import (
    conjugate_gradients,
    factorise_blocks,
    places,
    solve_bands,
    solve_blocks,
)
from dln_jax.solvers.elimination import cholesky, shared_or_batched, substitute
from dln_jax.solvers.elimination import solve as eliminate
from dln_jax.types import InputError

# Batches of bands up to this width, and of at least this size, are factorised faster together than by LAPACK one by
# one; measured with 56 to 120 unknowns, bands of 11 to 40 and 2 to 64 systems: 4 times at 56, 11 and 64.
_WIDEST_BAND = 20
_LOWER_BANDS = 4
# Relative residuals of the conjugate gradients, and their largest number of products.
_SOLVE_RESIDUAL = 1e-10
_SEARCH_RESIDUAL = 1e-2
_UPPER_PRODUCTS = 10_000
# With more unknowns the dense factorisation is slower than the block-tridiagonal one.
_DENSE_UNKNOWNS = 160
# Operations on small blocks are slower, as if a block had this many more rows.
_BLOCK_OVERHEAD = 150
# Operations of a factorisation that take as long as an entry of the element Hessians in a product, which reads it from
# memory; an inexact search also needs 1.75 times the Newton iterations.
_OPERATIONS_OF_ENTRY = 16
# With so few products there is little to gain, and counting them costs a compilation.
_LOWER_PRODUCTS = 20
# Largest numbers of entries in the blocks of a band, and in the tiles (32-bit indices).
_UPPER_ENTRIES = 3e7
_UPPER_TILE_ENTRIES = 5e8


class LinearSolver(NamedTuple):
    """A method for systems with the Hessian."""

    factorise: Callable[[Sequence[Array], Any], Any]
    """(element Hessians, entries of their sum [entries], or the tuple of `with_moving`) -> factor for the solves."""
    solve: Callable[[Any, Blocks], Blocks]
    """(factor, b) -> p, accurate to rounding; p is zero where the pattern is not free."""
    search: Callable[[Any, Blocks], Blocks]
    """(factor, b) -> p, accurate enough for a search direction."""


Columns = Float[Array, "n k"]
LinearSolverFactory = Callable[[Sequence[ElementEnergy], Pattern], LinearSolver]


def dense(_: Sequence[ElementEnergy], at: Pattern) -> LinearSolver:
    """Factorises the whole matrix by Cholesky; under `vmap` on a CPU, a batch of narrow bands side by side."""
    table = lookup(at)(np.arange(at.unknowns)[:, None], np.arange(at.unknowns)[None, :])

    def factorise(_: Sequence[Array], values: Float[Array, " entries"]) -> Array:
        return cholesky(with_constants(values)[table])

    def substituted(factor: Array, right: Columns) -> Columns:
        return substitute(factor, substitute(factor, right), transposed=True)

    def of_blocks(solve: Callable[[Array, Columns], Columns], factor: Array, b: Blocks) -> Blocks:
        right = jnp.where(at.free, b, 0).reshape(-1, 1)
        return solve(factor, right).reshape(b.shape)

    order = (narrowest_order(at)[:, None] * at.width + np.arange(at.width)).ravel()
    place = np.argsort(order)
    band = int(np.abs(place[at.rows] - place[at.columns]).max(initial=0))
    if band > _WIDEST_BAND:
        solve = partial(of_blocks, substituted)
        return LinearSolver(factorise, solve, solve)

    # The solve includes the factorisation, because the two methods have factors of different shapes.
    solve = partial(of_blocks, _one_or_many(lambda values, b: substituted(factorise((), values), b), at, order, band))
    return LinearSolver(lambda _, values: values, solve, solve)


def _one_or_many(
    one: Callable[[Array, Columns], Columns], at: Pattern, order: np.ndarray, band: int
) -> Callable[[Array, Columns], Columns]:
    """Returns the solve (entries, b) -> x by `one`; a batch is solved by banded factorisations side by side."""
    row, column = places(at.unknowns, band)
    numbers = np.append(order, np.full(max(row.max(), column.max()) + 1 - at.unknowns, at.unknowns))
    beyond = (row == column) & (row >= at.unknowns)
    table = np.where(beyond, _one(at), lookup(at)(numbers[row], numbers[column]))

    def by_bands(values: Float[Array, "systems entries"], b: Float[Array, "systems n k"]) -> Array:
        lower = jax.vmap(with_constants)(values).T[table]
        x = solve_bands(lower, b.transpose(1, 2, 0)[order])
        return x[np.argsort(order)].transpose(2, 0, 1)

    def many(values: Float[Array, "systems entries"], b: Float[Array, "systems n k"]) -> Array:
        one_by_one = jax.vmap(one)
        if len(values) < _LOWER_BANDS:
            return one_by_one(values, b)
        return lax.platform_dependent(values, b, cpu=by_bands, default=one_by_one)

    return shared_or_batched(one, many)


def block_tridiagonal(_: Sequence[ElementEnergy], at: Pattern) -> LinearSolver:
    """Factorises by blocks with Cholesky; the unknowns are ordered so that only neighbouring blocks couple."""
    order = narrowest_order(at)
    size = width_of_band(at, order)
    count = -(-at.blocks // size)
    # Unknowns in the new order; the last block is padded with unknowns that couple to nothing.
    numbers = np.full(count * size * at.width, at.unknowns)
    numbers[: at.unknowns] = (order[:, None] * at.width + np.arange(at.width)).ravel()
    numbers = numbers.reshape(count, size * at.width)
    place_of = lookup(at)
    diagonal = np.stack([place_of(rows[:, None], rows[None, :]) for rows in numbers])
    block, row = np.nonzero(numbers == at.unknowns)
    diagonal[block, row, row] = _one(at)
    below = np.stack([place_of(lower[:, None], upper[None, :]) for upper, lower in itertools.pairwise(numbers)])
    back = np.argsort(numbers.ravel()[: at.unknowns], kind="stable")

    def factorise(_: Sequence[Array], values: Float[Array, " entries"]) -> tuple[Array, Array]:
        values = with_constants(values)
        return factorise_blocks(values[diagonal], values[below])

    def solve(factor: tuple[Array, Array], b: Blocks) -> Blocks:
        right = jnp.append(jnp.where(at.free, b, 0).reshape(-1), 0)[numbers]
        return solve_blocks(factor, right).reshape(-1)[back].reshape(b.shape)

    return LinearSolver(factorise, solve, solve)


def sparse(_: Sequence[ElementEnergy], at: Pattern, *, tables: sparse_cholesky.Plan | None = None) -> LinearSolver:
    """Factorises by tiles after nested dissection; pass `tables` if the plan is already computed.

    The factor also serves as a preconditioner for similar matrices: `solve` takes any right-hand side.
    """
    tables = sparse_cholesky.plan(at) if tables is None else tables

    def factorise(_: Sequence[Array], values: Float[Array, " entries"]) -> sparse_cholesky.Tiles:
        return sparse_cholesky.factorise(tables, values)

    def solve(factor: sparse_cholesky.Tiles, b: Blocks) -> Blocks:
        return sparse_cholesky.solve(tables, factor, b.reshape(-1)).reshape(b.shape)

    return LinearSolver(factorise, solve, solve)


def matrix_free(energies: Sequence[ElementEnergy], at: Pattern, *, products: int = _UPPER_PRODUCTS) -> LinearSolver:
    """Solves by conjugate gradients with a block-Jacobi preconditioner, on products with the element Hessians.

    The solution is not finite if it misses its relative residual after `products` products.
    """
    n, b = at.blocks, at.width
    numbers = np.arange(n * b).reshape(n, b)
    of_blocks = lookup(at)(numbers[:, :, None], numbers[:, None, :])

    def factorise(hessians: Sequence[Array], values: Float[Array, " entries"]) -> tuple[tuple[Array, ...], Array]:
        inverse = jax.vmap(partial(eliminate, b=jnp.eye(b, dtype=values.dtype)))(with_constants(values)[of_blocks])
        return tuple(map(square, hessians)), inverse

    def run(tolerance: float, factor: tuple[tuple[Array, ...], Array], right: Blocks) -> Blocks:
        hessians, inverse = factor

        def product(x: Blocks) -> Blocks:
            return jnp.where(at.free, summed_products(energies, at, hessians, x), 0)

        def precondition(x: Blocks) -> Blocks:
            return (inverse @ x[..., None])[..., 0]

        right = jnp.where(at.free, right, 0)
        return conjugate_gradients(product, right, precondition, tolerance=tolerance, iterations=products)

    return LinearSolver(factorise, partial(run, _SOLVE_RESIDUAL), partial(run, _SEARCH_RESIDUAL))


def by_size(energies: Sequence[ElementEnergy], at: Pattern) -> LinearSolver:
    """Chooses the method with the least work by size and structure, for unknown stiffness."""
    return least_work(energies, at)(energies, at)


def least_work(
    energies: Sequence[ElementEnergy], at: Pattern, x: Blocks | None = None, data: Sequence[Any] | None = None
) -> LinearSolverFactory:
    """Returns the factory with the least work, for the Hessian at x if the data of the elements are known."""
    if at.unknowns <= _DENSE_UNKNOWNS:
        return dense
    size = width_of_band(at, narrowest_order(at)) * at.width
    direct, work = block_tridiagonal, 2.0 * at.unknowns * size * (size + _BLOCK_OVERHEAD)
    fits = at.unknowns * size <= _UPPER_ENTRIES
    # A band that is narrower than a tile has no zero tiles.
    if size > TILE or not fits:
        tables = sparse_cholesky.plan(at)
        by_tiles = 2.0 * TILE**3 * (len(tables.left) + len(tables.row))
        if not fits and len(tables.row) * TILE**2 > _UPPER_TILE_ENTRIES:
            return matrix_free
        if not fits or by_tiles < work:
            direct, work = partial(sparse, tables=tables), by_tiles
    if x is None or data is None:
        return direct
    product = _OPERATIONS_OF_ENTRY * sum(len(e.indices) * (e.indices.shape[1] * at.width) ** 2 for e in energies)
    products = int(work / product)
    if products < _LOWER_PRODUCTS or not search_takes_at_most(products, energies, at, x, data):
        return direct
    return matrix_free


def known_data(values: Any, data: Callable[[], Any]) -> Any | None:
    """Returns the data of the elements, or `None` if a value is traced or a control is missing."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values)):
        return None
    try:
        with jax.ensure_compile_time_eval():
            return data()
    except InputError:
        return None


def search_takes_at_most(
    products: int, energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any]
) -> bool:
    """Returns whether `matrix_free` finds search directions by at most `products` products with the Hessian at x.

    Tries a uniform and a random right-hand side.
    """
    solver = matrix_free(energies, at, products=products)

    def search(x: Blocks, data: Sequence[Any], right: Float[Array, "2 n b"]) -> Blocks:
        hessians = element_hessians(energies, x, data)
        factor = solver.factorise(hessians, entries(at, hessians))
        return jax.lax.map(partial(solver.search, factor), right)

    random = np.random.default_rng(0).normal(size=x.shape)
    right = np.stack([np.ones(x.shape), random]).astype(x.dtype)
    with jax.ensure_compile_time_eval():
        return bool(np.isfinite(compiled(search)(x, data, right)).all())


def summed_products(
    energies: Sequence[ElementEnergy], at: Pattern, hessians: Sequence[Float[Array, "_ _ _"]], x: Blocks
) -> Blocks:
    """Returns the product of the sum of whole element Hessians, one array [m, s, s] per energy, with x."""
    out = jnp.zeros_like(x)
    for element, corners, of_elements in zip(energies, at.corners, hessians, strict=True):
        at_corners = x[element.indices].reshape(len(element.indices), -1, 1)
        out += assemble(corners, (of_elements @ at_corners)[..., 0].T)
    return out


def lookup(at: Pattern) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Returns (rows, columns) -> index into the entries followed by the constants 0 and 1; 0 beyond the matrix."""
    size = at.unknowns + 1
    key = at.rows * size + at.columns
    order = np.argsort(key)
    fixed = np.append(~at.free.ravel(), False)

    def places(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        row, column = np.broadcast_arrays(row, column)
        # Both triangles use the entries of the lower one.
        wanted = np.maximum(row, column) * size + np.minimum(row, column)
        nearest = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
        place = np.where(key[order][nearest] == wanted, order[nearest], len(key))
        return np.where((row == column) & fixed[row], _one(at), place)

    return places


def _one(at: Pattern) -> int:
    return len(at.rows) + 1


def with_constants(values: Float[Array, " entries"]) -> Float[Array, " entries2"]:
    """Appends the constants 0 and 1 to the entries, for the indices of `lookup`."""
    return jnp.concatenate([values, jnp.asarray([0, 1], values.dtype)])


def narrowest_order(at: Pattern) -> Int[np.ndarray, " n"]:
    """Returns the reverse Cuthill-McKee order, or the given one if its band is narrower (meshes built by rows)."""
    rows, columns = at.rows // at.width, at.columns // at.width
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(at.blocks, at.blocks)).tocsr()
    ordering = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True).astype(int)
    return min(ordering, np.arange(at.blocks), key=lambda order: width_of_band(at, order))


def width_of_band(at: Pattern, order: np.ndarray) -> int:
    """Returns the largest distance in the order between two coupled blocks, at least 1."""
    place = np.argsort(order)
    return max(1, int(np.abs(place[at.rows // at.width] - place[at.columns // at.width]).max(initial=0)))
