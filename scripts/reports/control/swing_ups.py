"""Swing-ups of poles of desktop size by known and learned models, and of two links of a public board by plans.

The poles have dry friction, encoders as their only sensors, noise and a sample of delay. The board (Wiebe et al. 2022,
"RealAIGym") simulates ten seconds by the classical Runge-Kutta method at 500 Hz, from hanging at rest. Its plans are
chosen by its score, since the plant is known.
"""

import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.commands.learned_plants import SECONDS, file_of, fit_of, learn_to_swing_up, try_plant
from dln_jax.commands.learned_plants import model_of as identified_model
from dln_jax.control.closed_loop import ClosedLoopRun, Controller, Hardware, hanging_starts, outcomes, simulate
from dln_jax.control.estimate.tuning import from_log
from dln_jax.control.observers import by_differences, by_filter
from dln_jax.control.plants.exploring import Exploration, explore
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.plant import Plant
from dln_jax.control.plants.tuning import tune
from dln_jax.control.regulators import sampled_lqr
from dln_jax.control.shooting import shoot
from dln_jax.control.state_space import error, field_of, integrated, linearise, saturated
from dln_jax.control.swing_up import USUAL, law_of, swing_up_numbers, upright_of
from dln_jax.control.trajectories import Plan, TrajectoryProblem
from dln_jax.data.schema import Trajectories
from dln_jax.learning.recordings import FittedPlant, PreparedRecording, prepare
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import Links, two_link_pendulum
from dln_jax.types import InputError
from scripts.reports.run import Numbers

TURN = 2 * np.pi / 2048
STEPS = {"cart-pole": np.array([2.3e-5, TURN]), "furuta": np.array([TURN, TURN])}
"""Resolutions of the encoders, m and rad."""
NOISE = 0.005
"""Standard deviation of the motors' noise, as a share of their limits."""
RATE, LIMIT = 500.0, 6.0
"""Sampling rate of the board, Hz, and its torque limit, N m."""
HEIGHT = 0.9
"""Height of the tip above the shoulder that counts as up, relative to the stretched length."""
GOAL = np.array([np.pi, 0.0, 0.0, 0.0])
SIZES = {"time": 20.0, "energy": 60.0, "torque_cost": 20.0, "smoothness": 0.1, "velocity_cost": 400.0}
"""Sizes of the criteria in the board's score."""
EVERY = 10
"""Samples of the board per step of a plan."""
Motor = Literal["elbow", "shoulder"]


def desk(plant: str, *, seed: int = 0) -> Plant:
    """A desktop plant of the library."""
    noise = NOISE * mujoco_plant(file_of(plant)).layout.limits.control[:, 1]
    hardware = Hardware(encoder_step=STEPS[plant], control_noise=noise, delay=1)
    return mujoco_plant(file_of(plant), hardware=hardware, seed=seed)


def model_of(plant: str, name: str, prepared: PreparedRecording | None = None) -> Dynamics:
    """A model of a desktop plant by its name, from a recording or from its file."""
    return fit_of(name, file_of(plant), desk(plant).layout)(prepared).dynamics  # type: ignore[arg-type]


def recorded(plant: str, *, seed: int, settings: Exploration = Exploration()) -> Trajectories:  # noqa: B008
    """An exploration of a desktop plant of 30 s."""
    made = desk(plant, seed=seed)

    return explore(made, identified_model, settings, seed=seed).recording


