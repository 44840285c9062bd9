"""Value functions of the published plants: by fitted value iteration, and from the Hamilton-Jacobi-Bellman equation.

The pendulum's value is compared with a grid solution over the whole box, those of the other plants with direct
optimisation from the starts of the evaluation.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.optimal.fitted import Iteration, fit_values
from dln_jax.control.optimal.grid import extrapolated, interpolated, lookahead, solve_on_grid
from dln_jax.control.optimal.problem import (
    ControlProblem,
    ValueAndGradient,
    circles,
    flow,
    from_field,
    hjb_policy,
    worst_disturbance,
)
from dln_jax.control.optimal.value_networks import fit_hjb, value_network
from dln_jax.control.regulators import lqr
from dln_jax.control.shooting import shoot
from dln_jax.control.state_space import Law
from dln_jax.control.trajectories import TrajectoryProblem
from dln_jax.types import Scalar
from scripts.reports.control.published import FITS, PLANTS, SCALE, WIDTHS, ValuePlant, evaluate, starts
from scripts.reports.run import Numbers

LEAST = 1e-2
"""States whose V is below this share of the largest are left out of relative errors."""
HORIZON = 2.5
"""Horizon of the direct optimisations, s."""
FACTORS = {"model": (1.0, 1.0), "heavy_and_long": (1.15, 1.15), "far": (1.3, 1.15)}
"""Factors on mass and length of the evaluated pendulums; the last lies beyond the trained range."""


def trained(
    plant: ValuePlant, fit: Iteration, widths: tuple[int, ...], seeds: int
) -> tuple[list[ValueAndGradient], list[float]]:
    """Values in float64 by fitted value iteration, one seed after the other, and training times, s."""
    network = value_network(plant.problem, widths=widths, scale=SCALE)
    fits = fit_values(plant.problem, network, range(seeds), numbers=fit)

    def in_double(parameters):
        parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), parameters)
        return lambda x: network.value_and_gradient(parameters, x)

    return [in_double(one.parameters) for one in fits], [one.train_seconds for one in fits]


def off_by(V, truth: np.ndarray) -> np.ndarray:
    """Relative errors of the states that count."""
    counted = truth > LEAST * truth.max()
    return np.abs(np.asarray(V)[counted] / truth[counted] - 1)


def compared(
    plant: ValuePlant, values: Sequence[ValueAndGradient], seconds: Sequence[float], x: np.ndarray, truth: np.ndarray
) -> dict[str, float]:
    """Returns by kind of starts, training times, and errors of V at states x [N, n] that count."""
    measured = {"train_seconds": np.median(seconds), "train_seconds_worst": max(seconds)}
    for where in ("down", "uniform"):
        at = starts(plant, where)
        runs = [evaluate(plant, hjb_policy(value, plant.problem), at) for value in values]
        means = [np.mean(run.returns) for run in runs]
        measured |= {
            f"{where}_return": np.median(means),
            f"{where}_return_worst_seed": np.min(means),
            f"{where}_up_share": min(np.mean(np.isfinite(run.settled)) for run in runs),
        }
    off = np.stack([off_by(jax.jit(jax.vmap(lambda x, value=value: value(x)[0]))(x), truth) for value in values])
    return {
        **measured,
        "median_relative_error": np.median(np.median(off, axis=1)),
        "median_relative_error_worst_seed": np.median(off, axis=1).max(),
        "p90_relative_error": np.quantile(off, 0.9),
        "worst_relative_error": off.max(),
    }


def pendulum(
    *,
    fit: Iteration = FITS["pendulum"],
    widths: tuple[int, ...] = WIDTHS,
    seeds: int = 3,
    points: tuple[int, ...] = (101, 201, 401),
) -> Numbers:
    """Compares the pendulum's value with a grid solution over the box, extrapolated from the two finest grids."""
    plant = PLANTS["pendulum"]()
    problem, angle = plant.problem, plant.problem.high[0]

    def on_grid(points, start=None):
        # No trajectory from the box exceeds 12 rad/s.
        return solve_on_grid(problem, points, low=[-angle, -12.0], high=[angle, 12.0], limit=plant.limit, start=start)

    coarse = on_grid(points[:-1])
    fine = on_grid(points[-1:], coarse)
    axes = np.linspace(-angle, angle, 80, endpoint=False), np.linspace(problem.low[1], problem.high[1], 81)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    truth, by_grid = np.asarray(extrapolated(coarse, fine, nodes)), lookahead(problem, fine, limit=plant.limit)
    numbers = {
        **compared(plant, *trained(plant, fit, widths, seeds), nodes, truth),
        "grid_converged": float(fine.converged),
        "grid_median_relative_extrapolation": np.median(off_by(interpolated(fine.grid, fine.V, nodes), truth)),
        "grid_down_return": np.mean(evaluate(plant, by_grid, starts(plant, "down")).returns),
    }
    return {"value/pendulum": numbers}


