"""Gaussian-process Lagrangian over trigonometric energies, with one weight per measured torque.

The basis of `models.trigonometric` has 5^d functions for a non-planar arm of d joints. This model never forms them. T
and V are independent Gaussian processes, and the model is their mean conditioned on torques:

    L(q, qd) = sum over samples n, joints i of weights[n, i] cov(L(q, qd), tau_i(q_n, qd_n, qdd_n))

The covariances describe a chain of bodies with random frames and inertias. The velocity of body l has covariance k_l,

    k_l(x, x') = c_l(q_l, q_l') k_(l-1)(x, x') + rates_l qd_l qd_l',   cov(T, T') = sum over l of inertia_l k_l²
    cov(V, V') = sum over l of weight_l h_1(q_1, q_1') .. h_l(q_l, q_l')

with c_l(q, q') = a_l + b_l cos(q - q') for a revolute joint and a_l + b_l q q' for a prismatic one. h_l has the same
form (squared for a prismatic joint, so that it includes springs). V thus has degree 1 in the cosine and sine of every
angle and T degree 2. As in a chain of rigid bodies, T does not depend on the first joint. If the order of the bodies is
unknown (`serial=False`), all rates enter before the first joint and only the last body has an energy: every entry of M
can then be any function of that degree in every joint.

Giacomuzzo, Carli, Romeres and Dalla Libera (T-RO 2024, arXiv 2310.06585) formulated a Lagrangian process as a linear
problem of N d equations. Their kernel is a sum over links of products over all joints up to the link.
`learning.kernel.fit_kernel` fits the parameters.

The fit needs covariances between the torques of states. With v the velocity of a body, a random linear function of the
rates, and T = vᵀ A v, A random and symmetric,

    tau_i = 2 (P_iᵀ A dv/dt + Q_iᵀ A v),   P_i = dv/dqd_i,   Q_i = d/dt P_i - dv/dq_i

A covariance of torques is a sum of products of two inner products, <P_i, P_j'> <dv/dt, dv'/dt> and seven more. One pass
along the joints gives all of them, since P, Q, v and dv/dt of a body are linear in the same quantities of the previous
body.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.dynamics import minus_potential
from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.models.model import Model
from dln_jax.types import InputError, JointKind, Needs, Scalar, Vector

CHUNK = 24
"""Number of samples per chunk; C code for seven joints then fits its stack."""
PAIRS = 500
"""Number of pairs of states per block; a block fits into the cache."""


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


Factor = tuple[Array, Array, Array, Array]
"""A function of x and y, and its derivatives by x, by y and by both, as arrays that broadcast."""


def make_trigonometric_kernel(
    needs: Needs, *, samples: int = 600, serial: bool = True, dtype: DTypeLike = jnp.float64
) -> Model:
    """Returns the (init, energies) pair; `init` draws random samples and weights of the right shapes.

    One call of the inverse model takes about n d operations, one mass matrix n d³.

    Args:
        needs: kinds of joints, gravity, and viscous friction of the coordinates.
        samples: n, number of training samples that define the energy; the fit takes n³ d³ operations.
        serial: the joints form a serial chain; otherwise their order is arbitrary.
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


def turn_factor(joint: JointKind, pair: Array, x: Array, y: Array) -> Factor:
    """Returns c of a joint."""
    a, b = pair
    if joint == "prismatic":
        return a + b * x * y, b * y, b * x, b * jnp.ones_like(x * y)
    cosine = b * (jnp.cos(x) * jnp.cos(y) + jnp.sin(x) * jnp.sin(y))
    sine = b * (jnp.sin(x) * jnp.cos(y) - jnp.cos(x) * jnp.sin(y))
    return a + cosine, -sine, sine, cosine


def lift_factor(joint: JointKind, pair: Array, x: Array, y: Array) -> Factor:
    """Returns h of a joint."""
    turn = c, by_x, by_y, by_both = turn_factor(joint, pair, x, y)
    if joint == "revolute":
        return turn
    return c**2, 2 * c * by_x, 2 * c * by_y, 2 * (by_x * by_y + c * by_both)


