"""Reads `Needs` from JSON, as stated in a data file, on the command line or in a stored model."""

import json
import reprlib
from typing import Any, get_args

import numpy as np

from dln_jax.files import matches
from dln_jax.mechanics.friction import require_laws
from dln_jax.types import InputError, JointKind, Needs

JOINTS = get_args(JointKind)


def needs_from_text(text: str) -> Needs:
    """`Needs` from JSON text; errors as `needs_from_json`, also for text that is not JSON."""
    try:
        stated = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0][:80]
        raise InputError(f"needs is not JSON ({reason}); expected the fields {', '.join(Needs._fields)}") from error
    return needs_from_json(stated)


def needs_from_json(stated: Any) -> Needs:
    """`Needs` from parsed JSON.

    Raises:
        InputError: unknown or missing fields, or values of the wrong kind.
    """
    advice = f"expected JSON with the fields {', '.join(Needs._fields)}"
    if not isinstance(stated, dict) or not set(stated) <= set(Needs._fields) or "joints" not in stated:
        raise InputError(f"needs: {advice}, got {reprlib.repr(stated)}")
    joints = stated["joints"]
    if not isinstance(joints, list | tuple) or not joints or not all(each in JOINTS for each in joints):
        raise InputError(f"needs: joints are {reprlib.repr(joints)}; expected a list of 'revolute' and 'prismatic'")
    for key in ("gravity", "friction"):
        if not isinstance(stated.get(key, False), bool):
            raise InputError(f"needs: {key} is {reprlib.repr(stated[key])}; expected true or false")
    actuation = _rows("actuation", stated.get("actuation"), len(joints))
    joint_map = _rows("joint_map", stated.get("joint_map"), len(joints))
    if joint_map is not None and (len(joint_map[0]) != len(joints) or np.linalg.matrix_rank(joint_map) < len(joints)):
        square = f"[{len(joints)}, {len(joints)}] that can be inverted"
        raise InputError(
            f"needs: joint_map is {reprlib.repr(stated['joint_map'])}; expected a matrix {square}, or null"
        )
    laws = stated.get("joint_friction", [])
    if not isinstance(laws, list | tuple):
        raise InputError(f"needs: joint_friction is {reprlib.repr(laws)}; expected a list of laws such as 'viscous'")
    require_laws(laws, "needs: joint_friction")
    velocity = stated.get("velocity_scale", Needs._field_defaults["velocity_scale"])
    if not (matches(velocity, float) and velocity > 0):
        raise InputError(f"needs: velocity_scale is {reprlib.repr(velocity)}; expected a positive number, rad/s or m/s")
    friction = {"joint_friction": tuple(laws), "joint_map": joint_map, "velocity_scale": float(velocity)}
    return Needs(**{**stated, "joints": tuple(joints), "actuation": actuation, **friction})


def _rows(key: str, stated: Any, joints: int) -> tuple[tuple[float, ...], ...] | None:
    """Reads a matrix with one row per joint."""
    if stated is None:
        return None
    rows = stated if isinstance(stated, list | tuple) else ()
    lengths = {len(row) if isinstance(row, list | tuple) else 0 for row in rows}
    if len(rows) != joints or len(lengths) != 1 or not all(lengths):
        shape = f"[{joints}, u] with u >= 1, rows of one length"
        raise InputError(f"needs: {key} is {reprlib.repr(stated)}; expected {shape}, or null")
    if not all(matches(entry, float) for row in rows for entry in row):
        raise InputError(f"needs: {key} is {reprlib.repr(stated)}; expected finite numbers")
    return tuple(tuple(float(entry) for entry in row) for row in rows)
