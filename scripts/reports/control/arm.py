"""A seven-axis arm in closed loop: tracking in MuJoCo by known, identified and learned models, and predictive control.

Torques are limited and one sample of 1 kHz late. Only angles are measured, by 14-bit encoders before a 100:1 gear;
rates are low-passed differences.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import (
    Gains,
    Reference,
    TrajectoryProblem,
    computed_torque,
    feed_forward,
    field_of,
    first_plan,
    improve,
    integrated,
    judged,
    trusted,
    where_finite,
)
from dln_jax.control.state_space import saturated
from dln_jax.control.tracking import feedback
from dln_jax.data.encoders import smooth
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import Split, drawn, every, hold_out, select
from dln_jax.learning.dynamics import problem, suited_network
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.friction import fit_friction
from dln_jax.learning.kinematics import Search, fit_tree
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import tree_system
from dln_jax.metrics.errors import normalised_error
from dln_jax.models.serial_tree import make_serial_tree
from dln_jax.zoo.descriptions import build, describe
from scripts.reports.control.real_time import in_c, of_c, quantiles_ms
from scripts.reports.robots.arm import (
    DAMPING,
    MIDDLE,
    STEP,
    STIFFNESS,
    D,
    Motion,
    arm,
    logs,
    measured,
    motion,
    simulator,
)
from scripts.reports.run import Numbers

LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""Torque limits, N m."""
FRICTION = ("viscous", "coulomb", "offset")
COMPUTED, AHEAD = Gains(np.full(D, 400.0), np.full(D, 40.0)), Gains(STIFFNESS, DAMPING)
"""Gains of computed torque, 1/s² and 1/s, and of feed-forward."""
DT, RANGE = 0.02, 1.0
"""Time step of plans, s, and limit of joints about the middle, rad."""


def track(robot: Robot, law: Callable[..., Any], wanted: Motion, samples: int) -> tuple[float, float]:
    """Rms error along a motion, mrad, NaN for a run that diverges, and the share of samples that used the model."""

    @jax.jit
    def asked(q, qd, now):
        answer = law(q, qd, now)
        tau, usable = answer if isinstance(answer, tuple) else (answer, jnp.asarray(True))
        return saturated(where_finite(tau, q, qd), -LIMITS, LIMITS), usable

    mujoco, model, data = simulator(robot)
    data.qpos[:], data.qvel[:] = wanted.q[0], wanted.qd[0]
    step, share = 2 * np.pi / (2**14 * 100), -np.expm1(-2 * np.pi * 100.0 * STEP)
    qd, before, late, off, used = np.zeros(D), None, None, [], 0
    for number in range(samples):
        seen = step * np.round(data.qpos / step)
        qd = qd if before is None else qd + share * ((seen - before) / STEP - qd)
        before = seen
        tau, usable = asked(seen, qd, Reference(*(values[number] for values in wanted)))
        off.append(data.qpos - wanted.q[number])
        used += bool(usable)
        # Torques act one sample late; the first torque holds the arm at the start.
        data.ctrl[:], late = np.asarray(tau) if late is None else late, np.asarray(tau)
        mujoco.mj_step(model, data)
        if not np.isfinite(data.qpos).all():
            return np.nan, used / (number + 1)
    return 1e3 * float(np.sqrt(np.mean(np.square(off)))), used / samples


def network(robot: Robot, data: Trajectories, seed: int, scale: float, steps: int) -> Dynamics:
    """A structured DeLaN with joint friction and the library's default size for the data, trained by the library."""
    train, validation = hold_out(data, 0.1, seed)
    needs = robot.tree.needs._replace(friction=False, joint_friction=FRICTION, velocity_scale=scale)
    chosen = suited_network(needs, train)
    model = build(describe("structured-delan", precision="f64", needs=needs, **chosen.keywords))
    if chosen.samples is not None:
        train = drawn(train, chosen.samples, seed)
    optimiser = GaussNewton(steps=steps) if chosen.optimizer == "gauss-newton" else Adam(steps=steps * 100)
    training = fit(problem(model, Split(train, validation, validation), seeds=seed), optimiser)
    return dynamics(model.energies(training.parameters))


