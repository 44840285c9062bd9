"""Lagrangian of a Gaussian process over trigonometric energies: as many numbers as equations, for any number of joints.

The basis of `models.trigonometric` has 5^d functions for an arm of d joints that is not planar. Here they are never
formed. T and V are independent Gaussian processes, and the model is their mean conditioned on torques:

    L(q, qd) = sum over samples n, joints i of weights[n, i] cov(L(q, qd), tau_i(q_n, qd_n, qdd_n))

Covariances are those of a chain of bodies with random frames and inertias. The velocity of body l has covariance k_l,

    k_l(x, x') = c_l(q_l, q_l') k_(l-1)(x, x') + rates_l qd_l qd_l',   cov(T, T') = sum over l of inertia_l k_l²
    cov(V, V') = sum over l of weight_l h_1(q_1, q_1') .. h_l(q_l, q_l')

with c_l(q, q') = a_l + b_l cos(q - q') for a revolute joint and a_l + b_l q q' for a prismatic one. h_l has the same
form (squared for a prismatic joint, so that it includes springs). V thus has degree 1 in the cosine and sine of every
angle and T degree 2. Both depend on the same joints as in a chain of rigid bodies: T not on the first. If the order of
the bodies is unknown (`serial=False`), all rates enter before the first joint and only the last body has an energy:
every entry of M can then be any function of that degree in every joint.

The formulation of a Lagrangian process as a linear problem of N d equations is that of Giacomuzzo, Carli, Romeres and
Dalla Libera, T-RO 2024 (arXiv 2310.06585), whose kernel is a sum over links of products over all joints up to the link.
`learning.kernel.fit_kernel` fits the parameters.

The fit needs covariances between the torques of states. With v the velocity of a body, a random linear function of the
rates, and T = vᵀ A v, A random and symmetric,

    tau_i = 2 (P_iᵀ A dv/dt + Q_iᵀ A v),   P_i = dv/dqd_i,   Q_i = d/dt P_i - dv/dq_i

A covariance of torques is a sum of products of two inner products, <P_i, P_j'> <dv/dt, dv'/dt> and seven more. One pass
along the joints gives all of them, since P, Q, v and dv/dt of a body are linear in those of the body before.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.closed_form import RecursiveSystem
from dln_jax.mechanics.dynamics import minus_potential
from dln_jax.models.model import Model
from dln_jax.types import InputError, JointKind, Needs, Scalar, Vector

CHUNK = 24
"""Number of samples per chunk, small enough that C code for seven joints fits its stack."""


class KernelScales(NamedTuple):
    """Scales of the covariances of d joints, all positive; K is d, or 1 if the bodies are not a serial chain."""

    rates: Any
    """Scales of the joints' rates in the velocities of bodies [d]; the unit is shared with `inertia`."""
    inertia: Any
    """Scales of the bodies' kinetic energy [K]."""
    turns: Any
    """a and b of c [d, 2]; b is per m² for a prismatic joint."""
    weight: Any
    """Scales of the bodies' potential [K], in J²; `None` without gravity."""
    lifts: Any
    """a and b of h [d, 2]."""


class KernelParameters(NamedTuple):
    """Parameters of a model from n samples of d joints."""

    q: Any
    """[n, d], positions of the samples."""
    qd: Any
    """[n, d]."""
    qdd: Any
    """[n, d]."""
    weights: Any
    """[n, d], weights of their torques; 1/(N m) or 1/N."""
    scales: KernelScales
    friction: Any
    """Viscous friction of the coordinates [d], in N m s or N s/m."""


class JointFactor(NamedTuple):
    """c(x, y) and its derivatives, as arrays that broadcast."""

    value: Array
    by_x: Array
    by_y: Array
    by_both: Array


class Shared(NamedTuple):
    """Inner products [n] of a body's velocity with quantities of the samples."""

    velocity: Array
    """With the sample's velocity v."""
    acceleration: Array
    """With dv/dt."""
    momentum: Array
    """With sum_i w_i dv/dqd_i, w the sample's weights."""
    force: Array
    """With sum_i w_i (d/dt dv/dqd_i - dv/dq_i)."""


