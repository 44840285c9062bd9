"""Simplifies elementwise operations, and decides which are written element by element.

Simplifications keep the results of IEEE arithmetic, except the sign of zero in 0 + x = x, which XLA simplifies too.
1 x = x always holds, but 0 x = 0, 0 / x = 0 and 0 - x = -x hold only for finite numbers: they are applied in programs
that assume finite arguments (`Program.finite`), so that structural zeros of a derivative cost nothing.
"""

from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np

from dln_jax.export.c.nodes import Node, is_all, is_constant, is_direct, is_uniform, zeros
from dln_jax.export.c.operations import COMMUTATIVE, TRANSCENDENTAL
from dln_jax.export.c.text import NUMPY_TYPES, UNSIGNED, limit

if TYPE_CHECKING:
    from dln_jax.export.c.program import Program

UNROLL_LIMIT = 64
"""Largest number of elements of a result, or of products in a sum, that are unrolled; structural zeros are free."""
VECTOR = 8
VECTOR_OF_FUNCTIONS = 4
"""Results with fewer elements are always unrolled; the second limit is for functions of <math.h>."""
_MOST_ZEROS = 16 * UNROLL_LIMIT
"""Largest number of elements, including structural zeros, of a result that is unrolled."""
_MOST_SCALARS = 36
"""Largest number of elements of an operation on scalars alone that is unrolled; larger ones are faster as loops."""
_NEUTRAL = {"add": 0, "sub": 0, "mul": 1, "div": 1, "integer_div": 1, "or": 0, "xor": 0, "and": ...}
"""Number that leaves the other argument unchanged; for `and`, all bits of its kind are set."""

_TRIVIAL = {
    "mul": np.logical_or, "add": np.logical_or, "sub": np.logical_or, "div": lambda a, b: a, "neg": lambda a: a,
    "select": lambda condition, a, b: a & b,
}  # fmt: skip
"""Where an operation on finite numbers costs nothing, given where its arguments are zero."""


def neutral(op: str, dtype: str) -> Any:
    """Returns the number that leaves the other argument of an operation unchanged."""
    if op in ("max", "min"):
        return limit(dtype, upper=op == "min")
    return ~NUMPY_TYPES[dtype](0) if op == "and" else _NEUTRAL[op]


def unrolls(program: "Program", op: str, args: tuple[Node, ...], shape: tuple[int, ...]) -> bool:
    """Returns whether an elementwise operation is written element by element.

    Small ones are, so that moving their elements costs nothing and a compiler keeps them in registers.
    """
    size, functions = prod(shape), op in TRANSCENDENTAL
    if size < (VECTOR_OF_FUNCTIONS if functions else VECTOR):
        return shape != () and size > 0
    if functions or size > _MOST_ZEROS:
        return False
    scattered = (arg for arg in args if arg.op == "gather" and not is_direct(arg))
    if size <= UNROLL_LIMIT and any(size <= _MOST_SCALARS or _is_mixed(arg) for arg in scattered):
        return True
    if not program.finite or op not in _TRIVIAL:
        return False
    trivial = _TRIVIAL[op](*(np.broadcast_to(zeros(arg), size) for arg in args))
    return bool(trivial.any()) and size - trivial.sum() <= UNROLL_LIMIT


def _is_mixed(gather: Node) -> bool:
    """Returns whether a gather reads arrays, which a loop cannot read without copying them."""
    return any(arg.size > 1 or arg.op == "const" for arg in gather.args)


def unrolls_product(program: "Program", a: Node, b: Node) -> bool:
    """Returns whether a product of matrices [b, m, k] and [b, k, n] is written element by element.

    Constants with several columns stay whole: other products with the same constant share its loop.
    """
    (batch, m, k), n = a.shape, b.shape[2]
    if batch * m * k * n <= UNROLL_LIMIT and not (is_constant(b) and n >= VECTOR_OF_FUNCTIONS):
        return True
    if not program.finite or batch * m * n > _MOST_ZEROS:
        return False
    left, right = (~zeros(node).reshape(node.shape) for node in (a, b))
    return not (left.all() and right.all()) and int(np.matmul(left.astype(int), right).sum()) <= UNROLL_LIMIT


