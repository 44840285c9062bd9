"""Trains value functions, as a kind of the pipeline, or evaluates a stored one."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.control.optimal.fitted import Iteration
from dln_jax.control.optimal.plants import ValuePlant
from dln_jax.files import finite
from dln_jax.metrics.verdict import Verdict
from dln_jax.precision import with_float64
from dln_jax.runs.arguments import names_listed, numbers_of, refuse_given, require_positive_if_given
from dln_jax.runs.progress import progress
from dln_jax.runs.report import Report, png
from dln_jax.training.pipeline import Fitted, Kind
from dln_jax.training.value_figures import closed_loop, value_slice_of
from dln_jax.training.value_plants import Chosen, Wishes, is_file_of_plant, of_file, of_run, published
from dln_jax.training.values import (
    ITERATIONS,
    Family,
    Kept,
    Trained,
    ValueRun,
    by_equation,
    by_iteration,
    family_of,
    load_value,
    measured,
    save_value,
    usual,
    worst_of,
)
from dln_jax.types import InputError, require_positive, require_seed

FAILED, WRONG = 0.9, 0.1
"""Share of the hanging starts that must end upright; a law below it is refused. Largest median error of a good V."""
OF_OWN = ("actuated", "control", "positions", "effort", "weights", "box")
"""Options of a user's own plant."""


class Case(NamedTuple):
    """A plant and the family of networks for its value function, or a stored value function."""

    name: str
    plant: ValuePlant
    chosen: Chosen
    goal: tuple[float, ...] | None
    method: str
    family: Family | None
    """`None` for a stored value function."""
    numbers: Iteration
    robust: float = 0.0
    stored: ValueRun | None = None


def prepare(options: Any) -> Case:
    """Reads and checks everything that the options name."""
    require_positive(starts=options.starts)
    if options.stored is not None:
        run = load_value(options.stored)
        chosen = published(run.name, None)._replace(plant=run.plant) if run.own is None else run.own
        return Case(run.name, run.plant, chosen, None, "stored", None, Iteration(), stored=run)
    require_positive(seeds=options.seeds)
    require_seed(options.seed, options.seeds)
    require_positive_if_given(options, ("width", "depth", "members", "iterations"))
    goal = None if options.goal is None else numbers_of("--goal", options.goal)
    chosen = plant_of(options, goal)
    worst_of(chosen, options.robust)  # refuses a wrong share
    fit = usual(chosen, options.method)
    width, depth = options.width or fit.widths[0], options.depth or len(fit.widths)
    family = Family((width,) * depth, options.members or 1, scale=fit.scale)
    return Case(chosen.name, chosen.plant, chosen, goal, options.method, family, fit.numbers, options.robust)


def plant_of(options: Any, goal: tuple[float, ...] | None) -> Chosen:
    """The plant that the options name: published, of a file, or of a run folder."""
    own = options.run is not None or is_file_of_plant(options.plant)
    if not own:
        refuse_given(options, OF_OWN, f"an option of one's own plant, and --plant is {options.plant!r:.40}")
        return published(options.plant, goal)
    size = None if options.control is None else numbers_of("--control", options.control, positive=True)
    d = None if options.weights is None else numbers_of("--weights", options.weights, positive=True)
    box = None if options.box is None else numbers_of("--box", options.box, positive=True)
    positions = None if options.positions is None else ranges_of(options.positions)
    control = size[0] if size is not None and len(size) == 1 else size
    wishes = Wishes(names_listed(options.actuated), control, goal, positions, options.effort, d, box)
    return of_file(Path(options.plant), wishes) if options.run is None else of_run(options.run, wishes)


def ranges_of(text: str) -> list[tuple[float, float]]:
    """Parses the ranges of --positions, such as -0.5:0.5,free."""
    ranges = []
    for part in text.split(","):
        low, colon, high = part.partition(":")
        if part.strip() == "free":
            ranges.append((-np.inf, np.inf))
            continue
        try:
            pair = float(low), float(high)
        except ValueError:
            pair = np.nan, np.nan
        if not (colon and np.isfinite(pair).all() and pair[0] < pair[1]):
            raise InputError(f"--positions has {part!r:.40}; expected LOW:HIGH or free for every joint: -1:1,free")
        ranges.append(pair)
    return ranges


def announce(case: Case) -> Iterator[str]:
    """Lines on the plant, the method and the networks."""
    if case.family is None:
        return
    yield from case.chosen.lines
    widths = case.family.widths
    yield f"{case.name}: {case.method}, {case.family.members} x {len(widths)} layers of {widths[0]}"
    if case.robust:
        counted = dict.fromkeys(case.chosen.uncertain)
        yield f"robust against errors of {case.robust:.0%} of {' and '.join(counted)}"


