"""Recovery of the board's plants by model predictive control, whose model is identified on the way.

The plan from hanging is followed first. Then `control.recovery_by_plans` plans from three first guesses, every `every`
samples, and a regulator holds the goal where its value is below a level.

Nine numbers determine the motion of two links: with the known length l1,

    a = I1 + m2 l1²,  I2,  h = m2 l1 r2,  w = g (m1 r1 + m2 l1),  viscous and dry friction,  the rotors' inertia

They enter the torques linearly, and recursive least squares estimates them from second differences of the angles and
the commanded torques, from a prior about the nominal plant. The row of the joint without a motor has no torque and no
error of a torque, so it counts more.
"""

from typing import Any, NamedTuple

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
    first_plan,
    recovery_by_plans,
    sampled_lqr,
    saturated,
    with_differences,
    with_prediction,
)
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import CLASSICAL, MIDPOINT, advance, runge_kutta
from dln_jax.scenes.pendulums import Links
from scripts.reports.case import Findings
from scripts.reports.control.board import GOAL, LIMIT, RATE, Motor, at_goal, criteria, plant, play, score
from scripts.reports.control.disturbed_board import CRITERIA, GEAR, LONGEST, robustness
from scripts.reports.control.planned import EVERY as OF_PLAN
from scripts.reports.control.planned import Weights, follower, search
from scripts.reports.rows import Row

STATE_COST = np.diag([10.0, 10.0, 1.0, 1.0])
"""State cost of the regulator."""
CUTOFF = 1000.0
"""Cut-off of the differences, Hz: above the sampling rate, so that they are hardly filtered."""
PRIOR = np.array([0.1, 0.1, 0.1, 0.1])
"""Standard deviations of the inertial numbers before any motion, relative."""
FRICTION = np.array([0.05, 0.05, 0.1, 0.1, 5e-5])
"""Standard deviations of viscous and dry friction and of the rotors' inertia, N m s, N m, kg m²."""
DRIVEN_ERROR, PASSIVE_ERROR = 1.0, 0.01
"""Standard deviations of the torques of the joints with and without a motor about the model's, N m."""
GRAVITY = 9.81
LEVELS: dict[Motor, float] = {"elbow": 300.0, "shoulder": 100.0}
"""Levels of the regulator's value, chosen for the acrobot on one in five of the table's runs."""
PLANNED_SECONDS = 1.6
"""Horizon of the plan from hanging, s."""


class Replanning(NamedTuple):
    """Numbers of the model predictive control."""

    every: int = 10
    """Samples of the board between two plans, and per step of a plan."""
    steps: int = 60
    """Steps of the horizon."""
    torque: float = 0.1
    """Weights of the integrals of the squared torque and rates, and of the last state's angles and rates."""
    rates: float = 0.01
    angles_at_end: float = 300.0
    rates_at_end: float = 30.0
    level: float = 100.0
    """The regulator acts below this value of its cost to go."""
    control_cost: float = 1.0
    """Control cost of the regulator."""
    pumps: tuple[float, ...] = (0.0, 3.0, -3.0)
    """Amplitudes of the first guesses, N m: torques with the frequency of a small swing."""
    identified: bool = True
    """Whether the model is identified on the way."""


class Model(NamedTuple):
    """Quantities identified on the way: cost to go and gains of the regulator, and the nine numbers."""

    S: Array
    K: Array
    p: Array


class Estimate(NamedTuple):
    """Memory of the least squares."""

    numbers: Array
    """Deviations from the nominal numbers in units of the prior's standard deviations [9]."""
    covariance: Array
    angles: Array
    """The last three measured [3, 2], the newest first."""
    torques: Array
    """Past controls [LONGEST + 3], the newest first."""
    seen: Array


def nominal() -> tuple[np.ndarray, np.ndarray]:
    """The nine numbers of the nominal plant, and their prior standard deviations."""
    links = Links()
    (m1, m2), (l1, _), (r1, r2), (I1, I2) = links.masses, links.lengths, links.centres, links.inertias
    inertial = np.array([I1 + m2 * l1**2, I2, m2 * l1 * r2, GRAVITY * (m1 * r1 + m2 * l1)])
    return np.concatenate([inertial, np.zeros(5)]), np.concatenate([PRIOR * inertial, FRICTION])


