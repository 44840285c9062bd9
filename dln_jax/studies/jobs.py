"""What a table has measured so far, for --resume: jobs.json has the numbers of each case."""

import math
import reprlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from dln_jax.files import is_file, matches, read_json
from dln_jax.types import InputError

JOBS = "jobs.json"
REMEDY = "restore the file, or delete it to measure everything again"


def stored_jobs(folder: Path, known: Mapping[str, Collection[str]]) -> dict[str, dict[str, float]]:
    """The stored numbers of each case, none before the first; what JSON cannot say is NaN.

    Args:
        folder: of the run.
        known: the cases that there may be, and the quantities that each must have.

    Raises:
        InputError: the file is damaged, or another release has written it.
    """
    path = folder / JOBS
    if not is_file(path):
        return {}
    stored = read_json(path, remedy=REMEDY)
    return {case: numbers_of(path, case, numbers, known) for case, numbers in stored.items()}


def numbers_of(path: Path, case: str, stored: Any, known: Mapping[str, Collection[str]]) -> dict[str, float]:
    """The numbers of one case; errors as `stored_jobs`."""
    if case not in known:
        raise InputError(f"{path}: {case!r:.60} is no case of this table; {REMEDY}")
    if not isinstance(stored, dict) or not all(matches(value, float | None) for value in stored.values()):
        raise InputError(f"{path}: {case} holds {reprlib.repr(stored)}; expected numbers by their names; {REMEDY}")
    if missing := [name for name in known[case] if name not in stored]:
        raise InputError(f"{path}: {case} lacks {missing[0]}; {REMEDY}")
    return {name: math.nan if value is None else value for name, value in stored.items()}
