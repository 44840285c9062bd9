"""Trains policies of a soft creature from options, and writes the run folder of the best: model, metrics, gait."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.soft_bodies import write_soft_body_gif
from dln_jax.files import write_figure, write_json
from dln_jax.locomotion.gradient import Report, TrainedPolicies, settings_of, shown_walk, train
from dln_jax.locomotion.learning import LANES, Goal, Record, evaluation_steps
from dln_jax.locomotion.perturbed import numbers_of, perturbed_trials
from dln_jax.locomotion.task import LocomotionTask, Walk, beginning, creature_named, make_task
from dln_jax.locomotion.worlds import Variation
from dln_jax.runs.arguments import require_positive_if_given
from dln_jax.runs.progress import progress
from dln_jax.scale.devices import device_lines
from dln_jax.scale.mesh import shares
from dln_jax.softbody.terms.creature import TIME_STEP, ground_height
from dln_jax.training.locomotion_evaluation import judge
from dln_jax.training.locomotion_options import LocomotionOptions
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.parameter_files import save_tree
from dln_jax.zoo.run import MODEL

GOAL = 5.0
"""The effort of learning is measured up to this distance, in body lengths."""
STEPS = 400_000
FILMED = 160
"""Steps of the film."""
SHOWN = 3_000_000
"""Seed of the rough ground that is shown."""


def prepare(options: LocomotionOptions, mesh: Mesh | None) -> LocomotionTask:
    """Makes the task, and refuses settings that cannot be trained on these devices, before anything is written."""
    require_positive(seeds=options.seeds, width=options.width, episode=options.episode)
    if not (math.isfinite(options.clock_period) and options.clock_period >= 0):
        raise InputError(f"--clock-period is {options.clock_period}; expected a positive number, or 0 for no clock")
    require_positive_if_given(options, ["steps", "until", "window", "lanes"])
    require_seed(options.seed, options.seeds)
    for name in ("upright", "speed"):
        if not (math.isfinite(value := getattr(options, name)) and value >= 0):
            raise InputError(f"--{name} is {value}; expected 0 or a positive number")
    variation = Variation(options.start, options.slope, options.rough, options.push)
    sizes = {name: getattr(options, name) for name in ("episode", "clock_period", "upright", "speed")}
    task = make_task(creature_named(options.creature), variation=variation, **sizes)
    shares(mesh, settings_of(options.window, options.lanes).lanes, f"{LANES} (--lanes)")
    return task


def announce(task: LocomotionTask) -> None:
    """Prints the creature and the episode."""
    size = f"{len(task.creature.mesh.vertices)} vertices, {task.muscle_count} muscles, {task.length:.3g} m long"
    print(f"{task.creature.name}: {size}; episodes of {task.episode} steps of {TIME_STEP} s; f64")
    for line in device_lines("f64"):
        print(line)


def trained(task: LocomotionTask, options: LocomotionOptions, mesh: Mesh | None, **stored: Any) -> TrainedPolicies:
    """Trains all seeds; `stored` are the arguments of `train` on initial parameters and checkpoints."""

    def run(seeds: Sequence[int], goal: Goal, report: Report) -> TrainedPolicies:
        sizes = {"width": options.width, "window": options.window, "lanes": options.lanes}
        return train(task, seeds=seeds, goal=goal, mesh=mesh, report=report, **sizes, **stored)

    return reported(options, "gradient", options.steps or STEPS, run)


def reported(
    options: LocomotionOptions,
    method: str,
    steps: int,
    run: Callable[[Sequence[int], Goal, Report], TrainedPolicies],
) -> TrainedPolicies:
    """Trains all seeds by `run(seeds, goal, report)`, `steps` environment steps each, and shows the progress."""
    with progress(options.seeds * steps, "environment steps") as show:

        def report(seed: int, at: Record) -> None:
            done = (seed - options.seed) * steps + min(at.steps, steps)
            skipped = f", {at.succeeded:.0%} of starts succeed" + (f", {at.skipped} skipped" if at.skipped else "")
            show(done, f"{method}, seed {seed}: {at.distance:.3f} body lengths{skipped}")

        seeds = range(options.seed, options.seed + options.seeds)
        return run(seeds, Goal(steps, options.until or math.inf), report)


def write_run(
    folder: Path,
    task: LocomotionTask,
    policies: TrainedPolicies,
    settings: dict[str, Any],
    *,
    method: str = "gradient",
    figures: bool,
) -> dict[str, float]:
    """Writes model, metrics, figure and GIF (of the first steps) of the best seed; returns the metrics.

    Args:
        policies: trained policies; at least one has a finite distance.
        settings: settings of the training, stored with the model.

    Raises:
        InputError: no evaluation converged.
    """
    best, creature = policies.best, task.creature.name
    if not math.isfinite(best.distance):
        raise InputError(f"no evaluation converged; {folder} holds no model: lower the number of steps or the width")
    facts = {"name": f"locomotion-{method}", "creature": creature, "precision": "f64"}
    facts |= {"clock_period": task.clock_period, "variation": task.variation._asdict(), "settings": settings}
    save_tree(folder, MODEL, best.parameters, {"model": facts})
    start = SHOWN if task.variation.rough else None
    seen = shown_walk(task, policies.policy, best.parameters, task.episode, start)
    numbers = metrics_of(task, policies, seen)
    if any(task.variation):
        trials = perturbed_trials(task, policies.policy, best.parameters)
        verdict = judge(trials)
        numbers |= {**numbers_of(trials), "verdict": float(verdict.number)}
        print(verdict.line)
    write_json(folder / "metrics.json", numbers)
    if figures:
        records = [seed.records for seed in policies.learned]
        write_figure(folder / "learning.png", learning_figure(records, method=method))
        x = np.concatenate([task.creature.mesh.vertices[None], seen.x])[: FILMED + 1]
        write_soft_body_gif(
            folder / "gait.gif",
            task.creature.mesh,
            x,
            TIME_STEP * np.arange(len(x)),
            muscles=task.creature.muscles,
            ground=ground_line(task, x),
            actuation=np.concatenate([seen.actuation[:1], seen.actuation])[: FILMED + 1],
            title=f"{creature}, {method}: {best.distance:.2f} body lengths",
            stride=2,
            frames_per_second=0.5 / TIME_STEP,
        )
    return numbers


def ground_line(task: LocomotionTask, x: Float[np.ndarray, "T n dim"]) -> float | Float[np.ndarray, "g 2"]:
    """Ground of the walk that is shown, for figures: its line in the plane, or 0 where it is flat."""
    bumps = beginning(task, jax.random.key(SHOWN)).world.bumps
    if bumps is None or x.shape[2] != 2:
        return 0.0
    margin = 0.2 * task.length
    along = np.linspace(x[..., 0].min() - margin, x[..., 0].max() + margin, 500)
    return np.stack([along, jax.vmap(lambda at: ground_height(bumps, (at,)))(along)], axis=1)


def metrics_of(task: LocomotionTask, policies: TrainedPolicies, seen: Walk) -> dict[str, float]:
    """Finite metrics of the best seed, whose episode is `seen`, and medians over all seeds."""
    best, records = policies.best, [seed.records for seed in policies.learned]
    heights = seen.x[:, :, -1].mean(axis=1) / task.creature.mesh.vertices[:, -1].mean()
    numbers = {
        "distance_body_lengths": best.distance,
        "distance_body_lengths_median": np.median([float(seed.distance) for seed in policies.learned]),
        "environment_steps": best.records[-1].steps,
        "evaluation_steps": len(best.records) * evaluation_steps(task),
        "environment_steps_to_five_body_lengths": median_to_reach(records, GOAL, "steps"),
        "seconds_to_five_body_lengths": median_to_reach(records, GOAL, "seconds"),
        "compile_seconds": best.compile_seconds,
        "train_seconds": best.records[-1].seconds - best.compile_seconds,
        "skipped_updates": best.records[-1].skipped,
        "largest_tilt_rad": np.abs(seen.tilt).max(),
        "least_height": heights.min(),
    }
    return {name: float(value) for name, value in numbers.items() if math.isfinite(value)}


def first_reaching(records: Sequence[Record], distance: float) -> Record | None:
    """First evaluation of a seed that reached the distance; `None` if none did."""
    return next((record for record in records if record.distance >= distance), None)


def median_to_reach(seeds: Sequence[Sequence[Record]], distance: float, field: str) -> float:
    """Median over seeds of the "steps" or "seconds" to the distance; infinite if at least half never reached it."""
    reached = [first_reaching(records, distance) for records in seeds]
    return float(np.median([math.inf if record is None else getattr(record, field) for record in reached]))


def learning_figure(seeds: Sequence[Sequence[Record]], *, method: str) -> Figure:
    """Distance of every evaluation against environment steps, with a line per seed."""
    figure, [[axis]] = style.figure(height=3.4)
    for records in seeds:
        steps, distances = [record.steps for record in records], [record.distance for record in records]
        axis.plot(steps, distances, color=style.BLUE, linewidth=1.2, alpha=0.8)
    axis.axhline(GOAL, color="0.6", linewidth=0.8, linestyle="--")
    axis.set(xlabel="environment steps", ylabel="distance in one episode, body lengths")
    style.title(axis, f"{method}, {len(seeds)} seed{'s' if len(seeds) > 1 else ''}")
    return figure
