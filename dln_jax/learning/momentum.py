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
from jaxtyping import Float, Int

from dln_jax.data.encoders.sampling import delay_held
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments
from dln_jax.learning.engine.problem import Problem, arrays_of, selected_by
from dln_jax.learning.objectives import torque_scale
from dln_jax.learning.weak_forms import FEWEST, OVERLAP, WINDOW, fit_momentum, momentum_and_rest, window_weights
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, require_positive

SURE = 4.0
"""An estimated delay is rounded if it is within this number of standard errors of a whole number."""


class MomentumWindows(NamedTuple):
    """W windows of S steps."""

    q: Float[np.ndarray, "W S+1 d"]
    qd: Float[np.ndarray, "W S+1 d"]
    impulse: Float[np.ndarray, "W d"]
    """Integral of w tau dt, N m or N: a mean torque if the integral of w is 1."""
    dt: float
    trajectory: Int[np.ndarray, " W"]


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
    impulse = np.einsum("s,wsd->wd", w, data.tau[chosen])
    return MomentumWindows(data.q[chosen], data.qd[chosen], impulse, dt, np.asarray(data.trajectory[chosen[:, 0]]))


def momentum_errors(plant: Dynamics, q: Array, qd: Array, impulse: Array, *, dt: float) -> Array:
    """Residual of one window's equations [d], in N m or N."""
    w, slope = map(jnp.asarray, window_weights(q.shape[0] - 1, dt))
    p, rest = jax.vmap(lambda q, qd: momentum_and_rest(plant, q, qd))(q, qd)
    return w @ rest - slope @ p - impulse


def deviations(plant: Dynamics, windows: MomentumWindows) -> Float[np.ndarray, " d"]:
    """Root mean square over windows of the residuals of the joints' equations, N m or N."""
    return np.sqrt(np.mean(np.asarray(jax.jit(lambda: _residuals(plant, windows))()) ** 2, axis=0))


def acceleration_misfit(plant: Dynamics, windows: MomentumWindows) -> Array:
    """Half the log determinant of the covariance of acceleration errors: residuals divided by M in a window's middle.

    It compares models of one plant. Residuals alone favour models with small parameters if a joint has no motor.
    """
    masses = jax.vmap(plant.mass_matrix)(jnp.asarray(windows.q[:, windows.q.shape[1] // 2]))
    errors = jnp.linalg.solve(masses, _residuals(plant, windows)[..., None])[..., 0]
    return jnp.linalg.slogdet(errors.T @ errors / len(errors))[1] / 2


def _residuals(plant: Dynamics, windows: MomentumWindows) -> Float[Array, "W d"]:
    return jax.vmap(lambda *window: momentum_errors(plant, *window, dt=windows.dt))(*map(jnp.asarray, windows[:3]))


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
        steps = delay_held(data.tau[rows], float(delay))
        acting[rows] = (np.concatenate([np.zeros_like(steps[:1]), steps[:-1]]) + steps) / 2
    return data._replace(tau=acting)


class _Share(NamedTuple):
    """Share of the step between two whole delays."""

    share: float
    error: float
    """Standard error of the share."""
    squares: float
    """Sum of the squared residuals with this share."""


def delay_of_torques(model: Model, recording: Trajectories, *, most: int) -> float:
    """Estimates the delay of torques in samples: that with the smallest residuals of a model linear in its parameters.

    Commands of hardware may take effect between samples. The fitted equations' residuals r are linear in the torques:
    between the whole delays k and k + 1,

        r = r_k - s D,    D = r_k - r_{k+1},    s = r_k . D / D . D

    The episodes' parts of r . D give the standard error of s. A delay within `SURE` standard errors of a whole number
    is rounded to it.

    Args:
        model: model that is linear in its parameters, such as `models.make_trigonometric`.
        recording: q and the commanded torques.
        most: largest whole delay that is tried; the smallest is 0.

    Raises:
        InputError: as for `smooth` and `fit_momentum`.
    """
    smoothed = smooth(recording)
    unit = np.asarray(torque_scale(smoothed.data))

    def errors(delay: int) -> np.ndarray:
        late = smooth(driven_torques(recording, delay=delay), smoothed.cutoff).data
        return fit_momentum(model, late, noise=unit).errors / unit

    of_delays = [errors(whole) for whole in range(most + 1)]
    episode = cut_momentum_windows(smoothed.data).trajectory
    shares = [_between(of_delays[k], of_delays[k + 1], episode) for k in range(most)]
    best = min(range(most), key=lambda k: shares[k].squares)
    delay = best + shares[best].share
    return float(round(delay)) if abs(delay - round(delay)) < SURE * shares[best].error else delay


def _between(
    earlier: Float[np.ndarray, "W d"], later: Float[np.ndarray, "W d"], episode: Int[np.ndarray, " W"]
) -> _Share:
    """Returns the share with the smallest residuals; its error is infinite if all windows are of one episode."""
    change = earlier - later
    total = float(np.sum(change**2)) or np.inf
    share = float(np.clip(np.sum(earlier * change) / total, 0.0, 1.0))
    left = earlier - share * change
    # Windows of one episode share their errors, so that each episode counts once.
    parts = [np.sum((left * change)[episode == one]) for one in np.unique(episode)]
    error = np.sqrt(np.sum(np.square(parts)) * len(parts) / (len(parts) - 1)) / total if len(parts) > 1 else np.inf
    return _Share(share, float(error), float(np.sum(left**2)))
