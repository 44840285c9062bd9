"""Train differential networks with all activations, losses and optimisers of the published table, beside its numbers.

Both functions, sin and cos_sin, with the published noise; small networks by Gauss-Newton, whose widths are grown by
validation, and the published wide ones by Adam. Prints the table and writes report.json.
"""

from dataclasses import dataclass
from typing import ClassVar

from dln_jax.command_line.options import Resumable
from dln_jax.command_line.running import command_folder
from dln_jax.studies.differential_networks.table import Extent, cases, measure_into
from dln_jax.types import require_seed


@dataclass(frozen=True)
class Arguments(Resumable):
    """What to measure."""

    MEASURES_COMPILATION: ClassVar = True

    samples: int = 25_600
    """Of each function."""
    steps: int = 40
    """Gauss-Newton: iterations on all samples at most, per network."""
    coarse_steps: int = 200
    """Gauss-Newton: iterations before those, at most, on 2,048 of the samples where there are twice as many; 0 for
    none."""
    epochs: int = 500
    """Adam: passes over the data."""
    seed: int = 0
    """Of the data, the validation split, the initial parameters and the shuffling; 0 to 4294967295."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_seed(given.seed)
    extent = Extent(*(getattr(given, name) for name in Extent._fields))
    chosen = cases(extent)
    with command_folder(given, "diffnet_table") as folder:
        measure_into(folder, chosen, extent, resume=given.resume)
