"""Reads joint states from ROS bags with rosbags: `sensor_msgs/JointState` of ROS 2 (sqlite, MCAP) and ROS 1.

A message has a stamp, names, and positions, velocities and efforts in SI units, each empty or with one number per name.
Each quantity of each joint is a separate series, so names may come in any order and be absent from some messages. Three
rules put the series on one clock:

- The stamps of the slowest series are the times of the log.
- Cubic splines interpolate the positions and velocities of the other series; efforts, which may jump, are linear.
- A time is left out unless the two messages of each series around it are at most `BRIDGED` median steps apart.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from dln_jax.types import InputError, require_once

SUFFIXES = (".db3", ".mcap", ".bag")
METADATA = "metadata.yaml"
"""File that marks a folder as a ROS 2 bag."""
TYPE = "sensor_msgs/msg/JointState"
FIELDS = {"position": "q", "velocity": "qd", "effort": "tau"}
"""Fields of a message, and their keys in the schema."""
BRIDGED = 2.5
"""Largest time between two messages for interpolation, in median steps: one lost message is bridged."""
RESTART = 1_000_000_000
"""Largest backward jump of stamps in ns that counts as messages out of order; a longer jump discards the stamps."""
INSTALL = "pip install 'dln-jax[bag]'"

Selection = Callable[[Sequence[str]], Mapping[str, str]]
"""Names in the log -> joints to keep, in order, with their new names."""
Quantity = tuple[str, str]
"""A field and a joint."""
Series = tuple[np.ndarray, np.ndarray, str]
"""One quantity of one joint: increasing stamps in ns, values, and the topic."""


def read(path: Path, *, topics: Sequence[str], select: Selection) -> dict[str, Any]:
    """Reads a bag, or every bag in a folder as a trajectory: arrays by schema key.

    Args:
        path: .db3, .mcap or .bag file, folder of a ROS 2 bag, or folder of bags.
        topics: topics to read; the first one with a quantity counts (default: the only topic of joint states).
        select: selects and renames joints.

    Raises:
        InputError: no rosbags, no bag, an absent or ambiguous topic, malformed messages, or no overlap in time.
    """
    bags = _paths(path)
    parts, remarks = [], []
    for bag in bags:
        try:
            arrays, of_bag = _read_one(bag, topics, select)
        except InputError as error:
            raise InputError(str(error) if bag == path else f"{bag.name}: {error}") from None
        parts.append(arrays)
        remarks += [f"{bag.name}: {remark}" for remark in of_bag]
    first = parts[0]
    for bag, part in zip(bags, parts, strict=True):
        if (missing := {*first} ^ {*part}) or part["joint_names"].tolist() != first["joint_names"].tolist():
            what = f"{', '.join(sorted(missing))} only in one" if missing else "other joints"
            raise InputError(f"{bags[0].name} and {bag.name} differ ({what}); give bags of the same joints and fields")
    arrays = {key: np.concatenate([part[key] for part in parts]) for key in first}
    return {
        **arrays,
        "trajectory": np.repeat(np.arange(len(parts)), [len(part["t"]) for part in parts]),
        "label": np.array([bag.stem for bag in bags]),
        "joint_names": first["joint_names"],
        "remarks": tuple(remarks),
    }


def _paths(path: Path) -> list[Path]:
    """Returns the bags at a path."""
    if not path.is_dir() or (path / METADATA).is_file():
        return [path]
    inside = sorted(
        entry for entry in path.iterdir() if entry.suffix.lower() in SUFFIXES or (entry / METADATA).is_file()
    )
    if not inside:
        raise InputError(f"the folder has neither {METADATA}, as a ROS 2 bag has, nor bags ({', '.join(SUFFIXES)})")
    if len({bag.stem for bag in inside}) < len(inside):
        raise InputError("the folder has two bags of one name; rename one, since names label the trajectories")
    return inside


def _read_one(path: Path, topics: Sequence[str], select: Selection) -> tuple[dict[str, np.ndarray], list[str]]:
    """Reads the arrays of one bag, and remarks."""
    series: dict[Quantity, Series] = {}
    remarks: list[str] = []
    messages = _messages(path, topics)
    for topic, rows in messages.items():
        series = {**_series(topic, rows, remarks), **series}
    positioned = list(dict.fromkeys(joint for field, joint in series if field == "position"))
    if not positioned:
        raise InputError(f"no message of {', '.join(messages)} has names and positions; choose others: --topics")
    joints = select(positioned)
    there = {field: [joint for joint in joints if (field, joint) in series] for field in FIELDS}
    if left_out := [joint for joint in positioned if joint not in joints]:
        remarks.append(f"joints left out: {', '.join(left_out)}")
    if any(series["effort", joint][1].any() for joint in there["effort"]):
        if without := [joint for joint in joints if joint not in there["effort"]]:
            raise InputError(
                f"joint '{without[0]}' has no efforts, others have; read these alone: --joints "
                f"{','.join(there['effort'])}"
            )
    else:
        remarks.append("no efforts in the messages (none, NaN or zeros only), so there is no tau")
        there["effort"] = []
    if 0 < len(there["velocity"]) < len(joints):
        remarks.append("velocities of some joints are missing; they are derived from q for all")
    complete = [field for field, names in there.items() if len(names) == len(joints)]
    series = {(field, joint): series[field, joint] for field in complete for joint in joints}
    times, values = _on_one_clock(series, remarks)
    columns = {FIELDS[field]: np.stack([values[field, joint] for joint in joints], axis=1) for field in complete}
    names = np.array(list(joints.values()))
    return {"t": 1e-9 * (times - times[0]), **columns, "joint_names": names}, remarks


def _on_one_clock(series: dict[Quantity, Series], remarks: list[str]) -> tuple[np.ndarray, dict[Quantity, np.ndarray]]:
    """Returns the stamps of the slowest series and the values of all series at them; adds to the remarks.

    Raises:
        InputError: the series do not overlap in time.
    """
    steps = {key: np.median(np.diff(own)) if len(own) > 1 else np.inf for key, (own, _, _) in series.items()}
    # Steps that agree to 1 % count as one rate; take the series of that rate with the fewest messages.
    slowest = max(steps.values())
    key = min((key for key in series if steps[key] >= 0.99 * slowest), key=lambda key: len(series[key][0]))
    clock, _, topic = series[key]
    inside = np.ones(len(clock), bool)
    for other, (stamps, _, _) in series.items():
        after = np.searchsorted(stamps, clock)
        gaps = np.r_[np.nan, np.diff(stamps), np.nan]  # before each message, and behind the last
        inside &= np.isin(clock, stamps) | (gaps[after] <= BRIDGED * steps[other])
    times = clock[inside]
    if len(times) < 2:
        topics = ", ".join(sorted({own for _, _, own in series.values()}))
        raise InputError(
            f"the messages of {topics} do not overlap in time ({len(times)} common samples); leave joints out by "
            f"--joints, or choose other --topics"
        )
    exact, values = True, {}
    for (field, joint), (stamps, known, _) in series.items():
        equal = np.isin(times, stamps)
        t, at = 1e-9 * (stamps - stamps[0]), 1e-9 * (times - stamps[0])
        cubic = field != "effort" and len(t) > 3 and not equal.all()
        values[field, joint] = CubicSpline(t, known)(at) if cubic else np.interp(at, t, known)
        values[field, joint][equal] = known[np.isin(stamps, times)]
        exact &= bool(equal.all())
    if not exact or not inside.all():
        rate = f"{1e9 / steps[key]:.4g} Hz" if np.isfinite(steps[key]) else "one message"
        rule = "" if exact else "; q and qd by cubic splines between messages, tau linearly"
        left = f"; {np.sum(~inside)} times without near messages of all joints are left out" * (not inside.all())
        remarks.append(f"clock: stamps of {key[0]} of {key[1]} in {topic}, {rate}{rule}{left}")
    return times, values


def _series(topic: str, rows: Sequence[tuple[int, Any]], remarks: list[str]) -> dict[Quantity, Series]:
    """Sorts (time of receipt in ns, message) into series by field and joint; adds to the remarks."""
    columns: dict[Quantity, list[tuple[int, float]]] = {}
    for number, (_, message) in enumerate(rows):
        names = list(message.name)
        require_once(f"message {number + 1} of {topic}", names)
        for field in FIELDS:
            values = getattr(message, field)
            if len(values) and len(values) != len(names):
                raise InputError(
                    f"message {number + 1} of {topic} has {len(names)} names, but {field} of length {len(values)}"
                )
            for joint, value in zip(names, values, strict=False):
                if np.isfinite(value):
                    columns.setdefault((field, joint), []).append((number, float(value)))
    stamps = [message.header.stamp for _, message in rows]
    times = np.array([stamp.sec * 1_000_000_000 + stamp.nanosec for stamp in stamps], np.int64)
    if not times.all() or (np.diff(times) < -RESTART).any():
        why = "some messages have no stamp" if not times.all() else "stamps jump back by more than 1 s"
        remarks.append(f"{topic}: {why}; times of receipt are used")
        times = np.array([receipt for receipt, _ in rows], np.int64)
    series, repeated, backward = {}, [], []
    for key, column in columns.items():
        numbers, values = np.transpose(column)
        own = times[numbers.astype(int)]
        distinct, first = np.unique(own, return_index=True)
        series[key] = distinct, values[first], topic
        repeated.append(len(own) - len(distinct))
        backward.append(np.sum(np.diff(own) < 0))
    if any(repeated):
        remarks.append(f"{topic}: {max(repeated)} messages repeat a stamp (the first is kept)")
    if any(backward):
        remarks.append(f"{topic}: {max(backward)} messages are earlier than the one before (sorted by stamp)")
    return series


def _messages(path: Path, topics: Sequence[str]) -> dict[str, list[tuple[int, Any]]]:
    """Reads messages and their times of receipt by topic, in the order of `topics`."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"reading ROS bags needs the package rosbags: {INSTALL}") from None
    try:
        # Bags of older releases do not define their messages.
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            everywhere = {connection.topic: connection.msgtype for connection in reader.connections}
            wanted = _wanted(topics, everywhere)
            connections = [connection for connection in reader.connections if connection.topic in wanted]
            rows: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in wanted}
            for connection, receipt, raw in reader.messages(connections=connections) if connections else ():
                rows[connection.topic].append((receipt, reader.deserialize(raw, connection.msgtype)))
    except InputError:
        raise
    except Exception as error:  # the readers of sqlite, MCAP, YAML and CDR raise many types
        reason = (str(error).splitlines() or [""])[0][:120]
        raise InputError(f"not a readable ROS bag ({type(error).__name__}: {reason}); see `ros2 bag info`") from error
    if empty := [topic for topic, own in rows.items() if not own]:
        raise InputError(f"topic {empty[0]} has no messages")
    return rows


def _wanted(topics: Sequence[str], everywhere: dict[str, str]) -> list[str]:
    """Returns the topics to read; error messages list the available ones."""
    joint_states = [topic for topic, kind in everywhere.items() if kind == TYPE]
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(everywhere.items()))
    listed = f"the bag has {listed or 'no topics'}"
    if absent := [topic for topic in topics if topic not in everywhere]:
        raise InputError(f"topic {absent[0]:.80} is not in the bag; {listed:.600}")
    if other := [topic for topic in topics if topic not in joint_states]:
        raise InputError(f"topic {other[0]} has messages {everywhere[other[0]]}; expected {TYPE}; {listed:.600}")
    if not joint_states:
        raise InputError(f"no topic has {TYPE}; {listed:.600}")
    if not topics and len(joint_states) > 1:
        raise InputError(f"{', '.join(joint_states)} have joint states; choose, or combine, by --topics A,B")
    return list(dict.fromkeys(topics)) or joint_states
