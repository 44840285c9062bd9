"""Reads, checks and writes trajectory files (npz, CSV, ROS bags).

Samples of all trajectories are concatenated on axis 0.

| key | shape | unit | |
|---|---|---|---|
| `t` | [N] | s | time within its trajectory |
| `q`, `qd`, `qdd` | [N, d] | rad or m, 1/s, 1/s² | missing rates are estimated from `q` |
| `tau` | [N, d] | N m or N | zero if absent |
| `p`, `pd` | [N, d] | | optional canonical momentum and its rate |
| `tau_inertial`, `tau_coriolis`, `tau_gravity` | [N, d] | N m or N | optional true decomposition |
| `temperature` | [N, d] or [N] | °C | optional, of each joint's gear or motor, or one for all |
| `trajectory` | [N] int | | index of a sample's trajectory; any number >= 0 without `label`; one recording if absent |
| `label` | [K] str | | name of each trajectory; if absent, its number, and trajectories are renumbered from 0 |
| `joint_names` | [d] str | | optional, joint of each column |
| `needs` | str | | optional JSON of `dln_jax.types.Needs` |
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data import bags, csv_tables
from dln_jax.data.arrays import load_file, numeric, unread_line
from dln_jax.data.joints import (
    OPTIONAL,
    PER_JOINT,
    TorqueFactor,
    match_names,
    needs_from_text,
    scale_torques,
    select_names,
    with_selected_joints,
)
from dln_jax.files import is_file, is_folder, writing
from dln_jax.types import InputError, Needs, require_positive

KEYS = ("t", *PER_JOINT, "trajectory", "label", "joint_names", "needs")
RATES = {"qd": "q", "qdd": "qd"}
"""Rates -> the quantities that they differentiate."""
ABSOLUTE_ZERO = -273.15
"""°C."""
LARGEST_INDEX = 2**53
"""float64 represents integers up to this one exactly."""
LONG = np.pi / 4
"""rad: longer than usual steps of an angle."""


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
    temperature: np.ndarray | None = None
    """[N, d], °C, of each joint."""
    needs: Needs | None = None
    joint_names: np.ndarray | None = None
    estimated: tuple[str, ...] = ()
    """Keys that were absent: rates estimated by finite differences, torques set to zero."""
    remarks: tuple[str, ...] = ()
    """Lines on how the file was read: skipped or matched columns and joints, repaired stamps, the clock of a bag."""

    @property
    def degrees_of_freedom(self) -> int:
        """d."""
        return self.q.shape[1]

    def __repr__(self) -> str:
        """Shows sizes and keys instead of the arrays."""
        keys = [key for key in PER_JOINT if getattr(self, key) is not None]
        size = f"{len(self.t)} samples of {len(np.unique(self.trajectory))} trajectories, d = {self.degrees_of_freedom}"
        return f"Trajectories: {size}\n  {', '.join(keys)}; estimated: {', '.join(self.estimated) or 'none'}"


def load(
    path: str | Path,
    *,
    rate: float | int | None = None,
    units: str | None = None,
    joints: Sequence[str] = (),
    topics: Sequence[str] = (),
    torque_factor: TorqueFactor | None = None,
    robot: Sequence[str] = (),
    repair: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
) -> Trajectories:
    """Reads and checks trajectories from an npz file, a CSV file or a ROS bag; never unpickles.

    Args:
        path: .csv for CSV (see `data.csv_tables`); .db3, .mcap, .bag or a folder for a bag (see `data.bags`).
        rate: sampling rate of all trajectories, Hz, for a file without t.
        units: units of CSV titles without one, "si" or "degrees".
        joints: names of joints to keep, in this order, or LOG=NEW to rename one (see `data.joints.select_names`).
        topics: topics of joint states in a bag; by default the only one.
        torque_factor: factor of tau, N m per A for currents: one number, one for each joint, or numbers by name.
        robot: names of the robot's joints; a bag is read for these only (`splits.with_joints` orders them).
        repair: changes the arrays of the file before they are checked.

    Returns:
        Arrays of all samples in SI units; `data.schema` has their keys and shapes. Missing qd and qdd are estimated by
        finite differences, a missing tau is zero, and `estimated` lists both.

    Raises:
        InputError: the file is missing, damaged or pickled, breaks the schema, or lacks a stated joint or topic.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> import dln_jax
        >>> t = np.linspace(0.0, 2.0, 101)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(f"{folder}/log.npz", t=t, q=np.sin(t)[:, None], tau=np.cos(t)[:, None])
        ...     data = dln_jax.load_trajectories(f"{folder}/log.npz")
        >>> print(data.q.shape, data.qd.shape, data.estimated)
        (101, 1) (101, 1) ('qd', 'qdd')
    """
    suffix = Path(path).suffix.lower()
    of_bag = is_folder(Path(path)) or suffix in bags.SUFFIXES
    if units is not None and suffix != ".csv":
        raise InputError(f"{path!s:.200}: units are for CSV; npz files and bags are in SI units")
    if topics and not of_bag:
        raise InputError(f"{path!s:.200}: --topics is for ROS bags; leave it out")

    def select(own: Sequence[str]) -> dict[str, str]:
        selected = select_names(own, joints)
        by_name = {name: old for old, name in selected.items()}
        return {by_name[name]: name for name in match_names(list(by_name), robot).values()} if robot else selected

    def of_file(arrays: dict[str, Any]) -> Trajectories:
        arrays = _with_times(arrays, rate)
        arrays = scale_torques(arrays if of_bag else with_selected_joints(arrays, joints), torque_factor)
        return from_arrays(arrays if repair is None else repair(arrays))

    reader = (lambda bag: bags.read(bag, topics=topics, select=select)) if of_bag else None
    if suffix == ".csv" and not of_bag:
        reader = lambda table: csv_tables.read(table, units=units)  # noqa: E731
    return load_file(path, of_file, KEYS, reader=reader)


def _with_times(arrays: dict[str, Any], rate: float | int | None) -> dict[str, Any]:
    """Adds missing arrays: t from the rate, and trajectory for a single recording.

    Raises:
        InputError: neither or both of t and the rate are given, or the rate is not positive.
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
    """Returns an optional array; `InputError` if it is absent."""
    array = getattr(data, key)
    if array is None:
        raise InputError(f"the data have no {key}, but it is needed here; add it")
    return array


