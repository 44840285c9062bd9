"""Builds a Hamiltonian task from its name: the data to fit, and the motions to predict.

Generated tasks are those of `datasets.hamiltonian_tasks`. For measurements without momenta, models with their own
momenta p = dL/dqd are fitted in coordinates and velocities; for other models p is taken as qd, the momentum per unit of
inertia. Unless the test is stated, it is the last fifth of a single trajectory, or every sixth of several. The training
data are cut into segments without a gap. Velocities that were not measured come from local polynomials.
"""

from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories, column
from dln_jax.data.splits import select
from dln_jax.learning.shooting import MeasuredWindows, Noise
from dln_jax.metrics.phase_space import Motions
from dln_jax.scenes.datasets.hamiltonian_tasks import PROTOCOLS, PhaseSamples, reference_motion
from dln_jax.training.hamiltonian.measurements import (
    MEASURED,
    NOTHING,
    REAL,
    WINDOW,
    Stated,
    Trust,
    gap_count,
    motion_of,
    needs_of,
    parted,
    pieces,
    to_predict,
    trust_of,
    with_momenta,
    with_rates,
)
from dln_jax.types import Hamiltonian, InputError, Needs

TASKS = (*PROTOCOLS, REAL, MEASURED)
STARTS = 50
"""Largest number of test motions predicted."""
POINTS = 251
"""Number of times for comparing them."""
HORIZONS = {
    **{"spring": 20.0, "pendulum": 20.0, "damped-spring": 20.0, "damped-pendulum": 20.0},
    **{"henon-heiles": 30.0, "double-pendulum": 5.0, "two-body": 25.0, "three-body": 3.0},
}
"""Prediction horizon in s, as published for the bodies."""


class Problem(NamedTuple):
    """The data of a task, and the motions that a model has to predict from their first states."""

    name: str
    needs: Needs
    fitted: Trajectories
    """Training and validation data with q, p, qd, pd."""
    train: PhaseSamples | None
    """Training data with the exact field; `None` for measurements."""
    test: PhaseSamples | None
    truth: tuple[Motions, ...]
    """Motions to predict; the motions of an entry share their times."""
    energy: Hamiltonian | None
    """The true energy; `None` if unknown."""
    published_energy: Hamiltonian | None
    """The quantity published as the energy."""
    noise: Noise | None = None
    """Noise of measurements without momenta; `None` otherwise."""
    tests: MeasuredWindows | None = None
    """Recordings to predict, across their gaps, with starts fitted to their first `WINDOW` samples."""
    trust: Trust | None = None
    assumed: bool = False
    """Whether the needs are not stated, so that the data decide between candidates."""
    gaps: int = 0
    recorded: Trajectories | None = None
    """The file as it was read; `None` for generated data."""
    held_out: Trajectories | None = None
    """Test states q, p with their rates qd, pd, measured or of the exact field."""


def problem_of(
    name: str, *, trajectories: int | None = None, data: Path | None = None, stated: Stated = NOTHING
) -> Problem:
    """The task with this name; generated data are those of seed 0.

    Args:
        name: from `TASKS`.
        trajectories: number of generated trajectories, in place of the task's own.
        data: npz or CSV file; required for measurements, refused otherwise.

    Raises:
        InputError: an unknown name, too few trajectories, or a file that is missing or unsuitable.
    """
    if name not in TASKS:
        raise InputError(f"task '{name}' is unknown; choose from {', '.join(TASKS)}")
    if name in PROTOCOLS:
        if data is not None:
            raise InputError(f"task '{name}' generates its data; for a file choose {REAL} or {MEASURED}")
        return generated(name, trajectories)
    if data is None:
        raise InputError(f"task '{name}' needs its data, which are not part of this project: give their file")
    loaded = schema.load(data, **stated.file)
    if name == REAL:
        if loaded.degrees_of_freedom != 1:
            raise InputError(f"{data} has {loaded.degrees_of_freedom} coordinates; the task is that of one pendulum")
        stated = Stated(Needs(joints=("revolute",), friction=True))
    return measured(name, loaded, str(data), stated)


def generated(name: str, trajectories: int | None) -> Problem:
    """A generated task, with a known field."""
    task = PROTOCOLS[name](0) if trajectories is None else PROTOCOLS[name](0, trajectories=trajectories)
    clean = task.test.clean
    first = np.flatnonzero(np.diff(clean.trajectory, prepend=-1))[:STARTS]
    t = np.linspace(0.0, HORIZONS[name], POINTS)
    start = clean.q[first], schema.column(clean, "p")[first]
    q, p = reference_motion(task.hamiltonian, *start, t, dissipation=task.scene.dissipation)
    energies = task.hamiltonian, task.published_energy
    sides, truth = (task.train.data, task.train, task.test), (Motions(t, q, p),)
    held_out = task.test.data._replace(**task.test.field._asdict())
    return Problem(name, task.scene.needs, *sides, truth, *energies, held_out=held_out)


def real_energy(q: Array, p: Array) -> Array:
    """The published energy of the measured pendulum, in its own units."""
    return jnp.sum(2.4 * (1 - jnp.cos(q)) + p**2)


def measured(name: str, data: Trajectories, file: str, stated: Stated = NOTHING) -> Problem:
    """A task of measured motions without applied forces."""
    needs = needs_of(data, file, stated.needs)
    fitted, test = parted(name, data, file, stated.test)
    energy = real_energy if name == REAL else None
    noise, tests, trust, assumed = None, None, None, stated.needs is None and data.needs is None
    if name == MEASURED and data.p is None:
        fitted, noise = with_rates(fitted, stated.noise)
        test, _ = with_rates(test, stated.noise)
    fitted, test = with_momenta(fitted), with_momenta(test)
    fitted = pieces(fitted, WINDOW[name])
    if name == MEASURED:
        trust = trust_of(fitted, stated.noise)
        tests = to_predict(test._replace(qd=column(test, "p")))
        if tests is None and noise is not None:
            raise InputError(f"no test motion has {WINDOW[MEASURED] + 1} samples without a gap; record longer ones")
    present = np.unique(test.trajectory)[:STARTS]
    truth = tuple(motion_of(select(test, np.array([index]))) for index in present)
    known = noise, tests, trust, assumed, gap_count(test), data, test
    return Problem(name, needs, fitted, None, None, truth, energy, energy, *known)
