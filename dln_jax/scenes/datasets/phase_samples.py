"""Samples in phase space with the exact field, from motions of a Hamiltonian system."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.integrators import adaptive_rollout
from dln_jax.precision import in_float64
from dln_jax.scenes.scene import Scene
from dln_jax.types import Dissipation, Hamiltonian, InputError, Vector, require_positive


class PhaseField(NamedTuple):
    """Time derivatives of states."""

    qd: Float[np.ndarray, "N d"]
    pd: Float[np.ndarray, "N d"]


class PhaseSamples(NamedTuple):
    """One side of the published split; all members have the same N samples."""

    data: Trajectories
    """As published: q and p with noise; qd, pd (and qdd) of the noiseless motion; tau = 0 exactly."""
    clean: Trajectories
    """The same samples without noise."""
    field: PhaseField
    """The exact (qd, pd) at the noisy q, p of `data`."""


class PhaseTask(NamedTuple):
    """A published dataset and the system that generated it."""

    scene: Scene
    hamiltonian: Hamiltonian
    """(q, p) -> the textbook H of one state."""
    published_energy: Hamiltonian
    """(q, p) -> the quantity published as the energy: q² + p² for the pendulum, else H."""
    t: np.ndarray
    """Times of every trajectory [T], s."""
    train: PhaseSamples
    test: PhaseSamples


def make_task(
    scene: Scene,
    H: Hamiltonian,
    published_energy: Hamiltonian,
    starts: np.ndarray,
    errors: np.ndarray | None,
    t: np.ndarray,
    trained: slice,
    tolerance: float,
) -> PhaseTask:
    """Makes a task from starts (q, p) [K, 2, d] at the times t [T], with noise on both [K, 2, T, d], or `None`.

    Raises:
        InputError: one side of the split has no trajectories.
    """
    order = np.arange(len(starts))
    train, test = order[trained], np.setdiff1d(order, order[trained])
    if not len(train) or not len(test):
        raise InputError(f"trajectories is {len(starts)}; expected enough to leave some on both sides of the split")
    d = scene.needs.degrees_of_freedom
    motion = reference_motion(H, starts[:, 0], starts[:, 1], t, dissipation=scene.dissipation, tolerance=tolerance)
    exact = functools.partial(_fields, H, scene.dissipation)
    q, p = (states.reshape(-1, d) for states in motion)
    field = qd, pd = tuple(np.asarray(rate) for rate in exact(q, p))
    qdd = np.asarray(_accelerations(H, q, p, qd, pd))
    trajectory, label = np.repeat(order, len(t)), np.array([f"{scene.name}-{index}" for index in order])
    times, tau = np.tile(t, len(starts)), np.zeros_like(q)
    data = clean = Trajectories(times, q, qd, qdd, tau, trajectory, label, p, pd, needs=scene.needs)
    if errors is not None:
        data = clean._replace(q=q + errors[:, 0].reshape(-1, d), p=p + errors[:, 1].reshape(-1, d))
        field = tuple(np.asarray(rate) for rate in exact(data.q, data.p))

    def part(indices: np.ndarray) -> PhaseSamples:
        chosen = np.isin(trajectory, indices)
        rates = PhaseField(*(rate[chosen] for rate in field))
        return PhaseSamples(select(data, indices), select(clean, indices), rates)

    return PhaseTask(scene, H, published_energy, t, part(train), part(test))


_GROUP = 500


@in_float64
def reference_motion(
    H: Hamiltonian,
    q: Float[np.ndarray, "K d"],
    p: Float[np.ndarray, "K d"],
    t: Float[np.ndarray, " T"],
    *,
    dissipation: Dissipation | None = None,
    tolerance: float = 1e-12,
) -> tuple[Float[np.ndarray, "K T d"], Float[np.ndarray, "K T d"]]:
    """Returns free motions (q, p) at times t from states at t[0], integrated adaptively to a tolerance per step.

    States between steps are interpolated, with an error of a few hundred times the tolerance.

    Raises:
        InputError: an integration does not finish, for example because bodies meet.
    """
    require_positive(tolerance=tolerance)
    # All motions of a call take as many steps as the slowest one, so groups save time. The last group is padded.
    size = min(len(q), _GROUP)
    groups = [np.minimum(np.arange(first, first + size), len(q) - 1) for first in range(0, len(q), size)]
    solved = [_solve(H, dissipation, tolerance, q[group], p[group], t) for group in groups]
    if not all(bool(successful.all()) for _, successful in solved):
        raise InputError(f"a motion could not be integrated to {tolerance:g}; ask for less accuracy or time")
    motions = (np.concatenate([states[half] for states, _ in solved])[: len(q)] for half in range(2))
    return next(motions), next(motions)


# Compiled once per Hamiltonian, so further seeds start at once.
@functools.partial(jax.jit, static_argnames=("H", "dissipation", "tolerance"))
def _solve(H: Hamiltonian, dissipation: Dissipation | None, tolerance: float, q, p, t):
    def rate(t, state):
        return _field(H, dissipation, *state)

    return jax.vmap(lambda q, p: adaptive_rollout(rate, (q, p), t, tolerance=tolerance))(q, p)


@functools.partial(jax.jit, static_argnames=("H", "dissipation"))
def _fields(H: Hamiltonian, dissipation: Dissipation | None, q, p):
    return jax.vmap(functools.partial(_field, H, dissipation))(q, p)


def _field(H: Hamiltonian, dissipation: Dissipation | None, q: Vector, p: Vector) -> tuple[Vector, Vector]:
    return hamiltonian.time_derivative(H, q, p, jnp.zeros_like(q), dissipation=dissipation)


@functools.partial(jax.jit, static_argnames=("H",))
def _accelerations(H: Hamiltonian, q, p, qd, pd):
    """Returns qdd = d/dt dH/dp along the motion."""
    return jax.vmap(lambda *state: jax.jvp(jax.grad(H, argnums=1), state[:2], state[2:])[1])(q, p, qd, pd)
