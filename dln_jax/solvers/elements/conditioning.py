"""Measures how many products conjugate gradients need for a search direction, before a solver is chosen.

Stiffness, Poisson's ratio, time step and mesh together determine the number of products, which grows with the square
root of the condition number of the Hessian. It can be measured only for concrete numbers.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import cg

from dln_jax.solvers.elements.assembly import Pattern
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy


def search_takes_at_most(
    products: int, energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any], *, residual: float
) -> bool:
    """Returns whether conjugate gradients with a block-Jacobi preconditioner need at most `products` products.

    It solves with the Hessian at x for a uniform and a random right-hand side, and compiles one product of an element's
    Hessian.

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
    rows, columns, values = [], [], []
    with jax.ensure_compile_time_eval():
        for element, of in zip(energies, data, strict=True):
            whole = np.asarray(jax.jit(jax.vmap(partial(_element_hessian, element)))(x[element.indices], of), float)
            unknowns = (element.indices[:, :, None] * at.width + np.arange(at.width)).reshape(len(whole), -1)
            rows.append(np.broadcast_to(unknowns[:, :, None], whole.shape).ravel())
            columns.append(np.broadcast_to(unknowns[:, None, :], whole.shape).ravel())
            values.append(whole.ravel())
    row, column, value = map(np.concatenate, (rows, columns, values))
    free = at.free.ravel()
    place = np.cumsum(free) - 1
    kept = free[row] & free[column]
    row, column, value = row[kept], column[kept], value[kept]
    shape = (int(free.sum()), int(free.sum()))
    hessian = csr_array(coo_array((value, (place[row], place[column])), shape=shape))
    near = row // at.width == column // at.width
    blocks = np.zeros((at.blocks, at.width, at.width))
    np.add.at(blocks, (row[near] // at.width, row[near] % at.width, column[near] % at.width), value[near])
    blocks[:, np.arange(at.width), np.arange(at.width)] += ~at.free
    inverses = np.linalg.pinv(blocks)
    numbers = np.arange(at.unknowns).reshape(at.blocks, at.width)
    row, column = (np.broadcast_to(n, blocks.shape).ravel() for n in (numbers[:, :, None], numbers[:, None, :]))
    kept = free[row] & free[column]
    inverse = coo_array((inverses.ravel()[kept], (place[row[kept]], place[column[kept]])), shape=shape)
    return hessian, csr_array(inverse)


def _element_hessian(element: ElementEnergy, x: Float[Array, "k b"], data: Any) -> Float[Array, "s s"]:
    """Computes the Hessian by columns in a loop, which compiles several times faster than unrolled columns."""

    def column(direction: Float[Array, " s"]) -> Float[Array, " s"]:
        along = direction.reshape(x.shape)
        return jax.jvp(lambda x: jax.grad(element.energy)(x, data), (x,), (along,))[1].reshape(-1)

    return jax.lax.map(column, jnp.eye(x.size, dtype=x.dtype))
