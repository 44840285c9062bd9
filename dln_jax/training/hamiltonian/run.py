"""Trains Hamiltonian models of a phase space, as a kind of the pipeline: the model, its errors, speed and figures."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.control.optimal.problem import checked
from dln_jax.data.stated_needs import needs_from_json
from dln_jax.learning.engine.optimisers import Optimiser, optimiser_named
from dln_jax.learning.engine.problem import Progress, losses
from dln_jax.runs.arguments import numbers_of, require_positive_if_given
from dln_jax.runs.encoders import needs_from_option
from dln_jax.runs.logs import facts
from dln_jax.runs.progress import progress
from dln_jax.runs.report import Report
from dln_jax.scale.devices import device_lines
from dln_jax.time_limit import deadline, seconds_left
from dln_jax.training.hamiltonian.model_selection import PAIRWISE, choose_model, description_of
from dln_jax.training.hamiltonian.options import MEASURED, POLYNOMIAL, REAL
from dln_jax.training.hamiltonian.results import evaluate, figures_of, line
from dln_jax.training.hamiltonian.stages import gauge_of, in_velocities
from dln_jax.training.hamiltonian.tasks import Problem, Stated, problem_of
from dln_jax.training.hamiltonian.training import MOTIONS, Trained, check, stages_of, train
from dln_jax.training.pipeline import Fitted, Kind
from dln_jax.types import InputError, require_seed
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import save

FILTERED_HERE = ("raw-differences",)
"""Checks that do not apply here: estimated rates come from local polynomials, and motions are fitted to the states."""
CHOICE_SHARE = 0.2
"""After this fraction of the time limit model selection starts no further candidate."""
KEYWORDS = ("width", "depth", "activation", "degree", "coordinates", "order", "field")
"""Options that are keywords of a model."""


class Case(NamedTuple):
    """A phase space to learn, with its model and optimiser."""

    problem: Problem
    description: dict[str, Any]
    optimiser: Optimiser
    findings: list[str]
    until: float
    """Deadline by `time.perf_counter`."""


def prepare(options: Any) -> Case:
    """Resolves options into problem, description and optimiser, and checks them and the log; writes nothing."""
    until = deadline(options.seconds)
    require_seed(options.seed)
    require_positive_if_given(options, ["width", "depth", "degree", "steps", "trajectories", "seconds"])

    def stated(name: str) -> Any:
        return getattr(options, name, None)

    needs = None if stated("needs") is None else needs_from_option(options.needs)
    noise = None if stated("noise") is None else numbers_of("--noise", options.noise, positive=True)
    file = facts(options) if stated("data") is not None else {}
    known = Stated(needs, stated("test"), noise, file)
    problem = problem_of(options.task, trajectories=stated("trajectories"), data=stated("data"), stated=known)
    findings = []
    if problem.recorded is not None:
        findings = checked(options, problem.recorded, options.data, without=FILTERED_HERE)
    size = {name: stated(name) for name in KEYWORDS}
    if options.model == "auto" and options.task == MEASURED:
        networks = options.optimizer == "adam" or any(size[name] is not None for name in KEYWORDS[:3])
        chosen = {"networks": networks, "report": print, "seconds": CHOICE_SHARE * seconds_left(until)}
        description = choose_model(problem, **chosen, precision="f64", **size)
    else:
        description = description_of(problem, options.model, **size)
    build(description)
    if description["name"] == POLYNOMIAL:
        refuse_iterations(options, problem, description)
    name = "gauss-newton" if options.optimizer == "auto" else options.optimizer
    optimiser = optimiser_named(name, precision=description["precision"], learning_rate=stated("learning_rate"))
    check(problem, description, seed=options.seed)
    return Case(problem, description, optimiser, findings, until)


def refuse_iterations(options: Any, problem: Problem, description: dict[str, Any]) -> None:
    """Refuses iteration options for the polynomial model, whose fit of rates is one least-squares problem."""
    if options.optimizer == "adam":
        raise InputError("the polynomial model is one least-squares problem; leave --optimizer out")
    for name in ("steps", "seconds", "processes"):
        if getattr(options, name) is not None and MOTIONS not in stages_of(problem, description):
            raise InputError(f"--{name} is for networks; the polynomial model is one least-squares problem")


def fit(case: Case, options: Any, folder: Path, mesh: Mesh | None) -> Fitted:
    """Fits rates and then motions, in one training with two stages."""
    problem, description = case.problem, case.description
    with stage_progress(stages_of(problem, description, options.steps)) as report:
        trained = train(
            problem,
            description,
            seed=options.seed,
            optimiser=case.optimiser,
            steps=options.steps,
            directory=folder,
            resume=options.resume,
            seconds=seconds_left(case.until),
            report=report,
            keep=partial(save_first, folder, description),
            mesh=mesh,
        )
    if not np.isfinite(trained.result.validation):
        raise InputError(f"{trained.stopped}; {folder} holds no model")
    if options.seconds is not None:
        print(f"{folder} holds the model; its evaluation follows and is not limited by --seconds")
    return Fitted(description, trained.result.parameters, trained)


def judge(case: Case, fitted: Fitted, options: Any, folder: Path) -> Report:
    """Errors, speed and verdict on the predicted test motions."""
    problem, trained = case.problem, fitted.outcome
    metrics, seen, verdict = evaluate(folder, problem, trained)
    return Report(
        metrics=metrics,
        rows=[line(name, value) for name, value in metrics.items() if name != "verdict"],
        title=f"test motions of {problem.name}, f64",
        verdict=verdict,
        figures=figures_of(problem, case.description["name"], seen, trained),
        chosen=case.description,
        lines=(trained.stopped,) if trained.stopped and not trained.diverged else (),
        ended_by_user=options.steps is not None or trained.out_of_time,
        error=f"{trained.stopped}; {folder} holds the best model before that" if trained.diverged else "",
    )


def save_first(folder: Path, description: dict[str, Any], trained: Trained) -> None:
    """Saves the model of the fit of rates, which survives any failure of the fit of motions."""
    save(folder, description, trained.result.parameters)
    print(f"{folder} holds the model of the fit of rates; the fit of motions begins")


@contextmanager
def stage_progress(stages: dict[str, int]) -> Iterator[Callable[[Progress], None]]:
    """Yields `report(at)`, which shows the stages in sequence, each with its own count."""
    with ExitStack() as shown:
        current = next(iter(stages), "")
        show = shown.enter_context(progress(stages[current])) if stages else None

        def report(at: Progress) -> None:
            nonlocal current, show
            if show is None or at.stage != current:
                shown.close()
                current, show = at.stage, shown.enter_context(progress(stages[at.stage]))
            show(at.step, f"{at.stage}: {losses(at)}")

        yield report


def announce(case: Case) -> Iterator[str]:
    """Lines on the data used for training and the assumptions made."""
    problem, description = case.problem, case.description
    data = problem.fitted
    trajectories = len(np.unique(data.trajectory))
    needs = needs_from_json(description["needs"])
    terms = " and ".join(name for name in ("gravity", "friction") if getattr(needs, name)) or "no potential"
    yield f"{problem.name}: {len(data.t)} samples of {trajectories} segments for training and validation"
    yield f"{'-'.join(needs.joints)} with {terms}; {description['name']}, f64"
    unused = ("qdd",) if problem.noise is None else ("p", "pd")
    missing = [key for key in data.estimated if key not in ("tau", *unused)]
    if missing:
        of = "finite differences" if problem.noise is None else "local polynomials, not finite differences,"
        yield f"not in the data: {', '.join(missing)}; {of} start the fit to motions"
    yield from data.remarks
    yield from case.findings
    if in_velocities(problem, description):
        q = ", ".join(f"{coordinate:.3g}" for coordinate in gauge_of(problem).q)
        yield f"p = dL/dqd; without torques an energy is one up to a factor: here the mean inertia at q = ({q}) is 1"
    elif problem.name == REAL or problem.noise is not None:
        yield "momenta p are taken as qd, per unit of inertia"
    yield from assumptions(problem, description)
    yield from device_lines("f64")


def assumptions(problem: Problem, description: dict[str, Any]) -> list[str]:
    """Assumptions inferred from measurements rather than stated."""
    lines = []
    if problem.assumed:
        lines.append("nothing states the needs: joints, potential and friction above are assumed; --needs states them")
    if problem.name == MEASURED and description["name"] == PAIRWISE:
        example = {"bodies": "x1, y1, x2, y2", "axes": "x1, x2, y1, y2"}[description["order"]]
        lines.append(f"coordinates are taken as {example}, .. with {description['dimension']} axes; --order states it")
    if problem.trust is not None and problem.noise is None:
        noise = ", ".join(f"{sd:.2g}" for sd in np.ravel(problem.trust.weights.state))
        small = (
            "states are free of noise" if problem.trust.free_of_noise else f"motions are weighed by noise of {noise}"
        )
        lines.append(f"(q, p): {small}")
    if problem.gaps and problem.tests is not None:
        lines.append(f"test recordings have {problem.gaps} gap(s); predictions go on across them by time stamps")
    return lines


PHASE_SPACE = Kind(prepare, announce, fit, judge)
