"""Recordings of real robots: a double pendulum with motors, and an arm whose file is known.

The double pendulum is `design_A.0` (DFKI, BSD 3-Clause): nine recordings of q, t and tau, of which pairs are held out.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from dln_jax import Model, read_robot
from dln_jax.commands.identification.motions import choose_window, refit
from dln_jax.data import schema
from dln_jax.data.encoders.filters import low_pass
from dln_jax.data.encoders.smoothing import TRIMMED, smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import in_blocks, label_indices, select, with_joints
from dln_jax.identification.identify import identify
from dln_jax.identification.residual import fit_residual
from dln_jax.learning.friction import fit_friction
from dln_jax.learning.kinematics.fit import fit_tree
from dln_jax.learning.linear import design, parameters_of, unravelled
from dln_jax.mechanics.trees.description import Tree, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.metrics.predictions import cut_segments, predict_measured, valid_times
from dln_jax.models.model import Parameters
from dln_jax.models.trees import make_rigid_tree, tree_of
from dln_jax.models.trigonometric import make_planar_chain
from dln_jax.solvers import least_squares
from dln_jax.types import FrictionLaw, InputError, Needs
from scripts.reports.robots.arm import Torque, error_of, regression, torque_of
from scripts.reports.robots.known_kinematics import USUAL_SCALE
from scripts.reports.run import Numbers

CUTOFF, FINE, BASE, RATE = 6.0, 30.0, 500.0, 100.0
"""Cut-off at which least squares of filtered motions predict held-out recordings best (of 2, 3, 4, 6, 8, 10, 12, 25),
cut-off that keeps the motion, approximate rate of the recordings, and rate of the fitted samples, Hz."""
HELD_OUT = (("02", "11"), ("00", "12"), ("04", "13"), ("01", "05"), ("03", "13"))
"""Held-out recordings, by split."""
WINDOW = 11
"""Samples of a window and of a prediction's fitted start: 0.1 s."""
PENDULUM_SCALE, SCALES = 0.1, (0.05, 0.1, 0.2, 0.5, 1.0)
"""Default and candidate velocity scales of dry friction, rad/s."""
LAWS: tuple[tuple[FrictionLaw, ...], ...] = (
    ("viscous", "coulomb", "offset"),
    ("viscous", "coulomb", "stribeck", "offset"),
    ("asymmetric", "offset"),
)
"""Candidate sets of friction laws of the arm."""
Logs = tuple[Trajectories, Trajectories]
"""Recordings filtered at `CUTOFF`, and so that they keep the motion, at the same times."""


def double_pendulum(*, double_pendulum: Path | None = None, splits: int = len(HELD_OUT)) -> Numbers:
    """Planar chains of ten parameters, fitted in several ways to the recordings that are not held out.

        least-squares   torques of filtered motions, as engineers fit them; q and tau are filtered alike
        chosen-scale    the same, with the velocity scale that explains each recording best from the others
        low-passed      the regressor of less filtered motions is filtered, and tau with it
        stacked         the equations of both, with equal weights

    Recorded torques explain slow accelerations well and those above 3 Hz badly, because forces act that were not
    recorded. They draw least squares of torques to small inertias, which are best for torques and bad for predictions.
    """

    def fits(rest, held):
        scale, usual = best_scale(rest), chain(PENDULUM_SCALE)
        model = chain(scale)
        coarse, smoothed = (equations(model, rest, filtered=filtered) for filtered in (False, True))
        solved = {"chosen-scale": coarse, "low-passed": smoothed, "stacked": [*coarse, *smoothed]}
        chosen = {name: (model, with_vector(model, solution(measured))) for name, measured in solved.items()}
        return {"least-squares": (usual, with_vector(usual, solution(equations(usual, rest)))), **chosen}

    return judged("double-pendulum", double_pendulum, splits, fits)


