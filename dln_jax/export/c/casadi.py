"""Exports JAX functions with exact derivatives as C for CasADi's `external`, and hence for acados.

CasADi (3.6 and later) reads the derivatives of a function f from these symbols of the same library:

| symbol | inputs | outputs |
|---|---|---|
| `f` | x | y |
| `jac_f` | x, y | dy_j/dx_i for all i, then the next j |
| `fwd1_f` | x, y, seeds of x | (dy/dx) seeds |
| `adj1_f` | x, y, seeds of y | (dy/dx)ᵀ seeds |
| `jac_adj1_f` | x, y, seeds of y, outputs of `adj1_f` | derivatives of these outputs with respect to all inputs |

Outputs among the inputs, and derivatives with respect to them, are declared without elements. All other matrices are
dense and column-major; vectors are n x 1. A null pointer stands for an input of zeros or an unwanted output.

The C code loops over the directions of derivatives. Unrolled code would be at most a third faster at two and four
degrees of freedom. But at four, the Hessian of forward dynamics would compile in 18 s instead of 2 s, and at seven it
would need seven times the stack.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise, takewhile
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from dln_jax.export.c.body import Source
from dln_jax.export.c.emit import body_of
from dln_jax.export.c.interface import Function, Leaf, signature_of
from dln_jax.export.c.lowering import program_of, traced
from dln_jax.export.c.templates import stated
from dln_jax.types import InputError

Flat = Callable[[Array], Array]
"""x -> y, vectors."""
Way = Callable[[Array, Array], list[Array]]
"""(x, seeds) -> the dense results of a symbol."""
_DECLARATIONS = """
typedef double casadi_real;
typedef long long int casadi_int;

#ifdef __cplusplus
#define EXPORTED extern "C"
#else
#define EXPORTED
#endif
/* CasADi's queries about a function. The function has no state that needs reference counts, and its workspace is on
   the stack. */
#define DESCRIBED(f, inputs, outputs) \\
    EXPORTED void f##_incref(void) {} \\
    EXPORTED void f##_decref(void) {} \\
    EXPORTED casadi_int f##_n_in(void) { return inputs; } \\
    EXPORTED casadi_int f##_n_out(void) { return outputs; } \\
    EXPORTED const char *f##_name_in(casadi_int i) { return f##_names[i]; } \\
    EXPORTED const char *f##_name_out(casadi_int i) { return f##_names[inputs + i]; } \\
    EXPORTED const casadi_int *f##_sparsity_in(casadi_int i) { return f##_sparsities[i]; } \\
    EXPORTED const casadi_int *f##_sparsity_out(casadi_int i) { return f##_sparsities[inputs + i]; } \\
    EXPORTED int f(const casadi_real **arg, casadi_real **res, casadi_int *integers, casadi_real *reals, int memory)
"""
_FUNCTION = """
/* {cost} */
static const char *const {symbol}_names[] = {{{names}}};
static const casadi_int {symbol}_sparsities[][{length}] = {{{sparsities}}};
DESCRIBED({symbol}, {inputs}, {outputs})
{{
{lines}
}}
"""
ABOUT = """{name}_casadi.c: functions of {name}.h with exact derivatives, for CasADi 3.6 and later.
{written_by}

cmake -B build && cmake --build build, then in Python, with the name of one of the functions for F:
F = casadi.external("casadi_{name}_F", "build/lib{name}.so")

acados loads the same library; its folder is model_external_shared_lib_dir, and its name, {name},
model_external_shared_lib_name among the solver's options."""
BUILD = """
# The library that CasADi and acados load
add_library({name}_casadi SHARED {name}.c {name}_casadi.c)
set_target_properties({name}_casadi PROPERTIES OUTPUT_NAME {name} ARCHIVE_OUTPUT_NAME {name}_casadi
  C_STANDARD 99 C_EXTENSIONS OFF WINDOWS_EXPORT_ALL_SYMBOLS ON)
if(UNIX)
  target_link_libraries({name}_casadi PRIVATE m)
endif()
"""


