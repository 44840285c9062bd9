"""Fits trees of unknown joint frames: a search from random starts finds the frames, elimination everything else."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.identification.identify import identify, parameters_of
from dln_jax.learning.engine.problem import Training
from dln_jax.learning.kinematics.fit import fit_tree
from dln_jax.learning.kinematics.search import Search
from dln_jax.learning.objectives import Objective
from dln_jax.models.rigid_tree import USUAL, make_rigid_tree
from dln_jax.models.serial_tree import SerialTreeParameters, tree_of
from dln_jax.training.dynamics.methods.direct import refined_if_asked, training_of
from dln_jax.training.dynamics.options import TreeOptions
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Method, Refinement, Task
from dln_jax.training.identification.motions import choose_window, prediction_times, refit, spread_of
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import build, describe_for

BALL = np.array([2.0, 0, 0, 0, 0.02, 0, 0, 0.02, 0, 0.02])
"""Initial inertial parameters of bodies, in kg and kg m²."""


def needs_of_tree(needs: Needs) -> Needs:
    """Converts the needs to those of a learned tree, whose friction is viscous, dry and an offset per joint.

    Raises:
        InputError: friction laws that a learned tree does not have.
    """
    if others := [law for law in needs.joint_friction if law not in USUAL]:
        raise InputError(f"a learned tree has no {others[0]} friction; leave it out of joint_friction")
    return needs._replace(friction=bool(needs.joint_friction), joint_friction=())


def plan(options: TreeOptions, kind: str, recorded: Recorded, objective: Objective) -> tuple[dict[str, Any], None]:
    """Plans the tree with the stated parents of its joints."""
    needs = needs_of_tree(recorded.needs)
    stated = {"parents": recorded.parents, "velocity_scale": needs.velocity_scale}
    return describe_for(
        kind, recorded.sets.train, needs, precision=getattr(options, "precision", None) or "f64", **stated
    ), None


def fit(task: Task, options: Any, folder: Path, mesh: Mesh | None) -> tuple[Task, Training]:
    """Searches joint frames by Gauss-Newton, from random starts or near a prior, and eliminates everything else."""
    needs = needs_of_tree(task.needs)
    search = Search(seed=options.seed, seconds=task.seconds, kinematic_prior=task.recorded.kinematic_prior)
    solution = fit_tree(
        needs,
        task.sets.train,
        task.sets.validation,
        parents=task.description["parents"],
        acceleration=task.description["acceleration"],
        velocity_scale=task.description["velocity_scale"],
        settings=search,
        report=print,
    )
    size = f"{solution.parameter_count} parameters, of the linear ones rank {solution.rank}, "
    print(f"learned tree: {size}condition {solution.condition:.3g}")
    task, parameters = task._replace(search=solution), solution.parameters
    if getattr(options, "refine", None) == "motions":
        print("refining bodies and friction by motions, on these axes; inner splits choose the length of the windows")
        refinement = refined_by_motions(needs, task.description, task.sets, parameters)
        task, parameters = task._replace(refinement=refinement), refinement.parameters
    training = training_of(task, parameters, solution.torque_mse, solution.seconds)
    return task, refined_if_asked(task, training)


def refined_by_motions(
    needs: Needs, description: Mapping[str, Any], sets: Split, parameters: SerialTreeParameters,
    window: float | None = None,
) -> Refinement:  # fmt: skip
    """Refits bodies and friction on the same axes to motions; keeps them if they predict validation motions longer.

    The bodies start as balls, and a fit of torques first makes them physically consistent.

    Args:
        needs: needs of the tree, as by `needs_of_tree`.
        description: its parents, acceleration and velocity scale.
        sets: motions to fit, those that decide, and the test, which only measures.
        parameters: parameters of the tree, fitted to torques.
        window: length of the windows, s (default: chosen by inner splits).
    """
    scale = description["velocity_scale"]
    tree = tree_of(parameters, needs, parents=description["parents"], acceleration=description["acceleration"])
    d, friction = tree.degrees_of_freedom, USUAL if needs.friction else ()
    known = tree._replace(
        rotations=np.asarray(tree.rotations), positions=np.asarray(tree.positions),
        inertias=np.tile(BALL, (d, 1)), armature=np.full(d, BALL[-1]),
    )  # fmt: skip
    with jax.enable_x64(True):
        rigid = make_rigid_tree(known, friction=friction, velocity_scale=scale)
        prior = rigid.init(jax.random.key(0))
        solution = identify(rigid, prior, sets.train, joints=needs.joints)
        if window is None:
            window, line = choose_window("motions", rigid, prior, sets.train, sets.train, joints=needs.joints)
            print(line)
        solution, _ = refit("motions", rigid, prior, solution, sets.train, sets.train, window)
        fitted = parameters_of(solution.theta, prior)
        better = parameters._replace(
            **{name: value for name in parameters._fields if (value := getattr(fitted, name, None)) is not None}
        )
        variance, model = spread_of(sets.train, sets.validation), build(dict(description))

        def seconds(held: Trajectories) -> tuple[float, float]:
            times = (prediction_times(model, tried, held, variance)[0] for tried in (parameters, better))
            before, after = (float(np.mean(of_tree)) for of_tree in times)
            return before, after

        validation, test = seconds(sets.validation), seconds(sets.test)
    kept = validation[1] > validation[0]
    return Refinement(better if kept else parameters, kept, validation, test)


METHOD = Method(plan, fit)
