"""A recorded arm, blocks held out: the tree of its file, with a network or not, a learned one, and Pinocchio's fit.

The log is cut into ten blocks; two neighbours at a time are held out, and every other sample is predicted by a model
that has not seen its block. Errors are over the variance of the whole log, so that a block in which a joint rests does
not count for more. Laws of friction, the network and the learned frames are chosen by blocks of the fitted data.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dln_jax.data import schema
from dln_jax.data.encoders import smooth
from dln_jax.data.robots import read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import in_blocks, select, with_joints
from dln_jax.identification.residual import fit_residual
from dln_jax.learning.friction import FrictionFit, fit_friction
from dln_jax.learning.kinematics import fit_tree
from dln_jax.mechanics.trees import Tree
from dln_jax.models.serial_tree import tree_of
from dln_jax.types import FrictionLaw, Needs
from scripts.reports.case import Findings
from scripts.reports.robots.arm import Torque, error_of, torque_of
from scripts.reports.robots.known_kinematics import USUAL_SCALE
from scripts.reports.robots.pinocchio import regression
from scripts.reports.rows import Row, expect

BLOCKS = 10
CUTOFF, DECIMATE = 5.0, 2
"""Cut-off of the filter of all data, Hz, and stride of the samples."""
LAWS: tuple[tuple[FrictionLaw, ...], ...] = (
    ("viscous", "coulomb", "offset"),
    ("viscous", "coulomb", "stribeck", "offset"),
    ("asymmetric", "offset"),
)
"""Candidate sets of friction laws."""
LEARNED_SCALES = (0.01, 0.1)
"""Candidate velocity scales, rad/s, of the dry friction of a learned tree while its frames are fitted."""
CHOOSING = 4
"""Stride of the fitted blocks that serve as validation."""


def recorded_arm(log: Path, robot: Path, quick: bool) -> Findings:
    """Errors of every block by models that have not seen it; a quick run holds out one pair of blocks.

    Raises:
        InputError: `read_robot` or `schema.load` refuses a file, or the joints do not agree.
    """
    tree = read_robot(robot).tree
    data = with_joints(schema.load(log), tree.names)
    data = in_blocks(smooth(data, CUTOFF, decimate=DECIMATE).data, BLOCKS)
    pairs = [(first, first + 1) for first in range(0, BLOCKS, 2)][: 1 if quick else None]
    squares: dict[str, list[np.ndarray]] = {}
    for pair in pairs:
        held = select(data, pair)
        for name, torque in methods(tree, select(data, np.setdiff1d(np.unique(data.trajectory), pair))).items():
            squares.setdefault(name, []).append((torque(held.q, held.qd, held.qdd) - held.tau) ** 2)
    return Findings(rows_of(squares, data.tau.var(axis=0), tree.names))


def methods(tree: Tree, data: Trajectories) -> dict[str, Torque]:
    """Torques by method, fitted to these blocks."""
    present = np.unique(data.trajectory)
    chosen = present[1::CHOOSING]
    train, validation = select(data, np.setdiff1d(present, chosen)), select(data, chosen)
    laws = min(LAWS, key=lambda laws: error_of(torque_by(fit_friction(tree, train, laws)), validation).mean())
    full = fit_friction(tree, data, laws)
    # The tree has seen what the network's size is chosen by, which leaves a network less to better there.
    with_network = fit_residual(full.model, full.parameters, tree.needs, train, validation)
    torques = {
        "usual-friction": torque_by(fit_friction(tree, data, LAWS[0])),
        "chosen-friction": torque_by(full),
        "with-residual": torque_of(with_network.model, with_network.parameters),
        "learned-tree": torque_by(fit_friction(learned(tree.needs, train, validation), data, laws)),
    }
    rival = regression(tree, data, velocity_scale=USUAL_SCALE)
    return torques if rival is None else {**torques, "pinocchio": rival}


def learned(needs: Needs, train: Trajectories, validation: Trajectories) -> Tree:
    """A tree with frames learned from these motions alone."""
    wanted = needs._replace(friction=True)
    fits = [fit_tree(wanted, train, validation, velocity_scale=scale) for scale in LEARNED_SCALES]
    best = min(fits, key=lambda fit: fit.validation_error)
    tree = tree_of(best.parameters, wanted)
    return tree._replace(rotations=np.asarray(tree.rotations), positions=np.asarray(tree.positions))


def torque_by(fit: FrictionFit) -> Torque:
    """The torques of a fit."""
    return torque_of(fit.model, fit.parameters)


def rows_of(squares: dict[str, list[np.ndarray]], variance: np.ndarray, names: Sequence[str]) -> list[Row]:
    """Rows by method: mean nMSE over joints for all blocks and for the worst pair of blocks, and nMSE by joint."""
    every = {name: np.mean(np.concatenate(errors), axis=0) / variance for name, errors in squares.items()}
    bound = float(every["pinocchio"].mean()) if "pinocchio" in every else None
    rows = []
    for name, errors in every.items():
        case, limit = f"recorded-arm/{name}", None if name == "pinocchio" else bound
        worst = max(float(np.mean(pair.mean(axis=0) / variance)) for pair in squares[name])
        rows.append(Row(case, "nmse", float(errors.mean()), bound=limit, expected="mean over joints, blocks held out"))
        rows.append(Row(case, "nmse_worst_blocks", worst))
        rows += [Row(case, f"nmse_{joint}", float(value)) for joint, value in zip(names, errors, strict=True)]
    words = "with the network over without it, whose error it is to lower"
    ratio = every["with-residual"].mean() / every["chosen-friction"].mean()
    return [*rows, expect("recorded-arm/with-residual", "over_without", words, ratio, 1.0)]
