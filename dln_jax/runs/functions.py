"""Training a differential network, or an ensemble, into a run folder: the model, its errors, its speed and pictures."""

import re
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from dln_jax.command_line.optimisers import name_of
from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import CHOSEN, stored_arguments
from dln_jax.data.functions import SampleSplit
from dln_jax.figures import functions as drawing
from dln_jax.figures.training import training_curve
from dln_jax.files import write_figure, write_json
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import Progress, Training, one_after_the_other
from dln_jax.learning.functions import WIDTHS, Network, grow_width, train
from dln_jax.learning.growth import Trial
from dln_jax.learning.standardisation import layers_in_own_units, to_units
from dln_jax.metrics.functions import errors, predictions, typical_spread
from dln_jax.metrics.latency import one_step
from dln_jax.nn.activations import activation
from dln_jax.nn.differential_mlp import Layers
from dln_jax.runs.function_task import NAMED, Options, Task, of_named
from dln_jax.zoo.descriptions import Description, describe
from dln_jax.zoo.run import load, save
from dln_jax.zoo.run_folder import CONFIG

RELU = (
    "a ReLU network is piecewise linear: its Hessian is zero almost everywhere, so its hessian_mse is that of "
    "predicting zero and a Hessian in the loss teaches it nothing; use softplus, tanh, cos or another smooth activation"
)


def train_into(folder: Path, task: Task, given: Options, *, resume: bool = False, figures: bool = True) -> None:
    """Trains a task, `prepare(given)`, evaluates it, and writes the files of the run into an existing folder."""
    console = Console(highlight=False, soft_wrap=True)
    write_json(folder / CONFIG, stored_arguments(given))
    announce(console, task)
    network, training, trials = fit(task, folder, resume=resume, console=console)
    task = task._replace(network=network)
    optimiser = {"optimizer": name_of(task.optimiser), **task.optimiser._asdict()}
    chosen = {**network._asdict(), **optimiser, **of_named(given)}
    write_json(folder / CONFIG, {**stored_arguments(given), CHOSEN: chosen})
    if training.stop.reason == "not finite":
        console.print("the loss stopped being finite; the run keeps the best parameters before that")
    layers = layers_in_own_units(training.parameters, task.units)
    save(folder, description_of(layers, task.network), layers)
    metrics = evaluate(folder, task, training)
    if figures:
        draw_figures(folder, task, training, trials)
    write_json(folder / "metrics.json", metrics)
    console.print(results_table(metrics, task))
    if task.network.activation == "relu":
        console.print(RELU)
    console.print(f"run folder: {folder}")


def description_of(layers: Layers, network: Network) -> Description:
    """Of a network, or an ensemble; `layers` have the members on their leading axis."""
    members, inputs, _ = layers[0][0].shape
    stated = {"activation": network.activation, "precision": network.precision}
    sizes = [inputs, *(weight.shape[2] for weight, _ in layers)]
    return describe("differential-network", sizes=sizes, members=members, **stated)


def fit(task: Task, folder: Path, *, resume: bool, console: Console) -> tuple[Network, Training, list[Trial]]:
    """Trains at the width asked for, or at growing ones: the network chosen, its training, and all trials."""
    standard = SampleSplit(*(to_units(part, task.units) for part in task.sets))
    optimiser, total = task.optimiser, task.optimiser.steps
    if isinstance(optimiser, GaussNewton) and optimiser.has_coarse_stage(len(standard.train.x)):
        total += optimiser.coarse_steps

    def train_one(network: Network) -> Training:
        known = identity(optimiser, (array for data in standard for array in data), **network._asdict())
        checkpoint = Checkpoint(folder, known, resume, f"checkpoint_width_{network.width}")
        with progress(total) as show:
            return train(
                standard,
                network,
                optimiser,
                checkpoint=checkpoint,
                report=lambda at: show(min(at.step, total), shown(network, at)),
            )

    if not task.grown:
        return task.network, train_one(task.network), []
    chosen, trials = grow_width(standard, task.network, train_one, widths=WIDTHS)
    tried = ", ".join(f"{trial.candidate.width}: {trial.validation:.3e}" for trial in trials)
    console.print(f"validation loss by width: {tried}; chosen {chosen.candidate.width}")
    return chosen.candidate, chosen.outcome, trials


