"""Swings up a desktop plant with a model learned from its motions: explores, learns, closes the loop."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control.closed_loop import ClosedLoopRun, Push, hanging_starts
from dln_jax.control.desktop_plants import (
    NAMES,
    SECONDS,
    DesktopPlant,
    Tried,
    desktop_plant,
    law_of,
    motion_of,
    try_starts,
    upright_for,
)
from dln_jax.control.energy_shaping import parts_of, passive_energy
from dln_jax.control.estimate.tuning import from_log
from dln_jax.control.plants.estimators import Estimator, estimator_of, require_estimator
from dln_jax.control.plants.recovery import recovering
from dln_jax.control.plants.scales import scales_of
from dln_jax.control.plants.ways import require_recovery
from dln_jax.control.swing_up import SwingUp
from dln_jax.control.tracking import without_friction
from dln_jax.data import schema
from dln_jax.figures.closed_loop_animations import cart_pole_drawing, rotary_pendulum_drawing, write_closed_loop_gif
from dln_jax.figures.closed_loops import MOST_SHOWN, closed_loop_traces
from dln_jax.files import write_figure, write_json
from dln_jax.learning.weak_forms import STEPS
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.runs.progress import progress
from dln_jax.sizes import require_memory
from dln_jax.training.swing_ups.any_plant import push_at_half
from dln_jax.training.swing_ups.learned import MODELS, Obtained, errors_along, obtain, recorded, test_motions
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.run import save

LEAST_SECONDS = 12.0
"""Shortest data, s: six episodes of two seconds."""
UNITS = {"cart-pole": "N", "rotary-pendulum": "N m"}
"""Unit of the control."""
FILMED = 4.0
"""Duration of the animation, s."""


class SwingUpTask(NamedTuple):
    """The checked arguments of a swing-up."""

    plant: DesktopPlant
    name: str
    model: str
    seconds: float
    """Duration of the exploration, s."""
    estimator: str
    starts: int
    seed: int
    recover: str
    push: Push | None


def asked(
    plant: str,
    model: str,
    seconds_of_data: float,
    starts: int,
    seed: int,
    estimator: str = "extended",
    recover: str = "swing-up",
    push: float = 0.0,
) -> SwingUpTask:
    """Checks the arguments of a command before anything is written; errors are one line."""
    chosen = desktop_plant(plant)
    if model not in MODELS:
        raise InputError(f"model is {model!r:.40}; choose from {', '.join(MODELS)}")
    require_settings(chosen.layout.rate, seconds_of_data, starts, seed, estimator, recover)
    pushed = push_at_half(chosen.layout, push)
    return SwingUpTask(chosen, NAMES[plant], model, seconds_of_data, estimator, starts, seed, recover, pushed)


def require_settings(rate: float, seconds_of_data: float, starts: int, seed: int, estimator: str, recover: str) -> None:
    """Raises `InputError` for a setting that no swing-up has, or more data than the memory holds at a rate in Hz."""
    require_estimator(estimator)
    require_recovery(recover)
    require_positive(starts=starts)
    require_seed(seed)
    if not LEAST_SECONDS <= seconds_of_data < np.inf:
        raise InputError(f"--seconds-of-data is {seconds_of_data}; expected at least {LEAST_SECONDS:g} s: six episodes")
    require_memory(f"{seconds_of_data:.3g} s of motion at {rate:.3g} Hz", 1000.0 * rate * seconds_of_data)


def swing_up(task: SwingUpTask, folder: Path, *, figures: bool) -> dict[str, float]:
    """Explores, learns, swings up and writes the results; returns the metrics."""
    plant = task.plant
    recording = recorded(plant, seconds=task.seconds, seed=task.seed)
    schema.save(folder / "data.npz", recording)
    print(f"{task.name}: {task.seconds:g} s of q and torques in {len(recording.label)} episodes")
    with progress(STEPS) as show:
        got = obtain(
            plant, task.model, recording, seed=task.seed,
            report=lambda at: show(min(int(at.step), STEPS), f"loss {float(at.loss):.3g}"),
        )  # fmt: skip
    store(folder, got)
    errors = errors_along(plant, got.dynamics, test_motions(plant, seed=task.seed))
    late = plant.hardware.delay if got.prepared is None else got.prepared.delay
    process = None
    if task.estimator != "differences":
        process = from_log(got.dynamics, recording, actuation=plant.layout.actuation, delay=late).process
    estimator = estimator_of(task.estimator, plant.layout, process, delay=late)
    law = law_of(plant, got.dynamics, estimator)
    if task.recover == "plans":
        estimator = by_repeated_plans(plant, got.dynamics, law, estimator)
    tried = try_starts(
        plant, got.dynamics, starts=task.starts, seed=task.seed, estimator=estimator, push=task.push
    )  # fmt: skip
    metrics = {
        "learning_seconds": got.seconds,
        "torque_nmse": errors.torque_nmse,
        "acceleration_nmse": errors.acceleration_nmse,
        "equilibrium_offset_rad": law.offset,
        **metrics_of(tried),
    }
    write_json(folder / "metrics.json", metrics)
    summarise(task, got, metrics)
    if figures:
        draw(task, got.dynamics, estimator, folder)
    return metrics


def by_repeated_plans(plant: DesktopPlant, model: Dynamics, law: SwingUp, estimator: Estimator) -> Estimator:
    """The estimator, with repeated plans and the law's regulator in place of any law."""
    layout, upright = plant.layout, upright_for(plant, model)
    settings = plant.numbers
    states = recovering(upright, layout, scales_of(upright, layout), settings, law.regulator, settings.level)
    return lambda _: estimator(states)


