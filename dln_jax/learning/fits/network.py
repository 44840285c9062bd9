"""Networks, trained by an optimiser under a checkpoint: one seed, several in one program, or networks that grow."""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.data.log import Log
from dln_jax.data.parts import Parts
from dln_jax.data.splits import Split, drawn, merged
from dln_jax.data.splits import select as trajectories
from dln_jax.learning import dynamics
from dln_jax.learning.dynamics import MANY_JOINTS, suited_network, summed_with_friction, without_offset
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.engine.fit import fit as train
from dln_jax.learning.engine.optimisers import Optimiser, name_of, optimiser_named
from dln_jax.learning.engine.problem import Problem, Training, losses
from dln_jax.learning.fit import Fit, fit_of
from dln_jax.learning.fits.settings import OF_ADAM, Network
from dln_jax.learning.latency import latency_of
from dln_jax.learning.objectives import SCALED_TORQUE, TORQUE, Objective, objective_of
from dln_jax.learning.select import Trial, lowest, say_selection, select
from dln_jax.scale.devices import device_lines
from dln_jax.scale.mesh import of_first_process
from dln_jax.sizes import require_network
from dln_jax.time_limit import SOON
from dln_jax.types import InputError, Needs, require_positive, require_seed
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import Description, build, describe_for

STRUCTURED = "structured-delan"
WITHOUT_STRUCTURE = 400
"""Default number of iterations of a black box, which converges later than a structured network."""
WIDTHS, DEPTHS = (4, 8, 16, 32), (1, 2)
"""Sizes of networks that grow."""


class Plan(NamedTuple):
    """A network, its optimiser and its samples."""

    description: Description
    needs: Needs
    objective: Objective
    optimiser: Optimiser
    reason: str
    """Reason for this optimiser; empty if the user chose it."""
    samples: int | None
    """Number of training samples that are drawn; `None` for all."""
    seeds: int | tuple[int, ...]


def fit(settings: Network, log: Log, parts: Parts, context: Context) -> Fit:
    """Trains the network; cross-validation selects one of several seeds, and a target grows networks.

    Raises:
        InputError: settings out of range, data that cannot determine the model, or a loss that is not finite.
    """
    plan = plan_network(settings, log, parts, context.seed)
    say = context.say
    if plan.needs != log.needs:
        say("friction has no offset: the potential takes any constant")
    if CATALOGUE[settings.model].properties.canonical and plan.objective.of_torques:
        say("no momenta p in the data: the Hamiltonian is fitted to torques")
    why = f" ({plan.reason})" if plan.reason else ""
    say(f"{settings.model}, {plan.description['precision']}, {name_of(plan.optimiser)}{why}")
    for line in device_lines(plan.description["precision"]):
        say(line)
    if settings.target is not None:
        return grow(settings.target, plan, parts, context)
    several = settings.seeds > 1 and settings.folds > 1
    seconds = context.seconds / (settings.folds + 1 if several else 1)
    training = train_plan(plan, parts.sets, context.within(seconds), shown=True)
    if training.stop.reason != "not finite" and not np.isfinite(training.validation).any():
        raise InputError("no validation error is finite; there is no model: look for large numbers in the data")
    best = int(np.argmin(np.nan_to_num(np.ravel(training.validation), nan=np.inf)))
    if several:
        best = cross_validate(plan, parts.sets, context, settings.folds)
        if not np.isfinite(training.validation[best]):
            best = int(np.argmin(np.nan_to_num(training.validation, nan=np.inf)))
    return fit_of_plan(plan, training, best, cross_validated=several)


def fit_of_plan(plan: Plan, training: Training, best: int, **how: Any) -> Fit:
    """The fit of a trained plan."""
    how |= {"objective": plan.objective, "optimiser": plan.optimiser, "seeds": plan.seeds}
    return fit_of(plan.description, plan.needs, training, best, **how)


def plan_network(settings: Network, log: Log, parts: Parts, seed: int) -> Plan:
    """Plans the network and its optimiser: as stated, or as the sizes of model and data suggest."""
    require_consistent(settings, seed)
    name, sets, needs, optimizer = settings.model, parts.sets, log.needs, settings.optimizer
    if summed_with_friction(needs, sets.train, network=True):
        needs = without_offset(needs)
    objective = objective_of(name, sets.train, settings.objective)
    if objective is TORQUE and settings.target is None:
        objective = SCALED_TORQUE
    definite = CATALOGUE[name].properties.definite
    sized = settings.width is not None or settings.depth is not None or settings.target is not None
    suited = None
    if name == STRUCTURED and optimizer == "auto" and not sized and needs.degrees_of_freedom >= MANY_JOINTS:
        suited = suited_network(needs, sets.train)
        optimizer = suited.optimizer
    adam = optimizer == "adam"
    # A structured model needs fewer units; first-order training needs more.
    size: dict[str, Any] = {"width": 64 if adam else 8 if definite else 16, "depth": 2, "activation": "tanh"}
    size |= {key: value for key in size if (value := getattr(settings, key)) is not None}
    size |= {} if suited is None else suited.keywords
    require_network(width=size["width"], depth=size["depth"])
    precision = settings.precision or ("f32" if adam else "f64")
    description = describe_for(name, sets.train, needs, precision=precision, **size)
    reason = "" if suited is None else suited.reason
    if optimizer == "auto":
        optimizer, reason = dynamics.suited_optimiser(build(description), sets, objective)
        description["precision"] = precision = settings.precision or ("f32" if optimizer == "adam" else "f64")
    steps, samples = settings.steps, settings.samples
    if suited is not None:
        steps = suited.steps if steps is None else steps
        samples = suited.samples if samples is None else samples
    elif optimizer == "gauss-newton" and not definite:
        steps = steps or WITHOUT_STRUCTURE
    chosen = {key: getattr(settings, key) for key in (*OF_ADAM, "target")}
    optimiser = optimiser_named(optimizer, precision=precision, steps=steps, **chosen)
    seeds = seed if settings.seeds == 1 else tuple(range(seed, seed + settings.seeds))
    return Plan(description, needs, objective, optimiser, reason, samples, seeds)


