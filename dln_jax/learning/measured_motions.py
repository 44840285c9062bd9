"""Fits trajectories with measured coordinates in q and qd, with or without torques (multiple shooting).

The state is (q, qd). Momenta p = dL/dqd are the model's own, so coupled joints are no harder than a single one, and any
energies of `mechanics.equations.dynamics` work. The residual of a window of T samples is

    r_w(theta, z) = [(q(t; z, theta) - q_measured) / noise_q,  (qd(t; z, theta) - qd_measured) / noise_qd]

with the second part only if qd was measured. The fit minimises the sum over windows of |r_w|² over theta and all starts
z_w. Starts are eliminated window by window: Gauss-Newton solves for z_w(theta), and the derivative of the remaining r_w
is Kaufman's (`learning.motions`). The problem's parameters are the model's alone, for any number of windows.

Torque errors drive simulated motions off course. With `Noise.tau` every window has an unknown constant torque e_w and a
residual e_w / noise_tau: a compromise between matching motions under exact torques and torques of exact motions.

Motion without torques fits any multiple of an energy: a `Gauge` fixes the multiple.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import GAP, window_indices
from dln_jax.learning.engine.problem import Problem, arrays_of, selected_by
from dln_jax.learning.motions import nearest, require_windows, weighted, without_start
from dln_jax.mechanics.discrete import Torque, driven, torque_slopes
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import looped_rk4
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, require_positive

GAUGE_TOLERANCE = 0.01
"""Relative distance from a gauge that counts as one standard deviation; the fit meets the gauge exactly."""


class MeasuredWindows(NamedTuple):
    """W windows of equal length; shorter ones repeat their last sample with weight zero."""

    t: np.ndarray
    """Time since the window's first sample [W, T], in s."""
    q: np.ndarray
    """[W, T, d]."""
    qd: np.ndarray
    """[W, T, d], measured, or an estimate that only provides the initial start."""
    tau: np.ndarray
    """[W, T, d]."""
    weight: np.ndarray
    """1 for a sample, 0 for a repeated one [W, T]."""


class Noise(NamedTuple):
    """Standard deviations of the measurements, one per coordinate or one for all."""

    q: tuple[float, ...] | float
    qd: tuple[float, ...] | float | None = None
    """`None` if velocities were not measured."""
    tau: tuple[float, ...] | float | None = None
    """Standard deviation of the mean torque over a window; `None` if torques are exact. The torque error is then
    an unknown of every window, like its start."""


class Gauge(NamedTuple):
    """Fixes the multiple of an energy, which motions without torques leave free."""

    q: tuple[float, ...]
    """Position where the mass matrix is evaluated."""
    mass: float = 1.0
    """Mean of its diagonal there, kg m² or kg."""


def cut_measured_windows(data: Trajectories, length: int, *, gap: float = GAP) -> MeasuredWindows:
    """Cuts consecutive windows of `length` samples within segments without a gap.

    Raises:
        InputError: a length below 2, or no two samples without a gap between them.
    """
    indices, weight = window_indices(data, length, gap=gap)
    t = data.t[indices]
    return MeasuredWindows(t - t[:, :1], data.q[indices], data.qd[indices], data.tau[indices], weight)


def motion(
    system: Dynamics | PlainDynamics,
    start: Float[Array, " two_d"],
    t: Float[Array, " T"],
    tau: Float[Array, "T d"] | None = None,
    *,
    torque: Torque = "interpolated",
    substeps: int = 1,
) -> Float[Array, "T two_d"]:
    """States (q, qd) at the times t from `start`, by RK4, with or without torques."""
    d = start.shape[0] // 2
    driving = jnp.zeros((t.shape[0], d), start.dtype) if tau is None else tau

    def rate(state: tuple[Array, Array], tau: Array) -> tuple[Array, Array]:
        q, qd = state
        return qd, system.forward_dynamics(q, qd, tau)

    slopes = torque_slopes(driving, t, torque)
    state, drive = (start[:d], start[d:]), (driving[:-1], slopes, jnp.diff(t))
    q, qd = driven(rate, state, *drive, substeps=substeps, method=looped_rk4)
    return jnp.concatenate([q, qd], axis=1)


