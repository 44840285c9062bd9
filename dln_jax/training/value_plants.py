"""Plants of value functions: published ones by name, a user's own from a robot file or the run folder of a model."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.optimal.own_plants import OwnProblem, described, own_plant, own_problem, own_settings
from dln_jax.control.optimal.plants import FITS, PLANTS, ValuePlant, ValueSettings
from dln_jax.control.optimal.problem import ControlProblem, at_goal, from_field, rates
from dln_jax.control.plants.mujoco_plants import layout_of_file
from dln_jax.control.plants.plant import Layout, layout
from dln_jax.control.plants.postures import extremes
from dln_jax.control.state_space import Field, field_of
from dln_jax.data.robots import read_robot
from dln_jax.data.stated_needs import needs_from_json
from dln_jax.mechanics import equations
from dln_jax.mechanics.dynamics import Dynamics, PhaseRates, PlainDynamics
from dln_jax.mechanics.trees.description import tree_to_json
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import Description, build, describe
from dln_jax.zoo.run import load

OTHER_NAMES = {"furuta": "rotary-pendulum", "cartpole": "cart-pole"}
FILES = (".xml", ".mjcf", ".urdf")
"""Suffixes of robot files."""
OWN = "own"
"""Name of a user's own plant in the manifest of a value function."""


class OwnModel(NamedTuple):
    """Model of a user's own plant, as its run folder stores it."""

    description: Description
    parameters: Parameters
    problem: OwnProblem


class Chosen(NamedTuple):
    """A plant with the usual settings of its fit."""

    name: str
    plant: ValuePlant
    settings: ValueSettings
    altered: Callable[[Array], Field]
    """Factors of the plant's uncertain numbers -> its field."""
    uncertain: tuple[str, ...]
    """Names of the numbers that the factors multiply."""
    own: OwnModel | None = None
    lines: tuple[str, ...] = ()


class Wishes(NamedTuple):
    """A user's settings for a plant; `None` for the defaults."""

    actuated: Sequence[str] = ()
    control: Any = None
    goal: Any = None
    positions: Any = None
    effort: float | None = None
    weights: Any = None
    box: Any = None


def plant_named(name: str, goal: Sequence[float] | None = None) -> ValuePlant:
    """The plant with this name, with a posture [d] other than upright as its goal, if requested.

    Raises:
        InputError: an unknown name (the message lists all), or a goal of the wrong length or that no control can hold.
    """
    name = OTHER_NAMES.get(name, name)
    if name not in PLANTS:
        raise InputError(f"plant '{name}' is unknown; choose from {', '.join(PLANTS)}, or give the path of a file")
    plant = PLANTS[name]()
    if goal is None:
        return plant
    d = len(plant.problem.goal) // 2
    if len(goal) != d:
        raise InputError(f"the goal has {len(goal)} coordinates; expected the posture of {name}, which has {d}")
    return plant._replace(problem=at_goal(plant.problem, [*goal, *np.zeros(d)]))


def is_file_of_plant(plant: str) -> bool:
    """Whether a plant is named by a file."""
    return Path(plant).suffix.lower() in FILES or Path(plant).is_file()


def published(name: str, goal: Sequence[float] | None) -> Chosen:
    """A published plant; its uncertain numbers are the strengths of its motors."""
    plant, name = plant_named(name, goal), OTHER_NAMES.get(name, name)
    motors = plant.problem.actuation(jnp.asarray(plant.problem.goal, float)).shape[1]
    field = rates(plant.problem)
    return Chosen(name, plant, FITS[name], lambda p: lambda x, u: field(x, p * u), ("strength of motors",) * motors)


def of_file(path: Path, wishes: Wishes) -> Chosen:
    """The plant of an MJCF or URDF file: its tree of rigid bodies with viscous friction.

    Raises:
        InputError: raised by `read_robot`, `layout_of_file` and `own_problem`.
    """
    robot = read_robot(path)
    robot_layout = layout_of_file(path, wishes.actuated, control=wishes.control, goal=wishes.goal)
    needs = robot.tree.needs._replace(actuation=tuple(map(tuple, robot_layout.actuation.tolist())))
    viscous = bool(robot.damping.any())
    needs = needs._replace(joint_friction=("viscous",)) if viscous else needs
    description = describe("rigid-tree", precision="f64", needs=needs, tree=tree_to_json(robot.tree))
    parameters = build(description).init(jax.random.key(0))
    parameters = parameters._replace(viscous=robot.damping) if viscous else parameters
    lines = []
    if robot.coulomb.any():
        dry = ", ".join(f"{name} {value:.3g}" for name, value in zip(robot.tree.names, robot.coulomb, strict=True))
        lines.append(f"dry friction is not in the model, which has to be smooth: {dry} N m or N")
    return _own(str(path), description, parameters, robot_layout, wishes, lines)


