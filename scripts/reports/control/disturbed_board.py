"""The board's plant with the disturbances of its robustness table (version 2), one at a time, and controllers for it.

Numbers are those of the board's own program (`leaderboard/acrobot/robustness_v2` of Wiebe et al. 2022). Ten parameters
of the plant, noise of rates and torques, the response of the motor and the delay of measurements take 21 values each;
in 50 further runs the joints get three random pushes each. As on the board, pushes on the passive joint have no effect,
and a run succeeds if its last state is near the goal.

Nine numbers determine the plant: with the known length l1,

    a = I1 + m2 l1²,  I2,  h = m2 l1 r2,  w = g (m1 r1 + m2 l1),  viscous and dry friction,  the rotors' inertia
"""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    Controller,
    Plan,
    error,
    field_of,
    regulated,
    sampled_lqr,
    saturated,
    value,
    with_differences,
    with_prediction,
)
from dln_jax.control.state_space import Field
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import CLASSICAL, MIDPOINT, runge_kutta
from dln_jax.scenes.pendulums import Links
from scripts.reports.control.board import (
    EVERY,
    GOAL,
    LIMIT,
    RATE,
    SECONDS,
    STATE_COST,
    Law,
    Motor,
    at_goal,
    best_law,
    best_plan,
    by_energy,
    follower,
    judged,
    plant,
    pumping,
)
from scripts.reports.run import Numbers

VALUES, REPETITIONS, PUSHED, PUSHES = 21, 10, 50, 3
NEAR = np.array([0.35, 0.35, 1.0, 1.0])
"""Tolerance of the last state, rad and rad/s."""
LONGEST = 20
"""Longest delay in samples."""
GRAVITY, GEAR = 9.81, 6.0
"""Weight per mass, and gear ratio between a rotor and its joint."""
TOGETHER = 105
"""Runs per program call."""
# Chosen by random draws, with disturbances like those of the table, but not the same ones.
RECOVERIES: dict[Motor, tuple[Law, float, float, float]] = {
    "elbow": (Law(np.array([2.89, 17.1, 41.5]), 313.0, 1.0, 6.0), 0.2, 1.5, 1.0),
    "shoulder": (Law(np.array([47.8, 2.15, 3.44]), 63.9, 1.0, 6.0), 0.2, 1.0, 10.0),
}
"""Energy law; amplitude, J, and period, s, of the sweep of its energy; control cost of the regulator."""


class Disturbance(NamedTuple):
    """A plant's nine numbers, and what else differs from the nominal plant."""

    numbers: Any
    rate_noise: Any = 0.0
    """Standard deviation of the noise on measured rates, rad/s."""
    torque_noise: Any = 0.0
    """Standard deviation of the noise on torques, N m."""
    response: Any = 1.0
    """k in u_k = u_{k-1} + k (wanted - u_{k-1})."""
    delay: Any = 0
    """Delay of measurements in samples."""
    times: Any = np.zeros((2, PUSHES))
    """Times of the pushes by joint, s."""
    widths: Any = np.ones((2, PUSHES))
    """Standard deviations of the pushes in time, s."""
    pushes: Any = np.zeros((2, PUSHES))
    """Peak torques of the pushes, N m."""


def numbers_of(links: Links) -> np.ndarray:
    """The nine numbers of links without friction and rotors."""
    (m1, m2), (l1, _), (r1, r2), (I1, I2) = links.masses, links.lengths, links.centres, links.inertias
    return np.array([I1 + m2 * l1**2, I2, m2 * l1 * r2, GRAVITY * (m1 * r1 + m2 * l1), *np.zeros(5)])


NOMINAL = numbers_of(Links())


def parts(p: Array, q: Array, qd: Array) -> tuple[Array, Array]:
    """Mass matrix [2, 2] and the other torques [2] without acceleration, for the nine numbers."""
    a, outer, h, w, *friction, rotor = p
    cos, sin = jnp.cos(q[1]), jnp.sin(q[1])
    coupling = outer + h * cos - GEAR * rotor
    M = jnp.array([[a + outer + 2 * h * cos + (GEAR**2 + 1) * rotor, coupling], [coupling, outer + GEAR**2 * rotor]])
    far = h / Links().lengths[0] * GRAVITY * jnp.sin(q[0] + q[1])
    held = jnp.stack([w * jnp.sin(q[0]) + far - h * sin * qd[1] * (2 * qd[0] + qd[1]), far + h * sin * qd[0] ** 2])
    viscous, dry = jnp.stack(friction[:2]), jnp.stack(friction[2:])
    return M, held + viscous * qd + dry * jnp.arctan(100 * qd)


