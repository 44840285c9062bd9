"""Train a deep differential network, or an ensemble, on a function: value, gradient and Hessian from one pass.

Functions: sin (1-D), cos_sin (cos x1 sin x2), both with the published noise, or an npz file of one's own with x [N, n],
y [N, m] and optional dy, d2y. A run folder gets config.json, metrics.json, model.safetensors and model.json (load them
with dln_jax.zoo.load_function), and figures. --table trains all activations, losses and optimisers on both
functions, prints the published table beside the results, and writes report.json.
"""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from dln_jax.command_line.arguments import Unstated, choice, refuse_given, resolved
from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import stored_arguments, with_stored_arguments
from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.figures import functions as figures
from dln_jax.figures.dynamics import training_curve
from dln_jax.files import CONFIG, run_folder, write_figure, write_json
from dln_jax.learning.engine.runs import Checkpoint, Progress, Training, fingerprint, one_after_the_other
from dln_jax.learning.growth import Trial
from dln_jax.learning.regression import LOSSES, WIDTHS, Settings, check, grow_width, steps_of, train
from dln_jax.learning.standardisation import Units, layers_in_own_units, own_units, standard_units, to_units
from dln_jax.metrics.functions import errors, predictions, typical_spread
from dln_jax.metrics.latency import one_step
from dln_jax.nn.activations import ALL, activation
from dln_jax.studies.differential_networks import table as diffnet_table
from dln_jax.types import InputError, require_seed
from dln_jax.zoo.load_function import load_function, save_function

NAMED = {
    "sin": (functions.sine, functions.sine_grid),
    "cos_sin": (functions.cosine_sine, functions.cosine_sine_grid),
}
"""Generator and test grid of each named function."""
RELU = (
    "a ReLU network is piecewise linear: its Hessian is zero almost everywhere, so its hessian_mse is that of "
    "predicting zero and a Hessian in the loss teaches it nothing; use softplus, tanh, cos or another smooth activation"
)
OF_NAMED = {"samples": 25_600, "noise": 1e-3}
OF_ADAM = ("epochs", "batch", "learning_rate", "weight_decay")
OF_NEWTON = ("steps", "coarse_steps")
TABLE_DEFAULTS = {"samples": OF_NAMED["samples"], "steps": 40, "coarse_steps": 200, "epochs": 500}
OF_TABLE = (*TABLE_DEFAULTS, "seed", "out", "resume", "figures", "table")
SHARE_OF_DATA = 0.75
"""Width of the training box over that of the shown one, for ensembles."""


