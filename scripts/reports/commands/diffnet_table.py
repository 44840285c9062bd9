"""Train differential networks with all activations, losses and optimisers of the published table, beside its numbers.

Both functions, sin and cos_sin, with the published noise; small networks by Gauss-Newton, whose widths are grown by
validation, and the published wide ones by Adam. Prints the table and writes report.json.
"""

from dataclasses import dataclass
from typing import ClassVar

from dln_jax.cli.options import Resumable
from dln_jax.cli.stored_arguments import command_folder, stored_arguments
from dln_jax.learning.functions import WIDTHS
from dln_jax.types import require_seed
from scripts.reports.case import measure, rows_in, say_numbers
from scripts.reports.differential_networks.table import QUANTITIES, cases, table_rows
from scripts.reports.rows import conditions, markdown, publish


@dataclass(frozen=True)
class Arguments(Resumable):
    """What to measure."""

    MEASURES_COMPILATION: ClassVar = True

    samples: int = 25_600
    """Samples of each function."""
    steps: int = 40
    """Gauss-Newton: largest number of iterations on all samples, per network."""
    coarse_steps: int = 200
    """Gauss-Newton: largest number of iterations before those, on 2,048 samples if there are twice as many; 0 for
    none."""
    epochs: int = 500
    """Adam: passes over the data."""
    seed: int = 0
    """Seed for data, validation split, initial parameters and shuffling (0 to 4294967295)."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    require_seed(options.seed)
    chosen = cases(**stored_arguments(options))
    with command_folder(options, "diffnet_table") as folder:
        say = say_numbers(*QUANTITIES, "width", "job_seconds")
        rows = table_rows(rows_in(measure(chosen, say, folder=folder, resume=options.resume)))
        samples = f"{options.samples} (published: 25,600), noise sd 1e-3 on x, f and gradient, a tenth for validation"
        facts = conditions(
            dtype="float64 for gauss-newton, float32 for adam",
            seeds=[options.seed],
            adam=f"{options.epochs} epochs (published: 500), 128 units per layer, batch 512",
            gauss_newton=f"{options.coarse_steps} iterations on 2,048 samples and {options.steps} on all, at most; "
            f"width grown through {', '.join(map(str, WIDTHS))} by validation",
            selection="widths and stopping by validation; best of a row over losses and activations, as published",
            samples=samples,
        )
        tables = [
            f"mean squared errors on the clean grid, ours / published; {samples}",
            markdown([row for row in rows if row.quantity in QUANTITIES]),
        ]
        publish(folder, rows, facts, shown=[row for row in rows if row.bound is not None], tables=tables)
        print("ReLU: the Hessian of a ReLU network is zero almost everywhere, its error that of predicting zero.")
