"""Evaluates the law of a value function: runs, returns and the error of V, the verdict, and figures."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dln_jax.control.closed_loop import ClosedLoopRun, Hardware, outcomes, simulate, stateless
from dln_jax.control.optimal.own_plants import HORIZON, NEAR, OwnProblem
from dln_jax.control.optimal.problem import ControlProblem, limits, rates
from dln_jax.control.plants.plant import ACTIVE_SPREAD, SPREAD
from dln_jax.control.state_space import Law, error
from dln_jax.figures import style
from dln_jax.figures.closed_loops import angle_ticks, closed_loop_traces
from dln_jax.metrics.verdict import Verdict
from dln_jax.zoo.value_functions import ValueRun

FAILED, WRONG = 0.9, 0.1
"""Share of the hanging starts that must end upright; a law below it is refused. Largest median error of a good V."""
SHOWN, POINTS, LEVELS = 12, 121, 16
"""Number of runs drawn, of nodes along each side of the plane, and of contours of V."""
RATE = 20.0
"""Integrator steps of a run per 1 / lambda."""
LABELS = {
    "down_": "from hanging: ",
    "uniform_": "from anywhere: ",
    "heavy_weak_": "heavy bodies, weak motors: ",
    "light_strong_": "light bodies, strong motors: ",
    "return_": "return, ",
    "up_share": "share of starts that end upright",
    "settled_median_seconds": "median time to settle",
    "control_most": "largest control",
    "value_error": "median relative error of V",
}
"""Words for parts of metrics' names."""


def hinges_of(own: OwnProblem) -> list[int]:
    """Coordinates that must come near the goal: all hinges, or all slides of a plant without hinges."""
    d = len(own.joints)
    return [k for k in range(d) if own.joints[k] == "revolute"] or list(range(d))


def hanging(own: OwnProblem, count: int) -> Float[np.ndarray, "N n"]:
    """Returns random initial states near hanging."""
    still = np.zeros(len(own.joints))
    driven = np.asarray(own.actuation).any(axis=1)
    spread = [*np.where(driven, ACTIVE_SPREAD, SPREAD), *(still + 0.01)]
    random = np.random.default_rng(0)
    return [*own.hanging, *still] + spread * random.normal(size=(count, len(spread)))


def anywhere(problem: ControlProblem, own: OwnProblem, count: int) -> Float[np.ndarray, "N n"]:
    """Returns random initial states at rest, anywhere on circles and in a third of the box elsewhere."""
    d = len(own.joints)
    widths = [*np.where(own.turning, np.pi, np.asarray(own.box)[:d] / 3), *np.full(d, 0.01)]
    random = np.random.default_rng(0)
    return np.clip(problem.goal + random.uniform(-1, 1, (count, 2 * d)) * widths, *limits(problem))


def simulated(problem: ControlProblem, own: OwnProblem, law: Law, x: Any) -> tuple[ClosedLoopRun, np.ndarray]:
    """Runs a law from states [N, n] for 40 / lambda.

    Returns the runs, and the times [N] in s after which they stay near the goal, infinite if they do not end there. A
    run that leaves the range of a coordinate is never near.
    """
    limit, hinges = np.asarray(own.limits), np.array(hinges_of(own))
    settings = {"rate": RATE * own.scale, "controls": len(limit), "hardware": Hardware(-limit, limit)}

    def run(x: Any) -> ClosedLoopRun:
        return simulate(rates(problem), stateless(law), x, seconds=HORIZON / own.scale, **settings)

    runs = jax.tree.map(np.asarray, jax.jit(jax.vmap(run))(x))
    off = jax.vmap(jax.vmap(lambda x: error(x, problem.goal, problem.joints)))(runs.x)
    low, high = own.ranges.T
    q = runs.x[..., : len(low)]
    outside = ((q < low) | (q > high)).any(axis=2)
    # Angles above π are far, whatever their cosine.
    off = np.where(outside, np.pi, np.minimum(np.abs(np.asarray(off)[..., hinges]).max(axis=2), np.pi))
    return runs, outcomes(off, rate=settings["rate"], up=NEAR).seconds


def evaluation(run: ValueRun, count: int, altered: Mapping[str, ControlProblem]) -> dict[str, float]:
    """Returns of a value function's law from both kinds of starts, and the error of V; a failed start counts as NaN.

    A return is - sum of dt (q(x) + g(u)), undiscounted.

    Args:
        count: number of starts of each kind.
        altered: problems by name whose returns from near hanging are added.
    """
    down = hanging(run.own, count)
    starts = {"down": (run.problem, down), "uniform": (run.problem, anywhere(run.problem, run.own, count))}
    starts |= {name: (problem, down) for name, problem in altered.items()}
    numbers: dict[str, float] = {}
    for name, (problem, x) in starts.items():
        runs, settled = simulated(problem, run.own, run.law, x)
        returns = -cost_of(problem, runs, discount=0.0)
        numbers |= {
            f"{name}_return_mean": float(np.mean(returns)),
            f"{name}_return_median": float(np.median(returns)),
            f"{name}_return_worst": float(np.min(returns)),
            f"{name}_up_share": float(np.mean(np.isfinite(settled))),
            f"{name}_settled_median_seconds": float(np.median(settled)),
            f"{name}_control_most": float(np.max(np.abs(runs.u))),
        }
        if name == "uniform":
            numbers["value_error"] = value_error(run, runs, settled)
    return numbers


