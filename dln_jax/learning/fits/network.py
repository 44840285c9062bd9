"""Trains networks with checkpoints: one seed, several seeds in one program, or networks of growing size."""

import itertools
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from dln_jax.data.log import Log, Parts
from dln_jax.data.splits import Split, drawn, merged
from dln_jax.data.splits import select as trajectories
from dln_jax.errors import require_network
from dln_jax.learning import dynamics
from dln_jax.learning.dynamics import MANY_JOINTS, suited_network, summed_with_friction, without_offset
from dln_jax.learning.engine.checkpoint import CHECKPOINT, Context, no_progress
from dln_jax.learning.engine.fit import fit as train
from dln_jax.learning.engine.optimisers import optimiser_named
from dln_jax.learning.engine.problem import Training, losses
from dln_jax.learning.fit import Fit
from dln_jax.learning.fits.settings import OF_ADAM, Network
from dln_jax.learning.objectives import SCALED_TORQUE, TORQUE, objective_of
from dln_jax.learning.select import say_selection
from dln_jax.metrics.latency import latency_of
from dln_jax.process import SOON
from dln_jax.scale import device_lines, of_first_process
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, describe_for

STRUCTURED = "structured-delan"
WITHOUT_STRUCTURE = 400
"""Default number of iterations for a black box, which converges more slowly than a structured network."""
WIDTHS, DEPTHS = (4, 8, 16, 32), (1, 2)
"""Sizes of growing networks."""


def fit(settings: Network, log: Log, parts: Parts, context: Context) -> Fit:
    """Trains a network; cross-validation selects one of several seeds, and a target makes the network grow.

    Raises:
        InputError: settings out of range, data that cannot determine the model, or a loss that is not finite.
    """
    plan = plan_network(settings, log, parts, context)
    quiet = context._replace(progress=no_progress)
    if settings.target is not None:
        return grow(settings.target, plan, parts, quiet)
    several = settings.seeds > 1 and settings.folds > 1
    seconds = context.seconds / (settings.folds + 1 if several else 1)
    training = train_plan(plan, parts.sets, context.within(seconds))
    finite = np.isfinite(np.ravel(training.validation))
    if training.stop.reason != "not finite" and not finite.any():
        raise InputError("all validation errors are infinite or NaN; look for very large numbers in the data")
    best = int(np.argmin(np.where(finite, training.validation, np.inf)))
    if several:
        chosen = cross_validate(plan, parts.sets, quiet, settings.folds)
        best = chosen if finite[chosen] else best
    return of_training(plan, training, best, cross_validated=several)


def of_training(plan: Fit, training: Training, best: int = 0, *, cross_validated: bool = False) -> Fit:
    """Completes a plan with the parameters of a training."""
    trained = replace(plan, training=training, best=best, cross_validated=cross_validated)
    return replace(trained, parameters=trained.of_seed(best))


def plan_network(settings: Network, log: Log, parts: Parts, context: Context) -> Fit:
    """Plans the network and its optimiser, as given or by the size of model and data; returns an untrained fit.

    Reports the choice.
    """
    require_consistent(settings, context.seed)
    name, optimizer, reason = settings.model, settings.optimizer, ""
    sets, needs = parts.sets, log.needs
    if summed_with_friction(needs, sets.train, network=True):
        needs = without_offset(needs)
    torque = SCALED_TORQUE if settings.target is None else TORQUE
    objective = objective_of(name, sets.train, settings.objective, torque=torque)
    properties = CATALOGUE[name].properties
    sized = settings.width is not None or settings.depth is not None or settings.target is not None
    suited = None
    if name == STRUCTURED and optimizer == "auto" and not sized and needs.degrees_of_freedom >= MANY_JOINTS:
        suited = suited_network(needs, sets.train)
        optimizer, reason = suited.optimizer, suited.reason
    adam = optimizer == "adam"
    # A structured model needs fewer units; first-order training needs more.
    size: dict[str, Any] = {"width": 64 if adam else 8 if properties.definite else 16, "depth": 2, "activation": "tanh"}
    size |= {key: value for key in size if (value := getattr(settings, key)) is not None}
    size |= suited.keywords if suited else {}
    require_network(width=size["width"], depth=size["depth"])
    precision = settings.precision or ("f32" if adam else "f64")
    description = describe_for(name, sets.train, needs, precision=precision, **size)
    if optimizer == "auto":
        optimizer, reason = dynamics.suited_optimiser(build(description), sets, objective)
        description["precision"] = precision = settings.precision or ("f32" if optimizer == "adam" else "f64")
    chosen = {key: getattr(settings, key) for key in (*OF_ADAM, "target", "steps")}
    if settings.steps is None and suited:
        chosen["steps"] = suited.steps
    elif settings.steps is None and not properties.definite and optimizer == "gauss-newton":
        chosen["steps"] = WITHOUT_STRUCTURE
    optimiser = optimiser_named(optimizer, precision=precision, **chosen)
    if needs != log.needs:
        context.say("friction has no offset term, since the potential can represent any constant force")
    if properties.canonical and objective.of_torques:
        context.say("no momenta p in the data: the Hamiltonian is fitted to torques")
    context.say(f"{name}, {precision}, {optimizer}{f' ({reason})' if reason else ''}")
    for line in device_lines(precision):
        context.say(line)
    return Fit(
        build(description),
        None,
        description,
        needs=needs,
        objective=objective,
        optimiser=optimiser,
        samples=suited.samples if suited and settings.samples is None else settings.samples,
        seeds=context.seed if settings.seeds == 1 else tuple(range(context.seed, context.seed + settings.seeds)),
    )


