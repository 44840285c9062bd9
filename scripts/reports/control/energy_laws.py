"""Swing-ups by energy: the acrobot and the pendubot on the board, and other plants from many starts.

The law on the board is Spong's with the total energy: the driven joint accelerates by

    a = -k1 (q_a - goal) - k2 qd_a + k3 qd_p (E - E*)

The torque is limited below the motor's limit and low-passed, so that it is smooth. A linear-quadratic regulator takes
over where its value function is small. The law's numbers are drawn at random and the ones with the best score are kept:
the plant is known, and the score is the objective.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    ClosedLoopRun,
    Controller,
    EnergyGains,
    Hardware,
    energy_shaping,
    field_of,
    holding_controls,
    linearise,
    lqr,
    partial_linearisation,
    parts_of,
    regulated,
    simulate,
    switched,
    value,
    with_differences,
)
from dln_jax.control.closed_loop import Outcomes, hanging_starts, outcomes
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.scene import Scene
from scripts.reports.case import Findings
from scripts.reports.control.board import GOAL, LIMIT, RATE, SECONDS, Criteria, Motor, criteria, plant, score
from scripts.reports.rows import Row

STATE_COST, CONTROL_COST = np.diag([0.97, 0.93, 0.39, 0.26]), np.array([[0.11]])
"""Cost matrices of the regulator, from the board's own controller."""
STILL = 1e-3
"""Largest joint rate, rad/s, that counts as rest; the full torque is then applied to start the motion."""
DRAWS = 1000
UNITS = ("s", "J", "N² m² s", "N m", "rad²/s")
"""Units of the criteria."""
TO_REACH = 0.40
"""Score that the acrobot is to reach."""


class Law(NamedTuple):
    """Numbers of a swing-up law on the board."""

    gains: Array
    """k1, k2, k3 [3]."""
    level: Array
    """Level of the regulator's value function at which it takes over."""
    share: Array
    """Low-pass coefficient: weight of the new torque against that of the previous sample."""
    most: Array
    """Largest torque of the law, N m."""


def drawn_laws(count: int, seed: int = 0) -> Law:
    """Random laws; the numbers are log-uniform over their plausible decades, except the torque limit (uniform)."""
    random = np.random.default_rng(seed)
    return Law(
        jnp.asarray(10 ** random.uniform(-0.3, 1.3, (count, 3))),
        jnp.asarray(10 ** random.uniform(0.0, 1.5, count)),
        jnp.asarray(10 ** random.uniform(-1.5, 0.0, count)),
        jnp.asarray(random.uniform(0.25, 1.0, count) * LIMIT),
    )


def pumping(motor: Motor) -> Callable[..., Array]:
    """(x, gains k1, k2, k3, energy above the goal's, J) -> torque [1] of the swing-up by energy."""
    scene, B = plant(motor)
    system, parts = dynamics(scene.closed_form), parts_of(B)
    forces, (active,), (passive,) = partial_linearisation(system, parts), parts.active, parts.passive
    wanted = system.energy(GOAL[:2], np.zeros(2))

    def far(x: Array, gains: Array, beyond: Any = 0.0) -> Array:
        (k1, k2, k3), q, qd = gains, x[:2], x[2:]
        error = system.energy(q, qd) - wanted - beyond
        a = -k1 * (q[active] - GOAL[active]) - k2 * qd[active] + k3 * qd[passive] * error
        return jnp.where(jnp.max(jnp.abs(qd)) <= STILL, LIMIT, forces(q, qd, a[None]))

    return far


def controllers_by_energy(motor: Motor) -> Callable[[Law], Controller]:
    """A law's numbers -> its controller of x = (q, qd)."""
    scene, B = plant(motor)
    system, joints, far = dynamics(scene.energies), scene.needs.joints, pumping(motor)
    at = linearise(field_of(system, B), GOAL, holding_controls(system, GOAL[:2], B))
    regulator = lqr(at.A, at.B, STATE_COST, CONTROL_COST)
    near, cost = regulated(regulator, GOAL, at.u, joints), value(regulator, GOAL, joints)

    def controller(numbers: Law) -> Controller:
        law = switched(lambda x: far(x, numbers.gains), near, cost, numbers.level)

        def act(tau: Array, t: Array, y: Array) -> tuple[Array, Array]:
            tau = tau + numbers.share * (jnp.clip(law(y), -numbers.most, numbers.most) - tau)
            return tau, tau

        return Controller(jnp.zeros(1), act)

    return controller


