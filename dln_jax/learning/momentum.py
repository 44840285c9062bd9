"""Fits models to q, qd and torques by the weak form of the equations of motion, without accelerations.

With the momentum p = M(q) qd, tau = dp/dt + s(q, qd), where s = tau(q, qd, 0) - dM/dt qd has gravity, friction and the
rest of the Coriolis forces. Multiply by a window w(t) that is zero at both ends, and integrate by parts:

    - integral w' p dt + integral w s dt = integral w tau dt

(modulating functions, Shinbrot 1957; for robots the filtered forms of Slotine and Li 1987.) There are no accelerations,
which have noise that grows with the square of the frequency. Both sides pass through the same low-pass, so dry friction
is not distorted, and the result hardly depends on the cut-off of q. Torques held between samples fit as well as smooth
ones. The windows are sin⁴ (pi t / W); sums over their samples are accurate for smooth motions.

`fit_momentum` fits any model that is linear in its parameters: one equation per joint and window. `momentum_errors` are
the residuals of any other model, and `acceleration_misfit` compares models of one plant.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from dln_jax.data.encoders.sampling import EVEN
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments
from dln_jax.learning.linear import parameters_of, shapes_of, unravelled
from dln_jax.learning.objectives import torque_scale
from dln_jax.learning.posterior import Rows
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model
from dln_jax.precision import compiled
from dln_jax.solvers import least_squares
from dln_jax.solvers.least_squares import LeastSquaresSolution
from dln_jax.solvers.normal_equations import count
from dln_jax.types import InputError, JointVector, Vector, require_positive

WINDOW = 0.16
"""Length of a window in s: about two periods of a low-pass at 12 Hz."""
FEWEST = 8
"""Smallest number of steps of a window."""
OVERLAP = 5
"""Number of windows that start within one window length; more would be nearly redundant."""
CHUNK = 4096
"""Number of samples per chunk of columns in memory."""
ROUNDS = 10
"""Largest number of reweighted fits; three to five are usual."""
SETTLED = 0.01
"""Relative change of the error covariance that ends the reweighting."""


class MomentumWindows(NamedTuple):
    """W windows of S steps."""

    q: Float[np.ndarray, "W S+1 d"]
    qd: Float[np.ndarray, "W S+1 d"]
    impulse: Float[np.ndarray, "W d"]
    """Integral of w tau dt, N m or N: a mean torque if the integral of w is 1."""
    dt: float
    trajectory: Int[np.ndarray, " W"]


def fit_momentum(
    model: Model,
    data: Trajectories,
    *,
    window: float = WINDOW,
    noise: JointVector | None = None,
    reweighted: bool = False,
    **tolerances: Any,
) -> tuple[Any, Float[np.ndarray, "W d"], LeastSquaresSolution]:
    """Fits the momenta of windows by least squares, in float64, without qdd.

    Returns the parameters in the model's dtype, the error of the mean torques of each window in N m or N, and the
    solution with its rank and condition number.

    Args:
        model: linear in its parameters, such as `make_rigid_tree` and
            `make_trigonometric`.
        data: samples at equal time steps, with smooth velocities and measured torques, from
            `data.encoders.smoothing.smooth`.
        window: length in s, at least `FEWEST` steps.
        noise: standard deviation of the torque noise of each joint, which divides the equations (default: of the
            torques).
        reweighted: weight the equations by the covariance of their own errors until it settles (iterated generalised
            least squares, Zellner 1962). Encoder noise enters the equations of all joints through the mass matrix.
            Without its correlations, the equations of joints without a motor, which zero parameters satisfy, pull the
            parameters of a plant with weak motors towards zero.
        tolerances: ridge, rank_tolerance and negligible of `solvers.least_squares.solve`.

    Raises:
        InputError: unequal steps, segments shorter than a window, constant torques, or settings out of range.
    """
    require_positive(window=window)
    d, like = data.degrees_of_freedom, shapes_of(model)
    with jax.enable_x64(True):
        scale = torque_scale(data) if noise is None else np.asarray(noise, float)
        if scale.shape != (d,) or not (scale > 0).all():
            raise InputError(f"noise is {scale}; expected {d} positive numbers, one per joint")
        equations = list(_equations(functools.partial(_columns(model), np.zeros(count(like))), data, window))

    def solve(factor: np.ndarray) -> tuple[LeastSquaresSolution, np.ndarray]:
        """Returns solution and errors [W, d] for errors with the covariance factor factorᵀ."""
        weighted = (
            (np.linalg.solve(factor, A).reshape(b.size, -1), np.linalg.solve(factor, b[..., None]).ravel())
            for A, b in equations
        )
        solution = least_squares.solve_chunks(weighted, **tolerances)
        return solution, np.concatenate([A @ solution.x - b for A, b in equations])

    factor = np.diag(scale)
    solution, errors = solve(factor)
    for _ in range(1, ROUNDS if reweighted else 1):
        covariance = errors.T @ errors / len(errors)
        change = np.linalg.solve(factor, np.linalg.solve(factor, covariance).T) - np.eye(d)
        if np.abs(change).max() < SETTLED:
            break
        try:
            factor = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            break  # exact data leave no errors
        solution, errors = solve(factor)
    return parameters_of(solution.x, like), errors, solution


def momentum_and_rest(plant: Dynamics, q: Vector, qd: Vector) -> tuple[Vector, Vector]:
    """Returns p = M qd and s = tau(q, qd, 0) - dM/dt qd of one state, so that tau = dp/dt + s."""
    p, change = jax.jvp(lambda place: plant.mass_matrix(place) @ qd, (q,), (qd,))
    return p, plant.inverse_dynamics(q, qd, jnp.zeros_like(qd)) - change


def window_weights(steps: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns w dt and w' dt [steps + 1] of a window with this number of steps; the integral of w is 1."""
    phase = np.pi * np.arange(steps + 1) / steps
    w, slope = np.sin(phase) ** 4, 4 * np.pi / (steps * dt) * np.sin(phase) ** 3 * np.cos(phase)
    return w / w.sum(), slope / w.sum()


