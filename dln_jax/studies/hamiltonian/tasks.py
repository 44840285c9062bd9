"""What a Hamiltonian task is, from its name: the data to fit, and the motions that a model has to predict.

Generated tasks are those of `datasets.hamiltonian_tasks`. Measurements have neither momenta nor rates of them: models
that have momenta p = dL/dqd of their own are fitted in coordinates and velocities, for others p is taken as qd, the
momentum per unit of inertia. A single trajectory is predicted over its last fifth, of several every sixth, unless the
test is stated; what is left is cut into stretches without a gap. Velocities that were not measured are those of local
polynomials.
"""

from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data import schema
from dln_jax.data.local_polynomials import smooth_locally
from dln_jax.data.magnitudes import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import PER_SAMPLE, label_indices, require_no_copies, select
from dln_jax.data.stretches import stretches
from dln_jax.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.datasets.phase_samples import Part, reference_motion
from dln_jax.learning.measured_motions import MeasuredWindows, Noise
from dln_jax.metrics.measured_predictions import cut_stretches
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
HORIZON_WINDOWS = 20
"""Most windows that a measured motion is predicted for."""
LEAST_NOISE = 1e-6
"""Of the spread of a measurement: what has less noise is exact."""
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
    noise: Noise | None = None
    """Of measurements without momenta; `None` for all else."""
    tests: MeasuredWindows | None = None
    """Of the same: stretches to predict, whose starts are fitted to their first `WINDOW` samples."""


class Stated(NamedTuple):
    """What is known of measurements beside their file."""

    needs: Needs | None = None
    """Of the plant (default: what the file states, else revolute joints with a potential and friction)."""
    test: str | None = None
    """Labels of the test trajectories, separated by commas, or another file of them."""
    noise: tuple[float, ...] | None = None
    """Standard deviation of q, one for all or one each (default: estimated)."""
    rate: float | None = None
    """Hz, of a file without t."""
    units: str | None = None
    """Of a CSV file's titles without a unit."""


NOTHING = Stated()


