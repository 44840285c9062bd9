"""Swing-ups by a plan: an optimal trajectory from hanging to the goal, feedback along it, and a regulator at its end.

    min  |error_N|² weight + integral lambda (effort |u / u_max|² + rates²) dt,   |u| <= `SHARE` u_max

in the units of `scales`. Random guesses of the controls are improved together by iterative linear-quadratic regulators.
Plans with the smallest feedback gains come first: gains are large where the motors hardly move the passive joints, and
a phase error reverses their sign there. The feedback is a time-varying regulator for the samples; its final cost to go
comes from the regulator at the goal. A regulator about hanging brings the plant to rest first, and again if the goal is
lost.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import Controller
from dln_jax.control.plants.plant import Layout, spread_of
from dln_jax.control.real_time import improve
from dln_jax.control.recovery import recovery_by_plans
from dln_jax.control.regulators import Regulator, lqr, regulated, time_varying_lqr, value
from dln_jax.control.state_space import Field, circular, error, field_of, integrated, linearise
from dln_jax.control.swing_up import SwingUpNumbers, Upright, friction_of, swing_up_numbers
from dln_jax.control.tracking import without_friction
from dln_jax.control.trajectories import Plan, TrajectoryProblem, first_plan
from dln_jax.types import InputError

DURATIONS = (8.0, 14.0, 20.0)
"""Durations of plans, in units of 1 / lambda, tried from short to long until a plan arrives."""
FINENESS = 15.0
"""Steps of a plan per 1 / lambda."""
SHARE = 0.7
"""Largest share of the motors' limits in a plan; the rest remains for feedback."""
INSIDE = 0.8
"""A plan should stay within this share of the limits of the coordinates and rates."""
GUESSES, ITERATIONS, LENGTHS = 16, 100, 0.5 ** np.arange(6)
CLOSE = 0.1
"""Largest error at the end of a plan, in units of the coordinates."""
EFFORTS = (1.0, 0.1)
"""Weights of the controls in alternate plans: gentle and firm plans."""
AT_END, RATES, POSTURE, BEYOND = 300.0, 0.003, 0.02, 100.0
"""Weights of the errors at the end, of the rates, of active coordinates away from the goal (an acrobot's motor hardly
moves its passive joint there), and of coordinates and rates outside their share of the limits."""
READY = -1
"""Sample number of a plan while the plant hangs and waits for its start."""
CALM, PATIENCE = 1 / 36, 4
"""Share of the level below which a lost plan starts again: half a standard deviation of the starts instead of three,
because too distant a start may have caused the loss. After `PATIENCE` durations of the plan the whole level counts, in
case friction keeps the plant away."""
LOST = 1.0
"""Largest distance of an angle from the plan or the goal, rad; beyond it, the plant returns to hanging and starts
again."""
HORIZON, COARSENESS = 6.0, 7.0
"""Duration of repeated plans in units of 1 / lambda, and their steps per 1 / lambda."""
MORE, LESS_AT_END, SOON = 0.9, 100.0, 1.0
"""Their share of the motors' limits, and their weights of the errors at the end and of the distance on the way."""
SWINGS = (0.0, 0.5, -0.5)
"""Sizes of their first guesses, as shares of the motors' limits."""


class TrackedPlan(NamedTuple):
    """A plan at the samples of a controller, with its regulators."""

    x: Float[Array, "N n"]
    u: Float[Array, "N m"]
    K: Float[Array, "N m n"]
    S: Float[Array, "n n"]
    """Cost to go at the start."""
    level: Any
    """Largest cost to go, from hanging, at which the plan starts."""
    regulator: Regulator
    """Regulator at the goal."""
    hanging: Regulator


