"""Train a Hamiltonian model on motions without forces.

The model gives the rates (q, p) -> (qd, pd), and the table reports how well it predicts motions. Tasks are published or
textbook systems; for measured, --data is any file with q, qd or only q, and windows never cross a gap. Models:
separable-hnn is T(p) + V(q), polynomial-hamiltonian one least-squares problem, pairwise-hnn for bodies; networks give
the rates in phase-network, gradients of two in helmholtz-hnn, with friction. Others learn friction if the needs state
it. Load the model with dln_jax.load.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from dln_jax.errors import InputError
from dln_jax.learning.fits.settings import ActivationName
from dln_jax.options import Checked, Drawn, Limited, Resumable, Scaled, Unstated, choice
from dln_jax.runs.arguments import Variants

if TYPE_CHECKING:
    from dln_jax.commands.phase_spaces.data import PhaseLog

RECORDED = ("real-pendulum", "measured")
"""Tasks of a file."""
GENERATED = (
    *("spring", "pendulum", "damped-spring", "damped-pendulum", "henon-heiles", "double-pendulum", "two-body"),
    "three-body",
)
"""Tasks whose data are generated: the names of `scenes.datasets.hamiltonian_tasks.PROTOCOLS`."""
DIRECT = ("polynomial-hamiltonian", "trigonometric", "planar-chain")
"""Models without a network."""
READ_FOR = {
    "needs": ("task", "measured"),
    "test": ("task", "measured"),
    "noise": ("task", "measured"),
    "order": ("model", "pairwise-hnn", "auto"),
    "field": ("model", "helmholtz-hnn"),
    "coordinates": ("model", "planar-chain"),
    "degree": ("model", "polynomial-hamiltonian", "trigonometric"),
    "learning_rate": ("optimizer", "adam"),
}
"""Options that only some values of another option read."""


@dataclass(frozen=True)
class Motion(Drawn, Scaled, Limited, Resumable):
    """The system that moves, the model to learn, and where the results go."""

    task: Annotated[str, choice((*GENERATED, *RECORDED))] = "spring"
    """System that moves; measured: your --data."""
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
    """Model to learn. auto takes the one that suits the task; for measured, the smallest that no other improves
    significantly. The last three are for measured."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """Optimiser; auto is gauss-newton."""
    steps: Unstated[int] = None
    """Iterations of each stage (default: the task's)."""
    seed: int = 0
    """Seed for parameters, shuffling and validation."""


@dataclass(frozen=True)
class Generated:
    """Generated motions."""

    trajectories: Unstated[int] = None
    """Generated trajectories (default: the task's)."""


@dataclass(frozen=True)
class Recorded(Checked):
    """Recorded motions; real-pendulum takes only the file and how to read it."""

    data: Unstated[Path] = None
    """Trajectories as npz, CSV or ROS bag."""
    needs: Unstated[str] = None
    """Joints and terms of the plant, such as 'rr friction', or as JSON (default: those of the file, else revolute
    joints, a potential and friction)."""
    test: Unstated[str] = None
    """Test trajectories: labels, an npz file, last:30% for the end of every trajectory, or blocks, for ten blocks of
    time in each (default: every sixth, or the last fifth)."""
    noise: Unstated[str] = None
    """Standard deviations of q, or of q and p if the file has p: one number or one each (default: estimated)."""
    order: Unstated[Literal["bodies", "axes"]] = None
    """pairwise-hnn: order x1, y1, x2, y2 or x1, x2, y1, y2 (default: the one that balances the forces)."""


@dataclass(frozen=True)
class Networks:
    """Networks and their training."""

    width: Unstated[int] = None
    """Hidden units per layer (default: the task's)."""
    depth: Unstated[int] = None
    """Hidden layers (default: the task's)."""
    activation: Unstated[ActivationName] = None
    """Activation of the hidden layers (default: tanh)."""
    field: Unstated[Literal["solenoidal", "conservative", "both"]] = None
    """helmholtz-hnn: the solenoidal part conserves an energy, the conservative one is a gradient (default: both)."""
    learning_rate: Unstated[float] = None
    """adam: peak of the warm-up and cosine schedule (default: 0.005)."""


@dataclass(frozen=True)
class Direct:
    """Models without a network."""

    degree: Unstated[int] = None
    """Degree (default: polynomial by validation, trigonometric 1)."""
    coordinates: Unstated[Literal["relative", "absolute"]] = None
    """planar-chain: joint angles, or angles from the vertical (default: relative)."""


def class_of(stated: Mapping[str, Any]) -> type:
    """Options of the task and the model that a command line selects."""
    model = Direct if stated.get("model") in DIRECT else Networks
    return options_of(model, Recorded if stated.get("task") in RECORDED else Generated)


@functools.cache
def options_of(model: type, motions: type) -> type:
    """Options of models of one kind, fitted to motions of one kind."""
    return make_dataclass("Options", [], bases=(model, motions, Motion), frozen=True)


@dataclass(frozen=True)
class Arguments(Motion):
    """What to train on, how, and where the results go; `VARIANTS` says which options a task and a model have."""

    VARIANTS: ClassVar = Variants(
        class_of,
        {
            Networks: "networks",
            Generated: "tasks that generate their data",
            Recorded: "--task measured",
            Direct: f"--model {' or '.join(DIRECT)}",
        },
    )


def main(options: Any) -> None:
    """Trains and evaluates the model, and writes the run folder.

    Raises:
        InputError: a mistake in the options or data; nothing is then left behind.
        FitRefused: the model must not be used, and no limit of the user ended its training; the run folder is complete.
    """
    from dln_jax.commands.phase_spaces.data import generate, read_motions
    from dln_jax.commands.phase_spaces.models import choose_model, description_of
    from dln_jax.commands.phase_spaces.results import evaluate
    from dln_jax.commands.phase_spaces.training import POLYNOMIAL, train
    from dln_jax.learning.engine.checkpoint import Context
    from dln_jax.learning.engine.optimisers import optimiser_named
    from dln_jax.process import deadline
    from dln_jax.runs.arguments import facts, needs_of, numbers_of, refuse_given, require_positive_if_given
    from dln_jax.runs.devices import mesh_of
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.progress import progress
    from dln_jax.runs.report import finish
    from dln_jax.zoo.run import save

    until, mesh = deadline(options.seconds), mesh_of(options)
    require_positive_if_given(options, ["width", "depth", "degree", "steps", "trajectories", "seconds"])
    for name, (choice_of, *values) in READ_FOR.items():
        if hasattr(options, name) and getattr(options, choice_of) not in values:
            refuse_given(options, [name], f"an option of --{choice_of} {values[0]}")
    optimizer, names = options.optimizer, ("width", "depth", "activation", "field", "degree", "coordinates", "order")
    keywords = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    networks = optimizer == "adam" or not keywords.keys() <= {"order"}
    name, rate = "gauss-newton" if optimizer == "auto" else optimizer, getattr(options, "learning_rate", None)
    optimiser = optimiser_named(name, precision="f64", learning_rate=rate)
    if options.task in RECORDED:
        noise = None if options.noise is None else numbers_of("--noise", options.noise, positive=True)
        known = {"needs": needs_of(options.needs), "test": options.test, "noise": noise}
        log = read_motions(options.task, options.data, **known, **facts(options))
    else:
        log = generate(options.task, options.trajectories)
    if options.model == POLYNOMIAL:
        if optimizer == "adam":
            raise InputError("the polynomial model is one least-squares problem; leave --optimizer out")
        if not log.task.trajectory_steps:
            words = "for networks: the polynomial model is one least-squares problem"
            refuse_given(options, ["steps", "seconds", "processes"], words)
    with command_folder(options, "train_hnn_task") as folder:
        context = Context(options.seed, until, print, progress, folder, options.resume, mesh)
        if options.model == "auto" and not log.task.suits:
            description = choose_model(log, context, networks=networks, **keywords)
        else:
            description = description_of(log, options.model, **keywords)
        for line in lines_on(log, description):
            print(line)
        fit = train(log, description, context, optimiser=optimiser, steps=options.steps)
        save(folder, description, fit.parameters)
        report = evaluate(log, fit)
        finish(folder, options, report._replace(ended_by_user=options.steps is not None or fit.stop == "time"))


def lines_on(log: "PhaseLog", description: dict[str, Any]) -> Iterator[str]:
    """Lines on the data used for training and the assumptions made."""
    import numpy as np

    from dln_jax.commands.phase_spaces.training import gauge_of, in_velocities
    from dln_jax.scale import device_lines

    data, needs = log.fitted, description["needs"]
    terms = " and ".join(name for name in ("gravity", "friction") if needs[name]) or "no potential"
    trajectories = len(np.unique(data.trajectory))
    yield f"{log.name}: {len(data.t)} samples of {trajectories} segments for training and validation"
    yield f"{'-'.join(needs['joints'])} with {terms}; {description['name']}, f64"
    missing = [key for key in data.estimated if key not in ("tau", *(("qdd",) if log.noise is None else ("p", "pd")))]
    if missing:
        of = "finite differences" if log.noise is None else "local polynomials, not finite differences,"
        yield f"not in the data: {', '.join(missing)}; {of} start the fit to motions"
    yield from log.remarks
    if in_velocities(log, description):
        q = ", ".join(f"{coordinate:.3g}" for coordinate in gauge_of(log).q)
        yield f"p = dL/dqd; without torques the unit of energy is free: the mean inertia at q = ({q}) is set to 1"
    elif not log.momenta:
        yield "momenta p are not in the data; qd takes their place (momentum per unit of inertia)"
    if log.assumed:
        yield "no needs are stated, so joints, potential and friction above are assumptions; state them with --needs"
    if log.exact is None and "order" in description:
        example = {"bodies": "x1, y1, x2, y2", "axes": "x1, x2, y1, y2"}[description["order"]]
        yield f"assumed order of coordinates: {example}, ... in {description['dimension']} axes; state another --order"
    if log.weights is not None and log.noise is None:
        noise = ", ".join(f"{sd:.2g}" for sd in np.ravel(log.weights.state))
        free = log.free_of_noise
        yield f"(q, p): {'states are free of noise' if free else f'motions are weighted by noise of {noise}'}"
    yield from device_lines("f64")
