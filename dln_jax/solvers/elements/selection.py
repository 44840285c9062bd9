"""Chooses a linear solver before tracing, by the operations that it takes.

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
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from dln_jax.precision import compiled
from dln_jax.solvers.elements import sparse_cholesky
from dln_jax.solvers.elements.assembly import Pattern, entries
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, element_hessians
from dln_jax.solvers.elements.linear_solvers import (
    LinearSolver,
    LinearSolverFactory,
    block_tridiagonal,
    dense,
    matrix_free,
    narrowest_order,
    sparse,
    width_of_band,
)
from dln_jax.solvers.elements.sparse_cholesky import TILE
from dln_jax.types import InputError

# With more unknowns the dense factorisation is slower than the block-tridiagonal one.
_DENSE_UNKNOWNS = 160
# Small blocks are slower for each operation, as if a block had this many more rows.
_BLOCK_OVERHEAD = 150
# Operations of a factorisation that take as long as an entry of the element Hessians in a product, which reads it from
# memory; an inexact search also needs 1.75 times the Newton iterations.
_OPERATIONS_OF_ENTRY = 16
# So few products gain little, and counting them costs a compilation.
_LOWER_PRODUCTS = 20
# Largest numbers of entries of the blocks of a band, and of the tiles, whose places are 32-bit numbers.
_UPPER_ENTRIES = 3e7
_UPPER_TILE_ENTRIES = 5e8


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