def _system(parameters: KernelParameters, joints: tuple[JointKind, ...], serial: bool) -> ExplicitSystem:
    inertia, friction = parameters.scales.inertia, parameters.friction

    def kinetic(q: Vector, qd: Vector) -> Scalar:
        def of(some: KernelParameters) -> Scalar:
            velocity, acceleration, momentum, force = _products(some, joints, serial, q, qd)
            return 2 * jnp.sum(inertia @ (momentum * acceleration + velocity * force))

        return _summed(of, parameters)

    def mass_matrix(q: Vector) -> Array:
        product = functools.partial(jnp.einsum, "ikn,jkn->ij")

        def half(some: KernelParameters) -> Array:
            products = jax.vmap(lambda qd: _products(some, joints, serial, q, qd))(jnp.eye(len(joints), dtype=q.dtype))
            velocity, acceleration, momentum, force = products
            weight = inertia[:, None]
            return product(momentum, weight * acceleration) + product(velocity, weight * force)

        M = _summed(half, parameters)
        return 2 * (M + M.T)

    potential = _potential(parameters, joints, serial)
    return ExplicitSystem(
        mass_matrix=mass_matrix,
        # Uses derivatives of T; derivatives of M would take d times as long.
        forces=functools.partial(
            lagrangian.inverse_dynamics, lambda q, qd: minus_potential(kinetic(q, qd), potential, q)
        ),
        potential=potential,
        dissipation=None if friction is None else lambda q, qd: 0.5 * jnp.sum(friction * qd**2),
        friction=None if friction is None else lambda q, qd: friction * qd,
    )


def _products(
    parameters: KernelParameters, joints: tuple[JointKind, ...], serial: bool, q: Vector, qd: Vector
) -> tuple[Array, ...]:
    """Inner products [K, n] of the velocities of all K bodies with an inertia with quantities of the samples.

    These are the sample's velocity v, dv/dt, sum_i w_i dv/dqd_i and sum_i w_i (d/dt dv/dqd_i - dv/dq_i), with w the
    sample's weights. They are linear in qd.
    """
    moved, accelerated, weights = (array.T for array in (parameters.qd, parameters.qdd, parameters.weights))
    rates = (parameters.scales.rates * qd)[:, None]
    entering = rates * moved, rates * accelerated, rates * weights, jnp.zeros_like(moved)
    turns = [turn_factor(kind, parameters.scales.turns[k], q[k], parameters.q[:, k]) for k, kind in enumerate(joints)]
    value = jnp.stack([c for c, *_ in turns])
    slope = jnp.stack([jnp.broadcast_to(by_y, c.shape) for c, _, by_y, _ in turns])

    def link(before: tuple[Array, ...], at: tuple) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        velocity, acceleration, momentum, force = before
        new, c, by_y, moved, weight = at
        after = (
            c * velocity,
            c * acceleration + by_y * moved * velocity,
            c * momentum,
            c * force + by_y * (moved * momentum - weight * velocity),
        )
        if serial:
            after = jax.tree.map(jnp.add, after, new)
        return after, after

    start = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]) if serial else jnp.sum(leaf, axis=0), entering)
    last, bodies = lax.scan(link, start, (entering, value, slope, moved, weights))
    return bodies if serial else jax.tree.map(lambda product: product[None], last)


def _potential(
    parameters: KernelParameters, joints: tuple[JointKind, ...], serial: bool
) -> Callable[[Vector], Scalar] | None:
    weight, lifts = parameters.scales.weight, parameters.scales.lifts
    if weight is None:
        return None

    def of(some: KernelParameters, q: Vector) -> Scalar:
        height, force = jnp.ones_like(some.q[:, 0]), jnp.zeros_like(some.q[:, 0])
        bodies = []
        for joint, kind in enumerate(joints):
            h, _, by_y, _ = lift_factor(kind, lifts[joint], q[joint], some.q[:, joint])
            force = h * force + by_y * some.weights[:, joint] * height
            height = h * height
            bodies.append(jnp.sum(force))
        return jnp.stack(bodies if serial else bodies[-1:]) @ weight

    return lambda q: _summed(lambda some: of(some, q), parameters)


def _summed(function: Callable[[KernelParameters], Array], parameters: KernelParameters) -> Array:
    """Sums over chunks of samples, small enough that a batch of states and its derivatives fit into memory."""
    *samples, scales, friction = parameters
    n, d = parameters.q.shape
    if n <= CHUNK:
        return function(parameters)
    # The padding of the last chunk has weight zero.
    pieces = [jnp.pad(array, ((0, -n % CHUNK), (0, 0))).reshape(-1, CHUNK, d) for array in samples]

    def of(*some: Array) -> Array:
        return function(KernelParameters(*some, scales=scales, friction=friction))

    @jax.checkpoint
    def add(total: Array, piece: list[Array]) -> tuple[Array, None]:
        return total + of(*piece), None

    like = jax.eval_shape(of, *(piece[0] for piece in pieces))
    total, _ = lax.scan(add, jnp.zeros(like.shape, like.dtype), pieces)
    return total


States = tuple[Any, Any, Any]
"""q, qd and qdd as arrays [N, d], or with axes of pairs after the axis of joints."""


