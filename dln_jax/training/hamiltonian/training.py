"""Training of a model for a Hamiltonian task, in one or two stages.

Spring and pendulum have noise on the states and none on the rates: models are fitted to rates first and then to
trajectories with free starts, which removes the bias due to the noise. The other generated tasks have no noise and are
fitted to rates alone. Measured rates, usually noisy or estimated, serve for a first fit before that to trajectories.
"""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import PER_SAMPLE, hold_out
from dln_jax.learning import matching, shooting
from dln_jax.learning.engine import problem as engine
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser
from dln_jax.learning.engine.problem import Progress, ProgressReport, Training, silent
from dln_jax.scale.mesh import of_first_process
from dln_jax.training.hamiltonian.model_selection import EXACT, POLYNOMIAL, VALIDATION_SHARE, mean_square_rates
from dln_jax.training.hamiltonian.recipes import RECIPES
from dln_jax.training.hamiltonian.stages import first_problem, in_velocities, second_problem, weights_of
from dln_jax.training.hamiltonian.tasks import Problem
from dln_jax.zoo.descriptions import build

RATES, MOTIONS = "rates", "motions"
OUT_OF_TIME = "out of time"
WINDOWS_OF_A_STEP = 64
"""Batch size of Adam, in windows, for the fit of motions."""


MOTIONS_COMPILE = 6.0
"""Approximate ratio of the compile times of motions and rates (5 to 7): a compilation cannot be interrupted."""
FLAT = 1e-5
"""The fit of motions ends when the relative decrease of the loss per Gauss-Newton iteration is smaller."""


class Trained(NamedTuple):
    """A trained model and its stages."""

    description: dict[str, Any]
    """Description for `dln_jax.zoo.build`."""
    fits: dict[str, Training]
    """Trainings by stage, in sequence; the last one's parameters are the result."""
    stopped: str = ""
    """Why a stage was skipped or ended early; empty if neither happened."""
    diverged: bool = False
    """Whether the loss became non-finite."""

    @property
    def out_of_time(self) -> bool:
        """Whether the time limit ended or skipped a fit."""
        return self.stopped.startswith(OUT_OF_TIME)

    @property
    def result(self) -> Training:
        """The last fit."""
        return list(self.fits.values())[-1]

    @property
    def history(self) -> list[Progress]:
        """Progress of all stages, with a continuous count of steps."""
        named = ([at._replace(stage=stage) for at in fit.history] for stage, fit in self.fits.items())
        return engine.one_after_the_other(named)


def stages_of(problem: Problem, description: dict[str, Any], steps: int | None = None) -> dict[str, int]:
    """Number of steps of every iterative stage of a training."""
    recipe = RECIPES[problem.name]
    most = {RATES: 0 if description["name"] == POLYNOMIAL else recipe.steps, MOTIONS: recipe.trajectory_steps}
    return {stage: steps or own for stage, own in most.items() if own}


def check(problem: Problem, description: dict[str, Any], *, seed: int) -> None:
    """Raises `InputError` for anything in the data that `train` would refuse."""
    recipe = RECIPES[problem.name]
    parts = hold_out(problem.fitted, VALIDATION_SHARE, seed)
    fitted = first_problem(problem, description, parts, seed)
    if in_velocities(problem, description):
        engine.require_finite_start(fitted, fitted.arrays)
        second_problem(problem, description, parts, fitted.parameters, seed)
        return
    engine.require_finite_start(fitted, matching.phase_samples(problem.fitted))
    if recipe.trajectory_steps:
        windows, validation = (shooting.cut_windows(part, recipe.window) for part in parts)
        shooting.arrays(windows, validation, weights_of(problem, parts[0]))


