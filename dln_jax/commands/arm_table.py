"""Train every model of the two-link arm on both published data sets, and print the results beside the published ones.

Six models (structured and black-box Lagrangian, structured and black-box Hamiltonian, feed-forward, trigonometric), two
data sets (letters: train 17, test e, q, v; random states: test three free swings), several seeds in one program; also
on other splits of the letters, each a test once, and on states over the whole circle, which no letter holds.
Prints a Markdown table, writes it as table.md with report.json, and draws error against training time.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from dln_jax.command_line.arguments import Unstated
from dln_jax.command_line.running import stored_arguments, with_stored_arguments
from dln_jax.data.splits import Split, partition_labels, split
from dln_jax.figures.dynamics import error_against_time
from dln_jax.files import CONFIG, is_file, matches, read_json, run_folder, write_bytes, write_figure, write_json
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.studies.arm.data import letters, published_split, states
from dln_jax.studies.arm.models import (
    Curve,
    gauss_newton_rows,
    measure_adam,
    measure_seeds,
    measure_split,
    measure_trigonometric,
    plant_rows,
)
from dln_jax.studies.arm.published import COLUMNS, PUBLISHED, published
from dln_jax.studies.jobs import JOBS, REMEDY, numbers_of
from dln_jax.studies.report import Row, conditions, write_report
from dln_jax.studies.report_table import print_report
from dln_jax.types import InputError, require_positive
from dln_jax.zoo.kinds import KINDS

MODELS = (*PUBLISHED, "trigonometric")
LAGRANGIAN = "structured-delan"
STRUCTURED = (LAGRANGIAN, "structured-hnn")
STRUCTURED_FACTOR = 100.0
"""By how much the structured models are to beat their published rows."""
FROM_MOMENTA = "torque_from_momenta_mse"
VPT_SHARE = 0.98
"""Of the true plant's valid prediction time, that a structured model is to reach."""


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    data: Unstated[Path] = None
    """Letters written by the two-link arm, in the npz schema (default: the embedded ones)."""
    uniform: Unstated[Path] = None
    """Training states of the arm, in the npz schema (default: 3,000 generated ones)."""
    seeds: int = 5
    """Seeds of each model, in one program."""
    splits: int = 7
    """Further splits of the letters: permuted and cut into so many tests, each letter in one; 0 leaves them out."""
    split_seeds: int = 3
    """Seeds of the structured Lagrangian on each of them; other models have one."""
    steps: Unstated[int] = None
    """Iterations of Gauss-Newton (default: what each model's validation error takes to level off)."""
    adam_steps: int = 20_000
    """Steps of Adam, 64x64 networks, one seed, on the letters; 0 leaves Adam out."""
    timed_seeds: int = 5
    """Structured models that are trained one by one, to time Gauss-Newton; 0 leaves them out."""
    out: Unstated[Path] = None
    """Folder for report.json, table.md and the figure (default: runs/arm_table-1, -2, ...)."""
    resume: bool = False
    """Continue the measurement in --out."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    console = Console(highlight=False, soft_wrap=True)
    if given.resume:
        given = with_stored_arguments(given)
    require_positive(seeds=given.seeds, split_seeds=given.split_seeds)
    if given.steps is not None:
        require_positive(steps=given.steps)
    written = letters(given.data)
    sets = {"characters": published_split(written), "uniform": states(given.uniform)}
    tests = partition_labels(written, given.splits) if given.splits else []
    with run_folder(given.out, "arm_table", resume=given.resume) as folder:
        measure_into(folder, given, sets, [split(written, test=labels) for labels in tests], console)


def measure_into(folder: Path, given: Arguments, sets: dict[str, Split], parts: list[Split], console: Console) -> None:
    """Measures what has not been measured yet, and writes and prints the table."""
    jobs = {}
    for dataset, data in sets.items():
        jobs[f"plant/{dataset}"] = lambda data=data: plant_rows(two_link_arm(), data)
        jobs[f"trigonometric/{dataset}"] = lambda data=data: measure_trigonometric(data)
        for kind in PUBLISHED:
            jobs[f"{kind}/{dataset}"] = lambda kind=kind, data=data: measure_seeds(
                kind, data, seeds=given.seeds, steps=given.steps
            )
    for kind in MODELS:
        for number, part in enumerate(parts):
            jobs[split_case(kind, number)] = lambda kind=kind, part=part: measure_split(
                kind, part, seeds=given.split_seeds if kind == LAGRANGIAN else 1, steps=given.steps
            )
    if given.timed_seeds:
        jobs["structured-delan/characters/gauss-newton"] = lambda: gauss_newton_rows(
            sets["characters"], seeds=given.timed_seeds, steps=given.steps
        )
    if given.adam_steps:
        for kind in PUBLISHED:
            jobs[f"{kind}/characters/adam"] = lambda kind=kind: measure_adam(
                kind, sets["characters"], steps=given.adam_steps
            )
    found = stored_results(folder, list(jobs)) if given.resume else {}
    write_json(folder / CONFIG, stored_arguments(given))
    # What is most likely wanted comes first, so that an interrupted table has it.
    for number, case in enumerate(sorted(jobs, key=lambda case: not case.startswith(("plant", LAGRANGIAN))), start=1):
        if case not in found:
            numbers, curve = jobs[case]()
            found[case] = {"numbers": numbers, "curve": curve._asdict() if curve else None}
            write_json(folder / JOBS, found)
        console.print(f"{number}/{len(jobs)}  {case:44s} {summary(found[case]['numbers'])}")
    numbers = {case: found[case]["numbers"] for case in jobs}
    numbers |= {f"{kind}/characters/splits": over_splits(kind, numbers, len(parts)) for kind in MODELS if parts}
    rows = [row for case in numbers for row in rows_of(case, numbers)]
    facts = conditions(
        dtype="float64; adam float32",
        seeds=list(range(given.seeds)),
        selection="stopping by validation; sizes settled on seed 0 by validation, its test errors printed beside them",
        data="embedded letters" if given.data is None else given.data.name,
        statistics="medians over seeds; one program for all seeds of a model",
        splits=[" ".join(part.test.label[np.unique(part.test.trajectory)]) for part in parts],
    )
    write_report(folder / "report.json", rows, facts)
    table = markdown(numbers)
    write_bytes(folder / "table.md", table.encode())
    curves = {case: Curve(**result["curve"]) for case, result in found.items() if result["curve"]}
    write_figure(folder / "pareto.png", error_against_time({case: (c.seconds, c.errors) for case, c in curves.items()}))
    print_report([row for row in rows if row.bound is not None or row.reference is not None], facts)
    print(table)
    print(f"report: {folder / 'report.json'}, table: {folder / 'table.md'}, figure: {folder / 'pareto.png'}")


def stored_results(folder: Path, cases: list[str]) -> dict[str, Any]:
    """Numbers and curve of each case that has been measured; `InputError` for a damaged file."""
    path = folder / JOBS
    stored = read_json(path, remedy=REMEDY) if is_file(path) else {}
    known: dict[str, tuple[str, ...]] = {case: ("vpt_seconds",) if case.startswith("plant/") else () for case in cases}
    for dataset, kind in ((dataset, kind) for dataset in COLUMNS for kind in MODELS):
        known[f"{kind}/{dataset}"] = ("train_seconds", "parameters", "one_step_p50_us")
    found = {}
    for case, result in stored.items():
        numbers, curve = (result.get(key) for key in ("numbers", "curve")) if isinstance(result, dict) else (None, None)
        if curve is not None:
            points = list(curve.values()) if isinstance(curve, dict) and set(curve) == set(Curve._fields) else [None]
            if not all(isinstance(each, list) and all(matches(x, float | None) for x in each) for each in points):
                raise InputError(f"{path}: the curve of {case!r:.60} is none; {REMEDY}")
            curve = {key: [math.nan if x is None else x for x in each] for key, each in curve.items()}
        found[case] = {"numbers": numbers_of(path, case, numbers, known), "curve": curve}
    return found


def split_case(kind: str, number: int) -> str:
    """Name of a model on one of the further splits."""
    return f"{kind}/characters/split-{number + 1}"


def over_splits(kind: str, found: dict[str, dict[str, float]], count: int) -> dict[str, float]:
    """Median over the further splits of the test torque error, and the error of the worst single run."""
    parts = [found[split_case(kind, number)] for number in range(count)]
    return {
        "torque_mse_median": float(np.median([part["torque_mse"] for part in parts])),
        "torque_mse_worst": float(np.max([part["torque_mse_largest"] for part in parts])),
    }


def summary(numbers: dict[str, float]) -> str:
    """A line of the most telling numbers."""
    shown = ("torque_mse", "vpt_seconds", "train_seconds", "seconds_to_1e-08")
    return "  ".join(f"{key} {numbers[key]:.3g}" for key in shown if key in numbers)


def rows_of(case: str, found: dict[str, dict[str, float]]) -> list[Row]:
    """The report's rows of a case, with the published value and the bound where there are."""
    kind, dataset, *variant = case.split("/")
    rows = []
    for quantity, value in found[case].items():
        reference = published(kind, dataset, quantity) if not variant else None
        bound, at_least = None, False
        # Torques from recorded momenta are no better than the record, whatever the model; the sound ones are.
        figure = published(kind, dataset, FROM_MOMENTA) if quantity == "torque_mse" and not variant else None
        figure = reference if figure is None else figure
        if figure is not None and quantity.endswith("_mse"):
            bound = figure / (STRUCTURED_FACTOR if kind in STRUCTURED and quantity != FROM_MOMENTA else 1.0)
        if kind in STRUCTURED and quantity == "vpt_seconds" and not variant:
            ceiling = found[f"plant/{dataset}"]["vpt_seconds"]
            bound, at_least = VPT_SHARE * ceiling, True
        bound = BOUNDS.get((case, quantity), bound)
        rows.append(Row(case, quantity, value, unit(quantity), reference, bound, at_least=at_least))
    return rows


