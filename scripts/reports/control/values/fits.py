"""Fitted values of the published plants: training time, returns of their policies, and errors.

The pendulum's value is compared with a grid solution over the whole box, the cart-pole's with direct optimisation from
the starts of the evaluation. Seeds are trained one after the other, and their mean is evaluated as one more value.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.fitted import fit_values
from dln_jax.control.optimal.flow import flow
from dln_jax.control.optimal.grid import GridValue, extrapolated, lookahead, solve_on_grid
from dln_jax.control.optimal.grid_interpolation import interpolated
from dln_jax.control.optimal.plants import FITS, PLANTS, ValuePlant, ValueSettings, evaluate, starts
from dln_jax.control.optimal.problem import ValueAndGradient, hjb_policy
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.solvers.ending import reason
from scripts.reports.case import Findings
from scripts.reports.control.values.truths import direct_values, followed
from scripts.reports.rows import Row, expect

SEEDS = 3
PUBLISHED = {"pendulum": -30.96, "cart-pole": -25.05, "rotary-pendulum": None}
"""Mean returns of the published policies from downward starts, re-run; the draw of the starts hardly matters."""
TO_REACH = {"pendulum": -30.9, "cart-pole": -25.0, "rotary-pendulum": None}
"""Mean returns to reach."""
CLOSE = 1e-2
"""Bound on the median relative error of V over states."""
LEAST = 1e-2
"""States whose V is below this share of the largest are left out of relative errors, as their V is near zero."""
HORIZON, FOLLOWED = 2.5, 8.0
"""Horizon of the direct optimisations and of the policies' runs, s."""
GRIDS = (101, 201, 401)
EDGE = 12.0
"""Rate that no trajectory from the box exceeds, rad/s."""


class Trained(NamedTuple):
    """Value functions by seed, in float64."""

    values: list[ValueAndGradient]
    seconds: list[float]
    """Training times."""


def trained(plant: ValuePlant, fit: ValueSettings, seeds: int) -> Trained:
    """Trains values by fitted value iteration, one seed after the other."""
    network = value_network(plant.problem, widths=fit.widths, scale=fit.scale)
    fits = fit_values(plant.problem, network, range(seeds), numbers=fit.numbers)

    def in_double(parameters: Any) -> ValueAndGradient:
        parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), parameters)
        return lambda x: network.value_and_gradient(parameters, x)

    return Trained([in_double(fit.parameters) for fit in fits], [fit.train_seconds for fit in fits])


def mean_value(values: Sequence[ValueAndGradient]) -> ValueAndGradient:
    """The mean of several values and gradients."""

    def mean(x: Array) -> tuple[Array, Array]:
        levels, slopes = zip(*(value(x) for value in values), strict=True)
        return jnp.mean(jnp.stack(levels)), jnp.mean(jnp.stack(slopes), axis=0)

    return mean


def pendulum(quick: bool) -> Findings:
    """Compares the pendulum's value with a grid solution over the box."""
    plant, fit, seeds = PLANTS["pendulum"](), FITS["pendulum"], 1 if quick else SEEDS
    if quick:
        fit = fit._replace(widths=(24, 24), numbers=fit.numbers._replace(iterations=4, starts=128, seconds=1.0))
    points = (41, 81) if quick else GRIDS
    coarse = _on_grid(plant, points[:-1])
    fine = _on_grid(plant, points[-1:], coarse)
    nodes = states_of_box(plant, 80)
    truth, before = np.asarray(extrapolated(coarse, fine, nodes)), np.asarray(interpolated(fine.grid, fine.V, nodes))
    counted, ridge = truth > LEAST * truth.max(), beside_ridge(fine, nodes, plant.limit)
    training = trained(plant, fit, seeds)
    of_all = [np.asarray(_V(value)(nodes.reshape(-1, 2))).reshape(truth.shape) for value in training.values]
    case, by_grid = "value/pendulum", lookahead(plant.problem, fine, limit=plant.limit)
    rows = [
        *_returns(case, plant, training),
        *_errors(case, of_all, truth, counted),
        *(
            Row(case, f"beside_ridge_{quantity}", of(_relative(of_all, truth)[:, counted & ridge]))
            for quantity, of in (("median_relative_error", np.median), ("worst_relative_error", np.max))
        ),
        expect(case, "grid_converged", reason(fine.ending), float(fine.converged), 1.0, at_least=True),
        Row(case, "grid_median_relative_extrapolation", float(np.median(_relative([before], truth)[:, counted]))),
        Row(case, "grid_down_return", float(np.mean(evaluate(plant, by_grid, starts(plant, "down")).returns))),
    ]
    return Findings(rows)


def beside_shooting(name: str, quick: bool) -> Findings:
    """Compares a value with direct optimisation from starts all around the circle."""
    plant, fit, seeds = PLANTS[name](), FITS[name], 1 if quick else SEEDS
    if quick:
        numbers = fit.numbers._replace(iterations=3, starts=128, seconds=0.5, steps=50)
        fit = fit._replace(widths=(24, 24), numbers=numbers)
    training = trained(plant, fit, seeds)
    x = starts(plant, "uniform", 4 if quick else 100)
    truth = _direct(plant, training.values, x, dt=fit.numbers.dt, iterations=5 if quick else 25)
    of_all = [np.asarray(_V(value)(x)) for value in training.values]
    case = f"value/{name}"
    rows = [*_returns(case, plant, training), *_errors(case, of_all, truth, truth > LEAST * truth.max())]
    costs = [policy_costs(plant, value, x, dt=fit.numbers.dt) for value in training.values]
    rows.append(
        Row(case, "policy_cost_over_shooting", float(np.median([np.mean(cost) for cost in costs]) / truth.mean()))
    )
    return Findings(rows)


