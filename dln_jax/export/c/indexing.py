"""Rules for gather, scatter, dynamic slices and sort, by flat positions, which are constants if the indices are."""

from typing import Any

import numpy as np

from dln_jax.export.c.kinds import NUMPY_TYPES, UNSIGNED
from dln_jax.export.c.nodes import Node, is_constant, values
from dln_jax.export.c.primitives import convert
from dln_jax.export.c.program import Program
from dln_jax.export.c.reductions import rows_of

_ELEMENTWISE = {f"put_{name}": name for name in ("add", "sub", "mul", "min", "max")}
_UPDATES = {"scatter": "put_set", **{f"scatter-{name}": op for op, name in _ELEMENTWISE.items()}}


def _gather(program: Program, parameters: dict[str, Any], operand: Node, indices: Node) -> Node:
    """Applies `lax.gather`; windows that reach outside the operand are moved inside, or filled."""
    numbers, sizes = parameters["dimension_numbers"], parameters["slice_sizes"]
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    window = [size for axis, size in enumerate(sizes) if axis not in dropped]
    batch = indices.shape[:-1]
    start, inside = _starts(
        program, indices, operand.shape, sizes, numbers.start_index_map, parameters["mode"],
        tuple(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)),
    )  # fmt: skip
    kept = [axis for axis in range(len(operand.shape)) if axis not in dropped]
    offsets = _offsets(operand.shape, kept, window)
    rank = len(batch) + len(window)
    places = [axis for axis in range(rank) if axis not in numbers.offset_dims] + list(numbers.offset_dims)
    order = np.argsort(places)

    def placed(array: np.ndarray) -> np.ndarray:
        return np.broadcast_to(array, (*batch, *window)).transpose(order)

    windows = np.arange(int(np.prod(batch, dtype=int))).reshape((*batch, *[1] * len(window)))
    positions = program.elementwise(
        "add", program.gather([start], placed(windows)), program.constant(placed(offsets), "index")
    )
    taken = take(program, operand, positions)
    if inside is None:
        return taken
    fill = parameters["fill_value"]
    fill = _filled(operand.dtype) if fill is None else fill
    return program.select(program.gather([inside], placed(windows)), program.constant(fill, operand.dtype), taken)


def _filled(kind: str) -> Any:
    """Returns JAX's default fill value for positions outside the operand."""
    if kind in ("real", "bool"):
        return np.nan if kind == "real" else True
    limits = np.iinfo(NUMPY_TYPES[kind])
    return limits.max if kind in UNSIGNED else limits.min


def _scatter(name: str):
    """Returns the rule of `lax.scatter`, or of its variant that combines updates."""

    def rule(program: Program, parameters: dict[str, Any], operand: Node, indices: Node, updates: Node) -> Node:
        numbers = parameters["dimension_numbers"]
        dropped = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        kept = [axis for axis in range(len(operand.shape)) if axis not in dropped]
        window = [updates.shape[axis] for axis in numbers.update_window_dims]
        sizes = [1] * len(operand.shape)
        for axis, size in zip(kept, window, strict=True):
            sizes[axis] = size
        start, inside = _starts(
            program, indices, operand.shape, sizes, numbers.scatter_dims_to_operand_dims, parameters["mode"],
            tuple(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True)),
        )  # fmt: skip
        outer = [axis for axis in range(len(updates.shape)) if axis not in numbers.update_window_dims]
        order = np.arange(updates.size).reshape(updates.shape).transpose([*outer, *numbers.update_window_dims])
        windows = np.arange(start.size).reshape((*start.shape, *[1] * len(window)))
        shape = order.shape
        offsets = program.constant(np.broadcast_to(_offsets(operand.shape, kept, window), shape), "index")
        targets = program.elementwise("add", program.gather([start], np.broadcast_to(windows, shape)), offsets)
        if inside is not None:
            minus = program.constant(-1, "index")
            targets = program.select(program.gather([inside], np.broadcast_to(windows, shape)), minus, targets)
        return _put(program, _UPDATES[name], operand, targets, program.gather([updates], order))

    return rule


def take(program: Program, operand: Node, positions: Node) -> Node:
    """Returns the elements of the flat operand at positions, which must be inside."""
    if is_constant(positions):
        return program.gather([operand], values(positions))
    return program.make("take", positions.shape, operand.dtype, [operand, positions])


def _put(program: Program, op: str, operand: Node, targets: Node, updates: Node) -> Node:
    """Returns the operand with updates at flat targets; negative targets are dropped."""
    if not is_constant(targets):
        return program.make(op, operand.shape, operand.dtype, [operand, targets, updates])
    flat, index = values(targets).ravel(), np.arange(operand.size)
    if op == "put_set":
        index[flat[flat >= 0]] = operand.size + np.flatnonzero(flat >= 0)
        return program.gather([operand, updates], index.reshape(operand.shape))
    left = np.flatnonzero(flat >= 0)
    while left.size:  # a pass handles one update of every target
        _, first = np.unique(flat[left], return_index=True)
        now = left[first]
        combined = program.elementwise(
            _ELEMENTWISE[op], program.gather([operand], flat[now]), program.gather([updates], now)
        )
        index = np.arange(operand.size)
        index[flat[now]] = operand.size + np.arange(now.size)
        operand = program.gather([operand, combined], index.reshape(operand.shape))
        left = np.delete(left, first)
    return operand


