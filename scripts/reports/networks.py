"""Differential networks: the published table, and the cost of derivatives in them and in structured DeLaNs."""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.learning.functions import GAUSS_NEWTON, WIDTHS, Network, grow_width, published_adam, train
from dln_jax.mechanics import natural
from dln_jax.metrics.functions import errors, predictions
from dln_jax.models.lagrangian import cholesky_factor
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import activation as activation_named
from dln_jax.nn.activations import tanh
from scripts.reports.run import Numbers
from scripts.reports.timing import medians_in_turns


@functools.cache
def samples_of(function: str, samples: int, seed: int) -> tuple[SampleSplit, FunctionSamples]:
    """Noisy samples of a published function, split, and its clean grid."""
    sine = function == "sin"
    data = (functions.sine if sine else functions.cosine_sine)(samples=samples, seed=seed)
    return functions.split(data, seed=seed), functions.sine_grid() if sine else functions.cosine_sine_grid()


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
    predicted = predictions(training.parameters, test.x, activation=activation_named(activation))
    seconds = time.perf_counter() - began
    numbers = {**errors(predicted.mean, test), "width": network.width, "job_seconds": seconds}
    return {f"{function}/{loss}/{activation}/{optimizer}": numbers}


PLAIN = {"tanh": jnp.tanh, "softplus": jax.nn.softplus, "cos": jnp.cos, "sin": jnp.sin, "silu": jax.nn.silu}
"""Activations in plain JAX."""


def measure_one_pass(
    *, inputs: int | None = None, width: int = 128, depth: int = 2, batch: int = 512, activation: str = "tanh",
    repetitions: int = 30,
) -> Numbers:  # fmt: skip
    """Value, gradient and Hessian in one pass against jax.grad and jax.hessian, in float32.

    The programs compute the gradient of a loss on all three. Rivals differentiate a plain network in jax.numpy, and
    this library's `value`, whose activations have exact derivatives.
    """
    numbers = {}
    for n in (1, 2, 4, 7) if inputs is None else (inputs,):
        layers = differential_mlp.init(jax.random.key(0), (n, *(width,) * depth, 1), dtype=jnp.float32)
        x = jax.random.normal(jax.random.key(1), (batch, n), jnp.float32)
        programs = {name: jax.jit(gradient_of_loss(way)) for name, way in passes(activation).items()}
        seconds = medians_in_turns(programs, (layers, x), repetitions=repetitions)
        numbers[f"diffnet-pass/n-{n}"] = {
            "speedup_over_jax_hessian": seconds["jax_hessian"] / seconds["one_pass"],
            "speedup_over_jax_hessian_of_value": seconds["jax_hessian_of_value"] / seconds["one_pass"],
            "cost_over_value_alone": seconds["one_pass"] / seconds["value"],
            **{f"{name}_ms": 1e3 * value for name, value in seconds.items()},
        }
    return numbers


def passes(activation: str) -> dict[str, Callable]:
    """Value, gradient and Hessian of a network by each way, and its value alone."""
    function, plain_function = activation_named(activation), PLAIN[activation]

    def value(layers, x):
        return differential_mlp.value(layers, x, activation=function)[0]

    def plain(layers, x):
        for weight, bias in layers[:-1]:
            x = plain_function(x @ weight + bias)
        return (x @ layers[-1][0] + layers[-1][1])[0]

    return {
        "one_pass": functools.partial(differential_mlp.value_jacobian_and_hessian, activation=function),
        "jax_hessian": by_autodiff(plain),
        "jax_hessian_of_value": by_autodiff(value),
        "value": value,
    }


def by_autodiff(network: Callable) -> Callable:
    """Value, gradient and Hessian of a network by JAX."""
    ways = (network, jax.grad(network, 1), jax.hessian(network, 1))
    return lambda layers, x: tuple(way(layers, x) for way in ways)


def gradient_of_loss(network: Callable) -> Callable:
    """Gradient of a loss on all answers of a network."""

    def loss(layers, x):
        answers = jax.vmap(network, (None, 0))(layers, x)
        return sum(jnp.mean((answer - 1) ** 2) for answer in jax.tree.leaves(answers))

    return jax.grad(loss)