def of_run(folder: Path, wishes: Wishes) -> Chosen:
    """The plant of a learned or identified model in a run folder.

    Raises:
        InputError: as for `load` and `own_problem`; or the model has no dynamics, or lacks limits, motors or a goal.
    """
    run = load(folder)
    if not isinstance(run.model, Model) or isinstance(run.energies, PhaseRates) or "needs" not in run.description:
        raise InputError(f"{folder} holds a {run.description['name']}; expected a model of joints with dynamics")
    needs = needs_from_json(run.description["needs"])
    d = len(needs.joints)
    B = None if needs.actuation is None else np.asarray(needs.actuation)
    usual = np.flatnonzero(np.ones(d) if B is None else B.any(axis=1)).tolist()
    driven = _numbers(wishes.actuated, d) if wishes.actuated else usual
    if wishes.control is None:
        raise InputError(f"{folder} states no limits of the motors; give the largest force (--control), N m or N")
    model = equations.dynamics(run.energies, degrees_of_freedom=d)
    ranges = np.tile([-np.inf, np.inf], (d, 1))
    goal = hanging = wishes.goal
    if isinstance(model, Dynamics):
        energy = jax.jit(lambda q: model.energy(q, jnp.zeros(d)))
        hanging, highest = extremes(lambda q: float(energy(q)), needs.joints, driven, ranges)
        goal = highest if goal is None else goal
    if goal is None:
        raise InputError(f"a {run.description['name']} has no energy, whose highest posture is the goal; give --goal")
    robot_layout = layout(
        needs.joints, driven, goal=goal, hanging=hanging, rate=500.0, control=wishes.control, passive=False
    )  # fmt: skip
    return _own(str(folder), run.description, run.parameters, robot_layout, wishes, [])


def _own(
    name: str,
    description: Description,
    parameters: Parameters,
    robot_layout: Layout,
    wishes: Wishes,
    lines: Sequence[str],
) -> Chosen:
    if wishes.positions is not None:
        ranges, limits = np.asarray(wishes.positions, float), robot_layout.limits
        if ranges.shape != limits.position.shape:
            raise InputError(f"--positions has {len(ranges)} ranges; the plant has {len(limits.position)} joints")
        outside = [
            (q < ranges[:, 0]).any() or (q > ranges[:, 1]).any() for q in (robot_layout.goal, robot_layout.hanging)
        ]
        if any(outside):
            raise InputError(f"--positions are {ranges.tolist()}; the goal or the posture of rest is outside")
        robot_layout = robot_layout._replace(limits=limits._replace(position=ranges))
    parameters = jax.tree.map(np.asarray, parameters)
    with jax.enable_x64(True):
        model = dynamics_of(description)(parameters)
        numbers = own_problem(model, robot_layout, effort=wishes.effort, weights=wishes.weights, box=wishes.box)
        return rebuilt(name, OwnModel(description, parameters, numbers), lines)


def rebuilt(name: str, own: OwnModel, lines: Sequence[str] = ()) -> Chosen:
    """Rebuilds a user's own plant from what its folder stores."""
    description, parameters, numbers = own
    make, B = dynamics_of(description), np.asarray(numbers.actuation)
    plant, (d, m) = own_plant(make(parameters), numbers), B.shape
    masses = d if "tree" in description else 0

    def altered(p: Array) -> Field:
        """Multiplies the inertias of a tree's bodies and the strengths of the motors."""
        changed = parameters
        if masses:
            changed = parameters._replace(inertias=parameters.inertias * p[:masses, None])
        field = field_of(make(changed), B)
        return lambda x, u: field(x, p[masses:] * u)

    uncertain = (*("mass of bodies",) * masses, *("strength of motors",) * m)
    return Chosen(name, plant, own_settings(numbers), altered, uncertain, own, (*described(numbers), *lines))


def dynamics_of(description: Description) -> Callable[[Parameters], Dynamics | PlainDynamics]:
    """Parameters of a described model -> its dynamics, not jitted."""
    model = build(description)
    d = len(description["needs"]["joints"])
    return lambda parameters: equations.dynamics(model.energies(parameters), degrees_of_freedom=d)


def with_factors(chosen: Chosen, factors: Sequence[float]) -> ControlProblem:
    """The problem of a plant whose uncertain numbers are multiplied by factors."""
    problem = chosen.plant.problem
    motors = sum(name.startswith("strength") for name in chosen.uncertain)
    a, B = from_field(chosen.altered(jnp.asarray(factors, float)), motors)
    return problem._replace(drift=a, actuation=B)


def _numbers(actuated: Sequence[str], d: int) -> list[int]:
    if not all(joint.isdecimal() and int(joint) < d for joint in actuated):
        raise InputError(f"--actuated is {','.join(actuated)}; the model's joints are the numbers 0 to {d - 1}")
    return sorted({int(joint) for joint in actuated})
