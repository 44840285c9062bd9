"""Trajectory matching (multiple shooting): fits a model so that its motions pass through the measurements.

Trajectories are cut into short windows. The motion of each window starts at an unknown state z_w:

    minimise over theta and all z_w:   sum over windows and samples of |(x(t; z_w, theta) - x_measured) / noise|²

(Bock 1981; Hairer, Norsett and Wanner 1993, section II.6.) This needs no derivatives of noisy data. Free starts average
out noise, whereas derivative matching evaluates the field at noisy states and is biased. Windows do not cross gaps
(time steps of more than 1.5 times the median).

**Phase fields** have the state x = (q, p), and their loss may add |(rates(x) - rates_measured) / rate_noise|². The
parameters of the problem are theta and all starts. Gauss-Newton solves for all of them together, with one matrix row
per unknown. Adam, for larger networks, takes batches of windows, and the cost of a step does not depend on the number
of windows.

**Measured coordinates** have the state (q, qd), with or without torques. The model defines the momenta p = dL/dqd, so
coupled joints are as easy as a single one, and any energies of `mechanics.equations.dynamics` work. qd counts only if
it was measured. The parameters of the problem are the model's parameters for any number of windows, because the starts
are eliminated window by window (`without_start`), by

    z(theta) = argmin over z of |r(theta, z)|²,   dr/dtheta = (1 - U Uᵀ) dr/dtheta at fixed z,   U a basis of dr/dz

This is the derivative of Kaufman (1975, "A variable projection method for solving separable nonlinear least squares
problems"), which omits a term that is small for small residuals.

Torque errors drive simulated motions off course. With `Noise.tau` each window has an unknown constant torque e_w and a
residual e_w / noise_tau, a compromise between matching motions for exact torques and torques for exact motions.

Motion without torques fits any multiple of an energy. A `Gauge` fixes the multiple.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import window_indices
from dln_jax.learning.engine.problem import Problem, arrays_of, selected_by
from dln_jax.mechanics.discrete import Torque, driven, torque_slopes
from dln_jax.mechanics.dynamics import Dynamics, Flow, InverseForward, PhaseRates
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.integrators import looped_rk4, rk4, rollout
from dln_jax.models.model import Model, Parameters
from dln_jax.solvers.elimination import solve
from dln_jax.types import InputError, require_positive

START_STEPS = 3
"""Gauss-Newton steps from the measured start of a window to the best one."""
GAUGE_TOLERANCE = 0.01
"""Standard deviation of the mass relative to a gauge; the fit meets the gauge exactly."""


class MeasuredWindows(NamedTuple):
    """W windows of equal length; shorter ones repeat their last sample with weight zero."""

    t: np.ndarray
    """Time since the window's first sample [W, T], in s."""
    q: np.ndarray
    """[W, T, d]."""
    qd: np.ndarray
    """[W, T, d], measured, or estimated as an initial start only."""
    tau: np.ndarray
    """[W, T, d]."""
    weight: np.ndarray
    """1 for a sample, 0 for a repeated one [W, T]."""
    p: np.ndarray | None = None
    """[W, T, d], for a fit in coordinates and momenta."""
    pd: np.ndarray | None = None
    """[W, T, d]."""


def cut_measured_windows(data: Trajectories, length: int) -> MeasuredWindows:
    """Cuts consecutive windows of `length` samples; a window begins with the last sample of the previous one.

    Windows do not cross gaps. The remainder of a segment is a shorter window.

    Raises:
        InputError: a length below 2, or gaps between all samples.
    """
    rows, weight = window_indices(data, length)
    p, pd = (None if values is None else values[rows] for values in (data.p, data.pd))
    t = data.t[rows]
    return MeasuredWindows(t - t[:, :1], data.q[rows], data.qd[rows], data.tau[rows], weight, p, pd)


Deviations = tuple[float, ...] | float
"""Standard deviations of several quantities, or one for all."""


class Weights(NamedTuple):
    """Standard deviations that divide the residuals; larger ones reduce the weight."""

    state: Deviations
    """Standard deviations of q and p, one number or 2 d; infinite for quantities that were not measured."""
    rate: Deviations | None = None
    """Standard deviations of qd and pd, one number or 2 d; `None` leaves measured rates out."""


def phase_motion(
    field: Flow | PhaseRates, start: Array, t: Float[Array, " T"], *, substeps: int
) -> Float[Array, "T two_d"]:
    """Integrates the states (q, p) from `start` [2 d] to the times t by RK4."""
    first = tuple(jnp.split(start, 2))
    return jnp.concatenate(rollout(rk4(lambda t, state: field.rates(*state)), first, t, substeps=substeps), axis=1)


def weigh(weight: Array, *errors: Array) -> Array:
    """Concatenates and weights errors [T, n] of a window; the sum of their squares is a mean over its samples."""
    size = jnp.sqrt(weight / jnp.sum(weight))[:, None]
    return jnp.concatenate([jnp.ravel(size * error) for error in errors])


