"""`identify --by torques, motions, both` on the recorded double pendulum: prediction times and torque errors.

The robot is a rigid tree of two links, the second 0.3 m from the first, with rough masses; the splits, filters and the
judgement are those of `double_pendulum`. Inner splits of the training recordings choose the windows of motions, which
both takes over.
"""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from dln_jax.identification.identify import identify, parameters_of
from dln_jax.mechanics.trees import inertial_parameters, serial
from dln_jax.models.model import Parameters
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.training.identification.motions import MotionSets, fit_by
from scripts.reports.robots.double_pendulum import HELD_OUT, QUANTITIES, Numbers, judged, read
from scripts.reports.robots.double_pendulum_fits import USUAL_SCALE, Fitted, Logs
from scripts.reports.rows import Row

LENGTH = 0.3
"""Distance of the joints, m; the only parameter of the arm that is not identified."""
ROUGH = inertial_parameters(0.6, [0.0, 0.0, -0.2], 1e-3 * np.eye(3))
"""Both links before identification."""
WAYS = ("torques", "motions", "both")
LEAST_GAIN = 1.2
"""Prediction time by both over that by torques, median over the splits."""


def rows(path: Path, held_out: Sequence[Sequence[str]] = HELD_OUT) -> list[Row]:
    """Prediction times and torque errors by way and split, and the ratios of the times to those by torques."""
    logs, listed = read(path), []
    splits = [split_numbers(logs, labels) for labels in held_out]
    for way in WAYS:
        for quantity, (unit, longer) in QUANTITIES.items():
            values = [numbers[way][quantity] for numbers in splits]
            of_splits = {f"_{'_'.join(labels)}": value for labels, value in zip(held_out, values, strict=True)}
            for suffix, value in {"": float(np.median(values)), **of_splits}.items():
                listed.append(Row(f"identify-by/{way}", quantity + suffix, value, unit, None, None, longer))
    ratios = {
        way: [numbers[way]["vpt_mean_seconds"] / numbers["torques"]["vpt_mean_seconds"] for numbers in splits]
        for way in WAYS[1:]
    }
    for way, values in ratios.items():
        for name, value, bound in (
            ("worst", float(np.min(values)), 1.0 if way == "motions" else None),
            ("median", float(np.median(values)), LEAST_GAIN if way == "both" else None),
        ):
            listed.append(Row(f"identify-by/{way}", f"vpt_over_torques_{name}", value, "1", None, bound, True))
    return listed


def split_numbers(logs: Logs, held_out: Sequence[str]) -> dict[str, Numbers]:
    """Numbers by way and quantity, with the recordings of these labels held out."""
    index = {label: place for place, label in enumerate(logs.fine.label)}
    test = [index[label] for label in held_out]
    rest = logs.of(index for index in np.unique(logs.fine.trajectory) if index not in test)
    held = logs.of(test)
    known: Parameters = MODEL.init(jax.random.key(0))
    solution = identify(MODEL, known, rest.coarse)
    fits, sets = {"torques": solution.theta}, MotionSets(rest.fine, held.fine)
    by_motions, _, choice = fit_by("motions", MODEL, known, solution, rest.coarse, sets, None)
    by_both = solution
    if choice.window is not None:
        by_both, *_ = fit_by("both", MODEL, known, solution, rest.coarse, sets, choice.window)
    fits |= {"motions": by_motions.theta, "both": by_both.theta}
    return {way: judged(Fitted(MODEL, parameters_of(theta, known)), held, logs) for way, theta in fits.items()}


TREE = serial(
    np.tile(np.eye(3), (2, 1, 1)), [[0.0, 0.0, 0.0], [0.0, 0.0, -LENGTH]], [ROUGH] * 2,
    axes=np.tile([0.0, 1.0, 0.0], (2, 1)), armature=np.full(2, 1e-3), gravity=(0.0, 0.0, -9.81),
)  # fmt: skip
MODEL = make_rigid_tree(TREE, friction=("viscous", "coulomb", "offset"), velocity_scale=USUAL_SCALE)
