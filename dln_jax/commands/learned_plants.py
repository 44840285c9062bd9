"""Swing-ups of plants from files: explores a plant, obtains its model, tunes a law, and tries it from many starts."""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

from dln_jax.control.closed_loop import ClosedLoopRun, Hardware, Outcomes, Push
from dln_jax.control.estimate.tuning import from_log
from dln_jax.control.observers import estimator_of, require_estimator
from dln_jax.control.plants import __file__ as plants_package
from dln_jax.control.plants.exploring import Exploration, Explored, explore
from dln_jax.control.plants.mujoco_plants import mujoco_plant, plant_file
from dln_jax.control.plants.planned import TrackedPlan
from dln_jax.control.plants.plant import Layout, Plant
from dln_jax.control.plants.runs import HELD, PlantRun, Trials, compiled, judged_runs, run, start_of
from dln_jax.control.plants.tuning import SwingUp, tune
from dln_jax.data import schema
from dln_jax.data.encoders.sampling import held_at_equal_steps, noise_of
from dln_jax.data.robots import read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.errors import require_memory
from dln_jax.figures.closed_loops import MOST_SHOWN, closed_loop_traces
from dln_jax.files import write_json
from dln_jax.learning.engine.problem import Progress
from dln_jax.learning.momentum import acceleration_misfit, cut_momentum_windows
from dln_jax.learning.recordings import (
    LAWS,
    STEPS,
    FittedPlant,
    PreparedRecording,
    identified_chain,
    learned,
    prepare,
)
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.trees.description import tree_to_json
from dln_jax.metrics.verdict import Verdict
from dln_jax.runs.arguments import names_listed
from dln_jax.runs.folder import command_folder
from dln_jax.runs.progress import progress
from dln_jax.runs.report import Report, finish, png, rows_of
from dln_jax.types import InputError, require_positive
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import save

file_of = functools.partial(plant_file, Path(plants_package).parent / "mjcf")
"""The file of one of the library's plants by its name, or a path."""
LEAST_SECONDS = 12.0
"""Shortest data, s: six episodes of two seconds."""
SECONDS = 10.0
"""Shortest trial, s."""
LEAST_SHARE = 0.5
"""Smallest share of starts that must come up; below it the law is refused."""
TURN, SLIDE = 2 * np.pi / 4096, 1e-4
"""Resolutions of the simulated encoders of revolute and prismatic joints, rad and m."""
CUTOFFS = (1.0, 2.0)
"""Multiples of the usual cut-off that are compared: fast motions of a short log may be too rare to raise it."""
LABELS = {
    "success_share": "share of starts that come up",
    "median_seconds": "median time to come up",
    "worst_seconds": "longest time to come up",
    "stopped": "starts stopped at a limit",
    "farthest": "largest travel of the driven joints",
    "effort_at_goal": "rms control at the goal",
    "tuning_worked_share": "share of first gains that worked",
}
"""Words for parts of metrics' names."""
BAND = 10.0
"""Factor that widens the filter's torque band, for model errors that a short log does not show."""

NETWORKS = 3
"""Number of initial networks to try: one of nine ended in a minimum 15,000 times as high as the others."""

Fit = Callable[[PreparedRecording], FittedPlant]


class Learned(NamedTuple):
    """A plant's model and law, with the recording used to find them."""

    prepared: PreparedRecording
    fitted: FittedPlant
    law: SwingUp
    seconds: float
    """Time for all steps, s."""


def swing_up(options: Any) -> None:
    """Swings up the plant that the options name.

    Raises:
        InputError: an option or the file is wrong, and nothing is written; or a step refuses the plant.
        FitRefused: fewer than half of the starts came up.
    """
    file, seconds = file_of(options.plant), options.seconds_of_data
    plant_of_file = functools.partial(mujoco_plant, file, names_listed(options.actuated), control=options.control)
    layout = plant_of_file().layout
    fit = fit_of(options.model, file, layout, options.seed)
    require_positive(starts=options.starts)
    if seconds < LEAST_SECONDS:
        raise InputError(f"--seconds-of-data is {seconds}; expected at least {LEAST_SECONDS:g} s: six episodes")
    require_memory(f"{seconds:.3g} s of motion at {layout.rate:.3g} Hz", 1000.0 * layout.rate * seconds)
    slides = np.array(layout.joints) == "prismatic"
    hardware = Hardware(encoder_step=np.where(slides, SLIDE, TURN), delay=1)
    make = functools.partial(plant_of_file, hardware=hardware)
    with command_folder(options, "swing_up") as folder:
        finish(folder, options, tried(make, fit, options, folder))


