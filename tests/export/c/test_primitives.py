"""Each primitive, in each of its modes, gives in C what it gives in JAX, on what is not finite too.

Random programs have loops and branches within each other, reversed scans, and arrays that are moved.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from comparison import BOUND, in_c, in_jax
from compilers import needs_compiler
from conftest import slow_among
from jax import lax
from jax.extend.core import primitives as of_jax
from jax.scipy import linalg as scipy_linalg

RANDOM = np.random.default_rng(5)
SPECIAL = np.array(
    [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 1.5, 2.5, -2.5, 3.0, 1e-9, -1e-9, 700.0, -700.0, 30.0, np.nan, np.inf, -np.inf]
)
INTEGERS = np.array([0, 1, -1, 7, -7, 2, 3, -3, 12, 100])
PLACES = np.array([3, 0, -1, 9, 3, -8, 1])
"""Indices inside and outside of an axis of five, some of them twice."""
KINDS = (jnp.int32, jnp.int64, jnp.uint32, jnp.uint64)
ORDERS = ("lt_to", "le_to")


def normal(*shape):
    return RANDOM.normal(size=shape)


def wide(number, kind=np.int64):
    """A 64-bit whole number, cut to what JAX has of it in single precision."""
    return np.array(number, kind).astype(jax.dtypes.canonicalize_dtype(kind))


def named(names, *modules):
    """Functions of the first module that has them, by name."""
    return {name: next(getattr(module, name) for module in modules if hasattr(module, name)) for name in names.split()}


UNARY = {
    **named("abs negative exp exp2 expm1 log log1p sin cos tan sinh cosh tanh sqrt cbrt floor ceil round trunc", jnp),
    **named("arcsin arccos arctan arcsinh arccosh arctanh sign square isfinite isnan isinf logical_not", jnp),
    **named("rsqrt logistic erf erfc lgamma stop_gradient", lax),
    "round_away": lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO),
    "integer_pow": lambda x: [lax.integer_pow(x, n) for n in (0, 2, 3, 7, -1, -3)],
    "clamp": lambda x: lax.clamp(x.dtype.type(-0.7), x, x.dtype.type(0.9)),
    "copysign_and_frexp": lambda x: (jnp.copysign(x, jnp.flip(x)), jnp.frexp(jax.device_put(x))),
    "converted": lambda x: (jnp.where(jnp.abs(x) < 100, x, 0).astype(int), x.astype(bool)),
    "saturating_conversions": lambda x: [(1e17 * x).astype(kind) for kind in KINDS],
    "reduce_precision": lambda x: [
        lax.reduce_precision(x, *bits) for bits in ((5, 10), (8, 7), (8, 23), (11, 52), (8, 52), (11, 3), (5, 23))
    ],
}
HALFWAY = np.array([1 / 3, 1 + 2**-11, 1 + 3 * 2**-11, 65504.0, 65519.0, 65520.0, 6e-5, 6.1e-5, 3e-8, 2e38, 3.4e38])


def in_total_order(a, b):
    """NaN has the sign that is written in the program: that of a computed one depends on the processor."""
    number = jnp.where(a == a, a, 0)
    nan = jnp.full_like(a, np.nan)
    return [
        getattr(of_jax, f"{name}_p").bind(*pair)
        for name in ORDERS
        for pair in ((number, jnp.where(b == b, b, 1)), (a, a), (number, nan))
    ]


BINARY = {
    **named("add sub mul div max min pow atan2 rem", lax),
    **named("equal not_equal less less_equal greater greater_equal mod floor_divide hypot logaddexp", jnp),
    "nextafter": lambda a, b: (lax.nextafter(a, b), lax.nextafter(a, a), lax.nextafter(a, 0 * a)),
    "total_order": in_total_order,
}
SHIFTS = (lax.shift_left, lax.shift_right_logical, lax.shift_right_arithmetic)
ON_INTEGERS = {
    **named("add subtract multiply maximum minimum less equal bitwise_and bitwise_or bitwise_xor", jnp),
    "of_one": lambda a, b: (jnp.abs(a), ~a, jnp.sign(a), a**3, a.astype(float) * b, a / (b | 1)),
    "reductions": lambda a, b: (a.sum(), b.prod(), a.max(), b.min(), jnp.argmin(a), jnp.cumsum(b)),
    "wrapped": lambda a, b: (
        a * wide(2**62 + 3),
        a + wide(2**63 - 1),
        a.astype(jnp.int32) * 77777 * b.astype(jnp.int32) ** 5,
    ),
    "unsigned": lambda a, b: (
        *(a.astype(jnp.uint32) - 5, -a.astype(jnp.uint64), jnp.sign(a.astype(jnp.uint32)), a.astype(jnp.uint32) < 0),
        *(a.astype(jnp.uint64) >= 0, a.astype(jnp.uint32) // 3, wide(2**63 + 5, np.uint64) + a.astype(jnp.uint64)),
    ),
    "one_bit": lambda a, b: (a & 1, a | 0, a ^ 0, a & -1, (a & 3) * b),
    "constants": lambda a, b: (
        *(a + wide(2**53 + 1) // 3, a + lax.div(wide(-(2**53) - 1), wide(2)), a + wide(-(2**63))),
        a.astype(jnp.int32) + jnp.int32(-(2**31)),
    ),
    "compared_with_itself": lambda a, b: (a == a, a != a, a <= a, a < a, jnp.maximum(a, a), a[:3].max()),
    "truths": lambda a, b: (
        *((a > 0) == (b > 0), (a > 0) < (b > 0), (a > 0) >= (b > 0), jnp.maximum(a > 0, b > 0), (a > 0).max()),
        *((a > 0) <= True, jnp.dot(a > 0, b > 0), jnp.sum(a > 0), jnp.where(a > 0, 2, 3) != 0),
    ),
    "bits_that_differ": lambda a, b: (
        *((a[:3] | -2) != 0, (b[:3] & 3) == 4, (a[:3].astype(jnp.uint32) | 3) == 4, ((a | -2).astype(bool) & (b > 0))),
    ),
    "products": lambda a, b: (
        *(a @ b, jnp.dot(a.astype(jnp.uint32), b.astype(jnp.uint32)), a[(b @ b) % 3]),
        *((jnp.outer(a, b) @ jnp.outer(b, a)) % 3, (a * 30370005) @ (b * wide(4611686018427))),
    ),
    "product_to_wider": lambda a, b: lax.dot(
        a.astype(jnp.int32) * 99999, b.astype(jnp.int32), preferred_element_type=jnp.int64
    ),
    "filled": lambda a, b: (a.at[b].get(mode="fill"), a.astype(jnp.uint32).at[b].get(mode="fill")),
    "shifts": lambda a, b: [
        shift(a.astype(kind), by.astype(kind)) for shift in SHIFTS for kind in KINDS for by in (b + 25, b % 3 + 30)
    ],
    "shifts_of_constants": lambda a, b: [
        a.astype(jnp.int32) + shift(jnp.int32(-(2**30) - 5), jnp.int32(by)) for shift in SHIFTS for by in (1, 31, 32)
    ],
    "unsigned_beside_some_zeros": lambda a, b: [
        compare(*pair)
        for kind in (jnp.uint32, jnp.uint64)
        for x in (a[:3].astype(kind), a.astype(kind))
        for known in (jnp.array([0, 7, 1] + [0] * (len(x) - 3), kind),)
        for compare in (jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal, jnp.maximum, jnp.minimum)
        for pair in ((x, known), (known, x))
    ],
    "total_order": lambda a, b: [
        getattr(of_jax, f"{name}_p").bind(*pair)
        for name in ORDERS
        for pair in ((a, b), (a.astype(jnp.uint32), b.astype(jnp.uint32)), (a > 0, b > 0))
    ],
}
MOVES = {
    "slice": lambda x: (x[::2, 1:6:3], x[::-1, ::-2], x[-1], x[1, 2], x[:, None, 2:3]),
    "transpose": lambda x: (x.T.reshape(5, 7), jnp.swapaxes(x.reshape(5, 7, 1), 0, 2)),
    "pad": lambda x: (
        lax.pad(x, x.dtype.type(2), ((1, 2, 0), (0, 1, 2))),
        lax.pad(x, x.dtype.type(2), ((-1, 1, 1), (2, -3, 0))),
        lax.pad(x, x[0, 0], ((-2, -2, 1), (-1, -1, 3))),
    ),
    "concatenate": lambda x: (jnp.concatenate([x, 2 * x, x[:1]]), jnp.stack([x, -x], axis=1)),
    "unstack": lambda x: [3 * column for column in jnp.unstack(x, axis=1)[:3]] + list(jnp.split(x, [2, 3])),
    "triangles": lambda x: (jnp.triu(x, 1), jnp.diag(x[:, 0]), jnp.diagonal(x)),
    "reductions": lambda x: (
        *(x.sum(0), x.sum(1), x.sum(), x.prod(1), x.max(0), x.min((0, 1)), x.var(1), x[:, :2].sum(1)),
        *((x > 0).all(1), (x > 1).any(0), (x[..., None] * x[0]).max((0, 1))),
    ),
    "arguments": lambda x: (
        *(jnp.argmax(x, 0), jnp.argmin(x, 1), jnp.argmax(x), jnp.nanargmin(x)),
        jnp.argmax(jnp.where(x > 0, jnp.nan, x), 1),  # the first of several NaN
    ),
    "cumulative": lambda x: (
        *(jnp.cumsum(x, 0), lax.cumsum(x, 1, reverse=True), jnp.cumprod(x, 1)),
        *(lax.cummax(x, 1), lax.cummin(x, 0, reverse=True)),
    ),
}
INDEXED = {
    "gather": lambda x, i: (x[i], x[0, i], x[i, i[::-1]], x[:, i]),
    "gather_outside": lambda x, i: (
        [x.at[i].get(mode=mode) for mode in ("clip", "fill")] + [x.at[0, i].get(mode="fill", fill_value=-3.0)]
    ),
    "gather_known": lambda x, i: (x[np.array([0, 4, 4])], x[np.array([True, False, True, False, True])]),
    "scatter": lambda x, i: [
        getattr(x.at[i], name)(2.5 + x[0], mode=mode)
        for name, mode in [("add", "clip"), ("add", None)]
        + [(name, "drop") for name in ("set", "add", "subtract", "multiply", "min", "max")]
    ],
    "scatter_duplicates": lambda x, i: (x.at[i % 2].add(1.5), x.at[:, i % 2].mul(1.5), x.at[i % 2, 0].max(0.3)),
    "scatter_known": lambda x, i: (
        *(x.at[1].set(0.0), x.at[:, 2].add(x[0, 0]), x.at[1:3, ::2].mul(3.0), x.at[np.array([1, 1, 2])].add(1.0)),
        *(x.at[2, 3].set(i[0]), x.at[np.array([1, 1])].min(0.0)),
    ),
    "scatter_triangles": lambda x, i: jax.vmap(  # a loop cannot follow its places
        lambda row: jnp.zeros((4, 4), x.dtype).at[np.tril_indices(4)].add(jnp.tile(row, 2)[:10]).at[1].mul(row[1])
    )(x),
    "dynamic_slice": lambda x, i: (
        lax.dynamic_slice(x, (i[0], i[1]), (2, 3)),
        lax.dynamic_update_slice(x, 2 * x[:2, :3], (i[0], i[1])),
        lax.dynamic_slice_in_dim(x, i[2], 4, axis=1),
    ),
    "changed": lambda x, i: (x.at[i].apply(lambda v: v * v), x.at[1].apply(jnp.sin), x.at[:, i[:2]].apply(jnp.cos)),
    "changed_by_mode": lambda x, i: [x.at[i, 0].apply(jnp.tanh, mode=mode) for mode in ("clip", "drop")],
    "changed_at_known": lambda x, i: (x.at[np.array([1, 1, 2])].apply(lambda v: 2 * v), x.at[2:, ::3].apply(jnp.exp)),
    "changed_integers": lambda x, i: (i.at[i].apply(lambda v: 3 * v), (i > 0).at[i].apply(jnp.logical_not)),
}


@jax.custom_jvp
def of_own_slope(x):
    return x * x


of_own_slope.defjvp(lambda primals, tangents: (of_own_slope(*primals), 3 * tangents[0]))


@jax.custom_vjp
def of_own_pullback(x):
    return jnp.sum(x * x)


of_own_pullback.defvjp(lambda x: (of_own_pullback(x), x), lambda x, pulled: (5 * pulled * x,))


def root(x):
    def solve(f, start):
        return lax.fori_loop(0, 30, lambda _, y: y - f(y) / (3 * y * y + 1), start)

    return lax.custom_root(lambda y: y**3 + y - x, jnp.ones_like(x), solve, lambda g, y: y / g(jnp.ones_like(y)))


def counted(y, n):
    """A loop whose condition compares a counter and a real number, and the number of its turns."""
    return lax.while_loop(lambda s: (s[1] < 20) & (s[0] ** 2 < n), lambda s: (1.7 * s[0], s[1] + 1), (y, 0))


CONTROL = {
    "while": lambda x, n: lax.while_loop(lambda s: s[1] < n, lambda s: (s[0] * 0.9 + x, s[1] + 1), (x, 0)),
    "while_swapped": lambda x, n: lax.while_loop(
        lambda s: lax.cond(n > 2, jnp.any, lambda k: k < 2, s[2] ** 2),
        lambda s: (s[1], s[0] + 1, s[2] + 1),
        (x, 2 * x, 0),
    ),
    "while_without_turn": lambda x, n: lax.while_loop(lambda y: jnp.all(y != y), lambda y: y + 1, 0 * x + 1),
    "scan_of_rows": lambda x, n: lax.scan(
        lambda c, y: ((c[0] + y["a"], c[1] @ y["b"]), (y["a"] * 2, c[1])),
        (x, jnp.eye(2)),
        {"a": jnp.outer(x[:3], x), "b": jnp.ones((3, 2, 2)) * x[:2]},
    ),
    "select_n": lambda x, n: lax.select_n(jnp.clip(n, 0, 2), x, 2 * x, x + 1),
    "shared_by_branches": lambda x, n: lax.cond(n > 2, lambda: jnp.tanh(x) + 1, lambda: jnp.tanh(x) * 2),
    "own_derivatives": lambda x, n: (
        *(of_own_slope(x[0]), jax.grad(of_own_slope)(x[0]), of_own_pullback(x), jax.grad(of_own_pullback)(x)),
        *(root(x[0]), jax.grad(root)(x[0]), jax.checkpoint(jnp.sin)(x)),
    ),
    "mapped_while": lambda x, n: jax.vmap(jax.vmap(lambda y: counted(y, n)))(x[:, None] + x[:3]),
    "mapped_while_of_rows": lambda x, n: jax.vmap(
        lambda y: lax.while_loop(lambda s: jnp.sum(s[0] ** 2) < n, lambda s: (s[0] * s[1], s[1] + 0.1), (y * x, 1.1))
    )(x),
    "mapped_while_in_scan": lambda x, n: lax.scan(
        lambda c, y: (c + 1, jax.vmap(lambda z: counted(z, n))(c * y)[0]), x, x
    ),
    "mapped_cond": lambda x, n: jax.vmap(lambda y: lax.cond(y > 0, jnp.sin, lambda y: counted(1 + y * y, n)[0], y))(x),
}
EMPTY = {
    "reductions": lambda z, x: (z.sum(), z.prod(1), jnp.all(z > 0, 0), z.max(1), z.max(0, initial=2), jnp.argmin(z, 1)),
    "moves": lambda z, x: (
        *(jnp.pad(z, ((1, 2), (0, 1))), jnp.concatenate([z, x, z]), z.T.reshape(0, 3), jnp.sort(z, 0), jnp.sort(z, 1)),
        *(jnp.cumsum(z, 0), lax.cummax(z, 1), z.astype(int) // 3, jnp.nonzero(z > 0, size=2)[0]),
    ),
    "indices": lambda z, x: (
        *(x[z[:, 0].astype(int)], x.at[z[:, 0].astype(int)].set(z), x.at[:0].add(1.0), x.at[:0].apply(jnp.sin)),
        *(z[:, x[0].astype(int)], lax.dynamic_update_slice(x, z, (1, 2)), lax.dynamic_slice(z, (1, 2), (0, 2))),
    ),
    "factors": lambda z, x: (jnp.linalg.cholesky(z[:, :0]), jnp.linalg.inv(z[:, :0]), jnp.linalg.solve(x, x[:, :0])),
}


def definite(a):
    return a @ a.T + a.shape[0] * jnp.eye(a.shape[0], dtype=a.dtype)


def upper(a):
    return jnp.triu(a) + 3 * jnp.eye(a.shape[0], dtype=a.dtype)


def triangular_solves(a, b):
    return [
        lax.linalg.triangular_solve(
            upper(a).T if lower else upper(a),
            b if left else b.T,
            left_side=left,
            lower=lower,
            transpose_a=transposed,
            unit_diagonal=unit,
        )
        for left, lower, transposed, unit in np.ndindex(2, 2, 2, 2)
    ]


def matrix_free(a, b):
    m = definite(a)
    return lax.custom_linear_solve(
        lambda x: m @ x, b, lambda _, right: jnp.linalg.solve(m, right), lambda _, right: jnp.linalg.solve(m.T, right)
    )


def spectral(a, function):
    """A function of a symmetric matrix, which does not depend on the signs of eigenvectors."""
    values, vectors = jnp.linalg.eigh(a)
    return (vectors * function(values)) @ vectors.T


CHOLESKY = {
    "cholesky": lambda a, b: jnp.linalg.cholesky(jnp.stack([definite(a), 2 * definite(a)])),
    "cholesky_of_any": lambda a, b: jnp.linalg.cholesky(a + a.T),
}
FACTORED = {
    "triangular_solves": triangular_solves,
    "lu": lambda a, b: (lax.linalg.lu(a), scipy_linalg.lu_factor(jnp.hstack([a, b]))[0]),
    "solve": lambda a, b: (jnp.linalg.solve(jnp.stack([a, a.T]), jnp.stack([b, 2 * b])), jnp.linalg.det(a)),
    "custom_linear_solve": lambda a, b: (matrix_free(a, b[:, 0]), jax.jacobian(matrix_free, 1)(a, b[:, 0])),
    "qr": lambda a, b: (jnp.linalg.qr(jnp.stack([a, 2 * a.T])), jnp.linalg.qr(a, mode="r")),
    "qr_of_tall": lambda a, b: (jnp.linalg.qr(jnp.vstack([a, b.T])), jnp.linalg.qr(b, "complete")),
    "qr_of_wide": lambda a, b: (jnp.linalg.qr(b.T), jnp.linalg.qr(jnp.hstack([a, b]), mode="complete")),
    "reflectors": lambda a, b: lax.linalg.householder_product(a, jnp.tanh(a[0, :1])),
    "times_reflectors": lambda a, b: (
        lax.linalg.ormqr(a, jnp.tanh(a[0]), b, transpose=True),
        lax.linalg.ormqr(a, jnp.tanh(a[0]), b.T, left=False),
    ),
    "eigh": lambda a, b: (
        jax.vmap(lambda x: spectral(x, jnp.tanh))(jnp.stack([a + a.T, definite(a)])),
        jnp.linalg.eigvalsh(jnp.outer(b[:, 0], b[:, 0])),
    ),
    "eigh_of_a_triangle": lambda a, b: [
        (values, (vectors * values) @ vectors.T)
        for lower in (True, False)
        for vectors, values in [lax.linalg.eigh(a, lower=lower, symmetrize_input=False)]
    ],
    "gradient_of_eigh": lambda a, b: jax.grad(lambda x: jnp.sum(spectral(x + x.T, jnp.sin) * x))(a),
}


def products_of(n):
    """Products with arguments and with constants, and what is done to their elements; and an example of each."""
    square, wide = normal(n, n) / n**0.5, normal(5, n) / n**0.5

    def products(a, x, y, rows):
        w, v = (jnp.asarray(constant, x.dtype) for constant in (square, wide))
        both = jax.jvp(lambda x: jnp.tanh(x @ w) @ w, (x,), (x[::-1],))
        elements = (jnp.sin(x) * y + 1, x.sum(), x.max(), jnp.where(x > y, x, y), jnp.exp(-x * x).sum())
        return a @ x, x @ a.T, jnp.sin(a @ jnp.tanh(x)), both, (rows @ v) @ v.T, elements

    return products, (square, normal(n), normal(n), normal(3, 5))


PRODUCTS = {
    "contraction": (
        lambda a, b: (jnp.einsum("bij,bjk->bik", a, b), jnp.einsum("bij,bjk->i", a, b), jnp.tensordot(a, b, 0)),
        (normal(2, 3, 4), normal(2, 4, 5)),
    ),
    "large_batch": (lambda a, b: jnp.einsum("bij,bkj->bki", a, b), (normal(5, 9, 17), normal(5, 20, 17))),
    "many_rows": (lambda a, b: a @ b, (normal(40, 33), normal(33, 70))),
    # Unrolled, loops, and tiles with a remainder.
    **{f"products_{n}": products_of(n) for n in (1, 3, 33, 130)},
}
DIVISIONS = {
    f"division_of_{np.dtype(kind)}": (
        lambda a, b, kind=kind: [
            *(lax.div(a, b), lax.rem(a, b)),
            # JAX itself gives other remainders of the largest unsigned numbers.
            *([] if np.iinfo(kind).max > 2**62 else [a // b, a % b]),
        ],
        (
            np.array([5, 2**31 - 7, 0, np.iinfo(kind).min, np.iinfo(kind).max, np.iinfo(kind).min], kind),
            np.array([0, 0, 0, -1 if np.iinfo(kind).min else 7, 3, 1], np.int64).astype(kind),
        ),
    )
    for kind in KINDS
}
"""By zero, and of the least number by -1."""
TYPES = {
    "integer_exponents": (
        lambda x, n: (x**n, x ** n.astype(jnp.int32)),
        (np.array([0.3, -1.2, 2.5]), np.array([2, 3, -1])),
    ),
    "signs_of_zero": (lambda x: (1 / (0 - x), 1 / -x), (np.array([0.0, -0.0, 2.0]),)),
    "results_read_by_others": (lambda xs: [(2 * x, 2 * x + 1) for x in xs], ([normal(n) for n in (1, 8, 65)],)),
    "unused": (
        lambda x: lax.scan(lambda c, y: ((c[0] + y, c[1] * 2, y), (c[1], c[2] + x[0])), (x[0], x, x[1]), x)[0][0],
        (normal(9),),
    ),
}
INTERFACES = {
    "arrays": (
        lambda n, flags, x: {"n": n + 1, "flags": ~flags, "y": jnp.where(flags, x, n)},
        (np.array([3, -2]), np.array([True, False]), normal(2)),
    ),
    "returned_bool": (lambda x: jnp.all(x > 0), (normal(3),)),
    "trees": (
        lambda state, layers: {"next": {"qd": -state["qd"], "q": state["q"]}, "y": layers[0][0] @ state["q"]},
        ({"q": normal(2), "qd": normal(2)}, [(normal(2, 2), normal(2))]),
    ),
    "unchanged": (lambda x, y: (y, x, x), (normal(3), normal(3))),
}
SORTED = {
    "sort_along_axes": lambda x: (
        *(jnp.sort(x, 0), jnp.sort(x, None), jnp.argsort(x, 1), jnp.median(x, 1), jnp.sort(x[:, :1], 1)),
        *(jnp.sort(x, 0, descending=True), jnp.argsort(-x, 1, stable=False), jnp.sort(x.reshape(3, 4, 3), 1)),
    ),
    "sort_by_several": lambda x: (
        lax.sort((jnp.round(x), x, x[::-1]), 1, num_keys=1),
        lax.sort((x > 0, jnp.isfinite(x), jnp.sign(x), jnp.arange(36).reshape(6, 6) % 5, x), 0, num_keys=4),
    ),
    "sort_of_integers": lambda x: [
        (jnp.sort(k, 0), jnp.argsort(k, 1), jnp.argsort(k[:, 0] > 0))
        for whole in [(jnp.nan_to_num(x, posinf=9, neginf=-9) * 3).astype(int)]
        for k in map(whole.astype, KINDS)
    ],
    "sort_of_many": lambda x: jnp.sort((x[:, :, None] * jnp.cos(jnp.arange(80.0) ** 2)).reshape(6, 480), 1),
}


def rows(prefix, functions, *examples):
    return {f"{prefix}_{name}": (function, examples) for name, function in functions.items()}


CASES = {
    **rows("of", UNARY, np.concatenate([SPECIAL, HALFWAY, -HALFWAY])),
    **rows("of_two", BINARY, SPECIAL, RANDOM.permutation(SPECIAL)),
    **rows("of_integers", ON_INTEGERS, INTEGERS, INTEGERS[::-1].copy()),
    **rows("moved", MOVES, normal(5, 7)),
    **rows("indexed", INDEXED, normal(5, 7), PLACES),
    **rows("control", CONTROL, normal(4), np.int64(3)),
    **rows("empty", EMPTY, np.zeros((0, 3)), normal(3, 3)),
    **rows("sorted", SORTED, np.concatenate([SPECIAL, RANDOM.permutation(SPECIAL)]).reshape(6, 6)),
    # Matrices of 3 rows are unrolled and those of 9 rows are not.
    **rows("cholesky_3", CHOLESKY, normal(3, 3), normal(3, 2)),
    **rows("cholesky_9", CHOLESKY, normal(9, 9), normal(9, 2)),
    **rows("factored_3", FACTORED, normal(3, 3), normal(3, 2)),
    **rows("factored_9", FACTORED, normal(9, 9), normal(9, 2)),
    **PRODUCTS,
    **DIVISIONS,
    **TYPES,
    **INTERFACES,
}
"""Function and first example of each of its arguments."""


def drawn(leaf, random):
    """Another of the same sort."""
    leaf = np.asarray(leaf)
    if leaf.dtype.kind == "f" and np.isfinite(leaf).all():
        return random.normal(size=leaf.shape)
    return random.permutation(leaf.ravel()).reshape(leaf.shape)


NOT_FINITE = {"factored": (), "cholesky": (np.nan,)}
"""Inputs of some cases by how their names begin; the others get NaN and infinities. LAPACK makes finite numbers of
infinities, and of NaN by LU: C does not."""


def states_of(name, examples):
    """The example, some more, and some with one number that is not finite."""
    random = np.random.default_rng(6)
    states = [examples, *(jax.tree.map(lambda leaf: drawn(leaf, random), examples) for _ in range(3))]
    leaves, tree = jax.tree.flatten(examples)
    values = next((values for start, values in NOT_FINITE.items() if name.startswith(start)), (np.nan, np.inf, -np.inf))
    for place, leaf in enumerate(map(np.asarray, leaves)):
        if leaf.dtype.kind == "f" and leaf.size and np.isfinite(leaf).all():
            for value in values:
                changed = leaf.copy()
                changed[np.unravel_index(random.integers(leaf.size), leaf.shape)] = value
                states.append(tree.unflatten([*leaves[:place], changed, *leaves[place + 1 :]]))
        elif leaf.dtype.kind == "i" and not leaf.shape:
            states += [tree.unflatten([*leaves[:place], leaf.dtype.type(k), *leaves[place + 1 :]]) for k in (0, 2)]
    return states


STATES = {name: states_of(name, examples) for name, (_, examples) in CASES.items()}
SINGLE = {name for name in CASES if name.startswith("of_")} | {*INTERFACES, *list(CASES)[::8]}
"""Tried in single precision too by default: both sorts of elementary functions, types, some others."""


@needs_compiler
@pytest.mark.parametrize("precision", slow_among(BOUND, "f64".__eq__))
def test_a_primitive_gives_what_it_gives_in_jax(precision, pytestconfig, tmp_path):
    """All are exported and compiled at once; `--every-export` takes all of them in single precision too."""
    every = pytestconfig.getoption("--every-export") or precision == "f64"
    cases = {name: pair for name, pair in CASES.items() if every or name in SINGLE}
    got = in_c(cases, STATES, tmp_path, precision=precision, flags=("-O0",))
    expected = in_jax(cases, STATES, precision=precision)
    wrong = []
    for name in cases:
        for place, (ours, theirs) in enumerate(zip(got[name], expected[name], strict=True)):
            bound = BOUND[precision] if theirs.dtype.kind == "f" else 0
            try:
                assert ours.shape == theirs.shape
                np.testing.assert_allclose(ours, theirs, rtol=bound, atol=bound)
            except AssertionError as error:
                wrong.append(f"{name}, result {place}: {error}")
    assert not wrong, "\n".join(wrong)
