"""What a model selection tells: a table of its candidates, and selection.json."""

import io
import itertools
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from dln_jax.files import write_json
from dln_jax.learning.context import Context


def say_selection(context: Context, title: str, kept: str, ended: str, rows: Sequence[dict[str, Any]]) -> None:
    """Says a table of the candidates, and why the selection ended; writes both into the run's folder.

    Args:
        kept: name of the kept candidate.
        ended: why no further candidate was tried; empty if all were.
        rows: a dictionary for each candidate, with its `name`; lists and texts are not shown.
    """
    shown = [key for key in dict.fromkeys(itertools.chain(*rows)) if key not in ("name", "joints", "reason")]
    table = Table("model", *(key.replace("_", " ") for key in shown), "", title=title)
    for row in rows:
        values = (row.get(key) for key in shown)
        numbers = [
            f"{value:.3g}" if isinstance(value, float) else "" if value is None else f"{value}" for value in values
        ]
        table.add_row(row["name"], *numbers, "kept" if row["name"] == kept else "")
    text = io.StringIO()
    Console(file=text, highlight=False, soft_wrap=True).print(table)
    context.say(text.getvalue().rstrip())
    if ended:
        context.say(f"no further model was tried: {ended}")
    if context.folder is not None:
        write_json(context.folder / "selection.json", {"kept": kept, "ended": ended, "candidates": list(rows)})
