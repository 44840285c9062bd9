"""What train_delan and train_hnn share: from a command line to a trained model of dynamics in a run folder."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from dln_jax.command_line.arguments import Unstated, choice, refuse_given, resolved
from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import needs_from_option, stored_arguments, with_stored_arguments
from dln_jax.data import schema
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split, merged, split
from dln_jax.datasets.default_data import CHARACTERS_TEST, default_data
from dln_jax.files import CONFIG, run_folder, write_json
from dln_jax.learning.basis_degrees import choose_degrees
from dln_jax.learning.dynamics_fit import Settings, automatic_optimizer, check, check_start, train, validation_errors
from dln_jax.learning.engine.runs import Progress, Stop, Training
from dln_jax.learning.linear_fit import fit_linear
from dln_jax.learning.objectives import TORQUE, Objective, objective_of
from dln_jax.precision import data_type
from dln_jax.runs.dynamics_growth import grow_to_target
from dln_jax.runs.dynamics_results import Task, best_seed, definiteness_of, evaluate, latency_states, results_table
from dln_jax.scenes.registry import SCENES, scene_named
from dln_jax.scenes.scene import Scene
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.studies.speed.low_latency_calls import low_latency_metrics
from dln_jax.types import InputError, Needs, require_positive, require_seed
from dln_jax.zoo.kinds import build, describe
from dln_jax.zoo.load import load_run, save_model

OF_NETWORKS = ("width", "depth", "activation")
OF_ADAM = ("batch", "learning_rate", "weight_decay", "patience")
DEFAULT_STEPS = {"adam": 20_000, "gauss-newton": 150}


@dataclass(frozen=True)
class Arguments:
    """What to train on, how, and where the results go."""

    model: str = "structured"
    """What is learned."""
    data: Unstated[Path] = None
    """Trajectories in the npz schema (default: the embedded characters, or random states of --scene)."""
    test: Unstated[str] = None
    """Labels of the test trajectories, comma separated (default: e,q,v of the embedded set, else every sixth)."""
    scene: Annotated[str | None, choice(SCENES, unstated=True)] = None
    """Textbook scene whose needs the data have; without --data, the scene to sample."""
    needs: Unstated[str] = None
    """What the plant needs, as JSON, for example '{"joints": ["revolute", "prismatic"], "friction": true}'
    (default: what the scene or the file states, else revolute joints with gravity)."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """adam, gauss-newton (Levenberg-Marquardt, f64: orders of magnitude more accurate with small networks), or auto:
    gauss-newton while its equations are small. The trigonometric model is a linear problem and needs none."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 8 for structured models, 16 for others; 64 for adam)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 2)."""
    activation: Unstated[Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]] = None
    """Of the hidden layers (default: tanh)."""
    degree: Unstated[int] = None
    """trigonometric: degree of the polynomials in every joint (default: for each joint what validation asks for)."""
    steps: Unstated[int] = None
    """Iterations of gauss-newton (default: 150), or steps of adam (default: 20000)."""
    seconds: Unstated[float] = None
    """Seconds of training after which to stop and keep the best so far, compilation included (default: no limit). At
    least a few iterations are done. With --resume they count anew, and another number may be given."""
    batch: Unstated[int] = None
    """adam: samples per step (default: 512)."""
    learning_rate: Unstated[float] = None
    """adam: peak of the warm-up and cosine schedule (default: 0.005)."""
    weight_decay: Unstated[float] = None
    """adam: decoupled weight decay (default: 0.00001)."""
    patience: Unstated[int] = None
    """adam: steps without a better validation error after which training stops (default: 10000)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """Floating-point type of the model and its training (default: f64; f32 for adam)."""
    target: Unstated[float] = None
    """Validation error, in (N m)² or N²: grow the structured network (width 4, 8, 16, 32; one or two layers; M and V
    from one network or two) until it is met, and keep the fastest model that meets it. --seconds counts for each."""
    seed: int = 0
    """Of the initial parameters, the shuffling and the validation split; 0 to 4294967295."""
    seeds: int = 1
    """Train so many seeds, --seed and those after it, in one program; the model kept is the best in validation."""
    out: Unstated[Path] = None
    """Folder of the run (default: runs/train_delan-1, -2, ...; runs/train_hnn-1, ...)."""
    resume: bool = False
    """Continue the run in --out with the settings it was started with."""
    figures: bool = True
    """Draw the figures."""
    low_latency: bool = True
    """Time single calls also in low-latency mode, in a process of its own (about 2 s)."""


def run_training(given: Arguments, script: str, kinds: dict[str, str]) -> None:
    """Trains, evaluates, and writes the run folder; `kinds` are the kinds of model by the script's names for them."""
    console = Console(highlight=False, soft_wrap=True)
    if given.resume:
        given = with_stored_arguments(given)
    task = prepare(given, kinds)
    with run_folder(given.out, script, resume=given.resume) as folder:
        train_into(folder, given, task, console)


