"""Covariances between states of the torques from the energies of `models.trigonometric_kernel`.

With v the velocity of a body, a random linear function of the rates, and T = vᵀ A v, A random and symmetric,

    tau_i = 2 (P_iᵀ A dv/dt + Q_iᵀ A v),   P_i = dv/dqd_i,   Q_i = d/dt P_i - dv/dq_i

A covariance of torques is a sum of products of two inner products, <P_i, P_j'> <dv/dt, dv'/dt> and seven more. One pass
along the joints gives all of them, since P, Q, v and dv/dt of a body are linear in those of the body before.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from dln_jax.models.trigonometric_kernel import KernelScales, lift_factor, turn_factor
from dln_jax.types import JointKind

PAIRS = 500
"""Number of pairs of states per block, which fit into cache."""


class States(NamedTuple):
    """States as arrays [N, d], or with axes of pairs after the axis of joints."""

    q: Any
    qd: Any
    qdd: Any


class Products(NamedTuple):
    """Inner products of (P_1 .. P_d, v) and (Q_1 .. Q_d, dv/dt), as arrays [d + 1, d + 1, R, M]; primes are second."""

    first: Array
    """<P, P'>."""
    mixed: Array
    """<P, Q'>."""
    mirrored: Array
    """<Q, P'>."""
    second: Array
    """<Q, Q'>."""


