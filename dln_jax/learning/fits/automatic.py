"""Model selection: fits models from the strongest prior knowledge to the weakest, and keeps one by validation.

Validation compares squared torque errors in units of the joints' variances, so that a wrist counts as much as a
shoulder. Models with positive definite mass matrices are preferred unless they explain much less, because accelerations
are wrong otherwise. The selection ends when errors reach the noise of the torques or rounding, or when time is up.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.data.arrays import spread
from dln_jax.data.encoders.sampling import noise_of
from dln_jax.data.joints import needs_from_json
from dln_jax.data.log import Log, Parts
from dln_jax.data.schema import Trajectories
from dln_jax.files import is_file, read_json, write_json
from dln_jax.identification.identify import identify
from dln_jax.identification.rigid_tree import build_rigid_tree, describe_rigid_tree
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.fit import Fit, direct_fit
from dln_jax.learning.fits.direct import with_joint_laws
from dln_jax.learning.fits.settings import Automatic, Kernel, LearnedTree, Network, Trigonometric
from dln_jax.learning.linear import MOST_PARAMETERS, parameters_of, parameters_of_degree
from dln_jax.learning.objectives import squared_torque_errors, torque_scale
from dln_jax.learning.select import Trial, lowest, mean_of_segments, say_selection, select, simplest
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import definiteness
from dln_jax.types import InputError, JointVector, Needs
from dln_jax.zoo.run import load

SELECTION_SECONDS, CANDIDATE_SECONDS = 300.0, 120.0
"""Default time limits, s: for the whole selection, and for each search or network."""
EXACT = 1e-12
"""No further candidate is tried once the normalised error of every joint is below this."""
LEAST_NOISE, MOST_NOISE = 0.5, 1.2
"""Range of a joint's error relative to its noise variance that counts as noise. A lower error shows that the noise
estimate is wrong."""
USEFUL, PRICE = 0.25, 10.0
"""Largest mean normalised error that a verdict does not refuse, as in `metrics.verdict`, and the largest increase of
the mean error, as a factor, for a positive definite mass matrix."""


def fit(settings: Automatic, log: Log, parts: Parts, context: Context) -> Fit:
    """Fits the candidates, prints them as a table and returns the selected one.

    The devices of a mesh share the final network; one device fits all other candidates.

    Raises:
        InputError: no model could be fitted.
    """
    train, validation, _ = parts.sets
    for key in ("q", "qd", "qdd"):
        spread(key, getattr(train, key))  # refuses implausibly large numbers
    torque_scale(train)
    log = log._replace(needs=with_joint_laws(log.needs))
    limited = math.isfinite(context.until)
    context = context.within(math.inf if limited else SELECTION_SECONDS)
    attempt = partial(fit_or_load, log, parts, context, math.inf if limited else CANDIDATE_SECONDS)
    chosen, rows, ended = compare(
        {name: partial(attempt, name, candidate) for name, candidate in candidates_of(settings, log)},
        train,
        validation,
        noise=noise_of(train.tau, train.trajectory),
        until=context.until,
        definite=lambda result: is_definite(result, parts),
        say=context.say,
    )
    say_selection(context, "candidates, by errors on validation motions", chosen.candidate, ended, rows)
    return chosen.outcome


def compare(
    candidates: Mapping[str, Callable[[], Any]],
    train: Trajectories,
    validation: Trajectories,
    *,
    noise: JointVector | float,
    until: float,
    definite: Callable[[Any], bool],
    say: Callable[[str], None],
) -> tuple[Trial, list[dict[str, Any]], str]:
    """Fits candidates in order and chooses the first that no other one significantly improves; prefers definite models.

    Returns the chosen trial, a row for each candidate, and the reason for an early end, if any.

    Args:
        candidates: name -> function that returns a model with parameters, or a reason for failure; the most structured
            model first.
        train: samples to fit; their torque variances are the units of the errors.
        validation: other motions.
        noise: standard deviation of the torque noise of each joint, N m or N, or NaN; such errors end the comparison.
        until: reading of `time.perf_counter` at which the comparison ends, after the first successful fit.
        definite: whether a model's mass matrix is positive definite; true for models without one.
        say: takes a line for each candidate.

    Raises:
        InputError: torques do not vary, or no candidate could be fitted.
    """
    scale, rows, ended = torque_scale(train), {}, ""
    share = (noise / scale) ** 2

    def attempt(name: str, candidate: Callable[[], Any]) -> tuple[Any, np.ndarray | None]:
        began = time.perf_counter()
        result = candidate()
        seconds, errors = time.perf_counter() - began, None
        if not isinstance(result, str):
            squares = squared_torque_errors(result.model, result.parameters, validation, scale)
            errors = mean_of_segments(validation, squares)
            if np.isfinite(errors).all():
                nmse = squares.mean(axis=0)
                rows[name] = {
                    "name": name,
                    "validation_nmse": float(nmse.mean()),
                    "worst_joint": float(nmse.max()),
                    "seconds": seconds,
                    "definite": definite(result),
                    "joints": nmse.tolist(),
                }
                say(f"{name}: validation nMSE {nmse.mean():.3g}, worst joint {nmse.max():.3g}, {seconds:.1f} s")
                return result, errors.mean(axis=1)
            result = "torques are not finite on validation motions"
        rows[name] = {"name": name, "validation_nmse": None, "seconds": seconds, "reason": result}
        say(f"{name}: {result}")
        return result, None

    def stop(trial: Trial) -> bool:
        nonlocal ended
        nmse = np.array(rows[trial.candidate]["joints"])
        if not rows[trial.candidate]["definite"]:
            return False
        if (nmse <= EXACT).all():
            ended = f"{trial.candidate} is exact"
        elif np.all((nmse >= LEAST_NOISE * share) & (nmse <= MOST_NOISE * share)):
            ended = f"the errors of {trial.candidate} are as small as the torque noise"
        return bool(ended)

    def rule(trials: Sequence[Trial]) -> Trial:
        affordable = min(USEFUL, PRICE * lowest(trials).validation)
        sound = [trial for trial in trials if rows[trial.candidate]["definite"] and trial.validation <= affordable]
        return simplest(sound or trials)

    chosen, trials = select(
        list(candidates), lambda name: attempt(name, candidates[name]), rule=rule, until=until, stop=stop
    )
    left = list(candidates)[len(trials) :]
    if left and not ended:
        seconds = sum(row["seconds"] for row in rows.values())
        ended = f"time is up after {seconds:.0f} s; {', '.join(left)} not tried"
    return chosen, list(rows.values()), ended


Candidate = Callable[[Log, Parts, Context], Fit | str]
"""Returns a fit, or a reason for failure; an `InputError` counts as a reason."""


def candidates_of(settings: Automatic, log: Log) -> list[tuple[str, Candidate]]:
    """Lists the candidates with their names, from the strongest prior knowledge to the weakest."""
    first, second = (parameters_of_degree(log.needs, degree) for degree in (1, 2))
    size = "too many" if first is None else f"{first:,}"
    too_large = f"its basis has {size} coefficients; at most {MOST_PARAMETERS:,} are tried"
    fits = first is not None and first <= MOST_PARAMETERS
    explicit = "trigonometric", Trigonometric().fit if fits else lambda *_: too_large
    learned = "learned-tree", LearnedTree(parents=settings.parents, kinematic_prior=settings.kinematic_prior).fit
    # Fitting a small basis takes less than a second, and a search for joint frames half a minute.
    small = second is not None and second <= MOST_PARAMETERS
    return [
        *[("rigid-tree", lambda log, parts, context: identify_robot(log, parts))] * (log.robot is not None),
        *([explicit, learned] if small else [learned, explicit, ("trigonometric-kernel", Kernel().fit)]),
        ("structured-delan", Network().fit),
    ]


def fit_or_load(log: Log, parts: Parts, context: Context, seconds: float, name: str, candidate: Candidate) -> Fit | str:
    """Fits a candidate and stores it in its own folder, or loads it from there in a resumed run.

    A learned tree is fitted again, because its verdict needs the search.
    """
    place = (context.folder or Path()) / "candidates" / name
    done = place / "candidate.json"
    if context.folder is not None and context.resume and is_file(done):
        facts = read_json(done, remedy=f"remove {place}")
        if facts.get("reason"):
            return str(facts["reason"])
        run = load(place)
        needs = needs_from_json(run.description["needs"])
        return direct_fit(run.description, needs, parts, run.parameters, seconds=float(facts["seconds"]))
    began = time.perf_counter()
    try:
        result = candidate(log, parts, context.within(seconds))
    except InputError as error:
        result = str(error)
    if context.folder is None:
        return result
    place.mkdir(parents=True, exist_ok=True)
    if isinstance(result, str):
        write_json(done, {"reason": result})
    else:
        result.save(place)
        if result.search is None:
            write_json(done, {"seconds": time.perf_counter() - began})
    return result


def is_definite(result: Fit, parts: Parts) -> bool:
    """Whether a model's mass matrices are positive definite on validation motions; true if it has none."""
    if result.properties.definite or not result.properties.energy:
        return True
    data = parts.sets.validation
    with jax.enable_x64(True):
        mechanics = dynamics(result.model.energies(result.parameters))
        _, share_not_definite, _ = definiteness(mechanics, data.q, data.qd)
    return share_not_definite == 0


def identify_robot(log: Log, parts: Parts) -> Fit:
    """Identifies the inertias and friction of the robot's tree."""
    if log.robot is None:
        raise InputError("the log has no robot to identify; pass the robot's file as robot=")
    began, train, needs = time.perf_counter(), parts.sets.train, with_joint_laws(log.needs)
    stated = needs.velocity_scale != Needs(needs.joints).velocity_scale
    scale = needs.velocity_scale if stated else None
    description, _, _ = describe_rigid_tree(log.robot, needs, train, velocity_scale=scale)
    model, known = build_rigid_tree(description, log.robot)
    solution = identify(model, known, train, joints=needs.joints)
    parameters = parameters_of(solution.theta, known)
    return direct_fit(description, needs, parts, parameters, seconds=time.perf_counter() - began)
