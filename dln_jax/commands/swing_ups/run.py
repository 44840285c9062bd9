"""A run of swing_up: explores a plant, learns its model, closes the loop from many starts, and judges the law."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from dln_jax.commands.swing_ups.learning import (
    MODELS,
    errors_along,
    learn_to_swing_up,
    obtain,
    recorded,
    test_motions,
    try_plant,
)
from dln_jax.control.closed_loop import ClosedLoopRun, Hardware, Outcomes, Push, hanging_starts
from dln_jax.control.desktop_plants import (
    SECONDS,
    DesktopPlant,
    desktop_plant,
    law_of,
    motion_of,
    simulated_plant,
    try_starts,
    upright_for,
)
from dln_jax.control.energy_shaping import parts_of, passive_energy
from dln_jax.control.estimate.tuning import from_log
from dln_jax.control.plants.estimators import Estimator, estimator_of, require_estimator
from dln_jax.control.plants.exploring import Exploration, Explored
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.plant import Layout, Plant
from dln_jax.control.plants.recovery import recovering
from dln_jax.control.plants.runs import HELD, PlantRun
from dln_jax.control.plants.scales import scales_of
from dln_jax.control.plants.ways import require_recovery
from dln_jax.control.tracking import without_friction
from dln_jax.data import schema
from dln_jax.errors import require_memory
from dln_jax.figures.closed_loops import (
    MOST_SHOWN,
    cart_pole_drawing,
    closed_loop_traces,
    rotary_pendulum_drawing,
    write_closed_loop_gif,
)
from dln_jax.files import write_figure, write_json
from dln_jax.learning.recordings import STEPS
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.metrics.verdict import Verdict
from dln_jax.runs.arguments import names_listed
from dln_jax.runs.folder import command_folder
from dln_jax.runs.progress import progress
from dln_jax.runs.report import Report, finish, png, rows_of
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.run import save

FILES = (".xml", ".mjcf", ".urdf")
"""Suffixes of robot files."""
LEAST_SECONDS = 12.0
"""Shortest data, s: six episodes of two seconds."""
LEAST_SHARE = 0.5
"""Smallest share of the starts that come up; with fewer the law is refused."""
TURN, SLIDE = 2 * np.pi / 4096, 1e-4
"""Resolutions of the simulated encoders of a file's revolute and prismatic joints, rad and m."""
FILMED, SHOWN = 4.0, 6.0
"""Durations of the animation and of the runs in the figure, s; a push prolongs both."""


def swing_up(options: Any) -> None:
    """Swings up the plant that the options name.

    Raises:
        InputError: an option or the file is wrong, and nothing is written; or a step refuses the plant.
        FitRefused: fewer than half of the starts came up.
    """
    file, desk = Path(options.plant), None
    if file.suffix.lower() in FILES or file.is_file():
        if options.model not in (None, "identified"):
            raise InputError(f"--model is {options.model!r:.40}; the model of a file is identified")
        plant_of_file = functools.partial(mujoco_plant, file, names_listed(options.actuated), control=options.control)
        slides = np.array(plant_of_file().layout.joints) == "prismatic"
        hardware = Hardware(encoder_step=np.where(slides, SLIDE, TURN), delay=1)
        make = functools.partial(plant_of_file, hardware=hardware)
    else:
        if options.actuated is not None or options.control is not None:
            raise InputError(f"--actuated and --control belong to a file; --plant is {options.plant!r:.40}")
        desk = desktop_plant(options.plant)
        if options.model not in (None, *MODELS):
            raise InputError(f"model is {options.model!r:.40}; choose from {', '.join(MODELS)}")
        make = functools.partial(simulated_plant, desk)
    layout, seconds = make(seed=0).layout, options.seconds_of_data
    require_estimator(options.estimator)
    require_recovery(options.recover)
    require_positive(starts=options.starts)
    require_seed(options.seed)
    if not LEAST_SECONDS <= seconds < np.inf:
        raise InputError(f"--seconds-of-data is {seconds}; expected at least {LEAST_SECONDS:g} s: six episodes")
    require_memory(f"{seconds:.3g} s of motion at {layout.rate:.3g} Hz", 1000.0 * layout.rate * seconds)
    with command_folder(options, "swing_up") as folder:
        report = of_file(make, options, folder) if desk is None else of_desktop(desk, layout, options, folder)
        finish(folder, options, report)


