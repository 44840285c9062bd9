"""A seven-axis arm and a cart-pole in closed loop, by models that may be wrong, and their laws in C.

MuJoCo simulates the tracking arm and the cart-pole, with torques that are limited and one sample late. Only positions
are measured: those of the arm by 14-bit encoders before a 100:1 gear, at 1 kHz.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax import joint_dissipation, tree_system
from dln_jax.control.closed_loop import Hardware, following, outcomes
from dln_jax.control.observers import with_differences
from dln_jax.control.optimal.problem import hjb_policy
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.control.plants.mujoco_plants import simulate_in_mujoco
from dln_jax.control.regulators import regulated
from dln_jax.control.state_space import field_of, integrated
from dln_jax.control.swing_up import USUAL, law_of, swing_up_numbers, upright_of
from dln_jax.control.tracking import Gains, Reference, computed_torque, feed_forward, feedback, judged, trusted
from dln_jax.control.trajectories import TrajectoryProblem, first_plan
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot, compiled_model
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import Split, drawn, every, hold_out, select
from dln_jax.export.c.source import export_c
from dln_jax.learning.dynamics import problem, suited_network
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.friction import fit_friction
from dln_jax.learning.kinematics.fit import fit_tree
from dln_jax.learning.kinematics.search import Search
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import normalised_error
from dln_jax.models.trees import make_serial_tree
from dln_jax.zoo.descriptions import build, describe
from scripts.reports.control import plans
from scripts.reports.control.problems import Sizes, in_jax
from scripts.reports.control.published import cart_pole_on_rail
from scripts.reports.control.swing_ups import desk, model_of
from scripts.reports.robots.arm import DAMPING, MIDDLE, STEP, STIFFNESS, D, Motion, arm, logs, measured, motion
from scripts.reports.run import Numbers
from scripts.reports.speed.exported_c import compiled, evicting, programs, random_network, timed

LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""Torque limits, N m."""
FRICTION = ("viscous", "coulomb", "offset")
COMPUTED, AHEAD = Gains(np.full(D, 400.0), np.full(D, 40.0)), Gains(STIFFNESS, DAMPING)
"""Gains of computed torque, 1/s² and 1/s, and of feed-forward."""
LAB = Hardware(-LIMITS, LIMITS, encoder_step=2 * np.pi / (2**14 * 100), delay=1, sees_rates=False)
DT, RANGE = 0.02, 1.0
"""Time step of plans, s, and limit of joints about the middle, rad."""


def track(robot: Robot, law: Callable[..., Any], wanted: Motion, samples: int) -> float:
    """Rms error along a motion, mrad, NaN for a run that diverges."""
    tracker = following(law, Reference(*(values[:samples] for values in wanted)), rate=1 / STEP)
    controller = with_differences(tracker, D, rate=1 / STEP, cutoff=100.0)
    settings: Any = {"seconds": STEP * samples, "rate": 1 / STEP, "hardware": LAB}
    start = np.append(wanted.q[0], wanted.qd[0])
    run = simulate_in_mujoco(mjcf(robot, time_step=STEP), controller, start, **settings)
    return 1e3 * float(np.sqrt(np.mean(np.square(run.x[:-1, :D] - wanted.q[:samples]))))


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
    return lambda q, qd, qdd: jnp.any((jnp.append(q, qd) < low) | (jnp.append(q, qd) > high))


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
                known = within(few if name == "bad-network" else seen)
                for how, usable in (("trusted", True), ("judged", judged(system, held_out).usable)):
                    law = trusted(system, computed, ahead, out_of_distribution=known, usable=usable)
                    laws[f"{how}/{name}"] = lambda q, qd, now, law=law: law(q, qd, now)[0]
        for name, law in laws.items():
            tracked = [track(robot, law, motion, samples) for motion in wanted]
            runs.setdefault(f"tracking/{name}", []).extend(tracked)
    outcome: dict[str, dict[str, float]] = {name: {"nmse": np.median(values)} for name, values in errors.items()}
    for name, tracked in runs.items():
        rms = np.array(tracked)
        sound = np.append(rms[np.isfinite(rms)], [] if np.isfinite(rms).any() else [np.inf])
        failures = float(np.sum(~np.isfinite(rms)))
        outcome[name] = {"rms_mrad_median": np.median(sound), "rms_mrad_worst": sound.max(), "failures": failures}
    return outcome


