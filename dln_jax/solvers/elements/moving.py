"""Sums of element energies over elements that change with the unknowns, such as pairs of primitives in contact.

An energy of moving elements is a function of a few blocks of unknowns, as in `energies`, but the blocks depend on the
unknowns. It lists all elements that may act between two points, with a fixed capacity, and limits the step. The
elements of a list are fixed, also in derivatives.

Their systems are solved densely or by conjugate gradients. The preconditioner is the factor of the static elements with
the diagonal blocks of the moving elements. It takes about as many iterations as there are acting elements, or fewer.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.solvers.elements.assembly import Pattern
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, square
from dln_jax.solvers.elements.linear_solvers import LinearSolver, lookup, sparse, summed_products, with_constants
from dln_jax.solvers.elements.symmetric_systems import conjugate_gradients
from dln_jax.solvers.elimination import cholesky, substitute, symmetric_eigen

_DENSE_UNKNOWNS = 1000
"""Largest system solved densely: its factorisation takes about as long as its assembly."""
_SOLVE_RESIDUAL = 1e-11
_SEARCH_RESIDUAL = 1e-4
_UPPER_PRODUCTS = 3000


class Elements(NamedTuple):
    """Elements that may act between two points."""

    indices: Int[Array, "capacity k"]
    """Blocks of unknowns of every element; all different in a used element."""
    data: Any
    """Further data of the elements, without derivatives: a pytree with leading axis `capacity`."""
    overflow: Bool[Array, ""]
    """True if elements had to be left out."""


class MovingEnergy(NamedTuple):
    """A sum of one scalar function over elements that change; `data` is the energy's own, differentiable."""

    elements: Callable[[Blocks, Blocks, Any], Elements]
    """(x, step, data) -> all elements that may act anywhere between x and x + step."""
    describe: Callable[[Blocks, Elements, Any], Any]
    """(x, elements, data) -> the data of the elements for the energy at x."""
    gradient: Callable[[Float[Array, "k b"], Any], tuple[Float[Array, ""], Float[Array, "k b"]]]
    """(unknowns of one element, its data) -> energy and its gradient."""
    hessian: Callable[[Float[Array, "k b"], Any], Float[Array, "s s"]]
    """(unknowns of one element, its data) -> its Hessian, s = k b."""
    longest: Callable[[Blocks, Blocks, Elements, Any], Float[Array, ""]]
    """(x, step, elements, data) -> largest fraction of the step, at most 1, that keeps the energy finite."""


Lists = tuple[Elements, ...]


def lists_between(moving: Sequence[MovingEnergy], x: Blocks, step: Blocks, data: Sequence[Any]) -> Lists:
    """Returns the elements of all energies between x and x + step."""
    x, step, data = jax.lax.stop_gradient((x, step, tuple(data)))
    return tuple(m.elements(x, step, of) for m, of in zip(moving, data, strict=True))


def overflow(lists: Lists) -> Bool[Array, ""]:
    """Returns whether any list was too short."""
    return jnp.stack([jnp.asarray(False), *(elements.overflow for elements in lists)]).any()


def moving_gradient(
    moving: Sequence[MovingEnergy], x: Blocks, lists: Lists, data: Sequence[Any]
) -> tuple[Float[Array, ""], Blocks]:
    """Returns the sum of the energies and its gradient."""
    total, gradient = jnp.zeros((), x.dtype), jnp.zeros_like(x)
    for m, at, of in zip(moving, lists, data, strict=True):
        values, slopes = jax.vmap(m.gradient)(x[at.indices], m.describe(x, at, of))
        total += values.sum()
        gradient = gradient.at[at.indices].add(slopes)
    return total, gradient


def moving_hessians(
    moving: Sequence[MovingEnergy], x: Blocks, lists: Lists, data: Sequence[Any]
) -> tuple[Float[Array, "_ _ _"], ...]:
    """Returns the Hessians of the elements."""
    return tuple(
        jax.vmap(m.hessian)(x[at.indices], m.describe(x, at, of)) for m, at, of in zip(moving, lists, data, strict=True)
    )


