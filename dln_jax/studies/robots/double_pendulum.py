"""A real double pendulum with motors: nine recordings of `design_A.0` (DFKI, BSD 3-Clause), some held out.

A planar chain of ten parameters (two moments of inertia, their coupling, the second motor's armature, two weights,
viscous and dry friction of both joints) is fitted in three ways, from q, t and tau:

    least squares      torques of filtered motions, as engineers do it; q and tau filtered alike
    low-passed         the same, but what is filtered is the regressor of less filtered motions, and tau with it
    motions            the windows of `learning.measured_motions`, through an integrator with the torques, which are off
                       by as much as the low-passed equations are

Filtered coordinates give accelerations that are too small; dry friction is no function of them at all. Low-passing both
sides of the equation, or not to differentiate at all, leaves that bias out.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from dln_jax.data.schema import Trajectories, from_arrays, load
from dln_jax.data.splits import select
from dln_jax.learning import measured_motions
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.linear import fit_linear, linearised
from dln_jax.learning.measured_motions import Noise, cut_measured_windows
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.measured_predictions import cut_stretches, predict_measured, valid_times
from dln_jax.models.model import Model, Parameters
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.solvers import least_squares
from dln_jax.studies.report import Row
from dln_jax.types import Needs

CUTOFF, FINE = 6.0, 30.0
"""Hz: the one at which the least squares of filtered motions predict held-out recordings best, of 2, 3, 4, 6, 8, 10, 12
and 25; and one that keeps the motion."""
BASE, RATE = 500.0, 100.0
"""Hz: of the recordings, nearly, and of what is fitted."""
TRIM = 0.3
"""s, that are left out at both ends of a recording."""
WINDOW = 11
"""Samples of a window and of a prediction's fitted start: 0.1 s."""
NOISE = 2e-3
"""rad, of q: time stamps are off by about a millisecond."""
HORIZON, EVERY = 2.2, 0.5
"""s: predicted stretches, and from one start to the next."""
STEPS = 8
"""Of Gauss-Newton."""
VELOCITY_SCALE = 0.1
"""rad/s, of dry friction."""
HELD_OUT = (("02", "11"), ("00", "12"), ("04", "13"), ("01", "05"), ("03", "13"))
"""Recordings of each split."""
WAYS = ("least-squares", "low-passed", "motions")


class Logs(NamedTuple):
    """The recordings at equal steps, twice."""

    coarse: Trajectories
    """Filtered at `CUTOFF`."""
    fine: Trajectories
    """Filtered at `FINE`."""


def ten_parameters() -> Model:
    """Of two links with motors."""
    needs = Needs(joints=("revolute", "revolute"), friction=True)
    return make_planar_chain(needs, armature=True, velocity_scale=VELOCITY_SCALE)


def rows(path: Path, held_out: Sequence[Sequence[str]] = HELD_OUT) -> list[Row]:
    """Torque errors and valid prediction times of each way on recordings held out: median and worst of the splits.

    The bounds of the others are the least squares' numbers. `torque_nmse` is that of torques which filtered motions
    take, `torque_nmse_low_passed` that of torques of less filtered motions, low-passed beside the measured ones.
    """
    logs = read(path)
    found = [split_numbers(logs, labels) for labels in held_out]
    listed = []
    for way in WAYS:
        for quantity, (unit, longer) in QUANTITIES.items():
            values, rival = ([each[name][quantity] for each in found] for name in (way, WAYS[0]))
            worst = np.min if longer else np.max
            for suffix, of in (("", np.median), ("_worst", worst)):
                bound = float(of(rival)) if way != WAYS[0] else None
                row = Row(f"double-pendulum/{way}", quantity + suffix, float(of(values)), unit, None, bound, longer)
                listed.append(row)
    return listed


QUANTITIES = {
    "torque_nmse": ("1", False),
    "torque_nmse_low_passed": ("1", False),
    "vpt_seconds": ("s", True),
    "vpt_mean_seconds": ("s", True),
}
"""Their unit, and whether more is better."""


def split_numbers(logs: Logs, held_out: Sequence[str]) -> dict[str, dict[str, float]]:
    """By way and quantity, for the recordings with these labels."""
    index = {label: place for place, label in enumerate(logs.fine.label)}
    test = [index[label] for label in held_out]
    rest = [each for each in np.unique(logs.fine.trajectory) if each not in test]
    model = ten_parameters()
    fits = fitted(model, Logs(*(select(each, rest) for each in logs)))
    held = Logs(*(select(each, test) for each in logs))
    return {way: judged(model, parameters, held, logs) for way, parameters in fits.items()}


