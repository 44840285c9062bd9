"""A program of small arrays: a graph of interned nodes, simplified as it is built.

There are few kinds of nodes: every operation that only moves numbers (slices, transposes, concatenations, padding,
gathers and selections at constant indices) is a `gather`, which holds the source of every element. Nested gathers
merge.

| op | value |
|---|---|
| `input`, `const` | a leaf of an argument; numbers |
| `gather` | elements of the sources, laid end to end, at the positions `value` |
| a name in `operations.OPERATIONS` | elementwise, on arguments of one shape or scalars; small results are scalars |
| `dot_general` | A [b, m, k], B [b, k, n] -> sum over k [b, m, n] |
| `reduce_*` | reduction over the last axis of the argument [o, r] |
| `take` | flat elements of the first argument at the second's indices |
| `order` | flat indices that sort rows [o, n] |
| `put_*` | the first argument [n] with updates (third) at flat indices (second); negative ones are dropped |
| `cholesky`, `triangular_solve`, `lu` | of a small dense matrix |
| `permutation` | the order of rows after the exchanges of `lu` |
| `geqrf`, `householder_product` | R, reflectors and their factors [m n + min(m, n)]; the product of reflectors |
| `eigh` | eigenvectors and eigenvalues [n n + n] of a symmetric matrix |
| `call` | a call of another program |
| `while`, `repeat`, `branch` | control flow; `project` takes a result, an iteration reads `carry` and `counter` |

Simplifications keep the results of IEEE arithmetic, except the sign of zero in 0 + x = x, which XLA simplifies too. 1 x
= x always holds, but 0 x = 0, 0 / x = 0 and 0 - x = -x hold only for finite numbers. Programs with finite arguments
(`Program.finite`) use them, so structural zeros of a derivative cost nothing.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np

from dln_jax.export.c.nodes import (
    UNROLL_LIMIT,
    Loop,
    Node,
    Region,
    is_all,
    is_constant,
    is_uniform,
    owners,
    sources_of,
    unrolls,
    unrolls_product,
    values,
    without_unused,
)
from dln_jax.export.c.operations import COMMUTATIVE, OPERATIONS, neutral, on_kind
from dln_jax.export.c.text import LARGEST, NUMPY_TYPES, UNSIGNED
from dln_jax.types import InputError


@dataclass
class Program:
    """A graph of nodes under construction; a node follows its arguments."""

    nodes: list[Node] = field(default_factory=list)
    loops: dict[int, Loop] = field(default_factory=dict)
    floor: Region = ()
    """Region of the branch under construction; its nodes stay inside even if they do not depend on it."""
    real: Any = np.float64
    """NumPy type of real numbers; constants are folded in it."""
    repeated: Collection[int] = ()
    """`id` values of jaxprs that remain calls."""
    parts: dict[Any, tuple["Program", list[Node]]] = field(default_factory=dict)
    """Called programs with their results, by the attribute of a `call`: `id` of the jaxpr, and constant arguments."""
    inline: Any = None
    """(program, closed jaxpr, arguments) -> results."""
    finite: bool = False
    """True if arguments and intermediate results are finite, so that 0 x = 0."""
    _interned: dict[Any, list[Node]] = field(default_factory=dict)
    _scalars: dict[tuple[Node, Region], list[Node]] = field(default_factory=dict)
    """Scalars by node and `floor`: scalars of a branch exist only there."""

    def make(
        self,
        op: str,
        shape: Sequence[int],
        dtype: str,
        args: Sequence[Node] = (),
        attribute: Any = None,
        value: np.ndarray | None = None,
        region: Region = (),
    ) -> Node:
        """Returns the interned node in the innermost region of its arguments: outside loops if possible."""
        shape, args = tuple(map(int, shape)), tuple(args)
        if prod(shape) > LARGEST:
            raise InputError(
                f"an array of shape {shape} is too large for generated C; expected at most {LARGEST} numbers"
            )
        region = max((region, self.floor, *(arg.region for arg in args)), key=len)
        # The dtype belongs to the key, because True and 1 may have the same bytes.
        key = (op, shape, dtype, args, attribute, None if value is None else (value.tobytes(), value.dtype.str))
        for known in self._interned.setdefault(key, []):
            if region[: len(known.region)] == known.region:
                return known
        node = Node(op, shape, dtype, args, attribute, value, region, len(self.nodes))
        self.nodes.append(node)
        self._interned[key].append(node)
        return node

    def constant(self, value: Any, dtype: str) -> Node:
        """Returns a constant of a kind."""
        array = np.asarray(value).astype(self.real if dtype == "real" else NUMPY_TYPES[dtype])
        return self.make("const", array.shape, dtype, value=np.ascontiguousarray(array).reshape(array.shape))

    def gather(self, sources: Sequence[Node], positions: np.ndarray | np.integer) -> Node:
        """Returns the elements at `positions` [shape] of the concatenated sources."""
        inner, flat, start = [], [], 0
        for source in sources:
            parts, within = sources_of(source)
            inner += parts
            flat.append(within + start)
            start += sum(part.size for part in parts)
        positions = np.asarray(np.concatenate(flat)[np.asarray(positions, np.int64)])
        inner, positions = without_unused(inner, positions)
        if not inner or positions.size == 0:
            return self.constant(np.zeros(positions.shape), sources[0].dtype)
        if all(source.op == "const" for source in inner):
            joined = np.concatenate([values(source).ravel() for source in inner])
            if positions.size <= max(joined.size, UNROLL_LIMIT):
                return self.constant(joined[positions], inner[0].dtype)
        alone = len(inner) == 1 and inner[0].shape == positions.shape
        if alone and np.array_equal(positions.ravel(), np.arange(positions.size)):
            return inner[0]
        return self.make("gather", positions.shape, inner[0].dtype, inner, value=positions)

    def reshape(self, node: Node, shape: Sequence[int]) -> Node:
        """Returns the same elements in another shape."""
        return self.gather([node], np.arange(node.size).reshape(shape))

    def broadcast(self, node: Node, shape: Sequence[int]) -> Node:
        """Returns the node broadcast as in NumPy."""
        return self.gather([node], np.broadcast_to(np.arange(node.size).reshape(node.shape), shape))

    def elementwise(self, op: str, *operands: Node | float) -> Node:
        """Returns an operation of `OPERATIONS` on nodes of one kind and numbers, broadcast as in NumPy."""
        kinds = {arg.dtype for arg in (operands[1:] if op == "select" else operands) if isinstance(arg, Node)}
        assert len(kinds) == 1, f"{op} of {', '.join(sorted(kinds))}"
        (kind,) = kinds
        args = tuple(arg if isinstance(arg, Node) else self.constant(arg, kind) for arg in operands)
        shape = np.broadcast_shapes(*(arg.shape for arg in args))
        args = tuple(arg if arg.shape in ((), shape) else self.broadcast(arg, shape) for arg in args)
        operation = OPERATIONS[op := on_kind(op, kind)]
        dtype = operation.dtype or kind
        # Repeated real numbers are not folded, because the result would be a table in memory.
        known = all(arg.op == "const" or (dtype != "real" and is_constant(arg)) for arg in args)
        if known and operation.fold is not None:
            with np.errstate(all="ignore"):
                value = operation.fold(*map(values, args))
            return self.constant(np.broadcast_to(value, shape), dtype)
        if equal := self._simpler(op, args, shape) or self._below_broadcast(op, args, shape):
            return equal
        if unrolls(op, args, shape, finite=self.finite):
            columns = [self.scalars(arg) * (prod(shape) if arg.shape == () else 1) for arg in args]
            elements = [self.elementwise(op, *row) for row in zip(*columns, strict=True)]
            return self.gather(elements, np.arange(len(elements)).reshape(shape))
        if op in COMMUTATIVE:
            args = tuple(sorted(args, key=lambda arg: arg.number))
        return self.make(op, shape, dtype, args)

    def _simpler(self, op: str, args: tuple[Node, ...], shape: tuple[int, ...]) -> Node | None:
        """Returns an equal but cheaper node, or None."""
        a, b = args[0], args[-1]
        for kept, other in ((a, b), (b, a))[: 2 if op in (*COMMUTATIVE, "max", "min") else 1]:
            if (number := neutral(op, a.dtype)) is not None and is_all(other, number):
                return self.broadcast(kept, shape)
        if op == "select" and is_constant(a):
            index = np.arange(prod(shape)).reshape(shape)
            both = [self.broadcast(case, shape) for case in (b, args[1])]
            return self.gather(both, np.where(values(a), index + index.size, index))
        if op in ("add", "sub") and b.op == "neg":
            return self.elementwise("sub" if op == "add" else "add", a, b.args[0])
        if op == "add" and a.op == "neg":
            return self.elementwise("sub", b, a.args[0])
        if op == "neg" and a.op == "neg":
            return a.args[0]
        if (op in ("max", "min") and a is b) or (op == "select" and args[1] is b):
            return self.broadcast(b, shape)
        if op == "multiply_add":
            factors = args[:2]
            trivial = is_all(b, 0) or any(is_all(factor, 1) for factor in factors)
            if trivial or (self.finite and any(is_all(factor, 0) for factor in factors)):
                return self.elementwise("add", self.elementwise("mul", *factors), b)
            return None
        unsigned, real = a.dtype in UNSIGNED, a.dtype == "real"
        alike = a is b and (op in ("lt", "gt") or (not real and op in ("eq", "ne", "le", "ge")))
        beside_zero = (op in ("lt", "ge") and is_all(b, 0)) or (op in ("gt", "le") and is_all(a, 0))
        if alike or (unsigned and beside_zero):  # compilers warn about comparisons with a known result
            return self.broadcast(self.constant(op in ("eq", "le", "ge"), "bool"), shape)
        if real and not self.finite:
            return None
        if op == "sub" and is_all(a, 0):
            return self.elementwise("neg", self.broadcast(b, shape))
        absorbs = op == "mul" or (op == "min" and unsigned)
        if (absorbs and is_all(b, 0)) or ((absorbs or (op == "div" and real)) and is_all(a, 0)):
            return self.broadcast(self.constant(0, a.dtype), shape)
        return None

    def _below_broadcast(self, op: str, args: tuple[Node, ...], shape: tuple[int, ...]) -> Node | None:
        """Returns the operation applied before a common broadcast of its arguments, or None without one."""
        repeated = [arg for arg in args if arg.size > 1 and not is_uniform(arg)]
        if prod(shape) <= 1 or any(arg.op != "gather" or len(arg.args) > 1 for arg in repeated):
            return None
        if not repeated:
            return self.broadcast(self.elementwise(op, *map(self.one, args)), shape)
        positions, source = np.asarray(repeated[0].value), repeated[0].args[0]
        for arg in repeated:
            alike = arg.args[0].shape == source.shape and np.array_equal(np.asarray(arg.value), positions)
            if not alike or source.size >= arg.size:
                return None
        below = [arg.args[0] if arg in repeated else self.one(arg) for arg in args]
        return self.gather([self.elementwise(op, *below)], positions)

    def dot_general(self, a: Node, b: Node) -> Node:
        """Returns sum_k a[b, m, k] b[b, k, n]; products with a constant are transposed so that it comes second."""
        (batch, m, k), n = a.shape, b.shape[2]
        if a.op == b.op == "const":
            return self.constant(np.matmul(values(a), values(b)), a.dtype)
        if k == 0:
            return self.constant(np.zeros((batch, m, n)), a.dtype)
        if k == 1:
            return self.elementwise("mul", self.broadcast(a, (batch, m, n)), self.broadcast(b, (batch, m, n)))
        if is_constant(a) and not is_constant(b):
            return self.transpose(self.dot_general(self.transpose(b), self.transpose(a)))
        if not unrolls_product(a, b, finite=self.finite):
            return self.make("dot_general", (batch, m, n), a.dtype, (a, b))
        left, right = (np.array(self.scalars(node), object).reshape(node.shape) for node in (a, b))
        elements = [self._dot(left[batch, i], right[batch, :, j]) for batch, i, j in np.ndindex(batch, m, n)]
        return self.gather(elements, np.arange(len(elements)).reshape(batch, m, n))

    def _dot(self, left: Iterable[Node], right: Iterable[Node]) -> Node:
        (a, b), *rest = zip(left, right, strict=True)
        total = self.elementwise("mul", a, b)
        for a, b in rest:
            total = self.elementwise("multiply_add", a, b, total)
        return total

    def scalars(self, node: Node) -> list[Node]:
        """Returns the elements of a node as scalars."""
        key = node, self.floor
        if key not in self._scalars:
            parts, positions = sources_of(node)
            owner, starts = owners(parts, positions)
            places = positions - starts[owner]
            self._scalars[key] = [self._element(parts[k], place) for k, place in zip(owner, places, strict=True)]
        return self._scalars[key]

    def _element(self, node: Node, place: np.int64) -> Node:
        if node.op == "const":
            return self.constant(np.asarray(node.value).flat[place], node.dtype)
        return node if node.shape == () else self.make("gather", (), node.dtype, (node,), value=np.asarray(place))

    def one(self, node: Node) -> Node:
        """Returns the common value of all elements as a scalar."""
        return node if node.shape == () else self.gather([node], np.zeros((), np.int64))

    def transpose(self, node: Node) -> Node:
        """Returns the node with its last two axes exchanged."""
        return self.gather([node], np.swapaxes(np.arange(node.size).reshape(node.shape), -1, -2))