def of_file(make: Callable[..., Plant], options: Any, folder: Path) -> Report:
    """Explores, learns, tunes and tries the plant of a file.

    The recording is written after the exploration, and stays if a later step refuses it.
    """
    plant, recording = make(seed=options.seed), folder / "data.npz"
    layout = plant.layout
    driven = [name for name, row in zip(layout.names, layout.actuation, strict=True) if row.any()]
    print(f"joints {', '.join(layout.names)}, motor at {', '.join(driven)}; goal {np.round(layout.goal, 4).tolist()}")

    def keep(explored: Explored) -> None:
        schema.save(recording, explored.recording)
        for reason in explored.stopped:
            print(f"stopped: {reason}")

    try:
        learned = learn_to_swing_up(
            plant,
            Exploration(seconds=options.seconds_of_data),
            estimator=options.estimator,
            seed=options.seed,
            recover=options.recover,
            say=print,
            keep=keep,
        )
    except InputError as error:
        raise InputError(f"{error}; the recording stays in {recording}" if recording.exists() else str(error)) from None
    save(folder, *learned.fitted)
    tuned = learned.tuned
    seconds = max(SECONDS, 2 * tuned.seconds + HELD)  # long enough for a second attempt
    write_json(folder / "law.json", {"way": tuned.way, **tuned.numbers, "K": np.asarray(tuned.regulator.K).tolist()})
    push = push_at_half(layout, options.push, seconds)
    trials, runs = try_plant(make, tuned, starts=options.starts, seed=options.seed + 1000, seconds=seconds, push=push)
    metrics = {
        "stopped": float(len(trials.stopped)),
        "tuning_trials": float(tuned.trials),
        "tuning_worked_share": tuned.worked,
        "tuning_margin": tuned.margin,
        "learning_seconds": learned.seconds,
    }
    if trials.stopped:
        print(f"{len(trials.stopped)} of {options.starts} were stopped; the first: {trials.stopped[0]}")
    complete = [run for run in runs if not run.stopped][:MOST_SHOWN]
    figures = {"swing-ups.png": png(measured_traces, complete, layout)} if complete else {}
    outcomes = Outcomes(trials.seconds, np.zeros(len(trials.seconds), bool))
    return report_of(outcomes, seconds, push, metrics, figures)


def measured_traces(runs: list[PlantRun], layout: Layout) -> Figure:
    """Figure of some runs, with measurements in place of the states."""
    y = np.stack([run.y for run in runs])
    u = np.stack([run.u for run in runs])
    x = np.concatenate([y, np.zeros_like(y)], axis=2)
    shown = ClosedLoopRun(runs[0].t, x, u[:, :-1], y)  # type: ignore[arg-type]
    goal = np.pad(layout.goal, (0, len(layout.goal)))
    return closed_loop_traces(
        shown, layout.joints, names=layout.names, goal=goal, limits=tuple(layout.limits.control.T)
    )


def of_desktop(desk: DesktopPlant, layout: Layout, options: Any, folder: Path) -> Report:
    """Explores a desktop plant, obtains a model, and tries its law of given gains."""
    seed, B = options.seed, layout.actuation
    recording = recorded(desk, seconds=options.seconds_of_data, seed=seed)
    schema.save(folder / "data.npz", recording)
    print(f"{options.plant}: {options.seconds_of_data:g} s of q and torques in {len(recording.label)} episodes")
    with progress(STEPS) as show:
        obtained = obtain(
            desk,
            options.model or "delan",
            recording,
            seed=seed,
            report=lambda at: show(min(int(at.step), STEPS), f"loss {float(at.loss):.3g}"),
        )
    model, late = obtained.dynamics, float(desk.hardware.delay)
    if obtained.prepared is not None and obtained.fitted is not None:
        late = obtained.prepared.delay
        save(folder, *obtained.fitted)
        print(f"learned: controls {late:.3g} sample(s) late, q filtered at {obtained.prepared.cutoff:.3g} Hz")
    torque, acceleration = errors_along(desk, model, test_motions(desk, seed=seed))
    filtered = options.estimator != "differences"
    process = from_log(model, recording, actuation=B, delay=late) if filtered else None
    measured = estimator = estimator_of(options.estimator, layout, process, delay=late)
    law = law_of(desk, model, measured)
    if options.recover == "plans":
        upright = upright_for(desk, model)
        numbers = desk.numbers
        plans = recovering(upright, layout, scales_of(upright, layout), numbers, law.regulator, numbers.level)
        estimator = lambda _: measured(plans)  # noqa: E731
    push = push_at_half(layout, options.push, SECONDS)
    tried = try_starts(desk, model, starts=options.starts, seed=seed, estimator=estimator, push=push)
    metrics = {
        "learning_seconds": obtained.seconds,
        "torque_nmse": torque,
        "acceleration_nmse": acceleration,
        "equilibrium_offset_rad": law.offset,
        "not_finite": float(tried.outcomes.failed.sum()),
        "farthest": float(np.max(tried.farthest)),
        "effort_at_goal": float(np.median(tried.effort)),
    }
    figures = {"swing-ups.png": functools.partial(draw, desk, model, estimator, push, options)}
    return report_of(tried.outcomes, SECONDS, push, metrics, figures)


