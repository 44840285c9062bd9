"""Ways to prepare noisy encoder and torque data for the identification of a robot, compared.

All ways derive the equations of a linear fit, of the same tree with friction, from a noisy log. Errors are torque
errors along other motions with exact states and torques.
"""

from typing import Any

import numpy as np

from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import every as kept
from dln_jax.data.splits import select
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.weak_forms import fit_momentum
from dln_jax.models.rigid_tree import make_rigid_tree
from scripts.reports.robots.arm import ENCODER_NOISE, TORQUE_NOISE, arm, error_of, logs, torque_of
from scripts.reports.run import Numbers

TOLERANCES: dict[str, Any] = {"negligible": 1e-9, "rank_tolerance": 1e-8}


def encoders(*, motions: int = 15, unseen: int = 6, parts: int = 3) -> Numbers:
    """Median and worst nMSE over disjoint parts of the motions, with viscous friction and with MuJoCo's dry friction.

    Ways: exact rates; rates by differences; q filtered at the cut-off chosen from its spectra, with raw tau; tau
    filtered like q; and momenta of windows, which need no accelerations.
    """
    numbers = {}
    for name, robot in (("viscous", arm(coulomb=False)), ("coulomb", arm(coulomb=True))):
        random = np.random.default_rng(0)
        exact, test = (logs(robot, random, count) for count in (motions, unseen))
        model = make_rigid_tree(robot.tree, friction=True, velocity_scale=0.01)
        errors: dict[str, list[float]] = {}
        for seed, part in enumerate(np.array_split(np.arange(motions), parts)):
            random = np.random.default_rng(seed)
            clean = select(exact, part)
            log = clean._replace(
                q=clean.q + ENCODER_NOISE * random.normal(size=clean.q.shape),
                tau=clean.tau + TORQUE_NOISE * random.normal(size=clean.q.shape),
            )
            filtered = smooth(log)
            twice = smooth(log, 2 * filtered.cutoff)
            qd, qdd = differences(log, 1), differences(log, 2)
            fits = {
                "exact-rates": (fit_linear, clean._replace(tau=log.tau)),
                "raw-differences": (fit_linear, log._replace(qd=qd, qdd=qdd)),
                "acceleration": (fit_linear, filtered.data),
                "acceleration-torque-filtered": (fit_linear, smooth(log, filter_torque=True).data),
                "acceleration-twice-the-cutoff": (fit_linear, twice.data),
                "momentum": (fit_momentum, filtered.data),
                "momentum-twice-the-cutoff": (fit_momentum, twice.data),
            }
            for way, (fit, data) in fits.items():
                torque = torque_of(model, fit(model, data, **TOLERANCES).parameters)
                errors.setdefault(way, []).append(float(error_of(torque, test).mean()))
        for way, values in errors.items():
            numbers[f"encoders/{name}/{way}"] = {"nmse_median": np.median(values), "nmse_worst": np.max(values)}
    return numbers


def differences(log: Trajectories, times: int) -> np.ndarray:
    """Rates of q by differences."""
    parts = []
    for trajectory in np.unique(log.trajectory):
        here = log.trajectory == trajectory
        values = log.q[here]
        for _ in range(times):
            values = np.gradient(values, log.t[here], axis=0, edge_order=2)
        parts.append(values)
    return np.concatenate(parts)


def cutoffs(*, motions: int = 2, strides: tuple[int, ...] = (1, 4), tried: int = 30) -> Numbers:
    """Errors of accelerations at the chosen cut-off, at the best cut-off of a grid, and by central differences.

    Mean squared errors over the variance of the accelerations, at encoder noise of 1e-5, 1e-4 and 1e-3 rad.
    """
    exact = logs(arm(coulomb=False), np.random.default_rng(0), motions)
    numbers = {}
    for stride in strides:
        sparse = kept(exact, stride)
        for noise in (1e-5, 1e-4, 1e-3):
            log = sparse._replace(q=sparse.q + noise * np.random.default_rng(0).normal(size=sparse.q.shape))
            chosen = smooth(log)
            trim = 2.0 * chosen.trim

            def errors(cutoff: float, log: Trajectories = log, trim: float = trim) -> list[float]:
                filtered = smooth(log, cutoff, trim=trim)
                data, ends = filtered.data, round(trim * filtered.rate)
                inner = [np.flatnonzero(log.trajectory == k)[ends : -ends or None] for k in np.unique(log.trajectory)]
                true = log.qdd[np.concatenate(inner)]
                both = data.qdd, differences(data, 2)
                return [float(np.mean(np.mean((qdd - true) ** 2, axis=0) / true.var(axis=0))) for qdd in both]

            grid = np.geomspace(1.0, 0.44 * chosen.rate, tried)
            best, central = np.min([errors(float(cutoff)) for cutoff in grid], axis=0)
            numbers[f"cutoff/{noise:g}-rad-{chosen.rate:.4g}-hz"] = {
                "chosen_hz": chosen.cutoff,
                "qdd_error": errors(chosen.cutoff)[0],
                "qdd_error_best": best,
                "qdd_error_central": central,
            }
    return numbers
