"""Measure the verdict on fitted robots and motions: sound logs must be good, spoiled ones refused.

Each log is identified as the command identify does, from a robot's file with rough masses; logs of two joints are also
fitted by a tree of unknown frames, as train_delan does without a file. Files of motions are fitted by train_hnn_task:
sound plants, and ones that no model describes. Prints one table (case, quantity, expected, value, unit, to reach, pass)
and writes report.json.
"""

from dataclasses import dataclass

from dln_jax.cli.options import Folder
from dln_jax.types import require_positive, require_seed
from scripts.reports.case import report_cases
from scripts.reports.hamiltonian import motion_verdicts
from scripts.reports.robots.verdicts import cases


@dataclass(frozen=True)
class Arguments(Folder):
    """How many logs."""

    logs: int = 6
    """Number of sound logs, each of an arm of its own; each is then spoiled in every way."""
    learned: int = 2
    """Number of logs for trees of unknown frames; a fit takes a minute or two."""
    motions: int = 1
    """Number of files of motions of every plant; a fit takes a minute or two."""
    seed: int = 100
    """Seed of the first arm; thresholds were chosen by seeds below 100."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(logs=options.logs, motions=options.motions)
    require_seed(options.seed)
    chosen = cases(options.logs, options.learned, options.seed)
    chosen += motion_verdicts.cases(options.motions, options.seed)
    report_cases(options, "verdicts", chosen, dtype="float64", seeds=[options.seed, options.seed + options.logs - 1])
