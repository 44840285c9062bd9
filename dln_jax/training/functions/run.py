"""Trains a differential network or an ensemble, as a kind of the pipeline: the model, its errors, speed, figures."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from matplotlib.figure import Figure

from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.figures import functions as drawing
from dln_jax.figures.training import training_curve
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.optimisers import GaussNewton, name_of
from dln_jax.learning.engine.problem import Progress, Training, one_after_the_other
from dln_jax.learning.functions import WIDTHS, Network, grow_width
from dln_jax.learning.functions import train as train_network
from dln_jax.learning.latency import one_step
from dln_jax.learning.select import Trial
from dln_jax.learning.standardisation import layers_in_own_units, to_units
from dln_jax.metrics.functions import QUANTITIES, Prediction, errors, predictions, typical_spread
from dln_jax.metrics.verdict import Verdict, held_out, worst
from dln_jax.metrics.verdict import judge as judge_columns
from dln_jax.nn.activations import activation
from dln_jax.runs.progress import progress
from dln_jax.runs.report import Report, png
from dln_jax.scale.devices import device_lines
from dln_jax.training.functions.options import Options
from dln_jax.training.functions.task import NAMED, Task, of_named, prepare
from dln_jax.training.pipeline import Fitted, Kind
from dln_jax.training.results import OF_LOSSES, cost_metrics, number, settings_of, unit_of
from dln_jax.zoo.descriptions import describe
from dln_jax.zoo.run import load


class Outcome(NamedTuple):
    """A training of a differential network."""

    network: Network
    training: Training
    trials: list[Trial]
    """Trainings of all widths tried; empty for a stated width."""


RELU = (
    "a ReLU network is piecewise linear: its Hessian is zero almost everywhere, so its hessian_mse is that of "
    "predicting zero and a Hessian in the loss teaches it nothing; use softplus, tanh, cos or another smooth activation"
)

REMEDY = "train a wider network or longer, or add samples where the function changes quickly"


def announce(task: Task) -> Iterator[str]:
    """Lines on the data, the network and the training method."""
    data, network = task.sets.train, task.network
    counts = f"{len(data.x)} training, {len(task.sets.validation.x)} validation, {len(task.test.x)} test samples"
    terms = ["value", *(["gradient"] if network.loss == "type1" else []), *(["Hessian"] * (network.derivative == 2))]
    width = "grown" if task.grown else str(network.width)
    layers = " x ".join([str(data.inputs), *[width] * network.depth, str(data.outputs)])
    networks = f"{network.members} networks" if network.members > 1 else "network"
    yield f"{task.name}: {counts}, {data.inputs} inputs, {data.outputs} outputs"
    yield from task.remarks
    trained = f"{network.loss}: {', '.join(terms)}; {name_of(task.optimiser)}, {network.precision}"
    yield f"{networks} {layers}, {network.activation}; {trained}"
    if network.activation == "relu" and network.derivative == 2:
        yield RELU
    yield from device_lines(network.precision)


def fit(task: Task, options: Options, folder: Path, mesh: Mesh | None) -> Fitted:
    """Trains at the requested width, or at growing ones and selects one by validation."""
    standard = SampleSplit(*(to_units(part, task.units) for part in task.sets))
    optimiser, total = task.optimiser, task.optimiser.steps
    if isinstance(optimiser, GaussNewton) and optimiser.has_coarse_stage(len(standard.train.x)):
        total += optimiser.coarse_steps

    def train_one(network: Network) -> Training:
        known = identity(optimiser, (array for data in standard for array in data), **network._asdict())
        checkpoint = Checkpoint(folder, known, options.resume, f"checkpoint_width_{network.width}")
        with progress(total) as show:

            def report(at: Progress) -> None:
                stage = f", {at.stage}" if at.stage else ""
                text = f"loss {at.loss:.3e}  validation {at.validation:.3e}"
                show(min(at.step, total), f"width {network.width}{stage}: {text}")

            return train_network(standard, network, optimiser, checkpoint=checkpoint, report=report, mesh=mesh)

    network, trials = task.network, []
    if task.grown:
        chosen, trials = grow_width(standard, network, train_one, widths=WIDTHS)
        tried = ", ".join(f"{trial.candidate.width}: {trial.validation:.3e}" for trial in trials)
        print(f"validation loss by width: {tried}; chosen {chosen.candidate.width}")
        network, training = chosen.candidate, chosen.outcome
    else:
        training = train_one(network)
    layers = layers_in_own_units(training.parameters, task.units)
    members, inputs, _ = layers[0][0].shape
    stated = {"activation": network.activation, "precision": network.precision}
    sizes = [inputs, *(weight.shape[2] for weight, _ in layers)]
    description = describe("differential-network", sizes=sizes, members=members, **stated)
    return Fitted(description, layers, Outcome(network, training, trials))


def judge(task: Task, fitted: Fitted, options: Options, folder: Path) -> Report:
    """Loads the stored model as a user would, and evaluates it on the test samples."""
    network, training, trials = fitted.outcome
    loaded, function = load(folder), activation(network.activation)
    tested = predictions(loaded.parameters, task.test.x, activation=function)
    # Without a bound, the figures show the test samples.
    shown = tested if task.bound is None else predictions(loaded.parameters, task.shown.x, activation=function)
    verdict = verdict_of(network, tested.mean, task.test)
    metrics = {**errors(tested.mean, task.test), "verdict": verdict.number}
    if task.bound is not None and shown.spread is not None:
        inside = np.all(abs(task.shown.x) <= task.bound, axis=1)
        metrics["spread_inside"] = typical_spread(shown.spread, inside)
        metrics["spread_outside"] = typical_spread(shown.spread, ~inside)
    latency = one_step(loaded.derivatives, [(x,) for x in task.test.x[:512]], calls=1000)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(loaded.parameters))
    metrics |= {"validation_loss": float(training.validation), "width": network.width}
    metrics |= cost_metrics(training, latency, parameters=parameters, best_step=training.best_step)
    lines = (RELU,) if network.activation == "relu" else ()
    if training.stop.reason == "not finite":
        lines = ("the loss stopped being finite; the run keeps the best parameters before that", *lines)
    return Report(
        metrics=metrics,
        rows=[
            (key.replace("_", " "), number(key, value), unit_of(key, UNITS))
            for key, value in metrics.items()
            if key != "verdict"
        ],
        title=f"test on {task.name}, {network.precision}",
        verdict=verdict,
        ended_by_user=bool(getattr(options, "steps", None) or getattr(options, "epochs", None)),
        figures=drawings(task, shown, training, trials),
        chosen={**network._asdict(), **settings_of(task.optimiser), **of_named(options)},
        lines=lines,
    )


def verdict_of(network: Network, *samples: FunctionSamples) -> Verdict:
    """Verdict on every component of the value and of the derivatives that were fitted; predicted and true samples."""
    verdicts = []
    for key in ("y", *["dy"] * (network.loss == "type1"), *["d2y"] * (network.derivative == 2)):
        off = held_out(*(getattr(part, key).reshape(len(part.x), -1) for part in samples))
        names = [f"component {k + 1}" for k in range(len(off.error))]
        verdicts.append(judge_columns(off, names, quantity=QUANTITIES[key]))
    verdict = worst(*verdicts)
    return verdict if verdict.level == "good" else verdict._replace(remedy=REMEDY)


def drawings(task: Task, shown: Prediction, training: Training, trials: list[Trial]) -> dict[str, Any]:
    """Figures by file name, as applicable to the number of inputs."""
    drawn = {"training.png": png(training_figure, training, trials)} if training.history else {}
    if task.test.inputs == 1:
        drawn["curves.png"] = png(drawing.function_curves, task.shown, shown.mean)
    elif task.name in NAMED:
        drawn["heat_maps.png"] = png(drawing.heat_maps, task.shown, shown.mean)
        drawn["surfaces.png"] = png(drawing.surfaces, task.shown, shown.mean)
    else:
        drawn["parity.png"] = png(drawing.parity, *(to_units(part, task.units) for part in (task.shown, shown.mean)))
    if task.bound is not None and shown.spread is not None:
        drawn["ensemble.png"] = png(drawing.ensemble, task.shown, shown.mean, shown.spread, bound=task.bound)
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
"""Units of metrics, from the units x and y of the data."""


FUNCTIONS = Kind(prepare, announce, fit, judge)
