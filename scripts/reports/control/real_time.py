"""Predictive control with constraints in real time, in C, beside IPOPT, fatrop and HPIPM on the same problem.

A cart-pole between walls: the plant of Lutter et al. 2021 (arXiv 2105.04682), 12 N, rail of +-0.5 m, 100 Hz, a horizon
of 1.2 s in 120 steps. All controllers start with the plan of `shoot` from the start at rest, and then swing up in a
closed loop with a finer simulation. Times are CPU times of a call in this process, since other programs may share the
machine.
"""

import re
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import Plan, TrajectoryProblem, feedback, first_plan, improve, integrated, prepare, shoot
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from scripts.reports.case import Findings
from scripts.reports.control.plan_problems import GRAVITY, Formula, Planned, Steps
from scripts.reports.control.plans import in_jax
from scripts.reports.control.rivals_in_real_time import hpipm, to_the_end
from scripts.reports.rows import Row, expect

DT, STEPS, LIMIT, RAIL, MARGIN = 0.01, 120, 12.0, 0.5, 0.02
"""Sample, s, steps of the horizon, force limit, N, half the rail, and what plans keep of it, m."""
SECONDS, LOOPS, RIVAL_LOOPS = 2.5, 10, 2
TO_REACH_MS, ARM_TO_REACH_MS = 0.3, 1.0
STACK = 2**21
SETTLING, BARRIER = 10, 1e-4
"""Iterations on the first plan, and the barrier parameter."""
HANGING = np.array([0.0, np.pi, 0.0, 0.0])


class Sizes(NamedTuple):
    """A cart-pole: kg, kg, m, kg m² about the pole's centre, N s/m, N m s."""

    cart: float = 0.57
    pole: float = 0.127
    length: float = 0.16825
    """Distance of the pole's centre from its hinge."""
    inertia: float = 0.0
    damping: tuple[float, float] = (0.1, 1e-3)


def rates_of(sizes: Sizes) -> Formula:
    """Rates of position, angle from upright, and their rates."""
    cart, pole, length, inertia, damping = sizes

    def rates(f: Any, x: Any, u: Any) -> list[Any]:
        s, c = f.sin(x[1]), f.cos(x[1])
        force = u[0] - damping[0] * x[2] + pole * length * s * x[3] ** 2
        torque = pole * GRAVITY * length * s - damping[1] * x[3]
        a, b, d = cart + pole, pole * length * c, pole * length**2 + inertia
        det = a * d - b * b
        return [x[2], x[3], (d * force - b * torque) / det, (a * torque - b * force) / det]

    return rates


def roots(f: Any, x: Any, u: Any) -> list[Any]:
    """Roots of the cost's terms; 2 (1 - cos) = 4 sin² of half the angle."""
    last = u is None
    weight = np.sqrt(20.0 if last else DT)
    terms = [2.0 * x[0], 2 * f.sin(x[1] / 2), np.sqrt(0.1) * x[2], np.sqrt(0.01) * x[3]]
    return [weight * term for term in (terms if last else [*terms, np.sqrt(1e-3) * u[0]])]


def cart_pole(sizes: Sizes = Sizes(), margin: float = MARGIN) -> Planned:  # noqa: B008
    """The problem."""
    wall = np.array([RAIL - margin, *[np.inf] * 3])
    return Planned(
        "cart-pole", tuple(HANGING), (0.0,) * 4, STEPS, Steps(rates_of(sizes), DT),
        lambda f, x, u: sum(root**2 for root in roots(f, x, u)),
        lambda f, x: sum(root**2 for root in roots(f, x, None)),
        (LIMIT,), -wall, wall,
    )  # fmt: skip


class Loop(NamedTuple):
    """A closed loop."""

    x: np.ndarray
    cost: float
    milliseconds: np.ndarray
    """CPU time of every call."""


def starts(count: int, seed: int = 0) -> np.ndarray:
    """Random starts near hanging [count, 4], distributed as in the published evaluation."""
    random = np.random.default_rng(seed)
    return random.normal(size=(count, 4)) * np.sqrt([1e-3, 5e-2, 1e-6, 1e-6]) + HANGING


def closed(act: Callable[[np.ndarray], tuple[np.ndarray, float]], x: np.ndarray) -> Loop:
    """Closes the loop around a controller: state -> control, CPU seconds."""
    states, cost, times = [x], 0.0, []
    for _ in range(round(SECONDS / DT)):
        u, seconds = act(x)
        cost += float(sum(np.square(root) for root in roots(np, x, u)))
        x = np.asarray(FINE(x, u))
        states.append(x)
        times.append(1e3 * seconds)
    return Loop(np.stack(states), cost, np.array(times))


FINE = jax.jit(integrated(lambda x, u: jnp.stack(rates_of(Sizes())(jnp, x, u)), DT, substeps=4))


def starting(problem: TrajectoryProblem, steps: int = STEPS) -> tuple[Callable[[Any], Plan], Callable[[Plan], Plan]]:
    """Returns start -> plan of `shoot` from straight lines to both sides, and plan -> plan after some iterations."""
    line, other = (np.linspace(HANGING, [0, angle, 0, 0], steps + 1) for angle in (0.0, 2 * np.pi))
    still = np.zeros((steps, 1))
    settle = lambda plan: jax.lax.fori_loop(0, SETTLING, lambda _, plan: improve(problem, plan, barrier=BARRIER), plan)  # noqa: E731
    solve = lambda x: shoot(problem, x, line, still, starts=(other[None], still[None])).plan  # noqa: E731
    return jax.jit(solve), jax.jit(settle)


