"""Writes a planned program as the body of a C function, region by region."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from dln_jax.export.c import elements, kernels, products
from dln_jax.export.c.body import Body, Called, Source
from dln_jax.export.c.kinds import C_TYPES
from dln_jax.export.c.moves import copied
from dln_jax.export.c.nodes import Loop, Node
from dln_jax.export.c.operations import OPERATIONS
from dln_jax.export.c.plan import UNROLL_LIMIT, plan_of
from dln_jax.export.c.program import Program


def body_of(
    source: Source, program: Program, results: Sequence[Node], inputs, targets: Sequence[str | None], *, apart=False
) -> Body:
    """Returns the body of a function that writes its results to targets; for [None], that returns its only result.

    Results may overlap arguments unless `apart` is set.
    """
    body = Body(source, program, plan_of(program, results), inputs)
    region(body, ())
    if targets == [None]:
        body.line(f"return {body.read(results[0], np.array(0))};")
    else:
        for target, write in zip(targets, result_writers(body, results, apart=apart), strict=True):
            write(str(target))
    body.bytes += max((source.parts[key].bytes for key in body.calls), default=0)
    return body


def result_writers(body: Body, results: Sequence[Node], *, apart: bool) -> list[Callable[[str], None]]:
    """Returns functions that write the results to targets.

    Targets that may overlap arguments must not be written before all arguments are read: results that only move
    elements of arguments are therefore copied to arrays first.
    """
    writers = []
    for k, node in enumerate(results):
        if apart or node.size == 0 or not _moved_from_argument(body, node):
            writers.append(partial(copied, body, node))
            continue
        body.declared(f"r{k}_", node.dtype, max(node.size, 1))
        copied(body, node, f"r{k}_")
        writers.append(partial(_from_array, body, f"r{k}_", node.size))
    return writers


def _moved_from_argument(body: Body, node: Node) -> bool:
    if node.op == "gather" and node not in body.plan.arrays:
        return any(_moved_from_argument(body, arg) for arg in node.args)
    return node.op == "input" and not body.inputs[node.attribute][1]


def _from_array(body: Body, source: str, size: int, target: str) -> None:
    if size <= UNROLL_LIMIT:
        for k in range(size):
            body.line(f"{target}[{k}] = {source}[{k}];")
    else:
        body.line(f"for (int k_ = 0; k_ < {size}; ++k_) {target}[k_] = {source}[k_];")


def region(body: Body, region: tuple[int, ...], done: set[Node] | None = None, only: set[Node] | None = None) -> None:
    """Writes the nodes of a region that are not done yet; with `only`, those of them in this set."""
    done = set() if done is None else done
    for node in body.plan.order.get(region, []):
        if node not in done and (only is None or node in only):
            done.add(node)
            _computed(body, node, done, only)
            body.finished(node)


def ancestors(body: Body, nodes: Sequence[Node]) -> set[Node]:
    """Returns these nodes, all nodes that they need, and the loops that compute them."""
    needed, waiting = set(), list(nodes)
    while waiting:
        node = waiting.pop()
        if node not in needed:
            needed.add(node)
            waiting += [*node.args, *([body.plan.root[node]] if node in body.plan.root else [])]
    return needed


def _computed(body: Body, node: Node, done: set[Node], only: set[Node] | None) -> None:
    plan = body.plan
    if node.op in ("input", "const", "carry", "counter", "project"):
        return
    if node.op == "gather":
        if node in plan.arrays:
            copied(body, node, body.kept(node), own=True)
    elif node in plan.unrolled:
        elements.unrolled(body, node)
    elif node.op == "dot_general":
        members = [
            other for other in plan.order[node.region]
            if other.op == "dot_general" and other not in done and other not in plan.unrolled
            and (only is None or other in only)
            and other.args[1] is node.args[1] and plan.levels[other] == plan.levels[node]
        ]  # fmt: skip
        done.update(members)
        products.dot_general(body, [node, *members])
        for member in members:
            body.finished(member)
    elif node.op in OPERATIONS or node.op == "take":
        elements.looped(body, node)
    else:
        (_CONTROL.get(node.op) or kernels.WRITERS[node.op])(body, node)


def part(caller: Body, key: Any) -> Called:
    """Returns the C function for a called program, written on first use."""
    source = caller.source
    if key not in source.parts:
        program, results = caller.program.parts[key]
        inputs = sorted((node for node in program.nodes if node.op == "input"), key=lambda argument: argument.attribute)
        named = {argument.attribute: (f"a{argument.attribute}_", False) for argument in inputs}
        targets = [f"r{k}_" for k in range(len(results))]
        body = body_of(source, program, results, named, targets, apart=True)
        parameters = [f"const {C_TYPES[argument.dtype]} *RESTRICT a{argument.attribute}_" for argument in inputs]
        parameters += [
            f"{C_TYPES[result.dtype]} *RESTRICT {target}" for result, target in zip(results, targets, strict=True)
        ]
        unused = [f"    (void)a{argument.attribute}_;" for argument in inputs if not body.uses(argument)]
        lines = "\n".join([*unused, *body.lines])
        text = f"({', '.join(parameters)})\n{{\n{lines}\n}}\n"
        name = source.names.setdefault(text, f"part_{len(source.names)}")
        text = f"\nstatic void {name}{text}"
        source.parts[key] = Called(name, results, text, body.operations, body.bytes, body.calls)
    called = source.parts[key]
    caller.calls |= {key, *called.calls}
    return called


def _call(body: Body, node: Node) -> None:
    called = part(body, node.attribute)
    names = [f"v{node.number}_{k}" for k in range(len(called.results))]
    for name, result in zip(names, called.results, strict=True):
        body.declared(name, result.dtype, max(result.size, 1))
    body.line(f"{called.name}({', '.join([*map(body.pointer, node.args), *names])});")
    body.spend(called.operations)


def _stored(body: Body, node: Node, handed_on: list[Node], turns: list[int] | None = None) -> list[str]:
    """Declares the arrays of carries and stacked outputs of control flow, read or not, and returns their names."""
    number = np.ravel(node.attribute)[0]
    read = body.projected(node)
    names = [f"c{number}_{index}" for index in range(len(handed_on))]
    for name, result, count in zip(names, handed_on, turns or [1] * len(names), strict=True):
        body.declared(name, result.dtype, max(result.size * count, 1))
    for name in (name for index, name in enumerate(names) if index not in read):
        body.line(f"(void){name};")
    return names


def _handed_on(body: Body, loop: Loop, names: list[str], number: int) -> None:
    """Writes the new carries, through temporaries: results of an iteration may be the old carries in another order."""
    moved = loop.results[: len(names)]
    temporary = [f"n{number}_{index}" for index in range(len(moved))]
    for name, node in zip(temporary, moved, strict=True):
        body.declared(name, node.dtype, max(node.size, 1))
        copied(body, node, name)
    for name, old, node in zip(names, temporary, moved, strict=True):
        body.line(f"for (int k_ = 0; k_ < {node.size}; ++k_) {name}[k_] = {old}[k_];")


def _while(body: Body, node: Node) -> None:
    number, loop = node.attribute, body.program.loops[node.attribute]
    names = _stored(body, node, loop.carries)
    for name, start in zip(names, node.args, strict=True):
        copied(body, start, name)
    inside = (*node.region, number)
    body.opened("for (;;)")
    done: set[Node] = set()
    region(body, inside, done, ancestors(body, loop.conditions))
    body.line(f"if (!{body.read(loop.conditions[0], np.array(0))}) break;")
    region(body, inside, done)
    _handed_on(body, loop, names, number)
    body.closed()


def _repeat(body: Body, node: Node) -> None:
    number, loop = node.attribute, body.program.loops[node.attribute]
    length, carried = int(loop.length or 0), len(loop.carries)
    stacked = loop.results[carried:]
    names = _stored(body, node, [*loop.carries, *stacked], [1] * carried + [length] * len(stacked))[:carried]
    for name, start in zip(names, node.args, strict=True):
        copied(body, start, name)
    read = body.projected(node)
    stacked = {carried + k: result for k, result in enumerate(loop.results[carried:]) if carried + k in read}
    turn = f"{length - 1} - t{number}" if loop.reverse else f"t{number}"
    body.opened(f"for (int t{number} = 0; t{number} < {length}; ++t{number})", max(length, 1))
    counters = (counter for counter in body.plan.needed if counter.op == "counter" and counter.attribute == number)
    if stacked or any(map(body.uses, counters)):
        body.line(f"const long long i_{number} = {turn};")
    region(body, (*node.region, number))
    for index, result in stacked.items():
        body.opened("")
        body.declared(f"n{number}_{index}", result.dtype, max(result.size, 1))
        copied(body, result, f"n{number}_{index}")
        target = f"c{number}_{index}[i_{number} * {result.size} + k_]"
        body.line(f"for (int k_ = 0; k_ < {result.size}; ++k_) {target} = n{number}_{index}[k_];")
        body.closed()
    _handed_on(body, loop, names, number)
    body.closed(max(length, 1))


def _branch(body: Body, node: Node) -> None:
    numbers = node.attribute
    names = _stored(body, node, body.program.loops[numbers[0]].results)
    which = body.read(node.args[0], np.array(0))
    for place, number in enumerate(numbers):
        last = place == len(numbers) - 1
        test = f"if ({which} {'<=' if place == 0 else '=='} {place})"
        body.opened(("else " if place else "") + ("" if last else test))
        region(body, (*node.region, number))
        for index, (name, result) in enumerate(zip(names, body.program.loops[number].results, strict=True)):
            if index in body.projected(node):
                copied(body, result, name)
        body.closed()


_CONTROL = {"call": _call, "while": _while, "repeat": _repeat, "branch": _branch}
