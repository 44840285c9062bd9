"""Evaluate a stored model of dynamics on another log.

The model comes from a run of train_delan, train_hnn or identify. All trajectories of the log are the test set; nothing
is fitted. The table reports errors, rollouts and speed. The run folder gets metrics, figures and verdict.
"""

from dataclasses import dataclass
from pathlib import Path

from dln_jax.options import Drawn, Filtered, Folder


@dataclass(frozen=True, kw_only=True)
class Arguments(Drawn, Folder, Filtered):
    """The model, the log, and where the results go."""

    run: Path
    """Folder of the run that holds the model."""
    data: Path
    """Trajectories, npz, CSV or ROS bag."""


def main(options: Arguments) -> None:
    """Evaluates the model, and writes the run folder; `InputError` for a log of another plant."""
    from dln_jax.data.log import read_log
    from dln_jax.runs.arguments import facts
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.report import finish
    from dln_jax.runs.training import evaluate
    from dln_jax.zoo.run import load

    run = load(options.run)
    log = read_log(options.data, **facts(options))
    with command_folder(options, "evaluate") as folder:
        for line in log.remarks:
            print(line)
        finish(folder, options, evaluate(run, log))