def renewed(problem: TrajectoryProblem, plan: Plan, **settings: Any) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """`prepare` as a function of arrays, (x, controls, states, gains, damping, knots if any), and example arguments."""

    def renew(x: Any, u: Any, states: Any, gains: Any, damping: Any, knots: Any = None) -> Any:
        now = problem if knots is None else problem._replace(knots=knots)
        after = prepare(now, plan._replace(u=u, x=states, K=gains, damping=damping), x, **settings)
        return {
            "controls": after.u,
            "next": after.x,
            "feedback": after.K,
            "size": after.damping,
            "ending": after.ending,
        }

    knots = () if problem.knots is None else (problem.knots,)
    return renew, tuple(map(np.asarray, (plan.x[0], plan.u, plan.x, plan.K, plan.damping, *knots)))


class Effort(NamedTuple):
    """Cost of a call, from the header of an export."""

    operations: int
    """Floating-point operations; all loops have a fixed number of turns."""
    stack_bytes: int


def in_c(problem: TrajectoryProblem, plan: Plan, folder: Path, **settings: Any) -> tuple[Any, Mapping[str, Effort]]:
    """Exports `feedback` and `prepare`, and returns the compiled functions and the costs of their calls."""

    def respond(x: Any, u: Any, states: Any, gains: Any) -> Any:
        return feedback(problem, plan._replace(u=u, x=states, K=gains), x)

    renew, examples = renewed(problem, plan, **settings)
    export_c({"respond": (respond, examples[:4]), "renew": (renew, examples)}, folder, stack=STACK)
    stated = r"(\d+) floating-point operations, (\d+) bytes of stack[^/]*/\s*\w+ model_(\w+)\("
    efforts = {
        name: Effort(*map(int, numbers)) for *numbers, name in re.findall(stated, (folder / "model.h").read_text())
    }
    return load_c(folder), efforts


def of_c(functions: Any, plan: Plan) -> Callable[..., tuple[np.ndarray, float]]:
    """The controller in C: its memory is the plan."""
    memory = [np.asarray(array) for array in (plan.u, plan.x, plan.K)]
    state = {"plan": memory, "damping": float(plan.damping)}

    def act(x: np.ndarray, *knots: np.ndarray) -> tuple[np.ndarray, float]:
        began = time.thread_time_ns()
        u = functions.respond(x, *state["plan"])
        after = functions.renew(x, *state["plan"], state["damping"], *knots)
        seconds = (time.thread_time_ns() - began) / 1e9
        state["plan"], state["damping"] = [after.controls, after.next, after.feedback], float(after.size)
        return np.atleast_1d(u), seconds

    return act


def cart_pole_report(quick: bool) -> Findings:
    """Times, closed-loop costs and largest positions of all controllers."""
    planned = cart_pole()
    problem = in_jax(planned)
    solve, settle = starting(problem)
    rows: list[Row] = []
    drawn = starts(1 if quick else LOOPS)
    with tempfile.TemporaryDirectory() as place:
        functions, efforts = in_c(
            problem, first_plan(problem, HANGING, np.zeros((STEPS, 1))), Path(place) / "plan", barrier=BARRIER
        )
    loops = [closed(of_c(functions, settle(solve(x))), x) for x in drawn]
    rows += _rows("realtime/cart-pole/c", loops, TO_REACH_MS)
    for name, effort in efforts.items():
        case = f"realtime/cart-pole/c-{name}"
        rows.append(Row(case, "operations", effort.operations, expected="floating-point, of a call"))
        rows.append(Row(case, "stack_bytes", effort.stack_bytes, "B"))
    for name in ("ipopt", "fatrop", "hpipm"):
        make = hpipm(planned, roots) if name == "hpipm" else to_the_end(name, planned, roots)
        loops_of_rival = [closed(make(unknowns(solve(x))), x) for x in drawn[: 1 if quick else RIVAL_LOOPS]]
        rows += _rows(f"realtime/cart-pole/{name}", loops_of_rival, None)
    return Findings(rows)


def unknowns(plan: Plan) -> np.ndarray:
    """x_0, u_0, x_1, ..., x_N."""
    return np.append(np.concatenate([plan.x[:-1], plan.u], axis=1).ravel(), plan.x[-1])


def _rows(case: str, loops: list[Loop], bound: float | None) -> list[Row]:
    p50, p99, worst = np.percentile(np.concatenate([loop.milliseconds for loop in loops]), [50, 99, 100])
    words = f"of {sum(len(loop.milliseconds) for loop in loops)} calls, CPU"
    up = [bool(np.all(np.cos(loop.x[-20:, 1]) > np.cos(0.1))) for loop in loops]
    return [
        Row(case, "p50_ms", float(p50), "ms", expected=words),
        Row(case, "p99_ms", float(p99), "ms") if bound is None else expect(case, "p99_ms", words, p99, bound, "ms"),
        Row(case, "worst_ms", float(worst), "ms"),
        Row(case, "up_share", float(np.mean(up)), expected=f"of {len(loops)} starts"),
        Row(case, "closed_loop_cost_mean", float(np.mean([loop.cost for loop in loops]))),
        Row(case, "first_starts_cost_mean", float(np.mean([loop.cost for loop in loops[:RIVAL_LOOPS]]))),
        Row(case, "largest_position", max(float(np.abs(loop.x[:, 0]).max()) for loop in loops), "m"),
    ]