def require_consistent(settings: Network, seed: int) -> None:
    """Raises `InputError` for numbers out of range and for settings that contradict each other."""
    require_positive(seeds=settings.seeds, folds=settings.folds)
    require_seed(seed, settings.seeds)
    for name, optimizer in (*((name, "adam") for name in OF_ADAM), ("samples", "gauss-newton")):
        if getattr(settings, name) is not None and settings.optimizer != optimizer:
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option} is an option of --optimizer {optimizer}; add that, or leave {option} out")
    if settings.target is None:
        return
    require_positive(target=settings.target)
    if settings.model != STRUCTURED:
        raise InputError(f"--target is an option of --model {STRUCTURED}; add that, or leave --target out")
    if settings.optimizer == "adam" or settings.seeds > 1:
        raise InputError("--target grows one structured network by gauss-newton; leave the other options out")
    for name in ("width", "depth", "samples"):
        if getattr(settings, name) is not None:
            raise InputError(f"--{name} is for one network, and --target grows several; leave it out")


def train_plan(plan: Fit, sets: Split, context: Context, *, name: str = CHECKPOINT) -> Training:
    """Trains a plan on these sets within the time limit of the context; the spread of all samples sets the scale."""
    assert plan.optimiser is not None, "a network is trained by an optimiser"
    scale, total = plan.objective.scale(sets.train), plan.optimiser.steps
    arrays = (getattr(data, key) for data in sets for key in plan.objective.keys)
    checkpoint = context.checkpoint(name, plan.optimiser, arrays, seeds=plan.seeds)
    if plan.samples is not None:
        sets = sets._replace(train=drawn(sets.train, plan.samples, int(np.ravel(plan.seeds)[0])))
    with context.progress(total) as show:
        return train(
            dynamics.problem(plan.model, sets, plan.objective._replace(scale=lambda data: scale), seeds=plan.seeds),
            plan.optimiser,
            checkpoint=checkpoint,
            report=lambda at: show(min(int(np.max(at.step)), total), losses(at)),
            seconds=context.seconds,
            mesh=context.mesh,
        )


def cross_validate(plan: Fit, sets: Split, context: Context, folds: int) -> int:
    """Returns the index of the seed with the lowest cross-validation error over folds of the motions.

    One or two validation motions often prefer the worse of two seeds. Every motion outside the test is in one fold.
    """
    rest = merged(sets._replace(test=trajectories(sets.test, [])))
    motions = np.random.default_rng(np.ravel(plan.seeds)[0]).permutation(np.unique(rest.trajectory))
    total = np.zeros(len(np.ravel(plan.seeds)))
    folds = min(folds, len(motions))
    for number, held in enumerate(np.array_split(motions, folds)):
        fold = Split(trajectories(rest, np.setdiff1d(motions, held)), trajectories(rest, held), sets.test)
        own = context.within(context.seconds / (folds - number))
        training = train_plan(plan, fold, own, name=f"checkpoint_fold_{number + 1}")
        total += np.asarray(training.validation) * len(fold.validation.t)
    errors = total / len(rest.t)
    text = ", ".join(f"{seed}: {error:.2e}" for seed, error in zip(np.ravel(plan.seeds), errors, strict=True))
    context.say(f"cross-validated errors by seed, {folds} folds: {text}")
    return int(np.argmin(np.nan_to_num(errors, nan=np.inf)))


def grow(target: float, plan: Fit, parts: Parts, context: Context) -> Fit:
    """Trains all networks of one width, then of the next, up to the first width that meets the target.

    Keeps the fastest network that meets the target, or the most accurate one if none does.
    """
    fits: list[Fit] = []
    rows: list[dict[str, Any]] = []
    met: list[int] = []
    ended = ""
    for width, depth, shared in itertools.product(WIDTHS, DEPTHS, (True, False) if plan.needs.gravity else (False,)):
        if met and width > fits[-1].description["width"]:
            break
        # All processes have to agree.
        if fits and of_first_process(context.seconds <= SOON, context.mesh):
            ended = f"time is up; networks of width {width} and more were not all tried"
            break
        description = {**plan.description, "width": width, "depth": depth, "shared_trunk": shared}
        own = replace(plan, description=description, model=build(description))
        training = train_plan(own, parts.sets, context, name=f"checkpoint_{width}x{depth}_{1 if shared else 2}")
        result, error = of_training(own, training), float(training.validation)
        name = f"{depth} x {width}, {'one network' if shared else 'two networks'}"
        context.say(f"{name}: validation {error:.2e}, target {'met' if error <= target else 'not met'}")
        rows.append(
            {
                "name": name,
                "parameters": sum(np.size(leaf) for leaf in jax.tree.leaves(result.parameters)),
                "validation_error": error,
                "train_seconds": training.train_seconds + training.compile_seconds,
                # The selection depends on the time, so all processes must use the same value.
                "one_step_us": of_first_process(latency_of(result, parts.sets.test, calls=2000).p50_us, context.mesh),
            }
        )
        met += [len(fits)] * (error <= target)
        fits.append(result)
    key = "one_step_us" if met else "validation_error"
    kept = min(met or range(len(fits)), key=lambda place: rows[place][key])
    say_selection(context, f"grown until the validation error is {target:g}", rows[kept]["name"], ended, rows)
    if not met:
        context.say(f"no candidate meets {target:g}; the most accurate one is kept. More --steps or --seconds may help")
    return fits[kept]
