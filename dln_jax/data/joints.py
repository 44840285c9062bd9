"""Joints as users state them: names, their match with a robot's names, torque factors, and `Needs` in JSON.

Names match if they differ from the robot's by one prefix or one ending, such as `panda_joint1` and `fer_joint1`, or
`elbow` and `elbow_joint`. Exactly one replacement must turn every robot name into a name of the log.
"""

import json
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dln_jax.files import matches
from dln_jax.mechanics.friction import require_laws
from dln_jax.types import InputError, Needs, require_once

OPTIONAL = ("qd", "qdd", "tau", "p", "pd", "tau_inertial", "tau_coriolis", "tau_gravity")
PER_JOINT = ("q", *OPTIONAL, "temperature")
"""Keys of arrays with one column per joint."""


TorqueFactor = float | int | Sequence[float | int] | Mapping[str, float | int]
"""Factors of tau: one number, one per joint, or numbers by name."""


def select_names(own: Sequence[str], stated: Sequence[str]) -> dict[str, str]:
    """Returns the joints that a user selects: names in the log -> new names, in the stated order.

    Args:
        own: names in the log.
        stated: `LOG=NEW` renames a joint; if any entry is a plain name, only the stated joints are kept, in order.

    Raises:
        InputError: an unknown name, an empty one, or two joints with one name.
    """
    renamed: dict[str, str] = {}
    for entry in stated:
        old, renames, new = map(str.strip, entry.partition("="))
        if old not in own:
            raise InputError(f"--joints: '{old:.60}' is not a joint of the log ({_listed(own)})")
        if renames and not new:
            raise InputError(f"--joints: '{old:.60}=' lacks a name; expected LOG=NEW")
        renamed[old] = new or old
    kept = own if all("=" in entry for entry in stated) else renamed
    selected = {name: renamed.get(name, name) for name in kept}
    names = list(selected.values())
    if len(set(names)) < len(names) or len(renamed) < len(stated):
        raise InputError(f"--joints names a joint twice: {_listed(names)}")
    return selected


def with_selected_joints(arrays: dict[str, Any], joints: Sequence[str]) -> dict[str, Any]:
    """Selects, orders and renames the joints of a file's arrays as stated (see `select_names`).

    Raises:
        InputError: joints are stated, but the file has no names, or `select_names` refuses them.
    """
    if not joints:
        return arrays
    names = np.asarray(arrays.get("joint_names", ()))
    if names.ndim != 1 or not names.size or names.dtype.kind not in "US":
        raise InputError("--joints needs joint names, but the file has none; add joint_names, or names in titles")
    own = names.tolist()
    selected = select_names(own, joints)
    places = [own.index(name) for name in selected]
    if "needs" in arrays and places != list(range(len(own))):
        raise InputError(
            "--joints selects or reorders joints, but the file states needs for all of them; leave --joints out"
        )
    per_joint = [key for key in PER_JOINT if np.shape(arrays.get(key))[1:] == (len(own),)]
    columns = {key: np.asarray(arrays[key])[:, places] for key in per_joint}
    return {**arrays, **columns, "joint_names": np.array(list(selected.values()))}


def match_names(own: Sequence[str], wanted: Sequence[str]) -> dict[str, str]:
    """Matches the joints of a robot with names in the log, which may differ by one prefix or ending.

    Args:
        own: names in the log.
        wanted: names of the robot.

    Raises:
        InputError: no replacement fits all joints, or more than one does.
    """
    if set(wanted) <= set(own):
        return {name: name for name in wanted}
    options = _by_prefix(own, wanted)
    backwards = _by_prefix([name[::-1] for name in own], [name[::-1] for name in wanted])
    by_ending = [{a[::-1]: b[::-1] for a, b in option.items()} for option in backwards]
    options += [option for option in by_ending if option not in options]
    if len(options) == 1:
        return options[0]
    remedy = "state them: --joints LOG=ROBOT,LOG=ROBOT"
    if options:
        first, second = (", ".join(f"{b}={a}" for a, b in option.items()) for option in options[:2])
        raise InputError(f"the joints match the robot's in more than one way ({first:.150}; {second:.150}); {remedy}")
    missing = next(name for name in wanted if name not in own)
    raise InputError(f"the robot's joint '{missing}' is not in the data ({_listed(own)}); {remedy}")


def _by_prefix(own: Sequence[str], wanted: Sequence[str]) -> list[dict[str, str]]:
    """Returns the matches by replacing one prefix, which must leave at least one character of every name."""
    known, first = {name.casefold(): name for name in own}, wanted[0].casefold()
    options = []
    for name in known:
        # Shortest replaced part before the common ending.
        here = next((k for k in range(len(first)) if name.endswith(first[k:])), len(first))
        prefix, replaced = name.removesuffix(first[here:]), first[:here]
        if not all(other.casefold().startswith(replaced) and len(other) > here for other in wanted):
            continue
        option = {other: known.get(prefix + other.casefold()[here:], "") for other in wanted}
        if all(option.values()) and option not in options:
            options.append(option)
    return options


def scale_torques(arrays: dict[str, Any], stated: TorqueFactor | None) -> dict[str, Any]:
    """Multiplies tau by one factor, one per joint, or factors by name (1 for other joints).

    Raises:
        InputError: tau is missing, the number of factors differs from the joints, or a name or factor is invalid.
    """
    if stated is None:
        return arrays
    if np.ndim(arrays.get("tau")) != 2:
        why = "".join(f"; {remark}" for remark in arrays.get("remarks", ()))
        raise InputError(f"--torque-factor scales tau, but the file has no tau; leave it out{why}")
    count = np.shape(arrays["tau"])[1]
    names = np.asarray(arrays.get("joint_names", [str(joint + 1) for joint in range(count)])).astype(str).tolist()
    if isinstance(stated, Mapping):
        if unknown := [name for name in stated if name not in names]:
            raise InputError(f"--torque-factor: '{unknown[0]:.60}' is not a joint of the log ({_listed(names)})")
        factors = [stated.get(name, 1.0) for name in names]
    else:
        factors = [stated] * count if isinstance(stated, float | int) else stated
    if len(factors) != count:
        raise InputError(
            f"--torque-factor has {len(factors)} numbers, but the log has {count} joints; give one, or all"
        )
    if not all(factors):
        raise InputError("--torque-factor is zero; expected N m per unit of the log's efforts, negative to turn a sign")
    listed = ", ".join(f"{name} {factor:.4g}" for name, factor in zip(names, factors, strict=True))
    remarks = (*arrays.get("remarks", ()), f"tau of the log is multiplied by {listed}")
    return {**arrays, "tau": np.asarray(arrays["tau"]) * np.asarray(factors, float), "remarks": remarks}


def _listed(names: Sequence[str]) -> str:
    text = ", ".join(names) or "none"
    return text if len(text) <= 300 else f"{text[:300]}..."


def needs_from_text(text: str) -> Needs:
    """Reads `Needs` from JSON text; errors as for `needs_from_json`, also for text that is not JSON."""
    try:
        stated = json.loads(text, object_pairs_hook=_fields_once)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0][:80]
        raise InputError(f"needs is not JSON ({reason}); expected the fields {', '.join(Needs._fields)}") from error
    return needs_from_json(stated)


def needs_from_json(stated: Any) -> Needs:
    """Converts parsed JSON to `Needs`.

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
