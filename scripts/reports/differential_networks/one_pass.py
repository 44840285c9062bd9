"""Value, Jacobian and Hessian of one pass against jax.hessian of the same network, float32."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import activation
from dln_jax.sizes import require_network
from dln_jax.types import require_positive
from scripts.reports.case import Case, Findings
from scripts.reports.rows import Row
from scripts.reports.turns import medians_in_turns

INPUTS = (1, 2, 4, 7)
BOUNDS = {2: 4.0, 7: 4.0}
"""Speed-up over jax.hessian of the plain network to reach, by number of inputs."""
PLAIN = {"tanh": jnp.tanh, "softplus": jax.nn.softplus, "cos": jnp.cos, "sin": jnp.sin, "silu": jax.nn.silu}
"""Activations in plain JAX."""


def cases(
    *, width: int = 128, depth: int = 2, batch: int = 512, activation: str = "tanh", repetitions: int = 30
) -> list[Case]:
    """One case per number of inputs; `InputError` for sizes that are not positive."""
    require_network(width=width, depth=depth)
    require_positive(batch=batch, repetitions=repetitions)
    settings = {"hidden": (width,) * depth, "batch": batch, "activation": activation, "repetitions": repetitions}
    return [Case(f"diffnet-pass/n-{inputs}", partial(compared, inputs, **settings)) for inputs in INPUTS]


def compared(inputs: int, *, hidden: tuple[int, ...], batch: int, activation: str, repetitions: int) -> Findings:
    """Times and their ratios for one number of inputs."""
    programs, arguments = programs_for((inputs, *hidden, 1), batch, activation)
    seconds = medians_in_turns(
        {name: jax.jit(program).lower(*arguments).compile() for name, program in programs.items()},
        arguments,
        repetitions=repetitions,
    )
    case, ours, bound = f"diffnet-pass/n-{inputs}", seconds["one_pass"], BOUNDS.get(inputs)
    rows = [
        Row(case, "speedup_over_jax_hessian", seconds["jax_hessian"] / ours, "1", bound=bound, at_least=True),
        Row(case, "speedup_over_jax_hessian_of_value", seconds["jax_hessian_of_value"] / ours, "1"),
        Row(case, "cost_over_value_alone", ours / seconds["value"], "1"),
    ]
    return Findings([*rows, *(Row(case, f"{name}_ms", 1e3 * value, "ms") for name, value in seconds.items())])


def programs_for(sizes: tuple[int, ...], batch: int, name: str) -> tuple[dict[str, Callable], tuple]:
    """Programs for gradients of a loss on value, gradient and Hessian, and of a loss on the value; and (layers, x)."""
    function = activation(name)
    layers = differential_mlp.init(jax.random.key(0), sizes, dtype=jnp.float32)
    x = jax.random.normal(jax.random.key(1), (batch, sizes[0]), jnp.float32)

    def value(layers, x):
        return differential_mlp.value(layers, x, activation=function)[0]

    def plain(layers, x):
        for weight, bias in layers[:-1]:
            x = PLAIN[name](x @ weight + bias)
        return (x @ layers[-1][0] + layers[-1][1])[0]

    def by_autodiff(network):
        ways = (network, jax.grad(network, 1), jax.hessian(network, 1))
        return lambda layers, x: tuple(way(layers, x) for way in ways)

    def gradient_of_loss(network):
        def loss(layers, x):
            answers = jax.vmap(network, (None, 0))(layers, x)
            return sum(jnp.mean((answer - 1) ** 2) for answer in jax.tree.leaves(answers))

        return jax.grad(loss)

    networks = {
        "one_pass": partial(differential_mlp.value_jacobian_and_hessian, activation=function),
        "jax_hessian": by_autodiff(plain),
        "jax_hessian_of_value": by_autodiff(value),
        "value": value,
    }
    return {name: gradient_of_loss(network) for name, network in networks.items()}, (layers, x)
