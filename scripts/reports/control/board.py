"""The acrobot and the pendubot of a public board (Wiebe et al. 2022, "RealAIGym"): plant, score and two controllers.

Ten seconds of the classical Runge-Kutta method at 500 Hz, from hanging at rest. Numbers of both controllers are chosen
by the score, since the plant is known.
"""

import itertools
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    ClosedLoopRun,
    Controller,
    Hardware,
    Linearisation,
    Plan,
    TrajectoryProblem,
    error,
    field_of,
    holding_controls,
    linearise,
    lqr,
    optimise,
    partial_linearisation,
    parts_of,
    regulated,
    sampled_lqr,
    simulate,
    switched,
    value,
)
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import CLASSICAL, runge_kutta
from dln_jax.scenes.pendulums import Links, two_link_pendulum
from dln_jax.scenes.scene import Scene
from scripts.reports.run import Numbers

RATE, SECONDS, LIMIT = 500.0, 10.0, 6.0
"""Sampling rate, Hz, length of a run, s, and torque limit, N m."""
HEIGHT = 0.9
"""Height of the tip above the shoulder that counts as up, relative to the stretched length."""
GOAL = np.array([np.pi, 0.0, 0.0, 0.0])
SIZES = {"time": 20.0, "energy": 60.0, "torque_cost": 20.0, "smoothness": 0.1, "velocity_cost": 400.0}
"""Sizes of the criteria in the score."""
EVERY = 10
"""Samples of the board per step of a plan."""
STATE_COST = np.diag([10.0, 10.0, 1.0, 1.0])
"""State cost of the regulators after a plan."""
Motor = Literal["elbow", "shoulder"]


class Law(NamedTuple):
    """Numbers of a swing-up by energy."""

    gains: Any
    """k1, k2, k3 [3]."""
    level: Any
    """Level of the regulator's value at which it takes over."""
    share: Any
    """Weight of the new torque against that of the sample before."""
    most: Any
    """Largest torque of the law, N m."""


def plant(motor: Motor) -> tuple[Scene, Array]:
    """The scene and its actuation matrix [2, 1]."""
    scene = two_link_pendulum(motor)
    return scene, jnp.asarray(scene.needs.actuation)


def closed_loop(motor: Motor, controller: Controller) -> ClosedLoopRun:
    """A run with the board's settings, not compiled."""
    scene, B = plant(motor)
    field, lab = field_of(dynamics(scene.energies), B), Hardware(-LIMIT, LIMIT)
    return simulate(field, controller, np.zeros(4), seconds=SECONDS, rate=RATE, controls=1, hardware=lab)


def at_goal(motor: Motor) -> Linearisation:
    """The linearisation of the plant about its goal."""
    scene, B = plant(motor)
    system = dynamics(scene.closed_form)
    return linearise(field_of(system, B), GOAL, holding_controls(system, GOAL[:2], B))


def criteria(motor: Motor, run: ClosedLoopRun) -> dict[str, float]:
    """The criteria of a run in SI units; smaller is better. The time is infinite if the tip does not stay up."""
    driven = {"shoulder": 0, "elbow": 1}[motor]
    q, qd = np.split(np.asarray(run.x), 2, axis=1)
    u = np.asarray(run.u)[:, 0]
    inner, outer = Links().lengths
    up = -inner * np.cos(q[:, 0]) - outer * np.cos(q.sum(axis=1)) > HEIGHT * (inner + outer)
    stays = len(up) - np.argmin(up[::-1]) if not up.all() else 0
    return {
        "time": stays / RATE if up[-1] else np.inf,
        "energy": float(np.sum(np.abs(np.diff(q[:, driven]) * u))),
        "torque_cost": float(np.sum(u**2) / RATE),
        "smoothness": float(np.std(np.diff(u))),
        "velocity_cost": float(np.sum(qd**2) / RATE),
    }


def score(numbers: Mapping[str, float]) -> float:
    """Score of version 2, from 0 to 1: 1 - mean of tanh(pi criterion / size); 0 if a criterion is not finite."""
    if not np.isfinite(list(numbers.values())).all():
        return 0.0
    return 1 - float(np.mean([np.tanh(np.pi * numbers[name] / size) for name, size in SIZES.items()]))


def judged(motor: Motor, controller: Controller) -> dict[str, float]:
    """Score and criteria of a controller."""
    numbers = criteria(motor, jax.jit(lambda: closed_loop(motor, controller))())
    return {"score": score(numbers), **numbers}


def drawn_laws(count: int) -> Law:
    """Random laws; the numbers are log-uniform over their plausible decades, except the torque limit (uniform)."""
    random = np.random.default_rng(0)
    return Law(
        jnp.asarray(10 ** random.uniform(-0.3, 1.3, (count, 3))),
        jnp.asarray(10 ** random.uniform(0.0, 1.5, count)),
        jnp.asarray(10 ** random.uniform(-1.5, 0.0, count)),
        jnp.asarray(random.uniform(0.25, 1.0, count) * LIMIT),
    )


def pumping(motor: Motor) -> Callable[..., Array]:
    """(x, gains, energy beyond E*) -> torque [1] by Spong's law: a = -k1 (q - goal) - k2 qd + k3 qd_p (E - E*)."""
    scene, B = plant(motor)
    system, parts = dynamics(scene.closed_form), parts_of(B)
    forces, (active,), (passive,) = partial_linearisation(system, parts), parts.active, parts.passive
    wanted = system.energy(GOAL[:2], np.zeros(2))

    def far(x, gains, beyond=0.0):
        (k1, k2, k3), q, qd = gains, x[:2], x[2:]
        off = system.energy(q, qd) - wanted - beyond
        a = -k1 * (q[active] - GOAL[active]) - k2 * qd[active] + k3 * qd[passive] * off
        # At rest the full torque starts the motion.
        return jnp.where(jnp.max(jnp.abs(qd)) <= 1e-3, LIMIT, forces(q, qd, a[None]))

    return far