def external_functions(
    name: str, functions: Mapping[str, Any], source: Source, *, stack: int, leave_out: bool = False
) -> tuple[Source, str, list[str]]:
    """Returns the source with tables, the C text of `casadi_NAME_F` and its derivatives, and reasons for refusals.

    Args:
        functions: as for `export_c`.
        source: an empty source in double precision.
        stack: bytes of stack that a function may use.
        leave_out: omit functions that CasADi cannot use, and return the reasons.

    Raises:
        InputError: CasADi cannot use a function: its arrays are not real or have more than two axes, a name is
            reserved, it has no arguments or derivatives, or it needs more stack.
    """
    text, largest, left_out = "", 1, []
    for key, (function, examples) in functions.items():
        symbol = f"casadi_{name}_{key}"
        prefix = written = ""
        kept = source
        try:
            examples = jax.eval_shape(lambda *leaves: leaves, *examples)
            signature = signature_of(function, examples, jax.eval_shape(function, *examples))
            inputs, outputs = ([_matrix(leaf) for leaf in leaves] for leaves in signature[:2])
            if not inputs:
                raise InputError("the function has no arguments to differentiate by; export it without casadi")
            names = [start + leaf.name for start in ("", "out_", "adj_", "fwd_") for leaf in [*inputs, *outputs]]
            for word in (symbol, *names):
                if re.search("__|_$", word) or word in ("null", "jac", "hess") or names.count(word) > 1:
                    raise InputError(f"CasADi does not accept the name {word}, or a derivative uses it; choose another")
            symbols = _derivatives(inputs, outputs, _flat(function, examples))
            for prefix, (before, after, ways) in symbols.items():
                kept, more = _function(kept, prefix + symbol, before, after, ways, stack)
                written += more
                largest = max(largest, *(prod(leaf.shape) for leaf in before if leaf.kind))
        except InputError as error:
            reason = f"{prefix}{symbol}: {error}"
            if not leave_out:
                raise InputError(reason) from error
            left_out.append(f"Left out: {reason}")
            continue
        source, text = kept, text + written
    return source, f"{_DECLARATIONS}\nstatic const casadi_real zeros[{largest}] = {{0}};\n{text}", left_out


def _matrix(leaf: Leaf) -> Leaf:
    if leaf.kind != "real" or len(leaf.shape) > 2 or 0 in leaf.shape:
        raise InputError(
            f"{leaf.name} is {leaf.kind} of shape {list(leaf.shape)}; CasADi takes real arrays of at most two "
            "non-empty axes, so export it without casadi"
        )
    return leaf._replace(shape=(*leaf.shape, 1, 1)[:2])


def _flat(function: Function, examples: Sequence[Any]) -> Flat:
    """Returns the function from all inputs to all outputs, as concatenated column-major vectors."""
    leaves, tree = jax.tree.flatten(examples)
    # Column-major order of a matrix is row-major order of its transpose.
    _, parts_of = ravel_pytree([np.zeros(leaf.shape[::-1]) for leaf in leaves])

    def flat(x):
        results = jax.tree.leaves(function(*jax.tree.unflatten(tree, [part.T for part in parts_of(x)])))
        return jnp.concatenate([jnp.ravel(jnp.asarray(result).T).astype(x.dtype) for result in results])

    return flat


def _forward(function: Flat, x: Array) -> Array:
    """Returns the transposed Jacobian [n, m] of a function from x [n] to y [m], one input at a time."""

    def along(k):
        # A comparison avoids storing an identity matrix.
        return jax.jvp(function, (x,), ((jnp.arange(x.size) == k).astype(x.dtype),))[1]

    return lax.map(along, jnp.arange(x.size))


def _reverse(function: Flat, x: Array) -> Array:
    """Returns the transposed Jacobian [n, m], one output at a time."""
    value, pulled = jax.vjp(function, x)
    return _forward(lambda seeds: pulled(seeds)[0], jnp.zeros_like(value)).T


