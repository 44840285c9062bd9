"""Rules that lower JAX's primitives to nodes of a program, except indexing and control flow.

Primitives with an operation of the same name in `operations.OPERATIONS` need no rule.

A rule takes the program, the equation's arguments and the needed parameters by keyword, and returns one or several
results. Two more keywords are `results`, the abstract values of the results, and `kind`, the kind of the first.
"""

import functools
from collections.abc import Callable, Sequence
from itertools import accumulate
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dln_jax.export.c.nodes import UNROLL_LIMIT, Node, zeros
from dln_jax.export.c.operations import neutral, on_kind
from dln_jax.export.c.program import Program
from dln_jax.export.c.text import NUMPY_TYPES
from dln_jax.types import InputError

Rule = Callable[..., Any]


def convert(program: Program, node: Node, kind: str) -> Node:
    """Returns the node converted to a kind."""
    return node if node.dtype == kind else program.elementwise(f"to_{kind}", node)


def grouped(program: Program, node: Node, *groups: Sequence[int]) -> Node:
    """Returns the node with its axes transposed, and each group of axes flattened to one."""
    index = np.arange(node.size).reshape(node.shape).transpose([axis for group in groups for axis in group])
    return program.gather([node], index.reshape([prod(node.shape[axis] for axis in group) for group in groups]))


def rows_of(program: Program, node: Node, axes: Sequence[int]) -> Node:
    """Returns the node as a matrix [o, r] with the elements along `axes` as columns."""
    return grouped(program, node, _others(node, axes), axes)


def _others(node: Node, axes: Sequence[int]) -> list[int]:
    return [axis for axis in range(len(node.shape)) if axis not in axes]


def _moved(move: Callable[..., Any]) -> Rule:
    """Returns the rule of a primitive that only moves elements.

    `move` takes one array of element indices per argument, and the parameters; it returns the indices of the results.
    """

    @functools.wraps(move)
    def rule(program: Program, *nodes: Node, **parameters: Any) -> Any:
        starts = np.cumsum([0, *(node.size for node in nodes)])
        indices = [np.arange(node.size).reshape(node.shape) + k for node, k in zip(nodes, starts, strict=False)]
        moved = move(*indices, **parameters)
        return [program.gather(nodes, positions) for positions in (moved if isinstance(moved, list) else [moved])]

    return rule


def _broadcast_in_dim(index, *, shape, broadcast_dimensions):
    added = tuple(axis for axis in range(len(shape)) if axis not in broadcast_dimensions)
    return np.broadcast_to(np.expand_dims(index, added), shape)


def _slice(index, *, start_indices, limit_indices, strides):
    steps = strides or [1] * index.ndim
    return index[tuple(map(slice, start_indices, limit_indices, steps))]


