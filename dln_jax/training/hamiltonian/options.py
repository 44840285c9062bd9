"""Options of Hamiltonian trainings in a phase space, and the task, model and optimiser that follow from them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from dln_jax.cli.arguments import (
    Unstated,
    choice,
    numbers_of,
    refuse_given,
    require_positive_if_given,
)
from dln_jax.cli.encoders import Checked, checked
from dln_jax.cli.optimisers import optimiser_named
from dln_jax.cli.options import Drawn, Limited, Resumable, Scaled, SingleCalls
from dln_jax.cli.running import needs_from_option
from dln_jax.scenes.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.time_limit import seconds_left
from dln_jax.training.hamiltonian.model_selection import HELMHOLTZ, PAIRWISE, POLYNOMIAL, choose_model, description_of
from dln_jax.training.hamiltonian.stages import LINEAR
from dln_jax.training.hamiltonian.tasks import MEASURED, TASKS, Problem, Stated, problem_of
from dln_jax.training.hamiltonian.training import MOTIONS, check, stages_of
from dln_jax.types import InputError, require_seed
from dln_jax.zoo.descriptions import build

FILTERED_HERE = ("raw-differences",)
"""Checks that do not apply here: estimated rates come from local polynomials, and motions are fitted to the states."""
CHOICE_SHARE = 0.2
"""Fraction of the time limit after which model selection starts no further candidate."""


@dataclass(frozen=True)
class Options(Checked, Limited, Resumable, Drawn, SingleCalls, Scaled):
    """What to train on, how, and where the results go. What is not given is the task's own choice."""

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
        "helmholtz-hnn",
        "structured-delan",
        "trigonometric",
        "planar-chain",
    ] = "auto"
    """What is learned; auto: what suits the task, which for measured is the smallest model whose validation error no
    other's betters. The last three are for measured."""
    data: Unstated[Path] = None
    """Trajectories as npz or CSV, for measured and real-pendulum."""
    trajectories: Unstated[int] = None
    """Generated trajectories, for the other tasks."""
    needs: Unstated[str] = None
    """measured: what the plant needs, as JSON, for example '{"joints": ["revolute", "prismatic"], "friction": true}'
    (default: what the file states, else revolute joints with a potential and friction)."""
    test: Unstated[str] = None
    """measured: labels of test trajectories, or an npz file of them (default: every sixth, or the last fifth)."""
    noise: Unstated[str] = None
    """measured: standard deviation of q, rad or m, one number or one for each coordinate; where the file has p, also
    one for each coordinate and then one for each momentum (default: estimated)."""
    field: Unstated[Literal["solenoidal", "conservative", "both"]] = None
    """helmholtz-hnn: the part that conserves an energy, the part that is a gradient, or both (default: both)."""
    order: Unstated[Literal["bodies", "axes"]] = None
    """measured, pairwise-hnn: coordinates body by body (x1, y1, x2, y2) or axis by axis (x1, x2, y1, y2) (default: that
    in which the forces on the bodies balance)."""
    coordinates: Unstated[Literal["relative", "absolute"]] = None
    """planar-chain: whether angles are those of joints, or from the vertical (default: relative)."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """auto: gauss-newton."""
    width: Unstated[int] = None
    """Hidden units per layer."""
    depth: Unstated[int] = None
    """Hidden layers."""
    activation: Unstated[Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]] = None
    """Of the hidden layers (default: tanh)."""
    degree: Unstated[int] = None
    """polynomial: degree (default: what validation asks for); trigonometric: of the basis (default: 1)."""
    steps: Unstated[int] = None
    """Iterations of gauss-newton or steps of adam, of each stage."""
    learning_rate: Unstated[float] = None
    """adam: peak of the warm-up and cosine schedule (default: 0.005)."""
    seed: int = 0
    """Of the initial parameters, the shuffling and the validation split; 0 to 4294967295."""


def prepare(given: Options, until: float) -> tuple[Problem, dict[str, Any], dict[str, Any], list[str]]:
    """Resolves the options into the problem, the model's description, the keywords of `train`, and findings on the log.

    Everything is checked before anything is written, and the log before models are compared on it.

    Args:
        given: the arguments.
        until: deadline by `time.perf_counter`.
    """
    require_seed(given.seed)
    require_positive_if_given(given, ["width", "depth", "degree", "steps", "trajectories", "seconds"])
    if given.optimizer != "adam":
        refuse_given(given, ["learning_rate"], "for adam, but a task is fitted by gauss-newton: add --optimizer adam")
    if given.model not in (POLYNOMIAL, "trigonometric"):
        refuse_given(given, ["degree"], "for polynomial-hamiltonian and trigonometric")
    if given.model != "planar-chain":
        refuse_given(given, ["coordinates"], "for planar-chain")
    needs = None if given.needs is None else needs_from_option(given.needs)
    if given.task != MEASURED:
        refuse_given(given, ["test", "noise", "order"], "for measured")
    if given.model != HELMHOLTZ:
        refuse_given(given, ["field"], "for helmholtz-hnn")
    if given.model not in ("auto", PAIRWISE):
        refuse_given(given, ["order"], "for pairwise-hnn")
    noise = None if given.noise is None else numbers_of("--noise", given.noise, positive=True)
    stated = Stated(needs, given.test, noise)
    stated = stated._replace(rate=given.rate, units=given.units)
    problem = problem_of(given.task, trajectories=given.trajectories, data=given.data, stated=stated)
    said = [] if given.data is None else checked(given, problem.fitted, given.data, without=FILTERED_HERE)
    names = ("width", "depth", "activation", "degree", "coordinates", "order", "field")
    size: dict[str, Any] = {name: getattr(given, name) for name in names}
    if given.model == "auto" and given.task == MEASURED:
        networks = given.optimizer == "adam" or any(size[name] is not None for name in names[:3])
        chosen = {"networks": networks, "report": print, "seconds": CHOICE_SHARE * seconds_left(until)}
        description = choose_model(problem, **chosen, precision="f64", **size)
    else:
        description = description_of(problem, given.model, **size)
    check_suited(given, problem, description)
    name = "gauss-newton" if given.optimizer == "auto" else given.optimizer
    optimiser = optimiser_named(name, precision=description["precision"], learning_rate=given.learning_rate)
    check(problem, description, seed=given.seed)
    return problem, description, {"seed": given.seed, "optimiser": optimiser, "steps": given.steps}, said


def check_suited(given: Options, problem: Problem, description: dict[str, Any]) -> None:
    """Refuses options that do not apply to the task or its model."""
    build(description)
    if problem.name != MEASURED:
        refuse_given(given, ["needs"], f"what the task '{problem.name}' decides itself")
    if problem.name not in PROTOCOLS:
        refuse_given(given, ["trajectories"], f"for generated data, but '{problem.name}' reads its --data")
    if description["name"] in LINEAR:
        refuse_given(
            given, ["width", "depth", "activation"], f"for networks, which a {description['name']} model is not"
        )
    if description["name"] == POLYNOMIAL:
        linear = "for networks; the polynomial model's fit of rates is one least-squares problem"
        refuse_given(given, ["width", "depth", "activation"], linear)
        if MOTIONS not in stages_of(problem, description):
            refuse_given(given, ["steps", "seconds", "processes"], linear)
        if given.optimizer == "adam":
            raise InputError("the polynomial model is one least-squares problem; leave --optimizer out")
