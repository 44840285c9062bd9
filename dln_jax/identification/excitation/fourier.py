"""Motions as finite Fourier series of one period, from rest to rest.

    q(t) = offset + sum over k = 1..H of s_k sin(k w t) + c_k cos(k w t),   w = 2 pi / period

after Swevers, Ganseman, Tukel, De Schutter and Van Brussel (1997, IEEE T-RA 13, "Optimal robot excitation and
identification"). Rates are exact, the spectrum is known, and a motion can be repeated indefinitely. Velocity and
acceleration vanish at both ends if sum k s_k = 0 and sum k² c_k = 0, whose solutions `rest_basis` spans.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.linalg import block_diag

from dln_jax.types import InputError, Scalar, Vector, require_positive

MOST_HARMONICS = 50
"""Upper limit of harmonics for a design: more give no smooth motion and take hours."""


class FourierMotion(NamedTuple):
    """A periodic motion of d joints with H harmonics."""

    offset: Any
    """[d], mean posture, rad or m."""
    coefficients: Any
    """[d, 2 H]: s_1 .. s_H, c_1 .. c_H; rad or m."""
    period: float
    """s."""

    @property
    def harmonics(self) -> int:
        """H."""
        return np.shape(self.coefficients)[1] // 2


def state(motion: FourierMotion, t: Scalar | float) -> tuple[Vector, Vector, Vector]:
    """q, qd and qdd [d] at a time t, s."""
    values = harmonic_functions(motion.harmonics, motion.period, t)
    q, qd, qdd = (motion.coefficients @ functions for functions in values)
    return motion.offset + q, qd, qdd


def sample(motion: FourierMotion, t: Any) -> tuple[Float[Array, "N d"], Float[Array, "N d"], Float[Array, "N d"]]:
    """q, qd and qdd at the times t [N], s."""
    return jax.vmap(lambda time: state(motion, time))(jnp.asarray(t))


def harmonic_functions(harmonics: int, period: float, t: Scalar | float) -> tuple[Vector, Vector, Vector]:
    """sin(k w t) for k = 1..H, then cos(k w t), and their first and second derivatives; [2 H] each."""
    rates = 2 * np.pi / period * np.arange(1, harmonics + 1)
    sines, cosines = jnp.sin(rates * t), jnp.cos(rates * t)
    values = jnp.concatenate([sines, cosines])
    slopes = jnp.concatenate([rates * cosines, -rates * sines])
    return values, slopes, -(jnp.concatenate([rates, rates]) ** 2) * values


def rest_basis(harmonics: int) -> Float[np.ndarray, "F K"]:
    """Orthonormal columns [2 H, 2 H - 2] that span the coefficients of a joint at rest at both ends.

    Raises:
        InputError: fewer than two harmonics, which cannot move from rest to rest, or more than `MOST_HARMONICS`.
    """
    if not 2 <= harmonics <= MOST_HARMONICS:
        raise InputError(
            f"harmonics is {harmonics}; expected 2 to {MOST_HARMONICS}: with 1 a motion cannot start and end at rest"
        )
    orders = np.arange(1.0, harmonics + 1)
    # All but the first right singular vector of an equation are orthogonal to it.
    rests = (np.linalg.svd(equation[None, :])[2][1:].T for equation in (orders, orders**2))
    return np.asarray(block_diag(*rests))


def require_sampling(*, period: float, harmonics: int, rate: float) -> None:
    """Raises `InputError` unless the highest harmonic is below half the sampling rate (Hz)."""
    require_positive(seconds=period, harmonics=harmonics, rate=rate)
    highest = harmonics / period
    if highest >= rate / 2:
        raise InputError(
            f"{harmonics} harmonics of {period:g} s reach {highest:g} Hz, beyond half the sampling rate of {rate:g} "
            "Hz; take fewer harmonics, more seconds or a higher rate"
        )
