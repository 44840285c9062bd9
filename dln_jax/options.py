"""Marks of fields of dataclasses that are options of a command. Importing them does not import JAX."""

from collections.abc import Iterable
from typing import Annotated, Any, TypeVar

import tyro

T = TypeVar("T")

Unstated = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]
"""An option that is `None` by default; its help text states the effective default."""
InPython = Annotated[T, tyro.conf.Fixed, tyro.conf.Suppress]
"""A keyword that is no option of the command line."""


def choice(names: Iterable[str], *, several: bool = False, unstated: bool = False) -> Any:
    """Shows the allowed names of an option in its help, for `Annotated[str, ...]`.

    With `several` the option takes a list of names, by default all; `unstated` hides the default, as for `Unstated`.
    """
    return tyro.conf.arg(
        metavar="{" + ",".join(names) + "}" + "[,...]" * several, help_behavior_hint="" if several or unstated else None
    )
