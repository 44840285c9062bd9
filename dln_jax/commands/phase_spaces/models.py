"""Selects the model of a Hamiltonian task, by name or by validation, and describes it."""

from typing import Any

import jax
import numpy as np

from dln_jax.commands.phase_spaces.data import PhaseLog, bodies_of
from dln_jax.commands.phase_spaces.training import (
    EXACT,
    IN_VELOCITIES,
    LINEAR,
    POLYNOMIAL,
    VALIDATION_SHARE,
    Halves,
    in_velocities,
    mean_square_rates,
    problem_of_rates,
)
from dln_jax.data.bodies import Order, arrangements
from dln_jax.data.schema import column
from dln_jax.data.splits import hold_out
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import loss_of
from dln_jax.learning.matching import match_linear
from dln_jax.learning.objectives import TORQUE
from dln_jax.learning.select import mean_of_segments, say_selection, select
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE, entry_of
from dln_jax.zoo.descriptions import Description, build, describe_for

PAIRWISE = "pairwise-hnn"
DEGREES = range(2, 7)
"""Degrees of a polynomial that is chosen by validation."""
TRIED_DEGREES = (2, 4)
"""Degrees of the polynomial candidates in model selection."""
MOST_POLYNOMIAL = 2
"""A polynomial is a candidate up to this number of coordinates: its number of terms grows with their power."""
FRICTION_WIDTH = 4
"""Hidden units of the friction network if a scene has friction; the black-box model has one coefficient instead."""
TRIAL_STEPS = 20
"""Gauss-Newton iterations used to compare candidates."""
PATIENCE = 2
"""Candidates in a row without improvement after which no larger one is tried."""
CHOICE_SHARE = 0.2
"""After this fraction of the time limit model selection starts no further candidate."""


def description_of(log: PhaseLog, model: str, *, order: Order | None = None, **stated: Any) -> Description:
    """Description of a model for a task.

    Args:
        log: the data of the task.
        model: a name of the catalogue; "auto" for the one that suits the task, if it is not that of any plant.
        order: order of the coordinates of bodies (default: the one in which their forces balance).
        stated: keywords of the model (width, depth, activation, degree, coordinates, field); others take the task's
            or the model's defaults.

    Raises:
        InputError: a model of no phase space, or keywords that it does not have.
    """
    task, needs = log.task, log.needs
    name = task.suits if model == "auto" else model
    own = log.noise is not None and name in IN_VELOCITIES
    if not own and not entry_of(name).properties.canonical:
        known = ", ".join(name for name, entry in CATALOGUE.items() if entry.properties.canonical)
        raise InputError(f"model '{name}' has no phase space; choose from auto, {known}")
    values: dict[str, Any] = {}
    if name not in (POLYNOMIAL, *LINEAR):
        width, depth = (task.width, task.depth) if name == task.suits else (task.network, task.network_depth)
        values = {"width": width, "depth": depth, "activation": "tanh"}
        if needs.friction and name in ("separable-hnn", "structured-hnn"):
            values["friction_width"] = FRICTION_WIDTH
    # The model itself refuses other joints.
    if name == PAIRWISE and set(needs.joints) == {"prismatic"} and arrangements(needs.degrees_of_freedom):
        bodies = bodies_of(log.fitted, order)
        if bodies is None:
            raise InputError(
                f"the forces along {needs.degrees_of_freedom} coordinates do not show which of them belong to one "
                "body; state --order bodies (x1, y1, x2, y2) or --order axes (x1, x2, y1, y2), or take another model"
            )
        values |= bodies._asdict()
    values |= stated
    if name == POLYNOMIAL and "degree" not in values:
        fitted, validation = hold_out(log.fitted, VALIDATION_SHARE, 0)

        def attempt(degree: int) -> tuple[Any, np.ndarray]:
            model = build(description_of(log, POLYNOMIAL, degree=degree))
            return match_linear(model, fitted, validation=validation)

        values["degree"] = select(DEGREES, attempt, patience=PATIENCE)[0].candidate
    return describe_for(name, log.fitted, needs, precision="f64", pooled=True, **values)


