"""Plans a program: which nodes become scalars or loops, which need arrays, and the order of computation.

Small arrays are unrolled into scalars: moving their elements is then free, and compilers keep them in registers. Other
arrays become loops. An elementwise operation with one reader is fused into its reader's loop.
"""

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from dln_jax.export.c.nodes import UNROLL_LIMIT, Loop, Node, Region, is_direct
from dln_jax.export.c.operations import OPERATIONS, VECTORISED
from dln_jax.export.c.program import Program

_DEPTH = 16
"""Largest depth of a scalar expression; compilers limit the nesting of parentheses."""
_GIVEN = ("input", "const", "carry", "counter", "project")
"""Operations with values from the start of a region, or from the end of their loop."""
_FACTORED = ("cholesky", "triangular_solve", "permutation", "geqrf", "householder_product", "eigh")
PLAIN_MEMORY = ("take", "order", "lu", "call", *_FACTORED)
"""Operations with arguments by pointer."""


class Plan(NamedTuple):
    """Decisions about the nodes for the results."""

    order: dict[Region, list[Node]]
    """Nodes of a region in order of computation."""
    unrolled: set[Node]
    """Nodes computed element by element."""
    arrays: set[Node]
    """Nodes stored in an array; others are scalars."""
    root: dict[Node, Node]
    """Elementwise node -> last node of its loop."""
    nodes: set[Node]
    """Nodes with needed elements."""
    levels: dict[Node, int]
    """Length of the longest chain of products before a node."""
    reads: dict[Node | None, set[Node]]
    """Arrays of its region read by a step. A loop reads the arrays of its body; None stands for the results."""
    readers: Counter[Node]
    """Number of steps that read an array."""
    beside: dict[Node, Node]
    """Pairs of a sine and a cosine of the same scalar, in both directions."""


def plan_of(program: Program, results: Iterable[Node]) -> Plan:
    """Returns the plan for a program with these results."""
    results = list(results)
    nodes = needed_by(program, results)
    readers, whole, contiguous = _readers(program, results, nodes)
    unrolled = {node for node in nodes if _is_unrolled(node)}
    arrays, followed = set(contiguous), set()
    # Loops read arrays. A gather without linear indices in a loop is first copied to an array.
    for node in reversed(nodes):
        looped = any(
            reader in followed if reader.op == "gather" else reader not in unrolled for reader in readers[node]
        )
        if node.op == "gather" and node not in contiguous and not (looped and not is_direct(node)):
            followed |= {node} if looped or node in whole else set()
        elif node.op == "gather":
            arrays.add(node)
            (unrolled if node.size <= UNROLL_LIMIT else followed).add(node)
        elif (node.size > 1 and (looped or node in whole)) or not (node in unrolled or _is_scalar(node)):
            arrays.add(node)
    arrays = {node for node in arrays if node.op not in ("input", "const")}
    root: dict[Node, Node] = _fused(nodes, readers, whole | set(results), unrolled, arrays)
    arrays -= {node for node, into in root.items() if into is not node}
    levels, order = _levels(nodes), {}
    used = [node for node in nodes if node.size]
    for node in sorted(used, key=lambda node: (levels[node], node.op != "dot_general")):
        written = node in arrays if node.op == "gather" else node.op not in _GIVEN
        if written and root.get(node, node) is node:
            order.setdefault(node.region, []).append(node)
    reads = _reads(program, nodes, arrays, root, results)
    left = Counter(source for read in reads.values() for source in read)
    sines, cosines = (
        {(*n.args, n.region): n for n in unrolled - arrays if n.op == operation} for operation in ("sin", "cos")
    )
    pairs = [(sines[key], cosines[key]) for key in sines.keys() & cosines.keys()]
    partners = {**dict(pairs), **{cosine: sine for sine, cosine in pairs}}
    return Plan(order, unrolled, arrays, root, set(used), levels, reads, left, partners)


def _numbers(node: Node) -> list[int]:
    """Returns the numbers of the bodies of a loop or branch."""
    return [int(number) for number in np.ravel(node.attribute)] if node.op in ("while", "repeat", "branch") else []


def _bodies(program: Program, node: Node) -> list[Loop]:
    return [program.loops[number] for number in _numbers(node)]


