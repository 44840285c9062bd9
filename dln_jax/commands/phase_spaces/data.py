"""Motions of a Hamiltonian task: data to fit, motions to predict, and the noise in both.

Generated tasks are those of `scenes.datasets.hamiltonian_tasks`; the others read a file. For a file without momenta,
models with their own momenta p = dL/dqd are fitted in coordinates and velocities; for other models p is taken as qd,
the momentum per unit of inertia. Motions with noisy states are fitted through an integrator, weighted by that noise. If
states and rates are free of noise, a fit of the rates is sufficient.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dln_jax.data import schema
from dln_jax.data.arrays import spread
from dln_jax.data.bodies import Bodies, Order, find_bodies
from dln_jax.data.encoders.smoothing import FEWEST, smooth_locally
from dln_jax.data.log import ASSUMED, NOISY, read_log
from dln_jax.data.repeated_motions import motion_numbers
from dln_jax.data.schema import Trajectories, column, time_derivative
from dln_jax.data.splits import segments, select_samples, split, stated_test, with_joints
from dln_jax.learning.shooting import MeasuredWindows, Noise, Weights
from dln_jax.metrics.phase_space import Motions
from dln_jax.metrics.predictions import cut_recordings, grid_places
from dln_jax.scenes.datasets.hamiltonian_tasks import PROTOCOLS, PhaseSamples, reference_motion
from dln_jax.types import Hamiltonian, InputError, Needs

REAL, MEASURED = "real-pendulum", "measured"
TEST_SHARE = 0.2
"""Fraction of a single measured trajectory, at its end, used for the test, as published."""
STARTS = 50
"""Largest number of test motions predicted."""
POINTS = 251
"""Number of times for comparing predictions of generated motions."""
HORIZON_WINDOWS = 20
"""Largest number of windows predicted for a measured motion; a longer gap ends a recording."""
LEAST_NOISE = 1e-6
"""Measurements with noise below this fraction of their spread count as exact."""
FREE_OF_NOISE = 1e-3
"""Below this ratio of the states' noise to their spread the bias of a fit of rates, its square, is negligible."""
LEAST_RATE_NOISE = 0.01
"""Lower limit of the noise of measured rates, relative to their spread, since no model predicts them exactly."""
ANCHOR = 30.0
"""Noise of estimated momenta, in units of their spread: without any weight, a model could choose its own momentum."""
SURVEYED = 1_500
"""Approximate number of samples used to estimate noise; this gives its standard deviation to 2 %."""


class Task(NamedTuple):
    """Defaults of a task; networks and trainings were chosen by trial on seed 0, and are the same for all seeds."""

    suits: str
    """The model that suits the scene; empty for any plant, whose model is selected by validation."""
    width: int
    """Hidden units per layer of that model."""
    depth: int
    network: int
    """Hidden units per layer of less structured models: a Hamiltonian that is one network, and the baseline."""
    network_depth: int
    steps: int
    """Iterations of Gauss-Newton on rates."""
    samples: int
    trajectory_steps: int = 0
    """Iterations of Gauss-Newton on trajectories after the fit of rates."""
    window: int = 0
    """Samples per window; measured trajectories shorter than two windows are used as one."""
    weights: Weights | None = None
    """Weights of the trajectories; `None` if the data determine them."""
    substeps: int = 4
    """RK4 steps between two samples."""
    horizon: float = 0.0
    """Prediction horizon of generated motions, s, as published for the bodies."""
    needs: Needs | None = None
    """Joints and terms, if the file need not state them."""
    energy: Hamiltonian | None = None
    """The published energy of measured motions."""


