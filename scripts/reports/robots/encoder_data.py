"""Ways to prepare data for the identification of a robot: filters of encoder logs, and designed motions.

Filters: all ways derive the equations of a linear fit, of the same tree with friction, from a noisy log. Errors are
torque errors along other motions with exact states and torques.

Designed motions: these and random ones have the same period, samples, noise and least-squares fit. Errors of base
parameters are relative to their average standard deviation after random motions, so that units do not matter.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data import Trajectories, select
from dln_jax.data.encoders import smooth
from dln_jax.data.splits import every as kept
from dln_jax.identification.excitation import (
    CRITERIA,
    Design,
    MotionLimits,
    Task,
    best_design,
    make_optimiser,
    make_task,
    random_designs,
)
from dln_jax.identification.excitation.candidates import functions_at, states
from dln_jax.learning import fit_linear
from dln_jax.learning.weak_forms import fit_momentum
from dln_jax.models import make_rigid_tree
from scripts.reports.robots.arm import ENCODER_NOISE, TORQUE_NOISE, arm, error_of, logs, torque_of
from scripts.reports.robots.simulated_arms import panda
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


def excitation(*, joints: int = 7, designs: int = 6, draws: int = 60) -> Numbers:
    """Ratios of parameter errors after designed and random motions of the same series of a Panda, by criterion."""
    robot = panda(joints)
    model = make_rigid_tree(robot.tree, friction=True, velocity_scale=0.05)
    free = np.tile([-np.inf, np.inf], (joints, 1))
    limits = MotionLimits(robot.limits, robot.rates, robot.accelerations, free)
    task = make_task(model, model.init(jax.random.key(0)), limits, period=20.0, harmonics=5)
    drawn, starts = random_designs(task, designs), random_designs(task, designs, seed=1)
    numbers = {"excitation/random": {"condition_median": np.median([design.condition for design in drawn])}}
    for name, criterion in CRITERIA.items():
        optimise = make_optimiser(task, criterion)
        designed = [best_design(task, optimise, criterion, [start]) for start in starts]
        ratios = error_ratios(task, designed, drawn, seeds=draws)
        numbers[f"excitation/{name}"] = {
            "condition_median": np.median([design.condition for design in designed]),
            "error_worst": np.max(ratios),
            "error_median": np.median(ratios),
        }
    return numbers


def error_ratios(
    task: Task, designed: Sequence[Design], drawn: Sequence[Design], *, samples: int = 500, seeds: int = 50
) -> Float[np.ndarray, " seeds"]:
    """Errors after designed motions over those after random ones by seed; root mean squares over parameters.

    Compares least-squares errors pair by pair, with new noise for every seed. Values below one favour designed motions.

    Args:
        task: task whose `noise` holds the standard deviations.
        designed: motions optimised for a criterion.
        drawn: random motions within the same limits.
        samples: number of equally spaced samples in a motion's period.
        seeds: number of seeds for the noise.
    """
    errors = [solvers(task, designs, samples) for designs in (designed, drawn)]
    # Standard deviations of the parameters after random motions, averaged over the motions.
    scale = np.sqrt(np.mean([np.sum(inverse**2, axis=1) for inverse in errors[1]], axis=0))
    ratios = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed).normal(size=samples * task.noise.size)
        sizes = [np.sqrt(np.mean((inverses[seed % len(inverses)] @ noise / scale) ** 2)) for inverses in errors]
        ratios.append(sizes[0] / sizes[1])
    return np.array(ratios)


def solvers(task: Task, designs: Sequence[Design], samples: int) -> list[np.ndarray]:
    """Matrices [B, N d], one per motion, that map normalised noise to errors of parameters."""
    functions = functions_at(task, task.period * np.arange(samples) / samples)
    inverses = []
    for design in designs:
        at = list(map(np.asarray, states(functions, design.motion.offset, design.motion.coefficients)))
        rows = []
        for chunk in np.array_split(np.arange(samples), -(-samples // task.steps)):
            # The last chunk is padded, so that all chunks share one compiled program.
            filled = np.resize(chunk, task.steps)
            Phi = np.asarray(task.samples(*(array[filled] for array in at))[0])[: len(chunk)]
            rows.append(Phi[..., task.columns] / task.noise[:, None])
        W = np.concatenate(rows).reshape(samples * task.noise.size, -1)
        lengths = np.linalg.norm(W, axis=0)
        inverses.append(np.linalg.pinv(W / lengths) / lengths[:, None])
    return inverses