def parts(p: Array, q: Array, qd: Array) -> tuple[Array, Array]:
    """Mass matrix [2, 2] and the other torques [2] at rest accelerations, for the nine numbers."""
    a, outer, h, w, *friction, rotor = p
    cos, sin = jnp.cos(q[1]), jnp.sin(q[1])
    coupling = outer + h * cos - GEAR * rotor
    M = jnp.array([[a + outer + 2 * h * cos + (GEAR**2 + 1) * rotor, coupling], [coupling, outer + GEAR**2 * rotor]])
    far = h / Links().lengths[0] * GRAVITY * jnp.sin(q[0] + q[1])
    held = jnp.stack([w * jnp.sin(q[0]) + far - h * sin * qd[1] * (2 * qd[0] + qd[1]), far + h * sin * qd[0] ** 2])
    viscous, dry = jnp.stack(friction[:2]), jnp.stack(friction[2:])
    return M, held + viscous * qd + dry * jnp.arctan(100 * qd)


def field_for(p: Array, B: Array) -> Any:
    """(x, u) -> dx/dt for the nine numbers."""

    def field(x: Array, u: Array) -> Array:
        q, qd = jnp.split(x, 2)
        M, held = parts(p, q, qd)
        (a, b), (_, d) = M
        f, g = B @ u - held
        return jnp.concatenate([qd, jnp.stack([d * f - b * g, a * g - b * f]) / (a * d - b * b)])

    return field


def problem(field: Any, numbers: Replanning) -> TrajectoryProblem:
    """The optimal control problem on (q, qd) with the torque as control, held for a step."""
    dt = numbers.every / RATE

    def off(x: Array) -> tuple[Array, Array]:
        # Periodic, as a motion may come up from either side.
        return jnp.sum(2 * (1 - jnp.cos(x[:2] - GOAL[:2]))), jnp.sum(x[2:] ** 2)

    def cost(x: Array, u: Array) -> Array:
        return dt * (numbers.torque * u[0] ** 2 + numbers.rates * off(x)[1])

    def final_cost(x: Array) -> Array:
        angles, rates = off(x)
        return numbers.angles_at_end * angles + numbers.rates_at_end * rates

    def step(x: Array, u: Array) -> Array:
        return advance(runge_kutta(CLASSICAL, lambda t, x: field(x, u)), 0.0, x, dt, substeps=2)

    return TrajectoryProblem(step, cost, final_cost, -LIMIT, LIMIT)


def first_plans(horizon: TrajectoryProblem, numbers: Replanning) -> Plan:
    """Plans from hanging with every first guess, along a leading axis."""
    t = numbers.every / RATE * np.arange(numbers.steps)
    guesses = np.array(numbers.pumps)[:, None] * np.sin(2 * np.pi * t)
    return jax.vmap(lambda u: first_plan(horizon, np.zeros(4), u))(guesses[..., None])


def updated(motor: Motor, estimate: Estimate, y: Array, u: Array, delay: Array, moved: Array) -> Estimate:
    """The estimate after a measurement of the angles [2], before which u [1] was commanded."""
    centre, size = nominal()
    angles = jnp.concatenate([y[None], estimate.angles[:2]])
    torques = jnp.concatenate([u, estimate.torques[:-1]])
    q, dt = angles[1], 1 / RATE
    qd, qdd = (angles[0] - angles[2]) / (2 * dt), (angles[0] - 2 * q + angles[2]) / dt**2
    # A second difference sees the mean of the torques on both sides.
    tau = plant(motor)[1] @ (torques[delay] + torques[delay + 1])[None] / 2

    def torque(z: Array) -> Array:
        M, held = parts(jnp.asarray(centre) + size * z, q, qd)
        return M @ qdd + held

    zero = jnp.zeros(len(centre))
    rows, rest = jax.jacfwd(torque)(zero), tau - torque(zero)
    z, P = estimate.numbers, estimate.covariance
    errors = {"shoulder": (DRIVEN_ERROR, PASSIVE_ERROR), "elbow": (PASSIVE_ERROR, DRIVEN_ERROR)}[motor]
    for row, aim, deviation in zip(rows, rest, errors, strict=True):
        # Errors of differences grow with the acceleration.
        noise = deviation**2 + (1e-3 * jnp.max(jnp.abs(qdd)) * size[1] / PRIOR[1]) ** 2
        gain = P @ row / (row @ P @ row + noise)
        z, P = z + gain * (aim - row @ z), P - jnp.outer(gain, row @ P)
    used = moved & (estimate.seen >= LONGEST)
    z, P = jnp.where(used, z, estimate.numbers), jnp.where(used, (P + P.T) / 2, estimate.covariance)
    return Estimate(z, P, angles, torques, estimate.seen + 1)


