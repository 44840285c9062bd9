"""Train Hamiltonian models and baselines on the published tasks, and print their errors beside the published ones.

Tasks: spring, pendulum, real-pendulum, two-body, three-body and pixels. Models: what suits the scene (separable-hnn
or pairwise-hnn, with friction where it has it), black-box-hnn (one network is H), phase-network (one gives the rates).
Each is trained on the published data (those of seed 0) from several seeds; numbers are medians over these. Prints a
table, writes report.json and table.md, and draws each task's motions and energies.

--own FOLDER compares instead: files TASK-SEED.npz of the published protocols, learned as own data (train_hnn_task
--task measured) with their needs stated and without, beside the named tasks on the same starts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

from dln_jax.cli.arguments import Unstated, choice, names_in, refuse_given, require_positive_if_given
from dln_jax.cli.options import Drawn, Resumable
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.files import write_bytes
from dln_jax.training.hamiltonian.tasks import REAL, problem_of
from dln_jax.training.hamiltonian.training import RECIPES
from dln_jax.types import InputError
from scripts.reports.case import measure, rows_in, say_numbers
from scripts.reports.hamiltonian.own_files import QUANTITIES, own_cases, with_bounds
from scripts.reports.hamiltonian.table import PIXELS, SHOWN, TASKS, cases, table_rows
from scripts.reports.rows import Row, conditions, markdown, publish


@dataclass(frozen=True)
class Arguments(Resumable, Drawn):
    """What to measure."""

    MEASURES_COMPILATION: ClassVar = True

    tasks: Annotated[str, choice(TASKS, several=True)] = ",".join(TASKS)
    """Tasks (default: all)."""
    real_pendulum: Unstated[Path] = None
    """The measured pendulum (Schmidt and Lipson 2009) in the npz schema; without it that task is left out."""
    seeds: int = 3
    """Seeds of each model: 0, 1, ..."""
    trajectories: Unstated[int] = None
    """Generated trajectories of each task, for a trial (default: as published)."""
    own: Unstated[Path] = None
    """Folder of files TASK-SEED.npz to be learned as own data; python -m tests.published_motions FOLDER writes some."""
    steps: Unstated[int] = None
    """Iterations of each fit (default: each task's own)."""


def main(options: Arguments) -> None:
    """Measures the cases that are not stored yet, prints the table and writes it."""
    if options.own is not None:
        compare_own_files(options, options.own)
        return
    names = chosen_tasks(options)
    counts = {key: getattr(options, key) for key in ("seeds", "steps", "trajectories", "real_pendulum")}
    cases(names, folder=None, **counts)  # refuses before anything is written
    with command_folder(options, "hnn_table") as folder:
        chosen = cases(names, folder=folder if options.figures else None, **counts)
        if REAL not in names and REAL in options.tasks.split(","):
            print(f"{REAL} is left out: its data are not part of this project; give them by --real-pendulum FILE")
        say = say_numbers("clean_field_mse", "energy_mse", "published_energy_mse", "train_seconds", "compile_seconds")
        rows = table_rows(rows_in(measure(chosen, say, folder=folder, resume=options.resume)))
        facts = conditions(
            dtype="float64",
            seeds=list(range(options.seeds)),
            selection="parameters by validation trajectories alone; sizes and budgets are the same for all seeds",
            data="published protocols, seed 0",
            limits="seconds of a training, compilation included: "
            + ", ".join(f"{name} {RECIPES[name].seconds:g}" for name in names if name != PIXELS),
            statistics="medians over seeds; compilation is apart from train_seconds",
        )
        publish_table(folder, rows, facts, SHOWN)


def publish_table(folder: Path, rows: Sequence[Row], facts: Mapping[str, Any], shown: Sequence[str]) -> None:
    """Writes report.json and table.md, and prints the quantities that are `shown`."""
    listed = [row for row in rows if row.quantity in shown]
    write_bytes(folder / "table.md", markdown(listed).encode())
    publish(folder, rows, facts, shown=listed, tables=[markdown(listed)])
    print(f"table: {folder / 'table.md'}")


def compare_own_files(options: Arguments, own: Path) -> None:
    """Compares own files with the named tasks."""
    refuse_given(options, ["trajectories", "real_pendulum"], "for the table without --own")
    require_positive_if_given(options, ["seeds", "steps"])
    counts = {"seeds": options.seeds, "steps": options.steps}
    chosen = own_cases(own, names_in("--tasks", options.tasks, TASKS), **counts, report=partial(print, flush=True))
    with command_folder(options, "hnn_table") as folder:
        results = measure(chosen, say_numbers(*QUANTITIES), folder=folder, resume=options.resume)
        facts = conditions(
            dtype="float64",
            seeds=list(range(options.seeds)),
            data="named tasks: published protocols, seed 0; own files: " + str(own),
            statistics="median and largest over seeds of the named task, and over files; the same test starts",
        )
        publish_table(folder, with_bounds(rows_in(results)), facts, QUANTITIES)


def chosen_tasks(options: Arguments) -> list[str]:
    """The tasks whose data are available; checks the data before anything is written."""
    names = names_in("--tasks", options.tasks, TASKS)
    if options.real_pendulum is None:
        names = [name for name in names if name != REAL]
        if not names:
            raise InputError(f"{REAL} needs its data, which are not part of this project; give --real-pendulum FILE")
    elif REAL in names:
        problem_of(REAL, data=options.real_pendulum)
    return names
