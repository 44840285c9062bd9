"""Joint names of logs: selection, renaming, and their match with the names of a robot.

Names that differ from the robot's by one prefix or one ending are matched, such as `panda_joint1` and `fer_joint1`, or
`elbow` and `elbow_joint`: replacing it must turn every name of the robot into one of the log, in exactly one way.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dln_jax.types import InputError


class Chosen(NamedTuple):
    """Joints of a log that are kept, in their order."""

    own: tuple[str, ...]
    """Names in the log."""
    names: tuple[str, ...]
    """The same joints, renamed."""


def chosen(own: Sequence[str], stated: Sequence[str]) -> Chosen:
    """Applies the joints that a user stated to the names of a log.

    Args:
        own: names in the log.
        stated: entries `LOG=NEW` rename a joint; if any entry is a name alone, only stated joints are kept, in order.

    Raises:
        InputError: an unknown name, an empty one, or two joints with one name.
    """
    pairs = [tuple(part.strip() for part in entry.partition("=")[::2]) for entry in stated]
    renamed = {old: new if "=" in entry else old for entry, (old, new) in zip(stated, pairs, strict=True)}
    for old, new in renamed.items():
        if old not in own:
            raise InputError(f"--joints: '{old:.60}' is not among the log's joints ({_listed(own)})")
        if not new:
            raise InputError(f"--joints: '{old:.60}=' lacks a name; expected LOG=NEW")
    selects = any("=" not in entry for entry in stated)
    kept = tuple(renamed) if selects else tuple(own)
    names = tuple(renamed.get(name, name) for name in kept)
    if len(set(names)) < len(names) or len(renamed) < len(stated):
        raise InputError(f"--joints names a joint twice: {_listed(names)}")
    return Chosen(kept, names)


def matched(own: Sequence[str], wanted: Sequence[str]) -> dict[str, str]:
    """The name in the log of every joint of a robot: the same, or the same but for one prefix or ending.

    Args:
        own: names in the log.
        wanted: names of the robot.

    Raises:
        InputError: no replacement fits all joints, or more than one does.
    """
    if set(wanted) <= set(own):
        return {name: name for name in wanted}
    options = [*_by_prefix(own, wanted), *({a[::-1]: b[::-1] for a, b in option.items()} for option in _by_prefix(
        [name[::-1] for name in own], [name[::-1] for name in wanted]
    ))]  # fmt: skip
    options = [option for place, option in enumerate(options) if option not in options[:place]]
    if len(options) == 1:
        return options[0]
    remedy = "state them: --joints LOG=ROBOT,LOG=ROBOT"
    if options:
        first, second = (", ".join(f"{b}={a}" for a, b in option.items()) for option in options[:2])
        raise InputError(f"the joints match the robot's in more than one way ({first:.150}; {second:.150}); {remedy}")
    missing = next(name for name in wanted if name not in own)
    raise InputError(f"the robot's joint '{missing}' is not among the data's ({_listed(own)}); {remedy}")


def _by_prefix(own: Sequence[str], wanted: Sequence[str]) -> list[dict[str, str]]:
    """Matches by the replacement of one prefix, which leaves at least one character of every name."""
    known = {name.casefold(): name for name in own}
    options = []
    for name in own:
        common = _common_ending(name.casefold(), wanted[0].casefold())
        there, here = len(name) - common, len(wanted[0]) - common
        prefix, replaced = name[:there].casefold(), wanted[0][:here].casefold()
        if not common or not all(other.casefold().startswith(replaced) and len(other) > here for other in wanted):
            continue
        option = {other: known.get(prefix + other[here:].casefold(), "") for other in wanted}
        if all(option.values()):
            options.append(option)
    return options


def _common_ending(first: str, second: str) -> int:
    count = 0
    while count < min(len(first), len(second)) and first[-1 - count] == second[-1 - count]:
        count += 1
    return count


def factors(
    stated: float | int | Sequence[float | int] | Mapping[str, float | int], names: Sequence[str]
) -> list[float]:
    """Factor of every joint's torque, from one number, one per joint, or numbers by name (1 for other joints).

    Raises:
        InputError: another number of factors than joints, an unknown name, or a factor of zero.
    """
    if isinstance(stated, Mapping):
        if unknown := [name for name in stated if name not in names]:
            raise InputError(f"--torque-factor: '{unknown[0]:.60}' is not among the log's joints ({_listed(names)})")
        numbers = [float(stated.get(name, 1.0)) for name in names]
    else:
        numbers = [float(stated)] * len(names) if isinstance(stated, float | int) else [float(n) for n in stated]
    if len(numbers) != len(names):
        raise InputError(f"--torque-factor has {len(numbers)} numbers, the log {len(names)} joints; give one, or all")
    if not all(numbers):
        raise InputError("--torque-factor is zero; expected N m per unit of the log's efforts, negative to turn a sign")
    return numbers


def _listed(names: Sequence[str]) -> str:
    text = ", ".join(names) or "none"
    return text if len(text) <= 300 else f"{text[:300]}..."
