"""Trains a differential network, or an ensemble, into a run folder: the model, its errors, its speed and figures."""

import re
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh
from matplotlib.figure import Figure

from dln_jax.cli.optimisers import name_of
from dln_jax.cli.progress import progress
from dln_jax.cli.running import command_folder
from dln_jax.cli.scaled import mesh_of
from dln_jax.cli.stored_arguments import write_config
from dln_jax.data.functions import SampleSplit
from dln_jax.figures import functions as drawing
from dln_jax.figures.training import training_curve
from dln_jax.files import write_figure, write_json
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import Progress, Training, one_after_the_other
from dln_jax.learning.functions import WIDTHS, Network, grow_width, train
from dln_jax.learning.model_selection import Trial
from dln_jax.learning.standardisation import layers_in_own_units, to_units
from dln_jax.metrics.functions import Prediction, errors, predictions, typical_spread
from dln_jax.metrics.latency import one_step
from dln_jax.nn.activations import activation
from dln_jax.scale.devices import device_lines
from dln_jax.training.functions.task import NAMED, Options, Task, of_named, prepare
from dln_jax.training.results import OF_LOSSES, cost_metrics, print_numbers, settings_of, unit_of
from dln_jax.zoo.descriptions import describe
from dln_jax.zoo.run import load, save

RELU = (
    "a ReLU network is piecewise linear: its Hessian is zero almost everywhere, so its hessian_mse is that of "
    "predicting zero and a Hessian in the loss teaches it nothing; use softplus, tanh, cos or another smooth activation"
)


def run(given: Options, command: str) -> None:
    """Trains, evaluates and writes a run folder, by default runs/`command`-1, -2, ..."""
    task, mesh = prepare(given), mesh_of(given)
    with command_folder(given, command) as folder:
        announce(task)
        network, training, trials = fit(task, folder, resume=given.resume, mesh=mesh)
        task = task._replace(network=network)
        write_config(folder, given, **network._asdict(), **settings_of(task.optimiser), **of_named(given))
        if training.stop.reason == "not finite":
            print("the loss stopped being finite; the run keeps the best parameters before that")
        layers = layers_in_own_units(training.parameters, task.units)
        members, inputs, _ = layers[0][0].shape
        stated = {"activation": network.activation, "precision": network.precision}
        sizes = [inputs, *(weight.shape[2] for weight, _ in layers)]
        save(folder, describe("differential-network", sizes=sizes, members=members, **stated), layers)
        metrics = evaluate(folder, task, training, trials, figures=given.figures)
        write_json(folder / "metrics.json", metrics)
        numbers = ([key.replace("_", " "), number(key, value), unit_of(key, UNITS)] for key, value in metrics.items())
        print_numbers(numbers, title=f"test on {task.name}, {network.precision}")
        if network.activation == "relu":
            print(RELU)
        print(f"run folder: {folder}")


def announce(task: Task) -> None:
    """Prints the data, the network and the training method."""
    data, network = task.sets.train, task.network
    counts = f"{len(data.x)} training, {len(task.sets.validation.x)} validation, {len(task.test.x)} test samples"
    terms = ["value", *(["gradient"] if network.loss == "type1" else []), *(["Hessian"] * (network.derivative == 2))]
    width = "grown" if task.grown else str(network.width)
    layers = " x ".join([str(data.inputs), *[width] * network.depth, str(data.outputs)])
    networks = f"{network.members} networks" if network.members > 1 else "network"
    print(f"{task.name}: {counts}, {data.inputs} inputs, {data.outputs} outputs")
    trained = f"{network.loss}: {', '.join(terms)}; {name_of(task.optimiser)}, {network.precision}"
    print(f"{networks} {layers}, {network.activation}; {trained}")
    if network.activation == "relu" and network.derivative == 2:
        print(RELU)
    for line in device_lines(network.precision):
        print(line)