def within(data: Trajectories) -> Callable[..., Any]:
    """(q, qd, qdd) -> whether an angle or a rate lies outside the range of the data."""
    states = np.concatenate([data.q, data.qd], axis=1)
    low, high = states.min(axis=0), states.max(axis=0)

    def out_of_distribution(q, qd, qdd):
        x = jnp.concatenate([q, qd])
        return jnp.any((x < low) | (x > high))

    return out_of_distribution


def tracking(
    *,
    seeds: int = 3,
    motions: int = 15,
    unseen: int = 2,
    samples: int = 4000,
    steps: int = 30,
    search: Search = Search(seconds=40.0),  # noqa: B008
) -> Numbers:
    """Rms errors by law and model over seeds of the data and unseen motions; failures count separately."""
    from scripts.reports.robots.known_kinematics import DECIMATE, USUAL_SCALE, identified, rough

    robot, errors, runs = arm(coulomb=True), {}, {}
    for seed in range(seeds):
        random, other = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        seen = smooth(from_arrays(measured(logs(robot, random, motions), random))).data
        data = every(seen, DECIMATE)
        scales = fit_friction(rough(robot.tree), data, FRICTION).shape["velocity_scale"]
        scale, needs = float(np.median(scales)), robot.tree.needs._replace(friction=True)
        model, parameters = identified(robot.tree, data, scales)
        fitted = fit_tree(needs, data, velocity_scale=scale, settings=search)
        few = select(seen, np.unique(seen.trajectory)[:3])
        friction = joint_dissipation(robot.damping, robot.coulomb, velocity_scale=USUAL_SCALE)
        models = {
            "known": dynamics(tree_system(robot.tree, friction)),
            "identified": dynamics(model.energies(parameters)),
            "learned-tree": dynamics(make_serial_tree(needs, velocity_scale=scale).energies(fitted.parameters)),
            "network": network(robot, seen, seed, scale, steps),
            "bad-network": network(robot, few, seed, scale, steps),
        }
        wanted, test = [motion(random) for _ in range(unseen)], logs(robot, random, 1)
        held_out = smooth(from_arrays(measured(logs(robot, other, 1), other))).data
        laws: dict[str, Any] = {"feedback-alone": lambda q, qd, now: feedback(AHEAD, q, qd, now)}
        for name, system in models.items():
            tau = np.asarray(jax.jit(jax.vmap(system.inverse_dynamics))(test.q, test.qd, test.qdd))
            errors.setdefault(f"tracking/model/{name}", []).append(np.mean(normalised_error(tau, test.tau)))
            ahead, computed = feed_forward(system, AHEAD), computed_torque(system, COMPUTED)
            laws |= {f"feed-forward/{name}": ahead, f"computed-torque/{name}": computed}
            if name.endswith("network"):
                settings: Any = {"out_of_distribution": within(few if name == "bad-network" else seen)}
                laws[f"trusted/{name}"] = trusted(system, computed, ahead, **settings)
                usable = judged(system, held_out).usable
                laws[f"judged/{name}"] = trusted(system, computed, ahead, **settings, usable=usable)
        for name, law in laws.items():
            tracked = [track(robot, law, motion, samples) for motion in wanted]
            runs.setdefault(f"tracking/{name}", []).extend(tracked)
    outcome: dict[str, dict[str, float]] = {name: {"nmse": np.median(values)} for name, values in errors.items()}
    for name, tracked in runs.items():
        rms, share = np.array(tracked).T
        sound = rms[np.isfinite(rms)] if np.isfinite(rms).any() else np.array([np.inf])
        outcome[name] = {"rms_mrad_median": np.median(sound), "rms_mrad_worst": sound.max()}
        outcome[name]["failures"] = float(np.sum(~np.isfinite(rms)))
        if "trusted" in name or "judged" in name:
            outcome[name]["share_trusted"] = np.mean(share)
    return outcome