def problem(
    model: Model,
    parameters: Parameters,
    windows: MeasuredWindows,
    validation: MeasuredWindows,
    *,
    noise: Noise,
    gauge: Gauge | None = None,
    torque: Torque = "interpolated",
    substeps: int = 1,
    seed: int = 0,
) -> Problem:
    """Builds the problem of fitting a model's parameters to windows, in float64, with the starts eliminated.

    The validation windows select the parameters, by the distance of simulated motions after fitting their starts too.

    Args:
        model: built from any energies, or from accelerations, with float64 parameters.
        parameters: initial parameters, for example from `learning.accelerations`.
        validation: windows that select the parameters.
        noise: standard deviations of the measurements; noise alone then gives a loss of d (2 d if velocities were
            measured), less what the starts absorb.
        gauge: fixes the scale of the energies; needed only for motions without torques.
        torque: torque between samples.
        substeps: RK4 steps between two samples.

    Raises:
        InputError: no windows, noise that is not positive, neither torques nor a gauge, or a gauge of the wrong size.
    """
    require_positive(substeps=substeps)
    d = windows.q.shape[2]
    require_windows(windows, validation, noise_q=noise.q, noise_qd=noise.qd, noise_tau=noise.tau)
    check_gauge(gauge, windows.tau, d)

    def first(window: tuple[Array, ...]) -> Array:
        _, q, qd, *_ = window
        return jnp.concatenate([q[0], qd[0], *([] if noise.tau is None else [jnp.zeros(d)])])

    def error(system: Dynamics | PlainDynamics, start: Array, window: tuple[Array, ...]) -> Array:
        return _residual(system, start, window, noise=noise, torque=torque, substeps=substeps)

    def residual(parameters: Parameters, *window: Array) -> Array:
        frozen = dynamics(model.energies(jax.lax.stop_gradient(parameters)))
        system = dynamics(model.energies(parameters))
        left = without_start(
            lambda start: error(frozen, start, window), lambda start: error(system, start, window), first(window)
        )
        return jnp.append(left, gauge_error(system, gauge))

    def closest(parameters: Parameters, *window: Array) -> Array:
        system = dynamics(model.energies(parameters))
        return error(system, nearest(lambda start: error(system, start, window), first(window)), window)

    return selected_by(arrays_of(validation), residual, parameters, arrays_of(windows), seed, error=closest)


def check_gauge(gauge: Gauge | None, tau: np.ndarray, d: int) -> None:
    """Raises `InputError` if there are neither torques nor a gauge, or the gauge has a wrong size or a mass <= 0."""
    if gauge is None:
        if not np.any(tau):
            raise InputError("motions without torques fit any multiple of an energy; give a gauge")
        return
    require_positive(gauge_mass=gauge.mass)
    if len(gauge.q) != d:
        raise InputError(f"the gauge has {len(gauge.q)} coordinates, the data {d}; make them agree")


def gauge_error(system: Dynamics | PlainDynamics, gauge: Gauge | None) -> Float[Array, " n"]:
    """Distance of the mass matrix from the gauge, in units of `GAUGE_TOLERANCE` [1]; empty without either."""
    if gauge is None or not isinstance(system, Dynamics):
        return jnp.zeros(0)
    M = system.mass_matrix(jnp.asarray(gauge.q))
    return jnp.reshape(jnp.mean(jnp.diagonal(M)) / gauge.mass - 1, 1) / GAUGE_TOLERANCE


def _residual(
    system: Dynamics | PlainDynamics,
    start: Array,
    window: tuple[Array, ...],
    *,
    noise: Noise,
    torque: Torque,
    substeps: int,
) -> Array:
    t, q, qd, tau, weight = window
    d = q.shape[1]
    start, push = start[: 2 * d], start[2 * d :]
    pushed = tau if noise.tau is None else tau + push
    states = motion(system, start, t, pushed, torque=torque, substeps=substeps)
    errors = [(states[:, :d] - q) / jnp.asarray(noise.q)]
    if noise.qd is not None:
        errors.append((states[:, d:] - qd) / jnp.asarray(noise.qd))
    residual = weighted(weight, *errors)
    return residual if noise.tau is None else jnp.concatenate([residual, push / jnp.asarray(noise.tau)])