def needed_by(program: Program, results: Iterable[Node]) -> list[Node]:
    """Returns all needed nodes in order, also in the bodies of loops and branches."""
    reached, waiting = set(), [node for node in results if node.size]
    while waiting:
        node = waiting.pop()
        if node not in reached:
            reached.add(node)
            waiting += node.args
            for loop in _bodies(program, node):
                waiting += [*loop.carries, *loop.conditions, *loop.results[: len(loop.carries)]]
            if node.op == "project":
                waiting += [loop.results[node.attribute] for loop in _bodies(program, node.args[0])]
    return sorted(reached, key=lambda node: node.number)


def _readers(
    program: Program, results: list[Node], nodes: list[Node]
) -> tuple[dict[Node, list[Node]], set[Node], set[Node]]:
    """Returns the readers of every node, the nodes read whole, and the nodes read by pointer."""
    readers: dict[Node, list[Node]] = {node: [] for node in nodes}
    whole, contiguous = {node for node in results if node.size > UNROLL_LIMIT}, set()
    for node in nodes:
        for arg in node.args:
            readers[arg].append(node)
        if node.op in PLAIN_MEMORY or (node.op in VECTORISED and not _is_unrolled(node)):
            contiguous |= set(node.args[:1] if node.op == "take" else node.args)
        for loop in _bodies(program, node):
            whole |= {*loop.results, *loop.conditions, *node.args}
    return readers, whole, contiguous


def _is_unrolled(node: Node) -> bool:
    return node.size == 1 and (node.op in OPERATIONS or node.op == "take")


def _is_scalar(node: Node) -> bool:
    """Returns whether a node can be a variable instead of an array."""
    return node.size == 1 and node.op not in ("dot_general", *_FACTORED) and node.op[:4] != "put_"


def _fused(nodes: list[Node], readers: dict[Node, list[Node]], whole, unrolled, arrays) -> dict[Node, Node]:
    """Returns elementwise node -> last node of its loop or scalar expression."""
    root: dict[Node, Node] = {}
    depths = {node: 0 for node in nodes if node.op == "gather" and node in arrays and node in unrolled}
    for node in reversed(nodes):
        if node.op not in OPERATIONS:
            continue
        into = {root.get(reader, reader) for reader in readers[node]}
        alone = len(into) != 1 or node in whole or node.op in VECTORISED or node.region != next(iter(into)).region
        if node in unrolled:
            depths[node] = 1 + max((depths.get(reader, _DEPTH) for reader in readers[node]), default=_DEPTH)
            alone |= depths[node] > _DEPTH or _is_read_again(node, readers[node])
            depths[node] = 0 if alone else depths[node]
        else:
            alone |= any(reader not in root or reader.shape != node.shape for reader in readers[node])
            alone |= any(reader.op in VECTORISED for reader in readers[node])
        root[node] = node if alone else into.pop()
    return root


def _is_read_again(node: Node, readers: list[Node]) -> bool:
    """Returns whether a scalar occurs more than once in the C text of its readers."""
    if len(readers) > 1 or readers[0].op != "gather":
        return len(readers) > 1 or OPERATIONS[readers[0].op].repeats_arguments(node.dtype)
    start = sum(arg.size for arg in readers[0].args[: readers[0].args.index(node)])
    return bool((np.asarray(readers[0].value) == start).sum() > 1)


def _levels(nodes: list[Node]) -> dict[Node, int]:
    levels: dict[Node, int] = {}
    highest: dict[int, int] = {}
    for node in nodes:
        before = [*(levels[arg] for arg in node.args), *(highest.get(number, 0) for number in _numbers(node))]
        levels[node] = max(before, default=0) + (node.op == "dot_general")
        for number in node.region:
            highest[number] = max(highest.get(number, 0), levels[node])
    return levels


def _sources(node: Node, arrays: set[Node]) -> set[Node]:
    """Returns the arrays read to evaluate a node."""
    if node.op == "gather" and node not in arrays:
        return {source for arg in node.args for source in _sources(arg, arrays)}
    return {node} & arrays


def _reads(program: Program, nodes, arrays, root, results) -> dict[Node | None, set[Node]]:
    reads: dict[Node | None, set[Node]] = {None: {source for node in results for source in _sources(node, arrays)}}
    loops = {number: node for node in nodes for number in _numbers(node)}
    for node in nodes:
        if node.op == "gather" and node not in arrays:
            continue
        read = [*node.args]
        for loop in _bodies(program, node):
            read += [*loop.results, *loop.conditions]
        for argument in read:
            for source in _sources(argument, arrays):
                # A read in a nested loop counts as a read by that loop.
                depth = len(source.region)
                step = loops[node.region[depth]] if len(node.region) > depth else root.get(node, node)
                reads.setdefault(step, set()).add(source)
    return reads