def reference(t) -> np.ndarray:
    """q and qd [..., 14] at times, from rest in the middle; two joints leave their range."""
    t = np.asarray(t, float)[..., None]
    amplitudes = np.array([0.9, 1.15, 0.9, 0.9, 1.2, 0.9, 0.9])
    frequencies = np.array([1.5, 1.2, 1.6, 1.4, 1.8, 2.0, 2.1])
    rise, slope = 1 - np.exp(-(t**2)), 2 * t * np.exp(-(t**2))
    s, c = np.sin(frequencies * t), np.cos(frequencies * t)
    return np.concatenate([MIDDLE + amplitudes * rise * s, amplitudes * (slope * s + rise * frequencies * c)], axis=-1)


def beyond_limits(*, knots: int = 10, seconds: float = 8.0) -> Numbers:
    """Predictive control in C of a reference that leaves the range of two joints: times, use of limits, and errors.

    Controls are accelerations; the torques of the known tree are constraints. From the end of a plan the joints must
    stay within their limits for 0.2 s more, or a short plan ends at a speed that cannot be braked.
    """
    plant, room, fine = dynamics(tree_system(arm(coulomb=False).tree)), RANGE - 0.03, 20
    torque = lambda x, u: plant.inverse_dynamics(x[:D], x[D:], u)  # noqa: E731

    def off(x, wanted):
        return 100 * jnp.sum((x[:D] - wanted[:D]) ** 2) + jnp.sum((x[D:] - wanted[D:]) ** 2)

    def beyond(x, u, wanted):
        share = torque(x, u) / (0.95 * LIMITS)
        return jnp.concatenate([share - 1, -share - 1])

    def stopping(x, wanted):
        ahead = x[:D] + 0.2 * x[D:] - MIDDLE
        return jnp.concatenate([ahead, -ahead]) - room

    move = integrated(field_of(plant, np.eye(D)), DT / fine)

    @jax.jit
    def simulated(x, u):
        def step(x, _):
            tau = jnp.clip(torque(x, u), -LIMITS, LIMITS)
            return move(x, tau), jnp.abs(tau) / LIMITS

        x, share = jax.lax.scan(step, x, length=fine)
        return x, jnp.max(share)

    window = lambda k: reference(DT * (k + np.arange(knots + 2)))  # noqa: E731
    planned = TrajectoryProblem(
        lambda x, u, wanted: jnp.concatenate([x[:D] + DT * x[D:] + DT**2 / 2 * u, x[D:] + DT * u]),
        lambda x, u, wanted: DT * (off(x, wanted) + 1e-4 * u @ u),
        lambda x, wanted: 0.2 * off(x, wanted),
        -100.0,
        100.0,
        np.append(MIDDLE - room, np.full(D, -2.5)),
        np.append(MIDDLE + room, np.full(D, 2.5)),
        path=beyond,
        end_below=stopping,
        soft=(100.0, 1000.0),
    )
    x, first = reference(0.0), planned._replace(knots=window(0)[:-1])
    plan, settle = first_plan(first, x, np.zeros((knots, D))), jax.jit(lambda plan: improve(first, plan, barrier=3e-3))
    for _ in range(10):
        plan = settle(plan)
    functions, costs = in_c(planned._replace(knots=window(0)), plan, barrier=3e-3, iterations=2)
    act, states, shares, times = of_c(functions, plan), [x], [], []
    for k in range(round(seconds / DT)):
        u, spent = act(x, window(k))
        x, share = map(np.asarray, simulated(x, u))
        states.append(x)
        shares.append(share)
        times.append(spent)
    q, wanted = np.stack(states)[:, :D], reference(DT * np.arange(len(states)))[:, :D]
    inside = np.abs(wanted - MIDDLE).max(axis=1) < room
    numbers = {
        **quantiles_ms(times),
        "operations": costs["renew"].operations,
        "stack_bytes": costs["renew"].stack_bytes,
        "reference_beyond_rad": np.abs(wanted - MIDDLE).max() - RANGE,
        "largest_angle_rad": np.abs(q - MIDDLE).max(),
        "largest_torque_share": float(np.max(shares)),
        "rms_mrad": 1e3 * np.sqrt(np.mean((q - wanted)[inside] ** 2)),
    }
    return {"realtime/seven-axis": numbers}
