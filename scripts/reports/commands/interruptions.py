"""Kill training runs at random moments, resume them, and compare the models with that of the unbroken run, bit for bit.

Runs: gauss-newton and adam (train_delan), task (train_hnn_task, two stages), function (train_diffnet) and locomotion
(by gradients). Each is started anew for every kill (SIGKILL, at a moment drawn between its first checkpoint and its
end), resumed to the end, and its model file compared. Prints a count for each, and writes report.json.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Folder
from scripts.reports.case import report_cases
from scripts.reports.stability.interruptions import RUNS, cases


@dataclass(frozen=True)
class Arguments(Folder):
    """What to interrupt."""

    runs: Annotated[str, choice(RUNS, several=True)] = ",".join(RUNS)
    """Runs (default: all)."""
    kills: int = 10
    """Number of kills of each run."""
    seed: int = 0
    """Seed of the moments."""


def main(options: Arguments) -> None:
    """Kills and resumes the runs, compares them with unbroken ones, prints and writes the counts."""
    chosen = cases(names_in("--runs", options.runs, RUNS), kills=options.kills, seed=options.seed)
    facts = {"seeds": [options.seed], "kills": options.kills, "runs": RUNS}
    report_cases(options, "interruptions", chosen, dtype="that of each run", **facts)
