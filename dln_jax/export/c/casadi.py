"""Exports JAX functions with exact derivatives as C for CasADi's `external`, and hence for acados.

CasADi (3.6 and later) takes the derivatives of a function f from these symbols of the same library:

| symbol | inputs | outputs |
|---|---|---|
| `f` | x | y |
| `jac_f` | x, y | dy_j/dx_i for all i, then the next j |
| `fwd1_f` | x, y, seeds of x | (dy/dx) seeds |
| `adj1_f` | x, y, seeds of y | (dy/dx)ᵀ seeds |
| `jac_adj1_f` | x, y, seeds of y, outputs of `adj1_f` | derivatives of these outputs with respect to all inputs |

Outputs among the inputs, and derivatives with respect to them, are declared without elements. All other matrices are
dense and column-major; vectors are n x 1. A null pointer stands for an input of zeros or an unwanted output.

The C loops over the directions of derivatives. Unrolled, it would be at most a third faster at two and four degrees of
freedom, but the Hessian of forward dynamics would compile in 18 s instead of 2 s at four, and at seven it would exceed
the stack sevenfold.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise, takewhile
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from dln_jax.export.c.body import Body, Source
from dln_jax.export.c.emit import body_of
from dln_jax.export.c.interface import Leaf, argument_leaves, result_leaves
from dln_jax.export.c.lowering import program_of, traced
from dln_jax.export.c.templates import CASADI_DECLARATIONS, CASADI_FUNCTION, stated
from dln_jax.types import InputError

Function = Callable[[Array], Array]


class Block(NamedTuple):
    """An input or output: a dense matrix, or one declared without elements."""

    name: str
    rows: int
    columns: int
    dense: bool = True

    @property
    def size(self) -> int:
        """Number of elements."""
        return self.rows * self.columns if self.dense else 0


def external_functions(
    name: str, functions: Mapping[str, Any], source: Source, *, stack: int, leave_out: bool = False
) -> tuple[Source, str, list[str]]:
    """Returns the source of tables, the C of `casadi_NAME_F` and its derivatives for every F, and reasons for refusals.

    Args:
        functions: as for `export_c`.
        source: an empty source in double precision.
        stack: bytes of stack that a function may use.
        leave_out: omit functions that CasADi cannot take, and return the reasons.

    Raises:
        InputError: CasADi cannot take a function: its arrays are not real or have more than two axes, a name is
            reserved, it has no arguments or derivatives, or it needs more stack.
    """
    text, largest, left_out = "", 1, []
    for key, (function, examples) in functions.items():
        symbol = f"casadi_{name}_{key}"
        try:
            inputs, outputs, flat = _flat(symbol, function, examples)
            written, kept = "", source
            for prefix, blocks, results, ways in _derivatives(inputs, outputs, flat):
                kept, more = _function(kept, prefix + symbol, blocks, results, ways, stack)
                written += more
                largest = max(largest, *(block.size for block in blocks))
        except InputError as error:
            if not leave_out:
                raise
            left_out.append(str(error))
            continue
        source, text = kept, text + written
    return source, f"{CASADI_DECLARATIONS}\nstatic const casadi_real zeros[{largest}] = {{0}};\n{text}", left_out


def _flat(
    symbol: str, function: Callable[..., Any], examples: Sequence[Any]
) -> tuple[list[Block], list[Block], Function]:
    """Returns inputs, outputs, and the function from all inputs to all outputs as column-major vectors."""
    leaves, tree = jax.tree.flatten(tuple(examples))
    shapes = [np.shape(leaf) for leaf in leaves]
    try:
        arguments = argument_leaves(function, examples)
        inputs = [_block(leaf) for leaf in arguments]
        if not inputs:
            raise InputError("there are no arguments to differentiate with respect to; export it without casadi")
        outputs = [_block(leaf) for leaf in result_leaves(jax.eval_shape(function, *examples), arguments)]
        names = [prefix + block.name for prefix in ("", "out_", "adj_", "fwd_") for block in [*inputs, *outputs]]
        for name in (symbol, *names):
            if re.search("__|_$", name) or name in ("null", "jac", "hess") or names.count(name) > 1:
                raise InputError(f"CasADi has no such name as {name}, or derivatives have it too; choose another")
    except InputError as error:
        raise InputError(f"{symbol}: {error}") from error
    cuts = np.cumsum([block.size for block in inputs])[:-1]

    def flat(x: Array) -> Array:
        # Column-major order of a matrix is row-major order of its transpose.
        arguments = [part.reshape(shape[::-1]).T for part, shape in zip(jnp.split(x, cuts), shapes, strict=True)]
        results = jax.tree.leaves(function(*jax.tree.unflatten(tree, arguments)))
        return jnp.concatenate([jnp.ravel(jnp.asarray(result).T).astype(x.dtype) for result in results])

    return inputs, outputs, flat


def _block(leaf: Leaf) -> Block:
    if leaf.kind != "real" or len(leaf.shape) > 2 or 0 in leaf.shape:
        raise InputError(
            f"{leaf.name} is {leaf.kind} of shape {list(leaf.shape)}; CasADi takes real numbers of at most two axes, "
            "none of them empty, so export it without casadi"
        )
    rows, columns = (*leaf.shape, 1, 1)[:2]
    return Block(leaf.name, rows, columns)


def _forward(function: Function, x: Array) -> Array:
    """Returns the transposed Jacobian [n, m] of a function from x [n] to y [m], one input at a time."""
    return lax.map(lambda k: _push(function, x, _unit(k, x)), jnp.arange(x.size))


def _reverse(function: Function, x: Array) -> Array:
    """Returns the transposed Jacobian [n, m], one output at a time."""
    value, pulled = jax.vjp(function, x)
    return lax.map(lambda k: pulled(_unit(k, value))[0], jnp.arange(value.size)).T


def _unit(k: Array, like: Array) -> Array:
    # A comparison, because rows of an identity matrix would be stored in an array.
    return (jnp.arange(like.size) == k).astype(like.dtype)


def _push(function: Function, x: Array, seeds: Array) -> Array:
    """Returns (dy/dx) seeds [m]."""
    return jax.jvp(function, (x,), (seeds,))[1]


def _pull(function: Function, x: Array, seeds: Array) -> Array:
    """Returns (dy/dx)ᵀ seeds [n] in reverse mode."""
    return jax.vjp(function, x)[1](seeds)[0]


def _pull_forward(function: Function, x: Array, seeds: Array) -> Array:
    """Returns (dy/dx)ᵀ seeds [n] in forward mode, which also differentiates loops of unknown length."""
    return _forward(function, x) @ seeds


def _derivatives(inputs: list[Block], outputs: list[Block], flat: Any) -> Iterable[tuple[str, Any, Any, Any]]:
    """Yields prefix, inputs and outputs of every derivative, and functions that compute it, cheapest first."""
    x_parts, y_parts = (
        [slice(*ends) for ends in pairwise([0, *accumulate(block.size for block in blocks)])]
        for blocks in (inputs, outputs)
    )

    # Rows of the transposed Jacobian are columns of the Jacobian, which CasADi stores one after the other.
    def slopes(way: Any, x: Array, _: Any) -> Array:
        transposed = way(flat, x)
        return jnp.concatenate([transposed[i, j].ravel() for j in y_parts for i in x_parts])

    def curvature(pull: Any, x: Array, seeds: Array) -> Array:
        both = _forward(lambda x: jnp.concatenate([pull(flat, x, seeds), flat(x)]), x)
        hessian, transposed = both[:, : x.size], both[:, x.size :]
        blocks = [[*(hessian[k, i] for k in x_parts), *(transposed[i, j].T for j in y_parts)] for i in x_parts]
        return jnp.concatenate([block.ravel() for row in blocks for block in row])

    def of(prefix: str, blocks: list[Block]) -> list[Block]:
        return [block._replace(name=f"{prefix}_{block.name}", dense=prefix != "out") for block in blocks]

    def jacobians(results: list[Block], variables: list[Block]) -> list[Block]:
        return [
            Block(f"jac_{result.name}_{variable.name}", result.size, variable.rows * variable.columns, variable.dense)
            for result in results
            for variable in variables
        ]

    both, adjoints = [*inputs, *of("out", outputs)], of("adj", inputs)
    seeded, pulls = [*both, *of("adj", outputs)], (_pull, _pull_forward)
    more_inputs = sum(block.size for block in inputs) > sum(block.size for block in outputs)
    directions = (_forward, _reverse)[:: -1 if more_inputs else 1]
    yield "", inputs, outputs, [lambda x, _: flat(x)]
    yield "jac_", both, jacobians(outputs, inputs), [partial(slopes, way) for way in directions]
    yield "fwd1_", [*both, *of("fwd", inputs)], of("fwd", outputs), [partial(_push, flat)]
    yield "adj1_", seeded, adjoints, [partial(pull, flat) for pull in pulls]
    with_adjoints = [*seeded, *of("out", adjoints)]
    yield "jac_adj1_", with_adjoints, jacobians(adjoints, seeded), [partial(curvature, pull) for pull in pulls]


def _function(
    source: Source, symbol: str, inputs: list[Block], outputs: list[Block], ways: Sequence[Any], stack: int
) -> tuple[Source, str]:
    """Returns the source and the C text from the first method that can be compiled."""
    failure: Exception | None = None
    for way in ways:
        try:
            body = _body(source.copy(), inputs, outputs, way)
        except (TypeError, ValueError, NotImplementedError) as error:  # JAX cannot differentiate it, or it has no C
            failure = error
            continue
        if body.stack <= stack:
            blocks = [*inputs, *outputs]
            return body.source, CASADI_FUNCTION.format(
                symbol=symbol,
                names=", ".join(f'"{block.name}"' for block in blocks),
                length=3 + max(0 if block.dense else block.columns for block in blocks),
                sparsities=", ".join(f"{{{block.rows}, {block.columns}, {int(block.dense)}}}" for block in blocks),
                cost=stated(body.cost), inputs=len(inputs), outputs=len(outputs),
                lines="\n".join(body.lines),
            )  # fmt: skip
        kib = body.stack / 1024
        failure = InputError(f"it would take {kib:.0f} KiB of stack; generated C suits up to {stack // 1024} KiB")
    reason = str(failure).strip().partition("\n")[0]
    raise InputError(f"{symbol}: {reason}; export it without casadi") from failure


def _body(source: Source, inputs: list[Block], outputs: list[Block], way: Callable[..., Array]) -> Body:
    cuts = np.cumsum([output.size for output in outputs if output.dense])[:-1]
    dense = [k for k, block in enumerate(inputs) if block.dense]
    n = sum(block.size for block in takewhile(lambda block: block.dense, inputs))

    def evaluate(*columns: Array) -> list[Array]:
        x, seeds = jnp.split(jnp.concatenate(columns), [n])
        return jnp.split(way(x, seeds), cuts)

    closed, _ = traced(evaluate, [np.zeros(inputs[k].size) for k in dense])
    program, arguments, results = program_of(closed, finite=source.finite)
    names = {place: (f"in_{k}", False) for place, k in enumerate(dense)}
    targets = [f"res[{j}]" for j, output in enumerate(outputs) if output.dense]
    body = body_of(source, program, results, names, targets, optional=True)
    used = [k for k, node in zip(dense, arguments, strict=True) if node in body.plan.nodes]
    lines = [f"const casadi_real *in_{k} = arg[{k}] ? arg[{k}] : zeros;" for k in used]
    lines.append("(void)arg; (void)integers; (void)reals; (void)memory;")
    body.lines = [*(f"    {line}" for line in lines), *body.lines, "    return 0;"]
    return body
