"""Benefit of training a value against the worst disturbance, on plants that differ from the model, and its cost."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.optimal.plants import PLANTS, Returns, evaluate, starts
from dln_jax.control.optimal.problem import ControlProblem, hjb_policy
from dln_jax.control.optimal.residual import fit_hjb
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.control.optimal.worst_case import Bounds, worst_disturbance
from dln_jax.control.state_space import Law
from dln_jax.metrics.report import Row
from scripts.reports.case import Findings
from scripts.reports.rows import Row

SHARE = 0.15
"""Relative range of mass and length that the worst disturbance may use."""
FACTORS = {"model": (1.0, 1.0), "heavy_and_long": (1.15, 1.15), "far": (1.3, 1.15)}
"""Factors on mass and length of the evaluated plants; the last one lies outside the trained range."""


def rod(x: Array, u: Array, p: Array) -> Array:
    """dx/dt of the published pendulum with p = (mass, length)."""
    mass, length = p
    return jnp.stack([x[1], 3 / (mass * length**2) * (u[0] + mass * 9.81 * length / 2 * jnp.sin(x[0]))])


def pendulum(quick: bool) -> Findings:
    """Returns and successes of downward starts on altered pendulums, with and without the worst disturbance."""
    case, seeds, plant = "equation/robust", 1 if quick else 3, PLANTS["pendulum"]()
    x, rows = starts(plant, "down", 20 if quick else 100), []
    for name, share in (("trusting", 0.0), ("robust", SHARE)):
        laws = [trained(plant.problem, share, seed, quick) for seed in range(seeds)]
        for where, factors in FACTORS.items():
            found = [evaluate(plant._replace(problem=moved(plant.problem, factors)), law, x) for law in laws]
            rows += rows_of_returns(case, f"{name}_{where}", found)
    return Findings(rows)


def trained(problem: ControlProblem, share: float, seed: int, quick: bool) -> Law:
    """Trains a value against the worst disturbance of mass and length by a share, and returns its policy."""
    network = value_network(problem, widths=(8, 8) if quick else (16, 16), scale=30.0)
    of_parameters, of_samples = jax.random.split(jax.random.key(seed))
    fit = fit_hjb(
        problem, network.value_and_gradient, network.init(of_parameters), of_samples,
        samples=512 if quick else 2048, iterations=5 if quick else 15, rounds=6,
        disturbance=worst_disturbance(rod, [1.0, 1.0], Bounds(parameters=share)) if share else None,
    )  # fmt: skip
    return hjb_policy(lambda x: network.value_and_gradient(fit.parameters, x), problem)


def moved(problem: ControlProblem, factors: tuple[float, float]) -> ControlProblem:
    """The problem of a pendulum with mass and length multiplied by these factors."""
    p = jnp.asarray(factors)
    return problem._replace(
        drift=lambda x: rod(x, jnp.zeros(1), p), actuation=lambda x: jnp.array([[0.0], [3 / (p[0] * p[1] ** 2)]])
    )


def rows_of_returns(case: str, name: str, found: list[Returns]) -> list[Row]:
    """Median return and worst success share over the seeds."""
    return [
        Row(case, f"{name}_return_median", float(np.median([np.mean(run.returns) for run in found]))),
        Row(case, f"{name}_up_share_worst", float(min(np.mean(np.isfinite(run.settled)) for run in found))),
    ]
