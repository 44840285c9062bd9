"""A run of train_value: reads its options, trains or loads a value function, evaluates it and finishes the folder."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from dln_jax.commands.values.evaluation import LABELS, closed_loop, evaluation, value_plane, verdict_of
from dln_jax.commands.values.plants import file_of, of_file, of_run, problem_of, uncertain_numbers
from dln_jax.control.optimal.fitted import Iteration, fit_values
from dln_jax.control.optimal.own_plants import described, own_settings
from dln_jax.control.optimal.problem import ControlProblem, Disturbance, from_field, worst_disturbance
from dln_jax.control.optimal.value_networks import ValueFit, ValueNetwork, ValueProgress, discounts_down_to, fit_hjb
from dln_jax.files import finite
from dln_jax.learning.engine.checkpoint import Checkpoint, restore, store
from dln_jax.learning.engine.problem import Progress
from dln_jax.precision import with_float64
from dln_jax.runs.arguments import names_listed, numbers_of, require_positive_if_given
from dln_jax.runs.devices import mesh_of
from dln_jax.runs.folder import command_folder
from dln_jax.runs.progress import progress
from dln_jax.runs.report import Report, finish, png, rows_of
from dln_jax.types import InputError, require_positive
from dln_jax.zoo.run import load, save
from dln_jax.zoo.value_functions import ValueRun, network_of, plant_of_model, save_value

ITERATIONS = 15
"""Gauss-Newton iterations per discount."""
LAYERS = {"fitted": (96, 3), "residual": (24, 2)}
"""Width and depth of the networks by method."""
ROUNDS = 6
"""Number of resamplings at the problem's own discount."""


def train(options: Any) -> None:
    """Trains once per seed, keeps the best by validation, and evaluates it.

    Raises:
        InputError: an option is wrong, or the plant; nothing is written then.
        FitRefused: the law does not bring its starts up.
    """
    mesh = mesh_of(options)
    require_positive(starts=options.starts, seeds=options.seeds)
    require_positive_if_given(options, ("width", "depth", "members", "iterations"))
    if not 0 <= options.robust < 1:
        raise InputError(f"--robust is {options.robust}; expected a fraction of masses and motors, from 0 to below 1")
    goal = None if options.goal is None else numbers_of("--goal", options.goal)
    actuated, control = names_listed(options.actuated), positive_numbers(options, "control")
    control = control[0] if control is not None and len(control) == 1 else control
    source = options.run or file_of(options.plant)
    model, known, lacking = (of_file if options.run is None else of_run)(source, actuated, control, goal)
    own = problem_of(
        model,
        known,
        None if options.positions is None else ranges_of(options.positions),
        effort=options.effort,
        weights=positive_numbers(options, "weights"),
        box=positive_numbers(options, "box"),
    )
    name, problem = str(options.run or options.plant), plant_of_model(model.model, model.parameters, own)
    iteration, size = own_settings(own)
    lines = [*described(own), *filter(None, [lacking])]
    names, altered = uncertain_numbers(model, own)
    disturbance, extremes = None, {}
    if options.robust:
        disturbance = worst_disturbance(
            lambda x, u, p: altered(p)(x, u), np.ones(len(names)), parameters=options.robust
        )
        for extreme, sign in (("heavy_weak", options.robust), ("light_strong", -options.robust)):
            factors = jnp.array([1 - sign if of.startswith("strength") else 1 + sign for of in names], float)
            drift, actuation = from_field(altered(factors), len(own.limits))
            extremes[extreme] = problem._replace(drift=drift, actuation=actuation)
    width, depth = LAYERS[options.method]
    widths = [options.width or width] * (options.depth or depth)
    settings = {
        "widths": widths,
        "members": options.members or 1,
        "activation": "tanh",
        "floor": 1e-3,
        "scale": size,
    }
    network, seeds = network_of(problem, settings), range(options.seed, options.seed + options.seeds)
    with command_folder(options, "train_value") as folder:
        print(*lines, sep="\n")
        print(f"{name}: {options.method}, {settings['members']} x {len(widths)} layers of {widths[0]}")
        if options.robust:
            print(f"robust against errors of {options.robust:.0%} of {' and '.join(dict.fromkeys(names))}")
        if options.method == "residual":
            fits = by_equation(
                problem, network, options.iterations or ITERATIONS, seeds, mesh=mesh, disturbance=disturbance
            )
        else:
            iteration = iteration._replace(iterations=options.iterations or iteration.iterations)
            identity = [dataclasses.asdict(own), model.description, settings, iteration._asdict(), options.robust]
            fits = by_iteration(
                problem,
                network,
                iteration,
                seeds,
                lambda seed: Checkpoint(folder, {"settings": identity}, options.resume, f"checkpoint_seed_{seed}"),
                mesh=mesh,
                disturbance=disturbance,
            )
        best = min(fits, key=lambda fit: fit.validation)
        save(folder, model.description, model.parameters)
        save_value(folder, name, settings, best.parameters, own)
        seconds = [fit.train_seconds + fit.compile_seconds for fit in fits]
        metrics = {"train_seconds": seconds[fits.index(best)], "validation": best.validation}
        if len(fits) > 1:
            validation = [fit.validation for fit in fits]
            metrics |= {
                "validation_median": float(np.median(validation)),
                "validation_worst": max(validation),
                "train_seconds_median": float(np.median(seconds)),
            }
        run = ValueRun(name, problem, own, network, with_float64(best.parameters))
        finish(folder, options, report_of(run, options, metrics, extremes))


