"""Many symmetric positive definite systems with narrow bands, side by side: A x = b by Cholesky, A = L Lᵀ.

A few hundred operations per unknown are too few for one library call per system. Here every number is a vector over
the systems, the last axis, so that a loop over the columns works on long vectors. Unknowns are taken in pairs:

    X_J = A_J - sum over P >= 1 of L_{J-P} (L_{J-P}'s pair at J)ᵀ,    L_JJ L_JJᵀ = X_JJ,    L_IJ = X_IJ L_JJ⁻ᵀ

(left-looking; Golub and Van Loan 2013, sections 4.2 and 4.3). Right-hand sides are rows below the matrix, which the
factorisation turns into L⁻¹ b.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

PAIR = 2
"""Unknowns per step of the loop; the fastest of 1 to 4, measured on two cores with 4 to 64 systems."""

Columns = Float[Array, "pairs rows 2 systems"]
"""Pairs of columns of the lower triangle: [J, r, c] is the entry (2 J + r, 2 J + c)."""


def places(unknowns: int, band: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows and columns of the entries [pairs, rows, 2] of `Columns`, some of them beyond the matrix.

    Args:
        unknowns: n.
        band: largest i - j of a nonzero entry.
    """
    rows = PAIR * (1 + _pairs_below(band))
    first, row, column = np.ogrid[: _pairs(unknowns), :rows, :PAIR]
    return PAIR * first + row + 0 * column, PAIR * first + 0 * row + column


def solve_bands(lower: Columns, b: Float[Array, "unknowns k systems"]) -> Float[Array, "unknowns k systems"]:
    """Returns x with A x = b for all systems; not finite for a matrix that is not positive definite.

    Args:
        lower: entries of A at `places`; those beyond the matrix equal the unit matrix.
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

    def substitute(step: Array, x: Array) -> Array:
        pair = count - 1 - step
        column = lax.dynamic_index_in_dim(columns, pair + below, keepdims=False)
        known = lax.dynamic_slice_in_dim(x, PAIR * (pair + 1), PAIR * below)
        return lax.dynamic_update_slice_in_dim(x, _substituted(column, known, rows), PAIR * pair, 0)

    x = jnp.zeros((PAIR * (count + below), k, systems), lower.dtype)
    return lax.fori_loop(0, count, substitute, x)[:unknowns]


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


def _substituted(
    column: Float[Array, "rows 2 systems"], known: Float[Array, "rows2 k systems"], rows: int
) -> Float[Array, "2 k systems"]:
    """Returns two unknowns of Lᵀ x = y from the known ones after them."""
    panel = column[PAIR:rows]
    first, second = (column[rows:, i] - jnp.sum(panel[:, None, i] * known, axis=0) for i in range(PAIR))
    second *= column[1, 1]
    return jnp.stack([(first - column[1, 0] * second) * column[0, 0], second])


def _pairs(unknowns: int) -> int:
    return -(-unknowns // PAIR)


def _pairs_below(band: int) -> int:
    return (band + PAIR - 1) // PAIR
