"""A seven-axis arm that tracks a reference beyond its limits, by predictive control in C with 10 knots.

Controls are accelerations, so that steps are linear; torques, from the inverse dynamics of the known tree, are
constraints that depend on the state. Knots carry the reference. Between samples of 20 ms, computed torque at 1 kHz
applies the acceleration. The reference leaves the range of two joints.
"""

import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import TrajectoryProblem, field_of, first_plan, improve, integrated
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import tree_system
from scripts.reports.case import Findings
from scripts.reports.control.arm_loop import LIMITS
from scripts.reports.control.real_time import SETTLING, in_c, of_c
from scripts.reports.robots.arm import MIDDLE, D, arm
from scripts.reports.rows import Row, expect

KNOTS, DT, FINE, SECONDS, TO_REACH_MS = 10, 0.02, 20, 8.0, 1.0
"""Steps of the horizon, their duration, s, torques per step, and the run, s."""
RANGE, MARGIN, SPEED, ACCELERATION = 1.0, 0.03, 2.5, 100.0
"""Limits of joints about the middle, what plans keep of them, rad, speeds and accelerations."""
SHARE = 0.95
"""Share of the motors' torques that may be used."""
BARRIER, PRICES, ITERATIONS = 3e-3, (100.0, 1000.0), 2
STOPPING = 0.2
"""Time ahead for which the rates at the end of a plan must not lead out of the joints' limits, s: without it, a plan of
0.2 s drives up to a limit at a speed that cannot be braked."""
AMPLITUDES = np.array([0.9, 1.15, 0.9, 0.9, 1.2, 0.9, 0.9])
FREQUENCIES = np.array([1.5, 1.2, 1.6, 1.4, 1.8, 2.0, 2.1])


def reference(t: Any) -> np.ndarray:
    """q and qd [..., 14] at times; it begins at rest in the middle."""
    t = np.asarray(t, float)[..., None]
    rise, slope = 1 - np.exp(-(t**2)), 2 * t * np.exp(-(t**2))
    s, c = np.sin(FREQUENCIES * t), np.cos(FREQUENCIES * t)
    return np.concatenate([MIDDLE + AMPLITUDES * rise * s, AMPLITUDES * (slope * s + rise * FREQUENCIES * c)], axis=-1)


def problem_of(torque: Any) -> TrajectoryProblem:
    """Tracking with limits of joints, speeds and torques; `torque` is (x, qdd) -> tau."""

    def step(x: Array, u: Array, wanted: Array) -> Array:
        return jnp.concatenate([x[:D] + DT * x[D:] + DT**2 / 2 * u, x[D:] + DT * u])

    def off(x: Array, wanted: Array) -> Array:
        return 100 * jnp.sum((x[:D] - wanted[:D]) ** 2) + jnp.sum((x[D:] - wanted[D:]) ** 2)

    def beyond(x: Array, u: Array, wanted: Array) -> Array:
        share = torque(x, u) / (SHARE * LIMITS)
        return jnp.concatenate([share - 1, -share - 1])

    def stopping(x: Array, wanted: Array) -> Array:
        ahead = x[:D] + STOPPING * x[D:] - MIDDLE
        return jnp.concatenate([ahead, -ahead]) - (RANGE - MARGIN)

    low, high = (np.append(MIDDLE + side * (RANGE - MARGIN), np.full(D, side * SPEED)) for side in (-1, 1))
    return TrajectoryProblem(
        step, lambda x, u, wanted: DT * (off(x, wanted) + 1e-4 * u @ u), lambda x, wanted: 0.2 * off(x, wanted),
        -ACCELERATION, ACCELERATION, low, high, path=beyond, end_below=stopping, soft=PRICES,
    )  # fmt: skip


def seven_axis_report(quick: bool) -> Findings:
    """Times of calls in C, the largest use of all limits, and the error where the reference is within the limits."""
    plant = dynamics(tree_system(arm(coulomb=False).tree))
    torque = lambda x, u: plant.inverse_dynamics(x[:D], x[D:], u)  # noqa: E731
    move = integrated(field_of(plant, np.eye(D)), DT / FINE)

    @jax.jit
    def simulated(x: Array, u: Array) -> tuple[Array, Array]:
        def step(x: Array, _: None) -> tuple[Array, Array]:
            tau = jnp.clip(torque(x, u), -LIMITS, LIMITS)
            return move(x, tau), jnp.abs(tau) / LIMITS

        x, share = jax.lax.scan(step, x, length=FINE)
        return x, jnp.max(share, axis=0)

    window = lambda k: reference(DT * (k + np.arange(KNOTS + 2)))  # noqa: E731
    problem, x = problem_of(torque), reference(0.0)
    first = problem._replace(knots=window(0)[:-1])
    plan = first_plan(first, x, np.zeros((KNOTS, D)))
    settle = jax.jit(lambda plan: improve(first, plan, barrier=BARRIER))
    for _ in range(SETTLING):
        plan = settle(plan)
    with tempfile.TemporaryDirectory() as place:
        functions, efforts = in_c(problem._replace(knots=window(0)), plan, Path(place) / "arm", barrier=BARRIER,
                                    iterations=ITERATIONS)  # fmt: skip
    act, states, shares, times = of_c(functions, plan), [x], [], []
    for k in range(round((1.0 if quick else SECONDS) / DT)):
        u, seconds = act(x, window(k))
        x, share = (np.asarray(array) for array in simulated(x, u))
        states.append(x)
        shares.append(share)
        times.append(1e3 * seconds)
    q, wanted = np.stack(states)[:, :D], reference(DT * np.arange(len(states)))[:, :D]
    inside = np.abs(wanted - MIDDLE).max(axis=1) < RANGE - MARGIN
    p50, p99, worst = np.percentile(times, [50, 99, 100])
    case, words = "realtime/seven-axis", f"of {len(times)} calls, CPU"
    return Findings([
        Row(case, "p50_ms", float(p50), "ms", expected=words),
        expect(case, "p99_ms", words, p99, TO_REACH_MS, "ms"),
        Row(case, "worst_ms", float(worst), "ms"),
        Row(case, "operations", efforts["renew"].operations, expected="floating-point, of a call"),
        Row(case, "stack_bytes", efforts["renew"].stack_bytes, "B"),
        Row(case, "reference_beyond_rad", float(np.abs(wanted - MIDDLE).max() - RANGE), "rad"),
        expect(case, "largest_angle_rad", "about the middle", np.abs(q - MIDDLE).max(), RANGE, "rad"),
        Row(case, "largest_torque_share", float(np.max(shares)), expected=f"plans use up to {SHARE}"),
        Row(case, "rms_mrad", 1e3 * float(np.sqrt(np.mean((q - wanted)[inside] ** 2))), "mrad",
            expected="where the reference is within the joints' limits"),
    ])  # fmt: skip
