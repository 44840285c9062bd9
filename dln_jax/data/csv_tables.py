"""Reads logs and writes motions in CSV format: one row per sample and a header that names every column and its unit.

    t [s],q1 [deg],q2 [deg],tau1 [N m],tau2 [N m]        or        t_s,q_elbow_rad,tau_elbow_Nm

A title consists of a schema key, the joint (a number or a name; omitted for a single joint) and a unit. Values are
converted to SI. Units are never guessed: a title without a unit is refused unless the caller states `units`. Columns
may come in any order. A remark names the columns that are not read.
"""

import csv
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.data.arrays import UNREAD
from dln_jax.files import write_bytes
from dln_jax.types import InputError, JointKind, JointSamples, SampleVector

MOST_BYTES = 2**30
"""Largest file read; larger data are faster and smaller as npz."""
STATED = {"si": {}, "degrees": {"q": "deg", "qd": "deg/s", "qdd": "deg/s2"}}
"""Units by key that a caller may state for titles without a unit; other keys are in SI."""
ALONE = ("t", "trajectory")
"""Keys with a single column for any number of joints."""
DECIMALS = 10
"""Significant digits written, and decimals of rounded numbers."""
TURN = math.pi / 180
POSITIONS = {"rad": 1.0, "deg": TURN, "m": 1.0, "cm": 1e-2, "mm": 1e-3}
FORCES = {"nm": 1.0, "n": 1.0, "mnm": 1e-3, "mn": 1e-3, "knm": 1e3, "kn": 1e3}
UNITS = {
    "t": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "q": POSITIONS,
    "qd": {"rpm": math.pi / 30, **{f"{unit}/s": factor for unit, factor in POSITIONS.items()}},
    "qdd": {f"{unit}/s2": factor for unit, factor in POSITIONS.items()},
    **dict.fromkeys(("tau", "tau_inertial", "tau_coriolis", "tau_gravity", "pd"), FORCES),
    "temperature": {"degc": 1.0, "c": 1.0},
    "p": {"nms": 1.0, "ns": 1.0, "kgm2/s": 1.0, "kgm/s": 1.0},
    "trajectory": {},
}
"""Conversion factor to SI for every admissible unit, by key."""
EXAMPLES = {
    "t": "t [s]",
    "qd": "qd1 [rad/s]",
    "qdd": "qdd1 [rad/s^2]",
    "tau": "tau1 [N m]",
    "p": "p1 [N m s]",
    "temperature": "temperature [C]",
}
_SPELLINGS = {"degrees": "deg", "degree": "deg", "°": "deg", "²": "2", "µ": "u", "μ": "u", "sec": "s"}
# Longest key first, since "tau" would also match the start of "tau_inertial".
_TITLE = re.compile(rf"({'|'.join(sorted(UNITS, key=len, reverse=True))}|time)(?=$|[\d_ .\[(/])(.*)", re.DOTALL)
_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\])]*)[\])]\s*", re.DOTALL)


def read(path: Path, *, units: str | None = None) -> dict[str, Any]:
    """Reads a CSV file: arrays by schema key in SI units, and the titles of other columns under `UNREAD`.

    Args:
        units: units of titles without a unit: "si", or "degrees" for angles in degrees and the rest in SI.

    Raises:
        InputError: a missing header, a duplicate title, an unknown or missing unit, angles that look like radians
            where degrees are stated, joints that differ between q and another key, rows of different lengths, cells
            that are not numbers, or more than `MOST_BYTES`.
    """
    if units is not None and units not in STATED:
        raise InputError(f"units is {units!r:.40}; expected one of {', '.join(STATED)}")
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise InputError(f"holds {size / 2**30:.1f} GiB; at most 1 GiB is read as CSV: store it as npz, or split it")
    try:
        titles = _header(path)
        columns = {place: parsed for place, title in enumerate(titles) if (parsed := _key_joint_unit(title))}
        factors = {place: _factor(titles[place], key, unit, units) for place, (key, _, unit) in columns.items()}
        places = _by_key(titles, columns)
        table = _numbers(path, titles, set(columns))
    except UnicodeDecodeError:
        raise InputError("not a text file in UTF-8; export the log as CSV again") from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})") from None
    positions = places.get("q", [])
    bare = table[:, [place for place in positions if columns[place][2] is None]]
    if units == "degrees" and bare.size and (largest := float(np.abs(bare).max())) <= 2 * math.pi:
        raise InputError(
            f"--units degrees: q reaches only {largest:.3g}, which looks like radians; give --units si, or write [deg] "
            "into the titles if these are degrees"
        )
    arrays: dict[str, Any] = {UNREAD: [title for place, title in enumerate(titles) if place not in columns]}
    for key, own in places.items():
        values = np.stack([factors[place] * table[:, place] for place in own], axis=1)
        arrays[key] = values[:, 0] if key in ALONE else values
    joints = [columns[place][1] for place in positions]
    if not all(joint.isdecimal() or not joint for joint in joints):
        arrays["joint_names"] = np.array(joints)
    return arrays