def fit(case: Case, options: Any, folder: Path, mesh: Mesh | None) -> Fitted:
    """Trains once per seed and keeps the best by validation; a stored value function stays unchanged."""
    if case.family is None or case.stored is not None:
        return Fitted({}, None, (case.stored, {}))
    trained = trainings(case, case.family, options, folder, mesh)
    best = min(trained, key=lambda training: training.validation)
    numbers = {"train_seconds": best.train_seconds, "validation": best.validation}
    if len(trained) > 1:
        numbers |= over_seeds(trained)
    network = family_of(case.plant, case.family)
    return Fitted({}, best.parameters, (ValueRun(case.name, case.plant, network, best.parameters), numbers))


def trainings(case: Case, family: Family, options: Any, folder: Path, mesh: Mesh | None) -> list[Trained]:
    """Trains once per seed and shows the progress."""
    seeds = range(options.seed, options.seed + options.seeds)
    disturbance = worst_of(case.chosen, case.robust)
    with contextlib.ExitStack() as stack:
        show: list[Callable[[int, str], None]] = []

        def report(done: int, total: int, text: str) -> None:
            if not show:
                show.append(stack.enter_context(progress(total, "iterations")))
            show[0](done, text)

        if case.method == "residual":
            iterations = options.iterations or ITERATIONS
            return by_equation(case.plant, family, iterations, seeds, report, mesh, disturbance=disturbance)
        numbers = case.numbers._replace(iterations=options.iterations or case.numbers.iterations)
        own = case.chosen.own
        settings = {
            "plant": case.name if own is None else {**dataclasses.asdict(own.problem), "model": own.description},
            "goal": case.goal,
            "family": dataclasses.asdict(family),
            "numbers": numbers._asdict(),
            "robust": case.robust,
        }
        kept = Kept(folder, settings, options.resume)
        return by_iteration(case.plant, family, numbers, seeds, report, mesh, disturbance=disturbance, kept=kept)


def over_seeds(trained: Sequence[Trained]) -> dict[str, float]:
    """Median and worst validation, and median training time, over several seeds."""
    validation = [training.validation for training in trained]
    return {
        "validation_median": float(np.median(validation)),
        "validation_worst": float(np.max(validation)),
        "train_seconds_median": float(np.median([training.train_seconds for training in trained])),
    }


def judge(case: Case, fitted: Fitted, options: Any, folder: Path) -> Report:
    """Returns of the law in the evaluation, whether its starts end upright, and figures."""
    run, numbers = fitted.outcome
    run = ValueRun(run.name, run.plant, run.network, with_float64(run.parameters), run.own)
    measures = measured(case.chosen, run, count=options.starts, share=case.robust)
    verdict, numbers = verdict_of(measures, options.starts), numbers | measures
    own = None if case.chosen.own is None else case.chosen.own.problem
    return Report(
        metrics={**{key: finite(value) for key, value in numbers.items()}, "verdict": verdict.number},
        rows=[
            (key.replace("_", " "), f"{value:.4g}", "s" if "seconds" in key else "") for key, value in numbers.items()
        ],
        title=f"returns from {options.starts} starts hanging, and anywhere",
        # The evaluation of a stored value function reports the verdict; a training refuses.
        verdict=verdict if case.stored is None else None,
        lines=() if case.stored is None else (verdict.line,),
        figures={
            "value.png": png(value_slice_of, run, own),
            "closed-loop.png": png(closed_loop, run, own),
        },
        chosen={"plant": case.name},
        ended_by_user=getattr(options, "iterations", None) is not None,
    )


def verdict_of(numbers: dict[str, float], count: int) -> Verdict:
    """Verdict on a value function by the share of starts that its law brings upright, and the error of V."""
    down, anywhere = numbers["down_up_share"], numbers["uniform_up_share"]
    reason = f"{down:.0%} of {count} hanging starts end up, and {anywhere:.0%} of those anywhere at rest"
    if (altered := [numbers.get(f"{name}_up_share") for name in ("heavy_weak", "light_strong")])[0] is not None:
        reason += f"; {min(altered):.0%} of the hanging ones with the worst masses and motors"  # type: ignore[type-var]
    error = numbers.get("value_error", 0.0)
    reason += f"; V differs from the cost of its law by {error:.1%} in the median"
    remedy = "train longer (--iterations) or with other --seeds, narrow the --box, or give a stronger motor"
    if not down >= FAILED:
        return Verdict("refused", reason, remedy)
    shares = [down, anywhere, *(share for share in altered if share is not None)]
    # A robust V is that of the worst case, and exceeds the cost on the model.
    sound = min(shares) == 1 and (error <= WRONG or altered[0] is not None)
    return Verdict("good", reason) if sound else Verdict("doubtful", reason, remedy)


def save(folder: Path, fitted: Fitted, case: Case) -> None:
    """Stores a trained value function."""
    if case.family is not None:
        save_value(folder, case.name, case.goal, case.family, fitted.parameters, case.chosen.own)


VALUES = Kind(prepare, announce, fit, judge, save)
