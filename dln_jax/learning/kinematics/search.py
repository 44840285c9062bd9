"""Many descents of joint frames from random starts, and discrete moves of the best; two or more threads at a time.

Descents end in few valleys that recur. That several starts agree on the lowest says that it is the lowest.
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
"""Starts between two looks at whether they agree, whatever the number of threads: results do not depend on it."""
ALIKE = 0.02
"""Relative difference of two losses of the same valley."""


class Search(NamedTuple):
    """How much is tried; whatever ends first."""

    starts: int = 64
    """Random starts at most."""
    agreement: int = 5
    """Starts that must reach the lowest loss of all for the search to end."""
    iterations: int = 150
    """Of a descent, at most."""
    samples: int = 160
    """Drawn from the data for the search; the best is refined on all."""
    seconds: float = float("inf")
    """After which the best so far is taken; at least one wave of starts is done."""
    seed: int = 0
    """Of the starts and of the samples."""
    threads: int = 2
    sketch: Frames | None = None
    """Frames to start near, such as of a drawing: link lengths, and axes known roughly."""
    sketch_angle: float = 0.5
    """rad, by which axes of the sketch are off."""
    sketch_length: float = 0.05
    """m, likewise places."""


def search(
    structure: Structure, program: Program, samples: Samples, unit: Float[np.ndarray, " d"], settings: Search
) -> list[State]:
    """The ends of all descents, the lowest first.

    Args:
        structure: what is known of the tree.
        program: of the structure.
        samples: to explain, those of the data that the search sees.
        unit: of each joint's torque.
        settings: how much is tried.

    Raises:
        InputError: a setting out of range.
    """
    counts = {name: getattr(settings, name) for name in ("starts", "agreement", "iterations", "seconds", "threads")}
    require_positive(**counts, sketch_angle=settings.sketch_angle, sketch_length=settings.sketch_length)
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
    """How many descents ended as low as the lowest."""
    return sum(float(state.at.loss) <= (1 + ALIKE) * float(found[0].at.loss) for state in found)


def _waves(structure: Structure, settings: Search) -> Iterator[list[Frames]]:
    for first in range(0, settings.starts, WAVE):
        yield [_start(structure, settings, index) for index in range(first, min(first + WAVE, settings.starts))]


def _start(structure: Structure, settings: Search, index: int) -> Frames:
    random = np.random.default_rng([settings.seed, index])
    if settings.sketch is None:
        return random_frames(len(structure.joints), random)
    return rough_frames(settings.sketch, random, angle=settings.sketch_angle, length=settings.sketch_length)


def _turns(structure: Structure, frames: Frames, joints: int) -> Iterable[Frames]:
    """So many joints at a time that turn the other way."""
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
    with jax.enable_x64(True):  # a setting of each thread
        return descend(program, structure, frames, samples, unit, iterations=iterations, expired=expired)


def _sorted(found: list[State]) -> list[State]:
    return sorted(found, key=lambda state: float(np.nan_to_num(state.at.loss, nan=np.inf)))
