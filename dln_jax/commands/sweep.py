"""Run one command over a grid of its options, each combination as a job of its own, here, by Slurm or by Ray.

The grid is for example 'width=8,16 seed=0:10 data=a.npz,b.npz': commas separate values, a:b and a:b:step are whole
numbers without b, and all combinations run. Options are checked before anything starts. A sweep's folder gets a folder
for each job, table.csv with all their metrics, sweep.json and sweep.png: error against seconds, and the best by
validation alone. Jobs that fail are listed with their error message, and the exit status is 1; --resume runs only the
jobs that are not done. slurm needs the extra [sweep], ray the extra [ray]; hosts must share the sweep's folder.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from dln_jax.commands import COMMANDS
from dln_jax.options import Unstated
from dln_jax.runs.options import Resumable


@dataclass(frozen=True)
class Arguments(Resumable):
    """What to run, where to run it, and how to compare the jobs."""

    CHANGEABLE: ClassVar = ("where", "jobs", "gpus", "slurm", "metric", "best", "error", "over")

    command: str = "train_delan"
    """The command of every job."""
    grid: Unstated[str] = None
    """Options and their values: 'width=8,16 seed=0:10'."""
    fixed: str = ""
    """Options that all jobs have: 'steps=500 figures=no test=e,q,v'; a comma is part of the value."""
    where: Unstated[Literal["here", "slurm", "ray", "later"]] = None
    """What runs the jobs: processes on this machine, an array of the Slurm cluster, or Ray. later only writes the jobs'
    command lines, for any other scheduler (default: here)."""
    jobs: Unstated[int] = None
    """Jobs at once (default: as many as there are cores; with Slurm, as many as it allows). Jobs that run side by side
    slow each other down."""
    gpus: Unstated[int] = None
    """here and ray: accelerators of this machine; each job has one to itself (default: 0, jobs see none)."""
    slurm: Unstated[str] = None
    """Options of sbatch: 'partition=gpu time=60 gpus_per_node=1', time in minutes (default: 60). A job that reaches its
    time limit is queued again and continues."""
    metric: Unstated[str] = None
    """Metric of metrics.json that chooses the best job (default: the command's validation error)."""
    best: Unstated[Literal["smallest", "largest"]] = None
    """Which --metric is the best (default: smallest)."""
    error: Unstated[str] = None
    """Metric that is shown beside it and does not affect the choice (default: the command's test error)."""
    over: Unstated[str] = None
    """Options, separated by commas, over which medians and the worst are taken (default: seed)."""


def main(options: Arguments) -> None:
    """Checks the grid, runs the jobs and shows the results; raises `SystemExit` with 1 if a job is not done."""
    from dln_jax.commands.sweeps.command import sweep

    sweep(options, COMMANDS)
