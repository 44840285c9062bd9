"""Builds a task of dynamics from options: the data, their `Needs`, the model and its optimiser."""

from typing import Any, NamedTuple

from dln_jax.cli.arguments import refuse_given, resolved
from dln_jax.cli.optimisers import name_of, optimiser_named
from dln_jax.data.splits import Split, drawn
from dln_jax.learning import dynamics
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Problem, require_finite_start
from dln_jax.learning.kinematics import TreeFit
from dln_jax.learning.objectives import SCALED_TORQUE, TORQUE, Objective, objective_of
from dln_jax.learning.suited import MANY_JOINTS, suited_network
from dln_jax.models.rigid_tree import USUAL
from dln_jax.scenes.scene import Scene
from dln_jax.sizes import require_network
from dln_jax.time_limit import deadline, seconds_left
from dln_jax.training.dynamics.options import OF_ADAM, SAMPLES_OF_KERNEL, Options, check_options
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.types import InputError, Needs
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, describe_for


class Solver(NamedTuple):
    """Optimiser and problem of a training."""

    optimiser: Optimiser
    reason: str
    """Reason for this optimiser; empty if the user chose it."""
    problem: Problem
    samples: int | None
    """Number of training samples drawn for it; `None` for all."""


class Task(NamedTuple):
    """A resolved task: the data, their `Needs`, and the model to train."""

    recorded: Recorded
    kind: str
    description: dict[str, Any]
    """Description of the model, for `dln_jax.zoo.build`."""
    objective: Objective
    solver: Solver | None
    """`None` for models with a direct fit."""
    seeds: int | tuple[int, ...]
    """One seed, or several that train in one program."""
    until: float
    """Reading of `time.perf_counter` at which training stops, for the command or one candidate in model selection."""
    search: TreeFit | None = None
    """Result of the search for the joint frames of a learned tree."""
    best: int | None = None
    """Index of the seed selected by cross-validation; `None` without cross-validation."""

    @property
    def seconds(self) -> float:
        """Seconds left for fits."""
        return seconds_left(self.until)

    @property
    def name(self) -> str:
        """Name of the data."""
        return self.recorded.name

    @property
    def sets(self) -> Split:
        """Training, validation and test data."""
        return self.recorded.sets

    @property
    def scene(self) -> Scene | None:
        """Scene of the data, if known."""
        return self.recorded.scene

    @property
    def needs(self) -> Needs:
        """`Needs` of the plant."""
        return self.recorded.needs

    @property
    def precision(self) -> str:
        """f32 or f64, for the model and its training."""
        return self.description["precision"]


def task_of(given: Options, recorded: Recorded, *, checked: bool = False, until: float | None = None) -> Task:
    """The task for the model that the arguments name and these data; nothing is written yet.

    Args:
        given: the arguments.
        recorded: the data.
        checked: whether the options have already been checked against the model.
        until: deadline of the fit by `time.perf_counter` (default: that of the command).

    Raises:
        InputError: options that the model does not use, or data that it cannot be fitted to.
    """
    sets, kind = recorded.sets, str(given.model)
    if not checked:
        check_options(given, kind)
    objective = objective_of(kind, sets.train, given.objective)
    if objective is TORQUE and given.target is None:
        objective = SCALED_TORQUE
    description, optimiser, samples, reason = model_and_optimiser(given, kind, recorded, objective)
    seeds = given.seed if given.seeds == 1 else tuple(range(given.seed, given.seed + given.seeds))
    until = deadline(given.seconds) if until is None else until
    model, solver = build(description), None
    if optimiser is not None:
        require_finite_start(
            dynamics.problem(model, sets, objective, seeds=seeds), dynamics.samples(model, sets, objective)
        )
        solver = Solver(optimiser, reason, posed(description, sets, objective, samples, seeds), samples)
    return Task(recorded, kind, description, objective, solver, seeds, until)


