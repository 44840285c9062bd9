"""Swing-ups of a cart-pole in MuJoCo whose rail ends at +-0.5 m, from plans with that constraint.

The rod is a capsule, and cart and hinge have dry friction, which the plans do not know; they take the cart for 5 %
heavier and the rod for 5 % shorter. At 100 Hz, encoders measure position and angle with noise, and forces act a sample
late. A filter of the plan's model estimates the state at the time when the force will act.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import Plan, TrajectoryProblem, first_plan, time_varying_lqr
from dln_jax.control.closed_loop import outcomes
from dln_jax.data.robots import compiled_model
from scripts.reports.case import Findings
from scripts.reports.control.plans import in_jax
from scripts.reports.control.real_time import (
    BARRIER,
    DT,
    HANGING,
    LIMIT,
    RAIL,
    STEPS,
    Sizes,
    cart_pole,
    in_c,
    of_c,
    starting,
)
from scripts.reports.rows import Row, expect

CART, ROD, LENGTH = 0.8, 0.15, 0.5
"""Masses, kg, and the rod's length, m."""
SUBSTEPS, SECONDS, RUNS = 10, 5.0, 100
NOISE, TURN, TICK = np.array([1e-4, 1e-3]), 2 * np.pi / 4096, 2.5e-5
"""Standard deviations of the encoders' noise, m and rad, and their resolutions, rad and m."""
CORRECTIONS = 0.5, 0.15
"""Shares of an innovation that correct the coordinates, and their rates within a sample."""
WALL, ROOM, RESERVED = 0.03, 0.1, 0.7
"""Distance that predictive control and one plan with its gains keep from the ends of the rail, m, and the share of the
force that the latter plans with."""
LONG = 180
"""Steps of these plans."""
SOLID = 'contype="0" conaffinity="0"'


def model() -> Any:
    """The plant, without ends of the rail: a cart beyond them is seen."""
    return compiled_model(f"""<mujoco><option timestep="{DT / SUBSTEPS}" integrator="implicitfast"/><worldbody><body>
      <joint name="rail" type="slide" axis="1 0 0" damping="0.1" frictionloss="0.2"/>
      <geom type="box" size=".05 .04 .03" mass="{CART}" {SOLID}/>
      <body><joint name="hinge" axis="0 1 0" damping="1e-3" frictionloss="5e-4"/>
      <geom type="capsule" fromto="0 0 0 0 0 {LENGTH}" size=".01" mass="{ROD}" {SOLID}/></body>
    </body></worldbody><actuator><motor joint="rail"/></actuator></mujoco>""")


def known() -> Sizes:
    """The plant as the plans model it: a thin rod."""
    length = 0.95 * LENGTH
    return Sizes(1.05 * CART, ROD, length / 2, ROD * length**2 / 12)


def starts(count: int, seed: int = 0) -> np.ndarray:
    """Starts at rest: the cart within 0.2 m of the middle, the rod up to 0.3 rad from hanging."""
    random = np.random.default_rng(seed)
    return HANGING + random.uniform(-1, 1, (count, 4)) * [0.2, 0.3, 0.0, 0.0]


class Run(NamedTuple):
    """A swing-up."""

    x: np.ndarray
    """True states at the samples."""
    milliseconds: np.ndarray


def swing_up(
    plant: tuple[Any, Any], act: Callable[[np.ndarray], tuple[np.ndarray, float]], step: Callable[..., Any],
    x: np.ndarray, seed: int,
) -> Run:  # fmt: skip
    """Runs one start; `step` is that of the plan's model."""
    mujoco, model = plant
    data, random = mujoco.MjData(model), np.random.default_rng([1, seed])
    data.qpos[:], data.qvel[:] = np.split(x, 2)
    belief, acting, states, times = x, np.zeros(1), [x], []
    for _ in range(round(SECONDS / DT)):
        # The belief is of this sample, before the measurement.
        y = data.qpos + NOISE * random.normal(size=2)
        y = np.array([TICK, TURN]) * np.round(y / [TICK, TURN])
        off = y - belief[:2]
        belief = belief + np.append(CORRECTIONS[0] * off, CORRECTIONS[1] / DT * off)
        belief = np.asarray(step(belief, acting))  # of the sample when the next force will act
        following, seconds = act(belief)
        data.ctrl[:] = acting
        mujoco.mj_step(model, data, SUBSTEPS)
        acting = np.clip(following, -LIMIT, LIMIT)
        times.append(1e3 * seconds)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return Run(np.stack(states), np.array(times))