def laws_in_c(*, repeats: int = 9, calls: int = 1000, cold: int = 1000) -> Numbers:
    """Times of a call of laws as C: medians of warm calls, and quantiles of cold ones after reading 32 MiB or more."""
    problem, layout = cart_pole_on_rail().problem, desk("furuta").layout
    upright = upright_of(model_of("furuta", "analytic"), layout)
    numbers = swing_up_numbers(upright, USUAL)
    tree, network = dynamics(tree_system(arm(coulomb=False).tree)), value_network(problem, widths=(64, 64), scale=30.0)
    parameters = network.init(jax.random.key(0))
    of_states = {
        "regulator": regulated(numbers.regulator, upright.at.x, upright.at.u, layout.joints),
        "swing_up": law_of(upright, numbers),
        "value_policy": hjb_policy(lambda x: network.value_and_gradient(parameters, x), problem),
    }
    trackers = {
        "tree_feed_forward": feed_forward(tree, AHEAD),
        "tree_computed_torque": computed_torque(tree, COMPUTED),
        "network_computed_torque": computed_torque(dynamics(random_network(D, 32, "f64")), COMPUTED),
    }
    functions: dict[str, Any] = {name: (law, (np.array([0.0, np.pi, 0.0, 0.0]),)) for name, law in of_states.items()}
    for name, law in trackers.items():
        functions[name] = lambda q, qd, *now, law=law: law(q, qd, Reference(*now)), (np.zeros(D),) * 5
    times = {}
    for name, function in functions.items():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / name
            export_c({name: function}, folder, stack=2**21)
            program = programs(folder, compiled(folder, folder), [name])[name]
            spent = timed(program, repeats=repeats, calls=calls, cold=cold, mebibytes=max(evicting(), 32))
        p50, p999 = np.percentile(spent.cold, [50, 99.9]) / 1e3
        times[f"laws/{name}"] = {"warm_us": np.median(spent.hot) / 1e3, "cold_p50_us": p50, "cold_p999_us": p999}
    return times


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
    plan = plans.settling(first, 3e-3)(first_plan(first, x, np.zeros((knots, D))))
    controller, costs = plans.in_c(planned._replace(knots=window(0)), plan, barrier=3e-3, iterations=2)
    act, states, shares, times = controller(plan), [x], [], []
    for k in range(round(seconds / DT)):
        u, spent = act(x, window(k))
        x, share = map(np.asarray, simulated(x, u))
        states.append(x)
        shares.append(share)
        times.append(spent)
    q, wanted = np.stack(states)[:, :D], reference(DT * np.arange(len(states)))[:, :D]
    inside = np.abs(wanted - MIDDLE).max(axis=1) < room
    numbers = {
        **plans.quantiles_ms(times),
        "operations": costs["renew"].operations,
        "stack_bytes": costs["renew"].stack_bytes,
        "reference_beyond_rad": np.abs(wanted - MIDDLE).max() - RANGE,
        "largest_angle_rad": np.abs(q - MIDDLE).max(),
        "largest_torque_share": float(np.max(shares)),
        "rms_mrad": 1e3 * np.sqrt(np.mean((q - wanted)[inside] ** 2)),
    }
    return {"realtime/seven-axis": numbers}


def swung_up(plant: tuple[Any, Any], act: plans.Acting, step, x: np.ndarray, seed: int) -> tuple[np.ndarray, Any]:
    """True states and seconds of calls of one run of 5 s; `step` of the plan's model filters the measurements."""
    mujoco, model = plant
    data, random, tick = mujoco.MjData(model), np.random.default_rng([1, seed]), np.array([2.5e-5, 2 * np.pi / 4096])
    data.qpos[:], data.qvel[:] = np.split(x, 2)
    belief, acting, states, times = x, np.zeros(1), [x], []
    for _ in range(500):
        # The belief is of this sample, before the measurement.
        off = tick * np.round((data.qpos + np.array([1e-4, 1e-3]) * random.normal(size=2)) / tick) - belief[:2]
        belief = belief + np.append(0.5 * off, 0.15 / plans.DT * off)
        belief = np.asarray(step(belief, acting))  # of the sample when the next force will act
        following, seconds = act(belief)
        data.ctrl[:] = acting
        mujoco.mj_step(model, data, 10)
        acting = np.clip(following, -plans.LIMIT, plans.LIMIT)
        times.append(seconds)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.stack(states), times


def on_a_rail(*, runs: int = 100) -> Numbers:
    """Swing-ups within the rail of a MuJoCo cart-pole with dry friction, noise and delay, whose sizes are 5 % wrong."""
    cart, rod, length = 0.8, 0.15, 0.5
    # Without ends of the rail: a cart beyond them is seen.
    plant = compiled_model(f"""<mujoco><option timestep="{plans.DT / 10}" integrator="implicitfast"/>
      <default><geom contype="0" conaffinity="0"/></default><worldbody><body>
      <joint name="rail" type="slide" axis="1 0 0" damping="0.1" frictionloss="0.2"/>
      <geom type="box" size=".05 .04 .03" mass="{cart}"/>
      <body><joint name="hinge" axis="0 1 0" damping="1e-3" frictionloss="5e-4"/>
      <geom type="capsule" fromto="0 0 0 0 0 {length}" size=".01" mass="{rod}"/></body>
    </body></worldbody><actuator><motor joint="rail"/></actuator></mujoco>""")
    known = Sizes(1.05 * cart, rod, 0.95 * length / 2, rod * (0.95 * length) ** 2 / 12)
    planned = in_jax(plans.cart_pole(known, margin=0.03))
    solve, settle = plans.starting(planned), plans.settling(planned, plans.BARRIER)
    still = first_plan(planned, plans.HANGING, np.zeros((plans.STEPS, 1)))
    controller, _ = plans.in_c(planned, still, barrier=plans.BARRIER)
    drawn = np.random.default_rng(0).uniform(-1, 1, (runs, 4)) * [0.2, 0.3, 0.0, 0.0]
    step, states, times = jax.jit(planned.step), [], []
    for seed, x in enumerate(plans.HANGING + drawn):
        motion, spent = swung_up(plant, controller(settle(solve(x))), step, x, seed)
        states.append(motion)
        times.append(spent)
    x = np.stack(states)
    scores, farthest = outcomes(x[..., 1], rate=1 / plans.DT), np.abs(x[..., 0]).max(axis=1)
    numbers = {
        "success_share": np.mean(np.isfinite(scores.seconds) & (farthest <= plans.RAIL)),
        "farthest_m": farthest.max(),
        "seconds_median": scores.median,
        "seconds_worst": scores.worst,
        "p99_ms": plans.quantiles_ms(times)["p99_ms"],
    }
    return {"rail/predictive-control": numbers}
