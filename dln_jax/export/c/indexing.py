"""Rules for gather, scatter, dynamic slices and sort by flat positions, constant where the indices are."""

from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np
from jax.extend import core

from dln_jax.export.c.nodes import VECTOR, Node, is_constant, values
from dln_jax.export.c.primitives import Rule, convert, rows_of
from dln_jax.export.c.program import Program
from dln_jax.export.c.text import UNSIGNED, limit

_COMBINED = ("add", "sub", "mul", "min", "max")


def _gather(
    program: Program, operand: Node, indices: Node, *, dimension_numbers: Any, slice_sizes, mode: Any, fill_value: Any
) -> Node:
    """Applies `lax.gather`; windows that reach outside the operand are moved inside or filled."""
    numbers = dimension_numbers
    rank = len(indices.shape) - 1 + len(numbers.offset_dims)
    outer = [axis for axis in range(rank) if axis not in numbers.offset_dims]
    positions, inside = _windows(
        program, indices, operand.shape, slice_sizes, mode, numbers.start_index_map,
        dropped=(*numbers.collapsed_slice_dims, *numbers.operand_batching_dims),
        batched=(numbers.operand_batching_dims, numbers.start_indices_batching_dims),
        order=np.argsort([*outer, *numbers.offset_dims]),
    )  # fmt: skip
    taken = take(program, operand, positions)
    if inside is None:
        return taken
    if fill_value is None:  # JAX's default
        fill_value = (
            np.nan if operand.dtype == "real" else limit(operand.dtype, upper=operand.dtype in ("bool", *UNSIGNED))
        )
    return program.select(inside, program.constant(fill_value, operand.dtype), taken)


def _scatter(op: str) -> Rule:
    """Returns the rule of `lax.scatter`, or of its variant that combines updates."""

    def rule(
        program: Program, operand: Node, indices: Node, updates: Node, *,
        dimension_numbers: Any, mode: Any, update_jaxpr: Any, update_consts,
    ) -> Node:  # fmt: skip
        numbers = dimension_numbers
        dropped = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        window = iter([updates.shape[axis] for axis in numbers.update_window_dims])
        sizes = [1 if axis in dropped else next(window) for axis in range(len(operand.shape))]
        targets, inside = _windows(
            program, indices, operand.shape, sizes, mode, numbers.scatter_dims_to_operand_dims,
            dropped=dropped, batched=(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims),
            order=np.arange(len(updates.shape)),
        )  # fmt: skip
        if inside is not None:
            targets = program.select(inside, program.constant(-1, "index"), targets)
        outer = [axis for axis in range(len(updates.shape)) if axis not in numbers.update_window_dims]
        order = np.arange(updates.size).reshape(updates.shape).transpose([*outer, *numbers.update_window_dims])
        updates = program.gather([updates], order)
        if op == "set" and update_jaxpr is not None:  # of `x.at[i].apply(f)`
            return _updated(program, update_jaxpr, update_consts, operand, targets, updates)
        return _put(program, op, operand, targets, updates)

    return rule


def _windows(
    program: Program, indices: Node, shape, sizes, mode: Any, axes, *, dropped, batched, order
) -> tuple[Node, Node | None]:
    """Returns the flat positions of windows and, if windows outside are dropped, which positions are inside.

    Args:
        program: program in which they are computed.
        indices: corners of the windows [batch, axes].
        sizes: size of a window along each axis of the operand.
        mode: mode of `lax.gather` or `lax.scatter`, for windows outside.
        axes: axes of the operand that the indices refer to.
        dropped: axes of the operand that a window lacks.
        batched: corresponding axes of the operand and of the indices.
        order: order of the result's axes, among those of the batch followed by those of a window.
    """
    batch, index = indices.shape[:-1], np.arange(indices.size).reshape(indices.shape)
    flat = np.zeros(batch, np.int64)
    for axis, of_indices in zip(*batched, strict=True):
        flat = flat + np.indices(batch)[of_indices] * _stride(shape, axis)
    starts = {axis: program.gather([indices], index[..., component]) for component, axis in enumerate(axes)}
    corners, inside = _corners(program, starts, shape, sizes, flat, fills="FILL" in str(mode).upper())
    kept = [axis for axis in range(len(shape)) if axis not in dropped]
    window = [sizes[axis] for axis in kept]

    def placed(array: np.ndarray) -> np.ndarray:
        return np.broadcast_to(array, (*batch, *window)).transpose(order)

    windows = np.arange(prod(batch)).reshape((*batch, *[1] * len(window)))
    positions = program.elementwise(
        "add",
        program.gather([corners], placed(windows)),
        program.constant(placed(_offsets(shape, kept, window)), "index"),
    )
    return positions, None if inside is None else program.gather([inside], placed(windows))


