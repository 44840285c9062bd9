"""Traces functions, and lowers their jaxprs to programs: inlines calls and applies a rule for every primitive."""

import inspect
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax.dtypes import float0
from jax.extend import core

from dln_jax.export.c import control_flow, indexing, primitives
from dln_jax.export.c.nodes import Node, is_constant, values
from dln_jax.export.c.operations import OPERATIONS
from dln_jax.export.c.program import Program
from dln_jax.export.c.text import PRECISIONS, failure, kind_of
from dln_jax.types import InputError

_LARGE_CALL = 600
"""Smallest number of equations for which a repeatedly called jitted function becomes a C function."""
_CALLS = {
    "jit": "jaxpr", "closed_call": "call_jaxpr", "remat2": "jaxpr", "eval_jaxpr": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "custom_vmap_call": "call",
}  # fmt: skip
_WITHOUT_EFFECT = frozenset((
    "accuracy", "algorithm", "use_magma", "sharding", "out_sharding", "unroll", "linear",
    "_split_transpose", "weak_type", "new_dtype", "dtype", "index_dtype", "preferred_element_type",
    "indices_are_sorted", "unique_indices", "is_stable", "sort_eigenvalues", "conjugate_a", "branches_platforms",
    "ft_in", "ft_out", "memory_space", "devices", "srcs", "copy_semantics", "num_consts", "num_carry",
))  # fmt: skip
"""Parameters without effect on values: hints, promises, and types that the results already have."""
_REFUSED = {
    "random": "random numbers; draw them beforehand and pass them as arguments",
    "threefry": "random numbers; draw them beforehand and pass them as arguments",
    "callback": "a callback into Python, which C cannot call",
    "debug_print": "printing, a side effect",
}


def traced(function: Callable[..., Any], examples: Sequence[Any]) -> tuple[Any, Any]:
    """Returns the closed jaxpr of a function, and the tree of its results.

    Raises:
        InputError: the function has side effects, integers beyond 64 bits, or Python branches on an argument.
    """
    try:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
    except jax.errors.ConcretizationTypeError as error:
        raise InputError(
            "the function uses the value of an argument in Python, such as `if x > 0`; use jnp.where or lax.cond"
        ) from error
    except OverflowError as error:
        raise InputError(f"a whole number is out of range ({error}); C has integers of up to 64 bits") from error
    if closed.effects:
        raise InputError(
            f"the function has side effects ({', '.join(map(str, closed.effects))}); C export does not support them"
        )
    return closed, shapes


def repeated_calls(every: Sequence[Any]) -> set[int]:
    """Returns the `id` values of large jaxprs with several calls in these closed jaxprs.

    Calls of one jitted function with equal argument types share a jaxpr, which JAX keeps.
    """
    sizes: dict[int, int] = {}
    counts: Counter[int] = Counter()

    def size(jaxpr: Any) -> int:
        """Returns the number of equations, including those of calls."""
        if id(jaxpr) not in sizes:
            total = 0
            for equation in _closed(jaxpr).jaxpr.eqns:
                leaves = jax.tree.leaves(equation.params) if _of_jax(equation.primitive) else []
                inside = [leaf for leaf in leaves if hasattr(leaf, "eqns") or hasattr(leaf, "jaxpr")]
                counts.update(map(id, inside))
                total += max(1, sum(map(size, inside)))
            sizes[id(jaxpr)] = total
        return sizes[id(jaxpr)]

    for closed in every:
        size(closed)
    return {identity for identity, count in counts.items() if count > 1 and sizes[identity] >= _LARGE_CALL}


