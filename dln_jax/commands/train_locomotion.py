"""Train a policy that moves a soft creature.

Gradients flow through the simulator. The creature starts on the ground and has an episode of 400 steps of 0.033 s. A
policy is judged by how many body lengths the mean x of the vertices travels before the creature falls. The policy
observes the body in its own frame and a clock, and changes the actuation of the muscles, 0.25 to 1 of their rest
length, by at most 0.3 a step. Episodes can start perturbed, on slopes or rough ground, with pushes. The policy is then
selected by 16 walks of five episodes on the steepest slopes, and judged by 100 others of 2,000 steps. The run folder
gets config.json, metrics.json, the model of the best seed, a figure of the learning curve, and a GIF of the gait (an
MP4 too with ffmpeg). Use evaluate_locomotion to judge the policy on other ground.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dln_jax.errors import InputError
from dln_jax.options import Drawn, Resumable, Scaled, Unstated
from dln_jax.runs.arguments import require_positive_if_given

STEPS = 400_000


@dataclass(frozen=True)
class Arguments(Resumable, Drawn, Scaled):
    """Creature, task and training, and where the results go."""

    creature: Literal["crawler", "biped", "quadruped", "box-quadruped"] = "crawler"
    """Body of the creature."""
    seed: int = 0
    """First seed, 0 to 4294967295."""
    seeds: int = 1
    """Number of seeds, trained one after the other."""
    steps: Unstated[int] = None
    """Environment steps of each seed (default: 400000)."""
    until: Unstated[float] = None
    """Stop the training of a seed at this distance, in body lengths (default: no limit)."""
    upright: float = 0.05
    """Weight of the posture in the reward, body lengths per step."""
    speed: float = 0.04
    """The reward saturates at this speed, body lengths per step; 0 for no limit."""
    episode: int = 400
    """Length of an episode, in steps of 0.033 s."""
    start: float = 0.01
    """Standard deviation of the vertices' initial positions, m; of their velocities, 10 times as much in m/s."""
    slope: float = 0.0
    """Largest slope of the ground, degrees."""
    rough: float = 0.0
    """Largest height of bumps, m."""
    push: float = 0.0
    """Change of velocity by the pushes, m/s."""
    window: int = 32
    """Number of steps that gradients go back."""
    width: int = 64
    """Hidden units of the policy."""
    stored: Unstated[Path] = None
    """Folder of a run whose policy is trained further, for example on other ground (default: a new policy)."""


