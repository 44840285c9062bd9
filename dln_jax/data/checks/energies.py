"""Torques of an unknown robot: their covariance if kinetic and potential energy are Gaussian processes.

The robot is unknown, but its torques derive from one Lagrangian T(q, qd) - V(q) for all joints. With

    V ~ GP(0, v(q, q')),    T = sum over a, b of f_ab(q) qd_a qd_b / 2,    cov(T, T') = k(q, q') (qdᵀ W qd')²,

and kernels that are products over the coordinates, the torques d/dt dT/dqd - dT/dq + dV/dq are jointly Gaussian with a
closed-form covariance (the construction of Giacomuzzo et al., arXiv 2310.06585). The prior contains every tree of rigid
bodies with revolute joints. Most arms are chains with columns ordered from base to tip: the energy of a body then
depends on the joints below it only, and its kinetic energy not on the first joint. Such energies have weights of their
own, so few samples suffice for chains, and the general energies remain for all other robots. Forces A(q) qd with an
antisymmetric A, as of magnetic fields and flywheels, belong to no T - V and have a covariance of their own. Each joint
adds its own friction: viscous, dry on two scales, and an offset.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.checks.evidence import Prior

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


States = tuple[np.ndarray, np.ndarray, np.ndarray]
Build = Callable[[States, np.ndarray, np.ndarray | None], Prior]
"""(q, qd, qdd [n, d]), torques [n, d], gravity [3] (`None` for the stated one) -> prior of those torques."""


class Parts(NamedTuple):
    """Covariances [n d, m d] of torques at two sets of states, to be summed with weights."""

    kinetic: Float[np.ndarray, "a b"]
    potential: Float[np.ndarray, "a b"]


class _Kernel(NamedTuple):
    """A product kernel [n, m] of the coordinates and its logarithmic derivatives [n, m, d]."""

    value: np.ndarray
    slope: np.ndarray
    """h_i = k_i' / k_i."""
    bend: np.ndarray
    """e_i = k_i'' / k_i - h_i²."""


def any_energy(joints: tuple[str, ...]) -> Build:
    """Prior without a robot: torques of an arbitrary kinetic and potential energy, gyroscopic forces and friction."""

    def build(states: States, tau: np.ndarray, gravity: np.ndarray | None) -> Prior:
        del gravity  # any
        sizes = sizes_of(states[2], tau)
        pairs = covariances(states, states, joints, sizes)
        parts = [pair.kinetic for pair in pairs] + [pair.potential for pair in pairs]

        def inertias(pushed: States, rows: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray], int]:
            shared = [rows @ pair.kinetic for pair in covariances(pushed, states, joints, sizes)]
            own = [rows @ pair.kinetic @ rows.T for pair in covariances(pushed, pushed, joints, sizes)]
            return np.zeros(len(rows)), shared, own, 0

        parts += gyroscopic(states, joints, sizes)
        return Prior(np.zeros(tau.size), parts, friction(states[1]), inertias)

    return build


def gyroscopic(states: States, joints: Sequence[str], sizes: np.ndarray) -> list[Float[np.ndarray, "a a"]]:
    """Covariance of A(q) qd for an antisymmetric A with A_ij ~ GP(0, sizes_i sizes_j k(q, q')); none for one joint.

    cov(tau_i, tau_j') = k sizes_i ([i = j] sum over l of sizes_l qd_l qd_l' - sizes_j qd_j qd_i').
    """
    q, qd, _ = states
    n, d = q.shape
    if d == 1:
        return []
    strength, ranges = np.full(d, STRONGEST), np.maximum(np.ptp(q, axis=0), 1e-9)
    kernel = _kernel(q, q, joints, strength, ranges, 1).value
    along = kernel * ((qd * sizes) @ qd.T)
    across = kernel[..., None, None] * qd[:, None, None, :] * qd[None, :, :, None] * np.outer(sizes, sizes)
    both = along[..., None, None] * np.diag(sizes) - across
    return [both.transpose(0, 2, 1, 3).reshape(n * d, n * d)]


