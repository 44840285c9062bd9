"""Lowering rules for loops and branches, which remain loops and branches in the program.

With finite arguments (`Program.finite`), loop elements with an unchanging known value are constants inside and after
the loop. Structural zeros of a derivative then cost nothing.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dln_jax.export.c import indexing
from dln_jax.export.c.nodes import Loop, Node, Region, known
from dln_jax.export.c.primitives import RULES as SIMPLE
from dln_jax.export.c.program import Program
from dln_jax.export.c.text import kind_of


def _opened(program: Program, around: Sequence[Node], start: Sequence[Node] = ()) -> tuple[Region, list[Node]]:
    """Returns the region inside a new loop or branch that reads the nodes around it, and its carries."""
    number = len(program.loops)
    program.loops[number] = Loop([], [], [])
    region = (*max((program.floor, *(node.region for node in around)), key=len), number)
    return region, [
        program.make("carry", carry.shape, carry.dtype, attribute=(number, index), region=region)
        for index, carry in enumerate(start)
    ]


def projections(program: Program, node: Node, results: Sequence[Any]) -> list[Node]:
    """Returns the results of a loop, a branch or a call with these abstract values."""
    return [program.make("project", aval.shape, kind_of(aval.dtype), [node], k) for k, aval in enumerate(results)]


def _with_known(
    program: Program, nodes: Sequence[Node], constants: Sequence[tuple[np.ndarray, np.ndarray]]
) -> list[Node]:
    """Returns the nodes with the elements under a mask [size] replaced by constants."""
    results = [*nodes]
    for place, (node, (mask, numbers)) in enumerate(zip(nodes, constants, strict=True)):
        if mask.any():
            index = np.arange(node.size)
            both = [node, program.constant(numbers, node.dtype)]
            results[place] = program.gather(both, np.where(mask, index + node.size, index).reshape(node.shape))
    return results


def _steady(
    program: Program, start: Sequence[Node], carries: Sequence[Node], body: Callable[[list[Node]], list[Node]]
) -> tuple[list[Node], list[Node], list[tuple[np.ndarray, np.ndarray]]]:
    """Returns a loop's inner carries, the results of its body, and masks and values of unchanging elements.

    All elements known at the start are assumed constant; elements that the body changes are dropped until none changes.
    """
    steady = [known(node) for node in start]
    steady = [(mask & (program.finite and mask.size > 1), numbers) for mask, numbers in steady]
    while True:
        inside = _with_known(program, carries, steady)
        results = body(inside)
        after = [known(result) for result in results[: len(start)]]
        kept = [
            (mask & still & (numbers == new), numbers)
            for (mask, numbers), (still, new) in zip(steady, after, strict=True)
        ]
        if all(np.array_equal(one[0], other[0]) for one, other in zip(steady, kept, strict=True)):
            return inside, results, steady
        steady = kept


def _while(
    program: Program, *args: Node, cond_nconsts: int, cond_jaxpr: Any, body_nconsts: int, body_jaxpr: Any,
    results: Sequence[Any],
) -> list[Node]:  # fmt: skip
    """Applies `while`; under `vmap` it iterates while the condition of any row holds, and other rows keep their
    carries."""
    of_condition, of_body = args[:cond_nconsts], args[cond_nconsts : cond_nconsts + body_nconsts]
    start = args[cond_nconsts + body_nconsts :]
    region, carries = _opened(program, args, start)

    def condition(inside: Sequence[Node]) -> Node:
        return program.inline(program, cond_jaxpr, [*of_condition, *inside])[0]

    def turn(inside: list[Node]) -> list[Node]:
        after, holds = program.inline(program, body_jaxpr, [*of_body, *inside]), condition(inside)
        if holds.shape == ():
            return after
        added = [[1] * (len(new.shape) - len(holds.shape)) for new in after]
        every = [program.reshape(holds, (*holds.shape, *ones)) for ones in added]
        return [
            program.elementwise("select", row, new, old) for row, old, new in zip(every, inside, after, strict=True)
        ]

    inside, after, steady = _steady(program, start, carries, turn)
    holds = condition(inside)
    holds = SIMPLE["reduce_or"](program, holds, axes=range(len(holds.shape)))
    program.loops[region[-1]] = Loop(carries, [holds], after)
    loop = program.make("while", (), "int", start, attribute=region[-1], region=region[:-1])
    return _with_known(program, projections(program, loop, results), steady)


def _scan(program: Program, *args: Node, length: int, jaxpr: Any, reverse: bool, results: Sequence[Any]) -> list[Node]:
    inner = jaxpr.jaxpr

    def alike(outside: Sequence[Any], inside: Sequence[Any]) -> int:
        return sum(a.shape == b.aval.shape for a, b in zip(outside, inside, strict=True))

    # Counted here, because JAX releases store these numbers differently; stacked arrays have another shape inside.
    count = alike(results, inner.outvars)
    constants = alike(args, inner.invars) - count
    fixed, start, stacked = args[:constants], args[constants : constants + count], args[constants + count :]
    if length == 0:
        empty = [program.constant(np.zeros(aval.shape), kind_of(aval.dtype)) for aval in results[count:]]
        return [*start, *empty]
    region, carries = _opened(program, args, start)
    turn = program.make("counter", (), "index", attribute=region[-1], region=region)
    slices = [_slice_of(program, array, turn, length) for array in stacked]
    _, after, steady = _steady(
        program, start, carries, lambda inside: program.inline(program, jaxpr, [*fixed, *inside, *slices])
    )
    program.loops[region[-1]] = Loop(carries, [], after, length, reverse)
    loop = program.make("repeat", (), "int", start, attribute=region[-1], region=region[:-1])
    stacked = [known(result) for result in after[count:]]
    steady += [(np.tile(mask & program.finite, length), np.tile(numbers, length)) for mask, numbers in stacked]
    return _with_known(program, projections(program, loop, results), steady)


def _slice_of(program: Program, array: Node, turn: Node, length: int) -> Node:
    """Returns the slice of a stacked array in an iteration; elements equal in all slices are constants."""
    size, shape, index = array.size // length, array.shape[1:], np.arange(array.size)
    mask, numbers = (part.reshape(length, size) for part in known(array))
    same = mask.all(0) & (numbers == numbers[0]).all(0) & program.finite
    whole = array
    if same.any() and array.op == "gather" and array.args[0].shape == array.shape and array.args[0].op != "const":
        # The original array is in memory; the array with constants would need a copy.
        whole = array.args[0] if ((np.ravel(array.value) == index) | np.tile(same, length)).all() else array
    first = program.elementwise("mul", turn, size)
    offsets = program.constant(np.arange(size).reshape(shape), "index")
    taken = indexing.take(program, whole, program.elementwise("add", first, offsets))
    return _with_known(program, [taken], [(same, numbers[0])])[0]


def _cond(
    program: Program, which: Node, *operands: Node, branches: Sequence[Any], results: Sequence[Any]
) -> list[Node]:
    if len(branches) == 1 or which.op == "const":
        chosen = int(np.clip(which.value, 0, len(branches) - 1)) if which.value is not None else 0
        return program.inline(program, branches[chosen], operands)
    floor, regions = program.floor, []
    for closed in branches:
        region, _ = _opened(program, [which, *operands])
        regions.append(region)
        program.floor = region
        program.loops[region[-1]] = Loop([], [], program.inline(program, closed, operands))
        program.floor = floor
    numbers = tuple(region[-1] for region in regions)
    branch = program.make("branch", (), "int", [which], attribute=numbers, region=regions[0][:-1])
    return projections(program, branch, results)


RULES = {"while": _while, "scan": _scan, "cond": _cond}
"""Rules by name of the primitive."""
