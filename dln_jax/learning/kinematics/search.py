"""Searches joint frames by many descents from random starts, and by discrete moves of the best, in parallel threads.

Descents end in a few recurring local minima. If several starts agree on the lowest, it is probably the global minimum.
"""

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.learning.kinematics.descent import Program, State, descend
from dln_jax.learning.kinematics.frames import Frames, random_frames, rough_frames, turned_round
from dln_jax.learning.kinematics.projection import Samples, Structure
from dln_jax.types import require_positive, require_seed

WAVE = 8
"""Starts between two tests of agreement; it is independent of the number of threads, and so are the results."""
ALIKE = 0.02
"""Largest relative difference of two losses that count as the same local minimum."""


class Search(NamedTuple):
    """Limits of the search; the first one that is reached ends it."""

    starts: int = 64
    """Largest number of random starts."""
    agreement: int = 5
    """Number of starts that must reach the lowest loss for the search to end."""
    iterations: int = 150
    """Largest number of iterations of a descent."""
    samples: int = 160
    """Samples drawn from the data for the search; the best frames are refined on all."""
    seconds: float = float("inf")
    """Time after which the best frames so far are taken; at least one wave of starts runs."""
    seed: int = 0
    """Seed of the starts and of the samples."""
    threads: int = 2
    kinematic_prior: Frames | None = None
    """Kinematic prior: frames near which to start, for example from a drawing with link lengths and rough axes."""
    prior_angle: float = 0.5
    """Deviation of the prior's axes, rad."""
    prior_length: float = 0.05
    """Deviation of the prior's positions, m."""


def search(
    structure: Structure, program: Program, samples: Samples, unit: Float[np.ndarray, " d"], settings: Search
) -> list[State]:
    """Returns the final states of all descents, lowest loss first.

    Args:
        structure: known properties of the tree.
        program: descent of the structure, from `compiled`.
        samples: samples of the data for the search.
        unit: scale of the joints' torques.
        settings: limits of the search.

    Raises:
        InputError: a setting out of range.
    """
    counts = {name: getattr(settings, name) for name in ("starts", "agreement", "iterations", "seconds", "threads")}
    require_positive(**counts, prior_angle=settings.prior_angle, prior_length=settings.prior_length)
    require_seed(settings.seed)
    until = time.perf_counter() + settings.seconds
    end = functools.partial(
        _end, program, structure, samples, unit, settings.iterations, lambda: time.perf_counter() > until
    )
    found: list[State] = []
    with ThreadPoolExecutor(settings.threads) as pool:
        for wave in _waves(structure, settings):
            found = _sorted([*found, *pool.map(end, wave)])
            if agreeing(found) >= settings.agreement or time.perf_counter() > until:
                break
        for joints in (1, 2):
            while agreeing(found) < settings.agreement and time.perf_counter() < until:
                best = found[0]
                found = _sorted([*found, *pool.map(end, _turns(structure, best.frames, joints))])
                if not found[0].at.loss < (1 - ALIKE) * best.at.loss:
                    break
    return found


def agreeing(found: list[State]) -> int:
    """Number of descents that ended at the lowest loss."""
    return sum(float(state.at.loss) <= (1 + ALIKE) * float(found[0].at.loss) for state in found)


def _waves(structure: Structure, settings: Search) -> Iterator[list[Frames]]:
    for first in range(0, settings.starts, WAVE):
        yield [_start(structure, settings, index) for index in range(first, min(first + WAVE, settings.starts))]


def _start(structure: Structure, settings: Search, index: int) -> Frames:
    random = np.random.default_rng([settings.seed, index])
    if settings.kinematic_prior is None:
        return random_frames(len(structure.joints), random)
    return rough_frames(settings.kinematic_prior, random, angle=settings.prior_angle, length=settings.prior_length)


def _turns(structure: Structure, frames: Frames, joints: int) -> Iterable[Frames]:
    """Yields the frames with every combination of this number of joints reversed."""
    for chosen in itertools.combinations(range(len(structure.joints)), joints):
        yield functools.reduce(lambda frames, joint: turned_round(frames, structure.parents, joint), chosen, frames)


def _end(
    program: Program,
    structure: Structure,
    samples: Samples,
    unit: Any,
    iterations: int,
    expired: Callable[[], bool],
    frames: Frames,
) -> State:
    with jax.enable_x64(True):  # the setting is local to a thread
        return descend(program, structure, frames, samples, unit, iterations=iterations, expired=expired)


def _sorted(found: list[State]) -> list[State]:
    return sorted(found, key=lambda state: float(np.nan_to_num(state.at.loss, nan=np.inf)))
