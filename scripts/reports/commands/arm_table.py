"""Train every model of the two-link arm on both published data sets, and print the results beside the published ones.

Six models (structured and black-box Lagrangian, structured and black-box Hamiltonian, feed-forward, trigonometric), two
data sets (letters: train 17, test e, q, v; random states: test three free swings), several seeds in one program; also
on other splits of the letters, each a test once, and on states over the whole circle, which no letter holds.
Prints a Markdown table, and writes it as table.md with report.json.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dln_jax.cli.arguments import Unstated, require_positive_if_given
from dln_jax.cli.options import Resumable
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.files import write_bytes
from dln_jax.types import InputError
from scripts.reports.arm import table
from scripts.reports.case import Case, measure, say_numbers
from scripts.reports.rows import conditions, markdown, publish


@dataclass(frozen=True)
class Arguments(Resumable):
    """What to measure."""

    data: Unstated[Path] = None
    """Letters written by the two-link arm, in the npz schema (default: the embedded ones)."""
    uniform: Unstated[Path] = None
    """Training states of the arm, in the npz schema (default: 3,000 generated ones)."""
    seeds: int = 5
    """Seeds of each model, in one program."""
    splits: int = 7
    """Number of further splits: the permuted letters are cut into this many tests, each letter in one; 0 for none."""
    split_seeds: int = 3
    """Seeds of the structured Lagrangian on each further split; other models have one."""
    steps: Unstated[int] = None
    """Iterations of Gauss-Newton (default: 150; then the validation errors have levelled off)."""
    adam_steps: int = 20_000
    """Steps of Adam for one seed of 64x64 networks on the letters; 0 leaves Adam out."""
    timed_seeds: int = 5
    """Structured models that are trained one by one, to time Gauss-Newton; 0 leaves them out."""


def main(options: Arguments) -> None:
    """Measures the cases that are not stored yet, prints the table and writes it."""
    require_positive_if_given(options, ("seeds", "split_seeds", "steps"))
    counts = {key: getattr(options, key) for key in ("seeds", "split_seeds", "steps", "adam_steps", "timed_seeds")}
    for name in ("splits", "adam_steps", "timed_seeds"):
        if getattr(options, name) < 0:
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option} is {getattr(options, name)}; expected a whole number, 0 or more")
    sets, parts = table.data_sets(options.data, options.uniform, options.splits)
    cases = table.cases(sets, parts, **counts)
    with command_folder(options, "arm_table") as folder:
        say = say_numbers("torque_mse", "vpt_seconds", "train_seconds", "seconds_to_1e-08")
        results = measure(sorted(cases, key=_late), say, folder=folder, resume=options.resume)
        rows = table.table_rows({case.name: results[case.name] for case in cases})
        facts = conditions(
            dtype="float64; adam float32",
            seeds=list(range(options.seeds)),
            selection="stopping by validation; sizes settled on seed 0 by validation, its test errors printed beside "
            "them",
            data="embedded letters" if options.data is None else options.data.name,
            statistics="medians over seeds; one program for all seeds of a model",
            splits=[" ".join(part.test.label[np.unique(part.test.trajectory)]) for part in parts],
        )
        shown = markdown([row for row in rows if row.quantity in table.SHOWN])
        write_bytes(folder / "table.md", shown.encode())
        beside = [row for row in rows if row.bound is not None or row.reference is not None]
        publish(folder, rows, facts, shown=beside, tables=[shown])
        print(f"table: {folder / 'table.md'}")


def _late(case: Case) -> bool:
    """Sort key that puts the most important cases first, so that an interrupted table has them."""
    return not case.name.startswith(("plant", table.LAGRANGIAN))