def program_of(
    closed: Any, repeated: Collection[int] = (), *, precision: str = "f64", finite: bool = False
) -> tuple[Program, list[Node], list[Node]]:
    """Returns the program of a closed jaxpr, its inputs and its results.

    Args:
        closed: the jaxpr from `traced`.
        repeated: `id` values, from `repeated_calls`, of jaxprs that remain calls in the program.
        precision: f32 or f64.
        finite: arguments and intermediate results are finite numbers.

    Raises:
        InputError: the jaxpr cannot be written in C. It has an unsupported primitive (the message names its line),
            random numbers, an unsupported dtype, or a shape unknown at compile time.
    """
    program = Program(real=PRECISIONS[precision][0], repeated=repeated, finite=finite, inline=_inline)
    inputs = [
        program.make("input", variable.aval.shape, kind_of(variable.aval.dtype), attribute=number)
        for number, variable in enumerate(closed.jaxpr.invars)
    ]
    return program, inputs, _inline(program, closed, inputs)


def _inline(program: Program, closed: Any, args: Sequence[Node]) -> list[Node]:
    jaxpr = closed.jaxpr
    nodes: dict[Any, Node] = dict(zip(jaxpr.invars, args, strict=True))

    def read(variable: Any) -> Node:
        return _constant(program, variable.val, variable.aval) if hasattr(variable, "val") else nodes[variable]

    for variable, value in zip(jaxpr.constvars, closed.consts, strict=True):
        nodes[variable] = _constant(program, value, variable.aval)
    for equation in jaxpr.eqns:
        try:
            results = _apply(program, equation, [read(variable) for variable in equation.invars])
        except InputError as error:
            where = "" if " (made at " in str(error) else _made_at(equation)
            raise InputError(f"{error}{where}") from error
        for variable, result in zip(equation.outvars, results, strict=True):
            expected = tuple(variable.aval.shape), kind_of(variable.aval.dtype)
            made = result.shape, result.dtype
            assert made == expected, f"{equation.primitive.name} became {made}, not {expected}"
            nodes[variable] = result
    return [read(variable) for variable in jaxpr.outvars]


def _constant(program: Program, value: Any, aval: Any) -> Node:
    kind = kind_of(aval.dtype)
    if aval.dtype == float0:
        value = np.zeros(aval.shape, bool)
    return program.constant(np.asarray(value).reshape(aval.shape), kind)


def _apply(program: Program, equation: Any, args: list[Node]) -> list[Node]:
    primitive, parameters = equation.primitive, equation.params
    name = primitive.name
    for variable in equation.outvars:
        if not all(isinstance(size, int | np.integer) for size in getattr(variable.aval, "shape", ())):
            raise InputError(f"an array has shape {variable.aval.shape}; expected fixed sizes")
    if name in _CALLS:
        inner = parameters[_CALLS[name]]
        if id(inner) in program.repeated:
            return _call(program, inner, args)
        return _inline(program, _closed(inner), args)
    if name == "call_hi_primitive":
        high = parameters["_prim"]
        return primitives.composed(
            program, lambda *leaves: jax.tree.leaves(high.expand(*jax.tree.unflatten(high.in_tree, leaves))), args
        )
    if _is_error_of_equinox(equation):
        # C cannot raise an error: the results are NaN, the largest integers or true.
        kinds = [kind_of(variable.aval.dtype) for variable in equation.outvars]
        missing = [program.constant(failure(kind), kind) for kind in kinds]
        return [
            program.broadcast(node, variable.aval.shape)
            for node, variable in zip(missing, equation.outvars, strict=True)
        ]
    if name in _RULES or name in OPERATIONS:
        return _ruled(program, equation, args)
    if why := next((reason for part, reason in _REFUSED.items() if part in name), None):
        raise InputError(f"'{name}' is {why}")
    if _of_jax(primitive):
        raise InputError(f"the primitive '{name}' is not supported in C")

    def run(*unknown: Any) -> list[Any]:
        left = iter(unknown)
        return jax.tree.leaves(
            primitive.impl(*(next(left) if fixed is None else fixed for fixed in known), **parameters)
        )

    # Primitives of other libraries, such as Equinox, may need the values of constant arguments.
    known = [values(arg) if is_constant(arg) else None for arg in args]
    return primitives.composed(program, run, [arg for arg in args if not is_constant(arg)])


