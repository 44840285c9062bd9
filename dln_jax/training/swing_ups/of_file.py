"""Swings up a plant given as a file, with a model learned from its motions and gains chosen by trials."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dln_jax.control.closed_loop import ClosedLoopRun, Hardware, Push
from dln_jax.control.plants.exploring import Exploration, Explored
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.plant import Plant
from dln_jax.control.plants.runs import PlantRun
from dln_jax.data import schema
from dln_jax.figures.closed_loops import MOST_SHOWN, closed_loop_traces
from dln_jax.files import write_figure, write_json
from dln_jax.training.swing_ups.any_plant import learn_to_swing_up, push_at_half, run_seconds, try_plant
from dln_jax.training.swing_ups.run import require_settings
from dln_jax.types import InputError
from dln_jax.zoo.run import save

LEAST_SHARE = 0.5
"""Smallest share of the starts that come up; with fewer the law is refused."""
ENCODER_STEP = 2 * np.pi / 4096
"""Resolution of the simulated encoders of revolute joints, rad; that of prismatic joints is 0.1 mm."""


class FileTask(NamedTuple):
    """The checked arguments of a swing-up of a file."""

    make: Callable[[int], Plant]
    """Seed of start and noise -> plant."""
    exploration: Exploration
    estimator: str
    starts: int
    seed: int
    recover: str
    push: Push | None


def asked(
    file: Path,
    actuated: Sequence[str],
    control: float | None,
    seconds_of_data: float,
    starts: int,
    seed: int,
    estimator: str = "extended",
    recover: str = "swing-up",
    push: float = 0.0,
) -> FileTask:
    """Checks the arguments of a command before anything is written; errors as for `mujoco_plant`."""
    hardware = Hardware(encoder_step=ENCODER_STEP, delay=1)

    def make(number: int) -> Plant:
        return mujoco_plant(file, actuated, control=control, hardware=hardware, seed=number)

    layout = make(0).layout
    require_settings(layout.rate, seconds_of_data, starts, seed, estimator, recover)
    slides = np.array([kind == "prismatic" for kind in layout.joints])
    hardware = hardware._replace(encoder_step=np.where(slides, 1e-4, ENCODER_STEP))
    pushed = push_at_half(layout, push)
    return FileTask(make, Exploration(seconds=seconds_of_data), estimator, starts, seed, recover, pushed)


def swing_up_file(task: FileTask, folder: Path, *, figures: bool) -> dict[str, float]:
    """Explores, learns, tunes, swings up and writes the results; returns the metrics.

    The recording is written after the exploration, and stays if a later step refuses it.
    """
    plant = task.make(task.seed)
    layout = plant.layout
    driven = [name for name, row in zip(layout.names, layout.actuation, strict=True) if row.any()]
    print(f"joints {', '.join(layout.names)}, motor at {', '.join(driven)}; goal {np.round(layout.goal, 4).tolist()}")
    recording = folder / "data.npz"

    def keep(explored: Explored) -> None:
        schema.save(recording, explored.recording)
        for reason in explored.stopped:
            print(f"stopped: {reason}")

    try:
        learned = learn_to_swing_up(
            plant, task.exploration, estimator=task.estimator, seed=task.seed, recover=task.recover, say=print,
            keep=keep,
        )  # fmt: skip
    except InputError as error:
        raise InputError(f"{error}; the recording stays in {recording}" if recording.exists() else str(error)) from None
    save(folder, *learned.fitted)
    tuned, duration = learned.tuned, run_seconds(learned.tuned)
    push = None if task.push is None else task.push._replace(seconds=duration / 2)
    trials, runs = try_plant(
        task.make, tuned, starts=task.starts, seed=task.seed + 1000, seconds=duration, push=push
    )  # fmt: skip
    seconds = trials.seconds[trials.up]
    median, worst = (float(np.median(seconds)), float(np.max(seconds))) if len(seconds) else (np.inf, np.inf)
    metrics = {
        "success_share": float(trials.up.mean()),
        "stopped": float(len(trials.stopped)),
        "median_seconds": median,
        "worst_seconds": worst,
        "tuning_trials": float(tuned.trials),
        "tuning_worked_share": tuned.worked,
        "tuning_margin": tuned.margin,
        "learning_seconds": learned.seconds,
    }
    write_json(folder / "metrics.json", metrics)
    write_json(
        folder / "law.json",
        {"way": tuned.way, **tuned.numbers, "K": np.asarray(tuned.regulator.K).tolist()},
    )
    pushed = "" if push is None else f", pushed after {push.seconds:.3g} s"
    print(
        f"{metrics['success_share']:.1%} of {task.starts} starts up after {duration:.3g} s{pushed}: median "
        f"{median:.2f} s, worst {worst:.2f} s"
    )
    if trials.stopped:
        print(f"{len(trials.stopped)} of {task.starts} were stopped; the first: {trials.stopped[0]}")
    if metrics["success_share"] < LEAST_SHARE:
        print(
            "refused: fewer than half of the starts came up, although the law swings the learned model up; record "
            "longer (--seconds-of-data), or widen the limits of the file"
        )
    complete = [one for one in runs if not one.stopped][:MOST_SHOWN]
    if figures and complete:
        write_figure(folder / "swing-ups.png", _traces(complete, plant))
    return metrics


def _traces(runs: Sequence[PlantRun], plant: Plant):
    """Figure of some runs, with measurements in place of the states."""
    layout, d = plant.layout, len(plant.layout.joints)
    y = np.stack([one.y for one in runs])
    x = np.concatenate([y, np.zeros_like(y)], axis=2)
    u = np.stack([one.u for one in runs])
    shown = ClosedLoopRun(runs[0].t, x, u[:, :-1], y)  # type: ignore[arg-type]
    return closed_loop_traces(
        shown, layout.joints, names=layout.names, goal=np.concatenate([layout.goal, np.zeros(d)]),
        limits=tuple(layout.limits.control.T),
    )  # fmt: skip
