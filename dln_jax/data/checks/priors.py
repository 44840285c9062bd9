"""Compares explanations of a log's torques by Bayesian evidence, with a Gaussian process for unknown robots.

An explanation is a Gaussian prior of all torques: a mean, and a sum of covariances weighted by variances. The weights
maximise the likelihood (minorisation-maximisation: Zhou et al., arXiv 1509.07426). The score of an explanation is the
probability of each block of time given all others, so a fault counts only if it shows in most of the log.

The torques of an unknown robot derive from one Lagrangian T(q, qd) - V(q) for all joints. With

    V ~ GP(0, v(q, q')),    T = sum over a, b of f_ab(q) qd_a qd_b / 2,    cov(T, T') = k(q, q') (qdᵀ W qd')²,

and kernels that are products over the coordinates, the torques d/dt dT/dqd - dT/dq + dV/dq are jointly Gaussian with a
closed-form covariance (the construction of Giacomuzzo et al., arXiv 2310.06585). The prior contains every tree of rigid
bodies with revolute joints. Most arms are chains with columns ordered from base to tip. The energy of a body then
depends only on the joints below it, and its kinetic energy does not depend on the first joint. These energies have
separate weights, so few samples are enough for chains; the general energies cover all other robots. Forces A(q) qd with
an antisymmetric A, for example from magnetic fields and flywheels, do not derive from T - V and have a covariance of
their own. Each joint adds friction: viscous, dry on two scales, and an offset.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.types import JointVector

ITERATIONS = 12
"""Iterations of the likelihood maximisation; the weights need one digit."""
BLOCKS = 10
WEIGHED = 300
"""Largest number of torques used to find the weights; predictions use all."""
STRONGEST = 0.5
"""Dependence of the energies on the angle of the joint with the largest inertia; 1 is a pure cosine."""
WEAKEST = 0.03
"""The same for joints with far smaller inertia."""
OF_BODY = 0.7
"""Dependence of a body's energies on the angle of each joint that moves it."""
MOST_BODIES = 8
"""Bodies of a chain with energies of their own; a longer chain uses every second or third."""
LENGTH = 2.0
"""Length scale of the energies for a prismatic joint, in multiples of its range."""
SCALES = (0.02, 0.3)
"""Velocity scales of dry friction, relative to the typical velocity of the joint."""


class Hypothesis(NamedTuple):
    """A log, and the faults repaired in it."""

    data: Trajectories
    rows: np.ndarray
    """Indices of the samples used [n]."""
    signs: JointVector
    """-1 for torques with the wrong sign."""
    order: tuple[int, ...]
    """Column of tau for every joint."""
    delay: float = 0.0
    """Delay of the torques in samples."""
    speed: float = 1.0
    """True speed of the joints relative to the speed by t."""
    gravity: np.ndarray | None = None
    """m/s² [3]; `None` for the stated gravity."""

    def states(self) -> Sequence[np.ndarray]:
        """q, qd and qdd at the rows' times, shifted back by the delay with linear interpolation."""
        whole = int(np.floor(-self.delay))
        part, first = -self.delay - whole, self.rows + whole
        rates = (self.data.q, self.data.qd, self.data.qdd)
        return [
            self.speed**order * ((1 - part) * values[first] + part * values[first + 1])
            for order, values in enumerate(rates)
        ]

    def torques(self, shift: int = 0) -> np.ndarray:
        """Torques of the joints `shift` samples later, with repaired signs and order."""
        return self.data.tau[self.rows + shift][:, list(self.order)] * self.signs


Inertias = tuple[np.ndarray, list[np.ndarray], list[np.ndarray], int]
"""Mean of inertial torques [d], their covariances with the torques [d, n d] and with themselves [d, d], and the index
of the first of their weights."""


class Prior(NamedTuple):
    """Gaussian prior of the torques of n samples [n d], sample by sample."""

    mean: Float[np.ndarray, " a"]
    parts: list[Float[np.ndarray, "a a"]]
    """Covariances, to be weighted."""
    columns: list[Float[np.ndarray, "a k"]]
    """Factors C of further covariances C Cᵀ, to be weighted; the last d are friction, joint by joint."""
    inertias: Callable[[Sequence[np.ndarray], np.ndarray], Inertias]
    """(states q, qd and qdd [m, d], R [d, m d]) -> R times the inertial torques at these states."""


