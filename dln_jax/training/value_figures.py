"""Figures of a trained value function: a plane of V with its policy, and runs of the closed loop."""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from dln_jax.control.closed_loop import ClosedLoopRun
from dln_jax.control.optimal.own_plants import OwnProblem
from dln_jax.control.optimal.plants import Returns, ValuePlant, evaluate, starts
from dln_jax.figures.closed_loops import closed_loop_traces
from dln_jax.figures.values import value_slice
from dln_jax.training.values import ValueRun
from dln_jax.types import JointKind

SHOWN, POINTS = 12, 121
"""Number of runs drawn, and of nodes along each side of the plane."""


def _runs(run: ValueRun) -> Returns:
    return evaluate(run.plant, run.law, starts(run.plant, "down", SHOWN))


def _described(plant: ValuePlant, own: OwnProblem | None) -> tuple[tuple[JointKind, ...], tuple[str, ...]]:
    if own is not None:
        return own.joints, own.names
    d = len(plant.problem.goal) // 2
    return plant.problem.joints, ("pole",) if d == 1 else ("driven", "pole")


def value_slice_of(run: ValueRun, own: OwnProblem | None) -> Figure:
    """V and policy in the plane of the passive coordinate, or of the last one without passive ones."""
    plant, problem = run.plant, run.problem
    kinds, names = _described(plant, own)
    d, goal = len(kinds), np.asarray(problem.goal, float)
    B = np.asarray(problem.actuation(jnp.asarray(goal)))[d:]
    passive = [k for k in plant.angles if own is not None and not np.any(own.actuation[k])]
    k = (passive or list(plant.angles))[-1]
    low, high = np.asarray(problem.low) - goal, np.asarray(problem.high) - goal
    sides = np.linspace(low[k], high[k], POINTS), np.linspace(low[d + k], high[d + k], POINTS)
    nodes = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
    x = np.broadcast_to(goal, (*nodes.shape[:2], 2 * d)).copy()
    x[..., [k, d + k]] += nodes
    V, u = jax.jit(jax.vmap(jax.vmap(lambda x: (run.value_and_gradient(x)[0], run.law(x)[0]))))(jnp.asarray(x))
    paths = _runs(run).x[..., [k, d + k]] - goal[[k, d + k]]
    limit = float(np.broadcast_to(plant.limit, B.shape[1])[0])
    return value_slice(
        nodes, np.asarray(V), np.asarray(u), paths, name=names[k], kind=kinds[k], limit=limit, fixed=d > 1
    )  # fmt: skip


def closed_loop(run: ValueRun, own: OwnProblem | None) -> Figure:
    """Coordinates and controls over time of runs from near hanging."""
    plant, how = run.plant, run.plant.evaluation
    kinds, names = _described(plant, own)
    runs = _runs(run)
    t = how.held / how.rate * np.arange(runs.x.shape[1])
    shown = ClosedLoopRun(t, runs.x, runs.u, runs.x)  # type: ignore[arg-type]
    limit = np.asarray(plant.limit, float)
    return closed_loop_traces(shown, kinds, names=names, goal=np.asarray(run.problem.goal), limits=(-limit, limit))
