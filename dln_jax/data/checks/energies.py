"""Forces of any energy: the covariance of torques whose kinetic and potential energy are Gaussian processes.

The robot is not known, but its torques have a Lagrangian T(q, qd) - V(q), one for all joints. With

    V ~ GP(0, v(q, q')),    T = sum over a, b of f_ab(q) qd_a qd_b / 2,    cov(T, T') = k(q, q') (qdᵀ W qd')²,

products of kernels of single angles, the torques d/dt dT/dqd - dT/dq + dV/dq are jointly Gaussian, and their covariance
is a closed form (the construction of Giacomuzzo et al., arXiv 2310.06585). It contains every tree of rigid bodies with
revolute joints. Most arms are chains whose columns run from the base to the tip: the energy of a body then depends on
the joints below it alone, and its kinetic energy not on the first joint. Energies of that form have weights of their
own, so that few samples suffice where they fit, and those of any energy remain where they do not. Friction, viscous,
dry on two scales, and an offset, is added to each joint by itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

STRONGEST = 0.5
"""Dependence of the energies on the angle of the joint with the largest forces; 1 would be a pure cosine."""
WEAKEST = 0.03
"""The same of joints with far smaller forces."""
OF_BODY = 0.7
"""Dependence of a body's energies on the angle of each joint that moves it."""
MOST_BODIES = 8
"""Bodies of a chain that have energies of their own; in a longer one, every second or third."""
LENGTH = 2.0
"""Ranges of a prismatic joint, over which energies change."""
SCALES = (0.02, 0.3)
"""Of each joint's typical velocity, over which its dry friction changes sign."""


class Parts(NamedTuple):
    """Covariances [n d, m d] of torques at two sets of states, of which the sum is taken with weights."""

    kinetic: Float[np.ndarray, "a b"]
    potential: Float[np.ndarray, "a b"]


class _Kernel(NamedTuple):
    """A product kernel of the coordinates and its logarithmic derivatives, [n, m] and [n, m, d]."""

    value: np.ndarray
    slope: np.ndarray
    """h_i = k_i' / k_i."""
    bend: np.ndarray
    """e_i = k_i'' / k_i - h_i²."""


def covariances(
    states: Sequence[np.ndarray], others: Sequence[np.ndarray], joints: Sequence[str], sizes: np.ndarray
) -> list[Parts]:
    """Covariances of torques without friction: those of any energy, then those of the bodies of a chain.

    Args:
        states, others: q, qd and qdd [n, d].
        joints: kind of each.
        sizes: of inertias [d]: W = diag(sizes) for any energy, and their mean for each body, whatever moves it.
    """
    relative = np.sqrt(sizes / sizes.max())
    ranges = np.maximum(np.ptp(states[0], axis=0), 1e-9)
    strength = np.clip(STRONGEST * relative, WEAKEST, STRONGEST)
    place = np.arange(len(sizes))
    found = [_covariance(states, others, joints, ranges, (strength, strength), sizes)]
    for body in np.unique(np.linspace(0, place[-1], min(len(place), MOST_BODIES)).round()):
        below = place <= body
        turned = np.where(below, OF_BODY, 0.0)
        moved = np.where(place > 0, turned, 0.0)
        found.append(_covariance(states, others, joints, ranges, (moved, turned), below * sizes.mean()))
    return found


def _covariance(
    states: Sequence[np.ndarray],
    others: Sequence[np.ndarray],
    joints: Sequence[str],
    ranges: np.ndarray,
    strengths: tuple[np.ndarray, np.ndarray],
    sizes: np.ndarray,
) -> Parts:
    """Of one energy; `strengths` [d] of the kinetic and the potential one are zero where it ignores a coordinate."""
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
    """h_i h_j + [i = j] e_i: minus the mixed second derivatives over the value [n, m, d, d]."""
    found = kernel.slope[..., :, None] * kernel.slope[..., None, :]
    diagonal = np.arange(kernel.slope.shape[2])
    found[..., diagonal, diagonal] += kernel.bend
    return found


def _kinetic(kernel: _Kernel, rates: Sequence[np.ndarray], others: Sequence[np.ndarray], W: np.ndarray) -> np.ndarray:
    """L_i L'_j of k (uᵀ W v)² with L_i = d/dt d/du_i - d/dq_i, over states u = qd, a = qdd and others v, b."""
    (u, a), (v, b) = rates, others
    h, e = kernel.slope, kernel.bend
    s, sa, sb, sab = ((left * W) @ right.T for left, right in ((u, v), (a, v), (u, b), (a, b)))
    uh, vh = np.einsum("ni,nmi->nm", u, h), np.einsum("mi,nmi->nm", v, h)
    U, V, A, B = (W * each for each in (u, v, a, b))
    eye = np.diag(W)

    # Over the kernel's value: D k = uh, D' k = -vh, k_i = h_i, k_j' = -h_j, with D = u . d/dq.
    both = -(uh * vh + np.einsum("ni,mi,nmi->nm", u, v, e))  # D D' k
    d_other = -(uh[..., None] * h + u[:, None] * e)  # D k_j'
    other_d = -(h * vh[..., None] + v[None] * e)  # D' k_i
    mixed = -_hessian(kernel)  # k_ij'

    def outer(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """right [m, i] times left [n, j] at [n, m, i, j]."""
        return right[None, :, :, None] * left[:, None, None, :]

    def scaled(scalar: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        return scalar[..., None, None] * matrix

    momentum = 2 * (outer(U, V) + scaled(s, eye))  # d/dv_j of 2 s V_i
    momentum_b = 2 * (outer(U, B) + scaled(sb, eye))  # B of it
    force = 2 * (outer(A, V) + scaled(sa, eye))
    force_b = 2 * (outer(A, B) + scaled(sab, eye))
    found = scaled(both, momentum) + scaled(uh, momentum_b)
    found -= (2 * s[..., None] * V[None])[..., :, None] * d_other[..., None, :]
    found += scaled(-vh, force) + force_b
    found -= (2 * sa[..., None] * V[None])[..., :, None] * (-h)[..., None, :]
    found -= other_d[..., :, None] * (2 * s[..., None] * U[:, None])[..., None, :]
    found -= h[..., :, None] * (2 * sb[..., None] * U[:, None])[..., None, :]
    found += mixed * (s**2)[..., None, None]
    return kernel.value[..., None, None] * found


def friction_columns(qd: Float[np.ndarray, "n d"], typical: Float[np.ndarray, " d"]) -> Float[np.ndarray, "n d 4"]:
    """Viscous friction, dry friction on two scales, and an offset, of each joint, in units of one."""
    ratio = qd / typical
    return np.stack([ratio, *(np.tanh(ratio / scale) for scale in SCALES), np.ones_like(qd)], axis=2)
