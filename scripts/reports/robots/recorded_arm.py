"""A recorded arm, blocks held out: the tree of its file, with a network or not, a learned one, and Pinocchio's fit.

The log is cut into ten blocks; two neighbours at a time are held out, and every other sample is predicted by a model
that has not seen its block. Errors are over the variance of the whole log, so that a block in which a joint rests does
not count for more. Laws of friction, the network and the learned frames are chosen by blocks of what is fitted.
"""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.data import schema
from dln_jax.data.encoders import smooth
from dln_jax.data.robots import read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import in_blocks, select, with_joints
from dln_jax.identification.residual import fit_residual
from dln_jax.learning.friction import FrictionFit, fit_friction
from dln_jax.learning.kinematics import fit_tree
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import Tree
from dln_jax.models.serial_tree import tree_of
from dln_jax.types import FrictionLaw, Needs
from scripts.reports.case import Findings
from scripts.reports.robots.rivals import regression
from scripts.reports.rows import Row, expect

BLOCKS = 10
CUTOFF, DECIMATE = 5.0, 2
"""Hz, of the filter of all, and every so manyth sample of the log."""
LAWS: tuple[tuple[FrictionLaw, ...], ...] = (
    ("viscous", "coulomb", "offset"),
    ("viscous", "coulomb", "stribeck", "offset"),
    ("asymmetric", "offset"),
)
"""Candidate sets of friction laws."""
USUAL_SCALE = 0.01
"""Velocity scale of the rival's dry friction, rad/s, which it does not fit."""
LEARNED_SCALES = (0.01, 0.1)
"""rad/s, of the dry friction of a learned tree while its frames are found; chosen from."""
CHOOSING = 4
"""Stride of the fitted blocks that serve as validation."""

Predict = Callable[[Trajectories], np.ndarray]


def recorded_arm(log: Path, robot: Path, quick: bool) -> Findings:
    """Errors of every block by models that have not seen it; of one pair of blocks alone where it is to be quick.

    Raises:
        InputError: what `read_robot` or `schema.load` refuse, or joints that do not agree.
    """
    tree = read_robot(robot).tree
    data = with_joints(schema.load(log), tree.names)
    data = in_blocks(smooth(data, CUTOFF, decimate=DECIMATE).data, BLOCKS)
    pairs = [(first, first + 1) for first in range(0, BLOCKS, 2)][: 1 if quick else None]
    squares: dict[str, list[np.ndarray]] = {}
    for pair in pairs:
        held = select(data, pair)
        for name, predict in methods(tree, select(data, np.setdiff1d(np.unique(data.trajectory), pair))).items():
            squares.setdefault(name, []).append((predict(held) - held.tau) ** 2)
    variance = data.tau.var(axis=0)
    curves = {name: (np.mean(np.concatenate(found), axis=0) / variance).tolist() for name, found in squares.items()}
    return Findings(rows_of(squares, variance, tree.names), curves)


def methods(tree: Tree, data: Trajectories) -> dict[str, Predict]:
    """Predictors by method, fitted to these blocks."""
    present = np.unique(data.trajectory)
    chosen = present[1::CHOOSING]
    train, validation = select(data, np.setdiff1d(present, chosen)), select(data, chosen)
    laws = min(LAWS, key=lambda each: error(fit_friction(tree, train, each), validation))
    full = fit_friction(tree, data, laws)
    # The tree has seen what the network's size is chosen by, which leaves a network less to better there.
    with_network = fit_residual(full.model, full.parameters, tree.needs, train, validation)
    found: dict[str, Predict] = {
        "usual-friction": predictor(*_parts(fit_friction(tree, data, LAWS[0]))),
        "chosen-friction": predictor(*_parts(full)),
        "with-residual": predictor(with_network.model, with_network.parameters),
    }
    found["learned-tree"] = predictor(*_parts(fit_friction(learned(tree.needs, train, validation), data, laws)))
    rival = regression(tree, data, velocity_scale=USUAL_SCALE)
    if rival is not None:
        found["pinocchio"] = lambda held: rival.torque(held.q, held.qd, held.qdd)
    return found


def learned(needs: Needs, train: Trajectories, validation: Trajectories) -> Tree:
    """A tree with frames learned from these motions alone."""
    wanted = needs._replace(friction=True)
    fits = [fit_tree(wanted, train, validation, velocity_scale=scale) for scale in LEARNED_SCALES]
    best = min(fits, key=lambda fit: fit.validation_error)
    tree = tree_of(best.parameters, wanted)
    return tree._replace(rotations=np.asarray(tree.rotations), positions=np.asarray(tree.positions))


def predictor(model: Any, parameters: Any) -> Predict:
    """A function from held-out samples to their torques."""
    batch = jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))
    return lambda held: np.asarray(batch(held.q, held.qd, held.qdd))


def error(fit: FrictionFit, validation: Trajectories) -> float:
    """Mean over joints of squared errors over the variance of their torque."""
    left = predictor(*_parts(fit))(validation) - validation.tau
    return float(np.mean(np.mean(left**2, axis=0) / validation.tau.var(axis=0)))


def _parts(fit: FrictionFit) -> tuple[Any, Any]:
    return fit.model, fit.parameters


def rows_of(squares: dict[str, list[np.ndarray]], variance: np.ndarray, names: Sequence[str]) -> list[Row]:
    """Rows by method: mean nMSE over joints for all blocks and for the worst pair of blocks, and nMSE by joint."""
    over = functools.partial(np.mean, axis=0)
    pairs = {name: np.array([over(each) / variance for each in found]) for name, found in squares.items()}
    every = {name: over(np.concatenate(found)) / variance for name, found in squares.items()}
    rows = []
    for name, each in every.items():
        case = f"recorded-arm/{name}"
        bound = None if name == "pinocchio" or "pinocchio" not in every else float(every["pinocchio"].mean())
        rows.append(Row(case, "nmse", float(each.mean()), bound=bound, expected="mean over joints, blocks held out"))
        rows.append(Row(case, "nmse_worst_blocks", float(pairs[name].mean(axis=1).max())))
        rows += [Row(case, f"nmse_{joint}", float(value)) for joint, value in zip(names, each, strict=True)]
    words = "with the network over without it, whose error it is to lower"
    without, extended = every["chosen-friction"].mean(), every["with-residual"].mean()
    return [*rows, expect("recorded-arm/with-residual", "over_without", words, extended / without, 1.0)]
