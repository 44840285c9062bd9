"""Kill training runs at random moments, resume them, and compare what they come to with the unbroken run, bit for bit.

Runs: gauss-newton and adam (train_delan), task (train_hnn_task, two stages), function (train_diffnet) and locomotion
(by gradients). Each is started anew for every kill (SIGKILL, at a moment drawn between its first checkpoint and its
end), resumed to the end, and its model file compared. Prints a count for each, and writes report.json.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.zoo.run_folder import run_folder
from scripts.reports.case import Done, measure, rows_in
from scripts.reports.rows import conditions, publish
from scripts.reports.stability.interruptions import RUNS, cases


@dataclass(frozen=True)
class Arguments(Folder):
    """What to interrupt."""

    runs: Annotated[str, choice(RUNS, several=True)] = ",".join(RUNS)
    """Runs (default: all)."""
    kills: int = 10
    """Of each run."""
    seed: int = 0
    """Of the moments."""


def main(given: Arguments) -> None:
    """Kills and resumes the runs, compares them with unbroken ones, prints and writes the counts."""
    chosen = cases(names_in("--runs", given.runs, RUNS), kills=given.kills, seed=given.seed)
    with run_folder(given.out, "interruptions") as folder:
        rows = rows_in(measure(chosen, say))
        publish(folder, rows, conditions(dtype="that of each run", seeds=[given.seed], kills=given.kills, runs=RUNS))


def say(done: Done) -> None:
    """Prints the result of one kind of run."""
    (row,), moments = done.findings
    shown = ", ".join(f"{moment:.2f}" for moment in moments["moments"])
    print(f"{row.case}: {row.value} of {row.bound} as the unbroken run; killed s after a checkpoint: {shown}")
