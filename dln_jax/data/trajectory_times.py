"""Trajectories among samples: their names, times and derivatives within them."""

from typing import Any

import numpy as np

from dln_jax.data.arrays import numeric
from dln_jax.types import InputError

LARGEST_INDEX = 2**53
"""float64 is exact for integers up to this one."""
LONG = np.pi / 4
"""rad: usual steps of angles are shorter."""


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


def unwrapped(q: np.ndarray, trajectory: np.ndarray, revolute: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Angles without the jumps by 2 pi of sensors that wrap, and remarks on them.

    A joint is left alone if a step beside its jumps, or more than one in a hundred, is long: turns could be motions.

    Args:
        q: [N, d].
        trajectory: index of every sample's trajectory [N].
        revolute: joints that turn [d].
    """
    ends = np.flatnonzero(np.diff(trajectory)) + 1
    straight = np.concatenate([np.unwrap(part, axis=0) for part in np.split(q, ends)])
    turned, step = (np.abs(np.delete(np.diff(x, axis=0), ends - 1, axis=0)) for x in (straight - q, straight))
    jumps, far = turned > 1, step > LONG
    wraps = revolute & jumps.any(axis=0) & ~(jumps & far).any(axis=0) & (far.sum(axis=0) < len(far) / 100)
    if not wraps.any():
        return q, []
    columns = ", ".join(str(joint + 1) for joint in np.flatnonzero(wraps))
    return np.where(wraps, straight, q), [f"angles in column {columns} of q wrap by 2 pi and are unwrapped"]


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