@functools.lru_cache(maxsize=4)
def _columns(model: Model) -> Callable[..., Array]:
    """Returns the compiled (theta [P], q, qd as [N, d]) -> derivatives [N, 2 d, P] of p and s by theta."""
    like = shapes_of(model)

    def both(theta: Array, q: Vector, qd: Vector) -> Array:
        return jnp.concatenate(momentum_and_rest(dynamics(model.energies(unravelled(theta, like))), q, qd))

    return compiled(jax.vmap(jax.jacrev(both), in_axes=(None, 0, 0)))


def _cut(data: Trajectories, window: float) -> tuple[list[Int[np.ndarray, "W S+1"]], float]:
    """Returns the samples of overlapping windows in all segments that are long enough, and their time step.

    Raises:
        InputError: unequal steps, or all segments are too short.
    """
    pieces = segments(data.t, data.trajectory)
    dt = float(np.median(np.concatenate([np.diff(data.t[piece]) for piece in pieces])))
    steps = max(FEWEST, round(window / dt))
    for piece in pieces:
        late = np.abs(data.t[piece] - data.t[piece[0]] - dt * np.arange(len(piece)))
        if len(piece) > FEWEST and late.max() > 10 * EVEN * dt * len(piece):
            raise InputError(
                "windows need equal time steps, but the steps vary; resample with data.encoders.smoothing.smooth"
            )
    windows = [np.lib.stride_tricks.sliding_window_view(piece, steps + 1) for piece in pieces if len(piece) > steps]
    if not windows:
        raise InputError(f"no segment of the data is as long as a window of {window:g} s; give a shorter one")
    return [own[:: max(1, steps // OVERLAP)] for own in windows], dt


def _equations(program: Callable[..., Array], data: Trajectories, window: float) -> Rows:
    """Yields the columns [W, d, P] and right-hand sides [W, d] of windows in chunks."""
    pieces, dt = _cut(data, window)
    steps, d = pieces[0].shape[1] - 1, data.degrees_of_freedom
    w, slope = window_weights(steps, dt)
    apart = max(1, steps // OVERLAP)
    together = min(max(map(len, pieces)), max(1, (CHUNK - steps) // apart))
    for piece in pieces:
        for rows in (piece[first : first + together] for first in range(0, len(piece), together)):
            first, last = rows[0, 0], rows[-1, -1]
            # One program serves all chunks, since they have the same length; the last ones repeat a sample.
            samples = np.minimum(first + np.arange((together - 1) * apart + steps + 1), last)
            values = np.asarray(program(data.q[samples], data.qd[samples]))
            columns = [
                np.tensordot(w, values[own, d:], 1) - np.tensordot(slope, values[own, :d], 1) for own in rows - first
            ]
            yield np.stack(columns), np.einsum("s,wsd->wd", w, data.tau[rows])


def cut_momentum_windows(data: Trajectories) -> MomentumWindows:
    """Cuts overlapping windows within gapless segments; `InputError` as for `fit_momentum`."""
    pieces, dt = _cut(data, WINDOW)
    rows = np.concatenate(pieces)
    w, _ = window_weights(rows.shape[1] - 1, dt)
    impulse = np.einsum("s,wsd->wd", w, data.tau[rows])
    return MomentumWindows(data.q[rows], data.qd[rows], impulse, dt, data.trajectory[rows[:, 0]])


def momentum_errors(plant: Dynamics, q: Array, qd: Array, impulse: Array, *, dt: float) -> Array:
    """Returns the residual [d] of one window's equations, N m or N."""
    w, slope = map(jnp.asarray, window_weights(q.shape[0] - 1, dt))
    p, rest = jax.vmap(lambda q, qd: momentum_and_rest(plant, q, qd))(q, qd)
    return w @ rest - slope @ p - impulse


def window_errors(plant: Dynamics, windows: MomentumWindows) -> Float[Array, "W d"]:
    """Returns the residuals of the equations of all windows, N m or N."""
    return jax.vmap(lambda *window: momentum_errors(plant, *window, dt=windows.dt))(*map(jnp.asarray, windows[:3]))


def acceleration_misfit(plant: Dynamics, windows: MomentumWindows) -> Array:
    """Returns half the log determinant of the covariance of acceleration errors (residuals divided by M at mid-window).

    The number compares models of one plant. Residuals alone favour models with small parameters if a joint has no
    motor.
    """
    masses = jax.vmap(plant.mass_matrix)(jnp.asarray(windows.q[:, windows.q.shape[1] // 2]))
    errors = jnp.linalg.solve(masses, window_errors(plant, windows)[..., None])[..., 0]
    return jnp.linalg.slogdet(errors.T @ errors / len(errors))[1] / 2