def fit_of(name: str, file: Path, layout: Layout, seed: int = 0) -> Fit:
    """The way to a model with this name, from a prepared recording.

    Args:
        name: identified: a chain of rigid bodies, linear in its parameters; delan: the best of three structured
            networks in validation; known: the rigid bodies and the friction that the file states; analytic: the same
            without friction.
        file: the plant's file, for the last two.
        layout: layout of the plant.
        seed: seed of the network's initial parameters.

    Raises:
        InputError: another name, or `read_robot` refuses the file.
    """
    needs = layout.needs
    if name == "identified":
        return lambda prepared: identified_chain(prepared, needs)
    if name == "delan":

        def train(prepared: PreparedRecording) -> FittedPlant:
            held_out, fits = cut_momentum_windows(prepared.validation), []
            with progress(NETWORKS * STEPS) as show:
                for number in range(NETWORKS):

                    def report(at: Progress, before: int = number * STEPS) -> None:
                        show(before + min(int(at.step), STEPS), f"loss {float(at.loss):.3g}")

                    fits.append(learned(prepared, needs, seed=seed + number, report=report))
            return min(fits, key=lambda one: float(jax.jit(lambda: acceleration_misfit(one.dynamics, held_out))()))

        return train
    if name not in ("known", "analytic"):
        raise InputError(f"model is {name!r:.40}; choose from identified, delan, known, analytic")
    robot = read_robot(file)
    needs = robot.tree.needs._replace(actuation=needs.actuation, joint_friction=LAWS if name == "known" else ())
    description = describe("rigid-tree", precision="f64", needs=needs, tree=tree_to_json(robot.tree))
    parameters = build(description).init(jax.random.key(0))
    if name == "known":
        parameters = parameters._replace(viscous=robot.damping, coulomb=robot.coulomb)
    return lambda _: FittedPlant(description, parameters)


def tried(make: Callable[..., Plant], fit: Fit, options: Any, folder: Path) -> Report:
    """Learns to swing up, tries the law, and reports.

    The recording is written after the exploration, and stays if a later step refuses it.
    """
    plant, recording = make(seed=options.seed), folder / "data.npz"
    layout = plant.layout
    driven = (layout.actuation != 0).any(axis=1)
    motors = ", ".join(name for name, motor in zip(layout.names, driven, strict=True) if motor)
    print(f"joints {', '.join(layout.names)}; motors at {motors}; goal {np.round(layout.goal, 4).tolist()}")

    def keep(explored: Explored) -> None:
        schema.save(recording, explored.recording)
        for reason in explored.stopped:
            print(f"stopped: {reason}")

    exploration, estimator, recover = Exploration(seconds=options.seconds_of_data), options.estimator, options.recover
    try:
        result = learn_to_swing_up(
            plant, exploration, fit, estimator=estimator, seed=options.seed, recover=recover, say=print, keep=keep
        )
    except InputError as error:
        raise InputError(f"{error}; the recording stays in {recording}" if recording.exists() else str(error)) from None
    save(folder, *result.fitted)
    law = result.law
    write_json(folder / "law.json", {"way": law.way, **numbers_of(law, layout)})
    seconds = max(SECONDS, 2 * law.seconds + HELD)  # long enough for a second attempt
    push = Push(seconds / 2, np.where(driven, 0.0, options.push)) if options.push else None
    trials, runs = try_plant(make, law, starts=options.starts, seed=options.seed + 1000, seconds=seconds, push=push)
    if trials.stopped:
        print(f"{len(trials.stopped)} of {options.starts} were stopped; the first: {trials.stopped[0]}")
    complete = [one for one in runs if not one.stopped]
    outcomes = Outcomes(trials.seconds, np.zeros(options.starts, bool))
    last = round(HELD * layout.rate)
    metrics = {
        "success_share": outcomes.share,
        "median_seconds": outcomes.median,
        "worst_seconds": outcomes.worst,
        "stopped": len(trials.stopped),
        "farthest": max((float(np.abs(one.y[:, driven]).max()) for one in complete), default=np.inf),
        "effort_at_goal": float(np.median([np.sqrt(np.mean(one.u[-last:] ** 2)) for one in complete] or np.inf)),
        "tuning_trials": law.trials,
        "tuning_worked_share": law.worked,
        "tuning_margin": law.margin,
        "learning_seconds": result.seconds,
    }
    level, remedy = "good", ""
    if outcomes.share < 1:
        level = "refused" if outcomes.share < LEAST_SHARE else "doubtful"
        remedy = "record longer (--seconds-of-data), or widen the limits of the plant"
    pushed = "" if push is None else f", pushed after {push.seconds:.3g} s"
    reason = f"{outcomes.share:.1%} of {options.starts} starts are up after {seconds:.3g} s{pushed}"
    return Report(
        metrics=metrics,
        rows=rows_of(metrics, LABELS, {"farthest": "rad or m", "effort": "N m or N"}),
        title=f"swing-ups from {options.starts} starts",
        verdict=Verdict(level, reason, remedy),
        figures={"swing-ups.png": png(measured_traces, complete[:MOST_SHOWN], layout)} if complete else {},
    )


def numbers_of(law: SwingUp, layout: Layout) -> dict[str, Any]:
    """The numbers of a law, in SI units, and the gains of its regulator at the goal."""
    settings, more = law.settings, {}
    if isinstance(settings, TrackedPlan):
        more = {"seconds": len(settings.u) / layout.rate}
    elif law.way == "energy":
        more = {**settings.gains._asdict(), "kick": settings.kick, "surplus": settings.surplus}
    numbers = {name: float(value) for name, value in {**more, "level": settings.level}.items()}
    return {**numbers, "K": np.asarray(settings.regulator.K).tolist()}


