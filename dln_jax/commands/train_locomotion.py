"""Train a policy that moves a soft creature: by gradients through the simulator, by evolution, or by PPO.

The creature starts at rest on the ground and has an episode of 80 steps of 0.033 s; policies are judged by how many
body lengths the mean x of its vertices travels before it falls, if it does. The policy sees the body and a clock, and
sets the actuation of the muscles, 0.25 to 1 of their rest length. A run folder gets config.json, metrics.json, the
model of the best seed, a figure of the learning, and a GIF of the gait.

--compare trains one creature with all methods, prints what each needs for one body length, and writes report.json and
a figure of the distance against environment steps and against wall time. ppo needs the extra [rl].
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from dln_jax.command_line.arguments import Unstated, refuse_given
from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import stored_arguments, with_stored_arguments
from dln_jax.figures.soft_body_animations import write_soft_body_gif
from dln_jax.files import CONFIG, run_folder, write_figure, write_json
from dln_jax.locomotion import comparison, gradient
from dln_jax.locomotion.learning import Goal, Record
from dln_jax.locomotion.methods import METHODS, STEPS, Method, Trained, settings_of, shown_walk, train
from dln_jax.locomotion.policy import WIDTH
from dln_jax.locomotion.ppo import require_stable_baselines3
from dln_jax.locomotion.task import CLOCK_PERIOD, EPISODE, FALLEN, UPRIGHT, Task, creature_named, make_task
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.studies.report import Row, conditions, print_report, write_report
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.load import save_model

GOAL = 1.0
"""Body lengths that the methods are compared by."""
UNUSED = {"gradient": (), "evolution": ("window",), "ppo": ("window", "width")}
"""Options that a method does not use."""
COMPARED_UNTIL = 1.2
"""Body lengths at which a seed ends in a comparison."""


@dataclass(frozen=True)
class Arguments:
    """What to train, how, and where the results go."""

    creature: Literal["crawler", "biped", "quadruped"] = "crawler"
    """Which body."""
    method: Literal["gradient", "evolution", "ppo"] = "gradient"
    """How to learn."""
    compare: bool = False
    """All methods, 3 seeds each unless --seeds says otherwise, until 1.2 body lengths or --steps."""
    seed: int = 0
    """The first seed, 0 to 4294967295."""
    seeds: Unstated[int] = None
    """How many seeds, one after the other (default: 1, with --compare 3)."""
    steps: Unstated[int] = None
    """Environment steps of each seed (default: 40000 by gradient, 500000 by evolution, 300000 by ppo)."""
    until: Unstated[float] = None
    """Body lengths at which a seed ends (default: none, with --compare 1.2)."""
    upright: float = UPRIGHT
    """Weight of the posture in the reward, body lengths per episode."""
    clock_period: float = CLOCK_PERIOD
    """Steps of 0.033 s of one turn of the policy's clock."""
    episode: int = EPISODE
    """Steps of 0.033 s."""
    window: Unstated[int] = None
    """gradient: steps that gradients go back; divides the episode (default: 40, of the biped 80)."""
    width: Unstated[int] = None
    """gradient, evolution: hidden units of the policy (default: 32)."""
    out: Unstated[Path] = None
    """Run folder (default: runs/train_locomotion-1, -2, ...)."""
    resume: bool = False
    """Continue the run in --out bit for bit (gradient and evolution)."""
    figures: bool = True
    """Draw the figures and the GIF."""


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    if given.resume:
        given = with_stored_arguments(given)
    check(given)
    task = make_task(
        creature_named(given.creature),
        episode=given.episode,
        clock_period=given.clock_period,
        upright=given.upright,
    )
    with run_folder(given.out, "train_locomotion", resume=given.resume) as folder:
        train_into(folder, given, task)


def train_into(folder: Path, given: Arguments, task: Task) -> None:
    """Trains, evaluates, and writes the files of the run."""
    write_json(folder / CONFIG, stored_arguments(given))
    console = Console(highlight=False, soft_wrap=True)
    size = f"{len(task.creature.mesh.vertices)} vertices, {task.muscle_count} muscles, {task.length:.3g} m long"
    console.print(f"{given.creature}: {size}; episodes of {task.episode} steps of {TIME_STEP} s; f64")
    if given.compare:
        compare(given, task, folder, console)
    else:
        trained = learned(given, task, given.method, folder)
        numbers = write_run(given, task, given.method, trained, folder)
        console.print(results_table(numbers, given))
    console.print(f"run folder: {folder}")


