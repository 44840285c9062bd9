"""Trains policies of a soft creature from options, and writes the run folder of the best: model, metrics, gait."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jax.sharding import Mesh

from dln_jax.cli.arguments import Unstated, require_positive_if_given
from dln_jax.cli.progress import progress
from dln_jax.figures.soft_body_animations import write_soft_body_gif
from dln_jax.files import write_figure, write_json
from dln_jax.locomotion import gradient
from dln_jax.locomotion.learning import LANES, Goal, Record
from dln_jax.locomotion.methods import STEPS, Method, Report, Trained, settings_of, shown_walk, train
from dln_jax.locomotion.policy import WIDTH
from dln_jax.locomotion.progress import learning_figure, median_to_reach
from dln_jax.locomotion.task import CLOCK_PERIOD, EPISODE, UPRIGHT, Task, Walk, creature_named, make_task
from dln_jax.scale.devices import device_lines
from dln_jax.scale.mesh import shares
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.parameter_files import save_tree
from dln_jax.zoo.run import MODEL

GOAL = 1.0
"""Distance in body lengths by which the methods are compared."""


@dataclass(frozen=True)
class Options:
    """What is to be learned."""

    creature: Literal["crawler", "biped", "quadruped"] = "crawler"
    """Which body."""
    seed: int = 0
    """The first seed, 0 to 4294967295."""
    seeds: int = 1
    """How many seeds, one after the other."""
    steps: Unstated[int] = None
    """Environment steps of each seed (default: 40000 by gradient, 500000 by evolution)."""
    until: Unstated[float] = None
    """Body lengths at which a seed ends (default: no limit)."""
    upright: float = UPRIGHT
    """Weight of the posture in the reward, body lengths per episode."""
    clock_period: float = CLOCK_PERIOD
    """Steps of 0.033 s of one turn of the policy's clock."""
    episode: int = EPISODE
    """Steps of 0.033 s."""
    window: Unstated[int] = None
    """gradient: steps that gradients go back; divides the episode (default: 40, of the biped 80)."""
    width: Unstated[int] = None
    """Hidden units of the policy (default: 32)."""
    lanes: Unstated[int] = None
    """Creatures side by side, in pairs, which devices share (default: 2 by gradient, 32 by evolution)."""


def prepare(given: Options, methods: Sequence[Method], mesh: Mesh | None) -> Task:
    """Makes the task, and refuses settings that these methods and devices cannot train, before anything is written."""
    require_positive(episode=given.episode, clock_period=given.clock_period)
    require_positive_if_given(given, ["seeds", "steps", "until", "window", "width", "lanes"])
    require_seed(given.seed, given.seeds)
    for method in methods:
        settings = settings_of(method, given.creature, given.window, given.lanes)
        shares(mesh, settings.lanes, f"{LANES} (--lanes)")
        if method == "gradient":
            gradient.check(settings, given.episode)
    if not (math.isfinite(given.upright) and given.upright >= 0):
        raise InputError(f"--upright is {given.upright}; expected 0 or a positive number")
    creature = creature_named(given.creature)
    return make_task(creature, episode=given.episode, clock_period=given.clock_period, upright=given.upright)


def announce(task: Task) -> None:
    """Prints the creature and the episode."""
    size = f"{len(task.creature.mesh.vertices)} vertices, {task.muscle_count} muscles, {task.length:.3g} m long"
    print(f"{task.creature.name}: {size}; episodes of {task.episode} steps of {TIME_STEP} s; f64")
    for line in device_lines("f64"):
        print(line)


def learned(
    task: Task,
    method: Method,
    given: Options,
    mesh: Mesh | None,
    *,
    directory: Path | None = None,
    resume: bool = False,
) -> Trained:
    """Trains all seeds of one method, with checkpoints in `directory`, if any."""
    return reported(
        given,
        method,
        given.steps or STEPS[method],
        lambda seeds, goal, report: train(
            task,
            method,
            seeds=seeds,
            goal=goal,
            width=given.width or WIDTH,
            window=given.window,
            lanes=given.lanes,
            mesh=mesh,
            directory=directory,
            resume=resume,
            report=report,
        ),
    )


def reported(given: Options, method: str, steps: int, run: Callable[[Sequence[int], Goal, Report], Trained]) -> Trained:
    """Trains all seeds by `run(seeds, goal, report)`, `steps` environment steps each, and shows the progress."""
    with progress(given.seeds * steps, "environment steps") as show:

        def report(seed: int, at: Record) -> None:
            done = (seed - given.seed) * steps + min(at.steps, steps)
            skipped = f", {at.skipped} skipped" if at.skipped else ""
            show(done, f"{method}, seed {seed}: {at.distance:.3f} body lengths{skipped}")

        return run(range(given.seed, given.seed + given.seeds), Goal(steps, given.until or math.inf), report)


def write_run(
    folder: Path, task: Task, method: str, trained: Trained, given: Options, settings: Any, *, figures: bool
) -> dict[str, float]:
    """Writes model, metrics, figure and GIF (at half speed) of the best seed; returns the metrics."""
    best, creature = trained.best, task.creature.name
    if not math.isfinite(best.distance):
        raise InputError(f"no evaluation converged; {folder} holds no model: lower the number of steps or the width")
    description = {
        "name": f"locomotion-{method}",
        "creature": creature,
        "width": given.width or WIDTH,
        "precision": "f64",
        "clock_period": task.clock_period,
        "settings": settings._asdict(),
    }
    save_tree(folder, MODEL, best.parameters, {"model": description})
    seen = shown_walk(task, trained.policy, best.parameters, task.episode)
    numbers = metrics_of(task, trained, seen)
    write_json(folder / "metrics.json", numbers)
    if figures:
        records = [of.records for of in trained.learned]
        write_figure(folder / "learning.png", learning_figure(records, method=method))
        x = np.concatenate([task.creature.mesh.vertices[None], seen.x])
        write_soft_body_gif(
            folder / "gait.gif",
            task.creature.mesh,
            x,
            TIME_STEP * np.arange(len(x)),
            muscles=task.creature.muscles,
            actuation=np.concatenate([seen.actuation[:1], seen.actuation]),
            title=f"{creature}, {method}: {best.distance:.2f} body lengths",
            frames_per_second=0.5 / TIME_STEP,
        )
    return numbers


def metrics_of(task: Task, trained: Trained, seen: Walk) -> dict[str, float]:
    """Finite metrics of the best seed, whose episode is `seen`, and medians over all seeds."""
    best = trained.best
    records = [of.records for of in trained.learned]
    heights = seen.x[:, :, 1].mean(axis=1) / task.creature.mesh.vertices[:, 1].mean()
    numbers = {
        "distance_body_lengths": best.distance,
        "distance_body_lengths_median": np.median([float(of.distance) for of in trained.learned]),
        "environment_steps": best.records[-1].steps,
        "evaluation_steps": best.evaluation_steps,
        "environment_steps_to_one_body_length": median_to_reach(records, GOAL, "steps"),
        "seconds_to_one_body_length": median_to_reach(records, GOAL, "seconds"),
        "compile_seconds": best.compile_seconds,
        "train_seconds": best.records[-1].seconds - best.compile_seconds,
        "skipped_updates": best.records[-1].skipped,
        "largest_tilt_rad": np.abs(seen.tilt).max(),
        "least_height": heights.min(),
    }
    return {name: float(value) for name, value in numbers.items() if math.isfinite(value)}