def learn_to_swing_up(
    plant: Plant,
    exploration: Exploration = Exploration(),  # noqa: B008
    fit: Fit | None = None,
    *,
    estimator: str = "extended",
    seed: int = 0,
    recover: str = "swing-up",
    say: Callable[[str], None] = lambda _: None,
    keep: Callable[[Explored], None] = lambda _: None,
) -> Learned:
    """Explores a plant, learns its model and tunes its law.

    Args:
        plant: plant to swing up; exploration guards it.
        exploration: settings; its later episodes follow laws of identified models.
        fit: prepared recording -> model of the law, such as a result of `fit_of` (default: identified).
        estimator: one of `plants.ESTIMATORS`, for the law's states.
        seed: seed of the noise and of the trials.
        recover: as for `tune`.
        say: called with a line of text after every step.
        keep: called after the exploration, to store a recording that a later step might refuse.

    Raises:
        InputError: as for `explore`, `prepare`, the fit, `from_log` and `tune`, or an unknown estimator.
    """
    require_estimator(estimator)
    began, layout = time.perf_counter(), plant.layout
    explored = explore(plant, model_of, exploration, seed=seed)
    recording = explored.recording
    say(
        f"explored: {len(recording.t) / layout.rate:.3g} s in {len(recording.label)} episodes, "
        f"{len(explored.stopped)} stopped"
    )
    keep(explored)
    recording = held_at_equal_steps(recording, layout.rate)
    prepared = prepare(recording, chain=True, cutoffs=CUTOFFS)
    fitted = identified_chain(prepared, layout.needs) if fit is None else fit(prepared)
    noise = np.asarray(noise_of(recording.q, recording.trajectory), float)
    B = layout.actuation
    process = from_log(fitted.dynamics, recording, actuation=B, delay=prepared.delay)
    band = np.asarray(process.disturbance)
    # The trials add the unexplained torque of the driven joints as motor noise.
    hardware = Hardware(encoder_noise=noise, control_noise=np.linalg.pinv(B) @ band, delay=int(prepared.delay))
    unexplained = np.max(np.atleast_1d(hardware.control_noise) / (np.ptp(layout.limits.control, axis=1) / 2))
    say(
        f"learned: delay of the controls {prepared.delay:.3g} sample(s), q filtered at {prepared.cutoff:.3g} Hz, "
        f"unexplained forces {unexplained:.1%} of the motors' limits"
    )
    wide = process._replace(disturbance=BAND * band)
    make = estimator_of(estimator, layout, wide, delay=prepared.delay)
    law = tune(fitted.dynamics, layout, hardware, estimator=make, late=prepared.delay % 1, seed=seed, recover=recover)
    say(
        f"tuned by {law.way}: {law.trials} trials, {law.worked:.1%} of the first gains worked; margin "
        f"{law.margin:.0%}, up in {law.seconds:.2f} s"
    )
    return Learned(prepared, fitted, law, time.perf_counter() - began)


def model_of(recording: Trajectories) -> Dynamics:
    """The identified model of a recording of q and commanded torques; `InputError` if it states no needs."""
    if recording.needs is None:
        raise InputError("the recording states no needs of its plant; pass one that explore has made")
    return identified_chain(prepare(recording, chain=True), recording.needs).dynamics


def try_plant(
    make: Callable[..., Plant],
    law: SwingUp,
    *,
    starts: int = 100,
    seed: int = 1000,
    seconds: float = SECONDS,
    push: Push | None = None,
) -> tuple[Trials, list[PlantRun]]:
    """Swings up plants from many starts, in step; errors as for `run`.

    Args:
        make: seed -> a simulated plant with its own start and noise.
        law: result of `tune`.
        starts: number of plants.
        seed: seed of the first plant; the others follow.
        seconds: duration of a trial, s.
        push: push on every plant.
    """
    plants = [make(seed=seed + number) for number in range(starts)]
    layout = plants[0].layout
    act = compiled(law.controller, layout)
    runs = run(plants, act, start_of(law.controller, starts), seconds=seconds, push=push)
    return judged_runs(runs, layout, seconds=seconds), runs


def measured_traces(runs: list[PlantRun], layout: Layout) -> Figure:
    """Figure of some runs, with measurements in place of the states."""
    y = np.stack([one.y for one in runs])
    u = np.stack([one.u for one in runs])
    x = np.concatenate([y, np.zeros_like(y)], axis=2)
    shown = ClosedLoopRun(runs[0].t, x, u[:, :-1], y)  # type: ignore[arg-type]
    goal = np.pad(layout.goal, (0, len(layout.goal)))
    return closed_loop_traces(
        shown, layout.joints, names=layout.names, goal=goal, limits=tuple(layout.limits.control.T)
    )
