"""Errors of a model on trajectories, coverage of its bands, and definiteness of its mass matrices.

The band of level p around a prediction has the half width z_p sd, where a standard normal variable lies between -z_p
and z_p with probability p: 1.96 sd for 95 %. A kinetic energy has a positive definite M; a black-box network may not.
"""

from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.mechanics.equations import Canonical, Driven, dynamics, hamiltonian_of
from dln_jax.scale import spread
from dln_jax.types import Hamiltonian, InputError

DECOMPOSITION = ("inertial", "coriolis", "gravity")
LEVELS = tuple(np.round([*np.arange(0.05, 0.95, 0.05), 0.95, 0.975, 0.99], 3).tolist())
"""Levels of a coverage curve."""
LEVEL = 0.95
"""Level of the bands reported as a single number."""


def prediction_program(
    system_of: Callable[[Any], Driven], *, H: Hamiltonian | None = None, mesh: Mesh | None = None
) -> Callable[[Any, tuple[Any, ...]], dict[str, Array]]:
    """Returns (parameters, samples) -> predictions of the system with these parameters, for `jax.jit`.

    The predictions are `tau`, `qdd` and the parts of the torque, [N, d]. With recorded momenta and a Hamiltonian (`H`,
    or the system's own) they include `tau_from_momenta` = pd + dH/dq + friction, as published for such models.

    Parameters are arguments, not constants, so one compilation serves every seed. A mesh splits the samples.
    """

    def answers(parameters: Any, samples: tuple[Any, ...]) -> dict[str, Array]:
        system = system_of(parameters)
        functions = dynamics(system)
        energy = hamiltonian_of(system) if isinstance(system, Canonical) else H

        def answer(q, qd, qdd, tau, momenta):
            parts = functions.decompose(q, qd, qdd)
            answers = {
                "tau": functions.inverse_dynamics(q, qd, qdd),
                "qdd": functions.forward_dynamics(q, qd, tau),
                **{f"tau_{name}": getattr(parts, name) for name in DECOMPOSITION},
            }
            if energy is not None and momenta:
                friction = functions.friction(q, qd) if isinstance(functions, Dynamics) else 0.0
                answers["tau_from_momenta"] = hamiltonian.inverse(energy, q, *momenta) + friction
            return answers

        return jax.vmap(answer)(*samples)

    return spread(answers, mesh)


def samples_of(data: Trajectories, dtype) -> tuple[Any, ...]:
    """Returns the samples for a `prediction_program`: q, qd, qdd, tau, and the momenta if they were recorded."""
    momenta = () if data.p is None or data.pd is None else (data.p, data.pd)
    states = (np.asarray(array, dtype) for array in (data.q, data.qd, data.qdd, data.tau))
    return *states, tuple(np.asarray(array, dtype) for array in momenta)


def as_arrays(answers: dict[str, Array]) -> dict[str, np.ndarray]:
    """Converts the results of a `prediction_program` to float64."""
    return {key: np.asarray(array, np.float64) for key, array in answers.items()}


def errors(predicted: dict[str, np.ndarray], data: Trajectories) -> dict[str, float]:
    """Returns squared errors in SI units, summed over joints and averaged over samples (the published metric).

    The entries are `torque_mse`, `forward_mse` (of qdd), `power_mse` (of qdᵀ tau, which is dE/dt without friction) and,
    if the data have the true parts, `inertial_mse`, `coriolis_mse`, `gravity_mse`. A Hamiltonian model adds
    `torque_from_momenta_mse`, which includes the error of the recorded pd. Its lower bound is the error of the true
    plant (4.4e-6 on the published test letters, where pd are difference quotients).
    """
    torque_error = predicted["tau"] - data.tau
    result = {
        "torque_mse": mean_square(torque_error),
        "forward_mse": mean_square(predicted["qdd"] - data.qdd),
        "power_mse": float(np.mean(np.sum(data.qd * torque_error, axis=1) ** 2)),
    }
    if "tau_from_momenta" in predicted:
        result["torque_from_momenta_mse"] = mean_square(predicted["tau_from_momenta"] - data.tau)
    for name in DECOMPOSITION:
        truth = getattr(data, f"tau_{name}")
        if truth is not None:
            result[f"{name}_mse"] = mean_square(predicted[f"tau_{name}"] - truth)
    return result


