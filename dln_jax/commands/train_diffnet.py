"""Train a network on a function and its derivatives.

A deep differential network, or an ensemble of them, gives value, gradient and Hessian in one pass. Functions: sin
(1-D) and cos_sin (cos x1 sin x2), both with the published noise, or your own npz file with x [N, n], y [N, m] and
optional dy, d2y. The run folder gets config.json, metrics.json, model.safetensors and model.json (load them with
dln_jax.load), and figures. In the repository, `python -m scripts.report diffnet table` compares the published
activations and losses.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from dln_jax.errors import InputError
from dln_jax.options import Drawn, Resumable, Scaled, Unstated, choice
from dln_jax.runs.arguments import refuse_given, resolved

NAMES = ("sin", "cos_sin")
"""Functions with the published noise."""
SHARE_OF_DATA = 0.75
"""For ensembles: width of the training box relative to that of the box shown."""
RELU = (
    "a ReLU network is piecewise linear: its Hessian is zero almost everywhere, so its hessian_mse is that of "
    "predicting zero and a Hessian in the loss teaches it nothing; use softplus, tanh, cos or another smooth activation"
)
UNITS = {
    "value_mse": "y²",
    "gradient_mse": "(y / x)²",
    "hessian_mse": "(y / x²)²",
    "spread": "y",
    "validation_loss": "units of the fit",
}
"""Units of metrics, from the units x and y of the data."""


@dataclass(frozen=True)
class Arguments(Drawn, Scaled, Resumable):
    """The function to learn, the network and its optimiser, and where the results go."""

    function: Annotated[str, choice((*NAMES, "FILE.npz"))] = "sin"
    """Function to learn; an npz file has x [N, n], y [N, m], optional dy [N, m, n] and d2y [N, m, n, n]."""
    samples: Unstated[int] = None
    """Number of samples of sin or cos_sin (default: 25600)."""
    loss: Literal["type1", "type2"] = "type1"
    """type1 fits value and gradient, type2 the value only."""
    activation: Annotated[
        str, choice(("relu", "softplus", "tanh", "cos", "sin", "silu", "gelu", "linear", "quadratic", "cubic"))
    ] = "cos"
    """Activation of the hidden layers."""
    derivative: Literal[1, 2] = 1
    """2 adds the Hessian to the loss."""
    ensemble: int = 1
    """Number of networks; several learn sin and cos_sin on ±0.75 π and are shown on ±π."""
    optimizer: Literal["adam", "gauss-newton"] = "gauss-newton"
    """Levenberg-Marquardt for small networks, or Adam, the published recipe, for wide ones."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 128 for adam; for gauss-newton grown from 2 to 16 by validation)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 1 for one input, else 2)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """Floating-point type (default: f64 for gauss-newton, which needs it, f32 for adam)."""
    steps: Unstated[int] = None
    """Iterations of gauss-newton on all samples per network (default: at most 40)."""
    epochs: Unstated[int] = None
    """Passes of adam over the data (default: 500)."""
    batch: Unstated[int] = None
    """Samples per step of adam (default: 512)."""
    learning_rate: Unstated[float] = None
    """Constant learning rate of adam (default: 0.001)."""
    seed: int = 0
    """Seed of data, validation split, parameters and shuffling."""


def main(options: Arguments) -> None:
    """Trains and evaluates the network, and writes the run folder."""
    import numpy as np
    import optax

    from dln_jax.commands.functions import figures as drawing
    from dln_jax.commands.functions.networks import (
        Units,
        errors,
        layers_in_own_units,
        predict,
        standard_units,
        to_units,
        verdict_of,
    )
    from dln_jax.data.functions import SampleSplit, load, published, published_grid, split
    from dln_jax.learning.engine.checkpoint import Checkpoint, identity
    from dln_jax.learning.engine.optimisers import GaussNewton, check
    from dln_jax.learning.engine.problem import Progress, Training, losses
    from dln_jax.learning.functions import GAUSS_NEWTON, WIDTHS, Network, grow_width, published_adam, targets, train
    from dln_jax.metrics.latency import one_step
    from dln_jax.nn.activations import activation
    from dln_jax.precision import require_float64
    from dln_jax.runs.devices import mesh_of
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.progress import progress
    from dln_jax.runs.report import Report, cost_metrics, finish, png, rows_of
    from dln_jax.scale import device_lines
    from dln_jax.zoo.descriptions import describe
    from dln_jax.zoo.run import load as load_run
    from dln_jax.zoo.run import save

    # The samples
    mesh = mesh_of(options)
    function, seed, is_named = options.function, options.seed, options.function in NAMES
    newton, several = options.optimizer == "gauss-newton", options.ensemble > 1
    sampling, box, remarks = {}, None, ()
    if is_named:
        bound = np.pi * (SHARE_OF_DATA if several else 1)
        sampling = resolved(options, {"samples": 25_600})
        data = published(function, **sampling, bound=bound, seed=seed)
        test = shown = published_grid(function, bound=bound)
        if several:
            shown, box = published_grid(function), bound
        n, m = data.inputs, data.outputs
        units = Units(np.zeros(n), np.ones(n), np.zeros(m), np.ones(m))
    else:
        refuse_given(options, ["samples"], "an option of --function sin and cos_sin")
        if not function.endswith(".npz"):
            raise InputError(f"function '{function}' is unknown; expected sin, cos_sin or an npz file's path")
        everything, remarks = load(function)
        if len(everything.x) < 3:
            raise InputError(f"{function}: {len(everything.x)} samples; training, validation and test need 3")
        data, test = split(everything, seed=seed)
        shown, units = test, standard_units(data)
    sets = split(data, seed=seed)
    standard = SampleSplit(*(to_units(part, units) for part in sets))

    # The network and its optimiser
    network = Network(
        loss=options.loss,
        derivative=options.derivative,
        activation=options.activation,
        members=options.ensemble,
        seed=seed,
        **resolved(
            options,
            {
                "width": WIDTHS[0] if newton else 128,
                "depth": min(data.inputs, 2),
                "precision": "f64" if newton else "f32",
            },
        ),
    )
    is_grown = options.width is None and newton
    if newton:
        refuse_given(options, ["epochs", "batch", "learning_rate"], "an option of --optimizer adam")
        require_float64(network.precision)
        optimiser = GAUSS_NEWTON._replace(**resolved(options, {"steps": GAUSS_NEWTON.steps}))
    else:
        refuse_given(options, ["steps"], "an option of --optimizer gauss-newton")
        recipe = resolved(options, {"epochs": 500, "batch": 512, "learning_rate": 1e-3})
        optimiser = published_adam(len(sets.train.x), **recipe)
    check(optimiser)
    for part in standard:
        targets(part, network)
    total = optimiser.steps
    if isinstance(optimiser, GaussNewton) and optimiser.has_coarse_stage(len(sets.train.x)):
        total += optimiser.coarse_steps

    def train_one(network: Network) -> Training:
        known = identity(optimiser, (array for data in standard for array in data), **network._asdict())
        checkpoint = Checkpoint(folder, known, options.resume, f"checkpoint_width_{network.width}")
        with progress(total) as show:

            def report(at: Progress) -> None:
                stage = f", {at.stage}" if at.stage else ""
                show(min(at.step, total), f"width {network.width}{stage}: {losses(at)}")

            return train(standard, network, optimiser, checkpoint=checkpoint, report=report, mesh=mesh)

    with command_folder(options, "train_diffnet") as folder:
        counts = f"{len(sets.train.x)} training, {len(sets.validation.x)} validation, {len(test.x)} test samples"
        print(f"{function}: {counts}, {data.inputs} inputs, {data.outputs} outputs", *remarks, sep="\n")
        width = "grown" if is_grown else network.width
        layers = " x ".join(map(str, [data.inputs, *[width] * network.depth, data.outputs]))
        terms = ["value", *["gradient"] * (network.loss == "type1"), *["Hessian"] * (network.derivative == 2)]
        trained = f"{network.loss}: {', '.join(terms)}; {options.optimizer}, {network.precision}"
        print(f"{f'{options.ensemble} networks' if several else 'network'} {layers}, {network.activation}; {trained}")
        if network.activation == "relu" and network.derivative == 2:
            print(RELU)
        for line in device_lines(network.precision):
            print(line)

        # The fit
        trials = []
        if is_grown:
            chosen, trials = grow_width(standard, network, train_one)
            tried = ", ".join(f"{trial.candidate.width}: {trial.validation:.3e}" for trial in trials)
            print(f"validation loss by width: {tried}; chosen {chosen.candidate.width}")
            network, training = chosen.candidate, chosen.outcome
        else:
            training = train_one(network)
        layers = layers_in_own_units(training.parameters, units)
        description = describe(
            "differential-network",
            sizes=[data.inputs, *(weight.shape[2] for weight, _ in layers)],
            members=network.members,
            activation=network.activation,
            precision=network.precision,
        )
        save(folder, description, layers)

        # Errors, costs and figures of the stored model
        run, nonlinearity = load_run(folder), activation(network.activation)
        mean, spread = predict(run.parameters, shown.x, activation=nonlinearity)
        predicted = mean if shown is test else predict(run.parameters, test.x, activation=nonlinearity)[0]
        verdict = verdict_of(network, predicted, test)
        figures = {"training.png": png(drawing.training_figure, training, trials)} if training.history else {}
        if data.inputs == 1:
            figures["curves.png"] = png(drawing.function_curves, shown, mean)
        elif is_named:
            figures["heat_maps.png"] = png(drawing.heat_maps, shown, mean)
            figures["surfaces.png"] = png(drawing.surfaces, shown, mean)
        else:
            figures["parity.png"] = png(drawing.parity, to_units(shown, units), to_units(mean, units))
        metrics: dict[str, float | int] = {**errors(predicted, test)}
        if box is not None and spread is not None:
            inside = np.all(abs(shown.x) <= box, axis=1)
            for name, where in (("spread_inside", inside), ("spread_outside", ~inside)):
                metrics[name] = float(np.sqrt(np.mean(spread.y[where] ** 2)))
            if data.inputs == 1:
                figures["ensemble.png"] = png(drawing.ensemble_curves, shown, mean, spread, box)
            else:
                figures["ensemble.png"] = png(drawing.ensemble_maps, spread, box)
        latency = one_step(run.derivatives, [(x,) for x in test.x[:512]], calls=1000)
        parameters = int(optax.tree.size(run.parameters))
        metrics |= {"validation_loss": float(training.validation), "width": network.width}
        metrics |= cost_metrics(training, latency, parameters=parameters, best_step=training.best_step)
        lines = (RELU,) if network.activation == "relu" else ()
        if training.stop.reason == "not finite":
            lines = ("the loss stopped being finite; the best parameters before that are kept", *lines)
        report = Report(
            metrics=metrics | {"verdict": verdict.number},
            rows=rows_of(metrics, units=UNITS),
            title=f"test on {function}, {network.precision}",
            verdict=verdict,
            ended_by_user=bool(options.steps or options.epochs),
            figures=figures,
            chosen={**network._asdict(), "optimizer": options.optimizer, **optimiser._asdict(), **sampling},
            lines=lines,
        )
        finish(folder, options, report)
