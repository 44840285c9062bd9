"""Ways to prepare noisy encoder and torque data for the identification of a robot, compared.

All ways derive the equations of a linear fit, of the same tree with friction, from a noisy log. Errors are torque
errors along other motions with exact states and torques.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from dln_jax.compilation import quick_compilation
from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.weak_forms import Form, WeakFit, fit_form, fit_momentum
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import Tree
from dln_jax.models.rigid_tree import make_rigid_tree
from scripts.reports.rows import Row

TOLERANCES: dict[str, Any] = {"negligible": 1e-9, "rank_tolerance": 1e-8}
WAYS = (
    "raw-differences",
    "acceleration",
    "acceleration-torque-filtered",
    "acceleration-twice-the-cutoff",
    "momentum",
    "momentum-twice-the-cutoff",
    "energy",
)
"""Rates by differences; q filtered at the cut-off chosen from its spectra, with raw tau; tau filtered like q; and weak
forms, which need no accelerations."""


def encoder_rows(
    tree: Tree,
    exact: Trajectories,
    test: Trajectories,
    *,
    noise_q: float,
    noise_tau: Float[np.ndarray, " d"],
    parts: Sequence[Sequence[int]],
    velocity_scale: float = 0.01,
    ways: Sequence[str] = WAYS,
    say: Callable[[str], None] | None = None,
) -> list[Row]:
    """Median and worst nMSE, averaged over joints, of the ways over parts of the data with independent noise.

    Args:
        tree: tree with the robot's frames.
        exact: motions with exact q, qd, qdd and tau, to which noise is added.
        test: other exact motions.
        noise_q: standard deviation of the encoder noise, rad or m.
        noise_tau: standard deviations of the torque noise, N m or N.
        parts: groups of trajectories that are fitted together.
        velocity_scale: velocity scale of dry friction in the model.
        ways: names from `WAYS`.
        say: called with a line per error.
    """
    model = make_rigid_tree(tree, friction=True, velocity_scale=velocity_scale)
    with jax.enable_x64(True):

        def torques(parameters: Any, *states: Any) -> Any:
            return jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics)(*states)

        program = jax.jit(torques, compiler_options=quick_compilation())

        def error(parameters: Any) -> float:
            found = np.asarray(program(parameters, test.q, test.qd, test.qdd))
            return float(np.mean(np.mean((found - test.tau) ** 2, axis=0) / test.tau.var(axis=0)))

        errors: dict[str, list[float]] = {way: [] for way in ("exact-rates", *ways)}
        for seed, part in enumerate(parts):
            random = np.random.default_rng(seed)
            clean = select(exact, np.asarray(part))
            log = clean._replace(
                q=clean.q + noise_q * random.normal(size=clean.q.shape),
                tau=clean.tau + noise_tau * random.normal(size=clean.q.shape),
            )
            exact_rates = clean._replace(tau=log.tau)
            for way in errors:
                found = fit_linear(model, exact_rates, **TOLERANCES) if way == "exact-rates" else _fit(way, model, log)
                errors[way].append(error(found.parameters))
                if say is not None:
                    say(f"{way}, part {seed}: {errors[way][-1]:.3e}")
    expected = "mean over joints, on motions that were not fitted"
    return [
        Row(f"encoders/{way}", f"nmse_{name}", float(statistic(values)), expected=expected)
        for way, values in errors.items()
        for name, statistic in (("median", np.median), ("worst", np.max))
    ]


def _fit(way: str, model: Any, log: Trajectories) -> Any:
    if way == "raw-differences":
        rates = [np.concatenate([_differences(log, key, k) for k in np.unique(log.trajectory)]) for key in (1, 2)]
        return fit_linear(model, log._replace(qd=rates[0], qdd=rates[1]), **TOLERANCES)
    found = smooth(log, filter_torque=way.endswith("torque-filtered"))
    if way.endswith("twice-the-cutoff"):
        found = smooth(log, 2 * found.cutoff)
    if way.startswith("momentum"):
        return fit_momentum(model, found.data, **TOLERANCES)
    if way == "energy":
        return fit_energy(model, found.data, **TOLERANCES)
    return fit_linear(model, found.data, **TOLERANCES)


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
        q = sparse.q + noise * np.random.default_rng(0).normal(size=sparse.q.shape)
        log = sparse._replace(q=q)
        chosen = smooth(log)
        trim = 2.0 * chosen.trim

        def errors(cutoff: float, log: Trajectories = log, trim: float = trim) -> tuple[float, float]:
            found = smooth(log, cutoff, trim=trim)
            ends = round(trim * found.rate)
            inside = np.concatenate(
                [np.flatnonzero(log.trajectory == k)[ends : -ends or None] for k in np.unique(log.trajectory)]
            )
            true = log.qdd[inside]
            central = np.concatenate([_differences(found.data, 2, k) for k in np.unique(found.data.trajectory)])
            spline, differences = (
                float(np.mean(np.mean((qdd - true) ** 2, axis=0) / true.var(axis=0)))
                for qdd in (found.data.qdd, central)
            )
            return spline, differences

        grid = [errors(float(cutoff)) for cutoff in np.geomspace(1.0, 0.44 * chosen.rate, tried)]
        best, differences = np.min(grid, axis=0)
        case = f"cutoff/{noise:g}-rad-{chosen.rate:.4g}-hz"
        found = {"chosen_hz": chosen.cutoff, "qdd_error": errors(chosen.cutoff)[0], "qdd_error_best": float(best)}
        rows += [Row(case, name, value) for name, value in (found | {"qdd_error_central": float(differences)}).items()]
    return rows