def choose_model(
    log: PhaseLog,
    context: Context = Context(),  # noqa: B008
    *,
    networks: bool = False,
    order: Order | None = None,
    **stated: Any,
) -> Description:
    """The smallest model of measurements whose validation error no other candidate improves significantly.

    Args:
        log: measured motions.
        context: limits the time, and takes lines on the candidates.
        networks: whether only networks are candidates.
        order: order of the coordinates of bodies, as for `description_of`.
        stated: keywords of networks.

    Raises:
        InputError: as for `description_of`.
    """
    descriptions = candidates(log, networks, order, stated)
    names = [words_of(description) for description in descriptions]
    if len(descriptions) == 1:
        if has_biased_rates(log):
            context.say(
                f"auto: {names[0]}; the states are noisy, so errors of rates cannot rank models: "
                f"try --model {POLYNOMIAL} as well"
            )
        return descriptions[0]
    parts = hold_out(log.fitted, VALIDATION_SHARE, 0)
    size = mean_square_rates(log, descriptions[-1], parts[1])
    rows: list[dict[str, Any]] = []

    def attempt(place: int) -> tuple[Description, np.ndarray]:
        errors = validation_errors(log, descriptions[place], parts)
        share = float(np.mean(errors)) / size
        context.say(f"auto: {names[place]} leaves {share:.2g} of the mean square of validation rates")
        rows.append({"name": names[place], "unexplained_rates": share})
        return descriptions[place], errors

    chosen, trials = select(
        range(len(names)),
        attempt,
        patience=PATIENCE,
        until=context.within(CHOICE_SHARE * context.seconds).until,
        stop=lambda trial: trial.validation <= EXACT * size,
    )
    left = "; ".join(names[len(trials) :])
    title = "candidates, by errors of rates on validation motions"
    say_selection(context, title, names[chosen.candidate], left and f"{left} not tried", rows)
    return chosen.outcome


def words_of(description: Description) -> str:
    """The model's name, and the settings that distinguish it from candidates of the same name."""
    more = [f"{key} {description[key]}" for key in ("degree", "alike") if key in description]
    return ", ".join([description["name"], *more, *["with friction"] * description["needs"]["friction"]])


def has_biased_rates(log: PhaseLog) -> bool:
    """Whether rates were measured with states so noisy that a fit of the rates is biased."""
    return log.noise is None and log.weights is not None and not log.free_of_noise


def candidates(log: PhaseLog, networks: bool, order: Order | None, stated: dict[str, Any]) -> list[Description]:
    """Candidate models for measurements, in order of size.

    Bodies with balanced forces get pairwise models. Data without momenta compare models of accelerations, others
    models of rates. Noisy states rule out the comparison: they bias all fits, those of flexible models the least.
    """
    needs, d = log.needs, log.needs.degrees_of_freedom
    if set(needs.joints) == {"prismatic"} and not needs.friction and bodies_of(log.fitted):
        return [description_of(log, PAIRWISE, order=order, alike=alike, **stated) for alike in (True, False)]
    if has_biased_rates(log):
        # Assumed friction has one coefficient per coordinate.
        friction = {"friction_width": 0} if log.assumed else {}
        return [description_of(log, "separable-hnn" if d == 1 else "structured-hnn", **friction, **stated)]
    names = ["separable-hnn", "structured-hnn"]
    if log.noise is not None:
        chain = ["planar-chain"] if set(needs.joints) == {"revolute"} else []
        names = ["structured-hnn"] if networks else [*chain, "trigonometric", "structured-hnn"]
    models = [description_of(log, name, **stated) for name in names]
    if log.noise is not None or networks or d > MOST_POLYNOMIAL or (needs.friction and not log.assumed):
        return models
    free = log._replace(needs=needs._replace(friction=False))
    return [*(description_of(free, POLYNOMIAL, degree=degree) for degree in TRIED_DEGREES), *models]


def validation_errors(log: PhaseLog, description: Description, parts: Halves) -> np.ndarray:
    """Squared errors of validation rates after a short fit: per sample, or per segment of time for estimated rates."""
    if description["name"] == POLYNOMIAL:
        return match_linear(build(description), parts[0], validation=parts[1])[1]
    problem = problem_of_rates(log, description, parts, 0)
    training = fit(problem, GaussNewton(steps=TRIAL_STEPS), must_start=False)
    loss, velocities = loss_of(problem), in_velocities(log, description)
    # The loss of a batch of one sample is the squared error of that sample.
    batches = [column(parts[1], key)[:, None] for key in (TORQUE.keys if velocities else ("q", "p", "qd", "pd"))]
    errors = np.asarray(jax.jit(jax.vmap(lambda *batch: loss(training.parameters, batch)))(*batches))
    return mean_of_segments(parts[1], errors) if velocities else errors