def measure_derivatives(*, width: int = 64, repetitions: int = 40) -> Numbers:
    """Two ways to the derivatives in a structured DeLaN's inverse dynamics, by number of joints, in float32.

    The library's own, which `mechanics.natural` explains, and all partial derivatives of both networks in one pass.
    """
    numbers = {}
    for d in (1, 2, 4, 7, 12):
        keys = jax.random.split(jax.random.key(0), 3)
        sizes = zip(keys, (d * (d + 1) // 2, 1), strict=False)
        layers = tuple(
            differential_mlp.init(key, (2 * d, width, width, size), dtype=jnp.float32) for key, size in sizes
        )
        for batch, kind in {1: "single-call", 512: "training-step-batch-512"}.items():
            states = jax.random.normal(keys[2], (4, batch, d), jnp.float32)

            ways = {"jvp_vjp_us": by_jvp_and_vjp, "one_pass_us": by_one_pass}
            programs = {name: derivative_program(way, batch) for name, way in ways.items()}
            answers = zip(*(jax.tree.leaves(one(layers, states)) for one in programs.values()), strict=True)
            for one, other in answers:
                np.testing.assert_allclose(one, other, rtol=1e-2, atol=1e-3 * float(jnp.max(jnp.abs(one))))
            medians = medians_in_turns(programs, (layers, states), repetitions=repetitions)
            numbers[f"d-{d}/{kind}"] = {
                **{name: 1e6 * value for name, value in medians.items()},
                "one_pass_over_jvp_vjp": medians["one_pass_us"] / medians["jvp_vjp_us"],
            }
    return numbers


def derivative_program(way: Callable, batch: int) -> Callable:
    """A single call of the inverse dynamics, or the gradient of a torque loss, of (layers, states)."""

    def loss(layers, states):
        tau = jax.vmap(lambda q, qd, qdd: way(layers, q, qd, qdd))(*states[:3])
        return jnp.mean((tau - states[3]) ** 2)

    if batch == 1:
        return jax.jit(lambda layers, states: way(layers, *states[:3, 0]))
    return jax.jit(jax.grad(loss))


def by_jvp_and_vjp(layers: tuple, q: Array, qd: Array, qdd: Array) -> Array:
    """tau [d] by the library's own mechanics."""
    factor, potential = layers
    d = q.shape[0]
    system = natural.NaturalSystem(
        lambda q: cholesky_factor(
            differential_mlp.value(factor, features(q), activation=tanh), d, shift=2.0, floor=0.1
        ),
        lambda q: differential_mlp.value(potential, features(q), activation=tanh)[0],
    )
    return natural.forces(system, q, qd, qdd)


def by_one_pass(layers: tuple, q: Array, qd: Array, qdd: Array) -> Array:
    """tau [d] from the networks' own Jacobians, chained by hand through features and factor."""
    d = q.shape[0]
    entries, entries_by_feature = differential_mlp.value_and_jacobian(layers[0], features(q), activation=tanh)
    _, potential_by_feature = differential_mlp.value_and_jacobian(layers[1], features(q), activation=tanh)
    feature_slopes = jax.jacfwd(features)(q)
    factor, push = jax.linearize(lambda entries: cholesky_factor(entries, d, shift=2.0, floor=0.1), entries)
    factor_slopes = jax.vmap(push, in_axes=1, out_axes=2)(entries_by_feature @ feature_slopes)
    projected = factor.T @ qd
    factor_rate = factor_slopes @ qd
    momentum_rate = factor @ (factor.T @ qdd + factor_rate.T @ qd) + factor_rate @ projected
    kinetic_force = jnp.einsum("ijk,i,j->k", factor_slopes, qd, projected)
    return momentum_rate - kinetic_force + (potential_by_feature @ feature_slopes)[0]


def features(q: Array) -> Array:
    """cos and sin of revolute joints."""
    return jnp.concatenate([jnp.cos(q), jnp.sin(q)])
