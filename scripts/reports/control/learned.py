"""Swing-ups by models learned from at most thirty seconds of simulated motion, over several seeds."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from dln_jax.control.closed_loop import Outcomes
from dln_jax.control.desktop_plants import PLANTS, DesktopPlant, Tried, desktop_plant, law_of, nominal_model, try_starts
from dln_jax.control.exploration import Excitation, explore
from dln_jax.metrics.report import Row, expect
from dln_jax.training.swing_ups.learned import Obtained, errors_along, obtain, test_motions
from dln_jax.types import InputError
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect

SECONDS_OF_DATA = 30.0
SEEDS = (0, 1, 2)
"""Seeds of exploration and network; a seed also sets the rough model, the noise and the starts."""
STARTS, SUCCESS = 1000, 0.995
TRY_SEED = 100
"""Offset of the seed for evaluated starts; the gains were chosen on other starts (`swing_up_gains`)."""
LEARNED = ("delan", "identified")


def by_model(name: str, model: str, quick: bool) -> Findings:
    """Results of swing-ups by a learned model: median and worst over seeds of the data."""
    plant, seeds = desktop_plant(name), SEEDS[:1] if quick else SEEDS
    found = [_of_seed(plant, model, seed, quick) for seed in seeds]
    case = f"learned/{name}/{model}"
    words = f"of {len(found[0][2].outcomes.seconds)} starts, the worst of {len(seeds)} recording(s) of 30 s"
    bound = SUCCESS if model == "delan" else None
    rows = _of_tries(case, [tried for *_, tried in found], words, bound)
    for quantity, values in (
        ("torque_nmse", [errors.torque_nmse for _, errors, _ in found]),
        ("acceleration_nmse", [errors.acceleration_nmse for _, errors, _ in found]),
    ):
        rows += [
            Row(case, f"{quantity}_{kind}", float(of(values))) for kind, of in (("median", np.median), ("worst", max))
        ]
    rows.append(
        Row(case, "equilibrium_offset_worst", max(law_of(plant, got.dynamics).offset for got, *_ in found), "rad")
    )
    rows.append(Row(case, "learning_seconds_median", float(np.median([got.seconds for got, *_ in found])), "s"))
    return Findings(rows)


def by_nominal(name: str, quick: bool) -> Findings:
    """Results by the nominal model, which lacks friction and is not fitted."""
    plant, model = desktop_plant(name), nominal_model(desktop_plant(name))
    tries = [
        try_starts(plant, model, starts=50 if quick else STARTS, seed=seed + TRY_SEED)
        for seed in (SEEDS[:1] if quick else SEEDS)
    ]
    case = f"learned/{name}/analytic"
    errors = errors_along(plant, model, test_motions(plant, seed=0))
    rows = _of_tries(case, tries, "likewise, by the nominal sizes", None)
    rows += [Row(case, f"{key}_median", value) for key, value in errors._asdict().items()]
    return Findings(rows)


def _of_seed(plant: DesktopPlant, model: str, seed: int, quick: bool) -> tuple[Obtained, Any, Tried]:
    recording, _ = explore(plant, plant.numbers.gains, Excitation(seconds=SECONDS_OF_DATA), seed=seed)
    got = obtain(plant, model, recording, seed=seed)
    errors = errors_along(plant, got.dynamics, test_motions(plant, seed=seed))
    return got, errors, tries_or_none(plant, got, 50 if quick else STARTS, seed + TRY_SEED)


def tries_or_none(plant: DesktopPlant, got: Obtained, starts: int, seed: int) -> Tried:
    """Outcomes of a model's swing-ups; all fail if the controller rejects the model."""
    try:
        return try_starts(plant, got.dynamics, starts=starts, seed=seed)
    except InputError:
        return Tried(Outcomes(np.full(starts, np.inf), np.zeros(starts, bool)), np.full(starts, np.nan))


def _of_tries(case: str, tries: list[Tried], words: str, bound: float | None) -> list[Row]:
    share = min(tried.outcomes.share for tried in tries)
    rows = [
        Row(case, "success_share", share, expected=words)
        if bound is None
        else expect(case, "success_share", words, share, bound, at_least=True),
        Row(case, "not_finite_share", max(float(tried.outcomes.failed.mean()) for tried in tries)),
        Row(case, "seconds_median", float(np.median([tried.outcomes.median for tried in tries])), "s"),
        Row(case, "seconds_worst", max(tried.outcomes.worst for tried in tries), "s"),
    ]
    return rows


def cases(quick: bool) -> dict[str, Callable[[], Findings]]:
    """Cases of the control report by name."""
    found: dict[str, Callable[[], Findings]] = {}
    for name in PLANTS:
        for model in LEARNED:
            found[f"learned/{name}-{model}"] = functools.partial(by_model, name, model, quick)
        found[f"learned/{name}-analytic"] = functools.partial(by_nominal, name, quick)
    return found