def replanning(
    motor: Motor,
    weights: Weights,
    plan: Plan,
    numbers: Replanning = Replanning(),  # noqa: B008
) -> Controller:
    """The plan; after its end the regulator where its value is low, else model predictive control; from the angles."""
    scene, B = plant(motor)
    known = field_of(dynamics(scene.closed_form), B)
    at, joints = at_goal(motor, dynamics(scene.closed_form)), scene.needs.joints
    control_cost = numbers.control_cost * np.eye(1)
    regulator = sampled_lqr(at.A, at.B, STATE_COST, control_cost, 1 / RATE)
    planned, last = follower(motor, weights, plan), OF_PLAN * len(plan.u)
    centre, size = nominal()
    driven = {"shoulder": 0, "elbow": 1}[motor]
    off = lambda x: error(x, jnp.asarray(GOAL), joints)  # noqa: E731

    def near(x: Array, model: Model) -> Array:
        friction = model.p[6 + driven] * jnp.arctan(100 * x[2 + driven]) * numbers.identified
        return saturated(friction - model.K @ off(x), -LIMIT, LIMIT)

    again = recovery_by_plans(
        lambda model: problem(field_for(model.p, B), numbers), first_plans(problem(known, numbers), numbers), near,
        lambda x, model: off(x) @ model.S @ off(x), numbers.level, rate=RATE, every=numbers.every,
        parameters=Model(jnp.asarray(regulator.S), jnp.asarray(regulator.K), jnp.asarray(centre)),
    )  # fmt: skip

    def renewed(model: Model, p: Array) -> Model:
        """One iteration towards the sampled regulator of the identified model."""
        smooth = field_for(jnp.concatenate([p[:6], jnp.zeros(2), p[8:]]), B)
        step = lambda x, u: runge_kutta(CLASSICAL, lambda t, x: smooth(x, u))(0.0, x, 1 / RATE)  # noqa: E731
        A, b = jax.jacfwd(step, (0, 1))(jnp.asarray(GOAL), jnp.zeros(1))
        R = control_cost / RATE + b.T @ model.S @ b
        K = (b.T @ model.S @ A) / R
        return Model(STATE_COST / RATE + A.T @ model.S @ (A - b @ K), K, p)

    def act(memory: tuple[Any, ...], t: Array, y: Array) -> tuple[tuple[Any, ...], Array]:
        number, inner, later = memory
        inner, by_plan = planned.act(inner, t, y)
        begun = number >= last
        later, u = jax.lax.cond(begun, again.act, lambda later, t, y: (later, by_plan), later, t, y)
        return (number + 1, inner, later), saturated(u, -LIMIT, LIMIT)

    step = lambda x, u: runge_kutta(MIDPOINT, lambda t, x: known(x, u))(0.0, x, 1 / RATE)  # noqa: E731
    inside = Controller((jnp.asarray(0), planned.start, again.start), act)
    predicting = with_prediction(inside, step, states=4, controls=1, max_delay=LONGEST)
    seeing = with_differences(predicting, 2, rate=RATE, cutoff=CUTOFF, order=2)

    def outside(memory: tuple[Any, ...], t: Array, y: Array) -> tuple[tuple[Any, ...], Array]:
        estimate, u, (rates, late) = memory
        if numbers.identified:
            estimate = updated(motor, estimate, y[:2], u, late.delay, late.moved)
            *before, later = late.inner
            model = renewed(later.parameters, jnp.asarray(centre) + size * estimate.numbers)
            late = late._replace(inner=(*before, later._replace(parameters=model)))
        inner, u = seeing.act((rates, late), t, y[:2])
        return (estimate, u, inner), u

    nothing = jnp.zeros(len(centre)), jnp.eye(len(centre)), jnp.zeros((3, 2)), jnp.zeros(LONGEST + 3), jnp.asarray(0)
    return Controller((Estimate(*nothing), jnp.zeros(1), seeing.start), outside)


def replanned(motor: Motor, quick: bool) -> Findings:
    """Shares of successes by criterion of the recovery by model predictive control, and their mean."""
    name = plant(motor)[0].name
    _, plan, weights = search(motor, (PLANNED_SECONDS,), (Weights(),), guesses=1)
    controller = replanning(motor, weights, plan, Replanning(level=LEVELS[motor]))
    shares = robustness(motor, controller, every=10 if quick else 1)
    case = f"replanning/{name}"
    rows = [Row(case, f"share_{key}", shares[key]) for key in (*CRITERIA, "mean")]
    return Findings([*rows, Row(case, "score_undisturbed", score(criteria(motor, play(motor, controller))))])
