"""Each primitive, in each of its modes, gives in C what it gives in JAX, on what is not finite too."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from comparison import BOUND, in_c, in_jax
from jax import lax
from jax.extend.core import primitives as of_jax
from jax.scipy import linalg as scipy_linalg
from jax.scipy import special

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)
RANDOM = np.random.default_rng(5)
SPECIAL = np.array(
    [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 1.5, 2.5, -2.5, 3.0, 1e-9, -1e-9, 700.0, -700.0, 30.0, np.nan, np.inf, -np.inf]
)
INTEGERS = np.array([0, 1, -1, 7, -7, 2, 3, -3, 12, 100])
SIZES = (1, 3, 8, 33, 64, 130)
"""Unrolled, loops, one tile, and tiles with a remainder."""


def normal(*shape):
    return RANDOM.normal(size=shape)


SQUARE = {n: normal(n, n) / n**0.5 for n in SIZES}
WIDE = {n: normal(5, n) / n**0.5 for n in SIZES}


def of(x, w):
    """Constants at the precision of the arguments."""
    return jnp.asarray(w, x.dtype)


def total_order(name, a, b):
    """NaN has the sign that is written in the program: that of a computed one depends on the processor."""
    bind = getattr(of_jax, f"{name}_p").bind
    number = jnp.where(a == a, a, 0)
    return bind(number, jnp.where(b == b, b, 1)), bind(a, a), bind(number, of(a, [np.nan] * a.size))


def definite(a):
    return a @ a.T + a.shape[0] * jnp.eye(a.shape[0], dtype=a.dtype)


def upper(a):
    return jnp.triu(a) + 3 * jnp.eye(a.shape[0], dtype=a.dtype)


@jax.custom_jvp
def of_own_slope(x):
    return x * x


of_own_slope.defjvp(lambda primals, tangents: (of_own_slope(*primals), 3 * tangents[0]))


@jax.custom_vjp
def of_own_pullback(x):
    return jnp.sum(x * x)


of_own_pullback.defvjp(lambda x: (of_own_pullback(x), x), lambda x, pulled: (5 * pulled * x,))


def matrix_free(a, b):
    m = definite(a)
    return lax.custom_linear_solve(
        lambda x: m @ x, b, lambda _, right: jnp.linalg.solve(m, right), lambda _, right: jnp.linalg.solve(m.T, right)
    )


def root(x):
    def solve(f, start):
        return lax.fori_loop(0, 30, lambda _, y: y - f(y) / (3 * y * y + 1), start)

    return lax.custom_root(lambda y: y**3 + y - x, jnp.ones_like(x), solve, lambda g, y: y / g(jnp.ones_like(y)))


JNP = """
abs negative exp exp2 expm1 log log1p sin cos tan arcsin arccos arctan sinh cosh tanh arcsinh arccosh arctanh sqrt cbrt
floor ceil round trunc sign square isfinite isnan isinf logical_not reciprocal
"""
UNARY = {
    **{name: getattr(jnp, name) for name in JNP.split()},
    **{name: getattr(lax, name) for name in ("rsqrt", "logistic", "erf", "erfc", "lgamma")},
    **{name: getattr(jax.nn, name) for name in ("softplus", "silu", "gelu", "relu", "elu")},
    "round_away": lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO),
    **{f"integer_pow_{n}".replace("-", "minus_"): lambda x, n=n: lax.integer_pow(x, n) for n in (0, 2, 3, 7, -1, -3)},
    "stop_gradient": lax.stop_gradient,
    "clamp": lambda x: lax.clamp(x.dtype.type(-0.7), x, x.dtype.type(0.9)),
    "to_int": lambda x: jnp.where(jnp.abs(x) < 100, x, 0).astype(int),
    "to_bool": lambda x: x.astype(bool),
    "nan_to_num": jnp.nan_to_num,
    "where": lambda x: jnp.where(x > 0, x, -2 * x),
    "heaviside": lambda x: jnp.heaviside(x, 0.5),
    "logsumexp": lambda x: special.logsumexp(x[:3]),
}
BINARY = {
    **{name: getattr(lax, name) for name in ("add", "sub", "mul", "div", "max", "min", "pow", "atan2", "rem")},
    **{name: getattr(jnp, name) for name in ("equal", "not_equal", "less", "less_equal", "greater", "greater_equal")},
    **{name: getattr(jnp, name) for name in ("mod", "floor_divide", "hypot", "logaddexp")},
}


def wide(number, kind=np.int64):
    """A 64-bit whole number, cut to what JAX has of it in single precision."""
    return np.array(number, kind).astype(jax.dtypes.canonicalize_dtype(kind))


ON_INTEGERS = {
    **{name: getattr(jnp, name) for name in ("add", "subtract", "multiply", "maximum", "minimum", "less", "equal")},
    **{name: getattr(jnp, f"bitwise_{name}") for name in ("and", "or", "xor")},
    "integer_div": lambda a, b: lax.div(a, b | 1),
    "integer_rem": lambda a, b: lax.rem(a, b | 1),
    "mod_floor": lambda a, b: a % (b | 1),
    "divide": lambda a, b: a / (b | 1),
    "integer_abs": lambda a, b: jnp.abs(a) + b,
    "integer_not": lambda a, b: ~a + b,
    "integer_sign": lambda a, b: jnp.sign(a) - b,
    "integer_power": lambda a, b: a**3 + b,
    "integer_sums": lambda a, b: (a.sum(), b.prod(), a.max(), b.min(), jnp.argmin(a), jnp.cumsum(b)),
    "to_real": lambda a, b: a.astype(float) * b,
    "wrapped": lambda a, b: (
        a * wide(2**62 + 3),
        a + wide(2**63 - 1),
        a.astype(jnp.int32) * 77777 * b.astype(jnp.int32) ** 5,
    ),
    "unsigned": lambda a, b: (
        *(a.astype(jnp.uint32) - 5, -a.astype(jnp.uint64), jnp.sign(a.astype(jnp.uint32)), a.astype(jnp.uint32) < 0),
        *(a.astype(jnp.uint64) >= 0, a.astype(jnp.uint32) // 3, wide(2**63 + 5, np.uint64) + a.astype(jnp.uint64)),
    ),
    "one_bit": lambda a, b: (a & 1, a | 0, a ^ 0, a & -1, (a & 3) * b, a & b),
    "constants": lambda a, b: (
        *(a + wide(2**53 + 1) // 3, a + lax.div(wide(-(2**53) - 1), wide(2)), a + wide(-(2**63))),
        a.astype(jnp.int32) + jnp.int32(-(2**31)),
    ),
    "compared_with_itself": lambda a, b: (a == a, a != a, a <= a, a < a, jnp.maximum(a, a), a[:3].max(), a > a),
    "truths": lambda a, b: (
        *((a > 0) == (b > 0), (a > 0) < (b > 0), (a > 0) >= (b > 0), jnp.maximum(a > 0, b > 0), (a > 0).max()),
        *((a > 0) <= True, jnp.dot(a > 0, b > 0), jnp.sum(a > 0), jnp.where(a > 0, 2, 3) != 0),
    ),
    "bits_that_differ": lambda a, b: (
        *((a[:3] | -2) != 0, (b[:3] & 3) == 4, (a[:3].astype(jnp.uint32) | 3) == 4, ((a | -2).astype(bool) & (b > 0))),
    ),
    "bitwise_reductions": lambda a, b: (
        *(jnp.bitwise_or.reduce(a), jnp.bitwise_and.reduce(b[1:4]), jnp.bitwise_xor.reduce(a)),
        jnp.bitwise_xor.reduce(b[:2]),
    ),
    "products": lambda a, b: (
        *(a @ b, jnp.outer(a, b) @ a, jnp.dot(a.astype(jnp.uint32), b.astype(jnp.uint32))),
        *((jnp.outer(a, b) @ jnp.outer(b, a)) % 3, a[(b @ b) % 3]),
    ),
    "product_of_large_numbers": lambda a, b: (a * 30370005) @ (b * 4611686018427),
    "product_to_wider": lambda a, b: lax.dot(
        a.astype(jnp.int32) * 99999, b.astype(jnp.int32), preferred_element_type=jnp.int64
    ),
    "filled": lambda a, b: (a.at[b].get(mode="fill"), a.astype(jnp.uint32).at[b].get(mode="fill")),
    "mixed": lambda a, b: (a.astype(jnp.int32), a.astype(jnp.uint32), (a > 0) & (b > 0)),
}
ON_TWO_MORE = {
    "nextafter": lambda a, b: (lax.nextafter(a, b), lax.nextafter(a, a), lax.nextafter(a, 0 * a)),
    **{name: lambda a, b, name=name: total_order(name, a, b) for name in ("lt_to", "le_to")},
}
ON_INTEGERS_MORE = {
    **{
        f"shift_{name}": lambda a, b, name=name: [
            getattr(lax, f"shift_{name}")(a.astype(kind), by.astype(kind))
            for kind in (jnp.int32, jnp.int64, jnp.uint32, jnp.uint64)
            for by in (b, b + 25, b - 7, b % 3 + 30, jnp.full_like(b, 31), jnp.full_like(b, -1))
        ]
        for name in ("left", "right_logical", "right_arithmetic")
    },
    "shift_of_constants": lambda a, b: [
        a.astype(jnp.int32) + getattr(lax, f"shift_{name}")(jnp.int32(-(2**30) - 5), jnp.int32(by)) * (b > 0)
        for name in ("left", "right_logical", "right_arithmetic")
        for by in (0, 1, 30, 31, 32, -1)
    ],
    "unsigned_beside_some_zeros": lambda a, b: [
        compared(x, known)
        for kind in (jnp.uint32, jnp.uint64)
        for x in (a[:3].astype(kind), a.astype(kind))
        for known in (jnp.array([0, 7, 1] + [0] * (len(x) - 3), kind),)
        for compare in (jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal, jnp.maximum, jnp.minimum)
        for compared in (compare, lambda x, y, compare=compare: compare(y, x))
    ],
    "total_order": lambda a, b: [
        primitive.bind(*pair)
        for primitive in (of_jax.lt_to_p, of_jax.le_to_p)
        for pair in ((a, b), (a, a), (a.astype(jnp.uint32), b.astype(jnp.uint32)), (a > 0, b > 0))
    ],
}
MOVES = {
    "broadcast": lambda x: x[:, None] + x[None, 0] + jnp.ones((2, 1, 1, 1)),
    "slice": lambda x: (x[::2, 1:6:3], x[::-1, ::-2], x[-1], x[1, 2], x[:, None, 2:3]),
    "transpose": lambda x: (x.T, x.T.reshape(5, 7), jnp.swapaxes(x.reshape(5, 7, 1), 0, 2)),
    "reshape": lambda x: (x.reshape(7, 5), x.ravel(), x.reshape(1, 35, 1).squeeze(), jnp.expand_dims(x, (0, 3))),
    "pad": lambda x: (
        lax.pad(x, x.dtype.type(2), ((1, 2, 0), (0, 1, 2))),
        lax.pad(x, x.dtype.type(2), ((-1, 1, 1), (2, -3, 0))),
        lax.pad(x, x[0, 0], ((-2, -2, 1), (-1, -1, 3))),
    ),
    "concatenate": lambda x: (
        jnp.concatenate([x, 2 * x, x[:1]]),
        jnp.concatenate([x[:, :2], x], axis=1),
        jnp.stack([x, -x], axis=1),
        jnp.block([[x, x], [-x, x]]),
    ),
    "unstack": lambda x: [3 * column for column in jnp.unstack(x, axis=1)[:3]] + list(jnp.split(x, [2, 3])),
    "tile": lambda x: (jnp.tile(x, (2, 3)), jnp.repeat(x, 2, axis=1), jnp.roll(x, 2, axis=1), jnp.flip(x, 1)),
    "triangles": lambda x: (jnp.tril(x), jnp.triu(x, 1), jnp.diag(x[:, 0]), jnp.diagonal(x), jnp.trace(x)),
    "iota": lambda x: x * jnp.arange(7) + lax.broadcasted_iota(float, (5, 7), 0),
    "reductions": lambda x: (
        *(x.sum(0), x.sum(1), x.sum(), x.prod(1), x.max(0), x.min((0, 1)), x.mean(0), x.std(), x.var(1)),
        *((x > 0).all(1), (x > 1).any(0), jnp.linalg.norm(x, axis=0)),
    ),
    "reductions_of_axes": lambda x: (
        x.reshape(5, 7, 1).sum((0, 2)),
        (x[..., None] * x[0]).max((0, 1)),
        x[:, :2].sum(1),
    ),
    "arguments": lambda x: (jnp.argmax(x, 0), jnp.argmin(x, 1), jnp.argmax(x), jnp.nanargmin(x)),
    "cumulative": lambda x: (
        *(jnp.cumsum(x, 0), lax.cumsum(x, 1, reverse=True), jnp.cumprod(x, 1), lax.cumprod(x, 0, reverse=True)),
        *(lax.cummax(x, 1), lax.cummin(x, 0, reverse=True), lax.cummax(x, 0, reverse=True), lax.cummin(x, 1)),
    ),
    "gradients": lambda x: jax.grad(lambda x: jnp.sum(jnp.sin(x[::2]) ** 2) * x[0, 0])(x),
    "sort": lambda x: (
        jnp.sort(x[0]),
        jnp.argsort(x[1]),
        jnp.argsort(x[0] > 0),
        jnp.median(x[2]),
        x[0, jnp.argsort(x[3])],
    ),
    "gradient_of_max": lambda x: jax.grad(lambda x: x.max() * jnp.prod(x.min(1)))(x),
    "hessian": lambda x: jax.hessian(lambda x: jnp.prod(jnp.cos(x)) + x @ x)(x[0]),
}
INDEXED = {
    "gather": lambda x, i: (x[i], x[0, i], x[i, i[::-1]], x[:, i]),
    **{
        f"gather_{mode}": lambda x, i, mode=mode: (x.at[i].get(mode=mode), x.at[0, i].get(mode=mode))
        for mode in ("clip", "fill")
    },
    "gather_fill_value": lambda x, i: x.at[i].get(mode="fill", fill_value=-3.0),
    "gather_promise": lambda x, i: x.at[jnp.clip(i, 0, 4)].get(mode="promise_in_bounds"),
    "take_along_axis": lambda x, i: jnp.take_along_axis(x, i[:5, None] % 7, axis=1),
    "gather_batched": lambda x, i: jax.vmap(lambda row, k: row[k])(x, i[:5]),
    "gather_known": lambda x, i: (x[np.array([0, 4, 4])], x[np.array([True, False, True, False, True])]),
    **{
        f"scatter_{name}{'_' + mode if mode else ''}": lambda x, i, name=name, mode=mode: getattr(x.at[i], name)(
            2.5 + x[0], mode=mode
        )
        for name in ("set", "add", "subtract", "multiply", "min", "max")
        for mode in ("clip", "drop", None)
        if name == "add" or mode == "drop"
    },
    "scatter_duplicates": lambda x, i: (x.at[i % 2].add(1.5), x.at[:, i % 2].mul(1.5), x.at[i % 2, 0].max(0.3)),
    "scatter_known": lambda x, i: (
        *(x.at[1].set(0.0), x.at[:, 2].add(x[0, 0]), x.at[1:3, ::2].mul(3.0), x.at[np.array([1, 1, 2])].add(1.0)),
        *(x.at[2, 3].set(i[0]), x.at[np.array([1, 1])].min(0.0)),
    ),
    "scatter_triangles": lambda x, i: jax.vmap(  # a loop cannot follow its places
        lambda row: jnp.zeros((4, 4), x.dtype).at[np.tril_indices(4)].add(jnp.tile(row, 2)[:10]).at[1].mul(row[1])
    )(x),
    "lower_triangles": lambda x, i: jnp.tril(jnp.broadcast_to(x[:, None], (5, 7, 7))) * 2.0,
    "scatter_whole": lambda x, i: x.at[:].set(x[0, i[0] % 5]),
    "scatter_batched": lambda x, i: jax.vmap(lambda row, k: row.at[k].add(2.0))(x, i[:5]),
    "gather_gradient": lambda x, i: jax.grad(lambda x: jnp.sum(x[i % 5] ** 2) + jnp.sum(jnp.sin(x[:, i % 7])))(x),
    "dynamic_slice": lambda x, i: (
        lax.dynamic_slice(x, (i[0], i[1]), (2, 3)),
        lax.dynamic_slice_in_dim(x, i[2], 4, axis=1),
        lax.dynamic_index_in_dim(x, i[3], axis=0, keepdims=False),
    ),
    "dynamic_update_slice": lambda x, i: (
        lax.dynamic_update_slice(x, 2 * x[:2, :3], (i[0], i[1])),
        lax.dynamic_update_index_in_dim(x, x[0], i[2], axis=0),
    ),
    "one_hot": lambda x, i: jax.nn.one_hot(i, 4) @ x[:4],
}
CONTROL = {
    "fori_loop": lambda x, n: lax.fori_loop(0, 5, lambda k, y: jnp.sin(y) + k, x),
    "fori_loop_of_known_length": lambda x, n: lax.fori_loop(0, n, lambda k, y: 0.5 * y + x[k], x),
    "while_loop": lambda x, n: lax.while_loop(lambda s: s[1] < n, lambda s: (s[0] * 0.9 + x, s[1] + 1), (x, 0)),
    "while_swapped": lambda x, n: lax.while_loop(
        lambda s: s[2] < 3, lambda s: (s[1], s[0] + 1, s[2] + 1), (x, 2 * x, 0)
    ),
    "while_without_turn": lambda x, n: lax.while_loop(lambda y: jnp.all(y != y), lambda y: y + 1, 0 * x + 1),
    "scan": lambda x, n: lax.scan(lambda c, y: (c + y, c * y), 0.0, x),
    "scan_reverse": lambda x, n: lax.scan(lambda c, y: (c + y, jnp.stack([c, y])), 0.0, x, reverse=True),
    "scan_without_carry": lambda x, n: lax.scan(lambda c, y: (c, y**2), None, x)[1],
    "scan_of_length": lambda x, n: lax.scan(lambda c, _: (jnp.cos(c), c[:2]), x, None, length=4),
    "scan_of_rows": lambda x, n: lax.scan(
        lambda c, y: ((c[0] + y["a"], c[1] @ y["b"]), (y["a"] * 2, c[1])),
        (x, jnp.eye(2)),
        {"a": jnp.outer(x[:3], x), "b": jnp.ones((3, 2, 2)) * x[:2]},
    ),
    "scan_of_nothing": lambda x, n: lax.scan(lambda c, y: (c + y, y), x[0], x[:0])[0],
    "nested_loops": lambda x, n: lax.fori_loop(
        0, 3, lambda k, y: lax.scan(lambda c, z: (c + z * k, c), y, y[:, None] * x)[0] / 10, x
    ),
    "loop_of_what_is_outside": lambda x, n: lax.fori_loop(0, 4, lambda k, y: y + jnp.tanh(x) @ jnp.outer(x, x), x),
    "associative_scan": lambda x, n: lax.associative_scan(jnp.multiply, x),
    "map": lambda x, n: lax.map(lambda y: jnp.sin(y) * x, x),
    "cond": lambda x, n: lax.cond(n > 2, jnp.sin, lambda y: 3 * y, x),
    "cond_on_number": lambda x, n: lax.cond(x[0] > 0, lambda: (x, x[0]), lambda: (-x, x[1])),
    "switch_of_three": lambda x, n: lax.switch(n - 2, [jnp.sin, jnp.cos, lambda y: y[::-1]], x),
    "select_n": lambda x, n: lax.select_n(jnp.clip(n, 0, 2), x, 2 * x, x + 1),
    "cond_in_scan": lambda x, n: lax.scan(
        lambda c, y: (lax.cond(y > 0, lambda: c + y, lambda: c * 0.5), lax.switch(n, [jnp.sin, jnp.cos], y)), x[0], x
    ),
    "loop_in_cond": lambda x, n: lax.cond(
        n > 1,
        lambda: lax.fori_loop(0, 3, lambda k, y: jnp.cos(y), x),
        lambda: lax.cond(x[0] > 0, lambda: jnp.exp(x), lambda: lax.scan(lambda c, y: (c, c * y), x[0], x)[1]),
    ),
    "shared_by_branches": lambda x, n: lax.cond(n > 2, lambda: jnp.tanh(x) + 1, lambda: jnp.tanh(x) * 2),
    "gradient_of_scan": lambda x, n: jax.grad(lambda x: lax.scan(lambda c, y: (jnp.sin(c + y), c), 0.0, x)[0])(x),
    "checkpoint": lambda x, n: jax.grad(jax.checkpoint(lambda x: jnp.sum(jnp.sin(x) ** 3)))(x),
    "custom_jvp": lambda x, n: (of_own_slope(x[0]), jax.grad(of_own_slope)(x[0])),
    "custom_vjp": lambda x, n: (of_own_pullback(x), jax.grad(of_own_pullback)(x)),
    "custom_root": lambda x, n: (root(x[0]), jax.grad(root)(x[0])),
    "newton": lambda x, n: lax.while_loop(
        lambda s: (jnp.abs(s**3 - 2) > 1e-5) & (s < 10), lambda s: s - (s**3 - 2) / (3 * s**2), 1 + 0.0 * n
    ),
}


def counted(y, n):
    """A loop whose condition compares a counter and a real number, and the number of its turns."""
    return lax.while_loop(lambda s: (s[1] < 20) & (s[0] ** 2 < n), lambda s: (1.7 * s[0], s[1] + 1), (y, 0))


MAPPED = {
    "while": lambda x, n: jax.vmap(lambda y: lax.while_loop(lambda s: s**2 < n, lambda s: s * 1.7, y))(x),
    "while_with_counter": lambda x, n: jax.vmap(lambda y: counted(y, n))(x),
    "while_twice": lambda x, n: jax.vmap(jax.vmap(lambda y: counted(y, n)))(x[:, None] + x[:3]),
    "while_of_rows": lambda x, n: jax.vmap(
        lambda y: lax.while_loop(lambda s: jnp.sum(s[0] ** 2) < n, lambda s: (s[0] * s[1], s[1] + 0.1), (y * x, 1.1))
    )(x),
    "while_in_scan": lambda x, n: lax.scan(lambda c, y: (c + 1, jax.vmap(lambda z: counted(z, n))(c * y)[0]), x, x),
    "fori_loop": lambda x, n: jax.vmap(lambda y, k: lax.fori_loop(0, k, lambda j, z: 1.1 * z + j, y))(
        x, n + jnp.arange(9) % 4
    ),
    "gradient": lambda x, n: jax.vmap(lambda y: jax.jvp(lambda y: counted(y, n)[0], (y,), (2.0,))[1])(x),
    "newton": lambda x, n: jax.vmap(
        lambda a: lax.while_loop(lambda s: jnp.abs(s * s - a) > 1e-3, lambda s: (s + a / s) / 2, 1 + a)
    )(1 + x * x),
    "bisection": lambda x, n: jax.vmap(
        lambda a: lax.while_loop(
            lambda s: s[1] - s[0] > 1e-3 * (1 + a),
            lambda s: (
                jnp.where(jnp.tanh((s[0] + s[1]) / 2) < a / (1 + a), (s[0] + s[1]) / 2, s[0]),
                jnp.where(jnp.tanh((s[0] + s[1]) / 2) < a / (1 + a), s[1], (s[0] + s[1]) / 2),
            ),
            (0.0 * a, 5.0 + a),
        )
    )(jnp.abs(x)),
    "cond": lambda x, n: jax.vmap(lambda y: lax.cond(y > 0, jnp.sin, lambda y: counted(1 + y * y, n)[0], y))(x),
    "exponential_integral": lambda x, n: special.exp1(jnp.abs(x) + 0.1),
}
APPLIED = {
    "changed": lambda x, i: (x.at[i].apply(lambda v: v * v), x.at[1].apply(jnp.sin), x.at[:, i[:2]].apply(jnp.cos)),
    "changed_by_mode": lambda x, i: [x.at[i, 0].apply(jnp.tanh, mode=mode) for mode in ("clip", "drop")],
    "changed_at_known": lambda x, i: (x.at[np.array([1, 1, 2])].apply(lambda v: 2 * v), x.at[2:, ::3].apply(jnp.exp)),
    "changed_in_rows": lambda x, i: jax.vmap(lambda row, k: row.at[k].apply(lambda v: v - 1))(x, i[:5]),
    "changed_integers": lambda x, i: (i.at[i].apply(lambda v: 3 * v), (i > 0).at[i].apply(jnp.logical_not)),
}
EMPTY = {
    "reductions": lambda z, x: (
        *(z.sum(), z.sum(0), z.prod(1), jnp.all(z > 0, 0), jnp.any(z > 0), z.max(1), z.max(0, initial=2)),
    ),
    "products": lambda z, x: (z.T @ z + x, z @ x, z @ z.T, jnp.einsum("ij,ik->jk", z, z)),
    "moves": lambda z, x: (
        *(jnp.pad(z, ((1, 2), (0, 1))), jnp.concatenate([z, x, z]), jnp.tile(z, (2, 2)), z.T.reshape(0, 3)),
        *(jnp.flip(z, 0), z[:, :1], jnp.stack([z, z], 1).sum((0, 1)), jnp.repeat(z, 3, axis=0)),
    ),
    "indices": lambda z, x: (
        *(x[z[:, 0].astype(int)], x.at[z[:, 0].astype(int)].set(z), x.at[:0].add(1.0), x.at[:0].apply(jnp.sin)),
        *(z[:, x[0].astype(int)], lax.dynamic_update_slice(x, z, (1, 2)), lax.dynamic_slice(z, (1, 2), (0, 2))),
    ),
    "order": lambda z, x: (jnp.sort(z, 0), jnp.sort(z, 1), jnp.cumsum(z, 0), jnp.argmin(z, 1), lax.cummax(z, 1)),
    "carried": lambda z, x: (
        lax.fori_loop(0, 3, lambda k, s: (2 * s[0], s[1] + k), (z, x)),
        lax.while_loop(lambda s: jnp.abs(s[1].sum()) < 9, lambda s: (2 * s[0], s[1] + 1), (z, x)),
    ),
    "scanned": lambda z, x: (
        lax.scan(lambda c, row: (c + row, c * row), x[0], z),
        lax.scan(lambda c, row: (c + row, row[:0]), x[0], x),
        lax.associative_scan(jnp.add, z),
    ),
    "branches": lambda z, x: (
        lax.cond(x[0, 0] > 0, lambda: (z, x), lambda: (2 * z, 2 * x)),
        lax.switch(jnp.sum(x > 0) % 3, [lambda: z.sum() + x, lambda: 2 * x, lambda: x]),
    ),
    "mapped": lambda z, x: jax.vmap(lambda y: counted(y, 3.0))(z[:, 0]),
    "factors": lambda z, x: (
        *(jnp.linalg.cholesky(z[:, :0]), jnp.linalg.inv(z[:, :0]), jnp.linalg.det(z[:, :0])),
        jnp.linalg.solve(x, x[:, :0]),
    ),
    "sums": lambda z, x: (jnp.polyval(z[:, 0], x), jnp.interp(z[:, 0], x[0], x[1]), jnp.searchsorted(z[:, 0], x[0])),
    "integers": lambda z, x: (z.astype(int).sum(), z.astype(int) // 3, ~(z > 0), jnp.nonzero(z > 0, size=2)[0]),
}  # fmt: skip
FACTORED = {
    "cholesky": lambda a, b: jnp.linalg.cholesky(definite(a)),
    **{
        f"triangular_solve_{''.join('ny'[flag] for flag in flags)}": lambda a, b, flags=flags: lax.linalg.triangular_solve(  # noqa: E501
            upper(a).T if flags[1] else upper(a),
            b if flags[0] else b.T,
            left_side=flags[0], lower=flags[1], transpose_a=flags[2], unit_diagonal=flags[3],
        )
        for flags in np.ndindex(2, 2, 2, 2)
    },
    "lu": lambda a, b: scipy_linalg.lu_factor(a)[0],
    "pivots": lambda a, b: lax.linalg.lu(a)[1:],
    "solve": lambda a, b: (jnp.linalg.solve(a, b), jnp.linalg.inv(a), jnp.linalg.det(a)),
    "solve_triangular": lambda a, b: scipy_linalg.solve_triangular(upper(a), b[:, 0], trans=1),
    "solve_definite": lambda a, b: scipy_linalg.cho_solve(scipy_linalg.cho_factor(definite(a)), b),
    "gradients_of_factors": lambda a, b: jax.grad(
        lambda a: jnp.sum(jnp.linalg.cholesky(definite(a))) + jnp.sum(scipy_linalg.solve(definite(a), b, assume_a="pos"))  # noqa: E501
    )(a),
    "gradient_of_solve": lambda a, b: jax.grad(
        lambda a: jnp.sum(jnp.linalg.solve(definite(a), b)) + jnp.linalg.det(a[:3, :3])
    )(a),
    "tangent_of_solve": lambda a, b: jax.jvp(jnp.linalg.solve, (a, b), (a.T, 2 * b))[1],
    "cholesky_of_any": lambda a, b: jnp.linalg.cholesky(a + a.T),
    "custom_linear_solve": lambda a, b: (matrix_free(a, b[:, 0]), jax.jacobian(matrix_free, 1)(a, b[:, 0])),
    "batched_solve": lambda a, b: jnp.linalg.solve(jnp.stack([a, a.T]), jnp.stack([b, 2 * b])),
    "batched_cholesky": lambda a, b: jnp.linalg.cholesky(jnp.stack([definite(a), 2 * definite(a)])),
}  # fmt: skip


def spectral(a, function):
    """A function of a symmetric matrix, which does not depend on the signs of eigenvectors."""
    values, vectors = jnp.linalg.eigh(a)
    return (vectors * function(values)) @ vectors.T


ORTHOGONAL = {
    "qr": lambda a, b: (jnp.linalg.qr(a), jnp.linalg.qr(a, mode="r")),
    "qr_of_tall": lambda a, b: (jnp.linalg.qr(jnp.vstack([a, b.T])), jnp.linalg.qr(b), jnp.linalg.qr(b, "complete")),
    "qr_of_wide": lambda a, b: (jnp.linalg.qr(b.T), jnp.linalg.qr(jnp.hstack([a, b]), mode="complete")),
    "qr_of_several": lambda a, b: jnp.linalg.qr(jnp.stack([a, 2 * a.T, upper(a)])),
    "reflectors": lambda a, b: (
        *lax.linalg.householder_product(a, jnp.tanh(a[0])),
        lax.linalg.householder_product(a, jnp.tanh(a[0, :1])),
    ),
    "gradient_of_qr": lambda a, b: jax.grad(lambda x: jnp.sum(jnp.sin(jnp.vstack(jnp.linalg.qr(x)))))(definite(a)),
    "eigh": lambda a, b: (spectral(a + a.T, jnp.sin), jnp.linalg.eigvalsh(a), jnp.linalg.eigh(definite(a))[0]),
    "eigh_of_a_triangle": lambda a, b: [
        (values, (vectors * values) @ vectors.T, vectors.T @ vectors)
        for lower in (True, False)
        for vectors, values in [lax.linalg.eigh(a, lower=lower, symmetrize_input=False)]
    ],
    "eigh_of_several": lambda a, b: jax.vmap(lambda x: spectral(x, jnp.tanh))(jnp.stack([a + a.T, definite(a)])),
    "eigh_of_equal_values": lambda a, b: (
        jnp.linalg.eigvalsh(jnp.outer(b[:, 0], b[:, 0])),
        spectral(2 * jnp.eye(a.shape[0], dtype=a.dtype) + jnp.outer(b[:, 0], b[:, 0]), jnp.cos),
    ),
    "gradient_of_eigh": lambda a, b: jax.grad(lambda x: jnp.sum(spectral(x + x.T, jnp.sin) * x))(a),
}
PRODUCTS = {
    "contraction": (
        lambda a, b: (jnp.einsum("bij,bjk->bik", a, b), jnp.einsum("bij,bjk->i", a, b), jnp.tensordot(a, b, 0)),
        (normal(2, 3, 4), normal(2, 4, 5)),
    ),
    "several_axes": (
        lambda a, b: (jnp.tensordot(a, b, ((0, 2), (2, 0))), jnp.einsum("ijk,kli->jl", a, b)),
        (normal(3, 4, 2), normal(2, 5, 3)),
    ),
    "outer": (lambda a, b: (jnp.outer(a, b), jnp.kron(a, b), jnp.cross(a, b), jnp.vdot(a, b)), (normal(3), normal(3))),
    "large_batch": (lambda a, b: jnp.einsum("bij,bkj->bki", a, b), (normal(5, 9, 17), normal(5, 20, 17))),
    "many_rows": (lambda a, b: a @ b, (normal(40, 33), normal(33, 70))),
    **{
        f"matrix_vector_{n}": (
            lambda a, x: (a @ x, x @ a.T, jnp.sin(a @ jnp.tanh(x))),
            (normal(n, n) / n**0.5, normal(n)),
        )
        for n in SIZES
    },
    **{
        f"constant_matrix_{n}": (
            lambda x, w=SQUARE[n]: jax.jvp(lambda x: jnp.tanh(x @ of(x, w)) @ of(x, w), (x,), (x[::-1],)),
            (normal(n),),
        )
        for n in SIZES
    },
    **{f"wide_{n}": (lambda x, w=WIDE[n]: (x @ of(x, w)) @ of(x, w).T, (normal(3, 5),)) for n in SIZES},
    **{
        f"vector_{n}": (
            lambda x, y: (jnp.sin(x) * y + 1, x.sum(), x.max(), x @ y, jnp.where(x > y, x, y), jnp.exp(-x * x).sum()),
            (normal(n), normal(n)),
        )
        for n in SIZES
    },
    **{
        f"{name}_{n}": (function, (normal(n, n), normal(n, 2)))
        for n in (1, 3, 9)
        for place, (name, function) in enumerate(FACTORED.items())
        # Matrices of 3 rows are unrolled and those of 9 rows are not; every other rule is tried on either.
        if n == (3, 9)[place % 2] or name in ("cholesky", "solve", "custom_linear_solve", "lu")
    },
}
DIVISIONS = {
    f"{name}_of_{np.dtype(kind)}": (
        division,
        (
            np.array([5, 2**31 - 7, 0, np.iinfo(kind).min, np.iinfo(kind).max, np.iinfo(kind).min], kind),
            np.array([0, 0, 0, -1 if np.iinfo(kind).min else 7, 3, 1], np.int64).astype(kind),
        ),
    )
    for name, division in {"div": lax.div, "rem": lax.rem, "floor_divide": jnp.floor_divide, "mod": jnp.mod}.items()
    for kind in (np.int32, np.int64, np.uint32, np.uint64)
    if not (np.iinfo(kind).max > 2**62 and name in ("floor_divide", "mod"))
}
"""By zero, and of the least number by -1."""
HALFWAY = np.array([1 / 3, 1 + 2**-11, 1 + 3 * 2**-11, 65504.0, 65519.0, 65520.0, 6e-5, 6.1e-5, 3e-8, 2e38, 3.4e38])
ROUNDED = {
    f"reduce_precision_{exponent}_{mantissa}": (
        lambda x, bits=(exponent, mantissa): lax.reduce_precision(x, *bits),
        (np.concatenate([SPECIAL, HALFWAY, -HALFWAY]),),
    )
    for exponent, mantissa in ((5, 10), (8, 7), (8, 23), (11, 52), (8, 52), (11, 3), (5, 23))
}
TYPES = {
    "integer_exponents": (
        lambda x, n: (x**n, x ** n.astype(jnp.int32)),
        (np.array([0.3, -1.2, 2.5]), np.array([2, 3, -1])),
    ),
    "saturating_conversions": (
        lambda x: [(1e17 * x).astype(kind) for kind in (jnp.int32, jnp.int64, jnp.uint32, jnp.uint64)],
        (SPECIAL,),
    ),
    "signs_of_zero": (lambda x: (1 / (0 - x), 1 / -x), (np.array([0.0, -0.0, 2.0]),)),
    "whole_and_fraction": (jnp.modf, (np.array([0.5, -1.75, 3.0, -0.0]),)),
    **{f"result_read_by_another_{n}": (lambda x: (2 * x, 2 * x + 1), (normal(n),)) for n in (1, 7, 8, 64, 65)},
    "result_read_in_a_loop": (
        lambda x: (2 * x, lax.fori_loop(0, 3, lambda k, y: y + 2 * x, x), (2 * x)[::-1], (2 * x).sum()),
        (normal(12),),
    ),
    "unused": (
        lambda x: lax.scan(lambda c, y: ((c[0] + y, c[1] * 2, y), (c[1], c[2] + x[0])), (x[0], x, x[1]), x)[0][0],
        (normal(9),),
    ),
}
INTERFACES = {
    "integers": (lambda n, flags, x: {"n": n + 1, "flags": ~flags, "y": jnp.where(flags, x, n)},
                 (np.array([3, -2]), np.array([True, False]), normal(2))),
    "by_value": (lambda a, k, flag, x: {"y": a * x, "z": jnp.where(flag, k, -k)},
                 (normal(), np.int64(4), np.bool_(True), normal(3))),
    "small_integers": (lambda i, u: (i * 2, u // 3), (np.arange(4, dtype=np.int32), np.arange(4, dtype=np.uint32))),
    "returned": (lambda x: x @ x, (normal(3),)),
    "returned_integer": (lambda x: jnp.argmax(x), (normal(3),)),
    "returned_bool": (lambda x: jnp.all(x > 0), (normal(3),)),
    "trees": (
        lambda state, layers: {"next": {"q": state["q"] + state["qd"], "qd": -state["qd"]}, "y": layers[0][0] @ state["q"]},  # noqa: E501
        ({"q": normal(2), "qd": normal(2)}, [(normal(2, 2), normal(2))]),
    ),
    "empty": (lambda x, y: (x, y.sum(), jnp.concatenate([x, y]), y @ x), (normal(0), normal(0))),
    "of_constants": (lambda x: (jnp.ones(3), jnp.zeros(()), jnp.arange(4.0)), (normal(2),)),
    "unchanged": (lambda x, y: (y, x, x), (normal(3), normal(3))),
}  # fmt: skip
SORTED = {
    "sort_along_axes": lambda x: (
        *(jnp.sort(x, 0), jnp.sort(x, 1), jnp.sort(x, None), jnp.argsort(x, 0), jnp.argsort(x, 1), jnp.median(x, 1)),
        *(jnp.sort(x, 0, descending=True), jnp.argsort(-x, 1, stable=False), jnp.sort(x.reshape(3, 4, 3), 1)),
    ),
    "sort_by_several": lambda x: (
        lax.sort((jnp.round(x), x, lax.broadcasted_iota(int, x.shape, 0)), 0, num_keys=2),
        lax.sort((jnp.round(x), x, x[::-1]), 1, num_keys=1),
        lax.sort((x > 0, jnp.isfinite(x), jnp.sign(x), jnp.arange(36).reshape(6, 6) % 5, x), 0, num_keys=4),
        jnp.lexsort((x[0], jnp.sign(x[0]))),
    ),
    "sort_of_integers": lambda x: [
        (jnp.sort(k, 0), jnp.argsort(k, 1), jnp.sort(k, None), jnp.argsort(k[:, 0] > 0))
        for whole in [(jnp.nan_to_num(x, posinf=9, neginf=-9) * 3).astype(int)]
        for k in (whole, whole.astype(jnp.int32), whole.astype(jnp.uint32), whole.astype(jnp.uint64))
    ],
    "sort_of_known": lambda x: (jnp.sort(jnp.sin(jnp.arange(9.0) ** 2)), x[jnp.argsort(jnp.array([3, 1, 5, 1, 2, 0]))]),
    "sort_and_search": lambda x: (
        *(jnp.unique(x, size=20, fill_value=0), jnp.searchsorted(jnp.sort(x[0]), x)),
        *(jnp.searchsorted(jnp.sort(x[1]), x, side="right"), jnp.ravel(x)[jnp.argsort(x, None)][:3]),
        *(jnp.sort(x[:, :1], 1), jnp.sort(x[:0], 0), jnp.sort(x[0, :2])),
    ),
    "sort_in_a_loop": lambda x: lax.scan(
        lambda c, row: (jnp.sort(c + row), (jnp.argsort(row), jnp.sort(x, 0))), x[0], x
    ),
    "sort_of_many": lambda x: jnp.sort((x[:, :, None] * jnp.cos(jnp.arange(80.0) ** 2)).reshape(6, 480), 1),
}
CASES = {
    **{f"of_{name}": (function, (SPECIAL,)) for name, function in UNARY.items()},
    **{f"of_two_{name}": (function, (SPECIAL, RANDOM.permutation(SPECIAL))) for name, function in BINARY.items()},
    "broadcast_add": (jnp.add, (normal(1), normal(9))),
    **{f"of_integers_{name}": (function, (INTEGERS, INTEGERS[::-1].copy())) for name, function in ON_INTEGERS.items()},
    **{name: (function, (normal(5, 7),)) for name, function in MOVES.items()},
    **{name: (function, (normal(5, 7), np.array([3, 0, -1, 9, 3, -8, 1]))) for name, function in INDEXED.items()},
    **{name: (function, (normal(4), np.int64(3))) for name, function in CONTROL.items()},
    **{f"mapped_{name}": (function, (normal(9), np.int64(3))) for name, function in MAPPED.items()},
    **{name: (function, (normal(5, 7), np.array([3, 0, -1, 9, 3, -8, 1]))) for name, function in APPLIED.items()},
    **{f"empty_{name}": (function, (np.zeros((0, 3)), normal(3, 3))) for name, function in EMPTY.items()},
    **PRODUCTS,
    **DIVISIONS,
    **ROUNDED,
    **TYPES,
    **INTERFACES,
    **{f"of_two_{name}": (function, (SPECIAL, RANDOM.permutation(SPECIAL))) for name, function in ON_TWO_MORE.items()},
    **{
        f"of_integers_{name}": (function, (INTEGERS, INTEGERS[::-1].copy()))
        for name, function in ON_INTEGERS_MORE.items()
    },
    **{
        name: (function, (np.concatenate([SPECIAL, RANDOM.permutation(SPECIAL)]).reshape(6, 6),))
        for name, function in SORTED.items()
    },
    **{
        f"{name}_{n}": (function, (normal(n, n), normal(n, 2)))
        for n in (1, 3, 9)
        for name, function in ORTHOGONAL.items()
        if n == 9 or name in ("qr", "qr_of_tall", "eigh")
    },
    "gradient_of_sort": (
        jax.grad(lambda x: jnp.sort(x, 1)[:, 0] @ jnp.sort(x, 0)[2, :5] + jnp.median(x)),
        (normal(5, 7),),
    ),
}
"""Function and first example of each of its arguments."""


def drawn(leaf, random):
    """Another of the same sort."""
    leaf = np.asarray(leaf)
    if leaf.dtype.kind == "f" and np.isfinite(leaf).all():
        return random.normal(size=leaf.shape)
    return random.permutation(leaf.ravel()).reshape(leaf.shape)


NOT_FINITE = {
    **{f"{name}_{n}": (np.nan,) * ("cholesky" in name) for name in FACTORED for n in (1, 3, 9)},
    **{f"{name}_{n}": () for name in ORTHOGONAL for n in (1, 3, 9)},
    "gradient_of_max": (),
}
"""Inputs of some cases; the others get NaN and infinities. LAPACK makes finite numbers of infinities, and of
NaN by LU, and XLA of 0 times NaN where 0 is a truth value that is false: C does not."""


def states_of(name, examples):
    """The example, some more, and some with one number that is not finite."""
    random = np.random.default_rng(6)
    states = [examples, *(jax.tree.map(lambda leaf: drawn(leaf, random), examples) for _ in range(3))]
    leaves, tree = jax.tree.flatten(examples)
    for place, leaf in enumerate(leaves):
        if np.asarray(leaf).dtype.kind != "f" or leaf.size == 0 or not np.isfinite(leaf).all():
            continue
        for value in NOT_FINITE.get(name, (np.nan, np.inf, -np.inf)):
            changed = leaf.copy()
            changed[np.unravel_index(random.integers(leaf.size), leaf.shape)] = value
            states.append(tree.unflatten([*leaves[:place], changed, *leaves[place + 1 :]]))
    if any(np.asarray(leaf).dtype.kind in "iu" and np.ndim(leaf) == 0 for leaf in leaves):
        states += [
            jax.tree.map(
                lambda leaf, k=k: np.asarray(k, np.asarray(leaf).dtype) if np.ndim(leaf) == 0 else leaf, examples
            )
            for k in (0, 2)
        ]
    return states


STATES = {name: states_of(name, examples) for name, (_, examples) in CASES.items()}


SINGLE = {
    *(f"of_{name}" for name in UNARY), *(f"of_two_{name}" for name in ON_TWO_MORE), *INTERFACES, *list(CASES)[::8]
}  # fmt: skip
"""Tried in single precision too by default: both sorts of elementary functions, types, some others."""


@needs_compiler
@pytest.mark.parametrize("precision", BOUND)
def test_a_primitive_gives_what_it_gives_in_jax(precision, pytestconfig, tmp_path):
    """All are exported and compiled at once; `--every-export` takes all of them in single precision too."""
    every = pytestconfig.getoption("--every-export") or precision == "f64"
    cases = {name: pair for name, pair in CASES.items() if every or name in SINGLE}
    got, expected = in_c(cases, STATES, tmp_path, precision=precision), in_jax(cases, STATES, precision=precision)
    wrong = {}
    for name in cases:
        try:
            for ours, theirs in zip(got[name], expected[name], strict=True):
                assert_equal(ours, theirs, BOUND[precision])
        except AssertionError as error:
            wrong[name] = str(error)
    assert not wrong, "\n".join(f"{name}: {error}" for name, error in wrong.items())


def assert_equal(ours, theirs, bound):
    assert ours.shape == theirs.shape
    if theirs.dtype.kind == "f":
        np.testing.assert_allclose(ours, theirs, rtol=bound, atol=bound)
    else:
        np.testing.assert_array_equal(ours, theirs)
