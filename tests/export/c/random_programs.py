"""Random JAX programs: real, whole and truth arrays, moves, reductions, products, control flow and nested functions.

Control flow and indexing are also mapped over the rows of arrays, and arrays may have no elements.

Each is drawn from a seed while it is traced, from the shapes and types of what it has computed so far. Real numbers are
kept of order one and functions are smooth or compared far from ties, so that round-off stays small.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import primitives as of_jax

REAL, WHOLE = (jnp.float64,), (jnp.int32, jnp.int64, jnp.uint32, jnp.uint64)
TYPES = (*REAL * 3, *WHOLE[:2] * 2, *WHOLE[2:], jnp.bool_)
SHAPES = (
    (), (1,), (2,), (3,), (5,), (8,), (9,), (17,), (40,), (65,), (2, 2), (3, 4), (4, 4), (7, 3), (2, 3, 4), (9, 8),
    (0,), (3, 0),
)  # fmt: skip
LARGEST = 300
"""Elements of an array."""
Arrays = list[Any]


def program(seed: int) -> tuple[Callable[..., Any], tuple[np.ndarray, ...]]:
    """A function of one to four arrays that gives a list of arrays, and examples of its arguments."""
    random = np.random.default_rng([seed, 0])
    examples = tuple(_drawn(random) for _ in range(random.integers(1, 5)))

    def function(*arguments: Any) -> Arrays:
        random = np.random.default_rng([seed, 1])
        known = _computed(random, list(arguments), steps=int(random.integers(4, 16)), depth=2)
        chosen = random.choice(len(known), size=min(len(known), int(random.integers(1, 5))), replace=False)
        # The last is there, so that long chains are.
        return [known[k] for k in {*chosen.tolist(), len(known) - 1}]

    # Arguments have names in C, by position here.
    names = "abcd"[: len(examples)]
    scope: dict[str, Any] = {"function": function}
    exec(f"def named({', '.join(names)}):\n    return function({', '.join(names)})", scope)
    return scope["named"], examples


def states(seed: int, examples: tuple[np.ndarray, ...], count: int) -> list[tuple[np.ndarray, ...]]:
    """The examples, and others of the same shapes and types."""
    random = np.random.default_rng([seed, 2])
    others = (tuple(_of(random, array.shape, array.dtype) for array in examples) for _ in range(count - 1))
    return [examples, *others]


def _drawn(random: np.random.Generator) -> np.ndarray:
    return _of(random, SHAPES[random.integers(len(SHAPES))], TYPES[random.integers(len(TYPES))])


def _of(random: np.random.Generator, shape: Any, dtype: Any) -> np.ndarray:
    dtype = np.dtype(dtype)
    if dtype.kind == "f":
        return np.asarray(random.normal(size=shape))
    if dtype.kind == "b":
        return np.asarray(random.integers(0, 2, size=shape).astype(bool))
    limits = np.iinfo(dtype)
    small = np.asarray(random.integers(max(-9, limits.min), 10, size=shape))
    edges = random.choice(np.array([limits.min, limits.max, limits.max // 2 + 1], dtype), size=shape)
    return np.asarray(np.where(random.random(size=shape) < 0.85, small.astype(dtype), edges))


def _computed(random: np.random.Generator, known: Arrays, *, steps: int, depth: int) -> Arrays:
    """Returns the known arrays and those that the steps add."""
    for _ in range(steps):
        step = STEPS[random.choice(len(STEPS), p=WEIGHTS)]
        try:
            results = step(random, known, depth)
        except (IndexError, TypeError, ValueError, ZeroDivisionError):  # of what has no value without elements
            if all(array.size for array in known):
                raise
            continue
        known = [*known, *(result for result in results if result.size <= LARGEST)]
    return known


def _chosen(random: np.random.Generator, known: Arrays, kinds: str = "fiub", rank: int = 0) -> Any:
    """One of the arrays of a kind and least rank, late ones more often; a constant where there is none."""
    fitting = [array for array in known if jnp.dtype(array.dtype).kind in kinds and array.ndim >= rank]
    if not fitting or random.random() < 0.05:
        shapes = [shape for shape in SHAPES if len(shape) >= rank and 0 not in shape]
        dtype = next(dtype for dtype in random.permutation(np.array(TYPES, object)) if jnp.dtype(dtype).kind in kinds)
        return jnp.asarray(_of(random, shapes[random.integers(len(shapes))], dtype))
    return fitting[max(random.integers(len(fitting)), random.integers(len(fitting)))]


def _partner(random: np.random.Generator, known: Arrays, x: Any) -> Any:
    """Another of the type, of a shape that broadcasts with it."""
    fitting = [array for array in known if array.dtype == x.dtype and _broadcast(array, x) and array is not x]
    if fitting and random.random() < 0.7:
        return fitting[random.integers(len(fitting))]
    shape = x.shape if random.random() < 0.5 else ()
    return jnp.asarray(_of(random, shape, x.dtype))


def _broadcast(a: Any, b: Any) -> bool:
    try:
        return int(np.prod(np.broadcast_shapes(a.shape, b.shape))) <= LARGEST
    except ValueError:
        return False


def _tame(x: Any) -> Any:
    """A real array of order one."""
    return x / (1 + 0.2 * jnp.abs(x))


ON_REAL = (
    jnp.sin, jnp.cos, jnp.tanh, jnp.arctan, jnp.arcsinh, jnp.square, jnp.abs, jnp.negative, jnp.cbrt, jnp.floor,
    jnp.sign, jnp.round, jax.nn.relu, jax.nn.softplus, jax.nn.sigmoid, lax.erf, jnp.ceil, jnp.trunc,
    lambda x: jnp.exp(-jnp.abs(x)), lambda x: jnp.log1p(x * x), lambda x: jnp.sqrt(1 + x * x),
    lambda x: 1 / (1 + x * x), lambda x: 0 - x, lambda x: jnp.expm1(0.1 * x), lambda x: x**3,
    lambda x: (1 + x * x) ** -2,
    lambda x: lax.reduce_precision(x, 8, 10), lambda x: jnp.modf(x)[0], lambda x: jnp.log(2 + jnp.sin(x)),
    lambda x: jnp.clip(x, -0.5, 0.75), lambda x: lax.rsqrt(1 + x * x),
)  # fmt: skip
ON_TWO_REAL = (
    jnp.add, jnp.subtract, jnp.multiply, jnp.maximum, jnp.minimum, jnp.hypot, lambda a, b: a / (2 + jnp.abs(b)),
    lambda a, b: jnp.arctan2(a, 1 + b * b), lambda a, b: (1 + a * a) ** jnp.tanh(b), jnp.logaddexp,
    lambda a, b: jnp.fmod(a, 1.5 + jnp.abs(b)), lambda a, b: jnp.where(a > b, a, 2 * b),
    lambda a, b: jnp.nextafter(1 + a * a, b),  # never subnormal, which XLA takes for zero
)  # fmt: skip


def _not_zero_over_zero(a, b):
    """The dividend a, not 0 where b is: XLA takes x / x for 1 where it sees that both are x."""
    return a | (b == 0).astype(a.dtype)


ON_TWO_WHOLE = (
    jnp.add, jnp.subtract, jnp.multiply, jnp.maximum, jnp.minimum, lambda a, b: lax.div(_not_zero_over_zero(a, b), b),
    lax.rem, jnp.bitwise_and, jnp.bitwise_or, jnp.bitwise_xor,
    lambda a, b: jnp.floor_divide(_not_zero_over_zero(a, b), b), jnp.remainder, lax.shift_left,
    lax.shift_right_logical, lax.shift_right_arithmetic,
)  # fmt: skip
ON_WHOLE = (  # without squares, which XLA takes for positive though they wrap around
    jnp.negative, jnp.abs, jnp.sign, jnp.bitwise_not, lambda x: x * (x + 1), lambda x: x**3, lambda x: x & 1,
    lambda x: x | 0,
)  # fmt: skip
ON_TRUTHS = (jnp.logical_and, jnp.logical_or, jnp.logical_xor, jnp.equal, jnp.less, jnp.less_equal, jnp.maximum)
COMPARED = (
    jnp.equal, jnp.not_equal, jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal,
    lambda a, b: _in_total_order(of_jax.lt_to_p, a, b), lambda a, b: _in_total_order(of_jax.le_to_p, a, b),
)  # fmt: skip


def _in_total_order(comparison, a, b):
    """Not of zeros, whose signs XLA and C may lose."""
    return comparison.bind(*jnp.broadcast_arrays(*(1 + abs(x) if x.dtype == float else x for x in (a, b))))


def _one(random, known, depth):
    x = _chosen(random, known)
    kind = jnp.dtype(x.dtype).kind
    if kind == "b":
        return [jnp.logical_not(x)]
    functions = ON_REAL if kind == "f" else ON_WHOLE
    result = functions[random.integers(len(functions))](x)
    return [_tame(result) if kind == "f" else result]


def _two(random, known, depth):
    a = _chosen(random, known)
    b = _partner(random, known, a)
    kind = jnp.dtype(a.dtype).kind
    functions = {"f": ON_TWO_REAL, "b": ON_TRUTHS}.get(kind, ON_TWO_WHOLE)
    result = functions[random.integers(len(functions))](*jnp.broadcast_arrays(a, b))
    return [_tame(result) if kind == "f" else result]


def _doubled(random, known, depth):
    x = _chosen(random, known, "fiu")
    return [2 * x, 2 * x + 1]


def _compared(random, known, depth):
    a = _chosen(random, known)
    return [COMPARED[random.integers(len(COMPARED))](a, _partner(random, known, a))]


def _selected(random, known, depth):
    a = _chosen(random, known)
    b = _partner(random, known, a)
    which = _chosen(random, known, "b")
    which = which if _broadcast(which, a + b if a.dtype != bool else a | b) else jnp.any(which)
    return [jnp.where(which, a, b)]


def _power(random, known, depth):
    x = _chosen(random, known, "f")
    exponents = random.integers(-2, 4, size=x.shape).astype([np.int32, np.int64][random.integers(2)])
    return [_tame((1 + jnp.abs(x)) ** jnp.asarray(exponents))]


def _converted(random, known, depth):
    x = _chosen(random, known)
    dtype = TYPES[random.integers(len(TYPES))]
    if jnp.dtype(dtype).kind == "f":  # large ones lose their digits in sines
        return [_tame(jnp.clip(x.astype(dtype), -50, 50))]
    return [(3 * x if jnp.dtype(x.dtype).kind == "f" else x).astype(dtype)]


OVER_REAL = (
    lambda x, axis: _tame(x.mean(axis)), lambda x, axis: _tame(jnp.sum(x, axis)), jnp.max, jnp.min,
    lambda x, axis: jnp.prod(jnp.cos(x), axis), jnp.argmax, jnp.argmin, lambda x, axis: jnp.sqrt(1 + jnp.var(x, axis)),
    lambda x, axis: _tame(jnp.cumsum(x, axis or 0)), jnp.sort,
)  # fmt: skip
OVER_WHOLE = (
    jnp.sum, jnp.prod, jnp.max, jnp.min, jnp.argmax, jnp.argmin, lambda x, axis: jnp.cumsum(x, axis or 0),
    lambda x, axis: jnp.bitwise_xor.reduce(x, axis or 0), lambda x, axis: jnp.bitwise_or.reduce(x, axis or 0),
    lambda x, axis: jnp.bitwise_and.reduce(x, axis or 0), lambda x, axis: lax.cummax(x, axis or 0), jnp.argsort,
    lambda x, axis: lax.sort((x & 3, x), axis or 0, num_keys=2)[1],
)  # fmt: skip
OVER_TRUTHS = (jnp.any, jnp.all, jnp.sum, jnp.max, jnp.min)


def _reduced(random, known, depth):
    x = _chosen(random, known, rank=1)
    axis = (None, int(random.integers(x.ndim)))[random.integers(2)]
    kind = jnp.dtype(x.dtype).kind
    functions = {"f": OVER_REAL, "b": OVER_TRUTHS}.get(kind, OVER_WHOLE)
    return [jnp.asarray(functions[random.integers(len(functions))](x, axis))]


def _product(random, known, depth):
    a = _chosen(random, known, rank=1)
    b = _of(random, (a.shape[-1], *((), (3,), (9,))[random.integers(3)]), a.dtype)
    same = [array for array in known if array.dtype == a.dtype and array.ndim and array.shape[0] == a.shape[-1]]
    b = same[random.integers(len(same))] if same and random.random() < 0.6 else jnp.asarray(b)
    if random.random() < 0.3:
        b = jnp.tensordot(a, a[..., :1], 0).reshape(a.size, -1)[: a.shape[-1]] if a.ndim == 1 else b
    result = jnp.tensordot(a, b, ([a.ndim - 1], [0]))
    return [_tame(result / a.shape[-1]) if jnp.dtype(a.dtype).kind == "f" else result]


def _moved(random, known, depth):
    x = _chosen(random, known, rank=1)
    axis = int(random.integers(x.ndim))
    moves = [
        lambda: jnp.flip(x, axis),
        lambda: x.T,
        lambda: jnp.roll(x, 1 + int(random.integers(3)), axis),
        lambda: jnp.concatenate([_first(x, axis), x], axis),
        lambda: jnp.concatenate([x, jnp.flip(x, axis)], axis),
        lambda: x.reshape(-1),
        lambda: x[:: 1 + int(random.integers(2))],
        lambda: x[-1],
        lambda: jnp.pad(x, [(1, 0)] * x.ndim),
        lambda: jnp.repeat(x, 2, axis),
        lambda: jnp.stack([x, x], axis),
        lambda: jnp.broadcast_to(x, (2, *x.shape)),
        lambda: jnp.expand_dims(x, axis),
        lambda: jnp.concatenate([jnp.atleast_1d(_first(x, 0).reshape(-1)[0]), x.reshape(-1)[:-1]]),
        lambda: jnp.tril(x) if x.ndim > 1 else jnp.diag(x[:6]),
    ]
    return [moves[random.integers(len(moves))]()]


def _changed(x):
    """Another number of the type."""
    if x.dtype == bool:
        return ~x
    return _tame(x * x - 0.5) if jnp.dtype(x.dtype).kind == "f" else 3 * x + 1


def _first(x, axis):
    return lax.slice_in_dim(x, 0, 1, axis=axis)


def _indexed(random, known, depth):
    x = _chosen(random, known, rank=1)
    index = _chosen(random, known, "iu")
    # JAX narrows indices to 32 bits in some modes, and jitted and not it clamps large unsigned ones differently.
    index = index % 23 if jnp.dtype(index.dtype).kind == "u" else jnp.clip(index, -23, 23)
    index = index if index.size * (x.size // x.shape[0]) <= LARGEST else index.reshape(-1)[0]
    near = index % x.shape[0]
    ways = [
        lambda: x[near],
        lambda: jnp.take(
            x, index, axis=0, mode=("clip", "wrap", "fill")[random.integers(3 if x.dtype != float else 2)]
        ),
        lambda: lax.dynamic_slice_in_dim(x, index.reshape(-1)[0], max(1, x.shape[0] // 2)),
        lambda: lax.dynamic_update_slice_in_dim(x, _first(x, 0), index.reshape(-1)[0], 0),
        lambda: lax.dynamic_index_in_dim(x, near.reshape(-1)[0]),
        lambda: x.at[near].set(x[0]),
        lambda: x.at[near].max(x[0]) if x.dtype != bool else x,
        lambda: x.at[jnp.arange(x.shape[0])].add(x[near.reshape(-1)[0]]) if x.dtype != bool else x,
        lambda: jnp.where(jnp.arange(x.shape[0]) < near.reshape(-1)[0], x.reshape(x.shape[0], -1)[:, 0], 0),
        lambda: x.at[index].get(mode="fill", fill_value=1),
        lambda: x.at[near].get(mode="promise_in_bounds"),
        lambda: x.at[index].add(x[0], mode=("clip", "drop")[random.integers(2)]) if x.dtype != bool else ~x,
        lambda: x.at[near].min(x[0], mode="promise_in_bounds") if x.dtype != bool else x,
        lambda: x.at[index].apply(_changed, mode=("clip", "drop")[random.integers(2)]),
        lambda: x.at[index].apply(jnp.zeros_like),
    ]
    return [ways[random.integers(len(ways))]()]


def _scanned(random, known, depth):
    if not depth:
        return []
    start = _chosen(random, known)
    rows = _chosen(random, known, rank=1)[:6]
    seed = int(random.integers(1 << 30))

    def turn(carry, row):
        inside = np.random.default_rng(seed)
        results = _computed(inside, [carry, row], steps=2, depth=depth - 1)
        return _alike(results[-1], carry), results[-2]

    last, every = lax.scan(turn, start, rows, reverse=bool(random.integers(2)))
    return [last, every]


def _alike(x, like):
    """Numbers of x in the shape and type of another."""
    flat = jnp.resize(x, like.shape)
    if like.dtype == bool or jnp.dtype(x.dtype).kind != "f":
        return _bounded(flat.astype(like.dtype))
    return _bounded((3 * flat).astype(like.dtype))


def _bounded(x):
    return _tame(jnp.clip(x, -50, 50)) if jnp.dtype(x.dtype).kind == "f" else x


def _branched(random, known, depth):
    if not depth:
        return []
    which = _chosen(random, known, "biu")
    which = which.reshape(-1)[0]
    seeds = random.integers(1 << 30, size=2 if which.dtype == bool else 3)
    operand = _chosen(random, known)

    def branch(seed):
        def inside(x):
            return _alike(
                _computed(np.random.default_rng(int(seed)), [x, *known[-2:]], steps=2, depth=depth - 1)[-1], x
            )

        return inside

    branches = [branch(seed) for seed in seeds]
    if which.dtype == bool:
        return [lax.cond(which, *branches, operand)]
    return [lax.switch((which % 4).astype(jnp.int32), branches, operand)]


def _looped(random, known, depth):
    if not depth:
        return []
    start = _chosen(random, known)
    turns = jnp.clip(_chosen(random, known, "i").reshape(-1)[0], 0, 5)
    seed = int(random.integers(1 << 30))

    def body(k, carry):
        results = _computed(np.random.default_rng(seed), [carry, k], steps=2, depth=depth - 1)
        return _alike(results[-1], carry)

    way = random.integers(4)
    if way == 0:
        return [lax.fori_loop(0, int(random.integers(1, 5)), body, start)]
    if way == 1:
        return [lax.fori_loop(0, turns, body, start)]
    if way == 2:  # until a number of the carry is large, 5 turns at most
        last = lax.while_loop(
            lambda s: (s[0] < 5) & ~jnp.any(3 * s[1].astype(float) > 1), lambda s: (s[0] + 1, body(*s)), (0, start)
        )
        return [last[1], last[0]]
    last = lax.while_loop(lambda s: s[0] < turns, lambda s: (s[0] + 1, body(s[0], s[1])), (turns * 0, start))
    return [last[1], last[0]]


def _mapped(random, known, depth):
    """Control flow or indexing of each row of some arrays."""
    if not depth:
        return []
    x = _chosen(random, known, rank=1)[:9]
    rows = [x, *(array[:9] for array in known[-4:] if array.ndim and array[:9].shape[0] == x.shape[0])]
    order = jnp.argsort(x.reshape(x.shape[0], -1).sum(1)) if x.size else jnp.arange(x.shape[0])
    steps, seed = (_looped, _looped, _looped, _scanned, _branched, _indexed, _mapped), int(random.integers(1 << 30))
    step = steps[random.integers(len(steps))]
    return jax.vmap(lambda *rows: step(np.random.default_rng(seed), [*rows], depth - 1 + (depth < 2)))(*rows, order)


def _emptied(random, known, depth):
    x = _chosen(random, known, rank=1)
    return [lax.slice_in_dim(x, 0, 0, axis=int(random.integers(x.ndim)))]


def _nested(random, known, depth):
    """A jitted function with constants of its own, called twice; another differs in its constants alone."""
    if not depth:
        return []
    seed = int(random.integers(1 << 30))
    x, y = _chosen(random, known), _chosen(random, known, "f")
    constants = [jnp.asarray(_of(random, y.shape, y.dtype)) for _ in range(2)]

    def made(constant):
        def function(x, y):
            results = _computed(np.random.default_rng(seed), [x, y * constant], steps=3, depth=depth - 1)
            return results[-1], _tame(y + constant)

        return jax.jit(function)

    functions = [made(constant) for constant in constants]
    return [*functions[0](x, y), *functions[1](x, y), functions[0](x, y + 1)[1]]


def _differentiated(random, known, depth):
    x = _chosen(random, known, "f")
    return [_tame(jax.grad(lambda x: jnp.sum(jnp.sin(x) * jnp.flip(x)))(x))] if x.ndim else [jax.grad(jnp.tanh)(x)]


CHANCES = {
    _one: 5, _two: 6, _doubled: 1, _compared: 2, _selected: 2, _power: 1, _converted: 2, _reduced: 3, _product: 2,
    _moved: 4, _indexed: 3, _scanned: 1, _branched: 1, _looped: 1, _nested: 1, _differentiated: 1,
    _mapped: 4, _emptied: 1,
}  # fmt: skip
STEPS = tuple(CHANCES)
WEIGHTS = np.array(list(CHANCES.values())) / sum(CHANCES.values())