def runs_by_energy(motor: Motor) -> Callable[[Law], ClosedLoopRun]:
    """A law's numbers -> its closed loop on the board."""
    scene, B = plant(motor)
    field, controller = field_of(dynamics(scene.energies), B), controllers_by_energy(motor)
    lab, settings = Hardware(-LIMIT, LIMIT), {"seconds": SECONDS, "rate": RATE, "controls": 1}
    return lambda numbers: simulate(field, controller(numbers), np.zeros(4), hardware=lab, **settings)


def runs_of_drawn_laws(motor: Motor, draws: int) -> list[Criteria]:
    """Criteria of laws drawn at random."""
    runs = jax.jit(jax.vmap(runs_by_energy(motor)))(drawn_laws(draws))
    return [criteria(motor, jax.tree.map(lambda each, index=index: each[index], runs)) for index in range(draws)]


def best_law(motor: Motor, draws: int = DRAWS) -> Law:
    """The random law with the best score."""
    place = int(np.argmax([score(each) for each in runs_of_drawn_laws(motor, draws)]))
    return jax.tree.map(lambda each: each[place], drawn_laws(draws))


def board(motor: Motor, draws: int = DRAWS) -> Findings:
    """The best score of laws drawn at random, and the share that succeeds."""
    found = runs_of_drawn_laws(motor, draws)
    scores = np.array([score(each) for each in found])
    best = found[int(np.argmax(scores))]
    name = plant(motor)[0].name
    words = f"version 2 of the board's, the best of {draws} laws drawn"
    case, bound = f"board/{name}/energy", TO_REACH if motor == "elbow" else None
    rows = [Row(case, "score", float(scores.max()), expected=words, bound=bound, at_least=True)]
    rows.append(Row(case, "share_of_laws_that_succeed", float(np.mean(scores > 0))))
    return Findings([*rows, *rows_of_criteria(case, best)])


def rows_of_criteria(case: str, found: Criteria) -> list[Row]:
    """The five criteria of the score."""
    numbers = zip(found._fields, found, UNITS, strict=True)
    return [Row(case, key, float(number), unit) for key, number, unit in numbers]


class SwingUp(NamedTuple):
    """A plant with one free pole, and the numbers of its law."""

    scene: Scene
    gains: EnergyGains
    state_cost: np.ndarray
    control_cost: float
    limit: float
    """Limit of force or torque, N or N m."""
    level: float
    encoder_step: tuple[float, float]
    """Resolution of the encoders, m or rad."""
    position: float
    """Standard deviation of the driven coordinate at the start, m or rad."""


def closed_loop(case: SwingUp, *, seconds: float = 10.0) -> Callable[[Array], ClosedLoopRun]:
    """Start [4] -> run with a model of the hardware: only encoders are read, at 500 Hz, rates are their differences,
    and torques act one sample late."""
    scene, rate = case.scene, RATE
    system, B, joints = dynamics(scene.energies), np.asarray(scene.needs.actuation), scene.needs.joints
    field, goal = field_of(system, B), jnp.zeros(4)
    at = linearise(field, goal, holding_controls(system, goal[:2], B))
    regulator = lqr(at.A, at.B, case.state_cost, [[case.control_cost]])
    swing = energy_shaping(system, parts_of(B), goal[:2], case.gains)
    near = regulated(regulator, goal, at.u, joints)
    law = switched(lambda x: swing(x[:2], x[2:]), near, value(regulator, goal, joints), case.level)
    controller = with_differences(law, 2, rate=rate, cutoff=50.0)
    lab = Hardware(-case.limit, case.limit, encoder_step=np.array(case.encoder_step), delay=1, sees_rates=False)
    return lambda start: simulate(field, controller, start, seconds=seconds, rate=rate, controls=1, hardware=lab)


def success(case: SwingUp, starts: int, seed: int = 0, *, seconds: float = 10.0) -> Outcomes:
    """Outcomes from random starts near hanging."""
    return tried(case, hanging_starts(starts, seed, position=case.position), seconds=seconds)


def tried(case: SwingUp, starts: np.ndarray, *, seconds: float = 10.0) -> Outcomes:
    """Outcomes from these starts [K, 4]."""
    run = closed_loop(case, seconds=seconds)
    return outcomes(jax.jit(jax.vmap(lambda start: run(start).x[:, 1]))(starts), rate=RATE)


def rows_of_outcomes(case: str, found: Outcomes, words: str, bound: float | None = None) -> list[Row]:
    """Share of successes, number of NaN runs, and median and worst time."""
    return [
        Row(case, "success_share", found.share, expected=words, bound=bound, at_least=True),
        Row(case, "no_number", float(found.failed.sum()), expected="runs, counted as failures"),
        Row(case, "seconds_median", found.median, "s"),
        Row(case, "seconds_worst", found.worst, "s"),
    ]
