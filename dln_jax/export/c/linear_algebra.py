"""Rules for factorisations and triangular solves, which separate C functions compute."""

from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np

from dln_jax.export.c.nodes import Node
from dln_jax.export.c.program import Program
from dln_jax.types import InputError


def _items(program: Program, node: Node, rank: int = 2) -> list[Node]:
    """Returns the matrices of a batch (vectors for rank 1)."""
    if not node.size:
        raise InputError(f"factorisations have C of arrays with elements; this one has shape {node.shape}")
    index = np.arange(node.size).reshape(-1, *node.shape[len(node.shape) - rank :])
    return [program.gather([node], positions) for positions in index]


def _applied(
    program: Program, op: str, *arrays: Node, shapes: Sequence[Sequence[int]], ranks: Sequence[int] = (2, 2),
    kind: str = "real", attribute: Any = None,
) -> list[Node]:  # fmt: skip
    """Applies an operation to every item of a batch; the results of one item lie end to end."""
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


def _householder_product(program: Program, a: Node, tau: Node) -> list[Node]:
    return _applied(program, "householder_product", a, tau, shapes=[a.shape[-2:]], ranks=(2, 1))


def _ormqr(program: Program, a: Node, tau: Node, c: Node, *, left: bool, transpose: bool) -> Node:
    """Multiplies by the whole orthogonal matrix of reflectors."""
    *batch, m, n = a.shape
    index = np.arange(a.size).reshape(a.shape)
    square = np.pad(index, [(0, 0)] * (len(batch) + 1) + [(0, m - n)], constant_values=a.size)
    (q,) = _householder_product(program, program.gather([a, program.constant(0.0, "real")], square), tau)
    q, c = (program.reshape(node, (prod(batch), *node.shape[-2:])) for node in (q, c))
    q = program.transpose(q) if transpose else q
    return program.reshape(program.dot_general(*((q, c) if left else (c, q))), (*batch, *c.shape[-2:]))


def _qr(program: Program, a: Node, *, full_matrices: bool) -> list[Node]:
    """Applies `qr` by the two rules above, as JAX does."""
    (*batch, m, n), full = a.shape, full_matrices
    packed, tau = _geqrf(program, a)
    zero, rows, columns = program.constant(0.0, "real"), m if full else min(m, n), m if full or m < n else n
    index = np.arange(a.size).reshape(a.shape)
    wide = np.pad(index, [(0, 0)] * (len(batch) + 1) + [(0, max(columns - n, 0))], constant_values=a.size)
    (q,) = _householder_product(program, program.gather([packed, zero], wide[..., :columns]), tau)
    upper = np.where(np.arange(rows)[:, None] <= np.arange(n), index[..., :rows, :], a.size)
    return [q, program.gather([packed, zero], upper)]


def _eigh(program: Program, a: Node, *, lower: bool, subset_by_index) -> list[Node]:
    """Applies `eigh` to the lower or upper triangle; the signs of eigenvectors may differ from LAPACK's."""
    n = a.shape[-1]
    if subset_by_index not in (None, (0, n)):
        raise InputError("the primitive 'eigh' has C for all eigenvalues; got subset_by_index")
    row, column = np.sort(np.indices((n, n)), axis=0)[:: -1 if lower else 1]
    symmetric = program.gather([a], np.arange(a.size).reshape(a.shape)[..., row, column])
    return _applied(program, "eigh", symmetric, shapes=[(n, n), (n,)])


RULES = {
    "geqrf": _geqrf,
    "householder_product": _householder_product,
    "ormqr": _ormqr,
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
