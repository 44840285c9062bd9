"""The plant of a value function: of a robot file, or of the run folder of a model; and uncertain plants."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.optimal.own_plants import FOLDER, OwnProblem, own_problem
from dln_jax.control.plants.mujoco_plants import mujoco_plant, plant_file
from dln_jax.control.plants.plant import Layout, extremes, layout
from dln_jax.control.state_space import Field, field_of
from dln_jax.data.joints import needs_from_json
from dln_jax.data.robots import read_robot
from dln_jax.mechanics import equations
from dln_jax.mechanics.dynamics import Dynamics, PhaseRates
from dln_jax.mechanics.trees.description import tree_to_json
from dln_jax.models.model import Model
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import Run, load

file_of = functools.partial(plant_file, FOLDER)
"""The file of a desktop plant by its name, or a path."""


def of_file(path: Path, actuated: Sequence[str] = (), control: Any = None, goal: Any = None) -> tuple[Run, Layout, str]:
    """Returns the rigid-body tree of an MJCF or URDF file with viscous friction, its layout, and what it omits.

    Raises:
        InputError: raised by `read_robot` and `mujoco_plant`.
    """
    robot = read_robot(path)
    known = mujoco_plant(path, actuated, control=control, goal=goal, passive=False).layout
    needs = robot.tree.needs._replace(actuation=tuple(map(tuple, known.actuation.tolist())))
    viscous = bool(robot.damping.any())
    if viscous:
        needs = needs._replace(joint_friction=("viscous",))
    description = describe("rigid-tree", precision="f64", needs=needs, tree=tree_to_json(robot.tree))
    model = build(description)
    parameters = model.init(jax.random.key(0))
    if viscous:
        parameters = parameters._replace(viscous=robot.damping)
    lacking = ""
    if robot.coulomb.any():
        dry = ", ".join(f"{name} {value:.3g}" for name, value in zip(robot.tree.names, robot.coulomb, strict=True))
        lacking = f"dry friction is not in the model, which has to be smooth: {dry} N m or N"
    return Run(model, parameters, description), known, lacking


def of_run(
    folder: Path, actuated: Sequence[str] = (), control: Any = None, goal: Any = None
) -> tuple[Run, Layout, str]:
    """Returns the learned or identified model in a run folder, and its layout; it omits nothing.

    Raises:
        InputError: as for `load`; or the model has no dynamics, or lacks limits, motors or a goal.
    """
    run = load(folder)
    if not isinstance(run.model, Model) or isinstance(run.energies, PhaseRates) or "needs" not in run.description:
        raise InputError(f"{folder} holds a {run.description['name']}; expected a model of joints with dynamics")
    needs = needs_from_json(run.description["needs"])
    d = len(needs.joints)
    B = np.ones((d, 1)) if needs.actuation is None else np.asarray(needs.actuation)
    if not all(joint.isdecimal() and int(joint) < d for joint in actuated):
        raise InputError(f"--actuated is {','.join(actuated)}; the model's joints are the numbers 0 to {d - 1}")
    driven = sorted({int(joint) for joint in actuated}) or np.flatnonzero(B.any(axis=1)).tolist()
    if control is None:
        raise InputError(f"{folder} states no limits of the motors; give the largest force (--control), N m or N")
    model, hanging = equations.dynamics(run.energies, degrees_of_freedom=d), goal
    if isinstance(model, Dynamics):
        energy = jax.jit(lambda q: model.energy(q, jnp.zeros(d)))
        ranges = np.tile([-np.inf, np.inf], (d, 1))
        hanging, highest = extremes(lambda q: float(energy(q)), needs.joints, driven, ranges)
        goal = highest if goal is None else goal
    if goal is None:
        raise InputError(f"a {run.description['name']} has no energy, whose highest posture is the goal; give --goal")
    known = layout(needs.joints, driven, goal=goal, hanging=hanging, rate=500.0, control=control, passive=False)
    return run, known, ""


def problem_of(run: Run, known: Layout, positions: Any = None, **wishes: Any) -> OwnProblem:
    """The control problem of a model; `positions` [d, 2] replace the layout's, `wishes` are those of `own_problem`."""
    if positions is not None:
        ranges, limits = np.asarray(positions, float), known.limits
        if ranges.shape != limits.position.shape:
            raise InputError(f"--positions has {len(ranges)} ranges; the plant has {len(limits.position)} joints")
        low, high = ranges.T
        if any((q < low).any() or (q > high).any() for q in (known.goal, known.hanging)):
            raise InputError(f"--positions are {ranges.tolist()}; the goal or the posture of rest is outside")
        known = known._replace(limits=limits._replace(position=ranges))
    with jax.enable_x64(True):
        model = equations.dynamics(run.energies, degrees_of_freedom=len(known.joints))
        return own_problem(model, known, **wishes)


def uncertain_numbers(run: Run, problem: OwnProblem) -> tuple[tuple[str, ...], Callable[[Array], Field]]:
    """Names of a plant's uncertain numbers, and factors of these -> the plant's field.

    These are the strengths of the motors and, of a tree, the masses of the bodies before them.
    """
    model: Any = run.model
    parameters = jax.tree.map(np.asarray, run.parameters)
    B = np.asarray(problem.actuation)
    d, motors = B.shape
    masses = d if "tree" in run.description else 0

    def altered(p: Array) -> Field:
        changed = parameters._replace(inertias=parameters.inertias * p[:masses, None]) if masses else parameters
        field = field_of(equations.dynamics(model.energies(changed), degrees_of_freedom=d), B)
        return lambda x, u: field(x, p[masses:] * u)

    return (*("mass of bodies",) * masses, *("strength of motors",) * motors), altered