def sizes_of(qdd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Magnitudes of the joints' inertias [d] as the ratio of torques to accelerations."""
    ratios = tau.std(axis=0) / np.maximum(qdd.std(axis=0), 1e-12)
    return np.maximum(ratios, 1e-3 * max(float(ratios.max()), 1e-300))


def covariances(
    states: Sequence[np.ndarray], others: Sequence[np.ndarray], joints: Sequence[str], sizes: np.ndarray
) -> list[Parts]:
    """Covariances of torques without friction: first for an arbitrary energy, then for the bodies of a chain.

    Args:
        states, others: q, qd and qdd [n, d].
        sizes: magnitudes of inertias [d]: W = diag(sizes) for an arbitrary energy, their mean for joints of a body.
    """
    relative = np.sqrt(sizes / sizes.max())
    ranges = np.maximum(np.ptp(states[0], axis=0), 1e-9)
    strength = np.clip(STRONGEST * relative, WEAKEST, STRONGEST)
    place = np.arange(len(sizes))
    pairs = [_covariance(states, others, joints, ranges, (strength, strength), sizes)]
    for body in np.unique(np.linspace(0, place[-1], min(len(place), MOST_BODIES)).round()):
        below = place <= body
        turned = np.where(below, OF_BODY, 0.0)
        moved = np.where(place > 0, turned, 0.0)
        pairs.append(_covariance(states, others, joints, ranges, (moved, turned), below * sizes.mean()))
    return pairs


def _covariance(
    states: Sequence[np.ndarray],
    others: Sequence[np.ndarray],
    joints: Sequence[str],
    ranges: np.ndarray,
    strengths: tuple[np.ndarray, np.ndarray],
    sizes: np.ndarray,
) -> Parts:
    """Covariance of one energy; `strengths` [d] (kinetic, potential) are zero for coordinates that it ignores."""
    kinetic, potential = (
        _kernel(states[0], others[0], joints, strength, ranges, power)
        for strength, power in zip(strengths, (2, 1), strict=True)
    )
    n, m, d = potential.slope.shape
    of_potential = -potential.value[..., None, None] * _hessian(potential)
    return Parts(
        _kinetic(kinetic, states[1:], others[1:], sizes).transpose(0, 2, 1, 3).reshape(n * d, m * d),
        of_potential.transpose(0, 2, 1, 3).reshape(n * d, m * d),
    )


def _kernel(
    q: np.ndarray, other: np.ndarray, joints: Sequence[str], strength: np.ndarray, ranges: np.ndarray, power: int
) -> _Kernel:
    difference = q[:, None] - other[None]
    turning = np.array([kind == "revolute" for kind in joints])
    base = 1 + strength * np.cos(difference)
    first, second = -strength * np.sin(difference) / base, -strength * np.cos(difference) / base
    length = np.where(strength > 0, LENGTH * ranges, np.inf)
    logarithm = np.where(turning, power * np.log(base / (1 + strength)), -0.5 * (difference / length) ** 2)
    slope = np.where(turning, power * first, -difference / length**2)
    bend = np.where(turning, power * (second - first**2), -1 / length**2)
    return _Kernel(np.exp(logarithm.sum(axis=2)), slope, bend)


def _hessian(kernel: _Kernel) -> np.ndarray:
    """h_i h_j + [i = j] e_i [n, m, d, d]: minus the mixed second derivatives, divided by the value."""
    hessian = kernel.slope[..., :, None] * kernel.slope[..., None, :]
    diagonal = np.arange(kernel.slope.shape[2])
    hessian[..., diagonal, diagonal] += kernel.bend
    return hessian


def _kinetic(kernel: _Kernel, rates: Sequence[np.ndarray], others: Sequence[np.ndarray], W: np.ndarray) -> np.ndarray:
    """L_i L'_j of k (uᵀ W v)² with L_i = d/dt d/du_i - d/dq_i, over states u = qd, a = qdd and others v, b."""
    (u, a), (v, b) = rates, others
    h, e = kernel.slope, kernel.bend
    s, sa, sb, sab = ((left * W) @ right.T for left, right in ((u, v), (a, v), (u, b), (a, b)))
    uh, vh = np.einsum("ni,nmi->nm", u, h), np.einsum("mi,nmi->nm", v, h)
    U, V, A, B = (W * rate for rate in (u, v, a, b))
    eye = np.diag(W)

    # All divided by the kernel's value: D k = uh, D' k = -vh, k_i = h_i, k_j' = -h_j, with D = u . d/dq.
    both = -(uh * vh + np.einsum("ni,mi,nmi->nm", u, v, e))  # D D' k
    d_other = -(uh[..., None] * h + u[:, None] * e)  # D k_j'
    other_d = -(h * vh[..., None] + v[None] * e)  # D' k_i
    mixed = -_hessian(kernel)  # k_ij'

    def outer(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """The product right[m, i] left[n, j] as [n, m, i, j]."""
        return right[None, :, :, None] * left[:, None, None, :]

    def scaled(scalar: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        return scalar[..., None, None] * matrix

    momentum = 2 * (outer(U, V) + scaled(s, eye))  # d/dv_j of 2 s V_i
    momentum_b = 2 * (outer(U, B) + scaled(sb, eye))  # B of it
    force = 2 * (outer(A, V) + scaled(sa, eye))
    force_b = 2 * (outer(A, B) + scaled(sab, eye))
    total = scaled(both, momentum) + scaled(uh, momentum_b)
    total -= (2 * s[..., None] * V[None])[..., :, None] * d_other[..., None, :]
    total += scaled(-vh, force) + force_b
    total -= (2 * sa[..., None] * V[None])[..., :, None] * (-h)[..., None, :]
    total -= other_d[..., :, None] * (2 * s[..., None] * U[:, None])[..., None, :]
    total -= h[..., :, None] * (2 * sb[..., None] * U[:, None])[..., None, :]
    total += mixed * (s**2)[..., None, None]
    return kernel.value[..., None, None] * total


def friction(qd: Float[np.ndarray, "n d"]) -> list[np.ndarray]:
    """Friction columns [n d, 4] of every joint, dimensionless: viscous, dry on two scales, and an offset."""
    n, d = qd.shape
    ratio = qd / np.maximum(qd.std(axis=0), 1e-12)
    own = np.stack([ratio, *(np.tanh(ratio / scale) for scale in SCALES), np.ones_like(qd)], axis=2)
    return [(own * (np.arange(d) == joint)[:, None]).reshape(n * d, -1) for joint in range(d)]