def by_model(*, plant: str, model: str, seeds: int = 3, starts: int = 100) -> Numbers:
    """Swing-ups by models of several recordings of 30 s, each with starts of its own, and errors on unseen motions."""
    tries, errors, spent = [], [], []
    truth = model_of(plant, "known")
    for seed in range(seeds):
        fit = fit_of(model, file_of(plant), desk(plant).layout, seed)
        try:
            learned = learn_to_swing_up(desk(plant, seed=seed), fit=fit, seed=seed)
        except InputError as refusal:  # all starts fail
            print(refusal, flush=True)
            tries.append(np.full(starts, np.inf))
            continue
        spent.append(learned.seconds)
        tries.append(try_plant(functools.partial(desk, plant), learned.law, starts=starts)[0].seconds)
        blind = Exploration(seconds=12.0, blind=(0.4, 0.8), surplus=())
        errors.append(errors_at(truth, learned.fitted, recorded(plant, seed=500 + seed, settings=blind)))
    up = [seconds[np.isfinite(seconds)] for seconds in tries]
    numbers = {
        "success_share": min(np.isfinite(seconds).mean() for seconds in tries),
        "seconds_median": np.median(np.concatenate(up)),
        "seconds_worst": max(np.max(seconds, initial=0.0) for seconds in up),
        "learning_seconds_median": np.median(spent),
    }
    for name, values in zip(("torque", "acceleration"), np.array(errors).T, strict=True):
        numbers |= {f"{name}_nmse_median": np.median(values), f"{name}_nmse_worst": values.max()}
    return {f"{'swing-up' if model == 'known' else 'learned'}/{plant}/{model}": numbers}


def errors_at(truth: Dynamics, fitted: FittedPlant, motions: Trajectories) -> tuple[float, float]:
    """Normalised errors of a model's torques and accelerations at the states of a recording.

    They are sums of squared errors over sums of squares of the truth.
    """
    data, model = prepare(motions, chain=True).train, fitted.dynamics

    def squares(q, qd, qdd, tau):
        torque, acceleration = truth.inverse_dynamics(q, qd, qdd), truth.forward_dynamics(q, qd, tau)
        off = model.inverse_dynamics(q, qd, qdd) - torque, model.forward_dynamics(q, qd, tau) - acceleration
        return tuple(jnp.sum(array**2) for array in (*off, torque, acceleration))

    sums = [float(np.sum(part)) for part in jax.jit(jax.vmap(squares))(data.q, data.qd, data.qdd, data.tau)]
    return sums[0] / sums[2], sums[1] / sums[3]


def anywhere(*, plant: str, starts: int = 1000) -> Numbers:
    """Starts over the pole's phase plane that are up after ten seconds; the plant's own model simulates it."""
    truth, made = model_of(plant, "known"), desk(plant)
    lower, upper = made.layout.limits.control.T
    noise = Hardware(lower, upper, STEPS[plant], 0.0, NOISE * upper, 1, sees_rates=False)
    law = tune(truth, made.layout, noise).controller
    random, x = np.random.default_rng(1), np.zeros((starts, 4))
    x[:, 1], x[:, 3] = random.uniform(-np.pi, np.pi, starts), random.uniform(-15.0, 15.0, starts)
    field, rate = field_of(truth, made.layout.actuation), made.layout.rate

    @jax.jit
    @jax.vmap
    def run(x, key):
        motion = simulate(
            field, law, x, seconds=SECONDS, rate=rate, controls=1, hardware=noise, key=key, substeps=2
        )  # fmt: skip
        return motion.x[:, :2]

    q = np.asarray(run(x, jax.random.split(jax.random.key(0), starts)))
    result = outcomes(q[..., 1], rate=rate)
    numbers = {
        "success_share": result.share,
        "no_number": float(result.failed.sum()),
        "seconds_median": result.median,
        "seconds_worst": result.worst,
        "farthest": np.abs(q[..., 0]).max(),
    }
    return {f"starts/{plant}/known": numbers}


