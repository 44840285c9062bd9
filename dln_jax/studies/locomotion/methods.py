"""What each method needs until a creature travels one body length."""

import math

from dln_jax.locomotion import comparison
from dln_jax.locomotion.learning import Record
from dln_jax.studies.report import Row


def comparison_rows(creature: str, curves: dict[str, list[list[Record]]], *, goal: float, seed: int) -> list[Row]:
    """What each method needs for one body length, and the ratios to gradients.

    Args:
        creature: its name; only the crawler's numbers have bounds.
        curves: by method, the records of each seed.
        goal: distance in body lengths.
        seed: the first.
    """
    rows, needed = [], {}
    crawls = creature == "crawler"
    for method, seeds in curves.items():
        case = f"{creature}/{method}"
        for number, records in enumerate(seeds):
            first = comparison.first_reaching(records, goal)
            steps = math.nan if first is None else float(first.steps)
            rows.append(Row(case, f"environment_steps_to_one_body_length_seed_{seed + number}", steps, "1"))
        median = comparison.median_to_reach(seeds, goal, "steps")
        seconds = comparison.median_to_reach(seeds, goal, "seconds")
        needed[method] = float(max(r[-1].steps for r in seeds)) if math.isinf(median) else median
        rows.append(Row(case, "environment_steps_to_one_body_length", median, "1"))
        bound = 60.0 if method == "gradient" and crawls else None
        rows.append(Row(case, "seconds_to_one_body_length", seconds, "s", bound=bound))
    for method in curves:
        if method != "gradient":
            ratio, bound = needed[method] / needed["gradient"], 3.0 if crawls else None
            name = "environment_steps_ratio_to_gradient"
            rows.append(Row(f"{creature}/{method}", name, ratio, "1", bound=bound, at_least=True))
    return rows
