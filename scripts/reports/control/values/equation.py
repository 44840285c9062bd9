"""Values from the Hamilton-Jacobi-Bellman equation, on problems with a known solution and on a published plant.

On a line, dx/dt = x + u with the cost (x² + u²)/2 has V = x² (1 + √2)/2. With limited controls and no discount the
equation contains only the slope: its root is computed and integrated. A linear plant with quadratic costs has the
solution of the Riccati equation.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control import field_of, linearise, lqr
from dln_jax.control.optimal.action_costs import limited_atan, quadratic
from dln_jax.control.optimal.plants import PLANTS, evaluate, starts
from dln_jax.control.optimal.problem import ControlProblem, hjb_policy
from dln_jax.control.optimal.residual import discounts_down_to, fit_hjb
from dln_jax.control.optimal.value_networks import ValueNetwork, value_network
from dln_jax.control.optimal.worst_case import Bounds, worst_disturbance
from dln_jax.control.state_space import Law
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import flexible_cart_pole
from scripts.reports.case import Findings
from scripts.reports.control.values.fits import PUBLISHED
from scripts.reports.rows import Row, expect, largest, unit_of

EXACT = 1e-8
LIMIT, WEIGHT = 5.5, 2 * 5.5 / np.pi
"""Limit and weight of the limited control, whose cost is ½ u² near zero."""
LINE = ControlProblem(
    lambda x: x, lambda x: jnp.ones((1, 1)), lambda x: 0.5 * x @ x, quadratic(1.0), 0.0, [-5.0], [5.0], (), [0.0]
)
THETA = (1 + np.sqrt(2)) / 2, (1 - np.sqrt(2)) / 2
"""theta in V = theta x²: the cost to go, and the equation's other solution."""
SHARE = 0.15
"""Relative range of mass and length that the worst disturbance may use."""
FACTORS = {"model": (1.0, 1.0), "heavy_and_long": (1.15, 1.15), "far": (1.3, 1.15)}
"""Factors on mass and length of the evaluated plants; the last one lies beyond the trained range."""


def fitted(problem: ControlProblem, network: ValueNetwork, seed: int, **options: Any) -> tuple[Any, float]:
    """Fits a network to the equation; returns the fit and its time, s. Options as for `fit_hjb`."""
    of_parameters, of_samples = jax.random.split(jax.random.key(seed))
    began = time.perf_counter()
    start = network.init(of_parameters)
    fit = fit_hjb(problem, network.value_and_gradient, start, of_samples, **options)
    return fit, time.perf_counter() - began


def line(quick: bool) -> Findings:
    """The quadratic value by a form and by a network, with and without continuation, and limited controls."""
    case = "equation/line"
    rows = []
    form = lambda theta, x: (theta * x[0] ** 2, 2 * theta * x)  # noqa: E731
    for name, discounts, aim in (
        ("continued", discounts_down_to(0.0, first=100.0), THETA[0]),
        ("not_continued", [0.0], THETA[1]),
    ):
        fit = fit_hjb(LINE, form, jnp.asarray(-3.0), jax.random.key(0), discounts=discounts, samples=64, validation=64)
        words = "the cost to go, from a start that is nearer to the other solution"
        error = abs(float(fit.parameters) / aim - 1)
        rows.append(
            expect(case, f"{name}_theta_relative_error", words, error, EXACT, reference=aim)
            if name == "continued"
            else Row(case, f"{name}_theta", float(fit.parameters), reference=aim)
        )
    x = np.linspace(0.1, 5, 20 if quick else 50)[:, None]
    limited = LINE._replace(action_cost=limited_atan(LIMIT, WEIGHT))
    for name, problem, truth in (
        ("quadratic", LINE, THETA[0] * x[:, 0] ** 2),
        ("limited", limited, np.array([limited_value(*point) for point in x])),
    ):
        numbers = by_network(problem, x, truth, widths=(8,) if quick else (8, 8), seeds=1 if quick else 3)
        rows += [Row(case, f"network_{name}_{key}", value, unit_of(key)) for key, value in numbers.items()]
    return Findings(rows)


def limited_value(x: float) -> float:
    """V of the limited control at x > 0, by the root of g*(-s) = x²/2 + x s and quadrature."""
    from scipy.integrate import quad
    from scipy.optimize import brentq

    def slope(x: float) -> float:
        def left(s: float) -> float:
            gain = LIMIT / np.pi * (2 * s * np.arctan(s / WEIGHT) - WEIGHT * np.log1p((s / WEIGHT) ** 2))
            return gain - x * s - x**2 / 2

        # The other root belongs to controls that drive away from the goal.
        return float(brentq(left, WEIGHT * np.tan(np.pi * x / (2 * LIMIT)), 1e4, xtol=1e-13))  # type: ignore[arg-type]

    return quad(slope, 0, x, epsabs=1e-12, epsrel=1e-12)[0]


def linear(quick: bool) -> Findings:
    """The linearised flexible cart-pole (six states): a quadratic form and a network against the Riccati equation."""
    case, scene = "equation/flexible-cart-pole", flexible_cart_pole()
    field = field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation))
    at = linearise(field, np.zeros(6), np.zeros(1))
    A, B = at.A, at.B
    Q, R = np.diag([10.0, 10.0, 10.0, 0.1, 0.1, 0.1]), np.array([[0.1]])
    high = np.array([0.5, 0.1, 0.5, 2.0, 1.0, 5.0])
    problem = ControlProblem(
        lambda x: A @ x, lambda x: B, lambda x: x @ Q @ x, quadratic(2 * R), 0.0, -high, high, (),
        np.zeros(6),
    )  # fmt: skip
    x = high * np.random.default_rng(0).uniform(-1, 1, (200, 6))
    truth = np.einsum("ni,ij,nj->n", x, np.asarray(lqr(A, B, Q, R).S), x)
    exact = by_network(problem, x, truth, widths=(), seeds=1, samples=256, iterations=60)
    words = "a quadratic form has the regulator's value"
    rows = [expect(case, "form_worst_relative_error", words, exact["worst_relative_error"], EXACT)]
    if not quick:
        numbers = by_network(problem, x, truth, widths=(8,), seeds=1, samples=2048)
        rows += [Row(case, f"network_{key}", value, unit_of(key)) for key, value in numbers.items()]
    return Findings(rows)


