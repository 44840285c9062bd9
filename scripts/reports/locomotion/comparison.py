"""Rows of methods of learning to move, compared by their cost until a creature travels five body lengths."""

import math

from dln_jax.locomotion.learning import Record
from dln_jax.training.locomotion import first_reaching, median_to_reach
from scripts.reports.rows import Row


def comparison_rows(creature: str, curves: dict[str, list[list[Record]]], *, goal: float, seed: int) -> list[Row]:
    """Steps and seconds of the methods, and ratios to gradients; only the crawler's numbers have bounds.

    `curves` holds, by method, the records of successive seeds starting at `seed`; `goal` is in body lengths.
    """
    rows, needed, crawls, steps = [], {}, creature == "crawler", "environment_steps_to_five_body_lengths"
    for method, seeds in curves.items():
        case = f"{creature}/{method}"
        for number, records in enumerate(seeds, start=seed):
            first = first_reaching(records, goal)
            rows.append(Row(case, f"{steps}_seed_{number}", math.nan if first is None else float(first.steps)))
        median, seconds = (median_to_reach(seeds, goal, field) for field in ("steps", "seconds"))
        needed[method] = float(max(r[-1].steps for r in seeds)) if math.isinf(median) else median
        bound = 60.0 if method == "gradient" and crawls else None
        rows += [Row(case, steps, median), Row(case, "seconds_to_five_body_lengths", seconds, "s", bound=bound)]
    name, bound = "environment_steps_ratio_to_gradient", 3.0 if crawls else None
    ratios = {method: needed[method] / needed["gradient"] for method in curves if method != "gradient"}
    rows += [Row(f"{creature}/{method}", name, ratio, bound=bound, at_least=True) for method, ratio in ratios.items()]
    return rows