def fit(task: Task, folder: Path, *, resume: bool, mesh: Mesh | None) -> tuple[Network, Training, list[Trial]]:
    """Trains at the requested width or at growing ones; returns the selected network, its training, and all trials."""
    standard = SampleSplit(*(to_units(part, task.units) for part in task.sets))
    optimiser, total = task.optimiser, task.optimiser.steps
    if isinstance(optimiser, GaussNewton) and optimiser.has_coarse_stage(len(standard.train.x)):
        total += optimiser.coarse_steps

    def train_one(network: Network) -> Training:
        known = identity(optimiser, (array for data in standard for array in data), **network._asdict())
        checkpoint = Checkpoint(folder, known, resume, f"checkpoint_width_{network.width}")
        with progress(total) as show:

            def report(at: Progress) -> None:
                stage = f", {at.stage}" if at.stage else ""
                losses = f"loss {at.loss:.3e}  validation {at.validation:.3e}"
                show(min(at.step, total), f"width {network.width}{stage}: {losses}")

            return train(standard, network, optimiser, checkpoint=checkpoint, report=report, mesh=mesh)

    if not task.grown:
        return task.network, train_one(task.network), []
    chosen, trials = grow_width(standard, task.network, train_one, widths=WIDTHS)
    tried = ", ".join(f"{trial.candidate.width}: {trial.validation:.3e}" for trial in trials)
    print(f"validation loss by width: {tried}; chosen {chosen.candidate.width}")
    return chosen.candidate, chosen.outcome, trials


def evaluate(
    folder: Path, task: Task, training: Training, trials: list[Trial], *, figures: bool
) -> dict[str, float | int]:
    """Loads the stored model as a user would, evaluates it on the test samples, and draws the applicable figures."""
    loaded, function = load(folder), activation(task.network.activation)
    tested = predictions(loaded.parameters, task.test.x, activation=function)
    # Without a bound, the figures show the test samples.
    shown = tested if task.bound is None else predictions(loaded.parameters, task.shown.x, activation=function)
    metrics = errors(tested.mean, task.test)
    if task.bound is not None and shown.spread is not None:
        inside = np.all(abs(task.shown.x) <= task.bound, axis=1)
        metrics["spread_inside"] = typical_spread(shown.spread, inside)
        metrics["spread_outside"] = typical_spread(shown.spread, ~inside)
    latency = one_step(loaded.derivatives, [(x,) for x in task.test.x[:512]], calls=1000)
    if figures:
        for name, figure in drawings(task, shown, training, trials).items():
            write_figure(folder / f"{name}.png", figure)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(loaded.parameters))
    metrics |= {"validation_loss": float(training.validation), "width": task.network.width}
    return metrics | cost_metrics(training, latency, parameters=parameters, best_step=training.best_step)


def drawings(task: Task, shown: Prediction, training: Training, trials: list[Trial]) -> dict[str, Figure]:
    """Figures by name, as applicable to the number of inputs."""
    drawn = {"training": training_figure(training, trials)} if training.history else {}
    if task.test.inputs == 1:
        drawn["curves"] = drawing.function_curves(task.shown, shown.mean)
    elif task.name in NAMED:
        drawn["heat_maps"] = drawing.heat_maps(task.shown, shown.mean)
        drawn["surfaces"] = drawing.surfaces(task.shown, shown.mean)
    else:
        drawn["parity"] = drawing.parity(*(to_units(part, task.units) for part in (task.shown, shown.mean)))
    if task.bound is not None and shown.spread is not None:
        drawn["ensemble"] = drawing.ensemble(task.shown, shown.mean, shown.spread, bound=task.bound)
    return drawn


def training_figure(training: Training, trials: list[Trial]) -> Figure:
    """Figure of the losses of all widths tried, in sequence."""
    before, histories = 0, []
    for trial in trials:
        if trial.outcome is training:
            before = sum(history[-1].step for history in histories)
        name = f"width {trial.candidate.width}"
        histories.append([at._replace(stage=name) for at in trial.outcome.history])
    joined = one_after_the_other(histories) if trials else training.history
    return training_curve(
        joined, best_step=before + training.best_step, unit="loss, in the units of the fit", **OF_LOSSES
    )


UNITS = {
    "value_mse": "y²",
    "gradient_mse": "(y / x)²",
    "hessian_mse": "(y / x²)²",
    "spread_inside": "y",
    "spread_outside": "y",
    "validation_loss": "units of the fit",
}
"""Units of metrics, in those of the data."""


def number(metric: str, value: int | float) -> str:
    """Formats a metric for the table."""
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.2e}" if re.search("_mse|_loss|spread", metric) else f"{value:,.1f}"
