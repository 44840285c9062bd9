"""The text of one function as it grows: what holds each node, how elements of it are read, and lines.

An array is read at positions, an integer array over the box of the loops around the reading: no loops, one element.
What moves elements then is indexing of that array, and a constant is stored in the order in which it is read.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from dln_jax.export.c.kinds import C_TYPES
from dln_jax.export.c.nodes import Node, Region, is_constant, values
from dln_jax.export.c.plan import Plan, strides
from dln_jax.export.c.program import Program
from dln_jax.export.c.text import integer, literal


class Called(NamedTuple):
    """A function that others call."""

    name: str
    results: list[Node]
    text: str
    operations: int
    bytes: int
    calls: set[Any]
    """Functions that it calls in turn, by their keys in the source."""


@dataclass
class Source:
    """What the functions of one source share."""

    precision: str
    libm: bool
    tables: dict[tuple[str, bytes], tuple[str, np.ndarray]] = field(default_factory=dict)
    functions: set[str] = field(default_factory=set)
    """Elementary functions of one number that are called."""
    arrays: set[str] = field(default_factory=set)
    """Elementary functions of arrays that are called."""
    integers: set[str] = field(default_factory=set)
    """Functions of whole numbers that are called."""
    kernels: set[str] = field(default_factory=set)
    orders: set[tuple[str, ...]] = field(default_factory=set)
    """Kinds of the keys that something is sorted by."""
    parts: dict[bytes, "Called"] = field(default_factory=dict)
    """Functions that others call, by the identity of their program."""
    names: dict[str, str] = field(default_factory=dict)
    """Their names, by what they do."""

    @property
    def suffix(self) -> str:
        """Of functions of <math.h> and literals."""
        return "f" if self.precision == "f32" else ""

    def copy(self) -> "Source":
        """What may be changed without this one."""
        shared = {attribute.name: copy(getattr(self, attribute.name)) for attribute in fields(self)}
        return Source(**shared)

    def table(self, numbers: np.ndarray, dtype: str) -> str:
        """Name of a constant array."""
        array = np.ascontiguousarray(numbers)
        if dtype == "real":
            array = array.astype(np.float32 if self.precision == "f32" else np.float64)
        key = dtype, array.tobytes() + str(array.size).encode()
        return self.tables.setdefault(key, (f"table_{len(self.tables)}", array))[0]


@dataclass
class Body:
    """The text of one function as it grows."""

    source: Source
    program: Program
    plan: Plan
    inputs: dict[int, tuple[str, bool]]
    """Name of each argument, and whether it is passed by value."""
    lines: list[str] = field(default_factory=list)
    operations: int = 0
    bytes: int = 0
    calls: set[Any] = field(default_factory=set)
    """Functions that it or those that it calls call, by their keys in the source."""
    names: dict[Node, str] = field(default_factory=dict)
    """Arrays that nodes are kept in."""
    _free: dict[tuple[Region, str, int], list[str]] = field(default_factory=dict)
    """Arrays that nothing reads any more, by region, type and size."""
    _depth: int = 1
    _turns: int = 1

    def line(self, text: str) -> None:
        """Adds a line."""
        self.lines.append("    " * self._depth + text)

    def opened(self, text: str, turns: int = 1) -> None:
        """Starts a block, whose operations are done so many times."""
        self.line(text + " {")
        self._depth += 1
        self._turns *= turns

    def closed(self, turns: int = 1) -> None:
        """Ends it."""
        self._depth -= 1
        self._turns //= max(turns, 1)
        self.line("}")

    def spend(self, operations: int) -> None:
        """Counts floating-point operations."""
        self.operations += operations * self._turns

    def declared(self, name: str, dtype: str, size: int, value: str = "") -> None:
        """Declares an array, or a scalar for size 0."""
        self.bytes += max(size, 1) * (4 if self.source.precision == "f32" and dtype == "real" else 8)
        self.line(f"{C_TYPES[dtype]} {name}{f'[{size}]' if size else ''}{value};")

    def kept(self, node: Node) -> str:
        """Name of the array that is to hold a node: one that nothing reads any more, or a new one."""
        free = self._free.get((node.region, node.dtype, node.size))
        self.names[node] = free.pop() if free else f"v{node.number}"
        if self.names[node] == f"v{node.number}":
            self.declared(self.names[node], node.dtype, node.size)
        return self.names[node]

    def finished(self, step: Node) -> None:
        """Gives arrays back that no later step reads."""
        for source in sorted(self.plan.reads.get(step, ()), key=lambda node: node.number):
            left = self.plan.readers[source]
            left.discard(step)
            if not left and source in self.names:
                self._free.setdefault((source.region, source.dtype, source.size), []).append(self.names[source])

    def looped(self, shape: Sequence[int], inside: Callable[[list[str]], None]) -> None:
        """Loops over a box, with the names of their variables handed on."""
        names = [f"i{axis}_" for axis in range(len(shape))]
        for name, extent in zip(names, shape, strict=True):
            self.opened(f"for (int {name} = 0; {name} < {extent}; ++{name})", extent)
        inside(names)
        for extent in reversed(shape):
            self.closed(extent)

    def name(self, node: Node) -> str:
        """Of the array or scalar that holds a node."""
        if node.op == "input":
            return self.inputs[node.attribute][0]
        if node.op == "const":
            return self.source.table(np.asarray(node.value), node.dtype)
        if node.op == "carry":
            return "c{}_{}".format(*node.attribute)
        if node.op == "project":
            (loop,) = node.args
            if loop.op in ("lu", "call"):
                return f"v{loop.number}_{node.attribute}"
            return f"c{np.ravel(loop.attribute)[0]}_{node.attribute}"
        return f"i_{node.attribute}" if node.op == "counter" else self.names.get(node, f"v{node.number}")

    def read(self, node: Node, positions: np.ndarray, names: Sequence[str] = ()) -> str:
        """C expression of the elements at positions, over loops with these variables."""
        if node.op == "arrange" and node not in self.plan.arrays:
            if is_constant(node):
                return self.literal(np.asarray(values(node).ravel()[positions]), node.dtype, names)
            positions = np.asarray(np.asarray(node.value).ravel()[positions])
            starts = np.cumsum([0, *(arg.size for arg in node.args)])
            owner = np.searchsorted(starts, positions, side="right") - 1
            first = int(owner.flat[0])
            assert (owner == first).all(), "a loop reads from several arrays"
            return self.read(node.args[first], np.asarray(positions - starts[first]), names)
        if node.op == "const":
            return self.literal(np.asarray(values(node).ravel()[positions]), node.dtype, names)
        name = self.name(node)
        if node.op == "input":
            return name if self.inputs[node.attribute][1] else f"{name}[{self.index(positions, names)}]"
        if node in self.plan.arrays or node.op in ("carry", "project"):
            return f"{name}[{self.index(positions, names)}]"
        if node.op == "counter" or node.size == 1:
            return name
        return f"{name}_{int(positions.flat[0])}"

    def index(self, positions: np.ndarray, names: Sequence[str]) -> str:
        """C expression of an index."""
        terms, first = [], 0
        linear = strides(positions)
        if linear is None:
            # What moves by equal steps is not stored.
            even = {axis: step for axis in range(positions.ndim) if (step := _step(positions, axis)) is not None}
            kept = positions[tuple(0 if axis in even else slice(None) for axis in range(positions.ndim))]
            table, names_kept = self.source.table(kept.astype(np.int32), "int"), []
            for axis, name in enumerate(names):
                if axis in even:
                    terms += [(even[axis], name)]
                else:
                    names_kept.append(name)
            inside = self.index(np.arange(kept.size).reshape(kept.shape), names_kept)
            terms.append((1, f"{table}[{inside}]"))
        else:
            first, terms = linear[0], list(zip(linear[1], names, strict=True))
        texts = [f"{stride} * {name}" if stride != 1 else name for stride, name in terms if stride]
        return " + ".join([*texts, *([str(first)] if first or not texts else [])]).replace("+ -", "- ")

    def literal(self, numbers: np.ndarray, dtype: str, names: Sequence[str]) -> str:
        """C expression of numbers over the box of loops with these variables."""
        if numbers.size and same(numbers).all():
            return self.number(numbers.flat[0], dtype)
        # Axes along which nothing changes are not stored.
        kept = [axis for axis in range(numbers.ndim) if not (numbers == numbers.take([0], axis=axis)).all()]
        stored = numbers[tuple(slice(None) if axis in kept else 0 for axis in range(numbers.ndim))]
        index = self.index(np.arange(stored.size).reshape(stored.shape), [names[axis] for axis in kept])
        return f"{self.source.table(stored, dtype)}[{index}]"

    def number(self, value, dtype: str) -> str:
        """A literal."""
        if dtype == "real":
            return literal(value, self.source.precision)
        text = integer(int(value), dtype)
        return f"({text})" if value < 0 else text

    def pointer(self, node: Node) -> str:
        """To the memory of a node."""
        name = self.name(node)
        return (
            name if node in self.plan.arrays or node.op != "input" or not self.inputs[node.attribute][1] else f"&{name}"
        )

    def c_type(self, dtype: str) -> str:
        """C type of a kind of number."""
        return C_TYPES[dtype]

    def projected(self, loop: Node) -> set[int]:
        """Which results of a loop are read."""
        return {
            node.attribute
            for node, mask in self.plan.needed.items()
            if node.op == "project" and node.args[0] is loop and mask.any()
        }

    def uses(self, node: Node) -> bool:
        """Whether anything reads a node."""
        return node in self.plan.needed and bool(self.plan.needed[node].any())


def _step(positions: np.ndarray, axis: int) -> int | None:
    """By which all positions move along an axis, or None where they do so differently."""
    steps = np.diff(positions, axis=axis)
    return None if steps.size and np.ptp(steps) else int(steps.flat[0]) if steps.size else 0


def same(numbers: np.ndarray) -> np.ndarray:
    """Whether each is the first, NaN or not."""
    first = numbers.flat[0]
    return np.asarray((numbers == first) | ((numbers != numbers) & bool(first != first)))
