"""Random JAX programs: real, whole and truth arrays, moves, reductions, products, and control flow.

Control flow and indexing are also mapped over the rows of arrays, and arrays may have no elements.

Each is drawn from a seed while it is traced, from the shapes and types of what it has computed so far. Real numbers are
kept of order one and functions are smooth or compared far from ties, so that round-off stays small.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

WHOLE = (jnp.int32, jnp.int64, jnp.uint32, jnp.uint64)
TYPES = (*(jnp.float64,) * 3, *WHOLE[:2] * 2, *WHOLE[2:], jnp.bool_)
SIZES = (1, 2, 3, 5, 8, 9, 17, 40, 65, 0)
SHAPES = ((), *((size,) for size in SIZES), (2, 2), (3, 4), (4, 4), (7, 3), (2, 3, 4), (9, 8), (3, 0))
LARGEST = 300
"""Elements of an array."""


def program(seed, count):
    """A function of one to four arrays that gives a list of arrays, and some states of its arguments."""
    random = np.random.default_rng([seed, 0])
    like = [(_of_one(random, SHAPES), _of_one(random, TYPES)) for _ in range(random.integers(1, 5))]

    def function(*arguments):
        random = np.random.default_rng([seed, 1])
        known = _computed(random, [*arguments], steps=int(random.integers(4, 12)), depth=2)
        # The last is there, so that long chains are.
        return [*(_of_one(random, known) for _ in range(3)), known[-1]]

    return function, [tuple(_of(random, *one) for one in like) for _ in range(count)]


def _of_one(random, choices):
    return choices[random.integers(len(choices))]


def _of(random, shape, dtype):
    dtype = np.dtype(dtype)
    if dtype.kind == "f":
        return np.asarray(random.normal(size=shape))
    if dtype.kind == "b":
        return np.asarray(random.integers(0, 2, size=shape).astype(bool))
    limits = np.iinfo(dtype)
    small = np.asarray(random.integers(max(-9, limits.min), 10, size=shape))
    edges = random.choice(np.array([limits.min, limits.max, limits.max // 2 + 1], dtype), size=shape)
    return np.asarray(np.where(random.random(size=shape) < 0.85, small.astype(dtype), edges))


def _computed(random, known, *, steps, depth):
    """Returns the known arrays and those that the steps add."""
    for _ in range(steps):
        step = STEPS[random.choice(len(STEPS), p=WEIGHTS)]
        try:
            results = step(random, known, depth) if depth or step not in DEEP else []
        except (IndexError, TypeError, ValueError, ZeroDivisionError):  # of what has no value without elements
            if all(array.size for array in known):
                raise
            continue
        known = [*known, *(_tame(result) for result in results if result.size <= LARGEST)]
    return known


def _kind(x):
    return jnp.dtype(x.dtype).kind


def _chosen(random, known, kinds="fiub", rank=0):
    """One of the arrays of a kind and least rank, late ones more often; a constant where there is none."""
    fitting = [array for array in known if _kind(array) in kinds and array.ndim >= rank]
    if not fitting or random.random() < 0.05:
        shapes = [shape for shape in SHAPES if len(shape) >= rank and 0 not in shape]
        types = [dtype for dtype in TYPES if jnp.dtype(dtype).kind in kinds]
        return jnp.asarray(_of(random, _of_one(random, shapes), _of_one(random, types)))
    return fitting[max(random.integers(len(fitting)), random.integers(len(fitting)))]


def _partner(random, known, x):
    """Another of the type, of a shape that broadcasts to that of x."""
    fitting = [array for array in known if array.dtype == x.dtype and array.shape in ((), x.shape) and array is not x]
    if fitting and random.random() < 0.7:
        return _of_one(random, fitting)
    return jnp.asarray(_of(random, x.shape, x.dtype))


def _tame(x):
    """A real array of order one; large numbers lose their digits in sines."""
    return jnp.clip(x, -50, 50) / (1 + 0.2 * jnp.abs(jnp.clip(x, -50, 50))) if _kind(x) == "f" else x


def _cast(x, shape, dtype):
    """Numbers of x in another shape and type."""
    flat = jnp.resize(x, shape)
    return _tame((3 * flat if _kind(flat) == "f" else flat).astype(dtype))


def _alike(x, like):
    return _cast(x, like.shape, like.dtype)


def _divided(divide):
    """XLA takes x / x for 1 where it sees that both are x: the dividend is not 0 where the divisor is."""
    return lambda a, b: divide(a | (b == 0).astype(a.dtype), b)


NAMES = {
    "f": (
        "sin cos tanh abs negative floor sign square",
        "add subtract multiply maximum minimum hypot",
        "mean sum max min argmax argmin sort",
    ),
    # Without squares, which XLA takes for positive though they wrap around.
    "i": (
        "negative abs sign bitwise_not",
        "add subtract multiply maximum minimum bitwise_and bitwise_or left_shift right_shift",
        "sum prod max argmin argsort",
    ),
    "b": ("logical_not", "logical_and logical_or logical_xor equal less less_equal maximum", "any all sum max min"),
}
"""Functions of one array, of two, and over an axis, by the kind of number."""
MORE = {
    "f": (
        (lax.erf, lambda x: 1 / (1 + x * x), lambda x: jnp.exp(-jnp.abs(x)), lambda x: 0 - x),
        (lambda a, b: a / (2 + jnp.abs(b)), lambda a, b: (1 + a * a) ** jnp.tanh(b)),
        (lambda x, axis: jnp.prod(jnp.cos(x), axis), lambda x, axis: jnp.cumsum(x, axis or 0)),
    ),
    "i": (
        (lambda x: x**3, lambda x: x & 1),
        (lax.rem, _divided(lax.div), _divided(jnp.floor_divide)),
        (lambda x, axis: jnp.bitwise_or.reduce(x, axis or 0), lambda x, axis: lax.cummax(x, axis or 0)),
    ),
    "b": ((), (), ()),
}
COMPARED = (jnp.equal, jnp.not_equal, jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal)


def _function(random, x, place):
    kind = _kind(x) if _kind(x) in NAMES else "i"
    return _of_one(random, [*(getattr(jnp, name) for name in NAMES[kind][place].split()), *MORE[kind][place]])


def _elementwise(random, known, depth):
    a = _chosen(random, known)
    b = jnp.broadcast_to(_partner(random, known, a), a.shape)
    results = [
        lambda: _function(random, a, 0)(a),
        lambda: _function(random, a, 1)(a, b),
        lambda: _of_one(random, COMPARED)(a, b),
        lambda: jnp.where(jnp.resize(_chosen(random, known, "b", 1), a.shape), a, b),
    ]
    return [results[k]() for k in random.choice(4, size=2, p=[0.4, 0.3, 0.15, 0.15])]


def _converted(random, known, depth):
    x = _chosen(random, known)
    return [_cast(x, x.shape, _of_one(random, TYPES))]


def _reduced(random, known, depth):
    x = _chosen(random, known, rank=1)
    axis = (None, int(random.integers(x.ndim)))[random.integers(2)]
    return [jnp.asarray(_function(random, x, 2)(x, axis))]


def _product(random, known, depth):
    a = _chosen(random, known, rank=1)
    fitting = [array for array in known if array.dtype == a.dtype and array.ndim and array.shape[0] == a.shape[-1]]
    made = jnp.asarray(_of(random, (a.shape[-1], 9), a.dtype))
    return [jnp.tensordot(a, _of_one(random, [made, *fitting]), ([a.ndim - 1], [0]))]


def _moved(random, known, depth):
    x = _chosen(random, known, rank=1)
    axis = int(random.integers(x.ndim))
    move = _of_one(random, MOVES)
    return [move(x, axis)]


MOVES = (
    jnp.flip,
    lambda x, axis: x.T,
    lambda x, axis: jnp.roll(x, 2, axis),
    lambda x, axis: jnp.concatenate([lax.slice_in_dim(x, 0, 1, axis=axis), x], axis),
    lambda x, axis: x.reshape(-1)[::2],
    lambda x, axis: x[-1],
    lambda x, axis: jnp.pad(x, [(1, 0)] * x.ndim),
    lambda x, axis: jnp.repeat(x, 2, axis),
    lambda x, axis: jnp.broadcast_to(x, (2, *x.shape)),
    lambda x, axis: jnp.tril(x) if x.ndim > 1 else jnp.diag(x[:6]),
    lambda x, axis: lax.slice_in_dim(x, 0, 0, axis=axis),
)


def _indexed(random, known, depth):
    x, index = _chosen(random, known, rank=1), _chosen(random, known, "iu")
    # JAX narrows indices to 32 bits in some modes, and jitted and not it clamps large unsigned ones differently.
    index = index % 23 if _kind(index) == "u" else jnp.clip(index, -23, 23)
    index = index if index.size * (x.size // x.shape[0]) <= LARGEST else index.reshape(-1)[0]
    mode, first = _of_one(random, ("clip", "drop")), index.reshape(-1)[0]
    ways = [
        lambda: x[index % x.shape[0]],
        lambda: x.at[index].get(mode="fill", fill_value=1),
        lambda: lax.dynamic_slice_in_dim(x, first, max(1, x.shape[0] // 2)),
        lambda: lax.dynamic_update_slice_in_dim(x, x[:1], first, 0),
        lambda: x.at[index].set(x[0], mode=mode),
        lambda: x.at[index].add(x[0], mode=mode) if x.dtype != bool else ~x,
        lambda: x.at[index].apply(jnp.logical_not if x.dtype == bool else lambda v: v * v, mode=mode),
    ]
    return [_of_one(random, ways)()]


def _drawn_inside(random, steps, depth):
    """A function that continues arrays by the same steps each time."""
    seed = int(random.integers(1 << 30))
    return lambda known: _computed(np.random.default_rng(seed), known, steps=steps, depth=depth - 1)


def _scanned(random, known, depth):
    rows, inside = _chosen(random, known, rank=1)[:6], _drawn_inside(random, 2, depth)

    def turn(carry, row):
        results = inside([carry, row])
        return _alike(results[-1], carry), results[-2]

    return [*lax.scan(turn, _chosen(random, known), rows, reverse=bool(random.integers(2)))]


def _branched(random, known, depth):
    which = _chosen(random, known, "bi").reshape(-1)[0]
    branches = [_drawn_inside(random, 2, depth) for _ in range(3)]
    branches = [lambda x, inside=inside: _alike(inside([x, *known[-2:]])[-1], x) for inside in branches]
    if which.dtype == bool:
        return [lax.cond(which, *branches[:2], _chosen(random, known))]
    return [lax.switch((which % 4).astype(jnp.int32), branches, _chosen(random, known))]


def _looped(random, known, depth):
    start, inside = _chosen(random, known), _drawn_inside(random, 2, depth)
    turns = jnp.clip(_chosen(random, known, "i").reshape(-1)[0], 0, 5)

    def body(k, carry):
        return _alike(inside([carry, k])[-1], carry)

    if random.random() < 0.5:
        return [lax.fori_loop(0, _of_one(random, (3, turns)), body, start)]
    # Until a number of the carry is large, 5 turns at most.
    last = lax.while_loop(
        lambda s: (s[0] < 5) & ~jnp.any(3 * s[1].astype(float) > 1), lambda s: (s[0] + 1, body(*s)), (0, start)
    )
    return [last[1], last[0]]


def _mapped(random, known, depth):
    """Control flow or indexing of each row of some arrays."""
    x = _chosen(random, known, rank=1)[:9]
    rows = [x, *(array[:9] for array in known[-4:] if array.ndim and array[:9].shape[0] == x.shape[0])]
    step, seed = _of_one(random, (_looped, _looped, _scanned, _branched, _indexed)), int(random.integers(1 << 30))
    order = jnp.arange(x.shape[0])
    return jax.vmap(lambda *rows: step(np.random.default_rng(seed), [*rows], depth))(*rows, order)


DEEP = (_scanned, _branched, _looped, _mapped)
"""Steps that draw programs inside."""
CHANCES = {
    **{_elementwise: 8, _converted: 2, _reduced: 3, _product: 2, _moved: 4, _indexed: 3},
    **{_scanned: 1, _branched: 1, _looped: 1, _mapped: 4},
}
STEPS = tuple(CHANCES)
WEIGHTS = np.array(list(CHANCES.values())) / sum(CHANCES.values())
