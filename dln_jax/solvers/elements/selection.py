"""Chooses a linear solver before tracing, from the estimated work for size, structure and stiffness.

- `dense` for small systems;
- `block_tridiagonal` for narrow bands: bodies in the plane, and small or long ones in space;
- `sparse` for other systems, whatever their stiffness;
- `matrix_free` for soft bodies in small time steps, and for systems whose factor would not fit into memory.

Stiffness, Poisson's ratio, time step and mesh together determine how many products conjugate gradients need for a
search direction; it grows with the square root of the condition number, and can be counted for known values only.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from scipy.sparse import bsr_array, coo_array, csr_array, tril
from scipy.sparse.linalg import cg

from dln_jax.solvers.elements.assembly import Pattern, entries
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, lower_triangles, of_corners
from dln_jax.solvers.elements.linear_solvers import (
    SEARCH_RESIDUAL,
    TILE,
    LinearSolver,
    LinearSolverFactory,
    block_tridiagonal,
    dense,
    elimination_plan,
    matrix_free,
    narrowest_order,
    sparse,
    width_of_band,
)
from dln_jax.types import InputError

# With more unknowns the dense factorisation is slower than the block-tridiagonal one, measured on two cores.
_DENSE_UNKNOWNS = 160
# Measured as processor time of one core in float64, on eleven bodies in the plane and in space (675 to 20,502 unknowns,
# rows of cells and Delaunay meshes, nu 0.3 to 0.49, E 1e6 and 1e8 Pa, time steps of 1/60 s). A factorisation of n
# unknowns in blocks of b takes 1.3e-10 s n b (b + 150), within a factor of 1.6; a product with m element Hessians of s
# unknowns takes 6e-10 s m s², within 1.7. A search to 1e-2 takes 1.6 to 5 N^(1/d) products at nu = 0.3 and 7 to 16 at
# nu = 0.49 or E = 1e8, for N vertices in dimension d; because it is inexact, a step takes 1.5 to 2 times the Newton
# iterations. `_PRODUCTS` accounts for all of that. Time of whole steps in space by blocks, relative to matrix-free:
# 675 unknowns 0.69 (nu = 0.3) and 0.38 (0.49); 1,911: 1.19 and 0.50; 4,131 (6,994 tetrahedra): 1.88 and 0.74.
_BLOCK_SECONDS = 1.3e-10
_BLOCK_OVERHEAD = 150
_PRODUCT_SECONDS = 6e-10
_PRODUCTS = 15
# An inexact search takes this many times the Newton iterations, also when its products are measured.
_MORE_ITERATIONS = 1.75
_LOWER_PRODUCTS = 20
# Largest number of entries n b of the blocks that is stored; values, factor and index tables take 48 bytes per entry.
_UPPER_ENTRIES = 3e7
# Seconds per operation of the multifrontal factorisation: products of tiles, parts from children, targets, tiles below
# the diagonal and columns. Measured in the same way (825 to 21,756 unknowns), within a factor of 1.4.
_SPARSE_SECONDS = (22e-6, 15e-6, 7e-6, 20e-6, 25e-6)
# Lower bound per unknown for any tree: a column of tiles, one below it, and their targets and products.
_LEAST_SPARSE_SECONDS = 1e-4 / TILE
# Largest number of entries of the tiles, 8 bytes each; their places are 32-bit numbers.
_UPPER_TILE_ENTRIES = 5e8


def by_size(energies: Sequence[ElementEnergy], at: Pattern) -> LinearSolver:
    """Chooses the method with the least work by size and structure, for unknown stiffness."""
    return least_work(energies, at)(energies, at)


def by_stiffness(energies: Sequence[ElementEnergy], at: Pattern, *, x: Blocks, data: Sequence[Any]) -> LinearSolver:
    """Chooses the method with the least work for the Hessian at x, with concrete data of the elements."""
    measure = partial(search_takes_at_most, energies=energies, at=at, x=x, data=data, residual=SEARCH_RESIDUAL)
    return least_work(energies, at, measure)(energies, at)


def known_data(values: Any, data: Callable[[], Any]) -> Any | None:
    """Returns the data of the elements, or `None` if a value is traced or a control is missing."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values)):
        return None
    try:
        with jax.ensure_compile_time_eval():
            return data()
    except InputError:
        return None


def requested_or_chosen(
    requested: LinearSolverFactory | None, energies: Sequence[ElementEnergy], at: Pattern, x: Array, data: Any | None
) -> LinearSolverFactory:
    """Returns the requested linear solver, or the one with the least work, chosen once."""
    if requested is not None:
        return requested
    solver = by_size(energies, at) if data is None else by_stiffness(energies, at, x=x, data=data)
    return lambda *_: solver


