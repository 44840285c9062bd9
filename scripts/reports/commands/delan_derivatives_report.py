"""Measure two ways to the derivatives in a structured DeLaN's inverse dynamics, for each number of joints.

The jvp/vjp way differentiates the Cholesky network once along the motion and pulls one vector back through it; the
one-pass way carries all d partial derivatives of both networks forward (`nn.differential_mlp`). Training steps are
gradients of the torque loss at batch 512, single calls are one state. `mechanics.natural` follows the outcome.
"""

from dataclasses import dataclass

from dln_jax.cli.options import Folder
from scripts.reports.case import report_cases
from scripts.reports.speed.derivatives import cases


@dataclass(frozen=True)
class Arguments(Folder):
    """How long to measure."""

    repetitions: int = 40
    """Interleaved timings of each way; the median counts."""
    width: int = 64
    """Hidden units of the two layers of each network."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    chosen = cases(width=options.width, repetitions=options.repetitions)
    timed = "default jit, compilation apart, results waited for"
    report_cases(options, "delan_derivatives_report", chosen, dtype="float32", seeds=[0], call_path=timed)