def problem_of(
    name: str, *, trajectories: int | None = None, data: Path | None = None, stated: Stated = NOTHING
) -> Problem:
    """The task of a name; generated data are those of seed 0.

    Args:
        name: from `TASKS`.
        trajectories: of generated data, in place of the task's own number.
        data: file in the npz schema; only measurements take one, and they need it.
        stated: of measured motions, beside.

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
    loaded = schema.load(data, rate=stated.rate, units=stated.units)
    if name == REAL:
        if loaded.degrees_of_freedom != 1:
            raise InputError(f"{data} has {loaded.degrees_of_freedom} coordinates; the task is that of one pendulum")
        stated = Stated(Needs(joints=("revolute",), friction=True))
    return measured(name, loaded, str(data), stated)


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


def measured(name: str, data: Trajectories, file: str, stated: Stated = NOTHING) -> Problem:
    """Motions that were measured, without applied forces."""
    needs = needs_of(data, file, stated.needs)
    fitted, test = parted(name, data, file, stated.test)
    energy = real_energy if name == REAL else None
    noise, stretched = None, None
    if name == MEASURED and data.p is None:
        fitted, noise = with_rates(fitted, stated.noise)
        test, _ = with_rates(test, stated.noise)
        stretched = to_predict(test)
    fitted, test = (
        part._replace(p=part.qd if part.p is None else part.p, pd=part.qdd if part.pd is None else part.pd)
        for part in (fitted, test)
    )
    present = np.unique(test.trajectory)[:STARTS]
    tests = [select(test, np.array([index])) for index in present]
    length = min(len(each.t) for each in tests)
    truth = tuple(motion_of(each, length) for each in tests)
    return Problem(name, needs, pieces(fitted, WINDOW[name]), None, None, truth, energy, energy, noise, stretched)


def needs_of(data: Trajectories, file: str, stated: Needs | None) -> Needs:
    """Of a plant that moves by itself; `InputError` for one that does not, or is of another size than stated."""
    d = data.degrees_of_freedom
    if "tau" not in data.estimated and np.any(data.tau):
        raise InputError(f"{file} has applied forces tau; a phase field knows none: leave --task out")
    needs = stated or data.needs or Needs(joints=("revolute",) * d, friction=True)
    if needs.degrees_of_freedom != d:
        raise InputError(f"the needs have {needs.degrees_of_freedom} joints, but {file} has {d}; make them agree")
    return needs


def parted(name: str, data: Trajectories, file: str, test: str | None) -> tuple[Trajectories, Trajectories]:
    """What is fitted, and what is predicted; `InputError` where one of them is not there, or in the other."""
    present = np.unique(data.trajectory)
    if test is not None and test.endswith(".npz"):
        other = schema.load(test)
        if other.degrees_of_freedom != data.degrees_of_freedom:
            raise InputError(f"{test} has {other.degrees_of_freedom} coordinates, {file} {data.degrees_of_freedom}")
        return data, other
    if test is None and len(present) == 1:
        count = len(data.t) - round(TEST_SHARE * len(data.t))
        if min(count, len(data.t) - count) < WINDOW[name]:
            raise InputError(f"{file} has {len(data.t)} samples; expected some hundred, a fifth of them for the test")
        return samples_of(data, slice(0, count)), samples_of(data, slice(count, None))
    chosen = present[5::6] if len(present) >= 6 else present[-1:]
    if test is not None:
        chosen = label_indices(data, [label.strip() for label in test.split(",")])
    rest = np.setdiff1d(present, chosen)
    if not len(rest):
        raise InputError(f"all trajectories of {file} are for the test; leave some to learn from")
    fitted, held = select(data, rest), select(data, chosen)
    require_no_copies(fitted, held)
    return fitted, held


def with_rates(data: Trajectories, noise: tuple[float, ...] | None) -> tuple[Trajectories, Noise]:
    """With velocities and accelerations of local polynomials where they were not measured; and the noise.

    Raises:
        InputError: noise of another number of coordinates, or stretches that are too short.
    """
    d = data.degrees_of_freedom
    if noise is not None and len(noise) not in (1, d):
        raise InputError(f"noise has {len(noise)} numbers; expected one, or one for each of {d} coordinates")
    smooth = smooth_locally(data)
    of_q = _at_least(smooth.noise if noise is None else np.broadcast_to(noise, d), data.q)
    if "qd" not in data.estimated:
        return data, Noise(of_q, _at_least(smooth_locally(data._replace(q=data.qd)).noise, data.qd))
    kept = samples_of(data, smooth.rows)
    return kept._replace(qd=smooth.data.qd, qdd=smooth.data.qdd), Noise(of_q)


def _at_least(noise: np.ndarray, values: np.ndarray) -> tuple[float, ...]:
    """The noise, or the least that counts."""
    size = spread("q and qd", values)
    return tuple(np.maximum(noise, LEAST_NOISE * np.where(size > 0, size, 1.0)).tolist())


def to_predict(test: Trajectories) -> MeasuredWindows:
    """Stretches without a gap, as long as the shortest of several windows."""
    parts = [each for each in stretches(test.t, test.trajectory) if len(each) > WINDOW[MEASURED]]
    if not parts:
        raise InputError(f"no test motion has {WINDOW[MEASURED] + 1} samples without a gap; record longer ones")
    index = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    whole = samples_of(test, np.concatenate(parts))._replace(trajectory=index, label=np.unique(index).astype(str))
    length = min(min(map(len, parts)), HORIZON_WINDOWS * WINDOW[MEASURED])
    return cut_stretches(whole, length, every=max(length // 2, 1))


def motion_of(test: Trajectories, length: int) -> Motions:
    """The first samples of one trajectory as the motion that is to be predicted."""
    return Motions(test.t[:length] - test.t[0], test.q[None, :length], schema.column(test, "p")[None, :length])


def samples_of(data: Trajectories, chosen: slice | np.ndarray) -> Trajectories:
    """Some of the samples."""
    arrays = {key: getattr(data, key) for key in PER_SAMPLE}
    return data._replace(**{key: array[chosen] for key, array in arrays.items() if array is not None})


def pieces(data: Trajectories, length: int) -> Trajectories:
    """Stretches without a gap, cut to the length of two windows, as trajectories of their own: some to validate by."""
    parts = [
        each[at : at + 2 * length]
        for each in stretches(data.t, data.trajectory)
        for at in range(0, len(each), 2 * length)
    ]
    index = np.arange(len(parts))
    return data._replace(trajectory=np.repeat(index, [len(part) for part in parts]), label=index.astype(str))
