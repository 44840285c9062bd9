"""Swing-ups by models learned from at most thirty seconds of simulated motion, over several seeds."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from dln_jax.control.closed_loop import Outcomes
from dln_jax.control.desktop_plants import PLANTS, DesktopPlant, Tried, desktop_plant, law_of, nominal_model, try_starts
from dln_jax.training.swing_ups.learned import Errors, Obtained, errors_along, obtain, recorded, test_motions
from dln_jax.types import InputError
from scripts.reports.case import Findings, spread
from scripts.reports.rows import Row

SECONDS_OF_DATA = 30.0
SEEDS = (0, 1, 2)
"""Seeds of exploration and network; a seed also sets the rough model, the noise and the starts."""
STARTS, SUCCESS = 1000, 0.995
TRY_SEED = 100
"""Offset of the seed for evaluated starts; the gains were chosen on other starts."""


class Outcome(NamedTuple):
    """A model learned from one recording, its errors on unseen motions, and its swing-ups."""

    model: Obtained
    errors: Errors
    tried: Tried


def by_model(name: str, model: str, quick: bool) -> Findings:
    """Results of swing-ups by a learned model: median and worst over seeds of the data."""
    plant, seeds = desktop_plant(name), SEEDS[:1] if quick else SEEDS
    runs = [_of_seed(plant, model, seed, quick) for seed in seeds]
    case = f"learned/{name}/{model}"
    words = f"of {_starts(quick)} starts, the worst of {len(seeds)} recording(s) of 30 s"
    offsets = [law_of(plant, run.model.dynamics).offset for run in runs]
    return Findings(
        [
            *_of_tries(case, [run.tried for run in runs], words, SUCCESS if model == "delan" else None),
            *spread(case, "torque_nmse", [run.errors.torque_nmse for run in runs]),
            *spread(case, "acceleration_nmse", [run.errors.acceleration_nmse for run in runs]),
            Row(case, "equilibrium_offset_worst", max(offsets), "rad"),
            Row(case, "learning_seconds_median", float(np.median([run.model.seconds for run in runs])), "s"),
        ]
    )


def by_nominal(name: str, quick: bool) -> Findings:
    """Results by the nominal model, which lacks friction and is not fitted."""
    plant, model = desktop_plant(name), nominal_model(desktop_plant(name))
    seeds = SEEDS[:1] if quick else SEEDS
    tries = [try_starts(plant, model, starts=_starts(quick), seed=seed + TRY_SEED) for seed in seeds]
    case, errors = f"learned/{name}/analytic", errors_along(plant, model, test_motions(plant, seed=0))
    rows = _of_tries(case, tries, "likewise, by the nominal sizes", None)
    return Findings([*rows, *(Row(case, f"{key}_median", value) for key, value in errors._asdict().items())])


def _starts(quick: bool) -> int:
    return 50 if quick else STARTS


def _of_seed(plant: DesktopPlant, model: str, seed: int, quick: bool) -> Outcome:
    recording = recorded(plant, seconds=SECONDS_OF_DATA, seed=seed)
    learned, starts = obtain(plant, model, recording, seed=seed), _starts(quick)
    errors = errors_along(plant, learned.dynamics, test_motions(plant, seed=seed))
    try:
        tried = try_starts(plant, learned.dynamics, starts=starts, seed=seed + TRY_SEED)
    except InputError:  # the controller rejects the model: all starts fail
        absent = np.full(starts, np.nan)
        tried = Tried(Outcomes(np.full(starts, np.inf), np.zeros(starts, bool)), absent, absent)
    return Outcome(learned, errors, tried)


def _of_tries(case: str, tries: Sequence[Tried], words: str, bound: float | None) -> list[Row]:
    share = min(tried.outcomes.share for tried in tries)
    return [
        Row(case, "success_share", share, bound=bound, at_least=bound is not None, expected=words),
        Row(case, "not_finite_share", max(float(tried.outcomes.failed.mean()) for tried in tries)),
        Row(case, "seconds_median", float(np.median([tried.outcomes.median for tried in tries])), "s"),
        Row(case, "seconds_worst", max(tried.outcomes.worst for tried in tries), "s"),
    ]


CASES: dict[str, Callable[[bool], Findings]] = {
    f"learned/{name}-{model}": partial(by_nominal, name) if model == "analytic" else partial(by_model, name, model)
    for name in PLANTS
    for model in ("delan", "identified", "analytic")
}
"""Cases of the control report by name."""