def normalised_error(
    predicted: Float[np.ndarray, "N d"], measured: Float[np.ndarray, "N d"]
) -> Float[np.ndarray, " d"]:
    """Returns the nMSE of each joint: mean squared error over the variance of the measurements (NaN for a constant)."""
    variance = np.var(measured, axis=0)
    return np.mean((predicted - measured) ** 2, axis=0) / np.where(variance > 0, variance, np.nan)


def mean_square(error: np.ndarray) -> float:
    """Returns the mean over samples of the sum of squares over joints; error [N, d]."""
    return float(np.mean(np.sum(error**2, axis=1)))


def half_width(level: float) -> float:
    """Returns z_p, in standard deviations; raises `InputError` for a level outside (0, 1)."""
    if not 0 < level < 1:
        raise InputError(f"the level of a band is {level}; expected a number between 0 and 1")
    return NormalDist().inv_cdf(0.5 + level / 2)


def coverage(error: Any, std: Any, levels: tuple[float, ...] = LEVELS) -> Float[np.ndarray, "n d"]:
    """Returns the fraction of errors within z_p standard deviations, by level and joint.

    Args:
        error: predicted minus measured, [N, d].
        std: predicted standard deviations, [N, d].
        levels: levels p of the bands.

    Raises:
        InputError: a level is outside (0, 1), or shapes differ.
    """
    error, std = np.asarray(error, np.float64), np.asarray(std, np.float64)
    if error.shape != std.shape or error.ndim != 2 or not len(error):
        raise InputError(f"error is {error.shape} and std {std.shape}; expected the same [N, d] with N >= 1")
    return np.array([np.mean(np.abs(error) <= half_width(level) * std, axis=0) for level in levels])


def definiteness(
    dynamics: Dynamics | InverseForward, q: Float[Array | np.ndarray, "N d"], qd: Float[Array | np.ndarray, "N d"]
) -> tuple[float, float, float]:
    """Evaluates the eigenvalues of the mass matrix at N states. Reports only; does not repair the model.

    Returns three numbers: the smallest eigenvalue in the unit of M (NaN if a matrix is not finite); the fraction of
    states, 0 to 1, with an indefinite, numerically singular or non-finite M; and the largest condition number (infinite
    if M is singular or not finite).

    An eigenvalue counts as positive if it exceeds d times the rounding unit times the largest one of its matrix. A
    Hamiltonian model has M = H_pp⁻¹, which is not finite where H_pp is singular.

    Raises:
        InputError: the model has no mass matrix, or there are no states.
    """
    if not isinstance(dynamics, Dynamics):
        raise InputError("definiteness: the model has no mass matrix; give one that comes from an energy")
    if len(q) == 0:
        raise InputError("definiteness: q has no states; give at least one row")
    masses = np.asarray(jax.jit(jax.vmap(dynamics.mass_matrix))(q, qd))
    rounding = masses.shape[-1] * np.finfo(masses.dtype).eps
    finite = np.isfinite(masses).all(axis=(1, 2))
    eigenvalues = np.full(masses.shape[:2], np.nan)
    symmetric = (masses[finite] + masses[finite].swapaxes(1, 2)) / 2
    eigenvalues[finite] = np.linalg.eigvalsh(symmetric.astype(np.float64))

    sizes = np.abs(eigenvalues)
    largest, smallest = sizes.max(axis=1), sizes.min(axis=1)
    definite = eigenvalues.min(axis=1) > rounding * largest
    regular = smallest > rounding * largest
    conditions = np.divide(largest, smallest, out=np.full_like(largest, np.inf), where=regular)
    return (float(eigenvalues.min()), float(np.mean(~definite)), float(conditions.max()))
