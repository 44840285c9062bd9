"""A planned swing-up of the acrobot or the pendubot: trajectory optimisation, then a regulator that holds the goal.

The torque is a state of the plan and its slope the control, so that the cost can favour smooth torques. The plan's
linear-quadratic gains give the feedback. Several horizons and weights are tried and the run with the best score is
kept: the plant is known, and the score is the objective.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    Controller,
    Plan,
    TrajectoryProblem,
    error,
    field_of,
    optimise,
    sampled_lqr,
)
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import CLASSICAL, runge_kutta
from scripts.reports.case import Findings
from scripts.reports.control.board import (
    GOAL,
    LIMIT,
    RATE,
    Motor,
    at_goal,
    criteria,
    plant,
    play,
    rows_of_criteria,
    score,
)
from scripts.reports.rows import Row

EVERY = 10
"""Samples of the board per step of the plan."""
END = np.array([300.0, 300.0, 30.0, 30.0, 3.0])
"""Weights of the squared error of the last state, including the torque."""
BEYOND = 100.0
"""Weight of the squared excess of a torque over nine tenths of its limit."""


class Weights(NamedTuple):
    """Weights of the integrals in the cost."""

    torque: float = 0.3
    velocity: float = 0.01
    slope: float = 1e-3
    """Weight of the torque's slope."""


HORIZONS, WEIGHTS = (1.5, 1.6, 1.8, 2.0), (Weights(), Weights(torque=0.3, velocity=0.01, slope=3e-3))
PLANNED = {"acrobot": 0.66, "pendubot": None}
"""Score to reach; the best acrobot on the board has 0.655."""


def problem(motor: Motor, weights: Weights) -> TrajectoryProblem:
    """The optimal control problem on (q, qd, tau), in steps of `EVERY` samples with a constant slope of the torque."""
    scene, B = plant(motor)
    field, dt = field_of(dynamics(scene.energies), B), 1.0 / RATE

    def sample(state: Array, slope: Array) -> Array:
        # As on the board, the torque is constant over a sample.
        step = runge_kutta(CLASSICAL, lambda t, x: field(x, state[4:]))
        return jnp.concatenate([step(0.0, state[:4], dt), state[4:] + dt * slope])

    def step(state: Array, slope: Array) -> Array:
        return jax.lax.fori_loop(0, EVERY, lambda _, state: sample(state, slope), state)

    def cost(state: Array, slope: Array) -> Array:
        tau, over = state[4], jnp.maximum(jnp.abs(state[4]) - 0.9 * LIMIT, 0.0)
        speed = jnp.sum(state[2:4] ** 2)
        running = weights.torque * tau**2 + weights.velocity * speed + weights.slope * slope[0] ** 2 + BEYOND * over**2
        return EVERY * dt * running

    def final_cost(state: Array) -> Array:
        return jnp.asarray(END) @ (state - jnp.append(jnp.asarray(GOAL), 0.0)) ** 2

    return TrajectoryProblem(step, cost, final_cost)


def planned(motor: Motor, weights: Weights, guess: Array, *, iterations: int = 300) -> Plan:
    """Optimises the trajectory from a guess of the torque's slopes [N, 1], whose length sets the horizon."""
    return optimise(problem(motor, weights), np.zeros(5), guess, iterations=iterations)


def follower(motor: Motor, weights: Weights, plan: Plan) -> Controller:
    """Feedback about the plan, followed by a regulator about the goal."""
    scene, dt = plant(motor)[0], 1.0 / RATE
    at, joints = at_goal(motor, dynamics(scene.energies)), scene.needs.joints
    holding = sampled_lqr(at.A, at.B, np.diag([10.0, 10.0, 1.0, 1.0]), np.eye(1), dt)
    last = EVERY * len(plan.u)

    def act(memory: tuple[Array, Array, Array], t: Array, y: Array) -> tuple[tuple[Array, Array, Array], Array]:
        number, tau, slope = memory
        index = jnp.minimum(number // EVERY, len(plan.u) - 1)
        corrected = plan.u[index, 0] + plan.K[index, 0] @ (jnp.append(y, tau) - plan.x[index])
        slope = jnp.where(number % EVERY == 0, corrected, slope)
        u = jnp.where(number >= last, -holding.K[0] @ error(y, jnp.asarray(GOAL), joints), tau)
        return (number + 1, tau + dt * slope, slope), u[None]

    return Controller((jnp.asarray(0), jnp.asarray(0.0), jnp.asarray(0.0)), act)


def search(
    motor: Motor, horizons: Sequence[float], weights: Sequence[Weights], guesses: int = 3
) -> tuple[float, Plan, Weights]:
    """The best score over horizons, weights and random guesses, with its plan and weights."""
    results = []
    for option, seconds in itertools.product(weights, horizons):
        solve = jax.jit(lambda guess, option=option: planned(motor, option, guess))
        for seed in range(guesses):
            shape = (round(seconds * RATE / EVERY), 1)
            plan = solve(jnp.asarray(10.0 * np.random.default_rng(seed).normal(size=shape)))
            results.append((score(criteria(motor, play(motor, follower(motor, option, plan)))), plan, option))
    return max(results, key=lambda result: result[0])


def by_plan(motor: Motor, quick: bool) -> Findings:
    """The best score of plans over some horizons, weights and guesses."""
    horizons, weights = ((1.6,), WEIGHTS[:1]) if quick else (HORIZONS, WEIGHTS)
    best, plan, weighted = search(motor, horizons, weights, guesses=1 if quick else 3)
    name = plant(motor)[0].name
    case, words = f"board/{name}/planned", "version 2 of the board's"
    row = Row(case, "score", best, expected=words, bound=PLANNED[name], at_least=True)
    return Findings([row, *rows_of_criteria(case, criteria(motor, play(motor, follower(motor, weighted, plan))))])
