"""The end of a run: its files, printed table, verdict and exit status, and its figures."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Column, Table

from dln_jax.errors import FitRefused, InputError
from dln_jax.files import write_figure, write_json
from dln_jax.learning.engine.problem import Training
from dln_jax.metrics.latency import Latency
from dln_jax.metrics.verdict import Verdict
from dln_jax.runs.devices import print_compilation
from dln_jax.runs.folder import write_config


class Report(NamedTuple):
    """Results of a run."""

    metrics: Mapping[str, float | int]
    """Contents of metrics.json."""
    rows: Iterable[Sequence[str]]
    """Rows of the printed table; empty if the lines are enough."""
    title: str
    columns: tuple[str, ...] = ("quantity", "value", "unit")
    verdict: Verdict | None = None
    """Whether the model may be used; `None` if there is no test."""
    figures: Mapping[str, Callable[[Path], None]] = {}
    """File name -> function that writes the figure or film to a path."""
    chosen: Mapping[str, Any] = {}
    """Values that the fit derived from the arguments, for config.json."""
    lines: tuple[str, ...] = ()
    """Lines below the table."""
    ended_by_user: bool = False
    """Whether the user's own limit of steps or time ended the training: a refused fit is then a warning."""
    error: str = ""
    """Why the command fails although its run folder is complete; empty if it does not."""


def png(draw: Callable[..., Figure], *arguments: Any, **options: Any) -> Callable[[Path], None]:
    """Function that draws a figure and writes it to a path."""
    return lambda path: write_figure(path, draw(*arguments, **options))


def finish(folder: Path, options: Any, report: Report) -> None:
    """Stores and prints a report, and draws its figures unless the options decline them; the verdict comes last.

    Raises:
        InputError: a training that failed.
        FitRefused: the model must not be used, and no limit of the user ended its training; the run folder is complete.
    """
    write_json(folder / "metrics.json", dict(report.metrics))
    verdict = report.verdict
    stored = {} if verdict is None else {"verdict": verdict._asdict()}
    write_config(folder, options, **report.chosen, **stored)
    if report.rows:
        print_numbers(report.rows, title=report.title, columns=report.columns)
    if getattr(options, "figures", False):
        for name, draw in report.figures.items():
            draw(folder / name)
    print_compilation()
    print(f"run folder: {folder}", *report.lines, sep="\n")
    refused = verdict is not None and verdict.level == "refused"
    if refused and report.ended_by_user:
        print(
            "warning: the model is refused, but the exit status is 0, because --steps, --iterations or --seconds ended "
            "the training; train longer before you use this model"
        )
    if verdict is not None:
        print(verdict.line)
    if report.error:
        raise InputError(f"{folder}: {report.error}")
    if refused and not report.ended_by_user:
        raise FitRefused(verdict)


def print_numbers(
    rows: Iterable[Sequence[str]],
    *,
    title: str,
    columns: Sequence[str],
    width: int | None = None,
) -> None:
    """Prints a table of quantities, their values and units, `width` columns wide (default: the terminal's)."""
    left = ("quantity", "joint", "motion", "unit", "status")
    table = Table(*(Column(column, justify="left" if column in left else "right") for column in columns), title=title)
    for row in rows:
        table.add_row(*row)
    Console(highlight=False, soft_wrap=True, width=width).print(table)


LABELS = {
    "train_seconds": "training time",
    "compile_seconds": "compilation time",
    "one_step_p50_us": "latency of one call, median",
    "one_step_p99_us": "latency of one call, 99th percentile",
    "_seconds": " time",
    "_median": ", median",
    "mse": "MSE",
    "_": " ",
}
"""Words for parts of metrics' names."""


def spaced(name: str, labels: Mapping[str, str] = {}) -> str:
    """The name of a metric or an option in words: those of `labels` for parts of it, then those of `LABELS`."""
    for part, words in {**labels, **LABELS}.items():
        name = name.replace(part, words)
    return name


def rows_of(
    metrics: Mapping[str, float | int], labels: Mapping[str, str] = {}, units: Mapping[str, str] = {}
) -> list[tuple[str, str, str]]:
    """Rows of the printed table: label, value and unit of every metric but the verdict, which is printed in words.

    Args:
        labels: as for `spaced`.
        units: units by a part of the name; the first that occurs counts, and times have one of their own.
    """
    rows = []
    for name, value in metrics.items():
        unit = next(unit for part, unit in {**units, "_seconds": "s", "_us": "µs", "": ""}.items() if part in name)
        if name != "verdict":
            whole = float(value).is_integer() and abs(value) < 1e9
            rows.append((spaced(name, labels), f"{value:,.0f}" if whole else f"{value:.4g}", unit))
    return rows


def one_step_metrics(latency: Latency) -> dict[str, float]:
    """Latency metrics of single calls."""
    return {"one_step_p50_us": latency.p50_us, "one_step_p99_us": latency.p99_us}


def cost_metrics(training: Training, latency: Latency, *, parameters: int, best_step: int) -> dict[str, float | int]:
    """Costs of training a model and of its calls."""
    return {
        "parameters": parameters,
        "steps": training.stop.step,
        "best_step": best_step,
        "compile_seconds": training.compile_seconds,
        "train_seconds": training.train_seconds,
        **one_step_metrics(latency),
    }