def shown(network: Network, at: Progress) -> str:
    """A line of progress, with what is trained on what."""
    stage = f", {at.stage}" if at.stage else ""
    return f"width {network.width}{stage}: loss {at.loss:.3e}  validation {at.validation:.3e}"


def announce(console: Console, task: Task) -> None:
    """Says what is trained on what."""
    data, network = task.sets.train, task.network
    counts = f"{len(data.x)} training, {len(task.sets.validation.x)} validation, {len(task.test.x)} test samples"
    terms = ["value", *(["gradient"] if network.loss == "type1" else []), *(["Hessian"] * (network.derivative == 2))]
    width = "grown" if task.grown else str(network.width)
    layers = " x ".join([str(data.inputs), *[width] * network.depth, str(data.outputs)])
    networks = f"{network.members} networks" if network.members > 1 else "network"
    console.print(f"{task.name}: {counts}, {data.inputs} inputs, {data.outputs} outputs")
    console.print(
        f"{networks} {layers}, {network.activation}; {network.loss}: {', '.join(terms)}; "
        f"{name_of(task.optimiser)}, {network.precision}"
    )
    if network.activation == "relu" and network.derivative == 2:
        console.print(RELU)


def evaluate(folder: Path, task: Task, training: Training) -> dict[str, float]:
    """Loads the stored model as a user would, and measures it on the test samples."""
    loaded = load(folder)
    function = activation(task.network.activation)
    tested = predictions(loaded.parameters, task.test.x, activation=function)
    metrics = errors(tested.mean, task.test)
    bounded = task.bound is not None
    spread = predictions(loaded.parameters, task.shown.x, activation=function).spread if bounded else None
    if task.bound is not None and spread is not None:
        inside = np.all(abs(task.shown.x) <= task.bound, axis=1)
        metrics["spread_inside"] = typical_spread(spread, inside)
        metrics["spread_outside"] = typical_spread(spread, ~inside)
    latency = one_step(loaded.derivatives, [(x,) for x in task.test.x[:512]], calls=1000)
    return {
        **metrics,
        "validation_loss": float(training.validation),
        "width": task.network.width,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(loaded.parameters)),
        "steps": training.stop.step,
        "best_step": training.best_step,
        "compile_seconds": training.compile_seconds,
        "train_seconds": training.train_seconds,
        "one_step_p50_us": latency.p50_us,
        "one_step_p99_us": latency.p99_us,
    }


def draw_figures(folder: Path, task: Task, training: Training, trials: list[Trial]) -> None:
    """Writes what fits the number of inputs."""
    inputs, loaded = task.test.inputs, load(folder)
    shown = predictions(loaded.parameters, task.shown.x, activation=activation(task.network.activation))
    drawn = {"training": training_figure(training, trials)} if training.history else {}
    if inputs == 1:
        drawn["curves"] = drawing.function_curves(task.shown, shown.mean)
    elif task.name in NAMED:
        drawn["heat_maps"] = drawing.heat_maps(task.shown, shown.mean)
        drawn["surfaces"] = drawing.surfaces(task.shown, shown.mean)
    else:
        drawn["parity"] = drawing.parity(*(to_units(part, task.units) for part in (task.shown, shown.mean)))
    if task.bound is not None and shown.spread is not None:
        drawn["ensemble"] = drawing.ensemble(task.shown, shown.mean, shown.spread, bound=task.bound)
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
    table = Table("quantity", "value", "unit", title=f"test on {task.name}, {task.network.precision}")
    table.columns[1].justify = "right"
    for key, value in metrics.items():
        unit = "s" if key.endswith("_seconds") else "µs" if key.endswith("_us") else UNITS.get(key, "")
        small = f"{value:.2e}" if re.search("_mse|_loss|spread", key) else f"{value:,.1f}"
        table.add_row(key.replace("_", " "), f"{value:,}" if isinstance(value, int) else small, unit)
    return table
