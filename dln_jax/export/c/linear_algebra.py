"""Rules for factorisations and triangular solves, which C computes in functions of its own."""

from math import prod
from typing import Any

import numpy as np

from dln_jax.export.c.nodes import Node
from dln_jax.export.c.program import Program
from dln_jax.types import InputError


def _matrices(program: Program, node: Node) -> list[Node]:
    """Returns the matrices of a batch."""
    index = np.arange(node.size).reshape(-1, *node.shape[-2:])
    return [program.gather([node], positions) for positions in index]


def _stacked(program: Program, nodes: list[Node], shape: Any) -> Node:
    return program.gather(nodes, np.arange(sum(node.size for node in nodes)).reshape(shape))


def _cholesky(program: Program, _, a: Node) -> Node:
    factors = [program.make("cholesky", one.shape, "real", [one]) for one in _matrices(program, a)]
    return _stacked(program, factors, a.shape)


def _triangular_solve(program: Program, parameters: dict[str, Any], a: Node, b: Node) -> Node:
    results = []
    for matrix, right in zip(_matrices(program, a), _matrices(program, b), strict=True):
        lower, transposed = parameters["lower"], parameters["transpose_a"]
        if not parameters["left_side"]:  # X A = B is A^T X^T = B^T
            transposed, right = not transposed, program.transpose(right)
        if transposed:
            matrix, lower = program.transpose(matrix), not lower
        attribute = (bool(lower), bool(parameters["unit_diagonal"]))
        solved = program.make("triangular_solve", right.shape, "real", [matrix, right], attribute)
        results.append(solved if parameters["left_side"] else program.transpose(solved))
    return _stacked(program, results, b.shape)


def _lu(program: Program, _, a: Node) -> list[Node]:
    rows, columns = a.shape[-2:]
    factors, pivots, orders = [], [], []
    for matrix in _matrices(program, a):
        node = program.make("lu", (), "int", [matrix])
        factors.append(program.make("project", (rows, columns), "real", [node], 0))
        pivots.append(program.make("project", (min(rows, columns),), "int", [node], 1))
        orders.append(program.make("project", (rows,), "int", [node], 2))
    batch = a.shape[:-2]
    return [
        _stacked(program, factors, a.shape),
        _stacked(program, pivots, (*batch, min(rows, columns))),
        _stacked(program, orders, (*batch, rows)),
    ]


def _permutation(program: Program, parameters: dict[str, Any], pivots: Node) -> Node:
    size = parameters["permutation_size"]
    index = np.arange(pivots.size).reshape(-1, pivots.shape[-1])
    orders = [program.make("permutation", (size,), "int", [program.gather([pivots], row)]) for row in index]
    return _stacked(program, orders, (*pivots.shape[:-1], size))


def _parts(program: Program, nodes: list[Node], first: int, shape: tuple[int, ...], batch: list[int]) -> Node:
    """Returns a batch of arrays of this shape, read from flat nodes starting at element `first`."""
    index = first + np.arange(prod(shape))
    return _stacked(program, [program.gather([node], index) for node in nodes], (*batch, *shape))


def _geqrf(program: Program, _, a: Node) -> list[Node]:
    (*batch, m, n), k = a.shape, min(a.shape[-2:])
    nodes = [program.make("geqrf", (m * n + k,), "real", [matrix]) for matrix in _matrices(program, a)]
    return [_parts(program, nodes, 0, (m, n), batch), _parts(program, nodes, m * n, (k,), batch)]


def _householder_product(program: Program, _, a: Node, tau: Node) -> Node:
    rows = program.reshape(tau, (-1, tau.shape[-1]))
    factors = [program.gather([rows], row) for row in np.arange(rows.size).reshape(rows.shape)]
    pairs = zip(_matrices(program, a), factors, strict=True)
    return _stacked(program, [program.make("householder_product", x.shape, "real", [x, t]) for x, t in pairs], a.shape)


def _qr(program: Program, parameters: dict[str, Any], a: Node) -> list[Node]:
    """Applies `qr` by the two rules above, as JAX does."""
    (*batch, m, n), full = a.shape, parameters["full_matrices"]
    if parameters["pivoting"]:
        raise InputError("the primitive 'qr' has C without pivoting; got pivoting=True")
    if not a.size:
        raise InputError(f"the primitive 'qr' has C of matrices with elements; this is {a.shape}")
    packed, tau = _geqrf(program, {}, a)
    zero, rows, columns = program.constant(0.0, "real"), m if full else min(m, n), m if full or m < n else n
    index = np.arange(a.size).reshape(a.shape)
    wide = np.pad(index, [(0, 0)] * (len(batch) + 1) + [(0, max(columns - n, 0))], constant_values=a.size)
    q = _householder_product(program, {}, program.gather([packed, zero], wide[..., :columns]), tau)
    upper = np.where(np.arange(rows)[:, None] <= np.arange(n), index[..., :rows, :], a.size)
    return [q, program.gather([packed, zero], upper)]


def _eigh(program: Program, parameters: dict[str, Any], a: Node) -> list[Node]:
    """Applies `eigh` to the lower or upper triangle; the signs of eigenvectors may differ from LAPACK's."""
    *batch, n, _ = a.shape
    if parameters["subset_by_index"] not in (None, (0, n)):
        raise InputError("the primitive 'eigh' has C for all eigenvalues; got subset_by_index")
    row, column = np.sort(np.indices((n, n)), axis=0)[:: -1 if parameters["lower"] else 1]
    matrices = [program.gather([matrix], row * n + column) for matrix in _matrices(program, a)]
    nodes = [program.make("eigh", (n * n + n,), "real", [matrix]) for matrix in matrices]
    return [_parts(program, nodes, 0, (n, n), batch), _parts(program, nodes, n * n, (n,), batch)]


RULES = {
    "geqrf": _geqrf,
    "householder_product": _householder_product,
    "qr": _qr,
    "eigh": _eigh,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "lu": _lu,
    "lu_pivots_to_permutation": _permutation,
}
"""Rules by the name of the primitive."""
