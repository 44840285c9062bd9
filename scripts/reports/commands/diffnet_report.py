"""Time value, Jacobian and Hessian of one pass against jax.hessian of the same network, float32, batch 512.

For n inputs and one output, all compute value, gradient and Hessian of a network for every sample, and the gradient
with respect to its parameters of a loss that reads all three, which is a training step without its optimiser. The
rivals are jax.grad and jax.hessian, of a plain network in jax.numpy and of this library's `value`, to which the
formulas of its activations already give faster derivatives. Repetitions of all programs take turns, so that a busy
machine slows all alike; medians are compared. Prints a table and writes report.json.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.cli.stored_arguments import stored_arguments
from scripts.reports.case import report_cases
from scripts.reports.differential_networks.one_pass import PLAIN, cases


@dataclass(frozen=True)
class Arguments(Folder):
    """What to time."""

    width: int = 128
    """Hidden units per layer."""
    depth: int = 2
    """Hidden layers."""
    batch: int = 512
    """Samples at once."""
    activation: Annotated[str, choice(PLAIN)] = "tanh"
    """Activation of the hidden layers."""
    repetitions: int = 30
    """Timed calls of each program."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    names_in("--activation", options.activation, PLAIN)
    chosen = cases(**stored_arguments(options))
    network = f"{options.depth} layers of {options.width}, {options.activation}, batch {options.batch}"
    timed = f"medians of {options.repetitions} interleaved calls, gradient of the training loss included"
    report_cases(options, "diffnet_report", chosen, dtype="float32", network=network, timed=timed)