def draw(
    desk: DesktopPlant, model: Dynamics, estimator: Estimator, push: Push | None, options: Any, path: Path
) -> None:
    """Writes a figure of the first runs that were tried and, beside it, an animation of the first."""
    count, hardware = min(options.starts, MOST_SHOWN), desk.hardware
    run = motion_of(desk, model, seconds=SHOWN if push is None else SECONDS, estimator=estimator, push=push)
    starts = hanging_starts(count, options.seed, position=desk.position)
    runs = jax.jit(jax.vmap(run))(starts, jax.random.split(jax.random.key(options.seed), count))
    t, x, u = (np.asarray(array) for array in (runs.t[0], runs.x[0], runs.u[0]))
    needs, sizes = desk.scene.needs, desk.sizes
    energy = passive_energy(without_friction(model), parts_of(needs.actuation), np.zeros(2))
    of_pole = jax.jit(jax.vmap(jax.vmap(lambda x: energy(x[:2], x[2:]))))(runs.x)
    drawing, unit = cart_pole_drawing(sizes.get("length", 0.0)), "N"
    if "arm_length" in sizes:
        drawing, unit = rotary_pendulum_drawing(sizes["arm_length"], sizes["pole_length"]), "N m"
    shared: Any = {"limits": (hardware.lower, hardware.upper), "unit": unit}
    names = "driven", "pole"
    figure = closed_loop_traces(runs, needs.joints, names=names, energy=of_pole, goal_energy=0.0, **shared)
    write_figure(path, figure)
    last = int(np.searchsorted(t, FILMED if push is None else push.seconds + FILMED))
    film = path.with_name("swing-up.gif")
    write_closed_loop_gif(film, drawing, t[:last], x[:last, :2], u[:last, 0], **shared)


def push_at_half(layout: Layout, rate: float, seconds: float) -> Push | None:
    """A push on the passive joints in the middle of a run, rad/s or m/s; `None` for zero."""
    return Push(seconds / 2, np.where((layout.actuation != 0).any(axis=1), 0.0, rate)) if rate else None


def report_of(
    outcomes: Outcomes,
    seconds: float,
    push: Push | None,
    metrics: dict[str, float],
    figures: Mapping[str, Callable[[Path], None]],
) -> Report:
    """Numbers of swing-ups from many starts, and the verdict on the law."""
    times = {"median_seconds": outcomes.median, "worst_seconds": outcomes.worst}
    metrics = {"success_share": outcomes.share, **times, **metrics}
    starts, pushed = len(outcomes.seconds), "" if push is None else f", pushed after {push.seconds:.3g} s"
    level, remedy = "good", ""
    if outcomes.share < 1:
        level = "refused" if outcomes.share < LEAST_SHARE else "doubtful"
        remedy = "record longer (--seconds-of-data), or widen the limits of the plant"
    return Report(
        metrics=metrics,
        rows=rows_of(metrics),
        title=f"swing-ups from {starts} starts",
        verdict=Verdict(level, f"{outcomes.share:.1%} of {starts} starts up after {seconds:.3g} s{pushed}", remedy),
        figures=figures,
    )