def with_gains(problem: TrajectoryProblem) -> Callable[[Plan], Plan]:
    """Returns plan -> plan with the gains of regulators along it, which do not know the limits."""
    Q, R = np.diag([4.0, 1.0, 0.1, 0.01]) * DT, np.eye(1) * 1e-3 * DT

    @jax.jit
    def regulated(plan: Plan) -> Plan:
        A, B = jax.vmap(jax.jacfwd(problem.step, argnums=(0, 1)))(plan.x[:-1], plan.u)
        return plan._replace(K=-time_varying_lqr(A, B, Q, R, 2000 * Q).K)

    return regulated


def along(plan: Plan, top: Plan) -> Callable[[np.ndarray], tuple[np.ndarray, float]]:
    """The plan with its gains, then the gain of a plan that stands upright."""
    u, about, K = (np.asarray(array) for array in (plan.u, plan.x, plan.K))
    hold, number = np.asarray(top.K[0]), iter(range(10**6))

    def act(x: np.ndarray) -> tuple[np.ndarray, float]:
        if (k := next(number)) < len(u):
            return u[k] + K[k] @ (x - about[k]), 0.0
        return hold @ (x - [0, 2 * np.pi * np.round(x[1] / (2 * np.pi)), 0, 0]), 0.0

    return act


def on_a_rail(quick: bool) -> Findings:
    """Shares of swing-ups that succeed within the rail, by predictive control and by one plan with its gains."""
    planned, plant = cart_pole(known(), WALL), model()
    problem = in_jax(planned)
    solve, settle = starting(problem)
    step = jax.jit(problem.step)
    with tempfile.TemporaryDirectory() as place:
        functions, _ = in_c(
            problem, first_plan(problem, HANGING, np.zeros((STEPS, 1))), Path(place) / "plan", barrier=BARRIER
        )
    drawn = starts(5 if quick else RUNS)
    # Gains need a reserve of force, and room for what the plan does not know.
    careful = in_jax(cart_pole(known(), ROOM)._replace(limit=(RESERVED * LIMIT,)))
    solve_carefully, regulate = starting(careful, LONG)[0], with_gains(careful)
    top = regulate(first_plan(careful, jnp.zeros(4), np.zeros((LONG, 1))))
    ways = {
        "predictive-control": lambda x: of_c(functions, settle(solve(x))),
        "plan-and-gains": lambda x: along(regulate(solve_carefully(x)), top),
    }
    rows: list[Row] = []
    for way, controller in ways.items():
        runs = [swing_up(plant, controller(x), step, x, seed) for seed, x in enumerate(drawn)]
        rows += _rows(f"rail/{way}", runs)
    return Findings(rows)


def _rows(case: str, runs: list[Run]) -> list[Row]:
    scores = outcomes(np.stack([run.x[:, 1] for run in runs]), rate=1 / DT)
    farthest = np.array([np.abs(run.x[:, 0]).max() for run in runs])
    good, words = np.isfinite(scores.seconds) & (farthest <= RAIL), f"of {len(runs)} starts"
    return [
        expect(case, "success_share", f"{words}, up and never beyond the rail", np.mean(good), 1.0, at_least=True),
        expect(case, "farthest_m", words, farthest.max(), RAIL, "m"),
        Row(case, "seconds_median", scores.median, "s"),
        Row(case, "seconds_worst", scores.worst, "s"),
        Row(
            case,
            "p99_ms",
            float(np.percentile(np.concatenate([run.milliseconds for run in runs]), 99)),
            "ms",
            expected="CPU",
        ),
    ]