def torque_covariance(
    joints: tuple[JointKind, ...], serial: bool, scales: KernelScales, states: States
) -> Float[Array, "Nd Nd"]:
    """Returns cov(tau(state), tau(other)), (N m)², for all pairs of N states; the joints of a state are adjacent.

    Every state is paired cyclically with the next N/2 states; the other pairs are transposes of these. Blocks of rows
    are computed in turn; derivatives recompute them, because their intermediate values exceed the caches.
    """
    N, d = np.shape(states[0])
    arrays, width = [jnp.asarray(array) for array in states], N // 2 + 1
    following = jnp.asarray((np.arange(N)[:, None] + np.arange(width)) % N)

    def block(rows: Array) -> Array:
        x, y = ([jnp.moveaxis(array[at], 2, 0) for array in arrays] for at in (rows[:, None], following[rows]))
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
    joints: tuple[JointKind, ...], serial: bool, scales: KernelScales, x: list[Array], y: list[Array]
) -> Float[Array, "d d R K"]:
    """Returns the covariance of states x [d, R, 1] with y [d, R, K]; pairs are the last axes, for long inner loops.

    It carries inner products of P = (P_1 .. P_d, v) and Q = (Q_1 .. Q_d, dv/dt) as four arrays [d + 1, d + 1, R, K]:
    <P, P'>, <P, Q'>, <Q, P'> and <Q, Q'>, with primes for y.
    """
    d, dtype = len(joints), x[0].dtype
    nothing = jnp.zeros((d + 1, d + 1, *np.broadcast_shapes(x[0].shape[1:], y[0].shape[1:])), dtype)
    turns = _factors(turn_factor, joints, scales.turns, x[0], y[0])
    # Without a known order only the last body has an energy, and all rates enter before the first joint.
    inertia = jnp.pad(scales.inertia, (d - len(scales.inertia), 0))
    heights = lifts = weight = None
    if scales.weight is not None:
        weight = jnp.pad(scales.weight, (d - len(scales.weight), 0))
        lifts = _factors(lift_factor, joints, scales.lifts, x[0], y[0])
        heights = nothing.at[d, d].set(1.0)
    last = jnp.zeros((d + 1, 1, 1), dtype).at[-1].set(1.0)

    def entered(products: tuple[Array, ...], joint: Any, rate: Array) -> tuple[Array, ...]:
        e, (_, u, a), (_, w, b) = joint
        pairs = itertools.product((e + last * u, last * a), (e + last * w, last * b))
        return tuple(X + rate * left[:, None] * right[None] for X, (left, right) in zip(products, pairs, strict=True))

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

    products = (nothing,) * 4
    joint_axes = (jnp.eye(d + 1, dtype=dtype)[:d, :, None, None], x, y)
    if not serial:
        for joint in range(d):
            one = jax.tree.map(lambda leaf, joint=joint: leaf[joint], joint_axes)
            products = entered(products, one, scales.rates[joint])
    links = (joint_axes, scales.rates, turns, inertia, lifts, weight)
    (_, _, total), _ = lax.scan(jax.checkpoint(link), (products, heights, nothing[:d, :d]), links)
    return total


def _factors(
    factor: Callable[..., Factor], joints: tuple[JointKind, ...], pairs: Any, x: Array, y: Array
) -> tuple[Array, ...]:
    factors = [factor(kind, pairs[joint], x[joint], y[joint]) for joint, kind in enumerate(joints)]
    # The derivatives for a prismatic joint vary along one axis only.
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves, x[0] + y[0])[:-1]), *factors)


def _turned(products: tuple[Array, ...], turn: Factor, joint: Any) -> tuple[Array, ...]:
    """Passes a joint: v becomes C v, like P; Q becomes C Q + dC/dq (qd P - e vᵀ), with e the joint's unit vector."""
    e, (_, u, _), (_, w, _) = joint

    def rows(X: Array) -> Array:
        return u * X - e[:, None] * X[-1]

    def columns(X: Array) -> Array:
        return w * X - X[:, -1, None] * e

    c, by_x, by_y, by_both = turn
    PP, PQ, QP, QQ = products
    turned = columns(PP)
    return (
        c * PP,
        c * PQ + by_y * turned,
        c * QP + by_x * rows(PP),
        c * QQ + by_x * rows(PQ) + by_y * columns(QP) + by_both * rows(turned),
    )


def _kinetic(products: tuple[Array, ...]) -> Array:
    """Returns cov(tau_i, tau_j') of one body with unit inertia, [d, d, R, K]."""
    # Every product of blocks has a counterpart with v and dv/dt exchanged.
    exchanged = zip(products, reversed(products), strict=True)
    terms = (X[:-1, :-1] * Y[-1, -1] + X[:-1, -1:] * Y[-1:, :-1] for X, Y in exchanged)
    return 2 * functools.reduce(jnp.add, terms)


def _lifted(heights: Array, lift: Factor, e: Array) -> Array:
    """Returns inner products of (dz/dq_1 .. dz/dq_d, z); z is the product of functions of the joints so far."""
    h, by_x, by_y, by_both = lift
    return (
        h * heights
        + by_x * e[:, None] * heights[-1]
        + by_y * heights[:, -1, None] * e
        + by_both * e[:, None] * e * heights[-1, -1]
    )
