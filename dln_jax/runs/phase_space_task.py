"""From options to a task of a phase space: its problem, the model, and how it is trained."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from dln_jax.command_line.arguments import Unstated, choice, refuse_given, resolved
from dln_jax.command_line.optimisers import optimiser_named
from dln_jax.command_line.options import Limited
from dln_jax.command_line.running import needs_from_option
from dln_jax.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.studies.hamiltonian.tasks import MEASURED, TASKS, Problem, problem_of
from dln_jax.studies.hamiltonian.training import (
    MOTIONS,
    POLYNOMIAL,
    check,
    description_of,
    stages_of,
)
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.descriptions import build


@dataclass(frozen=True)
class Options(Limited):
    """What to train on, and how. What is not given is the task's own choice."""

    task: Annotated[str, choice(TASKS)] = "spring"
    """What moves."""
    model: Literal[
        "auto",
        "separable-hnn",
        "structured-hnn",
        "black-box-hnn",
        "pairwise-hnn",
        "polynomial-hamiltonian",
        "phase-network",
    ] = "auto"
    """What is learned; auto: what suits the task."""
    data: Unstated[Path] = None
    """Trajectories in the npz schema, for measured and real-pendulum."""
    trajectories: Unstated[int] = None
    """Generated trajectories, for the other tasks."""
    needs: Unstated[str] = None
    """measured: what the plant needs, as JSON, for example '{"joints": ["revolute", "prismatic"], "friction": true}'
    (default: what the file states, else revolute joints with a potential and friction)."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """auto: gauss-newton."""
    width: Unstated[int] = None
    """Hidden units per layer."""
    depth: Unstated[int] = None
    """Hidden layers."""
    activation: Unstated[Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]] = None
    """Of the hidden layers (default: tanh)."""
    degree: Unstated[int] = None
    """polynomial: degree (default: what validation asks for)."""
    steps: Unstated[int] = None
    """Iterations of gauss-newton or steps of adam, of each stage."""
    learning_rate: Unstated[float] = None
    """adam: peak of the warm-up and cosine schedule (default: 0.005)."""
    seed: int = 0
    """Of the initial parameters, the shuffling and the validation split; 0 to 4294967295."""


class PhaseTask(NamedTuple):
    """What the options come to."""

    problem: Problem
    description: dict[str, Any]
    """Of the model, for `dln_jax.zoo.build`."""
    training: dict[str, Any]
    """Keywords of `studies.hamiltonian.training.train`."""


def prepare(given: Options) -> PhaseTask:
    """Reads and checks everything that the options name, before anything is written."""
    check_options(given)
    needs = None if given.needs is None else needs_from_option(given.needs)
    problem = problem_of(given.task, trajectories=given.trajectories, data=given.data, needs=needs)
    size: dict[str, Any] = {name: getattr(given, name) for name in ("width", "depth", "activation", "degree")}
    description = description_of(problem, given.model, **size)
    check_suited(given, problem, description)
    name = "gauss-newton" if given.optimizer == "auto" else given.optimizer
    optimiser = optimiser_named(name, precision=description["precision"], learning_rate=given.learning_rate)
    training: dict[str, Any] = {"seed": given.seed, "optimiser": optimiser, "steps": given.steps}
    training |= resolved(given, {"seconds": math.inf})
    check(problem, description, seed=given.seed)
    return PhaseTask(problem, description, training)


def check_options(given: Options) -> None:
    """Refuses what no task takes."""
    require_seed(given.seed)
    for name in ("width", "depth", "degree", "steps", "trajectories", "seconds"):
        if getattr(given, name) is not None:
            require_positive(**{name: getattr(given, name)})
    if given.optimizer != "adam":
        refuse_given(given, ["learning_rate"], "for adam, but a task is fitted by gauss-newton: add --optimizer adam")
    if given.model != POLYNOMIAL:
        refuse_given(given, ["degree"], "for polynomial-hamiltonian")


def check_suited(given: Options, problem: Problem, description: dict[str, Any]) -> None:
    """Refuses what this task or its model does not take."""
    build(description)
    if problem.name != MEASURED:
        refuse_given(given, ["needs"], f"what the task '{problem.name}' decides itself")
    if problem.name not in PROTOCOLS:
        refuse_given(given, ["trajectories"], f"for generated data, but '{problem.name}' reads its --data")
    if description["name"] == POLYNOMIAL:
        linear = "for networks; the polynomial model's fit of rates is one least-squares problem"
        refuse_given(given, ["width", "depth", "activation"], linear)
        if MOTIONS not in stages_of(problem, description):
            refuse_given(given, ["steps", "seconds"], linear)
        if given.optimizer == "adam":
            raise InputError("the polynomial model is one least-squares problem; leave --optimizer out")
