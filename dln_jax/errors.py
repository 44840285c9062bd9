"""Errors for invalid input, and upper bounds on counts, magnitudes and memory. Does not import JAX.

The bounds are far above any sensible use, but keep a typo from exhausting the memory or running for years. Counts that
multiply (cells of a mesh, equations of Gauss-Newton) are bounded by an estimate of their memory before allocation.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MOST: dict[str, int] = {
    "batch": 10_000_000,
    "cells": 10_000,
    "decimate": 100_000,
    "degree": 50,
    "depth": 100,  # deeper networks take hours to compile and do not learn
    "devices": 256,
    "dimension": 3,
    "gpus": 256,
    "harmonics": 1000,
    "iterations": 100_000,
    "jobs": 10_000,
    "kills": 10_000,
    "lanes": 1_000_000,
    "members": 1000,
    "processes": 4096,
    "repetitions": 1_000_000,
    "samples": 100_000_000,
    "seeds": 1000,
    "sharing": 256,
    "split_seeds": 1000,
    "splits": 1000,
    "starts": 100_000,
    "steps": 100_000_000,
    "timed_seeds": 1000,
    "trajectories": 1_000_000,
    "width": 16_384,
}
"""Upper bounds of counts by name of the option or argument; `MOST_OF_OTHERS` bounds the rest."""
MOST_OF_OTHERS = 100_000_000
LARGEST, SMALLEST = 1e50, 1e-50
"""Range of magnitudes of measured quantities in SI units; the squares of values in the range stay finite."""
LARGEST_STATED = 1e20
"""Largest magnitude of an option on the command line."""


class InputError(ValueError):
    """Invalid input: the message states in one line what was wrong, what was expected and what to do.

    A `ValueError`. Commands print the message and end with status 2.

    Example:
        >>> import dln_jax
        >>> try:
        ...     dln_jax.load_trajectories("missing.npz")
        ... except dln_jax.InputError as error:
        ...     print(error)
        missing.npz: no such file; give the path of the data
    """


class FitRefused(Exception):
    """A fit that must not be used. Its run folder is complete except files for a robot; commands end with status 1."""

    def __init__(self, verdict: Any):
        """Takes a `metrics.verdict.Verdict`."""
        super().__init__(f"the fit is refused: {verdict.reason}; {verdict.remedy}")
        self.verdict = verdict


class ProcessLost(Exception):
    """Another process of the program ended, or the connection to it was lost."""


def require_within(counts: Mapping[str, int]) -> None:
    """Raises `InputError` that names the first count above its bound; names may be written as options (--steps)."""
    for name, count in counts.items():
        if count > (most := MOST.get(name.removeprefix("--").replace("-", "_"), MOST_OF_OTHERS)):
            # Python refuses to print a whole number of more than 4,300 digits.
            value = f"{count:,}" if count < 10**18 else "a number of more than 18 digits"
            raise InputError(f"{name} is {value}; expected at most {most:,}")


def require_magnitude(name: str, value: float) -> None:
    """Raises `InputError` for a nonzero number whose magnitude is implausible in SI units."""
    if value != 0 and not SMALLEST <= abs(value) <= LARGEST_STATED:
        raise InputError(
            f"{name} is {value:.3g}; expected 0, or a size between {SMALLEST:.0e} and {LARGEST_STATED:.0e}"
        )


def require_network(*, width: int, depth: int) -> None:
    """Raises `InputError` unless width and depth are positive whole numbers in bounds and the weights fit in memory."""
    for name, value in (("width", width), ("depth", depth)):
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise InputError(f"{name} is {value!r:.40}; expected a positive whole number")
    require_within({"width": width, "depth": depth})
    # Parameters, gradient, and Adam's two moments, in float64.
    require_memory(f"a network with {depth} hidden layers of {width} units", 4 * 8.0 * width**2 * (depth - 1))


def require_memory(what: str, bytes_needed: float) -> None:
    """Raises `InputError` if an estimate exceeds the memory of this machine."""
    if bytes_needed > (available := memory()):
        needed, here = (f"{size / 2**30:,.3g} GiB" for size in (bytes_needed, available))
        raise InputError(f"{what} would need about {needed} of memory, but this machine has {here}; ask for less")


def memory() -> float:
    """Memory of this machine or its container, whichever is smaller, in bytes; infinite if unknown."""
    size = float("inf")
    try:
        size = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
        return min(size, float(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError, AttributeError):  # no such system, no container, or "max"
        return size