def make_trigonometric_kernel(
    needs: Needs, *, samples: int = 600, serial: bool = True, dtype: DTypeLike = jnp.float64
) -> Model:
    """Returns the (init, energies) pair; `init` draws random samples and weights, which only have the right shapes.

    One call of the inverse model takes about n d operations, one mass matrix n d³.

    Args:
        needs: kinds of joints, gravity, and viscous friction of the coordinates.
        samples: n, number of samples whose torques define the energy; the fit takes n³ d³ operations.
        serial: whether joints form a serial chain; otherwise nothing is assumed about their order.
        dtype: type of the parameters; weights have either sign and cancel, so f32 costs accuracy.

    Raises:
        InputError: no samples.
    """
    if samples < 1:
        raise InputError(f"samples is {samples}; expected a positive whole number")
    d = needs.degrees_of_freedom
    bodies = d if serial else 1

    def init(key: Array) -> KernelParameters:
        q, qd, qdd, weights = jax.random.normal(key, (4, samples, d), dtype)
        pair = jnp.asarray([[1 / 3, 2 / 3]] * d, dtype)
        scales = KernelScales(
            rates=jnp.ones(d, dtype),
            inertia=jnp.ones(bodies, dtype),
            turns=pair,
            weight=jnp.ones(bodies, dtype) if needs.gravity else None,
            lifts=pair if needs.gravity else None,
        )
        return KernelParameters(q, qd, qdd, weights, scales, jnp.zeros(d, dtype) if needs.friction else None)

    return Model(init, lambda parameters: _system(parameters, needs.joints, serial))


def turn_factor(joint: JointKind, pair: Array, x: Array, y: Array) -> JointFactor:
    """Returns c of a joint."""
    a, b = pair
    if joint == "prismatic":
        return JointFactor(a + b * x * y, b * y, b * x, b * jnp.ones_like(x * y))
    cosine = b * (jnp.cos(x) * jnp.cos(y) + jnp.sin(x) * jnp.sin(y))
    sine = b * (jnp.sin(x) * jnp.cos(y) - jnp.cos(x) * jnp.sin(y))
    return JointFactor(a + cosine, -sine, sine, cosine)


def lift_factor(joint: JointKind, pair: Array, x: Array, y: Array) -> JointFactor:
    """Returns h of a joint."""
    c = turn_factor(joint, pair, x, y)
    if joint == "revolute":
        return c
    return JointFactor(
        c.value**2, 2 * c.value * c.by_x, 2 * c.value * c.by_y, 2 * (c.by_x * c.by_y + c.value * c.by_both)
    )


def _system(parameters: KernelParameters, joints: tuple[JointKind, ...], serial: bool) -> RecursiveSystem:
    scales, friction = parameters.scales, parameters.friction

    def kinetic(q: Vector, qd: Vector) -> Scalar:
        def of(some: KernelParameters) -> Scalar:
            s = _shared(some, joints, serial, q, qd)
            return 2 * jnp.sum(scales.inertia @ (s.momentum * s.acceleration + s.velocity * s.force))

        return _summed(of, parameters)

    def mass_matrix(q: Vector) -> Array:
        def half(some: KernelParameters) -> Array:
            s = jax.vmap(lambda qd: _shared(some, joints, serial, q, qd))(jnp.eye(len(joints), dtype=q.dtype))
            weighted = scales.inertia[:, None] * s.acceleration, scales.inertia[:, None] * s.force
            momentum, velocity = (
                jnp.einsum("ikn,jkn->ij", *pair) for pair in zip((s.momentum, s.velocity), weighted, strict=True)
            )
            return momentum + velocity

        M = _summed(half, parameters)
        return 2 * (M + M.T)

    potential = _potential(parameters, joints, serial)
    return RecursiveSystem(
        mass_matrix=mass_matrix,
        # By derivatives of T instead of M, which would take d times as long.
        forces=functools.partial(
            lagrangian.inverse_dynamics, lambda q, qd: minus_potential(kinetic(q, qd), potential, q)
        ),
        potential=potential,
        dissipation=None if friction is None else lambda q, qd: 0.5 * jnp.sum(friction * qd**2),
        friction=None if friction is None else lambda q, qd: friction * qd,
    )


