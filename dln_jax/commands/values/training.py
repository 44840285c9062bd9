"""Trains value functions once per seed, and evaluates their laws."""

import itertools
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from dln_jax.control.optimal.fitted import Iteration, IterationState, ValueProgress, fit_values
from dln_jax.control.optimal.plants import Returns, ValuePlant, Where, evaluate, starts
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.residual import discounts_down_to, fit_hjb
from dln_jax.control.optimal.value_networks import ValueNetwork
from dln_jax.control.optimal.worst_case import Disturbance
from dln_jax.learning.engine.checkpoint import Checkpoint, restore, store
from dln_jax.learning.engine.problem import Progress
from dln_jax.metrics.verdict import Verdict
from dln_jax.runs.progress import progress
from dln_jax.zoo.value_functions import ValueRun

ROUNDS = 6
"""Number of resamplings at the problem's own discount."""
FAILED, WRONG = 0.9, 0.1
"""Share of the hanging starts that must end upright; a law below it is refused. Largest median error of a good V."""


class Trained(NamedTuple):
    """Value function of one seed."""

    parameters: Any
    validation: float
    train_seconds: float
    """Includes compilation."""


def by_iteration(
    problem: ControlProblem,
    network: ValueNetwork,
    numbers: Iteration,
    seeds: range,
    *,
    folder: Path,
    identity: Any,
    resume: bool,
    mesh: Mesh | None,
    disturbance: Disturbance | None,
) -> list[Trained]:
    """Fits value functions by fitted value iteration, one per seed; devices share the states.

    The folder gets a checkpoint of every seed; a stored one with the same identity, JSON values that decide
    the result, is resumed bit for bit.
    """
    before = 0

    def checkpoint(seed: int) -> Checkpoint:
        return Checkpoint(folder, {"settings": identity}, resume, f"checkpoint_seed_{seed}")

    def start(seed: int, state: IterationState) -> IterationState:
        nonlocal before
        before = numbers.iterations * (seed - seeds.start)
        if (stored := restore(checkpoint(seed), state[:3])) is None:
            return state
        tree, history = stored
        done = [ValueProgress(at.step, at.loss, at.validation, at.seconds) for at in history]
        return IterationState(*tree, history=done)

    def keep(seed: int, state: IterationState) -> None:
        history = [Progress(at.iteration, at.loss, at.validation, math.nan, at.seconds, "") for at in state.history]
        store(checkpoint(seed), state[:3], history)

    with progress(len(seeds) * numbers.iterations, "iterations") as show:
        fits = fit_values(
            problem,
            network,
            seeds,
            numbers=numbers,
            mesh=mesh,
            disturbance=disturbance,
            report=lambda at: show(before + at.iteration, f"cost and misfit {at.validation:.4g}"),
            restore=start,
            store=keep,
        )
    return [
        Trained(fit.parameters, min(at.validation for at in fit.history), fit.train_seconds + fit.compile_seconds)
        for fit in fits
    ]


def by_equation(
    problem: ControlProblem,
    network: ValueNetwork,
    iterations: int,
    seeds: range,
    *,
    mesh: Mesh | None,
    disturbance: Disturbance | None,
) -> list[Trained]:
    """Fits one value function per seed by the Hamilton-Jacobi-Bellman residual; devices of a mesh share the samples."""
    discounts, done = discounts_down_to(problem.discount), itertools.count(1)
    trained = []
    with progress(len(seeds) * (len(discounts) - 1 + ROUNDS), "iterations") as show:
        for seed in seeds:
            of_parameters, of_samples = jax.random.split(jax.random.key(seed))
            began = time.perf_counter()
            solution = fit_hjb(
                problem,
                network.value_and_gradient,
                network.init(of_parameters),
                of_samples,
                discounts=discounts,
                iterations=iterations,
                rounds=ROUNDS,
                mesh=mesh,
                disturbance=disturbance,
                report=lambda at: show(next(done), f"discount {at.discount:.3g}/s, residual {at.validation:.2e}"),
            )
            trained.append(Trained(solution.parameters, solution.validation, time.perf_counter() - began))
    return trained


def evaluation(run: ValueRun, count: int, altered: Mapping[str, ValuePlant]) -> dict[str, float]:
    """Returns of a value function's law from both kinds of starts, and the error of V; a failed start counts as NaN.

    Args:
        count: number of starts of each kind.
        altered: plants by name whose returns from near hanging are added.
    """
    numbers: dict[str, float] = {}
    where: Where
    for where in get_args(Where):
        returns = evaluate(run.plant, run.law, starts(run.plant, where, count))
        numbers |= summary(where, returns)
        numbers["value_error"] = value_error(run, returns)
    for name, plant in altered.items():
        numbers |= summary(name, evaluate(plant, run.law, starts(run.plant, "down", count)))
    return numbers


def value_error(run: ValueRun, runs: Returns) -> float:
    """Median error of V, relative to the discounted cost of following its law; NaN unless a start ends up.

    Starts that are not up at the end of the evaluation are left out: their cost is not known.
    """
    problem, dt = run.problem, run.plant.evaluation.held / run.plant.evaluation.rate
    costs = jax.vmap(jax.vmap(lambda x, u: problem.state_cost(x) + problem.action_cost.cost(u)))
    weights = dt * np.exp(-problem.discount * dt * np.arange(runs.u.shape[1]))
    V = jax.vmap(run.value_and_gradient)(jnp.asarray(runs.x[:, 0]))[0]
    off = np.abs(V / (costs(runs.x[:, :-1], runs.u) @ weights) - 1)[np.isfinite(runs.settled)]
    return float(np.median(off)) if len(off) else float("nan")


def summary(name: str, runs: Returns) -> dict[str, float]:
    """Numbers of the runs from one kind of starts."""
    return {
        f"{name}_return_mean": float(np.mean(runs.returns)),
        f"{name}_return_median": float(np.median(runs.returns)),
        f"{name}_return_worst": float(np.min(runs.returns)),
        f"{name}_up_share": float(np.mean(np.isfinite(runs.settled))),
        f"{name}_settled_median_seconds": float(np.median(runs.settled)),
        f"{name}_control_most": runs.largest,
    }


def verdict_of(numbers: dict[str, float], count: int) -> Verdict:
    """Verdict on a value function by the share of starts that its law brings upright, and the error of V."""
    down, anywhere = numbers["down_up_share"], numbers["uniform_up_share"]
    altered = [numbers[key] for key in ("heavy_weak_up_share", "light_strong_up_share") if key in numbers]
    error = numbers.get("value_error", 0.0)
    reason = f"{down:.0%} of {count} hanging starts end up, and {anywhere:.0%} of those anywhere at rest"
    if altered:
        reason += f"; {min(altered):.0%} of the hanging ones with the worst masses and motors"
    reason += f"; V differs from the cost of its law by {error:.1%} in the median"
    remedy = "train longer (--iterations) or with other --seeds, narrow the --box, or give a stronger motor"
    if not down >= FAILED:
        return Verdict("refused", reason, remedy)
    # A robust V is that of the worst case, and exceeds the cost on the model.
    sound = min(down, anywhere, *altered) == 1 and (error <= WRONG or bool(altered))
    return Verdict("good", reason) if sound else Verdict("doubtful", reason, remedy)
