"""The text of one C function under construction: lines, variables for nodes, and expressions that read them.

A read takes an integer array of positions with one axis per surrounding loop (a scalar outside loops). Slices,
transposes and gathers become indexing of that integer array, and constants are stored in reading order.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from dln_jax.export.c.interface import Cost
from dln_jax.export.c.nodes import Node, Region, is_constant, read_source, steps, values
from dln_jax.export.c.operations import OPERATIONS, total
from dln_jax.export.c.plan import Plan
from dln_jax.export.c.program import Program
from dln_jax.export.c.text import C_TYPES, PRECISIONS, literal

_FRAME = 512
"""Bytes allowed for saved registers, spilled vectors and helper functions."""
_ALIGNMENT = 32
"""Alignment of gcc's arrays for vectors, bytes."""


class Called(NamedTuple):
    """A C function that other functions call."""

    name: str
    results: list[Node]
    text: str
    body: "Body"


@dataclass
class Source:
    """Tables and helper functions shared by the functions of one source file."""

    precision: str
    finite: bool = False
    """True if arguments and intermediate results are finite."""
    loop_bound: int | None = None
    """Largest number of iterations of a loop without a known bound; it then ends with NaN."""
    tables: dict[tuple[str, bytes], tuple[str, np.ndarray]] = field(default_factory=dict)
    parts: dict[Any, "Called"] = field(default_factory=dict)
    """Called functions, by the key of their program."""

    @property
    def suffix(self) -> str:
        """Suffix of literals and of functions of <math.h>."""
        return PRECISIONS[self.precision][2]

    def copy(self) -> "Source":
        """Returns a copy with its own containers, to discard if a function is refused."""
        return Source(**{attribute.name: copy(getattr(self, attribute.name)) for attribute in fields(self)})

    def table(self, numbers: np.ndarray, dtype: str) -> str:
        """Returns the name of a constant array; equal arrays share one."""
        array = np.ascontiguousarray(numbers)
        if dtype == "real":
            array = array.astype(PRECISIONS[self.precision][0])
        key = dtype, array.tobytes() + str(array.size).encode()
        return self.tables.setdefault(key, (f"table_{len(self.tables)}", array))[0]