def _ruled(program: Program, equation: Any, args: list[Node]) -> list[Node]:
    """Returns the results by the primitive's rule; refuses unknown parameters."""
    name, results = equation.primitive.name, [variable.aval for variable in equation.outvars]
    rule = _RULES.get(name) or (lambda program, *args: program.elementwise(name, *args))
    read = inspect.signature(rule).parameters
    for key, value in equation.params.items():
        if key not in read and key not in _WITHOUT_EFFECT and value is not None and value is not False:
            raise InputError(f"the primitive '{name}' is not supported in C with {key}={value}".partition("\n")[0])
    if results and all(0 in aval.shape for aval in results):
        return [program.constant(np.zeros(aval.shape), kind_of(aval.dtype)) for aval in results]
    known = {**equation.params, "results": results, "kind": kind_of(results[0].dtype) if results else None}
    nodes = rule(program, *args, **{key: known[key] for key in read if key in known})
    return list(nodes) if isinstance(nodes, list | tuple) else [nodes]


def _call(program: Program, closed: Any, args: list[Node]) -> list[Node]:
    """Returns the results of a call; constant arguments become part of the called function."""
    call = id(closed), tuple((k, values(arg).tobytes()) for k, arg in enumerate(args) if is_constant(arg))
    passed = [arg for arg in args if not is_constant(arg)]
    if call not in program.parts:
        part = replace(program, nodes=[], loops={}, floor=(), _interned={}, _scalars={})
        inputs = iter([part.make("input", arg.shape, arg.dtype, attribute=k) for k, arg in enumerate(passed)])
        inside = [part.constant(values(arg), arg.dtype) if is_constant(arg) else next(inputs) for arg in args]
        program.parts[call] = part, _inline(part, closed, inside)
    made = program.make("call", (), "int", passed, attribute=call)
    return control_flow.projections(program, made, _closed(closed).out_avals)


def _custom_linear_solve(program: Program, *args: Node, const_lengths: Any, jaxprs: Any) -> list[Node]:
    lengths = const_lengths
    before = lengths.matvec + lengths.vecmat
    constants, right = args[before : before + lengths.solve], args[sum(lengths) :]
    return _inline(program, jaxprs.solve, [*constants, *right])


def _platform(program: Program, *, platforms) -> Node:
    """Returns the index of the CPU's branch, or of the default branch."""
    places = [k for k, parameter in enumerate(platforms) if parameter is None or "cpu" in parameter]
    return program.constant(np.int32(places[0]), "int")


def _of_jax(primitive: Any) -> bool:
    return getattr(primitive.impl, "func", primitive.impl).__module__.partition(".")[0] == "jax"


def _is_error_of_equinox(equation: Any) -> bool:
    """Returns whether an equation is the error callback of `equinox.error_if`."""
    if equation.primitive.name != "pure_callback":
        return False
    callback = equation.params["callback"]
    return getattr(callback, "callback_func", callback).__module__ == "equinox._errors"


def _closed(jaxpr: Any) -> Any:
    """Returns a jaxpr in closed form; an open jaxpr has no constants."""
    return jaxpr if hasattr(jaxpr, "consts") else core.ClosedJaxpr(jaxpr, ())


def _made_at(equation: Any) -> str:
    """Returns " (made at FILE:LINE)" with the line of user code, or "" if JAX kept no traceback."""
    traceback = equation.source_info.traceback
    frames = [] if traceback is None else list(traceback.frames)
    users = [frame for frame in frames if "/jax/" not in frame.file_name and "/dln_jax/export/" not in frame.file_name]
    return f" (made at {users[0].file_name}:{users[0].line_num})" if users else ""


_RULES = {
    **primitives.RULES,
    **indexing.RULES,
    **control_flow.RULES,
    "platform_index": _platform,
    "custom_linear_solve": _custom_linear_solve,
}
