"""The table of the arm: all models on both published data sets and on further splits of the letters.

Numbers are compared with published ones, and structured models also with the true plant's valid prediction time.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split, select, split
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.datasets.generators import CHARACTERS_TEST, default_data
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.types import InputError
from scripts.reports.arm.models import (
    TRIGONOMETRIC,
    WIDTHS,
    measure_adam,
    measure_one_by_one,
    measure_plant,
    measure_seeds,
    measure_split,
    measure_trigonometric,
)
from scripts.reports.arm.published_swings import uniform_tests
from scripts.reports.case import Case, Findings, by_case, rows_in, rows_of
from scripts.reports.parts import partition_labels
from scripts.reports.published import ARM, published
from scripts.reports.rows import UNITS, Row, unit_of

MODELS = (*WIDTHS, TRIGONOMETRIC)
LAGRANGIAN = "structured-delan"
STRUCTURED = (LAGRANGIAN, "structured-hnn")
STRUCTURED_FACTOR = 100.0
"""Structured models must beat the published errors by this factor."""
FROM_MOMENTA = "torque_from_momenta_mse"
SHOWN = (
    *("torque_mse", FROM_MOMENTA, "inertial_mse", "coriolis_mse", "gravity_mse", "vpt_seconds"),
    *("whole_circle_torque_mse", "torque_mse_median", "torque_mse_worst", "train_seconds", "parameters"),
    "one_step_p50_us",
)
"""Quantities of the Markdown table."""
VPT_SHARE = 0.98
"""Share of the true plant's valid prediction time that a structured model must reach."""
ARM_UNITS = {**UNITS, "forward_mse": "1/s^4", "power_mse": "W^2", "mse": "N^2 m^2"}
BOUNDS = {
    "structured-delan/characters/gauss-newton": {
        **{"seconds_to_1.35e-05": 7.0, "seconds_to_1e-08": 20.0, "seconds_to_1e-09": 40.0, "seconds_to_1e-10": 110.0},
        **{"torque_mse_largest": 1e-8, "cost_of_ten_seeds": 8.0},
    },
    "trigonometric/characters": {"torque_mse": 1e-20, "train_seconds": 1.0, "noisy_torque_mse": 5e-5},
}
"""Bounds that do not follow from published numbers or from the plant's."""


def letters(path: Path | None) -> Trajectories:
    """The letters of the arm, embedded or from a file."""
    return _of_the_arm(path, default_data(two_link_arm()) if path is None else schema.load(path))


def published_split(written: Trajectories) -> Split:
    """Splits the letters with the published test letters as the test set."""
    return split(written, test=CHARACTERS_TEST)


