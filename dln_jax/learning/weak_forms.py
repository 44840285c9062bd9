"""Fits models linear in their parameters to q, qd and tau: the equations of motion in weak form, without qdd.

With the momentum p = M(q) qd, tau = dp/dt + s(q, qd), where s = tau(q, qd, 0) - dM/dt qd holds gravity, friction and
the rest of the Coriolis forces. Multiplied by a window w(t) that is zero at both ends, and integrated by parts:

    - integral w' p dt + integral w s dt = integral w tau dt

(modulating functions, Shinbrot 1957; for robots the filtered forms of Slotine and Li 1987.) Both sides are linear in
the parameters, with one equation per joint and window. Accelerations, whose noise grows with the square of the
frequency, do not appear. Both sides pass through the same low-pass, so that dry friction is not distorted, and the
result hardly depends on the cut-off of q. `fit_form` fits other equations of that kind.

The windows are sin⁴ (pi t / W); plain sums over their samples are as accurate as the motion is smooth.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.data.encoders.sampling import EVEN
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments
from dln_jax.learning.linear import unravelled
from dln_jax.learning.objectives import torque_scale
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.solvers import least_squares
from dln_jax.types import InputError, Vector, require_positive

WINDOW = 0.16
"""Length of a window in s: about two periods of the highest frequency that a low-pass at 12 Hz passes."""
FEWEST = 8
"""Smallest number of steps of a window."""
OVERLAP = 5
"""Number of windows that start within the length of one; more would be nearly redundant."""
CHUNK = 4096
"""Samples whose columns are in memory at a time."""
ROUNDS = 10
"""Largest number of fits of `fit_reweighted`; three to five are usual."""
SETTLED = 0.01
"""Relative change of the errors' covariance that ends them."""


class WeakFit(NamedTuple):
    """Identified parameters, and how well the data determine them; otherwise as `learning.linear.LinearFit`."""

    parameters: Any
    """Parameters of the model, in its dtype."""
    parameter_count: int
    rank: int
    condition: float
    equations: int
    """Number of windows, times the number of joints for momentum equations."""
    mse: float
    """Mean over windows of the squared error of the mean torque, summed over joints, or of the power; (N m)² or W²."""
    residual: float
    """Root of the sum of squares of all equations, divided by the deviations of the noise [1]."""
    errors: Float[np.ndarray, "W k"]
    """Error of every window's mean torques, N m or N, or of its power, W."""


class Form(NamedTuple):
    """Equations of the windows: `right` = d/dt of the first of `left` + the second."""

    left: Callable[[Dynamics, Vector, Vector], tuple[Array, Array]]
    """(plant, q, qd) -> two arrays [k]."""
    right: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """(qd, tau) [N, d] -> [N, k]."""
    noise: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """(qd [N, d], deviations of tau [d]) -> deviations of the right side [N, k]."""


def fit_momentum(
    model: Model,
    data: Trajectories,
    *,
    window: float = WINDOW,
    noise: Float[np.ndarray, " d"] | None = None,
    **tolerances: Any,
) -> WeakFit:
    """Fits the momenta of windows by least squares, in float64; qdd is not read.

    Args:
        model: linear in its parameters, such as `models.make_rigid_tree` and `models.make_trigonometric`.
        data: at equal time steps, with smooth velocities and measured torques, such as from `data.encoders.smooth`.
        window: length in s, at least `FEWEST` steps.
        noise: deviations of the torques' noise that divide the equations (default: those of the torques themselves).
        tolerances: ridge, rank_tolerance and negligible of `solvers.least_squares.solve`.

    Raises:
        InputError: unequal steps, no segment as long as a window, torques that do not vary, or settings out of range.
    """
    return fit_form(MOMENTUM, model, data, window=window, noise=noise, **tolerances)


def fit_form(
    form: Form,
    model: Model,
    data: Trajectories,
    *,
    window: float = WINDOW,
    noise: Float[np.ndarray, " d"] | None = None,
    **tolerances: Any,
) -> WeakFit:
    """Fits any equations of windows; arguments and errors as for `fit_momentum`."""
    equations = _all_equations(form, model, data, window, noise)
    return _solved(model, equations, lambda rows, unit: rows / unit[..., None], tolerances)


def fit_reweighted(model: Model, data: Trajectories, *, window: float = WINDOW, **tolerances: Any) -> WeakFit:
    """Fits momenta, with equations weighted by the covariance of their own errors until it settles.

    Iterated generalised least squares (Zellner 1962). Noise of encoders enters the equations of all joints through the
    mass matrix. Without its correlations, equations without a motor, which zero parameters satisfy, pull those of a
    plant with weak motors towards zero. Arguments and errors as for `fit_momentum`, which gives the first fit.
    """
    equations = _all_equations(MOMENTUM, model, data, window, None)
    fit = _solved(model, equations, lambda rows, unit: rows / unit[..., None], tolerances)
    factor = None
    for _ in range(1, ROUNDS):
        covariance = fit.errors.T @ fit.errors / len(fit.errors)
        if factor is not None:
            change = np.linalg.solve(factor, np.linalg.solve(factor, covariance).T) - np.eye(len(covariance))
            if np.abs(change).max() < SETTLED:
                break
        try:
            factor = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            break  # exact data leave no errors
        fit = _solved(model, equations, lambda rows, _, factor=factor: np.linalg.solve(factor, rows), tolerances)
    return fit