def estimates(*, plant: str, model: str, starts: int = 100) -> Numbers:
    """Commanded torques at the goal, with rates by differences, by filters tuned on 30 s of exploration, and exactly.

    The exact state is that of the time when a control acts.
    """
    measured, differences = {}, np.nan
    truth, layout, recording = model_of(plant, "known"), desk(plant).layout, recorded(plant, seed=0)
    lower, upper = layout.limits.control.T
    hardware = Hardware(lower, upper, STEPS[plant], 0.0, NOISE * upper, 1, sees_rates=False)
    last, field = round(2.0 * layout.rate), field_of(truth, layout.actuation)
    system = model_of(plant, model, prepare(recording, chain=True))
    process = from_log(system, recording, actuation=layout.actuation, delay=1)
    upright = upright_of(system, layout)
    law, step = law_of(upright, swing_up_numbers(upright, USUAL)), integrated(field, 1 / layout.rate, substeps=2)

    def foreseeing(law):
        def act(u, t, x):
            u = saturated(law(step(x, u)), lower, upper)
            return u, u

        return Controller(jnp.zeros(1), act)

    def trial(controller, hardware):
        settings: Any = {"rate": layout.rate, "substeps": 2, "controls": 1, "hardware": hardware}

        def one(x, key):
            run = simulate(field, controller, x, seconds=SECONDS, key=key, **settings)
            # Controls that acted have the motor's noise; those that were commanded are computed again.
            again = lambda memory, row: controller.act(memory, *row)  # noqa: E731
            u = saturated(jax.lax.scan(again, controller.start, (run.t[:-1], run.y))[1][-last:, 0], lower, upper)
            flips = jnp.sum(jnp.sign(u[1:]) * jnp.sign(u[:-1]) < 0) / 2.0
            return run.x[:, 1], jnp.sqrt(jnp.mean(u**2)), jnp.sqrt(jnp.mean(jnp.diff(u) ** 2)), flips

        return jax.jit(jax.vmap(one))

    estimators: dict[str, Callable[..., Controller]] = {
        "differences": by_differences(layout),
        "extended": by_filter(layout, process, delay=1),
        "unscented": by_filter(layout, process._replace(unscented=True), delay=1),
        "exact-state": foreseeing,
    }
    x, keys = hanging_starts(starts, 0, position=0.02), jax.random.split(jax.random.key(0), starts)
    for name, estimator in estimators.items():
        seen = {"encoder_step": 0.0, "sees_rates": True} if name == "exact-state" else {}
        angle, *of_torque = trial(estimator(law), hardware._replace(**seen))(x, keys)
        rms, change, flips = (float(np.median(values)) for values in of_torque)
        differences = rms if name == "differences" else differences
        measured[f"estimates/{plant}/{model}/{name}"] = {
            "success_share": outcomes(angle, rate=layout.rate).share,
            "torque_rms": rms,
            "torque_rms_ratio": rms / differences,
            "torque_change_rms": change,
            "reversals_per_second": flips,
        }
    return measured


def criteria(motor: Motor, run: ClosedLoopRun) -> dict[str, float]:
    """The board's criteria of a run in SI units; smaller is better. The time is infinite if the tip does not end up."""
    q, qd = np.split(np.asarray(run.x), 2, axis=1)
    u = np.asarray(run.u)[:, 0]
    inner, outer = Links().lengths
    up = -inner * np.cos(q[:, 0]) - outer * np.cos(q.sum(axis=1)) > HEIGHT * (inner + outer)
    stays = len(up) - np.argmin(up[::-1]) if not up.all() else 0
    return {
        "time": stays / RATE if up[-1] else np.inf,
        "energy": float(np.sum(np.abs(np.diff(q[:, int(motor == "elbow")]) * u))),
        "torque_cost": float(np.sum(u**2) / RATE),
        "smoothness": float(np.std(np.diff(u))),
        "velocity_cost": float(np.sum(qd**2) / RATE),
    }


def score(numbers: Mapping[str, float]) -> float:
    """Score of version 2, from 0 to 1: 1 - mean of tanh(pi criterion / size); 0 if a criterion is not finite."""
    if not np.isfinite(list(numbers.values())).all():
        return 0.0
    return 1 - float(np.mean([np.tanh(np.pi * numbers[name] / size) for name, size in SIZES.items()]))