def posed(
    description: dict[str, Any], sets: Split, objective: Objective, samples: int | None, seeds: int | tuple[int, ...]
) -> Problem:
    """The fitting problem of a model; `samples` training samples are drawn, scaled by the spread of all of them."""
    scale, some = objective.scale(sets.train), sets
    if samples is not None:
        some = sets._replace(train=drawn(sets.train, samples, seeds if isinstance(seeds, int) else seeds[0]))
    return dynamics.problem(build(description), some, objective._replace(scale=lambda data: scale), seeds=seeds)


def needs_of_tree(needs: Needs) -> Needs:
    """Converts the needs to those of a learned tree, whose friction is viscous, dry and an offset per joint.

    Raises:
        InputError: friction laws that a learned tree does not have.
    """
    if others := [law for law in needs.joint_friction if law not in USUAL]:
        raise InputError(f"a learned tree has no {others[0]} friction; leave it out of joint_friction")
    return needs._replace(friction=needs.friction or bool(needs.joint_friction), joint_friction=())


def model_and_optimiser(
    given: Options, kind: str, recorded: Recorded, objective: Objective
) -> tuple[dict[str, Any], Optimiser | None, int | None, str]:
    """Description of the model, its optimiser, its number of samples (`None`: all), and why that optimiser."""
    needs, sets = recorded.needs, recorded.sets
    properties, optimizer = CATALOGUE[kind].properties, given.optimizer
    if properties.searched:
        needs = needs_of_tree(needs)
        stated = {"parents": recorded.parents, "velocity_scale": needs.velocity_scale}
        return describe_for(kind, sets.train, needs, precision=given.precision or "f64", **stated), None, None, ""
    if properties.kernel:
        sizes = resolved(given, {"samples": SAMPLES_OF_KERNEL})
        return describe_for(kind, sets.train, needs, precision=given.precision or "f64", **sizes), None, None, ""
    if properties.linear:
        degree = 1 if given.degree is None else given.degree
        description = describe_for(kind, sets.train, needs, precision=given.precision or "f64", degree=degree)
        return description, None, None, ""
    suited = None
    sized = given.width is None and given.depth is None and given.target is None
    if kind == "structured-delan" and optimizer == "auto" and sized and needs.degrees_of_freedom >= MANY_JOINTS:
        suited = suited_network(needs, sets.train)
        optimizer = suited.optimizer
    adam = optimizer == "adam"
    precision = given.precision or ("f32" if adam else "f64")
    # A structured model needs fewer units; first-order training needs more.
    width = 64 if adam else 8 if properties.definite else 16
    keywords = resolved(given, {"width": width, "depth": 2, "activation": "tanh"})
    keywords |= {} if suited is None else suited.keywords
    require_network(width=keywords["width"], depth=keywords["depth"])
    description = describe_for(kind, sets.train, needs, precision=precision, **keywords)
    reason = "" if suited is None else suited.reason
    if optimizer == "auto":
        kind_suited, reason = dynamics.suited_optimiser(build(description), sets, objective)
        optimizer = name_of(kind_suited)
        description["precision"] = precision = given.precision or ("f32" if optimizer == "adam" else "f64")
    if optimizer == "gauss-newton":
        chosen = "auto chose gauss-newton" if reason else "the optimizer is gauss-newton"
        refuse_given(given, OF_ADAM, f"for adam, but {chosen}: add --optimizer adam")
    elif given.samples is not None:
        chosen = "auto chose adam: add --optimizer gauss-newton" if reason else "the optimizer is adam"
        raise InputError(f"--samples is for gauss-newton, but {chosen}; or leave it out")
    settings = {name: getattr(given, name) for name in (*OF_ADAM, "steps", "target")}
    if suited is not None and given.steps is None:
        settings["steps"] = suited.steps
    samples = given.samples if suited is None or given.samples is not None else suited.samples
    return description, optimiser_named(optimizer, precision=precision, **settings), samples, reason