def moving_products(lists: Lists, hessians: Sequence[Array], x: Blocks) -> Blocks:
    """Returns the product of the sum of the Hessians with x."""
    out = jnp.zeros_like(x)
    for elements, blocks in zip(lists, hessians, strict=True):
        at_corners = x[elements.indices].reshape(len(blocks), -1, 1)
        out = out.at[elements.indices].add((blocks @ at_corners).reshape(*elements.indices.shape, -1))
    return out


def with_moving(energies: Sequence[ElementEnergy], at: Pattern) -> LinearSolver:
    """Returns the solver of systems with the Hessians of static and moving elements.

    Its `factorise` takes (static element Hessians, (entries of their sum, lists, moving Hessians)).

    Args:
        energies: the static elements.
        at: their pattern.
    """
    if at.unknowns > _DENSE_UNKNOWNS:
        return _iterative(energies, at)
    numbers = np.arange(at.unknowns)
    table = lookup(at)(numbers[:, None], numbers[None, :])

    def factorise(_: Sequence[Array], parts: tuple[Array, Lists, Sequence[Array]]) -> Array:
        values, lists, hessians = parts
        matrix = with_constants(values)[table]
        for elements, blocks in zip(lists, hessians, strict=True):
            unknowns = (elements.indices[:, :, None] * at.width + jnp.arange(at.width)).reshape(len(blocks), -1)
            free = jnp.asarray(at.free.ravel())[unknowns]
            kept = blocks * free[:, :, None] * free[:, None, :]
            matrix = matrix.at[unknowns[:, :, None], unknowns[:, None, :]].add(kept)
        return cholesky(matrix)

    def solve(factor: Array, b: Blocks) -> Blocks:
        right = jnp.where(at.free, b, 0).reshape(-1, 1)
        return substitute(factor, substitute(factor, right), transposed=True).reshape(b.shape)

    return LinearSolver(factorise, solve, solve)


def project_moving(hessians: Float[Array, "capacity s s"]) -> Float[Array, "capacity s s"]:
    """Sets negative eigenvalues to zero, one acting element after the other, because few act."""
    hessians = jnp.where(jnp.isfinite(hessians), hessians, 0)
    acting = (hessians != 0).any(axis=(1, 2))
    order = jnp.argsort(~acting)

    def project(number: Array, hessians: Array) -> Array:
        place = order[number]
        values, vectors = symmetric_eigen(hessians[place])
        return hessians.at[place].set((vectors * jnp.maximum(values, 0)) @ vectors.T)

    return jax.lax.fori_loop(0, acting.sum(), project, hessians)


def _iterative(energies: Sequence[ElementEnergy], at: Pattern) -> LinearSolver:
    static = sparse(energies, at)
    numbers = np.arange(at.unknowns).reshape(at.blocks, at.width)
    blocks_of = lookup(at)(numbers[:, :, None], numbers[:, None, :])
    # The diagonal blocks of every vertex are entries of the static pattern.
    own_entries = (blocks_of < len(at.rows)) & np.tril(np.ones((at.width, at.width), bool))

    def factorise(hessians: Sequence[Array], parts: tuple[Array, Lists, Sequence[Array]]) -> Any:
        values, lists, moving = parts
        diagonal = jnp.zeros((at.blocks, at.width, at.width), values.dtype)
        for elements, blocks in zip(lists, moving, strict=True):
            k = elements.indices.shape[1]
            own = blocks.reshape(-1, k, at.width, k, at.width)
            own = jnp.stack([own[:, i, :, i] for i in range(k)], axis=1)
            diagonal = diagonal.at[elements.indices].add(own)
        added = values.at[blocks_of[own_entries]].add(diagonal[own_entries])
        return tuple(map(square, hessians)), (lists, tuple(moving)), static.factorise(hessians, added)

    def run(tolerance: float, factor: Any, right: Blocks) -> Blocks:
        hessians, (lists, moving), of_static = factor

        def product(x: Blocks) -> Blocks:
            out = summed_products(energies, at, hessians, x) + moving_products(lists, moving, x)
            return jnp.where(at.free, out, 0)

        right = jnp.where(at.free, right, 0)

        precondition = partial(static.solve, of_static)
        return conjugate_gradients(product, right, precondition, tolerance=tolerance, iterations=_UPPER_PRODUCTS)

    return LinearSolver(factorise, partial(run, _SOLVE_RESIDUAL), partial(run, _SEARCH_RESIDUAL))