def torque_covariance(
    joints: tuple[JointKind, ...], serial: bool, scales: KernelScales, states: States
) -> Float[Array, "Nd Nd"]:
    """Returns cov(tau(state), tau(other)), (N m)², for all pairs of N states; the joints of a state are adjacent.

    Every state is paired with the N/2 that follow it, cyclically; the other pairs are transposes of these. Blocks of
    rows are computed in turn; derivatives recompute them, because their intermediate values exceed the caches.
    """
    N, d = np.shape(states.q)
    states, width = States(*map(jnp.asarray, states)), N // 2 + 1
    following = jnp.asarray((np.arange(N)[:, None] + np.arange(width)) % N)

    def block(rows: Array) -> Array:
        x, y = (States(*(jnp.moveaxis(array[at], 2, 0) for array in states)) for at in (rows[:, None], following[rows]))
        return _block(joints, serial, scales, x, y)

    rows = max(1, min(N, PAIRS // width))
    places = np.arange(-(-N // rows) * rows) % N
    blocks = lax.map(jax.checkpoint(block), jnp.asarray(places.reshape(-1, rows)))
    pairs = blocks.transpose(0, 3, 4, 1, 2).reshape(len(places), width, d, d)[:N]
    row, column = np.indices((N, N))
    ahead = (column - row) % N
    follows = ahead < width
    whole = pairs[np.where(follows, row, column), np.where(follows, ahead, (row - column) % N)]
    whole = jnp.where(follows[..., None, None], whole, whole.swapaxes(2, 3))
    return whole.transpose(0, 2, 1, 3).reshape(N * d, N * d)


def _block(
    joints: tuple[JointKind, ...], serial: bool, scales: KernelScales, x: States, y: States
) -> Float[Array, "d d R K"]:
    """Returns the covariance of states x [d, R, 1] with y [d, R, K]; pairs are the last axes, for long inner loops."""
    d = len(joints)
    pairs = jnp.zeros(np.broadcast_shapes(x.q.shape[1:], y.q.shape[1:]), x.q.dtype)
    turns = _factors(turn_factor, joints, scales.turns, x.q, y.q)
    has_potential = scales.weight is not None and scales.lifts is not None
    lifts = _factors(lift_factor, joints, scales.lifts, x.q, y.q) if has_potential else None
    unit = jnp.eye(d + 1, dtype=pairs.dtype)[:d]
    # Without a known order only the last body has an energy, and all rates enter before the first joint.
    of_body = (lambda scale: scale) if serial else (lambda scale: jnp.zeros(d, scale.dtype).at[-1].set(scale[0]))

    def entered(products: Products, joint: Any, rate: Array) -> Products:
        at, (_, u, a), (_, w, b) = joint
        e, last = at[:, None, None], jnp.zeros(d + 1, at.dtype).at[-1].set(1.0)[:, None, None]
        P, P_other, Q, Q_other = e + last * u, e + last * w, last * a, last * b
        pairs = ((P, P_other), (P, Q_other), (Q, P_other), (Q, Q_other))
        return Products(
            *(X + rate * left[:, None] * right[None] for X, (left, right) in zip(products, pairs, strict=True))
        )

    def link(carry: tuple, at: tuple) -> tuple[tuple, None]:
        products, heights, total = carry
        joint, rate, turn, inertia, lift, weight = at
        products = _turned(products, turn, joint)
        if serial:
            products = entered(products, joint, rate)
        total = total + inertia * _kinetic(products)
        if lift is not None:
            heights = _lifted(heights, lift, joint[0])
            total = total + weight * heights[:d, :d]
        return (products, heights, total), None

    nothing = jnp.zeros((d + 1, d + 1, *pairs.shape), pairs.dtype)
    products = Products(nothing, nothing, nothing, nothing)
    joint_axes = (unit, x, y)
    if not serial:
        for joint in range(d):
            one = jax.tree.map(lambda leaf, joint=joint: leaf[joint], joint_axes)
            products = entered(products, one, scales.rates[joint])
    heights = nothing.at[d, d].set(1.0) if has_potential else None
    weight = of_body(scales.weight) if has_potential else None
    links = (joint_axes, scales.rates, turns, of_body(scales.inertia), lifts, weight)
    (_, _, total), _ = lax.scan(jax.checkpoint(link), (products, heights, nothing[:d, :d]), links)
    return total


def _factors(factor: Any, joints: tuple[JointKind, ...], pairs: Any, x: Array, y: Array) -> Any:
    factors = [factor(kind, pairs[joint], x[joint], y[joint]) for joint, kind in enumerate(joints)]
    # Derivatives for a prismatic joint do not vary along both axes.
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves, x[0] + y[0])[:-1]), *factors)


def _turned(products: Products, c: Any, joint: Any) -> Products:
    """Passes a joint: v becomes C v, like P; Q becomes C Q + dC/dq (qd P - e vᵀ), with e the joint's unit vector."""
    at, (_, u, _), (_, w, _) = joint
    e = at[:, None, None]

    def rows(X: Array) -> Array:
        return u * X - e[:, None] * X[-1]

    def columns(X: Array) -> Array:
        return w * X - X[:, -1, None] * e

    first, mixed, mirrored, second = products
    turned = columns(first)
    return Products(
        c.value * first,
        c.value * mixed + c.by_y * turned,
        c.value * mirrored + c.by_x * rows(first),
        c.value * second + c.by_x * rows(mixed) + c.by_y * columns(mirrored) + c.by_both * rows(turned),
    )


def _kinetic(products: Products) -> Array:
    """Returns cov(tau_i, tau_j') of one body with unit inertia, [d, d, R, M]."""
    PP, PQ, QP, QQ = products
    inner, column, row, corner = _parts(PP), _parts(PQ), _parts(QP), _parts(QQ)
    # Every product of blocks has a counterpart with v and dv/dt exchanged.
    return 2 * (
        inner.block * corner.end + column.right * row.below
        + column.block * row.end + inner.right * corner.below
        + row.block * column.end + corner.right * inner.below
        + corner.block * inner.end + row.right * column.below
    )  # fmt: skip


class _Parts(NamedTuple):
    block: Array
    right: Array
    below: Array
    end: Array


def _parts(X: Array) -> _Parts:
    return _Parts(X[:-1, :-1], X[:-1, -1:], X[-1:, :-1], X[-1, -1])


def _lifted(heights: Array, h: Any, at: Array) -> Array:
    """Returns inner products of (dz/dq_1 .. dz/dq_d, z); z is the product of functions of the joints so far."""
    e = at[:, None, None]
    return (
        h.value * heights
        + h.by_x * e[:, None] * heights[-1]
        + h.by_y * heights[:, -1, None] * e
        + h.by_both * e[:, None] * e * heights[-1, -1]
    )
