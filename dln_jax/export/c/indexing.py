"""Rules for gather, scatter, dynamic slices and sort by flat positions (constant for constant indices)."""

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
    """Applies `lax.gather`; windows that extend outside the operand are moved inside or filled."""
    numbers = dimension_numbers
    rank = len(indices.shape) - 1 + len(numbers.offset_dims)
    outer = [axis for axis in range(rank) if axis not in numbers.offset_dims]
    positions, inside = _windows(
        program, indices, operand.shape, slice_sizes, mode, numbers.start_index_map,
        dropped=(*numbers.collapsed_slice_dims, *numbers.operand_batching_dims),
        batched=(numbers.operand_batching_dims, numbers.start_indices_batching_dims),
    )  # fmt: skip
    if fill_value is None:  # JAX's default
        fill_value = (
            np.nan if operand.dtype == "real" else limit(operand.dtype, upper=operand.dtype in ("bool", *UNSIGNED))
        )
    taken = take(program, operand, positions)
    result = program.elementwise("select", inside, taken, program.constant(fill_value, operand.dtype))
    order = np.argsort([*outer, *numbers.offset_dims])
    return program.gather([result], np.arange(result.size).reshape(result.shape).transpose(order))


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
        )  # fmt: skip
        targets = program.elementwise("select", inside, targets, program.constant(-1, "index"))
        outer = [axis for axis in range(len(updates.shape)) if axis not in numbers.update_window_dims]
        order = np.arange(updates.size).reshape(updates.shape).transpose([*outer, *numbers.update_window_dims])
        updates = program.gather([updates], order)
        if op == "set" and update_jaxpr is not None:  # of `x.at[i].apply(f)`
            return _updated(program, core.ClosedJaxpr(update_jaxpr, update_consts), operand, targets, updates)
        return _put(program, op, operand, targets, updates)

    return rule


def _windows(
    program: Program, indices: Node, shape, sizes, mode: Any, axes, *, dropped=(), batched=((), ())
) -> tuple[Node, Node]:
    """Returns the flat positions of windows, clamped into the operand, and a mask of windows to keep if others are
    dropped.

    Args:
        program: program for the computation.
        indices: corners of the windows [batch, axes].
        shape: shape of the operand.
        sizes: size of a window along each axis of the operand.
        mode: mode of `lax.gather` or `lax.scatter`, for windows outside.
        axes: indexed axes of the operand.
        dropped: axes of the operand without a window axis.
        batched: corresponding axes of the operand and of the indices.
    """
    batch, fills = indices.shape[:-1], "FILL" in str(mode).upper()
    index, steps = np.arange(indices.size).reshape(indices.shape), [prod(shape[k + 1 :]) for k in range(len(shape))]
    first = np.zeros(batch, np.int64)
    for axis, of_indices in zip(*batched, strict=True):
        first = first + np.indices(batch)[of_indices] * steps[axis]
    corners, inside = program.constant(first, "index"), program.constant(np.ones(batch), "bool")
    for component, axis in enumerate(axes):
        start, last = program.gather([indices], index[..., component]), shape[axis] - sizes[axis]
        if start.dtype == "unsigned_long":  # an index may not hold it
            start = program.elementwise("min", start, max(last + fills, 0))
        start = convert(program, start, "index")
        if fills:
            for comparison, bound in (("ge", 0), ("le", last)):
                inside = program.elementwise("and", inside, program.elementwise(comparison, start, bound))
        clamped = program.elementwise("min", program.elementwise("max", start, 0), last)
        corners = program.elementwise("add", corners, program.elementwise("mul", clamped, steps[axis]))
    offsets = np.arange(prod(shape)).reshape(shape)[tuple(map(slice, sizes))].squeeze(tuple(dropped))
    shape = (*batch, *offsets.shape)
    windows = np.broadcast_to(np.arange(prod(batch)).reshape((*batch, *[1] * offsets.ndim)), shape)
    within = program.constant(np.broadcast_to(offsets, shape), "index")
    return program.elementwise("add", program.gather([corners], windows), within), program.gather([inside], windows)


def take(program: Program, operand: Node, positions: Node) -> Node:
    """Returns the elements of the flat operand at positions, which must be inside."""
    if is_constant(positions):
        return program.gather([operand], values(positions))
    if positions.size < VECTOR and positions.shape:
        taken = [take(program, operand, position) for position in program.scalars(positions)]
        return program.gather(taken, np.arange(len(taken)).reshape(positions.shape))
    return program.make("take", positions.shape, operand.dtype, [operand, positions])


def _put(program: Program, op: str, operand: Node, targets: Node, updates: Node) -> Node:
    """Returns the operand with updates at flat targets, set or combined; negative targets are dropped."""
    if not is_constant(targets):
        return program.make(f"put_{op}", operand.shape, operand.dtype, [operand, targets, updates])
    flat = values(targets).ravel()
    left = np.flatnonzero(flat >= 0)
    while left.size:  # a pass handles one update per target
        _, first = np.unique(flat[left], return_index=True)
        now = left[first]
        new = program.gather([updates], now)
        if op != "set":
            new = program.elementwise(op, program.gather([operand], flat[now]), new)
        index = np.arange(operand.size)
        index[flat[now]] = operand.size + np.arange(now.size)
        operand = program.gather([operand, new], index.reshape(operand.shape))
        left = np.delete(left, first)
    return operand


def _updated(program: Program, closed: Any, operand: Node, targets: Node, updates: Node) -> Node:
    """Returns the operand after applying a jaxpr of element and update at each target in turn."""
    for target, update in zip(program.scalars(targets), program.scalars(updates), strict=True):
        old = take(program, operand, program.elementwise("max", target, 0))
        (new,) = program.inline(program, closed, [old, update])
        operand = _put(program, "set", operand, target, new)
    return operand


def _dynamic_slice(program: Program, operand: Node, *starts: Node, slice_sizes) -> Node:
    return take(program, operand, _window(program, operand, slice_sizes, starts))


def _dynamic_update_slice(program: Program, operand: Node, update: Node, *starts: Node) -> Node:
    return _put(program, "set", operand, _window(program, operand, update.shape, starts), update)


def _window(program: Program, operand: Node, sizes, starts: Sequence[Node]) -> Node:
    """Returns the flat positions of one window with these corner indices."""
    corner = program.gather(starts or [program.constant(0, "int")], np.arange(len(starts)))
    return _windows(program, corner, operand.shape, sizes, None, range(len(starts)))[0]


def _sort(program: Program, *nodes: Node, dimension: int, num_keys: int) -> list[Node]:
    """Applies `lax.sort` along an axis with the first `num_keys` arrays as keys: stable, NaN last."""
    axis, shape = dimension, nodes[0].shape
    if shape[axis] < 2:
        return list(nodes)
    rows = [rows_of(program, node, (axis,)) for node in nodes]
    *others, last_key = rows[:num_keys]
    order = program.make("order", last_key.shape, "index", [last_key])
    for key in reversed(others):  # the sort is stable, so the first key comes last
        order = take(program, order, program.make("order", key.shape, "index", [take(program, key, order)]))
    last = np.moveaxis(np.empty(shape), axis, -1).shape
    back = np.moveaxis(np.arange(nodes[0].size).reshape(last), -1, axis)
    return [program.gather([take(program, row, order)], back) for row in rows]


RULES = {
    "gather": _gather,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "sort": _sort,
    "scatter": _scatter("set"),
    **{f"scatter-{op}": _scatter(op) for op in _COMBINED},
}
"""Rules by name of the primitive."""
