"""Identification by motions: output error over short windows, alone or together with the torque equations.

    minimise over theta, the delay, and for each window w its start z_w and a constant torque e_w

        sum over samples |(q(t; z_w, theta) - q_measured) / noise_q|² + sum over windows |e_w / noise_tau|²
            + |R (theta, -1)|²   (equations of the torques in units of their noise, `equations.whiten`)

The torque tau(t - delay) + e_w drives the simulated motion. Starts and constant torques are eliminated window by window
(Kaufman's derivative, `learning.shooting`). No accelerations are needed. Forces that no log records, such as the
vibration of a belt, affect torques of filtered motions but hardly move a joint.

Windows with an unusual event, such as a touch, have much larger errors than others. The weight of a window with a
residual above the median is the ratio of the median to its residual (Huber), from the previous fit.

Linearising the residual at theta gives equations of the same form as for torques. Each round solves one least-squares
problem of `consistent`, with physically consistent bodies, and halves its step until the sum decreases (consistent
bodies form a convex set).
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.identification.consistent import fit_consistent
from dln_jax.identification.equations import Columns, ParameterVector
from dln_jax.learning.linear import shapes_of, unravelled
from dln_jax.learning.shooting import MeasuredWindows, cut_measured_windows, motion, without_start
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model
from dln_jax.precision import compiled
from dln_jax.types import InputError, JointVector, require_positive

ROUNDS, SETTLED = 12, 1e-4
"""Largest number of linearisations, and the smallest relative decrease of the sum for another one."""
CHUNK = 16
"""Number of windows per linearisation; the last chunk is padded."""
REWEIGHTINGS = 2
STABLE = 2.785
"""Largest product of time step and damping of a stable classical Runge-Kutta step."""
MOST_GROWTH = 1e6
"""Largest growth of deviations along a window; beyond, its derivatives have too few correct digits."""
STEPS = 0.5 ** np.arange(8)
"""Trial fractions of a step."""
TYPICAL_DELAY = 1e-3
"""Unit of the delay among the unknowns, s."""


class MotionFit(NamedTuple):
    """Parameters that fit motions."""

    theta: ParameterVector
    delay: float
    """Delay of the motions relative to the logged torques, s."""
    before: float
    """Root mean square error of the motions with the initial parameters, in units of noise_q."""
    after: float
    """The same for the result."""
    rounds: int
    converged: bool


def cut_motions(data: Trajectories, length: int) -> tuple[MeasuredWindows, Float[np.ndarray, "W T d"]]:
    """Cuts consecutive windows of `length` samples; also returns the rate of tau, N m/s or N/s, for shifts in time.

    Raises:
        InputError: as for `cut_measured_windows`.
    """
    trajectories = np.split(np.arange(len(data.t)), np.flatnonzero(np.diff(data.trajectory)) + 1)
    slope = np.concatenate([np.gradient(data.tau[own], data.t[own], axis=0) for own in trajectories])
    return cut_measured_windows(data, length), cut_measured_windows(data._replace(tau=slope), length).tau


@functools.lru_cache(maxsize=4)
def linearise(model: Model) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Returns (unknowns [P + 1], noise_q [d], noise_tau [d], windows, slope) -> residuals [W, T d + d], derivatives.

    The last unknown is the delay in units of `TYPICAL_DELAY`. The derivatives are [W, T d + d, P + 1]. Residuals belong
    to the best starts.
    """
    like = shapes_of(model)

    def one(unknowns: Array, noise_q: Array, noise_tau: Array, window: tuple[Array, ...]) -> tuple[Array, Array]:
        t, q, qd, tau, weight, slope = window
        d = q.shape[1]

        def error(unknowns: Array, start: Array) -> Array:
            system = dynamics(model.energies(unravelled(unknowns[:-1], like)))
            driving = tau - TYPICAL_DELAY * unknowns[-1] * slope + noise_tau * start[2 * d :]
            states = motion(system, start[: 2 * d], t, driving)
            off = jnp.sqrt(weight)[:, None] * (states[:, :d] - q) / noise_q
            return jnp.concatenate([jnp.ravel(off), start[2 * d :]])

        frozen, first = jax.lax.stop_gradient(unknowns), jnp.concatenate([q[0], qd[0], jnp.zeros(d)])
        left = without_start(lambda start: error(frozen, start), lambda start: error(unknowns, start), first)
        return left, left

    with_slopes = jax.vmap(jax.jacfwd(one, has_aux=True), in_axes=(None, None, None, 0))
    every = compiled(with_slopes)

    def linearised(unknowns, noise_q, noise_tau, windows: MeasuredWindows, slope) -> tuple[np.ndarray, np.ndarray]:
        count, parts = len(windows.t), []
        with jax.enable_x64(True):
            for first in range(0, count, CHUNK):
                rows = np.minimum(np.arange(first, first + CHUNK), count - 1)  # one shape, so one program
                chunk = tuple(jnp.asarray(array[rows]) for array in (*windows[:5], slope))
                parts.append(every(unknowns, noise_q, noise_tau, chunk))
        slopes, left = (np.concatenate(part)[:count] for part in zip(*parts, strict=True))
        return left, slopes

    return linearised


@functools.lru_cache(maxsize=4)
def _damping(model: Model) -> Callable[..., Array]:
    """Returns (theta [P], q [n, d], qd [n, d], tau [n, d]) -> d qdd / d qd [n, d, d]."""
    like = shapes_of(model)

    def slopes(theta: Array, *state: Array) -> Array:
        forward_dynamics = dynamics(model.energies(unravelled(theta, like))).forward_dynamics
        return jax.jacfwd(forward_dynamics, argnums=1)(*state)

    return compiled(jax.vmap(slopes, in_axes=(None, 0, 0, 0)))


