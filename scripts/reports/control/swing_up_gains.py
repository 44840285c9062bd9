"""Choice of the gains for the desktop plants' swing-ups: random search with analytic models alone.

Every draw swings the plant up with two models: the analytic one with friction, and the nominal without. Draws that
succeed from all starts with both models are tried again from more starts. Starts and noise have seeds that no report
uses, and all models, including learned ones, get the same gains.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import EnergyGains
from dln_jax.control.closed_loop import Outcomes, hanging_starts, outcomes
from dln_jax.control.desktop_plants import DesktopPlant, model_of_plant, motion_of, nominal_model
from dln_jax.control.swing_up import SwingUpNumbers
from dln_jax.mechanics.dynamics import Dynamics

SEED = 1_000_000
"""Seed of starts and noise; reports use seeds below 1000."""
DECADES = {"energy": (-1.0, 1.0), "proportional": (0.7, 1.8), "derivative": (0.0, 1.3), "level": (-1.5, 0.5)}
"""Decades of the search: factors on a first guess for energy gain and level, 1/s² and 1/s for the other gains."""


class Candidate(NamedTuple):
    """Numbers of a law and their results."""

    numbers: SwingUpNumbers
    share: float
    """Share of successful starts, by the worse of two models."""
    worst: float
    """Worst time to swing up, s, likewise."""
    farthest: float
    """Largest excursion of the driven coordinate in any run, m or rad."""


def choose(
    plant: DesktopPlant, *, draws: int = 100, starts: int = 8, finalists: int = 8, more: int = 100, farthest: float
) -> list[Candidate]:
    """The finalists, best first: ranked by success from all starts, excursion within `farthest`, and time."""
    random = np.random.default_rng(SEED)
    drawn = {name: 10 ** random.uniform(*decades, draws) for name, decades in DECADES.items()}
    first = plant.numbers
    numbers = [
        first._replace(
            gains=EnergyGains(first.gains.energy * energy, proportional, derivative), level=first.level * level
        )
        for energy, proportional, derivative, level in zip(*drawn.values(), strict=True)
    ]
    found = sorted(_tried(plant, numbers, starts, SEED), key=lambda each: _rank(each, farthest))[:finalists]
    again = _tried(plant, [each.numbers for each in found], more, SEED + 1)
    return sorted(again, key=lambda each: _rank(each, farthest))


def _rank(candidate: Candidate, farthest: float) -> tuple[float, float, float]:
    return -candidate.share, max(candidate.farthest - farthest, 0.0), candidate.worst


def _tried(plant: DesktopPlant, numbers: list[SwingUpNumbers], starts: int, seed: int) -> list[Candidate]:
    models = (model_of_plant(plant), nominal_model(plant))
    results = [_of_model(plant, model, numbers, starts, seed) for model in models]
    return [
        Candidate(
            each,
            min(found[place][0].share for found in results),
            max(found[place][0].worst for found in results),
            max(found[place][1] for found in results),
        )
        for place, each in enumerate(numbers)
    ]


def _of_model(
    plant: DesktopPlant, model: Dynamics, numbers: list[SwingUpNumbers], starts: int, seed: int
) -> list[tuple[Outcomes, float]]:
    gains = jax.tree.map(lambda *each: jnp.asarray(each), *(each.gains for each in numbers))
    levels = jnp.asarray([each.level for each in numbers])
    x = hanging_starts(starts, seed, position=plant.position)
    keys = jax.random.split(jax.random.key(seed), starts)

    def one(gains: EnergyGains, level: Array, x: Array, key: Array) -> tuple[Array, Array]:
        run = motion_of(plant._replace(numbers=plant.numbers._replace(gains=gains, level=level)), model)(x, key)
        return run.x[:, 1], jnp.max(jnp.abs(run.x[:, 0]))

    of_starts = jax.vmap(one, in_axes=(None, None, 0, 0))
    angles, far = jax.jit(jax.vmap(of_starts, in_axes=(0, 0, None, None)))(gains, levels, x, keys)
    return [(outcomes(each, rate=plant.rate), float(jnp.max(most))) for each, most in zip(angles, far, strict=True)]
