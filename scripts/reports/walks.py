"""Files of the library that a run enters, and the files that call them: how much a reader has to follow."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

import dln_jax

ROOT = Path(dln_jax.__file__).parent
BODIES = ("<module>", "<genexpr>", "<listcomp>", "<dictcomp>", "<setcomp>")
"""Code that is entered without a visible call: imports and comprehensions."""


class Walk(NamedTuple):
    """The files that were entered, in the order of their first call, and pairs of (calling file, called file)."""

    files: tuple[str, ...]
    arrows: tuple[tuple[str, str], ...]


def walk_of(program: Callable[[], Any]) -> Walk:
    """Returns the walk of a program in this thread; calls from other libraries count from the last file of ours."""
    files: dict[str, None] = {}
    arrows: dict[tuple[str, str], None] = {}
    known: dict[CodeType, str | None] = {}

    def name_of(code: CodeType) -> str | None:
        if code not in known:
            path = Path(code.co_filename)
            inside = path.is_relative_to(ROOT) and code.co_name not in BODIES
            known[code] = str(path.relative_to(ROOT)) if inside else None
        return known[code]

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or (name := name_of(frame.f_code)) is None:
            return
        files[name] = None
        caller = frame.f_back
        while caller is not None and name_of(caller.f_code) is None:
            caller = caller.f_back
        if caller is not None and (before := name_of(caller.f_code)) is not None and before != name:
            arrows[before, name] = None

    earlier = sys.getprofile()
    sys.setprofile(note)
    try:
        program()
    finally:
        sys.setprofile(earlier)
    return Walk(tuple(files), tuple(arrows))