def plan_of(motor: Motor, guess, slope_weight: float) -> Plan:
    """Optimises (q, qd, tau), with the torque's slope as control [N, 1], so that the cost can favour smooth torques."""
    scene, dt = two_link_pendulum(motor), 1.0 / RATE
    move = integrated(field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation)), dt)

    def step(state, slope):
        # As on the board, the torque is constant over a sample.
        sample = lambda _, state: jnp.append(move(state[:4], state[4:]), state[4] + dt * slope)  # noqa: E731
        return jax.lax.fori_loop(0, EVERY, sample, state)

    def cost(state, slope):
        tau, over = state[4], jnp.maximum(jnp.abs(state[4]) - 0.9 * LIMIT, 0.0)
        running = 0.3 * tau**2 + 0.01 * jnp.sum(state[2:4] ** 2) + slope_weight * slope[0] ** 2 + 100.0 * over**2
        return EVERY * dt * running

    def final_cost(state):
        return jnp.array([300.0, 300.0, 30.0, 30.0, 3.0]) @ (state - jnp.append(jnp.asarray(GOAL), 0.0)) ** 2

    problem = TrajectoryProblem(step, cost, final_cost)
    return shoot(problem, np.zeros(5), None, guess, method="single", iterations=300).plan


def following(motor: Motor) -> Callable[[Plan], Controller]:
    """Returns plan -> feedback about it, followed by a regulator about the goal, which needs no torque."""
    scene, dt = two_link_pendulum(motor), 1.0 / RATE
    at = linearise(field_of(dynamics(scene.closed_form), np.asarray(scene.needs.actuation)), GOAL, np.zeros(1))
    K = sampled_lqr(at.A, at.B, np.diag([10.0, 10.0, 1.0, 1.0]), np.eye(1), dt).K[0]

    def act(memory, t, y):
        plan, number, tau, slope = memory
        index = jnp.minimum(number // EVERY, len(plan.u) - 1)
        corrected = plan.u[index, 0] + plan.K[index, 0] @ (jnp.append(y, tau) - plan.x[index])
        slope = jnp.where(number % EVERY == 0, corrected, slope)
        u = jnp.where(number >= EVERY * len(plan.u), -K @ error(y, jnp.asarray(GOAL), scene.needs.joints), tau)
        return (plan, number + 1, tau + dt * slope, slope), u[None]

    return lambda plan: Controller((plan, jnp.asarray(0), jnp.asarray(0.0), jnp.asarray(0.0)), act)


def board_run(motor: Motor, controller: Controller, seconds: float = SECONDS) -> ClosedLoopRun:
    """A run with the board's settings."""
    scene, lab = two_link_pendulum(motor), Hardware(-LIMIT, LIMIT)
    field = field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation))
    return simulate(field, controller, np.zeros(4), seconds=seconds, rate=RATE, controls=1, hardware=lab)


def planned(
    *,
    motor: Motor,
    horizons: tuple[float, ...] = (1.5, 1.6, 1.8, 2.0),
    slope_weights: tuple[float, ...] = (1e-3, 3e-3),
    guesses: int = 3,
) -> Numbers:
    """The best score of plans over horizons, s, weights of the torque's slope and random guesses."""
    tried, follower = [], following(motor)
    simulated = jax.jit(lambda plan: board_run(motor, follower(plan)))
    for weight, seconds in itertools.product(slope_weights, horizons):
        solve = jax.jit(lambda guess, weight=weight: plan_of(motor, guess, weight))
        for seed in range(guesses):
            plan = solve(10.0 * np.random.default_rng(seed).normal(size=(round(seconds * RATE / EVERY), 1)))
            numbers = criteria(motor, simulated(plan))
            tried.append({"score": score(numbers), **numbers})
    return {f"board/{two_link_pendulum(motor).name}/planned": max(tried, key=lambda numbers: numbers["score"])}
