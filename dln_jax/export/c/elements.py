"""C text of elementwise operations, small products, short sums and copies, unrolled or in loops over arrays."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from dln_jax.export.c.body import Body
from dln_jax.export.c.nodes import UNROLL_LIMIT, Node, owners, read_source, steps
from dln_jax.export.c.operations import OPERATIONS, VECTORISED, expression
from dln_jax.export.c.text import C_TYPES

_CHOICES = {
    "select": "elementary_choice({0}, {1}, {2})",
    "max": "elementary_choice(({0} > {1}) | ({0} != {0}), {0}, {1})",
    "min": "elementary_choice(({0} < {1}) | ({0} != {0}), {0}, {1})",
}
"""Branch-free C for loops: a branch would prevent vectorisation."""
_FIRST = np.array(0)
_BOXES = 6
"""Largest number of boxes with separate loops; more boxes use tables of positions."""


def unrolled(body: Body, node: Node) -> None:
    """Writes a scalar as an expression of variables and fused scalars, or a sine with its cosine."""
    if node in body.plan.beside:
        pair = sorted((node, body.plan.beside[node]), key=lambda scalar: scalar.op, reverse=True)
        body.spend(sin=1)
        for scalar in pair:
            body.declared(body.name(scalar), "real", 0)
        body.line("elementary_sin_cos({}, &{}, &{});".format(body.read(node.args[0], _FIRST), *map(body.name, pair)))
        body.done.update(pair)
        return
    text = _scalar(body, node, node)
    if node in body.plan.arrays:
        body.line(f"{body.kept(node)}[0] = {text};")
    else:
        body.declared(body.name(node), node.dtype, 0, text)


def _scalar(body: Body, node: Node, root: Node) -> str:
    """Returns the C expression of a scalar with its fused scalars."""
    if node is not root and body.plan.root.get(node) is not root:
        return body.read(node, _FIRST)
    if node.op == "take":
        return f"{body.name(node.args[0])}[{body.read(node.args[1], _FIRST)}]"
    return _expression(body, node, [_scalar(body, arg, root) for arg in node.args])


def combination(node: Node) -> Callable[..., str]:
    """Returns a function that writes the C of two combined terms."""
    return partial(expression, node.op.partition("_")[2], node.dtype)


def _expression(body: Body, node: Node, args: list[str], *, looped: bool = False) -> str:
    operation = OPERATIONS[node.op]
    if node.dtype == "real" or node.args[0].dtype == "real":
        body.spend(**{node.op: 1})
    if operation.function in VECTORISED:
        return f"elementary_{node.op}({args[0]})"
    if looped and node.dtype == "real" and node.op in _CHOICES:
        return _CHOICES[node.op].format(*args)
    # The operands decide the kind; a comparison gives bool.
    return expression(node.op, node.args[-1].dtype, *args, suffix=body.source.suffix)


def looped(body: Body, node: Node) -> None:
    """Writes a loop of fused elementwise operations that ends in a node."""
    inside = sorted(
        {node, *(member for member, root in body.plan.root.items() if root is node)}, key=lambda member: member.number
    )
    where: dict[Node, tuple[Node, np.ndarray]] = {}
    index = np.arange(node.size).reshape(node.shape)
    for member in inside:
        for arg in member.args[1:] if member.op == "take" else member.args:
            if arg not in inside:
                positions = index if arg.size == node.size else np.zeros_like(index)
                moved = arg.op == "gather" and arg not in body.plan.arrays
                where[arg] = read_source(arg, positions) if moved else (arg, positions)
    target = body.kept(node)
    if node.op in VECTORISED:
        body.spend(**{node.op: node.size})
        body.line(f"elementary_{node.op}_each({node.size}, {body.name(node.args[0])}, {target});")
        return
    shape = _merged(node.shape, [steps(positions) for _, positions in where.values()])
    names = _variables(shape)
    with body.loops(dict(zip(names, shape, strict=True))):
        text = {arg: body.read(source, at.reshape(shape), names) for arg, (source, at) in where.items()}
        for member in inside:
            if member.op == "take":
                written = f"{body.name(member.args[0])}[{text[member.args[1]]}]"
            else:
                written = _expression(body, member, [text[arg] for arg in member.args], looped=True)
            text[member] = f"v{member.number}"
            if member is node:
                body.line(f"{target}[{body.index(index.reshape(shape), names)}] = {written};")
            elif member.dtype == "bool":
                text[member] = written
            else:
                body.line(f"const {C_TYPES[member.dtype]} v{member.number} = {written};")


def _variables(shape: Sequence[int]) -> list[str]:
    return [f"i{axis}_" for axis in range(len(shape))]


def _merged(shape: Sequence[int], steps: list[list[int | None]]) -> list[int]:
    """Returns the shape with adjacent axes merged where all reads allow it; at least one axis remains."""
    result: list[int] = []
    kept: list[int] = []
    for axis, extent in enumerate(shape):
        if extent == 1:
            continue
        if kept and all(None not in step and step[kept[-1]] == (step[axis] or 0) * extent for step in steps):
            result[-1] *= extent
            kept[-1] = axis
        else:
            result.append(extent)
            kept.append(axis)
    return result or [1]


def copied(body: Body, node: Node, target: str, *, own: bool = False) -> None:
    """Copies a node to an array; `own` marks the array of a gather.

    Large gathers are split into boxes; one loop nest reads each box from one source.
    """
    if not node.size:
        return
    index = np.arange(node.size).reshape(node.shape)
    stored = node in body.plan.arrays and not own
    if node.size <= UNROLL_LIMIT and not stored:
        for k in range(node.size):
            body.line(f"{target}[{k}] = {_moved(body, node, np.array(k), own)};")
        return
    boxes = [index] if stored else _boxes(node, index)
    for box in boxes if len(boxes) <= _BOXES else _by_source(node, index):
        box = box.reshape([extent for extent in box.shape if extent > 1])
        names = _variables(box.shape)
        with body.loops(dict(zip(names, box.shape, strict=True))):
            body.line(f"{target}[{body.index(box, names)}] = {_moved(body, node, box, own, names)};")


def _moved(body: Body, node: Node, positions: np.ndarray, own: bool, names: Sequence[str] = ()) -> str:
    """Returns the C expression of elements; with `own`, of the sources of a gather."""
    if not own or node.op != "gather":
        return body.read(node, positions, names)
    source, positions = read_source(node, positions)
    return _scalar(body, source, node) if body.plan.root.get(source) is node else body.read(source, positions, names)


def _boxes(node: Node, index: np.ndarray) -> list[np.ndarray]:
    """Splits the elements into boxes, each for one loop nest and one source."""
    if node.op != "gather" or node.value is None:
        return [index]
    owner = owners(node.args, node.value)[0].ravel()
    flat = node.value.ravel()

    def split(box: np.ndarray) -> list[np.ndarray]:
        at, of = flat[box], owner[box]
        if None not in steps(at) and (of == of.flat[0]).all():
            return [box]
        cuts = {axis: _runs(np.moveaxis(at, axis, 0), np.moveaxis(of, axis, 0)) for axis in range(at.ndim)}
        axis = min(
            (choice for choice in cuts if len(cuts[choice]) > 2), key=lambda choice: len(cuts[choice]), default=-1
        )
        if axis < 0:
            axis = next(choice for choice in range(at.ndim) if at.shape[choice] > 1)
            cuts[axis] = list(range(at.shape[axis] + 1))
        parts = (box[(slice(None),) * axis + (slice(*ends),)] for ends in pairwise(cuts[axis]))
        return [smaller for part in parts for smaller in split(part)]

    return split(index)


def _by_source(node: Node, index: np.ndarray) -> list[np.ndarray]:
    """Returns the elements of every source as [axes with a constant source, other axes merged]."""
    owner, _ = owners(node.args, np.asarray(node.value))
    leading = []
    while len(leading) < index.ndim - 1 and (owner == owner[:1]).all():
        leading.append(index.shape[len(leading)])
        owner = owner[0]
    rows = index.reshape(*leading, -1)
    return [rows[..., owner.ravel() == source] for source in np.unique(owner)]


def _runs(at: np.ndarray, owner: np.ndarray) -> list[int]:
    """Returns the starts and the end of runs of rows with equal sources and equal steps."""
    steps, cuts = np.diff(at, axis=0), [0]
    for row in range(1, len(at)):
        first = cuts[-1]
        uneven = row > first + 1 and not np.array_equal(steps[row - 1], steps[first])
        if uneven or not np.array_equal(owner[row], owner[first]):
            cuts.append(row)
    return [*cuts, len(at)]
