"""Distances between a point and an edge or a triangle, and between two edges, with one formula for all of them.

    D = |delta|²,  delta = w - s_1 e_1 - s_2 e_2,  s = argmin D = G⁻¹ (e_i·w),  G_ij = e_i·e_j

w joins a point of one primitive to a point of the other, and e_1, e_2 span the closest features: both for the interior
of a triangle or of two edges, one for a point and an edge, none for two points. A `Stencil` states w and e as
combinations of the vertices, so that one energy serves all pairs. Which features are closest (`region`) is decided by
comparisons, without derivatives; D is once continuously differentiable where the region changes (Li et al. 2020,
section 3.2).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Two edges whose squared sine is below this are parallel, and their closest points are sought at their ends.
_PARALLEL = 1e-20


class Stencil(NamedTuple):
    """Coefficients of the vertices in w and in the directions of the closest features."""

    offset: Float[Array, "*pairs k"]
    """w = offset @ x."""
    directions: Float[Array, "*pairs axes k"]
    """e = directions @ x; zero for a direction that is not used."""
    unused: Float[Array, "*pairs axes"]
    """1 for a direction that is not used, else 0."""


def squared_distance(x: Float[Array, "k dim"], stencil: Stencil) -> Float[Array, ""]:
    """D in m² of the closest features of a pair with vertices x."""
    delta, _ = separation(x, stencil)
    return delta @ delta


def separation(x: Float[Array, "k dim"], stencil: Stencil) -> tuple[Float[Array, " dim"], Float[Array, " k"]]:
    """Returns delta in m, and the weights of the vertices in it: delta = weights @ x."""
    w, e = stencil.offset @ x, stencil.directions @ x
    s = _solved(e @ e.T + jnp.diag(stencil.unused), e @ w)
    return w - s @ e, stencil.offset - s @ stencil.directions


def point_edge(x: Float[Array, "3 dim"]) -> Stencil:
    """Stencil of a point and an edge: x = (p, a, b)."""
    region, _ = _point_segment(x[0], x[1], x[2])
    return _stencil(_POINT_EDGE, region, x.dtype)


def point_triangle(x: Float[Array, "4 3"]) -> Stencil:
    """Stencil of a point and a triangle: x = (p, a, b, c)."""
    p, a, b, c = x
    inside, _ = _interior(p - a, b - a, c - a)
    regions, squares = zip(*(_point_segment(p, *ends) for ends in ((a, b), (b, c), (c, a))), strict=True)
    side = jnp.argmin(jnp.stack(squares))
    region = jnp.where(inside, 9, 3 * side + jnp.stack(regions)[side])
    return _stencil(_POINT_TRIANGLE, region, x.dtype)


def edge_edge(x: Float[Array, "4 3"]) -> Stencil:
    """Stencil of two edges: x = (a, b, c, d), from a to b and from c to d."""
    a, b, c, d = x
    _, (s, t) = _interior(a - c, d - c, a - b)
    u, v = b - a, d - c
    crossed = (u @ u) * (v @ v) - (u @ v) ** 2 > _PARALLEL * (u @ u) * (v @ v)
    inside = crossed & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    regions, squares = zip(
        *(_point_segment(p, *ends) for p, ends in ((a, (c, d)), (b, (c, d)), (c, (a, b)), (d, (a, b)))), strict=True
    )
    end = jnp.argmin(jnp.stack(squares))
    region = jnp.where(inside, 12, 3 * end + jnp.stack(regions)[end])
    return _stencil(_EDGE_EDGE, region, x.dtype)


def _point_segment(p: Array, a: Array, b: Array) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Returns the region (0 at a, 1 at b, 2 between them) and the squared distance."""
    e, w = b - a, p - a
    squared = e @ e
    s = (w @ e) / jnp.where(squared > 0, squared, 1.0)
    delta = w - jnp.clip(s, 0.0, 1.0) * e
    return jnp.where(s <= 0, 0, jnp.where(s >= 1, 1, 2)), delta @ delta


def _interior(w: Array, e: Array, f: Array) -> tuple[Array, Float[Array, " 2"]]:
    """Whether the closest point of the plane w - s e - t f is inside the triangle of e and f, and (s, t)."""
    ee, ef, ff = e @ e, e @ f, f @ f
    determinant = ee * ff - ef**2
    good = determinant > _PARALLEL * ee * ff
    safe = jnp.where(good, determinant, 1.0)
    s, t = (ff * (e @ w) - ef * (f @ w)) / safe, (ee * (f @ w) - ef * (e @ w)) / safe
    return good & (s > 0) & (t > 0) & (s + t < 1), jnp.stack([s, t])


def _solved(G: Float[Array, "axes axes"], r: Float[Array, " axes"]) -> Float[Array, " axes"]:
    if len(r) == 1:
        return r / G[0]
    determinant = G[0, 0] * G[1, 1] - G[0, 1] ** 2
    return jnp.stack([G[1, 1] * r[0] - G[0, 1] * r[1], G[0, 0] * r[1] - G[0, 1] * r[0]]) / determinant


Table = tuple[np.ndarray, np.ndarray, np.ndarray]


def _stencil(table: Table, region: Int[Array, ""], dtype: jnp.dtype) -> Stencil:
    region = jax.lax.stop_gradient(region)
    return Stencil(*(jnp.asarray(part, dtype)[region] for part in table))


def _rows(entries: list[tuple[str, list[str]]], names: str, axes: int) -> Table:
    """Returns the table of regions, from w and the directions written as differences: "pa" is p - a."""

    def difference(pair: str) -> np.ndarray:
        row = np.zeros(len(names))
        row[names.index(pair[0])], row[names.index(pair[1])] = 1.0, -1.0
        return row

    offset = np.stack([difference(w) for w, _ in entries])
    directions = np.zeros((len(entries), axes, len(names)))
    for number, (_, pairs) in enumerate(entries):
        for axis, pair in enumerate(pairs):
            directions[number, axis] = difference(pair)
    return offset, directions, (~directions.any(axis=2)).astype(float)


def _ends(p: str, a: str, b: str) -> list[tuple[str, list[str]]]:
    """Regions of a point p and an edge: at a, at b, between them."""
    return [(p + a, []), (p + b, []), (p + a, [b + a])]


_POINT_EDGE = _rows(_ends("p", "a", "b"), "pab", 1)
_POINT_TRIANGLE = _rows(
    [*_ends("p", "a", "b"), *_ends("p", "b", "c"), *_ends("p", "c", "a"), ("pa", ["ba", "ca"])], "pabc", 2
)
_turned = functools.partial(_ends, a="a", b="b")
_EDGE_EDGE = _rows(
    [*_ends("a", "c", "d"), *_ends("b", "c", "d"), *_turned("c"), *_turned("d"), ("ac", ["dc", "ab"])], "abcd", 2
)