def identify_by(*, double_pendulum: Path | None = None, splits: int = len(HELD_OUT)) -> Numbers:
    """`identify --by torques, motions, both`: a rigid tree of two links, the second 0.3 m from the first, rough masses.

    Inner splits of the training recordings choose the windows of motions, which both takes over.
    """
    link = inertial_parameters(0.6, [0.0, 0.0, -0.2], 1e-3 * np.eye(3))
    tree = serial(
        np.tile(np.eye(3), (2, 1, 1)), [[0.0, 0.0, 0.0], [0.0, 0.0, -0.3]], [link] * 2,
        axes=np.tile([0.0, 1.0, 0.0], (2, 1)), armature=np.full(2, 1e-3), gravity=(0.0, 0.0, -9.81),
    )  # fmt: skip
    model = make_rigid_tree(tree, friction=LAWS[0], velocity_scale=PENDULUM_SCALE)
    known: Parameters = model.init(jax.random.key(0))

    def fits(rest, held):
        by_torques = identify(model, known, rest[0])
        window, _ = choose_window("motions", model, known, *rest)
        by_motions, by_both = (
            refit(by, model, known, by_torques, rest[0], rest[1], window)[0] for by in ("motions", "both")
        )
        measured = {"torques": by_torques, "motions": by_motions, "both": by_both}
        return {way: (model, parameters_of(solution.theta, known)) for way, solution in measured.items()}

    numbers = judged("identify-by", double_pendulum, splits, fits)
    by_torques = numbers.get("identify-by/torques", {})
    of_splits = [key for key in by_torques if key.startswith("vpt") and key[-1].isdigit()]
    for row in numbers.values():
        ratios = [row[key] / by_torques[key] for key in of_splits]
        row |= {"vpt_over_torques_worst": np.min(ratios), "vpt_over_torques_median": np.median(ratios)}
    return numbers


def judged(name: str, path: Path | None, splits: int, fits) -> dict[str, dict[str, float]]:
    """Torque errors of filtered motions and valid prediction times by way to fit: median, worst, and by split.

    Errors are relative to the variance over all recordings, times are means over segments of 2.2 s.
    """
    if path is None:
        return {}
    known = {"rate": BASE, "trim": 0.3, "decimate": round(BASE / RATE), "filter_torque": True}
    coarse, fine = (smooth(schema.load(path), cutoff, **known).data for cutoff in (CUTOFF, FINE))
    measured: dict[str, list[tuple[float, float]]] = {}
    for labels in HELD_OUT[:splits]:
        held = label_indices(fine, labels)
        others = np.setdiff1d(np.unique(fine.trajectory), held)
        rest, test = ((select(coarse, part), select(fine, part)) for part in (others, held))
        segments = cut_segments(test[1], round(2.2 * RATE), every=round(0.5 * RATE))
        for way, (model, parameters) in fits(rest, test).items():
            off = torque_of(model, parameters)(test[0].q, test[0].qd, test[0].qdd) - test[0].tau
            predicted = predict_measured(model, parameters, segments, fitted=WINDOW)
            times = valid_times(segments, predicted, fitted=WINDOW, variance=fine.q.var(axis=0))
            error = float(np.mean(off**2 / coarse.tau.var(axis=0)))
            measured.setdefault(f"{name}/{way}", []).append((error, float(np.mean(times))))
    numbers = {}
    for way, values in measured.items():
        errors, times = np.transpose(values)
        numbers[way] = {
            "torque_nmse": np.median(errors),
            "torque_nmse_worst": np.max(errors),
            "vpt_mean_seconds": np.median(times),
            "vpt_mean_seconds_worst": np.min(times),
            **{f"vpt_mean_seconds_{'_'.join(key)}": time for key, time in zip(HELD_OUT, times, strict=False)},
        }
    return numbers


def chain(velocity_scale: float) -> Model:
    """The planar chain of two links with motors."""
    needs = Needs(joints=("revolute", "revolute"), friction=True, velocity_scale=velocity_scale)
    return make_planar_chain(needs, armature=True, velocity_scale=velocity_scale)


