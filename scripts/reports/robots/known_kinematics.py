"""A seven-axis arm with known frames, identified from logs: torque errors on unseen motions, and tracking at 1 kHz.

The rival gets the same samples, filter and columns, and in a second run also our velocity scales. Errors are those on
noise-free unseen motions of the true arm.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.encoders import smooth
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import every
from dln_jax.identification import identify, parameters_of
from dln_jax.learning.friction import fit_friction
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import Tree, tree_system
from dln_jax.models.rigid_tree import make_rigid_tree
from scripts.reports.case import Findings
from scripts.reports.robots.arm import (
    D,
    Log,
    Motion,
    Torque,
    arm,
    error_of,
    exact_torque,
    follow,
    logs,
    measured,
    motion,
    torque_of,
)
from scripts.reports.robots.pinocchio import regression
from scripts.reports.rows import Row, expect

LAWS = ("viscous", "coulomb", "offset")
USUAL_SCALE = 0.01
"""Velocity scale of dry friction, rad/s, where it is not fitted: for the rival and our robust fit."""
DECIMATE = 3
"""Stride of the fitted samples; torques are not filtered, which would smear dry friction."""
CLEAN, SEEN = 1e-12, 1.65e-3
"""nMSE to reach: on clean data with viscous friction, and on noisy data with dry friction (a regressor's result)."""
TRACKING = 1.1
"""Tracking error to reach, relative to the error with true parameters."""


class Effort(NamedTuple):
    """Size of the measurement."""

    seeds: int
    motions: int
    unseen: int


FULL, QUICK = Effort(5, 15, 6), Effort(1, 4, 2)


def rough(tree: Tree) -> Tree:
    """The tree with inertias that an engineer would guess: balls of 2 kg at the joints, and no armature."""
    ball = np.array([2.0, 0, 0, 0, 0.02, 0, 0, 0.02, 0, 0.02])
    return tree._replace(inertias=np.tile(ball, (tree.degrees_of_freedom, 1)), armature=np.full(D, 0.05))


def identified(tree: Tree, data: Trajectories, scale: Any, *, robust: bool = False) -> tuple[Any, Any]:
    """Model and parameters of our identification: physically consistent, torques weighted by their noise.

    Args:
        tree: tree with known frames.
        data: data to fit.
        scale: velocity scale of dry friction, rad/s, by joint or one for all.
        robust: use Huber's loss, which is linear in errors beyond the noise, such as at reversals of friction.
    """
    shape = tuple(np.broadcast_to(scale, D).tolist())
    model = make_rigid_tree(rough(tree), friction=LAWS, velocity_scale=shape)
    start = model.init(jax.random.key(0))._replace(viscous=jnp.full(D, 0.5), coulomb=jnp.full(D, 0.5))
    solution = identify(model, start, data, joints=tree.joints, robust=robust)
    return model, parameters_of(solution.theta, start)


def clean(quick: bool) -> Findings:
    """Exact states of an arm with viscous friction."""
    effort, robot, errors = (QUICK if quick else FULL), arm(coulomb=False), []
    for seed in range(effort.seeds):
        random = np.random.default_rng(seed)
        train, test = (logs(robot, random, count) for count in (effort.motions, effort.unseen))
        model = make_rigid_tree(rough(robot.tree), friction=True)
        start = model.init(jax.random.key(0))
        solution = identify(model, start, every(train, DECIMATE), joints=robot.tree.joints, consistent=False)
        errors.append(error_of(torque_of(model, parameters_of(solution.theta, start)), test).mean())
    words = f"of torques on unseen motions, the worst of {effort.seeds} seeds"
    return Findings([expect("arm/clean-viscous", "nmse", words, max(errors), CLEAN)])


def noisy(quick: bool) -> Findings:
    """Noisy encoders and torques, dry friction: our fit (fitted scales, or robust), and Pinocchio's regressor."""
    effort, robot = (QUICK if quick else FULL), arm(coulomb=True)
    by_method: dict[str, list[np.ndarray]] = {}
    tracked: dict[str, list[float]] = {}
    for seed in range(effort.seeds):
        random = np.random.default_rng(seed)
        train, test = (logs(robot, random, count) for count in (effort.motions, effort.unseen))
        data = every(smooth(from_arrays(measured(train, random))).data, DECIMATE)
        scales = fit_friction(rough(robot.tree), data, LAWS).shape["velocity_scale"]
        methods = {
            "ours": torque_of(*identified(robot.tree, data, scales)),
            "ours-robust": torque_of(*identified(robot.tree, data, USUAL_SCALE, robust=True)),
        }
        for name, scale in (("pinocchio", USUAL_SCALE), ("pinocchio-with-our-scales", scales)):
            if (rival := regression(robot.tree, data, velocity_scale=scale)) is not None:
                methods[name] = rival
        for name, torque in methods.items():
            by_method.setdefault(name, []).append(error_of(torque, test))
        for name, values in tracking(robot, methods, random, effort.unseen).items():
            tracked.setdefault(name, []).extend(values)
    return Findings([*rows_of_errors(by_method, effort.seeds), *rows_of_tracking(tracked)])


def tracking(
    robot: Robot, methods: dict[str, Torque], random: np.random.Generator, count: int
) -> dict[str, list[float]]:
    """Rms tracking errors, mrad, on unseen motions under PD control, by model of the feed-forward and without any."""
    true = tree_system(robot.tree, joint_dissipation(robot.damping, robot.coulomb, velocity_scale=USUAL_SCALE))
    exact = jax.jit(jax.vmap(dynamics(true).inverse_dynamics))
    feeds: dict[str, Callable[[Motion], np.ndarray | None]] = {
        "without": lambda wanted: None,
        "simulator": lambda wanted: exact_torque(robot, wanted),
        "true-parameters": lambda wanted: np.asarray(exact(*wanted)),
        **{name: lambda wanted, torque=torque: torque(*wanted) for name, torque in methods.items()},
    }
    errors: dict[str, list[float]] = {name: [] for name in feeds}
    for _ in range(count):
        wanted = motion(random)
        for name, feed in feeds.items():
            errors[name].append(1e3 * rms(follow(robot, wanted, feed(wanted))))
    return errors


def rows_of_errors(by_method: dict[str, list[np.ndarray]], seeds: int) -> list[Row]:
    """Median and worst over seeds of the mean nMSE over joints, and our errors relative to the rivals'."""
    means = {name: np.mean(errors, axis=1) for name, errors in by_method.items()}
    rows = []
    for name, values in means.items():
        case, bound = f"arm/noisy-coulomb/{name}", SEEN if name == "ours" else None
        rows.append(Row(case, "nmse", float(np.median(values)), bound=bound, expected=f"median of {seeds} seeds"))
        rows.append(Row(case, "nmse_worst", float(np.max(values))))
        if name.startswith("pinocchio"):
            words = f"median over seeds of ours over {name}, the same samples and filter"
            ratio = np.median(means["ours"] / values)
            rows.append(expect("arm/noisy-coulomb/ours", f"over_{name}", words, ratio, 1))
    return rows


def rows_of_tracking(tracked: dict[str, list[float]]) -> list[Row]:
    """Median errors over motions and seeds, and our errors relative to those with true parameters."""
    rows = [
        Row(f"arm/tracking/{name}", "rms_mrad", float(np.median(errors)), "mrad") for name, errors in tracked.items()
    ]
    words = "median over motions of ours over that with true parameters and dry friction of the usual scale"
    for name in (name for name in tracked if name.startswith("ours")):
        ratio = np.median(np.divide(tracked[name], tracked["true-parameters"]))
        rows.append(expect(f"arm/tracking/{name}", "over_true_parameters", words, float(ratio), TRACKING))
    return rows


def rms(log: Log) -> float:
    """Root mean square tracking error, rad."""
    return float(np.sqrt(np.mean((log.q - log.reference) ** 2)))
