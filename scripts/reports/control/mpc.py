"""Model predictive control of a cart-pole at 100 Hz: swing-ups from many starts, and the times of single calls.

The plant is the Quanser cart-pole of Lutter et al. 2021 (arXiv 2105.04682) with its viscous friction and a limit of
12 N. Every 10 ms one iteration improves the plan of the previous call. The first plan applies no force: there is no
guess and no solution in advance. Calls are timed in a process of their own: one thread, low-latency mode.
"""

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import Controller, Hardware, Plan, TrajectoryProblem, error, first_plan, mpc, simulate
from dln_jax.control.state_space import Field, field_of
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.low_latency import enable_low_latency
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.integrators import CLASSICAL, advance, runge_kutta
from dln_jax.scenes.poles import cart_pole
from dln_jax.scenes.scene import Scene
from dln_jax.types import InputError
from scripts.reports.case import Findings
from scripts.reports.process import called
from scripts.reports.rows import Row, expect

RATE, SECONDS, LIMIT, RAIL = 100.0, 6.0, 12.0, 0.5
"""Control rate, Hz, length of a run, s, force limit, N, and half the length of the rail, m."""
HORIZONS = (1.2, 0.8)
"""Horizons of the plans, s."""
HANGING = np.array([0.0, np.pi, 0.0, 0.0])
UP = 0.1
"""Largest angle from upright that counts as up, rad."""
STARTS, LOOPS = 30, 10
"""Number of swing-ups, and number of loops with timed calls."""
WITHIN = 1e3 / RATE
"""Time limit of a call, ms."""
TIMED_SECONDS = 3.0
"""Length of a closed loop with timed calls, s, which covers the swing-up and balancing."""
PROCESS_LIMIT = 170.0
"""Time limit of the process that times calls, s."""
ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"
STACK = 2**20
"""Stack limit of a call in C, bytes."""


class Weights(NamedTuple):
    """Weights of the cost's integrand, and the factor on the last state's cost."""

    position: float = 4.0
    angle: float = 1.0
    """Weight of 2 (1 - cos)."""
    rates: tuple[float, float] = (0.1, 0.01)
    force: float = 1e-3
    beyond: float = 200.0
    """Weight of the squared excess of the cart's position over nine tenths of the rail, m²."""
    last: float = 20.0


class Calls(NamedTuple):
    """Times of successive calls, and of the compilation."""

    compile_seconds: float
    p50_ms: float
    p99_ms: float
    worst_ms: float
    calls: int


def scene() -> Scene:
    """The plant."""
    known = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825, friction=1.0)
    return known._replace(dissipation=joint_dissipation(np.array([0.1, 1e-3])))


def field() -> Field:
    """The plant's vector field, in closed form, which is cheaper than forces derived from energies."""
    known = scene()
    return field_of(dynamics(known.closed_form), np.asarray(known.needs.actuation))


def cart_pole_problem(weights: Weights = Weights()) -> TrajectoryProblem:  # noqa: B008
    """The optimal control problem: steps of 10 ms by the classical Runge-Kutta method, and their costs."""
    plant, dt = field(), 1.0 / RATE

    def off(x: Array) -> Array:
        beyond = jnp.maximum(jnp.abs(x[0]) - 0.9 * RAIL, 0.0)
        speed = weights.rates[0] * x[2] ** 2 + weights.rates[1] * x[3] ** 2
        return (
            weights.position * x[0] ** 2 + 2 * weights.angle * (1 - jnp.cos(x[1])) + speed + weights.beyond * beyond**2
        )

    return TrajectoryProblem(
        lambda x, u: runge_kutta(CLASSICAL, lambda t, state: plant(state, u))(0.0, x, dt),
        lambda x, u: dt * (off(x) + weights.force * u[0] ** 2),
        lambda x: weights.last * off(x),
        -LIMIT,
        LIMIT,
    )


def starts(count: int, seed: int = 0) -> np.ndarray:
    """Random starts near hanging [count, 4], distributed as in the published evaluation; the cart may be off centre."""
    random = np.random.default_rng(seed)
    return random.normal(size=(count, 4)) * np.sqrt([1e-3, 5e-2, 1e-6, 1e-6]) + HANGING


def controller(problem: TrajectoryProblem, steps: int) -> Controller:
    """A controller of the full state; its memory is the plan, initially without force."""
    act = mpc(problem)

    def sample(plan: Plan, t: Array, y: Array) -> tuple[Plan, Array]:
        u, plan = act(y, plan)
        return plan, u

    return Controller(first_plan(problem, HANGING, np.zeros((steps, 1))), sample)