@dataclass(frozen=True)
class Arguments:
    """What to train on, how, and where the results go."""

    function: Annotated[str, choice((*NAMED, "FILE.npz"))] = "sin"
    """sin, cos_sin, or the path of an npz file with x [N, n], y [N, m], optional dy [N, m, n] and d2y [N, m, n, n]."""
    loss: Annotated[str, choice(LOSSES)] = "type1"
    """type1 fits value and gradient, type2 the value only."""
    activation: Annotated[str, choice(ALL)] = "cos"
    """Of the hidden layers."""
    derivative: Literal[1, 2] = 1
    """2 adds the Hessian to the loss."""
    ensemble: int = 1
    """Networks; with more than one, sin and cos_sin are trained on ±0.75 π and shown on ±π."""
    optimizer: Literal["adam", "gauss-newton"] = "gauss-newton"
    """Levenberg-Marquardt on all samples (f64) for small networks, or Adam, the published recipe, for wide ones."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 128 for adam; for gauss-newton grown, 2, 4, 8, 16, until the validation error
    no longer falls)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 1 for one input, else 2)."""
    steps: Unstated[int] = None
    """Gauss-Newton: iterations on all samples at most, per network (default: 40)."""
    coarse_steps: Unstated[int] = None
    """Gauss-Newton: iterations before those, at most, on 2,048 of the samples where there are twice as many (default:
    200; 0 for none)."""
    epochs: Unstated[int] = None
    """Adam: passes over the data (default: 500)."""
    batch: Unstated[int] = None
    """Adam: samples per step (default: 512)."""
    learning_rate: Unstated[float] = None
    """Adam: constant rate (default: 0.001)."""
    weight_decay: Unstated[float] = None
    """Adam: decoupled weight decay (default: 0.000001)."""
    samples: Unstated[int] = None
    """Samples of sin and cos_sin (default: 25600)."""
    noise: Unstated[float] = None
    """Their standard deviation of the noise on x, f, gradient and Hessian (default: 0.001)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """Floating-point type (default: f64 for gauss-newton, which needs it, f32 for adam)."""
    seed: int = 0
    """Of the data, the validation split, the initial parameters and the shuffling; 0 to 4294967295."""
    out: Unstated[Path] = None
    """Folder of the run (default: runs/train_diffnet-1, -2, ...)."""
    resume: bool = False
    """Continue the run, or the table, in --out with the settings it was started with."""
    figures: bool = True
    """Draw the figures."""
    table: bool = False
    """Train everything that the published table has, by both optimisers; of the other arguments it takes --samples,
    --steps, --coarse-steps, --epochs, --seed, --out and --resume."""


class Task(NamedTuple):
    """What the arguments come to."""

    name: str
    sets: SampleSplit
    test: FunctionSamples
    shown: FunctionSamples
    """What the figures show: the test, or a wider grid for an ensemble."""
    bound: float | None
    """Half the width of the box of the training data, where the shown grid is wider."""
    units: Units
    settings: Settings
    grown: bool
    """Whether the width is chosen by validation."""


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    console = Console(highlight=False, soft_wrap=True)
    if given.resume:
        given = with_stored_arguments(given)
    require_seed(given.seed)
    if given.table:
        check_table(given)
        given = dataclasses.replace(given, **resolved(given, TABLE_DEFAULTS))
        diffnet_table.write_table(given)
        return
    task = prepare(given)
    with run_folder(given.out, "train_diffnet", resume=given.resume) as folder:
        train_into(folder, given, task, console)


def train_into(folder: Path, given: Arguments, task: Task, console: Console) -> None:
    """Trains, evaluates, and writes the files of the run."""
    write_json(folder / CONFIG, stored_arguments(given))
    announce(console, task)
    settings, training, trials = fit(task, folder, resume=given.resume, console=console)
    task = task._replace(settings=settings)
    write_json(folder / CONFIG, {**stored_arguments(given), "chosen": {**settings._asdict(), **of_named(given)}})
    if training.stop.reason == "not finite":
        console.print("the loss stopped being finite; the run keeps the best parameters before that")
    layers = layers_in_own_units(training.parameters, task.units)
    save_function(folder, layers, activation=task.settings.activation, precision=task.settings.precision)
    metrics = evaluate(folder, task, training)
    if given.figures:
        draw_figures(folder, task, training, trials)
    write_json(folder / "metrics.json", metrics)
    console.print(results_table(metrics, task))
    if task.settings.activation == "relu":
        console.print(RELU)
    console.print(f"run folder: {folder}")


def fit(task: Task, folder: Path, *, resume: bool, console: Console) -> tuple[Settings, Training, list[Trial]]:
    """Trains at the width asked for, or at growing ones: the settings chosen, their training, and all trials."""
    standard = SampleSplit(*(to_units(part, task.units) for part in task.sets))
    identity = {"data": fingerprint(array for data in standard for array in data)}

    def train_one(settings: Settings) -> Training:
        total = steps_of(task.sets, settings)
        name = f"checkpoint_width_{settings.width}"
        checkpoint = Checkpoint(folder, {"settings": settings._asdict(), **identity}, resume, name)
        with progress(total) as show:
            return train(
                standard,
                settings,
                checkpoint=checkpoint,
                report=lambda at: show(min(at.step, total), shown(settings, at)),
            )

    if not task.grown:
        return task.settings, train_one(task.settings), []
    chosen, trials = grow_width(standard, task.settings, train_one, widths=WIDTHS)
    tried = ", ".join(f"{trial.candidate.width}: {trial.validation:.3e}" for trial in trials)
    console.print(f"validation loss by width: {tried}; chosen {chosen.candidate.width}")
    return chosen.candidate, chosen.outcome, trials


def check_table(given: Arguments) -> None:
    """Refuses options that --table does not read."""
    for field in dataclasses.fields(given):
        if field.name not in OF_TABLE and getattr(given, field.name) != field.default:
            name = field.name.replace("_", "-")
            raise InputError(f"--{name} is not for --table, which trains all that was published; leave it out")


def shown(settings: Settings, at: Progress) -> str:
    """A line of progress, with what is trained on what."""
    stage = f", {at.stage}" if at.stage else ""
    return f"width {settings.width}{stage}: loss {at.loss:.3e}  validation {at.validation:.3e}"


def prepare(given: Arguments) -> Task:
    """Reads and checks everything that the arguments name, before anything is written."""
    settings, function, several = settings_from(given), given.function, given.ensemble > 1
    if function in NAMED:
        generate, grid = NAMED[function]
        bound = np.pi * (SHARE_OF_DATA if several else 1)
        data = generate(**of_named(given), bound=bound, seed=given.seed)
        test, shown = grid(bound=bound), grid()
        bound, units = (bound, own_units(data)) if several else (None, own_units(data))
    else:
        if not function.endswith(".npz"):
            raise InputError(f"function '{function}' is unknown; expected sin, cos_sin or an npz file's path")
        refuse_given(given, OF_NAMED, "for sin and cos_sin, not for a file")
        everything = functions.load(function)
        if len(everything.x) < 3:
            raise InputError(f"{function}: {len(everything.x)} samples; training, validation and test need 3")
        data, test = functions.split(everything, seed=given.seed)
        shown, bound, units = test, None, standard_units(data)
    depth = given.depth if given.depth is not None else min(data.inputs, 2)
    settings = settings._replace(depth=depth)
    check(to_units(data, units), settings)
    grown = given.width is None and settings.optimizer == "gauss-newton"
    return Task(function, functions.split(data, seed=given.seed), test, shown, bound, units, settings, grown)


def of_named(given: Arguments) -> dict[str, Any]:
    """How the data of a named function are drawn; nothing for a file."""
    return resolved(given, OF_NAMED) if given.function in NAMED else {}


def settings_from(given: Arguments) -> Settings:
    """The settings that the arguments name, with the defaults of the optimiser; the depth is up to the data."""
    newton = given.optimizer == "gauss-newton"
    if newton:
        refuse_given(given, OF_ADAM, "for adam: add --optimizer adam")
    else:
        refuse_given(given, OF_NEWTON, "for gauss-newton")
    own = {"width": WIDTHS[0] if newton else 128, "precision": "f64" if newton else "f32", "depth": 1}
    defaults = {key: value for key, value in Settings._field_defaults.items() if hasattr(given, key)}
    return Settings(**resolved(given, defaults | own), members=given.ensemble)


def announce(console: Console, task: Task) -> None:
    """Says what is trained on what."""
    data, settings = task.sets.train, task.settings
    counts = f"{len(data.x)} training, {len(task.sets.validation.x)} validation, {len(task.test.x)} test samples"
    terms = ["value", *(["gradient"] if settings.loss == "type1" else []), *(["Hessian"] * (settings.derivative == 2))]
    width = "grown" if task.grown else str(settings.width)
    layers = " x ".join([str(data.inputs), *[width] * settings.depth, str(data.outputs)])
    networks = f"{settings.members} networks" if settings.members > 1 else "network"
    console.print(f"{task.name}: {counts}, {data.inputs} inputs, {data.outputs} outputs")
    console.print(
        f"{networks} {layers}, {settings.activation}; {settings.loss}: {', '.join(terms)}; "
        f"{settings.optimizer}, {settings.precision}"
    )
    if settings.activation == "relu" and settings.derivative == 2:
        console.print(RELU)


def evaluate(folder: Path, task: Task, training: Training) -> dict[str, float]:
    """Loads the stored model as a user would, and measures it on the test samples."""
    loaded = load_function(folder)
    function = activation(task.settings.activation)
    tested = predictions(loaded.layers, task.test.x, activation=function)
    metrics = errors(tested.mean, task.test)
    spread = predictions(loaded.layers, task.shown.x, activation=function).spread if task.bound is not None else None
    if task.bound is not None and spread is not None:
        inside = np.all(abs(task.shown.x) <= task.bound, axis=1)
        metrics["spread_inside"] = typical_spread(spread, inside)
        metrics["spread_outside"] = typical_spread(spread, ~inside)
    latency = one_step(loaded.derivatives, [(x,) for x in task.test.x[:512]], calls=1000)
    return {
        **metrics,
        "validation_loss": float(training.validation),
        "width": task.settings.width,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(loaded.layers)),
        "steps": training.stop.step,
        "best_step": training.best_step,
        "compile_seconds": training.compile_seconds,
        "train_seconds": training.train_seconds,
        "one_step_p50_us": latency.p50_us,
        "one_step_p99_us": latency.p99_us,
    }


def draw_figures(folder: Path, task: Task, training: Training, trials: list[Trial]) -> None:
    """Writes what fits the number of inputs."""
    inputs, loaded = task.test.inputs, load_function(folder)
    shown = predictions(loaded.layers, task.shown.x, activation=activation(task.settings.activation))
    drawn = {"training": training_figure(training, trials)} if training.history else {}
    if inputs == 1:
        drawn["curves"] = figures.curves(task.shown, shown.mean)
    elif task.name in NAMED:
        drawn["heat_maps"] = figures.heat_maps(task.shown, shown.mean)
        drawn["surfaces"] = figures.surfaces(task.shown, shown.mean)
    else:
        drawn["parity"] = figures.parity(*(to_units(part, task.units) for part in (task.shown, shown.mean)))
    if task.bound is not None and shown.spread is not None:
        drawn["ensemble"] = figures.ensemble(task.shown, shown.mean, shown.spread, bound=task.bound)
    for name, figure in drawn.items():
        write_figure(folder / f"{name}.png", figure)


def training_figure(training: Training, trials: list[Trial]) -> Figure:
    """The losses of every width that was tried, one after the other."""
    words = {"error": "loss", "loss": "training loss", "unit": "loss, in the units of the fit"}
    before, histories = 0, []
    for trial in trials:
        if trial.outcome is training:
            before = sum(history[-1].step for history in histories)
        name = f"width {trial.candidate.width}"
        histories.append([at._replace(stage=name) for at in trial.outcome.history])
    joined = one_after_the_other(histories) if trials else training.history
    return training_curve(joined, best_step=before + training.best_step, **words)


UNITS = {
    "value_mse": "y²",
    "gradient_mse": "(y / x)²",
    "hessian_mse": "(y / x²)²",
    "spread_inside": "y",
    "spread_outside": "y",
    "validation_loss": "units of the fit",
}
"""Of metrics, in those of the data."""


def results_table(metrics: dict[str, float], task: Task) -> Table:
    """The figures that a user wants to see, with units."""
    table = Table("quantity", "value", "unit", title=f"test on {task.name}, {task.settings.precision}")
    table.columns[1].justify = "right"
    for key, value in metrics.items():
        unit = "s" if key.endswith("_seconds") else "µs" if key.endswith("_us") else UNITS.get(key, "")
        small = f"{value:.2e}" if re.search("_mse|_loss|spread", key) else f"{value:,.1f}"
        table.add_row(key.replace("_", " "), f"{value:,}" if isinstance(value, int) else small, unit)
    return table