def _all_equations(
    form: Form, model: Model, data: Trajectories, window: float, noise: Float[np.ndarray, " d"] | None
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    require_positive(window=window)
    d = data.degrees_of_freedom
    with jax.enable_x64(True):
        scale = np.asarray(torque_scale(data)) if noise is None else np.asarray(noise, float)
        if scale.shape != (d,) or not (scale > 0).all():
            raise InputError(f"noise is {scale}; expected a positive number for each of {d} joints")
        equations = list(_equations(_columns(form.left, model), data, form, scale, window))
    if not equations:
        raise InputError(f"no segment of the data is as long as a window of {window:g} s; give a shorter one")
    return equations


def _solved(
    model: Model,
    equations: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    weighted: Callable[[np.ndarray, np.ndarray], np.ndarray],
    tolerances: dict[str, Any],
) -> WeakFit:
    """Least squares of equations weighted by (rows [W, k, P], deviations [W, k]) -> rows."""
    chunks = ((weighted(A, unit).reshape(b.size, -1), weighted(b[..., None], unit).ravel()) for A, b, unit in equations)
    solution = least_squares.solve_chunks(chunks, **tolerances)
    errors, like = np.concatenate([A @ solution.x - b for A, b, _ in equations]), _shapes(model)
    return WeakFit(
        parameters=jax.tree.map(lambda leaf, shape: jnp.asarray(leaf, shape.dtype), unravelled(solution.x, like), like),
        parameter_count=solution.x.size,
        rank=solution.rank,
        condition=solution.condition,
        equations=errors.size,
        mse=float(np.sum(errors**2)) / len(errors),
        residual=solution.residual,
        errors=errors,
    )


def momentum_and_rest(plant: Dynamics, q: Vector, qd: Vector) -> tuple[Vector, Vector]:
    """p = M qd and s = tau(q, qd, 0) - dM/dt qd of one state: tau = dp/dt + s."""
    p, change = jax.jvp(lambda place: plant.mass_matrix(place) @ qd, (q,), (qd,))
    return p, plant.inverse_dynamics(q, qd, jnp.zeros_like(qd)) - change


MOMENTUM = Form(momentum_and_rest, lambda qd, tau: tau, lambda qd, noise: np.broadcast_to(noise, qd.shape))
"""The equations of the momenta, for `fit_momentum`."""


def window_weights(steps: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """w dt and w' dt [steps + 1] of a window of this number of steps, scaled so that the integral of w is 1."""
    phase = np.pi * np.arange(steps + 1) / steps
    w, slope = np.sin(phase) ** 4, 4 * np.pi / (steps * dt) * np.sin(phase) ** 3 * np.cos(phase)
    return w / w.sum(), slope / w.sum()


@functools.lru_cache(maxsize=4)
def _columns(left: Callable[..., tuple[Array, Array]], model: Model) -> Callable[..., Array]:
    """(q, qd as [N, d]) -> derivatives [N, 2 k, P] of both parts of `Form.left`, compiled."""
    zero, unravel = ravel_pytree(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), _shapes(model)))

    def columns(q: Vector, qd: Vector) -> Array:
        def both(theta: Array) -> Array:
            return jnp.concatenate(left(dynamics(model.energies(unravel(theta))), q, qd))

        values, pull_back = jax.vjp(both, zero)
        return jax.vmap(pull_back)(jnp.eye(values.shape[0], dtype=values.dtype))[0]

    return jax.jit(jax.vmap(columns), compiler_options=quick_compilation())


def _shapes(model: Model) -> Parameters:
    return jax.eval_shape(model.init, jax.random.key(0))


def _equations(
    program: Callable[..., Array],
    data: Trajectories,
    form: Form,
    noise: Float[np.ndarray, " d"],
    window: float,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Columns [W, k, P], right-hand sides and their deviations [W, k] of windows, one chunk after the other."""
    pieces = segments(data.t, data.trajectory)
    length = min(CHUNK, max(len(piece) for piece in pieces))
    for piece in pieces:
        if len(piece) <= FEWEST:
            continue
        steps_taken = np.diff(data.t[piece])
        dt = float(np.median(steps_taken))
        if np.abs(np.cumsum(steps_taken - dt)).max() > 10 * EVEN * dt * len(piece):
            raise InputError("steps in time are not equal, as windows take them; resample with data.encoders.smooth")
        steps = max(FEWEST, round(window / dt))
        w, slope = window_weights(steps, dt)
        starts = np.arange(0, len(piece) - steps, max(1, steps // OVERLAP))
        for begin in range(0, len(piece) - steps, max(1, length - steps)):
            mine = starts[(starts >= begin) & (starts < begin + max(1, length - steps))]
            rows = piece[np.minimum(np.arange(begin, begin + max(length, steps + 1)), len(piece) - 1)]
            values = np.asarray(program(data.q[rows], data.qd[rows]))
            k = values.shape[1] // 2
            A, b, unit = [], [], []
            for start in mine:
                part = slice(start - begin, start - begin + steps + 1)
                qd, tau = data.qd[rows[part]], data.tau[rows[part]]
                A.append(np.tensordot(w, values[part, k:], 1) - np.tensordot(slope, values[part, :k], 1))
                b.append(w @ form.right(qd, tau))
                unit.append(np.sqrt(w**2 @ form.noise(qd, noise) ** 2))
            if A:
                yield np.stack(A), np.stack(b), np.stack(unit)