def require_consistent(settings: Network, seed: int) -> None:
    """Refuses numbers out of range, and settings that other settings make meaningless."""
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


def problem_of(plan: Plan, sets: Split) -> Problem:
    """The fitting problem of a network; drawn samples are scaled by the spread of all of them."""
    scale, some = plan.objective.scale(sets.train), sets
    if plan.samples is not None:
        some = sets._replace(train=drawn(sets.train, plan.samples, int(np.ravel(plan.seeds)[0])))
    return dynamics.problem(
        build(plan.description), some, plan.objective._replace(scale=lambda data: scale), seeds=plan.seeds
    )


def train_plan(plan: Plan, sets: Split, context: Context, *, name: str = "checkpoint", shown: bool = False) -> Training:
    """Trains the plan on these sets in the time of the context."""
    total = plan.optimiser.steps
    identity = dynamics.identity_of(plan.optimiser, sets, plan.objective, seeds=plan.seeds)
    with context.progress(total) if shown else Context().progress(total) as show:
        return train(
            problem_of(plan, sets),
            plan.optimiser,
            checkpoint=context.checkpoint(identity, name),
            report=lambda at: show(min(int(np.max(at.step)), total), losses(at)),
            seconds=context.seconds,
            mesh=context.mesh,
        )


def cross_validate(plan: Plan, sets: Split, context: Context, folds: int) -> int:
    """Index of the seed with the lowest cross-validation error over folds of the motions.

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


def grow(target: float, plan: Plan, parts: Parts, context: Context) -> Fit:
    """Trains all networks of a width before the next width, up to the first width that meets the target.

    Keeps the fastest network that meets it or, if none does, the most accurate.
    """
    speeds: dict[str, float] = {}
    met: list[Trial] = []
    rows: list[dict[str, Any]] = []
    kinds = list(itertools.product(DEPTHS, (True, False) if plan.needs.gravity else (False,)))

    ended = ""

    def sizes() -> Iterator[dict[str, Any]]:
        nonlocal ended
        for width in WIDTHS:
            for depth, shared in kinds:
                # All processes have to agree.
                if rows and of_first_process(context.seconds <= SOON, context.mesh):
                    ended = f"out of time: networks of width {width} and more were not all tried"
                    return
                yield {"width": width, "depth": depth, "shared_trunk": shared}
            if met:
                return

    def attempt(size: dict[str, Any]) -> tuple[Fit, np.ndarray]:
        networks = 1 if size["shared_trunk"] else 2
        own = plan._replace(description={**plan.description, **size})
        name = f"checkpoint_{size['width']}x{size['depth']}_{networks}"
        result = fit_of_plan(own, train_plan(own, parts.sets, context, name=name), 0)
        error = float(result.training.validation)
        # The selection depends on the time, so all processes must use the same value.
        speed = of_first_process(latency_of(result, parts.sets.test, calls=2000).p50_us, context.mesh)
        words = f"{size['depth']} x {size['width']}, {'one network' if networks == 1 else 'two networks'}"
        context.say(f"{words}: validation {error:.2e}, target {'met' if error <= target else 'not met'}")
        rows.append(
            {
                "name": words,
                "parameters": sum(np.size(leaf) for leaf in jax.tree.leaves(result.parameters)),
                "validation_error": error,
                "train_seconds": result.training.train_seconds + result.training.compile_seconds,
                "one_step_us": speed,
            }
        )
        speeds[words] = speed
        trial = Trial(size, (result, words), np.array([error]))
        met.extend([trial] * (error <= target))
        return trial.outcome, trial.errors  # type: ignore[return-value]

    chosen, _ = select(
        sizes(),
        attempt,
        rule=lambda trials: min(met, key=lambda trial: speeds[trial.outcome[1]]) if met else lowest(trials),
    )
    say_selection(context, f"grown until the validation error is {target:g}", chosen.outcome[1], ended, rows)
    if not met:
        context.say(f"no candidate meets {target:g}; kept is the most accurate. More --steps or --seconds may help")
    return chosen.outcome[0]
