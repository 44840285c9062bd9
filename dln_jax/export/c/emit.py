"""Writes a planned program as the body of a C function, region by region."""

from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import nullcontext

import numpy as np

from dln_jax.export.c import elements, kernels
from dln_jax.export.c.body import Body, Called, Source
from dln_jax.export.c.elements import copied
from dln_jax.export.c.nodes import Loop, Node, Region, is_constant, values
from dln_jax.export.c.operations import OPERATIONS, total
from dln_jax.export.c.plan import needed_by, plan_of
from dln_jax.export.c.program import Program
from dln_jax.export.c.text import C_TYPES, failure, literal


def body_of(
    source: Source, program: Program, results: Sequence[Node], inputs: dict[int, tuple[str, bool]],
    targets: Sequence[str], *, apart: bool = False, optional: bool = False,
) -> Body:  # fmt: skip
    """Returns the body of a function that writes its results to targets or, without targets, returns its only result.

    Args:
        source: tables and helper functions of the file.
        inputs: name of every argument, and a flag for passing by value.
        targets: names of the arrays for the results.
        apart: results never overlap arguments.
        optional: a target may be a null pointer.
    """
    body = Body(source, program, plan_of(program, results), inputs)
    region(body, ())
    if results and not targets:
        body.line(f"return {body.read(results[0], np.array(0))};")
    # All arguments must be read before writing to targets that may overlap them. So results that only move elements of
    # arguments are copied to arrays first.
    moved = {k for k, _ in enumerate(targets) if not apart and results[k].size and _is_moved(body, results[k])}
    for k in sorted(moved):
        body.declared(f"r{k}_", results[k].dtype, results[k].size)
        copied(body, results[k], f"r{k}_")
    for k, target in enumerate(targets):
        with body.block(f"if ({target})") if optional else nullcontext():
            if k in moved:
                _from_array(body, f"r{k}_", results[k].size, target)
            else:
                copied(body, results[k], target)
    body.stack += max((source.parts[key].body.stack for key in body.calls), default=0)
    return body


def _is_moved(body: Body, node: Node) -> bool:
    """Returns whether a node only moves elements of an argument."""
    if node.op == "gather" and node not in body.plan.arrays:
        return any(_is_moved(body, arg) for arg in node.args)
    return node.op == "input" and not body.inputs[node.attribute][1]


def _from_array(body: Body, source: str, size: int, target: str) -> None:
    body.line(f"for (int k_ = 0; k_ < {size}; ++k_) {target}[k_] = {source}[k_];")


def region(body: Body, region: Region, only: Collection[Node] | None = None) -> None:
    """Writes the remaining nodes of a region; `only` restricts them to a set."""
    nodes = [node for node in body.plan.order.get(region, []) if only is None or node in only]
    for node in nodes:
        if node not in body.done:
            _computed(body, node, nodes)
            body.finished(node)


def _computed(body: Body, node: Node, among: list[Node]) -> None:
    """Writes a node, and other nodes of its region from the same C text."""
    plan = body.plan
    body.done.add(node)
    if node.op == "gather":
        copied(body, node, body.kept(node), own=True)
    elif node in plan.unrolled:
        elements.unrolled(body, node)
    elif node.op == "dot_general":
        members = [
            other for other in among
            if other.op == "dot_general" and other not in body.done
            and other.args[1] is node.args[1] and plan.levels[other] == plan.levels[node]
        ]  # fmt: skip
        body.done.update(members)
        kernels.dot_general(body, [node, *members])
        for member in members:
            body.finished(member)
    elif node.op in OPERATIONS or node.op == "take":
        elements.looped(body, node)
    else:
        (_CONTROL.get(node.op) or kernels.WRITERS[node.op])(body, node)


def _call(body: Body, node: Node) -> None:
    """Writes a call of another program's C function and, on first use, that function."""
    source, key = body.source, node.attribute
    if key not in source.parts:
        source.parts[key] = _part(source, *body.program.parts[key])
    called = source.parts[key]
    body.calls |= {key, *called.body.calls}
    names = [f"v{node.number}_{k}" for k in range(len(called.results))]
    for name, result in zip(names, called.results, strict=True):
        body.declared(name, result.dtype, max(result.size, 1))
    body.line(f"{called.name}({', '.join([*map(body.pointer, node.args), *names])});")
    body.spend(**called.body.operations)
    body.unbounded += called.body.unbounded


def _part(source: Source, program: Program, results: list[Node]) -> Called:
    inputs = {node.attribute: node for node in program.nodes if node.op == "input"}
    targets = [f"r{k}_" for k in range(len(results))]
    body = body_of(source, program, results, {k: (f"a{k}_", False) for k in inputs}, targets, apart=True)
    parameters = [f"const {C_TYPES[inputs[k].dtype]} *RESTRICT a{k}_" for k in sorted(inputs)]
    parameters += [f"{C_TYPES[node.dtype]} *RESTRICT {target}" for node, target in zip(results, targets, strict=True)]
    unused = [f"    (void)a{k}_;" for k in sorted(inputs) if inputs[k] not in body.plan.nodes]
    unused += [f"    (void){target};" for result, target in zip(results, targets, strict=True) if not result.size]
    lines = "\n".join([*unused, *body.lines])
    name = f"part_{len(source.parts)}"
    return Called(name, results, f"\nstatic void {name}({', '.join(parameters)})\n{{\n{lines}\n}}\n", body)


