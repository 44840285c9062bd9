"""Help of a command: its options in groups, as wide as the terminal; options that few need only with --help-all."""

import ast
import dataclasses
import inspect
import shutil
import textwrap
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tyro

GROUPS = {
    "data": (
        *("data", "robot", "test", "scene", "needs", "lock", "rate", "units", "joints", "topics", "torque_factor"),
        *("cutoff", "accept_log"),
    ),
    "model": ("model", "width", "depth", "activation", "degree", "members", "field", "parents", "kinematic_prior"),
    "training": (
        *("optimizer", "objective", "steps", "epochs", "iterations", "seconds", "seed", "seeds", "batch"),
        *("learning_rate", "samples", "target", "precision", "uncertainty"),
    ),
    "output": ("out", "resume", "figures", "overwrite"),
    "devices": ("devices", "processes", "coordinator", "process_id", "compilation_cache"),
}
"""Options by group, for commands that have its first option; all others come first."""
RARE = {
    *("units", "topics", "torque_factor", "accept_log", "coordinator", "process_id", "compilation_cache"),
    *("processes", "depth", "activation", "batch", "learning_rate", "samples", "target", "precision", "uncertainty"),
    *("members", "box", "effort", "rough", "noise", "height", "payload_position", "vtu", "scale", "poisson_ratio"),
    *("mixed", "youngs_modulus_of", "coupled", "velocity_scale"),
}
"""Options that `--help` leaves out and `--help-all` shows."""
METAVARS = {int: "INT", float: "NUMBER", Path: "PATH"}
COLUMN = 20
"""Width of the column of options, characters."""


def help_text(arguments: type, *, prog: str, description: str, common: type | None = None, every: bool = False) -> str:
    """Help of a command.

    Args:
        arguments: dataclass of the options; the string below a field is its text.
        prog: the command as the user typed it.
        description: what the command does.
        common: dataclass of options that every command has.
        every: whether to show all options.
    """
    width = max(60, min(shutil.get_terminal_size().columns, 100))
    every_option = [option for one in (arguments, common) if one for option in options_of(one)]
    shown = [option for option in every_option if every or option[0] not in RARE]
    paragraphs = [textwrap.fill(part, width) for part in inspect.cleandoc(description).split("\n\n")]
    lines = [f"usage: {prog} [OPTIONS]", "", *"\n\n".join(paragraphs).split("\n")]
    names = [name for name, _, _ in every_option]
    groups = {title: members for title, members in GROUPS.items() if members[0] in names}
    own = [name for name in names if not any(name in members for members in groups.values())]
    for title, members in {"options": own, **groups}.items():
        if options := sorted((one for one in shown if one[0] in members), key=lambda one: members.index(one[0])):
            lines += ["", f"{title}:", *(line for _, usage, text in options for line in _rows(usage, text, width))]
    if left := len(every_option) - len(shown):
        lines += ["", f"{left} more options: {prog} --help-all"]
    return "\n".join(lines)


def options_of(arguments: type) -> list[tuple[str, str, str]]:
    """Options of a dataclass, in its order: name, usage such as "--rate NUMBER", and text with unit and default."""
    hints, texts, options = get_type_hints(arguments, include_extras=True), _texts(arguments), []
    for field in dataclasses.fields(arguments):
        marks = getattr(hints[field.name], "__metadata__", ())
        if tyro.conf.Fixed in marks:
            continue
        usage, default = f"--{field.name.replace('_', '-')}", field.default
        stated = next((mark for mark in marks if hasattr(mark, "metavar")), None)
        kind = get_args(hints[field.name])[0] if marks else hints[field.name]
        text = stated.help if stated and stated.help else texts[field.name]
        hint = f" (default: {default})"
        if kind is not bool:
            usage += f" {stated.metavar if stated and stated.metavar else _metavar(kind)}"
        elif default is True:
            usage, text = f"--no-{usage[2:]}", f"Do not {text[0].lower()}{text[1:]}"
        if default is dataclasses.MISSING:
            hint = " (required)"
        elif default is None or kind is bool or (stated and stated.help_behavior_hint == ""):
            hint = ""
        options.append((field.name, usage, f"{text.rstrip('.')}{hint}."))
    return options


def _metavar(kind: Any) -> str:
    members = [member for member in get_args(kind) if member is not type(None)]
    if get_origin(kind) is Literal:
        return "{" + ",".join(map(str, members)) + "}"
    return _metavar(members[0]) if members else METAVARS.get(kind, "TEXT")


def _texts(arguments: type) -> dict[str, str]:
    """The string below each field, also of base classes."""
    texts = {}
    for one in reversed([one for one in arguments.__mro__ if dataclasses.is_dataclass(one)]):
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(one))).body[0]
        except OSError:  # a class that was made at run time, whose fields state their texts
            continue
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                texts[ast.unparse(field.target)] = " ".join(str(ast.literal_eval(below.value)).split())
    return texts


def _rows(usage: str, text: str, width: int) -> list[str]:
    wrap = partial(textwrap.wrap, width=width, break_on_hyphens=False)
    head = wrap(usage.replace(",", ", "), initial_indent="  ", subsequent_indent="      ")
    head = [line.replace(", ", ",") for line in head]
    body = wrap(text, initial_indent=" " * COLUMN, subsequent_indent=" " * COLUMN)
    if len(head[-1]) < COLUMN - 1 and body:
        return [*head[:-1], f"{head[-1]:{COLUMN}}{body[0][COLUMN:]}", *body[1:]]
    return [*head, *body]
