"""Selects the model of a Hamiltonian task, by name or by validation, and describes it."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.data.bodies import Order, arrangements, find_bodies
from dln_jax.data.schema import Trajectories, column
from dln_jax.data.splits import hold_out
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import loss_of
from dln_jax.learning.matching import match_linear
from dln_jax.learning.objectives import TORQUE
from dln_jax.learning.select import grow, segments
from dln_jax.training.hamiltonian.measurements import MEASURED, forces_of
from dln_jax.training.hamiltonian.recipes import RECIPES
from dln_jax.training.hamiltonian.stages import IN_VELOCITIES, LINEAR, first_problem, in_velocities
from dln_jax.training.hamiltonian.tasks import Problem
from dln_jax.types import InputError, Needs
from dln_jax.zoo.catalogue import CATALOGUE, entry_of
from dln_jax.zoo.descriptions import build, describe_for

PAIRWISE, HELMHOLTZ = "pairwise-hnn", "helmholtz-hnn"
POLYNOMIAL = "polynomial-hamiltonian"
"""Additional model for tasks with one coordinate and without friction."""
DEGREES = range(2, 7)
FRICTION_WIDTH = 4
"""Hidden units of the friction network if a scene has friction; the black-box model has one coefficient instead."""
VALIDATION_SHARE = 0.15
"""Fraction of the training trajectories used for validation."""
EXACT = 1e-8
"""With a smaller error, relative to the mean square of measured rates, no other model or fit of motions is needed."""
TRIED_DEGREES = (2, 4)
"""Degrees of the polynomial candidates in model selection."""
TRIAL_STEPS = 20
"""Gauss-Newton iterations used to compare candidates."""
MOST_POLYNOMIAL = 2
"""A polynomial is a candidate up to this number of coordinates: its number of terms grows with their power."""


class Candidate(NamedTuple):
    """A candidate model for measurements."""

    name: str
    needs: Needs
    keywords: Mapping[str, Any] = MappingProxyType({})

    @property
    def words(self) -> str:
        """The name and the settings that distinguish it from candidates of the same name."""
        more = [f"{key} {value}" for key, value in self.keywords.items() if key != "friction_width"]
        return ", ".join([self.name, *more, *(["with friction"] if self.needs.friction else [])])


def description_of(problem: Problem, model: str, *, precision: str = "f64", **keywords: Any) -> dict[str, Any]:
    """Description of a model for a task; "auto" selects the one that suits the scene.

    `keywords` (width, depth, activation, degree, coordinates, order) override the recipe; see also `choose_model`.
    """
    recipe = RECIPES[problem.name]
    if model == "auto" and problem.name == MEASURED:
        return choose_model(problem, precision=precision, **keywords)
    suits = model in ("auto", recipe.suits)
    name = recipe.suits if suits else model
    if problem.noise is not None and name in LINEAR:
        own = {key: value for key, value in keywords.items() if value is not None and key in LINEAR[name]}
        return describe_for(name, problem.fitted, problem.needs, precision=precision, **own)
    if not (entry_of(name).properties.canonical or (problem.noise is not None and name in IN_VELOCITIES)):
        known = ", ".join(name for name, entry in CATALOGUE.items() if entry.properties.canonical)
        raise InputError(f"model '{name}' is of no phase space; choose from auto, {known}")
    stated: dict[str, Any] = {"precision": precision, "pooled": True}
    if name == POLYNOMIAL:
        degree = keywords.get("degree") or polynomial_degree(problem)
        return describe_for(name, problem.fitted, problem.needs, **stated, degree=degree)
    bodies = stated_bodies(problem, keywords.get("order")) if name == PAIRWISE else {}
    few = (recipe.width, recipe.depth) if suits or problem.name == MEASURED else (recipe.network, recipe.network_depth)
    size: dict[str, Any] = {"width": few[0], "depth": few[1], "activation": "tanh"}
    if name == HELMHOLTZ and keywords.get("field"):
        size["field"] = keywords["field"]
    size |= {key: value for key, value in keywords.items() if value is not None and key in size}
    if problem.needs.friction and name in ("separable-hnn", "structured-hnn"):
        size["friction_width"] = keywords.get("friction_width", FRICTION_WIDTH)
    if name == PAIRWISE and "alike" in keywords:
        bodies["alike"] = keywords["alike"]
    return describe_for(name, problem.fitted, problem.needs, **stated, **size, **bodies)


def stated_bodies(problem: Problem, order: Order | None) -> dict[str, Any]:
    """Arrangement of the coordinates for a pairwise model: as stated, or the one in which measured forces balance.

    Raises:
        InputError: the order is neither stated nor determined by the measurements.
    """
    if problem.name != MEASURED:
        return {} if order is None else {"order": order}
    if set(problem.needs.joints) != {"prismatic"} or not arrangements(problem.needs.degrees_of_freedom):
        return {}  # the model itself refuses them
    bodies = find_bodies(forces_of(problem.fitted), order=order)
    if bodies is None:
        raise InputError(
            f"the forces along {problem.needs.degrees_of_freedom} coordinates do not show which of them belong to one "
            "body; state --order bodies (x1, y1, x2, y2) or --order axes (x1, x2, y1, y2), or take another model"
        )
    return bodies._asdict()


def polynomial_degree(problem: Problem) -> int:
    """The smallest sufficient degree, chosen by validation trajectories."""
    fitted, validation = hold_out(problem.fitted, VALIDATION_SHARE, 0)

    def fit(degree: int):
        description = describe_for(POLYNOMIAL, fitted, problem.needs, precision="f64", degree=degree)
        return match_linear(build(description), fitted, validation=validation)

    return grow(DEGREES, fit)[0].candidate


def choose_model(
    problem: Problem,
    *,
    networks: bool = False,
    seconds: float = math.inf,
    report: Callable[[str], None] | None = None,
    **keywords: Any,
) -> dict[str, Any]:
    """The smallest model of measurements whose validation error no other candidate improves significantly.

    Args:
        problem: measured motions.
        networks: whether only networks are candidates.
        seconds: time limit; then no other candidate is tried.
        report: called with one line per candidate tried, or the reason for trying none.
        keywords: as for `description_of`.
    """
    began = time.perf_counter()
    say = report or (lambda line: None)
    every = candidates(problem, networks)
    parts = hold_out(problem.fitted, VALIDATION_SHARE, 0)

    def described(candidate: Candidate) -> dict[str, Any]:
        narrowed = problem._replace(needs=candidate.needs)
        return description_of(narrowed, candidate.name, **keywords | dict(candidate.keywords))

    def attempt(candidate: Candidate) -> tuple[dict[str, Any], np.ndarray]:
        description = described(candidate)
        errors = validation_errors(problem, description, parts)
        share = float(np.mean(errors)) / mean_square_rates(problem, description, parts[1])
        say(f"auto: {candidate.words} leaves {share:.2g} of the mean square of validation rates")
        return description, errors

    if len(every) == 1:
        description = described(every[0])
        if rates_are_biased(problem):
            say(
                f"auto: {every[0].words}; the states are noisy, so that errors of rates cannot rank models: "
                f"try --model {POLYNOMIAL} as well"
            )
        return description
    target = EXACT * mean_square_rates(problem, described(every[-1]), parts[1])

    def in_time() -> Iterator[Candidate]:
        for at, candidate in enumerate(every):
            if at and time.perf_counter() - began >= seconds:
                say(f"auto: out of time, not tried: {'; '.join(other.words for other in every[at:])}")
                return
            yield candidate

    return grow(in_time(), attempt, target=target)[0].outcome


def rates_are_biased(problem: Problem) -> bool:
    """Whether rates were measured with states so noisy that a fit of the rates is biased."""
    return problem.noise is None and problem.trust is not None and not problem.trust.free_of_noise


def candidates(problem: Problem, networks: bool) -> list[Candidate]:
    """Candidate models for measurements, in order of size.

    Bodies with balanced forces get pairwise models. Data without momenta compare models of accelerations, others
    models of rates. Noisy states rule out the comparison: they bias all fits, those of flexible models the least.
    """
    needs, d = problem.needs, problem.needs.degrees_of_freedom
    free = needs._replace(friction=False)
    if set(needs.joints) == {"prismatic"} and not needs.friction and find_bodies(forces_of(problem.fitted)):
        return [Candidate(PAIRWISE, needs, {"alike": alike}) for alike in (True, False)]
    if problem.noise is not None:
        chain = ["planar-chain"] if set(needs.joints) == {"revolute"} else []
        names = ["structured-hnn"] if networks else [*chain, "trigonometric", "structured-hnn"]
        return [Candidate(name, needs) for name in names]
    if rates_are_biased(problem):
        # Assumed friction has one coefficient per coordinate.
        friction = {"friction_width": 0} if problem.assumed else {}
        return [Candidate("separable-hnn" if d == 1 else "structured-hnn", needs, friction)]
    structured = [Candidate(name, needs) for name in ("separable-hnn", "structured-hnn")]
    if networks or d > MOST_POLYNOMIAL or (needs.friction and not problem.assumed):
        return structured
    return [*(Candidate(POLYNOMIAL, free, {"degree": degree}) for degree in TRIED_DEGREES), *structured]


def validation_errors(
    problem: Problem, description: dict[str, Any], parts: tuple[Trajectories, Trajectories]
) -> np.ndarray:
    """Squared errors of validation rates after a short fit: per sample, or per segment of time for estimated rates."""
    if description["name"] == POLYNOMIAL:
        return match_linear(build(description), parts[0], validation=parts[1])[1]
    task = first_problem(problem, description, parts, 0)
    training = fit(task, GaussNewton(steps=TRIAL_STEPS), must_start=False)
    loss = loss_of(task)
    keys = TORQUE.keys if in_velocities(problem, description) else ("q", "p", "qd", "pd")
    # The loss of a batch of one sample is the squared error of that sample.
    batches = [column(parts[1], key)[:, None] for key in keys]
    errors = np.asarray(jax.jit(jax.vmap(lambda *batch: loss(training.parameters, batch)))(*batches))
    if not in_velocities(problem, description):
        return errors
    numbers = segments(parts[1])
    return np.bincount(numbers, errors) / np.bincount(numbers)


def mean_square_rates(problem: Problem, description: dict[str, Any], data: Trajectories) -> float:
    """Mean square of the rates, the reference for errors of a fit of rates."""
    if in_velocities(problem, description):
        return float(data.degrees_of_freedom)  # `accelerations_problem` divides by the spread
    return float(np.mean(np.concatenate([data.qd, column(data, "pd")]) ** 2))