def cost_of(problem: ControlProblem, runs: ClosedLoopRun, discount: float) -> Float[np.ndarray, " N"]:
    """Returns sum of dt e^(-discount t) (q(x) + g(u)) of each run."""
    costs = jax.vmap(jax.vmap(lambda x, u: problem.state_cost(x) + problem.action_cost.cost(u)))
    t = runs.t[0]
    return np.asarray(costs(runs.x[:, :-1], runs.u)) @ (np.diff(t) * np.exp(-discount * t[:-1]))


def value_error(run: ValueRun, runs: ClosedLoopRun, settled: np.ndarray) -> float:
    """Median error of V, relative to the discounted cost of following its law; NaN unless a start ends up.

    Starts that are not up at the end of the evaluation are left out: their cost is not known.
    """
    V = np.asarray(jax.vmap(run.value_and_gradient)(runs.x[:, 0])[0])
    off = np.abs(V / cost_of(run.problem, runs, run.problem.discount) - 1)[np.isfinite(settled)]
    return float(np.median(off)) if len(off) else float("nan")


def verdict_of(numbers: dict[str, float], count: int) -> Verdict:
    """Verdict on a value function by the share of starts that its law brings upright, and the error of V."""
    down, anywhere = numbers["down_up_share"], numbers["uniform_up_share"]
    altered = [numbers[key] for key in ("heavy_weak_up_share", "light_strong_up_share") if key in numbers]
    error = numbers.get("value_error", 0.0)
    reason = f"{down:.0%} of {count} hanging starts and {anywhere:.0%} of starts anywhere end upright"
    if altered:
        reason += f"; {min(altered):.0%} of hanging starts with the worst masses and motors"
    reason += f"; V differs from the cost of its law by {error:.1%} (median)"
    remedy = "train longer (--iterations) or with other --seeds, narrow the --box, or give a stronger motor"
    if not down >= FAILED:
        return Verdict("refused", reason, remedy)
    # A robust V is that of the worst case, and exceeds the cost on the model.
    sound = min(down, anywhere, *altered) == 1 and (error <= WRONG or bool(altered))
    return Verdict("good", reason) if sound else Verdict("doubtful", reason, remedy)


def value_plane(run: ValueRun) -> Figure:
    """V and the first control in the plane of one coordinate and its rate, with paths projected onto it.

    The coordinate is passive, or the last one without passive ones; all other states are at the goal.
    """
    problem, kinds, names = run.problem, run.own.joints, run.own.names
    d, goal = len(kinds), np.asarray(problem.goal, float)
    hinges = hinges_of(run.own)
    k = ([k for k in hinges if not np.any(run.own.actuation[k])] or hinges)[-1]
    low, high = np.asarray(problem.low) - goal, np.asarray(problem.high) - goal
    across, up = np.linspace(low[k], high[k], POINTS), np.linspace(low[d + k], high[d + k], POINTS)
    x = np.tile(goal, (POINTS, POINTS, 1))
    x[..., k] += across
    x[..., d + k] += up[:, None]
    V, u = jax.jit(jax.vmap(jax.vmap(lambda x: (run.value_and_gradient(x)[0], run.law(x)[0]))))(jnp.asarray(x))
    runs, _ = simulated(problem, run.own, run.law, hanging(run.own, SHOWN))
    paths = runs.x[..., [k, d + k]] - goal[[k, d + k]]
    limit, most = run.own.limits[0], float(np.max(V))
    unit, turning = ("rad", True) if kinds[k] == "revolute" else ("m", False)
    figure, [axes] = style.figure(1, 2, height=3.6)
    for axis, values, norm, colours, label, title in (
        (axes[0], V, Normalize(0, most), "YlGnBu", "V", "value"),
        (axes[1], u, Normalize(-limit, limit), "RdBu_r", "control, N or N m", "policy"),
    ):
        axis.grid(False)
        axis.pcolormesh(across, up, values, norm=norm, cmap=colours, shading="gouraud", rasterized=True)
        bar = figure.colorbar(ScalarMappable(norm, colours), ax=axis, pad=0.02, aspect=28)
        bar.set_label(label, fontsize=style.SMALL)
        bar.ax.tick_params(labelsize=style.SMALL)
        bar.outline.set_visible(False)
        for path in paths:
            q = path[:, 0]
            if turning:  # angles are wrapped, with gaps where they jump
                q = np.arctan2(np.sin(q), np.cos(q))
                q[1:][np.abs(np.diff(q)) > np.pi] = np.nan
            axis.plot(q, path[:, 1], color=style.VERMILLION, linewidth=0.8, alpha=0.8)
        axis.plot(0, 0, "o", color="white", markeredgecolor="black", markersize=4.5)
        style.title(axis, f"{title}, other states at the goal" if d > 1 else title)
        if turning and across[-1] > 3:
            angle_ticks(axis.xaxis)
        axis.set(xlim=across[[0, -1]], ylim=up[[0, -1]], xlabel=f"{names[k]} from the goal, {unit}")
    axes[0].contour(across, up, V, np.linspace(0, most, LEVELS), colors="0.25", linewidths=0.35, zorder=1.5)
    axes[0].set_ylabel(f"rate, {unit}/s")
    return figure


def closed_loop(run: ValueRun) -> Figure:
    """Coordinates and controls over time of runs from near hanging."""
    runs, _ = simulated(run.problem, run.own, run.law, hanging(run.own, SHOWN))
    limit = np.asarray(run.own.limits)
    shown = runs._replace(t=runs.t[0])
    return closed_loop_traces(
        shown, run.own.joints, names=run.own.names, goal=np.asarray(run.problem.goal), limits=(-limit, limit)
    )