def from_arrays(arrays: dict[str, Any]) -> Trajectories:
    """Checks arrays against the schema and completes them; an `InputError` names the key, its content and a remedy."""
    q = numeric(arrays, "q")
    if q.ndim != 2 or q.shape[1] == 0:
        raise InputError(f"q has shape {q.shape}; expected [N, d] with d >= 1: one column per coordinate")
    samples, d = q.shape
    if samples < 2:
        raise InputError(f"q has {samples} sample(s); expected at least 2: record longer trajectories")
    t = numeric(arrays, "t", (samples,))
    trajectory, label = _named_trajectories(arrays, t)
    needs = needs_from_text(str(arrays["needs"])) if "needs" in arrays else None
    if needs is not None and needs.degrees_of_freedom != d:
        raise InputError(f"needs states {needs.degrees_of_freedom} joints, but q has {d} columns; make them agree")
    turning = ["revolute"] * d if needs is None else needs.joints
    q, wraps = _unwrap(q, trajectory, np.array(turning) == "revolute")
    temperature = arrays.get("temperature")
    if temperature is not None:
        temperature = np.asarray(temperature)
        common = temperature.ndim == 1 or (temperature.ndim == 2 and temperature.shape[1] == 1)
        stated = {"temperature": temperature.reshape(-1) if common else temperature}
        temperature = numeric(stated, "temperature", (samples,) if common else q.shape)
        if temperature.min() < ABSOLUTE_ZERO:
            raise InputError(
                f"temperature is {temperature.min():.3g} °C, below absolute zero; expected degrees Celsius"
            )
        temperature = np.broadcast_to(temperature[:, None], q.shape).copy() if common else temperature
    checked = {key: numeric(arrays, key, q.shape) for key in OPTIONAL if key in arrays} | {"q": q}
    estimated = tuple(key for key in (*RATES, "tau") if key not in arrays)
    for key, source in RATES.items():
        if key in estimated:
            checked[key] = time_derivative(t, checked[source], trajectory, name=key)
    checked.setdefault("tau", np.zeros_like(q))
    names = arrays.get("joint_names")
    if names is not None:
        names = np.asarray(names)
        if names.dtype.kind not in "US" or names.shape != (d,) or len(set(names.tolist())) < d:
            stated = f"type {names.dtype} and shape {names.shape}"
            raise InputError(f"joint_names has {stated}; expected {d} different strings")
        names = names.astype(str)
    return Trajectories(
        t=t, trajectory=trajectory, label=label, needs=needs, joint_names=names, estimated=estimated,
        temperature=temperature, remarks=(*unread_line(arrays), *arrays.get("remarks", ()), *wraps), **checked,
    )  # fmt: skip