def _header(path: Path) -> list[str]:
    """Reads the titles of all columns; `InputError` for empty or repeated ones."""
    rows = _rows(path)
    titles = [title.strip() for title in next(rows, (0, []))[1]]
    if not titles:
        raise InputError("the file is empty; expected a header such as 't [s],q1 [rad],tau1 [N m]', then numbers")
    if len(titles) == 1:
        for separator, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if separator in titles[0]:
                raise InputError(f"columns are separated by {name}; export it with commas, and decimals with points")
    if all(_number(title) is not None for title in titles):
        raise InputError("the first line holds numbers; expected a header such as 't [s],q1 [rad],tau1 [N m]'")
    for place, title in enumerate(titles):
        if not title:
            raise InputError(f"column {place + 1} has no title; name it, or remove the comma")
        if title in titles[:place]:
            raise InputError(f"two columns have the title '{title:.60}'; remove or rename one")
    return titles


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yields the line number and cells of every row, without blank lines."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file)
        try:
            for cells in reader:
                if cells:
                    yield reader.line_num, cells
        except csv.Error as error:
            raise InputError(f"line {reader.line_num} is not CSV ({error})") from None


def _key_joint_unit(title: str) -> tuple[str, str, str | None] | None:
    """Parses a title; `None` if it does not start with a schema key.

    Returns the key, the number or name of the joint (empty for none), and the unit as spelled in `UNITS`.
    """
    match = _TITLE.fullmatch(title)
    if match is None:
        return None
    key, rest = match[1].replace("time", "t"), match[2]
    if key in ALONE:
        rest = rest.strip(" _")
        inside = _BRACKETS.fullmatch(rest)
        unit = inside[2] if inside and not inside[1] else rest
        return key, "", _spelled(unit) if unit else None
    unit = None
    while inside := _BRACKETS.fullmatch(rest):
        # q[2] names a joint, q2 [rad] a unit.
        numbered = inside[2].strip().isdecimal()
        rest = f"{inside[1]} {inside[2]}" if numbered else inside[1]
        unit = unit if numbered else _spelled(inside[2])
    words = [word for word in re.split(r"[_ ]+", rest.strip("_ ./")) if word]
    for first in range(len(words) if unit is None else 0):
        if (suffix := _spelled("/".join(words[first:]))) in UNITS[key]:
            words, unit = words[:first], suffix
            break
    joint = "_".join(words)
    return key, str(int(joint)) if joint.isdecimal() else joint, unit


def _spelled(unit: str) -> str:
    """Normalises a unit to its spelling in `UNITS`; mega, which is not in the table, is spelled out."""
    unit = re.sub(r"^\s*M(?=\s*[NnMmSs])", "mega", unit)
    unit = re.sub(r"[\s/]+per[\s/]+", "/", unit.lower())
    unit = re.sub(r"[\s*·.^]", "", unit)
    for spelling, ours in _SPELLINGS.items():
        unit = unit.replace(spelling, ours)
    return unit


def _factor(title: str, key: str, unit: str | None, stated: str | None) -> float:
    """Returns the conversion factor of a column to SI."""
    known = UNITS[key]
    if not known:
        return 1.0
    if unit is None:
        if stated is None:
            example = EXAMPLES.get(key, "q1 [rad] or q1 [deg]")
            raise InputError(
                f"'{title:.60}' has no unit; write it into the header, as in '{example}', or give --units si "
                "(or degrees) for all titles without one"
            )
        return known.get(STATED[stated].get(key, ""), 1.0)
    if unit not in known:
        raise InputError(f"'{title:.60}' has an unknown unit; expected one of {', '.join(known)}")
    return known[unit]


