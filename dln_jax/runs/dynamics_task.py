"""From options to a task of dynamics: the data, what they need, the model, and how it is trained."""

import math
from typing import Any, NamedTuple

from dln_jax.command_line.arguments import refuse_given, resolved
from dln_jax.command_line.optimisers import name_of, optimiser_named
from dln_jax.data.splits import Split
from dln_jax.learning import dynamics
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Problem, require_finite_start
from dln_jax.learning.objectives import SCALED_TORQUE, TORQUE, Objective, objective_of
from dln_jax.models.rigid_tree import USUAL
from dln_jax.runs.dynamics_data import Recorded
from dln_jax.runs.dynamics_options import OF_ADAM, Options, check_options
from dln_jax.scenes.scene import Scene
from dln_jax.types import InputError, Needs, require_positive
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, describe_for


class Solver(NamedTuple):
    """How a model is trained."""

    optimiser: Optimiser
    reason: str
    """Why it is that one; empty where the user chose."""
    problem: Problem


class Task(NamedTuple):
    """What the arguments come to: the data, what they need, and the model to train."""

    recorded: Recorded
    kind: str
    description: dict[str, Any]
    """Of the model, for `dln_jax.zoo.build`."""
    objective: Objective
    solver: Solver | None
    """`None` for models that have a fit of their own."""
    seeds: int | tuple[int, ...]
    """One, or several in one program."""
    seconds: float
    """Of training, after which to stop."""

    @property
    def name(self) -> str:
        """Of the data."""
        return self.recorded.name

    @property
    def sets(self) -> Split:
        """The data."""
        return self.recorded.sets

    @property
    def scene(self) -> Scene | None:
        """Of the data, where it is known."""
        return self.recorded.scene

    @property
    def needs(self) -> Needs:
        """Of the plant."""
        return self.recorded.needs

    @property
    def precision(self) -> str:
        """f32 or f64, of the model and its training."""
        return self.description["precision"]


def task_of(given: Options, recorded: Recorded, *, checked: bool = False) -> Task:
    """The model that the arguments name, for these data; nothing is written yet.

    Args:
        given: the arguments.
        recorded: the data.
        checked: whether it is known that the model reads the options that are given.

    Raises:
        InputError: options that it does not read, or data that it cannot be fitted to.
    """
    sets, kind = recorded.sets, given.model
    if not checked:
        check_options(given, kind)
    objective = objective_of(kind, sets.train)
    if objective is TORQUE and given.target is None:
        objective = SCALED_TORQUE
    description, optimiser, reason = model_and_optimiser(given, kind, recorded, objective)
    seeds = given.seed if given.seeds == 1 else tuple(range(given.seed, given.seed + given.seeds))
    limit = resolved(given, {"seconds": math.inf})
    require_positive(**limit)
    model, solver = build(description), None
    if optimiser is not None:
        problem = dynamics.problem(model, sets, objective, seeds=seeds)
        require_finite_start(problem, dynamics.samples(model, sets, objective))
        solver = Solver(optimiser, reason, problem)
    return Task(recorded, kind, description, objective, solver, seeds, **limit)


def needs_of_tree(needs: Needs) -> Needs:
    """The needs as a learned tree states them, whose friction is viscous, dry and an offset of each joint.

    Raises:
        InputError: laws of friction that it does not have.
    """
    if others := [law for law in needs.joint_friction if law not in USUAL]:
        raise InputError(f"a learned tree has no {others[0]} friction; leave it out of joint_friction")
    return needs._replace(friction=needs.friction or bool(needs.joint_friction), joint_friction=())


def model_and_optimiser(
    given: Options, kind: str, recorded: Recorded, objective: Objective
) -> tuple[dict[str, Any], Optimiser | None, str]:
    """Description of the model, its optimiser, and why that one."""
    needs, sets = recorded.needs, recorded.sets
    properties, adam = CATALOGUE[kind].properties, given.optimizer == "adam"
    precision = given.precision or ("f32" if adam else "f64")
    if properties.searched:
        needs = needs_of_tree(needs)
        stated = {"parents": recorded.parents, "velocity_scale": needs.velocity_scale}
        return describe_for(kind, sets.train, needs, precision=precision, **stated), None, ""
    if properties.linear:
        degree = 1 if given.degree is None else given.degree
        return describe_for(kind, sets.train, needs, precision=precision, degree=degree), None, ""
    # Structure needs fewer units, and first-order training more.
    width = 64 if adam else 8 if properties.definite else 16
    keywords = resolved(given, {"width": width, "depth": 2, "activation": "tanh"})
    require_positive(width=keywords["width"], depth=keywords["depth"])
    description = describe_for(kind, sets.train, needs, precision=precision, **keywords)
    optimizer, reason = given.optimizer, ""
    if optimizer == "auto":
        suited, reason = dynamics.suited_optimiser(build(description), sets, objective)
        optimizer = name_of(suited)
        precision = given.precision or ("f32" if optimizer == "adam" else "f64")
        description["precision"] = precision
    if optimizer == "gauss-newton":
        chosen = "auto chose gauss-newton" if reason else "the optimizer is gauss-newton"
        refuse_given(given, OF_ADAM, f"for adam, but {chosen}: add --optimizer adam")
    settings = {name: getattr(given, name) for name in (*OF_ADAM, "steps", "target")}
    return description, optimiser_named(optimizer, precision=precision, **settings), reason