def equations(model: Model, logs: Logs, *, filtered: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """Columns and torques of each recording over the torques' deviations: coarse motions, or low-passed fine ones.

    Ends of low-passed columns are dropped, where the filter has data on one side only.
    """
    data, scale = logs[int(filtered)], logs[0].tau.std(axis=0)
    Phi = np.asarray(design(model)(model.init(jax.random.key(0)), data.q, data.qd, data.qdd)[0])
    ends, listed = round(TRIMMED * RATE / CUTOFF), []
    for index in np.unique(data.trajectory):
        both = np.concatenate([Phi, data.tau[:, :, None]], axis=2)[data.trajectory == index] / scale[:, None]
        if filtered:
            columns = low_pass(both.reshape(len(both), -1), rate=RATE, cutoff=CUTOFF)[ends:-ends]
            both = columns.reshape(-1, *both.shape[1:])
        rows = both.reshape(-1, both.shape[2])
        listed.append((rows[:, :-1], rows[:, -1]))
    return listed


def solution(listed: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Least squares of equations."""
    A, b = (np.concatenate(parts) for parts in zip(*listed, strict=True))
    return least_squares.solve(A, b).x


def best_scale(logs: Logs) -> float:
    """The velocity scale with the lowest leave-one-out error over the recordings."""
    errors = []
    for scale in SCALES:
        listed = equations(chain(scale), logs)
        off = [A @ solution(listed[:out] + listed[out + 1 :]) - b for out, (A, b) in enumerate(listed)]
        errors.append(np.mean(np.concatenate(off) ** 2))
    return SCALES[int(np.argmin(errors))]


def with_vector(model: Model, x: np.ndarray) -> Parameters:
    """Parameters from their vector."""
    return unravelled(x, model.init(jax.random.key(0)))


def recorded_arm(*, log: Path | None = None, robot: Path | None = None, pairs: int = 5) -> Numbers:
    """A recorded arm in ten blocks, two neighbours held out at a time, by models that have not seen them.

    Errors are over the variance of the whole log, so that a block in which a joint rests does not count for more. Laws
    of friction, the network and the learned frames are chosen by blocks of the fitted data.
    """
    if log is None and robot is None:
        return {}
    if log is None or robot is None:
        raise InputError("--log and --robot belong together; give both, or neither")
    tree = read_robot(robot).tree
    data = in_blocks(smooth(with_joints(schema.load(log), tree.names), 5.0, decimate=2).data, 10)
    squares: dict[str, list[np.ndarray]] = {}
    for pair in ((2 * place, 2 * place + 1) for place in range(pairs)):
        held = select(data, pair)
        for name, torque in arm_fits(tree, select(data, np.setdiff1d(np.unique(data.trajectory), pair))).items():
            squares.setdefault(name, []).append((torque(held.q, held.qd, held.qdd) - held.tau) ** 2)
    return block_errors(squares, data.tau.var(axis=0), tree.names)


def block_errors(squares: Mapping[str, list[np.ndarray]], variance: np.ndarray, names: Sequence[str]) -> Numbers:
    """Mean nMSE over joints for all blocks and for the worst pair of blocks, and nMSE by joint."""
    numbers: dict[str, dict[str, float]] = {}
    for name, errors in squares.items():
        joints = np.mean(np.concatenate(errors), axis=0) / variance
        worst = max(float(np.mean(pair.mean(axis=0) / variance)) for pair in errors)
        by_joint = {f"nmse_{joint}": value for joint, value in zip(names, joints, strict=True)}
        numbers[f"recorded-arm/{name}"] = {"nmse": joints.mean(), "nmse_worst_blocks": worst, **by_joint}
    for name, over, other in (
        ("with-residual", "over_without", "chosen-friction"),
        ("chosen-friction", "over_pinocchio", "pinocchio"),
    ):
        if other in squares:
            own, rival = (numbers[f"recorded-arm/{kind}"]["nmse"] for kind in (name, other))
            numbers[f"recorded-arm/{name}"][over] = own / rival
    return numbers


def arm_fits(tree: Tree, data: Trajectories) -> dict[str, Torque]:
    """Torques by method, fitted to these blocks; every fourth one chooses."""
    present = np.unique(data.trajectory)
    chosen = present[1::4]
    train, validation = select(data, np.setdiff1d(present, chosen)), select(data, chosen)

    def torque_by(fitted):
        return torque_of(fitted.model, fitted.parameters)

    laws = min(LAWS, key=lambda laws: error_of(torque_by(fit_friction(tree, train, laws)), validation).mean())
    full = fit_friction(tree, data, laws)
    # The tree has seen what the network's size is chosen by, which leaves a network less to better there.
    model, parameters, _ = fit_residual(full.model, full.parameters, tree.needs, train, validation)
    needs = tree.needs._replace(friction=True)
    trees = [fit_tree(needs, train, validation, velocity_scale=scale) for scale in (0.01, 0.1)]
    learned = tree_of(min(trees, key=lambda measured: measured.validation_error).parameters, needs)
    frames = {"rotations": np.asarray(learned.rotations), "positions": np.asarray(learned.positions)}
    torques = {
        "usual-friction": torque_by(fit_friction(tree, data, LAWS[0])),
        "chosen-friction": torque_by(full),
        "with-residual": torque_of(model, parameters),
        "learned-tree": torque_by(fit_friction(learned._replace(**frames), data, laws)),
    }
    rival = regression(tree, data, USUAL_SCALE)
    return torques if rival is None else {**torques, "pinocchio": rival}