def by_energy(motor: Motor) -> Callable[[Law], Controller]:
    """A law's numbers -> its controller: low-passed energy law, and a regulator where its value is low."""
    joints, far, at = plant(motor)[0].needs.joints, pumping(motor), at_goal(motor)
    regulator = lqr(at.A, at.B, np.diag([0.97, 0.93, 0.39, 0.26]), np.array([[0.11]]))
    near, cost = regulated(regulator, GOAL, at.u, joints), value(regulator, GOAL, joints)

    def controller(numbers):
        law = switched(lambda x: far(x, numbers.gains), near, cost, numbers.level)

        def act(tau, t, y):
            tau = tau + numbers.share * (jnp.clip(law(y), -numbers.most, numbers.most) - tau)
            return tau, tau

        return Controller(jnp.zeros(1), act)

    return controller


def runs_of_laws(motor: Motor, draws: int) -> list[dict[str, float]]:
    """Criteria of random laws."""
    controller = by_energy(motor)
    runs = jax.jit(jax.vmap(lambda numbers: closed_loop(motor, controller(numbers))))(drawn_laws(draws))
    return [criteria(motor, jax.tree.map(lambda leaf, k=k: leaf[k], runs)) for k in range(draws)]


def best_law(motor: Motor, draws: int) -> Law:
    """The random law with the best score."""
    place = int(np.argmax([score(numbers) for numbers in runs_of_laws(motor, draws)]))
    return jax.tree.map(lambda leaf: leaf[place], drawn_laws(draws))


def energy_laws(*, motor: Motor, draws: int = 1000) -> Numbers:
    """The best score of random laws, and the share that succeeds."""
    results = runs_of_laws(motor, draws)
    scores = np.array([score(numbers) for numbers in results])
    succeed = {"score": scores.max(), "share_of_laws_that_succeed": np.mean(scores > 0)}
    return {f"board/{plant(motor)[0].name}/energy": {**succeed, **results[int(np.argmax(scores))]}}


def plan_of(motor: Motor, guess: Array, slope_weight: float) -> Plan:
    """Optimises (q, qd, tau), with the torque's slope as control [N, 1], so that the cost can favour smooth torques."""
    scene, B = plant(motor)
    field, dt = field_of(dynamics(scene.energies), B), 1.0 / RATE

    def sample(state, slope):
        # As on the board, the torque is constant over a sample.
        step = runge_kutta(CLASSICAL, lambda t, x: field(x, state[4:]))
        return jnp.concatenate([step(0.0, state[:4], dt), state[4:] + dt * slope])

    def step(state, slope):
        return jax.lax.fori_loop(0, EVERY, lambda _, state: sample(state, slope), state)

    def cost(state, slope):
        tau, over = state[4], jnp.maximum(jnp.abs(state[4]) - 0.9 * LIMIT, 0.0)
        running = 0.3 * tau**2 + 0.01 * jnp.sum(state[2:4] ** 2) + slope_weight * slope[0] ** 2 + 100.0 * over**2
        return EVERY * dt * running

    def final_cost(state):
        return jnp.array([300.0, 300.0, 30.0, 30.0, 3.0]) @ (state - jnp.append(jnp.asarray(GOAL), 0.0)) ** 2

    return optimise(TrajectoryProblem(step, cost, final_cost), np.zeros(5), guess, iterations=300)


def follower(motor: Motor, plan: Plan) -> Controller:
    """Feedback about the plan, followed by a regulator about the goal."""
    at, joints, dt = at_goal(motor), plant(motor)[0].needs.joints, 1.0 / RATE
    holding = sampled_lqr(at.A, at.B, STATE_COST, np.eye(1), dt)

    def act(memory, t, y):
        number, tau, slope = memory
        index = jnp.minimum(number // EVERY, len(plan.u) - 1)
        corrected = plan.u[index, 0] + plan.K[index, 0] @ (jnp.append(y, tau) - plan.x[index])
        slope = jnp.where(number % EVERY == 0, corrected, slope)
        u = jnp.where(number >= EVERY * len(plan.u), -holding.K[0] @ error(y, jnp.asarray(GOAL), joints), tau)
        return (number + 1, tau + dt * slope, slope), u[None]

    return Controller((jnp.asarray(0), jnp.asarray(0.0), jnp.asarray(0.0)), act)


def best_plan(
    motor: Motor, horizons: tuple[float, ...] = (1.6,), slope_weights: tuple[float, ...] = (1e-3,), guesses: int = 1
) -> Plan:
    """The plan with the best score over horizons, s, weights of the torque's slope and random guesses."""
    best, measured = -1.0, None
    for weight, seconds in itertools.product(slope_weights, horizons):
        solve = jax.jit(lambda guess, weight=weight: plan_of(motor, guess, weight))
        for seed in range(guesses):
            plan = solve(10.0 * np.random.default_rng(seed).normal(size=(round(seconds * RATE / EVERY), 1)))
            reached = judged(motor, follower(motor, plan))["score"]
            if reached > best:
                best, measured = reached, plan
    assert measured is not None
    return measured


def planned(
    *,
    motor: Motor,
    horizons: tuple[float, ...] = (1.5, 1.6, 1.8, 2.0),
    slope_weights: tuple[float, ...] = (1e-3, 3e-3),
    guesses: int = 3,
) -> Numbers:
    """The best score of plans."""
    plan = best_plan(motor, horizons, slope_weights, guesses)
    return {f"board/{plant(motor)[0].name}/planned": judged(motor, follower(motor, plan))}
