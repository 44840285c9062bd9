"""Schema of trajectory files (npz, CSV, ROS bags): how they are read, checked and written.

Samples of all trajectories are concatenated on axis 0.

| key | shape | unit | |
|---|---|---|---|
| `t` | [N] | s | time within its trajectory |
| `q`, `qd`, `qdd` | [N, d] | rad or m, 1/s, 1/s² | missing rates are estimated from `q` |
| `tau` | [N, d] | N m or N | zero if absent |
| `p`, `pd` | [N, d] | | optional canonical momentum and its rate |
| `tau_inertial`, `tau_coriolis`, `tau_gravity` | [N, d] | N m or N | optional true decomposition |
| `trajectory` | [N] int | | index of a sample's trajectory; any number >= 0 without `label`; one recording if absent |
| `label` | [K] str | | name of each trajectory; if absent, its number, and trajectories are renumbered from 0 |
| `joint_names` | [d] str | | optional, joint of each column |
| `needs` | str | | optional JSON of `dln_jax.types.Needs` |
"""

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from dln_jax.data import bags, csv_tables, joint_names
from dln_jax.data.arrays import FOLDER, load_file, numeric
from dln_jax.data.stated_needs import needs_from_text
from dln_jax.files import is_file, is_folder, writing
from dln_jax.types import InputError, Needs, require_positive

Data = TypeVar("Data")
RATES = ("qd", "qdd")
OPTIONAL = ("tau", "p", "pd", "tau_inertial", "tau_coriolis", "tau_gravity")
PER_JOINT = ("q", *RATES, *OPTIONAL)
KEYS = ("t", *PER_JOINT, "trajectory", "label", "joint_names", "needs")
LARGEST_INDEX = 2**53
"""Largest integer up to which float64 is exact."""


class Trajectories(NamedTuple):
    """Samples of several trajectories, float64; shapes and units as in the module's table."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray
    trajectory: np.ndarray
    label: np.ndarray
    p: np.ndarray | None = None
    pd: np.ndarray | None = None
    tau_inertial: np.ndarray | None = None
    tau_coriolis: np.ndarray | None = None
    tau_gravity: np.ndarray | None = None
    needs: Needs | None = None
    joint_names: np.ndarray | None = None
    estimated: tuple[str, ...] = ()
    """Keys that were absent: rates estimated by finite differences, torques set to zero."""
    remarks: tuple[str, ...] = ()
    """How the file was read: joints matched or left out, repaired stamps, and the clock of a bag."""

    @property
    def degrees_of_freedom(self) -> int:
        """d."""
        return self.q.shape[1]


def load(
    path: str | Path,
    *,
    rate: float | int | None = None,
    units: str | None = None,
    joints: Sequence[str] = (),
    topics: Sequence[str] = (),
    torque_factor: float | int | Sequence[float | int] | Mapping[str, float | int] | None = None,
    robot: Sequence[str] = (),
) -> Trajectories:
    """Reads and checks an npz file, a CSV file or a ROS bag; never unpickles.

    Args:
        path: path of the file; CSV if its name ends in .csv (see `data.csv_tables`), a bag if it ends in .db3, .mcap or
            .bag or is a folder (see `data.bags`).
        rate: sampling rate of all trajectories, Hz, for a file without t.
        units: units of CSV titles without one, "si" or "degrees".
        joints: names of joints to keep, in this order, or LOG=NEW to rename one (see `data.joint_names.chosen`).
        topics: topics of joint states in a bag; by default the only one.
        torque_factor: factor of tau, N m per A for currents: one number, one for each joint, or numbers by name.
        robot: names of the robot's joints. Of a bag, only the joints that match them are read; `splits.with_joints`
            brings them into this order.

    Raises:
        InputError: the file is missing, is not of its format, holds pickled objects, breaks the schema, or lacks a
            stated joint or topic.
    """
    stated = {"joints": joints, "topics": topics, "torque_factor": torque_factor, "robot": robot}
    return load_arrays(path, from_arrays, rate=rate, units=units, **stated)


def load_arrays(
    path: str | Path,
    from_arrays: Callable[[dict[str, Any]], Data],
    *,
    rate: float | int | None = None,
    units: str | None = None,
    joints: Sequence[str] = (),
    topics: Sequence[str] = (),
    torque_factor: Any = None,
    robot: Sequence[str] = (),
) -> Data:
    """Result of `from_arrays` on a file's arrays, completed with t and trajectory; arguments and errors as `load`."""
    suffix, folder = Path(path).suffix.lower(), is_folder(Path(path))
    if units is not None and suffix != ".csv":
        raise InputError(f"{path!s:.200}: units are for CSV; npz files and bags are in SI units")
    if topics and not (folder or suffix in bags.SUFFIXES):
        raise InputError(f"{path!s:.200}: --topics is for ROS bags; leave it out")

    def choose(own: Sequence[str]) -> Sequence[str]:
        kept = joint_names.chosen(own, joints)
        if not robot:
            return kept.own
        by_name = dict(zip(kept.names, kept.own, strict=True))
        return [by_name[name] for name in joint_names.matched(kept.names, robot).values()]

    of_bags = functools.partial(bags.read, topics=topics, choose=choose)
    of_csv = functools.partial(csv_tables.read, units=units)
    readers = {".csv": of_csv, **dict.fromkeys((*bags.SUFFIXES, FOLDER), of_bags)}

    def completed(arrays: dict[str, Any]) -> Data:
        return from_arrays(scaled(with_chosen(with_times(arrays, rate), joints), torque_factor))

    return load_file(path, completed, KEYS, readers=readers)


