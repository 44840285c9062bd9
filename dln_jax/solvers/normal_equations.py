"""Normal equations of a least-squares problem, summed over chunks of samples, and their factorisation.

A problem is a function of ONE sample, `sample_residual(parameters, *sample) -> [r]`. For N samples and P parameters the
Jacobian has N r rows; here it is J [P, rows], parameters first, because J Jᵀ multiplies fastest in this layout. Only
one piece of it is alive at a time, unless the caller wants to keep it; `jacobian_bytes` returns the memory.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jax.sharding import Mesh
from jaxtyping import Float

from dln_jax.scale import total
from dln_jax.types import InputError

SampleResidual = Callable[..., Array]
"""(parameters, *sample) -> residuals of one sample, [r] or another shape."""

# J Jᵀ is symmetric: blocks of this many rows, each as wide as the lower triangle needs, save up to half the products.
_ROWS_PER_BLOCK = 200


class Chunks(NamedTuple):
    """Samples in `k` equal chunks of `c`; the last chunk is padded with samples of weight 0."""

    arrays: tuple[Any, ...]
    """Arrays [k, c, ...], or None."""
    weights: Array
    """1 for a sample, 0 for padding, [k, c]."""


ScaledFactor = tuple[Float[Array, "P P"], Float[Array, "P"]]
"""L and the diagonal 1 / sqrt(A_ii) of S of a positive definite matrix A = S⁻¹ L Lᵀ S⁻¹, scaled to unit diagonal."""


def count(parameters: Any) -> int:
    """Returns P, the number of scalars in a tree of parameters."""
    return sum(int(np.prod(np.shape(leaf))) for leaf in jax.tree.leaves(parameters))


def jacobian_bytes(parameters: Any, samples: int, residuals: int, *, chunk_size: int, keep: bool) -> int:
    """Returns the bytes of the arrays that grow with the problem: 8 (4 P² + P chunk_size b + [P N r if kept]).

    There are P parameters and N samples with r residuals. 4 P² is the matrix, its damped copy, its factor and a spare;
    a piece of the Jacobian has b = 1 residual per sample in reverse mode (r < P), and b = r in forward mode.
    Intermediate values of the residual function itself, for `chunk_size` samples, come on top.
    """
    size = count(parameters)
    piece = size * min(chunk_size, samples) * (1 if residuals < size else residuals)
    return 8 * (4 * size**2 + piece + (size * samples * residuals if keep else 0))


def check_precision(tree: Any, what: str) -> None:
    """Raises InputError if a leaf is not float64."""
    others = {str(jnp.result_type(getattr(leaf, "dtype", leaf))) for leaf in jax.tree.leaves(tree)} - {"float64"}
    if others:
        raise InputError(
            f"{what} are {', '.join(sorted(others))}; Gauss-Newton needs float64, for normal equations square the "
            "condition number: set jax_enable_x64 (--precision f64) before arrays are made"
        )


def residual_count(sample_residual: SampleResidual, parameters: Any, chunks: Chunks) -> int:
    """Returns the number of residuals per sample.

    Raises:
        InputError: parameters or residuals are not float64.
    """
    check_precision(parameters, "parameters")
    one = jax.tree.map(lambda array: array[0, 0], chunks.arrays)
    residual = jax.eval_shape(sample_residual, parameters, *one)
    check_precision(residual, "residuals")
    return residual.size


def split(arrays: tuple[Any, ...], chunk_size: int, *, devices: int = 1) -> Chunks:
    """Splits samples into the fewest equal chunks of at most `chunk_size`, with equally many per device.

    The first sample serves as padding.

    Raises:
        InputError: arrays differ in length, or are empty.
    """
    lengths = [array.shape[0] if array.ndim else 0 for array in jax.tree.leaves(arrays)]
    if len(set(lengths)) != 1 or lengths[0] == 0:
        raise InputError(f"data arrays have {lengths} samples on axis 0; expected the same positive number in each")
    samples = lengths[0]
    pieces = devices * -(-samples // (devices * chunk_size))
    length = -(-samples // pieces)
    fillers = pieces * length - samples
    rows = jnp.concatenate([jnp.arange(samples), jnp.zeros(fillers, int)])
    weights = jnp.concatenate([jnp.ones(samples), jnp.zeros(fillers)])
    return Chunks(
        jax.tree.map(lambda array: array[rows].reshape(pieces, length, *array.shape[1:]), arrays),
        weights.reshape(pieces, length),
    )


def normal_equations(
    sample_residual: SampleResidual, parameters: Any, chunks: Chunks, *, keep: bool, mesh: Mesh | None = None
) -> tuple[Float[Array, "P P"], Float[Array, "P"], Float[Array, ""], Array | None]:
    """Returns J Jᵀ (read only its lower triangle), J r and the sum of r², and J with `keep`, else `None`.

    The sums are over all samples; the caller divides by their number. J is [k, blocks, P, rows of a block].

    With a mesh, call it in a function of `scale.on_devices`: chunks and Jacobian belong to this device, the sums
    to all devices.
    Reverse mode gives the rows, one residual at a time for all samples of a chunk; forward mode is used if a sample has
    at least as many residuals as there are parameters.
    """
    point, unravel = ravel_pytree(parameters)
    size = point.shape[0]
    edges = np.linspace(0, size, -(-size // _ROWS_PER_BLOCK) + 1).astype(int)

    def one(*sample):
        return jax.vjp(lambda tree: jnp.ravel(sample_residual(tree, *sample)), parameters)

    def forward(samples: tuple[Any, ...]) -> Array:
        def along(direction: Array) -> Array:
            return jax.jvp(lambda x: residuals_of(sample_residual, unravel(x), samples), (point,), (direction,))[1]

        return lax.map(lambda direction: along(direction).ravel(), jnp.eye(size))

    def add_chunk(sums, chunk):
        samples, weights = chunk
        residuals, pull_back = jax.vmap(one)(*samples)
        rows = residuals.shape[1]
        if rows >= size:
            weights = jnp.tile(weights, rows)
            sums, jacobian = add(sums, forward(samples), residuals.T.ravel(), weights)
            return sums, None if jacobian is None else jacobian[None]

        def add_residual(sums, residual):
            cotangent, values = residual
            # Leaves are joined after the pull-back: the transpose of splitting a vector is a sum of padded ones.
            jacobian = jax.vmap(lambda pull: ravel_pytree(pull(cotangent)[0])[0], out_axes=-1)(pull_back)
            return add(sums, jacobian, values, weights)

        return lax.scan(add_residual, sums, (jnp.eye(rows), residuals.T))

    def add(sums, jacobian: Array, residuals: Array, weights: Array):
        matrix, vector, squares = sums
        jacobian, residuals = jacobian * weights, residuals * weights
        matrix = tuple(
            block + jacobian[start:stop] @ jacobian[:stop].T
            for block, (start, stop) in zip(matrix, pairwise(edges), strict=True)
        )
        sums = (matrix, vector + jacobian @ residuals, squares + residuals @ residuals)
        return sums, jacobian if keep else None

    zeros = tuple(jnp.zeros((stop - start, stop)) for start, stop in pairwise(edges))
    (matrix, vector, squares), jacobian = lax.scan(add_chunk, (zeros, jnp.zeros(size), jnp.zeros(())), chunks)
    matrix, vector, squares = total((matrix, vector, squares), mesh)
    lower = jnp.concatenate([jnp.pad(block, ((0, 0), (0, size - block.shape[1]))) for block in matrix])
    return lower, vector, squares, jacobian


def residuals_of(sample_residual: SampleResidual, parameters: Any, samples: tuple[Any, ...]) -> Float[Array, "r c"]:
    """Returns the residuals of c samples, one row per residual of a sample."""
    return jax.vmap(lambda *sample: jnp.ravel(sample_residual(parameters, *sample)))(*samples).T


def residuals(sample_residual: SampleResidual, parameters: Any, chunks: Chunks) -> Float[Array, "k r c"]:
    """Returns the residuals at `parameters`, 0 for padding."""
    return lax.map(lambda chunk: residuals_of(sample_residual, parameters, chunk[0]) * chunk[1], chunks)


def pull_back(
    sample_residual: SampleResidual,
    parameters: Any,
    chunks: Chunks,
    jacobian: Array | None,
    vectors: Float[Array, "k r c"],
    *,
    mesh: Mesh | None = None,
) -> Float[Array, "P"]:
    """Returns J w [P] for a vector w over the residuals: from the Jacobian if it was kept, else by reverse mode.

    With a mesh, chunks, Jacobian and w belong to this device, and the product to all devices (`normal_equations`).
    """

    def reverse(product: Array, piece) -> tuple[Array, None]:
        samples, vector = piece
        _, pull = jax.vjp(lambda tree: residuals_of(sample_residual, tree, samples), parameters)
        return product + ravel_pytree(pull(vector)[0])[0], None

    zero = jnp.zeros(count(parameters))
    if jacobian is None:
        product, _ = lax.scan(reverse, zero, (chunks.arrays, vectors * chunks.weights[:, None]))
        return total(product, mesh)
    pieces = jacobian.reshape(-1, *jacobian.shape[2:])
    product, _ = lax.scan(
        lambda product, piece: (product + piece[0] @ piece[1], None), zero, (pieces, vectors.reshape(len(pieces), -1))
    )
    return total(product, mesh)


def factorise(matrix: Float[Array, "P P"]) -> tuple[ScaledFactor, Array]:
    """Returns a factor of a symmetric matrix (lower triangle), and whether the fallback was needed.

    A matrix whose Cholesky factor, scaled to unit diagonal, exists and has all L_ii² > P eps is solved unchanged. Else
    it is singular to working precision: eigenvalues below P eps times the largest are raised to that, and L comes from
    a QR decomposition, which leaves the other directions unchanged (Golub and Van Loan 2013, sections 4.2, 8.1).
    """
    scaling = lax.rsqrt(jnp.diagonal(matrix))
    scaled = matrix * scaling * scaling[:, None]
    smallest = matrix.shape[0] * jnp.finfo(matrix.dtype).eps
    lower = lax.linalg.cholesky(scaled, symmetrize_input=False)
    well_conditioned = jnp.min(jnp.diagonal(lower)) ** 2 > smallest  # False if the factorisation failed with NaN

    def by_eigenvalues() -> Array:
        vectors, values = lax.linalg.eigh(scaled, lower=True, symmetrize_input=False)
        roots = jnp.sqrt(jnp.maximum(values, smallest * values[-1]))
        return jnp.linalg.qr(roots[:, None] * vectors.T, mode="r").T

    return (lax.cond(well_conditioned, lambda: lower, by_eigenvalues), scaling), ~well_conditioned


def solve(factor: ScaledFactor, b: Float[Array, "P"]) -> Float[Array, "P"]:
    """Returns x [P] with A x = b."""
    lower, scaling = factor
    forward = solve_triangular(lower, scaling * b, lower=True)
    return scaling * solve_triangular(lower, forward, lower=True, trans="T")