def fitted(model: Model, logs: Logs) -> dict[str, Parameters]:
    """The parameters by each of the `WAYS`; one recording selects the iteration of the last."""
    low_passed, off = fit_low_passed(model, logs)
    present = np.unique(logs.fine.trajectory)
    chosen = present[len(present) // 2]
    windows = [
        cut_measured_windows(select(logs.fine, part), WINDOW) for part in ([*present[present != chosen]], [chosen])
    ]
    task = measured_motions.problem(model, low_passed, *windows, noise=Noise(NOISE, tau=off))
    training = fit(task, GaussNewton(STEPS, steps_per_dispatch=STEPS // 2))
    return dict(zip(WAYS, (fit_linear(model, logs.coarse).parameters, low_passed, training.parameters), strict=True))


def fit_low_passed(model: Model, logs: Logs) -> tuple[Parameters, tuple[float, ...]]:
    """Least squares of low-passed equations, each joint's in units of its torque's deviation; and what they are off."""
    zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), jax.eval_shape(model.init, jax.random.key(0)))
    scale = logs.coarse.tau.std(axis=0)
    columns, torques = [], []
    for index in np.unique(logs.fine.trajectory):
        data = select(logs.fine, [index])
        state = (jnp.asarray(each) for each in (data.q, data.qd, data.qdd))
        Phi = np.asarray(jax.vmap(partial(linearised, model, zero))(*state)[0])
        columns.append((_low_pass(Phi, CUTOFF, RATE) / scale[:, None]).reshape(-1, Phi.shape[-1]))
        torques.append((_low_pass(data.tau, CUTOFF, RATE) / scale).ravel())
    A, b = np.concatenate(columns), np.concatenate(torques)
    found = least_squares.solve(A, b)
    off = scale * np.sqrt(np.mean((A @ found.x - b).reshape(-1, len(scale)) ** 2, axis=0))
    return ravel_pytree(zero)[1](jnp.asarray(found.x)), tuple(off.tolist())


def judged(model: Model, parameters: Parameters, held: Logs, every: Logs) -> dict[str, float]:
    """Errors of torques in the variance of all recordings, mean of both joints; and valid prediction times."""
    torque = jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))
    variance = every.coarse.tau.var(axis=0)

    def error(data: Trajectories, filtered: Any) -> float:
        off = np.asarray(torque(data.q, data.qd, data.qdd)) - data.tau
        parts = [filtered(off[data.trajectory == index]) for index in np.unique(data.trajectory)]
        return float(np.mean(np.concatenate(parts) ** 2 / variance))

    stretches = cut_stretches(held.fine, round(HORIZON * RATE), every=round(EVERY * RATE))
    predicted = predict_measured(model, parameters, stretches, fitted=WINDOW)
    times = valid_times(stretches, predicted, fitted=WINDOW, variance=every.fine.q.var(axis=0))
    numbers = (
        error(held.coarse, lambda off: off),
        error(held.fine, lambda off: _low_pass(off, CUTOFF, RATE)),
        float(np.median(times)),
        float(np.mean(times)),
    )
    return dict(zip(QUANTITIES, numbers, strict=True))


def read(path: Path) -> Logs:
    """The recordings of the file, resampled to equal steps, filtered, and without their ends."""
    data = load(path)
    return Logs(_filtered(data, CUTOFF), _filtered(data, FINE))


def _filtered(data: Trajectories, cutoff: float) -> Trajectories:
    found: dict[str, list[np.ndarray]] = {key: [] for key in ("t", "q", "qd", "qdd", "tau", "trajectory")}
    ends = round(TRIM * BASE)
    for index in np.unique(data.trajectory):
        own = data.trajectory == index
        t = np.arange(data.t[own][0], data.t[own][-1], 1 / BASE)
        q, tau = (
            _low_pass(np.stack([np.interp(t, data.t[own], column) for column in values[own].T], axis=1), cutoff, BASE)
            for values in (data.q, data.tau)
        )
        qd = np.gradient(q, 1 / BASE, axis=0)
        arrays = (t - t[ends], q, qd, np.gradient(qd, 1 / BASE, axis=0), tau, np.full(len(t), index))
        for key, array in zip(found, arrays, strict=True):
            found[key].append(array[ends : -ends : round(BASE / RATE)])
    return from_arrays({key: np.concatenate(parts) for key, parts in found.items()} | {"label": data.label})


def _low_pass(values: np.ndarray, cutoff: float, rate: float) -> np.ndarray:
    """Butterworth's filter of fourth order, forwards and backwards."""
    from scipy.signal import butter, sosfiltfilt

    return sosfiltfilt(butter(4, cutoff, fs=rate, output="sos"), values, axis=0)