def policy_costs(plant: ValuePlant, value: ValueAndGradient, x: np.ndarray, *, dt: float) -> Float[np.ndarray, " N"]:
    """Discounted costs of a value's policy from states x [N, n] over `FOLLOWED` s, by the Runge-Kutta method."""
    problem, law = plant.problem, _law(plant, value)
    step, discount = flow(problem, dt), np.exp(-problem.discount * dt)

    def sample(carry: tuple[Array, Array, Array], _: Any) -> tuple[tuple[Array, Array, Array], None]:
        x, total, weight = carry
        after, cost = step(x, law(x))
        return (after, total + weight * cost, weight * discount), None

    def one(x: Array) -> Array:
        return jax.lax.scan(sample, (x, jnp.zeros(()), jnp.ones(())), length=round(FOLLOWED / dt))[0][1]

    return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(x, float)))


def states_of_box(plant: ValuePlant, count: int) -> Float[np.ndarray, "A B 2"]:
    """A grid over the box of two states; the first is an angle."""
    low, high = plant.problem.low, plant.problem.high
    axes = [np.linspace(low[0], high[0], count, endpoint=False), np.linspace(low[1], high[1], count + 1)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def beside_ridge(solution: GridValue, nodes: np.ndarray, limit: float, *, distance: float = 0.1) -> np.ndarray:
    """Whether the best control changes by half its limit within `distance` in rad, or 2.5 times that in rad/s."""
    near = [nodes + distance * np.array([i, 2.5 * j]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    controls = np.stack([np.asarray(interpolated(solution.grid, solution.u, points)) for points in near])
    return np.ptp(controls, axis=0) > 0.5 * limit


def _on_grid(plant: ValuePlant, points: Sequence[int], start: GridValue | None = None) -> GridValue:
    angle = plant.problem.high[0]
    # The action cost is finite up to the limit.
    return solve_on_grid(plant.problem, points, low=[-angle, -EDGE], high=[angle, EDGE], limit=plant.limit, start=start)


def _direct(
    plant: ValuePlant, values: Sequence[ValueAndGradient], x: np.ndarray, *, dt: float, iterations: int
) -> np.ndarray:
    """Lowest cost of direct optimisations that start from the controls of the values' policies."""
    steps = round(HORIZON / dt)
    guesses = np.stack([followed(plant.problem, _law(plant, value), x, dt=dt, steps=steps) for value in values])
    return np.min(direct_values(plant.problem, x, guesses, limit=plant.limit, dt=dt, iterations=iterations), axis=0)


def _returns(case: str, plant: ValuePlant, training: Trained) -> list[Row]:
    """Returns by kind of starts: over the seeds, and of the mean value."""
    x = np.concatenate([starts(plant, "down"), starts(plant, "uniform")])
    half = len(x) // 2
    runs = [evaluate(plant, _law(plant, value), x) for value in training.values]
    together = evaluate(plant, _law(plant, mean_value(training.values)), x)
    rows = []
    for where, part in (("down", slice(half)), ("uniform", slice(half, None))):
        means = [float(np.mean(run.returns[part])) for run in runs]
        up = float(min(np.mean(np.isfinite(run.settled[part])) for run in runs))
        words = f"mean of {half} starts, the median of {len(means)} seeds"
        down = where == "down"
        name = case.split("/")[1]
        bound, reference = (TO_REACH[name], PUBLISHED[name]) if down else (None, None)
        median = float(np.median(means))
        rows += [
            Row(case, f"{where}_return", median, "1", reference, bound, at_least=True, expected=words),
            expect(case, f"{where}_up_share", "of the worst seed", up, 1.0, at_least=True),
            Row(case, f"{where}_return_worst_seed", float(np.min(means))),
            Row(case, f"{where}_return_of_mean_value", float(np.mean(together.returns[part]))),
        ]
    seconds = training.seconds
    return [
        *rows,
        Row(case, "train_seconds", float(np.median(seconds)), "s"),
        Row(case, "train_seconds_worst", max(seconds), "s"),
    ]


def _errors(case: str, of_all: Sequence[np.ndarray], truth: np.ndarray, counted: np.ndarray) -> list[Row]:
    """Errors relative to the truth, over the states that count."""
    off = _relative(of_all, truth)[:, counted]
    medians = np.median(off, axis=1)
    together = _relative([np.mean(of_all, axis=0)], truth)[:, counted]
    words = f"of V over states, the median of {len(of_all)} seeds"
    return [
        expect(case, "median_relative_error", words, np.median(medians), CLOSE),
        Row(case, "median_relative_error_worst_seed", float(np.max(medians))),
        Row(case, "p90_relative_error", float(np.quantile(off, 0.9))),
        Row(case, "worst_relative_error", float(np.max(off))),
        Row(case, "median_relative_error_of_mean_value", float(np.median(together))),
    ]


def _relative(of_all: Sequence[np.ndarray], truth: np.ndarray) -> np.ndarray:
    return np.abs(np.stack(of_all) - truth) / np.maximum(truth, LEAST * truth.max())


def _V(value: ValueAndGradient) -> Callable[[np.ndarray], Array]:
    return jax.jit(jax.vmap(lambda x: value(x)[0]))


def _law(plant: ValuePlant, value: ValueAndGradient) -> Callable[[Array], Array]:
    return hjb_policy(value, plant.problem)