def _named_trajectories(arrays: dict[str, Any], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the trajectory index of every sample, and the trajectories' names; `InputError` for invalid ones.

    The samples of each trajectory must be contiguous and in the order of time.
    """
    trajectory = numeric(arrays, "trajectory", t.shape, most=np.inf)
    if (trajectory != np.round(trajectory)).any() or trajectory.min() < 0 or trajectory.max() > LARGEST_INDEX:
        raise InputError("trajectory has entries that are not whole numbers >= 0; give the index of each trajectory")
    trajectory = trajectory.astype(np.int64)
    if "label" not in arrays:
        present, trajectory = np.unique(trajectory, return_inverse=True)
        trajectory, label = trajectory.reshape(-1), present.astype(str)
    else:
        count = int(trajectory.max()) + 1
        try:
            label = np.asarray(arrays["label"])
        except ValueError as error:
            raise InputError("label is ragged; expected one string per trajectory") from error
        if label.dtype.kind not in "US" or label.ndim != 1:
            stated = f"type {label.dtype} and shape {label.shape}"
            raise InputError(f"label has {stated}; expected one string per trajectory")
        if len(label) < count:
            stated = f"names {len(label)} trajectories, but trajectory counts {count}"
            raise InputError(f"label {stated}; add the missing names")
        if len(set(label)) < len(label):
            raise InputError("label has repeated names; give every trajectory its own name")
        label = label.astype(str)
    same = trajectory[1:] == trajectory[:-1]
    starts = trajectory[np.flatnonzero(np.r_[True, ~same])]
    if len(set(starts)) < len(starts):
        raise InputError("trajectory returns to an earlier index; keep the samples of each trajectory together")
    for sample in 1 + np.flatnonzero(same & (np.diff(t) <= 0))[:1]:
        raise InputError(
            f"t does not increase at sample {sample} of trajectory '{label[trajectory[sample]]}'; sort the samples by "
            "time, keep one for each time, and number consecutive recordings in a column 'trajectory'"
        )
    return trajectory, label


def _unwrap(q: np.ndarray, trajectory: np.ndarray, revolute: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Removes jumps by 2 pi from angles of sensors that wrap; also returns remarks.

    A joint stays unchanged if one of its unwrapped jumps, or more than one in a hundred of its steps, is long: its
    jumps could be motions.

    Args:
        q: [N, d].
        trajectory: trajectory index of every sample [N].
        revolute: mask of revolute joints [d].
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
    """Differentiates values [N, d] over t [N] by second-order finite differences, for each trajectory.

    Differences are central inside and one-sided at the ends, at any spacing.

    Raises:
        InputError: a trajectory has fewer than three samples; the message contains `name`, the estimated key.
    """
    result = np.empty_like(values)
    for index in np.unique(trajectory):
        samples = trajectory == index
        count = int(samples.sum())
        if count < 3:
            raise InputError(
                f"{name} is missing, and trajectory {index} has {count} sample(s) but its estimate needs at least 3; "
                f"add {name} or record longer trajectories"
            )
        result[samples] = np.gradient(values[samples], t[samples], axis=0, edge_order=2)
    return result


def save(path: str | Path, data: Trajectories, *, overwrite: bool = False) -> None:
    """Writes trajectories to an npz file that `load_trajectories` reads, without estimated arrays.

    Args:
        path: file name, which ends in .npz.
        data: trajectories in SI units.
        overwrite: replace an existing file.

    Raises:
        InputError: the name does not end in .npz, the file exists and `overwrite` is false, its folder does not exist,
            or the data break the schema. Nothing is written then.

    Example:
        >>> import tempfile
        >>> import dln_jax
        >>> from dln_jax.scenes.datasets.generators import uniform
        >>> from dln_jax.scenes.pendulums import pendulum
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dln_jax.save_trajectories(f"{folder}/swings.npz", uniform(pendulum(), samples=50))
        ...     print(dln_jax.load_trajectories(f"{folder}/swings.npz").tau.shape)
        (50, 1)
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{path}: trajectories are stored as npz; choose a name that ends in .npz")
    if (path.exists() or path.is_symlink()) and not (overwrite and is_file(path)):
        raise InputError(f"{path} exists; choose another name or pass overwrite=True")
    if not isinstance(data, Trajectories):
        raise InputError(
            f"data is a {type(data).__name__}; expected Trajectories, for example from `load_trajectories`"
        )
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