def _dynamic_slice(program: Program, parameters: dict[str, Any], operand: Node, *starts: Node) -> Node:
    """Applies `lax.dynamic_slice`."""
    sizes = parameters["slice_sizes"]
    positions = _window(program, operand.shape, sizes, starts[: len(sizes)])
    return take(program, operand, positions)


def _dynamic_update_slice(program: Program, _, operand: Node, update: Node, *starts: Node) -> Node:
    """Applies `lax.dynamic_update_slice`."""
    return _put(program, "put_set", operand, _window(program, operand.shape, update.shape, starts), update)


def _sort(program: Program, parameters: dict[str, Any], *nodes: Node) -> list[Node]:
    """Applies `lax.sort` along an axis by the first `num_keys` arrays: stable, NaN last."""
    axis, shape = parameters["dimension"], nodes[0].shape
    if shape[axis] < 2 or nodes[0].size == 0:
        return list(nodes)
    rows = [rows_of(program, node, (axis,)) for node in nodes]
    order = program.make("order", rows[0].shape, "index", rows[: parameters["num_keys"]])
    last = np.moveaxis(np.empty(shape), axis, -1).shape
    back = np.moveaxis(np.arange(nodes[0].size).reshape(last), -1, axis)
    return [program.gather([take(program, row, order)], back) for row in rows]


def _window(program: Program, shape, sizes, starts) -> Node:
    """Returns the flat positions of a window whose corner is clamped into the operand."""
    flat = program.constant(0, "index")
    for axis, start in enumerate(starts):
        flat = _plus(program, flat, _clamped(program, start, shape[axis] - sizes[axis]), _stride(shape, axis))
    offsets = program.constant(_offsets(shape, range(len(shape)), sizes), "index")
    return program.elementwise("add", flat, offsets)


def _starts(program: Program, indices: Node, shape, sizes, axes, mode, batched) -> tuple[Node, Node | None]:
    """Returns the flat positions of the windows' corners; if windows outside are dropped, also which are inside."""
    batch = indices.shape[:-1]
    index = np.arange(indices.size).reshape(indices.shape)
    flat = program.constant(np.zeros(batch, np.int64), "index")
    for axis, of_indices in batched:
        counted = np.arange(batch[of_indices]).reshape(
            [-1 if dimension == of_indices else 1 for dimension in range(len(batch))]
        )
        corner = np.broadcast_to(counted, batch) * _stride(shape, axis)
        flat = program.elementwise("add", flat, program.constant(corner, "index"))
    fills, inside = "FILL" in str(mode).upper(), None
    for component, axis in enumerate(axes):
        start, last = program.gather([indices], index[..., component]), shape[axis] - sizes[axis]
        if fills:
            start = _index(program, start, last + 1)
            within = program.elementwise(
                "and",
                program.elementwise("ge", start, program.constant(0, "index")),
                program.elementwise("le", start, program.constant(last, "index")),
            )
            inside = within if inside is None else program.elementwise("and", inside, within)
        flat = _plus(program, flat, _clamped(program, start, last), _stride(shape, axis))
    if inside is not None and is_constant(inside) and values(inside).all():
        inside = None
    return flat, inside


def _clamped(program: Program, start: Node, last: int) -> Node:
    low, high = program.constant(0, "index"), program.constant(last, "index")
    return program.elementwise("min", program.elementwise("max", _index(program, start, last), low), high)


def _index(program: Program, start: Node, upper: int) -> Node:
    """Returns an index, clamped before the conversion if it is unsigned with 64 bits, which an index cannot hold."""
    if start.dtype == "unsigned_long":
        start = program.elementwise("min", start, program.constant(max(upper, 0), start.dtype))
    return convert(program, start, "index")


def _plus(program: Program, flat: Node, start: Node, stride: int) -> Node:
    return program.elementwise("add", flat, program.elementwise("mul", start, program.constant(stride, "index")))


def _stride(shape, axis: int | np.integer) -> int:
    return int(np.prod(shape[axis + 1 :], dtype=np.int64))


def _offsets(shape, axes, sizes) -> np.ndarray:
    """Returns the flat offsets [sizes] of a window along these axes."""
    offsets = np.zeros([1] * len(sizes), np.int64)
    for place, (axis, size) in enumerate(zip(axes, sizes, strict=True)):
        steps = np.arange(size) * _stride(shape, axis)
        offsets = offsets + steps.reshape([-1 if other == place else 1 for other in range(len(sizes))])
    return offsets


RULES = {
    "gather": _gather,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "sort": _sort,
    **{name: _scatter(name) for name in _UPDATES},
}
"""Rules by the name of the primitive."""