def with_chosen(arrays: dict[str, Any], joints: Sequence[str]) -> dict[str, Any]:
    """Selects, orders and renames the joints as stated (see `data.joint_names.chosen`).

    Raises:
        InputError: joints are stated, but the file names none; or as `chosen`.
    """
    if not joints:
        return arrays
    names = np.asarray(arrays.get("joint_names", ()))
    if names.ndim != 1 or not names.size or names.dtype.kind not in "US":
        raise InputError("--joints needs the joints' names, which the file lacks; add joint_names, or names in titles")
    own = names.tolist()
    # A bag has been read for the joints of a robot alone.
    stated = [entry for entry in joints if "remarks" not in arrays or entry.partition("=")[0].strip() in own]
    kept = joint_names.chosen(own, stated)
    places = [own.index(name) for name in kept.own]
    if "needs" in arrays and places != list(range(len(own))):
        raise InputError("--joints selects or reorders joints, but the file has needs for its own; leave --joints out")
    columns = {key: np.asarray(arrays[key])[:, places] for key in PER_JOINT if np.ndim(arrays.get(key)) == 2}
    return {**arrays, **columns, "joint_names": np.array(kept.names)}


def scaled(arrays: dict[str, Any], torque_factor: Any) -> dict[str, Any]:
    """Multiplies tau by the stated factors (see `data.joint_names.factors`).

    Raises:
        InputError: there is no tau, or as `factors`.
    """
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


def column(data: Trajectories, key: str) -> np.ndarray:
    """One of the optional arrays; raises `InputError` if it is absent."""
    array = getattr(data, key)
    if array is None:
        raise InputError(f"the data have no {key}, which is needed here; add it")
    return array


def from_arrays(arrays: dict[str, Any]) -> Trajectories:
    """Checks arrays against the schema and completes them.

    Raises:
        InputError: names the key, what it holds, what was expected and what to do.
    """
    q = numeric(arrays, "q")
    if q.ndim != 2 or q.shape[1] == 0:
        raise InputError(f"q has shape {q.shape}; expected [N, d] with d >= 1: one column per coordinate")
    samples = q.shape[0]
    if samples < 2:
        raise InputError(f"q has {samples} sample(s); expected at least 2: record longer trajectories")
    t = numeric(arrays, "t", (samples,))
    trajectory, label = _trajectory_names(arrays, samples)
    _require_increasing_time(t, trajectory, label)

    checked = {"q": q} | {key: numeric(arrays, key, q.shape) for key in (*RATES, *OPTIONAL) if key in arrays}
    estimated = tuple(key for key in (*RATES, "tau") if key not in arrays)
    for key, source in zip(RATES, ("q", "qd"), strict=True):
        if key in estimated:
            checked[key] = time_derivative(t, checked[source], trajectory, name=key)
    checked.setdefault("tau", np.zeros_like(q))
    needs = needs_from_text(str(arrays["needs"])) if "needs" in arrays else None
    if needs is not None and needs.degrees_of_freedom != q.shape[1]:
        raise InputError(
            f"needs states {needs.degrees_of_freedom} joints, but q has {q.shape[1]} columns; make them agree"
        )
    names = _joint_names(arrays["joint_names"], q.shape[1]) if "joint_names" in arrays else None
    return Trajectories(
        t=t, trajectory=trajectory, label=label, needs=needs, joint_names=names, estimated=estimated,
        remarks=tuple(arrays.get("remarks", ())), **checked,
    )  # fmt: skip


def save(path: str | Path, data: Trajectories, *, overwrite: bool = False) -> None:
    """Writes a file that `load` reads; estimated keys are left out, so the file holds only measured data.

    Raises:
        InputError: the name does not end in .npz, the file exists and `overwrite` is false, its folder does not exist,
            or the data break the schema.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{path}: trajectories are stored as npz; let the name end in .npz")
    if (path.exists() or path.is_symlink()) and not (overwrite and is_file(path)):
        raise InputError(f"{path} exists; choose another name or ask to overwrite it")
    if not isinstance(data, Trajectories):
        raise InputError(f"data is a {type(data).__name__}; expected Trajectories, such as `load_trajectories` gives")
    arrays: dict[str, Any] = {
        key: value
        for key, value in data._asdict().items()
        if value is not None and key not in ("needs", "estimated", "remarks", *data.estimated)
    }
    if data.needs is not None:
        arrays["needs"] = np.array(json.dumps(data.needs._asdict()))
    try:
        from_arrays(arrays)
    except InputError as error:
        raise InputError(f"{path} is not written: {error}") from None
    with writing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


def momenta(data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """p and pd; raises `InputError` if the data have none."""
    if data.p is None or data.pd is None:
        raise InputError("the data have no p and pd, to which a field is fitted; add them, or fit trajectories instead")
    return data.p, data.pd


def _joint_names(stated: Any, d: int) -> np.ndarray:
    names = np.asarray(stated)
    if names.dtype.kind not in "US" or names.shape != (d,) or len(set(names.tolist())) < d:
        raise InputError(f"joint_names has type {names.dtype} and shape {names.shape}; expected {d} different strings")
    return names.astype(str)


def _trajectory_names(arrays: dict[str, Any], samples: int) -> tuple[np.ndarray, np.ndarray]:
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


def _require_increasing_time(t: np.ndarray, trajectory: np.ndarray, label: np.ndarray) -> None:
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