def regulator_value(problem: ControlProblem) -> Callable[[Array], Scalar]:
    """x -> V of the regulator at the goal, with discount: A - rho/2 in place of A."""
    goal = jnp.asarray(problem.goal)
    B, A = problem.actuation(goal), jax.jacfwd(problem.drift)(goal) - 0.5 * problem.discount * jnp.eye(len(goal))
    R = 0.5 * jax.hessian(problem.action_cost.cost)(jnp.zeros(B.shape[1]))
    S, angles = lqr(A, B, 0.5 * jax.hessian(problem.state_cost)(goal), R).S, circles(problem)

    def value(x):
        off = x - goal
        off = jnp.where(angles, off - 2 * jnp.pi * jnp.round(off / (2 * jnp.pi)), off)
        return off @ S @ off

    return value


def direct_values(
    problem: ControlProblem, x, laws: Sequence[Law], *, limit: float, dt: float, iterations: int = 60
) -> np.ndarray:
    """Lowest costs of direct optimisations from states x [N, n], which start from the controls of some policies.

    Errors of the trapezoidal rule and of constant controls are of order dt². After the horizon the cost is that of the
    regulator. The costs bound V from above.
    """
    move, tail, steps = flow(problem, dt), regulator_value(problem), round(HORIZON / dt)
    discount, half = math.exp(-problem.discount * dt), math.exp(-problem.discount * dt / 2)

    def cost(state, u):
        return state[-1] * dt * (problem.state_cost(state[:-1]) + half * problem.action_cost.cost(u))

    planned = TrajectoryProblem(
        lambda state, u: jnp.append(move(state[:-1], u)[0], state[-1] * discount),
        cost,
        lambda state: state[-1] * (tail(state[:-1]) + 0.5 * dt * problem.state_cost(state[:-1])),
        -limit,
        limit,
    )

    def best(x, law):
        def follow(x, _):
            u = law(x)
            return move(x, u)[0], u

        guess = jax.lax.scan(follow, x, length=steps)[1]
        start = jnp.append(x, 1.0)
        plan = shoot(planned, start, None, guess, method="single", iterations=iterations, tolerance=1e-7).plan
        return plan.cost - 0.5 * dt * problem.state_cost(x)

    # One guess after the other: a batch takes as long as its slowest member.
    costs = [jax.jit(jax.vmap(lambda x, law=law: best(x, law)))(jnp.asarray(x, float)) for law in laws]
    return np.min(np.stack(costs), axis=0)


def beside_shooting(
    *,
    plant: str,
    fit: Iteration | None = None,
    widths: tuple[int, ...] = WIDTHS,
    seeds: int = 3,
    starts_around: int = 100,
    iterations: int = 25,
) -> Numbers:
    """Compares a value with direct optimisation from starts all around the circle."""
    described, fit = PLANTS[plant](), fit or FITS[plant]
    values, seconds = trained(described, fit, widths, seeds)
    x, laws = starts(described, "uniform", starts_around), [hjb_policy(value, described.problem) for value in values]
    settings: Any = {"limit": described.limit, "dt": fit.dt, "iterations": iterations}
    truth = direct_values(described.problem, x, laws, **settings)
    return {f"value/{plant}": compared(described, values, seconds, x, truth)}


def rod(x: Array, u: Array, p: Array) -> Array:
    """dx/dt of the published pendulum with p = (mass, length)."""
    mass, length = p
    return jnp.stack([x[1], 3 / (mass * length**2) * (u[0] + mass * 9.81 * length / 2 * jnp.sin(x[0]))])


def equation(
    *,
    robust: bool = False,
    seeds: int = 3,
    width: int = 24,
    samples: int = 4096,
    iterations: int = 15,
    starts_down: int = 100,
) -> Numbers:
    """Returns of the published pendulum's policy from the equation alone, on the model and on altered pendulums.

    Robust values are trained against the worst change of mass and length by up to 15 %.
    """
    plant = PLANTS["pendulum"]()
    x, measured = starts(plant, "down", starts_down), {}
    network = value_network(plant.problem, widths=(width, width), scale=30.0)
    for name in ("trusting", "robust") if robust else ("",):
        worst = worst_disturbance(rod, [1.0, 1.0], parameters=0.15) if name == "robust" else None
        effort: Any = {"samples": samples, "iterations": iterations, "disturbance": worst}
        effort |= {"rounds": 6} if robust else {}
        laws = []
        for seed in range(seeds):
            of_parameters, of_samples = jax.random.split(jax.random.key(seed))
            start = network.init(of_parameters)
            fit = fit_hjb(plant.problem, network.value_and_gradient, start, of_samples, **effort)
            laws.append(hjb_policy(lambda x, fit=fit: network.value_and_gradient(fit.parameters, x), plant.problem))
        for where, factors in FACTORS.items() if robust else [("", FACTORS["model"])]:
            drift, actuation = from_field(partial(rod, p=jnp.asarray(factors)), 1)
            changed = plant._replace(problem=plant.problem._replace(drift=drift, actuation=actuation))
            runs = [evaluate(changed, law, x) for law in laws]
            returns, up = [np.mean(run.returns) for run in runs], [np.mean(np.isfinite(run.settled)) for run in runs]
            key = f"{name}_{where}_" if robust else "down_"
            measured |= {f"{key}return_median": np.median(returns), f"{key}return_worst": np.min(returns)}
            measured[f"{key}up_share_worst"] = min(up)
    return {f"equation/{'robust' if robust else 'pendulum'}": measured}
