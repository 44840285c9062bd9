"""Measure differential networks: errors beside the published table, and the cost of their derivatives.

`table` trains networks for sin and cos_sin with all activations, losses and optimisers of the published table; the ReLU
network's Hessian is zero almost everywhere, so that its error is that of predicting zero. `one-pass` times value,
gradient and Hessian against jax.hessian. All programs take turns; medians are compared.
"""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

from dln_jax.commands.functions.networks import errors, predict
from dln_jax.data.functions import FunctionSamples, SampleSplit, published, published_grid, split
from dln_jax.learning.functions import GAUSS_NEWTON, WIDTHS, Network, grow_width, published_adam, train
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import activation as activation_named
from dln_jax.nn.activations import tanh
from scripts.reports.run import AtLeast, Case, Numbers
from scripts.reports.timing import medians_in_turns

ERRORS = ("value_mse", "gradient_mse", "hessian_mse")
PUBLISHED = {
    ("sin", "type1", "relu"): (9.8e-6, 4.5e-4, 5.0e-1),
    ("sin", "type1", "softplus"): (6.9e-6, 1.8e-4, 5.9e-3),
    ("sin", "type1", "tanh"): (8.2e-7, 3.1e-5, 1.6e-3),
    ("sin", "type1", "cos"): (2.0e-7, 2.2e-6, 5.5e-5),
    ("sin", "type2", "relu"): (5.1e-7, 2.7e-3, 5.0e-1),
    ("sin", "type2", "softplus"): (8.7e-6, 1.5e-4, 4.5e-3),
    ("sin", "type2", "tanh"): (7.6e-6, 4.3e-4, 8.6e-3),
    ("sin", "type2", "cos"): (1.7e-8, 5.7e-7, 1.2e-5),
    ("cos_sin", "type1", "relu"): (4.2e-5, 2.0e-3, 1.0),
    ("cos_sin", "type1", "softplus"): (2.9e-6, 3.7e-5, 1.3e-3),
    ("cos_sin", "type1", "tanh"): (2.6e-6, 1.5e-5, 8.5e-4),
    ("cos_sin", "type1", "cos"): (2.9e-7, 4.3e-6, 1.7e-4),
    ("cos_sin", "type2", "relu"): (3.3e-5, 5.0e-3, 1.0),
    ("cos_sin", "type2", "softplus"): (4.3e-5, 8.1e-4, 1.5e-2),
    ("cos_sin", "type2", "tanh"): (8.4e-6, 4.3e-4, 1.2e-2),
    ("cos_sin", "type2", "cos"): (2.1e-6, 7.0e-5, 1.3e-3),
}
"""Mean squared errors of the published table: Adam, 128 units a layer."""
FACTORS = {"sin": 30.0, "cos_sin": 10.0}
"""Our error with cosines by Gauss-Newton must beat the best published one of the function by this factor."""
BEST = {name: [min(row[i] for key, row in PUBLISHED.items() if key[0] == name) for i in range(3)] for name in FACTORS}


@functools.cache
def samples_of(function: str, samples: int, seed: int) -> tuple[SampleSplit, FunctionSamples]:
    """Noisy samples of a published function, split, and its clean grid."""
    return split(published(function, samples=samples, seed=seed), seed=seed), published_grid(function)


def measure_function(
    function: str, loss: str, activation: str, optimizer: str, *,
    samples: int = 25_600, seed: int = 0, steps: int = 40, coarse_steps: int = 200, epochs: int = 500,
) -> Numbers:  # fmt: skip
    """Trains a network on a published function and measures it on the clean grid.

    Gauss-Newton, in float64, grows the width by validation; Adam trains the published width of 128 in float32.

    Args:
        samples: samples of the function, with noise of 1e-3 on x, f and gradient; a tenth is for validation.
        steps: Gauss-Newton iterations on all samples at most, after `coarse_steps` on 2,048 of them.
        epochs: passes of Adam over the data.
    """
    sets, test = samples_of(function, samples, seed)
    network = Network(loss=loss, activation=activation, depth=1 if function == "sin" else 2, seed=seed)
    began = time.perf_counter()
    if optimizer == "adam":
        training = train(sets, network, published_adam(len(sets.train.x), epochs=epochs))
    else:
        optimiser = GAUSS_NEWTON._replace(steps=steps, coarse_steps=coarse_steps)
        small = network._replace(width=WIDTHS[0], precision="f64")
        chosen, _ = grow_width(sets, small, lambda candidate: train(sets, candidate, optimiser))
        network, training = chosen.candidate, chosen.outcome
    predicted, _ = predict(training.parameters, test.x, activation=activation_named(activation))
    seconds = time.perf_counter() - began
    numbers = {**errors(predicted, test), "width": network.width, "job_seconds": seconds}
    return {f"{function}/{loss}/{activation}/{optimizer}": numbers}