def field_for(p: Array, B: Array) -> Field:
    """(x, u) -> dx/dt for the nine numbers."""

    def field(x, u):
        q, qd = jnp.split(x, 2)
        M, held = parts(p, q, qd)
        # Cramer's rule: a factorisation of a 2 x 2 matrix would cost more than the rest.
        (a, b), (_, d) = M
        f, g = B @ u - held
        return jnp.concatenate([qd, jnp.stack([d * f - b * g, a * g - b * f]) / (a * d - b * b)])

    return field


def disturbances() -> dict[str, list[Disturbance]]:
    """All disturbances of the table by criterion; values of noise repeat ten times, and pushes are random."""
    base, random, model = Disturbance(NOMINAL), np.random.default_rng(0), []
    for rotor in np.linspace(0, 1e-4, VALUES):
        model.append(np.append(NOMINAL[:8], rotor))
    # Two of the board's parameters are products; one factor varies, and the inertias about the joints stay.
    for key, link in (("centres", 0), ("inertias", 0), ("centres", 1), ("masses", 1), ("inertias", 1)):
        for factor in np.linspace(0.75, 1.25, VALUES):
            scaled = np.array(getattr(Links(), key))
            scaled[link] *= factor
            model.append(numbers_of(Links()._replace(**{key: tuple(scaled)})))
    for place, most in ((4, 0.1), (5, 0.1), (6, 0.2), (7, 0.2)):
        for friction in np.linspace(-most, most, VALUES):
            model.append(np.where(np.arange(9) == place, friction, NOMINAL))
    pushed = []
    for _ in range(PUSHED):
        # Three pushes at each joint, all at least a second apart.
        count = 2 * PUSHES
        gaps = 1.0 + random.uniform(0, (SECONDS - (count + 1)) / count, count)
        times = random.permutation(np.cumsum(gaps)).reshape(2, PUSHES)
        drawn = random.uniform(-4.5, 4.5, (2, PUSHES))
        widths = random.uniform(0.05, 0.1, (2, PUSHES))
        pushed.append(base._replace(times=times, widths=widths, pushes=drawn + 0.5 * np.sign(drawn)))
    return {
        "model": [Disturbance(numbers) for numbers in model],
        "rate_noise": [base._replace(rate_noise=size) for size in np.repeat(np.linspace(0, 0.5, VALUES), REPETITIONS)],
        "torque_noise": [
            base._replace(torque_noise=size) for size in np.repeat(np.linspace(0, 1.1, VALUES), REPETITIONS)
        ],
        "response": [base._replace(response=k) for k in np.linspace(0.1, 2.0, VALUES)],
        "delay": [base._replace(delay=samples) for samples in range(LONGEST + 1)],
        "pushes": pushed,
    }


def last_state(
    motor: Motor, controller: Controller, disturbance: Disturbance, key: Array, seconds: float = SECONDS
) -> Array:
    """The state [4] after a run from hanging; the controller gets measured (q, qd)."""
    B, dt = plant(motor)[1], 1.0 / RATE
    field = field_for(jnp.asarray(disturbance.numbers), B)

    def sample(carry, number):
        history, memory, before = carry
        of_rates, of_torque = jax.random.split(jax.random.fold_in(key, number))
        y = history[jnp.asarray(disturbance.delay)]
        y = y.at[2:].add(disturbance.rate_noise * jax.random.normal(of_rates, (2,)))
        memory, wanted = controller.act(memory, number * dt, y)
        u = before + disturbance.response * (wanted - before)
        u = saturated(u + disturbance.torque_noise * jax.random.normal(of_torque, (1,)), -LIMIT, LIMIT)
        since = (number * dt - disturbance.times) / disturbance.widths
        # The board multiplies all torques by B, including pushes.
        acting = u + B.T @ jnp.sum(disturbance.pushes * jnp.exp(-(since**2) / 2), axis=1)
        x = runge_kutta(CLASSICAL, lambda t, state: field(state, acting))(0.0, history[0], dt)
        return (jnp.concatenate([x[None], history[:-1]]), memory, u), None

    start = (jnp.zeros((LONGEST + 1, 4)), controller.start, jnp.zeros(1))
    (history, _, _), _ = jax.lax.scan(sample, start, jnp.arange(round(seconds * RATE)))
    return history[0]