def check(given: Arguments) -> None:
    """Refuses what cannot be trained, before anything is written."""
    require_positive(episode=given.episode, clock_period=given.clock_period)
    if not given.compare:
        refuse_given(given, UNUSED[given.method], f"not used by --method {given.method}")
    for name in ("seeds", "steps", "until", "window", "width"):
        if getattr(given, name) is not None:
            require_positive(**{name: getattr(given, name)})
    require_seed(given.seed, seed_count(given))
    if given.compare or given.method == "gradient":
        gradient.check(settings_of("gradient", given.creature, given.window), given.episode)
    if not (math.isfinite(given.upright) and given.upright >= 0):
        raise InputError(f"--upright is {given.upright}; expected 0 or a positive number")
    if given.resume and (given.compare or given.method == "ppo"):
        raise InputError("--resume is for one run of gradient or evolution; train again without it")
    if given.compare or given.method == "ppo":
        require_stable_baselines3()


def seed_count(given: Arguments) -> int:
    """How many seeds train."""
    return given.seeds or (3 if given.compare else 1)


def width_of(given: Arguments) -> int:
    """Hidden units of the policy."""
    return WIDTH if given.width is None else given.width


def learned(given: Arguments, task: Task, method: Method, folder: Path) -> Trained:
    """All seeds of one method."""
    count = seed_count(given)
    steps = given.steps or STEPS[method]
    until = given.until or (COMPARED_UNTIL if given.compare else math.inf)
    seeds = range(given.seed, given.seed + count)
    with progress(count * steps, "environment steps") as show:

        def report(seed: int, at: Record) -> None:
            done = (seed - given.seed) * steps + min(at.steps, steps)
            skipped = f", {at.skipped} skipped" if at.skipped else ""
            show(done, f"{method}, seed {seed}: {at.distance:.3f} body lengths{skipped}")

        return train(
            task,
            method,
            seeds=seeds,
            goal=Goal(steps, until),
            width=width_of(given),
            window=given.window,
            directory=None if given.compare else folder,
            resume=given.resume,
            report=report,
        )


def write_run(given: Arguments, task: Task, method: Method, trained: Trained, folder: Path) -> dict[str, float]:
    """Model, metrics, figure and GIF of the best seed; gives the metrics."""
    best = trained.best
    if not math.isfinite(best.distance):
        raise InputError(f"no evaluation converged; {folder} holds no model: lower the number of steps or the width")
    description = {
        "kind": f"locomotion-{method}",
        "creature": given.creature,
        "width": width_of(given),
        "precision": "f64",
        "clock_period": given.clock_period,
        "settings": settings_of(method, given.creature, given.window)._asdict(),
    }
    save_model(folder, description, best.parameters)
    seen = shown_walk(task, trained.policy, best.parameters, task.episode)
    heights = seen.x[:, :, 1].mean(axis=1) / task.creature.mesh.vertices[:, 1].mean()
    records = [of.records for of in trained.learned]
    every = [float(of.distance) for of in trained.learned]
    numbers = {
        "distance_body_lengths": best.distance,
        "distance_body_lengths_median": float(np.median(every)),
        "environment_steps": best.records[-1].steps,
        "evaluation_steps": best.evaluation_steps,
        "environment_steps_to_one_body_length": comparison.median_to_reach(records, GOAL, "steps"),
        "seconds_to_one_body_length": comparison.median_to_reach(records, GOAL, "seconds"),
        "compile_seconds": best.compile_seconds,
        "train_seconds": best.records[-1].seconds - best.compile_seconds,
        "skipped_updates": best.records[-1].skipped,
        "largest_tilt_rad": float(np.abs(seen.tilt).max()),
        "least_height": float(heights.min()),
    }
    numbers = {name: float(value) for name, value in numbers.items() if math.isfinite(value)}
    write_json(folder / "metrics.json", numbers)
    if given.figures:
        write_figure(folder / "learning.png", comparison.learning_figure(records, method=method))
        write_gait(task, seen, folder / "gait.gif", f"{given.creature}, {method}: {best.distance:.2f} body lengths")
    return numbers