def measure_one_pass(
    *, inputs: int | None = None, width: int = 128, depth: int = 2, batch: int = 512, repetitions: int = 30
) -> Numbers:
    """Value, gradient and Hessian in one pass against jax.grad and jax.hessian, in float32.

    The programs compute the gradient of a loss on all three. Rivals differentiate a plain network in jax.numpy, and
    this library's `value`, whose activation has exact derivatives.
    """
    numbers = {}
    for n in (1, 2, 4, 7) if inputs is None else (inputs,):
        layers = differential_mlp.init(jax.random.key(0), (n, *(width,) * depth, 1), dtype=jnp.float32)
        x = jax.random.normal(jax.random.key(1), (batch, n), jnp.float32)
        programs = {name: jax.jit(gradient_of_loss(way)) for name, way in passes().items()}
        seconds = medians_in_turns(programs, (layers, x), repetitions=repetitions)
        numbers[f"diffnet-pass/n-{n}"] = {
            "speedup_over_jax_hessian": seconds["jax_hessian"] / seconds["one_pass"],
            "speedup_over_jax_hessian_of_value": seconds["jax_hessian_of_value"] / seconds["one_pass"],
            "cost_over_value_alone": seconds["one_pass"] / seconds["value"],
            **{f"{name}_ms": 1e3 * value for name, value in seconds.items()},
        }
    return numbers


def passes() -> dict[str, Callable]:
    """Value, gradient and Hessian of a tanh network by each way, and its value alone."""

    def value(layers, x):
        return differential_mlp.value(layers, x, activation=tanh)[0]

    def plain(layers, x):
        for weight, bias in layers[:-1]:
            x = jnp.tanh(x @ weight + bias)
        return (x @ layers[-1][0] + layers[-1][1])[0]

    return {
        "one_pass": functools.partial(differential_mlp.value_jacobian_and_hessian, activation=tanh),
        "jax_hessian": by_autodiff(plain),
        "jax_hessian_of_value": by_autodiff(value),
        "value": value,
    }


def by_autodiff(network: Callable) -> Callable:
    """Value, gradient and Hessian of a network by JAX."""
    ways = (network, jax.grad(network, 1), jax.hessian(network, 1))
    return lambda layers, x: [way(layers, x) for way in ways]


def gradient_of_loss(network: Callable) -> Callable:
    """Gradient of a loss on all answers of a network."""

    def loss(layers, x):
        answers = jax.vmap(network, (None, 0))(layers, x)
        return sum(jnp.mean((answer - 1) ** 2) for answer in jax.tree.leaves(answers))

    return jax.grad(loss)


def to_reach(function: str, loss: str, activation: str, optimizer: str) -> dict[str, float]:
    """Bounds of the best row of a function."""
    if (loss, activation, optimizer) != ("type1", "cos", "gauss-newton"):
        return {}
    return {name: best / FACTORS[function] for name, best in zip(ERRORS, BEST[function], strict=True)}


CASES = (
    *(
        Case(
            f"table/{'-'.join(key)}/{optimizer}",
            functools.partial(measure_function, *key, optimizer),
            quick={"samples": 512, "steps": 2, "coarse_steps": 2, "epochs": 1},
            published=dict(zip(ERRORS, row, strict=True)),
            bound=to_reach(*key, optimizer),
        )
        for optimizer in ("gauss-newton", "adam")
        for key, row in PUBLISHED.items()
        if (optimizer, key[2]) != ("gauss-newton", "relu")
    ),
    Case(
        "one-pass/beside-jax-hessian",
        measure_one_pass,
        quick={"inputs": 2, "width": 8, "repetitions": 2},
        bound={f"diffnet-pass/n-{n} speedup_over_jax_hessian": AtLeast(4.0) for n in (2, 7)},
    ),
)
