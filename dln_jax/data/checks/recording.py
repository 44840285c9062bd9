"""Reads a log tolerantly: faults in its times that `schema.load` refuses are repaired and reported."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data import schema
from dln_jax.data.checks.findings import Finding
from dln_jax.data.schema import Trajectories


class Recording(NamedTuple):
    """Trajectories in order of time, with joint names and findings on repairs."""

    data: Trajectories
    names: tuple[str, ...] = ()
    """Joint names, if the file has `joint_names`."""
    repaired: tuple[Finding, ...] = ()


def as_recording(data: Trajectories) -> Recording:
    """Wraps trajectories that have already been read."""
    return Recording(data)


def read(path: str | Path, *, rate: float | int | None = None, units: str | None = None) -> Recording:
    """Reads a file in the schema with samples possibly unordered or duplicated; arguments as `schema.load`.

    Raises:
        InputError: as `schema.load` for anything else.
    """
    return schema.load_arrays(path, _from_arrays, rate=rate, units=units)


def _from_arrays(arrays: dict[str, Any]) -> Recording:
    names = np.ravel(arrays.pop("joint_names", np.array([], str)))
    kept, repaired = _in_order(arrays)
    return Recording(schema.from_arrays(kept), tuple(str(each) for each in names), repaired)


def _in_order(arrays: dict[str, Any]) -> tuple[dict[str, Any], tuple[Finding, ...]]:
    """Groups samples by trajectory, sorts them by time and drops duplicates after the first."""
    t, trajectory = (np.asarray(arrays.get(key, np.zeros(0))) for key in ("t", "trajectory"))
    if t.ndim != 1 or t.shape != trajectory.shape or not np.issubdtype(t.dtype, np.number) or not len(t):
        return arrays, ()  # the schema refuses them
    order = np.lexsort((t, trajectory))
    same = np.r_[False, (np.diff(t[order]) == 0) & (np.diff(trajectory[order]) == 0)]
    found = []
    if backward := int(np.sum(np.diff(t)[np.diff(trajectory) == 0] < 0)):
        said = f"t runs backwards at {backward} sample(s)"
        found.append(Finding("error", "time-order", said, "sort the samples of each trajectory by time (done here)"))
    if same.any():
        said = f"{int(same.sum())} sample(s) have the time of the one before"
        found.append(Finding("error", "time-double", said, "keep one sample for each time (the first was kept here)"))
    if not found:
        return arrays, ()
    kept = order[~same]
    samples = len(t)
    return {
        key: np.asarray(array)[kept] if np.shape(array)[:1] == (samples,) and key != "label" else array
        for key, array in arrays.items()
    }, tuple(found)