# The noise of spring and pendulum has sd 0.1; their rates are noiseless and get a weight of 0.01.
_NOISY = Weights(state=0.1, rate=0.01)
_SPRING = Task("separable-hnn", 8, 1, 16, 1, 40, 10_000, 40, 30, _NOISY, 1, horizon=20.0)
_PENDULUM = _SPRING._replace(trajectory_steps=50, window=15)
TASKS = {
    "spring": _SPRING,
    "pendulum": _PENDULUM,
    "damped-spring": _SPRING,
    "damped-pendulum": _PENDULUM,
    "henon-heiles": Task("separable-hnn", 12, 2, 24, 2, 100, 4_000, horizon=30.0),
    "double-pendulum": Task("structured-hnn", 8, 2, 24, 2, 100, 4_000, horizon=5.0),
    "two-body": Task("pairwise-hnn", 8, 1, 24, 2, 60, 3_000, horizon=25.0),
    "three-body": Task("pairwise-hnn", 8, 1, 24, 2, 60, 4_000, horizon=3.0),
    REAL: Task("separable-hnn", 4, 1, 8, 1, 40, 10_000, 40, 30, Weights(state=0.03), 1)._replace(
        needs=Needs(joints=("revolute",), friction=True),
        energy=lambda q, p: jnp.sum(2.4 * (1 - jnp.cos(q)) + p**2),  # in the authors' units
    ),
    MEASURED: Task("", 8, 1, 8, 1, 60, 10_000, 60, 30, substeps=2),
}


class PhaseLog(NamedTuple):
    """The data of a task, and the motions that a model has to predict from their first states."""

    name: str
    task: Task
    needs: Needs
    fitted: Trajectories
    """Training and validation data with q, p, qd, pd."""
    held_out: Trajectories
    """Test states q, p with their rates qd, pd, measured or of the exact field."""
    truth: tuple[Motions, ...]
    """Motions to predict; the motions of an entry share their times."""
    energy: Hamiltonian | None = None
    """The true energy; `None` if unknown."""
    published_energy: Hamiltonian | None = None
    """The quantity published as the energy, if it differs."""
    exact: tuple[PhaseSamples, PhaseSamples] | None = None
    """Training and test data with the exact field; `None` for measurements."""
    momenta: bool = True
    """Whether p was measured; otherwise it is qd."""
    noise: Noise | None = None
    """Noise of measurements without momenta; `None` otherwise."""
    weights: Weights | None = None
    """Noise that weighs measured states and rates, with lower limits; `None` if unknown."""
    free_of_noise: bool = False
    """Whether rates are measured and states have so little noise that fitting the rates is sufficient."""
    state_noise: np.ndarray | None = None
    """Noise of q and p that was stated or measured [2 d]; 0 where it is unknown."""
    tests: MeasuredWindows | None = None
    """Recordings to predict, across their gaps, with starts fitted to their first window."""
    assumed: bool = False
    """Whether the needs are not stated, so that the data decide between candidates."""
    remarks: tuple[str, ...] = ()
    """Lines that state how the file was read, and the findings of its check."""


def generate(name: str, trajectories: int | None = None) -> PhaseLog:
    """A generated task, with its exact field; the data are those of seed 0.

    Raises:
        InputError: an unknown name, or too few trajectories.
    """
    if name not in PROTOCOLS:
        raise InputError(f"task '{name}' is unknown; choose from {', '.join(TASKS)}")
    task = TASKS[name]
    made = PROTOCOLS[name](0) if trajectories is None else PROTOCOLS[name](0, trajectories=trajectories)
    clean, t = made.test.clean, np.linspace(0.0, task.horizon, POINTS)
    first = np.flatnonzero(np.diff(clean.trajectory, prepend=-1))[:STARTS]
    starts = clean.q[first], column(clean, "p")[first]
    motions = reference_motion(made.hamiltonian, *starts, t, dissipation=made.scene.dissipation)
    return PhaseLog(
        name,
        task,
        made.scene.needs,
        fitted=made.train.data,
        held_out=made.test.field,
        truth=(Motions(t, *motions),),
        energy=made.hamiltonian,
        published_energy=made.published_energy,
        exact=(made.train, made.test),
    )