def _derivatives(
    inputs: list[Leaf], outputs: list[Leaf], flat: Flat
) -> dict[str, tuple[list[Leaf], list[Leaf], list[Way]]]:
    """Returns prefix -> inputs, outputs, and alternative functions for them, the cheapest first."""
    x_parts, y_parts = (
        [slice(*ends) for ends in pairwise(accumulate((prod(leaf.shape) for leaf in leaves), initial=0))]
        for leaves in (inputs, outputs)
    )

    def split(vector, parts):
        return [vector[part] for part in parts]

    # Rows of the transposed Jacobian are columns of the Jacobian, which CasADi stores one after the other.
    def slopes(transposed, x, _):
        by_x = transposed(flat, x)
        return [by_x[i, j] for j in y_parts for i in x_parts]

    def push(x, seeds):
        return split(jax.jvp(flat, (x,), (seeds,))[1], y_parts)

    def pull(x, seeds):
        return jax.vjp(flat, x)[1](seeds)[0]

    def pull_forward(x, seeds):  # also for loops of unknown length
        return _forward(flat, x) @ seeds

    def adjoint(pull, x, seeds):
        return split(pull(x, seeds), x_parts)

    def curvature(pull, x, seeds):
        by_x = _forward(lambda x: jnp.concatenate([pull(x, seeds), flat(x)]), x)
        hessian, by_seeds = by_x[:, : x.size], by_x[:, x.size :]
        rows = ([*(hessian[k, i] for k in x_parts), *(by_seeds[i, j].T for j in y_parts)] for i in x_parts)
        return [block for row in rows for block in row]

    def renamed(prefix, leaves):
        # CasADi declares copies of outputs, and derivatives with respect to them, without elements, and so without a
        # kind.
        kind = "" if prefix == "out" else "real"
        return [leaf._replace(name=f"{prefix}_{leaf.name}", kind=kind) for leaf in leaves]

    def jacobians(results, variables):
        return [
            Leaf(f"jac_{result.name}_{variable.name}", variable.kind, (prod(result.shape), prod(variable.shape)))
            for result in results
            for variable in variables
        ]

    both, adjoints = [*inputs, *renamed("out", outputs)], renamed("adj", inputs)
    seeded = [*both, *renamed("adj", outputs)]
    directions = [_forward, _reverse]
    if x_parts[-1].stop > y_parts[-1].stop:
        directions.reverse()
    pulls = (pull, pull_forward)
    return {
        "": (inputs, outputs, [lambda x, _: split(flat(x), y_parts)]),
        "jac_": (both, jacobians(outputs, inputs), [partial(slopes, way) for way in directions]),
        "fwd1_": ([*both, *renamed("fwd", inputs)], renamed("fwd", outputs), [push]),
        "adj1_": (seeded, adjoints, [partial(adjoint, way) for way in pulls]),
        "jac_adj1_": (
            [*seeded, *renamed("out", adjoints)],
            jacobians(adjoints, seeded),
            [partial(curvature, way) for way in pulls],
        ),
    }


def _function(
    source: Source, symbol: str, inputs: list[Leaf], outputs: list[Leaf], ways: Sequence[Way], stack: int
) -> tuple[Source, str]:
    """Returns the source and the C text of the first method that works."""
    dense = [k for k, leaf in enumerate(inputs) if leaf.kind]
    n = sum(prod(leaf.shape) for leaf in takewhile(lambda leaf: leaf.kind, inputs))
    names = {place: (f"in_{k}", False) for place, k in enumerate(dense)}
    targets = [f"res[{j}]" for j, leaf in enumerate(outputs) if leaf.kind]
    reason = ""

    def evaluate(way, *columns):
        return way(*jnp.split(jnp.concatenate(columns), [n]))

    for way in ways:
        try:
            closed, _ = traced(partial(evaluate, way), [np.zeros(prod(inputs[k].shape)) for k in dense])
            program, _, results = program_of(closed, finite=source.finite)
            body = body_of(source.copy(), program, results, names, targets, optional=True)
        except (TypeError, ValueError, NotImplementedError) as error:  # JAX cannot differentiate it, or it has no C
            reason = str(error).strip().partition("\n")[0]
            continue
        if body.stack > stack:
            kib = body.stack / 1024
            reason = f"it needs {kib:.0f} KiB of stack; the limit is {stack // 1024} KiB"
            continue
        lines = [f"    const casadi_real *in_{k} = arg[{k}] ? arg[{k}] : zeros; (void)in_{k};" for k in dense]
        lines += ["    (void)res; (void)integers; (void)reals; (void)memory;", *body.lines, "    return 0;"]
        leaves = [*inputs, *outputs]
        return body.source, _FUNCTION.format(
            symbol=symbol,
            names=", ".join(f'"{leaf.name}"' for leaf in leaves),
            length=3 + max(0 if leaf.kind else leaf.shape[1] for leaf in leaves),
            sparsities=", ".join(f"{{{leaf.shape[0]}, {leaf.shape[1]}, {int(leaf.kind != '')}}}" for leaf in leaves),
            cost=stated(body.cost), inputs=len(inputs), outputs=len(outputs),
            lines="\n".join(lines),
        )  # fmt: skip
    raise InputError(f"{reason}; export it without casadi")