def states(path: Path | None, *, samples: int = 3_000, validation: int = 300) -> Split:
    """Random states of the arm for training, and the published free swings for the test."""
    data = _of_the_arm(path, generators.uniform(two_link_arm(), samples=samples) if path is None else schema.load(path))
    present = np.random.default_rng(0).permutation(np.unique(data.trajectory))
    held_out = present[: min(validation, max(1, len(present) // 10))]
    return Split(select(data, np.setdiff1d(present, held_out)), select(data, held_out), uniform_tests())


def _of_the_arm(path: Path | None, data: Trajectories) -> Trajectories:
    if data.degrees_of_freedom != 2:
        raise InputError(f"{path} has {data.degrees_of_freedom} coordinates; the table is that of the two-link arm")
    return data._replace(needs=two_link_arm().needs)


def data_sets(data: Path | None, uniform: Path | None, splits: int) -> tuple[dict[str, Split], list[Split]]:
    """Both published data sets, and further splits of the letters, whose test sets partition the letters."""
    written = letters(data)
    tests = partition_labels(written, splits) if splits else []
    sets = {"characters": published_split(written), "uniform": states(uniform)}
    return sets, [split(written, test=labels) for labels in tests]


def cases(
    sets: Mapping[str, Split] | None = None,
    parts: Sequence[Split] = (),
    *,
    seeds: int = 5,
    split_seeds: int = 3,
    steps: int | None = None,
    adam_steps: int = 20_000,
    timed_seeds: int = 5,
) -> list[Case]:
    """Cases of the table on data sets (default: the embedded ones) and further splits, both from `data_sets`.

    One program trains `seeds` of a model. A further split trains `split_seeds` of the structured Lagrangian and one of
    the other models. `timed_seeds` structured models are trained one by one; `adam_steps` is the number of Adam steps
    on the letters; 0 leaves out either. `steps` of Gauss-Newton default to `STEPS`.
    """
    sets = data_sets(None, None, 0)[0] if sets is None else sets
    costs = ("train_seconds", "parameters", "one_step_p50_us")
    listed = []
    for name, data in sets.items():
        ceilings = ("vpt_seconds", "whole_circle_torque_mean_square")
        listed.append(_case(f"plant/{name}", partial(measure_plant, two_link_arm(), data), ceilings))
        listed.append(_case(f"{TRIGONOMETRIC}/{name}", partial(measure_trigonometric, data), costs))
        for kind in WIDTHS:
            listed.append(_case(f"{kind}/{name}", partial(measure_seeds, kind, data, seeds=seeds, steps=steps), costs))
    for kind in MODELS:
        count = split_seeds if kind == LAGRANGIAN else 1
        for number, part in enumerate(parts):
            measure = partial(measure_split, kind, part, seeds=count, steps=steps)
            name = f"{kind}/characters/split-{number + 1}"
            listed.append(_case(name, measure, ("torque_mse", "torque_mse_largest")))
    written = sets["characters"]
    if timed_seeds:
        measure = partial(measure_one_by_one, written, seeds=timed_seeds, steps=steps)
        listed.append(_case(f"{LAGRANGIAN}/characters/gauss-newton", measure))
    for kind in WIDTHS if adam_steps else ():
        listed.append(_case(f"{kind}/characters/adam", partial(measure_adam, kind, written, steps=adam_steps)))
    return listed


def _case(name: str, measure: Callable[[], dict[str, float]], quantities: Sequence[str] = ()) -> Case:
    return Case(name, lambda: Findings(rows_of(name, measure())), {name: quantities})


def table_rows(results: Mapping[str, Findings]) -> list[Row]:
    """All numbers with their published values and bounds, and summaries of the models over the splits."""
    numbers = by_case(rows_in(results))
    numbers |= {f"{kind}/characters/splits": summary for kind in MODELS if (summary := over_splits(kind, numbers))}
    return [_beside(row, numbers) for case in numbers for row in rows_of(case, numbers[case])]


def over_splits(kind: str, numbers: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Median test torque error over the further splits, and the error of the worst single run."""
    parts = [split for case, split in numbers.items() if case.startswith(f"{kind}/characters/split-")]
    if not parts:
        return {}
    return {
        "torque_mse_median": float(np.median([part["torque_mse"] for part in parts])),
        "torque_mse_worst": float(np.max([part["torque_mse_largest"] for part in parts])),
    }


def _beside(row: Row, numbers: Mapping[str, Mapping[str, float]]) -> Row:
    """Adds unit, published reference and bound to a row; bounds come from published numbers or from the plant."""
    kind, dataset = row.case.split("/")[:2]
    reference = published(ARM, row.case, row.quantity)
    # Published torques from recorded momenta are limited by the record; their error bounds ours instead.
    of_momenta = published(ARM, row.case, FROM_MOMENTA) if row.quantity == "torque_mse" else None
    bound = reference if of_momenta is None else of_momenta
    if row.quantity == "vpt_seconds":
        of_structure = kind in STRUCTURED and row.case == f"{kind}/{dataset}"
        bound = VPT_SHARE * numbers[f"plant/{dataset}"]["vpt_seconds"] if of_structure else None
    elif bound is not None and kind in STRUCTURED and row.quantity != FROM_MOMENTA:
        bound /= STRUCTURED_FACTOR
    return row._replace(
        unit=unit_of(row.quantity, ARM_UNITS),
        reference=reference,
        bound=BOUNDS.get(row.case, {}).get(row.quantity, bound),
        at_least=row.quantity == "vpt_seconds" and bound is not None,
    )