def plan_problem(
    upright: Upright, effort: Any, *, every: int, share: float = SHARE, at_end: float = AT_END, soon: float = 0.0
) -> TrajectoryProblem:
    """Returns the problem of plans to the goal.

    Args:
        upright: the model. The compensation removes the friction of its driven joints.
        effort: weight of the controls; it may be traced.
        every: samples per step.
        share: largest share of the motors' limits.
        at_end: weight of the errors at the end.
        soon: weight of the distance from the goal on the way. If positive, passive joints may reach the goal after any
            number of turns.
    """
    layout, size, units = upright.layout, upright.forces, _units(upright)
    d, dt, goal = len(layout.joints), every / layout.rate, np.asarray(upright.at.x)
    low, high = inner_ranges(layout, INSIDE)
    fastest = INSIDE * layout.limits.rate
    # Driven joints must not make extra turns, because of their cables.
    free = circular(layout.joints, 2 * d) & np.isin(np.arange(2 * d), upright.parts.passive) & (soon > 0)

    def off(x: Array) -> Array:
        return jnp.where(free, 2 * jnp.sin((x - goal) / 2), x - goal) / units

    def cost(x: Array, u: Array) -> Array:
        away = off(x)[np.array(upright.parts.active)]
        beyond = jnp.maximum(x[:d] - high, 0.0) + jnp.maximum(low - x[:d], 0.0)
        faster = jnp.maximum(jnp.abs(x[d:]) - fastest, 0.0)
        running = effort * jnp.sum((u / size) ** 2) + RATES * jnp.sum((x[d:] / units[d:]) ** 2)
        running += POSTURE * jnp.sum(away**2)
        if soon:
            running += soon * jnp.sum(off(x)[:d] ** 2)
        return dt * upright.scales.fall * running + BEYOND * (
            jnp.sum((beyond / units[:d]) ** 2) + jnp.sum((faster / units[d:]) ** 2)
        )

    def end(x: Array) -> Array:
        return at_end * jnp.sum(off(x) ** 2)

    step = integrated(_compensated(upright), dt, substeps=2)
    return TrajectoryProblem(step, cost, end, lower=-share * size, upper=share * size)


def plans_of(upright: Upright, *, seed: int = 0) -> list[Plan]:
    """Returns the plans from hanging that reach the goal, least sensitive first; raises `InputError` without any."""
    every, size, fall = steps_of(upright), upright.forces, upright.scales.fall
    goal, units = np.asarray(upright.at.x), _units(upright)

    @jax.jit
    @jax.vmap
    def solved(u: Array, effort: Array) -> Plan:
        problem = plan_problem(upright, effort, every=every)
        again = lambda _, plan: improve(problem, plan, step_lengths=LENGTHS)  # noqa: E731
        return jax.lax.fori_loop(0, ITERATIONS, again, first_plan(problem, upright.rest, u))

    random = np.random.default_rng([seed, 41])
    sizes = np.geomspace(0.03, 0.5, GUESSES)[:, None, None]
    nearest = np.inf
    for duration in DURATIONS:
        steps = round(duration / fall * upright.layout.rate / every)
        guesses = sizes * size * random.normal(size=(GUESSES, steps, len(size)))
        plans = jax.tree.map(np.asarray, solved(guesses, np.resize(EFFORTS, GUESSES)))
        off = np.abs((plans.x[:, -1] - goal) / units).max(axis=1)
        largest = np.abs(plans.K * units / size[:, None]).max(axis=(1, 2, 3))
        if good := [k for k in np.argsort(largest) if off[k] <= CLOSE]:
            return [jax.tree.map(lambda leaf: leaf[k], plans) for k in good]  # noqa: B023
        nearest = np.nanmin([nearest, *off])
    raise InputError(
        f"no plan of {DURATIONS[-1] / fall:.3g} s leads from hanging to the goal: the best misses it by {nearest:.2g} "
        "times the size of a coordinate; try a stronger motor or wider limits"
    )