def _corners(program: Program, starts: dict[int, Node], shape, sizes, first, *, fills=False) -> tuple[Node, Any]:
    """Returns the flat positions of windows' corners, clamped into the operand; with `fills`, also which were inside.

    `starts` are the corner indices by axis of the operand; they are added to the flat positions `first`.
    """
    flat, inside = program.constant(first, "index"), None
    for axis, start in starts.items():
        last = shape[axis] - sizes[axis]
        start = _index(program, start, last + fills)
        if fills:
            within = program.elementwise(
                "and", program.elementwise("ge", start, 0), program.elementwise("le", start, last)
            )
            inside = within if inside is None else program.elementwise("and", inside, within)
        clamped = program.elementwise("min", program.elementwise("max", start, 0), last)
        flat = program.elementwise("add", flat, program.elementwise("mul", clamped, _stride(shape, axis)))
    if inside is not None and is_constant(inside) and values(inside).all():
        inside = None
    return flat, inside


def take(program: Program, operand: Node, positions: Node) -> Node:
    """Returns the elements of the flat operand at positions, which must be inside."""
    if is_constant(positions):
        return program.gather([operand], values(positions))
    if positions.size < VECTOR and positions.shape:
        taken = [take(program, operand, position) for position in program.scalars(positions)]
        return program.gather(taken, np.arange(len(taken)).reshape(positions.shape))
    return program.make("take", positions.shape, operand.dtype, [operand, positions])


def _put(program: Program, op: str, operand: Node, targets: Node, updates: Node) -> Node:
    """Returns the operand with updates set at, or combined with, flat targets; negative targets are dropped."""
    if not is_constant(targets):
        return program.make(f"put_{op}", operand.shape, operand.dtype, [operand, targets, updates])
    flat, index = values(targets).ravel(), np.arange(operand.size)
    left = np.flatnonzero(flat >= 0)
    if op == "set":
        index[flat[left]] = operand.size + left
        return program.gather([operand, updates], index.reshape(operand.shape))
    while left.size:  # a pass handles one update per target
        _, first = np.unique(flat[left], return_index=True)
        now = left[first]
        combined = program.elementwise(op, program.gather([operand], flat[now]), program.gather([updates], now))
        index = np.arange(operand.size)
        index[flat[now]] = operand.size + np.arange(now.size)
        operand = program.gather([operand, combined], index.reshape(operand.shape))
        left = np.delete(left, first)
    return operand


def _updated(program: Program, jaxpr: Any, constants, operand: Node, targets: Node, updates: Node) -> Node:
    """Returns the operand after `jaxpr` of an element and an update, at one target after the other."""
    closed = core.ClosedJaxpr(jaxpr, constants)
    for place in range(targets.size):
        target, update = (program.gather([node], np.array([place])) for node in (targets, updates))
        old = take(program, operand, program.elementwise("max", target, 0))
        (new,) = program.inline(program, closed, [program.one(old), program.one(update)])
        operand = _put(program, "set", operand, target, program.reshape(new, (1,)))
    return operand


def _dynamic_slice(program: Program, operand: Node, *starts: Node, slice_sizes) -> Node:
    return take(program, operand, _window(program, operand.shape, slice_sizes, starts[: len(slice_sizes)]))


def _dynamic_update_slice(program: Program, operand: Node, update: Node, *starts: Node) -> Node:
    return _put(program, "set", operand, _window(program, operand.shape, update.shape, starts), update)


def _sort(program: Program, *nodes: Node, dimension: int, num_keys: int) -> list[Node]:
    """Applies `lax.sort` along an axis with the first `num_keys` arrays as keys: stable, NaN last."""
    axis, shape = dimension, nodes[0].shape
    if shape[axis] < 2:
        return list(nodes)
    rows = [rows_of(program, node, (axis,)) for node in nodes]
    order = program.make("order", rows[0].shape, "index", rows[:num_keys])
    last = np.moveaxis(np.empty(shape), axis, -1).shape
    back = np.moveaxis(np.arange(nodes[0].size).reshape(last), -1, axis)
    return [program.gather([take(program, row, order)], back) for row in rows]


def _window(program: Program, shape, sizes, starts: Sequence[Node]) -> Node:
    """Returns the flat positions of a window whose corner is clamped into the operand."""
    corner, _ = _corners(program, dict(enumerate(starts)), shape, sizes, 0)
    return program.elementwise("add", corner, program.constant(_offsets(shape, range(len(shape)), sizes), "index"))


def _index(program: Program, start: Node, upper: int) -> Node:
    """Returns an index; unsigned 64-bit indices are clamped before conversion, because an index cannot hold them."""
    if start.dtype == "unsigned_long":
        start = program.elementwise("min", start, max(upper, 0))
    return convert(program, start, "index")


def _stride(shape, axis: int | np.integer) -> int:
    return int(np.prod(shape[axis + 1 :], dtype=np.int64))


def _offsets(shape, axes, sizes) -> np.ndarray:
    """Returns the flat offsets [sizes] of a window along these axes."""
    steps = [np.arange(size) * _stride(shape, axis) for axis, size in zip(axes, sizes, strict=True)]
    return np.asarray(sum(np.ix_(*steps), np.zeros([1] * len(steps), np.int64)))


RULES = {
    "gather": _gather,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "sort": _sort,
    "scatter": _scatter("set"),
    **{f"scatter-{op}": _scatter(op) for op in _COMBINED},
}
"""Rules by name of the primitive."""