def simpler(program: "Program", op: str, args: tuple[Node, ...], shape: tuple[int, ...]) -> Node | None:
    """Returns an equal node that takes less work than the operation, or None."""
    for kept, other in (args, args[::-1])[: 2 if op in COMMUTATIVE else 1] if op in _NEUTRAL else ():
        if is_all(other, neutral(op, kept.dtype)):
            return program.broadcast(kept, shape)
    if (known := _comparison_known(op, args)) is not None:
        return program.broadcast(program.constant(known, "bool"), shape)
    if op in ("max", "min") and args[0] is args[1]:
        return program.broadcast(args[0], shape)
    if op in ("add", "sub") and args[1].op == "neg":
        return program.elementwise("sub" if op == "add" else "add", args[0], args[1].args[0])
    if op == "add" and args[0].op == "neg":
        return program.elementwise("sub", args[1], args[0].args[0])
    if op == "neg" and args[0].op == "neg":
        return args[0].args[0]
    if op == "abs" and args[0].op in ("neg", "abs"):
        return program.elementwise("abs", args[0].args[0])
    if op == "select" and args[1] is args[2]:
        return program.broadcast(args[1], shape)
    if op == "multiply_add":
        return _simpler_multiply_add(program, args)
    if program.finite or args[0].dtype != "real":
        return _beside_zero(program, op, args, shape)
    return None


def _beside_zero(program: "Program", op: str, args: tuple[Node, ...], shape: tuple[int, ...]) -> Node | None:
    """Returns the result if an argument is zero and all are finite, or None."""
    if (op == "mul" and (is_all(args[0], 0) or is_all(args[1], 0))) or (op == "div" and is_all(args[0], 0)):
        return program.broadcast(program.constant(0, args[0].dtype), shape)
    return program.elementwise("neg", program.broadcast(args[1], shape)) if op == "sub" and is_all(args[0], 0) else None


def _simpler_multiply_add(program: "Program", args: tuple[Node, ...]) -> Node | None:
    a, b, total = args
    if is_all(total, 0) or is_all(a, 1) or is_all(b, 1) or (program.finite and (is_all(a, 0) or is_all(b, 0))):
        return program.elementwise("add", program.elementwise("mul", a, b), total)
    return None


def below_broadcast(program: "Program", op: str, args: tuple[Node, ...], shape: tuple[int, ...]) -> Node | None:
    """Returns the operation applied before a common broadcast of its arguments, or None if they share none."""
    repeated = [arg for arg in args if arg.size > 1 and not is_uniform(arg)]
    others = [arg for arg in args if arg.size == 1 or is_uniform(arg)]
    if not shape or any(arg.op == "const" for arg in repeated) or len(repeated) + len(others) < len(args):
        return None
    if not repeated:
        if prod(shape) <= 1:
            return None
        return program.broadcast(program.elementwise(op, *map(program.one, args)), shape)
    positions, source = np.asarray(repeated[0].value), repeated[0].args[:1]
    for arg in repeated:
        alike = arg.op == "gather" and len(arg.args) == 1 and arg.args[0].shape == source[0].shape
        if not alike or arg.args[0].size >= arg.size or not np.array_equal(np.asarray(arg.value), positions):
            return None
    below = [arg.args[0] if any(arg is one for one in repeated) else program.one(arg) for arg in args]
    return program.gather([program.elementwise(op, *below)], positions)


def _comparison_known(op: str, args: tuple[Node, ...]) -> bool | None:
    """Returns the result of a comparison that does not depend on its operands, about which compilers warn; or None."""
    if op in ("lt", "gt") and args[0] is args[1]:
        return False
    if op in ("eq", "ne", "le", "ge") and args[0] is args[1] and args[0].dtype != "real":
        return op != "ne"
    if op in ("lt", "ge") and args[0].dtype in UNSIGNED and is_all(args[1], 0):
        return op == "ge"
    if op in ("gt", "le") and args[0].dtype in UNSIGNED and is_all(args[0], 0):
        return op == "le"
    return None