BOUNDS = {
    **{
        ("structured-delan/characters/gauss-newton", f"seconds_to_{error:g}"): seconds
        for error, seconds in ((1.35e-5, 7.0), (1e-8, 20.0), (1e-9, 40.0), (1e-10, 110.0))
    },
    ("structured-delan/characters/gauss-newton", "torque_mse_largest"): 1e-8,
    ("structured-delan/characters/gauss-newton", "cost_of_ten_seeds"): 8.0,
    ("trigonometric/characters", "torque_mse"): 1e-20,
    ("trigonometric/characters", "train_seconds"): 1.0,
    ("trigonometric/characters", "noisy_torque_mse"): 5e-5,
}


def unit(quantity: str) -> str:
    """SI unit of a quantity, by its name."""
    if "seconds" in quantity:
        return "s"
    if "_mse" in quantity:
        return "1/s^4" if quantity.startswith("forward") else "W^2" if quantity.startswith("power") else "N^2 m^2"
    return "us" if quantity.endswith("_us") else "J" if quantity.endswith("_j") else "1"


def markdown(found: dict[str, dict[str, float]]) -> str:
    """The published table's columns, ours beside the published numbers, and what each model costs."""
    published_columns = [(dataset, quantity) for dataset, quantities in COLUMNS.items() for quantity in quantities]
    extra = [*((dataset, FROM_MOMENTA) for dataset in COLUMNS), ("characters", "whole_circle_torque_mse")]
    columns = [*published_columns, *extra]
    heads = [f"{dataset} {quantity.replace('_', ' ')}" for dataset, quantity in columns]
    heads += ["other splits: median, worst", "training, s", "parameters", "one step, µs"]
    lines = ["| model | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for kind in [*MODELS, "plant"]:
        cells = []
        for dataset, quantity in columns:
            ours, theirs = found[f"{kind}/{dataset}"].get(quantity), published(kind, dataset, quantity)
            number = "{:.2f}" if quantity == "vpt_seconds" else "{:.1e}"
            cells.append(" / ".join(number.format(x) for x in (ours, theirs) if x is not None))
        splits = found.get(f"{kind}/characters/splits", {})
        cells.append(", ".join(f"{error:.1e}" for error in splits.values()))
        costs = found[f"{kind}/characters"]
        shown = {"train_seconds": ".1f", "parameters": ".0f", "one_step_p50_us": ".0f"}
        cells += [format(costs[key], form) if key in costs else "" for key, form in shown.items()]
        lines.append(f"| {kind} | " + " | ".join(cells) + " |")
    zero = found["plant/characters"]["whole_circle_torque_mean_square"]
    lines.append(f"\nours / published; medians over seeds. Mean square of torques, whole circle: {zero:.0f} (N m)².\n")
    return "\n".join(lines)


assert set(PUBLISHED) <= set(KINDS)