def evaluate_stored(options: Any) -> None:
    """Evaluates a stored value function on its own plant; raises `InputError` as `load`."""
    mesh_of(options)  # refuses devices that the machine lacks
    require_positive(starts=options.starts)
    run = load(options.stored).value
    run = dataclasses.replace(run, parameters=with_float64(run.parameters))
    with command_folder(options, "train_value") as folder:
        report = report_of(run, options, {}, {})
        # The evaluation of a stored value function reports the verdict; a training refuses.
        lines = () if report.verdict is None else (report.verdict.line,)
        finish(folder, options, report._replace(verdict=None, lines=lines))


def report_of(
    run: ValueRun, options: Any, numbers: Mapping[str, float], extremes: Mapping[str, ControlProblem]
) -> Report:
    """Returns of the law in the evaluation, also on extreme plants, whether its starts end upright, and figures."""
    measured = evaluation(run, options.starts, extremes)
    verdict = verdict_of(measured, options.starts)
    numbers = {**numbers, **measured}
    return Report(
        metrics={**finite(numbers), "verdict": verdict.number},
        rows=rows_of(numbers, LABELS),
        title=f"returns from {options.starts} starts near hanging, and as many anywhere",
        verdict=verdict,
        figures={"value.png": png(value_plane, run), "closed-loop.png": png(closed_loop, run)},
        chosen={"plant": run.name},
        ended_by_user=getattr(options, "iterations", None) is not None,
    )


def positive_numbers(options: Any, name: str) -> tuple[float, ...] | None:
    """Positive numbers of an option, if it was set."""
    text = getattr(options, name)
    return None if text is None else numbers_of(f"--{name}", text, positive=True)


def ranges_of(text: str) -> list[tuple[float, float]]:
    """Parses the ranges of --positions, such as -0.5:0.5,free."""
    ranges = []
    for part in text.split(","):
        try:
            low, high = map(float, part.strip().replace("free", "-inf:inf").split(":"))
        except ValueError:
            low = high = np.nan
        if not low < high:
            raise InputError(f"--positions has {part!r:.40}; expected LOW:HIGH or free for every joint: -1:1,free")
        ranges.append((low, high))
    return ranges


def by_iteration(
    problem: ControlProblem,
    network: ValueNetwork,
    numbers: Iteration,
    seeds: range,
    checkpoint: Callable[[int], Checkpoint],
    *,
    mesh: Mesh | None,
    disturbance: Disturbance | None,
) -> list[ValueFit]:
    """Fits value functions by fitted value iteration, one per seed; devices share the states.

    Every iteration is stored in the checkpoint of its seed; a stored seed is resumed bit for bit.
    """

    def stored(seed: int, like: Any) -> tuple[Any, list[ValueProgress]] | None:
        if (last := restore(checkpoint(seed), like)) is None:
            return None
        state, history = last
        return state, [ValueProgress(at.step, at.loss, at.validation, at.seconds, problem.discount) for at in history]

    def keep(seed: int, state: Any, history: list[ValueProgress]) -> None:
        rows = [Progress(at.step, at.loss, at.validation, math.nan, at.seconds) for at in history]
        store(checkpoint(seed), state, rows)

    with progress(len(seeds) * numbers.iterations, "iterations") as show:

        def report(seed: int, at: ValueProgress) -> None:
            show((seed - seeds.start) * numbers.iterations + at.step, f"cost and misfit {at.validation:.4g}")

        return fit_values(
            problem,
            network,
            seeds,
            numbers=numbers,
            mesh=mesh,
            disturbance=disturbance,
            report=report,
            restore=stored,
            store=keep,
        )


def by_equation(
    problem: ControlProblem,
    network: ValueNetwork,
    iterations: int,
    seeds: range,
    *,
    mesh: Mesh | None,
    disturbance: Disturbance | None,
) -> list[ValueFit]:
    """Fits one value function per seed by the Hamilton-Jacobi-Bellman residual; devices of a mesh share the samples."""
    discounts, done = discounts_down_to(problem.discount), itertools.count(1)

    def fit(seed: int) -> ValueFit:
        of_parameters, of_samples = jax.random.split(jax.random.key(seed))
        return fit_hjb(
            problem,
            network.value_and_gradient,
            network.init(of_parameters),
            of_samples,
            discounts=discounts,
            iterations=iterations,
            rounds=ROUNDS,
            mesh=mesh,
            disturbance=disturbance,
            report=lambda at: show(next(done), f"discount {at.discount:.3g}/s, residual {at.validation:.2e}"),
        )

    with progress(len(seeds) * (len(discounts) - 1 + ROUNDS), "iterations") as show:
        return [fit(seed) for seed in seeds]
