"""Structured symmetric systems: block-tridiagonal and banded Cholesky factorisations, and conjugate gradients.

Block-tridiagonal matrices are factorised by a scan over the blocks:

    H = [[D_0, C_1ᵀ, ...], [C_1, D_1, C_2ᵀ, ...], ...],    H = L Lᵀ with diagonal blocks L_i and blocks W_i below them:
    L_i L_iᵀ = D_i - W_i W_iᵀ,    W_i L_{i-1}ᵀ = C_i

Many narrow-band systems A x = b, A = L Lᵀ, are solved side by side, because a library call per system costs more than
its few hundred operations per unknown. Every number is a vector over the systems (the last axis), so a loop over the
columns works on long vectors. Unknowns are taken in pairs:

    X_J = A_J - sum over P >= 1 of L_{J-P} (L_{J-P}'s pair at J)ᵀ,    L_JJ L_JJᵀ = X_JJ,    L_IJ = X_IJ L_JJ⁻ᵀ

(left-looking; Golub and Van Loan 2013, sections 4.2 and 4.3). Right-hand sides are rows below A and become L⁻¹ b.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dln_jax.solvers.elimination import cholesky, substitute

Vector = Float[Array, "..."]
Factor = tuple[Float[Array, "count s s"], Float[Array, "count s s"]]
"""(L_i, W_i); W_0 is zero."""
PAIR = 2
"""Unknowns per step of the loop. Fastest of 1 to 4, measured on two cores with 4 to 64 systems."""

Columns = Float[Array, "pairs rows 2 systems"]
"""Pairs of columns of the lower triangle: [J, r, c] is the entry (2 J + r, 2 J + c)."""


def factorise_blocks(diagonal: Float[Array, "count s s"], below: Float[Array, "count1 s s"]) -> Factor:
    """Returns L of a block-tridiagonal matrix; not finite if the matrix is not positive definite.

    Args:
        diagonal: D_i; only their lower triangles are read.
        below: C_1, C_2, ...: rows of block i, columns of block i - 1.
    """

    def eliminate(previous: Array, blocks: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        d, c = blocks
        w = substitute(previous, c, transposed=True, right=True)
        factor = cholesky(d - w @ w.T)
        return factor, (factor, w)

    first = cholesky(diagonal[0])
    _, (factors, w) = jax.lax.scan(eliminate, first, (diagonal[1:], below))
    return jnp.concatenate([first[None], factors]), jnp.concatenate([jnp.zeros_like(first)[None], w])


def solve_blocks(factor: Factor, b: Float[Array, "count s"]) -> Float[Array, "count s"]:
    """Returns x with L Lᵀ x = b."""

    def forwards(y: Array, blocks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, w, right = blocks
        y = substitute(lower, (right - w @ y)[:, None])[:, 0]
        return y, y

    def backwards(carry: Array, blocks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, w, y = blocks
        x = substitute(lower, (y - carry)[:, None], transposed=True)[:, 0]
        return w.T @ x, x

    zero = jnp.zeros_like(b[0])
    _, y = jax.lax.scan(forwards, zero, (*factor, b))
    _, x = jax.lax.scan(backwards, zero, (*factor, y), reverse=True)
    return x


def conjugate_gradients(
    product: Callable[[Vector], Vector],
    b: Vector,
    precondition: Callable[[Vector], Vector],
    *,
    tolerance: float,
    iterations: int,
) -> Vector:
    """Returns x with A x = b to a relative residual, |b - A x| <= tolerance |b|, starting from x = 0.

    The result is not finite if A is not positive definite (a direction of curvature <= 0) or iterations run out.

    Args:
        product: x -> A x, A symmetric.
        precondition: r -> an approximation of A⁻¹ r, symmetric positive definite.
        iterations: largest number of products.
    """
    enough = tolerance * jnp.linalg.norm(b.reshape(-1))

    def more(state):
        _, r, _, _, count, definite = state
        return (jnp.linalg.norm(r.reshape(-1)) > enough) & (count < iterations) & definite

    def iterate(state):
        x, r, p, rz, count, _ = state
        product_p = product(p)
        curvature = jnp.vdot(p, product_p)
        length = rz / curvature
        x, r = x + length * p, r - length * product_p
        z = precondition(r)
        next_rz = jnp.vdot(r, z)
        return x, r, z + (next_rz / rz) * p, next_rz, count + 1, curvature > 0

    z = precondition(b)
    # A non-finite right-hand side ends the loop at once, because comparisons with NaN are false.
    last = jax.lax.while_loop(more, iterate, (jnp.zeros_like(b), b, z, jnp.vdot(b, z), 0, jnp.asarray(True)))
    x, r, _, _, _, definite = last
    solved = definite & (jnp.linalg.norm(r.reshape(-1)) <= enough)
    return jnp.where(solved, x, jnp.nan)


def places(unknowns: int, band: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns rows and columns of the entries [pairs, rows, 2] of `Columns`; some are beyond the matrix.

    Args:
        unknowns: n.
        band: largest i - j of a nonzero entry.
    """
    rows = PAIR * (1 + -(-band // PAIR))
    first, row, column = np.ogrid[: -(-unknowns // PAIR), :rows, :PAIR]
    return PAIR * first + row + 0 * column, PAIR * first + 0 * row + column


def solve_bands(lower: Columns, b: Float[Array, "unknowns k systems"]) -> Float[Array, "unknowns k systems"]:
    """Returns x with A x = b for all systems; not finite for a matrix that is not positive definite.

    Args:
        lower: entries of A at `places`; beyond the matrix, entries of the unit matrix.
        b: k right-hand sides of every system.
    """
    count, rows, _, systems = lower.shape
    unknowns, k, _ = b.shape
    below = rows // PAIR - 1
    padded = jnp.pad(b, ((0, PAIR * count - unknowns), (0, 0), (0, 0)))
    right = padded.reshape(count, PAIR, k, systems).swapaxes(1, 2)
    before = jnp.zeros((below, rows + k, PAIR, systems), lower.dtype)
    columns = jnp.concatenate([before, jnp.concatenate([lower, right], axis=1)])

    def eliminate(pair: Array, columns: Array) -> Array:
        window = lax.dynamic_slice_in_dim(columns, pair, below + 1)
        return lax.dynamic_update_slice_in_dim(columns, _eliminated(window, rows)[None], pair + below, 0)

    columns = lax.fori_loop(0, count, eliminate, columns)

    def two_unknowns(step: Array, x: Array) -> Array:
        """Finds two unknowns of Lᵀ x = y from the known ones after them."""
        pair = count - 1 - step
        column = lax.dynamic_index_in_dim(columns, pair + below, keepdims=False)
        known = lax.dynamic_slice_in_dim(x, PAIR * (pair + 1), PAIR * below)
        panel = column[PAIR:rows]
        first, second = (column[rows:, i] - jnp.sum(panel[:, None, i] * known, axis=0) for i in range(PAIR))
        second *= column[1, 1]
        own = jnp.stack([(first - column[1, 0] * second) * column[0, 0], second])
        return lax.dynamic_update_slice_in_dim(x, own, PAIR * pair, 0)

    x = jnp.zeros((PAIR * (count + below), k, systems), lower.dtype)
    return lax.fori_loop(0, count, two_unknowns, x)[:unknowns]


def _eliminated(window: Float[Array, "pairs rows 2 systems"], rows: int) -> Float[Array, "rows 2 systems"]:
    """Returns the window's last pair of columns of L from the pairs before it, with 1 / L_jj on the diagonal."""
    *before, own = window
    before = before[::-1]

    def without(start: int, stop: int, earlier: int) -> Array:
        """Returns rows start:stop of the pair, minus the contributions of the `earlier` pairs before it."""
        solution = own[start:stop]
        for distance, column in enumerate(before[:earlier], start=1):
            shift = PAIR * distance if stop <= rows else 0
            left, right = column[start + shift : stop + shift], column[PAIR * distance : PAIR * (distance + 1)]
            solution -= sum(left[:, None, i] * right[None, :, i] for i in range(PAIR))
        return solution

    pairs = [without(row, row + PAIR, len(before) - row // PAIR) for row in range(0, rows, PAIR)]
    (first, _), (corner, second) = pairs[0]
    first = 1 / jnp.sqrt(first)
    corner *= first
    second = 1 / jnp.sqrt(second - corner**2)
    panel = jnp.concatenate([*pairs[1:], without(rows, own.shape[0], len(before))])
    left = panel[:, 0] * first
    right = (panel[:, 1] - left * corner) * second
    top = jnp.stack([jnp.stack([first, jnp.zeros_like(first)]), jnp.stack([corner, second])])
    return jnp.concatenate([top, jnp.stack([left, right], axis=1)])
