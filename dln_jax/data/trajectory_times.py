"""Trajectories among samples: their names, times and derivatives within them."""

from typing import Any

import numpy as np

from dln_jax.data.arrays import numeric
from dln_jax.types import InputError

LARGEST_INDEX = 2**53
"""float64 is exact for integers up to this one."""


def trajectory_names(arrays: dict[str, Any], samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Index of every sample's trajectory and the trajectories' names; raises `InputError` for invalid ones."""
    trajectory = numeric(arrays, "trajectory", (samples,), most=np.inf)
    if (trajectory != np.round(trajectory)).any() or trajectory.min() < 0 or trajectory.max() > LARGEST_INDEX:
        raise InputError("trajectory has entries that are not whole numbers >= 0; give the index of each trajectory")
    trajectory = trajectory.astype(np.int64)
    if "label" not in arrays:
        present, trajectory = np.unique(trajectory, return_inverse=True)
        return trajectory.reshape(-1), present.astype(str)
    count = int(trajectory.max()) + 1
    try:
        label = np.asarray(arrays["label"])
    except ValueError as error:
        raise InputError("label is ragged; expected one string per trajectory") from error
    if label.dtype.kind not in "US" or label.ndim != 1:
        raise InputError(f"label has type {label.dtype} and shape {label.shape}; expected one string per trajectory")
    if len(label) < count:
        raise InputError(f"label names {len(label)} trajectories, but trajectory counts {count}; add the missing names")
    if len(set(label)) < len(label):
        raise InputError("label has repeated names; give every trajectory a name of its own")
    return trajectory, label.astype(str)


def require_increasing_time(t: np.ndarray, trajectory: np.ndarray, label: np.ndarray) -> None:
    """Raises `InputError` unless the samples of each trajectory are together and in the order of time."""
    same = trajectory[1:] == trajectory[:-1]
    starts = trajectory[np.flatnonzero(np.r_[True, ~same])]
    if len(set(starts)) < len(starts):
        raise InputError("trajectory returns to an earlier index; keep the samples of each trajectory together")
    for sample in 1 + np.flatnonzero(same & (np.diff(t) <= 0))[:1]:
        raise InputError(
            f"t does not increase at sample {sample} of trajectory '{label[trajectory[sample]]}'; sort the samples by "
            "time, and number recordings that follow one another in a column 'trajectory'"
        )


def time_derivative(t: np.ndarray, values: np.ndarray, trajectory: np.ndarray, *, name: str) -> np.ndarray:
    """Second-order finite differences of values [N, d] over t [N], trajectory by trajectory.

    Central inside, one-sided at the ends, any spacing; differences never reach across trajectories.

    Raises:
        InputError: a trajectory has fewer than three samples; the message names `name`, the key to be estimated.
    """
    result = np.empty_like(values)
    for index in np.unique(trajectory):
        samples = trajectory == index
        count = int(samples.sum())
        if count < 3:
            raise InputError(
                f"{name} is missing, and trajectory {index} has {count} sample(s): estimating it takes at least 3; "
                f"add {name} or record longer trajectories"
            )
        result[samples] = np.gradient(values[samples], t[samples], axis=0, edge_order=2)
    return result
