"""Factorisations and triangular solves, which become loops of their own in C."""

from typing import Any

import numpy as np

from dln_jax.deploy.c.nodes import Node
from dln_jax.deploy.c.program import Program


def _matrices(program: Program, node: Node) -> list[Node]:
    """Each [rows, columns] of a batch."""
    index = np.arange(node.size).reshape(-1, *node.shape[-2:])
    return [program.arrange([node], each) for each in index]


def _stacked(program: Program, nodes: list[Node], shape: Any) -> Node:
    return program.arrange(nodes, np.arange(sum(node.size for node in nodes)).reshape(shape))


def _cholesky(program: Program, _, a: Node) -> Node:
    each = [program.make("cholesky", one.shape, "real", [one]) for one in _matrices(program, a)]
    return _stacked(program, each, a.shape)


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
    each = [program.make("permutation", (size,), "int", [program.arrange([pivots], row)]) for row in index]
    return _stacked(program, each, (*pivots.shape[:-1], size))


RULES = {
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "lu": _lu,
    "lu_pivots_to_permutation": _permutation,
}
"""By the primitive's name."""