def main(options: Arguments, *, lanes: int = 4) -> None:
    """Trains and evaluates the policy, and writes the run folder.

    Args:
        lanes: number of creatures simulated side by side, which devices share; even.
    """
    import numpy as np

    from dln_jax.commands.locomotion import LABELS, NAME, SHOWN, UNITS, judge, learning_figure, load_policy, write_gait
    from dln_jax.locomotion.gradient import LANES, GradientSettings, make_policy, shown_walk
    from dln_jax.locomotion.learning import (
        GOAL,
        Record,
        evaluation_steps,
        median_to_reach,
        numbers_of,
        perturbed_trials,
        rank,
        train,
    )
    from dln_jax.locomotion.task import CLOCK_PERIOD, make_task
    from dln_jax.locomotion.worlds import Variation
    from dln_jax.runs.devices import mesh_of
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.progress import progress
    from dln_jax.runs.report import Report, finish, png, rows_of
    from dln_jax.scale import device_lines, shares
    from dln_jax.softbody.mesh.shapes import creature_named
    from dln_jax.softbody.terms.creature import TIME_STEP
    from dln_jax.types import require_positive
    from dln_jax.zoo.parameter_files import save_tree
    from dln_jax.zoo.run import MODEL

    mesh, settings = mesh_of(options), GradientSettings(options.width, options.window, lanes)
    require_positive(seeds=options.seeds, episode=options.episode, **settings._asdict())
    require_positive_if_given(options, ["steps", "until"])
    for name in ("upright", "speed"):
        if getattr(options, name) < 0:
            raise InputError(f"--{name} is {getattr(options, name)}; expected 0 or a positive number")
    shares(mesh, lanes, LANES)
    clock_period, initial = CLOCK_PERIOD, None
    if options.stored is not None:
        trained, _, initial, width = load_policy(options.stored)
        clock_period = trained.clock_period
        for name, own in (("creature", trained.creature.name), ("width", width)):
            if (wanted := getattr(options, name)) != own:
                raise InputError(f"the policy in {options.stored} has {name} {own}, not {wanted}; give --{name} {own}")
    task = make_task(
        creature_named(options.creature),
        episode=options.episode,
        upright=options.upright,
        speed=options.speed,
        variation=Variation(options.start, options.slope, options.rough, options.push),
        clock_period=clock_period,
    )
    with command_folder(options, "train_locomotion") as folder:
        size = f"{len(task.creature.mesh.vertices)} vertices, {task.muscle_count} muscles, {task.length:.3g} m long"
        print(f"{task.creature.name}: {size}; episodes of {task.episode} steps of {TIME_STEP} s; f64")
        for line in device_lines("f64"):
            print(line)
        steps = options.steps or STEPS
        with progress(options.seeds * steps, "environment steps") as show:

            def report(seed: int, at: Record) -> None:
                done = (seed - options.seed) * steps + min(at.steps, steps)
                skipped = f", {at.skipped} skipped" if at.skipped else ""
                succeeded = f"{at.succeeded:.0%} of starts succeed{skipped}"
                show(done, f"gradient, seed {seed}: {at.distance:.3f} body lengths, {succeeded}")

            trained = train(
                task,
                seeds=range(options.seed, options.seed + options.seeds),
                steps=steps,
                until=options.until or math.inf,
                settings=settings,
                initial=initial,
                directory=folder,
                resume=options.resume,
                mesh=mesh,
                report=report,
            )
        best = max(trained, key=lambda seed: rank(seed.selected))
        if not math.isfinite(best.distance):
            raise InputError(f"no evaluation converged, so {folder} holds no model; lower --steps or --width")
        facts = {"name": NAME, "creature": task.creature.name, "precision": "f64", "clock_period": task.clock_period}
        facts |= {"variation": task.variation._asdict(), "settings": settings._asdict()}
        save_tree(folder, MODEL, best.parameters, {"model": facts})
        start = SHOWN if task.variation.rough else None
        policy = make_policy(task, width=options.width)
        seen = shown_walk(task, policy, best.parameters, task.episode, start)
        curves = [seed.records for seed in trained]
        heights = seen.x[:, :, -1].mean(axis=1) / task.creature.mesh.vertices[:, -1].mean()
        metrics = {
            "distance_body_lengths": best.distance,
            "distance_body_lengths_median": np.median([float(seed.distance) for seed in trained]),
            "environment_steps": best.records[-1].steps,
            "evaluation_steps": len(best.records) * evaluation_steps(task),
            "environment_steps_to_five_body_lengths": median_to_reach(curves, GOAL, "steps"),
            "seconds_to_five_body_lengths": median_to_reach(curves, GOAL, "seconds"),
            "compile_seconds": best.compile_seconds,
            "train_seconds": best.records[-1].seconds - best.compile_seconds,
            "skipped_updates": best.records[-1].skipped,
            "largest_tilt_rad": np.abs(seen.tilt).max(),
            "least_height": heights.min(),
        }
        metrics, lines = {name: float(value) for name, value in metrics.items() if math.isfinite(value)}, ()
        if any(task.variation):
            trials = perturbed_trials(task, policy, best.parameters)
            verdict = judge(trials)
            metrics |= {**numbers_of(trials), "verdict": verdict.number}
            lines = (verdict.line,)
        title = f"{options.creature}, gradient"
        shown = f"{title}: {best.distance:.2f} body lengths"
        figures = {
            "learning.png": png(learning_figure, curves),
            "gait.gif": lambda path: write_gait(path, task, seen, shown),
        }
        finish(folder, options, Report(metrics, rows_of(metrics, LABELS, UNITS), title, lines=lines, figures=figures))