def _pad(index, padding, *, padding_config):
    for axis, (low, high, interior) in enumerate(padding_config):
        step, extent = int(interior) + 1, index.shape[axis]
        place = np.arange(-int(low), max((extent - 1) * step + 1, 0) + int(high))
        chosen = np.where((place % step == 0) & (place >= 0), np.minimum(place // step, extent), extent)
        sides = [(0, int(other == axis)) for other in range(index.ndim)]
        index = np.pad(index, sides, constant_values=padding).take(chosen, axis)
    return index


def _power(program: Program, x: Node, exponent: Node, *, kind: str) -> Node:
    return program.elementwise("pow", *(convert(program, node, kind) for node in (x, exponent)))


def composed(program: Program, function: Callable[..., Any], nodes: Sequence[Node]) -> list[Node]:
    """Returns the results of a JAX function."""
    types = [program.real if node.dtype == "real" else NUMPY_TYPES[node.dtype] for node in nodes]
    examples = [jax.ShapeDtypeStruct(node.shape, dtype) for node, dtype in zip(nodes, types, strict=True)]
    return program.inline(program, jax.make_jaxpr(function)(*examples), nodes)


def _composed(function: Callable[..., Any]) -> Rule:
    """Returns the rule of a primitive that a JAX function composes from others."""

    @functools.wraps(function)
    def rule(program: Program, *nodes: Node, **parameters: Any) -> list[Node]:
        return composed(program, functools.partial(function, **parameters), nodes)

    return rule


def _integer_power(x, *, y):
    result, power, left = jnp.ones_like(x), x, abs(y)
    while left:
        result = result * power if left & 1 else result
        left >>= 1
        power = power * power if left else power
    return result if y >= 0 else 1 / result


def _sign(x):
    one = jnp.ones_like(x)
    return jnp.where(x > 0, one, jnp.where(x < 0, -one, x))  # 0 and NaN are returned as they are


def _select_n(program: Program, which: Node, *cases: Node) -> Node:
    if which.dtype == "bool":
        return program.elementwise("select", which, *reversed(cases))
    *others, result = cases
    for number, case in enumerate(others):
        result = program.elementwise("select", program.elementwise("eq", which, number), case, result)
    return result


def _bits(program: Program, x: Node, *, results: Any, kind: str) -> Node:
    """Applies `bitcast_convert_type` between types of one size."""
    word = "unsigned_long" if np.dtype(program.real).itemsize == 8 else "unsigned"
    if results[0].shape != x.shape or (x.dtype == "real" and NUMPY_TYPES[word]().itemsize != results[0].dtype.itemsize):
        raise InputError("the primitive 'bitcast_convert_type' is supported in C only for types of equal size")
    if x.dtype == "real" != kind:
        return convert(program, program.elementwise(f"{word}_word_of", x), kind)
    return program.elementwise("number_of", convert(program, x, word)) if kind == "real" else convert(program, x, kind)


def _empty(program: Program, *, kind: str, shape: tuple[int, ...] = ()) -> Node:
    return program.constant(np.zeros(shape), kind)


def _reduce_precision(program: Program, x: Node, *, exponent_bits: int, mantissa_bits: int) -> Node:
    own = np.finfo(program.real)
    if exponent_bits >= own.nexp and mantissa_bits >= own.nmant:
        return x
    return program.elementwise("rounded", x, min(exponent_bits, own.nexp), min(mantissa_bits, own.nmant))


def _dot_general(program: Program, a: Node, b: Node, *, dimension_numbers, precision: Any, kind: str) -> Node:
    if isinstance(precision, lax.DotAlgorithm | lax.DotAlgorithmPreset):  # it may round operands and sums
        raise InputError(f"the primitive 'dot_general' is not supported in C with precision={precision}")
    counted = "int" if kind == "bool" else kind
    a, b = (convert(program, node, counted) for node in (a, b))
    (a_sum, b_sum), (a_batch, b_batch) = dimension_numbers
    a_free, b_free = _others(a, (*a_sum, *a_batch)), _others(b, (*b_sum, *b_batch))
    product = program.dot_general(
        grouped(program, a, a_batch, a_free, a_sum), grouped(program, b, b_batch, b_sum, b_free)
    )
    shape = [a.shape[axis] for axis in (*a_batch, *a_free)] + [b.shape[axis] for axis in b_free]
    return convert(program, program.reshape(product, shape), kind)


def _reduction(name: str) -> Rule:
    def rule(program: Program, node: Node, *, axes) -> Node:
        op, axes = on_kind(name, node.dtype), tuple(map(int, axes))
        shape = [size for axis, size in enumerate(node.shape) if axis not in axes]
        if node.size == 0:
            return program.broadcast(program.constant(neutral(op, node.dtype), node.dtype), shape)
        rows = rows_of(program, node, axes)
        columns = np.arange(rows.size).reshape(rows.shape).T
        if len(columns) > 2 and rows.size - program.finite * zeros(rows).sum() > UNROLL_LIMIT:
            return program.reshape(program.make(f"reduce_{op}", rows.shape[:1], node.dtype, [rows]), shape)
        terms = [program.gather([rows], positions) for positions in columns]
        return program.reshape(functools.reduce(functools.partial(program.elementwise, op), terms), shape)

    return rule


def _place_of(best: Callable[..., Any]) -> Rule:
    """Returns the rule of the first place of a row's largest or smallest element, or of its first NaN."""

    def place(x, *, axes, index_dtype):
        (axis,) = axes
        chosen = (x == best(x, axis=axis, keepdims=True)) | (x != x)
        places = lax.broadcasted_iota(index_dtype, x.shape, axis)
        return jnp.where(chosen, places, x.shape[axis]).min(axis)

    return _composed(place)


def _cumulative(combine: Callable[..., Any]) -> Rule:
    """Returns the rule of a cumulative operation, unrolled along the axis."""

    def totals(x, *, axis, reverse):
        order = slice(None, None, -1 if reverse else 1)
        return jnp.stack([*accumulate(jnp.unstack(x, axis=axis)[order], combine)][order], axis)

    return _composed(totals)


def _items(program: Program, node: Node, rank: int = 2) -> list[Node]:
    """Returns the matrices of a batch (vectors for rank 1)."""
    if not node.size:
        raise InputError(f"factorisations are supported in C for non-empty arrays; got shape {node.shape}")
    index = np.arange(node.size).reshape(-1, *node.shape[len(node.shape) - rank :])
    return [program.gather([node], positions) for positions in index]


def _applied(
    program: Program, op: str, *arrays: Node, shapes: Sequence[Sequence[int]], ranks: Sequence[int] = (2, 2),
    kind: str = "real", attribute: Any = None,
) -> list[Node]:  # fmt: skip
    """Applies an operation to every item of a batch; the results of one item are concatenated."""
    batch, sizes = arrays[0].shape[: len(arrays[0].shape) - ranks[0]], [prod(shape) for shape in shapes]
    items = zip(*(_items(program, array, rank) for array, rank in zip(arrays, ranks, strict=False)), strict=True)
    nodes = [program.make(op, (sum(sizes),), kind, item, attribute) for item in items]
    firsts = np.arange(len(nodes))[:, None] * sum(sizes)
    parts = np.split(firsts + np.arange(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
    return [program.gather(nodes, part.reshape(*batch, *shape)) for part, shape in zip(parts, shapes, strict=True)]


def _triangular_solve(
    program: Program, a: Node, b: Node, *, left_side: bool, lower: bool, transpose_a: bool, unit_diagonal: bool
) -> Node:
    if not left_side:  # X A = B is A^T X^T = B^T
        transpose_a, b = not transpose_a, program.transpose(b)
    if transpose_a:
        a, lower = program.transpose(a), not lower
    attribute = (bool(lower), bool(unit_diagonal))
    (x,) = _applied(program, "triangular_solve", a, b, shapes=[b.shape[-2:]], attribute=attribute)
    return x if left_side else program.transpose(x)


def _lu(program: Program, a: Node) -> list[Node]:
    *batch, rows, columns = a.shape
    nodes = [program.make("lu", (), "int", [matrix]) for matrix in _items(program, a)]
    results = []
    for place, shape in enumerate([(rows, columns), (min(rows, columns),), (rows,)]):
        parts = [program.make("project", shape, "int" if place else "real", [node], place) for node in nodes]
        results.append(program.gather(parts, np.arange(len(parts) * prod(shape)).reshape(*batch, *shape)))
    return results


def _geqrf(program: Program, a: Node) -> list[Node]:
    return _applied(program, "geqrf", a, shapes=[a.shape[-2:], (min(a.shape[-2:]),)])


def _with_columns(a, count):
    """Returns matrices with columns of zeros appended up to a count."""
    return jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, max(count - a.shape[-1], 0))])


def _ormqr(a, tau, c, *, left, transpose):
    """Multiplies by the whole orthogonal matrix of reflectors."""
    q = lax.linalg.householder_product(_with_columns(a, a.shape[-2]), tau)
    q = q.mT if transpose else q
    return q @ c if left else c @ q


def _q_and_r(packed, tau, *, full_matrices):
    m, n = packed.shape[-2:]
    rows = m if full_matrices else min(m, n)
    q = lax.linalg.householder_product(_with_columns(packed, rows)[..., :rows], tau)
    return q, jnp.triu(packed[..., :rows, :])


def _qr(program: Program, a: Node, *, full_matrices: bool) -> list[Node]:
    return _composed(_q_and_r)(program, *_geqrf(program, a), full_matrices=full_matrices)


def _eigh(program: Program, a: Node, *, lower: bool, subset_by_index) -> list[Node]:
    """Applies `eigh` to the lower or upper triangle; the signs of eigenvectors may differ from LAPACK's."""
    n = a.shape[-1]
    if subset_by_index not in (None, (0, n)):
        raise InputError("the primitive 'eigh' is supported in C only for all eigenvalues; got subset_by_index")
    row, column = np.sort(np.indices((n, n)), axis=0)[:: -1 if lower else 1]
    symmetric = program.gather([a], np.arange(a.size).reshape(a.shape)[..., row, column])
    return _applied(program, "eigh", symmetric, shapes=[(n, n), (n,)])


_OF_REDUCTIONS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or", "xor": "xor"}
RULES: dict[str, Rule] = {
    **dict.fromkeys(("stop_gradient", "copy", "device_put", "optimization_barrier"), lambda _, *nodes: nodes),
    "add_any": lambda program, a, b: program.elementwise("add", a, b),
    "square": _composed(lambda x: x * x),
    "reduce_precision": _reduce_precision,
    "sign": _composed(_sign),
    "rsqrt": _composed(lambda x: 1 / jnp.sqrt(x)),
    "pow": _power,
    "integer_pow": _composed(_integer_power),
    "logistic": _composed(lambda x: 1 / (1 + jnp.exp(-x))),
    "one_minus_square": _composed(lambda x: (1 - x) * (1 + x)),
    "clamp": _composed(lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high)),
    "round": lambda program, x, *, rounding_method: program.elementwise("rint" if int(rounding_method) else "round", x),
    "select_n": _select_n,
    "convert_element_type": lambda program, x, *, kind: convert(program, x, kind),
    "iota": lambda program, *, shape, dimension, kind: program.constant(np.indices(shape)[dimension], kind),
    "empty": _empty,
    "empty2": _empty,
    "bitcast_convert_type": _bits,
    "broadcast_in_dim": _moved(_broadcast_in_dim),
    "reshape": _moved(lambda index, *, new_sizes: index.reshape(new_sizes)),
    "squeeze": _moved(lambda index, *, dimensions: np.squeeze(index, tuple(dimensions))),
    "transpose": _moved(lambda index, *, permutation: index.transpose(permutation)),
    "rev": _moved(lambda index, *, dimensions: np.flip(index, dimensions)),
    "slice": _moved(_slice),
    "tile": _moved(lambda index, *, reps: np.tile(index, reps)),
    "pad": _moved(_pad),
    "concatenate": _moved(lambda *indices, dimension: np.concatenate(indices, axis=dimension)),
    "stack": _moved(lambda *indices, axis: np.stack(indices, axis)),
    "unstack": _moved(lambda index, *, axis: list(np.moveaxis(index, axis, 0))),
    "split": _moved(lambda index, *, sizes, axis: list(np.split(index, np.cumsum(sizes)[:-1], axis=axis))),
    "dot_general": _dot_general,
    **{f"reduce_{name}": _reduction(op) for name, op in _OF_REDUCTIONS.items()},
    "argmax": _place_of(jnp.max),
    "argmin": _place_of(jnp.min),
    "cumsum": _cumulative(jnp.add),
    "cumprod": _cumulative(jnp.multiply),
    "cummax": _cumulative(jnp.maximum),
    "cummin": _cumulative(jnp.minimum),
    "geqrf": _geqrf,
    "householder_product": lambda program, a, tau: _applied(
        program, "householder_product", a, tau, shapes=[a.shape[-2:]], ranks=(2, 1)
    ),
    "ormqr": _composed(_ormqr),
    "qr": _qr,
    "eigh": _eigh,
    "cholesky": lambda program, a: _applied(program, "cholesky", a, shapes=[a.shape[-2:]]),
    "triangular_solve": _triangular_solve,
    "lu": _lu,
    "lu_pivots_to_permutation": lambda program, pivots, *, permutation_size: _applied(
        program, "permutation", pivots, shapes=[(permutation_size,)], ranks=(1,), kind="int"
    ),
}
"""Rules by name of the primitive."""
