"""Distances of a point to an edge or a triangle and between two edges, all by one formula.

    D = |delta|²,  delta = w - s_1 e_1 - s_2 e_2,  s = argmin D = G⁻¹ (e_i·w),  G_ij = e_i·e_j

w joins a point of one primitive to a point of the other, and e_1, e_2 span the closest features: both for the interior
of a triangle or of two edges, one for a point and an edge, none for two points. A `Stencil` holds w and e as
combinations of the vertices, so one program serves all pairs. Comparisons, without derivatives, select the closest
features; D is once continuously differentiable where they change (Li et al. 2020, section 3.2). With the weights beta
of the vertices in delta, and c_i in e_i, the derivatives are

    dD/dx = 2 beta (x) delta,    d²D/dx² = 2 beta betaᵀ (x) I - 2 A G⁻¹ Aᵀ,    A_i = beta (x) e_i + c_i (x) delta.

Conservative continuous collision detection limits the motion of vertices before a pair touches. Additive advancement
(Li, Kaufman, Jiang 2021, Codimensional Incremental Potential Contact, section 5): with the speed bound l = max |p_i| +
max |p_j| over the vertices of the two primitives (relative to their mean motion), the distance after a time t is at
least d - t l. Time advances by such bounds until the distance has shrunk to a fraction of its initial value. The result
never overestimates beyond rounding, which is smaller than the remaining distance.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

POINT_TRIANGLE, EDGE_EDGE = 0, 1
"""Kinds of pairs in space: (p, a, b, c), and (a, b, c, d) with edges from a to b and from c to d. The plane has one
kind: a point and an edge, (p, a, b)."""
# Directions with a smaller squared sine count as parallel; the search for their closest points is on the boundary.
_PARALLEL = 1e-20
REMAINING = 0.1
"""Smallest fraction of a pair's distance that remains after one step."""
_ADVANCE = 0.9
_ITERATIONS = 200


class Stencil(NamedTuple):
    """Coefficients of the vertices in w and in the directions of the closest features."""

    offset: Float[Array, "*pairs k"]
    """w = offset @ x."""
    directions: Float[Array, "*pairs axes k"]
    """e = directions @ x; zero for an unused direction."""
    unused: Float[Array, "*pairs axes"]
    """1 for an unused direction, else 0."""


def closest(
    x: Float[Array, "k dim"], stencil: Stencil
) -> tuple[Float[Array, " dim"], Float[Array, " k"], Float[Array, "axes dim"], Float[Array, "axes axes"]]:
    """Returns delta between the closest points of the given features of a pair in m, beta, e in m and G⁻¹ in 1/m².

    The vector delta = beta @ x points from the second primitive to the first.
    """
    w, e = _combined(stencil.offset, x), _combined(stencil.directions, x)
    G = summed(e[:, None, :] * e[None, :, :]) + jnp.diag(stencil.unused)
    if len(G) == 1:
        inverse = 1 / G
    else:
        adjugate = jnp.stack([jnp.stack([G[1, 1], -G[0, 1]]), jnp.stack([-G[1, 0], G[0, 0]])])
        inverse = adjugate / (G[0, 0] * G[1, 1] - G[0, 1] ** 2)
    s = summed(inverse * summed(e * w))
    delta = w - summed(s[:, None] * e, axis=0)
    return delta, stencil.offset - summed(s[:, None] * stencil.directions, axis=0), e, inverse


def squared_distance(x: Float[Array, "k dim"], kind: Int[Array, ""] | int) -> Float[Array, ""]:
    """Returns D in m² of a pair."""
    delta, *_ = closest(x, stencil_of(x, kind))
    return summed(delta**2)


def summed(values: Array, axis: int = -1) -> Array:
    """Returns the sum over a short axis, unrolled: XLA fuses it, but compiles a reduction as a separate loop."""
    parts = [jax.lax.index_in_dim(values, i, axis, keepdims=False) for i in range(values.shape[axis])]
    return functools.reduce(jnp.add, parts)


def stencil_of(x: Float[Array, "k dim"], kind: Int[Array, ""] | int) -> Stencil:
    """Returns the closest features of a pair with vertices x."""
    tables = _SPACE if x.shape[1] == 3 else _PLANE
    p, a, b = jnp.moveaxis(_combined(jnp.asarray(tables.segments, x.dtype)[kind], x), 1, 0)
    e, w = b - a, p - a
    squared = summed(e**2)
    s = summed(w * e) / jnp.where(squared > 0, squared, 1.0)
    squares = summed((w - jnp.clip(s, 0.0, 1.0)[:, None] * e) ** 2)
    side = jnp.argmin(squares)
    region = 3 * side + jnp.where(s <= 0, 0, jnp.where(s >= 1, 1, 2))[side]
    if tables.interior is not None:
        w, e, f = _combined(jnp.asarray(tables.interior, x.dtype)[kind], x)
        inside = _inside(w, e, f, kind)
        region = jnp.where(inside, len(tables.offset[0]) - 1, region)
    offset, directions, unused = (
        jnp.asarray(part, x.dtype)[kind, region] for part in (tables.offset, tables.directions, tables.unused)
    )
    return Stencil(offset, directions, unused)


