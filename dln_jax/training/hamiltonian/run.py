"""Trains a Hamiltonian model of a phase space into a run folder: the model, its errors, speed and figures."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.cli.progress import progress
from dln_jax.cli.scaled import mesh_of
from dln_jax.cli.stored_arguments import command_folder, write_config
from dln_jax.data.stated_needs import needs_from_json
from dln_jax.files import write_json
from dln_jax.learning.engine.problem import Progress
from dln_jax.metrics.verdict import FitRefused
from dln_jax.scale.devices import device_lines
from dln_jax.time_limit import deadline, seconds_left
from dln_jax.training.hamiltonian.model_selection import PAIRWISE
from dln_jax.training.hamiltonian.options import Options, prepare
from dln_jax.training.hamiltonian.results import draw, evaluate, line
from dln_jax.training.hamiltonian.stages import gauge_of, in_velocities
from dln_jax.training.hamiltonian.tasks import MEASURED, REAL, Problem
from dln_jax.training.hamiltonian.training import Trained, stages_of, train
from dln_jax.training.results import losses, print_numbers
from dln_jax.types import InputError
from dln_jax.zoo.run import save


def run(given: Options, command: str) -> None:
    """Trains, evaluates and writes a run folder, by default runs/`command`-1, -2, ...

    Raises:
        InputError: the validation error is not finite, or the loss became non-finite; the last good parameters are
            kept.
        FitRefused: test motions are predicted badly, and neither --steps nor --seconds cut the training short; the run
            folder is complete.
    """
    until = deadline(given.seconds)
    problem, description, training, said = prepare(given, until)
    mesh = mesh_of(given)
    with command_folder(given, command, **description) as folder:
        announce(problem, description, said)
        with stage_progress(stages_of(problem, description, training["steps"])) as report:
            kept = {"directory": folder, "resume": given.resume}
            keep = partial(save_first, folder, description)
            limited = {"seconds": seconds_left(until), "report": report, "keep": keep, "mesh": mesh}
            trained = train(problem, description, **training, **kept, **limited)
        if not np.isfinite(trained.result.validation):
            raise InputError(f"{trained.stopped}; {folder} holds no model")
        save(folder, description, trained.result.parameters)
        if given.seconds is not None:
            print(f"{folder} holds the model; its evaluation follows and is not limited by --seconds")
        metrics, seen, verdict = evaluate(folder, problem, trained, low_latency=given.low_latency)
        write_json(folder / "metrics.json", metrics)
        write_config(folder, given, **description, verdict=verdict._asdict())
        if given.figures:
            draw(folder, problem, description["name"], seen, trained)
        numbers = [line(name, value) for name, value in metrics.items() if name != "verdict"]  # it has its own line
        print_numbers(numbers, title=f"test motions of {problem.name}, f64")
        print(f"run folder: {folder}")
        print(verdict.line)
        if trained.diverged:
            raise InputError(f"{trained.stopped}; {folder} holds the best model before that")
        if trained.stopped:
            print(trained.stopped)
        if verdict.level == "refused":
            if given.steps is None and not trained.out_of_time:
                raise FitRefused(verdict)
            print("warning: training ended at the limit that you set; give it more --steps or --seconds")


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


def announce(problem: Problem, description: dict[str, Any], said: list[str]) -> None:
    """Prints the data used for training and the assumptions made."""
    data = problem.fitted
    trajectories = len(np.unique(data.trajectory))
    needs = needs_from_json(description["needs"])
    terms = " and ".join(name for name in ("gravity", "friction") if getattr(needs, name)) or "no potential"
    print(f"{problem.name}: {len(data.t)} samples of {trajectories} segments for training and validation")
    print(f"{'-'.join(needs.joints)} with {terms}; {description['name']}, f64")
    unused = ("qdd",) if problem.noise is None else ("p", "pd")
    missing = [key for key in data.estimated if key not in ("tau", *unused)]
    if missing:
        of = "finite differences" if problem.noise is None else "local polynomials, not finite differences,"
        print(f"not in the data: {', '.join(missing)}; {of} start the fit to motions")
    print("".join(f"{line}\n" for line in said), end="")
    if in_velocities(problem, description):
        q = ", ".join(f"{each:.3g}" for each in gauge_of(problem).q)
        print(f"p = dL/dqd; without torques an energy is one up to a factor: here the mean inertia at q = ({q}) is 1")
    elif problem.name == REAL or problem.noise is not None:
        print("momenta p are taken as qd, per unit of inertia")
    for each in (*assumptions(problem, description), *device_lines("f64")):
        print(each)


def assumptions(problem: Problem, description: dict[str, Any]) -> list[str]:
    """Assumptions inferred from measurements rather than stated."""
    found = []
    if problem.assumed:
        found.append("nothing states the needs: joints, potential and friction above are assumed; --needs states them")
    if problem.name == MEASURED and description["name"] == PAIRWISE:
        example = {"bodies": "x1, y1, x2, y2", "axes": "x1, x2, y1, y2"}[description["order"]]
        found.append(f"coordinates are taken as {example}, .. with {description['dimension']} axes; --order states it")
    if problem.trust is not None and problem.noise is None:
        noise = ", ".join(f"{each:.2g}" for each in np.ravel(problem.trust.weights.state))
        small = (
            "states are free of noise" if problem.trust.free_of_noise else f"motions are weighed by noise of {noise}"
        )
        found.append(f"(q, p): {small}")
    if problem.gaps and problem.tests is not None:
        found.append(f"test recordings have {problem.gaps} gap(s); predictions go on across them by time stamps")
    return found
