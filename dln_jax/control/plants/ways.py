"""Ways of swinging up, with settings chosen by trials: plans with feedback, repeated plans, and energy laws."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.control.closed_loop import Controller, stateless
from dln_jax.control.plants.planned import followed, follower, plans_of
from dln_jax.control.plants.plant import Layout, spread_of
from dln_jax.control.plants.recovery import recovering
from dln_jax.control.plants.scales import RANGES, Scales, swing_up_numbers
from dln_jax.control.regulators import Regulator
from dln_jax.control.swing_up import Upright, law_at
from dln_jax.types import InputError

PLANS = 8
"""Largest number of plans that are tried with feedback."""
SETS_OF_REPEATED_PLANS = 2
"""Few, because trials of repeated plans take far longer than others: each of them plans at every step of a plan."""


class Way(NamedTuple):
    """A way of swinging up, with settings chosen by trials."""

    name: str
    draw: Callable[[np.random.Generator, int], list[Any]]
    """(random, count) -> settings, trees of arrays of equal shapes."""
    controller: Callable[[Any], Controller]
    """Settings, perhaps traced -> controller of states."""
    numbers: Callable[[Any], tuple[Mapping[str, float], Regulator]]
    """Settings -> their numbers, and the regulator at the goal."""
    errors: tuple[float, ...]
    """Errors in the first round, one trial each."""
    most_sets: int | None = None
    """Largest number of sets in a round; by default as many as are asked for."""


def by_energy(upright: Upright, layout: Layout, scales: Scales, seed: int) -> Way:
    """Returns the way by energy laws and a regulator."""
    # Smoothing and compensation are the same for all sets, because trials do not take them as arrays.
    plain = swing_up_numbers(upright, layout, scales, {name: 1.0 for name in RANGES})[0]

    def draw(random: np.random.Generator, count: int) -> list[Any]:
        settings = [swing_up_numbers(upright, layout, scales, one) for one in _draws(random, count)]
        arrays = [((one.gains, one.level, one.kick, one.surplus), regulator) for one, regulator in settings]
        return [jax.tree.map(lambda leaf: np.asarray(leaf, float), one) for one in arrays]

    def controller(settings: Any) -> Controller:
        (gains, level, kick, surplus), regulator = settings
        numbers = plain._replace(gains=gains, level=level, kick=kick, surplus=surplus)
        return stateless(law_at(upright, layout.joints, numbers, regulator))

    def numbers(settings: Any) -> tuple[dict[str, float], Regulator]:
        (gains, level, kick, surplus), regulator = settings
        named = {**gains._asdict(), "level": level, "kick": kick, "surplus": surplus}
        return {name: float(value) for name, value in named.items()}, regulator

    return Way("energy", draw, controller, numbers, (0.0, 0.0))


def by_plan(upright: Upright, layout: Layout, scales: Scales, seed: int) -> Way:
    """Returns the way by plans with feedback; raises as `plans_of`."""
    plans = plans_of(upright, layout, scales, seed=seed)[:PLANS]
    plain = swing_up_numbers(upright, layout, scales, {name: 1.0 for name in RANGES})[0]

    def draw(random: np.random.Generator, count: int) -> list[Any]:
        chosen = [plans[k % len(plans)] for k in range(count)]
        return followed(chosen, upright, layout, scales, _draws(random, count), spread_of(layout))

    def numbers(settings: Any) -> tuple[dict[str, float], Regulator]:
        return {"seconds": len(settings.u) / layout.rate, "level": float(settings.level)}, settings.goal

    return Way("plan", draw, lambda settings: follower(upright, layout, plain, settings), numbers, (0.15, -0.15))


def by_repeated_plans(upright: Upright, layout: Layout, scales: Scales, seed: int) -> Way:
    """Returns the way by repeated plans, which also recover from pushes, and a regulator."""
    plain = swing_up_numbers(upright, layout, scales, {name: 1.0 for name in RANGES})[0]

    def draw(random: np.random.Generator, count: int) -> list[Any]:
        settings = [swing_up_numbers(upright, layout, scales, one) for one in _draws(random, count)]
        return [(jax.tree.map(np.asarray, regulator), np.asarray(one.level)) for one, regulator in settings]

    def controller(settings: Any) -> Controller:
        return recovering(upright, layout, scales, plain, *settings)

    def numbers(settings: Any) -> tuple[dict[str, float], Regulator]:
        regulator, level = settings
        return {"level": float(level)}, regulator

    return Way("repeated plans", draw, controller, numbers, (0.15, -0.15), SETS_OF_REPEATED_PLANS)


RECOVERIES: Mapping[str, tuple[Callable[..., Way], ...]] = {
    "swing-up": (by_plan, by_energy),
    "plans": (by_repeated_plans,),
}
"""Ways that are tried, by how the plant comes up again after a push: as from hanging, or by plans from where it is."""


def require_recovery(name: str) -> None:
    """Raises `InputError` for a name that is not one of `RECOVERIES`."""
    if name not in RECOVERIES:
        raise InputError(f"recover is {name!r:.40}; choose from {', '.join(RECOVERIES)}")


def _draws(random: np.random.Generator, count: int) -> list[dict[str, float]]:
    """Returns sets of numbers, alternately with the energy of the passive part and of the whole plant."""
    low, high = np.log(np.array(list(RANGES.values()))).T
    rows = np.exp(random.uniform(low, high, size=(count, len(RANGES))))
    return [{**dict(zip(RANGES, row, strict=True)), "total": float(k % 2)} for k, row in enumerate(rows)]