def _inside(w: Array, e: Array, f: Array, kind: Int[Array, ""] | int) -> Array:
    """Tests if |w - s e - t f| is smallest inside a triangle (s, t >= 0, s + t <= 1) or inside two edges (s, t <=
    1)."""
    ee, ef, ff, ew, fw = (summed(u * v) for u, v in ((e, e), (e, f), (f, f), (e, w), (f, w)))
    determinant = ee * ff - ef**2
    s, t = ff * ew - ef * fw, ee * fw - ef * ew
    largest = jnp.where(kind == POINT_TRIANGLE, s + t, jnp.maximum(s, t))
    return (determinant > _PARALLEL * ee * ff) & (s > 0) & (t > 0) & (largest < determinant)


def _combined(weights: Float[Array, "*rows k"], x: Float[Array, "k dim"]) -> Float[Array, "*rows dim"]:
    # A sum, because a matrix product rounds to fewer digits on a GPU.
    return summed(weights[..., None] * x, axis=-2)


def speed_bound(p: Float[Array, "k dim"], kind: Int[Array, ""] | int) -> Float[Array, ""]:
    """Returns l in m per unit of time for one pair with vertex motions p; kinds as in `distances`."""
    speed = jnp.sqrt(summed((p - summed(p, axis=0) / len(p)) ** 2))
    first = jnp.arange(len(p)) < jnp.where((kind == EDGE_EDGE) & (len(p) == 4), 2, 1)
    return jnp.max(jnp.where(first, speed, 0)) + jnp.max(jnp.where(first, 0, speed))


def longest_step(
    distance: Callable[[Float[Array, " lanes"]], Float[Array, " lanes"]], bound: Float[Array, " lanes"]
) -> Float[Array, ""]:
    """Returns the largest t <= 1 before a lane has lost more than 1 - `REMAINING` of its distance.

    Args:
        distance: one time per lane -> distances in m.
        bound: upper bounds on the rates at which distances shrink, in m per unit of time; zero excludes a lane.
    """
    start = distance(jnp.zeros_like(bound))
    target = REMAINING * start
    # The other lanes keep enough distance in any motion.
    moving = bound > start - target
    rate = jnp.where(moving, bound, 1.0)

    def more(state: tuple[Array, Array, Array, Array]) -> Array:
        _, active, _, count = state
        return active.any() & (count < _ITERATIONS)

    def advance(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        t, active, limit, count = state
        now = distance(t)
        reached = now <= target + (1 - _ADVANCE) * (start - target)
        limit = jnp.min(jnp.where(active & reached, t, limit), initial=1.0)
        active &= ~reached
        t = jnp.where(active, t + _ADVANCE * jnp.maximum(now - target, 0) / rate, t)
        # A lane past the earliest stop of another lane cannot shorten the step.
        return t, active & (t < limit), limit, count + 1

    one = jnp.ones((), start.dtype)
    # A lane that is still active after all iterations is free up to its t, like a lane that has stopped.
    t, *_ = jax.lax.while_loop(more, advance, (jnp.zeros_like(bound), moving, one, jnp.asarray(0)))
    return jnp.min(jnp.where(moving, t, 1.0), initial=1.0)


class _Tables(NamedTuple):
    """Coefficients of the vertices, by kind: [kinds, ...]."""

    segments: np.ndarray
    """[s, 3, k]: a point p and the ends a, b of an edge, for the pairs of boundary features."""
    interior: np.ndarray | None
    """[3, k]: w, e_1, e_2 of the interior."""
    offset: np.ndarray
    """[regions, k] of `Stencil`: three regions for every segment (at a, at b, between), then the interior."""
    directions: np.ndarray
    unused: np.ndarray


def _tables(kinds: list[tuple[str, list[str], list[str]]], axes: int) -> _Tables:
    """Builds tables from names of vertices, segments such as "pab", and the interior as differences: "pa" is p - a."""
    segments, interiors, offsets, directions = [], [], [], []
    for names, edges, interior in kinds:
        unit = dict(zip(names, np.eye(len(names)), strict=True))

        def difference(pair: str, unit: dict[str, np.ndarray] = unit) -> np.ndarray:
            return unit[pair[0]] - unit[pair[1]]

        segments.append([[unit[name] for name in edge] for edge in edges])
        rows = [row for p, a, b in edges for row in ((p + a, []), (p + b, []), (p + a, [b + a]))]
        if interior:
            interiors.append([difference(pair) for pair in interior])
            rows.append((interior[0], interior[1:]))
        offsets.append([difference(w) for w, _ in rows])
        none = [np.zeros(len(names))] * axes
        directions.append([([difference(pair) for pair in pairs] + none)[:axes] for _, pairs in rows])
    unused = (~np.any(directions, axis=-1)).astype(float)
    interior = np.array(interiors) if interiors else None
    return _Tables(np.array(segments), interior, np.array(offsets), np.array(directions), unused)


_PLANE = _tables([("pab", ["pab"], [])], 1)
# A triangle has three edges; the last is repeated to fill the table.
_SPACE = _tables(
    [
        ("pabc", ["pab", "pbc", "pca", "pca"], ["pa", "ba", "ca"]),
        ("abcd", ["acd", "bcd", "cab", "dab"], ["ac", "dc", "ab"]),
    ],
    2,
)
