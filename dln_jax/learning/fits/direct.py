"""Fits without a network: linear models, Gaussian processes of energies, and trees of unknown joint frames.

A search from random starts finds the frames of a tree; elimination gives all other parameters.

Validation chooses degrees, the order of the bodies, and whether friction has an offset. Gauss-Newton refines the result
for objectives other than torques.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from dln_jax.data.log import Log, Parts
from dln_jax.files import read_json
from dln_jax.learning import dynamics
from dln_jax.learning.dynamics import without_offset
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.engine.fit import fit as train
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import one_after_the_other
from dln_jax.learning.fit import Fit, direct_fit
from dln_jax.learning.fits.settings import Arm, Kernel, LearnedTree, Trigonometric
from dln_jax.learning.kernel import choose_kernel, fit_kernel
from dln_jax.learning.kinematics.fit import fit_tree
from dln_jax.learning.kinematics.frames import KinematicPrior, kinematic_prior_from_json
from dln_jax.learning.kinematics.search import Search
from dln_jax.learning.linear import choose_degrees, fit_linear
from dln_jax.learning.objectives import (
    SCALED_TORQUE,
    objective_of,
    squared_torque_errors,
    torque_scale,
)
from dln_jax.learning.select import mean_of_segments, select
from dln_jax.mechanics.friction import USUAL
from dln_jax.scale import device_lines
from dln_jax.types import InputError, Needs, require_positive
from dln_jax.zoo.descriptions import Description, build, describe_for

SAMPLES = 600
"""Default for the largest number of samples in a kernel."""
REFINEMENTS = 50
"""Largest number of Gauss-Newton steps from a direct fit, which is near the minimum."""
EXACT = 1e-12
"""A fit with a smaller normalised error needs no further term."""


def fit_basis(settings: Trigonometric, log: Log, parts: Parts, context: Context) -> Fit:
    """Fits the trigonometric model by least squares; validation chooses the degrees unless they are given."""
    began, train, say = time.perf_counter(), parts.sets.train, context.say
    degree: Any = 1 if settings.degree is None else settings.degree
    description = described(settings, log.needs, parts, context, degree=degree)
    if settings.degree is None:
        chosen, trials = choose_degrees(log.needs, train, parts.sets.validation)
        tried = ", ".join(f"{_degrees(trial.candidate)}: {trial.validation:.2e}" for trial in trials)
        say(f"validation error by degrees of the joints: {tried}; chosen {_degrees(chosen.candidate)}")
        description["degree"] = list(chosen.candidate)
        solution = chosen.outcome
    else:
        solution = fit_linear(build(description), train)
    description, needs, solution = choose_offset(
        description, log.needs, parts, solution, lambda lean: fit_linear(build(lean), train), say
    )
    size = f"{solution.parameter_count} parameters, rank {solution.rank}, condition {solution.condition:.3g}"
    say(f"least squares: {size}")
    how = {"loss": solution.torque_mse, "seconds": time.perf_counter() - began}
    objective = objective_of(settings.model, parts.sets.train, settings.objective, torque=SCALED_TORQUE)
    return refine(direct_fit(description, needs, parts, solution.parameters, objective, **how), parts, context)


def _degrees(degrees: tuple[int, ...]) -> str:
    return "-".join(map(str, degrees))


def fit_energies(settings: Kernel, log: Log, parts: Parts, context: Context) -> Fit:
    """Fits kernels with and without the assumption of a serial chain, and selects one by validation."""
    began, train, say = time.perf_counter(), parts.sets.train, context.say
    samples = SAMPLES if settings.samples is None else settings.samples
    require_positive(samples=samples)
    chosen, trials = choose_kernel(log.needs, train, parts.sets.validation, samples=samples)
    kept = {"samples": chosen.outcome.samples, "serial": chosen.candidate}
    description, needs, solution = choose_offset(
        described(settings, log.needs, parts, context, **kept),
        log.needs,
        parts,
        chosen.outcome,
        lambda lean: fit_kernel(without_offset(log.needs), train, **kept),
        say,
    )
    if solution.samples < len(train.tau):
        say(f"kernel: {solution.samples} of {len(train.tau)} samples, evenly spaced; --samples takes more")
    order = {True: "a chain", False: "any order"}
    tried = ", ".join(f"{order[trial.candidate]}: {trial.validation:.2e}" for trial in trials)
    say(f"validation error in units of the torques' variance by order of the bodies: {tried}")
    noise = ", ".join(f"{sd:.2g}" for sd in solution.noise)
    size = f"{solution.parameter_count} equations, log likelihood {solution.likelihood:.2f} by the torque"
    say(f"kernel: {order[chosen.candidate]}, {size}, noise of the joints {noise}")
    how = {"loss": solution.torque_mse, "seconds": time.perf_counter() - began}
    return direct_fit(description, needs, parts, solution.parameters, **how)


def described(
    settings: Trigonometric | Kernel | LearnedTree, needs: Needs, parts: Parts, context: Context, **keywords: Any
) -> Description:
    """Describes the model, in float64 by default, and reports the devices of the fit."""
    precision = settings.precision or "f64"
    for line in device_lines(precision):
        context.say(line)
    return describe_for(settings.model, parts.sets.train, needs, precision=precision, **keywords)


def choose_offset(
    description: Description,
    needs: Needs,
    parts: Parts,
    solution: Any,
    refit: Callable[[Description], Any],
    say: Callable[[str], None],
) -> tuple[Description, Needs, Any]:
    """Keeps an offset of friction beside a potential if it improves the validation error.

    Args:
        solution: the fit with the offset; has `parameters`.
        refit: description without the offset -> fit.
    """
    lean = without_offset(needs)
    if lean == needs:
        return description, needs, solution
    scale, validation = torque_scale(parts.sets.train), parts.sets.validation

    def fitted(needs_of_trial: Needs) -> tuple[Any, np.ndarray]:
        own = {**description, "needs": needs_of_trial._asdict()}
        result = refit(own) if needs_of_trial == lean else solution
        errors = squared_torque_errors(build(own), result.parameters, validation, scale)
        return (own, needs_of_trial, result), mean_of_segments(validation, errors).mean(axis=1)

    chosen, _ = select((lean, needs), fitted, stop=lambda trial: trial.validation <= EXACT)
    say(f"friction kept by validation: {', '.join(chosen.candidate.joint_friction) or 'none'}")
    return chosen.outcome


def refine(start: Fit, parts: Parts, context: Context) -> Fit:
    """Refines a direct fit by Gauss-Newton for objectives other than torques; keeps the better fit by validation.

    Raises:
        InputError: the model has too many parameters for Gauss-Newton, or its precision is f32.
    """
    if start.objective.of_torques:
        return start
    precision = start.description["precision"]
    suited, reason = dynamics.suited_optimiser(start.model, parts.sets, start.objective)
    if suited != "gauss-newton" or precision != "f64":
        why = reason if precision == "f64" else "the precision is f32"
        raise InputError(f"--objective refines a {start.name} model by Gauss-Newton in f64, but {why}; leave it out")
    problem = dynamics.problem(start.model, parts.sets, start.objective)._replace(parameters=start.parameters)
    refit = train(problem, GaussNewton(steps=REFINEMENTS, improvement=1e-6), seconds=context.seconds, must_start=False)
    before = start.training
    context.say(
        f"refined by Gauss-Newton: validation error {before.validation:.2e} before, {refit.validation:.2e} after"
    )
    training = refit if refit.validation < before.validation else before
    history = one_after_the_other([before.history, refit.history])
    training = training._replace(history=history, compile_seconds=refit.compile_seconds)
    return replace(start, training=training, parameters=training.parameters)


def fit_arm(settings: LearnedTree, log: Log, parts: Parts, context: Context) -> Fit:
    """Searches joint frames by Gauss-Newton from random starts or near a prior, and eliminates all other parameters."""
    needs = needs_of_tree(log.needs)
    parents, prior = knowledge_of(settings, needs.degrees_of_freedom)
    description = described(settings, needs, parts, context, parents=parents, velocity_scale=needs.velocity_scale)
    solution = fit_tree(
        needs,
        parts.sets.train,
        parts.sets.validation,
        **{key: description[key] for key in ("parents", "acceleration", "velocity_scale")},
        settings=Search(seed=context.seed, seconds=context.seconds, kinematic_prior=prior),
        report=context.say,
    )
    size = f"{solution.parameter_count} parameters, of the linear ones rank {solution.rank}, "
    context.say(f"learned tree: {size}condition {solution.condition:.3g}")
    how = {"loss": solution.torque_mse, "seconds": solution.seconds, "search": solution}
    objective = objective_of(settings.model, parts.sets.train, settings.objective, torque=SCALED_TORQUE)
    return refine(direct_fit(description, needs, parts, solution.parameters, objective, **how), parts, context)


def needs_of_tree(needs: Needs) -> Needs:
    """Converts needs for a learned tree, which has viscous friction, dry friction and an offset per joint.

    Raises:
        InputError: friction laws that a learned tree does not have.
    """
    laws = with_joint_laws(needs).joint_friction
    if others := [law for law in laws if law not in USUAL]:
        raise InputError(f"a learned tree has no {others[0]} friction; leave it out of joint_friction")
    return needs._replace(friction=bool(laws), joint_friction=())


def with_joint_laws(needs: Needs) -> Needs:
    """Replaces friction by a network with joint friction laws."""
    if not needs.friction:
        return needs
    return needs._replace(friction=False, joint_friction=needs.joint_friction or USUAL)


def knowledge_of(settings: Arm, d: int) -> tuple[tuple[int, ...] | None, KinematicPrior | None]:
    """Returns the given parents of d joints, counted from 0, and the given kinematic prior."""
    parents, path = None, settings.kinematic_prior
    if settings.parents is not None:
        try:
            parents = tuple(int(number) - 1 for number in settings.parents.split(","))
        except ValueError:
            parents = ()
        if len(parents) != d or any(not -1 <= parent < link for link, parent in enumerate(parents)):
            raise InputError(
                f"--parents is {settings.parents!r:.60}; expected {d} whole numbers separated by commas: joints "
                "before, counted from 1, or 0 for the ground"
            )
    if path is None:
        return parents, None
    try:
        return parents, kinematic_prior_from_json(read_json(path, remedy="see --help"), d, parents)
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