def read_motions(
    name: str,
    path: str | Path | None,
    *,
    needs: Needs | None = None,
    test: str | None = None,
    noise: tuple[float, ...] | None = None,
    **facts: Any,
) -> PhaseLog:
    """A task of measured motions without applied forces; segments are cut to the length of two windows.

    Args:
        name: the task.
        path: file of the motions.
        needs: joints and terms (default: the file's, else bodies if forces balance, else revolute joints with
            friction).
        test: labels of the test trajectories, separated by commas, or an npz file with test trajectories.
        noise: standard deviation of q, one for all or one each; or, if the file has p, of q and then p (default:
            estimated).
        facts: keywords of `data.log.read_log`.

    Raises:
        InputError: a file that is missing or unsuitable, applied forces, or noise of another number of coordinates.
    """
    task = TASKS[name]
    if path is None:
        raise InputError(f"task '{name}' needs a file of measured motions; give it with --data")
    known = {"needs": needs, "assume": assumed_needs}
    if task.needs is not None:
        known = {"needs": task.needs, "needs_origin": f"task '{name}'"}
    log = read_log(path, driven=False, settled=(NOISY,), **known, **facts)
    d, momenta, estimates = log.data.degrees_of_freedom, log.data.p is not None, task.weights is None
    if noise is not None and len(noise) not in ((1, d, 2 * d) if momenta else (1, d)):
        more = f", or {2 * d} of q and then p" if momenta else ""
        raise InputError(f"noise has {len(noise)} numbers; expected one, or one for each of {d} coordinates{more}")
    fitted, held_out, remarks = split_test(log.data, log.name, test, task.window)
    of_coordinates = None
    if estimates and not momenta:
        fitted, of_coordinates = with_rates(fitted, noise)
        held_out, _ = with_rates(held_out, noise)
    fitted, held_out = with_momenta(fitted), with_momenta(held_out)
    length = 2 * task.window
    whole = segments(fitted.t, fitted.trajectory)
    counts = [len(rows[at : at + length]) for rows in whole for at in range(0, len(rows), length)]
    index = np.arange(len(counts))
    fitted = fitted._replace(trajectory=np.repeat(index, counts), label=index.astype(str))
    p, present, whole = column(held_out, "p"), np.unique(held_out.trajectory), segments(held_out.t, held_out.trajectory)
    longest, tests, truth = HORIZON_WINDOWS * task.window, None, []
    if estimates and (of_coordinates is not None or max(map(len, whole)) > task.window):
        tests = cut_recordings(held_out._replace(qd=p), longest, fitted=task.window)
        if len(whole) > len(present):
            gaps = f"test recordings have {len(whole) - len(present)} gap(s)"
            remarks = (*remarks, f"{gaps}; predictions go on across them by time stamps")
    for index in present[:STARTS]:
        rows = np.flatnonzero(held_out.trajectory == index)
        rows = np.split(rows, np.flatnonzero(np.diff(grid_places(held_out.t[rows])) > longest) + 1)[0]
        truth.append(Motions(held_out.t[rows] - held_out.t[rows[0]], held_out.q[None, rows], p[None, rows]))
    return PhaseLog(
        name,
        task,
        log.needs,
        fitted,
        held_out,
        tuple(truth),
        energy=task.energy,
        momenta=momenta,
        noise=of_coordinates,
        tests=tests,
        assumed=log.needs_origin == ASSUMED,
        remarks=(*log.remarks, *remarks),
        **(weights_of(fitted, noise) if estimates else {}),
    )


def assumed_needs(data: Trajectories) -> Needs:
    """Prismatic coordinates if the measured forces balance as between bodies, else revolute joints with friction."""
    d, turning = data.degrees_of_freedom, bodies_of(data) is None
    return Needs(joints=("revolute" if turning else "prismatic",) * d, friction=turning)


def bodies_of(data: Trajectories, order: Order | None = None) -> Bodies | None:
    """The arrangement in which the forces on bodies balance; forces are pd, else accelerations, up to the masses."""
    return find_bodies(data.qdd if data.pd is None else data.pd, order=order)


def split_test(
    data: Trajectories, file: str, test: str | None, window: int
) -> tuple[Trajectories, Trajectories, tuple[str, ...]]:
    """Training and test trajectories, and remarks on a test file.

    The test is the last fifth of a single trajectory, or every sixth of several, unless it is stated.

    Raises:
        InputError: a part that is missing or too short, or a test that copies training data.
    """
    if test is not None and test.endswith(".npz"):
        other = schema.load(test)
        if other.degrees_of_freedom != data.degrees_of_freedom:
            raise InputError(f"{test} has {other.degrees_of_freedom} coordinates, {file} {data.degrees_of_freedom}")
        if data.joint_names is not None and other.joint_names is not None:
            other = with_joints(other, data.joint_names.tolist())
        return data, other, tuple(f"{test}: {line}" for line in other.remarks)
    if test is None and len(np.unique(data.trajectory)) == 1:
        count = len(data.t) - round(TEST_SHARE * len(data.t))
        if min(count, len(data.t) - count) < window:
            raise InputError(f"{file} has {len(data.t)} samples; expected some hundred, a fifth of them for the test")
        return select_samples(data, slice(0, count)), select_samples(data, slice(count, None)), ()
    data, labels = stated_test(data, test)
    motion = motion_numbers(data.q, data.trajectory) if test is None else None
    fitted, _, held = split(data, test=labels, validation_share=0.0, motion=motion)
    return fitted, held, ()


