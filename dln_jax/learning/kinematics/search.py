"""Searches joint frames by many descents from random starts, and by discrete moves of the best, in parallel threads.

Descents end in a few recurring local minima. If several starts agree on the lowest, it is probably the global minimum.
"""

import functools
import itertools
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.learning.kinematics.frames import Frames, KinematicPrior, random_frames, rough_frames, turn_round
from dln_jax.learning.kinematics.projection import Descent, Program, Samples, Structure, descend
from dln_jax.types import require_positive, require_seed

WAVE = 8
"""Starts between two tests of agreement. It does not depend on the number of threads, so neither do the results."""
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
    """Time limit of the search; then the best frames so far are taken. At least one wave of starts runs."""
    confirm: bool = True
    """Whether to search until two descents end at the same arm, with the same validation error."""
    seed: int = 0
    threads: int = 2
    kinematic_prior: KinematicPrior | None = None
    """Frames near which to start, for example from a drawing with link lengths and rough axes (default: anywhere)."""


def search(
    structure: Structure,
    program: Program,
    samples: Samples,
    unit: Float[np.ndarray, " d"],
    settings: Search,
    *,
    until: float,
    before: tuple[list[Descent], int] = ([], 0),
) -> tuple[list[Descent], int]:
    """Descends from random starts, and from moves of the best, until enough descents agree on the lowest loss.

    Returns the final states of all descents, lowest loss first, and the number of random starts among them.

    Args:
        program: descent of the structure, from `compiled`.
        until: reading of `time.perf_counter` at the end of the search.
        before: an earlier search, which another wave of starts continues.

    Raises:
        InputError: a setting out of range.
    """
    counts = {name: getattr(settings, name) for name in ("starts", "agreement", "iterations", "seconds", "threads")}
    require_positive(**counts)
    if settings.kinematic_prior is not None:
        require_positive(angle=settings.kinematic_prior.angle, length=settings.kinematic_prior.length)
    require_seed(settings.seed)

    def end(frames: Frames) -> Descent:
        with jax.enable_x64(True):  # the setting is local to a thread
            limits = {"iterations": settings.iterations, "expired": lambda: time.perf_counter() > until}
            return descend(program, structure, frames, samples, unit, **limits)

    descents, done = before
    with ThreadPoolExecutor(settings.threads) as pool:
        starts = _starts(structure, settings, done)
        while wave := list(itertools.islice(starts, WAVE)):
            descents = _sorted([*descents, *pool.map(end, wave)])
            done += len(wave)
            if count_agreeing(descents) >= settings.agreement or time.perf_counter() > until:
                break
        for joints in (1, 2):
            while count_agreeing(descents) < settings.agreement and time.perf_counter() < until:
                best = descents[0]
                descents = _sorted([*descents, *pool.map(end, _turns(structure, best.frames, joints))])
                if not descents[0].at.loss < (1 - ALIKE) * best.at.loss:
                    break
    return descents, done


def count_agreeing(descents: list[Descent]) -> int:
    """Number of descents that ended at the lowest loss."""
    return sum(float(descent.at.loss) <= (1 + ALIKE) * float(descents[0].at.loss) for descent in descents)


def _starts(structure: Structure, settings: Search, first: int) -> Iterator[Frames]:
    for index in range(first, settings.starts):
        random = np.random.default_rng([settings.seed, index])
        if settings.kinematic_prior is None:
            yield random_frames(len(structure.joints), random)
        else:
            yield rough_frames(settings.kinematic_prior, random)


def _turns(structure: Structure, frames: Frames, joints: int) -> Iterable[Frames]:
    """Yields the frames with every combination of this number of joints reversed."""
    for chosen in itertools.combinations(range(len(structure.joints)), joints):
        yield functools.reduce(lambda frames, joint: turn_round(frames, structure.parents, joint), chosen, frames)


def _sorted(descents: list[Descent]) -> list[Descent]:
    return sorted(descents, key=lambda descent: float(np.nan_to_num(descent.at.loss, nan=np.inf)))