def phase_problem(
    model: Model,
    parameters: Parameters,
    windows: MeasuredWindows,
    validation: MeasuredWindows,
    *,
    weights: Weights,
    substeps: int = 4,
    seed: int = 0,
) -> Problem:
    """Builds the problem of fitting a model to windows, in float64, with parameters {"model": ..., "starts": ...}.

    The validation windows select the parameters by the distance of simulated motions, with fitted starts.

    Args:
        model: a phase model with float64 parameters.
        parameters: initial parameters, for example from a fit of rates.
        validation: windows that select the parameters.
        weights: standard deviations that divide the residuals.
        substeps: RK4 steps between two samples.

    Raises:
        InputError: windows, momenta or rates are missing, or weights are not positive.
    """
    require_positive(substeps=substeps)
    require_windows(windows, validation, state_weight=weights.state, rate_weight=weights.rate)
    keys = "t", "weight", "q", "p", *(("qd", "pd") if weights.rate is not None else ())
    fitted, held_out = (arrays_of(part, keys, jnp.result_type(float)) for part in (windows, validation))

    def error(unknowns: Any, window: tuple[Array, ...], start: Array) -> Array:
        t, weight, q, p, *rates = window
        field = flow(model.energies(unknowns["model"]))
        states = phase_motion(field, start, t, substeps=substeps)
        errors = [(states - jnp.concatenate([q, p], axis=1)) / jnp.asarray(weights.state, start.dtype)]
        if weights.rate is not None:
            off = jnp.concatenate(jax.vmap(field.rates)(*jnp.split(states, 2, axis=1)), axis=1)
            off = off - jnp.concatenate(rates, axis=1)
            errors.append(off / jnp.asarray(weights.rate, start.dtype))
        return weigh(weight, *errors)

    def residual(unknowns: Any, index: Array, *window: Array) -> Array:
        return error(unknowns, window, unknowns["starts"][index])

    def closest(unknowns: Any, *window: Array) -> Array:
        from_start = functools.partial(error, unknowns, window)
        _, _, q, p, *_ = window
        return from_start(nearest(from_start, jnp.append(q[0], p[0])))

    _, _, q, p, *_ = fitted
    unknowns = {"model": parameters, "starts": jnp.concatenate([q[:, 0], p[:, 0]], axis=1)}
    return selected_by(held_out, residual, unknowns, (jnp.arange(len(windows.t)), *fitted), seed, error=closest)


def require_windows(windows: MeasuredWindows, validation: MeasuredWindows, **deviations: Deviations | None) -> None:
    """Raises `InputError` for a set without windows, or a standard deviation that is not positive."""
    for name, values in deviations.items():
        for deviation in np.ravel(values) if values is not None else ():
            require_positive(**{name: float(deviation)})
    if not len(windows.t) or not len(validation.t):
        raise InputError(
            f"there are {len(windows.t)} windows to fit, {len(validation.t)} to validate; expected at least 1 of each"
        )


def without_start(frozen: Callable[[Array], Array], residual: Callable[[Array], Array], start: Array) -> Array:
    """Returns the residual at its best start, with Kaufman's derivative in the parameters that `frozen` fixes.

    Args:
        frozen: start -> residual, with constant parameters.
        residual: the same function, differentiable in the parameters.
        start: initial value.
    """
    start, slope = jax.lax.stop_gradient(_descend(frozen, start, START_STEPS))
    left = residual(start)
    change = left - jax.lax.stop_gradient(left)  # zero, with the derivative of `left`
    return left - slope @ solve(slope.T @ slope, slope.T @ change)


def nearest(residual: Callable[[Array], Array], start: Array, *, steps: int = START_STEPS) -> Array:
    """Lowers the residual by Gauss-Newton steps of the start."""
    return _descend(residual, start, steps)[0]


def _descend(residual: Callable[[Array], Array], start: Array, steps: int) -> tuple[Array, Array]:
    """Returns the start after some steps, and dr/dz before the last step."""
    linearised = jax.jacfwd(lambda start: (residual(start),) * 2, has_aux=True)

    def step(at: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], None]:
        slope, value = linearised(at[0])
        return (at[0] - solve(slope.T @ slope, slope.T @ value), slope), None

    nothing = jnp.zeros((jax.eval_shape(residual, start).shape[0], start.shape[0]), start.dtype)
    return jax.lax.scan(step, (start, nothing), length=steps)[0]


class Noise(NamedTuple):
    """Standard deviations of the measurements, one per coordinate or one for all."""

    q: Deviations
    qd: Deviations | None = None
    """`None` if velocities were not measured."""
    tau: Deviations | None = None
    """Standard deviation of the mean torque over a window; each window then has an unknown torque error besides its
    start. `None` if torques are exact."""