def metrics_of(tried: Tried) -> dict[str, float]:
    """Metrics of swing-ups from many starts."""
    outcomes = tried.outcomes
    return {
        "success_share": outcomes.share,
        "not_finite": float(outcomes.failed.sum()),
        "median_seconds": outcomes.median,
        "worst_seconds": outcomes.worst,
        "farthest": float(np.max(tried.farthest)),
        "effort_at_goal": float(np.median(tried.effort)),
    }


def store(folder: Path, got: Obtained) -> None:
    """Saves the model if it was learned."""
    if got.fitted is not None:
        save(folder, *got.fitted)


def summarise(task: SwingUpTask, got: Obtained, metrics: dict[str, float]) -> None:
    """Prints the results."""
    if got.prepared is not None:
        late = f"torques {got.prepared.delay:.3g} sample(s) late, q filtered at {got.prepared.cutoff:.0f} Hz"
        print(f"{task.model}: learned in {got.seconds:.0f} s; {late}")
    print(
        f"nMSE of motions not seen: torque {metrics['torque_nmse']:.2e}, acceleration "
        f"{metrics['acceleration_nmse']:.2e}; the model's equilibrium is "
        f"{metrics['equilibrium_offset_rad']:.2g} rad off"
    )
    failed = f", {metrics['not_finite']:.0f} not finite" if metrics["not_finite"] else ""
    pushed = "" if task.push is None else f", pushed after {task.push.seconds:g} s"
    print(
        f"{metrics['success_share']:.1%} of {task.starts} starts up after {SECONDS:g} s{pushed}{failed}: median "
        f"{metrics['median_seconds']:.2f} s, worst {metrics['worst_seconds']:.2f} s"
    )


def draw(task: SwingUpTask, model: Dynamics, estimator: Estimator, folder: Path) -> None:
    """Writes a figure of some runs, and an animation of the first."""
    plant, lab = task.plant, task.plant.hardware
    runs = some_runs(task, model, estimator, min(task.starts, MOST_SHOWN))
    unit, limits = UNITS[task.name], (lab.lower, lab.upper)
    energy = passive_energy(without_friction(model), parts_of(plant.scene.needs.actuation), np.zeros(2))
    of_pole = jax.jit(jax.vmap(jax.vmap(lambda x: energy(x[:2], x[2:]))))(jnp.asarray(runs.x))
    traces = closed_loop_traces(
        runs, plant.scene.needs.joints, names=("driven", "pole"), limits=limits, unit=unit,
        energy=np.asarray(of_pole), goal_energy=0.0,
    )  # fmt: skip
    write_figure(folder / "swing-ups.png", traces)
    sizes, t = plant.sizes, np.asarray(runs.t[0])
    if "arm_length" in sizes:
        drawing = rotary_pendulum_drawing(sizes["arm_length"], sizes["pole_length"])
    else:
        drawing = cart_pole_drawing(sizes["length"])
    last = int(np.searchsorted(t, FILMED if task.push is None else task.push.seconds + FILMED))
    write_closed_loop_gif(
        folder / "swing-up.gif", drawing, t[:last], runs.x[0, :last, :2], runs.u[0, :last, 0],
        limits=limits, unit=unit,
    )  # fmt: skip


def some_runs(task: SwingUpTask, model: Dynamics, estimator: Estimator, count: int) -> ClosedLoopRun:
    """The first `count` of the runs that were tried, [count, N]."""
    plant, seed, seconds = task.plant, task.seed, 6.0 if task.push is None else SECONDS
    run = jax.jit(jax.vmap(motion_of(plant, model, seconds=seconds, estimator=estimator, push=task.push)))
    runs = run(hanging_starts(count, seed, position=plant.position), jax.random.split(jax.random.key(seed), count))
    return jax.tree.map(np.asarray, runs)