Build = Callable[[Hypothesis], Prior]
"""Prior of the torques of a log."""


class Explanation(NamedTuple):
    """How well a prior explains the torques of a log."""

    log: Hypothesis
    prior: Prior
    """Without its `parts`, which are large."""
    weights: Float[np.ndarray, " w"]
    """Variance of every part, every factor, and every joint's noise."""
    inverse: Float[np.ndarray, "a a"]
    pull: Float[np.ndarray, " a"]
    """inverse (y - mean)."""
    densities: Float[np.ndarray, " B"]
    """Log probability of every block conditional on the others."""
    unexplained: Float[np.ndarray, "B d"]
    """Squared prediction error of every block, relative to the variance of the joint's torque."""


def explain(log: Hypothesis, prior: Prior, *, iterations: int = ITERATIONS) -> Explanation:
    """Finds the maximum-likelihood weights and predicts every block from the others."""
    tau = log.torques()
    n, d = tau.shape
    few = np.arange(n * d).reshape(n, d)[:: -(-n * d // WEIGHED)].ravel()
    sizes = np.maximum(tau.var(axis=0), 1e-12 * tau.var(axis=0).max())
    y, noise = tau.ravel() - prior.mean, np.tile(sizes, n)
    some = [part[np.ix_(few, few)] for part in prior.parts], [columns[few] for columns in prior.columns]
    weights = _likeliest(*some, y[few], noise[few], d, iterations)
    inverse = _inverse_covariance(prior.parts, prior.columns, weights, noise)
    pull = inverse @ y
    densities, unexplained = [], []
    for block in blocks_of(n, d):
        own = inverse[np.ix_(block, block)]
        error = np.linalg.solve(own, pull[block])
        densities.append(0.5 * np.linalg.slogdet(own)[1] - 0.5 * error @ own @ error)
        unexplained.append(np.mean(error.reshape(-1, d) ** 2, axis=0) / np.maximum(tau.var(axis=0), 1e-300))
    light = prior._replace(parts=[])
    return Explanation(log, light, weights, inverse, pull, np.array(densities), np.array(unexplained))


def _likeliest(
    parts: list[np.ndarray], factors: list[np.ndarray], y: np.ndarray, noise: np.ndarray, d: int, iterations: int
) -> np.ndarray:
    """Returns the weights of parts, factors and noise [w]; the likelihood grows in every iteration."""
    traces = [np.mean(np.diag(part) / noise) for part in parts]
    traces += [np.mean(np.sum(columns**2, axis=1) / noise) for columns in factors]
    start = np.mean(y**2 / noise) / np.maximum(traces, 1e-300) / max(len(traces), 1)
    weights = np.concatenate([start, np.full(d, 0.05)])
    for _ in range(iterations):
        inverse = _inverse_covariance(parts, factors, weights, noise)
        pull = inverse @ y
        slopes = [(pull @ part @ pull, np.vdot(inverse, part)) for part in parts]
        slopes += [(np.sum((columns.T @ pull) ** 2), np.vdot(columns, inverse @ columns)) for columns in factors]
        own = (pull**2 * noise).reshape(-1, d), (np.diag(inverse) * noise).reshape(-1, d)
        slopes += zip(*(values.sum(axis=0) for values in own), strict=True)
        weights = weights * np.array([np.sqrt(fit / max(size, 1e-300)) for fit, size in slopes])
        weights[-d:] = np.maximum(weights[-d:], 1e-7)
    return weights


def _inverse_covariance(
    parts: list[np.ndarray], factors: list[np.ndarray], weights: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Inverts the covariance with these weights of parts, factors and noise."""
    from scipy.linalg.lapack import dpotrf, dpotri  # pyright: ignore[reportAttributeAccessIssue]

    of_parts, of_factors, of_noise = np.split(weights, [len(parts), len(parts) + len(factors)])
    K = np.diag(np.tile(of_noise, len(noise) // len(of_noise)) * noise)
    for weight, part in zip(of_parts, parts, strict=True):
        K += weight * part
    for weight, columns in zip(of_factors, factors, strict=True):
        K += weight * columns @ columns.T
    # Rounding of large parts can make K indefinite if the noise is small, as on an exact log or a dead channel.
    K[np.diag_indices_from(K)] += len(K) * np.finfo(float).eps * K.diagonal().max()
    inverse, failed = dpotri(dpotrf(K, lower=True)[0], lower=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the torques is not positive definite")
    lower = np.tril(inverse)
    return lower + np.tril(inverse, -1).T


def blocks_of(n: int, d: int) -> list[np.ndarray]:
    """Indices of the equations of every block of samples."""
    return [block.ravel() for block in np.array_split(np.arange(n * d).reshape(n, d), min(BLOCKS, n))]


def any_energy(joints: Sequence[str]) -> Build:
    """Returns the prior without a robot: any kinetic and potential energy, gyroscopic forces and friction."""

    def build(log: Hypothesis) -> Prior:
        states = log.states()
        sizes = sizes_of(log)

        def inertias(pushed: Sequence[np.ndarray], rows: np.ndarray) -> Inertias:
            shared = [rows @ kinetic for kinetic, _ in covariances(pushed, states, joints, sizes)]
            own = [rows @ kinetic @ rows.T for kinetic, _ in covariances(pushed, pushed, joints, sizes)]
            return np.zeros(len(rows)), shared, own, 0

        kinetic, potential = zip(*covariances(states, states, joints, sizes), strict=True)
        parts = [*kinetic, *potential, *gyroscopic(log, joints)]
        return Prior(np.zeros(states[0].size), parts, friction(states[1]), inertias)

    return build


def gyroscopic(log: Hypothesis, joints: Sequence[str]) -> list[Float[np.ndarray, "a a"]]:
    """Covariance of A(q) qd for an antisymmetric A with A_ij ~ GP(0, sizes_i sizes_j k(q, q')); none for one joint.

    cov(tau_i, tau_j') = k sizes_i ([i = j] sum over l of sizes_l qd_l qd_l' - sizes_j qd_j qd_i').
    """
    q, qd, _ = log.states()
    sizes = sizes_of(log)
    n, d = q.shape
    if d == 1:
        return []
    strength, ranges = np.full(d, STRONGEST), np.maximum(np.ptp(q, axis=0), 1e-9)
    kernel = _kernel(q, q, joints, strength, ranges, 1)[0]
    along = kernel * ((qd * sizes) @ qd.T)
    across = kernel[..., None, None] * qd[:, None, None, :] * qd[None, :, :, None] * np.outer(sizes, sizes)
    both = along[..., None, None] * np.diag(sizes) - across
    return [both.transpose(0, 2, 1, 3).reshape(n * d, n * d)]


def sizes_of(log: Hypothesis) -> np.ndarray:
    """Estimates the magnitude of each joint's inertia [d] as the ratio of torques to accelerations."""
    ratios = log.torques().std(axis=0) / np.maximum(log.states()[2].std(axis=0), 1e-12)
    return np.maximum(ratios, 1e-3 * max(float(ratios.max()), 1e-300))


def covariances(
    states: Sequence[np.ndarray], others: Sequence[np.ndarray], joints: Sequence[str], sizes: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns torque covariances [n d, m d] for kinetic and potential energies of any robot, then of a chain's bodies.

    Args:
        states, others: q, qd and qdd [n, d].
        sizes: magnitudes of inertias [d]: W = diag(sizes) for an arbitrary energy, their mean for joints of a body.
    """
    (q, *rates), (other, *other_rates) = states, others
    relative = np.sqrt(sizes / sizes.max())
    ranges = np.maximum(np.ptp(q, axis=0), 1e-9)
    strength = np.clip(STRONGEST * relative, WEAKEST, STRONGEST)
    place = np.arange(len(sizes))
    energies = [(strength, strength, sizes)]  # strengths are zero for coordinates that an energy ignores
    for body in np.unique(np.linspace(0, place[-1], min(len(place), MOST_BODIES)).round()):
        turned = np.where(place <= body, OF_BODY, 0.0)
        energies.append((np.where(place > 0, turned, 0.0), turned, (place <= body) * sizes.mean()))
    pairs = []
    for of_kinetic, of_potential, W in energies:
        value, slope, bend = _kernel(q, other, joints, of_potential, ranges, 1)
        potential = -value[..., None, None] * _hessian(slope, bend)
        kinetic = _kinetic(_kernel(q, other, joints, of_kinetic, ranges, 2), rates, other_rates, W)
        pairs.append(tuple(matrix.transpose(0, 2, 1, 3).reshape(q.size, other.size) for matrix in (kinetic, potential)))
    return pairs


def _kernel(
    q: np.ndarray, other: np.ndarray, joints: Sequence[str], strength: np.ndarray, ranges: np.ndarray, power: int
) -> tuple[np.ndarray, ...]:
    """A product kernel k [n, m] of the coordinates, h_i = k_i' / k_i and e_i = k_i'' / k_i - h_i² [n, m, d]."""
    difference = q[:, None] - other[None]
    turning = np.array([kind == "revolute" for kind in joints])
    base = 1 + strength * np.cos(difference)
    first, second = -strength * np.sin(difference) / base, -strength * np.cos(difference) / base
    length = np.where(strength > 0, LENGTH * ranges, np.inf)
    logarithm = np.where(turning, power * np.log(base / (1 + strength)), -0.5 * (difference / length) ** 2)
    slope = np.where(turning, power * first, -difference / length**2)
    bend = np.where(turning, power * (second - first**2), -1 / length**2)
    return np.exp(logarithm.sum(axis=2)), slope, bend


def _hessian(slope: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """h_i h_j + [i = j] e_i [n, m, d, d]: minus the mixed second derivatives, divided by the value."""
    hessian = slope[..., :, None] * slope[..., None, :]
    diagonal = np.arange(slope.shape[2])
    hessian[..., diagonal, diagonal] += bend
    return hessian


def _kinetic(
    kernel: tuple[np.ndarray, ...], rates: Sequence[np.ndarray], others: Sequence[np.ndarray], W: np.ndarray
) -> np.ndarray:
    """L_i L'_j of k (uᵀ W v)² with L_i = d/dt d/du_i - d/dq_i, over states u = qd, a = qdd and others v, b."""
    value, h, e = kernel
    (u, a), (v, b) = [x[:, None] for x in rates], others
    U, A, V, B = (W * rate for rate in (u, a, v, b))

    def along(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        return np.sum(left * right, axis=-1, keepdims=True)

    def outer(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        return left[..., None] * right[..., None, :]

    # All divided by the kernel's value: k_i = h_i, k_j' = -h_j and k_ij' = -h_i h_j - [i = j] e_i.
    s, sa, sb, sab = along(U, v), along(A, v), along(U, b), along(A, b)
    uh, vh = along(u, h), along(v, h)
    both = -(uh * vh + along(u, v * e))  # D D' k with D = u . d/dq, D' = v . d/dq'
    half = outer(V, both * U - vh * A + (sa + s * uh) * h + s * u * e)
    half += outer(B, uh * U + A) + outer((s * vh - sb) * h + s * v * e, U)
    half += (both * s + uh * sb - vh * sa + sab)[..., None] * np.diag(W)
    return value[..., None, None] * (2 * half - s[..., None] ** 2 * _hessian(h, e))


def friction(qd: Float[np.ndarray, "n d"]) -> list[np.ndarray]:
    """Friction columns [n d, 4] of every joint, dimensionless: viscous, dry on two scales, and an offset."""
    n, d = qd.shape
    ratio = qd / np.maximum(qd.std(axis=0), 1e-12)
    own = np.stack([ratio, *(np.tanh(ratio / scale) for scale in SCALES), np.ones_like(qd)], axis=2)
    return [(own * (np.arange(d) == joint)[:, None]).reshape(n * d, -1) for joint in range(d)]