def swing_ups(steps: int, count: int, seed: int = 0) -> np.ndarray:
    """Times from which the pole stays up and the cart on its rail, s, by start; infinite for failures."""
    joints, plant, law = scene().needs.joints, field(), controller(cart_pole_problem(), steps)
    lab = Hardware(-LIMIT, LIMIT)

    def up(x: Array) -> Array:
        run = simulate(plant, law, x, seconds=SECONDS, rate=RATE, controls=1, hardware=lab, substeps=4)
        off = jax.vmap(lambda x: error(x, np.zeros(4), joints)[1])(run.x)
        return (jnp.abs(off) < UP) & (jnp.max(jnp.abs(run.x[:, 0])) <= RAIL)

    good = np.asarray(jax.jit(jax.vmap(up))(starts(count, seed)))
    return np.where(good[:, -1], (good.shape[1] - np.argmin(good[:, ::-1], axis=1)) / RATE, np.inf)


def one_call(steps: int) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """(x, u, states, K, damping) -> the control, and the next u, states, K and damping; arguments of the first call."""
    problem = cart_pole_problem()
    act, plan = mpc(problem), first_plan(problem, HANGING, np.zeros((steps, 1)))

    def call(x: Any, u: Any, about: Any, K: Any, damping: Any) -> Any:
        control, after = act(x, plan._replace(u=u, x=about, K=K, damping=damping))
        return {"control": control, "planned": after.u, "states": after.x, "gains": after.K, "size": after.damping}

    return call, tuple(map(np.asarray, (HANGING, plan.u, plan.x, plan.K, plan.damping)))


def timed_calls(steps: int, loops: int) -> dict[str, Calls]:
    """Calls of "jax", and of "c" if there is a compiler, for a process of its own."""
    enable_low_latency()
    act, first = one_call(steps)
    began = time.perf_counter()
    compiled = jax.jit(act)
    jax.block_until_ready(compiled(*first))
    calls = {"jax": timed(compiled, first, loops, time.perf_counter() - began)}
    with tempfile.TemporaryDirectory() as place:
        began = time.perf_counter()
        try:
            export_c({"act": (act, first)}, Path(place) / "plan", stack=STACK)
            in_c = load_c(Path(place) / "plan").act
        except InputError:
            return calls
        return calls | {"c": timed(in_c, first, loops, time.perf_counter() - began)}


def timed(act: Callable[..., Any], first: tuple[Any, ...], loops: int, compile_seconds: float) -> Calls:
    """Times all calls along some closed loops."""
    plant = field()
    after = jax.jit(
        lambda x, u: advance(runge_kutta(CLASSICAL, lambda t, state: plant(state, u)), 0.0, x, 1 / RATE, substeps=4)
    )
    nanoseconds = []
    for x in starts(loops, seed=1):
        plan = first[1:]
        for _ in range(round(TIMED_SECONDS * RATE)):
            start = time.perf_counter_ns()
            answer = jax.block_until_ready(act(x, *plan))
            nanoseconds.append(time.perf_counter_ns() - start)
            named = answer if isinstance(answer, dict) else answer._asdict()
            # The C binding returns the names of the dictionary, possibly with a suffix.
            named = {key.removesuffix("_result"): value for key, value in named.items()}
            control, *plan = (np.asarray(named[key]) for key in ("control", "planned", "states", "gains", "size"))
            x = np.asarray(after(x, control))
    p50, p99, worst = map(float, np.percentile(np.array(nanoseconds) / 1e6, [50, 99, 100]))
    return Calls(compile_seconds, p50, p99, worst, len(nanoseconds))


def cart_pole_report(quick: bool) -> Findings:
    """Success and time to swing up by horizon, and single-threaded times of a call in JAX and in C, ms."""
    rows: list[Row] = []
    for seconds in HORIZONS[:1] if quick else HORIZONS:
        steps = round(seconds * RATE)
        case, times = f"mpc/{seconds:g}-s", swing_ups(steps, 2 if quick else STARTS)
        words, reached = f"of {len(times)} starts", times[np.isfinite(times)]
        rows.append(Row(case, "success_share", float(np.isfinite(times).mean()), expected=words))
        for quantity, of in (("median", np.median), ("worst", np.max)):
            rows.append(Row(case, f"seconds_{quantity}", float(of(reached)) if len(reached) else np.inf, "s"))
    # Only the longest horizon is timed: its calls take the most time.
    steps, case = round(HORIZONS[0] * RATE), f"mpc/{HORIZONS[0]:g}-s"
    flags = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {ONE_THREAD}".strip(), "OMP_NUM_THREADS": "1"}
    for way, numbers in called(timed_calls, steps, 1 if quick else LOOPS, limit=PROCESS_LIMIT, **flags).items():
        calls = Calls(*numbers)
        rows.append(Row(f"{case}/{way}", "compile_seconds", calls.compile_seconds, "s"))
        rows.append(Row(f"{case}/{way}", "p50_ms", calls.p50_ms, "ms"))
        rows.append(expect(f"{case}/{way}", "p99_ms", f"of {calls.calls} calls", calls.p99_ms, WITHIN, "ms"))
        rows.append(Row(f"{case}/{way}", "worst_ms", calls.worst_ms, "ms"))
    return Findings(rows)