def shares(motor: Motor, controller: Controller, every: int) -> dict[str, float]:
    """Shares of successes by criterion, their mean, and the score without disturbance."""
    run = jax.jit(jax.vmap(lambda disturbance, key: last_state(motor, controller, disturbance, key)))
    table = {name: listed[::every] for name, listed in disturbances().items()}
    listed = list(itertools.chain(*table.values()))
    keys, ends = jax.random.split(jax.random.key(0), len(listed)), []
    # Neighbours are similar, so a controller that waits for a delay does not hold up very different runs.
    for first in range(0, len(listed), TOGETHER):
        places = np.minimum(np.arange(first, first + TOGETHER), len(listed) - 1)
        chunk = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *(listed[place] for place in places))
        ends.append(np.asarray(run(chunk, keys[places])))
    joints = plant(motor)[0].needs.joints
    off = np.abs(jax.vmap(lambda x: error(x, GOAL, joints))(jnp.asarray(np.concatenate(ends)[: len(listed)])))
    # NaN compares as False, hence as a failure.
    succeeded, outcome = np.all(off < NEAR, axis=1), {}
    for name, of_criterion in table.items():
        good, succeeded = np.split(succeeded, [len(of_criterion)])
        # Of ten runs with the same noise more than half must succeed.
        repeated = name.endswith("noise") and every == 1
        outcome[f"share_{name}"] = np.mean(good.reshape(-1, REPETITIONS).mean(axis=1) > 0.5 if repeated else good)
    return {
        **outcome,
        "share_mean": float(np.mean(list(outcome.values()))),
        "score_undisturbed": judged(motor, controller)["score"],
    }


def by_angles(motor: Motor, controller: Controller) -> Controller:
    """A controller of x that uses only the measured angles and predicts the current state if they are delayed."""
    scene, B = plant(motor)
    field = field_of(dynamics(scene.closed_form), B)
    step = lambda x, u: runge_kutta(MIDPOINT, lambda t, x: field(x, u))(0.0, x, 1 / RATE)  # noqa: E731
    predicting = with_prediction(controller, step, states=4, controls=1, max_delay=LONGEST)
    # The cut-off is above the sampling rate: differences are hardly filtered.
    seeing = with_differences(predicting, 2, rate=RATE, cutoff=1000.0, order=2)
    return Controller(seeing.start, lambda memory, t, y: seeing.act(memory, t, y[:2]))


def recovering(motor: Motor, plan: Plan) -> Controller:
    """The plan; after its end the regulator where its value is below the law's level, else the energy law."""
    law, amplitude, period, control_cost = RECOVERIES[motor]
    at, joints, far = at_goal(motor), plant(motor)[0].needs.joints, pumping(motor)
    regulator = sampled_lqr(at.A, at.B, STATE_COST, control_cost * np.eye(1), 1 / RATE)
    near, cost = regulated(regulator, GOAL, at.u, joints), value(regulator, GOAL, joints)
    planned, last = follower(motor, plan), EVERY * len(plan.u)

    def act(memory, t, y):
        inner, number, tau = memory
        inner, by_plan = planned.act(inner, t, y)
        # A wrong model has a wrong energy of the goal, so the law's energy is swept.
        beyond = amplitude * jnp.sin(2 * jnp.pi * (number - last) / (RATE * period))
        by_law = tau + law.share * (saturated(far(y, law.gains, beyond), -law.most, law.most) - tau)
        u = jnp.where(number < last, by_plan, jnp.where(cost(y) <= law.level, near(y), by_law))
        u = saturated(u, -LIMIT, LIMIT)
        return (inner, number + 1, u), u

    return Controller((planned.start, jnp.asarray(0), jnp.zeros(1)), act)


def robustness(*, motor: Motor, draws: int = 300, every: int = 1) -> Numbers:
    """Successes of controllers with gains and plans of the undisturbed plant, on one in `every` disturbances."""
    plan = best_plan(motor)
    controllers = {
        "planned": follower(motor, plan),
        "by-energy": by_energy(motor)(best_law(motor, draws)),
        "planned-by-angles": by_angles(motor, follower(motor, plan)),
        "recovering": by_angles(motor, recovering(motor, plan)),
    }
    name = plant(motor)[0].name
    return {f"robustness/{name}/{which}": shares(motor, one, every) for which, one in controllers.items()}
