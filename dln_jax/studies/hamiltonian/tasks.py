"""What a Hamiltonian task is, from its name: the data to fit, and the motions that a model has to predict.

Generated tasks are those of `datasets.hamiltonian_tasks`. Measurements have neither momenta nor rates of them: p is
taken as qd, the momentum per unit of inertia. A single trajectory is predicted over its last fifth, of several every
sixth; what is left is cut into stretches without a gap.
"""

from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import PER_SAMPLE, require_no_copies, select
from dln_jax.data.stretches import stretches
from dln_jax.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.datasets.phase_samples import Part, reference_motion
from dln_jax.metrics.phase_space import Motions
from dln_jax.types import Hamiltonian, InputError, Needs

REAL, MEASURED, PIXELS = "real-pendulum", "measured", "pixels"
TASKS = (*PROTOCOLS, REAL, MEASURED)
TEST_SHARE = 0.2
"""Of a single measured trajectory: its last samples, as published."""
STARTS = 50
"""Test motions that are predicted, at most."""
POINTS = 251
"""Times at which they are compared."""
HORIZONS = {
    **{"spring": 20.0, "pendulum": 20.0, "damped-spring": 20.0, "damped-pendulum": 20.0},
    **{"henon-heiles": 30.0, "double-pendulum": 5.0, "two-body": 25.0, "three-body": 3.0},
}
"""Time in s for which motions are predicted, as published for the bodies."""
WINDOW = {REAL: 30, MEASURED: 30}
"""Samples of a window of measurements; shorter trajectories than two of them are taken whole."""


class Problem(NamedTuple):
    """A task's data, and the motions that a model has to predict from their first states."""

    name: str
    needs: Needs
    fitted: Trajectories
    """For training and validation: q, p, qd, pd."""
    train: Part | None
    """With the exact field; `None` for measurements."""
    test: Part | None
    truth: tuple[Motions, ...]
    """Motions with times of their own; those of one entry share theirs."""
    energy: Hamiltonian | None
    """The true one; `None` where nobody knows it."""
    published_energy: Hamiltonian | None
    """Whose error was published as that of the energy."""


def problem_of(
    name: str, *, trajectories: int | None = None, data: Path | None = None, needs: Needs | None = None
) -> Problem:
    """The task of a name; generated data are those of seed 0.

    Args:
        name: from `TASKS`.
        trajectories: of generated data, in place of the task's own number.
        data: file in the npz schema; only measurements take one, and they need it.
        needs: of the measured plant (default: what the file states, else revolute joints with a potential and
            friction).

    Raises:
        InputError: an unknown name, too few trajectories, or a file that is missing or does not suit.
    """
    if name not in TASKS:
        raise InputError(f"task '{name}' is unknown; choose from {', '.join(TASKS)}")
    if name in PROTOCOLS:
        if data is not None:
            raise InputError(f"task '{name}' generates its data; for a file choose {REAL} or {MEASURED}")
        return generated(name, trajectories)
    if data is None:
        raise InputError(f"task '{name}' needs its data, which are not part of this project: give their file")
    loaded = schema.load(data)
    if name == REAL:
        if loaded.degrees_of_freedom != 1:
            raise InputError(f"{data} has {loaded.degrees_of_freedom} coordinates; the task is that of one pendulum")
        needs = Needs(joints=("revolute",), friction=True)
    return measured(name, loaded, str(data), needs)


def generated(name: str, trajectories: int | None) -> Problem:
    """A task whose field is known."""
    task = PROTOCOLS[name](0) if trajectories is None else PROTOCOLS[name](0, trajectories=trajectories)
    clean = task.test.clean
    first = np.flatnonzero(np.diff(clean.trajectory, prepend=-1))[:STARTS]
    t = np.linspace(0.0, HORIZONS[name], POINTS)
    start = clean.q[first], schema.column(clean, "p")[first]
    q, p = reference_motion(task.hamiltonian, *start, t, dissipation=task.scene.dissipation)
    energies = task.hamiltonian, task.published_energy
    return Problem(name, task.scene.needs, task.train.data, task.train, task.test, (Motions(t, q, p),), *energies)


def real_energy(q: Array, p: Array) -> Array:
    """The published energy of the measured pendulum, in its units."""
    return jnp.sum(2.4 * (1 - jnp.cos(q)) + p**2)


def measured(name: str, data: Trajectories, file: str, needs: Needs | None) -> Problem:
    """Motions that were measured, without applied forces."""
    d = data.degrees_of_freedom
    if "tau" not in data.estimated and np.any(data.tau):
        raise InputError(f"{file} has applied forces tau; a phase field knows none: leave --task out")
    needs = needs or data.needs or Needs(joints=("revolute",) * d, friction=True)
    if needs.degrees_of_freedom != d:
        raise InputError(f"the needs have {needs.degrees_of_freedom} joints, but {file} has {d}; make them agree")
    data = data._replace(p=data.qd if data.p is None else data.p, pd=data.qdd if data.pd is None else data.pd)
    present = np.unique(data.trajectory)
    if len(present) == 1:
        count = len(data.t) - round(TEST_SHARE * len(data.t))
        if min(count, len(data.t) - count) < WINDOW[name]:
            raise InputError(f"{file} has {len(data.t)} samples; expected some hundred, a fifth of them for the test")
        fitted, tests = samples_of(data, slice(0, count)), [samples_of(data, slice(count, None))]
    else:
        chosen = present[5::6] if len(present) >= 6 else present[-1:]
        fitted = select(data, np.setdiff1d(present, chosen))
        require_no_copies(fitted, select(data, chosen))
        tests = [select(data, chosen[[place]]) for place in range(min(len(chosen), STARTS))]
    length = min(len(test.t) for test in tests)
    truth = tuple(motion_of(test, length) for test in tests)
    energy = real_energy if name == REAL else None
    return Problem(name, needs, pieces(fitted, WINDOW[name]), None, None, truth, energy, energy)


def motion_of(test: Trajectories, length: int) -> Motions:
    """The first samples of one trajectory as the motion that is to be predicted."""
    return Motions(test.t[:length] - test.t[0], test.q[None, :length], schema.column(test, "p")[None, :length])


def samples_of(data: Trajectories, chosen: slice) -> Trajectories:
    """Some of the samples."""
    arrays = {key: getattr(data, key) for key in PER_SAMPLE}
    return data._replace(**{key: array[chosen] for key, array in arrays.items() if array is not None})


def pieces(data: Trajectories, length: int) -> Trajectories:
    """Stretches without a gap, cut to the length of two windows, as trajectories of their own: some to validate by."""
    parts = [each[at : at + 2 * length] for each in stretches(data) for at in range(0, len(each), 2 * length)]
    index = np.arange(len(parts))
    return data._replace(trajectory=np.repeat(index, [len(part) for part in parts]), label=index.astype(str))