def train_into(folder: Path, given: Arguments, task: Task, console: Console) -> None:
    """Trains, evaluates, and writes the files of the run."""
    write_json(folder / CONFIG, stored_arguments(given))
    announce(console, task)
    if task.kind == "trigonometric":
        task, training = fit_trigonometric(task, console, grown=given.degree is None)
    elif given.target is not None:
        task, training = grow_to_target(task, given.target, folder, console, resume=given.resume)
    else:
        training = fit(task, given, folder)
    if training.stop.reason != "not finite" and not np.isfinite(training.validation).any():
        raise InputError(f"no validation error is finite; {folder} holds no model; look for large numbers in the data")
    chosen, best = best_seed(training, given.seeds)
    save_model(folder, task.description, chosen)
    metrics = evaluate(folder, task, training, seeds=given.seeds, draw=given.figures)
    if given.low_latency:
        metrics |= low_latency_metrics(folder, latency_states(task), console.print)
    write_json(folder / "metrics.json", metrics)
    write_json(folder / CONFIG, {**stored_arguments(given), "chosen": {**task.description, **task.settings._asdict()}})
    console.print(results_table(metrics, task))
    if given.seeds > 1:
        console.print(f"the run keeps seed {given.seed + best}, the best in validation")
    console.print(f"run folder: {folder}")
    warn(console, task, training, folder)


def prepare(given: Arguments, kinds: dict[str, str]) -> Task:
    """Reads and checks everything that the arguments name, before anything is written."""
    if given.model not in kinds:
        raise InputError(f"model is '{given.model}'; expected one of {', '.join(kinds)}")
    kind = kinds[given.model]
    scene = scene_named(given.scene) if given.scene else None
    labels = tuple(given.test.split(",")) if given.test else None
    if given.data is not None:
        data, name = schema.load(given.data), str(given.data)
    else:
        scene = scene or two_link_arm()
        data, name = default_data(scene), f"default data of {scene.name}"
        if labels is None and scene.name == "two-link-arm":
            labels = CHARACTERS_TEST
    needs, origin = stated_needs(given, scene, data)
    if needs.degrees_of_freedom != data.degrees_of_freedom:
        raise InputError(
            f"{origin} has {needs.degrees_of_freedom} joints, but {name} has {data.degrees_of_freedom}; make them agree"
        )
    sets = split(data._replace(needs=needs), test=labels, seed=given.seed)
    objective = objective_of(kind, sets.train)
    description, settings, reason = model_and_settings(given, kind, sets, needs, objective)
    check(sets, settings, objective)
    if kind != "trigonometric":
        check_start(build(description), sets, settings, objective)
    return Task(name, kind, sets, scene, needs, origin, description, objective, settings, reason)


def model_and_settings(
    given: Arguments, kind: str, sets: Split, needs: Needs, objective: Objective
) -> tuple[dict[str, Any], Settings, str]:
    """Description of the model, how to train it, and why by that optimiser."""
    check_options(given, kind)
    precision = given.precision or ("f32" if given.optimizer == "adam" else "f64")
    if kind == "trigonometric":
        keywords: dict[str, Any] = {"degree": 1 if given.degree is None else given.degree}
        description = describe(kind, sets.train, needs, precision=precision, **keywords)
        build(description)
        return description, Settings(precision=precision, seed=given.seed), ""
    keywords = resolved(given, {"width": default_width(kind, given.optimizer), "depth": 2, "activation": "tanh"})
    require_positive(width=keywords["width"], depth=keywords["depth"])
    description = describe(kind, sets.train, needs, precision=precision, **keywords)
    model = build(description)
    optimizer, reason = given.optimizer, ""
    if optimizer == "auto":
        optimizer, reason = automatic_optimizer(model, sets, objective)
        precision = given.precision or ("f32" if optimizer == "adam" else "f64")
        description["precision"] = precision
    if optimizer == "gauss-newton":
        chosen = "auto chose gauss-newton" if reason else "the optimizer is gauss-newton"
        refuse_given(given, OF_ADAM, f"for adam, but {chosen}: add --optimizer adam")
    defaults = {name: Settings._field_defaults[name] for name in (*OF_ADAM, "seconds", "target")}
    numbers = resolved(given, {**defaults, "steps": DEFAULT_STEPS[optimizer]})
    return description, Settings(optimizer=optimizer, precision=precision, seed=given.seed, **numbers), reason


def check_options(given: Arguments, kind: str) -> None:
    """Refuses options that the model does not read."""
    require_positive(seeds=given.seeds)
    require_seed(given.seed, given.seeds)
    if kind == "trigonometric":
        if given.seeds > 1:
            raise InputError(f"--seeds is {given.seeds}, but one least-squares problem has no seeds; leave it out")
        names = (*OF_NETWORKS, *OF_ADAM, "steps", "seconds", "target")
        refuse_given(given, names, "for networks; the trigonometric model is one least-squares problem")
        if given.optimizer != "auto":
            raise InputError("the trigonometric model is one least-squares problem; leave --optimizer out")
        return
    refuse_given(given, ["degree"], "for the trigonometric model")
    if given.target is not None:
        if kind != "structured-delan" or given.optimizer == "adam" or given.seeds > 1:
            raise InputError("--target grows one structured network by gauss-newton; leave the other options out")
        refuse_given(given, ["width", "depth"], "what --target grows")
        require_positive(target=given.target)