def spreads(data: Trajectories, *keys: str) -> np.ndarray:
    """Standard deviations of the columns; 1 for constant columns."""
    size = np.concatenate([spread(key, column(data, key)) for key in keys])
    return np.where(size > 0, size, 1.0)


def with_rates(data: Trajectories, noise: tuple[float, ...] | None) -> tuple[Trajectories, Noise]:
    """Adds velocities and accelerations from local polynomials if they were not measured, and estimates the noise.

    Raises:
        InputError: segments that are too short.
    """

    def limited(noise: Any, key: str) -> tuple[float, ...]:
        return tuple(np.maximum(noise, LEAST_NOISE * spreads(data, key)).tolist())

    smooth = smooth_locally(data)
    of_q = limited(smooth.noise if noise is None else noise, "q")
    if "qd" not in data.estimated:
        return data, Noise(of_q, limited(smooth_locally(data._replace(q=data.qd)).noise, "qd"))
    kept = select_samples(data, smooth.rows)
    return kept._replace(qd=smooth.data.qd, qdd=smooth.data.qdd), Noise(of_q)


def with_momenta(data: Trajectories) -> Trajectories:
    """Adds p, by default qd, and pd, by default the rate of p; `estimated` names those that are not measured."""
    if data.p is None:
        estimated = [own for key, own in (("qd", "p"), ("qdd", "pd")) if key in data.estimated]
        return data._replace(p=data.qd, pd=data.qdd, estimated=(*data.estimated, *estimated))
    if data.pd is None:
        pd = time_derivative(data.t, data.p, data.trajectory, name="pd")
        return data._replace(pd=pd, estimated=(*data.estimated, "pd"))
    return data


def weights_of(data: Trajectories, noise: tuple[float, ...] | None) -> dict[str, Any]:
    """`weights`, `free_of_noise` and `state_noise` of a `PhaseLog`; none if all segments are too short.

    Raises:
        InputError: noise is stated for segments that are too short.
    """
    d, parts = data.degrees_of_freedom, segments(data.t, data.trajectory)
    if max(map(len, parts)) < FEWEST:
        if noise is None:
            return {}
        raise InputError(f"--noise is for motions, but no segment without a gap has {FEWEST} samples; leave it out")
    order = np.random.default_rng(0).permutation(len(parts))
    count = np.searchsorted(np.cumsum([len(parts[index]) for index in order]), SURVEYED) + 1
    surveyed = select_samples(data, np.sort(np.concatenate([parts[index] for index in order[:count]])))
    keys = ("q", "p", "qd", "pd")
    size = spreads(data, *keys)
    smoothed = [smooth_locally(surveyed._replace(q=column(surveyed, key))) for key in keys]
    deviation, resolved = (np.concatenate([getattr(smooth, of) for smooth in smoothed]) for of in ("noise", "resolved"))
    measured = np.repeat([key not in data.estimated for key in keys], d)
    least = np.repeat([FREE_OF_NOISE, LEAST_RATE_NOISE], 2 * d) * size
    of_estimates = np.repeat([ANCHOR, np.inf], 2 * d) * size
    limited = np.where(measured, np.maximum(deviation, least), of_estimates)
    known = np.where(measured & resolved, deviation, 0.0)
    if noise is not None:
        stated = slice(0, max(d, len(noise)))
        limited[stated] = known[stated] = noise
    state, rate = limited[: 2 * d], limited[2 * d :]
    quiet = np.all(state <= FREE_OF_NOISE * size[: 2 * d])
    return {
        "weights": Weights(tuple(state.tolist()), tuple(rate.tolist()) if np.isfinite(rate).any() else None),
        "free_of_noise": bool(quiet and np.isfinite(rate).all()),
        "state_noise": known[: 2 * d],
    }
