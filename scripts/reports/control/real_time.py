"""Predictive control with constraints in C: a cart-pole between walls, beside IPOPT, fatrop and HPIPM, and in MuJoCo.

The plant of Lutter et al. 2021 (arXiv 2105.04682), 12 N, rail of +-0.5 m, 100 Hz, a horizon of 1.2 s in 120 steps. All
controllers start with the plan of `shoot` from the start at rest. Times are CPU times of a call in this process.
"""

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import (
    Plan,
    TrajectoryProblem,
    feedback,
    first_plan,
    improve,
    integrated,
    prepare,
    shoot,
    time_varying_lqr,
)
from dln_jax.control.closed_loop import outcomes
from dln_jax.data.robots import compiled_model
from dln_jax.export.c.interface import Cost, stated_costs
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from scripts.reports.control.problems import Planned, Sizes, cart_pole_rates, in_jax
from scripts.reports.rivals.optimal_control import Controller, hpipm, to_the_end, unknowns_of
from scripts.reports.run import Numbers

DT, STEPS, LIMIT, RAIL = 0.01, 120, 12.0, 0.5
"""Sample, s, steps of the horizon, force limit, N, and half the rail, m."""
BARRIER, HANGING = 1e-4, np.array([0.0, np.pi, 0.0, 0.0])


def roots(f, x, u) -> list[Any]:
    """Roots of the cost's terms; 2 (1 - cos) = 4 sin² of half the angle."""
    weight = np.sqrt(20.0 if u is None else DT)
    terms = [2.0 * x[0], 2 * f.sin(x[1] / 2), np.sqrt(0.1) * x[2], np.sqrt(0.01) * x[3]]
    return [weight * term for term in (terms if u is None else [*terms, np.sqrt(1e-3) * u[0]])]


def cart_pole(sizes: Sizes = Sizes(), *, margin: float = 0.02, limit: float = LIMIT) -> Planned:  # noqa: B008
    """The problem; plans keep a margin from the ends of the rail, m."""
    wall, cost = np.array([RAIL - margin, *[np.inf] * 3]), lambda f, x, u: sum(root**2 for root in roots(f, x, u))
    rates, goal = cart_pole_rates(sizes), (0.0,) * 4
    return Planned("cart-pole", tuple(HANGING), goal, STEPS, rates, DT, 1, cost, (limit,), -wall, wall, roots=roots)


def starting(problem: TrajectoryProblem, steps: int = STEPS) -> tuple[Callable[[Any], Plan], Callable[[Plan], Plan]]:
    """Returns start -> plan of `shoot` from straight lines to both sides, and plan -> plan after ten iterations."""
    line, other = (np.linspace(HANGING, [0, angle, 0, 0], steps + 1) for angle in (0.0, 2 * np.pi))
    still = np.zeros((steps, 1))
    solve = lambda x: shoot(problem, x, line, still, starts=(other[None], still[None])).plan  # noqa: E731
    settle = lambda plan: jax.lax.fori_loop(0, 10, lambda _, plan: improve(problem, plan, barrier=BARRIER), plan)  # noqa: E731
    return jax.jit(solve), jax.jit(settle)


def in_c(problem: TrajectoryProblem, plan: Plan, **settings) -> tuple[Any, Mapping[str, Cost]]:
    """`feedback` and `prepare` as compiled C, with settings of the latter, and the costs of their calls."""

    def respond(x, u, states, gains):
        return feedback(problem, plan._replace(u=u, x=states, K=gains), x)

    def renew(x, u, states, gains, damping, *knots):
        now = problem._replace(knots=knots[0]) if knots else problem
        after = prepare(now, plan._replace(u=u, x=states, K=gains, damping=damping), x, **settings)
        return {"controls": after.u, "next": after.x, "feedback": after.K, "size": after.damping}

    knots = () if problem.knots is None else (problem.knots,)
    examples = tuple(map(np.asarray, (plan.x[0], plan.u, plan.x, plan.K, plan.damping, *knots)))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "plan"
        export_c({"respond": (respond, examples[:4]), "renew": (renew, examples)}, folder, stack=2**21)
        return load_c(folder), stated_costs(folder)


