"""Options of training commands that only some models and optimisers take: unset is `None`, what is set must count."""

from collections.abc import Iterable, Mapping
from typing import Any

from dln_jax.types import InputError


def refuse_given(given: Any, names: Iterable[str], why: str) -> None:
    """Raises `InputError` for the first of these options that was given, for example "--batch is for adam: ..."."""
    for name in names:
        if getattr(given, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} is {why}; leave it out")


def resolved(given: Any, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The options that `defaults` names, with its values for those that were not given."""
    stated = {name: getattr(given, name) for name in defaults}
    return {name: defaults[name] if value is None else value for name, value in stated.items()}
