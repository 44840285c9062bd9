"""Reads `Needs` from JSON, as stated in a data file, on the command line or in a stored model."""

import json
import reprlib
from typing import Any

import numpy as np

from dln_jax.files import matches
from dln_jax.mechanics.friction import require_laws
from dln_jax.types import InputError, Needs, require_once


def needs_from_text(text: str) -> Needs:
    """`Needs` from JSON text; errors as for `needs_from_json`, also for text that is not JSON."""
    try:
        stated = json.loads(text, object_pairs_hook=_fields_once)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0][:80]
        raise InputError(f"needs is not JSON ({reason}); expected the fields {', '.join(Needs._fields)}") from error
    return needs_from_json(stated)


def needs_from_json(stated: Any) -> Needs:
    """`Needs` from parsed JSON.

    Raises:
        InputError: unknown or missing fields, or values of the wrong kind.
    """
    if not isinstance(stated, dict) or not set(stated) <= set(Needs._fields) or "joints" not in stated:
        raise _wrong("JSON", stated, f"the fields {', '.join(Needs._fields)}")
    if isinstance(laws := stated.get("joint_friction", ()), list | tuple):
        require_laws(laws, "needs: joint_friction")
    try:
        needs = Needs(**{**stated, "actuation": None, "joint_map": None})
    except InputError as error:
        raise InputError(f"needs: {error}") from None
    d, velocity = needs.degrees_of_freedom, needs.velocity_scale
    if not (matches(velocity, float) and velocity > 0):
        raise _wrong("velocity_scale", velocity, "a positive number, rad/s or m/s")
    actuation, joint_map = (_rows(key, stated.get(key), d) for key in ("actuation", "joint_map"))
    if joint_map is not None and (len(joint_map[0]) != d or np.linalg.matrix_rank(joint_map) < d):
        raise _wrong("joint_map", joint_map, f"an invertible matrix [{d}, {d}], or null")
    return needs._replace(actuation=actuation, joint_map=joint_map, velocity_scale=float(velocity))


def _fields_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    require_once("needs", [key for key, _ in pairs])
    return dict(pairs)


def _rows(key: str, stated: Any, joints: int) -> tuple[tuple[float, ...], ...] | None:
    if stated is None:
        return None
    rows: list[tuple[Any, ...]] = []
    if isinstance(stated, list | tuple) and all(isinstance(row, list | tuple) for row in stated):
        rows = [tuple(row) for row in stated]
    if len(rows) != joints or len({len(row) for row in rows}) != 1 or not rows[0]:
        raise _wrong(key, stated, f"[{joints}, u] with u >= 1, rows of one length, or null")
    if not all(matches(entry, float) for row in rows for entry in row):
        raise _wrong(key, stated, "finite numbers")
    return tuple(tuple(map(float, row)) for row in rows)


def _wrong(key: str, value: Any, expected: str) -> InputError:
    return InputError(f"needs: {key} is {reprlib.repr(value)}; expected {expected}")
