"""Writes motions as CSV tables for a robot controller: time first, then the positions and velocities of the joints."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from dln_jax.files import write_bytes
from dln_jax.types import InputError, JointKind

DECIMALS = 10
"""Significant digits written, and decimals to which numbers are rounded."""
_UNITS = {"revolute": "rad", "prismatic": "m"}


def write_motion(
    path: Path,
    t: Float[np.ndarray, " N"],
    q: Float[np.ndarray, "N d"],
    qd: Float[np.ndarray, "N d"],
    *,
    names: tuple[str, ...],
    joints: tuple[JointKind, ...],
) -> None:
    """Writes t, q and qd; the header is like `t [s],q elbow [rad],..,qd elbow [rad/s]`.

    Raises:
        InputError: a name contains a comma, a quote or a line break, or the file cannot be written.
    """
    if broken := [name for name in names if set(name) & set(',"\r\n')]:
        raise InputError(f"joint {broken[0]!r} cannot be a title in CSV; rename it without commas, quotes and lines")
    units = [_UNITS[kind] for kind in joints]
    titles = ["t [s]"]
    titles += [f"q {name} [{unit}]" for name, unit in zip(names, units, strict=True)]
    titles += [f"qd {name} [{unit}/s]" for name, unit in zip(names, units, strict=True)]
    rows: Any = np.round(np.column_stack([t, q, qd]), DECIMALS) + 0.0  # no negative zero
    lines = [",".join(titles), *(",".join(f"{number:.{DECIMALS}g}" for number in row) for row in rows)]
    write_bytes(path, ("\n".join(lines) + "\n").encode())
