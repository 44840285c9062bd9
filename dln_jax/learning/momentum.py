"""Fits any energies to q, qd and tau in weak form: `learning.weak_forms` for models not linear in their parameters.

    r_w = [integral w (s - tau) dt - integral w' p dt] / unit_w,   p = M(q) qd,   s = tau(q, qd, 0) - dM/dt qd

The window w is zero at both ends; r_w compares the change of momentum with the measured forces. It contains no
accelerations, and torques that are held between samples are no harder to fit than smooth ones.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.encoders import smooth
from dln_jax.data.encoders.sampling import delayed
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments
from dln_jax.learning.engine.problem import Problem, arrays_of, selected_by
from dln_jax.learning.objectives import torque_scale
from dln_jax.learning.weak_forms import FEWEST, OVERLAP, WINDOW, fit_momentum, momentum_and_rest, window_weights
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, require_positive

WHOLE = 0.05
"""Distance from a whole number of samples within which an estimated delay is rounded."""


class MomentumWindows(NamedTuple):
    """W windows of S steps."""

    q: Float[np.ndarray, "W S+1 d"]
    qd: Float[np.ndarray, "W S+1 d"]
    impulse: Float[np.ndarray, "W d"]
    """Integral of w tau dt, N m or N: a mean torque if the integral of w is 1."""
    dt: float


def cut_momentum_windows(data: Trajectories, *, window: float = WINDOW) -> MomentumWindows:
    """Cuts overlapping windows of a length in s within gapless segments; `InputError` if no segment is long enough."""
    require_positive(window=window)
    pieces = segments(data.t, data.trajectory)
    dt = float(np.median(np.concatenate([np.diff(data.t[piece]) for piece in pieces])))
    steps = max(FEWEST, round(window / dt))
    rows = [
        piece[first : first + steps + 1]
        for piece in pieces
        for first in range(0, len(piece) - steps, max(1, steps // OVERLAP))
    ]
    if not rows:
        raise InputError(f"no segment of the data is as long as a window of {window:g} s; give a shorter one")
    chosen = np.stack(rows)
    w, _ = window_weights(steps, dt)
    return MomentumWindows(data.q[chosen], data.qd[chosen], np.einsum("s,wsd->wd", w, data.tau[chosen]), dt)


def momentum_errors(plant: Dynamics, q: Array, qd: Array, impulse: Array, *, dt: float) -> Array:
    """Residual of one window's equations [d], in N m or N."""
    w, slope = map(jnp.asarray, window_weights(q.shape[0] - 1, dt))
    p, rest = jax.vmap(lambda q, qd: momentum_and_rest(plant, q, qd))(q, qd)
    return w @ rest - slope @ p - impulse


def deviations(plant: Dynamics, windows: MomentumWindows) -> Float[np.ndarray, " d"]:
    """Root mean square over windows of the residuals of the joints' equations, N m or N."""
    left = jax.jit(jax.vmap(lambda *window: momentum_errors(plant, *window, dt=windows.dt)))(*windows[:3])
    return np.sqrt(np.mean(np.asarray(left) ** 2, axis=0))


def momentum_problem(
    model: Model,
    parameters: Parameters,
    windows: MomentumWindows,
    validation: MomentumWindows,
    *,
    unit: Sequence[float] | Float[np.ndarray, " d"],
    seed: int = 0,
) -> Problem:
    """Builds the problem of fitting a model's parameters to windows, selected by validation windows, in float64.

    Args:
        model: model of energies in coordinates and velocities.
        validation: windows that select the parameters.
        unit: scale of the joints' residuals [d], N m or N, for example the residuals of another model (`deviations`).

    Raises:
        InputError: a unit that is not positive, or validation windows of another length.
    """
    for size in unit:
        require_positive(unit=float(size))
    if windows.q.shape[1] != validation.q.shape[1]:
        raise InputError(
            f"windows have {windows.q.shape[1]} samples, those for validation {validation.q.shape[1]}; cut both to one "
            "length"
        )
    sizes = jnp.asarray(unit)

    def residual(parameters: Parameters, *window: Array) -> Array:
        return momentum_errors(dynamics(model.energies(parameters)), *window, dt=windows.dt) / sizes

    fitted, held_out = (arrays_of(part, ("q", "qd", "impulse")) for part in (windows, validation))
    return selected_by(held_out, residual, parameters, fitted, seed)


def driven_torques(data: Trajectories, *, delay: Any) -> Trajectories:
    """Returns the torques that act at the samples, from commanded torques that are delayed and held between samples.

    A torque held over a step contributes to both its ends: the torque at a sample is the mean of those held before and
    after it. The first torques of a trajectory, before the first command, are zero.

    Args:
        delay: delay of the commands in samples.

    Raises:
        InputError: a delay that is negative or not finite.
    """
    acting = np.zeros_like(data.tau)
    for index in np.unique(data.trajectory):
        rows = np.flatnonzero(data.trajectory == index)
        steps = delayed(data.tau[rows], float(delay))
        acting[rows] = (np.concatenate([np.zeros_like(steps[:1]), steps[:-1]]) + steps) / 2
    return data._replace(tau=acting)


def delay_of_torques(model: Model, recording: Trajectories, *, most: int) -> float:
    """Estimates the delay of torques in samples by the smallest residual of a model that is linear in its parameters.

    A parabola through the squared residuals near the best whole number gives the fraction of a sample, because commands
    of hardware may take effect between samples. Estimates within `WHOLE` of a whole number are rounded to it.

    Args:
        model: model that is linear in its parameters, such as `models.make_trigonometric`.
        recording: q and the commanded torques.
        most: largest delay that is tried; the smallest is 0.

    Raises:
        InputError: as for `smooth` and `fit_momentum`.
    """
    smoothed = smooth(recording)
    unit = np.asarray(torque_scale(smoothed.data))

    def misfit(delay: float) -> float:
        late = smooth(driven_torques(recording, delay=delay), smoothed.cutoff).data
        return fit_momentum(model, late, noise=unit).residual ** 2

    tried = {delay: misfit(delay) for delay in map(float, range(most + 1))}
    first = max(min(tried, key=tried.__getitem__) - 0.5, 0.0)
    below, centre, above = (tried[at] if at in tried else misfit(at) for at in (first, first + 0.5, first + 1.0))
    bend = below - 2 * centre + above
    delay = first + 0.5 + float(np.clip(0.25 * (below - above) / bend if bend > 0 else 0.0, -0.5, 0.5))
    return float(round(delay)) if abs(delay - round(delay)) < WHOLE else delay
