"""Time value, Jacobian and Hessian of one pass against jax.hessian of the same network, float32, batch 512.

For n inputs and one output, all compute value, gradient and Hessian of a network for every sample, and the gradient
with respect to its parameters of a loss that reads all three, which is a training step without its optimiser. The
rivals are jax.grad and jax.hessian, of a plain network in jax.numpy and of this library's `value`, to which the
formulas of its activations already give faster derivatives. Repetitions of all programs take turns, so that a busy
machine slows all alike; medians are compared. Prints a table and writes report.json.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
from rich.console import Console

from dln_jax.command_line.arguments import Unstated, choice, names_in
from dln_jax.files import run_folder
from dln_jax.metrics.latency import medians_in_turns
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import activation
from dln_jax.studies.report import Row, conditions, write_report
from dln_jax.studies.report_table import report_table
from dln_jax.types import require_network, require_positive

INPUTS = (1, 2, 4, 7)
BOUNDS = {2: 4.0, 7: 4.0}
"""At least so many times as fast as jax.hessian of the plain network, by number of inputs."""
PLAIN = {"tanh": jnp.tanh, "softplus": jax.nn.softplus, "cos": jnp.cos, "sin": jnp.sin, "silu": jax.nn.silu}
"""Activations as jax.numpy has them."""


@dataclass(frozen=True)
class Arguments:
    """What to time."""

    width: int = 128
    """Hidden units per layer."""
    depth: int = 2
    """Hidden layers."""
    batch: int = 512
    """Samples at once."""
    activation: Annotated[str, choice(PLAIN)] = "tanh"
    """Of the hidden layers."""
    repetitions: int = 30
    """Timed calls of each program."""
    out: Unstated[Path] = None
    """Folder for report.json (default: runs/diffnet_report-1, -2, ...)."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_network(width=given.width, depth=given.depth)
    require_positive(batch=given.batch, repetitions=given.repetitions)
    names_in("--activation", given.activation, PLAIN)
    with run_folder(given.out, "diffnet_report") as folder:
        measure_into(folder, given)


def measure_into(folder: Path, given: Arguments) -> None:
    """Times every number of inputs, and writes and prints the table."""
    rows = [row for inputs in INPUTS for row in rows_for(inputs, given)]
    network = f"{given.depth} layers of {given.width}, {given.activation}, batch {given.batch}"
    facts = conditions(dtype="float32", network=network, repetitions=given.repetitions)
    write_report(folder / "report.json", rows, facts)
    console = Console(soft_wrap=True, highlight=False)
    console.width = max(console.width, 110)  # numbers that are cut off say nothing
    console.print(report_table(rows, facts))
    console.print(
        f"{network}; gradient of the training loss included; medians of {given.repetitions} interleaved calls"
    )
    console.print(f"report: {folder / 'report.json'}")


def rows_for(inputs: int, given: Arguments) -> list[Row]:
    """Times and their ratios for one number of inputs."""
    programs, arguments = programs_for(inputs, given)
    seconds = medians_in_turns(
        {name: jax.jit(program).lower(*arguments).compile() for name, program in programs.items()},
        arguments,
        repetitions=given.repetitions,
    )
    case = f"diffnet-pass/n-{inputs}"
    ours, bound = seconds["one_pass"], BOUNDS.get(inputs)
    return [
        Row(case, "speedup_over_jax_hessian", seconds["jax_hessian"] / ours, "1", bound=bound, at_least=True),
        Row(case, "speedup_over_jax_hessian_of_value", seconds["jax_hessian_of_value"] / ours, "1"),
        Row(case, "cost_over_value_alone", ours / seconds["value"], "1"),
        *(Row(case, f"{name}_ms", 1e3 * value, "ms") for name, value in seconds.items()),
    ]


def programs_for(inputs: int, given: Arguments) -> tuple[dict[str, Callable], tuple]:
    """Gradients of a loss on value, gradient and Hessian by either way, and of one on the value; (layers, x)."""
    function = activation(given.activation)
    sizes = (inputs, *(given.width,) * given.depth, 1)
    layers = differential_mlp.init(jax.random.key(0), sizes, dtype=jnp.float32)
    x = jax.random.normal(jax.random.key(1), (given.batch, inputs), jnp.float32)

    def value(layers, x):
        return differential_mlp.value(layers, x, activation=function)[0]

    def plain(layers, x):
        for weight, bias in layers[:-1]:
            x = PLAIN[given.activation](x @ weight + bias)
        return (x @ layers[-1][0] + layers[-1][1])[0]

    def by_autodiff(network):
        return lambda layers, x: (
            network(layers, x),
            jax.grad(network, 1)(layers, x),
            jax.hessian(network, 1)(layers, x),
        )

    def one_pass(layers, x):
        return differential_mlp.value_jacobian_and_hessian(layers, x, activation=function)

    def gradient_of_loss(network):
        def loss(layers, x):
            answers = jax.vmap(network, (None, 0))(layers, x)
            return sum(jnp.mean((answer - 1) ** 2) for answer in jax.tree.leaves(answers))

        return jax.grad(loss)

    networks = {
        "one_pass": one_pass,
        "jax_hessian": by_autodiff(plain),
        "jax_hessian_of_value": by_autodiff(value),
        "value": value,
    }
    return {name: gradient_of_loss(network) for name, network in networks.items()}, (layers, x)