def _by_key(titles: Sequence[str], columns: dict[int, tuple[str, str, str | None]]) -> dict[str, list[int]]:
    """Returns the columns of each key in the joint order of q: by number, or as in the file for names."""
    keys: dict[str, dict[str, int]] = {}
    for place, (key, joint, _) in columns.items():
        own = keys.setdefault(key, {})
        if joint in own:
            raise InputError(f"'{titles[own[joint]]:.60}' and '{titles[place]:.60}' are the same column")
        own[joint] = place
    joints = list(keys.get("q", {}))
    if all(joint.isdecimal() for joint in joints):
        joints.sort(key=int)
    for key, own in keys.items():
        if key in ALONE or not joints or (key == "temperature" and list(own) == [""]):
            continue
        for joint in (*joints, *own):
            if joint not in own or joint not in joints:
                name = "q" if joint in own else key
                raise InputError(f"there is no column '{name}{joint:.40}'; q and {key} must name the same joints")
        keys[key] = {joint: own[joint] for joint in joints}
    return {key: list(own.values()) for key, own in keys.items()}


def _numbers(path: Path, titles: Sequence[str], read_places: set[int]) -> np.ndarray:
    """Reads all rows below the header [N, columns], with zeros in skipped columns."""
    unread = set(range(len(titles))) - read_places
    converters: dict[int | str, Callable] = {**dict.fromkeys(unread, lambda _: 0.0)}
    header, _ = next(_rows(path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about files without samples
        try:
            table = np.loadtxt(
                path,
                delimiter=",",
                comments=None,
                quotechar='"',
                converters=converters,
                ndmin=2,
                skiprows=header,
                encoding="utf-8-sig",
            )
        except (ValueError, OverflowError):
            table = None
    if table is None or (len(table) and table.shape[1] != len(titles)):
        raise InputError(_complaint(path, titles, read_places))
    if not len(table):
        raise InputError("the file has no samples below its header; add them")
    return table


def _complaint(path: Path, titles: Sequence[str], read_places: set[int]) -> str:
    rows = _rows(path)
    next(rows)
    for line, cells in rows:
        if len(cells) != len(titles):
            decimal = "; decimals take a point, not a comma" if len(cells) > len(titles) else ""
            return f"line {line} has {len(cells)} values, the header {len(titles)} titles{decimal}"
        for place in sorted(read_places):
            if _number(cells[place]) is None:
                shown = f"'{cells[place].strip():.40}'" if cells[place].strip() else "empty"
                return f"line {line}: '{titles[place]:.60}' is {shown}; expected a number with a decimal point"
    return "the rows below the header are not a table of numbers; export the log again"


def _number(text: str) -> float | None:
    try:
        return None if "_" in text else float(text)  # float() reads "1_000" as 1000
    except ValueError:
        return None


def write_motion(
    path: Path,
    t: SampleVector,
    q: JointSamples,
    qd: JointSamples,
    *,
    names: tuple[str, ...],
    joints: tuple[JointKind, ...],
) -> None:
    """Writes t, q and qd for a robot's controller; the header is like `t [s],q elbow [rad],..,qd elbow [rad/s]`.

    Raises:
        InputError: a name contains a comma, a quote or a line break, or the file cannot be written.
    """
    if broken := [name for name in names if set(name) & set(',"\r\n')]:
        raise InputError(f"joint {broken[0]!r} cannot be a title in CSV; rename it without commas, quotes and lines")
    units = ["rad" if kind == "revolute" else "m" for kind in joints]
    titles = [
        f"{key} {name} [{unit}{per}]"
        for key, per in (("q", ""), ("qd", "/s"))
        for name, unit in zip(names, units, strict=True)
    ]
    rows: Any = np.round(np.column_stack([t, q, qd]), DECIMALS) + 0.0  # no negative zero
    lines = [",".join(["t [s]", *titles]), *(",".join(f"{number:.{DECIMALS}g}" for number in row) for row in rows)]
    write_bytes(path, ("\n".join(lines) + "\n").encode())