def by_network(
    problem: ControlProblem,
    x: Float[np.ndarray, "N n"],
    truth: Float[np.ndarray, " N"],
    *,
    widths: Sequence[int],
    seeds: int,
    samples: int = 512,
    iterations: int = 30,
) -> dict[str, float]:
    """Relative errors of V, median and worst over states and seeds, and the training time."""
    errors, seconds = [], []
    for seed in range(seeds):
        network = value_network(problem, widths=widths, scale=float(np.max(truth)), floor=1e-3 if widths else 0.0)
        fit, spent = fitted(problem, network, seed, samples=samples, validation=samples, iterations=iterations)
        seconds.append(spent)
        V = jax.vmap(lambda x, fit=fit, network=network: network.value_and_gradient(fit.parameters, x)[0])(x)
        errors.append(np.abs(V / truth - 1))
    return {
        "median_relative_error": float(np.median(errors)),
        "worst_relative_error": largest(errors),
        "train_seconds": float(np.median(seconds)),
    }


def published(quick: bool) -> Findings:
    """The published pendulum, whose value has a ridge, by the equation alone: returns of the policy over seeds."""
    plant, case = PLANTS["pendulum"](), "equation/pendulum"
    widths, samples, iterations, seeds = ((8, 8), 512, 5, 1) if quick else ((24, 24), 4096, 15, 3)
    network = value_network(plant.problem, widths=widths, scale=30.0)
    returns, up, left, seconds = [], [], [], []
    for seed in range(seeds):
        fit, spent = fitted(plant.problem, network, seed, samples=samples, iterations=iterations)
        seconds.append(spent)
        left.append(fit.validation)
        law = hjb_policy(lambda x, fit=fit: network.value_and_gradient(fit.parameters, x), plant.problem)
        runs = evaluate(plant, law, starts(plant, "down"))
        returns.append(float(np.mean(runs.returns)))
        up.append(float(np.mean(np.isfinite(runs.settled))))
    reference = PUBLISHED["pendulum"]
    return Findings(
        [
            Row(case, "down_return_median", float(np.median(returns)), reference=reference),
            Row(case, "down_return_worst", float(np.min(returns)), reference=reference),
            Row(case, "up_share_worst", float(np.min(up))),
            Row(case, "equation_left_median", float(np.median(left))),
            Row(case, "train_seconds_median", float(np.median(seconds)), "s"),
        ]
    )


def rod(x: Array, u: Array, p: Array) -> Array:
    """dx/dt of the published pendulum with p = (mass, length)."""
    mass, length = p
    return jnp.stack([x[1], 3 / (mass * length**2) * (u[0] + mass * 9.81 * length / 2 * jnp.sin(x[0]))])


def robust(quick: bool) -> Findings:
    """Returns and successes of downward starts on altered pendulums, with and without the worst disturbance."""
    case, seeds, plant = "equation/robust", 1 if quick else 3, PLANTS["pendulum"]()
    x, rows = starts(plant, "down", 20 if quick else 100), []
    for name, share in (("trusting", 0.0), ("robust", SHARE)):
        laws = [robust_law(plant.problem, share, seed, quick) for seed in range(seeds)]
        for where, factors in FACTORS.items():
            runs = [evaluate(plant._replace(problem=moved(plant.problem, factors)), law, x) for law in laws]
            returns, up = [np.mean(run.returns) for run in runs], [np.mean(np.isfinite(run.settled)) for run in runs]
            rows.append(Row(case, f"{name}_{where}_return_median", float(np.median(returns))))
            rows.append(Row(case, f"{name}_{where}_up_share_worst", float(min(up))))
    return Findings(rows)


def robust_law(problem: ControlProblem, share: float, seed: int, quick: bool) -> Law:
    """Trains a value against the worst disturbance of mass and length by a share, and returns its policy."""
    network = value_network(problem, widths=(8, 8) if quick else (16, 16), scale=30.0)
    disturbance = worst_disturbance(rod, [1.0, 1.0], Bounds(parameters=share)) if share else None
    effort = {"samples": 512, "iterations": 5} if quick else {"samples": 2048, "iterations": 15}
    fit, _ = fitted(problem, network, seed, rounds=6, disturbance=disturbance, **effort)
    return hjb_policy(lambda x: network.value_and_gradient(fit.parameters, x), problem)


def moved(problem: ControlProblem, factors: tuple[float, float]) -> ControlProblem:
    """The problem of a pendulum with mass and length multiplied by these factors."""
    p = jnp.asarray(factors)
    return problem._replace(
        drift=lambda x: rod(x, jnp.zeros(1), p), actuation=lambda x: jnp.array([[0.0], [3 / (p[0] * p[1] ** 2)]])
    )


CASES: dict[str, Callable[[bool], Findings]] = {
    "equation/line": line,
    "equation/flexible-cart-pole": linear,
    "equation/pendulum": published,
    "equation/robust": robust,
}
"""Cases of the control report."""