def _require_resolved(model: Model, theta: ParameterVector, windows: MeasuredWindows) -> None:
    """Raises `InputError` if derivatives of most windows grow without bound, for example by steep dry friction at rest.

    A classical Runge-Kutta step multiplies a deviation that decays as exp(-z) by 1 - z + z²/2 - z³/6 + z⁴/24, which
    exceeds one for z > 2.785. The motions themselves may stay finite.
    """
    step = float(np.median(np.diff(windows.t, axis=1)[windows.weight[:, 1:] > 0]))
    rows = np.linspace(0, len(windows.t) - 1, CHUNK).astype(int)  # one shape, so one program
    with jax.enable_x64(True):
        states = (np.concatenate(array[rows]) for array in (windows.q, windows.qd, windows.tau))
        damping = np.asarray(_damping(model)(theta, *states))
    if not np.isfinite(damping).all():
        return  # non-finite motions have their own message
    z = step * np.abs(np.linalg.eigvals(damping)).max(axis=-1)
    growth = np.maximum(np.abs(1 - z + z**2 / 2 - z**3 / 6 + z**4 / 24), 1.0).reshape(CHUNK, -1).prod(axis=1)
    if np.median(growth) > MOST_GROWTH:
        raise InputError(
            f"friction is up to {z.max() / STABLE:.3g} times too fast for the log's time step of {step:.3g} s; "
            "record faster or decimate less, or state a larger --velocity-scale"
        )


def fit_motions(
    model: Model,
    columns: Columns,
    prior: ParameterVector,
    start: ParameterVector,
    windows: MeasuredWindows,
    slope: Float[np.ndarray, "W T d"],
    *,
    noise_tau: JointVector,
    torques: Float[np.ndarray, "K P_and_1"] | None = None,
    reweightings: int = REWEIGHTINGS,
) -> MotionFit:
    """Fits physically consistent parameters to motions, and to torques too if their equations are given.

    Args:
        model: a model that is linear in its parameters, for example from `make_rigid_tree`.
        columns: columns of its parameters.
        prior: prior values, which undetermined directions keep.
        start: initial parameters with a positive definite mass matrix, for example consistent ones from torques.
        windows, slope: from `cut_motions`.
        noise_tau: standard deviation of a window's constant torque, N m or N.
        torques: triangular factor of the torque equations in units of noise.
        reweightings: number of refits with windows weighted by their errors.

    Raises:
        InputError: the noise is not positive, motions are too stiff for their time step, or initial motions are not
            finite.
    """
    require_positive(noise_tau=float(np.min(noise_tau)))
    _require_resolved(model, start, windows)
    linearised, P, (_, samples, d) = linearise(model), len(start), windows.q.shape
    measured = windows.weight.sum()
    x = np.append(start, 0.0)
    # The error of the motions is the noise of q. It starts at a thousandth of the spread of q, and each round shifts
    # the compromise between starts and torques.
    noise_q = spread = np.maximum(1e-3 * windows.q.reshape(-1, d).std(axis=0), np.finfo(float).tiny)
    for _ in range(2):
        left = linearised(x, noise_q, noise_tau, windows, slope)[0][:, : samples * d]
        sizes = np.sum(left.reshape(-1, d) ** 2, axis=0) / measured
        noise_q = np.maximum(noise_q * np.sqrt(sizes), 1e-3 * spread)
    wider = Columns((*columns.names, "delay"), (*columns.kinds, "signed"))
    fixed = np.zeros((0, P + 2)) if torques is None else np.insert(torques, P, 0.0, axis=1)

    def at(x: np.ndarray, weight: np.ndarray = windows.weight) -> tuple[np.ndarray, np.ndarray, float]:
        left, slopes = linearised(x, noise_q, noise_tau, windows._replace(weight=weight), slope)
        return left, slopes, float(np.sum(left**2) + np.sum((fixed @ np.append(x, -1.0)) ** 2))

    def distance(left: np.ndarray) -> float:
        return float(np.linalg.norm(left[:, : samples * d]) / np.sqrt(measured * d))

    left = at(x)[0]
    before, weight, rounds, converged = distance(left), windows.weight, 0, False
    for _ in range(1 + reweightings):
        left, slopes, total = at(x, weight)
        if not np.isfinite(total):
            raise InputError("motions simulated with the initial fit diverge; record faster, or filter less")
        last, converged = rounds + ROUNDS, False
        while rounds < last and not converged:
            rounds += 1
            J, was = slopes.reshape(-1, P + 1), total
            rows = np.concatenate([np.column_stack([J, J @ x - left.ravel()]), fixed])
            step = fit_consistent(np.linalg.qr(rows, mode="r"), wider, np.append(prior, 0.0)).theta - x
            for length in STEPS:
                left, slopes, total = at(x + length * step, weight)
                if total < was:
                    x, converged = x + length * step, was - total < SETTLED * was
                    break
            else:
                converged = True  # no step lowers the sum
        left = at(x)[0]
        norms = np.linalg.norm(left, axis=1)
        usual = np.minimum(1.0, np.median(norms) / np.maximum(norms, np.finfo(float).tiny))
        weight = windows.weight * usual[:, None]
    return MotionFit(x[:-1], TYPICAL_DELAY * float(x[-1]), before, distance(left), rounds, converged)
