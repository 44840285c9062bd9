"""A seven-axis arm with known frames, identified from logs: torque errors on unseen motions, and tracking at 1 kHz.

The rival gets the same samples, filter and columns, and in a second run also our velocity scales. Errors are those on
noise-free unseen motions of the true arm.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import every
from dln_jax.identification import identify, parameters_of
from dln_jax.learning.friction import fit_friction
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import Tree, tree_system
from dln_jax.models.rigid_tree import make_rigid_tree
from scripts.reports.robots.arm import D, arm, error_of, exact_torque, follow, logs, measured, motion, torque_of
from scripts.reports.robots.pinocchio import regression
from scripts.reports.run import Numbers

LAWS = ("viscous", "coulomb", "offset")
USUAL_SCALE = 0.01
"""Velocity scale of dry friction, rad/s, where it is not fitted: for the rival and our robust fit."""
DECIMATE = 3
"""Stride of the fitted samples; torques are not filtered, which would smear dry friction."""


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


def clean(*, seeds: int = 5, motions: int = 15, unseen: int = 6) -> Numbers:
    """Exact states of an arm with viscous friction: the worst error of the seeds."""
    robot, errors = arm(coulomb=False), []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        train, test = (logs(robot, random, count) for count in (motions, unseen))
        model = make_rigid_tree(rough(robot.tree), friction=True)
        start = model.init(jax.random.key(0))
        solution = identify(model, start, every(train, DECIMATE), joints=robot.tree.joints, consistent=False)
        errors.append(error_of(torque_of(model, parameters_of(solution.theta, start)), test).mean())
    return {"arm/clean-viscous": {"nmse": max(errors)}}


def noisy(*, seeds: int = 5, motions: int = 15, unseen: int = 6) -> Numbers:
    """Noisy encoders and torques, dry friction: our fit (fitted scales, or robust), and Pinocchio's regressor.

    Errors are means over joints. Each method is also the feed-forward of PD control along the unseen motions.
    """
    robot = arm(coulomb=True)
    true = tree_system(robot.tree, joint_dissipation(robot.damping, robot.coulomb, velocity_scale=USUAL_SCALE))
    exact = jax.jit(jax.vmap(dynamics(true).inverse_dynamics))
    errors: dict[str, list[float]] = {}
    tracked: dict[str, list[float]] = {}
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        train, test = (logs(robot, random, count) for count in (motions, unseen))
        data = every(smooth(from_arrays(measured(train, random))).data, DECIMATE)
        scales = fit_friction(rough(robot.tree), data, LAWS).shape["velocity_scale"]
        methods = {
            "ours": torque_of(*identified(robot.tree, data, scales)),
            "ours-robust": torque_of(*identified(robot.tree, data, USUAL_SCALE, robust=True)),
            "pinocchio": regression(robot.tree, data, USUAL_SCALE),
            "pinocchio-with-our-scales": regression(robot.tree, data, scales),
        }
        methods = {name: torque for name, torque in methods.items() if torque}
        for name, torque in methods.items():
            errors.setdefault(name, []).append(float(error_of(torque, test).mean()))
        for _ in range(unseen):
            wanted = motion(random)
            feeds = {"without": None, "simulator": exact_torque(robot, wanted)}
            feeds["true-parameters"] = np.asarray(exact(*wanted))
            for name, feed in (feeds | {name: torque(*wanted) for name, torque in methods.items()}).items():
                q, _, _, _, reference = follow(robot, wanted, feed)
                tracked.setdefault(name, []).append(1e3 * float(np.sqrt(np.mean((q - reference) ** 2))))
    return summary(errors, tracked)


def summary(errors: dict[str, list[float]], tracked: dict[str, list[float]]) -> Numbers:
    """Medians and worst over seeds, and medians of our errors relative to the rival's and to true parameters."""
    numbers = {}
    for name, values in errors.items():
        numbers[f"arm/noisy-coulomb/{name}"] = {"nmse": np.median(values), "nmse_worst": np.max(values)}
        if name.startswith("pinocchio"):
            numbers["arm/noisy-coulomb/ours"][f"over_{name}"] = np.median(np.divide(errors["ours"], values))
    for name, values in tracked.items():
        numbers[f"arm/tracking/{name}"] = {"rms_mrad": np.median(values)}
        if name.startswith("ours"):
            ratio = np.median(np.divide(values, tracked["true-parameters"]))
            numbers[f"arm/tracking/{name}"]["over_true_parameters"] = ratio
    return numbers
