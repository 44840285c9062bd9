"""Completes the arrays of a file with facts that a user states: joints, torque factors, the sampling rate."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from dln_jax.data import joint_names
from dln_jax.data.schema_keys import PER_JOINT
from dln_jax.types import InputError, require_positive


def with_chosen(arrays: dict[str, Any], joints: Sequence[str], of_bag: bool) -> dict[str, Any]:
    """Selects, orders and renames the joints as stated (see `data.joint_names.chosen`).

    Of a bag, only the joints of the robot have been read, and the others that are stated do not count.

    Raises:
        InputError: joints are stated, but the file names none, or `chosen` refuses them.
    """
    if not joints:
        return arrays
    names = np.asarray(arrays.get("joint_names", ()))
    if names.ndim != 1 or not names.size or names.dtype.kind not in "US":
        raise InputError("--joints needs the joints' names, which the file lacks; add joint_names, or names in titles")
    own = names.tolist()
    stated = [entry for entry in joints if not of_bag or entry.partition("=")[0].strip() in own]
    kept = joint_names.chosen(own, stated)
    places = [own.index(name) for name in kept.own]
    if "needs" in arrays and places != list(range(len(own))):
        raise InputError("--joints selects or reorders joints, but the file has needs for its own; leave --joints out")
    present = {key: np.asarray(arrays[key]) for key in PER_JOINT if np.ndim(arrays.get(key)) == 2}
    columns = {key: array[:, places] for key, array in present.items() if array.shape[1] == len(own)}
    return {**arrays, **columns, "joint_names": np.array(kept.names)}


def scaled(arrays: dict[str, Any], torque_factor: Any) -> dict[str, Any]:
    """Multiplies tau by the stated factors (see `data.joint_names.factors`); `InputError` if there is no tau."""
    if torque_factor is None:
        return arrays
    if np.ndim(arrays.get("tau")) != 2:
        why = "".join(f"; {remark}" for remark in arrays.get("remarks", ()))
        raise InputError(f"--torque-factor scales tau, which the file lacks; leave it out{why}")
    count = np.shape(arrays["tau"])[1]
    names = np.asarray(arrays.get("joint_names", [str(joint + 1) for joint in range(count)])).astype(str).tolist()
    numbers = joint_names.factors(torque_factor, names)
    listed = ", ".join(f"{name} {number:.4g}" for name, number in zip(names, numbers, strict=True))
    remarks = (*arrays.get("remarks", ()), f"tau is that of the log times {listed}")
    return {**arrays, "tau": np.asarray(arrays["tau"]) * numbers, "remarks": remarks}


def with_times(arrays: dict[str, Any], rate: float | int | None) -> dict[str, Any]:
    """Completes the arrays with t, from the rate, and with trajectory, as one recording, if they are absent.

    Raises:
        InputError: there is neither t nor a rate, there are both, or the rate is not positive.
    """
    if "q" not in arrays:
        return arrays  # `from_arrays` refuses them
    samples = len(np.atleast_1d(np.asarray(arrays["q"])))
    if rate is None and "t" not in arrays:
        raise InputError("key 't' is missing; add the time of each sample in seconds, or give --rate HZ")
    arrays = {"trajectory": np.zeros(samples, int), **arrays}
    if rate is None:
        return arrays
    require_positive(rate=rate)
    if "t" in arrays:
        raise InputError("the file has t, so its rate is known; leave --rate out")
    starts = np.flatnonzero(np.diff(np.asarray(arrays["trajectory"]), prepend=np.nan))
    return {**arrays, "t": (np.arange(samples) - np.repeat(starts, np.diff(starts, append=samples))) / rate}
