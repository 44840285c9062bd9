"""Evaluates the law of a value function: returns and the error of V, the verdict, and figures."""

from collections.abc import Mapping
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dln_jax.control.closed_loop import ClosedLoopRun
from dln_jax.control.optimal.plants import Returns, ValuePlant, Where, evaluate, starts
from dln_jax.figures import style
from dln_jax.figures.closed_loops import angle_ticks, closed_loop_traces
from dln_jax.metrics.verdict import Verdict
from dln_jax.types import JointKind
from dln_jax.zoo.value_functions import ValueRun

FAILED, WRONG = 0.9, 0.1
"""Share of the hanging starts that must end upright; a law below it is refused. Largest median error of a good V."""
SHOWN, POINTS, LEVELS = 12, 121, 16
"""Number of runs drawn, of nodes along each side of the plane, and of contours of V."""


def evaluation(run: ValueRun, count: int, altered: Mapping[str, ValuePlant]) -> dict[str, float]:
    """Returns of a value function's law from both kinds of starts, and the error of V; a failed start counts as NaN.

    Args:
        count: number of starts of each kind.
        altered: plants by name whose returns from near hanging are added.
    """
    numbers: dict[str, float] = {}
    where: Where
    for where in get_args(Where):
        returns = evaluate(run.plant, run.law, starts(run.plant, where, count))
        numbers |= summary(where, returns)
        numbers["value_error"] = value_error(run, returns)
    for name, plant in altered.items():
        numbers |= summary(name, evaluate(plant, run.law, starts(run.plant, "down", count)))
    return numbers


def value_error(run: ValueRun, runs: Returns) -> float:
    """Median error of V, relative to the discounted cost of following its law; NaN unless a start ends up.

    Starts that are not up at the end of the evaluation are left out: their cost is not known.
    """
    problem, dt = run.problem, run.plant.evaluation.held / run.plant.evaluation.rate
    costs = jax.vmap(jax.vmap(lambda x, u: problem.state_cost(x) + problem.action_cost.cost(u)))
    weights = dt * np.exp(-problem.discount * dt * np.arange(runs.u.shape[1]))
    V = jax.vmap(run.value_and_gradient)(jnp.asarray(runs.x[:, 0]))[0]
    off = np.abs(V / (costs(runs.x[:, :-1], runs.u) @ weights) - 1)[np.isfinite(runs.settled)]
    return float(np.median(off)) if len(off) else float("nan")


def summary(name: str, runs: Returns) -> dict[str, float]:
    """Numbers of the runs from one kind of starts."""
    return {
        f"{name}_return_mean": float(np.mean(runs.returns)),
        f"{name}_return_median": float(np.median(runs.returns)),
        f"{name}_return_worst": float(np.min(runs.returns)),
        f"{name}_up_share": float(np.mean(np.isfinite(runs.settled))),
        f"{name}_settled_median_seconds": float(np.median(runs.settled)),
        f"{name}_control_most": runs.largest,
    }


def verdict_of(numbers: dict[str, float], count: int) -> Verdict:
    """Verdict on a value function by the share of starts that its law brings upright, and the error of V."""
    down, anywhere = numbers["down_up_share"], numbers["uniform_up_share"]
    altered = [numbers[key] for key in ("heavy_weak_up_share", "light_strong_up_share") if key in numbers]
    error = numbers.get("value_error", 0.0)
    reason = f"{down:.0%} of {count} hanging starts end up, and {anywhere:.0%} of those anywhere at rest"
    if altered:
        reason += f"; {min(altered):.0%} of the hanging ones with the worst masses and motors"
    reason += f"; V differs from the cost of its law by {error:.1%} in the median"
    remedy = "train longer (--iterations) or with other --seeds, narrow the --box, or give a stronger motor"
    if not down >= FAILED:
        return Verdict("refused", reason, remedy)
    # A robust V is that of the worst case, and exceeds the cost on the model.
    sound = min(down, anywhere, *altered) == 1 and (error <= WRONG or bool(altered))
    return Verdict("good", reason) if sound else Verdict("doubtful", reason, remedy)


def hanging_runs(run: ValueRun) -> Returns:
    """Runs of the closed loop from near hanging."""
    return evaluate(run.plant, run.law, starts(run.plant, "down", SHOWN))


def coordinates(run: ValueRun) -> tuple[tuple[JointKind, ...], tuple[str, ...]]:
    """Kinds and names of the plant's coordinates."""
    if run.own is not None:
        return run.own.joints, run.own.names
    d = len(run.problem.goal) // 2
    return run.problem.joints[:d], ("pole",) if d == 1 else ("driven", "pole")


def value_plane(run: ValueRun) -> Figure:
    """V and the first control in the plane of one coordinate and its rate, with paths projected onto it.

    The coordinate is passive, or the last one without passive ones; all other states are at the goal.
    """
    plant, problem = run.plant, run.problem
    kinds, names = coordinates(run)
    d, goal = len(kinds), np.asarray(problem.goal, float)
    passive = [k for k in plant.angles if run.own is not None and not np.any(run.own.actuation[k])]
    k = (passive or list(plant.angles))[-1]
    low, high = np.asarray(problem.low) - goal, np.asarray(problem.high) - goal
    across, up = np.linspace(low[k], high[k], POINTS), np.linspace(low[d + k], high[d + k], POINTS)
    x = np.tile(goal, (POINTS, POINTS, 1))
    x[..., k] += across
    x[..., d + k] += up[:, None]
    V, u = jax.jit(jax.vmap(jax.vmap(lambda x: (run.value_and_gradient(x)[0], run.law(x)[0]))))(jnp.asarray(x))
    paths = hanging_runs(run).x[..., [k, d + k]] - goal[[k, d + k]]
    limit, most = float(np.ravel(plant.limit)[0]), float(np.max(V))
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
    how, limit = run.plant.evaluation, np.asarray(run.plant.limit, float)
    kinds, names = coordinates(run)
    runs = hanging_runs(run)
    t = how.held / how.rate * np.arange(runs.x.shape[1])
    shown = ClosedLoopRun(t, runs.x, runs.u, runs.x)  # type: ignore[arg-type]
    return closed_loop_traces(shown, kinds, names=names, goal=np.asarray(run.problem.goal), limits=(-limit, limit))
