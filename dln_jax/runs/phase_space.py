"""Hamiltonian models of a phase space: from options to a run folder with the model, its errors, speed and pictures."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from dln_jax.command_line.arguments import (
    Unstated,
    choice,
    numbers_of,
    refuse_given,
    require_positive_if_given,
    resolved,
)
from dln_jax.command_line.encoders import Checked, checked
from dln_jax.command_line.optimisers import optimiser_named
from dln_jax.command_line.options import Drawn, Limited, Resumable, Scaled, SingleCalls
from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import command_folder, needs_from_option
from dln_jax.command_line.scaled import mesh_of
from dln_jax.data.stated_needs import needs_from_json
from dln_jax.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.figures import animations
from dln_jax.figures.style import TRUTH
from dln_jax.figures.training import training_curve
from dln_jax.files import write_figure, write_json
from dln_jax.learning.engine.problem import Progress
from dln_jax.metrics.latency import one_step
from dln_jax.runs.results import OF_LOSSES, losses, one_step_metrics, print_numbers, unit_of
from dln_jax.scale.devices import device_lines
from dln_jax.studies.hamiltonian.choice import HELMHOLTZ, PAIRWISE, POLYNOMIAL, choose_model, description_of
from dln_jax.studies.hamiltonian.stages import LINEAR, gauge_of, in_velocities
from dln_jax.studies.hamiltonian.table import Seen, figure_of, measured_once, units_of
from dln_jax.studies.hamiltonian.tasks import MEASURED, REAL, TASKS, Problem, Stated, problem_of
from dln_jax.studies.hamiltonian.training import MOTIONS, RATES, Trained, check, stages_of, train
from dln_jax.studies.speed.low_latency_calls import low_latency_metrics
from dln_jax.types import InputError, require_seed
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import load, save

GIF_FRAMES = 80
CHOICE_SHARE = 0.2
"""Of a limit of time, after which no other model is tried."""
SOON = 1e-3
"""Seconds that are left where none are."""
LOSSES = {
    RATES: "rates: mean square error of (qd, pd)",
    MOTIONS: "motions: mean square error of (q, p) over its weight",
}
"""What each stage makes small."""


@dataclass(frozen=True)
class Options(Checked, Limited, Resumable, Drawn, SingleCalls, Scaled):
    """What to train on, how, and where the results go. What is not given is the task's own choice."""

    task: Annotated[str, choice(TASKS)] = "spring"
    """What moves."""
    model: Literal[
        "auto",
        "separable-hnn",
        "structured-hnn",
        "black-box-hnn",
        "pairwise-hnn",
        "polynomial-hamiltonian",
        "phase-network",
        "helmholtz-hnn",
        "structured-delan",
        "trigonometric",
        "planar-chain",
    ] = "auto"
    """What is learned; auto: what suits the task, which for measured is the smallest model whose validation error no
    other's betters. The last three are for measured."""
    data: Unstated[Path] = None
    """Trajectories as npz or CSV, for measured and real-pendulum."""
    trajectories: Unstated[int] = None
    """Generated trajectories, for the other tasks."""
    needs: Unstated[str] = None
    """measured: what the plant needs, as JSON, for example '{"joints": ["revolute", "prismatic"], "friction": true}'
    (default: what the file states, else revolute joints with a potential and friction)."""
    test: Unstated[str] = None
    """measured: labels of test trajectories, or an npz file of them (default: every sixth, or the last fifth)."""
    noise: Unstated[str] = None
    """measured: standard deviation of q, rad or m, one number or one for each coordinate; where the file has p, also
    one for each coordinate and then one for each momentum (default: estimated)."""
    field: Unstated[Literal["solenoidal", "conservative", "both"]] = None
    """helmholtz-hnn: the part that conserves an energy, the part that is a gradient, or both (default: both)."""
    order: Unstated[Literal["bodies", "axes"]] = None
    """measured, pairwise-hnn: coordinates body by body (x1, y1, x2, y2) or axis by axis (x1, x2, y1, y2) (default: that
    in which the forces on the bodies balance)."""
    coordinates: Unstated[Literal["relative", "absolute"]] = None
    """planar-chain: whether angles are those of joints, or from the vertical (default: relative)."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """auto: gauss-newton."""
    width: Unstated[int] = None
    """Hidden units per layer."""
    depth: Unstated[int] = None
    """Hidden layers."""
    activation: Unstated[Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]] = None
    """Of the hidden layers (default: tanh)."""
    degree: Unstated[int] = None
    """polynomial: degree (default: what validation asks for); trigonometric: of the basis (default: 1)."""
    steps: Unstated[int] = None
    """Iterations of gauss-newton or steps of adam, of each stage."""
    learning_rate: Unstated[float] = None
    """adam: peak of the warm-up and cosine schedule (default: 0.005)."""
    seed: int = 0
    """Of the initial parameters, the shuffling and the validation split; 0 to 4294967295."""


def prepare(given: Options) -> tuple[Problem, dict[str, Any], dict[str, Any], list[str]]:
    """The problem, the model's description, the keywords of `train`, and what is to be said of the log.

    All is checked before anything is written.
    """
    require_seed(given.seed)
    require_positive_if_given(given, ["width", "depth", "degree", "steps", "trajectories", "seconds"])
    if given.optimizer != "adam":
        refuse_given(given, ["learning_rate"], "for adam, but a task is fitted by gauss-newton: add --optimizer adam")
    if given.model not in (POLYNOMIAL, "trigonometric"):
        refuse_given(given, ["degree"], "for polynomial-hamiltonian and trigonometric")
    if given.model != "planar-chain":
        refuse_given(given, ["coordinates"], "for planar-chain")
    needs = None if given.needs is None else needs_from_option(given.needs)
    if given.task != MEASURED:
        refuse_given(given, ["test", "noise", "order"], "for measured")
    if given.model != HELMHOLTZ:
        refuse_given(given, ["field"], "for helmholtz-hnn")
    if given.model not in ("auto", PAIRWISE):
        refuse_given(given, ["order"], "for pairwise-hnn")
    noise = None if given.noise is None else numbers_of("--noise", given.noise, positive=True)
    stated = Stated(needs, given.test, noise)
    stated = stated._replace(rate=given.rate, units=given.units)
    problem = problem_of(given.task, trajectories=given.trajectories, data=given.data, stated=stated)
    said = [] if given.data is None else checked(given, problem.fitted, given.data)
    names = ("width", "depth", "activation", "degree", "coordinates", "order", "field")
    size: dict[str, Any] = {name: getattr(given, name) for name in names}
    if given.model == "auto" and given.task == MEASURED:
        networks = given.optimizer == "adam" or any(size[name] is not None for name in names[:3])
        chosen = {"networks": networks, "report": print, "seconds": CHOICE_SHARE * (given.seconds or math.inf)}
        description = choose_model(problem, **chosen, precision="f64", **size)
    else:
        description = description_of(problem, given.model, **size)
    check_suited(given, problem, description)
    name = "gauss-newton" if given.optimizer == "auto" else given.optimizer
    optimiser = optimiser_named(name, precision=description["precision"], learning_rate=given.learning_rate)
    check(problem, description, seed=given.seed)
    training = {"seed": given.seed, "optimiser": optimiser, "steps": given.steps}
    return problem, description, training | resolved(given, {"seconds": math.inf}), said


def check_suited(given: Options, problem: Problem, description: dict[str, Any]) -> None:
    """Refuses what this task or its model does not take."""
    build(description)
    if problem.name != MEASURED:
        refuse_given(given, ["needs"], f"what the task '{problem.name}' decides itself")
    if problem.name not in PROTOCOLS:
        refuse_given(given, ["trajectories"], f"for generated data, but '{problem.name}' reads its --data")
    if description["name"] in LINEAR:
        refuse_given(
            given, ["width", "depth", "activation"], f"for networks, which a {description['name']} model is not"
        )
    if description["name"] == POLYNOMIAL:
        linear = "for networks; the polynomial model's fit of rates is one least-squares problem"
        refuse_given(given, ["width", "depth", "activation"], linear)
        if MOTIONS not in stages_of(problem, description):
            refuse_given(given, ["steps", "seconds", "processes"], linear)
        if given.optimizer == "adam":
            raise InputError("the polynomial model is one least-squares problem; leave --optimizer out")


def run(given: Options, command: str) -> None:
    """Trains what the options name, evaluates it, and writes the run folder, by default runs/`command`-1, -2, ...

    Raises:
        InputError: no error is finite, or the loss stopped being so; what was good before that is kept.
    """
    began = time.perf_counter()
    problem, description, training, said = prepare(given)
    mesh = mesh_of(given)
    truth = problem.truth[0]
    with command_folder(given, command, **description) as folder:
        announce(problem, description, said)
        with stage_progress(stages_of(problem, description, training["steps"])) as report:
            kept = {"directory": folder, "resume": given.resume}
            # The limit is of all that a user waits for until there is a model: data, choice of the model, fits.
            training["seconds"] = max(training["seconds"] - (time.perf_counter() - began), SOON)
            keep = partial(save_first, folder, description)
            trained = train(problem, description, **training, **kept, report=report, keep=keep, mesh=mesh)
        if not np.isfinite(trained.result.validation):
            raise InputError(f"{trained.stopped}; {folder} holds no model")
        save(folder, description, trained.result.parameters)
        metrics, seen = measured_once(problem, trained)
        states = list(zip(truth.q[0, :256], truth.p[0, :256], strict=True))
        metrics = {**metrics, **one_step_metrics(one_step(load(folder).flow.rates, states, calls=2000))}
        if problem.noise is not None:
            metrics |= {f"q{joint}_noise": float(sd) for joint, sd in enumerate(np.ravel(problem.noise.q), start=1)}
        metrics["validation_error"] = float(trained.result.validation)
        if given.low_latency:
            metrics |= low_latency_metrics(folder, (truth.q[0], truth.p[0]), print, function="rates")
        metrics = {key: value for key, value in metrics.items() if np.isfinite(value)}
        write_json(folder / "metrics.json", metrics)
        if given.figures:
            draw(folder, problem, description["name"], seen, trained)
        print_numbers(map(line, metrics, metrics.values()), title=f"test motions of {problem.name}, f64")
        print(f"run folder: {folder}")
        if trained.diverged:
            raise InputError(f"{trained.stopped}; {folder} holds the best model before that")
        if trained.stopped:
            print(trained.stopped)


def save_first(folder: Path, description: dict[str, Any], trained: Trained) -> None:
    """Saves the model of the fit of rates, which whatever ends the fit of motions then leaves."""
    save(folder, description, trained.result.parameters)
    print(f"{folder} holds the model of the fit of rates; the fit of motions begins")


@contextmanager
def stage_progress(stages: dict[str, int]) -> Iterator[Callable[[Progress], None]]:
    """Yields `report(at)`: the stages, one after the other, each with a count of its own."""
    with ExitStack() as shown:
        current = next(iter(stages), "")
        show = shown.enter_context(progress(stages[current])) if stages else None

        def report(at: Progress) -> None:
            nonlocal current, show
            if show is None or at.stage != current:
                shown.close()
                current, show = at.stage, shown.enter_context(progress(stages[at.stage]))
            show(at.step, f"{at.stage}: {losses(at)}")

        yield report


def announce(problem: Problem, description: dict[str, Any], said: list[str]) -> None:
    """Says what is trained on what, and what was assumed."""
    data = problem.fitted
    trajectories = len(np.unique(data.trajectory))
    needs = needs_from_json(description["needs"])
    terms = " and ".join(name for name in ("gravity", "friction") if getattr(needs, name)) or "no potential"
    print(f"{problem.name}: {len(data.t)} samples of {trajectories} stretches for training and validation")
    print(f"{'-'.join(needs.joints)} with {terms}; {description['name']}, f64")
    unused = ("qdd",) if problem.noise is None else ("p", "pd")
    missing = [key for key in data.estimated if key not in ("tau", *unused)]
    if missing:
        of = "finite differences" if problem.noise is None else "local polynomials, not finite differences,"
        print(f"not in the data: {', '.join(missing)}; {of} start the fit to motions")
    print("".join(f"{line}\n" for line in said), end="")
    if in_velocities(problem, description):
        q = ", ".join(f"{each:.3g}" for each in gauge_of(problem).q)
        print(f"p = dL/dqd; without torques an energy is one up to a factor: here the mean inertia at q = ({q}) is 1")
    elif problem.name == REAL or problem.noise is not None:
        print("momenta p are taken as qd, per unit of inertia")
    for each in (*assumptions(problem, description), *device_lines("f64")):
        print(each)


def assumptions(problem: Problem, description: dict[str, Any]) -> list[str]:
    """What was read off measurements rather than stated."""
    found = []
    if problem.assumed:
        found.append("nothing states the needs: joints, potential and friction above are assumed; --needs states them")
    if problem.name == MEASURED and description["name"] == PAIRWISE:
        example = {"bodies": "x1, y1, x2, y2", "axes": "x1, x2, y1, y2"}[description["order"]]
        found.append(f"coordinates are taken as {example}, .. with {description['dimension']} axes; --order states it")
    if problem.trust is not None and problem.noise is None:
        noise = ", ".join(f"{each:.2g}" for each in np.ravel(problem.trust.weights.state))
        small = (
            "states are free of noise" if problem.trust.free_of_noise else f"motions are weighed by noise of {noise}"
        )
        found.append(f"(q, p): {small}")
    if problem.gaps and problem.tests is not None:
        found.append(f"test recordings have {problem.gaps} gap(s); predictions go on across them by time stamps")
    return found


def draw(folder: Path, problem: Problem, name: str, seen: Seen, trained: Trained) -> None:
    """Writes what there is to draw."""
    write_figure(folder / "motions.png", figure_of(problem, {name: seen}))
    truth = problem.truth[0]
    stride = max(1, len(truth.t) // GIF_FRAMES)
    motions, units = {TRUTH: truth, name: seen.motions}, units_of(problem)[:2]
    animations.write_motion_gif(folder / "motions.gif", motions, stride=stride, units=units)
    history = trained.history
    if len(history) > 1:
        best = history[-1].step - trained.result.history[-1].step + trained.result.best_step
        named = [at._replace(stage=LOSSES[at.stage]) for at in history]
        curve = training_curve(named, best_step=best, unit="loss, of each stage in its own units", **OF_LOSSES)
        write_figure(folder / "training.png", curve)


MEANINGS = {
    "published_energy_mse": ("published energy along predicted motions, mean square error", "units of that energy²"),
    "energy_mse": ("energy along predicted motions, mean square error", "J²"),
    "rollout_mse": ("(q, p) of predicted motions, mean square error", "units of q² and p²"),
    "train_loss": ("(qd, pd) at training states, mean square error", "units of qd² and pd²"),
    "test_loss": ("(qd, pd) at test states, mean square error", "units of qd² and pd²"),
    "clean_field_mse": ("(qd, pd) against the exact field, mean square error", "units of qd² and pd²"),
    "vpt": ("time for which motions are predicted right", "s"),
    "lyapunov_seconds": ("Lyapunov time of the model", "s"),
    "predicted_seconds": ("duration of the predicted motions", "s"),
    "energy_drift": ("energy error along predicted motions, over the largest kinetic energy", "1"),
    "validation_error": ("validation loss of the last stage", "see training.png"),
}
"""What a metric's name begins with, in words, and its unit; for an energy error 0 is that of the true plant."""
OF_STARTS = {"_standard_error": ": its standard error over starts", "_median": ": its median over starts"}
"""What the rest of such a name says."""


def line(metric: str, value: float) -> tuple[str, str, str]:
    """A metric in words, its value and its unit."""
    quantity = next((key for key in MEANINGS if metric.startswith(key)), "")
    meaning, unit = MEANINGS.get(quantity, (metric, unit_of(metric, {})))
    rest = metric.removeprefix(quantity or metric)
    return meaning.replace("_", " ") + OF_STARTS.get(rest, rest), f"{value:.4g}", unit
