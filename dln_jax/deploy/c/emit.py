"""A planned program as the body of a C function.

An array is read at positions, an integer array over the box of the loops around the reading: no loops, one element.
What moves elements then is indexing of that array, and a constant is stored in the order in which it is read.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from dln_jax.deploy.c import kernels, products
from dln_jax.deploy.c.operations import OPERATIONS, VECTORISED
from dln_jax.deploy.c.plan import WRITTEN_OUT, Plan, plan_of, strides
from dln_jax.deploy.c.program import Node, Program, Region, is_constant, values
from dln_jax.deploy.c.text import integer, literal

C_TYPES = {"real": "real", "bool": "int", "int": "int", "long": "long long", "unsigned": "unsigned"}
C_TYPES |= {"unsigned_long": "unsigned long long"}
_CHOICES = {
    "select": "elementary_choice({0}, {1}, {2})",
    "max": "elementary_choice(({0} > {1}) | ({0} != {0}), {0}, {1})",
    "min": "elementary_choice(({0} < {1}) | ({0} != {0}), {0}, {1})",
}
"""In loops without a branch, which would keep them from being vectorised."""


class Called(NamedTuple):
    """A function that others call."""

    name: str
    results: list[Node]
    text: str
    operations: int
    bytes: int


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
    kernels: set[str] = field(default_factory=set)
    parts: dict[Any, "Called"] = field(default_factory=dict)
    """Functions that others call."""
    names: dict[str, str] = field(default_factory=dict)
    """Their names, by what they do."""

    @property
    def suffix(self) -> str:
        """Of functions of <math.h> and literals."""
        return "f" if self.precision == "f32" else ""

    def table(self, numbers: np.ndarray, dtype: str) -> str:
        """Name of a constant array."""
        array = np.ascontiguousarray(numbers)
        if dtype == "real":
            array = array.astype(np.float32 if self.precision == "f32" else np.float64)
        array = array.astype(np.int32) if dtype == "int" else array
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
    """Functions that it calls, by their keys in the source."""
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
        for source in self.plan.reads.get(step, ()):
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

    # Reading

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
            starts = np.cumsum([0, *(each.size for each in node.args)])
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
        found = strides(positions)
        if found is None:
            table = self.source.table(positions.astype(np.int32), "int")
            return f"{table}[{self.index(np.arange(positions.size).reshape(positions.shape), names)}]"
        first, steps = found
        terms = [f"{step} * {name}" if step != 1 else name for step, name in zip(steps, names, strict=True) if step]
        return " + ".join([*terms, *([str(first)] if first or not terms else [])]).replace("+ -", "- ")

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
        text = integer(int(value)) if value >= 0 else f"({integer(int(value))})"
        return text + {"unsigned": "U", "unsigned_long": "ULL"}.get(dtype, "")

    def pointer(self, node: Node) -> str:
        """To the memory of a node."""
        name = self.name(node)
        return (
            name if node in self.plan.arrays or node.op != "input" or not self.inputs[node.attribute][1] else f"&{name}"
        )

    def c_type(self, dtype: str) -> str:
        """C type of a kind of number."""
        return C_TYPES[dtype]

    # Writing

    def part(self, key: Any) -> Called:
        """A function that is called, written where it was not yet."""
        if key not in self.source.parts:
            program, results = self.program.parts[key]
            inputs = sorted((node for node in program.nodes if node.op == "input"), key=lambda each: each.attribute)
            named = {each.attribute: (f"a{each.attribute}_", False) for each in inputs}
            targets = [f"r{k}_" for k in range(len(results))]
            body = body_of(self.source, program, results, named, targets)
            parameters = [f"const {C_TYPES[each.dtype]} *RESTRICT a{each.attribute}_" for each in inputs]
            parameters += [
                f"{C_TYPES[each.dtype]} *RESTRICT {target}" for each, target in zip(results, targets, strict=True)
            ]
            unused = [f"    (void)a{each.attribute}_;" for each in inputs if not body.uses(each)]
            lines = "\n".join([*unused, *body.lines])
            text = f"({', '.join(parameters)})\n{{\n{lines}\n}}\n"
            name = self.source.names.setdefault(text, f"part_{len(self.source.names)}")
            text = f"\nstatic void {name}{text}"
            self.source.parts[key] = Called(name, results, text, body.operations, body.bytes)
        self.calls.add(key)
        return self.source.parts[key]

    def projected(self, loop: Node) -> set[int]:
        """Which results of a loop are read."""
        return {
            each.attribute
            for each, mask in self.plan.needed.items()
            if each.op == "project" and each.args[0] is loop and mask.any()
        }

    def uses(self, node: Node) -> bool:
        """Whether anything reads an input."""
        return node in self.plan.needed and bool(self.plan.needed[node].any())

    def copied(self, node: Node, target: str) -> None:
        """Copies all elements of a node to an array."""
        copied(self, node, target)

    def region(self, region: tuple[int, ...], done: set[Node] | None = None, only: set[Node] | None = None) -> None:
        """What is computed in a region and not done yet: all of it, or some nodes."""
        done = set() if done is None else done
        for node in self.plan.order.get(region, []):
            if node not in done and (only is None or node in only):
                done.add(node)
                self._computed(node, done, only)
                self.finished(node)

    def ancestors(self, nodes: Sequence[Node]) -> set[Node]:
        """These nodes and all that they need, with the loops that compute it."""
        found, waiting = set(), list(nodes)
        while waiting:
            node = waiting.pop()
            if node not in found:
                found.add(node)
                waiting += [*node.args, *([self.plan.root[node]] if node in self.plan.root else [])]
        return found

    def _computed(self, node: Node, done: set[Node], only: set[Node] | None) -> None:
        plan = self.plan
        if node.op in ("input", "const", "carry", "counter", "project"):
            return
        if node.op == "arrange":
            if node in plan.arrays:
                copied(self, node, self.kept(node), own=True)
        elif node in plan.written_out:
            self._elements(node)
        elif node.op == "contract":
            members = [
                each for each in plan.order[node.region]
                if each.op == "contract" and each not in done and each not in plan.written_out
                and (only is None or each in only)
                and each.args[1] is node.args[1] and plan.levels[each] == plan.levels[node]
            ]  # fmt: skip
            done.update(members)
            products.contracted(self, [node, *members])
            for each in members:
                self.finished(each)
        elif node.op in OPERATIONS or node.op == "take":
            self._loop(node)
        else:
            kernels.written(self, node)

    def _elements(self, node: Node) -> None:
        dtype = C_TYPES[node.dtype]
        name = self.kept(node) if node in self.plan.arrays else self.name(node)
        for k in np.flatnonzero(self.plan.needed[node]):
            text = self._element(node, int(k))
            if node in self.plan.arrays:
                self.line(f"{name}[{k}] = {text};")
            else:
                self.bytes += 8
                self.line(f"const {dtype} {name}{f'_{k}' if node.size > 1 else ''} = {text};")

    def _element(self, node: Node, k: int) -> str:
        if node.op == "contract":
            a, b = node.args
            (_, m, count), n = a.shape, b.shape[2]
            batch, row, column = np.unravel_index(k, node.shape)
            first = [self.read(a, np.array((batch * m + row) * count + each)) for each in range(count)]
            second = [self.read(b, np.array((batch * count + each) * n + column)) for each in range(count)]
            self.spend(2 * count - 1)
            return products.chain(list(zip(first, second, strict=True)))
        if node.op.startswith("reduce_"):
            (a,) = node.args
            count = a.shape[1]
            terms = [self.read(a, np.array(k * count + each)) for each in range(count)]
            return kernels.combined(self, node, k, terms)
        if node.op == "take":
            return f"{self.name(node.args[0])}[{self.read(node.args[1], np.array(k))}]"
        return self.expression(node, [self.read(each, np.array(k if each.size > 1 else 0)) for each in node.args])

    def expression(self, node: Node, args: list[str], *, looped: bool = False) -> str:
        """C of an elementwise operation."""
        operation = OPERATIONS[node.op]
        self.spend(operation.cost * (node.dtype == "real" or node.args[0].dtype == "real"))
        if operation.function in VECTORISED and not self.source.libm:
            self.source.functions.add(node.op)
            return f"elementary_{node.op}({args[0]})"
        if looped and node.dtype == "real" and node.op in _CHOICES:
            return _CHOICES[node.op].format(*args)
        if node.op in ("max", "min") and node.dtype != "real":
            return f"({args[0]} {'>' if node.op == 'max' else '<'} {args[1]} ? {args[0]} : {args[1]})"
        if node.op.startswith("to_") and node.op != "to_bool":
            return f"(({C_TYPES[node.dtype]}){args[0]})"
        return operation.c.format(*args, f=self.source.suffix)

    def _loop(self, node: Node) -> None:
        """A loop of elementwise operations that ends in a node."""
        inside = sorted(
            {node, *(each for each, root in self.plan.root.items() if root is node)}, key=lambda each: each.number
        )
        where: dict[Node, np.ndarray] = {}
        index = np.arange(node.size).reshape(node.shape)
        for each in inside:
            for arg in each.args[1:] if each.op == "take" else each.args:
                if arg not in inside:
                    where[arg] = index if arg.size == node.size else np.zeros_like(index)
        name = self.kept(node)
        if node.op in VECTORISED and not self.source.libm:
            self.spend(OPERATIONS[node.op].cost * node.size)
            self.source.arrays.add(node.op)
            self.line(f"elementary_{node.op}_each({node.size}, {self.name(node.args[0])}, {name});")
            return
        shape = merged(node.shape, [self._steps(arg, positions) for arg, positions in where.items()])

        def statements(names: list[str]) -> None:
            text = {arg: self.read(arg, positions.reshape(shape), names) for arg, positions in where.items()}
            for each in inside:
                if each.op == "take":
                    written = f"{self.name(each.args[0])}[{text[each.args[1]]}]"
                else:
                    written = self.expression(each, [text[arg] for arg in each.args], looped=True)
                text[each] = f"v{each.number}"
                if each is node:
                    self.line(f"{name}[{self.index(index.reshape(shape), names)}] = {written};")
                elif each.dtype == "bool":
                    text[each] = written
                else:
                    self.line(f"const {C_TYPES[each.dtype]} v{each.number} = {written};")

        self.looped(shape, statements)

    def _steps(self, node: Node, positions: np.ndarray) -> tuple[int, ...] | None:
        """How far a reading moves along each axis; None where it is a table."""
        if node.op == "arrange" and node not in self.plan.arrays:
            positions = np.asarray(np.asarray(node.value).ravel()[positions])
            if is_constant(node):
                return None if strides(positions) is None else strides(positions)[1]
        found = strides(positions)
        return None if found is None else found[1]


def same(numbers: np.ndarray) -> np.ndarray:
    """Whether each is the first, NaN or not."""
    first = numbers.flat[0]
    return np.asarray((numbers == first) | ((numbers != numbers) & bool(first != first)))


def merged(shape: Sequence[int], steps: list[tuple[int, ...] | None]) -> list[int]:
    """The shape with neighbouring axes as one where all readings allow it; never without an axis."""
    result: list[int] = []
    kept: list[int] = []
    for axis, extent in enumerate(shape):
        if extent == 1 and len(shape) > 1 and (result or axis + 1 < len(shape)):
            continue
        before = kept[-1] if kept else None
        joined = before is not None and all(each is not None and each[before] == each[axis] * extent for each in steps)
        if joined:
            result[-1] *= extent
            kept[-1] = axis
        else:
            result.append(extent)
            kept.append(axis)
    return result or [1]


def copied(body: Body, node: Node, target: str, *, own: bool = False) -> None:
    """Copies all elements of a node to an array; to its own, from where they come."""
    index = np.arange(node.size).reshape(node.shape)
    stored = node in body.plan.arrays and not own
    if node.size <= WRITTEN_OUT and not stored:
        for k in range(node.size):
            body.line(f"{target}[{k}] = {_moved(body, node, np.array(k), own)};")
        return
    for box in [index] if stored else _boxes(node, index):
        box = box.reshape(box.shape or (1,))
        body.looped(
            box.shape,
            lambda names, box=box: body.line(
                f"{target}[{body.index(box, names)}] = {_moved(body, node, box, own, names)};"
            ),
        )


def _moved(body: Body, node: Node, positions: np.ndarray, own: bool, names: Sequence[str] = ()) -> str:
    """Reading, through an arrange that is itself kept where it is its own copy."""
    if not (own and node.op == "arrange"):
        return body.read(node, positions, names)
    starts = np.cumsum([0, *(each.size for each in node.args)])
    inside = np.asarray(np.asarray(node.value).ravel()[positions])
    first = int(np.searchsorted(starts, inside.flat[0], side="right")) - 1
    return body.read(node.args[first], np.asarray(inside - starts[first]), names)


def _boxes(node: Node, index: np.ndarray) -> list[np.ndarray]:
    """Boxes of elements that a loop can follow, each from one source."""
    if node.op != "arrange" or node.value is None:
        return [index]
    starts = np.cumsum([0, *(each.size for each in node.args)])
    owner = (np.searchsorted(starts, node.value, side="right") - 1).ravel()
    flat = node.value.ravel()

    def split(box: np.ndarray) -> list[np.ndarray]:
        at, of = flat[box], owner[box]
        if strides(at) is not None and (of == of.flat[0]).all():
            return [box]
        cuts = {axis: _runs(np.moveaxis(at, axis, 0), np.moveaxis(of, axis, 0)) for axis in range(at.ndim)}
        axis = min((each for each in cuts if len(cuts[each]) > 2), key=lambda each: len(cuts[each]), default=None)
        if axis is None:
            axis = next(each for each in range(at.ndim) if at.shape[each] > 1)
            cuts[axis] = list(range(at.shape[axis] + 1))
        return [
            part
            for low, high in pairwise(cuts[axis])
            for part in split(box[(slice(None),) * axis + (slice(low, high),)])
        ]

    return split(index)


def _runs(at: np.ndarray, owner: np.ndarray) -> list[int]:
    """Where runs of rows from the same sources with equal steps begin, and the end."""
    steps, cuts = np.diff(at, axis=0), [0]
    for row in range(1, len(at)):
        first = cuts[-1]
        uneven = row > first + 1 and not np.array_equal(steps[row - 1], steps[first])
        if uneven or not np.array_equal(owner[row], owner[first]):
            cuts.append(row)
    return [*cuts, len(at)]


def body_of(source: Source, program: Program, results: Sequence[Node], inputs, targets: Sequence[str | None]) -> Body:
    """The body of a function that writes each result to a target, or returns the one without."""
    body = Body(source, program, plan_of(program, results), inputs)
    body.region(())
    # All results are written after all arguments are read, so that they may overlap.
    for node, target in zip(results, targets, strict=True):
        if target is None:
            body.line(f"return {body.read(node, np.array(0))};")
        else:
            copied(body, node, target)
    body.bytes += max((source.parts[key].bytes for key in body.calls), default=0)
    return body