def of_c(functions, plan: Plan) -> Callable[..., tuple[np.ndarray, float]]:
    """The controller in C: its memory is the plan."""
    memory = [np.asarray(array) for array in (plan.u, plan.x, plan.K, plan.damping)]

    def act(x, *knots):
        began = time.thread_time_ns()
        u = functions.respond(x, *memory[:3])
        after = functions.renew(x, *memory[:3], float(memory[3]), *knots)
        seconds = (time.thread_time_ns() - began) / 1e9
        memory[:] = after.controls, after.next, after.feedback, after.size
        return np.atleast_1d(u), seconds

    return act


def quantiles_ms(seconds) -> dict[str, float]:
    """Median, 99th percentile and worst of some times."""
    values = 1e3 * np.percentile(np.ravel(seconds), [50, 99, 100])
    return dict(zip(("p50_ms", "p99_ms", "worst_ms"), values, strict=True))


def beside_rivals(*, loops: int = 10, rival_loops: int = 2) -> Numbers:
    """Times, closed-loop costs and largest positions of all controllers, in 2.5 s of a finer simulation."""
    planned = cart_pole()
    problem = in_jax(planned)
    solve, settle = starting(problem)
    finer = jax.jit(integrated(lambda x, u: jnp.stack(planned.rates(jnp, x, u)), DT, substeps=4))
    functions, costs = in_c(problem, first_plan(problem, HANGING, np.zeros((STEPS, 1))), barrier=BARRIER)
    controllers: dict[str, Callable[[Plan], Controller]] = {
        "c": lambda plan: of_c(functions, settle(plan)),
        "ipopt": lambda plan: to_the_end("ipopt", planned, unknowns_of(plan.x, plan.u)),
        "fatrop": lambda plan: to_the_end("fatrop", planned, unknowns_of(plan.x, plan.u)),
        "hpipm": lambda plan: hpipm(planned, unknowns_of(plan.x, plan.u)),
    }
    # As in the published evaluation.
    drawn = np.random.default_rng(0).normal(size=(loops, 4)) * np.sqrt([1e-3, 5e-2, 1e-6, 1e-6]) + HANGING
    measured: dict[str, dict[str, float]] = {}
    for name, make in controllers.items():
        states, paid, times = [], [], []
        for x in drawn if name == "c" else drawn[:rival_loops]:
            act, run, cost = make(solve(x)), [x], 0.0
            for _ in range(250):
                u, seconds = act(x)
                cost += float(planned.cost(np, x, u))
                x = np.asarray(finer(x, u))
                run.append(x)
                times.append(seconds)
            states.append(run)
            paid.append(cost)
        x = np.array(states)
        measured[f"realtime/cart-pole/{name}"] = {
            **quantiles_ms(times),
            "up_share": np.mean(np.all(np.cos(x[:, -20:, 1]) > np.cos(0.1), axis=1)),
            "closed_loop_cost_mean": np.mean(paid),
            "first_starts_cost_mean": np.mean(paid[:rival_loops]),
            "largest_position": np.abs(x[..., 0]).max(),
        }
    for name, cost in costs.items():
        measured[f"realtime/cart-pole/c-{name}"] = {"operations": cost.operations, "stack_bytes": cost.stack_bytes}
    return measured


def with_gains(problem: TrajectoryProblem) -> Callable[[Plan], Plan]:
    """Returns plan -> plan with the gains of regulators along it, which do not know the limits."""
    Q, R = np.diag([4.0, 1.0, 0.1, 0.01]) * DT, np.eye(1) * 1e-3 * DT

    @jax.jit
    def regulated(plan):
        A, B = jax.vmap(jax.jacfwd(problem.step, argnums=(0, 1)))(plan.x[:-1], plan.u)
        return plan._replace(K=-time_varying_lqr(A, B, Q, R, 2000 * Q).K)

    return regulated


def along(plan: Plan, top: Plan) -> Controller:
    """The plan with its gains, then the gain of a plan that stands upright."""
    u, about, K = (np.asarray(array) for array in (plan.u, plan.x, plan.K))
    hold, number = np.asarray(top.K[0]), iter(range(10**6))

    def act(x):
        if (k := next(number)) < len(u):
            return u[k] + K[k] @ (x - about[k]), 0.0
        return hold @ (x - [0, 2 * np.pi * np.round(x[1] / (2 * np.pi)), 0, 0]), 0.0

    return act


