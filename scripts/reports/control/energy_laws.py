"""Swing-ups by energy of the acrobot and the pendubot on the board.

The law is Spong's with the total energy: the driven joint accelerates by

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

from dln_jax.control import ClosedLoopRun, Controller, lqr, partial_linearisation, parts_of, regulated, switched, value
from dln_jax.mechanics.equations import dynamics
from scripts.reports.case import Findings
from scripts.reports.control.board import (
    GOAL,
    LIMIT,
    Criteria,
    Motor,
    at_goal,
    closed_loop,
    criteria,
    plant,
    rows_of_criteria,
    score,
)
from scripts.reports.rows import Row

STATE_COST, CONTROL_COST = np.diag([0.97, 0.93, 0.39, 0.26]), np.array([[0.11]])
"""Cost matrices of the regulator, from the board's own controller."""
STILL = 1e-3
"""Largest joint rate, rad/s, that counts as rest; the full torque is then applied to start the motion."""
DRAWS = 1000
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
    scene, _ = plant(motor)
    system, joints, far = dynamics(scene.energies), scene.needs.joints, pumping(motor)
    at = at_goal(motor, system)
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
    controller = controllers_by_energy(motor)
    return lambda numbers: closed_loop(motor, controller(numbers))


def runs_of_drawn_laws(motor: Motor, draws: int) -> list[Criteria]:
    """Criteria of laws drawn at random."""
    runs = jax.jit(jax.vmap(runs_by_energy(motor)))(drawn_laws(draws))
    return [criteria(motor, jax.tree.map(lambda leaf, index=index: leaf[index], runs)) for index in range(draws)]


def best_law(motor: Motor, draws: int = DRAWS) -> Law:
    """The random law with the best score."""
    place = int(np.argmax([score(numbers) for numbers in runs_of_drawn_laws(motor, draws)]))
    return jax.tree.map(lambda leaf: leaf[place], drawn_laws(draws))


def board(motor: Motor, quick: bool) -> Findings:
    """The best score of laws drawn at random, and the share that succeeds."""
    draws = 100 if quick else DRAWS
    results = runs_of_drawn_laws(motor, draws)
    scores = np.array([score(numbers) for numbers in results])
    case = f"board/{plant(motor)[0].name}/energy"
    words = f"version 2 of the board's, the best of {draws} laws drawn"
    bound = TO_REACH if motor == "elbow" else None
    rows = [Row(case, "score", float(scores.max()), expected=words, bound=bound, at_least=True)]
    rows.append(Row(case, "share_of_laws_that_succeed", float(np.mean(scores > 0))))
    return Findings([*rows, *rows_of_criteria(case, results[int(np.argmax(scores))])])