@dataclass
class Body:
    """The text of one C function under construction."""

    source: Source
    program: Program
    plan: Plan
    inputs: dict[int, tuple[str, bool]]
    """Name of every argument, and a flag for passing by value."""
    lines: list[str] = field(default_factory=list)
    operations: Counter[str] = field(default_factory=Counter)
    """Upper bound on the operations on real numbers, by name in `operations.OPERATIONS`."""
    unbounded: int = 0
    """Number of loops without a bound on their iterations; one iteration of each is counted."""
    stack: int = _FRAME
    """Upper bound on the stack in bytes: variables, and the compiler's additions."""
    calls: set[Any] = field(default_factory=set)
    """Keys (in the source) of its direct and indirect callees."""
    names: dict[Node, str] = field(default_factory=dict)
    """Names of the arrays for nodes."""
    done: set[Node] = field(default_factory=set)
    """Written nodes."""
    _free: dict[tuple[Region, str, int], list[str]] = field(default_factory=dict)
    """Arrays that later lines may reuse, by region, kind and size."""
    _depth: int = 1
    _turns: int = 1

    def line(self, text: str) -> None:
        """Appends a line at the current indentation."""
        self.lines.append("    " * self._depth + text)

    @contextmanager
    def block(self, text: str, turns: int = 1) -> Iterator[None]:
        """Opens a block that runs `turns` times, and closes it."""
        self.line(f"{text} {{")
        self._depth += 1
        with self.repeated(turns):
            yield
        self._depth -= 1
        self.line("}")

    @contextmanager
    def repeated(self, turns: int) -> Iterator[None]:
        """Counts the operations inside `turns` times."""
        outside, self._turns = self._turns, self._turns * turns
        yield
        self._turns = outside

    @contextmanager
    def loops(self, extents: Mapping[str, int]) -> Iterator[None]:
        """Opens nested loops over variables, each from 0 to below its extent, and closes them."""
        with ExitStack() as stack:
            for name, extent in extents.items():
                stack.enter_context(self.block(f"for (int {name} = 0; {name} < {extent}; ++{name})", extent))
            yield

    def spend(self, **operations: int) -> None:
        """Counts operations on real numbers, by name."""
        self.operations.update({name: count * self._turns for name, count in operations.items()})

    def declared(self, name: str, dtype: str, size: int, value: str = "") -> None:
        """Declares an array, or a scalar if size is 0; a scalar with a value is constant."""
        width = 4 if self.source.precision == "f32" and dtype == "real" else 8
        self.stack += -(-size * width // _ALIGNMENT) * _ALIGNMENT or width
        declaration = f"{C_TYPES[dtype]} {name}" + f"[{size}]" * bool(size) + f" = {value}" * bool(value)
        self.line("const " * bool(value and not size) + declaration + ";")

    def kept(self, node: Node) -> str:
        """Returns the name of an array for a node, reusing a free one if possible."""
        if free := self._free.get((node.region, node.dtype, node.size)):
            self.names[node] = free.pop()
        else:
            self.names[node] = f"v{node.number}"
            self.declared(self.names[node], node.dtype, node.size)
        return self.names[node]

    def finished(self, step: Node) -> None:
        """Frees the arrays that no later step reads."""
        for source in sorted(self.plan.reads.get(step, ()), key=lambda node: node.number):
            self.plan.readers[source] -= 1
            if not self.plan.readers[source] and source in self.names:
                self._free.setdefault((source.region, source.dtype, source.size), []).append(self.names[source])

    def name(self, node: Node) -> str:
        """Returns the name of the array or scalar of a node."""
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
        """Returns the C expression for the elements at these positions, inside loops over these variables."""
        if is_constant(node) and node not in self.plan.arrays:
            return self.literal(np.asarray(values(node).ravel()[positions]), node.dtype, names)
        if node.op == "gather" and node not in self.plan.arrays:
            return self.read(*read_source(node, positions), names)
        name = self.name(node)
        if node.op == "input":
            return name if self.inputs[node.attribute][1] else f"{name}[{self.index(positions, names)}]"
        if node in self.plan.arrays or node.op in ("carry", "project"):
            return f"{name}[{self.index(positions, names)}]"
        return name

    def index(self, positions: np.ndarray, names: Sequence[str]) -> str:
        """Returns the C expression of an index, using a table unless it is linear in the loop variables."""
        every = steps(positions)
        terms = [f"{step} * {name}" if step != 1 else name for step, name in zip(every, names, strict=True) if step]
        # The table omits axes with equal steps of the index.
        first = positions[tuple(slice(None) if step is None else 0 for step in every)]
        if first.ndim:
            left = [name for step, name in zip(every, names, strict=True) if step is None]
            inside = self.index(np.arange(first.size).reshape(first.shape), left)
            terms.append(f"{self.source.table(first.astype(np.int32), 'int')}[{inside}]")
        elif first or not terms:
            terms.append(str(first))
        return " + ".join(terms).replace("+ -", "- ")

    def literal(self, numbers: np.ndarray, dtype: str, names: Sequence[str]) -> str:
        """Returns the C expression of constants, inside loops over these variables."""
        if numbers.size and ((numbers == numbers.flat[0]).all() or (numbers != numbers).all()):
            return literal(numbers.flat[0], self.source.precision, dtype)
        # The table omits axes with equal numbers.
        kept = [axis for axis in range(numbers.ndim) if not (numbers == numbers.take([0], axis=axis)).all()]
        stored = numbers[tuple(slice(None) if axis in kept else 0 for axis in range(numbers.ndim))]
        index = self.index(np.arange(stored.size).reshape(stored.shape), [names[axis] for axis in kept])
        return f"{self.source.table(stored, dtype)}[{index}]"

    def pointer(self, node: Node) -> str:
        """Returns a pointer to the memory of a node."""
        by_value = node not in self.plan.arrays and node.op == "input" and self.inputs[node.attribute][1]
        return f"{'&' if by_value else ''}{self.name(node)}"

    def projected(self, loop: Node) -> set[int]:
        """Returns the indices of a loop's results that are read."""
        return {node.attribute for node in self.plan.nodes if node.op == "project" and node.args[0] is loop}

    @property
    def cost(self) -> Cost:
        """Upper bound on the cost of a call."""
        count, fused = self.operations, self.operations["multiply_add"]
        functions = sum(count[name] for name in OPERATIONS if OPERATIONS[name].function and name != "sqrt")
        return Cost(
            total(count), count["add"] + count["sub"] + fused, count["mul"] + fused, count["div"], count["sqrt"],
            functions, self.stack, self.unbounded,
        )  # fmt: skip
