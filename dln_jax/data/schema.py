"""Schema of trajectory files (npz, CSV, ROS bags): how they are read, checked and written.

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

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from dln_jax.data import bags, csv_tables, joint_names
from dln_jax.data.arrays import FOLDER, load_file, numeric, unread_line
from dln_jax.data.schema_keys import KEYS, OPTIONAL, RATES
from dln_jax.data.stated_facts import scaled, with_chosen, with_times
from dln_jax.data.stated_needs import needs_from_text
from dln_jax.data.trajectory_times import require_increasing_time, time_derivative, trajectory_names, unwrapped
from dln_jax.files import is_file, is_folder, writing
from dln_jax.types import InputError, Needs

Data = TypeVar("Data")
ABSOLUTE_ZERO = -273.15
"""°C."""


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
    """How the file was read: columns and joints left out or matched, repaired stamps, and the clock of a bag."""

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
        path: .csv for CSV (see `data.csv_tables`); .db3, .mcap, .bag or a folder for a bag (see `data.bags`).
        rate: sampling rate of all trajectories, Hz, for a file without t.
        units: units of CSV titles without one, "si" or "degrees".
        joints: names of joints to keep, in this order, or LOG=NEW to rename one (see `data.joint_names.chosen`).
        topics: topics of joint states in a bag; by default the only one.
        torque_factor: factor of tau, N m per A for currents: one number, one for each joint, or numbers by name.
        robot: names of the robot's joints; of a bag only those are read (`splits.with_joints` orders them).

    Raises:
        InputError: the file is missing, damaged or pickled, breaks the schema, or lacks a stated joint or topic.
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
    """Result of `from_arrays` on a file's arrays, completed with t and trajectory; arguments and errors: see `load`."""
    suffix, folder = Path(path).suffix.lower(), is_folder(Path(path))
    if units is not None and suffix != ".csv":
        raise InputError(f"{path!s:.200}: units are for CSV; npz files and bags are in SI units")
    of_bag = folder or suffix in bags.SUFFIXES
    if topics and not of_bag:
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
        return from_arrays(scaled(with_chosen(with_times(arrays, rate), joints, of_bag), torque_factor))

    return load_file(path, completed, KEYS, readers=readers)


def column(data: Trajectories, key: str) -> np.ndarray:
    """One of the optional arrays; raises `InputError` if it is absent."""
    array = getattr(data, key)
    if array is None:
        raise InputError(f"the data have no {key}, which is needed here; add it")
    return array


def from_arrays(arrays: dict[str, Any]) -> Trajectories:
    """Checks arrays against the schema and completes them; an `InputError` names the key, its content and a remedy."""
    q = numeric(arrays, "q")
    if q.ndim != 2 or q.shape[1] == 0:
        raise InputError(f"q has shape {q.shape}; expected [N, d] with d >= 1: one column per coordinate")
    samples = q.shape[0]
    if samples < 2:
        raise InputError(f"q has {samples} sample(s); expected at least 2: record longer trajectories")
    t = numeric(arrays, "t", (samples,))
    trajectory, label = trajectory_names(arrays, samples)
    require_increasing_time(t, trajectory, label)

    needs = needs_from_text(str(arrays["needs"])) if "needs" in arrays else None
    if needs is not None and needs.degrees_of_freedom != q.shape[1]:
        raise InputError(
            f"needs states {needs.degrees_of_freedom} joints, but q has {q.shape[1]} columns; make them agree"
        )
    turning = ["revolute"] * q.shape[1] if needs is None else needs.joints
    q, wraps = unwrapped(q, trajectory, np.array(turning) == "revolute")
    checked = {"q": q} | {key: numeric(arrays, key, q.shape) for key in (*RATES, *OPTIONAL) if key in arrays}
    estimated = tuple(key for key in (*RATES, "tau") if key not in arrays)
    for key, source in zip(RATES, ("q", "qd"), strict=True):
        if key in estimated:
            checked[key] = time_derivative(t, checked[source], trajectory, name=key)
    checked.setdefault("tau", np.zeros_like(q))
    if arrays.get("temperature") is not None:
        checked["temperature"] = _temperature(arrays, q.shape)
    names = _joint_names(arrays["joint_names"], q.shape[1]) if "joint_names" in arrays else None
    return Trajectories(
        t=t, trajectory=trajectory, label=label, needs=needs, joint_names=names, estimated=estimated,
        remarks=(*unread_line(arrays), *arrays.get("remarks", ()), *wraps), **checked,
    )  # fmt: skip


def _temperature(arrays: dict[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    """Temperatures [N, d], from one for each joint or one for all."""
    stated = np.asarray(arrays["temperature"])
    common = stated.ndim == 1 or (stated.ndim == 2 and stated.shape[1] == 1)
    values = numeric({"temperature": stated.reshape(-1) if common else stated}, "temperature", shape[: 2 - common])
    if values.min() < ABSOLUTE_ZERO:
        raise InputError(f"temperature is {values.min():.3g} °C, below absolute zero; expected degrees Celsius")
    return np.broadcast_to(values[:, None], shape).copy() if common else values


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
        raise InputError(
            "a field is fitted to p and pd, which the data do not have; add them, or fit trajectories instead"
        )
    return data.p, data.pd


def _joint_names(stated: Any, d: int) -> np.ndarray:
    names = np.asarray(stated)
    if names.dtype.kind not in "US" or names.shape != (d,) or len(set(names.tolist())) < d:
        raise InputError(f"joint_names has type {names.dtype} and shape {names.shape}; expected {d} different strings")
    return names.astype(str)