def train(
    problem: Problem,
    description: dict[str, Any],
    *,
    seed: int,
    optimiser: Optimiser = GaussNewton(),  # noqa: B008
    steps: int | None = None,
    seconds: float = math.inf,
    directory: Path | None = None,
    resume: bool = False,
    report: ProgressReport = silent,
    keep: Callable[[Trained], None] | None = None,
    mesh: Mesh | None = None,
) -> Trained:
    """Fits a model to rates and then, if the recipe says so, to trajectories, by `steps` or the recipe's steps.

    `seconds` limits both fits together, compilation included. The fit of rates is the result if the time left is too
    short to compile the next program, or if the fit of motions is not finite at its start. `keep` is called with it
    before motions are fitted. Motions are not fitted if measured rates are exact. Devices share samples in both fits.
    """
    began = time.perf_counter()
    recipe, model = RECIPES[problem.name], build(description)
    numbers = [getattr(problem.fitted, key) for key in PER_SAMPLE]

    def fitted(stage: str, task: engine.Problem, most: int, file: str, seconds: float, **options: Any) -> Training:
        own = optimiser._replace(steps=steps or most)
        if isinstance(own, Adam):
            own = own._replace(patience=own.steps, batch=WINDOWS_OF_A_STEP if stage == MOTIONS else own.batch)
        elif stage == MOTIONS:
            # One iteration per dispatch, so that the time limit is kept and validation judges every iteration.
            own = own._replace(improvement=FLAT, steps_per_dispatch=1)
        known = identity(own, numbers, model=description, seed=seed, samples=recipe.samples)
        kept = None if directory is None else Checkpoint(directory, known, resume, f"checkpoint_{file}")
        staged = {"report": lambda at: report(at._replace(stage=stage)), "checkpoint": kept}
        return fit(task, own, **staged, seconds=seconds, mesh=mesh, **options)

    parts = hold_out(problem.fitted, VALIDATION_SHARE, seed)
    if description["name"] == POLYNOMIAL:
        first = matching.match_linear(model, parts[0], validation=parts[1])[0]
    else:
        first = fitted(RATES, first_problem(problem, description, parts, seed), recipe.steps, "rates", seconds)
    fits = {RATES: first}
    left = of_first_process(seconds - (time.perf_counter() - began), mesh)
    if not recipe.trajectory_steps or first.stop.reason == "not finite":
        return _ended(description, fits, RATES, first, optimiser)
    if rates_are_exact(problem, description, parts[1], first):
        return Trained(description, fits, "the measured rates are free of noise or fitted exactly: motions need no fit")
    alone = Trained(description, fits, f"{OUT_OF_TIME} after the fit of rates: motions were not fitted")
    if first.stop.reason == "time" or left <= MOTIONS_COMPILE * (first.compile_seconds or first.train_seconds):
        return alone
    if keep is not None:
        keep(alone)
    task = second_problem(problem, description, parts, first.parameters, seed)
    second = fitted(MOTIONS, task, recipe.trajectory_steps, "trajectories", left, must_start=False)
    if not in_velocities(problem, description):
        second = second._replace(parameters=second.parameters["model"])
    if second.stop.step and np.isfinite(second.validation):
        fits[MOTIONS] = second
    return _ended(description, fits, MOTIONS, second, optimiser)


def rates_are_exact(problem: Problem, description: dict[str, Any], validation: Trajectories, fit: Training) -> bool:
    """Whether a fit of measured rates is sufficient: states are free of noise, or its error is negligible."""
    own = ("qd", "qdd") if in_velocities(problem, description) else ("qd", "pd")
    if problem.trust is None or any(key in problem.fitted.estimated for key in own):
        return False
    size = mean_square_rates(problem, description, validation)
    return problem.trust.free_of_noise or fit.validation <= EXACT * size


def _ended(
    description: dict[str, Any], fits: dict[str, Training], stage: str, last: Training, optimiser: Optimiser
) -> Trained:
    """Adds a sentence on how the last fit ended."""
    at = f"after step {last.stop.step} of the fit of {stage}"
    remedy = (
        "lower --learning-rate" if isinstance(optimiser, Adam) else "state the plant's --needs, try another --model"
    )
    words = {
        "time": f"{OUT_OF_TIME} {at}: kept is the best so far",
        "not finite": f"the loss stopped being finite {at}; {remedy}, or look for very large numbers in the data",
    }
    return Trained(description, fits, words.get(last.stop.reason, ""), last.stop.reason == "not finite")