class Gauge(NamedTuple):
    """Fixes the scale of an energy, which motions without torques do not determine."""

    q: tuple[float, ...]
    """Position of the evaluated mass matrix."""
    mass: float = 1.0
    """Mean of its diagonal, kg m² or kg."""


def motion(
    system: Dynamics | InverseForward,
    start: Float[Array, " two_d"],
    t: Float[Array, " T"],
    tau: Float[Array, "T d"] | None = None,
    *,
    torque: Torque = "interpolated",
    substeps: int = 1,
) -> Float[Array, "T two_d"]:
    """Integrates the states (q, qd) from `start` to the times t by RK4, with or without torques."""
    first = tuple(jnp.split(start, 2))
    driving = jnp.zeros((len(t), len(first[0])), start.dtype) if tau is None else tau

    def rate(state: tuple[Array, Array], tau: Array) -> tuple[Array, Array]:
        q, qd = state
        return qd, system.forward_dynamics(q, qd, tau)

    drive = driving[:-1], torque_slopes(driving, t, torque), jnp.diff(t)
    return jnp.concatenate(driven(rate, first, *drive, substeps=substeps, method=looped_rk4), axis=1)


def measured_problem(
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

    The validation windows select the parameters by the distance of simulated motions, with fitted starts.

    Args:
        model: any model of energies or accelerations, with float64 parameters.
        parameters: initial parameters, for example from `learning.matching.accelerations_problem`.
        validation: windows that select the parameters.
        noise: standard deviations of the measurements. Noise alone gives a loss of d (2 d with measured velocities)
            minus the part that the starts absorb.
        gauge: fixes the scale of the energies; needed only for motions without torques.
        torque: torque between samples.
        substeps: RK4 steps between two samples.

    Raises:
        InputError: no windows, noise that is not positive, no torques and no gauge, or a gauge of the wrong size.
    """
    require_positive(substeps=substeps)
    d = windows.q.shape[2]
    require_windows(windows, validation, noise_q=noise.q, noise_qd=noise.qd, noise_tau=noise.tau)
    check_gauge(gauge, windows.tau, d)
    fitted, held_out = (arrays_of(part, ("t", "q", "qd", "tau", "weight")) for part in (windows, validation))

    def first(window: tuple[Array, ...]) -> Array:
        _, q, qd, *_ = window
        return jnp.concatenate([q[0], qd[0], *([] if noise.tau is None else [jnp.zeros(d)])])

    def error(system: Dynamics | InverseForward, window: tuple[Array, ...], start: Array) -> Array:
        t, q, qd, tau, weight = window
        push = start[2 * d :]
        states = motion(
            system, start[: 2 * d], t, tau if noise.tau is None else tau + push, torque=torque, substeps=substeps
        )
        errors = [(states[:, :d] - q) / jnp.asarray(noise.q)]
        if noise.qd is not None:
            errors.append((states[:, d:] - qd) / jnp.asarray(noise.qd))
        left = weigh(weight, *errors)
        return left if noise.tau is None else jnp.concatenate([left, push / jnp.asarray(noise.tau)])

    def residual(parameters: Parameters, *window: Array) -> Array:
        frozen, system = (dynamics(model.energies(part)) for part in (jax.lax.stop_gradient(parameters), parameters))
        left = without_start(
            functools.partial(error, frozen, window), functools.partial(error, system, window), first(window)
        )
        return jnp.append(left, gauge_error(system, gauge))

    def closest(parameters: Parameters, *window: Array) -> Array:
        from_start = functools.partial(error, dynamics(model.energies(parameters)), window)
        return from_start(nearest(from_start, first(window)))

    return selected_by(held_out, residual, parameters, fitted, seed, error=closest)


def check_gauge(gauge: Gauge | None, tau: np.ndarray, d: int) -> None:
    """Raises `InputError` if torques and gauge are both missing, or the gauge has a wrong size or a mass <= 0."""
    if gauge is None:
        if not np.any(tau):
            raise InputError("motions without torques fit any multiple of an energy; give a gauge")
        return
    require_positive(gauge_mass=gauge.mass)
    if len(gauge.q) != d:
        raise InputError(f"the gauge has {len(gauge.q)} coordinates, the data {d}; make them agree")


def gauge_error(system: Dynamics | InverseForward, gauge: Gauge | None) -> Float[Array, " n"]:
    """Returns the distance [1] of the mass matrix from the gauge in units of `GAUGE_TOLERANCE`; empty without a
    gauge."""
    if gauge is None or not isinstance(system, Dynamics):
        return jnp.zeros(0)
    masses = jnp.diagonal(system.mass_matrix(jnp.asarray(gauge.q)))
    return jnp.reshape(jnp.mean(masses) / gauge.mass - 1, 1) / GAUGE_TOLERANCE
