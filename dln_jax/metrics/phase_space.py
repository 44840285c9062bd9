"""Errors of a phase-space model: of its field at test states, and of its predicted motions.

    test loss        mean over samples and components of (rates - measured rates)², as published
    clean field      the same relative to the exact field at the same noisy states, which distinguishes models
    energy           mean over starts and times of (H(x_hat(t)) - H(x(t)))², with the true H
    rollout          mean over starts, times and components of (x_hat(t) - x(t))²

Standard errors are over starts. A few chaotic motions dominate means, so medians over starts are reported too. A motion
that is not finite, or needs more than `MOST_STEPS`, has infinite errors.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import column
from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.integrators import adaptive_rollout
from dln_jax.models.model import Model, Parameters
from dln_jax.scenes.datasets.hamiltonian_tasks import PhaseSamples
from dln_jax.types import Hamiltonian

TOLERANCE = 1e-9
MOST_STEPS = 5_000
"""Largest number of integrator steps of a predicted motion."""


class Motions(NamedTuple):
    """K motions at common times."""

    t: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "K T d"]
    p: Float[np.ndarray, "K T d"]


def field_rates(
    model: Model, parameters: Parameters, q: Float[np.ndarray, "N d"], p: Float[np.ndarray, "N d"]
) -> tuple[Float[np.ndarray, "N d"], Float[np.ndarray, "N d"]]:
    """Returns the rates (qd, pd) at the states."""
    qd, pd = _rates(model, parameters, jnp.asarray(q), jnp.asarray(p))
    return np.asarray(qd), np.asarray(pd)


def field_errors(model: Model, parameters: Parameters, part: PhaseSamples) -> dict[str, float]:
    """Returns `loss` against measured rates, and `clean_field_mse` against the exact field at the measured states."""
    data = part.data
    qd, pd = field_rates(model, parameters, data.q, column(data, "p"))

    def mean_square(velocity: np.ndarray, force: np.ndarray) -> float:
        return float(np.mean(np.concatenate([qd - velocity, pd - force]) ** 2))

    return {
        "loss": mean_square(data.qd, column(data, "pd")),
        "clean_field_mse": mean_square(part.field.qd, column(part.field, "pd")),
    }


def predict(
    model: Model,
    parameters: Parameters,
    q: Float[np.ndarray, "K d"],
    p: Float[np.ndarray, "K d"],
    t: Float[np.ndarray, " T"],
) -> Motions:
    """Predicts motions from the states at t[0], integrated adaptively to `TOLERANCE` per step."""
    states, successful = _motions(model, parameters, *map(jnp.asarray, (q, p, t)))
    finished = np.asarray(successful)[:, None, None]
    q_hat, p_hat = (np.where(finished, np.asarray(state), np.inf) for state in states)
    return Motions(np.asarray(t), q_hat, p_hat)


def energies(H: Hamiltonian, motions: Motions) -> Float[np.ndarray, "K T"]:
    """Returns H along motions; infinite if a state is not finite."""
    return finite_or_infinite(np.asarray(_along(H, jnp.asarray(motions.q), jnp.asarray(motions.p))))


def finite_or_infinite(values: np.ndarray | np.floating) -> np.ndarray:
    """Replaces NaN by infinity, so that it never counts as a small error."""
    return np.where(np.isfinite(values), values, np.inf)


def energy_errors(H: Hamiltonian, predicted: Motions, truth: Motions) -> Float[np.ndarray, " K"]:
    """Returns the mean over time of (H(x_hat) - H(x))² of the motions; infinite for motions that are not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return finite_or_infinite(np.mean((energies(H, predicted) - energies(H, truth)) ** 2, axis=1))


def state_errors(predicted: Motions, truth: Motions) -> Float[np.ndarray, " K"]:
    """Returns the mean over time and components of (x_hat - x)²; infinite for motions that are not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.concatenate([predicted.q - truth.q, predicted.p - truth.p], axis=2) ** 2
        return finite_or_infinite(np.mean(errors, axis=(1, 2)))


def summary(name: str, errors: Float[np.ndarray, " K"]) -> dict[str, float]:
    """Returns `name` (mean), `name_standard_error` (NaN for a single error) and `name_median` of errors."""
    count = len(errors)
    finite = bool(np.isfinite(errors).all())
    spread = float(np.std(errors, ddof=1) / np.sqrt(count)) if finite and count > 1 else float("nan")
    return {name: float(np.mean(errors)), f"{name}_standard_error": spread, f"{name}_median": float(np.median(errors))}


def motion_errors(
    predicted: Sequence[Motions],
    truth: Sequence[Motions],
    H: Hamiltonian | None,
    *,
    published_energy: Hamiltonian | None = None,
) -> dict[str, float]:
    """Returns `rollout_mse`, `energy_mse` if H is known, and `published_energy_mse` if that energy differs from H.

    `summary` reports each over all motions of all entries; the times may differ between entries.
    """

    def over_all(name: str, error: Callable[[Motions, Motions], np.ndarray]) -> dict[str, float]:
        return summary(name, np.concatenate(list(map(error, predicted, truth))))

    errors = {} if H is None else over_all("energy_mse", functools.partial(energy_errors, H))
    if published_energy is not None and published_energy is not H:
        errors |= over_all("published_energy_mse", functools.partial(energy_errors, published_energy))
    return errors | over_all("rollout_mse", state_errors)


def free_motions(
    states: Float[np.ndarray, "K T n"], joints: int, *, fitted: int, quarter: int
) -> tuple[Float[np.ndarray, "K 1 n"], Float[np.ndarray, "K T n"]]:
    """Returns two guesses without a model, rest and force-free motion, from the last of the `fitted` samples on.

    Args:
        states: measured states; the first `joints` columns are coordinates, the others momenta.
        quarter: a quarter period in samples; velocities are differences over a quarter of it.
    """
    near = max(quarter // 4, 1)
    first = max(fitted - 1 - near, 0)
    slope = (states[:, [first + near]] - states[:, [first]]) / near
    momenta, start = np.arange(states.shape[2]) >= joints, states[:, [fitted - 1]]
    line = start + slope * (np.arange(states.shape[1]) - fitted + 1)[:, None]
    return np.where(momenta, 0.0, start), np.where(momenta, start, line)


# Compiled once per model, for all parameters.
@functools.partial(jax.jit, static_argnames=("model",))
def _rates(model: Model, parameters, q, p):
    return jax.vmap(flow(model.energies(parameters)).rates)(q, p)


@functools.partial(jax.jit, static_argnames=("model",))
def _motions(model: Model, parameters, q, p, t):
    rates = flow(model.energies(parameters)).rates

    def motion(q, p):
        return adaptive_rollout(lambda t, state: rates(*state), (q, p), t, tolerance=TOLERANCE, max_steps=MOST_STEPS)

    return jax.vmap(motion)(q, p)


@functools.partial(jax.jit, static_argnames=("H",))
def _along(H: Hamiltonian, q, p):
    return jax.vmap(jax.vmap(H))(q, p)