def default_width(kind: str, optimizer: str) -> int:
    """Hidden units per layer: structure needs fewer, and first-order training more."""
    if optimizer == "adam":
        return 64
    return 8 if kind.startswith("structured") else 16


def stated_needs(given: Arguments, scene: Scene | None, data: Trajectories) -> tuple[Needs, str]:
    """What the plant needs, and who says so: the command line, the scene, the file, or an assumption."""
    if given.needs is not None:
        return needs_from_option(given.needs), "--needs"
    if scene is not None:
        return scene.needs, f"scene {scene.name}"
    if data.needs is not None:
        return data.needs, "the data file"
    return Needs(joints=("revolute",) * data.degrees_of_freedom), "assumed: nothing states the needs"


def announce(console: Console, task: Task) -> None:
    """Says what is trained on what, and what was assumed."""
    counts = ", ".join(f"{len(part.t)} {role}" for role, part in task.sets._asdict().items())
    joints = "-".join(task.needs.joints)
    terms = [name for name in ("gravity", "friction") if getattr(task.needs, name)] or ["no potential, no friction"]
    console.print(f"{task.name}: {counts} samples")
    console.print(f"{joints} with {' and '.join(terms)} ({task.needs_origin})")
    if task.sets.train.estimated:
        console.print(f"not in the data: {', '.join(task.sets.train.estimated)}; rates are finite differences")
    if task.kind.endswith("hnn") and task.objective is TORQUE:
        console.print("no momenta p in the data: the Hamiltonian is fitted to torques")
    if task.kind != "trigonometric":
        why = f" ({task.optimizer_reason})" if task.optimizer_reason else ""
        console.print(f"{task.kind}, {task.settings.precision}, {task.settings.optimizer}{why}")


def fit(task: Task, given: Arguments, folder: Path) -> Training:
    """Trains the task's model, one seed or several."""
    total = task.settings.steps
    seeds = None if given.seeds == 1 else tuple(range(given.seed, given.seed + given.seeds))
    with progress(total) as show:
        return train(
            build(task.description),
            task.sets,
            task.settings,
            objective=task.objective,
            seeds=seeds,
            directory=folder,
            resume=given.resume,
            report=lambda at: show(min(int(np.max(at.step)), total), shown(at)),
        )


def shown(at: Progress) -> str:
    """A line of progress; of several seeds the median."""
    return f"loss {np.median(at.loss):.2e}  validation {np.median(at.validation):.2e}"


def fit_trigonometric(task: Task, console: Console, *, grown: bool) -> tuple[Task, Training]:
    """One least-squares problem, after those by which validation chooses the degrees if it is to."""
    began = time.perf_counter()
    chosen = None
    if grown:
        chosen, trials = choose_degrees(task.needs, task.sets.train, task.sets.validation)
        tried = ", ".join(f"{_degrees(trial.candidate)}: {trial.validation:.2e}" for trial in trials)
        console.print(f"validation error by degrees of the joints: {tried}; chosen {_degrees(chosen.candidate)}")
        task = task._replace(description={**task.description, "degree": list(chosen.candidate)})
    model, dtype = build(task.description), data_type(task.settings.precision)
    fitted = chosen.outcome if chosen is not None else fit_linear(model, task.sets.train)
    parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), fitted.parameters)
    console.print(
        f"least squares: {fitted.parameter_count} parameters, rank {fitted.rank}, condition {fitted.condition:.3g}"
    )
    errors = validation_errors(model, task.sets, parameters, task.settings, task.objective)
    at = Progress(1, fitted.torque_mse, float(np.mean(errors)), float("nan"), time.perf_counter() - began)
    return task, Training(parameters, [at], Stop("finished", 1), 1, 0.0)


def _degrees(degrees: tuple[int, ...]) -> str:
    return "-".join(map(str, degrees))


def warn(console: Console, task: Task, training: Training, folder: Path) -> None:
    """Says what a user should know about how training ended, and of what came of it."""
    found = definiteness_of(load_run(folder), task, merged(task.sets))
    if found is not None and found.share_not_definite > 0:
        remedy = "another --degree, --model structured" if task.kind == "trigonometric" else "a structured model"
        console.print(
            f"the mass matrix is not positive definite at {found.share_not_definite:.1%} of the states of the data: "
            f"accelerations and rollouts are wrong or infinite there; try {remedy}, or more varied motions"
        )
    if training.stop.reason == "no improvement":
        console.print(f"stopped early, at step {training.stop.step}: no better validation error for --patience steps")
    if training.stop.reason == "time":
        console.print(f"out of time at step {training.stop.step}: kept is the best so far; --resume continues")
    if training.stop.reason == "not finite":
        remedy = (
            "lower --learning-rate or use --precision f64" if task.settings.optimizer == "adam" else "check the data"
        )
        raise InputError(
            f"the loss stopped being finite after step {training.stop.step}; {folder} holds the last good one; {remedy}"
        )