def least_work(
    energies: Sequence[ElementEnergy], at: Pattern, search_takes_at_most: Callable[[int], bool] | None = None
) -> LinearSolverFactory:
    """Returns the factory with the least work, by estimates for factorisations and products.

    `search_takes_at_most` returns whether a search direction takes at most this many products; it is called only if
    size and structure do not settle the choice. Without it, moderate stiffness and nu = 0.3 are assumed.
    """
    if at.unknowns <= _DENSE_UNKNOWNS:
        return dense
    direct, factorisation = _direct(at)
    if direct is None:
        return matrix_free
    product = _PRODUCT_SECONDS * sum(len(e.indices) * (e.indices.shape[1] * at.width) ** 2 for e in energies)
    if search_takes_at_most is None:
        # Number of vertices along an edge of the body; a product carries information across one of them.
        across = at.blocks ** (1 / min(at.width, 3))
        return direct if factorisation <= _PRODUCTS * across * product else matrix_free
    affordable = int(factorisation / (_MORE_ITERATIONS * product))
    # So few products gain little, and measuring costs a compilation.
    if affordable < _LOWER_PRODUCTS or not search_takes_at_most(affordable):
        return direct
    return matrix_free


def _direct(at: Pattern) -> tuple[LinearSolverFactory | None, float]:
    """Returns the direct solver with the least work that fits into memory, if any, and its estimated seconds."""
    size = width_of_band(at, narrowest_order(at)) * at.width
    stored = at.unknowns * size
    seconds = _BLOCK_SECONDS * stored * (size + _BLOCK_OVERHEAD) if stored <= _UPPER_ENTRIES else np.inf
    if seconds <= _LEAST_SPARSE_SECONDS * at.unknowns:
        return block_tridiagonal, seconds
    tables = elimination_plan(at)
    counts = (tables.targets.products.sum(), *map(len, (tables.parts.upper, tables.targets.tile, tables.below)))
    sparse_seconds = float(np.dot(_SPARSE_SECONDS, (*counts, tables.steps.columns.sum())))
    if seconds <= sparse_seconds:
        return block_tridiagonal, seconds
    if tables.tiles * tables.size**2 > _UPPER_TILE_ENTRIES:
        return None, sparse_seconds
    return partial(sparse, tables=tables), sparse_seconds


def search_takes_at_most(
    products: int, energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any], *, residual: float
) -> bool:
    """Returns whether conjugate gradients with a block-Jacobi preconditioner need at most `products` products.

    Solves with the Hessian at x for a uniform and a random right-hand side; compiles one element Hessian product.

    Args:
        products: the limit, which also bounds the work.
        energies, at: the sum of energies and its pattern.
        x, data: concrete values.
        residual: relative residual of the solution.
    """
    hessian, inverse = _hessian(energies, at, x, data)
    unknowns = int(at.free.sum())
    right = np.stack([np.ones(unknowns), np.random.default_rng(0).normal(size=unknowns)])
    return all(_solved(hessian, inverse, b, products, residual) for b in right)


def _solved(hessian: csr_array, inverse: csr_array, b: np.ndarray, products: int, residual: float) -> bool:
    x, status = cg(hessian, b, rtol=residual, maxiter=products, M=inverse)
    return status == 0 and bool(np.isfinite(x).all())


def _hessian(
    energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any]
) -> tuple[csr_array, csr_array]:
    """Returns the Hessian of the free unknowns, and the inverses of its diagonal blocks."""
    with jax.ensure_compile_time_eval():
        hessians = [
            lower_triangles(jax.jit(jax.vmap(partial(_element_hessian, element)))(x[element.indices], of_elements))
            for element, of_elements in zip(energies, data, strict=True)
        ]
        values = np.asarray(entries(at, hessians), float)
    lower = csr_array(coo_array((values, (at.rows, at.columns)), shape=(at.unknowns, at.unknowns)))
    (row, i), (column, j) = np.divmod(at.rows, at.width), np.divmod(at.columns, at.width)
    near = row == column
    blocks = np.eye(at.width) * ~at.free[:, :, None]
    blocks[row[near], i[near], j[near]] = blocks[row[near], j[near], i[near]] = values[near]
    places = np.arange(at.blocks + 1)
    inverse = csr_array(bsr_array((np.linalg.pinv(blocks), places[:-1], places), shape=lower.shape))
    free = np.flatnonzero(at.free)
    return tuple(matrix[free][:, free] for matrix in (csr_array(lower + tril(lower, -1).T), inverse))


def _element_hessian(element: ElementEnergy, x: Float[Array, "k b"], data: Any) -> Float[Array, "s s"]:
    """Computes the Hessian by columns in a loop, which compiles several times faster than unrolled columns."""

    def column(direction: Float[Array, " s"]) -> Float[Array, " s"]:
        along = direction.reshape(x.shape)
        return jax.jvp(lambda x: jax.grad(of_corners(element))(x, data), (x,), (along,))[1].reshape(-1)

    return jax.lax.map(column, jnp.eye(x.size, dtype=x.dtype))