def inner_ranges(layout: Layout, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends [d] of the middle share of every coordinate range; infinite ends stay."""
    low, high = layout.limits.position.T
    spare = np.where(np.isfinite(high - low), (1 - share) / 2 * (high - low), 0.0)
    return low + spare, high - spare


def steps_of(upright: Upright, fineness: float = FINENESS) -> int:
    """Returns the number of samples per step of a plan."""
    return max(1, round(upright.layout.rate / (fineness * upright.scales.fall)))


def with_feedback(upright: Upright, plans: Sequence[Plan], numbers: Sequence[Mapping[str, float]]) -> list[TrackedPlan]:
    """Returns plans from hanging with their regulators, each from dimensionless numbers; raises as `lqr`."""
    layout, every, d = upright.layout, steps_of(upright), len(upright.layout.joints)
    step, dt = integrated(_compensated(upright), 1 / layout.rate), 1 / layout.rate
    rest, spread = jnp.asarray(upright.rest), jnp.asarray(spread_of(layout))
    field = field_of(without_friction(upright.model), layout.actuation)
    below = linearise(jax.jit(field), rest, jnp.zeros(len(upright.forces)), tolerance=np.inf)

    @jax.jit
    @jax.vmap
    def along(u: Array, Q: Array, R: Array, S: Array) -> tuple[Array, ...]:
        u = jnp.repeat(u, every, axis=0)
        x = jax.lax.scan(lambda x, u: (step(x, u), x), rest, u)[1]
        F, G = jax.vmap(jax.jacfwd(step, argnums=(0, 1)))(x, u)
        regulators = time_varying_lqr(F, G, dt * Q, dt * R, S)
        level = 9 * jnp.sum(jnp.diagonal(regulators.S[0])[:d] * spread**2)
        return x, u, regulators.K, regulators.S[0], level

    settings = [swing_up_numbers(upright, one) for one in numbers]
    Q, R, S = (
        np.stack(rows)
        for rows in zip(*((one.state_cost, one.control_cost, one.regulator.S) for one in settings), strict=True)
    )
    x, u, K, S, level = map(np.asarray, along(np.stack([plan.u for plan in plans]), Q, R, S))
    return [
        TrackedPlan(x[k], u[k], K[k], S[k], level[k], one.regulator, lqr(below.A, below.B, Q[k], R[k]))
        for k, one in enumerate(settings)
    ]


def follower(upright: Upright, plan: TrackedPlan) -> Controller:
    """Returns the controller of states x that swings up by a plan; the arrays of the plan may be traced."""
    joints, last = upright.layout.joints, len(plan.u)
    angles = np.array([kind == "revolute" for kind in joints])
    plan = jax.tree.map(jnp.asarray, plan)
    rest, friction = jnp.asarray(upright.rest), friction_of(upright)
    hold, wait = (
        regulated(plan.regulator, upright.at.x, upright.at.u, joints),
        regulated(plan.hanging, rest, 0.0, joints),
    )
    begins = value(Regulator(plan.K[0], plan.S), rest, joints)

    def act(number: Array, t: Array, x: Array) -> tuple[Array, Array]:
        level = plan.level * jnp.where(number < READY, CALM, 1.0)
        number = jnp.where((number < 0) & (begins(x) <= level), 0, number)
        k = jnp.clip(number, 0, last - 1)
        off = error(x, jnp.where(number < last, plan.x[k], upright.at.x), joints)
        lost = jnp.max(jnp.abs(off[: len(joints)])[angles]) > LOST
        number = jnp.where(lost & (number >= 0), READY - PATIENCE * last, number)
        u = jnp.where(number < last, plan.u[k] - plan.K[k] @ off, hold(x))
        u = jnp.where(number < 0, wait(x), u) + friction(x)
        return jnp.where(number == READY, number, jnp.minimum(number + 1, last)), u

    return Controller(jnp.asarray(READY), act)


def by_repeated_plans(upright: Upright, numbers: SwingUpNumbers) -> Controller:
    """Returns the controller of states x by repeated plans (`recovery_by_plans`) and the numbers' regulator and level.

    A cost of the distance from the goal on the way keeps plans from delaying. Passive joints may make any number of
    turns. There are three first guesses: no control, and swings that begin to either side.
    """
    layout, fall, every = upright.layout, upright.scales.fall, steps_of(upright, COARSENESS)
    dt, joints, friction = every / layout.rate, layout.joints, friction_of(upright)
    problem = plan_problem(upright, EFFORTS[1], every=every, share=MORE, at_end=LESS_AT_END, soon=SOON)
    t = dt * np.arange(round(HORIZON / fall / dt))
    swings = np.array(SWINGS)[:, None, None] * np.sin(fall * t)[:, None] * upright.forces
    plans = jax.vmap(lambda u: first_plan(problem, jnp.asarray(upright.rest), u))(swings)
    near = regulated(numbers.regulator, upright.at.x, upright.at.u, joints)
    cost = value(numbers.regulator, upright.at.x, joints)
    law = recovery_by_plans(problem, plans, near, cost, numbers.level, rate=layout.rate, every=every)

    def act(memory: Any, t: Array, x: Array) -> tuple[Any, Array]:
        memory, u = law.act(memory, t, x)
        return memory, u + friction(x)

    return Controller(law.start, act)


def _units(upright: Upright) -> np.ndarray:
    return np.concatenate([upright.scales.sizes, upright.scales.sizes * upright.scales.fall])


def _compensated(upright: Upright) -> Field:
    """Returns the field of a plant with friction at the passive joints only; the compensation removes the other
    friction."""
    B = upright.layout.actuation
    driven = (B != 0).any(axis=1)

    def field(x: Array, u: Array) -> Array:
        q, qd = jnp.split(x, 2)
        tau = B @ u + jnp.where(driven, upright.model.friction(q, qd), 0.0)
        return jnp.concatenate([qd, upright.model.forward_dynamics(q, qd, tau)])

    return field