def write_gait(task: Task, seen: Any, path: Path, title: str) -> None:
    """The GIF of one episode, at half the speed of the motion."""
    x = np.concatenate([task.creature.mesh.vertices[None], seen.x])
    write_soft_body_gif(
        path,
        task.creature.mesh,
        x,
        TIME_STEP * np.arange(len(x)),
        muscles=task.creature.muscles,
        actuation=np.concatenate([seen.actuation[:1], seen.actuation]),
        title=title,
        frames_per_second=0.5 / TIME_STEP,
    )


def compare(given: Arguments, task: Task, folder: Path, console: Console) -> None:
    """All methods: the table, report.json, the figure, and the gait of each."""
    curves: dict[str, list[list[Record]]] = {}
    numbers: dict[str, dict[str, float]] = {}
    for method in METHODS:
        trained = learned(given, task, method, folder)
        (folder / method).mkdir()
        numbers[method] = write_run(given, task, method, trained, folder / method)
        curves[method] = [of.records for of in trained.learned]
    rows = comparison_rows(given, curves)
    facts = conditions(
        dtype="float64; ppo's networks float32",
        seeds=list(range(given.seed, given.seed + len(curves[METHODS[0]]))),
        settings={method: settings_of(method, given.creature, given.window)._asdict() for method in METHODS},
        goal=f"{GOAL} body lengths in one episode of {task.episode} steps from rest, before a tilt of {FALLEN} rad",
        counted="environment steps of learning; one episode after each evaluation is apart",
        seconds="wall time with compilation and evaluation, which the first seed pays and every seed is charged",
    )
    write_report(folder / "report.json", rows, facts)
    flat = {f"{method}_{name}": value for method, values in numbers.items() for name, value in values.items()}
    write_json(folder / "metrics.json", flat)
    if given.figures:
        title = f"{given.creature}: farthest so far, {len(curves[METHODS[0]])} seeds (thin) and their median (thick)"
        write_figure(folder / "comparison.png", comparison.comparison_figure(curves, distance=GOAL, title=title))
    print_report(rows, facts)
    if any(math.isinf(comparison.median_to_reach(seeds, GOAL, "steps")) for seeds in curves.values()):
        console.print("where a median was not reached, ratios take the steps that were allowed: they are lower bounds")


def comparison_rows(given: Arguments, curves: dict[str, list[list[Record]]]) -> list[Row]:
    """What each method needs for one body length, and the ratios to gradients."""
    rows, needed = [], {}
    crawls = given.creature == "crawler"
    for method, seeds in curves.items():
        case = f"{given.creature}/{method}"
        for number, records in enumerate(seeds):
            first = comparison.first_reaching(records, GOAL)
            steps = math.nan if first is None else float(first.steps)
            name = f"environment_steps_to_one_body_length_seed_{given.seed + number}"
            rows.append(Row(case, name, steps, "1"))
        median = comparison.median_to_reach(seeds, GOAL, "steps")
        seconds = comparison.median_to_reach(seeds, GOAL, "seconds")
        needed[method] = float(max(r[-1].steps for r in seeds)) if math.isinf(median) else median
        rows.append(Row(case, "environment_steps_to_one_body_length", median, "1"))
        bound = 60.0 if method == "gradient" and crawls else None
        rows.append(Row(case, "seconds_to_one_body_length", seconds, "s", bound=bound))
    for method in curves:
        if method != "gradient":
            ratio = needed[method] / needed["gradient"]
            name = "environment_steps_ratio_to_gradient"
            bound = 3.0 if crawls else None
            rows.append(Row(f"{given.creature}/{method}", name, ratio, "1", bound=bound, at_least=True))
    return rows


def results_table(metrics: dict[str, float], given: Arguments) -> Table:
    """Of numbers, whose names say their units."""
    table = Table(title=f"{given.creature}, {given.method}")
    table.add_column("quantity")
    table.add_column("value", justify="right")
    for name, value in metrics.items():
        table.add_row(name.replace("_", " "), f"{value:.4g}")
    return table