def _shared(parameters: KernelParameters, joints: tuple[JointKind, ...], serial: bool, q: Vector, qd: Vector) -> Shared:
    """Returns inner products for all K bodies with an inertia, as arrays [K, n]; linear in qd."""
    scales = parameters.scales
    moved, accelerated, weights = (array.T for array in (parameters.qd, parameters.qdd, parameters.weights))
    rates = (scales.rates * qd)[:, None]
    entered = Shared(rates * moved, rates * accelerated, rates * weights, jnp.zeros_like(moved))
    turns = [turn_factor(kind, scales.turns[k], q[k], parameters.q[:, k]) for k, kind in enumerate(joints)]
    value = jnp.stack([turn.value for turn in turns])
    slope = jnp.stack([jnp.broadcast_to(turn.by_y, turn.value.shape) for turn in turns])

    def turned(s: Shared, c: Array, by_y: Array, moved: Array, weight: Array) -> Shared:
        return Shared(
            c * s.velocity,
            c * s.acceleration + by_y * moved * s.velocity,
            c * s.momentum,
            c * s.force + by_y * (moved * s.momentum - weight * s.velocity),
        )

    def link(s: Shared, at: tuple) -> tuple[Shared, Shared]:
        new, *rest = at
        s = turned(s, *rest)
        if serial:
            s = Shared(*(product + more for product, more in zip(s, new, strict=True)))
        return s, s

    start = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]) if serial else jnp.sum(leaf, axis=0), entered)
    last, bodies = lax.scan(link, start, (entered, value, slope, moved, weights))
    return bodies if serial else Shared(*(product[None] for product in last))


def _potential(
    parameters: KernelParameters, joints: tuple[JointKind, ...], serial: bool
) -> Callable[[Vector], Scalar] | None:
    weight, lifts = parameters.scales.weight, parameters.scales.lifts
    if weight is None or lifts is None:
        return None

    def of(some: KernelParameters, q: Vector) -> Scalar:
        height, force = jnp.ones_like(some.q[:, 0]), jnp.zeros_like(some.q[:, 0])
        bodies = []
        for joint, kind in enumerate(joints):
            h = lift_factor(kind, lifts[joint], q[joint], some.q[:, joint])
            force = h.value * force + h.by_y * some.weights[:, joint] * height
            height = h.value * height
            bodies.append(jnp.sum(force))
        return jnp.stack(bodies if serial else bodies[-1:]) @ weight

    return lambda q: _summed(lambda some: of(some, q), parameters)


def _summed(function: Callable[[KernelParameters], Array], parameters: KernelParameters) -> Array:
    """Sums over chunks of samples, small enough that a batch of states and its derivatives fit into memory."""
    samples = (parameters.q, parameters.qd, parameters.qdd, parameters.weights)
    n, d = parameters.q.shape
    if n <= CHUNK:
        return function(parameters)
    # The padding of the last chunk has weight zero.
    pieces = [jnp.pad(array, ((0, -n % CHUNK), (0, 0))).reshape(-1, CHUNK, d) for array in samples]

    def of(q: Array, qd: Array, qdd: Array, weights: Array) -> Array:
        return function(parameters._replace(q=q, qd=qd, qdd=qdd, weights=weights))

    @jax.checkpoint
    def add(total: Array, piece: list[Array]) -> tuple[Array, None]:
        return total + of(*piece), None

    like = jax.eval_shape(of, *(piece[0] for piece in pieces))
    total, _ = lax.scan(add, jnp.zeros(like.shape, like.dtype), pieces)
    return total


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
