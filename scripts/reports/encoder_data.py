"""Ways to prepare noisy encoder and torque data for the identification of a robot, compared.

All ways derive the equations of a linear fit, of the same tree with friction, from a noisy log. Errors are torque
errors along other motions with exact states and torques.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.weak_forms import Form, WeakFit, fit_form, fit_momentum
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.models.model import Model
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.types import Vector
from scripts.reports.case import Findings, spread
from scripts.reports.robots.arm import ENCODER_NOISE, TORQUE_NOISE, arm, error_of, logs, torque_of
from scripts.reports.robots.known_kinematics import FULL, QUICK
from scripts.reports.rows import Row

TOLERANCES: dict[str, Any] = {"negligible": 1e-9, "rank_tolerance": 1e-8}
WAYS = (
    "exact-rates",
    "raw-differences",
    "acceleration",
    "acceleration-torque-filtered",
    "acceleration-twice-the-cutoff",
    "momentum",
    "momentum-twice-the-cutoff",
    "energy",
)
"""Exact rates; rates by differences; q filtered at the cut-off chosen from its spectra, with raw tau; tau filtered like
q; and weak forms, which need no accelerations."""
PARTS = 3
"""Number of logs with equal numbers of motions and independent noise."""


def encoders(quick: bool) -> Findings:
    """Median and worst nMSE over logs by way, with viscous friction and with MuJoCo's dry friction."""
    rows, effort = [], QUICK if quick else FULL
    expected = "mean over joints, on motions that were not fitted"
    for name, robot in (("viscous", arm(coulomb=False)), ("coulomb", arm(coulomb=True))):
        random = np.random.default_rng(0)
        exact, test = (logs(robot, random, count) for count in (effort.motions, effort.unseen))
        model = make_rigid_tree(robot.tree, friction=True, velocity_scale=0.01)
        errors: dict[str, list[float]] = {way: [] for way in WAYS}
        for seed, part in enumerate(np.array_split(np.arange(effort.motions), 1 if quick else PARTS)):
            random = np.random.default_rng(seed)
            clean = select(exact, part)
            log = clean._replace(
                q=clean.q + ENCODER_NOISE * random.normal(size=clean.q.shape),
                tau=clean.tau + TORQUE_NOISE * random.normal(size=clean.q.shape),
            )
            for way in WAYS:
                parameters = _fit(way, model, log, clean).parameters
                errors[way].append(error_of(torque_of(model, parameters), test).mean())
        for way, values in errors.items():
            rows += spread(f"encoders/{name}/{way}", "nmse", values, expected=expected)
    return Findings(rows)


def _fit(way: str, model: Any, log: Trajectories, clean: Trajectories) -> Any:
    if way == "exact-rates":
        return fit_linear(model, clean._replace(tau=log.tau), **TOLERANCES)
    if way == "raw-differences":
        rates = [np.concatenate([_differences(log, times, k) for k in np.unique(log.trajectory)]) for times in (1, 2)]
        return fit_linear(model, log._replace(qd=rates[0], qdd=rates[1]), **TOLERANCES)
    filtered = smooth(log, filter_torque=way.endswith("torque-filtered"))
    if way.endswith("twice-the-cutoff"):
        filtered = smooth(log, 2 * filtered.cutoff)
    fit = {"momentum": fit_momentum, "energy": fit_energy}.get(way.split("-")[0], fit_linear)
    return fit(model, filtered.data, **TOLERANCES)


def fit_energy(model: Model, data: Trajectories, **tolerances: Any) -> WeakFit:
    """Fits the energies of windows: one equation for all joints, cheaper than momenta but with less information.

    The energy E = T + V has a weak form with the power of motors and of friction (Gautier and Khalil 1988):

        qdᵀ tau = dE/dt + qdᵀ dD/dqd
    """
    form = Form(
        energy_and_loss,
        lambda qd, tau: np.sum(qd * tau, axis=1, keepdims=True),
        lambda qd, noise: np.linalg.norm(qd * noise, axis=1, keepdims=True),
    )
    return fit_form(form, model, data, **tolerances)


def energy_and_loss(plant: Dynamics, q: Vector, qd: Vector) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
    """E = T + V and the power lost to friction, of one state: qdᵀ tau = dE/dt + loss."""
    return plant.energy(q, qd)[None], (qd @ plant.friction(q, qd))[None]


def _differences(log: Trajectories, times: int, trajectory: int) -> np.ndarray:
    here = log.trajectory == trajectory
    values = log.q[here]
    for _ in range(times):
        values = np.gradient(values, log.t[here], axis=0, edge_order=2)
    return values


def cutoff_rows(exact: Trajectories, *, noises: Sequence[float], every: int = 1, tried: int = 30) -> list[Row]:
    """Errors of accelerations at the chosen cut-off, at the best cut-off of a grid, and by central differences.

    Args:
        exact: motions with exact q and qdd at equal steps.
        noises: standard deviations of encoders, rad or m.
        every: stride of the samples kept in the log.
        tried: number of cut-offs in the grid.
    """
    rows = []
    kept = np.concatenate([np.flatnonzero(exact.trajectory == k)[::every] for k in np.unique(exact.trajectory)])
    sparse = exact._replace(**{key: getattr(exact, key)[kept] for key in ("t", "q", "qd", "qdd", "tau", "trajectory")})
    for noise in noises:
        log = sparse._replace(q=sparse.q + noise * np.random.default_rng(0).normal(size=sparse.q.shape))
        chosen = smooth(log)

        def errors(cutoff: float, log: Trajectories = log, trim: float = 2.0 * chosen.trim) -> list[float]:
            filtered = smooth(log, cutoff, trim=trim)
            data, ends, runs = filtered.data, round(trim * filtered.rate), np.unique(log.trajectory)
            inner = np.concatenate([np.flatnonzero(log.trajectory == k)[ends : -ends or None] for k in runs])
            true = log.qdd[inner]
            central = np.concatenate([_differences(data, 2, k) for k in np.unique(data.trajectory)])
            return [
                float(np.mean(np.mean((qdd - true) ** 2, axis=0) / true.var(axis=0))) for qdd in (data.qdd, central)
            ]

        best, differences = np.min([errors(float(f)) for f in np.geomspace(1.0, 0.44 * chosen.rate, tried)], axis=0)
        numbers = {"chosen_hz": chosen.cutoff, "qdd_error": errors(chosen.cutoff)[0]}
        numbers |= {"qdd_error_best": float(best), "qdd_error_central": float(differences)}
        case = f"cutoff/{noise:g}-rad-{chosen.rate:.4g}-hz"
        rows += [Row(case, name, value) for name, value in numbers.items()]
    return rows