def _stored(body: Body, node: Node, results: Sequence[Node], turns: int = 1) -> list[str]:
    """Declares arrays for the results of a loop or branch, read or not, and returns their names.

    A loop has arrays for its carries, initialised with its arguments, then for the outputs of all `turns` iterations.
    """
    number = np.ravel(node.attribute)[0]
    starts = () if node.op == "branch" else node.args
    names = [f"c{number}_{index}" for index in range(len(results))]
    for index, (name, result) in enumerate(zip(names, results, strict=True)):
        body.declared(name, result.dtype, max(result.size * (turns if index >= len(starts) else 1), 1))
    read = body.projected(node)
    for name in (name for index, name in enumerate(names) if index not in read):
        body.line(f"(void){name};")
    for name, start in zip(names, starts, strict=False):
        copied(body, start, name)
    return names


def _carry_over(body: Body, loop: Loop, names: list[str], number: int) -> None:
    """Writes the new carries through temporaries, because they may permute the old carries."""
    moved = [
        (name, f"n{number}_{index}", node)
        for index, (name, node) in enumerate(zip(names, loop.results, strict=False))
        if node.size
    ]
    for _, temporary, node in moved:
        body.declared(temporary, node.dtype, node.size)
        copied(body, node, temporary)
    for name, temporary, node in moved:
        _from_array(body, temporary, node.size, name)


def _while(body: Body, node: Node) -> None:
    number, loop = node.attribute, body.program.loops[node.attribute]
    names, inside = _stored(body, node, loop.carries), (*node.region, number)
    bound = _bound(node, loop)
    stopped = body.source.loop_bound if bound is None else None
    turns = stopped if bound is None else bound
    body.unbounded += turns is None
    if stopped:
        body.declared(f"t{number}", "int", 0)
    with body.block(f"for (t{number} = 0;; ++t{number})" if stopped else "for (;;)"):
        with body.repeated(1 if turns is None else turns + 1):
            region(body, inside, {*needed_by(body.program, loop.conditions)})
        body.line(f"if (!{body.read(loop.conditions[0], np.array(0))}) break;")
        if stopped:
            with body.block(f"if (t{number} == {stopped})"):
                for name, carry in zip(names, loop.carries, strict=True):
                    value = literal(failure(carry.dtype), body.source.precision, carry.dtype)
                    body.line(f"for (int k_ = 0; k_ < {carry.size}; ++k_) {name}[k_] = {value};")
                body.line("break;")
        with body.repeated(1 if turns is None else turns):
            region(body, inside)
            _carry_over(body, loop, names, number)


def _bound(node: Node, loop: Loop) -> int | None:
    """Returns the largest number of iterations of a `while` with a counter in its condition, or None."""
    waiting, bounds = [*loop.conditions], []
    for test in waiting:
        if test.op == "and" and test.dtype == "bool":
            waiting += test.args
        elif test.op in ("lt", "le", "gt", "ge"):
            counter, last = test.args if test.op in ("lt", "le") else test.args[::-1]
            if counter in loop.carries and is_constant(last) and counter.dtype != "real":
                place = loop.carries.index(counter)
                start, after = node.args[place], loop.results[place]
                steps = [arg for arg in after.args if arg is not counter] if after.op == "add" else []
                if len(steps) == 1 and all(map(is_constant, (start, *steps))) and values(steps[0]) > 0:
                    left = int(values(last)) - int(values(start)) + (test.op in ("le", "ge"))
                    bounds.append(max(0, -(-left // int(values(steps[0])))))
    return min(bounds, default=None)


def _repeat(body: Body, node: Node) -> None:
    number, loop = node.attribute, body.program.loops[node.attribute]
    length, carried = int(loop.length or 0), len(loop.carries)
    names = _stored(body, node, [*loop.carries, *loop.results[carried:]], length)
    stacked = [index for index in sorted(body.projected(node)) if index >= carried]
    turn = f"{length - 1} - t{number}" if loop.reverse else f"t{number}"
    with body.loops({f"t{number}": length}):
        if stacked or any(node.op == "counter" and node.attribute == number for node in body.plan.nodes):
            body.line(f"const long long i_{number} = {turn};")
        region(body, (*node.region, number))
        for index in stacked:
            copied(body, loop.results[index], f"({names[index]} + i_{number} * {loop.results[index].size})")
        _carry_over(body, loop, names[:carried], number)


def _branch(body: Body, node: Node) -> None:
    numbers = node.attribute
    names = _stored(body, node, body.program.loops[numbers[0]].results)
    which, before, most = body.read(node.args[0], np.array(0)), body.operations, Counter()
    for place, number in enumerate(numbers):
        test = f"if ({which} {'<=' if place == 0 else '=='} {place})" if place < len(numbers) - 1 else ""
        body.operations = Counter()
        with body.block(("else " if place else "") + test):
            region(body, (*node.region, number))
            for index, (name, result) in enumerate(zip(names, body.program.loops[number].results, strict=True)):
                if index in body.projected(node):
                    copied(body, result, name)
        most = max(most, body.operations, key=total)
    body.operations = before + most


_CONTROL = {"call": _call, "while": _while, "repeat": _repeat, "branch": _branch}
