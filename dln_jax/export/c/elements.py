"""C of elementwise operations, small products and short sums: unrolled, or in loops over arrays."""

import numpy as np

from dln_jax.export.c import kernels, products
from dln_jax.export.c.body import Body
from dln_jax.export.c.kinds import C_TYPES, NUMPY_TYPES
from dln_jax.export.c.moves import merged
from dln_jax.export.c.nodes import Node, is_constant, values
from dln_jax.export.c.operations import OPERATIONS, VECTORISED, expression
from dln_jax.export.c.plan import strides

_CHOICES = {
    "select": "elementary_choice({0}, {1}, {2})",
    "max": "elementary_choice(({0} > {1}) | ({0} != {0}), {0}, {1})",
    "min": "elementary_choice(({0} < {1}) | ({0} != {0}), {0}, {1})",
}
"""C without a branch, for loops, since a branch would prevent vectorisation."""


def unrolled(body: Body, node: Node) -> None:
    """Writes the elements of a node that something reads, one statement for every element."""
    dtype = C_TYPES[node.dtype]
    name = body.kept(node) if node in body.plan.arrays else body.name(node)
    for k in np.flatnonzero(body.plan.needed[node]):
        text = _element(body, node, int(k))
        if node in body.plan.arrays:
            body.line(f"{name}[{k}] = {text};")
        else:
            body.bytes += 8
            body.line(f"const {dtype} {name}{f'_{k}' if node.size > 1 else ''} = {text};")


def _element(body: Body, node: Node, k: int) -> str:
    if node.op == "dot_general":
        a, b = node.args
        (_, m, count), n = a.shape, b.shape[2]
        batch, row, column = np.unravel_index(k, node.shape)
        first = [body.read(a, np.array((batch * m + row) * count + term)) for term in range(count)]
        second = [body.read(b, np.array((batch * count + term) * n + column)) for term in range(count)]
        body.spend((2 * count - 1) * (node.dtype == "real"))
        return products.chain(list(zip(first, second, strict=True)), node.dtype)
    if node.op.startswith("reduce_"):
        (a,) = node.args
        count = a.shape[1]
        terms = [body.read(a, np.array(k * count + term)) for term in range(count)]
        return kernels.combined(body, node, k, terms)
    if node.op == "take":
        return f"{body.name(node.args[0])}[{body.read(node.args[1], np.array(k))}]"
    return _expression(body, node, [body.read(arg, np.array(k if arg.size > 1 else 0)) for arg in node.args])


def _expression(body: Body, node: Node, args: list[str], *, looped: bool = False) -> str:
    """Returns the C of an elementwise operation on expressions."""
    operation = OPERATIONS[node.op]
    body.spend(operation.cost * (node.dtype == "real" or node.args[0].dtype == "real"))
    if operation.function in VECTORISED and not body.source.libm:
        body.source.functions.add(node.op)
        return f"elementary_{node.op}({args[0]})"
    if looped and node.dtype == "real" and node.op in _CHOICES:
        body.source.functions.add("choice")
        return _CHOICES[node.op].format(*args)
    if node.op in ("rounded", "lt_to", "le_to"):
        body.source.functions.add("rounded" if node.op == "rounded" else "ordered")
    if name := _checked(node):
        body.source.integers.add(name)
        return f"elementary_{name}({', '.join(args)})"
    # The kind of the operands decides: that of a comparison's result is bool.
    return expression(node.op, node.args[-1].dtype, *args, suffix=body.source.suffix)


def _checked(node: Node) -> str | None:
    """Returns the name of the integer function that keeps an operation from trapping, or None if none is needed."""
    if node.op.startswith("shift_"):
        return f"{node.op}_{node.dtype}"
    if node.op in ("integer_div", "integer_rem"):
        divisor = node.args[1]
        if is_constant(divisor) and not np.isin(values(divisor), (0, ~NUMPY_TYPES[node.dtype](0))).any():
            return None
        return f"{'quotient' if node.op == 'integer_div' else 'remainder'}_{node.dtype}"
    if node.op.startswith("to_") and node.args[0].dtype == "real" and node.dtype != "bool":
        return f"{node.dtype}_of"
    return None


def looped(body: Body, node: Node) -> None:
    """Writes a loop of fused elementwise operations that ends in a node."""
    inside = sorted(
        {node, *(member for member, root in body.plan.root.items() if root is node)}, key=lambda member: member.number
    )
    where: dict[Node, np.ndarray] = {}
    index = np.arange(node.size).reshape(node.shape)
    for member in inside:
        for arg in member.args[1:] if member.op == "take" else member.args:
            if arg not in inside:
                where[arg] = index if arg.size == node.size else np.zeros_like(index)
    name = body.kept(node)
    if node.op in VECTORISED and not body.source.libm:
        body.spend(OPERATIONS[node.op].cost * node.size)
        body.source.arrays.add(node.op)
        body.line(f"elementary_{node.op}_each({node.size}, {body.name(node.args[0])}, {name});")
        return
    shape = merged(node.shape, [_steps(body, arg, positions) for arg, positions in where.items()])

    def statements(names: list[str]) -> None:
        text = {arg: body.read(arg, positions.reshape(shape), names) for arg, positions in where.items()}
        for member in inside:
            if member.op == "take":
                written = f"{body.name(member.args[0])}[{text[member.args[1]]}]"
            else:
                written = _expression(body, member, [text[arg] for arg in member.args], looped=True)
            text[member] = f"v{member.number}"
            if member is node:
                body.line(f"{name}[{body.index(index.reshape(shape), names)}] = {written};")
            elif member.dtype == "bool":
                text[member] = written
            else:
                body.line(f"const {C_TYPES[member.dtype]} v{member.number} = {written};")

    body.looped(shape, statements)


def _steps(body: Body, node: Node, positions: np.ndarray) -> tuple[int, ...] | None:
    """Returns the strides of a reading, or None if it needs a table."""
    if node.op == "gather" and node not in body.plan.arrays:
        positions = np.asarray(np.asarray(node.value).ravel()[positions])
    linear = strides(positions)
    return None if linear is None else linear[1]