def swung_up(plant: tuple[Any, Any], act: Controller, step, x: np.ndarray, seed: int) -> tuple[np.ndarray, Any]:
    """True states and seconds of calls of one run of 5 s; `step` of the plan's model filters the measurements."""
    mujoco, model = plant
    data, random, tick = mujoco.MjData(model), np.random.default_rng([1, seed]), np.array([2.5e-5, 2 * np.pi / 4096])
    data.qpos[:], data.qvel[:] = np.split(x, 2)
    belief, acting, states, times = x, np.zeros(1), [x], []
    for _ in range(500):
        # The belief is of this sample, before the measurement.
        off = tick * np.round((data.qpos + np.array([1e-4, 1e-3]) * random.normal(size=2)) / tick) - belief[:2]
        belief = belief + np.append(0.5 * off, 0.15 / DT * off)
        belief = np.asarray(step(belief, acting))  # of the sample when the next force will act
        following, seconds = act(belief)
        data.ctrl[:] = acting
        mujoco.mj_step(model, data, 10)
        acting = np.clip(following, -LIMIT, LIMIT)
        times.append(seconds)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.stack(states), times


def on_a_rail(*, runs: int = 100) -> Numbers:
    """Swing-ups within the rail of a MuJoCo cart-pole with dry friction, noise and delay, whose sizes are 5 % wrong.

    By predictive control, and by one plan with its gains, which need a reserve of force and room.
    """
    cart, rod, length = 0.8, 0.15, 0.5
    # Without ends of the rail: a cart beyond them is seen.
    plant = compiled_model(f"""<mujoco><option timestep="{DT / 10}" integrator="implicitfast"/>
      <default><geom contype="0" conaffinity="0"/></default><worldbody><body>
      <joint name="rail" type="slide" axis="1 0 0" damping="0.1" frictionloss="0.2"/>
      <geom type="box" size=".05 .04 .03" mass="{cart}"/>
      <body><joint name="hinge" axis="0 1 0" damping="1e-3" frictionloss="5e-4"/>
      <geom type="capsule" fromto="0 0 0 0 0 {length}" size=".01" mass="{rod}"/></body>
    </body></worldbody><actuator><motor joint="rail"/></actuator></mujoco>""")
    known = Sizes(1.05 * cart, rod, 0.95 * length / 2, rod * (0.95 * length) ** 2 / 12)
    problem = in_jax(cart_pole(known, margin=0.03))
    careful, steps = in_jax(cart_pole(known, margin=0.1, limit=0.7 * LIMIT)), 180
    (solve, settle), (plan, _), regulate = starting(problem), starting(careful, steps), with_gains(careful)
    functions, _ = in_c(problem, first_plan(problem, HANGING, np.zeros((STEPS, 1))), barrier=BARRIER)
    top = regulate(first_plan(careful, jnp.zeros(4), np.zeros((steps, 1))))
    ways: dict[str, Callable[[Any], Controller]] = {
        "predictive-control": lambda x: of_c(functions, settle(solve(x))),
        "plan-and-gains": lambda x: along(regulate(plan(x)), top),
    }
    step, drawn = jax.jit(problem.step), np.random.default_rng(0).uniform(-1, 1, (runs, 4)) * [0.2, 0.3, 0.0, 0.0]
    measured = {}
    for way, make in ways.items():
        states, times = zip(
            *(swung_up(plant, make(x), step, x, seed) for seed, x in enumerate(HANGING + drawn)), strict=True
        )
        x = np.stack(states)
        scores, farthest = outcomes(x[..., 1], rate=1 / DT), np.abs(x[..., 0]).max(axis=1)
        measured[f"rail/{way}"] = {
            "success_share": np.mean(np.isfinite(scores.seconds) & (farthest <= RAIL)),
            "farthest_m": farthest.max(),
            "seconds_median": scores.median,
            "seconds_worst": scores.worst,
            "p99_ms": quantiles_ms(times)["p99_ms"],
        }
    return measured
